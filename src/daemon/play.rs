//! Plays an input through tracking and mapping, in one of two paces.
//!
//! `recorded`: frames arrive when they were recorded; what is not done in time is not done.
//! `lockstep`: one thread, a stated number of mapper steps a frame; the same input gives the same map.

use super::input::{Input, Source};
use super::mapping::{KeyframeQueue, Mapping, SLICE};
use super::progress::{Gauges, Progress};
use super::tracking::{Tracked, Tracking};
use crate::counters::Counters;
use crate::map::{Keyframe, PoseCorrection};
use crate::mem::{seal_thread, unsealed};
use crossbeam_queue::ArrayQueue;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::time::{Duration, Instant};
use stipple_drivers::{Frames, ImuSample, Nanos, Pose};

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

/// Numbers keyframes, chooses the held-out ones, and offers them.
struct Keyframes {
    holdout: u32,
    count: u64,
}

impl Keyframes {
    fn fill(&mut self, slot: &mut Keyframe, world_from_body: Pose) {
        slot.id = self.count;
        slot.world_from_body = world_from_body;
        let n = u64::from(self.holdout);
        slot.held_out = n > 0 && self.count % n == n - 1;
        self.count += 1;
    }
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

fn lockstep(
    mut input: Input,
    mut tracking: Tracking,
    mut mapping: Option<Mapping>,
    options: &Play,
    progress: &mut Progress,
) -> Played {
    let counters = Counters::default();
    let gauges = Gauges::default();
    let queue = KeyframeQueue::new(&input.calibration);
    let mut frames = Frames::for_rig(&input.calibration);
    let mut keyframes = Keyframes { holdout: options.holdout, count: 0 };
    let mut recent = Recent::new();
    let mut warnings = std::mem::take(&mut input.warnings);
    let total = input.frames_within(options.duration_s);
    let start = Instant::now();
    let mut imu = input.imu.iter().copied();
    for i in 0..total {
        // One sample past the frame, to interpolate at its stamp.
        for sample in imu.by_ref() {
            tracking.imu(sample);
            if sample.t >= input.stamps[i] {
                break;
            }
        }
        if input.source.read(i, &mut frames).is_err() {
            counters.frames_unreadable.add(1);
            continue;
        }
        if let Some(tracked) = tracking.frame(&frames, &counters) {
            pass_on(&tracked, &tracking, &frames, &mut keyframes, &mut recent, &queue, &counters);
        }
        gauges.frames.store(i as u64 + 1, Relaxed);
        gauges.keyframes.store(keyframes.count, Relaxed);
        gauges.played_ms.store(((input.stamps[i] - input.stamps[0]).secs() * 1e3) as u64, Relaxed);
        if let Some(m) = &mut mapping {
            drain(&queue, m);
            for _ in 0..options.lockstep_iterations {
                m.step(Instant::now(), &gauges);
            }
            m.sample_if_due(start.elapsed().as_secs_f64(), &gauges);
        }
        progress.show(&gauges);
    }
    if let Some(m) = &mut mapping {
        for _ in 0..extra_iterations(&input, total, options) {
            m.step(Instant::now(), &gauges);
            m.sample_if_due(start.elapsed().as_secs_f64(), &gauges);
            progress.show(&gauges);
        }
        m.sample(start.elapsed().as_secs_f64(), &gauges);
    }
    let wall_s = start.elapsed().as_secs_f64();
    warnings.extend_from_slice(input.source.warnings());
    let source = input.source.counters();
    Played { tracking, mapping, counters, frames: total, keyframes: keyframes.count, wall_s, warnings, source }
}

/// Lockstep time past the end of the recording, in iterations at the recording's frame rate.
fn extra_iterations(input: &Input, total: usize, options: &Play) -> u64 {
    let length_s = input.length_s();
    match options.duration_s {
        Some(s) if s > length_s && total > 1 && length_s > 0.0 => {
            let frames = (s - length_s) * (total - 1) as f64 / length_s;
            frames as u64 * u64::from(options.lockstep_iterations)
        }
        _ => 0,
    }
}

/// Hands a tracked frame on: a keyframe to the mapper, and the window's newer poses with it.
fn pass_on(
    tracked: &Tracked,
    tracking: &Tracking,
    frames: &Frames,
    keyframes: &mut Keyframes,
    recent: &mut Recent,
    queue: &KeyframeQueue,
    counters: &Counters,
) {
    if !tracked.keyframe {
        return;
    }
    let id = keyframes.count;
    if queue.offer(frames, |slot| keyframes.fill(slot, tracked.world_from_body)) {
        recent.add(frames.t, id);
    } else {
        counters.keyframes_rejected.add(1);
    }
    tracking.corrections(|t, world_from_body| {
        if let Some(id) = recent.find(t).filter(|found| *found != id) {
            if queue.corrections.push(PoseCorrection { id, world_from_body }).is_err() {
                counters.corrections_full.add(1);
            }
        }
    });
}

fn drain(queue: &KeyframeQueue, mapping: &mut Mapping) {
    let mapper = &mut mapping.mapper;
    while mapper.has_room() && queue.take(|keyframe| mapper.offer(keyframe)).is_some() {}
    while let Some(correction) = queue.corrections.pop() {
        mapper.correct(&correction);
    }
}

/// What the threads of a recorded-pace run share. Frames go round: spare -> newest -> spare.
struct Shared {
    start: Instant,
    spare: ArrayQueue<Box<Frames>>,
    newest: ArrayQueue<Box<Frames>>,
    imu: ArrayQueue<ImuSample>,
    keyframes: KeyframeQueue,
    counters: Counters,
    gauges: Gauges,
    source_done: AtomicBool,
    tracking_done: AtomicBool,
    mapping_done: AtomicBool,
    keyframe_count: AtomicUsize,
}

/// One being decoded, one waiting, one being tracked, one in hand while they change places.
pub const FRAME_SLOTS: usize = 4;
/// Two seconds of a 1 kHz unit.
const IMU_SLOTS: usize = 2048;
const POLL: Duration = Duration::from_micros(500);

fn recorded(
    input: Input,
    tracking: Tracking,
    mapping: Option<Mapping>,
    options: &Play,
    progress: &mut Progress,
) -> Played {
    let shared = Shared {
        start: Instant::now(),
        spare: ArrayQueue::new(FRAME_SLOTS),
        newest: ArrayQueue::new(1),
        imu: ArrayQueue::new(IMU_SLOTS),
        keyframes: KeyframeQueue::new(&input.calibration),
        counters: Counters::default(),
        gauges: Gauges::default(),
        source_done: AtomicBool::new(false),
        tracking_done: AtomicBool::new(false),
        mapping_done: AtomicBool::new(mapping.is_none()),
        keyframe_count: AtomicUsize::new(0),
    };
    for _ in 0..FRAME_SLOTS {
        let _ = shared.spare.push(Box::new(Frames::for_rig(&input.calibration)));
    }
    let total = input.frames_within(options.duration_s);
    let Input { imu, stamps, mut source, warnings, .. } = input;
    let s = &shared;
    let (tracking, mapping, source) = std::thread::scope(|scope| {
        let source_thread = scope.spawn(move || {
            feed(s, &mut source, &stamps[..total], &imu);
            source
        });
        let tracking_thread = scope.spawn(move || track(s, tracking, options.holdout));
        let mapping_thread = mapping.map(|m| scope.spawn(move || map(s, m, options.duration_s)));
        while !(s.tracking_done.load(Relaxed) && s.mapping_done.load(Relaxed)) {
            progress.show(&s.gauges);
            std::thread::sleep(Duration::from_millis(50));
        }
        let died = "threads of a run answer with values, not panics";
        let tracking = tracking_thread.join().expect(died);
        let mapping = mapping_thread.map(|t| t.join().expect(died));
        (tracking, mapping, source_thread.join().expect(died))
    });
    Played {
        tracking,
        mapping,
        frames: total,
        keyframes: shared.keyframe_count.load(Relaxed) as u64,
        wall_s: shared.start.elapsed().as_secs_f64(),
        warnings: [&warnings[..], source.warnings()].concat(),
        counters: shared.counters,
        source: source.counters(),
    }
}

/// Thread `source`, in the place of the sensors: decodes ahead, delivers at the recorded time.
fn feed(s: &Shared, source: &mut Source, stamps: &[Nanos], imu: &[ImuSample]) {
    let mut imu = imu.iter().copied();
    for (i, &t) in stamps.iter().enumerate() {
        let Some(mut frames) = s.spare.pop() else {
            // Every buffer is in use: the tracker is two frames behind, this one is lost.
            s.counters.frames_overwritten.add(1);
            continue;
        };
        let read = source.read(i, &mut frames);
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
                if let Some(old) = s.newest.force_push(frames) {
                    s.counters.frames_overwritten.add(1);
                    let _ = s.spare.push(old);
                }
            }
            Err(_) => {
                s.counters.frames_unreadable.add(1);
                let _ = s.spare.push(frames);
            }
        }
        s.gauges.played_ms.store(((t - stamps[0]).secs() * 1e3) as u64, Relaxed);
    }
    s.source_done.store(true, Ordering::Release);
}

/// Thread `tracking`: never waits for the mapper, allocates nothing.
fn track(s: &Shared, mut tracking: Tracking, holdout: u32) -> Tracking {
    let mut keyframes = Keyframes { holdout, count: 0 };
    let mut recent = Recent::new();
    seal_thread();
    loop {
        // Read before the queue, so that a frame pushed last is still taken.
        let done = s.source_done.load(Ordering::Acquire);
        let Some(frames) = s.newest.pop() else {
            if done {
                break;
            }
            std::thread::sleep(POLL);
            continue;
        };
        while let Some(sample) = s.imu.pop() {
            tracking.imu(sample);
            if sample.t >= frames.t {
                break;
            }
        }
        if let Some(tracked) = tracking.frame(&frames, &s.counters) {
            pass_on(&tracked, &tracking, &frames, &mut keyframes, &mut recent, &s.keyframes, &s.counters);
        }
        let _ = s.spare.push(frames);
        s.gauges.frames.fetch_add(1, Relaxed);
        s.gauges.keyframes.store(keyframes.count, Relaxed);
    }
    s.keyframe_count.store(keyframes.count as usize, Relaxed);
    s.tracking_done.store(true, Ordering::Release);
    tracking
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
        drain(&s.keyframes, &mut mapping);
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
