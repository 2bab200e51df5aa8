//! Training steps from the host's side: started and finished, one ahead of the other, or both at once.

use super::buffers::GROUP;
use super::pipeline::Pipeline;
use super::view::{pose_gradient, stats, Goal, LearningRates, StepStats, View, Weights};
use crate::gpu::kernels::types::Status;
use crate::gpu::{Gpu, GpuError, Ticket, REPORTS};

/// A training step that was started, and what its answer will be read with.
#[must_use]
#[derive(Clone, Copy, Debug)]
pub struct Step {
    ticket: Ticket,
    /// Of its status among the reports.
    place: usize,
    pub view: View,
    goal: Goal,
    weights: Weights,
}

impl Pipeline {
    /// One step on a keyframe, or its slot. The view must have the pipeline's shape.
    pub fn train(
        &mut self,
        gpu: &mut Gpu,
        view: &View,
        goal: impl Into<Goal>,
        rates: &LearningRates,
        weights: &Weights,
    ) -> Result<StepStats, GpuError> {
        self.pass(gpu, view, goal.into(), Some(rates), weights)
    }

    /// What `train` would answer; the map, Adam's moments included, stays as it is to the bit.
    pub fn look(
        &mut self,
        gpu: &mut Gpu,
        view: &View,
        goal: impl Into<Goal>,
        weights: &Weights,
    ) -> Result<StepStats, GpuError> {
        self.pass(gpu, view, goal.into(), None, weights)
    }

    fn pass(
        &mut self,
        gpu: &mut Gpu,
        view: &View,
        goal: Goal,
        rates: Option<&LearningRates>,
        weights: &Weights,
    ) -> Result<StepStats, GpuError> {
        let mut rec = gpu.record();
        self.record_step(&mut rec, view, &goal, rates, weights);
        rec.read_back(self.b.status);
        gpu.submit(rec)?;
        let status = self.status(gpu)?;
        Ok(self.step_stats(view, &goal, weights, &status))
    }

    /// Starts what `train` does. `finish` must have its answer before the step after next is started.
    pub fn start(
        &mut self,
        gpu: &mut Gpu,
        view: &View,
        goal: impl Into<Goal>,
        rates: &LearningRates,
        weights: &Weights,
    ) -> Result<Step, GpuError> {
        let goal = goal.into();
        let place = self.steps_started % REPORTS;
        self.steps_started += 1;
        let mut rec = gpu.record();
        self.record_step(&mut rec, view, &goal, Some(rates), weights);
        rec.report(self.b.status, place);
        let ticket = gpu.start(rec)?;
        Ok(Step { ticket, place, view: *view, goal, weights: *weights })
    }

    /// Waits for a step that was started; its answer.
    pub fn finish(&self, gpu: &mut Gpu, step: &Step) -> Result<StepStats, GpuError> {
        let mut status = [Status::default()];
        gpu.report(step.ticket, step.place, &mut status)?;
        Ok(self.step_stats(&step.view, &step.goal, &step.weights, &status[0]))
    }

    fn step_stats(&self, view: &View, goal: &Goal, weights: &Weights, s: &Status) -> StepStats {
        let valid = f64::from(self.valid_pixels[goal.camera as usize].max(1) * self.shape.channels);
        let (l1, ssim) = (f64::from(s.l1_sum) / valid, f64::from(s.ssim_sum) / valid);
        let lambda = f64::from(weights.ssim);
        StepStats {
            stats: stats(s),
            loss: (1.0 - lambda) * l1 + lambda * (1.0 - ssim),
            l1,
            ssim,
            gradients_rejected: s.gradients_refused as u32,
            pose_gradient: pose_gradient(view, &s.pose),
            exposure_gradient: s.exposure.map(f64::from),
        }
    }

    /// One step down a gradient by pixel that the caller gives in place of a loss: planes by colour.
    pub fn descend(
        &mut self,
        gpu: &mut Gpu,
        view: &View,
        pixel_gradient: &[f32],
        rates: &LearningRates,
        weights: &Weights,
    ) -> Result<StepStats, GpuError> {
        gpu.upload(self.b.pixel_gradient, 0, pixel_gradient)?;
        let mut rec = gpu.record();
        let by_tile = self.record_picture(&mut rec, view, &self.k.raster_forward);
        self.record_update(&mut rec, view, by_tile, Some(rates), weights);
        self.record_summary(&mut rec, 0, self.high_water.div_ceil(GROUP));
        rec.read_back(self.b.status);
        gpu.submit(rec)?;
        let s = self.status(gpu)?;
        Ok(StepStats {
            stats: stats(&s),
            gradients_rejected: s.gradients_refused as u32,
            pose_gradient: pose_gradient(view, &s.pose),
            ..StepStats::default()
        })
    }
}
