//! The points that are followed: which camera sees each where, and what it looks like there. Room for all is bought
//! once.

use super::patch::{Stack, Template};
use crate::limits::{CAMERAS_MAX, TRACKS};

/// Levels a prediction is refined over, the full image included; the rest are for where it fails.
pub const FINE_LEVELS: usize = 2;

/// A point and its views.
#[derive(Clone, Copy, Default)]
pub struct Point {
    pub id: u64,
    /// Inverse distance along the ray of the first camera that sees it, 1/m; kept while no second camera does.
    pub inverse_depth: Option<f64>,
    /// Frame of the next search along the epipolar curve in each camera, and the wait after it.
    pub search_at: [u64; CAMERAS_MAX],
    pub search_wait: [u64; CAMERAS_MAX],
    /// Pixel in each camera that sees it.
    pub views: [Option<[f32; 2]>; CAMERAS_MAX],
    /// Patch of each view, in those of its camera.
    pub patches: [usize; CAMERAS_MAX],
}

impl Point {
    /// First camera that sees it.
    pub fn first(&self) -> Option<usize> {
        self.views.iter().position(Option::is_some)
    }
}

/// What a view looked like: in the last frame at the fine levels, and when it was first seen. Coarse levels
/// are taken from the last frame's pyramid when they are needed.
#[derive(Clone, Default)]
pub struct Patch {
    pub last: [Template; FINE_LEVELS],
    pub reference: Template,
    /// Direction of the rotation since the reference.
    pub rotation: [f32; 2],
}

impl Patch {
    /// Takes what was found as last view and as reference.
    pub fn restart(&mut self, stack: &Stack) {
        self.last.copy_from_slice(&stack[..FINE_LEVELS]);
        self.reference = stack[0];
        self.rotation = [1.0, 0.0];
    }
}

/// All points, their patches, and the room that is left.
pub struct Points {
    /// Ascending id.
    pub list: Vec<Point>,
    /// `patches[camera][patch]`
    pub patches: Vec<Vec<Patch>>,
    /// Free patches of each camera.
    free: Vec<Vec<usize>>,
    next_id: u64,
}

impl Points {
    pub fn new(cameras: usize) -> Points {
        Points {
            list: Vec::with_capacity(cameras * TRACKS),
            patches: (0..cameras).map(|_| vec![Patch::default(); TRACKS]).collect(),
            free: (0..cameras).map(|_| (0..TRACKS).rev().collect()).collect(),
            next_id: 0,
        }
    }

    /// How many points that are seen in a camera first may be created.
    pub fn room(&self, camera: usize) -> usize {
        self.free[camera].len().min(self.list.capacity() - self.list.len())
    }

    /// Creates a point seen in one camera, where there is room for it.
    pub fn create(&mut self, camera: usize, px: [f32; 2], stack: &Stack) {
        self.list.push(Point { id: self.next_id, ..Point::default() });
        self.next_id += 1;
        self.add_view(self.list.len() - 1, camera, px, stack);
    }

    /// Whether a camera has room for one more view.
    pub fn has_room(&self, camera: usize) -> bool {
        !self.free[camera].is_empty()
    }

    /// Adds a view and what it looks like, where there is room for it.
    pub fn add_view(&mut self, i: usize, camera: usize, px: [f32; 2], stack: &Stack) {
        let patch = self.free[camera].pop().expect("the caller looked for room");
        self.patches[camera][patch].restart(stack);
        (self.list[i].views[camera], self.list[i].patches[camera]) = (Some(px), patch);
    }

    /// Ends a view and frees its patch; answers whether there was one.
    pub fn lose(&mut self, i: usize, camera: usize) -> bool {
        let lost = self.list[i].views[camera].take().is_some();
        if lost {
            self.free[camera].push(self.list[i].patches[camera]);
        }
        lost
    }

    /// Whether one of the first `n` points is nearer to a pixel of a camera than `spacing_px`.
    pub fn is_near(&self, n: usize, camera: usize, px: [f32; 2], spacing_px: f32) -> bool {
        // Most are further off along one axis already: that takes no root.
        let near = |q: [f32; 2]| (0..2).all(|k| (px[k] - q[k]).abs() < spacing_px) && distance(px, q) < spacing_px;
        self.list[..n].iter().any(|p| p.views[camera].is_some_and(near))
    }
}

/// Between two pixels, px.
pub fn distance(a: [f32; 2], b: [f32; 2]) -> f32 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}
