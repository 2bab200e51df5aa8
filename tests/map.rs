//! The mapper as a whole: keyframes with their true poses in, a map with a measured error out.
#![allow(clippy::unwrap_used)]

mod flight;

use flight::{board, flight, train};
use glam::{DQuat, DVec3};
use std::path::PathBuf;
use std::time::{Duration, Instant};
use stipple::limits::CAMERAS_MAX;
use stipple::map::{Keyframe, Mapper, Panel, PoseCorrection, StepKind};
use stipple::mem::{heap_after_seal, seal_thread, CountingAllocator};
use stipple::output::panel::panel;
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::sim::{Scenario, Sim};
use stipple_drivers::types::pose_at;
use stipple_drivers::{Calibration, Camera, Frames, Lens, Pose, Span};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

/// The same flight through TUM-VI's lenses, 512 px wide.
fn fisheye_flight(count: usize) -> (Calibration, Vec<Keyframe>) {
    let mut scenario = Scenario::named("demo").unwrap();
    scenario.image_divisor = 1;
    let lens = Lens::KannalaBrandt { k: [0.0034, 0.0007, -0.0020, 0.0002] };
    let camera = Camera { width: 512, height: 512, fx: 190.0, fy: 190.0, cx: 254.5, cy: 256.5, lens };
    scenario.calibration.cameras.iter_mut().for_each(|c| c.camera = camera);
    let mut sim = Sim::new(&scenario).unwrap();
    let calibration = sim.calibration().clone();
    let mut frames = Frames::for_rig(&calibration);
    let mut keyframe = |k: usize| {
        sim.render(40 + 10 * k, &mut frames);
        let (images, world_from_body) = (frames.images.clone(), sim.truth_at(frames.t).pose);
        Keyframe { id: k as u64, t: frames.t, world_from_body, images, ..Keyframe::default() }
    };
    let keyframes = (0..count).map(&mut keyframe).collect();
    (calibration, keyframes)
}

/// Where the cameras of a rig sit, the second turned.
fn places(calibration: &Calibration, turned: DVec3) -> [Pose; CAMERAS_MAX] {
    let mut places = std::array::from_fn(|c| calibration.cameras.get(c).map_or(Pose::IDENTITY, |c| c.body_from_cam));
    places[1].q *= DQuat::from_scaled_axis(turned);
    places
}

#[test]
fn fisheye_anchors_are_densified() {
    let (calibration, keyframes) = fisheye_flight(4);
    let run = |densify: u32| {
        let densify = format!("map.densify_max={densify}");
        // By alpha alone, or seeds come where densification would put its own, and as many as are asked for; poses and
        // exposures are true as they are.
        let settings = [
            "map.scale=4",
            "map.projection=fisheye",
            "map.seeds_per_anchor=1500",
            &densify,
            "map.wrong_error=1",
            "map.seeds_per_step=0",
            "map.refine_pose=false",
            "map.refine_exposure=false",
        ];
        let mut mapper = Mapper::open(&calibration, &board(&settings)).unwrap();
        for k in &keyframes {
            mapper.ingest(k).unwrap();
            train(&mut mapper, 60);
        }
        (mapper.evaluate().unwrap().psnr_db.unwrap(), mapper.counters().splats_densified.get())
    };
    let (seeded, densified) = (run(0), run(4096));
    println!("seeded {seeded:?} densified {densified:?}");
    assert!(seeded.1 == 0 && densified.1 > 200 && densified.0 > seeded.0 + 0.1, "{seeded:?} {densified:?}");
}

#[test]
fn flight_becomes_a_map_that_held_out_views_confirm() {
    let (calibration, keyframes) = flight(8);
    let run = || {
        let mut mapper = Mapper::open(&calibration, &board(&[])).unwrap();
        for k in &keyframes {
            mapper.ingest(k).unwrap();
            train(&mut mapper, 20);
        }
        mapper
    };
    let mut mapper = run();
    let quality = mapper.evaluate().unwrap();
    assert_eq!((mapper.keyframe_count(), mapper.iterations()), (8, 160));
    assert!(mapper.anchor_count() >= 1 && mapper.splat_count() > 1000);
    assert!(quality.psnr_db.unwrap() > 20.0, "{quality:?}");
    assert!(quality.psnr_heldout_db.unwrap() > 17.0, "{quality:?}");
    assert!(quality.psnr_heldout_aligned_db.unwrap() > quality.psnr_heldout_db.unwrap() - 0.2, "{quality:?}");
    let panels = mapper.panels(3).unwrap();
    assert_eq!(panels.iter().map(|p| p.name.as_str()).collect::<Vec<_>>(), ["0000", "0003_heldout", "0007_heldout"]);
    // The same keyframes in lockstep give the same map.
    assert!(run().splats().unwrap() == run().splats().unwrap());
}

#[test]
fn a_third_of_the_intersections_makes_as_many_anchors_and_nearly_as_good_a_map() {
    let (calibration, keyframes) = flight(8);
    let run = |intersections: u32| {
        let intersections = format!("budget.intersections={intersections}");
        let board = board(&["map.scale=1", "budget.splats=4000", &intersections]);
        let mut mapper = Mapper::open(&calibration, &board).unwrap();
        for k in &keyframes {
            mapper.ingest(k).unwrap();
            train(&mut mapper, 40);
        }
        let quality = mapper.evaluate().unwrap();
        let counters = mapper.counters();
        let [coarsened, lost, most] =
            [&counters.views_coarsened, &counters.intersections_overflow, &counters.intersections_most]
                .map(|c| c.get());
        println!("{intersections}: {quality:?}, {} anchors, {:?}", mapper.anchor_count(), (coarsened, lost, most));
        (quality.psnr_db.unwrap(), mapper.anchor_count(), coarsened, lost, most)
    };
    let enough = run(400_000);
    assert_eq!((enough.2, enough.3), (0, 0));
    assert!(enough.4 > 3 * 5000, "{enough:?}");
    let few = run(5000);
    assert!(few.2 > 100 && few.3 < 60, "{few:?}");
    assert!(few.0 > enough.0 - 1.5 && few.1.abs_diff(enough.1) * 5 <= enough.1, "{few:?} after {enough:?}");
}

/// A camera that was knocked askew after it was calibrated, by twice as much as the first keyframes know: what odometry learns of
/// it, a part of the way from the calibration to the truth, reaches the pictures, their poses and stereo.
#[test]
fn cameras_that_sit_elsewhere_than_calibrated_are_taken_over_from_keyframes_and_corrections() {
    // A rectified pair loses its depth where rows are off; of raw images a coarse map loses little, dB.
    let flights = [(flight(6), vec![], 1.0), (fisheye_flight(4), vec!["map.scale=4", "map.projection=fisheye"], 0.0)];
    for ((truth, keyframes), settings, lost) in flights {
        let settings = [settings, vec!["map.refine_pose=false", "map.cameras=2"]].concat();
        let rig = |part: f64| places(&truth, (1.0 - part) * DVec3::new(0.03, -0.01, 0.02));
        let run = |calibration: &Calibration, told: Option<f64>| {
            let mut mapper = Mapper::open(calibration, &board(&settings)).unwrap();
            for (n, k) in keyframes.iter().enumerate() {
                let part = |first: f64| if n < 2 { first } else { 1.0 };
                mapper.ingest(&Keyframe { body_from_cam: told.map(|first| rig(part(first))), ..k.clone() }).unwrap();
                for &Keyframe { id, world_from_body, .. } in &keyframes[..if n == 2 { 2 } else { 0 }] {
                    let body_from_cam = told.map(|_| rig(1.0));
                    mapper.correct(&PoseCorrection { id, world_from_body, body_from_cam });
                }
                train(&mut mapper, 40);
            }
            (mapper.evaluate().unwrap().psnr_db.unwrap(), mapper.counters().rectified_anew.get())
        };
        let mut wrong = truth.clone();
        wrong.cameras.iter_mut().zip(rig(0.0)).for_each(|(c, place)| c.body_from_cam = place);
        let (right, untold) = (run(&truth, None), run(&wrong, None));
        let (at_once, told) = (run(&wrong, Some(1.0)), run(&wrong, Some(0.5)));
        println!("PSNR, rectified anew: right {right:?}, told at once {at_once:?}, told {told:?}, not told {untold:?}");
        assert_eq!((right.1, at_once.1, told.1, untold.1), (0, 1, 2, 0));
        // The first depths are those of a pair that is half as far askew. Of the coarse map all is within 0.2 dB.
        let regained = if lost > 0.0 { 0.5 } else { 0.0 };
        let least = untold.0 + regained * (right.0 - untold.0);
        assert!(at_once.0 > right.0 - 0.3 && told.0 > least && untold.0 < right.0 - lost);
    }
}

#[test]
fn held_out_views_are_never_anchors_and_never_trained_on() {
    let (calibration, mut keyframes) = flight(2);
    keyframes.iter_mut().for_each(|k| k.held_out = true);
    let mut mapper = Mapper::open(&calibration, &board(&[])).unwrap();
    for k in &keyframes {
        assert_eq!(mapper.ingest(k).unwrap(), StepKind::Stored);
    }
    assert_eq!(mapper.step(Instant::now() + Duration::from_millis(5)).unwrap().kind, StepKind::Idle);
    assert_eq!((mapper.splat_count(), mapper.iterations(), mapper.anchor_count()), (0, 0, 0));
    assert_eq!(mapper.evaluate().unwrap().psnr_db, None);
}

#[test]
fn full_store_and_pool_are_counted_values() {
    let (calibration, keyframes) = flight(6);
    let tight = ["budget.keyframes=2", "budget.splats=256"];
    let mut mapper = Mapper::open(&calibration, &board(&tight)).unwrap();
    let kinds: Vec<StepKind> = keyframes.iter().map(|k| mapper.ingest(k).unwrap()).collect();
    assert_eq!(kinds[2..], [StepKind::Dropped; 4]);
    train(&mut mapper, 10);
    assert_eq!((mapper.keyframe_count(), mapper.iterations()), (2, 10));
    assert!(mapper.splat_count() <= 256);
    assert_eq!(mapper.counters().keyframe_store_full.get(), 4);
}

#[test]
fn corrections_reach_stored_keyframes_and_their_gaussians() {
    let (calibration, keyframes) = flight(2);
    let mut mapper = Mapper::open(&calibration, &board(&[])).unwrap();
    let truth = keyframes[0].world_from_body;
    let far = Pose { p: truth.p + glam::DVec3::X * 100.0, ..truth };
    mapper.ingest(&Keyframe { world_from_body: far, ..keyframes[0].clone() }).unwrap();
    train(&mut mapper, 1);
    let x = mapper.splats().unwrap()[0].mean[0];
    assert!((f64::from(x) - far.p.x).abs() < 20.0, "seeded where it was: {x}");
    let before = mapper.panels(1).unwrap()[0].psnr_db.unwrap();
    let to = |id, world_from_body| PoseCorrection { id, world_from_body, body_from_cam: None };
    mapper.correct(&to(0, truth));
    train(&mut mapper, 1);
    let x = mapper.splats().unwrap()[0].mean[0];
    assert!((f64::from(x) - truth.p.x).abs() < 20.0, "moved with its anchor: {x}");
    let after = mapper.panels(1).unwrap()[0].psnr_db.unwrap();
    assert!(after > before - 0.5, "the same picture from there: {before} {after}");
    assert_eq!(mapper.counters().blocks_moved.get(), 1);
    // What is not finite is refused, and a keyframe nobody knows is ignored.
    mapper.correct(&to(0, Pose { p: truth.p * f64::NAN, ..truth }));
    mapper.correct(&to(77, far));
    train(&mut mapper, 1);
    assert_eq!(mapper.counters().blocks_moved.get(), 1);
}

#[test]
fn exposure_is_found_but_for_what_all_share() {
    let (calibration, mut keyframes) = flight(8);
    let gains = [1.0, 0.8, 0.6, 0.7, 0.8, 1.0, 1.2, 1.0];
    for (k, gain) in keyframes.iter_mut().zip(gains) {
        k.images.iter_mut().for_each(|i| i.pixels.iter_mut().for_each(|p| *p = (f64::from(*p) * gain) as u8));
    }
    let run = |exposure: &str| {
        let mut mapper = Mapper::open(&calibration, &board(&["map.refine_pose=false", exposure])).unwrap();
        for k in &keyframes {
            mapper.ingest(k).unwrap();
            train(&mut mapper, 30);
        }
        (mapper.evaluate().unwrap(), mapper)
    };
    let (without, _) = run("map.refine_exposure=false");
    let (with, mapper) = run("map.refine_exposure=true");
    println!("{without:?}\n{with:?}");
    assert!(with.psnr_db.unwrap() > without.psnr_db.unwrap() + 2.0);
    assert!(with.psnr_heldout_db.unwrap() > without.psnr_heldout_db.unwrap() + 1.0);
    // Those that see what the first sees; farther on, errors add up from one to the next.
    let mid_grey = |k: usize| mapper.keyframe(k).refined.exposure.observed(0.5);
    for k in [1, 2] {
        let found = mid_grey(k) / mid_grey(0);
        assert!((found / gains[k] - 1.0).abs() < 0.12, "keyframe {k}: {found} for {}", gains[k]);
    }
}

#[test]
fn corrections_compose_with_what_the_mapper_found() {
    let (calibration, mut keyframes) = flight(3);
    let truth = keyframes[1].world_from_body;
    keyframes[1].world_from_body.p += glam::DVec3::new(0.02, -0.02, 0.01);
    let mut mapper = Mapper::open(&calibration, &board(&["map.lr_pose=1e-3"])).unwrap();
    for k in &keyframes {
        mapper.ingest(k).unwrap();
        train(&mut mapper, 60);
    }
    let (given, found) = (mapper.keyframe(1).given, mapper.keyframe(1).refined.body_from_refined);
    assert_eq!(given, keyframes[1].world_from_body);
    // Of the two, which is where is for neither to say; how far apart they are is in the pictures.
    let apart = |a: Pose, b: Pose| (a.inverse() * b).p;
    let (first, truly) = (keyframes[0].world_from_body, apart(keyframes[0].world_from_body, truth));
    let off = |a: Pose, b: Pose| (apart(a, b) - truly).length();
    let refined = |mapper: &Mapper| mapper.keyframe_poses().map(|(_, timed)| timed.pose).collect::<Vec<_>>();
    let (was, is) = (off(first, given), off(refined(&mapper)[0], given * found));
    assert!(is < 0.7 * was, "{is} of {was}");
    let corrected = Pose { p: given.p + glam::DVec3::Z, ..given };
    mapper.correct(&PoseCorrection { id: 1, world_from_body: corrected, body_from_cam: None });
    assert_eq!(refined(&mapper)[1], corrected * found);
}

#[test]
fn evaluation_leaves_no_trace() {
    let (calibration, keyframes) = flight(4);
    let run = |looks: bool| {
        let mut mapper = Mapper::open(&calibration, &board(&[])).unwrap();
        for k in &keyframes {
            mapper.ingest(k).unwrap();
            train(&mut mapper, 10);
            if looks {
                mapper.evaluate().unwrap();
                mapper.sample(1.0).unwrap();
                mapper.panels(2).unwrap();
            }
        }
        train(&mut mapper, 10);
        let found: Vec<_> = mapper.keyframe_poses().collect();
        (mapper.splats().unwrap(), found)
    };
    assert!(run(true) == run(false));
}

#[test]
fn mapper_rests_once_its_views_are_learnt() {
    let (calibration, keyframes) = flight(3);
    let mut mapper =
        Mapper::open(&calibration, &board(&["map.steps_per_keyframe_max=15", "map.burst_iterations=4"])).unwrap();
    for (k, keyframe) in keyframes.iter().enumerate() {
        mapper.ingest(keyframe).unwrap();
        train(&mut mapper, 1000);
        let most = 15 * (k as u64 + 1);
        assert!((most..most + 5).contains(&mapper.iterations()), "{} steps", mapper.iterations());
        assert_eq!(mapper.step(Instant::now()).unwrap().kind, StepKind::Idle);
    }
}

#[test]
fn full_pool_gives_its_least_valuable_for_a_new_view() {
    let (calibration, keyframes) = flight(8);
    let run = |evict: &str| {
        let mut mapper = Mapper::open(&calibration, &board(&["budget.splats=800", evict])).unwrap();
        let mut most = 0;
        for k in &keyframes {
            mapper.ingest(k).unwrap();
            train(&mut mapper, 60);
            most = most.max(mapper.splat_count());
        }
        assert!(most <= 800, "{most}");
        (mapper.counters().splats_evicted.get(), mapper.counters().splats_densified.get())
    };
    let (kept, evicting) = (run("map.evict=false"), run("map.evict=true"));
    assert!(kept.0 == 0 && evicting.0 > 0 && evicting.1 > kept.1, "{kept:?} {evicting:?}");
}

#[test]
fn a_room_seen_again_in_other_light_does_not_double() {
    let (calibration, keyframes) = flight(6);
    let run = |pause: Span| {
        let mut mapper = Mapper::open(&calibration, &board(&["map.wrong_after_steps=0"])).unwrap();
        let mut fly = |keyframes: &[Keyframe]| {
            for k in keyframes {
                mapper.ingest(k).unwrap();
                train(&mut mapper, 60);
            }
            (mapper.splat_count(), mapper.counters().anchors_for_error.get())
        };
        let (once, for_error) = fly(&keyframes);
        let mut again = keyframes.clone();
        for k in &mut again {
            (k.id, k.t) = (k.id + 6, k.t + Span::from_secs(3.0) + pause);
            for image in &mut k.images {
                let width = image.width;
                image
                    .pixels
                    .iter_mut()
                    .enumerate()
                    .filter(|(i, _)| i % width < width / 2)
                    .for_each(|(_, p)| *p = 255 - *p);
            }
        }
        let (twice, for_error_twice) = fly(&again);
        assert!(for_error_twice > for_error, "nothing of the second visit was wrong");
        twice as f64 / once as f64
    };
    let (same_visit, later) = (run(Span::from_secs(0.5)), run(Span::from_secs(60.0)));
    println!("{same_visit:.2} of the Gaussians in the same visit, {later:.2} in a later one");
    assert!(same_visit > 1.3 && later < 1.15, "{same_visit} {later}");
}

#[test]
fn steps_allocate_nothing() {
    let (calibration, mut keyframes) = flight(3);
    for (n, k) in keyframes.iter_mut().enumerate() {
        k.body_from_cam = Some(places(&calibration, DVec3::X * 0.01 * n as f64));
    }
    let mut mapper = Mapper::open(&calibration, &board(&[])).unwrap();
    let sealed = std::thread::spawn(move || {
        seal_thread();
        for k in &keyframes {
            mapper.ingest(k).unwrap();
            train(&mut mapper, 25);
        }
        (heap_after_seal(), mapper.counters().rectified_anew.get())
    });
    assert_eq!(sealed.join().unwrap(), (0, 2));
}

fn recording(name: &str) -> Option<PathBuf> {
    let beside = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let root = std::env::var_os("STIPPLE_RECORDINGS").map_or(beside, PathBuf::from);
    let path = root.join(name);
    path.is_dir().then_some(path)
}

/// Every frame with a true pose is a keyframe, every eighth held out, `steps` training steps after each.
fn play(mapper: &mut Mapper, recording: &Recording, keyframes: usize, steps: u32) {
    let mut frames = Frames::for_rig(&recording.calibration);
    let mut reader = recording.reader();
    let mut id = 0;
    for (i, frame) in recording.frames.iter().enumerate().take(keyframes) {
        let Some(world_from_body) = pose_at(&recording.truth, frame.t, Span(50_000_000)) else { continue };
        reader.read(i, &mut frames).unwrap();
        let images = frames.images.clone();
        let held_out = id % 8 == 7;
        mapper.ingest(&Keyframe { id, t: frame.t, world_from_body, images, held_out, ..Keyframe::default() }).unwrap();
        id += 1;
        train(mapper, steps);
    }
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn recorded_room_becomes_a_map() {
    let Some(path) = recording("euroc_V1_01_easy_keyframes") else {
        return println!("ignored: recorded_room_becomes_a_map: no recordings");
    };
    let recording = Recording::open(&path, &OpenOptions::default()).unwrap();
    let mut mapper = Mapper::open(&recording.calibration, &board(&["map.scale=4"])).unwrap();
    play(&mut mapper, &recording, 12, 25);
    let quality = mapper.evaluate().unwrap();
    assert!(quality.psnr_db.unwrap() > 18.0, "{quality:?}");
    assert!(quality.psnr_heldout_db.unwrap() > 13.0, "{quality:?}");
}

/// The map that steps on a recording's keyframes leave, bit by bit.
fn same_twice(keyframes: usize, steps: u32, at_least: u64) {
    let Some(path) = recording("euroc_V1_01_easy_keyframes") else {
        return println!("ignored: same_twice: no recordings");
    };
    let recording = Recording::open(&path, &OpenOptions::default()).unwrap();
    let run = || {
        let mut mapper = Mapper::open(&recording.calibration, &board(&["map.scale=4"])).unwrap();
        play(&mut mapper, &recording, keyframes, steps);
        assert!(mapper.iterations() >= at_least && mapper.splat_count() > 1000);
        mapper.splats().unwrap()
    };
    let words = |map: &[stipple::map::Gaussian]| bytemuck::cast_slice::<_, u32>(map).to_vec();
    assert!(words(&run()) == words(&run()), "two runs differ");
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn a_recorded_room_maps_to_the_same_bits_twice() {
    same_twice(4, 15, 60);
}

#[test]
#[ignore = "the long form: 500 steps"]
fn a_recorded_room_maps_to_the_same_bits_twice_over_500_steps() {
    same_twice(14, 36, 500);
}

fn write_png(dir: &std::path::Path, p: &Panel) {
    let file = std::fs::File::create(dir.join(format!("{}.png", p.name))).unwrap();
    panel(p).write_png(&mut std::io::BufWriter::new(file)).unwrap();
}

#[test]
fn both_cameras_of_a_pair_train_one_map() {
    let (calibration, keyframes) = flight(4);
    let mut mapper = Mapper::open(&calibration, &board(&["map.cameras=2"])).unwrap();
    for k in &keyframes {
        mapper.ingest(k).unwrap();
        train(&mut mapper, 30);
    }
    let q = mapper.evaluate().unwrap();
    println!("{q:?}");
    assert_eq!(mapper.keyframe_count(), 4);
    let [left, right, others @ ..] = &q.psnr_heldout_by_camera_db[..] else { panic!("{q:?}") };
    assert!(left.unwrap() > 15.0 && right.unwrap() > 15.0, "{q:?}");
    assert_eq!(others, [None; 2]);
}

#[test]
fn fisheye_images_of_other_lenses_are_refused_at_boot() {
    let (calibration, _) = flight(1);
    let board = board(&["map.projection=fisheye"]);
    let said = Mapper::open(&calibration, &board).err().unwrap().to_string();
    assert!(said.contains("map.projection") && said.contains("Kannala-Brandt"), "{said}");
}

#[test]
#[cfg_attr(not(recordings), ignore = "no recordings")]
fn recorded_fisheye_images_become_a_map_as_they_are() {
    let Some(path) = recording("tumvi_room1_fisheye_16") else {
        return println!("ignored: recorded_fisheye_images_become_a_map_as_they_are: no recordings");
    };
    let recording = Recording::open(&path, &OpenOptions::default()).unwrap();
    for cameras in ["map.cameras=1", "map.cameras=2"] {
        let mut mapper =
            Mapper::open(&recording.calibration, &board(&["map.scale=4", "map.projection=fisheye", cameras])).unwrap();
        play(&mut mapper, &recording, 12, 25);
        let q = mapper.evaluate().unwrap();
        println!("{cameras}: {q:?}");
        if let Some(dir) = std::env::var_os("OUT").map(PathBuf::from) {
            mapper.panels(3).unwrap().iter().for_each(|p| write_png(&dir, p));
        }
        assert!(q.psnr_db.unwrap() > 18.0, "{q:?}");
        assert!(q.psnr_heldout_by_camera_db[0].unwrap() > 16.0, "{q:?}");
    }
}

/// An experiment; settings from the environment: SET="map.x=1 ..", KEYFRAMES, STEPS, OUT.
#[test]
#[ignore = "a measurement of minutes"]
fn v1_01_quality() {
    let Some(path) = recording("euroc_V1_01_easy_keyframes") else {
        return println!("ignored: v1_01_quality: no recordings");
    };
    let env = |key: &str, default: usize| std::env::var(key).map_or(default, |v| v.parse().unwrap());
    let set = std::env::var("SET").unwrap_or_default();
    let mut overrides =
        vec!["map.scale=2", "budget.keyframes=160", "budget.splats=60000", "budget.intersections=1500000"];
    overrides.extend(set.split_whitespace());
    let recording = Recording::open(&path, &OpenOptions::default()).unwrap();
    let board = board(&overrides);
    let mut mapper = Mapper::open(&recording.calibration, &board).unwrap();
    println!("{}", mapper.device());
    let start = Instant::now();
    play(&mut mapper, &recording, env("KEYFRAMES", 1000), env("STEPS", 20) as u32);
    let s = start.elapsed().as_secs_f64();
    println!(
        "{} keyframes, {} anchors, {} splats, {} iterations, {s:.1} s",
        mapper.keyframe_count(),
        mapper.anchor_count(),
        mapper.splat_count(),
        mapper.iterations()
    );
    for (name, n) in mapper.counters().list() {
        if n > 0 {
            println!("  {name} {n}");
        }
    }
    for t in mapper.kernel_times() {
        println!(
            "  {:18} {:6} {:9.1} ms total {:8.3} ms each",
            t.name,
            t.count,
            t.total_ms,
            t.total_ms / t.count as f64
        );
    }
    println!("{:?}", mapper.sample(s).unwrap());
    println!("{:?}", mapper.evaluate().unwrap());
    if let Some(dir) = std::env::var_os("OUT").map(PathBuf::from) {
        std::fs::create_dir_all(&dir).unwrap();
        for p in mapper.panels(env("PANELS", 8)).unwrap() {
            write_png(&dir, &p);
            let (mut n, mut sx, mut sy, mut sxx, mut sxy, mut syy) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
            for i in (0..p.valid.len()).filter(|&i| p.valid[i] != 0) {
                let (x, y) = (f64::from(p.rendered[i]), f64::from(p.observed[i]) / 255.0);
                (n, sx, sy, sxx, sxy, syy) = (n + 1.0, sx + x, sy + y, sxx + x * x, sxy + x * y, syy + y * y);
            }
            let gain = (n * sxy - sx * sy) / (n * sxx - sx * sx);
            let rest = (syy - sy * sy / n) / n - gain * gain * (sxx - sx * sx / n) / n;
            println!(
                "{:14} {:6.2} dB, {:6.2} dB with gain {gain:.3}, mean {:.3} for {:.3}",
                p.name,
                p.psnr_db.unwrap(),
                -10.0 * rest.log10(),
                sx / n,
                sy / n
            );
        }
    }
}

/// A covered eye gives no depth: the keyframe is kept to train on, no anchor is made of it, and it is counted.
#[test]
fn a_black_eye_makes_no_anchor_and_is_counted() {
    let (calibration, mut keyframes) = flight(2);
    keyframes[0].images[1].pixels.fill(0);
    let mut mapper = Mapper::open(&calibration, &board(&[])).unwrap();
    assert_eq!(mapper.ingest(&keyframes[0]).unwrap(), StepKind::Stored);
    assert_eq!((mapper.counters().depth_absent.get(), mapper.splat_count()), (1, 0));
    assert!(matches!(mapper.ingest(&keyframes[1]).unwrap(), StepKind::Anchor { seeded } if seeded > 0));
    assert_eq!(mapper.counters().depth_absent.get(), 1);
}

/// A reset moves the frame of what comes after it, here by 0.36 m: the same room from the same places, at other poses.
#[test]
fn epochs_share_no_gaussian() {
    let (calibration, keyframes) = flight(4);
    let shift = Pose { p: glam::DVec3::new(0.3, 0.2, 0.0), ..Pose::IDENTITY };
    let alone = |keyframes: &[Keyframe]| {
        let mut mapper = Mapper::open(&calibration, &board(&[])).unwrap();
        for k in keyframes {
            mapper.ingest(k).unwrap();
            train(&mut mapper, 20);
        }
        mapper
    };
    let later: Vec<Keyframe> = keyframes
        .iter()
        .map(|k| Keyframe { id: k.id + 4, epoch: 1, world_from_body: shift * k.world_from_body, ..k.clone() })
        .collect();
    let mut first = alone(&keyframes[..3]);
    let before = first.splats().unwrap();
    let (one, anchors) = (before.len(), first.anchor_count());
    // Its first view shows nothing of the epoch before, and is an anchor with as many seeds as the first of all.
    let kind = first.ingest(&later[0]).unwrap();
    assert!(matches!(kind, StepKind::Anchor { seeded } if seeded > 500), "{kind:?}");
    // The burst that follows draws views of both epochs. Gaussians of the first learn from the first's alone: a map of the
    // first alone looks no better from there than this one.
    train(&mut first, 120);
    assert!(first.anchor_count() > anchors && first.splat_count() > one);
    let both = first.evaluate().unwrap().psnr_db.unwrap();
    let mut mixed = alone(&keyframes[..3]);
    mixed.ingest(&Keyframe { epoch: 0, ..later[0].clone() }).unwrap();
    train(&mut mixed, 120);
    let mixed = mixed.evaluate().unwrap().psnr_db.unwrap();
    println!("epochs apart {both:.2} dB, as if of one frame {mixed:.2} dB");
    assert!(both > mixed + 1.0, "{both} {mixed}");
}
