//! Sensors of Stipple and the vocabulary they speak.
//!
//! This crate builds and tests without Vulkan or OpenCV. It owns the plain data that crosses from
//! sensors to estimators (`Nanos`, `ImuSample`, `Image`, `Frames`, `Pose`, `Calibration`, `Fault`),
//! the camera models (calibration is a property of the sensor, and the simulator renders with the
//! same models the estimator inverts), what a run reads sensors through (`source`), the reader of recordings and
//! the simulator.

pub mod calibration;
pub mod camera;
pub mod counters;
pub mod euroc;
pub mod fault;
pub mod gpio;
pub mod host;
pub mod imu;
pub mod inject;
pub mod list;
pub mod paced;
pub mod record;
pub mod replay;
pub mod sim;
pub mod source;
pub mod types;
pub mod v4l2;

#[cfg(test)]
#[path = "../../tests/hil/jpeg.rs"]
mod jpeg;

pub use calibration::{Calibration, ImuCalibration, ImuCorrection, RigCamera};
pub use camera::{Camera, Lens};
pub use fault::{Fault, FaultKind};
pub use list::List;
pub use types::{Colour, Frames, Image, ImuSample, Nanos, Pose, Span, TimedPose};
