//! What goes into a training step and what comes out of it.

use super::coarseness::Coarseness;
use super::exposure::Exposure;
use super::horizon::Absent;
use super::view::View;
use crate::gpu::kernels::types::Status;
use glam::DVec3;

/// What a step compares the rendering with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Target {
    /// Place of the stored image.
    pub image: u32,
    /// The camera whose mask holds.
    pub camera: u32,
    /// In which the rendering is compared.
    pub exposure: Exposure,
    /// Where the map has more than is in the pool; `None` where all that it shows is there.
    pub absent: Option<Absent>,
    /// Both are drawn and compared at half the size.
    pub half_size: bool,
}

impl From<u32> for Target {
    fn from(image: u32) -> Target {
        Target { image, camera: 0, exposure: Exposure::default(), absent: None, half_size: false }
    }
}

/// Adam step sizes: m, ln m, quaternion, logit, level.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LearningRates {
    pub position: f32,
    pub scale: f32,
    pub rotation: f32,
    pub opacity: f32,
    pub colour: f32,
}

/// Weights of the loss (1 - ssim)·L1 + ssim·(1 - SSIM) + mean over the visible of the rest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weights {
    pub ssim: f32,
    /// On ln(longest axis / second axis) above ln 3.
    pub needle: f32,
    /// On ln(longest axis) above ln(scale_soft_m).
    pub scale: f32,
    pub scale_soft_m: f32,
    /// On the opacity.
    pub opacity: f32,
}

impl Default for Weights {
    fn default() -> Self {
        Weights { ssim: 0.2, needle: 0.1, scale: 0.1, scale_soft_m: 0.1, opacity: 0.0 }
    }
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Stats {
    pub visible: u32,
    /// Places of the list that are taken: one for each (Gaussian, tile) pair, and gaps of fewer than 16 after those of 64 slots.
    pub intersections: u32,
    /// Places there was no room for. None of a picture, which is drawn coarser until it fits.
    pub overflow: u32,
    /// Gaussians culled for not being finite.
    pub failed: u32,
    /// What was left out, that the rest might fit.
    pub coarseness: Coarseness,
}

impl Stats {
    /// What the device says of a picture from `view`.
    pub(super) fn new(s: &Status, view: &View) -> Stats {
        Stats {
            visible: s.visible,
            intersections: s.intersections,
            overflow: s.intersections_needed - s.intersections,
            failed: s.not_finite,
            coarseness: view.coarseness,
        }
    }

    /// Places that the picture would have taken in a list with room.
    pub fn needed(&self) -> u32 {
        self.intersections + self.overflow
    }
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepStats {
    pub stats: Stats,
    pub loss: f64,
    pub l1: f64,
    pub ssim: f64,
    /// Gaussians not moved because their gradient was not finite.
    pub gradients_rejected: u32,
    /// Gradient by [p, θ] of world_from_cam: p additive in world, rotation perturbed on the right.
    pub pose_gradient: [f64; 6],
    /// Gradient by [gain, offset].
    pub exposure_gradient: [f64; 2],
}

impl StepStats {
    /// What the device says of a step from `view` on `values` compared values.
    pub(super) fn new(s: &Status, view: &View, values: f64, ssim_weight: f32) -> StepStats {
        let (l1, ssim) = (f64::from(s.l1_sum) / values, f64::from(s.ssim_sum) / values);
        let lambda = f64::from(ssim_weight);
        StepStats {
            stats: Stats::new(s, view),
            loss: (1.0 - lambda) * l1 + lambda * (1.0 - ssim),
            l1,
            ssim,
            gradients_rejected: s.gradients_refused as u32,
            pose_gradient: pose_gradient(view, &s.pose),
            exposure_gradient: s.exposure.map(f64::from),
        }
    }
}

/// From points moved in the camera frame to the camera moved in the world.
fn pose_gradient(view: &View, g: &[f32; 6]) -> [f64; 6] {
    let v = |i: usize| DVec3::new(f64::from(g[i]), f64::from(g[i + 1]), f64::from(g[i + 2]));
    let (p, turn) = (-(view.world_from_cam.q * v(0)), -v(3));
    [p.x, p.y, p.z, turn.x, turn.y, turn.z]
}
