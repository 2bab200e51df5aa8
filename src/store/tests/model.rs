//! The store against a plain map: random puts, removals, reopening, and compaction.
#![cfg(test)]

use super::*;
use proptest::collection::vec;
use proptest::prelude::*;

#[derive(Clone, Debug)]
enum Do {
    Put { id: u32, length: usize },
    Remove { id: u32 },
    Read { id: u32 },
    Serve,
    Flush,
    Reopen,
}

fn action() -> impl Strategy<Value = Do> {
    let id = || 0u32..48;
    prop_oneof![
        20 => (id(), 0usize..6000).prop_map(|(id, length)| Do::Put { id, length }),
        4 => id().prop_map(|id| Do::Remove { id }),
        4 => id().prop_map(|id| Do::Read { id }),
        8 => Just(Do::Serve),
        2 => Just(Do::Flush),
        1 => Just(Do::Reopen),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]

    #[test]
    fn the_store_holds_what_a_map_holds(actions in vec(action(), 200..900)) {
        let dir = tempfile::tempdir().unwrap();
        let (mut store, mut disk) = open(dir.path(), &SMALL);
        let (mut model, mut next) = (BTreeMap::new(), 0u32);
        for action in actions {
            match action {
                Do::Put { id, length } => {
                    next += 1;
                    if put(&mut store, key(id), next, length) {
                        model.insert(key(id), next);
                    }
                }
                Do::Remove { id } => {
                    if store.remove(key(id)) {
                        prop_assert!(model.remove(&key(id)).is_some());
                    }
                }
                Do::Read { id } => {
                    if store.figures().refused_no_buffer == 0 {
                        disk.serve();
                    }
                    disk.serve();
                    prop_assert_eq!(version(&mut store, &disk, key(id)), model.get(&key(id)).copied());
                }
                Do::Serve => disk.serve(),
                Do::Flush => store.flush().unwrap(),
                Do::Reopen => {
                    store.flush().unwrap();
                    drop((store, disk));
                    (store, disk) = open(dir.path(), &SMALL);
                    prop_assert_eq!(&entries(&store), &model);
                }
            }
            let f = store.figures();
            prop_assert!(f.disk_bytes <= SMALL.bytes_max, "{:?}", f);
            prop_assert!(f.write_errors == 0 && f.records_damaged == 0, "{:?}", f);
        }
        store.flush().unwrap();
        prop_assert_eq!(&entries(&store), &model);
        for (key, wanted) in &model {
            prop_assert_eq!(version(&mut store, &disk, *key), Some(*wanted));
        }
        drop((store, disk));
        let mut reader = Reader::open(dir.path()).unwrap();
        let mut read = BTreeMap::new();
        reader.entries(|key, about| { read.insert(*key, word(about, 4)); });
        prop_assert_eq!(&read, &model);
        for (key, wanted) in &model {
            let mut payload = vec![];
            let about = reader.read(*key, &mut payload).unwrap();
            prop_assert_eq!((about, payload), content(*key, *wanted, word(&about, 8) as usize));
        }
    }
}

/// Fills a store with keys until it takes no more, and answers how many there are.
fn fill(store: &mut Store, disk: &Disk, length: usize) -> u32 {
    let mut n = 0;
    while store.has_room() && put(store, key(n), 1, length) {
        disk.serve();
        n += 1;
    }
    n
}

/// Pseudo-random numbers.
fn random(seed: &mut u64) -> u32 {
    *seed ^= *seed << 13;
    *seed ^= *seed >> 7;
    *seed ^= *seed << 17;
    (*seed >> 16) as u32
}

/// At 90 % of the keys that a store takes, generations grow for long: with every key as likely as another, where few are
/// written often, and in turn.
#[test]
fn at_most_twice_is_written_what_was_put_whatever_grows() {
    let limits = Limits { records_max: 1000, ..SMALL };
    for (name, pick) in [("even", 0), ("hot", 1), ("in turn", 2)] {
        let dir = tempfile::tempdir().unwrap();
        let (mut store, disk) = open(dir.path(), &limits);
        let keys = fill(&mut store, &disk, 4000) * 9 / 10;
        let mut seed = 88172645463325252;
        for i in 0..40 * keys {
            let r = random(&mut seed);
            let id = match pick {
                0 => r % keys,
                1 if r % 10 > 0 => random(&mut seed) % (keys / 10),
                1 => random(&mut seed) % keys,
                _ => i % keys,
            };
            assert!(put(&mut store, key(id), i + 2, 3000 + (r >> 8) as usize % 2000), "{i}: {:?}", store.figures());
            disk.serve();
        }
        let f = store.figures();
        let amplification = f.written_bytes as f64 / f.put_bytes as f64;
        println!("{name}: {keys} keys, amplification {amplification:.3}, {} compacted", f.segments_compacted);
        // The files that wait for their first use have a header each.
        assert!(f.written_bytes <= 2 * f.put_bytes + 16 * 512 && f.segments_compacted > 20, "{name}: {f:?}");
        assert!(f.refused_full == 0 && f.disk_bytes <= limits.bytes_max, "{name}: {f:?}");
    }
}

#[test]
fn a_full_store_refuses_new_keys_and_takes_new_generations() {
    let dir = tempfile::tempdir().unwrap();
    let (mut store, disk) = open(dir.path(), &Limits { records_max: 1000, ..SMALL });
    let keys = fill(&mut store, &disk, 5000);
    let refused = store.figures().refused_full;
    assert!(!put(&mut store, key(keys), 1, 6000) && store.figures().refused_full == refused + 1);
    for i in 0..5 * keys {
        assert!(put(&mut store, key(i % keys), i + 2, 5000), "{i}: {:?}", store.figures());
        disk.serve();
    }
    // What is removed makes room.
    (0..keys / 2).for_each(|id| {
        assert!(store.remove(key(id)));
        disk.serve();
    });
    assert!(store.has_room() && put(&mut store, key(keys), 1, 6000));
    store.flush().unwrap();
    assert_eq!(entries(&store).len() as u32, keys - keys / 2 + 1);
}

#[test]
fn the_index_full_refuses_new_keys_alone() {
    let dir = tempfile::tempdir().unwrap();
    let (mut store, disk) = open(dir.path(), &Limits { records_max: 5, ..SMALL });
    for round in 0..200 {
        for id in 0..5 {
            assert!(put(&mut store, key(100 * (round % 3) + id), round, 10), "{round} {:?}", store.figures());
            disk.serve();
        }
        assert!(!store.has_room() && !put(&mut store, key(9999), 1, 10));
        for id in 0..5 {
            assert!(store.remove(key(100 * (round % 3) + id)), "{round} {:?}", store.figures());
            disk.serve();
        }
    }
    assert_eq!(store.figures().records, 0);
}

#[test]
fn what_is_put_is_fetched_before_it_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let (mut store, disk) = open(dir.path(), &SMALL);
    assert!(!store.fetch(key(1)) && !store.remove(key(1)));
    assert!(put(&mut store, key(1), 1, 100) && put(&mut store, key(1), 2, 200) && store.fetch(key(1)));
    disk.serve();
    let fetched = store.fetched().unwrap();
    assert_eq!((fetched.outcome, word(&fetched.about, 4)), (Outcome::Newest, 2));
    store.give_back(fetched);
    assert!(store.remove(key(1)) && !store.fetch(key(1)));
}

#[test]
fn full_buffers_refuse_and_are_counted() {
    let dir = tempfile::tempdir().unwrap();
    let (mut store, disk) = open(dir.path(), &SMALL);
    (0..8).for_each(|id| assert!(put(&mut store, key(id), 1, 10)));
    assert!(!store.has_room() && !put(&mut store, key(9), 1, 10) && !store.fetch(key(1)) && !store.remove(key(1)));
    disk.serve();
    assert!(store.has_room() && store.figures().refused_no_buffer == 2);
    assert!(!put(&mut store, key(9), 1, 6001) && store.figures().refused_too_long == 1);
    assert!(put(&mut store, key(9), 1, 6000));
}
