//! The splat kernels: each stage against its twin, the twins against finite differences, and what must hold
//! whatever the picture: determinism, capacity, bad input, odd sizes, convergence.

pub use super::twins::compare::STILL;
use super::twins::compare::{compare, SSIM};
use super::twins::{self, project::Parameters};
use glam::{DQuat, DVec3};
use stipple::config::GpuConfig;
use stipple::gpu::{Gpu, GpuOptions};
use stipple::map::{
    Coarseness, Exposure, Gaussian, LearningRates, Pipeline, PruneRule, Rendered, Shape, StepStats, Target, Tiling,
    View, Weights,
};
use stipple::stereo::Pinhole;
use stipple_drivers::Pose;

/// SplitMix64.
pub struct Rng(pub u64);

impl Rng {
    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        low + (high - low) * ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }
}

pub fn view(width: usize, height: usize) -> View {
    let f = 0.8 * width.max(height) as f64;
    let camera =
        Pinhole { width, height, fx: f, fy: 1.1 * f, cx: 0.5 * width as f64 - 0.3, cy: 0.5 * height as f64 + 0.4 };
    let q = DQuat::from_scaled_axis(DVec3::new(0.3, -0.5, 0.2));
    View::new(Pose::new(q, DVec3::new(1.0, -2.0, 0.5)), camera, None)
}

/// Gaussians in and a little outside the view, some behind the camera.
pub fn scene(n: usize, view: &View, seed: u64) -> Vec<Gaussian> {
    let mut r = Rng(seed);
    let c = &view.camera;
    (0..n)
        .map(|_| {
            let z = if r.uniform(0.0, 1.0) < 0.05 { -1.0 } else { r.uniform(1.0, 4.0) };
            let x = r.uniform(-0.1, 1.1) * c.width as f64 - c.cx;
            let y = r.uniform(-0.1, 1.1) * c.height as f64 - c.cy;
            let p = view.world_from_cam.transform(DVec3::new(x / c.fx * z, y / c.fy * z, z));
            let q: [f64; 4] = std::array::from_fn(|_| r.uniform(-1.0, 1.0));
            Gaussian {
                mean: p.as_vec3().to_array(),
                log_scale: std::array::from_fn(|_| r.uniform(-4.0, -1.2) as f32),
                quat_xyzw: q.map(|v| v as f32),
                opacity_logit: r.uniform(-3.0, 3.5) as f32,
                colour: [r.uniform(0.05, 0.95) as f32; 3],
            }
        })
        .collect()
}

pub fn target(width: usize, height: usize) -> Vec<u8> {
    let level = |i: usize| {
        let (x, y) = ((i % width) as f64, (i / width) as f64);
        127.0 + 80.0 * (0.35 * x).sin() * (0.21 * y + 0.1 * x).cos() + 30.0 * ((x - y) * 0.8).sin()
    };
    (0..width * height).map(|i| level(i) as u8).collect()
}

/// A corner and a stripe are not seen.
pub fn mask(width: usize, height: usize) -> Vec<u8> {
    (0..width * height).map(|i| if i % width + i / width < 6 || i % width == width - 4 { 0 } else { 255 }).collect()
}

pub fn shape(v: &View, splats: u32, intersections: u32) -> Shape {
    let (width, height) = (v.camera.width as u32, v.camera.height as u32);
    Shape {
        width,
        height,
        splats,
        intersections,
        images: 2,
        channels: 1,
        cameras: 1,
        fisheye: v.fisheye.is_some(),
        half_size: false,
    }
}

pub fn open(shape: Shape) -> (Gpu, Pipeline) {
    open_with(shape, false)
}

/// With or without what only some devices have.
pub fn open_with(shape: Shape, baseline: bool) -> (Gpu, Pipeline) {
    let config = crate::config();
    let config = GpuConfig { subgroups: config.subgroups && !baseline, ..config };
    let mut gpu = Gpu::open(&config, Pipeline::arena_bytes(&shape).unwrap()).unwrap();
    let p = Pipeline::new(&mut gpu, shape).unwrap();
    (gpu, p)
}

pub fn render(gpu: &mut Gpu, p: &mut Pipeline, v: &View) -> Rendered {
    let mut out = Rendered::default();
    p.render(gpu, v, &mut out).unwrap();
    out
}

pub fn worst(a: impl IntoIterator<Item = f64>, b: impl IntoIterator<Item = f64>) -> f64 {
    a.into_iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

pub fn wide(v: &[f32]) -> Vec<f64> {
    v.iter().map(|x| f64::from(*x)).collect()
}

#[test]
fn twin_gradients_agree_with_finite_differences() {
    let v = view(23, 17);
    compare_differences(&v, &scene(24, &v, 3));
}

#[test]
fn twin_gradients_before_a_backdrop_agree_with_finite_differences() {
    let v = view(23, 17);
    let backdrop: Vec<f64> = (0..23 * 17).map(|i| 0.5 + 0.4 * (0.7 * f64::from(i)).sin()).collect();
    compare_differences_before(&backdrop, &v, &scene(24, &v, 3));
}

/// The twin's gradient by every parameter of every Gaussian and by the pose.
pub fn compare_differences(v: &View, splats: &[Gaussian]) {
    compare_differences_before(&vec![0.0; v.camera.width * v.camera.height], v, splats);
}

fn compare_differences_before(backdrop: &[f64], v: &View, splats: &[Gaussian]) {
    const STEP: f64 = 1e-6;
    let (w, h) = (v.camera.width, v.camera.height);
    let splats: Vec<Parameters> = splats.iter().map(twins::project::parameters).collect();
    let goal: Vec<f64> = target(w, h).iter().map(|g| f64::from(*g) / 255.0).collect();
    let seen = mask(w, h);
    let lambda = f64::from(SSIM);
    let run = |s: &[Parameters], twist: &[f64; 6]| twins::step(backdrop, s, v, twist, &goal, &seen, lambda);
    let at = run(&splats, &[0.0; 6]);
    assert!(at.rendered.margin > 1e-5, "a decision is too close for differences: {}", at.rendered.margin);
    let slope = |f: &dyn Fn(f64) -> f64| (f(STEP) - f(-STEP)) / (2.0 * STEP);
    let close = |analytic: f64, numeric: f64, what: String| {
        let error = (analytic - numeric).abs();
        assert!(error <= 1e-7 + 1e-5 * numeric.abs(), "{what}: {analytic} against {numeric}");
    };
    for i in 0..splats.len() {
        for k in 0..12 {
            let numeric = slope(&|h| {
                let mut moved = splats.clone();
                moved[i][k] += h;
                run(&moved, &[0.0; 6]).loss.total(lambda)
            });
            close(at.splats[i][k], numeric, format!("splat {i} parameter {k}"));
        }
    }
    for k in 0..6 {
        let numeric = slope(&|h| {
            let mut twist = [0.0; 6];
            twist[k] = h;
            run(&splats, &twist).loss.total(lambda)
        });
        close(at.twist[k], numeric, format!("twist {k}"));
    }
}

/// Everything a step leaves behind, beside what its twin says.
pub fn compare_step(v: &View, splats: &[Gaussian], tiling: Option<Tiling>) {
    let (w, h) = (v.camera.width, v.camera.height);
    let s = shape(v, splats.len() as u32, 1 << 16);
    let mut gpu = Gpu::open(&crate::config(), Pipeline::arena_bytes(&s).unwrap()).unwrap();
    let mut p = match tiling {
        Some(tiling) => Pipeline::with_tiling(&mut gpu, s, tiling).unwrap(),
        None => Pipeline::new(&mut gpu, s).unwrap(),
    };
    assert_eq!(p.pool.append(&mut gpu, splats).unwrap(), splats.len());
    let errors = compare(&mut gpu, &mut p, v, splats, [&target(w, h), &mask(w, h)]).unwrap();
    assert_eq!(errors.complaint(1.0), None, "{errors:?}");
}

#[test]
fn every_stage_agrees_with_its_twin() {
    for (n, seed, v) in [(40, 1, view(33, 21)), (64, 2, view(64, 48))] {
        compare_step(&v, &scene(n, &v, seed), None);
    }
}

#[test]
fn the_baseline_without_subgroups_agrees_with_its_twin() {
    // The loss has one tile, and three in a row.
    for v in [view(33, 21), view(130, 21)] {
        compare_step(&v, &scene(40, &v, 1), Some(Tiling::BASELINE));
    }
}

#[test]
fn one_pixel_and_odd_sizes_agree_with_their_twin() {
    for (w, h) in [(1, 1), (1, 9), (7, 1), (17, 5), (9, 33)] {
        let v = view(w, h);
        let (mut gpu, mut p) = open(shape(&v, 16, 4096));
        let splats = scene(16, &v, 5);
        p.pool.append(&mut gpu, &splats).unwrap();
        let doubles: Vec<Parameters> = splats.iter().map(twins::project::parameters).collect();
        let twin = twins::raster::forward(&twins::flat(&twins::project_all(&doubles, &v, &[0.0; 6])), w, h);
        let picture = render(&mut gpu, &mut p, &v);
        assert!(worst(wide(&picture.colour), twin.planes.colour[0].clone()) < 1e-5, "{w}x{h}");
        p.loss.set_image(&mut gpu, 0, &target(w, h)).unwrap();
        assert!(p.train(&mut gpu, &v, 0, Some(&STILL), &Weights::default()).unwrap().loss.is_finite());
    }
}

#[test]
fn an_empty_map_renders_nothing_and_trains() {
    let v = view(33, 21);
    let (mut gpu, mut p) = open(shape(&v, 16, 1024));
    let picture = render(&mut gpu, &mut p, &v);
    assert!(picture.colour.iter().chain(&picture.alpha).chain(&picture.depth).all(|x| *x == 0.0));
    p.loss.set_image(&mut gpu, 0, &target(33, 21)).unwrap();
    let step = p.train(&mut gpu, &v, 0, Some(&STILL), &Weights::default()).unwrap();
    assert_eq!((step.stats.visible, step.stats.intersections), (0, 0));
    assert!(step.l1 > 0.1);
    assert_eq!(step.pose_gradient.map(f64::abs), [0.0; 6]);
}

pub const FAST: LearningRates =
    LearningRates { position: 4e-3, scale: 2e-2, rotation: 1e-2, opacity: 5e-2, colour: 2e-2 };

pub fn train(gpu: &mut Gpu, p: &mut Pipeline, v: &View, steps: usize) -> Vec<StepStats> {
    (0..steps).map(|_| p.train(gpu, v, 0, Some(&FAST), &Weights::default()).unwrap()).collect()
}

/// Image at half the size: `one_of` makes one pixel of two by two; an odd row or column is left off.
fn halved(image: &[u8], width: usize, one_of: fn([u8; 4]) -> u8) -> Vec<u8> {
    let (w, h) = (width / 2, image.len() / width / 2);
    let at = |i: usize, dx: usize, dy: usize| image[(2 * (i / w) + dy) * width + 2 * (i % w) + dx];
    (0..w * h).map(|i| one_of([at(i, 0, 0), at(i, 1, 0), at(i, 0, 1), at(i, 1, 1)])).collect()
}

#[test]
fn a_step_at_half_size_is_one_of_a_camera_with_pixels_twice_as_wide() {
    let (w, h) = (65, 47);
    let v = view(w, h);
    let c = v.camera;
    // The middle of pixel (0, 0) is that of four: (0.5, 0.5).
    let camera = Pinhole {
        width: w / 2,
        height: h / 2,
        fx: c.fx / 2.0,
        fy: c.fy / 2.0,
        cx: (c.cx - 0.5) / 2.0,
        cy: (c.cy - 0.5) / 2.0,
    };
    let small = View { camera, ..v };
    let mean = |four: [u8; 4]| (four.iter().map(|p| f64::from(*p)).sum::<f64>() / 4.0 + 0.5) as u8;
    let all = |four: [u8; 4]| if four.contains(&0) { 0 } else { 255 };
    let seen = mask(w, h);
    for channels in [1, 3] {
        // The second image and camera, so that no offset is zero.
        let planes: Vec<Vec<u8>> =
            (0..channels).map(|c| target(w, h).iter().map(|p| p.rotate_left(c)).collect()).collect();
        let run = |view: &View, half_size: bool, planes: &[Vec<u8>], seen: &[u8], is_half: bool| {
            let shape = Shape { channels, cameras: 2, half_size, ..shape(view, 512, 1 << 16) };
            let (mut gpu, mut p) = open(shape);
            p.pool.append(&mut gpu, scene(500, &v, 9)).unwrap();
            p.loss.set_image(&mut gpu, 1, &planes.concat()).unwrap();
            p.loss.set_mask(&mut gpu, 1, seen).unwrap();
            let target = Target { camera: 1, half_size: is_half, ..Target::from(1) };
            let mut step = || p.train(&mut gpu, view, target, Some(&FAST), &Weights::default()).unwrap();
            let steps: Vec<_> = (0..5).map(|_| step()).collect();
            (steps, p.pool.download(&mut gpu).unwrap())
        };
        let small_planes: Vec<_> = planes.iter().map(|plane| halved(plane, w, mean)).collect();
        let halves = run(&v, true, &planes, &seen, true);
        let alone = run(&small, false, &small_planes, &halved(&seen, w, all), false);
        assert!(halves.0[0].loss > 0.0 && halves == alone, "{:?}, {:?}", halves.0, alone.0);
        let whole = run(&v, true, &planes, &seen, false);
        assert!(whole == run(&v, false, &planes, &seen, false) && whole != halves);
    }
}

#[test]
fn two_runs_are_bit_identical() {
    let v = view(65, 47);
    let run = || {
        let (mut gpu, mut p) = open(shape(&v, 512, 1 << 16));
        p.pool.append(&mut gpu, scene(500, &v, 9)).unwrap();
        p.loss.set_image(&mut gpu, 0, &target(65, 47)).unwrap();
        let steps = train(&mut gpu, &mut p, &v, 10);
        let map = p.pool.download(&mut gpu).unwrap();
        (steps, map, render(&mut gpu, &mut p, &v).colour)
    };
    let (a, b) = (run(), run());
    assert_eq!(a.0, b.0);
    assert_eq!(bytemuck::cast_slice::<_, u32>(&a.1), bytemuck::cast_slice::<_, u32>(&b.1));
    assert_eq!(a.2, b.2);
}

#[test]
fn training_in_pieces_of_any_length_is_the_same_to_the_bit() {
    let v = view(65, 47);
    let run = |submission_max_ms: f64| {
        let shape = shape(&v, 512, 1 << 16);
        let config = GpuConfig { submission_max_ms, ..crate::config() };
        let mut gpu = Gpu::open(&config, Pipeline::arena_bytes(&shape).unwrap()).unwrap();
        let mut p = Pipeline::new(&mut gpu, shape).unwrap();
        p.pool.append(&mut gpu, scene(500, &v, 9)).unwrap();
        p.loss.set_image(&mut gpu, 0, &target(65, 47)).unwrap();
        let first = train(&mut gpu, &mut p, &v, 2);
        let before = gpu.submissions();
        let steps = train(&mut gpu, &mut p, &v, 3);
        let submissions = gpu.submissions() - before;
        (submissions, first, steps, p.pool.download(&mut gpu).unwrap(), render(&mut gpu, &mut p, &v).colour)
    };
    let [whole, short] = [1e6, 1e-6].map(run);
    // A step is one submission where nothing has to be cut; else the rasters alone are a tile or two each.
    assert!(whole.0 == 3 && short.0 > 3 * 2 * 12, "{} {}", whole.0, short.0);
    assert_eq!((&whole.1, &whole.2), (&short.1, &short.2));
    assert_eq!(bytemuck::cast_slice::<_, u32>(&whole.3), bytemuck::cast_slice::<_, u32>(&short.3));
    assert_eq!(whole.4, short.4);
}

#[test]
fn a_view_that_overflows_its_list_is_drawn_coarser_and_never_loses_the_background() {
    let v = view(64, 48);
    let splats = scene(64, &v, 2);
    let (mut gpu, mut p) = open(shape(&v, 64, 1 << 16));
    p.pool.append(&mut gpu, &splats).unwrap();
    let mut whole = Rendered::default();
    let full = p.render(&mut gpu, &v, &mut whole).unwrap();
    assert_eq!((full.overflow, full.coarseness), (0, Coarseness::default()));

    let capacity = full.intersections / 5;
    let (mut gpu, mut p) = open(shape(&v, 64, capacity));
    p.pool.append(&mut gpu, &splats).unwrap();
    let mut out = Rendered::default();
    let coarse = p.render(&mut gpu, &v, &mut out).unwrap();
    assert!(coarse.overflow == 0 && coarse.coarseness > Coarseness::default(), "{coarse:?}");
    assert!(coarse.intersections > capacity / 3, "{coarse:?} of {capacity}");
    // The farthest that fills the picture alone is there as before: what is lost is lost at all depths.
    let mean = |r: &Rendered| wide(&r.alpha).iter().sum::<f64>() / r.alpha.len() as f64;
    assert!(mean(&out) > 0.5 * mean(&whole), "{} of {}", mean(&out), mean(&whole));

    // A step on a list that lost Gaussians says so and moves nothing; from as coarse a view it does.
    p.loss.set_image(&mut gpu, 0, &target(64, 48)).unwrap();
    let before = p.pool.download(&mut gpu).unwrap();
    let lost = train(&mut gpu, &mut p, &v, 1)[0].stats;
    assert_eq!((lost.intersections, lost.overflow), (capacity, full.intersections - capacity));
    assert_eq!(p.pool.download(&mut gpu).unwrap(), before);
    let v = View { coarseness: coarse.coarseness, ..v };
    let steps = train(&mut gpu, &mut p, &v, 3);
    assert!(steps.iter().all(|s| s.stats.overflow == 0 && s.loss.is_finite()), "{steps:?}");
    assert!(p.pool.download(&mut gpu).unwrap() != before);
}

#[test]
fn splats_that_are_not_finite_do_not_change_the_picture() {
    let v = view(64, 48);
    let good = scene(60, &v, 4);
    let mut mixed = good.clone();
    for (i, bad) in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::NAN].into_iter().enumerate() {
        let mut s = good[i];
        match i {
            0 => s.mean[1] = bad,
            1 => s.log_scale[2] = bad,
            2 => s.opacity_logit = bad,
            _ => s.quat_xyzw[0] = bad,
        }
        mixed.insert(7 * i, s);
    }
    let run = |splats: &[Gaussian]| {
        let (mut gpu, mut p) = open(shape(&v, 64, 1 << 16));
        p.pool.append(&mut gpu, splats).unwrap();
        let picture = render(&mut gpu, &mut p, &v);
        p.loss.set_image(&mut gpu, 0, &target(64, 48)).unwrap();
        let steps = train(&mut gpu, &mut p, &v, 3);
        let pruned = p
            .pool
            .prune(&mut gpu, &PruneRule { opacity_min: 1e-6, scale_max_m: 100.0, ..PruneRule::default() })
            .unwrap();
        (picture.colour, steps, pruned)
    };
    let (clean, dirty) = (run(&good), run(&mixed));
    assert_eq!(clean.0, dirty.0);
    assert_eq!((clean.1[0].stats.failed, dirty.1[0].stats.failed), (0, 4));
    assert_eq!(clean.1[2].loss, dirty.1[2].loss);
    assert_eq!((clean.2, dirty.2), (0, 4));
}

#[test]
fn a_full_pool_takes_no_more_and_reuses_what_was_pruned() {
    let v = view(33, 21);
    let (mut gpu, mut p) = open(shape(&v, 20, 4096));
    let mut splats = scene(30, &v, 6);
    splats[..5].iter_mut().for_each(|s| s.opacity_logit = -8.0);
    splats[5..].iter_mut().for_each(|s| s.opacity_logit = 1.0);
    assert_eq!(p.pool.append(&mut gpu, &splats).unwrap(), 20);
    assert_eq!(p.pool.append(&mut gpu, &splats).unwrap(), 0);
    assert_eq!(p.pool.prune(&mut gpu, &PruneRule::default()).unwrap(), 5);
    assert_eq!(p.pool.prune(&mut gpu, &PruneRule::default()).unwrap(), 0);
    assert_eq!(p.pool.count(), 15);
    assert_eq!(p.pool.append(&mut gpu, &splats[20..]).unwrap(), 5);
    let map = p.pool.download(&mut gpu).unwrap();
    assert_eq!(map.len(), 20);
    assert!(splats[5..25].iter().all(|s| map.contains(s)));
}

pub fn psnr(picture: &[f32], goal: &[u8]) -> f64 {
    let square = |(a, b): (&f32, &u8)| (f64::from(*a) - f64::from(*b) / 255.0).powi(2);
    let mse = picture.iter().zip(goal).map(square).sum::<f64>() / goal.len() as f64;
    -10.0 * mse.log10()
}

#[test]
fn training_on_one_picture_converges() {
    let (w, h) = (96, 64);
    let v = view(w, h);
    let goal = target(w, h);
    let (mut gpu, mut p) = open(shape(&v, 1024, 1 << 16));
    p.pool.append(&mut gpu, scene(1024, &v, 8)).unwrap();
    p.loss.set_image(&mut gpu, 0, &goal).unwrap();
    let before = psnr(&render(&mut gpu, &mut p, &v).colour, &goal);
    let steps = train(&mut gpu, &mut p, &v, 150);
    let picture = render(&mut gpu, &mut p, &v);
    let after = psnr(&picture.colour, &goal);
    println!("PSNR {before:.1} -> {after:.1} dB, loss {:.4} -> {:.4}", steps[0].loss, steps[149].loss);
    write_png("converged", &picture.colour, &goal, w, h);
    assert!(before < 15.0 && after > 25.0, "PSNR {before:.1} -> {after:.1} dB");
}

/// Picture and goal side by side, in $STIPPLE_PICTURES if it is set.
pub fn write_png(name: &str, picture: &[f32], goal: &[u8], width: usize, height: usize) {
    let Some(folder) = std::env::var_os("STIPPLE_PICTURES") else { return };
    let mut bytes = Vec::new();
    for y in 0..height {
        bytes.extend(picture[y * width..][..width].iter().map(|g| (g.clamp(0.0, 1.0) * 255.0) as u8));
        bytes.extend(&goal[y * width..][..width]);
    }
    let file = std::fs::File::create(std::path::Path::new(&folder).join(format!("{name}.png"))).unwrap();
    let mut e = png::Encoder::new(file, 2 * width as u32, height as u32);
    e.set_color(png::ColorType::Grayscale);
    e.write_header().unwrap().write_image_data(&bytes).unwrap();
}

#[test]
fn the_validation_layer_is_silent() {
    let v = view(33, 21);
    let s = shape(&v, 64, 4096);
    let opened = Gpu::open_with(&crate::config(), Pipeline::arena_bytes(&s).unwrap(), GpuOptions { validation: true });
    let mut gpu = match opened {
        Ok(gpu) => gpu,
        Err(fault) => return println!("ignored: the_validation_layer_is_silent: {fault}"),
    };
    let mut p = Pipeline::new(&mut gpu, s).unwrap();
    p.pool.append(&mut gpu, scene(64, &v, 1)).unwrap();
    p.loss.set_image(&mut gpu, 0, &target(33, 21)).unwrap();
    train(&mut gpu, &mut p, &v, 2);
    let goal = Target { exposure: Exposure { gain: 1.2, offset: 0.1 }, ..Target::from(0) };
    p.train(&mut gpu, &v, goal, Some(&FAST), &Weights::default()).unwrap();
    render(&mut gpu, &mut p, &v);
    p.pool.prune(&mut gpu, &PruneRule::default()).unwrap();
    assert_eq!(gpu.validation_messages(), Vec::<String>::new());
}
