//! What leaves the window becomes a prior on what it touched.
//!
//! Per frame: the oldest state leaves once there are more than rest in the window; a keyframe keeps
//! its pose, another frame goes whole. Beyond the resting number of keyframe poses the least useful
//! goes. The factors that leave with them (the old prior, those of the state, finished landmarks,
//! landmarks of the removed keyframe) are stacked as rows, leaving columns first, and a
//! rank-revealing QR takes those columns out. What stays is a square root: its rows times a
//! direction are zero where nothing was observed (Demmel et al., ICCV 2021). The state after the
//! leaving one is the boundary: nothing newer is linearized.

use super::factors;
use super::graph::Graph;
use super::landmarks::{Landmark, Landmarks};
use super::model::Model;
use super::prior::{Block, Blocks};
use super::rows::{FactorRows, STACK_ROWS};
use super::window::{Layout, Window};
use crate::limits::WINDOW_DIM;
use crate::math::qr::Rows;

/// A keyframe of which fewer than this fraction of landmarks is still seen goes first.
const SEEN_FRACTION_MIN: f64 = 0.1;
/// Newest keyframes that are never removed.
const KEYFRAMES_SAFE: usize = 2;

/// The stack of rows, bought once.
#[derive(Clone, Debug)]
pub struct Marginalizer {
    stack: Rows,
}

/// Who leaves.
struct Leaving {
    state: usize,
    /// The state after it.
    boundary: usize,
    /// It is a keyframe, and stays as a pose.
    keeps_pose: bool,
    /// A keyframe pose that leaves for it.
    keyframe: Option<usize>,
}

impl Leaving {
    /// `None` while no more states are in the window than rest there.
    fn choose(window: &Window, landmarks: &Landmarks, model: &Model) -> Option<Leaving> {
        let mut states = window.states();
        let (state, boundary) = (states.next()?, states.next()?);
        if 2 + states.count() <= model.config.states as usize {
            return None;
        }
        let keeps_pose = window.frame(state).keyframe;
        let poses = window.keyframe_poses().count() + keeps_pose as usize;
        let full = poses > model.config.keyframes as usize;
        let keyframe = if full { least_useful(window, landmarks, window.newest()?) } else { None };
        Some(Leaving { state, boundary, keeps_pose, keyframe })
    }

    /// Columns of every frame up to the boundary, the leaving ones first; how many leave, and the blocks that stay.
    fn layout(&self, window: &Window) -> (Layout, usize, Blocks) {
        let mut layout = Layout::default();
        layout.add_motion(self.state);
        layout.add_height_bias(window, self.state);
        if !self.keeps_pose {
            layout.add_pose(self.state);
        }
        self.keyframe.into_iter().for_each(|s| layout.add_pose(s));
        let leaving = layout.dim;
        let mut blocks = Blocks::default();
        let mut keep = |b: Block| blocks.push(b).expect("a block a frame, two of the boundary's and one of the rig");
        layout.add_rig(&window.rig);
        keep(Block::Rig);
        let kept = window.keyframe_poses().filter(|s| Some(*s) != self.keyframe);
        for s in kept.chain(self.keeps_pose.then_some(self.state)) {
            layout.add_pose(s);
            keep(Block::Pose(s as u8));
        }
        // In the order of `Layout::of`.
        layout.add_height_bias(window, self.boundary);
        if window.has_heights {
            keep(Block::HeightBias(self.boundary as u8));
        }
        layout.add_pose(self.boundary);
        keep(Block::Pose(self.boundary as u8));
        layout.add_motion(self.boundary);
        keep(Block::Motion(self.boundary as u8));
        (layout, leaving, blocks)
    }

    /// Whether a landmark leaves too: its host does, or no frame past the boundary sees it.
    fn finishes(&self, l: &Landmark, layout: &Layout) -> bool {
        Some(l.host as usize) == self.keyframe || l.observations.iter().all(|o| layout.pose(o.slot as usize).is_some())
    }
}

impl Marginalizer {
    pub fn new() -> Marginalizer {
        Marginalizer { stack: Rows::new(STACK_ROWS, WINDOW_DIM + 1) }
    }

    /// Brings the window back to its resting size; answers how many columns were not finite, whose part of the prior is
    /// lost. `rows` is scratch.
    pub fn marginalize(&mut self, graph: &mut Graph, rows: &mut FactorRows, model: &Model) -> u64 {
        let Graph { window, landmarks, prior } = graph;
        let Some(leaving) = Leaving::choose(window, landmarks, model) else { return 0 };
        let (layout, columns, blocks) = leaving.layout(window);
        let stack = &mut self.stack;
        stack.clear(layout.dim + 1);
        prior.append_to(window, &layout, stack);
        let finished = landmarks.pool.iter().filter(|l| leaving.finishes(l, &layout));
        for factor in factors::of_leaving(window, (leaving.state, leaving.boundary), finished) {
            if let Some(first) = factor.linearize(window, model, &layout, rows).first {
                rows.append_to(first, stack);
            }
        }
        landmarks.retain(|l| !leaving.finishes(l, &layout));

        let lost = stack.marginalize(columns);
        for b in blocks.iter() {
            match b {
                Block::Pose(s) | Block::Motion(s) => window.frame_mut(*s as usize).fix_linearization_point(),
                Block::Rig => window.rig.fix_linearization_point(),
                Block::HeightBias(_) => {}
            }
        }
        prior.take(stack, columns, blocks, window);

        if leaving.keeps_pose {
            window.frame_mut(leaving.state).is_state = false;
        }
        let gone = [(!leaving.keeps_pose).then_some(leaving.state), leaving.keyframe];
        for slot in gone.into_iter().flatten() {
            window.remove(slot);
            landmarks.forget(slot);
        }
        lost
    }
}

/// The keyframe pose whose removal costs least: one hardly seen any more, else the one most crowded
/// by the others and farthest from now (Engel et al., PAMI 2018).
fn least_useful(window: &Window, landmarks: &Landmarks, newest: usize) -> Option<usize> {
    let n = window.keyframe_poses().count();
    let candidates = || window.keyframe_poses().take(n.saturating_sub(KEYFRAMES_SAFE));
    let is_hardly_seen = |s: &usize| {
        let is_seen = |l: &&Landmark| l.host as usize == *s && l.views_in(newest) > 0;
        let seen = landmarks.pool.iter().filter(is_seen).count();
        (seen as f64) < SEEN_FRACTION_MIN * window.frame(*s).hosted as f64
    };
    let p = |s: usize| window.frame(s).now.pose.p;
    let score = |s: usize| {
        let crowd: f64 =
            window.keyframe_poses().filter(|o| *o != s).map(|o| 1.0 / ((p(s) - p(o)).length() + 1e-5)).sum();
        (p(s) - p(newest)).length().sqrt() * crowd
    };
    candidates().find(is_hardly_seen).or_else(|| candidates().min_by(|a, b| score(*a).total_cmp(&score(*b))))
}
