//! `stipple replay`: a recording through tracking and mapping.

use super::{finish, seconds, BoardArgs};
use crate::config::InjectConfig;
use crate::output::OutputDir;
use crate::run::sensors::Input;
use crate::run::{fly, threads, Options, Pace, Steps};
use std::path::PathBuf;
use stipple_drivers::{Fault, FaultKind};

#[derive(clap::Args)]
pub struct Args {
    /// EuRoC ASL folder (holding mav0) of one to four cameras, or TUM-VI with a Kalibr camchain.yaml
    dataset: PathBuf,
    #[command(flatten)]
    board: BoardArgs,
    /// Folder for trajectory, map, renders and report. A map that is there moves to DIR/previous-map, and the one that was there is deleted
    #[arg(long, value_name = "DIR", default_value = "out/replay")]
    out: PathBuf,
    #[arg(long, value_enum, default_value = "recorded")]
    pace: PaceName,
    /// Mapping steps a frame in lockstep; without it 2
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(..=1000))]
    steps: Option<u32>,
    /// Mapping steps a second of the recording in lockstep, instead: plays a device that slow
    #[arg(long, value_name = "N", value_parser = seconds, conflicts_with = "steps")]
    steps_per_s: Option<f64>,
    /// Calibration in place of the recording's own: Kalibr's camchain.yaml or Basalt's json
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
    /// Faults to inject into the sensors at recorded pace: a TOML file of [[camera]], [[imu]] and [[thread]] rules
    #[arg(long, value_name = "FILE")]
    inject: Option<PathBuf>,
    /// Skip odometry: poses from this table (EuRoC or TUM csv); every frame it covers is a keyframe
    #[arg(long, value_name = "CSV")]
    poses: Option<PathBuf>,
    /// Never train on every Nth keyframe, only evaluate it
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..))]
    holdout: Option<u32>,
    /// End after this time of the recording; past its end the mapper goes on alone
    #[arg(long, value_name = "S", value_parser = seconds)]
    duration: Option<f64>,
    /// Mapping resolution divisor: 1, 2 or 4 (short for --set map.scale=N)
    #[arg(long, value_name = "N", value_parser = ["1", "2", "4"])]
    scale: Option<String>,
}

#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum PaceName {
    /// Frames arrive at their recorded time; what is not done in time is not done
    Recorded,
    /// Deterministic: a stated number of mapping steps a frame
    Lockstep,
}

impl Args {
    fn pace(&self) -> Result<Pace, Fault> {
        match (self.pace, self.steps, self.steps_per_s) {
            (PaceName::Recorded, None, None) => Ok(Pace::Recorded),
            (PaceName::Recorded, ..) => {
                let fix = "add --pace lockstep, or leave it out: at recorded pace mapping takes the time there is";
                Err(Fault::new(FaultKind::Usage, "--steps", "is for --pace lockstep", fix))
            }
            (PaceName::Lockstep, _, Some(rate)) => Ok(Pace::Lockstep(Steps::PerSecond(rate))),
            (PaceName::Lockstep, n, None) => Ok(Pace::Lockstep(Steps::PerFrame(n.unwrap_or(2)))),
        }
    }
}

pub fn replay(args: &Args) -> Result<(), Fault> {
    let scale: Vec<String> = args.scale.iter().map(|s| format!("map.scale={s}")).collect();
    let board = args.board.load_with(&scale)?;
    let inject = args.inject.as_deref().map(InjectConfig::load).transpose()?.unwrap_or_default();
    threads::disturb(&inject.thread)?;
    let input = Input::recording(&args.dataset, args.calibration.as_deref(), &board)?;
    let out = OutputDir::create(&args.out)?;
    let options = Options {
        pace: args.pace()?,
        poses: args.poses.clone(),
        holdout: args.holdout.unwrap_or(0),
        duration_s: args.duration,
        inject,
        fresh: true,
        ..Options::default()
    };
    finish(fly(input, &board, &out, &options, None)?, &out)
}
