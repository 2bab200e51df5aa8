//! A picture as a camera's driver gives it, to 8-bit grey: the only copy between the kernel's buffer and the tracker. Deeper
//! pixels keep their high bits, colour pictures the camera's own luma; one behind a Bayer filter has the luma of its colours.
//! The colours themselves are read in `colour`.

use super::bayer;
use crate::jpeg_scan::check_whole;
use crate::types::Image;
use serde::{Deserialize, Serialize};
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::{colorspace::ColorSpace, options::DecoderOptions};
use zune_jpeg::JpegDecoder;

/// A decoder of the bytes of one picture.
pub(super) type Decoder<'a> = JpegDecoder<ZCursor<&'a [u8]>>;

/// Formats that can be read, in the order in which one is chosen where the board names none: the cheapest to unpack first,
/// and those that lose detail last.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Format {
    Grey,
    /// Ten, twelve and sixteen bits in the low end of two bytes, the low one first.
    Y10,
    Y12,
    Y16,
    /// MIPI: four pixels in five bytes, two in three; the high bits have a byte each, the low ones share the last.
    Y10p,
    Y12p,
    /// A plane of luma, and after it one of chroma, a pair for each two by two pixels. One in a buffer of its own (NM12) is not
    /// read.
    Nv12,
    Yuyv,
    /// A sensor's own pixels of eight bits behind a filter of two by two colours, named row by row.
    Rggb,
    Grbg,
    Gbrg,
    Bggr,
    Mjpeg,
}

/// Each format with its name in board files, and the codes by which drivers offer it.
const FORMATS: [(Format, &str, &[&[u8; 4]]); 13] = [
    (Format::Grey, "grey", &[b"GREY"]),
    (Format::Y10, "y10", &[b"Y10 "]),
    (Format::Y12, "y12", &[b"Y12 "]),
    (Format::Y16, "y16", &[b"Y16 "]),
    (Format::Y10p, "y10p", &[b"Y10P"]),
    (Format::Y12p, "y12p", &[b"Y12P"]),
    (Format::Nv12, "nv12", &[b"NV12", b"NM12"]),
    (Format::Yuyv, "yuyv", &[b"YUYV"]),
    (Format::Rggb, "rggb", &[b"RGGB"]),
    (Format::Grbg, "grbg", &[b"GRBG"]),
    (Format::Gbrg, "gbrg", &[b"GBRG"]),
    (Format::Bggr, "bggr", &[b"BA81"]),
    (Format::Mjpeg, "mjpeg", &[b"MJPG", b"JPEG"]),
];

impl Format {
    /// All formats, in the order in which one is chosen.
    pub(super) fn all() -> impl Iterator<Item = Format> {
        FORMATS.iter().map(|f| f.0)
    }

    /// Whether a driver's code means this format.
    pub(super) fn is(self, fourcc: u32) -> bool {
        FORMATS[self as usize].2.contains(&&fourcc.to_le_bytes())
    }

    /// The name in board files.
    pub fn name(self) -> &'static str {
        FORMATS[self as usize].1
    }

    /// Where the filter of a sensor's own pixels is red; none of other formats.
    pub(super) fn bayer(self) -> Option<bayer::Red> {
        match self {
            Format::Rggb => Some((0, 0)),
            Format::Grbg => Some((1, 0)),
            Format::Gbrg => Some((0, 1)),
            Format::Bggr => Some((1, 1)),
            _ => None,
        }
    }

    /// Bytes from a row's start to the end of its pixel `width - 1`; 0 for compressed pictures.
    pub(super) fn row_bytes(self, width: usize) -> usize {
        match self {
            Format::Grey | Format::Nv12 | Format::Rggb | Format::Grbg | Format::Gbrg | Format::Bggr => width,
            Format::Y10 | Format::Y12 | Format::Y16 => 2 * width,
            // A byte of low bits follows each whole group; that of a group that is cut is not needed.
            Format::Y10p => width + width.saturating_sub(1) / 4,
            Format::Y12p => width + width.saturating_sub(1) / 2,
            Format::Yuyv => (2 * width).saturating_sub(1),
            Format::Mjpeg => 0,
        }
    }
}

/// Where the pixels of one camera lie in a node's picture: all of it, or a half of two side by side.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Part {
    /// First column.
    pub x: usize,
    /// Columns of the whole picture, pixels; the image that is written gives those of the part.
    pub width: usize,
    /// Rows of the whole picture, pixels.
    pub height: usize,
    /// Bytes from row to row.
    pub stride: usize,
}

/// Why a picture cannot be read: the driver wrote fewer bytes than it has, or they are no such picture.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Unreadable {
    Short { needed: usize, got: usize },
    Undecodable(String),
}

impl std::fmt::Display for Unreadable {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Unreadable::Short { needed, got } => write!(f, "{got} bytes of {needed}"),
            Unreadable::Undecodable(why) => write!(f, "cannot decode: {why}"),
        }
    }
}

/// Least bytes of a picture, without the padding after its last row; 0 for a compressed picture, which states its length.
pub(super) fn least_bytes(format: Format, part: Part) -> usize {
    if format == Format::Mjpeg {
        return 0;
    }
    part.height.saturating_sub(1) * part.stride + format.row_bytes(part.width)
}

/// Writes a part of a picture, which has the size of `out`. `scratch` is used for compressed pictures with several parts, and
/// for a row of colours.
///
/// Panics where the part's columns are not in the picture, which `Node::open` has checked.
pub(super) fn to_grey(
    format: Format,
    bytes: &[u8],
    part: Part,
    scratch: &mut Vec<u8>,
    out: &mut Image,
) -> Result<(), Unreadable> {
    assert!(part.x + out.width <= part.width && out.height == part.height, "checked when the node was opened");
    if format == Format::Mjpeg {
        return decode(bytes, part, scratch, out);
    }
    check_bytes(bytes, least_bytes(format, part))?;
    if out.width == 0 {
        return Ok(());
    }
    if let Some(red) = format.bayer() {
        bayer::read(red, bytes, part, scratch, out, None);
        return Ok(());
    }
    let row_bytes = format.row_bytes(part.width);
    let rows = (0..part.height).map(|y| &bytes[y * part.stride..y * part.stride + row_bytes]);
    for (row, to) in rows.zip(out.pixels.chunks_exact_mut(out.width)) {
        unpack_row(format, row, part.x, to);
    }
    Ok(())
}

/// Refuses fewer bytes than are `needed`.
pub(super) fn check_bytes(bytes: &[u8], needed: usize) -> Result<(), Unreadable> {
    if bytes.len() < needed {
        return Err(Unreadable::Short { needed, got: bytes.len() });
    }
    Ok(())
}

/// Unpacks the pixels of a row from column `x` on.
fn unpack_row(format: Format, row: &[u8], x: usize, to: &mut [u8]) {
    match format {
        Format::Grey | Format::Nv12 => to.copy_from_slice(&row[x..x + to.len()]),
        // A camera that sets bits above its depth would wrap; it is clamped to white instead.
        Format::Y10 => words(&row[2 * x..], to, |v| (v >> 2).min(255) as u8),
        Format::Y12 => words(&row[2 * x..], to, |v| (v >> 4).min(255) as u8),
        Format::Y16 => every_other(&row[2 * x + 1..], to),
        Format::Y10p => packed::<4>(row, x, to),
        Format::Y12p => packed::<2>(row, x, to),
        Format::Yuyv => every_other(&row[2 * x..], to),
        Format::Rggb | Format::Grbg | Format::Gbrg | Format::Bggr | Format::Mjpeg => {}
    }
}

fn words(row: &[u8], to: &mut [u8], narrow: impl Fn(u16) -> u8) {
    to.iter_mut().zip(row.chunks_exact(2)).for_each(|(p, w)| *p = narrow(u16::from_le_bytes([w[0], w[1]])));
}

/// Copies bytes 0, 2, 4 and so on. Blocks of a known size become vector instructions: a fifth of the plain loop's time.
fn every_other(row: &[u8], to: &mut [u8]) {
    const BLOCK: usize = 16;
    let whole = (row.len() / (2 * BLOCK)).min(to.len() / BLOCK);
    for (p, w) in to.chunks_exact_mut(BLOCK).zip(row.chunks_exact(2 * BLOCK)) {
        let p: &mut [u8; BLOCK] = p.try_into().expect("a whole block");
        let w: &[u8; 2 * BLOCK] = w.try_into().expect("a whole block");
        (0..BLOCK).for_each(|i| p[i] = w[2 * i]);
    }
    (BLOCK * whole..to.len()).for_each(|i| to[i] = row[2 * i]);
}

/// Unpacks groups of `N` bytes, a pixel each, that are followed by a byte of low bits.
fn packed<const N: usize>(row: &[u8], x: usize, to: &mut [u8]) {
    let from = &row[x + x / N..];
    // In whole groups, unless the part starts inside one; the last may lack its low bits.
    let whole = if x % N == 0 { (from.len() / (N + 1)).min(to.len() / N) } else { 0 };
    for (p, group) in to.chunks_exact_mut(N).zip(from.chunks_exact(N + 1)).take(whole) {
        p.copy_from_slice(&group[..N]);
    }
    (N * whole..to.len()).for_each(|i| to[i] = row[(x + i) + (x + i) / N]);
}

/// The fault of a JPEG that cannot be decoded.
pub(super) fn undecodable(e: &dyn std::fmt::Display) -> Unreadable {
    Unreadable::Undecodable(e.to_string())
}

/// Reads the headers of a JPEG that is decoded to `space`, strictly: half a picture is an error and not a picture whose rest
/// is grey, or the last picture's.
pub(super) fn jpeg_decoder(bytes: &[u8], part: Part, space: ColorSpace) -> Result<Decoder<'_>, Unreadable> {
    check_whole(bytes).map_err(|what| undecodable(&what))?;
    let options = DecoderOptions::default().set_strict_mode(true).jpeg_set_out_colorspace(space);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(|e| undecodable(&e))?;
    let size = decoder.dimensions().ok_or_else(|| undecodable(&"no size"))?;
    if size != (part.width, part.height) {
        return Err(undecodable(&format!("is {}x{}, not {}x{}", size.0, size.1, part.width, part.height)));
    }
    Ok(decoder)
}

/// Decodes the luma of a JPEG.
fn decode(bytes: &[u8], part: Part, scratch: &mut Vec<u8>, out: &mut Image) -> Result<(), Unreadable> {
    let mut decoder = jpeg_decoder(bytes, part, ColorSpace::Luma)?;
    if part.width == out.width {
        return decoder.decode_into(&mut out.pixels).map_err(|e| undecodable(&e));
    }
    scratch.resize(part.width * part.height, 0);
    decoder.decode_into(scratch).map_err(|e| undecodable(&e))?;
    let rows = scratch.chunks_exact(part.width).zip(out.pixels.chunks_exact_mut(out.width));
    rows.for_each(|(row, to)| to.copy_from_slice(&row[part.x..part.x + to.len()]));
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::colour::to_colour;
    use super::*;
    use crate::ycbcr::Matrix;
    use proptest::prelude::*;

    /// A picture packed in `format`, of which `to_grey` must give `grey` back; low bits and padding are `noise`.
    fn pack(format: Format, grey: &[u8], width: usize, stride: usize, noise: u8) -> Vec<u8> {
        let height = grey.len() / width;
        let mut bytes = vec![noise; stride * height];
        for (y, row) in grey.chunks_exact(width).enumerate() {
            for (x, g) in row.iter().enumerate() {
                let at = y * stride;
                let word =
                    |bytes: &mut [u8], v: u16| bytes[at + 2 * x..at + 2 * x + 2].copy_from_slice(&v.to_le_bytes());
                let (g16, n16) = (u16::from(*g), u16::from(noise));
                match format {
                    Format::Grey | Format::Nv12 => bytes[at + x] = *g,
                    Format::Y10 => word(&mut bytes, g16 << 2 | n16 & 3),
                    Format::Y12 => word(&mut bytes, g16 << 4 | n16 & 15),
                    Format::Y16 => word(&mut bytes, g16 << 8 | n16),
                    Format::Y10p => bytes[at + x / 4 * 5 + x % 4] = *g,
                    Format::Y12p => bytes[at + x / 2 * 3 + x % 2] = *g,
                    Format::Yuyv => bytes[at + 2 * x] = *g,
                    _ => unreachable!("has no grey of its own"),
                }
            }
        }
        bytes
    }

    fn whole(width: usize, height: usize, stride: usize) -> Part {
        Part { x: 0, width, height, stride }
    }

    proptest! {
        #[test]
        fn high_bits_of_every_pixel_arrive_and_low_bits_and_padding_do_not(
            which in 0usize..8,
            width in 1usize..41,
            height in 1usize..9,
            padding in 0usize..23,
            noise: u8,
            seed: u32,
            split in 0usize..41,
        ) {
            let format = FORMATS[which].0;
            let grey: Vec<u8> = (0..width * height).map(|i| ((i as u32 + 1).wrapping_mul(seed | 1) >> 13) as u8).collect();
            // Whole groups of packed pixels, as MIPI has them.
            let stride = format.row_bytes(width.next_multiple_of(4)) + 2 + padding;
            let bytes = pack(format, &grey, width, stride, noise);
            let mut out = Image::new(width, height);
            to_grey(format, &bytes, whole(width, height, stride), &mut Vec::new(), &mut out).unwrap();
            prop_assert_eq!(&out.pixels, &grey);
            // A part of it: columns from `split` on.
            let x = split % width;
            let mut half = Image::new(width - x, height);
            to_grey(format, &bytes, Part { x, width, height, stride }, &mut Vec::new(), &mut half).unwrap();
            for y in 0..height {
                prop_assert_eq!(&half.pixels[y * (width - x)..(y + 1) * (width - x)], &grey[y * width + x..(y + 1) * width]);
            }
            // The last row needs no padding, and one byte less is refused and read nowhere.
            let needed = least_bytes(format, whole(width, height, stride));
            prop_assert!(to_grey(format, &bytes[..needed], whole(width, height, stride), &mut Vec::new(), &mut out).is_ok());
            let short = to_grey(format, &bytes[..needed - 1], whole(width, height, stride), &mut Vec::new(), &mut out);
            prop_assert_eq!(short, Err(Unreadable::Short { needed, got: needed - 1 }));
        }

        #[test]
        fn bytes_that_are_no_picture_are_an_error_and_no_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            let mut out = Image::new(8, 8);
            let mut jpeg = vec![0xff, 0xd8, 0xff];
            jpeg.extend(bytes);
            prop_assert!(to_grey(Format::Mjpeg, &jpeg, whole(8, 8, 0), &mut Vec::new(), &mut out).is_err());
        }
    }

    #[test]
    fn each_format_stands_at_its_place_in_the_table() {
        assert!(FORMATS.iter().enumerate().all(|(i, f)| f.0 as usize == i));
    }

    #[test]
    fn pixels_brighter_than_their_depth_are_white() {
        let mut out = Image::new(1, 1);
        for format in [Format::Y10, Format::Y12] {
            to_grey(format, &[0xff, 0xff], whole(1, 1, 2), &mut Vec::new(), &mut out).unwrap();
            assert_eq!(out.pixels, [255]);
        }
    }

    #[test]
    #[ignore = "prints times of conversions: cargo test --release -p stipple-drivers --lib cost_of_a_picture -- --ignored --nocapture"]
    fn cost_of_a_picture() {
        const RUNS: usize = 200;
        let (width, height) = (752, 480);
        let median = |work: &mut dyn FnMut()| {
            let mut us: Vec<f64> = (0..RUNS)
                .map(|_| {
                    let start = std::time::Instant::now();
                    work();
                    start.elapsed().as_secs_f64() * 1e6
                })
                .collect();
            us.sort_by(f64::total_cmp);
            us[RUNS / 2]
        };
        let noise: Vec<u8> = (0..2 * width * height).map(|i| (i * 7) as u8).collect();
        let mut out = Image::new(width, height);
        let mut colour = [(); 3].map(|()| out.clone());
        let copy = median(&mut || {
            out.pixels.copy_from_slice(std::hint::black_box(&noise[..width * height]));
            std::hint::black_box(&mut out);
        });
        println!("copy of {width}x{height}: {copy:.0} us");
        let mut scratch = Vec::new();
        for format in Format::all() {
            let blocks = width / 8 * (height / 8);
            let bytes = match format {
                Format::Mjpeg => crate::jpeg::planes(
                    width,
                    height,
                    &[&noise[..blocks], &noise[9..][..blocks], &noise[5..][..blocks]],
                ),
                _ => noise.clone(),
            };
            let stride = format.row_bytes(width).next_multiple_of(2);
            let part = whole(width, height, stride);
            let grey = median(&mut || {
                to_grey(format, std::hint::black_box(&bytes), part, &mut scratch, &mut out).unwrap();
                std::hint::black_box(&out);
            });
            println!("{}: {grey:.0} us, {:.1} copies", format.name(), grey / copy);
            if !format.has_colour() {
                continue;
            }
            let us = median(&mut || {
                let how = (format, &Matrix::JFIF);
                to_colour(how, std::hint::black_box(&bytes), part, &mut scratch, &mut out, &mut colour).unwrap();
                std::hint::black_box((&out, &colour));
            });
            println!("{} in colour: {us:.0} us, {:.1} copies", format.name(), us / copy);
            // A tenth of the time between frames at 20 Hz: what else is done with a frame has the rest.
            assert!(us < 5000.0, "{} in colour: {us:.0} us", format.name());
        }
    }

    #[test]
    fn a_picture_without_pixels_is_no_panic() {
        for format in Format::all().filter(|f| *f != Format::Mjpeg) {
            let mut out = Image::new(0, 3);
            to_grey(format, &[], whole(0, 3, 0), &mut Vec::new(), &mut out).unwrap();
        }
    }

    /// Every bit of a compressed picture turned over, one at a time: half are refused, the rest are another picture, and
    /// none is a panic. Of grey pictures no bit can be told.
    #[test]
    fn a_bit_that_flipped_in_a_compressed_picture_is_refused_or_harmless() {
        let blocks: Vec<u8> = (0..32).map(|i| 8 * i).collect();
        let jpeg = crate::jpeg::flat(64, 32, &blocks);
        let mut out = Image::new(64, 32);
        let mut refused = 0;
        for bit in 0..8 * jpeg.len() {
            let mut flipped = jpeg.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            refused +=
                usize::from(to_grey(Format::Mjpeg, &flipped, whole(64, 32, 0), &mut Vec::new(), &mut out).is_err());
        }
        println!("{refused} of {} bits are seen", 8 * jpeg.len());
        assert!(4 * refused > 8 * jpeg.len(), "{refused} of {}", 8 * jpeg.len());
    }

    #[test]
    fn jpeg_is_decoded_whole_in_halves_and_never_by_half() {
        let (width, height) = (32, 16);
        let blocks: Vec<u8> = (0..8).map(|i| 16 + 24 * i).collect();
        let jpeg = crate::jpeg::flat(width, height, &blocks);
        let mut out = Image::new(width, height);
        let mut scratch = Vec::new();
        to_grey(Format::Mjpeg, &jpeg, whole(width, height, 0), &mut scratch, &mut out).unwrap();
        for (i, p) in out.pixels.iter().enumerate() {
            let block = (i / width) / 8 * (width / 8) + (i % width) / 8;
            assert!(p.abs_diff(blocks[block]) <= 1, "pixel {i} is {p}, not {}", blocks[block]);
        }
        assert!(scratch.is_empty(), "a whole picture is decoded in place");
        let mut half = Image::new(16, height);
        to_grey(Format::Mjpeg, &jpeg, Part { x: 16, width, height, stride: 0 }, &mut scratch, &mut half).unwrap();
        assert_eq!(half.at(0, 0), out.at(16, 0));
        assert_eq!(half.at(15, 15), out.at(31, 15));
        for cut in 0..jpeg.len() - 2 {
            let truncated = to_grey(Format::Mjpeg, &jpeg[..cut], whole(width, height, 0), &mut scratch, &mut out);
            assert!(matches!(truncated, Err(Unreadable::Undecodable(_))), "cut at {cut} of {}", jpeg.len());
        }
        let wrong = to_grey(Format::Mjpeg, &jpeg, whole(16, 16, 0), &mut scratch, &mut Image::new(16, 16));
        assert!(matches!(&wrong, Err(Unreadable::Undecodable(why)) if why.contains("32x16")), "{wrong:?}");
    }
}
