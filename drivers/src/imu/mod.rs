//! Inertial units: by their registers over I2C or SPI (`register`), or through the kernel's driver (`iio`).
//!
//! ```text
//! bus -> die: FIFO burst -> frames -> unit: stamp, scale, flags -> [merge of two dies] -> register: ImuSource
//!              edges, timeline ----------^          chips: tables of all of the above
//! ```
//!
//! Stamps are `CLOCK_MONOTONIC` of the instant at which a sample was ready: that of the kernel's event where a
//! data-ready line is wired, else estimated from the moments of reading (`timeline`: within 0.2 ms of the truth at
//! 200 Hz, and the sensor's rate within 10 ppm). The delay of the unit's own low-pass filter, some milliseconds, is
//! part of the time offset between camera and inertial unit that calibration states or odometry estimates.

pub mod bus;
pub mod chips;
pub mod counters;
mod die;
pub mod edges;
mod frames;
pub mod iio;
mod iio_scan;
mod merge;
mod register;
mod self_test;
#[cfg(test)]
mod tests;
pub mod timeline;
mod unit;

pub use counters::ImuCounters;
pub use iio::{IioImu, IioOptions};
pub use register::RegisterImu;
pub use timeline::ClockReport;

use crate::gpio::DataReady;
use crate::source::{ImuBatch, ImuSource, SourceFault, Wait};
use crate::types::{Nanos, Span};
use crate::{Fault, FaultKind};
use bus::{Bus, BusFault, I2c, Spi};
use chips::Chip;
use die::Die;
use std::path::PathBuf;
use unit::Unit;

/// A unit and how it is read.
#[derive(Clone, Debug, PartialEq)]
pub enum ImuOptions {
    Register(RegisterOptions),
    Iio(IioOptions),
}

/// The inertial unit of a live run.
pub enum HardwareImu {
    Register(Box<RegisterImu<Box<dyn Bus>, DataReady>>),
    Iio(Box<IioImu>),
}

impl ImuOptions {
    /// With the line on which a unit that we drive says that a sample is ready, where that is wired.
    pub fn open(&self, data_ready: Option<DataReady>) -> Result<HardwareImu, Fault> {
        Ok(match self {
            ImuOptions::Register(options) => HardwareImu::Register(Box::new(options.open(data_ready)?)),
            ImuOptions::Iio(options) => HardwareImu::Iio(Box::new(IioImu::open(options)?)),
        })
    }
}

impl HardwareImu {
    /// The sensor's clock against the host's.
    pub fn clock(&self) -> ClockReport {
        match self {
            HardwareImu::Register(imu) => imu.clock(),
            HardwareImu::Iio(imu) => imu.clock(),
        }
    }
}

impl ImuSource for HardwareImu {
    fn next(&mut self, timeout: Span, batch: &mut ImuBatch) -> Result<Wait, SourceFault> {
        match self {
            HardwareImu::Register(imu) => imu.next(timeout, batch),
            HardwareImu::Iio(imu) => imu.next(timeout, batch),
        }
    }

    fn counters(&self) -> Vec<(&'static str, u64)> {
        match self {
            HardwareImu::Register(imu) => imu.counters(),
            HardwareImu::Iio(imu) => imu.counters(),
        }
    }
}

/// Where a die is wired.
#[derive(Clone, Debug, PartialEq)]
pub enum Wiring {
    /// An adapter (a path, or the name its driver gives it) and an address.
    I2c {
        adapter: String,
        address: u16,
    },
    Spi {
        path: String,
        hz: u32,
    },
}

/// A unit that we drive by its registers.
#[derive(Clone, Debug, PartialEq)]
pub struct RegisterOptions {
    pub chip: String,
    /// Of each die of the chip; the one with the gyro first.
    pub wiring: Vec<Wiring>,
    /// The nearest there is within 10 % is taken.
    pub rate_hz: f64,
    /// The smallest there is that holds them is taken.
    pub accel_range_g: f64,
    pub gyro_range_dps: f64,
    pub self_test: bool,
    /// The BMI270's configuration file.
    pub configuration: PathBuf,
    /// Equal values in a row that are no coincidence; 0: never.
    pub frozen_samples: u32,
}

impl RegisterOptions {
    /// Opens the buses, tests the unit where that is asked for, and starts it.
    pub fn open(&self, data_ready: Option<DataReady>) -> Result<RegisterImu<Box<dyn Bus>, DataReady>, Fault> {
        let chip = Chip::named(&self.chip)?;
        if self.wiring.len() != chip.dies.len() {
            let what = format!("{} has {} dies, {} are wired", chip.name, chip.dies.len(), self.wiring.len());
            return Err(Fault::new(
                FaultKind::Config,
                "imu",
                what,
                "say where each is: imu.address, imu.accel_address",
            ));
        }
        let buses = chip.dies.iter().zip(&self.wiring).map(|(die, wiring)| wiring.open(die.spi_dummy));
        self.start(buses.collect::<Result<_, _>>()?, data_ready)
    }

    /// With the buses of the dies.
    pub fn start<B: Bus, E: edges::Edges>(&self, buses: Vec<B>, edges: Option<E>) -> Result<RegisterImu<B, E>, Fault> {
        let chip = Chip::named(&self.chip)?;
        let place = self.wiring.first().map_or(self.chip.clone(), |w| format!("{} at {w}", self.chip));
        let upload = self.read_configuration()?;
        let mut units = Vec::new();
        for ((die, bus), wiring) in chip.dies.iter().zip(buses).zip(&self.wiring) {
            let (mut setting, rate_hz) = die.setting(self.rate_hz, self.accel_range_g, self.gyro_range_dps)?;
            setting.spi = matches!(wiring, Wiring::Spi { .. });
            setting.data_ready = edges.is_some() && die.gyro.is_some();
            let mut die = Die::new(bus, die, &setting, upload.clone());
            if self.self_test {
                self_test::self_test(&mut die)
                    .map_err(|trouble| register::cannot_start(&place, die.chip.name, trouble))?;
            }
            units.push(Unit::new(die, &setting, rate_hz, self.frozen_samples));
        }
        RegisterImu::start(place, units, edges, watermark(self.rate_hz))
    }

    fn read_configuration(&self) -> Result<Vec<u8>, Fault> {
        /// "Device initialisation" of the BMI270. Its smaller files are of other variants, whose FIFO is longer and whose
        /// cross-axis factor stands elsewhere.
        const BYTES: usize = 8192;
        if self.configuration.as_os_str().is_empty() {
            return Ok(Vec::new());
        }
        let place = self.configuration.display().to_string();
        let fix =
            "imu.configuration names the bytes of bmi270_config_file of Bosch's BMI270_SensorAPI, as they are sent";
        let bytes = std::fs::read(&self.configuration)
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

impl Bus for Box<dyn Bus> {
    fn read(&mut self, register: u8, into: &mut [u8]) -> Result<(), BusFault> {
        (**self).read(register, into)
    }

    fn write(&mut self, register: u8, bytes: &[u8]) -> Result<(), BusFault> {
        (**self).write(register, bytes)
    }

    fn reopen(&mut self) -> Result<(), BusFault> {
        (**self).reopen()
    }

    fn now(&self) -> Nanos {
        (**self).now()
    }

    fn sleep(&mut self, span: Span) {
        (**self).sleep(span);
    }
}

/// Samples of one read at this rate, Hz: as many as come in 20 ms, half of what the tracker waits for a frame's samples; 16
/// at most, since the smallest FIFO holds 36.
fn watermark(rate_hz: f64) -> usize {
    ((rate_hz * 0.02) as usize).clamp(1, 16)
}

/// Sleeps for a span; not at all where it is negative.
fn pause(span: Span) {
    std::thread::sleep(std::time::Duration::from_nanos(span.0.max(0) as u64));
}
