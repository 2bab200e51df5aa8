//! Snapshots: what is read back is one that was ended, whole, of this map and this boot.
#![cfg(test)]
#![allow(clippy::unwrap_used)]

use super::{content, key, open, IDENTITY, SMALL};
use crate::store::set_aside;
use crate::store::snapshot::{bytes, Snapshot, NAME};
use crate::store::Key;
use std::path::Path;

const RECORDS: usize = 3;
const LENGTH: usize = 300;

fn opened(folder: &Path) -> Snapshot {
    Snapshot::open(folder, IDENTITY).unwrap()
}

fn made(folder: &Path) -> Snapshot {
    let mut snapshot = opened(folder);
    snapshot.make(bytes(RECORDS, RECORDS * LENGTH)).unwrap();
    snapshot
}

fn add(snapshot: &mut Snapshot, version: u32, records: usize) {
    for id in 0..records as u32 {
        let (about, payload) = content(key(id), version, LENGTH);
        assert!(snapshot.add(&key(id), version + 7, &about, &payload).unwrap());
    }
}

fn write(snapshot: &mut Snapshot, version: u32, records: usize) {
    snapshot.begin();
    add(snapshot, version, records);
    snapshot.end().unwrap();
}

/// The versions of the records that are read back, each of which is checked.
fn versions(snapshot: &Snapshot) -> Vec<(Key, u32)> {
    let mut found = vec![];
    let read = snapshot.read(|key, generation, about, payload| {
        let version = u32::from_le_bytes(about[4..8].try_into().unwrap());
        assert_eq!((*about, payload.to_vec(), generation), {
            let (about, payload) = content(key, version, LENGTH);
            (about, payload, version + 7)
        });
        found.push((key, version));
    });
    read.unwrap();
    found
}

fn all(version: u32, records: usize) -> Vec<(Key, u32)> {
    (0..records as u32).map(|id| (key(id), version)).collect()
}

#[test]
fn the_last_that_was_ended_is_read() {
    let dir = tempfile::tempdir().unwrap();
    let mut snapshot = made(dir.path());
    assert_eq!(versions(&snapshot), []);
    write(&mut snapshot, 1, 2);
    write(&mut snapshot, 2, RECORDS);
    // The process dies while it writes another.
    snapshot.begin();
    add(&mut snapshot, 3, 1);
    drop(snapshot);
    assert_eq!(versions(&opened(dir.path())), all(2, RECORDS));
    let mut snapshot = opened(dir.path());
    snapshot.clear().unwrap();
    assert_eq!(versions(&opened(dir.path())), []);
    // Of another size from here on.
    snapshot.make(bytes(1, LENGTH)).unwrap();
    write(&mut snapshot, 4, 1);
    assert_eq!(versions(&opened(dir.path())), all(4, 1));
    snapshot.begin();
    add(&mut snapshot, 5, 1);
    let (about, payload) = content(key(1), 5, LENGTH);
    assert!(!snapshot.add(&key(1), 0, &about, &payload).unwrap(), "it is full");
    assert_eq!(versions(&opened(dir.path())), all(4, 1));
}

/// The space of a file may be there after a power cut, and nothing that was written to it.
#[test]
fn a_file_of_zeros_is_an_empty_snapshot() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join(NAME), [0; 4096]).unwrap();
    assert_eq!(versions(&opened(dir.path())), []);
    write(&mut made(dir.path()), 1, RECORDS);
    assert_eq!(versions(&opened(dir.path())), all(1, RECORDS));
}

/// A store that is set aside takes its snapshot along, and a foreign file stays.
#[test]
fn a_store_that_begins_anew_has_no_snapshot() {
    let dir = tempfile::tempdir().unwrap();
    let (map, aside) = (dir.path().join("map"), dir.path().join("previous-map"));
    for version in 1..3 {
        drop(open(&map, &SMALL));
        write(&mut made(&map), version, RECORDS);
        assert_eq!(set_aside(&map).unwrap(), Some(aside.clone()));
        assert_eq!(versions(&opened(&aside)), all(version, RECORDS));
        assert!(!map.join(NAME).exists());
    }
    drop(open(&map, &SMALL));
    std::fs::write(map.join(NAME), b"my notes").unwrap();
    set_aside(&map).unwrap();
    assert_eq!(std::fs::read(map.join(NAME)).unwrap(), b"my notes");
}

#[test]
fn a_flipped_bit_or_a_cut_costs_one_snapshot_and_never_changes_one() {
    let dir = tempfile::tempdir().unwrap();
    let mut snapshot = made(dir.path());
    write(&mut snapshot, 1, RECORDS);
    write(&mut snapshot, 2, RECORDS);
    let (file, whole) = (dir.path().join(NAME), std::fs::read(dir.path().join(NAME)).unwrap());
    let mut seen = [0; 3];
    // The magic at the very start says whose file it is.
    for at in 8..whole.len() {
        let mut bytes = whole.clone();
        bytes[at] ^= 1 << (at % 8);
        std::fs::write(&file, &bytes).unwrap();
        let found = versions(&opened(dir.path()));
        let newest = found.first().map_or(0, |(_, version)| *version as usize);
        assert_eq!(found, all(newest as u32, RECORDS), "{at}");
        seen[newest] += 1;
    }
    assert!(seen[0] == 0 && seen[1] > 0 && seen[2] > 0, "{seen:?}");
    for length in (8..whole.len()).step_by(97) {
        std::fs::write(&file, &whole[..length]).unwrap();
        let found = versions(&opened(dir.path()));
        assert!(found.is_empty() || [1, 2].iter().any(|version| found == all(*version, RECORDS)), "{length}");
    }
}

#[test]
fn what_is_of_another_map_boot_or_program_is_not_read() {
    let dir = tempfile::tempdir().unwrap();
    let mut snapshot = made(dir.path());
    write(&mut snapshot, 1, RECORDS);
    assert_eq!(versions(&Snapshot::open(dir.path(), IDENTITY + 1).unwrap()), []);
    let mut other = opened(dir.path());
    other.of_another_boot();
    assert_eq!(versions(&other), []);
    for foreign in [&b"notes"[..], b"a text that is longer than a magic"] {
        std::fs::write(dir.path().join(NAME), foreign).unwrap();
        let refused = Snapshot::open(dir.path(), IDENTITY).map(|_| ()).unwrap_err();
        assert!(refused.to_string().contains("no snapshot"), "{refused}");
        assert_eq!(std::fs::read(dir.path().join(NAME)).unwrap(), foreign);
    }
}
