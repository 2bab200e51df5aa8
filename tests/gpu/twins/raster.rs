//! Twin of raster_forward.comp and raster_backward.comp: every pixel against every Gaussian, the
//! backward pass from the back to the front.

use super::lists::depth_key;
use super::project::Projected;

pub const ALPHA_MIN: f64 = 1.0 / 255.0;
const ALPHA_MAX: f64 = 0.99;
const TRANSMITTANCE_MIN: f64 = 1e-4;

/// A Gaussian on the image, and a gradient by it, in the order of a gradient slot: centre x, y (integer = pixel
/// centre); conic a, b, c; opacity; grey or red; depth; green, blue.
pub type Flat = [f64; 10];

/// Where the three channels of a colour are; grey has the first.
const COLOUR: [usize; 3] = [6, 8, 9];
const DEPTH: usize = 7;

/// A colour, or a gradient by it, by pixel.
#[derive(Clone, Default)]
pub struct Planes {
    pub colour: [Vec<f64>; 3],
}

pub struct Rendered {
    pub planes: Planes,
    pub transmittance: Vec<f64>,
    /// Expected, m.
    pub depth: Vec<f64>,
    /// How close any decision (alpha floor, alpha cap, opaque) came to falling the other way, relative.
    pub margin: f64,
}

impl Planes {
    pub fn zeros(n: usize) -> Planes {
        let zeros = || vec![0.0; n];
        Planes { colour: [zeros(), zeros(), zeros()] }
    }

    /// Planes of grey alone.
    pub fn grey(grey: &[f64]) -> Planes {
        let mut p = Planes::zeros(grey.len());
        p.colour[0].copy_from_slice(grey);
        p
    }

    fn all(&self) -> impl Iterator<Item = &f64> {
        self.colour.iter().flatten()
    }

    /// The loss that this is the gradient of.
    pub fn dot(&self, rendered: &Planes) -> f64 {
        self.all().zip(rendered.all()).map(|(a, b)| a * b).sum()
    }
}

/// A grey Gaussian as `project` leaves it.
pub fn flat(p: &Projected) -> Flat {
    let v = |i: usize| p[i].v;
    [v(0), v(1), v(2), v(3), v(4), v(5), v(6), v(7), 0.0, 0.0]
}

/// One contribution to a pixel.
struct Seen {
    splat: usize,
    d: [f64; 2],
    raw: f64,
    alpha: f64,
    before: f64,
}

fn order(splats: &[Option<Flat>]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..splats.len()).filter(|i| splats[*i].is_some()).collect();
    order.sort_by_key(|i| splats[*i].as_ref().map(|p| depth_key(p[DEPTH] as f32)));
    order
}

fn contributions(splats: &[Option<Flat>], order: &[usize], x: usize, y: usize, margin: &mut f64) -> Vec<Seen> {
    let mut t = 1.0;
    let mut seen = Vec::new();
    let near = |a: f64, b: f64, margin: &mut f64| *margin = margin.min((a / b - 1.0).abs());
    for &splat in order {
        let Some(p) = &splats[splat] else { continue };
        let d = [p[0] - x as f64, p[1] - y as f64];
        let sigma = 0.5 * (p[2] * d[0] * d[0] + p[4] * d[1] * d[1]) + p[3] * d[0] * d[1];
        let raw = p[5] * (-sigma).exp();
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

pub fn forward(splats: &[Option<Flat>], width: usize, height: usize) -> Rendered {
    let order = order(splats);
    let n = width * height;
    let mut out = Rendered { planes: Planes::zeros(n), transmittance: vec![1.0; n], depth: vec![0.0; n], margin: 1.0 };
    for i in 0..n {
        for s in contributions(splats, &order, i % width, i / width, &mut out.margin) {
            let Some(p) = &splats[s.splat] else { continue };
            let w = s.alpha * s.before;
            (0..3).for_each(|c| out.planes.colour[c][i] += w * p[COLOUR[c]]);
            out.depth[i] += w * p[DEPTH];
            out.transmittance[i] = s.before * (1.0 - s.alpha);
        }
        out.depth[i] /= (1.0 - out.transmittance[i]).max(1e-6);
    }
    out
}

/// From the gradient by what is blended, and what light from beyond all Gaussians of a pixel is worth, to the gradient by each.
pub fn backward(splats: &[Option<Flat>], width: usize, height: usize, v: &Planes, beyond: &[f64]) -> Vec<Flat> {
    let order = order(splats);
    let mut out = vec![[0.0; 10]; splats.len()];
    for i in 0..width * height {
        // What one unit of light that gets here is worth: what lies behind, seen through nothing else.
        let mut behind = beyond[i];
        for s in contributions(splats, &order, i % width, i / width, &mut 1.0).iter().rev() {
            let Some(p) = &splats[s.splat] else { continue };
            let g = &mut out[s.splat];
            let blended = [(6, &v.colour[0]), (8, &v.colour[1]), (9, &v.colour[2])];
            let worth: f64 = blended.iter().map(|(k, v)| p[*k] * v[i]).sum();
            blended.iter().for_each(|(k, v)| g[*k] += v[i] * s.before * s.alpha);
            let v_alpha = s.before * (worth - behind);
            behind = s.alpha * worth + (1.0 - s.alpha) * behind;
            if s.raw > ALPHA_MAX {
                continue;
            }
            let v_sigma = -s.alpha * v_alpha;
            g[0] += v_sigma * (p[2] * s.d[0] + p[3] * s.d[1]);
            g[1] += v_sigma * (p[3] * s.d[0] + p[4] * s.d[1]);
            g[2] += v_sigma * 0.5 * s.d[0] * s.d[0];
            g[3] += v_sigma * s.d[0] * s.d[1];
            g[4] += v_sigma * 0.5 * s.d[1] * s.d[1];
            g[5] += v_alpha * s.alpha / p[5];
        }
    }
    out
}
