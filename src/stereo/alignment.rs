//! Whether a rectified pair is aligned: how far below its row in the left image a point lies in the right one.
//!
//! Corners of the left image are sought in the right one over the range of disparities and `SEARCH` rows up and
//! down, by normalised correlation, to a fraction of a row by a parabola. Matching rows assumes that they agree to
//! a quarter of a pixel or so; a lens that was touched, or a calibration of another camera, shows here.

use stipple_drivers::Image;

/// Half side of a patch, and rows looked at up and down, px.
const HALF: usize = 5;
const SEARCH: i32 = 4;
/// A corner a cell, px.
const CELL: usize = 32;
/// Least correlation of a match, and least sum of squared differences down a patch of a corner.
const ALIKE: f64 = 0.9;
const DETAIL: f64 = 4000.0;

/// How far the rows of one or more pairs are apart.
#[derive(Clone, Debug, Default)]
pub struct Alignment {
    /// Rows by which each matched corner is lower in the right image, px.
    pub rows: Vec<f64>,
}

impl Alignment {
    /// Adds the corners of a pair.
    pub fn add(&mut self, left: &Image, right: &Image, disparities: usize) {
        let (w, h) = (left.width, left.height);
        let margin = HALF + SEARCH as usize + 1;
        for y0 in (margin..h.saturating_sub(margin + CELL)).step_by(CELL) {
            for x0 in (margin..w.saturating_sub(margin + CELL)).step_by(CELL) {
                let within = (0..CELL * CELL).step_by(3).map(|i| (x0 + i % CELL, y0 + i / CELL));
                let best = within.map(|(x, y)| (detail(left, x, y), x, y)).max_by(|a, b| a.0.total_cmp(&b.0));
                if let Some((_, x, y)) = best.filter(|b| b.0 > DETAIL) {
                    self.rows.extend(lower(left, right, x, y, disparities));
                }
            }
        }
    }

    /// The median, and the median distance from it, px; `None` of too few corners to say.
    pub fn summary(&self) -> Option<(f64, f64)> {
        const FEW: usize = 20;
        let median = |mut v: Vec<f64>| {
            v.sort_by(f64::total_cmp);
            v[v.len() / 2]
        };
        (self.rows.len() >= FEW).then(|| {
            let middle = median(self.rows.clone());
            (middle, median(self.rows.iter().map(|r| (r - middle).abs()).collect()))
        })
    }
}

/// The lesser eigenvalue of the gradients' sums: large where a patch is found again both along and across.
fn detail(image: &Image, x: usize, y: usize) -> f64 {
    let at = |x: usize, y: usize| f64::from(image.at(x, y));
    let (mut xx, mut yy, mut xy) = (0.0, 0.0, 0.0);
    for v in y - HALF..=y + HALF {
        for u in x - HALF..=x + HALF {
            let (gx, gy) = (0.5 * (at(u + 1, v) - at(u - 1, v)), 0.5 * (at(u, v + 1) - at(u, v - 1)));
            (xx, yy, xy) = (xx + gx * gx, yy + gy * gy, xy + gx * gy);
        }
    }
    0.5 * (xx + yy - ((xx - yy).powi(2) + 4.0 * xy * xy).sqrt())
}

/// Normalised correlation of the patches about two places.
fn alike(left: &Image, (x, y): (usize, usize), right: &Image, (u, v): (usize, usize)) -> f64 {
    let (mut l, mut r, mut ll, mut rr, mut lr) = (0u64, 0u64, 0u64, 0u64, 0u64);
    let side = 2 * HALF + 1;
    for k in 0..side {
        let a = &left.pixels[(y + k - HALF) * left.width + x - HALF..][..side];
        let b = &right.pixels[(v + k - HALF) * right.width + u - HALF..][..side];
        for (a, b) in a.iter().zip(b) {
            let (a, b) = (u64::from(*a), u64::from(*b));
            (l, r, ll, rr, lr) = (l + a, r + b, ll + a * a, rr + b * b, lr + a * b);
        }
    }
    let n = (side * side) as f64;
    let (l, r, ll, rr, lr) = (l as f64, r as f64, ll as f64, rr as f64, lr as f64);
    (n * lr - l * r) / ((n * ll - l * l) * (n * rr - r * r)).max(1.0).sqrt()
}

/// How many rows lower a corner is in the right image.
fn lower(left: &Image, right: &Image, x: usize, y: usize, disparities: usize) -> Option<f64> {
    let mut best = (ALIKE, 0, 0);
    for d in 0..disparities.min(x - HALF) {
        for dy in -SEARCH..=SEARCH {
            let score = alike(left, (x, y), right, (x - d, (y as i32 + dy) as usize));
            if score > best.0 {
                best = (score, d, dy);
            }
        }
    }
    let (score, d, dy) = best;
    if score <= ALIKE || dy.abs() == SEARCH {
        return None;
    }
    let at = |dy: i32| alike(left, (x, y), right, (x - d, (y as i32 + dy) as usize));
    let (up, down) = (at(dy - 1), at(dy + 1));
    let bend = up + down - 2.0 * score;
    (bend < 0.0).then(|| f64::from(dy) + 0.5 * (up - down) / bend)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Smooth bumps, `lower` px down and `d` px to the left.
    fn picture(lower: f64, d: f64) -> Image {
        let mut image = Image::new(256, 192);
        for (i, p) in image.pixels.iter_mut().enumerate() {
            let (x, y) = ((i % 256) as f64 + d, (i / 256) as f64 - lower);
            let wave = |a: f64, b: f64, c: f64| (a * x + b * y + c).sin();
            let grain = wave(0.31, 0.17, 0.0) + wave(-0.23, 0.37, 1.0) + wave(0.11, -0.29, 2.0) + wave(0.53, 0.41, 3.0);
            *p = (128.0 + 28.0 * grain) as u8;
        }
        image
    }

    #[test]
    fn misalignment_is_measured_to_a_tenth_of_a_row() {
        for rows in [-1.4, -1.0, 0.0, 0.3, 1.0, 2.5] {
            let mut found = Alignment::default();
            found.add(&picture(0.0, 0.0), &picture(rows, 9.3), 48);
            let (median, spread) = found.summary().expect("corners enough");
            assert!((median - rows).abs() < 0.1 && spread < 0.1, "{rows}: {median} +- {spread}");
        }
    }

    #[test]
    fn a_blank_pair_says_nothing() {
        let mut found = Alignment::default();
        found.add(&Image::new(256, 192), &Image::new(256, 192), 48);
        assert!(found.rows.is_empty() && found.summary().is_none());
    }
}
