//! What stays constant while estimating: the cameras as calibrated, the noise of the inertial unit, the settings.

use super::health::landmarks_enough;
use super::preintegration::Noise;
use super::reprojection::{huber, huber_scale, CameraModel, CURVATURE};
use super::window::Frame;
use crate::config::VioConfig;
use crate::limits::CAMERAS_MAX;
use glam::{DMat2, DVec2};
use stipple_drivers::{Calibration, RigCamera};

/// Deviation of a view of a doubted frame, as a factor on that of other views, and Huber's width for it, in such deviations.
const DOUBTED_SIGMA: f64 = 5.0 / 3.0;
const DOUBTED_WIDTH: f64 = 2.0;

/// Noise of a view: Gaussian errors, and Huber's cost of them.
#[derive(Clone, Copy, Debug)]
pub struct ViewNoise {
    /// Inverse deviation by which errors are whitened, 1/px: the squared rows then sum up to what the estimate knows.
    inv_sigma: f64,
    /// Width of Huber's weight, in those deviations.
    width: f64,
}

impl ViewNoise {
    fn new(sigma_px: f64, width_px: f64) -> ViewNoise {
        let inv_sigma = 1.0 / (sigma_px * huber_scale(width_px / sigma_px));
        ViewNoise { inv_sigma, width: width_px * inv_sigma }
    }

    /// Cost of a view that is off by so many px.
    pub fn cost(&self, off_px: f64) -> f64 {
        huber(off_px * self.inv_sigma, self.width).1
    }

    /// Whitening of a view that is off by `px`.
    pub fn whiten(&self, px: DVec2) -> Whitened {
        let off = px.length();
        let (weight, cost) = huber(off * self.inv_sigma, self.width);
        let scale = weight.sqrt() * self.inv_sigma;
        if weight == 1.0 {
            return Whitened { rows: DMat2::from_diagonal(DVec2::splat(scale)), error: px * scale, cost };
        }
        let along = px / off;
        let rows = DMat2::IDENTITY - DMat2::from_cols(along * along.x, along * along.y) * (1.0 - CURVATURE.sqrt());
        Whitened { rows: rows * scale, error: px * (scale / CURVATURE.sqrt()), cost }
    }
}

/// The two rows of a view `[J | r]`, in px, as they go into the normal equations: `rows J` and `error`. Their square has the
/// gradient of Huber's cost.
#[derive(Clone, Copy, Debug)]
pub struct Whitened {
    /// 1/px; symmetric.
    pub rows: DMat2,
    /// Without unit.
    pub error: DVec2,
    pub cost: f64,
}

/// Constants of one rig and its settings.
#[derive(Clone, Debug)]
pub struct Model {
    pub cameras: Vec<CameraModel>,
    pub noise: Noise,
    pub config: VioConfig,
    /// Noise of the views of a frame, and of one in doubt.
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
                let pixels = calibration.cameras.iter().map(RigCamera::free_pixels).max();
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

#[cfg(test)]
mod tests {
    use super::super::world::{Path, World};
    use super::*;
    use stipple_drivers::calibration::Mask;

    #[test]
    fn whitened_rows_have_the_gradient_of_the_cost_and_the_stated_curvature() {
        const H: f64 = 1e-6;
        let noise = ViewNoise::new(0.3, 0.2);
        for px in [DVec2::ZERO, DVec2::new(0.03, -0.05), DVec2::new(0.7, 0.2), DVec2::new(-3.0, 40.0)] {
            let Whitened { rows, error, cost } = noise.whiten(px);
            assert_eq!(cost, noise.cost(px.length()));
            let slope =
                |axis: DVec2| (noise.cost((px + axis * H).length()) - noise.cost((px - axis * H).length())) / (2.0 * H);
            let off = rows * error - DVec2::new(slope(DVec2::X), slope(DVec2::Y));
            assert!(off.length() < 1e-5, "{px}: the gradient is off by {off}");
            let along = px.normalize_or(DVec2::X);
            let [on, across] = [along, along.perp()].map(|axis| (rows * axis).length_squared());
            let share = if px.length() > 0.2 { CURVATURE } else { 1.0 };
            assert!((on - share * across).abs() < 1e-9 * across, "{px}: {on} along, {across} across");
        }
    }

    /// A camera that sees the vehicle in three quarters of its image holds as many landmarks as a smaller one.
    #[test]
    fn landmarks_that_are_enough_are_those_that_the_masks_leave_room_for() {
        let mut calibration = World::new(Path { rest: 0.0 }).rig;
        let (width, height) = (calibration.cameras[0].camera.width as u32, calibration.cameras[0].camera.height as u32);
        let whole = Model::new(&calibration, &VioConfig::default()).landmarks_enough;
        for camera in &mut calibration.cameras {
            camera.masks[0] = Mask { left: 0, top: 0, right: width, bottom: height / 2 };
            camera.masks[1] = Mask { left: 0, top: 0, right: width / 2, bottom: height };
        }
        let masked = Model::new(&calibration, &VioConfig::default()).landmarks_enough;
        assert!((whole - 40.0).abs() < 0.1 && (masked - 10.0).abs() < 0.1, "{whole} {masked}");
    }
}
