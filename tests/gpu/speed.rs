//! What makes steps fast must not show in the map: steps started ahead, sums in chunks.

use super::splat::{open, scene, shape, target, train, view, Rng, FAST};
use super::twins::chunks;
use stipple::gpu::kernels::sum_chunks;
use stipple::gpu::kernels::types::{Counts, Moments};
use stipple::gpu::{Gpu, GpuOptions, Threads};
use stipple::map::step::Stats;
use stipple::map::tiling::CHUNK_GPU;
use stipple::map::{Pipeline, Rendered, Shape, StepStats, Target, Tiling, Weights};

/// The map, to the bit.
fn map(gpu: &mut Gpu, p: &mut Pipeline) -> Vec<u32> {
    bytemuck::cast_slice(&p.pool.download(gpu).unwrap()).to_vec()
}

#[test]
fn steps_started_ahead_leave_the_same_map_and_answers_to_the_bit() {
    const STEPS: usize = 9;
    let v = view(65, 47);
    let s = shape(&v, 512, 1 << 16);
    let ready = |gpu: &mut Gpu, p: &mut Pipeline| {
        p.pool.append(gpu, scene(500, &v, 9)).unwrap();
        p.loss.set_image(gpu, 0, &target(65, 47)).unwrap();
    };
    let (mut gpu, mut p) = open(s);
    ready(&mut gpu, &mut p);
    let answers = train(&mut gpu, &mut p, &v, STEPS);
    let waited_for = map(&mut gpu, &mut p);

    let validated = GpuOptions { validation: true };
    let Ok(mut gpu) = Gpu::open_with(&crate::config(), Pipeline::arena_bytes(&s).unwrap(), validated) else {
        return println!("ignored: there is no validation layer");
    };
    let mut p = Pipeline::new(&mut gpu, s).unwrap();
    ready(&mut gpu, &mut p);
    let (mut ahead, mut under_way): (Vec<StepStats>, _) = (Vec::new(), None);
    for i in 0..=STEPS {
        let next = (i < STEPS).then(|| p.start(&mut gpu, &v, 0, &FAST, &Weights::default()).unwrap());
        // Looking at the map in between neither disturbs it nor what the step has to say.
        if i % 4 == 2 {
            p.render(&mut gpu, &v, &mut Rendered::default()).unwrap();
        }
        if let Some(step) = std::mem::replace(&mut under_way, next) {
            ahead.push(p.finish(&mut gpu, &step).unwrap());
        }
    }
    assert_eq!(answers, ahead);
    assert!(waited_for == map(&mut gpu, &mut p));
    assert_eq!(gpu.validation_messages(), Vec::<String>::new());
}

#[test]
fn sums_of_chunks_equal_their_twin_and_nothing_else_changes() {
    const CAPACITY: usize = 3000;
    let mut r = Rng(5);
    // Runs from one slot to hundreds, as a near wall and far clutter have them.
    let mut owners: Vec<u32> = Vec::new();
    for owner in 0.. {
        let run = 10f64.powf(r.uniform(0.0, 2.5)) as usize;
        owners.extend(std::iter::repeat_n(owner, run));
        if owners.len() >= CAPACITY {
            break;
        }
    }
    owners.truncate(CAPACITY);
    for (channels, words) in [(1, 8), (3, 12)] {
        for count in [0, 15, 16, 2048, CAPACITY - 7] {
            let before: Vec<f32> = (0..CAPACITY * words).map(|_| r.uniform(-1.0, 1.5) as f32).collect();
            let mut gpu = Gpu::open(&crate::config(), 1 << 20).unwrap();
            let counts = gpu.alloc::<Counts>("counts", 1).unwrap();
            gpu.upload(counts, 0, &[Counts { listed: count as u32, ..Counts::default() }]).unwrap();
            let on_gpu = gpu.alloc::<u32>("owners", CAPACITY).unwrap();
            gpu.upload(on_gpu, 0, &owners).unwrap();
            let slots = gpu.alloc::<f32>("slots", before.len()).unwrap();
            gpu.upload(slots, 0, &before).unwrap();
            let k = gpu.kernel::<sum_chunks::K>(sum_chunks::Spec { channels, chunk: CHUNK_GPU }).unwrap();
            let mut rec = gpu.record();
            let bind = sum_chunks::Bind {
                counts_in: counts.read(),
                owners: on_gpu.read(),
                isect_gradients: slots.read_write(),
            };
            rec.dispatch(&k, bind, (), Threads::groups(3, 1, 1));
            gpu.submit(rec).unwrap();
            let mut got = before.clone();
            gpu.download(slots, 0, &mut got).unwrap();

            let mut wanted: Vec<f64> = before.iter().map(|v| f64::from(*v)).collect();
            chunks::sum_chunks(&owners[..count], &mut wanted, words);
            let (mut summed, mut kept) = (0, 0);
            for ((got, wanted), before) in got.iter().zip(&wanted).zip(&before) {
                if *wanted == f64::from(*before) {
                    assert_eq!(got, before);
                    kept += 1;
                } else {
                    assert!((f64::from(*got) - wanted).abs() < 1e-5, "{got} against {wanted}");
                    summed += 1;
                }
            }
            assert!(kept > 0 && (summed > 0) == (count > 500), "{summed} of {count}");
        }
    }
}

#[test]
fn a_loss_filtered_by_tiles_is_that_filtered_by_runs() {
    let v = view(130, 21);
    for channels in [1, 3] {
        let s = Shape { channels, ..shape(&v, 64, 1 << 14) };
        let of = |loss_by_tiles: bool| {
            let mut gpu = Gpu::open(&crate::config(), Pipeline::arena_bytes(&s).unwrap()).unwrap();
            let tiling = Tiling { loss_by_tiles, ..Tiling::of(gpu.caps()) };
            let mut p = Pipeline::with_tiling(&mut gpu, s, tiling).unwrap();
            p.pool.append(&mut gpu, scene(64, &v, 9)).unwrap();
            p.loss.set_image(&mut gpu, 0, &target(130, 21).repeat(channels as usize)).unwrap();
            let step = p.train(&mut gpu, &v, 0, None, &Weights::default()).unwrap();
            let mut gradient = vec![0f32; p.loss.buffers.pixel_gradient.len()];
            gpu.download(p.loss.buffers.pixel_gradient, 0, &mut gradient).unwrap();
            let mut map = Vec::new();
            p.similarity(&mut gpu, &Target::from(0), &mut map).unwrap();
            (step, gradient, map)
        };
        let ((a, gradient_a, map_a), (b, gradient_b, map_b)) = (of(true), of(false));
        assert!((a.loss - b.loss).abs() < 1e-6 && (a.ssim - b.ssim).abs() < 1e-6, "{a:?} {b:?}");
        let off = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        let most = gradient_a.iter().fold(0f32, |m, g| m.max(g.abs()));
        let (by_gradient, by_map) = (off(&gradient_a, &gradient_b), off(&map_a, &map_b));
        assert!(most > 0.0 && by_gradient < 1e-4 * most, "{by_gradient} of {most}");
        assert!(by_map < 1e-4, "{by_map}");
    }
}

#[test]
fn gradients_summed_in_chunks_are_those_summed_one_by_one() {
    let v = view(65, 47);
    for channels in [1, 3] {
        let s = Shape { channels, ..shape(&v, 128, 1 << 14) };
        let of = |chunk: u32| {
            let mut gpu = Gpu::open(&crate::config(), Pipeline::arena_bytes(&s).unwrap()).unwrap();
            let tiling = Tiling { chunk, ..Tiling::of(gpu.caps()) };
            let mut p = Pipeline::with_tiling(&mut gpu, s, tiling).unwrap();
            let mut all = scene(128, &v, 9);
            // So near that they cover every tile.
            all.iter_mut().step_by(5).for_each(|s| s.log_scale = [0.3; 3]);
            p.pool.append(&mut gpu, &all).unwrap();
            let picture = target(65, 47).repeat(channels as usize);
            p.loss.set_image(&mut gpu, 0, &picture).unwrap();
            let step = train(&mut gpu, &mut p, &v, 1)[0];
            let mut moments = vec![Moments::default(); 128];
            gpu.download(p.pool.buffers.moments, 0, &mut moments).unwrap();
            let mut states = vec![0u32; 128];
            gpu.download(p.pool.buffers.steps, 0, &mut states).unwrap();
            let first: Vec<f32> = moments.iter().flat_map(|m| m.m.into_iter().flatten()).collect();
            (step, first, states)
        };
        let ((one, a, states), (chunked, b, chunked_states)) = (of(1), of(CHUNK_GPU));
        // Two workgroups of `project`, each of which may leave a gap before a chunk.
        let gaps = chunked.stats.intersections - one.stats.intersections;
        assert!(one.stats.intersections > 20 * CHUNK_GPU && gaps < 2 * CHUNK_GPU);
        assert_eq!(one.stats, Stats { intersections: one.stats.intersections, ..chunked.stats });
        assert!((one.loss - chunked.loss).abs() == 0.0);
        let most = a.iter().fold(0f32, |m, v| m.max(v.abs()));
        let worst = a.iter().zip(&b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(most > 0.0 && worst < 1e-5 * most, "{worst} of {most}");
        // Importance may round to the neighbour of 8 bits.
        let near = |(a, b): (&u32, &u32)| (a & 0xffff) == (b & 0xffff) && (a >> 16).abs_diff(b >> 16) <= 1;
        assert!(states.iter().zip(&chunked_states).all(near));
    }
}
