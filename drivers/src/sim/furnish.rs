//! A room around a path: walls, furniture along them, pieces in the middle, lamps.
//!
//! Input is the box of the room, the path that must stay free and a seed. Furniture comes in sets (a shelf, a table with
//! things on it, a sofa, ...) put side by side along the walls and on a coarse grid inside; a set that would come nearer to
//! the path than `KEEP_CLEAR` is left out.

use super::room::{Light, LightMap, Room, Shape, Solid, AMBIENT};
use super::texture::{
    BOOKS, BRICK, CONCRETE, CRATE, DRAWERS, LEAVES, MARBLE, PARQUET, PLAID, PLASTER, POSTER, PRINT, RUG,
};
use glam::{vec3, Vec2, Vec3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Least distance of a solid from the path, m.
pub const KEEP_CLEAR: f32 = 0.55;

/// A set of furniture.
#[derive(Clone, Copy, Debug)]
enum Set {
    Shelf,
    Cabinet,
    Table,
    Sofa,
    Crates,
    Plant,
    Pillar,
    Column,
}

/// The place of a set: its centre on the floor; +y of its own frame points away from the wall.
#[derive(Clone, Copy)]
struct Stand {
    base: Vec3,
    cos: f32,
    sin: f32,
}

impl Stand {
    /// A point of the set's frame.
    fn at(&self, x: f32, y: f32, z: f32) -> Vec3 {
        self.base + vec3(self.cos * x - self.sin * y, self.sin * x + self.cos * y, z)
    }

    fn turned(&self, angle: f32) -> (f32, f32) {
        let (s, c) = angle.sin_cos();
        (self.cos * c - self.sin * s, self.sin * c + self.cos * s)
    }
}

impl Set {
    /// Width along the wall, depth, height, m.
    fn extent(self) -> Vec3 {
        match self {
            Set::Shelf => vec3(1.1, 0.32, 2.02),
            Set::Cabinet => vec3(0.82, 0.46, 1.5),
            Set::Table => vec3(1.5, 0.75, 1.15),
            Set::Sofa => vec3(1.9, 0.85, 0.9),
            Set::Crates => vec3(1.2, 0.9, 1.25),
            Set::Plant => vec3(0.7, 0.7, 1.2),
            Set::Pillar => vec3(0.36, 0.36, 9.0),
            Set::Column => vec3(0.5, 0.5, 1.3),
        }
    }
}

/// Builds, furnishes and lights a room; `path` is sampled densely in world coordinates.
pub fn furnish(low: Vec3, high: Vec3, path: &[Vec3], seed: u64, threads: usize) -> Room {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x526F_6F6D);
    let walls = [BRICK, CONCRETE, PLASTER, PLASTER];
    let mut room = Room::empty(low, high, walls, rng.random());
    fill(&mut room, &Place { cell: 0, low, high }, path, true, &mut rng);
    add_lamps(&mut room, low, high);
    let e = high - low;
    let pitch = 0.1 * (e.x * e.y / 48.0).sqrt().clamp(1.0, 2.5);
    room.light_map = LightMap::bake(&room, AMBIENT, pitch, threads);
    room
}

/// What is furnished: a cell and its box, m.
pub struct Place {
    pub cell: usize,
    pub low: Vec3,
    pub high: Vec3,
}

impl Place {
    /// Whether what is `width` wide along the wall at `foot` would stand before an opening of it.
    fn is_open(&self, room: &Room, foot: Vec2, width: f32) -> bool {
        room.cells[self.cell].openings.iter().any(|w| w.distance(foot) < 0.5 * width + 0.15)
    }
}

/// Furnishes a cell, the middle of which has a rug unless it is a corridor.
pub fn fill(room: &mut Room, place: &Place, path: &[Vec3], rug: bool, rng: &mut ChaCha8Rng) {
    if rug {
        add_rug(room, place, rng);
    }
    along_walls(room, place, path, rng);
    inside(room, place, path, rng);
}

fn add_rug(room: &mut Room, &Place { low, high, .. }: &Place, rng: &mut ChaCha8Rng) {
    let mid = (low + high) * 0.5;
    let half = vec3(0.24 * (high.x - low.x), 0.2 * (high.y - low.y), 0.006);
    let half = half.min(vec3(2.2, 1.6, 1.0));
    room.add_block(mid.with_z(low.z), half, (1.0, 0.0), PLAID, RUG, rng.random());
}

fn along_walls(room: &mut Room, space: &Place, path: &[Vec3], rng: &mut ChaCha8Rng) {
    const ROUND: [Set; 7] = [Set::Shelf, Set::Table, Set::Crates, Set::Cabinet, Set::Sofa, Set::Shelf, Set::Plant];
    let (a, b) = (space.low, space.high);
    // Corner and inward direction of each wall, which runs to the right of that direction.
    let walls = [
        (Vec2::new(a.x, b.y), Vec2::new(1.0, 0.0)),
        (Vec2::new(b.x, a.y), Vec2::new(-1.0, 0.0)),
        (Vec2::new(a.x, a.y), Vec2::new(0.0, 1.0)),
        (Vec2::new(b.x, b.y), Vec2::new(0.0, -1.0)),
    ];
    // Rooms of a building do not begin with the same piece.
    let mut next = space.cell;
    for (corner, inward) in walls {
        let along = Vec2::new(inward.y, -inward.x);
        let length = (along * (b - a).truncate()).length();
        let mut s = rng.random_range(0.55..0.75);
        while s < length - 0.6 {
            let set = ROUND[next % ROUND.len()];
            next += 1;
            let e = set.extent();
            if s + e.x > length - 0.45 {
                break;
            }
            let foot = corner + along * (s + 0.5 * e.x) + inward * (0.5 * e.y + 0.01);
            let wall = corner + along * (s + 0.5 * e.x);
            if !space.is_open(room, wall, e.x) {
                // The set's +y is `inward`.
                let stand = Stand { base: foot.extend(a.z), cos: inward.y, sin: -inward.x };
                place(room, set, stand, path, rng);
                if e.z < 1.6 {
                    hang_picture(room, wall, inward, e.z.max(1.35), rng);
                }
            }
            s += e.x + rng.random_range(0.12..0.4);
        }
        for s in [0.3, length - 0.3] {
            let set = if rng.random_bool(0.5) { Set::Pillar } else { Set::Column };
            let foot = corner + along * s + inward * 0.28;
            if !space.is_open(room, foot, 0.5) {
                place(room, set, Stand { base: foot.extend(a.z), cos: 1.0, sin: 0.0 }, path, rng);
            }
        }
    }
}

fn inside(room: &mut Room, space: &Place, path: &[Vec3], rng: &mut ChaCha8Rng) {
    const ROUND: [Set; 5] = [Set::Crates, Set::Plant, Set::Table, Set::Column, Set::Cabinet];
    const GRID: f32 = 2.4;
    let e = (space.high - space.low).truncate();
    let cells = ((e - 2.6) / GRID).floor().max(Vec2::ZERO);
    let (nx, ny) = (cells.x as usize, cells.y as usize);
    let margin = (e - cells * GRID) * 0.5;
    for k in 0..nx * ny {
        let shift = Vec2::new(rng.random_range(0.3..0.7), rng.random_range(0.3..0.7));
        let at = space.low.truncate() + margin + (Vec2::new((k % nx) as f32, (k / nx) as f32) + shift) * GRID;
        let (sin, cos) = rng.random_range(0.0..std::f32::consts::TAU).sin_cos();
        place(room, ROUND[k % ROUND.len()], Stand { base: at.extend(space.low.z), cos, sin }, path, rng);
    }
}

fn place(room: &mut Room, set: Set, stand: Stand, path: &[Vec3], rng: &mut ChaCha8Rng) {
    let half = set.extent() * 0.5;
    let centre = stand.at(0.0, 0.0, half.z);
    let hull =
        Solid { shape: Shape::Block { half }, centre, cos: stand.cos, sin: stand.sin, face: 0, bound: half.length() };
    if path.iter().any(|p| hull.distance(*p) < KEEP_CLEAR) {
        return;
    }
    match set {
        Set::Shelf => {
            room.add_block(stand.base, half, (stand.cos, stand.sin), BOOKS, CRATE, rng.random());
        }
        Set::Cabinet => cabinet(room, stand, rng),
        Set::Table => table(room, stand, rng),
        Set::Sofa => sofa(room, stand, rng),
        Set::Crates => crates(room, stand, rng),
        Set::Plant => {
            room.add_drum(stand.base, 0.19, 0.42, BRICK, rng.random());
            room.add_drum(stand.at(0.0, 0.0, 0.42), 0.03, 0.2, CRATE, rng.random());
            room.add_ball(stand.at(0.0, 0.0, 0.85), 0.33, LEAVES, rng.random());
        }
        Set::Pillar => {
            let height = room.high.z - room.low.z;
            room.add_drum(stand.base, 0.16, height, MARBLE, rng.random());
        }
        Set::Column => {
            room.add_block(stand.base, vec3(0.2, 0.2, 0.45), (stand.cos, stand.sin), MARBLE, MARBLE, rng.random());
            room.add_ball(stand.at(0.0, 0.0, 1.08), 0.18, MARBLE, rng.random());
        }
    }
}

fn cabinet(room: &mut Room, stand: Stand, rng: &mut ChaCha8Rng) {
    let turn = (stand.cos, stand.sin);
    room.add_block(stand.base, vec3(0.4, 0.22, 0.54), turn, DRAWERS, CRATE, rng.random());
    room.add_ball(stand.at(-0.2, 0.0, 1.08 + 0.15), 0.15, MARBLE, rng.random());
    let turn = stand.turned(rng.random_range(-0.5..0.5));
    room.add_block(stand.at(0.18, 0.0, 1.08), vec3(0.13, 0.1, 0.14), turn, PRINT, PRINT, rng.random());
}

fn table(room: &mut Room, stand: Stand, rng: &mut ChaCha8Rng) {
    let turn = (stand.cos, stand.sin);
    const HEIGHT: f32 = 0.72;
    for (x, y) in [(-0.66, -0.3), (0.66, -0.3), (-0.66, 0.3), (0.66, 0.3)] {
        room.add_block(stand.at(x, y, 0.0), vec3(0.03, 0.03, 0.5 * HEIGHT), turn, PARQUET, PARQUET, rng.random());
    }
    room.add_block(stand.at(0.0, 0.0, HEIGHT), vec3(0.74, 0.36, 0.02), turn, PARQUET, PARQUET, rng.random());
    let top = HEIGHT + 0.04;
    for x in [-0.5, -0.1, 0.35] {
        let turn = stand.turned(rng.random_range(-0.6..0.6));
        let y = rng.random_range(-0.12..0.12);
        match rng.random_range(0..4) {
            0 => room.add_ball(stand.at(x, y, top + 0.12), 0.12, PLAID, rng.random()),
            1 => room.add_drum(stand.at(x, y, top), 0.08, 0.24, MARBLE, rng.random()),
            2 => room.add_block(stand.at(x, y, top), vec3(0.15, 0.11, 0.03), turn, BOOKS, PRINT, rng.random()),
            _ => room.add_block(stand.at(x, y, top), vec3(0.13, 0.12, 0.15), turn, PRINT, POSTER, rng.random()),
        }
    }
}

fn sofa(room: &mut Room, stand: Stand, rng: &mut ChaCha8Rng) {
    let turn = (stand.cos, stand.sin);
    let cloth = PLAID;
    let seed = rng.random();
    room.add_block(stand.at(0.0, 0.06, 0.06), vec3(0.72, 0.34, 0.18), turn, cloth, cloth, seed);
    room.add_block(stand.at(0.0, -0.34, 0.06), vec3(0.72, 0.07, 0.4), turn, cloth, cloth, seed);
    room.add_block(stand.at(-0.83, 0.0, 0.0), vec3(0.1, 0.41, 0.3), turn, cloth, cloth, seed);
    room.add_block(stand.at(0.83, 0.0, 0.0), vec3(0.1, 0.41, 0.3), turn, cloth, cloth, seed);
    for x in [-0.4, 0.35] {
        let turn = stand.turned(rng.random_range(-0.7..0.7));
        room.add_block(stand.at(x, 0.0, 0.42), vec3(0.17, 0.07, 0.15), turn, RUG, RUG, rng.random());
    }
}

fn crates(room: &mut Room, stand: Stand, rng: &mut ChaCha8Rng) {
    let mut add = |x: f32, y: f32, z: f32, half: Vec3| {
        let turn = stand.turned(rng.random_range(-0.3..0.3));
        room.add_block(stand.at(x, y, z), half, turn, CRATE, CRATE, rng.random());
    };
    add(-0.3, -0.02, 0.0, Vec3::splat(0.26));
    add(0.3, 0.04, 0.0, vec3(0.23, 0.25, 0.2));
    add(-0.2, 0.0, 0.52, vec3(0.2, 0.18, 0.17));
    add(0.32, 0.02, 0.4, vec3(0.15, 0.15, 0.12));
}

/// A framed picture on the wall above `bottom`.
fn hang_picture(room: &mut Room, at: Vec2, inward: Vec2, bottom: f32, rng: &mut ChaCha8Rng) {
    let half = vec3(rng.random_range(0.3..0.55), 0.015, rng.random_range(0.24..0.42));
    let z = room.low.z + bottom + 0.12 + rng.random_range(0.0..0.15);
    if z + 2.0 * half.z > room.high.z - 0.1 {
        return;
    }
    let base = (at + inward * half.y).extend(z);
    room.add_block(base, half, (inward.y, -inward.x), POSTER, CRATE, rng.random());
}

/// Lamps under the ceiling, one for about every 12 m².
pub fn add_lamps(room: &mut Room, low: Vec3, high: Vec3) {
    const SPACING: f32 = 4.0;
    let e = (high - low).truncate();
    let n = (e / SPACING).round().max(Vec2::ONE);
    for k in 0..(n.x * n.y) as usize {
        let cell = Vec2::new((k % n.x as usize) as f32 + 0.45, (k / n.x as usize) as f32 + 0.55);
        let at = (low.truncate() + e * cell / n).extend(high.z - 0.5);
        let power = if k % 2 == 0 { 2.4 } else { 1.7 };
        room.lights.push(Light { at, power });
    }
}
