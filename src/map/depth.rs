//! Stereo depth of anchors, kept to train on: inverse depth at half the mapping resolution, 12 bits, with a confidence of
//! 4. A cell is two by two pixels. The newest anchors are kept; a new one takes the place of the oldest.

use super::pipeline::{Goal, Pipeline, Weights};
use super::Mapper;
use crate::gpu::kernels::loss_depth;
use crate::gpu::{Gpu, GpuError, Recorder, Threads};
use crate::stereo::DepthMap;

/// Anchors whose depth is kept at most: 12 MB at 752x480.
pub const DEPTHS_MAX: u32 = 64;
/// Nearer than a quarter of a metre stereo of our rigs sees nothing; a step of 12 bits is 1e-3, 0.05 px of EuRoC's rig.
pub const INVERSE_DEPTH_MAX: f32 = 4.0;
const DEPTH_LEVELS: f32 = 4095.0;
const TRUST_LEVELS: f32 = 15.0;

/// Words of one anchor's depths: two cells to a word, whole words a row.
pub fn depth_words(width: u32, height: u32) -> usize {
    width.div_ceil(4) as usize * height.div_ceil(2) as usize
}

/// A cell of inverse depths, zero where there is none, as stored: their median, and as confidence the share that agree with
/// it to a pixel of disparity. Two surfaces in one cell leave little.
fn cell(inverse: &mut [f32], inverse_max: f32, one_px: f32) -> u32 {
    let n = inverse.len() as f32;
    inverse.sort_unstable_by(f32::total_cmp);
    let known = &inverse[inverse.partition_point(|d| *d <= 0.0)..];
    let Some(&median) = known.get(known.len() / 2) else { return 0 };
    let agree = known.iter().filter(|d| (**d - median).abs() <= one_px).count() as f32;
    let level = (median / inverse_max * DEPTH_LEVELS).round().clamp(0.0, DEPTH_LEVELS);
    (level as u32) << 4 | (agree / n * TRUST_LEVELS).round() as u32
}

impl Pipeline {
    /// Keeps an anchor's depth in place `index`, less than `depths_max`. `one_px` is the inverse depth of a pixel of
    /// disparity, 1/m.
    pub fn set_depth(&mut self, gpu: &mut Gpu, index: u32, depth: &DepthMap, one_px: f64) -> Result<(), GpuError> {
        let (w, h) = (depth.width, depth.height);
        self.words.clear();
        for y in (0..h).step_by(2) {
            for x in (0..w).step_by(4) {
                let stored = |x: usize| {
                    let mut of = [0.0; 4];
                    let inside = [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)];
                    let metres = inside.iter().filter(|(x, y)| *x < w && *y < h).map(|(x, y)| depth.metres[y * w + x]);
                    let mut n = 0;
                    for z in metres {
                        of[n] = if z > 0.0 { 1.0 / z } else { 0.0 };
                        n += 1;
                    }
                    cell(&mut of[..n], INVERSE_DEPTH_MAX, one_px as f32)
                };
                self.words.push(stored(x) | stored(x + 2) << 16);
            }
        }
        let words = depth_words(self.shape.width, self.shape.height);
        gpu.upload(self.b.anchor_depths, index as usize * words, &self.words)
    }

    /// After the loss of the picture; its planes of the gradient are the last two.
    pub(super) fn record_loss_depth(&self, rec: &mut Recorder, goal: &Goal, anchor: u32, weights: &Weights) {
        let (b, [w, h]) = (&self.b, [self.shape.width, self.shape.height]);
        let push = loss_depth::Push {
            size: [w, h],
            anchor: anchor * depth_words(w, h) as u32,
            inverse_max: INVERSE_DEPTH_MAX,
            weight: weights.depth / self.valid_pixels[goal.camera as usize].max(1) as f32,
        };
        let bind = loss_depth::Bind {
            rendered: b.rendered.read(),
            anchor_depths: b.anchor_depths.read(),
            pixel_gradient: b.pixel_gradient.write(),
        };
        rec.dispatch(&self.k.loss_depth, bind, push, Threads::d1(w * h));
    }

    /// Anchors whose depths there is room for.
    pub fn depths_max(&self) -> u32 {
        self.shape.depths()
    }
}

impl Mapper {
    /// Keeps the depth just matched for an anchor, where it is trained on; of a fisheye along the rays, as its raster
    /// renders it.
    pub(super) fn keep_depth(&mut self, index: usize) -> Result<(), GpuError> {
        if !self.pipeline.shape().inverse_depth {
            return Ok(());
        }
        let place = self.store.keep_depth(index, self.pipeline.depths_max());
        let camera = self.stereo.camera();
        let one_px = 1.0 / (camera.pinhole.fx * camera.baseline_m);
        let depth = self.pair.as_ref().map_or(&self.depth, |pair| &pair.distance);
        self.pipeline.set_depth(&mut self.gpu, place, depth, one_px)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cell_keeps_its_median_and_trusts_what_agrees() {
        let of = |mut v: [f32; 4]| {
            let stored = cell(&mut v, 4.0, 0.02);
            (f64::from(stored >> 4) * 4.0 / 4095.0, stored & 15)
        };
        let (d, trust) = of([0.5, 0.51, 0.49, 0.5]);
        assert!((d - 0.5).abs() < 1e-3 && trust == 15);
        assert_eq!(of([0.0; 4]), (0.0, 0));
        assert_eq!(of([0.0, 0.0, 0.5, 0.0]).1, 4);
        assert_eq!(of([1.0, 1.0, 0.5, 0.5]).1, 8);
        assert_eq!(cell(&mut [], 4.0, 0.02), 0);
        assert_eq!(of([9.0; 4]).0, 4.0);
    }
}
