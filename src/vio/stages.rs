//! The estimator's stages one at a time, for timing: a frame has entered the window of a running
//! estimator and nothing has been optimised yet. Each call runs what a whole frame runs there, on a copy, so
//! that a flight stopped at a frame can be measured as often as wanted.

use super::landmarks::Landmark;
use super::linear::landmark_rows;
use super::preintegration::Increment;
use super::solve::{cost_of, Outcome, LAMBDA_START};
use super::window::Layout;
use super::Vio;
use crate::frontend::Tracks;

/// A copy of an estimator, stopped when a frame has entered its window.
#[derive(Clone, Debug)]
pub struct Stages {
    vio: Vio,
    layout: Layout,
    /// Slots of the frame and of the one before it.
    slot: usize,
    before: usize,
    /// This frame becomes a keyframe.
    pub keyframe: bool,
}

/// What the stages work on.
#[derive(Clone, Copy, Debug)]
pub struct Extent {
    pub frames: usize,
    pub landmarks: usize,
    pub views: usize,
    /// Columns of the system that is solved.
    pub columns: usize,
}

impl Stages {
    /// Lets the frame in. `None` while the estimator is not running.
    pub fn new(vio: &Vio, tracks: &Tracks) -> Option<Stages> {
        let before = vio.window.newest().filter(|_| vio.running)?;
        let mut vio = vio.clone();
        let (slot, connected, unconnected) = vio.enter(before, tracks);
        let keyframe = vio.is_keyframe_due(connected, unconnected);
        let layout = Layout::of(&vio.window);
        Some(Stages { vio, layout, slot, before, keyframe })
    }

    pub fn extent(&self) -> Extent {
        let (window, pool) = (&self.vio.window, &self.vio.landmarks.pool);
        let views = |l: &Landmark| l.observations.len();
        let (landmarks, views) = (pool.len(), pool.iter().map(views).sum());
        Extent { frames: window.slots().count(), landmarks, views, columns: self.layout.dim }
    }

    /// The samples since the frame before, and the weight of their increment.
    pub fn preintegrate(&self) -> Increment {
        self.vio.propagated(self.before, self.vio.window.frame(self.slot).t).increment
    }

    /// Landmarks made of the frame's other points, as of a keyframe's; answers how many.
    pub fn triangulate(&mut self) -> usize {
        self.vio.make_keyframe(self.slot);
        self.vio.window.frame(self.slot).hosted
    }

    /// The rows of all landmarks with their points eliminated, not summed: a part of `linearise`. Answers the
    /// cost.
    pub fn eliminate(&mut self) -> f64 {
        let vio = &mut self.vio;
        let rows = |l| landmark_rows(l, &vio.window, &vio.model, &self.layout, &mut vio.solver.linear).0;
        vio.landmarks.pool.iter().map(rows).sum()
    }

    /// All factors summed; answers the cost.
    pub fn linearize(&mut self) -> f64 {
        let vio = &mut self.vio;
        vio.solver.linearize(&vio.window, &vio.landmarks, &mut vio.prior, &vio.model, &self.layout)
    }

    /// The damped step of what `linearise` summed; answers the decrease it predicts.
    pub fn solve(&mut self) -> Option<f64> {
        self.vio.solver.step(LAMBDA_START, self.vio.landmarks.pool.len())
    }

    /// The cost of the window, which judges a step.
    pub fn cost(&self) -> f64 {
        cost_of(&self.vio.window, &self.vio.landmarks, &self.vio.prior, &self.vio.model)
    }

    /// All iterations.
    pub fn optimize(&mut self) -> Outcome {
        let vio = &mut self.vio;
        vio.solver.optimize(&mut vio.window, &mut vio.landmarks, &mut vio.prior, &vio.model)
    }

    /// Of the newest state, from what `linearise` summed.
    pub fn covariance(&mut self) -> Option<[[f64; 15]; 15]> {
        self.vio.solver.newest_covariance()
    }

    /// Brings the window back to its resting size; answers how many keyframes left it.
    pub fn marginalize(&mut self) -> usize {
        let keyframes = |vio: &Vio| vio.window().filter(|(_, _, keyframe)| *keyframe).count();
        let before = keyframes(&self.vio);
        self.vio.marginalize();
        before - keyframes(&self.vio)
    }
}
