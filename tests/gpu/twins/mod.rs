//! f64 references of the kernels, by stage, for scenes of a few dozen Gaussians.

pub mod dual;
pub mod loss;
pub mod project;
pub mod raster;

use project::{Parameters, Projected};
use stipple::map::pipeline::View;

/// Loss of a scene against a target and its gradient by every parameter and the pose twist.
pub struct Step {
    pub rendered: raster::Rendered,
    pub loss: loss::Loss,
    pub splats: Vec<[f64; 12]>,
    pub twist: [f64; 6],
}

pub fn project_all(splats: &[Parameters], view: &View, twist: &[f64; 6]) -> Vec<Option<Projected>> {
    let visible = |p: &Projected| p[5].v > raster::ALPHA_MIN;
    splats.iter().map(|p| project::project(p, view, twist).filter(visible)).collect()
}

pub fn step(
    splats: &[Parameters],
    view: &View,
    twist: &[f64; 6],
    target: &[f64],
    mask: &[u8],
    ssim_weight: f64,
) -> Step {
    let (w, h) = (view.camera.width, view.camera.height);
    let projected = project_all(splats, view, twist);
    let rendered = raster::forward(&projected, w, h);
    let loss = loss::loss(&rendered.grey, target, mask, w, h, ssim_weight);
    let image = raster::backward(&projected, w, h, &loss.gradient);
    let mut out = Step { rendered, loss, splats: vec![[0.0; 12]; splats.len()], twist: [0.0; 6] };
    for (i, p) in projected.iter().enumerate() {
        let Some(p) = p else { continue };
        for (v, d) in image[i].iter().zip(p) {
            (0..12).for_each(|k| out.splats[i][k] += v * d.d[k]);
            (0..6).for_each(|k| out.twist[k] += v * d.d[12 + k]);
        }
    }
    out
}
