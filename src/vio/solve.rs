//! Levenberg-Marquardt over the window, landmarks eliminated one by one (Schur complement).
//!
//! In f64 the normal equations keep enough digits; what would cost them, the position prior beside
//! pixel residuals, is bounded by the prior's own standard deviations.

use super::landmarks::{Landmark, Landmarks};
use super::marginalise::Prior;
use super::residuals::{
    huber, inertial_jacobians, inertial_residual, predict, reproject, Eye, Mat15, Point, Reprojection,
};
use super::rest::{add_rest, rest_cost};
use super::window::{Layout, Window, FRAMES};
use crate::config::VioConfig;
use crate::limits::{LANDMARKS, WINDOW_DIM};
use crate::math::dense::System;
use glam::{DMat3, DVec2, DVec3};

const LAMBDA_START: f64 = 1e-4;
const LAMBDA_MIN: f64 = 1e-6;
const LAMBDA_MAX: f64 = 1e2;
/// Done when a step changes no error by this (m, rad, m/s ...), or the cost, in variances, by this: a
/// thousandth of a window's. Below 1e-3 MH_01 and the test room end the same at twice the iterations.
const STEP_SETTLED: f64 = 1e-4;
const COST_SETTLED: f64 = 0.5;
/// A rejected step that promised less than this is rounding.
const COST_NUMERIC: f64 = 1e-3;
/// Added to the diagonal whatever lambda is, so that unobserved directions stay put.
const DAMPING_MIN: f64 = 1e-6;
/// Information on an inverse distance nothing observes, m².
const RHO_RIDGE: f64 = 1e-6;
/// An observation whose point has left the camera model costs as if this far off, px.
const LOST_PX: f64 = 20.0;

/// Everything constant about the rig and the weights.
#[derive(Clone, Debug)]
pub struct Model {
    pub eyes: Vec<Eye>,
    pub sigma_px: f64,
    pub huber_px: f64,
    pub iterations_max: u32,
}

impl Model {
    pub fn new(eyes: Vec<Eye>, config: &VioConfig) -> Model {
        Model {
            eyes,
            sigma_px: config.observation_sigma_px,
            huber_px: config.huber_px,
            iterations_max: config.iterations_max,
        }
    }

    fn lost_cost(&self) -> f64 {
        huber(LOST_PX / self.sigma_px, self.huber_px / self.sigma_px).1
    }
}

/// One landmark, linearised and eliminated: what the back-substitution needs.
#[derive(Clone, Copy, Debug)]
pub struct Eliminated {
    slots: [u8; FRAMES],
    n: usize,
    /// d²/d(point)d(pose) of each touched frame.
    w: [[[f64; 6]; 3]; FRAMES],
    v_inv: DMat3,
    g: DVec3,
    saved: Point,
}

impl Eliminated {
    const EMPTY: Eliminated = Eliminated {
        slots: [0; FRAMES],
        n: 0,
        w: [[[0.0; 6]; 3]; FRAMES],
        v_inv: DMat3::ZERO,
        g: DVec3::ZERO,
        saved: Point { s: DVec2::ZERO, rho: 0.0 },
    };

    fn touch(&mut self, slot: u8) -> usize {
        if let Some(i) = self.slots[..self.n].iter().position(|s| *s == slot) {
            return i;
        }
        self.slots[self.n] = slot;
        self.w[self.n] = [[0.0; 6]; 3];
        self.n += 1;
        self.n - 1
    }
}

/// Buffers of the solver, bought once.
#[derive(Clone, Debug)]
pub struct Solver {
    system: System,
    factor: System,
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

fn accumulate(system: &mut System, at: usize, bt: usize, a: &[[f64; 6]; 2], b: &[[f64; 6]; 2], weight: f64) {
    let (at, bt, a, b) = if at >= bt { (at, bt, a, b) } else { (bt, at, b, a) };
    for i in 0..6 {
        let (x, y) = (a[0][i] * weight, a[1][i] * weight);
        let row = system.row_mut(at + i, bt, 6);
        for j in 0..6 {
            row[j] += x * b[0][j] + y * b[1][j];
        }
    }
}

/// Residual at the estimate, Jacobians at the linearisation points.
fn observe(landmark: &Landmark, view: usize, window: &Window, eyes: &[Eye]) -> Option<Reprojection> {
    let o = &landmark.observations[view];
    let (h, t) = (window.frame(landmark.host as usize), window.frame(o.slot as usize));
    let (host_eye, eye) = (&eyes[0].body_from_cam, &eyes[o.camera as usize]);
    let mut r = reproject(&landmark.point, host_eye, &h.body_jacobian, eye, &t.body_jacobian)?;
    if h.anchored || t.anchored {
        r.px = predict(&landmark.point, host_eye, &h.body, eye, &t.body)?;
    }
    r.px -= o.px();
    Some(r)
}

/// Adds a landmark's views in frames of the layout to the system, with the landmark eliminated.
/// Answers its cost.
pub fn eliminate_landmark(
    landmark: &Landmark,
    window: &Window,
    model: &Model,
    layout: &Layout,
    system: &mut System,
    out: &mut Eliminated,
) -> f64 {
    let mut cost = 0.0;
    let mut v = [[0.0; 3]; 3];
    let mut g = [0.0; 3];
    out.n = 0;
    out.saved = landmark.point;
    let inv_sigma = 1.0 / model.sigma_px;
    for k in 0..landmark.observations.len() {
        let slot = landmark.observations[k].slot;
        let Some(target_at) = layout.pose(slot as usize) else { continue };
        let Some(r) = observe(landmark, k, window, &model.eyes) else {
            cost += model.lost_cost();
            continue;
        };
        let (weight, c) = huber(r.px.length() * inv_sigma, model.huber_px * inv_sigma);
        cost += c;
        let weight = weight * inv_sigma * inv_sigma;
        let px = [r.px.x, r.px.y];
        for row in 0..2 {
            for i in 0..3 {
                let x = r.d_point[row][i] * weight;
                g[i] += x * px[row];
                (0..3).for_each(|j| v[i][j] += x * r.d_point[row][j]);
            }
        }
        // In its host's own frame a view says nothing about poses.
        if slot == landmark.host {
            continue;
        }
        let Some(host_at) = layout.pose(landmark.host as usize) else { continue };
        accumulate(system, host_at, host_at, &r.d_host, &r.d_host, weight);
        accumulate(system, target_at, target_at, &r.d_target, &r.d_target, weight);
        accumulate(system, target_at, host_at, &r.d_target, &r.d_host, weight);
        for (s, at, d) in [(landmark.host, host_at, &r.d_host), (slot, target_at, &r.d_target)] {
            let w = out.touch(s);
            for row in 0..2 {
                let x = px[row] * weight;
                (0..6).for_each(|i| system.b[at + i] += d[row][i] * x);
                for p in 0..3 {
                    let x = r.d_point[row][p] * weight;
                    (0..6).for_each(|i| out.w[w][p][i] += d[row][i] * x);
                }
            }
        }
    }
    v[2][2] += RHO_RIDGE;
    let v_inv = DMat3::from_cols_array_2d(&v).inverse();
    if !v_inv.is_finite() {
        out.v_inv = DMat3::ZERO;
        return cost;
    }
    (out.v_inv, out.g) = (v_inv, DVec3::from_array(g));
    subtract_schur(out, layout, system);
    cost
}

fn subtract_schur(e: &Eliminated, layout: &Layout, system: &mut System) {
    let g = (e.v_inv * e.g).to_array();
    let v = e.v_inv.to_cols_array_2d();
    for b in 0..e.n {
        let Some(b_at) = layout.pose(e.slots[b] as usize) else { continue };
        let wb = &e.w[b];
        let mut y = [[0.0; 6]; 3];
        for k in 0..3 {
            for i in 0..6 {
                y[k][i] = v[k][0] * wb[0][i] + v[k][1] * wb[1][i] + v[k][2] * wb[2][i];
            }
        }
        for i in 0..6 {
            system.b[b_at + i] -= wb[0][i] * g[0] + wb[1][i] * g[1] + wb[2][i] * g[2];
        }
        for a in 0..e.n {
            let Some(a_at) = layout.pose(e.slots[a] as usize) else { continue };
            if a_at < b_at {
                continue;
            }
            let wa = &e.w[a];
            for i in 0..6 {
                let (x0, x1, x2) = (wa[0][i], wa[1][i], wa[2][i]);
                let row = system.row_mut(a_at + i, b_at, 6);
                for j in 0..6 {
                    row[j] -= x0 * y[0][j] + x1 * y[1][j] + x2 * y[2][j];
                }
            }
        }
    }
}

/// Adds the inertial factor that ends in `slot`; answers its cost.
pub fn add_inertial(window: &Window, from: usize, slot: usize, layout: &Layout, system: &mut System) -> f64 {
    let (a, b) = (window.frame(from), window.frame(slot));
    let r = inertial_residual(&b.increment, &b.weight, &a.now, &b.now);
    if let (Some(ca), Some(cb)) = (layout.columns(from), layout.columns(slot)) {
        let (ja, jb) = inertial_jacobians(&b.increment, &b.weight, a.motion_jacobian(), b.motion_jacobian());
        let (haa, hbb, hba) = (ja.transpose() * ja, jb.transpose() * jb, jb.transpose() * ja);
        let (ga, gb) = (ja.transpose() * r, jb.transpose() * r);
        for i in 0..15 {
            system.b[ca[i]] += ga[i];
            system.b[cb[i]] += gb[i];
            for j in 0..15 {
                system.add(cb[i], ca[j], hba[(i, j)]);
                if j <= i {
                    system.add(ca[i], ca[j], haa[(i, j)]);
                    system.add(cb[i], cb[j], hbb[(i, j)]);
                }
            }
        }
    }
    0.5 * r.norm_squared()
}

fn cost_of(window: &Window, landmarks: &Landmarks, prior: &Prior, model: &Model) -> f64 {
    let mut cost = prior.cost(window);
    let mut before = None;
    for slot in window.states() {
        if let Some(from) = before {
            let (a, b) = (window.frame(from), window.frame(slot));
            cost += 0.5 * inertial_residual(&b.increment, &b.weight, &a.now, &b.now).norm_squared();
        }
        cost += rest_cost(window.frame(slot));
        before = Some(slot);
    }
    let inv_sigma = 1.0 / model.sigma_px;
    for l in &landmarks.pool {
        let host = &window.frame(l.host as usize).body;
        for o in l.observations.iter() {
            let eye = &model.eyes[o.camera as usize];
            let target = &window.frame(o.slot as usize).body;
            cost += match predict(&l.point, &model.eyes[0].body_from_cam, host, eye, target) {
                Some(px) => huber((px - o.px()).length() * inv_sigma, model.huber_px * inv_sigma).1,
                None => model.lost_cost(),
            };
        }
    }
    cost
}

impl Solver {
    pub fn new() -> Solver {
        Solver {
            system: System::new(WINDOW_DIM),
            factor: System::new(WINDOW_DIM),
            eliminated: vec![Eliminated::EMPTY; LANDMARKS],
            dx: vec![0.0; WINDOW_DIM],
        }
    }

    pub const BYTES: usize = LANDMARKS * size_of::<Eliminated>() + 2 * (WINDOW_DIM + 1) * WINDOW_DIM * 8;

    /// The scratch system and one scratch landmark, for marginalisation.
    pub fn scratch(&mut self) -> (&mut System, &mut Eliminated) {
        (&mut self.system, &mut self.eliminated[0])
    }

    fn linearise(
        &mut self,
        window: &Window,
        landmarks: &Landmarks,
        prior: &Prior,
        model: &Model,
        layout: &Layout,
    ) -> f64 {
        let system = &mut self.system;
        system.clear(layout.dim);
        let mut cost = prior.add_to(window, layout, system);
        let mut before = None;
        for slot in window.states() {
            if let Some(from) = before {
                cost += add_inertial(window, from, slot, layout, system);
            }
            cost += add_rest(window.frame(slot), slot, layout, system);
            before = Some(slot);
        }
        for (l, out) in landmarks.pool.iter().zip(&mut self.eliminated) {
            cost += eliminate_landmark(l, window, model, layout, system, out);
        }
        cost
    }

    /// Solves the damped system; answers the decrease it predicts, `None` when not finite.
    fn step(&mut self, lambda: f64, landmarks: usize) -> Option<f64> {
        let n = self.system.dim;
        self.factor.copy_from(&self.system);
        for i in 0..n {
            let d = (lambda * self.system.at(i, i)).max(DAMPING_MIN);
            self.factor.add(i, i, d);
        }
        self.factor.solve(&mut self.dx);
        let mut decrease = 0.0;
        for i in 0..n {
            let d = (lambda * self.system.at(i, i)).max(DAMPING_MIN);
            decrease += 0.5 * (d * self.dx[i] * self.dx[i] - self.dx[i] * self.system.b[i]);
        }
        for e in &self.eliminated[..landmarks] {
            decrease += 0.5 * e.g.dot(e.v_inv * e.g);
        }
        (decrease.is_finite() && self.dx[..n].iter().all(|x| x.is_finite())).then_some(decrease)
    }

    fn apply(&self, window: &mut Window, landmarks: &mut Landmarks, layout: &Layout) {
        window.step(layout, &self.dx);
        for (l, e) in landmarks.pool.iter_mut().zip(&self.eliminated) {
            let mut g = e.g;
            for a in 0..e.n {
                let Some(at) = layout.pose(e.slots[a] as usize) else { continue };
                for k in 0..3 {
                    g[k] += (0..6).map(|i| e.w[a][k][i] * self.dx[at + i]).sum::<f64>();
                }
            }
            let d = e.v_inv * g;
            l.point.s -= d.truncate();
            l.point.rho = (l.point.rho - d.z).max(0.0);
        }
    }

    /// The undamped step of every slot, for tests of what the system says.
    #[cfg(test)]
    pub fn newton_step(
        &mut self,
        window: &Window,
        landmarks: &Landmarks,
        prior: &Prior,
        model: &Model,
    ) -> [[f64; 15]; FRAMES] {
        let layout = Layout::of(window);
        self.linearise(window, landmarks, prior, model, &layout);
        self.system.solve(&mut self.dx);
        let mut steps = [[0.0; 15]; FRAMES];
        for slot in window.slots() {
            for i in 0..15 {
                let at = if i < 6 { layout.pose(slot).map(|o| o + i) } else { layout.motion(slot).map(|o| o + i - 6) };
                steps[slot][i] = at.map_or(0.0, |o| self.dx[o]);
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

    pub fn optimise(
        &mut self,
        window: &mut Window,
        landmarks: &mut Landmarks,
        prior: &Prior,
        model: &Model,
    ) -> Outcome {
        let layout = Layout::of(window);
        let (mut lambda, mut growth) = (LAMBDA_START, 2.0);
        let mut cost = self.linearise(window, landmarks, prior, model, &layout);
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
                self.linearise(window, landmarks, prior, model, &layout);
            } else {
                window.restore();
                for (l, e) in landmarks.pool.iter_mut().zip(&self.eliminated) {
                    l.point = e.saved;
                }
                if predicted < COST_NUMERIC {
                    break;
                }
                (lambda, growth) = (lambda * growth, growth * 2.0);
            }
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
