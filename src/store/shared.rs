//! What the owner's side and the disk's threads hold in common, and what only the writer has.
//!
//! Locks are taken in this order: writer, then state. The state's is held for moments; no file is touched under it.

use super::record::SECTOR;
use super::segment::{Folder, Walk, SCRATCH};
use super::state::State;
use super::Limits;
use crate::mem::{cut, unsealed};
use std::fs::File;
use std::io;
use std::path::PathBuf;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// What the owner and the threads share.
pub struct Shared {
    state: Mutex<State>,
    writer: Mutex<Writer>,
    /// Wakes the writer, the reader, and who waits for what is written.
    pub work: Condvar,
    pub asked: Condvar,
    pub done: Condvar,
    pub folder: Folder,
    pub path: PathBuf,
    /// Held as long as this lives.
    _lock: File,
}

impl Shared {
    pub fn new(state: State, writer: Writer, folder: Folder, path: PathBuf, lock: File) -> Shared {
        let (state, writer) = (Mutex::new(state), Mutex::new(writer));
        let (work, asked, done) = Default::default();
        Shared { state, writer, work, asked, done, folder, path, _lock: lock }
    }

    pub fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn writer(&self) -> MutexGuard<'_, Writer> {
        self.writer.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Counts a write error; the first one's text stays.
    pub fn count_error(&self, e: &io::Error) {
        let text = unsealed(|| cut(&e.to_string()));
        let mut state = self.state();
        state.figures.write_errors += 1;
        if state.figures.first_error.is_empty() {
            state.figures.first_error = text.clone();
        }
        state.last_error = text;
    }

    /// Counts an error of what was put: who waits for it hears of it.
    pub fn failed(&self, e: &io::Error) {
        self.count_error(e);
        let mut state = self.state();
        state.failures += 1;
        state.flush_to = state.synced;
        drop(state);
        self.done.notify_all();
    }
}
/// What only the writer has.
pub struct Writer {
    /// The active segment.
    pub file: Option<File>,
    /// When the first byte was written that is not synced.
    pub dirty_since: Option<Instant>,
    pub copy: Vec<u8>,
    pub scratch: Vec<u8>,
    pub compaction: Option<Compaction>,
    /// The owner's record was the last thing written: it is compaction's turn.
    pub turn: bool,
    pub next_write: Instant,
    pub retry_at: Option<Instant>,
    pub room_at: Option<Instant>,
}

impl Writer {
    pub fn new(limits: &Limits) -> Writer {
        let now = Instant::now();
        Writer {
            file: None,
            dirty_since: None,
            copy: Vec::with_capacity(limits.payload_max.next_multiple_of(SECTOR)),
            scratch: vec![0; SCRATCH],
            compaction: None,
            turn: false,
            next_write: now,
            retry_at: None,
            room_at: None,
        }
    }

    /// Tries again at once what failed.
    #[cfg(test)]
    pub fn forget_pause(&mut self) {
        (self.retry_at, self.room_at) = (None, None);
    }
}

/// A segment that is being compacted.
pub struct Compaction {
    pub at: usize,
    pub file: File,
    pub walk: Walk,
}
