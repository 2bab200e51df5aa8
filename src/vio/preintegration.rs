//! Inertial samples between two frames, summed once: position, rotation and velocity increments in
//! the first body frame, their covariance, and their derivatives to the biases (Forster et al.,
//! T-RO 2017).
//!
//! Samples are interpolated at the ends so an increment covers exactly `[t0, t1]`; each step takes
//! the mean of its two samples and the rotation at mid-step. Gaps are integrated across with the
//! last samples' mean and the noise of not having measured.

use crate::config::VioConfig;
use crate::limits::IMU_BETWEEN_FRAMES;
use crate::math::so3;
use glam::{DMat3, DQuat, DVec3};
use nalgebra::SMatrix;
use stipple_drivers::{ImuCalibration, ImuSample, Nanos, Span};

pub type Mat9 = SMatrix<f64, 9, 9>;
type Mat93 = SMatrix<f64, 9, 3>;

/// World frame, z up, m/s².
pub const GRAVITY: DVec3 = DVec3::new(0.0, 0.0, -9.81);
/// A step longer than this many nominal periods is a gap, and then what may have happened in it, as
/// densities: rad/s/√Hz and m/s²/√Hz of a hand-held or flying rig.
const GAP_PERIODS: f64 = 4.0;
const GAP_GYRO: f64 = 0.2;
const GAP_ACCEL: f64 = 1.0;
/// A sample this near the end of its range is clipped, and what it hides, as densities: a shock is several
/// samples long and all of one sign.
const RANGE_FRACTION: f64 = 0.99;
const CLIPPED_GYRO: f64 = 1.0;
const CLIPPED_ACCEL: f64 = 5.0;
/// Position noise of integrating in steps, m/√s; keeps one-step increments invertible.
const POSITION_NOISE: f64 = 1e-4;

/// Continuous densities the estimator believes.
#[derive(Clone, Copy, Debug)]
pub struct Noise {
    pub gyro: f64,
    pub accel: f64,
    pub gyro_walk: f64,
    pub accel_walk: f64,
    /// Nominal sample period, s.
    pub period: f64,
    /// Ends of the sensors' ranges, rad/s and m/s².
    pub gyro_max: f64,
    pub accel_max: f64,
}

impl Noise {
    /// The config's scales cover what the data sheet does not: vibration, scale and misalignment errors.
    pub fn new(imu: &ImuCalibration, config: &VioConfig) -> Noise {
        Noise {
            gyro: imu.gyro_noise * config.gyro_noise_scale,
            accel: imu.accel_noise * config.accel_noise_scale,
            gyro_walk: imu.gyro_walk,
            accel_walk: imu.accel_walk,
            period: 1.0 / imu.rate_hz,
            gyro_max: config.gyro_max,
            accel_max: config.accel_max,
        }
    }

    /// Whether samples this far apart, s, have others missing between them.
    pub fn is_gap(&self, dt: f64) -> bool {
        dt > GAP_PERIODS * self.period
    }

    /// Whether the (gyro, accelerometer) is at the end of its range on any axis.
    pub fn clipped(&self, gyro: DVec3, accel: DVec3) -> (bool, bool) {
        let at_end = |x: DVec3, max: f64| x.abs().max_element() >= RANGE_FRACTION * max;
        (at_end(gyro, self.gyro_max), at_end(accel, self.accel_max))
    }

    /// The noise of a step between two samples: that of not having measured where one is clipped.
    fn between(&self, a: (DVec3, DVec3), b: (DVec3, DVec3)) -> Noise {
        let (first, second) = (self.clipped(a.0, a.1), self.clipped(b.0, b.1));
        Noise {
            gyro: if first.0 || second.0 { CLIPPED_GYRO } else { self.gyro },
            accel: if first.1 || second.1 { CLIPPED_ACCEL } else { self.accel },
            ..*self
        }
    }
}

/// Increment over `dt`; error order of covariance rows: [p, θ, v].
#[derive(Clone, Copy, Debug)]
pub struct Increment {
    pub dt: f64,
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
}

pub fn block(m: &Mat93, row: usize) -> DMat3 {
    DMat3::from_cols_array_2d(&std::array::from_fn(|c| std::array::from_fn(|r| m[(row + r, c)])))
}

fn put<const R: usize, const C: usize>(m: &mut SMatrix<f64, R, C>, row: usize, col: usize, x: &DMat3) {
    for c in 0..3 {
        for r in 0..3 {
            m[(row + r, col + c)] = x.col(c)[r];
        }
    }
}

impl Increment {
    pub fn new(bg: DVec3, ba: DVec3) -> Increment {
        Increment {
            dt: 0.0,
            p: DVec3::ZERO,
            q: DQuat::IDENTITY,
            v: DVec3::ZERO,
            bg,
            ba,
            covariance: Mat9::zeros(),
            d_bg: Mat93::zeros(),
            d_ba: Mat93::zeros(),
        }
    }

    pub fn d_p_bg(&self) -> DMat3 {
        block(&self.d_bg, 0)
    }
    pub fn d_q_bg(&self) -> DMat3 {
        block(&self.d_bg, 3)
    }
    pub fn d_v_bg(&self) -> DMat3 {
        block(&self.d_bg, 6)
    }
    pub fn d_p_ba(&self) -> DMat3 {
        block(&self.d_ba, 0)
    }
    pub fn d_v_ba(&self) -> DMat3 {
        block(&self.d_ba, 6)
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

    /// One step of `dt` with constant rate and specific force.
    pub fn step(&mut self, gyro: DVec3, accel: DVec3, dt: f64, noise: &Noise) {
        if !(dt > 0.0) {
            return;
        }
        let (w, a) = (gyro - self.bg, accel - self.ba);
        let half = so3::exp(w * (0.5 * dt));
        let r_half = DMat3::from_quat(self.q * half);
        let a_first = r_half * a;

        // Errors: rotation right-perturbed, so R_half Exp(θ_half), θ_half = Exp(-w dt/2) θ + Jr dt/2 n_g.
        let tilt = r_half * so3::hat(a) * -dt;
        let v_q = tilt * DMat3::from_quat(half.conjugate());
        let v_g = tilt * so3::right_jacobian(w * (0.5 * dt)) * (0.5 * dt);
        let v_a = r_half * dt;
        let full = so3::exp(w * dt);
        let mut f = Mat9::identity();
        put(&mut f, 0, 3, &(v_q * (0.5 * dt)));
        put(&mut f, 0, 6, &(DMat3::IDENTITY * dt));
        put(&mut f, 3, 3, &DMat3::from_quat(full.conjugate()));
        put(&mut f, 6, 3, &v_q);
        let mut g = Mat93::zeros();
        put(&mut g, 0, 0, &(v_g * (0.5 * dt)));
        put(&mut g, 3, 0, &(so3::right_jacobian(w * dt) * dt));
        put(&mut g, 6, 0, &v_g);
        let mut h = Mat93::zeros();
        put(&mut h, 0, 0, &(v_a * (0.5 * dt)));
        put(&mut h, 6, 0, &v_a);

        let gap = noise.is_gap(dt);
        let (sg, sa) =
            if gap { (noise.gyro.max(GAP_GYRO), noise.accel.max(GAP_ACCEL)) } else { (noise.gyro, noise.accel) };
        self.covariance = f * self.covariance * f.transpose()
            + g * g.transpose() * (sg * sg / dt)
            + h * h.transpose() * (sa * sa / dt);
        (0..3).for_each(|i| self.covariance[(i, i)] += POSITION_NOISE * POSITION_NOISE * dt);
        self.d_bg = f * self.d_bg - g;
        self.d_ba = f * self.d_ba - h;

        self.p += self.v * dt + a_first * (0.5 * dt * dt);
        self.v += a_first * dt;
        self.q = (self.q * full).normalize();
        self.dt += dt;
    }

    /// Inverse square root of the covariance: `‖W r‖²` is the Mahalanobis norm.
    pub fn whitening(&self) -> Option<Mat9> {
        self.covariance.cholesky()?.l().try_inverse()
    }
}

/// The newest samples; old ones are overwritten.
#[derive(Clone, Debug)]
pub struct ImuRing {
    samples: Vec<ImuSample>,
    /// Samples ever pushed.
    count: usize,
}

impl ImuRing {
    pub fn new() -> ImuRing {
        ImuRing { samples: vec![ImuSample::default(); IMU_BETWEEN_FRAMES], count: 0 }
    }

    pub const BYTES: usize = IMU_BETWEEN_FRAMES * size_of::<ImuSample>();

    pub fn clear(&mut self) {
        self.count = 0;
    }

    /// Returns the sample that was overwritten.
    pub fn push(&mut self, s: ImuSample) -> Option<ImuSample> {
        let at = self.count % IMU_BETWEEN_FRAMES;
        let old = (self.count >= IMU_BETWEEN_FRAMES).then(|| self.samples[at]);
        self.samples[at] = s;
        self.count += 1;
        old
    }

    fn len(&self) -> usize {
        self.count.min(IMU_BETWEEN_FRAMES)
    }

    /// `i` = 0 is the oldest kept.
    fn get(&self, i: usize) -> &ImuSample {
        &self.samples[(self.count - self.len() + i) % IMU_BETWEEN_FRAMES]
    }

    pub fn newest(&self) -> Option<&ImuSample> {
        self.len().checked_sub(1).map(|i| self.get(i))
    }

    pub fn iter(&self) -> impl Iterator<Item = &ImuSample> {
        (0..self.len()).map(|i| self.get(i))
    }

    /// First index with a stamp after `t`.
    fn after(&self, t: Nanos) -> usize {
        let (mut lo, mut hi) = (0, self.len());
        while lo < hi {
            let mid = (lo + hi) / 2;
            if self.get(mid).t <= t {
                lo = mid + 1;
            } else {
                hi = mid;
            }
        }
        lo
    }

    /// Rate and force at `t`: linear between samples, held outside them.
    fn sample_at(&self, t: Nanos) -> Option<(DVec3, DVec3)> {
        let n = self.len();
        let next = self.after(t);
        if n == 0 {
            return None;
        }
        if next == 0 || next == n {
            let s = self.get(next.min(n - 1));
            return Some((s.gyro_body, s.accel_body));
        }
        let (a, b) = (self.get(next - 1), self.get(next));
        let s = (t - a.t).secs() / (b.t - a.t).secs();
        Some((a.gyro_body.lerp(b.gyro_body, s), a.accel_body.lerp(b.accel_body, s)))
    }

    /// The increment over `[t0, t1]`. Without any sample: gravity-free rest with the noise of a gap.
    pub fn integrate(&self, t0: Nanos, t1: Nanos, bg: DVec3, ba: DVec3, noise: &Noise) -> Increment {
        let mut inc = Increment::new(bg, ba);
        let Some((mut w, mut a)) = self.sample_at(t0) else {
            inc.step(bg, ba, (t1 - t0).secs(), noise);
            return inc;
        };
        let mut t = t0;
        let mut step = |to: Nanos, w1: DVec3, a1: DVec3| {
            inc.step((w + w1) * 0.5, (a + a1) * 0.5, (to - t).secs(), &noise.between((w, a), (w1, a1)));
            (t, w, a) = (to, w1, a1);
        };
        for i in self.after(t0)..self.after(t1) {
            let s = self.get(i);
            step(s.t, s.gyro_body, s.accel_body);
        }
        if let Some((w1, a1)) = self.sample_at(t1) {
            step(t1, w1, a1);
        }
        inc
    }

    /// Mean and standard deviation (norm over axes) of the last `span`, when it is covered.
    pub fn statistics(&self, until: Nanos, span: Span) -> Option<Statistics> {
        let (from, to) = (self.after(until - span), self.after(until));
        let n = to - from;
        if n < 10 || (self.get(to - 1).t - self.get(from).t).secs() < 0.9 * span.secs() {
            return None;
        }
        let scale = 1.0 / n as f64;
        let mean = |f: &dyn Fn(&ImuSample) -> DVec3| {
            (from..to).map(|i| f(self.get(i))).fold(DVec3::ZERO, |a, b| a + b) * scale
        };
        let gyro = mean(&|s| s.gyro_body);
        let accel = mean(&|s| s.accel_body);
        let spread = |f: &dyn Fn(&ImuSample) -> DVec3, m: DVec3| {
            ((from..to).map(|i| (f(self.get(i)) - m).length_squared()).sum::<f64>() * scale).sqrt()
        };
        Some(Statistics {
            gyro,
            accel,
            gyro_sigma: spread(&|s| s.gyro_body, gyro),
            accel_sigma: spread(&|s| s.accel_body, accel),
        })
    }
}

impl Default for ImuRing {
    fn default() -> Self {
        ImuRing::new()
    }
}

#[derive(Clone, Copy, Debug)]
pub struct Statistics {
    pub gyro: DVec3,
    pub accel: DVec3,
    pub gyro_sigma: f64,
    pub accel_sigma: f64,
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::residuals::Motion;
    use super::super::world;
    use super::*;
    use stipple_drivers::Pose;

    const NOISE: Noise = Noise {
        gyro: 1e-3,
        accel: 2e-2,
        gyro_walk: 1e-4,
        accel_walk: 1e-3,
        period: 0.005,
        gyro_max: 35.0,
        accel_max: 160.0,
    };
    const PATH: world::Path = world::Path { rest: -1.0 };

    fn at(t: f64) -> Nanos {
        Nanos((t * 1e9).round() as i64)
    }

    fn ring(rate: f64, t1: f64) -> ImuRing {
        let mut ring = ImuRing::new();
        for i in 0..=(t1 * rate) as usize + 1 {
            let t = i as f64 / rate;
            let (gyro_body, accel_body) = world::rate_and_force(|t| PATH.pose(t), t);
            ring.push(ImuSample { t: at(t), gyro_body, accel_body });
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
        const DT: f64 = 0.005;
        let mut random = world::Noise(3);
        let sample = |k: usize| world::rate_and_force(|t| PATH.pose(t), 0.5 + (k as f64 + 0.5) * DT);
        let clean = (0..STEPS).fold(Increment::new(DVec3::ZERO, DVec3::ZERO), |mut inc, k| {
            inc.step(sample(k).0, sample(k).1, DT, &NOISE);
            inc
        });
        let samples: Vec<_> = (0..STEPS).map(sample).collect();
        let mut sum = Mat9::zeros();
        for _ in 0..RUNS {
            let mut inc = Increment::new(DVec3::ZERO, DVec3::ZERO);
            for (gyro, accel) in &samples {
                let gyro = *gyro + random.vector() * (NOISE.gyro / DT.sqrt());
                inc.step(gyro, *accel + random.vector() * (NOISE.accel / DT.sqrt()), DT, &NOISE);
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
    fn gap_widens_the_covariance() {
        let full = ring(200.0, 0.3);
        let mut holed = ImuRing::new();
        full.iter().filter(|s| s.t < at(0.1) || s.t > at(0.2)).for_each(|s| {
            holed.push(*s);
        });
        let integrate = |r: &ImuRing| r.integrate(at(0.0), at(0.3), DVec3::ZERO, DVec3::ZERO, &NOISE);
        let (a, b) = (integrate(&full), integrate(&holed));
        assert!(b.covariance[(6, 6)] > 100.0 * a.covariance[(6, 6)]);
        assert!((a.dt - b.dt).abs() < 1e-12);
    }

    #[test]
    fn ring_keeps_the_newest_and_gives_back_what_it_overwrote() {
        let mut ring = ImuRing::new();
        let sample = |i: usize| ImuSample { t: Nanos(i as i64), ..ImuSample::default() };
        for i in 0..IMU_BETWEEN_FRAMES {
            assert!(ring.push(sample(i)).is_none());
        }
        assert_eq!(ring.push(sample(IMU_BETWEEN_FRAMES)).map(|s| s.t), Some(Nanos(0)));
        assert_eq!(ring.iter().next().map(|s| s.t), Some(Nanos(1)));
        assert_eq!(ring.iter().count(), IMU_BETWEEN_FRAMES);
    }
}
