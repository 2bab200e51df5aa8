//! The calibration of a rig: its cameras, where and when they see, and what its inertial unit reads.
//!
//! Time: `t_imu = t_cam + time_offset` (the sign of Kalibr's `timeshift_cam_imu` and of Basalt's
//! `cam_time_offset_ns`), where a camera stamps the middle of its first row's exposure. An image's stamp
//! downstream is that of its *middle* row in the unit's clock: rows are then at most half a readout away,
//! and whoever models no rolling shutter errs least. `RigCamera::to_imu_clock` makes the one of the other;
//! `ImuCorrection::apply` turns what the unit reads into what it should have read. A source applies both
//! before anyone else sees its data (recordings: `replay::Recording::open`, and nowhere else), so
//! everything downstream is in the unit's clock and along orthogonal axes, and an online estimate of
//! either is what the calibration left over.

use crate::camera::Camera;
use crate::types::{ImuSample, Nanos, Pose, Span};
use glam::{DMat3, DVec3};

/// A camera of the rig, where it sits and when it sees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RigCamera {
    pub camera: Camera,
    pub body_from_cam: Pose,
    /// Of the inertial unit's clock over the camera's.
    pub time_offset: Span,
    /// From the first row's exposure to the last one's; zero is a global shutter.
    pub readout: Span,
}

impl RigCamera {
    /// With a global shutter and the inertial unit's clock.
    pub fn new(camera: Camera, body_from_cam: Pose) -> RigCamera {
        RigCamera { camera, body_from_cam, time_offset: Span(0), readout: Span(0) }
    }

    /// The instant of an image's middle row in the inertial unit's clock, from the camera's own stamp.
    pub fn to_imu_clock(&self, t: Nanos) -> Nanos {
        t + self.time_offset + Span(self.readout.0 / 2)
    }

    /// The camera's own stamp of an image of which downstream says `t`.
    pub fn from_imu_clock(&self, t: Nanos) -> Nanos {
        t - self.time_offset - Span(self.readout.0 / 2)
    }

    /// When a row is exposed, after the image's stamp downstream.
    pub fn row_delay(&self, row: f64) -> f64 {
        self.readout.secs() * (row / (self.camera.height - 1).max(1) as f64 - 0.5)
    }
}

/// What a reading lacks: the true rate or force is `scale * reading - bias`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImuCorrection {
    /// Scale and misalignment of the axes.
    pub gyro_scale: DMat3,
    pub accel_scale: DMat3,
    /// rad/s, m/s²
    pub gyro_bias: DVec3,
    pub accel_bias: DVec3,
}

impl ImuCorrection {
    pub const NONE: ImuCorrection = ImuCorrection {
        gyro_scale: DMat3::IDENTITY,
        accel_scale: DMat3::IDENTITY,
        gyro_bias: DVec3::ZERO,
        accel_bias: DVec3::ZERO,
    };

    pub fn apply(&self, s: &ImuSample) -> ImuSample {
        ImuSample {
            t: s.t,
            gyro_body: self.gyro_scale * s.gyro_body - self.gyro_bias,
            accel_body: self.accel_scale * s.accel_body - self.accel_bias,
        }
    }

    /// What the unit reads where the truth is `s`.
    pub fn undo(&self, s: &ImuSample) -> ImuSample {
        ImuSample {
            t: s.t,
            gyro_body: self.gyro_scale.inverse() * (s.gyro_body + self.gyro_bias),
            accel_body: self.accel_scale.inverse() * (s.accel_body + self.accel_bias),
        }
    }
}

/// Continuous-time noise densities of the inertial unit, and what its axes need.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImuCalibration {
    pub rate_hz: f64,
    /// rad/s/√Hz
    pub gyro_noise: f64,
    /// rad/s²/√Hz
    pub gyro_walk: f64,
    /// m/s²/√Hz
    pub accel_noise: f64,
    /// m/s³/√Hz
    pub accel_walk: f64,
    pub correction: ImuCorrection,
}

impl ImuCalibration {
    /// A good consumer unit at 200 Hz.
    pub const CONSUMER: ImuCalibration = ImuCalibration {
        rate_hz: 200.0,
        gyro_noise: 1e-4,
        gyro_walk: 1e-5,
        accel_noise: 1e-3,
        accel_walk: 1e-4,
        correction: ImuCorrection::NONE,
    };
}

#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    pub cameras: Vec<RigCamera>,
    pub imu: ImuCalibration,
}
