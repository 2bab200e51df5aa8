//! `stipple-bench`: the instruments. Each subcommand measures one thing and leaves tables and charts in the folder of `--out`.
//!
//! This program is no part of the product: it is built with the feature `instruments`, which opens to it what the library
//! keeps to itself. What each bench measures, how long it takes and what it found: README.md beside this file.

mod consistency;
mod faults;
mod flight;
mod inputs;
mod kernels;
mod loops;
mod map;
mod odometry;
mod page;
mod patrol;
mod ply;
mod predict;
mod record;
mod relocalise;
mod run;
mod stability;
mod stages;
mod stereo;
#[allow(dead_code)] // the tests take more of it
mod world;

use clap::{Parser, Subcommand};
use std::process::ExitCode;
use stipple::commands::exit_code;
use stipple::mem::CountingAllocator;
use stipple_drivers::{Fault, FaultKind};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

/// Measures what Stipple's parameters cost and what they buy
#[derive(Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    bench: Bench,
}

#[derive(Subcommand)]
enum Bench {
    Odometry(odometry::Args),
    Stages(stages::Args),
    Stability(stability::Args),
    Consistency(consistency::Args),
    Predict(predict::Args),
    Map(map::Args),
    Kernels(kernels::Args),
    Stereo(stereo::Args),
    Faults(faults::Args),
    Record(record::Args),
    Ply(ply::Args),
    Patrol(patrol::Args),
    Loops(loops::Args),
}

fn run(bench: &Bench) -> Result<(), Fault> {
    match bench {
        Bench::Odometry(args) => odometry::run(args),
        Bench::Stages(args) => stages::run(args),
        Bench::Stability(args) => stability::run(args),
        Bench::Consistency(args) => consistency::run(args),
        Bench::Predict(args) => predict::run(args),
        Bench::Map(args) => map::run(args),
        Bench::Kernels(args) => kernels::run(args),
        Bench::Stereo(args) => stereo::run(args),
        Bench::Faults(args) => faults::run(args),
        Bench::Record(args) => record::run(args),
        Bench::Ply(args) => ply::run(args),
        Bench::Patrol(args) => patrol::run(args),
        Bench::Loops(args) => loops::run(args),
    }
}

fn main() -> ExitCode {
    // Who stops reading, as `head` does, has read enough.
    stipple_drivers::host::end_when_unread();
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(e) => {
            let _ = e.print();
            return if e.use_stderr() { exit_code(FaultKind::Usage) } else { ExitCode::SUCCESS };
        }
    };
    match run(&cli.bench) {
        Ok(()) => ExitCode::SUCCESS,
        Err(fault) => {
            eprintln!("stipple-bench: {fault}");
            exit_code(fault.kind)
        }
    }
}

/// A positive number of seconds, for clap.
fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if s.is_finite() && s > 0.0 => Ok(s),
        _ => Err("a positive number of seconds".into()),
    }
}

/// Says what is not as it has to be, and ends the bench with it.
fn missed(bench: &str, complaints: &[String]) -> Result<(), Fault> {
    complaints.iter().for_each(|c| eprintln!("not as expected: {c}"));
    match complaints.len() {
        0 => Ok(()),
        n => {
            Err(Fault::new(FaultKind::Internal, bench, format!("{n} cases are not as expected"), "see the lines above"))
        }
    }
}
