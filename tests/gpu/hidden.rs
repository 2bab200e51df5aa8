//! What a view does not show, or where it is not compared, does not change. Twin of mask_cells.comp: `both`, the mask less the
//! hidden cells, made on the host.

use super::splat::{mask, open, psnr, render, scene, shape, target, train, view, wide, worst, FAST, STILL};
use stipple::gpu::kernels::types::Moments;
use stipple::gpu::Gpu;
use stipple::map::horizon::{cell_of, Cells, CELLS};
use stipple::map::{Gaussian, Pipeline, Target, Weights};

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
    let part = Target { hidden, incomplete: true, ..Target::from(0) };
    let values = p.loss.values(&part);
    let by_cells = p.train(&mut gpu, &v, part, &STILL, &Weights::default()).unwrap();
    let gradient = pixel_gradient(&mut gpu, &p);

    let both: Vec<u8> = seen.iter().enumerate().map(|(i, m)| if is_hidden(i) { 0 } else { *m }).collect();
    p.loss.set_mask(&mut gpu, 0, &both).unwrap();
    let whole = Target::from(0);
    // Each is a mean over the pixels of its camera's mask.
    let ratio = p.loss.values(&whole) / values;
    let by_mask = p.train(&mut gpu, &v, whole, &STILL, &Weights::default()).unwrap();
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
        let step =
            p.train(&mut gpu, &v, Target { hidden, incomplete: true, ..Target::from(0) }, &FAST, &weights).unwrap();
        assert_eq!((step.pose_gradient.map(f64::abs), step.exposure_gradient), ([0.0; 6], [0.0; 2]));
    }
    let after = p.pool.download(&mut gpu).unwrap();
    assert_eq!(bytemuck::cast_slice::<_, u32>(&before), bytemuck::cast_slice::<_, u32>(&after));
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
