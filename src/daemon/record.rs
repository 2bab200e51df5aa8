//! `stipple record`: what the sensors give to disk, and nothing else.
//!
//! The threads are those of a run, with nobody at the mailbox, so that a loss is said and counted as in a run.

use super::light::Light;
use super::live::{rig_of, Run};
use super::pipeline::Bell;
use super::progress::{print, Gauges, Progress};
use super::sensors::{self, Inbox, Sensors};
use crate::config::Board;
use crate::counters::Counters;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::{Duration, Instant};
use stipple_drivers::record::{self, Format, Recorded};
use stipple_drivers::source::FrameSource;
use stipple_drivers::{host, Exit, Fault, Frames};

/// Slots that the cameras go round with when nobody tracks.
const SLOTS: usize = 3;
/// Counted by having no tracker.
const OF_TRACKING: [&str; 3] = ["frames_overwritten", "imu_overflow", "frames_without_imu"];

/// `stipple record`
pub fn record(path: &Path, out: &Path, format: Format, set: &[String], options: &Run) -> Result<(), Fault> {
    let board = Board::load(path, set)?;
    let light = Light::open(board.gpio.led())?;
    let rig = rig_of(path, &board, options)?;
    let shape = Frames::for_rig(&rig.calibration);
    let sink = record::open(out, format, &rig.calibration)?;
    let (recorder, taps) = record::start(sink, &shape, board.record.ring_frames as usize);
    let (mut frames, mut imu) = taps.on(rig.sensors.frames, rig.sensors.imu);
    let (inbox, bell, over) = (Inbox::new(SLOTS, &rig.calibration, 0), Bell::default(), AtomicBool::new(false));
    let (counters, gauges, begun) = (Counters::default(), Gauges::default(), Instant::now());
    let (stop, mut progress) = (host::stop_asked_for(), Progress::new(rig.length_s).lit(light));
    std::thread::scope(|scope| {
        let camera = scope.spawn(|| {
            sensors::camera(&inbox, &mut frames, &bell, &counters, &gauges);
            over.store(true, Relaxed);
        });
        scope.spawn(|| sensors::inertial(&inbox, &mut imu, &bell, &over, &counters));
        while !camera.is_finished() {
            let late = options.duration_s.is_some_and(|limit| begun.elapsed().as_secs_f64() >= limit);
            inbox.stop.fetch_or(late || stop.load(Relaxed), Relaxed);
            while let Some(line) = inbox.notices.pop() {
                progress.say(&line);
            }
            let arrived = inbox.arrived.load(Relaxed);
            [&gauges.frames, &gauges.posed].into_iter().for_each(|gauge| gauge.store(arrived, Relaxed));
            progress.show(&gauges);
            std::thread::sleep(Duration::from_millis(20));
        }
    });
    progress.finish();
    let line = inbox.capture.get().and_then(|c| c.line(&frames.counters()));
    line.into_iter().for_each(|line| print(format_args!("cameras     {line}")));
    drop((frames, imu));
    let recorded = recorder.finish();
    for (name, n) in counters.list().iter().chain(&recorded.counters) {
        if *n > 0 && !OF_TRACKING.contains(name) {
            print(format_args!("{n:>10}  {name}"));
        }
    }
    print(out.display());
    whole(&recorded, out)?;
    inbox.broken.pop().map_or(Ok(()), Err)?;
    progress.ended_well();
    Ok(())
}

/// A recording that lacks something is not passed over in silence.
pub fn whole(recorded: &Recorded, out: &Path) -> Result<(), Fault> {
    let Some(why) = &recorded.failure else { return Ok(()) };
    let what = format!("the recording lacks what could not be written: {why}");
    Err(Fault::new(Exit::Io, out.display().to_string(), what, "check the free space of the disk"))
}

/// Puts taps on sensors.
pub fn tapped(sensors: Sensors, taps: record::Taps) -> Sensors {
    let (frames, imu) = taps.on(sensors.frames, sensors.imu);
    Sensors { frames: Box::new(frames), imu: Box::new(imu) }
}
