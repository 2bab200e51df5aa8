//! `stipple record`: the sensors' samples to disk, and nothing else.

use super::{open_input, seconds, BoardArgs};
use crate::run::status::{print_out, Status};
use crate::run::status_led::StatusLed;
use crate::run::{observe, threads};
use std::path::PathBuf;
use stipple_drivers::record::Format;
use stipple_drivers::Fault;

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    board: BoardArgs,
    /// Folder for the recording; must be empty or absent
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    #[arg(long, value_enum, default_value = "euroc")]
    format: FormatName,
    /// Stop after this time
    #[arg(long, value_name = "S", value_parser = seconds)]
    duration: Option<f64>,
    /// Play this recording in place of the sensors, at its pace
    #[arg(long, value_name = "DIR")]
    dataset: Option<PathBuf>,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum FormatName {
    /// EuRoC ASL, which `stipple replay` plays
    Euroc,
    /// MCAP with ROS 2 messages, which Foxglove opens
    Mcap,
}

pub fn record(args: &Args) -> Result<(), Fault> {
    let board = args.board.load()?;
    threads::ask_for_realtime();
    let led = StatusLed::open(board.gpio.led())?;
    let input = open_input(args.dataset.as_deref(), &args.board, &board)?;
    let format = match args.format {
        FormatName::Euroc => Format::Euroc,
        FormatName::Mcap => Format::Mcap,
    };
    let mut status = Status::new(args.duration.or(input.source.length_s())).with_led(led);
    let (mut flown, recorded) =
        observe(input, &board, args.duration, Some((&args.out, format)), Box::new(|_| {}), &mut status)?;
    let line = flown.capture.and_then(|c| c.line(&flown.source));
    line.into_iter().for_each(|line| print_out(format_args!("cameras     {line}")));
    for (name, n) in flown.counters.list().iter().chain(&flown.source).filter(|(_, n)| *n > 0) {
        print_out(format_args!("{n:>10}  {name}"));
    }
    print_out(args.out.display());
    recorded?;
    flown.broken.take().map_or(Ok(()), Err)?;
    status.ended_well();
    Ok(())
}
