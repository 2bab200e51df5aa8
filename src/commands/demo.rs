//! `stipple demo`: ten seconds of simulated flight, then mapping alone.

use super::{finish, rendering_progress, BoardArgs};
use crate::output::OutputDir;
use crate::run::sensors::Input;
use crate::run::{fly, memory, Options};
use std::path::PathBuf;
use stipple_drivers::sim::Scenario;
use stipple_drivers::Fault;

#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    board: BoardArgs,
    /// Folder for trajectory, map, renders and report. A map that is there moves to DIR/previous-map, and the one that was there is deleted
    #[arg(long, value_name = "DIR", default_value = "out/demo")]
    out: PathBuf,
}

pub const HOLDOUT: u32 = 8;
const SECONDS: f64 = 60.0;
/// The demo's cameras are small already.
pub const SCALE: &str = "map.scale=1";

pub fn demo(args: &Args) -> Result<(), Fault> {
    let board = args.board.load_with(&[SCALE.to_string()])?;
    let out = OutputDir::create(&args.out)?;
    let scenario = Scenario::named("demo").expect("the demo's scenario is compiled in");
    let colours = memory::colours(&scenario.calibration, &board).len();
    let input = Input::rendered(&scenario, colours, rendering_progress)?;
    let options = Options { holdout: HOLDOUT, duration_s: Some(SECONDS), fresh: true, ..Options::default() };
    finish(fly(input, &board, &out, &options, None)?, &out)
}
