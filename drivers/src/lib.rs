//! Sensors, and the plain data that crosses from them to estimators.
//!
//! - vocabulary: `types` (`Nanos`, `ImuSample`, `Image`, `Frames`, `Pose`), `calibration` and `camera` (the simulator renders
//!   with the models that the estimator inverts), `fault`, `counters`, `list`
//! - sources of frames and samples behind three traits (`source`): cameras (`v4l2`), inertial units (`imu`), barometers (`baro`), recordings
//!   (`replay`, played by `paced`), faults on purpose (`inject`); lines of GPIO (`gpio`)
//! - written recordings (`record`, `euroc`) and the simulator (`sim`)
//! - the operating system (`host`), memory that two processes share (`shared`)
//!
//! It builds and tests without Vulkan or OpenCV and knows nothing of the program: no threads of its own but the recorder's
//! writer and the simulator's renderers, no configuration file, no exit codes.

pub mod baro;
pub mod calibration;
pub mod camera;
pub mod counters;
pub mod euroc;
pub mod fault;
pub mod gpio;
pub mod host;
pub mod imu;
pub mod inject;
pub mod input;
mod jpeg_scan;
pub mod list;
pub mod paced;
pub mod record;
pub mod replay;
pub mod shared;
pub mod sim;
pub mod source;
pub mod types;
pub mod v4l2;
mod ycbcr;

#[cfg(test)]
#[path = "../../tests/hil/jpeg.rs"]
mod jpeg;

pub use calibration::{Calibration, ImuCalibration, ImuCorrection, RigCamera};
pub use camera::{Camera, Lens};
pub use fault::{Fault, FaultKind};
pub use list::List;
pub use types::{Colour, Frames, Image, ImuSample, Nanos, Pose, Span, TimedPose};
