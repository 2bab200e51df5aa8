//! Seeds of an anchor keyframe: where its view is uncovered, Gaussians are put on the stereo depth.
//!
//! Pixels are picked by error diffusion (Floyd and Steinberg 1976) of a density that follows the image
//! gradient: evenly spaced where the image is flat, denser on detail, and the spacing is known,
//! so the size of a Gaussian is the distance to its neighbours. Where matching found no depth (bare walls)
//! the inverse depth of the nearest matches left, right, above and below is carried over, the background
//! preferred; such seeds start large and faint so that others overrule them.

use super::occupancy::{HELD, UNKNOWN};
use super::pipeline::Gaussian;
use super::schedule::Rng;
use super::view::{Exposure, View};
use crate::counters::Counters;
use crate::mem::Footprint;
use crate::stereo::DepthMap;
use glam::DVec3;
use stipple_drivers::Image;

/// A Gaussian to be: isotropic, at a pixel's depth.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Seed {
    pub p_world: DVec3,
    /// Standard deviation, m.
    pub sigma_m: f64,
    pub opacity: f64,
    /// That it is the colour of.
    pub pixel: u32,
}

impl Seed {
    /// With the colour of its pixel in the exposure of the map.
    pub fn gaussian(&self, planes: &[Image], exposure: Exposure) -> Gaussian {
        let level =
            |plane: &Image| exposure.inverse(f64::from(plane.pixels[self.pixel as usize]) / 255.0).max(0.0) as f32;
        Gaussian {
            mean: self.p_world.as_vec3().to_array(),
            log_scale: [self.sigma_m.ln() as f32; 3],
            quat_xyzw: [0.0, 0.0, 0.0, 1.0],
            opacity_logit: (self.opacity / (1.0 - self.opacity)).ln() as f32,
            colour: std::array::from_fn(|c| level(&planes[c.min(planes.len() - 1)])),
        }
    }
}

/// σ over the spacing of seeds: neighbours meet at about 0.6 of their peak.
pub(super) const SPREAD: f64 = 0.5;
/// Spacing of seeds, px.
pub(super) const SPACING_PX: [f64; 2] = [1.0, 12.0];
/// What stands wrongly before other views hides little of them. At 0.7 and 0.5, on V1_01 at 28 steps a second (scale 2,
/// 60 k): 21.71 dB and 19.74 held out against 23.24 and 21.01; at 150 steps a keyframe (52 k) 30.04 and 23.11 against 30.19
/// and 23.25. At 0.2 and 0.15: 30.00 and 23.15.
const OPACITY_MATCHED: f64 = 0.35;
const OPACITY_FILLED: f64 = 0.25;
/// Density of a filled pixel over that of a matched one: bare walls need few Gaussians.
const DENSITY_FILLED: f64 = 0.5;
/// Gradient, grey levels a pixel, that doubles the density of a flat area.
const GRADIENT_DOUBLES: f64 = 6.0;
/// Neighbours whose inverse depth exceeds the farthest's by this are foreground, and not carried over.
const FOREGROUND: f32 = 1.25;
/// Below this rendered alpha a pixel takes seeds even in an occupied cell.
const SEED_ALPHA: f32 = 0.5;

/// A pixel rendered this far from what was seen takes seeds even in an occupied cell.
const SEED_ERROR: f64 = 0.1;

/// What an anchor sees.
pub struct Seen<'a> {
    /// Grey, or red, green and blue.
    pub planes: &'a [Image],
    pub valid: &'a [u8],
    /// As the raster counts it.
    pub depth: &'a DepthMap,
    /// Rendered before the anchor was added.
    pub alpha: &'a [f32],
    pub colour: &'a [f32],
    /// Of the image; renderings and seeds are in the map's.
    pub exposure: Exposure,
    /// m; zero where nothing was hit.
    pub rendered_depth: &'a [f32],
    pub from: View,
}

impl Seen<'_> {
    pub fn width(&self) -> usize {
        self.planes[0].width
    }

    /// Mean over the channels of |rendered - seen| at a pixel, in the map's exposure.
    pub fn error(&self, i: usize) -> f64 {
        let of = |(channel, plane): (usize, &Image)| {
            let rendered = self.colour[channel * self.alpha.len() + i];
            (f64::from(rendered) - self.exposure.inverse(f64::from(plane.pixels[i]) / 255.0)).abs()
        };
        self.planes.iter().enumerate().map(of).sum::<f64>() / self.planes.len() as f64
    }
}

/// Fractions of a view's valid pixels that the map does not reconstruct.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Missing {
    /// Rendered alpha below `covered_alpha`.
    pub bare: f64,
    /// Covered, and rendered farther than `error` from what is seen, in the exposure of the map.
    pub wrong: f64,
}

impl Missing {
    pub fn of(view: &Seen, covered_alpha: f64, error: f64) -> Missing {
        let (mut bare, mut wrong, mut n) = (0u32, 0u32, 0u32);
        for i in (0..view.valid.len()).filter(|&i| view.valid[i] != 0) {
            n += 1;
            if f64::from(view.alpha[i]) < covered_alpha {
                bare += 1;
            } else {
                wrong += u32::from(view.error(i) > error);
            }
        }
        let part = |k: u32| f64::from(k) / f64::from(n.max(1));
        Missing { bare: part(bare), wrong: part(wrong) }
    }
}

/// Picks seeds; owns the scratch it needs.
pub struct Seeder {
    filled: Vec<f32>,
    /// Seeds wanted a pixel.
    pub(super) density: Vec<f32>,
    /// Index of the nearest matched pixel left, right, above, below; `NONE` without.
    nearest: [Vec<u32>; 4],
    /// Error carried to the row being walked and to the next, one pixel of margin on each side.
    carried: [Vec<f32>; 2],
    pub(super) seeds: Vec<Seed>,
    /// Where each seed is, and whether it is wanted even in an occupied cell.
    points: Vec<[f32; 4]>,
    pub(super) seeds_max: usize,
}

const NONE: u32 = u32::MAX;

impl Seeder {
    pub fn footprint(pixels: usize, seeds_max: usize) -> Footprint {
        let mut f = Footprint::default();
        f.host("map: seeding scratch", pixels * 6 * size_of::<f32>());
        f.host("map: seeds", seeds_max * (size_of::<Seed>() + size_of::<[f32; 4]>()));
        f
    }

    pub fn new(width: usize, height: usize, seeds_max: usize) -> Seeder {
        let n = width * height;
        Seeder {
            filled: vec![0.0; n],
            density: vec![0.0; n],
            nearest: std::array::from_fn(|_| vec![NONE; n]),
            carried: std::array::from_fn(|_| vec![0.0; width + 2]),
            seeds: Vec::with_capacity(seeds_max),
            points: Vec::with_capacity(seeds_max),
            seeds_max,
        }
    }

    /// Picks seeds as dense as `whole` for a view, and answers where they are; `settle` says which of them stay.
    pub fn seed(&mut self, seen: &Seen, whole: usize, counters: &Counters) -> &[[f32; 4]] {
        self.fill(&seen.depth.metres, seen.depth.width);
        self.set_density(seen, self.seeds_max.min(whole));
        self.points.clear();
        self.pick(seen, self.seeds_max, counters, |seeder, x, y| seeder.put(seen, x, y));
        &self.points
    }

    /// Of the picked, at most `room`: those whose cell holds nothing yet, or that the rendering lacks.
    pub fn settle(&mut self, answers: &[u32], room: usize, counters: &Counters) -> &[Seed] {
        let mut kept = 0;
        for i in 0..self.seeds.len() {
            let lacking = self.points[i][3] != 0.0;
            counters.occupancy_full.add(u64::from(answers[i] == UNKNOWN));
            if answers[i] == HELD && !lacking {
                counters.seeds_occupied.add(1);
            } else if kept == room {
                counters.splats_full.add(1);
            } else {
                self.seeds[kept] = self.seeds[i];
                kept += 1;
            }
        }
        self.seeds.truncate(kept);
        &self.seeds
    }

    /// Calls `put` for pixels picked as `density` says, as long as there are fewer than `room` seeds.
    pub(super) fn pick(
        &mut self,
        seen: &Seen,
        room: usize,
        counters: &Counters,
        mut put: impl FnMut(&mut Seeder, usize, usize),
    ) {
        self.seeds.clear();
        let (w, h) = (seen.width(), seen.planes[0].height);
        // The first row inherits what a row above would have left, else a sparse pattern starts late.
        let mut rng = Rng::new(1);
        self.carried[0].fill_with(|| rng.below(1024) as f32 / 1024.0 - 0.5);
        self.carried[1].fill(0.0);
        for y in 0..h {
            for step in 0..w {
                // Alternate rows run backwards, else the pattern leans.
                let x = if y % 2 == 0 { step } else { w - 1 - step };
                let wanted = self.density[y * w + x] + self.carried[0][x + 1];
                let picked = wanted >= 0.5;
                let rest = wanted - if picked { 1.0 } else { 0.0 };
                let (ahead, behind) = if y % 2 == 0 { (x + 2, x) } else { (x, x + 2) };
                self.carried[0][ahead] += rest * (7.0 / 16.0);
                self.carried[1][behind] += rest * (3.0 / 16.0);
                self.carried[1][x + 1] += rest * (5.0 / 16.0);
                self.carried[1][ahead] += rest * (1.0 / 16.0);
                if picked && self.density[y * w + x] > 0.0 {
                    if self.seeds.len() == room {
                        counters.splats_full.add(1);
                    } else {
                        put(self, x, y);
                    }
                }
            }
            self.carried.swap(0, 1);
            self.carried[1].fill(0.0);
        }
    }

    fn put(&mut self, seen: &Seen, x: usize, y: usize) {
        let i = y * seen.width() + x;
        let c = seen.from.camera;
        let matched = seen.depth.metres[i] > 0.0;
        let z = f64::from(if matched { seen.depth.metres[i] } else { self.filled[i] });
        let Some(p_world) = seen.from.point(x, y, z) else { return };
        let lacking = seen.alpha[i] < SEED_ALPHA || seen.error(i) >= SEED_ERROR;
        let [px, py, pz] = p_world.as_vec3().to_array();
        self.points.push([px, py, pz, f32::from(u8::from(lacking))]);
        let spacing_px = (1.0 / f64::from(self.density[i])).sqrt().clamp(SPACING_PX[0], SPACING_PX[1]);
        self.seeds.push(Seed {
            p_world,
            sigma_m: SPREAD * spacing_px * z / c.fx,
            opacity: if matched { OPACITY_MATCHED } else { OPACITY_FILLED },
            pixel: i as u32,
        });
    }

    /// Seeds a pixel, so that a whole uncovered view gets `seeds` of them.
    fn set_density(&mut self, seen: &Seen, seeds: usize) {
        let (w, h) = (seen.width(), seen.planes[0].height);
        let px = |x: usize, y: usize| {
            let sum = seen.planes.iter().map(|p| f64::from(p.pixels[y * w + x])).sum::<f64>();
            sum / seen.planes.len() as f64
        };
        let mut sum = 0.0;
        for y in 0..h {
            for x in 0..w {
                let i = y * w + x;
                let mut weight = 0.0;
                if seen.valid[i] != 0 && self.filled[i] > 0.0 {
                    let (x0, x1) = (x.saturating_sub(1), (x + 1).min(w - 1));
                    let (y0, y1) = (y.saturating_sub(1), (y + 1).min(h - 1));
                    let gradient = 0.5 * (px(x1, y) - px(x0, y)).hypot(px(x, y1) - px(x, y0));
                    weight = 1.0 + gradient / GRADIENT_DOUBLES;
                    if seen.depth.metres[i] <= 0.0 {
                        weight *= DENSITY_FILLED;
                    }
                    sum += weight;
                }
                self.density[i] = weight as f32;
            }
        }
        let scale = (seeds as f64 / f64::max(sum, 1.0)) as f32;
        for i in 0..w * h {
            self.density[i] = (self.density[i] * scale).min(1.0);
        }
    }

    /// Depth where there is a match, else inverse depth carried over from the nearest matches around.
    fn fill(&mut self, metres: &[f32], width: usize) {
        let height = metres.len() / width;
        let [left, right, up, down] = &mut self.nearest;
        for y in 0..height {
            for x in 0..width {
                let i = y * width + x;
                let own = if metres[i] > 0.0 { i as u32 } else { NONE };
                left[i] = if own == NONE && x > 0 { left[i - 1] } else { own };
                up[i] = if own == NONE && y > 0 { up[i - width] } else { own };
            }
        }
        for y in (0..height).rev() {
            for x in (0..width).rev() {
                let i = y * width + x;
                let own = if metres[i] > 0.0 { i as u32 } else { NONE };
                right[i] = if own == NONE && x + 1 < width { right[i + 1] } else { own };
                down[i] = if own == NONE && y + 1 < height { down[i + width] } else { own };
            }
        }
        for i in 0..metres.len() {
            self.filled[i] = if metres[i] > 0.0 {
                metres[i]
            } else {
                let around = self.nearest.each_ref().map(|n| n[i]);
                carried_depth(metres, width, i, around)
            };
        }
    }
}

fn carried_depth(metres: &[f32], width: usize, i: usize, around: [u32; 4]) -> f32 {
    let inverse = |j: u32| 1.0 / metres[j as usize];
    let known = || around.iter().copied().filter(|&j| j != NONE);
    let farthest = known().map(inverse).fold(f32::INFINITY, f32::min);
    let (mut sum, mut weights) = (0.0, 0.0);
    for j in known().filter(|&j| inverse(j) <= FOREGROUND * farthest) {
        let (dx, dy) = ((j as usize % width).abs_diff(i % width), (j as usize / width).abs_diff(i / width));
        let weight = 1.0 / (dx + dy) as f32;
        sum += weight * inverse(j);
        weights += weight;
    }
    if weights > 0.0 {
        weights / sum
    } else {
        0.0
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::occupancy::FREE;
    use super::*;
    use crate::stereo::Pinhole;
    use stipple_drivers::Pose;

    pub const W: usize = 64;
    pub const H: usize = 48;

    pub fn from() -> View {
        let camera = Pinhole { width: W, height: H, fx: 50.0, fy: 50.0, cx: 31.5, cy: 23.5 };
        View { world_from_cam: Pose::IDENTITY, camera, fisheye: None }
    }

    /// Rendered black by a map that is `alpha` opaque.
    fn seen<'a>(image: &'a Image, depth: &'a DepthMap, alpha: &'a [f32]) -> Seen<'a> {
        Seen {
            planes: std::slice::from_ref(image),
            valid: &[1; W * H],
            depth,
            alpha,
            colour: &[0.0; W * H],
            exposure: Exposure::default(),
            rendered_depth: &[0.0; W * H],
            from: from(),
        }
    }

    /// With every cell held as `answer` says.
    fn seed(seeder: &mut Seeder, image: &Image, depth: &DepthMap, alpha: f32, answer: u32) -> Vec<Seed> {
        let n = seeder.seed(&seen(image, depth, &[alpha; W * H]), usize::MAX, &Counters::default()).len();
        seeder.settle(&vec![answer; n], usize::MAX, &Counters::default()).to_vec()
    }

    pub fn flat(z: f32) -> DepthMap {
        DepthMap::of(W, H, vec![z; W * H])
    }

    #[test]
    fn missing_is_what_is_bare_and_what_is_wrong_of_the_valid() {
        let (mut image, depth, mut alpha) = (Image::new(W, H), flat(1.0), [0.9; W * H]);
        image.pixels[..W * H / 4].fill(100);
        alpha[W * H / 8..W * H / 2].fill(0.01);
        let v = seen(&image, &depth, &alpha);
        assert_eq!(Missing::of(&v, 0.05, 0.25), Missing { bare: 3.0 / 8.0, wrong: 1.0 / 8.0 });
        assert_eq!(Missing::of(&v, 0.05, 0.5).wrong, 0.0);
        // At half the gain what is seen as 100 would be 200.
        let dim = Seen { exposure: Exposure { gain: 0.5, offset: 0.0 }, ..v };
        assert_eq!(Missing::of(&dim, 0.05, 0.5).wrong, 1.0 / 8.0);
        let mut half = [1; W * H];
        half[..W * H / 2].fill(0);
        assert_eq!(Missing::of(&Seen { valid: &half, ..dim }, 0.05, 0.25), Missing { bare: 0.0, wrong: 0.0 });
        assert_eq!(Missing::of(&Seen { valid: &[0; W * H], ..dim }, 0.05, 0.25), Missing { bare: 0.0, wrong: 0.0 });
    }

    #[test]
    fn flat_view_is_seeded_evenly_and_within_budget() {
        let mut s = Seeder::new(W, H, 300);
        let seeds = seed(&mut s, &Image::new(W, H), &flat(2.0), 0.0, FREE);
        assert!((270..=300).contains(&seeds.len()), "{}", seeds.len());
        // Every 16x16 block gets its share.
        let mut blocks = [0; 12];
        for k in &seeds {
            let (x, y) = (k.p_world.x / 2.0 * 50.0 + 31.5, k.p_world.y / 2.0 * 50.0 + 23.5);
            blocks[(y / 16.0) as usize * 4 + (x / 16.0) as usize] += 1;
            assert!((k.p_world.z - 2.0).abs() < 1e-6);
        }
        assert!(blocks.iter().all(|n| (20..=30).contains(n)), "{blocks:?}");
    }

    #[test]
    fn detail_is_seeded_denser() {
        let mut image = Image::new(W, H);
        for (i, p) in image.pixels.iter_mut().enumerate() {
            *p = if i % W >= W / 2 && (i % W / 2) % 2 == 0 { 200 } else { 60 };
        }
        let seeds = seed(&mut Seeder::new(W, H, 300), &image, &flat(2.0), 0.0, FREE);
        let right = seeds.iter().filter(|k| k.p_world.x > 0.1).count();
        assert!(right > 3 * (seeds.len() - right), "{right} of {}", seeds.len());
    }

    #[test]
    fn occupied_cells_take_no_seed_unless_bare() {
        let mut s = Seeder::new(W, H, 300);
        let image = Image::new(W, H);
        let first = seed(&mut s, &image, &flat(2.0), 0.0, FREE).len();
        assert_eq!(seed(&mut s, &image, &flat(2.0), 1.0, HELD).len(), 0);
        assert_eq!(seed(&mut s, &image, &flat(2.0), 1.0, UNKNOWN).len(), first);
        assert_eq!(seed(&mut s, &image, &flat(2.0), 0.0, HELD).len(), first);
        let mut wrong = Image::new(W, H);
        wrong.pixels.fill(200);
        assert_eq!(seed(&mut s, &wrong, &flat(2.0), 1.0, HELD).len(), first);
    }

    #[test]
    fn room_is_never_exceeded() {
        let mut s = Seeder::new(W, H, 300);
        let counters = Counters::default();
        let (image, depth) = (Image::new(W, H), flat(1.0));
        let seen = Seen {
            planes: std::slice::from_ref(&image),
            valid: &[1; W * H],
            depth: &depth,
            alpha: &[0.0; W * H],
            colour: &[0.0; W * H],
            exposure: Exposure::default(),
            rendered_depth: &[0.0; W * H],
            from: from(),
        };
        let n = s.seed(&seen, 300, &counters).len();
        assert!((270..=300).contains(&n), "{n}");
        assert_eq!((s.settle(&vec![0; n], 25, &counters).len(), counters.splats_full.get()), (25, n as u64 - 25));
        assert!(s.seed(&seen, 1 << 20, &counters).len() <= 300);
    }

    #[test]
    fn holes_take_the_background() {
        let mut depth = flat(0.0);
        for y in 0..H {
            for x in 0..W {
                depth.metres[y * W + x] = match x {
                    0..=19 => 1.0,
                    20..=39 => 0.0,
                    _ => 3.0,
                };
            }
        }
        let mut s = Seeder::new(W, H, 300);
        s.fill(&depth.metres, W);
        assert!((s.filled[10 * W + 22] - 3.0).abs() < 1e-5);
        assert_eq!(s.filled[10 * W + 5], 1.0);
        // A plane is continued as a plane: inverse depth is linear in the image.
        for y in 0..H {
            for x in 0..W {
                let inv = 0.5 + 0.004 * x as f32;
                depth.metres[y * W + x] = if (20..40).contains(&x) && (10..30).contains(&y) { 0.0 } else { 1.0 / inv };
            }
        }
        s.fill(&depth.metres, W);
        let error = (1.0 / s.filled[20 * W + 25] - (0.5 + 0.004 * 25.0)).abs();
        assert!(error < 0.01, "{error}");
    }
}
