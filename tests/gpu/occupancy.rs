//! The grid of occupied cells against its twin, and what must hold of it.

use super::splat::Rng;
use super::twins::occupancy as twin;
use stipple::config::GpuConfig;
use stipple::gpu::{Gpu, GpuOptions};
use stipple::map::occupancy::{Occupancy, CLAIMED, FULL, HELD};

fn open(cells: u32) -> (Gpu, Occupancy) {
    let bytes = Occupancy::footprint(cells).gpu_total();
    let mut gpu = Gpu::open(&GpuConfig::default(), bytes).unwrap();
    let grid = Occupancy::new(&mut gpu, 0.125, cells).unwrap();
    (gpu, grid)
}

fn points(n: usize, seed: u64, reach: f64) -> Vec<[f32; 4]> {
    let mut r = Rng(seed);
    (0..n).map(|_| std::array::from_fn(|_| r.uniform(-reach, reach) as f32)).collect()
}

fn claim(gpu: &mut Gpu, grid: &mut Occupancy, anchor: u32, points: &[[f32; 4]]) -> Vec<u32> {
    let mut out = Vec::new();
    grid.claim(gpu, anchor, points, &mut out).unwrap();
    out
}

fn table(gpu: &mut Gpu, grid: &Occupancy) -> Vec<u32> {
    let mut out = vec![0; grid.cells().len()];
    gpu.download(grid.cells(), 0, &mut out).unwrap();
    out
}

#[test]
fn a_cell_belongs_to_the_first_anchor() {
    let (mut gpu, mut grid) = open(4096);
    let p = [-0.01, 2.05, 1.0, 0.0];
    assert_eq!(claim(&mut gpu, &mut grid, 1, &[p, p]), [CLAIMED, CLAIMED]);
    assert_eq!(claim(&mut gpu, &mut grid, 1, &[[-0.1, 2.05, 1.0, 0.0]]), [CLAIMED]);
    let beside = [0.01, 2.05, 1.0, 0.0];
    assert_eq!(claim(&mut gpu, &mut grid, 2, &[p, beside]), [HELD, CLAIMED]);
    assert_eq!(claim(&mut gpu, &mut grid, 3, &[p, beside]), [HELD, HELD]);
}

#[test]
fn claims_agree_with_the_twin_in_any_order() {
    let (mut gpu, mut grid) = open(2048);
    let mut cells = vec![u32::MAX; 2048];
    let (mut held, mut full) = (0, 0);
    for anchor in 0..6 {
        let mut all = points(5000, u64::from(anchor) + 1, 1.2);
        let answers = claim(&mut gpu, &mut grid, anchor, &all);
        // The twin takes them last to first.
        all.reverse();
        let mut expected = twin::claim(&mut cells, anchor, 8.0, &all);
        expected.reverse();
        assert_eq!(answers, expected);
        assert_eq!(table(&mut gpu, &grid), cells);
        held += answers.iter().filter(|a| **a == HELD).count();
        full += answers.iter().filter(|a| **a == FULL).count();
    }
    // 7000 cells in 2048 places.
    assert!(held > 1000 && full > 1000, "{held} {full}");
}

#[test]
fn the_validation_layer_is_silent_about_the_grid() {
    let opened =
        Gpu::open_with(&GpuConfig::default(), Occupancy::footprint(1024).gpu_total(), GpuOptions { validation: true });
    let mut gpu = match opened {
        Ok(gpu) => gpu,
        Err(fault) => return println!("ignored: the_validation_layer_is_silent_about_the_grid: {fault}"),
    };
    let mut grid = Occupancy::new(&mut gpu, 0.1, 1024).unwrap();
    claim(&mut gpu, &mut grid, 7, &points(100, 1, 3.0));
    assert_eq!(gpu.validation_messages(), Vec::<String>::new());
}
