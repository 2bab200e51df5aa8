//! What the owner and the disk's threads share: index, segments, queues, buffers; and how much may be put.
//!
//! Half of the space holds records, so that compaction always finds a segment half of which is stale: see `compact.rs`.

use super::index::{Index, Place};
use super::record::Header;
use super::record::{size, About, Key, SECTOR};
use super::scan::{Segment, Use};
use super::{Fetched, Figures, Limits};
use crate::mem::List;
use std::collections::VecDeque;

/// Bytes written to a segment over its life besides records: header, two end markers, the header that frees it.
pub const OVERHEAD: u64 = 4 * SECTOR as u64;
/// Bytes at the end of a segment that records leave: the end marker after the last one, and that in the last sector.
pub const ENDS: u64 = 2 * SECTOR as u64;
/// Segments that hold no record for the owner: the one that is appended to, the one that compaction may always take, and one
/// for what segments sealed early lack.
const SPARE: u64 = 3;
/// Fraction of the space that new keys leave to new generations that are longer than what they replace.
const RESERVE: u64 = 8;
/// Keys that wait to be written anew, since their newest generation was found damaged.
pub const RESCUES: usize = 64;

/// A record on its way to the disk.
pub struct Pending {
    pub key: Key,
    pub about: About,
    pub is_tombstone: bool,
    pub payload: Vec<u8>,
    /// Counts what was put.
    pub number: u64,
}

pub struct State {
    pub limits: Limits,
    pub identity: u64,
    pub index: Index,
    pub segments: Vec<Segment>,
    pub active: Option<usize>,
    pub next_sequence: u64,
    pub next_number: u32,
    pub foreign_bytes: u64,
    pub free: Vec<Vec<u8>>,
    pub queue: VecDeque<Pending>,
    /// What the writer has taken from the queue and not yet written: key, bytes, whether it is data.
    pub in_flight: Option<(Key, u64, bool)>,
    pub asked: VecDeque<(Key, Vec<u8>)>,
    /// Buffers of payloads that were asked for and not given back.
    pub reading: usize,
    pub fetched: VecDeque<Fetched>,
    pub rescues: List<Key, RESCUES>,
    /// Number of the last record that was put, written, and known to be on the disk.
    pub put: u64,
    pub written: u64,
    pub synced: u64,
    /// Somebody waits until this number is synced: pace and pauses do not count.
    pub flush_to: u64,
    /// The disk has no room for another file.
    pub no_room: bool,
    pub stop: bool,
    /// Threads that write.
    pub writers: u32,
    /// Times that writing a record or syncing failed.
    pub failures: u64,
    pub figures: Figures,
    pub last_error: List<u8, 200>,
}

/// Segment files that the limits allow, with so many bytes in foreign ones.
pub fn segments_max(limits: &Limits, foreign_bytes: u64) -> u64 {
    limits.bytes_max.saturating_sub(foreign_bytes) / limits.segment_bytes.max(1)
}

/// Bytes of records that a segment has at least when it is full.
fn used_min(limits: &Limits) -> u64 {
    // Full: the longest record did not fit behind what is there.
    let rest = SECTOR as u64 + ENDS + size(limits.payload_max) as u64 - SECTOR as u64;
    limits.segment_bytes.saturating_sub(rest)
}

/// Bytes of records that count, at most, in so many segments: whenever all but the spare ones are full, one of them has as
/// many stale bytes as live ones.
pub fn live_max(limits: &Limits, segments: u64) -> u64 {
    segments.saturating_sub(SPARE) * (used_min(limits).saturating_sub(OVERHEAD) / 2)
}

impl State {
    /// Everything a store holds in memory, without anything in it.
    pub fn new(limits: &Limits, identity: u64) -> State {
        // Whole sectors: the writer fills up the last one.
        let buffer = || Vec::with_capacity(limits.payload_max.next_multiple_of(SECTOR));
        let n = limits.buffers;
        State {
            limits: *limits,
            identity,
            index: Index::fixed(limits.records_max),
            segments: Vec::with_capacity(segments_max(limits, 0) as usize + 1),
            active: None,
            next_sequence: 1,
            next_number: 0,
            foreign_bytes: 0,
            free: (0..n).map(|_| buffer()).collect(),
            queue: VecDeque::with_capacity(n + 1),
            in_flight: None,
            asked: VecDeque::with_capacity(n + 1),
            reading: 0,
            fetched: VecDeque::with_capacity(n + 1),
            rescues: List::default(),
            put: 0,
            written: 0,
            synced: 0,
            flush_to: 0,
            no_room: false,
            stop: false,
            writers: 0,
            failures: 0,
            figures: Figures::default(),
            last_error: List::default(),
        }
    }

    pub fn file_bytes(&self) -> u64 {
        self.segments.iter().filter(|s| s.state != Use::Gone).map(|s| s.bytes).sum()
    }

    fn count(&self, state: Use) -> u64 {
        self.segments.iter().filter(|s| s.state == state).count() as u64
    }

    /// Whether the limits allow one more file.
    pub fn may_grow(&self) -> bool {
        let limit = self.limits.bytes_max.saturating_sub(self.foreign_bytes);
        self.file_bytes() + self.limits.segment_bytes <= limit
    }

    /// Files that can be begun now: those that wait, and those that may be made.
    pub fn available(&self) -> u64 {
        let limit = self.limits.bytes_max.saturating_sub(self.foreign_bytes);
        let more = limit.saturating_sub(self.file_bytes()) / self.limits.segment_bytes;
        self.count(Use::Free) + if self.no_room { 0 } else { more }
    }

    pub fn live(&self) -> u64 {
        self.segments.iter().map(|s| s.live).sum()
    }

    /// What is on its way to the disk, in its order: key, bytes, whether it is data.
    fn pending(&self) -> impl Iterator<Item = (Key, u64, bool)> + Clone + '_ {
        let queued = self.queue.iter().map(|p| (p.key, size(p.payload.len()) as u64, !p.is_tombstone));
        self.in_flight.into_iter().chain(queued)
    }

    /// Bytes that will count, and keys that will be there, when everything put is written and `key` has `bytes` (`None`: as is).
    fn planned(&self, key: Option<(Key, u64)>) -> (u64, usize) {
        let (mut live, mut keys) = (self.live() as i64, self.index.records() as i64);
        let mut add = |key: &Key, bytes: u64, is_data: bool| {
            let entry = self.index.get(key);
            live += bytes as i64 - entry.map_or(0, |e| e.newest.size()) as i64;
            keys += i64::from(is_data) - i64::from(entry.is_some_and(|e| !e.is_tombstone));
        };
        for (i, (own, bytes, is_data)) in self.pending().enumerate() {
            let is_last = !self.pending().skip(i + 1).any(|p| p.0 == own);
            if is_last && key.is_none_or(|(key, _)| key != own) {
                add(&own, bytes, is_data);
            }
        }
        if let Some((key, bytes)) = key {
            add(&key, bytes, true);
        }
        (live.max(0) as u64, keys.max(0) as usize)
    }

    /// Whether a key is there, or will be when everything put is written.
    pub fn is_known(&self, key: &Key) -> bool {
        let pending = self.pending().filter(|p| p.0 == *key).last().map(|p| p.2);
        pending.unwrap_or_else(|| self.index.get(key).is_some_and(|e| !e.is_tombstone))
    }

    /// Whether a record of a key waits to be written.
    pub fn is_pending(&self, key: &Key) -> bool {
        self.pending().any(|p| p.0 == *key)
    }

    /// Bytes that may count: by the files that are there, not by those that could be made, since others may fill the disk.
    fn live_max(&self) -> u64 {
        let files = self.segments.iter().filter(|s| s.state != Use::Gone).count() as u64;
        live_max(&self.limits, files.min(segments_max(&self.limits, self.foreign_bytes)))
    }

    /// Whether another file is to be made ahead: one always waits, and there is room for what fills all buffers.
    pub fn wants_file(&self) -> bool {
        let (max, record) = (self.live_max(), size(self.limits.payload_max) as u64);
        let ahead = (self.limits.buffers as u64 + 2) * record;
        self.may_grow() && (self.count(Use::Free) == 0 || max - max / RESERVE < self.live() + ahead)
    }

    /// Whether a new key with so many bytes of payload may be put.
    pub fn takes_new(&self, length: usize) -> bool {
        let (max, (live, keys)) = (self.live_max(), self.planned(None));
        live + size(length) as u64 <= max - max / RESERVE && keys < self.limits.records_max
    }

    /// Whether a record of so many bytes of payload may be put.
    pub fn takes(&self, key: &Key, length: usize) -> bool {
        if !self.is_known(key) {
            return self.takes_new(length);
        }
        let (live, _) = self.planned(Some((*key, size(length) as u64)));
        let can_count = self.index.get(key).is_none_or(|e| e.generation < u32::MAX - self.limits.buffers as u32);
        // What takes no more than what it replaces is always taken.
        can_count && (live <= self.live_max() || live <= self.planned(None).0)
    }

    /// Whether one more payload may be asked for: a quarter of the buffers is left to what is put.
    pub fn may_read(&self) -> bool {
        self.reading < (self.limits.buffers - self.limits.buffers / 4)
    }

    /// Takes a record from the owner.
    pub fn push(&mut self, key: Key, about: &About, is_tombstone: bool, payload: Vec<u8>) {
        self.put += 1;
        self.figures.put_bytes += size(payload.len()) as u64;
        self.queue.push_back(Pending { key, about: *about, is_tombstone, payload, number: self.put });
    }

    /// Takes a buffer back. One that grew is cut to size; one that is not ours, or was taken apart, is dropped.
    pub fn take_back(&mut self, mut payload: Vec<u8>) {
        let bytes = self.limits.payload_max.next_multiple_of(SECTOR);
        payload.clear();
        if payload.capacity() > bytes {
            payload.shrink_to(bytes);
        }
        if payload.capacity() >= bytes && self.free.len() < self.limits.buffers {
            self.free.push(payload);
        }
    }

    /// Whether one more tombstone has a place.
    pub fn takes_tombstone(&self) -> bool {
        let queued = self.pending().filter(|p| !p.2).count();
        self.index.tombstones + queued < self.limits.records_max
    }

    /// Whether compaction of a segment is paid for: each byte that it copies, and what the file itself costs, by a byte that the
    /// owner made stale there (`compact.rs`).
    pub fn pays(s: &Segment) -> bool {
        s.used.saturating_sub(s.live) >= s.live + OVERHEAD
    }

    /// A sealed segment of which a sync failed: what is in it must be written anew.
    pub fn suspect(&self) -> Option<usize> {
        self.segments.iter().position(|s| s.state == Use::Sealed && s.is_open && !s.is_unreadable)
    }

    /// The segment with most stale bytes of those whose compaction is paid for.
    pub fn victim(&self) -> Option<usize> {
        let all = self.segments.iter().enumerate();
        let paid = all.filter(|(_, s)| s.state == Use::Sealed && !s.is_unreadable && State::pays(s));
        paid.max_by_key(|(i, s)| (s.used - s.live, std::cmp::Reverse(*i))).map(|(i, _)| i)
    }

    /// Removals wait for compaction: their tombstones fill half of the places there are.
    pub fn has_many_tombstones(&self) -> bool {
        self.index.tombstones > self.limits.records_max / 2
    }

    pub fn wants_compaction(&self) -> bool {
        let needs_files = self.available() <= 2;
        let active_pays = || self.active.is_some_and(|a| State::pays(&self.segments[a])) && self.available() >= 2;
        let pressed = needs_files || self.has_many_tombstones();
        self.suspect().is_some() || pressed && self.victim().is_some() || self.has_many_tombstones() && active_pays()
    }

    /// Raises what is known to be on the disk, unless a segment is in doubt.
    pub fn settle(&mut self, number: u64) {
        if self.suspect().is_none() {
            self.synced = self.synced.max(number);
        }
    }

    /// Takes note of a record that was written at the end of the active segment: what it replaces is stale from now on.
    pub fn commit(&mut self, header: &Header, place: Place) {
        let before = self.index.get(&header.key).map(|e| e.newest);
        let segment = &mut self.segments[place.segment];
        segment.used += place.size();
        segment.end = place.offset + place.size();
        self.figures.written_bytes += place.size();
        // Full it cannot be, since more than it holds is not put; a record that it refuses is stale.
        if self.index.insert(header, place).is_ok() {
            self.segments[place.segment].live += place.size();
            self.stale(before);
        }
    }

    /// A record counts no longer.
    pub fn stale(&mut self, place: Option<Place>) {
        if let Some(place) = place {
            let segment = &mut self.segments[place.segment];
            segment.live = segment.live.saturating_sub(place.size());
        }
    }
}
