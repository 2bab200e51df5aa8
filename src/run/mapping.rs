//! The mapping side of a flight: keyframes in, a map and its error against run time out.

use super::status::Gauges;
use super::tracking::FramePacket;
use crate::config::Board;
use crate::counters::Counters;
use crate::gpu::GpuError;
use crate::map::{cameras, CurvePoint, Keyframe, Mapper, PoseCorrection, StepKind};
use crate::mem::{seal_thread, unsealed};
use crossbeam_queue::ArrayQueue;
use std::collections::VecDeque;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::Arc;
use std::time::{Duration, Instant};
use stipple_drivers::{host, Calibration, Fault, Frames, Image, Nanos, Pose};

/// Nice value of the threads that map: after the sensors, odometry and recording. What is not mapped in time comes later.
pub const NICE: i32 = 10;
/// Time handed to the mapper at once; between slices it looks at its queues.
pub const SLICE: Duration = Duration::from_millis(50);
/// Pause of a mapper with nothing to do.
const IDLE: Duration = Duration::from_micros(500);
/// Iterations whose time is kept for the median.
const ITERATION_TIMES: usize = 1 << 16;
/// Samples of error against run time.
const CURVE_POINTS: usize = 4096;

pub struct Mapping {
    pub mapper: Mapper,
    /// Where keyframes and corrections come from.
    pub queue: Arc<KeyframeQueue>,
    /// Keyframes taken from it, oldest first; corrections still reach them.
    waiting: VecDeque<Box<Keyframe>>,
    pub curve: Vec<CurvePoint>,
    pub iteration_ms: Vec<f32>,
    pub iterations: u64,
    /// Time spent in steps, s.
    pub busy_s: f64,
    pub anchors: u64,
    /// Why mapping stopped before the end, if it did; odometry goes on.
    pub failure: Option<String>,
    period_s: f64,
    next_curve_s: f64,
}

impl Mapping {
    /// Opens the device on a thread of low priority: the threads of a CPU device inherit it, so
    /// that odometry is served first.
    pub fn open(calibration: &Calibration, board: &Board) -> Result<Mapping, Fault> {
        let build = || {
            host::lower_priority(NICE);
            Mapper::open(calibration, board)
        };
        let mapper = super::apart("mapping", build)?;
        Ok(Mapping {
            mapper,
            queue: Arc::new(KeyframeQueue::new(calibration, board)),
            waiting: VecDeque::with_capacity(KEYFRAME_SLOTS),
            curve: Vec::with_capacity(CURVE_POINTS),
            iteration_ms: Vec::with_capacity(ITERATION_TIMES),
            iterations: 0,
            busy_s: 0.0,
            anchors: 0,
            failure: None,
            period_s: board.map.curve_period_s,
            next_curve_s: board.map.curve_period_s,
        })
    }

    /// Takes over the keyframes and corrections that came.
    pub fn collect(&mut self) {
        self.queue.collect(&mut self.waiting, |correction| self.mapper.correct(correction));
    }

    /// One slice of work: keyframes first, until one becomes an anchor, then training. At least one thing is done; answers
    /// false when there was nothing to do.
    pub fn step(&mut self, deadline: Instant, gauges: &Gauges) -> bool {
        if self.failure.is_some() {
            return false;
        }
        let start = Instant::now();
        let worked = match self.work(deadline) {
            Ok(worked) => worked,
            Err(e) => {
                self.fail(e);
                return false;
            }
        };
        self.busy_s += start.elapsed().as_secs_f64();
        gauges.anchors.store(self.anchors, Relaxed);
        gauges.iterations.store(self.iterations, Relaxed);
        gauges.splats.store(self.mapper.splat_count() as u64, Relaxed);
        worked
    }

    fn work(&mut self, deadline: Instant) -> Result<bool, GpuError> {
        while let Some(keyframe) = self.waiting.pop_front() {
            let kind = self.mapper.ingest(&keyframe);
            // As many places as slots: there is always room.
            let _ = self.queue.spare.push(keyframe);
            let anchor = matches!(kind?, StepKind::Anchor { .. });
            self.anchors += u64::from(anchor);
            if anchor || Instant::now() >= deadline {
                return Ok(true);
            }
        }
        let report = self.mapper.step(deadline)?;
        self.iterations += u64::from(report.iterations);
        if report.iterations > 0 && self.iteration_ms.len() < ITERATION_TIMES {
            self.iteration_ms.push((report.ms / f64::from(report.iterations)) as f32);
        }
        Ok(report.kind != StepKind::Idle)
    }

    /// Samples the curve when its period has passed; `t_s` is the run time so far.
    pub fn sample_if_due(&mut self, t_s: f64, gauges: &Gauges) {
        if t_s < self.next_curve_s {
            return;
        }
        self.next_curve_s = (t_s / self.period_s).floor() * self.period_s + self.period_s;
        self.sample(t_s, gauges);
    }

    pub fn sample(&mut self, t_s: f64, gauges: &Gauges) {
        if self.failure.is_some() || self.curve.len() == CURVE_POINTS {
            return;
        }
        match unsealed(|| self.mapper.sample(t_s)) {
            Ok(point) => {
                gauges.psnr_cdb.store((point.psnr_db.unwrap_or(0.0).max(0.0) * 100.0) as u64, Relaxed);
                self.curve.push(point);
            }
            Err(e) => self.fail(e),
        }
    }

    /// Ends mapping: a device that fails once is lost or hangs.
    fn fail(&mut self, e: GpuError) {
        self.mapper.counters().gpu_failures.add(1);
        self.failure = Some(unsealed(|| e.to_string()));
    }
}

/// Keyframes on their way to the mapper: a fixed number of pre-shaped boxes going round.
pub struct KeyframeQueue {
    spare: ArrayQueue<Box<Keyframe>>,
    offered: ArrayQueue<Box<Keyframe>>,
    corrections: ArrayQueue<PoseCorrection>,
    colours: usize,
}

/// Keyframes between tracking and the map: as many as come while one or two anchors are being made.
pub const KEYFRAME_SLOTS: usize = 12;

/// Pose corrections that wait: those of four windows.
const CORRECTION_SLOTS: usize = 64;

impl KeyframeQueue {
    /// Shaped for the images that the board's map wants of this rig.
    pub fn new(calibration: &Calibration, board: &Board) -> KeyframeQueue {
        let q = KeyframeQueue {
            spare: ArrayQueue::new(KEYFRAME_SLOTS),
            offered: ArrayQueue::new(KEYFRAME_SLOTS),
            corrections: ArrayQueue::new(CORRECTION_SLOTS),
            colours: cameras::colours(calibration.cameras.len(), &board.map),
        };
        for _ in 0..KEYFRAME_SLOTS {
            let shape = |i: usize| {
                let c = &calibration.cameras[i].camera;
                Image::new(c.width, c.height)
            };
            let colours = (0..q.colours).map(|i| std::array::from_fn(|_| shape(i))).collect();
            let images = (0..cameras::images(calibration.cameras.len(), &board.map)).map(shape).collect();
            let _ = q.spare.push(Box::new(Keyframe { images, colours, ..Keyframe::default() }));
        }
        q
    }

    /// Images of a keyframe that are wanted in colour.
    pub fn colours(&self) -> usize {
        self.colours
    }

    /// Copies a keyframe in; false when every slot is taken.
    pub fn offer(&self, frames: &Frames, fill: impl FnOnce(&mut Keyframe)) -> bool {
        let Some(mut slot) = self.spare.pop() else { return false };
        slot.t = frames.t;
        let colours = slot.colours.iter_mut().flatten().zip(frames.colours.iter().flatten());
        for (to, from) in slot.images.iter_mut().zip(&frames.images).chain(colours) {
            to.copy_from(from);
        }
        fill(&mut slot);
        // As many places as slots: there is always room.
        let _ = self.offered.push(slot);
        true
    }

    /// Appends the keyframes that came to `waiting`, which corrections still reach, and calls `correct` with these.
    fn collect(&self, waiting: &mut VecDeque<Box<Keyframe>>, mut correct: impl FnMut(&PoseCorrection)) {
        let mut offered = std::iter::from_fn(|| self.offered.pop());
        waiting.extend(&mut offered);
        while let Some(correction) = self.corrections.pop() {
            // Its keyframe was offered before.
            waiting.extend(&mut offered);
            for keyframe in waiting.iter_mut().filter(|k| k.id == correction.id) {
                keyframe.world_from_body = correction.world_from_body;
            }
            correct(&correction);
        }
    }
}

/// Newest keyframes, which the estimator may still move: more than a window holds.
const RECENT: usize = 32;

/// Numbers keyframes, chooses the held-out ones, and hands them to the mapper where there is one.
pub struct Keyframes {
    /// Every Nth keyframe is held out; 0: none.
    holdout: u32,
    /// Keyframes accepted by the mapper's queue; without a mapper, all.
    pub count: u64,
    /// Stamps and numbers of the newest.
    recent: VecDeque<(Nanos, u64)>,
}

impl Keyframes {
    pub fn new(holdout: u32) -> Keyframes {
        Keyframes { holdout, count: 0, recent: VecDeque::with_capacity(RECENT) }
    }

    fn fill(&mut self, slot: &mut Keyframe, world_from_body: Pose) {
        slot.id = self.count;
        slot.world_from_body = world_from_body;
        let n = u64::from(self.holdout);
        slot.held_out = n > 0 && self.count % n == n - 1;
        self.count += 1;
    }

    /// Hands a tracked frame on: a keyframe to the mapper, and the window's newer poses with it.
    pub fn pass_on(&mut self, packet: &FramePacket, queue: Option<&KeyframeQueue>, counters: &Counters) {
        let Some(tracked) = packet.tracked.as_ref().filter(|t| t.keyframe) else { return };
        let Some(queue) = queue else {
            self.count += 1;
            return;
        };
        if packet.blank {
            counters.keyframes_blank.add(1);
            return;
        }
        let id = self.count;
        if queue.offer(&packet.frames, |keyframe| self.fill(keyframe, tracked.world_from_body)) {
            self.recent.truncate(RECENT - 1);
            self.recent.push_front((packet.frames.t, id));
        } else {
            counters.keyframes_rejected.add(1);
        }
        for (t, world_from_body) in tracked.corrections.iter() {
            if let Some((_, id)) = self.recent.iter().find(|(at, found)| at == t && *found != id) {
                if queue.corrections.push(PoseCorrection { id: *id, world_from_body: *world_from_body }).is_err() {
                    counters.corrections_full.add(1);
                }
            }
        }
    }
}

/// Thread `mapping`: keyframes first, then single steps, until tracking has ended and `over` answers true; `over` is
/// given the seconds since `start`.
pub fn map(
    mut mapping: Mapping,
    gauges: &Gauges,
    start: Instant,
    tracked: impl Fn() -> bool,
    over: impl Fn(f64) -> bool,
) -> Mapping {
    host::lower_priority(NICE);
    seal_thread();
    loop {
        let tracked = tracked();
        mapping.collect();
        let worked = mapping.step(Instant::now() + SLICE, gauges);
        let t_s = start.elapsed().as_secs_f64();
        mapping.sample_if_due(t_s, gauges);
        gauges.broke.fetch_or(mapping.failure.is_some(), Relaxed);
        if tracked {
            // Nothing is played any more; the run's own time is what progresses.
            gauges.played_ms.fetch_max((t_s * 1e3) as u64, Relaxed);
            if over(t_s) || mapping.failure.is_some() {
                break;
            }
        }
        if !worked {
            std::thread::sleep(IDLE);
        }
    }
    unsealed(|| mapping.sample(start.elapsed().as_secs_f64(), gauges));
    mapping
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use stipple_drivers::{Camera, ImuCalibration, Lens, RigCamera};

    fn queue() -> KeyframeQueue {
        let lens = Lens::Radtan { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0 };
        let camera = Camera { width: 4, height: 3, fx: 4.0, fy: 4.0, cx: 2.0, cy: 1.0, lens };
        let cameras = vec![RigCamera::new(camera, Pose::IDENTITY); 2];
        let board = include_str!("../../board-configs/lavapipe.toml");
        let board = Board::parse("lavapipe.toml", board, &[]).expect("a board of ours");
        KeyframeQueue::new(&Calibration { cameras, imu: ImuCalibration::CONSUMER }, &board)
    }

    #[test]
    fn full_queue_rejects_newest_keeps_order_and_lets_corrections_reach_what_waits() {
        let (q, mut waiting, mut corrected) = (queue(), VecDeque::new(), vec![]);
        let frames = Frames { images: vec![Image::new(4, 3); 2], ..Frames::default() };
        let offer = |id: u64| q.offer(&frames, |k| k.id = id);
        assert!((0..KEYFRAME_SLOTS as u64).all(offer) && !offer(99));
        let correction = PoseCorrection { id: 2, world_from_body: Pose { p: DVec3::X, ..Pose::IDENTITY } };
        assert!(q.corrections.push(correction).is_ok());
        q.collect(&mut waiting, |c| corrected.push(c.id));
        assert_eq!(corrected, [2]);
        assert!(waiting.iter().enumerate().all(|(i, k)| k.id == i as u64));
        assert_eq!([1, 2].map(|i| waiting[i].world_from_body.p), [DVec3::ZERO, DVec3::X]);
    }
}
