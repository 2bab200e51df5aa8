//! Begins a store anew: what is there is moved beside it. One previous store is kept, and nothing that is not a store's is
//! removed or overwritten.

use super::record::{SegmentHeader, SECTOR};
use super::scan::LOCK;
use super::segment;
use super::snapshot;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use stipple_drivers::{host, Fault, FaultKind};

/// Moves the segments of a store to `previous-NAME` beside its folder, in the place of those that are there, and answers where;
/// `None` where there were none. Fails where a run holds the store, or a file cannot be moved.
pub fn set_aside(folder: &Path) -> Result<Option<PathBuf>, Fault> {
    let Some(name) = folder.file_name().filter(|_| folder.is_dir()) else { return Ok(None) };
    let fault = |place: &Path, e: io::Error| {
        let why = format!("the store that is there cannot be set aside: {e}");
        Fault::new(FaultKind::NoOutput, place.display().to_string(), why, "move it by hand, or name another folder")
    };
    let _lock = lock(folder)?;
    let mut aside = std::ffi::OsString::from("previous-");
    aside.push(name);
    let aside = folder.with_file_name(aside);
    let ours = segments(folder).map_err(|e| fault(folder, e))?;
    if ours.iter().all(|name| name == snapshot::NAME) {
        // Without its segments it is nothing.
        let removed = ours.iter().try_for_each(|name| fs::remove_file(folder.join(name)));
        return removed.map(|()| None).map_err(|e| fault(folder, e));
    }
    let move_all = || {
        fs::create_dir_all(&aside)?;
        for old in segments(&aside)? {
            fs::remove_file(aside.join(old))?;
        }
        for name in &ours {
            let to = aside.join(name);
            if to.symlink_metadata().is_ok() {
                let why = format!("{} is in its way, and is no segment", to.display());
                return Err(io::Error::new(io::ErrorKind::AlreadyExists, why));
            }
            fs::rename(folder.join(name), to)?;
        }
        File::open(&aside)?.sync_all()?;
        File::open(folder)?.sync_all()?;
        host::sync_folder_of(folder)
    };
    move_all().map_err(|e| fault(&aside, e))?;
    Ok(Some(aside))
}

/// How long a lock that is taken is asked for again: a process that is being started holds copies of its parent's locks until it
/// runs its own program.
const LOCK_PATIENCE: Duration = Duration::from_millis(200);

/// Takes the lock of a store. Fails where another has it, or the folder cannot be written.
pub fn lock(folder: &Path) -> Result<File, Fault> {
    let place = folder.join(LOCK);
    let text = place.display().to_string();
    let file = OpenOptions::new().create(true).truncate(false).write(true).open(&place).map_err(|e| {
        let why = format!("the store's folder cannot be written: {e}");
        Fault::new(FaultKind::NoOutput, &text[..], why, "name another folder, or make this one writable")
    })?;
    let (begun, mut locked) = (Instant::now(), host::lock(&file));
    while begun.elapsed() < LOCK_PATIENCE && locked.as_ref().is_err_and(|e| e.kind() == io::ErrorKind::WouldBlock) {
        std::thread::sleep(LOCK_PATIENCE / 20);
        locked = host::lock(&file);
    }
    locked.map_err(|e| {
        let why = match e.kind() {
            io::ErrorKind::WouldBlock => "another run holds this store".to_string(),
            _ => format!("the store cannot be locked: {e}"),
        };
        Fault::new(FaultKind::Unavailable, text, why, "end that run, or name another folder")
    })?;
    Ok(file)
}

/// Names of the segments in a folder and of its snapshot: files that have the name of one, and its header or nothing in them.
fn segments(folder: &Path) -> io::Result<Vec<String>> {
    let mut found = vec![];
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name().to_string_lossy().into_owned();
        let is_snapshot = name == snapshot::NAME;
        if segment::number(&name).is_none() && !is_snapshot || !entry.file_type()?.is_file() {
            continue;
        }
        let (mut sector, mut got) = ([0; SECTOR], vec![]);
        File::open(entry.path())?.take(SECTOR as u64).read_to_end(&mut got)?;
        sector[..got.len()].copy_from_slice(&got);
        let is_ours = match is_snapshot {
            true => sector.starts_with(&snapshot::MAGIC),
            false => SegmentHeader::decode(&sector).is_some(),
        };
        if is_ours || sector == [0; SECTOR] {
            found.push(name);
        }
    }
    // The snapshot first: it never lies beside segments that it is not of.
    found.sort_by_key(|name| (name != snapshot::NAME, name.clone()));
    Ok(found)
}
