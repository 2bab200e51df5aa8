//! Records as they are at one instant, for an owner whose process may die: a file of fixed size, each of whose halves is written
//! anew in turn.
//!
//! A store has each record as it was when it was last put. A snapshot has all that have changed since, of one age, and is
//! written often: the kernel writes it to the disk about each half a minute, and what was overwritten by then never. It is not
//! synced and survives the process alone: after a boot it is not read.
//!
//! Each record has the generation that the store had of it: where the store has a later one, that is newer.

use super::record::{About, Key, ABOUT, SECTOR};
use rustix::fs::OFlags;
use std::fs::{File, OpenOptions};
use std::io::{self, Read as _};
use std::os::unix::fs::{FileExt as _, OpenOptionsExt as _};
use std::path::Path;

/// Its file in the store's folder.
pub const NAME: &str = "latest";
/// The first bytes of both halves.
pub const MAGIC: [u8; 8] = *b"StipLast";
/// What precedes a payload: key, generation, length and what the owner keeps of it.
const ENTRY: usize = 17 + ABOUT;
/// Characters that name a boot.
const BOOT: usize = 36;
/// Where the checksum of a half's first sector lies.
const HEAD_CRC: usize = SECTOR - 4;

/// What a half holds, in its first sector.
#[derive(Clone, Copy, PartialEq, Debug)]
struct Head {
    identity: u64,
    sequence: u64,
    /// Bytes of entries, and their CRC32C.
    bytes: u64,
    crc: u32,
    /// The boot in which it was written.
    boot: [u8; BOOT],
}

/// A snapshot's file, and the half that is written.
pub struct Snapshot {
    file: File,
    /// Bytes of a half.
    half: u64,
    head: Head,
    /// The sequence number of the last that was ended.
    ended: u64,
}

/// Bytes of a snapshot of so many records with so many bytes of payloads in all.
pub fn bytes(records: usize, payloads: usize) -> u64 {
    (SECTOR + records * ENTRY + payloads).next_multiple_of(SECTOR) as u64
}

impl Snapshot {
    /// Opens or makes the snapshot of a map of `identity` in a store's folder. Fails where its file is another's or cannot be
    /// written.
    pub fn open(folder: &Path, identity: u64) -> io::Result<Snapshot> {
        let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits() as i32;
        let mut options = OpenOptions::new();
        options.read(true).write(true).create(true).truncate(false).mode(0o644).custom_flags(flags);
        let mut file = options.open(folder.join(NAME))?;
        let mut magic = MAGIC;
        let about = file.metadata()?;
        // Of a file that a power cut left without its content, there are zeros.
        let mut is_known = || file.read_exact(&mut magic).is_ok() && [MAGIC, [0; 8]].contains(&magic);
        let is_ours = about.is_file() && (about.len() == 0 || is_known());
        if !is_ours {
            return Err(io::Error::new(io::ErrorKind::AlreadyExists, "it is no snapshot of a map"));
        }
        let boot = std::fs::read("/proc/sys/kernel/random/boot_id")?;
        let boot = boot.trim_ascii().try_into().map_err(|_| io::Error::other("the kernel does not name its boot"))?;
        let half = file.metadata()?.len() / 2;
        Ok(Snapshot { file, half, head: Head { identity, sequence: 0, bytes: 0, crc: 0, boot }, ended: 0 })
    }

    /// Visits the records of the newest whole half, with the generations that the store had of them, if it is of this map and this
    /// boot. Allocates.
    pub fn read(&self, mut visit: impl FnMut(Key, u32, &About, &[u8])) -> io::Result<()> {
        let mut newest: Option<(Head, Vec<u8>)> = None;
        for at in [0, self.half] {
            let mut sector = [0; SECTOR];
            if self.file.read_exact_at(&mut sector, at).is_err() {
                continue;
            }
            let ours = |h: &Head| (h.identity, h.boot) == (self.head.identity, self.head.boot);
            let Some(head) = Head::decode(&sector).filter(ours) else { continue };
            let is_older = newest.as_ref().is_some_and(|(other, _)| other.sequence > head.sequence);
            if is_older || head.bytes > self.half.saturating_sub(SECTOR as u64) {
                continue;
            }
            let mut entries = vec![0; head.bytes as usize];
            self.file.read_exact_at(&mut entries, at + SECTOR as u64)?;
            if crc32c::crc32c(&entries) == head.crc {
                newest = Some((head, entries));
            }
        }
        let Some((_, entries)) = newest else { return Ok(()) };
        let mut rest = &entries[..];
        while let Some((entry, after)) = rest.split_first_chunk::<ENTRY>() {
            let u32_at = |at: usize| u32::from_le_bytes(std::array::from_fn(|i| entry[at + i]));
            let about = std::array::from_fn(|i| entry[17 + i]);
            let Some((payload, after)) = after.split_at_checked(u32_at(13) as usize) else { break };
            visit(Key { kind: entry[0], run: u32_at(1), id: u32_at(5) }, u32_at(9), &about, payload);
            rest = after;
        }
        Ok(())
    }

    /// Makes the file new, empty and with halves of so many bytes, whose space is taken; of none where there is too little.
    pub fn make(&mut self, half: u64) -> io::Result<()> {
        self.file.set_len(0)?;
        self.half = half;
        if half == 0 {
            return Ok(());
        }
        super::segment::allocate(&self.file, 2 * half).and_then(|()| self.clear()).inspect_err(|_| {
            let _ = self.file.set_len(0);
        })
    }

    /// Whether there is room for anything.
    pub fn has_room(&self) -> bool {
        self.half > 0
    }

    /// Forgets what is there: all of it is in the store. The older half goes first.
    pub fn clear(&mut self) -> io::Result<()> {
        let mut none = [0; SECTOR];
        none[..MAGIC.len()].copy_from_slice(&MAGIC);
        self.file.write_all_at(&none, self.half - self.start())?;
        self.file.write_all_at(&none, self.start())
    }

    /// Begins another; the one before it stays until this one is ended.
    pub fn begin(&mut self) {
        (self.head.sequence, self.head.bytes, self.head.crc) = (self.ended + 1, 0, 0);
    }

    /// Adds a record of which the store has a generation; false where it does not fit.
    pub fn add(&mut self, key: &Key, generation: u32, about: &About, payload: &[u8]) -> io::Result<bool> {
        let mut entry = [0; ENTRY];
        entry[0] = key.kind;
        for (at, number) in [(1, key.run), (5, key.id), (9, generation), (13, payload.len() as u32)] {
            entry[at..at + 4].copy_from_slice(&number.to_le_bytes());
        }
        entry[17..].copy_from_slice(about);
        let more = (ENTRY + payload.len()) as u64;
        if SECTOR as u64 + self.head.bytes + more > self.half {
            return Ok(false);
        }
        let at = self.start() + SECTOR as u64 + self.head.bytes;
        self.file.write_all_at(&entry, at)?;
        self.file.write_all_at(payload, at + ENTRY as u64)?;
        self.head.crc = crc32c::crc32c_append(crc32c::crc32c_append(self.head.crc, &entry), payload);
        self.head.bytes += more;
        Ok(true)
    }

    /// Ends what was begun: from here on it is what `read` answers. Its bytes.
    pub fn end(&mut self) -> io::Result<u64> {
        self.file.write_all_at(&self.head.encode(), self.start())?;
        self.ended = self.head.sequence;
        Ok(self.head.bytes)
    }

    #[cfg(test)]
    pub fn of_another_boot(&mut self) {
        self.head.boot[0] ^= 1;
    }

    /// Where the half that is written begins.
    fn start(&self) -> u64 {
        self.head.sequence % 2 * self.half
    }
}

impl Head {
    fn encode(&self) -> [u8; SECTOR] {
        let mut sector = [0; SECTOR];
        sector[..8].copy_from_slice(&MAGIC);
        for (at, number) in [(8, self.identity), (16, self.sequence), (24, self.bytes)] {
            sector[at..at + 8].copy_from_slice(&number.to_le_bytes());
        }
        sector[32..36].copy_from_slice(&self.crc.to_le_bytes());
        sector[36..36 + BOOT].copy_from_slice(&self.boot);
        let crc = crc32c::crc32c(&sector[..HEAD_CRC]);
        sector[HEAD_CRC..].copy_from_slice(&crc.to_le_bytes());
        sector
    }

    fn decode(sector: &[u8; SECTOR]) -> Option<Head> {
        let u64_at = |at: usize| u64::from_le_bytes(std::array::from_fn(|i| sector[at + i]));
        let u32_at = |at: usize| u32::from_le_bytes(std::array::from_fn(|i| sector[at + i]));
        if sector[..8] != MAGIC || crc32c::crc32c(&sector[..HEAD_CRC]) != u32_at(HEAD_CRC) {
            return None;
        }
        let boot = std::array::from_fn(|i| sector[36 + i]);
        Some(Head { identity: u64_at(8), sequence: u64_at(16), bytes: u64_at(24), crc: u32_at(32), boot })
    }
}
