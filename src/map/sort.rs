//! Radix sort and prefix sum on the GPU: stable, deterministic, the element count stays on the device.
//!
//! A pass is count and scatter (`shaders-glsl/sort`), least significant digit first, no subgroup operations. On a GPU
//! workgroups rank many keys at a time (`radix_*`), and every second pass is counted while the one before it scatters, which saves a
//! dispatch; on a CPU each invocation moves a share of the keys one by one (`share_*`), as barriers and shared memory are dear there.
//! The number of workgroups is fixed at boot and each walks its share, so nothing is sized by a count that only the device knows. The
//! first pass also leaves out what is not to be sorted, which compacts a list for nothing.

use crate::gpu::kernels::{radix_count, radix_scatter, scan_apply, scan_reduce, share_count, share_scatter};
use crate::gpu::{Arena, Buf, Caps, DeviceKind, Gpu, Kernel, Recorder, Threads};
use stipple_drivers::Fault;

/// How a pass is cut.
#[derive(Clone, Copy, Debug)]
pub struct Cut {
    digit_bits: u32,
    /// Workgroups at most.
    groups: u32,
    /// Whether each invocation sorts a share of the keys alone (`share_*`), as on a CPU; else workgroups rank keys together (`radix_*`).
    by_shares: bool,
}

/// Digits of 11 bits sort the tiles of 320x240 in one pass, with two workgroups, as the table has no room for more; passes of 8 bits
/// have up to 16, two a core.
pub const CPU: Cut = Cut { digit_bits: 11, groups: 32, by_shares: true };
/// A GPU hides latency with many workgroups. 11 KiB of shared memory let many be resident.
pub const GPU: Cut = Cut { digit_bits: 8, groups: 256, by_shares: false };
/// Fewest keys of a workgroup on a GPU.
const KEYS_MIN: u32 = 1024;
/// Words of a digit table, digits x workgroups; there is one of a pass and one of the next. By shares half of the first is the
/// table and half the places, and the second is not used.
const TABLE_LEN: usize = 1 << 16;
/// Most blocks of a scan: their sums are scanned by one workgroup.
const SCAN_BLOCKS_MAX: u32 = 256;
const SCAN_BLOCKS_CPU: u32 = 16;
/// Elements that a lane scans at a time. Few spread a short list over more workgroups; many take fewer barriers.
const SCAN_ITEMS_GPU: u32 = 4;
const SCAN_ITEMS_CPU: u32 = 16;
/// A key that the first pass leaves out.
#[cfg(feature = "instruments")]
pub const NONE: u32 = u32::MAX;

const _: () = assert!((share_count::LOCAL[0] << CPU.digit_bits) as usize <= TABLE_LEN / 2);
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
            table: arena.alloc("sort: digit tables", 2 * TABLE_LEN)?,
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
        let (blocks, items) = match gpu.caps().kind {
            DeviceKind::Cpu => (SCAN_BLOCKS_CPU, SCAN_ITEMS_CPU),
            _ => (SCAN_BLOCKS_MAX, SCAN_ITEMS_GPU),
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

/// Sorts (key, payload) pairs by the low bits of the key.
pub struct Sorter {
    kernels: Kernels,
    table: Buf<u32>,
    /// Stands in for a count where all keys of a buffer are sorted.
    pub unlimited: Buf<u32>,
    cut: Cut,
}

enum Kernels {
    Ranked(Kernel<radix_count::K>, Kernel<radix_scatter::K>),
    ByShares(Kernel<share_count::K>, Kernel<share_scatter::K>),
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
        let Buffers { table, unlimited, .. } = *buffers;
        gpu.upload(unlimited, 0, &[u32::MAX])?;
        let kernels = match cut.by_shares {
            true => Kernels::ByShares(
                gpu.kernel(share_count::Spec::default())?,
                gpu.kernel(share_scatter::Spec::default())?,
            ),
            false => {
                Kernels::Ranked(gpu.kernel(radix_count::Spec::default())?, gpu.kernel(radix_scatter::Spec::default())?)
            }
        };
        Ok(Sorter { kernels, table, unlimited, cut })
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
            let nth = |pass| (bits * pass / passes, bits * (pass + 1) / passes);
            let ((shift, end), (next_shift, next_end)) = (nth(pass), nth(pass + 1));
            let counted = if pass == 0 { count } else { sorted };
            let next_digits = if pass % 2 == 0 && pass + 1 < passes { 1 << (next_end - next_shift) } else { 0 };
            let pass = Pass { pass, shift, digits: 1 << (end - shift), next_shift, next_digits };
            match &self.kernels {
                Kernels::Ranked(count, scatter) => {
                    self.ranked(rec, (*count, *scatter), (from, to), (counted, sorted), pass);
                }
                Kernels::ByShares(count, scatter) => {
                    self.by_shares(rec, (*count, *scatter), (from, to), (counted, sorted), pass);
                }
            }
            (from, to) = (to, from);
        }
        from
    }

    fn ranked(
        &self,
        rec: &mut Recorder,
        (count_keys, scatter): (Kernel<radix_count::K>, Kernel<radix_scatter::K>),
        (from, to): (Pairs, Pairs),
        (count, sorted): (Buf<u32>, Buf<u32>),
        Pass { pass, shift, digits, next_shift, next_digits }: Pass,
    ) {
        let (groups_max, keys_min, first) = (self.cut.groups, KEYS_MIN, u32::from(pass == 0));
        let capacity = capacity(from, to);
        let push = radix_count::Push { capacity, groups_max, keys_min, shift, digits, first, next_shift, next_digits };
        let threads = Threads::groups(groups_max, 1, 1);
        let nth = |i: u32| self.table.part(i as usize % 2 * TABLE_LEN, TABLE_LEN);
        let (table, next_table) = (nth(pass), nth(pass + 1));
        if pass % 2 == 0 {
            let (keys, count, table) = (from.keys.read(), count.read(), table.write());
            let next_table = next_table.write();
            rec.dispatch(&count_keys, radix_count::Bind { keys, count, table, next_table }, push, threads);
        }
        let moved = radix_scatter::Bind {
            keys_in: from.keys.read(),
            payload_in: from.payload.read(),
            count: count.read(),
            table: table.read(),
            keys_out: to.keys.write(),
            payload_out: to.payload.write(),
            sorted_count: sorted.write(),
            next_table: next_table.read_write(),
        };
        rec.dispatch(&scatter, moved, bytemuck::cast(push), threads);
    }

    fn by_shares(
        &self,
        rec: &mut Recorder,
        (count_keys, scatter): (Kernel<share_count::K>, Kernel<share_scatter::K>),
        (from, to): (Pairs, Pairs),
        (count, sorted): (Buf<u32>, Buf<u32>),
        Pass { pass, shift, digits, .. }: Pass,
    ) {
        let first = u32::from(pass == 0);
        let [lanes, ..] = share_count::LOCAL;
        let half = TABLE_LEN / 2;
        let (table, places) = (self.table.part(0, half), self.table.part(half, half));
        let groups = self.cut.groups.min(half as u32 / (lanes * digits));
        let push = share_count::Push { capacity: capacity(from, to), shares: groups * lanes, shift, digits, first };
        let threads = Threads::groups(groups, 1, 1);
        let seen = share_count::Bind { keys: from.keys.read(), count: count.read(), table: table.read_write() };
        rec.dispatch(&count_keys, seen, push, threads);
        let moved = share_scatter::Bind {
            keys_in: from.keys.read(),
            payload_in: from.payload.read(),
            count: count.read(),
            table: table.read(),
            places: places.read_write(),
            keys_out: to.keys.write(),
            payload_out: to.payload.write(),
            sorted_count: sorted.write(),
        };
        rec.dispatch(&scatter, moved, bytemuck::cast(push), threads);
    }
}

/// Number of a pass, the bits of a key that it sorts by, and those of the next, if it counts for it.
#[derive(Clone, Copy)]
struct Pass {
    pass: u32,
    shift: u32,
    digits: u32,
    next_shift: u32,
    next_digits: u32,
}

/// Pairs that there is room for.
fn capacity(from: Pairs, to: Pairs) -> u32 {
    from.keys.len().min(from.payload.len()).min(to.keys.len()) as u32
}
