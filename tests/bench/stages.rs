//! `stipple-bench stages`: the time of each stage of tracker and estimator and of whole frames of both, on one thread; then
//! the program's own figures of whole runs on one thread and on two.
//!
//! Frames are rendered by the simulator and, where the recordings are, those of MH_01. Calls are timed one by one, and their median
//! is given: the shortest takes 40 times what reading the clock does.

mod window;

use crate::inputs::{self, Folders};
use crate::page::{count, number, text, Page, Part, Table};
use crate::run::default_board;
use crate::table;
use std::hint::black_box;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};
use stipple::config::{FrontendConfig, VioConfig};
use stipple::frontend::instruments::{align_stack, take_stack, Detector, Pyramid, Stack, Warp, STEP_MIN};
use stipple::frontend::{Frontend, Prediction, Tracks};
use stipple::limits::PYRAMID_LEVELS;
use stipple::output::metrics::percentile;
use stipple::output::report::Report;
use stipple::output::OutputDir;
use stipple::run::sensors::Input;
use stipple::run::{fly, Options, Pace, Steps};
use stipple::vio::{Predictor, Vio};
use stipple_drivers::sim::Scenario;
use stipple_drivers::{Calibration, Fault, Frames, ImuSample, Pose, Span};
use window::{Extent, Stages};

/// Part of a flight that is held in memory, s, and how many of its frames pass before any is timed: the estimator's
/// window is full by then.
const SECONDS: f64 = 8.0;
const FRAMES_BEFORE: usize = 120;
/// Length of the simulated flight of the whole runs, s.
const RUN_S: f64 = 11.0;
/// Time for which a stage is called, s, and how often at least.
const STAGE_S: f64 = 0.7;
const CALLS_MIN: usize = 10;
/// The same in a quick run, which only shows that it runs.
const QUICK_S: f64 = 0.0;

/// Times of tracker and estimator by stage, and of whole runs; a minute and a half
#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    folders: Folders,
    /// The simulated flight at half its size, a few calls each, no whole run
    #[arg(long)]
    quick: bool,
}

/// A stage on a flight.
struct Timed {
    flight: &'static str,
    stage: String,
    calls: usize,
    /// Time of a call, s.
    median_s: f64,
    p90_s: f64,
}

struct Clock {
    stage_s: f64,
    timed: Vec<Timed>,
}

impl Clock {
    /// Calls `once`, which answers the time that counts, s.
    fn time(&mut self, flight: &'static str, stage: &str, mut once: impl FnMut() -> Duration) {
        let (mut calls, mut spent_s) = (vec![], 0.0);
        once();
        while calls.len() < CALLS_MIN || spent_s < self.stage_s {
            calls.push(once().as_secs_f64());
            spent_s += calls[calls.len() - 1];
        }
        let rank = |p| percentile(&calls, p).unwrap_or(f64::NAN);
        let timed =
            Timed { flight, stage: stage.to_string(), calls: calls.len(), median_s: rank(0.5), p90_s: rank(0.9) };
        eprintln!("{flight}: {stage}: {:.1} us", 1e6 * timed.median_s);
        self.timed.push(timed);
    }

    /// The same of what may be called as it is.
    fn call<T>(&mut self, flight: &'static str, stage: &str, mut call: impl FnMut() -> T) {
        self.time(flight, stage, || timed(&mut call));
    }
}

fn timed<T>(call: impl FnOnce() -> T) -> Duration {
    let begun = Instant::now();
    black_box(call());
    begun.elapsed()
}

/// A whole run of the program.
struct Run {
    flight: &'static str,
    threads: u32,
    report: Report,
}

pub fn run(args: &Args) -> Result<(), Fault> {
    let out = OutputDir::create(&args.folders.out)?;
    let mut clock = Clock { stage_s: if args.quick { QUICK_S } else { STAGE_S }, timed: vec![] };
    let recording = args.folders.recordings()?.join(inputs::RECORDING);
    let recording = Some(recording).filter(|path| path.is_dir() && !args.quick);
    for flight in std::iter::once(simulated(args.quick)).chain(recording.as_deref().map(recorded)) {
        let flight = flight?;
        tracker_stages(&mut clock, &flight)?;
        estimator_stages(&mut clock, &flight);
        frames(&mut clock, &flight)?;
    }
    let mut runs = vec![];
    for threads in if args.quick { 1..1 } else { 1..3 } {
        runs.push(whole("simulated", None, threads, &out)?);
        runs.extend(recording.as_deref().map(|path| whole("MH_01", Some(path), threads, &out)).transpose()?);
    }
    let what = "tracker and estimator on one thread; whole runs in lockstep without a mapper".to_string();
    let parts = vec![Part::Table(stages_table(&clock.timed)), Part::Table(runs_table(&runs))];
    Page { name: "stages", title: "Odometry: time by stage", what, facts: vec![], parts }.finish(&out)
}

fn stages_table(timed: &[Timed]) -> Table {
    table!("stages", "Stages", timed, |t| false, [
        text("flight") => t.flight,
        text("stage") => t.stage.as_str(),
        count("calls") => t.calls,
        number("median", "us", 1) => 1e6 * t.median_s,
        number("90 %", "us", 1) => 1e6 * t.p90_s,
    ])
}

fn runs_table(runs: &[Run]) -> Table {
    table!("runs", "Whole runs", runs, |r| false, [
        text("flight") => r.flight,
        count("threads") => r.threads,
        number("throughput", "frames/s", 0) => r.report.tracking_fps,
        number("CPU a frame", "ms", 2) => r.report.tracking_cpu_ms,
        number("tracker", "ms", 2) => r.report.frontend_ms_p50,
        number("estimator", "ms", 2) => r.report.estimator_ms_p50,
        number("a frame", "ms", 2) => r.report.tracking_ms_p50,
        number("a frame 99 %", "ms", 2) => r.report.tracking_ms_p99,
    ])
}

/// The program on so many threads, no mapper; without a recording on a simulated flight held in memory.
fn whole(flight: &'static str, recording: Option<&Path>, threads: u32, out: &OutputDir) -> Result<Run, Fault> {
    let board = default_board(&["map.enabled=false".into(), format!("frontend.threads={threads}")])?;
    let input = match recording {
        Some(path) => Input::recording(path, None, &board)?,
        None => {
            let mut scenario = Scenario::named("circle").expect("a scenario of the simulator");
            scenario.duration = Span::from_secs(RUN_S);
            Input::rendered(&scenario, 0, |_, _| {})?
        }
    };
    let options = Options { pace: Pace::Lockstep(Steps::PerFrame(0)), fresh: true, ..Options::default() };
    let dir = OutputDir::create(&out.file(&format!("run-{flight}-{threads}")))?;
    let report = fly(input, &board, &dir, &options, None)?.report;
    Ok(Run { flight, threads, report })
}

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
fn deliver<'a>(imu: &mut impl Iterator<Item = &'a ImuSample>, frames: &Frames, mut take: impl FnMut(ImuSample)) {
    for s in imu {
        take(*s);
        if s.t >= frames.t {
            break;
        }
    }
}

fn prepare(name: &'static str, input: inputs::Flight) -> Result<Flight, Fault> {
    let inputs::Flight { calibration, imu, frames, .. } = input;
    let mut frontend = Frontend::new(&calibration, &FrontendConfig::default())?;
    let mut vio = Vio::new(&calibration, &VioConfig::default());
    let (mut predicted, mut tracks) = (Vec::new(), Vec::new());
    let mut predictor = Predictor::new(&calibration, &VioConfig::default());
    let mut before = None;
    let mut samples = imu.iter();
    for f in &frames {
        deliver(&mut samples, f, |s| {
            vio.on_imu(s);
            predictor.on_imu(s);
        });
        let prev_from_now = predictor.motion_to(f.t, before.as_ref());
        before = vio.odometry();
        predicted.push(prev_from_now);
        let found = frontend.track(f, &Prediction { prev_from_now });
        vio.on_tracks(found);
        tracks.push(found.clone());
    }
    drop(samples);
    Ok(Flight { name, calibration, imu, frames, predicted, tracks })
}

fn simulated(quick: bool) -> Result<Flight, Fault> {
    let mut scenario = Scenario::named("circle").expect("a scenario of the simulator");
    scenario.image_divisor = if quick { 2 } else { 1 };
    prepare("simulated", inputs::rendered(scenario, SECONDS)?)
}

fn recorded(path: &Path) -> Result<Flight, Fault> {
    prepare("MH_01", inputs::read(path, SECONDS)?)
}

/// The stages of the tracker on a frame in the middle of the flight.
fn tracker_stages(clock: &mut Clock, flight: &Flight) -> Result<(), Fault> {
    let (name, config) = (flight.name, FrontendConfig::default());
    let camera = &flight.calibration.cameras[0].camera;
    let (before, now) = (&flight.frames[FRAMES_BEFORE], &flight.frames[FRAMES_BEFORE + 1]);
    let pyramid = |frames: &Frames, camera: usize| {
        let image = &frames.images[camera];
        let mut pyramid = Pyramid::new(image.width, image.height);
        pyramid.build(image);
        pyramid
    };
    let mut built = pyramid(now, 0);
    clock.call(name, "pyramid, one image", || built.build(black_box(&now.images[0])));
    let mut detector = Detector::new(camera.width, camera.height, &config);
    clock.call(name, "detection, every cell of one image", || {
        detector.detect(&now.images[0], std::iter::empty(), 0, usize::MAX).0.len()
    });
    let points: Vec<[f32; 2]> = flight.tracks[FRAMES_BEFORE].cameras[0].iter().map(|t| t.px).collect();
    let (old, new) = (pyramid(before, 0), pyramid(now, 0));
    let (old, new) = (old.over(&before.images[0]), new.over(&now.images[0]));
    let mut stack = Stack::default();
    let mut next = points.iter().cycle();
    let mut pick = || *next.next().expect("a flight in mid-air is tracked");
    clock.time(name, "patch, taken at all levels", || {
        let px = pick();
        timed(|| take_stack(&mut stack, &old, px, 0..PYRAMID_LEVELS))
    });
    clock.time(name, "patch, aligned from the coarsest level", || {
        let px = pick();
        take_stack(&mut stack, &old, px, 0..PYRAMID_LEVELS);
        let iterations = config.iterations as usize;
        timed(|| align_stack(&stack, &new, Warp::upright(px), PYRAMID_LEVELS - 1, iterations, STEP_MIN))
    });
    let mut frontend = Frontend::new(&flight.calibration, &config)?;
    clock.time(name, "first frame: detection and stereo match", || {
        frontend = Frontend::new(&flight.calibration, &config).expect("it was made of the same before");
        timed(|| frontend.track(before, &Prediction::default()).cameras[1].len())
    });
    Ok(())
}

/// The last windows of the flight stopped as a frame came in: one that is no keyframe, one that becomes one, and,
/// optimized, one that only a state leaves and one that a keyframe leaves too.
fn windows(flight: &Flight) -> [Option<Stages>; 4] {
    let mut vio = Vio::new(&flight.calibration, &VioConfig::default());
    let (mut imu, mut found) = (flight.imu.iter(), [const { None }; 4]);
    for (i, f) in flight.frames.iter().enumerate() {
        deliver(&mut imu, f, |s| vio.on_imu(s));
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
fn estimator_stages(clock: &mut Clock, flight: &Flight) {
    let name = flight.name;
    let [plain, keyframe, state_leaves, keyframe_leaves] = windows(flight);
    if let Some(mut s) = plain {
        let (Extent { frames, landmarks, views, columns }, n) = (s.extent(), s.clone().optimize().iterations);
        let of = format!("{landmarks} landmarks in {views} views, {columns} columns, {n} iterations");
        println!("{name}: a window of {frames} frames, {of}");
        clock.call(name, "preintegration, a frame interval", || s.preintegrate());
        clock.call(name, "landmark rows", || s.view_rows());
        clock.call(name, "linearisation, all factors summed", || s.linearize());
        clock.call(name, "damped solve", || s.solve());
        clock.call(name, "covariance of the newest state", || s.covariance());
        clock.call(name, "cost", || s.cost());
        clock.time(name, "all iterations", on_copies(&s, Stages::optimize));
    }
    let mut apart = |stage, stages: Option<Stages>, run: fn(&mut Stages) -> usize| match stages {
        Some(s) => clock.time(name, stage, on_copies(&s, run)),
        None => println!("{name}: {stage}: no such frame"),
    };
    apart("triangulation of a keyframe", keyframe, Stages::triangulate);
    apart("marginalisation, a state leaves", state_leaves, Stages::marginalize);
    apart("marginalisation, a keyframe too", keyframe_leaves, Stages::marginalize);
}

/// A stage that changes what it works on.
fn on_copies<'a, T>(stages: &'a Stages, mut run: impl FnMut(&mut Stages) -> T + 'a) -> impl FnMut() -> Duration + 'a {
    move || {
        let mut copy = stages.clone();
        timed(|| run(&mut copy))
    }
}

/// Whole frames of each half, one thread: those past the first in turn, starting over as often as it takes.
fn frames(clock: &mut Clock, flight: &Flight) -> Result<(), Fault> {
    let fresh = || Frontend::new(&flight.calibration, &FrontendConfig::default());
    let (mut frontend, mut i) = (fresh()?, 0);
    let mut track = || {
        if i == flight.frames.len() {
            (frontend, i) = (fresh().expect("it was made of the same before"), 0);
        }
        i += 1;
        let prediction = Prediction { prev_from_now: flight.predicted[i - 1] };
        let took = timed(|| frontend.track(&flight.frames[i - 1], &prediction).cameras[0].len());
        (i > FRAMES_BEFORE).then_some(took)
    };
    clock.time(flight.name, "tracker, a frame", || {
        std::iter::repeat_with(&mut track).flatten().next().expect("endless")
    });
    let fresh = || (Vio::new(&flight.calibration, &VioConfig::default()), flight.imu.iter());
    let ((mut vio, mut imu), mut i) = (fresh(), 0);
    let mut estimate = || {
        if i == flight.frames.len() {
            ((vio, imu), i) = (fresh(), 0);
        }
        i += 1;
        let took = timed(|| {
            deliver(&mut imu, &flight.frames[i - 1], |s| vio.on_imu(s));
            vio.on_tracks(&flight.tracks[i - 1])
        });
        (i > FRAMES_BEFORE).then_some(took)
    };
    clock.time(flight.name, "estimator, a frame", || {
        std::iter::repeat_with(&mut estimate).flatten().next().expect("endless")
    });
    Ok(())
}
