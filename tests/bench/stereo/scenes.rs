//! The hard cases of stereo: pairs drawn of flat patches by rays, with exact disparity. Each has what a
//! matcher may do there in its test (`tests/stereo.rs`) and a picture in the report.

use super::sets::{Pair, Set};
use crate::world::{stream, Noise};
use glam::DVec3;
use stipple_drivers::Image;

pub const WIDTH: usize = 384;
pub const HEIGHT: usize = 240;
/// 26.4 px of disparity at a metre.
pub const FOCAL_PX: f64 = 240.0;
pub const BASELINE_M: f64 = 0.11;
pub const DISPARITIES: u32 = 64;
/// Standard deviation of the sensor's noise, grey levels.
const NOISE: f64 = 1.2;
/// Rays a pixel and side.
const RAYS: usize = 3;

#[derive(Clone, Copy, Debug)]
enum Paint {
    /// Noise of this finest grain, m; two coarser octaves on top.
    Grain(f64),
    Plain,
    /// Upright stripes of this period, m.
    Stripes(f64),
}

/// A parallelogram from `corner` along `u` and `v`, m.
#[derive(Clone, Copy, Debug)]
struct Patch {
    corner: DVec3,
    u: DVec3,
    v: DVec3,
    paint: Paint,
}

impl Patch {
    /// Facing the camera at `z`.
    fn facing(x: [f64; 2], y: [f64; 2], z: f64, paint: Paint) -> Patch {
        let corner = DVec3::new(x[0], y[0], z);
        Patch { corner, u: DVec3::X * (x[1] - x[0]), v: DVec3::Y * (y[1] - y[0]), paint }
    }

    /// Distance along the ray in units of `ray`, and where on the patch, m.
    fn meet(&self, from: DVec3, ray: DVec3) -> Option<(f64, [f64; 2])> {
        let normal = self.u.cross(self.v);
        let t = (self.corner - from).dot(normal) / ray.dot(normal);
        let p = from + ray * t - self.corner;
        let (a, b) = (p.dot(self.u) / self.u.length_squared(), p.dot(self.v) / self.v.length_squared());
        let inside = t > 1e-3 && (0.0..=1.0).contains(&a) && (0.0..=1.0).contains(&b);
        inside.then(|| (t, [a * self.u.length(), b * self.v.length()]))
    }
}

impl Paint {
    /// 0..1 at a place on patch `seed`.
    fn albedo(self, seed: u64, [a, b]: [f64; 2]) -> f64 {
        match self {
            Paint::Plain => 0.5,
            Paint::Stripes(period) => 0.5 + 0.35 * (a / period * std::f64::consts::TAU).sin(),
            Paint::Grain(cell) => {
                let octave = |k: u64| lattice(seed * 8 + k, a / cell / (1 << k) as f64, b / cell / (1 << k) as f64);
                (0.3 * octave(0) + 0.4 * octave(1) + 0.5 * octave(3) - 0.1).clamp(0.02, 0.98)
            }
        }
    }
}

/// Smooth noise, 0..1, of cells of one.
fn lattice(seed: u64, x: f64, y: f64) -> f64 {
    let corner = |i: f64, j: f64| {
        let at = (i as i64 as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (j as i64 as u64).rotate_left(32);
        stream(seed, at).uniform()
    };
    let (i, j) = (x.floor(), y.floor());
    let ease = |t: f64| t * t * (3.0 - 2.0 * t);
    let (s, t) = (ease(x - i), ease(y - j));
    let row = |j: f64| corner(i, j) * (1.0 - s) + corner(i + 1.0, j) * s;
    row(j) * (1.0 - t) + row(j + 1.0) * t
}

/// The nearest patch along a ray: which, how far, and where on it.
fn nearest(patches: &[Patch], from: DVec3, ray: DVec3) -> Option<(usize, f64, [f64; 2])> {
    let met = patches.iter().enumerate().filter_map(|(i, p)| p.meet(from, ray).map(|(t, at)| (i, t, at)));
    met.min_by(|a, b| a.1.total_cmp(&b.1))
}

/// The ray of a pixel, fractions included; the image's centre is the axis.
fn ray(x: f64, y: f64) -> DVec3 {
    DVec3::new((x - (WIDTH - 1) as f64 / 2.0) / FOCAL_PX, (y - (HEIGHT - 1) as f64 / 2.0) / FOCAL_PX, 1.0)
}

/// Seen from `from`, with rows `lower` px too low and `gain` times the light.
fn draw(patches: &[Patch], from: DVec3, lower: f64, gain: f64, noise: &mut Noise) -> Image {
    let mut image = Image::new(WIDTH, HEIGHT);
    for (i, px) in image.pixels.iter_mut().enumerate() {
        let (x, y) = ((i % WIDTH) as f64, (i / WIDTH) as f64 - lower);
        let mut sum = 0.0;
        for k in 0..RAYS * RAYS {
            let off = |k: usize| (k as f64 + 0.5) / RAYS as f64 - 0.5;
            let hit = nearest(patches, from, ray(x + off(k % RAYS), y + off(k / RAYS)));
            sum += hit.map_or(0.1, |(i, _, at)| patches[i].paint.albedo(i as u64, at));
        }
        let level = 215.0 * gain * sum / (RAYS * RAYS) as f64 + NOISE * noise.normal();
        *px = level.round().clamp(0.0, 255.0) as u8;
    }
    image
}

/// Disparity where something is, and whether the right eye sees it too.
fn truth(patches: &[Patch]) -> (Vec<f32>, Vec<bool>) {
    let right = DVec3::X * BASELINE_M;
    let of = |i: usize| {
        let r = ray((i % WIDTH) as f64, (i / WIDTH) as f64);
        let Some((_, z, _)) = nearest(patches, DVec3::ZERO, r) else { return (-1.0, false) };
        let d = FOCAL_PX * BASELINE_M / z;
        let back = nearest(patches, right, r * z - right);
        let seen = (i % WIDTH) as f64 >= d && back.is_some_and(|(_, t, _)| (t - 1.0).abs() < 1e-3);
        (d as f32, seen)
    };
    (0..WIDTH * HEIGHT).map(of).unzip()
}

/// What is wrong with the right camera.
#[derive(Clone, Copy)]
struct RightCamera {
    lower_px: f64,
    gain: f64,
}

const FAIR: RightCamera = RightCamera { lower_px: 0.0, gain: 1.0 };
const GRAIN: Paint = Paint::Grain(0.012);

fn pair(name: &'static str, about: &'static str, patches: &[Patch], camera: RightCamera) -> Set {
    let mut noise = stream(3, 1);
    let left = draw(patches, DVec3::ZERO, 0.0, 0.9, &mut noise);
    let right = draw(patches, DVec3::X * BASELINE_M, camera.lower_px, 0.9 * camera.gain, &mut noise);
    let (truth, visible) = truth(patches);
    Set {
        name: name.to_string(),
        about: about.to_string(),
        pairs: vec![Pair { left, right, truth, visible }],
        disparities: DISPARITIES,
        focal_baseline: Some(FOCAL_PX * BASELINE_M),
    }
}

fn wall(z: f64) -> Patch {
    Patch::facing([-4.0, 4.0], [-3.0, 3.0], z, GRAIN)
}

/// Upright poles of 1, 2, 3, 4 and 6 px at 1.2 m.
fn poles() -> Vec<Patch> {
    let wide = [1.0, 2.0, 3.0, 4.0, 6.0].map(|px: f64| px * 1.2 / FOCAL_PX);
    let at = |i: usize| Patch::facing([0.3 * i as f64 - 0.6, 0.3 * i as f64 - 0.6 + wide[i]], [-1.0, 1.0], 1.2, GRAIN);
    (0..wide.len()).map(at).chain([wall(3.0)]).collect()
}

fn box_before_wall() -> Vec<Patch> {
    vec![Patch::facing([-0.35, 0.35], [-0.25, 0.3], 1.0, GRAIN), wall(3.0)]
}

fn floor() -> Patch {
    let corner = DVec3::new(-6.0, 0.7, 1.0);
    Patch { corner, u: DVec3::X * 12.0, v: DVec3::Z * 11.0, paint: Paint::Grain(0.02) }
}

/// The hard cases, by the names that tests and report have for them.
pub fn hard() -> Vec<Set> {
    let plain = [Patch::facing([-0.9, 0.9], [-0.55, 0.55], 1.999, Paint::Plain), wall(2.0)];
    // A period of 14 px at 2 m: every disparity has as good a one beside it.
    let stripes = Paint::Stripes(14.0 * 2.0 / FOCAL_PX);
    let repeated = [Patch::facing([-0.9, 0.9], [-0.55, 0.55], 1.999, stripes), wall(2.0)];
    let mut dark = pair("hard_black_eye", "the right eye is covered", &box_before_wall(), FAIR);
    dark.pairs[0].right = draw(&[], DVec3::ZERO, 0.0, 0.0, &mut stream(3, 2));
    vec![
        pair("hard_textureless", "a plain wall within a grained one, at 2 m", &plain, FAIR),
        pair("hard_repeated", "stripes of 14 px on a grained wall, at 2 m", &repeated, FAIR),
        pair("hard_slanted", "a floor 0.7 m below, from 1.4 to 12 m", &[floor(), wall(12.0)], FAIR),
        pair("hard_thin", "poles of 1, 2, 3, 4 and 6 px at 1.2 m before a wall at 3 m", &poles(), FAIR),
        pair("hard_occlusion", "a box at 1 m before a wall at 3 m", &box_before_wall(), FAIR),
        pair("hard_exposure", "half the light in the right eye", &box_before_wall(), RightCamera { gain: 0.5, ..FAIR }),
        pair(
            "hard_misaligned",
            "the right eye's rows 1 px low",
            &box_before_wall(),
            RightCamera { lower_px: 1.0, ..FAIR },
        ),
        dark,
    ]
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// Where both eyes see a surface, the pixel in the right image is as bright, wherever the disparity is whole.
    #[test]
    fn pixels_lie_where_the_truth_says() {
        for Set { name, pairs, .. } in hard() {
            let set = &pairs[0];
            let compared = name != "hard_exposure" && name != "hard_misaligned" && name != "hard_black_eye";
            let (mut off, mut n) = (0.0, 0);
            for i in 0..WIDTH * HEIGHT {
                let d = set.truth[i];
                if set.visible[i] && compared && (d - d.round()).abs() < 0.05 {
                    let j = i - d.round() as usize;
                    off += (f64::from(set.left.pixels[i]) - f64::from(set.right.pixels[j])).abs();
                    n += 1;
                }
            }
            assert!(n == 0 || off / f64::from(n) < 6.0, "{name}: {} of {n}", off / f64::from(n));
        }
    }

    #[test]
    fn what_a_near_box_hides_is_not_visible() {
        let set = hard().into_iter().find(|s| s.name == "hard_occlusion").unwrap().pairs.remove(0);
        // Left of the box the right eye sees the box: 26.4 - 8.8 px of the wall are hidden.
        let row = 120 * WIDTH;
        let hidden = (row..row + WIDTH).filter(|&i| i % WIDTH > 20 && !set.visible[i]).count();
        assert!((17..=19).contains(&hidden), "{hidden}");
        assert!((set.truth[row + WIDTH / 2] - 26.4).abs() < 1e-3);
    }
}
