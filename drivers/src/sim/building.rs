//! The building of a patrol: a cell for each room of the plan and for each doorway, furnished and lit twice.
//!
//! Input is the plan, the path that must stay free and a seed. Every room has patterns of its own, and so has every part of a
//! corridor. In the second light other lamps burn, fewer and lower, and less comes from everywhere: no gain turns one into the
//! other.

use super::furnish::{self, Place};
use super::patrol::{Door, Plan, DOOR};
use super::room::{Light, LightMap, Opening, Room, AMBIENT, CELLS_MAX};
use super::texture::{Material, BRICK, CEILING_TILE, CONCRETE, CRATE, MARBLE, PARQUET, PLAID, PLASTER};
use glam::{Vec2, Vec3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

const WALLS: [[Material; 2]; 7] = [
    [BRICK, PLASTER],
    [CONCRETE, MARBLE],
    [PLASTER, PLAID],
    [MARBLE, BRICK],
    [CRATE, PLASTER],
    [CONCRETE, BRICK],
    [PLASTER, MARBLE],
];
const FLOORS: [Material; 5] = [PARQUET, CONCRETE, PLAID, MARBLE, CRATE];
const CEILINGS: [Material; 3] = [CEILING_TILE, CONCRETE, PLASTER];
/// Spacing of the nodes of the light, m.
const LIGHT_PITCH: f32 = 0.22;
/// Light of the second round: what comes from everywhere, of the first's, a ratio; power of its lamps and their height, m.
const EVENING: f32 = 0.45;
const EVENING_POWER: f32 = 1.9;
const EVENING_HEIGHT: f32 = 1.9;

/// Builds, furnishes and lights a building; `path` is sampled densely in world coordinates.
pub fn build(plan: &Plan, path: &[Vec3], seed: u64, threads: usize) -> Room {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x4275_696C);
    let (low, high) = plan
        .rooms
        .iter()
        .fold((Vec3::MAX, Vec3::MIN), |(low, high), r| (low.min(r.low.as_vec3()), high.max(r.high.as_vec3())));
    let mut room = Room::empty(low, high, [PLASTER; 4], 0);
    (room.cells.clear(), room.faces.clear());
    let shift = rng.random_range(0..WALLS.len());
    for (k, r) in plan.rooms.iter().enumerate() {
        let ([a, b], k) = (WALLS[(k + shift) % WALLS.len()], k + shift);
        let materials = [a, b, b, a, FLOORS[k % FLOORS.len()], CEILINGS[k % CEILINGS.len()]];
        room.add_cell(r.low.as_vec3(), r.high.as_vec3(), materials, rng.random());
    }
    plan.doors.iter().for_each(|door| open(&mut room, plan, door, rng.random()));
    assert!(room.cells.len() <= CELLS_MAX, "a set of cells is a word");
    for (k, r) in plan.rooms.iter().enumerate() {
        let first = room.solids.len();
        let place = Place { cell: k, low: r.low.as_vec3(), high: r.high.as_vec3() };
        furnish::fill(&mut room, &place, path, !r.corridor, &mut rng);
        room.cells[k].solids = first..room.solids.len();
    }
    let end = room.solids.len();
    room.cells[plan.rooms.len()..].iter_mut().for_each(|doorway| doorway.solids = end..end);
    plan.rooms.iter().for_each(|r| furnish::add_lamps(&mut room, r.low.as_vec3(), r.high.as_vec3()));
    room.light_map = LightMap::bake(&room, AMBIENT, LIGHT_PITCH, threads);
    room.lights = plan.rooms.iter().map(|r| evening(r.low.as_vec3(), r.high.as_vec3(), &mut rng)).collect();
    room.later = Some(LightMap::bake(&room, EVENING * AMBIENT, LIGHT_PITCH, threads));
    room
}

/// The one lamp of a room in the evening: low, and near one of its corners.
fn evening(low: Vec3, high: Vec3, rng: &mut ChaCha8Rng) -> Light {
    let share = Vec2::new(rng.random_range(0.15..0.3), rng.random_range(0.15..0.3));
    let share = Vec2::select(glam::BVec2::new(rng.random(), rng.random()), share, 1.0 - share);
    let at = low.truncate() + share * (high - low).truncate();
    let size = (high - low).truncate();
    // As bright in a hall as in a chamber.
    let power = EVENING_POWER * (size.x * size.y / 30.0).sqrt().clamp(1.0, 2.0);
    Light { at: at.extend(low.z + EVENING_HEIGHT), power }
}

/// Opens the wall between two cells: by a doorway as deep as the wall, or, where they touch, from wall to wall.
fn open(room: &mut Room, plan: &Plan, door: &Door, seed: u32) {
    let (axis, [below, above]) = door.wall(plan.rooms);
    let (near, far) = (room.cells[below].high[axis], room.cells[above].low[axis]);
    let side = 2 * axis as u32;
    let (mut low, mut high) = (room.cells[below].low, room.cells[below].high);
    if far - near < 1e-4 {
        // The narrower of the two.
        (low, high) = (low.max(room.cells[above].low), high.min(room.cells[above].high));
        (low[axis], high[axis]) = (near, near);
        room.cells[below].openings.push(Opening { side: side + 1, low, high, to: above });
        room.cells[above].openings.push(Opening { side, low, high, to: below });
        return;
    }
    let across = 1 - axis;
    let half = 0.5 * DOOR.x as f32;
    (low[across], high[across]) = (door.at as f32 - half, door.at as f32 + half);
    high.z = low.z + DOOR.y as f32;
    let plane = |at: f32| {
        let (mut low, mut high) = (low, high);
        (low[axis], high[axis]) = (at, at);
        (low, high)
    };
    let doorway = room.cells.len();
    let jamb = [CRATE, CRATE, CRATE, CRATE, CONCRETE, CRATE];
    let mut corners = (low, high);
    (corners.0[axis], corners.1[axis]) = (near, far);
    room.add_cell(corners.0, corners.1, jamb, seed);
    for (cell, side, at, to) in [
        (below, side + 1, near, doorway),
        (above, side, far, doorway),
        (doorway, side, near, below),
        (doorway, side + 1, far, above),
    ] {
        let (low, high) = plane(at);
        room.cells[cell].openings.push(Opening { side, low, high, to });
    }
}
