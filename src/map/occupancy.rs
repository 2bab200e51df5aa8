//! Which cells of space hold Gaussians: a hash table of fixed size on the GPU, made anew of the pool for every anchor, so
//! that what was evicted, pruned or moved since holds nothing (a fill of 1 MB and one thread a Gaussian; the pool is
//! all there is to keep).
//!
//! A cell has two places and is found in either (`occupy.comp`). No probing: the table does not depend on the order of
//! threads, so a map can be repeated to the bit. A cell that loses both its places is not known to be held; the cost is a
//! duplicate seed, so that is counted and forgotten.

use super::pool::Pool;
use crate::gpu::kernels::{occupied, occupy};
use crate::gpu::{Arena, Buf, Gpu, GpuError, Kernel, Threads};
use std::ops::Range;
use stipple_drivers::Fault;

/// Points that travel to the GPU at a time.
const POINTS: usize = 4096;

/// What `look_up` finds at a point.
pub const FREE: u32 = 0;
pub const HELD: u32 = 1;
/// Both places are other cells'.
pub const UNKNOWN: u32 = 2;

#[derive(Clone, Copy)]
pub struct Buffers {
    pub cells: Buf<u32>,
    points: Buf<[f32; 4]>,
    found: Buf<u32>,
}

impl Buffers {
    /// `cells` is a power of two.
    pub fn new(arena: &mut Arena, cells: u32) -> Result<Buffers, Fault> {
        debug_assert!(cells.is_power_of_two());
        Ok(Buffers {
            cells: arena.alloc("occupancy: cells", cells as usize)?,
            points: arena.alloc("occupancy: points asked for", POINTS)?,
            found: arena.alloc("occupancy: answers", POINTS)?,
        })
    }
}

pub struct Occupancy {
    pub buffers: Buffers,
    occupy: Kernel<occupy::K>,
    occupied: Kernel<occupied::K>,
    per_metre: f32,
}

impl Occupancy {
    pub fn new(gpu: &mut Gpu, buffers: Buffers, cell_m: f64) -> Result<Occupancy, Fault> {
        Ok(Occupancy {
            buffers,
            occupy: gpu.kernel(occupy::Spec::default())?,
            occupied: gpu.kernel(occupied::Spec::default())?,
            per_metre: (1.0 / cell_m) as f32,
        })
    }

    /// Which of `points` lie in cells that hold Gaussians of some slots of the pool, `width` times as wide as the grid's; one
    /// answer a point.
    pub fn look_up(
        &self,
        gpu: &mut Gpu,
        pool: &Pool,
        (slots, width): (impl Iterator<Item = Range<u32>>, f32),
        points: &[[f32; 4]],
        answers: &mut Vec<u32>,
    ) -> Result<(), GpuError> {
        answers.clear();
        answers.resize(points.len(), FREE);
        let mut slots = slots.peekable();
        if slots.peek().is_none() {
            return Ok(());
        }
        let Buffers { cells, points: asked, found } = self.buffers;
        let (per_metre, mask) = (self.per_metre / width, cells.len() as u32 - 1);
        let mut rec = gpu.record();
        rec.fill(cells, u32::MAX);
        for slots in slots {
            if rec.room() == 0 {
                gpu.submit(rec)?;
                rec = gpu.record();
            }
            let bind = occupy::Bind { splats: pool.buffers.splats.read(), cells: cells.read_write() };
            let push = occupy::Push { first: slots.start, splats: slots.end, per_metre, mask };
            rec.dispatch(&self.occupy, bind, push, Threads::d1(slots.end));
        }
        gpu.submit(rec)?;
        for (points, answers) in points.chunks(POINTS).zip(answers.chunks_mut(POINTS)) {
            gpu.upload(asked, 0, points)?;
            let mut rec = gpu.record();
            let bind = occupied::Bind { points: asked.read(), cells: cells.read(), found: found.write() };
            let n = points.len() as u32;
            rec.dispatch(&self.occupied, bind, occupied::Push { points: n, per_metre, mask }, Threads::d1(n));
            gpu.submit(rec)?;
            gpu.download(found, 0, answers)?;
        }
        Ok(())
    }
}
