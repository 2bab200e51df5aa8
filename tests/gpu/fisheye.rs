//! Kannala-Brandt images splatted as they are: kernels against twins and twins against differences, from the
//! axis to beyond 90 degrees off it.

use super::splat::{compare_differences, compare_step, open, render, shape, train, view, Rng};
use super::twins;
use glam::{DVec2, DVec3};
use stipple::map::{Fisheye, Gaussian, Shape, View};
use stipple::stereo::Pinhole;
use stipple_drivers::{Camera, Lens};

/// Distortion of TUM-VI's cameras.
const K: [f64; 4] = [0.0034, 0.0008, -0.0017, 0.0003];

/// Sees about 95 degrees off its axis at the sides, and more in the corners.
pub fn wide_view(width: usize, height: usize) -> View {
    let f = 0.3 * width as f64;
    let camera =
        Pinhole { width, height, fx: f, fy: 1.05 * f, cx: 0.5 * width as f64 - 0.3, cy: 0.5 * height as f64 + 0.4 };
    View { fisheye: Some(Fisheye::new(K, &camera)), camera, ..view(width, height) }
}

/// A Gaussian at an angle off the axis, at an azimuth and a distance.
fn at(v: &View, theta: f64, phi: f64, range: f64, r: &mut Rng) -> Gaussian {
    let d = DVec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos());
    Gaussian {
        mean: v.world_from_cam.transform(d * range).as_vec3().to_array(),
        log_scale: std::array::from_fn(|_| r.uniform(-3.0, -1.0) as f32),
        quat_xyzw: std::array::from_fn(|_| r.uniform(-1.0, 1.0) as f32),
        opacity_logit: r.uniform(-3.0, 3.0) as f32,
        colour: [r.uniform(0.05, 0.95) as f32; 3],
    }
}

pub fn around(n: usize, v: &View, seed: u64) -> Vec<Gaussian> {
    let mut r = Rng(seed);
    let mut one = |i: usize| {
        let theta = match i % 4 {
            0 => r.uniform(1e-4, 0.12),
            1 => r.uniform(1.4, 1.9),
            _ => r.uniform(0.0, 3.1),
        };
        let (phi, range) = (r.uniform(-3.1, 3.1), r.uniform(0.7, 4.0));
        at(v, theta, phi, range, &mut r)
    };
    (0..n).map(&mut one).collect()
}

#[test]
fn gradients_agree_with_finite_differences_near_the_axis_and_past_90_degrees() {
    let v = wide_view(25, 19);
    compare_differences(&v, &around(24, &v, 5));
}

#[test]
fn kernels_agree_with_their_twins() {
    for (w, h, seed) in [(33, 21, 1), (64, 48, 2)] {
        let v = wide_view(w, h);
        compare_step(&v, &around(60, &v, seed), None);
    }
}

/// Projection and its derivatives alone, on a fine grid of angles: the images of f32 and f64 differ by less than
/// 1e-3 px, and the twin's centre is the calibrated camera's.
#[test]
fn every_angle_projects_as_the_calibrated_camera_does() {
    let v = wide_view(64, 48);
    let (c, f) = (v.camera, v.fisheye.unwrap());
    let camera =
        Camera { width: 64, height: 48, fx: c.fx, fy: c.fy, cx: c.cx, cy: c.cy, lens: Lens::KannalaBrandt { k: K } };
    let mut r = Rng(1);
    let angles: Vec<f64> = (0..100).map(|i| f64::from(i) * 0.031 + 1e-5).collect();
    let splats: Vec<Gaussian> = angles.iter().map(|t| at(&v, *t, 40.0 * t, 1.0 + t, &mut r)).collect();
    let (mut gpu, mut p) = open(shape(&v, 100, 1 << 16));
    p.pool.append(&mut gpu, &splats).unwrap();
    render(&mut gpu, &mut p, &v);
    let (mut runs, mut projected) = (vec![[0u32; 2]; 100], vec![Default::default(); 100]);
    gpu.download(p.renderer.lists.buffers.runs, 0, &mut runs).unwrap();
    let visible = runs.iter().map(|[from, to]| from < to).collect::<Vec<_>>();
    gpu.download(p.renderer.projected, 0, &mut projected).unwrap();
    let mut drawn = 0;
    for (i, s) in splats.iter().enumerate() {
        let twin = twins::project::project(&twins::project::parameters(s), &v, &[0.0; 6]);
        if (angles[i] - f.theta_max).abs() > 1e-4 {
            assert_eq!(twin.is_some(), angles[i] < f.theta_max, "{}", angles[i]);
        }
        let Some(twin) = twin else {
            assert!(!visible[i], "{} rad is beyond the lens", angles[i]);
            continue;
        };
        let p_cam = v.world_from_cam.inverse().transform(glam::Vec3::from(s.mean).as_dvec3());
        let px = camera.project(p_cam).unwrap();
        assert!((px - DVec2::new(twin[0].v, twin[1].v)).length() < 1e-9, "{}", angles[i]);
        if visible[i] {
            let got = projected[i].centre_conic;
            let error = DVec2::new(f64::from(got[0]) - 0.5 - px.x, f64::from(got[1]) - 0.5 - px.y).length();
            assert!(error < 1e-3, "{} rad: off by {error} px", angles[i]);
            drawn += 1;
        }
    }
    assert!(drawn > 40, "{drawn}");
}

#[test]
fn angles_end_where_the_image_or_the_growth_of_the_radius_does() {
    let camera = Pinhole { width: 64, height: 48, fx: 20.0, fy: 20.0, cx: 31.5, cy: 23.5 };
    // D = θ: the corner is at hypot(32, 24) / 20 = 2 rad.
    let plain = Fisheye::new([0.0; 4], &camera);
    assert!((plain.theta_max - 2.1).abs() < 2e-3, "{}", plain.theta_max);
    // D' = 1 - 0.3 θ² is zero at 1.826 rad.
    let folding = Fisheye::new([-0.1, 0.0, 0.0, 0.0], &camera);
    assert!((folding.theta_max - (1.0f64 / 0.3).sqrt()).abs() < 2e-3, "{}", folding.theta_max);
    assert!(Fisheye::new([0.0; 4], &Pinhole { fx: 1.0, fy: 1.0, ..camera }).theta_max < 3.0);
}

#[test]
fn a_map_trains_on_a_fisheye_image() {
    let v = wide_view(64, 48);
    let (mut gpu, mut p) = open(shape(&v, 600, 1 << 16));
    p.pool.append(&mut gpu, around(600, &v, 7)).unwrap();
    let goal: Vec<u8> = (0..64 * 48).map(|i| (128.0 + 90.0 * ((i % 64) as f64 * 0.2).sin()) as u8).collect();
    p.loss.set_image(&mut gpu, 0, &goal).unwrap();
    let steps = train(&mut gpu, &mut p, &v, 100);
    assert!(steps[99].loss < 0.5 * steps[0].loss, "{} -> {}", steps[0].loss, steps[99].loss);
}

#[test]
#[should_panic(expected = "views are of the lenses that the map was made with")]
fn a_map_without_fisheyes_takes_no_view_of_one() {
    let v = wide_view(64, 48);
    let (mut gpu, mut p) = open(Shape { fisheye: false, ..shape(&v, 60, 1 << 12) });
    p.pool.append(&mut gpu, around(60, &v, 7)).unwrap();
    render(&mut gpu, &mut p, &v);
}
