//! Compaction: copies what counts of a segment, and frees its file.
//!
//! Write amplification is at most 2, by construction. A segment is compacted only where at least as many of its bytes are
//! stale as are copied from it, its headers and end markers counted as copied (`State::pays`). A record becomes stale once,
//! by what the owner does, and is stale in one place: its copies are made before, and the places they were copied from are
//! freed. So all that is ever copied is at most what became stale, which is at most what was put. That such a segment exists
//! whenever one is needed follows from what may be put (`state::live_max`): half of the space.
//!
//! What is freed: copies are synced, then the file gets a new sequence number, and that is synced. Until then its records
//! count at the next boot; after it they do not, and no tombstone is needed for them.

use super::append::{append, empty, new_header, place_for, seal, sync};
use super::index::Place;
use super::record::{Form, Header, Key, SECTOR};
use super::scan::Use;
use super::segment::{sync_file, write_at, Walk};
use super::shared::{Compaction, Shared, Writer};
use std::io;
use std::os::unix::fs::FileExt as _;

/// Stale records that are passed over in one portion.
const PORTION: usize = 64;

/// Begins compaction, or copies one record, or frees the segment.
pub fn portion(shared: &Shared, w: &mut Writer) -> io::Result<()> {
    let Some(mut compaction) = w.compaction.take() else { return choose(shared, w) };
    let done = advance(shared, w, &mut compaction);
    if !matches!(done, Ok(true)) {
        w.compaction = Some(compaction);
    }
    done.map(|_| ())
}

fn choose(shared: &Shared, w: &mut Writer) -> io::Result<()> {
    let state = shared.state();
    let Some(at) = state.suspect().or_else(|| state.victim()) else {
        drop(state);
        // The removed records whose tombstones fill the index are in the segment that is appended to.
        return seal(shared, w);
    };
    let (segment, identity) = (state.segments[at], state.identity);
    drop(state);
    let file = shared.folder.read(segment.number)?;
    let walk = Walk::new(segment.bytes, segment.sequence, identity);
    w.compaction = Some(Compaction { at, file, walk });
    Ok(())
}

/// Copies the next record that counts; true when the compaction is over.
fn advance(shared: &Shared, w: &mut Writer, c: &mut Compaction) -> io::Result<bool> {
    for _ in 0..PORTION {
        let before = c.walk.read;
        let next = c.walk.next(&c.file, &mut w.scratch);
        shared.state().figures.read_bytes += c.walk.read - before;
        let Ok(next) = next else {
            set_aside(shared, c.at);
            return Ok(true);
        };
        let Some((offset, header)) = next else { return finish(shared, w, c) };
        let state = shared.state();
        let place = Place { segment: c.at, offset, length: header.length };
        let counts = state.index.get(&header.key).is_some_and(|e| e.newest == place);
        drop(state);
        if counts && matches!(header.form, Form::Data | Form::Tombstone) {
            match relocate(shared, w, &header.key) {
                Ok(true) => {}
                Ok(false) => {
                    set_aside(shared, c.at);
                    return Ok(true);
                }
                Err(e) => {
                    c.walk.at = offset;
                    return Err(e);
                }
            }
            return Ok(false);
        }
    }
    Ok(false)
}

/// Leaves a segment that the disk does not read, or of which a header was damaged since the boot, as it is.
fn set_aside(shared: &Shared, at: usize) {
    let mut state = shared.state();
    state.segments[at].is_unreadable = true;
    state.figures.read_errors += 1;
}

/// A record read for copying.
enum Copy {
    Whole(Header),
    Damaged(Header),
    Unreadable,
}

fn read(shared: &Shared, w: &mut Writer, place: Place) -> Copy {
    let state = shared.state();
    let (segment, identity) = (state.segments[place.segment], state.identity);
    drop(state);
    let mut sector = [0; SECTOR];
    w.copy.resize(place.length as usize, 0);
    let read = shared.folder.read(segment.number).and_then(|file| {
        file.read_exact_at(&mut sector, place.offset)?;
        file.read_exact_at(&mut w.copy, place.offset + SECTOR as u64)
    });
    shared.state().figures.read_bytes += (SECTOR + w.copy.len()) as u64;
    if read.is_err() {
        return Copy::Unreadable;
    }
    let is_own = |h: &Header| (h.sequence, h.identity, h.length) == (segment.sequence, identity, place.length);
    match Header::decode(&sector).filter(is_own) {
        None => Copy::Unreadable,
        Some(header) if crc32c::crc32c(&w.copy) == header.payload_crc => Copy::Whole(header),
        Some(header) => Copy::Damaged(header),
    }
}

/// Writes the newest generation of a key anew. Where it is damaged and the one before it is whole, that takes its place and its
/// number; where none is whole, the damaged one is copied as it is, so that the owner hears of it. False where the disk does
/// not give it.
fn relocate(shared: &Shared, w: &mut Writer, key: &Key) -> io::Result<bool> {
    let Some(entry) = shared.state().index.get(key).copied() else { return Ok(true) };
    let mut header = match read(shared, w, entry.newest) {
        Copy::Whole(header) => header,
        Copy::Unreadable => return Ok(false),
        Copy::Damaged(damaged) => {
            shared.state().figures.records_damaged += 1;
            let older = entry.previous.map(|place| read(shared, w, place));
            if let Some(Copy::Whole(older)) = older {
                Header { generation: entry.generation, ..older }
            } else {
                // The bytes of the one before are in the buffer.
                if matches!(read(shared, w, entry.newest), Copy::Unreadable) {
                    return Ok(false);
                }
                damaged
            }
        }
    };
    let Some((segment, offset, sequence)) = place_for(shared, w, header.size() as u64, true)? else {
        return Err(io::Error::new(io::ErrorKind::StorageFull, "no file of the store is free"));
    };
    header.sequence = sequence;
    let mut payload = std::mem::take(&mut w.copy);
    payload.resize((header.length as usize).next_multiple_of(SECTOR), 0);
    let written = append(shared, w, offset, &header, &payload);
    w.copy = payload;
    written?;
    shared.state().commit(&header, Place { segment, offset, length: header.length });
    Ok(true)
}

/// Frees a segment nothing of which counts.
fn finish(shared: &Shared, w: &mut Writer, c: &Compaction) -> io::Result<bool> {
    sync(shared, w)?;
    let state = shared.state();
    let segment = state.segments[c.at];
    if state.suspect().is_some_and(|other| other != c.at) {
        // What was copied may not be on the disk: that comes first, then this segment again.
        return Ok(true);
    }
    let (header, identity) = (new_header(&state, true), state.identity);
    drop(state);
    if segment.live > 0 {
        set_aside(shared, c.at);
        return Ok(true);
    }
    let file = shared.folder.write(segment.number)?;
    write_at(&file, &header.encode(), 0)?;
    sync_file(&file)?;
    release(shared, w, c, Walk::new(segment.bytes, segment.sequence, identity));
    let mut state = shared.state();
    state.next_sequence += 1;
    state.segments[c.at] = empty(segment.number, header.sequence, segment.bytes);
    state.figures.segments_compacted += 1;
    state.figures.syncs += 1;
    state.figures.written_bytes += SECTOR as u64;
    let number = if w.dirty_since.is_none() { state.written } else { state.synced };
    state.settle(number);
    let limit = state.limits.bytes_max.saturating_sub(state.foreign_bytes);
    let is_surplus = state.file_bytes() > limit || segment.bytes != state.limits.segment_bytes;
    drop(state);
    if is_surplus && shared.folder.remove(segment.number).is_ok() {
        shared.state().segments[c.at].state = Use::Gone;
    }
    shared.done.notify_all();
    Ok(true)
}

/// Takes the records of a freed segment out of the count. Where one cannot be read, its tombstone stays until the next boot.
fn release(shared: &Shared, w: &mut Writer, c: &Compaction, mut walk: Walk) {
    while let Ok(Some((_, header))) = walk.next(&c.file, &mut w.scratch) {
        if matches!(header.form, Form::Data | Form::Tombstone) {
            let mut state = shared.state();
            let tombstone = state.index.forget(&header.key, c.at, header.form == Form::Data);
            state.stale(tombstone);
        }
    }
    shared.state().figures.read_bytes += walk.read;
}

/// Writes a key anew whose newest generation was found damaged, before the one before it is freed. False where there is no room.
pub fn rescue_next(shared: &Shared, w: &mut Writer) -> io::Result<bool> {
    let mut state = shared.state();
    let Some(key) = state.rescues.first().copied() else { return Ok(false) };
    if state.available() < 2 {
        return Ok(false);
    }
    state.rescues.retain(|k| *k != key);
    let has_older = state.index.get(&key).is_some_and(|e| e.previous.is_some());
    drop(state);
    if has_older {
        relocate(shared, w, &key)?;
    }
    Ok(true)
}
