//! Preintegration: the inertial samples between two frames summed once, as increments of position, rotation and
//! velocity in the first body frame, with their covariance and their derivatives to the biases (Forster et al.,
//! T-RO 2017).
//!
//! A step from one sample to the next is a midpoint step: the mean of both rates and forces, the force rotated by
//! the rotation at mid-step. Covariance and derivatives are those of the step as taken. `ImuRing::integrate`
//! interpolates at the ends, so that an increment covers exactly `[t0, t1]`, and crosses gaps with the noise of
//! not having measured.

use crate::config::VioConfig;
use crate::math::block::{block, put};
use crate::math::so3;
use glam::{DMat3, DQuat, DVec3};
use nalgebra::SMatrix;
use stipple_drivers::ImuCalibration;

/// Matrix over errors [p, θ, v].
pub type Mat9 = SMatrix<f64, 9, 9>;
type Mat93 = SMatrix<f64, 9, 3>;

/// Gravity of an increment that nothing was integrated into, m/s².
const GRAVITY: f64 = 9.81;
/// A step longer than this many nominal periods is a gap, and then what may have happened in it, as
/// densities: rad/s/√Hz and m/s²/√Hz of a hand-held or flying rig.
const GAP_PERIODS: f64 = 4.0;
const GAP_GYRO: f64 = 0.2;
const GAP_ACCEL: f64 = 1.0;
/// What saturated samples hide, as densities: a shock is several samples long and all of one sign.
const SATURATED_GYRO: f64 = 1.0;
const SATURATED_ACCEL: f64 = 5.0;
/// Position noise of integrating in steps, m/√s; keeps one-step increments invertible.
const POSITION_NOISE: f64 = 1e-4;

/// Noise that the estimator believes, as continuous densities: white noise of gyro and accelerometer, rad/s and m/s² per √Hz,
/// and walks of their biases, rad/s and m/s² per s and √Hz.
#[derive(Clone, Copy, Debug)]
pub struct Noise {
    pub gyro: f64,
    pub accel: f64,
    pub gyro_walk: f64,
    pub accel_walk: f64,
    /// Nominal sample period, s.
    pub period: f64,
    /// Derivatives to the scales of the axes are wanted.
    pub scale: bool,
    /// Gravity where the unit is, m/s².
    pub gravity: f64,
}

impl Noise {
    /// Figures that were measured are believed as they are. The config's scales cover what a data sheet leaves out: vibration,
    /// scale and misalignment errors.
    pub fn new(imu: &ImuCalibration, config: &VioConfig) -> Noise {
        let (gyro_scale, accel_scale) =
            if imu.measured { (1.0, 1.0) } else { (config.gyro_noise_scale, config.accel_noise_scale) };
        Noise {
            gyro: imu.gyro_noise * gyro_scale,
            accel: imu.accel_noise * accel_scale,
            gyro_walk: imu.gyro_walk,
            accel_walk: imu.accel_walk,
            period: 1.0 / imu.rate_hz,
            scale: config.estimate_imu_scale,
            gravity: config.gravity,
        }
    }

    /// Whether samples this far apart, s, have others missing between them.
    pub fn is_gap(&self, dt: f64) -> bool {
        dt > GAP_PERIODS * self.period
    }

    /// The noise of a step between two samples, by whether gyro and accelerometer were saturated at either: that of not
    /// having measured where one was.
    pub fn between(&self, a: [bool; 2], b: [bool; 2]) -> Noise {
        Noise {
            gyro: if a[0] || b[0] { SATURATED_GYRO } else { self.gyro },
            accel: if a[1] || b[1] { SATURATED_ACCEL } else { self.accel },
            ..*self
        }
    }
}

/// Increment over `dt`, s, in the body frame at its start: position, m, rotation, velocity, m/s; the rows of its covariance
/// are errors [p, θ, v].
#[derive(Clone, Copy, Debug)]
pub struct Increment {
    pub dt: f64,
    /// In the world frame, z up, m/s². No part of what was integrated.
    pub gravity: DVec3,
    pub p: DVec3,
    pub q: DQuat,
    pub v: DVec3,
    /// Biases removed while integrating.
    pub bg: DVec3,
    pub ba: DVec3,
    pub covariance: Mat9,
    /// d[p, θ, v]/d(bg), d[p, θ, v]/d(ba)
    d_bg: Mat93,
    d_ba: Mat93,
    /// d[p, θ, v]/d(scale) of the gyro's and the accelerometer's axes, zero where not wanted.
    pub d_gyro_scale: Mat93,
    pub d_accel_scale: Mat93,
}

impl Increment {
    pub fn new(bg: DVec3, ba: DVec3) -> Increment {
        Increment {
            dt: 0.0,
            gravity: DVec3::NEG_Z * GRAVITY,
            p: DVec3::ZERO,
            q: DQuat::IDENTITY,
            v: DVec3::ZERO,
            bg,
            ba,
            covariance: Mat9::zeros(),
            d_bg: Mat93::zeros(),
            d_ba: Mat93::zeros(),
            d_gyro_scale: Mat93::zeros(),
            d_accel_scale: Mat93::zeros(),
        }
    }

    /// Derivatives of p, q (on the right) and v to the biases, per rad/s and per m/s².
    pub fn d_p_bg(&self) -> DMat3 {
        block(&self.d_bg, 0, 0)
    }
    pub fn d_q_bg(&self) -> DMat3 {
        block(&self.d_bg, 3, 0)
    }
    pub fn d_v_bg(&self) -> DMat3 {
        block(&self.d_bg, 6, 0)
    }
    pub fn d_p_ba(&self) -> DMat3 {
        block(&self.d_ba, 0, 0)
    }
    pub fn d_v_ba(&self) -> DMat3 {
        block(&self.d_ba, 6, 0)
    }

    /// Increments at other biases, to first order.
    pub fn corrected(&self, bg: DVec3, ba: DVec3) -> (DVec3, DQuat, DVec3) {
        let (dg, da) = (bg - self.bg, ba - self.ba);
        (
            self.p + self.d_p_bg() * dg + self.d_p_ba() * da,
            self.q * so3::exp(self.d_q_bg() * dg),
            self.v + self.d_v_bg() * dg + self.d_v_ba() * da,
        )
    }

    /// The increments had the readings been `1 + gyro` and `1 + accel` times as large, axis by axis, to first
    /// order.
    pub fn rescaled(&self, gyro: DVec3, accel: DVec3) -> Increment {
        let part = |row: usize| block(&self.d_gyro_scale, row, 0) * gyro + block(&self.d_accel_scale, row, 0) * accel;
        Increment { p: self.p + part(0), q: self.q * so3::exp(part(3)), v: self.v + part(6), ..*self }
    }

    /// One step of `dt` between two samples of [rate, specific force].
    pub fn step_between(&mut self, first: [DVec3; 2], second: [DVec3; 2], dt: f64, noise: &Noise) {
        if !(dt > 0.0) {
            return;
        }
        let (w0, w1) = (first[0] - self.bg, second[0] - self.bg);
        let (a0, a1) = (first[1] - self.ba, second[1] - self.ba);
        // Rotation since the start of the step, at its middle and at its end.
        let (half, whole) = ((w0 * 0.25 + w1 * 0.25) * dt, (w0 * 0.5 + w1 * 0.5) * dt);
        let (to_half, to_end) = (so3::exp(half), so3::exp(whole));
        let r = DMat3::from_quat(self.q * to_half);
        let force = a0.lerp(a1, 0.5);
        let (dv, dp) = (r * force * dt, r * force * (0.5 * dt * dt));

        // Errors: rotation right-perturbed, R Exp(φ) Exp(θ') with θ' = Exp(-φ) θ + Jr(φ) dφ.
        let tilt = r * so3::hat(-force);
        let by_theta = tilt * DMat3::from_quat(to_half.conjugate());
        let mut f = Mat9::identity();
        put(&mut f, 0, 3, by_theta * (0.5 * dt * dt));
        put(&mut f, 0, 6, DMat3::IDENTITY * dt);
        put(&mut f, 3, 3, DMat3::from_quat(to_end.conjugate()));
        put(&mut f, 6, 3, by_theta * dt);
        // Derivatives to the readings of both samples, each axis by a factor a sample.
        let by_rate = tilt * so3::right_jacobian(half) * (0.25 * dt);
        let jr = so3::right_jacobian(whole);
        let of_rates = |first: DVec3, second: DVec3| {
            let (u, w) = (DMat3::from_diagonal(first), DMat3::from_diagonal(second));
            let mut g = Mat93::zeros();
            put(&mut g, 0, 0, by_rate * (0.5 * dt * dt) * u + by_rate * (0.5 * dt * dt) * w);
            put(&mut g, 3, 0, jr * (u * (0.5 * dt) + w * (0.5 * dt)));
            put(&mut g, 6, 0, by_rate * dt * u + by_rate * dt * w);
            g
        };
        let of_forces = |first: DVec3, second: DVec3| {
            let (u, w) = (DMat3::from_diagonal(first), DMat3::from_diagonal(second));
            let mut h = Mat93::zeros();
            put(&mut h, 0, 0, r * (0.25 * dt * dt) * u + r * (0.25 * dt * dt) * w);
            put(&mut h, 6, 0, r * (0.5 * dt) * u + r * (0.5 * dt) * w);
            h
        };
        let (g, h) = (of_rates(DVec3::ONE, DVec3::ONE), of_forces(DVec3::ONE, DVec3::ONE));

        let gap = noise.is_gap(dt);
        let (sg, sa) =
            if gap { (noise.gyro.max(GAP_GYRO), noise.accel.max(GAP_ACCEL)) } else { (noise.gyro, noise.accel) };
        self.covariance = f * self.covariance * f.transpose()
            + g * g.transpose() * (sg * sg / dt)
            + h * h.transpose() * (sa * sa / dt);
        (0..3).for_each(|i| self.covariance[(i, i)] += POSITION_NOISE * POSITION_NOISE * dt);
        self.d_bg = f * self.d_bg - g;
        self.d_ba = f * self.d_ba - h;
        if noise.scale {
            self.d_gyro_scale = f * self.d_gyro_scale + of_rates(first[0], second[0]);
            self.d_accel_scale = f * self.d_accel_scale + of_forces(first[1], second[1]);
        }
        self.p += self.v * dt + dp;
        self.v += dv;
        self.q = (self.q * to_end).normalize();
        self.dt += dt;
    }

    /// Inverse square root of the covariance: `‖W r‖²` is the Mahalanobis norm.
    pub fn whitening(&self) -> Option<Mat9> {
        self.covariance.cholesky()?.l().try_inverse()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::inertial::Motion;
    use super::super::samples::ImuRing;
    use super::super::world;
    use super::*;
    use stipple_drivers::{ImuSample, Nanos, Pose};

    const NOISE: Noise = Noise {
        gyro: 1e-3,
        accel: 2e-2,
        gyro_walk: 1e-4,
        accel_walk: 1e-3,
        period: 0.005,
        scale: true,
        gravity: GRAVITY,
    };
    const PATH: world::Path = world::Path { rest: -1.0 };

    fn at(t: f64) -> Nanos {
        Nanos((t * 1e9).round() as i64)
    }

    fn ring(rate: f64, t1: f64) -> ImuRing {
        let mut ring = ImuRing::new(200.0);
        for i in 0..=(t1 * rate) as usize + 1 {
            let t = i as f64 / rate;
            let (gyro_body, accel_body) = world::rate_and_force(|t| PATH.pose(t), t);
            ring.push(ImuSample { t: at(t), gyro_body, accel_body, ..ImuSample::default() });
        }
        ring
    }

    fn start(t: f64) -> Motion {
        const H: f64 = 1e-5;
        let v = (PATH.pose(t + H).p - PATH.pose(t - H).p) / (2.0 * H);
        Motion { pose: PATH.pose(t), v, ..Motion::default() }
    }

    fn error(a: &Pose, b: &Pose) -> (f64, f64) {
        ((a.p - b.p).length(), so3::log(a.q.conjugate() * b.q).length())
    }

    #[test]
    fn increment_follows_the_path_and_converges_with_the_square_of_the_rate() {
        let (t0, t1) = (0.0123, 0.2104);
        let miss = |rate: f64| {
            let inc = ring(rate, t1).integrate(at(t0), at(t1), DVec3::ZERO, DVec3::ZERO, &NOISE);
            error(&start(t0).propagate(&inc).pose, &PATH.pose(t1))
        };
        let (coarse, fine) = (miss(200.0), miss(2000.0));
        assert!(coarse.0 < 1e-4 && coarse.1 < 1e-4, "{coarse:?}");
        assert!(fine.0 < coarse.0 / 20.0 + 1e-8 && fine.1 < coarse.1 / 20.0 + 1e-8, "{coarse:?} {fine:?}");
    }

    const STEPS: usize = 12;
    const DT: f64 = 0.005;

    /// Twelve steps along the path; `change` may alter both samples of a step.
    fn walk(bg: DVec3, ba: DVec3, change: impl Fn(usize, &mut [DVec3; 2])) -> Increment {
        let sample = |k: usize| world::rate_and_force(|t| PATH.pose(t), 0.5 + k as f64 * DT);
        (0..STEPS).fold(Increment::new(bg, ba), |mut inc, k| {
            let [first, second] = [k, k + 1].map(|i| {
                let mut s = [sample(i).0, sample(i).1];
                change(k, &mut s);
                s
            });
            inc.step_between(first, second, DT, &NOISE);
            inc
        })
    }

    /// `a` over `b` in their tangent space, [p, θ, v].
    fn over(a: &Increment, b: &Increment) -> [f64; 9] {
        let th = so3::log(b.q.conjugate() * a.q);
        let (p, v) = (a.p - b.p, a.v - b.v);
        [p.x, p.y, p.z, th.x, th.y, th.z, v.x, v.y, v.z]
    }

    /// Column of a central difference about `at`.
    fn difference(at: &Increment, f: impl Fn(f64) -> Increment) -> SMatrix<f64, 9, 1> {
        const H: f64 = 1e-5;
        let (a, b) = (over(&f(H), at), over(&f(-H), at));
        SMatrix::from_fn(|i, _| (a[i] - b[i]) / (2.0 * H))
    }

    #[test]
    fn derivatives_to_biases_and_scales_match_differences() {
        let (bg, ba) = (DVec3::new(0.01, -0.02, 0.03), DVec3::new(0.1, 0.2, -0.1));
        let inc = walk(bg, ba, |_, _| {});
        for axis in 0..3 {
            let e = DVec3::AXES[axis];
            let scaled = |h: f64, what: usize| walk(bg, ba, |_, s| s[what] *= DVec3::ONE + e * h);
            let cases = [
                ("bg", &inc.d_bg, difference(&inc, |h| walk(bg + e * h, ba, |_, _| {}))),
                ("ba", &inc.d_ba, difference(&inc, |h| walk(bg, ba + e * h, |_, _| {}))),
                ("gyro scale", &inc.d_gyro_scale, difference(&inc, |h| scaled(h, 0))),
                ("accel scale", &inc.d_accel_scale, difference(&inc, |h| scaled(h, 1))),
            ];
            for (what, analytic, numeric) in cases {
                let error = (analytic.column(axis) - numeric).norm() / numeric.norm();
                assert!(error < 1e-6, "{what} {axis}: {error}");
            }
        }
        let (g, a) = (DVec3::new(0.01, -0.02, 0.01), DVec3::new(0.02, 0.01, -0.02));
        let again = walk(bg, ba, |_, s| (s[0], s[1]) = (s[0] * (DVec3::ONE + g), s[1] * (DVec3::ONE + a)));
        let left = over(&inc.rescaled(g, a), &again).iter().fold(0.0f64, |m, x| m.max(x.abs()));
        let moved = over(&inc, &again).iter().fold(0.0f64, |m, x| m.max(x.abs()));
        assert!(left < 0.02 * moved, "{left} left of {moved}");
    }

    #[test]
    fn covariance_is_the_sum_over_differences_to_every_sample() {
        let clean = walk(DVec3::ZERO, DVec3::ZERO, |_, _| {});
        let mut sum = Mat9::zeros();
        for (step, axis, what) in (0..STEPS).flat_map(|k| (0..6).map(move |i| (k, i % 3, i / 3))) {
            let sigma = [NOISE.gyro, NOISE.accel][what] / DT.sqrt();
            let noisy = |h: f64| {
                let e = DVec3::AXES[axis] * h;
                walk(DVec3::ZERO, DVec3::ZERO, |k, s| s[what] += if k == step { e } else { DVec3::ZERO })
            };
            let column = difference(&clean, noisy) * sigma;
            sum += column * column.transpose();
        }
        (0..3).for_each(|i| sum[(i, i)] += POSITION_NOISE * POSITION_NOISE * DT * STEPS as f64);
        for (i, j) in (0..9).flat_map(|i| (0..9).map(move |j| (i, j))) {
            let scale = (sum[(i, i)] * sum[(j, j)]).sqrt();
            // Position noise turned into velocity is not summed here: none is.
            assert!((sum[(i, j)] - clean.covariance[(i, j)]).abs() < 1e-5 * scale, "{i} {j}");
        }
    }

    /// Against the position a unit of 2e-3 m/s²/√Hz (EuRoC's) loses to noise over the same 50 ms.
    #[test]
    fn at_two_hundred_hertz_a_midpoint_step_loses_a_tenth_of_what_noise_does() {
        let squares = (0..40).map(|k| 0.5 + 0.0503 * k as f64).map(|t| {
            let inc = ring(200.0, t + 0.05).integrate(at(t), at(t + 0.05), DVec3::ZERO, DVec3::ZERO, &NOISE);
            let e = error(&start(t).propagate(&inc).pose, &PATH.pose(t + 0.05));
            [e.0 * e.0 / 40.0, e.1 * e.1 / 40.0]
        });
        let [moved, rotated] = squares.fold([0.0, 0.0], |a, b| [a[0] + b[0], a[1] + b[1]]).map(f64::sqrt);
        let lost = 2e-3 * 0.05f64.powf(1.5) / 3f64.sqrt();
        assert!(moved < 0.1 * lost && rotated < 2e-6, "{moved} m, {rotated} rad over 50 ms");
    }

    #[test]
    fn first_order_bias_correction_matches_integrating_again() {
        let ring = ring(200.0, 0.2);
        let (bg, ba) = (DVec3::new(0.002, -0.003, 0.001), DVec3::new(0.05, 0.02, -0.04));
        let once = ring.integrate(at(0.0), at(0.1), DVec3::ZERO, DVec3::ZERO, &NOISE);
        let (p, q, v) = once.corrected(bg, ba);
        let again = ring.integrate(at(0.0), at(0.1), bg, ba, &NOISE);
        // The corrections are of order 1e-3 (v) and 1e-4 (p, q); what is left is of second order.
        assert!((p - again.p).length() < 1e-7, "{}", (p - again.p).length());
        assert!(so3::log(q.conjugate() * again.q).length() < 1e-7);
        assert!((v - again.v).length() < 5e-6, "{}", (v - again.v).length());
    }

    #[test]
    fn covariance_matches_monte_carlo() {
        const RUNS: usize = 4000;
        const STEPS: usize = 20;
        let mut random = world::Noise(3);
        let sample = |k: usize| world::rate_and_force(|t| PATH.pose(t), 0.5 + (k as f64 + 0.5) * DT);
        let clean = (0..STEPS).fold(Increment::new(DVec3::ZERO, DVec3::ZERO), |mut inc, k| {
            inc.step_between(sample(k).into(), sample(k).into(), DT, &NOISE);
            inc
        });
        let samples: Vec<_> = (0..STEPS).map(sample).collect();
        let mut sum = Mat9::zeros();
        for _ in 0..RUNS {
            let mut inc = Increment::new(DVec3::ZERO, DVec3::ZERO);
            for (gyro, accel) in &samples {
                let gyro = *gyro + random.vector() * (NOISE.gyro / DT.sqrt());
                let sample = [gyro, *accel + random.vector() * (NOISE.accel / DT.sqrt())];
                inc.step_between(sample, sample, DT, &NOISE);
            }
            let th = so3::log(clean.q.conjugate() * inc.q);
            let (p, v) = (inc.p - clean.p, inc.v - clean.v);
            let e = nalgebra::SVector::<f64, 9>::from_row_slice(&[p.x, p.y, p.z, th.x, th.y, th.z, v.x, v.y, v.z]);
            sum += e * e.transpose() / RUNS as f64;
        }
        // The position noise is modelling error, not drawn here.
        let mut expected = clean.covariance;
        (0..3).for_each(|i| expected[(i, i)] -= POSITION_NOISE * POSITION_NOISE * DT * STEPS as f64);
        for i in 0..9 {
            for j in 0..9 {
                let scale = (expected[(i, i)] * expected[(j, j)]).sqrt();
                // 4000 runs estimate a correlation to about 1/√4000 = 0.016.
                assert!((sum[(i, j)] - expected[(i, j)]).abs() < 0.08 * scale, "{i} {j}");
            }
        }
    }

    #[test]
    fn the_allowance_for_a_data_sheet_does_not_touch_figures_that_were_measured() {
        let config = VioConfig::default();
        let of = |measured| Noise::new(&ImuCalibration { measured, ..ImuCalibration::CONSUMER }, &config);
        let (sheet, own) = (of(false), of(true));
        assert_eq!((own.gyro, own.accel), (1e-4, 1e-3));
        assert_eq!((sheet.gyro, sheet.accel), (2e-4, 8e-3));
        assert_eq!((sheet.gyro_walk, sheet.accel_walk), (own.gyro_walk, own.accel_walk));
    }

    #[test]
    fn gap_widens_the_covariance() {
        let full = ring(200.0, 0.3);
        let mut holed = ImuRing::new(200.0);
        full.iter().filter(|s| s.t < at(0.1) || s.t > at(0.2)).for_each(|s| {
            holed.push(*s);
        });
        let integrate = |r: &ImuRing| r.integrate(at(0.0), at(0.3), DVec3::ZERO, DVec3::ZERO, &NOISE);
        let (a, b) = (integrate(&full), integrate(&holed));
        assert!(b.covariance[(6, 6)] > 100.0 * a.covariance[(6, 6)]);
        assert!((a.dt - b.dt).abs() < 1e-12);
    }
}
