//! The Gaussians on the device: a pool of fixed size that never grows, in blocks.
//!
//! The Gaussians of one anchor lie together, blocks lie in the order of their anchors, and there are no gaps. New
//! Gaussians go to the end, so only the newest block grows; what is removed leaves a gap that is closed at once by moving
//! everything behind it down. That keeps a rigid correction of an anchor one sequential pass over its block. Closing gaps
//! costs two copies of the pool (200 k: 60 MB) and is rare: at keyframes only. Who leaves a full pool is read off a
//! histogram of importance; nothing is sorted. Whole blocks come and go by `paging`.

use super::scan::Scan;
use super::shape::Shape;
use crate::gpu::kernels::types::{Moments, Splat};
use crate::gpu::kernels::{importance, move_block, prune, repack};
use crate::gpu::{Arena, Buf, Gpu, GpuError, Kernel, Recorder, Threads};
use std::borrow::Borrow;
use std::ops::Range;
use stipple_drivers::{Fault, Pose};

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

    pub(super) fn unpacked(s: &Splat, [green, blue]: [f32; 2]) -> Gaussian {
        let ([x, y, z, opacity_logit], [a, b, c, first]) = (s.mean_opacity, s.scale_colour);
        let colour = [first, green, blue];
        Gaussian { mean: [x, y, z], log_scale: [a, b, c], quat_xyzw: s.quat, opacity_logit, colour }
    }

    /// From 0 to 1.
    pub fn opacity(&self) -> f32 {
        1.0 / (1.0 + (-self.opacity_logit).exp())
    }

    /// How much of the scene it covers: opacity times the product of its two largest deviations, m².
    pub fn importance(&self) -> f32 {
        let [a, b, c] = self.log_scale;
        self.opacity() * (a + b + c - a.min(b).min(c)).exp()
    }
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

/// A block's Gaussians begin here and end where the next block begins.
#[derive(Clone, Copy, Debug)]
pub(super) struct Block {
    pub number: u32,
    pub epoch: u32,
    pub first: u32,
}

/// Bins of importance.comp: quarter octaves from 2^-63.
const BINS: usize = 256;
/// The bits of the lowest bin, and the step from one to the next.
const LOWEST: u32 = 0x2000_0000;
const QUARTER_OCTAVE: u32 = 1 << 21;
/// Gaussians that travel to the GPU at a time.
const APPENDED_AT_ONCE: usize = 4096;
/// A block's seeds take one in so many of the free places, so that there is always room for the next.
pub const FREE_DIVISOR: usize = 8;
/// Blocks in the pool at once.
pub const BLOCKS: usize = 4096;

/// How many Gaussians have which importance.
pub type Bins = [u32; BINS];

/// Lower end of a bin.
pub fn importance_of_bin(bin: usize) -> f32 {
    if bin == 0 {
        0.0
    } else {
        f32::from_bits(LOWEST + bin as u32 * QUARTER_OCTAVE)
    }
}

/// The importance below which about `wanted` are found, and how many those are: never more than `most`.
pub fn threshold(bins: &Bins, wanted: usize, most: usize) -> (f32, usize) {
    let (mut below, mut at) = (0, 0);
    for (bin, n) in bins.iter().enumerate() {
        if below >= wanted || below + *n as usize > most {
            break;
        }
        below += *n as usize;
        at = bin + 1;
    }
    if below == 0 {
        return (0.0, 0);
    }
    (importance_of_bin(at), below)
}

#[derive(Clone, Copy)]
pub struct Buffers {
    pub splats: Buf<Splat>,
    pub moments: Buf<Moments>,
    /// How many steps a Gaussian has had, and its importance: importance.glsl.
    pub steps: Buf<u32>,
    /// Green and blue, and their moments; one element of a grey map.
    pub chroma: Buf<[f32; 2]>,
    pub chroma_moments: Buf<[f32; 4]>,
    pub(super) kept: Buf<u32>,
    bins: Buf<u32>,
}

impl Buffers {
    pub fn new(arena: &mut Arena, shape: &Shape) -> Result<Buffers, Fault> {
        let n = shape.splats as usize;
        Ok(Buffers {
            splats: arena.alloc("splats: parameters", n)?,
            moments: arena.alloc("splats: Adam moments", n)?,
            steps: arena.alloc("splats: Adam steps and importance", n)?,
            chroma: arena.alloc("splats: green and blue", shape.in_colour(n))?,
            chroma_moments: arena.alloc("splats: Adam moments of green and blue", shape.in_colour(n))?,
            kept: arena.alloc("splats: kept, then their prefix sum", n + 1)?,
            bins: arena.alloc("splats: how many of which importance", BINS)?,
        })
    }
}

/// Host memory of the pool: its blocks, and what is on its way to and from the device.
pub struct Transfers {
    pub(super) blocks: Vec<Block>,
    pub(super) splats: Vec<Splat>,
    pub(super) chroma: Vec<[f32; 2]>,
    pub(super) kept: Vec<u32>,
}

impl Transfers {
    pub fn new(shape: &Shape) -> Transfers {
        Transfers {
            blocks: Vec::with_capacity(BLOCKS),
            splats: Vec::with_capacity(APPENDED_AT_ONCE),
            chroma: Vec::with_capacity(APPENDED_AT_ONCE),
            kept: Vec::with_capacity(shape.splats as usize + 1),
        }
    }
}

pub struct Pool {
    pub buffers: Buffers,
    capacity: u32,
    pub(super) colour: bool,
    pub(super) count: u32,
    pub(super) host: Transfers,
    /// Memory that no step under way uses, to close gaps in.
    scratch: Buf<u32>,
    scan: Scan,
    prune: Kernel<prune::K>,
    repack: Kernel<repack::K>,
    importance: Kernel<importance::K>,
    move_block: Kernel<move_block::K>,
}

impl Pool {
    /// An empty one. `scratch` lives for one step.
    pub fn new(gpu: &mut Gpu, buffers: Buffers, scratch: Buf<u32>, scan: Scan, shape: &Shape) -> Result<Pool, Fault> {
        Ok(Pool {
            buffers,
            capacity: shape.splats,
            colour: shape.channels == 3,
            count: 0,
            host: Transfers::new(shape),
            scratch,
            scan,
            prune: gpu.kernel(prune::Spec::default())?,
            repack: gpu.kernel(repack::Spec::default())?,
            importance: gpu.kernel(importance::Spec::default())?,
            move_block: gpu.kernel(move_block::Spec::default())?,
        })
    }

    /// Gaussians alive: slots below this are in use.
    pub fn count(&self) -> u32 {
        self.count
    }

    /// Gaussians that still fit.
    pub fn room(&self) -> usize {
        (self.capacity - self.count) as usize
    }

    pub fn capacity(&self) -> usize {
        self.capacity as usize
    }

    /// What is appended from now on belongs to block `number`, of an epoch that is none before the newest's. False, and
    /// nothing done, where there are as many blocks as there may be.
    pub fn open_block(&mut self, number: u32, epoch: u32) -> bool {
        let blocks = &mut self.host.blocks;
        let fits = blocks.len() < BLOCKS;
        if fits {
            blocks.push(Block { number, epoch, first: self.count });
        }
        fits
    }

    /// The number of the block that what is appended belongs to.
    pub fn newest(&self) -> Option<u32> {
        self.host.blocks.last().map(|b| b.number)
    }

    /// The slots of an epoch's Gaussians: all of them where no block was opened.
    pub fn slots(&self, epoch: u32) -> Range<u32> {
        let blocks = &self.host.blocks;
        let begin = |i: usize| blocks.get(i).map_or(self.count, |b| b.first);
        let (before, upto) =
            (blocks.partition_point(|b| b.epoch < epoch), blocks.partition_point(|b| b.epoch <= epoch));
        (if before == 0 { 0 } else { begin(before) })..begin(upto)
    }

    /// Makes one map of the Gaussians of two epochs; false where those of another are between them.
    pub fn join(&mut self, from: u32, into: u32) -> bool {
        let between = from.min(into) + 1..from.max(into);
        let blocks = &mut self.host.blocks;
        let may = !blocks.iter().any(|b| between.contains(&b.epoch));
        blocks.iter_mut().filter(|b| may && b.epoch == from).for_each(|b| b.epoch = into);
        may
    }

    /// The slots of the blocks whose numbers are wanted; blocks that lie together have one range.
    pub fn slots_of<'a>(&'a self, wanted: impl Fn(u32) -> bool + 'a) -> impl Iterator<Item = Range<u32>> + 'a {
        let blocks = &self.host.blocks;
        let begin = |i: usize| blocks.get(i).map_or(self.count, |b| b.first);
        let mut at = 0;
        std::iter::from_fn(move || {
            let first = at + blocks[at..].iter().position(|b| wanted(b.number))?;
            let others = blocks[first..].iter().position(|b| !wanted(b.number));
            at = others.map_or(blocks.len(), |n| first + n);
            Some(begin(first)..begin(at))
        })
    }

    /// The newest epoch, and the slots of its Gaussians.
    pub fn newest_epoch(&self) -> (u32, Range<u32>) {
        let epoch = self.host.blocks.last().map_or(0, |b| b.epoch);
        (epoch, self.slots(epoch))
    }

    /// The slots of a block's Gaussians; empty where it is not here.
    pub fn block(&self, number: u32) -> Range<u32> {
        let blocks = &self.host.blocks;
        match blocks.iter().position(|b| b.number == number) {
            Some(i) => blocks[i].first..blocks.get(i + 1).map_or(self.count, |next| next.first),
            None => 0..0,
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
        let (before, b) = (self.count, self.buffers);
        while splats.peek().is_some() && self.room() > 0 {
            let at = self.count as usize;
            let Transfers { splats: packed, chroma, .. } = &mut self.host;
            packed.clear();
            chroma.clear();
            for s in splats.by_ref().take(APPENDED_AT_ONCE.min(self.capacity as usize - at)) {
                packed.push(s.packed());
                chroma.push([s.colour[1], s.colour[2]]);
            }
            let n = packed.len();
            gpu.upload(b.splats, at, packed)?;
            let mut rec = gpu.record();
            rec.fill(b.moments.part(at, n), 0);
            rec.fill(b.steps.part(at, n), 0);
            if self.colour {
                gpu.upload(b.chroma, at, chroma)?;
                rec.fill(b.chroma_moments.part(at, n), 0);
            }
            gpu.submit(rec)?;
            self.count += n as u32;
        }
        Ok((self.count - before) as usize)
    }

    /// Empties the pool.
    #[cfg(feature = "instruments")]
    pub fn clear(&mut self) {
        self.count = 0;
        self.host.blocks.clear();
    }

    /// The Gaussians alive, in slot order. Allocates.
    pub fn download(&self, gpu: &mut Gpu) -> Result<Vec<Gaussian>, GpuError> {
        let mut splats = vec![Splat::default(); self.count as usize];
        gpu.download(self.buffers.splats, 0, &mut splats)?;
        let mut chroma: Vec<[f32; 2]> = splats.iter().map(|s| [s.scale_colour[3]; 2]).collect();
        if self.colour {
            gpu.download(self.buffers.chroma, 0, &mut chroma)?;
        }
        Ok(splats.iter().zip(chroma).map(|(s, c)| Gaussian::unpacked(s, c)).collect())
    }

    /// Removes Gaussians that are faint, huge, not finite or unimportant and closes the gaps; how many.
    pub fn prune(&mut self, gpu: &mut Gpu, rule: &PruneRule) -> Result<usize, GpuError> {
        let (n, b) = (self.count, self.buffers);
        let mut rec = gpu.record();
        let bind = prune::Bind { splats: b.splats.read(), steps: b.steps.read(), kept: b.kept.write() };
        let push = prune::Push {
            splats: n,
            opacity_logit_min: (rule.opacity_min / (1.0 - rule.opacity_min)).ln() as f32,
            log_scale_max: rule.scale_max_m.ln() as f32,
            importance_min: rule.importance_min,
            steps_min: rule.steps_min,
        };
        rec.dispatch(&self.prune, bind, push, Threads::d1(n + 1));
        self.scan.record(&mut rec, b.kept.part(0, n as usize + 1));
        gpu.submit(rec)?;
        let kept = &mut self.host.kept;
        kept.resize(n as usize + 1, 0);
        gpu.download(b.kept, 0, kept)?;
        self.close_gaps(gpu)
    }

    /// Moves those that stay down to where `kept`, on the host and on the device, says; answers how many have gone.
    pub(super) fn close_gaps(&mut self, gpu: &mut Gpu) -> Result<usize, GpuError> {
        let (n, b, kept) = (self.count, self.buffers, &self.host.kept);
        let Some(first) = (0..n).find(|slot| kept[*slot as usize + 1] == *slot) else { return Ok(0) };
        for block in &mut self.host.blocks {
            block.first = kept[block.first as usize];
        }
        let left = kept[n as usize];
        let mut rec = gpu.record();
        // Every array over the pool that outlives a step.
        self.record_repack(&mut rec, first, b.splats);
        self.record_repack(&mut rec, first, b.moments);
        self.record_repack(&mut rec, first, b.steps);
        if self.colour {
            self.record_repack(&mut rec, first, b.chroma);
            self.record_repack(&mut rec, first, b.chroma_moments);
        }
        gpu.submit(rec)?;
        self.count = left;
        Ok((n - left) as usize)
    }

    /// Sets the kept slots from `first` on down to where `kept` says, as many at once as the scratch holds.
    fn record_repack<T: Copy>(&self, rec: &mut Recorder, first: u32, array: Buf<T>) {
        let stride = (size_of::<T>() / size_of::<u32>()) as u32;
        let at_once = (self.scratch.len() as u32 / stride).max(1);
        for first in (first..self.count).step_by(at_once as usize) {
            let count = at_once.min(self.count - first);
            for lift in [1, 0] {
                let bind = repack::Bind {
                    kept_offsets: self.buffers.kept.read(),
                    words: array.cast().read_write(),
                    scratch: self.scratch.read_write(),
                };
                let push = repack::Push { first, count, stride, lift };
                rec.dispatch(&self.repack, bind, push, Threads::d1(count * stride));
            }
        }
    }

    /// Counts those that have had `steps_min` steps by their importance.
    pub fn importance(&self, gpu: &mut Gpu, steps_min: u32) -> Result<Bins, GpuError> {
        let b = &self.buffers;
        let mut rec = gpu.record();
        rec.fill(b.bins, 0);
        let bind = importance::Bind { steps: b.steps.read(), bins: b.bins.read_write() };
        let push = importance::Push { splats: self.count, steps_min };
        rec.dispatch(&self.importance, bind, push, Threads::d1(self.count));
        gpu.submit(rec)?;
        let mut bins = [0; BINS];
        gpu.download(b.bins, 0, &mut bins)?;
        Ok(bins)
    }

    /// Moves each block's Gaussians: x' = by x, as many blocks in a submission as it has room for.
    pub fn move_blocks(&self, gpu: &mut Gpu, moves: impl Iterator<Item = (u32, Pose)>) -> Result<(), GpuError> {
        let b = &self.buffers;
        let mut rec = gpu.record();
        for (number, by) in moves {
            if rec.room() == 0 {
                gpu.submit(rec)?;
                rec = gpu.record();
            }
            let slots = self.block(number);
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
            let bind = move_block::Bind { splats: b.splats.read_write(), moments_in_out: b.moments.read_write() };
            rec.dispatch(&self.move_block, bind, push, Threads::d1(push.count));
        }
        gpu.submit(rec)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn threshold_takes_enough_and_never_too_many() {
        let mut bins = [0; BINS];
        (bins[10], bins[20], bins[30]) = (5, 5, 100);
        let (least, n) = threshold(&bins, 7, 50);
        assert_eq!(n, 10);
        assert!(least > importance_of_bin(20) && least <= importance_of_bin(30));
        assert_eq!(threshold(&bins, 5, 50).1, 5);
        // The next bin would take more than is allowed.
        assert_eq!(threshold(&bins, 60, 50).1, 10);
        assert_eq!(threshold(&bins, 3, 4), (0.0, 0));
        assert_eq!(threshold(&[0; BINS], 3, 4), (0.0, 0));
    }
}
