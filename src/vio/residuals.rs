//! Residuals and their analytic Jacobians. Every one is checked by finite differences.
//!
//! A landmark lives in the camera 0 of its host: stereographic direction `s` and inverse distance
//! `rho`. Its point, scaled by `rho`, is `b(s)`, so points at infinity are ordinary:
//! `x_w = R_h (R_c b + rho t_c) + rho p_h`, `x_t = R_tᵀ (x_w - rho p_t)`; projection ignores the scale.

use super::preintegration::{Increment, Mat9, GRAVITY};
use crate::math::so3;
use glam::{DMat3, DVec2, DVec3};
use nalgebra::SMatrix;
use stipple_drivers::{Camera, Pose, RigCamera};

/// A rotation matrix and a position: what many residuals of one frame share.
#[derive(Clone, Copy, Debug, Default)]
pub struct Body {
    pub r: DMat3,
    pub p: DVec3,
}

impl From<&Pose> for Body {
    fn from(pose: &Pose) -> Body {
        Body { r: pose.rotation(), p: pose.p }
    }
}

/// A camera and where it sits on the body.
#[derive(Clone, Copy, Debug)]
pub struct Eye {
    pub camera: Camera,
    pub body_from_cam: Body,
}

impl From<&RigCamera> for Eye {
    fn from(c: &RigCamera) -> Eye {
        Eye { camera: c.camera, body_from_cam: Body::from(&c.body_from_cam) }
    }
}

/// A point seen from its host's camera 0.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Point {
    /// (x, y)/(1 + z) of the unit bearing.
    pub s: DVec2,
    /// 1/m along the bearing.
    pub rho: f64,
}

impl Point {
    pub fn new(bearing: DVec3, rho: f64) -> Point {
        Point { s: bearing.truncate() / (1.0 + bearing.z), rho }
    }

    pub fn bearing(&self) -> DVec3 {
        let n = self.s.length_squared();
        (2.0 * self.s).extend(1.0 - n) / (1.0 + n)
    }

    fn d_bearing(&self) -> [DVec3; 2] {
        let (s, n) = (self.s, self.s.length_squared());
        let k = 2.0 / ((1.0 + n) * (1.0 + n));
        [
            DVec3::new(1.0 + n - 2.0 * s.x * s.x, -2.0 * s.x * s.y, -2.0 * s.x) * k,
            DVec3::new(-2.0 * s.x * s.y, 1.0 + n - 2.0 * s.y * s.y, -2.0 * s.y) * k,
        ]
    }
}

/// Prediction minus observation, px, and derivatives to [p, θ] of both frames and to [s, rho].
#[derive(Clone, Copy, Debug, Default)]
pub struct Reprojection {
    pub px: DVec2,
    pub d_host: [[f64; 6]; 2],
    pub d_target: [[f64; 6]; 2],
    pub d_point: [[f64; 3]; 2],
}

/// Pixel at which `eye` on `target` sees the point of `host_eye` on `host`.
pub fn predict(point: &Point, host_eye: &Body, host: &Body, eye: &Eye, target: &Body) -> Option<DVec2> {
    let x_host = host_eye.r * point.bearing() + host_eye.p * point.rho;
    let x_rel = host.r * x_host + (host.p - target.p) * point.rho;
    let x_target = target.r.transpose() * x_rel;
    let x_cam = eye.body_from_cam.r.transpose() * (x_target - eye.body_from_cam.p * point.rho);
    eye.camera.project(x_cam)
}

pub fn reproject(point: &Point, host_eye: &Body, host: &Body, eye: &Eye, target: &Body) -> Option<Reprojection> {
    let rho = point.rho;
    let x_host = host_eye.r * point.bearing() + host_eye.p * rho;
    let x_rel = host.r * x_host + (host.p - target.p) * rho;
    let x_target = target.r.transpose() * x_rel;
    let x_cam = eye.body_from_cam.r.transpose() * (x_target - eye.body_from_cam.p * rho);
    let (px, d_px) = eye.camera.project_with_jacobian(x_cam)?;
    let d_bearing = point.d_bearing();
    let d_rho_rel = host.r * host_eye.p + host.p - target.p;
    let mut out = Reprojection { px, ..Reprojection::default() };
    for k in 0..2 {
        // The row g of d(px)/d(x_cam), carried back through each frame.
        let g_target = eye.body_from_cam.r * DVec3::from_array(d_px[k]);
        let g_world = target.r * g_target;
        let g_host = host.r.transpose() * g_world;
        let g_point = host_eye.r.transpose() * g_host;
        let p = g_world * rho;
        let th_host = x_host.cross(g_host);
        let th_target = g_target.cross(x_target);
        out.d_host[k] = [p.x, p.y, p.z, th_host.x, th_host.y, th_host.z];
        out.d_target[k] = [-p.x, -p.y, -p.z, th_target.x, th_target.y, th_target.z];
        let d_rho = g_world.dot(d_rho_rel) - g_target.dot(eye.body_from_cam.p);
        out.d_point[k] = [g_point.dot(d_bearing[0]), g_point.dot(d_bearing[1]), d_rho];
    }
    Some(out)
}

/// Pose, velocity and biases of one frame.
#[derive(Clone, Copy, Debug, Default)]
pub struct Motion {
    pub pose: Pose,
    pub v: DVec3,
    pub bg: DVec3,
    pub ba: DVec3,
}

impl Motion {
    /// Retraction by an error [p, θ, v, bg, ba].
    pub fn plus(&self, d: &[f64; 15]) -> Motion {
        let at = |i: usize| DVec3::new(d[i], d[i + 1], d[i + 2]);
        Motion {
            pose: Pose::new(self.pose.q * so3::exp(at(3)), self.pose.p + at(0)),
            v: self.v + at(6),
            bg: self.bg + at(9),
            ba: self.ba + at(12),
        }
    }

    pub fn is_finite(&self) -> bool {
        self.pose.is_finite() && self.v.is_finite() && self.bg.is_finite() && self.ba.is_finite()
    }

    /// Where the increment leads.
    pub fn propagate(&self, inc: &Increment) -> Motion {
        let (p, q, v) = inc.corrected(self.bg, self.ba);
        let dt = inc.dt;
        Motion {
            pose: Pose::new(self.pose.q * q, self.pose.p + self.v * dt + GRAVITY * (0.5 * dt * dt) + self.pose.q * p),
            v: self.v + GRAVITY * dt + self.pose.q * v,
            ..*self
        }
    }
}

pub type Mat15 = SMatrix<f64, 15, 15>;
pub type Vec15 = SMatrix<f64, 15, 1>;

/// Whitening of an inertial factor: the increment's covariance and the bias walk.
#[derive(Clone, Copy, Debug)]
pub struct InertialWeight {
    pub increment: Mat9,
    pub bg: f64,
    pub ba: f64,
}

/// Whitened residual [p, θ, v, bg, ba] between two frames.
pub fn inertial_residual(inc: &Increment, w: &InertialWeight, a: &Motion, b: &Motion) -> Vec15 {
    let dt = inc.dt;
    let (p, q, v) = inc.corrected(a.bg, a.ba);
    let to_a = a.pose.q.conjugate();
    let r_p = to_a * (b.pose.p - a.pose.p - a.v * dt - GRAVITY * (0.5 * dt * dt)) - p;
    let r_q = so3::log(q.conjugate() * to_a * b.pose.q);
    let r_v = to_a * (b.v - a.v - GRAVITY * dt) - v;
    let r = SMatrix::<f64, 9, 1>::from_column_slice(&[r_p.x, r_p.y, r_p.z, r_q.x, r_q.y, r_q.z, r_v.x, r_v.y, r_v.z]);
    let mut out = Vec15::zeros();
    out.fixed_rows_mut::<9>(0).copy_from(&(w.increment * r));
    let (r_bg, r_ba) = ((b.bg - a.bg) * w.bg, (b.ba - a.ba) * w.ba);
    for i in 0..3 {
        out[9 + i] = r_bg[i];
        out[12 + i] = r_ba[i];
    }
    out
}

/// Derivatives of the whitened residual to the errors of both frames.
pub fn inertial_jacobians(inc: &Increment, w: &InertialWeight, a: &Motion, b: &Motion) -> (Mat15, Mat15) {
    let dt = inc.dt;
    let (_, q, _) = inc.corrected(a.bg, a.ba);
    let to_a = a.pose.q.conjugate();
    let r_to_a = DMat3::from_quat(to_a);
    let r_q = so3::log(q.conjugate() * to_a * b.pose.q);
    let jr_inv = so3::right_jacobian_inverse(r_q);
    let mut ja = Mat15::zeros();
    let mut jb = Mat15::zeros();
    let mut set = |m: usize, row: usize, col: usize, x: DMat3| {
        let target = if m == 0 { &mut ja } else { &mut jb };
        for c in 0..3 {
            for r in 0..3 {
                target[(row + r, col + c)] = x.col(c)[r];
            }
        }
    };
    set(0, 0, 0, -r_to_a);
    set(0, 0, 3, so3::hat(to_a * (b.pose.p - a.pose.p - a.v * dt - GRAVITY * (0.5 * dt * dt))));
    set(0, 0, 6, r_to_a * -dt);
    set(0, 0, 9, -inc.d_p_bg());
    set(0, 0, 12, -inc.d_p_ba());
    set(1, 0, 0, r_to_a);
    set(0, 3, 3, -jr_inv * DMat3::from_quat(b.pose.q.conjugate() * a.pose.q));
    let d_bg = inc.d_q_bg();
    let shift = d_bg * (a.bg - inc.bg);
    set(0, 3, 9, -jr_inv * DMat3::from_quat(so3::exp(-r_q)) * so3::right_jacobian(shift) * d_bg);
    set(1, 3, 3, jr_inv);
    set(0, 6, 3, so3::hat(to_a * (b.v - a.v - GRAVITY * dt)));
    set(0, 6, 6, -r_to_a);
    set(0, 6, 9, -inc.d_v_bg());
    set(0, 6, 12, -inc.d_v_ba());
    set(1, 6, 6, r_to_a);
    for (at, weight) in [(9, w.bg), (12, w.ba)] {
        set(0, at, at, DMat3::from_diagonal(DVec3::splat(-weight)));
        set(1, at, at, DMat3::from_diagonal(DVec3::splat(weight)));
    }
    for j in [&mut ja, &mut jb] {
        let whitened = w.increment * j.fixed_rows::<9>(0);
        j.fixed_rows_mut::<9>(0).copy_from(&whitened);
    }
    (ja, jb)
}

/// Huber on a whitened length: (weight of the squared residual, cost).
#[inline]
pub fn huber(length: f64, width: f64) -> (f64, f64) {
    if length <= width {
        (1.0, 0.5 * length * length)
    } else {
        (width / length, width * (length - 0.5 * width))
    }
}
