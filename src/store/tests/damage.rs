//! Damage to files: cut off anywhere, a bit flipped anywhere.
#![cfg(test)]

use super::*;
use std::fs;
use std::panic::{catch_unwind, AssertUnwindSafe};

const TINY: Limits = Limits { bytes_max: 8 * 8192, segment_bytes: 8192, payload_max: 700, records_max: 16, ..SMALL };

/// A record and where it lies: file, from, to.
struct Lies {
    key: Key,
    version: u32,
    from: usize,
    to: usize,
}

/// Three generations of a key and some others in one segment, with all that is known of them.
fn small_store(folder: &Path) -> Vec<Lies> {
    let (mut store, _disk) = open(folder, &TINY);
    let mut lies = vec![];
    let mut at = 512;
    for (id, version, length) in [(1, 1, 600), (2, 1, 100), (1, 2, 500), (3, 1, 0), (1, 3, 40), (4, 1, 300)] {
        assert!(put(&mut store, key(id), version, length));
        let to = at + 512 + length.next_multiple_of(512);
        lies.push(Lies { key: key(id), version, from: at, to });
        at = to;
        store.flush().unwrap();
    }
    lies
}

/// Opens what is there, and answers the version of each key whose payload is whole; checks payloads and the reader too.
fn versions(folder: &Path) -> BTreeMap<Key, u32> {
    let (mut store, disk) = open(folder, &TINY);
    let keys: Vec<Key> = entries(&store).into_keys().collect();
    let mut found = BTreeMap::new();
    for key in keys {
        let (outcome, about, payload) = get(&mut store, &disk, key).unwrap();
        if matches!(outcome, Outcome::Newest | Outcome::Older) {
            let (version, length) = (word(&about, 4), word(&about, 8) as usize);
            assert_eq!((about, payload), content(key, version, length));
            found.insert(key, version);
        }
    }
    found
}

/// What a reader without the lock sees, without the boot's mending.
fn read_versions(folder: &Path) -> BTreeMap<Key, u32> {
    let mut found = BTreeMap::new();
    let Ok(mut reader) = Reader::open(folder) else { return found };
    let mut keys = vec![];
    reader.entries(|key, _| keys.push(*key));
    for key in keys {
        let mut payload = vec![];
        if let Ok(about) = reader.read(key, &mut payload) {
            let (version, length) = (word(&about, 4), word(&about, 8) as usize);
            assert_eq!((about, payload), content(key, version, length));
            found.insert(key, version);
        }
    }
    found
}

/// The newest version of each key among records that are whole.
fn expected<'a>(whole: impl Iterator<Item = &'a Lies>) -> BTreeMap<Key, u32> {
    let mut found = BTreeMap::new();
    whole.for_each(|l| {
        found.insert(l.key, l.version);
    });
    found
}

fn damaged(what: &str, live: &Path, to: &Path, change: impl Fn(&mut Vec<u8>), wanted: &BTreeMap<Key, u32>) {
    let _ = fs::remove_dir_all(to);
    copy_store(live, to);
    let file = used_file(to);
    let mut bytes = fs::read(&file).unwrap();
    change(&mut bytes);
    fs::write(&file, &bytes).unwrap();
    let seen = catch_unwind(AssertUnwindSafe(|| (read_versions(to), versions(to), versions(to))));
    let (read, first, second) = seen.unwrap_or_else(|_| panic!("{what}: a panic"));
    assert_eq!((&read, &first, &second), (wanted, wanted, wanted), "{what}");
}

/// The file in which the records are.
fn used_file(folder: &Path) -> PathBuf {
    let has_records = |path: &PathBuf| fs::read(path).unwrap()[512..].iter().any(|b| *b != 0);
    files(folder).into_iter().find(has_records).unwrap()
}

#[test]
fn a_file_cut_off_anywhere_loses_what_is_beyond_the_cut() {
    let dir = tempfile::tempdir().unwrap();
    let (live, to) = (dir.path().join("live"), dir.path().join("cut"));
    let lies = small_store(&live);
    let end = lies.last().unwrap().to;
    for at in (512..end + 1030).filter(|at| at % 7 == 0 || at % 512 < 3 || at % 512 > 509) {
        let wanted = expected(lies.iter().filter(|l| l.to <= at));
        damaged(&format!("cut at {at}"), &live, &to, |bytes| bytes.truncate(at), &wanted);
    }
    // Without its header it cannot be told from a stranger's file: it is left as it is.
    for at in [1, 100, 511] {
        damaged(&format!("cut at {at}"), &live, &to, |bytes| bytes.truncate(at), &BTreeMap::new());
        assert_eq!(fs::read(used_or_short(&to, at)).unwrap().len(), at);
    }
}

fn used_or_short(folder: &Path, bytes: usize) -> PathBuf {
    files(folder).into_iter().find(|f| f.metadata().unwrap().len() == bytes as u64).unwrap()
}

#[test]
fn a_flipped_bit_loses_the_record_it_hits_and_an_older_generation_stands_in() {
    let dir = tempfile::tempdir().unwrap();
    let (live, to) = (dir.path().join("live"), dir.path().join("flipped"));
    let lies = small_store(&live);
    let end = lies.last().unwrap().to;
    for at in 0..end + 512 {
        let mask = 1 << (at % 8);
        let hit = lies.iter().find(|l| (l.from..l.to).contains(&at));
        let length = |l: &Lies| [600, 100, 500, 0, 40, 300][lies.iter().position(|x| x.from == l.from).unwrap()];
        // What fills the last sector says nothing.
        let hurts = hit.filter(|l| at < l.from + 512 + length(l) && !(l.from + 6..l.from + 6).contains(&at));
        let wanted = expected(lies.iter().filter(|l| hurts.is_none_or(|h| h.from != l.from)));
        damaged(&format!("bit {mask:#x} of byte {at}"), &live, &to, |bytes| bytes[at] ^= mask, &wanted);
    }
}

/// The newest generation of a sealed segment is damaged while the one before it is whole: it is written anew before compaction
/// frees that.
#[test]
fn an_older_generation_that_stands_in_is_kept() {
    let dir = tempfile::tempdir().unwrap();
    let (mut store, disk) = open(dir.path(), &SMALL);
    assert!(put(&mut store, key(1), 1, 3000));
    // Into other segments.
    (0..30).for_each(|i| {
        assert!(put(&mut store, key(2), i, 6000));
        disk.serve();
    });
    assert!(put(&mut store, key(1), 2, 3000));
    (0..30).for_each(|i| {
        assert!(put(&mut store, key(2), i, 6000));
        disk.serve();
    });
    store.flush().unwrap();
    let (_, needle) = content(key(1), 2, 3000);
    let mut hit = 0;
    for file in files(dir.path()) {
        let mut bytes = fs::read(&file).unwrap();
        if let Some(at) = bytes.windows(64).position(|w| *w == needle[..64]) {
            bytes[at + 10] ^= 4;
            fs::write(&file, bytes).unwrap();
            hit += 1;
        }
    }
    assert_eq!(hit, 1);
    assert_eq!(get(&mut store, &disk, key(1)).unwrap().0, Outcome::Older);
    (0..300).for_each(|i| {
        assert!(put(&mut store, key(2), i, 6000));
        disk.serve();
    });
    assert!(store.figures().segments_compacted > 5);
    let (outcome, about, _) = get(&mut store, &disk, key(1)).unwrap();
    assert_eq!((outcome, word(&about, 4)), (Outcome::Newest, 1));
    store.flush().unwrap();
    drop((store, disk));
    let (mut store, disk) = open(dir.path(), &SMALL);
    assert_eq!(version(&mut store, &disk, key(1)), Some(1));
}

/// A damaged record without an older generation goes on being named as damaged, also after compaction.
#[test]
fn a_record_with_no_whole_generation_is_said_to_be_damaged() {
    let dir = tempfile::tempdir().unwrap();
    let (mut store, disk) = open(dir.path(), &SMALL);
    assert!(put(&mut store, key(1), 1, 3000));
    store.flush().unwrap();
    let file = used_file(dir.path());
    let mut bytes = fs::read(&file).unwrap();
    bytes[1100] ^= 1;
    fs::write(&file, bytes).unwrap();
    for i in 0..400 {
        assert!(put(&mut store, key(2), i, 6000));
        disk.serve();
    }
    assert!(store.figures().segments_compacted > 10);
    let (outcome, about, payload) = get(&mut store, &disk, key(1)).unwrap();
    assert!(outcome == Outcome::Damaged && word(&about, 4) == 1 && payload.is_empty());
    assert!(put(&mut store, key(1), 2, 3000));
    assert_eq!(version(&mut store, &disk, key(1)), Some(2));
}
