//! A disk that loses power: of what was written and not synced, any sectors are there and any are not. And calls that fail.
#![cfg(test)]

use super::disk::{noted, Log, Op};
use super::*;
use proptest::prelude::*;
use std::collections::HashMap;
use std::fs;
use std::os::unix::fs::MetadataExt as _;

/// For each key, which of its versions was flushed last.
type Flushed = BTreeMap<Key, usize>;

/// What the owner knew at a moment: number of calls to the disk until then, and what it had flushed.
struct Moment {
    ops: usize,
    flushed: Flushed,
}

fn ops() -> usize {
    disk::LOG.with_borrow(|log| log.as_ref().map_or(0, |l| l.ops.len()))
}

/// Writes for a while, and notes what is known to be on the disk. A version of 0 is a removal.
fn work(folder: &Path, rounds: u32, seed: &mut u64) -> (Vec<Moment>, BTreeMap<Key, Vec<u32>>) {
    let (mut store, disk) = open(folder, &SMALL);
    let (mut moments, mut all) = (vec![], BTreeMap::<Key, Vec<u32>>::new());
    let mut random = || {
        *seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (*seed >> 33) as u32
    };
    for version in 1..=rounds {
        let id = key(random() % 24);
        if random() % 8 == 0 {
            if store.remove(id) {
                all.entry(id).or_default().push(0);
            }
        } else if put(&mut store, id, version, (random() % 6000) as usize) {
            all.entry(id).or_default().push(version);
        }
        if random() % 3 == 0 {
            disk.serve();
        }
        if random() % 12 == 0 {
            store.flush().unwrap();
            let flushed = all.iter().map(|(key, versions)| (*key, versions.len() - 1)).collect();
            moments.push(Moment { ops: ops(), flushed });
        }
    }
    (moments, all)
}

/// The files as a power cut after so many calls leaves them.
fn cut(from: &Path, to: &Path, log: &Log, at: usize, seed: &mut u64) {
    fs::create_dir_all(to).unwrap();
    let mut durable: HashMap<u64, Vec<u8>> = HashMap::new();
    let mut pending: HashMap<u64, Vec<(u64, Vec<u8>)>> = HashMap::new();
    let apply = |image: &mut Vec<u8>, offset: u64, bytes: &[u8]| {
        let end = offset as usize + bytes.len();
        image.resize(image.len().max(end).max(SMALL.segment_bytes as usize), 0);
        image[offset as usize..end].copy_from_slice(bytes);
    };
    for op in &log.ops[..at] {
        match op {
            Op::Write { inode, offset, bytes } => {
                let sectors = bytes.chunks(512).enumerate().map(|(i, s)| (offset + 512 * i as u64, s.to_vec()));
                pending.entry(*inode).or_default().extend(sectors);
            }
            Op::Sync { inode } => {
                let image = durable.entry(*inode).or_default();
                pending.remove(inode).into_iter().flatten().for_each(|(offset, bytes)| apply(image, offset, &bytes));
            }
        }
    }
    for (inode, sectors) in pending {
        let image = durable.entry(inode).or_default();
        // From nearly nothing to nearly everything.
        *seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1);
        let share = (*seed >> 60) as u32;
        for (offset, bytes) in sectors {
            *seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            if (*seed >> 33) as u32 % 15 < share {
                apply(image, offset, &bytes);
            }
        }
    }
    for file in files(from) {
        if let Some(image) = durable.get(&file.metadata().unwrap().ino()) {
            let mut image = image.clone();
            image.resize(SMALL.segment_bytes as usize, 0);
            fs::write(to.join(file.file_name().unwrap()), image).unwrap();
        }
    }
}

/// What is there after the cut is what was flushed, or was put after it.
fn judge(folder: &Path, flushed: &Flushed, all: &BTreeMap<Key, Vec<u32>>) {
    let (mut store, disk) = open(folder, &SMALL);
    for (key, versions) in all {
        let found = version(&mut store, &disk, *key).unwrap_or(0);
        let last = flushed.get(key).copied();
        let is_new = versions[last.unwrap_or(0)..].contains(&found) || (last.is_none() && found == 0);
        assert!(is_new, "{key:?}: {found} is there, flushed was number {last:?} of {versions:?}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]

    #[test]
    fn what_was_flushed_outlives_a_power_cut(seed in any::<u64>(), cuts in proptest::collection::vec(any::<u64>(), 12)) {
        let dir = tempfile::tempdir().unwrap();
        let (live, mut seed) = (dir.path().join("live"), seed);
        let ((moments, all), log) = noted(Log::default(), || work(&live, 600, &mut seed));
        for (i, mut cut_seed) in cuts.into_iter().enumerate() {
            let at = (cut_seed % (log.ops.len() as u64 + 1)) as usize;
            let none = Flushed::new();
            let flushed = moments.iter().rev().find(|m| m.ops <= at).map_or(&none, |m| &m.flushed);
            let to = dir.path().join(format!("cut-{i}"));
            cut(&live, &to, &log, at, &mut cut_seed);
            judge(&to, flushed, &all);
            // Once more: what was mended stays so, and what is written then survives as well.
            judge(&to, flushed, &all);
        }
    }
}

/// What a failed sync left is written anew, and the owner's flush says so until it is.
#[test]
fn a_sync_that_fails_is_made_good() {
    for before in 0..30 {
        let dir = tempfile::tempdir().unwrap();
        let plan = Log { fail_syncs: Some((before, 1)), ..Log::default() };
        let (written, _) = noted(plan, || {
            let Ok((mut store, disk)) = Store::open(dir.path(), IDENTITY, &SMALL) else { return None };
            let mut failed = 0;
            for i in 0..120 {
                assert!(put(&mut store, key(i % 20), i, 4000));
                if i % 10 == 0 {
                    failed += u32::from(store.flush().is_err());
                }
                disk.serve();
                disk.0.writer().forget_pause();
                disk.serve();
            }
            store.flush().unwrap();
            assert!(store.figures().write_errors == 1 && failed <= 1, "{before}: {:?}", store.figures());
            assert!(store.figures().first_error.len() > 5);
            Some(entries(&store))
        });
        let Some(written) = written else { continue };
        let (mut store, disk) = open(dir.path(), &SMALL);
        assert_eq!(entries(&store), written);
        (0..20).for_each(|id| assert_eq!(version(&mut store, &disk, key(id)), Some(100 + id)));
    }
}

/// A disk that is full for a while: nothing that was taken is lost, and it goes on when there is room.
#[test]
fn a_write_that_fails_is_tried_again() {
    let dir = tempfile::tempdir().unwrap();
    let (mut store, disk) = open(dir.path(), &SMALL);
    assert!(put(&mut store, key(1), 1, 5000));
    store.flush().unwrap();
    let plan = Log { fail_writes: Some((0, 5)), ..Log::default() };
    noted(plan, || {
        assert!(put(&mut store, key(1), 2, 5000) && put(&mut store, key(2), 2, 5000));
        for _ in 0..5 {
            assert!(store.flush().is_err());
            // What was there is there.
            assert_eq!(entries(&store), BTreeMap::from([(key(1), 1)]));
        }
        store.flush().unwrap();
    });
    let f = store.figures();
    assert!(f.write_errors == 5 && String::from_utf8_lossy(&f.first_error).contains("No space left"), "{f:?}");
    assert_eq!(entries(&store), BTreeMap::from([(key(1), 2), (key(2), 2)]));
    drop((store, disk));
    let (mut store, disk) = open(dir.path(), &SMALL);
    assert_eq!([1, 2].map(|id| version(&mut store, &disk, key(id))), [Some(2); 2]);
}
