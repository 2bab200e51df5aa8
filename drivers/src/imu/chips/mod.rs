//! The inertial units that are driven by their registers, as tables: what answers to WHO_AM_I, the codes of ranges and
//! rates, where the data stand, how the FIFO frames them, and how the unit tests itself. Every fact is from the data sheet
//! named beside it, with the register or the title of the section. "Checked against" names the open drivers that were
//! compared with the table, and which facts fewer than two of them confirm. No table has met its chip yet.
//!
//! Input is what a board file asks for (chip, rate, ranges), output a `DieSpec` with the codes that set it. A unit is one
//! die with both sensors, or two dies with one each (BMI088), which run on clocks of their own. All that talks to a die is
//! in `die`, `frames` and `self_test`; a table holds no code but the list of writes that configures its chip.

mod bosch;
mod invensense;
mod st;

use crate::{Fault, FaultKind};

/// The units that are driven, by the names that board files use.
pub const CHIPS: &[Chip] = &[
    Chip { name: "bmi088", dies: &[bosch::BMI088_GYRO, bosch::BMI088_ACCEL] },
    Chip { name: "bmi270", dies: &[bosch::BMI270] },
    Chip { name: "icm-42688-p", dies: &[invensense::ICM_42688_P] },
    Chip { name: "icm-20948", dies: &[invensense::ICM_20948] },
    Chip { name: "lsm6dsox", dies: &[st::LSM6DSOX] },
    Chip { name: "mpu-9250", dies: &[invensense::MPU_9250] },
    Chip { name: "mpu-6500", dies: &[invensense::MPU_6500] },
];

/// An inertial unit.
pub struct Chip {
    /// The name in board files.
    pub name: &'static str,
    /// One or two; the one with the gyro first, whose samples set the times of both.
    pub dies: &'static [DieSpec],
}

impl Chip {
    /// The unit of a name; a fault lists those that there are.
    pub fn named(name: &str) -> Result<&'static Chip, Fault> {
        CHIPS.iter().find(|c| c.name == name).ok_or_else(|| {
            let known = CHIPS.iter().map(|c| c.name).collect::<Vec<_>>().join(", ");
            let fix = format!("choose one of {known}, or `iio` for a unit that the kernel drives");
            Fault::new(FaultKind::Config, "imu.chip", format!("`{name}` is not driven"), fix)
        })
    }
}

/// A register's address, its bank in the high byte.
pub type Reg = u16;

/// Register `address` of a bank.
pub const fn banked(bank: u8, address: u8) -> Reg {
    (bank as Reg) << 8 | address as Reg
}

/// What there is to know of one die.
pub struct DieSpec {
    /// The name in messages.
    pub name: &'static str,
    /// WHO_AM_I, and its possible answers.
    pub who: Reg,
    /// Answers to WHO_AM_I that mean this die.
    pub who_answers: &'static [u8],
    /// The register that selects a bank, and the shift of the bank's number in it.
    pub bank_select: Option<(u8, u32)>,
    /// Bytes between address and data of a read by SPI.
    pub spi_dummy: usize,
    /// Byte order of all words.
    pub big_endian: bool,
    /// The accelerometer, if it has one.
    pub accel: Option<SensorSpec>,
    /// The gyro, if it has one.
    pub gyro: Option<SensorSpec>,
    /// Rates of its sensors, which share one.
    pub rates: Rates,
    /// Its thermometer.
    pub temperature: Temperature,
    /// Its queue of samples.
    pub fifo: Fifo,
    /// Steps from any state to a known idle one; WHO_AM_I is read after them.
    pub reset: &'static [Step],
    /// Steps from there to sampling into the FIFO.
    pub configure: fn(&Setting) -> Vec<Step>,
    /// The part of the gyro's z that is in its x, in 1/512, seven bits (BMI270).
    pub cross_axis: Option<Reg>,
    /// Tests that it makes of itself, in this order.
    pub self_tests: &'static [SelfTest],
}

/// One of the two sensors of a die.
pub struct SensorSpec {
    /// In rising order.
    pub ranges: &'static [Range],
    /// Where the newest sample stands: three words.
    pub data: Reg,
}

/// A range of a sensor: full scale, its code, and the size of a step. Accelerometers in g, gyros in °/s.
pub struct Range {
    /// Largest magnitude, in the sensor's unit.
    pub full_scale: f64,
    /// Code that sets the range.
    pub code: u8,
    /// Size of a step, in the sensor's unit.
    pub per_lsb: f64,
}

/// A range whose full scale is 2^15 steps.
const fn range(full_scale: f64, code: u8) -> Range {
    Range { full_scale, code, per_lsb: full_scale / 32768.0 }
}

/// Ranges that several units share.
const ACCEL_2_TO_16: &[Range] = &[range(2.0, 0), range(4.0, 1), range(8.0, 2), range(16.0, 3)];
const GYRO_125_TO_2000: &[Range] =
    &[range(125.0, 4), range(250.0, 3), range(500.0, 2), range(1000.0, 1), range(2000.0, 0)];

impl SensorSpec {
    /// The range of a code that came from this table.
    pub fn range(&self, code: u8) -> &Range {
        self.ranges.iter().find(|r| r.code == code).expect("codes of ranges come from the table")
    }
}

/// Sample rates, Hz.
pub enum Rates {
    /// Each rate with its code.
    Listed(&'static [(f64, u8)]),
    /// `base_hz / (1 + code)`.
    Divided { base_hz: f64, code_max: u8 },
}

impl Rates {
    /// The rate nearest to `hz`, by ratio, and its code.
    pub fn nearest(&self, hz: f64) -> (f64, u8) {
        match *self {
            Rates::Listed(rates) => {
                let distance = |rate: &&(f64, u8)| (rate.0 / hz).ln().abs();
                let nearest = rates.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
                *nearest.expect("tables are not empty")
            }
            Rates::Divided { base_hz, code_max } => {
                let code = (base_hz / hz - 1.0).round().clamp(0.0, f64::from(code_max));
                (base_hz / (1.0 + code), code as u8)
            }
        }
    }
}

/// The temperature of a die: °C = raw * c_per_lsb + c_at_zero.
pub struct Temperature {
    /// Where the raw value stands.
    pub from: TemperatureSource,
    /// °C of a step.
    pub c_per_lsb: f64,
    /// °C at a raw value of 0.
    pub c_at_zero: f64,
}

/// Where a die's temperature stands.
pub enum TemperatureSource {
    Nowhere,
    /// In the frames of the FIFO.
    Frames,
    /// In a word of its own.
    Word(Reg),
    /// In 11 bits, high byte first, the low bits on top of the second (BMI088).
    ElevenBits(Reg),
}

/// A die's FIFO.
pub struct Fifo {
    /// Where the count stands: a word (a byte where `count_bytes` is 1), masked by `count_mask`.
    pub count: Reg,
    pub count_bytes: usize,
    /// Bits of the word that are the count.
    pub count_mask: u16,
    /// Bits beside the count that say that samples were lost; 0: none do.
    pub overrun: u16,
    /// Bytes that one count stands for.
    pub unit: usize,
    /// The register that gives the content, byte after byte.
    pub data: Reg,
    /// Bytes.
    pub capacity: usize,
    /// Bytes from which on the next sample is refused or overwrites the oldest: the content is of no use then.
    pub full: usize,
    /// How samples stand in the bytes.
    pub layout: Layout,
    /// Steps that empty it.
    pub reset: &'static [Step],
}

/// How a FIFO frames its samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// Frames of one length; byte at which each triple, and the temperature's word, begins.
    Plain { len: usize, accel: Option<usize>, gyro: Option<usize>, temperature: Option<usize> },
    /// Packet 3 of the ICM-42688-P: a header, both triples, a byte of temperature, a time.
    Packet3,
    /// Frames with a header each; `config` bytes follow the one that says that the configuration changed.
    Bosch { config: usize },
    /// Seven bytes for each sensor: a tag, then three values.
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

/// How a die is to be set, in its own codes.
#[derive(Clone, Copy, Debug)]
pub struct Setting {
    /// Code of the rate.
    pub rate: u8,
    /// Code of the accelerometer's range.
    pub accel: u8,
    /// Code of the gyro's range.
    pub gyro: u8,
    /// It is wired by SPI: its I2C interface is turned off.
    pub spi: bool,
    /// Drive the data-ready line.
    pub data_ready: bool,
}

/// One access to a die's registers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    Write(Reg, u8),
    /// Clears the first bits, then sets the second, and keeps the rest.
    Change(Reg, u8, u8),
    WaitUs(u32),
    /// A read whose answer does not matter: it wakes the interface up.
    Touch(Reg),
    /// Sends the BMI270's configuration file and waits until it runs.
    Upload,
}

/// A test that a die makes of one of its sensors while the board stands still.
pub enum SelfTest {
    /// The proof mass is deflected by a known force, and the answer must lie within stated limits.
    Excitation(ExcitationTest),
    /// The same, and the answer is compared with that at the factory (InvenSense).
    Factory(FactoryTest),
    /// The die tests itself and says whether all is well (Bosch's gyros).
    BuiltIn(BuiltInTest),
}

/// The newest sample with the force on less that with it off, in g or °/s, must lie `within` on each axis.
pub struct ExcitationTest {
    /// The sensor under test.
    pub sensor: Sensor,
    /// Steps before the test.
    pub prepare: &'static [Step],
    /// Steps that turn the force on, and wait.
    pub on: &'static [Step],
    /// Steps that turn it off, and wait.
    pub off: &'static [Step],
    /// Size of a step at the range that `prepare` sets, in the sensor's unit.
    pub per_lsb: f64,
    /// Least and largest answer of each axis.
    pub within: [(f64, f64); 3],
}

/// The answer, in steps, is compared with the factory's, which was `FACTORY_BASE * 1.01^(code - 1)` steps.
pub struct FactoryTest {
    /// The sensor under test.
    pub sensor: Sensor,
    /// Steps before the test.
    pub prepare: &'static [Step],
    /// Register that turns the force on by this value, and off by zero.
    pub switch: (Reg, u8),
    /// First of three registers with the codes of the axes.
    pub codes: Reg,
    /// Answer over that at the factory.
    pub ratio: (f64, f64),
    /// Answer, steps, of a die of which the factory left no codes.
    pub uncoded: (f64, f64),
    pub settle_us: u32,
}

/// The die is triggered and answers in a register.
pub struct BuiltInTest {
    /// The sensor under test.
    pub sensor: Sensor,
    /// Steps before the test.
    pub prepare: &'static [Step],
    /// Register and value that start it.
    pub trigger: (Reg, u8),
    /// The register that answers.
    pub answer: Reg,
    /// Bit of the answer that says that it is done.
    pub done: u8,
    /// Bits of the answer that say how it went, and their value if all is well.
    pub verdict: u8,
    /// Value of these bits if all is well.
    pub good: u8,
}

/// Which of a die's sensors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sensor {
    Accel,
    Gyro,
}

/// How far, by ratio, the nearest rate may be from the one asked for; an accelerometer's of its own, whose samples are
/// brought to the gyro's times anyway, may be further.
const RATE_WITHIN: f64 = 0.1;
const RATE_WITHIN_ALONE: f64 = 0.25;

impl DieSpec {
    /// The setting nearest to what is asked for, and its rate, Hz: the nearest rate, and the smallest ranges that hold
    /// `accel_g` and `gyro_dps`. A fault where the die has none near enough, or that holds them.
    pub fn setting(&self, rate_hz: f64, accel_g: f64, gyro_dps: f64) -> Result<(Setting, f64), Fault> {
        let (hz, rate) = self.rates.nearest(rate_hz);
        let within = if self.gyro.is_some() { RATE_WITHIN } else { RATE_WITHIN_ALONE };
        if (hz / rate_hz - 1.0).abs() > within {
            let what = format!("the {} has no rate near {rate_hz} Hz", self.name);
            return Err(Fault::new(FaultKind::Config, "imu.rate_hz", what, format!("the nearest is {hz:.1}")));
        }
        let accel = self.smallest_range(&self.accel, accel_g, "imu.accel_range_g")?;
        let gyro = self.smallest_range(&self.gyro, gyro_dps, "imu.gyro_range_dps")?;
        Ok((Setting { rate, accel, gyro, spi: false, data_ready: false }, hz))
    }

    /// The code of the smallest range that holds what is asked for; 0 where there is no such sensor.
    fn smallest_range(&self, sensor: &Option<SensorSpec>, asked: f64, key: &str) -> Result<u8, Fault> {
        let Some(sensor) = sensor else { return Ok(0) };
        let smallest = sensor.ranges.iter().find(|r| r.full_scale >= asked);
        smallest.map(|r| r.code).ok_or_else(|| {
            let has = sensor.ranges.iter().map(|r| r.full_scale.to_string()).collect::<Vec<_>>().join(", ");
            let what = format!("the {} does not reach {asked}", self.name);
            Fault::new(FaultKind::Config, key, what, format!("choose one of {has}"))
        })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn every_chip_has_both_sensors_the_gyro_first() {
        for chip in CHIPS {
            let both = |f: fn(&DieSpec) -> bool| chip.dies.iter().filter(|d| f(d)).count();
            assert_eq!((both(|d| d.accel.is_some()), both(|d| d.gyro.is_some())), (1, 1), "{}", chip.name);
            assert!(chip.dies[0].gyro.is_some(), "{}", chip.name);
        }
    }

    #[test]
    fn tables_are_in_order_and_their_codes_are_distinct() {
        for die in CHIPS.iter().flat_map(|c| c.dies) {
            for sensor in [&die.accel, &die.gyro].into_iter().flatten() {
                for (i, a) in sensor.ranges.iter().enumerate() {
                    // A step times 2^15 is full scale, or a little more.
                    let part = a.per_lsb * 32768.0 / a.full_scale;
                    assert!((0.99..1.15).contains(&part), "{}: {part}", die.name);
                    let before = &sensor.ranges[..i];
                    assert!(before.iter().all(|b| b.full_scale < a.full_scale && b.code != a.code), "{}", die.name);
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
        assert_eq!(die.accel.as_ref().unwrap().range(setting.accel).full_scale, 8.0);
        assert_eq!(die.gyro.as_ref().unwrap().range(setting.gyro).full_scale, 1000.0);
        let bmi088 = &Chip::named("bmi088").unwrap().dies[1];
        let (setting, _) = bmi088.setting(400.0, 16.0, 1000.0).unwrap();
        assert_eq!(bmi088.accel.as_ref().unwrap().range(setting.accel).full_scale, 24.0);
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
