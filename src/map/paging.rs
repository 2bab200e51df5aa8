//! Whole blocks on their way between the pool and memory: read, removed, put back.
//!
//! A block in memory is its arrays one after another, in the order of `record`: what the Gaussians are, their Adam steps and
//! importance, green and blue of a map in colour, then, where they are kept, Adam's moments. A block that comes back as it
//! went trains on as if it had never been away, to the bit.

use super::pool::{Block, Pool, BLOCKS};
use crate::gpu::kernels::types::{Moments, Splat};
use crate::gpu::{Buf, Gpu, GpuError};

/// Bytes of a Gaussian in memory, of a map in colour or grey, with Adam's moments or without.
pub fn splat_bytes(colour: bool, moments: bool) -> usize {
    let grey = size_of::<Splat>() + size_of::<u32>() + usize::from(moments) * size_of::<Moments>();
    grey + usize::from(colour) * (size_of::<[f32; 2]>() + usize::from(moments) * size_of::<[f32; 4]>())
}

impl Pool {
    /// Whether a block is here.
    pub fn holds(&self, number: u32) -> bool {
        self.host.blocks.iter().any(|b| b.number == number)
    }

    /// Whether so many more blocks may be here.
    pub fn may_have(&self, more: usize) -> bool {
        self.host.blocks.len() + more <= BLOCKS
    }

    /// Numbers and sizes of the blocks here, in order.
    pub fn blocks(&self) -> impl Iterator<Item = (u32, u32)> + '_ {
        let ends = self.host.blocks.iter().skip(1).map(|b| b.first).chain(std::iter::once(self.count));
        self.host.blocks.iter().zip(ends).map(|(b, end)| (b.number, end - b.first))
    }

    /// Appends a block's arrays to `bytes`; how many Gaussians they are of.
    pub fn read_block(
        &mut self,
        gpu: &mut Gpu,
        number: u32,
        moments: bool,
        bytes: &mut Vec<u8>,
    ) -> Result<usize, GpuError> {
        self.read_blocks(gpu, std::iter::once(number), moments, bytes)
    }

    /// Appends the arrays of several blocks to `bytes`, block by block.
    pub fn read_blocks(
        &mut self,
        gpu: &mut Gpu,
        numbers: impl Iterator<Item = u32> + Clone,
        moments: bool,
        bytes: &mut Vec<u8>,
    ) -> Result<usize, GpuError> {
        let n = numbers.clone().map(|number| self.block(number).len()).sum::<usize>();
        let (start, size) = (bytes.len(), n * splat_bytes(self.colour, moments));
        bytes.resize(start + size, 0);
        let slots = numbers.map(|number| self.block(number));
        let arrays = slots.flat_map(|slots| self.arrays(slots.start as usize, slots.len(), moments));
        gpu.download_parts(arrays, &mut bytes[start..])?;
        Ok(n)
    }

    /// Puts a block that was read back, as the newest. False, and nothing done, where it does not fit, is here, is older than
    /// what is here, or `bytes` is not such a block.
    pub fn insert_block(
        &mut self,
        gpu: &mut Gpu,
        (number, epoch): (u32, u32),
        (count, moments): (usize, bool),
        bytes: &[u8],
    ) -> Result<bool, GpuError> {
        let blocks = &self.host.blocks;
        let fits = count <= self.room() && blocks.len() < BLOCKS && !self.holds(number);
        let last = blocks.last().map_or(0, |b| b.epoch);
        if !fits || epoch < last || bytes.len() != count * splat_bytes(self.colour, moments) {
            return Ok(false);
        }
        self.write_arrays(gpu, (self.count as usize, count), moments, bytes)?;
        self.host.blocks.push(Block { number, epoch, first: self.count });
        self.count += count as u32;
        Ok(true)
    }

    /// Writes the arrays of a block that is here, as many and of the same form as were read.
    pub fn write_block(&mut self, gpu: &mut Gpu, number: u32, moments: bool, bytes: &[u8]) -> Result<(), GpuError> {
        let slots = self.block(number);
        self.write_arrays(gpu, (slots.start as usize, slots.len()), moments, bytes)
    }

    fn write_arrays(
        &mut self,
        gpu: &mut Gpu,
        (first, count): (usize, usize),
        moments: bool,
        mut bytes: &[u8],
    ) -> Result<(), GpuError> {
        for part in self.arrays(first, count, moments) {
            let (of_it, rest) = bytes.split_at(part.len());
            bytes = rest;
            gpu.upload(part, 0, of_it)?;
        }
        if moments {
            return Ok(());
        }
        let (mut rec, b) = (gpu.record(), self.buffers);
        rec.fill(b.moments.part(first, count), 0);
        if self.colour {
            rec.fill(b.chroma_moments.part(first, count), 0);
        }
        gpu.submit(rec)
    }

    /// The bytes of some slots in each of the arrays that a block in memory has, in their order.
    fn arrays(&self, first: usize, n: usize, moments: bool) -> impl Iterator<Item = Buf<u8>> {
        let (b, colour) = (self.buffers, self.colour);
        let part = |is_there: bool, part: Buf<u8>| is_there.then_some(part);
        let of_one = [
            part(true, b.splats.part(first, n).cast()),
            part(true, b.steps.part(first, n).cast()),
            part(colour, b.chroma.part(first * usize::from(colour), n * usize::from(colour)).cast()),
            part(moments, b.moments.part(first, n).cast()),
            part(moments && colour, b.chroma_moments.part(first * usize::from(colour), n * usize::from(colour)).cast()),
        ];
        of_one.into_iter().flatten()
    }

    /// What of a block lies from a slot on becomes another one, behind it.
    pub fn cut_block(&mut self, number: u32, other: u32, first: u32) {
        if let Some(at) = self.host.blocks.iter().position(|b| b.number == number) {
            let block = Block { number: other, first, ..self.host.blocks[at] };
            self.host.blocks.insert(at + 1, block);
        }
    }

    /// Takes out the blocks that `goes` names; how many Gaussians.
    pub fn remove_blocks(&mut self, gpu: &mut Gpu, goes: impl Fn(u32) -> bool) -> Result<usize, GpuError> {
        let (n, b) = (self.count as usize, self.buffers);
        let super::pool::Transfers { blocks, kept, .. } = &mut self.host;
        if !blocks.iter().any(|block| goes(block.number)) {
            return Ok(0);
        }
        // Where each slot goes: the exclusive prefix sum of those that stay.
        kept.clear();
        let mut stay = 0;
        let before_all = blocks.first().map_or(n, |block| block.first as usize);
        kept.extend(0..before_all as u32);
        stay += before_all as u32;
        for (at, block) in blocks.iter().enumerate() {
            let end = blocks.get(at + 1).map_or(n, |next| next.first as usize);
            let by = u32::from(!goes(block.number));
            for _ in block.first as usize..end {
                kept.push(stay);
                stay += by;
            }
        }
        kept.push(stay);
        gpu.upload(b.kept, 0, kept)?;
        let gone = self.close_gaps(gpu)?;
        self.host.blocks.retain(|block| !goes(block.number));
        Ok(gone)
    }
}
