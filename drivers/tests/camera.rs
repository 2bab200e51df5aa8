//! Camera models against finite differences and against their own inverses, for lenses of real
//! calibrations (copied here, so that the tests need no recordings), for the recordings' files, and for random lenses.
#![allow(clippy::unwrap_used)]

use glam::{DVec2, DVec3};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use std::f64::consts::{PI, TAU};
use std::path::{Path, PathBuf};
use stipple_drivers::replay::{read_calibration, OpenOptions, Recording};
use stipple_drivers::{Camera, Lens};

fn camera(width: usize, height: usize, f: [f64; 4], lens: Lens) -> Camera {
    Camera { width, height, fx: f[0], fy: f[1], cx: f[2], cy: f[3], lens }
}

/// EuRoC with radtan, EuRoC with double sphere, TUM-VI, Odyssey+ (whose polynomial turns at 73°), MSDMI, a pinhole, and Reverb G2's
/// rational lens.
fn cameras() -> [Camera; 7] {
    let euroc = [458.654, 457.296, 367.215, 248.375];
    let radtan = Lens::Radtan { k1: -0.28340811, k2: 0.07395907, p1: 0.00019359, p2: 1.76187114e-5 };
    let kb = |k: [f64; 4]| Lens::KannalaBrandt { k };
    let ds = Lens::DoubleSphere { xi: -0.2409573942178872, alpha: 0.566996899163044 };
    let tumvi = kb([0.0101710798924, -0.0108164400299, 0.0059427817694, -0.0016622846678]);
    let odyssey = kb([0.0786766526, -0.0308476692, 0.2085084554, -0.1196923005]);
    let msdmi = kb([0.19293820, 0.04211519, -0.23311489, 0.09541027]);
    let k = [0.7516374494, 0.7934193236, 0.0087763195, 1.0123613902, 0.9222284151, 0.1074828058];
    let reverb = Lens::rational(k, -4.8035549e-4, -4.2050202e-5, 2.81754300);
    [
        camera(752, 480, euroc, radtan),
        camera(752, 480, [349.756, 348.724, 365.894, 249.329], ds),
        camera(1024, 1024, [380.81, 380.81, 510.29, 514.33], tumvi),
        camera(640, 480, [268.196, 268.057, 323.317, 245.752], odyssey),
        camera(960, 960, [420.527, 420.668, 469.483, 479.137], msdmi),
        camera(320, 240, [160.0, 160.0, 159.5, 119.5], Lens::Radtan { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0 }),
        camera(640, 480, [269.609741733, 269.280539502, 323.1000444905, 228.7320446824], reverb),
    ]
}

fn bearing(theta: f64, phi: f64) -> DVec3 {
    DVec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos())
}

/// Largest relative difference between the Jacobian and central differences.
fn jacobian_error(c: &Camera, p: DVec3) -> Option<f64> {
    let (_, j) = c.project_with_jacobian(p)?;
    let h = 1e-6 * p.length();
    let mut worst: f64 = 0.0;
    for axis in 0..3 {
        let d = DVec3::AXES[axis] * h;
        let n = (c.project(p + d)? - c.project(p - d)?) / (2.0 * h);
        let scale = (c.fx / p.length()).max(n.length());
        worst = worst.max((n.x - j[0][axis]).abs() / scale).max((n.y - j[1][axis]).abs() / scale);
    }
    Some(worst)
}

#[test]
fn jacobians_are_those_of_the_projection() {
    for (i, c) in cameras().iter().enumerate() {
        let mut tested = 0;
        for theta in [0.0, 1e-10, 1e-8, 1.0001e-8, 1e-7, 1e-6, 1e-4, 0.01, 0.2, 0.5, 0.9, 1.2, 1.4, 1.5, 1.7, 1.9] {
            for phi in (0..12).map(|k| 0.1 + f64::from(k) * PI / 6.0) {
                for distance in [0.05, 1.0, 30.0] {
                    if let Some(error) = jacobian_error(c, bearing(theta, phi) * distance) {
                        assert!(error < 1e-6, "camera {i}, {theta} rad off axis: {error}");
                        tested += 1;
                    }
                }
            }
        }
        assert!(tested >= 11 * 36, "camera {i}: only {tested} points in its domain");
    }
}

/// Every pixel has a bearing of unit length that projects back onto it, but for those of a fisheye
/// that lie outside the circle its lens lights: few, and farther out than all others.
fn assert_round_trip_over_image(c: &Camera, name: &str) {
    let (mut lit, mut dark, mut unlit) = (0.0f64, f64::MAX, 0);
    let across = |n: usize| (0..=40).map(move |i| f64::from(i) / 40.0 * (n as f64 - 1.0));
    for y in across(c.height) {
        for x in across(c.width) {
            let px = DVec2::new(x, y);
            let radius = ((x - c.cx) / c.fx).hypot((y - c.cy) / c.fy);
            let Some(b) = c.unproject(px) else {
                (dark, unlit) = (dark.min(radius), unlit + 1);
                continue;
            };
            lit = lit.max(radius);
            assert!((b.length() - 1.0).abs() < 1e-12);
            let back = c.project(b * 3.0).unwrap_or_else(|| panic!("{name}: {px} has a bearing that has no pixel"));
            assert!((back - px).length() < 1e-6, "{name}: {px} comes back as {back}");
        }
    }
    // tangential distortion makes the rim of a rational lens other than round
    let rim = match c.lens {
        Lens::KannalaBrandt { .. } => 1.0,
        Lens::Rational { .. } => 1.01,
        _ => 0.0,
    };
    let outside = unlit == 0 || unlit < 80 && lit < rim * dark;
    assert!(outside, "{name}: {unlit} of 1681 pixels without a bearing, lit to {lit}, dark from {dark}");
}

#[test]
fn pixels_come_back_over_the_whole_image() {
    for (i, c) in cameras().iter().enumerate() {
        assert_round_trip_over_image(c, &format!("camera {i}"));
    }
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn pixels_come_back_for_every_recorded_calibration() {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    let root = std::env::var_os("STIPPLE_RECORDINGS").map_or_else(beside, PathBuf::from);
    if !root.join("calibration").is_dir() {
        println!("ignored: pixels_come_back_for_every_recorded_calibration: no recordings");
        return;
    }
    let names = ["euroc_double_sphere_basalt", "msdmi_calib", "odysseyplus_kb4_calib", "reverbg2v2_calib"];
    let files = names.map(|name| format!("{name}.json"));
    let folders = ["euroc_MH_01_easy_11s", "euroc_V1_01_easy_static_1s", "tumvi_room1_fisheye_16"];
    let files = files.iter().map(|name| read_calibration(&root.join("calibration").join(name)).unwrap());
    let opened = |name: &&str| Recording::open(&root.join(name), &OpenOptions::default()).unwrap().calibration;
    for (i, calibration) in files.chain(folders.iter().map(opened)).enumerate() {
        for (k, c) in calibration.cameras.iter().enumerate() {
            assert_round_trip_over_image(&c.camera, &format!("calibration {i} camera {k}"));
        }
    }
}

/// Along a ray from the axis outwards the radius grows until the domain ends, and never starts again.
fn assert_domain_is_one_growing_stretch(c: &Camera, phi: f64, name: &str) -> f64 {
    const STEPS: u32 = 2000;
    let (mut last, mut ended) = (-1.0, None);
    for i in 0..STEPS {
        let theta = PI * f64::from(i) / f64::from(STEPS);
        match (c.project(bearing(theta, phi)), ended) {
            (Some(px), None) => {
                let m = DVec2::new((px.x - c.cx) / c.fx, (px.y - c.cy) / c.fy);
                assert!(m.length() > last, "{name}: radius shrinks at {theta} rad");
                last = m.length();
                // near the edge of the domain the lens squeezes all bearings into one pixel
                if let Some(b) = c.unproject(px) {
                    assert!(b.angle_between(bearing(theta, phi)) < 1e-4, "{name}: wrong bearing at {theta} rad");
                }
            }
            (None, None) => ended = Some(theta),
            (None, Some(_)) => {}
            (Some(_), Some(end)) => panic!("{name}: ended at {end} rad, began again at {theta} rad"),
        }
    }
    ended.unwrap_or(PI)
}

#[test]
fn domain_is_one_growing_stretch_from_the_axis() {
    // degrees off axis at which each domain ends
    let ends = [89.4..89.6, 100.0..180.0, 103.0..108.0, 70.0..76.0, 70.0..180.1, 89.4..89.6, 70.0..70.5];
    for ((i, c), end) in cameras().iter().enumerate().zip(ends) {
        for phi in [0.0, 0.4, 2.0, 4.0] {
            let found = assert_domain_is_one_growing_stretch(c, phi, &format!("camera {i}")).to_degrees();
            assert!(end.contains(&found), "camera {i}: domain ends at {found} degrees");
        }
    }
}

#[test]
fn points_that_no_camera_sees_have_no_pixel() {
    for c in cameras() {
        for p in [DVec3::ZERO, DVec3::NAN, DVec3::new(0.0, 0.0, -1.0), DVec3::new(f64::INFINITY, 0.0, 1.0)] {
            assert_eq!(c.project(p), None, "{p} in {c:?}");
        }
        for px in [DVec2::NAN, DVec2::INFINITY, DVec2::new(1e30, 0.0)] {
            if let Some(b) = c.unproject(px) {
                assert!(b.is_finite() && (b.length() - 1.0).abs() < 1e-9, "{px} -> {b} in {c:?}");
            }
        }
    }
}

#[test]
fn barrel_distortion_does_not_fold_back_into_the_image() {
    // r (1 - 0.3 r²) turns at r = 1.054: beyond it the image radius shrinks again
    let c = camera(640, 480, [300.0, 300.0, 320.0, 240.0], Lens::Radtan { k1: -0.3, k2: 0.0, p1: 0.0, p2: 0.0 });
    assert!(c.project(DVec3::new(1.05, 0.0, 1.0)).is_some());
    assert_eq!(c.project(DVec3::new(1.06, 0.0, 1.0)), None);
    assert_eq!(c.unproject(DVec2::new(320.0 + 300.0 * 0.8, 240.0)), None, "nothing reaches that radius");
    let b = c.unproject(DVec2::new(320.0 + 300.0 * 0.6, 240.0)).unwrap();
    assert!((b.x / b.z) < 1.054, "the inner of two preimages");
}

/// Radtan with tangential terms up to `tangential`, Kannala-Brandt, double sphere.
fn lens(tangential: f64) -> impl Strategy<Value = Lens> {
    let radtan =
        (-0.5..0.5, -0.3..0.3, -1.0..1.0, -1.0..1.0).prop_map(move |(k1, k2, p1, p2): (f64, f64, f64, f64)| {
            Lens::Radtan { k1, k2, p1: p1 * tangential, p2: p2 * tangential }
        });
    let kb = [-0.3..0.3, -0.3..0.3, -0.3..0.3, -0.15..0.15f64].prop_map(|k| Lens::KannalaBrandt { k });
    let ds = (-0.9..0.9f64, 0.0..1.0f64).prop_map(|(xi, alpha)| Lens::DoubleSphere { xi, alpha });
    prop_oneof![radtan, kb, ds]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 1000, failure_persistence: None, rng_seed: RngSeed::Fixed(1), ..ProptestConfig::default() })]

    #[test]
    fn random_lenses_have_one_growing_domain(lens in lens(0.0), phi in 0.0..TAU) {
        assert_domain_is_one_growing_stretch(&camera(640, 480, [300.0, 300.0, 320.0, 240.0], lens), phi, "random");
    }

    #[test]
    fn random_lenses_invert_and_differentiate(lens in lens(1e-3), theta in 0.0..2.0f64, phi in 0.0..TAU) {
        let c = camera(640, 480, [300.0, 300.0, 320.0, 240.0], lens);
        let p = bearing(theta, phi);
        // within 0.02 rad of the end of the domain derivatives grow or vanish without bound
        if let (Some(px), true) = (c.project(p), c.project(bearing(theta + 0.02, phi)).is_some()) {
            let b = c.unproject(px);
            prop_assert!(b.is_some_and(|b| b.angle_between(p) < 1e-6), "{p} -> {px} -> {b:?}");
            if let Some(error) = jacobian_error(&c, p) {
                prop_assert!(error < 1e-4, "Jacobian off by {error}");
            }
        }
    }
}
