//! What a folder holds: the boot's way from files to an index.
//!
//! Headers alone are read, in the order in which they were written. Of segments without an end marker the payloads are
//! checked too: what a power cut tore has a whole header here and there, and must not stand in the place of the generation
//! before it, which is whole.

use super::index::{Full, Index, Place};
use super::record::{Form, Header, SegmentHeader, SECTOR, VERSION};
use super::segment::{self, Folder, Walk, SCRATCH};
use super::snapshot;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt as _;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::thread::Builder;
use stipple_drivers::{Fault, FaultKind};

pub const LOCK: &str = "lock";
/// Foreign files that are named.
const WARNINGS_MAX: usize = 16;
/// Threads that read headers ahead of the scan.
const READERS: usize = 8;

#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Use {
    Free,
    /// Appended to.
    Active,
    /// Full, or never to be appended to again.
    Sealed,
    /// The file was removed: its place in the list is free.
    Gone,
}

#[derive(Clone, Copy, Debug)]
pub struct Segment {
    pub number: u32,
    pub sequence: u64,
    /// Size of the file.
    pub bytes: u64,
    /// Bytes of records, and of those among them that count.
    pub used: u64,
    pub live: u64,
    /// Where the next record goes.
    pub end: u64,
    pub state: Use,
    /// The disk refused to read it: it is left as it is.
    pub is_unreadable: bool,
    /// It was not sealed, or a sync of it failed: not all of it need be on the disk.
    pub is_open: bool,
}

#[derive(Debug)]
pub struct Found {
    /// In the order of their sequence numbers.
    pub segments: Vec<Segment>,
    pub identity: u64,
    pub next_sequence: u64,
    pub next_number: u32,
    /// Size of files that have a segment's name and are none.
    pub foreign_bytes: u64,
    pub warnings: Vec<String>,
    pub read_bytes: u64,
    pub damaged: u64,
    pub read_errors: u64,
    /// Records whose payload a power cut tore.
    pub torn: Vec<(Place, Header)>,
}

pub fn io_fault(kind: FaultKind, path: &Path, what: &str, e: &io::Error, fix: &str) -> Fault {
    Fault::new(kind, path.display().to_string(), format!("{what}: {e}"), fix)
}

/// Reads what is in a folder into `index`. With an `identity` the store must be of it, else it is the newest segment's. `check`
/// has room for the longest payload that may be there where payloads are checked.
pub fn scan(
    path: &Path,
    folder: &Folder,
    identity: Option<u64>,
    index: &mut Index,
    mut check: Option<&mut [u8]>,
) -> Result<Found, Fault> {
    let mut found = list(path, folder, identity)?;
    let sealed: Vec<Segment> = found.segments.iter().filter(|s| s.state == Use::Sealed).copied().collect();
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let readers = if sealed.len() > 1 { READERS.min(sealed.len()) } else { 0 };
        for t in 0..readers {
            let own = sealed.iter().skip(t).step_by(readers);
            let read = || own.for_each(|segment| read_ahead(folder, segment, &over));
            // Where no thread can start, the scan reads all by itself.
            let _ = Builder::new().name("store".into()).spawn_scoped(scope, read);
        }
        let taken = take(path, folder, &mut found, index, &mut check);
        over.store(true, Relaxed);
        taken
    })?;
    complete(path, folder, &mut found, index)?;
    for entry in index.entries() {
        found.segments[entry.newest.segment].live += entry.newest.size();
    }
    Ok(found)
}

/// Brings the headers of a segment into the page cache. Where each is, is known from the one before: of one segment a disk
/// is asked for one at a time, and most disks serve several in the time of one. Ends where there is no header, or when the scan
/// is over.
fn read_ahead(folder: &Folder, segment: &Segment, over: &AtomicBool) {
    let Ok(file) = folder.read(segment.number) else { return };
    let (mut at, mut sector) = (SECTOR as u64, [0; SECTOR]);
    while !over.load(Relaxed) && file.read_exact_at(&mut sector, at).is_ok() {
        let Some(header) = Header::decode(&sector) else { return };
        at += header.size() as u64;
    }
}

/// Takes the records of all segments, in the order in which they were written.
fn take(
    path: &Path,
    folder: &Folder,
    found: &mut Found,
    index: &mut Index,
    check: &mut Option<&mut [u8]>,
) -> Result<(), Fault> {
    let mut scratch = vec![0; SCRATCH];
    for i in 0..found.segments.len() {
        if found.segments[i].state != Use::Sealed {
            continue;
        }
        let number = found.segments[i].number;
        let file = match folder.read(number) {
            // A run that writes may have removed it.
            Err(e) if e.kind() == io::ErrorKind::NotFound => {
                found.segments[i].state = Use::Gone;
                continue;
            }
            opened => opened.map_err(|e| unreadable(path, number, &e))?,
        };
        let place = path.join(segment::name(number));
        match walk(found, i, &file, index, &mut scratch, check) {
            Ok(()) => {}
            Err(Stop::Io(e)) => {
                found.read_errors += 1;
                found.segments[i].is_unreadable = true;
                warn(found, format!("{}: a part cannot be read: {e}; the disk may be failing", place.display()));
            }
            Err(Stop::Full) => {
                let why = "the store holds more records than the limits allow";
                return Err(Fault::new(
                    FaultKind::Config,
                    place.display().to_string(),
                    why,
                    "raise the limit of records",
                ));
            }
            Err(Stop::Long(n)) => {
                let why = format!("a record of {n} bytes is longer than the limits allow");
                return Err(Fault::new(
                    FaultKind::Config,
                    place.display().to_string(),
                    why,
                    "raise the limit of a payload",
                ));
            }
        }
    }
    Ok(())
}

fn unreadable(path: &Path, number: u32, e: &io::Error) -> Fault {
    let place = path.join(segment::name(number));
    io_fault(FaultKind::Io, &place, "a segment of the store cannot be opened", e, "check its permissions and the disk")
}

fn warn(found: &mut Found, text: String) {
    if found.warnings.len() < WARNINGS_MAX {
        found.warnings.push(text);
    }
}

/// What a file of a segment's name is.
enum Kind {
    Segment(SegmentHeader),
    /// Its header is lost, and its records say what it was.
    Headless(SegmentHeader),
    /// Made and never written to.
    Blank,
    Foreign,
}

/// The files of a folder, by their headers.
fn list(path: &Path, folder: &Folder, identity: Option<u64>) -> Result<Found, Fault> {
    let refused = |e: io::Error| io_fault(FaultKind::NoInput, path, "the store's folder cannot be read", &e, "");
    let (mut numbers, mut strangers) = (vec![], vec![]);
    for entry in std::fs::read_dir(path).map_err(refused)? {
        let name = entry.map_err(refused)?.file_name();
        match name.to_str().and_then(segment::number) {
            Some(number) => numbers.push(number),
            None if matches!(name.to_str(), Some(LOCK | snapshot::NAME)) => {}
            None => strangers.push(name.to_string_lossy().into_owned()),
        }
    }
    numbers.sort_unstable();
    strangers.sort_unstable();
    let mut found = Found {
        segments: vec![],
        identity: identity.unwrap_or(0),
        next_sequence: 1,
        next_number: numbers.last().map_or(0, |n| n + 1),
        foreign_bytes: 0,
        warnings: vec![],
        read_bytes: 0,
        damaged: 0,
        read_errors: 0,
        torn: vec![],
    };
    let mut kinds = vec![];
    for number in numbers {
        let (kind, bytes) = match kind_of(path, folder, number, identity, &mut found.read_bytes) {
            Ok(Some(kind)) => kind,
            Ok(None) => continue,
            Err(fault) => return Err(fault),
        };
        kinds.push((number, bytes, kind));
    }
    if identity.is_none() {
        // A reader takes the newest segment's word; where no header is whole, a record's.
        let sequence = |kind: &Kind| match kind {
            Kind::Segment(h) => Some((1, h.sequence, h.identity)),
            Kind::Headless(h) => Some((0, h.sequence, h.identity)),
            _ => None,
        };
        found.identity = kinds.iter().filter_map(|k| sequence(&k.2)).max().map_or(0, |(_, _, identity)| identity);
    }
    for (number, bytes, kind) in kinds {
        let mut segment = Segment {
            number,
            sequence: 0,
            bytes,
            used: 0,
            live: 0,
            end: SECTOR as u64,
            state: Use::Free,
            is_unreadable: false,
            is_open: false,
        };
        match kind {
            Kind::Segment(h) | Kind::Headless(h) if h.identity == found.identity => {
                found.damaged += u64::from(matches!(kind, Kind::Headless(_)));
                segment.sequence = h.sequence;
                segment.state = if h.is_free { Use::Free } else { Use::Sealed };
                found.next_sequence = found.next_sequence.max(h.sequence.saturating_add(1));
            }
            Kind::Blank => {}
            _ => {
                found.foreign_bytes += bytes;
                strangers.push(segment::name(number));
                continue;
            }
        }
        found.segments.push(segment);
    }
    for name in strangers {
        warn(&mut found, format!("{}: a file that is not the store's; it is left as it is", path.join(name).display()));
    }
    found.segments.sort_by_key(|s| s.sequence);
    Ok(found)
}

fn kind_of(
    path: &Path,
    folder: &Folder,
    number: u32,
    identity: Option<u64>,
    read_bytes: &mut u64,
) -> Result<Option<(Kind, u64)>, Fault> {
    let place = path.join(segment::name(number));
    let file = match folder.read(number) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
        // A link, a socket: whatever has our name without being a file is not opened.
        Err(_) if !place.symlink_metadata().is_ok_and(|m| m.is_file()) => return Ok(Some((Kind::Foreign, 0))),
        opened => opened.map_err(|e| unreadable(path, number, &e))?,
    };
    let meta = file.metadata().map_err(|e| unreadable(path, number, &e))?;
    if !meta.is_file() {
        return Ok(Some((Kind::Foreign, 0)));
    }
    let bytes = meta.len();
    let mut sector = [0; SECTOR];
    let got = bytes.min(SECTOR as u64) as usize;
    // A sector that cannot be read is as good as a damaged one.
    let _ = file.read_exact_at(&mut sector[..got], 0);
    *read_bytes += got as u64;
    if let Some(header) = SegmentHeader::decode(&sector) {
        let text = place.display().to_string();
        if header.version != VERSION {
            let why =
                format!("the store has version {} of the form on the disk, this program {VERSION}", header.version);
            return Err(Fault::new(FaultKind::Data, text, why, "begin a new one with --fresh, or name another folder"));
        }
        if identity.is_some_and(|identity| header.identity != identity) {
            let why = "the store is that of another rig or of another shape of the map";
            return Err(Fault::new(
                FaultKind::Config,
                text,
                why,
                "begin a new one with --fresh, or name another folder",
            ));
        }
        return Ok(Some((Kind::Segment(header), bytes)));
    }
    let first = first_record(&file, bytes, identity, read_bytes);
    let kind = match first {
        Some(h) => Kind::Headless(SegmentHeader {
            version: VERSION,
            identity: h.identity,
            sequence: h.sequence,
            is_free: false,
        }),
        None if sector == [0; SECTOR] => Kind::Blank,
        None => Kind::Foreign,
    };
    Ok(Some((kind, bytes)))
}

/// The first record's header of a file whose own is lost.
fn first_record(file: &File, bytes: u64, identity: Option<u64>, read_bytes: &mut u64) -> Option<Header> {
    let mut scratch = vec![0; SCRATCH];
    let mut at = SECTOR as u64;
    while at + SECTOR as u64 <= bytes {
        let wanted = (bytes - at).min(SCRATCH as u64) as usize / SECTOR * SECTOR;
        file.read_exact_at(&mut scratch[..wanted], at).ok()?;
        *read_bytes += wanted as u64;
        let mut headers = scratch[..wanted].chunks_exact(SECTOR).filter_map(Header::decode);
        if let Some(header) = headers.find(|h| identity.is_none_or(|identity| h.identity == identity)) {
            return Some(header);
        }
        at += wanted as u64;
    }
    None
}

enum Stop {
    Io(io::Error),
    Full,
    /// A payload of so many bytes.
    Long(u32),
}

impl From<io::Error> for Stop {
    fn from(e: io::Error) -> Stop {
        Stop::Io(e)
    }
}

impl From<Full> for Stop {
    fn from(_: Full) -> Stop {
        Stop::Full
    }
}

/// Takes the records of one segment.
fn walk(
    found: &mut Found,
    i: usize,
    file: &File,
    index: &mut Index,
    scratch: &mut [u8],
    check: &mut Option<&mut [u8]>,
) -> Result<(), Stop> {
    let Segment { bytes, sequence, .. } = found.segments[i];
    let identity = found.identity;
    let is_sealed = segment::is_sealed(file, bytes, sequence, identity)?;
    found.segments[i].is_open = !is_sealed;
    found.read_bytes += SECTOR as u64;
    let mut walk = Walk::new(bytes, sequence, identity);
    loop {
        let next = walk.next(file, scratch);
        let Some((offset, header)) = next.inspect_err(|_| found.read_bytes += walk.read)? else { break };
        let place = Place { segment: i, offset, length: header.length };
        let segment = &mut found.segments[i];
        segment.used += place.size();
        segment.end = walk.at;
        if let Some(payload) = check.as_deref_mut().filter(|_| header.form == Form::Data) {
            let room = payload.len();
            let payload = payload.get_mut(..header.length as usize).ok_or(Stop::Long(header.length))?;
            debug_assert!(payload.len() <= room);
            if !is_sealed {
                file.read_exact_at(payload, offset + SECTOR as u64)?;
                found.read_bytes += payload.len() as u64;
                if crc32c::crc32c(payload) != header.payload_crc {
                    found.damaged += 1;
                    found.torn.push((place, header));
                    continue;
                }
            }
        }
        index.insert(&header, place)?;
    }
    found.read_bytes += walk.read;
    found.damaged += walk.damaged;
    Ok(())
}

/// Reads the headers again of those records for which the index had no place while removed ones were in it.
fn complete(path: &Path, folder: &Folder, found: &mut Found, index: &mut Index) -> Result<(), Fault> {
    let missing: Vec<_> = index.without_about().collect();
    for (key, place) in missing {
        let number = found.segments[place.segment].number;
        let mut sector = [0; SECTOR];
        let read = folder.read(number).and_then(|file| file.read_exact_at(&mut sector, place.offset));
        read.map_err(|e| unreadable(path, number, &e))?;
        found.read_bytes += SECTOR as u64;
        let about = Header::decode(&sector).map(|h| h.about);
        if about.is_none_or(|about| index.complete(&key, &about).is_err()) {
            let why = "the store holds more records than the limits allow";
            let place = path.display().to_string();
            return Err(Fault::new(FaultKind::Config, place, why, "raise the limit of records"));
        }
    }
    Ok(())
}
