//! Where records are: for each key the newest place, and the one before it while that still exists. Of fixed capacity, or
//! growing for a reader.
//!
//! A tombstone stays as long as an older record of its key is on the disk, which would come back without it: therefore the
//! index counts the records of each key.

use super::record::{About, Form, Header, Key, ABOUT};
use std::collections::HashMap;

/// A record on the disk.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Place {
    /// Index of the segment.
    pub segment: usize,
    pub offset: u64,
    /// Bytes of the payload.
    pub length: u32,
}

impl Place {
    pub fn size(&self) -> u64 {
        super::record::size(self.length as usize) as u64
    }
}

#[derive(Clone, Copy, Debug)]
pub struct Entry {
    pub key: Key,
    pub generation: u32,
    pub is_tombstone: bool,
    pub newest: Place,
    pub previous: Option<Place>,
    /// Records of this key on the disk that hold data.
    pub data_records: u32,
    /// Index of what the owner keeps in the header; `NONE` of tombstones.
    about: u32,
}

pub const NONE: u32 = u32::MAX;

/// The index has no place for a key.
#[derive(Debug)]
pub struct Full;

pub struct Index {
    places: HashMap<Key, u32>,
    entries: Vec<Entry>,
    abouts: Vec<About>,
    /// Free places of `abouts`.
    free: Vec<u32>,
    pub tombstones: usize,
    /// Keys with data, and tombstones, at most; `usize::MAX` of one that grows.
    records_max: usize,
}

impl Index {
    /// An index that allocates nothing from then on: as many tombstones as keys, and a table that never has to grow.
    pub fn fixed(records_max: usize) -> Index {
        Index {
            // The table is cleaned in place while it is at most half full.
            places: HashMap::with_capacity(4 * records_max),
            entries: Vec::with_capacity(2 * records_max),
            abouts: vec![[0; ABOUT]; records_max],
            free: (0..records_max as u32).rev().collect(),
            tombstones: 0,
            records_max,
        }
    }

    /// An index that takes whatever it is given.
    pub fn growing() -> Index {
        let (places, entries, abouts, free) = Default::default();
        Index { places, entries, abouts, free, tombstones: 0, records_max: usize::MAX }
    }

    /// Keys with data.
    pub fn records(&self) -> usize {
        self.entries.len() - self.tombstones
    }

    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    pub fn get(&self, key: &Key) -> Option<&Entry> {
        self.places.get(key).map(|at| &self.entries[*at as usize])
    }

    fn get_mut(&mut self, key: &Key) -> Option<&mut Entry> {
        self.places.get(key).map(|at| &mut self.entries[*at as usize])
    }

    pub fn about(&self, entry: &Entry) -> Option<&About> {
        self.abouts.get(entry.about as usize)
    }

    /// Keeps what the owner has in a header, where there is a place for it.
    fn set_about(&mut self, about: u32, bytes: Option<&About>) -> u32 {
        let Some(bytes) = bytes else {
            self.free.extend((about != NONE).then_some(about));
            return NONE;
        };
        if about == NONE && self.free.is_empty() && self.records_max == usize::MAX {
            self.free.push(self.abouts.len() as u32);
            self.abouts.push([0; ABOUT]);
        }
        let at = if about == NONE { self.free.pop().unwrap_or(NONE) } else { about };
        if at != NONE {
            self.abouts[at as usize] = *bytes;
        }
        at
    }

    /// Takes a record that was found or written. Of two of one generation the later counts: the other is its copy.
    pub fn insert(&mut self, header: &Header, place: Place) -> Result<(), Full> {
        let (key, is_tombstone) = (header.key, header.form == Form::Tombstone);
        let is_data = header.form == Form::Data;
        if !is_data && !is_tombstone {
            return Ok(());
        }
        let Some(at) = self.places.get(&key).copied() else {
            // A tombstone without older records says nothing: they come before it, in segment and sequence.
            if is_tombstone {
                return Ok(());
            }
            if self.entries.len() >= self.records_max.saturating_mul(2) {
                return Err(Full);
            }
            let about = self.set_about(NONE, Some(&header.about));
            self.places.insert(key, self.entries.len() as u32);
            let (generation, previous) = (header.generation, None);
            let entry = Entry { key, generation, is_tombstone, newest: place, previous, data_records: 1, about };
            self.entries.push(entry);
            return Ok(());
        };
        let mut entry = self.entries[at as usize];
        entry.data_records += u32::from(is_data);
        if header.generation >= entry.generation {
            if is_tombstone || entry.is_tombstone {
                entry.previous = None;
            } else if header.generation > entry.generation {
                entry.previous = Some(entry.newest);
            }
            self.tombstones += usize::from(is_tombstone);
            self.tombstones -= usize::from(entry.is_tombstone);
            entry.about = self.set_about(entry.about, is_data.then_some(&header.about));
            entry = Entry { generation: header.generation, is_tombstone, newest: place, ..entry };
        }
        self.entries[at as usize] = entry;
        Ok(())
    }

    /// Takes note that a record of a segment is no more; answers where the tombstone is that this made superfluous.
    pub fn forget(&mut self, key: &Key, segment: usize, is_data: bool) -> Option<Place> {
        let entry = self.get_mut(key)?;
        entry.data_records = entry.data_records.saturating_sub(is_data.into());
        entry.previous = entry.previous.filter(|p| p.segment != segment);
        let place = entry.newest;
        if !entry.is_tombstone || entry.data_records > 0 {
            return None;
        }
        let at = self.places.remove(key)? as usize;
        self.entries.swap_remove(at);
        if let Some(moved) = self.entries.get(at) {
            self.places.insert(moved.key, at as u32);
        }
        self.tombstones -= 1;
        Some(place)
    }

    /// Keys whose header is to be read again: there was no place for what the owner keeps in it when the record was met.
    pub fn without_about(&self) -> impl Iterator<Item = (Key, Place)> + '_ {
        self.entries.iter().filter(|e| e.about == NONE && !e.is_tombstone).map(|e| (e.key, e.newest))
    }

    /// Keeps what the owner has in the header of a key. Fails where there is still no place.
    pub fn complete(&mut self, key: &Key, about: &About) -> Result<(), Full> {
        let at = self.set_about(NONE, Some(about));
        let entry = self.get_mut(key).filter(|_| at != NONE).ok_or(Full)?;
        entry.about = at;
        Ok(())
    }
}
