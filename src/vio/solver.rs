//! Levenberg-Marquardt over the window. Landmarks are eliminated (`elimination.rs`), and what is left is solved with its
//! diagonal scaled to one.

use super::elimination::Elimination;
use super::factors::{self, view_rows, Factor};
use super::graph::Graph;
use super::inertial::{Covariance, Mat15};
use super::model::Model;
use super::rows::FactorRows;
use super::window::Layout;
use crate::limits::WINDOW_DIM;
use crate::math::dense::{eliminate, System};
use nalgebra::SMatrix;

/// Damping, as a share of the diagonal: at the start, at least, at most. With ten times as much at the start the scale of a
/// scene that is far away, whose curvature is a small part of a position's, does not arrive: on a climb of 120 m between walls
/// 40 m away the height was off by 6 m instead of 0.6.
pub const LAMBDA_START: f64 = 1e-5;
const LAMBDA_MIN: f64 = 1e-6;
const LAMBDA_MAX: f64 = 1e2;
/// Done when a step changes no error by this (m, rad, m/s ...), or the cost, in variances, by this: some thousandths of a
/// window's, of which a further step would gain a fraction.
const STEP_SETTLED: f64 = 1e-4;
const COST_SETTLED: f64 = 1.0;
/// A rejected step that promised less than this is rounding.
const COST_NUMERIC: f64 = 1e-3;
/// Added to the diagonal whatever lambda is, so that unobserved directions stay put.
const DAMPING_MIN: f64 = 1e-6;

/// Buffers of the solver, bought once.
#[derive(Clone, Debug)]
pub struct Solver {
    system: System,
    factor: System,
    pub rows: FactorRows,
    elimination: Elimination,
    dx: Vec<f64>,
}

/// What an optimization took.
#[derive(Clone, Copy, Debug, Default)]
pub struct Outcome {
    pub iterations: u32,
    /// Steps that were not finite.
    pub failures: u32,
    /// Steps that were taken back because they made the cost larger.
    pub rejected: u32,
}

impl Solver {
    pub fn new() -> Solver {
        Solver {
            system: System::new(WINDOW_DIM),
            factor: System::new(WINDOW_DIM),
            rows: FactorRows::new(),
            elimination: Elimination::new(),
            dx: vec![0.0; WINDOW_DIM],
        }
    }

    /// Sums the squares of all factors and of the prior up; answers their cost.
    pub fn linearize(&mut self, graph: &mut Graph, model: &Model, layout: &Layout) -> f64 {
        let Graph { window, landmarks, prior } = graph;
        let (system, rows) = (&mut self.system, &mut self.rows);
        system.clear(layout.dim);
        self.elimination.begin(layout);
        let mut cost = prior.add_to(window, layout, system);
        for factor in factors::of_window(window, &landmarks.pool) {
            if let Factor::Landmark(l) = factor {
                cost += view_rows(l, window, model, layout, rows);
                self.elimination.eliminate(l, rows, layout.cameras(), system);
            } else {
                cost += factor.linearize(window, model, layout, rows).cost;
                rows.add_to(0, system);
            }
        }
        self.elimination.subtract_from(system);
        cost
    }

    /// Solves the damped system; answers the decrease it predicts, `None` when not finite.
    pub fn step(&mut self, lambda: f64) -> Option<f64> {
        let n = self.system.dim;
        let damping = |h: f64| (lambda * h).max(DAMPING_MIN);
        self.system.solve_damped(damping, &mut self.factor, &mut self.dx);
        let mut decrease = 0.0;
        for (i, x) in self.dx[..n].iter().enumerate() {
            decrease += 0.5 * (damping(self.system.at(i, i)) * x * x - x * self.system.b[i]);
        }
        decrease += self.elimination.decrease();
        (decrease.is_finite() && self.dx[..n].iter().all(|x| x.is_finite())).then_some(decrease)
    }

    fn apply(&self, graph: &mut Graph, layout: &Layout) {
        graph.window.step(layout, &self.dx);
        self.elimination.apply(&mut graph.landmarks.pool, &self.dx);
    }

    /// The undamped step, in the columns of `Layout::of`, for tests of what the system says.
    #[cfg(test)]
    pub fn newton_step(&mut self, graph: &mut Graph, model: &Model) -> &[f64] {
        self.linearize(graph, model, &Layout::of(&graph.window));
        self.system.solve_damped(|_| 0.0, &mut self.factor, &mut self.dx);
        &self.dx[..self.system.dim]
    }

    /// Covariance of the newest state from the last linearization, all else eliminated. Its columns are
    /// the last ones of `Layout::of`. `None` when the normal equations do not determine it.
    pub fn newest_covariance(&mut self) -> Option<Covariance> {
        let first = self.system.dim.checked_sub(15)?;
        self.factor.copy_from(&self.system);
        eliminate(&mut self.factor, first);
        let information = Mat15::from_fn(|i, j| self.factor.at(first + i, first + j));
        let covariance = information.cholesky()?.inverse();
        covariance.iter().all(|x| x.is_finite()).then(|| covariance.into())
    }

    /// Standard deviation of a barometer's bias at the newest state from the last linearization, m: its column is the last but
    /// those of the state in `Layout::of`.
    pub fn newest_height_deviation(&mut self) -> Option<f64> {
        let first = self.system.dim.checked_sub(16)?;
        self.factor.copy_from(&self.system);
        eliminate(&mut self.factor, first);
        let information = SMatrix::<f64, 16, 16>::from_fn(|i, j| self.factor.at(first + i, first + j));
        let variance = information.cholesky()?.inverse()[(0, 0)];
        (variance > 0.0).then(|| variance.sqrt())
    }

    /// Standard deviations of the rig's columns, which are the first of `Layout::of`, from the last
    /// linearization.
    pub fn rig_deviations(&mut self, out: &mut [f64]) {
        let n = out.len().min(self.system.dim);
        self.system.deviations(&mut self.factor, &mut out[..n]);
    }

    /// Steps until they settle; leaves `rho_sigma` of every landmark behind.
    pub fn optimize(&mut self, graph: &mut Graph, model: &Model) -> Outcome {
        let layout = Layout::of(&graph.window);
        let (mut lambda, mut growth) = (LAMBDA_START, 2.0);
        let mut cost = self.linearize(graph, model, &layout);
        let mut outcome = Outcome::default();
        while outcome.iterations < model.config.iterations_max && lambda <= LAMBDA_MAX {
            outcome.iterations += 1;
            let Some(predicted) = self.step(lambda) else {
                outcome.failures += 1;
                (lambda, growth) = (lambda * 10.0, 2.0);
                continue;
            };
            graph.window.save();
            self.apply(graph, &layout);
            let trial = graph.cost(model);
            let gain = (cost - trial) / predicted;
            if gain > 0.0 && predicted > 0.0 {
                let largest = self.dx[..layout.dim].iter().fold(0.0f64, |m, x| m.max(x.abs()));
                let done = largest < STEP_SETTLED || cost - trial < COST_SETTLED;
                cost = trial;
                (lambda, growth) = ((lambda * (1.0 - (2.0 * gain - 1.0).powi(3)).max(1.0 / 3.0)).max(LAMBDA_MIN), 2.0);
                if done || outcome.iterations == model.config.iterations_max {
                    break;
                }
                self.linearize(graph, model, &layout);
            } else {
                graph.window.restore();
                self.elimination.restore(&mut graph.landmarks.pool);
                if predicted < COST_NUMERIC {
                    break;
                }
                outcome.rejected += 1;
                (lambda, growth) = (lambda * growth, growth * 2.0);
            }
        }
        self.elimination.tell_deviations(&mut graph.landmarks.pool);
        outcome
    }
}
