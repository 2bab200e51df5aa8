//! Whether a log is that of a unit at rest, read without a gap at the rate that is stated: decided from sums over each second,
//! in fixed memory.

use super::allan::{fit, Noise, Octaves};
use glam::DVec3;
use stipple_drivers::{ImuSample, Nanos, Span};

/// A step from sample to sample of more periods is a gap.
const GAP_PERIODS: f64 = 1.5;
/// Largest difference between the rate measured and the one stated: more than the clock of any unit is off.
const RATE_TOLERANCE: f64 = 0.05;
/// Least length, s: white noise is then known to a few hundredths.
const SECS_MIN: f64 = 300.0;
/// Largest steps between the means of successive seconds at rest, rad/s and m/s²: five times and more those of a unit of
/// 2.4e-4 rad/s/√Hz and 3e-3 m/s²/√Hz, the noisiest that flies.
const STEP_MAX: [f64; 2] = [0.02, 0.1];
/// Largest step between the means of successive seconds, and largest deviation within a second, in medians of the log's own:
/// a tenth of a second's jolt, or one sample that is wrong by fifty deviations. Over a day noise alone comes to 8 and 1.4.
const STEPS_MAX: f64 = 15.0;
const DEVIATIONS_MAX: f64 = 3.0;

pub const SENSORS: [(&str, &str); 2] = [("gyro", "rad/s"), ("accelerometer", "m/s²")];

/// Magnitudes, counted by quarters of an octave, and the largest.
struct Spread {
    counts: [u32; Spread::BINS],
    most: f64,
    most_at: Nanos,
}

impl Spread {
    const BINS: usize = 256;
    /// Binary logarithm of the least magnitude that is told from zero.
    const LEAST: f64 = -44.0;

    fn new() -> Spread {
        Spread { counts: [0; Spread::BINS], most: 0.0, most_at: Nanos(0) }
    }

    fn add(&mut self, x: f64, at: Nanos) {
        let bin = ((x.log2() - Spread::LEAST) * 4.0).clamp(0.0, (Spread::BINS - 1) as f64);
        self.counts[bin as usize] += 1;
        if x > self.most {
            (self.most, self.most_at) = (x, at);
        }
    }

    /// The median, to a tenth of it; 0 where it is not told from zero.
    fn median(&self) -> f64 {
        let half = self.counts.iter().sum::<u32>().div_ceil(2);
        let mut sum = 0;
        let reaches = |n: &u32| {
            sum += n;
            sum >= half
        };
        match self.counts.iter().position(reaches) {
            Some(bin) if bin > 0 => ((bin as f64 + 0.5) / 4.0 + Spread::LEAST).exp2(),
            _ => 0.0,
        }
    }
}

/// A sensor second by second.
struct Seconds {
    sum: DVec3,
    squares: DVec3,
    /// First sample of the second: sums are about it.
    origin: DVec3,
    mean: Option<DVec3>,
    steps: [Spread; 3],
    deviations: [Spread; 3],
    octaves: Octaves,
}

impl Seconds {
    fn new() -> Seconds {
        let spreads = || std::array::from_fn(|_| Spread::new());
        let (zero, octaves) = (DVec3::ZERO, Octaves::default());
        Seconds { sum: zero, squares: zero, origin: zero, mean: None, steps: spreads(), deviations: spreads(), octaves }
    }

    fn add(&mut self, value: DVec3, first: bool) {
        self.octaves.add(value);
        if first {
            (self.origin, self.sum, self.squares) = (value, DVec3::ZERO, DVec3::ZERO);
        }
        let d = value - self.origin;
        (self.sum, self.squares) = (self.sum + d, self.squares + d * d);
    }

    /// Ends a second of `n` samples.
    fn end(&mut self, n: f64, at: Nanos) {
        let mean = self.sum / n;
        let variance = (self.squares / n - mean * mean).max(DVec3::ZERO);
        let mean = self.origin + mean;
        let step = self.mean.replace(mean).map(|before| (mean - before).abs());
        for axis in 0..3 {
            self.deviations[axis].add(variance[axis].sqrt(), at);
            step.iter().for_each(|step| self.steps[axis].add(step[axis], at));
        }
    }
}

/// A log as it is read.
pub struct Rest {
    stated_hz: f64,
    first: Nanos,
    last: Nanos,
    pub samples: u64,
    /// Steps of too many periods, the first of them, and steps that are none.
    gaps: u64,
    first_gap: Option<(Nanos, Span)>,
    backward: u64,
    sensors: [Seconds; 2],
    in_second: u64,
}

impl Rest {
    pub fn new() -> Rest {
        let sensors = [Seconds::new(), Seconds::new()];
        let (first, last) = (Nanos(0), Nanos(0));
        Rest { stated_hz: 0.0, first, last, samples: 0, gaps: 0, first_gap: None, backward: 0, sensors, in_second: 0 }
    }

    pub fn add(&mut self, stated_hz: f64, s: &ImuSample) {
        if self.samples == 0 {
            (self.first, self.stated_hz) = (s.t, stated_hz);
        } else {
            let step = s.t - self.last;
            self.backward += u64::from(step.0 <= 0);
            if step.secs() * stated_hz > GAP_PERIODS {
                self.gaps += 1;
                self.first_gap.get_or_insert((s.t, step));
            }
        }
        (self.last, self.samples) = (s.t, self.samples + 1);
        let first = self.in_second == 0;
        self.sensors[0].add(s.gyro_body, first);
        self.sensors[1].add(s.accel_body, first);
        self.in_second += 1;
        if self.in_second as f64 >= stated_hz {
            self.sensors.iter_mut().for_each(|seconds| seconds.end(self.in_second as f64, s.t));
            self.in_second = 0;
        }
    }

    pub fn secs(&self) -> f64 {
        (self.last - self.first).secs()
    }

    /// The rate that the stamps tell, Hz.
    pub fn rate_hz(&self) -> f64 {
        self.samples.saturating_sub(1) as f64 / self.secs()
    }

    /// What is wrong with the log, and what to do; nothing where it is that of a unit at rest.
    pub fn wrong(&self) -> Option<(String, String)> {
        let (secs, rate, stated) = (self.secs(), self.rate_hz(), self.stated_hz);
        let again = || "record again at rest, with nothing else on the board".to_string();
        let after = |t: Nanos| format!("{:.1} s after its start", (t - self.first).secs());
        if self.backward > 0 {
            return Some((format!("{} of its stamps are not newer than the one before", self.backward), again()));
        }
        if secs < SECS_MIN {
            let what = format!("is too short: {secs:.1} s, and {SECS_MIN} s at rest are the least");
            let fix =
                "white noise takes 5 minutes, a walk or an instability of the bias an hour to a night: record longer";
            return Some((what, fix.into()));
        }
        if (rate / stated - 1.0).abs() > RATE_TOLERANCE && (self.gaps == 0 || 2 * self.gaps > self.samples) {
            let what = format!("has {rate:.2} samples a second, and its calibration states {stated}");
            return Some((what, "state the unit's rate (rate_hz or update_rate), or record at that rate".into()));
        }
        if let Some((t, step)) = self.first_gap {
            let missing = format!("the first of {:.4} s, {}", step.secs(), after(t));
            return Some((format!("has {} gaps between samples, {missing}", self.gaps), again()));
        }
        let axes = SENSORS.into_iter().zip(&self.sensors).zip(STEP_MAX);
        let axes = axes.flat_map(|((names, s), most)| (0..3).map(move |i| (names, s, i, most)));
        for ((sensor, unit), seconds, i, most) in axes {
            let (steps, deviations, axis) = (&seconds.steps[i], &seconds.deviations[i], ["x", "y", "z"][i]);
            if deviations.median() == 0.0 {
                let what =
                    format!("{sensor} {axis} does not change: its driver has stopped, or its steps are too coarse");
                return Some((what, "check the unit, or take a smaller range".into()));
            }
            let (step, own) = (steps.most, steps.median());
            if step > most || step > STEPS_MAX * own {
                let what =
                    format!("moves, or has a wrong sample: {sensor} {axis} changes by {step:.1e} {unit} in a second");
                let at = after(steps.most_at);
                return Some((format!("{what}, {at} (its median is {own:.1e}, {most} the most at rest)"), again()));
            }
            if deviations.most > DEVIATIONS_MAX * deviations.median() {
                let (d, own, at) = (deviations.most, deviations.median(), after(deviations.most_at));
                let what = format!(
                    "is knocked, or has a wrong sample: {sensor} {axis} deviates by {d:.1e} {unit} within a second"
                );
                return Some((format!("{what}, {at} (its median is {own:.1e})"), again()));
            }
        }
        None
    }

    /// The noise of gyro and accelerometer; `None` of too short a log.
    pub fn noise(&self) -> Option<[Noise; 2]> {
        let of = |seconds: &Seconds| fit(&seconds.octaves, 1.0 / self.rate_hz());
        Some([of(&self.sensors[0])?, of(&self.sensors[1])?])
    }
}
