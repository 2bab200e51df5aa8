//! Plays an input through tracking and mapping, in one of two paces.
//!
//! `recorded`, here, and the sensors of a board alike: frames arrive when they do; what is not done in time is
//! not done. While the estimator is behind, the newest frame waits for it and replaces the one that waited
//! before, which is counted. `lockstep`: a stated number of mapper steps a frame; the same input, the same map.

use super::input::Input;
use super::lockstep::lockstep;
use super::mapping::{KeyframeQueue, Mapping, SLICE};
use super::pipeline::{Ends, Pipeline};
use super::progress::{Gauges, Progress};
use super::sensors::{self, Capture, Inbox, Sensors};
use super::tracking::{Slot, Tracking};
use crate::config::InjectConfig;
use crate::counters::Counters;
use crate::map::{Keyframe, PoseCorrection};
use crate::mem::{seal_thread, unsealed};
use std::sync::atomic::{AtomicBool, Ordering, Ordering::Relaxed};
use std::time::{Duration, Instant};
use stipple_drivers::paced::FRAMES_UNREADABLE;
use stipple_drivers::{host, Calibration, Fault, Frames, Nanos, Pose, Span};

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Pace {
    /// Frames arrive at their recorded time; what is not done in time is not done
    Recorded,
    /// Deterministic: a stated number of mapper iterations a frame
    Lockstep,
}

pub struct Play {
    pub pace: Pace,
    /// Every Nth keyframe is evaluated and never trained on; 0: none.
    pub holdout: u32,
    /// Ends the run after this time of the recording; past its end the mapper goes on alone.
    pub duration_s: Option<f64>,
    /// In lockstep: mapper iterations a frame, or where not zero, a second of the recording.
    pub lockstep_iterations: u32,
    pub lockstep_iterations_per_s: f64,
    /// At recorded pace: what goes wrong with the sensors.
    pub inject: InjectConfig,
    /// In lockstep: instead of iterations, an equal part of these seconds of mapping a frame.
    pub mapping_s: Option<f64>,
}

impl Play {
    /// Mapper iterations due in lockstep after so many frames that span so much time.
    pub fn steps_due(&self, frames: u64, since_first: Span) -> u64 {
        match self.lockstep_iterations_per_s {
            rate if rate > 0.0 => (rate * since_first.secs().max(0.0)) as u64,
            _ => frames * u64::from(self.lockstep_iterations),
        }
    }
}

pub struct Played {
    pub tracking: Tracking,
    pub mapping: Option<Mapping>,
    pub counters: Counters,
    pub frames: usize,
    pub keyframes: u64,
    pub wall_s: f64,
    pub warnings: Vec<String>,
    /// Counters of the sources.
    pub source: Vec<(&'static str, u64)>,
    /// In real time.
    pub capture: Option<Capture>,
    /// The source that broke, if one did.
    pub broken: Option<Fault>,
}

/// Keyframes the estimator may still move: the newest ones, by stamp.
struct Recent {
    entries: [(Nanos, u64); Recent::LEN],
    next: usize,
}

impl Recent {
    /// More than a window holds.
    const LEN: usize = 32;

    fn new() -> Recent {
        Recent { entries: [(Nanos::MIN, 0); Recent::LEN], next: 0 }
    }

    fn add(&mut self, t: Nanos, id: u64) {
        self.entries[self.next % Recent::LEN] = (t, id);
        self.next += 1;
    }

    fn find(&self, t: Nanos) -> Option<u64> {
        self.entries.iter().find(|e| e.0 == t).map(|e| e.1)
    }
}

/// Numbers keyframes, chooses the held-out ones, and hands them to the mapper where there is one.
pub struct Keyframes {
    holdout: u32,
    /// Accepted by the mapper's queue; without a mapper, all.
    pub count: u64,
    recent: Recent,
}

impl Keyframes {
    pub fn new(holdout: u32) -> Keyframes {
        Keyframes { holdout, count: 0, recent: Recent::new() }
    }

    fn fill(&mut self, slot: &mut Keyframe, world_from_body: Pose) {
        slot.id = self.count;
        slot.world_from_body = world_from_body;
        let n = u64::from(self.holdout);
        slot.held_out = n > 0 && self.count % n == n - 1;
        self.count += 1;
    }

    /// Hands a tracked frame on: a keyframe to the mapper, and the window's newer poses with it.
    pub fn pass_on(&mut self, slot: &Slot, queue: Option<&KeyframeQueue>, counters: &Counters) {
        let Some(tracked) = slot.tracked.as_ref().filter(|t| t.keyframe) else { return };
        let Some(queue) = queue else {
            self.count += 1;
            return;
        };
        if slot.blank {
            counters.keyframes_blank.add(1);
            return;
        }
        let id = self.count;
        if queue.offer(&slot.frames, |keyframe| self.fill(keyframe, tracked.world_from_body)) {
            self.recent.add(slot.frames.t, id);
        } else {
            counters.keyframes_rejected.add(1);
        }
        for (t, world_from_body) in tracked.corrections.iter() {
            if let Some(id) = self.recent.find(*t).filter(|found| *found != id) {
                if queue.corrections.push(PoseCorrection { id, world_from_body: *world_from_body }).is_err() {
                    counters.corrections_full.add(1);
                }
            }
        }
    }
}

pub fn play(input: Input, tracking: Tracking, mapping: Option<Mapping>, options: &Play) -> Played {
    let length_s = options.duration_s.unwrap_or_else(|| input.length_s());
    let mut progress = Progress::new(Some(length_s));
    let played = match options.pace {
        Pace::Recorded => recorded(input, tracking, mapping, options, &mut progress),
        Pace::Lockstep => lockstep(input, tracking, mapping, options, &mut progress),
    };
    progress.finish();
    played
}

pub fn drain(queue: &KeyframeQueue, mapping: &mut Mapping) {
    let mapper = &mut mapping.mapper;
    while mapper.has_room() && queue.take(|keyframe| mapper.offer(keyframe)).is_some() {}
    while let Some(correction) = queue.corrections.pop() {
        mapper.correct(&correction);
    }
}

/// One being decoded, one waiting, one in hand while they change places, one in tracking for each of its
/// threads, and the last one, from which points are followed.
pub fn frame_slots(threads: u32) -> usize {
    4 + threads as usize
}

/// What the mapper sleeps when it has nothing to do.
const POLL: Duration = Duration::from_micros(500);

/// What the threads of a run in real time share.
struct Shared {
    start: Instant,
    inbox: Inbox,
    /// `None` without a mapper.
    keyframes: Option<KeyframeQueue>,
    counters: Counters,
    gauges: Gauges,
    source_done: AtomicBool,
    tracking_done: AtomicBool,
    mapping_done: AtomicBool,
}

/// A run in real time ends when its cameras do, or is asked to by the flag: `stop`.
pub struct Realtime<'a> {
    pub holdout: u32,
    /// The mapper goes on until then.
    pub duration_s: Option<f64>,
    /// The sensors are stopped then.
    pub sensors_s: Option<f64>,
    pub stop: &'a AtomicBool,
}

fn recorded(
    input: Input,
    tracking: Tracking,
    mapping: Option<Mapping>,
    options: &Play,
    progress: &mut Progress,
) -> Played {
    let total = input.frames_within(options.duration_s);
    let Input { imu, mut stamps, source, mut warnings, calibration, .. } = input;
    stamps.truncate(total);
    let shape = || Frames::in_colour(&calibration, mapping.as_ref().map_or(0, |m| m.mapper.colours_offered()));
    let sensors = Sensors::of_recording(source, stamps, imu, &options.inject, shape);
    let run = Realtime {
        holdout: options.holdout,
        duration_s: options.duration_s,
        sensors_s: None,
        stop: &AtomicBool::new(false),
    };
    let mut played = realtime(sensors, &calibration, tracking, mapping, &run, progress);
    warnings.append(&mut played.warnings);
    Played { warnings, ..played }
}

/// Runs sensors through tracking and mapping.
pub fn realtime(
    mut sensors: Sensors,
    calibration: &Calibration,
    mut tracking: Tracking,
    mapping: Option<Mapping>,
    run: &Realtime,
    progress: &mut Progress,
) -> Played {
    let colours = mapping.as_ref().map_or(0, |m| m.mapper.colours_offered());
    let shared = Shared {
        start: Instant::now(),
        inbox: Inbox::new(frame_slots(tracking.threads()), calibration, colours),
        keyframes: mapping.as_ref().map(|m| m.queue(calibration)),
        counters: Counters::default(),
        gauges: Gauges::default(),
        source_done: AtomicBool::new(false),
        tracking_done: AtomicBool::new(false),
        mapping_done: AtomicBool::new(mapping.is_none()),
    };
    let (s, pipeline) = (&shared, Pipeline::new());
    let mut keyframes = Keyframes::new(run.holdout);
    let mapping = std::thread::scope(|scope| {
        let (bell, counted) = (&pipeline.taker, &mut keyframes);
        let Sensors { frames, imu } = &mut sensors;
        scope.spawn(move || {
            let _ended = Ends(&s.source_done, Some(bell));
            sensors::camera(&s.inbox, frames, bell, &s.counters, &s.gauges);
        });
        scope.spawn(move || sensors::inertial(&s.inbox, imu, bell, &s.source_done, &s.counters));
        let give = move |slot: Box<Slot>| {
            if !slot.frameless {
                counted.pass_on(&slot, s.keyframes.as_ref(), &s.counters);
                s.gauges.frames.fetch_add(1, Relaxed);
                s.gauges.posed.fetch_add(u64::from(slot.tracked.is_some()), Relaxed);
                s.gauges.keyframes.store(counted.count, Relaxed);
            }
            let _ = s.inbox.spare.push(slot);
        };
        let mut held = None;
        let take = move || s.inbox.take(&mut held, &s.source_done, &s.counters);
        let ended = Ends(&s.tracking_done, None);
        pipeline.start(scope, &mut tracking, &s.source_done, &s.counters, take, give, ended);
        let mapping_thread = mapping.map(|m| scope.spawn(move || map(s, m, run)));
        while !(s.tracking_done.load(Relaxed) && s.mapping_done.load(Relaxed)) {
            let over = run.sensors_s.is_some_and(|limit| s.start.elapsed().as_secs_f64() >= limit);
            s.inbox.stop.fetch_or(over || run.stop.load(Relaxed), Relaxed);
            s.gauges.broke.fetch_or(!s.inbox.broken.is_empty(), Relaxed);
            while let Some(line) = s.inbox.notices.pop() {
                progress.say(&line);
            }
            progress.show(&s.gauges);
            std::thread::sleep(Duration::from_millis(50));
        }
        mapping_thread.map(|t| t.join().expect("threads of a run answer with values, not panics"))
    });
    let warnings = sensors.frames.warnings().to_vec();
    let mut source = [sensors.frames.counters(), sensors.imu.counters()].concat();
    source
        .iter()
        .filter(|(name, _)| *name == FRAMES_UNREADABLE)
        .for_each(|(_, n)| s.counters.frames_unreadable.add(*n));
    source.retain(|(name, _)| *name != FRAMES_UNREADABLE);
    // A recording ends when its taps are gone.
    drop(sensors);
    let arrived = s.inbox.arrived.load(Relaxed) + s.counters.frames_unreadable.get();
    Played {
        tracking,
        mapping,
        frames: arrived as usize,
        keyframes: keyframes.count,
        wall_s: shared.start.elapsed().as_secs_f64(),
        warnings,
        counters: shared.counters,
        source,
        capture: shared.inbox.capture.get().copied(),
        broken: shared.inbox.broken.pop(),
    }
}

/// Thread `mapping`: keyframes first, then single steps, until the run's time is over.
fn map(s: &Shared, mut mapping: Mapping, run: &Realtime) -> Mapping {
    host::lower_priority(host::Waits::Mapping);
    seal_thread();
    let over = |tracked: bool| match run.duration_s {
        _ if run.stop.load(Relaxed) => tracked,
        Some(d) => tracked && s.start.elapsed().as_secs_f64() >= d,
        None => tracked,
    };
    loop {
        let tracked = s.tracking_done.load(Ordering::Acquire);
        if let Some(queue) = &s.keyframes {
            drain(queue, &mut mapping);
        }
        let worked = mapping.step(Instant::now() + SLICE, &s.gauges);
        let t_s = s.start.elapsed().as_secs_f64();
        mapping.sample_if_due(t_s, &s.gauges);
        s.gauges.broke.fetch_or(mapping.failure.is_some(), Relaxed);
        if tracked {
            // Nothing is played any more; the run's own time is what progresses.
            s.gauges.played_ms.fetch_max((t_s * 1e3) as u64, Relaxed);
        }
        if over(tracked) || (tracked && mapping.failure.is_some()) {
            break;
        }
        if !worked {
            std::thread::sleep(POLL);
        }
    }
    unsealed(|| mapping.sample(s.start.elapsed().as_secs_f64(), &s.gauges));
    s.mapping_done.store(true, Ordering::Release);
    mapping
}
