//! Colour through the whole chain, each channel against the twins of the rasters and the loss. Twin of chroma_backward.comp: the
//! gradient by green and blue of raster::backward.

use super::splat::{open, scene, shape, view, wide, STILL};
use super::twins::loss::loss;
use super::twins::project::{parameters, Parameters};
use super::twins::raster::{backward, forward, Planes};
use super::twins::{flat, project_all};
use stipple::gpu::kernels::types::Moments;
use stipple::gpu::{Gpu, GpuOptions};
use stipple::map::{Gaussian, Pipeline, PruneRule, Shape, StepStats, View, Weights};

const W: usize = 33;
const H: usize = 21;
const PLAIN: Weights = Weights { ssim: 0.2, needle: 0.0, scale: 0.0, scale_soft_m: 1.0, opacity: 0.0 };

fn in_colour(v: &View, n: u32) -> Shape {
    Shape { channels: 3, ..shape(v, n, 1 << 16) }
}

/// Gaussians of all colours.
fn coloured(n: usize, v: &View) -> Vec<Gaussian> {
    let mut splats = scene(n, v, 3);
    for (i, s) in splats.iter_mut().enumerate() {
        s.colour = [s.colour[0], 0.1 + 0.8 * (i % 7) as f32 / 7.0, 0.1 + 0.8 * (i % 5) as f32 / 5.0];
    }
    splats
}

/// Three pictures, one a channel.
fn target() -> Vec<u8> {
    let level = |i: usize| {
        let (x, y, c) = ((i % W) as f64, (i / W % H) as f64, (i / W / H) as f64);
        (127.0 + 90.0 * (0.3 * x + c).sin() * (0.25 * y - 2.0 * c).cos()) as u8
    };
    (0..3 * W * H).map(level).collect()
}

#[test]
fn picture_loss_and_gradients_agree_with_the_twin_of_each_channel() {
    let v = view(W, H);
    let splats = coloured(60, &v);
    let doubles: Vec<Parameters> = splats.iter().map(parameters).collect();
    let mut flats = flat(&project_all(&doubles, &v, &[0.0; 6]));
    for (f, s) in flats.iter_mut().zip(&splats) {
        f.iter_mut().for_each(|f| (f[8], f[9]) = (f64::from(s.colour[1]), f64::from(s.colour[2])));
    }
    let rendered = forward(&flats, W, H);
    // A channel is an image of its own: the loss is the mean of the three.
    let (mut gradient, mut l1) = (Planes::zeros(W * H), 0.0);
    for (c, goal) in target().chunks(W * H).enumerate() {
        let goal: Vec<f64> = goal.iter().map(|g| f64::from(*g) / 255.0).collect();
        let own = loss(&rendered.planes.colour[c], &goal, &[255; W * H], W, H, 0.2);
        gradient.colour[c] = own.gradient.iter().map(|g| g / 3.0).collect();
        l1 += own.l1 / 3.0;
    }
    let by_splat = backward(&flats, W, H, &gradient, &[0.0; W * H]);

    let (mut gpu, mut p) = open(in_colour(&v, 60));
    p.pool.append(&mut gpu, &splats).unwrap();
    p.loss.set_image(&mut gpu, 0, &target()).unwrap();
    let picture = super::splat::render(&mut gpu, &mut p, &v);
    let want: Vec<f64> = rendered.planes.colour.concat();
    let worst = wide(&picture.colour).iter().zip(&want).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(worst < 2e-5, "colour off by {worst}");
    let step = p.train(&mut gpu, &v, 0, Some(&STILL), &PLAIN).unwrap();
    assert!((step.l1 - l1).abs() < 1e-5, "{} against {l1}", step.l1);
    // Adam's first moment after one step from rest: a tenth of the gradient.
    let mut moments = vec![Moments::default(); 60];
    gpu.download(p.pool.buffers.moments, 0, &mut moments).unwrap();
    let mut chroma = vec![[0f32; 4]; 60];
    gpu.download(p.pool.buffers.chroma_moments, 0, &mut chroma).unwrap();
    let scale = by_splat.iter().flat_map(|g| [g[6], g[8], g[9]]).fold(0.0f64, |m, g| m.max(g.abs()));
    for (i, want) in by_splat.iter().enumerate() {
        for (got, want) in [moments[i].m[1][3], chroma[i][0], chroma[i][1]].iter().zip([want[6], want[8], want[9]]) {
            let error = (f64::from(*got) * 10.0 - want).abs();
            assert!(error < 2e-3 * scale, "splat {i}: {} against {want}", got * 10.0);
        }
    }
}

#[test]
fn what_is_left_after_pruning_keeps_its_colour() {
    let v = view(W, H);
    let mut splats = coloured(60, &v);
    splats.iter_mut().step_by(3).for_each(|s| s.opacity_logit = -9.0);
    let (mut gpu, mut p) = open(in_colour(&v, 60));
    p.pool.append(&mut gpu, &splats).unwrap();
    assert_eq!(p.pool.prune(&mut gpu, &PruneRule::default()).unwrap(), 20);
    let kept: Vec<Gaussian> = splats.iter().enumerate().filter(|(i, _)| i % 3 != 0).map(|(_, s)| *s).collect();
    assert_eq!(p.pool.download(&mut gpu).unwrap(), kept);
}

#[test]
fn a_map_learns_a_coloured_picture() {
    const STEPS: usize = 120;
    let v = view(W, H);
    let planes = target();
    let (mut gpu, mut p) = open(in_colour(&v, 400));
    p.pool.append(&mut gpu, scene(400, &v, 8)).unwrap();
    p.loss.set_image(&mut gpu, 0, &planes).unwrap();
    let losses: Vec<StepStats> =
        (0..STEPS).map(|_| p.train(&mut gpu, &v, 0, Some(&super::splat::FAST), &PLAIN).unwrap()).collect();
    assert!(losses[STEPS - 1].loss < 0.4 * losses[0].loss, "{} -> {}", losses[0].loss, losses[STEPS - 1].loss);
    let out = super::splat::render(&mut gpu, &mut p, &v);
    for (c, shown) in out.colour.chunks(W * H).enumerate() {
        let db = super::splat::psnr(shown, &planes[c * W * H..][..W * H]);
        assert!(db > 20.0, "channel {c}: {db:.1} dB");
    }
}

#[test]
fn the_validation_layer_is_silent_in_colour() {
    let v = view(W, H);
    let s = in_colour(&v, 32);
    let options = GpuOptions { validation: true };
    let mut gpu = match Gpu::open_with(&Default::default(), Pipeline::arena_bytes(&s).unwrap(), options) {
        Ok(gpu) => gpu,
        Err(fault) => return println!("ignored: the_validation_layer_is_silent_in_colour: {fault}"),
    };
    let mut p = Pipeline::new(&mut gpu, s).unwrap();
    p.pool.append(&mut gpu, coloured(32, &v)).unwrap();
    p.loss.set_image(&mut gpu, 0, &target()).unwrap();
    p.train(&mut gpu, &v, 0, Some(&STILL), &PLAIN).unwrap();
    assert_eq!(gpu.validation_messages(), Vec::<String>::new());
}
