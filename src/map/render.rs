//! From Gaussians to a picture: who is visible, in which tiles, front to back, and their blend.
//!
//! ```text
//! project -> lists -> raster_forward                                                              Gaussians -> picture
//! ```
//!
//! Counts stay on the GPU: a dispatch over Gaussians is sized by those alive, never by the pool's capacity; those over intersections
//! walk them (3D Gaussian splatting: Kerbl et al. 2023).

use super::lists::{self, Lists};
use super::pool::Pool;
use super::shape::{Scratch, Shape};
use super::tiling::Tiling;
use super::view::View;
use crate::gpu::kernels::types::Projected;
use crate::gpu::kernels::{project, raster_forward};
use crate::gpu::{Arena, Buf, Gpu, Kernel, Recorder, Threads};
use stipple_drivers::Fault;

#[derive(Clone, Copy)]
pub struct Buffers {
    pub projected: Buf<Projected>,
    /// Planes of colour, transmittance and depth.
    pub rendered: Buf<f32>,
    lists: lists::Buffers,
}

impl Buffers {
    pub fn new(arena: &mut Arena, shape: &Shape) -> Result<Buffers, Fault> {
        Ok(Buffers {
            projected: arena.alloc("splats: projected", shape.splats as usize)?,
            lists: lists::Buffers::new(arena, shape)?,
            rendered: arena
                .alloc("pixels: colour, transmittance, depth", (shape.channels as usize + 2) * shape.pixels())?,
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
    pub projected: Buf<Projected>,
    pub rendered: Buf<f32>,
    pub lists: Lists,
    pub tiling: Tiling,
    /// By lens.
    project: [Kernel<project::K>; 2],
    fisheye: bool,
    /// Without depth, and with it.
    raster: [Kernel<raster_forward::K>; 2],
}

impl Renderer {
    pub fn new(
        gpu: &mut Gpu,
        Buffers { projected, rendered, lists }: Buffers,
        scratch: Scratch,
        shape: &Shape,
        tiling: Tiling,
    ) -> Result<Renderer, Fault> {
        let Tiling { lanes, column, variant, chunk, .. } = tiling;
        let raster = |gpu: &mut Gpu, depth| {
            gpu.kernel_variant(raster_forward::Spec { lanes, column, depth, channels: shape.channels }, variant)
        };
        let project = |gpu: &mut Gpu, fisheye| gpu.kernel_in_pieces(project::Spec { lanes, column, fisheye, chunk });
        Ok(Renderer {
            projected,
            rendered,
            lists: Lists::new(gpu, lists, &scratch, shape)?,
            tiling,
            project: shape.by_lens(|fisheye| project(gpu, fisheye))?,
            fisheye: shape.fisheye,
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
        assert!(self.fisheye || view.fisheye.is_none(), "views are of the lenses that the map was made with");
        let (lists, slots, size) = (&self.lists.buffers, pool.slots(view.epoch), view.size());
        let tiles = self.tiles(view);
        self.lists.record_start(rec);
        rec.dispatch(
            &self.project[view.lens()],
            project::Bind {
                splats: pool.buffers.splats.read(),
                projected_out: self.projected.write(),
                runs: lists.runs.write(),
                tile_depths: self.lists.tile_depths.write(),
                owners: lists.owners.write(),
                tile_lengths: lists.lengths.read_write(),
                counts_out: lists.counts.read_write(),
            },
            project::Push {
                camera: view.words(),
                size,
                first: slots.start,
                splats: slots.end,
                capacity: self.lists.capacity,
                coarseness: view.coarseness.level(),
            },
            Threads::d1(slots.end),
        );
        self.lists.record(rec, tiles);
        rec.dispatch(
            &self.raster[usize::from(depth)],
            raster_forward::Bind {
                ranges: lists.ranges.read(),
                intersections: lists.lists.read(),
                owners: lists.owners.read(),
                projected_in: self.projected.read(),
                chroma: pool.buffers.chroma.read(),
                rendered: self.rendered.write(),
            },
            raster_forward::Push { size },
            Threads::d1(tiles * self.tiling.lanes),
        );
    }
}
