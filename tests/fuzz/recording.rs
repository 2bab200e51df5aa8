//! A small whole recording, of which a target spoils one file.

use std::fs;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

pub const T0: i64 = 1_000_000_000;
const FRAME: i64 = 50_000_000;

const CAMERA: &str = "T_BS:
  data: [1.0, 0.0, 0.0, BASELINE, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
resolution: [32, 24]
camera_model: pinhole
intrinsics: [20.0, 20.0, 15.5, 11.5]
distortion_model: radial-tangential
distortion_coefficients: [-0.1, 0.01, 0.0, 0.0]
";
const IMU: &str = "rate_hz: 200
gyroscope_noise_density: 1.6968e-04
gyroscope_random_walk: 1.9393e-05
accelerometer_noise_density: 2.0000e-3
accelerometer_random_walk: 3.0000e-3
";

/// Makes a recording of three pairs in a scratch folder.
pub fn recording() -> (TempDir, PathBuf) {
    let dir = tempfile::tempdir().expect("the scratch folder can be written to");
    let mav0 = dir.path().join("mav0");
    let mut image = Vec::new();
    let mut encoder = png::Encoder::new(&mut image, 32, 24);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.write_header().and_then(|mut w| w.write_image_data(&[9; 32 * 24])).expect("memory can be written to");
    for k in 0..2 {
        write(&mav0, &format!("cam{k}/sensor.yaml"), CAMERA.replace("BASELINE", &format!("0.{k}")));
        let rows = (0..3).map(|i| format!("{0},{0}.png\n", T0 + i * FRAME)).collect::<String>();
        write(&mav0, &format!("cam{k}/data.csv"), rows);
        (0..3).for_each(|i| write(&mav0, &format!("cam{k}/data/{}.png", T0 + i * FRAME), &image));
    }
    write(&mav0, "imu0/sensor.yaml", IMU);
    let rows =
        (0..40).map(|i| format!("{},0.0,0.1,0.2,0.0,0.0,9.81\n", T0 - FRAME + i * 5_000_000)).collect::<String>();
    write(&mav0, "imu0/data.csv", rows);
    write(&mav0, "state_groundtruth_estimate0/data.csv", format!("{T0},1,2,3,1,0,0,0\n"));
    (dir, mav0)
}

/// Writes a file of a recording.
pub fn write(mav0: &Path, name: &str, content: impl AsRef<[u8]>) {
    let path = mav0.join(name);
    fs::create_dir_all(path.parent().expect("a name in a folder")).expect("the scratch folder can be written to");
    fs::write(path, content).expect("the scratch folder can be written to");
}
