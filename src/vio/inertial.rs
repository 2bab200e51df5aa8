//! Inertial residual between two states and its derivatives, which are checked by finite differences.

use super::preintegration::{Increment, Mat9, Noise};
use crate::math::block::{block, matrix, put};
use crate::math::so3;
use glam::{DMat3, DVec3};
use nalgebra::{Matrix3, SMatrix};
use stipple_drivers::Pose;

/// Pose in the world, velocity in the world, m/s, and biases in the body, rad/s and m/s².
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

    /// Whether every number of it is finite.
    pub fn is_finite(&self) -> bool {
        self.pose.is_finite() && self.v.is_finite() && self.bg.is_finite() && self.ba.is_finite()
    }

    /// The motion after an increment.
    pub fn propagate(&self, inc: &Increment) -> Motion {
        let (p, q, v) = inc.corrected(self.bg, self.ba);
        let dt = inc.dt;
        Motion {
            pose: Pose::new(
                self.pose.q * q,
                self.pose.p + self.v * dt + inc.gravity * (0.5 * dt * dt) + self.pose.q * p,
            ),
            v: self.v + inc.gravity * dt + self.pose.q * v,
            ..*self
        }
    }
}

/// Covariance of a motion, errors [p, θ, v, bg, ba]: p and v in the world, m and m/s; θ on the right of the
/// rotation, rad; gyro bias, rad/s; accelerometer bias, m/s².
pub type Covariance = [[f64; 15]; 15];
/// Matrix over errors [p, θ, v, bg, ba].
pub type Mat15 = SMatrix<f64, 15, 15>;
/// Errors [p, θ, v, bg, ba].
pub type Vec15 = SMatrix<f64, 15, 1>;

/// Covariance, m²/s², of the velocity in the body's frame, Rᵀ v. That in the world contains the unknown yaw times the speed, which no
/// sensor observes and which makes nothing drift.
pub fn body_velocity_covariance(c: &Covariance, motion: &Motion) -> Matrix3<f64> {
    let to_body = motion.pose.rotation().transpose();
    let (d_v, d_theta) = (matrix(to_body), matrix(so3::hat(to_body * motion.v)));
    let block = |row: usize, col: usize| Matrix3::from_fn(|i, j| c[row + i][col + j]);
    let cross = d_v * block(6, 3) * d_theta.transpose();
    d_v * block(6, 6) * d_v.transpose() + d_theta * block(3, 3) * d_theta.transpose() + cross + cross.transpose()
}

/// Standard deviation of the velocity in the body's frame, m/s, all axes.
pub fn body_velocity_sigma(c: &Covariance, motion: &Motion) -> f64 {
    body_velocity_covariance(c, motion).trace().max(0.0).sqrt()
}

/// Standard deviations of a motion: position, m; tilt and yaw about world axes, rad; velocity, m/s; gyro bias,
/// rad/s; accelerometer bias, m/s².
#[derive(Clone, Copy, Debug)]
pub struct MotionSigma {
    pub p: f64,
    pub tilt: f64,
    pub yaw: f64,
    pub v: f64,
    pub bg: f64,
    pub ba: f64,
}

impl MotionSigma {
    /// Covariance of the errors of a motion that is known this well.
    pub fn covariance(&self, motion: &Motion) -> Covariance {
        let r = motion.pose.rotation();
        let mut c = [[0.0; 15]; 15];
        for i in 0..3 {
            for (at, sigma) in [(0, self.p), (6, self.v), (9, self.bg), (12, self.ba)] {
                c[at + i][at + i] = sigma * sigma;
            }
            for j in 0..3 {
                let world = [self.tilt, self.tilt, self.yaw];
                c[3 + i][3 + j] = (0..3).map(|k| r.col(i)[k] * world[k] * world[k] * r.col(j)[k]).sum();
            }
        }
        c
    }
}

/// Whitening of an inertial factor: inverse deviations of the increment [p, θ, v] and of the walks of the biases over it,
/// in inverse units of rad/s and m/s².
#[derive(Clone, Copy, Debug)]
pub struct InertialWeight {
    pub increment: Mat9,
    pub bg: f64,
    pub ba: f64,
}

impl InertialWeight {
    pub fn new(inc: &Increment, noise: &Noise) -> InertialWeight {
        let root_dt = inc.dt.sqrt();
        InertialWeight {
            // A covariance that cannot be factored says nothing; zero weight leaves the step to vision.
            increment: inc.whitening().unwrap_or_default(),
            bg: 1.0 / (noise.gyro_walk * root_dt),
            ba: 1.0 / (noise.accel_walk * root_dt),
        }
    }

    /// Whether the covariance could not be factored.
    pub fn is_nothing(&self) -> bool {
        self.increment == Mat9::zeros()
    }
}

/// Whitened residual [p, θ, v, bg, ba] between two frames.
pub fn inertial_residual(inc: &Increment, w: &InertialWeight, a: &Motion, b: &Motion) -> Vec15 {
    let dt = inc.dt;
    let (p, q, v) = inc.corrected(a.bg, a.ba);
    let to_a = a.pose.q.conjugate();
    let r_p = to_a * (b.pose.p - a.pose.p - a.v * dt - inc.gravity * (0.5 * dt * dt)) - p;
    let r_q = so3::log(q.conjugate() * to_a * b.pose.q);
    let r_v = to_a * (b.v - a.v - inc.gravity * dt) - v;
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
    set(0, 0, 3, so3::hat(to_a * (b.pose.p - a.pose.p - a.v * dt - inc.gravity * (0.5 * dt * dt))));
    set(0, 0, 6, r_to_a * -dt);
    set(0, 0, 9, -inc.d_p_bg());
    set(0, 0, 12, -inc.d_p_ba());
    set(1, 0, 0, r_to_a);
    set(0, 3, 3, -jr_inv * DMat3::from_quat(b.pose.q.conjugate() * a.pose.q));
    let d_bg = inc.d_q_bg();
    let correction = d_bg * (a.bg - inc.bg);
    set(0, 3, 9, -jr_inv * DMat3::from_quat(so3::exp(-r_q)) * so3::right_jacobian(correction) * d_bg);
    set(1, 3, 3, jr_inv);
    set(0, 6, 3, so3::hat(to_a * (b.v - a.v - inc.gravity * dt)));
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
    let correction = so3::exp(inc.d_q_bg() * (a.bg - inc.bg)).conjugate();
    let rotation = block(of_gyro, 3, 0) * gyro + block(of_accel, 3, 0) * accel;
    let carry = -so3::right_jacobian_inverse(r_q)
        * DMat3::from_quat(so3::exp(-r_q) * correction)
        * so3::right_jacobian(rotation);
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use glam::DQuat;

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

    fn increment() -> (Increment, InertialWeight) {
        let noise = Noise {
            gyro: 1e-3,
            accel: 1e-2,
            gyro_walk: 1e-4,
            accel_walk: 1e-3,
            period: 0.005,
            scale: true,
            gravity: 9.81,
        };
        let mut inc = Increment::new(DVec3::new(0.005, 0.0, -0.01), DVec3::new(0.05, -0.05, 0.1));
        for k in 0..12 {
            let t = k as f64 * 0.3;
            let sample = [DVec3::new(t.sin(), 0.7, -t.cos()), DVec3::new(1.0, t.cos(), 9.0 + t.sin())];
            inc.step_between(sample, sample, 0.005, &noise);
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

    /// Yaw in the world is ours to choose: however unknown, it says nothing of how fast the rig drifts.
    #[test]
    fn unknown_yaw_is_no_uncertainty_of_the_velocity_in_the_body() {
        let m = motion(1.0);
        let yaw = [DVec3::ZERO, m.pose.q.conjugate() * DVec3::Z, DVec3::Z.cross(m.v)];
        let mut c = [[0.0; 15]; 15];
        (0..9).for_each(|i| (0..9).for_each(|j| c[i][j] = 0.04 * yaw[i / 3][i % 3] * yaw[j / 3][j % 3]));
        assert!(c[6][6] > 1e-3 && body_velocity_covariance(&c, &m).norm() < 1e-12);
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
}
