//! The building of a patrol: a cell for each room of the plan and for each doorway, furnished and lit twice.
//!
//! Input is the plan, the path that must stay free and a seed. Every room has patterns of its own, and so has every part of a
//! corridor, except where the plan says that a place looks like another: it has the other's patterns, furniture and light. In
//! the second light other lamps burn, fewer and lower, and less comes from everywhere: no gain turns one into the other.

use super::furnish::{self, Place};
use super::patrol::{Door, Plan, DOOR};
use super::room::{Face, Light, LightMap, Opening, Room, AMBIENT, CELLS_MAX};
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
    room.cells.clear();
    room.faces.clear();
    let shift = rng.random_range(0..WALLS.len());
    for (k, r) in plan.rooms.iter().enumerate() {
        let ([a, b], k) = (WALLS[(k + shift) % WALLS.len()], k + shift);
        let materials = [a, b, b, a, FLOORS[k % FLOORS.len()], CEILINGS[k % CEILINGS.len()]];
        room.add_cell(r.low.as_vec3(), r.high.as_vec3(), materials, rng.random());
    }
    let ways: Vec<Option<usize>> = plan.doors.iter().map(|door| open(&mut room, plan, door, rng.random())).collect();
    let alike = alike(plan, &ways);
    for &[cell, first] in &alike {
        let [to, from] = [cell, first].map(|c| room.cells[c].face as usize);
        for k in 0..6 {
            room.faces[to + k] = Face { chart: room.faces[to + k].chart, ..room.faces[from + k] };
        }
    }
    assert!(room.cells.len() <= CELLS_MAX, "a set of cells is a word");
    for (k, r) in plan.rooms.iter().enumerate().filter(|(k, _)| plan.like(*k) == *k) {
        let first = room.solids.len();
        let place = Place { cell: k, low: r.low.as_vec3(), high: r.high.as_vec3() };
        let free = free_in_all(plan, k, path);
        furnish::fill(&mut room, &place, &free, !r.corridor, &mut rng);
        room.cells[k].solids = first..room.solids.len();
    }
    for &[cell, first] in alike.iter().filter(|a| a[0] < plan.rooms.len()) {
        room.furnish_alike(cell, first);
    }
    let end = room.solids.len();
    room.cells[plan.rooms.len()..].iter_mut().for_each(|doorway| doorway.solids = end..end);
    plan.rooms.iter().for_each(|r| furnish::add_lamps(&mut room, r.low.as_vec3(), r.high.as_vec3()));
    room.light_map = LightMap::bake(&room, AMBIENT, LIGHT_PITCH, threads);
    for &[cell, first] in &alike {
        room.light_alike(cell, first);
    }
    if plan.varied {
        room.lights = plan.rooms.iter().map(|r| evening(r.low.as_vec3(), r.high.as_vec3(), &mut rng)).collect();
        room.later = Some(LightMap::bake(&room, EVENING * AMBIENT, LIGHT_PITCH, threads));
    }
    room
}

/// The cells that look like another, each with that one: rooms, and their doorways, which are in `ways`, one for each door.
fn alike(plan: &Plan, ways: &[Option<usize>]) -> Vec<[usize; 2]> {
    let rooms = (0..plan.rooms.len()).map(|k| [k, plan.like(k)]);
    let doorways = plan.doors.iter().zip(ways).filter_map(|(door, way)| {
        let first = plan.doors.iter().position(|d| d.rooms[0] == plan.like(door.rooms[0]))?;
        (plan.like(door.rooms[0]) != door.rooms[0]).then_some([(*way)?, ways[first]?])
    });
    rooms.chain(doorways).filter(|[cell, first]| cell != first).collect()
}

/// The path, and those of its points that are in or near a room that looks like room `k`, moved to the same place in `k`.
fn free_in_all(plan: &Plan, k: usize, path: &[Vec3]) -> Vec<Vec3> {
    let mut free = path.to_vec();
    for (_, r) in plan.rooms.iter().enumerate().filter(|(j, _)| *j != k && plan.like(*j) == k) {
        let (low, high) = (r.low.as_vec3() - furnish::KEEP_CLEAR, r.high.as_vec3() + furnish::KEEP_CLEAR);
        let by = (plan.rooms[k].low - r.low).as_vec3();
        free.extend(path.iter().filter(|p| p.cmpge(low).all() && p.cmple(high).all()).map(|p| *p + by));
    }
    free
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

/// Opens the wall between two cells: by a doorway as deep as the wall, or, where they touch, from wall to wall. Returns the
/// cell of the doorway.
fn open(room: &mut Room, plan: &Plan, door: &Door, seed: u32) -> Option<usize> {
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
        return None;
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
    Some(doorway)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::patrol::{Extent, Route};
    use super::super::texture::{albedo, Spot};
    use super::*;
    use glam::{vec3, DVec3};

    fn built(extent: Extent, seed: u64) -> (&'static Plan, Room) {
        let plan = extent.plan();
        let path: Vec<Vec3> = Route::new(plan).places().map(|p| p.as_vec3()).collect();
        (plan, build(plan, &path, seed, 2))
    }

    /// Whether a point is between the walls of a room or of a doorway, by the plan alone.
    fn is_free(plan: &Plan, p: Vec3) -> bool {
        let within =
            |low: DVec3, high: DVec3| p.cmpge(low.as_vec3() - 1e-3).all() && p.cmple(high.as_vec3() + 1e-3).all();
        let doorway = |door: &Door| {
            let (axis, [below, above]) = door.wall(plan.rooms);
            let (mut low, mut high) = (DVec3::ZERO, DVec3::splat(DOOR.y));
            (low[axis], high[axis]) = (plan.rooms[below].high[axis], plan.rooms[above].low[axis]);
            (low[1 - axis], high[1 - axis]) = (door.at - 0.5 * DOOR.x, door.at + 0.5 * DOOR.x);
            within(low, high)
        };
        plan.rooms.iter().any(|r| within(r.low, r.high)) || plan.doors.iter().any(doorway)
    }

    #[test]
    fn a_ray_leaves_a_room_through_a_doorway_alone() {
        for extent in [Extent::Two, Extent::Whole, Extent::Twins, Extent::Doors] {
            let (plan, room) = built(extent, 3);
            let mut rng = ChaCha8Rng::seed_from_u64(5);
            let mut left = 0;
            for r in plan.rooms.iter().cycle().take(4000) {
                let mut between = |low: f32, high: f32| rng.random_range(low + 0.05..high - 0.05);
                let (low, high) = (r.low.as_vec3(), r.high.as_vec3());
                let o = vec3(between(low.x, high.x), between(low.y, high.y), between(low.z, high.z));
                let d = vec3(between(-1.1, 1.1), between(-1.1, 1.1), between(-0.3, 0.3)).normalize();
                if room.clearance(o) <= 0.0 {
                    continue;
                }
                let (reach, face) = room.nearest(o, d);
                assert!(room.faces[face as usize].place(o + d * reach).normal.dot(d) < 0.0, "a back is seen");
                let steps = (reach / 0.02) as usize;
                let seen = (0..=steps).map(|k| o + d * (reach * k as f32 / steps.max(1) as f32));
                for p in seen {
                    assert!(is_free(plan, p), "{}: from {o} along {d}: {p} is in a wall", r.name);
                }
                left += usize::from(!r.contains((o + d * reach).as_dvec3()));
                assert!(!room.blocked(room.cell_of(o), o, d, reach - 0.01), "from {o} along {d}");
                assert!(room.blocked(room.cell_of(o), o, d, reach + 0.01), "from {o} along {d}");
            }
            assert!(left > 50, "{left} rays left their room");
        }
    }

    #[test]
    fn walls_of_different_rooms_do_not_look_alike() {
        for extent in [Extent::Whole, Extent::Twins, Extent::Doors] {
            let (plan, room) = built(extent, 1);
            // Levels of each room's four walls at the same places.
            let n = 300;
            let levels = |wall: usize| -> Vec<f32> {
                let face = &room.faces[wall];
                let spot = |k: i32| {
                    let at = Vec2::new((k % 25) as f32 * 0.09 + 0.2, (k / 25) as f32 * 0.2 + 0.2);
                    albedo(face.material, face.seed, Spot { at, footprint: Vec2::splat(0.02), size: face.size })
                };
                let levels: Vec<f32> = (0..n).map(spot).collect();
                let mean = levels.iter().sum::<f32>() / n as f32;
                levels.into_iter().map(|v| v - mean).collect()
            };
            let walls: Vec<(usize, Vec<f32>)> = (0..plan.rooms.len())
                .flat_map(|k| (0..4).map(move |w| (k, 6 * k + w)))
                .map(|(k, w)| (k, levels(w)))
                .collect();
            let norm = |v: &[f32]| v.iter().map(|v| v * v).sum::<f32>().sqrt();
            for (i, (a, x)) in walls.iter().enumerate() {
                for (b, y) in walls[..i].iter().filter(|(b, _)| plan.like(*a) != plan.like(*b)) {
                    let alike = x.iter().zip(y).map(|(x, y)| x * y).sum::<f32>() / (norm(x) * norm(y));
                    assert!(alike < 0.7, "{} and {}: {alike}", plan.rooms[*a].name, plan.rooms[*b].name);
                }
            }
        }
    }

    #[test]
    fn the_light_of_the_second_round_is_dimmer_and_no_multiple_of_the_first() {
        let (plan, mut room) = built(Extent::Whole, 1);
        for (k, r) in plan.rooms.iter().enumerate() {
            let mut ratios = vec![];
            for face in 6 * k..6 * k + 6 {
                for i in 0..100 {
                    let at = room.faces[face].size * Vec2::new((i % 10) as f32 + 0.5, (i / 10) as f32 + 0.5) / 10.0;
                    let lit = [0.0, 1.0].map(|late| {
                        room.late = late;
                        room.light(face, at)
                    });
                    ratios.push((lit[1] / lit[0].max(1e-3)).max(1e-3).ln());
                }
            }
            let n = ratios.len() as f32;
            let mean = ratios.iter().sum::<f32>() / n;
            let spread = (ratios.iter().map(|r| (r - mean) * (r - mean)).sum::<f32>() / n).sqrt();
            println!("{}: {:.2} of the light, spread {spread:.2}", r.name, mean.exp());
            assert!(mean < -0.2 && spread > 0.15, "{}: {mean} {spread}", r.name);
        }
    }
}
