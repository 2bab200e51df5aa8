//! The pool of Gaussians and the stored images, from the host's side: what goes in and what comes out. Slots in use
//! have no gaps (see `blocks` for how they are closed); the pool never grows.

use super::buffers::ARRIVALS;
use super::pipeline::Pipeline;
use crate::gpu::kernels::insert;
use crate::gpu::kernels::types::Splat;
use crate::gpu::{Gpu, GpuError, Threads};

/// A Gaussian as the host sees it.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct SplatInit {
    /// World, m.
    pub mean: [f32; 3],
    /// ln m
    pub log_scale: [f32; 3],
    /// world_from_splat
    pub quat_xyzw: [f32; 4],
    pub opacity_logit: f32,
    /// Grey or red, linear 0..1.
    pub colour: f32,
}

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
    pub fn append(&mut self, gpu: &mut Gpu, arrivals: &[SplatInit]) -> Result<usize, GpuError> {
        self.append_tinted(gpu, arrivals, &[])
    }

    /// As `append`, with the green and blue of each; where there are none, colours are grey.
    pub fn append_tinted(
        &mut self,
        gpu: &mut Gpu,
        arrivals: &[SplatInit],
        tints: &[[f32; 2]],
    ) -> Result<usize, GpuError> {
        let room = (self.shape.splats - self.high_water) as usize;
        let before = self.count();
        for (i, chunk) in arrivals[..arrivals.len().min(room)].chunks(ARRIVALS).enumerate() {
            self.words.clear();
            self.pool.clear();
            for s in chunk.iter().filter(|s| s.quat_xyzw != [0.0; 4]) {
                self.pool.push(packed(s));
                self.words.push(self.high_water);
                self.high_water += 1;
            }
            gpu.upload(self.b.arrivals, 0, &self.pool)?;
            gpu.upload(self.b.arrival_slots, 0, &self.words)?;
            if let Some(h) = &mut self.harmonics {
                let of_chunk = tints.get(i * ARRIVALS..).unwrap_or_default();
                let tint = |(k, s): (usize, &SplatInit)| of_chunk.get(k).copied().unwrap_or([s.colour; 2]);
                let sound = chunk.iter().enumerate().filter(|(_, s)| s.quat_xyzw != [0.0; 4]);
                h.take_tints(gpu, sound.map(tint))?;
            }
            let b = &self.b;
            let bind = insert::Bind {
                arrivals: b.arrivals.read(),
                arrival_slots: b.arrival_slots.read(),
                splats: b.splats.write(),
                moments_out: b.moments.write(),
                steps: b.steps.write(),
            };
            let mut rec = gpu.record();
            let n = self.words.len() as u32;
            rec.dispatch(&self.k.insert, bind, insert::Push { arrivals: n }, Threads::d1(n));
            if let Some(h) = &self.harmonics {
                h.record_insert(&mut rec, b, n);
            }
            gpu.submit(rec)?;
        }
        Ok(self.count() - before)
    }

    /// Empties the pool.
    pub fn clear(&mut self) {
        self.high_water = 0;
        self.blocks.clear();
    }

    /// The Gaussians alive, in slot order.
    pub fn download(&mut self, gpu: &mut Gpu, out: &mut Vec<SplatInit>) -> Result<(), GpuError> {
        self.pool.clear();
        self.pool.resize(self.high_water as usize, Splat::default());
        gpu.download(self.b.splats, 0, &mut self.pool)?;
        out.clear();
        out.extend(self.pool.iter().map(unpacked));
        Ok(())
    }
}

impl Pipeline {
    /// Of the Gaussians that `download` gives, in its order: the coefficients of their colour beyond the first level.
    pub fn download_colours(&mut self, gpu: &mut Gpu, out: &mut Vec<f32>) -> Result<(), GpuError> {
        out.clear();
        let Some(h) = &self.harmonics else { return Ok(()) };
        out.resize(self.high_water as usize * self.shape.colour_extra(), 0.0);
        gpu.download(h.coefficients, 0, out)
    }
}

fn packed(s: &SplatInit) -> Splat {
    let ([x, y, z], [a, b, c]) = (s.mean, s.log_scale);
    Splat { mean_opacity: [x, y, z, s.opacity_logit], scale_colour: [a, b, c, s.colour], quat: s.quat_xyzw }
}

fn unpacked(s: &Splat) -> SplatInit {
    let ([x, y, z, opacity_logit], [a, b, c, colour]) = (s.mean_opacity, s.scale_colour);
    SplatInit { mean: [x, y, z], log_scale: [a, b, c], quat_xyzw: s.quat, opacity_logit, colour }
}
