//! The grid of occupied cells against its twin, and what must hold of it.

use super::splat::{shape, view, Rng};
use super::twins::occupancy as twin;
use stipple::gpu::{Arena, Gpu, GpuOptions};
use stipple::map::occupancy::{Buffers, Occupancy, FREE, HELD, UNKNOWN};
use stipple::map::{Gaussian, Pipeline, PruneRule};
use stipple_drivers::Pose;

const CELL_M: f64 = 0.125;

struct Grid {
    gpu: Gpu,
    pipeline: Pipeline,
    occupancy: Occupancy,
}

impl Grid {
    fn open(cells: u32, validation: bool) -> Option<Grid> {
        let shape = shape(&view(16, 16), 20_000, 20_000);
        let mut arena = Arena::counting();
        Buffers::new(&mut arena, cells).unwrap();
        let bytes = Pipeline::arena_bytes(&shape).unwrap() + arena.used();
        let opened = Gpu::open_with(&crate::config(), bytes, GpuOptions { validation });
        let mut gpu = match opened {
            Ok(gpu) => gpu,
            Err(fault) if validation => {
                println!("ignored: {fault}");
                return None;
            }
            Err(fault) => panic!("{fault}"),
        };
        let pipeline = Pipeline::new(&mut gpu, shape).unwrap();
        let buffers = Buffers::new(gpu.arena(), cells).unwrap();
        let occupancy = Occupancy::new(&mut gpu, buffers, CELL_M).unwrap();
        Some(Grid { gpu, pipeline, occupancy })
    }

    fn append(&mut self, means: &[[f32; 3]]) {
        let splat = |mean: &[f32; 3]| Gaussian {
            mean: *mean,
            log_scale: [-3.0; 3],
            quat_xyzw: [0.0, 0.0, 0.0, 1.0],
            ..Gaussian::default()
        };
        let splats: Vec<Gaussian> = means.iter().map(splat).collect();
        assert_eq!(self.pipeline.pool.append(&mut self.gpu, &splats).unwrap(), means.len());
    }

    fn look(&mut self, points: &[[f32; 4]]) -> Vec<u32> {
        let mut out = Vec::new();
        let pool = &self.pipeline.pool;
        self.occupancy.look_up(&mut self.gpu, pool, (std::iter::once(pool.slots(0)), 1.0), points, &mut out).unwrap();
        out
    }

    /// Looks among the Gaussians of some blocks, in cells so many times as wide.
    fn look_for(&mut self, blocks: &[u32], width: f32, points: &[[f32; 4]]) -> Vec<u32> {
        let mut out = Vec::new();
        let pool = &self.pipeline.pool;
        let slots = pool.slots_of(|number| blocks.contains(&number));
        self.occupancy.look_up(&mut self.gpu, pool, (slots, width), points, &mut out).unwrap();
        out
    }
}

fn means(n: usize, seed: u64, reach: f64) -> Vec<[f32; 3]> {
    let mut r = Rng(seed);
    (0..n).map(|_| std::array::from_fn(|_| r.uniform(-reach, reach) as f32)).collect()
}

fn at([x, y, z]: [f32; 3]) -> [f32; 4] {
    [x, y, z, 0.0]
}

#[test]
fn a_cell_is_held_as_long_as_a_gaussian_is_in_it() {
    let mut g = Grid::open(4096, false).unwrap();
    let (p, q) = ([-0.01, 2.05, 1.0], [0.01, 2.05, 1.0]);
    let asked = [at(p), at([-0.1, 2.05, 1.0]), at(q)];
    assert_eq!(g.look(&asked), [FREE; 3]);
    g.pipeline.pool.open_block(1, 0);
    g.append(&[p]);
    assert_eq!(g.look(&asked), [HELD, HELD, FREE]);
    // A correction takes it along.
    let by = Pose { p: glam::DVec3::new(0.02, 0.0, 0.0), ..Pose::IDENTITY };
    g.pipeline.pool.move_blocks(&mut g.gpu, [(1, by)].into_iter()).unwrap();
    assert_eq!(g.look(&asked), [FREE, FREE, HELD]);
    // Evicted, it leaves room to be seeded again.
    let all = PruneRule { opacity_min: 0.9, ..PruneRule::default() };
    assert_eq!(g.pipeline.pool.prune(&mut g.gpu, &all).unwrap(), 1);
    assert_eq!(g.look(&asked), [FREE; 3]);
}

#[test]
fn only_gaussians_of_the_blocks_asked_for_hold_cells_as_wide_as_asked_for() {
    let mut g = Grid::open(4096, false).unwrap();
    let places = [[0.05, 0.05, 1.05], [1.05, 0.05, 1.05], [2.05, 0.05, 1.05], [3.05, 0.05, 1.05]];
    for (number, place) in places.into_iter().enumerate() {
        g.pipeline.pool.open_block(number as u32, 0);
        g.append(&[place]);
    }
    let pool = &g.pipeline.pool;
    let ranges = |blocks: &[u32]| {
        let slots = pool.slots_of(|number| blocks.contains(&number));
        slots.map(|range| (range.start, range.end)).collect::<Vec<_>>()
    };
    assert_eq!((ranges(&[1, 2]), ranges(&[0, 3])), (vec![(1, 3)], vec![(0, 1), (3, 4)]));
    assert_eq!((ranges(&[]), ranges(&[0, 1, 2, 3])), (vec![], vec![(0, 4)]));
    let asked = places.map(at);
    assert_eq!(g.look_for(&[0, 1, 2, 3], 1.0, &asked), [HELD; 4]);
    assert_eq!(g.look_for(&[0, 3], 1.0, &asked), [HELD, FREE, FREE, HELD]);
    assert_eq!(g.look_for(&[], 1.0, &asked), [FREE; 4]);
    // 0.4 m beside each, in other cells of 0.125 m and in the same of 0.625 m.
    let beside = places.map(|[x, y, z]| at([x, y + 0.4, z]));
    assert_eq!(g.look_for(&[1], 1.0, &beside), [FREE; 4]);
    assert_eq!(g.look_for(&[1], 5.0, &beside), [FREE, HELD, FREE, FREE]);
}

#[test]
fn answers_agree_with_the_twin_in_tables_with_room_and_without() {
    for (cells, some_unknown) in [(65_536, false), (2048, true)] {
        let mut g = Grid::open(cells, false).unwrap();
        let mut all = means(9000, 1, 1.2);
        all[17][1] = f32::NAN;
        all[18][2] = f32::INFINITY;
        g.append(&all);
        let points: Vec<[f32; 4]> = means(9000, 2, 1.4).into_iter().map(at).collect();
        let answers = g.look(&points);
        let mut table = vec![twin::FREE; cells as usize];
        // The twin takes them last to first.
        all.reverse();
        twin::occupy(&mut table, 8.0, &all);
        let mut got = vec![0; cells as usize];
        g.gpu.download(g.occupancy.buffers.cells, 0, &mut got).unwrap();
        assert!(got == table, "tables differ");
        assert_eq!(answers, twin::occupied(&table, 8.0, &points));
        let count = |a: u32| answers.iter().filter(|k| **k == a).count();
        // 5000 of 8000 cells are held.
        assert!(count(HELD) > 500 && count(FREE) + count(UNKNOWN) > 500);
        assert_eq!(count(UNKNOWN) > 500, some_unknown, "{}", count(UNKNOWN));
    }
}

#[test]
fn the_validation_layer_is_silent_about_the_grid() {
    let Some(mut g) = Grid::open(1024, true) else { return };
    g.append(&means(100, 1, 3.0));
    g.look(&means(100, 2, 3.0).into_iter().map(at).collect::<Vec<_>>());
    assert_eq!(g.gpu.validation_messages(), Vec::<String>::new());
}
