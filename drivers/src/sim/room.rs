//! The room: solids with analytic ray intersection, faces that carry material and light.
//!
//! A `Room` is a box seen from inside, or several that are joined (`room/cells.rs`), and solids in it: blocks (boxes turned about z), balls and drums (upright
//! cylinders). `nearest` finds the face that a ray meets first, exactly. Furniture is in `furnish.rs`, baked light in
//! `room/light.rs`, surface patterns in `texture.rs`. World frame: z up, metres, f32 (1e-7 of a metre is finer than any sensor
//! here).

mod cells;
mod light;

pub use cells::{Cell, Opening, CELLS_MAX};
pub use light::{LightMap, AMBIENT};

use super::texture::{Material, CEILING_TILE, PARQUET};
use glam::{Vec2, Vec3};

/// No face: the ray left the room (only rays outside the lens' domain do).
pub const NOTHING: u32 = u32::MAX;

/// The shape of a solid, m.
#[derive(Clone, Copy, Debug)]
pub enum Shape {
    Block { half: Vec3 },
    Ball { radius: f32 },
    Drum { radius: f32, half_height: f32 },
}

/// A piece of furniture, or a part of one.
#[derive(Clone, Copy, Debug)]
pub struct Solid {
    /// Shape in the solid's own frame.
    pub shape: Shape,
    /// Centre in the world frame, m.
    pub centre: Vec3,
    /// Cosine of the rotation about z, a ratio.
    pub cos: f32,
    /// Sine of the rotation about z, a ratio.
    pub sin: f32,
    /// Index of its first face; a block has six, a ball one, a drum three: side, top, bottom.
    pub face: u32,
    /// Radius of the bounding sphere, m.
    pub bound: f32,
}

/// The map from points of a face to surface coordinates. The `origin` of a flat one is the corner where u = v = 0.
#[derive(Clone, Copy, Debug)]
pub enum Chart {
    Flat { origin: Vec3, u: Vec3, v: Vec3 },
    Ball { centre: Vec3, radius: f32 },
    Drum { base: Vec3, radius: f32 },
}

/// A surface with its material.
#[derive(Clone, Copy, Debug)]
pub struct Face {
    /// Where it lies, and its surface coordinates.
    pub chart: Chart,
    /// Extent along u and v, m.
    pub size: Vec2,
    /// Pattern of the surface.
    pub material: Material,
    /// Seed of the pattern.
    pub seed: u32,
}

/// Surface coordinate, m, outward normal and tangents at a point.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    /// Surface coordinate, m.
    pub at: Vec2,
    /// Outward unit normal.
    pub normal: Vec3,
    /// Tangent along the first coordinate.
    pub u: Vec3,
    /// Tangent along the second coordinate.
    pub v: Vec3,
}

/// A lamp.
#[derive(Clone, Copy, Debug)]
pub struct Light {
    /// Place in the world frame, m.
    pub at: Vec3,
    /// Radiant intensity, in units in which 1 at 1 m lights a white surface fully.
    pub power: f32,
}

/// Boxes seen from inside, their furniture and their light.
pub struct Room {
    /// Corner of least coordinates, m.
    pub low: Vec3,
    /// Corner of largest coordinates, m.
    pub high: Vec3,
    /// One, or those of a building.
    pub cells: Vec<Cell>,
    /// Furniture: that of each cell, then what is in no cell's list.
    pub solids: Vec<Solid>,
    /// The first six are the first cell's: -x, +x, -y, +y, floor, ceiling.
    pub faces: Vec<Face>,
    /// Lamps.
    pub lights: Vec<Light>,
    /// Light of the lamps on every face.
    pub light_map: LightMap,
    /// Light of other lamps, where it changes.
    pub later: Option<LightMap>,
    /// Share of the other light, 0 to 1, a ratio.
    pub late: f32,
}

impl Room {
    /// An empty room, dark until `light_map` is baked.
    pub fn empty(low: Vec3, high: Vec3, walls: [Material; 4], seed: u32) -> Room {
        let [w0, w1, w2, w3] = walls;
        let mut room = Room {
            low,
            high,
            cells: Vec::new(),
            solids: Vec::new(),
            faces: Vec::new(),
            lights: Vec::new(),
            light_map: LightMap::default(),
            later: None,
            late: 0.0,
        };
        room.add_cell(low, high, [w0, w1, w2, w3, PARQUET, CEILING_TILE], seed);
        room
    }

    /// Adds a cell without openings and furniture; `materials` of -x, +x, -y, +y, floor and ceiling.
    pub fn add_cell(&mut self, low: Vec3, high: Vec3, materials: [Material; 6], seed: u32) {
        let e = high - low;
        let (x, y, z) = (Vec3::X, Vec3::Y, Vec3::Z);
        let corner = |x: f32, y: f32| Vec3::new(x, y, low.z);
        let (first, at) = (self.faces.len(), self.solids.len());
        let flat = Vec2::new(e.x, e.y);
        let charts = [
            (corner(low.x, low.y), y, z, Vec2::new(e.y, e.z)),
            (corner(high.x, high.y), -y, z, Vec2::new(e.y, e.z)),
            (corner(high.x, low.y), -x, z, Vec2::new(e.x, e.z)),
            (corner(low.x, high.y), x, z, Vec2::new(e.x, e.z)),
            (corner(low.x, low.y), x, y, flat),
            (Vec3::new(low.x, high.y, high.z), x, -y, flat),
        ];
        for (k, ((origin, u, v, size), material)) in charts.into_iter().zip(materials).enumerate() {
            self.faces.push(face(origin, u, v, size, material, seed.wrapping_add(k as u32)));
        }
        self.cells.push(Cell { low, high, face: first as u32, solids: at..at, openings: Vec::new() });
    }

    /// Adds a block standing on `base` (the centre of its underside); `turn` is (cos, sin) about z.
    pub fn add_block(&mut self, base: Vec3, half: Vec3, turn: (f32, f32), side: Material, top: Material, seed: u32) {
        let first = self.faces.len();
        for (k, (chart, size)) in block_charts(base, half, turn).into_iter().enumerate() {
            let material = if k < 4 { side } else { top };
            self.faces.push(Face { chart, size, material, seed: seed.wrapping_add(k as u32) });
        }
        let (shape, centre) = (Shape::Block { half }, base + Vec3::Z * half.z);
        let (cos, sin) = turn;
        self.solids.push(Solid { shape, centre, cos, sin, face: first as u32, bound: half.length() });
    }

    /// Moves a block to stand on `base`, turned as `add_block` has it.
    pub fn move_block(&mut self, solid: usize, base: Vec3, turn: (f32, f32)) {
        let s = &mut self.solids[solid];
        let Shape::Block { half } = s.shape else { return };
        (s.centre, (s.cos, s.sin)) = (base + Vec3::Z * half.z, turn);
        let charts = block_charts(base, half, turn);
        self.faces[s.face as usize..].iter_mut().zip(charts).for_each(|(face, (chart, _))| face.chart = chart);
    }

    /// Adds a ball.
    pub fn add_ball(&mut self, centre: Vec3, radius: f32, material: Material, seed: u32) {
        let pi = std::f32::consts::PI;
        let size = Vec2::new(2.0 * pi, pi) * radius;
        let first = self.faces.len() as u32;
        self.faces.push(Face { chart: Chart::Ball { centre, radius }, size, material, seed });
        let shape = Shape::Ball { radius };
        self.solids.push(Solid { shape, centre, cos: 1.0, sin: 0.0, face: first, bound: radius });
    }

    /// Adds an upright cylinder standing on `base`.
    pub fn add_drum(&mut self, base: Vec3, radius: f32, height: f32, material: Material, seed: u32) {
        let size = Vec2::new(2.0 * std::f32::consts::PI * radius, height);
        let first = self.faces.len() as u32;
        self.faces.push(Face { chart: Chart::Drum { base, radius }, size, material, seed });
        let corner = base - Vec3::new(radius, radius, 0.0);
        let flat = Vec2::splat(2.0 * radius);
        self.faces.push(face(corner + Vec3::Z * height, Vec3::X, Vec3::Y, flat, material, seed.wrapping_add(1)));
        self.faces.push(face(corner + Vec3::Y * flat.y, Vec3::X, -Vec3::Y, flat, material, seed.wrapping_add(2)));
        let half_height = 0.5 * height;
        let bound = radius.hypot(half_height);
        let centre = base + Vec3::Z * half_height;
        let shape = Shape::Drum { radius, half_height };
        self.solids.push(Solid { shape, centre, cos: 1.0, sin: 0.0, face: first, bound });
    }

    /// Furnishes a cell like another, which has its furniture.
    pub fn furnish_alike(&mut self, cell: usize, first: usize) {
        let (by, begin) = (self.cells[cell].low - self.cells[first].low, self.solids.len());
        for k in self.cells[first].solids.clone() {
            let (s, face) = (self.solids[k], self.faces.len() as u32);
            for f in s.faces() {
                let face = self.faces[f];
                self.faces.push(Face { chart: face.chart.moved(by), ..face });
            }
            self.solids.push(Solid { centre: s.centre + by, face, ..s });
        }
        self.cells[cell].solids = begin..self.solids.len();
    }

    /// Lights a cell and its furniture like another cell, which has the same furniture.
    pub fn light_alike(&mut self, cell: usize, first: usize) {
        for (face, as_face) in self.faces_of(cell).zip(self.faces_of(first)).collect::<Vec<_>>() {
            self.light_map.share(face, as_face);
        }
    }

    /// The faces of a cell and of its furniture.
    pub fn faces_of(&self, cell: usize) -> impl Iterator<Item = usize> + '_ {
        let Cell { face, solids, .. } = &self.cells[cell];
        (*face as usize..*face as usize + 6).chain(self.solids[solids.clone()].iter().flat_map(|s| s.faces()))
    }

    /// The first surface along a unit ray: distance and face.
    pub fn nearest(&self, o: Vec3, d: Vec3) -> (f32, u32) {
        let mut best = self.shell(self.cell_of(o), o, d);
        for s in &self.solids {
            if s.may_meet(o, d, best.0) {
                s.meet(o, d, &mut best);
            }
        }
        best
    }

    /// The light at a surface coordinate of a face.
    #[inline]
    pub fn light(&self, face: usize, at: Vec2) -> f32 {
        let now = self.light_map.at(face, at);
        match &self.later {
            Some(later) if self.late > 0.0 => now + self.late * (later.at(face, at) - now),
            _ => now,
        }
    }
}

/// Charts and sizes of a block's faces: ahead, behind, left, right, top, bottom.
fn block_charts(base: Vec3, half: Vec3, (cos, sin): (f32, f32)) -> [(Chart, Vec2); 6] {
    let (ex, ey, size) = (Vec3::new(cos, sin, 0.0), Vec3::new(-sin, cos, 0.0), half * 2.0);
    let wall = |n: Vec3, u: Vec3, reach: f32, width: f32| {
        let origin = base + n * reach - u * (0.5 * width);
        (Chart::Flat { origin, u, v: Vec3::Z }, Vec2::new(width, size.z))
    };
    let corner = base + Vec3::Z * half.z - ex * half.x - ey * half.y;
    let flat = |origin: Vec3, v: Vec3| (Chart::Flat { origin, u: ex, v }, size.truncate());
    [
        wall(ex, ey, half.x, size.y),
        wall(-ex, -ey, half.x, size.y),
        wall(ey, -ex, half.y, size.x),
        wall(-ey, ex, half.y, size.x),
        flat(corner + Vec3::Z * half.z, ey),
        flat(corner + ey * size.y - Vec3::Z * half.z, -ey),
    ]
}

fn face(origin: Vec3, u: Vec3, v: Vec3, size: Vec2, material: Material, seed: u32) -> Face {
    Face { chart: Chart::Flat { origin, u, v }, size, material, seed }
}

impl Chart {
    fn moved(self, by: Vec3) -> Chart {
        match self {
            Chart::Flat { origin, u, v } => Chart::Flat { origin: origin + by, u, v },
            Chart::Ball { centre, radius } => Chart::Ball { centre: centre + by, radius },
            Chart::Drum { base, radius } => Chart::Drum { base: base + by, radius },
        }
    }
}

impl Solid {
    /// Its faces.
    fn faces(&self) -> std::ops::Range<usize> {
        let n = match self.shape {
            Shape::Block { .. } => 6,
            Shape::Ball { .. } => 1,
            Shape::Drum { .. } => 3,
        };
        self.face as usize..self.face as usize + n
    }

    /// Whether a ray meets the bounding sphere: a cheap test.
    #[inline]
    fn may_meet(&self, o: Vec3, d: Vec3, reach: f32) -> bool {
        let c = self.centre - o;
        let along = c.dot(d);
        along > -self.bound
            && along < reach + self.bound
            && c.length_squared() - along * along <= self.bound * self.bound
    }

    /// Replaces `best` if the ray enters this solid sooner. Rays start outside.
    #[inline]
    pub fn meet(&self, o: Vec3, d: Vec3, best: &mut (f32, u32)) {
        match self.shape {
            Shape::Block { half } => self.meet_block(half, o, d, best),
            Shape::Ball { radius } => {
                let c = self.centre - o;
                let along = c.dot(d);
                let q = radius * radius - (c - d * along).length_squared();
                if q > 0.0 {
                    let t = along - q.sqrt();
                    if t > 0.0 && t < best.0 {
                        *best = (t, self.face);
                    }
                }
            }
            Shape::Drum { radius, half_height } => self.meet_drum(radius, half_height, o, d, best),
        }
    }

    #[inline]
    fn meet_block(&self, half: Vec3, o: Vec3, d: Vec3, best: &mut (f32, u32)) {
        let turn = |v: Vec3| Vec3::new(self.cos * v.x + self.sin * v.y, self.cos * v.y - self.sin * v.x, v.z);
        let (o, d) = (turn(o - self.centre), turn(d));
        let inv = Vec3::ONE / d;
        let mid = -o * inv;
        let reach = (half * inv).abs();
        let (near, far) = (mid - reach, mid + reach);
        let t0 = near.x.max(near.y).max(near.z);
        let t1 = far.x.min(far.y).min(far.z);
        if !(t0 < t1 && t0 > 0.0 && t0 < best.0) {
            return;
        }
        let face = if t0 == near.x {
            (d.x > 0.0) as u32
        } else if t0 == near.y {
            2 + (d.y > 0.0) as u32
        } else {
            4 + (d.z > 0.0) as u32
        };
        *best = (t0, self.face + face);
    }

    fn meet_drum(&self, radius: f32, half_height: f32, o: Vec3, d: Vec3, best: &mut (f32, u32)) {
        let o = o - self.centre;
        if d.z.abs() > 1e-9 {
            let cap = if d.z < 0.0 { half_height } else { -half_height };
            let t = (cap - o.z) / d.z;
            let p = (o + d * t).truncate();
            if t > 0.0 && t < best.0 && p.length_squared() < radius * radius {
                *best = (t, self.face + 1 + (d.z > 0.0) as u32);
                return;
            }
        }
        let (p, r) = (o.truncate(), d.truncate());
        let a = r.length_squared();
        if a < 1e-12 {
            return;
        }
        let along = -p.dot(r) / a;
        let q = radius * radius - (p + r * along).length_squared();
        if q > 0.0 {
            let t = along - (q / a).sqrt();
            if t > 0.0 && t < best.0 && (o.z + d.z * t).abs() <= half_height {
                *best = (t, self.face);
            }
        }
    }

    /// Signed distance of a point from the surface, m.
    pub fn distance(&self, p: Vec3) -> f32 {
        let o = p - self.centre;
        match self.shape {
            Shape::Ball { radius } => o.length() - radius,
            Shape::Drum { radius, half_height } => {
                let q = Vec2::new(o.truncate().length() - radius, o.z.abs() - half_height);
                q.max(Vec2::ZERO).length() + q.max_element().min(0.0)
            }
            Shape::Block { half } => {
                let l = Vec3::new(self.cos * o.x + self.sin * o.y, self.cos * o.y - self.sin * o.x, o.z);
                let q = l.abs() - half;
                q.max(Vec3::ZERO).length() + q.max_element().min(0.0)
            }
        }
    }
}

impl Face {
    /// The place of a point on the face.
    #[inline]
    pub fn place(&self, p: Vec3) -> Place {
        match self.chart {
            Chart::Flat { origin, u, v } => {
                let d = p - origin;
                Place { at: Vec2::new(d.dot(u), d.dot(v)), normal: u.cross(v), u, v }
            }
            Chart::Ball { centre, radius } => {
                let n = (p - centre) / radius;
                let ring = n.truncate().length().max(1e-3);
                let u = Vec3::new(-n.y, n.x, 0.0) / ring;
                let longitude = n.y.atan2(n.x) + std::f32::consts::PI;
                let latitude = n.z.clamp(-1.0, 1.0).asin() + std::f32::consts::FRAC_PI_2;
                // The chart is stretched along u towards the poles.
                Place { at: Vec2::new(longitude, latitude) * radius, normal: n, u: u / ring, v: n.cross(u) }
            }
            Chart::Drum { base, radius } => {
                let d = p - base;
                let n = Vec3::new(d.x, d.y, 0.0) / radius;
                let at = Vec2::new((n.y.atan2(n.x) + std::f32::consts::PI) * radius, d.z);
                Place { at, normal: n, u: Vec3::new(-n.y, n.x, 0.0), v: Vec3::Z }
            }
        }
    }

    /// The point at a surface coordinate, and its outward normal.
    pub fn point(&self, at: Vec2) -> (Vec3, Vec3) {
        match self.chart {
            Chart::Flat { origin, u, v } => (origin + u * at.x + v * at.y, u.cross(v)),
            Chart::Ball { centre, radius } => {
                let (a, b) = (at.x / radius - std::f32::consts::PI, at.y / radius - std::f32::consts::FRAC_PI_2);
                let n = Vec3::new(a.cos() * b.cos(), a.sin() * b.cos(), b.sin());
                (centre + n * radius, n)
            }
            Chart::Drum { base, radius } => {
                let a = at.x / radius - std::f32::consts::PI;
                let n = Vec3::new(a.cos(), a.sin(), 0.0);
                (base + n * radius + Vec3::Z * at.y, n)
            }
        }
    }
}
