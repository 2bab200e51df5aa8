//! Bosch BMP388, data sheet BST-BMP388-DS001: registers, coefficients, and the compensation of its appendix in double
//! precision. It measures on demand ("forced mode"), pressure four times and temperature once, without its low-pass filter,
//! which would delay the height of a climb.

use super::{BaroError, Sensor};
use crate::imu::bus::Bus;
use crate::types::{Nanos, Span};

const CHIP_ID: u8 = 0x00;
const BMP388: u8 = 0x50;
const STATUS: u8 = 0x03;
/// Pressure and temperature are there.
const READY: u8 = 0x60;
/// Pressure, then temperature, three bytes each, the least first.
const DATA: u8 = 0x04;
/// What the pressure is before there was one: it would pass for that of 2100 m.
const NOT_MEASURED: u32 = 0x80_0000;
const PWR_CTRL: u8 = 0x1B;
/// Measures both once.
const FORCED: u8 = 0x13;
const OSR: u8 = 0x1C;
/// Pressure four times, temperature once.
const OVERSAMPLING: u8 = 0x02;
const CONFIG: u8 = 0x1F;
const UNFILTERED: u8 = 0x00;
const COEFFICIENTS: u8 = 0x31;
const CMD: u8 = 0x7E;
const SOFT_RESET: u8 = 0xB6;
const RESET_TIME: Span = Span(5_000_000);
/// Time of a measurement, and until the middle of its pressure ("measurement time": 234 + 392 + 4 x 2020 + 163 + 2020 µs).
const MEASURING: Span = Span(10_889_000);
const MIDDLE: Span = Span(4_666_000);
/// Looks for the end of a measurement, a millisecond apart: at its longest it takes a tenth more.
const LOOKS: usize = 6;
const LOOK_AGAIN: Span = Span(1_000_000);

/// The coefficients of one sensor, scaled as the data sheet says.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Coefficients {
    t: [f64; 3],
    p: [f64; 11],
}

impl Coefficients {
    /// From the bytes of the registers 0x31 to 0x45; `None` where these are blank.
    pub(super) fn new(raw: &[u8; 21]) -> Option<Coefficients> {
        if raw.iter().all(|b| *b == raw[0]) {
            return None;
        }
        let word = |i: usize| u16::from_le_bytes([raw[i], raw[i + 1]]);
        let [unsigned, signed] = [|w: u16| f64::from(w), |w: u16| f64::from(w as i16)];
        let byte = |i: usize| f64::from(raw[i] as i8);
        let scaled = |value: f64, bits: i32| value * 2f64.powi(-bits);
        const OFFSET: f64 = 16384.0;
        Some(Coefficients {
            t: [scaled(unsigned(word(0)), -8), scaled(unsigned(word(2)), 30), scaled(byte(4), 48)],
            p: [
                scaled(signed(word(5)) - OFFSET, 20),
                scaled(signed(word(7)) - OFFSET, 29),
                scaled(byte(9), 32),
                scaled(byte(10), 37),
                scaled(unsigned(word(11)), -3),
                scaled(unsigned(word(13)), 6),
                scaled(byte(15), 8),
                scaled(byte(16), 15),
                scaled(signed(word(17)), 48),
                scaled(byte(19), 48),
                scaled(byte(20), 65),
            ],
        })
    }

    /// Temperature, °C, of what the sensor counts.
    pub(super) fn celsius(&self, counts: u32) -> f64 {
        let d = f64::from(counts) - self.t[0];
        d * self.t[1] + d * d * self.t[2]
    }

    /// Pressure, Pa, of what the sensor counts at a temperature.
    pub(super) fn pascal(&self, counts: u32, t: f64) -> f64 {
        let (u, p) = (f64::from(counts), &self.p);
        let offset = p[4] + t * (p[5] + t * (p[6] + t * p[7]));
        let slope = p[0] + t * (p[1] + t * (p[2] + t * p[3]));
        offset + u * slope + u * u * (p[8] + p[9] * t) + u * u * u * p[10]
    }
}

/// A BMP388 behind its bus.
pub(super) struct Bmp388 {
    bus: Box<dyn Bus>,
    coefficients: Coefficients,
    started: bool,
}

impl Bmp388 {
    pub(super) fn new(bus: Box<dyn Bus>) -> Bmp388 {
        Bmp388 { bus, coefficients: Coefficients::default(), started: false }
    }

    fn register(&mut self, register: u8) -> Result<u8, BaroError> {
        let mut value = [0];
        self.bus.read(register, &mut value)?;
        Ok(value[0])
    }
}

impl Sensor for Bmp388 {
    fn start(&mut self) -> Result<(), BaroError> {
        if std::mem::replace(&mut self.started, true) {
            self.bus.reopen()?;
        }
        match self.register(CHIP_ID)? {
            BMP388 => {}
            other => return Err(BaroError::WrongChip(other)),
        }
        self.bus.write(CMD, &[SOFT_RESET])?;
        self.bus.sleep(RESET_TIME);
        let mut raw = [0; 21];
        self.bus.read(COEFFICIENTS, &mut raw)?;
        self.coefficients = Coefficients::new(&raw).ok_or(BaroError::NoCoefficients)?;
        for (register, value) in [(OSR, OVERSAMPLING), (CONFIG, UNFILTERED)] {
            self.bus.write(register, &[value])?;
            match self.register(register)? {
                set if set == value => {}
                other => return Err(BaroError::Stuck(register, other)),
            }
        }
        Ok(())
    }

    fn measure(&mut self) -> Result<(Nanos, f64), BaroError> {
        self.bus.write(PWR_CTRL, &[FORCED])?;
        let begun = self.bus.now();
        self.bus.sleep(MEASURING);
        for _ in 0..LOOKS {
            if self.register(STATUS)? & READY == READY {
                let mut raw = [0; 6];
                self.bus.read(DATA, &mut raw)?;
                let counts = |i: usize| u32::from_le_bytes([raw[i], raw[i + 1], raw[i + 2], 0]);
                if counts(0) == NOT_MEASURED {
                    return Err(BaroError::Silent);
                }
                let celsius = self.coefficients.celsius(counts(3));
                return Ok((begun + MIDDLE, self.coefficients.pascal(counts(0), celsius)));
            }
            self.bus.sleep(LOOK_AGAIN);
        }
        Err(BaroError::Silent)
    }

    fn now(&self) -> Nanos {
        self.bus.now()
    }

    fn sleep(&mut self, span: Span) {
        self.bus.sleep(span);
    }
}
