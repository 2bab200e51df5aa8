//! What the writing thread does, a small portion at a time: records of the owner, compaction, syncs.

use super::append::{append, make, place_for, sync};
use super::compact;
use super::index::Place;
use super::record::{size, Form, Header, SECTOR};
use super::shared::{Shared, Writer};
use std::io;
use std::time::{Duration, Instant};

/// What was written is synced after so long: on the disk within a second, the sync's own time included.
const SYNC_PERIOD: Duration = Duration::from_millis(500);
/// Pause after an error: a disk that is full or gone is not asked more often.
const RETRY_PERIOD: Duration = Duration::from_secs(1);

pub enum Step {
    Worked,
    /// Nothing is due before this instant.
    Idle(Option<Instant>),
    Failed,
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

/// Makes one file ahead of its use, so that there is room for new generations also when others fill the disk.
fn make_spare(shared: &Shared, w: &mut Writer, now: Instant) {
    if !shared.state().wants_file() || w.room_at.is_some_and(|at| at > now) {
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
