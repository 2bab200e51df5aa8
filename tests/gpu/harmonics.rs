//! Colour and spherical harmonics: kernels against the twin, the twin against differences, for one channel and three
//! and degrees 0 to 3.

use super::splat::{open, scene, shape, view, wide, Rng, STILL};
use super::twins::harmonics::{self, Coloured};
use super::twins::project::{parameters, Parameters};
use super::twins::raster::Planes;
use glam::{DQuat, DVec3};
use stipple::gpu::kernels::types::Moments;
use stipple::gpu::{Gpu, GpuOptions};
use stipple::map::pipeline::{Pipeline, PruneRule, Shape, SplatInit, StepStats, View, Weights};
use stipple_drivers::Pose;

const W: usize = 33;
const H: usize = 21;
const PLAIN: Weights = Weights { ssim: 0.2, needle: 0.0, scale: 0.0, scale_soft_m: 1.0, opacity: 0.0 };

fn in_colour(v: &View, n: u32, channels: u32, sh_degree: u32) -> Shape {
    Shape { channels, sh_degree, ..shape(v, n, 1 << 16) }
}

/// A gradient by pixel, in planes by channel.
fn pixel_gradient(channels: usize) -> Planes {
    let mut r = Rng(4);
    let mut v = Planes::zeros(W * H);
    for c in 0..channels {
        v.colour[c] = (0..W * H).map(|_| f64::from(r.uniform(-1.0, 2.0) as f32)).collect();
    }
    v
}

fn coefficients(n: usize, channels: usize, degree: usize) -> Vec<Vec<f64>> {
    let mut r = Rng(8);
    let extra = channels * (degree + 1).pow(2) - 1;
    let one = |i: usize, r: &mut Rng| if i + 1 < channels { r.uniform(0.1, 0.9) } else { r.uniform(-0.4, 0.4) };
    (0..n).map(|_| (0..extra).map(|i| f64::from(one(i, &mut r) as f32)).collect()).collect()
}

#[test]
fn twin_gradients_agree_with_finite_differences() {
    const STEP: f64 = 1e-6;
    let view = view(W, H);
    let splats: Vec<Parameters> = scene(10, &view, 3).iter().map(parameters).collect();
    assert!(harmonics::grey_agrees(&splats, &view, &pixel_gradient(1)));
    let (v, form) = (pixel_gradient(3), (3, 3));
    let extra = coefficients(10, 3, 3);
    let loss = |s: &[Parameters], e: &[Vec<f64>], twist: [f64; 6]| {
        v.dot(&harmonics::step(s, e, &view, &twist, &v, form).rendered.planes)
    };
    let at = harmonics::step(&splats, &extra, &view, &[0.0; 6], &v, form);
    assert!(at.rendered.margin > 1e-6, "a decision is too close for differences: {}", at.rendered.margin);
    let agree = |analytic: f64, f: &dyn Fn(f64) -> f64, what: String| {
        let numeric = (f(STEP) - f(-STEP)) / (2.0 * STEP);
        let error = (analytic - numeric).abs();
        assert!(error <= 2e-5 + 1e-5 * numeric.abs(), "{what}: {analytic} against {numeric}");
    };
    for i in 0..splats.len() {
        for k in [0, 1, 2, 5, 8, 10, 11] {
            let moved = |h: f64| {
                let mut s = splats.clone();
                s[i][k] += h;
                loss(&s, &extra, [0.0; 6])
            };
            agree(at.splats[i][k], &moved, format!("splat {i} parameter {k}"));
        }
        for k in (0..47).step_by(5) {
            let moved = |h: f64| {
                let mut e = extra.clone();
                e[i][k] += h;
                loss(&splats, &e, [0.0; 6])
            };
            agree(at.extra[i][k], &moved, format!("splat {i} coefficient {k}"));
        }
    }
    for k in 0..6 {
        let moved = |h: f64| loss(&splats, &extra, std::array::from_fn(|i| if i == k { h } else { 0.0 }));
        agree(at.twist[k], &moved, format!("twist {k}"));
    }
}

fn close(got: &[f64], want: &[f64], what: &str) {
    let scale = want.iter().fold(0.0f64, |m, w| m.max(w.abs()));
    for (i, (g, w)) in got.iter().zip(want).enumerate() {
        assert!((g - w).abs() <= 1e-3 * scale + 1e-6, "{what} {i}: {g} against {w}");
    }
}

/// A map with coefficients as given.
fn coloured(v: &View, splats: &[SplatInit], extra: &[Vec<f64>], form: (usize, usize)) -> (Gpu, Pipeline) {
    let (mut gpu, mut p) = open(in_colour(v, splats.len() as u32, form.0 as u32, form.1 as u32));
    let tints: Vec<[f32; 2]> =
        extra.iter().map(|e| if form.0 == 3 { [e[0] as f32, e[1] as f32] } else { [0.0; 2] }).collect();
    p.open_block(0);
    p.append_tinted(&mut gpu, splats, &tints).unwrap();
    if let Some(h) = p.harmonics() {
        let inserted: Vec<f64> =
            tints.iter().flat_map(|t| harmonics::harmonics_insert(t.map(f64::from), form.0, form.1)).collect();
        let mut got = vec![1f32; inserted.len()];
        gpu.download(h.coefficients, 0, &mut got).unwrap();
        assert_eq!(wide(&got), inserted);
        let all: Vec<f32> = extra.iter().flatten().map(|c| *c as f32).collect();
        gpu.upload(h.coefficients, 0, &all).unwrap();
    }
    (gpu, p)
}

#[test]
fn kernels_agree_with_their_twin_in_every_form() {
    let view = view(W, H);
    let splats = scene(60, &view, 3);
    let doubles: Vec<Parameters> = splats.iter().map(parameters).collect();
    for form in [(1, 0), (1, 1), (1, 2), (1, 3), (3, 0), (3, 1), (3, 2), (3, 3)] {
        let v = pixel_gradient(form.0);
        let extra = coefficients(60, form.0, form.1);
        let Coloured { splats: by_splat, extra: by_extra, twist, rendered } =
            harmonics::step(&doubles, &extra, &view, &[0.0; 6], &v, form);
        let (mut gpu, mut p) = coloured(&view, &splats, &extra, form);
        let words: Vec<f32> = v.colour[..form.0].iter().flatten().map(|v| *v as f32).collect();
        let step = p.descend(&mut gpu, &view, &words, &STILL, &PLAIN).unwrap();
        let mut planes = vec![0f32; form.0 * W * H];
        gpu.download(p.buffers().rendered, 0, &mut planes).unwrap();
        let want: Vec<f64> = rendered.planes.colour[..form.0].iter().flatten().copied().collect();
        let worst = wide(&planes).iter().zip(&want).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(worst < 2e-5, "{form:?}: colour off by {worst}");

        let mut moments = vec![Moments::default(); splats.len()];
        gpu.download(p.buffers().moments, 0, &mut moments).unwrap();
        let of = |m: &Moments| [m.m[0][0], m.m[0][1], m.m[0][2], m.m[1][3]].map(|v| f64::from(v) * 10.0);
        let got: Vec<f64> = moments.iter().flat_map(of).collect();
        let want: Vec<f64> = by_splat.iter().flat_map(|g| [g[0], g[1], g[2], g[11]]).collect();
        close(&got, &want, &format!("{form:?} position and first level"));
        if let Some(h) = p.harmonics() {
            let n = splats.len() * extra[0].len();
            let mut moments = vec![[0f32; 2]; n];
            gpu.download(h.moments, 0, &mut moments).unwrap();
            let got: Vec<f64> = moments.iter().map(|m| f64::from(m[0]) * 10.0).collect();
            close(&got, &by_extra.concat(), &format!("{form:?} coefficient"));
        }
        let dp = -(view.world_from_cam.q * DVec3::from_slice(&twist[..3]));
        close(&step.pose_gradient, &[dp.x, dp.y, dp.z, -twist[3], -twist[4], -twist[5]], &format!("{form:?} pose"));
    }
}

#[test]
fn a_turned_block_looks_from_a_turned_camera_as_it_did() {
    let before = view(W, H);
    let splats = scene(60, &before, 3);
    for form in [(1, 3), (3, 1), (3, 2), (3, 3)] {
        let extra = coefficients(60, form.0, form.1);
        let (mut gpu, mut p) = coloured(&before, &splats, &extra, form);
        let planes = |gpu: &mut Gpu, p: &mut Pipeline, v: &View| {
            let mut planes = vec![0f32; form.0 * W * H];
            super::splat::render(gpu, p, v);
            gpu.download(p.buffers().rendered, 0, &mut planes).unwrap();
            wide(&planes)
        };
        let seen = planes(&mut gpu, &mut p, &before);
        let by = Pose::new(DQuat::from_scaled_axis(DVec3::new(0.7, -1.1, 0.4)), DVec3::new(0.3, -0.2, 0.5));
        p.move_blocks(&mut gpu, [(0, by)].into_iter()).unwrap();
        let mut turned = Vec::new();
        p.download_colours(&mut gpu, &mut turned).unwrap();
        let (stride, first) = (form.0, form.0 - 1);
        let channel: Vec<f64> = extra[0][first..].iter().step_by(stride).copied().collect();
        let got: Vec<f64> = wide(&turned[first..extra[0].len()]).into_iter().step_by(stride).collect();
        let want = harmonics::harmonics_turn(&channel, by.q, form.1);
        assert!(got.iter().zip(&want).all(|(g, w)| (g - w).abs() < 2e-3), "{form:?}: {got:?} against {want:?}");
        let after = View { world_from_cam: by * before.world_from_cam, ..before };
        let moved = planes(&mut gpu, &mut p, &after);
        let worst = seen.iter().zip(&moved).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(worst < 1e-4, "{form:?}: {worst}");
        assert!(planes(&mut gpu, &mut p, &before).iter().zip(&seen).any(|(a, b)| (a - b).abs() > 0.1));
    }
}

#[test]
fn what_is_left_after_pruning_keeps_its_colour() {
    let v = view(W, H);
    let mut splats = scene(60, &v, 3);
    splats.iter_mut().step_by(3).for_each(|s| s.opacity_logit = -9.0);
    let extra = coefficients(60, 3, 2);
    let (mut gpu, mut p) = coloured(&v, &splats, &extra, (3, 2));
    assert_eq!(p.prune(&mut gpu, &PruneRule::default()).unwrap(), 20);
    let mut colours = Vec::new();
    p.download_colours(&mut gpu, &mut colours).unwrap();
    let kept: Vec<f64> = extra.iter().enumerate().filter(|(i, _)| i % 3 != 0).flat_map(|(_, e)| e.clone()).collect();
    assert_eq!(wide(&colours), kept);
}

#[test]
fn a_map_learns_a_coloured_picture() {
    const STEPS: usize = 120;
    let v = view(W, H);
    let planes: Vec<u8> = (0..3 * W * H)
        .map(|i| {
            let (x, y, c) = ((i % W) as f64, (i / W % H) as f64, (i / W / H) as f64);
            (127.0 + 90.0 * (0.3 * x + c).sin() * (0.25 * y - 2.0 * c).cos()) as u8
        })
        .collect();
    let (mut gpu, mut p) = open(in_colour(&v, 400, 3, 1));
    p.append(&mut gpu, &scene(400, &v, 8)).unwrap();
    p.set_keyframe(&mut gpu, 0, &planes).unwrap();
    let out = super::splat::render(&mut gpu, &mut p, &v);
    // A channel is an image of its own: the loss is the mean of the three.
    let shown = [&out.grey[..], &out.tints[..W * H], &out.tints[W * H..]];
    let mut l1 = 0.0;
    for (c, shown) in shown.iter().enumerate() {
        let goal: Vec<f64> = planes[c * W * H..][..W * H].iter().map(|g| f64::from(*g) / 255.0).collect();
        l1 += super::twins::loss::loss(&wide(shown), &goal, &[255; W * H], W, H, 0.2).l1 / 3.0;
    }
    let losses: Vec<StepStats> =
        (0..STEPS).map(|_| p.train(&mut gpu, &v, 0, &super::splat::FAST, &PLAIN).unwrap()).collect();
    assert!((losses[0].l1 - l1).abs() < 1e-5, "{} against {l1}", losses[0].l1);
    assert!(losses[STEPS - 1].loss < 0.4 * losses[0].loss, "{} -> {}", losses[0].loss, losses[STEPS - 1].loss);
    let out = super::splat::render(&mut gpu, &mut p, &v);
    for (c, shown) in [&out.grey[..], &out.tints[..W * H], &out.tints[W * H..]].into_iter().enumerate() {
        let db = super::splat::psnr(shown, &planes[c * W * H..][..W * H]);
        assert!(db > 20.0, "channel {c}: {db:.1} dB");
    }
}

#[test]
fn grey_of_degree_zero_has_neither_buffers_nor_kernels() {
    let v = view(W, H);
    let (mut gpu, mut p) = open(shape(&v, 16, 1 << 12));
    p.append(&mut gpu, &scene(16, &v, 1)).unwrap();
    super::splat::render(&mut gpu, &mut p, &v);
    assert!(p.harmonics().is_none());
    assert!(gpu.timings().iter().all(|t| !t.name.starts_with("harmonics")));
    let rows = Pipeline::footprint(p.shape()).rows;
    assert!(rows.iter().all(|r| !r.name.contains("beyond the first level")));
}

#[test]
fn the_validation_layer_is_silent_in_colour() {
    let v = view(W, H);
    let s = in_colour(&v, 32, 3, 2);
    let options = GpuOptions { validation: true };
    let mut gpu = match Gpu::open_with(&Default::default(), Pipeline::arena_bytes(&s), options) {
        Ok(gpu) => gpu,
        Err(fault) => return println!("ignored: the_validation_layer_is_silent_in_colour: {fault}"),
    };
    let mut p = Pipeline::new(&mut gpu, s).unwrap();
    p.append_tinted(&mut gpu, &scene(32, &v, 1), &[[0.1, 0.9]; 32]).unwrap();
    p.descend(&mut gpu, &v, &vec![0.1; 3 * W * H], &STILL, &PLAIN).unwrap();
    assert_eq!(gpu.validation_messages(), Vec::<String>::new());
}
