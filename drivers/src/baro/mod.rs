//! Barometers: the BMP388 by its registers over I2C (`bmp388`), or any through the kernel's driver (`iio`).
//!
//! Each reading is measured when it is asked for, `RATE_HZ` times a second, so that its stamp is the middle of the
//! measurement. A sensor that fails is tried again at the next reading; after `FAILURES_MAX` in a row it is lost, and looked
//! for with a pause that doubles from `BACKOFF` to `BACKOFF_MAX`.

mod bmp388;
mod iio;
#[cfg(test)]
mod tests;

use crate::imu::bus::{BusFault, I2c};
use crate::source::{Aid, AidBatch, AidReading, AidSource, SourceFault, Wait};
use crate::types::{Nanos, Span};
use crate::{counters, Fault, FaultKind};
use bmp388::Bmp388;
use iio::Iio;

/// Readings a second.
const RATE_HZ: i64 = 50;
const PERIOD: Span = Span(1_000_000_000 / RATE_HZ);
/// First and longest pause between attempts to find a lost sensor.
const BACKOFF: Span = Span(100_000_000);
const BACKOFF_MAX: Span = Span(2_000_000_000);
/// Readings that may fail in a row.
const FAILURES_MAX: u32 = 3;
/// Pressures that these sensors are made for, Pa.
const RANGE: std::ops::RangeInclusive<f64> = 30_000.0..=125_000.0;

/// A barometer and where it is.
#[derive(Clone, Debug, PartialEq)]
pub enum BaroOptions {
    /// A BMP388: its I2C adapter (a path, or the name its driver gives it), and its address.
    Bmp388 { adapter: String, address: u16 },
    /// A device of the kernel's by its name, its label or its place in the device tree.
    Iio { device: String },
}

impl BaroOptions {
    /// Opens it; a fault where it is missing or answers as something else.
    pub fn open(&self) -> Result<Box<dyn AidSource>, Fault> {
        Ok(match self {
            BaroOptions::Bmp388 { adapter, address } => {
                let bus = Box::new(I2c::open(adapter, *address)?);
                Box::new(Barometer::start(format!("bmp388 at {adapter} {address:#04x}"), Bmp388::new(bus))?)
            }
            BaroOptions::Iio { device } => {
                Box::new(Barometer::start(format!("IIO device `{device}`"), Iio::new(device, "/sys/bus/iio/devices"))?)
            }
        })
    }
}

/// Why a barometer gives no reading now.
#[derive(Clone, Copy, Debug, PartialEq)]
enum BaroError {
    Bus(BusFault),
    /// CHIP_ID answers this, which is another chip.
    WrongChip(u8),
    /// A register that was set reads as something else.
    Stuck(u8, u8),
    /// Its coefficients are blank.
    NoCoefficients,
    /// A measurement did not end.
    Silent,
    /// A pressure that no air has, Pa.
    Implausible(f64),
    /// So many devices of the kernel's are called so, and not one.
    Named(usize),
}

impl From<BusFault> for BaroError {
    fn from(fault: BusFault) -> BaroError {
        BaroError::Bus(fault)
    }
}

impl std::fmt::Display for BaroError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            BaroError::Bus(fault) => write!(f, "{fault}"),
            BaroError::WrongChip(id) => write!(f, "CHIP_ID answers {id:#04x}, which is another chip"),
            BaroError::Stuck(register, value) => write!(f, "register {register:#04x} stays at {value:#04x}"),
            BaroError::NoCoefficients => write!(f, "its calibration is blank"),
            BaroError::Silent => write!(f, "it answers but does not measure"),
            BaroError::Implausible(pa) => write!(f, "it measures {pa:.0} Pa, which no air has"),
            BaroError::Named(n) => write!(f, "{n} IIO devices with a pressure have this name"),
        }
    }
}

counters! {
    /// What went wrong with a barometer.
    #[derive(Clone, Copy, PartialEq, Eq)]
    pub struct BaroCounters of u64, read by u64::clone;
    /// Transfers that failed.
    baro_bus_errors,
    /// Measurements that did not end, and pressures that no air has.
    baro_silences,
    baro_implausible,
    /// Times that it was set up anew, and that this failed: no answer, another chip, blank or stuck registers.
    baro_restarts,
    baro_restarts_failed,
}

/// A sensor that measures when it is asked to.
trait Sensor: Send {
    /// Finds it and sets it up, after a loss too.
    fn start(&mut self) -> Result<(), BaroError>;
    /// One pressure, Pa, and the middle of its measurement.
    fn measure(&mut self) -> Result<(Nanos, f64), BaroError>;
    fn now(&self) -> Nanos;
    fn sleep(&mut self, span: Span);
}

/// A barometer that is read at a steady rate.
struct Barometer<S> {
    place: String,
    sensor: S,
    due: Nanos,
    failures: u32,
    /// Why it is lost, and when it is looked for again.
    lost: Option<(BaroError, Nanos)>,
    pause: Span,
    counters: BaroCounters,
}

impl<S: Sensor> Barometer<S> {
    fn start(place: String, mut sensor: S) -> Result<Barometer<S>, Fault> {
        sensor.start().map_err(|error| {
            let fix =
                "check wiring, supply, baro.device and baro.address (i2cdetect and /sys/bus/iio show what is there)";
            Fault::new(FaultKind::Unavailable, &place, format!("the barometer does not start: {error}"), fix)
        })?;
        let due = sensor.now();
        let counters = BaroCounters::default();
        Ok(Barometer { place, sensor, due, failures: 0, lost: None, pause: BACKOFF, counters })
    }

    fn sleep_until(&mut self, t: Nanos) {
        let span = t - self.sensor.now();
        if span.0 > 0 {
            self.sensor.sleep(span);
        }
    }

    fn handle(&mut self, error: BaroError) {
        match error {
            BaroError::Silent => self.counters.baro_silences += 1,
            BaroError::Implausible(_) => self.counters.baro_implausible += 1,
            _ => self.counters.baro_bus_errors += 1,
        }
        self.failures += 1;
        if self.failures >= FAILURES_MAX || error == BaroError::Bus(BusFault::Gone) {
            self.lose(error);
        }
    }

    fn lose(&mut self, why: BaroError) {
        self.lost = Some((why, self.sensor.now() + self.pause));
        self.pause = Span((self.pause.0 * 2).min(BACKOFF_MAX.0));
    }

    /// Looks for a lost sensor when it is time to, and waits for that until `limit`.
    fn look_for_lost(&mut self, limit: Nanos) -> Result<(), SourceFault> {
        let Some((why, retry)) = self.lost else { return Ok(()) };
        self.sleep_until(retry.min(limit));
        if self.sensor.now() >= retry {
            match self.sensor.start() {
                Ok(()) => {
                    self.counters.baro_restarts += 1;
                    (self.lost, self.failures, self.due) = (None, 0, self.sensor.now());
                    return Ok(());
                }
                Err(error) => {
                    self.counters.baro_restarts_failed += 1;
                    self.lose(error);
                }
            }
        }
        let fix = "check cable, supply and the kernel's log; it is looked for again and again";
        let what = format!("the barometer is lost: {why}");
        Err(SourceFault::Lost(Fault::new(FaultKind::Unavailable, &self.place, what, fix)))
    }
}

impl<S: Sensor> AidSource for Barometer<S> {
    fn next(&mut self, timeout: Span, batch: &mut AidBatch) -> Result<Wait, SourceFault> {
        batch.clear();
        let limit = self.sensor.now() + timeout.max(Span(0));
        loop {
            self.look_for_lost(limit)?;
            self.sleep_until(self.due.min(limit));
            if self.due > limit {
                return Ok(Wait::TimedOut);
            }
            // A reading that came late does not make the next ones follow in haste.
            self.due = (self.due + PERIOD).max(self.sensor.now());
            let measured = self.sensor.measure().and_then(|(t, pa)| match RANGE.contains(&pa) {
                true => Ok(AidReading { t, value: Aid::Pressure(pa) }),
                false => Err(BaroError::Implausible(pa)),
            });
            match measured {
                Ok(reading) => {
                    (self.failures, self.pause) = (0, BACKOFF);
                    let _ = batch.push(reading);
                    return Ok(Wait::Got);
                }
                Err(error) => self.handle(error),
            }
        }
    }

    fn counters(&self) -> Vec<(&'static str, u64)> {
        self.counters.list()
    }
}
