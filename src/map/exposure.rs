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

/// Share of a view's pixels that must show the map to tell its exposure.
const SHOWN_MIN: f64 = 0.2;
/// Least alpha of a pixel that shows the map.
const OPAQUE: f32 = 0.9;
/// Least alpha of a pixel that shows a young map, of few steps. Its gain is less exact, and used only if it differs from the guess by
/// more than `STEP`: used always it costs 0.2 dB in training at 60 steps a keyframe.
const HALF_OPAQUE: f32 = 0.5;
const STEP: f64 = 1.5;
/// Halvings of the range of gains: to a thousandth.
const HALVINGS: u32 = 12;
/// One pixel in so many is looked at.
const STRIDE: usize = 5;

/// Gain of a new image. `guess` has its offset, and the gain of the image before it. `None` where too few pixels show the map, or
/// where a young map shows no change of light by `STEP` or more.
pub fn gain_from(planes: &[Image], guess: Exposure, rendered: &Rendered, valid: &[u8]) -> Option<f64> {
    let with = |alpha_min| gain_where(planes, guess.offset, rendered, valid, alpha_min);
    let is_step = |gain: &f64| (gain / guess.gain).ln().abs() > STEP.ln();
    with(OPAQUE).or_else(|| with(HALF_OPAQUE).filter(is_step))
}

/// Gain with which the pixels that are opaque in the rendering have their observed mean, with levels clipped to 0..1 as by a camera;
/// `None` of too few. A fit of both gain and offset would take the blur of an unfinished map for a low contrast.
fn gain_where(planes: &[Image], offset: f64, rendered: &Rendered, valid: &[u8], alpha_min: f32) -> Option<f64> {
    let looked_at = || (0..valid.len()).step_by(STRIDE).filter(|i| valid[*i] != 0);
    let shown = || looked_at().filter(|i| rendered.alpha[*i] > alpha_min);
    let level =
        |plane: usize, i: usize| f64::from(rendered.colour[plane * rendered.alpha.len() + i] / rendered.alpha[i]);
    let sum = |of: &dyn Fn(usize, usize) -> f64| -> f64 {
        shown().map(|i| (0..planes.len()).map(|plane| of(plane, i)).sum::<f64>()).sum()
    };
    let exposed = |gain: f64| sum(&|plane, i| (gain * level(plane, i) + offset).clamp(0.0, 1.0));
    let observed = sum(&|plane, i| f64::from(planes[plane].pixels[i]) / 255.0);
    let (mut low, mut high) = (1.0 / GAIN_MAX, GAIN_MAX);
    let tells = shown().count() as f64 >= SHOWN_MIN * looked_at().count() as f64 && exposed(high) > exposed(low);
    if !tells {
        return None;
    }
    for _ in 0..HALVINGS {
        let middle = (low * high).sqrt();
        *(if exposed(middle) < observed { &mut low } else { &mut high }) = middle;
    }
    Some((low * high).sqrt())
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
    fn gain_of_a_new_image_is_found_through_saturation_and_of_a_young_map_where_light_steps() {
        let levels: Vec<f32> = (0..100).map(|i| 0.01 * i as f32).collect();
        let of = |gain: f64, alpha: f32, guess: f64| {
            let mut image = Image::new(100, 1);
            image
                .pixels
                .iter_mut()
                .zip(&levels)
                .for_each(|(p, l)| *p = (255.0 * gain * f64::from(*l)).min(255.0) as u8);
            let colour = levels.iter().map(|l| l * alpha).collect();
            let rendered = Rendered { alpha: vec![alpha; 100], colour, ..Rendered::new(100, 1, 1) };
            gain_from(&[image], Exposure { gain: guess, offset: 0.0 }, &rendered, &[1; 100])
        };
        for gain in [0.2, 0.9, 1.1, 4.0] {
            assert!(of(gain, 1.0, 1.0).is_some_and(|found| (found / gain - 1.0).abs() < 0.02), "{gain}");
            let young = of(gain, 0.6, 1.0);
            assert_eq!(young.is_some(), !(0.67..1.5).contains(&gain), "{gain}: {young:?}");
            assert!(young.is_none_or(|found| (found / gain - 1.0).abs() < 0.02), "{young:?}");
            assert_eq!(of(gain, 0.3, 1.0), None);
        }
        let mut rendered = Rendered { alpha: vec![1.0; 100], colour: levels, ..Rendered::new(100, 1, 1) };
        rendered.colour[5] = f32::NAN;
        assert_eq!(gain_from(&[Image::new(100, 1)], Exposure::default(), &rendered, &[1; 100]), None);
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
