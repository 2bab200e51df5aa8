//! How far a matched disparity may be off: its standard deviation, px, for methods that do not say.
//!
//! Parts added as variances: a floor (interpolation between whole disparities, calibration); the grey levels' noise over
//! the picture's horizontal gradient in the window, which is the Cramér-Rao bound of a shift, σ² = 2 n² / Σ gₓ² (Delon and
//! Rougé, JMIV 2007, eq. 20); how far the disparity is from the mean of the window's, and how far these are from a plane,
//! which is none on a plane and large where two surfaces meet, where matching by windows errs; the latter the more, the
//! smaller the disparity is, since far off two surfaces differ by little and the wrong one of them is as wrong; and the
//! share of the window where nothing was matched. Sums of the window are carried along columns and rows.

use super::Disparity;
use crate::config::{StereoConfig, StereoMethod};
use stipple_drivers::Image;

/// What a method's errors were fitted with.
#[derive(Clone, Copy, Debug)]
struct Fit {
    /// px².
    floor: f64,
    /// Twice the squared noise, grey levels².
    noise: f64,
    /// By the squared distance to the window's mean.
    off: f64,
    /// By the squared distance of the window from a plane, and by the same over the disparity, px.
    bent: f64,
    bent_far: f64,
    /// By the share of the window that is unknown, px².
    missing: f64,
}

/// Factors of greatest likelihood on simulated flights: errors are as large as they say on others (tests/bench/README.md).
const BM: Fit = Fit { floor: 2.5e-4, noise: 1.99, off: 1.318, bent: 2.20, bent_far: 1.40, missing: 0.180 };
const SGBM: Fit = Fit { floor: 8.14e-3, noise: 20.6, off: 0.904, bent: 2.19, bent_far: 1.30, missing: 0.606 };

/// Half the side of the window, px.
const HALF: usize = 5;
/// Squared distance from a plane beyond which the deviation says no more, px².
const BENT_MAX: f64 = 25.0;

pub struct Confidence {
    fit: Fit,
    columns: Vec<Sums>,
}

/// Over pixels: of all, and of those known with their place and disparity. What is added can be taken away again, to a
/// rounding error of 1e-9 px².
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    pixels: f64,
    gradient2: f64,
    known: f64,
    /// Columns, rows and disparities.
    first: [f64; 3],
    squares: [f64; 3],
    /// Columns and rows times disparities.
    products: [f64; 2],
}

impl Confidence {
    pub fn new(width: usize, config: &StereoConfig) -> Confidence {
        let fit = if config.method == StereoMethod::Bm { BM } else { SGBM };
        Confidence { fit, columns: vec![Sums::default(); width] }
    }

    /// Fills in the standard deviations of what is known.
    pub fn estimate(&mut self, left: &Image, out: &mut Disparity) {
        let (w, h) = (out.width, out.height);
        let fit = self.fit;
        self.columns.fill(Sums::default());
        for y in 0..h + HALF {
            for (x, column) in self.columns.iter_mut().enumerate() {
                if y < h {
                    column.add(&Sums::of(left, out, x, y), 1.0);
                }
                if y > 2 * HALF {
                    column.add(&Sums::of(left, out, x, y - 2 * HALF - 1), -1.0);
                }
            }
            let Some(row) = y.checked_sub(HALF) else { continue };
            let mut window = Sums::default();
            for x in 0..w + HALF {
                if x < w {
                    window.add(&self.columns[x], 1.0);
                }
                if x > 2 * HALF {
                    window.add(&self.columns[x - 2 * HALF - 1], -1.0);
                }
                let Some(i) = x.checked_sub(HALF).map(|x| row * w + x) else { continue };
                if out.px[i] >= 0.0 {
                    out.sigma_px[i] = fit.sigma(f64::from(out.px[i]), &window) as f32;
                }
            }
        }
    }
}

impl Sums {
    fn of(left: &Image, disparity: &Disparity, x: usize, y: usize) -> Sums {
        let w = left.width;
        let row = &left.pixels[y * w..][..w];
        let g = 0.5 * (f64::from(row[(x + 1).min(w - 1)]) - f64::from(row[x.saturating_sub(1)]));
        let mut sums = Sums { pixels: 1.0, gradient2: g * g, ..Sums::default() };
        let d = disparity.px[y * w + x];
        if d >= 0.0 {
            let place = [x as f64, y as f64, f64::from(d)];
            sums.known = 1.0;
            sums.first = place;
            sums.squares = place.map(|v| v * v);
            sums.products = [place[0] * place[2], place[1] * place[2]];
        }
        sums
    }

    fn add(&mut self, other: &Sums, sign: f64) {
        self.pixels += sign * other.pixels;
        self.gradient2 += sign * other.gradient2;
        self.known += sign * other.known;
        (0..3).for_each(|k| self.first[k] += sign * other.first[k]);
        (0..3).for_each(|k| self.squares[k] += sign * other.squares[k]);
        (0..2).for_each(|k| self.products[k] += sign * other.products[k]);
    }

    fn mean(&self) -> [f64; 3] {
        self.first.map(|sum| sum / self.known.max(1.0))
    }

    /// Mean squared distance of the disparities from a plane; a window is about as wide in all its rows, so that columns
    /// and rows can be fitted one by one.
    fn bent(&self) -> f64 {
        let (n, mean) = (self.known.max(1.0), self.mean());
        let variance = |k: usize| (self.squares[k] / n - mean[k] * mean[k]).max(0.0);
        let explained = |k: usize| (self.products[k] / n - mean[k] * mean[2]).powi(2) / variance(k).max(1e-3);
        (variance(2) - explained(0) - explained(1)).clamp(0.0, BENT_MAX)
    }
}

impl Fit {
    fn sigma(&self, d: f64, window: &Sums) -> f64 {
        let off = d - window.mean()[2];
        let variance = self.floor
            + self.noise / window.gradient2.max(1.0)
            + self.off * off * off
            + (self.bent + self.bent_far / d.max(1.0)) * window.bent()
            + self.missing * (1.0 - window.known / window.pixels);
        variance.sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Deviations in a picture whose columns differ by `contrast`, with `step` px more disparity right of the middle.
    fn sigmas(contrast: u8, step: f32) -> Vec<f32> {
        let (w, h) = (64, 32);
        let mut image = Image::new(w, h);
        image.pixels.iter_mut().enumerate().for_each(|(i, p)| *p = 100 + contrast * (i % w / 2 % 2) as u8);
        let mut d = Disparity::new(w, h);
        d.px.iter_mut().enumerate().for_each(|(i, p)| *p = 10.0 + if i % w >= w / 2 { step } else { 0.0 });
        Confidence::new(w, &StereoConfig::default()).estimate(&image, &mut d);
        d.sigma_px[16 * w..17 * w].to_vec()
    }

    #[test]
    fn detail_is_sure_and_blank_walls_and_borders_are_not() {
        let (sharp, faint, edge) = (sigmas(100, 0.0)[10], sigmas(2, 0.0)[10], sigmas(100, 6.0));
        assert!(sharp < 0.2 && faint > 1.5 * sharp, "{sharp} {faint}");
        assert!(edge[31] > 5.0 * sharp && (edge[10] - sharp).abs() < 1e-3, "{edge:?}");
    }

    /// Deviation in the middle of a picture of these disparities.
    fn sigma_of(disparity: impl Fn(f32, f32) -> f32) -> f32 {
        let (w, h) = (48, 40);
        let mut image = Image::new(w, h);
        image.pixels.iter_mut().enumerate().for_each(|(i, p)| *p = 100 + 50 * (i % w / 2 % 2) as u8);
        let mut d = Disparity::new(w, h);
        d.px.iter_mut().enumerate().for_each(|(i, p)| *p = disparity((i % w) as f32 - 24.0, (i / w) as f32 - 20.0));
        Confidence::new(w, &StereoConfig::default()).estimate(&image, &mut d);
        d.sigma_px[20 * w + 24]
    }

    #[test]
    fn a_slope_is_as_sure_as_a_wall_and_a_step_far_off_less_sure_than_one_near_by() {
        let (wall, slope) = (sigma_of(|_, _| 10.0), sigma_of(|x, y| 10.0 + 0.2 * x - 0.1 * y));
        assert!((wall - slope).abs() < 1e-4, "{wall} {slope}");
        let step = |d: f32| sigma_of(move |x, _| d + f32::from(x > 2.0));
        assert!(step(3.0) > 1.02 * step(60.0) && step(60.0) > 2.0 * wall, "{} {} {wall}", step(3.0), step(60.0));
        let sparse = sigma_of(|x, y| if x == 0.0 || y < 0.0 { 10.0 } else { -1.0 });
        assert!(sparse > 2.0 * wall, "{sparse} {wall}");
    }
}
