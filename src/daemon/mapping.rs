//! The mapping side of a run: keyframes in, a map and its error against run time out.

use super::progress::Gauges;
use crate::config::Board;
use crate::gpu::GpuError;
use crate::map::{CurvePoint, Did, Keyframe, Mapper, PoseCorrection};
use crate::mem::unsealed;
use crossbeam_queue::ArrayQueue;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};
use stipple_drivers::{host, Calibration, Fault, Frames, Image};

/// Time handed to the mapper at once; between slices it looks at its queues.
pub const SLICE: Duration = Duration::from_millis(50);
/// Iterations whose time is kept for the median.
const ITERATION_TIMES: usize = 1 << 16;
/// Samples of error against run time.
const CURVE_POINTS: usize = 4096;

pub struct Mapping {
    pub mapper: Mapper,
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
            host::lower_priority(host::Waits::Mapping);
            Mapper::open(calibration, board)
        };
        let mapper = std::thread::scope(|s| s.spawn(build).join().expect("boot faults are values, not panics"))?;
        Ok(Mapping {
            mapper,
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

    /// For the keyframes that the mapper wants.
    pub fn queue(&self, calibration: &Calibration) -> KeyframeQueue {
        KeyframeQueue::new(calibration, self.mapper.images(), self.mapper.colours_offered())
    }

    /// One slice of work. Answers false when there was nothing to do.
    pub fn step(&mut self, deadline: Instant, gauges: &Gauges) -> bool {
        if self.failure.is_some() {
            return false;
        }
        let report = match self.mapper.step(deadline) {
            Ok(report) => report,
            Err(e) => {
                self.fail(e);
                return false;
            }
        };
        self.iterations += u64::from(report.iterations);
        self.busy_s += report.ms * 1e-3;
        if report.iterations > 0 && self.iteration_ms.len() < ITERATION_TIMES {
            self.iteration_ms.push((report.ms / f64::from(report.iterations)) as f32);
        }
        self.anchors += u64::from(matches!(report.did, Did::Anchor { .. }));
        gauges.anchors.store(self.anchors, Relaxed);
        gauges.iterations.store(self.iterations, Relaxed);
        gauges.splats.store(self.mapper.splat_count() as u64, Relaxed);
        !matches!(report.did, Did::Idle)
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
    pub corrections: ArrayQueue<PoseCorrection>,
}

/// Keyframes between tracking and the mapper's own queue: what comes while an anchor is being made.
pub const KEYFRAME_SLOTS: usize = 8;

/// Four windows of poses.
const CORRECTION_SLOTS: usize = 64;

impl KeyframeQueue {
    /// For keyframes of so many images, the first `colours` of them in colour.
    pub fn new(calibration: &Calibration, images: usize, colours: usize) -> KeyframeQueue {
        let q = KeyframeQueue {
            spare: ArrayQueue::new(KEYFRAME_SLOTS),
            offered: ArrayQueue::new(KEYFRAME_SLOTS),
            corrections: ArrayQueue::new(CORRECTION_SLOTS),
        };
        for _ in 0..KEYFRAME_SLOTS {
            let shape = |i: usize| {
                let c = &calibration.cameras[i].camera;
                Image::new(c.width, c.height)
            };
            let colours = (0..colours).map(|i| std::array::from_fn(|_| shape(i))).collect();
            let images = (0..images).map(shape).collect();
            let _ = q.spare.push(Box::new(Keyframe { images, colours, ..Keyframe::default() }));
        }
        q
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

    /// Lends the oldest keyframe out and takes its slot back; `None` when there is none.
    pub fn take<R>(&self, lend: impl FnOnce(&Keyframe) -> R) -> Option<R> {
        let slot = self.offered.pop()?;
        let r = lend(&slot);
        let _ = self.spare.push(slot);
        Some(r)
    }
}
