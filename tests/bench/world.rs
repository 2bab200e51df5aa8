//! A made-up world without images: points on the walls of a room, seen along an analytic path with
//! noise, and the inertial samples of that path. Shared by the estimator's unit and integration tests.

use glam::{DMat3, DQuat, DVec2, DVec3};
use stipple::frontend::{Track, Tracks};
use stipple_drivers::{Calibration, Camera, ImuCalibration, ImuCorrection, ImuSample, Lens, Nanos, Pose, RigCamera};

/// SplitMix64; normal values by summing twelve uniforms.
pub struct Noise(pub u64);

impl Noise {
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }
    pub fn uniform(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }
    pub fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform()).sum::<f64>() - 6.0
    }
    pub fn vector(&mut self) -> DVec3 {
        DVec3::new(self.normal(), self.normal(), self.normal())
    }
}

/// Values of unrelated streams for seeds that differ by little.
pub fn stream(seed: u64, which: u64) -> Noise {
    let mut noise = Noise(seed.wrapping_mul(0x1000_0000_01b3) ^ which);
    noise.bits();
    noise
}

pub const RATE_HZ: f64 = 200.0;
pub const FRAME_SECS: f64 = 0.05;
/// Noise of a view, px.
pub const SIGMA_PX: f64 = 0.3;
/// Seed of the walk of the biases, apart from that of all else.
const WALK: u64 = 0x5741_4c4b;
pub const GYRO_BIAS: DVec3 = DVec3::new(-0.003, 0.02, 0.07);
pub const ACCEL_BIAS: DVec3 = DVec3::new(-0.02, 0.1, 0.05);

pub fn calibration() -> Calibration {
    let lens = Lens::Radtan { k1: -0.28, k2: 0.07, p1: 2e-4, p2: 2e-5 };
    let camera = Camera { width: 752, height: 480, fx: 458.0, fy: 457.0, cx: 367.0, cy: 248.0, lens };
    let q = DQuat::from_mat3(&DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X));
    let eye = |y: f64| RigCamera::new(camera, Pose::new(q, DVec3::new(0.02, y, 0.01)));
    let imu = ImuCalibration {
        rate_hz: RATE_HZ,
        gyro_noise: 1.7e-4,
        gyro_walk: 2e-5,
        accel_noise: 2e-3,
        accel_walk: 3e-3,
        range: ImuCalibration::RANGE,
        measured: false,
        correction: ImuCorrection::NONE,
    };
    Calibration { cameras: vec![eye(0.055), eye(-0.055)], imu }
}

/// Position and orientation at `t`; at rest before `rest`.
#[derive(Clone, Copy)]
pub struct Path {
    pub rest: f64,
}

impl Path {
    pub fn pose(&self, t: f64) -> Pose {
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

    /// Velocity at `t`, m/s.
    pub fn velocity(&self, t: f64) -> DVec3 {
        const H: f64 = 1e-5;
        (self.pose(t + H).p - self.pose(t - H).p) / (2.0 * H)
    }
}

/// What a perfect inertial sensor on the path `pose` reads at `t`.
pub fn rate_and_force(pose: impl Fn(f64) -> Pose, t: f64) -> (DVec3, DVec3) {
    const H: f64 = 1e-4;
    let (a, b, c) = (pose(t - H), pose(t), pose(t + H));
    let turn = a.q.conjugate() * c.q;
    let gyro = turn.to_scaled_axis() / (2.0 * H);
    let accel = (a.p + c.p - 2.0 * b.p) / (H * H) - DVec3::new(0.0, 0.0, -9.81);
    (gyro, b.q.conjugate() * accel)
}

/// Points on the walls of a room of 8 x 8 x 4 m.
pub fn room(n: usize, noise: &mut Noise) -> Vec<DVec3> {
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
pub struct World {
    pub rig: Calibration,
    points: Vec<DVec3>,
    ids: Vec<Option<u64>>,
    next_id: u64,
    noise: Noise,
    walk: Noise,
    /// Present values, rad/s and m/s²; they walk as the calibration says.
    pub gyro_bias: DVec3,
    pub accel_bias: DVec3,
    pose: Box<dyn Fn(f64) -> Pose>,
}

impl World {
    pub fn new(path: Path) -> World {
        let mut noise = Noise(7);
        let points = room(1500, &mut noise);
        World::seen_from(move |t| path.pose(t), points, noise)
    }

    pub fn seen_from(pose: impl Fn(f64) -> Pose + 'static, points: Vec<DVec3>, noise: Noise) -> World {
        World {
            rig: calibration(),
            ids: vec![None; points.len()],
            points,
            next_id: 0,
            walk: stream(noise.0, WALK),
            noise,
            gyro_bias: GYRO_BIAS,
            accel_bias: ACCEL_BIAS,
            pose: Box::new(pose),
        }
    }

    /// The next sample; the biases walk on by one.
    pub fn imu(&mut self, t: f64) -> ImuSample {
        let (gyro, accel) = rate_and_force(&self.pose, t);
        let root = self.rig.imu.rate_hz.sqrt();
        self.gyro_bias += self.walk.vector() * (self.rig.imu.gyro_walk / root);
        self.accel_bias += self.walk.vector() * (self.rig.imu.accel_walk / root);
        ImuSample {
            t: Nanos((t * 1e9).round() as i64),
            gyro_body: gyro + self.gyro_bias + self.noise.vector() * self.rig.imu.gyro_noise * root,
            accel_body: accel + self.accel_bias + self.noise.vector() * self.rig.imu.accel_noise * root,
            ..ImuSample::default()
        }
    }

    pub fn tracks(&mut self, t: f64, out: &mut Tracks) {
        let body = (self.pose)(t).inverse();
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
                out.cameras[camera].push(Track { id, px: [px.x as f32, px.y as f32] }).expect("120 fit");
            }
        }
    }
}
