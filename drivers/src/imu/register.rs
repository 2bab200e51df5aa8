//! An inertial unit that is driven by its registers: waits, reads, and restarts what failed.
//!
//! With a data-ready line it wakes on edges and reads once `watermark` samples are there; without one it reads by the
//! clock. Then the moment of reading wanders over a whole period (a golden-ratio sequence): a read that always fell at the
//! same phase could not tell where in the period the samples lie; a wandering one narrows it to a few percent
//! (`timeline`), for half a period more of latency.
//!
//! A transfer that fails is tried again at the next read. After `FAILURES_MAX` in a row, after a frozen sensor or silence,
//! the unit is reset and set up anew. Where that fails, or where nothing good came since the last time, it is lost, and
//! looked for with a pause that doubles from `BACKOFF` to `BACKOFF_MAX`. Setting a unit up takes 60 to 250 ms, and a call
//! that does it outlasts its timeout by that.

use super::bus::BusFault;
use super::counters::ImuCounters;
use super::edges::{EdgeFault, EdgeQueue, Edges};
use super::error::ImuError;
use super::merge::{pass, Merge};
use super::unit::Unit;
use crate::source::{ImuBatch, ImuSource, SourceFault, Wait};
use crate::types::{Nanos, Span};
use crate::Fault;

/// First and longest pause between attempts to find a lost unit.
const BACKOFF: Span = Span(20_000_000);
const BACKOFF_MAX: Span = Span(1_000_000_000);
/// No sample for so many periods, and at least so long: the unit lost its configuration, as after a brown-out.
const SILENT_PERIODS: i64 = 20;
const SILENT_MIN: Span = Span(100_000_000);
/// Transfers that may fail in a row before the unit is set up anew.
const FAILURES_MAX: u32 = 3;
/// How long edges may stay away before samples are looked for without them, and how long a line that failed is left alone.
const EDGES_LATE: Span = Span(2_000_000);
const EDGES_RETRY: Span = Span(1_000_000_000);
/// The golden ratio's fraction: multiples of it fill the unit interval as evenly as can be.
const GOLDEN: f64 = 0.618_033_988_749_895;

/// A lost unit is looked for again at `retry`.
enum State {
    Running,
    Lost { retry: Nanos, why: ImuError },
}

/// A unit of one or two dies, and its data-ready line.
pub struct RegisterImu {
    place: String,
    /// One, or gyro and accelerometer.
    pub(super) units: Vec<Unit>,
    edges: Option<Box<dyn Edges>>,
    /// When a line that failed is used again.
    edges_from: Nanos,
    queue: EdgeQueue,
    merge: Option<Merge>,
    /// Samples of one read.
    watermark: usize,
    state: State,
    failures: u32,
    /// Before the next attempt to find it; doubles until the unit gives samples that differ.
    pause: Span,
    /// When the unit is read next, before the moment wanders; and how often it was read.
    due: Nanos,
    reads: u64,
    /// When each unit gave its last sample, or was started.
    heard: [Nanos; 2],
    /// Nothing was read since the start.
    fresh: bool,
    counters: ImuCounters,
}

impl RegisterImu {
    /// Starts the dies, of which the first has the gyro. `place` is named in faults.
    pub(super) fn start(
        place: String,
        mut units: Vec<Unit>,
        edges: Option<Box<dyn Edges>>,
        watermark: usize,
    ) -> Result<RegisterImu, Fault> {
        for unit in &mut units {
            unit.start().map_err(|error| error.at_start(&place, unit.die.spec.name))?;
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
        imu.begin();
        Ok(imu)
    }

    /// The counters so far.
    pub fn counts(&self) -> ImuCounters {
        ImuCounters {
            imu_edges_refused: self.queue.refused,
            imu_edges_unmatched: self.queue.unmatched,
            imu_unpaired: self.merge.as_ref().map_or(0, |m| m.unpaired),
            imu_rate_millihertz: (self.units[0].line.rate_hz() * 1e3).round() as u64,
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

    /// Begins to read a unit that was just started: edges from before belong to no sample that will come.
    fn begin(&mut self) {
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
            if let Err(EdgeFault(_)) = self.take_edges(late.min(limit)) {
                self.leave_edges();
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

    fn take_edges(&mut self, until: Nanos) -> Result<(), EdgeFault> {
        let span = until - self.now();
        let Some(edges) = &mut self.edges else { return Ok(()) };
        if edges.wait(span.max(Span(0)))? {
            edges.drain(&mut self.queue)?;
        }
        Ok(())
    }

    /// Leaves a line that failed alone for a while: samples are stamped by the estimated line until it is back.
    fn leave_edges(&mut self) {
        self.counters.imu_edge_faults += 1;
        self.queue.clear();
        self.edges_from = self.now() + EDGES_RETRY;
        if let Some(Err(_)) = self.edges.as_mut().map(|edges| edges.reopen()) {
            self.counters.imu_edge_faults += 1;
        }
    }

    fn collect(&mut self, batch: &mut ImuBatch) {
        let with_edges = self.has_edges();
        // What piled up while the rest of the program started is of no use, and silence counts from here.
        let fresh = std::mem::take(&mut self.fresh);
        if fresh {
            self.heard = [self.now(); 2];
        }
        let mut worst = None;
        for (i, unit) in self.units.iter_mut().enumerate() {
            let edges = (i == 0 && with_edges).then_some(&mut self.queue);
            let merge = &mut self.merge;
            match unit.collect(edges, &mut self.counters, |reading| pass(merge, batch, reading)) {
                Ok(0) => {}
                Ok(_) => {
                    self.heard[i] = unit.die.bus.now();
                    if i == 0 {
                        self.failures = 0;
                    }
                }
                Err(ImuError::Overflow) if fresh => {}
                Err(error) => worst = Some(error),
            }
        }
        if let Some(merge) = &mut self.merge {
            merge.drain(batch);
        }
        if let Some(error) = worst {
            self.handle(error);
        } else if self.is_silent() {
            self.handle(ImuError::Silent);
        }
    }

    fn is_silent(&self) -> bool {
        let allowed = Span((self.period().0.saturating_mul(SILENT_PERIODS)).max(SILENT_MIN.0));
        let now = self.now();
        self.heard[..self.units.len()].iter().any(|heard| now - *heard > allowed)
    }

    fn handle(&mut self, error: ImuError) {
        self.counters.count(&error);
        match error {
            // Cleared already.
            ImuError::Overflow => {}
            ImuError::Bus(BusFault::Gone) | ImuError::Frozen(_) | ImuError::Silent => self.restart(error),
            _ => {
                self.failures += 1;
                if self.failures >= FAILURES_MAX {
                    self.restart(error);
                }
            }
        }
    }

    /// Sets the unit up at once where it was well since the last time, else after a pause.
    fn restart(&mut self, why: ImuError) {
        let alive = self.units.iter_mut().all(Unit::is_alive);
        if alive {
            self.pause = BACKOFF;
        }
        if !alive || !self.set_up(why == ImuError::Bus(BusFault::Gone)) {
            self.lose(why);
        }
    }

    fn lose(&mut self, why: ImuError) {
        self.state = State::Lost { retry: self.now() + self.pause, why };
        self.pause = Span((self.pause.0 * 2).min(BACKOFF_MAX.0));
    }

    /// Resets the unit and sets it up; whether that went well.
    fn set_up(&mut self, reopen: bool) -> bool {
        let outcome = self.units.iter_mut().try_for_each(|unit| {
            if reopen {
                unit.die.bus.reopen()?;
            }
            unit.start()
        });
        if let Err(error) = outcome {
            self.counters.imu_restarts_failed += 1;
            self.counters.count(&error);
            return false;
        }
        self.counters.imu_restarts += 1;
        self.begin();
        self.state = State::Running;
        true
    }

    /// Looks for a lost unit when it is time to, and waits for that until `limit`.
    fn look_for_lost(&mut self, limit: Nanos) -> Result<(), SourceFault> {
        let State::Lost { retry, why } = self.state else { return Ok(()) };
        self.sleep_until(retry.min(limit));
        if self.now() >= retry {
            if self.set_up(true) {
                return Ok(());
            }
            self.lose(why);
        }
        Err(why.lost(&self.place))
    }
}

impl ImuSource for RegisterImu {
    fn next(&mut self, timeout: Span, batch: &mut ImuBatch) -> Result<Wait, SourceFault> {
        batch.clear();
        let limit = self.now() + timeout.max(Span(0));
        loop {
            self.look_for_lost(limit)?;
            if !self.wait(limit) {
                return Ok(Wait::TimedOut);
            }
            self.collect(batch);
            self.schedule();
            if !batch.is_empty() {
                return Ok(Wait::Got);
            }
            if let State::Lost { why, .. } = self.state {
                return Err(why.lost(&self.place));
            }
            if self.now() >= limit {
                return Ok(Wait::TimedOut);
            }
        }
    }

    fn range(&self) -> Option<[f64; 2]> {
        let of = |sensor: usize| self.units.iter().find_map(|unit| unit.range()[sensor]);
        Some([of(0)?, of(1)?])
    }

    fn counters(&self) -> Vec<(&'static str, u64)> {
        self.counts().list()
    }
}
