//! The deterministic pace: every frame is tracked, and each gets a stated number of mapper steps. For comparisons at
//! equal time each gets an equal part of a stated mapping time instead; then only the tracking is deterministic.
//!
//! Frames are decoded a batch at a time into memory and tracked when the batch is there, so decoding
//! is in no figure and takes no core from tracking; reading a recording into memory whole would do
//! the same, but a flight of minutes does not fit. This thread decodes, then runs the mapper on the
//! frames that tracking gives back, in their order, while tracking goes on.

use super::input::Input;
use super::mapping::{Mapping, SLICE};
use super::pipeline::{Bell, Ends, Pipeline};
use super::play::{drain, Keyframes, Play, Played};
use super::progress::{Gauges, Progress};
use super::tracking::{Slot, Tracking};
use crate::counters::Counters;
use crossbeam_queue::ArrayQueue;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::{Duration, Instant};
use stipple_drivers::{ImuSample, Span};

/// Frames decoded at once: 24 MiB of two 752x480 cameras. What the threads of tracking lose at its ends is
/// one stage of one frame in so many.
const BATCH: usize = 32;
/// And the one before the batch, from which points are followed.
const SLOTS: usize = BATCH + 1;

pub fn lockstep(
    mut input: Input,
    mut tracking: Tracking,
    mut mapping: Option<Mapping>,
    options: &Play,
    progress: &mut Progress,
) -> Played {
    let counters = Counters::default();
    let gauges = Gauges::default();
    let queue = mapping.as_ref().map(|m| m.queue(&input.calibration));
    let colours = mapping.as_ref().map_or(0, |m| m.mapper.colours_offered());
    let mut keyframes = Keyframes::new(options.holdout);
    let mut warnings = std::mem::take(&mut input.warnings);
    let total = input.frames_within(options.duration_s);
    let mut slots: Vec<Box<Slot>> =
        (0..SLOTS.min(total + 1)).map(|_| Slot::for_rig(&input.calibration, colours)).collect();
    let (waiting, done) = (ArrayQueue::new(SLOTS), ArrayQueue::new(SLOTS));
    let (over, ended, bell, pipeline) =
        (AtomicBool::new(false), AtomicBool::new(false), Bell::default(), Pipeline::new());
    let start = Instant::now();
    let ahead = options.mapping_s.is_none() && options.lockstep_iterations_per_s > 0.0;
    let (mut iterated, mut played_s) = (0, 0.0);
    std::thread::scope(|scope| {
        let (taken, given, rung) = (&waiting, &done, &bell);
        let give = move |slot| {
            // As many places as slots.
            let _ = given.push(slot);
            rung.ring();
        };
        let last = Ends(&ended, Some(rung));
        pipeline.start(scope, &mut tracking, &over, &counters, || taken.pop(), give, last);
        let _over = Ends(&over, Some(&pipeline.taker));
        let mut reading = Reading { next: 0, samples: 0 };
        while reading.next < total {
            let mut sent = read_batch(&mut input, total, &mut reading, &mut slots, &waiting, &counters);
            pipeline.taker.ring();
            while sent > 0 {
                let Some(slot) = bell.wait(&ended, || done.pop()) else { return };
                sent -= 1;
                keyframes.pass_on(&slot, queue.as_ref(), &counters);
                gauges.frames.fetch_add(1, Relaxed);
                gauges.keyframes.store(keyframes.count, Relaxed);
                let since_first = slot.frames.t - input.stamps[0];
                played_s = since_first.secs();
                gauges.played_ms.store((played_s * 1e3) as u64, Relaxed);
                slots.push(slot);
                if let (Some(m), Some(queue)) = (&mut mapping, &queue) {
                    // A device so slow has done what was due before this frame came.
                    if !ahead {
                        drain(queue, m);
                    }
                    let played = gauges.frames.load(Relaxed) as f64 / total as f64;
                    match options.mapping_s {
                        Some(s) => work_until(m, s * played, &gauges),
                        None => {
                            let due = options.steps_due(gauges.frames.load(Relaxed), since_first);
                            let t_s = if ahead { played_s } else { start.elapsed().as_secs_f64() };
                            steps(m, due.saturating_sub(iterated), t_s, &gauges);
                            iterated = due;
                        }
                    }
                    if ahead {
                        drain(queue, m);
                    }
                }
                progress.show(&gauges);
            }
        }
    });
    if let Some(m) = &mut mapping {
        match options.mapping_s {
            Some(s) => work_until(m, s, &gauges),
            None => {
                for _ in 0..extra_iterations(&input, total, options) {
                    if ahead {
                        played_s += 1.0 / options.lockstep_iterations_per_s;
                    }
                    steps(m, 1, if ahead { played_s } else { start.elapsed().as_secs_f64() }, &gauges);
                    progress.show(&gauges);
                }
            }
        }
        let end_s = if ahead { played_s } else { start.elapsed().as_secs_f64() };
        m.sample(options.mapping_s.unwrap_or(end_s), &gauges);
    }
    let wall_s = start.elapsed().as_secs_f64();
    warnings.extend_from_slice(input.source.warnings());
    let source = input.source.counters();
    Played {
        tracking,
        mapping,
        counters,
        frames: total,
        keyframes: keyframes.count,
        wall_s,
        warnings,
        source,
        capture: None,
        broken: None,
    }
}

fn steps(m: &mut Mapping, n: u64, t_s: f64, gauges: &Gauges) {
    for _ in 0..n {
        m.step(Instant::now(), gauges);
    }
    m.sample_if_due(t_s, gauges);
}

/// Maps until `busy_s` seconds of it are done; what is left over by a map that has nothing to do stays for later frames.
fn work_until(m: &mut Mapping, busy_s: f64, gauges: &Gauges) {
    while m.busy_s < busy_s {
        let left = Duration::from_secs_f64(busy_s - m.busy_s).min(SLICE);
        if !m.step(Instant::now() + left, gauges) {
            break;
        }
        m.sample_if_due(m.busy_s, gauges);
    }
}

/// How far the input has been read.
struct Reading {
    next: usize,
    samples: usize,
}

/// Decodes frames into every slot but the last, or until the input ends, hands them over together, and answers
/// how many. Slots come back in order: the last is the one the front end still looks at. A frame that cannot be read
/// leaves its samples to the next.
fn read_batch(
    input: &mut Input,
    total: usize,
    reading: &mut Reading,
    slots: &mut Vec<Box<Slot>>,
    waiting: &ArrayQueue<Box<Slot>>,
    counters: &Counters,
) -> usize {
    let mut sent = 0;
    let writable = slots.len() - 1;
    for slot in &mut slots[..writable] {
        slot.imu.clear();
        let mut read = false;
        while reading.next < total && !read {
            let i = reading.next;
            reading.next += 1;
            // One sample past the frame, to interpolate at its stamp.
            let samples: &[ImuSample] = &input.imu[reading.samples..];
            let upto = samples.iter().position(|s| s.t >= input.stamps[i]).map_or(samples.len(), |at| at + 1);
            samples[..upto].iter().for_each(|s| slot.push_imu(*s, counters));
            reading.samples += upto;
            let frames = slot.writable().expect("it is not the last that came back");
            read = input.source.read(i, frames).is_ok();
            counters.frames_unreadable.add(u64::from(!read));
        }
        sent += usize::from(read);
    }
    for slot in slots.drain(..sent) {
        let _ = waiting.push(slot);
    }
    sent
}

/// Lockstep time past the end of the recording, in iterations at the recording's frame rate.
fn extra_iterations(input: &Input, total: usize, options: &Play) -> u64 {
    let length_s = input.length_s();
    match options.duration_s {
        Some(s) if s > length_s && total > 1 && length_s > 0.0 => {
            let frames = (s - length_s) * (total - 1) as f64 / length_s;
            options.steps_due(frames as u64, Span::from_secs(s - length_s))
        }
        _ => 0,
    }
}
