//! What is in the folder besides: strangers, other versions and rigs, other limits, a store set aside.
#![cfg(test)]

use super::record::{SegmentHeader, SECTOR};
use super::*;
use std::fs;

fn says(result: Result<(Store, Disk), Fault>, words: &[&str]) {
    let text = result.err().unwrap().to_string();
    assert!(words.iter().all(|w| text.contains(w)) && !text.contains('\n'), "{text}");
}

#[test]
fn foreign_files_are_named_and_left_alone() {
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("notes.txt"), b"mine").unwrap();
    fs::write(dir.path().join("00000000.seg"), b"mine too").unwrap();
    fs::create_dir(dir.path().join("00000002.seg")).unwrap();
    let limits = Limits { records_max: 1000, ..SMALL };
    let (mut store, disk) = open(dir.path(), &limits);
    assert_eq!(store.warnings().len(), 3, "{:?}", store.warnings());
    assert!(store.warnings()[0].contains("left as it is"));
    for i in 0..2000 {
        assert!(put(&mut store, key(i % 50), i, 3000));
        disk.serve();
    }
    store.flush().unwrap();
    assert!(store.figures().disk_bytes + 8 <= limits.bytes_max);
    drop((store, disk));
    let (store, _disk) = open(dir.path(), &limits);
    assert_eq!(entries(&store).len(), 50);
    assert_eq!(fs::read(dir.path().join("00000000.seg")).unwrap(), b"mine too");
    assert_eq!(fs::read(dir.path().join("notes.txt")).unwrap(), b"mine");
    assert!(dir.path().join("00000002.seg").is_dir());
}

#[test]
fn other_versions_and_other_rigs_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    drop(open(dir.path(), &SMALL));
    says(Store::open(dir.path(), IDENTITY + 1, &SMALL), &["another rig", "--fresh"]);
    let file = &files(dir.path())[0];
    let mut bytes = fs::read(file).unwrap();
    let header = SegmentHeader::decode(&bytes[..SECTOR]).unwrap();
    bytes[..SECTOR].copy_from_slice(&SegmentHeader { version: 1, ..header }.encode());
    fs::write(file, bytes).unwrap();
    says(Store::open(dir.path(), IDENTITY, &SMALL), &["version 1", "--fresh"]);
    assert!(Reader::open(dir.path()).err().unwrap().to_string().contains("version 1"));
}

#[test]
fn a_second_opener_is_refused_and_a_reader_is_not() {
    let dir = tempfile::tempdir().unwrap();
    let (mut store, disk) = open(dir.path(), &SMALL);
    says(Store::open(dir.path(), IDENTITY, &SMALL), &["another run holds this store"]);
    assert!(set_aside(dir.path()).is_err());
    let mut payload = vec![];
    assert!(put(&mut store, key(1), 1, 3000));
    store.flush().unwrap();
    let mut reader = Reader::open(dir.path()).unwrap();
    assert_eq!(reader.identity(), IDENTITY);
    for i in 2..400 {
        assert!(put(&mut store, key(1 + i % 3), i, 5000));
        disk.serve();
        // Where it was has been compacted away many times since: the reader looks again.
        let about = reader.read(key(1), &mut payload).unwrap();
        assert_eq!((about, payload.clone()), content(key(1), word(&about, 4), word(&about, 8) as usize));
    }
    assert!(reader.read(key(77), &mut payload).is_err());
    drop(store);
    drop(disk);
    drop(open(dir.path(), &SMALL));
}

#[test]
fn a_folder_without_a_store_is_told_so() {
    let dir = tempfile::tempdir().unwrap();
    for place in [dir.path().join("no"), dir.path().into()] {
        let fault = Reader::open(&place).err().unwrap();
        assert_eq!(fault.kind, FaultKind::NoInput, "{fault}");
    }
    assert!(set_aside(&dir.path().join("no")).unwrap().is_none() && !dir.path().join("no").exists());
}

#[test]
fn limits_that_hold_nothing_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    for limits in [
        Limits { segment_bytes: 1000, ..SMALL },
        Limits { bytes_max: 3 * SMALL.segment_bytes, ..SMALL },
        Limits { payload_max: SMALL.segment_bytes as usize, ..SMALL },
        Limits { buffers: 0, ..SMALL },
        Limits { records_max: 0, ..SMALL },
        Limits { segment_bytes: 0, ..SMALL },
    ] {
        assert_eq!(Store::open(dir.path(), IDENTITY, &limits).err().unwrap().kind, FaultKind::Config, "{limits:?}");
    }
    let (mut store, disk) = open(dir.path(), &SMALL);
    (0..20).for_each(|id| {
        assert!(put(&mut store, key(id), 1, 3000));
        disk.serve();
    });
    store.flush().unwrap();
    drop((store, disk));
    says(Store::open(dir.path(), IDENTITY, &Limits { records_max: 9, ..SMALL }), &["more records", "raise"]);
    says(Store::open(dir.path(), IDENTITY, &Limits { payload_max: 2999, ..SMALL }), &["3000 bytes", "raise"]);
    assert_eq!(entries(&open(dir.path(), &SMALL).0).len(), 20);
}

/// With less room, or other segments, than before: what is there stays, and the store shrinks to its limit as it is written.
#[test]
fn a_store_goes_on_with_other_limits() {
    let dir = tempfile::tempdir().unwrap();
    let (mut store, disk) = open(dir.path(), &SMALL);
    for i in 0..600 {
        assert!(put(&mut store, key(i % 10), i, 5000));
        disk.serve();
    }
    store.flush().unwrap();
    drop((store, disk));
    let less = Limits { bytes_max: 8 * (64 << 10), ..SMALL };
    let other = Limits { segment_bytes: 32 << 10, ..SMALL };
    for (limits, from) in [(less, 600), (other, 1200), (SMALL, 1800)] {
        let (mut store, disk) = open(dir.path(), &limits);
        assert_eq!(entries(&store).len(), 10);
        for i in from..from + 600 {
            assert!(put(&mut store, key(i % 10), i, 5000), "{limits:?} {i} {:?}", store.figures());
            disk.serve();
        }
        store.flush().unwrap();
        let f = store.figures();
        assert!(f.disk_bytes <= limits.bytes_max && f.write_errors == 0, "{f:?}");
        (0..10).for_each(|id| assert_eq!(version(&mut store, &disk, key(id)), Some(from + 590 + id)));
    }
}

#[test]
fn one_previous_store_is_kept_and_strangers_stay_where_they_are() {
    let dir = tempfile::tempdir().unwrap();
    let (folder, aside) = (dir.path().join("map"), dir.path().join("previous-map"));
    for round in 1..=3 {
        let (mut store, _disk) = open(&folder, &SMALL);
        assert!(entries(&store).is_empty() && put(&mut store, key(1), round, 100));
        store.flush().unwrap();
        drop((store, _disk));
        fs::write(folder.join("notes"), b"mine").unwrap();
        if round == 2 {
            fs::write(aside.join("notes"), b"mine").unwrap();
        }
        assert_eq!(set_aside(&folder).unwrap(), Some(aside.clone()));
        assert!(folder.join("notes").exists() && files(&folder).is_empty());
        let mut reader = Reader::open(&aside).unwrap();
        let mut payload = vec![];
        assert_eq!(word(&reader.read(key(1), &mut payload).unwrap(), 4), round);
    }
    assert!(aside.join("notes").exists());
    // A stranger of a segment's name is in the way.
    drop(open(&folder, &SMALL));
    fs::write(aside.join("00000000.seg"), b"mine").unwrap();
    let name = files(&folder)[0].file_name().unwrap().to_owned();
    fs::write(aside.join(&name), b"mine").unwrap();
    assert!(set_aside(&folder).unwrap_err().to_string().contains("in its way"));
    assert_eq!(fs::read(aside.join(&name)).unwrap(), b"mine");
}
