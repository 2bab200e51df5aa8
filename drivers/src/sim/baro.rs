//! A barometer carried along a spline: pressure of the standard atmosphere, with white noise and a drift that walks.

use super::spline::Spline;
use crate::source::{Aid, AidReading};
use crate::types::Nanos;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

/// Readings a second.
pub const RATE_HZ: f64 = 50.0;
/// Standard deviations of a reading and of the drift in ten minutes, m.
const NOISE: f64 = 0.03;
const DRIFT: f64 = 1.0;
/// Altitude of the room's floor, m.
const GROUND: f64 = 250.0;

/// Readings of a spline, whose time 0 is `start`, at `stamps`.
pub fn simulate(spline: &Spline, start: Nanos, stamps: &[Nanos], seed: u64) -> Vec<AidReading> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x4241_524F);
    let (mut drift, step) = (0.0, DRIFT * (1.0 / RATE_HZ / 600.0).sqrt());
    let reading = |&t: &Nanos| {
        let [white, walk] = [(); 2].map(|()| rng.sample::<f64, _>(StandardNormal));
        drift += walk * step;
        let altitude = GROUND + spline.at((t - start).secs()).pose.p.z + drift + white * NOISE;
        AidReading { t, value: Aid::Pressure(pressure(altitude)) }
    };
    stamps.iter().map(reading).collect()
}

/// Pressure of the standard atmosphere (ISO 2533) at an altitude in m, Pa.
fn pressure(altitude: f64) -> f64 {
    101_325.0 * (1.0 - altitude * 0.0065 / 288.15).powf(9.80665 / (287.052_87 * 0.0065))
}
