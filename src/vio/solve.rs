//! Levenberg-Marquardt over the window, landmarks eliminated one by one by QR.
//!
//! What is summed up is the square of the rows that QR left without their landmark, dimension of
//! the window; of a landmark's own three rows the step of its point is found afterwards. The sum is
//! solved with its diagonal scaled to one.

use super::landmarks::Landmarks;
use super::linear::{
    cost_of_views, inertial_residual_at, inertial_rows, landmark_rows, rest_rows, Linear, POINT_DIM, SPANS,
};
use super::marginalization::Prior;
use super::residuals::{CameraModel, Mat15, Point};
use super::window::{Layout, Window, FRAMES, POSE_DIM};
use super::zero_velocity::rest_cost;
use crate::config::VioConfig;
use crate::limits::{LANDMARKS, RIG_DIM, WINDOW_DIM};
use crate::math::dense::{Columns, System};
use crate::mem::List;
use glam::DVec2;

pub(super) const LAMBDA_START: f64 = 1e-4;
const LAMBDA_MIN: f64 = 1e-6;
const LAMBDA_MAX: f64 = 1e2;
/// Done when a step changes no error by this (m, rad, m/s ...), or the cost, in variances, by this: a
/// thousandth of a window's. Below 1e-3 MH_01 and the test room end the same at twice the iterations; four times
/// as much saves MH_01 a quarter of them and takes a single camera from 0.012 to 0.026 m.
const STEP_SETTLED: f64 = 1e-4;
const COST_SETTLED: f64 = 0.5;
/// A rejected step that promised less than this is rounding.
const COST_NUMERIC: f64 = 1e-3;
/// Added to the diagonal whatever lambda is, so that unobserved directions stay put.
const DAMPING_MIN: f64 = 1e-6;
/// Columns of a landmark's rows besides its point.
const LOCAL_DIM: usize = POSE_DIM * FRAMES + RIG_DIM;

/// Everything constant about the rig, the weights and the shape.
#[derive(Clone, Debug)]
pub struct Model {
    pub cameras: Vec<CameraModel>,
    pub sigma_px: f64,
    pub huber_px: f64,
    pub iterations_max: u32,
    /// States and keyframe poses at rest.
    pub states: usize,
    pub keyframes: usize,
}

impl Model {
    pub fn new(cameras: Vec<CameraModel>, config: &VioConfig) -> Model {
        Model {
            cameras,
            sigma_px: config.observation_sigma_px,
            huber_px: config.huber_px,
            iterations_max: config.iterations_max,
            states: config.states as usize,
            keyframes: config.keyframes as usize,
        }
    }
}

/// The three rows that hold a landmark's point: `R d + W dx + g = 0` gives its step d.
#[derive(Clone, Copy, Debug)]
struct Own {
    /// Upper triangle.
    r: [[f64; POINT_DIM]; POINT_DIM],
    w: [[f64; LOCAL_DIM]; POINT_DIM],
    g: [f64; POINT_DIM],
    saved: Point,
}

#[derive(Clone, Debug)]
struct Eliminated {
    own: Own,
    spans: List<Columns, SPANS>,
    determined: bool,
}

impl Eliminated {
    fn empty() -> Eliminated {
        let own = Own {
            r: [[0.0; POINT_DIM]; POINT_DIM],
            w: [[0.0; LOCAL_DIM]; POINT_DIM],
            g: [0.0; POINT_DIM],
            saved: Point { s: DVec2::ZERO, rho: 0.0 },
        };
        Eliminated { own, spans: List::default(), determined: false }
    }

    fn take(&mut self, linear: &Linear, point: Point, determined: bool) {
        self.own.saved = point;
        self.determined = determined;
        if !determined {
            return;
        }
        self.spans.clone_from(&linear.spans);
        let n = linear.rows.cols() - 1 - POINT_DIM;
        for i in 0..POINT_DIM {
            let row = linear.rows.row(i);
            self.own.r[i].copy_from_slice(&row[..POINT_DIM]);
            self.own.w[i][..n].copy_from_slice(&row[POINT_DIM..POINT_DIM + n]);
            self.own.g[i] = row[POINT_DIM + n];
        }
    }

    /// Decrease of the cost by the point's own step.
    fn decrease(&self) -> f64 {
        if self.determined {
            0.5 * self.own.g.iter().map(|g| g * g).sum::<f64>()
        } else {
            0.0
        }
    }

    /// Of the inverse distance, the frames taken as known; infinite when nothing determines it.
    fn rho_sigma(&self) -> f32 {
        if self.determined {
            (1.0 / self.own.r[POINT_DIM - 1][POINT_DIM - 1].abs()) as f32
        } else {
            f32::INFINITY
        }
    }

    fn step(&self, dx: &[f64]) -> [f64; POINT_DIM] {
        let mut d = [0.0; POINT_DIM];
        if self.determined {
            for i in (0..POINT_DIM).rev() {
                let mut sum = self.own.g[i];
                let mut w = self.own.w[i].iter();
                for s in self.spans.iter() {
                    sum += w.by_ref().zip(&dx[s.at..s.at + s.len]).map(|(w, x)| w * x).sum::<f64>();
                }
                (i + 1..POINT_DIM).for_each(|j| sum += self.own.r[i][j] * d[j]);
                d[i] = -sum / self.own.r[i][i];
            }
        }
        d
    }
}

/// Buffers of the solver, bought once.
#[derive(Clone, Debug)]
pub struct Solver {
    system: System,
    factor: System,
    pub linear: Linear,
    eliminated: Vec<Eliminated>,
    dx: Vec<f64>,
}

#[derive(Clone, Copy, Debug, Default)]
pub struct Outcome {
    pub iterations: u32,
    /// Steps that were not finite.
    pub failures: u32,
    pub cost_before: f64,
    pub cost: f64,
}

pub(super) fn cost_of(window: &Window, landmarks: &Landmarks, prior: &Prior, model: &Model) -> f64 {
    let mut cost = prior.cost(window);
    let mut before = None;
    for slot in window.states() {
        if let Some(from) = before {
            cost += 0.5 * inertial_residual_at(window, from, slot).norm_squared();
        }
        cost += rest_cost(window.frame(slot));
        before = Some(slot);
    }
    cost + cost_of_views(&landmarks.pool, window, model)
}

impl Solver {
    pub fn new() -> Solver {
        Solver {
            system: System::new(WINDOW_DIM),
            factor: System::new(WINDOW_DIM),
            linear: Linear::new(),
            eliminated: vec![Eliminated::empty(); LANDMARKS],
            dx: vec![0.0; WINDOW_DIM],
        }
    }

    pub const BYTES: usize = LANDMARKS * size_of::<Eliminated>()
        + 2 * System::bytes(WINDOW_DIM)
        + Linear::BYTES
        + WINDOW_DIM * size_of::<f64>();

    pub(super) fn linearize(
        &mut self,
        window: &Window,
        landmarks: &Landmarks,
        prior: &mut Prior,
        model: &Model,
        layout: &Layout,
    ) -> f64 {
        let (system, linear) = (&mut self.system, &mut self.linear);
        system.clear(layout.dim);
        let mut cost = prior.add_to(window, layout, system);
        let mut before = None;
        for slot in window.states() {
            if let Some(from) = before {
                cost += inertial_rows(window, from, slot, layout, linear);
                linear.add_to(0, system);
            }
            if let Some(c) = rest_rows(window, slot, layout, linear) {
                cost += c;
                linear.add_to(0, system);
            }
            before = Some(slot);
        }
        for (l, out) in landmarks.pool.iter().zip(&mut self.eliminated) {
            let (c, determined) = landmark_rows(l, window, model, layout, linear);
            cost += c;
            if determined {
                linear.add_to(POINT_DIM, system);
            }
            out.take(linear, l.point, determined);
        }
        cost
    }

    /// Solves the damped system; answers the decrease it predicts, `None` when not finite.
    pub(super) fn step(&mut self, lambda: f64, landmarks: usize) -> Option<f64> {
        let n = self.system.dim;
        let damping = |h: f64| (lambda * h).max(DAMPING_MIN);
        self.system.solve_damped(damping, &mut self.factor, &mut self.dx);
        let mut decrease = 0.0;
        for (i, x) in self.dx[..n].iter().enumerate() {
            decrease += 0.5 * (damping(self.system.at(i, i)) * x * x - x * self.system.b[i]);
        }
        decrease += self.eliminated[..landmarks].iter().map(Eliminated::decrease).sum::<f64>();
        (decrease.is_finite() && self.dx[..n].iter().all(|x| x.is_finite())).then_some(decrease)
    }

    fn apply(&self, window: &mut Window, landmarks: &mut Landmarks, layout: &Layout) {
        window.step(layout, &self.dx);
        for (l, e) in landmarks.pool.iter_mut().zip(&self.eliminated) {
            let [x, y, rho] = e.step(&self.dx);
            l.point.s += DVec2::new(x, y);
            l.point.rho = (l.point.rho + rho).max(0.0);
        }
    }

    /// The undamped step of every slot, for tests of what the system says.
    #[cfg(test)]
    pub fn newton_step(
        &mut self,
        window: &Window,
        landmarks: &Landmarks,
        prior: &mut Prior,
        model: &Model,
    ) -> [[f64; 15]; FRAMES] {
        let layout = Layout::of(window);
        self.linearize(window, landmarks, prior, model, &layout);
        self.system.solve_damped(|_| 0.0, &mut self.factor, &mut self.dx);
        let mut steps = [[0.0; 15]; FRAMES];
        for slot in window.slots() {
            for (part, first) in layout.state(slot).into_iter().zip([0, POSE_DIM]) {
                let Some(part) = part else { continue };
                (0..part.len).for_each(|i| steps[slot][first + i] = self.dx[part.at + i]);
            }
        }
        steps
    }

    /// Covariance of the newest state from the last linearisation, all else eliminated. Its columns are
    /// the last ones of `Layout::of`. `None` when the normal equations do not determine it.
    pub fn newest_covariance(&mut self) -> Option<[[f64; 15]; 15]> {
        let first = self.system.dim.checked_sub(15)?;
        self.factor.copy_from(&self.system);
        self.factor.eliminate(first);
        let information = Mat15::from_fn(|i, j| self.factor.at(first + i, first + j));
        let covariance = information.cholesky()?.inverse();
        covariance.iter().all(|x| x.is_finite()).then(|| covariance.into())
    }

    /// Standard deviations of the rig's columns, which are the first of `Layout::of`, from the last
    /// linearisation.
    pub fn rig_deviations(&mut self, out: &mut [f64]) {
        let n = out.len().min(self.system.dim);
        self.system.deviations(&mut self.factor, &mut out[..n]);
    }

    pub fn optimize(
        &mut self,
        window: &mut Window,
        landmarks: &mut Landmarks,
        prior: &mut Prior,
        model: &Model,
    ) -> Outcome {
        let layout = Layout::of(window);
        let (mut lambda, mut growth) = (LAMBDA_START, 2.0);
        let mut cost = self.linearize(window, landmarks, prior, model, &layout);
        let mut outcome = Outcome { cost_before: cost, ..Outcome::default() };
        while outcome.iterations < model.iterations_max && lambda <= LAMBDA_MAX {
            outcome.iterations += 1;
            let Some(predicted) = self.step(lambda, landmarks.pool.len()) else {
                outcome.failures += 1;
                (lambda, growth) = (lambda * 10.0, 2.0);
                continue;
            };
            window.save();
            self.apply(window, landmarks, &layout);
            let trial = cost_of(window, landmarks, prior, model);
            let gain = (cost - trial) / predicted;
            if gain > 0.0 && predicted > 0.0 {
                let largest = self.dx[..layout.dim].iter().fold(0.0f64, |m, x| m.max(x.abs()));
                let done = largest < STEP_SETTLED || cost - trial < COST_SETTLED;
                cost = trial;
                (lambda, growth) = ((lambda * (1.0 - (2.0 * gain - 1.0).powi(3)).max(1.0 / 3.0)).max(LAMBDA_MIN), 2.0);
                if done || outcome.iterations == model.iterations_max {
                    break;
                }
                self.linearize(window, landmarks, prior, model, &layout);
            } else {
                window.restore();
                for (l, e) in landmarks.pool.iter_mut().zip(&self.eliminated) {
                    l.point = e.own.saved;
                }
                if predicted < COST_NUMERIC {
                    break;
                }
                (lambda, growth) = (lambda * growth, growth * 2.0);
            }
        }
        for (l, e) in landmarks.pool.iter_mut().zip(&self.eliminated) {
            l.rho_sigma = e.rho_sigma();
        }
        outcome.cost = cost;
        outcome
    }
}

impl Default for Solver {
    fn default() -> Self {
        Solver::new()
    }
}
