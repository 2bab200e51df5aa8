//! Inertial units: driven by their registers over I2C or SPI (`register`), or through the kernel's driver (`iio`).
//!
//! ```text
//! bus -> die: FIFO burst -> frames -> unit: stamp, scale, flags -> [merge of two dies] -> register: ImuSource
//!              edges, timeline ----------^          chips: tables of all of the above
//! ```
//!
//! Stamps are `CLOCK_MONOTONIC` of the instant at which a sample was ready: that of the kernel's event where a data-ready
//! line is wired, else estimated from the moments of reading (`timeline`: within 0.2 ms of the truth at 200 Hz, and the
//! sensor's rate within 10 ppm). The delay of the unit's own low-pass filter, some milliseconds, is part of the time offset
//! between camera and inertial unit that calibration states or odometry estimates.

pub mod bus;
pub mod chips;
mod counters;
mod die;
pub mod edges;
mod error;
mod frames;
mod iio;
mod iio_scan;
mod merge;
mod register;
mod self_test;
#[cfg(test)]
mod tests;
mod timeline;
mod unit;

pub use counters::ImuCounters;
pub(crate) use iio::is_called;
pub use iio::{IioImu, IioOptions};
pub use register::RegisterImu;

use crate::gpio::DataReady;
use crate::source::ImuSource;
use crate::types::Span;
use crate::{input, Fault, FaultKind};
use bus::{Bus, I2c, Spi};
use chips::Chip;
use die::Die;
use edges::Edges;
use std::path::PathBuf;
use unit::Unit;

/// A unit and how it is read.
#[derive(Clone, Debug, PartialEq)]
pub enum ImuOptions {
    Register(RegisterOptions),
    Iio(IioOptions),
}

impl ImuOptions {
    /// Opens the unit. `data_ready` is the line on which a unit that is driven by its registers says that a sample is ready,
    /// where that is wired; the kernel's driver has a line of its own. A fault where the unit is missing or fails its test.
    pub fn open(&self, data_ready: Option<DataReady>) -> Result<Box<dyn ImuSource>, Fault> {
        Ok(match self {
            ImuOptions::Register(options) => Box::new(options.open(data_ready)?),
            ImuOptions::Iio(options) => Box::new(IioImu::open(options)?),
        })
    }
}

/// Where a die is wired.
#[derive(Clone, Debug, PartialEq)]
pub enum Wiring {
    /// An adapter (a path, or the name its driver gives it) and an address.
    I2c { adapter: String, address: u16 },
    /// A spidev node and its clock.
    Spi { path: String, hz: u32 },
}

/// A unit that is driven by its registers, and how it is set.
#[derive(Clone, Debug, PartialEq)]
pub struct RegisterOptions {
    /// A name of `chips::CHIPS`.
    pub chip: String,
    /// One for each die of the chip; the one with the gyro first.
    pub wiring: Vec<Wiring>,
    /// The nearest rate within 10 % is taken.
    pub rate_hz: f64,
    /// The smallest ranges that hold these are taken.
    pub accel_range_g: f64,
    pub gyro_range_dps: f64,
    /// Whether the unit tests itself before it starts; the board must stand still meanwhile.
    pub self_test: bool,
    /// File of the BMI270's configuration; empty for other chips.
    pub configuration: PathBuf,
    /// Equal values in a row that are no coincidence; 0: never.
    pub frozen_samples: u32,
}

impl RegisterOptions {
    /// Opens the buses, tests the unit where that is asked for, and starts it. A fault where one of these fails.
    pub fn open(&self, data_ready: Option<DataReady>) -> Result<RegisterImu, Fault> {
        let chip = Chip::named(&self.chip)?;
        if self.wiring.len() != chip.dies.len() {
            let what = format!("{} has {} dies, {} are wired", chip.name, chip.dies.len(), self.wiring.len());
            let fix = "say where each is: imu.address, imu.accel_address";
            return Err(Fault::new(FaultKind::Config, "imu", what, fix));
        }
        let buses = chip.dies.iter().zip(&self.wiring).map(|(die, wiring)| wiring.open(die.spi_dummy));
        let edges = data_ready.map(|line| Box::new(line) as Box<dyn Edges>);
        self.start(buses.collect::<Result<_, _>>()?, edges)
    }

    /// Tests and starts the dies behind these buses.
    fn start(&self, buses: Vec<Box<dyn Bus>>, edges: Option<Box<dyn Edges>>) -> Result<RegisterImu, Fault> {
        let chip = Chip::named(&self.chip)?;
        let place = self.wiring.first().map_or(self.chip.clone(), |w| format!("{} at {w}", self.chip));
        let upload = self.read_configuration()?;
        let mut units = Vec::new();
        for ((spec, bus), wiring) in chip.dies.iter().zip(buses).zip(&self.wiring) {
            let (mut setting, rate_hz) = spec.setting(self.rate_hz, self.accel_range_g, self.gyro_range_dps)?;
            setting.spi = matches!(wiring, Wiring::Spi { .. });
            setting.data_ready = edges.is_some() && spec.gyro.is_some();
            let mut die = Die::new(bus, spec, &setting, upload.clone());
            if self.self_test {
                self_test::self_test(&mut die).map_err(|error| error.at_start(&place, spec.name))?;
            }
            units.push(Unit::new(die, &setting, rate_hz, self.frozen_samples));
        }
        RegisterImu::start(place, units, edges, watermark(self.rate_hz))
    }

    fn read_configuration(&self) -> Result<Vec<u8>, Fault> {
        /// "Device initialisation" of the BMI270. Bosch's smaller files are for other variants, whose FIFO is longer and
        /// whose cross-axis factor stands elsewhere.
        const BYTES: usize = 8192;
        if self.configuration.as_os_str().is_empty() {
            return Ok(Vec::new());
        }
        let place = self.configuration.display().to_string();
        let fix =
            "set imu.configuration to a file of the bytes of bmi270_config_file, from Bosch's BMI270_SensorAPI, as sent";
        let mut bytes = Vec::new();
        input::read(&self.configuration, input::SETTINGS_BYTES_MAX, &mut bytes)
            .map_err(|e| Fault::new(FaultKind::NoInput, &place, format!("cannot be read: {e}"), fix))?;
        if bytes.len() != BYTES {
            let what = format!("{} bytes, not {BYTES}", bytes.len());
            return Err(Fault::new(FaultKind::Config, place, what, fix));
        }
        Ok(bytes)
    }
}

impl Wiring {
    fn open(&self, spi_dummy: usize) -> Result<Box<dyn Bus>, Fault> {
        Ok(match self {
            Wiring::I2c { adapter, address } => Box::new(I2c::open(adapter, *address)?),
            Wiring::Spi { path, hz } => Box::new(Spi::open(path, *hz, spi_dummy)?),
        })
    }
}

impl std::fmt::Display for Wiring {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Wiring::I2c { adapter, address } => write!(f, "{adapter} {address:#04x}"),
            Wiring::Spi { path, .. } => write!(f, "{path}"),
        }
    }
}

/// Samples of one read at a rate, Hz: as many as come in 20 ms, half of what the tracker waits for a frame's samples; at
/// most 16, since the smallest FIFO holds 36.
fn watermark(rate_hz: f64) -> usize {
    ((rate_hz * 0.02) as usize).clamp(1, 16)
}

/// Sleeps for a span; not at all where it is negative.
pub(crate) fn pause(span: Span) {
    std::thread::sleep(std::time::Duration::from_nanos(span.0.max(0) as u64));
}
