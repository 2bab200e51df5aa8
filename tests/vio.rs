//! The estimator on a made-up world (points of a room, noisy tracks and inertial samples along an
//! analytic path) and, with the tracker, on recordings. Errors are against truth after the best
//! rigid alignment.
#![allow(clippy::unwrap_used)]

#[allow(dead_code)] // each test takes of it what it needs
#[path = "bench/world.rs"]
mod world;

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;
use stipple::config::{FrontendConfig, VioConfig};
use stipple::frontend::{Frontend, Prediction, Tracks};
use stipple::mem::{heap_after_seal, seal_thread, unsealed, CountingAllocator};
use stipple::output::metrics::trajectory_error;
use stipple::vio::{Health, Odometry, Predictor, Update, Vio};
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::sim::{Flight, Scenario, Sim};
use stipple_drivers::{Calibration, Frames, ImuSample, Nanos, Pose, Span, TimedPose};
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
    assert!(holds(name, run, frames_min, ate_max));
}

/// Whether a flight was followed without a reset, as far and as well as asked; prints its figures.
fn holds(name: &str, run: &Run, frames_min: usize, ate_max: f64) -> bool {
    let e = trajectory_error(&run.estimated, &run.truth).unwrap();
    let (frames, stats) = (run.estimated.len(), run.vio.stats());
    eprintln!("{name}: ATE {:.4} m over {frames} of {frames_min} frames, {stats:?}", e.ate_rmse_m);
    frames >= frames_min && e.ate_rmse_m < ate_max && stats.resets == 0
}

#[test]
fn room_from_rest_stays_within_two_centimetres() {
    check("from rest", &simulate(Path { rest: 2.0 }, 1.0, |_| true), 195, 0.02);
}

#[test]
fn room_from_motion_stays_within_two_centimetres() {
    check("moving start", &simulate(Path { rest: -1.0 }, 0.0, |_| true), 185, 0.02);
}

/// Ten seconds of a flight under way from the start, by a unit of `rate_hz` and the first so many cameras.
fn started_in_motion(rate_hz: f64, cameras: usize) -> Run {
    let path = Path { rest: -1.0 };
    let mut world = World::new(path);
    world.rig.imu.rate_hz = rate_hz;
    let mut rig = world.rig.clone();
    rig.cameras.truncate(cameras);
    let mut vio = Vio::new(&rig, &VioConfig::default());
    let mut tracks = Tracks::default();
    let (mut estimated, mut truth, mut sample) = (Vec::new(), Vec::new(), 0);
    for frame in 0..200 {
        let t = frame as f64 * FRAME_SECS + 0.0012;
        while (sample as f64) / rate_hz < t + 1.0 / rate_hz {
            vio.on_imu(world.imu(sample as f64 / rate_hz));
            sample += 1;
        }
        world.tracks(t, &mut tracks);
        tracks.cameras[cameras..].iter_mut().for_each(|c| c.clear());
        truth.push(TimedPose { t: tracks.t, pose: path.pose(t) });
        estimated.extend(vio.on_tracks(&tracks).odometry.map(|o| TimedPose { t: o.t, pose: o.world_from_body }));
    }
    Run { estimated, truth, vio }
}

/// The inertial history is one of seconds, however fast the unit.
#[test]
fn room_from_motion_at_every_rate_of_the_unit() {
    let good = [100.0, 400.0, 1000.0, 4000.0].map(|rate_hz| {
        let run = started_in_motion(rate_hz, 2);
        let first = (run.estimated[0].t - run.truth[0].t).secs();
        holds(&format!("from motion at {rate_hz} Hz, first pose after {first:.2} s"), &run, 185, 0.02)
            && run.vio.stats().imu_overflow == 0
    });
    assert_eq!(good, [true; 4]);
}

/// One camera does not see how far things are, but with the inertial unit it tells within a second.
#[test]
fn room_from_motion_with_one_camera_at_every_rate_of_the_unit() {
    let good = [100.0, 400.0, 1000.0, 4000.0].map(|rate_hz| {
        let run = started_in_motion(rate_hz, 1);
        let first = (run.estimated[0].t - run.truth[0].t).secs();
        holds(&format!("one camera at {rate_hz} Hz, first pose after {first:.2} s"), &run, 180, 0.03) && first < 1.0
    });
    assert_eq!(good, [true; 4]);
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

/// What was published of a frame: epoch, pose, whether dead reckoning made it, its deviation along the worst axis, and truth.
struct Published {
    epoch: u32,
    pose: Pose,
    dead_reckoned: bool,
    sigma_p_m: f64,
    truth: Pose,
}

/// Ten seconds whose inertial samples and tracks are spoiled, as they would be published.
fn published(spoil: impl Fn(f64, &mut ImuSample, &mut Tracks)) -> Vec<Published> {
    let path = Path { rest: -1.0 };
    let mut world = World::new(path);
    let mut vio = Vio::new(&world.rig, &VioConfig::default());
    let (mut tracks, mut sample, mut list) = (Tracks::default(), 0, vec![]);
    for frame in 0..200 {
        let t = f64::from(frame) * FRAME_SECS + 0.0012;
        world.tracks(t, &mut tracks);
        while f64::from(sample) / RATE_HZ < t + 1.0 / RATE_HZ {
            let at = f64::from(sample) / RATE_HZ;
            let mut s = world.imu(at);
            spoil(at, &mut s, &mut Tracks::default());
            vio.on_imu(s);
            sample += 1;
        }
        spoil(t, &mut ImuSample::default(), &mut tracks);
        let u = vio.on_tracks(&tracks);
        assert!(u.odometry.is_none() || u.dead_reckoned.is_none());
        assert_eq!(u.health.has(Health::DEAD_RECKONED), u.dead_reckoned.is_some());
        let Some(o) = u.odometry.or(u.dead_reckoned) else {
            assert!(list.is_empty(), "{t}: a state is published from the first start on");
            continue;
        };
        let c = u.covariance.expect("a state has a covariance");
        let sigma_p_m = c[0][0].max(c[1][1]).max(c[2][2]).sqrt();
        let (pose, dead_reckoned) = (o.world_from_body, u.dead_reckoned.is_some());
        list.push(Published { epoch: u.epoch, pose, dead_reckoned, sigma_p_m, truth: path.pose(t) });
    }
    list
}

/// Checks that the poses of an epoch move as truth does from frame to frame; answers the epochs.
fn epochs_without_jumps(list: &[Published], jump_max_m: f64) -> Vec<u32> {
    for pair in list.windows(2).filter(|pair| pair[0].epoch == pair[1].epoch) {
        let moved = |p: &dyn Fn(&Published) -> Pose| (p(&pair[0]).inverse() * p(&pair[1])).p;
        let jump = (moved(&|p| p.pose) - moved(&|p| p.truth)).length();
        assert!(jump < jump_max_m, "{jump} m in epoch {}", pair[0].epoch);
    }
    let mut epochs: Vec<u32> = list.iter().map(|p| p.epoch).collect();
    assert!(epochs.is_sorted());
    epochs.dedup();
    epochs
}

#[test]
fn a_blinded_rig_is_carried_by_inertia_in_an_epoch_of_its_own() {
    let list = published(|t, _, tracks| {
        if (3.0..7.0).contains(&t) {
            tracks.cameras.iter_mut().for_each(|c| c.clear());
        }
    });
    // Inertia alone for four seconds: its velocity is off by less than 0.2 m/s at the end.
    assert_eq!(epochs_without_jumps(&list, 0.02), [0, 1]);
    assert!(list.iter().any(|p| p.dead_reckoned));
    assert!(!list.last().expect("it is published to the end").dead_reckoned, "it starts again when it sees");
    for p in &list {
        let error = (p.pose.p - p.truth.p - (list[0].pose.p - list[0].truth.p)).length();
        assert!(error < 0.05 + 4.0 * p.sigma_p_m, "{error} m at a deviation of {} m", p.sigma_p_m);
    }
}

#[test]
fn inertial_samples_that_lie_begin_an_epoch_where_they_are_given_up_and_one_where_they_are_contradicted() {
    let list = published(|t, sample, _| {
        if (3.0..4.0).contains(&t) {
            sample.accel_body.x += 30.0;
        }
    });
    let last = list.last().expect("it is published to the end");
    assert!(!last.dead_reckoned && last.epoch == 2, "epoch {}", last.epoch);
    let recovered: Vec<_> = list.into_iter().filter(|p| p.epoch == 2).collect();
    epochs_without_jumps(&recovered, 0.02);
    let error = (recovered[0].pose.p - recovered[0].truth.p).length();
    assert!(error < 0.05 + 4.0 * recovered[0].sigma_p_m, "{error} m, {} m", recovered[0].sigma_p_m);
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

/// Tracker and estimator of one rig, and what they made of its flight.
struct Pilot {
    frontend: Frontend,
    vio: Vio,
    predictor: Predictor,
    before: Option<Odometry>,
    period: Span,
    /// Inertial samples taken so far.
    taken: usize,
    estimated: Vec<TimedPose>,
    /// Time of tracker and estimator.
    secs: [f64; 2],
}

impl Pilot {
    fn new(rig: &Calibration) -> Pilot {
        Pilot {
            frontend: Frontend::new(rig, &FrontendConfig::default()).unwrap(),
            vio: Vio::new(rig, &VioConfig::default()),
            predictor: Predictor::new(rig, &VioConfig::default()),
            before: None,
            period: Span::from_secs(1.0 / rig.imu.rate_hz),
            taken: 0,
            estimated: Vec::new(),
            secs: [0.0; 2],
        }
    }

    /// One more frame, after the samples up to it.
    fn see(&mut self, frames: &Arc<Frames>, imu: &[ImuSample]) -> Update {
        for s in imu[self.taken..].iter().take_while(|s| s.t <= frames.t + self.period) {
            self.vio.on_imu(*s);
            self.predictor.on_imu(*s);
            self.taken += 1;
        }
        let start = Instant::now();
        let prev_from_now = self.predictor.motion_to(frames.t, self.before.as_ref());
        self.before = self.vio.odometry();
        let tracks = self.frontend.track(frames, &Prediction { prev_from_now });
        let middle = Instant::now();
        let update = self.vio.on_tracks(tracks);
        self.secs[0] += (middle - start).as_secs_f64();
        self.secs[1] += middle.elapsed().as_secs_f64();
        self.estimated.extend(update.odometry.map(|o| TimedPose { t: o.t, pose: o.world_from_body }));
        if std::env::var("VIO_TRACE").is_ok() {
            trace(tracks, &update);
        }
        update
    }
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
    let mut pilot = Pilot::new(rig);
    let mut frames = Arc::new(Frames::for_rig(rig));
    for i in 0..count {
        read(i, Arc::make_mut(&mut frames));
        pilot.see(&frames, imu);
    }
    (Run { estimated: pilot.estimated, truth, vio: pilot.vio }, pilot.secs.map(|s| 1e3 * s / count as f64))
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

fn trace(tracks: &Tracks, u: &Update) {
    let [left, right] = [0, 1].map(|c| tracks.cameras[c].len());
    let t = tracks.t.0 as f64 * 1e-9;
    let Some(o) = u.odometry else { return eprintln!("{t:.2}: not running, {left}/{right} tracks") };
    eprintln!(
        "{t:.2}: kf {} tracks {left}/{right} connected {} v {:.3} bg {:.4} ba {:.3} q {} {:?}",
        u.keyframe as u8,
        u.connected,
        o.v_world,
        o.gyro_bias,
        o.accel_bias,
        u.quality,
        u.health.reasons().collect::<Vec<_>>()
    );
}

/// Cameras of the rig, and which of them is black from when on, s.
type Eyes = (&'static str, usize, Option<(usize, f64)>);

/// Flies once for each of `eyes` on the same frames, which are given by `read`.
fn fly_with(
    rig: &Calibration,
    imu: &[ImuSample],
    truth: &[TimedPose],
    stamps: &[Nanos],
    mut read: impl FnMut(usize, &mut Frames),
    eyes: &[Eyes],
) -> Vec<Run> {
    let mut seen = Frames::for_rig(rig);
    let mut pilots: Vec<_> = eyes
        .iter()
        .map(|(_, cameras, _)| {
            let mut rig = rig.clone();
            rig.cameras.truncate(*cameras);
            (Pilot::new(&rig), Arc::new(Frames::for_rig(&rig)))
        })
        .collect();
    for (i, stamp) in stamps.iter().enumerate() {
        read(i, &mut seen);
        let t = (*stamp - stamps[0]).secs();
        for ((pilot, frames), (_, cameras, black)) in pilots.iter_mut().zip(eyes) {
            let given = Arc::make_mut(frames);
            given.t = seen.t;
            for c in 0..*cameras {
                given.images[c].pixels.clone_from(&seen.images[c].pixels);
                if black.is_some_and(|(camera, from)| camera == c && t >= from) {
                    given.images[c].pixels.fill(0);
                }
            }
            pilot.see(frames, imu);
        }
    }
    pilots.into_iter().map(|(p, _)| Run { estimated: p.estimated, truth: truth.to_vec(), vio: p.vio }).collect()
}

const PAUSED: [Eyes; 5] = [
    ("stereo", 2, None),
    ("left black", 2, Some((0, 9.0))),
    ("right black", 2, Some((1, 9.0))),
    ("mono", 1, None),
    ("left black from the start", 2, Some((0, 0.0))),
];

fn check_pauses(seed: u64, scenario: Scenario, ate_max: f64) {
    let least = (scenario.duration.secs() * scenario.rate_hz) as usize - 40;
    let mut sim = Sim::new(&Scenario { seed, ..scenario }).unwrap();
    let (rig, imu, truth) = (sim.calibration().clone(), sim.imu().to_vec(), sim.truth());
    let stamps: Vec<Nanos> = (0..sim.frame_count()).map(|i| sim.stamp(i)).collect();
    let runs = fly_with(&rig, &imu, &truth, &stamps, |i, out| sim.render(i, out), &PAUSED);
    let good = runs
        .iter()
        .zip(PAUSED)
        .map(|(run, eyes)| holds(&format!("pauses, seed {seed}, {}", eyes.0), run, least, ate_max));
    assert!(good.fold(true, |all, one| all & one));
}

/// One camera that rests sees nothing new and triangulates nothing; the estimate must stand all the same.
#[test]
fn flight_that_rests_and_hovers_goes_on_with_any_camera() {
    let mut scenario = Scenario::named("pauses").unwrap();
    scenario.path = Flight::Pauses { rest: 8.0, hover: 6.0 };
    scenario.duration = Span::from_secs(34.0);
    check_pauses(4, scenario, 0.03);
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn recording_goes_on_with_either_camera_black() {
    let Some(dir) = recording("euroc_MH_01_easy_11s") else { return };
    let r = Recording::open(&dir, &OpenOptions::default()).unwrap();
    let stamps: Vec<Nanos> = r.frames.iter().map(|f| f.t).collect();
    let mut reader = r.reader();
    let eyes = [("left black", 2, Some((0, 5.0))), ("right black", 2, Some((1, 5.0))), ("mono", 1, None)];
    let runs = fly_with(&r.calibration, &r.imu, &r.truth, &stamps, |i, out| reader.read(i, out).unwrap(), &eyes);
    let good = runs.iter().zip(eyes).map(|(run, eyes)| holds(&format!("MH_01, {}", eyes.0), run, 180, 0.02));
    assert!(good.fold(true, |all, one| all & one));
}

/// One camera, its recording begun in flight: the scale is known before the first pose.
#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn one_camera_starts_in_flight_on_a_recording() {
    let Some(dir) = recording("euroc_MH_01_easy_11s") else { return };
    let r = Recording::open(&dir, &OpenOptions::default()).unwrap();
    let mut reader = r.reader();
    let good = [40, 60, 80, 100].map(|first| {
        let stamps: Vec<Nanos> = r.frames[first..].iter().map(|f| f.t).collect();
        let begun = r.imu.partition_point(|s| s.t < stamps[0]);
        let read = |i: usize, out: &mut Frames| reader.read(first + i, out).unwrap();
        let runs = fly_with(&r.calibration, &r.imu[begun..], &r.truth, &stamps, read, &[("mono", 1, None)]);
        holds(&format!("MH_01 from frame {first}, mono"), &runs[0], stamps.len() - 20, 0.02)
    });
    assert_eq!(good, [true; 4]);
}

/// The whole of it: minutes.
#[test]
#[ignore = "takes minutes"]
fn minute_at_rest_is_survived_with_any_camera() {
    (4..=6).for_each(|seed| check_pauses(seed, Scenario::named("pauses").unwrap(), 0.02));
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
    let mut predictor = Predictor::new(&world.rig, &VioConfig::default());
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
            predictor.on_imu(*s);
        }
        predictor.on_update(&vio.on_tracks(&tracks));
        assert_eq!(predictor.state_at(tracks.t + Span(10_000_000)).is_some(), vio.is_running());
    }
    let heap = heap_after_seal() - before;
    unsealed(|| {
        assert!(vio.is_running());
        assert_eq!(heap, 0);
    });
}
