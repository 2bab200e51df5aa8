//! Whole blocks on their way between the pool and memory: read, removed, put back.
//!
//! A block in memory is its arrays one after another, in the order of `record`: what the Gaussians are, their Adam steps and
//! importance, green and blue of a map in colour, then, where they are kept, Adam's moments. A block that comes back as it
//! went trains on as if it had never been away, to the bit.

use super::pool::{Block, Pool, BLOCKS};
use crate::gpu::kernels::types::{Moments, Splat};
use crate::gpu::{Buf, Gpu, GpuError};
use bytemuck::Pod;

/// Bytes of a Gaussian in memory, of a map in colour or grey, with Adam's moments or without.
pub fn splat_bytes(colour: bool, moments: bool) -> usize {
    let grey = size_of::<Splat>() + size_of::<u32>() + usize::from(moments) * size_of::<Moments>();
    grey + usize::from(colour) * (size_of::<[f32; 2]>() + usize::from(moments) * size_of::<[f32; 4]>())
}

impl Pool {
    /// Whether an anchor has a block here.
    pub fn holds(&self, anchor: u32) -> bool {
        self.host.blocks.iter().any(|b| b.anchor == anchor)
    }

    /// Anchors and sizes of the blocks here, in order.
    pub fn blocks(&self) -> impl Iterator<Item = (u32, u32)> + '_ {
        let ends = self.host.blocks.iter().skip(1).map(|b| b.first).chain(std::iter::once(self.count));
        self.host.blocks.iter().zip(ends).map(|(b, end)| (b.anchor, end - b.first))
    }

    /// Appends a block's arrays to `bytes`; how many Gaussians they are of.
    pub fn read_block(
        &mut self,
        gpu: &mut Gpu,
        anchor: u32,
        moments: bool,
        bytes: &mut Vec<u8>,
    ) -> Result<usize, GpuError> {
        let (slots, b) = (self.block(anchor), self.buffers);
        let (first, n) = (slots.start as usize, slots.len());
        read(gpu, b.splats.part(first, n), bytes)?;
        read(gpu, b.steps.part(first, n), bytes)?;
        if self.colour {
            read(gpu, b.chroma.part(first, n), bytes)?;
        }
        if moments {
            read(gpu, b.moments.part(first, n), bytes)?;
            if self.colour {
                read(gpu, b.chroma_moments.part(first, n), bytes)?;
            }
        }
        Ok(n)
    }

    /// Puts a block that was read back, as the newest. False, and nothing done, where it does not fit, is here, is older than
    /// what is here, or `bytes` is not such a block.
    pub fn insert_block(
        &mut self,
        gpu: &mut Gpu,
        (anchor, epoch): (u32, u32),
        (count, moments): (usize, bool),
        mut bytes: &[u8],
    ) -> Result<bool, GpuError> {
        let blocks = &self.host.blocks;
        let fits = count <= self.room() && blocks.len() < BLOCKS && !self.holds(anchor);
        let last = blocks.last().map_or(0, |b| b.epoch);
        if !fits || epoch < last || bytes.len() != count * splat_bytes(self.colour, moments) {
            return Ok(false);
        }
        let (first, b) = (self.count as usize, self.buffers);
        write(gpu, b.splats.part(first, count), &mut bytes)?;
        write(gpu, b.steps.part(first, count), &mut bytes)?;
        if self.colour {
            write(gpu, b.chroma.part(first, count), &mut bytes)?;
        }
        if moments {
            write(gpu, b.moments.part(first, count), &mut bytes)?;
            if self.colour {
                write(gpu, b.chroma_moments.part(first, count), &mut bytes)?;
            }
        } else {
            let mut rec = gpu.record();
            rec.fill(b.moments.part(first, count), 0);
            if self.colour {
                rec.fill(b.chroma_moments.part(first, count), 0);
            }
            gpu.submit(rec)?;
        }
        self.host.blocks.push(Block { anchor, epoch, first: self.count });
        self.count += count as u32;
        Ok(true)
    }

    /// Takes out the blocks of the anchors that `goes` names; how many Gaussians.
    pub fn remove_blocks(&mut self, gpu: &mut Gpu, goes: impl Fn(u32) -> bool) -> Result<usize, GpuError> {
        let (n, b) = (self.count as usize, self.buffers);
        let super::pool::Transfers { blocks, kept, .. } = &mut self.host;
        if !blocks.iter().any(|block| goes(block.anchor)) {
            return Ok(0);
        }
        // Where each slot goes: the exclusive prefix sum of those that stay.
        kept.resize(n + 1, 0);
        let mut stay = 0;
        let mut at = 0;
        for slot in 0..n {
            while at + 1 < blocks.len() && blocks[at + 1].first as usize <= slot {
                at += 1;
            }
            kept[slot] = stay;
            let before_all = blocks.first().is_none_or(|block| slot < block.first as usize);
            stay += u32::from(before_all || !goes(blocks[at].anchor));
        }
        kept[n] = stay;
        gpu.upload(b.kept, 0, kept)?;
        let gone = self.close_gaps(gpu)?;
        self.host.blocks.retain(|block| !goes(block.anchor));
        Ok(gone)
    }
}

fn read<T: Pod>(gpu: &mut Gpu, from: Buf<T>, bytes: &mut Vec<u8>) -> Result<(), GpuError> {
    let start = bytes.len();
    bytes.resize(start + from.len() * size_of::<T>(), 0);
    gpu.download(from.cast::<u8>(), 0, &mut bytes[start..])
}

fn write<T: Pod>(gpu: &mut Gpu, to: Buf<T>, bytes: &mut &[u8]) -> Result<(), GpuError> {
    let (of_it, rest) = bytes.split_at(to.len() * size_of::<T>());
    *bytes = rest;
    gpu.upload(to.cast::<u8>(), 0, of_it)
}
