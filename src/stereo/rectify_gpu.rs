//! Rectification on the GPU that matches: raw pair in, rectified pair where the matcher reads it. The maps are those of
//! `rectify`, and so is the arithmetic: both give the same bytes.

use super::rectify::Remap;
use crate::gpu::kernels::rectify;
use crate::gpu::{Buf, Gpu, GpuError, Kernel, Recorder, Threads, ALIGN};
use crate::mem::Footprint;
use stipple_drivers::{Fault, Image};

pub struct Rectifier {
    kernel: Kernel<rectify::K>,
    raw: Buf<u32>,
    taps: Buf<[u32; 2]>,
    size: [u32; 2],
    /// Host side of the raw images.
    bytes: Vec<u8>,
}

/// Of one image, rows being whole words.
fn image_bytes(width: usize, height: usize) -> usize {
    width.next_multiple_of(4) * height
}

impl Rectifier {
    pub fn footprint(width: usize, height: usize) -> Footprint {
        let mut f = Footprint::default();
        f.gpu("stereo: raw pair", 2 * image_bytes(width, height) + ALIGN as usize);
        f.gpu("stereo: rectification maps on the GPU", 2 * width * height * size_of::<[u32; 2]>() + ALIGN as usize);
        f.host("stereo: raw pair", 2 * image_bytes(width, height));
        f
    }

    pub fn new(gpu: &mut Gpu, width: usize, height: usize, maps: &[Remap; 2]) -> Result<Rectifier, Fault> {
        let r = Rectifier {
            kernel: gpu.kernel_in_pieces(rectify::Spec::default())?,
            raw: gpu.alloc("stereo: raw pair", image_bytes(width, height) / 2)?,
            taps: gpu.alloc("stereo: rectification maps on the GPU", 2 * width * height)?,
            size: [width as u32, height as u32],
            bytes: vec![0; 2 * image_bytes(width, height)],
        };
        for (side, map) in maps.iter().enumerate() {
            gpu.upload(r.taps, side * width * height, &map.taps(width.next_multiple_of(4)))?;
        }
        Ok(r)
    }

    pub fn load(&mut self, gpu: &mut Gpu, left: &Image, right: &Image) -> Result<(), GpuError> {
        pack(left, right, &mut self.bytes);
        gpu.upload(self.raw.cast(), 0, &self.bytes)
    }

    /// Writes the rectified pair to `images`.
    pub fn record(&self, rec: &mut Recorder, images: Buf<u32>) {
        let bind = rectify::Bind { raw: self.raw.read(), taps: self.taps.read(), images: images.write() };
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
