//! Logs that are whole, cut off anywhere, and on a disk that is full.
#![allow(clippy::unwrap_used)]

#[path = "../../../tests/program/small_disk.rs"]
mod small_disk;

use super::read::{read_files, runs, Message};
use super::*;
use crate::loops::Corrections;
use crate::output::OutputDir;
use crate::run::summary::write_trajectory;
use proptest::collection::vec;
use proptest::prelude::*;
use small_disk::on_a_small_disk;
use std::fs;
use std::path::Path;
use std::sync::LazyLock;
use stipple_drivers::TimedPose;

const LARGE: Limits = Limits { file: 1 << 30, free: 0 };

const RIG: Rig = Rig {
    t_ns: 7,
    time_offsets: [Some([0.25, 0.5]), None, None, None],
    extrinsics: [None, Some([[0.125; 6], [0.5; 6]]), None, None],
    imu_scale: None,
};

/// Frame i at 20 Hz; the first five have no pose.
fn state(i: u64) -> State {
    // Of few digits: JSON is parsed to the last bit but one.
    let x = 0.5 + i as f64 / 4.0;
    let estimate = Estimate {
        p_m: [x, -x, 0.0],
        q_xyzw: [0.0, 0.6, 0.0, 0.8],
        v_world: [x; 3],
        gyro_bias: [1e-3; 3],
        accel_bias: [0.1; 3],
    };
    let estimate = (i >= 5).then_some(estimate);
    let keyframe = i % 5 == 0;
    State {
        t_ns: i as i64 * 50_000_000,
        epoch: 0,
        estimate,
        time_offsets_ns: Some([-1500, 2500, 0, 0]),
        dead_reckoned: false,
        carried: i % 2 == 1,
        sigma: Some([0.5; 9]),
        health: 1,
        quality: 90,
        keyframe,
        latency_ms: 4.5,
        cpu_ms: 3.5,
    }
}

/// Logs frames, so many between syncs, and answers the files and the counters.
fn log(dir: &Path, limits: Limits, frames: &[u64], between: usize) -> (Vec<PathBuf>, Vec<(&'static str, u64)>) {
    let log = Log::start(dir.into(), limits, "a test");
    let sender = log.sender();
    for (i, batch) in frames.chunks(between).enumerate() {
        std::thread::sleep((SYNC_PERIOD + 3 * POLL_PERIOD) * i.min(1) as u32);
        batch.iter().for_each(|i| sender.state(state(*i)));
    }
    sender.rig(RIG);
    sender.counters(vec![("frames".into(), 7), ("resets".into(), 0)]);
    sender.event(EventId::End, "over");
    let mut counters = vec![];
    let files = log.finish(&mut counters);
    (files, counters)
}

fn some(frames: std::ops::Range<u64>) -> Vec<u64> {
    frames.collect()
}

fn states(files: &[PathBuf]) -> Vec<State> {
    let mut found = vec![];
    let each = |_, message: Message| {
        if let Message::State(s) = message {
            found.push(s);
        }
        Ok(())
    };
    read_files(files, each).unwrap();
    found
}

fn count(counters: &[(&str, u64)], name: &str) -> u64 {
    counters.iter().find(|(n, _)| *n == name).unwrap().1
}

#[test]
fn what_was_logged_is_read_back_across_files_and_runs() {
    let dir = tempfile::tempdir().unwrap();
    // Full at once: each sync begins another.
    let small = Limits { file: 1, free: 0 };
    let (first, counters) = log(dir.path(), small, &some(0..3), 1);
    assert!(first.len() >= 3 && count(&counters, "log_files") == first.len() as u64, "{first:?}");
    assert_eq!((count(&counters, "log_records_written"), count(&counters, "log_records_lost")), (7, 0));
    let (second, _) = log(dir.path(), LARGE, &some(3..300), 4000);
    let found = runs(dir.path()).unwrap();
    assert_eq!(found.iter().map(|r| r.files.clone()).collect::<Vec<_>>(), [first.clone(), second.clone()]);
    assert!(found[0].run_ns < found[1].run_ns);
    assert!([states(&first), states(&second)].concat().into_iter().eq((0..300).map(state)));
    let mut rest = vec![];
    let each = |_, message: Message| {
        // Each chunk begins with the clocks.
        let clocks = !rest.is_empty() && matches!(message, Message::Clocks(_));
        rest.extend((!clocks && !matches!(message, Message::State(_))).then(|| format!("{message:?}")));
        Ok(())
    };
    read_files(&second, each).unwrap();
    assert!(rest[0].starts_with("Clocks(") && rest[1].contains("Start") && rest[1].contains("a test"), "{rest:?}");
    assert_eq!(rest[2], format!("{:?}", Message::Rig(RIG)));
    assert!(rest[3] == r#"Counters({"frames": 7})"# && rest[4].contains("End"), "{rest:?}");
}

/// The room of a disk goes while a file fills.
#[test]
fn the_last_file_says_why_no_other_follows() {
    let dir = tempfile::tempdir().unwrap();
    let mut files = LogFiles::new(dir.path().into(), Limits { file: 1, free: 0 }, None);
    files.begin().unwrap();
    files.limits.free = u64::MAX;
    let last = State { epoch: 2, ..state(7) };
    files.write(&Record { at: Nanos(0), content: Content::State(last) }).unwrap();
    let why = files.sync(false).unwrap_err().to_string();
    files.give_up();
    let mut said = vec![];
    let each = |_, message: Message| {
        if let Message::Event(event) = message {
            said.push((event.epoch, event.text.into_owned()));
        }
        Ok(())
    };
    read_files(&files.written, each).unwrap();
    assert!(why.contains("make room") && said == [(2, why)], "{said:?}");
    assert_eq!(states(&files.written), [last]);
}

/// A disk that fails between two syncs: a chunk that was written whole stays.
#[test]
fn what_was_written_since_the_last_sync_stays() {
    let dir = tempfile::tempdir().unwrap();
    let mut files = LogFiles::new(dir.path().into(), LARGE, None);
    files.begin().unwrap();
    (0..500).for_each(|i| files.write(&Record { at: Nanos(0), content: Content::State(state(i)) }).unwrap());
    files.give_up();
    let found = states(&files.written);
    assert!(found.len() + CHUNK > 500, "{}", found.len());
    assert!(found.iter().enumerate().all(|(i, found)| *found == state(i as u64)));
}

/// Frames in a chunk that is ended by its size, and some more.
const CHUNK: usize = 70;

#[test]
fn a_log_cut_off_at_any_byte_gives_every_whole_chunk_before_it() {
    let dir = tempfile::tempdir().unwrap();
    let (files, _) = log(dir.path(), LARGE, &some(0..500), 4000);
    let whole = fs::read(&files[0]).unwrap();
    let needle = b"\"cpu_ms\":3.5}";
    let ends: Vec<usize> =
        (0..whole.len() - needle.len()).filter(|i| whole[*i..].starts_with(needle)).map(|i| i + needle.len()).collect();
    assert_eq!(ends.len(), 500);
    let cut = dir.path().join("log-0001.mcap");
    let mut before = 0;
    let from = (0..400).chain((ends[250]..whole.len() - 4096).step_by(997)).chain(whole.len() - 4096..whole.len());
    for bytes in from {
        fs::write(&cut, &whole[..bytes]).unwrap();
        let found = states(std::slice::from_ref(&cut));
        assert!(found.iter().enumerate().all(|(i, found)| *found == state(i as u64)));
        let written = ends.iter().filter(|end| **end <= bytes).count();
        assert!((before..=written).contains(&found.len()) && found.len() + CHUNK > written, "cut to {bytes} bytes");
        before = found.len();
    }
}

/// The logs of two runs, of frames 0 to 999 and 5000 to 5999.
static TWO_LOGS: LazyLock<[Vec<u8>; 2]> = LazyLock::new(|| {
    let dir = tempfile::tempdir().unwrap();
    [0, 5000].map(|first| fs::read(&log(dir.path(), LARGE, &some(first..first + 1000), 4000).0[0]).unwrap())
});

proptest! {
    /// Whatever a disk may make of a part of a log, what is read was logged, in order, and what is lost is near the damage.
    #[test]
    fn damage_costs_the_chunks_it_meets_and_makes_no_frame(
        (spot, source) in (0.0..1.0, 0.0..1.0), length in 1usize..60_000, kind in 0..8, random in vec(any::<u8>(), 512),
    ) {
        let [mut bytes, other] = TWO_LOGS.clone();
        let at = (spot * bytes.len() as f64) as usize;
        let end = (at + length).min(bytes.len());
        let length = end - at;
        let from = (source * (other.len().min(bytes.len()) - length) as f64) as usize;
        let repeated = |pattern: &[u8]| pattern.iter().copied().cycle().take(length).collect::<Vec<_>>();
        let (keeps, with) = match kind {
            0 => (end, repeated(&[0])),
            1 => (end, repeated(&random)),
            2 => (end, repeated(&[6, 9])),
            3 => (end, repeated(b"{\"t_ns\":5,\"estimate\":null}")),
            4 => (end, vec![]),
            5 => (end, bytes[from..from + length].to_vec()),
            6 => (at, bytes[from..from + length].to_vec()),
            _ => (end, other[from..from + length].to_vec()),
        };
        bytes.splice(at..keeps, with);
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("log-0000.mcap"), &bytes).unwrap();
        let runs = runs(dir.path()).unwrap();
        prop_assert!(runs.len() == 1);
        let found = states(&runs[0].files);
        prop_assert!(found.windows(2).all(|f| f[0].t_ns < f[1].t_ns));
        prop_assert!(found.iter().all(|f| f.t_ns < state(1000).t_ns && *f == state(f.t_ns as u64 / 50_000_000)));
        let most = (length / (16 << 10) + 2) * CHUNK;
        prop_assert!(found.len() + most >= 1000, "{} of 1000 for {length} bytes at {at}", found.len());
    }
}

/// Zeroes are what a card may answer for a block that it cannot read.
#[test]
fn a_zeroed_block_costs_a_chunk_and_is_found() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("log-0000.mcap");
    let mut bytes = TWO_LOGS[0].clone();
    fs::write(&path, &bytes).unwrap();
    assert_eq!(runs(dir.path()).unwrap()[0].damage, []);
    let middle = bytes.len() / 2;
    bytes[middle..middle + 512].fill(0);
    fs::write(&path, &bytes).unwrap();
    let runs = runs(dir.path()).unwrap();
    let [(place, range)] = &runs[0].damage[..] else { panic!("{runs:?}") };
    assert!(*place == path && range.contains(&(middle as u64)) && range.end - range.start < 40_000, "{runs:?}");
    assert!(states(&[path]).len() > 1000 - 2 * CHUNK);
}

#[test]
fn damage_and_what_is_no_log_are_passed_over() {
    let dir = tempfile::tempdir().unwrap();
    let (files, _) = log(dir.path(), LARGE, &some(0..100), 4000);
    let mut bytes = fs::read(&files[0]).unwrap();
    let mut seed = 1u32;
    for at in (100..bytes.len()).step_by(211) {
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let was = std::mem::replace(&mut bytes[at], (seed >> 24) as u8);
        let path = dir.path().join("log-0001.mcap");
        fs::write(&path, &bytes).unwrap();
        assert!(states(&[path]).len() <= 100);
        bytes[at] = was;
    }
    fs::write(dir.path().join("log-0001.mcap"), b"").unwrap();
    fs::write(dir.path().join("log-x.mcap"), b"no number").unwrap();
    let pipe = dir.path().join("log-0007.mcap");
    assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    assert_eq!(runs(dir.path()).unwrap().len(), 1);
    let (next, _) = log(dir.path(), LARGE, &some(0..1), 4000);
    assert_eq!(next, [dir.path().join("log-0008.mcap")]);
}

#[test]
fn a_full_disk_ends_the_log_and_keeps_every_record_before() {
    on_a_small_disk("1m", "run::log::tests::a_full_disk_ends_the_log_and_keeps_every_record_before", |disk| {
        // 150 kB a sync.
        let (files, counters) = log(disk, LARGE, &some(0..5000), 500);
        let (written, lost) = (count(&counters, "log_records_written"), count(&counters, "log_records_lost"));
        assert_eq!((files.len(), count(&counters, "log_ended_early"), written + lost), (1, 1, 5004), "{counters:?}");
        let found = states(&files);
        // And the event of its start. Of the last sync a part may be there.
        assert!(written >= 2000 && found.len() as u64 + 1 >= written, "{} of {written}", found.len());
        assert!(found.iter().enumerate().all(|(i, found)| *found == state(i as u64)));
        assert_eq!(fs::read_dir(disk).unwrap().count(), 1, "no file for each record that fails");
    });
}

#[test]
fn a_disk_under_the_floor_is_left_alone() {
    let dir = tempfile::tempdir().unwrap();
    let log = Log::start(dir.path().into(), Limits { file: 1 << 20, free: u64::MAX }, "a test");
    let sender = log.sender();
    sender.state(state(0));
    let mut counters = vec![];
    assert!(log.finish(&mut counters).is_empty());
    assert_eq!((count(&counters, "log_records_lost"), fs::read_dir(dir.path()).unwrap().count()), (2, 0));
    assert!(sender.notice().unwrap().contains("make room"), "{:?}", sender.notice());
}

#[test]
fn a_full_queue_loses_and_counts_and_never_waits() {
    let queue = Arc::new(Queue::measured(&mut Footprint::default()));
    let sender = LogSender(queue.clone());
    (0..QUEUE as u64 + 10).for_each(|i| sender.state(state(i)));
    // Cut where a character begins.
    sender.event(EventId::SensorLost, &"ü".repeat(TEXT));
    assert_eq!((queue.records.len(), queue.counts.log_records_lost.get()), (QUEUE, 11));
    while queue.records.pop().is_some() {}
    sender.event(EventId::SensorLost, &format!("a{}", "ü".repeat(TEXT)));
    let Content::Event(_, text) = queue.records.pop().unwrap().content else { panic!("an event") };
    assert_eq!(String::from_utf8(text.to_vec()).unwrap(), format!("a{}", "ü".repeat(TEXT / 2 - 1)));
}

#[test]
fn a_long_run_takes_its_trajectory_from_the_log_and_what_came_after_from_memory() {
    let dir = tempfile::tempdir().unwrap();
    let (files, _) = log(dir.path(), LARGE, &some(0..1000), 4000);
    let timed = |i: u64| TimedPose { t: Nanos(state(i).t_ns), pose: state(i).estimate.unwrap().pose() };
    let out = OutputDir::create(dir.path()).unwrap();
    let of = |whole: bool, kept: Vec<TimedPose>, files: &[PathBuf]| {
        write_trajectory(whole, (&kept, &[]), files, (&out, "trajectory.tum"), &Corrections::default()).unwrap();
        fs::read_to_string(dir.path().join("trajectory.tum")).unwrap()
    };
    // The memory of a run of 1200 frames, of which 1000 were logged, and of which it has one in 16.
    let thinned: Vec<TimedPose> = (5..1200).step_by(16).map(timed).collect();
    let expected = (5..1000).chain(thinned.iter().map(|p| p.t.0 as u64 / 50_000_000).filter(|i| *i >= 1000));
    assert_eq!(of(false, thinned.clone(), &files), of(true, expected.map(timed).collect(), &[]));
    assert_eq!(of(false, thinned.clone(), &[]), of(true, thinned, &[]));
}
