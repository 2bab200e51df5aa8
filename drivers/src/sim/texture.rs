//! Surfaces: procedural albedo, filtered to the pixel that sees it.
//!
//! Input is a surface coordinate in metres and the extent of the pixel there (the footprint); output is albedo in [0, 1].
//! There is detail at every scale down to a millimetre, below a pixel at any distance at which a camera flies, so nothing may
//! be point-sampled: piecewise-constant patterns and lines are averaged over the footprint in closed form, and smooth noise
//! stops adding octaves when a cell is no wider than the footprint.

use glam::Vec2;

/// What a surface looks like.
#[derive(Clone, Copy, Debug)]
pub struct Material {
    /// Grey pattern: albedo of a spot, by seed.
    pattern: fn(Spot, u32) -> f32,
    /// Red, green and blue over the grey.
    tint: [f32; 3],
}

pub(super) const PLASTER: Material = Material { pattern: plaster, tint: [1.0, 0.9, 0.75] };
pub(super) const BRICK: Material = Material { pattern: brick, tint: [1.3, 0.75, 0.6] };
pub(super) const CONCRETE: Material = Material { pattern: concrete, tint: [0.9, 1.0, 1.1] };
pub(super) const PARQUET: Material = Material { pattern: parquet, tint: [1.3, 0.95, 0.5] };
pub(super) const CEILING_TILE: Material = Material { pattern: ceiling_tile, tint: [0.95, 1.0, 1.0] };
pub(super) const BOOKS: Material = Material { pattern: books, tint: [1.4, 0.7, 0.8] };
pub(super) const POSTER: Material = Material { pattern: poster, tint: [0.6, 0.9, 1.5] };
pub(super) const PLAID: Material = Material { pattern: plaid, tint: [0.7, 1.2, 0.8] };
pub(super) const CRATE: Material = Material { pattern: crate_boards, tint: [1.3, 0.95, 0.5] };
pub(super) const MARBLE: Material = Material { pattern: marble, tint: [0.95, 1.0, 1.0] };
pub(super) const PRINT: Material = Material { pattern: print, tint: [0.6, 0.9, 1.5] };
pub(super) const DRAWERS: Material = Material { pattern: drawers, tint: [0.8, 0.9, 1.3] };
pub(super) const RUG: Material = Material { pattern: rug, tint: [1.4, 0.7, 0.8] };
pub(super) const LEAVES: Material = Material { pattern: leaves, tint: [0.6, 1.3, 0.5] };

/// A place on a surface as one pixel sees it.
#[derive(Clone, Copy, Debug)]
pub struct Spot {
    /// Surface coordinate, m; v points up on walls.
    pub at: Vec2,
    /// Extent of the pixel along u and v, m.
    pub footprint: Vec2,
    /// Extent of the surface, m.
    pub size: Vec2,
}

/// The albedo of a material at a spot.
pub fn albedo(material: Material, seed: u32, s: Spot) -> f32 {
    (material.pattern)(s, seed).clamp(0.02, 0.95)
}

/// The red, green and blue of a surface over its grey; their luma is one.
pub fn tint(material: Material, seed: u32) -> [f32; 3] {
    let [r, g, b] = material.tint;
    // Two walls of one material differ in colour.
    let vary = |v: f32, c: i32| v * (0.8 + 0.4 * cell(c, 0, seed));
    let [r, g, b] = [vary(r, 0), vary(g, 1), vary(b, 2)];
    let luma = 0.299 * r + 0.587 * g + 0.114 * b;
    [r / luma, g / luma, b / luma]
}

/// Counter-based hash of a lattice point (xxHash-like avalanche).
#[inline]
pub fn hash(x: i32, y: i32, seed: u32) -> u32 {
    let mut h =
        (x as u32).wrapping_mul(0x9E37_79B1) ^ (y as u32).wrapping_mul(0x85EB_CA77) ^ seed.wrapping_mul(0xC2B2_AE3D);
    h = (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
    h = (h ^ (h >> 12)).wrapping_mul(0x297A_2D39);
    h ^ (h >> 15)
}

/// Random numbers in [0, 1) on a lattice that repeats every `PERIOD` cells: each entry holds the four corners of a cell, so
/// that interpolated noise costs one load from 64 KiB. Seeds and octaves read it shifted.
const PERIOD: usize = 64;
static CORNERS: [[f32; 4]; PERIOD * PERIOD] = corners();

const fn corners() -> [[f32; 4]; PERIOD * PERIOD] {
    let mut values = [0.0; PERIOD * PERIOD];
    // xorshift32 (Marsaglia).
    let mut state = 0x2545_F491u32;
    let mut k = 0;
    while k < values.len() {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        values[k] = (state >> 8) as f32 / 16_777_216.0;
        k += 1;
    }
    let mut cells = [[0.0; 4]; PERIOD * PERIOD];
    k = 0;
    while k < cells.len() {
        let (x, y) = (k % PERIOD, k / PERIOD);
        let (x1, y1) = ((x + 1) % PERIOD, (y + 1) % PERIOD * PERIOD);
        cells[k] = [values[k], values[y * PERIOD + x1], values[y1 + x], values[y1 + x1]];
        k += 1;
    }
    cells
}

/// A random number, uniform in [0, 1), of a lattice point; does not repeat.
#[inline]
fn cell(x: i32, y: i32, seed: u32) -> f32 {
    (hash(x, y, seed) >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// The cell of `x`, as integer and as float; exact below 2²² cells. At an integer it may be the cell below, whose upper end is
/// the same place.
#[inline(always)]
fn floor(x: f32) -> (i32, f32) {
    /// 1.5 * 2²³: the mantissa of a sum with it is the rounded integer.
    const SHIFT: f32 = 12_582_912.0;
    let y = (x - 0.5) + SHIFT;
    ((y.to_bits() as i32).wrapping_sub(SHIFT.to_bits() as i32), y - SHIFT)
}

/// The two cells a footprint of `f` cells touches: the lower one and the weight of the upper one.
#[inline]
fn span(x: f32, f: f32) -> (i32, f32) {
    let f = f.clamp(1e-4, 1.0);
    let (i, low) = floor(x - 0.5 * f);
    (i, ((x + 0.5 * f - (low + 1.0)) / f).clamp(0.0, 1.0))
}

/// The four corners of cell (i, j).
#[inline(always)]
fn corners_of(i: i32, j: i32, seed: u32) -> [f32; 4] {
    let shift = seed.wrapping_mul(0x9E37_79B1);
    let x = (i as u32).wrapping_add(shift >> 25) as usize % PERIOD;
    let y = (j as u32).wrapping_add(shift >> 18) as usize % PERIOD;
    CORNERS[y * PERIOD + x]
}

#[inline(always)]
fn between([c00, c10, c01, c11]: [f32; 4], a: f32, b: f32) -> f32 {
    let low = c00 + a * (c10 - c00);
    let high = c01 + a * (c11 - c01);
    low + b * (high - low)
}

/// Noise in [0, 1] between the corners of cell (i, j).
#[inline(always)]
fn bilinear(i: i32, j: i32, a: f32, b: f32, seed: u32) -> f32 {
    between(corners_of(i, j, seed), a, b)
}

/// Part of the footprint on cells of `pitch` metres of which `share`, chosen at random, are set.
#[inline]
fn scattered(s: Spot, pitch: Vec2, share: f32, seed: u32) -> f32 {
    let (x, f) = (s.at / pitch, s.footprint / pitch);
    let fade = 1.0 / (f.x.max(1.0) * f.y.max(1.0));
    let ((i, a), (j, b)) = (span(x.x, f.x), span(x.y, f.y));
    let set = corners_of(i, j, seed).map(|c| if c < share { 1.0 } else { 0.0 });
    share + fade * (between(set, a, b) - share)
}

/// Piecewise-constant noise on cells of `pitch` metres, mean 0.5, averaged over the footprint.
#[inline]
fn blocks(s: Spot, pitch: Vec2, seed: u32) -> f32 {
    let (x, f) = (s.at / pitch, s.footprint / pitch);
    // The spread of the mean of many cells.
    let fade = 1.0 / (f.x.max(1.0) * f.y.max(1.0));
    if fade < 0.1 {
        return 0.5;
    }
    let ((i, a), (j, b)) = (span(x.x, f.x), span(x.y, f.y));
    0.5 + fade * (bilinear(i, j, a, b, seed) - 0.5)
}

const LACUNARITY: f32 = 2.3;

/// Smooth noise, mean 0, first octave in [-0.5, 0.5]: octaves from cells of `coarse` down to `fine`
/// metres or to the footprint, each `gain` times weaker than the one before.
#[inline]
fn fbm(s: Spot, coarse: f32, fine: f32, gain: f32, seed: u32) -> f32 {
    fbm_until(s, coarse, fine, gain, seed, f32::NEG_INFINITY)
}

/// Smooth noise as `fbm`, which stops as soon as no finer octave can lift the sum to `level`.
#[inline(always)]
fn fbm_until(s: Spot, coarse: f32, fine: f32, gain: f32, seed: u32, level: f32) -> f32 {
    let foot = 0.5 * (s.footprint.x + s.footprint.y);
    let (floor_pitch, per_foot) = (fine.max(foot), 1.0 / foot);
    let (mut pitch, mut per_pitch, mut amplitude, mut sum, mut octave) = (coarse, 1.0 / coarse, 1.0f32, 0.0f32, seed);
    let tail = 0.5 / (1.0 - gain); // bound of all octaves from an amplitude of 1 down
    while pitch > floor_pitch && sum + tail * amplitude > level {
        let fade = ((pitch * per_foot - 1.0) * 0.7).min(1.0);
        let x = s.at * per_pitch;
        let ((i, left), (j, bottom)) = (floor(x.x), floor(x.y));
        let (a, b) = (x.x - left, x.y - bottom);
        let smooth = |a: f32| a * a * (3.0 - 2.0 * a);
        sum += amplitude * fade * (bilinear(i, j, smooth(a), smooth(b), octave) - 0.5);
        pitch *= 1.0 / LACUNARITY;
        per_pitch *= LACUNARITY;
        amplitude *= gain;
        octave = octave.wrapping_add(0x3C6E_F372);
    }
    sum
}

/// A step at x = 0 averaged over `f`.
#[inline]
fn step(x: f32, f: f32) -> f32 {
    (x / f.max(1e-5) + 0.5).clamp(0.0, 1.0)
}

/// 1 inside [lo, hi] averaged over `f`.
#[inline]
fn band(x: f32, lo: f32, hi: f32, f: f32) -> f32 {
    let f = f.max(1e-5);
    (((x + 0.5 * f).min(hi) - (x - 0.5 * f).max(lo)) / f).clamp(0.0, 1.0)
}

/// Coverage by lines of `width` every `pitch` metres, starting at 0.
#[inline]
fn lines(x: f32, pitch: f32, width: f32, f: f32) -> f32 {
    let (x, w, f) = (x / pitch, width / pitch, (f / pitch).max(1e-4));
    let integral = |x: f32| {
        let i = floor(x).1;
        i * w + (x - i).min(w)
    };
    (integral(x + 0.5 * f) - integral(x - 0.5 * f)) / f
}

fn mix(a: f32, b: f32, s: f32) -> f32 {
    a + (b - a) * s
}

/// Blotches: where smooth noise passes `level`, with a sharp edge.
#[inline]
fn blotches(s: Spot, pitch: f32, level: f32, seed: u32) -> f32 {
    // the noise changes by about 1 over `pitch`, so a footprint spans footprint / pitch of it
    let soft = (s.footprint.x + s.footprint.y) / pitch + 0.02;
    let n = fbm_until(s, pitch, 0.002, 0.5, seed, level - 0.5 * soft);
    step(n - level, soft)
}

/// Painted plaster: stains, chipped patches, grain.
fn plaster(s: Spot, seed: u32) -> f32 {
    let base = 0.62 + 0.16 * fbm(s, 1.3, 0.001, 0.62, seed);
    let chipped = blotches(s, 0.34, 0.3, seed ^ 0x51);
    let specks = blotches(s, 0.055, 0.37, seed ^ 0x77);
    mix(mix(base, 0.36 + 0.1 * blocks(s, Vec2::splat(0.013), seed), chipped), 0.25, 0.8 * specks)
}

fn brick(s: Spot, seed: u32) -> f32 {
    const HEIGHT: f32 = 0.078;
    const LENGTH: f32 = 0.25;
    const MORTAR: f32 = 0.012;
    let row = floor(s.at.y / HEIGHT).0;
    let shifted = Spot { at: Vec2::new(s.at.x + (row & 1) as f32 * 0.5 * LENGTH, s.at.y), ..s };
    let tone = blocks(shifted, Vec2::new(LENGTH, HEIGHT), seed);
    let joint_u = lines(shifted.at.x, LENGTH, MORTAR, s.footprint.x);
    let joint_v = lines(s.at.y, HEIGHT, MORTAR, s.footprint.y);
    let joint = joint_u + joint_v - joint_u * joint_v;
    let grain = fbm(s, 0.06, 0.001, 0.7, seed ^ 3);
    let stain = fbm(s, 1.1, 0.3, 0.5, seed ^ 5);
    mix(0.18 + 0.42 * tone + 0.2 * grain, 0.66 + 0.12 * grain, joint) + 0.12 * stain
}

/// Cast in panels, with tie holes and runs of water.
fn concrete(s: Spot, seed: u32) -> f32 {
    let panel = Vec2::new(1.2, 0.9);
    let base = 0.42 + 0.14 * (blocks(s, panel, seed) - 0.5) + 0.24 * fbm(s, 0.8, 0.001, 0.66, seed ^ 1);
    let runs = fbm(Spot { at: s.at * Vec2::new(1.0, 0.12), ..s }, 0.16, 0.01, 0.6, seed ^ 2);
    let seam = lines(s.at.x, panel.x, 0.012, s.footprint.x).max(lines(s.at.y, panel.y, 0.012, s.footprint.y));
    let q = Vec2::new(s.at.x / 0.6 - 0.5, s.at.y / 0.45 - 0.5);
    let hole = (q - Vec2::new(floor(q.x).1, floor(q.y).1) - 0.5) * Vec2::new(0.6, 0.45);
    let hole = step(0.022 - hole.length(), s.footprint.max_element());
    let pores = blotches(s, 0.04, 0.36, seed ^ 4);
    mix(mix(base + 0.16 * runs, 0.14, 0.75 * pores), 0.08, seam.max(hole))
}

fn parquet(s: Spot, seed: u32) -> f32 {
    let plank = Vec2::new(1.05, 0.135);
    let row = floor(s.at.y / plank.y).0;
    let shifted = Spot { at: Vec2::new(s.at.x + cell(row, 7, seed) * plank.x, s.at.y), ..s };
    let tone = blocks(shifted, plank, seed);
    let stretch = Vec2::new(0.12, 1.0);
    let grain =
        fbm(Spot { at: shifted.at * stretch, footprint: s.footprint * stretch, ..s }, 0.03, 0.001, 0.75, seed ^ 1);
    let knots = blotches(s, 0.11, 0.4, seed ^ 2);
    let seam = lines(shifted.at.x, plank.x, 0.006, s.footprint.x).max(lines(s.at.y, plank.y, 0.005, s.footprint.y));
    mix(mix(0.32 + 0.32 * tone + 0.22 * grain, 0.15, 0.7 * knots), 0.06, seam)
}

fn ceiling_tile(s: Spot, seed: u32) -> f32 {
    const TILE: f32 = 0.6;
    let rail = lines(s.at.x, TILE, 0.024, s.footprint.x).max(lines(s.at.y, TILE, 0.024, s.footprint.y));
    let tone = blocks(s, Vec2::splat(TILE), seed);
    let holes = blotches(s, 0.03, 0.28, seed ^ 1);
    let stain = blotches(s, 0.7, 0.34, seed ^ 3);
    let base = 0.56 + 0.18 * tone + 0.1 * fbm(s, 0.2, 0.001, 0.7, seed ^ 2) - 0.12 * stain;
    mix(mix(base, 0.28, 0.7 * holes), 0.85, rail)
}

/// Spines of uneven width and height on shelves.
fn books(s: Spot, seed: u32) -> f32 {
    const SHELF: f32 = 0.33;
    const BOARD: f32 = 0.028;
    let row = floor(s.at.y / SHELF).0;
    let y = s.at.y - row as f32 * SHELF;
    let board = lines(s.at.y, SHELF, BOARD, s.footprint.y);
    // a monotonic warp of u makes the spines uneven without a search
    let u = s.at.x + 0.011 * (37.0 * s.at.x + 9.0 * row as f32).sin() + 0.02 * (11.0 * s.at.x + row as f32).sin();
    let pitch = 0.042;
    let spot = Spot { at: Vec2::new(u, row as f32 + 0.5), footprint: Vec2::new(s.footprint.x, 1e-3), ..s };
    let tone = blocks(spot, Vec2::new(pitch, 1.0), seed);
    let tall = blocks(spot, Vec2::new(pitch, 1.0), seed ^ 1);
    let gap = lines(u, pitch, 0.003, s.footprint.x);
    let top = BOARD + SHELF * (0.58 + 0.3 * tall);
    let spine = step(top - y, s.footprint.y) * (1.0 - gap);
    let label = BOARD + 0.05 + 0.12 * blocks(spot, Vec2::new(pitch, 1.0), seed ^ 2);
    let label = band(y, label, label + 0.05, s.footprint.y);
    let letters = blocks(s, Vec2::new(0.009, 0.006), seed ^ 3);
    let cover = tone * tone * 0.75 + 0.07 + 0.08 * fbm(s, 0.05, 0.001, 0.7, seed ^ 4);
    let cover = mix(cover, (1.05 - cover) * (0.35 + 0.8 * letters), 0.8 * label);
    mix(mix(0.04, cover, spine), 0.45 + 0.15 * fbm(s, 0.1, 0.001, 0.7, seed ^ 5), board)
}

/// A framed picture: sky, ground and a few overlapping shapes.
fn poster(s: Spot, seed: u32) -> f32 {
    let f = s.footprint;
    let border = 0.06 * s.size.min_element() + 0.02;
    let inside = band(s.at.x, border, s.size.x - border, f.x) * band(s.at.y, border, s.size.y - border, f.y);
    let mat = band(s.at.x, 0.02, s.size.x - 0.02, f.x) * band(s.at.y, 0.02, s.size.y - 0.02, f.y);
    let horizon = s.size.y * (0.3 + 0.3 * cell(0, 1, seed));
    let relief = horizon + 0.25 * s.size.y * fbm(Spot { at: Vec2::new(s.at.x, 0.5), ..s }, 0.3, 0.01, 0.5, seed);
    let sky = 0.5 + 0.3 * (s.at.y / s.size.y - 0.5) + 0.3 * fbm(s, 0.35, 0.001, 0.6, seed ^ 9);
    let ground = 0.22 + 0.35 * fbm(s, 0.09, 0.001, 0.75, seed ^ 8);
    let mut value = mix(sky, ground, step(relief - s.at.y, f.y));
    for k in 0..7 {
        let c = Vec2::new(cell(k, 2, seed), cell(k, 3, seed)) * s.size;
        let r = s.size.min_element() * (0.05 + 0.16 * cell(k, 4, seed));
        let d = s.at - c;
        let cover = if hash(k, 5, seed) & 1 == 0 {
            step(r - d.length(), f.max_element())
        } else {
            band(d.x, -r, r, f.x) * band(d.y, -0.6 * r, 0.6 * r, f.y)
        };
        let tone = cell(k, 6, seed) + 0.25 * fbm(s, 0.05, 0.001, 0.7, seed ^ 11);
        value = mix(value, tone, cover);
    }
    mix(0.1, mix(0.85, value, inside), mat)
}

fn plaid(s: Spot, seed: u32) -> f32 {
    let (at, f) = (s.at, s.footprint);
    let across = Spot { at: Vec2::new(at.x, 0.5), footprint: Vec2::new(f.x, 1e-3), ..s };
    let along = Spot { at: Vec2::new(0.5, at.y), footprint: Vec2::new(1e-3, f.y), ..s };
    let warp = blocks(across, Vec2::new(0.07, 1.0), seed);
    let weft = blocks(along, Vec2::new(1.0, 0.07), seed ^ 1);
    let threads = blocks(s, Vec2::new(0.006, 0.004), seed ^ 2);
    0.06 + 0.32 * warp + 0.32 * weft + 0.14 * (threads - 0.5) + 0.14 * fbm(s, 0.3, 0.001, 0.65, seed ^ 3)
}

fn crate_boards(s: Spot, seed: u32) -> f32 {
    let f = s.footprint;
    let frame = 0.07;
    let inner = band(s.at.x, frame, s.size.x - frame, f.x) * band(s.at.y, frame, s.size.y - frame, f.y);
    let rim = band(s.at.x, frame - 0.006, s.size.x - frame + 0.006, f.x)
        * band(s.at.y, frame - 0.006, s.size.y - frame + 0.006, f.y);
    let tone = blocks(s, Vec2::new(9.0, 0.11), seed);
    let stretch = Vec2::new(0.15, 1.0);
    let grain = fbm(Spot { at: s.at * stretch, footprint: f * stretch, ..s }, 0.03, 0.001, 0.75, seed ^ 1);
    let gap = lines(s.at.y, 0.11, 0.007, f.y) * inner;
    let c = s.at - 0.5 * s.size;
    let stencil = band(c.x, -0.13, 0.13, f.x) * band(c.y, -0.05, 0.05, f.y);
    let stencil = stencil * scattered(s, Vec2::new(0.03, 0.02), 0.55, seed ^ 2);
    let board = mix(0.5, 0.28 + 0.3 * tone, inner) + 0.25 * grain;
    mix(board, 0.06, (gap + (rim - inner)).max(0.9 * stencil).clamp(0.0, 1.0))
}

/// Veined stone: thin rims around islands of darker stone, and inclusions.
fn marble(s: Spot, seed: u32) -> f32 {
    let islands = blotches(s, 0.22, 0.1, seed);
    let rims = islands - blotches(s, 0.22, 0.16, seed);
    let inclusions = blotches(s, 0.06, 0.3, seed ^ 1);
    let base = 0.62 - 0.2 * islands + 0.2 * fbm(s, 0.25, 0.001, 0.66, seed ^ 2);
    mix(base - 0.28 * rims, 0.2, 0.8 * inclusions)
}

/// A printed page: headline, columns of words.
fn print(s: Spot, seed: u32) -> f32 {
    let ink_row = lines(s.at.y - 0.004, 0.016, 0.009, s.footprint.y);
    let words = scattered(s, Vec2::new(0.013, 0.016), 0.65, seed);
    let ink = ink_row * words * band(s.at.x, 0.03, s.size.x - 0.03, s.footprint.x);
    let picture = scattered(s, Vec2::new(0.14, 0.11), 0.28, seed ^ 1);
    let paper = 0.78 + 0.1 * fbm(s, 0.2, 0.001, 0.6, seed ^ 2);
    mix(mix(paper, 0.12, 0.85 * ink), 0.2 + 0.7 * fbm(s, 0.05, 0.001, 0.7, seed ^ 3).abs(), picture)
}

fn drawers(s: Spot, seed: u32) -> f32 {
    let f = s.footprint;
    let pitch = Vec2::new(0.4, 0.27);
    let tone = blocks(s, pitch, seed);
    let seam = lines(s.at.x, pitch.x, 0.01, f.x).max(lines(s.at.y, pitch.y, 0.01, f.y));
    let q = s.at / pitch;
    let c = (q - Vec2::new(floor(q.x).1, floor(q.y).1) - 0.5) * pitch;
    let handle = band(c.x, -0.06, 0.06, f.x) * band(c.y, 0.03, 0.05, f.y);
    let label = band(c.x, -0.04, 0.05, f.x) * band(c.y, -0.06, -0.015, f.y);
    let text = blocks(s, Vec2::new(0.008, 0.009), seed ^ 1);
    let scratches = blotches(s, 0.09, 0.36, seed ^ 2);
    let base = 0.22 + 0.16 * tone + 0.16 * fbm(s, 0.25, 0.001, 0.66, seed ^ 3) + 0.25 * scratches;
    mix(mix(mix(base, 0.03, seam), 0.75, handle), 0.3 + 0.6 * text, label)
}

fn rug(s: Spot, seed: u32) -> f32 {
    let f = s.footprint;
    let edge = (s.at.min(s.size - s.at)).min_element();
    let folded = Spot { at: (s.at - 0.5 * s.size).abs(), ..s }; // the halves mirror each other
    let motif = 0.55 * blocks(folded, Vec2::splat(0.17), seed) + 0.3 * blocks(folded, Vec2::splat(0.055), seed ^ 1);
    let motif = motif + 0.25 * blocks(s, Vec2::splat(0.012), seed ^ 2);
    let trim = band(edge, 0.06, 0.09, f.max_element()) + band(edge, 0.14, 0.16, f.max_element());
    mix(0.04 + 0.75 * motif, 0.7, trim) + 0.1 * fbm(s, 0.4, 0.001, 0.7, seed ^ 3)
}

fn leaves(s: Spot, seed: u32) -> f32 {
    let large = blotches(s, 0.12, 0.02, seed);
    let small = blotches(s, 0.045, 0.08, seed ^ 1);
    0.07 + 0.2 * large + 0.28 * small + 0.12 * fbm(s, 0.03, 0.001, 0.8, seed ^ 2)
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [(&str, Material); 14] = [
        ("plaster", PLASTER),
        ("brick", BRICK),
        ("concrete", CONCRETE),
        ("parquet", PARQUET),
        ("ceiling_tile", CEILING_TILE),
        ("books", BOOKS),
        ("poster", POSTER),
        ("plaid", PLAID),
        ("crate_boards", CRATE),
        ("marble", MARBLE),
        ("print", PRINT),
        ("drawers", DRAWERS),
        ("rug", RUG),
        ("leaves", LEAVES),
    ];

    fn spot(at: Vec2, f: f32) -> Spot {
        Spot { at, footprint: Vec2::splat(f), size: Vec2::new(1.2, 1.0) }
    }

    /// The filtered albedo of a pixel is close to the mean of its sub-pixels.
    #[test]
    fn filtered_albedo_is_the_mean_over_the_footprint() {
        for (name, material) in ALL {
            let (mut error, mut n) = (0.0f64, 0.0);
            for k in 0..400 {
                let at = Vec2::new(0.05 + 1.1 * cell(k, 0, 1), 0.05 + 0.9 * cell(k, 1, 1));
                let f = 0.008;
                let whole = albedo(material, 7, spot(at, f));
                let mut mean = 0.0;
                for i in 0..64 {
                    let d = Vec2::new((i % 8) as f32 - 3.5, (i / 8) as f32 - 3.5) * (f / 8.0);
                    mean += albedo(material, 7, spot(at + d, f / 8.0)) / 64.0;
                }
                error += ((whole - mean) as f64).powi(2);
                n += 1.0;
            }
            let rms = (error / n).sqrt();
            assert!(rms < 0.05, "{name}: {rms}");
        }
    }

    #[test]
    fn every_material_has_contrast_at_a_pixel_and_at_a_hand_s_breadth() {
        for (name, material) in ALL {
            for reach in [0.01f32, 0.1] {
                let (mut sum, n) = (0.0, 300);
                for k in 0..n {
                    let at = Vec2::new(0.1 + 0.9 * cell(k, 0, 2), 0.1 + 0.7 * cell(k, 1, 2));
                    let a = albedo(material, 3, spot(at, 0.005));
                    let b = albedo(material, 3, spot(at + Vec2::new(reach, 0.6 * reach), 0.005));
                    sum += (a - b).abs();
                }
                assert!(sum / n as f32 > 0.015, "{name} at {reach}: {}", sum / n as f32);
            }
        }
    }
}
