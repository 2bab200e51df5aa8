//! The estimator on a made-up world (points of a room, noisy tracks and inertial samples along an
//! analytic path) and, with the tracker, on recordings. Errors are against truth after the best
//! rigid alignment.
#![allow(clippy::unwrap_used)]

use glam::{DMat3, DQuat, DVec2, DVec3};
use std::path::PathBuf;
use stipple::config::{FrontendConfig, VioConfig};
use stipple::frontend::{Frontend, Prediction, Track, Tracks};
use stipple::mem::{heap_after_seal, seal_thread, unsealed, CountingAllocator};
use stipple::output::metrics::trajectory_error;
use stipple::vio::Vio;
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::{
    Calibration, Camera, Frames, ImuCalibration, ImuSample, Lens, Nanos, Pose, RigCamera, Span, TimedPose,
};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

/// SplitMix64; normal values by summing twelve uniforms.
struct Noise(u64);

impl Noise {
    fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }
    fn uniform(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }
    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform()).sum::<f64>() - 6.0
    }
    fn vector(&mut self) -> DVec3 {
        DVec3::new(self.normal(), self.normal(), self.normal())
    }
}

const RATE_HZ: f64 = 200.0;
const FRAME_SECS: f64 = 0.05;
const SIGMA_PX: f64 = 0.3;
const GYRO_BIAS: DVec3 = DVec3::new(-0.003, 0.02, 0.07);
const ACCEL_BIAS: DVec3 = DVec3::new(-0.02, 0.1, 0.05);

fn calibration() -> Calibration {
    let lens = Lens::Radtan { k1: -0.28, k2: 0.07, p1: 2e-4, p2: 2e-5 };
    let camera = Camera { width: 752, height: 480, fx: 458.0, fy: 457.0, cx: 367.0, cy: 248.0, lens };
    let q = DQuat::from_mat3(&DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X));
    let eye = |y: f64| RigCamera { camera, body_from_cam: Pose::new(q, DVec3::new(0.02, y, 0.01)) };
    let imu =
        ImuCalibration { rate_hz: RATE_HZ, gyro_noise: 1.7e-4, gyro_walk: 2e-5, accel_noise: 2e-3, accel_walk: 3e-3 };
    Calibration { cameras: vec![eye(0.055), eye(-0.055)], imu }
}

/// Position and orientation at `t`; at rest before `rest`.
#[derive(Clone, Copy)]
struct Path {
    rest: f64,
}

impl Path {
    fn pose(&self, t: f64) -> Pose {
        // Amplitude grows smoothly from rest.
        let u = ((t - self.rest) / 2.0).clamp(0.0, 1.0);
        let a = if self.rest < 0.0 { 1.0 } else { u * u * u * (10.0 - 15.0 * u + 6.0 * u * u) };
        let s = |k: f64, f: f64| (k * t + f).sin();
        let p = DVec3::new(0.8 * s(1.1, 0.0) + 0.1 * s(5.0, 1.0), 0.7 * s(0.9, 0.5), 0.4 * s(1.7, 1.0)) * a;
        let q = DQuat::from_euler(
            glam::EulerRot::ZYX,
            0.6 * s(0.7, 0.0) * a,
            0.25 * s(1.3, 0.3) * a,
            0.3 * s(1.1, 2.0) * a,
        );
        Pose::new(q, p)
    }

    fn imu(&self, t: f64) -> (DVec3, DVec3) {
        const H: f64 = 1e-4;
        let (a, b, c) = (self.pose(t - H), self.pose(t), self.pose(t + H));
        let turn = a.q.conjugate() * c.q;
        let gyro = turn.to_scaled_axis() / (2.0 * H);
        let accel = (a.p + c.p - 2.0 * b.p) / (H * H) - DVec3::new(0.0, 0.0, -9.81);
        (gyro, b.q.conjugate() * accel)
    }
}

/// Points on the walls of a room of 8 x 8 x 4 m.
fn room(n: usize, noise: &mut Noise) -> Vec<DVec3> {
    let wall = |noise: &mut Noise| {
        let (u, v) = (8.0 * noise.uniform() - 4.0, 4.0 * noise.uniform() - 2.0);
        match noise.bits() % 6 {
            0 => DVec3::new(4.0, u, v),
            1 => DVec3::new(-4.0, u, v),
            2 => DVec3::new(u, 4.0, v),
            3 => DVec3::new(u, -4.0, v),
            4 => DVec3::new(u, 2.0 * v, 2.0),
            _ => DVec3::new(u, 2.0 * v, -2.0),
        }
    };
    (0..n).map(|_| wall(noise)).collect()
}

/// Tracks of a room along a path, as a tracker would make them: a point that leaves gets a new id.
struct World {
    rig: Calibration,
    points: Vec<DVec3>,
    ids: Vec<Option<u64>>,
    next_id: u64,
    noise: Noise,
    path: Path,
}

impl World {
    fn new(path: Path) -> World {
        let mut noise = Noise(7);
        let points = room(1500, &mut noise);
        World { rig: calibration(), ids: vec![None; points.len()], points, next_id: 0, noise, path }
    }

    fn imu(&mut self, t: f64) -> ImuSample {
        let (gyro, accel) = self.path.imu(t);
        let root = RATE_HZ.sqrt();
        ImuSample {
            t: Nanos((t * 1e9).round() as i64),
            gyro_body: gyro + GYRO_BIAS + self.noise.vector() * self.rig.imu.gyro_noise * root,
            accel_body: accel + ACCEL_BIAS + self.noise.vector() * self.rig.imu.accel_noise * root,
        }
    }

    fn tracks(&mut self, t: f64, out: &mut Tracks) {
        let body = self.path.pose(t).inverse();
        out.t = Nanos((t * 1e9).round() as i64);
        out.cameras.iter_mut().for_each(|c| c.clear());
        let mut seen: Vec<(u64, [Option<DVec2>; 2])> = Vec::new();
        let mut live = 0;
        for i in 0..self.points.len() {
            let p_body = body.transform(self.points[i]);
            let view = |c: &RigCamera| {
                let px = c.camera.project(c.body_from_cam.inverse().transform(p_body))?;
                c.camera.contains(px, 5.0).then_some(px)
            };
            let views = [view(&self.rig.cameras[0]), view(&self.rig.cameras[1])];
            if views[0].is_none() || live == 120 || self.noise.uniform() < 0.01 {
                self.ids[i] = None;
                continue;
            }
            live += 1;
            let id = *self.ids[i].get_or_insert_with(|| {
                self.next_id += 1;
                self.next_id
            });
            seen.push((id, views));
        }
        seen.sort_by_key(|s| s.0);
        for (id, views) in seen {
            for (camera, view) in views.iter().enumerate() {
                let Some(px) = view else { continue };
                let wrong = if self.noise.uniform() < 0.01 { 15.0 } else { 0.0 };
                let px = *px + DVec2::new(self.noise.normal(), self.noise.normal()) * SIGMA_PX + wrong;
                out.cameras[camera].push(Track { id, px: [px.x as f32, px.y as f32] }).unwrap();
            }
        }
    }
}

struct Run {
    estimated: Vec<TimedPose>,
    truth: Vec<TimedPose>,
    vio: Vio,
}

/// Ten seconds after `before` seconds of inertial samples alone; frames for which `keep` is false are lost.
fn simulate(path: Path, before: f64, keep: impl Fn(usize) -> bool) -> Run {
    let mut world = World::new(path);
    let mut vio = Vio::new(&world.rig, &VioConfig::default());
    let mut tracks = Tracks::default();
    let (mut estimated, mut truth) = (Vec::new(), Vec::new());
    let mut sample = 0;
    for frame in 0..200 {
        let t = before + frame as f64 * FRAME_SECS + 0.0012;
        while (sample as f64) / RATE_HZ < t + 1.0 / RATE_HZ {
            vio.on_imu(world.imu(sample as f64 / RATE_HZ));
            sample += 1;
        }
        world.tracks(t, &mut tracks);
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

/// Tracks and estimates a recording; answers estimate, the recording, and mean ms a frame of each.
fn replay(name: &str, config: &VioConfig) -> Option<(Run, [f64; 2])> {
    let recording = Recording::open(&recording(name)?, &OpenOptions::default()).unwrap();
    let mut frontend = Frontend::new(&recording.calibration, &FrontendConfig::default()).unwrap();
    let mut vio = Vio::new(&recording.calibration, config);
    let mut reader = recording.reader();
    let mut frames = Frames::for_rig(&recording.calibration);
    let mut estimated = Vec::new();
    let mut secs = [0.0; 2];
    let mut imu = recording.imu.iter().peekable();
    let period = Span::from_secs(1.0 / recording.calibration.imu.rate_hz);
    for i in 0..recording.pairs.len() {
        reader.read(i, &mut frames).unwrap();
        while let Some(s) = imu.next_if(|s| s.t <= frames.t + period) {
            vio.on_imu(*s);
        }
        let start = std::time::Instant::now();
        let tracks = frontend.track(&frames, &Prediction { prev_from_now: vio.predict_motion(frames.t) });
        let middle = std::time::Instant::now();
        let update = vio.on_tracks(tracks);
        secs[0] += (middle - start).as_secs_f64();
        secs[1] += middle.elapsed().as_secs_f64();
        if std::env::var("VIO_TRACE").is_ok() {
            trace(i, tracks, &vio, &update, &recording.truth);
        }
        if let Some(o) = update.odometry {
            estimated.push(TimedPose { t: o.t, pose: o.world_from_body });
        }
    }
    let ms = secs.map(|s| 1e3 * s / recording.pairs.len() as f64);
    Some((Run { estimated, truth: recording.truth, vio }, ms))
}

fn trace(i: usize, tracks: &Tracks, vio: &Vio, u: &stipple::vio::Update, truth: &[TimedPose]) {
    let Some(o) = u.odometry else { return eprintln!("{i}: not running, {} tracks", tracks.cameras[0].len()) };
    let g = stipple_drivers::types::pose_at(truth, o.t, Span::from_secs(0.1));
    let tilt = g.map_or(f64::NAN, |g| {
        let (a, b) = (o.world_from_body.q.conjugate() * DVec3::Z, g.q.conjugate() * DVec3::Z);
        a.angle_between(b).to_degrees()
    });
    eprintln!(
        "{i}: kf {} tracks {}/{} connected {} landmarks {} it {} cost {:.1} -> {:.1} tilt {tilt:.2} v {:.3} bg {:.4} ba {:.3}",
        u.keyframe as u8,
        tracks.cameras[0].len(),
        tracks.cameras[1].len(),
        u.connected,
        vio.landmarks(),
        u.outcome.iterations,
        u.outcome.cost_before,
        u.outcome.cost,
        o.v_world,
        o.gyro_bias,
        o.accel_bias
    );
}

#[test]
fn shaken_recording_stays_within_five_centimetres() {
    let Some((run, ms)) = replay("euroc_MH_01_easy_11s", &VioConfig::default()) else { return };
    eprintln!("tracker {:.1} ms, estimator {:.1} ms a frame", ms[0], ms[1]);
    check("MH_01 11 s", &run, 205, 0.05);
}

#[test]
fn resting_recording_starts_at_rest_and_stays() {
    let Some((run, _)) = replay("euroc_V1_01_easy_static_1s", &VioConfig::default()) else { return };
    check("V1_01 at rest", &run, 8, 0.005);
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
