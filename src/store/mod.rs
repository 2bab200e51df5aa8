//! An append-only store of records on disk, which keeps the blocks and keyframes of a map: `src/store/README.md`.
//!
//! ```text
//! owner: put, remove -> buffers -> Disk::write_loop -> segments, compaction
//!        fetch  ------> buffers -> Disk::read_loop  -> fetched
//! ```
//!
//! The owner never waits for the disk: what finds no buffer is refused. One short lock guards the index and the queues; no
//! file is touched under it, so that the owner waits for copies of a few hundred bytes at most.

mod record;

pub use record::{About, Key, ABOUT};

use crate::mem::{Footprint, List};
use std::path::{Path, PathBuf};
use stipple_drivers::{Fault, FaultKind};

/// What a store may take; bytes.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Space on the disk that is never exceeded. Half of it holds records, see `compact.rs`.
    pub bytes_max: u64,
    /// Size of a file: 16 to 32 MiB keep the boot short.
    pub segment_bytes: u64,
    /// Keys that may be there at once.
    pub records_max: usize,
    pub payload_max: usize,
    /// Payloads of `payload_max` bytes that are in memory: put and not yet written, or fetched and not yet given back.
    pub buffers: usize,
    /// The writer's pace, B/s; 0: no limit.
    pub write_bytes_per_s: u64,
}

/// What a fetched payload is.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Outcome {
    /// The newest generation.
    Newest,
    /// The generation before it, since the newest is damaged.
    Older,
    /// No generation that is there is whole: there is no payload.
    Damaged,
    /// The disk did not give it.
    Unreadable,
    /// It was removed since it was asked for.
    Gone,
}

/// A payload that was asked for, in one of the store's buffers: `Store::give_back` returns it.
#[derive(Debug)]
pub struct Fetched {
    pub key: Key,
    pub about: About,
    pub outcome: Outcome,
    /// Empty unless the outcome is `Newest` or `Older`.
    pub payload: Vec<u8>,
}

/// Counters of a store; bytes where the name says so.
#[derive(Clone, Debug, Default)]
pub struct Figures {
    /// Newest generations and tombstones, and how many keys there are.
    pub live_bytes: u64,
    pub records: u64,
    /// Size of all segment files.
    pub disk_bytes: u64,
    /// Records that the owner put, with their headers; all that was written. Their ratio is the write amplification.
    pub put_bytes: u64,
    pub written_bytes: u64,
    /// Read since the store was opened, the boot included.
    pub read_bytes: u64,
    pub syncs: u64,
    pub segments_compacted: u64,
    pub records_damaged: u64,
    /// Records refused: the store, the index or the tombstones are full; every buffer is taken; longer than `payload_max`.
    pub refused_full: u64,
    pub refused_no_buffer: u64,
    pub refused_too_long: u64,
    pub write_errors: u64,
    pub read_errors: u64,
    /// Text of the first write error.
    pub first_error: List<u8, 200>,
}

/// The owner's side.
pub struct Store {}

/// The disk's side: what two threads run, or what the owner's thread runs in lockstep.
pub struct Disk {}

/// A store that is read while another may write it.
pub struct Reader {}

impl Store {
    /// Opens or makes the store in `folder`, for a map of `identity` (a hash of rig and shape). Takes the lock. Fails where the
    /// folder cannot be written, another run holds it, or it is of another identity or version.
    pub fn open(folder: &Path, _identity: u64, _limits: &Limits) -> Result<(Store, Disk), Fault> {
        Err(Fault::new(FaultKind::NoOutput, folder.display().to_string(), "the store is not finished", ""))
    }

    /// Host memory that a store of these limits takes.
    pub fn footprint(_limits: &Limits) -> Footprint {
        Footprint::default()
    }

    /// What was found at opening that the owner should hear of: foreign files.
    pub fn warnings(&self) -> &[String] {
        &[]
    }

    /// Visits the newest generation of every record that is on disk.
    pub fn entries(&self, _visit: impl FnMut(&Key, &About)) {}

    /// The header's bytes of the newest generation on disk.
    pub fn about(&self, _key: &Key) -> Option<About> {
        None
    }

    /// Whether a buffer is free and the disk takes a new key.
    pub fn has_room(&self) -> bool {
        false
    }

    /// Hands a record over; false, and counted, where no buffer is free or the store is full. Never waits for the disk. `fill`
    /// writes the payload into an empty buffer of `payload_max` bytes.
    pub fn put(&mut self, _key: Key, _about: &About, _fill: impl FnOnce(&mut Vec<u8>)) -> bool {
        false
    }

    /// Removes a record; false where it is not known, no buffer is free, or too many removals wait for compaction.
    pub fn remove(&mut self, _key: Key) -> bool {
        false
    }

    /// Asks for a payload; false where no buffer is free or the key is unknown.
    pub fn fetch(&mut self, _key: Key) -> bool {
        false
    }

    /// The next payload that was read.
    pub fn fetched(&mut self) -> Option<Fetched> {
        None
    }

    /// Returns the buffer of a payload.
    pub fn give_back(&mut self, _fetched: Fetched) {}

    /// Waits until everything put is on disk and synced; where no thread writes, it does so itself. Fails where writing does.
    pub fn flush(&mut self) -> Result<(), Fault> {
        Ok(())
    }

    pub fn figures(&self) -> Figures {
        Figures::default()
    }
}

impl Disk {
    /// Body of the thread that writes; it ends when the store is dropped or told to stop.
    pub fn write_loop(&self) {}

    /// Body of the thread that reads; it ends when the store is dropped or told to stop.
    pub fn read_loop(&self) {}

    /// Does all that waits now, on the caller's thread: instead of both threads, deterministically.
    pub fn serve(&self) {}

    /// Tells both loops to end.
    pub fn stop(&self) {}
}

impl Reader {
    /// Opens the store in a folder to be read, without its lock. Fails where there is none, or one of another version.
    pub fn open(folder: &Path) -> Result<Reader, Fault> {
        Err(Fault::new(FaultKind::NoInput, folder.display().to_string(), "the store is not finished", ""))
    }

    pub fn identity(&self) -> u64 {
        0
    }

    /// Visits the newest generation of every record.
    pub fn entries(&self, _visit: impl FnMut(&Key, &About)) {}

    pub fn about(&self, _key: &Key) -> Option<About> {
        None
    }

    /// Reads a payload, of an older generation where the newest is damaged. Fails where no generation is whole.
    pub fn read(&mut self, key: Key, _payload: &mut Vec<u8>) -> Result<About, Fault> {
        Err(Fault::new(FaultKind::NoInput, format!("{key:?}"), "the store is not finished", ""))
    }
}

/// Moves the segments of a store to `previous-NAME` beside its folder, in the place of those that are there, and answers where.
/// Fails where a run holds the store, or a file cannot be moved.
pub fn set_aside(_folder: &Path) -> Result<Option<PathBuf>, Fault> {
    Ok(None)
}
