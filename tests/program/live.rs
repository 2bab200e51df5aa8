//! `stipple run` on a recording in the place of sensors: it ends as a replay ends, stops when asked, and outlives what
//! `--inject` does to it, with every fault that was injected counted by what detected it.

use crate::start::{flight, signal, stipple, text, BOARD};
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use stipple::run::log::read::{read_files, runs, Message};
use stipple::run::log::{PredictedState, State};
use stipple::vio::Health;
use stipple_drivers::replay::read_trajectory;
use stipple_drivers::types::pose_at;
use stipple_drivers::{Nanos, Pose, Span};

/// A run with a map.
fn run_and_map(dataset: &Path, out: &Path, board: &str) -> Command {
    let mut command = stipple();
    command.args(["run", "--board", board, "--dataset", dataset.to_str().unwrap(), "--out", out.to_str().unwrap()]);
    command
}

fn run(dataset: &Path, out: &Path, board: &str) -> Command {
    let mut command = run_and_map(dataset, out, board);
    command.args(["--set", "map.enabled=false"]);
    command
}

fn report(out: &Path) -> Value {
    serde_json::from_slice(&fs::read(out.join("report.json")).unwrap()).unwrap()
}

fn count(report: &Value, name: &str) -> u64 {
    report[format!("count_{name}")].as_u64().unwrap_or(0)
}

/// A run with these faults injected.
fn run_with(dataset: &Path, out: &Path, rules: &str) -> Command {
    let file = dataset.with_file_name("inject.toml");
    fs::write(&file, format!("seed = 1\n{rules}")).unwrap();
    let mut command = run(dataset, out, BOARD);
    command.args(["--inject", file.to_str().unwrap()]);
    command
}

#[test]
fn a_run_on_a_recording_leaves_what_a_replay_leaves() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (flight(dir.path(), "4"), dir.path().join("out"));
    let o = run(&data, &out, BOARD).output().unwrap();
    assert!(o.status.success(), "{}", text(&o));
    let r = report(&out);
    assert!(out.join("trajectory.tum").exists() && out.join("report.html").exists());
    assert_eq!((&r["pace"], &r["heap_after_seal"]), (&"recorded".into(), &0.into()), "{}", text(&o));
    assert!(r["frames"].as_u64().unwrap() > 40 && r["ate_rmse_m"].as_f64().unwrap() < 0.02, "{}", text(&o));
    let quiet = [
        "camera_lost",
        "camera_silent",
        "imu_lost",
        "frames_missing",
        "frames_timestamp_jump",
        "imu_missing",
        "imu_frozen",
    ];
    quiet.iter().for_each(|name| assert_eq!(count(&r, name), 0, "{name}: {}", text(&o)));
}

/// With the map on, at the pace of the sensors, on a processor that has to do the GPU's work: odometry is the same, no frame is
/// lost to the mapper, and what is left is a map.
#[test]
fn a_run_maps_while_it_tracks() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (flight(dir.path(), "6"), dir.path().join("out"));
    let o = run_and_map(&data, &out, BOARD).args(["--set", "map.scale=2"]).output().unwrap();
    let (r, said) = (report(&out), text(&o));
    assert!(o.status.success(), "{said}");
    assert!(out.join("map.ply").exists() && r["heap_after_seal"] == 0, "{said}");
    assert!(r["ate_rmse_m"].as_f64().unwrap() < 0.02, "{said}");
    let frames = r["frames"].as_u64().unwrap();
    assert!(count(&r, "frames_overwritten") * 100 <= frames, "tracking waits for mapping: {said}");
    assert!(r["anchors"].as_u64().unwrap() > 0 && r["splats"].as_u64().unwrap() > 1000, "{said}");
    // A tenth of the range of grey off at most. One grey for each of the demo's views, its mean, is 11.8 to 13.7 dB.
    assert!(r["psnr_db"].as_f64().unwrap() > 20.0, "{said}");
    assert_eq!(count(&r, "gpu_failures"), 0, "{said}");
    let [keyframes, frames] = ["keyframes.tum", "trajectory.tum"].map(|name| read_trajectory(&out.join(name)).unwrap());
    assert!(keyframes.len() as u64 >= r["anchors"].as_u64().unwrap(), "{said}");
    for keyframe in &keyframes {
        let frame = frames.iter().find(|frame| frame.t == keyframe.t).unwrap();
        assert!((keyframe.pose.p - frame.pose.p).length() < 0.02, "{keyframe:?} {frame:?}");
    }
}

#[test]
fn a_run_asked_to_stop_ends_with_its_files_written() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (flight(dir.path(), "8"), dir.path().join("out"));
    let begun = Instant::now();
    let child = run(&data, &out, BOARD).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    std::thread::sleep(Duration::from_secs(3));
    signal(&child, "INT");
    let o = child.wait_with_output().unwrap();
    assert!(o.status.success() && begun.elapsed() < Duration::from_secs(7), "{}", text(&o));
    let frames = report(&out)["frames"].as_u64().unwrap();
    assert!((10..100).contains(&frames), "{frames}");
}

#[test]
fn a_board_without_sensors_is_told_what_to_write() {
    let dir = tempfile::tempdir().unwrap();
    let o =
        stipple().args(["run", "--board", BOARD, "--out", dir.path().join("out").to_str().unwrap()]).output().unwrap();
    assert_eq!(o.status.code(), Some(78));
    for words in ["[camera] devices", "[imu] chip", "[rig] calibration", "--dataset"] {
        assert!(text(&o).contains(words), "{words}: {}", text(&o));
    }
}

/// Two cables out, a stuck and a leaping camera: said, counted, outlived.
#[test]
fn sensors_that_fail_are_said_counted_and_taken_back() {
    const RULES: &str = "
        [[camera]]
        fault = \"drop\"
        start_s = 1.5
        end_s = 1.7
        [[camera]]
        fault = \"unplug\"
        start_s = 2.2
        end_s = 3.0
        [[camera]]
        fault = \"freeze\"
        start_s = 3.5
        end_s = 3.7
        [[camera]]
        fault = \"stamp_jump\"
        by_s = 60.0
        start_s = 4.0
        end_s = 4.2
        [[camera]]
        fault = \"duplicate\"
        start_s = 4.5
        end_s = 4.7
        [[imu]]
        fault = \"freeze\"
        start_s = 4.7
        end_s = 4.9
        [[imu]]
        fault = \"unplug\"
        start_s = 5.0
        end_s = 5.5
    ";
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (flight(dir.path(), "7"), dir.path().join("out"));
    let o = run_with(&data, &out, RULES).output().unwrap();
    let (r, said) = (report(&out), text(&o));
    assert!(o.status.success(), "{said}");
    let same = |injected: &[&str], detected: &[&str]| {
        let sum = |names: &[&str]| names.iter().map(|n| count(&r, n)).sum::<u64>();
        assert!(sum(injected) > 0, "{injected:?}: {said}");
        assert_eq!(sum(injected), sum(detected), "{injected:?}, {detected:?}: {said}");
    };
    same(&["injected_camera_unplugs"], &["camera_lost"]);
    same(&["injected_imu_unplugs"], &["imu_lost"]);
    same(&["injected_frames_frozen"], &["frames_frozen"]);
    same(&["injected_frames_jumped"], &["frames_timestamp_jump"]);
    same(&["injected_frames_duplicated"], &["frames_not_newer"]);
    same(&["injected_imu_frozen"], &["imu_frozen"]);
    // After a loss nobody knows how many frames there were; leaps are gaps among those believed.
    same(&["injected_frames_dropped", "injected_frames_jumped"], &["frames_missing"]);
    for words in ["camera lost", "camera is back after", "inertial unit lost", "inertial unit is back after"] {
        assert!(said.contains(words), "{words}: {said}");
    }
    assert!(r["ate_rmse_m"].as_f64().unwrap() < 0.1, "{said}");
}

/// A flight whose camera 1 suffers `fault` for two seconds, and which goes on with the other; its report and what it said.
fn flown_with_one_camera(fault: &str) -> (Value, String) {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (flight(dir.path(), "6"), dir.path().join("out"));
    let rule = format!("[[camera]]\nfault = \"{fault}\"\ncamera = 1\nstart_s = 2.0\nend_s = 4.0\n");
    let o = run_with(&data, &out, &rule).output().unwrap();
    let (r, said) = (report(&out), text(&o));
    assert!(o.status.success(), "{said}");
    assert_eq!(count(&r, "resets"), 0, "{said}");
    assert!(r["ate_rmse_m"].as_f64().unwrap() < 0.03, "{said}");
    (r, said)
}

#[test]
fn a_run_goes_on_with_one_camera_and_says_which_is_gone() {
    let (r, said) = flown_with_one_camera("unplug");
    assert_eq!((count(&r, "one_camera_lost"), count(&r, "camera_lost")), (1, 0), "{said}");
    assert!((1500..3000).contains(&count(&r, "one_camera_away_ms")) && count(&r, "frames_blank") > 20, "{said}");
    assert!(said.contains("one camera lost: camera 1") && said.contains("one camera is back after"), "{said}");
    assert!(said.contains("ms of CPU a frame to read it") && r["camera_cpu_ms"].as_f64().unwrap() > 0.0, "{said}");
}

/// While one frozen image refused the whole frame, the other camera was of no use for these two seconds.
#[test]
fn a_run_goes_on_with_one_camera_while_the_other_repeats_an_image() {
    let (r, said) = flown_with_one_camera("freeze");
    assert_eq!(count(&r, "frames_frozen"), 0, "{said}");
    assert!(count(&r, "images_frozen") > 20, "{said}");
    assert_eq!(count(&r, "images_frozen"), count(&r, "frames_blank"), "{said}");
}

/// A camera that is unplugged for three seconds, longer than odometry believes inertia alone.
#[test]
fn states_between_frames_follow_the_samples_and_go_on_without_frames() {
    const RULES: &str = "[[camera]]\nfault = \"unplug\"\nstart_s = 4.0\nend_s = 7.0\n";
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (flight(dir.path(), "9"), dir.path().join("out"));
    let o = run_with(&data, &out, RULES).args(["--set", "log.predicted_hz=100"]).output().unwrap();
    let said = text(&o);
    assert!(o.status.success() && count(&report(&out), "log_records_lost") == 0, "{said}");
    let truth = read_trajectory(&data.join("mav0/state_groundtruth_estimate0/data.csv")).unwrap();
    let (mut carried, mut tie): (Vec<PredictedState>, Option<Pose>) = (vec![], None);
    read_files(&runs(&out).unwrap()[0].files, |_, message| {
        match message {
            // The world of the estimate is tied to that of the truth by the first frame.
            Message::State(State { t_ns, estimate: Some(estimate), .. }) => {
                let truth = pose_at(&truth, Nanos(t_ns), Span(20_000_000)).unwrap();
                tie.get_or_insert(estimate.pose() * truth.inverse());
            }
            Message::Predicted(state) => carried.push(state),
            _ => {}
        }
        Ok(())
    })
    .unwrap();
    let tie = tie.unwrap();
    let error = |s: &PredictedState| {
        let truth = tie * pose_at(&truth, Nanos(s.t_ns), Span(20_000_000)).unwrap();
        (truth.p - s.estimate.pose().p).length()
    };
    let (fresh, old): (Vec<&PredictedState>, Vec<_>) = carried.iter().partition(|s| s.age_ns < 500_000_000);
    assert!(fresh.len() > 400 && old.len() > 200, "{} and {}: {said}", fresh.len(), old.len());
    let begun = fresh[0].t_ns;
    for s in carried.iter().filter(|s| s.t_ns < begun + 3_000_000_000) {
        assert!(s.epoch == 0 && error(s) < 0.02, "{} m: {s:?}", error(s));
    }
    let dead_reckoned = carried.iter().filter(|s| s.age_ns > 2_000_000_000).collect::<Vec<_>>();
    assert!(dead_reckoned.len() > 50, "{}", dead_reckoned.len());
    for s in dead_reckoned {
        assert!(Health(s.health).has(Health::DEAD_RECKONED) && s.quality == 0, "{s:?}");
        let sigma = s.sigma.unwrap()[..3].iter().map(|s| f64::from(s * s)).sum::<f64>().sqrt();
        assert!(error(s) < 4.0 * sigma + 0.02, "{} m: {s:?}", error(s));
    }
    let steps = carried.windows(2).map(|s| s[1].t_ns - s[0].t_ns);
    assert!(steps.clone().all(|step| step > 0), "stamps ascend");
    assert!(steps.filter(|step| *step > 15_000_000).count() < 5, "one every 10 ms");
}

#[test]
fn a_senseless_rule_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (flight(dir.path(), "0.3"), dir.path().join("out"));
    let o = run_with(&data, &out, "[[imu]]\nfault = \"blackout\"\n").output().unwrap();
    assert_eq!(o.status.code(), Some(78));
    assert!(text(&o).contains("inject.toml: imu, rule 1") && text(&o).contains("no light"), "{}", text(&o));
}

#[test]
fn a_flight_goes_on_when_nobody_reads_what_it_says() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (flight(dir.path(), "4"), dir.path().join("out"));
    let mut child = run_and_map(&data, &out, BOARD);
    child.args(["--set", "map.scale=4"]);
    let mut child = child.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    drop((child.stdout.take(), child.stderr.take()));
    assert!(child.wait().unwrap().success());
    assert!(out.join("report.json").is_file() && out.join("map.ply").is_file());
}
