//! Records frames and samples as the sources give them, while a run goes on.
//!
//! A tap on each source copies what passes into a ring of fixed size; a thread of low priority writes it. A full ring drops
//! and counts, and the source never waits. What was written stays readable whatever happens: an image appears whole or not
//! at all and is listed after it appeared; a chunk of MCAP is complete or taken back. A full disk loses what comes until it
//! has room again (an MCAP ends there), and nothing before. A power cut loses what was not yet brought to the disk, which
//! the writer does every second and at the end.

mod euroc;
mod mcap;

pub use euroc::EurocSink;
pub use mcap::McapSink;

use crate::counters::Counter;
use crate::source::{AidBatch, AidReading, AidSource, FrameSource, ImuBatch, ImuReading, ImuSource, SourceFault, Wait};
use crate::types::{Frames, Span};
use crate::{counters, host, Calibration, Fault, FaultKind};
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender};
use std::sync::{mpsc, Arc};
use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};

/// A recording's format on disk. A write that fails leaves what was written before as it was.
pub trait Sink: Send {
    /// Writes the images of one frame.
    fn frames(&mut self, frames: &Frames) -> io::Result<()>;
    /// Writes one inertial sample.
    fn imu(&mut self, reading: &ImuReading) -> io::Result<()>;
    /// Writes one reading of a sensor beside them.
    fn aid(&mut self, reading: &AidReading) -> io::Result<()>;
    /// Brings what was written to the disk.
    fn sync(&mut self) -> io::Result<()>;
    /// Writes what is left and brings it to the disk: nothing more comes.
    fn finish(&mut self) -> io::Result<()>;
}

/// The formats of recordings.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Format {
    /// EuRoC ASL: a folder of PNG and csv, which `stipple replay` plays.
    Euroc,
    /// MCAP with ROS 2 messages, which Foxglove opens.
    Mcap,
}

/// Nice value of the writer's thread: after the sensors and odometry, before a map. What is not written in time is lost.
const NICE: i32 = 5;
/// Time between what is brought to the disk: what a power cut may cost.
const SYNC_EVERY: Duration = Duration::from_secs(1);
/// Samples that may wait for the writer: eight seconds of a 1 kHz unit.
const IMU_SLOTS: usize = 8192;

counters! {
    struct Counts of Counter, read by Counter::get;
    /// Frames written, frames dropped for a full ring, and frames whose writing failed.
    record_frames_written,
    record_frames_dropped,
    record_frames_failed,
    /// Most frames that waited in the ring.
    record_ring_most,
    /// CPU time of the writer, us.
    record_cpu_us,
    /// Longest time that it took to bring a second of it to the disk, us.
    record_sync_us_most,
    /// Inertial samples written, dropped for a full ring, and failed.
    record_imu_written,
    record_imu_dropped,
    record_imu_failed,
    /// The same of a barometer's readings.
    record_aids_written,
    record_aids_dropped,
    record_aids_failed,
}

enum Item {
    Frames(Box<Frames>),
    Imu(ImuReading),
    Aid(AidReading),
}

/// The writer of a recording.
pub struct Recorder {
    counts: Arc<Counts>,
    thread: JoinHandle<Option<String>>,
}

/// The outcome of a recording.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Recorded {
    /// Counters of the recording, by name.
    pub counters: Vec<(&'static str, u64)>,
    /// The first failure to write, if there was one.
    pub failure: Option<String>,
}

/// Makes the folder `dir`, which must not exist or be empty, ready for a recording; a fault where that fails.
pub fn open(dir: &Path, format: Format, calibration: &Calibration) -> Result<Box<dyn Sink>, Fault> {
    let fault = |e: io::Error| {
        let fix = "choose a folder that can be written to and has room";
        Fault::new(FaultKind::NoOutput, dir.display().to_string(), format!("cannot be recorded to: {e}"), fix)
    };
    if dir.is_file() || std::fs::read_dir(dir).is_ok_and(|mut d| d.next().is_some()) {
        let what = "exists and is not an empty folder";
        return Err(Fault::new(FaultKind::NoOutput, dir.display().to_string(), what, "choose another folder"));
    }
    std::fs::create_dir_all(dir).map_err(fault)?;
    Ok(match format {
        Format::Euroc => Box::new(EurocSink::create(dir, calibration).map_err(fault)?),
        Format::Mcap => Box::new(McapSink::create(dir, calibration).map_err(fault)?),
    })
}

/// The frames and samples between sources and writer, and those that are free.
pub struct Ring {
    items: mpsc::SyncSender<Item>,
    waiting: mpsc::Receiver<Item>,
    give_back: mpsc::SyncSender<Box<Frames>>,
    spare: mpsc::Receiver<Box<Frames>>,
}

impl Ring {
    /// A ring of `slots` frames of this shape.
    pub fn new(shape: &Frames, slots: usize) -> Ring {
        let (items, waiting) = mpsc::sync_channel(slots + IMU_SLOTS);
        let (give_back, spare) = mpsc::sync_channel(slots);
        for _ in 0..slots {
            let _ = give_back.send(Box::new(shape.clone()));
        }
        Ring { items, waiting, give_back, spare }
    }
}

/// Name of the writer's thread.
pub const WRITER: &str = "writer";

/// Cameras, an inertial unit, and a barometer where there is one.
pub type Sources = (Box<dyn FrameSource>, Box<dyn ImuSource>, Option<Box<dyn AidSource>>);
/// Sources with taps on them: frames, samples, and a barometer where there is one.
pub type Tapped = (TappedFrames, TappedImu, Option<TappedAids>);

/// Starts the writer behind a ring, and taps on the sources. The recording ends when both taps are gone. The writer calls
/// `alive` before each piece of work, and once a second while there is none.
pub fn start(
    mut sink: Box<dyn Sink>,
    (frames, imu, aids): Sources,
    ring: Ring,
    mut alive: impl FnMut() + Send + 'static,
) -> (Recorder, Tapped) {
    let Ring { items, waiting, give_back, spare } = ring;
    let (counts, in_ring) = (Arc::new(Counts::default()), Arc::new(AtomicU64::new(0)));
    let (c, taken) = (counts.clone(), in_ring.clone());
    let work = move || {
        host::lower_priority(NICE);
        let give_back = |frames| {
            let _ = give_back.send(frames);
            taken.fetch_sub(1, Relaxed);
        };
        let failure = write_all(&mut *sink, &waiting, give_back, &c, &mut alive);
        c.record_cpu_us.add((1e6 * host::thread_cpu().total_s()) as u64);
        failure
    };
    let thread = Builder::new().name(WRITER.into()).spawn(work).expect("the system starts one more thread");
    let tapped = TappedFrames { source: frames, spare, items: items.clone(), counts: counts.clone(), waiting: in_ring };
    let tapped_imu = TappedImu { source: imu, items: items.clone(), counts: counts.clone() };
    let tapped_aids = aids.map(|source| TappedAids { source, items, counts: counts.clone() });
    (Recorder { counts, thread }, (tapped, tapped_imu, tapped_aids))
}

/// Writes what comes until both taps are gone; the first failure, if there was one.
fn write_all(
    sink: &mut dyn Sink,
    waiting: &Receiver<Item>,
    give_back: impl Fn(Box<Frames>),
    c: &Counts,
    alive: &mut dyn FnMut(),
) -> Option<String> {
    let mut failure: Option<String> = None;
    let mut note = |done: io::Result<()>| match done {
        Ok(()) => true,
        Err(e) => {
            failure.get_or_insert_with(|| e.to_string());
            false
        }
    };
    // When the first item was written that may not be on the disk yet.
    let mut unsynced: Option<Instant> = None;
    loop {
        alive();
        let item = match waiting.recv_timeout(SYNC_EVERY) {
            Ok(item) => Some(item),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => break,
        };
        if item.is_some() {
            unsynced = unsynced.or_else(|| Some(Instant::now()));
        }
        match item {
            Some(Item::Frames(frames)) => {
                let written = note(sink.frames(&frames));
                if written { &c.record_frames_written } else { &c.record_frames_failed }.add(1);
                give_back(frames);
            }
            Some(Item::Imu(reading)) => {
                let written = note(sink.imu(&reading));
                if written { &c.record_imu_written } else { &c.record_imu_failed }.add(1);
            }
            Some(Item::Aid(reading)) => {
                let written = note(sink.aid(&reading));
                if written { &c.record_aids_written } else { &c.record_aids_failed }.add(1);
            }
            None => {}
        }
        if unsynced.take_if(|since| since.elapsed() >= SYNC_EVERY).is_some() {
            let begun = Instant::now();
            note(sink.sync());
            c.record_sync_us_most.raise(begun.elapsed().as_micros() as u64);
        }
    }
    note(sink.finish());
    failure
}

impl Recorder {
    /// Waits until everything is written; the taps must be gone.
    pub fn finish(self) -> Recorded {
        let failure = self.thread.join().unwrap_or_else(|_| Some("the writer ended early".into()));
        Recorded { counters: self.counts.list(), failure }
    }
}

/// Cameras that are recorded.
pub struct TappedFrames {
    source: Box<dyn FrameSource>,
    spare: Receiver<Box<Frames>>,
    items: SyncSender<Item>,
    counts: Arc<Counts>,
    /// Frames in the ring.
    waiting: Arc<AtomicU64>,
}

impl FrameSource for TappedFrames {
    fn next(&mut self, timeout: Span, frames: &mut Frames) -> Result<Wait, SourceFault> {
        let wait = self.source.next(timeout, frames)?;
        if wait == Wait::Got {
            if let Ok(mut slot) = self.spare.try_recv() {
                slot.copy_from(frames);
                self.counts.record_ring_most.raise(self.waiting.fetch_add(1, Relaxed) + 1);
                // The queue has room for every slot and as many samples as are let in beside them.
                let _ = self.items.try_send(Item::Frames(slot));
            } else {
                self.counts.record_frames_dropped.add(1);
            }
        }
        Ok(wait)
    }

    fn inner(&self) -> Option<&dyn FrameSource> {
        Some(&*self.source)
    }
}

/// An inertial unit that is recorded.
pub struct TappedImu {
    source: Box<dyn ImuSource>,
    items: SyncSender<Item>,
    counts: Arc<Counts>,
}

impl ImuSource for TappedImu {
    fn next(&mut self, timeout: Span, batch: &mut ImuBatch) -> Result<Wait, SourceFault> {
        let wait = self.source.next(timeout, batch)?;
        for reading in batch.iter() {
            if self.items.try_send(Item::Imu(*reading)).is_err() {
                self.counts.record_imu_dropped.add(1);
            }
        }
        Ok(wait)
    }

    fn inner(&self) -> Option<&dyn ImuSource> {
        Some(&*self.source)
    }
}

/// A barometer that is recorded.
pub struct TappedAids {
    source: Box<dyn AidSource>,
    items: SyncSender<Item>,
    counts: Arc<Counts>,
}

impl AidSource for TappedAids {
    fn next(&mut self, timeout: Span, batch: &mut AidBatch) -> Result<Wait, SourceFault> {
        let wait = self.source.next(timeout, batch)?;
        for reading in batch.iter() {
            if self.items.try_send(Item::Aid(*reading)).is_err() {
                self.counts.record_aids_dropped.add(1);
            }
        }
        Ok(wait)
    }

    fn counters(&self) -> Vec<(&'static str, u64)> {
        self.source.counters()
    }
}

#[cfg(test)]
mod tests;
