//! How far a matched disparity may be off: its standard deviation, px, for methods that do not say.
//!
//! Three parts, added as variances: a floor (interpolation between whole disparities, calibration); the
//! grey levels' noise over the picture's horizontal gradient in the window, which is the Cramér-Rao bound
//! of a shift, σ² = 2 n² / Σ gₓ² (Delon and Rougé, JMIV 2007, eq. 20); and a share of how far the disparity
//! is from the mean of the window's, which is none on a plane and large where two surfaces meet, where
//! matching by windows errs. Windows are summed down columns, then along the row.

use super::method::Disparity;
use crate::config::{StereoConfig, StereoMethod};
use crate::mem::Footprint;
use stipple_drivers::Image;

/// What a method's errors were fitted with.
#[derive(Clone, Copy, Debug)]
struct Fit {
    floor_px: f32,
    /// Grey levels.
    noise: f32,
    /// Of the distance to the window's mean.
    edge: f32,
}

/// Side of the window, px.
const WINDOW: usize = 11;

pub struct Confidence {
    fit: Fit,
    columns: Vec<Column>,
}

/// Sums down one column of the window.
#[derive(Clone, Copy, Debug, Default)]
struct Column {
    gradient2: f32,
    disparity: f32,
    known: f32,
}

impl Confidence {
    pub fn footprint(width: usize) -> Footprint {
        let mut f = Footprint::default();
        f.host("stereo: sums of the confidence", width * size_of::<Column>());
        f
    }

    pub fn new(width: usize, config: &StereoConfig) -> Confidence {
        // To simulated flights of `stipple bench stereo`: over all of 0.5 to 20 m residuals have a variance of 1.01 (bm) and
        // 1.08 (sgbm); by range 0.85 to 1.17 and 0.96 to 1.16, but 1.41 of sgbm beyond 8 m.
        let fit = match config.method {
            StereoMethod::Bm => Fit { floor_px: 0.15, noise: 6.0, edge: 0.5 },
            _ => Fit { floor_px: 0.18, noise: 7.1, edge: 0.36 },
        };
        Confidence { fit, columns: vec![Column::default(); width] }
    }

    /// Fills in the standard deviations of what is known.
    pub fn estimate(&mut self, left: &Image, out: &mut Disparity) {
        let (w, h, half) = (out.width, out.height, WINDOW / 2);
        for y in 0..h {
            let (top, bottom) = (y.saturating_sub(half), (y + half + 1).min(h));
            for (x, column) in self.columns.iter_mut().enumerate() {
                *column = Column::default();
                for row in top..bottom {
                    column.add(left, out, x, row);
                }
            }
            for x in 0..w {
                let d = out.px[y * w + x];
                if d >= 0.0 {
                    let window = &self.columns[x.saturating_sub(half)..(x + half + 1).min(w)];
                    let sum = window.iter().fold(Column::default(), Column::plus);
                    out.sigma_px[y * w + x] = self.fit.sigma(d, &sum);
                }
            }
        }
    }
}

impl Column {
    fn add(&mut self, left: &Image, disparity: &Disparity, x: usize, y: usize) {
        let w = left.width;
        let row = &left.pixels[y * w..][..w];
        let g = 0.5 * (f32::from(row[(x + 1).min(w - 1)]) - f32::from(row[x.saturating_sub(1)]));
        self.gradient2 += g * g;
        let d = disparity.px[y * w + x];
        if d >= 0.0 {
            self.disparity += d;
            self.known += 1.0;
        }
    }

    fn plus(self, other: &Column) -> Column {
        Column {
            gradient2: self.gradient2 + other.gradient2,
            disparity: self.disparity + other.disparity,
            known: self.known + other.known,
        }
    }
}

impl Fit {
    fn sigma(&self, d: f32, window: &Column) -> f32 {
        let by_noise = 2.0 * self.noise * self.noise / window.gradient2.max(1.0);
        let off = self.edge * (d - window.disparity / window.known.max(1.0));
        (self.floor_px * self.floor_px + by_noise + off * off).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Of a picture whose columns differ by `contrast`, with `step` px more disparity right of the middle.
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
        assert!(sharp < 0.2 && faint > 2.0 * sharp, "{sharp} {faint}");
        assert!(edge[31] > 5.0 * sharp && (edge[10] - sharp).abs() < 1e-3, "{edge:?}");
    }
}
