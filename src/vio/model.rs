//! What stays constant while estimating: the cameras as calibrated, the noise of the inertial unit, the settings.

use super::health::landmarks_enough;
use super::preintegration::Noise;
use super::reprojection::{huber, huber_scale, CameraModel};
use super::window::Frame;
use crate::config::VioConfig;
use crate::limits::CAMERAS_MAX;
use stipple_drivers::Calibration;

/// Deviation of a view of a doubted frame, as a factor on that of other views, and Huber's width for it, in such deviations.
const DOUBTED_SIGMA: f64 = 5.0 / 3.0;
const DOUBTED_WIDTH: f64 = 2.0;

/// By how much views count.
#[derive(Clone, Copy, Debug)]
pub struct ViewNoise {
    /// Inverse deviation by which errors are whitened, 1/px: Huber's weights then sum up to what the estimate knows.
    inv_sigma: f64,
    /// Width of Huber's weight, in those deviations.
    width: f64,
}

impl ViewNoise {
    fn new(sigma_px: f64, width_px: f64) -> ViewNoise {
        let inv_sigma = 1.0 / (sigma_px * huber_scale(width_px / sigma_px));
        ViewNoise { inv_sigma, width: width_px * inv_sigma }
    }

    /// Factor on the rows of a view that is off by so many px, 1/px, and its cost.
    pub fn weigh(&self, off_px: f64) -> (f64, f64) {
        let (weight, cost) = huber(off_px * self.inv_sigma, self.width);
        (weight.sqrt() * self.inv_sigma, cost)
    }
}

/// Constants of one rig and its settings.
#[derive(Clone, Debug)]
pub struct Model {
    pub cameras: Vec<CameraModel>,
    pub noise: Noise,
    pub config: VioConfig,
    views: ViewNoise,
    doubted_views: ViewNoise,
    /// Number of landmarks in view that is enough for the largest image of the rig, without unit.
    pub landmarks_enough: f64,
}

impl Model {
    pub fn new(calibration: &Calibration, config: &VioConfig) -> Model {
        let (sigma, width) = (config.observation_sigma_px, config.huber_px);
        Model {
            views: ViewNoise::new(sigma, width),
            doubted_views: ViewNoise::new(DOUBTED_SIGMA * sigma, DOUBTED_WIDTH * DOUBTED_SIGMA * sigma),
            cameras: calibration.cameras.iter().take(CAMERAS_MAX).map(CameraModel::from).collect(),
            noise: Noise::new(&calibration.imu, config),
            config: config.clone(),
            landmarks_enough: {
                let pixels = calibration.cameras.iter().map(|c| c.camera.width * c.camera.height).max();
                landmarks_enough(pixels.unwrap_or(0))
            },
        }
    }

    /// Noise of the views of a frame.
    pub fn view_noise(&self, frame: &Frame) -> &ViewNoise {
        if frame.doubted {
            &self.doubted_views
        } else {
            &self.views
        }
    }
}
