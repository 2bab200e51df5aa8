//! `stipple`: argv to subcommand; nothing else.

use clap::{Parser, Subcommand};
use std::path::PathBuf;
use std::process::ExitCode;
use stipple::bench;
use stipple::config::Board;
use stipple::daemon::{self, Pace};
use stipple::mem::CountingAllocator;
use stipple::output::OutputDir;
use stipple_drivers::record::Format;
use stipple_drivers::replay::{OpenOptions, Recording};
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
    /// Measure what the parameters cost and what they buy
    Bench {
        #[command(subcommand)]
        what: Bench,
    },
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum RecordFormat {
    /// EuRoC ASL, which `stipple replay` plays
    Euroc,
    /// MCAP with ROS 2 messages, which Foxglove opens
    Mcap,
}

#[derive(Subcommand)]
enum Bench {
    /// Error against run time of frontend and estimator over flights and settings
    Odometry {
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
        /// Folder of recordings; otherwise $STIPPLE_RECORDINGS, otherwise ../shared/data
        #[arg(long, value_name = "FOLDER")]
        recordings: Option<PathBuf>,
        /// Seconds of each input, 40 at most
        #[arg(long, value_name = "S", value_parser = seconds)]
        seconds: Option<f64>,
        /// One small flight, two settings
        #[arg(long)]
        quick: bool,
        /// The default settings only, in both precisions: a row a flight
        #[arg(long, conflicts_with = "quick")]
        defaults: bool,
    },
    /// What becomes of the estimator when something goes wrong: one row a case
    Stability {
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
        /// Flights of each case; the worst is shown
        #[arg(long, value_name = "N", default_value = "5", value_parser = clap::value_parser!(u64).range(1..=1000))]
        seeds: u64,
    },
    /// Quality of the map at equal time: against the cap of Gaussians, and without parts of the method
    Map {
        /// As for replay; without it the simulated flight of the demo
        dataset: Option<PathBuf>,
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
        /// Board file; without it the one for Vulkan on the CPU
        #[arg(long, value_name = "FILE")]
        board: Option<PathBuf>,
        /// Skip odometry, as for replay
        #[arg(long, value_name = "CSV")]
        poses: Option<PathBuf>,
        /// Of mapping, each run
        #[arg(long, value_name = "S", value_parser = seconds)]
        seconds: Option<f64>,
        /// Two small caps and one ablation
        #[arg(long)]
        quick: bool,
        /// Override a key of the board file in every run
        #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
        set: Vec<String>,
    },
    /// What a training step costs by kernel, against what the device could do
    Kernels {
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
        /// Substring of the Vulkan device's name
        #[arg(long, value_name = "NAME")]
        device: Option<String>,
        /// Also on Gaussians seeded from the stereo depth of this recording, at full resolution
        #[arg(long, value_name = "FOLDER")]
        recording: Option<PathBuf>,
        /// One small case
        #[arg(long)]
        quick: bool,
        /// Without subgroups: what every device runs
        #[arg(long)]
        baseline: bool,
        /// Pixels a lane of the raster shades: 2, 4 or 8
        #[arg(long, value_name = "N", value_parser = clap::builder::PossibleValuesParser::new(["2", "4", "8"]))]
        column: Option<String>,
    },
    /// Disparity of every method against truth: Middlebury, simulated flights, hard cases, time
    Stereo {
        /// Recording of which each method makes a map, too
        dataset: Option<PathBuf>,
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
        /// Folder of recordings; otherwise $STIPPLE_RECORDINGS, otherwise ../shared/data
        #[arg(long, value_name = "FOLDER")]
        recordings: Option<PathBuf>,
        /// Board file whose [stereo] and [gpu] to use, and of the map the rest; the methods' own defaults without it
        #[arg(long, value_name = "FILE")]
        board: Option<PathBuf>,
        /// Of the map: skip odometry, as for replay
        #[arg(long, value_name = "CSV", requires = "dataset")]
        poses: Option<PathBuf>,
        /// Of mapping, with each method
        #[arg(long, value_name = "S", value_parser = seconds, requires = "dataset")]
        seconds: Option<f64>,
        /// Override a key of the board file
        #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
        set: Vec<String>,
        /// Two hard cases
        #[arg(long)]
        quick: bool,
        /// Fit the methods' deviations to flights that are otherwise left out, print them, and judge them on the others
        #[arg(long, conflicts_with_all = ["quick", "dataset"])]
        fit: bool,
    },
    /// Sensors that fail, in real time: which counter sees each fault, and what it costs; three minutes
    Faults {
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
        /// The unplugged sensors only
        #[arg(long)]
        quick: bool,
    },
    /// Odometry's time a frame with recording and without, in turns in real time, and what the recorder keeps up with
    Record {
        /// As for replay; without it a simulated flight at 752x480
        dataset: Option<PathBuf>,
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
        /// Of each kind
        #[arg(long, value_name = "N", default_value = "3", value_parser = clap::value_parser!(u64).range(1..=100))]
        passes: u64,
    },
    /// Errors beside what the covariance claims, and beside the quality
    Consistency {
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
        /// Seeded flights
        #[arg(long, value_name = "N", default_value = "50", value_parser = clap::value_parser!(u64).range(2..=10_000))]
        flights: u64,
    },
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
        Command::Bench { what: Bench::Odometry { out, recordings, seconds, quick, defaults } } => {
            bench::odometry(&bench::Options { recordings, seconds, quick, defaults }, &out)
        }
        Command::Bench { what: Bench::Map { dataset, out, board, poses, seconds, quick, set } } => {
            let what = daemon::Benched { dataset, board, poses, set };
            bench::map::map(&bench::map::Options { seconds, quick }, &out, &|job, dir| daemon::benched(&what, job, dir))
        }
        Command::Bench { what: Bench::Consistency { out, flights } } => {
            bench::consistency::consistency(flights as usize, &out)
        }
        Command::Bench { what: Bench::Kernels { out, device, recording, quick, baseline, column } } => {
            let column = column.and_then(|n| n.parse().ok());
            bench::kernels::kernels(&bench::kernels::Options { device, recording, quick, baseline, column }, &out)
        }
        Command::Bench { what: Bench::Stereo { dataset, out, recordings, board, poses, seconds, set, quick, fit } } => {
            let loaded = board.as_deref().map(|path| Board::load(path, &set)).transpose()?;
            let options = bench::stereo::Options { recordings, board: loaded, quick, fit, seconds };
            // A wrong folder is told now, not after the minutes that come before the maps.
            dataset.as_deref().map(|path| Recording::open(path, &OpenOptions::default())).transpose()?;
            let maps = dataset.is_some();
            let what = daemon::Benched { dataset, board, poses, set };
            let run = |job: &bench::map::Job, dir: &OutputDir| daemon::benched(&what, job, dir);
            bench::stereo::stereo(&options, &out, maps.then_some(&run as bench::stereo::MapRun))
        }
        Command::Bench { what: Bench::Record { dataset, out, passes } } => {
            daemon::bench_record(dataset.as_deref(), passes as usize, &out)
        }
        Command::Bench { what: Bench::Faults { out, quick } } => daemon::faults(&out, quick),
        Command::Bench { what: Bench::Stability { out, seeds } } => bench::stability::stability(seeds, &out),
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
