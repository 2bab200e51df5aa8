//! Image pyramid: each level is the one below it, smoothed by the 5x5 binomial [1 4 6 4 1]ᵀ[1 4 6 4 1]/256
//! with a reflect-101 border, every other pixel. Pixel x of level l sits at x·2^l of the image.
//!
//! Levels are 8-bit: smoothing lowers the noise far more than rounding (0.29 grey) adds, and
//! sixteen bits would double what the tracker pulls through the cache.
//!
//! The finest level is the image itself, where its camera wrote it: a pyramid owns those above it.

use crate::limits::PYRAMID_LEVELS;
use crate::math::wide::wide;
use std::sync::Arc;
use stipple_drivers::{Calibration, Frames, Image, RigCamera};

/// The levels above one image.
pub struct Pyramid {
    /// Width and height of the image.
    size: (usize, usize),
    /// Levels 1 and up.
    above: [Image; PYRAMID_LEVELS - 1],
    /// Sums down a column, with two reflected entries on either side and one to make the last pair.
    columns: Vec<u16>,
}

/// All levels of an image, the image first.
pub type Levels<'a> = [&'a Image; PYRAMID_LEVELS];

/// Width or height of each level.
pub fn sizes(full: usize) -> [usize; PYRAMID_LEVELS] {
    let mut s = [full; PYRAMID_LEVELS];
    for l in 1..PYRAMID_LEVELS {
        s[l] = s[l - 1].div_ceil(2);
    }
    s
}

impl Pyramid {
    pub fn new(width: usize, height: usize) -> Pyramid {
        let (w, h) = (sizes(width), sizes(height));
        let above = std::array::from_fn(|l| Image::new(w[l + 1], h[l + 1]));
        Pyramid { size: (width, height), above, columns: vec![0; width + 5] }
    }

    /// Whether an image has the size given at construction, and all its pixels.
    pub fn fits(&self, image: &Image) -> bool {
        let (width, height) = self.size;
        (image.width, image.height, image.pixels.len()) == (width, height, width * height)
    }

    /// Fills the levels above an image that fits.
    pub fn build(&mut self, image: &Image) {
        let mut below = image;
        for level in &mut self.above {
            halve(below, level, &mut self.columns);
            below = level;
        }
    }

    /// All levels, with the image it was built from.
    pub fn over<'a>(&'a self, image: &'a Image) -> Levels<'a> {
        std::array::from_fn(|l| if l == 0 { image } else { &self.above[l - 1] })
    }
}

/// A frame and the pyramids of its images, which are shared, not copied.
pub struct FramePyramids {
    pub frames: Arc<Frames>,
    pub pyramids: Vec<Pyramid>,
}

impl FramePyramids {
    /// Room for the frames of a rig.
    pub fn new(calibration: &Calibration) -> FramePyramids {
        let pyramid = |c: &RigCamera| Pyramid::new(c.camera.width, c.camera.height);
        FramePyramids { frames: Arc::default(), pyramids: calibration.cameras.iter().map(pyramid).collect() }
    }

    /// Levels of a camera whose image was taken.
    pub fn levels(&self, camera: usize) -> Levels<'_> {
        self.pyramids[camera].over(&self.frames.images[camera])
    }
}

/// Index mirrored about the first and last pixel, which are not repeated.
fn reflect(i: isize, n: usize) -> usize {
    let last = n as isize - 1;
    let i = i.abs();
    (if i > last { 2 * last - i } else { i }) as usize
}

wide! {
    fn halve<'a>(src: &'a Image, dst: &'a mut Image, columns: &'a mut [u16]) -> () {
        let (w, h) = (src.width, src.height);
        let columns = &mut columns[..w + 5];
        for (y, out) in dst.pixels.chunks_exact_mut(dst.width).enumerate() {
            let row = |dy: isize| {
                let r = reflect(2 * y as isize + dy, h) * w;
                &src.pixels[r..r + w]
            };
            let (a, b, c, d, e) = (row(-2), row(-1), row(0), row(1), row(2));
            for (x, sum) in columns[2..w + 2].iter_mut().enumerate() {
                // at most 16·255
                *sum = a[x] as u16 + e[x] as u16 + 4 * (b[x] as u16 + d[x] as u16) + 6 * c[x] as u16;
            }
            for x in [-2, -1, w as isize, w as isize + 1] {
                columns[(x + 2) as usize] = columns[2 + reflect(x, w)];
            }
            let even = columns.chunks_exact(2);
            for ((o, p), (q, r)) in out.iter_mut().zip(even.clone()).zip(even.clone().skip(1).zip(even.skip(2))) {
                // at most 256·255 + 128, which fits
                *o = ((p[0] + 4 * (p[1] + q[1]) + 6 * q[0] + r[0] + 128) >> 8) as u8;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;

    fn naive(src: &Image) -> Image {
        let k = [1u32, 4, 6, 4, 1];
        let mut dst = Image::new(src.width.div_ceil(2), src.height.div_ceil(2));
        for y in 0..dst.height {
            for x in 0..dst.width {
                let mut sum = 128;
                for (j, kj) in k.iter().enumerate() {
                    for (i, ki) in k.iter().enumerate() {
                        let sx = reflect(2 * x as isize + i as isize - 2, src.width);
                        let sy = reflect(2 * y as isize + j as isize - 2, src.height);
                        sum += ki * kj * src.at(sx, sy) as u32;
                    }
                }
                dst.pixels[y * dst.width + x] = (sum >> 8) as u8;
            }
        }
        dst
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]
        #[test]
        fn every_level_is_the_naive_binomial(w in 33usize..90, h in 33usize..70, seed in any::<u64>()) {
            let mut s = seed | 1;
            let mut image = Image::new(w, h);
            for p in &mut image.pixels {
                s = s.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                *p = (s >> 56) as u8;
            }
            let mut pyramid = Pyramid::new(w, h);
            pyramid.build(&image);
            let levels = pyramid.over(&image);
            prop_assert!(std::ptr::eq(levels[0], &image), "shared, not copied");
            for l in 1..PYRAMID_LEVELS {
                prop_assert_eq!(levels[l], &naive(levels[l - 1]));
            }
        }
    }
}
