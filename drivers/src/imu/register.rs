//! An inertial unit driven by its registers: waits, reads, and comes back.
//!
//! With a data-ready line it wakes on edges and reads once `watermark` are there; without one it reads by the clock.
//! Then the moment of reading wanders over a whole period (a golden-ratio sequence): a read that always fell at the
//! same phase could not tell where in the period the samples lie, a wandering one narrows it to a few percent
//! (`timeline`), for half a period more of latency.
//!
//! A transfer that fails is tried again at the next read. After `FAILURES_MAX` in a row, a frozen sensor or silence
//! the unit is reset and set up anew; where that fails, or nothing good came of the last time, it is lost, and looked
//! for with a pause that doubles from `BACKOFF` to `BACKOFF_MAX`. Setting up takes 60 to 250 ms, and a call that does
//! it outlasts its timeout by that.

use super::bus::{Bus, BusFault};
use super::counters::ImuCounters;
use super::die::Trouble;
use super::edges::{EdgeQueue, Edges};
use super::merge::{Merge, Reading};
use super::timeline::ClockReport;
use super::unit::Unit;
use crate::source::{ImuBatch, ImuReading, ImuSource, SourceFault, Wait};
use crate::types::{ImuSample, Nanos, Span};
use crate::{Fault, FaultKind};

/// Pauses between attempts to find a lost unit.
const BACKOFF: Span = Span(20_000_000);
const BACKOFF_MAX: Span = Span(1_000_000_000);
/// No sample for so many periods, and at least so long: the unit lost its configuration, as after a brown-out.
const SILENT_PERIODS: i64 = 20;
const SILENT_MIN: Span = Span(100_000_000);
/// Transfers that may fail in a row before the unit is set up anew.
const FAILURES_MAX: u32 = 3;
/// How long edges may stay away before samples are looked for without them.
const EDGES_LATE: Span = Span(2_000_000);
const EDGES_RETRY: Span = Span(1_000_000_000);
/// The golden ratio's fraction: multiples of it fill the unit interval as evenly as can be.
const GOLDEN: f64 = 0.618_033_988_749_895;

enum State {
    Running,
    /// When it is looked for again, and why.
    Lost {
        retry: Nanos,
        why: Trouble,
    },
}

pub struct RegisterImu<B: Bus, E: Edges> {
    place: String,
    /// One, or gyro and accelerometer.
    units: Vec<Unit<B>>,
    edges: Option<E>,
    edges_from: Nanos,
    queue: EdgeQueue,
    merge: Option<Merge>,
    /// Samples of one read.
    watermark: usize,
    state: State,
    failures: u32,
    /// Before the next attempt; doubles until the unit gives samples that differ.
    pause: Span,
    /// When the unit is read next, before it wanders; and how often it was.
    due: Nanos,
    reads: u64,
    /// When each unit gave its last sample, or was started.
    heard: [Nanos; 2],
    /// Nothing was read since the start.
    fresh: bool,
    counters: ImuCounters,
}

impl<B: Bus, E: Edges> RegisterImu<B, E> {
    /// Starts the dies; the one with the gyro first.
    pub fn start(
        place: String,
        mut units: Vec<Unit<B>>,
        edges: Option<E>,
        watermark: usize,
    ) -> Result<RegisterImu<B, E>, Fault> {
        for unit in &mut units {
            unit.start().map_err(|trouble| cannot_start(&place, unit.die.chip.name, trouble))?;
        }
        let merge = units.get(1).map(|accel| Merge::new(accel.line.period()));
        let mut imu = RegisterImu {
            place,
            units,
            edges,
            edges_from: Nanos::MIN,
            queue: EdgeQueue::default(),
            merge,
            watermark,
            state: State::Running,
            failures: 0,
            pause: BACKOFF,
            due: Nanos(0),
            reads: 0,
            heard: [Nanos(0); 2],
            fresh: true,
            counters: ImuCounters::default(),
        };
        imu.started();
        Ok(imu)
    }

    /// The sensor's clock, of the die whose samples set the time.
    pub fn clock(&self) -> ClockReport {
        self.units[0].line.report()
    }

    pub fn seen(&self) -> ImuCounters {
        ImuCounters {
            imu_edges_refused: self.queue.refused,
            imu_edges_unmatched: self.queue.unmatched,
            imu_unpaired: self.merge.as_ref().map_or(0, |m| m.unpaired),
            imu_rate_millihertz: (self.clock().rate_hz * 1e3).round() as u64,
            ..self.counters
        }
    }

    fn now(&self) -> Nanos {
        self.units[0].die.bus.now()
    }

    fn sleep_until(&mut self, t: Nanos) {
        let span = t - self.now();
        if span.0 > 0 {
            self.units[0].die.bus.sleep(span);
        }
    }

    /// Edges of before a start are of no sample that will come.
    fn started(&mut self) {
        if let Some(edges) = &mut self.edges {
            let _ = edges.drain(&mut self.queue);
        }
        self.queue.clear();
        self.merge.iter_mut().for_each(Merge::clear);
        let now = self.now();
        (self.failures, self.due, self.heard, self.fresh) = (0, now, [now; 2], true);
        self.schedule();
    }

    fn period(&self) -> Span {
        self.units[0].line.period()
    }

    fn schedule(&mut self) {
        let step = Span(self.period().0.saturating_mul(self.watermark as i64));
        let now = self.now();
        // A read that came late does not make the next ones follow in haste.
        self.due = (self.due + step).max(now + Span(step.0 / 2));
        self.reads = self.reads.wrapping_add(1);
    }

    /// The moment of the next read without edges.
    fn wandering(&self) -> Nanos {
        let part = (self.reads as f64 * GOLDEN).fract();
        self.due + Span((part * self.period().0 as f64) as i64)
    }

    fn has_edges(&self) -> bool {
        self.edges.is_some() && self.now() >= self.edges_from
    }

    /// Waits for the moment to read; false where `limit` is before it.
    fn wait(&mut self, limit: Nanos) -> bool {
        if !self.has_edges() {
            let due = self.wandering();
            self.sleep_until(due.min(limit));
            return due <= limit;
        }
        let late = self.due + self.period() + EDGES_LATE;
        loop {
            if let Err(fault) = self.take_edges(late.min(limit)) {
                self.edge_fault(fault);
                return true;
            }
            let now = self.now();
            if self.queue.stamps().len() >= self.watermark || now >= late {
                return true;
            }
            if now >= limit {
                return false;
            }
        }
    }

    fn take_edges(&mut self, until: Nanos) -> Result<(), super::edges::EdgeFault> {
        let span = until - self.now();
        let Some(edges) = &mut self.edges else { return Ok(()) };
        if edges.wait(span.max(Span(0)))? {
            edges.drain(&mut self.queue)?;
        }
        Ok(())
    }

    /// Samples are stamped by the line until the edges are back.
    fn edge_fault(&mut self, _: super::edges::EdgeFault) {
        self.counters.imu_edge_faults += 1;
        self.queue.clear();
        self.edges_from = self.now() + EDGES_RETRY;
        if let Some(Err(_)) = self.edges.as_mut().map(Edges::reopen) {
            self.counters.imu_edge_faults += 1;
        }
    }

    fn collect(&mut self, batch: &mut ImuBatch) {
        let with_edges = self.has_edges();
        // What piled up while the rest of the program started was for nobody, and silence counts from here.
        let fresh = std::mem::take(&mut self.fresh);
        if fresh {
            self.heard = [self.now(); 2];
        }
        let mut worst = None;
        for (i, unit) in self.units.iter_mut().enumerate() {
            let edges = (i == 0 && with_edges).then_some(&mut self.queue);
            let merge = &mut self.merge;
            let give = |reading: Reading| match merge {
                Some(merge) => merge.push(reading),
                None => push(batch, reading),
            };
            match unit.collect(edges, &mut self.counters, give) {
                Ok(0) => {}
                Ok(_) => {
                    self.heard[i] = unit.die.bus.now();
                    if i == 0 {
                        self.failures = 0;
                    }
                }
                Err(Trouble::Overflow) if fresh => {}
                Err(trouble) => worst = Some(trouble),
            }
        }
        if let Some(merge) = &mut self.merge {
            merge.drain(batch);
        }
        if let Some(trouble) = worst {
            self.met(trouble);
        } else if self.is_silent() {
            self.met(Trouble::Silent);
        }
    }

    fn is_silent(&self) -> bool {
        let allowed = Span((self.period().0.saturating_mul(SILENT_PERIODS)).max(SILENT_MIN.0));
        let now = self.now();
        self.heard[..self.units.len()].iter().any(|heard| now - *heard > allowed)
    }

    fn met(&mut self, trouble: Trouble) {
        self.counters.count(&trouble);
        match trouble {
            // Cleared already.
            Trouble::Overflow => {}
            Trouble::Bus(BusFault::Gone) | Trouble::Frozen(_) | Trouble::Silent => self.restart(trouble),
            _ => {
                self.failures += 1;
                if self.failures >= FAILURES_MAX {
                    self.restart(trouble);
                }
            }
        }
    }

    /// At once where it was well since the last time, else after a pause.
    fn restart(&mut self, why: Trouble) {
        let alive = self.units.iter().all(Unit::is_alive);
        if alive {
            self.pause = BACKOFF;
        }
        if !alive || !self.set_up(why == Trouble::Bus(BusFault::Gone)) {
            self.lose(why);
        }
    }

    fn lose(&mut self, why: Trouble) {
        self.state = State::Lost { retry: self.now() + self.pause, why };
        self.pause = Span((self.pause.0 * 2).min(BACKOFF_MAX.0));
    }

    /// Resets the unit and sets it up.
    fn set_up(&mut self, reopen: bool) -> bool {
        let outcome = self.units.iter_mut().try_for_each(|unit| {
            if reopen {
                unit.die.bus.reopen()?;
            }
            unit.start()
        });
        if let Err(trouble) = outcome {
            self.counters.imu_restarts_failed += 1;
            self.counters.count(&trouble);
            return false;
        }
        self.counters.imu_restarts += 1;
        self.started();
        self.state = State::Running;
        true
    }

    /// Looks for a lost unit, at its time; waits for that until `limit`.
    fn look(&mut self, limit: Nanos) -> Result<(), SourceFault> {
        let State::Lost { retry, why } = self.state else { return Ok(()) };
        self.sleep_until(retry.min(limit));
        if self.now() >= retry {
            if self.set_up(true) {
                return Ok(());
            }
            self.lose(why);
        }
        Err(self.lost())
    }

    fn lost(&self) -> SourceFault {
        let why = match &self.state {
            State::Lost { why, .. } => why.to_string(),
            State::Running => String::new(),
        };
        let fix = "check cable and supply; it is looked for again and again";
        SourceFault::Lost(Fault::new(
            FaultKind::Unavailable,
            &self.place,
            format!("the inertial unit is lost: {why}"),
            fix,
        ))
    }
}

fn push(batch: &mut ImuBatch, reading: Reading) {
    if let (Some(gyro_body), Some(accel_body)) = (reading.gyro, reading.accel) {
        let sample = ImuSample { t: reading.t, gyro_body, accel_body };
        let pushed =
            batch.push(ImuReading { sample, temperature_c: reading.temperature_c, saturated: reading.saturated });
        debug_assert!(pushed.is_ok(), "a batch holds more than any FIFO");
    }
}

pub(super) fn cannot_start(place: &str, die: &str, trouble: Trouble) -> Fault {
    let fix = match trouble {
        Trouble::Bus(BusFault::Nack) => "check wiring, supply and imu.address (i2cdetect shows what answers)",
        Trouble::Stranger(_) => "set imu.chip to what is there, or check the wiring (by SPI the chip select)",
        Trouble::NoConfiguration => {
            "set imu.configuration to a file of the 8192 bytes of bmi270_config_file, from Bosch's BMI270_SensorAPI: it \
             is Bosch's program, and no part of this one"
        }
        Trouble::BadConfiguration(_) => {
            "check that imu.configuration holds bmi270_config_file as it stands in Bosch's BMI270_SensorAPI, then the \
             wiring"
        }
        Trouble::SelfTest(..) => {
            "keep the board still while it starts, or set imu.self_test = false and expect bad data"
        }
        _ => "check wiring and supply, then power the unit off and on",
    };
    Fault::new(FaultKind::Unavailable, place, format!("the {die} does not start: {trouble}"), fix)
}

impl<B: Bus, E: Edges> ImuSource for RegisterImu<B, E> {
    fn next(&mut self, timeout: Span, batch: &mut ImuBatch) -> Result<Wait, SourceFault> {
        batch.clear();
        let limit = self.now() + timeout.max(Span(0));
        loop {
            self.look(limit)?;
            if !self.wait(limit) {
                return Ok(Wait::TimedOut);
            }
            self.collect(batch);
            self.schedule();
            if !batch.is_empty() {
                return Ok(Wait::Got);
            }
            if matches!(self.state, State::Lost { .. }) {
                return Err(self.lost());
            }
            if self.now() >= limit {
                return Ok(Wait::TimedOut);
            }
        }
    }

    fn counters(&self) -> Vec<(&'static str, u64)> {
        self.seen().list()
    }
}
