//! The pool of Gaussians and the stored images, from the host's side: what goes in and what comes out. Slots in use
//! have no gaps (see `blocks` for how they are closed); the pool never grows.

use super::pipeline::Pipeline;
use crate::gpu::kernels::types::Splat;
use crate::gpu::{Gpu, GpuError};
use std::borrow::Borrow;

/// A Gaussian as the host sees it.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Gaussian {
    /// World, m.
    pub mean: [f32; 3],
    /// ln m
    pub log_scale: [f32; 3],
    /// world_from_splat
    pub quat_xyzw: [f32; 4],
    pub opacity_logit: f32,
    /// Red, green and blue, linear 0..1; grey three times.
    pub colour: [f32; 3],
}

impl Gaussian {
    fn packed(&self) -> Splat {
        let ([x, y, z], [a, b, c]) = (self.mean, self.log_scale);
        Splat {
            mean_opacity: [x, y, z, self.opacity_logit],
            scale_colour: [a, b, c, self.colour[0]],
            quat: self.quat_xyzw,
        }
    }

    fn unpacked(s: &Splat, [green, blue]: [f32; 2]) -> Gaussian {
        let ([x, y, z, opacity_logit], [a, b, c, first]) = (s.mean_opacity, s.scale_colour);
        let colour = [first, green, blue];
        Gaussian { mean: [x, y, z], log_scale: [a, b, c], quat_xyzw: s.quat, opacity_logit, colour }
    }
}

/// Gaussians that travel to the GPU at a time.
pub(super) const APPENDED_AT_ONCE: usize = 4096;

/// What `prune` removes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PruneRule {
    pub opacity_min: f64,
    pub scale_max_m: f64,
    /// Less important ones go, of those that have had `steps_min` steps.
    pub importance_min: f32,
    pub steps_min: u32,
}

impl Default for PruneRule {
    fn default() -> Self {
        PruneRule { opacity_min: 0.005, scale_max_m: 5.0, importance_min: 0.0, steps_min: 0 }
    }
}

impl Pipeline {
    /// Gaussians alive.
    pub fn count(&self) -> usize {
        self.high_water as usize
    }

    /// Stores the image that keyframe `slot` is trained on: a plane for each channel, row-major, stride = width.
    pub fn set_keyframe(&mut self, gpu: &mut Gpu, slot: u32, planes: &[u8]) -> Result<(), GpuError> {
        let channels = self.shape.channels as usize;
        assert_eq!(planes.len(), channels * self.shape.pixels(), "images are of the shape the pipeline was made with");
        let mut planes = planes.chunks_exact(self.shape.pixels()).enumerate();
        planes.try_for_each(|(channel, plane)| self.set_plane(gpu, slot, channel, plane))
    }

    /// One channel of it.
    pub fn set_plane(&mut self, gpu: &mut Gpu, slot: u32, channel: usize, plane: &[u8]) -> Result<(), GpuError> {
        self.pack(plane);
        let at = (slot as usize * self.shape.channels as usize + channel) * self.shape.image_words();
        gpu.upload(self.b.targets, at, &self.words)
    }

    /// Pixels that count, of every keyframe of the first camera: zero is ignored.
    pub fn set_mask(&mut self, gpu: &mut Gpu, mask: &[u8]) -> Result<(), GpuError> {
        self.set_mask_of(gpu, 0, mask)
    }

    pub fn set_mask_of(&mut self, gpu: &mut Gpu, camera: usize, mask: &[u8]) -> Result<(), GpuError> {
        self.valid_pixels[camera] = mask.iter().filter(|m| **m != 0).count() as u32;
        self.pack(mask);
        gpu.upload(self.b.mask, camera * self.shape.mask_stride(), &self.words)
    }

    fn pack(&mut self, image: &[u8]) {
        assert_eq!(image.len(), self.shape.pixels(), "images are of the shape the pipeline was made with");
        self.words.clear();
        for row in image.chunks_exact(self.shape.width as usize) {
            self.words.extend(row.chunks(4).map(|c| {
                let mut b = [0; 4];
                b[..c.len()].copy_from_slice(c);
                u32::from_le_bytes(b)
            }));
        }
    }

    /// Takes Gaussians into the newest block until the pool is full; how many. Those without a rotation are left out:
    /// nothing would ever be drawn of them.
    pub fn append(
        &mut self,
        gpu: &mut Gpu,
        splats: impl IntoIterator<Item = impl Borrow<Gaussian>>,
    ) -> Result<usize, GpuError> {
        let mut splats = splats.into_iter().map(|s| *s.borrow()).filter(|s| s.quat_xyzw != [0.0; 4]).peekable();
        let before = self.count();
        while splats.peek().is_some() && self.high_water < self.shape.splats {
            let at = self.count();
            self.pool.clear();
            self.chroma.clear();
            let room = APPENDED_AT_ONCE.min(self.shape.splats as usize - at);
            for s in splats.by_ref().take(room) {
                self.pool.push(s.packed());
                self.chroma.push([s.colour[1], s.colour[2]]);
            }
            let n = self.pool.len();
            gpu.upload(self.b.splats, at, &self.pool)?;
            let mut rec = gpu.record();
            rec.fill(self.b.moments.part(at, n), 0);
            rec.fill(self.b.steps.part(at, n), 0);
            if self.shape.channels == 3 {
                gpu.upload(self.b.chroma, at, &self.chroma)?;
                rec.fill(self.b.chroma_moments.part(at, n), 0);
            }
            gpu.submit(rec)?;
            self.high_water += n as u32;
        }
        Ok(self.count() - before)
    }

    /// Empties the pool.
    pub fn clear(&mut self) {
        self.high_water = 0;
        self.blocks.clear();
    }

    /// The Gaussians alive, in slot order. Allocates.
    pub fn download(&mut self, gpu: &mut Gpu) -> Result<Vec<Gaussian>, GpuError> {
        let mut splats = vec![Splat::default(); self.count()];
        gpu.download(self.b.splats, 0, &mut splats)?;
        let mut chroma: Vec<[f32; 2]> = splats.iter().map(|s| [s.scale_colour[3]; 2]).collect();
        if self.shape.channels == 3 {
            gpu.download(self.b.chroma, 0, &mut chroma)?;
        }
        Ok(splats.iter().zip(chroma).map(|(s, c)| Gaussian::unpacked(s, c)).collect())
    }
}
