//! Which cells of space already hold Gaussians, and of which anchor: a hash table of fixed size on the GPU.
//!
//! A cell has two places and is found in either (`occupy.comp`). No probing: what is found does not depend on the order
//! of claims, so a map can be repeated to the bit. Where both places are other cells' nothing is claimed; the cost is a
//! duplicate seed, so that is counted and forgotten. A Gaussian that is moved or evicted leaves its cell claimed: seeds
//! go to occupied cells too where the rendering lacks them.

use crate::gpu::kernels::occupy;
use crate::gpu::{Buf, Gpu, GpuError, Kernel, Threads, ALIGN};
use crate::mem::Footprint;
use stipple_drivers::Fault;

/// Points that travel to the GPU at a time.
const POINTS: usize = 4096;

/// What `claim` answers of a point.
pub const CLAIMED: u32 = 0;
pub const HELD: u32 = 1;
pub const FULL: u32 = 2;

pub struct Occupancy {
    kernel: Kernel<occupy::K>,
    cells: Buf<u32>,
    points: Buf<[f32; 4]>,
    held: Buf<u32>,
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
        let o = Occupancy {
            kernel: gpu.kernel::<occupy::K>(occupy::Spec::default())?,
            cells: gpu.alloc("map: occupancy grid", cells as usize)?,
            points: gpu.alloc("map: points to place", POINTS)?,
            held: gpu.alloc("map: points placed", POINTS)?,
            per_metre: (1.0 / cell_m) as f32,
        };
        let mut rec = gpu.record();
        rec.fill(o.cells, u32::MAX);
        gpu.submit(rec).map_err(Fault::from)?;
        Ok(o)
    }

    /// Claims the cells around `points` for `anchor`, the latest there is; one answer a point.
    pub fn claim(
        &mut self,
        gpu: &mut Gpu,
        anchor: u32,
        points: &[[f32; 4]],
        answers: &mut Vec<u32>,
    ) -> Result<(), GpuError> {
        answers.clear();
        answers.resize(points.len(), CLAIMED);
        for (points, answers) in points.chunks(POINTS).zip(answers.chunks_mut(POINTS)) {
            gpu.upload(self.points, 0, points)?;
            let mut rec = gpu.record();
            let bind =
                occupy::Bind { points: self.points.read(), cells: self.cells.read_write(), held: self.held.write() };
            let n = points.len() as u32;
            let push = occupy::Push { points: n, anchor, per_metre: self.per_metre, mask: self.cells.len() as u32 - 1 };
            rec.dispatch(&self.kernel, bind, push, Threads::d1(n));
            gpu.submit(rec)?;
            gpu.download(self.held, 0, answers)?;
        }
        Ok(())
    }

    /// What is in the table, for tests.
    pub fn cells(&self) -> Buf<u32> {
        self.cells
    }
}
