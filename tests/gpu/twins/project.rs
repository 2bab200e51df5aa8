//! Twin of project.comp and project_backward.comp: centre, conic, opacity, grey and depth of a Gaussian on
//! the image, with exact derivatives.

use super::dual::{constant, cross, dot, variable, Dual};
use glam::DMat3;
use stipple::map::{Gaussian, View};

pub const NEAR: f64 = 0.05;
pub const LOW_PASS: f64 = 0.3;
const MARGIN: f64 = 0.15;
const LOG_SCALE: (f64, f64) = (-11.5, 4.6);

/// Parameters in the order of `Gaussian`: mean, log scale, quaternion xyzw, opacity logit, grey.
pub type Parameters = [f64; 12];

pub fn parameters(s: &Gaussian) -> Parameters {
    let mut p = [0.0; 12];
    let all = s.mean.iter().chain(&s.log_scale).chain(&s.quat_xyzw).chain([&s.opacity_logit, &s.colour[0]]);
    all.zip(&mut p).for_each(|(a, b)| *b = f64::from(*a));
    p
}

/// centre x, y (integer = pixel centre), conic a, b, c, opacity, grey, depth.
pub type Projected = [Dual; 8];

/// Centre without the principal point, and its Jacobian by the position, rows x and y.
struct Lens {
    centre: [Dual; 2],
    jacobian: [[Dual; 3]; 2],
}

fn pinhole(c: &[Dual; 3], view: &View) -> Lens {
    let k = &view.camera;
    let focal = [constant(k.fx), constant(k.fy)];
    let slope = [c[0] / c[2], c[1] / c[2]];
    let edge = |pp: f64, size: usize, f: f64| {
        ((-MARGIN * size as f64 - pp - 0.5) / f, ((1.0 + MARGIN) * size as f64 - pp - 0.5) / f)
    };
    let ((lx, hx), (ly, hy)) = (edge(k.cx, k.width, k.fx), edge(k.cy, k.height, k.fy));
    let held = [slope[0].clamp(lx, hx), slope[1].clamp(ly, hy)];
    let (j, zero) = ([focal[0] / c[2], focal[1] / c[2]], constant(0.0));
    Lens {
        centre: [focal[0] * slope[0], focal[1] * slope[1]],
        jacobian: [[j[0], zero, -(j[0] * held[0])], [zero, j[1], -(j[1] * held[1])]],
    }
}

/// Radius and angle instead of the kernel's three scalars: D(θ) along the unit vector (x, y) / r.
fn fisheye(c: &[Dual; 3], view: &View, k: &[f64; 4]) -> Lens {
    let [x, y, z] = *c;
    let r = (x * x + y * y).sqrt();
    let theta = r.atan2(z);
    let t2 = theta * theta;
    let series = |c: [f64; 4]| {
        let one = constant(1.0);
        one + t2 * (constant(c[0]) + t2 * (constant(c[1]) + t2 * (constant(c[2]) + t2 * constant(c[3]))))
    };
    let along = series([3.0 * k[0], 5.0 * k[1], 7.0 * k[2], 9.0 * k[3]]) / (r * r + z * z);
    let (across, outwards) = (theta * series(*k) / r, along * z);
    let e = [x / r, y / r];
    let focal = [constant(view.camera.fx), constant(view.camera.fy)];
    let stretch = outwards - across;
    let row = |i: usize| {
        let mut j = [stretch * e[i] * e[0], stretch * e[i] * e[1], -(along * c[i])];
        j[i] = j[i] + across;
        j.map(|v| focal[i] * v)
    };
    Lens { centre: [focal[0] * across * x, focal[1] * across * y], jacobian: [row(0), row(1)] }
}

/// Depth that orders, or `None` where the kernel draws nothing.
fn depth(c: &[Dual; 3], view: &View) -> Option<Dual> {
    let range = dot(*c, *c).sqrt();
    let seen = match view.fisheye {
        None => c[2].v >= NEAR,
        Some(f) => range.v >= NEAR && c[0].v.hypot(c[1].v).atan2(c[2].v) <= f.theta_max,
    };
    seen.then_some(if view.fisheye.is_some() { range } else { c[2] })
}

/// `None` behind the camera, or not finite. `twist` moves points of the camera frame: x -> Exp(twist) x, translation first.
pub fn project(p: &Parameters, view: &View, twist: &[f64; 6]) -> Option<Projected> {
    let x: [Dual; 12] = std::array::from_fn(|i| variable(p[i], i));
    let xi: [Dual; 6] = std::array::from_fn(|i| variable(0.0, 12 + i));
    let turn = DMat3::from_quat(glam::DQuat::from_scaled_axis(glam::DVec3::from_slice(&twist[3..])));
    let cam_from_world = view.world_from_cam.inverse();
    let r = turn * cam_from_world.rotation();
    let t = turn * cam_from_world.p + glam::DVec3::from_slice(&twist[..3]);

    let rotate = |v: [Dual; 3]| -> [Dual; 3] {
        let turned: [Dual; 3] =
            std::array::from_fn(|i| (0..3).fold(constant(0.0), |s, j| s + constant(r.col(j)[i]) * v[j]));
        let extra = cross([xi[3], xi[4], xi[5]], turned);
        std::array::from_fn(|i| turned[i] + extra[i])
    };
    let offset = [constant(t.x), constant(t.y), constant(t.z)];
    let moved = cross([xi[3], xi[4], xi[5]], offset);
    let rotated = rotate([x[0], x[1], x[2]]);
    let c: [Dual; 3] = std::array::from_fn(|i| rotated[i] + offset[i] + moved[i] + xi[i]);
    let norm2: f64 = p[6..10].iter().map(|q| q * q).sum();
    if !(c.iter().all(|c| c.v.is_finite()) && p.iter().all(|p| p.is_finite()) && norm2 >= 1e-6) {
        return None;
    }
    let depth = depth(&c, view)?;
    let norm = (x[6] * x[6] + x[7] * x[7] + x[8] * x[8] + x[9] * x[9]).sqrt();
    let (qx, qy, qz, qw) = (x[6] / norm, x[7] / norm, x[8] / norm, x[9] / norm);
    let (one, two) = (constant(1.0), constant(2.0));
    let columns = [
        [one - two * (qy * qy + qz * qz), two * (qx * qy + qw * qz), two * (qx * qz - qw * qy)],
        [two * (qx * qy - qw * qz), one - two * (qx * qx + qz * qz), two * (qy * qz + qw * qx)],
        [two * (qx * qz + qw * qy), two * (qy * qz - qw * qx), one - two * (qx * qx + qy * qy)],
    ];

    let lens = match &view.fisheye {
        None => pinhole(&c, view),
        Some(f) => fisheye(&c, view, &f.k),
    };
    let mut vx = [constant(0.0); 3];
    let mut vy = vx;
    for i in 0..3 {
        let s = x[3 + i].clamp(LOG_SCALE.0, LOG_SCALE.1).exp();
        let axis = rotate(columns[i].map(|e| e * s));
        vx[i] = dot(lens.jacobian[0], axis);
        vy[i] = dot(lens.jacobian[1], axis);
    }
    let low_pass = constant(LOW_PASS);
    let (cxx, cxy, cyy) = (dot(vx, vx) + low_pass, dot(vx, vy), dot(vy, vy) + low_pass);
    // As the kernel: by Lagrange's identity no digits are lost on needles.
    let n = cross(vx, vy);
    let det = dot(n, n) + low_pass * (cxx + cyy) - low_pass * low_pass;
    let centre = [lens.centre[0] + constant(view.camera.cx), lens.centre[1] + constant(view.camera.cy)];
    Some([centre[0], centre[1], cyy / det, -cxy / det, cxx / det, x[10].sigmoid(), x[11], depth])
}
