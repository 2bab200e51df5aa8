//! Properties of the simulator: its sensors agree with its path and with each other, it is
//! reproducible, and recorded flights stay in their room.

#![allow(clippy::unwrap_used)]

use glam::{DMat3, DQuat, DVec2, DVec3};
use std::path::PathBuf;
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::sim::{rig_named, write_euroc, Flight, Scenario, Sim, GRAVITY, RIGS};
use stipple_drivers::source::Aid;
use stipple_drivers::{Camera, FaultKind, Frames, ImuCalibration, Lens, Nanos, Pose, Span};

fn quiet(name: &str) -> Scenario {
    let mut s = Scenario::named(name).unwrap();
    s.calibration.imu =
        ImuCalibration { gyro_noise: 0.0, gyro_walk: 0.0, accel_noise: 0.0, accel_walk: 0.0, ..s.calibration.imu };
    s.imu_errors.gyro_bias = 0.0;
    s.imu_errors.accel_bias = 0.0;
    s.sensor.read_noise = 0.0;
    s.sensor.shot_noise = 0.0;
    s.sensor.vignette = 0.0;
    s
}

fn recordings(test: &str) -> Option<PathBuf> {
    let root = std::env::var_os("STIPPLE_RECORDINGS").map(PathBuf::from);
    let root = root.unwrap_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../shared/data"));
    if !root.join("euroc_text").is_dir() {
        println!("ignored: {test}: no recordings");
        return None;
    }
    Some(root)
}

#[test]
fn integrating_the_noise_free_imu_reproduces_the_path() {
    for name in ["demo", "circle", "aggressive", "patrol-two"] {
        let mut scenario = quiet(name);
        scenario.image_divisor = 4;
        let sim = Sim::new(&scenario).unwrap();
        let start = sim.truth_at(sim.stamp(0));
        let (mut q, mut p, mut v) = (start.pose.q, start.pose.p, start.v_world);
        // Simpson's rule over pairs of sample intervals
        let mut worst: f64 = 0.0;
        for s in sim.imu().windows(3).step_by(2) {
            let h = (s[2].t - s[0].t).secs();
            let turn = |w: DVec3| DQuat::from_scaled_axis(w);
            let half = turn(h / 24.0 * (5.0 * s[0].gyro_body + 8.0 * s[1].gyro_body - s[2].gyro_body));
            let cross = h * h / 12.0 * s[0].gyro_body.cross(s[2].gyro_body);
            let whole = turn(h / 6.0 * (s[0].gyro_body + 4.0 * s[1].gyro_body + s[2].gyro_body) + cross);
            let a0 = q * s[0].accel_body + GRAVITY;
            let a1 = q * half * s[1].accel_body + GRAVITY;
            let a2 = q * whole * s[2].accel_body + GRAVITY;
            p += h * v + h * h / 6.0 * (a0 + 2.0 * a1);
            v += h / 6.0 * (a0 + 4.0 * a1 + a2);
            q = (q * whole).normalize();
            worst = worst.max((p - sim.truth_at(s[2].t).pose.p).length());
        }
        println!("{name}: {:.3} mm", worst * 1e3);
        assert!(worst < 2e-3, "{name}: {worst} m");
    }
}

#[test]
fn flights_begin_with_a_second_at_rest_and_keep_to_their_speed() {
    for (name, v_max, w_max) in [
        ("static", 1e-9, 1e-9),
        ("hover", 0.7, 0.6),
        ("circle", 1.6, 1.6),
        ("demo", 1.8, 2.0),
        ("aggressive", 4.5, 4.5),
        ("patrol-two", 1.2, 1.05),
    ] {
        let mut scenario = quiet(name);
        scenario.image_divisor = 4;
        let sim = Sim::new(&scenario).unwrap();
        let (mut v, mut w): (f64, f64) = (0.0, 0.0);
        for s in sim.imu() {
            let state = sim.truth_at(s.t);
            if (s.t - sim.stamp(0)).secs() < 0.9 {
                assert!(state.v_world.length() < 1e-9 && s.gyro_body.length() < 1e-9, "{name} moves at {:?}", s.t);
                assert!((s.accel_body.length() - 9.81).abs() < 1e-9);
            }
            v = v.max(state.v_world.length());
            w = w.max(s.gyro_body.length());
        }
        println!("{name}: {v:.2} m/s, {w:.2} rad/s");
        assert!(v <= v_max && w <= w_max, "{name}: {v} m/s, {w} rad/s");
    }
}

#[test]
fn inertial_noise_has_the_stated_density_and_biases_are_told() {
    let scenario = Scenario {
        duration: Span::from_secs(60.0),
        rate_hz: 1.0,
        image_divisor: 4,
        ..Scenario::named("static").unwrap()
    };
    let sim = Sim::new(&scenario).unwrap();
    let noise = scenario.calibration.imu;
    let pose = sim.truth_at(sim.stamp(0)).pose;
    let (mut g, mut a) = (0.0, 0.0);
    for s in sim.imu() {
        let truth = sim.truth_at(s.t);
        g += (s.gyro_body - truth.gyro_bias).length_squared() / 3.0;
        a += (s.accel_body - truth.accel_bias + pose.q.conjugate() * GRAVITY).length_squared() / 3.0;
    }
    let n = sim.imu().len() as f64;
    let (g, a) = ((g / n).sqrt(), (a / n).sqrt());
    let root = noise.rate_hz.sqrt();
    assert!((g / (noise.gyro_noise * root) - 1.0).abs() < 0.03, "{g}");
    assert!((a / (noise.accel_noise * root) - 1.0).abs() < 0.03, "{a}");
    let drift = sim.truth_at(Nanos(61_000_000_000)).accel_bias - sim.truth_at(sim.stamp(0)).accel_bias;
    let expected = noise.accel_walk * 60f64.sqrt() * 3f64.sqrt();
    assert!(drift.length() > 0.1 * expected && drift.length() < 3.0 * expected, "{drift}");
}

#[test]
fn inertial_samples_saturate_at_the_range() {
    let mut scenario = Scenario::named("aggressive").unwrap();
    scenario.image_divisor = 4;
    scenario.imu_errors.gyro_max = 1.0;
    scenario.imu_errors.accel_max = 9.0;
    let sim = Sim::new(&scenario).unwrap();
    let most = sim
        .imu()
        .iter()
        .fold((DVec3::ZERO, DVec3::ZERO), |m, s| (m.0.max(s.gyro_body.abs()), m.1.max(s.accel_body.abs())));
    assert_eq!(most.0.max_element(), 1.0);
    assert_eq!(most.1.max_element(), 9.0);
}

fn sample(image: &stipple_drivers::Image, px: DVec2) -> f64 {
    let (x, y) = (px.x as usize, px.y as usize);
    let (a, b) = (px.x.fract(), px.y.fract());
    let at = |dx: usize, dy: usize| image.at(x + dx, y + dy) as f64;
    (at(0, 0) * (1.0 - a) + at(1, 0) * a) * (1.0 - b) + (at(0, 1) * (1.0 - a) + at(1, 1) * a) * b
}

#[test]
fn points_of_the_depth_map_look_alike_in_the_other_camera() {
    let mut sim = Sim::new(&Scenario { image_divisor: 1, ..quiet("demo") }).unwrap();
    let rig = sim.calibration().clone();
    let (c0, c1) = (&rig.cameras[0], &rig.cameras[1]);
    let cam1_from_cam0 = c1.body_from_cam.inverse() * c0.body_from_cam;
    let mut frames = Frames::for_rig(&rig);
    let (w, h) = (c0.camera.width, c0.camera.height);
    let (mut z0, mut z1) = (vec![0.0f32; w * h], vec![0.0f32; w * h]);
    for frame in [0, 100, 160] {
        sim.render(frame, &mut frames);
        sim.depth(frame, 0, &mut z0);
        sim.depth(frame, 1, &mut z1);
        let (mut near, mut shifted, mut spread) = (Vec::new(), Vec::new(), Vec::new());
        for i in (0..w * h).step_by(53) {
            let b = c0.camera.unproject(DVec2::new((i % w) as f64, (i / w) as f64)).unwrap();
            let p = cam1_from_cam0.transform(b * (z0[i] as f64 / b.z));
            let Some(px) = c1.camera.project(p).filter(|px| c1.camera.contains(*px, 12.0)) else { continue };
            let k = px.y.round() as usize * w + px.x.round() as usize;
            spread.push((z1[k] as f64 / p.z - 1.0).abs());
            let level = frames.images[0].pixels[i] as f64;
            if level < 240.0 {
                near.push((sample(&frames.images[1], px) / 1.03 - level).abs());
                shifted.push((sample(&frames.images[1], px + DVec2::new(4.0, 0.0)) / 1.03 - level).abs());
            }
        }
        let median = |v: &mut Vec<f64>| {
            v.sort_by(f64::total_cmp);
            v[v.len() / 2]
        };
        let (near, shifted, spread) = (median(&mut near), median(&mut shifted), median(&mut spread));
        println!("frame {frame}: grey {near:.2} (4 px off: {shifted:.2}), depth {spread:.5}");
        assert!(near < 3.0 && shifted > 2.0 * near, "frame {frame}: {near} {shifted}");
        assert!(spread < 2e-3, "frame {frame}: {spread}");
    }
}

#[test]
fn the_same_seed_gives_the_same_bytes_on_any_number_of_threads() {
    let scenario = Scenario::named("demo").unwrap();
    let shoot = |scenario: &Scenario, threads: usize, order: [usize; 2]| {
        let mut sim = Sim::with_threads(scenario, threads).unwrap();
        let mut frames = Frames::for_rig(sim.calibration());
        let mut shots = [Vec::new(), Vec::new()];
        for i in order {
            sim.render(i * 100, &mut frames);
            shots[i] = frames.images.clone();
        }
        (shots, sim.imu().to_vec())
    };
    let one = shoot(&scenario, 1, [0, 1]);
    assert!(one == shoot(&scenario, 2, [1, 0]));
    assert!(one == shoot(&scenario, 5, [0, 1]));
    let other = shoot(&Scenario { seed: 2, ..scenario }, 1, [0, 1]);
    assert!(one.0 != other.0 && one.1 != other.1);
}

#[test]
fn frames_have_texture_almost_everywhere_and_plausible_exposure() {
    const CELL: usize = 50;
    for name in Scenario::names() {
        let mut sim = Sim::new(&Scenario { image_divisor: 1, ..Scenario::named(name).unwrap() }).unwrap();
        let mut frames = Frames::for_rig(sim.calibration());
        let (mut cells, mut rich, mut worst_mean) = (0, 0, (255.0f64, 0.0f64));
        for k in 0..6 {
            sim.render(k * (sim.frame_count() - 1) / 5, &mut frames);
            for image in &frames.images {
                let mean = image.pixels.iter().map(|p| *p as f64).sum::<f64>() / image.pixels.len() as f64;
                worst_mean = (worst_mean.0.min(mean), worst_mean.1.max(mean));
                for (cx, cy) in
                    (0..image.height / CELL).flat_map(|y| (0..image.width / CELL).map(move |x| (x * CELL, y * CELL)))
                {
                    let mut tensor = [0.0f64; 3];
                    for (x, y) in (cy + 1..cy + CELL - 1).flat_map(|y| (cx + 1..cx + CELL - 1).map(move |x| (x, y))) {
                        let gx = image.at(x + 1, y) as f64 - image.at(x - 1, y) as f64;
                        let gy = image.at(x, y + 1) as f64 - image.at(x, y - 1) as f64;
                        tensor = [tensor[0] + gx * gx, tensor[1] + gx * gy, tensor[2] + gy * gy];
                    }
                    // the smaller eigenvalue: gradients in both directions, as a corner has
                    let [a, b, c] = tensor.map(|t| t / (CELL * CELL) as f64);
                    let small = 0.5 * (a + c) - (0.25 * (a - c) * (a - c) + b * b).sqrt();
                    cells += 1;
                    rich += (small > 30.0) as usize; // noise alone gives about 15
                }
            }
        }
        println!("{name}: {rich} of {cells} cells, means {worst_mean:.0?}");
        assert!(rich * 100 > cells * 93, "{name}: {rich} of {cells} cells have texture");
        assert!(worst_mean.0 > 60.0 && worst_mean.1 < 160.0, "{name}: {worst_mean:?}");
    }
}

#[test]
fn a_person_crosses_follows_and_fills_half_the_view_and_hides_what_is_behind() {
    let scenario = Scenario::named("demo").unwrap();
    let mut without = Sim::new(&scenario).unwrap();
    let mut with = Sim::new(&Scenario { person: true, ..scenario }).unwrap();
    let mut frames = [Frames::for_rig(with.calibration()), Frames::for_rig(with.calibration())];
    let (w, h) = (frames[0].images[1].width, frames[0].images[1].height);
    let mut depths = [vec![0.0; w * h], vec![0.0; w * h]];
    // Seconds, least share of the view, and the third of the view it is in the middle of.
    for (t, share, third) in [
        (1.0, 0.0, None),
        (3.2, 0.05, Some(0)),
        (3.4, 0.05, Some(1)),
        (3.6, 0.05, Some(2)),
        (6.4, 0.05, Some(1)),
        (8.7, 0.45, None),
    ] {
        let i = (t * 20.0) as usize;
        for (k, sim) in [&mut without, &mut with].into_iter().enumerate() {
            sim.render(i, &mut frames[k]);
            sim.depth(i, 1, &mut depths[k]);
        }
        let hidden: Vec<usize> = (0..w * h).filter(|i| depths[0][*i] != depths[1][*i]).collect();
        assert!(hidden.iter().all(|i| depths[1][*i] < depths[0][*i]), "{t} s: behind what it hides");
        let seen = hidden.len() as f64 / (w * h) as f64;
        let column = hidden.iter().map(|i| i % w).sum::<usize>() / hidden.len().max(1);
        println!("{t} s: {:.1} % of the view, column {column} of {w}", 100.0 * seen);
        assert!((share..0.6).contains(&seen) && third.is_none_or(|k| 3 * column / w == k), "{t} s: {seen}, {column}");
        // Pixels on its outline are mixed.
        let near = |i: usize| [i, i - 1, i + 1, i - w, i + w].iter().any(|j| depths[0][*j] != depths[1][*j]);
        let pixels = |k: usize| &frames[k].images[1].pixels;
        let spoiled = (w + 1..w * h - w - 1).filter(|i| !near(*i) && pixels(0)[*i] != pixels(1)[*i]).count();
        let same = hidden.iter().filter(|i| pixels(0)[**i] == pixels(1)[**i]).count();
        // A pixel or two where it goes through furniture: the face changes, the depth does not.
        assert!(spoiled < 5 && 10 * same <= hidden.len(), "{t} s: {spoiled} px beside it, {same} px under it");
    }
}

#[test]
fn a_fisheye_camera_is_rendered_over_its_whole_domain() {
    let mut scenario = quiet("circle");
    let k = [0.0034, 0.0007, -0.0020, 0.0002];
    for c in &mut scenario.calibration.cameras {
        c.camera = Camera {
            width: 512,
            height: 512,
            fx: 190.0,
            fy: 190.0,
            cx: 254.5,
            cy: 256.5,
            lens: Lens::KannalaBrandt { k },
        };
    }
    let mut sim = Sim::new(&scenario).unwrap();
    let mut frames = Frames::for_rig(sim.calibration());
    sim.render(90, &mut frames);
    let dark = frames.images[0].pixels.iter().filter(|p| **p == 0).count();
    assert!(dark < 512 * 512 / 100, "{dark} black pixels");
    let mut depth = vec![0.0; 512 * 512];
    sim.depth(90, 0, &mut depth);
    assert!(depth.iter().all(|z| z.is_finite() && *z < 12.0));
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn recorded_flights_stay_in_their_room_and_keep_their_velocity() {
    let Some(root) = recordings("recorded_flights_stay_in_their_room_and_keep_their_velocity") else { return };
    for name in ["MH_04_difficult", "V1_02_medium", "V2_02_medium"] {
        let folder = root.join("euroc_text").join(name);
        let truth = folder.join("state_groundtruth_estimate0.csv");
        let mut scenario = Scenario::from_euroc(&truth, Some(&folder.join("imu0.csv"))).unwrap();
        scenario.image_divisor = 4;
        let sim = Sim::new(&scenario).unwrap();
        let clear = sim.truth().iter().map(|s| sim.clearance(s.pose.p)).fold(f64::INFINITY, f64::min);
        assert!(clear > 0.5, "{name}: {clear} m from a surface");
        let (mut dv, mut dw, mut da, mut n) = (0.0, 0.0, 0.0, 0.0);
        let text = std::fs::read_to_string(&truth).unwrap();
        for row in text.lines().filter(|line| !line.starts_with('#')).step_by(7) {
            let row: Vec<&str> = row.split(',').collect();
            let t = Nanos(row[0].parse().unwrap());
            if t < sim.stamp(0) || t > sim.stamp(sim.frame_count() - 1) {
                continue;
            }
            let f = |i: usize| row[i].trim().parse::<f64>().unwrap();
            let state = sim.truth_at(t);
            dv += (state.v_world - DVec3::new(f(8), f(9), f(10))).length_squared();
            // jumps of the truth are taken out, so late positions may lie a little beside the file's
            assert!((state.pose.p - DVec3::new(f(1), f(2), f(3))).length() < 0.5, "{name} at {}", t.0);
            n += 1.0;
        }
        // what the smoothed path implies against the real inertial samples less their biases
        for s in sim.imu().windows(2).step_by(5) {
            let (a, b) = (sim.truth_at(s[0].t), sim.truth_at(s[1].t));
            let dt = (s[1].t - s[0].t).secs();
            let q = a.pose.q.conjugate() * b.pose.q;
            let w = 2.0 * q.w.signum() * DVec3::new(q.x, q.y, q.z) / dt;
            dw += (w - 0.5 * (s[0].gyro_body + s[1].gyro_body) + a.gyro_bias).length_squared();
            let force = 0.5 * (s[0].accel_body + s[1].accel_body) - a.accel_bias;
            da += ((b.v_world - a.v_world) / dt - a.pose.q * force - GRAVITY).length_squared();
        }
        let samples = sim.imu().len() as f64 / 5.0;
        let (dv, dw, da) = ((dv / n).sqrt(), (dw / samples).sqrt(), (da / samples).sqrt());
        println!("{name}: {clear:.2} m clear; rms against recording {dv:.3} m/s, {dw:.3} rad/s, {da:.2} m/s²");
        assert!(dv < 0.05 && dw < 0.15 && da < 2.0, "{name}: {dv} m/s, {dw} rad/s, {da} m/s²");
        let Flight::Recorded(recording) = &scenario.path else { panic!("a recorded flight") };
        let real = recording.imu.as_ref().unwrap();
        assert!(sim.imu().iter().all(|s| real.binary_search_by_key(&s.t, |r| r.t).is_ok()));
    }
}

#[test]
fn a_written_run_is_whole_and_can_be_flown_again() {
    let parent = tempfile::tempdir().unwrap();
    let dir = parent.path().join("run");
    let scenario = Scenario { duration: Span::from_secs(0.8), image_divisor: 4, ..Scenario::named("hover").unwrap() };
    let mut sim = Sim::new(&scenario).unwrap();
    let mut told = 0;
    write_euroc(&mut sim, &dir, 0, |done, all| {
        assert!(done == told + 1 && all == sim_frames(0.8));
        told = done;
    })
    .unwrap();
    let mav = dir.join("mav0");
    for (sensor, count) in [("cam0", 17), ("cam1", 17), ("depth0", 17)] {
        assert_eq!(std::fs::read_dir(mav.join(sensor).join("data")).unwrap().count(), count);
        let table = std::fs::read_to_string(mav.join(sensor).join("data.csv")).unwrap();
        assert!(table.starts_with("#timestamp [ns],") && table.lines().count() == count + 1);
    }
    assert_eq!(std::fs::read_dir(parent.path()).unwrap().count(), 1, "only the finished folder is there");
    let again = Scenario::from_euroc(
        &mav.join("state_groundtruth_estimate0").join("data.csv"),
        Some(&mav.join("imu0").join("data.csv")),
    );
    let Flight::Recorded(recording) = again.unwrap().path else { panic!("a recorded flight") };
    for (read, made) in recording.poses.iter().zip(sim.truth()) {
        assert!(read.t == made.t && (read.pose.p - made.pose.p).length() < 1e-8);
        let apart = DMat3::from_quat(read.pose.q) - DMat3::from_quat(made.pose.q);
        assert!(apart.to_cols_array().iter().all(|e| e.abs() < 1e-8));
    }
    assert_eq!(recording.imu.unwrap().len(), sim.imu().len());
    let read = Recording::open(&dir, &OpenOptions::default()).unwrap();
    assert!(read.warnings.is_empty(), "{:?}", read.warnings);
    assert!(sim.aids().len() == 41 && read.aids.len() == 41, "50 a second");
    for (read, made) in read.aids.iter().zip(sim.aids()) {
        let [Aid::Pressure(a), Aid::Pressure(b)] = [read, made].map(|a| a.value);
        assert!(read.t == made.t && (a - b).abs() < 1e-4 && (97_000.0..99_000.0).contains(&a), "{a} {b}");
    }
    assert_eq!((read.frames.len(), read.imu.len(), read.truth.len()), (17, sim.imu().len(), sim.imu().len()));
    for (a, b) in read.calibration.cameras.iter().zip(&sim.calibration().cameras) {
        assert_eq!(a.camera, b.camera);
        assert!((a.body_from_cam.inverse() * b.body_from_cam).p.length() < 1e-9);
        assert!(a.body_from_cam.q.angle_between(b.body_from_cam.q) < 1e-7);
    }
    assert_eq!(read.calibration.imu, sim.calibration().imu);
    let (mut shown, mut made) = (Frames::for_rig(&read.calibration), Frames::for_rig(&read.calibration));
    read.reader().read(16, &mut shown).unwrap();
    sim.render(16, &mut made);
    assert!(shown.t == made.t && shown.images == made.images);
    let refused = write_euroc(&mut sim, &dir, 0, |_, _| {}).unwrap_err();
    assert_eq!(refused.kind, FaultKind::NoOutput);
}

fn sim_frames(secs: f64) -> usize {
    (secs * 20.0) as usize + 1
}

#[test]
fn a_failed_write_leaves_nothing_behind() {
    let parent = tempfile::tempdir().unwrap();
    let blocked = parent.path().join("file");
    std::fs::write(&blocked, "in the way").unwrap();
    let scenario = Scenario { duration: Span::from_secs(0.6), image_divisor: 4, ..Scenario::named("static").unwrap() };
    let mut sim = Sim::new(&scenario).unwrap();
    for dir in [blocked.clone(), blocked.join("below")] {
        assert_eq!(write_euroc(&mut sim, &dir, 0, |_, _| {}).unwrap_err().kind, FaultKind::NoOutput);
    }
    assert_eq!(std::fs::read_dir(parent.path()).unwrap().count(), 1);
}

#[test]
fn wrong_csv_is_refused_by_line() {
    let parent = tempfile::tempdir().unwrap();
    let path = parent.path().join("truth.csv");
    let row = |t: &str| format!("{t},0,0,1,1,0,0,0\n");
    for (text, line, word) in [
        (row("1") + &row("x"), 2, "stamp"),
        (row("1") + "2,0,0,1,1,0,0,zero\n", 2, "7 or more numbers"),
        ("#head\n".to_string() + &row("5") + &row("5"), 3, "stamp 5 again"),
        (row("1") + "2,0,0\n", 2, "7 or more numbers"),
        (row("1") + "2,0,0,1,5,0,0,0\n", 2, "quaternion"),
    ] {
        std::fs::write(&path, text).unwrap();
        let fault = Scenario::from_euroc(&path, None).unwrap_err();
        assert_eq!(fault.kind, FaultKind::Data);
        let said = fault.to_string();
        assert!(said.contains(&format!("truth.csv:{line}")) && said.contains(word), "{said}");
    }
    let missing = Scenario::from_euroc(&parent.path().join("none.csv"), None).unwrap_err();
    assert_eq!(missing.kind, FaultKind::NoInput);
    std::fs::write(&path, row("1") + &row("2")).unwrap();
    let short = Sim::new(&Scenario::from_euroc(&path, None).unwrap()).map(|_| ()).unwrap_err();
    assert_eq!(short.kind, FaultKind::Data);
}

#[test]
fn a_time_offset_moves_stamps_and_not_images_and_its_calibration_moves_them_back() {
    let mut scenario = quiet("circle");
    scenario.image_divisor = 4;
    scenario.duration = Span::from_secs(3.0);
    let mut exact = Sim::new(&scenario).unwrap();
    let offset = Span::from_secs(0.008);
    scenario.camera_errors.time_offset = offset;
    let mut late = Sim::new(&scenario).unwrap();
    let mut frames = [Frames::for_rig(exact.calibration()), Frames::for_rig(exact.calibration())];
    exact.render(50, &mut frames[0]);
    late.render(50, &mut frames[1]);
    assert!(frames[0].images == frames[1].images, "the same instant of the flight");
    assert_eq!(frames[1].t + offset, frames[0].t, "t_imu = t_cam + offset");
    assert_eq!(exact.imu(), late.imu());

    let dir = tempfile::tempdir().unwrap();
    let (out, chain) = (dir.path().join("late"), dir.path().join("camchain.yaml"));
    write_euroc(&mut late, &out, 0, |_, _| {}).unwrap();
    let mut text = String::new();
    for (k, c) in exact.calibration().cameras.iter().enumerate() {
        let m = c.camera;
        let pose = c.body_from_cam.inverse();
        let rows: Vec<String> = (0..3)
            .map(|i| {
                let r = DMat3::from_quat(pose.q).row(i);
                format!("[{:.12}, {:.12}, {:.12}, {:.12}]", r.x, r.y, r.z, pose.p[i])
            })
            .collect();
        text += &format!(
            "cam{k}:\n  T_cam_imu: [{}, [0.0, 0.0, 0.0, 1.0]]\n  camera_model: pinhole\n  distortion_model: none\n  \
             intrinsics: [{}, {}, {}, {}]\n  resolution: [{}, {}]\n  timeshift_cam_imu: 0.008\n",
            rows.join(", "),
            m.fx,
            m.fy,
            m.cx,
            m.cy,
            m.width,
            m.height
        );
    }
    std::fs::write(&chain, text).unwrap();
    let options = OpenOptions { calibration: Some(chain), ..OpenOptions::default() };
    let read = Recording::open(&out, &options).unwrap();
    let stamps: Vec<Nanos> = read.frames.iter().map(|p| p.t).collect();
    let taken: Vec<Nanos> = (0..late.frame_count()).map(|i| late.taken(i)).collect();
    assert_eq!(stamps, taken, "Kalibr's shift and ours have the same sign");
}

#[test]
fn a_written_rolling_shutter_comes_back_with_its_middle_rows_at_the_stamp() {
    let mut scenario = Scenario::named("circle").unwrap();
    scenario.image_divisor = 4;
    scenario.duration = Span::from_secs(0.3);
    scenario.calibration.cameras.iter_mut().for_each(|c| c.readout = Span::from_secs(0.02));
    let mut sim = Sim::new(&scenario).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("rolling");
    write_euroc(&mut sim, &out, 0, |_, _| {}).unwrap();
    let read = Recording::open(&out, &OpenOptions::default()).unwrap();
    assert!(read.calibration.cameras.iter().all(|c| c.readout == Span(20_000_000)));
    assert_eq!(read.frames[3].t, sim.stamp(3));
}

#[test]
fn errors_are_in_what_sensors_give_and_not_in_the_calibration_handed_out() {
    let exact = Sim::new(&quiet("circle")).unwrap();
    let mut scenario = quiet("circle");
    let scale = DMat3::from_diagonal(DVec3::new(1.02, 0.99, 1.01));
    (scenario.imu_errors.axes.gyro_scale, scenario.imu_errors.axes.accel_scale) = (scale, scale * 0.98);
    let error = Pose::new(DQuat::from_rotation_x(0.02), DVec3::new(0.005, 0.0, 0.0));
    scenario.camera_errors.extrinsics = vec![Pose::IDENTITY, error];
    let mut sim = Sim::new(&scenario).unwrap();
    for (read, truth) in sim.imu().iter().zip(exact.imu()) {
        let right = scenario.imu_errors.axes.apply(read);
        assert!((right.gyro_body - truth.gyro_body).length() < 1e-12);
        assert!((right.accel_body - truth.accel_body).length() < 1e-12);
        assert!(
            (read.gyro_body.x * 1.02 - truth.gyro_body.x).abs() < 1e-12,
            "reads too little where its scale is large"
        );
    }
    assert_eq!(sim.calibration().imu.correction, exact.calibration().imu.correction);
    let (found, truth) = (sim.calibration().cameras[1].body_from_cam, exact.calibration().cameras[1].body_from_cam);
    assert!((found.p - (truth * error).p).length() < 1e-12 && found != truth);
    let mut frames = [Frames::for_rig(exact.calibration()), Frames::for_rig(exact.calibration())];
    let mut exact = exact;
    exact.render(40, &mut frames[0]);
    sim.render(40, &mut frames[1]);
    assert!(frames[0].images == frames[1].images, "images are of the true rig");
}

#[test]
fn exposure_steps_and_flicker_reach_the_pixels() {
    let mut scenario = quiet("static");
    scenario.image_divisor = 4;
    scenario.light.steps = vec![(Span::from_secs(1.0), 0.5, 0.0), (Span::from_secs(2.0), 1.0, 20.0)];
    let mut sim = Sim::new(&scenario).unwrap();
    let mut frames = Frames::for_rig(sim.calibration());
    let mut grey = |sim: &mut Sim, i: usize| {
        sim.render(i, &mut frames);
        frames.images[0].pixels.iter().map(|p| f64::from(*p)).sum::<f64>() / frames.images[0].pixels.len() as f64
    };
    let (before, dark, lifted) = (grey(&mut sim, 10), grey(&mut sim, 30), grey(&mut sim, 50));
    assert!((dark / before - 0.5).abs() < 0.03 && (lifted - before - 20.0).abs() < 2.0, "{before} {dark} {lifted}");
    // A quarter of a period between frames: light at its mean, its most, its mean, its least; none of it clipped.
    scenario.light = stipple_drivers::sim::Light { steps: vec![(Span(0), 0.5, 0.0)], flicker: 0.3, flicker_hz: 5.0 };
    let mut sim = Sim::new(&scenario).unwrap();
    let (mean, most, least) = (grey(&mut sim, 20), grey(&mut sim, 21), grey(&mut sim, 23));
    assert!((most / mean - 1.3).abs() < 0.05 && (least / mean - 0.7).abs() < 0.03, "{mean} {most} {least}");
}

#[test]
fn named_rigs_see_as_much_in_common_as_they_should() {
    for (name, cameras) in RIGS.into_iter().zip([1, 2, 2, 4]) {
        let rig = rig_named(name).unwrap();
        assert_eq!(rig.cameras.len(), cameras, "{name}");
        // share of camera 0's pixels that camera k sees at 3 m
        let shared = |k: usize| {
            let (a, b) = (&rig.cameras[0], &rig.cameras[k]);
            let from_a = b.body_from_cam.inverse() * a.body_from_cam;
            let px = (0..480).step_by(20).flat_map(|y| (0..752).step_by(20).map(move |x| (x, y)));
            let sees = |(x, y): (i32, i32)| {
                let p = from_a.transform(a.camera.unproject(DVec2::new(x.into(), y.into())).unwrap() * 3.0);
                b.camera.project(p).is_some_and(|px| b.camera.contains(px, 0.0))
            };
            let seen: Vec<bool> = px.map(sees).collect();
            seen.iter().filter(|s| **s).count() as f64 / seen.len() as f64
        };
        match name {
            "stereo" => assert!(shared(1) > 0.8),
            "opposed" => assert_eq!(shared(1), 0.0),
            "four" => {
                let all = [1, 2, 3].map(shared);
                assert!(all[0] > 0.8 && all[1..].iter().all(|s| *s > 0.0 && *s < 0.3), "{all:?}");
            }
            _ => {}
        }
        let mut scenario = quiet("circle");
        (scenario.calibration, scenario.image_divisor) = (rig, 4);
        let mut sim = Sim::new(&scenario).unwrap();
        let mut frames = Frames::for_rig(sim.calibration());
        sim.render(100, &mut frames);
        assert!(frames.images.iter().all(|i| i.pixels.iter().filter(|p| **p > 10).count() * 10 > i.pixels.len() * 9));
    }
    assert!(rig_named("three").is_none());
}
