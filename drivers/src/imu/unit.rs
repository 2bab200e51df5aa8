//! One die as a stream: its bursts become readings that are stamped, in SI units, and flagged where something is wrong.

use super::chips::{Range, SensorSpec, Setting, TemperatureSource};
use super::counters::ImuCounters;
use super::die::Die;
use super::edges::EdgeQueue;
use super::error::ImuError;
use super::frames::Raw;
use super::merge::Reading;
use super::timeline::Timeline;
use crate::source::{IMU_BATCH, RANGE_END};
use crate::types::{Nanos, Span};
use glam::DVec3;

/// Standard gravity, m/s² per g.
pub const GRAVITY: f64 = 9.80665;
/// How often a temperature that is not in the frames is read.
const TEMPERATURE_EVERY: Span = Span(1_000_000_000);

/// One sensor: counts into SI units, and whether they move.
struct Axes {
    name: &'static str,
    si_per_lsb: f64,
    /// End of the range, counts: that of 16 bits, or of the range where that ends before.
    end: f64,
    last: Option<[i16; 3]>,
    /// How often `last` came again.
    repeats: u32,
    moved: bool,
}

impl Axes {
    /// `si` is the sensor's unit in SI units.
    fn new(name: &'static str, si: f64, range: &Range) -> Axes {
        let end = (range.full_scale / range.per_lsb).min(f64::from(i16::MAX));
        Axes { name, si_per_lsb: range.per_lsb * si, end, last: None, repeats: 0, moved: false }
    }

    fn forget(&mut self) {
        (self.last, self.repeats, self.moved) = (None, 0, false);
    }

    fn convert(&mut self, raw: [i16; 3], saturated: &mut bool) -> DVec3 {
        let again = self.last == Some(raw);
        self.moved |= self.last.is_some() && !again;
        self.repeats = if again { self.repeats.saturating_add(1) } else { 0 };
        self.last = Some(raw);
        let counts = raw.map(f64::from);
        *saturated |= counts.iter().any(|c| c.abs() >= RANGE_END * self.end);
        DVec3::from(counts) * self.si_per_lsb
    }
}

/// A die, its clock and its sensors.
pub struct Unit {
    /// The die that is read.
    pub die: Die,
    /// The estimate of its clock.
    pub line: Timeline,
    accel: Option<Axes>,
    gyro: Option<Axes>,
    /// Samples in a row that are the same to the bit and no coincidence; 0: never.
    frozen_samples: u32,
    raws: Vec<Raw>,
    edges: Vec<Option<Nanos>>,
    last: Option<Nanos>,
    temperature_c: Option<f32>,
    temperature_due: Nanos,
}

impl Unit {
    /// A unit that is not started yet, of the rate, Hz, that its setting gives.
    pub fn new(die: Die, setting: &Setting, rate_hz: f64, frozen_samples: u32) -> Unit {
        let axes = |name, si, sensor: &Option<SensorSpec>, code| {
            sensor.as_ref().map(|sensor: &SensorSpec| Axes::new(name, si, sensor.range(code)))
        };
        Unit {
            accel: axes("accelerometer", GRAVITY, &die.spec.accel, setting.accel),
            gyro: axes("gyro", 1f64.to_radians(), &die.spec.gyro, setting.gyro),
            line: Timeline::new(Span::from_secs(1.0 / rate_hz)),
            frozen_samples,
            raws: Vec::with_capacity(die.spec.fifo.capacity / die.spec.fifo.layout.frame() + 1),
            edges: Vec::with_capacity(2 * IMU_BATCH),
            last: None,
            temperature_c: None,
            temperature_due: Nanos::MIN,
            die,
        }
    }

    /// Resets the die and sets it up.
    pub fn start(&mut self) -> Result<(), ImuError> {
        self.die.start()?;
        self.line.forget_phase();
        self.sensors().for_each(Axes::forget);
        Ok(())
    }

    fn sensors(&mut self) -> impl Iterator<Item = &mut Axes> {
        [&mut self.accel, &mut self.gyro].into_iter().flatten()
    }

    /// Ends of the ranges of gyro and accelerometer, rad/s and m/s², where the die has them.
    pub fn range(&self) -> [Option<f64>; 2] {
        [&self.gyro, &self.accel].map(|axes| axes.as_ref().map(|a| a.end * a.si_per_lsb))
    }

    /// Whether every sensor has given two values that differ since the start.
    pub fn is_alive(&mut self) -> bool {
        self.sensors().all(|a| a.moved)
    }

    /// Reads what the FIFO holds, hands it to `give`, and answers how many samples that were. Where edges are given they
    /// stamp the samples.
    pub fn collect(
        &mut self,
        edges: Option<&mut EdgeQueue>,
        counters: &mut ImuCounters,
        mut give: impl FnMut(Reading),
    ) -> Result<usize, ImuError> {
        self.raws.clear();
        let burst = match self.die.burst(&mut self.raws) {
            Ok(burst) => burst,
            Err(error) => {
                if error == ImuError::Overflow {
                    self.line.forget_phase();
                    edges.into_iter().for_each(EdgeQueue::clear);
                }
                return Err(error);
            }
        };
        counters.imu_samples_skipped += burst.parsed.skipped as u64;
        counters.imu_frames_invalid += burst.parsed.invalid as u64;
        if burst.parsed.skipped > 0 {
            self.line.forget_phase();
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
            counters.count_gap(self.last, t, self.line.period());
            self.last = Some(t);
            let reading = self.reading(t, self.raws[i]);
            counters.imu_saturated += u64::from(reading.saturated);
            give(reading);
        }
        if n > 0 {
            self.read_temperature(burst.after, counters);
            self.check_frozen()?;
        }
        Ok(n)
    }

    fn reading(&mut self, t: Nanos, raw: Raw) -> Reading {
        let mut saturated = false;
        let gyro = self.gyro.as_mut().zip(raw.gyro).map(|(axes, raw)| axes.convert(raw, &mut saturated));
        let accel = self.accel.as_mut().zip(raw.accel).map(|(axes, raw)| axes.convert(raw, &mut saturated));
        let temperature_c = raw.temperature.map(|raw| self.die.celsius(raw)).or(self.temperature_c);
        Reading { t, gyro, accel, temperature_c, saturated }
    }

    /// Reads the temperature when it is due. A failure is counted and costs no samples.
    fn read_temperature(&mut self, now: Nanos, counters: &mut ImuCounters) {
        let from = &self.die.spec.temperature.from;
        if matches!(from, TemperatureSource::Nowhere | TemperatureSource::Frames) || now < self.temperature_due {
            return;
        }
        self.temperature_due = now + TEMPERATURE_EVERY;
        match self.die.temperature() {
            Ok(known) => self.temperature_c = known,
            Err(fault) => counters.count(&ImuError::Bus(fault)),
        }
    }

    fn check_frozen(&mut self) -> Result<(), ImuError> {
        let limit = self.frozen_samples;
        match self.sensors().find(|a| limit > 0 && a.repeats + 1 >= limit) {
            Some(axes) => Err(ImuError::Frozen(axes.name)),
            None => Ok(()),
        }
    }
}
