//! The loss in a keyframe's exposure against its twin, the twin against finite differences, and evaluation.

use super::splat::{mask, open, render, scene, shape, target, view, wide, worst, FAST, STILL};
use super::twins::loss::{exposed, loss};
use stipple::gpu::Gpu;
use stipple::map::{Exposure, Pipeline, Target, Weights};

const SIZE: (usize, usize) = (33, 21);
const EXPOSURE: Exposure = Exposure { gain: 1.3, offset: -0.07 };
const SSIM: f64 = 0.2;

fn goal() -> Target {
    Target { exposure: EXPOSURE, ..Target::from(1) }
}

fn levels(image: &[u8]) -> Vec<f64> {
    image.iter().map(|g| f64::from(*g) / 255.0).collect()
}

/// A picture with a part that is white and one that is black.
fn harsh() -> Vec<u8> {
    let mut image = target(SIZE.0, SIZE.1);
    image[200..320].fill(255);
    image[400..470].fill(0);
    image
}

#[test]
fn twin_of_the_exposed_loss_agrees_with_finite_differences() {
    const STEP: f64 = 1e-6;
    let (w, h) = SIZE;
    let x: Vec<f64> = (0..w * h).map(|i| 0.5 + 0.6 * (0.7 * i as f64).sin()).collect();
    let (y, seen) = (levels(&harsh()), mask(w, h));
    let run = |x: &[f64], e: [f64; 2]| exposed(x, &y, &seen, SIZE, SSIM, e);
    let at = [EXPOSURE.gain, EXPOSURE.offset];
    let (here, by_exposure) = run(&x, at);
    let slope = |f: &dyn Fn(f64) -> f64| (f(STEP) - f(-STEP)) / (2.0 * STEP);
    for k in 0..2 {
        let numeric = slope(&|d| {
            let mut e = at;
            e[k] += d;
            run(&x, e).0.total(SSIM)
        });
        assert!((by_exposure[k] - numeric).abs() < 1e-7, "exposure {k}: {} against {numeric}", by_exposure[k]);
    }
    for i in (0..w * h).step_by(29) {
        let numeric = slope(&|d| {
            let mut moved = x.clone();
            moved[i] += d;
            run(&moved, at).0.total(SSIM)
        });
        assert!((here.gradient[i] - numeric).abs() < 1e-7, "pixel {i}: {} against {numeric}", here.gradient[i]);
    }
}

#[test]
fn exposed_loss_agrees_with_its_twin() {
    let (w, h) = SIZE;
    let v = view(w, h);
    let (mut gpu, mut p) = open(shape(&v, 64, 1 << 16));
    p.pool.append(&mut gpu, scene(40, &v, 1)).unwrap();
    p.loss.set_image(&mut gpu, 1, &harsh()).unwrap();
    p.loss.set_mask(&mut gpu, 0, &mask(w, h)).unwrap();
    let picture = wide(&render(&mut gpu, &mut p, &v).colour);
    let weights = Weights { ssim: SSIM as f32, needle: 0.0, scale: 0.0, ..Weights::default() };
    let (y, seen) = (levels(&harsh()), mask(w, h));

    let step = p.train(&mut gpu, &v, goal(), Some(&STILL), &weights).unwrap();
    let (twin, by_exposure) = exposed(&picture, &y, &seen, SIZE, SSIM, [EXPOSURE.gain, EXPOSURE.offset]);
    let mut gradient = vec![0f32; w * h];
    gpu.download(p.loss.buffers.pixel_gradient, 0, &mut gradient).unwrap();
    let scale = twin.gradient.iter().fold(0.0f64, |m, g| m.max(g.abs()));
    let error = worst(wide(&gradient), twin.gradient.iter().copied());
    assert!(error < 2e-3 * scale, "gradient off by {error} of {scale}");
    assert!((step.l1 - twin.l1).abs() < 1e-5 && (step.ssim - twin.ssim).abs() < 1e-4);
    let error = worst(step.exposure_gradient, by_exposure);
    assert!(error < 1e-3 * by_exposure[1].abs().max(by_exposure[0].abs()), "{step:?} against {by_exposure:?}");

    // Without one the image is compared as it is.
    let plain = p.train(&mut gpu, &v, 1, Some(&STILL), &weights).unwrap();
    assert!((plain.l1 - loss(&picture, &y, &seen, w, h, SSIM).l1).abs() < 1e-5);
}

/// Everything training moves.
fn state(gpu: &mut Gpu, p: &Pipeline) -> Vec<u32> {
    let (b, n) = (p.pool.buffers, p.pool.count() as usize);
    let (mut splats, mut moments, mut steps) = (vec![Default::default(); n], vec![Default::default(); n], vec![0; n]);
    gpu.download(b.splats, 0, &mut splats).unwrap();
    gpu.download(b.moments, 0, &mut moments).unwrap();
    gpu.download(b.steps, 0, &mut steps).unwrap();
    [bytemuck::cast_slice(&splats), bytemuck::cast_slice(&moments), &steps[..]].concat()
}

#[test]
fn evaluation_tells_what_training_would_and_changes_nothing() {
    let (w, h) = (65, 47);
    let v = view(w, h);
    let (mut gpu, mut p) = open(shape(&v, 512, 1 << 16));
    p.pool.append(&mut gpu, scene(500, &v, 9)).unwrap();
    p.loss.set_image(&mut gpu, 1, &target(w, h)).unwrap();
    for _ in 0..3 {
        p.train(&mut gpu, &v, goal(), Some(&FAST), &Weights::default()).unwrap();
    }
    let before = state(&mut gpu, &p);
    let looked = p.train(&mut gpu, &v, goal(), None, &Weights::default()).unwrap();
    assert!(before == state(&mut gpu, &p));
    assert_eq!(looked, p.train(&mut gpu, &v, goal(), Some(&FAST), &Weights::default()).unwrap());
}
