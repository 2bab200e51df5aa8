//! Times of the odometry: each stage of tracker and estimator and whole frames of both on one thread
//! (criterion), then the program's own figures of whole runs on one thread and on two.
//!
//! On frames the simulator renders and, where the recordings are, on MH_01. `make bench-odometry`.
#![allow(clippy::unwrap_used)]

use criterion::measurement::WallTime;
use criterion::{BatchSize, Bencher, BenchmarkGroup, Criterion};
use std::hint::black_box;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::time::{Duration, Instant};
use stipple::config::{FrontendConfig, VioConfig};
use stipple::frontend::detect::Detector;
use stipple::frontend::patch::{align_stack, take_stack, Stack, Warp, STEP_MIN};
use stipple::frontend::pyramid::Pyramid;
use stipple::frontend::{Frontend, Prediction, Tracks};
use stipple::limits::PYRAMID_LEVELS;
use stipple::vio::stages::{Extent, Stages};
use stipple::vio::Vio;
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::sim::{Scenario, Sim};
use stipple_drivers::{Calibration, Frames, ImuSample, Pose};

/// Frames of a flight held in memory, and how many of them pass before any is timed: the estimator's
/// window is full by then.
const FRAMES: usize = 160;
const FRAMES_BEFORE: usize = 120;
/// Flights of the whole-run figures, s.
const RUN_SECONDS: &str = "11";

/// A flight as tracker and estimator meet it: predictions and tracks as they were in a whole run.
struct Flight {
    name: &'static str,
    calibration: Calibration,
    imu: Vec<ImuSample>,
    frames: Vec<Arc<Frames>>,
    predicted: Vec<Option<Pose>>,
    tracks: Vec<Tracks>,
}

/// Samples of the estimator up to the first past each frame.
fn deliver<'a>(vio: &mut Vio, imu: &mut impl Iterator<Item = &'a ImuSample>, frames: &Frames) {
    for s in imu {
        vio.on_imu(*s);
        if s.t >= frames.t {
            break;
        }
    }
}

fn prepare(name: &'static str, calibration: Calibration, imu: Vec<ImuSample>, frames: Vec<Arc<Frames>>) -> Flight {
    let mut frontend = Frontend::new(&calibration, &FrontendConfig::default()).unwrap();
    let mut vio = Vio::new(&calibration, &VioConfig::default());
    let (mut predicted, mut tracks) = (Vec::new(), Vec::new());
    let mut samples = imu.iter();
    for f in &frames {
        deliver(&mut vio, &mut samples, f);
        let prev_from_now = vio.predict_motion(f.t);
        predicted.push(prev_from_now);
        tracks.push(frontend.track(f, &Prediction { prev_from_now }).clone());
        vio.on_tracks(tracks.last().unwrap());
    }
    drop(samples);
    Flight { name, calibration, imu, frames, predicted, tracks }
}

fn simulated() -> Flight {
    let mut sim = Sim::new(&Scenario::named("circle").unwrap()).unwrap();
    let calibration = sim.calibration().clone();
    let render = |i| {
        let mut frames = Frames::for_rig(&calibration);
        sim.render(i, &mut frames);
        Arc::new(frames)
    };
    let frames = (0..FRAMES).map(render).collect();
    let imu = sim.imu().to_vec();
    prepare("simulated", calibration, imu, frames)
}

fn recording() -> Option<PathBuf> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let path = std::env::var_os("STIPPLE_RECORDINGS").map_or(beside, PathBuf::from).join("euroc_MH_01_easy_11s");
    path.is_dir().then_some(path)
}

fn recorded() -> Option<Flight> {
    let recording = Recording::open(&recording()?, &OpenOptions::default()).unwrap();
    let mut reader = recording.reader();
    let read = |i| {
        let mut frames = Frames::for_rig(&recording.calibration);
        reader.read(i, &mut frames).unwrap();
        Arc::new(frames)
    };
    let frames = (0..FRAMES.min(recording.frames.len())).map(read).collect();
    Some(prepare("MH_01", recording.calibration, recording.imu, frames))
}

/// The stages of the tracker on a frame in the middle of the flight.
fn tracker_stages(c: &mut Criterion, flight: &Flight) {
    let mut group = c.benchmark_group(flight.name);
    let config = FrontendConfig::default();
    let camera = &flight.calibration.cameras[0].camera;
    let (before, now) = (&flight.frames[FRAMES_BEFORE], &flight.frames[FRAMES_BEFORE + 1]);
    let pyramid = |frames: &Frames, camera: usize| {
        let image = &frames.images[camera];
        let mut pyramid = Pyramid::new(image.width, image.height);
        pyramid.build(image);
        pyramid
    };
    let mut built = pyramid(now, 0);
    group.bench_function("pyramid, one image", |b| b.iter(|| built.build(black_box(&now.images[0]))));
    let mut detector = Detector::new(camera.width, camera.height, &config);
    group.bench_function("detection, every cell of one image", |b| {
        b.iter(|| black_box(detector.detect(&now.images[0], std::iter::empty(), 0, usize::MAX).0.len()))
    });
    let points: Vec<[f32; 2]> = flight.tracks[FRAMES_BEFORE].cameras[0].iter().map(|t| t.px).collect();
    let (old, new) = (pyramid(before, 0), pyramid(now, 0));
    let (old, new) = (old.over(&before.images[0]), new.over(&now.images[0]));
    let mut stack = Stack::default();
    let mut next = points.iter().cycle();
    group.bench_function("patch, taken at all levels", |b| {
        b.iter(|| take_stack(&mut stack, &old, *next.next().unwrap(), 0..PYRAMID_LEVELS))
    });
    group.bench_function("patch, aligned from the coarsest level", |b| {
        let pick = || {
            let px = *next.next().unwrap();
            let mut stack = Stack::default();
            take_stack(&mut stack, &old, px, 0..PYRAMID_LEVELS);
            (stack, px)
        };
        let align = |(stack, px): (Stack, [f32; 2])| {
            align_stack(&stack, &new, Warp::upright(px), PYRAMID_LEVELS - 1, config.iterations as usize, STEP_MIN)
        };
        b.iter_batched(pick, align, BatchSize::SmallInput)
    });
    group.bench_function("first frame: detection and stereo match", |b| {
        let new = || Frontend::new(&flight.calibration, &config).unwrap();
        b.iter_batched_ref(new, |f| f.track(before, &Prediction::default()).cameras[1].len(), BatchSize::LargeInput)
    });
    group.finish();
}

/// The last windows of the flight stopped as a frame came in: one that is no keyframe, one that becomes one, and,
/// optimised, one that only a state leaves and one that a keyframe leaves too.
fn windows(flight: &Flight) -> [Option<Stages>; 4] {
    let mut vio = Vio::new(&flight.calibration, &VioConfig::default());
    let (mut imu, mut found) = (flight.imu.iter(), [const { None }; 4]);
    for (i, f) in flight.frames.iter().enumerate() {
        deliver(&mut vio, &mut imu, f);
        let entered = Stages::new(&vio, &flight.tracks[i]).filter(|_| i >= FRAMES_BEFORE);
        vio.on_tracks(&flight.tracks[i]);
        let Some(mut stages) = entered else { continue };
        found[usize::from(stages.keyframe)] = Some(stages.clone());
        if stages.keyframe {
            stages.triangulate();
        }
        stages.optimize();
        let left = stages.clone().marginalize();
        found[2 + left.min(1)] = Some(stages);
    }
    found
}

/// The stages of the estimator.
fn estimator_stages(c: &mut Criterion, flight: &Flight) {
    let [plain, keyframe, state_leaves, keyframe_leaves] = windows(flight);
    let mut group = c.benchmark_group(flight.name);
    if let Some(mut s) = plain {
        let (Extent { frames, landmarks, views, columns }, n) = (s.extent(), s.clone().optimize().iterations);
        let of = format!("{landmarks} landmarks in {views} views, {columns} columns, {n} iterations");
        println!("{}: a window of {frames} frames, {of}", flight.name);
        group.bench_function("preintegration, a frame interval", |b| b.iter(|| black_box(s.preintegrate())));
        group.bench_function("landmark rows and their elimination", |b| b.iter(|| black_box(s.eliminate())));
        group.bench_function("linearisation, all factors summed", |b| b.iter(|| black_box(s.linearize())));
        group.bench_function("damped solve", |b| b.iter(|| black_box(s.solve())));
        group.bench_function("covariance of the newest state", |b| b.iter(|| black_box(s.covariance())));
        group.bench_function("cost", |b| b.iter(|| black_box(s.cost())));
        group.bench_function("all iterations", |b| on_copies(b, &s, Stages::optimize));
    }
    let mut apart = |name, stages: Option<Stages>, stage: fn(&mut Stages) -> usize| match stages {
        Some(s) => drop(group.bench_function(name, |b| on_copies(b, &s, stage))),
        None => println!("{}: {name}: no such frame", flight.name),
    };
    apart("triangulation of a keyframe", keyframe, Stages::triangulate);
    apart("marginalisation, a state leaves", state_leaves, Stages::marginalize);
    apart("marginalisation, a keyframe too", keyframe_leaves, Stages::marginalize);
    group.finish();
}

/// A stage that changes what it works on.
fn on_copies<T>(b: &mut Bencher, stages: &Stages, run: impl FnMut(&mut Stages) -> T) {
    b.iter_batched_ref(|| stages.clone(), run, BatchSize::PerIteration)
}

/// Times the frames past the first in turn, starting over as often as it takes. `start` makes what `step` moves
/// on by a frame, answering the time that counts.
fn play<T>(
    group: &mut BenchmarkGroup<WallTime>,
    name: &str,
    flight: &Flight,
    start: impl Fn() -> T,
    mut step: impl FnMut(&mut T, usize) -> Duration,
) {
    let (mut state, mut i) = (start(), 0);
    let mut next = || loop {
        if i == flight.frames.len() {
            (state, i) = (start(), 0);
        }
        let took = step(&mut state, i);
        i += 1;
        if i > FRAMES_BEFORE {
            return took;
        }
    };
    // Criterion would take the frames before for a part of the first.
    next();
    group.bench_function(name, |b| b.iter_custom(|n| (0..n).map(|_| next()).sum()));
}

/// Whole frames of each half, one thread.
fn frames(c: &mut Criterion, flight: &Flight) {
    let mut group = c.benchmark_group(flight.name);
    let start = || Frontend::new(&flight.calibration, &FrontendConfig::default()).unwrap();
    play(&mut group, "tracker, a frame", flight, start, |frontend, i| {
        let begun = Instant::now();
        black_box(frontend.track(&flight.frames[i], &Prediction { prev_from_now: flight.predicted[i] }));
        begun.elapsed()
    });
    let start = || (Vio::new(&flight.calibration, &VioConfig::default()), flight.imu.iter());
    play(&mut group, "estimator, a frame", flight, start, |(vio, imu), i| {
        let begun = Instant::now();
        deliver(vio, imu, &flight.frames[i]);
        black_box(vio.on_tracks(&flight.tracks[i]));
        begun.elapsed()
    });
    group.finish();
}

/// The program on one thread and on two, frames in memory, no mapper.
fn runs(dataset: &Path, name: &str, scratch: &Path) {
    for threads in [1, 2] {
        let out = scratch.join(format!("{threads}"));
        let output = Command::new(env!("CARGO_BIN_EXE_stipple"))
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .args(["replay", dataset.to_str().unwrap(), "--out", out.to_str().unwrap(), "--pace", "lockstep"])
            .args(["--board", "board-configs/lavapipe.toml", "--set", "map.enabled=false", "--set"])
            .arg(format!("frontend.threads={threads}"))
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let report: serde_json::Value =
            serde_json::from_slice(&std::fs::read(out.join("report.json")).unwrap()).unwrap();
        let of = |key: &str| report[key].as_f64().unwrap();
        println!(
            "{name}, {threads} thread(s): {:.0} frames/s, {:.2} ms of CPU a frame; tracker {:.2} ms, estimator {:.2} ms, \
             a frame {:.2} ms, {:.2} ms at the 99th percentile ({:.1} times)",
            of("tracking_fps"),
            of("tracking_cpu_ms"),
            of("frontend_ms_p50"),
            of("estimator_ms_p50"),
            of("tracking_ms_p50"),
            of("tracking_ms_p99"),
            of("tracking_ms_p99") / of("tracking_ms_p50"),
        );
    }
}

fn main() {
    let mut criterion = Criterion::default()
        .sample_size(10)
        .nresamples(10_000)
        .warm_up_time(Duration::from_millis(100))
        .measurement_time(Duration::from_millis(700))
        .without_plots()
        .configure_from_args();
    for flight in std::iter::once(simulated()).chain(recorded()) {
        tracker_stages(&mut criterion, &flight);
        estimator_stages(&mut criterion, &flight);
        frames(&mut criterion, &flight);
    }
    criterion.final_summary();
    let scratch = tempfile::tempdir().unwrap();
    let flight = scratch.path().join("flight");
    let simulate = ["sim", "circle", "--duration", RUN_SECONDS, "--out", flight.to_str().unwrap()];
    assert!(Command::new(env!("CARGO_BIN_EXE_stipple")).args(simulate).output().unwrap().status.success());
    runs(&flight, "simulated", scratch.path());
    match recording() {
        Some(path) => runs(&path, "MH_01", scratch.path()),
        None => println!("MH_01: no recording"),
    }
}
