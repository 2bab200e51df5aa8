//! Twin of project.comp and project_backward.comp: centre, conic, opacity, grey and depth of a Gaussian on
//! the image, with exact derivatives.

use super::dual::{constant, cross, dot, variable, Dual};
use glam::DMat3;
use stipple::map::pipeline::{SplatInit, View};

pub const NEAR: f64 = 0.05;
pub const LOW_PASS: f64 = 0.3;
const MARGIN: f64 = 0.15;

/// Parameters in the order of `SplatInit`: mean, log scale, quaternion xyzw, opacity logit, grey.
pub type Parameters = [f64; 12];

pub fn parameters(s: &SplatInit) -> Parameters {
    let mut p = [0.0; 12];
    let all = s.mean.iter().chain(&s.log_scale).chain(&s.quat_xyzw).chain([&s.opacity_logit, &s.colour]);
    all.zip(&mut p).for_each(|(a, b)| *b = f64::from(*a));
    p
}

/// centre x, y (integer = pixel centre), conic a, b, c, opacity, grey, depth.
pub type Projected = [Dual; 8];

/// `None` behind the camera. `twist` moves points of the camera frame: x -> Exp(twist) x, translation first.
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
    if c[2].v.is_nan() || c[2].v < NEAR {
        return None;
    }

    let norm = (x[6] * x[6] + x[7] * x[7] + x[8] * x[8] + x[9] * x[9]).sqrt();
    let (qx, qy, qz, qw) = (x[6] / norm, x[7] / norm, x[8] / norm, x[9] / norm);
    let (one, two) = (constant(1.0), constant(2.0));
    let columns = [
        [one - two * (qy * qy + qz * qz), two * (qx * qy + qw * qz), two * (qx * qz - qw * qy)],
        [two * (qx * qy - qw * qz), one - two * (qx * qx + qz * qz), two * (qy * qz + qw * qx)],
        [two * (qx * qz + qw * qy), two * (qy * qz - qw * qx), one - two * (qx * qx + qy * qy)],
    ];

    let k = &view.camera;
    let (fx, fy) = (constant(k.fx), constant(k.fy));
    let (slope_x, slope_y) = (c[0] / c[2], c[1] / c[2]);
    let edge = |pp: f64, size: usize, f: f64| {
        ((-MARGIN * size as f64 - pp - 0.5) / f, ((1.0 + MARGIN) * size as f64 - pp - 0.5) / f)
    };
    let (lx, hx) = edge(k.cx, k.width, k.fx);
    let (ly, hy) = edge(k.cy, k.height, k.fy);
    let (jx, jy) = (slope_x.clamp(lx, hx), slope_y.clamp(ly, hy));
    let mut vx = [constant(0.0); 3];
    let mut vy = vx;
    for i in 0..3 {
        let s = x[3 + i].exp();
        let axis = rotate(columns[i].map(|e| e * s));
        vx[i] = fx / c[2] * (axis[0] - jx * axis[2]);
        vy[i] = fy / c[2] * (axis[1] - jy * axis[2]);
    }
    let low_pass = constant(LOW_PASS);
    let (cxx, cxy, cyy) = (dot(vx, vx) + low_pass, dot(vx, vy), dot(vy, vy) + low_pass);
    let det = cxx * cyy - cxy * cxy;
    let centre = (fx * slope_x + constant(k.cx), fy * slope_y + constant(k.cy));
    Some([centre.0, centre.1, cyy / det, -cxy / det, cxx / det, x[10].sigmoid(), x[11], c[2]])
}
