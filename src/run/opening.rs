//! What a flight needs before it begins: input and board in order, the mapper, and what closes loops.

use super::keyframes::KeyframeRing;
use super::loop_closing::LoopClosing;
use super::mapping::{Kept, Mapping};
use super::memory;
use super::sensors::{Input, Playback, Source};
use super::status::print_err;
use super::worker::{MapSide, Worker};
use super::{unkept, Options, Pace, Sinks, FRAMES_KEPT, MAP_STORE};
use crate::config::Board;
use crate::map::Place;
use crate::output::OutputDir;
use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};
use stipple_drivers::{Fault, FaultKind};

/// Cuts a recording to the time it is played for; answers how many frames the run keeps to be judged by.
pub fn frames_kept(input: &mut Input, options: &Options) -> usize {
    let Playback { speed, repeats } = options.playback;
    match &mut input.source {
        Source::Recorded(_) if repeats => {
            // It is of the first lap alone.
            input.truth.clear();
            FRAMES_KEPT
        }
        Source::Recorded(r) => {
            r.cut(options.duration_s.map(|s| s * speed));
            r.stamps.len()
        }
        // A rate that the camera made a little higher is no reason to lose the end.
        Source::Live { rate_hz, .. } => {
            FRAMES_KEPT.min(options.duration_s.map_or(f64::INFINITY, |s| 1.2 * s * *rate_hz + 100.0) as usize)
        }
    }
}

/// Puts what this machine has in the place of what it lacks, and refuses a board that does not fit.
pub fn prepare(input: &mut Input, board: &mut Board, options: &Options, apart: bool) -> Result<(), Fault> {
    board.map.enabled &= !options.localise_only;
    if !apart {
        input.warnings.extend(memory::replace_missing(board).map(|missing| missing.to_string()));
    }
    input.warnings.iter().for_each(|warning| print_err(format_args!("stipple: warning: {warning}")));
    input.calibration.imu.range = input.source.imu_range(board);
    if !apart {
        memory::check_fits(&input.place, &input.calibration, board, options.record.is_some())?;
    }
    Ok(())
}

/// Opens the mapper in this process, or `apart` in one of its own.
fn open_map(
    input: &mut Input,
    board: &Board,
    out: &OutputDir,
    options: &Options,
    (apart, flight): (bool, i64),
) -> Result<MapSide, Fault> {
    if apart {
        let kept = board.store.enabled.then_some(Kept { fresh: options.fresh, flight });
        let worker = Worker::start(&input.place, &input.calibration, board, out, options.record.is_some(), kept)?;
        input.warnings.extend(worker.warning.clone());
        return Ok(MapSide::Apart(Box::new(worker)));
    }
    let ring = Arc::new(KeyframeRing::new(&input.calibration, board)?);
    let folder = out.file(MAP_STORE);
    let at_once = matches!(options.pace, Pace::Lockstep(_));
    let place = Place { folder: &folder, fresh: options.fresh, flight: Some(flight), at_once };
    let mapping = Mapping::open(&input.calibration, board, ring, board.store.enabled.then_some(place))?;
    input.warnings.extend(mapping.mapper.unkept.as_ref().map(|fault| unkept(fault).to_string()));
    Ok(MapSide::Here(Box::new(mapping)))
}

/// The time now, by which a flight is told from others, ms since 1970.
fn flight() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as i64)
}

/// Opens who takes keyframes; loops are closed where the poses are those of `odometry`.
pub fn sinks(
    input: &mut Input,
    board: &Board,
    out: &OutputDir,
    options: &Options,
    (apart, odometry): (bool, bool),
) -> Result<Sinks, Fault> {
    let flight = flight();
    let mut loops = if odometry { LoopClosing::new(&input.calibration, board)? } else { None };
    let (fresh, read_only) = (options.fresh, options.localise_only);
    let rig = (&input.calibration, board);
    let read = loops.as_mut().map(|loops| loops.remember(rig, out.path(), (flight, fresh, read_only)));
    let warnings = match read {
        None if read_only => {
            let (what, fix) = ("no place is recognised without loops", "set loops.enabled = true");
            return Err(Fault::new(FaultKind::Config, "loops.enabled", what, fix));
        }
        Some(Ok((0, mut warnings))) if read_only => {
            warnings.insert(0, "there is no place of an earlier run to be found in".into());
            let what = warnings.join("; ");
            let fix = "name the --out folder of a run whose board has store.enabled and loops.enabled";
            return Err(Fault::new(FaultKind::NoInput, out.path().display().to_string(), what, fix));
        }
        Some(Err(fault)) if read_only => return Err(fault),
        Some(Err(fault)) => {
            let what = format!(
                "{}; places of earlier runs are not used, and those of this run not kept: no later run finds itself in its map",
                fault.what
            );
            vec![Fault { what, ..fault }.to_string()]
        }
        Some(Ok((_, warnings))) => warnings,
        None => vec![],
    };
    warnings.iter().for_each(|warning| print_err(format_args!("stipple: warning: {warning}")));
    input.warnings.extend(warnings);
    let map = if board.map.enabled { Some(open_map(input, board, out, options, (apart, flight))?) } else { None };
    Ok((map, loops))
}
