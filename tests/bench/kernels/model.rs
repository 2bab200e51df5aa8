//! What kernels must move and calculate, and what the device could at most.
//!
//! Bytes are those of a perfect cache: each buffer a kernel touches, once. Operations count a multiply-add as two. The
//! rasters' are an upper bound: every pixel of a tile against every Gaussian listed, though opaque pixels end early.

use stipple::gpu::kernels::{bench_copy, bench_fma};
use stipple::gpu::{Gpu, Threads};
use stipple_drivers::Fault;

#[derive(Clone, Copy, Debug)]
pub struct Peaks {
    pub bytes_per_s: f64,
    pub flops_per_s: f64,
}

impl Peaks {
    pub fn ms(&self, bytes: f64, flops: f64) -> f64 {
        1e3 * (bytes / self.bytes_per_s).max(flops / self.flops_per_s)
    }
}

/// Vectors copied, twice what any cache holds; a quick run only shows that it runs.
const QUADS: u32 = 4 << 20;
const QUADS_QUICK: u32 = 1 << 16;
const THREADS: u32 = 1 << 18;
const ROUNDS: u32 = 512;
const ROUNDS_QUICK: u32 = 4;
const FLOPS_A_ROUND: f64 = 32.0;
const TRIES: usize = 5;

fn quads(quick: bool) -> u32 {
    if quick {
        QUADS_QUICK
    } else {
        QUADS
    }
}

pub fn arena_bytes(quick: bool) -> u64 {
    32 * u64::from(quads(quick)) + 4 * u64::from(THREADS) + (1 << 16)
}

pub fn measure(gpu: &mut Gpu, quick: bool) -> Result<Peaks, Fault> {
    let n = quads(quick);
    let from = gpu.alloc::<[f32; 4]>("bench: from", n as usize)?;
    let to = gpu.alloc::<[f32; 4]>("bench: to", n as usize)?;
    let factor = gpu.alloc::<f32>("bench: factor", 2)?;
    let result = gpu.alloc::<f32>("bench: result", THREADS as usize)?;
    let copy = gpu.kernel::<bench_copy::K>(bench_copy::Spec::default())?;
    let fma = gpu.kernel::<bench_fma::K>(bench_fma::Spec::default())?;
    // Converges, so that no chain meets denormals or infinity.
    gpu.upload(factor, 0, &[0.5, 0.25]).map_err(Fault::from)?;
    let best = |gpu: &mut Gpu, run: &dyn Fn(&mut Gpu) -> Result<(), Fault>| -> Result<f64, Fault> {
        let mut least = f64::INFINITY;
        for _ in 0..TRIES {
            run(gpu)?;
            least = least.min(gpu.last_submit_ms());
        }
        Ok(least * 1e-3)
    };
    let copy_s = best(gpu, &|gpu| {
        let mut rec = gpu.record();
        let bind = bench_copy::Bind { from: from.read(), to: to.write() };
        rec.dispatch(&copy, bind, bench_copy::Push { quads: n }, Threads::d1(n));
        gpu.submit(rec).map_err(Fault::from)
    })?;
    let rounds = if quick { ROUNDS_QUICK } else { ROUNDS };
    let fma_s = best(gpu, &|gpu| {
        let mut rec = gpu.record();
        let bind = bench_fma::Bind { factor: factor.read(), result: result.write() };
        rec.dispatch(&fma, bind, bench_fma::Push { rounds }, Threads::d1(THREADS));
        gpu.submit(rec).map_err(Fault::from)
    })?;
    let flops = f64::from(THREADS) * f64::from(rounds) * FLOPS_A_ROUND;
    Ok(Peaks { bytes_per_s: 32.0 * f64::from(n) / copy_s, flops_per_s: flops / fma_s })
}

/// Sizes of the work of one step.
#[derive(Clone, Copy, Debug)]
pub struct Counts {
    pub splats: f64,
    pub visible: f64,
    pub intersections: f64,
    pub pixels: f64,
    /// Pixels of one tile.
    pub tile_pixels: f64,
}

impl Counts {
    /// Bytes and operations of one step in the kernel of this name, for grey without depth.
    pub fn model(&self, name: &str) -> (f64, f64) {
        let Counts { splats: n, visible: v, intersections: i, pixels: p, tile_pixels } = *self;
        let pairs = i * tile_pixels;
        match name.trim_end_matches("_cpu").trim_end_matches("_subgroup") {
            "project" => (56.0 * n + 32.0 * v + 8.0 * i, 300.0 * v),
            "fill_lists" => (16.0 * i, 0.0),
            "sort_lists" => (12.0 * i, 0.0),
            // α takes 8 operations, blending 5; the way back 21 more.
            "raster_forward" => (40.0 * i + 8.0 * p, 13.0 * pairs),
            "raster_backward" => (72.0 * i + 8.0 * p, 34.0 * pairs),
            "ssim_tiles" => (18.0 * p, 236.0 * p),
            "loss_tiles" => (22.0 * p, 146.0 * p),
            "ssim_rows" => (22.0 * p, 106.0 * p),
            "ssim_columns" => (29.0 * p, 128.0 * p),
            "loss_rows" => (24.0 * p, 66.0 * p),
            "loss_columns" => (22.0 * p, 80.0 * p),
            // Where all Gaussians are small.
            "sum_chunks" => (0.5 * i, 0.0),
            "project_backward" => (32.0 * i + 8.0 * n + 2.0 * 148.0 * v, 600.0 * v + 8.0 * i),
            _ => (0.0, 0.0),
        }
    }
}
