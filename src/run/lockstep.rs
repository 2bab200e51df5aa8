//! The deterministic pace: no frame is dropped, and mapping gets a stated number of steps. For comparisons at equal
//! time mapping gets an equal part of a stated time a frame instead; then only tracking is deterministic.
//!
//! Frames are decoded a batch at a time into memory and tracked when the batch is there, so decoding is in no figure and
//! takes no core from tracking; reading a recording into memory whole would do the same, but a flight of minutes does not
//! fit. This thread decodes, then runs the mapper on the frames that tracking gives back, in their order, while tracking
//! goes on.

use super::gate::{FrameGate, ImuGate};
use super::keyframes::Keyframes;
use super::mapping::{Mapping, SLICE};
use super::sensors::Recorded;
use super::status::{Gauges, Status};
use super::tracking::{FramePacket, Inlet, Link, Tracker};
use super::waker::{SetOnDrop, Waker};
use super::worker::MapSide;
use super::{spawn_tracking, Flown, Options, Sinks, Steps};
use crate::counters::Counters;
use crate::publish::event::EventId;
use crossbeam_queue::ArrayQueue;
use std::cell::Cell;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::{Duration, Instant};
use stipple_drivers::source::ImuReading;
use stipple_drivers::{host, Calibration, ImuSample, Span};

/// Frames decoded at once: 24 MiB of two 752x480 cameras. What the threads of tracking lose at its ends is one stage of one
/// frame in so many.
const BATCH: usize = 32;
/// Packets in all: a batch, and the one before it, from which points are followed.
const PACKETS: usize = BATCH + 1;

/// Spends the mapping steps of a flight, or its seconds.
struct Budget {
    steps: Steps,
    /// Frames of the flight.
    total: usize,
    spent: u64,
    start: Instant,
}

impl Budget {
    /// Steps due after so many frames that span so much time.
    fn due(&self, frames: u64, since_first: Span) -> u64 {
        match self.steps {
            Steps::PerFrame(n) => frames * u64::from(n),
            Steps::PerSecond(rate) => (rate * since_first.secs().max(0.0)) as u64,
            Steps::EqualTime(_) => 0,
        }
    }

    /// Whether steps are due before a frame is seen: a device so slow has done them before it came.
    fn ahead(&self) -> bool {
        matches!(self.steps, Steps::PerSecond(_))
    }

    /// The run time that a curve shows: of the device that is played, or of this one.
    fn run_s(&self, played_s: f64) -> f64 {
        if self.ahead() {
            played_s
        } else {
            self.start.elapsed().as_secs_f64()
        }
    }

    /// Spends what is due after `frames` frames, the last `since_first` after the first.
    fn spend(&mut self, m: &mut Mapping, frames: u64, since_first: Span, gauges: &Gauges) {
        if let Steps::EqualTime(seconds) = self.steps {
            map_until(m, seconds * frames as f64 / self.total as f64, gauges);
            return;
        }
        let due = self.due(frames, since_first);
        for _ in 0..due.saturating_sub(self.spent) {
            m.step_due(gauges);
        }
        self.spent = due;
        m.sample_if_due(self.run_s(since_first.secs()), gauges);
    }

    /// Spends what is due past the end of a recording of `length_s`, until `duration_s`, at its frame rate.
    fn spend_rest(
        &self,
        m: &mut Mapping,
        length_s: f64,
        duration_s: Option<f64>,
        gauges: &Gauges,
        status: &mut Status,
    ) {
        let end_s = match (self.steps, duration_s) {
            (Steps::EqualTime(seconds), _) => {
                map_until(m, seconds, gauges);
                seconds
            }
            (_, Some(s)) if s > length_s && self.total > 1 && length_s > 0.0 => {
                let frames = (s - length_s) * (self.total - 1) as f64 / length_s;
                let (mut played_s, steps) = (length_s, self.due(frames as u64, Span::from_secs(s - length_s)));
                for _ in (0..steps).take_while(|_| !host::stop_asked_for().load(Relaxed)) {
                    played_s += (s - length_s) / steps as f64;
                    m.step_due(gauges);
                    m.sample_if_due(self.run_s(played_s), gauges);
                    status.show(gauges);
                }
                self.run_s(played_s)
            }
            _ => self.run_s(length_s),
        };
        m.sample(end_s, gauges);
    }
}

pub fn fly(
    recorded: Recorded,
    calibration: &Calibration,
    mut tracker: Tracker,
    (map, loops): Sinks,
    options: &Options,
    steps: Steps,
    status: &mut Status,
) -> Flown {
    let (counters, gauges) = (Counters::default(), Gauges::default());
    // Steps in lockstep are taken in this process.
    let mut mapping = if let Some(MapSide::Here(mapping)) = map { Some(mapping) } else { None };
    let ring = mapping.as_ref().map(|m| m.ring.clone());
    let colours = ring.as_ref().map_or(0, |r| r.colours());
    let mut keyframes = Keyframes::new(options.holdout, loops);
    let (total, length_s) = (recorded.stamps.len(), recorded.length_s());
    let mut packets: Vec<Box<FramePacket>> =
        (0..PACKETS.min(total + 1)).map(|_| FramePacket::for_rig(calibration, colours)).collect();
    let (waiting, done) = (ArrayQueue::new(PACKETS), ArrayQueue::new(PACKETS));
    let (over, ended) = (AtomicBool::new(false), AtomicBool::new(false));
    let (waker, link, stop) = (Waker::default(), Link::default(), host::stop_asked_for());
    let mut budget = Budget { steps, total, spent: 0, start: Instant::now() };
    let gates = (FrameGate::new(&packets[0].frames), ImuGate::new(&calibration.imu));
    let (mut notices, mut reading) = (vec![], Reading { recorded, gates, next: 0, samples: 0, aids: 0 });
    std::thread::scope(|scope| {
        let (taken, given, woken) = (&waiting, &done, &waker);
        let give = move |packet| {
            // As many places as packets.
            let _ = given.push(packet);
            woken.wake();
        };
        let inlet = Inlet { take: || taken.pop(), over: &over };
        spawn_tracking(scope, &link, &mut tracker, inlet, &counters, give, SetOnDrop(&ended, Some(woken)));
        let _over = SetOnDrop(&over, Some(&link.taker));
        while reading.next < total && !stop.load(Relaxed) {
            let mut sent = reading.batch(&mut packets, &waiting, &counters);
            link.taker.wake();
            while sent > 0 {
                let Some(packet) = waker.wait(&ended, || done.pop()) else { return };
                sent -= 1;
                keyframes.pass_on(&packet, ring.as_deref(), &counters);
                let closed = keyframes.loops.iter().flat_map(|l| l.queue.closed());
                closed.filter_map(|closed| gauges.set_closed(closed)).for_each(|(id, line)| status.say(id, &line));
                gauges.set_epoch(packet.epoch, packet.health);
                if let Some(line) = status.epoch_begun(&gauges) {
                    status.say(EventId::Epoch, &line);
                }
                gauges.set_found(&packet);
                for (id, line) in status.rig_judged(&gauges) {
                    status.say(id, &line);
                    notices.push((id, line));
                }
                let frames = gauges.frames.fetch_add(1, Relaxed) + 1;
                gauges.keyframes.store(keyframes.count, Relaxed);
                let since_first = packet.frames.t - reading.recorded.stamps[0];
                gauges.played_ms.store((since_first.secs() * 1e3) as u64, Relaxed);
                packets.push(packet);
                if let Some(m) = &mut mapping {
                    if !budget.ahead() {
                        m.collect();
                    }
                    budget.spend(m, frames, since_first, &gauges);
                    if budget.ahead() {
                        m.collect();
                    }
                }
                status.show(&gauges);
                status.log_counters(&counters, &gauges);
            }
        }
    });
    if let Some(m) = &mut mapping {
        budget.spend_rest(m, length_s, options.duration_s, &gauges, status);
    }
    Flown {
        tracker,
        map: mapping.map(MapSide::Here),
        counters,
        frames: reading.next,
        keyframes: keyframes.count,
        loops: keyframes.loops.and_then(|loops| loops.here),
        wall_s: budget.start.elapsed().as_secs_f64(),
        energy: None,
        warnings: reading.recorded.images.warnings().to_vec(),
        source: reading.recorded.images.counters(),
        capture: None,
        broken: None,
        notices,
    }
}

/// Maps until `busy_s` seconds of it are done; what a map with nothing to do leaves stays for later frames.
fn map_until(m: &mut Mapping, busy_s: f64, gauges: &Gauges) {
    while m.busy_s < busy_s {
        let left = Duration::from_secs_f64(busy_s - m.busy_s).min(SLICE);
        if !m.step(Instant::now() + left, gauges) {
            break;
        }
        m.sample_if_due(m.busy_s, gauges);
    }
}

/// A recording, and how far it has been read. It is read ahead: for the gates a sample arrives at its own stamp.
struct Reading {
    recorded: Recorded,
    gates: (FrameGate, ImuGate),
    next: usize,
    samples: usize,
    aids: usize,
}

impl Reading {
    /// Decodes frames into every packet but the one that the front end still reads, or until the recording ends, hands them over
    /// together, and answers how many. A frame that cannot be read or is refused leaves its samples to the next.
    fn batch(
        &mut self,
        packets: &mut Vec<Box<FramePacket>>,
        waiting: &ArrayQueue<Box<FramePacket>>,
        counters: &Counters,
    ) -> usize {
        let Recorded { images, stamps, imu, aids } = &mut self.recorded;
        let (frame_gate, imu_gate) = &mut self.gates;
        let mut sent = 0;
        let writable = packets.len() - 1;
        if let Some(held) = packets.iter_mut().position(|packet| packet.writable().is_none()) {
            packets[held..].rotate_left(1);
        }
        for packet in &mut packets[..writable] {
            packet.clear();
            let mut read = false;
            while self.next < stamps.len() && !read {
                let i = self.next;
                self.next += 1;
                // Up to one sample past the frame, to interpolate at its stamp.
                let past = Cell::new(false);
                let mut push = |sample: ImuSample| {
                    past.set(sample.t >= stamps[i]);
                    packet.push_imu(sample, counters);
                };
                while let (false, Some(&sample)) = (past.get(), imu.get(self.samples)) {
                    self.samples += 1;
                    let reading = ImuReading { sample, ..ImuReading::default() };
                    imu_gate.pass(&reading, sample.t, counters, &mut push);
                    if self.samples == imu.len() {
                        imu_gate.lose(&mut push);
                    }
                }
                while let Some(&reading) = aids.get(self.aids).filter(|a| a.t <= stamps[i]) {
                    self.aids += 1;
                    packet.push_aid(reading, counters);
                }
                let frames = packet.writable().expect("the front end reads one packet, the last here");
                read = images.read(i, frames).is_ok();
                counters.frames_unreadable.add(u64::from(!read));
                read = read && frame_gate.admit(frames, stamps[i], counters);
                packet.blank = frame_gate.blank;
            }
            sent += usize::from(read);
        }
        for packet in packets.drain(..sent) {
            let _ = waiting.push(packet);
        }
        sent
    }
}
