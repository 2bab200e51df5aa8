//! Allan variance of three axes in fixed memory, and the noise that explains it.
//!
//! Averages over 1, 2, 4 .. samples are kept by octaves. Half the mean square of the difference of two neighbouring averages
//! over a time τ is the Allan variance; pairs do not overlap, so that those of one octave are independent. A sensor of white
//! noise N (its angle or velocity random walk), bias instability B and random walk of the bias K has
//!
//! ```text
//! σ²(τ) = N²/τ + (2 ln 2/π) B² + K²τ/3
//! ```
//!
//! (IEEE Std 952), which is linear in N², B² and K²: they are fitted by least squares, weighted by the variance that the fit
//! itself predicts of each octave, none of them below zero. Octaves under `FITTED_MIN` are left out: there a unit's low-pass
//! filter has taken white noise away. Differences are taken about their mean, which takes a steady drift (of temperature) out.

use glam::DVec3;
use nalgebra::{Matrix3, Vector3};
use std::f64::consts::{LN_2, PI};

/// Octaves kept: 2^40 samples are more than any log has.
const OCTAVES: usize = 40;
/// Shortest average that is fitted, s.
const FITTED_MIN: f64 = 0.1;
/// Fewest pairs of averages that say anything.
const PAIRS_MIN: u64 = 4;
/// Rounds of the fit, whose weights follow from the round before.
const ROUNDS: usize = 50;

#[derive(Clone, Copy, Default)]
struct Octave {
    /// The first average of a pair.
    first: Option<DVec3>,
    pairs: u64,
    sum: DVec3,
    squares: DVec3,
}

/// Sums of differences of neighbouring averages, octave by octave.
#[derive(Clone)]
pub struct Octaves([Octave; OCTAVES]);

impl Default for Octaves {
    fn default() -> Octaves {
        Octaves([Octave::default(); OCTAVES])
    }
}

impl Octaves {
    pub fn add(&mut self, value: DVec3) {
        let mut average = value;
        for octave in &mut self.0 {
            let Some(first) = octave.first.take() else {
                octave.first = Some(average);
                return;
            };
            let d = average - first;
            (octave.pairs, octave.sum, octave.squares) = (octave.pairs + 1, octave.sum + d, octave.squares + d * d);
            average = 0.5 * (first + average);
        }
    }

    /// The Allan variances that are fitted, of samples `period` s apart, means of the three axes.
    fn variances(&self, period: f64) -> Vec<(Step, f64)> {
        let fitted = self.0.iter().enumerate().filter_map(|(k, o)| {
            let step = Step::of(k, o.pairs, period)?;
            let about_mean = o.squares - o.sum * o.sum / o.pairs as f64;
            Some((step, about_mean.element_sum() / (2.0 * step.freedom)))
        });
        fitted.collect()
    }
}

/// An octave in the fit.
#[derive(Clone, Copy)]
struct Step {
    /// Samples of an average, and s.
    samples: f64,
    tau: f64,
    /// Independent differences of the three axes, less their means.
    freedom: f64,
}

impl Step {
    fn of(octave: usize, pairs: u64, period: f64) -> Option<Step> {
        let samples = (1u64 << octave) as f64;
        let step = Step { samples, tau: samples * period, freedom: 3.0 * pairs.saturating_sub(1) as f64 };
        (step.tau >= FITTED_MIN && pairs >= PAIRS_MIN).then_some(step)
    }

    /// The octaves of a log of so many seconds.
    fn all(secs: f64, period: f64) -> Vec<Step> {
        let pairs = |k: usize| (secs / (2.0 * period * (1u64 << k) as f64)) as u64;
        (0..OCTAVES).filter_map(|k| Step::of(k, pairs(k), period)).collect()
    }

    /// Derivatives of the variance to N², B² and K²; the last is that of a bias that steps from sample to sample.
    fn model(&self) -> Vector3<f64> {
        let walk = (2.0 * self.samples * self.samples + 1.0) / (6.0 * self.samples * self.samples) * self.tau;
        Vector3::new(1.0 / self.tau, 2.0 * LN_2 / PI, walk)
    }
}

/// Covariance of the variances of two octaves, `short` the shorter: of white noise they are independent, of a walk not.
fn covariance(short: &Step, long: &Step, power: &Vector3<f64>) -> f64 {
    if short.samples == long.samples {
        return 2.0 * short.model().dot(power).powi(2) / short.freedom;
    }
    // A difference weights the walk's steps by a triangle; the short ones lie side by side under the long one.
    let half = long.samples / short.samples / 2.0;
    (power[2] * short.tau).powi(2) * (4.0 * half * half - 1.0) / (6.0 * half) / (2.0 * short.freedom)
}

/// Weighted least squares: a column a step, which times the variances gives N², B² and K² of those that are `free`.
fn solution(steps: &[Step], power: &Vector3<f64>, free: [bool; 3]) -> Option<Vec<Vector3<f64>>> {
    let mut normal = Matrix3::zeros();
    let mut weighted: Vec<Vector3<f64>> = Vec::with_capacity(steps.len());
    for step in steps {
        let model = Vector3::from_fn(|i, _| if free[i] { step.model()[i] } else { 0.0 });
        let row = model / covariance(step, step, power);
        normal += row * model.transpose();
        weighted.push(row);
    }
    (0..3).filter(|i| !free[*i]).for_each(|i| normal[(i, i)] = 1.0);
    // Scaled to ones on the diagonal: N² and K² are decades apart.
    let scale = Vector3::from_fn(|i, _| normal[(i, i)].sqrt().recip());
    let scaled = Matrix3::from_fn(|i, j| normal[(i, j)] * scale[i] * scale[j]).cholesky()?;
    Some(weighted.iter().map(|w| scaled.solve(&w.component_mul(&scale)).component_mul(&scale)).collect())
}

/// Standard errors of N², B² and K² where these are true; `None` of too short a log.
fn errors(steps: &[Step], power: &Vector3<f64>) -> Option<Vector3<f64>> {
    let columns = solution(steps, power, [true; 3])?;
    let mut sum = Vector3::zeros();
    for (i, (a, x)) in steps.iter().zip(&columns).enumerate() {
        for (j, (b, y)) in steps.iter().zip(&columns).enumerate() {
            let c = if i < j { covariance(a, b, power) } else { covariance(b, a, power) };
            sum += x.component_mul(y) * c;
        }
    }
    Some(sum.map(f64::sqrt))
}

/// One figure of a sensor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Figure {
    /// The value and its standard error; where it is not determined the most it can be (95 %).
    pub value: f64,
    pub sigma: Option<f64>,
    /// Length of log that determines it, s: where it is not determined, if it is half the most that it can be.
    pub needs: f64,
}

/// White noise, bias instability and random walk of a sensor, in its unit: 1/√Hz, itself, 1/s/√Hz.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Noise {
    pub white: Figure,
    pub instability: Figure,
    pub walk: Figure,
}

/// Least ratio of a power to its standard error for the figure to be determined: its root is then known to a quarter.
const DETERMINED: f64 = 2.0;
/// Longest log that is asked for, s: a month.
const LENGTH_MAX: f64 = 2.6e6;

/// Fits the noise of samples `period` s apart; `None` of too short a log.
pub fn fit(octaves: &Octaves, period: f64) -> Option<Noise> {
    let (steps, variances): (Vec<Step>, Vec<f64>) = octaves.variances(period).into_iter().unzip();
    let first = steps.first()?;
    let mut power = Vector3::new(variances[0] * first.tau, 0.0, 0.0);
    for _ in 0..ROUNDS {
        let mut free = [true; 3];
        power = loop {
            let columns = solution(&steps, &power, free)?;
            let found: Vector3<f64> = columns.iter().zip(&variances).map(|(c, v)| c * *v).sum();
            let found = Vector3::from_fn(|i, _| if free[i] { found[i] } else { 0.0 });
            // White noise there always is.
            match (1..3).filter(|i| found[*i] < 0.0).min_by(|i, j| found[*i].total_cmp(&found[*j])) {
                Some(negative) => free[negative] = false,
                None => break found,
            }
        };
    }
    let errors = errors(&steps, &power)?;
    let secs = octaves.0[0].pairs as f64 * 2.0 * period;
    let figure = |i: usize| {
        let (p, error) = (power[i], errors[i]);
        if p >= DETERMINED * error {
            let sigma = Some(error / (2.0 * p.sqrt()));
            return Figure { value: p.sqrt(), sigma, needs: secs };
        }
        let most = p + 2.0 * error;
        let mut half = power;
        half[i] = most / 4.0;
        Figure { value: most.sqrt(), sigma: None, needs: length(&half, i, secs, period) }
    };
    Some(Noise { white: figure(0), instability: figure(1), walk: figure(2) })
}

/// Length of log that determines a figure of this noise, s, `secs` or more, to a quarter.
fn length(power: &Vector3<f64>, which: usize, secs: f64, period: f64) -> f64 {
    let mut length = secs;
    let determined =
        |length| errors(&Step::all(length, period), power).is_some_and(|e| power[which] >= DETERMINED * e[which]);
    while length < LENGTH_MAX && !determined(length) {
        length *= 1.25;
    }
    length
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::Noise as Random;

    const RATE: f64 = 200.0;

    /// A resting sensor of `secs` s with white noise, bias instability left out, and a walk of its bias.
    fn rested(white: f64, walk: f64, secs: f64, seed: u64) -> Octaves {
        let (mut random, mut bias, mut octaves) = (Random(seed), DVec3::new(0.01, -0.02, 9.8), Octaves::default());
        for _ in 0..(secs * RATE) as usize {
            bias += random.vector() * (walk / RATE.sqrt());
            octaves.add(bias + random.vector() * (white * RATE.sqrt()));
        }
        octaves
    }

    /// EuRoC's unit, and one whose walk shows after ten minutes only. The bound of the walks is three of the standard errors
    /// that the fit states, and these are as large as the errors are.
    #[test]
    fn noise_and_walks_of_simulated_units_are_recovered_within_their_stated_errors() {
        for (white, walk, secs) in [(1.7e-4, 2e-5, 3600.0), (2e-3, 3e-3, 1800.0), (2e-3, 2e-5, 10_800.0)] {
            let (mut square, runs) = ([0.0; 2], 6);
            for seed in 0..runs {
                let noise = fit(&rested(white, walk, secs, seed), 1.0 / RATE).expect("long enough");
                assert!((noise.white.value / white - 1.0).abs() < 0.1, "{noise:?} of {white}");
                for (i, (figure, truth)) in [(noise.white, white), (noise.walk, walk)].into_iter().enumerate() {
                    let Some(sigma) = figure.sigma else {
                        assert!(figure.value > truth && i == 1, "{noise:?} of {walk}");
                        continue;
                    };
                    let off = (figure.value - truth) / sigma;
                    square[i] += off * off / runs as f64;
                    assert!(off.abs() < 3.5 && sigma < 0.25 * figure.value, "{noise:?} of {white} {walk}");
                }
            }
            eprintln!("{white} {walk}: errors {square:?} of the variance stated");
            assert!(square[0] < 2.5 && square[1] < 2.5, "{square:?}");
        }
    }

    /// A day's warming of the unit is no walk.
    #[test]
    fn a_steady_drift_is_no_walk() {
        let (mut random, mut octaves) = (Random(1), Octaves::default());
        for k in 0..720_000 {
            octaves.add(DVec3::splat(1e-8 * k as f64) + random.vector() * (2e-4 * RATE.sqrt()));
        }
        let noise = fit(&octaves, 1.0 / RATE).expect("long enough");
        assert!(noise.walk.sigma.is_none() && noise.walk.value < 2e-6, "{noise:?}");
    }

    #[test]
    fn a_walk_that_the_log_is_too_short_to_show_is_bounded_and_the_length_that_shows_it_is_told() {
        let short = fit(&rested(2e-3, 2e-5, 300.0, 3), 1.0 / RATE).expect("long enough for its noise");
        assert!(short.white.sigma.is_some() && short.walk.sigma.is_none(), "{short:?}");
        assert!(short.walk.value > 2e-5 && short.walk.needs > 600.0, "{short:?}");
        // A walk of half the bound is found by a log of that length.
        let (walk, secs) = (short.walk.value / 2.0, short.walk.needs);
        let long = fit(&rested(2e-3, walk, secs, 4), 1.0 / RATE).expect("longer");
        assert!((long.walk.value / walk - 1.0).abs() < 0.75, "{long:?} of {walk}");
        assert_eq!(fit(&rested(2e-3, 2e-5, 0.5, 3), 1.0 / RATE), None);
    }
}
