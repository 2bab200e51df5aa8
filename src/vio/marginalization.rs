//! What leaves the window becomes a prior on what it touched.
//!
//! Per frame: the oldest state leaves once there are more than rest in the window; a keyframe keeps
//! its pose, another frame goes whole. Beyond the resting number of keyframe poses the least useful
//! goes. The factors that leave with them (the old prior, the inertial factor, finished landmarks,
//! landmarks of the removed keyframe) are stacked as rows, leaving columns first, and a
//! rank-revealing QR takes those columns out. What stays is a square root: its rows times a
//! direction are zero where nothing was observed (Demmel et al.,
//! ICCV 2021). The state after the leaving one is the boundary: nothing newer is linearised.

use super::landmarks::{Landmark, Landmarks};
use super::linear::{inertial_rows, landmark_rows, rest_rows, Linear, POINT_DIM, STACK_ROWS};
use super::residuals::Motion;
use super::rig::{RigSigma, RigState};
use super::solve::Model;
use super::window::{Layout, Window, FRAMES, MOTION_DIM, POSE_DIM};
use crate::limits::{RIG_DIM, WINDOW_DIM};
use crate::math::dense::{Columns, System};
use crate::math::qr::Rows;
use crate::mem::List;

/// A keyframe of which fewer than this fraction of landmarks is still seen goes first.
const SEEN_FRACTION_MIN: f64 = 0.1;
/// Newest keyframes that are never removed.
const KEYFRAMES_SAFE: usize = 2;

/// What a run of columns of the prior belongs to.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Block {
    Pose(u8),
    Motion(u8),
    /// Cameras, then inertial unit.
    Rig(bool),
}

impl Default for Block {
    fn default() -> Block {
        Block::Rig(false)
    }
}

type Blocks = List<Block, { 2 * FRAMES }>;

/// `½ ‖J δ + r‖²` on the errors δ of what is anchored.
#[derive(Clone, Debug)]
pub struct Prior {
    rows: Rows,
    /// JᵀJ, which every linearisation adds; its last row is r's and changes.
    gram: Vec<f64>,
    stride: usize,
    blocks: Blocks,
}

impl Prior {
    pub fn new() -> Prior {
        let cols = WINDOW_DIM + 1;
        let gram = vec![0.0; Rows::gram_len(cols)];
        let mut rows = Rows::new(cols, cols);
        rows.clear(1);
        Prior { rows, gram, stride: 0, blocks: List::default() }
    }

    pub const BYTES: usize =
        Rows::bytes(WINDOW_DIM + 1, WINDOW_DIM + 1) + Rows::gram_len(WINDOW_DIM + 1) * size_of::<f64>();

    pub fn clear(&mut self) {
        self.blocks.clear();
        self.rows.clear(1);
    }

    /// Starts with one state and the rig, which are to be anchored, and their standard deviations; tilt and yaw
    /// are about world axes.
    pub fn start(&mut self, slot: usize, motion: &Motion, sigma: &Sigma, rig: (&RigState, &RigSigma)) {
        self.blocks.clear();
        let _ = self.blocks.push(Block::Pose(slot as u8));
        let _ = self.blocks.push(Block::Motion(slot as u8));
        let (cameras, imu) = (rig.0.camera_dim(), rig.0.parts.imu_dim());
        for (width, is_imu) in [(cameras, false), (imu, true)] {
            if width > 0 {
                let _ = self.blocks.push(Block::Rig(is_imu));
            }
        }
        self.rows.clear(15 + cameras + imu + 1);
        let r = motion.pose.rotation();
        let mut diagonal = |i: usize, s: f64| self.rows.push()[i] = 1.0 / s;
        for i in 0..3 {
            diagonal(i, sigma.p);
            diagonal(6 + i, sigma.v);
            diagonal(9 + i, sigma.bg);
            diagonal(12 + i, sigma.ba);
        }
        for (i, s) in rig.0.sigmas(rig.1)[..cameras + imu].iter().enumerate() {
            diagonal(15 + i, *s);
        }
        for (axis, s) in [sigma.tilt, sigma.tilt, sigma.yaw].into_iter().enumerate() {
            let row = self.rows.push();
            (0..3).for_each(|i| row[3 + i] = r.col(i)[axis] / s);
        }
        self.stride = self.rows.gram(0, &mut self.gram);
    }

    fn width(block: Block, rig: &RigState) -> usize {
        match block {
            Block::Pose(_) => POSE_DIM,
            Block::Motion(_) => MOTION_DIM,
            Block::Rig(false) => rig.camera_dim(),
            Block::Rig(true) => rig.parts.imu_dim(),
        }
    }

    fn place(block: Block, layout: &Layout) -> Columns {
        let place = match block {
            Block::Pose(s) => layout.state(s as usize)[0],
            Block::Motion(s) => layout.state(s as usize)[1],
            Block::Rig(false) => layout.cameras(),
            Block::Rig(true) => layout.imu(),
        };
        place.expect("the layout holds all that the prior is about")
    }

    /// `J δ` and r, a row at a time, for the errors δ `of` each block.
    fn residuals<'a>(
        &'a self,
        window: &Window,
        of: impl Fn(Block, &mut [f64]),
    ) -> impl Iterator<Item = (f64, f64)> + 'a {
        let mut d = [0.0; WINDOW_DIM];
        let mut at = 0;
        for b in self.blocks.iter() {
            let width = Self::width(*b, &window.rig);
            of(*b, &mut d[at..at + width]);
            at += width;
        }
        (0..self.rows.len()).map(move |i| {
            let row = self.rows.row(i);
            ((0..at).map(|c| row[c] * d[c]).sum::<f64>(), row[at])
        })
    }

    fn delta(window: &Window, block: Block, out: &mut [f64]) {
        let n = out.len();
        match block {
            Block::Pose(s) => out.copy_from_slice(&window.frame(s as usize).delta[..POSE_DIM]),
            Block::Motion(s) => out.copy_from_slice(&window.frame(s as usize).delta[POSE_DIM..]),
            Block::Rig(false) => out.copy_from_slice(&window.rig.delta[..n]),
            Block::Rig(true) => out.copy_from_slice(&window.rig.delta[window.rig.camera_dim()..][..n]),
        }
    }

    pub fn cost(&self, window: &Window) -> f64 {
        self.residuals(window, |b, out| Self::delta(window, b, out)).map(|(jd, r)| 0.5 * (jd + r) * (jd + r)).sum()
    }

    fn spans(&self, layout: &Layout) -> List<Columns, { 2 * FRAMES }> {
        let mut spans = List::default();
        for b in self.blocks.iter() {
            let _ = spans.push(Self::place(*b, layout));
        }
        spans
    }

    /// Adds the square of the prior; answers its cost.
    pub fn add_to(&mut self, window: &Window, layout: &Layout, system: &mut System) -> f64 {
        let mut cost = 0.0;
        let mut b = [0.0; WINDOW_DIM];
        let n = self.rows.cols() - 1;
        for (i, (jd, r)) in self.residuals(window, |b, out| Self::delta(window, b, out)).enumerate() {
            let e = jd + r;
            cost += 0.5 * e * e;
            b[..n].iter_mut().zip(self.rows.row(i)).for_each(|(b, j)| *b += *j * e);
        }
        self.gram[n * self.stride..][..n].copy_from_slice(&b[..n]);
        let spans = self.spans(layout);
        system.add_gram(&self.gram, self.stride, 0, &spans);
        cost
    }

    /// Stacks the prior's rows at the estimate.
    fn append_to(&self, window: &Window, layout: &Layout, stack: &mut Rows) {
        let spans = self.spans(layout);
        for (i, (jd, r)) in self.residuals(window, |b, out| Self::delta(window, b, out)).enumerate() {
            let (row, out) = (self.rows.row(i), stack.push());
            let mut at = 0;
            for s in spans.iter() {
                out[s.at..s.at + s.len].copy_from_slice(&row[at..at + s.len]);
                at += s.len;
            }
            out[out.len() - 1] = jd + r;
        }
    }

    /// Takes what is left of a stack, whose first columns have left, as the new prior, re-based to the anchors.
    fn take(&mut self, stack: &Rows, left: usize, blocks: Blocks, window: &Window) {
        self.blocks = blocks;
        let n = stack.cols() - left;
        self.rows.clear(n);
        for i in 0..stack.len() {
            self.rows.push().copy_from_slice(&stack.row(i)[left..]);
        }
        let mut shift = [0.0; WINDOW_DIM + 1];
        let moved = self.residuals(window, |b, out| Self::delta(window, b, out));
        shift.iter_mut().zip(moved).for_each(|(to, (jd, _))| *to = jd);
        for (i, shift) in shift[..self.rows.len()].iter().enumerate() {
            self.rows.row_mut(i)[n - 1] -= *shift;
        }
        self.stride = self.rows.gram(0, &mut self.gram);
    }

    /// `½ ‖J n‖²` of a direction given per frame as [p, θ, v, bg, ba]; nothing of the rig moves.
    pub fn energy(&self, window: &Window, direction: impl Fn(usize) -> [f64; 15]) -> f64 {
        let of = |b: Block, out: &mut [f64]| match b {
            Block::Pose(s) => out.copy_from_slice(&direction(s as usize)[..POSE_DIM]),
            Block::Motion(s) => out.copy_from_slice(&direction(s as usize)[POSE_DIM..]),
            Block::Rig(_) => out.fill(0.0),
        };
        self.residuals(window, of).map(|(jd, _)| 0.5 * jd * jd).sum()
    }
}

impl Default for Prior {
    fn default() -> Self {
        Prior::new()
    }
}

/// Standard deviations of the first state.
#[derive(Clone, Copy, Debug)]
pub struct Sigma {
    pub p: f64,
    pub tilt: f64,
    pub yaw: f64,
    pub v: f64,
    pub bg: f64,
    pub ba: f64,
}

impl Sigma {
    /// As the covariance of a motion's errors.
    pub fn covariance(&self, motion: &Motion) -> [[f64; 15]; 15] {
        let r = motion.pose.rotation();
        let mut c = [[0.0; 15]; 15];
        for i in 0..3 {
            for (at, sigma) in [(0, self.p), (6, self.v), (9, self.bg), (12, self.ba)] {
                c[at + i][at + i] = sigma * sigma;
            }
            for j in 0..3 {
                let world = [self.tilt, self.tilt, self.yaw];
                c[3 + i][3 + j] = (0..3).map(|k| r.col(i)[k] * world[k] * world[k] * r.col(j)[k]).sum();
            }
        }
        c
    }
}

/// The keyframe pose whose removal costs least: one hardly seen any more, else the one most crowded
/// by the others and farthest from now (Engel et al., PAMI 2018).
fn least_useful(window: &Window, landmarks: &Landmarks, newest: usize) -> Option<usize> {
    let mut candidates: List<u8, FRAMES> = List::default();
    let n = window.keyframe_poses().count();
    for s in window.keyframe_poses().take(n.saturating_sub(KEYFRAMES_SAFE)) {
        candidates.push(s as u8).ok()?;
    }
    let sees = |l: &Landmark| l.observations.iter().any(|o| o.slot as usize == newest);
    for s in candidates.iter() {
        let seen = landmarks.pool.iter().filter(|l| l.host == *s && sees(l)).count();
        if (seen as f64) < SEEN_FRACTION_MIN * window.frame(*s as usize).hosted as f64 {
            return Some(*s as usize);
        }
    }
    let p = |s: usize| window.frame(s).now.pose.p;
    let score = |s: usize| {
        let crowd: f64 =
            window.keyframe_poses().filter(|o| *o != s).map(|o| 1.0 / ((p(s) - p(o)).length() + 1e-5)).sum();
        (p(s) - p(newest)).length().sqrt() * crowd
    };
    candidates.iter().map(|s| *s as usize).min_by(|a, b| score(*a).total_cmp(&score(*b)))
}

/// Rows and a factor's block, bought once.
#[derive(Clone, Debug)]
pub struct Marginalizer {
    stack: Rows,
}

impl Marginalizer {
    pub fn new() -> Marginalizer {
        Marginalizer { stack: Rows::new(STACK_ROWS, WINDOW_DIM + 1) }
    }

    pub const BYTES: usize = Rows::bytes(STACK_ROWS, WINDOW_DIM + 1);

    /// Shrinks the window back to its resting size.
    pub fn marginalize(
        &mut self,
        window: &mut Window,
        landmarks: &mut Landmarks,
        prior: &mut Prior,
        linear: &mut Linear,
        model: &Model,
    ) {
        let mut states = window.states();
        let (Some(oldest), Some(boundary)) = (states.next(), states.next()) else { return };
        if 2 + states.count() <= model.states {
            return;
        }
        let newest = window.newest().expect("a window with states has a newest frame");
        let keeps_pose = window.frame(oldest).keyframe;
        let poses = window.keyframe_poses().count() + keeps_pose as usize;
        let removed = if poses > model.keyframes { least_useful(window, landmarks, newest) } else { None };

        // Leaving columns first; every frame up to the boundary is in.
        let mut layout = Layout::empty();
        layout.add_motion(oldest);
        if !keeps_pose {
            layout.add_pose(oldest);
        }
        removed.into_iter().for_each(|s| layout.add_pose(s));
        let leaving = layout.dim;
        let mut blocks = Blocks::default();
        let mut keep = |b: Block| blocks.push(b).expect("a block a frame, one of motion and two of the rig");
        layout.add_rig(&window.rig);
        layout.cameras().into_iter().for_each(|_| keep(Block::Rig(false)));
        layout.imu().into_iter().for_each(|_| keep(Block::Rig(true)));
        let kept = window.keyframe_poses().filter(|s| Some(*s) != removed);
        for s in kept.chain(keeps_pose.then_some(oldest)).chain([boundary]) {
            layout.add_pose(s);
            keep(Block::Pose(s as u8));
        }
        layout.add_motion(boundary);
        keep(Block::Motion(boundary as u8));

        let stack = &mut self.stack;
        stack.clear(layout.dim + 1);
        prior.append_to(window, &layout, stack);
        inertial_rows(window, oldest, boundary, &layout, linear);
        linear.append_to(0, stack);
        if rest_rows(window, oldest, &layout, linear).is_some() {
            linear.append_to(0, stack);
        }
        let finished = |l: &Landmark| {
            Some(l.host as usize) == removed || l.observations.iter().all(|o| layout.pose(o.slot as usize).is_some())
        };
        for l in landmarks.pool.iter().filter(|l| finished(l)) {
            if landmark_rows(l, window, model, &layout, linear).1 {
                linear.append_to(POINT_DIM, stack);
            }
        }
        landmarks.retain(|l| !finished(l));

        stack.marginalize(leaving);
        for b in blocks.iter() {
            match b {
                Block::Pose(s) | Block::Motion(s) => window.frame_mut(*s as usize).fix_linearization_point(),
                Block::Rig(_) => window.rig.fix_linearization_point(),
            }
        }
        prior.take(stack, leaving, blocks, window);

        if keeps_pose {
            window.frame_mut(oldest).moving = false;
        } else {
            window.remove(oldest);
            landmarks.forget(oldest);
        }
        if let Some(s) = removed {
            window.remove(s);
            landmarks.forget(s);
        }
    }
}

impl Default for Marginalizer {
    fn default() -> Self {
        Marginalizer::new()
    }
}

const _: () = assert!(FRAMES + 4 <= 2 * FRAMES && RIG_DIM < WINDOW_DIM);
