//! Opens a store: lock, boot scan, and what a power cut left half done.

use super::append::{make, mark_end};
use super::aside::lock;
use super::record::{size, Form, Header, SECTOR};
use super::scan::{io_fault, scan, Found, Use};
use super::segment::{sync_file, write_at, Folder};
use super::shared::{Shared, Writer};
use super::state::{live_max, segments_max, State, ENDS};
use super::Limits;
use std::fs;
use std::io;
use std::path::Path;
use stipple_drivers::{host, Fault, FaultKind};

/// Opens or makes a store, and answers what is worth a line.
pub fn open(path: &Path, identity: u64, limits: &Limits) -> Result<(Shared, Vec<String>), Fault> {
    check(path, limits)?;
    if !path.is_dir() {
        let made = fs::create_dir_all(path).and_then(|()| host::sync_folder_of(path));
        made.map_err(|e| {
            io_fault(FaultKind::NoOutput, path, "the store's folder cannot be made", &e, "name another folder")
        })?;
    }
    let refused = |e: io::Error| {
        let fix = "make room, check the disk, or name another folder";
        io_fault(FaultKind::NoOutput, path, "the store cannot be opened", &e, fix)
    };
    let locked = lock(path)?;
    let folder = Folder::open(path).map_err(refused)?;
    let mut state = State::new(limits, identity);
    // Payloads that are checked, and the headers of walks, take memory while it is opened alone.
    let mut payload = vec![0; limits.payload_max];
    let mut found = scan(path, &folder, Some(identity), &mut state.index, Some(&mut payload))?;
    let mut writer = Writer::new(limits);
    mend(&folder, &mut found, identity, limits, &mut writer, &mut state).map_err(refused)?;
    state.next_sequence = found.next_sequence;
    state.next_number = found.next_number;
    state.foreign_bytes = found.foreign_bytes;
    state.figures.read_bytes = found.read_bytes;
    state.figures.records_damaged = found.damaged;
    state.figures.read_errors = found.read_errors;
    // Room for every file that the limits allow was bought; more may be there from a run with other limits.
    state.segments.reserve(found.segments.len());
    state.segments.extend_from_slice(&found.segments);
    let is_new = state.segments.iter().all(|s| s.state == Use::Gone);
    if segments_max(limits, found.foreign_bytes) < SEGMENTS_MIN {
        let why = format!("foreign files of {} bytes leave the store too little room", found.foreign_bytes);
        return Err(Fault::new(FaultKind::Config, path.display().to_string(), why, "move them away"));
    }
    let shared = Shared::new(state, writer, folder, path.into(), locked);
    let mut files = 0;
    while shared.state().wants_file() {
        match make(&shared) {
            Err(e) if is_new && files < SEGMENTS_MIN => return Err(refused(e)),
            // What is there can be read; the writer tries again.
            Err(e) => {
                shared.count_error(&e);
                break;
            }
            Ok(()) => files += 1,
        }
    }
    Ok((shared, found.warnings))
}

/// Files without which compaction has no place to work.
const SEGMENTS_MIN: u64 = 4;

/// Checks limits against each other. Fails where nothing could be kept in a store of them.
fn check(path: &Path, limits: &Limits) -> Result<(), Fault> {
    let record = size(limits.payload_max) as u64;
    let refuse = |what: String, fix: &str| Err(Fault::new(FaultKind::Config, path.display().to_string(), what, fix));
    if limits.segment_bytes % SECTOR as u64 != 0 {
        return refuse(
            format!("segments of {} bytes are no whole sectors", limits.segment_bytes),
            "round up to 512 bytes",
        );
    }
    if segments_max(limits, 0) < SEGMENTS_MIN {
        let what = format!("{} bytes are fewer than {SEGMENTS_MIN} segments of the store", limits.bytes_max);
        return refuse(what, "give it more bytes, or smaller segments");
    }
    let max = live_max(limits, segments_max(limits, 0));
    if max < 2 * record {
        return refuse(format!("{max} bytes of records are fewer than two of the longest"), "give it more bytes");
    }
    if limits.buffers == 0 || limits.records_max == 0 || limits.records_max > u32::MAX as usize / 4 {
        return refuse("a store needs a buffer and a place for a record".into(), "raise the limit that is zero");
    }
    if limits.payload_max > i32::MAX as usize {
        return refuse(
            format!("payloads of {} bytes are too long", limits.payload_max),
            "lower the limit of a payload",
        );
    }
    Ok(())
}

/// Puts right what a power cut or a failing disk left: records that were torn are made void, so that they never stand before
/// the generation that is whole; segments that were not sealed are synced, sealed, or gone on with.
fn mend(
    folder: &Folder,
    found: &mut Found,
    identity: u64,
    limits: &Limits,
    writer: &mut Writer,
    state: &mut State,
) -> io::Result<()> {
    let newest = found.segments.iter().rposition(|s| s.state == Use::Sealed);
    for at in 0..found.segments.len() {
        let s = found.segments[at];
        // A file without anything in it and of another size is made anew when it is needed.
        if s.state == Use::Free && s.bytes != limits.segment_bytes {
            folder.remove(s.number)?;
            found.segments[at].state = Use::Gone;
        }
        if s.state != Use::Sealed || !s.is_open || s.is_unreadable {
            continue;
        }
        let file = folder.write(s.number)?;
        for (place, header) in found.torn.iter().filter(|(place, _)| place.segment == at) {
            let void = Header { form: Form::Void, ..*header };
            write_at(&file, &void.encode(), place.offset)?;
        }
        let has_room = s.end + ENDS <= s.bytes;
        let goes_on = Some(at) == newest && has_room && s.bytes == limits.segment_bytes;
        if !goes_on && has_room && s.bytes % SECTOR as u64 == 0 {
            mark_end(&file, &s, identity)?;
        }
        // The system may still hold what a killed process wrote.
        sync_file(&file)?;
        found.segments[at].is_open = goes_on;
        if goes_on {
            found.segments[at].state = Use::Active;
            state.active = Some(at);
            writer.file = Some(file);
        }
    }
    Ok(())
}
