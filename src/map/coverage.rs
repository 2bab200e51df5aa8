//! What a keyframe sees, beside what the map shows from there, and how much of it the map lacks.

use super::exposure::Exposure;
use super::render::Rendered;
use super::view::View;
use stipple_drivers::Image;

/// A keyframe's picture, its depth, and the rendering of the map from the same place before the keyframe adds to it.
#[derive(Clone, Copy)]
pub struct KeyframeView<'a> {
    /// Grey, or red, green and blue.
    pub planes: &'a [Image],
    /// Zero where a pixel does not count.
    pub valid: &'a [u8],
    /// Matched depth as the raster counts it, m; zero where there is none.
    pub depth: &'a [f32],
    /// Standard deviation of `depth`, m; of no meaning where that is zero.
    pub depth_sigma_m: &'a [f32],
    pub rendered: &'a Rendered,
    /// The image's; renderings and seeds are in the map's.
    pub exposure: Exposure,
    pub view: View,
}

impl KeyframeView<'_> {
    pub fn width(&self) -> usize {
        self.planes[0].width
    }

    /// Mean over the channels of |rendered - seen| at a pixel, in the map's exposure.
    pub fn error(&self, i: usize) -> f64 {
        let error = |(channel, plane): (usize, &Image)| {
            let rendered = self.rendered.colour[channel * self.rendered.alpha.len() + i];
            (f64::from(rendered) - self.exposure.inverse(f64::from(plane.pixels[i]) / 255.0)).abs()
        };
        self.planes.iter().enumerate().map(error).sum::<f64>() / self.planes.len() as f64
    }
}

/// Fractions of a view's valid pixels that the map does not reconstruct.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Coverage {
    /// Rendered with an alpha below `alpha_min`.
    pub uncovered: f64,
    /// Covered, and rendered farther than `error_max` from what is seen, in the exposure of the map.
    pub mismatched: f64,
}

impl Coverage {
    pub fn new(seen: &KeyframeView, alpha_min: f64, error_max: f64) -> Coverage {
        let (mut uncovered, mut mismatched, mut n) = (0u32, 0u32, 0u32);
        for i in (0..seen.valid.len()).filter(|&i| seen.valid[i] != 0) {
            n += 1;
            if f64::from(seen.rendered.alpha[i]) < alpha_min {
                uncovered += 1;
            } else {
                mismatched += u32::from(seen.error(i) > error_max);
            }
        }
        let part = |k: u32| f64::from(k) / f64::from(n.max(1));
        Coverage { uncovered: part(uncovered), mismatched: part(mismatched) }
    }

    pub fn lacking(&self) -> f64 {
        self.uncovered + self.mismatched
    }
}

#[cfg(test)]
pub mod tests {
    use super::*;
    use crate::stereo::Pinhole;
    use stipple_drivers::Pose;

    pub const W: usize = 64;
    pub const H: usize = 48;

    pub fn view() -> View {
        let camera = Pinhole { width: W, height: H, fx: 50.0, fy: 50.0, cx: 31.5, cy: 23.5 };
        View::new(Pose::IDENTITY, camera, None)
    }

    /// Black, as opaque as `alpha`.
    pub fn black(alpha: &[f32]) -> Rendered {
        Rendered { alpha: alpha.to_vec(), ..Rendered::new(W, H, 1) }
    }

    pub fn seen<'a>(image: &'a Image, depth: &'a [f32], rendered: &'a Rendered) -> KeyframeView<'a> {
        let planes = std::slice::from_ref(image);
        let (valid, exposure) = (&[1; W * H], Exposure::default());
        KeyframeView { planes, valid, depth, depth_sigma_m: &[0.0; W * H], rendered, exposure, view: view() }
    }

    #[test]
    fn coverage_tells_what_is_uncovered_and_what_is_mismatched_of_the_valid() {
        let (mut image, mut alpha) = (Image::new(W, H), [0.9; W * H]);
        image.pixels[..W * H / 4].fill(100);
        alpha[W * H / 8..W * H / 2].fill(0.01);
        let rendered = black(&alpha);
        let v = seen(&image, &[1.0; W * H], &rendered);
        let none = Coverage { uncovered: 0.0, mismatched: 0.0 };
        assert_eq!(Coverage::new(&v, 0.05, 0.25), Coverage { uncovered: 3.0 / 8.0, mismatched: 1.0 / 8.0 });
        assert_eq!(Coverage::new(&v, 0.05, 0.5).mismatched, 0.0);
        // At half the gain what is seen as 100 would be 200.
        let dim = KeyframeView { exposure: Exposure { gain: 0.5, offset: 0.0 }, ..v };
        assert_eq!(Coverage::new(&dim, 0.05, 0.5).mismatched, 1.0 / 8.0);
        let mut half = [1; W * H];
        half[..W * H / 2].fill(0);
        assert_eq!(Coverage::new(&KeyframeView { valid: &half, ..dim }, 0.05, 0.25), none);
        assert_eq!(Coverage::new(&KeyframeView { valid: &[0; W * H], ..dim }, 0.05, 0.25), none);
    }
}
