//! Lists of tiles against their twins: which Gaussians a tile lists, and in which order.

use super::splat::{open, render, scene, shape, view, Rng};
use super::twins::lists::{sorted, touched, Ellipse, Grid};
use glam::DVec3;
use stipple::gpu::kernels::types::{Counts, Projected};
use stipple::gpu::{Buf, Gpu};
use stipple::map::{Gaussian, Pipeline, Rendered, Tiling};

/// Relative to the level: nearer than this a tile may fall either way in f32.
const UNDECIDED: f64 = 2e-3;
const CAPACITY: usize = 1 << 16;
/// Workgroups of `project` for 400 slots; each may leave a gap.
const GROUPS: u32 = 7;

fn read<T: bytemuck::Pod + Default>(gpu: &mut Gpu, buf: Buf<T>, n: usize) -> Vec<T> {
    let mut out = vec![T::default(); n];
    gpu.download(buf, 0, &mut out).unwrap();
    out
}

fn ellipse(p: &Projected) -> Ellipse {
    let ([x, y, a, b], [c, opacity, ..]) = (p.centre_conic, p.conic_shade);
    [x, y, a, b, c, opacity].map(f64::from)
}

/// Slots that each tile lists.
fn listed(gpu: &mut Gpu, p: &Pipeline, tiles: usize) -> Vec<Vec<u32>> {
    let b = p.renderer.lists.buffers;
    let (ranges, lists, owners) =
        (read(gpu, b.ranges, tiles), read(gpu, b.lists, CAPACITY), read(gpu, b.owners, CAPACITY));
    let list = |[from, to]: [u32; 2]| lists[from as usize..to as usize].iter().map(|i| owners[*i as usize]).collect();
    ranges.into_iter().map(list).collect()
}

/// Round ones, needles, tiny and huge ones, and a wall at one depth.
fn many(v: &stipple::map::View) -> Vec<Gaussian> {
    let mut all = scene(400, v, 3);
    let mut r = Rng(4);
    for g in all.iter_mut().step_by(3) {
        g.log_scale = std::array::from_fn(|_| r.uniform(-6.0, 0.5) as f32);
    }
    let wall = Gaussian {
        mean: v.world_from_cam.transform(DVec3::new(0.0, 0.0, 2.0)).as_vec3().to_array(),
        log_scale: [-0.5; 3],
        ..all[7]
    };
    all.iter_mut().skip(250).for_each(|g| *g = Gaussian { opacity_logit: g.opacity_logit, ..wall });
    all
}

#[test]
fn lists_of_tiles_equal_their_twins() {
    let v = view(157, 93);
    let s = shape(&v, 400, CAPACITY as u32);
    for (lanes, column) in [(8, 8), (32, 8), (32, 4), (16, 4)] {
        let mut gpu = Gpu::open(&crate::config(), Pipeline::arena_bytes(&s).unwrap()).unwrap();
        let tiling = Tiling { lanes, column, ..Tiling::BASELINE };
        let (tile, mut p) = (tiling.tile(), Pipeline::with_tiling(&mut gpu, s, tiling).unwrap());
        p.pool.append(&mut gpu, many(&v)).unwrap();
        let mut rec = gpu.record();
        p.renderer.record(&mut rec, &p.pool, &v, false);
        gpu.submit(rec).unwrap();

        let grid = Grid { width: 157, height: 93, tile: tile.map(|n| n as usize) };
        let tiles = grid.columns() * grid.rows();
        let b = p.renderer.lists.buffers;
        let counts: Counts = read(&mut gpu, b.counts, 1)[0];
        let runs: Vec<[u32; 2]> = read(&mut gpu, b.runs, 400);
        let owners: Vec<u32> = read(&mut gpu, b.owners, CAPACITY);
        let projected: Vec<Projected> = read(&mut gpu, p.renderer.projected, 400);
        let lists = listed(&mut gpu, &p, tiles);
        assert_eq!(counts.visible as usize, runs.iter().filter(|[from, to]| to > from).count());
        assert_eq!(counts.shared_out as usize, lists.iter().map(Vec::len).sum::<usize>());
        assert!(
            (0..GROUPS * tiling.chunk).contains(&(counts.needed - counts.shared_out)) && counts.listed == counts.needed
        );
        for (slot, ([from, to], g)) in runs.iter().zip(&projected).enumerate() {
            assert!(owners[*from as usize..*to as usize].iter().all(|o| *o == slot as u32), "{slot}");
            let has = |tile: usize| lists[tile].contains(&(slot as u32));
            assert_eq!((0..tiles).filter(|t| has(*t)).count(), (to - from) as usize, "{lanes} lanes, slot {slot}");
            let twin = if from < to { touched(&ellipse(g), &grid) } else { continue };
            for (tile, level) in twin.iter().enumerate().filter(|(_, l)| (**l - 1.0).abs() > UNDECIDED) {
                assert_eq!(has(tile), *level < 1.0, "{lanes} lanes, slot {slot}, tile {tile}: {level} of the level");
            }
        }
        for list in &lists {
            let of = |slot: &u32| (*slot, projected[*slot as usize]);
            assert_eq!(*list, sorted(list.iter().map(of)), "{lanes} lanes: front to back, and by slot at one depth");
        }
        assert!(lists.iter().any(|l| l.len() > 128));
    }
}

/// What does not fit is counted, whoever gets the places; pictures are drawn coarser until all of it fits.
#[test]
fn lists_of_tiles_that_do_not_fit_are_counted_and_drawn_coarser() {
    let v = view(64, 48);
    let (mut gpu, mut p) = open(shape(&v, 400, 600));
    p.pool.append(&mut gpu, many(&v)).unwrap();
    let mut rec = gpu.record();
    p.renderer.record(&mut rec, &p.pool, &v, false);
    gpu.submit(rec).unwrap();
    let b = p.renderer.lists.buffers;
    let counts: Counts = read(&mut gpu, b.counts, 1)[0];
    assert!(counts.listed == 600 && counts.needed > 600 && counts.shared_out <= 600, "{counts:?}");
    let mut out = Rendered::default();
    let stats = p.render(&mut gpu, &v, &mut out).unwrap();
    assert!(stats.overflow == 0 && stats.intersections <= 600 && out.alpha.iter().all(|a| a.is_finite()), "{stats:?}");
    assert!(render(&mut gpu, &mut p, &v).alpha.iter().any(|a| *a > 0.5));
}

/// From one element to two hundred runs, of depths as they may be: all different, few, one; in order, against it, shuffled.
#[test]
fn lists_of_tiles_are_sorted_at_any_length() {
    const MOST: usize = 50_000;
    let v = view(8, 8);
    let (mut gpu, mut p) = open(shape(&v, MOST as u32, CAPACITY as u32));
    let mut r = Rng(6);
    for n in [1, 2, 31, 63, 64, 65, 127, 128, 129, 255, 256, 257, 511, 513, 1023, 1024, 1025, 2048, 2049, 5000, MOST] {
        for (what, depths) in [("all", 1e6), ("few", 3.0), ("one", 1.0)] {
            for order in ["shuffled", "rising", "falling"] {
                let mut z: Vec<f64> = (0..n).map(|_| 1.0 + r.uniform(0.0, depths).floor() / depths).collect();
                match order {
                    "rising" => z.sort_by(f64::total_cmp),
                    "falling" => z.sort_by(|a, b| b.total_cmp(a)),
                    _ => {}
                }
                // Each as wide as the image, which is one tile or less.
                let centre = |z: f64| v.world_from_cam.transform(DVec3::new(0.0, 0.0, z)).as_vec3().to_array();
                let flat = Gaussian { log_scale: [0.0; 3], opacity_logit: -4.0, ..scene(1, &v, 1)[0] };
                p.pool.clear();
                p.pool.append(&mut gpu, z.iter().map(|z| Gaussian { mean: centre(*z), ..flat })).unwrap();
                let mut rec = gpu.record();
                p.renderer.record(&mut rec, &p.pool, &v, false);
                gpu.submit(rec).unwrap();
                let projected: Vec<Projected> = read(&mut gpu, p.renderer.projected, n);
                let lists = listed(&mut gpu, &p, 1);
                assert_eq!(lists[0].len(), n);
                assert!(lists[0] == sorted((0..).zip(projected)), "{what}, {order}, {n}");
            }
        }
    }
}
