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

/// Invocations that sort a list: on a GPU; on a CPU a subgroup, but for long ones.
const SORT_LANES: u32 = 128;
const SORT_LANES_LONG: u32 = 256;
/// Lists longer than this are sorted apart on a CPU, as Mesa's driver leaves a shader after 65 535 rounds of its loops; by so many
/// workgroups.
const LONG: u32 = 2048;
const LONG_GROUPS: u32 = 64;

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
        })
    }
}

pub struct Lists {
    pub buffers: Buffers,
    /// What kernels that walk the intersections are dispatched with. They ask how many workgroups there are, so they are made by
    /// `Gpu::kernel`, never in pieces.
    pub walkers: Threads,
    scratch: Scratch,
    pub capacity: u32,
    ranges: Kernel<tile_ranges::K>,
    fill: Kernel<fill_lists::K>,
    sort: Kernel<sort_lists::K>,
    /// The same for long lists, on a CPU.
    sort_long: Option<Kernel<sort_lists::K>>,
}

impl Lists {
    pub fn new(gpu: &mut Gpu, buffers: Buffers, scratch: Scratch, shape: &Shape) -> Result<Lists, Fault> {
        let (walkers, on_cpu) = (walkers(gpu.caps()), gpu.caps().kind == DeviceKind::Cpu);
        let lanes = if on_cpu { gpu.caps().subgroup_size } else { SORT_LANES };
        Ok(Lists {
            buffers,
            walkers,
            scratch,
            capacity: shape.intersections,
            ranges: gpu.kernel(tile_ranges::Spec::default())?,
            fill: gpu.kernel(fill_lists::Spec::default())?,
            sort: gpu.kernel(sort_lists::Spec { lanes, walk: false })?,
            sort_long: on_cpu
                .then(|| gpu.kernel(sort_lists::Spec { lanes: SORT_LANES_LONG, walk: true }))
                .transpose()?,
        })
    }

    /// Zeroes what a picture counts, before `project`.
    pub fn record_start(&self, rec: &mut Recorder) {
        rec.fill(self.buffers.counted, 0);
    }

    /// Makes the lists of a picture of so many tiles, after `project`.
    pub fn record(&self, rec: &mut Recorder, tiles: u32) {
        let (b, s, capacity) = (&self.buffers, &self.scratch, self.capacity);
        let ranges = tile_ranges::Bind {
            tile_lengths: b.lengths.read(),
            ranges: b.ranges.write(),
            counts_out: b.counts.read_write(),
        };
        rec.dispatch(&self.ranges, ranges, tile_ranges::Push { tiles, capacity }, Threads::d1(tiles));
        let fill = fill_lists::Bind {
            counts_in: b.counts.read(),
            tile_depths: s.tile_depths.read(),
            owners: b.owners.read(),
            ranges: b.ranges.read_write(),
            unsorted: s.unsorted.write(),
        };
        rec.dispatch(&self.fill, fill, (), self.walkers);
        let sort = sort_lists::Bind {
            counts_in: b.counts.read(),
            ranges: b.ranges.read(),
            unsorted: s.unsorted.read(),
            spare: s.spare.read_write(),
            lists: b.lists.write(),
        };
        let up_to = if self.sort_long.is_some() { LONG } else { u32::MAX };
        let push = sort_lists::Push { tiles, longer_than: 0, up_to, capacity };
        rec.dispatch(&self.sort, sort, push, Threads::groups(tiles, 1, 1));
        if let Some(long) = &self.sort_long {
            let push = sort_lists::Push { tiles, longer_than: LONG, up_to: u32::MAX, capacity };
            rec.dispatch(long, sort, push, Threads::groups(LONG_GROUPS, 1, 1));
        }
    }
}
