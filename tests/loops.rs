//! Loops on whole flights: drift goes, and a place that looks exactly like another is not taken for it.
#![allow(clippy::unwrap_used)]

use glam::{DQuat, DVec3};
use std::sync::Arc;
use stipple::config::{Board, FrontendConfig};
use stipple::loops::kept::{self, Keeper};
use stipple::loops::pose4::{wrapped, Pose4};
use stipple::loops::{LoopKeyframe, Loops};
use stipple::output::export::{export, Form, Request};
use stipple::output::metrics::{align, percentile};
use stipple::output::report::Report;
use stipple::output::OutputDir;
use stipple::run::sensors::{Input, Playback};
use stipple::run::{fly, Options, Pace, Steps};
use stipple_drivers::replay::read_trajectory;
use stipple_drivers::sim::{Scenario, Sim};
use stipple_drivers::types::pose_at;
use stipple_drivers::{Frames, Nanos, Pose, Span, TimedPose};

fn counter(report: &Report, name: &str) -> u64 {
    report.counted().find(|(n, _)| *n == name).map_or(0, |(_, n)| n)
}

/// Flies a part of the patrol of two rooms, from `begin_s` on for so long, in lockstep.
fn patrol(begin_s: f64, seconds: f64, board: &Board, out: &OutputDir, options: &Options) -> (Report, Vec<TimedPose>) {
    let [begin, duration] = [begin_s, begin_s + seconds].map(Span::from_secs);
    let scenario = Scenario { begin, duration, ..Scenario::named("patrol-two").unwrap() };
    let input = Input::simulated(&scenario, |_, _| ()).unwrap();
    let truth = input.truth.clone();
    (fly(input, board, out, options, None).unwrap().report, truth)
}

/// How far the last pose of a run's trajectory is off, where an earlier trajectory tells where the map is.
fn last_off(out: &OutputDir, truth: &[TimedPose], map: (&[TimedPose], &[TimedPose])) -> f64 {
    let at = |truth: &[TimedPose], t| pose_at(truth, t, Span(100_000_000)).unwrap().p;
    let pairs: Vec<_> = map.0.iter().map(|e| (e.pose.p, at(map.1, e.t))).collect();
    let world_from_map = align(pairs.iter().copied());
    let last = *read_trajectory(&out.file("trajectory.tum")).unwrap().last().unwrap();
    (world_from_map.transform(last.pose.p) - at(truth, last.t)).length()
}

/// The first round is mapped; a flight of the day after starts in mid-air in the second, in other light.
#[test]
fn a_later_flight_finds_itself_in_the_stored_map_and_extends_it() {
    let text = include_str!("../board-configs/lavapipe.toml");
    let small =
        ["map.scale=2", "budget.splats=6000", "map.seeds_per_anchor=600", "map.densify_max=300", "budget.keyframes=24"];
    let board = Board::parse("lavapipe.toml", text, &small.map(String::from)).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let out = OutputDir::create(dir.path()).unwrap();
    let options = Options { pace: Pace::Lockstep(Steps::PerFrame(1)), ..Options::default() };
    let (_, truth) = patrol(0.0, 16.0, &board, &out, &options);
    let first = read_trajectory(&out.file("trajectory.tum")).unwrap();
    let exported = |name: &str| export(&out.file("map"), &out.file(name), Form::Ply, &Request::default()).unwrap();
    let alone = exported("alone.ply");
    assert!(alone.gaussians > 1000 && alone.run == 0, "{alone:?}");
    let kept = |folder: &str| {
        let files = std::fs::read_dir(out.file(folder)).unwrap().map(|f| f.unwrap().path());
        let mut all: Vec<_> = files.filter(|f| f.is_file()).map(|f| (f.clone(), std::fs::read(f).unwrap())).collect();
        all.sort();
        all
    };

    // Only to find itself changes nothing of the map.
    let before = (kept("map"), kept("places"), kept("renders"));
    let localise = Options { localise_only: true, ..options.clone() };
    let (report, second) = patrol(48.0, 8.0, &board, &out, &localise);
    assert_eq!(counter(&report, "epochs_joined"), 1, "{:?}", report.loops);
    assert!(counter(&report, "places_read") > 10 && report.splats.is_none() && report.heap_after_seal == Some(0));
    let off = last_off(&out, &second, (&first, &truth));
    assert!(off < 0.15, "{off} m");
    assert!((kept("map"), kept("places"), kept("renders")) == before, "the stored map has changed");
    assert!(["map.ply", "keyframes.tum"].iter().all(|name| out.file(name).exists()), "its results are gone");

    // A flight that maps extends it, in its frame.
    let (report, second) = patrol(48.0, 8.0, &board, &out, &options);
    assert_eq!((counter(&report, "epochs_joined"), counter(&report, "epochs_kept_apart")), (1, 0));
    let off = last_off(&out, &second, (&first, &truth));
    assert!(off < 0.15, "{off} m");
    let both = exported("both.ply");
    assert!(both.run == 1 && both.runs == 2 && both.gaussians > alone.gaussians, "{alone:?} {both:?}");
    assert!(report.quality.psnr_db.unwrap() > 15.0, "{:?}", report.quality);

    // Another rig does not see these places, and flies without them.
    let mut other = Scenario { duration: Span::from_secs(3.0), ..Scenario::named("patrol-two").unwrap() };
    other.calibration.cameras[0].camera.fx *= 1.01;
    let input = Input::simulated(&other, |_, _| ()).unwrap();
    let outcome = fly(input, &board, &out, &options, None).unwrap();
    assert_eq!(counter(&outcome.report, "places_read"), 0);
    let input = Input::simulated(&other, |_, _| ()).unwrap();
    let refused = fly(input, &board, &out, &localise, None).err().map(|fault| fault.to_string());
    assert!(refused.as_ref().is_some_and(|why| why.contains("another rig")), "{refused:?}");
}

/// Keyframes at true poses, from `begin_s` on for so long, as an estimator of epoch `epoch` tells them whose frame is `odom_from_world`.
fn look_around(
    loops: &mut Loops,
    scenario: &Scenario,
    (begin_s, seconds): (f64, f64),
    epoch: u32,
    odom_from_world: Pose,
) {
    let [begin, duration] = [begin_s, begin_s + seconds].map(Span::from_secs);
    let mut sim = Sim::new(&Scenario { begin, duration, ..scenario.clone() }).unwrap();
    for i in (0..sim.frame_count()).step_by(5) {
        let mut frames = Frames::for_rig(sim.calibration());
        sim.render(i, &mut frames);
        let odom_from_body = odom_from_world * sim.truth_at(sim.taken(i)).pose;
        let (t, frames, body_from_cam) = (frames.t, &Arc::new(frames), None);
        loops.add(&LoopKeyframe { t, frames, id: None, epoch, odom_from_body, window: &[], body_from_cam });
    }
}

/// A vehicle that is carried elsewhere while its cameras are covered: nothing is known of where it is.
#[test]
fn a_kidnapped_vehicle_finds_itself_where_only_one_place_looks_like_it() {
    let carried = Pose::new(DQuat::from_rotation_z(2.0), DVec3::new(-40.0, 7.0, 3.0));
    let new = |name: &str| {
        let scenario = Scenario { seed: 3, ..Scenario::named(name).unwrap() };
        (Loops::new(&scenario.rig(), &FrontendConfig::default(), 512).unwrap(), scenario)
    };
    let (mut loops, patrol) = new("patrol-two");
    look_around(&mut loops, &patrol, (0.0, 16.0), 0, Pose::IDENTITY);
    assert!(!loops.is_lost());
    look_around(&mut loops, &patrol, (49.0, 6.0), 1, carried);
    assert!((loops.stats.epochs_joined, loops.is_lost()) == (1, false), "{:?}", loops.stats);
    let placed = loops.map_from_odom();
    let off = placed.pose.pose() * carried;
    let at = off.transform(patrol_place()) - patrol_place();
    assert!(at.length() < 0.3 && off.q.angle_between(DQuat::IDENTITY) < 0.03, "{off:?}");
    assert!((placed.epoch, placed.count > 0) == (1, true) && placed.covariance[0][0] > 0.0, "{placed:?}");

    // Two rooms that look the same: it is in one of them, and nothing tells which.
    let (mut loops, twins) = new("twins");
    look_around(&mut loops, &twins, (0.0, 52.0), 0, Pose::IDENTITY);
    let before = loops.stats.loops_ambiguous;
    look_around(&mut loops, &twins, (62.0, 8.0), 1, carried);
    assert!(loops.stats.epochs_joined == 0 && loops.is_lost(), "{:?}", loops.stats);
    assert!(loops.stats.loops_ambiguous > before, "{:?}", loops.stats);
}

/// While an estimator converges it turns keyframes of the past: what is on the disk follows. What is damaged there is told.
#[test]
fn a_tilt_that_is_found_later_is_on_the_disk() {
    let scenario = Scenario { duration: Span::from_secs(2.0), ..Scenario::named("patrol-two").unwrap() };
    let (rig, dir) = (scenario.rig(), tempfile::tempdir().unwrap());
    let folder = dir.path().join("places");
    let mut loops = Loops::new(&rig, &FrontendConfig::default(), 64).unwrap();
    loops.remember(1, &[], Some(Keeper::new(&folder, &rig, 64).unwrap()));
    let mut sim = Sim::new(&scenario).unwrap();
    let mut window = vec![];
    for (i, tilt) in [(0, 0.05), (10, 0.0)] {
        let mut frames = Frames::for_rig(sim.calibration());
        sim.render(i, &mut frames);
        let (t, truth) = (frames.t, sim.truth_at(sim.taken(i)).pose);
        let odom_from_body = Pose::new(DQuat::from_rotation_x(tilt) * truth.q, truth.p);
        let (frames, id, epoch, body_from_cam) = (&Arc::new(frames), None, 0, None);
        loops.add(&LoopKeyframe { t, frames, id, epoch, odom_from_body, window: &window, body_from_cam });
        window.push((t, truth));
    }
    assert_eq!(loops.stats.places_unkept, 0);
    drop(loops);
    let kept = kept::read(&folder, &rig).unwrap();
    assert!((kept.places.len(), kept.warnings.len()) == (2, 0), "{:?}", kept.warnings);
    let up = kept.places[0].0.tilt * (window[0].1.q.inverse() * DVec3::Z);
    assert!(up.angle_between(DVec3::Z) < 1e-6, "{up}");

    let segment =
        std::fs::read_dir(&folder).unwrap().map(|f| f.unwrap().path()).find(|f| f.metadata().unwrap().len() > 1 << 20);
    let mut bytes = std::fs::read(segment.as_ref().unwrap()).unwrap();
    bytes[6000..].iter_mut().step_by(900).for_each(|byte| *byte ^= 1);
    std::fs::write(segment.unwrap(), bytes).unwrap();
    let kept = kept::read(&folder, &rig).unwrap();
    assert!(kept.places.len() < 2 && kept.warnings.iter().any(|w| w.contains("damaged")), "{:?}", kept.warnings);
}

/// A place that the patrol passes, m.
fn patrol_place() -> DVec3 {
    DVec3::new(2.0, 2.0, 1.2)
}

/// Two rooms that look the same, 14 m apart: a, b, a, b.
#[test]
fn between_rooms_that_look_the_same_each_is_recognised_as_itself() {
    let text = include_str!("../board-configs/lavapipe.toml");
    let board = Board::parse("lavapipe.toml", text, &["map.enabled=false".into()]).unwrap();
    let scenario = Scenario { seed: 5, ..Scenario::named("twins").unwrap() };
    let input = Input::simulated(&scenario, |_, _| ()).unwrap();
    let truth = input.truth.clone();
    let dir = tempfile::tempdir().unwrap();
    let out = OutputDir::create(dir.path()).unwrap();
    let options = Options { pace: Pace::Lockstep(Steps::PerFrame(1)), ..Options::default() };
    let report = fly(input, &board, &out, &options, None).unwrap().report;
    assert!(report.loops.len() >= 10, "{} loops", report.loops.len());
    for l in &report.loops {
        let level = |t| Pose4::upright(&pose_at(&truth, Nanos(t), Span(100_000_000)).unwrap()).0;
        let is = level(l.with_ns).between(&level(l.t_ns));
        let off = (is.p - DVec3::from(l.p_m)).length();
        assert!(off < 0.5 && wrapped(is.yaw - l.yaw_rad).abs() < 0.08, "{off} m: {l:?}");
    }
    assert!(counter(&report, "loops_implausible") > 5, "the other room was seen to look the same, and refused");
    let (with, without) = (report.ate_rmse_m.unwrap(), report.odometry_ate_rmse_m.unwrap());
    assert!(with < without, "{with} {without}");
    assert_eq!(report.heap_after_seal, Some(0));
    // The files have what the report says.
    let [map, odometry] = ["trajectory.tum", "odometry.tum"].map(|name| read_trajectory(&out.file(name)).unwrap());
    assert_eq!(map.len(), odometry.len());
    let moved = map.iter().zip(&odometry).map(|(a, b)| (a.pose.p - b.pose.p).length()).fold(0.0, f64::max);
    assert!(moved > 0.01 && moved < 1.0, "{moved}");
}

/// `taskset -c 0,1 cargo test --release --test loops disturbed -- --ignored --nocapture`: ten pairs of the patrol of two rooms at
/// three times its pace (30 frames a second), with loops and without, a minute of it. Frames of all flights of a kind are pooled.
#[test]
#[ignore = "ten minutes, on a machine that does nothing else"]
fn tracking_is_not_disturbed_by_the_closing_of_loops() {
    const FLIGHTS: usize = 20;
    let scenario = Scenario { duration: Span::from_secs(60.0), ..Scenario::named("patrol-two").unwrap() };
    let mut pooled: [(Vec<f64>, Vec<f64>); 2] = Default::default();
    let (mut dropped, mut closed) = ([0, 0], 0);
    for flight in 0..FLIGHTS {
        let kind = flight % 2;
        let set = ["map.enabled=false".to_string(), format!("loops.enabled={}", kind == 1)];
        let board = Board::parse("lavapipe.toml", include_str!("../board-configs/lavapipe.toml"), &set).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let out = OutputDir::create(dir.path()).unwrap();
        let playback = Playback { speed: 3.0, repeats: false };
        let options = Options { pace: Pace::Recorded, playback, ..Options::default() };
        let input = Input::rendered(&scenario, 0, |_, _| ()).unwrap();
        let report = fly(input, &board, &out, &options, None).unwrap().report;
        dropped[kind] += report.frames_dropped.unwrap();
        closed += report.loops.len();
        let log = std::fs::read(out.file("log-0000.mcap")).unwrap();
        for message in mcap::MessageStream::new(&log).unwrap().map(Result::unwrap) {
            if message.channel.topic == "/state" {
                let state: serde_json::Value = serde_json::from_slice(&message.data).unwrap();
                pooled[kind].0.push(state["latency_ms"].as_f64().unwrap());
                pooled[kind].1.push(state["cpu_ms"].as_f64().unwrap());
            }
        }
    }
    let [without, with] = pooled.each_ref().map(|(ms, cpu)| {
        let at = |list: &[f64], share: f64| percentile(list, share).unwrap();
        (at(ms, 0.5), [0.9, 0.95, 0.99].map(|share| at(cpu, share)), ms.len())
    });
    println!("| | without loops | with, {closed} closed | ratio |\n|---|---|---|---|");
    println!("| frames; lost | {}; {} | {}; {} | |", without.2, dropped[0], with.2, dropped[1]);
    println!("| tracking, median | {:.2} ms | {:.2} ms | {:.3} |", without.0, with.0, with.0 / without.0);
    for (k, percent) in [90, 95, 99].into_iter().enumerate() {
        let [without, with] = [without.1[k], with.1[k]];
        println!("| CPU a frame, {percent} % | {without:.2} ms | {with:.2} ms | {:.3} |", with / without);
    }
    assert!(closed > FLIGHTS && dropped == [0, 0], "{closed} {dropped:?}");
    assert!(with.0 < 1.05 * without.0 && with.1[2] < 1.15 * without.1[2]);
}
