//! Rectification on the GPU that matches: raw pair in, rectified pair where the matcher reads it. The maps are those of
//! `rectify`, and so is the arithmetic: both give the same bytes.

use super::rectify::Remap;
use crate::gpu::kernels::rectify;
use crate::gpu::{Arena, Buf, Gpu, GpuError, Kernel, Recorder, Threads};
use stipple_drivers::{Fault, Image};

#[derive(Clone, Copy)]
pub struct Buffers {
    raw: Buf<u32>,
    taps: Buf<[u32; 2]>,
}

impl Buffers {
    pub fn new(arena: &mut Arena, width: usize, height: usize) -> Result<Buffers, Fault> {
        Ok(Buffers {
            raw: arena.alloc("stereo: raw pair", 2 * image_bytes(width, height) / size_of::<u32>())?,
            taps: arena.alloc("stereo: rectification maps on the GPU", 2 * width * height)?,
        })
    }
}

pub struct Rectifier {
    buffers: Buffers,
    kernel: Kernel<rectify::K>,
    size: [u32; 2],
    /// Host side of the raw images.
    bytes: Vec<u8>,
    /// Host side of a few rows of a map.
    taps: Vec<[u32; 2]>,
}

/// Rows of a map that are sent at once.
const ROWS: usize = 16;

/// Bytes of one image whose rows are whole words.
pub fn image_bytes(width: usize, height: usize) -> usize {
    width.next_multiple_of(4) * height
}

/// Room for a pair of images on its way to the GPU.
pub fn packed(width: usize, height: usize) -> Vec<u8> {
    vec![0; 2 * image_bytes(width, height)]
}

/// Room for rows of a map on their way to the GPU.
pub fn rows(width: usize) -> Vec<[u32; 2]> {
    Vec::with_capacity(ROWS * width)
}

impl Rectifier {
    pub fn new(
        gpu: &mut Gpu,
        buffers: Buffers,
        width: usize,
        height: usize,
        maps: &[Remap; 2],
    ) -> Result<Rectifier, Fault> {
        let mut rectifier = Rectifier {
            buffers,
            kernel: gpu.kernel_in_pieces(rectify::Spec::default())?,
            size: [width as u32, height as u32],
            bytes: packed(width, height),
            taps: rows(width),
        };
        rectifier.upload(gpu, maps)?;
        Ok(rectifier)
    }

    /// Puts other maps in the place of those it has.
    pub fn upload(&mut self, gpu: &mut Gpu, maps: &[Remap; 2]) -> Result<(), GpuError> {
        let width = self.size[0] as usize;
        let mut from = 0;
        for map in maps {
            let mut taps = map.taps(width.next_multiple_of(4)).peekable();
            while taps.peek().is_some() {
                self.taps.clear();
                self.taps.extend(taps.by_ref().take(ROWS * width));
                gpu.upload(self.buffers.taps, from, &self.taps)?;
                from += self.taps.len();
            }
        }
        Ok(())
    }

    pub fn load(&mut self, gpu: &mut Gpu, left: &Image, right: &Image) -> Result<(), GpuError> {
        pack(left, right, &mut self.bytes);
        gpu.upload(self.buffers.raw.cast(), 0, &self.bytes)
    }

    /// Writes the rectified pair to `images`.
    pub fn record(&self, rec: &mut Recorder, images: Buf<u32>) {
        let bind =
            rectify::Bind { raw: self.buffers.raw.read(), taps: self.buffers.taps.read(), images: images.write() };
        rec.dispatch(&self.kernel, bind, rectify::Push { size: self.size }, Threads::d1(images.len() as u32));
    }
}

/// Both images one after the other, their rows in whole words.
pub(super) fn pack(left: &Image, right: &Image, bytes: &mut [u8]) {
    let stride = left.width.next_multiple_of(4);
    let half = bytes.len() / 2;
    for (image, bytes) in [left, right].into_iter().zip(bytes.chunks_mut(half)) {
        for (from, to) in image.pixels.chunks(image.width).zip(bytes.chunks_mut(stride)) {
            to[..image.width].copy_from_slice(from);
        }
    }
}
