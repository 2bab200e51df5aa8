//! Cameras through V4L2: a node for each, or one node with their pictures side by side.
//!
//! A thin layer of our own over the ioctls (`kernel`, `uapi`): buffers are the kernel's, mapped once; frames are paired
//! while they still lie there (`stamps::pair`), and a pair is written into the caller's images by the one copy there is,
//! which also makes 8-bit grey of them (`pixels`). Everything that decides is a function of numbers, and every system
//! call goes through one trait, so that each error of each of them is met in tests without a camera.
//!
//! Stamps are the driver's, brought to the middle of the exposure of the first row (`stamps::Timing`) and then to the
//! calibration's clock and middle row, as recordings' are. A frame is Got when every camera has one within the tolerance;
//! what has no partner is counted and its buffer given back at once. A camera that is unplugged or silent is closed and,
//! from the next call on, looked for by its name and opened again, with growing pauses. Meanwhile, and from a
//! quarter of such a silence on, the others go on without it: its image is black, and `away` says why. The rig is `Lost` when
//! none is left.
//!
//! Nothing is allocated between opening and losing a camera, except by the JPEG decoder and to word a warning.

mod controls;
mod fault;
mod find;
mod kernel;
mod node;
mod offer;
mod pixels;
mod stamps;
#[cfg(test)]
mod tests;
mod uapi;

pub use find::Select;
pub use pixels::Format;
pub use stamps::StampPoint;

use crate::source::{FrameSource, SourceFault, Wait};
use crate::types::{Frames, Nanos, Span};
use crate::{Calibration, Fault, FaultKind, RigCamera};
use fault::is_gone;
use kernel::{Kernel, Linux, Ready, NODES_MAX};
use node::{Failure, Filled, Node, Taken};
use pixels::{to_grey, Part, Unreadable};
use stamps::{pair, stamp_of, Gaps, Order, Pairing, Stamp, Timing};
use std::collections::VecDeque;
use std::sync::Arc;

/// What the board file says of the cameras.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// One a camera, in the order of the calibration; or one, with the pictures of all side by side.
    pub devices: Vec<Select>,
    /// None: the first of `Format::ALL` that the camera has in its size.
    pub format: Option<Format>,
    /// Of one camera's picture.
    pub width: usize,
    pub height: usize,
    pub rate_hz: f64,
    /// Zero: as the camera has it.
    pub exposure: Span,
    /// Unit of `exposure` where the camera counts it in lines; zero: it does not.
    pub exposure_line: Span,
    /// Anything else, by the names of `v4l2-ctl --list-ctrls`: gain, black level, trigger.
    pub controls: Vec<(String, i64)>,
    pub stamp: StampPoint,
    /// From the end of the first row's exposure until the last row was received.
    pub transfer: Span,
    pub pair_tolerance: Span,
}

/// First and longest pause between attempts to open a lost camera: a USB device needs some 0.2 s to come up, and an
/// attempt costs a millisecond.
const RETRY_MIN: Span = Span(100_000_000);
const RETRY_MAX: Span = Span(2_000_000_000);
/// Errors in a row after which a camera is opened again.
const ERRORS_MAX: u32 = 8;
/// A camera that gave nothing for so long is opened again: a device that hangs is reset by it, and no camera that is meant
/// to feed odometry pauses for longer.
const SILENT: Span = Span(2_000_000_000);
/// The others go on without a camera that gave nothing for so many periods, and so long: a quarter of what odometry bridges.
const AWAY_PERIODS: i64 = 5;
const AWAY: Span = Span(500_000_000);
/// Warnings kept.
const WARNINGS_MAX: usize = 32;

crate::counters! {
    /// What cameras met, since they were opened first.
    #[derive(Clone, Copy, PartialEq, Eq)]
    pub struct CameraCounters of u64, read by u64::clone;
    /// Frames given: one image of every camera.
    camera_frames,
    /// Calls that waited in vain.
    camera_timeouts,
    /// Bytes written from the kernel's buffers into images: of grey pictures once each pixel.
    camera_bytes_copied,
    /// Images missing before one that came, by its number and by its stamp.
    camera_missed_by_sequence,
    camera_missed_by_stamp,
    /// Black images in the place of a lost camera's.
    camera_images_absent,
    /// Images without a partner within the tolerance.
    camera_images_unpaired,
    /// Images that the driver marked as damaged.
    camera_images_corrupt,
    /// Images of fewer bytes than their size takes.
    camera_images_short,
    /// Compressed images that could not be decoded.
    camera_images_undecodable,
    /// Images that the driver reported as lost (EIO).
    camera_io_errors,
    /// Images stamped by us, as their driver says not in which clock it stamps, or copied the stamp from elsewhere.
    camera_stamps_unknown,
    camera_stamps_copied,
    /// Images dropped for a stamp in the future, or from long ago.
    camera_stamps_implausible,
    /// Images and frames dropped for a stamp that is not newer than the last one's.
    camera_stamps_not_newer,
    /// Times that a camera was unplugged, refused to go on, or fell silent.
    camera_losses,
    /// Of these, because it fell silent.
    camera_silences,
    /// Times that one was there again.
    camera_returns,
}

/// An image that still lies in the kernel's buffer; `t` is in the calibration's clock.
struct Held {
    filled: Filled,
    t: Nanos,
}

/// A node with what was taken from it.
struct Stream {
    node: Node,
    held: VecDeque<Held>,
    timing: Timing,
    gaps: Gaps,
    /// When it last gave anything, or was opened.
    heard: Nanos,
    /// When it last gave an image. None: nobody goes on without it until it has.
    spoke: Option<Nanos>,
    errors: u32,
}

struct Lost {
    fault: Fault,
    retry_at: Nanos,
    pause: Span,
}

/// The cameras of a rig.
pub struct Rig {
    kernel: Arc<dyn Kernel>,
    settings: Settings,
    cameras: Vec<RigCamera>,
    /// One a device, `None` while it is closed. `lost` says why, until it has given an image again.
    streams: Vec<Option<Stream>>,
    lost: Vec<Option<Lost>>,
    /// That none is left was said.
    told: bool,
    last: Nanos,
    scratch: Vec<u8>,
    counters: CameraCounters,
    warnings: Vec<String>,
}

impl Rig {
    /// Finds, sets and starts the cameras of `calibration`.
    pub fn open(settings: Settings, calibration: &Calibration) -> Result<Rig, Fault> {
        Rig::open_in(Arc::new(Linux), settings, calibration)
    }

    fn open_in(kernel: Arc<dyn Kernel>, settings: Settings, calibration: &Calibration) -> Result<Rig, Fault> {
        let cameras = calibration.cameras.clone();
        check(&settings, &cameras)?;
        let (streams, scratch) = (Vec::new(), Vec::new());
        let (counters, warnings) = (CameraCounters::default(), Vec::with_capacity(WARNINGS_MAX));
        let last = Nanos::MIN;
        let lost = settings.devices.iter().map(|_| None).collect();
        let told = false;
        let mut rig = Rig { kernel, settings, cameras, streams, lost, told, last, scratch, counters, warnings };
        for select in &rig.settings.devices {
            let stream = rig.open_stream(select, None)?;
            rig.streams.push(Some(stream));
        }
        Ok(rig)
    }

    /// What is open, in words, a line for each node: path, name, format, exposure.
    pub fn describe(&self) -> Vec<String> {
        let line = |s: &Stream| {
            let (node, part) = (&s.node, s.node.part);
            let (hz, us) = (1.0 / node.period.secs(), node.exposure.0 / 1000);
            format!(
                "{}: {} {}x{} at {hz:.2} Hz, exposure {us} us",
                node.name,
                node.format.name(),
                part.width,
                part.height
            )
        };
        self.streams.iter().flatten().map(line).collect()
    }

    /// Pictures side by side in each node's.
    fn parts(&self) -> usize {
        self.cameras.len() / self.settings.devices.len()
    }

    fn open_stream(&self, select: &Select, spoke: Option<Nanos>) -> Result<Stream, Fault> {
        let path = find::find(&*self.kernel, select)?;
        let node = Node::open(self.kernel.clone(), &path, self.parts(), &self.settings)?;
        let timing = Timing { point: self.settings.stamp, exposure: node.exposure, transfer: self.settings.transfer };
        let held = VecDeque::with_capacity(node.held_max());
        Ok(Stream { node, held, timing, gaps: Gaps::default(), heard: self.kernel.now(), spoke, errors: 0 })
    }

    fn warn(&mut self, line: impl FnOnce() -> String) {
        if self.warnings.len() < WARNINGS_MAX {
            self.warnings.push(line());
        }
    }

    fn lose(&mut self, index: usize, fault: Fault) {
        let (now, before) = (self.kernel.now(), self.lost[index].as_ref().map(|l| l.pause));
        if before.is_none() {
            self.counters.camera_losses += 1;
            self.warn(|| fault.to_string());
        }
        self.streams[index] = None;
        let pause = before.map_or(RETRY_MIN, |p| Span((2 * p.0).min(RETRY_MAX.0)));
        self.lost[index] = Some(Lost { fault, retry_at: now + pause, pause });
    }

    /// Tries to open again what is lost, each camera when its pause is over.
    fn come_back(&mut self) {
        for index in 0..self.lost.len() {
            let due = self.lost[index].as_ref().is_some_and(|l| l.retry_at <= self.kernel.now());
            if due && self.streams[index].is_none() {
                match self.open_stream(&self.settings.devices[index], Some(Nanos::MIN)) {
                    Ok(stream) => self.streams[index] = Some(stream),
                    Err(fault) => self.lose(index, fault),
                }
            }
        }
    }

    /// Until the next camera is looked for.
    fn until_retry(&self) -> Option<Span> {
        let closed = self.lost.iter().zip(&self.streams).filter(|(_, s)| s.is_none());
        closed.filter_map(|(l, _)| Some(l.as_ref()?.retry_at - self.kernel.now())).min()
    }

    /// What is said of a rig without a camera.
    fn all_lost(&self) -> Option<Fault> {
        let none = self.streams.iter().all(Option::is_none);
        self.lost.iter().flatten().next().filter(|_| none).map(|l| l.fault.clone())
    }

    /// Takes everything that lies ready; whether there was anything.
    fn drain(&mut self) -> bool {
        let mut any = false;
        for index in 0..self.streams.len() {
            match self.drain_one(index) {
                Ok(some) => any |= some,
                Err(fault) => self.lose(index, fault),
            }
        }
        any
    }

    fn drain_one(&mut self, index: usize) -> Result<bool, Fault> {
        let mut any = false;
        while let Some(stream) = &mut self.streams[index] {
            match stream.node.take().map_err(|f| stopped(&stream.node, f))? {
                Taken::Nothing => break,
                Taken::Corrupt => {
                    stream.heard = self.kernel.now();
                    self.counters.camera_images_corrupt += 1;
                }
                Taken::Failed(error) => {
                    self.counters.camera_io_errors += 1;
                    stream.errors += 1;
                    if stream.errors >= ERRORS_MAX {
                        return Err(stopped(&stream.node, Failure { call: "VIDIOC_DQBUF", error }));
                    }
                    break;
                }
                Taken::Filled(filled) => {
                    let (now, camera, counters) = (self.kernel.now(), &self.cameras[index], &mut self.counters);
                    stream.hold(filled, now, camera, counters)?;
                    // Back is who gives an image, not who can be opened.
                    counters.camera_returns += u64::from(self.lost[index].take().is_some());
                    any = true;
                    // Enough to decide with; the driver keeps the rest in order.
                    if stream.is_full() {
                        break;
                    }
                }
            }
        }
        Ok(any)
    }

    /// Gives back the oldest image held of a camera.
    fn give_back(&mut self, index: usize) {
        if let Some(Err(fault)) = self.streams[index].as_mut().map(Stream::give_back) {
            self.lose(index, fault);
        }
    }

    /// Writes the oldest frame that all cameras have that are there; whether there is one.
    fn deliver(&mut self, frames: &mut Frames) -> bool {
        loop {
            let (mut heads, mut full, mut of, mut n) = ([None; NODES_MAX], [false; NODES_MAX], [0; NODES_MAX], 0);
            let now = self.kernel.now();
            let there = |(i, s): (usize, &'_ Option<Stream>)| s.as_ref().filter(|s| !s.is_away(now)).map(|_| i);
            for index in self.streams.iter().enumerate().filter_map(there) {
                let Some(s) = &self.streams[index] else { continue };
                (heads[n], full[n], of[n]) = (s.held.front().map(|h| h.t), s.is_full(), index);
                n += 1;
            }
            match pair(&heads[..n], &full[..n], self.settings.pair_tolerance) {
                Pairing::Wait => return false,
                Pairing::Drop(i) => {
                    self.counters.camera_images_unpaired += 1;
                    self.give_back(of[i]);
                }
                Pairing::Together => {
                    let written = self.write(frames);
                    of[..n].iter().for_each(|index| self.give_back(*index));
                    if written {
                        return true;
                    }
                }
            }
        }
    }

    /// Copies the oldest image of every camera; whether they make a frame.
    fn write(&mut self, frames: &mut Frames) -> bool {
        let first = self.streams.iter().flatten().find_map(|s| s.held.front());
        let t = first.expect("called when all that are there have one").t;
        if t <= self.last {
            self.counters.camera_stamps_not_newer += 1;
            return false;
        }
        let parts = self.parts();
        for (camera, image) in frames.images.iter_mut().enumerate() {
            let of = self.streams[camera / parts].as_ref();
            let Some((stream, held)) = of.and_then(|s| Some((s, s.held.front()?))) else {
                image.pixels.fill(0);
                self.counters.camera_images_absent += 1;
                continue;
            };
            let part = Part { x: camera % parts * image.width, ..stream.node.part };
            let bytes = stream.node.bytes(&held.filled);
            let copied = to_grey(stream.node.format, bytes, part, &mut self.scratch, image);
            self.counters.camera_bytes_copied += image.pixels.len() as u64;
            let Err(why) = copied else { continue };
            match why {
                Unreadable::Short { .. } => self.counters.camera_images_short += 1,
                Unreadable::Undecodable(_) => self.counters.camera_images_undecodable += 1,
            }
            if self.warnings.len() < WARNINGS_MAX {
                self.warnings.push(format!("{}: image at {}: {why}", stream.node.name, t.0));
            }
            return false;
        }
        // A grey camera's colours are equal.
        for (colour, image) in frames.colours.iter_mut().zip(&frames.images) {
            colour.iter_mut().for_each(|plane| plane.copy_from(image));
            self.counters.camera_bytes_copied += 3 * image.pixels.len() as u64;
        }
        frames.t = t;
        self.last = t;
        self.counters.camera_frames += 1;
        true
    }

    /// Waits until a camera has something, or for `remaining`.
    fn wait(&mut self, remaining: Span) -> Result<(), Fault> {
        let (mut fds, mut ready) = ([-1; NODES_MAX], [Ready::default(); NODES_MAX]);
        fds.iter_mut().zip(self.streams.iter().flatten()).for_each(|(fd, s)| *fd = s.node.fd);
        let n = self.streams.iter().flatten().count();
        let remaining = self.until_retry().map_or(remaining, |retry| retry.min(remaining));
        let polled = self.kernel.poll(&fds[..n], &mut ready[..n], remaining);
        polled.map_err(|e| fault::refused("cameras", "wait for a frame", "poll", &e))?;
        let (now, mut ready) = (self.kernel.now(), ready.into_iter());
        for index in 0..self.streams.len() {
            let Some(stream) = &mut self.streams[index] else { continue };
            if let Err(fault) = stream.heeds(ready.next().unwrap_or_default(), now) {
                let silent = now - stream.heard > SILENT;
                self.counters.camera_silences += u64::from(silent && self.lost[index].is_none());
                self.lose(index, fault);
            }
        }
        Ok(())
    }

    /// False where the time is over. That no camera is left is said at once when it comes to that, and after the time while
    /// it stays so.
    fn next_frame(&mut self, deadline: Nanos, frames: &mut Frames) -> Result<bool, SourceFault> {
        loop {
            self.come_back();
            let any = self.drain();
            if self.deliver(frames) {
                return Ok(true);
            }
            let (remaining, lost) = (deadline - self.kernel.now(), self.all_lost());
            let over = remaining.0 <= 0 && !any;
            self.told &= lost.is_some();
            match (lost.clone(), over) {
                (Some(fault), over) if over || !self.told => {
                    self.told = true;
                    return Err(SourceFault::Lost(fault));
                }
                (None, true) => return Ok(false),
                _ => {}
            }
            match self.wait(remaining) {
                Ok(()) => {}
                // The wait was a sleep, and one that cannot be had would make a loop.
                Err(fault) if lost.is_some() => return Err(SourceFault::Broken(fault)),
                Err(fault) => (0..self.streams.len()).for_each(|index| self.lose(index, fault.clone())),
            }
        }
    }
}

impl Stream {
    fn is_full(&self) -> bool {
        self.held.len() >= self.node.held_max()
    }

    /// The others go on without it.
    fn is_away(&self, now: Nanos) -> bool {
        let patience = Span(self.node.period.0.saturating_mul(AWAY_PERIODS)).max(AWAY);
        self.held.is_empty() && self.spoke.is_some_and(|t| now - t > patience)
    }

    /// What poll said. What an error means is said by the next call that takes a buffer; one that says nothing is answered
    /// here.
    fn heeds(&mut self, ready: Ready, now: Nanos) -> Result<(), Fault> {
        if ready.error && !ready.readable {
            self.errors += 1;
            if self.errors >= ERRORS_MAX {
                let what = "poll reports an error and no frame";
                return Err(Fault::new(FaultKind::Io, &self.node.name, what, "`dmesg` says more"));
            }
        }
        if !ready.readable && now - self.heard > SILENT {
            let what = format!("gave nothing for {:.1} s", (now - self.heard).secs());
            let fix = "check its cable and its trigger";
            return Err(Fault::new(FaultKind::Io, &self.node.name, what, fix));
        }
        Ok(())
    }

    /// Keeps an image until its partners come, or gives its buffer back at once.
    fn hold(
        &mut self,
        filled: Filled,
        now: Nanos,
        camera: &RigCamera,
        counters: &mut CameraCounters,
    ) -> Result<(), Fault> {
        (self.heard, self.spoke, self.errors) = (now, Some(now), 0);
        let arrived = Timing { point: StampPoint::FrameEnd, ..self.timing }.mid_exposure(now, 0);
        let stamp = match stamp_of(filled.flags, filled.stamp_s, filled.stamp_us, now) {
            Stamp::Monotonic(t) => Some(self.timing.mid_exposure(t, filled.flags)),
            Stamp::Implausible => {
                counters.camera_stamps_implausible += 1;
                None
            }
            // Now is after the last row, by as long as we were not running.
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
                self.held.push_back(Held { filled, t: camera.to_imu_clock(t) });
                return Ok(());
            }
            Some((_, Order::NotNewer)) => counters.camera_stamps_not_newer += 1,
            None => {}
        }
        self.node.give_back(filled).map_err(|f| stopped(&self.node, f))
    }

    /// Gives back the oldest image held.
    fn give_back(&mut self) -> Result<(), Fault> {
        let Some(held) = self.held.pop_front() else { return Ok(()) };
        self.node.give_back(held.filled).map_err(|f| stopped(&self.node, f))
    }
}

/// A system call that failed while streaming.
fn stopped(node: &Node, failure: Failure) -> Fault {
    let purpose = if is_gone(&failure.error) { "go on: it was unplugged" } else { "go on" };
    fault::refused(&node.name, purpose, failure.call, &failure.error)
}

/// Settings and calibration must be of the same rig.
fn check(settings: &Settings, cameras: &[RigCamera]) -> Result<(), Fault> {
    let wrong = |what: String, fix: &str| Err(Fault::new(FaultKind::Config, "[camera]", what, fix));
    let (devices, count) = (settings.devices.len(), cameras.len());
    if devices == 0 || count == 0 || count > NODES_MAX || (devices != count && devices != 1) {
        let what = format!("camera.devices names {devices}, the calibration has {count} cameras (at most {NODES_MAX})");
        return wrong(what, "name one device a camera, or one that gives all side by side");
    }
    for (i, device) in settings.devices.iter().enumerate() {
        if settings.devices[..i].contains(device) {
            return wrong(format!("camera.devices names {device} twice"), "name each camera once");
        }
    }
    let other = |c: &&RigCamera| (c.camera.width, c.camera.height) != (settings.width, settings.height);
    if let Some(c) = cameras.iter().find(other) {
        let size = format!("{}x{}", c.camera.width, c.camera.height);
        let what =
            format!("the calibration is of {size}, the cameras are asked for {}x{}", settings.width, settings.height);
        return wrong(what, "calibrate at the size that is used");
    }
    let rate = settings.rate_hz;
    if !(rate > 0.0 && rate.is_finite()) {
        return wrong(format!("camera.rate_hz = {rate} is no rate"), "state the cameras' rate");
    }
    if devices > 1 && settings.pair_tolerance.secs() * rate >= 0.5 {
        let what = format!("camera.pair_tolerance_s is half a period at {rate} Hz or more: any two frames would pair");
        return wrong(what, "lower it");
    }
    Ok(())
}

impl FrameSource for Rig {
    fn next(&mut self, timeout: Span, frames: &mut Frames) -> Result<Wait, SourceFault> {
        let shaped =
            |(image, c): (&crate::Image, &RigCamera)| (image.width, image.height) == (c.camera.width, c.camera.height);
        if frames.images.len() != self.cameras.len() || !frames.images.iter().zip(&self.cameras).all(shaped) {
            let what = "frames are not shaped by the calibration that the cameras were opened with";
            return Err(SourceFault::Broken(Fault::new(FaultKind::Internal, "cameras", what, "use Frames::for_rig")));
        }
        let deadline = self.kernel.now() + timeout;
        if self.next_frame(deadline, frames)? {
            return Ok(Wait::Got);
        }
        self.counters.camera_timeouts += 1;
        Ok(Wait::TimedOut)
    }

    fn away(&self) -> Option<&Fault> {
        self.lost.iter().flatten().next().map(|l| &l.fault)
    }

    fn counters(&self) -> Vec<(&'static str, u64)> {
        self.counters.list()
    }

    fn warnings(&self) -> &[String] {
        &self.warnings
    }
}
