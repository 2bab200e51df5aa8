//! Rigs that are not what their calibration says: cameras that are swapped, show something else, or end early are named within
//! two seconds, and no normal rig is.
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use stipple::config::FrontendConfig;
use stipple::frontend::{Frontend, Prediction, Verdict};
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::sim::{rig_named, Scenario, Sim};
use stipple_drivers::{Calibration, Frames, Span};

/// A rig and the first seconds of what it saw.
struct Seen {
    name: String,
    rig: Calibration,
    frames: Vec<Frames>,
}

fn recorded(name: &str, seconds: f64) -> Option<Seen> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let path = std::env::var_os("STIPPLE_RECORDINGS").map_or(beside, PathBuf::from).join(name);
    let recording = path.is_dir().then(|| Recording::open(&path, &OpenOptions::default()).unwrap())?;
    let (mut reader, rig, mut frames) = (recording.reader(), recording.calibration.clone(), vec![]);
    let first = recording.frames[0].t;
    for (i, _) in recording.frames.iter().enumerate().take_while(|(_, f)| (f.t - first).secs() <= seconds) {
        let mut images = Frames::for_rig(&rig);
        reader.read(i, &mut images).unwrap();
        frames.push(images);
    }
    Some(Seen { name: name.into(), rig, frames })
}

fn simulated(scenario: &str, rig: &str, seconds: f64) -> Seen {
    let mut s = Scenario::named(scenario).unwrap();
    s.calibration = rig_named(rig).unwrap();
    (s.image_divisor, s.duration) = (2, Span::from_secs(seconds));
    let mut sim = Sim::new(&s).unwrap();
    let mut frame = |i: usize| {
        let mut frames = Frames::for_rig(sim.calibration());
        sim.render(i, &mut frames);
        frames
    };
    let frames = (0..(seconds * s.rate_hz) as usize).map(&mut frame).collect();
    Seen { name: format!("{scenario} {rig}"), rig: sim.calibration().clone(), frames }
}

/// What is found of frames changed by `change`, which gets the index of each, and after which time.
fn found(seen: &Seen, change: impl Fn(usize, &mut Frames)) -> Vec<(Verdict, [usize; 2], f64)> {
    let mut frontend = Frontend::new(&seen.rig, &FrontendConfig::default()).unwrap();
    let mut list: Vec<(Verdict, [usize; 2], f64)> = vec![];
    for (i, frames) in seen.frames.iter().enumerate() {
        let mut frames = frames.clone();
        change(i, &mut frames);
        frontend.track(&Arc::new(frames), &Prediction::default());
        let t = (seen.frames[i].t - seen.frames[0].t).secs();
        for (verdict, cameras) in frontend.verdicts().iter() {
            if !list.iter().any(|(v, c, _)| (*v, *c) == (verdict, cameras)) {
                list.push((verdict, cameras, t));
            }
        }
    }
    list
}

/// One verdict of cameras 0 and 1, within two seconds of data.
fn is_only(list: &[(Verdict, [usize; 2], f64)], verdict: Verdict) -> bool {
    matches!(list, [(v, [0, 1], t)] if *v == verdict && *t <= 2.0)
}

#[test]
fn lying_cameras_are_named_within_two_seconds_and_no_other() {
    let names =
        ["euroc_MH_01_easy_11s", "euroc_V1_01_easy_keyframes", "euroc_V1_01_easy_static_1s", "tumvi_room1_fisheye_16"];
    let mut all: Vec<Seen> = names.into_iter().filter_map(|name| recorded(name, 12.0)).collect();
    let rigs = [("demo", "mono"), ("demo", "opposed"), ("hover", "four"), ("demo", "stereo"), ("aggressive", "stereo")];
    all.extend(rigs.map(|(scenario, rig)| simulated(scenario, rig, 2.1)));
    for seen in &all {
        let name = &seen.name;
        assert_eq!(found(seen, |_, _| {}), [], "{name}, as it is");
        // The other cameras of four show the same as before; keyframes are seconds apart.
        if seen.rig.cameras.len() != 2 || name.ends_with("opposed") || name.ends_with("keyframes") {
            continue;
        }
        let swapped = found(seen, |_, frames| frames.images.swap(0, 1));
        assert!(is_only(&swapped, Verdict::Swapped), "{name}, swapped: {swapped:?}");
        let turned = found(seen, |_, frames| frames.images[1].pixels.reverse());
        assert!(is_only(&turned, Verdict::Disagree), "{name}, turned: {turned:?}");
        let covered = found(seen, |_, frames| frames.images[1].pixels.fill(0));
        assert!(is_only(&covered, Verdict::Disagree), "{name}, covered: {covered:?}");
        let first = |i: usize| if i < 40 { 0 } else { 255 };
        let uncovered = found(seen, |i, frames| frames.images[1].pixels.iter_mut().for_each(|px| *px &= first(i)));
        let after_all = uncovered.iter().any(|(verdict, _, _)| *verdict == Verdict::AgreeAfterAll);
        assert_eq!(after_all, seen.frames.len() > 60, "{name}, uncovered: {uncovered:?}");
    }
    let [.., demo, aggressive] = &all[..] else { panic!("there are simulated flights") };
    let other = found(demo, |i, frames| frames.images[1].copy_from(&aggressive.frames[i].images[1]));
    assert!(is_only(&other, Verdict::Disagree), "the camera of another scene: {other:?}");
    let mut rig = demo.rig.clone();
    rig.cameras[1].body_from_cam.q *= glam::DQuat::from_rotation_x(0.06);
    let wrong = Seen { name: "3.4 degrees".into(), rig, frames: demo.frames.clone() };
    let wrong = found(&wrong, |_, _| {});
    assert!(is_only(&wrong, Verdict::Disagree), "the calibration of another rig: {wrong:?}");
}

fn stipple(args: &[&str]) -> String {
    let o = Command::new(env!("CARGO_BIN_EXE_stipple"))
        .args(args)
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&o.stderr).into_owned() + &String::from_utf8_lossy(&o.stdout);
    assert!(o.status.success(), "{said}");
    said
}

/// A recording of so many seconds whose files `change` spoils, replayed; answers what was said, the report, and the log.
fn replayed(seconds: &str, pace: &str, change: impl Fn(&Path)) -> (String, serde_json::Value, String) {
    let dir = tempfile::tempdir().unwrap();
    let (flight, out) = (dir.path().join("flight"), dir.path().join("out"));
    stipple(&["sim", "demo", "--out", flight.to_str().unwrap(), "--duration", seconds]);
    change(&flight.join("mav0"));
    let board = ["--board", "board-configs/lavapipe.toml", "--set", "map.enabled=false"];
    let run = ["replay", flight.to_str().unwrap(), "--pace", pace, "--out", out.to_str().unwrap()];
    let said = stipple(&[&run[..], &board[..]].concat());
    let report = serde_json::from_slice(&fs::read(out.join("report.json")).unwrap()).unwrap();
    (said, report, String::from_utf8_lossy(&fs::read(out.join("log-0000.mcap")).unwrap()).into_owned())
}

#[test]
fn a_replay_says_that_cameras_are_swapped_in_every_place() {
    for pace in ["lockstep", "recorded"] {
        let (said, report, log) = replayed("2.2", pace, |mav0| {
            for part in ["data", "data.csv"] {
                let [left, right, aside] = ["cam0", "cam1", ""].map(|sensor| mav0.join(sensor).join(part));
                fs::rename(&left, &aside).unwrap();
                fs::rename(&right, &left).unwrap();
                fs::rename(&aside, &right).unwrap();
            }
        });
        let line = "cameras 0 and 1 are swapped: each sees what the other should. Exchange their names";
        assert!(said.contains(line) && log.contains(line), "{pace}: {said}");
        assert!(report["warnings"].as_u64().unwrap() >= 1, "{pace}: {said}");
    }
}

#[test]
fn a_recording_that_loses_a_camera_goes_on_with_the_other() {
    // Rows of its list that are lost; row 0 is the headline.
    let cases: [(usize, std::ops::Range<usize>, &str); 4] = [
        (1, 42..82, "ended 2.0 s before the others"),
        (0, 42..82, "ended 2.0 s before the others"),
        (0, 1..82, "has no images"),
        (0, 32..62, "gave no image for 1."),
    ];
    for (camera, lost, words) in cases {
        let (said, report, log) = replayed("4", "lockstep", |mav0| {
            let list = mav0.join(format!("cam{camera}/data.csv"));
            let rows = fs::read_to_string(&list).unwrap();
            let left = rows.lines().enumerate().filter(|(i, _)| !lost.contains(i));
            fs::write(&list, left.map(|(_, row)| format!("{row}\n")).collect::<String>()).unwrap();
        });
        let line = format!("camera {camera} {words}");
        assert!(said.contains(&line) && log.contains(&line), "{said}");
        let count = |key: &str| report[key].as_u64().unwrap_or_default();
        assert_eq!((count("frames"), count("count_images_unpaired")), (81, 0), "{said}");
        assert_eq!(count("count_cameras_away"), 1, "{said}");
        assert_eq!([count("count_images_absent"), count("count_frames_blank")], [lost.len() as u64; 2], "{said}");
        assert!(report["ate_rmse_m"].as_f64().unwrap() < 0.02, "{said}");
        assert!(count("count_frames_without_odometry") < 20, "{said}");
    }
}
