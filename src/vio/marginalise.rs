//! What leaves the window becomes a prior on what it touched.
//!
//! Per frame: the oldest state leaves once there are more than `STATES`; a keyframe keeps its pose,
//! another frame goes whole. Beyond `KEYFRAMES` poses the least useful keyframe goes. The factors
//! that leave with them (the old prior, the inertial factor, finished landmarks, landmarks of the
//! removed keyframe) are linearised and the leaving variables eliminated. The state after the
//! leaving one is the boundary: nothing newer is linearised.

use super::landmarks::Landmarks;
use super::residuals::Motion;
use super::rest::add_rest;
use super::solve::{add_inertial, eliminate_landmark, Model, Solver};
use super::window::{Layout, Window, FRAMES, MOTION_DIM, POSE_DIM};
use crate::limits::{KEYFRAMES, STATES, WINDOW_DIM};
use crate::math::dense::System;
use crate::mem::List;

/// A keyframe of which fewer than this fraction of landmarks is still seen goes first.
const SEEN_FRACTION_MIN: f64 = 0.1;
/// Newest keyframes that are never removed.
const KEYFRAMES_SAFE: usize = 2;

#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Block {
    slot: u8,
    motion: bool,
}

/// `½ δᵀ H δ + bᵀ δ` on the errors δ of anchored frames.
#[derive(Clone, Debug)]
pub struct Prior {
    system: System,
    blocks: List<Block, { 2 * FRAMES }>,
}

impl Prior {
    pub fn new() -> Prior {
        Prior { system: System::new(WINDOW_DIM), blocks: List::default() }
    }

    pub const BYTES: usize = WINDOW_DIM * (WINDOW_DIM + 1) * 8;

    pub fn clear(&mut self) {
        self.blocks.clear();
        self.system.clear(0);
    }

    /// Starts with one state and its standard deviations; tilt and yaw are about world axes.
    pub fn start(&mut self, slot: usize, motion: &Motion, sigma: &Sigma) {
        self.blocks.clear();
        let _ = self.blocks.push(Block { slot: slot as u8, motion: false });
        let _ = self.blocks.push(Block { slot: slot as u8, motion: true });
        self.system.clear(15);
        let r = motion.pose.rotation();
        let info = |s: f64| 1.0 / (s * s);
        for i in 0..3 {
            self.system.add(i, i, info(sigma.p));
            for j in 0..=i {
                let world = [sigma.tilt, sigma.tilt, sigma.yaw];
                let x: f64 = (0..3).map(|k| r.col(i)[k] * info(world[k]) * r.col(j)[k]).sum();
                self.system.add(3 + i, 3 + j, x);
            }
            self.system.add(6 + i, 6 + i, info(sigma.v));
            self.system.add(9 + i, 9 + i, info(sigma.bg));
            self.system.add(12 + i, 12 + i, info(sigma.ba));
        }
    }

    /// Errors of the anchored frames, and where they sit in `layout`.
    fn delta(&self, window: &Window) -> [f64; WINDOW_DIM] {
        let mut d = [0.0; WINDOW_DIM];
        let mut at = 0;
        for b in self.blocks.iter() {
            let delta = &window.frame(b.slot as usize).delta;
            let part = if b.motion { &delta[POSE_DIM..] } else { &delta[..POSE_DIM] };
            d[at..at + part.len()].copy_from_slice(part);
            at += part.len();
        }
        d
    }

    fn columns(&self, layout: &Layout) -> [usize; WINDOW_DIM] {
        let mut columns = [0; WINDOW_DIM];
        let mut at = 0;
        for b in self.blocks.iter() {
            let slot = b.slot as usize;
            let (place, n) = if b.motion { (layout.motion(slot), MOTION_DIM) } else { (layout.pose(slot), POSE_DIM) };
            let place = place.expect("the layout holds every frame of the prior");
            (0..n).for_each(|i| columns[at + i] = place + i);
            at += n;
        }
        columns
    }

    pub fn cost(&self, window: &Window) -> f64 {
        let d = self.delta(window);
        let mut hd = [0.0; WINDOW_DIM];
        self.system.multiply(&d, &mut hd);
        (0..self.system.dim).map(|i| d[i] * (0.5 * hd[i] + self.system.b[i])).sum()
    }

    pub fn add_to(&self, window: &Window, layout: &Layout, system: &mut System) -> f64 {
        let d = self.delta(window);
        let columns = self.columns(layout);
        let mut hd = [0.0; WINDOW_DIM];
        self.system.multiply(&d, &mut hd);
        let mut cost = 0.0;
        for i in 0..self.system.dim {
            system.b[columns[i]] += hd[i] + self.system.b[i];
            cost += d[i] * (0.5 * hd[i] + self.system.b[i]);
            for j in 0..=i {
                system.add(columns[i], columns[j], self.system.at(i, j));
            }
        }
        cost
    }

    /// Takes the trailing block of an eliminated system as the new prior, re-based to the anchors.
    fn take(&mut self, system: &System, eliminated: usize, blocks: List<Block, { 2 * FRAMES }>, window: &Window) {
        self.blocks = blocks;
        let n = system.dim - eliminated;
        self.system.clear(n);
        for i in 0..n {
            self.system.b[i] = system.b[eliminated + i];
            for j in 0..=i {
                self.system.add(i, j, system.at(eliminated + i, eliminated + j));
            }
        }
        let d = self.delta(window);
        let mut hd = [0.0; WINDOW_DIM];
        self.system.multiply(&d, &mut hd);
        (0..n).for_each(|i| self.system.b[i] -= hd[i]);
    }

    /// `½ nᵀ H n` of a direction given per frame as [p, θ, v, bg, ba].
    pub fn energy(&self, direction: impl Fn(usize) -> [f64; 15]) -> f64 {
        let mut d = [0.0; WINDOW_DIM];
        let mut at = 0;
        for b in self.blocks.iter() {
            let full = direction(b.slot as usize);
            let part = if b.motion { &full[POSE_DIM..] } else { &full[..POSE_DIM] };
            d[at..at + part.len()].copy_from_slice(part);
            at += part.len();
        }
        let mut hd = [0.0; WINDOW_DIM];
        self.system.multiply(&d, &mut hd);
        0.5 * (0..self.system.dim).map(|i| d[i] * hd[i]).sum::<f64>()
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
    let sees = |l: &super::landmarks::Landmark| l.observations.iter().any(|o| o.slot as usize == newest);
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

/// Shrinks the window back to its resting size.
pub fn marginalise(
    window: &mut Window,
    landmarks: &mut Landmarks,
    prior: &mut Prior,
    solver: &mut Solver,
    model: &Model,
) {
    let mut states = window.states();
    let (Some(oldest), Some(boundary)) = (states.next(), states.next()) else { return };
    if 2 + states.count() <= STATES {
        return;
    }
    let newest = window.newest().expect("a window with states has a newest frame");
    let keeps_pose = window.frame(oldest).keyframe;
    let poses = window.keyframe_poses().count() + keeps_pose as usize;
    let removed = if poses > KEYFRAMES { least_useful(window, landmarks, newest) } else { None };

    // Leaving columns first; every frame up to the boundary is in.
    let mut layout = Layout::empty();
    layout.add_motion(oldest);
    if !keeps_pose {
        layout.add_pose(oldest);
    }
    removed.into_iter().for_each(|s| layout.add_pose(s));
    let leaving = layout.dim;
    let mut blocks = List::default();
    for s in
        window.keyframe_poses().filter(|s| Some(*s) != removed).chain(keeps_pose.then_some(oldest)).chain([boundary])
    {
        layout.add_pose(s);
        let _ = blocks.push(Block { slot: s as u8, motion: false });
    }
    layout.add_motion(boundary);
    let _ = blocks.push(Block { slot: boundary as u8, motion: true });

    let (system, scratch) = solver.scratch();
    system.clear(layout.dim);
    prior.add_to(window, &layout, system);
    add_inertial(window, oldest, boundary, &layout, system);
    add_rest(window.frame(oldest), oldest, &layout, system);
    let finished = |l: &super::landmarks::Landmark| {
        Some(l.host as usize) == removed || l.observations.iter().all(|o| layout.pose(o.slot as usize).is_some())
    };
    for l in landmarks.pool.iter().filter(|l| finished(l)) {
        eliminate_landmark(l, window, model, &layout, system, scratch);
    }
    landmarks.retain(|l| !finished(l));

    system.eliminate(leaving);
    for b in blocks.iter() {
        window.frame_mut(b.slot as usize).fix_anchor();
    }
    prior.take(system, leaving, blocks, window);

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
