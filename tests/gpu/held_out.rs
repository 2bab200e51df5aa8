//! What the regularisers are worth on views that were not trained on:
//! `cargo test --test gpu held_out -- --ignored --nocapture`.

use super::splat::{psnr, render, write_png, Rng};
use glam::{DQuat, DVec3};
use stipple::gpu::Gpu;
use stipple::map::{Gaussian, LearningRates, Pipeline, Shape, View, Weights};
use stipple::stereo::Pinhole;
use stipple_drivers::Pose;

const SIZE: (usize, usize) = (160, 120);
const TRAINED: usize = 6;
const STEPS: usize = 900;

/// Looking at a wall 3 m away from `x`, turned a little.
fn view(x: f64, y: f64, turn: f64) -> View {
    let (width, height) = SIZE;
    let camera = Pinhole { width, height, fx: 130.0, fy: 130.0, cx: 79.5, cy: 59.5 };
    View::new(Pose::new(DQuat::from_rotation_y(turn), DVec3::new(x, y, 0.0)), camera, None)
}

fn relief(x: f64, y: f64) -> f64 {
    3.0 + 0.4 * (1.7 * x).sin() + 0.3 * (2.3 * y + x).cos() + if (x - 0.3).abs() < 0.35 { -0.6 } else { 0.0 }
}

fn grey(x: f64, y: f64) -> f64 {
    let tile = if ((x * 3.0).floor() + (y * 3.0).floor()) as i64 % 2 == 0 { 0.25 } else { 0.7 };
    tile + 0.1 * (11.0 * x).sin() * (9.0 * y).cos()
}

/// Discs of `sigma` on the wall; depth off by `noise` of itself.
fn wall(n: usize, sigma: f64, noise: f64, logit: f32, r: &mut Rng) -> Vec<Gaussian> {
    (0..n)
        .map(|_| {
            let (x, y) = (r.uniform(-3.0, 3.0), r.uniform(-2.2, 2.2));
            let z = relief(x, y) * (1.0 + r.uniform(-noise, noise));
            Gaussian {
                mean: [x as f32, y as f32, z as f32],
                log_scale: [sigma.ln() as f32; 3],
                quat_xyzw: [0.0, 0.0, 0.0, 1.0],
                opacity_logit: logit,
                colour: [grey(x, y) as f32; 3],
            }
        })
        .collect()
}

#[test]
#[ignore = "a minute; shows what each regulariser does to views that were not trained on: cargo test --release --test gpu held_out_views_by_regulariser -- --ignored --nocapture"]
fn held_out_views_by_regulariser() {
    let (width, height) = (SIZE.0 as u32, SIZE.1 as u32);
    let s = Shape {
        width,
        height,
        splats: 40_000,
        intersections: 1 << 19,
        images: TRAINED as u32,
        channels: 1,
        cameras: 1,
    };
    let mut gpu = Gpu::open(&crate::config(), Pipeline::arena_bytes(&s).unwrap()).unwrap();
    let mut p = Pipeline::new(&mut gpu, s).unwrap();
    let training: Vec<View> =
        (0..TRAINED).map(|i| view(-0.5 + 0.2 * i as f64, 0.1 * (i % 3) as f64, 0.04 * (i % 2) as f64)).collect();
    let unseen = [view(-0.9, 0.0, 0.1), view(0.05, -0.35, 0.0), view(0.95, 0.2, -0.12), view(0.0, 0.5, 0.15)];

    p.pool.append(&mut gpu, wall(40_000, 0.02, 0.0, 3.0, &mut Rng(1))).unwrap();
    let mut photograph = |v: &View| -> Vec<u8> {
        render(&mut gpu, &mut p, v).colour.iter().map(|g| (g.clamp(0.0, 1.0) * 255.0).round() as u8).collect()
    };
    let goals: Vec<Vec<u8>> = training.iter().map(&mut photograph).collect();
    let truth: Vec<Vec<u8>> = unseen.iter().map(&mut photograph).collect();

    let off = Weights { ssim: 0.2, needle: 0.0, scale: 0.0, scale_soft_m: 0.1, opacity: 0.0 };
    let cases = [
        ("none", off),
        ("needle 0.1", Weights { needle: 0.1, ..off }),
        ("needle 1", Weights { needle: 1.0, ..off }),
        ("scale 0.01", Weights { scale: 0.01, ..off }),
        ("scale 0.1", Weights { scale: 0.1, ..off }),
        ("needle 0.1 scale 0.1", Weights { needle: 0.1, scale: 0.1, ..off }),
        ("opacity 0.001", Weights { opacity: 0.001, ..off }),
    ];
    let rates = LearningRates { position: 1e-3, scale: 5e-3, rotation: 2e-3, opacity: 5e-2, colour: 5e-3 };
    for (name, weights) in cases {
        p.pool.clear();
        p.pool.append(&mut gpu, wall(4000, 0.05, 0.03, 0.0, &mut Rng(7))).unwrap();
        for (i, g) in goals.iter().enumerate() {
            p.loss.set_image(&mut gpu, i as u32, g).unwrap();
        }
        let mut r = Rng(3);
        for _ in 0..STEPS {
            let i = r.uniform(0.0, TRAINED as f64) as usize;
            p.train(&mut gpu, &training[i], i as u32, &rates, &weights).unwrap();
        }
        let mut mean = |views: &[View], goals: &[Vec<u8>]| {
            let each = views.iter().zip(goals).map(|(v, g)| psnr(&render(&mut gpu, &mut p, v).colour, g));
            each.sum::<f64>() / views.len() as f64
        };
        println!("{name:>20}: trained {:.2} dB, held out {:.2} dB", mean(&training, &goals), mean(&unseen, &truth));
        write_png(&name.replace(' ', "_"), &render(&mut gpu, &mut p, &unseen[2]).colour, &truth[2], SIZE.0, SIZE.1);
    }
}
