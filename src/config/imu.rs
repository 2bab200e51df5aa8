//! `[imu]` and `[gpio]`: the inertial unit of a live run, and the lines it and the cameras are wired to. Without them a
//! run reads none.

use serde::{Deserialize, Serialize};
use stipple_drivers::gpio::{Edge, LineName};
use stipple_drivers::imu::chips::Chip;
use stipple_drivers::imu::{IioOptions, ImuOptions, RegisterOptions, Wiring};
use stipple_drivers::Span;

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ImuConfig {
    /// bmi088, bmi270, icm-42688-p, icm-20948, lsm6dsox, mpu-9250 or mpu-6500, driven by its registers; iio: what the
    /// kernel drives; empty: none.
    pub chip: String,
    /// Adapter that the unit is wired to: a path, or the name its driver gives it (`i2cdetect -l`); and its address, the
    /// gyro's of a unit that has two.
    pub i2c: String,
    pub i2c_address: u16,
    pub accel_i2c_address: u16,
    /// Or the spidev node, the gyro's of a unit that has two; and the clock. MPUs take no more than 1 MHz.
    pub spi: String,
    pub accel_spi: String,
    pub spi_hz: u32,
    /// Of iio: name, label or place of the device, the accelerometer's where that is another, and the trigger of a
    /// device that has no interrupt of its own.
    pub device: String,
    pub accel_device: String,
    pub trigger: String,
    /// The nearest that the unit has, within 10 %.
    pub rate_hz: f64,
    /// The smallest of the unit's ranges that holds these.
    pub accel_range_g: f64,
    pub gyro_range_dps: f64,
    /// Test the unit when it is opened, which takes up to two seconds and wants the board to stand still.
    pub self_test: bool,
    /// A file of the 8192 bytes that the BMI270 needs at each start: Bosch's program for it, and no part of this one.
    pub configuration: String,
    /// Equal samples in a row that are no coincidence, 0: never. The quietest of the units, at its widest range, has a
    /// noise of a third of a step and more; six axes that stand still for 50 samples do not come by chance.
    pub frozen_samples: u32,
}

impl Default for ImuConfig {
    fn default() -> Self {
        ImuConfig {
            chip: String::new(),
            i2c: String::new(),
            i2c_address: 0x68,
            accel_i2c_address: 0x18,
            spi: String::new(),
            accel_spi: String::new(),
            spi_hz: 1_000_000,
            device: String::new(),
            accel_device: String::new(),
            trigger: String::new(),
            rate_hz: 200.0,
            accel_range_g: 16.0,
            gyro_range_dps: 2000.0,
            self_test: false,
            configuration: String::new(),
            frozen_samples: 50,
        }
    }
}

/// The chip's name that means the kernel's driver.
const IIO: &str = "iio";

impl ImuConfig {
    /// The first key that is wrong for what it says, and why.
    pub(super) fn wrong(&self, gpio: &GpioConfig) -> Option<(&'static str, String)> {
        let rules: &[(bool, &'static str, &str)] = match self.chip.as_str() {
            "" => &[],
            IIO => &[
                (!self.device.is_empty(), "imu.device", "must name the device of imu.chip = \"iio\" (/sys/bus/iio)"),
                (gpio.data_ready.is_none(), "gpio.data_ready.chip", "must be empty: the kernel's driver has the line"),
            ],
            name => match Chip::named(name) {
                Err(fault) => return Some(("imu.chip", format!("imu.chip = {}; {}", fault.what, fault.fix))),
                Ok(chip) => &[
                    (
                        self.i2c.is_empty() != self.spi.is_empty(),
                        "imu.i2c",
                        "or imu.spi, one of them, must say where imu.chip is wired",
                    ),
                    (
                        chip.dies.len() == 1 || self.spi.is_empty() == self.accel_spi.is_empty(),
                        "imu.accel_spi",
                        "must name the spidev node of the second die, as imu.spi that of the first",
                    ),
                    (
                        name != "bmi270" || !self.configuration.is_empty(),
                        "imu.configuration",
                        "must name a file of the 8192 bytes of bmi270_config_file, from Bosch's BMI270_SensorAPI, without \
                         which it measures nothing",
                    ),
                ],
            },
        };
        let broken = rules.iter().find(|(holds, _, _)| !holds);
        broken.map(|(_, key, rule)| (*key, format!("{key} {rule}")))
    }

    /// What to open; none where the board has no inertial unit.
    pub fn options(&self) -> Option<ImuOptions> {
        match self.chip.as_str() {
            "" => None,
            IIO => Some(ImuOptions::Iio(IioOptions {
                device: self.device.clone(),
                accel_device: self.accel_device.clone(),
                trigger: self.trigger.clone(),
                rate_hz: self.rate_hz,
                frozen_samples: self.frozen_samples,
                sysfs: "/sys/bus/iio/devices".into(),
                dev: "/dev".into(),
            })),
            name => Some(ImuOptions::Register(RegisterOptions {
                chip: name.into(),
                wiring: self.wiring(),
                rate_hz: self.rate_hz,
                accel_range_g: self.accel_range_g,
                gyro_range_dps: self.gyro_range_dps,
                self_test: self.self_test,
                configuration: self.configuration.clone().into(),
                frozen_samples: self.frozen_samples,
            })),
        }
    }

    /// Of each die, the gyro's first.
    fn wiring(&self) -> Vec<Wiring> {
        let dies = Chip::named(&self.chip).map_or(1, |chip| chip.dies.len());
        let i2c = |address: u16| Wiring::I2c { adapter: self.i2c.clone(), address };
        let spi = |path: &str| Wiring::Spi { path: path.into(), hz: self.spi_hz };
        let mut wired = if self.spi.is_empty() {
            vec![i2c(self.i2c_address), i2c(self.accel_i2c_address)]
        } else {
            vec![spi(&self.spi), spi(&self.accel_spi)]
        };
        wired.truncate(dies);
        wired
    }
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GpioConfig {
    pub data_ready: DataReadyConfig,
    pub trigger: TriggerConfig,
    pub led: LedConfig,
}

/// The line on which an inertial unit that we drive says that a sample is ready; of a unit with two dies the gyro's.
/// Without it samples are stamped by the times of reading: within 0.2 ms on a bus that is served in time.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DataReadyConfig {
    /// Label, name or path (`gpiodetect`); empty: none is wired.
    pub chip: String,
    /// Name or offset (`gpioinfo`).
    pub line: String,
    pub edge: Edge,
}

impl Default for DataReadyConfig {
    fn default() -> Self {
        DataReadyConfig { chip: String::new(), line: String::new(), edge: Edge::Rising }
    }
}

/// The line that starts the cameras' exposures, at camera.rate_hz.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TriggerConfig {
    pub chip: String,
    pub line: String,
    pub active_low: bool,
    /// Long enough for the opto-couplers of machine-vision cameras.
    pub pulse_us: u32,
}

impl Default for TriggerConfig {
    fn default() -> Self {
        TriggerConfig { chip: String::new(), line: String::new(), active_low: false, pulse_us: 100 }
    }
}

/// A light: flashes at boot, is on while frames are tracked, blinks while they are not, flashes thrice on a fault.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LedConfig {
    pub chip: String,
    pub line: String,
    pub active_low: bool,
}

fn named(chip: &str, line: &str) -> Option<LineName> {
    (!chip.is_empty()).then(|| LineName { chip: chip.into(), line: line.into() })
}

impl DataReadyConfig {
    fn is_none(&self) -> bool {
        self.chip.is_empty()
    }
}

impl GpioConfig {
    pub(super) fn wrong(&self) -> Option<(&'static str, String)> {
        let lines = [
            ("gpio.data_ready.line", &self.data_ready.chip, &self.data_ready.line),
            ("gpio.trigger.line", &self.trigger.chip, &self.trigger.line),
            ("gpio.led.line", &self.led.chip, &self.led.line),
        ];
        let half = lines.into_iter().find(|(_, chip, line)| chip.is_empty() != line.is_empty());
        half.map(|(key, _, _)| (key, format!("{key} and the chip beside it must both be given, or neither")))
    }

    pub fn data_ready(&self) -> Option<(LineName, Edge)> {
        Some((named(&self.data_ready.chip, &self.data_ready.line)?, self.data_ready.edge))
    }

    /// Line, whether low is active, and length of the pulse.
    pub fn trigger(&self) -> Option<(LineName, bool, Span)> {
        let t = &self.trigger;
        Some((named(&t.chip, &t.line)?, t.active_low, Span(i64::from(t.pulse_us) * 1000)))
    }

    /// Line, and whether low is active.
    pub fn led(&self) -> Option<(LineName, bool)> {
        Some((named(&self.led.chip, &self.led.line)?, self.led.active_low))
    }
}
