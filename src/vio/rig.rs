//! What of the rig may be estimated along with the window: the cameras' time offset, where each
//! camera sits on the body, the inertial unit's scale. One block of columns that leaves the window
//! never; what is not estimated has none.
//!
//! Like a frame, the block is anchored once the prior touches it.

use super::residuals::{Body, Eye};
use crate::limits::{CAMERAS_MAX, RIG_DIM};
use crate::math::so3;
use glam::DVec3;
use stipple_drivers::Pose;

/// Errors in order: time offset, [p, θ] of each camera (θ on the right), gyro scale, accelerometer scale.
pub const TIME_DIM: usize = 1;
pub const EYE_DIM: usize = 6;
pub const SCALE_DIM: usize = 6;
const _: () = assert!(RIG_DIM == TIME_DIM + EYE_DIM * CAMERAS_MAX + SCALE_DIM);

/// What is estimated. Nothing unless the board asks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Parts {
    pub time_offset: bool,
    pub extrinsics: bool,
    pub imu_scale: bool,
}

impl Parts {
    /// Columns that cameras touch: time offset, then extrinsics of `cameras`.
    pub fn camera_dim(self, cameras: usize) -> usize {
        self.time_offset as usize * TIME_DIM + self.extrinsics as usize * EYE_DIM * cameras
    }

    pub fn imu_dim(self) -> usize {
        self.imu_scale as usize * SCALE_DIM
    }
}

#[derive(Clone, Copy, Debug)]
pub struct Rig {
    /// Added to the stamps of images, s.
    pub time_offset: f64,
    pub body_from_cam: [Pose; CAMERAS_MAX],
    /// Factors on what the unit reads, less one.
    pub gyro_scale: DVec3,
    pub accel_scale: DVec3,
}

#[derive(Clone, Debug)]
pub struct RigState {
    pub parts: Parts,
    pub now: Rig,
    anchor: Rig,
    pub anchored: bool,
    /// Error since the anchor, of the estimated parts one after the other.
    pub delta: [f64; RIG_DIM],
    /// `now` and where Jacobians are taken, as residuals use them.
    eyes: Vec<Eye>,
    eyes_jacobian: Vec<Eye>,
    saved: (Rig, [f64; RIG_DIM]),
}

impl RigState {
    pub fn new(eyes: &[Eye], poses: &[Pose], parts: Parts) -> RigState {
        let mut body_from_cam = [Pose::IDENTITY; CAMERAS_MAX];
        body_from_cam.iter_mut().zip(poses).for_each(|(to, from)| *to = *from);
        let rig = Rig { time_offset: 0.0, body_from_cam, gyro_scale: DVec3::ZERO, accel_scale: DVec3::ZERO };
        RigState {
            parts,
            now: rig,
            anchor: rig,
            anchored: false,
            delta: [0.0; RIG_DIM],
            eyes: eyes.to_vec(),
            eyes_jacobian: eyes.to_vec(),
            saved: (rig, [0.0; RIG_DIM]),
        }
    }

    pub fn camera_dim(&self) -> usize {
        self.parts.camera_dim(self.eyes.len())
    }

    /// First column of a camera's extrinsics.
    pub fn eye_column(&self, camera: usize) -> Option<usize> {
        self.parts.extrinsics.then(|| self.parts.time_offset as usize * TIME_DIM + EYE_DIM * camera)
    }

    #[inline]
    pub fn eyes(&self) -> &[Eye] {
        &self.eyes
    }

    #[inline]
    pub fn eyes_jacobian(&self) -> &[Eye] {
        &self.eyes_jacobian
    }

    pub fn fix_anchor(&mut self) {
        if !self.anchored {
            (self.anchored, self.anchor, self.delta) = (true, self.now, [0.0; RIG_DIM]);
            self.refresh();
        }
    }

    /// What was learnt stays; the prior that anchored it is gone.
    pub fn release(&mut self) {
        self.anchored = false;
        self.refresh();
    }

    fn refresh(&mut self) {
        if !self.parts.extrinsics {
            return;
        }
        for (c, eye) in self.eyes.iter_mut().enumerate() {
            eye.body_from_cam = Body::from(&self.now.body_from_cam[c]);
        }
        let fixed = if self.anchored { &self.anchor } else { &self.now };
        for (c, eye) in self.eyes_jacobian.iter_mut().enumerate() {
            eye.body_from_cam = Body::from(&fixed.body_from_cam[c]);
        }
    }

    /// Moves by errors of the cameras' columns and of the inertial unit's.
    pub fn step(&mut self, cameras: &[f64], imu: &[f64]) {
        let n = cameras.len();
        let mut d = [0.0; RIG_DIM];
        d[..n].copy_from_slice(cameras);
        d[n..n + imu.len()].copy_from_slice(imu);
        let base = if self.anchored {
            self.delta.iter_mut().zip(&d).for_each(|(sum, d)| *sum += d);
            d = self.delta;
            self.anchor
        } else {
            self.now
        };
        let at = |i: usize| DVec3::new(d[i], d[i + 1], d[i + 2]);
        self.now = base;
        if self.parts.time_offset {
            self.now.time_offset += d[0];
        }
        for c in 0..self.eyes.len() {
            if let Some(i) = self.eye_column(c) {
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
