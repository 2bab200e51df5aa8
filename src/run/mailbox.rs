//! Where frames and samples wait for tracking, and the threads that put them there.
//!
//! Each thread waits for its source, has the gate judge what comes, and delivers: frames to a mailbox of one, where the
//! newest replaces the one that waits; samples to a queue. A source that is lost or silent is reported in one line when
//! it goes and one when it is back, counted, and asked again; nothing is restarted. A broken one ends the run.
//!
//! A frame is tracked when a sample at or past its stamp has come, or one hardly before it, or when none did within
//! `SAMPLE_WAIT`.

use super::carrier::Carrier;
use super::gate::{FrameGate, ImuGate, JUMP_MAX};
use super::status::{self, Gauges};
use super::threads;
use super::tracking::FramePacket;
use super::waker::Waker;
use crate::counters::{Counter, Counters};
use crate::limits::IMU_BETWEEN_FRAMES;
use crate::publish::event::{EventId, Notice};
use crossbeam_queue::ArrayQueue;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, Ordering::Relaxed};
use std::sync::OnceLock;
use std::time::{Duration, Instant};
use stipple_drivers::host::{monotonic, thread_cpu, CpuTime};
use stipple_drivers::source::{
    AidBatch, AidReading, AidSource, FrameSource, ImuBatch, ImuSource, SourceFault, Wait, AID_BATCH,
};
use stipple_drivers::{Calibration, Fault, ImuSample, Span};

/// Longest wait for a source: what ends a run or reports a loss is at most so late.
const PATIENCE: Span = Span(100_000_000);
/// Longest wait of a frame for a sample at its stamp: more than a FIFO of 10 samples at 200 Hz holds back.
const SAMPLE_WAIT: Duration = Duration::from_millis(100);
/// A sample that is older than its frame by no more than this is as good as one at it: held for so long, a rate that changes
/// by 10 rad/s² is 5 mrad/s off, and a wait for the next costs the pose 5 ms at 200 Hz.
const SAMPLE_EARLY: Span = Span(500_000);
/// A source that gives nothing for so long is silent: ten frames at 20 Hz.
const SILENT_AFTER: Duration = Duration::from_millis(500);
/// Least time between two reports of one sensor.
const REPORT_PERIOD: Duration = Duration::from_secs(1);
const POLL: Duration = Duration::from_micros(500);
/// Samples that wait: two seconds of a 1 kHz unit.
const IMU_SLOTS: usize = 2048;
/// Samples that go without a frame: half of what fits before one, a second and a quarter at 200 Hz.
const SAMPLES_ALONE: usize = IMU_BETWEEN_FRAMES / 2;
const NOTICES: usize = 8;

/// Where frames and samples wait for tracking. Packets go round: spare -> newest -> tracking -> spare.
pub struct Mailbox {
    pub spare: ArrayQueue<Box<FramePacket>>,
    newest: ArrayQueue<Box<FramePacket>>,
    imu: ArrayQueue<ImuSample>,
    aids: ArrayQueue<AidReading>,
    /// Stamp of the newest sample, ns.
    imu_until: AtomicI64,
    /// The unit is lost, silent, or its recording over: nobody waits for it.
    imu_away: AtomicBool,
    /// Frames that arrived.
    pub arrived: AtomicU64,
    /// Cost of reading the cameras, known when the thread `camera` has ended.
    pub capture: OnceLock<Capture>,
    /// Asks the threads to end.
    pub stop: AtomicBool,
    /// Lines to be printed.
    pub notices: ArrayQueue<Notice>,
    /// What ended the run.
    pub broken: ArrayQueue<Fault>,
}

impl Mailbox {
    pub fn new(packets: usize, calibration: &Calibration, colours: usize) -> Mailbox {
        let mailbox = Mailbox {
            spare: ArrayQueue::new(packets),
            newest: ArrayQueue::new(1),
            imu: ArrayQueue::new(IMU_SLOTS),
            aids: ArrayQueue::new(AID_BATCH),
            imu_until: AtomicI64::new(i64::MIN),
            imu_away: AtomicBool::new(false),
            arrived: AtomicU64::new(0),
            capture: OnceLock::new(),
            stop: AtomicBool::new(false),
            notices: ArrayQueue::new(NOTICES),
            broken: ArrayQueue::new(2),
        };
        for _ in 0..packets {
            let _ = mailbox.spare.push(FramePacket::for_rig(calibration, colours));
        }
        mailbox
    }

    /// The frame to track next with the samples up to the first at or past it, or `None` while one of them is to
    /// come; `held` is the frame that waits.
    pub fn take(&self, held: &mut Option<Held>, over: &AtomicBool, counters: &Counters) -> Option<Box<FramePacket>> {
        if held.is_none() {
            let Some(mut packet) = self.newest.pop() else { return self.take_samples(counters) };
            packet.clear();
            packet.imu_only = false;
            *held = Some(Held { packet, since: Instant::now() });
        }
        let Held { packet, since } = held.as_mut().expect("filled above");
        // Read first, so that what was queued before it was set is still taken.
        let away = self.imu_away.load(Relaxed) || over.load(Relaxed);
        let mut reached = false;
        while let Some(sample) = self.imu.pop() {
            packet.push_imu(sample, counters);
            // Samples so far ahead are of the clock before.
            reached = (Span(-SAMPLE_EARLY.0)..=JUMP_MAX).contains(&(sample.t - packet.frames.t));
            if reached {
                break;
            }
        }
        if !reached && !away && since.elapsed() < SAMPLE_WAIT {
            return None;
        }
        counters.frames_without_imu.add(u64::from(!reached));
        // Nobody waits for these: a later frame brings what comes late.
        while let Some(reading) = self.aids.pop() {
            packet.push_aid(reading, counters);
        }
        held.take().map(|h| h.packet)
    }

    /// Without a frame: samples alone, once there are as many as one packet takes well. Inertia carries the estimate over the
    /// gap, and each that is missing costs metres.
    fn take_samples(&self, counters: &Counters) -> Option<Box<FramePacket>> {
        if self.imu.len() < SAMPLES_ALONE {
            return None;
        }
        let mut packet = self.spare.pop()?;
        packet.clear();
        packet.imu_only = true;
        for _ in 0..SAMPLES_ALONE {
            self.imu.pop().into_iter().for_each(|sample| packet.push_imu(sample, counters));
        }
        Some(packet)
    }

    /// A spare packet to read a frame into: not the one the front end still looks at.
    fn writable(&self) -> Option<Box<FramePacket>> {
        for _ in 0..self.spare.len() {
            let mut packet = self.spare.pop()?;
            if packet.writable().is_some() {
                return Some(packet);
            }
            let _ = self.spare.push(packet);
        }
        None
    }
}

/// What the thread `camera` took to read frames: waiting in the kernel, copying, decoding, and looking whether they are
/// believed. What the kernel does in interrupts and in threads of its own is not in it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Capture {
    pub frames: u64,
    /// Size of the images of one frame.
    pub frame_bytes: usize,
    pub cpu: CpuTime,
}

impl Capture {
    /// CPU time a frame, ms: all of it, and the kernel's part.
    pub fn ms_a_frame(&self) -> Option<(f64, f64)> {
        let ms = |s: f64| 1e3 * s / self.frames as f64;
        (self.frames > 0).then(|| (ms(self.cpu.total_s()), ms(self.cpu.kernel_s)))
    }

    /// How often each byte was copied on its way from the kernel's buffer, where the source counts that.
    pub fn copies(&self, source: &[(&'static str, u64)]) -> Option<f64> {
        let copied = source.iter().find(|(name, n)| *name == "camera_bytes_copied" && *n > 0)?.1;
        let bytes = self.frames as f64 * self.frame_bytes as f64;
        (bytes > 0.0).then(|| copied as f64 / bytes)
    }

    /// For a person to read.
    pub fn line(&self, source: &[(&'static str, u64)]) -> Option<String> {
        let (ms, kernel) = self.ms_a_frame()?;
        let copies = self.copies(source).map_or(String::new(), |n| format!(", {n:.2} copies of each byte"));
        Some(format!("{ms:.2} ms of CPU a frame to read it, {kernel:.2} of them in the kernel{copies}"))
    }
}

/// Says at the end of its thread what that took.
struct Metered<'a>(&'a Mailbox, CpuTime, usize);

impl Drop for Metered<'_> {
    fn drop(&mut self) {
        let Metered(mailbox, from, frame_bytes) = self;
        let (frames, cpu) = (mailbox.arrived.load(Relaxed), thread_cpu() - *from);
        let _ = mailbox.capture.set(Capture { frames, frame_bytes: *frame_bytes, cpu });
    }
}

/// A frame that waits for its samples.
pub struct Held {
    packet: Box<FramePacket>,
    since: Instant,
}

/// Whether a sensor answers, and what is said of it.
#[derive(Clone, Copy)]
struct Liveness<'a> {
    name: &'static str,
    heard: Instant,
    away: bool,
    lost: &'a Counter,
    silent: &'a Counter,
    away_ms: &'a Counter,
    notices: &'a ArrayQueue<Notice>,
    said: Option<Instant>,
    /// The last loss was said, so its end is, too.
    told: bool,
}

impl<'a> Liveness<'a> {
    /// A sensor that answers, and where its losses, silences and time away are counted.
    fn new(name: &'static str, counted: [&'a Counter; 3], notices: &'a ArrayQueue<Notice>) -> Liveness<'a> {
        let [lost, silent, away_ms] = counted;
        Liveness { name, heard: Instant::now(), away: false, lost, silent, away_ms, notices, said: None, told: false }
    }

    fn lose(&mut self, counter: &Counter, id: EventId, what: impl FnOnce() -> String) {
        self.away = true;
        counter.add(1);
        self.told = self.said.is_none_or(|t| t.elapsed() >= REPORT_PERIOD);
        if self.told {
            self.said = Some(Instant::now());
            status::count_lost(self.notices.push((id, format!("{} {}", self.name, what()))));
        }
    }

    /// What `next` answered, but for `Broken`; whether the sensor is away.
    fn update(&mut self, answer: &Result<Wait, SourceFault>) -> bool {
        match answer {
            Ok(Wait::Got) => {
                let gone = self.heard.elapsed();
                self.heard = Instant::now();
                if std::mem::take(&mut self.away) {
                    self.away_ms.add(gone.as_millis() as u64);
                    if self.told {
                        let line = format!("{} is back after {:.1} s", self.name, gone.as_secs_f64());
                        status::count_lost(self.notices.push((EventId::SensorBack, line)));
                    }
                }
            }
            Err(SourceFault::Lost(fault)) if !self.away => {
                self.lose(self.lost, EventId::SensorLost, || format!("lost: {fault}"))
            }
            Ok(Wait::TimedOut) if !self.away && self.heard.elapsed() >= SILENT_AFTER => {
                self.lose(self.silent, EventId::SensorSilent, || {
                    format!("is silent for {:.1} s", SILENT_AFTER.as_secs_f64())
                });
            }
            _ => {}
        }
        self.away
    }
}

/// Thread `camera`. Ends with its source, or when asked.
pub fn camera(mailbox: &Mailbox, source: &mut dyn FrameSource, tracking: &Waker, c: &Counters, gauges: &Gauges) {
    let Some(mut packet) = mailbox.writable() else { return };
    let mut gate = FrameGate::new(&packet.frames);
    let _metered = Metered(mailbox, thread_cpu(), packet.frames.images.iter().map(|i| i.pixels.len()).sum());
    let counted = [&c.camera_lost, &c.camera_silent, &c.camera_away_ms];
    let mut liveness = Liveness::new("camera", counted, &mailbox.notices);
    let mut eye = Liveness { name: "one camera", lost: &c.one_camera_lost, away_ms: &c.one_camera_away_ms, ..liveness };
    let mut span = None;
    while !mailbox.stop.load(Relaxed) {
        threads::alive();
        let frames = packet.writable().expect("it was taken as such, and nobody else has it");
        let answer = source.next(PATIENCE, frames);
        if liveness.update(&answer) && answer.is_err() {
            gate.stamps.forget();
        }
        if answer == Ok(Wait::Got) {
            eye.update(&source.away().map_or(Ok(Wait::Got), |fault| Err(SourceFault::Lost(fault.clone()))));
        }
        match answer {
            Ok(Wait::Got) => {}
            Ok(Wait::TimedOut) | Err(SourceFault::Lost(_)) => continue,
            Ok(Wait::Ended) => break,
            Err(SourceFault::Broken(fault)) => {
                let _ = mailbox.broken.push(fault);
                break;
            }
        }
        mailbox.arrived.fetch_add(1, Relaxed);
        if !gate.admit(frames, monotonic(), c) {
            continue;
        }
        packet.blank = gate.blank;
        let t = packet.frames.t;
        let (first, _) = *span.get_or_insert((t, t));
        span = Some((first, t));
        gauges.played_ms.store(((t - first).secs() * 1e3).max(0.0) as u64, Relaxed);
        let replaced = mailbox.newest.force_push(packet);
        c.frames_overwritten.add(u64::from(replaced.is_some()));
        tracking.wake();
        packet = match replaced.or_else(|| mailbox.writable()) {
            Some(packet) => packet,
            // FramePackets are as many as frames can be under way; one is about to come back.
            None => loop {
                std::thread::sleep(POLL);
                if let Some(packet) = mailbox.writable() {
                    break packet;
                }
            },
        };
    }
    let Some((_, last)) = span else { return };
    let limit = Instant::now() + SAMPLE_WAIT;
    let reached = || mailbox.imu_until.load(Relaxed) >= last.0 || mailbox.imu_away.load(Relaxed);
    while !reached() && Instant::now() < limit {
        std::thread::sleep(POLL);
    }
}

/// Thread `imu`. Ends with its source or with the cameras.
pub fn inertial(
    mailbox: &Mailbox,
    source: &mut dyn ImuSource,
    (mut gate, mut carrier): (ImuGate, Option<Carrier>),
    tracking: &Waker,
    over: &AtomicBool,
    c: &Counters,
) {
    let mut batch = ImuBatch::default();
    // Never refused: while no frame comes the oldest make room.
    let mut queue = |sample: ImuSample| {
        c.imu_overflow.add(u64::from(mailbox.imu.force_push(sample).is_some()));
        mailbox.imu_until.store(sample.t.0, Relaxed);
        carrier.iter_mut().for_each(|carrier| carrier.on_imu(sample));
    };
    let counted = [&c.imu_lost, &c.imu_silent, &c.imu_away_ms];
    let mut liveness = Liveness::new("inertial unit", counted, &mailbox.notices);
    while !over.load(Relaxed) {
        threads::alive();
        let answer = source.next(PATIENCE, &mut batch);
        let away = liveness.update(&answer);
        mailbox.imu_away.store(away, Relaxed);
        match answer {
            Ok(Wait::Got) => {}
            Ok(Wait::TimedOut) => continue,
            Err(SourceFault::Lost(_)) => {
                gate.lose(&mut queue);
                continue;
            }
            Ok(Wait::Ended) => break,
            Err(SourceFault::Broken(fault)) => {
                let _ = mailbox.broken.push(fault);
                mailbox.stop.store(true, Relaxed);
                break;
            }
        }
        let now = monotonic();
        batch.iter().for_each(|reading| gate.pass(reading, now, c, &mut queue));
        tracking.wake();
    }
    gate.lose(&mut queue);
    mailbox.imu_away.store(true, Relaxed);
}

/// Thread `barometer`. Ends with its source or with the cameras; a run goes on without it.
pub fn aids(mailbox: &Mailbox, source: &mut dyn AidSource, over: &AtomicBool, c: &Counters) {
    let mut batch = AidBatch::default();
    let mut liveness = Liveness::new("barometer", [&c.aid_lost, &c.aid_silent, &c.aid_away_ms], &mailbox.notices);
    while !over.load(Relaxed) {
        threads::alive();
        let answer = source.next(PATIENCE, &mut batch);
        liveness.update(&answer);
        match answer {
            Ok(Wait::Got) => {}
            Ok(Wait::TimedOut) | Err(SourceFault::Lost(_)) => continue,
            Ok(Wait::Ended) => break,
            Err(broken) => {
                liveness.lose(&c.aid_lost, EventId::SensorLost, || format!("is {broken}"));
                break;
            }
        }
        for reading in batch.iter() {
            c.aid_overflow.add(u64::from(mailbox.aids.force_push(*reading).is_some()));
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::sync::{Arc, Mutex};
    use stipple_drivers::sim::euroc_rig;
    use stipple_drivers::types::{Image, Nanos};
    use stipple_drivers::Frames;

    /// A camera that says where it wrote the images of its last frame, and gives one at a time.
    struct Writes<'a>(&'a Mutex<Vec<usize>>, i64);

    fn places(images: &[Image]) -> Vec<usize> {
        images.iter().map(|i| i.pixels.as_ptr() as usize).collect()
    }

    impl FrameSource for Writes<'_> {
        fn next(&mut self, _: Span, frames: &mut Frames) -> Result<Wait, SourceFault> {
            if self.1 == 3 {
                return Ok(Wait::Ended);
            }
            self.1 += 1;
            frames.t = Nanos(self.1 * 50_000_000);
            frames.images.iter_mut().for_each(|i| i.pixels[..99].fill(self.1 as u8 * 40));
            *self.0.lock().unwrap() = places(&frames.images);
            Ok(Wait::Got)
        }

        fn counters(&self) -> Vec<(&'static str, u64)> {
            vec![("camera_bytes_copied", 3 * 2 * 752 * 480)]
        }
    }

    #[test]
    fn the_tracker_gets_the_image_where_the_camera_wrote_it() {
        let (mailbox, written) = (Mailbox::new(4, &euroc_rig(), 0), Mutex::new(vec![]));
        let (bell, counters, gauges) = (Waker::default(), Counters::default(), Gauges::default());
        mailbox.imu_away.store(true, Relaxed);
        let mut source = Writes(&written, 0);
        camera(&mailbox, &mut source, &bell, &counters, &gauges);
        let packet = mailbox.take(&mut None, &AtomicBool::new(true), &counters).unwrap();
        assert_eq!((packet.frames.t, counters.frames_overwritten.get()), (Nanos(150_000_000), 2));
        assert_eq!(places(&packet.frames.images), *written.lock().unwrap(), "handed on, not copied");
        let capture = mailbox.capture.get().unwrap();
        assert_eq!((capture.frames, capture.frame_bytes), (3, 2 * 752 * 480));
        assert_eq!(capture.copies(&source.counters()), Some(1.0));
        assert!(capture.ms_a_frame().is_some_and(|(all, kernel)| all >= kernel && kernel >= 0.0));
    }

    #[test]
    fn a_packet_the_front_end_looks_at_is_not_written_into() {
        let mailbox = Mailbox::new(3, &euroc_rig(), 0);
        let looked_at = mailbox.spare.pop().unwrap();
        let front_end = looked_at.frames.clone();
        let _ = mailbox.spare.push(looked_at);
        let taken = [mailbox.writable(), mailbox.writable()].map(Option::unwrap);
        assert!(taken.iter().all(|packet| !Arc::ptr_eq(&packet.frames, &front_end)));
        assert!(mailbox.writable().is_none(), "it has to wait");
        drop(front_end);
        assert!(mailbox.writable().is_some());
    }

    /// Frames of EuRoC are 0.2 µs past a sample.
    #[test]
    fn frame_waits_for_a_sample_unless_one_is_hardly_older() {
        for (older_us, is_taken) in [(0, true), (1, true), (500, true), (501, false)] {
            let mailbox = Mailbox::new(4, &euroc_rig(), 0);
            let mut packet = mailbox.writable().unwrap();
            packet.writable().unwrap().t = Nanos(50_000_000);
            let _ = mailbox.newest.push(packet);
            mailbox.imu.force_push(ImuSample { t: Nanos(50_000_000 - older_us * 1000), ..ImuSample::default() });
            let taken = mailbox.take(&mut None, &AtomicBool::new(false), &Counters::default());
            assert_eq!(taken.is_some(), is_taken, "{older_us} us");
        }
    }

    #[test]
    fn while_no_frame_comes_samples_reach_the_estimator_all_the_same() {
        let (mailbox, counters, over) = (Mailbox::new(4, &euroc_rig(), 0), Counters::default(), AtomicBool::new(false));
        let mut taken = vec![];
        for i in 0..3 * IMU_BETWEEN_FRAMES as i64 {
            mailbox.imu.force_push(ImuSample { t: Nanos(i), ..ImuSample::default() });
            if let Some(packet) = mailbox.take(&mut None, &over, &counters) {
                assert!(packet.imu_only);
                taken.extend(packet.imu.iter().map(|s| s.t.0));
                let _ = mailbox.spare.push(packet);
            }
        }
        assert_eq!(taken, (0..3 * IMU_BETWEEN_FRAMES as i64).collect::<Vec<_>>());
        assert_eq!(counters.imu_overflow.get(), 0);
    }

    #[test]
    fn samples_of_the_clock_before_are_not_those_a_frame_waits_for() {
        let (mailbox, counters, over) = (Mailbox::new(4, &euroc_rig(), 0), Counters::default(), AtomicBool::new(false));
        let mut packet = mailbox.spare.pop().unwrap();
        packet.writable().unwrap().t = Nanos(5_000_000_000);
        let _ = mailbox.newest.push(packet);
        let stamps = [15_000, 15_005, 4_995, 5_000, 5_005].map(|ms| Nanos(ms * 1_000_000));
        for t in stamps {
            mailbox.imu.force_push(ImuSample { t, ..ImuSample::default() });
        }
        let packet = mailbox.take(&mut None, &over, &counters).unwrap();
        assert!(packet.imu.iter().map(|s| s.t).eq(stamps[..4].iter().copied()));
    }
}
