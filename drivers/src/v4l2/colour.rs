//! A picture as a camera's driver gives it, to red, green and blue beside the grey, which is the same as without them. Chroma
//! that several pixels share is each one's. Matrix and range are those that the driver states.

use super::bayer;
use super::pixels::{check_bytes, jpeg_decoder, least_bytes, to_grey, undecodable, Format, Part, Unreadable};
use crate::types::{Colour, Image};
use crate::ycbcr::Matrix;
use zune_jpeg::zune_core::colorspace::ColorSpace;

/// The code of NV12 whose chroma follows the luma in one buffer; that of NM12 is in a buffer of its own, which is not mapped.
const NV12: u32 = u32::from_le_bytes(*b"NV12");

impl Format {
    /// Whether its pictures have colours.
    pub fn has_colour(self) -> bool {
        matches!(self, Format::Nv12 | Format::Yuyv | Format::Mjpeg) || self.bayer().is_some()
    }

    /// Whether a driver's code means this format, in colour.
    pub(super) fn is_in_colour(self, fourcc: u32) -> bool {
        self.has_colour() && self.is(fourcc) && (self != Format::Nv12 || fourcc == NV12)
    }
}

/// Colour spaces that have defaults of their own.
const SMPTE_240M: u32 = 2;
const REC_709: u32 = 3;
const JPEG: u32 = 7;
const BT_2020: u32 = 10;
const DCI_P3: u32 = 12;

/// What a driver states of the colours of a format, by the numbers of `linux/videodev2.h`; 0 is the default of each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Stated {
    /// `V4L2_COLORSPACE_..`.
    pub colorspace: u32,
    /// `V4L2_YCBCR_ENC_..`.
    pub encoding: u32,
    /// `V4L2_QUANTIZATION_..`.
    pub quantization: u32,
}

impl Stated {
    /// The matrix of YCbCr. What is left out is what the kernel's `V4L2_MAP_YCBCR_ENC_DEFAULT` and
    /// `V4L2_MAP_QUANTIZATION_DEFAULT` make of it; an encoding of constant luminance, which is no matrix, is taken as the
    /// other one of BT.2020.
    pub(super) fn matrix(self) -> Matrix {
        let encoding = match (self.encoding, self.colorspace) {
            (0, REC_709 | DCI_P3) => 2,
            (0, BT_2020) => 6,
            (0, SMPTE_240M) => 8,
            (stated, _) => stated,
        };
        let (red, blue) = match encoding {
            2 | 4 => (0.2126, 0.0722),
            6 | 7 => (0.2627, 0.0593),
            8 => (0.212, 0.087),
            _ => (0.299, 0.114),
        };
        let full = match self.quantization {
            0 => self.colorspace == JPEG,
            stated => stated == 1,
        };
        Matrix::new(red, blue, full)
    }
}

/// Least bytes of a picture that is read in colour, without the padding after its last row.
pub(super) fn least_bytes_in_colour(format: Format, part: Part) -> usize {
    let pairs = 2 * part.width.div_ceil(2);
    let before = part.height.saturating_sub(1) * part.stride;
    match format {
        Format::Nv12 => (part.height + part.height.div_ceil(2)).saturating_sub(1) * part.stride + pairs,
        Format::Yuyv => before + 2 * pairs,
        _ => least_bytes(format, part),
    }
}

/// Bytes of `scratch` that pictures of this size take at most: a row of colours; in colour, a JPEG of three components and a
/// row of chroma.
pub(super) fn scratch_bytes(in_colour: bool, width: usize, height: usize) -> usize {
    3 * width + if in_colour { 3 * width * height } else { 0 }
}

/// Writes a part of a picture, which has the size of `out`: its grey as `to_grey` does, and its colours.
///
/// Panics where the part's columns are not in the picture, which `Node::open` has checked.
pub(super) fn to_colour(
    (format, matrix): (Format, &Matrix),
    bytes: &[u8],
    part: Part,
    scratch: &mut Vec<u8>,
    out: &mut Image,
    colour: &mut Colour,
) -> Result<(), Unreadable> {
    if format == Format::Mjpeg {
        return decode(bytes, part, scratch, out, colour);
    }
    check_bytes(bytes, least_bytes_in_colour(format, part))?;
    if let Some(red) = format.bayer() {
        bayer::read(red, bytes, part, scratch, out, Some(colour));
        return Ok(());
    }
    to_grey(format, bytes, part, scratch, out)?;
    let width = out.width;
    scratch.resize(2 * width, 0);
    let (cb, cr) = scratch.split_at_mut(width);
    let after_luma = part.height * part.stride;
    for (y, grey) in out.pixels.chunks_exact(width.max(1)).enumerate() {
        match format {
            Format::Nv12 => chroma::<2, 0>(&bytes[after_luma + y / 2 * part.stride..], part.x, cb, cr),
            Format::Yuyv => chroma::<4, 1>(&bytes[y * part.stride..], part.x, cb, cr),
            // No chroma: a grey picture.
            _ => cb.iter_mut().chain(cr.iter_mut()).for_each(|c| *c = 128),
        }
        matrix.row(grey, cb, cr, rows(colour, y));
    }
    Ok(())
}

/// Row `y` of each plane.
fn rows(colour: &mut Colour, y: usize) -> [&mut [u8]; 3] {
    colour.each_mut().map(|plane| &mut plane.pixels[y * plane.width..][..plane.width])
}

/// Spreads the chroma of a row from column `x` on: groups of `N` bytes for two pixels, with that of blue and of red in the
/// bytes from `FIRST` on, two apart in groups of four.
fn chroma<const N: usize, const FIRST: usize>(row: &[u8], x: usize, cb: &mut [u8], cr: &mut [u8]) {
    const PAIRS: usize = 8;
    let from = &row[x / 2 * N..];
    // In blocks of a known size, which become vector instructions, unless the part starts inside a group.
    let whole = if x % 2 == 0 { (from.len() / (PAIRS * N)).min(cb.len() / (2 * PAIRS)) } else { 0 };
    let to = cb.chunks_exact_mut(2 * PAIRS).zip(cr.chunks_exact_mut(2 * PAIRS));
    for ((b, r), groups) in to.zip(from.chunks_exact(PAIRS * N)).take(whole) {
        for i in 0..2 * PAIRS {
            (b[i], r[i]) = (groups[i / 2 * N + FIRST], groups[i / 2 * N + FIRST + N / 2]);
        }
    }
    for i in 2 * PAIRS * whole..cb.len() {
        let at = (x % 2 + i) / 2 * N + FIRST;
        (cb[i], cr[i]) = (from[at], from[at + N / 2]);
    }
}

/// Decodes a JPEG to its colours, and to its luma, which is the one that it has without them. One without colours is grey.
fn decode(
    bytes: &[u8],
    part: Part,
    scratch: &mut Vec<u8>,
    out: &mut Image,
    colour: &mut Colour,
) -> Result<(), Unreadable> {
    let mut decoder = jpeg_decoder(bytes, part, ColorSpace::YCbCr)?;
    if decoder.info().is_some_and(|i| i.components < 3) {
        to_grey(Format::Mjpeg, bytes, part, scratch, out)?;
        colour.iter_mut().for_each(|plane| plane.copy_from(out));
        return Ok(());
    }
    let (pixels, width) = (3 * part.width * part.height, out.width);
    scratch.resize(pixels + 2 * width, 0);
    let (pixels, chroma) = scratch.split_at_mut(pixels);
    decoder.decode_into(pixels).map_err(|e| undecodable(&e))?;
    let (cb, cr) = chroma.split_at_mut(width);
    let from = pixels.chunks_exact(3 * part.width.max(1));
    for (y, (row, grey)) in from.zip(out.pixels.chunks_exact_mut(width.max(1))).enumerate() {
        for (i, px) in row[3 * part.x..][..3 * width].chunks_exact(3).enumerate() {
            (grey[i], cb[i], cr[i]) = (px[0], px[1], px[2]);
        }
        Matrix::JFIF.row(grey, cb, cr, rows(colour, y));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::types::luma;
    use proptest::prelude::*;

    fn planes(width: usize, height: usize) -> Colour {
        [(); 3].map(|()| Image::new(width, height))
    }

    /// Grey and colours of a part of a picture.
    fn read(
        (format, matrix): (Format, &Matrix),
        bytes: &[u8],
        part: Part,
        width: usize,
    ) -> Result<(Image, Colour), Unreadable> {
        let (mut grey, mut colour) = (Image::new(width, part.height), planes(width, part.height));
        let mut scratch = vec![99; 7];
        to_colour((format, matrix), bytes, part, &mut scratch, &mut grey, &mut colour)?;
        let mut alone = grey.clone();
        to_grey(format, bytes, part, &mut scratch, &mut alone).unwrap();
        assert_eq!(alone, grey, "the grey is the same without colours");
        Ok((grey, colour))
    }

    /// The parts of red and blue in the luma, and the full range or not, by what a driver states, as BT.601, 709 and 2020 and
    /// the kernel's documentation have them.
    const STATED: [(Stated, [f64; 2], bool); 9] = [
        // SRGB of most USB cameras.
        (Stated { colorspace: 8, encoding: 0, quantization: 0 }, [0.299, 0.114], false),
        (Stated { colorspace: 8, encoding: 2, quantization: 1 }, [0.2126, 0.0722], true),
        (Stated { colorspace: 0, encoding: 0, quantization: 0 }, [0.299, 0.114], false),
        (Stated { colorspace: 3, encoding: 0, quantization: 0 }, [0.2126, 0.0722], false),
        (Stated { colorspace: 3, encoding: 1, quantization: 2 }, [0.299, 0.114], false),
        (Stated { colorspace: 7, encoding: 0, quantization: 0 }, [0.299, 0.114], true),
        (Stated { colorspace: 7, encoding: 0, quantization: 2 }, [0.299, 0.114], false),
        (Stated { colorspace: 10, encoding: 0, quantization: 0 }, [0.2627, 0.0593], false),
        (Stated { colorspace: 2, encoding: 0, quantization: 1 }, [0.212, 0.087], true),
    ];

    /// Y, Cb and Cr of a colour, rounded.
    fn ycbcr([r, g, b]: [u8; 3], [red, blue]: [f64; 2], full: bool) -> [u8; 3] {
        let [r, g, b] = [r, g, b].map(|v| f64::from(v) / 255.0);
        let y = red * r + (1.0 - red - blue) * g + blue * b;
        let (cb, cr) = ((b - y) / (2.0 * (1.0 - blue)), (r - y) / (2.0 * (1.0 - red)));
        let (black, of_luma, of_chroma) = if full { (0.0, 255.0, 255.0) } else { (16.0, 219.0, 224.0) };
        [black + of_luma * y, 128.0 + of_chroma * cb, 128.0 + of_chroma * cr].map(|v| v.round().min(255.0) as u8)
    }

    fn noise(seed: u32, i: usize) -> u8 {
        ((i as u32 + 1).wrapping_mul(seed | 1) >> 13) as u8
    }

    /// A picture of blocks of two by two pixels, each of one colour.
    fn block(seed: u32, width: usize, x: usize, y: usize) -> [u8; 3] {
        [0, 1, 2].map(|c| noise(seed, 3 * (y / 2 * width + x / 2) + c))
    }

    /// Packs a picture as a driver does; the padding is noise.
    fn pack(format: Format, pixel: impl Fn(usize, usize) -> [u8; 3], (w, h): (usize, usize), stride: usize) -> Vec<u8> {
        let mut bytes = vec![77; stride * (h + h.div_ceil(2))];
        for (x, y) in (0..w * h).map(|i| (i % w, i / w)) {
            let [luma, cb, cr] = pixel(x, y);
            match format {
                Format::Nv12 => {
                    bytes[y * stride + x] = luma;
                    bytes[(h + y / 2) * stride + x / 2 * 2..][..2].copy_from_slice(&[cb, cr]);
                }
                _ => {
                    bytes[y * stride + 2 * x] = luma;
                    bytes[y * stride + x / 2 * 4 + 1] = cb;
                    bytes[y * stride + x / 2 * 4 + 3] = cr;
                }
            }
        }
        bytes
    }

    proptest! {
        #[test]
        fn colours_that_were_packed_are_unpacked_to_their_rounding(
            yuyv: bool, which in 0..STATED.len(), w in 1usize..41, h in 1usize..9, padding in 0usize..9, seed: u32, split in 0usize..41,
        ) {
            let format = if yuyv { Format::Yuyv } else { Format::Nv12 };
            let (stated, parts, full) = STATED[which];
            let stride = (if yuyv { 2 } else { 1 }) * w.next_multiple_of(2) + padding;
            let bytes = pack(format, |x, y| ycbcr(block(seed, w, x, y), parts, full), (w, h), stride);
            let part = Part { x: 0, width: w, height: h, stride };
            let how = (format, &stated.matrix());
            let (_, colour) = read(how, &bytes, part, w).unwrap();
            // Half a level of luma and of chroma, by their coefficients, and half a level of the result.
            let bound = if full { 1 } else { 2 };
            for (x, y) in (0..w * h).map(|i| (i % w, i / w)) {
                for (plane, exact) in colour.iter().zip(block(seed, w, x, y)) {
                    prop_assert!(plane.at(x, y).abs_diff(exact) <= bound, "{} for {exact} at {x}, {y}", plane.at(x, y));
                }
            }
            // A part of it, from an even or an odd column on.
            let from = split % w;
            let (grey, of_part) = read(how, &bytes, Part { x: from, ..part }, w - from).unwrap();
            prop_assert_eq!(grey.width, w - from);
            for (x, y) in (from..w).flat_map(|x| (0..h).map(move |y| (x, y))) {
                prop_assert!((0..3).all(|c| of_part[c].at(x - from, y) == colour[c].at(x, y)), "{x}, {y}");
            }
            // The last row needs no padding; a byte less is refused.
            let needed = least_bytes_in_colour(format, part);
            prop_assert!(needed <= bytes.len() && read(how, &bytes[..needed], part, w).is_ok());
            prop_assert_eq!(read(how, &bytes[..needed - 1], part, w), Err(Unreadable::Short { needed, got: needed - 1 }));
        }

        /// Against the definition: the mean of those of the eight neighbours that have the colour.
        #[test]
        fn a_bayer_pixel_has_the_mean_of_its_nearest_neighbours_of_each_colour(
            which in 0usize..4, w in 2usize..20, h in 2usize..9, x0 in 0usize..5, right in 0usize..5, padding in 0usize..5, seed: u32,
        ) {
            let (format, pattern) = [
                (Format::Rggb, b"RGGB"), (Format::Grbg, b"GRBG"), (Format::Gbrg, b"GBRG"), (Format::Bggr, b"BGGR"),
            ][which];
            let (width, stride) = (x0 + w + right, x0 + w + right + padding);
            let bytes: Vec<u8> = (0..stride * h).map(|i| noise(seed, i)).collect();
            let part = Part { x: x0, width, height: h, stride };
            let (grey, colour) = read((format, &Matrix::JFIF), &bytes, part, w).unwrap();
            let mirrored = |i: isize, n: usize| if i < 0 { -i } else if i >= n as isize { 2 * n as isize - 2 - i } else { i } as usize;
            for (x, y) in (0..w * h).map(|i| (i % w, i / w)) {
                let mut exact = [0; 3];
                for (c, letter) in b"RGB".iter().enumerate() {
                    let (mut sum, mut n) = (0.0, 0.0);
                    let letter_at = |dx: isize, dy: isize| {
                        let (x, y) = (mirrored(x as isize + dx, w), mirrored(y as isize + dy, h));
                        (pattern[(y % 2) * 2 + (x0 + x) % 2] == *letter).then(|| f64::from(bytes[y * stride + x0 + x]))
                    };
                    for (dx, dy) in (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| (dx, dy))) {
                        // Where the pixel has the colour it is its own; where it lies beside, the corners are farther.
                        let corner = dx * dy != 0 && (-1..=1).any(|d| letter_at(d, 0).is_some() || letter_at(0, d).is_some());
                        let other = (dx, dy) != (0, 0) && letter_at(0, 0).is_some();
                        if let Some(v) = letter_at(dx, dy).filter(|_| !corner && !other) {
                            (sum, n) = (sum + v, n + 1.0);
                        }
                    }
                    exact[c] = (sum / n + 0.5f64).floor() as u8;
                    prop_assert_eq!(colour[c].at(x, y), exact[c], "channel {} at {}, {}", c, x, y);
                }
                prop_assert_eq!(grey.at(x, y), luma(exact[0], exact[1], exact[2]));
            }
            let needed = least_bytes_in_colour(format, part);
            prop_assert_eq!(read((format, &Matrix::JFIF), &bytes[..needed - 1], part, w), Err(Unreadable::Short { needed, got: needed - 1 }));
        }

        #[test]
        fn bytes_that_are_no_picture_are_no_panic(
            bytes in prop::collection::vec(any::<u8>(), 0..300), w in 0usize..20, h in 0usize..9, x in 0usize..9, more in 0usize..9,
        ) {
            for format in Format::all() {
                let stride = format.row_bytes(x + w + more) + more;
                let part = Part { x, width: x + w + more, height: h, stride };
                let bytes = if format == Format::Mjpeg { [&[0xff, 0xd8, 0xff][..], &bytes].concat() } else { bytes.clone() };
                let _ = read((format, &Matrix::JFIF), &bytes, part, w);
            }
        }
    }

    #[test]
    fn a_flat_bayer_picture_is_flat() {
        for (format, pattern) in [(Format::Rggb, [9, 99, 99, 200]), (Format::Gbrg, [99, 200, 9, 99])] {
            let bytes: Vec<u8> = (0..8 * 6).map(|i| pattern[i / 8 % 2 * 2 + i % 2]).collect();
            let part = Part { x: 0, width: 8, height: 6, stride: 8 };
            let (_, colour) = read((format, &Matrix::JFIF), &bytes, part, 8).unwrap();
            for (plane, level) in colour.iter().zip([9, 99, 200]) {
                assert!(plane.pixels.iter().all(|p| *p == level), "{format:?} {level}");
            }
        }
    }

    #[test]
    fn jpeg_gives_its_colours_in_halves_too_and_its_luma_bit_for_bit() {
        let (w, h) = (32, 16);
        let block = |i: usize| ycbcr([20 + 25 * i as u8, 240 - 20 * i as u8, 60 + 10 * i as u8], [0.299, 0.114], true);
        let of = |c: usize| (0..8).map(|i| block(i)[c]).collect::<Vec<u8>>();
        let jpeg = crate::jpeg::planes(w, h, &[&of(0), &of(1), &of(2)]);
        let part = Part { x: 0, width: w, height: h, stride: 0 };
        let limited = STATED[0].0.matrix();
        let (_, colour) = read((Format::Mjpeg, &limited), &jpeg, part, w).unwrap();
        for (x, y) in (0..w * h).map(|i| (i % w, i / w)) {
            let i = y / 8 * (w / 8) + x / 8;
            let exact = [20 + 25 * i as u8, 240 - 20 * i as u8, 60 + 10 * i as u8];
            // A level of each of the three from its coder, 1.8 levels of colour at most, and the rounding.
            assert!((0..3).all(|c| colour[c].at(x, y).abs_diff(exact[c]) <= 4), "{x}, {y}: not {exact:?}");
        }
        let (_, half) = read((Format::Mjpeg, &limited), &jpeg, Part { x: 16, ..part }, 16).unwrap();
        assert!((0..16 * 16).all(|i| (0..3).all(|c| half[c].at(i % 16, i / 16) == colour[c].at(16 + i % 16, i / 16))));
        for cut in 0..jpeg.len() - 2 {
            let truncated = read((Format::Mjpeg, &limited), &jpeg[..cut], part, w);
            assert!(matches!(truncated, Err(Unreadable::Undecodable(_))), "cut at {cut} of {}", jpeg.len());
        }
        // Its colours at half the resolution, by another program's coder.
        let (w, h) = (32, 24);
        let halves = include_bytes!("../../tests/folder/halves.jpg");
        let part = Part { x: 0, width: w, height: h, stride: 0 };
        let (_, colour) = read((Format::Mjpeg, &limited), halves, part, w).unwrap();
        let off = |c: usize, x: usize| colour[c].at(x, 5).abs_diff([[200, 80, 40], [30, 90, 210]][x / (w / 2)][c]);
        assert!((0..3).all(|c| [0, w / 2 - 4, w / 2 + 4, w - 1].iter().all(|x| off(c, *x) < 6)));
        // One without colours.
        let grey = crate::jpeg::flat(16, 8, &[50, 200]);
        let (luma, colour) = read((Format::Mjpeg, &limited), &grey, Part { width: 16, height: 8, ..part }, 16).unwrap();
        assert!(colour.iter().all(|plane| *plane == luma));
    }

    #[test]
    fn codes_in_colour_are_those_whose_chroma_is_mapped() {
        let code = |text: &[u8; 4]| u32::from_le_bytes(*text);
        let in_colour = |text| Format::all().find(|f| f.is_in_colour(code(text)));
        for (text, format) in
            [(b"NV12", Format::Nv12), (b"YUYV", Format::Yuyv), (b"RGGB", Format::Rggb), (b"MJPG", Format::Mjpeg)]
        {
            assert_eq!(in_colour(text), Some(format));
        }
        assert!([b"NM12", b"GREY", b"Y10P", b"H264"].iter().all(|text| in_colour(text).is_none()));
    }
}
