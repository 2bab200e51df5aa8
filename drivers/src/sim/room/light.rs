//! Baked light: irradiance on a grid of nodes over every face, bilinear between nodes.
//!
//! The room does not change, so lamps (Lambert, inverse square, soft shadows) and the ambient term (occluded in corners and
//! under furniture) are computed once; a pixel then costs one look-up.

use super::{Face, Light, Room, Solid};
use glam::{Vec2, Vec3};
use std::thread::Builder;

/// The irradiance of all faces.
#[derive(Clone, Debug, Default)]
pub struct LightMap {
    grids: Vec<Grid>,
    nodes: Vec<f32>,
}

#[derive(Clone, Copy, Debug)]
struct Grid {
    first: usize,
    columns: usize,
    rows: usize,
    /// Nodes per metre along u and v.
    density: Vec2,
}

/// Ambient light of a point whose whole hemisphere is open.
pub const AMBIENT: f32 = 0.6;
/// Surfaces nearer than this block ambient light, m.
const AMBIENT_REACH: f32 = 0.9;
const AMBIENT_RAYS: usize = 24;
/// Side of the square lamps, m: the width of penumbrae.
const LAMP: f32 = 0.35;
/// Keeps the spot above a lamp from outshining the room, m².
const SOFTEN: f32 = 0.8;
/// Light below which a lamp is not worth its shadow rays.
const FAINT: f32 = 0.02;

impl LightMap {
    /// Computes the light of a room's lamps, and so much ambient light, at nodes every `pitch` metres, two a side at least.
    pub fn bake(room: &Room, ambient: f32, pitch: f32, threads: usize) -> LightMap {
        let mut grids = Vec::with_capacity(room.faces.len());
        let mut first = 0;
        for face in &room.faces {
            let cells = (face.size / pitch).ceil().max(Vec2::ONE);
            let (columns, rows) = (cells.x as usize + 1, cells.y as usize + 1);
            grids.push(Grid { first, columns, rows, density: cells / face.size });
            first += columns * rows;
        }
        let mut nodes = vec![0.0; first];
        let share = first.div_ceil(threads.max(1)).max(1);
        std::thread::scope(|scope| {
            for (k, out) in nodes.chunks_mut(share).enumerate() {
                let grids = &grids;
                let bake = move || {
                    let mut near = Vec::with_capacity(room.solids.len());
                    for (i, node) in out.iter_mut().enumerate() {
                        let i = k * share + i;
                        let f = grids.partition_point(|g| g.first <= i) - 1;
                        let (g, i) = (&grids[f], i - grids[f].first);
                        let at = Vec2::new((i % g.columns) as f32, (i / g.columns) as f32) / g.density;
                        *node = irradiance(room, &room.faces[f], at, ambient, &mut near);
                    }
                };
                Builder::new().name("light".into()).spawn_scoped(scope, bake).expect("the system starts a few threads");
            }
        });
        LightMap { grids, nodes }
    }

    /// Adds the next face, evenly lit.
    pub fn add_even(&mut self, irradiance: f32) {
        self.grids.push(Grid { first: self.nodes.len(), columns: 2, rows: 2, density: Vec2::ONE });
        self.nodes.extend([irradiance; 4]);
    }

    /// Lights a face like another of its size.
    pub fn share(&mut self, face: usize, as_face: usize) {
        self.grids[face] = self.grids[as_face];
    }

    /// The irradiance at a surface coordinate of a face, m.
    #[inline]
    pub fn at(&self, face: usize, at: Vec2) -> f32 {
        let g = &self.grids[face];
        let x = (at.x * g.density.x).clamp(0.0, (g.columns - 1) as f32 - 1e-3);
        let y = (at.y * g.density.y).clamp(0.0, (g.rows - 1) as f32 - 1e-3);
        let (i, j) = (x as usize, y as usize);
        let (a, b) = (x - i as f32, y - j as f32);
        let k = g.first + j * g.columns + i;
        let n = &self.nodes;
        let low = n[k] + a * (n[k + 1] - n[k]);
        let high = n[k + g.columns] + a * (n[k + g.columns + 1] - n[k + g.columns]);
        low + b * (high - low)
    }
}

/// The irradiance of one node; `near` is scratch.
fn irradiance(room: &Room, face: &Face, at: Vec2, full: f32, near: &mut Vec<Solid>) -> f32 {
    // Nodes on an edge are pulled in, so that they see what the face sees.
    let margin = face.size.min_element() * 0.02;
    let at = at.clamp(Vec2::splat(margin), face.size - margin);
    let (p, n) = face.point(at);
    let p = p + n * 2e-3;
    let cell = room.cell_of(p);
    let lamps: f32 = room.lights.iter().map(|l| lamp(room, l, cell, p, n)).sum();
    near.clear();
    near.extend(room.solids.iter().filter(|s| s.centre.distance(p) < s.bound + AMBIENT_REACH));
    lamps + ambient(room, near, cell, (p, n), full)
}

fn lamp(room: &Room, light: &Light, cell: usize, p: Vec3, n: Vec3) -> f32 {
    let to = light.at - p;
    let full = light.power * n.dot(to).max(0.0) / (to.length() * (to.length_squared() + SOFTEN));
    if full < FAINT {
        return full;
    }
    let mut seen = 0.0;
    for k in 0..4 {
        let corner = Vec3::new((k & 1) as f32 - 0.5, (k >> 1) as f32 - 0.5, 0.0) * LAMP;
        let to = light.at + corner - p;
        let reach = to.length();
        if !room.blocked(cell, p, to / reach, reach) {
            seen += 0.25;
        }
    }
    full * seen
}

/// The ambient light of a point; `full` is that of one whose whole hemisphere is open.
fn ambient(room: &Room, near: &[Solid], cell: usize, (p, n): (Vec3, Vec3), full: f32) -> f32 {
    let (u, v) = n.any_orthonormal_pair();
    let mut open = 0.0;
    for k in 0..AMBIENT_RAYS {
        // A cosine-weighted spiral.
        let r = ((k as f32 + 0.5) / AMBIENT_RAYS as f32).sqrt();
        let (sin, cos) = (k as f32 * 2.399_963).sin_cos();
        let d = u * (r * cos) + v * (r * sin) + n * (1.0 - r * r).sqrt();
        let mut first = room.shell(cell, p, d);
        for s in near {
            s.meet(p, d, &mut first);
        }
        open += (first.0 / AMBIENT_REACH).min(1.0);
    }
    full * open / AMBIENT_RAYS as f32
}
