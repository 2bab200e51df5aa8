//! What stands on the disk: the headers of segments and records, 512 bytes each, little endian.
//!
//! A header counts only where its checksum holds. A record's header names the map and the sequence number of its segment too:
//! what a recycled file still has of its former life, and a segment whose own header is damaged, are told apart by them.

/// Unit of everything on the disk, bytes: what a disk writes whole or not at all.
pub const SECTOR: usize = 512;
/// Bytes that the owner keeps in a record's header; they are read at boot.
pub const ABOUT: usize = 464;
/// What the owner keeps in a record's header.
pub type About = [u8; ABOUT];

/// Name of a record. What kind, run and id mean is the owner's.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Default)]
pub struct Key {
    pub kind: u8,
    pub run: u32,
    pub id: u32,
}

/// What a record is.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Form {
    Data,
    /// Its key was removed.
    Tombstone,
    /// Nothing follows in this segment.
    End,
    /// Its payload did not survive a power cut: nothing but its length counts.
    Void,
}

const RECORD_MAGIC: [u8; 4] = *b"StRc";
const SEGMENT_MAGIC: [u8; 8] = *b"StipSegm";
/// Version of the form on the disk, and of what the map puts into it (`map::block`).
pub const VERSION: u32 = 2;
const FORMS: [Form; 4] = [Form::Data, Form::Tombstone, Form::End, Form::Void];

/// Header of a record.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Header {
    pub form: Form,
    pub key: Key,
    pub generation: u32,
    /// Bytes of the payload, and its checksum.
    pub length: u32,
    pub payload_crc: u32,
    /// Number of the segment, and map.
    pub sequence: u64,
    pub identity: u64,
    pub about: About,
}

/// Bytes that a record takes on the disk.
pub fn size(length: usize) -> usize {
    SECTOR + length.next_multiple_of(SECTOR)
}

/// A field of a header.
fn field<const N: usize>(bytes: &[u8], at: usize) -> [u8; N] {
    bytes[at..at + N].try_into().expect("fields lie within a sector")
}

impl Header {
    /// A header without key and payload.
    pub fn bare(form: Form, sequence: u64, identity: u64) -> Header {
        let key = Key { kind: 0, run: 0, id: 0 };
        Header { form, key, generation: 0, length: 0, payload_crc: 0, sequence, identity, about: [0; ABOUT] }
    }

    /// Bytes of the whole record on the disk.
    pub fn size(&self) -> usize {
        size(self.length as usize)
    }

    pub fn encode(&self) -> [u8; SECTOR] {
        let mut out = [0; SECTOR];
        let mut at = 0;
        let mut put = |bytes: &[u8]| {
            out[at..at + bytes.len()].copy_from_slice(bytes);
            at += bytes.len();
        };
        put(&RECORD_MAGIC);
        put(&[self.form as u8, self.key.kind, 0, 0]);
        put(&self.key.run.to_le_bytes());
        put(&self.key.id.to_le_bytes());
        put(&self.generation.to_le_bytes());
        put(&self.length.to_le_bytes());
        put(&self.payload_crc.to_le_bytes());
        put(&self.sequence.to_le_bytes());
        put(&self.identity.to_le_bytes());
        put(&self.about);
        let crc = crc32c::crc32c(&out[..SECTOR - 4]);
        out[SECTOR - 4..].copy_from_slice(&crc.to_le_bytes());
        out
    }

    /// The header that a sector holds; `None` where it is none, or damaged.
    pub fn decode(sector: &[u8]) -> Option<Header> {
        if sector.len() < SECTOR || sector[..4] != RECORD_MAGIC {
            return None;
        }
        if crc32c::crc32c(&sector[..SECTOR - 4]).to_le_bytes() != sector[SECTOR - 4..SECTOR] {
            return None;
        }
        let number = |at| u32::from_le_bytes(field(sector, at));
        let form = *FORMS.iter().find(|form| **form as u8 == sector[4])?;
        let key = Key { kind: sector[5], run: number(8), id: number(12) };
        let (sequence, identity) = (u64::from_le_bytes(field(sector, 28)), u64::from_le_bytes(field(sector, 36)));
        let (generation, length, payload_crc) = (number(16), number(20), number(24));
        Some(Header { form, key, generation, length, payload_crc, sequence, identity, about: field(sector, 44) })
    }
}

/// Header of a segment. The sector holds it twice, so that no damage of a few bytes costs it.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct SegmentHeader {
    pub version: u32,
    pub identity: u64,
    /// Grows by one whenever a segment is begun or freed.
    pub sequence: u64,
    /// Nothing in the file counts: it waits for its next use.
    pub is_free: bool,
}

const COPY: usize = SECTOR / 2;

impl SegmentHeader {
    pub fn encode(&self) -> [u8; SECTOR] {
        let mut copy = [0; COPY];
        copy[..8].copy_from_slice(&SEGMENT_MAGIC);
        copy[8..12].copy_from_slice(&self.version.to_le_bytes());
        copy[12] = self.is_free.into();
        copy[16..24].copy_from_slice(&self.identity.to_le_bytes());
        copy[24..32].copy_from_slice(&self.sequence.to_le_bytes());
        let crc = crc32c::crc32c(&copy[..COPY - 4]);
        copy[COPY - 4..].copy_from_slice(&crc.to_le_bytes());
        let mut out = [0; SECTOR];
        out.chunks_exact_mut(COPY).for_each(|half| half.copy_from_slice(&copy));
        out
    }

    /// The header that a sector holds; `None` where it is none, or both copies are damaged.
    pub fn decode(sector: &[u8]) -> Option<SegmentHeader> {
        let is_whole = |copy: &&[u8]| {
            copy[..8] == SEGMENT_MAGIC && crc32c::crc32c(&copy[..COPY - 4]).to_le_bytes() == copy[COPY - 4..]
        };
        let copy = sector.chunks_exact(COPY).take(2).find(is_whole)?;
        Some(SegmentHeader {
            version: u32::from_le_bytes(field(copy, 8)),
            is_free: copy[12] != 0,
            identity: u64::from_le_bytes(field(copy, 16)),
            sequence: u64::from_le_bytes(field(copy, 24)),
        })
    }
}
