//! Residuals and their analytic Jacobians. Every one is checked by finite differences.
//!
//! A landmark lives in the camera 0 of its host: stereographic direction `s` and inverse distance
//! `rho`. Its point, scaled by `rho`, is `b(s)`, so points at infinity are ordinary:
//! `x_w = R_h (R_c b + rho t_c) + rho p_h`, `x_t = R_tᵀ (x_w - rho p_t)`; projection ignores the scale.

use super::preintegration::{Increment, Mat9, GRAVITY};
use crate::math::block::{block, put};
use crate::math::so3;
use glam::{DMat3, DVec2, DVec3};
use nalgebra::SMatrix;
use stipple_drivers::{Camera, Pose, RigCamera};

/// A rotation matrix and a position: what many residuals of one frame share.
#[derive(Clone, Copy, Debug, Default)]
pub struct Transform {
    pub r: DMat3,
    pub p: DVec3,
}

impl From<&Pose> for Transform {
    fn from(pose: &Pose) -> Transform {
        Transform { r: pose.rotation(), p: pose.p }
    }
}

/// A camera and where it sits on the body.
#[derive(Clone, Copy, Debug)]
pub struct CameraModel {
    pub camera: Camera,
    pub body_from_cam: Transform,
    /// First row to last, s; zero is a global shutter.
    pub readout: f64,
}

impl From<&RigCamera> for CameraModel {
    fn from(c: &RigCamera) -> CameraModel {
        CameraModel { camera: c.camera, body_from_cam: Transform::from(&c.body_from_cam), readout: c.readout.secs() }
    }
}

impl CameraModel {
    /// When a row is exposed, after the stamp, which is the middle row's, s.
    pub fn row_delay(&self, row: f64) -> f64 {
        self.readout * (row / (self.camera.height - 1).max(1) as f64 - 0.5)
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

/// Pixel at which `camera_model` on `target` sees the point of `host_eye` on `host`.
pub fn predict(
    point: &Point,
    host_cam: &Transform,
    host: &Transform,
    camera_model: &CameraModel,
    target: &Transform,
) -> Option<DVec2> {
    let x_host = host_cam.r * point.bearing() + host_cam.p * point.rho;
    let x_rel = host.r * x_host + (host.p - target.p) * point.rho;
    let x_target = target.r.transpose() * x_rel;
    let x_cam = camera_model.body_from_cam.r.transpose() * (x_target - camera_model.body_from_cam.p * point.rho);
    camera_model.camera.project(x_cam)
}

/// Derivatives to [p, θ] of the cameras on the body, host's and target's.
#[derive(Clone, Copy, Debug, Default)]
pub struct ExtrinsicDerivatives {
    pub host: [[f64; 6]; 2],
    pub target: [[f64; 6]; 2],
}

#[inline]
pub fn reproject(
    point: &Point,
    host_cam: &Transform,
    host: &Transform,
    camera_model: &CameraModel,
    target: &Transform,
) -> Option<Reprojection> {
    trace(point, host_cam, host, camera_model, target, |_, _| {})
}

/// The same, with derivatives to where the cameras sit.
pub fn reproject_with_extrinsics(
    point: &Point,
    host_cam: &Transform,
    host: &Transform,
    camera_model: &CameraModel,
    target: &Transform,
) -> Option<(Reprojection, ExtrinsicDerivatives)> {
    let mut d = ExtrinsicDerivatives::default();
    let bearing = point.bearing();
    let r = trace(point, host_cam, host, camera_model, target, |k, g| {
        let (th_host, th_target) = (bearing.cross(g.point), g.cam.cross(g.x_cam));
        let (p_host, p_target) = (g.host * point.rho, g.target * -point.rho);
        d.host[k] = [p_host.x, p_host.y, p_host.z, th_host.x, th_host.y, th_host.z];
        d.target[k] = [p_target.x, p_target.y, p_target.z, th_target.x, th_target.y, th_target.z];
    })?;
    Some((r, d))
}

/// A row of d(px)/d(x_cam), carried back through each frame on the ray's way.
struct Gradient {
    x_cam: DVec3,
    cam: DVec3,
    target: DVec3,
    host: DVec3,
    point: DVec3,
}

#[inline(always)]
fn trace(
    point: &Point,
    host_cam: &Transform,
    host: &Transform,
    camera_model: &CameraModel,
    target: &Transform,
    mut each: impl FnMut(usize, &Gradient),
) -> Option<Reprojection> {
    let rho = point.rho;
    let x_host = host_cam.r * point.bearing() + host_cam.p * rho;
    let x_rel = host.r * x_host + (host.p - target.p) * rho;
    let x_target = target.r.transpose() * x_rel;
    let x_cam = camera_model.body_from_cam.r.transpose() * (x_target - camera_model.body_from_cam.p * rho);
    let (px, d_px) = camera_model.camera.project_with_jacobian(x_cam)?;
    let d_bearing = point.d_bearing();
    let d_rho_rel = host.r * host_cam.p + host.p - target.p;
    let mut out = Reprojection { px, ..Reprojection::default() };
    for k in 0..2 {
        let g_cam = DVec3::from_array(d_px[k]);
        let g_target = camera_model.body_from_cam.r * g_cam;
        let g_world = target.r * g_target;
        let g_host = host.r.transpose() * g_world;
        let g_point = host_cam.r.transpose() * g_host;
        let p = g_world * rho;
        let th_host = x_host.cross(g_host);
        let th_target = g_target.cross(x_target);
        out.d_host[k] = [p.x, p.y, p.z, th_host.x, th_host.y, th_host.z];
        out.d_target[k] = [-p.x, -p.y, -p.z, th_target.x, th_target.y, th_target.z];
        let d_rho = g_world.dot(d_rho_rel) - g_target.dot(camera_model.body_from_cam.p);
        out.d_point[k] = [g_point.dot(d_bearing[0]), g_point.dot(d_bearing[1]), d_rho];
        each(k, &Gradient { x_cam, cam: g_cam, target: g_target, host: g_host, point: g_point });
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
    let mut set = |m: usize, row: usize, col: usize, x: DMat3| put([&mut ja, &mut jb][m], row, col, x);
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

/// Derivatives of the whitened residual of `inc.rescaled(gyro, accel)` to those scales, gyro's first.
pub fn scale_jacobian(
    inc: &Increment,
    w: &InertialWeight,
    a: &Motion,
    b: &Motion,
    gyro: DVec3,
    accel: DVec3,
) -> SMatrix<f64, 15, 6> {
    let scaled = inc.rescaled(gyro, accel);
    let (_, q, _) = scaled.corrected(a.bg, a.ba);
    let r_q = so3::log(q.conjugate() * a.pose.q.conjugate() * b.pose.q);
    let (of_gyro, of_accel) = (&inc.d_gyro_scale, &inc.d_accel_scale);
    // The rotation is q Exp(D s) Exp(D_bg db): what s adds is carried through the second, then to r_q.
    let shift = so3::exp(inc.d_q_bg() * (a.bg - inc.bg)).conjugate();
    let turn = block(of_gyro, 3, 0) * gyro + block(of_accel, 3, 0) * accel;
    let carry =
        -so3::right_jacobian_inverse(r_q) * DMat3::from_quat(so3::exp(-r_q) * shift) * so3::right_jacobian(turn);
    let mut plain = SMatrix::<f64, 9, 6>::zeros();
    for (col, d) in [(0, of_gyro), (3, of_accel)] {
        for (row, m) in [(0, -block(d, 0, 0)), (3, carry * block(d, 3, 0)), (6, -block(d, 6, 0))] {
            put(&mut plain, row, col, m);
        }
    }
    let mut out = SMatrix::<f64, 15, 6>::zeros();
    out.fixed_rows_mut::<9>(0).copy_from(&(w.increment * plain));
    out
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::preintegration::Noise;
    use super::*;
    use glam::DQuat;
    use stipple_drivers::Lens;

    const H: f64 = 1e-6;

    fn close(analytic: f64, numeric: f64, what: &str) {
        let error = (analytic - numeric).abs() / (1.0 + analytic.abs().max(numeric.abs()));
        assert!(error < 2e-6, "{what}: analytic {analytic}, numeric {numeric}");
    }

    fn moved(m: &Motion, i: usize, h: f64) -> Motion {
        let mut d = [0.0; 15];
        d[i] = h;
        m.plus(&d)
    }

    fn motion(k: f64) -> Motion {
        Motion {
            pose: Pose::new(DQuat::from_scaled_axis(DVec3::new(0.3, -0.2, 0.4) * k), DVec3::new(0.5, -0.3, 0.2) * k),
            v: DVec3::new(0.3, 0.8, -0.4) * k,
            bg: DVec3::new(0.01, -0.02, 0.03) * k,
            ba: DVec3::new(-0.1, 0.05, 0.2) * k,
        }
    }

    fn cameras() -> Vec<CameraModel> {
        let lenses = [
            Lens::Radtan { k1: -0.28, k2: 0.07, p1: 2e-4, p2: 2e-5 },
            Lens::KannalaBrandt { k: [0.01, -0.005, 0.003, -0.001] },
            Lens::DoubleSphere { xi: -0.2, alpha: 0.6 },
        ];
        let camera_model = |lens| CameraModel {
            camera: Camera { width: 752, height: 480, fx: 458.0, fy: 457.0, cx: 367.0, cy: 248.0, lens },
            body_from_cam: Transform::from(&Pose::new(
                DQuat::from_scaled_axis(DVec3::new(0.1, 0.2, -0.3)),
                DVec3::new(0.05, 0.1, -0.02),
            )),
            readout: 0.0,
        };
        lenses.into_iter().map(camera_model).collect()
    }

    #[test]
    fn reprojection_jacobians_match_differences_to_host_target_and_point() {
        let (host, target) = (motion(1.0), motion(1.3));
        for camera_model in cameras() {
            for point in [
                Point::new(DVec3::new(0.1, -0.2, 1.0).normalize(), 0.4),
                Point::new(DVec3::new(-0.3, 0.1, 1.0).normalize(), 0.0),
                Point::new(DVec3::new(0.4, 0.3, 1.0).normalize(), 1.5),
            ] {
                let f = |point: &Point, host: &Motion, target: &Motion| {
                    predict(
                        point,
                        &camera_model.body_from_cam,
                        &Transform::from(&host.pose),
                        &camera_model,
                        &Transform::from(&target.pose),
                    )
                    .unwrap()
                };
                let r = reproject(
                    &point,
                    &camera_model.body_from_cam,
                    &Transform::from(&host.pose),
                    &camera_model,
                    &Transform::from(&target.pose),
                )
                .unwrap();
                assert!((r.px - f(&point, &host, &target)).length() < 1e-12);
                for i in 0..6 {
                    let d_host = (f(&point, &moved(&host, i, H), &target) - f(&point, &moved(&host, i, -H), &target))
                        / (2.0 * H);
                    let d_target = (f(&point, &host, &moved(&target, i, H)) - f(&point, &host, &moved(&target, i, -H)))
                        / (2.0 * H);
                    for row in 0..2 {
                        close(r.d_host[row][i], d_host[row], "host");
                        close(r.d_target[row][i], d_target[row], "target");
                    }
                }
                for i in 0..3 {
                    let at = |h: f64| {
                        let mut p = point;
                        match i {
                            2 => p.rho += h,
                            _ => p.s[i] += h,
                        }
                        f(&p, &host, &target)
                    };
                    let d = (at(H) - at(-H)) / (2.0 * H);
                    (0..2).for_each(|row| close(r.d_point[row][i], d[row], "point"));
                }
            }
        }
    }

    #[test]
    fn stereographic_point_keeps_its_bearing() {
        for b in [DVec3::Z, DVec3::new(0.9, -0.4, 0.1), DVec3::new(-0.5, 0.5, -0.5)] {
            assert!((Point::new(b.normalize(), 1.0).bearing() - b.normalize()).length() < 1e-14);
        }
    }

    fn increment() -> (Increment, InertialWeight) {
        let noise = Noise {
            gyro: 1e-3,
            accel: 1e-2,
            gyro_walk: 1e-4,
            accel_walk: 1e-3,
            period: 0.005,
            gyro_max: 35.0,
            accel_max: 160.0,
            scale: true,
        };
        let mut inc = Increment::new(DVec3::new(0.005, 0.0, -0.01), DVec3::new(0.05, -0.05, 0.1));
        for k in 0..12 {
            let t = k as f64 * 0.3;
            inc.step(DVec3::new(t.sin(), 0.7, -t.cos()), DVec3::new(1.0, t.cos(), 9.0 + t.sin()), 0.005, &noise);
        }
        let weight = InertialWeight { increment: inc.whitening().unwrap(), bg: 300.0, ba: 20.0 };
        (inc, weight)
    }

    #[test]
    fn inertial_and_bias_jacobians_match_differences() {
        // Unit weights: whitening is a constant factor and would only hide digits.
        let (inc, _) = increment();
        let w = InertialWeight { increment: Mat9::identity(), bg: 1.0, ba: 1.0 };
        let (a, b) = (motion(1.0), motion(1.4));
        let (ja, jb) = inertial_jacobians(&inc, &w, &a, &b);
        for i in 0..15 {
            let f = |a: &Motion, b: &Motion| inertial_residual(&inc, &w, a, b);
            let da = (f(&moved(&a, i, H), &b) - f(&moved(&a, i, -H), &b)) / (2.0 * H);
            let db = (f(&a, &moved(&b, i, H)) - f(&a, &moved(&b, i, -H))) / (2.0 * H);
            for row in 0..15 {
                close(ja[(row, i)], da[row], "start");
                close(jb[(row, i)], db[row], "end");
            }
        }
    }

    #[test]
    fn scale_jacobian_matches_differences() {
        let (inc, _) = increment();
        let w = InertialWeight { increment: Mat9::identity(), bg: 1.0, ba: 1.0 };
        let (a, b) = (motion(1.0), motion(1.4));
        let (gyro, accel) = (DVec3::new(0.02, -0.01, 0.03), DVec3::new(-0.02, 0.01, 0.02));
        let j = scale_jacobian(&inc, &w, &a, &b, gyro, accel);
        for i in 0..6 {
            let at = |h: f64| {
                let e = DVec3::AXES[i % 3] * h;
                let (g, s) = if i < 3 { (gyro + e, accel) } else { (gyro, accel + e) };
                inertial_residual(&inc.rescaled(g, s), &w, &a, &b)
            };
            let d = (at(H) - at(-H)) / (2.0 * H);
            (0..15).for_each(|row| close(j[(row, i)], d[row], "scale"));
        }
    }

    #[test]
    fn inertial_residual_is_zero_where_the_increment_leads() {
        let (inc, w) = increment();
        let a = motion(0.7);
        assert!(inertial_residual(&inc, &w, &a, &a.propagate(&inc)).norm() < 1e-8);
    }

    #[test]
    fn weighted_inertial_jacobian_is_the_weight_times_the_plain_one() {
        let (inc, w) = increment();
        let plain = InertialWeight { increment: Mat9::identity(), bg: 1.0, ba: 1.0 };
        let (a, b) = (motion(1.0), motion(1.4));
        let ((ja, _), (pa, _)) = (inertial_jacobians(&inc, &w, &a, &b), inertial_jacobians(&inc, &plain, &a, &b));
        let expected = w.increment * pa.fixed_rows::<9>(0);
        assert!((ja.fixed_rows::<9>(0) - expected).norm() < 1e-9 * expected.norm());
        assert!((ja[(9, 9)] + 300.0).abs() < 1e-12 && (ja[(12, 12)] + 20.0).abs() < 1e-12);
    }

    #[test]
    fn huber_cost_and_weight_agree() {
        // d(cost)/d(length) = weight * length, on both sides of the width.
        for x in [0.3, 0.999, 1.001, 4.0] {
            let slope = (huber(x + H, 1.0).1 - huber(x - H, 1.0).1) / (2.0 * H);
            close(huber(x, 1.0).0 * x, slope, "huber");
        }
    }
}
