//! Semi-global matching and its filter: each stage against its twin, and that a result can be repeated to the bit.

use super::stereo_scenes::{draw, Scene, Texture};
use super::twins::stereo::{self as twin, Grey, Penalties, Variance};
use stipple::config::{GpuConfig, StereoConfig, StereoMethod};
use stipple::gpu::{Arena, Gpu, GpuOptions};
use stipple::stereo::rectify::Rectification;
use stipple::stereo::rectify_gpu::{self, Rectifier};
use stipple::stereo::sgm::wls::Wls;
use stipple::stereo::sgm::{self, Sgm, Shape};
use stipple::stereo::{Buffers, DepthMap, Disparity, Stereo};
use stipple_drivers::{Calibration, Camera, Image, ImuCalibration, Lens, Pose, RigCamera};

pub fn shape(width: usize, height: usize, disparities: u32) -> Shape {
    Shape { width, height, disparities, paths: 8, uniqueness_percent: 10, wls: true }
}

pub fn open(shape: Shape) -> (Gpu, Sgm) {
    let mut gpu = Gpu::open(&GpuConfig::default(), arena_bytes(&shape)).unwrap();
    let sgm = matcher(&mut gpu, shape);
    (gpu, sgm)
}

fn arena_bytes(shape: &Shape) -> u64 {
    let mut arena = Arena::counting();
    sgm::Buffers::new(&mut arena, shape).unwrap();
    arena.used()
}

fn matcher(gpu: &mut Gpu, shape: Shape) -> Sgm {
    let buffers = sgm::Buffers::new(gpu.arena(), &shape).unwrap();
    Sgm::new(gpu, buffers, shape).unwrap()
}

pub fn run(gpu: &mut Gpu, sgm: &mut Sgm, left: &Image, right: &Image) -> (Vec<f32>, Vec<f32>) {
    let mut out = Disparity::new(left.width, left.height);
    sgm.compute(gpu, left, right, &mut out).unwrap();
    (out.px, out.sigma_px)
}

fn grey(image: &Image) -> Grey {
    Grey { width: image.width, height: image.height, pixels: image.pixels.clone() }
}

const PENALTIES: Penalties =
    Penalties { outside: sgm::OUTSIDE, p1: sgm::P1, p2: sgm::P2, p2_slope: sgm::P2_SLOPE, p2_min: sgm::P2_MIN };

#[test]
fn sums_and_matches_agree_with_their_twins() {
    // Odd sizes; disparities whose lanes do not divide a workgroup, fill one, and are more than the picture is wide.
    for (w, h, disparities, paths) in [(53, 37, 48, 8), (40, 21, 16, 4), (61, 19, 128, 8), (36, 40, 256, 4)] {
        let (left, right) = draw(&Scene::steps(w, h), 5);
        let s = Shape { paths, ..shape(w, h, disparities) };
        let (mut gpu, mut sgm) = open(s);
        sgm.load(&mut gpu, &left, &right).unwrap();
        let mut rec = gpu.record();
        sgm.record_sums(&mut rec);
        gpu.submit(rec).unwrap();
        let d = disparities as usize;
        let mut packed = vec![0u32; w * h * d / 2];
        gpu.download(sgm.buffers().sums.cast(), 0, &mut packed).unwrap();
        let sums: Vec<u32> = packed.iter().flat_map(|v| [v & 0xffff, v >> 16]).collect();
        let strings = [&left, &right].map(|i| twin::census(&grey(i)));
        let mut expected = vec![0; w * h * d];
        for step in sgm::DIRECTIONS.iter().take(paths as usize) {
            let l = twin::aggregate(&grey(&left), [&strings[0], &strings[1]], d, *step, PENALTIES);
            expected.iter_mut().zip(l).for_each(|(sum, l)| *sum += l);
        }
        assert!(sums == expected, "{w}x{h}, {disparities} disparities, {paths} paths");
        let mut rec = gpu.record();
        sgm.record_matches(&mut rec);
        gpu.submit(rec).unwrap();
        let (mut in_right, mut disparity) = (vec![0u32; w * h], vec![0f32; w * h]);
        gpu.download(sgm.buffers().right, 0, &mut in_right).unwrap();
        gpu.download(sgm.buffers().disparity, 0, &mut disparity).unwrap();
        assert_eq!(in_right, twin::match_right(&sums, w, d));
        let mut expected = twin::match_left(&sums, &in_right, w, d, 100 - s.uniqueness_percent, sgm::DISAGREE);
        let limits = [sgm::CHANCE, sgm::REPEAT_FIT, sgm::REPEAT_ALIKE, sgm::REPEAT_WALL];
        for (i, found) in expected.iter_mut().enumerate().filter(|(_, found)| **found >= 0.0) {
            if !twin::verify([&strings[0], &strings[1]], [w, h], d, i, *found, limits) {
                *found = -1.0;
            }
        }
        for (i, (a, b)) in disparity.iter().zip(&expected).enumerate() {
            assert!((f64::from(*a) - b).abs() < 1e-4, "pixel {i}: {a} and {b}");
        }
        let known = disparity.iter().filter(|d| **d >= 0.0).count();
        assert!(known * 4 > w * h, "{known} of {} known", w * h);
    }
}

#[test]
fn speckles_are_the_small_regions() {
    let (w, h) = (67, 45);
    let mut r = super::splat::Rng(3);
    // Blotches of few levels, with holes: regions of all sizes, rings and combs among them.
    let disparity: Vec<f32> = (0..w * h)
        .map(|i| match ((i % w) / 9 + (i / w) / 7) % 3 {
            _ if r.uniform(0.0, 1.0) < 0.1 => -1.0,
            0 => 4.0 + r.uniform(0.0, 3.0) as f32,
            k => 9.0 + k as f32 + r.uniform(0.0, 0.9) as f32,
        })
        .collect();
    let (mut gpu, sgm) = open(shape(w, h, 16));
    let own: Vec<u32> = (0..(w * h) as u32).collect();
    gpu.upload(sgm.buffers().labels, 0, &own).unwrap();
    gpu.upload(sgm.buffers().disparity, 0, &disparity).unwrap();
    let mut rec = gpu.record();
    sgm.record_speckles(&mut rec);
    gpu.submit(rec).unwrap();
    let (mut labels, mut areas, mut kept) = (vec![0; w * h], vec![0; w * h], vec![0f32; w * h]);
    gpu.download(sgm.buffers().labels, 0, &mut labels).unwrap();
    gpu.download(sgm.buffers().areas, 0, &mut areas).unwrap();
    gpu.download(sgm.buffers().disparity, 0, &mut kept).unwrap();
    assert_eq!(labels, twin::speckle_join(&disparity, w, sgm::SPECKLE_CLOSE));
    assert_eq!(areas, twin::speckle_count(&disparity, &labels));
    let mut expected = disparity.clone();
    twin::speckle_drop(&mut expected, &labels, &areas, sgm::SPECKLE_AREA);
    assert_eq!(kept, expected);
    let dropped = kept.iter().zip(&disparity).filter(|(a, b)| a != b).count();
    assert!(dropped > 100 && kept.iter().any(|d| *d >= 0.0), "{dropped} dropped");
}

#[test]
fn filter_agrees_with_its_twin() {
    let (w, h) = (45, 31);
    let (left, right) = draw(&Scene::steps(w, h), 9);
    let (mut gpu, mut sgm) = open(shape(w, h, 16));
    sgm.load(&mut gpu, &left, &right).unwrap();
    let mut r = super::splat::Rng(8);
    let mut disparity: Vec<f32> = (0..w * h).map(|i| 3.0 + (i % w) as f32 * 0.2).collect();
    disparity.iter_mut().for_each(|d| *d = if r.uniform(0.0, 1.0) < 0.4 { -1.0 } else { *d });
    disparity[5 * w..6 * w].fill(-1.0);
    gpu.upload(sgm.buffers().disparity, 0, &disparity).unwrap();
    let mut rec = gpu.record();
    sgm.record_filter(&mut rec);
    gpu.submit(rec).unwrap();
    let (mut found, mut deviation) = (vec![0f32; w * h], vec![0f32; w * h]);
    gpu.download(sgm.buffers().disparity, 0, &mut found).unwrap();
    gpu.download(sgm.buffers().deviation, 0, &mut deviation).unwrap();
    let mut data =
        twin::fill_rows(&disparity, w, [Wls::FILL, Wls::HIDDEN, Wls::ALIKE_PX, Wls::FILL_REACH].map(f64::from));
    data = twin::median(&data, w);
    for pass in 0..Wls::PASSES {
        for columns in [false, true] {
            let lambda = f64::from(Wls::lambda(pass));
            twin::smooth_lines(&grey(&left), &mut data, columns, lambda, f64::from(Wls::SIGMA));
        }
    }
    let own = stipple::stereo::sgm::wls::Variance::FITTED;
    let variance = Variance {
        weight_min: f64::from(Wls::WEIGHT_MIN),
        fill: f64::from(Wls::FILL),
        least: f64::from(own.least),
        bent: f64::from(own.bent),
        bent_far: f64::from(own.bent_far),
        faint: f64::from(own.faint),
        missing: f64::from(own.missing),
    };
    for i in 0..w * h {
        let [a, b] = twin::settle(&grey(&left), &data, i, &variance);
        assert!((f64::from(found[i]) - a).abs() < 1e-3, "pixel {i}: {} and {a}", found[i]);
        assert!((f64::from(deviation[i]) - b).abs() < 1e-3 * (1.0 + b), "pixel {i}: {} and {b}", deviation[i]);
    }
}

#[test]
fn raw_pairs_are_rectified_as_on_the_cpu() {
    let lenses = [
        Lens::Radtan { k1: -0.28, k2: 0.07, p1: 2e-4, p2: 2e-5 },
        Lens::KannalaBrandt { k: [0.01, -0.01, 0.005, -0.001] },
    ];
    // Rows of whole words, and others.
    for (lens, w) in lenses.into_iter().zip([120, 131]) {
        let h = 83;
        let (cx, cy) = (0.5 * w as f64 + 1.3, 0.5 * h as f64 - 0.7);
        let camera = Camera { width: w, height: h, fx: 70.0, fy: 71.0, cx, cy, lens };
        let right = Pose::new(glam::DQuat::from_rotation_z(0.02), glam::DVec3::new(0.1, 0.003, -0.002));
        let rig = Calibration {
            cameras: vec![RigCamera::new(camera, Pose::IDENTITY), RigCamera::new(camera, right)],
            imu: ImuCalibration::CONSUMER,
        };
        let rectification = Rectification::new(&rig).unwrap();
        let maps = [0, 1].map(|i| rectification.map(&rig.cameras[i]));
        let (left, right) = draw(&Scene::steps(w, h), 6);
        let stride = w.next_multiple_of(4);
        let mut gpu = Gpu::open(&GpuConfig::default(), 1 << 20).unwrap();
        let buffers = rectify_gpu::Buffers::new(gpu.arena(), w, h).unwrap();
        // Made for other maps first, as before the cameras moved.
        let before = [1, 0].map(|i| rectification.map(&rig.cameras[i]));
        let mut rectifier = Rectifier::new(&mut gpu, buffers, w, h, &before).unwrap();
        rectifier.upload(&mut gpu, &maps).unwrap();
        let images = gpu.alloc::<u32>("images", 2 * stride * h / 4).unwrap();
        rectifier.load(&mut gpu, &left, &right).unwrap();
        let mut rec = gpu.record();
        rectifier.record(&mut rec, images);
        gpu.submit(rec).unwrap();
        let mut found = vec![0u8; 2 * stride * h];
        gpu.download(images.cast(), 0, &mut found).unwrap();
        for (side, raw) in [&left, &right].into_iter().enumerate() {
            let mut expected = Image::new(w, h);
            maps[side].apply(raw, &mut expected);
            assert!(expected.pixels.iter().filter(|p| **p > 0).count() * 2 > w * h);
            let mut padded = vec![0; stride * (h + 1)];
            (0..h).for_each(|y| padded[y * stride..][..w].copy_from_slice(&raw.pixels[y * w..][..w]));
            for (i, tap) in maps[side].taps(stride).enumerate() {
                let here = found[(side * h + i / w) * stride + i % w];
                assert_eq!(here, expected.pixels[i], "side {side}, pixel {i}");
                assert_eq!(here, twin::rectify(&padded, stride, tap), "side {side}, pixel {i}");
            }
        }
    }
}

#[test]
fn a_wall_seen_through_two_lenses_has_its_depth() {
    let (w, h, wall_m) = (200, 140, 2.0);
    let lens = Lens::Radtan { k1: -0.2, k2: 0.05, p1: 1e-4, p2: -1e-4 };
    let camera = Camera { width: w, height: h, fx: 130.0, fy: 130.0, cx: 100.3, cy: 68.9, lens };
    let right = Pose::new(glam::DQuat::from_rotation_y(0.01), glam::DVec3::new(0.1, 0.002, -0.001));
    let rig = Calibration {
        cameras: vec![RigCamera::new(camera, Pose::IDENTITY), RigCamera::new(camera, right)],
        imu: ImuCalibration::CONSUMER,
    };
    let paint = Scene::of(w, h, [0.0; 3], Texture::Rough);
    let draw = |c: &RigCamera| {
        let mut image = Image::new(w, h);
        for (i, px) in image.pixels.iter_mut().enumerate() {
            let ray = c.camera.unproject(glam::DVec2::new((i % w) as f64, (i / w) as f64)).unwrap();
            let d = c.body_from_cam.q * ray;
            let p = c.body_from_cam.p + d * ((wall_m - c.body_from_cam.p.z) / d.z);
            *px = paint.seen(0, p.x * 80.0, p.y * 80.0).0 as u8;
        }
        image
    };
    let images = [draw(&rig.cameras[0]), draw(&rig.cameras[1])];
    let config = StereoConfig { method: StereoMethod::Sgm, disparities: 32, ..StereoConfig::default() };
    let mut arena = Arena::counting();
    Buffers::new(&mut arena, &rig, &config).unwrap();
    let mut gpu = Gpu::open(&GpuConfig::default(), arena.used()).unwrap();
    let mut stereo = Stereo::new(&rig, &config, 2, Some(&mut gpu)).unwrap();
    let camera = stereo.views.camera();
    let mut depth = DepthMap::new(camera.pinhole.width, camera.pinhole.height);
    let found = stereo.depth(Some(&mut gpu), &images[0], &images[1], &mut depth).unwrap();
    assert!(found * 10 > depth.metres.len() * 8, "{found} of {}", depth.metres.len());
    let mut off: Vec<f64> = Vec::new();
    for (i, z) in depth.metres.iter().enumerate().filter(|(_, z)| **z > 0.0) {
        let (x, y) = ((i % depth.width) as f64, (i / depth.width) as f64);
        let p = camera.pinhole;
        let ray = glam::DVec3::new((x - p.cx) / p.fx, (y - p.cy) / p.fy, 1.0);
        off.push((camera.body_from_rect.transform(ray * f64::from(*z)).z - wall_m).abs());
    }
    off.sort_by(f64::total_cmp);
    // A tenth of a pixel of about 6.5 is 3 cm.
    assert!(off[off.len() / 2] < 0.03, "median error {} m", off[off.len() / 2]);
    assert!(off[off.len() * 95 / 100] < 0.15, "95 % error {} m", off[off.len() * 95 / 100]);
    // One eye covered: no depth.
    let found = stereo.depth(Some(&mut gpu), &images[0], &Image::new(w, h), &mut depth).unwrap();
    assert_eq!((found, depth.metres.iter().filter(|z| **z > 0.0).count()), (0, 0));
}

#[test]
fn depth_of_a_pair_is_the_same_to_the_bit() {
    let (left, right) = draw(&Scene::steps(150, 90), 1);
    let (mut gpu, mut sgm) = open(shape(150, 90, 32));
    let once = run(&mut gpu, &mut sgm, &left, &right);
    // Another pair in between leaves nothing behind.
    run(&mut gpu, &mut sgm, &right, &left);
    assert!(once == run(&mut gpu, &mut sgm, &left, &right));
}

#[test]
fn sums_do_not_depend_on_the_workgroup() {
    let (left, right) = draw(&Scene::steps(150, 90), 1);
    let s = shape(150, 90, 48);
    let found = [8, 32, 256].map(|group| {
        let mut gpu = Gpu::open(&GpuConfig::default(), arena_bytes(&s)).unwrap();
        let buffers = sgm::Buffers::new(gpu.arena(), &s).unwrap();
        let mut sgm = Sgm::with_group(&mut gpu, buffers, s, group).unwrap();
        let found = run(&mut gpu, &mut sgm, &left, &right);
        println!("group {group}: {:?}", gpu.timings().iter().find(|t| t.name == "aggregate"));
        found
    });
    assert!(found[0] == found[1] && found[1] == found[2]);
}

#[test]
fn depth_in_pieces_of_any_length_is_the_same_to_the_bit() {
    let (left, right) = draw(&Scene::steps(150, 90), 1);
    let s = shape(150, 90, 48);
    let [whole, short, shortest] = [1e6, 2.0, 1e-6].map(|submission_max_ms| {
        let config = GpuConfig { submission_max_ms, ..GpuConfig::default() };
        let mut gpu = Gpu::open(&config, arena_bytes(&s)).unwrap();
        let mut sgm = matcher(&mut gpu, s);
        let found = [(); 2].map(|()| {
            let before = gpu.submissions();
            let found = run(&mut gpu, &mut sgm, &left, &right);
            (found, gpu.submissions() - before)
        });
        println!("{submission_max_ms} ms: {} submissions, the longest {} ms", found[1].1, gpu.longest_submission_ms());
        found
    });
    // A kernel's first dispatch begins small; then all is one submission, or as many as it takes.
    assert!(whole[0].1 > 10 && whole[1].1 == 1, "{} {}", whole[0].1, whole[1].1);
    let paths = 2 * 90 + 6 * 150;
    assert!(shortest[1].1 > paths / 4 && short[1].1 < shortest[1].1, "{} {}", short[1].1, shortest[1].1);
    for (found, _) in whole[1..].iter().chain(&short).chain(&shortest) {
        assert!(*found == whole[0].0);
    }
}

#[test]
fn the_validation_layer_is_silent_about_matching() {
    let s = shape(64, 48, 32);
    let options = GpuOptions { validation: true };
    // Short enough that long dispatches are cut.
    let config = GpuConfig { submission_max_ms: 0.1, ..GpuConfig::default() };
    let mut gpu = match Gpu::open_with(&config, arena_bytes(&s), options) {
        Ok(gpu) => gpu,
        Err(fault) => return println!("ignored: the_validation_layer_is_silent_about_matching: {fault}"),
    };
    let mut sgm = matcher(&mut gpu, s);
    let (left, right) = draw(&Scene::steps(64, 48), 1);
    run(&mut gpu, &mut sgm, &left, &right);
    assert_eq!(gpu.validation_messages(), Vec::<String>::new());
}
