//! Segment files: their names, how they are made, and the walk over the headers in one.
//!
//! Names are made in place and files opened below the folder's descriptor: a writer allocates nothing.

use super::record::{Form, Header, SECTOR};
use rustix::fs::{Advice, AtFlags, FallocateFlags, Mode, OFlags};
use std::ffi::CStr;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt as _;
use std::path::Path;

/// Bytes that are read at once where a header is searched for.
pub const SCRATCH: usize = 64 << 10;
/// Digits of a segment's name.
const DIGITS: usize = 8;
const EXTENSION: &str = ".seg";
pub const NUMBER_MAX: u32 = 99_999_999;

/// The folder of a store.
pub struct Folder(File);

/// The number of a segment file of this name; `None` where it is another file.
pub fn number(name: &str) -> Option<u32> {
    let digits = name.strip_suffix(EXTENSION).filter(|d| d.len() == DIGITS)?;
    digits.bytes().all(|b| b.is_ascii_digit()).then(|| digits.parse().ok())?
}

pub fn name(number: u32) -> String {
    format!("{number:08}{EXTENSION}")
}

/// The same in place, for system calls.
fn c_name(number: u32) -> [u8; DIGITS + EXTENSION.len() + 1] {
    let mut name = *b"00000000.seg\0";
    let mut rest = number;
    for digit in name[..DIGITS].iter_mut().rev() {
        *digit = b'0' + (rest % 10) as u8;
        rest /= 10;
    }
    name
}

fn with_name<R>(number: u32, call: impl FnOnce(&CStr) -> rustix::io::Result<R>) -> io::Result<R> {
    let name = c_name(number);
    let name = CStr::from_bytes_with_nul(&name).map_err(io::Error::other)?;
    Ok(call(name)?)
}

impl Folder {
    pub fn open(path: &Path) -> io::Result<Folder> {
        File::open(path).map(Folder)
    }

    fn open_segment(&self, number: u32, flags: OFlags) -> io::Result<File> {
        let flags = flags | OFlags::CLOEXEC | OFlags::NOFOLLOW | OFlags::NONBLOCK;
        let mode = Mode::RUSR | Mode::WUSR | Mode::RGRP | Mode::ROTH;
        with_name(number, |name| rustix::fs::openat(&self.0, name, flags, mode)).map(File::from)
    }

    pub fn read(&self, number: u32) -> io::Result<File> {
        let file = self.open_segment(number, OFlags::RDONLY)?;
        // Headers are a payload apart: read ahead, each would cost the payload before it. A file system may not know of this.
        let _ = rustix::fs::fadvise(&file, 0, None, Advice::Random);
        Ok(file)
    }

    pub fn write(&self, number: u32) -> io::Result<File> {
        self.open_segment(number, OFlags::RDWR)
    }

    /// Makes a file whose space is there, and its name too, before anything is written. Where the file system cannot promise
    /// space, the file has holes, and a full disk refuses a later write.
    pub fn make(&self, number: u32, bytes: u64) -> io::Result<File> {
        let file = self.open_segment(number, OFlags::RDWR | OFlags::CREATE | OFlags::EXCL)?;
        let made = allocate(&file, bytes).and_then(|()| self.sync());
        if let Err(e) = made {
            let _ = self.remove(number);
            return Err(e);
        }
        Ok(file)
    }

    pub fn remove(&self, number: u32) -> io::Result<()> {
        with_name(number, |name| rustix::fs::unlinkat(&self.0, name, AtFlags::empty()))
    }

    /// Puts names on the disk. A file system that knows no such thing is no failure.
    pub fn sync(&self) -> io::Result<()> {
        match self.0.sync_all() {
            Err(e) if matches!(e.kind(), io::ErrorKind::InvalidInput | io::ErrorKind::Unsupported) => Ok(()),
            done => done,
        }
    }
}

/// Writes all bytes at a place of a file.
pub fn write_at(file: &File, bytes: &[u8], offset: u64) -> io::Result<()> {
    #[cfg(test)]
    super::tests::disk::note_write(file, bytes, offset)?;
    file.write_all_at(bytes, offset)
}

/// Puts what was written to a file on the disk.
pub fn sync_file(file: &File) -> io::Result<()> {
    #[cfg(test)]
    super::tests::disk::note_sync(file)?;
    file.sync_data()
}

pub fn allocate(file: &File, bytes: u64) -> io::Result<()> {
    use rustix::io::Errno;
    loop {
        match rustix::fs::fallocate(file, FallocateFlags::empty(), 0, bytes) {
            Err(Errno::INTR) => {}
            Err(Errno::OPNOTSUPP | Errno::NOSYS | Errno::INVAL) => return file.set_len(bytes),
            done => return Ok(done?),
        }
    }
}

/// A walk over the records of a segment. After a damaged header it goes on at the next one that is whole and of this segment.
pub struct Walk {
    /// Where the next header is expected: the end of the last record.
    pub at: u64,
    end: u64,
    sequence: u64,
    identity: u64,
    /// Bytes read, and places where something damaged was passed over.
    pub read: u64,
    pub damaged: u64,
    /// It came to the end marker.
    pub is_sealed: bool,
}

impl Walk {
    pub fn new(bytes: u64, sequence: u64, identity: u64) -> Walk {
        Walk { at: SECTOR as u64, end: bytes, sequence, identity, read: 0, damaged: 0, is_sealed: false }
    }

    /// The next record and where it is; `None` at the end. `scratch` is at least a sector.
    pub fn next(&mut self, file: &File, scratch: &mut [u8]) -> io::Result<Option<(u64, Header)>> {
        let (mut from, mut reach) = (self.at, SECTOR);
        while !self.is_sealed {
            let left = self.end.saturating_sub(from) as usize;
            let wanted = reach.min(left).min(scratch.len()) / SECTOR * SECTOR;
            if wanted == 0 {
                break;
            }
            file.read_exact_at(&mut scratch[..wanted], from)?;
            self.read += wanted as u64;
            for (i, sector) in scratch[..wanted].chunks_exact(SECTOR).enumerate() {
                let at = from + (i * SECTOR) as u64;
                let fits = |h: &Header| h.size() as u64 <= self.end - at;
                let is_own = |h: &Header| (h.sequence, h.identity) == (self.sequence, self.identity);
                let Some(header) = Header::decode(sector).filter(|h| is_own(h) && fits(h)) else { continue };
                self.damaged += u64::from(at != self.at);
                if header.form == Form::End {
                    self.is_sealed = true;
                    return Ok(None);
                }
                self.at = at + header.size() as u64;
                return Ok(Some((at, header)));
            }
            (from, reach) = (from + wanted as u64, SCRATCH);
        }
        Ok(None)
    }
}

/// Whether a segment was sealed: its last sector holds an end marker, so that this is known without a walk.
pub fn is_sealed(file: &File, bytes: u64, sequence: u64, identity: u64) -> io::Result<bool> {
    let mut sector = [0; SECTOR];
    let Some(at) = bytes.checked_sub(SECTOR as u64).filter(|at| *at >= SECTOR as u64 && at % SECTOR as u64 == 0) else {
        return Ok(false);
    };
    file.read_exact_at(&mut sector, at)?;
    let end = Header::decode(&sector).filter(|h| h.form == Form::End);
    Ok(end.is_some_and(|h| (h.sequence, h.identity) == (sequence, identity)))
}
