//! Why an inertial unit gives no samples: the one error of this module while it runs. At boot it becomes a `Fault`.

use super::bus::BusFault;
use super::chips::Reg;
use crate::source::SourceFault;
use crate::{Fault, FaultKind};

/// Why a die, or a unit, gives no samples now.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ImuError {
    Bus(BusFault),
    /// WHO_AM_I answered this, which is another chip.
    WrongChip(u8),
    /// This sensor gave the same value, to the bit, too often in a row.
    Frozen(&'static str),
    /// It answers, and gave no sample for too long.
    Silent,
    /// A register did not come to its value in time: the register, and the value it has.
    Stuck(Reg, u8),
    /// The FIFO says that it holds so many bytes, more than it can.
    BadCount(usize),
    /// The FIFO filled up: samples are lost, and it was cleared.
    Overflow,
    /// The BMI270 has no configuration file to be sent.
    NoConfiguration,
    /// The BMI270 does not run its configuration file: its INTERNAL_STATUS.
    BadConfiguration(u8),
    /// The self-test of this sensor or axis answered this, which is out of bounds.
    SelfTest(&'static str, f64),
}

impl ImuError {
    /// The fault of a die that does not start, at boot.
    pub fn at_start(self, place: &str, die: &str) -> Fault {
        let fix = match self {
            ImuError::Bus(BusFault::Nack) => "check wiring, supply and imu.address (i2cdetect shows what answers)",
            ImuError::WrongChip(_) => {
                "set imu.chip to what is there, or check the wiring, by SPI that of the chip select"
            }
            ImuError::NoConfiguration => {
                "set imu.configuration to a file of the 8192 bytes of bmi270_config_file, from Bosch's \
                 BMI270_SensorAPI: it is Bosch's program and does not come with this one"
            }
            ImuError::BadConfiguration(_) => {
                "check that imu.configuration holds bmi270_config_file as it stands in Bosch's BMI270_SensorAPI, then \
                 the wiring"
            }
            ImuError::SelfTest(..) => {
                "keep the board still while it starts, or set imu.self_test = false and expect bad data"
            }
            _ => "check wiring and supply, then power the unit off and on",
        };
        Fault::new(FaultKind::Unavailable, place, format!("the {die} does not start: {self}"), fix)
    }

    /// The fault of a unit that was lost during a run.
    pub fn lost(self, place: &str) -> SourceFault {
        let what = format!("the inertial unit is lost: {self}");
        let fix = "check cable, supply and the kernel's log; it is looked for again and again";
        SourceFault::Lost(Fault::new(FaultKind::Unavailable, place, what, fix))
    }
}

impl From<BusFault> for ImuError {
    fn from(fault: BusFault) -> ImuError {
        ImuError::Bus(fault)
    }
}

impl std::fmt::Display for ImuError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            ImuError::Bus(fault) => write!(f, "{fault}"),
            ImuError::WrongChip(id) => write!(f, "WHO_AM_I answers {id:#04x}, which is another chip"),
            ImuError::Frozen(sensor) => write!(f, "its {sensor} gives the same value again and again"),
            ImuError::Silent => write!(f, "it answers but gives no samples"),
            ImuError::Stuck(register, value) => write!(f, "register {register:#04x} stays at {value:#04x}"),
            ImuError::BadCount(bytes) => write!(f, "its FIFO claims to hold {bytes} bytes"),
            ImuError::Overflow => write!(f, "its FIFO overflowed"),
            ImuError::NoConfiguration => write!(f, "it needs its configuration file"),
            ImuError::BadConfiguration(status) => {
                write!(f, "it does not run its configuration file: INTERNAL_STATUS is {status:#04x}")
            }
            ImuError::SelfTest(sensor, value) => write!(f, "the self-test of {sensor} answers {value:.2}"),
        }
    }
}
