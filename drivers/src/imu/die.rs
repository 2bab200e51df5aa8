//! One die behind its bus: brought up, asked who it is, and its FIFO read in bursts. Nothing here waits for samples or
//! knows of time; `unit` does.

use super::bus::{Bus, BusFault, TRANSFER_MAX};
use super::chips::{self, Reg, Step, TemperatureFrom};
use super::frames::{triple, Parsed, Parser, Raw};
use crate::types::{Nanos, Span};

/// Why a die gives no samples now.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Trouble {
    Bus(BusFault),
    /// WHO_AM_I answered this.
    Stranger(u8),
    /// So many samples were the same to the bit.
    Frozen(&'static str),
    /// No sample for longer than the unit may take.
    Silent,
    /// A register did not come to its value in time.
    Stuck(Reg, u8),
    /// The FIFO says it holds more than it can.
    Garbage(usize),
    /// It filled up: samples are lost, and it was cleared.
    Overflow,
    NoConfiguration,
    /// The BMI270 does not run its configuration file: its INTERNAL_STATUS.
    BadConfiguration(u8),
    /// An axis answered its self-test with this, which is out of bounds.
    SelfTest(&'static str, f64),
}

impl From<BusFault> for Trouble {
    fn from(fault: BusFault) -> Trouble {
        Trouble::Bus(fault)
    }
}

impl std::fmt::Display for Trouble {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Trouble::Bus(fault) => write!(f, "{fault}"),
            Trouble::Stranger(id) => write!(f, "WHO_AM_I answers {id:#04x}, which is another chip"),
            Trouble::Frozen(which) => write!(f, "its {which} gives the same value again and again"),
            Trouble::Silent => write!(f, "it answers but gives no samples"),
            Trouble::Stuck(register, value) => write!(f, "register {register:#04x} stays at {value:#04x}"),
            Trouble::Garbage(bytes) => write!(f, "its FIFO claims to hold {bytes} bytes"),
            Trouble::Overflow => write!(f, "its FIFO overflowed"),
            Trouble::NoConfiguration => write!(f, "it needs its configuration file"),
            Trouble::BadConfiguration(status) => {
                write!(f, "it does not run its configuration file: INTERNAL_STATUS is {status:#04x}")
            }
            Trouble::SelfTest(axis, value) => write!(f, "self-test of {axis} answers {value:.2}"),
        }
    }
}

/// The two instants that the FIFO was counted between, and what its frames said.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Burst {
    pub before: Nanos,
    pub after: Nanos,
    pub parsed: Parsed,
}

pub struct Die<B: Bus> {
    pub bus: B,
    pub chip: &'static chips::Die,
    plan: Vec<Step>,
    /// The BMI270's configuration file.
    upload: Vec<u8>,
    bank: Option<u8>,
    parser: Parser,
    buffer: Box<[u8; TRANSFER_MAX]>,
    cross_axis: i32,
}

/// Bytes of one write of the configuration file; an even number.
const UPLOAD_CHUNK: usize = 32;

impl<B: Bus> Die<B> {
    pub fn new(bus: B, chip: &'static chips::Die, setting: &chips::Setting, upload: Vec<u8>) -> Die<B> {
        let (plan, parser) = ((chip.configure)(setting), Parser::new(chip.fifo.layout));
        Die { bus, chip, plan, upload, bank: None, parser, buffer: Box::new([0; TRANSFER_MAX]), cross_axis: 0 }
    }

    fn select(&mut self, register: Reg) -> Result<u8, BusFault> {
        let [bank, address] = register.to_be_bytes();
        if let Some((select, shift)) = self.chip.bank_select.filter(|_| self.bank != Some(bank)) {
            // Unknown until the write went through.
            self.bank = None;
            self.bus.write(select, &[bank << shift])?;
            self.bank = Some(bank);
        }
        Ok(address)
    }

    pub fn read_into(&mut self, register: Reg, into: &mut [u8]) -> Result<(), BusFault> {
        let address = self.select(register)?;
        self.bus.read(address, into)
    }

    pub fn read_byte(&mut self, register: Reg) -> Result<u8, BusFault> {
        let mut byte = [0];
        self.read_into(register, &mut byte)?;
        Ok(byte[0])
    }

    pub fn write(&mut self, register: Reg, value: u8) -> Result<(), BusFault> {
        let address = self.select(register)?;
        self.bus.write(address, &[value])
    }

    pub fn run(&mut self, steps: &[Step]) -> Result<(), Trouble> {
        steps.iter().try_for_each(|step| self.step(*step))
    }

    fn step(&mut self, step: Step) -> Result<(), Trouble> {
        match step {
            Step::Write(register, value) => Ok(self.write(register, value)?),
            Step::Change(register, clear, set) => {
                let value = self.read_byte(register)?;
                Ok(self.write(register, value & !clear | set)?)
            }
            Step::WaitUs(us) => {
                self.bus.sleep(Span(i64::from(us) * 1000));
                Ok(())
            }
            Step::Touch(register) => {
                // The answer does not matter, nor that there is none: what follows will tell.
                let _ = self.read_byte(register);
                Ok(())
            }
            Step::Upload => self.upload(),
        }
    }

    pub fn expect(&mut self, register: Reg, mask: u8, value: u8, ms: u32) -> Result<(), Trouble> {
        for _ in 0..=ms {
            if self.read_byte(register)? & mask == value {
                return Ok(());
            }
            self.bus.sleep(Span(1_000_000));
        }
        Err(Trouble::Stuck(register, self.read_byte(register)?))
    }

    /// BMI270, "Device initialisation": INIT_CTRL off, the file through INIT_DATA in chunks whose word number stands
    /// in INIT_ADDR_0 and 1, INIT_CTRL on, and within 150 ms it says whether it runs.
    fn upload(&mut self) -> Result<(), Trouble> {
        const INIT_CTRL: Reg = 0x59;
        const INIT_ADDR_0: u8 = 0x5B;
        const INIT_DATA: u8 = 0x5E;
        const INTERNAL_STATUS: Reg = 0x21;
        if self.upload.is_empty() {
            return Err(Trouble::NoConfiguration);
        }
        self.write(INIT_CTRL, 0)?;
        for (i, chunk) in self.upload.chunks(UPLOAD_CHUNK).enumerate() {
            let word = i * UPLOAD_CHUNK / 2;
            self.bus.write(INIT_ADDR_0, &[(word & 0x0F) as u8, (word >> 4) as u8])?;
            self.bus.write(INIT_DATA, chunk)?;
        }
        self.write(INIT_CTRL, 1)?;
        self.expect(INTERNAL_STATUS, 0x0F, 0x01, 150).map_err(|trouble| match trouble {
            Trouble::Stuck(_, status) => Trouble::BadConfiguration(status),
            trouble => trouble,
        })
    }

    /// Resets it and asks who it is.
    pub fn wake(&mut self) -> Result<(), Trouble> {
        self.bank = None;
        // Who it is comes first: another chip at this address must not be written to. It may be asleep in SPI's
        // other mode, so that the first answer is not to be believed.
        let _ = self.read_byte(self.chip.who);
        self.identify()?;
        self.bank = None;
        // A write that resets may go unanswered.
        let reset = self.chip.reset;
        if let Some((first, rest)) = reset.split_first() {
            let _ = self.step(*first);
            self.bank = None;
            self.run(rest)?;
        }
        self.identify()
    }

    fn identify(&mut self) -> Result<(), Trouble> {
        let id = self.read_byte(self.chip.who)?;
        if self.chip.who_answers.contains(&id) {
            Ok(())
        } else {
            Err(Trouble::Stranger(id))
        }
    }

    /// From whatever state to an empty FIFO that fills.
    pub fn start(&mut self) -> Result<(), Trouble> {
        self.wake()?;
        let plan = std::mem::take(&mut self.plan);
        let done = self.run(&plan);
        self.plan = plan;
        done?;
        self.parser.reset();
        if let Some(register) = self.chip.cross_axis {
            // Seven bits, signed.
            self.cross_axis = i32::from((self.read_byte(register)? << 1) as i8 >> 1);
        }
        Ok(())
    }

    pub fn clear(&mut self) -> Result<(), Trouble> {
        self.parser.reset();
        self.run(self.chip.fifo.reset)
    }

    /// Appends what the FIFO holds. On `Overflow` it was cleared, and holds what came since.
    pub fn burst(&mut self, out: &mut Vec<Raw>) -> Result<Burst, Trouble> {
        let fifo = &self.chip.fifo;
        let before = self.bus.now();
        let mut count = [0; 2];
        self.read_into(fifo.count, &mut count[..fifo.count_bytes])?;
        let after = self.bus.now();
        let words = if fifo.count_big_endian { u16::from_be_bytes(count) } else { u16::from_le_bytes(count) };
        let bytes = usize::from(words & fifo.count_mask) * fifo.unit;
        if bytes > fifo.capacity {
            return Err(Trouble::Garbage(bytes));
        }
        if bytes >= fifo.full || words & fifo.overrun != 0 {
            self.clear()?;
            return Err(Trouble::Overflow);
        }
        let whole = match fifo.layout {
            // Frames of several lengths: all of it, or the die would begin in the middle of one.
            chips::Layout::Bosch { .. } => bytes,
            layout => bytes - bytes % layout.frame(),
        };
        let mut parsed = Parsed::default();
        if whole > 0 {
            let address = self.select(fifo.data)?;
            self.bus.read(address, &mut self.buffer[..whole])?;
            let first = out.len();
            parsed = self.parser.parse(&self.buffer[..whole], out);
            self.compensate(&mut out[first..]);
        }
        Ok(Burst { before, after, parsed })
    }

    fn compensate(&self, samples: &mut [Raw]) {
        if self.cross_axis == 0 {
            return;
        }
        for gyro in samples.iter_mut().filter_map(|s| s.gyro.as_mut()) {
            let x = i32::from(gyro[0]) - self.cross_axis * i32::from(gyro[2]) / 512;
            gyro[0] = x.clamp(i32::from(i16::MIN), i32::from(i16::MAX)) as i16;
        }
    }

    /// The newest sample of one sensor, from its registers.
    pub fn newest(&mut self, sense: &chips::Sense) -> Result<[i16; 3], BusFault> {
        let mut bytes = [0; 6];
        self.read_into(sense.data, &mut bytes)?;
        Ok(triple(&bytes, 0, sense.big_endian))
    }

    /// What has to be asked for apart from the FIFO.
    pub fn temperature(&mut self) -> Result<Option<f32>, BusFault> {
        let mut word = [0; 2];
        let (word, shift) = match self.chip.temperature.from {
            TemperatureFrom::Nowhere | TemperatureFrom::Frames => return Ok(None),
            TemperatureFrom::Word(register) => {
                self.read_into(register, &mut word)?;
                (i16::from_le_bytes(word), 0)
            }
            TemperatureFrom::Eleven(register) => {
                self.read_into(register, &mut word)?;
                // Two's complement of eleven bits.
                (i16::from_be_bytes(word), 5)
            }
        };
        // Both of Bosch's say so of a temperature that is not known yet.
        Ok((word != i16::MIN).then(|| self.celsius(word >> shift)))
    }

    pub fn celsius(&self, raw: i16) -> f32 {
        let t = &self.chip.temperature;
        (f64::from(raw) * t.c_per_lsb + t.c_at_zero) as f32
    }
}
