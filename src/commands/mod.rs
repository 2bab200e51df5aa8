//! The commands of `stipple`, one file each: their arguments, and what they print.

mod bugreport;
mod calib_check;
mod calib_noise;
mod check;
mod checks;
mod demo;
mod doctor;
mod export;
mod record;
mod recover;
mod replay;
mod run;
mod sim;
mod status;
mod top;

use crate::config::Board;
use crate::output::OutputDir;
use crate::run::sensors::Input;
use crate::run::status::print_out;
use crate::run::summary;
use crate::run::Outcome;
use clap::{Args, Parser, Subcommand};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use stipple_drivers::{Fault, FaultKind};

/// Stereo-inertial odometry and a live 3D Gaussian map, in fixed memory
#[derive(Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Fly with the board's sensors until stopped (SIGINT, SIGTERM): trajectory, map, renders and report go to DIR
    Run(run::Args),
    /// Play a recording: trajectory, map, renders and report go to DIR
    Replay(replay::Args),
    /// Record the board's sensors until stopped (SIGINT, SIGTERM)
    Record(record::Args),
    /// Print how a run goes: from its status socket, on one screen, as JSON or as metrics
    Status(status::Args),
    /// Show how a run goes, live
    Top(top::Args),
    /// Pack what helps to find a fault into one file: the last minutes of the log, board, versions, kernel messages
    Bugreport(bugreport::Args),
    /// Write the trajectory of a run that was killed or cut off, from its log
    Recover(recover::Args),
    /// Write the map of a run, or the part of it that is asked for, from its store
    Export(export::Args),
    /// Fly through a simulated room and map it; needs no data
    Demo(demo::Args),
    /// Write a simulated flight as an EuRoC folder with ground truth
    Sim(sim::Args),
    /// Print the memory table of a board; refuse a board that does not fit
    Check(check::Args),
    /// Judge the calibration of a recording: rectified rows, clock offset, gyro axes and bias, camera attitude
    CalibCheck(calib_check::Args),
    /// Measure the noise of an inertial unit from a recording of it at rest, and print it as a calibration states it
    CalibNoise(calib_noise::Args),
    /// Map for a process that flies; `run` starts it
    #[command(hide = true)]
    MapWorker,
    /// Judge each part of a board and its live sensors, and say what to do
    Doctor(doctor::Args),
}

/// Ends the log, and shows a fault on the LED, where the process is about to end by itself.
fn last_words(why: &str) {
    crate::run::log::close_for_panic(why);
    crate::run::status_led::show_panic();
}

/// Runs the command of the command line.
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(e) => {
            // Printing may fail on a closed pipe; the exit code still says what happened.
            let _ = e.print();
            return if e.use_stderr() { exit_code(FaultKind::Usage) } else { ExitCode::SUCCESS };
        }
    };
    // What these print is all that they do: a reader that stops, as `head` does, has read enough.
    if matches!(
        cli.command,
        Command::Check(_) | Command::Status(_) | Command::CalibCheck(_) | Command::CalibNoise(_) | Command::Doctor(_)
    ) {
        stipple_drivers::host::end_when_unread();
    }
    crate::run::threads::abort_on_panic(last_words);
    let done = match cli.command {
        Command::Run(args) => run::run(&args),
        Command::Replay(args) => replay::replay(&args),
        Command::Record(args) => record::record(&args),
        Command::Recover(args) => recover::recover(&args),
        Command::Status(args) => status::status(&args),
        Command::Top(args) => top::top(&args),
        Command::Bugreport(args) => bugreport::bugreport(&args),
        Command::Export(args) => export::export(&args),
        Command::Demo(args) => demo::demo(&args),
        Command::Sim(args) => sim::sim(&args),
        Command::Check(args) => check::check(&args),
        Command::CalibCheck(args) => calib_check::calib_check(&args),
        Command::CalibNoise(args) => calib_noise::calib_noise(&args),
        Command::Doctor(args) => doctor::doctor(&args),
        Command::MapWorker => crate::run::worker::serve(std::io::stdin().lock(), std::io::stdout().lock()),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(fault) => {
            crate::run::status::print_err(format_args!("stipple: {fault}"));
            exit_code(fault.kind)
        }
    }
}

/// The exit code of `sysexits.h` for each kind of fault.
pub fn exit_code(kind: FaultKind) -> ExitCode {
    ExitCode::from(match kind {
        FaultKind::Usage => 64,
        FaultKind::Data => 65,
        FaultKind::NoInput => 66,
        FaultKind::Unavailable => 69,
        FaultKind::Internal => 70,
        FaultKind::NoOutput => 73,
        FaultKind::Io => 74,
        FaultKind::Config => 78,
    })
}

/// The board that every command reads alike.
#[derive(Args, Clone, Debug, Default)]
pub struct BoardArgs {
    /// Board file, see board-configs/; without it the built-in one for Vulkan on the CPU
    #[arg(long, value_name = "FILE")]
    pub board: Option<PathBuf>,
    /// Set a key of the board file to another value
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
    pub set: Vec<String>,
}

/// The board without a board file.
const BUILT_IN: &str = include_str!("../../board-configs/lavapipe.toml");

impl BoardArgs {
    pub fn load(&self) -> Result<Board, Fault> {
        self.load_with(&[])
    }

    /// With keys that `--set` may override again.
    pub fn load_with(&self, set: &[String]) -> Result<Board, Fault> {
        let set = [set, &self.set].concat();
        match &self.board {
            Some(path) => Board::load(path, &set),
            None => Board::parse("the built-in board", BUILT_IN, &set),
        }
    }

    /// The file, for errors and for what lies beside it.
    fn path(&self) -> &Path {
        self.board.as_deref().unwrap_or(Path::new("the built-in board"))
    }
}

/// The board's sensors, or a recording in their place.
fn open_input(dataset: Option<&Path>, args: &BoardArgs, board: &Board) -> Result<Input, Fault> {
    match dataset {
        Some(dataset) => Input::recording(dataset, None, board),
        None => Input::live(args.path(), board),
    }
}

/// Prints what a flight came to.
fn finish(outcome: Outcome, out: &OutputDir) -> Result<(), Fault> {
    print_out(summary::lines(&outcome.report, out));
    outcome.capture.into_iter().for_each(|line| print_out(format_args!("cameras     {line}")));
    outcome.fault.map_or(Ok(()), Err)
}

/// Parses a positive number of seconds.
fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if s.is_finite() && s > 0.0 => Ok(s),
        _ => Err("must be a positive number".into()),
    }
}

fn rendering_progress(done: usize, of: usize) {
    if done % 50 == 0 || done == of {
        crate::run::status::print_err(format_args!("rendering the flight: {done} of {of} frames"));
    }
}
