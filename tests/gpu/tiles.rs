//! Lists of tiles and the summary against their twins, and that every kernel has a twin.

use super::splat::{open, scene, shape, train, view, Rng};
use super::twins::tiles::{summary as summed, tile_ranges as ranges_of, touched, Ellipse, Grid};
use stipple::config::GpuConfig;
use stipple::gpu::kernels::types::{Camera, Moments, Projected, Splat, Status};
use stipple::gpu::kernels::{count_tiles, emit_tiles, project_backward, summary, tile_ranges};
use stipple::gpu::{Buf, Gpu, Threads};

const SIZE: [u32; 2] = [157, 93];
/// Relative to the level: nearer than this a tile may fall either way in f32.
const UNDECIDED: f64 = 2e-3;

fn upload<T: bytemuck::Pod>(gpu: &mut Gpu, items: &[T]) -> Buf<T> {
    let buf = gpu.alloc("test", items.len()).unwrap();
    gpu.upload(buf, 0, items).unwrap();
    buf
}

fn read<T: bytemuck::Pod + Default>(gpu: &mut Gpu, buf: Buf<T>, n: usize) -> Vec<T> {
    let mut out = vec![T::default(); n];
    gpu.download(buf, 0, &mut out).unwrap();
    out
}

/// Round ones, needles, tiny and huge ones, in and about the image.
fn ellipses(n: usize) -> Vec<Ellipse> {
    let mut r = Rng(3);
    (0..n)
        .map(|_| {
            let (long, short) = (10f64.powf(r.uniform(0.0, 2.5)), 10f64.powf(r.uniform(-0.2, 1.0)));
            let (s, c) = r.uniform(0.0, 3.2).sin_cos();
            let (p, q) = (1.0 / (long * long), 1.0 / (short * short));
            let conic = [p * c * c + q * s * s, (p - q) * s * c, p * s * s + q * c * c];
            let centre = [r.uniform(-40.0, 200.0), r.uniform(-40.0, 130.0)];
            [centre[0], centre[1], conic[0], conic[1], conic[2], r.uniform(0.005, 1.0)].map(|v| f64::from(v as f32))
        })
        .collect()
}

fn projected(e: &Ellipse) -> Projected {
    let [x, y, a, b, c, opacity] = e.map(|v| v as f32);
    Projected { centre_conic: [x, y, a, b], conic_shade: [c, opacity, 0.5, 1.0] }
}

#[test]
fn lists_of_tiles_equal_their_twins() {
    let all = ellipses(400);
    let n = all.len() as u32;
    for (lanes, column) in [(8, 8), (32, 8), (32, 4)] {
        let tile = [lanes.min(16) as usize, (column * lanes / lanes.min(16)) as usize];
        let grid = Grid { width: SIZE[0] as usize, height: SIZE[1] as usize, tile };
        let tiles = grid.columns() * grid.rows();
        let mut gpu = Gpu::open(&GpuConfig::default(), 16 << 20).unwrap();
        let count_kernel = gpu.kernel::<count_tiles::K>(count_tiles::Spec { lanes, column }).unwrap();
        let emit_kernel = gpu.kernel::<emit_tiles::K>(emit_tiles::Spec { lanes, column }).unwrap();
        let ranges_kernel = gpu.kernel::<tile_ranges::K>(Default::default()).unwrap();
        let visible_count = upload(&mut gpu, &[n]);
        let slots: Vec<u32> = (0..n).rev().collect();
        let slots_on_gpu = upload(&mut gpu, &slots);
        let records = upload(&mut gpu, &all.iter().map(projected).collect::<Vec<_>>());
        let counts = upload(&mut gpu, &vec![77u32; n as usize + 1]);
        let mut rec = gpu.record();
        let bind = count_tiles::Bind {
            visible_count: visible_count.read(),
            slots: slots_on_gpu.read(),
            projected_in: records.read(),
            tile_counts: counts.write(),
        };
        rec.dispatch(
            &count_kernel,
            bind,
            count_tiles::Push { size: SIZE, splats: n, coarseness: 0.0 },
            Threads::d1(n + 1),
        );
        gpu.submit(rec).unwrap();
        let counted = read(&mut gpu, counts, n as usize + 1);
        assert_eq!(counted[n as usize], 0);

        let mut offsets = vec![0u32];
        offsets.extend(counted.iter().scan(0, |sum, c| {
            *sum += c;
            Some(*sum)
        }));
        let needed = offsets[n as usize];
        for capacity in [needed, needed / 3] {
            let offsets_on_gpu = upload(&mut gpu, &offsets[..=n as usize]);
            let keys = upload(&mut gpu, &vec![u32::MAX; needed as usize]);
            let owners = upload(&mut gpu, &vec![u32::MAX; needed as usize]);
            let totals = upload(&mut gpu, &[0u32; 2]);
            let ranges = upload(&mut gpu, &vec![[0u32; 2]; tiles + 1]);
            let mut rec = gpu.record();
            let bind = emit_tiles::Bind {
                visible_count: visible_count.read(),
                slots: slots_on_gpu.read(),
                projected_in: records.read(),
                tile_offsets: offsets_on_gpu.read(),
                keys: keys.write(),
                owners: owners.write(),
                isect_count: totals.write(),
            };
            rec.dispatch(
                &emit_kernel,
                bind,
                emit_tiles::Push { size: SIZE, splats: n, capacity, coarseness: 0.0 },
                Threads::d1(n),
            );
            gpu.submit(rec).unwrap();
            assert_eq!(read(&mut gpu, totals, 2), [capacity, needed]);
            let mut listed = read(&mut gpu, keys, capacity as usize);
            let owned = read(&mut gpu, owners, capacity as usize);
            for rank in 0..n as usize {
                let (first, end) = (offsets[rank].min(capacity) as usize, offsets[rank + 1].min(capacity) as usize);
                assert!(owned[first..end].iter().all(|o| *o == slots[rank]), "{lanes} lanes, rank {rank}: owner");
                if offsets[rank + 1] > capacity {
                    continue;
                }
                let twin = touched(&all[slots[rank] as usize], &grid);
                for (tile, level) in twin.iter().enumerate().filter(|(_, l)| (**l - 1.0).abs() > UNDECIDED) {
                    let is = listed[first..end].contains(&(tile as u32));
                    assert_eq!(is, *level < 1.0, "{lanes} lanes, rank {rank}, tile {tile}: {level} of the level");
                }
            }
            listed.sort_unstable();
            gpu.upload(keys, 0, &listed).unwrap();
            let mut rec = gpu.record();
            let bind = tile_ranges::Bind { isect_count: totals.read(), keys: keys.read(), ranges: ranges.write() };
            let push = tile_ranges::Push { tiles: tiles as u32 + 1 };
            rec.dispatch(&ranges_kernel, bind, push, Threads::groups(3, 1, 1));
            gpu.submit(rec).unwrap();
            assert_eq!(read(&mut gpu, ranges, tiles + 1), ranges_of(&listed, tiles + 1));
        }
    }
}

#[test]
fn a_gaussian_that_only_the_forward_pass_could_place_is_left_as_it_is() {
    // Behind the camera, and yet in the list: as where the two passes round the near plane differently.
    let v = view(64, 48);
    let behind = v.world_from_cam.transform(glam::DVec3::new(0.0, 0.0, -1.0)).as_vec3();
    let splat = Splat {
        mean_opacity: [behind.x, behind.y, behind.z, 1.0],
        scale_colour: [-3.0; 4],
        quat: [0.0, 0.0, 0.0, 1.0],
    };
    let mut gpu = Gpu::open(&GpuConfig::default(), 1 << 20).unwrap();
    let spec = project_backward::Spec { channels: 1, chunk: 1, fisheye: false, learn: true };
    let kernel = gpu.kernel::<project_backward::K>(spec).unwrap();
    let (one, slots) = (upload(&mut gpu, &[1u32]), upload(&mut gpu, &[0u32]));
    let (offsets, gradients) = (upload(&mut gpu, &[0u32, 1]), upload(&mut gpu, &[[1f32; 4]; 2]));
    let (splats, moments) = (upload(&mut gpu, &[splat]), upload(&mut gpu, &[Moments::default()]));
    let (steps, sums) = (upload(&mut gpu, &[0u32]), upload(&mut gpu, &[9f32; 8]));
    let bind = project_backward::Bind {
        visible_count: one.read(),
        slots: slots.read(),
        tile_offsets: offsets.read(),
        isect_gradients: gradients.read(),
        splats: splats.read_write(),
        moments_in_out: moments.read_write(),
        steps: steps.read_write(),
        sums: sums.write(),
    };
    let camera = Camera {
        rotation: v.world_from_cam.inverse().q.as_quat().to_array(),
        translation: v.world_from_cam.inverse().p.as_vec3().extend(0.0).to_array(),
        focal_centre: [50.0, 50.0, 32.0, 24.0],
        distortion: [0.0; 4],
    };
    let push = project_backward::Push {
        camera,
        size: [64, 48],
        capacity: 1,
        rate_position: 0.1,
        rate_scale: 0.1,
        rate_rotation: 0.1,
        rate_opacity: 0.1,
        rate_colour: 0.1,
        weight_needle: 0.1,
        weight_scale: 0.1,
        log_scale_soft: -4.0,
        weight_opacity: 0.1,
    };
    let mut rec = gpu.record();
    rec.dispatch(&kernel, bind, push, Threads::d1(1));
    gpu.submit(rec).unwrap();
    assert_eq!(read(&mut gpu, splats, 1), [splat]);
    assert_eq!((read(&mut gpu, moments, 1), read(&mut gpu, steps, 1)), (vec![Moments::default()], vec![0]));
    assert_eq!(read(&mut gpu, sums, 8), [0.0; 8]);
}

#[test]
fn summary_equals_its_twin() {
    let mut r = Rng(5);
    let mut noise = |n: usize| (0..n).map(|_| r.uniform(-1.0, 1.0) as f32).collect::<Vec<_>>();
    let (ssim, loss, pose) = (noise(1000), noise(4000), noise(8 * 300));
    let (ssim_sums, loss_sums, pose_sums): (Vec<f32>, Vec<[f32; 4]>, Vec<[f32; 8]>) =
        (ssim, bytemuck::cast_slice(&loss).to_vec(), bytemuck::cast_slice(&pose).to_vec());
    let mut gpu = Gpu::open(&GpuConfig::default(), 1 << 20).unwrap();
    let kernel = gpu.kernel::<summary::K>(Default::default()).unwrap();
    let visible = upload(&mut gpu, &[11u32]);
    let isects = upload(&mut gpu, &[12u32, 13]);
    let failed = upload(&mut gpu, &[14u32]);
    let (on_ssim, on_loss, on_pose) =
        (upload(&mut gpu, &ssim_sums), upload(&mut gpu, &loss_sums), upload(&mut gpu, &pose));
    let status = upload(&mut gpu, &[Status::default()]);
    let mut rec = gpu.record();
    let bind = summary::Bind {
        visible_count: visible.read(),
        isect_count: isects.read(),
        failed: failed.read(),
        ssim_sums: on_ssim.read(),
        loss_sums: on_loss.read(),
        sums: on_pose.read(),
        status_out: status.write(),
    };
    rec.dispatch(&kernel, bind, summary::Push { image_groups: 1000, splat_groups: 300 }, Threads::groups(1, 1, 1));
    gpu.submit(rec).unwrap();
    let s = read(&mut gpu, status, 1)[0];
    assert_eq!((s.visible, s.intersections, s.intersections_needed, s.not_finite), (11, 12, 13, 14));
    let (ssim, [l1, gain, offset], terms) = summed(&ssim_sums, &loss_sums, &pose_sums);
    let close = |a: f32, b: f64| assert!((f64::from(a) - b).abs() < 1e-4, "{a} against {b}");
    close(s.ssim_sum, ssim);
    close(s.l1_sum, l1);
    close(s.exposure[0], gain);
    close(s.exposure[1], offset);
    (0..6).for_each(|k| close(s.pose[k], terms[k]));
    close(s.gradients_refused, terms[6]);
}

/// What arrives lies in its slot with nothing remembered, and the rest is as it was.
#[test]
fn what_is_appended_begins_anew() {
    let v = view(33, 21);
    let splats = scene(40, &v, 1);
    let (mut gpu, mut p) = open(shape(&v, 40, 1 << 12));
    let state = |gpu: &mut Gpu, p: &stipple::map::Pipeline, n: usize| {
        let b = p.pool.buffers;
        let (s, m, k) = (b.splats, b.moments, b.steps);
        (read::<Splat>(gpu, s, n), read::<Moments>(gpu, m, n), read::<u32>(gpu, k, n))
    };
    // What an earlier map left in the slots.
    p.pool.append(&mut gpu, &splats).unwrap();
    train(&mut gpu, &mut p, &v, 2);
    p.pool.clear();
    p.pool.append(&mut gpu, &splats[..25]).unwrap();
    train(&mut gpu, &mut p, &v, 2);
    let before = state(&mut gpu, &p, 25);
    p.pool.append(&mut gpu, &splats[25..]).unwrap();
    let after = state(&mut gpu, &p, 40);
    assert_eq!((&before.0[..], &before.1[..], &before.2[..]), (&after.0[..25], &after.1[..25], &after.2[..25]));
    for (i, s) in splats.iter().enumerate().skip(25) {
        let ([x, y, z], [a, b, c]) = (s.mean, s.log_scale);
        assert_eq!(after.0[i].mean_opacity, [x, y, z, s.opacity_logit]);
        assert_eq!((after.0[i].scale_colour, after.0[i].quat), ([a, b, c, s.colour[0]], s.quat_xyzw));
        assert_eq!((after.1[i], after.2[i]), (Moments::default(), 0));
    }
}

#[test]
fn every_kernel_is_named_beside_its_twin() {
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
    let files = |folder: &str| -> Vec<std::path::PathBuf> {
        std::fs::read_dir(root.join(folder)).unwrap().map(|e| e.unwrap().path()).collect()
    };
    let sources = files("tests/gpu").into_iter().chain(files("tests/gpu/twins"));
    let texts: Vec<String> = sources.filter_map(|p| std::fs::read_to_string(p).ok()).collect();
    let twins: Vec<&String> = texts.iter().filter(|t| t.contains("Twin")).collect();
    for kernel in files("shaders-glsl/splat").iter().chain(&files("shaders-glsl/sort")) {
        if kernel.extension().is_some_and(|e| e == "comp") {
            let stem = kernel.file_stem().unwrap().to_str().unwrap();
            assert!(twins.iter().any(|t| t.contains(stem)), "{stem}.comp has no twin in tests/gpu");
        }
    }
}
