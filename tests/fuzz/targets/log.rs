//! Logs of a run, read back as `stipple recover` does: a file of any bytes (first byte even), or a log of 400 frames with
//! damage (odd). Damage is a list of ten bytes each: what is done, to which bytes, with which. Whatever it is, what is read
//! back was logged, once and in order.
#![no_main]

use libfuzzer_sys::fuzz_target;
use std::fs;
use std::path::PathBuf;
use std::sync::LazyLock;
use stipple::output::trajectory::TumWriter;
use stipple::run::log::read::{read_files, runs, write_trajectory, Message};
use stipple::run::log::{Estimate, Limits, Log, State};
use tempfile::TempDir;

const FRAMES: i64 = 400;

fn state(i: i64) -> State {
    let x = i as f64 / 4.0;
    let estimate = Estimate {
        p_m: [x; 3],
        q_xyzw: [0.0, 0.0, 0.0, 1.0],
        v_world: [x; 3],
        gyro_bias: [0.5; 3],
        accel_bias: [0.5; 3],
    };
    let estimate = (i > 5).then_some(estimate);
    State {
        t_ns: i,
        epoch: (i / 100) as u32,
        estimate,
        time_offsets_ns: (i % 3 == 0).then_some([4, -4, 0, 0]),
        dead_reckoned: i % 7 == 0,
        carried: i % 3 == 0,
        sigma: estimate.map(|_| [0.25; 9]),
        health: 1,
        quality: 9,
        keyframe: i % 5 == 0,
        latency_ms: 4.5,
        cpu_ms: 3.5,
    }
}

static FOLDER: LazyLock<(TempDir, PathBuf)> = LazyLock::new(|| {
    let dir = tempfile::tempdir().expect("the scratch folder can be written to");
    let path = dir.path().join("log-0000.mcap");
    (dir, path)
});

static WHOLE: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let dir = tempfile::tempdir().expect("the scratch folder can be written to");
    let log = Log::start(dir.path().into(), Limits { file: 1 << 30, free: 0 }, "a target");
    (0..FRAMES).for_each(|i| log.sender().state(state(i)));
    let files = log.finish(&mut vec![]);
    fs::read(&files[0]).expect("it was written")
});

fn damaged(list: &[u8]) -> Vec<u8> {
    let mut bytes = WHOLE.clone();
    for damage in list.chunks_exact(10).take(8) {
        let number = |i: usize| usize::from(u16::from_le_bytes([damage[i], damage[i + 1]]));
        let of = |at: usize, size: usize| (at * size) >> 16;
        let at = of(number(1), bytes.len());
        let end = (at + number(3)).min(bytes.len());
        let from = of(number(5), bytes.len() - (end - at));
        let copy = bytes[from..from + (end - at)].to_vec();
        match damage[0] % 6 {
            0 => bytes[at..end].fill(damage[7]),
            1 => bytes[at..end].iter_mut().for_each(|b| *b ^= damage[7]),
            2 => drop(bytes.drain(at..end)),
            3 => bytes.truncate(at),
            4 => bytes[at..end].copy_from_slice(&copy),
            _ => drop(bytes.splice(at..at, copy)),
        }
    }
    bytes
}

fuzz_target!(|data: &[u8]| {
    let Some((kind, rest)) = data.split_first() else { return };
    let (dir, path) = &*FOLDER;
    let ours = kind % 2 == 1;
    let bytes = if ours { damaged(rest) } else { rest.to_vec() };
    fs::write(path, bytes).expect("the scratch folder can be written to");
    for run in runs(dir.path()).expect("the folder can be read") {
        assert!(run.damage.iter().all(|(_, range)| range.start < range.end));
        let mut last = -1;
        let each = |_, message: Message| {
            if let (Message::State(found), true) = (message, ours) {
                assert!(last < found.t_ns && found.t_ns < FRAMES && found == state(found.t_ns));
                last = found.t_ns;
            }
            Ok(())
        };
        read_files(&run.files, each).expect("the folder can be read");
        let mut sink = std::io::sink();
        let mut out = TumWriter::begin(&mut sink).expect("a sink takes everything");
        write_trajectory(&run.files, &mut out, |pose| *pose, |_, _| {}).expect("the folder can be read");
    }
});
