//! What stays constant while estimating: the cameras as calibrated, the noise of the inertial unit, the settings.

use super::health::landmarks_enough;
use super::preintegration::Noise;
use super::reprojection::CameraModel;
use crate::config::VioConfig;
use crate::limits::CAMERAS_MAX;
use stipple_drivers::Calibration;

/// Constants of one rig and its settings.
#[derive(Clone, Debug)]
pub struct Model {
    pub cameras: Vec<CameraModel>,
    pub noise: Noise,
    pub config: VioConfig,
    /// Number of landmarks in view that is enough for the largest image of the rig, without unit.
    pub landmarks_enough: f64,
}

impl Model {
    pub fn new(calibration: &Calibration, config: &VioConfig) -> Model {
        Model {
            cameras: calibration.cameras.iter().take(CAMERAS_MAX).map(CameraModel::from).collect(),
            noise: Noise::new(&calibration.imu, config),
            config: config.clone(),
            landmarks_enough: {
                let pixels = calibration.cameras.iter().map(|c| c.camera.width * c.camera.height).max();
                landmarks_enough(pixels.unwrap_or(0))
            },
        }
    }
}
