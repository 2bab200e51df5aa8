//! The pool of Gaussians and the stored images, from the host's side: what goes in, what comes out, which
//! slots are free. The pool never grows; a freed slot is taken again first.

use super::buffers::ARRIVALS;
use super::pipeline::Pipeline;
use crate::gpu::kernels::types::Splat;
use crate::gpu::kernels::{insert, prune};
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
    /// Grey, linear 0..1.
    pub colour: f32,
}

/// What `prune` removes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PruneRule {
    pub opacity_min: f64,
    pub scale_max_m: f64,
}

impl Default for PruneRule {
    fn default() -> Self {
        PruneRule { opacity_min: 0.005, scale_max_m: 5.0 }
    }
}

impl Pipeline {
    /// Gaussians alive.
    pub fn count(&self) -> usize {
        self.high_water as usize - self.free.len()
    }

    /// Stores the image that keyframe `slot` is trained on, row-major, stride = width.
    pub fn set_keyframe(&mut self, gpu: &mut Gpu, slot: u32, grey: &[u8]) -> Result<(), GpuError> {
        self.pack(grey);
        gpu.upload(self.b.targets, slot as usize * self.shape.image_words(), &self.words)
    }

    /// Pixels that count, of every keyframe: zero is ignored.
    pub fn set_mask(&mut self, gpu: &mut Gpu, mask: &[u8]) -> Result<(), GpuError> {
        self.valid_pixels = mask.iter().filter(|m| **m != 0).count() as u32;
        self.pack(mask);
        gpu.upload(self.b.mask, 0, &self.words)
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

    /// Takes Gaussians until the pool is full; how many. Those without a rotation are left out: a slot whose
    /// quaternion is zero is free.
    pub fn append(&mut self, gpu: &mut Gpu, arrivals: &[SplatInit]) -> Result<usize, GpuError> {
        let room = self.free.len() + (self.shape.splats - self.high_water) as usize;
        let before = self.count();
        for chunk in arrivals[..arrivals.len().min(room)].chunks(ARRIVALS) {
            self.words.clear();
            self.pool.clear();
            for s in chunk.iter().filter(|s| s.quat_xyzw != [0.0; 4]) {
                self.pool.push(packed(s));
                self.words.push(self.free.pop().unwrap_or_else(|| {
                    self.high_water += 1;
                    self.high_water - 1
                }));
            }
            gpu.upload(self.b.arrivals, 0, &self.pool)?;
            gpu.upload(self.b.arrival_slots, 0, &self.words)?;
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
            gpu.submit(rec)?;
        }
        Ok(self.count() - before)
    }

    /// Frees the slots of Gaussians that are faint, huge or not finite; how many.
    pub fn prune(&mut self, gpu: &mut Gpu, rule: &PruneRule) -> Result<usize, GpuError> {
        let n = self.high_water;
        let bind = prune::Bind { splats: self.b.splats.read_write(), freed: self.b.freed.write() };
        let push = prune::Push {
            splats: n,
            opacity_logit_min: (rule.opacity_min / (1.0 - rule.opacity_min)).ln() as f32,
            log_scale_max: rule.scale_max_m.ln() as f32,
        };
        let mut rec = gpu.record();
        rec.dispatch(&self.k.prune, bind, push, Threads::d1(n));
        gpu.submit(rec)?;
        self.words.clear();
        self.words.resize(n as usize, 0);
        gpu.download(self.b.freed, 0, &mut self.words)?;
        let before = self.free.len();
        self.free.extend((0..n).filter(|slot| self.words[*slot as usize] != 0));
        Ok(self.free.len() - before)
    }

    /// Empties the pool.
    pub fn clear(&mut self) {
        self.high_water = 0;
        self.free.clear();
    }

    /// The Gaussians alive, in slot order.
    pub fn download(&mut self, gpu: &mut Gpu, out: &mut Vec<SplatInit>) -> Result<(), GpuError> {
        self.pool.clear();
        self.pool.resize(self.high_water as usize, Splat::default());
        gpu.download(self.b.splats, 0, &mut self.pool)?;
        out.clear();
        out.extend(self.pool.iter().filter(|s| s.quat != [0.0; 4]).map(unpacked));
        Ok(())
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
