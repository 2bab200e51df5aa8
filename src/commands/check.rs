//! `stipple check`: the memory table of a board.

use super::BoardArgs;
use crate::run::memory;
use crate::run::status::print_err;
use stipple_drivers::Fault;

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    board: BoardArgs,
}

pub fn check(args: &Args) -> Result<(), Fault> {
    let mut board = args.board.load()?;
    if let Some(warning) = memory::replace_missing(&mut board) {
        print_err(format_args!("stipple: warning: {warning}"));
    }
    let rig = memory::largest_rig(&board);
    memory::print(&memory::footprint(&rig, &board, true)?);
    memory::check_fits(&args.board.path().display().to_string(), &rig, &board, true)?;
    println!(
        "{:>12}       fits memory_max_mib = {}; sensors and calibration are judged by doctor",
        "", board.memory_max_mib
    );
    Ok(())
}
