//! `stipple-bench .. --quick` leaves figures that can be read and drawn.

use crate::start::{self, flight, text};
use std::fs;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Command, Output, Stdio};

fn stipple_bench(args: &[&str], out: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_stipple-bench"));
    command.args(args).args(["--out", out.to_str().unwrap()]).output().unwrap()
}

fn json(file: &Path) -> serde_json::Value {
    serde_json::from_slice(&fs::read(file).unwrap()).unwrap()
}

/// Answers what it said.
fn bench(args: &[&str], out: &Path) -> String {
    let o = stipple_bench(args, out);
    assert!(o.status.success(), "{}", text(&o));
    text(&o)
}

#[test]
fn quick_sweep_writes_finite_figures_and_marks_the_default() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    bench(&["odometry", "--quick"], &out);

    let csv = fs::read_to_string(out.join("odometry.csv")).unwrap();
    let mut lines = csv.lines().map(|l| l.split(',').collect::<Vec<_>>());
    let head = lines.next().unwrap();
    let rows: Vec<_> = lines.collect();
    assert_eq!(
        rows.iter().map(|r| &r[..2]).collect::<Vec<_>>(),
        [["demo", "default"], ["demo", "vio.iterations_max=3"]]
    );
    for row in &rows {
        assert_eq!(row.len(), head.len());
        for (name, field) in head.iter().zip(row).skip(2).filter(|(name, _)| **name != "hash") {
            assert!(field.parse::<f64>().is_ok_and(f64::is_finite), "{name} is `{field}`");
        }
    }
    let json = json(&out.join("odometry.json"));
    assert!(json["odometry"][0]["ate_mm"].as_f64().unwrap() < 200.0, "{csv}");
    assert!(json["knee"].is_string() && json["settings"].as_array().unwrap().len() == 2);
    let html = fs::read_to_string(out.join("odometry.html")).unwrap();
    assert!(html.contains("<svg") && html.contains("class=\"marked\"") && !html.contains("NaN"));
    assert!(fs::read_to_string(out.join("odometry.svg")).unwrap().starts_with("<svg xmlns"));
}

#[test]
fn quick_stages_time_every_stage_of_tracker_and_estimator() {
    let dir = tempfile::tempdir().unwrap();
    bench(&["stages", "--quick"], dir.path());
    let json = json(&dir.path().join("stages.json"));
    let rows = json["stages"].as_array().unwrap();
    let timed = |stage: &str| rows.iter().any(|r| r["stage"] == stage && r["median_us"].as_f64().unwrap() > 0.0);
    for stage in ["pyramid, one image", "linearisation, all factors summed", "tracker, a frame", "estimator, a frame"] {
        assert!(timed(stage), "{stage}: {json}");
    }
    assert!(rows.len() >= 16, "{json}");
}

#[test]
fn quick_map_bench_gives_every_run_the_same_time_and_draws_it() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    bench(&["map", "--quick", "--set", "map.scale=4"], &out);

    let json = json(&out.join("map.json"));
    let rows = json["map"].as_array().unwrap();
    assert!(rows.len() >= 4, "{json}");
    for row in rows {
        let of = |name: &str| row[name].as_f64().unwrap();
        assert!(of("psnr_db").is_finite() && of("gaussians") <= of("cap") && of("gaussians") > 0.0, "{row}");
        // Time over steps times steps: the same for every run.
        let spent = of("step_ms") * of("steps");
        assert!((spent - 1500.0).abs() < 15.0, "{row}");
    }
    assert_eq!(json["mapping_s"], 1.5);
    let html = fs::read_to_string(out.join("map.html")).unwrap();
    assert!(html.contains("<svg") && html.contains("class=\"marked\"") && !html.contains("NaN"));
}

#[test]
fn quick_work_of_the_map_trains_as_long_as_it_says() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    bench(&["map", "--work", "--quick", "--set", "map.scale=4", "--set", "map.burst_iterations=2"], &out);

    let json = json(&out.join("map-work.json"));
    let rows = json["map-work"].as_array().unwrap();
    let steps: Vec<f64> = rows.iter().map(|row| row["steps"].as_f64().unwrap()).collect();
    assert!(steps.len() == 2 && steps[0] > 0.0 && steps[1] > 1.5 * steps[0], "{json}");
    assert!(rows.iter().all(|row| row["training_s"].as_f64().unwrap() > 0.0), "{json}");
}

#[test]
fn quick_kernel_bench_times_every_kernel_of_a_step() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    bench(&["kernels", "--quick"], &out);

    let json = json(&out.join("kernels.json"));
    assert!(json["copy_bytes_per_s"].as_f64().unwrap() > 0.0 && json["fma_flops_per_s"].as_f64().unwrap() > 0.0);
    let case = &json["cases"][0];
    assert!(case["throughput_steps_per_s"].as_f64().unwrap() > 0.0 && case["visible"].as_f64().unwrap() > 1900.0);
    let kernels = json["kernels"].as_array().unwrap();
    for name in [
        "project",
        "fill_lists",
        "sort_lists",
        "raster_forward",
        "raster_backward",
        "ssim_",
        "loss_",
        "project_backward",
    ] {
        let is_it = |k: &&serde_json::Value| k["kernel"].as_str().unwrap().starts_with(name);
        let k = kernels.iter().find(is_it).unwrap_or_else(|| panic!("{name} is missing: {kernels:?}"));
        assert!(k["time_ms"].as_f64().unwrap() > 0.0 && k["moved_bytes"].as_f64().unwrap() > 0.0, "{k}");
    }
    let html = fs::read_to_string(out.join("kernels.html")).unwrap();
    assert!(html.contains("<svg") && !html.contains("NaN"));
    assert!(fs::read_to_string(out.join("kernels.csv")).unwrap().lines().count() > kernels.len());
}

#[test]
fn quick_stereo_bench_writes_a_row_a_method_and_a_picture_of_each() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let said = bench(&["stereo", "--quick"], &out);

    let json = json(&out.join("stereo.json"));
    let rows = json["stereo"].as_array().unwrap();
    let row = |set: &str, method: &str| rows.iter().find(|r| r["set"] == set && r["method"] == method);
    let methods: Vec<&str> =
        ["bm", "sgbm", "sgm", "sgm_wls"].into_iter().filter(|m| !said.contains(&format!("{m} is left out"))).collect();
    assert!(!methods.is_empty(), "{said}");
    for method in methods {
        let box_ = row("hard_occlusion", method).unwrap();
        let figure = |name: &str| box_[name].as_f64().unwrap();
        let (bad1, density) = (figure("bad_1_percent"), figure("density_percent"));
        assert!(bad1 < 10.0 && density > 80.0 && figure("mean_error_px") < 1.0, "{box_}");
        assert!(figure("time_ms") > 0.0 && figure("memory_mib") > 0.0 && !box_["device"].as_str().unwrap().is_empty());
        assert_eq!(row("hard_black_eye", method).unwrap()["density_percent"], 0.0);
        assert!(out.join(format!("pictures/hard_occlusion-{method}.png")).is_file());
    }
    let html = fs::read_to_string(out.join("stereo.html")).unwrap();
    assert!(html.contains("data:image/png") && !html.contains(">NaN") && !html.contains("NaN,"));
}

#[test]
fn kernels_of_a_recording_that_is_not_there_fail_before_the_sweep() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let o = stipple_bench(&["kernels", "--recording", "no/such/folder"], &out);
    let said = String::from_utf8_lossy(&o.stderr);
    assert!(!o.status.success() && said.contains("no/such/folder"), "{said}");
    assert_eq!(said.trim().lines().count(), 1, "{said}");
    assert!(!out.exists());
}

#[test]
fn recording_is_measured_against_a_flight_without() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (flight(dir.path(), "1.5"), dir.path().join("bench"));
    let said = bench(&["record", data.to_str().unwrap(), "--passes", "1"], &out);
    assert!(said.contains("with recording over that without"), "{said}");
    let json = json(&out.join("record.json"));
    let rows = &json["record"];
    assert_eq!((&rows[0]["recording"], &rows[1]["recording"]), (&"off".into(), &"on".into()));
    let of = |name: &str| rows[1][name].as_f64().unwrap();
    assert!(of("written") + of("dropped") >= 29.0 && of("ring_at_most") >= 1.0, "{rows}");
    assert!(!out.join("recording-1").exists(), "what was measured is not kept");
}

/// The command fails where a counter misses a fault, odometry is not back within a second, or the motion jumps.
#[test]
fn unplugged_sensors_are_seen_and_cost_no_more_than_a_drone_can_bear() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let said = bench(&["faults", "--quick"], &out);
    assert_eq!(json(&out.join("faults.json"))["faults"].as_array().unwrap().len(), 4, "{said}");
}

#[test]
fn a_reader_that_stops_reading_ends_the_bench_quietly() {
    let dir = tempfile::tempdir().unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_stipple-bench"));
    command.args(["odometry", "--quick", "--out", dir.path().to_str().unwrap()]);
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    let o = child.wait_with_output().unwrap();
    assert_eq!(o.status.signal(), Some(libc::SIGPIPE), "{}", text(&o));
    assert!(!text(&o).contains("panicked") && dir.path().join("odometry.html").is_file(), "{}", text(&o));
}

/// Another reader and renderer than the mapper's sees in map.ply what the report says, as it stands: in the exposure that most
/// images have.
#[test]
fn a_viewer_shows_the_map_as_the_report_scores_it() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out, scored) = (flight(dir.path(), "2"), dir.path().join("out"), dir.path().join("ply"));
    let poses = data.join("mav0/state_groundtruth_estimate0/data.csv");
    let [from, to, poses] = [&data, &out, &poses].map(|p| p.to_str().unwrap());
    let args = ["replay", from, "--poses", poses, "--pace", "lockstep", "--steps", "15", "--scale", "1", "--out", to];
    // Each frame is a keyframe and gets 15 steps: with most of them at half the size poses and exposures are not found yet.
    let o = start::stipple().args(args).args(["--set", "map.half_size_steps=0"]).output().unwrap();
    assert!(o.status.success(), "{}", text(&o));
    let psnr = json(&out.join("report.json"))["psnr_db"].as_f64().unwrap();
    let said = bench(&["ply", out.join("map.ply").to_str().unwrap(), from, "--poses", poses], &scored);
    let training = &json(&scored.join("ply.json"))["ply"][0];
    let [stands, fitted] = ["as_it_stands_db", "exposure_fitted_db"].map(|name| training[name].as_f64().unwrap());
    // The report scores at refined poses, and gives each view its own exposure: less than a decibel of so short a flight.
    assert!(psnr > 20.0 && (stands - psnr).abs() < 1.0 && (fitted - psnr).abs() < 1.0, "{psnr}: {said}");
}
