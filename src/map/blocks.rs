//! Blocks of the pool: the Gaussians of one anchor lie together, blocks lie in the order of their anchors, and there
//! are no gaps. New Gaussians go to the end, so only the newest block grows; what is removed leaves a gap that is
//! closed at once by moving everything behind it down. That keeps a rigid correction of an anchor one sequential pass
//! over its block. Closing gaps costs two copies of the pool (200 k: 60 MB) and is rare: at anchors only.

use super::buffers::IMPORTANCE_BINS;
use super::pipeline::{Pipeline, PruneRule};
use crate::gpu::kernels::{importance, move_block, prune, repack};
use crate::gpu::{Buf, Gpu, GpuError, Recorder, Threads};
use std::ops::Range;
use stipple_drivers::Pose;

/// An anchor's Gaussians begin here and end where the next block begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Block {
    pub anchor: u32,
    pub first: u32,
}

/// How many Gaussians have which importance: quarter octaves from 2^-63.
pub type Bins = [u32; IMPORTANCE_BINS];

/// The bits of the lowest bin of importance.comp, and the step from one to the next.
const LOWEST: u32 = 0x2000_0000;
const QUARTER_OCTAVE: u32 = 1 << 21;

/// Lower end of a bin.
pub fn importance_of_bin(bin: usize) -> f32 {
    if bin == 0 {
        0.0
    } else {
        f32::from_bits(LOWEST + bin as u32 * QUARTER_OCTAVE)
    }
}

impl Pipeline {
    /// What is appended from now on belongs to `anchor`.
    pub fn open_block(&mut self, anchor: u32) {
        if self.blocks.len() < self.blocks.capacity() {
            self.blocks.push(Block { anchor, first: self.high_water });
        }
    }

    /// The anchor that what is appended belongs to.
    pub fn newest(&self) -> Option<u32> {
        self.blocks.last().map(|b| b.anchor)
    }

    /// The slots of an anchor's Gaussians; empty where it has none.
    pub fn block(&self, anchor: u32) -> Range<u32> {
        match self.blocks.iter().position(|b| b.anchor == anchor) {
            Some(i) => self.blocks[i].first..self.blocks.get(i + 1).map_or(self.high_water, |next| next.first),
            None => 0..0,
        }
    }

    /// Removes Gaussians that are faint, huge, not finite or unimportant and closes the gaps; how many.
    pub fn prune(&mut self, gpu: &mut Gpu, rule: &PruneRule) -> Result<usize, GpuError> {
        let n = self.high_water;
        let mut rec = gpu.record();
        let b = &self.b;
        let bind = prune::Bind { splats: b.splats.read(), steps: b.steps.read(), kept: b.kept.write() };
        let push = prune::Push {
            splats: n,
            opacity_logit_min: (rule.opacity_min / (1.0 - rule.opacity_min)).ln() as f32,
            log_scale_max: rule.scale_max_m.ln() as f32,
            importance_min: rule.importance_min,
            steps_min: rule.steps_min,
        };
        rec.dispatch(&self.k.prune, bind, push, Threads::d1(n + 1));
        self.scan.record(&mut rec, b.kept.part(0, n as usize + 1));
        gpu.submit(rec)?;
        self.words.clear();
        self.words.resize(n as usize + 1, 0);
        gpu.download(b.kept, 0, &mut self.words)?;
        let Some(first) = (0..n).find(|slot| self.words[*slot as usize + 1] == *slot) else { return Ok(0) };
        let mut rec = gpu.record();
        // Every array over the pool that outlives a step.
        self.record_repack(&mut rec, first, self.b.splats);
        self.record_repack(&mut rec, first, self.b.moments);
        self.record_repack(&mut rec, first, self.b.steps);
        if self.shape.channels == 3 {
            self.record_repack(&mut rec, first, self.b.chroma);
            self.record_repack(&mut rec, first, self.b.chroma_moments);
        }
        gpu.submit(rec)?;
        for block in &mut self.blocks {
            block.first = self.words[block.first as usize];
        }
        self.high_water = self.words[n as usize];
        Ok((n - self.high_water) as usize)
    }

    /// Sets the kept slots from `first` on down to where `kept` says.
    fn record_repack<T>(&self, rec: &mut Recorder, first: u32, array: Buf<T>) {
        let b = &self.b;
        let stride = (size_of::<T>() / size_of::<u32>()) as u32;
        // Gradients of intersections live for one step.
        let scratch = b.over.isect_gradients.cast::<u32>();
        let at_once = (scratch.len() as u32 / stride).max(1);
        for first in (first..self.high_water).step_by(at_once as usize) {
            let count = at_once.min(self.high_water - first);
            for lift in [1, 0] {
                let bind = repack::Bind {
                    kept_offsets: b.kept.read(),
                    words: array.cast::<u32>().read_write(),
                    scratch: scratch.read_write(),
                };
                rec.dispatch(
                    &self.k.repack,
                    bind,
                    repack::Push { first, count, stride, lift },
                    Threads::d1(count * stride),
                );
            }
        }
    }

    /// Counts those that have had `steps_min` steps by their importance.
    pub fn importance(&mut self, gpu: &mut Gpu, steps_min: u32) -> Result<Bins, GpuError> {
        let b = &self.b;
        let mut rec = gpu.record();
        rec.fill(b.importance_bins, 0);
        let bind = importance::Bind { steps: b.steps.read(), bins: b.importance_bins.read_write() };
        let push = importance::Push { splats: self.high_water, steps_min };
        rec.dispatch(&self.k.importance, bind, push, Threads::d1(self.high_water));
        gpu.submit(rec)?;
        let mut bins = [0; IMPORTANCE_BINS];
        gpu.download(b.importance_bins, 0, &mut bins)?;
        Ok(bins)
    }

    /// Moves each anchor's Gaussians: x' = by x, as many anchors in a submission as it has room for.
    pub fn move_blocks(&mut self, gpu: &mut Gpu, moves: impl Iterator<Item = (u32, Pose)>) -> Result<(), GpuError> {
        let mut rec = gpu.record();
        for (anchor, by) in moves {
            if rec.room() == 0 {
                gpu.submit(rec)?;
                rec = gpu.record();
            }
            let slots = self.block(anchor);
            let (r, t) = (by.rotation().transpose(), by.p);
            let row = |i: usize| [r.col(i).x as f32, r.col(i).y as f32, r.col(i).z as f32, t[i] as f32];
            let push = move_block::Push {
                row0: row(0),
                row1: row(1),
                row2: row(2),
                quat: by.q.to_array().map(|v| v as f32),
                first: slots.start,
                count: slots.end - slots.start,
            };
            let bind =
                move_block::Bind { splats: self.b.splats.read_write(), moments_in_out: self.b.moments.read_write() };
            rec.dispatch(&self.k.move_block, bind, push, Threads::d1(push.count));
        }
        gpu.submit(rec)
    }
}
