//! `stipple calib-noise` as its users meet it: what it prints is what a calibration reads, and a log that is not that of a
//! unit at rest is refused with the reason.

use crate::start::{flight, stipple, text};
use crate::world::Noise;
use glam::DVec3;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;
use stipple_drivers::euroc::{imu_row, imu_yaml, IMU_COLUMNS};
use stipple_drivers::record::{McapSink, Sink};
use stipple_drivers::replay::read_calibration;
use stipple_drivers::sim::euroc_rig;
use stipple_drivers::source::ImuReading;
use stipple_drivers::{Frames, ImuCalibration, ImuSample, Nanos};

const RATE: f64 = 100.0;
const SECS: f64 = 900.0;
const DATA: i32 = 65;
/// A unit whose walks show in minutes.
const UNIT: ImuCalibration = ImuCalibration {
    rate_hz: RATE,
    gyro_noise: 1.7e-4,
    gyro_walk: 1e-4,
    accel_noise: 2e-3,
    accel_walk: 1e-3,
    ..ImuCalibration::CONSUMER
};

/// A log of the unit at rest.
fn rested(secs: f64) -> Vec<ImuSample> {
    let (mut noise, mut gyro, mut accel) = (Noise(1), DVec3::splat(0.01), DVec3::new(0.1, -0.1, 9.8));
    let root = RATE.sqrt();
    let sample = |k: usize| {
        gyro += noise.vector() * (UNIT.gyro_walk / root);
        accel += noise.vector() * (UNIT.accel_walk / root);
        ImuSample {
            t: Nanos(1_000_000_000 + (k as f64 * 1e9 / RATE) as i64),
            gyro_body: gyro + noise.vector() * (UNIT.gyro_noise * root),
            accel_body: accel + noise.vector() * (UNIT.accel_noise * root),
            ..ImuSample::default()
        }
    };
    (0..(secs * RATE) as usize).map(sample).collect()
}

/// The log as an EuRoC folder.
fn folder(dir: &Path, samples: &[ImuSample]) -> PathBuf {
    let imu = dir.join("mav0/imu0");
    fs::create_dir_all(&imu).unwrap();
    fs::write(imu.join("sensor.yaml"), imu_yaml(&UNIT, "at rest")).unwrap();
    let mut table = IMU_COLUMNS.as_bytes().to_vec();
    samples.iter().for_each(|s| imu_row(&mut table, s).unwrap());
    fs::write(imu.join("data.csv"), table).unwrap();
    dir.to_path_buf()
}

fn calib_noise(log: &Path) -> Output {
    stipple().args(["calib-noise", log.to_str().unwrap()]).output().unwrap()
}

#[test]
fn what_it_prints_is_read_as_a_calibration_and_is_the_noise_of_the_unit_from_a_folder_and_from_mcap() {
    let dir = tempfile::tempdir().unwrap();
    let samples = rested(SECS);
    let log = folder(&dir.path().join("euroc"), &samples);
    let o = calib_noise(&log);
    assert!(o.status.success(), "{}", text(&o));
    let printed = String::from_utf8(o.stdout).unwrap();

    // Into a calibration, in the place of the figures there.
    let flight = flight(dir.path(), "0.2");
    let yaml = flight.join("mav0/imu0/sensor.yaml");
    let stated = fs::read_to_string(&yaml).unwrap();
    let kept: Vec<&str> = stated.lines().filter(|l| !l.contains("_density") && !l.contains("_walk")).collect();
    fs::write(&yaml, format!("{}\n{printed}", kept.join("\n"))).unwrap();
    let imu = read_calibration(&flight.join("mav0")).unwrap().imu;
    assert!(imu.measured, "{printed}");
    let near = |found: f64, truth: f64, within: f64| {
        assert!((found / truth - 1.0).abs() < within, "{found} of {truth}: {printed}");
    };
    near(imu.gyro_noise, UNIT.gyro_noise, 0.1);
    near(imu.accel_noise, UNIT.accel_noise, 0.1);
    // Three standard errors, which are printed.
    near(imu.gyro_walk, UNIT.gyro_walk, 0.3);
    near(imu.accel_walk, UNIT.accel_walk, 0.5);

    let mut rig = euroc_rig();
    rig.imu = UNIT;
    rig.cameras.iter_mut().for_each(|c| (c.camera.width, c.camera.height) = (4, 3));
    let (out, mut frames) = (dir.path().join("mcap"), Frames::for_rig(&rig));
    fs::create_dir(&out).unwrap();
    let mut sink = McapSink::create(&out, &rig).unwrap();
    for (k, sample) in samples.iter().enumerate() {
        sink.imu(&ImuReading { sample: *sample, ..ImuReading::default() }).unwrap();
        if k % 100 == 99 {
            frames.t = sample.t;
            sink.frames(&frames).unwrap();
        }
    }
    sink.finish().unwrap();
    let figures = |o: &Output| -> Vec<String> {
        String::from_utf8_lossy(&o.stdout).lines().map(str::to_string).filter(|l| !l.starts_with("# ")).collect()
    };
    let of_folder = printed.lines().filter(|l| !l.starts_with("# ")).map(str::to_string).collect::<Vec<_>>();
    // The table rounds to a billionth.
    assert_eq!(figures(&calib_noise(&out)), of_folder);
    assert_eq!(figures(&calib_noise(&out.join("recording-000.mcap"))), of_folder);
    // A kill cuts the file off.
    let file = out.join("recording-000.mcap");
    let cut = fs::metadata(&file).unwrap().len() * 9 / 10;
    fs::OpenOptions::new().write(true).open(&file).unwrap().set_len(cut).unwrap();
    let o = calib_noise(&out);
    assert!(o.status.success() && figures(&o).len() == 5, "{}", text(&o));
}

/// Spoils a log, which must be refused with all of these words.
#[track_caller]
fn refused(spoil: impl FnOnce(&mut Vec<ImuSample>), words: &[&str]) {
    let dir = tempfile::tempdir().unwrap();
    let mut samples = rested(400.0);
    spoil(&mut samples);
    let o = calib_noise(&folder(dir.path(), &samples));
    let said = text(&o);
    assert_eq!(o.status.code(), Some(DATA), "{said}");
    assert!(words.iter().all(|w| said.contains(w)) && o.stdout.is_empty(), "{words:?}: {said}");
}

#[test]
fn a_log_that_moves_is_refused() {
    let turned = |t: f64| DVec3::new(0.0, 0.05 * (0.8 * t).sin(), 0.0);
    refused(
        |log| log.iter_mut().for_each(|s| s.gyro_body += turned(s.t.0 as f64 * 1e-9)),
        &["moves", "gyro y", "at rest"],
    );
    // Lifted once, and put down again.
    refused(
        |log| log[20_000..20_200].iter_mut().for_each(|s| s.accel_body.z += 0.4),
        &["moves", "accelerometer z", "s after its start"],
    );
    // Tilted by a third of a degree, which leaves no other trace.
    refused(|log| log[20_000..].iter_mut().for_each(|s| s.accel_body.x += 0.06), &["moves", "accelerometer x"]);
}

#[test]
fn spikes_and_an_axis_that_does_not_change_are_refused() {
    refused(|log| log[7_777].gyro_body.x += 1.0, &["wrong sample", "gyro x", "78.0 s after its start"]);
    refused(|log| log[7_777].accel_body.y += 2.0, &["knocked", "wrong sample", "accelerometer y"]);
    refused(|log| log.iter_mut().for_each(|s| s.gyro_body.z = 0.01), &["gyro z does not change"]);
}

#[test]
fn a_log_with_gaps_or_of_another_rate_or_too_short_is_refused_with_what_is_needed() {
    refused(|log| drop(log.drain(9_000..9_003)), &["1 gaps", "0.0400 s", "90.0 s after"]);
    refused(|log| log.swap(500, 501), &["1 of its stamps"]);
    refused(
        |log| log.iter_mut().for_each(|s| s.t.0 = s.t.0 * 9 / 10),
        &["111.1", "states 100", "rate_hz or update_rate"],
    );
    refused(|log| log.retain(|s| s.t.0 / 10_000_000 % 2 == 0), &["50.0", "states 100"]);
    refused(|log| log.truncate(6_000), &["too short", "60.0 s", "5 minutes", "an hour to a night"]);
    refused(|log| log.clear(), &["no sample"]);
}

#[test]
fn a_row_that_is_no_sample_is_named_and_the_last_one_of_a_killed_recording_may_be_cut() {
    let dir = tempfile::tempdir().unwrap();
    let log = folder(dir.path(), &rested(400.0));
    let table = log.join("mav0/imu0/data.csv");
    let whole = fs::read_to_string(&table).unwrap();
    fs::write(&table, &whole[..whole.len() - 9]).unwrap();
    assert!(calib_noise(&log).status.success());
    fs::write(&table, whole.replacen(",0.0", ",nan", 1)).unwrap();
    let o = calib_noise(&log);
    assert!(o.status.code() == Some(DATA) && text(&o).contains("imu0/data.csv:"), "{}", text(&o));
    fs::remove_file(log.join("mav0/imu0/sensor.yaml")).unwrap();
    let o = calib_noise(&log);
    assert!(!o.status.success() && text(&o).contains("imu_config.yaml"), "{}", text(&o));
}
