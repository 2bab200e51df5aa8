//! The factor graph: frames, points, and the prior on them. What was measured is in `factors.rs`.

use super::factors::{self, Factor};
use super::landmarks::Landmarks;
use super::model::Model;
use super::prior::Prior;
use super::rig::RigState;
use super::window::Window;

/// Variables of the window and the prior on them.
#[derive(Clone, Debug)]
pub struct Graph {
    pub window: Window,
    pub landmarks: Landmarks,
    pub prior: Prior,
}

impl Graph {
    pub fn new(rig: RigState) -> Graph {
        Graph { window: Window::new(rig), landmarks: Landmarks::new(), prior: Prior::new() }
    }

    /// Forgets everything but what was learnt of the rig.
    pub fn clear(&mut self) {
        self.window.clear();
        self.landmarks.clear();
        self.prior.clear();
    }

    /// Cost of the prior and of all factors at the estimate. Views are summed by themselves: they are many, and small
    /// beside the rest.
    pub fn cost(&self, model: &Model) -> f64 {
        let (mut cost, mut views) = (self.prior.cost(&self.window), 0.0);
        for factor in factors::of_window(&self.window, &self.landmarks.pool) {
            let sum = if matches!(factor, Factor::Landmark(_)) { &mut views } else { &mut cost };
            factor.add_cost(&self.window, model, sum);
        }
        cost + views
    }
}
