//! `stipple run`: the sensors of a board, or a recording in their place, through tracking and mapping until it is
//! stopped. What it leaves behind is what a replay leaves behind.

use super::input::Input;
use super::light::Light;
use super::mapping::Mapping;
use super::play::{realtime, Realtime};
use super::progress::{print, tell, Progress};
use super::sensors::Sensors;
use super::tracking::{OdometryRun, Tracking};
use super::{hardware, memory, record, summary};
use crate::config::{Board, InjectConfig};
use crate::output::OutputDir;
use std::path::{Path, PathBuf};
use stipple_drivers::record::Format;
use stipple_drivers::{host, Calibration, Fault, Frames, TimedPose};

pub struct Run {
    /// Takes the place of the sensors, at its recorded pace.
    pub dataset: Option<PathBuf>,
    pub duration_s: Option<f64>,
    /// Records there what the sensors give, as EuRoC.
    pub record: Option<PathBuf>,
}

/// What a run reads.
pub struct Rig {
    pub name: String,
    pub place: String,
    pub calibration: Calibration,
    pub sensors: Sensors,
    pub truth: Vec<TimedPose>,
    pub opened: Vec<(&'static str, u64)>,
    pub warnings: Vec<String>,
    /// At most.
    pub frames: usize,
    pub length_s: Option<f64>,
    /// Frames a second, where they were asked for.
    pub expected_hz: Option<f64>,
}

/// The sensors of a board, or the recording in their place.
pub fn rig_of(path: &Path, board: &Board, options: &Run) -> Result<Rig, Fault> {
    match &options.dataset {
        Some(dataset) => recorded(dataset, board, options),
        None => hardware(path, board, options),
    }
}

/// `stipple run`
pub fn run(path: &Path, out: &Path, set: &[String], options: &Run) -> Result<(), Fault> {
    let board = Board::load(path, set)?;
    let light = Light::open(board.gpio.led())?;
    let mut rig = rig_of(path, &board, options)?;
    memory::admit(&rig.place, &rig.calibration, &board, options.record.is_some())?;
    let out = OutputDir::create(out)?;
    let tracking = Tracking::Odometry(Box::new(OdometryRun::new(&rig.calibration, &board, rig.frames)?));
    let mapping = if board.map.enabled { Some(Mapping::open(&rig.calibration, &board)?) } else { None };
    for warning in &rig.warnings {
        tell(format_args!("stipple: warning: {warning}"));
    }
    let recorder = match &options.record {
        Some(dir) => {
            let sink = stipple_drivers::record::open(dir, Format::Euroc, &rig.calibration)?;
            let shape = Frames::in_colour(&rig.calibration, memory::colours(&rig.calibration, &board).len());
            let (recorder, taps) = stipple_drivers::record::start(sink, &shape, board.record.ring_frames as usize);
            rig.sensors = record::tapped(rig.sensors, taps);
            Some((recorder, dir))
        }
        None => None,
    };
    let shape = || Frames::in_colour(&rig.calibration, memory::colours(&rig.calibration, &board).len());
    let sensors = rig.sensors.spoilt(&board.inject, shape);
    let title = summary::Title {
        dataset: rig.name,
        board: board.name.clone(),
        pace: "live".into(),
        scale: board.map.scale,
        truth: rig.truth,
        opened: rig.opened,
    };
    let mut progress = Progress::new(rig.length_s).lit(light);
    let realtime_options =
        Realtime { holdout: 0, duration_s: None, sensors_s: options.duration_s, stop: host::stop_asked_for() };
    let mut played = realtime(sensors, &rig.calibration, tracking, mapping, &realtime_options, &mut progress);
    progress.finish();
    for warning in &played.warnings {
        tell(format_args!("stipple: warning: {warning}"));
    }
    played.warnings = [rig.warnings, played.warnings].concat();
    let cameras = played.capture.and_then(|c| c.line(&played.source));
    let broken = played.broken.take();
    let recorded = recorder.map(|(recorder, dir)| (recorder.finish(), dir));
    if let Some((recorded, _)) = &recorded {
        played.source.extend(&recorded.counters);
    }
    let report = summary::conclude(title, played, &out)?;
    print(summary::seven_lines(&report, &out));
    cameras.into_iter().for_each(|line| print(format_args!("cameras     {line}")));
    recorded.map_or(Ok(()), |(recorded, dir)| record::whole(&recorded, dir))?;
    broken.map_or(Ok(()), Err)?;
    progress.ended_well();
    Ok(())
}

fn recorded(dataset: &Path, board: &Board, options: &Run) -> Result<Rig, Fault> {
    let input = Input::recording(dataset, &board.replay, &board.rig)?;
    let place = dataset.display().to_string();
    let colours = memory::colours(&input.calibration, board).len();
    input.needs_colour(colours, &place)?;
    let (frames, length_s) = (input.frames_within(options.duration_s), input.length_s());
    let Input { name, calibration, imu, mut stamps, truth, warnings, counters, source } = input;
    stamps.truncate(frames);
    let shape = || Frames::in_colour(&calibration, colours);
    let sensors = Sensors::of_recording(source, stamps, imu, &InjectConfig::default(), shape);
    let length_s = Some(options.duration_s.map_or(length_s, |s| s.min(length_s)));
    Ok(Rig {
        name,
        place,
        calibration,
        sensors,
        truth,
        opened: counters,
        warnings,
        frames,
        length_s,
        expected_hz: None,
    })
}

/// Poses kept for the trajectory of a run without an end: half an hour at 30 Hz, 15 MiB. The run goes on past it.
const POSES_KEPT: usize = 1 << 16;

fn hardware(path: &Path, board: &Board, options: &Run) -> Result<Rig, Fault> {
    let (calibration, sensors) = hardware::open(path, board)?;
    // A rate that the camera made a little higher is no reason to lose the end.
    let asked = options.duration_s.map_or(f64::INFINITY, |s| 1.2 * s * board.camera.rate_hz + 100.0);
    Ok(Rig {
        name: board.name.clone(),
        place: path.display().to_string(),
        calibration,
        sensors,
        truth: vec![],
        opened: vec![],
        warnings: vec![],
        frames: POSES_KEPT.min(asked as usize),
        length_s: options.duration_s,
        expected_hz: Some(board.camera.rate_hz),
    })
}
