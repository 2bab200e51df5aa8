//! A simulated register file with a FIFO, for the tests: each chip as its data sheet describes it, told apart from the
//! driver's tables, with a sensor clock of its own that runs off the host's, and every fault a bus can have.
#![cfg(test)]

use super::bus::{Bus, BusFault};
use super::chips::Layout;
use super::edges::{EdgeFault, EdgeQueue, Edges};
use super::frames::Raw;
use crate::types::{Nanos, Span};
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard};

/// How a chip behaves; registers are `[bank][address]`.
pub struct Model {
    pub who: (u8, u8),
    pub bank: Option<(u8, u32)>,
    /// Written value of a register that resets the chip.
    pub reset: (u8, u8),
    /// Whether samples go into the FIFO.
    pub on: fn(&Registers) -> bool,
    pub rate_hz: fn(&Registers) -> f64,
    /// Steps a g, and a °/s.
    pub per_g: fn(&Registers) -> f64,
    pub per_dps: fn(&Registers) -> f64,
    /// Whether this write empties the FIFO.
    pub clears: fn(u8, u8, u8) -> bool,
    pub count: u8,
    pub data: u8,
    pub capacity: usize,
    pub layout: Layout,
    /// Count register's bytes for so many in the FIFO.
    pub counted: fn(usize) -> [u8; 2],
    /// Steps of the temperature, 31.5 °C.
    pub temperature: i16,
    /// First registers of the newest sample of accelerometer and gyro.
    pub newest: [u8; 2],
    pub big: bool,
    /// Steps by which a self-test that is on pushes accelerometer and gyro.
    pub testing: fn(&Registers) -> [f64; 2],
    /// Banks and first registers of the factory's codes of both.
    pub codes: [(u8, u8); 2],
}

/// The factory's code in the simulated chips, and the push it stands for.
const CODE: u8 = 60;
const PUSH: f64 = 4713.0;

pub type Registers = [[u8; 256]; 8];

/// Signals of sample `i`: g and °/s.
pub fn signal(i: u64) -> ([f64; 3], [f64; 3]) {
    let saw = |step: u64, of: u64| ((i * step) % of) as f64;
    ([saw(1, 1000) * 1e-3, -0.25 + saw(7, 100) * 1e-3, 1.0], [saw(3, 200), -40.5, saw(11, 90) - 45.0])
}

pub struct World {
    pub model: Model,
    pub registers: Registers,
    bank: u8,
    pub fifo: VecDeque<u8>,
    now: i64,
    /// Of the sensor: parts by which it runs fast, next sample and its number.
    pub fast: f64,
    next: Option<f64>,
    pub sampled: u64,
    /// Number, instant and counts of every sample that was put into the FIFO since the test began.
    pub truth: Vec<(u64, i64, Raw)>,
    pub lost: u64,
    /// Faults of the transfers to come.
    pub faults: VecDeque<BusFault>,
    pub unplugged: bool,
    /// Repeats the sample it was set with, or holds an axis at the end of its range.
    pub frozen: Option<Raw>,
    pub clipped: bool,
    /// No more samples, as after a brown-out, until it is reset.
    pub browned: bool,
    /// Answers that take the place of the count's.
    pub counts: VecDeque<[u8; 2]>,
    /// Push of the self-test, as a part of what it should be.
    pub push: f64,
    pub edges: Option<Vec<i64>>,
    pub edge_fault: bool,
    pub reopened: u32,
    pub transfers: u64,
    /// A pause of the host, ns, at the next sleep.
    pub stall: i64,
    /// What the BMI270 was sent.
    pub upload: Vec<u8>,
    /// Its factor of cross-axis sensitivity.
    pub cross: u8,
}

#[derive(Clone)]
pub struct SimBus(pub Arc<Mutex<World>>, pub Arc<Mutex<i64>>);

impl World {
    pub fn new(model: Model) -> World {
        World {
            model,
            registers: [[0; 256]; 8],
            bank: 0,
            fifo: VecDeque::new(),
            now: 0,
            fast: 0.0,
            next: None,
            sampled: 0,
            truth: vec![],
            lost: 0,
            faults: VecDeque::new(),
            unplugged: false,
            frozen: None,
            clipped: false,
            browned: false,
            counts: VecDeque::new(),
            push: 1.0,
            edges: None,
            edge_fault: false,
            reopened: 0,
            transfers: 0,
            stall: 0,
            upload: vec![],
            cross: 0,
        }
    }

    /// Takes the samples that are due by then.
    fn run(&mut self, now: i64) {
        self.now = now;
        if !(self.model.on)(&self.registers) || self.browned {
            self.next = None;
            return;
        }
        let period = 1e9 / (self.model.rate_hz)(&self.registers) / (1.0 + self.fast);
        let mut next = self.next.unwrap_or(now as f64 + 0.37 * period);
        while next <= now as f64 {
            self.sample(next as i64);
            next += period;
        }
        self.next = Some(next);
    }

    fn sample(&mut self, t: i64) {
        let raw = self.frozen.unwrap_or_else(|| self.counts_of(self.sampled));
        self.edges.iter_mut().for_each(|edges| edges.push(t));
        let frame = encode(self.model.layout, self.sampled, &raw);
        if self.fifo.len() + frame.len() <= self.model.capacity {
            self.fifo.extend(frame);
            self.truth.push((self.sampled, t, raw));
        } else {
            self.lost += 1;
        }
        self.sampled += 1;
    }

    pub fn counts_of(&self, i: u64) -> Raw {
        let (g, dps) = signal(i);
        let of = |v: [f64; 3], scale: f64| v.map(|v| (v * scale).round().clamp(-32768.0, 32767.0) as i16);
        let mut accel = of(g, (self.model.per_g)(&self.registers));
        if self.clipped {
            accel[1] = i16::MIN;
        }
        let gyro = of(dps, (self.model.per_dps)(&self.registers));
        Raw { accel: Some(accel), gyro: Some(gyro), temperature: Some(self.model.temperature) }
    }

    fn transfer(&mut self) -> Result<(), BusFault> {
        self.transfers += 1;
        if self.unplugged {
            return Err(BusFault::Gone);
        }
        self.faults.pop_front().map_or(Ok(()), Err)
    }

    fn byte(&mut self, address: u8) -> u8 {
        if self.model.bank.is_some_and(|(select, _)| select == address) {
            return self.bank;
        }
        if self.bank == 0 && address == self.model.data {
            return self.fifo.pop_front().unwrap_or(0xFF);
        }
        self.registers[usize::from(self.bank)][usize::from(address)]
    }

    fn refresh(&mut self) {
        let count = self.counts.pop_front().unwrap_or_else(|| (self.model.counted)(self.fifo.len()));
        let at = usize::from(self.model.count);
        // The BMI088's gyro counts frames in one byte.
        let bytes = if self.model.who.1 == 0x0F { 1 } else { 2 };
        self.registers[0][at..at + bytes].copy_from_slice(&count[..bytes]);
        let (who, id) = self.model.who;
        self.registers[0][usize::from(who)] = id;
        for (bank, first) in self.model.codes {
            let first = usize::from(first);
            self.registers[usize::from(bank)][first..first + 3].fill(if bank + first as u8 > 0 { CODE } else { 0 });
        }
        match self.model.who.1 {
            0x24 => self.registers[0][0x22..0x24].copy_from_slice(&self.model.temperature.to_le_bytes()),
            0x1E => self.registers[0][0x22..0x24].copy_from_slice(&(self.model.temperature << 5).to_be_bytes()),
            _ => {}
        }
        if self.model.newest != [0; 2] {
            let push = (self.model.testing)(&self.registers);
            let raw = self.counts_of(0);
            for (i, raw) in [raw.accel, raw.gyro].into_iter().flatten().enumerate() {
                let pushed = raw.map(|v| (f64::from(v) + push[i] * self.push) as i16);
                let at = usize::from(self.model.newest[i]);
                self.registers[0][at..at + 6].copy_from_slice(&words(pushed, self.model.big));
            }
        }
    }

    fn set(&mut self, address: u8, value: u8) {
        if let Some((_, shift)) = self.model.bank.filter(|(select, _)| *select == address) {
            self.bank = value >> shift;
            return;
        }
        if self.bank == 0 && (address, value) == self.model.reset {
            self.registers = [[0; 256]; 8];
            if self.model.who.1 == 0x24 {
                self.registers[0][0x3C] = self.cross;
            }
            (self.browned, self.next) = (false, None);
            self.fifo.clear();
            return;
        }
        let mut value = value;
        // The BMI088 gyro's test of itself, and the BMI270's start.
        if (self.model.who.1, address, value) == (0x0F, 0x3C, 1) {
            value = if self.push > 0.5 { 0x12 } else { 0x16 };
        }
        if (self.model.who.1, address, value) == (0x24, 0x59, 1) {
            self.registers[0][0x21] = u8::from(self.upload.len() == 8192);
        }
        if (self.model.clears)(self.bank, address, value) {
            self.fifo.clear();
        }
        self.registers[usize::from(self.bank)][usize::from(address)] = value;
    }
}

fn words(v: [i16; 3], big: bool) -> [u8; 6] {
    let bytes = v.map(|v| if big { v.to_be_bytes() } else { v.to_le_bytes() });
    std::array::from_fn(|i| bytes[i / 2][i % 2])
}

fn encode(layout: Layout, i: u64, raw: &Raw) -> Vec<u8> {
    let (accel, gyro) = (raw.accel.unwrap_or_default(), raw.gyro.unwrap_or_default());
    let t = raw.temperature.unwrap_or_default();
    match layout {
        Layout::Plain { len: 6, big_endian, .. } => words(gyro, big_endian).to_vec(),
        Layout::Plain { temperature: Some(6), .. } => {
            [&words(accel, true)[..], &t.to_be_bytes(), &words(gyro, true)].concat()
        }
        Layout::Plain { .. } => [&words(accel, true)[..], &words(gyro, true), &t.to_be_bytes()].concat(),
        Layout::Packet3 => [&[0x68][..], &words(accel, true), &words(gyro, true), &[t as u8, 0, 0]].concat(),
        Layout::Bosch { config: 1 } => [&[0x84][..], &words(accel, false)].concat(),
        Layout::Bosch { .. } => [&[0x8C][..], &words(gyro, false), &words(accel, false)].concat(),
        Layout::Tagged => {
            let tag = |tag: u8, v| [&[tag << 3 | ((i % 4) as u8) << 1][..], &words(v, false)].concat();
            let mut bytes = [tag(1, gyro), tag(2, accel)].concat();
            if i % 128 == 0 {
                bytes.splice(0..0, tag(3, [t, 0, 0]));
            }
            bytes
        }
    }
}

impl SimBus {
    pub fn new(model: Model) -> SimBus {
        SimBus(Arc::new(Mutex::new(World::new(model))), Arc::new(Mutex::new(1_000_000_000)))
    }

    /// Another die on the same clock.
    pub fn beside(&self, model: Model) -> SimBus {
        SimBus(Arc::new(Mutex::new(World::new(model))), self.1.clone())
    }

    pub fn world(&self) -> MutexGuard<'_, World> {
        let mut world = self.0.lock().expect("no test panics while it holds it");
        let now = *self.1.lock().expect("as above");
        world.run(now);
        world
    }

    /// Runs the world in small steps, so that what is set up in between takes its time.
    fn pass(&self, ns: i64) {
        *self.1.lock().expect("as above") += ns;
        drop(self.world());
    }

    pub fn instant(&self) -> i64 {
        *self.1.lock().expect("as above")
    }
}

impl Bus for SimBus {
    fn read(&mut self, register: u8, into: &mut [u8]) -> Result<(), BusFault> {
        // An I2C bus at 1 MHz or so.
        self.pass(40_000);
        let mut world = self.world();
        world.transfer()?;
        world.refresh();
        let data = world.bank == 0 && register == world.model.data;
        for (i, byte) in into.iter_mut().enumerate() {
            *byte = world.byte(if data { register } else { register.wrapping_add(i as u8) });
        }
        drop(world);
        self.pass(9_000 * into.len() as i64);
        Ok(())
    }

    fn write(&mut self, register: u8, bytes: &[u8]) -> Result<(), BusFault> {
        self.pass(40_000);
        let mut world = self.world();
        world.transfer()?;
        if (world.model.who.1, register) == (0x24, 0x5E) {
            let [low, high] = [world.registers[0][0x5B], world.registers[0][0x5C]].map(usize::from);
            assert_eq!(world.upload.len() % 8192, (high << 4 | low) * 2, "chunks are sent in order");
            world.upload.truncate(if high + low == 0 { 0 } else { 8192 });
            world.upload.extend(bytes);
            return Ok(());
        }
        bytes.iter().enumerate().for_each(|(i, b)| world.set(register.wrapping_add(i as u8), *b));
        Ok(())
    }

    fn reopen(&mut self) -> Result<(), BusFault> {
        let mut world = self.world();
        world.reopened += 1;
        if world.unplugged {
            Err(BusFault::Gone)
        } else {
            Ok(())
        }
    }

    fn now(&self) -> Nanos {
        Nanos(self.instant())
    }

    fn sleep(&mut self, span: Span) {
        let stall = std::mem::take(&mut self.world().stall);
        self.pass(span.0.max(0) + stall);
    }
}

/// Edges of the first die, delivered `latency` after they were stamped; the kernel keeps 16.
pub struct SimEdges {
    pub bus: SimBus,
    pub latency: i64,
    pub drop_every: usize,
    pub given: usize,
}

impl SimEdges {
    fn ready(&self) -> bool {
        let now = self.bus.instant();
        let world = self.bus.world();
        world.edges.as_ref().is_some_and(|e| e.first().is_some_and(|t| t + self.latency <= now))
    }
}

impl Edges for SimEdges {
    fn wait(&mut self, timeout: Span) -> Result<bool, EdgeFault> {
        if self.bus.world().edge_fault {
            return Err(EdgeFault(libc::ENODEV));
        }
        let until = self.bus.instant() + timeout.0;
        while !self.ready() && self.bus.instant() < until {
            self.bus.pass(20_000);
        }
        Ok(self.ready())
    }

    fn drain(&mut self, into: &mut EdgeQueue) -> Result<(), EdgeFault> {
        let now = self.bus.instant();
        let mut world = self.bus.world();
        let Some(edges) = &mut world.edges else { return Ok(()) };
        let there = edges.iter().take_while(|t| **t + self.latency <= now).count();
        for (i, t) in edges.drain(..there).enumerate() {
            self.given += 1;
            let dropped = self.drop_every > 0 && self.given % self.drop_every == 0;
            if i < 16 && !dropped {
                into.push(Nanos(t), Nanos(now));
            }
        }
        Ok(())
    }

    fn reopen(&mut self) -> Result<(), EdgeFault> {
        if self.bus.world().edge_fault {
            Err(EdgeFault(libc::ENOENT))
        } else {
            Ok(())
        }
    }
}

fn big(n: usize) -> [u8; 2] {
    (n as u16).to_be_bytes()
}

fn little(n: usize) -> [u8; 2] {
    (n as u16).to_le_bytes()
}

/// Full scale of a code.
fn pick(code: u8, of: &[f64]) -> f64 {
    32768.0 / of[usize::from(code)]
}

pub fn model(name: &str, die: usize) -> Model {
    let base = Model {
        who: (0x75, 0x70),
        bank: None,
        reset: (0x6B, 0x80),
        on: |r| r[0][0x6A] & 0x40 != 0 && r[0][0x23] == 0xF8 && r[0][0x6B] == 1,
        rate_hz: |r| 1000.0 / (1.0 + f64::from(r[0][0x19])),
        per_g: |r| pick(r[0][0x1C] >> 3 & 3, &[2.0, 4.0, 8.0, 16.0]),
        per_dps: |r| pick(r[0][0x1B] >> 3 & 3, &[250.0, 500.0, 1000.0, 2000.0]),
        clears: |_, a, v| a == 0x6A && v & 4 != 0,
        count: 0x72,
        data: 0x74,
        capacity: 512,
        layout: Layout::Plain { len: 14, accel: Some(0), temperature: Some(6), gyro: Some(8), big_endian: true },
        counted: big,
        temperature: 3506,
        newest: [0x3B, 0x43],
        big: true,
        testing: |r| [f64::from(r[0][0x1C] >> 7) * PUSH, f64::from(r[0][0x1B] >> 7) * PUSH],
        codes: [(0, 0x0D), (0, 0x00)],
    };
    match (name, die) {
        ("mpu-6500", _) => base,
        ("mpu-9250", _) => Model { who: (0x75, 0x71), ..base },
        ("icm-20948", _) => Model {
            who: (0x00, 0xEA),
            bank: Some((0x7F, 4)),
            reset: (0x06, 0x80),
            on: |r| r[0][0x03] & 0x40 != 0 && r[0][0x67] == 0x1F && r[0][0x06] == 1 && r[0][0x68] == 0,
            rate_hz: |r| if r[2][0] == r[2][0x11] { 1125.0 / (1.0 + f64::from(r[2][0])) } else { f64::NAN },
            per_g: |r| pick(r[2][0x14] >> 1 & 3, &[2.0, 4.0, 8.0, 16.0]),
            per_dps: |r| pick(r[2][0x01] >> 1 & 3, &[250.0, 500.0, 1000.0, 2000.0]),
            clears: |b, a, v| b == 0 && a == 0x68 && v == 0x1F,
            count: 0x70,
            data: 0x72,
            layout: Layout::Plain { len: 14, accel: Some(0), gyro: Some(6), temperature: Some(12), big_endian: true },
            newest: [0x2D, 0x33],
            testing: |r| [f64::from(r[2][0x15] >> 4) * PUSH, f64::from(r[2][0x02] >> 5) * PUSH],
            codes: [(1, 0x0E), (1, 0x02)],
            ..base
        },
        ("icm-42688-p", _) => Model {
            who: (0x75, 0x47),
            bank: Some((0x76, 0)),
            reset: (0x11, 0x01),
            on: |r| r[0][0x16] == 0x40 && r[0][0x5F] == 0x07 && r[0][0x4E] == 0x0F,
            rate_hz: |r| match (r[0][0x4F] & 15, r[0][0x50] & 15) {
                (7, 7) => 200.0,
                (6, 6) => 1000.0,
                _ => f64::NAN,
            },
            per_g: |r| pick(r[0][0x50] >> 5, &[16.0, 8.0, 4.0, 2.0]),
            per_dps: |r| pick(r[0][0x4F] >> 5, &[2000.0, 1000.0, 500.0, 250.0, 125.0]),
            clears: |b, a, v| b == 0 && a == 0x4B && v == 0x02,
            count: 0x2E,
            data: 0x30,
            capacity: 2048,
            layout: Layout::Packet3,
            temperature: 13,
            newest: [0x1F, 0x25],
            testing: |r| [f64::from(r[0][0x70] >> 5 & 1) * PUSH, f64::from(r[0][0x70] & 1) * PUSH],
            codes: [(2, 0x3B), (1, 0x5F)],
            ..base
        },
        ("lsm6dsox", _) => Model {
            who: (0x0F, 0x6C),
            reset: (0x12, 0x01),
            on: |r| r[0][0x0A] == 0x16 && r[0][0x12] == 0x44,
            rate_hz: |r| match (r[0][0x10] >> 4, r[0][0x11] >> 4, r[0][0x09]) {
                (5, 5, 0x55) => 208.0,
                _ => f64::NAN,
            },
            per_g: |r| 1.0 / [0.061e-3, 0.488e-3, 0.122e-3, 0.244e-3][usize::from(r[0][0x10] >> 2 & 3)],
            per_dps: |r| 1.0 / [8.75e-3, 17.5e-3, 35e-3, 70e-3][usize::from(r[0][0x11] >> 2 & 3)],
            clears: |_, a, v| a == 0x0A && v == 0,
            count: 0x3A,
            data: 0x78,
            capacity: 3584,
            layout: Layout::Tagged,
            counted: |n| {
                let words = n / 7;
                // Watermark and full flags stand in the bits above the count.
                [words as u8, (words >> 8) as u8 | 0x80]
            },
            temperature: 1664,
            newest: [0x28, 0x22],
            big: false,
            testing: |r| [f64::from(r[0][0x14] & 1) * 1000.0 / 0.122, f64::from(r[0][0x14] >> 2 & 1) * 300.0 / 70e-3],
            codes: [(7, 0); 2],
            ..base
        },
        ("bmi270", _) => Model {
            who: (0x00, 0x24),
            reset: (0x7E, 0xB6),
            on: |r| r[0][0x49] == 0xD0 && r[0][0x7D] == 0x0E && r[0][0x59] == 1 && r[0][0x7C] == 0,
            rate_hz: |r| match (r[0][0x40], r[0][0x42]) {
                (0xA9, 0xE9) => 200.0,
                (0xAA, 0xEA) => 400.0,
                _ => f64::NAN,
            },
            per_g: |r| pick(r[0][0x41], &[2.0, 4.0, 8.0, 16.0]),
            per_dps: |r| pick(r[0][0x43], &[2000.0, 1000.0, 500.0, 250.0, 125.0]),
            clears: |_, a, v| a == 0x7E && v == 0xB0,
            count: 0x24,
            data: 0x26,
            capacity: 2048,
            layout: Layout::Bosch { config: 4 },
            counted: little,
            temperature: 4352,
            newest: [0x0C, 0x12],
            big: false,
            // 16 g and its half of either sign: a push of ten counts each way.
            testing: |r| [if r[0][0x6D] == 0x0D { 9.0 * 2048.0 } else { -9.0 * 2048.0 }, 0.0],
            codes: [(7, 0); 2],
            ..base
        },
        ("bmi088", 0) => Model {
            who: (0x00, 0x0F),
            reset: (0x14, 0xB6),
            on: |r| r[0][0x3E] == 0x80,
            rate_hz: |r| [2000.0, 2000.0, 1000.0, 400.0, 200.0, 100.0, 200.0, 100.0][usize::from(r[0][0x10])],
            per_dps: |r| pick(r[0][0x0F], &[2000.0, 1000.0, 500.0, 250.0, 125.0]),
            clears: |_, a, _| a == 0x3E,
            count: 0x0E,
            data: 0x3F,
            capacity: 600,
            layout: Layout::Plain { len: 6, accel: None, gyro: Some(0), temperature: None, big_endian: false },
            counted: |n| [(n / 6) as u8, 0],
            newest: [0; 2],
            codes: [(7, 0); 2],
            ..base
        },
        ("bmi088", _) => Model {
            who: (0x00, 0x1E),
            reset: (0x7E, 0xB6),
            on: |r| r[0][0x49] == 0x50 && r[0][0x7D] == 4 && r[0][0x7C] == 0,
            rate_hz: |r| match r[0][0x40] {
                0xA9 => 200.0,
                0xAA => 400.0,
                0xAB => 800.0,
                _ => f64::NAN,
            },
            per_g: |r| pick(r[0][0x41], &[3.0, 6.0, 12.0, 24.0]),
            clears: |_, a, v| a == 0x7E && v == 0xB0,
            count: 0x24,
            data: 0x26,
            capacity: 1024,
            layout: Layout::Bosch { config: 1 },
            counted: little,
            temperature: 68,
            newest: [0x12, 0x70],
            big: false,
            testing: |r| [if r[0][0x6D] == 0x0D { 900.0 } else { -900.0 }, 0.0],
            codes: [(7, 0); 2],
            ..base
        },
        _ => panic!("no model of {name}"),
    }
}
