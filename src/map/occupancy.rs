//! Which cells of space hold Gaussians: a hash table of fixed size on the GPU, made anew of the pool for every anchor, so
//! that what was evicted, pruned or moved since holds nothing (a fill of 1 MB and one thread a Gaussian; the pool is
//! all there is to keep).
//!
//! A cell has two places and is found in either (`occupy.comp`). No probing: the table does not depend on the order of
//! threads, so a map can be repeated to the bit. A cell that loses both its places is not known to be held; the cost is a
//! duplicate seed, so that is counted and forgotten.

use super::pipeline::Pipeline;
use crate::gpu::kernels::{occupied, occupy};
use crate::gpu::{Buf, Gpu, GpuError, Kernel, Threads, ALIGN};
use crate::mem::Footprint;
use stipple_drivers::Fault;

/// Points that travel to the GPU at a time.
const POINTS: usize = 4096;

/// What `look` finds at a point.
pub const FREE: u32 = 0;
pub const HELD: u32 = 1;
/// Both places are other cells'.
pub const UNKNOWN: u32 = 2;

pub struct Occupancy {
    occupy: Kernel<occupy::K>,
    occupied: Kernel<occupied::K>,
    cells: Buf<u32>,
    points: Buf<[f32; 4]>,
    found: Buf<u32>,
    per_metre: f32,
}

impl Occupancy {
    pub fn footprint(cells: u32) -> Footprint {
        let mut f = Footprint::default();
        f.gpu("map: occupancy grid", cells as usize * size_of::<u32>());
        f.gpu("map: points to place", POINTS * (size_of::<[f32; 4]>() + size_of::<u32>()) + 3 * ALIGN as usize);
        f
    }

    /// `cells` is a power of two.
    pub fn new(gpu: &mut Gpu, cell_m: f64, cells: u32) -> Result<Occupancy, Fault> {
        debug_assert!(cells.is_power_of_two());
        Ok(Occupancy {
            occupy: gpu.kernel::<occupy::K>(occupy::Spec::default())?,
            occupied: gpu.kernel::<occupied::K>(occupied::Spec::default())?,
            cells: gpu.alloc("map: occupancy grid", cells as usize)?,
            points: gpu.alloc("map: points to place", POINTS)?,
            found: gpu.alloc("map: points placed", POINTS)?,
            per_metre: (1.0 / cell_m) as f32,
        })
    }

    /// Which of `points` lie in cells that hold Gaussians of the pool; one answer a point.
    pub fn look(
        &mut self,
        gpu: &mut Gpu,
        pipeline: &Pipeline,
        points: &[[f32; 4]],
        answers: &mut Vec<u32>,
    ) -> Result<(), GpuError> {
        let (splats, per_metre, mask) = (pipeline.count() as u32, self.per_metre, self.cells.len() as u32 - 1);
        let mut rec = gpu.record();
        rec.fill(self.cells, u32::MAX);
        let bind = occupy::Bind { splats: pipeline.buffers().splats.read(), cells: self.cells.read_write() };
        rec.dispatch(&self.occupy, bind, occupy::Push { splats, per_metre, mask }, Threads::d1(splats));
        gpu.submit(rec)?;
        answers.clear();
        answers.resize(points.len(), FREE);
        for (points, answers) in points.chunks(POINTS).zip(answers.chunks_mut(POINTS)) {
            gpu.upload(self.points, 0, points)?;
            let mut rec = gpu.record();
            let bind =
                occupied::Bind { points: self.points.read(), cells: self.cells.read(), found: self.found.write() };
            let n = points.len() as u32;
            rec.dispatch(&self.occupied, bind, occupied::Push { points: n, per_metre, mask }, Threads::d1(n));
            gpu.submit(rec)?;
            gpu.download(self.found, 0, answers)?;
        }
        Ok(())
    }

    /// What is in the table, for tests.
    pub fn cells(&self) -> Buf<u32> {
        self.cells
    }
}
