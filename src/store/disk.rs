//! The disk's side: bodies of the two threads, or the same work on the owner's thread.

use super::index::Place;
use super::record::{About, Form, Header, Key, ABOUT, SECTOR};
use super::shared::Shared;
use super::state::State;
use super::writer::{self, Step};
use super::{Fetched, Outcome};
use std::io;
use std::os::unix::fs::FileExt as _;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Longest sleep of a thread that nobody wakes.
const NAP: Duration = Duration::from_millis(200);
/// Times that a payload is looked up again because compaction moved it while it was read.
const LOOKUPS: usize = 8;

/// The disk's side: what two threads run, or what the owner's thread runs in lockstep.
#[derive(Clone)]
pub struct Disk(pub(super) Arc<Shared>);

impl Disk {
    /// Body of the thread that writes; it ends when the store is dropped or told to stop, after what was put is written.
    pub fn write_loop(&self) {
        let shared = &*self.0;
        shared.state().writers += 1;
        loop {
            let step = writer::step(shared, &mut shared.writer(), true);
            let state = shared.state();
            let until = match step {
                Step::Worked => continue,
                Step::Failed if state.stop => break,
                Step::Failed => None,
                Step::Idle(None) if !state.queue.is_empty() => continue,
                Step::Idle(until) if state.stop => {
                    // Hurried, it is idle when nothing is left.
                    debug_assert!(until.is_none() || !state.queue.is_empty() || !state.rescues.is_empty());
                    break;
                }
                Step::Idle(until) => until,
            };
            let nap = until.map_or(NAP, |at| at.saturating_duration_since(Instant::now()).min(NAP));
            drop(shared.work.wait_timeout(state, nap));
        }
        shared.state().writers -= 1;
        shared.done.notify_all();
    }

    /// Body of the thread that reads; it ends when the store is dropped or told to stop.
    pub fn read_loop(&self) {
        let shared = &*self.0;
        loop {
            let has_read = read_next(shared);
            let state = shared.state();
            if state.stop {
                return;
            }
            if !has_read {
                drop(shared.asked.wait_timeout(state, NAP));
            }
        }
    }

    /// Does all that waits now, on the caller's thread: instead of both threads, deterministically.
    pub fn serve(&self) {
        write_all(&self.0);
        while read_next(&self.0) {}
    }

    /// Tells both loops to end.
    pub fn stop(&self) {
        self.0.state().stop = true;
        self.0.work.notify_all();
        self.0.asked.notify_all();
    }
}

/// Writes what waits, without pace.
pub fn write_all(shared: &Shared) {
    let mut w = shared.writer();
    while let Step::Worked = writer::step(shared, &mut w, false) {}
}

/// Reads one of the payloads that were asked for; false where none can be read now.
fn read_next(shared: &Shared) -> bool {
    let mut state = shared.state();
    // What is being written just now is read when it is.
    let in_flight = state.in_flight.map(|p| p.0);
    let Some(at) = state.asked.iter().position(|(key, _)| Some(*key) != in_flight) else { return false };
    let Some((key, mut payload)) = state.asked.remove(at) else { return false };
    payload.clear();
    // What waits for the disk is copied out of its buffer.
    let queued = state.queue.iter().rev().find(|p| p.key == key);
    let (outcome, about) = match queued {
        Some(p) if p.is_tombstone => (Outcome::Gone, [0; ABOUT]),
        Some(p) => {
            payload.extend_from_slice(&p.payload);
            (Outcome::Newest, p.about)
        }
        None => {
            drop(state);
            let read = read(shared, &key, &mut payload);
            state = shared.state();
            read
        }
    };
    if !matches!(outcome, Outcome::Newest | Outcome::Older) {
        payload.clear();
    }
    state.fetched.push_back(Fetched { key, about, outcome, payload });
    true
}

/// Reads a payload from the disk: the newest generation that is whole.
fn read(shared: &Shared, key: &Key, payload: &mut Vec<u8>) -> (Outcome, About) {
    for _ in 0..LOOKUPS {
        let state = shared.state();
        let Some(entry) = state.index.get(key).filter(|e| !e.is_tombstone).copied() else {
            return (Outcome::Gone, [0; ABOUT]);
        };
        let about = state.index.about(&entry).copied().unwrap_or([0; ABOUT]);
        let of = |place: Place| (state.segments[place.segment].number, state.segments[place.segment].sequence);
        let (newest, previous) = (of(entry.newest), entry.previous.map(of));
        let identity = state.identity;
        drop(state);
        let mut load = |place: Place, (number, sequence): (u32, u64)| {
            let read = load(shared, place, number, payload);
            shared.state().figures.read_bytes += (SECTOR + place.length as usize) as u64;
            let is_own = |h: &Header| {
                (h.sequence, h.identity, h.key, h.length, h.form)
                    == (sequence, identity, *key, place.length, Form::Data)
            };
            Ok(read?.filter(is_own).filter(|h| crc32c::crc32c(payload) == h.payload_crc))
        };
        let found: io::Result<Option<Header>> = load(entry.newest, newest);
        if let Ok(Some(header)) = found {
            return (Outcome::Newest, header.about);
        }
        let older = entry.previous.zip(previous).map(|(place, of)| load(place, of));
        // Compaction may have moved what was just read.
        let mut state = shared.state();
        let is_same = state.index.get(key).is_some_and(|e| (e.newest, e.previous) == (entry.newest, entry.previous));
        if !is_same || of_now(&state, entry.newest) != newest.1 {
            continue;
        }
        state.figures.records_damaged += u64::from(found.is_ok());
        state.figures.read_errors += u64::from(found.is_err());
        if let Some(Ok(Some(header))) = older {
            if found.is_ok() && !state.rescues.contains(key) {
                let _ = state.rescues.push(*key);
            }
            return (Outcome::Older, header.about);
        }
        return (if found.is_err() { Outcome::Unreadable } else { Outcome::Damaged }, about);
    }
    (Outcome::Unreadable, [0; ABOUT])
}

fn of_now(state: &State, place: Place) -> u64 {
    state.segments[place.segment].sequence
}

/// The bytes of a record as they are; the header where it is one.
fn load(shared: &Shared, place: Place, number: u32, payload: &mut Vec<u8>) -> io::Result<Option<Header>> {
    let file = shared.folder.read(number)?;
    let mut sector = [0; SECTOR];
    payload.resize(place.length as usize, 0);
    file.read_exact_at(&mut sector, place.offset)?;
    file.read_exact_at(payload, place.offset + SECTOR as u64)?;
    Ok(Header::decode(&sector))
}
