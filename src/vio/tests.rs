//! The estimator on the synthetic world, where its insides are seen.

use super::estimator::Estimator;
use super::factors::{of_window, view_rows, Factor};
use super::graph::Graph;
use super::inertial::{InertialWeight, MotionSigma};
use super::projection::{observe, Host};
use super::rig::CAMERA_DIM_MAX;
use super::rows::{scatter, FactorRows, POINT_DIM};
use super::window::{Frame, Layout};
use super::world::{self, Path, World, FRAME_SECS, RATE_HZ};
use super::*;
use crate::limits::FRAMES;
use crate::math::dense::System;
use glam::DQuat;
use nalgebra::{Matrix3, Vector3};
use stipple_drivers::Span;

fn run(vio: &mut Vio, frames: std::ops::Range<usize>, world: &mut World) {
    run_seeing(vio, frames, world, |_| {});
}

/// Flies; `spoil` may change what the cameras see. Answers what the last frame led to.
fn run_seeing(vio: &mut Vio, frames: std::ops::Range<usize>, world: &mut World, spoil: impl Fn(&mut Tracks)) -> Update {
    let (mut tracks, mut update) = (Tracks::default(), Update::default());
    for frame in frames {
        let t = frame as f64 * FRAME_SECS + 0.0012;
        let mut sample = ((t - FRAME_SECS) * RATE_HZ).max(0.0) as usize;
        while (sample as f64) / RATE_HZ < t + 1.0 / RATE_HZ {
            let s = world.imu(sample as f64 / RATE_HZ);
            if vio.imu.newest().is_none_or(|n| s.t > n.t) {
                vio.on_imu(s);
            }
            sample += 1;
        }
        world.tracks(t, &mut tracks);
        spoil(&mut tracks);
        update = vio.on_tracks(&tracks);
    }
    update
}

/// The direction in which the whole window is translated, and rotated about the world's axis.
fn gauge(estimator: &Estimator, translation: DVec3, rotation: DVec3, slot: usize) -> [f64; 15] {
    let m = estimator.graph.window.frame(slot).linearized();
    let (p, v) = (translation + rotation.cross(m.pose.p), rotation.cross(m.v));
    let th = m.pose.q.conjugate() * rotation;
    let mut d = [0.0; 15];
    (0..3).for_each(|i| (d[i], d[3 + i], d[6 + i]) = (p[i], th[i], v[i]));
    d
}

const UNOBSERVABLE: [(&str, DVec3, DVec3); 4] = [
    ("x", DVec3::X, DVec3::ZERO),
    ("y", DVec3::Y, DVec3::ZERO),
    ("z", DVec3::Z, DVec3::ZERO),
    ("yaw", DVec3::ZERO, DVec3::Z),
];

/// Energies of the prior along the four unobservable directions, and the least along tilt, after so many
/// frames of a flight whose prior was started again with the gauge left free.
fn energies(frames: usize, config: &VioConfig, readout: Span) -> ([f64; 4], f64) {
    let mut world = World::new(Path { rest: -1.0 });
    world.rig.cameras.iter_mut().for_each(|c| c.readout = readout);
    let mut vio = Vio::new(&world.rig, config);
    run(&mut vio, 0..12, &mut world);
    assert!(vio.is_running());
    // The first state is still in the window; with its position and yaw its velocity is left free too,
    // which as a vector of the world would tell yaw.
    let Estimator { graph: Graph { window, prior, .. }, rig_deviations, .. } = &mut vio.estimator;
    let first = window.slots().next().expect("a running window has frames");
    let motion = window.frame(first).linearization_point.expect("the prior is about the first state");
    let sigma = MotionSigma { p: 1e9, yaw: 1e9, tilt: 0.05, v: 1e9, bg: 0.02, ba: 0.3 };
    *rig_deviations = window.rig.sigmas(config);
    prior.start(first, &motion, &sigma, [motion.bg, motion.ba], window, rig_deviations);
    run(&mut vio, 12..frames, &mut world);
    let estimator = &vio.estimator;
    assert!(vio.stats.resets == 0 && estimator.graph.window.keyframe_poses().count() > 3);
    let energy = |translation: DVec3, rotation: DVec3| {
        estimator.graph.prior.energy(&estimator.graph.window, |slot| gauge(estimator, translation, rotation, slot))
    };
    let tilt = energy(DVec3::ZERO, DVec3::X).min(energy(DVec3::ZERO, DVec3::Y));
    (UNOBSERVABLE.map(|(_, translation, rotation)| energy(translation, rotation)), tilt)
}

fn four_directions_stay_empty(energy_max: f64, config: &VioConfig, readout: Span) {
    for frames in [120, 1012] {
        let (free, tilt) = energies(frames, config, readout);
        let shown = free.map(|e| format!("{e:.1e}")).join(" ");
        eprintln!("after {frames} frames: x y z yaw {shown}, tilt {tilt:.1e}");
        assert!(tilt > 1e4, "tilt is observable: {tilt}");
        for ((name, ..), e) in UNOBSERVABLE.iter().zip(free) {
            assert!(e < energy_max, "{name} after {frames} frames: {e} beside tilt {tilt}");
        }
    }
}

#[test]
fn prior_learns_nothing_about_position_and_yaw_in_a_thousand_frames() {
    four_directions_stay_empty(1e-9, &VioConfig::default(), Span(0));
}

#[test]
fn prior_learns_no_more_when_the_rig_is_estimated_and_rows_roll() {
    let all = VioConfig {
        estimate_time_offset: true,
        estimate_extrinsics: true,
        estimate_imu_scale: true,
        ..VioConfig::default()
    };
    four_directions_stay_empty(1e-9, &all, Span::from_secs(0.002));
}

/// A view in one camera of a landmark hosted in the other touches the columns of both, one in the host's own camera sums up.
#[test]
fn columns_of_two_cameras_match_differences_where_their_offsets_differ() {
    const H: f64 = 1e-6;
    let both = VioConfig { estimate_time_offset: true, estimate_extrinsics: true, ..VioConfig::default() };
    let mut world = World::new(Path { rest: -1.0 });
    let mut vio = Vio::new(&world.rig, &both);
    run(&mut vio, 0..60, &mut world);
    let Graph { window, landmarks, .. } = &mut vio.estimator.graph;
    // Differences are taken at the estimate, so derivatives have to be.
    for slot in window.order.clone().iter() {
        let frame = window.frame_mut(*slot as usize);
        frame.linearization_point = None;
        frame.step(&[0.0; 15]);
    }
    window.rig.release();
    window.rig.step(&[0.004, -0.003]);
    let mut seen = [0; 2];
    for (l, o) in landmarks.pool.iter().flat_map(|l| l.observations.iter().map(move |o| (l, o))) {
        let view = |window: &window::Window| {
            let mut columns = [[0.0; CAMERA_DIM_MAX]; 2];
            let r = observe(l, &Host::of(l, window), o, window, &mut columns);
            (r.expect("a landmark in view").px, columns)
        };
        seen[usize::from(l.host_camera == o.camera)] += 1;
        let analytic = view(window).1;
        for i in 0..window.rig.camera_dim() {
            let mut at = |h: f64| {
                let mut error = [0.0; CAMERA_DIM_MAX];
                error[i] = h;
                window.rig.save();
                window.rig.step(&error);
                let px = view(window).0;
                window.rig.restore();
                px
            };
            let numeric = (at(H) - at(-H)) / (2.0 * H);
            for (k, row) in analytic.iter().enumerate() {
                let error = (row[i] - numeric[k]).abs() / (1.0 + row[i].abs());
                assert!(error < 2e-6, "column {i}: analytic {}, numeric {}", row[i], numeric[k]);
            }
        }
    }
    assert!(seen.iter().all(|n| *n > 100), "views in another and in the host's camera: {seen:?}");
}

/// So little motion that nothing can be told for half a minute, then a flight.
#[test]
fn a_place_that_is_not_found_is_said_to_be_so_after_some_motion_and_found_later() {
    const CALM: f64 = 25.0;
    let flight = Path { rest: CALM };
    let path = move |t: f64| {
        let sway = Pose::new(DQuat::IDENTITY, DVec3::new(0.0, 0.02 * (2.0 * t).sin(), 0.0));
        flight.pose(t) * sway
    };
    let mut world = World::seen_from(path, world::room(1500, &mut world::Noise(7)), world::Noise(7));
    let usual = VioConfig { zero_velocity: false, ..VioConfig::default() };
    let config = VioConfig { estimate_extrinsics: true, extrinsics_sigma_m: 0.03, ..usual };
    let mut vio = Vio::new(&world.rig, &config);
    let findings = |vio: &Vio| vio.rig_findings().iter().collect::<Vec<_>>();
    run(&mut vio, 0..360, &mut world);
    assert_eq!(findings(&vio), [], "too early to tell");
    run(&mut vio, 360..480, &mut world);
    let unknown = [0, 1].map(|c| (Finding::Unknown, Part::Extrinsics(c)));
    assert_eq!(findings(&vio), unknown);
    run(&mut vio, 480..900, &mut world);
    vio.rig_parts().for_each(|part| eprintln!("{part:.2?}"));
    let found = [0, 1].map(|c| (Finding::FoundAfterAll, Part::Extrinsics(c)));
    assert_eq!(findings(&vio), [unknown, found].concat());
    vio.convergence.restart(true);
    assert!(vio.rig_findings().has_thrown_away() && findings(&vio).len() == 4);
}

/// A window in which only inertial factors and finished landmarks act between the frames that leave and
/// those that stay, so that before and after marginalization it holds the same quadratic on what stays.
/// The newest is pushed off by `push` in every error.
fn ready_to_marginalize(push: f64) -> Estimator {
    let mut world = World::new(Path { rest: -1.0 });
    let mut vio = Vio::new(&world.rig, &VioConfig::default());
    run(&mut vio, 0..40, &mut world);
    let mut estimator = vio.estimator;
    let window = &mut estimator.graph.window;
    let oldest = window.states().next().expect("a running window has states");
    let newest = *window.frame(window.newest().expect("a running window has a newest frame"));
    // One more state, by inertia alone, so that one is due to leave; and no live landmark.
    let (from, t) = (newest.now, newest.t + Span::from_secs(0.05));
    let inc = vio.imu.integrate(newest.t, t, from.bg, from.ba, &estimator.model.noise);
    let mut frame = Frame::new(t, from.propagate(&inc).plus(&[push; 15]));
    frame.weight = InertialWeight::new(&inc, &estimator.model.noise);
    frame.increment = inc;
    window.push(frame).expect("room for one");
    let boundary = window.frame(window.states().nth(1).expect("a second state")).t;
    let is_finished = |s: u8| window.frame(s as usize).t <= boundary;
    estimator.graph.landmarks.retain(|l| l.observations.iter().all(|o| is_finished(o.slot)));
    assert!(window.frame(oldest).is_state);
    estimator
}

/// The undamped step of every slot.
fn newton(estimator: &mut Estimator) -> [[f64; 15]; FRAMES] {
    let Estimator { graph, solver, model, .. } = estimator;
    by_slot(solver.newton_step(graph, model), &graph.window)
}

fn by_slot(step: &[f64], window: &window::Window) -> [[f64; 15]; FRAMES] {
    let layout = Layout::of(window);
    let mut steps = [[0.0; 15]; FRAMES];
    for slot in window.slots() {
        for (part, first) in layout.state(slot).into_iter().zip([0, 6]) {
            let Some(part) = part else { continue };
            steps[slot][first..first + part.len].copy_from_slice(&step[part.at..part.at + part.len]);
        }
    }
    steps
}

#[test]
fn marginalizing_keeps_the_step_of_what_stays() {
    let mut estimator = ready_to_marginalize(0.01);
    let before = newton(&mut estimator);
    estimator.marginalize();
    let after = newton(&mut estimator);
    for slot in estimator.graph.window.states() {
        for i in 0..15 {
            let (a, b) = (before[slot][i], after[slot][i]);
            assert!((a - b).abs() < 1e-7 + 1e-5 * a.abs(), "slot {slot} error {i}: {a} then {b}");
        }
    }
}

/// The normal equations of the same window by the textbook: landmarks eliminated by Schur complement,
/// from rows that are not yet eliminated.
fn schur_step(estimator: &mut Estimator) -> (Vec<f64>, Vec<f64>) {
    let Estimator { graph: Graph { window, landmarks, prior }, model, .. } = estimator;
    let layout = Layout::of(window);
    let n = layout.dim;
    let mut system = System::new(n);
    system.clear(n);
    prior.add_to(window, &layout, &mut system);
    let mut rows = FactorRows::new();
    for factor in of_window(window, &landmarks.pool) {
        let Factor::Landmark(l) = factor else {
            factor.linearize(window, model, &layout, &mut rows);
            rows.add_to(0, &mut system);
            continue;
        };
        view_rows(l, window, model, &layout, &mut rows);
        // [point | all columns of the layout | r]
        let mut raw = vec![vec![0.0; POINT_DIM + n + 1]; rows.rows.count()];
        for (i, wide) in raw.iter_mut().enumerate() {
            let row = rows.rows.row(i);
            wide[..POINT_DIM].copy_from_slice(&row[..POINT_DIM]);
            scatter(&row[POINT_DIM..], &rows.columns, &mut wide[POINT_DIM..]);
        }
        if factor.linearize(window, model, &layout, &mut rows).first.is_none() {
            continue;
        }
        let (mut v, mut g) = (Matrix3::<f64>::zeros(), Vector3::<f64>::zeros());
        let mut w = vec![Vector3::<f64>::zeros(); n];
        for row in &raw {
            let j = Vector3::from_row_slice(&row[..3]);
            v += j * j.transpose();
            g += j * row[3 + n];
            for a in 0..n {
                w[a] += j * row[3 + a];
                system.b[a] += row[3 + a] * row[3 + n];
                (0..=a).for_each(|b| system.add(a, b, row[3 + a] * row[3 + b]));
            }
        }
        let inverse = v.try_inverse().expect("a determined point");
        for a in 0..n {
            system.b[a] -= w[a].dot(&(inverse * g));
            (0..=a).for_each(|b| system.add(a, b, -w[a].dot(&(inverse * w[b]))));
        }
    }
    let (b, mut x) = (system.b.clone(), vec![0.0; n]);
    system.solve_damped(|_| 0.0, &mut system.clone(), &mut x);
    (b, x)
}

#[test]
fn qr_and_schur_complement_agree() {
    let mut world = World::new(Path { rest: -1.0 });
    let mut vio = Vio::new(&world.rig, &VioConfig::default());
    run(&mut vio, 0..60, &mut world);
    let estimator = &mut vio.estimator;
    assert!(estimator.graph.landmarks.pool.len() > 50);
    let steps = newton(estimator);
    let (b, x) = schur_step(estimator);
    assert!(b.iter().any(|b| *b != 0.0));
    let schur = by_slot(&x, &estimator.graph.window);
    for slot in estimator.graph.window.slots() {
        for (i, (qr, schur)) in steps[slot].iter().zip(&schur[slot]).enumerate() {
            assert!((qr - schur).abs() < 1e-7 + 1e-5 * qr.abs(), "slot {slot} error {i}: {qr} {schur}");
        }
    }
}

#[test]
fn same_input_gives_the_same_bits() {
    let once = || {
        let mut world = World::new(Path { rest: -1.0 });
        let mut vio = Vio::new(&world.rig, &VioConfig::default());
        run(&mut vio, 0..40, &mut world);
        (vio.hash(), vio.stats)
    };
    let (a, b) = (once(), once());
    assert_eq!(a, b);
    assert_ne!(a.0, FNV_START);
}

#[test]
fn restart_goes_on_where_it_was() {
    let mut world = World::new(Path { rest: -1.0 });
    let mut vio = Vio::new(&world.rig, &VioConfig::default());
    run(&mut vio, 0..60, &mut world);
    let path = Path { rest: -1.0 };
    let before = vio.window().last().expect("a running window has frames");
    vio.reset();
    run(&mut vio, 60..80, &mut world);
    assert!(vio.is_running() && vio.stats.resets == 1);
    let after = vio.window().next().expect("a running window has frames");
    // Half a second of alignment at up to 1 m/s, carried by inertia.
    let truly = |t: Nanos| path.pose(t.0 as f64 * 1e-9);
    let (moved, true_move) = (before.1.inverse() * after.1, truly(before.0).inverse() * truly(after.0));
    assert!((after.0 - before.0).secs() > 0.3 && true_move.p.length() > 0.1);
    assert!(moved.p.distance(true_move.p) < 0.02 && moved.q.angle_between(true_move.q) < 0.02);
    assert_eq!(vio.window().last().map(|w| w.0), Some(Nanos(((79.0 * FRAME_SECS + 0.0012) * 1e9) as i64)));
}

#[test]
fn samples_that_are_not_finite_or_not_newer_are_counted_and_refused() {
    let mut vio = Vio::new(&world::calibration(), &VioConfig::default());
    let sample = |t: i64, x: f64| ImuSample {
        t: Nanos(t),
        gyro_body: DVec3::splat(x),
        accel_body: DVec3::Z,
        ..ImuSample::default()
    };
    for (t, x) in [(1, 0.0), (1, 0.0), (0, 0.0), (2, f64::NAN), (3, f64::INFINITY), (4, 0.0)] {
        vio.on_imu(sample(t, x));
    }
    assert_eq!(vio.stats.imu_rejected, 4);
    assert_eq!(vio.imu.iter().count(), 2);
}

#[test]
fn prediction_meets_the_next_estimate() {
    let mut world = World::new(Path { rest: -1.0 });
    let mut vio = Vio::new(&world.rig, &VioConfig::default());
    run(&mut vio, 0..59, &mut world);
    let before = vio.odometry();
    run(&mut vio, 59..60, &mut world);
    let last = vio.odometry().expect("running");
    let t = last.t + Span::from_secs(FRAME_SECS);
    for k in 1..=10 {
        vio.on_imu(world.imu((last.t.0 as f64 * 1e-9) + k as f64 / RATE_HZ));
    }
    let mut predictor = Predictor::new(&world.rig, &VioConfig::default());
    vio.imu.iter().for_each(|s| predictor.on_imu(*s));
    assert!(predictor.state_at(t).is_none(), "no state was given");
    let covariance = vio.covariance().copied();
    predictor.on_update(&Update { odometry: Some(last), covariance, epoch: 3, quality: 80, ..Update::default() });
    let carried = predictor.state_at(t).expect("a state was given");
    assert!((carried.epoch, carried.quality, carried.age) == (3, 80, t - last.t));
    assert!(predictor.state_at(last.t - Span(1)).is_none() && predictor.state_at(t + Span::from_secs(3.0)).is_none());
    let [before_v, v] = [covariance, carried.covariance].map(|c| c.expect("it is determined")[6][6]);
    assert!(v > before_v, "samples have noise");
    let mut past_a_gap = predictor.clone();
    past_a_gap.on_imu(ImuSample { t: t + Span::from_secs(60.0), ..vio.imu.newest().copied().expect("samples") });
    past_a_gap.advance(t + Span::from_secs(60.0));
    assert!(past_a_gap.state_at(t + Span::from_secs(60.0)).is_none(), "one sample held for a minute leads nowhere");
    let predicted = carried.odometry;
    predictor.motion_to(last.t, None);
    let motion = predictor.motion_to(t, before.as_ref()).expect("a second frame");
    let mut tracks = Tracks::default();
    world.tracks(t.0 as f64 * 1e-9, &mut tracks);
    let update = vio.on_tracks(&tracks).odometry.expect("running");
    assert!((predicted.world_from_body.p - update.world_from_body.p).length() < 0.005);
    assert!((last.world_from_body * motion).p.distance(predicted.world_from_body.p) < 0.005);
}

#[test]
fn uncertainty_of_position_and_yaw_only_grows() {
    let mut world = World::new(Path { rest: -1.0 });
    let mut vio = Vio::new(&world.rig, &VioConfig::default());
    let mut sigmas: Vec<(f64, f64)> = Vec::new();
    for frames in [0..100, 100..300, 300..600] {
        run(&mut vio, frames, &mut world);
        let c = vio.covariance().expect("running");
        let world_from_body = vio.odometry().expect("running").world_from_body.rotation();
        let theta = Matrix3::from_fn(|i, j| c[3 + i][3 + j]);
        let up = world_from_body.transpose() * DVec3::Z;
        let up = Vector3::new(up.x, up.y, up.z);
        sigmas.push(((0..3).map(|i| c[i][i]).sum::<f64>().sqrt(), up.dot(&(theta * up)).sqrt()));
    }
    eprintln!("position, m, and yaw, rad, after 5, 15 and 30 s: {sigmas:.4?}");
    assert!(sigmas.windows(2).all(|w| w[1].0 > w[0].0 && w[1].1 > w[0].1), "{sigmas:?}");
}

/// The next frame of a running flight, which sees at most `landmarks_max` landmarks and whose views of landmarks are moved by
/// 12 px where `moved` says so by id. Answers how many were moved, and how many views and frames the gate refused and left alone.
fn gated(landmarks_max: usize, moved: impl Fn(u64) -> bool) -> (u64, u64, u64) {
    let mut world = World::new(Path { rest: -1.0 });
    let mut vio = Vio::new(&world.rig, &VioConfig::default());
    run(&mut vio, 0..60, &mut world);
    let newest = vio.imu.newest().expect("samples were fed").t;
    (1..=10).for_each(|k| vio.on_imu(world.imu(newest.0 as f64 * 1e-9 + k as f64 / RATE_HZ)));
    let mut tracks = Tracks::default();
    world.tracks(60.0 * FRAME_SECS + 0.0012, &mut tracks);
    let known = |id: u64| vio.estimator.graph.landmarks.find(id).is_some();
    let landmarks = tracks.cameras[0].iter().map(|t| t.id).filter(|id| known(*id));
    let left_out: Vec<u64> = landmarks.skip(landmarks_max).collect();
    tracks.cameras.iter_mut().for_each(|c| c.retain(|t| !left_out.contains(&t.id)));
    let mut count = 0;
    for track in tracks.cameras.iter_mut().flat_map(|c| c.iter_mut()) {
        if known(track.id) && moved(track.id) {
            (track.px[0], count) = (track.px[0] + 12.0, count + 1);
        }
    }
    let before = vio.stats;
    vio.on_tracks(&tracks);
    (count, vio.stats.tracks_gated - before.tracks_gated, vio.stats.gates_opened - before.gates_opened)
}

#[test]
fn views_that_cannot_be_their_landmarks_are_refused_and_true_ones_are_not() {
    let (none, by_itself, _) = gated(usize::MAX, |_| false);
    let (moved, refused, opened) = gated(usize::MAX, |id| id % 5 == 0);
    // Of the world's own views one in a hundred is 15 px off.
    assert!(none == 0 && by_itself <= 6, "{by_itself} refused of a true frame");
    assert!(moved > 20 && refused >= moved && refused <= moved + by_itself, "{refused} of {moved}");
    assert_eq!(opened, 0);
}

#[test]
fn prediction_that_nearly_all_contradict_refuses_nothing() {
    let (moved, refused, opened) = gated(usize::MAX, |_| true);
    assert!(moved > 100);
    assert_eq!((refused, opened), (0, 1));
}

#[test]
fn few_views_are_refused_where_all_contradict_the_prediction() {
    let (moved, refused, opened) = gated(3, |_| true);
    assert!((3..=6).contains(&moved));
    assert_eq!((refused, opened), (moved, 0));
}

/// A unit of 3 mg/√Hz is at rest however fast it is read.
#[test]
fn unit_at_rest_starts_at_every_rate() {
    for rate_hz in [200.0, 1000.0, 4000.0] {
        let mut world = World::new(Path { rest: 100.0 });
        (world.rig.imu.rate_hz, world.rig.imu.accel_noise) = (rate_hz, 3e-3);
        let mut vio = Vio::new(&world.rig, &VioConfig::default());
        (0..(2.0 * rate_hz) as usize).for_each(|i| vio.on_imu(world.imu(i as f64 / rate_hz)));
        let mut tracks = Tracks::default();
        let (mut first, mut held) = (None, 0);
        for frame in 0..40 {
            let t = frame as f64 * FRAME_SECS + 0.0012;
            world.tracks(t, &mut tracks);
            let update = vio.on_tracks(&tracks);
            first = first.or(update.odometry.map(|o| (t, o.v_world)));
            held += usize::from(update.health.has(Health::ZERO_VELOCITY));
        }
        let (t, v) = first.expect("it starts");
        eprintln!("{rate_hz} Hz: starts after {t:.2} s, held for {held} frames");
        assert!(t < 0.7 && v == DVec3::ZERO && held > 20);
    }
}

#[test]
fn start_in_motion_takes_as_long_at_every_frame_rate() {
    for frame_hz in [20.0, 140.0, 200.0] {
        let mut world = World::new(Path { rest: -1.0 });
        let mut vio = Vio::new(&world.rig, &VioConfig::default());
        (0..300).for_each(|i| vio.on_imu(world.imu(f64::from(i) / RATE_HZ)));
        let mut tracks = Tracks::default();
        let first = (0..300).map(|frame| f64::from(frame) / frame_hz + 0.0012).find(|t| {
            world.tracks(*t, &mut tracks);
            vio.on_tracks(&tracks).odometry.is_some()
        });
        assert!(first.is_some_and(|t| (0.44..0.52).contains(&t)), "{frame_hz} Hz: starts after {first:?} s");
    }
}

#[test]
fn frame_whose_views_disagree_claims_little() {
    let mut world = World::new(Path { rest: -1.0 });
    let mut vio = Vio::new(&world.rig, &VioConfig::default());
    run(&mut vio, 0..60, &mut world);
    let update = run_seeing(&mut vio, 60..61, &mut world, |tracks| {
        for track in tracks.cameras.iter_mut().flat_map(|c| c.iter_mut()) {
            let away = [15.0, -15.0][(track.id / 2 % 2) as usize];
            track.px[(track.id % 2) as usize] += away;
        }
    });
    assert!(update.odometry.is_some() && update.health.has(Health::VISION_DISAGREES), "{:?}", update.health);
    assert!(update.quality <= QUALITY_SUSPECT, "quality {}", update.quality);
}

#[test]
fn frame_that_is_refused_is_not_healthy() {
    let mut world = World::new(Path { rest: -1.0 });
    let mut vio = Vio::new(&world.rig, &VioConfig::default());
    run(&mut vio, 0..20, &mut world);
    let mut tracks = Tracks::default();
    world.tracks(0.5, &mut tracks);
    let update = vio.on_tracks(&tracks);
    assert!(update.health.has(Health::FRAME_REJECTED) && update.odometry.is_none() && update.quality == 0);
    assert!(vio.health_frames().any(|f| f == ("frame_rejected", 1)));
}

/// One camera that has lost its points and moves by 6 cm a second: a frame that triangulates nothing must not push out the keyframe
/// that the vehicle has to move away from.
#[test]
fn slow_camera_finds_points_again() {
    let creep = |t: f64| Pose::new(DQuat::from_rotation_x(0.03 * (9.0 * t).sin()), DVec3::X * 0.06 * t);
    let mut noise = world::stream(3, 1);
    let points = world::room(1500, &mut noise);
    let mut world = World::seen_from(creep, points, noise);
    let mut vio = Vio::new(&world.rig, &VioConfig::default());
    run(&mut vio, 0..60, &mut world);
    run_seeing(&mut vio, 60..200, &mut world, |tracks| {
        tracks.cameras[1].clear();
        tracks.cameras[0].iter_mut().for_each(|t| t.id += 1 << 20);
    });
    assert!(vio.is_running() && vio.stats.resets == 0, "{:?}", vio.stats);
}

/// What the estimator goes on without is counted.
#[test]
fn inertia_that_says_nothing_and_steps_that_are_taken_back_are_counted() {
    let mut world = World::new(Path { rest: -1.0 });
    let mut vio = Vio::new(&world.rig, &VioConfig::default());
    run(&mut vio, 0..40, &mut world);
    assert_eq!(vio.stats.inertia_lost, 0);
    let noise = vio.estimator.model.noise;
    vio.estimator.model.noise.accel = 1e200;
    run(&mut vio, 40..45, &mut world);
    assert_eq!((vio.stats.inertia_lost, vio.stats.resets), (5, 0));
    vio.estimator.model.noise = noise;
    run(&mut vio, 45..60, &mut world);
    assert_eq!(vio.stats.solver_steps_rejected, 0);
    // An estimate that is turned half about lies where the cost is far from a square.
    let window = &mut vio.estimator.graph.window;
    let newest = window.newest().expect("a running window has a newest frame");
    window.frame_mut(newest).now.pose.q *= DQuat::from_rotation_y(2.0);
    run(&mut vio, 60..62, &mut world);
    assert!(vio.stats.solver_steps_rejected > 0, "{:?}", vio.stats);
}

/// Poses of the body and places of the cameras on it say together how the cameras moved, whichever of them was knocked: the map
/// is drawn by both.
#[test]
fn cameras_move_as_poses_and_places_together_say() {
    for knocked in 0..2 {
        let path = Path { rest: -1.0 };
        let mut world = World::new(path);
        let (truth, mut rig) = (world.rig.clone(), world.rig.clone());
        rig.cameras[knocked].body_from_cam.q *= DQuat::from_scaled_axis(DVec3::new(0.02, -0.03, 0.02));
        let config = VioConfig { estimate_extrinsics: true, ..VioConfig::default() };
        let mut vio = Vio::new(&rig, &config);
        let mut seen = vec![];
        for frames in [0..600, 600..620] {
            run(&mut vio, frames, &mut world);
            let (t, world_from_body, _) = vio.window().last().expect("it runs");
            let places = vio.known().cameras.expect("they are estimated").body_from_cam;
            seen.push((path.pose((t - Nanos(0)).secs()), world_from_body, places));
        }
        for c in 0..2 {
            let real = truth.cameras[c].body_from_cam;
            let [(true_a, a, at_a), (true_b, b, at_b)] = [seen[0], seen[1]];
            let moved = (a * at_a[c]).inverse() * (b * at_b[c]);
            let off = ((true_a * real).inverse() * (true_b * real)).inverse() * moved;
            let turned = off.q.to_scaled_axis().length();
            eprintln!(
                "camera {knocked} knocked, camera {c}: off by {:.1} mm, {:.1} mrad",
                1e3 * off.p.length(),
                1e3 * turned
            );
            assert!(off.p.length() < 0.01 && turned < 0.004);
        }
    }
}
