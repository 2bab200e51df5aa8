//! Prefix sum on the GPU: two dispatches, sized by the device, not by a count.

use crate::gpu::kernels::{scan_apply, scan_reduce};
use crate::gpu::{Arena, Buf, DeviceKind, Gpu, Kernel, Recorder, Threads};
use stipple_drivers::Fault;

/// Most blocks of a scan: their sums are scanned by one workgroup.
const BLOCKS_MAX: u32 = 256;
const BLOCKS_CPU: u32 = 16;
/// Elements that a lane scans at a time. Few spread a short list over more workgroups; many take fewer barriers.
const ITEMS_GPU: u32 = 4;
const ITEMS_CPU: u32 = 16;

/// What scans work in: the sums of blocks.
#[derive(Clone, Copy)]
pub struct Buffers {
    sums: Buf<u32>,
}

impl Buffers {
    pub fn new(arena: &mut Arena) -> Result<Buffers, Fault> {
        Ok(Buffers { sums: arena.alloc("scan: block sums", BLOCKS_MAX as usize)? })
    }
}

/// Exclusive prefix sum in place, modulo 2^32.
#[derive(Clone, Copy)]
pub struct Scan {
    reduce: Kernel<scan_reduce::K>,
    apply: Kernel<scan_apply::K>,
    sums: Buf<u32>,
    blocks: u32,
}

impl Scan {
    pub fn new(gpu: &mut Gpu, buffers: &Buffers) -> Result<Scan, Fault> {
        let (blocks, items) = match gpu.caps().kind {
            DeviceKind::Cpu => (BLOCKS_CPU, ITEMS_CPU),
            _ => (BLOCKS_MAX, ITEMS_GPU),
        };
        Ok(Scan {
            reduce: gpu.kernel(scan_reduce::Spec { items })?,
            apply: gpu.kernel(scan_apply::Spec { items })?,
            sums: buffers.sums,
            blocks,
        })
    }

    /// Scans the whole buffer.
    pub fn record(&self, rec: &mut Recorder, data: Buf<u32>) {
        let (n, blocks) = (data.len() as u32, self.blocks);
        let threads = Threads::groups(blocks, 1, 1);
        let sums = scan_reduce::Bind { data: data.read(), sums: self.sums.write() };
        rec.dispatch(&self.reduce, sums, scan_reduce::Push { n, blocks }, threads);
        let scanned = scan_apply::Bind { data: data.read_write(), sums: self.sums.read() };
        rec.dispatch(&self.apply, scanned, scan_apply::Push { n, blocks }, threads);
    }
}
