//! `stipple`: argv to subcommand; nothing else.

use clap::{Parser, Subcommand};
use std::path::PathBuf;
use std::process::ExitCode;
use stipple::daemon::{self, Pace};
use stipple::mem::CountingAllocator;
use stipple_drivers::record::Format;
use stipple_drivers::{Exit, Fault};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

/// Stereo-inertial odometry and a live 3D Gaussian map, in fixed memory
#[derive(Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Play a recording: trajectory, map, renders and report go to DIR
    Replay {
        /// EuRoC ASL folder (holding mav0) of one to four cameras, or TUM-VI with a Kalibr camchain.yaml
        dataset: PathBuf,
        /// Board file, see board-configs/
        #[arg(long, value_name = "FILE")]
        board: PathBuf,
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
        #[arg(long, value_enum, default_value = "recorded")]
        pace: Pace,
        /// Skip odometry: poses from this table (EuRoC or TUM csv); every frame it covers is a keyframe
        #[arg(long, value_name = "CSV")]
        poses: Option<PathBuf>,
        /// Every Nth keyframe is never trained on, only evaluated
        #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..))]
        holdout: Option<u32>,
        /// End after this time of the recording; past its end the mapper goes on alone
        #[arg(long, value_name = "S", value_parser = seconds)]
        duration: Option<f64>,
        /// Mapping resolution divisor: 1, 2 or 4 (short for --set map.scale=N)
        #[arg(long, value_name = "N", value_parser = ["1", "2", "4"])]
        scale: Option<String>,
        /// Override a key of the board file
        #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
        set: Vec<String>,
    },
    /// Run the board's sensors until stopped (SIGINT, SIGTERM); leaves what a replay leaves
    Run {
        /// Board file, see board-configs/
        board: PathBuf,
        #[arg(long, value_name = "DIR", default_value = "out/run")]
        out: PathBuf,
        /// Stop after this time
        #[arg(long, value_name = "S", value_parser = seconds)]
        duration: Option<f64>,
        /// A recording in the place of the sensors, as for replay, at its pace
        #[arg(long, value_name = "DIR")]
        dataset: Option<PathBuf>,
        /// Record what the sensors give as EuRoC ASL, too
        #[arg(long, value_name = "DIR")]
        record: Option<PathBuf>,
        /// Override a key of the board file
        #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
        set: Vec<String>,
    },
    /// Record the board's sensors until stopped (SIGINT, SIGTERM)
    Record {
        /// Board file, see board-configs/
        board: PathBuf,
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
        #[arg(long, value_enum, default_value = "euroc")]
        format: RecordFormat,
        /// Stop after this time
        #[arg(long, value_name = "S", value_parser = seconds)]
        duration: Option<f64>,
        /// A recording in the place of the sensors, as for replay, at its pace
        #[arg(long, value_name = "DIR")]
        dataset: Option<PathBuf>,
        /// Override a key of the board file
        #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
        set: Vec<String>,
    },
    /// Look at a board's sensors and say of each part ok, warn or fail, and what to do
    Doctor {
        /// Board file, see board-configs/
        board: PathBuf,
        /// How long to look; 15 s where nothing is said
        #[arg(long, value_name = "S", value_parser = seconds)]
        duration: Option<f64>,
        /// A recording in the place of the sensors, as for replay, at its pace
        #[arg(long, value_name = "DIR")]
        dataset: Option<PathBuf>,
        /// Where runs and recordings will go, whose disk is asked for its room
        #[arg(long, value_name = "DIR", default_value = "out")]
        out: PathBuf,
        /// Override a key of the board file
        #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
        set: Vec<String>,
    },
    /// Fly through a simulated room and map it; needs no data
    Demo {
        /// Board file; without it the one for Vulkan on the CPU
        #[arg(long, value_name = "FILE")]
        board: Option<PathBuf>,
        #[arg(long, value_name = "DIR", default_value = "out/demo")]
        out: PathBuf,
        /// Override a key of the board file
        #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
        set: Vec<String>,
    },
    /// Write a simulated flight as an EuRoC folder with ground truth
    Sim {
        /// A scenario's name, or `euroc` to fly the trajectory of --truth
        scenario: String,
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
        /// EuRoC ground-truth csv to fly along
        #[arg(long, value_name = "CSV")]
        truth: Option<PathBuf>,
        /// EuRoC IMU csv to use in place of a simulated IMU
        #[arg(long, value_name = "CSV", requires = "truth")]
        imu: Option<PathBuf>,
        /// Seconds of the flight to write
        #[arg(long, value_name = "S", value_parser = seconds)]
        duration: Option<f64>,
        #[arg(long)]
        seed: Option<u64>,
        /// Cameras: mono, stereo, opposed, four
        #[arg(long, value_name = "NAME")]
        rig: Option<String>,
        /// Images as RGB; grey otherwise
        #[arg(long)]
        colour: bool,
        #[command(flatten)]
        defects: daemon::Defects,
    },
    /// Print a board's byte table; refuse what does not fit. Of a recording, say how well its rectified rows agree
    Check {
        #[arg(required_unless_present = "dataset")]
        board: Option<PathBuf>,
        /// Recording to look at, as for replay
        #[arg(long, value_name = "DIR")]
        dataset: Option<PathBuf>,
        /// Override a key of the board file
        #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
        set: Vec<String>,
    },
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum RecordFormat {
    /// EuRoC ASL, which `stipple replay` plays
    Euroc,
    /// MCAP with ROS 2 messages, which Foxglove opens
    Mcap,
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if s.is_finite() && s > 0.0 => Ok(s),
        _ => Err("a positive number of seconds".into()),
    }
}

fn run(command: Command) -> Result<(), Fault> {
    match command {
        Command::Replay { dataset, board, out, pace, poses, holdout, duration, scale, mut set } => {
            set.extend(scale.map(|s| format!("map.scale={s}")));
            let options =
                daemon::Replay { pace, poses, holdout: holdout.unwrap_or(0), duration_s: duration, mapping_s: None };
            daemon::replay(&dataset, &board, &out, &set, &options)
        }
        Command::Run { board, out, duration, dataset, record, set } => {
            daemon::run_sensors(&board, &out, &set, &daemon::Run { dataset, duration_s: duration, record })
        }
        Command::Record { board, out, format, duration, dataset, set } => {
            let format = match format {
                RecordFormat::Euroc => Format::Euroc,
                RecordFormat::Mcap => Format::Mcap,
            };
            let options = daemon::Run { dataset, duration_s: duration, record: None };
            daemon::record(&board, &out, format, &set, &options)
        }
        Command::Doctor { board, duration, dataset, out, set } => {
            daemon::doctor(&board, &out, &set, &daemon::Run { dataset, duration_s: duration, record: None })
        }
        Command::Demo { board, out, set } => daemon::demo(board.as_deref(), &out, &set),
        Command::Sim { scenario, out, truth, imu, duration, seed, rig, colour, defects } => {
            let options = daemon::Simulate { scenario, truth, imu, duration_s: duration, seed, rig, colour, defects };
            daemon::simulate(&options, &out)
        }
        Command::Check { board, dataset, set } => {
            let board = board.map(|path| daemon::check(&path, &set)).transpose()?;
            dataset.map_or(Ok(()), |dataset| daemon::check_dataset(&dataset, board.as_ref()))
        }
    }
}

fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(e) => {
            // Printing may fail on a closed pipe; the exit code still says what happened.
            let _ = e.print();
            return if e.use_stderr() { ExitCode::from(Exit::Usage as u8) } else { ExitCode::SUCCESS };
        }
    };
    // What these say is all that they do: who stops reading, as `head` does, has read enough.
    if matches!(cli.command, Command::Check { .. } | Command::Doctor { .. }) {
        stipple_drivers::host::end_when_unread();
    }
    match run(cli.command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(fault) => {
            eprintln!("stipple: {fault}");
            ExitCode::from(fault.exit as u8)
        }
    }
}
