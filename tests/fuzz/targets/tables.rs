//! Tables of a recording (by the first byte): image lists, inertial samples, ground truth, pressures, and poses in the TUM
//! format.
//! What is read is finite and in the order of time.
#![no_main]

#[path = "../recording.rs"]
mod recording;

use libfuzzer_sys::fuzz_target;
use std::path::PathBuf;
use std::sync::LazyLock;
use stipple_drivers::replay::{read_trajectory, OpenOptions, Recording};
use stipple_drivers::source::Aid;
use tempfile::TempDir;

static FOLDERS: LazyLock<[(TempDir, PathBuf); 6]> = LazyLock::new(|| std::array::from_fn(|_| recording::recording()));
const TABLES: [&str; 6] = [
    "cam0/data.csv",
    "cam1/data.csv",
    "imu0/data.csv",
    "state_groundtruth_estimate0/data.csv",
    "poses.tum",
    "baro0/data.csv",
];

fuzz_target!(|data: &[u8]| {
    let Some((kind, text)) = data.split_first() else { return };
    let kind = usize::from(*kind) % TABLES.len();
    let (_, mav0) = &FOLDERS[kind];
    recording::write(mav0, TABLES[kind], text);
    if kind == 4 {
        let _ = read_trajectory(&mav0.join(TABLES[kind]));
        return;
    }
    match Recording::open(mav0, &OpenOptions::default()) {
        Ok(r) => {
            assert!(r.imu.iter().all(|s| s.is_finite()) && r.imu.windows(2).all(|s| s[0].t < s[1].t));
            let Aid::Pressure(last) = r.aids.last().map_or(Aid::Pressure(0.0), |a| a.value);
            assert!(last.is_finite() && r.aids.windows(2).all(|a| a[0].t < a[1].t));
            assert!(r.truth.iter().all(|p| p.pose.p.is_finite() && p.pose.q.is_finite()));
            assert!(r.frames.iter().flat_map(|f| f.images.iter().flatten()).all(|i| i.path.starts_with(mav0)));
        }
        Err(fault) => assert!(!fault.to_string().contains('\n'), "{fault}"),
    }
});
