//! Images: the rays of a camera, the surfaces that they meet, and the response of the sensor.
//!
//! A frame is made in two passes over 16-pixel tiles: `cast` finds distance and face at every pixel centre; `shade` turns
//! them into grey levels. Textures are filtered to the pixel in closed form, so one sample is enough inside a face; pixels
//! whose neighbours see another face cast `EDGE x EDGE` rays. For each tile only the solids that meet the tile's cone are
//! listed, of them for each block of 4 pixels those that meet its cone, and these are tried, nearest first.
//!
//! Work is split over threads by tile rows, and every random number is a hash of (seed, frame, camera, pixel), so the image
//! does not depend on the number of threads. There is no motion blur. Under a rolling shutter every row has a view of its
//! own; lists of solids are those of the middle row of a tile, with a margin for the motion of the rig until the others.

use super::room::{Room, NOTHING};
use super::texture::{self, Spot};
use crate::camera::Camera;
use crate::types::Pose;
use glam::{DVec2, Quat, Vec2, Vec3};
use std::thread::Builder;

/// Side of a tile, of the blocks in it, pixels, and of the grid of rays of an edge pixel.
const TILE: usize = 16;
const BLOCK: usize = 4;
const EDGE: usize = 4;
/// What rounding may take from the radius of a sphere, m.
const ROUNDED: f32 = 1e-4;
/// Motion of a rig in half a tile's rows under a rolling shutter, m and rad: 20 m/s and 20 rad/s for 1 ms.
const ROLL_MOVE: f32 = 0.02;
const ROLL_TURN: f32 = 0.02;

/// The sensor behind the lens. Grey levels are those of the 8-bit image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sensor {
    /// Standard deviation of the read noise, grey levels.
    pub read_noise: f64,
    /// Variance of the shot noise per grey level, grey levels.
    pub shot_noise: f64,
    /// Light lost at the edge of a field of view of 45° half angle, fraction.
    pub vignette: f64,
}

/// The surface that a pixel centre sees.
#[derive(Clone, Copy, Debug)]
pub struct Hit {
    /// Along the unit ray, m.
    pub distance: f32,
    /// Index in `Room::faces`, or `NOTHING`.
    pub face: u32,
}

/// Bearings of all pixels of a camera, and the cones of its tiles.
pub struct Lens {
    width: usize,
    height: usize,
    /// Unit bearing in the camera frame (zero outside the lens' domain).
    bearings: Vec<Vec3>,
    /// Angle a pixel spans, rad.
    pixel_angle: Vec<f32>,
    cones: Vec<Cone>,
    /// Those of the blocks of 4 pixels, row-major.
    blocks: Vec<Cone>,
}

#[derive(Clone, Copy)]
struct Cone {
    axis: Vec3,
    cos: f32,
    sin: f32,
}

/// A camera at an instant, in the room's frame.
#[derive(Clone, Copy)]
pub struct View {
    /// Centre of the camera in the world frame, m.
    pub origin: Vec3,
    /// `world_from_cam`.
    pub turn: Quat,
    /// The cell of the room that it is in.
    pub cell: usize,
}

impl View {
    /// The view of a camera's pose.
    pub fn new(room: &Room, world_from_cam: &Pose) -> View {
        let origin = world_from_cam.p.as_vec3();
        View { origin, turn: world_from_cam.q.as_quat(), cell: room.cell_of(origin) }
    }
}

/// The view and the exposure of a row.
#[derive(Clone, Copy)]
pub struct Row {
    /// Pose of the camera when the row is exposed.
    pub view: View,
    /// Grey levels per unit of radiance.
    pub gain: f32,
    /// Added to every pixel, grey levels.
    pub offset: f32,
}

/// The rows of an image, or one that stands for all under a global shutter.
#[derive(Clone, Copy)]
pub struct Rows<'a>(pub &'a [Row]);

impl Rows<'_> {
    #[inline]
    fn at(&self, y: usize) -> &Row {
        &self.0[y.min(self.0.len() - 1)]
    }

    fn roll(&self) -> bool {
        self.0.len() > 1
    }
}

/// The sensor and the noise streams of an image of `N` channels: one of grey, or three of red, green and blue.
#[derive(Clone, Copy)]
pub struct Exposure<const N: usize> {
    /// Noise and vignette.
    pub sensor: Sensor,
    /// Differ for every plane of a run.
    pub streams: [u32; N],
}

/// A solid as seen from a view, for the tile tests.
#[derive(Clone, Copy)]
struct SolidInView {
    solid: u32,
    /// Nearest it can be, m.
    near: f32,
    /// Centre from the camera, and the radius of the sphere around it that holds the solid, m.
    centre: Vec3,
    reach: f32,
    axis: Vec3,
    cos: f32,
    sin: f32,
}

impl SolidInView {
    /// Whether a unit ray may meet it.
    #[inline]
    fn may_meet(&self, d: Vec3) -> bool {
        (self.centre - d * self.centre.dot(d)).length_squared() <= self.reach * self.reach
    }
}

/// Memory that is reused between frames: nothing here allocates after construction.
pub struct Scratch {
    lists: Vec<Lists>,
    /// What each pixel saw in the last `cast`, row-major.
    pub hits: Vec<Hit>,
}

/// The lists of one thread: all solids nearest first, those of a tile, and those of a block of it.
struct Lists {
    seen: Vec<SolidInView>,
    tile: Vec<SolidInView>,
    block: Vec<SolidInView>,
}

impl Lists {
    /// Lists the solids for a row of tiles; under a global shutter the first list serves all.
    fn look_around(&mut self, room: &Room, rows: Rows, ty: usize, first: bool) {
        if first || rows.roll() {
            let slack = if rows.roll() { ROLL_MOVE } else { 0.0 };
            look_around(room, rows.at(ty * TILE + TILE / 2).view, slack, &mut self.seen);
        }
    }

    fn tile(&mut self, lens: &Lens, rows: Rows, tx: usize, ty: usize) {
        let slack = if rows.roll() { ROLL_TURN } else { 0.0 };
        let cone = &lens.cones[ty * lens.tiles_across() + tx];
        list_within(&self.seen, cone, rows.at(ty * TILE + TILE / 2).view, slack, &mut self.tile);
    }

    /// Lists the solids of a block of a tile that is listed.
    fn block(&mut self, lens: &Lens, rows: Rows, bx: usize, by: usize) {
        let slack = if rows.roll() { ROLL_TURN } else { 0.0 };
        let cone = &lens.blocks[by * lens.width.div_ceil(BLOCK) + bx];
        list_within(&self.tile, cone, rows.at(by * BLOCK / TILE * TILE + TILE / 2).view, slack, &mut self.block);
    }
}

impl Scratch {
    /// Memory for images of at most so many pixels, and for so many threads.
    pub fn new(room: &Room, pixels: usize, threads: usize) -> Scratch {
        let n = room.solids.len();
        Scratch {
            lists: (0..threads.max(1))
                .map(|_| [(); 3].map(|()| Vec::with_capacity(n)))
                .map(|[seen, tile, block]| Lists { seen, tile, block })
                .collect(),
            hits: vec![Hit { distance: 0.0, face: NOTHING }; pixels],
        }
    }
}

impl Lens {
    /// Bearings of a camera, one for each pixel.
    pub fn new(camera: &Camera) -> Lens {
        let (width, height) = (camera.width, camera.height);
        let at = |i: usize| camera.unproject(DVec2::new((i % width) as f64, (i / width) as f64));
        let bearings: Vec<Vec3> = (0..width * height).map(|i| at(i).map_or(Vec3::ZERO, |b| b.as_vec3())).collect();
        let mut lens =
            Lens { width, height, bearings, pixel_angle: vec![0.0; width * height], cones: vec![], blocks: vec![] };
        for i in 0..width * height {
            if lens.bearings[i] != Vec3::ZERO {
                let (du, dv) = lens.gradients(i % width, i / width);
                lens.pixel_angle[i] = du.cross(dv).length().sqrt();
            }
        }
        let cones = |side: usize| -> Vec<Cone> {
            let (across, down) = (width.div_ceil(side), height.div_ceil(side));
            (0..across * down).map(|k| lens.cone(side, k % across, k / across)).collect()
        };
        (lens.cones, lens.blocks) = (cones(TILE), cones(BLOCK));
        lens
    }

    fn cone(&self, side: usize, tx: usize, ty: usize) -> Cone {
        let rays = || {
            let ys = ty * side..((ty + 1) * side).min(self.height);
            let row = move |y: usize| y * self.width + tx * side..y * self.width + ((tx + 1) * side).min(self.width);
            ys.flat_map(row).filter(|i| self.pixel_angle[*i] > 0.0)
        };
        let axis = rays().map(|i| self.bearings[i]).sum::<Vec3>().normalize_or_zero();
        // A pixel reaches half its diagonal beyond its centre.
        let reach = |i: usize| self.bearings[i].dot(axis).clamp(-1.0, 1.0).acos() + self.pixel_angle[i];
        let (sin, cos) = rays().map(reach).fold(0.0, f32::max).min(std::f32::consts::PI).sin_cos();
        Cone { axis, cos, sin }
    }

    fn tiles_across(&self) -> usize {
        self.width.div_ceil(TILE)
    }

    /// The change of the bearing per pixel to the right and down, from the neighbours.
    fn gradients(&self, x: usize, y: usize) -> (Vec3, Vec3) {
        let at = |x: usize, y: usize| self.bearings[y * self.width + x];
        let here = at(x, y);
        // At the end of the lens' domain a neighbour is missing and the pixel itself stands in.
        let gradient = |low: Vec3, high: Vec3| match (low == Vec3::ZERO, high == Vec3::ZERO) {
            (false, false) => (high - low) * 0.5,
            (true, false) => high - here,
            (false, true) => here - low,
            (true, true) => Vec3::ZERO,
        };
        let near = |inside: bool, x: usize, y: usize| if inside { at(x, y) } else { Vec3::ZERO };
        let left = near(x > 0, x.saturating_sub(1), y);
        let up = near(y > 0, x, y.saturating_sub(1));
        let right = near(x + 1 < self.width, (x + 1).min(self.width - 1), y);
        let down = near(y + 1 < self.height, x, (y + 1).min(self.height - 1));
        (gradient(left, right), gradient(up, down))
    }
}

/// Finds distance and face at every pixel centre, into `scratch.hits`.
pub fn cast(room: &Room, lens: &Lens, rows: Rows, scratch: &mut Scratch) {
    let hits = &mut scratch.hits[..lens.width * lens.height];
    fill(room, lens, rows, hits, &mut scratch.lists, |block, x, y| {
        let (view, d) = (rows.at(y).view, lens.bearings[y * lens.width + x]);
        if d == Vec3::ZERO {
            return Hit { distance: 0.0, face: NOTHING };
        }
        meet(room, block.solids(), &view, view.turn * d)
    });
}

/// Writes what `pixel` makes of the levels, from the hits of the last `cast` of the same rows.
pub fn shade<const N: usize, T: Send>(
    (room, lens, rows): (&Room, &Lens, Rows),
    exposure: &Exposure<N>,
    scratch: &mut Scratch,
    out: &mut [T],
    pixel: impl Fn([u8; N]) -> T + Sync,
) {
    let hits = &scratch.hits[..lens.width * lens.height];
    fill(room, lens, rows, out, &mut scratch.lists, |block, x, y| {
        let (i, Row { view, gain, offset }) = (y * lens.width + x, *rows.at(y));
        let light = if is_edge(hits, lens, x, y) {
            edge_radiance(room, lens, view, block.solids(), (x, y))
        } else if hits[i].face == NOTHING {
            [0.0; N]
        } else {
            radiance(room, view, view.turn * lens.bearings[i], hits[i], lens.pixel_angle[i])
        };
        pixel(std::array::from_fn(|c| develop(light[c] * gain, offset, lens.bearings[i].z, i, c, exposure)))
    });
}

/// The mean radiance of a sparse set of pixels, as an exposure meter sees it.
pub fn meter(room: &Room, lens: &Lens, view: View) -> f32 {
    const STEP: usize = 24;
    let (mut sum, mut n) = (0.0, 0.0);
    for y in (STEP / 2..lens.height).step_by(STEP) {
        for x in (STEP / 2..lens.width).step_by(STEP) {
            let i = y * lens.width + x;
            if lens.pixel_angle[i] > 0.0 {
                let d = view.turn * lens.bearings[i];
                let (distance, face) = room.nearest(view.origin, d);
                let [light] = radiance(room, view, d, Hit { distance, face }, lens.pixel_angle[i] * STEP as f32);
                sum += light;
                n += 1.0;
            }
        }
    }
    sum / f32::max(n, 1.0)
}

/// Writes the depth (z in the camera frame, m) of the hits of the last `cast`; 0 where there is none.
pub fn depths(lens: &Lens, hits: &[Hit], out: &mut [f32]) {
    for ((z, hit), b) in out.iter_mut().zip(hits).zip(&lens.bearings) {
        *z = if hit.face == NOTHING { 0.0 } else { (hit.distance * b.z).max(0.0) };
    }
}

/// A block of a tile, and the solids that its rays may meet, listed when they are first asked for.
struct Block<'a> {
    lens: &'a Lens,
    rows: Rows<'a>,
    lists: &'a mut Lists,
    tile_listed: bool,
    listed: bool,
    x: usize,
    y: usize,
}

impl Block<'_> {
    #[inline]
    fn solids(&mut self) -> &[SolidInView] {
        if !self.listed {
            self.list();
        }
        &self.lists.block
    }

    fn list(&mut self) {
        if !self.tile_listed {
            self.lists.tile(self.lens, self.rows, self.x * BLOCK / TILE, self.y * BLOCK / TILE);
        }
        self.lists.block(self.lens, self.rows, self.x, self.y);
        (self.tile_listed, self.listed) = (true, true);
    }
}

/// Fills an image with what `pixel` gives for each tile, column and row. Each thread has a band of whole tile rows, as equal
/// as can be.
fn fill<T: Send>(
    room: &Room,
    lens: &Lens,
    rows: Rows,
    pixels: &mut [T],
    lists: &mut [Lists],
    pixel: impl Fn(&mut Block, usize, usize) -> T + Sync,
) {
    let band_rows = lens.height.div_ceil(TILE).div_ceil(lists.len()) * TILE;
    let work = |k: usize, band: &mut [T], lists: &mut Lists| {
        let (first, end) = (k * band_rows, k * band_rows + band.len() / lens.width);
        for ty in first / TILE..end.div_ceil(TILE) {
            lists.look_around(room, rows, ty, ty == first / TILE);
            for tx in 0..lens.tiles_across() {
                let mut block = Block { lens, rows, lists, tile_listed: false, listed: false, x: 0, y: 0 };
                for k in 0..(TILE / BLOCK).pow(2) {
                    (block.x, block.y) =
                        ((tx * TILE / BLOCK) + k % (TILE / BLOCK), (ty * TILE / BLOCK) + k / (TILE / BLOCK));
                    block.listed = false;
                    for y in block.y * BLOCK..((block.y + 1) * BLOCK).min(end) {
                        for x in block.x * BLOCK..((block.x + 1) * BLOCK).min(lens.width) {
                            band[(y - first) * lens.width + x] = pixel(&mut block, x, y);
                        }
                    }
                }
            }
        }
    };
    let (mut bands, mut lists) = (pixels.chunks_mut(band_rows * lens.width).enumerate(), lists.iter_mut());
    let (first, spare) = (bands.next(), lists.next());
    std::thread::scope(|scope| {
        for ((k, band), list) in bands.zip(lists) {
            let work = &work;
            let draw = move || work(k, band, list);
            Builder::new().name("render".into()).spawn_scoped(scope, draw).expect("the system starts a few threads");
        }
        if let (Some((_, band)), Some(list)) = (first, spare) {
            work(0, band, list);
        }
    });
}

/// Lists all solids that a view may see, nearest first.
fn look_around(room: &Room, view: View, slack: f32, seen: &mut Vec<SolidInView>) {
    seen.clear();
    room.visible(view.cell, view.origin, slack, |k, s| {
        let c = s.centre - view.origin;
        let range = c.length().max(1e-6);
        let bound = s.bound + slack;
        let sin = (bound / range).min(1.0);
        let cos = (1.0 - sin * sin).sqrt();
        let near = (range - bound).max(0.0);
        seen.push(SolidInView { solid: k as u32, near, centre: c, reach: bound + ROUNDED, axis: c / range, cos, sin });
    });
    seen.sort_unstable_by(|a, b| a.near.total_cmp(&b.near).then(a.solid.cmp(&b.solid)));
}

/// Lists the solids whose bounding sphere may meet the cone.
fn list_within(seen: &[SolidInView], cone: &Cone, view: View, slack: f32, list: &mut Vec<SolidInView>) {
    list.clear();
    let axis = view.turn * cone.axis;
    list.extend(seen.iter().filter(|s| {
        // The angle between the axes against the sum of the half angles, in cosines; the sum may pass π.
        let cos_sum = s.cos * cone.cos - s.sin * cone.sin;
        let sin_sum = s.sin * cone.cos + s.cos * cone.sin;
        s.near <= 0.0 || sin_sum < slack || s.axis.dot(axis) >= cos_sum - 1e-5 - slack
    }));
}

#[inline]
fn meet(room: &Room, list: &[SolidInView], view: &View, d: Vec3) -> Hit {
    let mut best = room.shell(view.cell, view.origin, d);
    for s in list {
        if s.near > best.0 {
            break;
        }
        if s.may_meet(d) {
            room.solids[s.solid as usize].meet(view.origin, d, &mut best);
        }
    }
    Hit { distance: best.0, face: best.1 }
}

fn is_edge(hits: &[Hit], lens: &Lens, x: usize, y: usize) -> bool {
    let i = y * lens.width + x;
    let face = hits[i].face;
    let around = [
        (x > 0).then(|| i - 1),
        (x + 1 < lens.width).then_some(i + 1),
        (y > 0).then(|| i - lens.width),
        (y + 1 < lens.height).then_some(i + lens.width),
    ];
    let faces = around.into_iter().flatten().map(|j| hits[j].face);
    // At the end of the lens' domain there are no bearings to interpolate.
    let (mut differs, mut outside) = (false, face == NOTHING);
    for f in faces {
        differs |= f != face;
        outside |= f == NOTHING;
    }
    differs && !outside
}

/// The light that leaves a surface towards the camera: of all colours, or red, green and blue.
#[inline]
fn radiance<const N: usize>(room: &Room, view: View, d: Vec3, hit: Hit, angle: f32) -> [f32; N] {
    let face = &room.faces[hit.face as usize];
    let place = face.place(view.origin + d * hit.distance);
    // A ray turned by `angle` slides by angle·distance·|u - n (u·d)/(n·d)| along u.
    let stretch = 1.0 / place.normal.dot(d).abs().max(0.02);
    let slide = |u: Vec3| {
        let tilt = u.dot(d) * stretch;
        (u.length_squared() + tilt * tilt).sqrt()
    };
    let footprint = Vec2::new(slide(place.u), slide(place.v)) * (angle * hit.distance);
    let spot = Spot { at: place.at, footprint, size: face.size };
    let light = texture::albedo(face.material, face.seed, spot) * room.light(hit.face as usize, place.at);
    let tint = if N == 1 { [1.0; 3] } else { texture::tint(face.material, face.seed) };
    std::array::from_fn(|c| light * tint[c])
}

/// The light of a pixel that several faces share: its rays are gathered by face, and each face is shaded once, where its rays
/// meet it on average.
fn edge_radiance<const N: usize>(
    room: &Room,
    lens: &Lens,
    view: View,
    list: &[SolidInView],
    (x, y): (usize, usize),
) -> [f32; N] {
    const RAYS: usize = EDGE * EDGE;
    let angle = lens.pixel_angle[y * lens.width + x];
    let (du, dv) = lens.gradients(x, y);
    let (du, dv) = (view.turn * du / EDGE as f32, view.turn * dv / EDGE as f32);
    let corner = view.turn * lens.bearings[y * lens.width + x] - (du + dv) * (0.5 * (EDGE - 1) as f32);
    let ray = |k: usize| {
        let d = (corner + du * (k % EDGE) as f32 + dv * (k / EDGE) as f32).normalize();
        (meet(room, list, &view, d), d)
    };
    // In a building what is thinner than a pixel is too far to matter; in one room images are as they always were.
    if room.cells.len() > 1 {
        let ends = [0, EDGE - 1, RAYS - EDGE, RAYS - 1].map(ray);
        let face = ends[0].0.face;
        if ends.iter().all(|(hit, _)| hit.face == face) {
            let middle = ends.iter().map(|(hit, d)| *d * hit.distance).sum::<Vec3>() * 0.25;
            let distance = middle.length();
            return radiance(room, view, middle / distance, Hit { distance, face }, angle);
        }
    }
    let mut parts = [(NOTHING, 0.0f32, Vec3::ZERO); RAYS];
    let mut used = 0;
    for k in 0..RAYS {
        let (hit, d) = ray(k);
        let part = parts[..used].iter().position(|p| p.0 == hit.face).unwrap_or(used);
        used = used.max(part + 1);
        let (_, n, sum) = parts[part];
        parts[part] = (hit.face, n + 1.0, sum + d * hit.distance);
    }
    let mut light = [0.0; N];
    for (face, n, sum) in &parts[..used] {
        let distance = sum.length() / n;
        let hit = Hit { distance, face: *face };
        let share = n / RAYS as f32;
        let part: [f32; N] = radiance(room, view, *sum / (distance * n), hit, angle * share.sqrt());
        light.iter_mut().zip(part).for_each(|(light, part)| *light += share * part);
    }
    light
}

/// The level of a pixel in a channel, `cos` of the angle off the axis: vignette, exposure, shot and read noise, quantisation.
#[inline]
fn develop<const N: usize>(light: f32, offset: f32, cos: f32, pixel: usize, channel: usize, e: &Exposure<N>) -> u8 {
    let (stream, Sensor { read_noise, shot_noise, vignette }) = (e.streams[channel], e.sensor);
    let lost = vignette as f32 * 2.0 * (1.0 - cos * cos);
    let level = (light * (1.0 - lost).max(0.0) + offset).max(0.0);
    let read = read_noise as f32;
    let sigma = (read * read + shot_noise as f32 * level).sqrt();
    let a = texture::hash(pixel as i32, 0, stream);
    let b = texture::hash(pixel as i32, 1, stream);
    // The sum of four uniform numbers, scaled to unit variance.
    let sum = (a & 0xFFFF) + (a >> 16) + (b & 0xFFFF) + (b >> 16);
    let normal = (sum as f32 / 65536.0 - 2.0) * 1.732_050_8;
    (level + sigma * normal + 0.5).clamp(0.0, 255.0) as u8
}
