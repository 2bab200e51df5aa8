//! Faults on a flight through the synthetic world, a case each: where it flies, what fails and
//! when, what is expected of the estimator, and how far off it may be.

use super::{Case, Limits, Verdict};
use crate::flight::{from_rest, moving, Plan};
use crate::world::Noise;
use glam::{DQuat, DVec3};
use std::ops::Range;
use stipple::frontend::Tracks;
use stipple::vio::Health;
use stipple_drivers::{ImuCalibration, ImuSample, Nanos, Pose};

/// Frames during which passing faults last; t = 5 s is frame 80.
const AT: usize = 80;
/// No bound, where the estimate cannot help being wrong: every case is asked to say so, and that the restart's covariance
/// holds the truth.
const SAID: f64 = f64::INFINITY;
/// Ends with the flight.
const EVER: usize = usize::MAX;

fn resting(_: f64) -> Pose {
    Pose::new(DQuat::from_rotation_z(0.3), DVec3::new(0.2, -0.1, 0.3))
}

fn turned(t: f64) -> Pose {
    let s = |k: f64, f: f64| (k * t + f).sin();
    let q = DQuat::from_euler(glam::EulerRot::ZYX, 0.8 * s(0.9, 0.0), 0.3 * s(1.3, 0.3), 0.3 * s(1.1, 2.0));
    Pose::new(q, DVec3::ZERO)
}

fn hover(t: f64) -> Pose {
    let s = |k: f64, f: f64| (k * t + f).sin();
    let p = DVec3::new(0.03 * s(1.9, 0.0), 0.03 * s(2.3, 1.0), 0.02 * s(1.7, 2.0));
    Pose::new(DQuat::from_euler(glam::EulerRot::ZYX, 0.02 * s(1.1, 0.0), 0.02 * s(2.7, 1.0), 0.02 * s(3.1, 2.0)), p)
}

/// Four tenths of a second of fall, caught over the next eight.
fn fall(t: f64) -> Pose {
    let g = 9.81;
    let (fallen, caught) = ((t - 5.0).clamp(0.0, 0.4), (t - 5.4).clamp(0.0, 0.8));
    let z = -0.5 * g * fallen * fallen - 0.4 * g * caught + 0.25 * g * caught * caught;
    let base = moving(t);
    Pose::new(base.q, base.p * 0.5 + DVec3::new(0.0, 0.0, 1.0 + z))
}

/// Bumps of 2.5 mm whose flanks are 10 g.
fn shocks(t: f64) -> Pose {
    let base = moving(t);
    let bump = |at: f64| 2.5e-3 * (-0.5 * ((t - at) / 5e-3).powi(2)).exp();
    Pose::new(base.q, base.p + DVec3::new(bump(5.0) + bump(6.5), bump(6.0), bump(7.0) + bump(5.5)))
}

fn near(t: f64) -> Pose {
    let base = moving(t);
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

/// `n` of twelve tracks.
fn thin(tracks: &mut Tracks, n: u64) {
    tracks.cameras.iter_mut().for_each(|c| c.retain(|t| t.id % 12 < n));
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

fn within(s: &ImuSample, span: Range<f64>) -> bool {
    span.contains(&(s.t.0 as f64 * 1e-9))
}

/// An accelerometer that lies for two seconds.
fn lean(s: &mut ImuSample, _: &mut Noise) {
    if within(s, 5.0..7.0) {
        s.accel_body += DVec3::new(8.0, 0.0, 0.0);
    }
}

fn jitter(s: &mut ImuSample, noise: &mut Noise) {
    s.t = Nanos(s.t.0 + ((noise.uniform() - 0.5) * 4e6) as i64);
}

/// Motors on, nothing moving: as EuRoC V1_01 on the ground.
fn shake(s: &mut ImuSample, noise: &mut Noise) {
    s.gyro_body += noise.vector() * 0.06;
    s.accel_body += noise.vector() * 0.9;
}

/// Ranges that this flight leaves: rad/s, and m/s² (1.07 g).
const GYRO_RANGE: f64 = 0.3;
const ACCEL_RANGE: f64 = 10.5;

fn clip_gyro(s: &mut ImuSample, _: &mut Noise) {
    s.gyro_body = s.gyro_body.clamp(DVec3::splat(-GYRO_RANGE), DVec3::splat(GYRO_RANGE));
}

fn clip_accel(s: &mut ImuSample, _: &mut Noise) {
    s.accel_body = s.accel_body.clamp(DVec3::splat(-ACCEL_RANGE), DVec3::splat(ACCEL_RANGE));
}

fn poison(s: &mut ImuSample, noise: &mut Noise) {
    if noise.uniform() < 0.2 {
        s.gyro_body.x = f64::NAN;
    } else if noise.uniform() < 0.1 {
        s.t = Nanos(s.t.0 - 20_000_000);
    }
}

fn case(name: &'static str, plan: Plan) -> Case {
    Case { name, plan, fault: None, expect: Verdict::Survived, limits: Limits::default(), health: Health::default() }
}

impl Case {
    fn fault(self, from: usize, to: usize) -> Case {
        Case { fault: Some((from, to)), ..self }
    }

    fn says(self, health: Health) -> Case {
        Case { health, ..self }
    }

    /// Expected, and within so many metres before, after and across the fault.
    fn expect(self, expect: Verdict, after: f64, jump: f64) -> Case {
        Case { expect, limits: Limits { after, jump, ..self.limits }, ..self }
    }
}

#[rustfmt::skip]
pub fn all() -> Vec<Case> {
    let plan = Plan::default;
    let long = || Plan { frames: 220, ..Plan::default() };
    [starts(plan), lost(plan, long), inertial(plan, long), seeing(plan, long), motions(plan)].concat()
}

#[rustfmt::skip]
fn starts(plan: fn() -> Plan) -> Vec<Case> {
    use Verdict::{Detected, Survived};
    vec![
        case("moving start", plan()),
        case("static start", Plan { pose: from_rest, ..plan() }).says(Health::ZERO_VELOCITY),
        case("at rest", Plan { pose: resting, ..plan() }).says(Health::ZERO_VELOCITY).expect(Survived, 0.002, 0.0),
        case("at rest, motors on", Plan { pose: resting, warp: shake, ..plan() }).says(Health::ZERO_VELOCITY).expect(Survived, 0.02, 0.0),
        // Without parallax a velocity not known at the start stays unknown.
        case("distant only, moving start", Plan { scene: distant, ..plan() }).says(Health::VELOCITY_UNOBSERVED).expect(Detected, 0.1, 0.0),
        case("distant only, static start", Plan { scene: distant, pose: from_rest, ..plan() }).expect(Survived, 0.35, 0.0),
        case("near only", Plan { scene: wall, pose: near, ..plan() }).expect(Survived, 0.002, 0.0),
    ]
}

#[rustfmt::skip]
fn lost(plan: fn() -> Plan, long: fn() -> Plan) -> Vec<Case> {
    use Verdict::{Reset, Survived};
    vec![
        case("1 frame dropped", Plan { frame: |i| i != AT, ..plan() }).fault(AT, AT + 1),
        case("10 frames dropped", Plan { frame: |i| !(AT..AT + 10).contains(&i), ..plan() }).fault(AT, AT + 10),
        case("100 frames dropped", Plan { frame: |i| !(AT..AT + 100).contains(&i), frames: 260, ..plan() }).fault(AT, AT + 100).says(Health::FRAME_GAP_RESET).expect(Reset, 0.008, 0.4),
        case("left camera blind 1 s", Plan { spoil: |i, t| if (AT..AT + 20).contains(&i) { t.cameras[0].clear() }, ..plan() }).fault(AT, AT + 20).says(Health::ONE_CAMERA_BLIND),
        case("right camera blind 1 s", Plan { spoil: |i, t| if (AT..AT + 20).contains(&i) { t.cameras[1].clear() }, ..plan() }).fault(AT, AT + 20).says(Health::ONE_CAMERA_BLIND),
        case("left camera blind for good", Plan { spoil: |i, t| if i >= AT { t.cameras[0].clear() }, ..long() }).fault(AT, EVER).says(Health::ONE_CAMERA_BLIND).expect(Survived, 0.03, 0.008),
        case("right camera blind for good", Plan { spoil: |i, t| if i >= AT { t.cameras[1].clear() }, ..long() }).fault(AT, EVER).says(Health::ONE_CAMERA_BLIND),
        case("left camera dead from the start", Plan { spoil: |_, t| t.cameras[0].clear(), pose: from_rest, ..plan() }).says(Health::ONE_CAMERA_BLIND).expect(Survived, 0.03, 0.0),
        case("left camera dead, 100 frames dropped", Plan { frame: |i| !(AT..AT + 100).contains(&i), spoil: |i, t| if i >= AT { t.cameras[0].clear() }, frames: 300, ..plan() }).fault(AT, AT + 100).says(Health::FRAME_GAP_RESET).expect(Reset, 0.03, 0.4),
        case("dark 1 s", Plan { spoil: |i, t| if (AT..AT + 20).contains(&i) { thin(t, 0) }, ..plan() }).fault(AT, AT + 20).says(Health::NO_TRACKS | Health::INERTIA_ALONE),
        case("dark 4 s", Plan { spoil: |i, t| if (AT..AT + 80).contains(&i) { thin(t, 0) }, frames: 260, ..plan() }).fault(AT, AT + 80).says(Health::NO_TRACKS | Health::UNSEEN_RESET).expect(Reset, 0.008, 0.3),
    ]
}

#[rustfmt::skip]
fn inertial(plan: fn() -> Plan, long: fn() -> Plan) -> Vec<Case> {
    use Verdict::Reset;
    vec![
        case("imu gap 5 ms", Plan { sample: |t| !(5.0..5.004).contains(&t), ..plan() }).fault(AT, AT + 1),
        case("imu gap 50 ms", Plan { sample: |t| !(5.0..5.05).contains(&t), ..plan() }).fault(AT, AT + 2).says(Health::IMU_GAP),
        case("imu gap 500 ms", Plan { sample: |t| !(5.0..5.5).contains(&t), ..plan() }).fault(AT, AT + 11).says(Health::IMU_GAP),
        case("imu stamps jittered by 2 ms", Plan { warp: jitter, ..plan() }),
        case("gyro saturated", Plan { warp: clip_gyro, range: [GYRO_RANGE, ImuCalibration::RANGE[1]], ..plan() }).says(Health::IMU_SATURATED),
        case("accelerometer saturated", Plan { warp: clip_accel, range: [ImuCalibration::RANGE[0], ACCEL_RANGE], ..plan() }).says(Health::IMU_SATURATED),
        case("imu samples not finite or late", Plan { warp: poison, ..plan() }).says(Health::IMU_REJECTED),
        case("accelerometer 8 m/s2 wrong 2 s", Plan { warp: lean, ..long() }).fault(AT, AT + 40).says(Health::DIVERGED_RESET | Health::VISION_DISAGREES).expect(Reset, 0.012, SAID),
    ]
}

#[rustfmt::skip]
fn seeing(plan: fn() -> Plan, long: fn() -> Plan) -> Vec<Case> {
    use Verdict::{Reset, Survived};
    vec![
        case("low texture: 20 tracks", Plan { spoil: |i, t| if i >= AT { thin(t, 2) }, ..plan() }).fault(AT, EVER),
        case("low texture: 10 tracks", Plan { spoil: |i, t| if i >= AT { thin(t, 1) }, ..plan() }).fault(AT, EVER).says(Health::FEW_LANDMARKS).expect(Survived, 0.008, 0.008),
        case("tracks scattered 1 s", Plan { spoil: |i, t| if (AT..AT + 20).contains(&i) { scatter(i, t) }, ..plan() }).fault(AT, AT + 20).says(Health::VISION_DISAGREES).expect(Survived, 0.01, 0.03),
        // It may start again while tracks still lie, and is then off by a velocity it says it does not know.
        case("tracks scattered 4 s", Plan { spoil: |i, t| if (AT..AT + 80).contains(&i) { scatter(i, t) }, frames: 260, ..plan() }).fault(AT, AT + 80).says(Health::VISION_DISAGREES | Health::UNSEEN_RESET).expect(Reset, 0.1, SAID),
        case("tracks scattered for good", Plan { spoil: |i, t| if i >= AT { scatter(0, t) }, ..long() }).fault(AT, EVER).says(Health::VISION_DISAGREES | Health::UNSEEN_RESET).expect(Reset, SAID, 0.2),
    ]
}

#[rustfmt::skip]
fn motions(plan: fn() -> Plan) -> Vec<Case> {
    vec![
        case("pure rotation", Plan { pose: turned, ..plan() }),
        case("hover", Plan { pose: hover, ..plan() }),
        case("hover, motors on", Plan { pose: hover, warp: shake, ..plan() }).expect(Verdict::Survived, 0.025, 0.0),
        case("free fall", Plan { pose: fall, ..plan() }).fault(AT, AT + 25),
        case("10 g shocks", Plan { pose: shocks, ..plan() }).fault(AT, AT + 41),
    ]
}
