//! The calibration of a rig: lenses, poses and timing of its cameras, noise and axes of its inertial unit.
//!
//! Time: `t_imu = t_cam + time_offset` (the sign of Kalibr's `timeshift_cam_imu` and of Basalt's `cam_time_offset_ns`),
//! where a camera stamps the middle of its first row's exposure. Downstream, the stamp of an image is that of its *middle*
//! row in the unit's clock: rows are then at most half a readout away, and code without a model of the rolling shutter errs
//! least. `RigCamera::to_imu_clock` converts the one into the other; `ImuCorrection::apply` corrects the unit's readings. A
//! source applies both before anyone else sees its data (recordings: `replay::Recording::open`), so everything downstream
//! is in the unit's clock and along orthogonal axes, and an online estimate of either is what the calibration left over.

use crate::camera::Camera;
use crate::types::{Frames, Image, ImuSample, Nanos, Pose, Span};
use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

/// Most masks of a camera.
pub const MASKS_MAX: usize = 8;

/// A rectangle of a raw image in which the vehicle itself is seen: columns `left..right` of rows `top..bottom`, px. The default
/// is none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Mask {
    pub left: u32,
    pub top: u32,
    pub right: u32,
    pub bottom: u32,
}

/// A camera of the rig: its lens, its pose and its timing.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RigCamera {
    /// Size and lens.
    pub camera: Camera,
    /// `body_from_cam`, m: the camera's frame is x right, y down, z forward, the body's that of the inertial unit.
    pub body_from_cam: Pose,
    /// The inertial unit's clock less the camera's.
    pub time_offset: Span,
    /// From the first row's exposure to the last one's; zero is a global shutter.
    pub readout: Span,
    /// Where the vehicle is in view.
    #[serde(default)]
    pub masks: [Mask; MASKS_MAX],
}

impl RigCamera {
    /// A camera with a global shutter in the inertial unit's clock.
    pub fn new(camera: Camera, body_from_cam: Pose) -> RigCamera {
        RigCamera { camera, body_from_cam, time_offset: Span(0), readout: Span(0), masks: Default::default() }
    }

    /// Whether the vehicle is in view at a pixel; integer = pixel centre.
    pub fn is_masked(&self, x: f64, y: f64) -> bool {
        let within = |v: f64, low: u32, high: u32| v + 0.5 >= f64::from(low) && v + 0.5 < f64::from(high);
        self.masks.iter().any(|m| within(x, m.left, m.right) && within(y, m.top, m.bottom))
    }

    /// Pixels in which the vehicle is not in view.
    pub fn free_pixels(&self) -> usize {
        let free = |y: usize| (0..self.camera.width).filter(|x| !self.is_masked(*x as f64, y as f64)).count();
        (0..self.camera.height).map(free).sum()
    }

    /// The instant of an image's middle row in the inertial unit's clock, from the camera's own stamp.
    pub fn to_imu_clock(&self, t: Nanos) -> Nanos {
        t + self.time_offset + Span(self.readout.0 / 2)
    }

    /// The camera's own stamp of an image that is stamped `t` downstream.
    pub fn from_imu_clock(&self, t: Nanos) -> Nanos {
        t - self.time_offset - Span(self.readout.0 / 2)
    }

    /// Exposure of a row after the image's stamp downstream, s.
    pub fn row_delay(&self, row: f64) -> f64 {
        self.readout.secs() * (row / (self.camera.height - 1).max(1) as f64 - 0.5)
    }
}

/// The correction of a unit's readings: the true rate or force is `scale * reading - bias`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ImuCorrection {
    /// Scale and misalignment of the gyro's axes.
    pub gyro_scale: DMat3,
    /// Scale and misalignment of the accelerometer's axes.
    pub accel_scale: DMat3,
    /// rad/s, of the gyro's axes.
    pub gyro_bias: DVec3,
    /// m/s², of the accelerometer's axes.
    pub accel_bias: DVec3,
}

impl ImuCorrection {
    /// The correction that changes nothing.
    pub const NONE: ImuCorrection = ImuCorrection {
        gyro_scale: DMat3::IDENTITY,
        accel_scale: DMat3::IDENTITY,
        gyro_bias: DVec3::ZERO,
        accel_bias: DVec3::ZERO,
    };

    /// The true sample of a reading.
    pub fn apply(&self, s: &ImuSample) -> ImuSample {
        ImuSample {
            gyro_body: self.gyro_scale * s.gyro_body - self.gyro_bias,
            accel_body: self.accel_scale * s.accel_body - self.accel_bias,
            ..*s
        }
    }

    /// The reading of a true sample.
    pub fn undo(&self, s: &ImuSample) -> ImuSample {
        ImuSample {
            gyro_body: self.gyro_scale.inverse() * (s.gyro_body + self.gyro_bias),
            accel_body: self.accel_scale.inverse() * (s.accel_body + self.accel_bias),
            ..*s
        }
    }
}

/// Continuous-time noise densities of the inertial unit, and the correction of its axes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ImuCalibration {
    pub rate_hz: f64,
    /// White noise of the gyro, rad/s per √Hz.
    pub gyro_noise: f64,
    /// Random walk of the gyro's bias, rad/s per s and √Hz.
    pub gyro_walk: f64,
    /// White noise of the accelerometer, m/s² per √Hz.
    pub accel_noise: f64,
    /// Random walk of the accelerometer's bias, m/s² per s and √Hz.
    pub accel_walk: f64,
    /// Whether these figures were measured on this very unit; else they are those of a data sheet or of another unit.
    pub measured: bool,
    /// Ends of the ranges of gyro and accelerometer, rad/s and m/s².
    pub range: [f64; 2],
    /// Correction of readings that a source applies.
    pub correction: ImuCorrection,
}

impl ImuCalibration {
    /// 2000 degrees a second and 16 g: ranges of consumer units that a drone does not leave.
    pub const RANGE: [f64; 2] = [34.906_585, 156.906_4];
    /// A good consumer unit at 200 Hz.
    pub const CONSUMER: ImuCalibration = ImuCalibration {
        rate_hz: 200.0,
        gyro_noise: 1e-4,
        gyro_walk: 1e-5,
        accel_noise: 1e-3,
        accel_walk: 1e-4,
        measured: false,
        range: ImuCalibration::RANGE,
        correction: ImuCorrection::NONE,
    };
}

/// The calibration of a rig; the body frame is that of the inertial unit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Cameras in the order of their images, cam0 first.
    pub cameras: Vec<RigCamera>,
    /// The inertial unit, whose frame is the body's.
    pub imu: ImuCalibration,
}

impl Frames {
    /// Black images in the shape of a rig, so that reading into them allocates nothing.
    pub fn for_rig(calibration: &Calibration) -> Frames {
        let shape = |c: &RigCamera| Image::new(c.camera.width, c.camera.height);
        Frames { t: Nanos(0), images: calibration.cameras.iter().map(shape).collect(), colours: Vec::new() }
    }

    /// The same, with colours of the first `cameras`.
    pub fn in_colour(calibration: &Calibration, cameras: usize) -> Frames {
        let mut frames = Frames::for_rig(calibration);
        frames.colours = frames.images.iter().take(cameras).map(|i| std::array::from_fn(|_| i.clone())).collect();
        frames
    }
}
