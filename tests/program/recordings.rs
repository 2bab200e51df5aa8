//! The whole program on recordings: what the README claims of them holds.

use crate::start::{self, text, BOARD};
use serde_json::Value;
use std::path::{Path, PathBuf};
use stipple::counters::Counters;
use stipple::run::gate::ImuGate;
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::sim::scenario::Flight;
use stipple_drivers::sim::{euroc_rig, Scenario};
use stipple_drivers::source::ImuReading;
use stipple_drivers::ImuSample;

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
    let mut command = start::stipple();
    command.args(args).args(["--board", BOARD, "--out", out.to_str().unwrap()]);
    if validation {
        command.env("STIPPLE_VALIDATION", "1");
    }
    let output = command.output().unwrap();
    let said = text(&output);
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

/// Replays in lockstep without a mapper, front end and estimator on so many threads.
fn odometry(data: &Path, threads: u32) -> Run {
    let threads = format!("frontend.threads={threads}");
    let data = data.to_str().unwrap();
    stipple(&["replay", data, "--pace", "lockstep", "--set", "map.enabled=false", "--set", &threads], false)
}

/// Twice on each number of threads.
fn gives_the_same_bits(data: &Path) -> Run {
    let [first, again, two, two_again] = [1, 1, 2, 2].map(|threads| odometry(data, threads));
    for (run, threads) in [(&first, 1), (&again, 1), (&two, 2), (&two_again, 2)] {
        assert!(run.report["vio_hash"].is_string());
        assert_eq!(run.report["vio_hash"], first.report["vio_hash"]);
        assert_eq!(run.report["ate_rmse_m"], first.report["ate_rmse_m"]);
        assert_eq!(run.report["tracking_threads"], threads);
        assert_eq!(run.number("heap_after_seal"), 0.0);
        assert_eq!(run.number("count_keyframes_rejected"), 0.0, "without a mapper none is offered");
        assert!(run.number("tracking_fps") > 0.0 && run.number("tracking_cpu_ms") > 0.0);
        assert!(run.number("frontend_ms_p99") >= run.number("frontend_ms_p50"));
        assert!(run.number("tracking_ms_p50") >= run.number("estimator_ms_p50"));
    }
    let mapped = stipple(
        &["replay", data.to_str().unwrap(), "--pace", "lockstep", "--steps", "1", "--set", "map.burst_iterations=0"],
        false,
    );
    assert_eq!(mapped.report["vio_hash"], first.report["vio_hash"], "the mapper changes nothing");
    first
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn short_recordings_give_the_same_bits() {
    for name in ["euroc_V1_01_easy_static_1s", "tumvi_room1_fisheye_16"] {
        let Some(data) = recording("short_recordings_give_the_same_bits", name) else { continue };
        gives_the_same_bits(&data);
    }
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn machine_hall_gives_the_same_bits_on_one_thread_and_on_two() {
    let name = "machine_hall_gives_the_same_bits_on_one_thread_and_on_two";
    let Some(data) = recording(name, "euroc_MH_01_easy_11s") else { return };
    let run = gives_the_same_bits(&data);
    assert_eq!(run.report["frames"], 220);
    assert!(run.number("ate_rmse_m") <= 0.006 && run.number("rte_1s_m") <= 0.0065, "{}", run.said);
    assert!(run.report["psnr_db"].is_null(), "not measured is null");
}

#[test]
fn simulated_flight_gives_the_same_bits_on_one_thread_and_on_two() {
    let dir = tempfile::tempdir().unwrap();
    let flight = dir.path().join("flight");
    let made =
        start::stipple().args(["sim", "demo", "--out", flight.to_str().unwrap(), "--duration", "4"]).output().unwrap();
    assert!(made.status.success());
    // A frame that cannot be read leaves its samples to the next on either number of threads.
    for camera in ["cam0", "cam1"] {
        let images = flight.join("mav0").join(camera).join("data");
        let mut names: Vec<_> = std::fs::read_dir(&images).unwrap().map(|e| e.unwrap().path()).collect();
        names.sort();
        std::fs::write(&names[40], b"not an image").unwrap();
    }
    let run = gives_the_same_bits(&flight);
    assert_eq!(run.number("count_frames_unreadable"), 1.0);
    assert!(run.number("count_frames_carried") > 10.0, "it hovers at first: {}", run.number("count_frames_carried"));
    assert!(run.number("ate_rmse_m") < 0.02, "{}", run.said);
}

/// It crosses the view, walks ahead of the rig, and fills half of the view. Where the tracker does not hear what was rejected
/// this flight ends at 0.08 m; a rig that holds its place bears 0.02 m.
#[test]
fn a_person_in_view_does_not_carry_the_estimate_along() {
    let dir = tempfile::tempdir().unwrap();
    let flight = dir.path().join("flight");
    let made = start::stipple()
        .args(["sim", "hover", "--seed", "22", "--person", "--out", flight.to_str().unwrap()])
        .output()
        .unwrap();
    assert!(made.status.success());
    let [one, two] = [1, 2].map(|threads| odometry(&flight, threads));
    assert_eq!(one.report["vio_hash"], two.report["vio_hash"], "what is rejected is heard in the same frame");
    assert_eq!(one.number("count_resets"), 0.0);
    assert!(one.number("count_tracks_contradicted") > 20.0, "{}", one.said);
    assert!(one.number("ate_rmse_m") < 0.02, "{}", one.said);
}

/// Fewer steps than two cores take in the recording's own time, without depending on how busy they are.
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
            "--steps",
            "10",
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
    let made = start::stipple()
        .args(["sim", "demo", "--out", flight.to_str().unwrap(), "--duration", "2.5"])
        .output()
        .unwrap();
    assert!(made.status.success());
    let poses = flight.join("mav0/state_groundtruth_estimate0/data.csv");
    for extra in [
        &["--set", "map.burst_iterations=3", "--set", "map.steps_per_keyframe_max=4"][..],
        &["--poses", poses.to_str().unwrap(), "--duration", "1"][..],
    ] {
        let args = [&["replay", flight.to_str().unwrap(), "--pace", "lockstep", "--holdout", "2"][..], extra].concat();
        let run = stipple(&args, true);
        assert!(!run.said.contains("vulkan validation:"), "{}", run.said);
        assert!(run.number("iterations") > 0.0 && run.number("splats") > 0.0, "{}", run.said);
        let left_out = run.report["left_out"].as_array().unwrap();
        let kind = |what: &str| left_out.iter().find(|l| l["what"].as_str().unwrap().starts_with(what)).unwrap();
        let [times, of] = ["times", "of"].map(|name| kind("Training steps")[name].as_f64().unwrap());
        assert_eq!(of, times + run.number("iterations"), "{left_out:?}");
        assert_eq!(times > 0.0, extra[1].starts_with("map."), "only where keyframes had their steps: {left_out:?}");
        let pairs = kind("Stereo depth")["of"].as_f64().unwrap();
        assert!(pairs > 0.0 && pairs <= run.number("keyframes"), "those held out are neither: {left_out:?}");
    }
}

/// What the check for flipped bits makes of 93 thousand samples of real units, with motors on and without: nothing.
#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn no_sample_of_a_recording_is_taken_for_a_flipped_bit() {
    let name = "no_sample_of_a_recording_is_taken_for_a_flipped_bit";
    let still = |place: &str, imu: &[ImuSample]| {
        let (mut gate, counters, mut given) = (ImuGate::new(&euroc_rig().imu), Counters::default(), 0);
        for sample in imu {
            let reading = ImuReading { sample: *sample, ..ImuReading::default() };
            gate.pass(&reading, sample.t, &counters, &mut |_| given += 1);
        }
        gate.lose(&mut |_| given += 1);
        assert_eq!((given, counters.imu_repaired.get()), (imu.len(), 0), "{place}");
        assert!(imu.len() > 500, "{place}: {}", imu.len());
    };
    for place in
        ["euroc_MH_01_easy_11s", "euroc_V1_01_easy_keyframes", "euroc_V1_01_easy_static_1s", "tumvi_room1_fisheye_16"]
    {
        let Some(data) = recording(name, place) else { return };
        still(place, &Recording::open(&data, &OpenOptions::default()).unwrap().imu);
    }
    for place in ["MH_04_difficult", "V1_02_medium", "V2_02_medium"] {
        let Some(data) = recording(name, "euroc_text") else { return };
        let truth = data.join(place).join("state_groundtruth_estimate0.csv");
        let scenario = Scenario::from_euroc(&truth, Some(&data.join(place).join("imu0.csv"))).unwrap();
        let Flight::Recorded(flight) = scenario.path else { panic!("{place}") };
        still(place, &flight.imu.unwrap());
    }
}
