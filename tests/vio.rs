//! The estimator on a made-up world (points of a room, noisy tracks and inertial samples along an
//! analytic path) and, with the tracker, on recordings. Errors are against truth after the best
//! rigid alignment.
#![allow(clippy::unwrap_used)]

#[allow(dead_code)] // each test takes of it what it needs
#[path = "bench/world.rs"]
mod world;

use glam::DVec3;
use std::path::PathBuf;
use std::sync::Arc;
use stipple::config::{FrontendConfig, VioConfig};
use stipple::frontend::{Frontend, Prediction, Tracks};
use stipple::mem::{heap_after_seal, seal_thread, unsealed, CountingAllocator};
use stipple::output::metrics::trajectory_error;
use stipple::vio::{Predictor, Update, Vio};
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::sim::{Scenario, Sim};
use stipple_drivers::{Calibration, Frames, ImuSample, Span, TimedPose};
use world::{Path, World, FRAME_SECS, RATE_HZ};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

struct Run {
    estimated: Vec<TimedPose>,
    truth: Vec<TimedPose>,
    vio: Vio,
}

/// Ten seconds after `before` seconds of inertial samples alone; frames for which `keep` is false are lost.
fn simulate(path: Path, before: f64, keep: impl Fn(usize) -> bool) -> Run {
    simulate_spoiled(path, before, keep, |_| true, |_, _| {})
}

/// As above, with inertial samples for which `keep_imu` is false lost, and tracks spoiled.
fn simulate_spoiled(
    path: Path,
    before: f64,
    keep: impl Fn(usize) -> bool,
    keep_imu: impl Fn(f64) -> bool,
    spoil: impl Fn(usize, &mut Tracks),
) -> Run {
    let mut world = World::new(path);
    let mut vio = Vio::new(&world.rig, &VioConfig::default());
    let mut tracks = Tracks::default();
    let (mut estimated, mut truth) = (Vec::new(), Vec::new());
    let mut sample = 0;
    for frame in 0..200 {
        let t = before + frame as f64 * FRAME_SECS + 0.0012;
        while (sample as f64) / RATE_HZ < t + 1.0 / RATE_HZ {
            let s = world.imu(sample as f64 / RATE_HZ);
            if keep_imu(sample as f64 / RATE_HZ) {
                vio.on_imu(s);
            }
            sample += 1;
        }
        world.tracks(t, &mut tracks);
        spoil(frame, &mut tracks);
        if !keep(frame) {
            continue;
        }
        truth.push(TimedPose { t: tracks.t, pose: path.pose(t) });
        if let Some(o) = vio.on_tracks(&tracks).odometry {
            estimated.push(TimedPose { t: o.t, pose: o.world_from_body });
        }
    }
    Run { estimated, truth, vio }
}

fn check(name: &str, run: &Run, frames_min: usize, ate_max: f64) {
    let e = trajectory_error(&run.estimated, &run.truth).unwrap();
    eprintln!("{name}: ATE {:.4} m over {} frames, {:?}", e.ate_rmse_m, run.estimated.len(), run.vio.stats());
    assert!(run.estimated.len() >= frames_min, "{name}: {} frames", run.estimated.len());
    assert!(e.ate_rmse_m < ate_max, "{name}: ATE {} m", e.ate_rmse_m);
    assert_eq!(run.vio.stats().resets, 0);
}

#[test]
fn room_from_rest_stays_within_two_centimetres() {
    check("from rest", &simulate(Path { rest: 2.0 }, 1.0, |_| true), 195, 0.02);
}

#[test]
fn room_from_motion_stays_within_two_centimetres() {
    check("moving start", &simulate(Path { rest: -1.0 }, 0.0, |_| true), 185, 0.02);
}

#[test]
fn room_with_lost_frames_stays_within_two_centimetres() {
    let keep = |i: usize| i % 7 != 3 && !(90..96).contains(&i);
    check("lost frames", &simulate(Path { rest: -1.0 }, 0.0, keep), 155, 0.02);
}

#[test]
fn hole_in_the_inertial_stream_is_bridged_by_vision() {
    let run = simulate_spoiled(Path { rest: -1.0 }, 0.0, |_| true, |t| !(4.0..4.3).contains(&t), |_, _| {});
    check("inertial hole", &run, 185, 0.03);
}

#[test]
fn second_without_tracks_is_bridged_by_inertia() {
    let dark = |frame: usize, tracks: &mut Tracks| {
        if (80..100).contains(&frame) {
            tracks.cameras.iter_mut().for_each(|c| c.clear());
        }
    };
    check("dark second", &simulate_spoiled(Path { rest: -1.0 }, 0.0, |_| true, |_| true, dark), 185, 0.10);
}

#[test]
fn garbage_tracks_give_finite_odometry_or_none() {
    let garbage = |frame: usize, tracks: &mut Tracks| {
        if frame % 3 == 1 || frame > 120 {
            for camera in tracks.cameras.iter_mut() {
                for (i, t) in camera.iter_mut().enumerate() {
                    t.px = [((i * 7919 + frame * 31) % 752) as f32, if i % 5 == 0 { f32::NAN } else { 100.0 }];
                }
            }
        }
    };
    let run = simulate_spoiled(Path { rest: -1.0 }, 0.0, |_| true, |_| true, garbage);
    assert!(run.estimated.iter().all(|e| e.pose.is_finite()));
}

fn recording(name: &str) -> Option<PathBuf> {
    let root = std::env::var("STIPPLE_RECORDINGS")
        .map(PathBuf::from)
        .unwrap_or_else(|_| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"));
    let path = root.join(name);
    if !path.is_dir() {
        eprintln!("ignored: {name}: no recordings");
        return None;
    }
    Some(path)
}

/// Tracks and estimates frames given by `read`; answers estimate and truth, and mean ms a frame of tracker
/// and estimator.
fn follow(
    rig: &Calibration,
    imu: &[ImuSample],
    truth: Vec<TimedPose>,
    count: usize,
    mut read: impl FnMut(usize, &mut Frames),
) -> (Run, [f64; 2]) {
    let mut frontend = Frontend::new(rig, &FrontendConfig::default()).unwrap();
    let mut vio = Vio::new(rig, &VioConfig::default());
    let mut predictor = Predictor::new(rig, &VioConfig::default());
    let mut before = None;
    let mut frames = Arc::new(Frames::for_rig(rig));
    let mut estimated = Vec::new();
    let mut secs = [0.0; 2];
    let mut imu = imu.iter().peekable();
    let period = Span::from_secs(1.0 / rig.imu.rate_hz);
    for i in 0..count {
        read(i, Arc::make_mut(&mut frames));
        while let Some(s) = imu.next_if(|s| s.t <= frames.t + period) {
            vio.on_imu(*s);
            predictor.on_imu(*s);
        }
        let start = std::time::Instant::now();
        let prev_from_now = predictor.motion_to(frames.t, before.as_ref());
        before = vio.odometry();
        let tracks = frontend.track(&frames, &Prediction { prev_from_now });
        let middle = std::time::Instant::now();
        let update = vio.on_tracks(tracks);
        secs[0] += (middle - start).as_secs_f64();
        secs[1] += middle.elapsed().as_secs_f64();
        if std::env::var("VIO_TRACE").is_ok() {
            trace(i, tracks, &vio, &update, &truth);
        }
        if let Some(o) = update.odometry {
            estimated.push(TimedPose { t: o.t, pose: o.world_from_body });
        }
    }
    (Run { estimated, truth, vio }, secs.map(|s| 1e3 * s / count as f64))
}

fn replay(name: &str) -> Option<(Run, [f64; 2])> {
    let recording = Recording::open(&recording(name)?, &OpenOptions::default()).unwrap();
    let mut reader = recording.reader();
    let truth = recording.truth.clone();
    let count = recording.frames.len();
    Some(follow(&recording.calibration, &recording.imu, truth, count, |i, out| reader.read(i, out).unwrap()))
}

fn fly(scenario: &Scenario) -> (Run, [f64; 2]) {
    let mut sim = Sim::new(scenario).unwrap();
    let (rig, imu, truth) = (sim.calibration().clone(), sim.imu().to_vec(), sim.truth());
    follow(&rig, &imu, truth, sim.frame_count(), |i, out| sim.render(i, out))
}

fn trace(i: usize, tracks: &Tracks, vio: &Vio, u: &Update, truth: &[TimedPose]) {
    let Some(o) = u.odometry else { return eprintln!("{i}: not running, {} tracks", tracks.cameras[0].len()) };
    let g = stipple_drivers::types::pose_at(truth, o.t, Span::from_secs(0.1));
    let tilt = g.map_or(f64::NAN, |g| {
        let (a, b) = (o.world_from_body.q.conjugate() * DVec3::Z, g.q.conjugate() * DVec3::Z);
        a.angle_between(b).to_degrees()
    });
    eprintln!(
        "{i}: kf {} tracks {}/{} connected {} iterations {} tilt {tilt:.2} v {:.3} bg {:.4} ba {:.3}",
        u.keyframe as u8,
        tracks.cameras[0].len(),
        tracks.cameras[1].len(),
        u.connected,
        vio.stats().solver_iterations,
        o.v_world,
        o.gyro_bias,
        o.accel_bias
    );
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn shaken_recording_stays_within_five_centimetres() {
    let Some((run, ms)) = replay("euroc_MH_01_easy_11s") else { return };
    eprintln!("tracker {:.1} ms, estimator {:.1} ms a frame", ms[0], ms[1]);
    check("MH_01 11 s", &run, 205, 0.05);
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn resting_recording_starts_at_rest_and_stays() {
    let Some((run, _)) = replay("euroc_V1_01_easy_static_1s") else { return };
    // Its motors are on: it shakes as if it flew.
    assert!(run.vio.stats().zero_velocity_updates >= 4, "{:?}", run.vio.stats());
    check("V1_01 at rest", &run, 8, 0.005);
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn fisheye_recording_is_followed() {
    let Some((run, _)) = replay("tumvi_room1_fisheye_16") else { return };
    check("TUM-VI room1, 16 frames", &run, 4, 0.01);
}

#[test]
fn rendered_aggressive_flight_is_followed() {
    let mut scenario = Scenario::named("aggressive").unwrap();
    (scenario.image_divisor, scenario.duration) = (2, Span::from_secs(6.0));
    check("aggressive", &fly(&scenario).0, 110, 0.05);
}

/// Recorded flights and their real inertial samples, rendered: minutes; `cargo test --test vio -- --ignored --nocapture`.
#[test]
#[ignore = "takes minutes"]
fn rendered_recorded_flights_are_followed() {
    for name in ["V1_02_medium", "V2_02_medium", "MH_04_difficult"] {
        let Some(dir) = recording("euroc_text").map(|d| d.join(name)) else { return };
        let truth = dir.join("state_groundtruth_estimate0.csv");
        let mut scenario = Scenario::from_euroc(&truth, Some(&dir.join("imu0.csv"))).unwrap();
        scenario.duration = Span::from_secs(40.0);
        let (run, ms) = fly(&scenario);
        eprintln!("{name}: tracker {:.1} ms, estimator {:.1} ms a frame", ms[0], ms[1]);
        check(name, &run, 500, 0.3);
    }
}

#[test]
fn heap_is_untouched_after_construction() {
    let path = Path { rest: -1.0 };
    let mut world = World::new(path);
    let mut vio = Vio::new(&world.rig, &VioConfig::default());
    let mut tracks = Tracks::default();
    let imu: Vec<ImuSample> = (0..500).map(|i| world.imu(i as f64 / RATE_HZ)).collect();
    let mut imu = imu.iter().peekable();
    seal_thread();
    let before = heap_after_seal();
    for frame in 0..40 {
        let t = frame as f64 * FRAME_SECS + 0.0012;
        unsealed(|| world.tracks(t, &mut tracks));
        while let Some(s) = imu.next_if(|s| s.t <= tracks.t + Span(5_000_000)) {
            vio.on_imu(*s);
        }
        vio.on_tracks(&tracks);
        vio.predict(tracks.t + Span(10_000_000));
    }
    let heap = heap_after_seal() - before;
    unsealed(|| {
        assert!(vio.is_running());
        assert_eq!(heap, 0);
    });
}
