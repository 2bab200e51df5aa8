//! The cameras of a rig as one source of frames: takes what lies ready in each node, pairs it, writes the pairs into the
//! caller's images, and opens again what was lost. What waits and what goes on is described in `v4l2`.

use super::colour::{scratch_bytes, to_colour};
use super::fault::refused;
use super::find::find;
use super::kernel::{Kernel, Linux, Ready, NODES_MAX};
use super::node::{Node, Taken};
use super::pixels::{to_grey, Part, Unreadable};
use super::stamps::{pair, spread, Pairing, Timing};
use super::stream::{stopped, Stream};
use super::{check, CameraCounters, Settings};
use crate::source::{FrameSource, SourceFault, Wait};
use crate::types::{Colour, Frames, Image, Nanos, Span};
use crate::{Calibration, Fault, FaultKind, RigCamera};
use std::sync::Arc;

/// First and longest pause between attempts to open a lost camera: a USB device needs some 0.2 s to come up, and an attempt
/// costs a millisecond.
const RETRY_MIN: Span = Span(100_000_000);
const RETRY_MAX: Span = Span(2_000_000_000);
/// Warnings that are kept.
const WARNINGS_MAX: usize = 32;

/// Why a camera is lost, and when it is looked for again.
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
    /// One for each device, `None` while it is closed. `lost` says why, until it has given an image again.
    streams: Vec<Option<Stream>>,
    lost: Vec<Option<Lost>>,
    /// The caller was told that no camera is left.
    told: bool,
    last: Nanos,
    scratch: Vec<u8>,
    counters: CameraCounters,
    warnings: Vec<String>,
}

impl Rig {
    /// Finds, sets and starts the cameras of `calibration`; a fault where one is missing or refuses a setting.
    pub fn open(settings: Settings, calibration: &Calibration) -> Result<Rig, Fault> {
        Rig::open_in(Arc::new(Linux), settings, calibration)
    }

    pub(super) fn open_in(
        kernel: Arc<dyn Kernel>,
        settings: Settings,
        calibration: &Calibration,
    ) -> Result<Rig, Fault> {
        let cameras = calibration.cameras.clone();
        check(&settings, &cameras)?;
        // Each part of a node's picture is a camera's.
        let width = settings.width * (cameras.len() / settings.devices.len());
        let scratch = scratch_bytes(settings.colours > 0, width, settings.height);
        let mut rig = Rig {
            lost: settings.devices.iter().map(|_| None).collect(),
            kernel,
            settings,
            cameras,
            streams: Vec::new(),
            told: false,
            last: Nanos::MIN,
            scratch: Vec::with_capacity(scratch),
            counters: CameraCounters::default(),
            warnings: Vec::with_capacity(WARNINGS_MAX),
        };
        for index in 0..rig.settings.devices.len() {
            let stream = rig.open_stream(index, None)?;
            rig.streams.push(Some(stream));
        }
        Ok(rig)
    }

    /// The open nodes, a line each: path, name, format, rate, exposure.
    pub fn describe(&self) -> Vec<String> {
        let line = |s: &Stream| {
            let (node, part) = (&s.node, s.node.part);
            let (name, format) = (&node.name, node.format.name());
            let (hz, us) = (1.0 / node.period.secs(), node.exposure.now.0 / 1000);
            format!("{name}: {format} {}x{} at {hz:.2} Hz, exposure {us} us", part.width, part.height)
        };
        self.streams.iter().flatten().map(line).collect()
    }

    /// Pictures side by side in each node's.
    fn parts(&self) -> usize {
        self.cameras.len() / self.settings.devices.len()
    }

    fn open_stream(&self, index: usize, last_image: Option<Nanos>) -> Result<Stream, Fault> {
        let path = find(&*self.kernel, &self.settings.devices[index])?;
        // Cameras in colour are the first, and a node's are in their order.
        let cameras = (self.parts(), index * self.parts() < self.settings.colours);
        let node = Node::open(self.kernel.clone(), &path, cameras, &self.settings)?;
        let timing =
            Timing { point: self.settings.stamp, exposure: node.exposure.now, transfer: self.settings.transfer };
        Ok(Stream::new(node, timing, self.kernel.now(), last_image))
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

    /// Tries to open again what is closed, each camera when its pause is over.
    fn reopen_lost(&mut self) {
        for index in 0..self.lost.len() {
            let due = self.lost[index].as_ref().is_some_and(|l| l.retry_at <= self.kernel.now());
            if due && self.streams[index].is_none() {
                match self.open_stream(index, Some(Nanos::MIN)) {
                    Ok(stream) => self.streams[index] = Some(stream),
                    Err(fault) => self.lose(index, fault),
                }
            }
        }
    }

    /// Until the next closed camera is looked for.
    fn until_retry(&self) -> Option<Span> {
        let closed = self.lost.iter().zip(&self.streams).filter(|(_, s)| s.is_none());
        closed.filter_map(|(l, _)| Some(l.as_ref()?.retry_at - self.kernel.now())).min()
    }

    /// The fault of a rig without any open camera.
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
            let taken = stream.node.take().map_err(|f| stopped(&stream.node, f))?;
            let now = self.kernel.now();
            match taken {
                Taken::Nothing => break,
                Taken::Corrupt => {
                    stream.gave_corrupt(now);
                    self.counters.camera_images_corrupt += 1;
                }
                Taken::Failed(error) => {
                    self.counters.camera_io_errors += 1;
                    stream.gave_error(error)?;
                    break;
                }
                Taken::Filled(filled) => {
                    stream.hold(filled, now, &self.cameras[index], &mut self.counters)?;
                    // A camera is back when it gives an image, not when it can be opened.
                    self.counters.camera_returns += u64::from(self.lost[index].take().is_some());
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

    /// Writes the oldest frame that all cameras have, but for those that are missed; whether there is one.
    fn deliver(&mut self, frames: &mut Frames) -> bool {
        loop {
            let (mut heads, mut full, mut of, mut n) = ([None; NODES_MAX], [false; NODES_MAX], [0; NODES_MAX], 0);
            let mut ends = heads;
            let now = self.kernel.now();
            for (index, stream) in self.streams.iter().enumerate() {
                if let Some(s) = stream.as_ref().filter(|s| !s.is_missed(now)) {
                    let head = s.held.front();
                    (heads[n], ends[n]) = (head.map(|h| h.t - h.half), head.map(|h| h.t + h.half));
                    (full[n], of[n]) = (s.is_full(), index);
                    n += 1;
                }
            }
            // A trigger starts all exposures together; cameras that are synchronised by their readout end them together.
            if spread(&ends[..n]) < spread(&heads[..n]) {
                heads = ends;
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

    /// Copies the oldest image of every camera, black where it cannot be read; whether one can, which makes a frame.
    fn write(&mut self, frames: &mut Frames) -> bool {
        let first = self.streams.iter().flatten().find_map(|s| s.held.front());
        let t = first.expect("called when all that are there have one").t;
        if t <= self.last {
            self.counters.camera_stamps_not_newer += 1;
            return false;
        }
        let parts = self.parts();
        let (mut any, mut absent) = (false, 0);
        let mut colours = frames.colours.iter_mut();
        for (camera, image) in frames.images.iter_mut().enumerate() {
            let mut colour = colours.next();
            let of = self.streams[camera / parts].as_ref();
            let Some((stream, held)) = of.and_then(|s| Some((s, s.held.front()?))) else {
                blacken(image, colour);
                absent += 1;
                continue;
            };
            let part = Part { x: camera % parts * image.width, ..stream.node.part };
            let bytes = stream.node.bytes(&held.filled);
            let (format, matrix) = (stream.node.format, &stream.node.matrix);
            let planes = if colour.is_some() { 4 } else { 1 };
            let copied = match &mut colour {
                None => to_grey(format, bytes, part, &mut self.scratch, image),
                Some(colour) => to_colour((format, matrix), bytes, part, &mut self.scratch, image, colour),
            };
            self.counters.camera_bytes_copied += planes * image.pixels.len() as u64;
            let Err(why) = copied else {
                any = true;
                continue;
            };
            blacken(image, colour);
            match why {
                Unreadable::Short { .. } => self.counters.camera_images_short += 1,
                Unreadable::Undecodable(_) => self.counters.camera_images_undecodable += 1,
            }
            if self.warnings.len() < WARNINGS_MAX {
                self.warnings.push(format!("{}: image at {}: {why}", stream.node.name, t.0));
            }
        }
        if !any {
            return false;
        }
        frames.t = t;
        self.last = t;
        self.counters.camera_frames += 1;
        self.counters.camera_images_absent += absent;
        true
    }

    /// Waits until a camera has something or is due to be looked for, or for `remaining`.
    fn wait(&mut self, remaining: Span) -> Result<(), Fault> {
        let (mut fds, mut ready) = ([-1; NODES_MAX], [Ready::default(); NODES_MAX]);
        fds.iter_mut().zip(self.streams.iter().flatten()).for_each(|(fd, s)| *fd = s.node.fd);
        let n = self.streams.iter().flatten().count();
        let remaining = self.until_retry().map_or(remaining, |retry| retry.min(remaining));
        let polled = self.kernel.poll(&fds[..n], &mut ready[..n], remaining);
        polled.map_err(|e| refused("cameras", "wait for a frame", "poll", &e))?;
        let (now, mut ready) = (self.kernel.now(), ready.into_iter());
        for index in 0..self.streams.len() {
            let Some(stream) = &mut self.streams[index] else { continue };
            if let Err(fault) = stream.check(ready.next().unwrap_or_default(), now) {
                self.counters.camera_silences += u64::from(stream.is_silent(now) && self.lost[index].is_none());
                self.lose(index, fault);
            }
        }
        Ok(())
    }

    /// False where the time is over. That no camera is left is said at once when it comes to that, and after the timeout
    /// while it stays so.
    fn next_frame(&mut self, deadline: Nanos, frames: &mut Frames) -> Result<bool, SourceFault> {
        loop {
            self.reopen_lost();
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
                // The wait was a sleep, and without it this would be a busy loop.
                Err(fault) if lost.is_some() => return Err(SourceFault::Broken(fault)),
                Err(fault) => (0..self.streams.len()).for_each(|index| self.lose(index, fault.clone())),
            }
        }
    }
}

/// Makes a picture black.
fn blacken(image: &mut Image, colour: Option<&mut Colour>) {
    colour.into_iter().flatten().chain([image]).for_each(|plane| plane.pixels.fill(0));
}

impl FrameSource for Rig {
    fn next(&mut self, timeout: Span, frames: &mut Frames) -> Result<Wait, SourceFault> {
        let shaped =
            |(image, c): (&Image, &RigCamera)| (image.width, image.height) == (c.camera.width, c.camera.height);
        let colours = frames.colours.iter().flat_map(|colour| colour.iter().zip(std::iter::repeat(&self.cameras[0])));
        let images = frames.images.iter().zip(&self.cameras).chain(colours);
        let coloured = frames.colours.len() <= self.settings.colours;
        if frames.images.len() != self.cameras.len() || !coloured || !images.into_iter().all(shaped) {
            let what = "frames are not shaped by the calibration that the cameras were opened with";
            return Err(SourceFault::Broken(Fault::new(FaultKind::Internal, "cameras", what, "use Frames::in_colour")));
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
