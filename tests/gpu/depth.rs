//! The depth loss against its twin, the twin against finite differences, and that it draws a map to the depth.

use super::splat::{open, scene, shape, view, wide, STILL};
use super::twins::loss::depth;
use stipple::map::pipeline::{Exposure, Goal, LearningRates, Weights};
use stipple::stereo::DepthMap;

const WEIGHT: f64 = 0.7;
/// What 12 bits over 4 /m round to.
const STEP: f64 = 4.0 / 4095.0;

fn goal(anchor: u32) -> Goal {
    Goal { slot: 0, camera: 0, exposure: Some(Exposure::default()), depth: Some(anchor) }
}

fn weights(depth: f64) -> Weights {
    Weights { depth: depth as f32, ..Weights::default() }
}

#[test]
fn twin_of_the_depth_loss_agrees_with_finite_differences() {
    const H: f64 = 1e-6;
    for (d, t, goal) in [(0.4, 0.1, 0.3), (0.2, 0.3, 0.6), (0.1, 0.7, 0.9)] {
        let (_, g) = depth(d, t, goal, 0.8, WEIGHT);
        let at = |d, t| depth(d, t, goal, 0.8, WEIGHT).0;
        let by_d = (at(d + H, t) - at(d - H, t)) / (2.0 * H);
        let by_t = (at(d, t + H) - at(d, t - H)) / (2.0 * H);
        assert!((g[0] - by_d).abs() < 1e-7 && (g[1] - by_t).abs() < 1e-7, "{g:?} against {by_d} {by_t}");
    }
}

#[test]
fn depth_loss_agrees_with_its_twin() {
    for (w, h) in [(33, 21), (64, 48)] {
        let v = view(w, h);
        let (mut gpu, mut p) = open(shape(&v, 64, 1 << 16));
        p.append(&mut gpu, &scene(60, &v, 2)).unwrap();
        p.set_keyframe(&mut gpu, 0, &vec![90; w * h]).unwrap();
        // Cells of two by two: all known, half known, none.
        let metres = |i: usize| match (i % w / 2 + i / w / 2) % 3 {
            0 => 1.0 + (i % w / 2) as f32 * 0.05,
            1 if i / w % 2 == 0 => 2.0,
            _ => 0.0,
        };
        let stored = DepthMap::of(w, h, (0..w * h).map(metres).collect());
        p.set_depth(&mut gpu, 1, &stored, 0.02).unwrap();
        let step = p.train(&mut gpu, &v, goal(1), &STILL, &weights(WEIGHT)).unwrap();
        assert!(step.stats.visible > 30);
        let n = w * h;
        let (mut rendered, mut gradient) = (vec![0f32; 3 * n], vec![0f32; 3 * n]);
        gpu.download(p.buffers().rendered, 0, &mut rendered).unwrap();
        gpu.download(p.buffers().pixel_gradient, 0, &mut gradient).unwrap();
        let (rendered, gradient) = (wide(&rendered), wide(&gradient));
        let mut compared = 0;
        for i in 0..n {
            let (x, y) = (i % w / 2 * 2, i / w / 2 * 2);
            let cell: Vec<f32> = [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)]
                .iter()
                .filter(|(x, y)| *x < w && *y < h)
                .map(|(x, y)| stored.metres[y * w + x])
                .collect();
            let known: Vec<f32> = cell.iter().copied().filter(|z| *z > 0.0).collect();
            let share = known.len() as f64 / cell.len() as f64;
            let goal = known.first().map_or(0.0, |z| 1.0 / f64::from(*z));
            let (d, t) = (rendered[2 * n + i], rendered[n + i]);
            if (d / (1.0 - t) - goal).abs() < STEP || (t - 0.5).abs() < 1e-4 {
                continue;
            }
            let trust = (share * 15.0).round() / 15.0;
            let (_, twin) = depth(d, t, goal, trust, WEIGHT / n as f64);
            let scale = WEIGHT / n as f64;
            for k in 0..2 {
                let error = (gradient[(1 + k) * n + i] - twin[k]).abs();
                assert!(error < 1e-4 * scale, "pixel {i}, {k}: {} against {}", gradient[(1 + k) * n + i], twin[k]);
            }
            compared += usize::from(twin[0] != 0.0);
        }
        assert!(compared > n / 10, "{compared} of {n}");
    }
}

#[test]
fn training_on_depth_draws_the_map_to_it() {
    let (w, h) = (48, 32);
    let v = view(w, h);
    let rates = LearningRates { position: 5e-3, ..STILL };
    let run = |weight: f64| {
        let (mut gpu, mut p) = open(shape(&v, 256, 1 << 16));
        p.append(&mut gpu, &scene(256, &v, 4)).unwrap();
        p.set_keyframe(&mut gpu, 0, &vec![128; w * h]).unwrap();
        let flat = DepthMap::of(w, h, vec![2.0; w * h]);
        p.set_depth(&mut gpu, 0, &flat, 0.02).unwrap();
        for _ in 0..60 {
            p.train(&mut gpu, &v, goal(0), &rates, &weights(weight)).unwrap();
        }
        let picture = super::splat::render(&mut gpu, &mut p, &v);
        let seen = || picture.depth.iter().zip(&picture.alpha).filter(|(_, a)| **a > 0.5);
        seen().map(|(z, _)| f64::from((1.0 / z - 0.5).abs())).sum::<f64>() / seen().count() as f64
    };
    let (without, with) = (run(0.0), run(1.0));
    assert!(with < 0.5 * without, "{with} against {without} /m");
}
