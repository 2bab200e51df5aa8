//! The part of the rig that may be estimated along with the window: the time offset and the place on the
//! body of each camera, the scale of the inertial unit. One block of columns that never leaves the window; what is
//! not estimated has no column.
//!
//! Like a frame, the block has a fixed linearization point once the prior touches it.

use super::reprojection::{CameraModel, Transform};
use crate::config::VioConfig;
use crate::limits::{CAMERAS_MAX, RIG_DIM};
use crate::math::so3;
use glam::DVec3;
use stipple_drivers::{Calibration, Pose};

/// Errors in order: time offset of each camera, [p, θ] of each camera (θ on the right), gyro scale, accelerometer scale.
pub const TIME_DIM: usize = 1;
pub const EXTRINSIC_DIM: usize = 6;
pub const SCALE_DIM: usize = 6;
/// Columns that cameras touch, at most.
pub const CAMERA_DIM_MAX: usize = (TIME_DIM + EXTRINSIC_DIM) * CAMERAS_MAX;
const _: () = assert!(RIG_DIM == CAMERA_DIM_MAX + SCALE_DIM);

/// Bounds of what is estimated, beyond the calibration: s, m, rad, and of scales. A rig further off is lost. The
/// deviations that a board may state lie well within.
const TIME_OFFSET_MAX: f64 = 0.3;
const TRANSLATION_MAX: f64 = 3.0;
const ROTATION_MAX: f64 = 1.5;
const SCALE_MAX: f64 = 0.9;

/// Which parts are estimated: nothing unless the board asks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Parts {
    pub time_offset: bool,
    pub extrinsics: bool,
    pub imu_scale: bool,
}

impl Parts {
    pub fn new(config: &VioConfig) -> Parts {
        Parts {
            time_offset: config.estimate_time_offset,
            extrinsics: config.estimate_extrinsics,
            imu_scale: config.estimate_imu_scale,
        }
    }

    /// Whether anything is estimated.
    pub fn any(self) -> bool {
        self.time_offset || self.extrinsics || self.imu_scale
    }
}

/// Values of the rig that estimation may change.
#[derive(Clone, Copy, Debug)]
pub struct RigParameters {
    /// Added to the stamps of each camera's images, beyond what the calibration adds, s.
    pub time_offsets: [f64; CAMERAS_MAX],
    pub body_from_cam: [Pose; CAMERAS_MAX],
    /// Factors on the readings of each axis, less one.
    pub gyro_scale: DVec3,
    pub accel_scale: DVec3,
}

impl RigParameters {
    fn calibrated(body_from_cam: [Pose; CAMERAS_MAX]) -> RigParameters {
        let (gyro_scale, accel_scale) = (DVec3::ZERO, DVec3::ZERO);
        RigParameters { time_offsets: [0.0; CAMERAS_MAX], body_from_cam, gyro_scale, accel_scale }
    }

    /// Factors on the readings of gyro and accelerometer, less one.
    pub fn imu_scale(&self) -> [DVec3; 2] {
        [self.gyro_scale, self.accel_scale]
    }
}

/// Estimate and standard deviation of what the board asks for; `None` for the rest.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RigEstimate {
    /// Time offset of each camera beyond the calibration's, and its deviation, s.
    pub time_offsets: [Option<[f64; 2]>; CAMERAS_MAX],
    /// [p, θ] of each camera over the calibration, m and rad, θ on the right; and deviations.
    pub extrinsics: [Option<[[f64; EXTRINSIC_DIM]; 2]>; CAMERAS_MAX],
    /// Factors less one of the gyro's axes and the accelerometer's; and deviations.
    pub imu_scale: Option<[[f64; SCALE_DIM]; 2]>,
}

impl RigEstimate {
    pub fn new(rig: &RigState, deviations: &[f64; RIG_DIM]) -> RigEstimate {
        let errors = rig.errors();
        let six = |at: usize| [&errors, deviations].map(|v| std::array::from_fn(|i| v[at + i]));
        RigEstimate {
            time_offsets: std::array::from_fn(|c| rig.time_column(c).map(|at| [errors[at], deviations[at]])),
            extrinsics: std::array::from_fn(|c| rig.extrinsic_column(c).map(six)),
            imu_scale: rig.parts.imu_scale.then(|| six(rig.camera_dim())),
        }
    }
}

/// The rig as it is estimated.
#[derive(Clone, Debug)]
pub struct RigState {
    pub parts: Parts,
    pub now: RigParameters,
    linearization_point: Option<RigParameters>,
    /// Error since the linearization point, of the estimated parts one after the other.
    pub delta: [f64; RIG_DIM],
    /// `now` and where Jacobians are taken, as residuals use them.
    cameras: Vec<CameraModel>,
    cameras_linearized: Vec<CameraModel>,
    saved: (RigParameters, [f64; RIG_DIM]),
    /// A shutter rolls.
    rolls: bool,
    calibrated: [Pose; CAMERAS_MAX],
}

impl RigState {
    /// A rig as calibrated.
    pub fn new(cameras: &[CameraModel], calibration: &Calibration, config: &VioConfig) -> RigState {
        let mut body_from_cam = [Pose::IDENTITY; CAMERAS_MAX];
        body_from_cam.iter_mut().zip(&calibration.cameras).for_each(|(to, from)| *to = from.body_from_cam);
        let rig = RigParameters::calibrated(body_from_cam);
        RigState {
            parts: Parts::new(config),
            now: rig,
            linearization_point: None,
            delta: [0.0; RIG_DIM],
            cameras: cameras.to_vec(),
            cameras_linearized: cameras.to_vec(),
            saved: (rig, [0.0; RIG_DIM]),
            calibrated: body_from_cam,
            rolls: cameras.iter().any(|c| c.readout > 0.0),
        }
    }

    /// Whether every view is taken at its stamp by a camera that sits where it was calibrated.
    #[inline]
    pub fn is_plain(&self) -> bool {
        !(self.rolls || self.parts.time_offset || self.parts.extrinsics)
    }

    /// Whether Jacobians are taken at a fixed point and no longer at the estimate.
    pub fn is_linearized(&self) -> bool {
        self.linearization_point.is_some()
    }

    /// The rig at which Jacobians are taken.
    pub fn linearized(&self) -> &RigParameters {
        self.linearization_point.as_ref().unwrap_or(&self.now)
    }

    /// Standard deviations of the estimated parts at the start, in the order of the columns.
    pub fn sigmas(&self, config: &VioConfig) -> [f64; RIG_DIM] {
        let (cameras, n) = (self.camera_dim(), self.dim());
        let of = |i: usize| match i {
            i if i >= n => f64::INFINITY,
            i if i >= cameras => config.imu_scale_sigma,
            i if i < self.time_dim() => config.time_offset_sigma_s,
            i if (i - self.time_dim()) % EXTRINSIC_DIM < 3 => config.extrinsics_sigma_m,
            _ => config.extrinsics_sigma_rad,
        };
        std::array::from_fn(of)
    }

    /// Number of columns of time offsets.
    fn time_dim(&self) -> usize {
        self.parts.time_offset as usize * TIME_DIM * self.cameras.len()
    }

    /// Number of columns that cameras touch: the time offsets of all, then their extrinsics.
    pub fn camera_dim(&self) -> usize {
        let extrinsics = self.parts.extrinsics as usize * EXTRINSIC_DIM * self.cameras.len();
        self.time_dim() + extrinsics
    }

    /// Number of columns that the inertial unit touches.
    pub fn imu_dim(&self) -> usize {
        self.parts.imu_scale as usize * SCALE_DIM
    }

    /// Number of all columns of the rig.
    pub fn dim(&self) -> usize {
        self.camera_dim() + self.imu_dim()
    }

    /// Column of a camera's time offset.
    pub fn time_column(&self, camera: usize) -> Option<usize> {
        (self.parts.time_offset && camera < self.cameras.len()).then_some(TIME_DIM * camera)
    }

    /// First column of a camera's extrinsics.
    pub fn extrinsic_column(&self, camera: usize) -> Option<usize> {
        let is_estimated = self.parts.extrinsics && camera < self.cameras.len();
        is_estimated.then(|| self.time_dim() + EXTRINSIC_DIM * camera)
    }

    /// Estimate of every column, over the calibration.
    pub fn errors(&self) -> [f64; RIG_DIM] {
        let mut errors = [0.0; RIG_DIM];
        let mut put = |at: usize, vectors: [DVec3; 2]| {
            errors[at..].iter_mut().zip(vectors.iter().flat_map(DVec3::to_array)).for_each(|(to, x)| *to = x);
        };
        for c in 0..self.cameras.len() {
            if let Some(at) = self.extrinsic_column(c) {
                let (from, to) = (&self.calibrated[c], &self.now.body_from_cam[c]);
                put(at, [to.p - from.p, so3::log(from.q.conjugate() * to.q)]);
            }
        }
        if self.parts.imu_scale {
            put(self.camera_dim(), [self.now.gyro_scale, self.now.accel_scale]);
        }
        for c in 0..self.cameras.len() {
            self.time_column(c).into_iter().for_each(|at| errors[at] = self.now.time_offsets[c]);
        }
        errors
    }

    /// The cameras at the estimate.
    #[inline]
    pub fn cameras(&self) -> &[CameraModel] {
        &self.cameras
    }

    /// The cameras at the linearization point.
    #[inline]
    pub fn cameras_linearized(&self) -> &[CameraModel] {
        &self.cameras_linearized
    }

    /// Makes the present estimate the point at which Jacobians are taken from now on.
    pub fn fix_linearization_point(&mut self) {
        if self.linearization_point.is_none() {
            (self.linearization_point, self.delta) = (Some(self.now), [0.0; RIG_DIM]);
            self.refresh();
        }
    }

    /// Frees the linearization point of a prior that is gone. What was learnt stays, unless it makes no sense.
    pub fn release(&mut self) {
        self.linearization_point = None;
        if !self.is_sane() {
            self.now = RigParameters::calibrated(self.calibrated);
        }
        self.refresh();
    }

    /// Estimated time from a stamp to camera 0's exposure, s; `None` where it is not estimated. Whoever draws all cameras by it
    /// draws another one as far off as it is exposed at another instant than camera 0.
    pub fn exposure(&self) -> Option<f64> {
        self.parts.time_offset.then(|| self.now.time_offsets[0])
    }

    /// Whether a rig could be like this.
    pub fn is_sane(&self) -> bool {
        let (rig, n) = (&self.now, self.cameras.len());
        let near = |(a, b): (&Pose, &Pose)| {
            let rotation = so3::log(a.q.conjugate() * b.q).length();
            a.p.distance(b.p) < TRANSLATION_MAX && rotation < ROTATION_MAX
        };
        let scale = rig.gyro_scale.abs().max(rig.accel_scale.abs()).max_element();
        let finite = rig.gyro_scale.is_finite() && rig.accel_scale.is_finite();
        rig.time_offsets.iter().all(|t| t.abs() < TIME_OFFSET_MAX)
            && finite
            && scale < SCALE_MAX
            && rig.body_from_cam[..n].iter().zip(&self.calibrated[..n]).all(near)
    }

    fn refresh(&mut self) {
        if !self.parts.extrinsics {
            return;
        }
        for (c, camera) in self.cameras.iter_mut().enumerate() {
            camera.body_from_cam = Transform::from(&self.now.body_from_cam[c]);
        }
        let fixed = *self.linearized();
        for (c, camera) in self.cameras_linearized.iter_mut().enumerate() {
            camera.body_from_cam = Transform::from(&fixed.body_from_cam[c]);
        }
    }

    /// Moves by an error of its columns.
    pub fn step(&mut self, error: &[f64]) {
        let n = self.camera_dim();
        let mut d = [0.0; RIG_DIM];
        d[..error.len()].copy_from_slice(error);
        let base = self.linearization_point.unwrap_or(self.now);
        if self.linearization_point.is_some() {
            self.delta.iter_mut().zip(&d).for_each(|(sum, d)| *sum += d);
            d = self.delta;
        }
        let at = |i: usize| DVec3::new(d[i], d[i + 1], d[i + 2]);
        self.now = base;
        for c in 0..self.cameras.len() {
            if let Some(i) = self.time_column(c) {
                self.now.time_offsets[c] += d[i];
            }
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

    /// Keeps the estimate for `restore`.
    pub fn save(&mut self) {
        self.saved = (self.now, self.delta);
    }

    /// Takes back the estimate as `save` kept it.
    pub fn restore(&mut self) {
        (self.now, self.delta) = self.saved;
        self.refresh();
    }
}
