//! What each tile shows: lists of intersections, (Gaussian, tile) pairs, front to back.
//!
//! ```text
//! (project) -> tile_ranges -> fill_lists -> sort_lists                                             intersections -> lists
//! ```
//!
//! Each list is sorted by one workgroup, in shared memory unless it is long, so that nothing is sorted over the whole picture. Where
//! intersections do not fit, those of some Gaussians are missing, and counted: a picture is drawn again coarser, a step learns nothing.

use super::shape::{Scratch, Shape};
use crate::gpu::kernels::types::Counts;
use crate::gpu::kernels::{fill_lists, sort_lists, tile_ranges};
use crate::gpu::{Arena, Buf, Caps, DeviceKind, Gpu, Kernel, Recorder, Threads, ALIGN};
use stipple_drivers::Fault;

/// Invocations of a workgroup that sorts a list on a GPU. On a CPU they are a subgroup.
const SORT_LANES: u32 = 128;
/// Lists of more elements for each lane than this are sorted apart on a CPU, by LONG_LANES invocations each: Mesa's driver leaves a shader
/// after 65 535 rounds of its loops. That bounds the length of a list at some 57 000 there, as it does in the raster.
const LONG_A_LANE: u32 = 256;
const LONG_LANES: u32 = 256;
/// Fewest lanes of a subgroup of a CPU.
const LANES_LEAST: u32 = 4;

/// Workgroups that walk the intersections, whose count only the device knows: enough for a large GPU. (Some drivers of small GPUs run
/// indirect dispatches on the CPU.)
fn walkers(caps: &Caps) -> Threads {
    Threads::groups(if caps.kind == DeviceKind::Cpu { 64 } else { 1024 }, 1, 1)
}

#[derive(Clone, Copy)]
pub struct Buffers {
    /// What the picture counts, and the lengths of the tiles' lists.
    pub counts: Buf<Counts>,
    pub lengths: Buf<u32>,
    /// Both, to be zeroed at once.
    counted: Buf<u32>,
    /// Where the intersections of each Gaussian begin and end.
    pub runs: Buf<[u32; 2]>,
    /// Slot of each intersection.
    pub owners: Buf<u32>,
    /// Where the list of each tile begins and ends, and the intersections in it.
    pub ranges: Buf<[u32; 2]>,
    pub lists: Buf<u32>,
    /// Tiles whose lists are long.
    long_tiles: Buf<u32>,
}

/// Long lists that there may be where a list is sorted by so many lanes.
fn long_lists_most(shape: &Shape, lanes: u32) -> u32 {
    shape.intersections / (LONG_A_LANE * lanes) + 1
}

impl Buffers {
    pub fn new(arena: &mut Arena, shape: &Shape) -> Result<Buffers, Fault> {
        let (isects, tiles) = (shape.intersections as usize, shape.tiles_max());
        let words = ALIGN as usize / size_of::<u32>();
        let counted = arena.alloc::<u32>("counts, and lengths of the tiles' lists", words + tiles)?;
        Ok(Buffers {
            counts: counted.part(0, size_of::<Counts>() / size_of::<u32>()).cast(),
            lengths: counted.part(words, tiles),
            counted,
            runs: arena.alloc("splats: runs of intersections", shape.splats as usize)?,
            owners: arena.alloc("intersections: slots", isects)?,
            ranges: arena.alloc("tiles: ranges", tiles)?,
            lists: arena.alloc("intersections: by tile", isects)?,
            long_tiles: arena.alloc("tiles: of long lists", long_lists_most(shape, LANES_LEAST) as usize)?,
        })
    }
}

pub struct Lists {
    pub buffers: Buffers,
    /// Tile and depth of each intersection, from `project`; then elements of lists, and room to sort long ones.
    pub tile_depths: Buf<u32>,
    unsorted: Buf<[u32; 2]>,
    spare: Buf<[u32; 2]>,
    /// What kernels that walk the intersections are dispatched with. They ask how many workgroups there are, so they are made by
    /// `Gpu::kernel`, never in pieces.
    pub walkers: Threads,
    pub capacity: u32,
    /// Longer lists are sorted apart.
    up_to: u32,
    ranges: Kernel<tile_ranges::K>,
    fill: Kernel<fill_lists::K>,
    sort: Kernel<sort_lists::K>,
    /// On a CPU the same for long lists, and how many there may be.
    sort_long: Option<(Kernel<sort_lists::K>, u32)>,
}

impl Lists {
    pub fn new(gpu: &mut Gpu, buffers: Buffers, scratch: &Scratch, shape: &Shape) -> Result<Lists, Fault> {
        let (walkers, on_cpu) = (walkers(gpu.caps()), gpu.caps().kind == DeviceKind::Cpu);
        let lanes = if on_cpu { gpu.caps().subgroup_size } else { SORT_LANES };
        let subgroup_lanes = gpu.caps().subgroup_size;
        let long = sort_lists::Spec { lanes: LONG_LANES, long: true, subgroup_lanes };
        let most = long_lists_most(shape, lanes.max(LANES_LEAST));
        Ok(Lists {
            buffers,
            tile_depths: scratch.tile_depths,
            unsorted: scratch.unsorted,
            spare: scratch.spare,
            walkers,
            capacity: shape.intersections,
            ranges: gpu.kernel(tile_ranges::Spec::default())?,
            fill: gpu.kernel(fill_lists::Spec::default())?,
            up_to: if on_cpu { LONG_A_LANE * lanes.max(LANES_LEAST) } else { u32::MAX },
            sort: gpu.kernel_in_pieces(sort_lists::Spec { lanes, long: false, subgroup_lanes })?,
            sort_long: on_cpu.then(|| gpu.kernel(long).map(|k| (k, most))).transpose()?,
        })
    }

    /// Zeroes what a picture counts, before `project`.
    pub fn record_start(&self, rec: &mut Recorder) {
        rec.fill(self.buffers.counted, 0);
    }

    /// Makes the lists of a picture of so many tiles, after `project`.
    pub fn record(&self, rec: &mut Recorder, tiles: u32) {
        let (b, capacity, up_to) = (&self.buffers, self.capacity, self.up_to);
        let ranges = tile_ranges::Bind {
            tile_lengths: b.lengths.read(),
            ranges: b.ranges.write(),
            long_tiles: b.long_tiles.write(),
            counts_out: b.counts.read_write(),
        };
        rec.dispatch(&self.ranges, ranges, tile_ranges::Push { tiles, capacity, up_to }, Threads::d1(tiles));
        let fill = fill_lists::Bind {
            counts_in: b.counts.read(),
            tile_depths: self.tile_depths.read(),
            owners: b.owners.read(),
            ranges: b.ranges.read_write(),
            unsorted: self.unsorted.write(),
        };
        rec.dispatch(&self.fill, fill, (), self.walkers);
        let sort = sort_lists::Bind {
            counts_in: b.counts.read(),
            ranges: b.ranges.read(),
            long_tiles: b.long_tiles.read(),
            unsorted: self.unsorted.read(),
            spare: self.spare.read_write(),
            lists: b.lists.write(),
        };
        let push = sort_lists::Push { capacity, up_to };
        rec.dispatch(&self.sort, sort, push, Threads::groups(tiles, 1, 1));
        if let Some((long, most)) = self.sort_long {
            rec.dispatch(&long, sort, push, Threads::groups(most, 1, 1));
        }
    }
}
