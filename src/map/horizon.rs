//! How far a view sees: the depth of its picture in a few cells, coarse and small enough to keep for every keyframe that is
//! known, in memory and on disk. With it, which keyframes see a block is told on the host, without drawing anything, whether
//! or not their images and Gaussians are in memory.
//!
//! A cell has the farthest surface in it, so what stands behind a door's edge still counts as seen.

use super::render::Rendered;
use super::view::View;
use glam::{DVec3, Vec3};
use std::sync::LazyLock;

pub const COLUMNS: usize = 16;
pub const ROWS: usize = 12;
pub const CELLS: usize = COLUMNS * ROWS;

/// A Gaussian reaches so many σ.
pub const SIGMAS: f64 = 3.0;
/// Nothing is known of how far a cell sees.
const OPEN: u8 = u8::MAX;
/// The nearest depth that a cell can have, m, and the ratio from one code to the next: 0.1 m to 100 m in steps of 2.8 %.
const NEAREST_M: f64 = 0.1;
const STEP_LN: f64 = 0.0272;
/// A surface is as deep as this, by a fraction and m: the error of depth, and Gaussians of a wall behind its middle.
const THICKNESS: f64 = 0.1;
const THICKNESS_M: f64 = 0.15;
/// A pixel this opaque shows a surface; a cell with a smaller part of its pixels that do is open.
const SURFACE_ALPHA: f32 = 0.5;
const SURFACE_PART: f64 = 0.75;

/// Some of the cells of a picture.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Cells(pub [u32; CELLS / 32]);

impl Cells {
    pub fn insert(&mut self, cell: usize) {
        self.0[cell / 32] |= 1 << (cell % 32);
    }

    pub fn contains(&self, cell: usize) -> bool {
        self.0[cell / 32] >> (cell % 32) & 1 == 1
    }

    pub fn len(&self) -> usize {
        self.0.iter().map(|word| word.count_ones() as usize).sum()
    }

    pub fn is_empty(&self) -> bool {
        self.0 == Self::default().0
    }
}

/// The cells of a view that show what is not in the pool.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Absent {
    /// Much of it: not compared.
    pub hidden: Cells,
    /// Some of it: the image stands in for it. Those of `hidden` among them.
    pub filled: Cells,
}

/// Codes of depth, row by row.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Horizon(pub [u8; CELLS]);

impl Default for Horizon {
    fn default() -> Horizon {
        Horizon([OPEN; CELLS])
    }
}

/// The cell of a pixel of an image of so many.
pub fn cell_of(x: f64, y: f64, width: usize, height: usize) -> usize {
    let nth = |v: f64, size: usize, n: usize| (((v + 0.5) / size as f64 * n as f64) as usize).min(n - 1);
    nth(y, height, ROWS) * COLUMNS + nth(x, width, COLUMNS)
}

impl Horizon {
    /// The horizon of a picture of the map.
    pub fn of(rendered: &Rendered) -> Horizon {
        let (w, h) = (rendered.width, rendered.height);
        let (mut farthest, mut shown, mut all) = ([0.0f32; CELLS], [0u32; CELLS], [0u32; CELLS]);
        for y in 0..h {
            for x in 0..w {
                let (i, cell) = (y * w + x, cell_of(x as f64, y as f64, w, h));
                all[cell] += 1;
                if rendered.alpha[i] >= SURFACE_ALPHA && rendered.depth[i] > 0.0 {
                    shown[cell] += 1;
                    farthest[cell] = farthest[cell].max(rendered.depth[i]);
                }
            }
        }
        Horizon(std::array::from_fn(|cell| {
            let known = f64::from(shown[cell]) >= SURFACE_PART * f64::from(all[cell].max(1));
            if known {
                code(f64::from(farthest[cell]))
            } else {
                OPEN
            }
        }))
    }

    /// Keeps what another knows of how far it sees where this one knows nothing.
    pub fn take_over(&mut self, other: &Horizon) {
        self.0.iter_mut().zip(other.0).filter(|(code, _)| **code == OPEN).for_each(|(code, known)| *code = known);
    }

    /// Takes the mean depth of the pixels that have one where nothing is known of how far a cell sees; row by row, zero for none.
    pub fn fill(&mut self, depth: &[f32], width: usize) {
        let (mut sum, mut n) = ([0.0f64; CELLS], [0u32; CELLS]);
        for (i, z) in depth.iter().enumerate().filter(|(_, z)| **z > 0.0) {
            let cell = cell_of((i % width) as f64, (i / width) as f64, width, depth.len() / width);
            (sum[cell], n[cell]) = (sum[cell] + f64::from(*z), n[cell] + 1);
        }
        for cell in (0..CELLS).filter(|cell| n[*cell] > 0) {
            if self.0[cell] == OPEN {
                self.0[cell] = code(sum[cell] / f64::from(n[cell]));
            }
        }
    }

    /// The cell in which a view with this horizon sees a point of its camera's frame, or, by a margin, px, the nearest cell to it,
    /// and how far outside the picture the point is, px. A cell of which nothing is known sees all.
    pub fn sees(&self, view: &View, p_cam: DVec3, margin_px: f64) -> Option<(usize, f64)> {
        let (x, y, depth) = view.project(p_cam, margin_px)?;
        let (width, height) = (view.camera.width, view.camera.height);
        let cell = cell_of(x, y, width, height);
        let outside = |v: f64, size: usize| (-0.5 - v).max(v + 0.5 - size as f64).max(0.0);
        self.reaches(cell, depth).then(|| (cell, outside(x, width).max(outside(y, height))))
    }

    fn reaches(&self, cell: usize, depth: f64) -> bool {
        self.0[cell] == OPEN || depth <= METRES[usize::from(self.0[cell])] * (1.0 + THICKNESS) + THICKNESS_M
    }

    /// The part of the cells of which nothing is known.
    pub fn open_part(&self) -> f64 {
        self.0.iter().filter(|code| **code == OPEN).count() as f64 / CELLS as f64
    }
}

fn code(depth_m: f64) -> u8 {
    ((depth_m / NEAREST_M).ln() / STEP_LN).ceil().clamp(0.0, f64::from(OPEN)) as u8
}

/// What each code stands for, m.
static METRES: LazyLock<[f64; 256]> = LazyLock::new(|| std::array::from_fn(|code| metres(code as u8)));

fn metres(code: u8) -> f64 {
    NEAREST_M * (f64::from(code) * STEP_LN).exp()
}

/// A ball around Gaussians, means and σ, m: its centre is the mean of theirs.
pub fn ball(samples: &[[f32; 4]]) -> (Vec3, f32) {
    let means = || samples.iter().map(|[x, y, z, _]| Vec3::new(*x, *y, *z));
    let centre = means().sum::<Vec3>() / samples.len().max(1) as f32;
    let reach = means().zip(samples).map(|(mean, [.., size])| centre.distance(mean) + SIGMAS as f32 * size);
    (centre, reach.fold(0.0, f32::max))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::coverage::tests::{black, view, H, W};

    #[test]
    fn codes_round_up_by_less_than_a_step() {
        for depth in [0.05, 0.1, 0.33, 1.0, 7.7, 60.0] {
            let told = metres(code(depth));
            assert!(told >= depth && told <= f64::max(depth, NEAREST_M) * STEP_LN.exp() * 1.0001, "{depth}: {told}");
        }
        assert_eq!(code(1e9), OPEN);
    }

    #[test]
    fn a_wall_hides_what_is_behind_it_and_a_hole_does_not() {
        let mut rendered = black(&[1.0; W * H]);
        rendered.depth.fill(2.0);
        // The right half is uncovered.
        (0..H).for_each(|y| rendered.alpha[y * W + W / 2..(y + 1) * W].fill(0.0));
        let (horizon, view) = (Horizon::of(&rendered), view());
        for (x, z, seen) in
            [(-0.3, 1.0, true), (-0.3, 2.1, true), (-0.4, 3.0, false), (0.4, 3.0, true), (0.0, -1.0, false)]
        {
            assert_eq!(horizon.sees(&view, DVec3::new(x, 0.1, z), 0.0).is_some(), seen, "{x} {z}");
        }
        assert!(horizon.sees(&view, DVec3::new(9.0, 0.0, 1.0), 0.0).is_none(), "beside the picture");
        assert_eq!((horizon.open_part(), Horizon::default().open_part()), (0.5, 1.0));
    }

    #[test]
    fn depth_closes_what_is_open_and_nothing_else() {
        let mut rendered = black(&[1.0; W * H]);
        rendered.depth.fill(2.0);
        (0..H).for_each(|y| rendered.alpha[y * W + W / 2..(y + 1) * W].fill(0.0));
        let (mut horizon, view) = (Horizon::of(&rendered), view());
        let behind = DVec3::new(0.4, 0.1, 3.5);
        assert!(horizon.sees(&view, behind, 0.0).is_some(), "nothing is known of how far it sees");
        horizon.fill(&[3.0; W * H], W);
        assert_eq!(horizon.open_part(), 0.0);
        assert!(
            horizon.sees(&view, DVec3::new(0.4, 0.1, 3.0), 0.0).is_some()
                && horizon.sees(&view, behind * 2.0, 0.0).is_none()
        );
        assert!(horizon.sees(&view, DVec3::new(-0.4, 0.1, 3.0), 0.0).is_none(), "the map is nearer there");
        let known = horizon;
        horizon.fill(&[0.0; W * H], W);
        assert_eq!(horizon, known);
    }

    #[test]
    fn cells_are_counted_and_found() {
        let mut cells = Cells::default();
        [0, 31, 32, CELLS - 1, 31].into_iter().for_each(|cell| cells.insert(cell));
        assert_eq!((cells.len(), cells.is_empty(), Cells::default().is_empty()), (4, false, true));
        assert!(cells.contains(31) && cells.contains(CELLS - 1) && !cells.contains(33));
    }

    #[test]
    fn a_ball_holds_its_points() {
        let points = [[0.0, 0.0, 0.0, 0.1], [2.0, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0]];
        let (centre, radius) = ball(&points);
        assert!(points.iter().all(|[x, y, z, size]| centre.distance(Vec3::new(*x, *y, *z)) + size <= radius));
        assert_eq!(ball(&[]), (Vec3::ZERO, 0.0));
    }
}
