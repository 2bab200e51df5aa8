//! The whole program on recordings: what the README claims of them holds.
#![allow(clippy::unwrap_used)]

use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;

const BOARD: &str = "board-configs/lavapipe.toml";

/// The recording, or `None` after saying that the test of this name is ignored: where there is no
/// recording at all the build knows it (`cfg(recordings)`), and the test is listed as ignored.
fn recording(test: &str, name: &str) -> Option<PathBuf> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let root = std::env::var_os("STIPPLE_RECORDINGS").map_or(beside, PathBuf::from);
    let path = root.join(name);
    if path.is_dir() {
        return Some(path);
    }
    println!("ignored: {test}: no recording {name}");
    None
}

struct Run {
    report: Value,
    said: String,
}

impl Run {
    fn number(&self, key: &str) -> f64 {
        self.report[key].as_f64().unwrap_or_else(|| panic!("{key} is {}: {}", self.report[key], self.said))
    }
}

/// Runs a subcommand of the program into a scratch folder and reads its report.
fn stipple(args: &[&str], validation: bool) -> Run {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let mut command = Command::new(env!("CARGO_BIN_EXE_stipple"));
    command.args(args).args(["--board", BOARD, "--out", out.to_str().unwrap()]);
    if validation {
        command.env("STIPPLE_VALIDATION", "1");
    }
    let output = command.current_dir(env!("CARGO_MANIFEST_DIR")).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned() + &String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{said}");
    for file in ["trajectory.tum", "report.html", "report.json"] {
        assert!(out.join(file).metadata().unwrap().len() > 0, "{file}");
    }
    let report = serde_json::from_slice(&std::fs::read(out.join("report.json")).unwrap()).unwrap();
    Run { report, said }
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn machine_hall_is_tracked_to_the_end_and_mapped_live() {
    let name = "machine_hall_is_tracked_to_the_end_and_mapped_live";
    let Some(data) = recording(name, "euroc_MH_01_easy_11s") else { return };
    let run = stipple(&["replay", data.to_str().unwrap(), "--holdout", "4"], false);
    println!("{}", run.said);
    assert!(run.number("ate_rmse_m") <= 0.05);
    assert_eq!(run.number("frames") + run.number("frames_dropped"), 220.0);
    assert_eq!(run.number("heap_after_seal"), 0.0);
    assert!(run.number("anchors") >= 1.0 && run.number("splats") > 1000.0);
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn machine_hall_gives_the_same_bits_twice() {
    let name = "machine_hall_gives_the_same_bits_twice";
    let Some(data) = recording(name, "euroc_MH_01_easy_11s") else { return };
    let odometry = ["replay", data.to_str().unwrap(), "--pace", "lockstep", "--set", "map.enabled=false"];
    let runs = [stipple(&odometry, false), stipple(&odometry, false)];
    assert_eq!(runs[0].report["vio_hash"], runs[1].report["vio_hash"]);
    assert_eq!(runs[0].report["frames"], 220);
    assert!(runs[0].number("ate_rmse_m") <= 0.05);
    assert!(runs[0].report["psnr_db"].is_null(), "not measured is null");
}

/// As many steps as two cores take in the recording's own time, without depending on how busy they are.
#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn vicon_room_reaches_twenty_decibels_from_its_true_poses() {
    let name = "vicon_room_reaches_twenty_decibels_from_its_true_poses";
    let Some(data) = recording(name, "euroc_V1_01_easy_keyframes") else { return };
    let poses = data.join("mav0/state_groundtruth_estimate0/data.csv");
    let run = stipple(
        &[
            "replay",
            data.to_str().unwrap(),
            "--poses",
            poses.to_str().unwrap(),
            "--scale",
            "2",
            "--holdout",
            "8",
            "--pace",
            "lockstep",
            "--set",
            "map.lockstep_iterations=15",
        ],
        false,
    );
    println!("{}", run.said);
    assert!(run.number("psnr_db") >= 20.0, "{}", run.said);
    assert!(run.number("psnr_heldout_db") > 15.0);
    assert!(!run.report["curve"].as_array().unwrap().is_empty());
    assert!(run.report["ate_rmse_m"].is_null(), "poses were given, not estimated");
}

#[test]
fn whole_pipeline_is_silent_under_validation() {
    let dir = tempfile::tempdir().unwrap();
    let flight = dir.path().join("flight");
    let made = Command::new(env!("CARGO_BIN_EXE_stipple"))
        .args(["sim", "demo", "--out", flight.to_str().unwrap(), "--duration", "2.5"])
        .output()
        .unwrap();
    assert!(made.status.success());
    let poses = flight.join("mav0/state_groundtruth_estimate0/data.csv");
    for extra in
        [&["--set", "map.burst_iterations=3"][..], &["--poses", poses.to_str().unwrap(), "--duration", "1"][..]]
    {
        let args = [&["replay", flight.to_str().unwrap(), "--pace", "lockstep", "--holdout", "2"][..], extra].concat();
        let run = stipple(&args, true);
        assert!(!run.said.contains("vulkan validation:"), "{}", run.said);
        assert!(run.number("iterations") > 0.0 && run.number("splats") > 0.0, "{}", run.said);
    }
}
