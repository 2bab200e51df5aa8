//! The inertial units we drive by their registers, as tables: what answers to WHO_AM_I, what each range and rate is
//! called, where the data stand, how the FIFO frames them, and how the unit tests itself. Every fact is from the
//! data sheet whose name stands beside it, with the register or the title of the section it is under. "Checked
//! against" names the open drivers that were read beside it, and what fewer than two of them bear out. No table has met
//! its chip yet. All that runs is in `die`, `frames` and `self_test`.
//!
//! A unit is one die with both sensors, or two with one each (BMI088), which run on clocks of their own.

mod bosch;
mod invensense;
mod st;

use crate::{Fault, FaultKind};

/// Register address, its bank in the high byte.
pub type Reg = u16;

/// Register `address` of a bank.
pub const fn banked(bank: u8, address: u8) -> Reg {
    (bank as Reg) << 8 | address as Reg
}

pub struct Chip {
    /// As a board file writes it.
    pub name: &'static str,
    /// The one with the gyro first: its samples set the time of the pair.
    pub dies: &'static [Die],
}

pub struct Die {
    pub name: &'static str,
    /// WHO_AM_I, and what it may answer.
    pub who: Reg,
    pub who_answers: &'static [u8],
    /// Where the bank is chosen, and by how much the bank's number is shifted.
    pub bank_select: Option<(u8, u32)>,
    /// Bytes between address and data of a read by SPI.
    pub spi_dummy: usize,
    pub accel: Option<Sense>,
    pub gyro: Option<Sense>,
    pub rates: Rates,
    pub temperature: Temperature,
    pub fifo: Fifo,
    /// Brings it from power-on into a known idle state; WHO_AM_I is read after.
    pub reset: &'static [Step],
    /// From there to sampling into the FIFO.
    pub configure: fn(&Setting) -> Vec<Step>,
    /// How much of the gyro's z is in its x, in 1/512, seven bits (BMI270).
    pub cross_axis: Option<Reg>,
    pub self_tests: &'static [SelfTest],
}

/// One of the two sensors of a die.
pub struct Sense {
    /// g or °/s at full scale, the register's code, and g or °/s of one step.
    pub ranges: &'static [(f64, u8, f64)],
    /// Three words from here: the newest sample.
    pub data: Reg,
    pub big_endian: bool,
}

pub enum Rates {
    /// Hz and the register's code.
    Listed(&'static [(f64, u8)]),
    /// base / (1 + code).
    Divided { base_hz: f64, code_max: u8 },
}

impl Rates {
    /// The rate next to the one asked for, and its code.
    pub fn nearest(&self, hz: f64) -> (f64, u8) {
        match *self {
            Rates::Listed(rates) => {
                let by_ratio = |a: &&(f64, u8), b: &&(f64, u8)| (a.0 / hz).ln().abs().total_cmp(&(b.0 / hz).ln().abs());
                *rates.iter().min_by(by_ratio).expect("tables are not empty")
            }
            Rates::Divided { base_hz, code_max } => {
                let code = (base_hz / hz - 1.0).round().clamp(0.0, f64::from(code_max));
                (base_hz / (1.0 + code), code as u8)
            }
        }
    }
}

/// Where the temperature comes from: °C = raw * scale + offset.
pub struct Temperature {
    pub from: TemperatureFrom,
    pub c_per_lsb: f64,
    pub c_at_zero: f64,
}

pub enum TemperatureFrom {
    Nowhere,
    /// It rides in the frames of the FIFO.
    Frames,
    /// Two bytes, low first.
    Word(Reg),
    /// 11 bits, high byte first, low bits on top of the second (BMI088).
    Eleven(Reg),
}

pub struct Fifo {
    /// Two bytes (one where `count_bytes` is 1), then masked.
    pub count: Reg,
    pub count_bytes: usize,
    pub count_big_endian: bool,
    pub count_mask: u16,
    /// Bits beside the count that say that samples were lost; 0: none do.
    pub overrun: u16,
    /// Bytes that one count stands for.
    pub unit: usize,
    pub data: Reg,
    pub capacity: usize,
    /// Bytes from which on the next sample is refused or overwrites the oldest: what it holds is of no use.
    pub full: usize,
    pub layout: Layout,
    pub reset: &'static [Step],
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// Frames of one length; bytes at which each triple, and the temperature's word, begin.
    Plain { len: usize, accel: Option<usize>, gyro: Option<usize>, temperature: Option<usize>, big_endian: bool },
    /// ICM-42688-P, packet 3: a header, both triples, a byte of temperature, a time.
    Packet3,
    /// A header a frame; `config` bytes follow one that says the configuration changed.
    Bosch { config: usize },
    /// Seven bytes a word: a tag, then three values.
    Tagged,
}

impl Layout {
    /// Bytes of the smallest frame that carries a sample.
    pub fn frame(self) -> usize {
        match self {
            Layout::Plain { len, .. } => len,
            Layout::Packet3 => 16,
            Layout::Bosch { .. } | Layout::Tagged => 7,
        }
    }
}

/// What a die is told to do, in its own codes.
#[derive(Clone, Copy, Debug)]
pub struct Setting {
    pub rate: u8,
    pub accel: u8,
    pub gyro: u8,
    pub spi: bool,
    /// Drive the data-ready line.
    pub data_ready: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    Write(Reg, u8),
    /// Clears bits, then sets others, and keeps the rest.
    Change(Reg, u8, u8),
    WaitUs(u32),
    /// A read whose answer does not matter: it wakes the interface up.
    Touch(Reg),
    /// The BMI270's configuration file, until it runs.
    Upload,
}

pub enum SelfTest {
    /// A sensor is pushed by a known force: the newest sample with `on` less that with `off`, in g or °/s at a range,
    /// is to be within.
    Push(Push),
    /// As InvenSense does it: the push, as a part of what it was at the factory.
    Factory(FactoryTest),
    /// The die decides (Bosch's gyros).
    Asked(Asked),
}

pub struct Push {
    pub of: Which,
    pub prepare: &'static [Step],
    pub on: &'static [Step],
    pub off: &'static [Step],
    pub per_lsb: f64,
    /// Least and largest answer of each axis.
    pub within: [(f64, f64); 3],
}

pub struct FactoryTest {
    pub of: Which,
    pub prepare: &'static [Step],
    pub on: &'static [Step],
    pub off: &'static [Step],
    /// Codes of the three axes: the push at the factory was `base * 1.01^(code - 1)` steps.
    pub codes: [Reg; 3],
    pub base: f64,
    /// Push over that of the factory.
    pub ratio: (f64, f64),
    /// Steps of the push of a die of which the factory left no codes.
    pub uncoded: (f64, f64),
    pub settle_us: u32,
}

pub struct Asked {
    pub of: Which,
    pub prepare: &'static [Step],
    /// Written to start it.
    pub trigger: (Reg, u8),
    /// Where it answers: this bit once it is done, and then, of these bits, those that mean that all is well.
    pub answer: Reg,
    pub done: u8,
    pub verdict: u8,
    pub good: u8,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Which {
    Accel,
    Gyro,
}

pub const CHIPS: &[Chip] = &[
    Chip { name: "bmi088", dies: &[bosch::BMI088_GYRO, bosch::BMI088_ACCEL] },
    Chip { name: "bmi270", dies: &[bosch::BMI270] },
    Chip { name: "icm-42688-p", dies: &[invensense::ICM_42688_P] },
    Chip { name: "icm-20948", dies: &[invensense::ICM_20948] },
    Chip { name: "lsm6dsox", dies: &[st::LSM6DSOX] },
    Chip { name: "mpu-9250", dies: &[invensense::MPU_9250] },
    Chip { name: "mpu-6500", dies: &[invensense::MPU_6500] },
];

impl Chip {
    pub fn named(name: &str) -> Result<&'static Chip, Fault> {
        CHIPS.iter().find(|c| c.name == name).ok_or_else(|| {
            let known = CHIPS.iter().map(|c| c.name).collect::<Vec<_>>().join(", ");
            let fix = format!("choose one of {known}, or `iio` for what the kernel drives");
            Fault::new(FaultKind::Config, "imu.chip", format!("`{name}` is not driven"), fix)
        })
    }
}

/// How far the nearest rate may be from the one asked for; of an accelerometer whose samples are brought to the gyro's
/// times anyway, more.
const RATE_WITHIN: f64 = 0.1;
const RATE_WITHIN_ALONE: f64 = 0.25;

impl Die {
    /// Codes for what is asked for: the rate nearest to `rate_hz`, the smallest ranges that hold what is asked for.
    pub fn setting(&self, rate_hz: f64, accel_g: f64, gyro_dps: f64) -> Result<(Setting, f64), Fault> {
        let (hz, rate) = self.rates.nearest(rate_hz);
        let within = if self.gyro.is_some() { RATE_WITHIN } else { RATE_WITHIN_ALONE };
        if (hz / rate_hz - 1.0).abs() > within {
            let what = format!("the {} has no rate near {rate_hz} Hz", self.name);
            return Err(Fault::new(FaultKind::Config, "imu.rate_hz", what, format!("the next is {hz:.1}")));
        }
        let setting = Setting {
            rate,
            accel: range(self.accel.as_ref(), accel_g, "imu.accel_range_g", self.name)?.1,
            gyro: range(self.gyro.as_ref(), gyro_dps, "imu.gyro_range_dps", self.name)?.1,
            spi: false,
            data_ready: false,
        };
        Ok((setting, hz))
    }
}

impl Sense {
    pub fn range(&self, code: u8) -> (f64, f64) {
        let found = self.ranges.iter().find(|r| r.1 == code);
        let (full, _, per_lsb) = *found.expect("codes of ranges come from the table");
        (full, per_lsb)
    }
}

fn range(sense: Option<&Sense>, asked: f64, key: &str, name: &str) -> Result<(f64, u8), Fault> {
    let Some(sense) = sense else { return Ok((0.0, 0)) };
    let fitting = sense.ranges.iter().filter(|r| r.0 >= asked).min_by(|a, b| a.0.total_cmp(&b.0));
    fitting.map(|r| (r.0, r.1)).ok_or_else(|| {
        let has = sense.ranges.iter().map(|r| r.0.to_string()).collect::<Vec<_>>().join(", ");
        Fault::new(FaultKind::Config, key, format!("the {name} does not reach {asked}"), format!("choose one of {has}"))
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn every_chip_has_both_sensors_the_gyro_first() {
        for chip in CHIPS {
            let both = |f: fn(&Die) -> bool| chip.dies.iter().filter(|d| f(d)).count();
            assert_eq!((both(|d| d.accel.is_some()), both(|d| d.gyro.is_some())), (1, 1), "{}", chip.name);
            assert!(chip.dies[0].gyro.is_some(), "{}", chip.name);
        }
    }

    #[test]
    fn tables_are_in_order_and_their_codes_are_distinct() {
        for die in CHIPS.iter().flat_map(|c| c.dies) {
            for sense in [&die.accel, &die.gyro].into_iter().flatten() {
                for (i, a) in sense.ranges.iter().enumerate() {
                    // A step times 2^15 is full scale, or a little more.
                    let part = a.2 * 32768.0 / a.0;
                    assert!((0.99..1.15).contains(&part), "{}: {part}", die.name);
                    assert!(sense.ranges[..i].iter().all(|b| b.0 < a.0 && b.1 != a.1), "{}", die.name);
                }
            }
            assert!(die.fifo.full <= die.fifo.capacity && die.fifo.capacity < super::super::bus::TRANSFER_MAX);
        }
    }

    #[test]
    fn the_nearest_rate_and_the_smallest_range_that_holds_are_chosen() {
        let die = &Chip::named("mpu-9250").unwrap().dies[0];
        assert_eq!(die.setting(200.0, 8.0, 1000.0).unwrap().1, 200.0);
        assert!((die.setting(210.0, 8.0, 1000.0).unwrap().1 - 200.0).abs() < 1e-9);
        let (setting, _) = die.setting(200.0, 5.0, 600.0).unwrap();
        assert_eq!(die.accel.as_ref().unwrap().range(setting.accel).0, 8.0);
        assert_eq!(die.gyro.as_ref().unwrap().range(setting.gyro).0, 1000.0);
        let bmi088 = &Chip::named("bmi088").unwrap().dies[1];
        let (setting, _) = bmi088.setting(400.0, 16.0, 1000.0).unwrap();
        assert_eq!(bmi088.accel.as_ref().unwrap().range(setting.accel).0, 24.0);
    }

    #[test]
    fn what_no_chip_or_range_or_rate_holds_is_refused_with_what_there_is() {
        let fault = Chip::named("bno055").map(|_| ()).unwrap_err();
        assert!(fault.to_string().contains("lsm6dsox") && fault.to_string().contains("iio"), "{fault}");
        let die = &Chip::named("lsm6dsox").unwrap().dies[0];
        let line = |rate, accel, gyro| die.setting(rate, accel, gyro).map(|_| ()).unwrap_err().to_string();
        assert!(line(300.0, 8.0, 500.0).contains("imu.rate_hz"), "{}", line(300.0, 8.0, 500.0));
        assert!(line(208.0, 32.0, 500.0).contains("2, 4, 8, 16"));
        assert!(line(208.0, 8.0, 4000.0).contains("imu.gyro_range_dps"));
    }
}
