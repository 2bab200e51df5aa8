//! The exposure of each frame, where it may change after a camera was opened: half of it is in the frame's stamp.
//!
//! An exposure that the camera sets by itself (its control is volatile, or its automatic exposure is on) is read with each
//! frame. One that somebody else may set is heard of: the kernel queues an event when it is set, and holds from the first
//! frame that is stamped after that. Either costs one system call a frame, and neither waits: a camera whose exposure takes
//! long to read, or cannot be read, keeps the last one. A driver with neither keeps the one that it had when it was opened.

use super::kernel::{Kernel, Request};
use super::uapi::*;
use crate::types::{Nanos, Span};

/// Longest that reading an exposure may take. A register takes microseconds, a transfer over USB a millisecond.
const READ_MAX: Span = Span(10_000_000);

/// How changes are followed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Follow {
    /// Not at all.
    No,
    /// By the kernel's events.
    Events,
    /// By reading.
    Reads,
}

/// The exposure of a camera's frames.
#[derive(Clone, Copy, Debug)]
pub(super) struct Exposure {
    /// That of the newest frame; zero: the camera does not say.
    pub now: Span,
    /// One that somebody set, and when.
    set: Option<(Nanos, Span)>,
    /// How it is followed.
    pub follow: Follow,
    control: QueryControl,
    /// Time of one count of the control.
    unit: Span,
}

/// The outcome of following an exposure to a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Followed {
    Same,
    Changed,
    /// It could not be read, or not in time, and is not any more.
    Lost,
}

impl Exposure {
    /// The exposure of a camera that has the control, at the value `count`.
    pub(super) fn new(control: &QueryControl, unit: Span, count: i64) -> Exposure {
        let now = Span(count.saturating_mul(unit.0));
        Exposure { now, set: None, follow: Follow::No, control: *control, unit }
    }

    /// The exposure of a camera that does not say: it stays zero.
    pub(super) fn unknown() -> Exposure {
        Exposure::new(&QueryControl::default(), Span(0), 0)
    }

    /// Begins to follow it; `automatic`: the camera sets it by itself, although the control may not say so.
    pub(super) fn begin(&mut self, kernel: &dyn Kernel, fd: i32, automatic: bool) {
        if automatic || self.control.flags & CONTROL_VOLATILE != 0 {
            self.follow = Follow::Reads;
            return;
        }
        let mut asked = EventSubscription { kind: EVENT_CONTROL, id: self.control.id, ..Default::default() };
        if kernel.ioctl(fd, Request::SubscribeEvent(&mut asked)).is_ok() {
            self.follow = Follow::Events;
        }
    }

    /// Brings it to the frame that the driver stamped at `stamp`.
    pub(super) fn follow(&mut self, kernel: &dyn Kernel, fd: i32, stamp: Nanos) -> Followed {
        let before = self.now;
        match self.follow {
            Follow::No => return Followed::Same,
            Follow::Reads => {
                let begun = kernel.now();
                let mut asked = ExtControl { id: self.control.id, ..ExtControl::default() };
                let read = kernel.ioctl(fd, Request::GetExtControl(&mut asked));
                if read.is_ok() {
                    self.now = self.time_of(asked.value);
                }
                if read.is_err() || kernel.now() - begun > READ_MAX {
                    self.follow = Follow::No;
                    return Followed::Lost;
                }
            }
            Follow::Events => {
                // One that holds already makes room for the next.
                self.take_set(stamp);
                let mut event = Event::default();
                if kernel.ioctl(fd, Request::DequeueEvent(&mut event)).is_ok() {
                    let changed = event.changes & EVENT_CONTROL_VALUE != 0 && event.id == self.control.id;
                    let at = Nanos(event.stamp_s.saturating_mul(1_000_000_000).saturating_add(event.stamp_ns));
                    if event.kind == EVENT_CONTROL && changed {
                        self.set = Some((at, self.time_of(event.value)));
                    }
                }
                self.take_set(stamp);
            }
        }
        if self.now == before {
            Followed::Same
        } else {
            Followed::Changed
        }
    }

    fn take_set(&mut self, stamp: Nanos) {
        if let Some((_, set)) = self.set.take_if(|(at, _)| *at <= stamp) {
            self.now = set;
        }
    }

    fn time_of(&self, value: i64) -> Span {
        Span(self.control.number(value).saturating_mul(self.unit.0))
    }
}
