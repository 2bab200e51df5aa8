//! Matching of drawn pairs whose disparity is known, the hard cases among them, and of Middlebury's.

use super::stereo::{open, run, shape};
use std::path::{Path, PathBuf};
use stipple::stereo::sgm::Shape;
use stipple_drivers::Image;

/// A textured plane, seen within a rectangle of the left image. Disparity a + b x + c y.
#[derive(Clone, Copy)]
pub struct Layer {
    pub plane: [f64; 3],
    /// x from, x to, y from, y to.
    pub within: [f64; 4],
    pub texture: Texture,
}

#[derive(Clone, Copy)]
pub enum Texture {
    /// Noise of several scales.
    Rough,
    /// One grey level.
    Blank,
    /// Vertical stripes of this period, px.
    Stripes(f64),
}

#[derive(Clone)]
pub struct Scene {
    pub width: usize,
    pub height: usize,
    /// The last is in front.
    pub layers: Vec<Layer>,
}

const ALL: [f64; 4] = [-1e6, 1e6, -1e6, 1e6];

impl Scene {
    pub fn of(width: usize, height: usize, plane: [f64; 3], texture: Texture) -> Scene {
        Scene { width, height, layers: vec![Layer { plane, within: ALL, texture }] }
    }

    pub fn with(mut self, plane: [f64; 3], within: [f64; 4], texture: Texture) -> Scene {
        self.layers.push(Layer { plane, within, texture });
        self
    }

    /// A wall with a box before it.
    pub fn steps(width: usize, height: usize) -> Scene {
        let (w, h) = (width as f64, height as f64);
        Scene::of(width, height, [3.3, 0.0, 0.0], Texture::Rough).with(
            [9.6, 0.0, 0.0],
            [0.4 * w, 0.7 * w, 0.3 * h, 0.8 * h],
            Texture::Rough,
        )
    }

    /// Grey level and left position of what side 0 or 1 sees at (x, y).
    pub fn seen(&self, side: usize, x: f64, y: f64) -> (f64, f64, f64) {
        let mut front = (0.0, x, 0.0);
        for (k, layer) in self.layers.iter().enumerate() {
            let [a, b, c] = layer.plane;
            let left = if side == 0 { x } else { (x + a + c * y) / (1.0 - b) };
            let [x0, x1, y0, y1] = layer.within;
            if (x0..x1).contains(&left) && (y0..y1).contains(&y) {
                front = (layer.texture.level(left, y, k), left, a + b * left + c * y);
            }
        }
        front
    }

    /// Disparity of a left pixel, and whether the right image sees it too.
    pub fn truth(&self, x: usize, y: usize) -> (f64, bool) {
        let (_, _, d) = self.seen(0, x as f64, y as f64);
        let (_, left, _) = self.seen(1, x as f64 - d, y as f64);
        (d, (left - x as f64).abs() < 0.5 && x as f64 >= d)
    }
}

impl Texture {
    fn level(self, x: f64, y: f64, seed: usize) -> f64 {
        match self {
            Texture::Blank => 120.0,
            Texture::Stripes(period) => 128.0 + 70.0 * (x / period * std::f64::consts::TAU).sin(),
            Texture::Rough => {
                let octaves = [(2.3, 45.0), (5.1, 50.0), (17.0, 60.0)];
                let of = |(n, (scale, contrast)): (usize, (f64, f64))| {
                    contrast * (lattice(x / scale, y / scale, 10 * seed + n) - 0.5)
                };
                128.0 + octaves.into_iter().enumerate().map(of).sum::<f64>()
            }
        }
    }
}

/// Noise in 0..1, linear between the points of a lattice.
fn lattice(x: f64, y: f64, seed: usize) -> f64 {
    let (x0, y0) = (x.floor(), y.floor());
    let at = |i: f64, j: f64| {
        let mut r = super::splat::Rng(((x0 + i) as i64 as u64) << 32 ^ ((y0 + j) as i64 as u64) << 8 ^ seed as u64);
        r.uniform(0.0, 1.0);
        r.uniform(0.0, 1.0)
    };
    let (u, v) = (x - x0, y - y0);
    let mix = |a: f64, b: f64, t: f64| a + (b - a) * t;
    mix(mix(at(0.0, 0.0), at(1.0, 0.0), u), mix(at(0.0, 1.0), at(1.0, 1.0), u), v)
}

/// Both images, with noise of a grey level.
pub fn draw(scene: &Scene, seed: u64) -> (Image, Image) {
    let mut r = super::splat::Rng(seed);
    let mut image = |side| {
        let mut image = Image::new(scene.width, scene.height);
        for (i, px) in image.pixels.iter_mut().enumerate() {
            let (x, y) = ((i % scene.width) as f64, (i / scene.width) as f64);
            let noise = r.uniform(-1.0, 1.0) + r.uniform(-1.0, 1.0);
            *px = (scene.seen(side, x, y).0 + noise).round().clamp(0.0, 255.0) as u8;
        }
        image
    };
    (image(0), image(1))
}

#[derive(Clone, Copy, Debug)]
pub struct Score {
    pub bad1: f64,
    pub bad2: f64,
    pub mean: f64,
    pub density: f64,
}

/// Errors in percent, of the pixels whose truth is given; mean in px.
pub fn score(disparity: &[f32], truth: &[Option<f64>]) -> Score {
    let asked = truth.iter().flatten().count().max(1) as f64;
    let both = disparity.iter().zip(truth).filter(|(d, _)| **d >= 0.0);
    let errors: Vec<f64> = both.filter_map(|(d, t)| t.map(|t| (f64::from(*d) - t).abs())).collect();
    let n = errors.len().max(1) as f64;
    let above = |limit: f64| 100.0 * errors.iter().filter(|e| **e > limit).count() as f64 / n;
    let mean = errors.iter().sum::<f64>() / n;
    Score { bad1: above(1.0), bad2: above(2.0), mean, density: 100.0 * errors.len() as f64 / asked }
}

/// Truth of the pixels for which `of` holds, given whether both eyes see them.
fn truth(scene: &Scene, of: impl Fn(usize, usize, bool) -> bool) -> Vec<Option<f64>> {
    (0..scene.width * scene.height)
        .map(|i| {
            let (x, y) = (i % scene.width, i / scene.width);
            let (d, both) = scene.truth(x, y);
            of(x, y, both).then_some(d)
        })
        .collect()
}

const W: usize = 160;
const H: usize = 100;

fn matched(scene: &Scene, wls: bool, change: impl Fn(&mut Image)) -> Vec<f32> {
    let (mut gpu, mut sgm) = open(Shape { wls, ..shape(W, H, 32) });
    let (left, mut right) = draw(scene, 2);
    change(&mut right);
    run(&mut gpu, &mut sgm, &left, &right).0
}

fn both_eyes(_: usize, _: usize, both: bool) -> bool {
    both
}

#[test]
fn slanted_floor_is_followed_to_a_part_of_a_pixel() {
    let scene = Scene::of(W, H, [4.0, 0.03, 0.18], Texture::Rough);
    for wls in [false, true] {
        let s = score(&matched(&scene, wls, |_| ()), &truth(&scene, both_eyes));
        println!("slanted floor, wls {wls}: {s:?}");
        assert!(s.bad1 < 1.0 && s.mean < 0.13 && s.density > 95.0, "{s:?}");
    }
}

#[test]
fn thin_things_are_found_or_unknown() {
    let mut scene = Scene::of(W, H, [4.0, 0.0, 0.0], Texture::Rough);
    for x in [40.0, 80.0, 120.0] {
        scene = scene.with([14.0, 0.0, 0.0], [x, x + 5.0, 0.0, H as f64], Texture::Rough);
    }
    let pole = |x: usize, _, both| both && scene.truth(x, 0).0 > 10.0;
    let s = score(&matched(&scene, false, |_| ()), &truth(&scene, pole));
    println!("poles 5 px wide: {s:?}");
    assert!(s.bad1 < 25.0 && s.density > 35.0, "{s:?}");
}

#[test]
fn what_one_eye_sees_is_unknown_and_filled_from_behind() {
    let scene = Scene::steps(W, H);
    // Right of the strip that only the left eye has in view.
    let hidden = truth(&scene, |x, _, both| !both && x > 40);
    let s = score(&matched(&scene, false, |_| ()), &hidden);
    println!("hidden: {s:?}");
    assert!(s.density < 25.0, "{s:?}");
    let s = score(&matched(&scene, true, |_| ()), &hidden);
    println!("hidden, filled: {s:?}");
    assert!(s.bad2 < 10.0 && s.density == 100.0, "{s:?}");
    let s = score(&matched(&scene, true, |_| ()), &truth(&scene, |_, _, _| true));
    println!("the whole view, filled: {s:?}");
    assert!(s.bad1 < 1.5 && s.bad2 < 1.0 && s.density == 100.0, "{s:?}");
}

#[test]
fn exposure_of_one_eye_does_not_matter() {
    let scene = Scene::steps(W, H);
    let seen = truth(&scene, both_eyes);
    let plain = score(&matched(&scene, true, |_| ()), &seen);
    // Twice as bright also burns out what is above 127.
    for gain in [0.5, 2.0] {
        let expose = |i: &mut Image| i.pixels.iter_mut().for_each(|p| *p = (f64::from(*p) * gain).min(255.0) as u8);
        let s = score(&matched(&scene, true, expose), &seen);
        println!("exposure x{gain}: {s:?} against {plain:?}");
        assert!(s.bad1 < plain.bad1 + if gain < 1.0 { 0.5 } else { 4.0 }, "{s:?} against {plain:?}");
    }
}

#[test]
fn nothing_is_made_up() {
    let blank = Scene::of(W, H, [8.0, 0.0, 0.0], Texture::Blank);
    let stripes = Scene::of(W, H, [9.0, 0.0, 0.0], Texture::Stripes(9.0));
    let rough = Scene::steps(W, H);
    let known = |scene: &Scene, wls: bool, change: &dyn Fn(&mut Image)| {
        score(&matched(scene, wls, change), &truth(scene, both_eyes)).density
    };
    for wls in [false, true] {
        let d = [&blank, &stripes].map(|scene| known(scene, wls, &|_| ()));
        println!("known of a blank wall, of stripes: {d:?} %");
        assert_eq!(d, [0.0, 0.0]);
    }
    let d = known(&rough, false, &|i| i.pixels.fill(0));
    println!("known with one eye black: {d:?} %");
    assert!(d < 0.5);
}

fn grey_png(path: &Path) -> Image {
    let file = std::io::BufReader::new(std::fs::File::open(path).unwrap());
    let mut reader = png::Decoder::new(file).read_info().unwrap();
    let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut bytes).unwrap();
    let of = |c: &[u8]| (299 * u32::from(c[0]) + 587 * u32::from(c[1]) + 114 * u32::from(c[2]) + 500) / 1000;
    let pixels = bytes.chunks(3).map(|c| of(c) as u8).collect();
    Image { width: info.width as usize, height: info.height as usize, pixels }
}

/// A Middlebury pair with its truth, where there are recordings.
fn middlebury(name: &str) -> Option<(Image, Image, Vec<Option<f64>>)> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let folder = std::env::var_os("STIPPLE_RECORDINGS").map_or(beside, PathBuf::from).join(name);
    let stored = std::fs::read(folder.join("disp2.pgm")).ok()?;
    let (left, right) = (grey_png(&folder.join("im2.png")), grey_png(&folder.join("im6.png")));
    let quarters = &stored[stored.len() - left.pixels.len()..];
    let truth = quarters.iter().map(|v| (*v > 0).then_some(f64::from(*v) / 4.0)).collect();
    Some((left, right, truth))
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn cones_and_teddy_beat_semi_global_block_matching() {
    // OpenCV 5's SGBM (blocks of 3 px, the view padded by 64 px) with ximgproc's filter (lambda 1000, sigma 1): its best
    // settings for each pair, of five directions and of three.
    let filtered = [
        Score { bad1: 10.45, bad2: 8.07, mean: 0.781, density: 99.78 },
        Score { bad1: 12.57, bad2: 7.09, mean: 0.661, density: 99.93 },
    ];
    for (name, rival) in ["middlebury_cones", "middlebury_teddy"].into_iter().zip(filtered) {
        let Some((left, right, truth)) = middlebury(name) else {
            return println!("ignored: cones_and_teddy_beat_semi_global_block_matching: no recording {name}");
        };
        for wls in [false, true] {
            let (mut gpu, mut sgm) = open(Shape { wls, ..shape(left.width, left.height, 64) });
            let (disparity, deviation) = run(&mut gpu, &mut sgm, &left, &right);
            let s = score(&disparity, &truth);
            let residuals = disparity.iter().zip(&deviation).zip(&truth).filter(|((d, _), _)| **d >= 0.0);
            let near = residuals.filter_map(|((d, v), t)| t.map(|t| (f64::from(*d) - t, f64::from(*v))));
            let near: Vec<_> = near.filter(|(e, _)| e.abs() <= 3.0).map(|(e, v)| (e / v).powi(2)).collect();
            let variance = near.iter().sum::<f64>() / near.len() as f64;
            println!("{name}, wls {wls}: {s:?}, variance of residuals {variance:.2}");
            for t in gpu.timings().iter().filter(|t| t.count > 0) {
                println!("  {}: {:.1} ms x {}", t.name, t.total_ms, t.count);
            }
            let better = s.bad1 < rival.bad1 && s.bad2 < rival.bad2 && s.mean < rival.mean;
            assert!(better && (!wls || s.density >= rival.density), "{s:?}");
        }
    }
}
