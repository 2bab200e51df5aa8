//! What trains the map: which image is next, at which rates, and what a step says of its keyframe's pose and exposure.
//!
//! A step is started before the one before it is finished, so that the device never waits for the host. What a step says
//! is therefore taken in exactly one step late, whenever the device ends it, and before anything else is done with the
//! map: the same seed and keyframes give the same map to the bit.

use super::archive::Archive;
use super::coarseness::Coarseness;
use super::pipeline::Step;
use super::scene::Scene;
use super::schedule::{Rng, Schedule};
use super::step::{LearningRates, StepStats, Target, Weights};
use super::StepKind;
use crate::config::MapConfig;
use crate::gpu::GpuError;

/// A training step that was started and whose answer was not taken in yet.
struct InFlight {
    /// The image it is on.
    index: usize,
    step: Step,
}

/// Depth of a scene that nothing is known of yet, m.
const SCENE_DEPTH_M: f64 = 3.0;

pub struct Trainer {
    config: MapConfig,
    weights: Weights,
    schedule: Schedule,
    /// Median depth of the first anchor, m: what a position step is measured in.
    pub scene_depth_m: f64,
    in_flight: Option<InFlight>,
    /// The view of the last step that has ended.
    pub trained: Option<usize>,
    /// The loss of the last step that has ended.
    pub loss: f64,
}

impl Trainer {
    pub fn new(config: &MapConfig) -> Trainer {
        Trainer {
            config: config.clone(),
            weights: Weights {
                ssim: config.ssim_weight as f32,
                needle: config.needle_weight as f32,
                scale: config.scale_weight as f32,
                scale_soft_m: config.scale_soft_m as f32,
                opacity: config.opacity_weight as f32,
            },
            schedule: Schedule::new(config.seed),
            scene_depth_m: SCENE_DEPTH_M,
            in_flight: None,
            trained: None,
            loss: 0.0,
        }
    }

    pub fn weights(&self) -> &Weights {
        &self.weights
    }

    /// The next steps are a new anchor's burst.
    pub fn start_burst(&mut self, anchor: usize) {
        self.schedule.start_burst(anchor, self.config.burst_iterations);
    }

    /// Whether the next step is of a new anchor's burst.
    pub fn in_burst(&self) -> bool {
        self.schedule.in_burst()
    }

    /// Whether `finish_pending` decides what is next.
    pub fn must_wait(&self) -> bool {
        self.schedule.must_wait()
    }

    /// Starts a step, then finishes the one before it; `None` when there is nothing to train.
    pub fn step(&mut self, scene: &mut Scene, archive: &mut Option<Archive>) -> Result<Option<StepKind>, GpuError> {
        let burst = self.schedule.in_burst();
        if scene.pipeline.pool.count() == 0 || (self.trained_enough(scene) && !burst) {
            return Ok(None);
        }
        let draw = |rng: &mut Rng| match archive.as_mut() {
            Some(archive) => archive.next_view(scene, rng),
            None => Ok(scene.views.draw(scene.views.training(), |_| true, rng).map(|index| index as usize)),
        };
        let Some(index) = self.schedule.next(draw)? else { return Ok(None) };
        archive.iter_mut().for_each(|archive| archive.find_absent(scene, index));
        let half_size = scene.views.get(index).steps < self.config.half_size_steps;
        scene.counters.steps_at_half_size.add(u64::from(half_size));
        let target = Target { half_size, ..scene.target(index) };
        let (view, rates) = (scene.view(index), self.rates(scene));
        let step = scene.pipeline.start(&mut scene.gpu, &view, target, &rates, &self.weights)?;
        scene.steps += 1;
        scene.views.get_mut(index).trained_at = scene.steps;
        if let Some(before) = self.in_flight.replace(InFlight { index, step }) {
            let beside = archive.as_ref().map(Archive::trained_beside);
            let ended = self.finish(before, scene, beside)?;
            debug_assert!(ended.is_none(), "the last step of a burst is waited for before another starts");
        }
        Ok(Some(if burst { StepKind::Burst } else { StepKind::Train }))
    }

    /// Finishes the step in flight, if any: before anything but training is done with the map. Answers the anchor whose
    /// burst it ended.
    pub fn finish_pending(&mut self, scene: &mut Scene, archive: &Option<Archive>) -> Result<Option<usize>, GpuError> {
        match self.in_flight.take() {
            Some(last) => self.finish(last, scene, archive.as_ref().map(Archive::trained_beside)),
            None => Ok(None),
        }
    }

    fn finish(
        &mut self,
        InFlight { index, step }: InFlight,
        scene: &mut Scene,
        beside: Option<&[u32]>,
    ) -> Result<Option<usize>, GpuError> {
        let done = scene.pipeline.finish(&mut scene.gpu, &step)?;
        let counters = &scene.counters;
        let whole = done.stats.overflow == 0;
        (self.loss, self.trained) = (if whole { done.loss } else { self.loss }, Some(index));
        counters.intersections_overflow.add(u64::from(!whole));
        counters.intersections_most.raise(u64::from(done.stats.needed()));
        counters.views_coarsened.add(u64::from(whole && step.view.coarseness > Coarseness::default()));
        counters.splats_not_finite.add(u64::from(done.stats.failed));
        counters.gradients_rejected.add(u64::from(done.gradients_rejected));
        let entry = scene.views.get_mut(index);
        // A list at half the size has room where a whole one has not.
        if !(whole && step.target.half_size) {
            entry.coarseness = scene.pipeline.coarseness_after(&done.stats);
        }
        entry.steps = entry.steps.saturating_add(1);
        // A step on a picture with holes was not taken, and tells nothing of pose and exposure.
        if whole {
            self.refine(scene, beside, index, &step, &done);
        }
        Ok(self.schedule.took())
    }

    /// One step of the pose of the image's keyframe, and of its exposure.
    fn refine(&self, scene: &mut Scene, beside: Option<&[u32]>, index: usize, step: &Step, done: &StepStats) {
        let part = self.rate_part(scene);
        if self.config.refine_pose {
            let body_from_cam = scene.views.get(index).body_from_cam;
            let first = scene.views.first(index);
            let refined = &mut scene.views.get_mut(first).refined;
            let rate = part * self.config.lr_pose;
            refined.step_pose(&done.pose_gradient, &step.view.world_from_cam, &body_from_cam, rate);
        }
        if self.config.refine_exposure {
            let refined = &mut scene.views.get_mut(index).refined;
            let moved = refined.step_exposure(&done.exposure_gradient, part * self.config.lr_exposure);
            scene.views.balance_exposure(moved, beside);
        }
    }

    /// Steps past this only teach the map the few views it has, and what they do not show looks covered to the next.
    pub fn trained_enough(&self, scene: &Scene) -> bool {
        let most = u64::from(self.config.steps_per_keyframe_max);
        most > 0 && scene.steps >= most * scene.views.own_training().len() as u64
    }

    /// Smaller as the steps a keyframe has had grow: large ones find the picture, small ones settle it.
    fn rate_part(&self, scene: &Scene) -> f64 {
        let steps = scene.steps as f64 / scene.views.len().max(1) as f64;
        f64::max(self.config.lr_part_min, 1.0 / (1.0 + steps / self.config.lr_halving_steps))
    }

    fn rates(&self, scene: &Scene) -> LearningRates {
        let c = &self.config;
        let part = self.rate_part(scene) * if self.schedule.in_burst() { c.burst_rate } else { 1.0 };
        LearningRates {
            position: (part * c.lr_position * self.scene_depth_m) as f32,
            scale: (part * c.lr_scale) as f32,
            rotation: (part * c.lr_rotation) as f32,
            opacity: (part * c.lr_opacity) as f32,
            colour: (part * c.lr_colour) as f32,
        }
    }
}
