//! What the writing thread does, a small portion at a time: records of the owner, seals, syncs, compaction.
//!
//! A payload is written before its header, so that a process that dies leaves no header without its payload. What is on the
//! disk is known in memory only after the call that put it there succeeded: after a failure the same place is written again.

use super::compact::{self, Compaction};
use super::disk::Shared;
use super::index::Place;
use super::record::{size, Form, Header, SegmentHeader, SECTOR, VERSION};
use super::scan::{Segment, Use};
use super::segment::{sync_file, write_at, SCRATCH};
use super::state::{State, ENDS};
use super::Limits;
use std::fs::File;
use std::io;
use std::time::{Duration, Instant};

/// What was written is synced after so long: on the disk within a second, the sync's own time included.
const SYNC_PERIOD: Duration = Duration::from_millis(500);
/// Pause after an error: a disk that is full or gone is not asked more often.
const RETRY_PERIOD: Duration = Duration::from_secs(1);

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
    turn: bool,
    next_write: Instant,
    retry_at: Option<Instant>,
    room_at: Option<Instant>,
}

pub enum Step {
    Worked,
    /// Nothing is due before this instant.
    Idle(Option<Instant>),
    Failed,
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

/// Does one portion of what waits. `paced`: not faster than the limits say.
pub fn step(shared: &Shared, w: &mut Writer, paced: bool) -> Step {
    let now = Instant::now();
    match try_step(shared, w, paced, now) {
        Ok(step) => step,
        Err(e) => {
            w.retry_at = Some(now + RETRY_PERIOD);
            shared.failed(&e);
            Step::Failed
        }
    }
}

fn try_step(shared: &Shared, w: &mut Writer, paced: bool, now: Instant) -> io::Result<Step> {
    let state = shared.state();
    let hurry = state.stop || state.flush_to > state.synced;
    let (has_record, has_rescue) = (!state.queue.is_empty(), !state.rescues.is_empty());
    // A store that closes has no use for room.
    let compacts = (has_record || !state.stop) && (w.compaction.is_some() || state.wants_compaction());
    let is_behind = state.synced < state.written && state.suspect().is_none();
    drop(state);
    if let Some(at) = w.retry_at.filter(|at| *at > now && !hurry) {
        return Ok(Step::Idle(Some(at)));
    }
    w.retry_at = None;
    make_spare(shared, w, now);
    let due = w.dirty_since.map(|since| since + SYNC_PERIOD);
    if due.is_some_and(|due| due <= now) || hurry && !has_record && (due.is_some() || is_behind) {
        sync(shared, w)?;
        return Ok(Step::Worked);
    }
    if !(has_record || has_rescue || compacts) {
        return Ok(Step::Idle(due));
    }
    if paced && !hurry && w.next_write > now {
        return Ok(Step::Idle(Some(due.map_or(w.next_write, |due| due.min(w.next_write)))));
    }
    if compacts && (w.turn || !has_record) {
        w.turn = false;
        compact::portion(shared, w)?;
        return Ok(Step::Worked);
    }
    if has_record && write_next(shared, w)? {
        w.turn = true;
        return Ok(Step::Worked);
    }
    if compacts {
        compact::portion(shared, w)?;
        return Ok(Step::Worked);
    }
    if !has_record {
        let done = compact::rescue_next(shared, w)?;
        return Ok(if done { Step::Worked } else { Step::Idle(Some(due.unwrap_or(now + RETRY_PERIOD))) });
    }
    Err(io::Error::new(io::ErrorKind::StorageFull, "the disk has no room for another segment of the store"))
}

/// Writes the record that has waited longest; false where there is no room before compaction has made some.
fn write_next(shared: &Shared, w: &mut Writer) -> io::Result<bool> {
    let bytes = shared.state().queue.front().map_or(0, |p| size(p.payload.len()) as u64);
    let Some((segment, offset, sequence)) = place_for(shared, w, bytes, false)? else { return Ok(false) };
    let mut state = shared.state();
    let Some(mut record) = state.queue.pop_front() else { return Ok(true) };
    let before = state.index.get(&record.key).map(|e| e.generation);
    state.in_flight = Some((record.key, bytes, !record.is_tombstone));
    let identity = state.identity;
    drop(state);
    let form = if record.is_tombstone { Form::Tombstone } else { Form::Data };
    let length = record.payload.len();
    let header = Header {
        form,
        key: record.key,
        generation: before.unwrap_or(0).saturating_add(1),
        length: length as u32,
        payload_crc: crc32c::crc32c(&record.payload),
        sequence,
        identity,
        about: record.about,
    };
    record.payload.resize(length.next_multiple_of(SECTOR), 0);
    // What removes nothing is not written.
    let is_needed = !record.is_tombstone || before.is_some();
    let written = if is_needed { append(shared, w, offset, &header, &record.payload) } else { Ok(()) };
    record.payload.truncate(length);
    let mut state = shared.state();
    state.in_flight = None;
    if let Err(e) = written {
        state.queue.push_front(record);
        return Err(e);
    }
    if is_needed {
        state.commit(&header, Place { segment, offset, length: length as u32 });
    }
    state.written = record.number;
    state.take_back(record.payload);
    drop(state);
    shared.done.notify_all();
    shared.asked.notify_all();
    Ok(true)
}

/// Writes a record; its place is in memory only when the caller takes note of it.
pub fn append(shared: &Shared, w: &mut Writer, offset: u64, header: &Header, payload: &[u8]) -> io::Result<()> {
    let Some(file) = &w.file else { return Err(io::Error::other("no segment is open")) };
    w.dirty_since.get_or_insert_with(Instant::now);
    write_at(file, payload, offset + SECTOR as u64)?;
    write_at(file, &header.encode(), offset)?;
    let rate = shared.state().limits.write_bytes_per_s;
    if rate > 0 {
        let pause = Duration::from_secs_f64((SECTOR + payload.len()) as f64 / rate as f64);
        w.next_write = w.next_write.max(Instant::now()) + pause;
    }
    Ok(())
}

/// Where so many bytes go: segment, offset, and the segment's sequence number. `None` where that would take from compaction the
/// file that it needs to make room: a copy may take it, the owner's record may not.
pub fn place_for(shared: &Shared, w: &mut Writer, bytes: u64, is_copy: bool) -> io::Result<Option<(usize, u64, u64)>> {
    loop {
        let state = shared.state();
        let available = state.available();
        if !is_copy && available == 0 {
            return Ok(None);
        }
        let active = state.active.map(|a| (a, state.segments[a]));
        if let Some((at, s)) = active.filter(|(_, s)| s.end + bytes + ENDS <= s.bytes) {
            return Ok(Some((at, s.end, s.sequence)));
        }
        if !is_copy && available < 2 {
            return Ok(None);
        }
        drop(state);
        if active.is_some() {
            seal(shared, w)?;
        }
        begin(shared, w)?;
    }
}

/// Begins a segment in a file that waits for it.
fn begin(shared: &Shared, w: &mut Writer) -> io::Result<()> {
    let mut waiting = next_free(&shared.state());
    if waiting.is_none() {
        make(shared)?;
        waiting = next_free(&shared.state());
    }
    let Some((at, number)) = waiting else {
        return Err(io::Error::new(io::ErrorKind::StorageFull, "no file of the store is free"));
    };
    let file = shared.folder.write(number)?;
    let header = new_header(&shared.state(), false);
    write_at(&file, &header.encode(), 0)?;
    let mut state = shared.state();
    state.next_sequence += 1;
    let (sequence, bytes) = (header.sequence, state.segments[at].bytes);
    state.segments[at] = Segment { state: Use::Active, is_open: true, ..empty(number, sequence, bytes) };
    state.active = Some(at);
    state.figures.written_bytes += SECTOR as u64;
    w.file = Some(file);
    w.dirty_since.get_or_insert_with(Instant::now);
    Ok(())
}

fn next_free(state: &State) -> Option<(usize, u32)> {
    let free = state.segments.iter().position(|s| s.state == Use::Free);
    free.map(|at| (at, state.segments[at].number))
}

/// A header with the next sequence number, which counts when the caller has raised it.
pub fn new_header(state: &State, is_free: bool) -> SegmentHeader {
    SegmentHeader { version: VERSION, identity: state.identity, sequence: state.next_sequence, is_free }
}

pub fn empty(number: u32, sequence: u64, bytes: u64) -> Segment {
    let end = SECTOR as u64;
    Segment { number, sequence, bytes, used: 0, live: 0, end, state: Use::Free, is_unreadable: false, is_open: false }
}

/// Makes one file ahead of its use, so that compaction has one also when others fill the disk.
fn make_spare(shared: &Shared, w: &mut Writer, now: Instant) {
    let state = shared.state();
    let is_wanted = next_free(&state).is_none() && state.may_grow();
    drop(state);
    if !is_wanted || w.room_at.is_some_and(|at| at > now) {
        return;
    }
    let made = make(shared);
    w.room_at = made.is_err().then(|| now + RETRY_PERIOD);
    let mut state = shared.state();
    state.no_room = made.is_err();
    drop(state);
    if let Err(e) = made {
        shared.count_error(&e);
    }
}

/// Makes a file that is free.
pub fn make(shared: &Shared) -> io::Result<()> {
    let state = shared.state();
    let (number, bytes, header) = (state.next_number, state.limits.segment_bytes, new_header(&state, true));
    if !state.may_grow() || number > super::segment::NUMBER_MAX {
        return Err(io::Error::new(io::ErrorKind::StorageFull, "the store has as many files as its limits allow"));
    }
    drop(state);
    let file = shared.folder.make(number, bytes)?;
    if let Err(e) = write_at(&file, &header.encode(), 0).and_then(|()| sync_file(&file)) {
        let _ = shared.folder.remove(number);
        return Err(e);
    }
    let mut state = shared.state();
    state.next_sequence += 1;
    state.next_number += 1;
    state.figures.written_bytes += SECTOR as u64;
    state.figures.syncs += 1;
    let segment = empty(number, header.sequence, bytes);
    match state.segments.iter_mut().find(|s| s.state == Use::Gone) {
        Some(gone) => *gone = segment,
        None => state.segments.push(segment),
    }
    Ok(())
}

/// Ends the active segment: synced first, so that an end marker says that everything before it is on the disk.
pub fn seal(shared: &Shared, w: &mut Writer) -> io::Result<()> {
    sync(shared, w)?;
    let state = shared.state();
    let Some(at) = state.active else { return Ok(()) };
    let (segment, identity) = (state.segments[at], state.identity);
    drop(state);
    let marked = w.file.as_ref().map_or(Ok(()), |file| mark_end(file, &segment, identity));
    w.file = None;
    let mut state = shared.state();
    state.active = None;
    state.segments[at].state = Use::Sealed;
    // Without its markers it is searched to its end at the next boot.
    state.segments[at].is_open = false;
    state.figures.written_bytes += ENDS;
    marked
}

/// Writes the end markers of a segment: behind the last record, where a walk ends, and into the last sector, where the boot
/// looks.
pub fn mark_end(file: &File, segment: &Segment, identity: u64) -> io::Result<()> {
    let end = Header::bare(Form::End, segment.sequence, identity).encode();
    write_at(file, &end, segment.end)?;
    write_at(file, &end, segment.bytes - SECTOR as u64)
}

/// Puts the active segment on the disk. Where that fails nobody knows what of it is there, and asking again says nothing: the
/// system has dropped what it could not write. The segment is given up, and compaction writes anew what is in it.
pub fn sync(shared: &Shared, w: &mut Writer) -> io::Result<()> {
    let number = shared.state().written;
    let synced = match (&w.file, w.dirty_since) {
        (Some(file), Some(_)) => sync_file(file),
        _ => {
            shared.state().settle(number);
            shared.done.notify_all();
            return Ok(());
        }
    };
    w.dirty_since = None;
    let mut state = shared.state();
    state.figures.syncs += 1;
    match synced {
        Ok(()) => state.settle(number),
        Err(_) => {
            w.file = None;
            if let Some(at) = state.active.take() {
                state.segments[at].state = Use::Sealed;
            }
        }
    }
    drop(state);
    shared.done.notify_all();
    synced
}
