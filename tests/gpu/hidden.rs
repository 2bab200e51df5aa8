//! What a view does not show, or where it is not compared, does not change; and what is absent, the image stands in for. Twin of
//! fill_absent.comp: `both`, the mask less the hidden cells, and a picture before a backdrop, made on the host.

use super::splat::{mask, open, psnr, render, scene, shape, target, train, view, wide, worst, FAST, STILL};
use super::twins::{self, compare::by_group, compare::GROUPS};
use stipple::gpu::kernels::types::Moments;
use stipple::gpu::Gpu;
use stipple::map::horizon::{cell_of, Absent, Cells, CELLS};
use stipple::map::{Exposure, Gaussian, Pipeline, Shape, Target, Weights};

const SIZE: (usize, usize) = (65, 47);

fn moments(gpu: &mut Gpu, p: &Pipeline, n: usize) -> Vec<Moments> {
    let mut moments = vec![Moments::default(); n];
    gpu.download(p.pool.buffers.moments, 0, &mut moments).unwrap();
    moments
}

fn pixel_gradient(gpu: &mut Gpu, p: &Pipeline) -> Vec<f64> {
    let mut gradient = vec![0f32; SIZE.0 * SIZE.1];
    gpu.download(p.loss.buffers.pixel_gradient, 0, &mut gradient).unwrap();
    wide(&gradient)
}

#[test]
fn hidden_cells_are_masked_beside_the_mask() {
    let (w, h) = SIZE;
    let v = view(w, h);
    let (mut gpu, mut p) = open(shape(&v, 512, 1 << 16));
    p.pool.append(&mut gpu, scene(500, &v, 9)).unwrap();
    p.loss.set_image(&mut gpu, 0, &target(w, h)).unwrap();
    let mut hidden = Cells::default();
    (0..CELLS).filter(|cell| cell % 7 == 3 || *cell > 150).for_each(|cell| hidden.insert(cell));
    let alpha = render(&mut gpu, &mut p, &v).alpha;
    let is_hidden = |i: usize| {
        let cell = cell_of((i % w) as f64, (i / w) as f64, w, h);
        hidden.contains(cell) || alpha[i] < 0.5
    };
    let seen = mask(w, h);
    p.loss.set_mask(&mut gpu, 0, &seen).unwrap();
    let part = Target { absent: Some(Absent { hidden, filled: hidden }), ..Target::from(0) };
    let values = p.loss.values(&part);
    let by_cells = p.train(&mut gpu, &v, part, Some(&STILL), &Weights::default()).unwrap();
    let gradient = pixel_gradient(&mut gpu, &p);

    let both: Vec<u8> = seen.iter().enumerate().map(|(i, m)| if is_hidden(i) { 0 } else { *m }).collect();
    p.loss.set_mask(&mut gpu, 0, &both).unwrap();
    let whole = Target::from(0);
    // Each is a mean over the pixels of its camera's mask.
    let ratio = p.loss.values(&whole) / values;
    let by_mask = p.train(&mut gpu, &v, whole, Some(&STILL), &Weights::default()).unwrap();
    let wanted: Vec<f64> = pixel_gradient(&mut gpu, &p).iter().map(|g| g * ratio).collect();
    assert!((by_cells.l1 - by_mask.l1 * ratio).abs() < 1e-6, "{} and {}", by_cells.l1, by_mask.l1 * ratio);
    let scale = wanted.iter().fold(0.0f64, |m, g| m.max(g.abs()));
    assert!(scale > 0.0 && worst(gradient.iter().copied(), wanted) < 1e-5 * scale);
    assert!((0..w * h).filter(|i| both[*i] == 0).all(|i| gradient[i] == 0.0));
}

#[test]
fn a_view_that_is_hidden_trains_nothing_however_it_is_regularised() {
    let (w, h) = SIZE;
    let v = view(w, h);
    let (mut gpu, mut p) = open(shape(&v, 512, 1 << 16));
    p.pool.append(&mut gpu, scene(500, &v, 9)).unwrap();
    p.loss.set_image(&mut gpu, 0, &target(w, h)).unwrap();
    let before = p.pool.download(&mut gpu).unwrap();
    let mut hidden = Cells::default();
    (0..CELLS).for_each(|cell| hidden.insert(cell));
    assert_eq!(hidden.len(), CELLS);
    let weights = Weights { scale_soft_m: 1e-3, opacity: 0.1, ..Weights::default() };
    for _ in 0..3 {
        let absent = Some(Absent { hidden, filled: hidden });
        let step = p.train(&mut gpu, &v, Target { absent, ..Target::from(0) }, Some(&FAST), &weights).unwrap();
        assert_eq!((step.pose_gradient.map(f64::abs), step.exposure_gradient), ([0.0; 6], [0.0; 2]));
    }
    let after = p.pool.download(&mut gpu).unwrap();
    assert_eq!(bytemuck::cast_slice::<_, u32>(&before), bytemuck::cast_slice::<_, u32>(&after));
}

/// Every second cell, and none that is hidden.
fn filled() -> Absent {
    let mut absent = Absent::default();
    (0..CELLS).filter(|cell| cell % 2 == 0).for_each(|cell| absent.filled.insert(cell));
    absent
}

fn is_filled(i: usize) -> bool {
    let (w, h) = SIZE;
    filled().filled.contains(cell_of((i % w) as f64, (i / w) as f64, w, h))
}

#[test]
fn the_image_stands_in_behind_the_picture_in_its_exposure() {
    let (w, h) = SIZE;
    let v = view(w, h);
    for channels in [1, 3] {
        let (mut gpu, mut p) = open(Shape { channels, ..shape(&v, 512, 1 << 16) });
        p.pool.append(&mut gpu, scene(200, &v, 9)).unwrap();
        let planes: Vec<u8> =
            (0..channels as u8).flat_map(|c| target(w, h).into_iter().map(move |l| l / (c + 1))).collect();
        p.loss.set_image(&mut gpu, 0, &vec![7; planes.len()]).unwrap();
        p.loss.set_image(&mut gpu, 1, &planes).unwrap();
        let picture = render(&mut gpu, &mut p, &v);
        let exposure = Exposure { gain: 1.3, offset: -0.07 };
        let part = Target { absent: Some(filled()), exposure, ..Target::from(1) };
        p.train(&mut gpu, &v, part, Some(&STILL), &Weights::default()).unwrap();
        let mut got = vec![0f32; planes.len()];
        gpu.download(p.renderer.rendered, 0, &mut got).unwrap();
        let through = |i: usize| if is_filled(i) { 1.0 - f64::from(picture.alpha[i]) } else { 0.0 };
        let want = planes.into_iter().enumerate().map(|(i, level)| {
            let light = (f64::from(level) / 255.0 - exposure.offset) / exposure.gain;
            f64::from(picture.colour[i]) + through(i % (w * h)) * light
        });
        let error = worst(wide(&got), want.collect::<Vec<_>>());
        assert!(error < 1e-5, "{channels} channels: off by {error}");
        let filled = || (0..w * h).filter(|i| is_filled(*i)).map(|i| picture.alpha[i]);
        assert!(filled().any(|a| a < 0.3) && filled().any(|a| a > 0.8));
    }
}

#[test]
fn gradients_before_the_image_agree_with_their_twin() {
    let (w, h) = SIZE;
    let v = view(w, h);
    let (mut gpu, mut p) = open(shape(&v, 256, 1 << 16));
    let splats = scene(200, &v, 9);
    p.pool.append(&mut gpu, &splats).unwrap();
    p.loss.set_image(&mut gpu, 1, &target(w, h)).unwrap();
    let alpha = render(&mut gpu, &mut p, &v).alpha;
    let weights = Weights { ssim: 0.2, needle: 0.0, scale: 0.0, scale_soft_m: 1.0, opacity: 0.0 };
    let part = Target { absent: Some(filled()), ..Target::from(1) };
    let step = p.train(&mut gpu, &v, part, Some(&STILL), &weights).unwrap();

    let goal: Vec<f64> = target(w, h).iter().map(|level| f64::from(*level) / 255.0).collect();
    let backdrop: Vec<f64> = goal.iter().enumerate().map(|(i, g)| if is_filled(i) { *g } else { 0.0 }).collect();
    let seen: Vec<u8> = alpha.iter().map(|a| if *a < 0.5 { 0 } else { 255 }).collect();
    let doubles: Vec<_> = splats.iter().map(twins::project::parameters).collect();
    let twin = twins::step(&backdrop, &doubles, &v, &[0.0; 6], &goal, &seen, 0.2);
    // A mean over all pixels, and over those that are compared.
    let part = seen.iter().filter(|s| **s != 0).count() as f64 / (w * h) as f64;
    assert!(part > 0.2 && (step.l1 - twin.loss.l1 * part).abs() < 1e-5, "{} {}", step.l1, twin.loss.l1 * part);
    let by_splat: Vec<_> = twin.splats.iter().map(|g| g.map(|v| v * part)).collect();
    let errors = by_group(&mut gpu, &p, &by_splat).unwrap();
    for ((name, _), error) in GROUPS.iter().zip(errors) {
        assert!(error < 1e-3, "{name} is {error} of the largest off");
    }
    // R <- R Exp(θ) moves points by Exp(-θ), p <- p + δ by -Rᵀδ.
    let (rho, phi) = (glam::DVec3::from_slice(&twin.twist[..3]), glam::DVec3::from_slice(&twin.twist[3..]));
    let (dp, turn) = (-(v.world_from_cam.q * rho) * part, -phi * part);
    let pose = [dp.x, dp.y, dp.z, turn.x, turn.y, turn.z];
    let scale = pose.iter().fold(0.0f64, |m, g| m.max(g.abs()));
    let error = worst(step.pose_gradient, pose);
    assert!(error < 1e-3 * scale, "pose off by {error} of {scale}");
}

/// A wall close before the camera that hides all.
fn wall(v: &stipple::map::View) -> Vec<Gaussian> {
    let at = |x: i32, y: i32| {
        let p = v.world_from_cam.transform(glam::DVec3::new(0.1 * f64::from(x), 0.1 * f64::from(y), 0.5));
        let [x, y, z, w] = v.world_from_cam.q.as_quat().to_array();
        Gaussian {
            mean: p.as_vec3().to_array(),
            log_scale: [-2.0, -2.0, -4.0],
            quat_xyzw: [x, y, z, w],
            opacity_logit: 6.0,
            colour: [0.5; 3],
        }
    };
    (-5..=5).flat_map(|y| (-5..=5).map(move |x| (x, y))).map(|(x, y)| at(x, y)).collect()
}

#[test]
fn what_stands_behind_a_wall_is_not_worn_away() {
    let (w, h) = SIZE;
    let v = view(w, h);
    let (mut gpu, mut p) = open(shape(&v, 1024, 1 << 17));
    let n = p.pool.append(&mut gpu, scene(500, &v, 9)).unwrap();
    p.loss.set_image(&mut gpu, 0, &target(w, h)).unwrap();
    train(&mut gpu, &mut p, &v, 40);
    let learnt = psnr(&render(&mut gpu, &mut p, &v).colour, &target(w, h));
    let (known, seen) = (p.pool.download(&mut gpu).unwrap(), moments(&mut gpu, &p, n));
    p.pool.append(&mut gpu, wall(&v)).unwrap();
    // The wall is trained on a picture of its own.
    p.loss.set_image(&mut gpu, 0, &vec![90; w * h]).unwrap();
    train(&mut gpu, &mut p, &v, 40);
    let now = p.pool.download(&mut gpu).unwrap();
    let moved = (0..n).filter(|i| now[*i] != known[*i]).count();
    // A few stand beside the wall or before it.
    assert!(moved < n / 10, "{moved} of {n} moved");
    assert_eq!(moments(&mut gpu, &p, n).iter().zip(&seen).filter(|(a, b)| a == b).count(), n - moved);
    assert!(learnt > 15.0);
}
