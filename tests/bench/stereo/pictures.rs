//! A pair and what a method made of it, side by side: left eye | truth | disparity | error | deviation.
//!
//! Disparities share one scale a set, from its least to its greatest truth. Errors and deviations are drawn on
//! fixed ones, so that pictures compare. What is unknown is dark grey.

use super::sets::Pair;
use stipple::output::panel::{ramp, Picture, DEPTH_RAMP, ERROR_RAMP, MISSING};
use stipple::stereo::Disparity;

/// Drawn at full brightness, px.
const ERROR_FULL: f32 = 4.0;
const SIGMA_FULL: f32 = 2.0;
const GAP_PX: usize = 4;
/// Widest picture of one eye in the report.
const WIDTH_MAX: usize = 384;

pub fn picture(pair: &Pair, found: &Disparity) -> Picture {
    let (w, h) = (found.width, found.height);
    let known = || pair.truth.iter().copied().filter(|d| *d >= 0.0);
    let (near, far) = (known().fold(1.0, f32::max), known().fold(f32::INFINITY, f32::min).min(1e6));
    let colour = |d: f32| match d >= 0.0 {
        true => ramp(&DEPTH_RAMP, (near - d) / (near - far).max(1.0)),
        false => MISSING,
    };
    let both = |i: usize| found.px[i] >= 0.0 && pair.truth[i] >= 0.0;
    let deviation = |i: usize| match found.px[i] >= 0.0 {
        true => ramp(&ERROR_RAMP, found.sigma_px[i] / SIGMA_FULL),
        false => MISSING,
    };
    let error = |i: usize| match both(i) {
        true => ramp(&ERROR_RAMP, (found.px[i] - pair.truth[i]).abs() / ERROR_FULL),
        false => MISSING,
    };
    let eye = |i: usize| [pair.left.pixels[i]; 3];
    let columns: [&dyn Fn(usize) -> [u8; 3]; 5] =
        [&eye, &|i| colour(pair.truth[i]), &|i| colour(found.px[i]), &error, &deviation];
    let mut all = Picture::filled(columns.len() * (w + GAP_PX) - GAP_PX, h, [255; 3]);
    for (k, column) in columns.iter().enumerate() {
        for i in 0..w * h {
            all.pixels[i / w * all.width + k * (w + GAP_PX) + i % w] = column(i);
        }
    }
    all.shrunk(5 * (WIDTH_MAX + GAP_PX))
}
