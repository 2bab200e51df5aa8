//! The program's commands, and the threads of a run. Threads are started here and nowhere else:
//!
//! | thread | work | heap |
//! |---|---|---|
//! | main | boot, progress, report | free |
//! | camera | waits for frames, or decodes files and delivers them when they are due | free |
//! | imu | waits for inertial samples | free |
//! | tracking | front end and back end in turns; offers keyframes | sealed |
//! | or frontend | follows points (`frontend.threads = 2`) | sealed |
//! | and estimator | estimates, one frame behind at most; offers keyframes | sealed |
//! | mapping | rectification, depth, training; low priority, as are the CPU device's own threads | sealed; OpenCV and the driver allocate behind it |
//! | trigger | starts the cameras' exposures, where a line is wired for it | free |
//! | light | shows the state of a run, where a line is wired for it | free |
//! | writer | writes what is recorded, if anything is; low priority | free |
//!
//! In lockstep pace the main thread is both sensors and mapping too.
//!
//! Queues between them: frames (newest wins, the rest are counted as dropped), inertial samples
//! (never dropped), tracks (two frames: the front end waits for the back end), keyframes (an offer may
//! fail, counted), pose corrections. Tracking waits for nobody, save a moment for the samples up to a frame. Shutdown:
//! the cameras end, tracking drains and ends, mapping ends with the run's time.

mod dataset;
mod doctor;
mod hardware;
mod input;
mod light;
mod live;
mod lockstep;
mod mapping;
mod memory;
mod pipeline;
mod play;
mod progress;
mod record;
mod sensors;
mod summary;
mod tracking;
mod watch;

pub use dataset::check_dataset;
pub use doctor::doctor;
pub use live::{run as run_sensors, Run};
pub use play::Pace;
pub use record::record;

/// What `stipple-bench` starts besides.
#[cfg(feature = "instruments")]
#[doc(hidden)]
pub mod instruments {
    pub use super::input::Input;
    pub use super::memory::{admit, colours};
    pub use super::play::{realtime, Played, Realtime};
    pub use super::progress::Progress;
    pub use super::record::tapped;
    pub use super::sensors::Sensors;
    pub use super::tracking::{OdometryRun, Tracking};
}

use crate::config::Board;
use crate::output::report::Report;
use crate::output::OutputDir;
use input::Input;
use mapping::Mapping;
use play::{play, Play};
use progress::{print, tell};
use std::path::{Path, PathBuf};
use stipple_drivers::replay::read_trajectory;
use stipple_drivers::sim::{rig_named, write_euroc, write_euroc_colour, Scenario, Sim, RIGS};
use stipple_drivers::{Exit, Fault, Span};
use tracking::{OdometryRun, Tracking};

pub struct Replay {
    pub pace: Pace,
    pub poses: Option<PathBuf>,
    pub holdout: u32,
    pub duration_s: Option<f64>,
    /// See `play::Play`.
    pub mapping_s: Option<f64>,
}

/// `stipple replay`
pub fn replay(dataset: &Path, board: &Path, out: &Path, set: &[String], options: &Replay) -> Result<(), Fault> {
    let board = Board::load(board, set)?;
    let input = Input::recording(dataset, &board.replay, &board.rig)?;
    let out = OutputDir::create(out)?;
    let report = run(input, &dataset.display().to_string(), &board, &out, options)?;
    print(summary::seven_lines(&report, &out));
    Ok(())
}

/// Held-out keyframes and length of the demo: ten seconds of flight, then mapping alone.
const DEMO_HOLDOUT: u32 = 8;
const DEMO_SECONDS: f64 = 60.0;
/// The demo's cameras are small already.
const DEMO_SCALE: &str = "map.scale=1";
const DEMO_BOARD: &str = include_str!("../../board-configs/lavapipe.toml");

/// `stipple demo`
pub fn demo(board: Option<&Path>, out: &Path, set: &[String]) -> Result<(), Fault> {
    let set = [&[DEMO_SCALE.to_string()], set].concat();
    let board = match board {
        Some(path) => Board::load(path, &set)?,
        None => Board::parse("board-configs/lavapipe.toml", DEMO_BOARD, &set)?,
    };
    let out = OutputDir::create(out)?;
    let scenario = Scenario::named("demo").expect("the demo's scenario is compiled in");
    let input = Input::rendered(&scenario, memory::colours(&scenario.calibration, &board).len(), rendering_progress)?;
    let options = Replay {
        pace: Pace::Recorded,
        poses: None,
        holdout: DEMO_HOLDOUT,
        duration_s: Some(DEMO_SECONDS),
        mapping_s: None,
    };
    let report = run(input, "the simulated flight", &board, &out, &options)?;
    print(summary::seven_lines(&report, &out));
    Ok(())
}

fn rendering_progress(done: usize, of: usize) {
    if done % 50 == 0 || done == of {
        eprintln!("rendering the flight: {done} of {of} frames");
    }
}

/// Plays an input; leaves its files in `out`.
pub fn run(mut input: Input, place: &str, board: &Board, out: &OutputDir, options: &Replay) -> Result<Report, Fault> {
    memory::admit(place, &input.calibration, board, false)?;
    input.needs_colour(memory::colours(&input.calibration, board).len(), place)?;
    let frames = input.frames_within(options.duration_s);
    let tracking = match &options.poses {
        Some(path) => Tracking::Table(read_trajectory(path)?),
        None => Tracking::Odometry(Box::new(OdometryRun::new(&input.calibration, board, frames)?)),
    };
    let mapping = if board.map.enabled { Some(Mapping::open(&input.calibration, board)?) } else { None };
    for warning in &input.warnings {
        tell(format_args!("stipple: warning: {warning}"));
    }
    let title = summary::Title {
        dataset: input.name.clone(),
        board: board.name.clone(),
        pace: format!("{:?}", options.pace).to_lowercase(),
        scale: board.map.scale,
        truth: std::mem::take(&mut input.truth),
        opened: std::mem::take(&mut input.counters),
    };
    let opened = input.warnings.len();
    let asked = frames as u64;
    let options = Play {
        pace: options.pace,
        holdout: options.holdout,
        duration_s: options.duration_s,
        lockstep_iterations: board.map.lockstep_iterations,
        lockstep_iterations_per_s: board.map.lockstep_iterations_per_s,
        inject: board.inject.clone(),
        mapping_s: options.mapping_s,
    };
    let played = play(input, tracking, mapping, &options);
    for warning in &played.warnings[opened..] {
        tell(format_args!("stipple: warning: {warning}"));
    }
    if played.counters.frames_unreadable.get() == asked {
        let first = played.warnings.get(opened).map_or("", String::as_str);
        let what = format!("none of its {asked} frames can be read, the first: {first}");
        return Err(Fault::new(Exit::Data, place, what, "check that the recording is complete"));
    }
    summary::conclude(title, played, out)
}

pub struct Simulate {
    pub scenario: String,
    pub truth: Option<PathBuf>,
    pub imu: Option<PathBuf>,
    pub duration_s: Option<f64>,
    pub seed: Option<u64>,
    pub rig: Option<String>,
    pub colour: bool,
    pub defects: Defects,
}

/// What is wrong with simulated sensors.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct Defects {
    /// Clock of the inertial unit over that of the images, s; the calibration does not say so
    #[arg(long, value_name = "S", allow_negative_numbers = true, default_value_t = 0.0)]
    time_offset: f64,
    /// Rolling shutter: from the first row to the last, s
    #[arg(long, value_name = "S", default_value_t = 0.0)]
    readout: f64,
    /// The inertial unit reads this fraction too little on every axis
    #[arg(long, value_name = "FRACTION", allow_negative_numbers = true, default_value_t = 0.0)]
    imu_scale: f64,
    /// Fraction of the light that comes and goes
    #[arg(long, value_name = "FRACTION", default_value_t = 0.0)]
    flicker: f64,
    /// How often it does a second
    #[arg(long, value_name = "HZ", default_value_t = 100.0)]
    flicker_hz: f64,
}

impl Defects {
    fn spoil(&self, scenario: &mut Scenario) -> Result<(), Fault> {
        let within = [
            ("--time-offset", self.time_offset, -1.0..=1.0),
            ("--readout", self.readout, 0.0..=0.1),
            ("--imu-scale", self.imu_scale, -0.5..=0.5),
            ("--flicker", self.flicker, 0.0..=1.0),
            ("--flicker-hz", self.flicker_hz, 0.0..=1e4),
        ];
        for (name, value, range) in within {
            if !range.contains(&value) {
                let what = format!("is {value}, must be {} to {}", range.start(), range.end());
                return Err(Fault::new(Exit::Usage, name, what, "choose a value in that range"));
            }
        }
        scenario.camera_errors.time_offset = Span::from_secs(self.time_offset);
        scenario.calibration.cameras.iter_mut().for_each(|c| c.readout = Span::from_secs(self.readout));
        let axes = &mut scenario.imu_errors.axes;
        axes.gyro_scale *= 1.0 + self.imu_scale;
        axes.accel_scale *= 1.0 + self.imu_scale;
        (scenario.light.flicker, scenario.light.flicker_hz) = (self.flicker, self.flicker_hz);
        Ok(())
    }
}

/// `stipple sim`
pub fn simulate(options: &Simulate, out: &Path) -> Result<(), Fault> {
    let mut scenario = match (&options.truth, options.scenario.as_str()) {
        (Some(truth), "euroc") => Scenario::from_euroc(truth, options.imu.as_deref())?,
        (None, name) => Scenario::named(name).ok_or_else(|| unknown_scenario(name))?,
        (Some(_), name) => {
            return Err(Fault::new(
                Exit::Usage,
                name,
                "does not fly a given trajectory",
                "use the scenario `euroc` with --truth",
            ))
        }
    };
    if let Some(s) = options.duration_s {
        scenario.duration = scenario.duration.min(Span::from_secs(s));
    }
    if let Some(seed) = options.seed {
        scenario.seed = seed;
    }
    if let Some(name) = &options.rig {
        let known = || Fault::new(Exit::Usage, name, "is not a rig", format!("choose one of {}", RIGS.join(", ")));
        scenario.calibration = rig_named(name).ok_or_else(known)?;
    }
    options.defects.spoil(&mut scenario)?;
    let mut sim = Sim::new(&scenario)?;
    let write = if options.colour { write_euroc_colour } else { write_euroc };
    write(&mut sim, out, rendering_progress)?;
    println!("{}", out.display());
    Ok(())
}

fn unknown_scenario(name: &str) -> Fault {
    let known = Scenario::names().collect::<Vec<_>>().join(", ");
    Fault::new(Exit::Usage, name, "is not a scenario", format!("choose one of {known}, or `euroc` with --truth"))
}

/// `stipple check`; answers the board.
pub fn check(path: &Path, set: &[String]) -> Result<Board, Fault> {
    let board = Board::load(path, set)?;
    let rig = memory::largest_rig(&board);
    let footprint = memory::footprint(&rig, &board, true);
    memory::print(&footprint);
    memory::admit(&path.display().to_string(), &rig, &board, true)?;
    println!("{:>12}       fits memory_max_mib = {}", "", board.memory_max_mib);
    Ok(board)
}
