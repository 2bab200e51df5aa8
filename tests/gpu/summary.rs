//! The summary against its twin, and that every kernel has a twin.

use super::splat::{open, scene, shape, train, view, Rng};
use super::twins::summary::summary as summed;
use stipple::config::GpuConfig;
use stipple::gpu::kernels::types::{Camera, Counts, Moments, Splat, Status};
use stipple::gpu::kernels::{project_backward, summary};
use stipple::gpu::{Buf, Gpu, Threads};

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
    let counts = upload(&mut gpu, &[Counts { visible: 1, listed: 1, needed: 1, ..Counts::default() }]);
    let (runs, gradients) = (upload(&mut gpu, &[[0u32, 1]]), upload(&mut gpu, &[[1f32; 4]; 2]));
    let (splats, moments) = (upload(&mut gpu, &[splat]), upload(&mut gpu, &[Moments::default()]));
    let (steps, sums) = (upload(&mut gpu, &[0u32]), upload(&mut gpu, &[9f32; 8]));
    let bind = project_backward::Bind {
        counts_in: counts.read(),
        runs: runs.read(),
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
        splats: 1,
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
    let counts =
        upload(&mut gpu, &[Counts { visible: 11, listed: 12, needed: 13, not_finite: 14, ..Counts::default() }]);
    let (on_ssim, on_loss, on_pose) =
        (upload(&mut gpu, &ssim_sums), upload(&mut gpu, &loss_sums), upload(&mut gpu, &pose));
    let status = upload(&mut gpu, &[Status::default()]);
    let mut rec = gpu.record();
    let bind = summary::Bind {
        counts_in: counts.read(),
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
    for kernel in files("shaders-glsl/splat").iter().chain(&files("shaders-glsl/scan")) {
        if kernel.extension().is_some_and(|e| e == "comp") {
            let stem = kernel.file_stem().unwrap().to_str().unwrap();
            assert!(twins.iter().any(|t| t.contains(stem)), "{stem}.comp has no twin in tests/gpu");
        }
    }
}
