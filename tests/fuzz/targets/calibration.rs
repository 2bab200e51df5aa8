//! Calibration files: a camchain or Basalt file by itself, or a sensor.yaml of a camera or of the inertial unit (by the
//! first byte). What is read has lenses that see their centre and poses of finite numbers.
#![no_main]

#[path = "../recording.rs"]
mod recording;

use libfuzzer_sys::fuzz_target;
use std::path::PathBuf;
use std::sync::LazyLock;
use stipple_drivers::replay::read_calibration;
use tempfile::TempDir;

static FOLDERS: LazyLock<[(TempDir, PathBuf); 3]> = LazyLock::new(|| std::array::from_fn(|_| recording::recording()));

fuzz_target!(|data: &[u8]| {
    let Some((kind, text)) = data.split_first() else { return };
    let name = ["camchain.yaml", "cam0/sensor.yaml", "imu0/sensor.yaml"][usize::from(kind % 3)];
    let (_, mav0) = &FOLDERS[usize::from(kind % 3)];
    recording::write(mav0, name, text);
    let alone = name == "camchain.yaml";
    match read_calibration(&if alone { mav0.join(name) } else { mav0.clone() }) {
        Ok(calibration) => {
            for c in &calibration.cameras {
                let camera = &c.camera;
                assert!((1..=4096).contains(&camera.width) && (1..=4096).contains(&camera.height));
                assert!(c.body_from_cam.p.is_finite() && c.body_from_cam.q.is_finite());
                // As every reader of a recording does with stamps.
                let _ = c.from_imu_clock(c.to_imu_clock(stipple_drivers::Nanos(recording::T0)));
            }
        }
        Err(fault) => assert!(!fault.to_string().contains('\n'), "{fault}"),
    }
});
