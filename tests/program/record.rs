//! `stipple record` and `stipple run --record`: what was recorded before a kill reads back whole, and recording takes
//! nothing from odometry.

use crate::start::{flight, stipple, text, BOARD};
use std::fs;
use std::path::Path;
use std::process::{Child, Stdio};
use std::time::{Duration, Instant};
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::Frames;

fn recording(dataset: &Path, out: &Path, format: &str) -> Child {
    let mut command = stipple();
    command.args(["record", "--board", BOARD, "--dataset", dataset.to_str().unwrap(), "--out", out.to_str().unwrap()]);
    command.args(["--format", format]).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

/// Kills without warning once `there` holds, twenty seconds at most.
fn kill_when(mut child: Child, there: impl Fn() -> bool) {
    let begun = Instant::now();
    while !there() && begun.elapsed() < Duration::from_secs(20) {
        std::thread::sleep(Duration::from_millis(7));
    }
    child.kill().unwrap();
    child.wait().unwrap();
}

/// Every frame of a recording, read.
fn frames_of(dataset: &Path) -> Vec<Frames> {
    let r = Recording::open(dataset, &OpenOptions::default()).unwrap();
    let mut reader = r.reader();
    let read = |i| {
        let mut frames = Frames::for_rig(&r.calibration);
        reader.read(i, &mut frames).unwrap();
        frames
    };
    (0..r.frames.len()).map(read).collect()
}

#[test]
fn what_was_recorded_before_a_kill_reads_back_whole() {
    let dir = tempfile::tempdir().unwrap();
    let (data, euroc, mcap) = (flight(dir.path(), "3"), dir.path().join("euroc"), dir.path().join("mcap"));
    let rows = || fs::read_to_string(euroc.join("mav0/cam1/data.csv")).map_or(0, |t| t.lines().count());
    kill_when(recording(&data, &euroc, "euroc"), || rows() > 20);
    let (back, truth) = (frames_of(&euroc), frames_of(&data));
    assert!(back.len() >= 19 && back.len() < truth.len(), "{}", back.len());
    assert!(back.iter().zip(&truth).all(|(a, b)| a.t == b.t && a.images == b.images));

    let file = mcap.join("recording-000.mcap");
    let bytes = || fs::metadata(&file).map_or(0, |m| m.len());
    kill_when(recording(&data, &mcap, "mcap"), || bytes() > 1_500_000);
    let read = fs::read(&file).unwrap();
    let open = mcap::MessageStream::new_with_options(&read, mcap::read::Options::IgnoreEndMagic.into()).unwrap();
    let messages: Vec<_> = open.map_while(Result::ok).collect();
    let of = |topic: &str| messages.iter().filter(|m| m.channel.topic == topic).count();
    let (left, right, samples) = (of("/cam0/image"), of("/cam1/image"), of("/imu0"));
    assert!(left >= 10 && left == right && samples > 50, "{left} {right} {samples}");
    // Behind the CDR of "cam1" and "png" the picture begins.
    let image = messages.iter().find(|m| m.channel.topic == "/cam1/image").unwrap();
    let at = image.data.windows(8).position(|w| w == b"\x89PNG\r\n\x1a\n").unwrap();
    let stamp = |at: usize| i64::from(u32::from_le_bytes(image.data[at..at + 4].try_into().unwrap()));
    assert_eq!((at, stamp(4) * 1_000_000_000 + stamp(8)), (36, truth[0].t.0));
}

#[test]
fn a_whole_recording_in_mcap_has_every_message_and_the_calibration() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (flight(dir.path(), "1"), dir.path().join("mcap"));
    let o = recording(&data, &out, "mcap").wait_with_output().unwrap();
    assert!(o.status.success(), "{}", text(&o));
    let read = fs::read(out.join("recording-000.mcap")).unwrap();
    let summary = mcap::Summary::read(&read).unwrap().unwrap();
    let names: Vec<&str> = summary.attachment_indexes.iter().map(|a| a.name.as_str()).collect();
    assert_eq!(names, ["cam0/sensor.yaml", "cam1/sensor.yaml", "imu0/sensor.yaml"]);
    let count = |topic: &str| {
        let channel = summary.channels.values().find(|c| c.topic == topic).unwrap();
        summary.stats.as_ref().unwrap().channel_message_counts[&channel.id]
    };
    let frames = frames_of(&data).len() as u64;
    assert_eq!((count("/cam0/image"), count("/cam1/image")), (frames, frames));
    assert!(count("/imu0") >= 195);
}

#[test]
fn a_run_that_records_plays_back_as_it_flew() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out, kept) = (flight(dir.path(), "3"), dir.path().join("out"), dir.path().join("kept"));
    let arg = |path: &Path| path.to_str().unwrap().to_string();
    let o = stipple()
        .args(["run", "--board", BOARD, "--dataset", &arg(&data), "--out", &arg(&out), "--record", &arg(&kept)])
        .args(["--set", "map.enabled=false"])
        .output()
        .unwrap();
    assert!(o.status.success(), "{}", text(&o));
    let report: serde_json::Value = serde_json::from_slice(&fs::read(out.join("report.json")).unwrap()).unwrap();
    assert_eq!((&report["count_record_frames_dropped"], &report["heap_after_seal"]), (&0.into(), &0.into()));
    let (back, truth) = (frames_of(&kept), frames_of(&data));
    assert_eq!((back.len(), report["count_record_frames_written"].as_u64()), (truth.len(), Some(truth.len() as u64)));
    assert!(back.iter().zip(&truth).all(|(a, b)| a.t == b.t && a.images == b.images));
    let again =
        stipple().args(["record", "--board", BOARD, "--dataset", &arg(&data), "--out", &arg(&kept)]).output().unwrap();
    assert_eq!(again.status.code(), Some(73), "a recording is not written over: {}", text(&again));
}
