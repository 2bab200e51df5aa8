//! Writers that tell others of a flight while it goes on. None of them can hold it up: what a thread of the flight hands over
//! is put into a queue of fixed size, where the newest wins, and writers do the rest on threads of their own.
//!
//! ```text
//! estimator, per frame ------> Feed -> thread `autopilot` -> UART or UDP
//! imu, between frames ---------^
//! main, events ----------------^
//! ```

pub mod mavlink;

use crate::mem::{cut, List};
use crate::vio::{Covariance, Odometry, Update};
use crossbeam_queue::ArrayQueue;
use glam::DVec3;
use std::sync::Arc;
use stipple_drivers::counters::Counter;
use stipple_drivers::{counters, ImuSample};

/// States that may wait: a writer takes the newest.
const STATES: usize = 4;
/// Texts that may wait, and the longest, bytes; the rest is cut off.
const TEXTS: usize = 32;
const TEXT: usize = 200;
/// Lines about links that may wait.
const NOTICES: usize = 16;

/// A state of the vehicle.
#[derive(Clone, Copy, Debug)]
pub struct State {
    pub odometry: Odometry,
    /// Angular rate in the body's axes, rad/s.
    pub rate: DVec3,
    pub covariance: Option<Covariance>,
    pub epoch: u32,
    /// 0 to 100.
    pub quality: u8,
    pub source: Source,
}

impl State {
    /// Whether odometry has failed: nothing but inertia is left of it.
    pub fn has_failed(&self) -> bool {
        self.quality == 0 || self.source == Source::DeadReckoned
    }
}

/// Where a state comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Source {
    /// The estimate of a frame.
    Frame,
    /// The estimate of the last frame, carried on by inertial samples.
    Carried,
    /// The last estimate that was trusted, carried on by inertial samples while no estimator runs.
    DeadReckoned,
}

/// How bad what a text says is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Severity {
    Notice,
    Warning,
    Critical,
}

counters! {
    /// What writers were given and did with it.
    pub struct Counts of Counter, read by Counter::get;
    /// States that were not sent: a newer one came, the link had no room, or odometry had failed; texts that newer ones replaced.
    mavlink_states_skipped,
    mavlink_texts_lost,
    /// Messages sent, and those of them that are states.
    mavlink_sent,
    mavlink_states_sent,
    /// Messages that the link refused; times that it was opened anew.
    mavlink_refused,
    mavlink_reopened,
    /// Messages received, and bytes that belong to none.
    mavlink_received,
    mavlink_bytes_malformed,
    /// Longest time from a request of TIMESYNC to its answer, µs.
    mavlink_round_trip_us_most,
}

/// Where the threads of a flight hand over what is told. A clone is another handle to the same queues.
#[derive(Clone)]
pub struct Feed(Arc<Queues>);

struct Queues {
    states: ArrayQueue<State>,
    texts: ArrayQueue<(Severity, List<u8, TEXT>)>,
    /// Lines of writers about their links.
    notices: ArrayQueue<String>,
    counts: Counts,
    waker: mio::Waker,
}

impl Feed {
    fn new(waker: mio::Waker) -> Feed {
        let (states, texts, notices) = (ArrayQueue::new(STATES), ArrayQueue::new(TEXTS), ArrayQueue::new(NOTICES));
        Feed(Arc::new(Queues { states, texts, notices, counts: Counts::default(), waker }))
    }

    /// Hands over a state. Allocates nothing and waits for nobody.
    pub fn state(&self, state: State) {
        self.0.counts.mavlink_states_skipped.add(u64::from(self.0.states.force_push(state).is_some()));
        self.wake();
    }

    /// Hands over the state of a frame, where it has one; `sample` is the last before it.
    pub fn frame(&self, update: &Update, sample: Option<&ImuSample>) {
        let (odometry, source) = match (update.odometry, update.dead_reckoned) {
            (Some(odometry), _) => (odometry, Source::Frame),
            (None, Some(odometry)) => (odometry, Source::DeadReckoned),
            (None, None) => return,
        };
        let rate = sample.map_or(DVec3::ZERO, |sample| sample.gyro_body - odometry.gyro_bias);
        let (covariance, epoch, quality) = (update.covariance, update.epoch, update.quality);
        self.state(State { odometry, rate, covariance, epoch, quality, source });
    }

    /// Hands over a text for people.
    pub fn text(&self, severity: Severity, text: &str) {
        let replaced = self.0.texts.force_push((severity, cut(text)));
        self.0.counts.mavlink_texts_lost.add(u64::from(replaced.is_some()));
        self.wake();
    }

    /// Lines about links since this was asked last.
    pub fn notices(&self) -> impl Iterator<Item = String> + '_ {
        std::iter::from_fn(|| self.0.notices.pop())
    }

    /// What was told so far.
    pub fn counters(&self) -> Vec<(&'static str, u64)> {
        self.0.counts.list()
    }

    fn wake(&self) {
        // It fails where its counter is full: the writer is awake then.
        let _ = self.0.waker.wake();
    }
}
