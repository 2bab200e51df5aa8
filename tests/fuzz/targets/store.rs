//! Segments of a map's store: any bytes as one (first byte even), or a segment with damage (odd): a list of four bytes each,
//! where and with what. Reader and store open it or say why not; what they give has a checksum that holds.
#![no_main]

use libfuzzer_sys::fuzz_target;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;
use stipple::store::{Key, Limits, Outcome, Reader, Store, ABOUT};
use tempfile::TempDir;

const LIMITS: Limits = Limits {
    bytes_max: 8 * 8192,
    segment_bytes: 8192,
    records_max: 16,
    payload_max: 700,
    buffers: 4,
    write_bytes_per_s: 0,
};
const IDENTITY: u64 = 1;

fn scratch() -> TempDir {
    tempfile::tempdir().expect("the scratch folder can be written to")
}

fn key(id: u32) -> Key {
    Key { kind: 1, run: 1, id }
}

/// A payload that tells whose it is.
fn payload(id: u32) -> Vec<u8> {
    vec![id as u8 + 1; 100 * id as usize]
}

fn segments(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).expect("the folder can be read");
    let mut found: Vec<PathBuf> = entries.map(|e| e.expect("it is there").path()).collect();
    found.retain(|p| p.extension().is_some_and(|e| e == "seg"));
    found.sort();
    found
}

static WHOLE: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let dir = scratch();
    let (mut store, _disk) = Store::open(dir.path(), IDENTITY, &LIMITS).expect("it can be made");
    for id in [0, 1, 2, 3, 1, 2] {
        assert!(store.put(key(id), &[id as u8; ABOUT], |to| to.extend(payload(id))));
        store.flush().expect("it can be written");
    }
    store.remove(key(3));
    store.flush().expect("it can be written");
    fs::read(&segments(dir.path())[0]).expect("it was written")
});

fuzz_target!(|data: &[u8]| {
    let Some((kind, rest)) = data.split_first() else { return };
    let ours = kind % 2 == 1;
    let mut bytes = if ours { WHOLE.clone() } else { rest.to_vec() };
    for damage in rest.chunks_exact(4).take(if ours { 32 } else { 0 }) {
        let at = usize::from(u16::from_le_bytes([damage[0], damage[1]])) % bytes.len();
        let end = (at + usize::from(damage[2])).min(bytes.len());
        bytes[at..end].fill(damage[3]);
    }
    let dir = scratch();
    fs::write(dir.path().join("00000000.seg"), bytes).expect("the scratch folder can be written to");
    let mut buffer = vec![];
    if let Ok(mut reader) = Reader::open(dir.path()) {
        let mut keys = vec![];
        reader.entries(|key, _| keys.push(*key));
        for key in keys {
            let read = reader.read(key, &mut buffer);
            assert!(read.is_err() || !ours || buffer == payload(key.id));
        }
    }
    let (mut store, disk) = match Store::open(dir.path(), IDENTITY, &LIMITS) {
        Ok(opened) => opened,
        Err(fault) => return assert!(!fault.to_string().contains('\n'), "{fault}"),
    };
    let mut keys = vec![];
    store.entries(|key, _| keys.push(*key));
    for key in keys {
        assert!(store.fetch(key));
        disk.serve();
        let fetched = store.fetched().expect("it was asked for");
        let is_whole = matches!(fetched.outcome, Outcome::Newest | Outcome::Older);
        assert!(fetched.payload.len() <= LIMITS.payload_max && (is_whole || fetched.payload.is_empty()));
        assert!(!ours || !is_whole || fetched.payload == payload(key.id));
        store.give_back(fetched);
    }
    // It goes on being written, and compacted, whatever it holds.
    for round in 0..24 {
        store.put(key(9), &[round; ABOUT], |to| to.resize(600, round));
        disk.serve();
    }
    let _ = store.flush();
    assert!(store.figures().disk_bytes <= LIMITS.bytes_max);
});
