//! `stipple doctor` and `stipple calib-check` on recordings in the place of sensors: a whole one passes, and one with an
//! axis of the gyro turned round, a clock that is off, or its cameras exchanged is told so.

use crate::start::{self, flight, text, BOARD};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

const UNAVAILABLE: i32 = 69;
const CONFIG: i32 = 78;

fn stipple(args: &[&str]) -> Output {
    start::stipple().args(args).output().unwrap()
}

fn doctor(data: &Path) -> Output {
    stipple(&["doctor", "--board", BOARD, "--dataset", data.to_str().unwrap(), "--set", "map.enabled=false"])
}

/// What `calib-check` prints; it exits with an error where a check failed, and only there.
fn check(data: &Path) -> String {
    let o = stipple(&["calib-check", data.to_str().unwrap()]);
    let said = text(&o);
    let failed = said.lines().any(|l| l.starts_with("fail"));
    assert_eq!(o.status.code(), Some(if failed { CONFIG } else { 0 }), "{said}");
    said
}

/// The line that speaks of `what` and its verdict.
fn verdict<'a>(said: &'a str, what: &str) -> (&'a str, &'a str) {
    let first = |l: &str| l.split_whitespace().next().map(str::to_string).unwrap_or_default();
    let judges = |l: &&str| ["ok", "warn", "fail"].contains(&first(l).as_str());
    let line = said.lines().filter(judges).find(|l| l.contains(what)).unwrap_or_else(|| panic!("{what}: {said}"));
    (line.split_whitespace().next().unwrap(), line)
}

/// Every sample's gyro and force along y the other way round.
fn turn_y_round(data: &Path) {
    let file = data.join("mav0/imu0/data.csv");
    let turned = |line: &str| {
        let mut fields: Vec<String> = line.split(',').map(str::to_string).collect();
        for y in [2, 5] {
            let value: f64 = fields[y].parse().unwrap();
            fields[y] = format!("{}", -value);
        }
        fields.join(",")
    };
    let rows = fs::read_to_string(&file).unwrap();
    let rows: Vec<String> = rows.lines().map(|l| if l.starts_with('#') { l.into() } else { turned(l) }).collect();
    fs::write(&file, rows.join("\n")).unwrap();
}

#[test]
fn a_whole_recording_passes_every_check() {
    let dir = tempfile::tempdir().unwrap();
    let data = flight(dir.path(), "7");
    let (said, o) = (check(&data), doctor(&data));
    for words in ["time offset", "axes", "extrinsics", "gyro bias", "vertical disparity"] {
        assert_eq!(verdict(&said, words).0, "ok", "{said}");
    }
    let said = text(&o);
    assert!(o.status.success() && !said.contains("fail"), "{said}");
    let all = [
        "camera rate",
        "inertial rate",
        "left and right",
        "capture",
        "camera 0: mean",
        "camera 1: mean",
        "stereo",
        "gravity",
    ];
    let more =
        ["gyro noise", "accelerometer noise", "saturation", "time offset", "axes", "extrinsics", "memory", "disk"];
    for words in all.iter().chain(&more).filter(|w| **w != "disk") {
        assert_eq!(verdict(&said, words).0, "ok", "{words}: {said}");
    }
}

#[test]
fn an_axis_turned_round_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let data = flight(dir.path(), "7");
    turn_y_round(&data);
    let said = check(&data);
    let (verdict, line) = verdict(&said, "axes");
    assert!(verdict == "fail" && line.contains("gyro's y axis has the wrong sign"), "{said}");
}

#[test]
fn a_clock_twenty_milliseconds_off_is_measured() {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("flight");
    let args = ["sim", "demo", "--duration", "7", "--time-offset", "0.02", "--out", data.to_str().unwrap()];
    assert!(stipple(&args).status.success());
    let said = check(&data);
    let (verdict, line) = verdict(&said, "time offset");
    let mut words = line.split("clock is ").nth(1).unwrap().split(' ');
    let ms: f64 = words.next().unwrap().parse().unwrap();
    let sigma: f64 = words.nth(1).unwrap().parse().unwrap();
    assert!(verdict == "fail" && (ms - 20.0).abs() < 1.5 && sigma < 1.0, "{said}");
}

#[test]
fn cameras_exchanged_are_told_and_the_doctor_says_no() {
    let dir = tempfile::tempdir().unwrap();
    let data = flight(dir.path(), "7");
    let mav = data.join("mav0");
    for name in ["data", "data.csv"] {
        fs::rename(mav.join("cam0").join(name), mav.join("other")).unwrap();
        fs::rename(mav.join("cam1").join(name), mav.join("cam0").join(name)).unwrap();
        fs::rename(mav.join("other"), mav.join("cam1").join(name)).unwrap();
    }
    let o = doctor(&data);
    let said = text(&o);
    assert_eq!(o.status.code(), Some(UNAVAILABLE), "{said}");
    let (verdict, line) = verdict(&said, "stereo:");
    assert!(verdict == "fail" && line.contains("swapped"), "{said}");
}

#[test]
fn a_board_without_sensors_is_told_what_to_write() {
    let o = stipple(&["doctor", "--board", BOARD, "--set", "map.enabled=false"]);
    assert_eq!(o.status.code(), Some(UNAVAILABLE), "{}", text(&o));
    assert!(verdict(&text(&o), "sensors").0 == "fail" && text(&o).contains("[camera]"), "{}", text(&o));
}

#[test]
fn each_part_of_a_board_is_looked_for_where_one_is_not_there() {
    let dir = tempfile::tempdir().unwrap();
    let data = flight(dir.path(), "7");
    let board = dir.path().join("board.toml");
    let plain = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(BOARD)).unwrap();
    let sensors = format!(
        "[rig]\ncalibration = \"{}\"\n[camera]\ndevices = [\"serial:L\", \"serial:R\"]\n\
         [imu]\nchip = \"mpu-6500\"\ndevice = \"/dev/no-such-bus\"\n\
         [gpio]\nled = \"no-such-chip:3\"\n",
        data.join("mav0").display()
    );
    fs::write(&board, format!("{plain}\n{sensors}")).unwrap();
    let o = stipple(&["doctor", "--board", board.to_str().unwrap(), "--set", "map.enabled=false"]);
    let said = text(&o);
    assert_eq!(o.status.code(), Some(UNAVAILABLE), "{said}");
    assert_eq!(verdict(&said, "calibration: 2 cameras").0, "ok");
    for (part, what) in
        [("cameras", "serial:L"), ("inertial unit", "/dev/no-such-bus"), ("status light", "no-such-chip")]
    {
        let (verdict, line) = verdict(&said, &format!("{part}: "));
        assert!(verdict == "fail" && line.contains(what), "{said}");
    }
    assert!(said.contains("3 checks failed"), "{said}");
}

#[test]
fn what_is_missing_of_a_recording_is_said_and_whoever_reads_may_stop() {
    let dir = tempfile::tempdir().unwrap();
    let data = flight(dir.path(), "7");
    let images: Vec<PathBuf> = fs::read_dir(data.join("mav0/cam1/data")).unwrap().map(|e| e.unwrap().path()).collect();
    images.iter().step_by(2).for_each(|image| fs::remove_file(image).unwrap());
    let said = check(&data);
    assert!(said.contains("pairs cannot be read") && said.contains("images_missing"), "{said}");
    assert_eq!(said.matches("the first: ").count(), 1, "the first image that is missing: {said}");
    let mut child = Command::new(env!("CARGO_BIN_EXE_stipple"))
        .args(["calib-check", data.to_str().unwrap()])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let o = child.wait_with_output().unwrap();
    assert_eq!(String::from_utf8_lossy(&o.stderr), "", "{:?}", o.status);
}
