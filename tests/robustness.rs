//! What goes wrong on a flight, one row each: the estimator survives it within a stated error, or
//! notices and starts again. Made-up points and inertial samples, no images.
//! `cargo test --test robustness -- --nocapture` prints the table.
#![allow(clippy::unwrap_used)]

use glam::{DQuat, DVec3};
use std::ops::RangeInclusive;
use stipple::bench::world::{room, Noise, Path, World, ACCEL_BIAS, FRAME_SECS, GYRO_BIAS, RATE_HZ};
use stipple::config::VioConfig;
use stipple::frontend::Tracks;
use stipple::output::metrics::trajectory_error;
use stipple::vio::health::Health;
use stipple::vio::residuals::{Mat15, Vec15};
use stipple::vio::{Odometry, Vio};
use stipple_drivers::{ImuSample, Nanos, Pose, TimedPose};

/// Inertial samples alone before the first frame, s.
const BEFORE: f64 = 1.0;

struct Row {
    name: &'static str,
    pose: fn(f64) -> Pose,
    scene: fn(&mut Noise) -> Vec<DVec3>,
    config: fn(&mut VioConfig),
    frames: usize,
    /// Whether a frame arrives, whether the sample of an instant does, and what they suffer.
    frame: fn(usize) -> bool,
    sample: fn(f64) -> bool,
    spoil: fn(usize, &mut Tracks),
    warp: fn(&mut ImuSample, &mut Noise),
    ate_max: f64,
    resets: RangeInclusive<u64>,
    /// Bits that must have been set on some frame.
    health: Health,
}

impl Default for Row {
    fn default() -> Row {
        Row {
            name: "",
            pose: flight,
            scene: |noise| room(1500, noise),
            config: |_| {},
            frames: 160,
            frame: |_| true,
            sample: |_| true,
            spoil: |_, _| {},
            warp: |_, _| {},
            ate_max: 0.02,
            resets: 0..=0,
            health: Health::default(),
        }
    }
}

struct Run {
    ate: f64,
    /// Distance of the estimate from its first, at the end.
    travelled: f64,
    vio: Vio,
    /// Of all frames.
    health: Health,
    quality: Vec<u8>,
}

fn flight(t: f64) -> Pose {
    Path { rest: -1.0 }.pose(t)
}

fn resting(_: f64) -> Pose {
    Pose::new(DQuat::from_rotation_z(0.3), DVec3::new(0.2, -0.1, 0.3))
}

fn run(row: &Row, seed: u64) -> Run {
    run_checked(row, seed, |_, _, _| {})
}

/// As above; `check` sees every frame's odometry and covariance.
fn run_checked(row: &Row, seed: u64, mut check: impl FnMut(usize, &Odometry, &[[f64; 15]; 15])) -> Run {
    let mut noise = Noise(seed);
    let points = (row.scene)(&mut noise);
    let mut world = World::seen_from(row.pose, points, Noise(seed + 1));
    let mut config = VioConfig::default();
    (row.config)(&mut config);
    let mut vio = Vio::new(&world.rig, &config);
    let mut tracks = Tracks::default();
    let (mut estimated, mut truth) = (Vec::new(), Vec::new());
    let (mut sample, mut health, mut quality) = (0, Health::default(), Vec::new());
    for frame in 0..row.frames {
        let t = BEFORE + frame as f64 * FRAME_SECS + 0.0012;
        while (sample as f64) / RATE_HZ < t + 1.0 / RATE_HZ {
            let at = sample as f64 / RATE_HZ;
            let mut s = world.imu(at);
            (row.warp)(&mut s, &mut noise);
            if (row.sample)(at) {
                vio.on_imu(s);
            }
            sample += 1;
        }
        world.tracks(t, &mut tracks);
        (row.spoil)(frame, &mut tracks);
        if !(row.frame)(frame) {
            continue;
        }
        truth.push(TimedPose { t: tracks.t, pose: (row.pose)(t) });
        let update = vio.on_tracks(&tracks);
        health.set(update.health, true);
        quality.push(update.quality);
        if let Some(o) = update.odometry {
            assert!(o.world_from_body.is_finite(), "{}: not finite", row.name);
            if let Some(c) = vio.covariance() {
                check(frame, &o, c);
            }
            estimated.push(TimedPose { t: o.t, pose: o.world_from_body });
        }
    }
    let ate = trajectory_error(&estimated, &truth).map_or(f64::INFINITY, |e| e.ate_rmse_m);
    let travelled = match (estimated.first(), estimated.last()) {
        (Some(a), Some(b)) => a.pose.p.distance(b.pose.p),
        _ => f64::INFINITY,
    };
    Run { ate, travelled, vio, health, quality }
}

#[test]
fn zero_velocity_update_stops_the_creep_of_a_resting_rig() {
    let held = run(&Row { name: "at rest", pose: resting, ..Row::default() }, 7);
    let free = run(&Row { pose: resting, config: |c| c.zero_velocity = false, ..Row::default() }, 7);
    eprintln!(
        "at rest 8 s: moved {:.5} m, ATE {:.5} m, {} updates; without {:.5} m, {:.5} m",
        held.travelled,
        held.ate,
        held.vio.stats().zero_velocity_updates,
        free.travelled,
        free.ate
    );
    assert!(held.vio.stats().zero_velocity_updates > 140 && free.vio.stats().zero_velocity_updates == 0);
    assert!(held.travelled < 0.002 && held.ate <= free.ate);
}

#[test]
fn flight_is_never_taken_for_rest() {
    assert_eq!(run(&Row::default(), 7).vio.stats().zero_velocity_updates, 0);
}

/// A gyro of 0.3 rad/s and an accelerometer of 1.07 g: this flight leaves both.
fn clip(s: &mut ImuSample, _: &mut Noise) {
    s.gyro_body = s.gyro_body.clamp(DVec3::splat(-0.3), DVec3::splat(0.3));
    s.accel_body = s.accel_body.clamp(DVec3::splat(-10.5), DVec3::splat(10.5));
}

#[test]
fn clipped_samples_harm_less_when_the_range_is_known() {
    let known = |c: &mut VioConfig| (c.gyro_max, c.accel_max) = (0.3, 10.5);
    let told = run(&Row { name: "clipped", config: known, warp: clip, ..Row::default() }, 7);
    let untold = run(&Row { warp: clip, ..Row::default() }, 7);
    let (n, resets) = (told.vio.stats().imu_saturated, untold.vio.stats().resets);
    eprintln!("{n} clipped samples: ATE {:.4} m; range not known {:.4} m, {resets} resets", told.ate, untold.ate);
    assert!(n > 100 && untold.vio.stats().imu_saturated == 0);
    assert!(told.ate < 0.03 && told.ate < 0.7 * untold.ate && told.vio.stats().resets == 0);
}

fn turned(t: f64, p: DVec3) -> Pose {
    let s = |k: f64, f: f64| (k * t + f).sin();
    Pose::new(DQuat::from_euler(glam::EulerRot::ZYX, 0.8 * s(0.9, 0.0), 0.3 * s(1.3, 0.3), 0.3 * s(1.1, 2.0)), p)
}

fn hover(t: f64) -> Pose {
    let s = |k: f64, f: f64| (k * t + f).sin();
    let p = DVec3::new(0.03 * s(1.9, 0.0), 0.03 * s(2.3, 1.0), 0.02 * s(1.7, 2.0));
    Pose::new(DQuat::from_euler(glam::EulerRot::ZYX, 0.02 * s(1.1, 0.0), 0.02 * s(2.7, 1.0), 0.02 * s(3.1, 2.0)), p)
}

/// Four tenths of a second of fall, caught over the next eight.
fn fall(t: f64) -> Pose {
    let g = 9.81;
    let (fallen, caught) = ((t - 4.0).clamp(0.0, 0.4), (t - 4.4).clamp(0.0, 0.8));
    let z = -0.5 * g * fallen * fallen - 0.4 * g * caught + 0.25 * g * caught * caught;
    let base = flight(t);
    Pose::new(base.q, base.p * 0.5 + DVec3::new(0.0, 0.0, 1.0 + z))
}

/// Bumps of 2.5 mm whose flanks are 10 g.
fn shocks(t: f64) -> Pose {
    let base = flight(t);
    let bump = |at: f64| 2.5e-3 * (-0.5 * ((t - at) / 5e-3).powi(2)).exp();
    let p = DVec3::new(bump(4.0) + bump(5.5), bump(5.0), bump(6.0) + bump(4.5));
    Pose::new(base.q, base.p + p)
}

fn near(t: f64) -> Pose {
    let base = flight(t);
    Pose::new(base.q.slerp(DQuat::IDENTITY, 0.7), base.p * 0.1)
}

/// Points on a sphere of 300 m: no parallax, stereo or other.
fn distant(noise: &mut Noise) -> Vec<DVec3> {
    (0..1500).map(|_| noise.vector().normalize() * 300.0).collect()
}

/// A wall at half a metre.
fn wall(noise: &mut Noise) -> Vec<DVec3> {
    let mut side = || 2.0 * noise.uniform() - 1.0;
    (0..1500).map(|_| DVec3::new(0.6 + 0.1 * side(), 1.2 * side(), 0.9 * side())).collect()
}

fn thin(tracks: &mut Tracks, n: usize) {
    tracks.cameras.iter_mut().for_each(|c| c.retain(|t| t.id % 12 < n as u64));
}

/// Every track somewhere else, as after a swap of the lens or a tracker gone mad.
fn scatter(frame: usize, tracks: &mut Tracks) {
    for (camera, list) in tracks.cameras.iter_mut().enumerate() {
        for (i, t) in list.iter_mut().enumerate() {
            let k = i * 7919 + frame * 104_729 + camera * 31;
            t.px = [(k % 752) as f32, (k / 752 % 480) as f32];
        }
    }
}

/// An accelerometer that lies for two seconds.
fn lean(s: &mut ImuSample, _: &mut Noise) {
    if (5_000_000_000..7_000_000_000).contains(&s.t.0) {
        s.accel_body += DVec3::new(8.0, 0.0, 0.0);
    }
}

fn jitter(s: &mut ImuSample, noise: &mut Noise) {
    s.t = Nanos(s.t.0 + ((noise.uniform() - 0.5) * 4e6) as i64);
}

#[rustfmt::skip]
fn rows() -> Vec<Row> {
    let row = Row::default;
    vec![
        Row { name: "clean", ..row() },
        Row { name: "static start", health: Health::ZERO_VELOCITY, pose: |t| Path { rest: 2.0 }.pose(t), ..row() },
        Row { name: "imu gap 5 ms", sample: |t| !(4.0..4.004).contains(&t), ..row() },
        Row { name: "imu gap 50 ms", sample: |t| !(4.0..4.05).contains(&t), ..row() },
        Row { name: "imu gap 500 ms", health: Health::IMU_GAP, sample: |t| !(4.0..4.5).contains(&t), ate_max: 0.03, ..row() },
        Row { name: "imu stamps +-2 ms", warp: jitter, ate_max: 0.03, ..row() },
        Row { name: "imu clipped", health: Health::IMU_SATURATED, warp: clip, config: |c| (c.gyro_max, c.accel_max) = (0.3, 10.5), ate_max: 0.03, ..row() },
        Row { name: "1 frame dropped", frame: |i| i != 80, ..row() },
        Row { name: "10 frames dropped", frame: |i| !(80..90).contains(&i), ate_max: 0.03, ..row() },
        Row { name: "100 frames dropped", health: Health::FRAME_GAP_RESET, frames: 240, frame: |i| !(80..180).contains(&i), ate_max: 0.1, resets: 1..=1, ..row() },
        Row { name: "right camera blind", health: Health::ONE_CAMERA_BLIND, spoil: |i, t| if i > 60 { t.cameras[1].clear() }, ate_max: 0.05, ..row() },
        Row { name: "left camera blind 1 s", health: Health::ONE_CAMERA_BLIND, spoil: |i, t| if (80..100).contains(&i) { t.cameras[0].clear() }, ate_max: 0.1, ..row() },
        Row { name: "low texture: 20 tracks", spoil: |_, t| thin(t, 2), ate_max: 0.05, ..row() },
        Row { name: "low texture: 10 tracks", health: Health::FEW_LANDMARKS, spoil: |i, t| if i > 40 { thin(t, 1) }, ate_max: 0.1, ..row() },
        Row { name: "dark 1 s", health: Health::NO_TRACKS, spoil: |i, t| if (80..100).contains(&i) { thin(t, 0) }, ate_max: 0.1, ..row() },
        Row { name: "tracks scattered 1 s", frames: 200, spoil: |i, t| if (80..100).contains(&i) { scatter(i, t) }, ate_max: 0.5, resets: 0..=1, ..row() },
        Row { name: "tracks scattered for good", frames: 260, spoil: |i, t| if i >= 80 { scatter(0, t) }, ate_max: 3.0, health: Health::VISION_DISAGREES | Health::INERTIA_ALONE, resets: 1..=3, ..row() },
        Row { name: "dark 4 s", frames: 200, spoil: |i, t| if (60..140).contains(&i) { thin(t, 0) }, ate_max: 0.2, resets: 1..=1, health: Health::UNSEEN_RESET, ..row() },
        Row { name: "accel 8 m/s2 wrong 2 s", warp: lean, frames: 200, ate_max: 1.5, resets: 1..=1, health: Health::DIVERGED_RESET, ..row() },
        Row { name: "pure rotation", pose: |t| turned(t, DVec3::ZERO), ..row() },
        Row { name: "hover", pose: hover, ..row() },
        Row { name: "free fall", pose: fall, ate_max: 0.03, ..row() },
        Row { name: "10 g shocks", pose: shocks, ate_max: 0.03, ..row() },
        // Without parallax a velocity not known at the start stays unknown.
        Row { name: "distant only", scene: distant, health: Health::VELOCITY_UNOBSERVED, ate_max: 20.0, ..row() },
        Row { name: "distant, static start", scene: distant, pose: |t| Path { rest: 2.0 }.pose(t), ate_max: 0.5, ..row() },
        Row { name: "near only", scene: wall, pose: near, ..row() },
    ]
}

#[test]
fn flights_gone_wrong_are_survived_or_noticed() {
    let mut failed = Vec::new();
    let head = ["resets", "diverged", "outliers", "clipped", "gaps", "blind", "still", "quality"];
    eprintln!("{:26} {:>7} {:>8}  health", "", "ATE m", head.map(|h| format!("{h:>8}")).join(" "));
    for row in rows() {
        if std::env::var("ONLY").is_ok_and(|o| !row.name.contains(&o)) {
            continue;
        }
        let r = run(&row, 7);
        let s = r.vio.stats();
        let half = &r.quality[r.quality.len() / 2..];
        let quality = half.iter().map(|q| *q as u64).sum::<u64>() / half.len() as u64;
        let numbers = [
            s.resets,
            s.resets_disagreement,
            s.outliers,
            s.imu_saturated,
            s.imu_gaps,
            s.camera_blind,
            s.zero_velocity_updates,
            quality,
        ];
        let reasons = r.health.reasons().collect::<Vec<_>>().join(" ");
        eprintln!("{:26} {:7.4} {}  {reasons}", row.name, r.ate, numbers.map(|n| format!("{n:8}")).join(" "));
        if !(r.ate < row.ate_max && row.resets.contains(&s.resets) && r.health.has(row.health)) {
            failed.push(row.name);
        }
    }
    assert!(failed.is_empty(), "{failed:?}");
}

/// Normalised squared error of 15 errors, mean over the frames of a flight, in the estimate's own world:
/// truth is moved there by the position and yaw of the first frame.
fn nees(seed: u64, config: fn(&mut VioConfig)) -> f64 {
    let row = Row { name: "consistency", pose: |t| Path { rest: 2.0 }.pose(t), config, ..Row::default() };
    let (mut sum, mut n) = (0.0, 0);
    let mut to_estimate: Option<Pose> = None;
    run_checked(&row, seed, |_, o, c| {
        let t = o.t.0 as f64 * 1e-9;
        let velocity = ((row.pose)(t + 1e-4).p - (row.pose)(t - 1e-4).p) / 2e-4;
        let truth = (row.pose)(t);
        let moved = *to_estimate.get_or_insert_with(|| {
            let turn = o.world_from_body.q * truth.q.conjugate();
            let yaw = DQuat::from_xyzw(0.0, 0.0, turn.z, turn.w).normalize();
            Pose::new(yaw, o.world_from_body.p - yaw * truth.p)
        });
        let truth = moved * truth;
        let angle = (o.world_from_body.q.conjugate() * truth.q).to_scaled_axis();
        let parts = [
            truth.p - o.world_from_body.p,
            angle,
            moved.q * velocity - o.v_world,
            GYRO_BIAS - o.gyro_bias,
            ACCEL_BIAS - o.accel_bias,
        ];
        let error = Vec15::from_fn(|i, _| parts[i / 3][i % 3]);
        let covariance = Mat15::from_fn(|i, j| c[i][j]);
        assert!((covariance - covariance.transpose()).norm() <= 1e-9 * covariance.norm(), "symmetric");
        let factor = covariance.cholesky().expect("positive definite");
        sum += error.dot(&factor.solve(&error));
        n += 1;
    });
    sum / n as f64
}

#[test]
fn covariance_is_positive_definite_and_as_large_as_the_errors() {
    // As the world is made: the noise stated, and 0.3 px.
    let honest = |c: &mut VioConfig| {
        (c.gyro_noise_scale, c.accel_noise_scale, c.observation_sigma_px) = (1.0, 1.0, 0.3);
    };
    let mean = |config: fn(&mut VioConfig)| {
        let all: Vec<f64> = (0..10).map(|seed| nees(100 + 10 * seed, config)).collect();
        eprintln!("NEES of 15 over ten flights: {all:.1?}");
        all.iter().sum::<f64>() / all.len() as f64
    };
    let (stated, default) = (mean(honest), mean(|_| {}));
    eprintln!("mean: {stated:.2} with the world's noise, {default:.2} with the defaults, which claim less");
    assert!((1.0..40.0).contains(&stated) && default < 15.0);
}
