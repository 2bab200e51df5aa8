//! Radix sort and prefix sum on the GPU: stable, deterministic, the element count stays on the device.
//!
//! A pass is count and scatter (`shaders-glsl/sort`): least significant digit first, no look-back between
//! workgroups, no subgroup operations. The number of workgroups is fixed at boot and each walks its share,
//! so nothing is sized by a count that only the device knows; groups without keys return at once. The first
//! pass also leaves out what is not to be sorted, which compacts a list for nothing.

use crate::gpu::kernels::{radix_count, radix_scatter, scan_apply, scan_reduce};
use crate::gpu::{Arena, Buf, Caps, DeviceKind, Gpu, Kernel, Recorder, Threads};
use stipple_drivers::Fault;

/// How a pass is cut.
#[derive(Clone, Copy, Debug)]
pub struct Cut {
    digit_bits: u32,
    groups: u32,
    keys_min: u32,
    /// Invocations of a scatter workgroup, which are the keys it ranks at a time.
    lanes: u32,
}

/// A CPU reads memory dear. Every group reads the whole table, so there are few (at most this many, two a core), and a
/// wide digit saves whole passes.
pub const CPU: Cut = Cut { digit_bits: 11, groups: 32, keys_min: 1024, lanes: 32 };
/// A GPU hides latency with many workgroups. 8 KiB of shared memory let many be resident.
pub const GPU: Cut = Cut { digit_bits: 8, groups: 256, keys_min: 1024, lanes: 256 };
/// Words of the digit table: digits x workgroups.
const TABLE_LEN: usize = 1 << 16;
/// Most blocks of a scan: their sums are scanned by one workgroup.
const SCAN_BLOCKS_MAX: u32 = 256;
const SCAN_BLOCKS_CPU: u32 = 16;
/// A key that the first pass leaves out.
#[cfg(feature = "instruments")]
pub const NONE: u32 = u32::MAX;

const _: () = assert!((CPU.groups << CPU.digit_bits) as usize <= TABLE_LEN);
const _: () = assert!((GPU.groups << GPU.digit_bits) as usize <= TABLE_LEN);

impl Cut {
    pub fn of(caps: &Caps) -> Cut {
        let cores = std::thread::available_parallelism().map_or(1, |n| n.get() as u32);
        match caps.kind {
            DeviceKind::Cpu => Cut { groups: (2 * cores).min(CPU.groups), ..CPU },
            _ => GPU,
        }
    }
}

/// What sorts and scans work in.
#[derive(Clone, Copy)]
pub struct Buffers {
    table: Buf<u32>,
    sums: Buf<u32>,
    unlimited: Buf<u32>,
}

impl Buffers {
    pub fn new(arena: &mut Arena) -> Result<Buffers, Fault> {
        Ok(Buffers {
            table: arena.alloc("sort: digit table", TABLE_LEN)?,
            sums: arena.alloc("scan: block sums", SCAN_BLOCKS_MAX as usize)?,
            unlimited: arena.alloc("sort: unlimited", 1)?,
        })
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
        Ok(Scan {
            reduce: gpu.kernel(scan_reduce::Spec::default())?,
            apply: gpu.kernel(scan_apply::Spec::default())?,
            sums: buffers.sums,
            blocks: if gpu.caps().kind == DeviceKind::Cpu { SCAN_BLOCKS_CPU } else { SCAN_BLOCKS_MAX },
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

/// Sorts (key, payload) pairs by the low bits of the key.
pub struct Sorter {
    count: Kernel<radix_count::K>,
    scatter: Kernel<radix_scatter::K>,
    table: Buf<u32>,
    /// Stands in for a count where all keys of a buffer are sorted.
    pub unlimited: Buf<u32>,
    cut: Cut,
}

/// Keys and payloads, index by index.
#[derive(Clone, Copy)]
pub struct Pairs {
    pub keys: Buf<u32>,
    pub payload: Buf<u32>,
}

impl Sorter {
    /// The result does not depend on the cut.
    pub fn new(gpu: &mut Gpu, buffers: &Buffers, cut: Cut) -> Result<Sorter, Fault> {
        let digits_max = 1 << cut.digit_bits;
        let Buffers { table, unlimited, .. } = *buffers;
        gpu.upload(unlimited, 0, &[u32::MAX])?;
        Ok(Sorter {
            count: gpu.kernel(radix_count::Spec { digits_max })?,
            scatter: gpu.kernel(radix_scatter::Spec { digits_max, lanes: cut.lanes })?,
            table,
            unlimited,
            cut,
        })
    }

    pub fn passes(&self, bits: u32) -> u32 {
        bits.div_ceil(self.cut.digit_bits)
    }

    /// Sorts the keys `from.keys[..count[0]]` that are not `NONE` by their low `bits`; the payload of a key is its
    /// index. Answers where they are then: in `to` after an odd number of passes, else in `from`, whose contents are
    /// lost either way. How many were sorted goes to `sorted`. More than the capacity is not looked at.
    pub fn record(
        &self,
        rec: &mut Recorder,
        (from, to): (Pairs, Pairs),
        count: Buf<u32>,
        sorted: Buf<u32>,
        bits: u32,
    ) -> Pairs {
        let passes = self.passes(bits);
        let (mut from, mut to) = (from, to);
        for pass in 0..passes {
            let (shift, end) = (bits * pass / passes, bits * (pass + 1) / passes);
            let counted = if pass == 0 { count } else { sorted };
            let push = radix_count::Push {
                capacity: from.keys.len().min(from.payload.len()).min(to.keys.len()) as u32,
                groups_max: self.cut.groups,
                keys_min: self.cut.keys_min,
                round: self.cut.lanes,
                shift,
                digits: 1 << (end - shift),
                first: u32::from(pass == 0),
            };
            self.pass(rec, from, to, counted, sorted, push);
            (from, to) = (to, from);
        }
        from
    }

    fn pass(
        &self,
        rec: &mut Recorder,
        from: Pairs,
        to: Pairs,
        count: Buf<u32>,
        sorted: Buf<u32>,
        push: radix_count::Push,
    ) {
        let threads = Threads::groups(self.cut.groups, 1, 1);
        let seen = radix_count::Bind { keys: from.keys.read(), count: count.read(), table: self.table.write() };
        rec.dispatch(&self.count, seen, push, threads);
        let moved = radix_scatter::Bind {
            keys_in: from.keys.read(),
            payload_in: from.payload.read(),
            count: count.read(),
            table: self.table.read(),
            keys_out: to.keys.write(),
            payload_out: to.payload.write(),
            sorted_count: sorted.write(),
        };
        rec.dispatch(&self.scatter, moved, bytemuck::cast(push), threads);
    }
}
