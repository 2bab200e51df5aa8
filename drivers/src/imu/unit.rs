//! A die's bursts into readings: stamped, in SI, with what is wrong with them.

use super::bus::Bus;
use super::chips::{self, TemperatureFrom};
use super::counters::ImuCounters;
use super::die::{Die, Trouble};
use super::edges::EdgeQueue;
use super::frames::Raw;
use super::merge::Reading;
use super::timeline::Timeline;
use crate::source::IMU_BATCH;
use crate::types::{Nanos, Span};
use glam::DVec3;

/// Standard gravity, m/s² a g.
pub const GRAVITY: f64 = 9.80665;
/// How often a temperature that does not ride in the frames is asked for.
const TEMPERATURE_EVERY: Span = Span(1_000_000_000);
/// Counts this near the end of 16 bits, or of the range where that ends before, are clipped: 0.2 %.
const SATURATED: f64 = 0.998;
/// Between samples further apart than this many periods some are missing.
pub const GAP: f64 = 1.5;

/// Counts of one sensor into SI, and whether they move.
struct Axes {
    name: &'static str,
    si_per_lsb: f64,
    saturated_from: f64,
    last: Option<[i16; 3]>,
    /// How often `last` came again.
    repeats: u32,
    moved: bool,
}

impl Axes {
    fn new(name: &'static str, si: f64, (full, per_lsb): (f64, f64)) -> Axes {
        let saturated_from = SATURATED * (full / per_lsb).min(f64::from(i16::MAX));
        Axes { name, si_per_lsb: per_lsb * si, saturated_from, last: None, repeats: 0, moved: false }
    }

    fn forget(&mut self) {
        (self.last, self.repeats, self.moved) = (None, 0, false);
    }

    fn take(&mut self, raw: [i16; 3], saturated: &mut bool) -> DVec3 {
        let again = self.last == Some(raw);
        self.moved |= self.last.is_some() && !again;
        self.repeats = if again { self.repeats.saturating_add(1) } else { 0 };
        self.last = Some(raw);
        let counts = raw.map(f64::from);
        *saturated |= counts.iter().any(|c| c.abs() >= self.saturated_from);
        DVec3::from(counts) * self.si_per_lsb
    }
}

pub struct Unit<B: Bus> {
    pub die: Die<B>,
    pub line: Timeline,
    accel: Option<Axes>,
    gyro: Option<Axes>,
    /// Values in a row that are the same to the bit and no coincidence; 0: never.
    frozen_samples: u32,
    raws: Vec<Raw>,
    edges: Vec<Option<Nanos>>,
    last: Option<Nanos>,
    temperature_c: Option<f32>,
    temperature_due: Nanos,
}

impl<B: Bus> Unit<B> {
    pub fn new(die: Die<B>, setting: &chips::Setting, rate_hz: f64, frozen_samples: u32) -> Unit<B> {
        let axes = |name, si, sense: &Option<chips::Sense>, code| {
            sense.as_ref().map(|sense: &chips::Sense| Axes::new(name, si, sense.range(code)))
        };
        Unit {
            accel: axes("accelerometer", GRAVITY, &die.chip.accel, setting.accel),
            gyro: axes("gyro", 1f64.to_radians(), &die.chip.gyro, setting.gyro),
            line: Timeline::new(Span::from_secs(1.0 / rate_hz)),
            frozen_samples,
            raws: Vec::with_capacity(die.chip.fifo.capacity / die.chip.fifo.layout.frame() + 1),
            edges: Vec::with_capacity(2 * IMU_BATCH),
            last: None,
            temperature_c: None,
            temperature_due: Nanos::MIN,
            die,
        }
    }

    pub fn start(&mut self) -> Result<(), Trouble> {
        self.die.start()?;
        self.line.lose();
        [&mut self.accel, &mut self.gyro].into_iter().flatten().for_each(Axes::forget);
        Ok(())
    }

    /// Whether every sensor has given two values that differ since the start.
    pub fn is_alive(&self) -> bool {
        [&self.accel, &self.gyro].into_iter().flatten().all(|a| a.moved)
    }

    /// Reads what there is; answers how many samples. Where edges are given they stamp the samples.
    pub fn collect(
        &mut self,
        edges: Option<&mut EdgeQueue>,
        counters: &mut ImuCounters,
        mut give: impl FnMut(Reading),
    ) -> Result<usize, Trouble> {
        self.raws.clear();
        let burst = match self.die.burst(&mut self.raws) {
            Ok(burst) => burst,
            Err(trouble) => {
                if trouble == Trouble::Overflow {
                    self.line.lose();
                    edges.into_iter().for_each(EdgeQueue::clear);
                }
                return Err(trouble);
            }
        };
        counters.imu_samples_skipped += burst.parsed.skipped as u64;
        counters.imu_frames_invalid += burst.parsed.invalid as u64;
        if burst.parsed.skipped > 0 {
            self.line.lose();
        }
        let n = self.raws.len();
        self.edges.clear();
        match edges {
            Some(edges) => edges.pair(n, burst.before, self.line.period(), &mut self.edges),
            None => self.edges.resize(n, None),
        }
        let newest = self.edges.last().copied().flatten();
        if !self.line.advance(n, burst.before, burst.after, newest) {
            counters.imu_clock_slips += 1;
        }
        for i in 0..n {
            let t = self.line.stamp(n - 1 - i, burst.after, self.edges[i]);
            self.count_gap(t, counters);
            let reading = self.reading(t, self.raws[i]);
            counters.imu_saturated += u64::from(reading.saturated);
            give(reading);
        }
        if n > 0 {
            self.ask_temperature(burst.after, counters);
            self.check_frozen()?;
        }
        Ok(n)
    }

    fn count_gap(&mut self, t: Nanos, counters: &mut ImuCounters) {
        let period = self.line.period().0 as f64;
        let periods = self.last.map_or(1.0, |last| (t - last).0 as f64 / period);
        if periods > GAP {
            counters.imu_gaps += 1;
            counters.imu_samples_missing += (periods.round() - 1.0).max(1.0) as u64;
        }
        self.last = Some(t);
    }

    fn reading(&mut self, t: Nanos, raw: Raw) -> Reading {
        let mut saturated = false;
        let gyro = self.gyro.as_mut().zip(raw.gyro).map(|(axes, raw)| axes.take(raw, &mut saturated));
        let accel = self.accel.as_mut().zip(raw.accel).map(|(axes, raw)| axes.take(raw, &mut saturated));
        let temperature_c = raw.temperature.map(|raw| self.die.celsius(raw)).or(self.temperature_c);
        Reading { t, gyro, accel, temperature_c, saturated }
    }

    /// The samples are worth more than their temperature: a failure is counted and forgotten.
    fn ask_temperature(&mut self, now: Nanos, counters: &mut ImuCounters) {
        let from = &self.die.chip.temperature.from;
        if matches!(from, TemperatureFrom::Nowhere | TemperatureFrom::Frames) || now < self.temperature_due {
            return;
        }
        self.temperature_due = now + TEMPERATURE_EVERY;
        match self.die.temperature() {
            Ok(known) => self.temperature_c = known,
            Err(fault) => counters.count(&Trouble::Bus(fault)),
        }
    }

    fn check_frozen(&self) -> Result<(), Trouble> {
        let too_long = |a: &&Axes| self.frozen_samples > 0 && a.repeats + 1 >= self.frozen_samples;
        match [&self.accel, &self.gyro].into_iter().flatten().find(too_long) {
            Some(axes) => Err(Trouble::Frozen(axes.name)),
            None => Ok(()),
        }
    }
}
