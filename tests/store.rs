//! The record store of a map on real files: killed at any moment, on disks that are full or read-only, of two gigabytes, and
//! on threads of its own without an allocation.
#![allow(clippy::unwrap_used)]

#[path = "program/small_disk.rs"]
mod small_disk;

use small_disk::on_a_small_disk;
use std::collections::BTreeMap;
use std::fs;
use std::io::{BufRead, BufReader, Write as _};
use std::os::unix::fs::FileExt as _;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use stipple::mem::{heap_after_seal, seal_thread, CountingAllocator};
use stipple::store::{About, Disk, Key, Limits, Outcome, Reader, Store, ABOUT};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

const LIMITS: Limits = Limits {
    bytes_max: 24 << 20,
    segment_bytes: 1 << 20,
    records_max: 500,
    payload_max: 40_000,
    buffers: 8,
    write_bytes_per_s: 0,
};
const IDENTITY: u64 = 1;
const CHILD: &str = "STIPPLE_TEST_STORE";

fn key(id: u32) -> Key {
    Key { kind: 2, run: 1, id }
}

fn about(version: u32) -> About {
    let mut about = [0; ABOUT];
    about[..4].copy_from_slice(&version.to_le_bytes());
    about
}

fn version_of(about: &About) -> u32 {
    u32::from_le_bytes(about[..4].try_into().unwrap())
}

/// Puts a record whose payload repeats its version.
fn put(store: &mut Store, id: u32, version: u32, length: usize) -> bool {
    store.put(key(id), &about(version), |to| to.resize(length, version as u8))
}

/// Both threads of a store, until it is dropped.
fn threads(disk: &Disk) -> [std::thread::JoinHandle<()>; 2] {
    let (writer, reader) = (disk.clone(), disk.clone());
    [std::thread::spawn(move || writer.write_loop()), std::thread::spawn(move || reader.read_loop())]
}

/// Writes without an end, and prints each generation that is flushed; the parent kills it.
fn write_until_killed(folder: &Path) {
    let (mut store, disk) = Store::open(folder, IDENTITY, &LIMITS).unwrap();
    let _threads = threads(&disk);
    let mut next = 0;
    store.entries(|_, about| next = next.max(version_of(about)));
    let mut out = std::io::stdout();
    loop {
        let mut batch = vec![];
        while batch.len() < 20 {
            next += 1;
            let id = next % 60;
            if put(&mut store, id, next, 1000 + (next as usize * 7919) % 39_000) {
                batch.push((id, next));
            } else {
                std::thread::sleep(Duration::from_micros(200));
            }
        }
        store.flush().unwrap();
        batch.iter().for_each(|(id, version)| writeln!(out, "flushed {id} {version}").unwrap());
        out.flush().unwrap();
    }
}

#[test]
fn what_was_flushed_outlives_a_kill() {
    if let Some(folder) = std::env::var_os(CHILD) {
        write_until_killed(folder.as_ref());
    }
    let dir = tempfile::tempdir().unwrap();
    let mut flushed = BTreeMap::<u32, u32>::new();
    for round in 0..50u64 {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "what_was_flushed_outlives_a_kill", "--nocapture"])
            .env(CHILD, dir.path())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines().map_while(Result::ok);
        let mut heard = lines.filter(|l| l.starts_with("flushed "));
        let first = heard.next().unwrap();
        // Moments that do not follow the pattern of writing.
        std::thread::sleep(Duration::from_micros(round * 7321 % 60_000));
        child.kill().unwrap();
        for line in std::iter::once(first).chain(heard) {
            let numbers: Vec<u32> = line.split(' ').skip(1).filter_map(|n| n.parse().ok()).collect();
            if let [id, version] = numbers[..] {
                flushed.insert(id, version);
            }
        }
        child.wait().unwrap();
        let mut reader = Reader::open(dir.path()).unwrap();
        let (mut store, disk) = Store::open(dir.path(), IDENTITY, &LIMITS).unwrap();
        assert!(store.warnings().is_empty(), "{:?}", store.warnings());
        for (id, version) in &flushed {
            assert!(store.fetch(key(*id)));
            disk.serve();
            let fetched = store.fetched().unwrap();
            let found = version_of(&fetched.about);
            assert!(fetched.outcome == Outcome::Newest && found >= *version, "{id}: {found} after {version}");
            assert!(fetched.payload.iter().all(|b| *b == found as u8));
            store.give_back(fetched);
            let mut payload = vec![];
            assert!(version_of(&reader.read(key(*id), &mut payload).unwrap()) >= *version);
        }
        assert!(store.figures().disk_bytes <= LIMITS.bytes_max);
    }
    assert!(flushed.len() == 60 && flushed.values().max() > Some(&1000), "{flushed:?}");
}

#[test]
fn nothing_is_allocated_after_opening() {
    let dir = tempfile::tempdir().unwrap();
    let (mut store, disk) = Store::open(dir.path(), IDENTITY, &LIMITS).unwrap();
    let sealed = |body: fn(&Disk)| {
        let disk = disk.clone();
        std::thread::spawn(move || {
            seal_thread();
            body(&disk);
        })
    };
    let threads = [sealed(Disk::write_loop), sealed(Disk::read_loop)];
    let owner = std::thread::spawn(move || {
        seal_thread();
        let (mut fetches, mut reads) = (0, 0);
        for i in 1..6000u32 {
            let start = Instant::now();
            while !put(&mut store, i % 200, i, 20_000) {
                assert!(start.elapsed() < Duration::from_secs(20), "{i}: {:?}", store.figures());
                std::thread::sleep(Duration::from_micros(100));
            }
            if i % 5 == 0 {
                store.remove(key(i % 200));
            }
            fetches += u32::from(i % 3 == 0 && store.fetch(key(i * 7 % 200)));
            while let Some(fetched) = store.fetched() {
                reads += 1;
                store.give_back(fetched);
            }
            assert!(store.has_room() || i > 0);
        }
        store.flush().unwrap();
        let f = store.figures();
        assert!(f.segments_compacted > 20 && fetches > 100 && reads > 100 && f.write_errors == 0, "{f:?}");
    });
    owner.join().unwrap();
    threads.into_iter().for_each(|t| t.join().unwrap());
    assert_eq!(heap_after_seal(), 0);
}

#[test]
fn opening_takes_the_memory_that_was_stated() {
    let dir = tempfile::tempdir().unwrap();
    let mut taken = stipple::mem::Footprint::default();
    let _store = taken.build("store", || Store::open(dir.path(), IDENTITY, &LIMITS).unwrap());
    let (stated, taken) = (Store::footprint(&LIMITS).total(), taken.total());
    assert!(taken <= stated + 8192, "{taken} of {stated} bytes");
}

/// The pace is that of the limits, and a flush does not wait for it.
#[test]
fn the_writer_keeps_its_pace() {
    let dir = tempfile::tempdir().unwrap();
    let limits = Limits { write_bytes_per_s: 400_000, ..LIMITS };
    let (mut store, disk) = Store::open(dir.path(), IDENTITY, &limits).unwrap();
    let _threads = threads(&disk);
    let start = Instant::now();
    while start.elapsed() < Duration::from_secs(2) {
        put(&mut store, 1, 1, 20_000);
        std::thread::sleep(Duration::from_millis(1));
    }
    let (written, elapsed) = (store.figures().written_bytes as f64, start.elapsed().as_secs_f64());
    assert!((200_000.0..500_000.0).contains(&(written / elapsed)), "{written} bytes in {elapsed} s");
    store.flush().unwrap();
    assert!(store.figures().refused_no_buffer > 10);
}

/// Two gibibytes of records of 100 kB, whose payloads are holes: headers alone are read.
#[test]
fn two_gibibytes_open_within_two_seconds() {
    let dir = tempfile::tempdir().unwrap();
    let segment = 16 << 20;
    let limits = Limits {
        bytes_max: 128 * segment,
        segment_bytes: segment,
        records_max: 40_000,
        payload_max: 200_000,
        buffers: 4,
        write_bytes_per_s: 0,
    };
    // One segment, written by the store itself, is the pattern of all.
    let small = Limits { bytes_max: 12 * segment, ..limits };
    let (mut store, disk) = Store::open(dir.path(), IDENTITY, &small).unwrap();
    for id in 0..330u32 {
        assert!(put(&mut store, id, 1, 100_000), "{:?}", store.figures());
        disk.serve();
    }
    store.flush().unwrap();
    drop((store, disk));
    let mut made = vec![];
    for entry in fs::read_dir(dir.path()).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|e| e == "seg") {
            made.push(path);
        }
    }
    made.sort();
    // Sealed segments, again and again under other keys and numbers: all checksums are made here, by the published form.
    let pattern = fs::read(&made[0]).unwrap();
    let mut headers = vec![];
    let mut at = 512;
    while pattern[at + 4] == 0 {
        headers.push(at);
        at += 512 + 100_000usize.next_multiple_of(512);
    }
    let end = at;
    made.iter().for_each(|path| fs::remove_file(path).unwrap());
    let signed = |mut bytes: Vec<u8>| {
        let n = bytes.len() - 4;
        let crc = crc32c::crc32c(&bytes[..n]);
        bytes[n..].copy_from_slice(&crc.to_le_bytes());
        bytes
    };
    for n in 0..127u64 {
        let file = fs::File::create(dir.path().join(format!("{n:08}.seg"))).unwrap();
        file.set_len(segment).unwrap();
        let mut head = pattern[..256].to_vec();
        head[24..32].copy_from_slice(&(n + 1).to_le_bytes());
        let head = signed(head);
        file.write_all_at(&[&head[..], &head[..]].concat(), 0).unwrap();
        for (i, at) in headers.iter().chain([&end]).enumerate() {
            let mut header = pattern[*at..at + 512].to_vec();
            header[28..36].copy_from_slice(&(n + 1).to_le_bytes());
            if *at != end {
                header[12..16].copy_from_slice(&(n as u32 * 1000 + i as u32).to_le_bytes());
            }
            let header = signed(header);
            file.write_all_at(&header, *at as u64).unwrap();
            if *at == end {
                file.write_all_at(&header, segment - 512).unwrap();
            }
        }
        // Off the page cache: after a power cut none of it is in memory.
        file.sync_all().unwrap();
        rustix::fs::fadvise(&file, 0, None, rustix::fs::Advice::DontNeed).unwrap();
    }
    let start = Instant::now();
    let (store, _disk) = Store::open(dir.path(), IDENTITY, &limits).unwrap();
    let (elapsed, f) = (start.elapsed(), store.figures());
    println!("{} records in {} MiB: {elapsed:?}, {} KiB read", f.records, f.disk_bytes >> 20, f.read_bytes >> 10);
    assert_eq!(f.records as usize, 127 * headers.len());
    assert!(headers.len() > 150 && f.records_damaged == 0);
    assert!(elapsed < Duration::from_secs(2) && f.read_bytes < 64 << 20, "{elapsed:?} {f:?}");
}

/// A disk with room for some of the segments: what was taken is kept, and there is room again when others give it back.
#[test]
fn a_full_disk_refuses_and_loses_nothing() {
    on_a_small_disk("6m", "a_full_disk_refuses_and_loses_nothing", |disk_path| {
        let folder = disk_path.join("store");
        let (mut store, disk) = Store::open(&folder, IDENTITY, &LIMITS).unwrap();
        let mut held = BTreeMap::new();
        for id in 0..400 {
            if put(&mut store, id, 7, 30_000) {
                held.insert(id, 7);
            }
            disk.serve();
        }
        let f = store.figures();
        assert!(f.write_errors > 0 && f.refused_full > 0 && !f.first_error.is_empty(), "{f:?}");
        assert!(String::from_utf8_lossy(&f.first_error).contains("No space left"), "{f:?}");
        assert!(held.len() > 20, "{}", held.len());
        store.flush().unwrap();
        // Generations go on where the disk is full.
        for i in 0..300u32 {
            let id = i % held.len() as u32;
            assert!(put(&mut store, id, 8 + i, 30_000), "{i}: {:?}", store.figures());
            held.insert(id, 8 + i);
            disk.serve();
        }
        store.flush().unwrap();
        drop((store, disk));
        let (store, _disk) = Store::open(&folder, IDENTITY, &LIMITS).unwrap();
        let mut found = BTreeMap::new();
        store.entries(|key, about| {
            found.insert(key.id, version_of(about));
        });
        assert_eq!(found, held);
    });
}

#[test]
fn a_disk_full_from_the_start_is_a_fault() {
    on_a_small_disk("512k", "a_disk_full_from_the_start_is_a_fault", |disk| {
        let fault = Store::open(&disk.join("store"), IDENTITY, &LIMITS).err().unwrap().to_string();
        assert!(fault.contains("No space left") && fault.contains("make room"), "{fault}");
    });
}

#[test]
fn a_read_only_folder_is_a_fault_and_is_read() {
    on_a_small_disk("8m", "a_read_only_folder_is_a_fault_and_is_read", |disk| {
        let (mut store, _disk) = Store::open(disk, IDENTITY, &LIMITS).unwrap();
        assert!(put(&mut store, 3, 9, 100));
        store.flush().unwrap();
        drop((store, _disk));
        let remount = |how: &str| Command::new("mount").args(["-o", how]).arg(disk).status().unwrap().success();
        assert!(remount("remount,ro"));
        let fault = Store::open(disk, IDENTITY, &LIMITS).err().unwrap().to_string();
        let mut payload = vec![];
        let read = Reader::open(disk).unwrap().read(key(3), &mut payload).unwrap();
        assert!(remount("remount,rw"));
        assert!(fault.contains("cannot be written") && fault.contains("another folder"), "{fault}");
        assert!(version_of(&read) == 9 && payload == [9; 100]);
    });
}
