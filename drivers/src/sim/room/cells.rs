//! The cells of a building: boxes seen from inside, joined by openings in their sides.
//!
//! A ray leaves its cell through a wall, or through an opening into the next cell, so a wall hides whatever is behind it
//! from both sides and costs no more than a room's. A doorway is a cell as deep as the wall. Which cells a view may see
//! follows from the plan: the angle that it sees narrows at every opening.

use super::{Room, Solid, NOTHING};
use glam::{Vec2, Vec3};
use std::ops::Range;

/// Openings that a ray passes at most.
const PASSED_MAX: usize = 24;
/// Cells of a building at most: a set of them is a word.
pub const CELLS_MAX: usize = 64;
/// An opening as near as this to the eye hides nothing, m.
const AT_EYE: f32 = 0.1;

/// A box seen from inside.
#[derive(Clone, Debug)]
pub struct Cell {
    /// Corner of least coordinates, m.
    pub low: Vec3,
    /// Corner of largest coordinates, m.
    pub high: Vec3,
    /// Index of its first face: -x, +x, -y, +y, floor, ceiling.
    pub face: u32,
    /// Its furniture, in `Room::solids`. No other cell has it.
    pub solids: Range<usize>,
    /// Where its sides are open.
    pub openings: Vec<Opening>,
}

/// An upright rectangle in a side of a cell.
#[derive(Clone, Copy, Debug)]
pub struct Opening {
    /// The side: -x, +x, -y, +y.
    pub side: u32,
    /// Corner of least coordinates, m.
    pub low: Vec3,
    /// Corner of largest coordinates, m; like the other in the plane of the side.
    pub high: Vec3,
    /// The cell behind it.
    pub to: usize,
}

impl Opening {
    /// Distance in plan from a point, m.
    pub fn distance(&self, p: Vec2) -> f32 {
        p.distance(p.clamp(self.low.truncate(), self.high.truncate()))
    }

    /// Whether a point of its side is in it.
    #[inline]
    fn holds(&self, p: Vec3) -> bool {
        let across = if self.side < 2 {
            p.y >= self.low.y && p.y <= self.high.y
        } else {
            p.x >= self.low.x && p.x <= self.high.x
        };
        across && p.z >= self.low.z && p.z <= self.high.z
    }

    /// Its ends in plan as seen from a point, the right one first, each moved outwards by `slack`; `None` where it is at the
    /// eye.
    fn ends(&self, o: Vec2, slack: f32) -> Option<(Vec2, Vec2)> {
        let (a, b) = (self.low.truncate() - o, self.high.truncate() - o);
        let along = (b - a).normalize_or_zero();
        if along.perp_dot(a).abs() < AT_EYE + slack {
            return None;
        }
        let (a, b) = (a - along * slack, b + along * slack);
        Some(if a.perp_dot(b) >= 0.0 { (a, b) } else { (b, a) })
    }
}

impl Cell {
    /// Whether a point is inside or on a side.
    pub fn contains(&self, p: Vec3) -> bool {
        p.cmpge(self.low).all() && p.cmple(self.high).all()
    }

    /// The distance at which a ray from inside leaves the box, and the face.
    #[inline]
    pub fn exit(&self, o: Vec3, d: Vec3) -> (f32, u32) {
        let far = |o: f32, d: f32, low: f32, high: f32, face: u32| {
            if d > 0.0 {
                ((high - o) / d, face + 1)
            } else if d < 0.0 {
                ((low - o) / d, face)
            } else {
                (f32::INFINITY, face)
            }
        };
        let x = far(o.x, d.x, self.low.x, self.high.x, self.face);
        let y = far(o.y, d.y, self.low.y, self.high.y, self.face + 2);
        let z = far(o.z, d.z, self.low.z, self.high.z, self.face + 4);
        let xy = if y.0 < x.0 { y } else { x };
        if z.0 < xy.0 {
            z
        } else {
            xy
        }
    }

    /// The cell behind a point of a face, where that is open.
    #[inline]
    fn through(&self, face: u32, p: Vec3) -> Option<usize> {
        let side = face - self.face;
        self.openings.iter().find(|w| w.side == side && w.holds(p)).map(|w| w.to)
    }

    /// Distance of a point inside from the walls, floor and ceiling; in front of an opening from its rim, m.
    fn wall_distance(&self, p: Vec3) -> f32 {
        let sides = [p.x - self.low.x, self.high.x - p.x, p.y - self.low.y, self.high.y - p.y];
        let upright = sides.into_iter().enumerate().map(|(side, plane)| {
            let facing = self.openings.iter().filter(|w| w.side == side as u32);
            let rim = facing.filter_map(|w| {
                let across =
                    if side < 2 { (p.y - w.low.y).min(w.high.y - p.y) } else { (p.x - w.low.x).min(w.high.x - p.x) };
                let inside = across.min(w.high.z - p.z).min(p.z - w.low.z);
                (inside > 0.0).then(|| plane.max(0.0).hypot(inside))
            });
            rim.reduce(f32::max).unwrap_or(plane)
        });
        upright.fold((p.z - self.low.z).min(self.high.z - p.z), f32::min)
    }
}

impl Room {
    /// The cell that a point is in, or the first where it is in none.
    pub fn cell_of(&self, p: Vec3) -> usize {
        self.cells.iter().position(|c| c.contains(p)).unwrap_or(0)
    }

    /// The distance at which a ray from inside a cell meets a wall, a floor or a ceiling, and the face.
    #[inline]
    pub fn shell(&self, cell: usize, o: Vec3, d: Vec3) -> (f32, u32) {
        let mut cell = &self.cells[cell];
        let mut met = cell.exit(o, d);
        for _ in 0..PASSED_MAX {
            if cell.openings.is_empty() {
                break;
            }
            let Some(next) = cell.through(met.1, o + d * met.0) else { break };
            cell = &self.cells[next];
            met = cell.exit(o, d);
        }
        met
    }

    /// Whether a solid or a wall stands between `o` in a cell and the point `reach` along the unit ray.
    pub fn blocked(&self, cell: usize, o: Vec3, d: Vec3, reach: f32) -> bool {
        let mut best = (reach, NOTHING);
        let mut meets = |s: &Solid| {
            if s.may_meet(o, d, reach) {
                s.meet(o, d, &mut best);
            }
            best.1 != NOTHING
        };
        if self.loose().iter().any(&mut meets) {
            return true;
        }
        if self.cells.len() == 1 {
            return false;
        }
        let mut cell = &self.cells[cell];
        for _ in 0..PASSED_MAX {
            if self.solids[cell.solids.clone()].iter().any(&mut meets) {
                return true;
            }
            let (t, face) = cell.exit(o, d);
            if t >= reach {
                return false;
            }
            let Some(next) = cell.through(face, o + d * t) else { return true };
            cell = &self.cells[next];
        }
        true
    }

    /// The solids that are in no cell's list: those of a room of one cell, and those that move.
    pub fn loose(&self) -> &[Solid] {
        &self.solids[self.loose_from()..]
    }

    fn loose_from(&self) -> usize {
        self.cells.last().map_or(0, |c| c.solids.end)
    }

    /// Calls `see` with the solids of all cells that an eye within `slack` of `o` in a cell may see.
    pub fn visible(&self, cell: usize, o: Vec3, slack: f32, mut see: impl FnMut(usize, &Solid)) {
        let mut cells = 0;
        self.look(&[cell, cell], 0, (o.truncate(), slack), None, &mut cells);
        let seen =
            self.cells.iter().enumerate().filter(|(k, _)| cells >> k & 1 == 1).flat_map(|(_, c)| c.solids.clone());
        seen.chain(self.loose_from()..self.solids.len()).for_each(|k| see(k, &self.solids[k]));
    }

    /// Marks a cell, which is behind `passed` openings, and those behind it, as seen by an eye between the directions right and
    /// left of `window`.
    fn look(
        &self,
        [from, cell]: &[usize; 2],
        passed: usize,
        eye: (Vec2, f32),
        window: Option<(Vec2, Vec2)>,
        seen: &mut u64,
    ) {
        *seen |= 1 << cell;
        for w in self.cells[*cell].openings.iter().filter(|w| w.to != *from && passed < PASSED_MAX) {
            // Beyond its first opening all that a ray passes is ahead of that: angles are less than half a turn.
            let narrowed = match (window, w.ends(eye.0, eye.1)) {
                (Some((right, left)), Some((a, b))) => {
                    let right = if right.perp_dot(a) > 0.0 { a } else { right };
                    let left = if b.perp_dot(left) > 0.0 { b } else { left };
                    if right.perp_dot(left) <= 0.0 {
                        continue;
                    }
                    Some((right, left))
                }
                (one, other) => one.or(other),
            };
            self.look(&[*cell, w.to], passed + 1, eye, narrowed, seen);
        }
    }

    /// Distance from a point to the nearest solid or wall; zero or negative inside one.
    pub fn clearance(&self, p: Vec3) -> f32 {
        let wall = self.cells[self.cell_of(p)].wall_distance(p);
        self.solids.iter().map(|s| s.distance(p)).fold(wall, f32::min)
    }
}
