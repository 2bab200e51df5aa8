//! An inertial unit carried along a spline: point samples of angular velocity and specific force Rᵀ(a - g), with white
//! noise, biases that start at random and walk, and a range that clips.

use super::spline::Spline;
use crate::calibration::{ImuCalibration, ImuCorrection};
use crate::types::{ImuSample, Nanos, Span};
use glam::DVec3;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use std::f64::consts::FRAC_1_SQRT_2;

/// Gravity in the world frame, m/s².
pub const GRAVITY: DVec3 = DVec3::new(0.0, 0.0, -9.81);

/// Errors of an inertial unit that its calibration file does not state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImuErrors {
    /// Standard deviation of the gyro's biases at the start, rad/s.
    pub gyro_bias: f64,
    /// Standard deviation of the accelerometer's biases at the start, m/s².
    pub accel_bias: f64,
    /// Range of an axis of the gyro, rad/s.
    pub gyro_max: f64,
    /// Range of an axis of the accelerometer, m/s².
    pub accel_max: f64,
    /// The correction of scales and misalignments that would make the readings right.
    pub axes: ImuCorrection,
    /// Standard deviation of an axis while motors shake the unit, rad/s and m/s².
    pub shaken: [f64; 2],
}

impl ImuErrors {
    /// The ADIS16448 of EuRoC: 1000 °/s, 18 g; shaken as V1_01 on the ground with its motors on.
    pub const EUROC: ImuErrors = ImuErrors {
        gyro_bias: 0.02,
        accel_bias: 0.05,
        gyro_max: 17.453_293,
        accel_max: 18.0 * 9.81,
        axes: ImuCorrection::NONE,
        shaken: [0.06, 0.9],
    };
}

/// True biases at an instant: rad/s, m/s².
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bias {
    /// Instant by the unit's clock.
    pub t: Nanos,
    /// Bias of the gyro in the body frame, rad/s.
    pub gyro: DVec3,
    /// Bias of the accelerometer in the body frame, m/s².
    pub accel: DVec3,
}

/// Samples of a spline, whose time 0 is `start`, at `stamps`, and the biases in them. `motors`: whether they run so many
/// seconds from the start. Vibration moves the unit nowhere, so it is the difference of successive random numbers, whose
/// integral is zero.
pub fn simulate(
    spline: &Spline,
    start: Nanos,
    stamps: &[Nanos],
    noise: &ImuCalibration,
    errors: &ImuErrors,
    seed: u64,
    motors: impl Fn(f64) -> bool,
) -> (Vec<ImuSample>, Vec<Bias>) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x0049_4D55);
    let mut normal = || DVec3::from_array(std::array::from_fn(|_| rng.sample::<f64, _>(StandardNormal)));
    // A continuous-time density times the root of the rate is the deviation of one sample.
    let root_rate = noise.rate_hz.sqrt();
    let mut gyro = normal() * errors.gyro_bias;
    let mut accel = normal() * errors.accel_bias;
    let mut samples = Vec::with_capacity(stamps.len());
    let mut biases = Vec::with_capacity(stamps.len());
    let mut shaken = [DVec3::ZERO; 2];
    for &t in stamps {
        let m = spline.at((t - start).secs());
        let force = m.pose.q.conjugate() * (m.a_world - GRAVITY);
        let before = shaken;
        if motors((t - start).secs()) {
            shaken = errors.shaken.map(|sigma| normal() * (sigma * FRAC_1_SQRT_2));
        }
        let w = m.gyro_body + gyro + normal() * (noise.gyro_noise * root_rate) + shaken[0] - before[0];
        let f = force + accel + normal() * (noise.accel_noise * root_rate) + shaken[1] - before[1];
        let (w_max, f_max) = (DVec3::splat(errors.gyro_max), DVec3::splat(errors.accel_max));
        samples.push(ImuSample {
            t,
            gyro_body: w.clamp(-w_max, w_max),
            accel_body: f.clamp(-f_max, f_max),
            ..ImuSample::default()
        });
        biases.push(Bias { t, gyro, accel });
        gyro += normal() * (noise.gyro_walk / root_rate);
        accel += normal() * (noise.accel_walk / root_rate);
    }
    (samples, biases)
}

/// Biases at `t`, linear between table entries and held at the ends; zero for an empty table.
pub fn bias_at(table: &[Bias], t: Nanos) -> Bias {
    let after = table.partition_point(|b| b.t < t);
    match (after.checked_sub(1).map(|i| table[i]), table.get(after).copied()) {
        (Some(a), Some(b)) => {
            let s = (t - a.t).secs() / (b.t - a.t).secs();
            Bias { t, gyro: a.gyro.lerp(b.gyro, s), accel: a.accel.lerp(b.accel, s) }
        }
        (Some(b), None) | (None, Some(b)) => Bias { t, ..b },
        (None, None) => Bias { t, gyro: DVec3::ZERO, accel: DVec3::ZERO },
    }
}

/// Stamps of a clock of `rate_hz` from `first` up to and including `last`.
pub fn ticks(first: Nanos, last: Nanos, rate_hz: f64) -> Vec<Nanos> {
    let n = ((last - first).secs() * rate_hz + 1e-6).floor().max(0.0) as i64;
    (0..=n).map(|k| first + Span::from_secs(k as f64 / rate_hz)).collect()
}
