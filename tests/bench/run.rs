//! Runs of the whole program, in this process: a recording or the demo's flight through odometry and map in lockstep.

use std::path::PathBuf;
use stipple::config::Board;
use stipple::output::report::Report;
use stipple::output::OutputDir;
use stipple::run::sensors::Input;
use stipple::run::{fly, memory, Options, Pace, Steps};
use stipple_drivers::sim::Scenario;
use stipple_drivers::{Fault, Span};

/// The board of the benches that are given none: Vulkan on the CPU, the estimator at the method's defaults.
pub const BOARD_NAME: &str = "board-configs/lavapipe.toml";
const BOARD: &str = include_str!("../../board-configs/lavapipe.toml");
/// The demo's cameras are small already.
const DEMO_SCALE: &str = "map.scale=1";
/// Every so many keyframes one is held out.
const HOLDOUT: u32 = 8;
/// Seconds of the demo's flight that a quick run plays.
const QUICK_FLIGHT_S: f64 = 3.0;

/// Settings of a flight whose images are made at half the cameras' resolution, to be rendered in less time: the map is drawn at
/// the images' full size, and the tracker's cells are half as wide, so that there are as many points as in whole images.
const SMALL_IMAGES: [&str; 2] = ["map.scale=1", "frontend.grid_px=30"];

/// The settings that a scenario's images ask for, and after them those given, which may change them.
pub fn settings_for(scenario: &Scenario, set: &[String]) -> Vec<String> {
    let small: &[&str] = if scenario.image_divisor == 2 { &SMALL_IMAGES } else { &[] };
    small.iter().map(|s| s.to_string()).chain(set.iter().cloned()).collect()
}

pub fn default_board(set: &[String]) -> Result<Board, Fault> {
    Board::parse(BOARD_NAME, BOARD, set)
}

/// The input of every run of a bench, and its settings.
pub struct Source {
    /// Recording, as for replay; without it the simulated flight of the demo.
    pub dataset: Option<PathBuf>,
    pub board: Option<PathBuf>,
    /// Table of poses in place of odometry.
    pub poses: Option<PathBuf>,
    /// `--set` of every run.
    pub set: Vec<String>,
}

/// One run to make.
pub struct Job<'a> {
    /// Overrides the board and the source's own; the last wins.
    pub set: &'a [String],
    /// The mapper's pace.
    pub steps: Steps,
    /// A small input will do.
    pub quick: bool,
}

impl Source {
    /// Plays the job in lockstep, every eighth keyframe held out; leaves the run's files in `out`.
    pub fn play(&self, job: &Job, out: &OutputDir) -> Result<Report, Fault> {
        let demo_scale = self.dataset.is_none().then(|| DEMO_SCALE.to_string());
        let set: Vec<String> = demo_scale.iter().chain(&self.set).chain(job.set).cloned().collect();
        let board = match &self.board {
            Some(path) => Board::load(path, &set)?,
            None => default_board(&set)?,
        };
        let input = match &self.dataset {
            Some(path) => Input::recording(path, None, &board)?,
            None => {
                let mut scenario = Scenario::named("demo").expect("the demo's scenario is compiled in");
                if job.quick {
                    scenario.duration = scenario.duration.min(Span::from_secs(QUICK_FLIGHT_S));
                }
                Input::rendered(&scenario, memory::colours(&scenario.calibration, &board).len(), |_, _| {})?
            }
        };
        let pace = Pace::Lockstep(job.steps);
        let options = Options { pace, poses: self.poses.clone(), holdout: HOLDOUT, fresh: true, ..Options::default() };
        Ok(fly(input, &board, out, &options, None)?.report)
    }
}
