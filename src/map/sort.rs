//! Radix sort and prefix sum on the GPU: stable, deterministic, the element count stays on the device.
//!
//! A pass is count, scan, scatter (`shaders-glsl/sort`): least significant digit first, no look-back between
//! workgroups, no subgroup operations. The number of workgroups is fixed at boot and each walks its share,
//! so nothing is sized by a count that only the device knows; groups without keys return at once.

use crate::gpu::kernels::{radix_count, radix_scatter, scan_apply, scan_reduce};
use crate::gpu::{Buf, Gpu, Kernel, Recorder, Threads};
use crate::mem::Footprint;
use stipple_drivers::Fault;

/// Words of the digit table: digits x workgroups, however they are split.
const TABLE_LEN: usize = 1 << 18;
/// A CPU runs few big workgroups best, and a wide digit saves it whole passes over memory.
const CPU: (u32, u32) = (11, 16);
/// A GPU hides latency with many workgroups, and 2 KiB of shared memory let many be resident.
const GPU: (u32, u32) = (8, 1024);
/// Most blocks of a scan: their sums are scanned by one workgroup.
const SCAN_BLOCKS_MAX: u32 = 256;
const SCAN_BLOCKS_CPU: u32 = 16;

const _: () = assert!((CPU.1 << CPU.0) as usize <= TABLE_LEN && (GPU.1 << GPU.0) as usize <= TABLE_LEN);

/// Exclusive prefix sum in place, modulo 2^32.
pub struct Scan {
    reduce: Kernel<scan_reduce::K>,
    apply: Kernel<scan_apply::K>,
    sums: Buf<u32>,
    /// Stands in for the count where the length is the buffer's.
    unlimited: Buf<u32>,
    blocks: u32,
}

impl Scan {
    pub fn footprint() -> Footprint {
        let mut f = Footprint::default();
        f.gpu("scan: block sums", (SCAN_BLOCKS_MAX as usize + 1) * size_of::<u32>());
        f
    }

    pub fn new(gpu: &mut Gpu) -> Result<Scan, Fault> {
        let scan = Scan {
            reduce: gpu.kernel::<scan_reduce::K>(scan_reduce::Spec::default())?,
            apply: gpu.kernel::<scan_apply::K>(scan_apply::Spec::default())?,
            sums: gpu.alloc("scan: block sums", SCAN_BLOCKS_MAX as usize)?,
            unlimited: gpu.alloc("scan: unlimited", 1)?,
            blocks: if is_cpu(gpu) { SCAN_BLOCKS_CPU } else { SCAN_BLOCKS_MAX },
        };
        gpu.upload(scan.unlimited, 0, &[u32::MAX]).map_err(Fault::from)?;
        Ok(scan)
    }

    /// Scans the whole buffer.
    pub fn record(&self, rec: &mut Recorder, data: Buf<u32>) {
        self.record_counted(rec, data, self.unlimited);
    }

    /// Scans `data[..count[0]]`, or all of it when the count is more.
    pub fn record_counted(&self, rec: &mut Recorder, data: Buf<u32>, count: Buf<u32>) {
        let (capacity, blocks) = (data.len() as u32, self.blocks);
        let threads = Threads::groups(blocks, 1, 1);
        let sums = scan_reduce::Bind { data: data.read(), count: count.read(), sums: self.sums.write() };
        rec.dispatch(&self.reduce, sums, scan_reduce::Push { capacity, blocks }, threads);
        let scanned = scan_apply::Bind { data: data.read_write(), count: count.read(), sums: self.sums.read() };
        rec.dispatch(&self.apply, scanned, scan_apply::Push { capacity, blocks }, threads);
    }
}

/// Sorts up to `capacity` (key, payload) pairs by the low bits of the key.
pub struct Sorter {
    count: Kernel<radix_count::K>,
    scatter: Kernel<radix_scatter::K>,
    scan: Scan,
    spare: Pairs,
    table: Buf<u32>,
    table_len: Buf<u32>,
    digit_bits: u32,
    groups: u32,
}

/// Keys and payloads, index by index.
#[derive(Clone, Copy)]
pub struct Pairs {
    pub keys: Buf<u32>,
    pub payload: Buf<u32>,
}

impl Sorter {
    pub fn footprint(capacity: usize) -> Footprint {
        let mut f = Scan::footprint();
        f.gpu("sort: spare pairs", 2 * capacity * size_of::<u32>());
        f.gpu("sort: digit table", (TABLE_LEN + 1) * size_of::<u32>());
        f
    }

    pub fn new(gpu: &mut Gpu, capacity: usize) -> Result<Sorter, Fault> {
        let (digit_bits, groups) = if is_cpu(gpu) { CPU } else { GPU };
        Ok(Sorter {
            count: gpu.kernel::<radix_count::K>(radix_count::Spec { digits_max: 1 << digit_bits })?,
            scatter: gpu.kernel::<radix_scatter::K>(radix_scatter::Spec { digits_max: 1 << digit_bits })?,
            scan: Scan::new(gpu)?,
            spare: Pairs {
                keys: gpu.alloc("sort: spare keys", capacity)?,
                payload: gpu.alloc("sort: spare payload", capacity)?,
            },
            table: gpu.alloc("sort: digit table", TABLE_LEN)?,
            table_len: gpu.alloc("sort: digit table length", 1)?,
            digit_bits,
            groups,
        })
    }

    /// Sorts the first `count[0]` pairs by the low `bits` of their keys, and answers where they are then: in
    /// `pairs` after an even number of passes, else in the sorter's own buffers until its next use. Bits of
    /// the key above `bits` travel along and are not compared. More than the capacity is not looked at.
    pub fn record(&self, rec: &mut Recorder, pairs: Pairs, count: Buf<u32>, bits: u32) -> Pairs {
        let passes = bits.div_ceil(self.digit_bits);
        let (mut from, mut to) = (pairs, self.spare);
        for pass in 0..passes {
            let (shift, end) = (bits * pass / passes, bits * (pass + 1) / passes);
            self.pass(rec, from, to, count, shift, 1 << (end - shift));
            (from, to) = (to, from);
        }
        from
    }

    fn pass(&self, rec: &mut Recorder, from: Pairs, to: Pairs, count: Buf<u32>, shift: u32, digits: u32) {
        let capacity = from.keys.len().min(from.payload.len()).min(to.keys.len()) as u32;
        let groups_max = self.groups;
        let seen = radix_count::Bind {
            keys: from.keys.read(),
            count: count.read(),
            table: self.table.write(),
            table_len: self.table_len.write(),
        };
        let push = radix_count::Push { capacity, groups_max, shift, digits };
        rec.dispatch(&self.count, seen, push, Threads::groups(groups_max, 1, 1));
        self.scan.record_counted(rec, self.table, self.table_len);
        let moved = radix_scatter::Bind {
            keys_in: from.keys.read(),
            payload_in: from.payload.read(),
            count: count.read(),
            table: self.table.read(),
            keys_out: to.keys.write(),
            payload_out: to.payload.write(),
        };
        let push = radix_scatter::Push { capacity, groups_max, shift, digits };
        rec.dispatch(&self.scatter, moved, push, Threads::groups(groups_max, 1, 1));
    }
}

fn is_cpu(gpu: &Gpu) -> bool {
    gpu.caps().kind == crate::gpu::DeviceKind::Cpu
}
