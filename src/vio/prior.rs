//! The prior: what is known of the window from everything that left it, as rows of a square root.
//!
//! Rows are kept over the errors from the linearization points of what they touch, and are never made anew; only
//! their residual changes with the estimate. What a marginalization leaves of its stack is the next prior.

use super::height;
use super::inertial::{Motion, MotionSigma};
use super::rig::RigState;
use super::rows::scatter;
use super::window::{Layout, Window, MOTION_DIM, POSE_DIM};
use crate::limits::{FRAMES, RIG_DIM, WINDOW_DIM};
use crate::math::dense::{add_gram, Columns, System};
use crate::math::qr::Rows;
use crate::mem::List;
use glam::DVec3;

/// Variables that a run of columns of the prior belongs to; frames by slot.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Block {
    Pose(u8),
    Motion(u8),
    HeightBias(u8),
    #[default]
    Rig,
}

/// Blocks in the order of their columns.
pub type Blocks = List<Block, { 2 * FRAMES }>;

impl Block {
    fn width(self, rig: &RigState) -> usize {
        match self {
            Block::Pose(_) => POSE_DIM,
            Block::Motion(_) => MOTION_DIM,
            Block::HeightBias(_) => 1,
            Block::Rig => rig.dim(),
        }
    }

    fn columns(self, layout: &Layout) -> Columns {
        let columns = match self {
            Block::Pose(s) => layout.state(s as usize)[0],
            Block::Motion(s) => layout.state(s as usize)[1],
            Block::HeightBias(s) => layout.height_bias(s as usize),
            Block::Rig => Some(layout.rig),
        };
        columns.expect("the layout holds all that the prior is about")
    }

    /// Error since the linearization point; a barometer's bias enters everything linearly, and its point is zero.
    fn delta(self, window: &Window, out: &mut [f64]) {
        match self {
            Block::Pose(s) => out.copy_from_slice(&window.frame(s as usize).delta[..POSE_DIM]),
            Block::Motion(s) => out.copy_from_slice(&window.frame(s as usize).delta[POSE_DIM..]),
            Block::HeightBias(s) => out[0] = window.frame(s as usize).height_bias,
            Block::Rig => out.copy_from_slice(&window.rig.delta[..out.len()]),
        }
    }
}

/// `½ ‖J δ + r‖²` on the errors δ since the linearization points.
#[derive(Clone, Debug)]
pub struct Prior {
    rows: Rows,
    /// JᵀJ, which every linearization adds; its last row is r's and changes.
    gram: Vec<f64>,
    stride: usize,
    blocks: Blocks,
}

impl Prior {
    pub fn new() -> Prior {
        let cols = WINDOW_DIM + 1;
        let mut rows = Rows::new(cols, cols);
        rows.clear(1);
        Prior { rows, gram: vec![0.0; Rows::gram_len(cols)], stride: 0, blocks: List::default() }
    }

    /// Knows nothing any more.
    pub fn clear(&mut self) {
        self.blocks.clear();
        self.rows.clear(1);
    }

    /// Starts with one state and the rig, whose linearization points are to be fixed, and their standard deviations,
    /// the rig's in the order of its columns. `biases`: what is expected of gyro and accelerometer, where that is not what
    /// the state has.
    pub fn start(
        &mut self,
        slot: usize,
        motion: &Motion,
        sigma: &MotionSigma,
        biases: [DVec3; 2],
        window: &Window,
        rig_sigmas: &[f64; RIG_DIM],
    ) {
        self.blocks.clear();
        let (rig, height_bias) = (&window.rig, window.has_heights.then_some(Block::HeightBias(slot as u8)));
        let blocks = [Block::Pose(slot as u8), Block::Motion(slot as u8), Block::Rig];
        for block in blocks.into_iter().chain(height_bias) {
            self.blocks.push(block).expect("room for the blocks of one state");
        }
        self.rows.clear(15 + rig.dim() + usize::from(window.has_heights) + 1);
        let r = motion.pose.rotation();
        let mut diagonal = |i: usize, s: f64, off: f64| {
            let row = self.rows.push();
            (row[i], row[row.len() - 1]) = (1.0 / s, off / s);
        };
        for i in 0..3 {
            diagonal(i, sigma.p, 0.0);
            diagonal(6 + i, sigma.v, 0.0);
            diagonal(9 + i, sigma.bg, (motion.bg - biases[0])[i]);
            diagonal(12 + i, sigma.ba, (motion.ba - biases[1])[i]);
        }
        for (i, s) in rig_sigmas[..rig.dim()].iter().enumerate() {
            diagonal(15 + i, *s, 0.0);
        }
        if window.has_heights {
            diagonal(15 + rig.dim(), height::BIAS_UNKNOWN, 0.0);
        }
        for (axis, s) in [sigma.tilt, sigma.tilt, sigma.yaw].into_iter().enumerate() {
            let row = self.rows.push();
            (0..3).for_each(|i| row[3 + i] = r.col(i)[axis] / s);
        }
        self.stride = self.rows.gram(0, &mut self.gram);
    }

    /// Errors of all blocks, one after the other.
    fn deltas(&self, window: &Window, of: impl Fn(Block, &mut [f64])) -> [f64; WINDOW_DIM] {
        let mut d = [0.0; WINDOW_DIM];
        let mut at = 0;
        for b in self.blocks.iter() {
            let width = b.width(&window.rig);
            of(*b, &mut d[at..at + width]);
            at += width;
        }
        d
    }

    /// `J δ` and r, a row at a time.
    fn residuals(&self, d: [f64; WINDOW_DIM]) -> impl Iterator<Item = (f64, f64)> + '_ {
        let n = self.rows.cols() - 1;
        (0..self.rows.count()).map(move |i| {
            let row = self.rows.row(i);
            ((0..n).map(|c| row[c] * d[c]).sum::<f64>(), row[n])
        })
    }

    /// `J δ` and r at the estimate.
    fn residuals_now(&self, window: &Window) -> impl Iterator<Item = (f64, f64)> + '_ {
        self.residuals(self.deltas(window, |b, out| b.delta(window, out)))
    }

    /// Cost at the estimate.
    pub fn cost(&self, window: &Window) -> f64 {
        self.residuals_now(window).map(|(jd, r)| 0.5 * (jd + r) * (jd + r)).sum()
    }

    fn columns(&self, layout: &Layout) -> List<Columns, { 2 * FRAMES }> {
        let mut columns = List::default();
        for b in self.blocks.iter() {
            let _ = columns.push(b.columns(layout));
        }
        columns
    }

    /// Adds the square of the prior; answers its cost.
    pub fn add_to(&mut self, window: &Window, layout: &Layout, system: &mut System) -> f64 {
        let mut cost = 0.0;
        let mut b = [0.0; WINDOW_DIM];
        let n = self.rows.cols() - 1;
        for (i, (jd, r)) in self.residuals_now(window).enumerate() {
            let e = jd + r;
            cost += 0.5 * e * e;
            b[..n].iter_mut().zip(self.rows.row(i)).for_each(|(b, j)| *b += *j * e);
        }
        self.gram[n * self.stride..][..n].copy_from_slice(&b[..n]);
        add_gram(system, &self.gram, self.stride, 0, &self.columns(layout));
        cost
    }

    /// Stacks the prior's rows at the estimate.
    pub fn append_to(&self, window: &Window, layout: &Layout, stack: &mut Rows) {
        let columns = self.columns(layout);
        for (i, (jd, r)) in self.residuals_now(window).enumerate() {
            let out = stack.push();
            scatter(self.rows.row(i), &columns, out);
            out[out.len() - 1] = jd + r;
        }
    }

    /// Takes what is left of a stack, whose first columns have left, as the new prior. Its rows were taken at the
    /// estimate and are moved to the linearization points.
    pub fn take(&mut self, stack: &Rows, left: usize, blocks: Blocks, window: &Window) {
        self.blocks = blocks;
        let n = stack.cols() - left;
        self.rows.clear(n);
        for i in 0..stack.count() {
            self.rows.push().copy_from_slice(&stack.row(i)[left..]);
        }
        let mut at_delta = [0.0; WINDOW_DIM + 1];
        at_delta.iter_mut().zip(self.residuals_now(window)).for_each(|(to, (jd, _))| *to = jd);
        for (i, jd) in at_delta[..self.rows.count()].iter().enumerate() {
            self.rows.row_mut(i)[n - 1] -= *jd;
        }
        self.stride = self.rows.gram(0, &mut self.gram);
    }

    /// `½ ‖J n‖²` of a direction given per frame as [p, θ, v, bg, ba]; nothing of the rig moves.
    #[cfg(test)]
    pub fn energy(&self, window: &Window, direction: impl Fn(usize) -> [f64; 15]) -> f64 {
        let of = |b: Block, out: &mut [f64]| match b {
            Block::Pose(s) => out.copy_from_slice(&direction(s as usize)[..POSE_DIM]),
            Block::Motion(s) => out.copy_from_slice(&direction(s as usize)[POSE_DIM..]),
            Block::HeightBias(_) | Block::Rig => out.fill(0.0),
        };
        self.residuals(self.deltas(window, of)).map(|(jd, _)| 0.5 * jd * jd).sum()
    }
}

const _: () = assert!(FRAMES + 4 <= 2 * FRAMES && RIG_DIM < WINDOW_DIM);
