//! One keyframe at a glance: observed | rendered | absolute error | depth, side by side.
//!
//! Error is drawn on a fixed scale so that panels of one run compare; depth on the logarithm
//! between its own 2nd and 98th percentile, which the caption states. Pixels without a value are dark grey.

use super::metrics::percentile;
use crate::map::Panel;
use std::io::{self, Write};

/// Error drawn at full brightness, of a grey range 0..1.
const ERROR_FULL: f32 = 0.25;
const GAP_PX: usize = 4;
/// Colour of pixels without a value.
pub const MISSING: [u8; 3] = [48, 48, 48];

/// Near to far: warm to cool, lightness rising to the middle.
pub const DEPTH_RAMP: [[u8; 3]; 8] = [
    [122, 4, 3],
    [217, 56, 7],
    [253, 143, 40],
    [223, 223, 55],
    [125, 254, 95],
    [27, 208, 213],
    [70, 107, 227],
    [66, 52, 148],
];
/// None to full: black through violet and orange to pale yellow, lightness rising throughout.
pub const ERROR_RAMP: [[u8; 3]; 6] =
    [[0, 0, 4], [66, 10, 104], [147, 38, 103], [221, 81, 58], [252, 165, 10], [252, 255, 164]];

/// An 8-bit RGB picture, row-major.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    pub width: usize,
    pub height: usize,
    pub pixels: Vec<[u8; 3]>,
}

impl Picture {
    pub fn filled(width: usize, height: usize, colour: [u8; 3]) -> Picture {
        Picture { width, height, pixels: vec![colour; width * height] }
    }

    pub fn write_png(&self, out: &mut impl Write) -> io::Result<()> {
        let mut encoder = png::Encoder::new(out, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_compression(png::Compression::Balanced);
        let mut writer = encoder.write_header().map_err(io::Error::from)?;
        writer.write_image_data(self.pixels.as_flattened()).map_err(io::Error::from)
    }

    /// At most `width_max` wide, by averaging whole blocks of pixels.
    pub fn shrunk(&self, width_max: usize) -> Picture {
        let by = self.width.div_ceil(width_max.max(1)).max(1);
        let (width, height) = ((self.width / by).max(1), (self.height / by).max(1));
        let block = |i: usize| {
            let (x0, y0) = (i % width * by, i / width * by);
            let mut sum = [0usize; 3];
            for y in y0..(y0 + by).min(self.height) {
                for p in &self.pixels[y * self.width + x0..][..by.min(self.width - x0)] {
                    (0..3).for_each(|c| sum[c] += p[c] as usize);
                }
            }
            let n = by.min(self.width - x0) * by.min(self.height - y0);
            sum.map(|s| ((s + n / 2) / n) as u8)
        };
        Picture { width, height, pixels: (0..width * height).map(block).collect() }
    }

    fn paste(&mut self, x0: usize, width: usize, colour: impl Iterator<Item = [u8; 3]>) {
        for (i, c) in colour.enumerate() {
            self.pixels[i / width * self.width + x0 + i % width] = c;
        }
    }
}

/// What the four panels of a keyframe are, in words.
pub fn caption(view: &Panel) -> String {
    let (near, far) = depth_range(&view.depth);
    let decibels = view.psnr_db.map_or(String::new(), |d| format!(", {d:.1} dB"));
    let name = &view.name;
    format!("{name}: observed | rendered{decibels} | error, 0 to {ERROR_FULL} | depth, {near:.1} to {far:.1} m")
}

/// Draws the four panels.
pub fn panel(view: &Panel) -> Picture {
    let (w, h) = (view.width, view.height);
    let (near, far) = depth_range(&view.depth);
    let mut picture = Picture::filled(4 * w + 3 * GAP_PX, h, [16, 16, 16]);
    let column = |index: usize| index * (w + GAP_PX);
    let compared = |i: usize| view.valid.get(i).is_none_or(|&v| v != 0);
    picture.paste(column(0), w, (0..w * h).map(|i| observed(view, i).map(byte)));
    picture.paste(column(1), w, (0..w * h).map(|i| rendered(view, i).map(byte)));
    let error = |i: usize| {
        let (a, b) = (observed(view, i), rendered(view, i));
        // As PSNR counts it: a window brighter than the image can be is no error.
        let mean = (0..3).map(|c| (a[c] - b[c].clamp(0.0, 1.0)).abs()).sum::<f32>() / 3.0;
        if compared(i) {
            ramp(&ERROR_RAMP, mean / ERROR_FULL)
        } else {
            MISSING
        }
    };
    picture.paste(column(2), w, (0..w * h).map(error));
    let depth = |i: usize| match view.depth[i] {
        d if d.is_finite() && d > 0.0 => ramp(&DEPTH_RAMP, (d / near).ln() / (far / near).ln().max(1e-6)),
        _ => MISSING,
    };
    picture.paste(column(3), w, (0..w * h).map(depth));
    picture
}

fn observed(view: &Panel, i: usize) -> [f32; 3] {
    channels(&view.observed, view.width * view.height, i, |v| v as f32 / 255.0)
}

fn rendered(view: &Panel, i: usize) -> [f32; 3] {
    channels(&view.rendered, view.width * view.height, i, |v| v)
}

fn channels<T: Copy>(values: &[T], pixels: usize, i: usize, unit: impl Fn(T) -> f32) -> [f32; 3] {
    match values.len() / pixels.max(1) {
        3 => [0, 1, 2].map(|c| unit(values[3 * i + c])),
        _ => [unit(values[i]); 3],
    }
}

/// NaN becomes 0 by the cast.
fn byte(v: f32) -> u8 {
    (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8
}

fn depth_range(depth: &[f32]) -> (f32, f32) {
    // One pixel in seven is plenty for a percentile, and seven divides no usual image width.
    let seen: Vec<f64> = depth.iter().step_by(7).filter(|d| d.is_finite() && **d > 0.0).map(|&d| d as f64).collect();
    let near = percentile(&seen, 0.02).unwrap_or(1.0) as f32;
    let far = percentile(&seen, 0.98).unwrap_or(10.0) as f32;
    (near, far.max(1.01 * near))
}

/// Colour at `s` of 0..1 along evenly spaced anchors.
pub fn ramp<const N: usize>(anchors: &[[u8; 3]; N], s: f32) -> [u8; 3] {
    let at = if s.is_finite() { s.clamp(0.0, 1.0) * (N - 1) as f32 } else { (N - 1) as f32 };
    let i = (at as usize).min(N - 2);
    let f = at - i as f32;
    [0, 1, 2].map(|c| (anchors[i][c] as f32 * (1.0 - f) + anchors[i + 1][c] as f32 * f + 0.5) as u8)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn pixel(p: &Picture, x: usize, y: usize) -> [u8; 3] {
        p.pixels[y * p.width + x]
    }

    #[test]
    fn panels_show_their_buffers_side_by_side() {
        let (width, height) = (64, 16);
        let n = width * height;
        let observed = vec![51u8; n];
        let mut rendered = vec![0.2f32; n];
        rendered[0] = 0.2 + ERROR_FULL;
        let mut depth: Vec<f32> = (0..n).map(|i| 1.0 + (i % width) as f32).collect();
        depth[1] = f32::NAN;
        let mut valid = vec![1u8; n];
        valid[2] = 0;
        let psnr_db = Some(31.25);
        let view = Panel { width, height, observed, rendered, depth, valid, psnr_db, ..Panel::default() };
        let p = panel(&view);
        assert_eq!((p.width, p.height), (4 * 64 + 3 * GAP_PX, height));
        assert_eq!(pixel(&p, 0, 0), [51, 51, 51]);
        assert_eq!(pixel(&p, 64 + GAP_PX + 1, 0), [51, 51, 51]);
        let (error, depth) = (2 * (64 + GAP_PX), 3 * (64 + GAP_PX));
        assert_eq!(pixel(&p, error, 0), ERROR_RAMP[5]);
        assert_eq!(pixel(&p, error + 1, 0), ERROR_RAMP[0]);
        assert_eq!(pixel(&p, error + 2, 0), MISSING);
        assert_eq!(pixel(&p, depth, 0), DEPTH_RAMP[0]);
        assert_eq!(pixel(&p, depth + 1, 0), MISSING);
        assert_eq!(pixel(&p, depth + 63, 0), DEPTH_RAMP[7]);
        assert_eq!(caption(&view), ": observed | rendered, 31.2 dB | error, 0 to 0.25 | depth, 1.0 to 64.0 m");
    }

    #[test]
    fn colour_and_grey_buffers_are_both_taken() {
        let view = Panel {
            width: 2,
            height: 1,
            observed: vec![10, 20, 30, 40, 50, 60],
            rendered: vec![0.5, 1.0],
            depth: vec![f32::NAN; 2],
            ..Panel::default()
        };
        let p = panel(&view);
        assert_eq!(pixel(&p, 1, p.height - 1), [40, 50, 60]);
        assert_eq!(pixel(&p, 2 + GAP_PX, p.height - 1), [128, 128, 128]);
    }

    #[test]
    fn shrinking_averages_whole_blocks() {
        let mut p = Picture::filled(4, 2, [0, 0, 0]);
        p.pixels[0] = [200, 100, 4];
        assert_eq!(p.shrunk(2).pixels, [[50, 25, 1], [0, 0, 0]]);
        assert_eq!(p.shrunk(9), p);
    }

    #[test]
    fn png_is_read_back() {
        let p = Picture { width: 2, height: 1, pixels: vec![[1, 2, 3], [250, 0, 9]] };
        let mut bytes = Vec::new();
        p.write_png(&mut bytes).unwrap();
        let mut reader = png::Decoder::new(io::Cursor::new(bytes)).read_info().unwrap();
        let mut read = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut read).unwrap();
        assert_eq!(read, p.pixels.as_flattened());
    }
}
