//! What stays constant while estimating: the cameras as calibrated, the noise of the inertial unit, the settings.

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
}

impl Model {
    pub fn new(calibration: &Calibration, config: &VioConfig) -> Model {
        Model {
            cameras: calibration.cameras.iter().take(CAMERAS_MAX).map(CameraModel::from).collect(),
            noise: Noise::new(&calibration.imu, config),
            config: config.clone(),
        }
    }
}
