//! Recording beside a flight: taps on its sensors, and a writer behind a ring of fixed size.

use super::sensors::Sensors;
use super::threads;
use crate::config::Board;
use std::path::{Path, PathBuf};
use stipple_drivers::record::{self, Format, Recorder, Ring};
use stipple_drivers::source::AidSource;
use stipple_drivers::{Calibration, Fault, FaultKind, Frames};

/// A recording under way.
pub struct Recording {
    recorder: Recorder,
    dir: PathBuf,
}

impl Recording {
    /// Records what `sensors` give, in frames of this shape, to a folder that must not hold anything; nothing without one.
    pub fn start(
        to: Option<(&Path, Format)>,
        sensors: Sensors,
        calibration: &Calibration,
        board: &Board,
        shape: &Frames,
    ) -> Result<(Sensors, Option<Recording>), Fault> {
        let Some((dir, format)) = to else { return Ok((sensors, None)) };
        let sink = record::open(dir, format, calibration)?;
        let ring = Ring::new(shape, board.record.ring_frames as usize);
        let mut watched = None;
        let alive = move || {
            watched.get_or_insert_with(|| threads::watch(record::WRITER));
            threads::alive();
        };
        let sources = (sensors.frames, sensors.imu, sensors.aids);
        let (recorder, (frames, imu, aids)) = record::start(sink, sources, ring, alive);
        let aids = aids.map(|aids| Box::new(aids) as Box<dyn AidSource>);
        let sensors = Sensors { frames: Box::new(frames), imu: Box::new(imu), aids };
        Ok((sensors, Some(Recording { recorder, dir: dir.into() })))
    }

    /// Waits until everything is written and adds its counters; the sensors must be gone. An incomplete recording is an
    /// error.
    pub fn finish(self, counters: &mut Vec<(&'static str, u64)>) -> Result<(), Fault> {
        let recorded = self.recorder.finish();
        counters.extend(&recorded.counters);
        let Some(why) = &recorded.failure else { return Ok(()) };
        let what = format!("the recording lacks what could not be written: {why}");
        Err(Fault::new(FaultKind::Io, self.dir.display().to_string(), what, "check the free space of the disk"))
    }
}
