//! Plays an input through tracking and mapping, in one of two paces.
//!
//! `recorded`, here: frames arrive when they were recorded; what is not done in time is not done. While
//! the estimator is behind, the newest frame waits for it and replaces the one that waited before,
//! which is counted. `lockstep`: a stated number of mapper steps a frame; the same input, the same map.

use super::input::Input;
use super::lockstep::lockstep;
use super::mapping::{KeyframeQueue, Mapping, SLICE};
use super::pipeline::{Bell, Ends, Pipeline};
use super::progress::{Gauges, Progress};
use super::tracking::{Slot, Tracking};
use crate::counters::Counters;
use crate::map::{Keyframe, PoseCorrection};
use crate::mem::{seal_thread, unsealed};
use crossbeam_queue::ArrayQueue;
use std::sync::atomic::{AtomicBool, Ordering, Ordering::Relaxed};
use std::time::{Duration, Instant};
use stipple_drivers::paced::Images;
use stipple_drivers::{ImuSample, Nanos, Pose};

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
    pub lockstep_iterations: u32,
    /// In lockstep: instead of iterations, an equal part of these seconds of mapping a frame.
    pub mapping_s: Option<f64>,
}

pub struct Played {
    pub tracking: Tracking,
    pub mapping: Option<Mapping>,
    pub counters: Counters,
    pub frames: usize,
    pub keyframes: u64,
    pub wall_s: f64,
    pub warnings: Vec<String>,
    /// Counters of the source.
    pub source: Vec<(&'static str, u64)>,
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
    let mut progress = Progress::new(length_s);
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

/// One being decoded, one waiting, one in hand while they change places, and one in tracking for each
/// of its threads.
pub fn frame_slots(threads: u32) -> usize {
    3 + threads as usize
}

/// Two seconds of a 1 kHz unit.
const IMU_SLOTS: usize = 2048;
const POLL: Duration = Duration::from_micros(500);

/// What the threads of a recorded-pace run share. Slots go round: spare -> newest -> tracking -> spare.
struct Shared {
    start: Instant,
    spare: ArrayQueue<Box<Slot>>,
    newest: ArrayQueue<Box<Slot>>,
    imu: ArrayQueue<ImuSample>,
    /// `None` without a mapper.
    keyframes: Option<KeyframeQueue>,
    counters: Counters,
    gauges: Gauges,
    source_done: AtomicBool,
    tracking_done: AtomicBool,
    mapping_done: AtomicBool,
}

fn recorded(
    input: Input,
    mut tracking: Tracking,
    mapping: Option<Mapping>,
    options: &Play,
    progress: &mut Progress,
) -> Played {
    let slots = frame_slots(tracking.threads());
    let colours = mapping.as_ref().map_or(0, |m| m.mapper.colours_offered());
    let shared = Shared {
        start: Instant::now(),
        spare: ArrayQueue::new(slots),
        newest: ArrayQueue::new(1),
        imu: ArrayQueue::new(IMU_SLOTS),
        keyframes: mapping.as_ref().map(|m| m.queue(&input.calibration)),
        counters: Counters::default(),
        gauges: Gauges::default(),
        source_done: AtomicBool::new(false),
        tracking_done: AtomicBool::new(false),
        mapping_done: AtomicBool::new(mapping.is_none()),
    };
    for _ in 0..slots {
        let _ = shared.spare.push(Slot::for_rig(&input.calibration, colours));
    }
    let total = input.frames_within(options.duration_s);
    let Input { imu, stamps, mut source, warnings, .. } = input;
    let (s, pipeline) = (&shared, Pipeline::new());
    let mut keyframes = Keyframes::new(options.holdout);
    let (mapping, source) = std::thread::scope(|scope| {
        let (bell, counted) = (&pipeline.taker, &mut keyframes);
        let source_thread = scope.spawn(move || {
            let _ended = Ends(&s.source_done, Some(bell));
            feed(s, bell, &mut source, &stamps[..total], &imu);
            source
        });
        let give = move |slot: Box<Slot>| {
            counted.pass_on(&slot, s.keyframes.as_ref(), &s.counters);
            s.gauges.frames.fetch_add(1, Relaxed);
            s.gauges.keyframes.store(counted.count, Relaxed);
            let _ = s.spare.push(slot);
        };
        let ended = Ends(&s.tracking_done, None);
        pipeline.start(scope, &mut tracking, &s.source_done, &s.counters, || newest(s), give, ended);
        let mapping_thread = mapping.map(|m| scope.spawn(move || map(s, m, options.duration_s)));
        while !(s.tracking_done.load(Relaxed) && s.mapping_done.load(Relaxed)) {
            progress.show(&s.gauges);
            std::thread::sleep(Duration::from_millis(50));
        }
        let died = "threads of a run answer with values, not panics";
        (mapping_thread.map(|t| t.join().expect(died)), source_thread.join().expect(died))
    });
    Played {
        tracking,
        mapping,
        frames: total,
        keyframes: keyframes.count,
        wall_s: shared.start.elapsed().as_secs_f64(),
        warnings: [&warnings[..], source.warnings()].concat(),
        counters: shared.counters,
        source: source.counters(),
    }
}

/// The newest frame, with the samples that have come up to the first at or past it.
fn newest(s: &Shared) -> Option<Box<Slot>> {
    let mut slot = s.newest.pop()?;
    slot.imu.clear();
    while let Some(sample) = s.imu.pop() {
        slot.push_imu(sample, &s.counters);
        if sample.t >= slot.frames.t {
            break;
        }
    }
    Some(slot)
}

/// Thread `source`, in the place of the sensors: decodes ahead, delivers at the recorded time.
fn feed(s: &Shared, tracking: &Bell, source: &mut Images, stamps: &[Nanos], imu: &[ImuSample]) {
    let mut imu = imu.iter().copied();
    for (i, &t) in stamps.iter().enumerate() {
        let Some(mut slot) = s.spare.pop() else {
            // Every buffer is in use: tracking is behind, this one is lost.
            s.counters.frames_overwritten.add(1);
            continue;
        };
        let read = source.read(i, &mut slot.frames);
        let due = s.start + Duration::from_nanos((t - stamps[0]).0.max(0) as u64);
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        // One sample past the frame, to interpolate at its stamp.
        for sample in imu.by_ref() {
            if s.imu.push(sample).is_err() {
                s.counters.imu_overflow.add(1);
            }
            if sample.t >= t {
                break;
            }
        }
        match read {
            Ok(()) => {
                if let Some(old) = s.newest.force_push(slot) {
                    s.counters.frames_overwritten.add(1);
                    let _ = s.spare.push(old);
                }
            }
            Err(_) => {
                s.counters.frames_unreadable.add(1);
                let _ = s.spare.push(slot);
            }
        }
        tracking.ring();
        s.gauges.played_ms.store(((t - stamps[0]).secs() * 1e3) as u64, Relaxed);
    }
}

/// Thread `mapping`: keyframes first, then single steps, until the run's time is over.
fn map(s: &Shared, mut mapping: Mapping, duration_s: Option<f64>) -> Mapping {
    stipple_drivers::host::lower_priority();
    seal_thread();
    let over = |tracked: bool| match duration_s {
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
