//! What of the rig may be estimated along with the window: the cameras' time offset, where each
//! camera sits on the body, the inertial unit's scale. One block of columns that leaves the window
//! never; what is not estimated has none.
//!
//! Like a frame, the block is anchored once the prior touches it.

use super::residuals::{CameraModel, Transform};
use crate::config::VioConfig;
use crate::limits::{CAMERAS_MAX, RIG_DIM};
use crate::math::so3;
use glam::DVec3;
use stipple_drivers::Pose;

/// Errors in order: time offset, [p, θ] of each camera (θ on the right), gyro scale, accelerometer scale.
pub const TIME_DIM: usize = 1;
pub const EXTRINSIC_DIM: usize = 6;
pub const SCALE_DIM: usize = 6;
const _: () = assert!(RIG_DIM == TIME_DIM + EXTRINSIC_DIM * CAMERAS_MAX + SCALE_DIM);

/// Further than this from its calibration a rig is not estimated but lost: s, m, rad, and of scales. The
/// bounds of the deviations that a board may state lie well within.
const TIME_OFFSET_MAX: f64 = 0.3;
const TRANSLATION_MAX: f64 = 3.0;
const ROTATION_MAX: f64 = 1.5;
const SCALE_MAX: f64 = 0.9;

/// What is estimated. Nothing unless the board asks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Parts {
    pub time_offset: bool,
    pub extrinsics: bool,
    pub imu_scale: bool,
}

/// What is known of the rig before flying: standard deviations, s, m, rad, and of scales.
#[derive(Clone, Copy, Debug)]
pub struct RigSigma {
    pub time_offset: f64,
    pub extrinsic_p: f64,
    pub extrinsic_theta: f64,
    pub imu_scale: f64,
}

impl RigSigma {
    pub fn new(config: &VioConfig) -> RigSigma {
        RigSigma {
            time_offset: config.time_offset_sigma_s,
            extrinsic_p: config.extrinsics_sigma_m,
            extrinsic_theta: config.extrinsics_sigma_rad,
            imu_scale: config.imu_scale_sigma,
        }
    }
}

impl Parts {
    pub fn new(config: &VioConfig) -> Parts {
        Parts {
            time_offset: config.estimate_time_offset,
            extrinsics: config.estimate_extrinsics,
            imu_scale: config.estimate_imu_scale,
        }
    }

    pub fn any(self) -> bool {
        self.time_offset || self.extrinsics || self.imu_scale
    }

    /// Columns that cameras touch: time offset, then extrinsics of `cameras`.
    pub fn camera_dim(self, cameras: usize) -> usize {
        self.time_offset as usize * TIME_DIM + self.extrinsics as usize * EXTRINSIC_DIM * cameras
    }

    pub fn imu_dim(self) -> usize {
        self.imu_scale as usize * SCALE_DIM
    }
}

#[derive(Clone, Copy, Debug)]
pub struct Rig {
    /// Added to the stamps of images, beyond what the calibration adds, s.
    pub time_offset: f64,
    pub body_from_cam: [Pose; CAMERAS_MAX],
    /// Factors on what the unit reads, less one.
    pub gyro_scale: DVec3,
    pub accel_scale: DVec3,
}

/// Estimate and standard deviation of what the board asks for; `None` for the rest.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RigEstimate {
    /// Beyond the calibration's, s.
    pub time_offset: Option<[f64; 2]>,
    /// Of each camera: [p, θ] over the calibration, m and rad, θ on the right; and deviations.
    pub extrinsics: [Option<[[f64; EXTRINSIC_DIM]; 2]>; CAMERAS_MAX],
    /// Factors less one of the gyro's axes and the accelerometer's; and deviations.
    pub imu_scale: Option<[[f64; SCALE_DIM]; 2]>,
}

impl RigEstimate {
    pub fn new(rig: &RigState, deviations: &[f64; RIG_DIM]) -> RigEstimate {
        let camera_model = |c: usize| {
            let at = rig.extrinsic_column(c).filter(|_| c < rig.cameras.len())?;
            let (from, to) = (&rig.calibrated[c], &rig.now.body_from_cam[c]);
            let (p, th) = (to.p - from.p, so3::log(from.q.conjugate() * to.q));
            Some([[p.x, p.y, p.z, th.x, th.y, th.z], std::array::from_fn(|i| deviations[at + i])])
        };
        let (g, a) = (rig.now.gyro_scale, rig.now.accel_scale);
        let scales = [g.x, g.y, g.z, a.x, a.y, a.z];
        RigEstimate {
            time_offset: rig.parts.time_offset.then(|| [rig.now.time_offset, deviations[0]]),
            extrinsics: std::array::from_fn(camera_model),
            imu_scale: rig.parts.imu_scale.then(|| [scales, std::array::from_fn(|i| deviations[rig.camera_dim() + i])]),
        }
    }
}

#[derive(Clone, Debug)]
pub struct RigState {
    pub parts: Parts,
    pub now: Rig,
    linearization_point: Rig,
    pub is_linearized: bool,
    /// Error since the anchor, of the estimated parts one after the other.
    pub delta: [f64; RIG_DIM],
    /// `now` and where Jacobians are taken, as residuals use them.
    cameras: Vec<CameraModel>,
    cameras_linearized: Vec<CameraModel>,
    saved: (Rig, [f64; RIG_DIM]),
    rolls: bool,
    calibrated: [Pose; CAMERAS_MAX],
}

impl RigState {
    pub fn new(cameras: &[CameraModel], poses: &[Pose], parts: Parts) -> RigState {
        let mut body_from_cam = [Pose::IDENTITY; CAMERAS_MAX];
        body_from_cam.iter_mut().zip(poses).for_each(|(to, from)| *to = *from);
        let rig = Rig { time_offset: 0.0, body_from_cam, gyro_scale: DVec3::ZERO, accel_scale: DVec3::ZERO };
        RigState {
            parts,
            now: rig,
            linearization_point: rig,
            is_linearized: false,
            delta: [0.0; RIG_DIM],
            cameras: cameras.to_vec(),
            cameras_linearized: cameras.to_vec(),
            saved: (rig, [0.0; RIG_DIM]),
            calibrated: body_from_cam,
            rolls: cameras.iter().any(|e| e.readout > 0.0),
        }
    }

    /// Whether every view is taken at its stamp by a camera that sits where it was calibrated.
    #[inline]
    pub fn is_plain(&self) -> bool {
        !(self.rolls || self.parts.time_offset || self.parts.extrinsics)
    }

    /// The rig at which Jacobians are taken.
    pub fn linearized(&self) -> &Rig {
        if self.is_linearized {
            &self.linearization_point
        } else {
            &self.now
        }
    }

    /// Standard deviations of the estimated parts at the start, in the order of the columns.
    pub fn sigmas(&self, s: &RigSigma) -> [f64; RIG_DIM] {
        let (cameras, n) = (self.camera_dim(), self.camera_dim() + self.parts.imu_dim());
        let of = |i: usize| match i {
            i if i >= n => f64::INFINITY,
            i if i >= cameras => s.imu_scale,
            0 if self.parts.time_offset => s.time_offset,
            i if (i - self.parts.time_offset as usize * TIME_DIM) % EXTRINSIC_DIM < 3 => s.extrinsic_p,
            _ => s.extrinsic_theta,
        };
        std::array::from_fn(of)
    }

    pub fn camera_dim(&self) -> usize {
        self.parts.camera_dim(self.cameras.len())
    }

    /// First column of a camera's extrinsics.
    pub fn extrinsic_column(&self, camera: usize) -> Option<usize> {
        self.parts.extrinsics.then(|| self.parts.time_offset as usize * TIME_DIM + EXTRINSIC_DIM * camera)
    }

    #[inline]
    pub fn cameras(&self) -> &[CameraModel] {
        &self.cameras
    }

    #[inline]
    pub fn cameras_linearized(&self) -> &[CameraModel] {
        &self.cameras_linearized
    }

    pub fn fix_linearization_point(&mut self) {
        if !self.is_linearized {
            (self.is_linearized, self.linearization_point, self.delta) = (true, self.now, [0.0; RIG_DIM]);
            self.refresh();
        }
    }

    /// What was learnt stays, unless it makes no sense; the prior that anchored it is gone.
    pub fn release(&mut self) {
        self.is_linearized = false;
        if !self.is_sane() {
            let body_from_cam = self.calibrated;
            self.now = Rig { time_offset: 0.0, body_from_cam, gyro_scale: DVec3::ZERO, accel_scale: DVec3::ZERO };
        }
        self.refresh();
    }

    /// Whether a rig could be like this.
    pub fn is_sane(&self) -> bool {
        let (rig, n) = (&self.now, self.cameras.len());
        let near = |(a, b): (&Pose, &Pose)| {
            let turn = so3::log(a.q.conjugate() * b.q).length();
            a.p.distance(b.p) < TRANSLATION_MAX && turn < ROTATION_MAX
        };
        let scale = rig.gyro_scale.abs().max(rig.accel_scale.abs()).max_element();
        let finite = rig.gyro_scale.is_finite() && rig.accel_scale.is_finite();
        rig.time_offset.abs() < TIME_OFFSET_MAX
            && finite
            && scale < SCALE_MAX
            && rig.body_from_cam[..n].iter().zip(&self.calibrated[..n]).all(near)
    }

    fn refresh(&mut self) {
        if !self.parts.extrinsics {
            return;
        }
        for (c, camera_model) in self.cameras.iter_mut().enumerate() {
            camera_model.body_from_cam = Transform::from(&self.now.body_from_cam[c]);
        }
        let fixed = if self.is_linearized { &self.linearization_point } else { &self.now };
        for (c, camera_model) in self.cameras_linearized.iter_mut().enumerate() {
            camera_model.body_from_cam = Transform::from(&fixed.body_from_cam[c]);
        }
    }

    /// Moves by errors of the cameras' columns and of the inertial unit's.
    pub fn step(&mut self, cameras: &[f64], imu: &[f64]) {
        let n = cameras.len();
        let mut d = [0.0; RIG_DIM];
        d[..n].copy_from_slice(cameras);
        d[n..n + imu.len()].copy_from_slice(imu);
        let base = if self.is_linearized {
            self.delta.iter_mut().zip(&d).for_each(|(sum, d)| *sum += d);
            d = self.delta;
            self.linearization_point
        } else {
            self.now
        };
        let at = |i: usize| DVec3::new(d[i], d[i + 1], d[i + 2]);
        self.now = base;
        if self.parts.time_offset {
            self.now.time_offset += d[0];
        }
        for c in 0..self.cameras.len() {
            if let Some(i) = self.extrinsic_column(c) {
                let pose = &base.body_from_cam[c];
                self.now.body_from_cam[c] = Pose::new(pose.q * so3::exp(at(i + 3)), pose.p + at(i));
            }
        }
        if self.parts.imu_scale {
            self.now.gyro_scale += at(n);
            self.now.accel_scale += at(n + 3);
        }
        self.refresh();
    }

    pub fn save(&mut self) {
        self.saved = (self.now, self.delta);
    }

    pub fn restore(&mut self) {
        (self.now, self.delta) = self.saved;
        self.refresh();
    }
}
