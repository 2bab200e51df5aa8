//! A recording, or a simulated flight rendered before or as it is read, as a pair of sources that deliver at the recorded times. What is late is
//! delivered at once and in order, as by a device with a queue.

use crate::replay::{ImageFault, Reader};
use crate::sim::Sim;
use crate::source::{AidBatch, AidReading, AidSource, FrameSource, ImuBatch, ImuReading, ImuSource, SourceFault, Wait};
use crate::types::{Frames, ImuSample, Nanos, Span};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Images of a recording on disk, or rendered.
pub enum Images {
    Recording(Reader),
    /// Frames in memory.
    Rendered(Vec<Frames>),
    /// Each frame is rendered when it is read, and kept nowhere: memory does not grow with the flight.
    Simulated(Box<Simulated>),
}

/// A simulated flight, and who is told how many of its frames are rendered, of all.
pub struct Simulated {
    pub sim: Sim,
    pub progress: Box<dyn FnMut(usize, usize) + Send>,
}

impl Images {
    /// Reads frame `index` into pre-shaped `out`; `warnings` keeps the images that cannot be read, which are black. A fault
    /// where none can.
    pub fn read(&mut self, index: usize, out: &mut Frames) -> Result<(), ImageFault> {
        match self {
            Images::Recording(reader) => reader.read_any(index, out),
            Images::Rendered(frames) => {
                out.copy_from(&frames[index]);
                Ok(())
            }
            Images::Simulated(flight) => {
                flight.sim.render(index, out);
                (flight.progress)(index + 1, flight.sim.frame_count());
                Ok(())
            }
        }
    }

    /// Whether the first `cameras` are in colour.
    pub fn has_colour(&self, cameras: usize) -> bool {
        match self {
            Images::Recording(reader) => reader.has_colour(cameras),
            Images::Rendered(frames) => frames.iter().all(|f| f.colours.len() >= cameras),
            Images::Simulated(_) => true,
        }
    }

    /// The first faults of each kind, a line each.
    pub fn warnings(&self) -> &[String] {
        match self {
            Images::Recording(reader) => reader.warnings(),
            Images::Rendered(_) | Images::Simulated(_) => &[],
        }
    }

    /// Counters of faults, by name.
    pub fn counters(&self) -> Vec<(&'static str, u64)> {
        match self {
            Images::Recording(reader) => reader.counters().list(),
            Images::Rendered(_) | Images::Simulated(_) => vec![],
        }
    }
}

/// The instants at which the parts of a recording are due. Both sources of a recording are given the same.
#[derive(Clone, Copy, Debug)]
pub struct Pace {
    first: Nanos,
    start: Instant,
    /// Seconds of the recording per second.
    speed: f64,
    /// Length of a lap, where the recording begins again each time it ends.
    lap: Option<Span>,
}

impl Pace {
    /// The pace of the recording, `first` of which is due now.
    pub fn starting(first: Nanos) -> Pace {
        Pace::at_speed(first, 1.0)
    }

    /// A pace so many times as fast.
    pub fn at_speed(first: Nanos, speed: f64) -> Pace {
        Pace { first, start: Instant::now(), speed, lap: None }
    }

    /// The same pace for a recording that begins again after each `lap`, and whose stamps go on growing.
    pub fn repeating(self, lap: Span) -> Pace {
        Pace { lap: Some(lap), ..self }
    }

    /// Which of `count` parts is played as the `n`th, and how much later than it was recorded; `None` after the last.
    fn part(&self, n: usize, count: usize) -> Option<(usize, Span)> {
        match self.lap {
            Some(lap) if count > 0 => Some((n % count, Span(lap.0 * (n / count) as i64))),
            _ => (n < count).then_some((n, Span(0))),
        }
    }

    fn due(&self, t: Nanos) -> Instant {
        self.start + Duration::from_secs_f64(((t - self.first).secs() / self.speed).max(0.0))
    }

    /// Sleeps until `t` is due, or until `limit`; false where that is before.
    fn wait(&self, t: Nanos, limit: Instant) -> bool {
        let due = self.due(t);
        std::thread::sleep(due.min(limit).saturating_duration_since(Instant::now()));
        due <= limit
    }
}

fn after(timeout: Span) -> Instant {
    Instant::now() + Duration::from_nanos(timeout.0.max(0) as u64)
}

/// Name of the counter of frames whose images could not be read.
pub const FRAMES_UNREADABLE: &str = "frames_unreadable";

/// The cameras of a recording.
pub struct PacedFrames {
    images: Images,
    stamps: Vec<Nanos>,
    pace: Pace,
    next: usize,
    unreadable: u64,
}

impl PacedFrames {
    /// Frame i of `images` has stamp i; frames beyond the stamps are not played.
    pub fn new(images: Images, stamps: Vec<Nanos>, pace: Pace) -> PacedFrames {
        PacedFrames { images, stamps, pace, next: 0, unreadable: 0 }
    }
}

impl FrameSource for PacedFrames {
    /// Decodes ahead of the frame's time, so that decoding does not make it late.
    fn next(&mut self, timeout: Span, frames: &mut Frames) -> Result<Wait, SourceFault> {
        let limit = after(timeout);
        loop {
            let Some((index, later)) = self.pace.part(self.next, self.stamps.len()) else { return Ok(Wait::Ended) };
            let t = self.stamps[index] + later;
            if self.pace.due(t) > limit {
                self.pace.wait(t, limit);
                return Ok(Wait::TimedOut);
            }
            let read = self.images.read(index, frames);
            frames.t = frames.t + later;
            self.next += 1;
            self.pace.wait(t, limit);
            match read {
                Ok(()) => return Ok(Wait::Got),
                Err(_) => self.unreadable += 1,
            }
        }
    }

    fn counters(&self) -> Vec<(&'static str, u64)> {
        let mut list = self.images.counters();
        list.push((FRAMES_UNREADABLE, self.unreadable));
        list
    }

    fn warnings(&self) -> &[String] {
        self.images.warnings()
    }
}

/// The inertial unit of a recording.
pub struct PacedImu {
    samples: Arc<[ImuSample]>,
    pace: Pace,
    next: usize,
}

impl PacedImu {
    /// The samples of a recording, in the order of their stamps.
    pub fn new(samples: Arc<[ImuSample]>, pace: Pace) -> PacedImu {
        PacedImu { samples, pace, next: 0 }
    }
}

impl PacedImu {
    fn upcoming(&self) -> Option<ImuSample> {
        let (index, later) = self.pace.part(self.next, self.samples.len())?;
        let sample = self.samples[index];
        Some(ImuSample { t: sample.t + later, ..sample })
    }
}

impl ImuSource for PacedImu {
    fn next(&mut self, timeout: Span, batch: &mut ImuBatch) -> Result<Wait, SourceFault> {
        batch.clear();
        let Some(first) = self.upcoming() else { return Ok(Wait::Ended) };
        if !self.pace.wait(first.t, after(timeout)) {
            return Ok(Wait::TimedOut);
        }
        let now = Instant::now();
        while let Some(sample) = self.upcoming().filter(|s| self.pace.due(s.t) <= now) {
            if batch.push(ImuReading { sample, ..ImuReading::default() }).is_err() {
                break;
            }
            self.next += 1;
        }
        Ok(Wait::Got)
    }
}

/// The barometer of a recording.
pub struct PacedAids {
    readings: Vec<AidReading>,
    pace: Pace,
    next: usize,
}

impl PacedAids {
    /// The readings of a recording, in the order of their stamps.
    pub fn new(readings: Vec<AidReading>, pace: Pace) -> PacedAids {
        PacedAids { readings, pace, next: 0 }
    }

    fn upcoming(&self) -> Option<AidReading> {
        let (index, later) = self.pace.part(self.next, self.readings.len())?;
        let reading = self.readings[index];
        Some(AidReading { t: reading.t + later, ..reading })
    }
}

impl AidSource for PacedAids {
    fn next(&mut self, timeout: Span, batch: &mut AidBatch) -> Result<Wait, SourceFault> {
        batch.clear();
        let Some(first) = self.upcoming() else { return Ok(Wait::Ended) };
        if !self.pace.wait(first.t, after(timeout)) {
            return Ok(Wait::TimedOut);
        }
        let now = Instant::now();
        while let Some(reading) = self.upcoming().filter(|r| self.pace.due(r.t) <= now) {
            if batch.push(reading).is_err() {
                break;
            }
            self.next += 1;
        }
        Ok(Wait::Got)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::types::Image;

    const MS: i64 = 1_000_000;

    fn frames(n: i64) -> (Images, Vec<Nanos>) {
        let frame = |i: i64| Frames { t: Nanos(i * 20 * MS), images: vec![Image::new(2, 2)], colours: vec![] };
        (Images::Rendered((0..n).map(frame).collect()), (0..n).map(|i| Nanos(i * 20 * MS)).collect())
    }

    #[test]
    fn frames_come_in_order_not_before_their_time_and_end() {
        let (images, stamps) = frames(4);
        let pace = Pace::starting(stamps[0]);
        let mut source = PacedFrames::new(images, stamps, pace);
        let mut out = Frames { images: vec![Image::new(2, 2)], ..Frames::default() };
        let (mut seen, mut waits) = (vec![], 0);
        loop {
            match source.next(Span(7 * MS), &mut out).unwrap() {
                Wait::Got => {
                    assert!(Instant::now() >= pace.due(out.t));
                    seen.push(out.t.0 / MS);
                }
                Wait::TimedOut => waits += 1,
                Wait::Ended => break,
            }
        }
        assert_eq!(seen, [0, 20, 40, 60]);
        assert!(waits >= 3, "{waits}");
    }

    #[test]
    fn a_recording_that_repeats_goes_on_with_stamps_that_grow() {
        let (images, stamps) = frames(3);
        let sample = |i: i64| ImuSample { t: Nanos(i * 20 * MS), ..ImuSample::default() };
        let pace = Pace::at_speed(Nanos(0), 100.0).repeating(Span(60 * MS));
        let mut imu = PacedImu::new((0..3).map(sample).collect(), pace);
        let mut source = PacedFrames::new(images, stamps, pace);
        let mut out = Frames { images: vec![Image::new(2, 2)], ..Frames::default() };
        for i in 0..10 {
            while source.next(Span(MS), &mut out).unwrap() != Wait::Got {}
            assert_eq!(out.t, Nanos(i * 20 * MS));
        }
        let (mut batch, mut seen) = (ImuBatch::default(), vec![]);
        while seen.len() < 10 {
            imu.next(Span(MS), &mut batch).unwrap();
            seen.extend(batch.iter().map(|r| r.sample.t.0 / MS));
        }
        assert_eq!(seen[..10], [0, 20, 40, 60, 80, 100, 120, 140, 160, 180]);
    }

    #[test]
    fn every_sample_comes_once_however_late_it_is_asked_for() {
        let sample = |i: i64| ImuSample { t: Nanos(i * MS), ..ImuSample::default() };
        let samples: Arc<[ImuSample]> = (0..1000).map(sample).collect();
        let mut source = PacedImu::new(samples, Pace::at_speed(Nanos(0), 1e3));
        std::thread::sleep(Duration::from_millis(2));
        let (mut batch, mut seen) = (ImuBatch::default(), vec![]);
        while source.next(Span(MS), &mut batch).unwrap() != Wait::Ended {
            seen.extend(batch.iter().map(|r| r.sample.t.0 / MS));
        }
        assert_eq!(seen, (0..1000).collect::<Vec<_>>());
    }
}
