//! How good the map is: PSNR and SSIM of rendered keyframes, and pictures of some of them.
//!
//! Held-out keyframes are scored at the pose they came with, and once more with that pose refined on the image
//! alone (the map stands still): the difference is the pose's share of the error.

use super::evaluate::{mse, psnr_db, Ssim};
use super::pipeline::{LearningRates, Weights};
use super::pose::PoseAdam;
use super::Mapper;
use crate::gpu::GpuError;
use stipple_drivers::Pose;

/// A cheap probe on a few views, through the run.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CurvePoint {
    pub t_s: f64,
    pub psnr_db: Option<f64>,
    pub psnr_heldout_db: Option<f64>,
    pub splats: u32,
    pub iterations: u64,
}

/// Means over all keyframes of a kind; `None` where there are none.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Evaluation {
    pub psnr_db: Option<f64>,
    pub ssim: Option<f64>,
    pub psnr_heldout_db: Option<f64>,
    pub ssim_heldout: Option<f64>,
    pub psnr_heldout_aligned_db: Option<f64>,
}

/// A keyframe and its rendering, row-major at mapping resolution.
#[derive(Clone, Debug, Default)]
pub struct Panel {
    pub name: String,
    pub width: usize,
    pub height: usize,
    pub observed: Vec<u8>,
    pub rendered: Vec<f32>,
    /// |observed - rendered|, 0 where not compared.
    pub error: Vec<f32>,
    /// m, 0 where there is none.
    pub depth: Vec<f32>,
    /// Zero where not compared.
    pub valid: Vec<u8>,
    pub psnr_db: Option<f64>,
}

/// Views of a probe, of each kind.
const PROBED: usize = 5;
/// Steps of a pose refinement, and the first one's size, m and rad; each is a little smaller than the last.
const ALIGN_STEPS: i32 = 50;
const ALIGN_RATE: f64 = 2e-3;
const ALIGN_DECAY: f64 = 0.93;

/// Sums of one kind of keyframes.
#[derive(Default)]
struct Mean {
    sum: f64,
    n: u32,
}

impl Mean {
    fn add(&mut self, value: Option<f64>) {
        if let Some(v) = value {
            self.sum += v;
            self.n += 1;
        }
    }

    fn get(&self) -> Option<f64> {
        (self.n > 0).then(|| self.sum / f64::from(self.n))
    }
}

impl Mapper {
    /// Scores a few keyframes spread over the run. Allocates.
    pub fn sample(&mut self, t_s: f64) -> Result<CurvePoint, GpuError> {
        let mut means = [Mean::default(), Mean::default()];
        for (held_out, mean) in means.iter_mut().enumerate() {
            let of_kind: Vec<usize> =
                (0..self.store.len()).filter(|&i| self.store.get(i).held_out == (held_out == 1)).collect();
            for i in spread(&of_kind, PROBED) {
                mean.add(self.score(i)?);
            }
        }
        Ok(CurvePoint {
            t_s,
            psnr_db: means[0].get(),
            psnr_heldout_db: means[1].get(),
            splats: self.splat_count() as u32,
            iterations: self.iterations(),
        })
    }

    /// Scores every keyframe. Allocates. Aligning held-out views disturbs Adam's moments, so this ends a run.
    pub fn evaluate(&mut self) -> Result<Evaluation, GpuError> {
        let camera = self.stereo.camera().pinhole;
        let mut ssim_of = Ssim::new(camera.width, camera.height);
        let (mut psnr, mut ssim) = ([Mean::default(), Mean::default()], [Mean::default(), Mean::default()]);
        let mut aligned = Mean::default();
        for i in 0..self.store.len() {
            let held_out = self.store.get(i).held_out;
            psnr[usize::from(held_out)].add(self.score(i)?);
            let observed = self.observed(i);
            let s = ssim_of.mean(&observed, &self.rendered.grey, self.stereo.valid_mask());
            ssim[usize::from(held_out)].add(s);
        }
        for i in (0..self.store.len()).filter(|&i| self.store.get(i).held_out).collect::<Vec<_>>() {
            let given = self.store.get(i).world_from_body;
            self.store.get_mut(i).world_from_body = self.aligned(i)?;
            aligned.add(self.score(i)?);
            self.store.get_mut(i).world_from_body = given;
        }
        Ok(Evaluation {
            psnr_db: psnr[0].get(),
            ssim: ssim[0].get(),
            psnr_heldout_db: psnr[1].get(),
            ssim_heldout: ssim[1].get(),
            psnr_heldout_aligned_db: aligned.get(),
        })
    }

    /// Pictures of `count` keyframes spread over the run. Allocates.
    pub fn panels(&mut self, count: usize) -> Result<Vec<Panel>, GpuError> {
        let all: Vec<usize> = (0..self.store.len()).collect();
        let mut panels = Vec::with_capacity(count);
        for i in spread(&all, count) {
            let psnr_db = self.score(i)?;
            let (observed, valid) = (self.store.image(i).pixels.clone(), self.stereo.valid_mask().to_vec());
            let r = &self.rendered;
            let error = |k: usize| match valid[k] {
                0 => 0.0,
                _ => (f32::from(observed[k]) / 255.0 - r.grey[k].clamp(0.0, 1.0)).abs(),
            };
            let kind = if self.store.get(i).held_out { "_heldout" } else { "" };
            panels.push(Panel {
                name: format!("{:04}{kind}", self.store.get(i).id),
                width: r.width,
                height: r.height,
                error: (0..valid.len()).map(error).collect(),
                rendered: r.grey.clone(),
                depth: r.depth.clone(),
                observed,
                valid,
                psnr_db,
            });
        }
        Ok(panels)
    }

    /// Renders a keyframe into `self.rendered` and compares; `None` where nothing is valid.
    fn score(&mut self, index: usize) -> Result<Option<f64>, GpuError> {
        let view = self.view(index);
        self.pipeline.render(&mut self.gpu, &view, &mut self.rendered)?;
        Ok(mse(&self.observed(index), &self.rendered.grey, self.stereo.valid_mask()).map(psnr_db))
    }

    fn observed(&self, index: usize) -> Vec<f32> {
        self.store.image(index).pixels.iter().map(|p| f32::from(*p) / 255.0).collect()
    }

    /// The pose of a keyframe from which the map looks most like its image; the map stands still.
    fn aligned(&mut self, index: usize) -> Result<Pose, GpuError> {
        let still = LearningRates { position: 0.0, scale: 0.0, rotation: 0.0, opacity: 0.0, colour: 0.0 };
        let weights = Weights { ssim: self.config.ssim_weight as f32, ..Weights::default() };
        let rect_from_body = self.stereo.camera().body_from_rect.inverse();
        let mut view = self.view(index);
        let mut adam = PoseAdam::default();
        let (mut best, mut best_loss) = (view.world_from_cam, f64::INFINITY);
        for k in 0..ALIGN_STEPS {
            let done = self.pipeline.train(&mut self.gpu, &view, index as u32, &still, &weights)?;
            if done.loss < best_loss {
                (best, best_loss) = (view.world_from_cam, done.loss);
            }
            adam.step(&mut view.world_from_cam, &done.pose_gradient, ALIGN_RATE * ALIGN_DECAY.powi(k));
        }
        Ok(best * rect_from_body)
    }
}

/// At most `count` of the items, evenly spread, first and last included.
fn spread(items: &[usize], count: usize) -> Vec<usize> {
    let n = items.len();
    if n <= count {
        return items.to_vec();
    }
    (0..count).map(|k| items[k * (n - 1) / (count - 1).max(1)]).collect()
}

#[cfg(test)]
mod tests {
    use super::spread;

    #[test]
    fn spread_takes_first_and_last() {
        let items: Vec<usize> = (10..30).collect();
        assert_eq!(spread(&items, 3), [10, 19, 29]);
        assert_eq!(spread(&items[..2], 3), [10, 11]);
        assert_eq!(spread(&items, 1), [10]);
    }
}
