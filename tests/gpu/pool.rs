//! The pool's kernels against their twins, and what must hold of blocks: order, rigid moves, who is removed.

use super::splat::{open, render, scene, shape, target, train, view, Rng};
use super::twins::chunks;
use super::twins::pool::{self, Moved};
use glam::{DQuat, DVec3, DVec4, Vec3, Vec4};
use stipple::gpu::kernels::types::{Moments, Splat};
use stipple::gpu::{Gpu, GpuOptions};
use stipple::map::pool::importance_of_bin;
use stipple::map::{Gaussian, Pipeline, PruneRule, Rendered, Shape, Tiling, View};
use stipple_drivers::Pose;

const KEEP_ALL: PruneRule = PruneRule { opacity_min: 1e-9, scale_max_m: 1e3, importance_min: 0.0, steps_min: 0 };

fn states(gpu: &mut Gpu, p: &Pipeline) -> Vec<u32> {
    let mut out = vec![0; p.pool.count() as usize];
    gpu.download(p.pool.buffers.steps, 0, &mut out).unwrap();
    out
}

fn moments(gpu: &mut Gpu, p: &Pipeline) -> Vec<Moments> {
    let mut out = vec![Moments::default(); p.pool.count() as usize];
    gpu.download(p.pool.buffers.moments, 0, &mut out).unwrap();
    out
}

fn splats(gpu: &mut Gpu, p: &mut Pipeline) -> Vec<Gaussian> {
    p.pool.download(gpu).unwrap()
}

/// Two blocks of Gaussians, trained a little.
fn trained(v: &View, n: usize) -> (Gpu, Pipeline) {
    let (mut gpu, mut p) = open(shape(v, n as u32, 1 << 16));
    let all = scene(n, v, 11);
    p.pool.open_block(4, 0);
    p.pool.append(&mut gpu, &all[..n / 3]).unwrap();
    p.pool.open_block(9, 0);
    p.pool.append(&mut gpu, &all[n / 3..]).unwrap();
    p.loss.set_image(&mut gpu, 0, &target(v.camera.width, v.camera.height)).unwrap();
    train(&mut gpu, &mut p, v, 5);
    (gpu, p)
}

/// The first block goes and comes back as the newest: both are as they were, to the bit.
#[test]
fn a_block_that_left_comes_back_as_it_was() {
    let v = view(64, 48);
    let (mut gpu, mut p) = trained(&v, 300);
    let read = |gpu: &mut Gpu, p: &mut Pipeline, anchor: u32| {
        let mut bytes = vec![];
        let count = p.pool.read_block(gpu, anchor, true, &mut bytes).unwrap();
        (count, bytes)
    };
    let [first, second] = [4, 9].map(|anchor| read(&mut gpu, &mut p, anchor));
    assert_eq!(p.pool.remove_blocks(&mut gpu, |anchor| anchor == 4).unwrap(), first.0);
    assert_eq!((p.pool.holds(4), p.pool.block(9)), (false, 0..second.0 as u32));
    assert_eq!(read(&mut gpu, &mut p, 9), second);
    let whole = (first.0, true);
    assert!(!p.pool.insert_block(&mut gpu, (4, 0), whole, &first.1[1..]).unwrap(), "of another length");
    assert!(p.pool.insert_block(&mut gpu, (4, 0), whole, &first.1).unwrap());
    assert!(!p.pool.insert_block(&mut gpu, (4, 0), whole, &first.1).unwrap(), "it is there");
    assert_eq!([4, 9].map(|anchor| read(&mut gpu, &mut p, anchor)), [first, second]);
    assert_eq!(p.pool.blocks().map(|(anchor, _)| anchor).collect::<Vec<_>>(), [9, 4]);
}

#[test]
fn eviction_takes_the_least_valuable_and_keeps_the_order_of_anchors() {
    let v = view(64, 48);
    let (mut gpu, mut p) = trained(&v, 300);
    let (before, words, moved) = (splats(&mut gpu, &mut p), states(&mut gpu, &p), moments(&mut gpu, &p));
    let bins = p.pool.importance(&mut gpu, 5).unwrap();
    assert_eq!(bins, pool::importance(&words, 5));
    assert!(bins.iter().filter(|n| **n > 0).count() > 8, "{bins:?}");

    // About a third of the judged.
    let third = bins.iter().sum::<u32>() / 3;
    let mut below = 0;
    let bin = bins.iter().position(|n| {
        below += n;
        below > third
    });
    let importance_min = importance_of_bin(bin.unwrap());
    let kept: Vec<bool> =
        words.iter().map(|s| pool::steps_of(*s) < 5 || pool::importance_of(*s) >= f64::from(importance_min)).collect();
    let gone = p.pool.prune(&mut gpu, &PruneRule { importance_min, steps_min: 5, ..KEEP_ALL }).unwrap();
    assert_eq!(gone, kept.iter().filter(|k| !**k).count());
    assert!(gone > 10 && gone <= third as usize, "{gone} of {third}");
    assert_eq!(splats(&mut gpu, &mut p), pool::repack(&before, &kept));
    assert_eq!(states(&mut gpu, &p), pool::repack(&words, &kept));
    let bytes = |m: &[Moments]| bytemuck::cast_slice::<_, u32>(m).to_vec();
    assert_eq!(bytes(&moments(&mut gpu, &p)), bytes(&pool::repack(&moved, &kept)));
    let first = kept[..100].iter().filter(|k| **k).count() as u32;
    assert_eq!((p.pool.block(4), p.pool.block(9)), (0..first, first..p.pool.count()));
    assert_eq!(p.pool.block(5), 0..0);

    // The freed room is at the end, and the newest block takes it.
    assert_eq!(p.pool.append(&mut gpu, &before[..gone]).unwrap(), gone);
    assert_eq!((p.pool.count(), p.pool.block(9).end), (300, 300));
}

#[test]
fn gaps_close_in_pieces_where_scratch_is_short() {
    let v = view(33, 21);
    // 8 words of scratch a Gaussian, 24 of moments: three pieces.
    let (mut gpu, mut p) = open(shape(&v, 200, 200));
    let mut all = scene(200, &v, 3);
    all.iter_mut().step_by(3).for_each(|s| s.opacity_logit = -30.0);
    p.pool.append(&mut gpu, &all).unwrap();
    let kept: Vec<bool> = (0..200).map(|i| i % 3 != 0).collect();
    assert_eq!(p.pool.prune(&mut gpu, &KEEP_ALL).unwrap(), 67);
    assert_eq!(splats(&mut gpu, &mut p), pool::repack(&all, &kept));
    assert_eq!(p.pool.prune(&mut gpu, &KEEP_ALL).unwrap(), 0);
}

#[test]
fn importance_is_the_mean_of_what_the_opacity_gradient_says() {
    let v = view(64, 48);
    let (mut gpu, mut p) = open(shape(&v, 60, 1 << 16));
    p.pool.append(&mut gpu, scene(60, &v, 2)).unwrap();
    p.loss.set_image(&mut gpu, 0, &target(64, 48)).unwrap();
    let mut expected = vec![0u32; 60];
    for _ in 0..3 {
        train(&mut gpu, &mut p, &v, 1);
        let mut runs = vec![[0u32; 2]; 60];
        gpu.download(p.renderer.lists.buffers.runs, 0, &mut runs).unwrap();
        let mut gradients = vec![0f32; 8 << 16];
        gpu.download(p.backward.isect_gradients, 0, &mut gradients).unwrap();
        for ([from, to], state) in runs.into_iter().zip(&mut expected).filter(|([from, to], _)| from < to) {
            let chunk = Tiling::of(gpu.caps()).chunk as usize;
            *state = pool::after_step(*state, chunks::worth(&gradients, 8, from as usize..to as usize, chunk));
        }
    }
    for (got, want) in states(&mut gpu, &p).iter().zip(&expected) {
        assert_eq!(pool::steps_of(*got), pool::steps_of(*want));
        let (a, b) = (pool::importance_of(*got), pool::importance_of(*want));
        // A float sum may round to the neighbour of 8 bits.
        assert!((a - b).abs() <= b / 128.0, "{a} {b}");
    }
}

fn pose(seed: u64) -> Pose {
    let mut r = Rng(seed);
    let mut three = |s: f64| DVec3::from_array(std::array::from_fn(|_| r.uniform(-s, s)));
    Pose::new(DQuat::from_scaled_axis(three(1.0)), three(3.0))
}

#[test]
fn correction_moves_block_rigidly() {
    let v = view(64, 48);
    let (mut gpu, mut p) = trained(&v, 120);
    let picture = render(&mut gpu, &mut p, &v);
    let (before, old) = (splats(&mut gpu, &mut p), moments(&mut gpu, &p));
    let by = pose(5);
    p.pool.move_blocks(&mut gpu, [(9, by)].into_iter()).unwrap();
    let (after, new) = (splats(&mut gpu, &mut p), moments(&mut gpu, &p));
    assert_eq!(before[..40], after[..40], "the other block stays");
    let wide = |v: [f32; 4]| Vec4::from(v).as_dvec4();
    for i in 40..120 {
        let of = |s: &Gaussian, m: &Moments| Moved {
            mean: glam::Vec3::from(s.mean).as_dvec3(),
            quat: wide(s.quat_xyzw),
            m_mean: wide(m.m[0]).truncate(),
            v_mean: wide(m.v[0]).truncate(),
            m_quat: wide(m.m[2]),
            v_quat: wide(m.v[2]),
        };
        let (got, want) = (of(&after[i], &new[i]), pool::move_block(&of(&before[i], &old[i]), &by));
        let near = |a: DVec4, b: DVec4| (a - b).length() <= 1e-5 * b.length().max(1e-12);
        assert!(near(got.mean.extend(1.0), want.mean.extend(1.0)) && near(got.quat, want.quat), "{i}");
        assert!(near(got.m_mean.extend(0.0), want.m_mean.extend(0.0)), "{i}");
        assert!(near(got.v_mean.extend(0.0), want.v_mean.extend(0.0)), "{i}");
        assert!(near(got.m_quat, want.m_quat) && near(got.v_quat, want.v_quat), "{i}");
        let rest = |s: &Gaussian, m: &Moments| (s.log_scale, s.opacity_logit, s.colour, m.m[1], m.v[1]);
        assert_eq!(rest(&before[i], &old[i]), rest(&after[i], &new[i]));
    }
    // With both blocks moved, the moved camera sees the same picture.
    p.pool.move_blocks(&mut gpu, [(4, by)].into_iter()).unwrap();
    let moved = render(&mut gpu, &mut p, &View { world_from_cam: by * v.world_from_cam, ..v });
    let worst = picture.colour.iter().zip(&moved.colour).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(worst < 1.5 / 255.0, "{worst}");
}

#[test]
fn training_goes_on_after_a_move_as_if_nothing_happened() {
    let v = view(64, 48);
    let by = pose(6);
    let loss = |moved: bool| {
        let (mut gpu, mut p) = trained(&v, 120);
        let mut view = v;
        if moved {
            p.pool.move_blocks(&mut gpu, [(4, by), (9, by)].into_iter()).unwrap();
            view.world_from_cam = by * v.world_from_cam;
        }
        train(&mut gpu, &mut p, &view, 30).last().unwrap().loss
    };
    let (stayed, moved) = (loss(false), loss(true));
    // Adam scales each axis by itself, so the paths differ; where they lead does not.
    assert!((stayed - moved).abs() < 0.03 * stayed, "{stayed} {moved}");
}

#[test]
fn the_validation_layer_is_silent_about_the_pool() {
    let v = view(33, 21);
    let s = shape(&v, 64, 4096);
    let opened = Gpu::open_with(&crate::config(), Pipeline::arena_bytes(&s).unwrap(), GpuOptions { validation: true });
    let mut gpu = match opened {
        Ok(gpu) => gpu,
        Err(fault) => return println!("ignored: the_validation_layer_is_silent_about_the_pool: {fault}"),
    };
    let mut p = Pipeline::new(&mut gpu, s).unwrap();
    p.pool.open_block(0, 0);
    let mut all = scene(64, &v, 1);
    all[3].opacity_logit = f32::NAN;
    p.pool.append(&mut gpu, &all).unwrap();
    p.pool.importance(&mut gpu, 0).unwrap();
    assert_eq!(p.pool.prune(&mut gpu, &KEEP_ALL).unwrap(), 1);
    p.pool.move_blocks(&mut gpu, [(0, pose(1))].into_iter()).unwrap();
    assert_eq!(gpu.validation_messages(), Vec::<String>::new());
    let mut one = [Splat::default()];
    gpu.download(p.pool.buffers.splats, 0, &mut one).unwrap();
}

#[test]
fn a_loop_that_moves_thousands_of_anchors_fits() {
    let v = view(32, 32);
    let (mut gpu, mut p) = trained(&v, 30);
    let before = splats(&mut gpu, &mut p);
    let there = Pose { p: DVec3::X, ..Pose::IDENTITY };
    let and_back = [(4, there), (4, there.inverse())];
    p.pool.move_blocks(&mut gpu, and_back.into_iter().cycle().take(3000)).unwrap();
    for (now, then) in splats(&mut gpu, &mut p).iter().zip(&before) {
        let (now, then) = (DVec3::from(Vec3::from(now.mean)), DVec3::from(Vec3::from(then.mean)));
        assert!(now.distance(then) < 1e-3, "{now} {then}");
    }
}

#[test]
fn a_view_shows_and_trains_its_own_epoch_alone() {
    let v = view(64, 48);
    let (mut gpu, mut p) = open(Shape { images: 4, ..shape(&v, 300, 1 << 16) });
    let all = scene(300, &v, 11);
    let draw = |gpu: &mut Gpu, p: &Pipeline, epoch: u32| {
        let mut out = Rendered::new(64, 48, 1);
        p.render(gpu, &View { epoch, ..v }, &mut out).unwrap();
        out.colour
    };
    let alone = |range: std::ops::Range<usize>| {
        let (mut gpu, mut p) = open(shape(&v, 300, 1 << 16));
        p.pool.append(&mut gpu, &all[range]).unwrap();
        draw(&mut gpu, &p, 0)
    };
    for (anchor, epoch, range) in [(0, 0, 0..100), (1, 1, 100..180), (2, 1, 180..220), (3, 3, 220..300)] {
        p.pool.open_block(anchor, epoch);
        p.pool.append(&mut gpu, &all[range]).unwrap();
    }
    for (epoch, range) in [(0, 0..100), (1, 100..220), (3, 220..300)] {
        assert_eq!(p.pool.slots(epoch), range.start as u32..range.end as u32);
        assert!(draw(&mut gpu, &p, epoch) == alone(range), "epoch {epoch}");
    }
    assert!(draw(&mut gpu, &p, 2).iter().all(|x| *x == 0.0), "an epoch without a block shows nothing");
    p.loss.set_image(&mut gpu, 0, &target(64, 48)).unwrap();
    let before = splats(&mut gpu, &mut p);
    train(&mut gpu, &mut p, &View { epoch: 1, ..v }, 3);
    let after = splats(&mut gpu, &mut p);
    let moved = |range: std::ops::Range<usize>| range.filter(|i| before[*i] != after[*i]).count();
    assert_eq!((moved(0..100), moved(220..300)), (0, 0));
    assert!(moved(100..220) > 60);
}
