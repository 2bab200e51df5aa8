//! Writers that tell others of a flight while it goes on. None of them can hold it up: what a thread of the flight hands over
//! is put into a queue of fixed size, where the newest wins, and writers do the rest on threads of their own.
//!
//! ```text
//! estimator, per frame ---+--> Feed -> thread `autopilot` -> UART or UDP
//! imu, between frames ----+--> Feed -> thread `status` ----> Unix socket
//! main, events -----------+
//! ```

pub mod cloud;
pub mod event;
pub mod mavlink;
pub mod status;
mod turned;

use crate::mem::{cut, List};
use crate::vio::{Covariance, Health, Odometry, Update};
use crossbeam_queue::ArrayQueue;
use event::{EventId, Notice};
use glam::DVec3;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::Arc;
use stipple_drivers::counters::Counter;
use stipple_drivers::{host, ImuSample, Nanos, Span};

/// States that may wait: a writer takes the newest.
const STATES: usize = 4;
/// Events that may wait, and the longest text, bytes; the rest is cut off.
const EVENTS: usize = 32;
pub const TEXT: usize = 200;
/// Events of writers that may wait.
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
    pub health: Health,
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
    /// The estimate of a frame, tracked or left to inertia.
    Frame,
    /// The estimate of the last frame, carried on by inertial samples.
    Carried,
    /// The last estimate that was trusted, carried on by inertial samples while no estimator runs.
    DeadReckoned,
}

/// How stamps of frames become those of the monotonic clock.
#[derive(Clone, Copy, Debug)]
pub struct Stamps {
    /// This stamp is of this instant.
    pub stamp: Nanos,
    pub monotonic: Nanos,
    /// Seconds of stamps a second.
    pub speed: f64,
}

impl Default for Stamps {
    /// They are of that clock.
    fn default() -> Stamps {
        Stamps { stamp: Nanos(0), monotonic: Nanos(0), speed: 1.0 }
    }
}

impl Stamps {
    fn monotonic(&self, t: Nanos) -> Nanos {
        let since = t - self.stamp;
        let since = if self.speed == 1.0 { since } else { Span::from_secs(since.secs() / self.speed) };
        self.monotonic + since
    }
}

/// An event on its way to a writer.
#[derive(Clone, Debug)]
pub struct Event {
    pub id: EventId,
    pub at: Nanos,
    pub text: List<u8, TEXT>,
}

/// Where the threads of a flight hand over what one writer tells. A clone is another handle to the same queues.
#[derive(Clone)]
pub struct Feed(Arc<Queues>);

struct Queues {
    states: ArrayQueue<State>,
    /// Whether the writer wants states now.
    wants_states: AtomicBool,
    events: ArrayQueue<Event>,
    /// What writers say of their links.
    notices: ArrayQueue<Notice>,
    /// States that were not sent: a newer one came, the link had no room, or odometry had failed.
    skipped: Counter,
    /// Events that newer ones replaced.
    lost: Counter,
    waker: mio::Waker,
}

impl Feed {
    fn new(waker: mio::Waker, wants_states: bool) -> Feed {
        Feed(Arc::new(Queues {
            states: ArrayQueue::new(STATES),
            wants_states: wants_states.into(),
            events: ArrayQueue::new(EVENTS),
            notices: ArrayQueue::new(NOTICES),
            skipped: Counter::default(),
            lost: Counter::default(),
            waker,
        }))
    }

    /// Hands over a state. Allocates nothing and waits for nobody.
    fn state(&self, state: State) {
        let replaced = self.0.states.force_push(state).is_some();
        if self.0.wants_states.load(Relaxed) {
            self.0.skipped.add(u64::from(replaced));
            self.wake();
        }
    }

    fn event(&self, id: EventId, text: &str) {
        let event = Event { id, at: host::monotonic(), text: cut(text) };
        self.0.lost.add(u64::from(self.0.events.force_push(event).is_some()));
        self.wake();
    }

    /// Says something of the writer's link. Where many wait, the first ones say what is wrong.
    fn say(&self, id: EventId, line: String) {
        let _ = self.0.notices.push((id, line));
    }

    /// What the writer said since this was asked last.
    pub fn notices(&self) -> impl Iterator<Item = Notice> + '_ {
        std::iter::from_fn(|| self.0.notices.pop())
    }

    /// States that were skipped and events that were lost, under these names.
    pub fn counters(&self, [skipped, lost]: [&'static str; 2]) -> Vec<(&'static str, u64)> {
        vec![(skipped, self.0.skipped.get()), (lost, self.0.lost.get())]
    }

    /// Wakes the writer, which looks whether it is to end.
    pub fn wake(&self) {
        // It fails where its counter is full: the writer is awake then.
        let _ = self.0.waker.wake();
    }
}

/// The feeds of all writers of a flight.
#[derive(Clone, Default)]
pub struct Feeds(pub Vec<Feed>);

impl Feeds {
    /// Hands over a state. Allocates nothing and waits for nobody.
    pub fn state(&self, state: State) {
        self.0.iter().for_each(|feed| feed.state(state));
    }

    /// Hands over the state of a frame, where it has one; `sample` is the last before it.
    pub fn frame(&self, update: &Update, sample: Option<&ImuSample>) {
        let (odometry, source) = match (update.odometry, update.dead_reckoned) {
            (Some(odometry), _) => (odometry, Source::Frame),
            (None, Some(odometry)) => (odometry, Source::DeadReckoned),
            (None, None) => return,
        };
        let rate = sample.map_or(DVec3::ZERO, |sample| sample.gyro_body - odometry.gyro_bias);
        let Update { covariance, epoch, quality, health, .. } = *update;
        self.state(State { odometry, rate, covariance, epoch, quality, health, source });
    }

    /// Hands over an event.
    pub fn event(&self, id: EventId, text: &str) {
        self.0.iter().for_each(|feed| feed.event(id, text));
    }
}
