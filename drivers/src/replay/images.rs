//! Decoding of one frame's images to 8-bit grey: PNG of 8 or 16 bits (the high byte is taken:
//! recordings use the full range), grey, palette or colour; JPEG, grey or colour. Decoding is strict, so that
//! half an image is a fault and not a half-grey picture.

use super::findings::{self, Findings, ReplayCounters};
use super::pairing::{FrameFiles, ImageFile};
use crate::types::{Frames, Image};
use std::fmt;
use std::io::{Cursor, Read};
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::{colorspace::ColorSpace, options::DecoderOptions};
use zune_jpeg::JpegDecoder;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameFaultKind {
    Missing,
    Undecodable,
    WrongSize,
}

/// Why one frame has no images. The recording goes on without it.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameFault {
    pub kind: FrameFaultKind,
    /// csv:line that lists the image.
    pub place: String,
    pub what: String,
}

impl fmt::Display for FrameFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.place, self.what)
    }
}

impl std::error::Error for FrameFault {}

/// Decodes the frames of a recording.
#[derive(Debug, Default)]
pub struct Reader {
    frames: Vec<FrameFiles>,
    file: Vec<u8>,
    decoded: Vec<u8>,
    findings: Findings,
}

impl Reader {
    pub(super) fn new(frames: Vec<FrameFiles>) -> Reader {
        Reader { frames, ..Reader::default() }
    }

    /// Faults of the images read so far; add them to the recording's.
    pub fn counters(&self) -> &ReplayCounters {
        &self.findings.counters
    }

    /// The first faults of each kind as "file:line: what".
    pub fn warnings(&self) -> &[String] {
        &self.findings.warnings
    }

    /// Fills `out`, which is shaped by `Frames::for_rig`. After a fault its pixels are unspecified.
    ///
    /// Panics where `index` is not that of a frame or `out` has not one image a camera.
    pub fn read(&mut self, index: usize, out: &mut Frames) -> Result<(), FrameFault> {
        let frame = &self.frames[index];
        assert_eq!(frame.images.len(), out.images.len(), "Frames::for_rig gives one image a camera");
        out.t = frame.t;
        for (file, image) in frame.images.iter().zip(&mut out.images) {
            let Err((kind, what)) = read_image(file, &mut self.file, &mut self.decoded, image) else { continue };
            let counter: fn(&mut ReplayCounters) -> &mut u64 = match kind {
                FrameFaultKind::Missing => |c| &mut c.images_missing,
                FrameFaultKind::Undecodable => |c| &mut c.images_undecodable,
                FrameFaultKind::WrongSize => |c| &mut c.images_wrong_size,
            };
            let what = format!("{}: {what}", file.path.display());
            self.findings.warn(counter, &file.list, file.line, &what);
            return Err(FrameFault { kind, place: findings::place(&file.list, file.line), what });
        }
        Ok(())
    }
}

type Why = (FrameFaultKind, String);

fn read_image(file: &ImageFile, bytes: &mut Vec<u8>, decoded: &mut Vec<u8>, out: &mut Image) -> Result<(), Why> {
    let missing = |e: std::io::Error| (FrameFaultKind::Missing, format!("cannot read: {e}"));
    bytes.clear();
    std::fs::File::open(&file.path).and_then(|mut f| f.read_to_end(bytes)).map_err(missing)?;
    if bytes.starts_with(b"\x89PNG") {
        read_png(bytes, decoded, out)
    } else if bytes.starts_with(b"\xff\xd8") {
        read_jpeg(bytes, out)
    } else {
        Err(undecodable("neither PNG nor JPEG"))
    }
}

fn undecodable(e: impl fmt::Display) -> Why {
    (FrameFaultKind::Undecodable, format!("cannot decode: {e}"))
}

/// Before anything is decoded, so that a wrong header cannot ask for more memory than the camera's.
fn check_size(width: usize, height: usize, out: &Image) -> Result<(), Why> {
    if (width, height) == (out.width, out.height) {
        return Ok(());
    }
    let what = format!("is {width}x{height}, the calibration says {}x{}", out.width, out.height);
    Err((FrameFaultKind::WrongSize, what))
}

fn read_png(bytes: &[u8], decoded: &mut Vec<u8>, out: &mut Image) -> Result<(), Why> {
    let mut decoder = png::Decoder::new(Cursor::new(bytes));
    decoder.set_transformations(png::Transformations::EXPAND | png::Transformations::STRIP_16);
    let mut reader = decoder.read_info().map_err(undecodable)?;
    check_size(reader.info().width as usize, reader.info().height as usize, out)?;
    let (colour, _) = reader.output_color_type();
    if colour == png::ColorType::Grayscale {
        reader.next_frame(&mut out.pixels).map_err(undecodable)?;
    } else {
        let channels = colour.samples();
        decoded.resize(out.pixels.len() * channels, 0);
        reader.next_frame(decoded).map_err(undecodable)?;
        for (grey, px) in out.pixels.iter_mut().zip(decoded.chunks_exact(channels)) {
            *grey = if channels < 3 { px[0] } else { luma(px[0], px[1], px[2]) };
        }
    }
    reader.finish().map_err(undecodable)
}

/// ITU-R BT.601, the weights of JPEG's own luma.
fn luma(r: u8, g: u8, b: u8) -> u8 {
    ((77 * u32::from(r) + 150 * u32::from(g) + 29 * u32::from(b) + 128) >> 8) as u8
}

fn read_jpeg(bytes: &[u8], out: &mut Image) -> Result<(), Why> {
    let options = DecoderOptions::default().set_strict_mode(true).jpeg_set_out_colorspace(ColorSpace::Luma);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(undecodable)?;
    let (width, height) = decoder.dimensions().ok_or_else(|| undecodable("no size"))?;
    check_size(width, height, out)?;
    decoder.decode_into(&mut out.pixels).map_err(undecodable)
}
