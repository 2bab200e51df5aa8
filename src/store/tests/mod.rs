//! Tests of the store: against a plain map, against damage, and against a model of a disk that loses power.
#![cfg(test)]
#![allow(clippy::unwrap_used)]

mod damage;
pub mod disk;
mod files;
mod model;
mod power;
mod snapshot;

use super::*;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Four segments more than the spare ones; records of up to 6 KiB.
pub const SMALL: Limits = Limits {
    bytes_max: 16 * (64 << 10),
    segment_bytes: 64 << 10,
    records_max: 64,
    payload_max: 6000,
    buffers: 8,
    write_bytes_per_s: 0,
};
pub const IDENTITY: u64 = 0x5717_7e1d;

pub fn key(id: u32) -> Key {
    Key { kind: 1, run: 7, id }
}

/// A header and a payload that say which record and which version they are.
pub fn content(key: Key, version: u32, length: usize) -> (About, Vec<u8>) {
    let mut about = [0; ABOUT];
    about[..4].copy_from_slice(&key.id.to_le_bytes());
    about[4..8].copy_from_slice(&version.to_le_bytes());
    about[8..12].copy_from_slice(&(length as u32).to_le_bytes());
    let seed = key.id.wrapping_mul(0x9e37_79b9) ^ version.wrapping_mul(0x85eb_ca6b);
    let byte = |i: u32| {
        let x = i.wrapping_mul(0x9e37_79b1) ^ seed;
        ((x ^ x >> 15).wrapping_mul(0x85eb_ca6b) >> 13) as u8
    };
    let payload = (0..length as u32).map(byte).collect();
    (about, payload)
}

pub fn word(about: &About, at: usize) -> u32 {
    u32::from_le_bytes(about[at..at + 4].try_into().unwrap())
}

pub fn open(folder: &Path, limits: &Limits) -> (Store, Disk) {
    Store::open(folder, IDENTITY, limits).unwrap()
}

pub fn put(store: &mut Store, key: Key, version: u32, length: usize) -> bool {
    let (about, payload) = content(key, version, length);
    store.put(key, &about, |to| to.extend_from_slice(&payload))
}

/// Fetches one payload in lockstep.
pub fn get(store: &mut Store, disk: &Disk, key: Key) -> Option<(Outcome, About, Vec<u8>)> {
    if !store.fetch(key) {
        return None;
    }
    disk.serve();
    let fetched = store.fetched().unwrap();
    assert_eq!(fetched.key, key);
    let answer = (fetched.outcome, fetched.about, fetched.payload.clone());
    store.give_back(fetched);
    Some(answer)
}

/// The version of what the store has of a key, whose payload is checked; `None` where it has nothing.
pub fn version(store: &mut Store, disk: &Disk, key: Key) -> Option<u32> {
    let (outcome, about, payload) = get(store, disk, key)?;
    if outcome == Outcome::Gone {
        return None;
    }
    assert!(matches!(outcome, Outcome::Newest | Outcome::Older), "{key:?}: {outcome:?}");
    let (version, length) = (word(&about, 4), word(&about, 8) as usize);
    assert_eq!((about, payload), content(key, version, length), "{key:?}");
    Some(version)
}

pub fn entries(store: &Store) -> BTreeMap<Key, u32> {
    let mut found = BTreeMap::new();
    store.entries(|key, about| assert!(found.insert(*key, word(about, 4)).is_none()));
    found
}

/// The segment files of a folder, by name.
pub fn files(folder: &Path) -> Vec<PathBuf> {
    let all = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
    let mut found: Vec<PathBuf> = all.filter(|p| p.extension().is_some_and(|e| e == "seg")).collect();
    found.sort();
    found
}

pub fn copy_store(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for file in files(from) {
        std::fs::copy(&file, to.join(file.file_name().unwrap())).unwrap();
    }
}
