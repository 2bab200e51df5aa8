//! Twin of ssim_tiles.comp and loss_tiles.comp, and of ssim_rows.comp, ssim_columns.comp, loss_rows.comp and loss_columns.comp: (1 - λ)|x - y| + λ(1 - SSIM), mean over valid pixels, with the two-dimensional
//! window written out. Where the target is white or black, what lies beyond it is not compared.

pub struct Loss {
    pub l1: f64,
    pub ssim: f64,
    /// By the rendered image.
    pub gradient: Vec<f64>,
}

impl Loss {
    pub fn total(&self, ssim_weight: f64) -> f64 {
        (1.0 - ssim_weight) * self.l1 + ssim_weight * (1.0 - self.ssim)
    }
}

const C1: f64 = 1e-4;
const C2: f64 = 9e-4;

/// (pixel, weight) of the window around pixel `i`, the part inside the image.
fn window(i: usize, width: usize, height: usize) -> Vec<(usize, f64)> {
    let tap = |d: i64| (-(d * d) as f64 / (2.0 * 1.5 * 1.5)).exp();
    let sum: f64 = (-5..=5).map(tap).sum();
    let (x, y) = ((i % width) as i64, (i / width) as i64);
    let mut out = Vec::with_capacity(121);
    for dy in -5..=5 {
        for dx in -5..=5 {
            let (u, v) = (x + dx, y + dy);
            if u >= 0 && v >= 0 && u < width as i64 && v < height as i64 {
                out.push(((v * width as i64 + u) as usize, tap(dx) * tap(dy) / (sum * sum)));
            }
        }
    }
    out
}

pub fn loss(x: &[f64], y: &[f64], mask: &[u8], width: usize, height: usize, ssim_weight: f64) -> Loss {
    let n = width * height;
    let valid = mask.iter().filter(|m| **m != 0).count().max(1) as f64;
    let shown = |i: usize| match y[i] {
        b if b >= 1.0 => x[i].min(1.0),
        b if b <= 0.0 => x[i].max(0.0),
        _ => x[i],
    };
    let gate: Vec<f64> = (0..n).map(|i| if shown(i) == x[i] { 1.0 } else { 0.0 }).collect();
    let x = &(0..n).map(shown).collect::<Vec<f64>>();
    let masked = |v: &[f64], i: usize| if mask[i] != 0 { v[i] } else { 0.0 };
    let mut out = Loss { l1: 0.0, ssim: 0.0, gradient: vec![0.0; n] };
    for i in (0..n).filter(|i| mask[*i] != 0) {
        out.l1 += (x[i] - y[i]).abs() / valid;
        let sign = if x[i] == y[i] { 0.0 } else { (x[i] - y[i]).signum() };
        out.gradient[i] += (1.0 - ssim_weight) / valid * sign;

        let w = window(i, width, height);
        let mean = |f: &dyn Fn(usize) -> f64| w.iter().map(|(j, w)| w * f(*j)).sum::<f64>();
        let (mx, my) = (mean(&|j| masked(x, j)), mean(&|j| masked(y, j)));
        let sx = mean(&|j| masked(x, j) * masked(x, j)) - mx * mx;
        let sy = mean(&|j| masked(y, j) * masked(y, j)) - my * my;
        let sxy = mean(&|j| masked(x, j) * masked(y, j)) - mx * my;
        let (a1, a2) = (2.0 * mx * my + C1, 2.0 * sxy + C2);
        let (b1, b2) = (mx * mx + my * my + C1, sx + sy + C2);
        let s = a1 * a2 / (b1 * b2);
        out.ssim += s / valid;
        for (j, w) in w {
            if mask[j] == 0 {
                continue;
            }
            // By x_j: d mx = w, d sx = 2w(x_j - mx), d sxy = w(y_j - my).
            let d = 2.0 * my * w / a1 + 2.0 * w * (y[j] - my) / a2 - 2.0 * mx * w / b1 - 2.0 * w * (x[j] - mx) / b2;
            out.gradient[j] -= ssim_weight / valid * s * d;
        }
    }
    out.gradient.iter_mut().zip(gate).for_each(|(v, gate)| *v *= gate);
    out
}

/// As `loss`, of gain · x + offset; beside it the gradient by gain and offset.
pub fn exposed(
    x: &[f64],
    y: &[f64],
    mask: &[u8],
    (width, height): (usize, usize),
    ssim_weight: f64,
    [gain, offset]: [f64; 2],
) -> (Loss, [f64; 2]) {
    let shown: Vec<f64> = x.iter().map(|x| gain * x + offset).collect();
    let mut out = loss(&shown, y, mask, width, height, ssim_weight);
    let by_gain = out.gradient.iter().zip(x).map(|(v, x)| v * x).sum();
    let by_offset = out.gradient.iter().sum();
    out.gradient.iter_mut().for_each(|v| *v *= gain);
    (out, [by_gain, by_offset])
}
