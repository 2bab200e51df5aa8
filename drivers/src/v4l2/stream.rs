//! One node with the images that were taken from it and wait for their partners. Times come in as numbers; whether a camera
//! is missed or silent is decided here.

use super::exposure::Followed;
use super::fault::{is_gone, refused};
use super::kernel::Ready;
use super::node::{Failure, Filled, Node};
use super::stamps::{stamp_of, Gaps, Order, Stamp, Timing};
use super::{CameraCounters, StampPoint};
use crate::source::missed_after;
use crate::types::{Nanos, Span};
use crate::{Fault, FaultKind, RigCamera};
use std::collections::VecDeque;

/// A camera that gave nothing for so long is opened again. That resets a device that hangs, and no camera that odometry can
/// use pauses for longer.
pub(super) const SILENT: Span = Span(2_000_000_000);
/// Errors in a row after which a camera is opened again.
const ERRORS_MAX: u32 = 8;

/// An image that still lies in the kernel's buffer; `t` is in the calibration's clock.
pub(super) struct Held {
    /// The buffer.
    pub filled: Filled,
    /// Mid-exposure instant in the calibration's clock.
    pub t: Nanos,
    /// Half the exposure of a row.
    pub half: Span,
}

/// A node and its held images, oldest first.
pub(super) struct Stream {
    /// The node that streams.
    pub node: Node,
    /// Images that wait for their partners, oldest first.
    pub held: VecDeque<Held>,
    timing: Timing,
    gaps: Gaps,
    /// When it last gave anything, or was opened.
    last_sign: Nanos,
    /// When it last gave an image. `None`: not since boot, and no frame goes without it.
    last_image: Option<Nanos>,
    errors: u32,
}

impl Stream {
    pub(super) fn new(node: Node, timing: Timing, now: Nanos, last_image: Option<Nanos>) -> Stream {
        let held = VecDeque::with_capacity(node.held_max());
        Stream { node, held, timing, gaps: Gaps::default(), last_sign: now, last_image, errors: 0 }
    }

    /// Whether no more images can be held.
    pub(super) fn is_full(&self) -> bool {
        self.held.len() >= self.node.held_max()
    }

    /// Whether the others go on without it.
    pub(super) fn is_missed(&self, now: Nanos) -> bool {
        self.held.is_empty() && self.last_image.is_some_and(|t| now - t > missed_after(self.node.period))
    }

    /// Whether it has given nothing for so long that it is opened again.
    pub(super) fn is_silent(&self, now: Nanos) -> bool {
        now - self.last_sign > SILENT
    }

    /// Checks the answer of poll. An error that another call can explain is left to that call.
    pub(super) fn check(&mut self, ready: Ready, now: Nanos) -> Result<(), Fault> {
        if ready.readable {
            return Ok(());
        }
        let fault = |what: String, fix| Err(Fault::new(FaultKind::Io, &self.node.name, what, fix));
        if ready.error {
            self.errors += 1;
            if self.errors >= ERRORS_MAX {
                return fault("poll reports an error and no frame".to_string(), "`dmesg` says more");
            }
        }
        if self.is_silent(now) {
            let what = format!("gave nothing for {:.1} s", (now - self.last_sign).secs());
            return fault(what, "check its cable and its trigger");
        }
        Ok(())
    }

    /// Notes that it gave an image that is damaged.
    pub(super) fn gave_corrupt(&mut self, now: Nanos) {
        self.last_sign = now;
    }

    /// Notes that the driver reported an image as lost; too many of them in a row are a fault.
    pub(super) fn gave_error(&mut self, error: std::io::Error) -> Result<(), Fault> {
        self.errors += 1;
        if self.errors < ERRORS_MAX {
            return Ok(());
        }
        Err(stopped(&self.node, Failure { call: "VIDIOC_DQBUF", error }))
    }

    /// Keeps an image until its partners come, or gives its buffer back at once.
    pub(super) fn hold(
        &mut self,
        filled: Filled,
        now: Nanos,
        camera: &RigCamera,
        counters: &mut CameraCounters,
    ) -> Result<(), Fault> {
        (self.last_sign, self.last_image, self.errors) = (now, Some(now), 0);
        let stamp = stamp_of(filled.flags, filled.stamp_s, filled.stamp_us, now);
        match self.node.follow_exposure(if let Stamp::Monotonic(t) = stamp { t } else { now }) {
            Followed::Same => {}
            Followed::Changed => counters.camera_exposure_changes += 1,
            Followed::Lost => counters.camera_exposures_lost += 1,
        }
        self.timing.exposure = self.node.exposure.now;
        // Now is after the last row, by as long as we were not running.
        let arrived = Timing { point: StampPoint::FrameEnd, ..self.timing }.mid_exposure(now, 0);
        let stamp = match stamp {
            Stamp::Monotonic(t) => Some(self.timing.mid_exposure(t, filled.flags)),
            Stamp::Implausible => {
                counters.camera_stamps_implausible += 1;
                None
            }
            Stamp::Unknown => {
                counters.camera_stamps_unknown += 1;
                Some(arrived)
            }
            Stamp::Copied => {
                counters.camera_stamps_copied += 1;
                Some(arrived)
            }
        };
        match stamp.map(|t| (t, self.gaps.see(filled.sequence, t, self.node.period))) {
            Some((t, Order::Next { missed_by_sequence, missed_by_stamp })) => {
                counters.camera_missed_by_sequence += missed_by_sequence;
                counters.camera_missed_by_stamp += missed_by_stamp;
                let half = Span(self.timing.exposure.0 / 2);
                self.held.push_back(Held { filled, t: camera.to_imu_clock(t), half });
                return Ok(());
            }
            Some((_, Order::NotNewer)) => counters.camera_stamps_not_newer += 1,
            None => {}
        }
        self.node.give_back(filled).map_err(|f| stopped(&self.node, f))
    }

    /// Gives back the oldest image held.
    pub(super) fn give_back(&mut self) -> Result<(), Fault> {
        let Some(held) = self.held.pop_front() else { return Ok(()) };
        self.node.give_back(held.filled).map_err(|f| stopped(&self.node, f))
    }
}

/// The fault of a system call that failed while streaming.
pub(super) fn stopped(node: &Node, failure: Failure) -> Fault {
    let purpose = if is_gone(&failure.error) { "go on: it was unplugged" } else { "go on" };
    refused(&node.name, purpose, failure.call, &failure.error)
}
