//! PSNR and SSIM as the Gaussian splatting literature computes them, over the valid pixels of a view.
//!
//! Images are grey in 0..=1, row-major, or in colour plane by plane; `valid` is of one plane. PSNR is that of one image's mean squared error; figures of a set
//! are means over its images. SSIM (Wang et al., IEEE TIP 2004) has an 11x11 Gaussian window, σ 1.5 px,
//! zero-padded, the dynamic range 1; invalid pixels are zero in both images, as the padding is.

pub const WINDOW: usize = 11;
const RADIUS: usize = WINDOW / 2;
const SIGMA_PX: f64 = 1.5;
/// (0.01 L)² and (0.03 L)² of the paper, L = 1.
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;
/// What two equal images score: 1e-10 is below what 8 bits resolve by orders.
const MSE_MIN: f64 = 1e-10;

/// Mean squared error over valid pixels of all planes; `None` if there are none.
pub fn mse(observed: &[f32], rendered: &[f32], valid: &[u8]) -> Option<f64> {
    let (mut sum, mut n) = (0.0, 0u32);
    for i in 0..observed.len() {
        if valid[i % valid.len()] != 0 {
            let e = f64::from(observed[i]) - f64::from(rendered[i].clamp(0.0, 1.0));
            sum += e * e;
            n += 1;
        }
    }
    (n > 0).then(|| sum / f64::from(n))
}

/// PSNR of a mean squared error, dB; 100 at most, and not a number where the error is none.
pub fn psnr_db(mse: f64) -> f64 {
    -10.0 * (if mse < MSE_MIN { MSE_MIN } else { mse }).log10()
}

/// Weights of the 1-D window, sum 1; the 2-D window is their product.
pub fn window() -> [f64; WINDOW] {
    let mut w = [0.0; WINDOW];
    for (i, w) in w.iter_mut().enumerate() {
        let d = i as f64 - RADIUS as f64;
        *w = (-d * d / (2.0 * SIGMA_PX * SIGMA_PX)).exp();
    }
    let sum: f64 = w.iter().sum();
    w.map(|w| w / sum)
}

/// Structural similarity, with the buffers of its five filtered moments.
pub struct Ssim {
    width: usize,
    height: usize,
    moments: [Vec<f64>; 5],
    rows: Vec<f64>,
}

impl Ssim {
    pub fn new(width: usize, height: usize) -> Ssim {
        let n = width * height;
        Ssim { width, height, moments: std::array::from_fn(|_| vec![0.0; n]), rows: vec![0.0; n] }
    }

    /// Mean over valid pixels of all planes; `None` if there are none.
    pub fn mean(&mut self, observed: &[f32], rendered: &[f32], valid: &[u8]) -> Option<f64> {
        let (mut sum, mut n) = (0.0, 0u32);
        for (observed, rendered) in observed.chunks_exact(valid.len()).zip(rendered.chunks_exact(valid.len())) {
            self.each(observed, rendered, valid, |_, s| {
                sum += s;
                n += 1;
            });
        }
        (n > 0).then(|| sum / f64::from(n))
    }

    /// Calls `f(pixel, ssim)` at every valid pixel.
    pub fn each(&mut self, observed: &[f32], rendered: &[f32], valid: &[u8], mut f: impl FnMut(usize, f64)) {
        for i in 0..valid.len() {
            let inside = f64::from(valid[i].min(1));
            let x = f64::from(rendered[i].clamp(0.0, 1.0)) * inside;
            let y = f64::from(observed[i]) * inside;
            for (m, v) in self.moments.iter_mut().zip([x, y, x * x, y * y, x * y]) {
                m[i] = v;
            }
        }
        let w = window();
        for m in &mut self.moments {
            blur(m, &mut self.rows, self.width, self.height, &w);
        }
        for i in (0..valid.len()).filter(|&i| valid[i] != 0) {
            let [mx, my, xx, yy, xy] = std::array::from_fn(|k| self.moments[k][i]);
            let (sx, sy, sxy) = (xx - mx * mx, yy - my * my, xy - mx * my);
            let s = (2.0 * mx * my + C1) * (2.0 * sxy + C2) / ((mx * mx + my * my + C1) * (sx + sy + C2));
            f(i, s);
        }
    }
}

/// Separable filter in place; outside the image is zero.
fn blur(image: &mut [f64], rows: &mut [f64], width: usize, height: usize, w: &[f64; WINDOW]) {
    for y in 0..height {
        for x in 0..width {
            let (first, last) = (x.saturating_sub(RADIUS), (x + RADIUS).min(width - 1));
            let taps = &w[first + RADIUS - x..=last + RADIUS - x];
            let row = &image[y * width + first..=y * width + last];
            rows[y * width + x] = row.iter().zip(taps).map(|(v, w)| v * w).sum();
        }
    }
    image.fill(0.0);
    for y in 0..height {
        let (first, last) = (y.saturating_sub(RADIUS), (y + RADIUS).min(height - 1));
        for v in first..=last {
            let weight = w[v + RADIUS - y];
            let to = &mut image[y * width..(y + 1) * width];
            to.iter_mut().zip(&rows[v * width..(v + 1) * width]).for_each(|(t, r)| *t += weight * r);
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn noise(seed: u32, n: usize) -> Vec<f32> {
        let mut s = seed;
        let mut next = || {
            s = s.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (s >> 8) as f32 / (1 << 24) as f32
        };
        (0..n).map(|_| next()).collect()
    }

    #[test]
    fn psnr_of_a_tenth_is_twenty_db_and_ignores_invalid_pixels() {
        let observed = [0.5, 0.5, 0.5, 0.9];
        let rendered = [0.6, 0.4, 0.6, 0.0];
        let e = mse(&observed, &rendered, &[1, 1, 1, 0]).unwrap();
        assert!((psnr_db(e) - 20.0).abs() < 1e-5, "{}", psnr_db(e));
        assert_eq!(mse(&observed, &rendered, &[0; 4]), None);
    }

    #[test]
    fn rendered_values_are_clamped_before_comparison() {
        assert_eq!(mse(&[1.0, 0.0], &[1.7, -0.3], &[1, 1]), Some(0.0));
    }

    #[test]
    fn ssim_of_equal_images_is_one() {
        let a = noise(1, 20 * 15);
        let s = Ssim::new(20, 15).mean(&a, &a, &[1; 300]).unwrap();
        assert!((s - 1.0).abs() < 1e-12);
    }

    #[test]
    fn ssim_of_constants_is_the_luminance_term() {
        // Deep inside, variances vanish: (2 a b + C1) / (a² + b² + C1).
        let (a, b) = (0.25f32, 0.75f32);
        let mut at_centre = 0.0;
        let (w, h) = (25, 25);
        Ssim::new(w, h).each(&[a; 625], &[b; 625], &[1; 625], |i, s| {
            if i == 12 * w + 12 {
                at_centre = s;
            }
        });
        let expected = (2.0 * 0.25 * 0.75 + C1) / (0.0625 + 0.5625 + C1);
        assert!((at_centre - expected).abs() < 1e-6, "{at_centre} {expected}");
    }

    #[test]
    fn ssim_equals_the_two_dimensional_definition() {
        let (w, h) = (17usize, 13usize);
        let (a, b) = (noise(3, w * h), noise(4, w * h));
        let mut valid = vec![1u8; w * h];
        valid[5 * w + 6..5 * w + 11].fill(0);
        let g = window();
        let mut worst = 0.0f64;
        Ssim::new(w, h).each(&a, &b, &valid, |i, s| {
            let (x0, y0) = ((i % w) as i64, (i / w) as i64);
            let mut m = [0.0; 5];
            for dy in -5..=5i64 {
                for dx in -5..=5i64 {
                    let (x, y) = (x0 + dx, y0 + dy);
                    if x < 0 || y < 0 || x >= w as i64 || y >= h as i64 {
                        continue;
                    }
                    let j = y as usize * w + x as usize;
                    let v = f64::from(valid[j]);
                    let (p, q) = (f64::from(b[j]) * v, f64::from(a[j]) * v);
                    let weight = g[(dx + 5) as usize] * g[(dy + 5) as usize];
                    for (m, t) in m.iter_mut().zip([p, q, p * p, q * q, p * q]) {
                        *m += weight * t;
                    }
                }
            }
            let (sx, sy, sxy) = (m[2] - m[0] * m[0], m[3] - m[1] * m[1], m[4] - m[0] * m[1]);
            let expected =
                (2.0 * m[0] * m[1] + C1) * (2.0 * sxy + C2) / ((m[0] * m[0] + m[1] * m[1] + C1) * (sx + sy + C2));
            worst = worst.max((s - expected).abs());
        });
        assert!(worst < 1e-10, "{worst}");
    }

    #[test]
    fn window_is_the_published_one() {
        // The values every 3DGS implementation tabulates.
        let published = [0.00102838, 0.00759876, 0.03600077, 0.10936069, 0.21300553, 0.26601172];
        for (w, p) in window().iter().zip(published) {
            assert!((w - p).abs() < 1e-8);
        }
    }
}
