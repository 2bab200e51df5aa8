//! The tracker as a whole: on a made-up plane in front of a rig, and on recordings, where ground-truth
//! poses and the tracker's own stereo depth must predict where points go.
#![allow(clippy::unwrap_used, unsafe_code)]

use glam::{DQuat, DVec2, DVec3};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use stipple::config::FrontendConfig;
use stipple::frontend::{Frontend, Prediction, Stats, Tracks};
use stipple::limits::TRACKS;
use stipple::mem::{heap_after_seal, seal_thread, unsealed, CountingAllocator};
use stipple_drivers::calibration::Mask;
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::sim::{rig_named, Scenario, Sim};
use stipple_drivers::types::pose_at;
use stipple_drivers::{Calibration, Camera, Frames, Image, ImuCalibration, Lens, Nanos, Pose, RigCamera, Span};

#[global_allocator]
static HEAP: CountingAllocator = CountingAllocator;

const FOCAL_PX: f64 = 300.0;
const BASELINE: f64 = 0.1;

fn rig(width: usize, height: usize) -> Calibration {
    let lens = Lens::Radtan { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0 };
    let (cx, cy) = ((width - 1) as f64 / 2.0, (height - 1) as f64 / 2.0);
    let camera = Camera { width, height, fx: FOCAL_PX, fy: FOCAL_PX, cx, cy, lens };
    let at = |x: f64| RigCamera::new(camera, Pose::new(DQuat::IDENTITY, DVec3::new(x, 0.0, 0.0)));
    Calibration { cameras: vec![at(0.0), at(BASELINE)], imu: ImuCalibration::CONSUMER }
}

/// Grey levels on a wall: random values seven pixels apart, smoothly joined.
fn wall(x: f64, y: f64) -> f64 {
    const CELL: f64 = 7.0;
    let lattice = |i: f64, j: f64| {
        let s = (i as i64 as u64).wrapping_mul(0x9E3779B97F4A7C15) ^ (j as i64 as u64).wrapping_mul(0xC2B2AE3D27D4EB4F);
        let s = (s ^ (s >> 29)).wrapping_mul(0xBF58476D1CE4E5B9);
        30.0 + 190.0 * ((s >> 33) as f64 / (1u64 << 31) as f64)
    };
    let (i, j) = ((x / CELL).floor(), (y / CELL).floor());
    let ease = |t: f64| t * t * (3.0 - 2.0 * t);
    let (u, v) = (ease(x / CELL - i), ease(y / CELL - j));
    let row = |j: f64| lattice(i, j) + u * (lattice(i + 1.0, j) - lattice(i, j));
    row(j) + v * (row(j + 1.0) - row(j))
}

/// Both images of the wall at a distance, the rig moved sideways and down, m; the second image also
/// slipped downwards by `slip` px, which no motion explains.
fn see(calibration: &Calibration, moved: [f64; 2], distance: f64, slip: f64, out: &mut Frames) {
    for (image, rig) in out.images.iter_mut().zip(&calibration.cameras) {
        let x = rig.body_from_cam.p.x;
        let (dx, dy) = (FOCAL_PX * (moved[0] + x) / distance, FOCAL_PX * moved[1] / distance);
        let dy = if x > 0.0 { dy - slip } else { dy };
        for (v, row) in image.pixels.chunks_exact_mut(rig.camera.width).enumerate() {
            for (u, p) in row.iter_mut().enumerate() {
                *p = wall(u as f64 + dx, v as f64 + dy).round() as u8;
            }
        }
    }
}

fn pairs(t: &Tracks) -> Vec<([f32; 2], [f32; 2])> {
    let right = |id| t.cameras[1].binary_search_by_key(&id, |b| b.id).ok().map(|i| t.cameras[1][i].px);
    t.cameras[0].iter().filter_map(|a| Some((a.px, right(a.id)?))).collect()
}

#[test]
fn points_move_as_the_wall_does_in_both_cameras() {
    let calibration = rig(320, 240);
    let mut frontend = Frontend::new(&calibration, &FrontendConfig::default()).unwrap();
    let mut frames = Arc::new(Frames::for_rig(&calibration));
    let distance = 2.0;
    let mut first = BTreeMap::new();
    for k in 0..12 {
        let moved = [0.006 * k as f64, -0.004 * k as f64];
        see(&calibration, moved, distance, 0.0, Arc::make_mut(&mut frames));
        let tracks = frontend.track(&frames, &Prediction::default());
        for (a, b) in pairs(tracks) {
            assert!(
                (a[0] as f64 - b[0] as f64 - FOCAL_PX * BASELINE / distance).abs() < 0.15,
                "frame {k}: {a:?} {b:?}"
            );
            assert!((a[1] - b[1]).abs() < 0.15, "frame {k}: {a:?} {b:?}");
        }
        assert!(pairs(tracks).len() >= 15, "frame {k}: {}", pairs(tracks).len());
        for track in tracks.cameras[0].iter() {
            let [u, v] = track.px.map(f64::from);
            let still = [u + FOCAL_PX * moved[0] / distance, v + FOCAL_PX * moved[1] / distance];
            let from = *first.entry(track.id).or_insert(still);
            assert!((still[0] - from[0]).hypot(still[1] - from[1]) < 0.15, "frame {k}: {from:?} -> {still:?}");
        }
    }
}

#[test]
fn no_track_begins_or_stays_where_the_vehicle_is_in_view() {
    let mut calibration = rig(480, 360);
    let seen = |calibration: &Calibration| {
        let mut frontend = Frontend::new(calibration, &FrontendConfig::default()).unwrap();
        let mut frames = Arc::new(Frames::for_rig(calibration));
        let mut inside = 0;
        for k in 0..12 {
            see(calibration, [0.04 * k as f64, 0.0], 2.0, 0.0, Arc::make_mut(&mut frames));
            let tracks = frontend.track(&frames, &Prediction::default());
            assert!(pairs(tracks).len() > 10, "frame {k}");
            inside += tracks.cameras[1].iter().filter(|t| (150.0..249.0).contains(&t.px[0]) && t.px[1] < 199.0).count();
        }
        inside
    };
    assert!(seen(&calibration) > 20);
    calibration.cameras[1].masks[3] = Mask { left: 150, top: 0, right: 250, bottom: 200 };
    assert_eq!(seen(&calibration), 0);
}

#[test]
fn a_point_that_the_estimator_rejects_is_dropped_and_its_cell_rests() {
    let calibration = rig(480, 360);
    let mut frontend = Frontend::new(&calibration, &FrontendConfig::default()).unwrap();
    let mut frames = Arc::new(Frames::for_rig(&calibration));
    see(&calibration, [0.0; 2], 2.0, 0.0, Arc::make_mut(&mut frames));
    let point = frontend.track(&frames, &Prediction::default()).cameras[0][10];
    let near = |t: &Tracks| t.cameras[0].iter().any(|a| (a.px[0] - point.px[0]).hypot(a.px[1] - point.px[1]) < 10.0);
    frontend.reject(&[point.id, u64::MAX]);
    let mut rested = 0;
    for _ in 0..64 {
        Arc::make_mut(&mut frames).t.0 += 50_000_000;
        let tracks = frontend.track(&frames, &Prediction::default());
        assert!(tracks.find(0, point.id).is_none() && tracks.find(1, point.id).is_none());
        if near(tracks) {
            break;
        }
        rested += 1;
    }
    assert!((1..64).contains(&rested), "the cell rests, and is looked at again: {rested}");
    assert_eq!(frontend.stats().tracks_contradicted, 1);
}

#[test]
fn what_is_covered_is_dropped() {
    let calibration = rig(480, 360);
    let mut frontend = Frontend::new(&calibration, &FrontendConfig::default()).unwrap();
    let mut frames = Arc::new(Frames::for_rig(&calibration));
    see(&calibration, [0.0; 2], 2.0, 0.0, Arc::make_mut(&mut frames));
    let covered = |px: [f32; 2]| (60.0..260.0).contains(&px[0]) && (60.0..180.0).contains(&px[1]);
    let before = frontend.track(&frames, &Prediction::default()).clone();
    for image in &mut Arc::make_mut(&mut frames).images {
        for v in 50..190 {
            for u in 50..270 {
                image.pixels[v * 480 + u] = wall(900.0 - u as f64, 700.0 + v as f64) as u8;
            }
        }
    }
    let after = frontend.track(&frames, &Prediction::default());
    let old = |id: u64| before.cameras[0].iter().any(|a| a.id == id);
    let hidden = before.cameras[0].iter().filter(|a| covered(a.px)).count();
    let survivors = after.cameras[0].iter().filter(|a| covered(a.px) && old(a.id)).count();
    assert!(hidden >= 8 && survivors <= hidden / 10, "{survivors} of {hidden}");
    assert!(after.cameras[0].iter().filter(|a| !covered(a.px) && old(a.id)).count() >= 8);
}

#[test]
fn a_slipped_second_image_matches_nothing() {
    let calibration = rig(320, 240);
    let mut frames = Arc::new(Frames::for_rig(&calibration));
    see(&calibration, [0.0; 2], 2.0, 5.0, Arc::make_mut(&mut frames));
    let mut frontend = Frontend::new(&calibration, &FrontendConfig::default()).unwrap();
    let tracks = frontend.track(&frames, &Prediction::default());
    assert!(tracks.cameras[0].len() >= 12 && tracks.cameras[1].is_empty(), "{}", tracks.cameras[1].len());
}

#[test]
fn a_slip_between_frames_is_caught_by_the_epipolar_gate() {
    let calibration = rig(320, 240);
    let mut frames = Arc::new(Frames::for_rig(&calibration));
    let mut frontend = Frontend::new(&calibration, &FrontendConfig::default()).unwrap();
    see(&calibration, [0.0; 2], 2.0, 0.0, Arc::make_mut(&mut frames));
    let matched = pairs(frontend.track(&frames, &Prediction::default())).len();
    see(&calibration, [0.0; 2], 2.0, 4.0, Arc::make_mut(&mut frames));
    let left = pairs(frontend.track(&frames, &Prediction::default())).len();
    assert!(matched >= 15 && left == 0, "{matched} -> {left}");
    assert!(frontend.stats().tracks_epipolar_rejected as usize >= matched / 2, "{:?}", frontend.stats());
}

#[test]
fn a_near_wall_is_matched_without_a_guess() {
    // 55 px of disparity where the first guess says 7.5
    let calibration = rig(480, 240);
    let mut frames = Arc::new(Frames::for_rig(&calibration));
    see(&calibration, [0.0; 2], 0.55, 0.0, Arc::make_mut(&mut frames));
    let mut frontend = Frontend::new(&calibration, &FrontendConfig::default()).unwrap();
    let tracks = frontend.track(&frames, &Prediction::default());
    let right = pairs(tracks).iter().filter(|(a, b)| (a[0] - b[0] - 54.55).abs() < 0.3).count();
    assert!(right >= 20 && right * 10 >= 9 * pairs(tracks).len(), "{right} of {}", pairs(tracks).len());
}

#[test]
fn more_corners_than_room_are_counted_and_never_stored() {
    let calibration = rig(640, 480);
    let mut frames = Arc::new(Frames::for_rig(&calibration));
    see(&calibration, [0.0; 2], 2.0, 0.0, Arc::make_mut(&mut frames));
    let config = FrontendConfig { grid_px: 16, ..FrontendConfig::default() };
    let mut frontend = Frontend::new(&calibration, &config).unwrap();
    for _ in 0..3 {
        let tracks = frontend.track(&frames, &Prediction::default());
        assert!(tracks.cameras[0].len() > TRACKS * 3 / 4 && tracks.cameras[0].len() <= TRACKS);
        assert!(tracks.cameras[0].windows(2).all(|w| w[0].id < w[1].id));
    }
    assert!(frontend.stats().tracks_full > 0);
}

#[test]
fn a_frame_is_shared_until_the_next_is_tracked() {
    let calibration = rig(320, 240);
    let mut frontend = Frontend::new(&calibration, &FrontendConfig::default()).unwrap();
    let frames = [0, 1, 2].map(|_| Arc::new(Frames::for_rig(&calibration)));
    for (k, frame) in frames.iter().enumerate() {
        frontend.track(frame, &Prediction::default());
        let held: Vec<bool> = frames.iter().map(|f| Arc::strong_count(f) > 1).collect();
        assert_eq!(held, [0, 1, 2].map(|i| i == k), "frame {k}");
    }
}

#[test]
fn tracking_is_deterministic_and_allocates_nothing() {
    let calibration = rig(320, 240);
    let sequence: Vec<Arc<Frames>> = (0..6)
        .map(|k| {
            let mut frames = Arc::new(Frames::for_rig(&calibration));
            see(&calibration, [0.02 * k as f64, 0.0], 2.0, if k == 3 { 4.0 } else { 0.0 }, Arc::make_mut(&mut frames));
            Arc::make_mut(&mut frames).t = Nanos(k);
            frames
        })
        .collect();
    let config = FrontendConfig::default();
    let mut both: Vec<Frontend> = (0..2).map(|_| Frontend::new(&calibration, &config).unwrap()).collect();
    let moved = Some(Pose::new(DQuat::IDENTITY, DVec3::new(-0.02, 0.0, 0.0)));
    let bits = |t: &Tracks| -> Vec<(u64, [u32; 2])> {
        t.cameras.iter().flat_map(|c| c.iter().map(|a| (a.id, a.px.map(f32::to_bits)))).collect()
    };
    for frames in &sequence {
        let mut seen = Vec::new();
        for frontend in &mut both {
            seal_thread();
            let before = heap_after_seal();
            let tracks = frontend.track(frames, &Prediction { prev_from_now: moved });
            let heap = heap_after_seal() - before;
            unsealed(|| {
                assert_eq!(heap, 0);
                seen.push(bits(tracks));
            });
        }
        unsealed(|| assert_eq!(seen[0], seen[1]));
    }
}

/// Flies a rig of the simulator's through its room; answers what the tracker saw, frame by frame, and with it
/// the true poses.
fn fly(rig: &str) -> (Calibration, Vec<(Tracks, Pose)>) {
    let mut scenario = Scenario::named("circle").unwrap();
    (scenario.calibration, scenario.image_divisor) = (rig_named(rig).unwrap(), 2);
    let mut sim = Sim::new(&scenario).unwrap();
    let (calibration, truth) = (sim.calibration().clone(), sim.truth());
    let config = FrontendConfig { grid_px: 40, ..FrontendConfig::default() };
    let mut frontend = Frontend::new(&calibration, &config).unwrap();
    let mut frames = Arc::new(Frames::for_rig(&calibration));
    let (mut flown, mut last) = (Vec::new(), None::<Pose>);
    for i in 20..32 {
        sim.render(i, Arc::make_mut(&mut frames));
        let pose = pose_at(&truth, frames.t, Span::from_secs(0.1)).unwrap();
        let prev_from_now = last.map(|l| l.inverse() * pose);
        last = Some(pose);
        flown.push((frontend.track(&frames, &Prediction { prev_from_now }).clone(), pose));
    }
    eprintln!("{rig}: {:?}", frontend.stats());
    (calibration, flown)
}

/// Median distance of a followed point from the plane its ray and the camera's true motion span, rad.
fn off_plane(calibration: &Calibration, flown: &[(Tracks, Pose)], camera: usize) -> f64 {
    let eye = calibration.cameras[camera];
    let ray = |p: [f32; 2]| eye.camera.unproject(DVec2::new(p[0] as f64, p[1] as f64)).unwrap().normalize();
    let mut off = Vec::new();
    for pair in flown.windows(2) {
        let [then, now] =
            [&pair[0], &pair[1]].map(|(tracks, pose)| (&tracks.cameras[camera], *pose * eye.body_from_cam));
        let now_from_then = now.1.inverse() * then.1;
        for a in then.0.iter() {
            let Ok(i) = now.0.binary_search_by_key(&a.id, |b| b.id) else { continue };
            let (f, g) = (now_from_then.q * ray(a.px), ray(now.0[i].px));
            off.push(g.dot(now_from_then.p.cross(f).normalize()).abs());
        }
    }
    off.sort_by(f64::total_cmp);
    assert!(off.len() >= 100, "camera {camera}: {} followed", off.len());
    off[off.len() / 2]
}

/// Points that two cameras share.
fn shared(tracks: &Tracks, a: usize, b: usize) -> usize {
    let other = &tracks.cameras[b];
    tracks.cameras[a].iter().filter(|t| other.binary_search_by_key(&t.id, |o| o.id).is_ok()).count()
}

#[test]
fn every_camera_of_any_rig_follows_points() {
    for (rig, cameras) in [("mono", 1), ("stereo", 2), ("opposed", 2), ("four", 4)] {
        let (calibration, flown) = fly(rig);
        let seen: Vec<usize> = flown.last().unwrap().0.cameras.iter().map(|c| c.len()).collect();
        assert_eq!(calibration.cameras.len(), cameras);
        assert!(seen[..cameras].iter().all(|n| *n >= 20) && seen[cameras..].iter().all(|n| *n == 0), "{rig}: {seen:?}");
        for camera in 0..cameras {
            let off = off_plane(&calibration, &flown, camera);
            assert!(off < 2e-3, "{rig}, camera {camera}: {off} rad");
        }
    }
}

#[test]
fn what_two_cameras_see_is_one_point_and_what_one_sees_is_its_own() {
    let (_, opposed) = fly("opposed");
    assert!(opposed.iter().all(|(t, _)| shared(t, 0, 1) == 0), "cameras that look apart share nothing");
    for rig in ["stereo", "four"] {
        let (_, flown) = fly(rig);
        let tracks = &flown.last().unwrap().0;
        let (both, own) = (shared(tracks, 0, 1), tracks.cameras[1].len());
        assert!(both >= 20 && 10 * both >= 8 * own, "{rig}: {both} of {own}");
        for camera in tracks.cameras.iter() {
            let near = |a: [f32; 2], b: [f32; 2]| (a[0] - b[0]).hypot(a[1] - b[1]) < 3.0;
            let twice =
                camera.iter().enumerate().filter(|(i, a)| camera[..*i].iter().any(|b| near(a.px, b.px))).count();
            assert!(20 * twice <= camera.len(), "{rig}: {twice} of {} are followed twice", camera.len());
        }
    }
}

#[test]
fn a_camera_whose_partner_is_covered_finds_its_own_points() {
    let calibration = rig(320, 240);
    let mut frames = Arc::new(Frames::for_rig(&calibration));
    let mut frontend = Frontend::new(&calibration, &FrontendConfig::default()).unwrap();
    for k in 0..3 {
        see(&calibration, [0.004 * k as f64, 0.0], 2.0, 0.0, Arc::make_mut(&mut frames));
        Arc::make_mut(&mut frames).images[0].pixels.fill(12);
        let tracks = frontend.track(&frames, &Prediction::default());
        assert!(
            tracks.cameras[0].is_empty() && tracks.cameras[1].len() >= 15,
            "frame {k}: {}",
            tracks.cameras[1].len()
        );
    }
    // uncovered: the same points are found in it, not new ones
    see(&calibration, [0.012, 0.0], 2.0, 0.0, Arc::make_mut(&mut frames));
    let tracks = frontend.track(&frames, &Prediction::default());
    assert!(shared(tracks, 0, 1) >= 12, "{}", shared(tracks, 0, 1));
}

#[test]
fn a_camera_with_an_image_of_another_size_sees_nothing_that_frame() {
    let calibration = rig(320, 240);
    let cut = |pixels: usize| Image { pixels: vec![0; pixels], ..Image::new(320, 240) };
    for wrong in [Image::new(160, 240), Image::new(240, 320), Image::new(640, 480), Image::default(), cut(7)] {
        let mut frontend = Frontend::new(&calibration, &FrontendConfig::default()).unwrap();
        let mut frames = Arc::new(Frames::for_rig(&calibration));
        see(&calibration, [0.0; 2], 2.0, 0.0, Arc::make_mut(&mut frames));
        let before = frontend.track(&frames, &Prediction::default()).clone();
        let good = std::mem::replace(&mut Arc::make_mut(&mut frames).images[1], wrong);
        let lost = frontend.stats().tracks_lost;
        let blind = frontend.track(&frames, &Prediction::default()).clone();
        assert_eq!((frontend.stats().frontend_images_refused, blind.cameras[1].len()), (1, 0));
        assert_eq!(frontend.stats().tracks_lost - lost, before.cameras[1].len() as u64);
        // nothing moved, and the other camera did not notice
        let kept = blind.cameras[0].iter().filter(|a| before.cameras[0].iter().any(|b| a.id == b.id)).count();
        assert_eq!(kept, before.cameras[0].len());
        Arc::make_mut(&mut frames).images[1] = good;
        let after = frontend.track(&frames, &Prediction::default());
        assert!(10 * shared(after, 0, 1) >= 9 * shared(&before, 0, 1), "{}", shared(after, 0, 1));
    }
}

#[test]
fn missing_images_blind_their_cameras_and_spare_ones_are_ignored() {
    let calibration = rig(320, 240);
    let mut frontend = Frontend::new(&calibration, &FrontendConfig::default()).unwrap();
    let mut frames = Arc::new(Frames::for_rig(&calibration));
    see(&calibration, [0.0; 2], 2.0, 0.0, Arc::make_mut(&mut frames));
    let images = frames.images.clone();
    let mut refused = 0;
    for (count, new) in [(0, 2), (2, 0), (1, 1), (2, 0), (0, 2), (3, 1), (0, 2), (2, 0)] {
        Arc::make_mut(&mut frames).images = images.iter().cycle().take(count).cloned().collect();
        refused += new;
        let tracks = frontend.track(&frames, &Prediction::default());
        for camera in 0..2 {
            assert_eq!(tracks.cameras[camera].is_empty(), camera >= count, "camera {camera} of {count} images");
        }
        assert_eq!(frontend.stats().frontend_images_refused, refused, "{count} images");
    }
}

fn recording(name: &str) -> Option<Recording> {
    let root = std::env::var("STIPPLE_RECORDINGS")
        .map(PathBuf::from)
        .unwrap_or_else(|_| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"));
    if !root.join(name).is_dir() {
        eprintln!("ignored: {name}: no recordings");
        return None;
    }
    Some(Recording::open(&root.join(name), &OpenOptions::default()).unwrap())
}

/// Rotation of the body between two instants, from the gyroscope alone.
fn turn(recording: &Recording, from: Nanos, to: Nanos) -> DQuat {
    let (mut q, mut t) = (DQuat::IDENTITY, from);
    for s in recording.imu.iter().skip_while(|s| s.t <= from) {
        let end = s.t.min(to);
        q = (q * DQuat::from_scaled_axis(s.gyro_body * (end - t).secs())).normalize();
        t = end;
        if s.t >= to {
            break;
        }
    }
    q
}

struct Run {
    tracks: Vec<Tracks>,
    truth: Vec<Option<Pose>>,
    stats: Stats,
}

fn replay(recording: &Recording, config: &FrontendConfig) -> Run {
    let mut reader = recording.reader();
    let mut frames = Arc::new(Frames::for_rig(&recording.calibration));
    let mut frontend = Frontend::new(&recording.calibration, config).unwrap();
    let (mut tracks, mut truth, mut last) = (Vec::new(), Vec::new(), None);
    for i in 0..recording.frames.len() {
        reader.read(i, Arc::make_mut(&mut frames)).unwrap();
        let prev_from_now = last.map(|t| Pose::new(turn(recording, t, frames.t), DVec3::ZERO));
        last = Some(frames.t);
        tracks.push(frontend.track(&frames, &Prediction { prev_from_now }).clone());
        truth.push(pose_at(&recording.truth, frames.t, Span::from_secs(0.1)));
    }
    Run { tracks, truth, stats: *frontend.stats() }
}

/// Distances, px, between where points went and where their stereo depth and the true motion put them.
fn reprojection(recording: &Recording, run: &Run, gap: usize) -> Vec<f64> {
    let [left, right] = [recording.calibration.cameras[0], recording.calibration.cameras[1]];
    let right_from_left = right.body_from_cam.inverse() * left.body_from_cam;
    let px = |p: [f32; 2]| DVec2::new(p[0] as f64, p[1] as f64);
    let mut errors = Vec::new();
    for k in gap..run.tracks.len() {
        let (Some(then), Some(now)) = (run.truth[k - gap], run.truth[k]) else { continue };
        let now_from_then = (now * left.body_from_cam).inverse() * (then * left.body_from_cam);
        let find = |k: usize, camera: usize, id: u64| {
            let list = &run.tracks[k].cameras[camera];
            list.binary_search_by_key(&id, |a| a.id).ok().map(|i| px(list[i].px))
        };
        for a in run.tracks[k - gap].cameras[0].iter() {
            let (Some(b), Some(c)) = (find(k - gap, 1, a.id), find(k, 0, a.id)) else { continue };
            let f = left.camera.unproject(px(a.px)).unwrap();
            let g = right.camera.unproject(b).unwrap();
            let (e, h) = (g.cross(right_from_left.p), g.cross(right_from_left.q * f));
            let q = (-e.dot(h) / e.length_squared()).max(0.001);
            let there = left.camera.project(now_from_then.transform(f / q));
            errors.extend(there.map(|p| (p - c).length()));
        }
    }
    errors.sort_by(f64::total_cmp);
    errors
}

/// Points a frame, share of them with a stereo partner, mean frames a point lives, median error px
/// over one frame and over five.
fn judge(name: &str, recording: &Recording, config: &FrontendConfig) -> [f64; 5] {
    let run = replay(recording, config);
    let mut lives: BTreeMap<u64, u32> = BTreeMap::new();
    run.tracks.iter().flat_map(|t| t.cameras[0].iter()).for_each(|a| *lives.entry(a.id).or_default() += 1);
    let points: usize = run.tracks.iter().map(|t| t.cameras[0].len()).sum();
    let stereo: usize = run.tracks.iter().map(|t| pairs(t).len()).sum();
    let median = |gap| {
        let errors = reprojection(recording, &run, gap);
        errors[errors.len() / 2]
    };
    let m = [
        points as f64 / run.tracks.len() as f64,
        stereo as f64 / points as f64,
        points as f64 / lives.len() as f64,
        median(1),
        median(5),
    ];
    eprintln!(
        "{name}: {:.0} points a frame, {:.2} stereo, {:.1} frames long, {:.2} px, {:.2} px, {:?}",
        m[0], m[1], m[2], m[3], m[4], run.stats
    );
    m
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn shaken_recording_agrees_with_its_ground_truth() {
    let Some(recording) = recording("euroc_MH_01_easy_11s") else { return };
    let [points, stereo, length, one, five] = judge("MH_01", &recording, &FrontendConfig::default());
    assert!(points > 118.0 && stereo > 0.6 && length > 6.5);
    assert!(one < 0.3 && five < 1.0);
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn fisheye_recording_agrees_with_its_ground_truth() {
    let Some(recording) = recording("tumvi_room1_fisheye_16") else { return };
    let config = FrontendConfig { grid_px: 70, ..FrontendConfig::default() };
    let [points, stereo, length, one, five] = judge("TUM-VI room1", &recording, &config);
    assert!(points > 100.0 && stereo > 0.75 && length > 7.0);
    assert!(one < 0.6 && five < 0.6);
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn at_rest_points_stay() {
    let Some(recording) = recording("euroc_V1_01_easy_static_1s") else { return };
    let [points, stereo, length, one, five] = judge("V1_01 at rest", &recording, &FrontendConfig::default());
    assert!(points > 76.0 && stereo > 0.7 && length > 15.0);
    assert!(one < 0.1 && five < 0.3);
}
