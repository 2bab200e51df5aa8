//! What a flight reads: the sensors that a board file names, a recording, or a flight rendered by the simulator. All three
//! become one `Input`, so that everything behind it is wired once.

use super::memory;
use super::status::print_err;
use super::threads;
use crate::config::{Board, InjectConfig};
use crate::publish::Stamps;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::Arc;
use std::thread::JoinHandle;
use stipple_drivers::counters::Counter;
use stipple_drivers::gpio::{DataReady, Output, Trigger};
use stipple_drivers::imu::ImuOptions;
use stipple_drivers::inject::{FaultyFrames, FaultyImu};
use stipple_drivers::paced::{Images, Pace, PacedAids, PacedFrames, PacedImu, Simulated};
use stipple_drivers::replay::{read_calibration, OpenOptions, Recording};
use stipple_drivers::sim::{Scenario, Sim};
use stipple_drivers::source::{AidReading, AidSource, FrameSource, ImuBatch, ImuSource, SourceFault, Wait};
use stipple_drivers::{
    host, v4l2, Calibration, Fault, FaultKind, Frames, ImuCorrection, ImuSample, Nanos, Span, TimedPose,
};

/// What a flight reads, opened.
pub struct Input {
    pub name: String,
    /// The file or folder it comes from, for errors.
    pub place: String,
    pub calibration: Calibration,
    /// world_from_body; empty where there is none.
    pub truth: Vec<TimedPose>,
    pub warnings: Vec<String>,
    /// Counters of opening it.
    pub opened: Vec<(&'static str, u64)>,
    pub source: Source,
}

#[allow(clippy::large_enum_variant)] // there is one in a run
pub enum Source {
    /// The board's own sensors, and the frame rate they were asked for, Hz.
    Live {
        sensors: Sensors,
        rate_hz: f64,
    },
    Recorded(Recorded),
}

/// A recording, or a flight rendered into memory.
pub struct Recorded {
    pub images: Images,
    /// One of each frame.
    pub stamps: Vec<Nanos>,
    pub imu: Vec<ImuSample>,
    /// Readings of a barometer, where there is one.
    pub aids: Vec<AidReading>,
}

/// How a recording is played.
#[derive(Clone, Copy, Debug)]
pub struct Playback {
    /// Seconds of it per second.
    pub speed: f64,
    /// It begins again each time it ends, and its stamps go on growing.
    pub repeats: bool,
}

impl Default for Playback {
    fn default() -> Playback {
        Playback { speed: 1.0, repeats: false }
    }
}

/// A rig of cameras and an inertial unit, and a barometer where the board names one.
pub struct Sensors {
    pub frames: Box<dyn FrameSource>,
    pub imu: Box<dyn ImuSource>,
    pub aids: Option<Box<dyn AidSource>>,
}

/// Opens a recording with what the board says of its rig, and another calibration than its own where one is given.
pub fn open_recording(dataset: &Path, calibration: Option<&Path>, board: &Board) -> Result<Recording, Fault> {
    let options = OpenOptions {
        pair_tolerance: Span::from_secs(board.camera.pair_tolerance_s),
        calibration: calibration.map(Path::to_path_buf),
        readout: (board.rig.readout_s > 0.0).then(|| Span::from_secs(board.rig.readout_s)),
        ..OpenOptions::default()
    };
    let mut recording = Recording::open(dataset, &options)?;
    board.rig.mask(&mut recording.calibration)?;
    Ok(recording)
}

impl Input {
    /// A recording, with another calibration than its own where one is given.
    pub fn recording(dataset: &Path, calibration: Option<&Path>, board: &Board) -> Result<Input, Fault> {
        let r = open_recording(dataset, calibration, board)?;
        let images = Images::Recording(r.reader());
        let place = dataset.display().to_string();
        Ok(Input {
            name: dataset.file_name().map_or_else(|| place.clone(), |n| n.to_string_lossy().into_owned()),
            place,
            calibration: r.calibration,
            truth: r.truth,
            warnings: r.warnings,
            opened: r.counters.list(),
            source: Source::Recorded(Recorded {
                images,
                stamps: r.frames.iter().map(|f| f.t).collect(),
                imu: r.imu,
                aids: r.aids,
            }),
        })
    }

    /// Renders every frame before the flight starts, so that rendering takes nothing from it; the first `colours` cameras
    /// in colour.
    pub fn rendered(
        scenario: &Scenario,
        colours: usize,
        mut progress: impl FnMut(usize, usize),
    ) -> Result<Input, Fault> {
        let mut sim = Sim::new(scenario)?;
        let count = sim.frame_count();
        let mut frames = Vec::with_capacity(count);
        for i in 0..count {
            let mut f = Frames::in_colour(sim.calibration(), colours);
            sim.render(i, &mut f);
            frames.push(f);
            progress(i + 1, count);
        }
        Ok(Input::flown(scenario, sim, |_| Images::Rendered(frames)))
    }

    /// Renders each frame when it is read, so that a flight of any length fits; rendering takes its share of the machine while
    /// it lasts. `progress` is told how many frames are rendered, of all.
    #[cfg_attr(not(feature = "instruments"), allow(dead_code))] // a bench asks for it
    pub fn simulated(scenario: &Scenario, progress: impl FnMut(usize, usize) + Send + 'static) -> Result<Input, Fault> {
        let images = |sim| Images::Simulated(Box::new(Simulated { sim, progress: Box::new(progress) }));
        Ok(Input::flown(scenario, Sim::new(scenario)?, images))
    }

    fn flown(scenario: &Scenario, sim: Sim, images: impl FnOnce(Sim) -> Images) -> Input {
        Input {
            name: format!("simulated flight `{}`", scenario.name),
            place: "the simulated flight".into(),
            calibration: sim.calibration().clone(),
            truth: sim.truth(),
            warnings: vec![],
            opened: vec![],
            source: Source::Recorded(Recorded {
                stamps: (0..sim.frame_count()).map(|i| sim.stamp(i)).collect(),
                imu: sim.imu().to_vec(),
                aids: sim.aids().to_vec(),
                images: images(sim),
            }),
        }
    }

    /// Opens the sensors that a board file names.
    pub fn live(path: &Path, board: &Board) -> Result<Input, Fault> {
        let (calibration, sensors) = open(path, board)?;
        Ok(Input {
            name: board.name.clone(),
            place: path.display().to_string(),
            calibration,
            truth: vec![],
            warnings: vec![],
            opened: vec![],
            source: Source::Live { sensors, rate_hz: board.camera.rate_hz },
        })
    }

    /// Refuses grey images where the first `cameras` are asked for in colour.
    pub fn needs_colour(&self, cameras: usize) -> Result<(), Fault> {
        match &self.source {
            Source::Recorded(r) if !r.images.has_colour(cameras) => {
                let what = format!("map.colour = true, but the images of {} are grey", self.place);
                Err(Fault::new(FaultKind::Config, "map.colour", what, "set map.colour = false"))
            }
            _ => Ok(()),
        }
    }
}

impl Source {
    /// Seconds it lasts; `None` of live sensors.
    pub fn length_s(&self) -> Option<f64> {
        match self {
            Source::Live { .. } => None,
            Source::Recorded(r) => Some(r.length_s()),
        }
    }

    /// Ends of the ranges of gyro and accelerometer, rad/s and m/s²: those that a live unit is set to, else the board's. Of one
    /// that the kernel drives the end of its storage is known, which may lie beyond the sensor's: the smaller counts.
    pub fn imu_range(&self, board: &Board) -> [f64; 2] {
        let asked = board.imu.range();
        let set = match self {
            Source::Live { sensors, .. } => sensors.imu.range().unwrap_or(asked),
            Source::Recorded(_) => asked,
        };
        let is_bound = matches!(board.imu.options(), Some(ImuOptions::Iio(_)));
        std::array::from_fn(|i| if is_bound { set[i].min(asked[i]) } else { set[i] })
    }

    /// How its stamps become those of the monotonic clock, where it begins now and is played at a `speed`.
    pub fn stamps(&self, speed: f64) -> Stamps {
        match self {
            Source::Live { .. } => Stamps::default(),
            Source::Recorded(r) => {
                Stamps { stamp: r.stamps.first().copied().unwrap_or_default(), monotonic: host::monotonic(), speed }
            }
        }
    }

    /// The sensors; a recording plays in their place.
    pub fn sensors(self, playback: Playback) -> Sensors {
        match self {
            Source::Live { sensors, .. } => sensors,
            Source::Recorded(r) => r.paced(playback),
        }
    }
}

impl Recorded {
    /// Seconds from the first frame to the last.
    pub fn length_s(&self) -> f64 {
        match (self.stamps.first(), self.stamps.last()) {
            (Some(a), Some(b)) => (*b - *a).secs(),
            _ => 0.0,
        }
    }

    /// Leaves the frames whose stamp is less than `duration_s` after the first.
    pub fn cut(&mut self, duration_s: Option<f64>) {
        if let (Some(s), Some(&first)) = (duration_s, self.stamps.first()) {
            self.stamps.truncate(self.stamps.partition_point(|t| (*t - first).secs() < s));
        }
    }

    /// Plays it.
    pub fn paced(mut self, playback: Playback) -> Sensors {
        let first = self.stamps.first().copied().unwrap_or_default();
        let mut pace = Pace::at_speed(first, playback.speed);
        if playback.repeats {
            // The first frame of the next lap takes the place of the last of this one: no sample is missing between them.
            let last = if self.stamps.len() > 1 { self.stamps.pop() } else { None };
            let end = last.unwrap_or(first + Span::from_secs(1.0));
            self.imu.retain(|s| s.t >= first && s.t < end);
            self.aids.retain(|a| a.t >= first && a.t < end);
            pace = pace.repeating(end - first);
        }
        Sensors {
            frames: Box::new(PacedFrames::new(self.images, self.stamps, pace)),
            imu: Box::new(PacedImu::new(self.imu.into(), pace)),
            aids: (!self.aids.is_empty()).then(|| Box::new(PacedAids::new(self.aids, pace)) as Box<dyn AidSource>),
        }
    }
}

impl Sensors {
    /// Adds faults to what the sensors give; `shape` makes frames of the rig's shape.
    pub fn with_faults(self, inject: &InjectConfig, shape: impl Fn() -> Frames) -> Sensors {
        let Sensors { mut frames, mut imu, aids } = self;
        if !inject.camera.is_empty() {
            frames = Box::new(FaultyFrames::new(frames, &inject.camera, inject.seed, shape()));
        }
        if !inject.imu.is_empty() {
            imu = Box::new(FaultyImu::new(imu, &inject.imu, inject.seed));
        }
        Sensors { frames, imu, aids }
    }
}

fn open(path: &Path, board: &Board) -> Result<(Calibration, Sensors), Fault> {
    let parts = [
        ("[camera] devices", board.camera.devices.is_empty()),
        ("[imu] chip", board.imu.options().is_none()),
        ("[rig] calibration", board.rig.calibration.is_empty()),
    ];
    let missing: Vec<&str> = parts.iter().filter(|(_, is)| *is).map(|(name, _)| *name).collect();
    let (Some(options), true) = (board.imu.options(), missing.is_empty()) else {
        let what = format!("does not say {}", missing.join(", "));
        let fix = "write what is missing, or pass --dataset to run on a recording";
        return Err(Fault::new(FaultKind::Config, path.display().to_string(), what, fix));
    };
    let calibration = calibration(path, board)?;
    let data_ready = board.gpio.data_ready().map(|(line, edge)| DataReady::open(&line, edge)).transpose()?;
    let imu = CorrectedImu { source: options.open(data_ready)?, correction: calibration.imu.correction };
    let rig = cameras(&calibration, board)?;
    rig.describe().iter().for_each(|line| print_err(format_args!("stipple: {line}")));
    let frames: Box<dyn FrameSource> = match board.gpio.trigger() {
        None => Box::new(rig),
        Some((line, active_low, pulse)) => {
            let trigger = Trigger::new(Output::open(&line, active_low)?, pulse, board.camera.rate_hz);
            Box::new(Triggered { source: rig, pulses: Pulses::start(trigger) })
        }
    };
    let aids = board.baro.options().map(|baro| baro.open()).transpose()?;
    Ok((calibration, Sensors { frames, imu: Box::new(imu), aids }))
}

/// Opens the cameras of a board; those that its map trains in colour give it.
fn cameras(calibration: &Calibration, board: &Board) -> Result<v4l2::Rig, Fault> {
    let colours = memory::colours(calibration, board).len();
    v4l2::Rig::open(board.camera.settings(calibration, colours)?, calibration)
}

/// Opens each part of a board by itself, where not all can be opened: its name, and what was found or is wrong.
pub fn parts(path: &Path, board: &Board) -> Vec<(&'static str, Result<String, Fault>)> {
    let mut parts = vec![];
    let calibration = calibration(path, board);
    let cameras = calibration
        .as_ref()
        .map_err(Fault::clone)
        .and_then(|calibration| Ok(cameras(calibration, board)?.describe().join("; ")));
    let count = |c: &Calibration| format!("{} cameras", c.cameras.len());
    parts.push(("calibration", calibration.as_ref().map(count).map_err(Fault::clone)));
    let unopened =
        |_| Fault::new(FaultKind::Config, "cameras", "not opened: they need the calibration", "mend rig.calibration");
    parts.push(("cameras", if calibration.is_ok() { cameras } else { cameras.map_err(unopened) }));
    let none = || Fault::new(FaultKind::Config, "[imu]", "names no chip", "write imu.chip and where it is wired");
    let data_ready = board.gpio.data_ready().map(|(line, edge)| DataReady::open(&line, edge)).transpose();
    if board.gpio.data_ready().is_some() {
        parts.push(("data-ready line", data_ready.as_ref().map(|_| "opened".into()).map_err(Fault::clone)));
    }
    let opened = board.imu.options().ok_or_else(none).and_then(|o| o.open(data_ready.ok().flatten()));
    parts.push(("inertial unit", opened.map(|_| format!("{} answers", board.imu.chip))));
    if let Some(baro) = board.baro.options() {
        parts.push(("barometer", baro.open().map(|_| format!("{} answers", board.baro.chip))));
    }
    let outputs =
        [("trigger line", board.gpio.trigger().map(|(line, low, _)| (line, low))), ("status light", board.gpio.led())];
    for (name, (line, active_low)) in outputs.into_iter().filter_map(|(name, o)| Some((name, o?))) {
        parts.push((name, Output::open(&line, active_low).map(|_| "opened".into())));
    }
    parts
}

/// Reads the board's calibration; a relative path starts at the board file's folder.
fn calibration(path: &Path, board: &Board) -> Result<Calibration, Fault> {
    let folder = path.parent().unwrap_or(Path::new(""));
    let fix = "set rig.calibration to a folder with cam0/sensor.yaml, Kalibr's camchain.yaml, or Basalt's json";
    let unread = |f: Fault| if f.kind == FaultKind::NoInput { Fault { fix: fix.into(), ..f } } else { f };
    let mut calibration = read_calibration(&folder.join(&board.rig.calibration)).map_err(unread)?;
    // Noise densities are the unit's; how often it is read here is the board's word.
    calibration.imu.rate_hz = board.imu.rate_hz;
    if board.rig.readout_s > 0.0 {
        calibration.cameras.iter_mut().for_each(|c| c.readout = Span::from_secs(board.rig.readout_s));
    }
    board.rig.mask(&mut calibration)?;
    Ok(calibration)
}

/// An inertial unit whose readings are corrected by its calibration, as those of recordings are.
struct CorrectedImu {
    source: Box<dyn ImuSource>,
    correction: ImuCorrection,
}

impl ImuSource for CorrectedImu {
    fn next(&mut self, timeout: Span, batch: &mut ImuBatch) -> Result<Wait, SourceFault> {
        let wait = self.source.next(timeout, batch)?;
        batch.iter_mut().for_each(|reading| reading.sample = self.correction.apply(&reading.sample));
        Ok(wait)
    }

    fn inner(&self) -> Option<&dyn ImuSource> {
        Some(&*self.source)
    }
}

/// Thread `trigger`: starts exposures until it is dropped.
struct Pulses {
    stop: Arc<AtomicBool>,
    /// Pulses that failed, and pulses whose period was over before they came.
    counts: Arc<[Counter; 2]>,
    thread: Option<JoinHandle<()>>,
}

impl Pulses {
    fn start(mut trigger: Trigger) -> Pulses {
        let (stop, counts): (Arc<AtomicBool>, Arc<[Counter; 2]>) = Default::default();
        let (asked, counted) = (stop.clone(), counts.clone());
        let thread = super::start("trigger", move || {
            while !asked.load(Relaxed) {
                threads::alive();
                counted[1].add(trigger.wait());
                counted[0].add(u64::from(trigger.pulse().is_err()));
            }
        });
        Pulses { stop, counts, thread: Some(thread) }
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

    fn inner(&self) -> Option<&dyn FrameSource> {
        Some(&self.source)
    }

    fn counters(&self) -> Vec<(&'static str, u64)> {
        let mut list = self.source.counters();
        let [failed, missed] = &*self.pulses.counts;
        list.extend([("trigger_failures", failed.get()), ("trigger_missed", missed.get())]);
        list
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    struct Unit([f64; 2]);

    impl ImuSource for Unit {
        fn next(&mut self, _: Span, _: &mut ImuBatch) -> Result<Wait, SourceFault> {
            Ok(Wait::TimedOut)
        }

        fn range(&self) -> Option<[f64; 2]> {
            Some(self.0)
        }
    }

    struct NoFrames;

    impl FrameSource for NoFrames {
        fn next(&mut self, _: Span, _: &mut Frames) -> Result<Wait, SourceFault> {
            Ok(Wait::TimedOut)
        }
    }

    /// ST's gyros end at 2000 °/s and their storage at 2294: readings that were clipped counted as sound. A BMI088 that is
    /// asked for 16 g is set to 24 g, and means it.
    #[test]
    fn the_end_of_a_kernel_devices_storage_is_no_more_than_a_bound() {
        let lavapipe = include_str!("../../board-configs/lavapipe.toml");
        let asked = Board::parse("", lavapipe, &[]).unwrap().imu.range();
        let (wide, narrow) = (asked.map(|end| 1.147 * end), asked.map(|end| 0.5 * end));
        for (chip, of_wide) in [("iio", asked), ("bmi088", wide)] {
            let set = [format!("imu.chip={chip}"), "imu.device=mpu6500".into()];
            let board = Board::parse("", lavapipe, &set).unwrap();
            for (set, taken) in [(wide, of_wide), (narrow, narrow)] {
                let sensors = Sensors { frames: Box::new(NoFrames), imu: Box::new(Unit(set)), aids: None };
                assert_eq!(Source::Live { sensors, rate_hz: 20.0 }.imu_range(&board), taken, "{chip}");
            }
        }
    }
}
