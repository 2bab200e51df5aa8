//! The reader on real recordings: everything in them is read, and nothing in them is wrong.
#![allow(clippy::unwrap_used)]

mod folder;

use folder::{recorded, Folder, T0};
use std::fs;
use std::path::Path;
use stipple_drivers::replay::*;
use stipple_drivers::types::pose_at;
use stipple_drivers::{Frames, Lens, Span};

/// Opens a recording, decodes every pair, and finds nothing wrong with it.
fn assert_clean(path: &Path, pairs: usize) -> Recording {
    let recording = Recording::open(path, &OpenOptions::default()).unwrap();
    assert_eq!(recording.warnings, Vec::<String>::new());
    assert_eq!(recording.frames.len(), pairs);
    assert!(recording.frames.windows(2).all(|p| p[0].t < p[1].t));
    let mut reader = recording.reader();
    let mut frames = Frames::for_rig(&recording.calibration);
    for i in 0..pairs {
        reader.read(i, &mut frames).unwrap();
        assert_eq!(frames.t, recording.frames[i].t);
        for image in &frames.images {
            let mean = image.pixels.iter().map(|p| u64::from(*p)).sum::<u64>() / image.pixels.len() as u64;
            assert!((10..245).contains(&mean), "pair {i} is grey on average {mean}");
        }
    }
    let posed = recording.frames.iter().filter(|p| pose_at(&recording.truth, p.t, Span(100_000_000)).is_some());
    assert!(posed.count() * 10 >= pairs * 9, "most pairs have a true pose");
    recording
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn euroc_png_recording_is_clean() {
    let Some(path) = recorded("euroc_png_recording_is_clean", "euroc_MH_01_easy_11s") else { return };
    let r = assert_clean(&path, 220);
    assert_eq!((r.imu.len(), r.truth.len()), (3000, 3000));
    let baseline = r.calibration.cameras[0].body_from_cam.inverse() * r.calibration.cameras[1].body_from_cam;
    assert!((baseline.p.length() - 0.110).abs() < 1e-3, "EuRoC's cameras are 11 cm apart");
    assert!(baseline.p.x > 0.1, "camera 1 is to the right of camera 0");
    // the folder itself may be named
    assert_eq!(Recording::open(&path.join("mav0"), &OpenOptions::default()).unwrap().imu, r.imu);
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn euroc_jpeg_recording_is_clean() {
    let Some(path) = recorded("euroc_jpeg_recording_is_clean", "euroc_V1_01_easy_keyframes") else { return };
    assert_eq!(assert_clean(&path, 100).imu.len(), 27501);
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn euroc_static_recording_is_clean() {
    let Some(path) = recorded("euroc_static_recording_is_clean", "euroc_V1_01_easy_static_1s") else { return };
    let r = assert_clean(&path, 20);
    let g = r.imu.iter().map(|s| s.accel_body.length()).sum::<f64>() / r.imu.len() as f64;
    assert!((g - 9.81).abs() < 0.15, "at rest the accelerometer measures gravity, not {g}");
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn tumvi_16_bit_recording_is_clean() {
    let Some(path) = recorded("tumvi_16_bit_recording_is_clean", "tumvi_room1_fisheye_16") else { return };
    let r = assert_clean(&path, 16);
    assert_eq!((r.imu.len(), r.truth.len()), (607, 332));
    assert!(matches!(r.calibration.cameras[0].camera.lens, Lens::KannalaBrandt { .. }));
    let baseline = r.calibration.cameras[0].body_from_cam.inverse() * r.calibration.cameras[1].body_from_cam;
    assert!((baseline.p.length() - 0.101).abs() < 1e-3 && baseline.p.x > 0.1, "{baseline:?}");
    assert_eq!(r.calibration.imu.gyro_noise, 0.00016);
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn trajectories_of_whole_flights_are_clean() {
    for flight in ["MH_04_difficult", "V1_02_medium", "V2_02_medium"] {
        let name = format!("euroc_text/{flight}/state_groundtruth_estimate0.csv");
        let Some(path) = recorded("trajectories_of_whole_flights_are_clean", &name) else { return };
        let poses = read_trajectory(&path).unwrap();
        assert_eq!(poses.len(), fs::read_to_string(&path).unwrap().lines().count() - 1);
    }
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn basalt_calibrations_are_read_whole() {
    let name = "basalt_calibrations_are_read_whole";
    let Some(dir) = recorded(name, "calibration") else { return };
    let ds = read_calibration(&dir.join("euroc_double_sphere_basalt.json")).unwrap();
    assert!(matches!(ds.cameras[1].camera.lens, Lens::DoubleSphere { xi, .. } if (xi + 0.213).abs() < 1e-3));
    assert_eq!(ds.imu.rate_hz, 200.0);
    for kb4 in ["msdmi_calib.json", "odysseyplus_kb4_calib.json"] {
        let c = read_calibration(&dir.join(kb4)).unwrap();
        assert!(matches!(c.cameras[0].camera.lens, Lens::KannalaBrandt { .. }));
    }
    let headset = read_calibration(&dir.join("reverbg2v2_calib.json")).unwrap();
    assert_eq!(headset.cameras.len(), 4);
    assert!(headset.cameras.iter().all(|c| matches!(c.camera.lens, Lens::Rational { .. })));
    // the file's own remark: biases first, then the mixing matrix less the identity
    let axes = read_calibration(&dir.join("odysseyplus_kb4_calib.json")).unwrap().imu.correction;
    assert!((axes.accel_bias.x - 0.18563582).abs() < 1e-8 && (axes.gyro_bias.y - 0.01642640).abs() < 1e-8);
    assert!((axes.accel_scale.x_axis.x - (1.0 - 0.001865983)).abs() < 1e-8 && axes.accel_scale.z_axis.x == 0.0);
    assert!((axes.accel_scale.z_axis.z - (1.0 - 0.0022075772)).abs() < 1e-8);
    assert!((axes.gyro_scale.x_axis.y + 0.0008238459).abs() < 1e-8);
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn truncated_jpeg_is_undecodable() {
    let Some(path) = recorded("truncated_jpeg_is_undecodable", "euroc_V1_01_easy_keyframes") else { return };
    let r = Recording::open(&path, &OpenOptions::default()).unwrap();
    let bytes = fs::read(&r.frames[0].images[0].as_ref().unwrap().path).unwrap();
    let f = Folder::new();
    (0..2).for_each(|k| f.replace(&format!("cam{k}/sensor.yaml"), "[32, 24]", "[752, 480]"));
    for part in [2, 100, 700, bytes.len() / 2, bytes.len() * 9 / 10, bytes.len() - 20, bytes.len() - 6, bytes.len()] {
        f.write(&format!("cam0/data/{T0}.png"), &bytes[..part]);
        f.write(&format!("cam1/data/{T0}.png"), &bytes);
        let r = f.open().unwrap();
        let result = r.reader().read(0, &mut Frames::for_rig(&r.calibration));
        let expected = if part == bytes.len() { Ok(()) } else { Err(ImageFault::Undecodable) };
        assert_eq!(result, expected, "{part} bytes of {}", bytes.len());
    }
}
