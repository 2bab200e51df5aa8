//! One flight through the made-up world, what may go wrong on it, and what the estimator made of it.

use crate::world::{room, stream, Noise, Path, World, FRAME_SECS, RATE_HZ};
use glam::{DQuat, DVec3};
use stipple::config::VioConfig;
use stipple::counters::Counters;
use stipple::frontend::Tracks;
use stipple::run::gate::ImuGate;
use stipple::vio::{Update, Vio};
use stipple_drivers::source::ImuReading;
use stipple_drivers::{ImuCalibration, ImuSample, Nanos, Pose, TimedPose};

/// Inertial samples alone before the first frame, s.
pub const BEFORE: f64 = 1.0;
/// Cameras expose between inertial samples, s after one.
const OFFSET: f64 = 0.0012;

/// A flight: its path, the points to be seen, and what is done to its sensors.
#[derive(Clone)]
pub struct Plan {
    pub pose: fn(f64) -> Pose,
    pub scene: fn(&mut Noise) -> Vec<DVec3>,
    pub config: fn(&mut VioConfig),
    /// Whether the unit's noise is stated as measured; else as that of a data sheet.
    pub measured: bool,
    /// What is known of the ends of the ranges of gyro and accelerometer, rad/s and m/s².
    pub range: [f64; 2],
    pub frames: usize,
    /// Standard deviations of the biases at the start, rad/s and m/s²; those of the world where `None`.
    pub biases: Option<(f64, f64)>,
    /// Whether a frame arrives, whether the sample of an instant does, and what they suffer.
    pub frame: fn(usize) -> bool,
    pub sample: fn(f64) -> bool,
    pub spoil: fn(usize, &mut Tracks),
    pub warp: fn(&mut ImuSample, &mut Noise),
}

impl Default for Plan {
    fn default() -> Plan {
        Plan {
            pose: moving,
            scene: |noise| room(1500, noise),
            config: |_| {},
            measured: false,
            range: ImuCalibration::RANGE,
            frames: 160,
            biases: None,
            frame: |_| true,
            sample: |_| true,
            spoil: |_, _| {},
            warp: |_, _| {},
        }
    }
}

/// Through the room, moving from the start.
pub fn moving(t: f64) -> Pose {
    Path { rest: -1.0 }.pose(t)
}

/// The same after a second of rest in view of the cameras.
pub fn from_rest(t: f64) -> Pose {
    Path { rest: BEFORE + 1.0 }.pose(t)
}

/// Instant of a frame, s.
pub fn frame_time(frame: usize) -> f64 {
    BEFORE + frame as f64 * FRAME_SECS + OFFSET
}

/// The truth at an instant.
#[derive(Clone, Copy, Debug)]
pub struct Truth {
    pub pose: Pose,
    pub v_world: DVec3,
    pub gyro_bias: DVec3,
    pub accel_bias: DVec3,
}

/// A frame as the estimator left it.
pub struct EstimatedFrame<'a> {
    pub frame: usize,
    pub t: Nanos,
    pub truth: Truth,
    pub update: &'a Update,
    pub vio: &'a Vio,
}

/// Flies a plan, its samples through the gate; `each` sees every frame that arrived. Same seed, same flight.
pub fn fly(plan: &Plan, seed: u64, mut each: impl FnMut(&EstimatedFrame)) -> Vio {
    let mut noise = stream(seed, 1);
    let points = (plan.scene)(&mut noise);
    let mut world = World::seen_from(plan.pose, points, stream(seed, 2));
    if let Some((gyro, accel)) = plan.biases {
        (world.gyro_bias, world.accel_bias) = (noise.vector() * gyro, noise.vector() * accel);
    }
    let mut config = VioConfig::default();
    (plan.config)(&mut config);
    (world.rig.imu.range, world.rig.imu.measured) = (plan.range, plan.measured);
    let mut vio = Vio::new(&world.rig, &config);
    let (mut gate, counters) = (ImuGate::new(&world.rig.imu), Counters::default());
    let mut tracks = Tracks::default();
    let mut sample = 0;
    for frame in 0..plan.frames {
        let t = frame_time(frame);
        // Up to the first sample past the frame.
        while (sample as f64) / RATE_HZ < t + 1.0 / RATE_HZ {
            let at = sample as f64 / RATE_HZ;
            let mut s = world.imu(at);
            (plan.warp)(&mut s, &mut noise);
            if (plan.sample)(at) {
                let reading = ImuReading { sample: s, ..ImuReading::default() };
                let arrived = Nanos((at * 1e9) as i64);
                gate.pass(&reading, arrived, &counters, &mut |s| vio.on_imu(s));
            }
            sample += 1;
        }
        world.tracks(t, &mut tracks);
        (plan.spoil)(frame, &mut tracks);
        if !(plan.frame)(frame) {
            continue;
        }
        let update = vio.on_tracks(&tracks);
        let truth = Truth {
            pose: (plan.pose)(t),
            v_world: velocity(plan.pose, t),
            gyro_bias: world.gyro_bias,
            accel_bias: world.accel_bias,
        };
        each(&EstimatedFrame { frame, t: tracks.t, truth, update: &update, vio: &vio });
    }
    vio
}

/// Velocity along a path, m/s.
pub fn velocity(pose: fn(f64) -> Pose, t: f64) -> DVec3 {
    const H: f64 = 1e-4;
    (pose(t + H).p - pose(t - H).p) / (2.0 * H)
}

/// The world of an estimate from that of the truth, by position and yaw of one instant of both.
pub fn estimate_from_truth(estimate: &Pose, truth: &Pose) -> Pose {
    let turn = estimate.q * truth.q.conjugate();
    let yaw = DQuat::from_xyzw(0.0, 0.0, turn.z, turn.w).normalize();
    Pose::new(yaw, estimate.p - yaw * truth.p)
}

/// Errors [p, θ, v, bg, ba] of the newest estimate, `None` without one. `to_estimate` as above.
pub fn errors(seen: &EstimatedFrame, to_estimate: &Pose) -> Option<[DVec3; 5]> {
    let o = seen.update.odometry?;
    let truth = *to_estimate * seen.truth.pose;
    Some([
        truth.p - o.world_from_body.p,
        (o.world_from_body.q.conjugate() * truth.q).to_scaled_axis(),
        to_estimate.q * seen.truth.v_world - o.v_world,
        seen.truth.gyro_bias - o.gyro_bias,
        seen.truth.accel_bias - o.accel_bias,
    ])
}

/// A frame as a table needs it.
#[derive(Clone, Copy, Debug)]
pub struct Record {
    pub frame: usize,
    pub truth: TimedPose,
    pub estimate: Option<TimedPose>,
    pub health: stipple::vio::Health,
    pub quality: u8,
    pub resets: u64,
    /// Distance of the position's error in its covariance, `√(eᵀ P⁻¹ e)`; the world is that of the first estimate.
    pub position_sigmas: Option<f64>,
    /// Error of the velocity in the body's frame, m/s.
    pub velocity_error: Option<f64>,
}

/// Flies a plan and keeps a record of each frame.
pub fn record(plan: &Plan, seed: u64) -> (Vec<Record>, Vio) {
    let mut records = Vec::with_capacity(plan.frames);
    let mut to_estimate = None;
    let vio = fly(plan, seed, |seen| {
        let estimate = seen.update.odometry.map(|o| TimedPose { t: o.t, pose: o.world_from_body });
        if let (None, Some(e)) = (to_estimate, estimate) {
            to_estimate = Some(estimate_from_truth(&e.pose, &seen.truth.pose));
        }
        let sigmas = || {
            let e = errors(seen, &to_estimate?)?[0];
            let c = seen.vio.covariance()?;
            let p = nalgebra::Matrix3::from_fn(|i, j| c[i][j]);
            let e = nalgebra::Vector3::new(e.x, e.y, e.z);
            Some(e.dot(&p.cholesky()?.solve(&e)).sqrt())
        };
        records.push(Record {
            frame: seen.frame,
            truth: TimedPose { t: seen.t, pose: seen.truth.pose },
            estimate,
            health: seen.update.health,
            quality: seen.update.quality,
            resets: seen.vio.stats().resets,
            position_sigmas: sigmas(),
            velocity_error: seen.update.odometry.map(|o| {
                let in_body = |pose: &Pose, v: DVec3| pose.q.conjugate() * v;
                in_body(&o.world_from_body, o.v_world).distance(in_body(&seen.truth.pose, seen.truth.v_world))
            }),
        });
    });
    (records, vio)
}
