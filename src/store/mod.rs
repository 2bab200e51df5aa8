//! An append-only store of records on disk, which keeps the blocks and keyframes of a map: `src/store/README.md`.
//!
//! ```text
//! owner: put, remove -> buffers -> Disk::write_loop -> segments, compaction
//!        fetch  ------> buffers -> Disk::read_loop  -> fetched
//! ```
//!
//! The owner never waits for the disk: what finds no buffer is refused. One short lock guards the index and the queues; no
//! file is touched under it, so that the owner waits for copies of a few hundred bytes at most.

mod append;
mod aside;
mod compact;
mod disk;
mod index;
mod open;
mod reader;
mod record;
mod scan;
mod segment;
mod shared;
mod snapshot;
mod state;
#[cfg(test)]
mod tests;
mod writer;

pub use aside::set_aside;
pub use disk::Disk;
pub use reader::Reader;
pub use record::{size as record_bytes, About, Key, ABOUT};
pub use scan::LOCK;
pub use snapshot::{bytes as snapshot_bytes, Snapshot};

use crate::mem::{Footprint, List};
use shared::{Shared, Writer};
use state::State;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;
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

/// A number for what a store is of, by its description: a store of another is not read.
pub fn identity(text: &str) -> u64 {
    // FNV-1a.
    text.bytes().fold(0xcbf2_9ce4_8422_2325, |h, b| (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3))
}

/// The owner's side.
pub struct Store {
    shared: Arc<Shared>,
    warnings: Vec<String>,
}

impl Drop for Store {
    fn drop(&mut self) {
        Disk(self.shared.clone()).stop();
    }
}

impl Store {
    /// Opens or makes the store in `folder`, for a map of `identity` (a hash of rig and shape). Takes the lock. Fails where the
    /// folder cannot be written, another run holds it, it is of another identity or version, or it holds more than the limits
    /// allow.
    pub fn open(folder: &Path, identity: u64, limits: &Limits) -> Result<(Store, Disk), Fault> {
        let (shared, warnings) = open::open(folder, identity, limits)?;
        let shared = Arc::new(shared);
        Ok((Store { shared: shared.clone(), warnings }, Disk(shared)))
    }

    /// Host memory that a store of these limits takes.
    pub fn footprint(limits: &Limits) -> Footprint {
        let mut footprint = Footprint::default();
        footprint.build("store", || (State::new(limits, 0), Writer::new(limits)));
        footprint
    }

    /// What was found at opening that the owner should hear of: foreign files, parts that cannot be read.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Visits the newest generation of every record that is on disk. `visit` must not call the store.
    pub fn entries(&self, mut visit: impl FnMut(&Key, &About)) {
        let state = self.shared.state();
        for entry in state.index.entries().iter().filter(|e| !e.is_tombstone) {
            if let Some(about) = state.index.about(entry) {
                visit(&entry.key, about);
            }
        }
    }

    /// What the owner has in the header of the newest generation on disk.
    pub fn about(&self, key: &Key) -> Option<About> {
        let state = self.shared.state();
        state.index.about(state.index.get(key)?).copied()
    }

    /// The generation on disk of a key, 0 for none, and whether another waits to be written.
    pub fn generation(&self, key: &Key) -> (u32, bool) {
        let state = self.shared.state();
        (state.index.get(key).map_or(0, |entry| entry.generation), state.is_pending(key))
    }

    /// Whether a buffer is free and the disk takes a new key.
    pub fn has_room(&self) -> bool {
        let state = self.shared.state();
        !state.free.is_empty() && state.takes_new(state.limits.payload_max)
    }

    /// Hands a record over; false, and counted, where no buffer is free or the store is full. Never waits for the disk. `fill`
    /// writes the payload into an empty buffer of `payload_max` bytes.
    pub fn put(&mut self, key: Key, about: &About, fill: impl FnOnce(&mut Vec<u8>)) -> bool {
        let mut state = self.shared.state();
        let Some(mut payload) = state.free.pop() else {
            state.figures.refused_no_buffer += 1;
            return false;
        };
        drop(state);
        payload.clear();
        fill(&mut payload);
        let mut state = self.shared.state();
        let is_long = payload.len() > state.limits.payload_max;
        if is_long || !state.takes(&key, payload.len()) {
            let figures = &mut state.figures;
            *(if is_long { &mut figures.refused_too_long } else { &mut figures.refused_full }) += 1;
            state.take_back(payload);
            return false;
        }
        state.push(key, about, false, payload);
        drop(state);
        self.shared.work.notify_all();
        true
    }

    /// Removes a record; false where it is not known, no buffer is free, or too many removals wait for compaction.
    pub fn remove(&mut self, key: Key) -> bool {
        let mut state = self.shared.state();
        if !state.is_known(&key) {
            return false;
        }
        if !state.takes_tombstone() {
            state.figures.refused_full += 1;
            return false;
        }
        let Some(mut payload) = state.free.pop() else {
            state.figures.refused_no_buffer += 1;
            return false;
        };
        payload.clear();
        state.push(key, &[0; ABOUT], true, payload);
        drop(state);
        self.shared.work.notify_all();
        true
    }

    /// Asks for a payload, the one put last; false where no buffer is free or the key is unknown. Payloads that were asked for
    /// take three quarters of the buffers at most, until they are given back.
    pub fn fetch(&mut self, key: Key) -> bool {
        let mut state = self.shared.state();
        if !state.is_known(&key) || !state.may_read() {
            return false;
        }
        let Some(payload) = state.free.pop() else { return false };
        state.reading += 1;
        state.asked.push_back((key, payload));
        drop(state);
        self.shared.asked.notify_all();
        true
    }

    /// The next payload that was read.
    pub fn fetched(&mut self) -> Option<Fetched> {
        self.shared.state().fetched.pop_front()
    }

    /// Returns the buffer of a payload.
    pub fn give_back(&mut self, fetched: Fetched) {
        let mut state = self.shared.state();
        state.reading = state.reading.saturating_sub(1);
        state.take_back(fetched.payload);
    }

    /// Waits until everything put is on disk and synced; where no thread writes, it does so itself. Fails where writing does:
    /// what was put stays in its buffers then, and is tried again.
    pub fn flush(&mut self) -> Result<(), Fault> {
        let shared = &*self.shared;
        let mut state = shared.state();
        let (wanted, failures) = (state.put, state.failures);
        while state.synced < wanted {
            if state.failures != failures {
                let why = String::from_utf8_lossy(&state.last_error).into_owned();
                let fix = "make room on the disk, or check it";
                return Err(Fault::new(FaultKind::Io, shared.path.display().to_string(), why, fix));
            }
            state.flush_to = wanted;
            if state.writers == 0 {
                drop(state);
                disk::write_all(shared);
                state = shared.state();
            } else {
                shared.work.notify_all();
                let waited = shared.done.wait_timeout(state, Duration::from_millis(100));
                state = waited.unwrap_or_else(std::sync::PoisonError::into_inner).0;
            }
        }
        Ok(())
    }

    pub fn figures(&self) -> Figures {
        let state = self.shared.state();
        let (records, live_bytes) = (state.index.records() as u64, state.live());
        Figures { live_bytes, records, disk_bytes: state.file_bytes(), ..state.figures.clone() }
    }
}
