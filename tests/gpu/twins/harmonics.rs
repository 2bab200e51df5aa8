//! Twin of harmonics.comp and harmonics_backward.comp: colours by the definition of real spherical harmonics.

use super::project::Parameters;
use super::raster::{self, Planes};
use super::{descend, flat, project_all};
use glam::DVec3;
use stipple::map::pipeline::View;

/// Twin of harmonics_insert.comp: green and blue as they came, and nothing beyond.
pub fn harmonics_insert(tint: [f64; 2], channels: usize, degree: usize) -> Vec<f64> {
    let mut c = vec![0.0; channels * (degree + 1) * (degree + 1) - 1];
    c[..channels - 1].copy_from_slice(&tint[..channels - 1]);
    c
}

fn factorial(n: i64) -> f64 {
    (1..=n).map(|k| k as f64).product()
}

/// Associated Legendre function with the Condon-Shortley phase, by its recurrence.
fn legendre(l: i64, m: i64, x: f64) -> f64 {
    let mut p = (1..=m).fold(1.0, |p, k| -p * (2 * k - 1) as f64 * (1.0 - x * x).sqrt());
    let mut before = 0.0;
    for n in m + 1..=l {
        (before, p) = (p, ((2 * n - 1) as f64 * x * p - (n + m - 1) as f64 * before) / (n - m) as f64);
    }
    p
}

/// Y_lm for l = 1..=degree, m = -l..=l.
pub fn basis(d: DVec3, degree: usize) -> Vec<f64> {
    let phi = d.y.atan2(d.x);
    let mut out = Vec::new();
    for l in 1..=degree as i64 {
        for m in -l..=l {
            let a = m.abs();
            let norm = ((2 * l + 1) as f64 / (4.0 * std::f64::consts::PI) * factorial(l - a) / factorial(l + a)).sqrt();
            let around = match m.signum() {
                0 => 1.0,
                1 => 2f64.sqrt() * (a as f64 * phi).cos(),
                _ => 2f64.sqrt() * (a as f64 * phi).sin(),
            };
            out.push(norm * around * legendre(l, a, d.z));
        }
    }
    out
}

/// Of each channel, from where the eye is.
fn colour(first: f64, extra: &[f64], mean: DVec3, eye: DVec3, channels: usize, degree: usize) -> [f64; 3] {
    let y = basis((mean - eye).normalize(), degree);
    std::array::from_fn(|c| match c {
        _ if c >= channels => 0.0,
        _ => {
            let constant = if c == 0 { first } else { extra[c - 1] };
            constant + y.iter().enumerate().map(|(k, y)| y * extra[channels - 1 + k * channels + c]).sum::<f64>()
        }
    })
}

pub struct Coloured {
    pub splats: Vec<[f64; 12]>,
    pub extra: Vec<Vec<f64>>,
    pub twist: [f64; 6],
    pub rendered: raster::Rendered,
}

/// Renders in colour and carries a gradient by pixel back to every parameter, coefficient and the pose twist.
pub fn step(
    splats: &[Parameters],
    extra: &[Vec<f64>],
    view: &View,
    twist: &[f64; 6],
    v: &Planes,
    (channels, degree): (usize, usize),
) -> Coloured {
    let (w, h) = (view.camera.width, view.camera.height);
    let mut projected = project_all(splats, view, twist);
    // x -> Exp(φ) x + ρ leaves the eye where it was but for ρ; the twin turns first and shifts then.
    let turn = glam::DQuat::from_scaled_axis(DVec3::from_slice(&twist[3..]));
    let eye = view.world_from_cam.transform(turn.conjugate() * -DVec3::from_slice(&twist[..3]));
    let mean = |i: usize| DVec3::from_slice(&splats[i][..3]);
    let seen = |i: usize, p: DVec3, e: DVec3| colour(splats[i][11], &extra[i], p, e, channels, degree);
    let mut flats = flat(&projected);
    for (i, f) in flats.iter_mut().enumerate() {
        let Some(f) = f else { continue };
        let c = seen(i, mean(i), eye);
        (f[6], f[8], f[9]) = (c[0], c[1], c[2]);
        if let Some(p) = &mut projected[i] {
            p[6].v = c[0];
        }
    }
    let rendered = raster::forward(&flats, w, h);
    let image = raster::backward(&flats, w, h, v);
    let (mut by_splat, mut by_twist) = (vec![[0.0; 12]; splats.len()], [0.0; 6]);
    let mut by_extra: Vec<Vec<f64>> = extra.iter().map(|e| vec![0.0; e.len()]).collect();
    for (i, p) in projected.iter().enumerate() {
        let Some(p) = p else { continue };
        for (g, d) in image[i].iter().zip(p) {
            (0..12).for_each(|k| by_splat[i][k] += g * d.d[k]);
            (0..6).for_each(|k| by_twist[k] += g * d.d[12 + k]);
        }
        let g = [image[i][6], image[i][8], image[i][9]];
        let y = basis((mean(i) - eye).normalize(), degree);
        for c in 0..channels {
            if c > 0 {
                by_extra[i][c - 1] = g[c];
            }
            for (k, y) in y.iter().enumerate() {
                by_extra[i][channels - 1 + k * channels + c] = g[c] * y;
            }
        }
        // By the direction, numerically: of the colour weighted with its gradient.
        let weighed = |p: DVec3| seen(i, p, eye).iter().zip(g).map(|(c, g)| c * g).sum::<f64>();
        const STEP: f64 = 1e-5;
        let along = DVec3::from_array(
            [DVec3::X, DVec3::Y, DVec3::Z]
                .map(|a| (weighed(mean(i) + STEP * a) - weighed(mean(i) - STEP * a)) / (2.0 * STEP)),
        );
        let in_cam = view.world_from_cam.q.conjugate() * along;
        for k in 0..3 {
            by_splat[i][k] += along[k];
            by_twist[k] += in_cam[k];
        }
    }
    Coloured { splats: by_splat, extra: by_extra, twist: by_twist, rendered }
}

/// Grey of degree 0 is `descend`.
pub fn grey_agrees(splats: &[Parameters], view: &View, v: &Planes) -> bool {
    let plain = descend(&project_all(splats, view, &[0.0; 6]), view, v);
    let none = vec![Vec::new(); splats.len()];
    let coloured = step(splats, &none, view, &[0.0; 6], v, (1, 0));
    plain.0.iter().flatten().zip(coloured.splats.iter().flatten()).all(|(a, b)| (a - b).abs() < 1e-12)
}

/// Twin of harmonics_turn.comp: one channel's coefficients after their Gaussian was turned, each the integral over the
/// sphere of the turned colour times its function, by the midpoint rule.
pub fn harmonics_turn(c: &[f64], by: glam::DQuat, degree: usize) -> Vec<f64> {
    const N: usize = 60;
    let mut out = vec![0.0; c.len()];
    for i in 0..2 * N {
        for j in 0..N {
            let phi = std::f64::consts::PI * (i as f64 + 0.5) / N as f64;
            let theta = std::f64::consts::PI * (j as f64 + 0.5) / N as f64;
            let d = DVec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos());
            let area = theta.sin() * (std::f64::consts::PI / N as f64).powi(2);
            let seen: f64 = c.iter().zip(basis(by.conjugate() * d, degree)).map(|(c, y)| c * y).sum();
            out.iter_mut().zip(basis(d, degree)).for_each(|(o, y)| *o += area * seen * y);
        }
    }
    out
}
