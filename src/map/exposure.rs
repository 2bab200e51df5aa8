//! How an image was exposed, and what can be told of it from a rendering.

use super::render::Rendered;
use stipple_drivers::Image;

/// What an image shows of the map's level x is gain · x + offset.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure {
    pub gain: f64,
    pub offset: f64,
}

impl Default for Exposure {
    fn default() -> Exposure {
        Exposure { gain: 1.0, offset: 0.0 }
    }
}

/// Gain and level turn about this grey, the middle of what cameras expose for: about zero a change of gain would
/// look like one of the offset, and Adam, which takes each alone, would be slow.
pub const PIVOT: f64 = 0.5;
/// Cameras range over more stops, but two keyframes of one flight that overlap do not.
const GAIN_MAX: f64 = 8.0;

impl Exposure {
    pub fn observed(self, level: f64) -> f64 {
        self.gain * level + self.offset
    }

    /// The map's level behind an observed one.
    pub fn inverse(self, observed: f64) -> f64 {
        (observed - self.offset) / self.gain
    }

    /// ln gain, and how far mid-grey moves.
    pub fn levels(self) -> [f64; 2] {
        [self.gain.ln(), self.offset + PIVOT * (self.gain - 1.0)]
    }

    pub fn from_levels([log_gain, level]: [f64; 2]) -> Exposure {
        let gain = log_gain.exp().clamp(1.0 / GAIN_MAX, GAIN_MAX);
        Exposure { gain, offset: level - PIVOT * (gain - 1.0) }
    }

    /// Gain and offset for a kernel.
    pub fn words(self) -> [f32; 2] {
        [self.gain as f32, self.offset as f32]
    }
}

/// A pixel this opaque shows the map, and a view with this share of them tells its exposure.
const SHOWN_ALPHA: f32 = 0.9;
const SHOWN_MIN: f64 = 0.2;

/// The gain of an image of known offset, from the mean level of what a rendering already shows of it; `None` of too little.
/// A fit of both would take the blur of an unfinished map for a low contrast.
pub fn gain_from(planes: &[Image], offset: f64, rendered: &Rendered, valid: &[u8]) -> Option<f64> {
    let (mut seen, mut n, mut observed, mut level) = (0u32, 0u32, 0.0, 0.0);
    let channels = planes.len() as f64;
    for i in (0..valid.len()).filter(|&i| valid[i] != 0) {
        n += 1;
        if rendered.alpha[i] > SHOWN_ALPHA {
            seen += 1;
            observed += planes.iter().map(|p| f64::from(p.pixels[i])).sum::<f64>() / (255.0 * channels);
            let sum: f32 = rendered.colour[i..].iter().step_by(rendered.alpha.len()).sum();
            level += f64::from(sum / rendered.alpha[i]) / channels;
        }
    }
    let tells = f64::from(seen) >= SHOWN_MIN * f64::from(n.max(1)) && level > 0.0;
    tells.then(|| ((observed - offset * f64::from(seen)) / level).clamp(1.0 / GAIN_MAX, GAIN_MAX))
}

/// Grey levels between which a camera's pixel is neither black nor saturated: beyond them a rendering may rightly be
/// darker or brighter than the image, so they say nothing of the exposure.
const UNSATURATED: std::ops::Range<f32> = 0.02..0.98;

/// The exposure that takes a rendering closest to an image, in closed form: linear least squares of gain and offset
/// over the valid pixels of all planes that the camera did not saturate. A flat or empty rendering gets the offset alone.
pub fn fitted_exposure(observed: &[f32], rendered: &[f32], valid: &[u8]) -> Exposure {
    let (mut n, mut sx, mut sy, mut sxx, mut sxy) = (0.0, 0.0, 0.0, 0.0, 0.0);
    let tells = |i: &usize| valid[i % valid.len()] != 0 && UNSATURATED.contains(&observed[*i]);
    for i in (0..observed.len()).filter(tells) {
        let (x, y) = (f64::from(rendered[i]), f64::from(observed[i]));
        (n, sx, sy, sxx, sxy) = (n + 1.0, sx + x, sy + y, sxx + x * x, sxy + x * y);
    }
    if n == 0.0 {
        return Exposure::default();
    }
    let variance = sxx - sx * sx / n;
    let gain = if variance > 1e-9 * n { (sxy - sx * sy / n) / variance } else { 1.0 };
    Exposure { gain, offset: (sy - gain * sx) / n }
}

/// The one of these exposures that is nearest to all of them: the least sum of distances by ln gain and by the level of
/// mid-grey (the medoid). `None` of none.
pub fn median_exposure(exposures: &[Exposure]) -> Option<Exposure> {
    let all: Vec<[f64; 2]> = exposures.iter().map(|e| e.levels()).collect();
    let distance = |a: &[f64; 2]| all.iter().map(|b| (a[0] - b[0]).hypot(a[1] - b[1])).sum::<f64>();
    let nearest = (0..all.len()).min_by(|i, j| distance(&all[*i]).total_cmp(&distance(&all[*j])))?;
    Some(exposures[nearest])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn median_exposure_is_one_of_them_and_no_outlier() {
        let of = |gain: f64| Exposure { gain, offset: 0.0 };
        assert_eq!(median_exposure(&[of(1.0), of(8.0), of(1.1), of(0.2), of(1.2)]), Some(of(1.1)));
        assert_eq!(median_exposure(&[]), None);
    }

    #[test]
    fn saturated_pixels_do_not_tell_the_exposure() {
        // The map is rightly brighter than white where a camera saturated.
        let rendered: Vec<f32> = (0..100).map(|i| 0.02 * i as f32).collect();
        let observed: Vec<f32> = rendered.iter().map(|x| (0.8 * x + 0.1).clamp(0.0, 1.0)).collect();
        let e = fitted_exposure(&observed, &rendered, &[1; 100]);
        assert!((e.gain - 0.8).abs() < 1e-5 && (e.offset - 0.1).abs() < 1e-5, "{e:?}");
    }

    #[test]
    fn fitted_exposure_is_the_least_squares_one() {
        let rendered: Vec<f32> = (0..100).map(|i| (i % 17) as f32 / 17.0).collect();
        let observed: Vec<f32> = rendered.iter().map(|x| 0.8 * x + 0.1).collect();
        let mut valid = [1u8; 100];
        valid[3] = 0;
        let mut spoiled = observed.clone();
        spoiled[3] = 9.0;
        let e = fitted_exposure(&spoiled, &rendered, &valid);
        assert!((e.gain - 0.8).abs() < 1e-5 && (e.offset - 0.1).abs() < 1e-5, "{e:?}");
        let flat = fitted_exposure(&observed, &[0.5; 100], &valid);
        assert!(flat.gain == 1.0 && flat.offset.is_finite());
        assert_eq!(fitted_exposure(&observed, &rendered, &[0; 100]), Exposure::default());
    }
}
