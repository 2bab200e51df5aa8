//! `stipple run`: the board's sensors through tracking and mapping, until it is stopped.

use super::{finish, open_input, seconds, BoardArgs};
use crate::config::InjectConfig;
use crate::output::OutputDir;
use crate::run::sensors::Playback;
use crate::run::status_led::StatusLed;
use crate::run::{fly, threads, BoardSource, Options};
use std::path::PathBuf;
use stipple_drivers::{host, Fault};

#[derive(clap::Args)]
#[command(group(clap::ArgGroup::new("what --inject may disturb").args(["dataset", "allow_injection"]).multiple(true)))]
pub struct Args {
    #[command(flatten)]
    board: BoardArgs,
    /// Folder for trajectory, map, renders and report
    #[arg(long, value_name = "DIR", default_value = "out/run")]
    out: PathBuf,
    /// Stop after this time
    #[arg(long, value_name = "S", value_parser = seconds)]
    duration: Option<f64>,
    /// Play this recording in place of the sensors, at its pace
    #[arg(long, value_name = "DIR")]
    dataset: Option<PathBuf>,
    /// Play the recording so many times as fast
    #[arg(long, value_name = "N", requires = "dataset", default_value = "1", value_parser = speed)]
    speed: f64,
    /// Begin the recording again each time it ends, until stopped or for --duration
    #[arg(long, requires = "dataset")]
    repeat: bool,
    /// Faults to inject into the recording: a TOML file of [[camera]], [[imu]] and [[thread]] rules
    #[arg(long, value_name = "FILE", requires = "what --inject may disturb")]
    inject: Option<PathBuf>,
    /// Inject the faults into the board's own sensors: for tests on the ground only
    #[arg(long, requires = "inject")]
    allow_injection: bool,
    /// Begin with an empty map: what earlier runs left in DIR/map and DIR/places is moved to previous-map and previous-places
    #[arg(long)]
    fresh: bool,
    /// Find the way in the map that earlier runs left in DIR, and change nothing of DIR/map and DIR/places: nothing is mapped
    #[arg(long, conflicts_with = "fresh")]
    localise_only: bool,
    /// Record the samples to this folder too, as EuRoC
    #[arg(long, value_name = "DIR")]
    record: Option<PathBuf>,
}

pub fn run(args: &Args) -> Result<(), Fault> {
    let board = args.board.load()?;
    let inject = args.inject.as_deref().map(InjectConfig::load).transpose()?.unwrap_or_default();
    // Before the threads of light and trigger start.
    threads::disturb(&inject.thread)?;
    threads::ask_for_realtime();
    let led = StatusLed::open(board.gpio.led())?;
    let mut input = open_input(args.dataset.as_deref(), &args.board, &board)?;
    if args.inject.is_some() && args.dataset.is_none() {
        input.warnings.push("faults are injected into the board's own sensors and threads (--allow-injection)".into());
    }
    let out = OutputDir::create(&args.out)?;
    let (duration_s, record) = (args.duration, args.record.clone());
    let playback = Playback { speed: args.speed, repeats: args.repeat };
    threads::end_where_one_hangs(host::stop_asked_for(), super::last_words);
    let source = args.board.board.clone().map(|file| BoardSource { file, set: args.board.set.clone() });
    let (fresh, localise_only, service) = (args.fresh, args.localise_only, true);
    let options =
        Options { source, duration_s, record, fresh, localise_only, inject, service, playback, ..Options::default() };
    finish(fly(input, &board, &out, &options, led)?, &out)
}

/// Parses a speed that timers and queues can follow.
fn speed(text: &str) -> Result<f64, String> {
    seconds(text).ok().filter(|s| (0.01..=100.0).contains(s)).ok_or_else(|| "must be from 0.01 to 100".into())
}
