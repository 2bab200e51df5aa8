//! A store that is read while a run writes it: without its lock, and without a word to the run.
//!
//! A reader has its own index, which is read anew where a record is no longer where it was.

use super::index::{Entry, Index, Place};
use super::record::{About, Form, Header, Key, SECTOR};
use super::scan::{scan, Found};
use super::segment::Folder;
use std::io;
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use stipple_drivers::{Fault, FaultKind};

/// Times that the index is read anew for one record: a writer compacts a segment in seconds.
const LOOKUPS: usize = 3;

pub struct Reader {
    path: PathBuf,
    folder: Folder,
    index: Index,
    found: Found,
}

impl Reader {
    /// Opens the store in a folder to be read. Fails where there is none, or one of another version.
    pub fn open(path: &Path) -> Result<Reader, Fault> {
        let place = path.display().to_string();
        let folder = Folder::open(path).map_err(|e| {
            let why = format!("the store's folder cannot be read: {e}");
            Fault::new(FaultKind::NoInput, &place[..], why, "name the folder of a run that kept a map")
        })?;
        let mut index = Index::growing();
        let found = scan(path, &folder, None, &mut index, None)?;
        if found.segments.iter().all(|s| s.sequence == 0) {
            let fix = "name the folder of a run that kept a map";
            return Err(Fault::new(FaultKind::NoInput, place, "there is no store in this folder", fix));
        }
        Ok(Reader { path: path.into(), folder, index, found })
    }

    pub fn identity(&self) -> u64 {
        self.found.identity
    }

    /// What was found at opening that is worth a line: foreign files, parts that cannot be read.
    pub fn warnings(&self) -> &[String] {
        &self.found.warnings
    }

    /// Stretches without a whole record that were found at opening.
    pub fn damaged(&self) -> u64 {
        self.found.damaged
    }

    /// Visits the newest generation of every record.
    pub fn entries(&self, mut visit: impl FnMut(&Key, &About)) {
        for entry in self.index.entries().iter().filter(|e| !e.is_tombstone) {
            if let Some(about) = self.index.about(entry) {
                visit(&entry.key, about);
            }
        }
    }

    pub fn about(&self, key: &Key) -> Option<About> {
        self.index.about(self.index.get(key)?).copied()
    }

    /// Reads a payload, of the generation before where the newest is damaged, and answers what is in the header of what was
    /// read. Fails where no generation is whole, or the disk does not give it.
    pub fn read(&mut self, key: Key, payload: &mut Vec<u8>) -> Result<About, Fault> {
        let fault = |reader: &Reader, kind, what: String, fix: &str| {
            let place = format!("{}: record {} {}/{}", reader.path.display(), key.kind, key.run, key.id);
            Fault::new(kind, place, what, fix)
        };
        for lookup in 0..LOOKUPS {
            if lookup > 0 {
                self.index = Index::growing();
                self.found = scan(&self.path, &self.folder, Some(self.found.identity), &mut self.index, None)?;
            }
            let Some(entry) = self.index.get(&key).filter(|e| !e.is_tombstone).copied() else {
                return Err(fault(self, FaultKind::NoInput, "it is not in the store".into(), ""));
            };
            match self.newest_whole(&entry, payload) {
                Ok(Some(about)) => return Ok(about),
                Err(e) if lookup + 1 == LOOKUPS => {
                    return Err(fault(self, FaultKind::Io, format!("it cannot be read: {e}"), "check the disk"))
                }
                _ => {}
            }
        }
        payload.clear();
        Err(fault(self, FaultKind::Data, "no generation of it is whole".into(), "go on without it"))
    }

    fn newest_whole(&self, entry: &Entry, payload: &mut Vec<u8>) -> io::Result<Option<About>> {
        let newest = self.load(entry, entry.newest, payload);
        if let (Ok(None) | Err(_), Some(previous)) = (&newest, entry.previous) {
            if let Ok(Some(about)) = self.load(entry, previous, payload) {
                return Ok(Some(about));
            }
        }
        newest
    }

    fn load(&self, entry: &Entry, place: Place, payload: &mut Vec<u8>) -> io::Result<Option<About>> {
        let segment = &self.found.segments[place.segment];
        let file = self.folder.read(segment.number)?;
        let mut sector = [0; SECTOR];
        // No longer than its file was at the scan.
        payload.resize(place.length as usize, 0);
        file.read_exact_at(&mut sector, place.offset)?;
        file.read_exact_at(payload, place.offset + SECTOR as u64)?;
        let ours = (segment.sequence, self.found.identity, entry.key, place.length, Form::Data);
        let header = Header::decode(&sector).filter(|h| (h.sequence, h.identity, h.key, h.length, h.form) == ours);
        Ok(header.filter(|h| crc32c::crc32c(payload) == h.payload_crc).map(|h| h.about))
    }
}
