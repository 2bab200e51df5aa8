//! A simulated register file with a FIFO, for the tests: each chip as its data sheet describes it, told apart from the
//! driver's tables, with a sensor clock of its own that runs off the host's, and every fault a bus can have.
#![cfg(test)]

use crate::imu::bus::{Bus, BusFault};
use crate::imu::chips::Layout;
use crate::imu::edges::{EdgeFault, EdgeQueue, Edges};
use crate::imu::frames::Raw;
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

const MS: i64 = 1_000_000;
/// ACC_PWR_CONF of the BMI088's accelerometer after a reset.
const SUSPENDED: u8 = 3;
/// The factory's code in the simulated chips, and the push it stands for.
const CODE: u8 = 60;
pub const PUSH: f64 = 4713.0;

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
    /// The sensor's clock: how much it runs fast, relative; its next sample, and that sample's number.
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
    /// Push of the self-test of accelerometer and gyro, as a part of what it should be; the factory's codes of it.
    pub push: [f64; 2],
    pub code: u8,
    pub edges: Option<Vec<i64>>,
    pub edge_fault: bool,
    pub reopened: u32,
    pub transfers: u64,
    /// A pause of the host, ns, at the next sleep.
    pub stall: i64,
    /// What the BMI270 was sent.
    pub upload: Vec<u8>,
    /// Its factor of cross-axis sensitivity, and what it makes of its configuration.
    pub cross: u8,
    pub configured: u8,
    /// The BMI088's accelerometer hears no write before then.
    deaf_until: i64,
    /// The next count of the ICM-42688-P is 0, whatever there is.
    uncounted: bool,
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
            push: [1.0; 2],
            code: CODE,
            edges: None,
            edge_fault: false,
            reopened: 0,
            transfers: 0,
            stall: 0,
            upload: vec![],
            cross: 0,
            configured: 1,
            deaf_until: 0,
            uncounted: false,
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
            self.registers[usize::from(bank)][first..first + 3].fill(self.code);
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
                let pushed = raw.map(|v| (f64::from(v) + push[i] * self.push[i]) as i16);
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
            match self.model.who.1 {
                0x24 => self.registers[0][0x3C] = self.cross,
                0x1E => (self.registers[0][0x7C], self.deaf_until) = (SUSPENDED, self.now + MS),
                0x47 => self.registers[0][0x4D] = 0x91,
                _ => {}
            }
            (self.browned, self.next) = (false, None);
            self.fifo.clear();
            return;
        }
        if self.model.who.1 == 0x1E {
            if self.now < self.deaf_until {
                return;
            }
            // A write in suspend mode takes it a millisecond.
            self.deaf_until = if self.registers[0][0x7C] == SUSPENDED { self.now + MS } else { 0 };
        }
        let mut value = value;
        // The tests that the gyros of the BMI088 and the BMI270 make of themselves, and the latter's start.
        match (self.model.who.1, address, value) {
            (0x0F, 0x3C, 1) => value = if self.push[1] > 0.5 { 0x12 } else { 0x16 },
            (0x24, 0x7E, 2) if self.registers[0][0x7D] == 4 => {
                self.registers[0][0x6E] = if self.push[1] > 0.5 { 0x0F } else { 0x0B };
            }
            (0x24, 0x59, 1) => {
                self.registers[0][0x21] = if self.upload.len() == 8192 { self.configured } else { 2 };
            }
            _ => {}
        }
        if (self.model.clears)(self.bank, address, value) {
            self.fifo.clear();
            self.uncounted = self.model.who.1 == 0x47;
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
        Layout::Plain { len: 6, .. } => words(gyro, false).to_vec(),
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
        if register == world.model.count && std::mem::take(&mut world.uncounted) {
            world.registers[0][usize::from(register)..][..2].fill(0);
        }
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
