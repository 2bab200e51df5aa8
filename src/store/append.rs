//! Appends to segments: where a record goes, how a segment is begun, sealed, synced, and how a file is made.
//!
//! A payload is written before its header, so that a process that dies leaves no header without its payload. What is on the
//! disk is known in memory only after the call that put it there succeeded: after a failure the same place is written again.

use super::record::{Form, Header, SegmentHeader, SECTOR, VERSION};
use super::scan::{Segment, Use};
use super::segment::{sync_file, write_at, NUMBER_MAX};
use super::shared::{Shared, Writer};
use super::state::{State, ENDS};
use std::fs::File;
use std::io;
use std::time::{Duration, Instant};

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

/// Makes a file that is free.
pub fn make(shared: &Shared) -> io::Result<()> {
    let state = shared.state();
    let (number, bytes, header) = (state.next_number, state.limits.segment_bytes, new_header(&state, true));
    if !state.may_grow() || number > NUMBER_MAX {
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
