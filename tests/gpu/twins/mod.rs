//! f64 references of the kernels, by stage, for scenes of a few dozen Gaussians.

pub mod chunks;
pub mod compare;
pub mod dual;
pub mod lists;
pub mod loss;
pub mod occupancy;
pub mod pool;
pub mod project;
pub mod raster;
pub mod stereo;
pub mod summary;

use project::{Parameters, Projected};
use stipple::map::View;

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

/// A step on a picture before a backdrop, by pixel.
pub fn step(
    backdrop: &[f64],
    splats: &[Parameters],
    view: &View,
    twist: &[f64; 6],
    target: &[f64],
    mask: &[u8],
    ssim_weight: f64,
) -> Step {
    let (w, h) = (view.camera.width, view.camera.height);
    let projected = project_all(splats, view, twist);
    let mut rendered = raster::forward(&flat(&projected), w, h);
    let lights = rendered.transmittance.iter().zip(backdrop).map(|(t, b)| t * b);
    rendered.planes.colour[0].iter_mut().zip(lights).for_each(|(c, light)| *c += light);
    let loss = loss::loss(&rendered.planes.colour[0], target, mask, w, h, ssim_weight);
    let worth: Vec<f64> = loss.gradient.iter().zip(backdrop).map(|(v, b)| v * b).collect();
    let (splats, twist) = descend(&projected, view, &raster::Planes::grey(&loss.gradient), &worth);
    Step { rendered, loss, splats, twist }
}

pub fn flat(projected: &[Option<Projected>]) -> Vec<Option<raster::Flat>> {
    projected.iter().map(|p| p.as_ref().map(raster::flat)).collect()
}

/// From a gradient by pixel, and what light that passes all Gaussians of a pixel is worth, to that by every parameter and the
/// pose twist.
pub fn descend(
    projected: &[Option<Projected>],
    view: &View,
    v: &raster::Planes,
    behind: &[f64],
) -> (Vec<[f64; 12]>, [f64; 6]) {
    let image = raster::backward(&flat(projected), view.camera.width, view.camera.height, v, behind);
    let (mut splats, mut twist) = (vec![[0.0; 12]; projected.len()], [0.0; 6]);
    for (i, p) in projected.iter().enumerate() {
        let Some(p) = p else { continue };
        for (v, d) in image[i].iter().zip(p) {
            (0..12).for_each(|k| splats[i][k] += v * d.d[k]);
            (0..6).for_each(|k| twist[k] += v * d.d[12 + k]);
        }
    }
    (splats, twist)
}
