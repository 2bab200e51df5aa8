//! One die behind its bus: resets and configures it, and reads its FIFO in bursts. Input is a table (`chips`), output raw
//! counts (`frames::Raw`) with the two instants between which the FIFO was counted. Nothing here waits for samples or
//! stamps them; `unit` does.

use super::bus::{Bus, BusFault, TRANSFER_MAX};
use super::chips::{DieSpec, Layout, Reg, SensorSpec, Setting, Step, TemperatureSource};
use super::error::ImuError;
use super::frames::{triple, Parsed, Parser, Raw};
use crate::types::{Nanos, Span};

/// A die and its bus.
pub struct Die {
    /// The wires to it, and the clock it is read by.
    pub bus: Box<dyn Bus>,
    /// The table of its chip.
    pub spec: &'static DieSpec,
    /// Steps from idle to sampling.
    configure: Vec<Step>,
    /// The BMI270's configuration file; empty for other chips.
    upload: Vec<u8>,
    /// The bank that is selected; `None`: unknown.
    bank: Option<u8>,
    parser: Parser,
    buffer: Box<[u8; TRANSFER_MAX]>,
    /// The part of the gyro's z that is in its x, in 1/512.
    cross_axis: i32,
}

/// A burst: the FIFO was counted between two instants, and `parsed` says what it held beside samples.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Burst {
    /// Instant before the count was read.
    pub before: Nanos,
    /// Instant after the count was read.
    pub after: Nanos,
    /// What the burst held beside samples.
    pub parsed: Parsed,
}

/// Bytes of one write of the configuration file; an even number.
const UPLOAD_CHUNK: usize = 32;

impl Die {
    /// A die that is not started yet; `upload` is its configuration file, empty where it needs none.
    pub fn new(bus: Box<dyn Bus>, spec: &'static DieSpec, setting: &Setting, upload: Vec<u8>) -> Die {
        let (configure, parser) = ((spec.configure)(setting), Parser::new(spec.fifo.layout, spec.big_endian));
        Die { bus, spec, configure, upload, bank: None, parser, buffer: Box::new([0; TRANSFER_MAX]), cross_axis: 0 }
    }

    /// Selects the register's bank; answers its address there.
    fn select(&mut self, register: Reg) -> Result<u8, BusFault> {
        let [bank, address] = register.to_be_bytes();
        if let Some((select, shift)) = self.spec.bank_select.filter(|_| self.bank != Some(bank)) {
            // Unknown until the write went through.
            self.bank = None;
            self.bus.write(select, &[bank << shift])?;
            self.bank = Some(bank);
        }
        Ok(address)
    }

    fn read_into(&mut self, register: Reg, into: &mut [u8]) -> Result<(), BusFault> {
        let address = self.select(register)?;
        self.bus.read(address, into)
    }

    /// Reads one register; fails as the bus does.
    pub fn read_byte(&mut self, register: Reg) -> Result<u8, BusFault> {
        let mut byte = [0];
        self.read_into(register, &mut byte)?;
        Ok(byte[0])
    }

    /// Writes one register; fails as the bus does.
    pub fn write(&mut self, register: Reg, value: u8) -> Result<(), BusFault> {
        let address = self.select(register)?;
        self.bus.write(address, &[value])
    }

    /// Takes steps in order, up to the first that fails.
    pub fn run(&mut self, steps: &[Step]) -> Result<(), ImuError> {
        steps.iter().try_for_each(|step| self.step(*step))
    }

    fn step(&mut self, step: Step) -> Result<(), ImuError> {
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

    /// Waits until the masked bits of a register have a value, `ms` at most.
    pub fn expect(&mut self, register: Reg, mask: u8, value: u8, ms: u32) -> Result<(), ImuError> {
        for _ in 0..=ms {
            if self.read_byte(register)? & mask == value {
                return Ok(());
            }
            self.bus.sleep(Span(1_000_000));
        }
        Err(ImuError::Stuck(register, self.read_byte(register)?))
    }

    /// Sends the BMI270 its configuration file ("Device initialisation"): INIT_CTRL off, the file through INIT_DATA in
    /// chunks whose word number stands in INIT_ADDR_0 and 1, INIT_CTRL on; within 150 ms it says whether it runs.
    fn upload(&mut self) -> Result<(), ImuError> {
        const INIT_CTRL: Reg = 0x59;
        const INIT_ADDR_0: u8 = 0x5B;
        const INIT_DATA: u8 = 0x5E;
        const INTERNAL_STATUS: Reg = 0x21;
        if self.upload.is_empty() {
            return Err(ImuError::NoConfiguration);
        }
        self.write(INIT_CTRL, 0)?;
        for (i, chunk) in self.upload.chunks(UPLOAD_CHUNK).enumerate() {
            let word = i * UPLOAD_CHUNK / 2;
            self.bus.write(INIT_ADDR_0, &[(word & 0x0F) as u8, (word >> 4) as u8])?;
            self.bus.write(INIT_DATA, chunk)?;
        }
        self.write(INIT_CTRL, 1)?;
        self.expect(INTERNAL_STATUS, 0x0F, 0x01, 150).map_err(|error| match error {
            ImuError::Stuck(_, status) => ImuError::BadConfiguration(status),
            error => error,
        })
    }

    /// Resets the die to idle and checks which chip it is.
    pub fn wake(&mut self) -> Result<(), ImuError> {
        self.bank = None;
        // Which chip it is comes first: another chip at this address must not be written to. It may be asleep in SPI's
        // other mode, so the first answer is not believed.
        let _ = self.read_byte(self.spec.who);
        self.identify()?;
        self.bank = None;
        // A write that resets may go unanswered.
        if let Some((first, rest)) = self.spec.reset.split_first() {
            let _ = self.step(*first);
            self.bank = None;
            self.run(rest)?;
        }
        self.identify()
    }

    fn identify(&mut self) -> Result<(), ImuError> {
        let id = self.read_byte(self.spec.who)?;
        if self.spec.who_answers.contains(&id) {
            Ok(())
        } else {
            Err(ImuError::WrongChip(id))
        }
    }

    /// Brings the die from whatever state to sampling into an empty FIFO.
    pub fn start(&mut self) -> Result<(), ImuError> {
        self.wake()?;
        let steps = std::mem::take(&mut self.configure);
        let done = self.run(&steps);
        self.configure = steps;
        done?;
        self.clear()?;
        if let Some(register) = self.spec.cross_axis {
            // Seven bits, signed.
            self.cross_axis = i32::from((self.read_byte(register)? << 1) as i8 >> 1);
        }
        Ok(())
    }

    /// Empties the FIFO.
    fn clear(&mut self) -> Result<(), ImuError> {
        self.parser.reset();
        self.run(self.spec.fifo.reset)
    }

    /// Appends the content of the FIFO to `out`. After `Overflow` the FIFO is empty and fills again.
    pub fn burst(&mut self, out: &mut Vec<Raw>) -> Result<Burst, ImuError> {
        let fifo = &self.spec.fifo;
        let before = self.bus.now();
        let mut count = [0; 2];
        self.read_into(fifo.count, &mut count[..fifo.count_bytes])?;
        let after = self.bus.now();
        let words = if self.spec.big_endian { u16::from_be_bytes(count) } else { u16::from_le_bytes(count) };
        let bytes = usize::from(words & fifo.count_mask) * fifo.unit;
        if bytes > fifo.capacity {
            return Err(ImuError::BadCount(bytes));
        }
        if bytes >= fifo.full || words & fifo.overrun != 0 {
            self.clear()?;
            return Err(ImuError::Overflow);
        }
        let whole = match fifo.layout {
            // Frames of several lengths: all of it, or the die would begin in the middle of one.
            Layout::Bosch { .. } => bytes,
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

    /// Takes the gyro's z out of its x.
    fn compensate(&self, samples: &mut [Raw]) {
        if self.cross_axis == 0 {
            return;
        }
        for gyro in samples.iter_mut().filter_map(|s| s.gyro.as_mut()) {
            let x = i32::from(gyro[0]) - self.cross_axis * i32::from(gyro[2]) / 512;
            gyro[0] = x.clamp(i32::from(i16::MIN), i32::from(i16::MAX)) as i16;
        }
    }

    /// The newest sample of one sensor, counts, from its registers; fails as the bus does.
    pub fn newest(&mut self, sensor: &SensorSpec) -> Result<[i16; 3], BusFault> {
        let mut bytes = [0; 6];
        self.read_into(sensor.data, &mut bytes)?;
        Ok(triple(&bytes, 0, self.spec.big_endian))
    }

    /// The temperature, °C, of a die that does not put it into its FIFO; `None` where it is not known. Fails as
    /// the bus does.
    pub fn temperature(&mut self) -> Result<Option<f32>, BusFault> {
        let mut word = [0; 2];
        let (word, shift) = match self.spec.temperature.from {
            TemperatureSource::Nowhere | TemperatureSource::Frames => return Ok(None),
            TemperatureSource::Word(register) => {
                self.read_into(register, &mut word)?;
                (i16::from_le_bytes(word), 0)
            }
            TemperatureSource::ElevenBits(register) => {
                self.read_into(register, &mut word)?;
                // Two's complement of eleven bits.
                (i16::from_be_bytes(word), 5)
            }
        };
        // Both of Bosch's dies say so of a temperature that is not known yet.
        Ok((word != i16::MIN).then(|| self.celsius(word >> shift)))
    }

    /// A raw temperature in °C.
    pub fn celsius(&self, raw: i16) -> f32 {
        let t = &self.spec.temperature;
        (f64::from(raw) * t.c_per_lsb + t.c_at_zero) as f32
    }
}
