//! Decodes the images of one frame to 8-bit grey: PNG of 8 or 16 bits (the high byte is taken: recordings use the full
//! range), grey, palette or colour; JPEG, grey or colour. Decoding is strict, so that half an image is a fault and not a
//! half-grey picture. Where colour is asked for, red, green and blue are given beside the same grey; those of a grey file
//! are equal.

use super::findings::{Findings, ReplayCounters};
use super::pairing::{FrameFiles, ImageFile};
use crate::input;
use crate::jpeg_scan::check_whole;
use crate::types::{luma, Colour, Frames, Image};
use crate::ycbcr::Matrix;
use std::fmt;
use std::io::{Cursor, ErrorKind};
use std::path::Path;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::{colorspace::ColorSpace, options::DecoderOptions};
use zune_jpeg::JpegDecoder;

/// Why an image is missing; the reader's warnings say which file and what. The recording goes on with those of the other
/// cameras.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImageFault {
    /// A file cannot be read.
    Missing,
    Undecodable,
    /// Its size differs from the calibration's.
    WrongSize,
}

/// Decodes the frames of a recording.
#[derive(Debug)]
pub struct Reader {
    frames: Box<[FrameFiles]>,
    /// The recording's folder, canonical: no link leads out of it.
    root: Box<Path>,
    file: Vec<u8>,
    decoded: Vec<u8>,
    findings: Box<Findings>,
}

impl Reader {
    pub(super) fn new(frames: Box<[FrameFiles]>, root: Box<Path>) -> Reader {
        Reader { frames, root, file: vec![], decoded: vec![], findings: Box::default() }
    }

    /// Faults of the images read so far.
    pub fn counters(&self) -> &ReplayCounters {
        &self.findings.counters
    }

    /// The first faults of each kind as "file:line: what".
    pub fn warnings(&self) -> &[String] {
        &self.findings.warnings
    }

    /// Whether the first `cameras` have colour, by the first image of each that can be read, if one can.
    pub fn has_colour(&self, cameras: usize) -> bool {
        let coloured = |k: usize| {
            self.frames.iter().find_map(|f| is_coloured(f.images.get(k)?.as_ref()?, &self.root)).unwrap_or(true)
        };
        (0..cameras).all(coloured)
    }

    /// Fills `out`, which is shaped by `Frames::for_rig` or `in_colour`. Images of cameras that are away are black, and those
    /// that cannot be read, of which the first is the fault.
    ///
    /// Panics where there is no frame `index`, or `out` has another number of images.
    pub fn read(&mut self, index: usize, out: &mut Frames) -> Result<(), ImageFault> {
        self.fill(index, out).1.map_or(Ok(()), Err)
    }

    /// Fills `out` as [`Reader::read`] does; a fault only where no image can be read.
    pub fn read_any(&mut self, index: usize, out: &mut Frames) -> Result<(), ImageFault> {
        match self.fill(index, out) {
            (0, Some(fault)) => Err(fault),
            _ => Ok(()),
        }
    }

    /// Fills `out`; answers how many images were read, and the fault of the first that could not be.
    fn fill(&mut self, index: usize, out: &mut Frames) -> (usize, Option<ImageFault>) {
        let frame = &self.frames[index];
        assert_eq!(frame.images.len(), out.images.len(), "Frames::for_rig gives one image for each camera");
        out.t = frame.t;
        let mut colours = out.colours.iter_mut();
        let (mut count, mut first) = (0, None);
        for (file, image) in frame.images.iter().zip(&mut out.images) {
            let mut colour = colours.next();
            let read = file.as_ref().map(|file| {
                let colour = colour.as_deref_mut();
                read_image(file, &self.root, &mut self.file, &mut self.decoded, image, colour)
                    .map_err(|why| (file, why))
            });
            if let Some(Ok(())) = read {
                count += 1;
                continue;
            }
            let planes = colour.into_iter().flatten().chain([image]);
            planes.for_each(|plane| plane.pixels.fill(0));
            let Some(Err((file, (fault, what)))) = read else { continue };
            let counter: fn(&mut ReplayCounters) -> &mut u64 = match fault {
                ImageFault::Missing => |c| &mut c.images_missing,
                ImageFault::Undecodable => |c| &mut c.images_undecodable,
                ImageFault::WrongSize => |c| &mut c.images_wrong_size,
            };
            self.findings.warn(counter, &file.list, file.line, format_args!("{}: {what}", file.path.display()));
            first = first.or(Some(fault));
        }
        (count, first)
    }
}

/// Largest image file: 16 megapixels of three 16-bit colours, not compressed.
const FILE_BYTES_MAX: u64 = 96 << 20;

/// A fault, and what is said of it.
type Why = (ImageFault, String);

fn read_image(
    file: &ImageFile,
    root: &Path,
    bytes: &mut Vec<u8>,
    decoded: &mut Vec<u8>,
    out: &mut Image,
    colour: Option<&mut Colour>,
) -> Result<(), Why> {
    read_file(file, root, bytes)?;
    if bytes.starts_with(b"\x89PNG") {
        read_png(bytes, decoded, out, colour)
    } else if bytes.starts_with(b"\xff\xd8") {
        match colour {
            None => read_jpeg(bytes, out),
            Some(colour) => read_jpeg_colour(bytes, decoded, out, colour),
        }
    } else {
        Err(undecodable("neither PNG nor JPEG"))
    }
}

/// Reads the bytes of a file of the recording.
fn read_file(file: &ImageFile, root: &Path, bytes: &mut Vec<u8>) -> Result<(), Why> {
    if input::leads_out(&file.path, root) {
        return Err((ImageFault::Missing, "is a link out of the recording".to_string()));
    }
    input::read(&file.path, FILE_BYTES_MAX, bytes).map_err(|e| match e.kind() {
        ErrorKind::FileTooLarge => undecodable(e),
        _ => (ImageFault::Missing, format!("cannot read: {e}")),
    })
}

/// Whether an image has colour; `None` where its header cannot be read.
fn is_coloured(file: &ImageFile, root: &Path) -> Option<bool> {
    let mut bytes = Vec::new();
    read_file(file, root, &mut bytes).ok()?;
    if bytes.starts_with(b"\x89PNG") {
        let mut decoder = png::Decoder::new(Cursor::new(&bytes));
        decoder.set_transformations(png::Transformations::EXPAND);
        return Some(decoder.read_info().ok()?.output_color_type().0.samples() >= 3);
    }
    let mut decoder = JpegDecoder::new(ZCursor::new(&bytes));
    decoder.decode_headers().ok()?;
    Some(decoder.info()?.components >= 3)
}

fn undecodable(e: impl fmt::Display) -> Why {
    (ImageFault::Undecodable, format!("cannot decode: {e}"))
}

/// Checks the size before anything is decoded, so that a wrong header cannot ask for more memory than the camera's.
fn check_size(width: usize, height: usize, out: &Image) -> Result<(), Why> {
    if (width, height) == (out.width, out.height) {
        return Ok(());
    }
    let what = format!("is {width}x{height}, the calibration says {}x{}", out.width, out.height);
    Err((ImageFault::WrongSize, what))
}

/// Refuses a palette that the decoder does not look at before it takes colours from it: more than 256, parts of one, or fewer
/// colours than transparencies.
fn check_palette(info: &png::Info) -> Result<(), Why> {
    let bytes = |chunk: &Option<std::borrow::Cow<[u8]>>| chunk.as_ref().map_or(0, |c| c.len());
    let (palette, transparencies) = (bytes(&info.palette), bytes(&info.trns));
    let is_sound = palette % 3 == 0 && palette <= 3 * 256 && transparencies <= palette / 3;
    match info.color_type == png::ColorType::Indexed && !is_sound {
        true => Err(undecodable("its palette is broken")),
        false => Ok(()),
    }
}

fn read_png(bytes: &[u8], decoded: &mut Vec<u8>, out: &mut Image, colour: Option<&mut Colour>) -> Result<(), Why> {
    let mut decoder = png::Decoder::new(Cursor::new(bytes));
    decoder.set_transformations(png::Transformations::EXPAND | png::Transformations::STRIP_16);
    let mut reader = decoder.read_info().map_err(undecodable)?;
    check_size(reader.info().width as usize, reader.info().height as usize, out)?;
    check_palette(reader.info())?;
    let channels = reader.output_color_type().0.samples();
    if channels == 1 {
        reader.next_frame(&mut out.pixels).map_err(undecodable)?;
    } else {
        decoded.resize(out.pixels.len() * channels, 0);
        reader.next_frame(decoded).map_err(undecodable)?;
        for (grey, px) in out.pixels.iter_mut().zip(decoded.chunks_exact(channels)) {
            *grey = if channels < 3 { px[0] } else { luma(px[0], px[1], px[2]) };
        }
    }
    if let Some(planes) = colour {
        for (c, plane) in planes.iter_mut().enumerate() {
            if channels < 3 {
                plane.copy_from(out);
            } else {
                let of_channel = decoded.chunks_exact(channels).map(|px| px[c]);
                plane.pixels.iter_mut().zip(of_channel).for_each(|(to, from)| *to = from);
            }
        }
    }
    reader.finish().map_err(undecodable)
}

/// A decoder to the colour space `space`, whose headers are read and checked.
fn jpeg_decoder<'a>(bytes: &'a [u8], space: ColorSpace, out: &Image) -> Result<JpegDecoder<ZCursor<&'a [u8]>>, Why> {
    check_whole(bytes).map_err(undecodable)?;
    let options = DecoderOptions::default().set_strict_mode(true).jpeg_set_out_colorspace(space);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(undecodable)?;
    let (width, height) = decoder.dimensions().ok_or_else(|| undecodable("no size"))?;
    check_size(width, height, out)?;
    Ok(decoder)
}

fn read_jpeg(bytes: &[u8], out: &mut Image) -> Result<(), Why> {
    jpeg_decoder(bytes, ColorSpace::Luma, out)?.decode_into(&mut out.pixels).map_err(undecodable)
}

/// Reads a JPEG in colour; the grey is the file's own luma, as it is without colour.
fn read_jpeg_colour(bytes: &[u8], decoded: &mut Vec<u8>, out: &mut Image, colour: &mut Colour) -> Result<(), Why> {
    let mut decoder = jpeg_decoder(bytes, ColorSpace::YCbCr, out)?;
    if decoder.info().is_some_and(|i| i.components < 3) {
        read_jpeg(bytes, out)?;
        colour.iter_mut().for_each(|plane| plane.copy_from(out));
        return Ok(());
    }
    decoded.resize(3 * out.pixels.len(), 0);
    decoder.decode_into(decoded).map_err(undecodable)?;
    let [red, green, blue] = colour;
    for (i, px) in decoded.chunks_exact(3).enumerate() {
        out.pixels[i] = px[0];
        [red.pixels[i], green.pixels[i], blue.pixels[i]] = Matrix::JFIF.rgb(px[0], px[1], px[2]);
    }
    Ok(())
}
