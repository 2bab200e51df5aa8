//! Seeds of an anchor keyframe: where its view is uncovered, Gaussians are put on the stereo depth.
//!
//! Pixels are picked by error diffusion of a density that follows the image gradient: denser on detail, and the spacing is
//! known, so the size of a Gaussian is the distance to its neighbours. Where there is only filled-in depth, seeds are few
//! and faint, so that others overrule them; where depth is uncertain, as on a wall that is far away, they are faint. Filled-in
//! depth has no deviation of its own, and its seeds are as faint beside uncertain matches as beside others.

use super::coverage::KeyframeView;
use super::depth_fill::DepthFill;
use super::diffusion::Diffusion;
use super::exposure::Exposure;
use super::occupancy::{HELD, UNKNOWN};
use super::pool::Gaussian;
use crate::counters::Counters;
use glam::DVec3;
use stipple_drivers::Image;

/// A Gaussian to be: isotropic, at a pixel's depth.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Seed {
    pub p_world: DVec3,
    /// Standard deviation, m.
    pub sigma_m: f64,
    pub opacity: f64,
    /// Whose colour it has.
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
pub const SPREAD: f64 = 0.5;
/// Spacing of seeds, px.
pub const SPACING_PX: [f64; 2] = [1.0, 12.0];
/// Faint: what stands wrongly before other views hides little of them.
const OPACITY_MATCHED: f64 = 0.35;
const OPACITY_FILLED: f64 = 0.25;
/// Standard deviation of depth, m, above which a Gaussian begins with less opacity, and the least part of it that is left.
const SIGMA_SURE_M: f64 = 0.2;
const FAINTEST: f64 = 0.1;
/// Density of a filled pixel over that of a matched one: bare walls need few Gaussians.
const DENSITY_FILLED: f64 = 0.5;
/// Gradient, grey levels a pixel, that doubles the density of a flat area.
const GRADIENT_DOUBLES: f64 = 6.0;
/// Below this rendered alpha a pixel takes seeds even in an occupied cell.
const SEED_ALPHA: f32 = 0.5;
/// A pixel rendered this far from what was seen takes seeds even in an occupied cell. Not where an earlier visit left Gaussians:
/// in other light nearly all is a little wrong, and only what is `map.wrong_error` off takes seeds.
const SEED_ERROR: f32 = 0.1;

/// Opacity that a Gaussian begins with where depth has the standard deviation `sigma_m`. Gaussians of a wall that is far away lie
/// before it and behind it. Behind a thin wall they stand in the next room, and hide the wall from the views there.
pub fn initial_opacity(opacity: f64, sigma_m: f32) -> f64 {
    opacity * (SIGMA_SURE_M / f64::from(sigma_m)).clamp(FAINTEST, 1.0)
}

/// Picks seeds; owns the scratch it needs.
pub struct Seeder {
    fill: DepthFill,
    /// Where each seed is, and how far its pixel is rendered from what was seen; infinite where it is not covered.
    points: Vec<[f32; 4]>,
    seeds: Vec<Seed>,
    seeds_max: usize,
    wrong_error: f32,
}

impl Seeder {
    pub fn new(width: usize, height: usize, seeds_max: usize, wrong_error: f64) -> Seeder {
        Seeder {
            fill: DepthFill::new(width, height),
            points: Vec::with_capacity(seeds_max),
            seeds: Vec::with_capacity(seeds_max),
            seeds_max,
            wrong_error: wrong_error as f32,
        }
    }

    /// Picks seeds as dense as `whole` for a view, and answers where they are; `keep` says which of them stay.
    pub fn seed(
        &mut self,
        seen: &KeyframeView,
        whole: usize,
        diffusion: &mut Diffusion,
        counters: &Counters,
    ) -> &[[f32; 4]] {
        self.fill.fill(seen.depth);
        self.set_density(seen, self.seeds_max.min(whole), diffusion);
        self.points.clear();
        self.seeds.clear();
        diffusion.pick(|x, y, density| {
            if self.seeds.len() == self.seeds_max {
                counters.splats_full.add(1);
            } else {
                self.put(seen, x, y, density);
            }
        });
        &self.points
    }

    /// Keeps at most `room` of the picked: those whose cell holds nothing yet, neither by `answers` nor by what `earlier` visits
    /// left, and those that the rendering lacks. Answers them, and how many of them are where earlier visits left something.
    pub fn keep(&mut self, answers: &[u32], earlier: &[u32], room: usize, counters: &Counters) -> (&[Seed], usize) {
        let (mut kept, mut again) = (0, 0);
        for i in 0..self.seeds.len() {
            counters.occupancy_full.add(u64::from(answers[i] == UNKNOWN));
            let error_min = match (answers[i], earlier[i]) {
                (_, HELD) => self.wrong_error,
                (HELD, _) => SEED_ERROR,
                _ => 0.0,
            };
            if self.points[i][3] < error_min {
                counters.seeds_occupied.add(1);
            } else if kept == room {
                counters.splats_full.add(1);
            } else {
                self.seeds[kept] = self.seeds[i];
                kept += 1;
                again += usize::from(earlier[i] == HELD);
            }
        }
        self.seeds.truncate(kept);
        (&self.seeds, again)
    }

    fn put(&mut self, seen: &KeyframeView, x: usize, y: usize, density: f32) {
        let i = y * seen.width() + x;
        let matched = seen.depth[i] > 0.0;
        let z = f64::from(self.fill.metres[i]);
        let Some(p_world) = seen.view.point(x, y, z) else { return };
        let covered = seen.rendered.alpha[i] >= SEED_ALPHA;
        let error = if covered { seen.error(i) as f32 } else { f32::INFINITY };
        let [px, py, pz] = p_world.as_vec3().to_array();
        self.points.push([px, py, pz, error]);
        let spacing_px = (1.0 / f64::from(density)).sqrt().clamp(SPACING_PX[0], SPACING_PX[1]);
        self.seeds.push(Seed {
            p_world,
            sigma_m: SPREAD * spacing_px * z / seen.view.camera.fx,
            opacity: if matched { initial_opacity(OPACITY_MATCHED, seen.depth_sigma_m[i]) } else { OPACITY_FILLED },
            pixel: i as u32,
        });
    }

    /// Seeds a pixel, so that a whole uncovered view gets `seeds` of them.
    fn set_density(&self, seen: &KeyframeView, seeds: usize, diffusion: &mut Diffusion) {
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
                if seen.valid[i] != 0 && self.fill.metres[i] > 0.0 {
                    let (x0, x1) = (x.saturating_sub(1), (x + 1).min(w - 1));
                    let (y0, y1) = (y.saturating_sub(1), (y + 1).min(h - 1));
                    let gradient = 0.5 * (px(x1, y) - px(x0, y)).hypot(px(x, y1) - px(x, y0));
                    weight = 1.0 + gradient / GRADIENT_DOUBLES;
                    if seen.depth[i] <= 0.0 {
                        weight *= DENSITY_FILLED;
                    }
                    sum += weight;
                }
                diffusion.density[i] = weight as f32;
            }
        }
        diffusion.scale(seeds, f64::max(sum, 1.0));
    }
}

#[cfg(test)]
mod tests {
    use super::super::coverage::tests::{black, seen, H, W};
    use super::super::occupancy::FREE;
    use super::*;

    const FAR: [f32; W * H] = [2.0; W * H];

    /// With a map that is black and `alpha` opaque, and every cell held as `answer` says.
    fn seed(image: &Image, alpha: f32, answer: u32) -> Vec<Seed> {
        let (mut s, mut d, counters) = (Seeder::new(W, H, 300, 0.25), Diffusion::new(W, H), Counters::default());
        let n = s.seed(&seen(image, &FAR, &black(&[alpha; W * H])), usize::MAX, &mut d, &counters).len();
        s.keep(&vec![answer; n], &vec![FREE; n], usize::MAX, &counters).0.to_vec()
    }

    #[test]
    fn where_earlier_visits_left_something_only_what_is_quite_wrong_is_kept() {
        let (mut s, mut d, counters) = (Seeder::new(W, H, 300, 0.25), Diffusion::new(W, H), Counters::default());
        // A quarter each is right, a little wrong and quite wrong, and uncovered.
        let mut image = Image::new(W, H);
        image.pixels[W * H / 4..W * H / 2].fill(40);
        image.pixels[W * H / 2..W * H * 3 / 4].fill(100);
        let alpha: Vec<f32> = (0..W * H).map(|i| if i < W * H * 3 / 4 { 1.0 } else { 0.0 }).collect();
        let mut kept = |answer: u32, earlier: u32| {
            let n = s.seed(&seen(&image, &FAR, &black(&alpha)), usize::MAX, &mut d, &counters).len();
            let (seeds, again) = s.keep(&vec![answer; n], &vec![earlier; n], usize::MAX, &counters);
            let rows = seeds.iter().map(|seed| seed.pixel as usize / (W * H / 4));
            let mut of = [false; 4];
            rows.for_each(|quarter| of[quarter] = true);
            assert_eq!(again, if earlier == HELD { seeds.len() } else { 0 });
            of
        };
        assert_eq!(kept(FREE, FREE), [true; 4]);
        assert_eq!(kept(HELD, FREE), [false, true, true, true]);
        assert_eq!(kept(HELD, HELD), [false, false, true, true]);
        assert_eq!(kept(FREE, HELD), [false, false, true, true]);
    }

    #[test]
    fn uncertain_depth_makes_faint_seeds() {
        let opacities = [0.0, 0.2, 0.4, 1e9, f32::INFINITY].map(|sigma_m| initial_opacity(0.5, sigma_m));
        assert_eq!(opacities.map(|o| (1e4 * o).round()), [5000.0, 5000.0, 2500.0, 500.0, 500.0]);
        let (image, rendered) = (Image::new(W, H), black(&[0.0; W * H]));
        let view = KeyframeView { depth_sigma_m: &[0.8; W * H], ..seen(&image, &FAR, &rendered) };
        let (mut s, mut d) = (Seeder::new(W, H, 300, 0.25), Diffusion::new(W, H));
        assert!(s.seed(&view, 300, &mut d, &Counters::default()).len() > 100);
        assert!(s.seeds.iter().all(|k| (k.opacity - 0.25 * OPACITY_MATCHED).abs() < 1e-6));
    }

    #[test]
    fn flat_view_is_seeded_evenly_and_within_budget() {
        let seeds = seed(&Image::new(W, H), 0.0, FREE);
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
        let seeds = seed(&image, 0.0, FREE);
        let right = seeds.iter().filter(|k| k.p_world.x > 0.1).count();
        assert!(right > 3 * (seeds.len() - right), "{right} of {}", seeds.len());
    }

    #[test]
    fn occupied_cells_take_no_seed_unless_uncovered_or_mismatched() {
        let image = Image::new(W, H);
        let first = seed(&image, 0.0, FREE).len();
        assert_eq!(seed(&image, 1.0, HELD).len(), 0);
        assert_eq!(seed(&image, 1.0, UNKNOWN).len(), first);
        assert_eq!(seed(&image, 0.0, HELD).len(), first);
        let mut wrong = Image::new(W, H);
        wrong.pixels.fill(200);
        assert_eq!(seed(&wrong, 1.0, HELD).len(), first);
    }

    #[test]
    fn room_is_never_exceeded() {
        let (mut s, mut d, counters) = (Seeder::new(W, H, 300, 0.25), Diffusion::new(W, H), Counters::default());
        let (image, rendered) = (Image::new(W, H), black(&[0.0; W * H]));
        let v = seen(&image, &FAR, &rendered);
        let n = s.seed(&v, 300, &mut d, &counters).len();
        assert!((270..=300).contains(&n), "{n}");
        let (kept, _) = s.keep(&vec![FREE; n], &vec![FREE; n], 25, &counters);
        assert_eq!((kept.len(), counters.splats_full.get()), (25, n as u64 - 25));
        assert!(s.seed(&v, 1 << 20, &mut d, &counters).len() <= 300);
    }
}
