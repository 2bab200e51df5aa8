//! From Gaussians to a picture: who is visible, in which tiles, front to back, and their blend.
//!
//! ```text
//! project -> sort by depth                                                        Gaussians -> visible, front to back
//! count_tiles -> scan -> emit_tiles -> sort by tile -> tile_ranges -> raster_forward         intersections -> picture
//! ```
//!
//! Counts stay on the GPU: a dispatch over Gaussians is sized by those alive, never by the pool's capacity, and ends early
//! past those visible; those over intersections walk them (3D Gaussian splatting: Kerbl et al. 2023).

use super::pool::Pool;
use super::shape::{Scratch, Shape};
use super::sort::{self, Cut, Scan, Sorter};
use super::tiling::Tiling;
use super::view::View;
use crate::gpu::kernels::types::Projected;
use crate::gpu::kernels::{count_tiles, emit_tiles, project, raster_forward, tile_ranges};
use crate::gpu::{Arena, Buf, Caps, DeviceKind, Gpu, Kernel, Recorder, Threads};
use stipple_drivers::Fault;

/// Bits of a depth key: depth_key.glsl.
const DEPTH_BITS: u32 = 16;

/// Workgroups that walk the intersections, whose count only the device knows: enough for a large GPU. (Some drivers of small GPUs run
/// indirect dispatches on the CPU.)
fn walkers(caps: &Caps) -> Threads {
    Threads::groups(if caps.kind == DeviceKind::Cpu { 64 } else { 1024 }, 1, 1)
}

#[derive(Clone, Copy)]
pub struct Buffers {
    pub projected: Buf<Projected>,
    /// Slots of the visible, by depth, and how many they are.
    pub ranked: Buf<u32>,
    pub visible_count: Buf<u32>,
    /// Tiles that each of the visible touches, then their prefix sum.
    pub tile_offsets: Buf<u32>,
    /// Intersections by tile; the slot of each; how many are listed, and are needed.
    pub isects: Buf<u32>,
    pub owners: Buf<u32>,
    pub isect_count: Buf<u32>,
    isects_sorted: Buf<u32>,
    pub ranges: Buf<[u32; 2]>,
    /// Planes of colour, transmittance and depth.
    pub rendered: Buf<f32>,
    /// Gaussians that are not finite.
    pub failed: Buf<u32>,
}

impl Buffers {
    pub fn new(arena: &mut Arena, shape: &Shape) -> Result<Buffers, Fault> {
        let (slots, isects) = (shape.splats as usize, shape.intersections as usize);
        Ok(Buffers {
            projected: arena.alloc("splats: projected", slots)?,
            ranked: arena.alloc("splats: visible slots by depth", slots + 1)?,
            visible_count: arena.alloc("counts: visible", 1)?,
            tile_offsets: arena.alloc("splats: tiles touched, then their prefix sum", slots + 1)?,
            isects: arena.alloc("intersections: by tile", isects)?,
            owners: arena.alloc("intersections: slots", isects)?,
            isect_count: arena.alloc("counts: intersections listed, needed", 2)?,
            isects_sorted: arena.alloc("counts: intersections sorted", 1)?,
            ranges: arena.alloc("tiles: ranges", shape.tiles_max() + 1)?,
            rendered: arena
                .alloc("pixels: colour, transmittance, depth", (shape.channels as usize + 2) * shape.pixels())?,
            failed: arena.alloc("counts: not finite", 1)?,
        })
    }
}

/// A picture of the map; sized by the view.
#[derive(Clone, Debug, Default)]
pub struct Rendered {
    pub width: usize,
    pub height: usize,
    /// Plane by plane: grey, or red, green and blue.
    pub colour: Vec<f32>,
    pub alpha: Vec<f32>,
    /// Expected depth, m; zero where nothing was hit.
    pub depth: Vec<f32>,
}

impl Rendered {
    /// A blank one.
    pub fn new(width: usize, height: usize, channels: usize) -> Rendered {
        let planes = |n: usize| vec![0.0; n * width * height];
        Rendered { width, height, colour: planes(channels), alpha: planes(1), depth: planes(1) }
    }
}

pub struct Renderer {
    pub buffers: Buffers,
    pub tiling: Tiling,
    scratch: Scratch,
    capacity: u32,
    /// What kernels that walk the intersections are dispatched with. They ask how many workgroups there are, so they are made by
    /// `Gpu::kernel`, never in pieces.
    pub walkers: Threads,
    scan: Scan,
    sorter: Sorter,
    /// By lens.
    project: [Kernel<project::K>; 2],
    fisheye: bool,
    count_tiles: Kernel<count_tiles::K>,
    emit_tiles: Kernel<emit_tiles::K>,
    tile_ranges: Kernel<tile_ranges::K>,
    /// Without depth, and with it.
    raster: [Kernel<raster_forward::K>; 2],
}

impl Renderer {
    pub fn new(
        gpu: &mut Gpu,
        buffers: Buffers,
        scratch: Scratch,
        sort: &sort::Buffers,
        shape: &Shape,
        tiling: Tiling,
    ) -> Result<Renderer, Fault> {
        let Tiling { lanes, column, variant, .. } = tiling;
        let cut = Cut::of(gpu.caps());
        let raster = |gpu: &mut Gpu, depth| {
            gpu.kernel_variant(raster_forward::Spec { lanes, column, depth, channels: shape.channels }, variant)
        };
        let project = |gpu: &mut Gpu, fisheye| gpu.kernel_in_pieces(project::Spec { lanes, column, fisheye });
        Ok(Renderer {
            buffers,
            tiling,
            scratch,
            capacity: shape.intersections,
            walkers: walkers(gpu.caps()),
            scan: Scan::new(gpu, sort)?,
            sorter: Sorter::new(gpu, sort, cut)?,
            project: shape.by_lens(|fisheye| project(gpu, fisheye))?,
            fisheye: shape.fisheye,
            count_tiles: gpu.kernel_in_pieces(count_tiles::Spec { lanes, column })?,
            emit_tiles: gpu.kernel_in_pieces(emit_tiles::Spec { lanes, column })?,
            tile_ranges: gpu.kernel(tile_ranges::Spec::default())?,
            raster: [raster(gpu, false)?, raster(gpu, true)?],
        })
    }

    /// Tiles of a view.
    pub fn tiles(&self, view: &View) -> u32 {
        let ([tw, th], [w, h]) = (self.tiling.tile(), view.size());
        w.div_ceil(tw) * h.div_ceil(th)
    }

    /// Draws the pool as `view` sees it.
    pub fn record(&self, rec: &mut Recorder, pool: &Pool, view: &View, depth: bool) {
        self.record_order(rec, pool, view);
        self.record_lists(rec, pool, view);
        let b = &self.buffers;
        rec.dispatch(
            &self.raster[usize::from(depth)],
            raster_forward::Bind {
                ranges: b.ranges.read(),
                intersections: b.isects.read(),
                owners: b.owners.read(),
                projected_in: b.projected.read(),
                chroma: pool.buffers.chroma.read(),
                rendered: b.rendered.write(),
            },
            raster_forward::Push { size: view.size() },
            Threads::d1(self.tiles(view) * self.tiling.lanes),
        );
    }

    /// The visible, front to back.
    fn record_order(&self, rec: &mut Recorder, pool: &Pool, view: &View) {
        assert!(self.fisheye || view.fisheye.is_none(), "views are of the lenses that the map was made with");
        let (b, slots, coarseness) = (&self.buffers, pool.slots(view.epoch), view.coarseness.level());
        let (first, n) = (slots.start, slots.end);
        rec.fill(b.failed, 0);
        rec.dispatch(
            &self.project[view.lens()],
            project::Bind {
                splats: pool.buffers.splats.read(),
                projected_out: b.projected.write(),
                keys: self.scratch.depth_keys.write(),
                failed: b.failed.read_write(),
            },
            project::Push { camera: view.words(), size: view.size(), first, splats: n, coarseness },
            Threads::d1(n + 1),
        );
        let keys = self.scratch.depth_keys.part(0, n as usize + 1);
        let pairs = self.scratch.pairs(keys, b.ranked, self.sorter.passes(DEPTH_BITS));
        self.sorter.record(rec, pairs, self.sorter.unlimited, b.visible_count, DEPTH_BITS);
    }

    /// What each tile shows, front to back.
    fn record_lists(&self, rec: &mut Recorder, pool: &Pool, view: &View) {
        let (b, n) = (&self.buffers, pool.slots(view.epoch).end);
        let (size, coarseness) = (view.size(), view.coarseness.level());
        let per_slot = Threads::d1(n + 1);
        rec.dispatch(
            &self.count_tiles,
            count_tiles::Bind {
                visible_count: b.visible_count.read(),
                slots: b.ranked.read(),
                projected_in: b.projected.read(),
                tile_counts: b.tile_offsets.write(),
            },
            count_tiles::Push { size, splats: n, coarseness },
            per_slot,
        );
        self.scan.record(rec, b.tile_offsets.part(0, n as usize + 1));
        rec.dispatch(
            &self.emit_tiles,
            emit_tiles::Bind {
                visible_count: b.visible_count.read(),
                slots: b.ranked.read(),
                projected_in: b.projected.read(),
                tile_offsets: b.tile_offsets.read(),
                keys: self.scratch.isect_keys.write(),
                owners: b.owners.write(),
                isect_count: b.isect_count.write(),
            },
            emit_tiles::Push { size, splats: n, capacity: self.capacity, coarseness },
            per_slot,
        );
        let tiles = self.tiles(view);
        let bits = u32::BITS - tiles.leading_zeros();
        let pairs = self.scratch.pairs(self.scratch.isect_keys, b.isects, self.sorter.passes(bits));
        let sorted = self.sorter.record(rec, pairs, b.isect_count.part(0, 1), b.isects_sorted, bits);
        rec.fill(b.ranges, 0);
        rec.dispatch(
            &self.tile_ranges,
            tile_ranges::Bind { isect_count: b.isect_count.read(), keys: sorted.keys.read(), ranges: b.ranges.write() },
            tile_ranges::Push { tiles: tiles + 1 },
            self.walkers,
        );
    }
}
