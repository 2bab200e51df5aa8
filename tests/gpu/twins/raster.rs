//! Twin of raster_forward.comp and raster_backward.comp: every pixel against every Gaussian, the
//! backward pass from the back to the front.

use super::project::Projected;

pub const ALPHA_MIN: f64 = 1.0 / 255.0;
const ALPHA_MAX: f64 = 0.99;
const TRANSMITTANCE_MIN: f64 = 1e-4;

pub struct Rendered {
    pub grey: Vec<f64>,
    pub transmittance: Vec<f64>,
    pub depth: Vec<f64>,
    /// How close any decision (alpha floor, alpha cap, opaque) came to falling the other way, relative.
    pub margin: f64,
}

/// One contribution to a pixel.
struct Seen {
    splat: usize,
    d: [f64; 2],
    raw: f64,
    alpha: f64,
    before: f64,
}

fn order(splats: &[Option<Projected>]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..splats.len()).filter(|i| splats[*i].is_some()).collect();
    // Depths are compared as the kernels see them.
    order.sort_by_key(|i| splats[*i].as_ref().map(|p| (p[7].v as f32).to_bits()));
    order
}

fn contributions(splats: &[Option<Projected>], order: &[usize], x: usize, y: usize, margin: &mut f64) -> Vec<Seen> {
    let mut t = 1.0;
    let mut seen = Vec::new();
    let near = |a: f64, b: f64, margin: &mut f64| *margin = margin.min((a / b - 1.0).abs());
    for &splat in order {
        let Some(p) = &splats[splat] else { continue };
        let d = [p[0].v - x as f64, p[1].v - y as f64];
        let sigma = 0.5 * (p[2].v * d[0] * d[0] + p[4].v * d[1] * d[1]) + p[3].v * d[0] * d[1];
        let raw = p[5].v * (-sigma).exp();
        near(raw, ALPHA_MIN, margin);
        if raw < ALPHA_MIN {
            continue;
        }
        near(raw, ALPHA_MAX, margin);
        let alpha = raw.min(ALPHA_MAX);
        seen.push(Seen { splat, d, raw, alpha, before: t });
        t *= 1.0 - alpha;
        near(t, TRANSMITTANCE_MIN, margin);
        if t <= TRANSMITTANCE_MIN {
            break;
        }
    }
    seen
}

pub fn forward(splats: &[Option<Projected>], width: usize, height: usize) -> Rendered {
    let order = order(splats);
    let n = width * height;
    let mut out = Rendered { grey: vec![0.0; n], transmittance: vec![1.0; n], depth: vec![0.0; n], margin: 1.0 };
    for i in 0..n {
        for s in contributions(splats, &order, i % width, i / width, &mut out.margin) {
            let Some(p) = &splats[s.splat] else { continue };
            let w = s.alpha * s.before;
            out.grey[i] += w * p[6].v;
            out.depth[i] += w * p[7].v;
            out.transmittance[i] = s.before * (1.0 - s.alpha);
        }
        out.depth[i] /= (1.0 - out.transmittance[i]).max(1e-6);
    }
    out
}

/// Gradient by the first seven entries of each `Projected`.
pub fn backward(splats: &[Option<Projected>], width: usize, height: usize, v_grey: &[f64]) -> Vec<[f64; 7]> {
    let order = order(splats);
    let mut out = vec![[0.0; 7]; splats.len()];
    for i in 0..width * height {
        let mut behind = 0.0; // grey of what lies behind, as seen through nothing else
        for s in contributions(splats, &order, i % width, i / width, &mut 1.0).iter().rev() {
            let Some(p) = &splats[s.splat] else { continue };
            let g = &mut out[s.splat];
            let v_alpha = v_grey[i] * s.before * (p[6].v - behind);
            g[6] += v_grey[i] * s.before * s.alpha;
            behind = s.alpha * p[6].v + (1.0 - s.alpha) * behind;
            if s.raw > ALPHA_MAX {
                continue;
            }
            let v_sigma = -s.alpha * v_alpha;
            g[0] += v_sigma * (p[2].v * s.d[0] + p[3].v * s.d[1]);
            g[1] += v_sigma * (p[3].v * s.d[0] + p[4].v * s.d[1]);
            g[2] += v_sigma * 0.5 * s.d[0] * s.d[0];
            g[3] += v_sigma * s.d[0] * s.d[1];
            g[4] += v_sigma * 0.5 * s.d[1] * s.d[1];
            g[5] += v_alpha * s.alpha / p[5].v;
        }
    }
    out
}
