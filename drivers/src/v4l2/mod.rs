//! Cameras through V4L2: a node for each, or one node with their pictures side by side.
//!
//! A thin layer of our own over the ioctls (`kernel`, `uapi`): buffers are the kernel's, mapped once; frames are paired
//! while they still lie there (`stamps::pair`), and a pair is written into the caller's images by the one copy there is,
//! which also makes 8-bit grey of them (`pixels`). Everything that decides is a function of numbers, and every system
//! call goes through one trait, so that each error of each of them is met in tests without a camera.
//!
//! Stamps are the driver's, brought to the middle of the exposure of the first row (`stamps::Timing`) and then to the
//! calibration's clock and middle row, as recordings' are. A frame is Got when every camera has one within the tolerance;
//! what has no partner is counted and its buffer given back at once. A camera that is unplugged or silent is `Lost`:
//! all of them are closed and, from the next call on, looked for by name and opened again, with growing pauses.
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
use crate::{Calibration, Exit, Fault, RigCamera};
use fault::is_gone;
use kernel::{Kernel, Linux, Ready, NODES_MAX};
use node::{Failure, Filled, Node, Taken};
use pixels::{to_grey, Part, Unreadable};
use stamps::{pair, stamp_of, Gaps, Order, Pairing, Stamp, Timing};
use std::collections::VecDeque;
use std::os::fd::{AsFd, BorrowedFd};
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
    /// Asked of each node.
    pub buffers: u32,
    /// A camera that gave nothing for so long is opened again.
    pub silent: Span,
    /// Export the buffers as DMA-BUF.
    pub export: bool,
}

/// First and longest pause between attempts to open a lost camera: a USB device needs some 0.2 s to come up, and an
/// attempt costs a millisecond.
const RETRY_MIN: Span = Span(100_000_000);
const RETRY_MAX: Span = Span(2_000_000_000);
/// Errors in a row after which a camera is opened again.
const ERRORS_MAX: u32 = 8;
/// Warnings kept.
const WARNINGS_MAX: usize = 32;

macro_rules! counters {
    ($($(#[doc = $doc:literal])* $name:ident),+ $(,)?) => {
        /// What cameras met, since they were opened first.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
        pub struct CameraCounters { $($(#[doc = $doc])* pub $name: u64),+ }
        impl CameraCounters {
            pub fn list(&self) -> Vec<(&'static str, u64)> {
                vec![$((stringify!($name), self.$name)),+]
            }
        }
    };
}

counters! {
    /// Frames given: one image of every camera.
    camera_frames,
    /// Calls that waited in vain.
    camera_timeouts,
    /// Bytes written from the kernel's buffers into images: of grey pictures once each pixel.
    camera_bytes_copied,
    /// Images missing before one that came, by its number and by its stamp.
    camera_missed_by_sequence,
    camera_missed_by_stamp,
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
    /// Times that all cameras were there again.
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
    /// When it last gave anything.
    heard: Nanos,
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
    /// Empty while lost.
    streams: Vec<Stream>,
    lost: Option<Lost>,
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
        let mut rig = Rig { kernel, settings, cameras, streams, lost: None, last, scratch, counters, warnings };
        rig.streams = rig.open_streams()?;
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
        self.streams.iter().map(line).collect()
    }

    /// Descriptors of a camera's buffers, where `Settings::export` asks for them: for whoever imports them.
    pub fn exported(&self, camera: usize) -> impl Iterator<Item = BorrowedFd<'_>> {
        self.streams.get(camera).into_iter().flat_map(|s| s.node.exported().map(|fd| fd.as_fd()))
    }

    /// Pictures side by side in each node's.
    fn parts(&self) -> usize {
        self.cameras.len() / self.settings.devices.len()
    }

    fn open_streams(&self) -> Result<Vec<Stream>, Fault> {
        let mut streams = Vec::with_capacity(self.settings.devices.len());
        for select in &self.settings.devices {
            let path = find::find(&*self.kernel, select)?;
            let node = Node::open(self.kernel.clone(), &path, self.parts(), &self.settings)?;
            let timing =
                Timing { point: self.settings.stamp, exposure: node.exposure, transfer: self.settings.transfer };
            let held = VecDeque::with_capacity(node.held_max());
            streams.push(Stream { node, held, timing, gaps: Gaps::default(), heard: self.kernel.now(), errors: 0 });
        }
        Ok(streams)
    }

    fn warn(&mut self, line: impl FnOnce() -> String) {
        if self.warnings.len() < WARNINGS_MAX {
            self.warnings.push(line());
        }
    }

    fn lose(&mut self, fault: Fault) {
        self.counters.camera_losses += 1;
        self.warn(|| fault.to_string());
        self.streams.clear();
        self.lost = Some(Lost { fault, retry_at: self.kernel.now() + RETRY_MIN, pause: RETRY_MIN });
    }

    /// Tries to open everything again until `deadline`.
    fn come_back(&mut self, deadline: Nanos) -> Result<(), SourceFault> {
        while let Some(mut lost) = self.lost.take() {
            if self.kernel.now() >= lost.retry_at {
                match self.open_streams() {
                    Ok(streams) => {
                        self.streams = streams;
                        self.counters.camera_returns += 1;
                        return Ok(());
                    }
                    Err(fault) => {
                        lost.fault = fault;
                        lost.pause = Span((2 * lost.pause.0).min(RETRY_MAX.0));
                        lost.retry_at = self.kernel.now() + lost.pause;
                    }
                }
            }
            let (now, until) = (self.kernel.now(), lost.retry_at.min(deadline));
            let over = deadline <= now || lost.retry_at >= deadline;
            let fault = lost.fault.clone();
            self.lost = Some(lost);
            if until > now {
                let slept = self.kernel.poll(&[], &mut [], until - now);
                slept.map_err(|e| SourceFault::Broken(fault::refused("cameras", "wait", "poll", &e)))?;
            }
            if over {
                return Err(SourceFault::Lost(fault));
            }
        }
        Ok(())
    }

    /// Takes everything that lies ready; whether there was anything.
    fn drain(&mut self) -> Result<bool, Fault> {
        let mut any = false;
        for index in 0..self.streams.len() {
            loop {
                let stream = &mut self.streams[index];
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
                        self.hold(index, filled)?;
                        any = true;
                        // Enough to decide with; the driver keeps the rest in order.
                        if self.streams[index].is_full() {
                            break;
                        }
                    }
                }
            }
        }
        Ok(any)
    }

    /// Keeps an image until its partners come, or gives its buffer back at once.
    fn hold(&mut self, index: usize, filled: Filled) -> Result<(), Fault> {
        let now = self.kernel.now();
        let (stream, counters) = (&mut self.streams[index], &mut self.counters);
        stream.heard = now;
        stream.errors = 0;
        let stamp = match stamp_of(filled.flags, filled.stamp_s, filled.stamp_us, now) {
            Stamp::Monotonic(t) => Some(stream.timing.mid_exposure(t, filled.flags)),
            Stamp::Implausible => {
                counters.camera_stamps_implausible += 1;
                None
            }
            // Now is after the last row, by as long as we were not running.
            Stamp::Unknown => {
                counters.camera_stamps_unknown += 1;
                Some(Timing { point: StampPoint::FrameEnd, ..stream.timing }.mid_exposure(now, 0))
            }
            Stamp::Copied => {
                counters.camera_stamps_copied += 1;
                Some(Timing { point: StampPoint::FrameEnd, ..stream.timing }.mid_exposure(now, 0))
            }
        };
        let order = stamp.map(|t| (t, stream.gaps.see(filled.sequence, t, stream.node.period)));
        match order {
            Some((t, Order::Next { missed_by_sequence, missed_by_stamp })) => {
                counters.camera_missed_by_sequence += missed_by_sequence;
                counters.camera_missed_by_stamp += missed_by_stamp;
                let t = self.cameras[index].to_imu_clock(t);
                stream.held.push_back(Held { filled, t });
                return Ok(());
            }
            Some((_, Order::NotNewer)) => counters.camera_stamps_not_newer += 1,
            None => {}
        }
        stream.node.give_back(filled).map_err(|f| stopped(&stream.node, f))
    }

    /// Gives back the oldest image held of a camera.
    fn give_back(&mut self, index: usize) -> Result<(), Fault> {
        let stream = &mut self.streams[index];
        let Some(held) = stream.held.pop_front() else { return Ok(()) };
        stream.node.give_back(held.filled).map_err(|f| stopped(&stream.node, f))
    }

    /// Writes the oldest frame that all cameras have; whether there is one.
    fn deliver(&mut self, frames: &mut Frames) -> Result<bool, Fault> {
        loop {
            let (mut heads, mut full) = ([None; NODES_MAX], [false; NODES_MAX]);
            for (i, s) in self.streams.iter().enumerate() {
                heads[i] = s.held.front().map(|h| h.t);
                full[i] = s.is_full();
            }
            let n = self.streams.len();
            match pair(&heads[..n], &full[..n], self.settings.pair_tolerance) {
                Pairing::Wait => return Ok(false),
                Pairing::Drop(index) => {
                    self.counters.camera_images_unpaired += 1;
                    self.give_back(index)?;
                }
                Pairing::Together => {
                    let written = self.write(frames);
                    (0..n).try_for_each(|index| self.give_back(index))?;
                    if written {
                        return Ok(true);
                    }
                }
            }
        }
    }

    /// Copies the oldest image of every camera; whether they make a frame.
    fn write(&mut self, frames: &mut Frames) -> bool {
        let t = self.streams[0].held[0].t;
        if t <= self.last {
            self.counters.camera_stamps_not_newer += 1;
            return false;
        }
        let parts = self.parts();
        for (camera, image) in frames.images.iter_mut().enumerate() {
            let stream = &self.streams[camera / parts];
            let part = Part { x: camera % parts * image.width, ..stream.node.part };
            let bytes = stream.node.bytes(&stream.held[0].filled);
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
        let (mut fds, mut ready) = ([0; NODES_MAX], [Ready::default(); NODES_MAX]);
        fds.iter_mut().zip(&self.streams).for_each(|(fd, s)| *fd = s.node.fd);
        let n = self.streams.len();
        let polled = self.kernel.poll(&fds[..n], &mut ready[..n], remaining);
        polled.map_err(|e| fault::refused("cameras", "wait for a frame", "poll", &e))?;
        // What an error means is said by the next call that takes a buffer; one that says nothing is answered here.
        let now = self.kernel.now();
        for (stream, ready) in self.streams.iter_mut().zip(&ready) {
            if ready.error && !ready.readable {
                stream.errors += 1;
                if stream.errors >= ERRORS_MAX {
                    let what = "poll reports an error and no frame";
                    return Err(Fault::new(Exit::Io, &stream.node.name, what, "`dmesg` says more"));
                }
            }
            if !ready.readable && now - stream.heard > self.settings.silent {
                self.counters.camera_silences += 1;
                let what = format!("gave nothing for {:.1} s", (now - stream.heard).secs());
                let fix = "check its cable, its trigger, and camera.silent_s if it is meant to pause";
                return Err(Fault::new(Exit::Io, &stream.node.name, what, fix));
            }
        }
        Ok(())
    }

    fn next_frame(&mut self, deadline: Nanos, frames: &mut Frames) -> Result<bool, Fault> {
        loop {
            let any = self.drain()?;
            if self.deliver(frames)? {
                return Ok(true);
            }
            let remaining = deadline - self.kernel.now();
            if remaining.0 <= 0 && !any {
                return Ok(false);
            }
            self.wait(remaining)?;
        }
    }
}

impl Stream {
    fn is_full(&self) -> bool {
        self.held.len() >= self.node.held_max()
    }
}

/// A system call that failed while streaming.
fn stopped(node: &Node, failure: Failure) -> Fault {
    let purpose = if is_gone(&failure.error) { "go on: it was unplugged" } else { "go on" };
    fault::refused(&node.name, purpose, failure.call, &failure.error)
}

/// Settings and calibration must be of the same rig.
fn check(settings: &Settings, cameras: &[RigCamera]) -> Result<(), Fault> {
    let wrong = |what: String, fix: &str| Err(Fault::new(Exit::Config, "[camera]", what, fix));
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
            return Err(SourceFault::Broken(Fault::new(Exit::Software, "cameras", what, "use Frames::for_rig")));
        }
        let deadline = self.kernel.now() + timeout;
        self.come_back(deadline)?;
        match self.next_frame(deadline, frames) {
            Ok(true) => Ok(Wait::Got),
            Ok(false) => {
                self.counters.camera_timeouts += 1;
                Ok(Wait::TimedOut)
            }
            Err(fault) => {
                self.lose(fault.clone());
                Err(SourceFault::Lost(fault))
            }
        }
    }

    fn counters(&self) -> Vec<(&'static str, u64)> {
        self.counters.list()
    }

    fn warnings(&self) -> &[String] {
        &self.warnings
    }
}
