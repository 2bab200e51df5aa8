//! The estimator's stages one at a time, for timing: a frame has entered the window of a running
//! estimator and nothing has been optimized yet. Each call runs what a whole frame runs there, on a copy, so
//! that a flight stopped at a frame can be measured as often as wanted.

use stipple::frontend::Tracks;
use stipple::vio::instruments::{
    parts, view_rows, Covariance, Estimator, Graph, ImuRing, Increment, Layout, Outcome, LAMBDA_START,
};
use stipple::vio::Vio;

/// A copy of an estimator, stopped when a frame has entered its window.
#[derive(Clone, Debug)]
pub struct Stages {
    estimator: Estimator,
    imu: ImuRing,
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
        let (estimator, imu, covariance) = parts(vio);
        let before = estimator.graph.window.newest()?;
        let (mut estimator, imu) = (estimator.clone(), imu.clone());
        let (slot, step) = estimator.enter(before, tracks, &imu, covariance);
        let layout = Layout::of(&estimator.graph.window);
        Some(Stages { estimator, imu, layout, slot, before, keyframe: step.keyframe })
    }

    pub fn extent(&self) -> Extent {
        let (window, pool) = (&self.estimator.graph.window, &self.estimator.graph.landmarks.pool);
        let (landmarks, views) = (pool.len(), pool.iter().map(|l| l.observations.len()).sum());
        Extent { frames: window.slots().count(), landmarks, views, columns: self.layout.dim }
    }

    /// The samples since the frame before, and the weight of their increment.
    pub fn preintegrate(&self) -> Increment {
        self.estimator.propagated(self.before, self.estimator.graph.window.frame(self.slot).t, &self.imu).increment
    }

    /// Landmarks made of the frame's other points, as of a keyframe's; answers how many.
    pub fn triangulate(&mut self) -> usize {
        self.estimator.make_keyframe(self.slot);
        self.estimator.graph.window.frame(self.slot).hosted
    }

    /// The rows of all landmarks, neither eliminated nor summed: a part of `linearize`. Answers the cost.
    pub fn view_rows(&mut self) -> f64 {
        let Estimator { graph: Graph { window, landmarks, .. }, solver, model, .. } = &mut self.estimator;
        landmarks.pool.iter().map(|l| view_rows(l, window, model, &self.layout, &mut solver.rows)).sum()
    }

    /// All factors summed; answers the cost.
    pub fn linearize(&mut self) -> f64 {
        let Estimator { graph, solver, model, .. } = &mut self.estimator;
        solver.linearize(graph, model, &self.layout)
    }

    /// The damped step of what `linearize` summed; answers the decrease it predicts.
    pub fn solve(&mut self) -> Option<f64> {
        self.estimator.solver.step(LAMBDA_START)
    }

    /// The cost of the window, which judges a step.
    pub fn cost(&self) -> f64 {
        self.estimator.graph.cost(&self.estimator.model)
    }

    /// All iterations.
    pub fn optimize(&mut self) -> Outcome {
        let Estimator { graph, solver, model, .. } = &mut self.estimator;
        solver.optimize(graph, model)
    }

    /// Covariance of the newest state, from what `linearize` summed.
    pub fn covariance(&mut self) -> Option<Covariance> {
        self.estimator.solver.newest_covariance()
    }

    /// Brings the window back to its resting size; answers how many keyframes left it.
    pub fn marginalize(&mut self) -> usize {
        let keyframes = |e: &Estimator| e.graph.window.slots().filter(|s| e.graph.window.frame(*s).keyframe).count();
        let before = keyframes(&self.estimator);
        self.estimator.marginalize();
        before - keyframes(&self.estimator)
    }
}
