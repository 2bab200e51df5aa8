//! The sensors that a board file names: cameras through V4L2, an inertial unit on its bus or through the kernel, and the
//! line that triggers the cameras.

use super::progress::tell;
use super::sensors::Sensors;
use crate::config::Board;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::Arc;
use std::thread::JoinHandle;
use stipple_drivers::gpio::{DataReady, Output, Trigger};
use stipple_drivers::replay::read_calibration;
use stipple_drivers::source::{FrameSource, ImuBatch, ImuSource, SourceFault, Wait};
use stipple_drivers::v4l2;
use stipple_drivers::{Calibration, Exit, Fault, Frames, ImuCorrection, Span};

/// Opens all of them.
pub fn open(path: &Path, board: &Board) -> Result<(Calibration, Sensors), Fault> {
    let parts = [
        ("[camera] devices", board.camera.devices.is_empty()),
        ("[imu] chip", board.imu.options().is_none()),
        ("[rig] calibration", board.rig.calibration.is_empty()),
    ];
    let missing: Vec<&str> = parts.iter().filter(|(_, is)| *is).map(|(name, _)| *name).collect();
    let (Some(options), true) = (board.imu.options(), missing.is_empty()) else {
        let what = format!("does not say {}", missing.join(", "));
        let fix = "write what is missing, or pass --dataset to run on a recording";
        return Err(Fault::new(Exit::Config, path.display().to_string(), what, fix));
    };
    let calibration = calibration(path, board)?;
    let data_ready = board.gpio.data_ready().map(|(line, edge)| DataReady::open(&line, edge)).transpose()?;
    let imu = CorrectedImu { source: options.open(data_ready)?, correction: calibration.imu.correction };
    let rig = v4l2::Rig::open(board.camera.settings(&calibration)?, &calibration)?;
    rig.describe().iter().for_each(|line| tell(format_args!("stipple: {line}")));
    let frames: Box<dyn FrameSource> = match board.gpio.trigger() {
        None => Box::new(rig),
        Some((line, active_low, pulse)) => {
            let trigger = Trigger::new(Output::open(&line, active_low)?, pulse, board.camera.rate_hz);
            Box::new(Triggered { source: rig, pulses: Pulses::start(trigger) })
        }
    };
    Ok((calibration, Sensors { frames, imu: Box::new(imu) }))
}

/// What each part of a board comes to by itself, where they cannot all be opened: its name, and what was found or is wrong.
pub fn parts(path: &Path, board: &Board) -> Vec<(&'static str, Result<String, Fault>)> {
    let mut parts = vec![];
    let calibration = calibration(path, board);
    let cameras = calibration.as_ref().map_err(Fault::clone).and_then(|calibration| {
        let rig = v4l2::Rig::open(board.camera.settings(calibration)?, calibration)?;
        Ok(rig.describe().join("; "))
    });
    let count = |c: &Calibration| format!("{} cameras", c.cameras.len());
    parts.push(("calibration", calibration.as_ref().map(count).map_err(Fault::clone)));
    if calibration.is_ok() {
        parts.push(("cameras", cameras));
    }
    let none = || Fault::new(Exit::Config, "[imu]", "names no chip", "write imu.chip and where it is wired");
    let data_ready = board.gpio.data_ready().map(|(line, edge)| DataReady::open(&line, edge)).transpose();
    if board.gpio.data_ready().is_some() {
        parts.push(("data-ready line", data_ready.as_ref().map(|_| "opened".into()).map_err(Fault::clone)));
    }
    let opened = board.imu.options().ok_or_else(none).and_then(|o| o.open(data_ready.ok().flatten()));
    parts.push(("inertial unit", opened.map(|_| format!("{} answers", board.imu.chip))));
    let outputs =
        [("trigger line", board.gpio.trigger().map(|(line, low, _)| (line, low))), ("status light", board.gpio.led())];
    for (name, (line, active_low)) in outputs.into_iter().filter_map(|(name, o)| Some((name, o?))) {
        parts.push((name, Output::open(&line, active_low).map(|_| "opened".into())));
    }
    parts
}

/// A relative path is one from the board file's folder.
fn calibration(path: &Path, board: &Board) -> Result<Calibration, Fault> {
    let folder = path.parent().unwrap_or(Path::new(""));
    let fix = "set rig.calibration to a folder with cam0/sensor.yaml, Kalibr's camchain.yaml, or Basalt's json";
    let unread = |f: Fault| if f.exit == Exit::NoInput { Fault { fix: fix.into(), ..f } } else { f };
    let mut calibration = read_calibration(&folder.join(&board.rig.calibration)).map_err(unread)?;
    // Noise densities are the unit's; how often it is read here is the board's word.
    calibration.imu.rate_hz = board.imu.rate_hz;
    if board.rig.readout_s > 0.0 {
        calibration.cameras.iter_mut().for_each(|c| c.readout = Span::from_secs(board.rig.readout_s));
    }
    Ok(calibration)
}

/// Reads what the calibration makes of the unit's readings, as recordings do.
struct CorrectedImu<S> {
    source: S,
    correction: ImuCorrection,
}

impl<S: ImuSource> ImuSource for CorrectedImu<S> {
    fn next(&mut self, timeout: Span, batch: &mut ImuBatch) -> Result<Wait, SourceFault> {
        let wait = self.source.next(timeout, batch)?;
        batch.iter_mut().for_each(|reading| reading.sample = self.correction.apply(&reading.sample));
        Ok(wait)
    }

    fn counters(&self) -> Vec<(&'static str, u64)> {
        self.source.counters()
    }
}

/// Thread `trigger`: starts exposures until it is dropped.
struct Pulses {
    stop: Arc<AtomicBool>,
    failed: Arc<AtomicU64>,
    thread: Option<JoinHandle<()>>,
}

impl Pulses {
    fn start(mut trigger: Trigger) -> Pulses {
        let (stop, failed) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
        let (asked, count) = (stop.clone(), failed.clone());
        let thread = std::thread::spawn(move || {
            while !asked.load(Relaxed) {
                trigger.wait();
                count.fetch_add(u64::from(trigger.pulse().is_err()), Relaxed);
            }
        });
        Pulses { stop, failed, thread: Some(thread) }
    }
}

impl Drop for Pulses {
    fn drop(&mut self) {
        self.stop.store(true, Relaxed);
        if let Some(thread) = self.thread.take() {
            // It ends after the pulse under way.
            let _ = thread.join();
        }
    }
}

/// Cameras whose exposures we start.
struct Triggered<S> {
    source: S,
    pulses: Pulses,
}

impl<S: FrameSource> FrameSource for Triggered<S> {
    fn next(&mut self, timeout: Span, frames: &mut Frames) -> Result<Wait, SourceFault> {
        self.source.next(timeout, frames)
    }

    fn away(&self) -> Option<&Fault> {
        self.source.away()
    }

    fn counters(&self) -> Vec<(&'static str, u64)> {
        let mut list = self.source.counters();
        list.push(("trigger_failures", self.pulses.failed.load(Relaxed)));
        list
    }

    fn warnings(&self) -> &[String] {
        self.source.warnings()
    }
}
