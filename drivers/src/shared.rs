//! Memory that two processes share: a `memfd`, mapped as atomic words, so that nothing either process does to it is undefined
//! in the other. Whoever starts the second process hands it the descriptor's number.
#![allow(unsafe_code)]

use std::io;
use std::ops::Deref;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Bytes of a word.
const WORD: usize = size_of::<u64>();

/// Words of memory that other processes may map too; zero at first.
pub struct SharedWords {
    fd: OwnedFd,
    start: *const AtomicU64,
    words: usize,
}

// SAFETY: the mapping belongs to the process, not to a thread, and is only seen as atomics.
unsafe impl Send for SharedWords {}
// SAFETY: as above.
unsafe impl Sync for SharedWords {}

impl SharedWords {
    /// Takes `words` words of new memory, all of it now. A process that is started inherits it.
    pub fn create(words: usize) -> io::Result<SharedWords> {
        // SAFETY: the name is a C string; the descriptor is new and ours.
        let fd = unsafe {
            let fd = libc::memfd_create(c"stipple".as_ptr(), 0);
            if fd < 0 {
                return Err(io::Error::last_os_error());
            }
            OwnedFd::from_raw_fd(fd)
        };
        // SAFETY: plain integers; the descriptor is open.
        let failed = unsafe { libc::posix_fallocate(fd.as_raw_fd(), 0, (words * WORD) as libc::off_t) };
        if failed != 0 {
            return Err(io::Error::from_raw_os_error(failed));
        }
        SharedWords::map(fd, words)
    }

    /// Maps what another process created, by the number of the inherited descriptor. Fails where that has another size.
    pub fn attach(fd: i32, words: usize) -> io::Result<SharedWords> {
        // SAFETY: a descriptor that is not open makes the calls below fail; `F_GETFD` tells before it is taken for ours.
        let fd = unsafe {
            if libc::fcntl(fd, libc::F_GETFD) < 0 {
                return Err(io::Error::last_os_error());
            }
            OwnedFd::from_raw_fd(fd)
        };
        let file = std::fs::File::from(fd);
        let (bytes, needed) = (file.metadata()?.len(), words * WORD);
        if bytes != needed as u64 {
            return Err(io::Error::other(format!("it has {bytes} bytes, not {needed}")));
        }
        SharedWords::map(file.into(), words)
    }

    fn map(fd: OwnedFd, words: usize) -> io::Result<SharedWords> {
        let access = libc::PROT_READ | libc::PROT_WRITE;
        // SAFETY: a new mapping of a file that is at least as long, at an address that the kernel chooses.
        let start = unsafe {
            libc::mmap(std::ptr::null_mut(), (words * WORD).max(1), access, libc::MAP_SHARED, fd.as_raw_fd(), 0)
        };
        if start == libc::MAP_FAILED {
            return Err(io::Error::last_os_error());
        }
        Ok(SharedWords { fd, start: start.cast(), words })
    }

    /// The descriptor's number, for a process that is started.
    pub fn number(&self) -> i32 {
        self.fd.as_raw_fd()
    }
}

impl Deref for SharedWords {
    type Target = [AtomicU64];
    fn deref(&self) -> &[AtomicU64] {
        // SAFETY: `start` is page-aligned and maps so many words until `self` is dropped; the file is never made shorter.
        unsafe { std::slice::from_raw_parts(self.start, self.words) }
    }
}

impl Drop for SharedWords {
    fn drop(&mut self) {
        // SAFETY: nobody borrows the words any more.
        unsafe {
            libc::munmap(self.start.cast_mut().cast(), (self.words * WORD).max(1));
        }
    }
}

/// Words that `bytes` bytes take.
pub const fn words_of(bytes: usize) -> usize {
    bytes.div_ceil(WORD)
}

/// Writes bytes into words; what is left of the last word is zero.
pub fn write_bytes(words: &[AtomicU64], bytes: &[u8]) {
    for (word, chunk) in words.iter().zip(bytes.chunks(WORD)) {
        let mut eight = [0; WORD];
        eight[..chunk.len()].copy_from_slice(chunk);
        word.store(u64::from_le_bytes(eight), Relaxed);
    }
}

/// Reads the bytes that `write_bytes` wrote.
pub fn read_bytes(words: &[AtomicU64], bytes: &mut [u8]) {
    for (word, chunk) in words.iter().zip(bytes.chunks_mut(WORD)) {
        let eight = word.load(Relaxed).to_le_bytes();
        chunk.copy_from_slice(&eight[..chunk.len()]);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::os::fd::IntoRawFd;

    #[test]
    fn what_one_mapping_writes_the_other_reads() {
        let one = SharedWords::create(4).unwrap();
        let wrong = SharedWords::attach(one.fd.try_clone().unwrap().into_raw_fd(), 3);
        assert!(wrong.is_err() && SharedWords::attach(-1, 4).is_err());
        let copy = one.fd.try_clone().unwrap();
        let other = SharedWords::map(copy, 4).unwrap();
        write_bytes(&one[1..], b"twenty-one bytes here");
        let mut read = [0; 21];
        read_bytes(&other[1..], &mut read);
        assert_eq!(&read, b"twenty-one bytes here");
        assert_eq!(words_of(21), 3);
    }
}
