//! The mapping side of a flight, in a thread of it or in a process of its own: keyframes in, a map and its error against
//! run time out.

use super::keyframes::{KeyframeRing, Word};
use super::loop_closing::Join;
use super::seams::{ScoredLoop, Seams};
use super::status::{print_err, Gauges};
use super::threads;
use super::MAP_STORE;
use crate::config::Board;
use crate::gpu::GpuError;
use crate::map::{CurvePoint, Evaluation, Gaussian, Keyframe, Mapper, Place, PoseCorrection, StepKind};
use crate::mem::{self, seal_thread, unsealed};
use crate::output::export::{export, Form, Request};
use crate::output::metrics::percentile;
use crate::output::panel::{caption, panel, Picture};
use crate::output::report::{KernelTime, LeftOut};
use crate::output::trajectory::TumWriter;
use crate::output::{ply, OutputDir};
use crate::publish::cloud::{Point, POINTS};
use serde::{Deserialize, Serialize};
use std::sync::atomic::Ordering::Relaxed;
use std::sync::Arc;
use std::time::{Duration, Instant};
use stipple_drivers::{host, Calibration, Fault};

/// Nice value of the threads that map: after the sensors, odometry and recording. What is not mapped in time comes later.
pub const NICE: i32 = 10;
/// Time handed to the mapper at once; between slices it looks at its queues.
pub const SLICE: Duration = Duration::from_millis(50);
/// Pause of a mapper with nothing to do.
const IDLE: Duration = Duration::from_micros(500);
/// Longest rest that the governor asks for at once.
const REST_MAX: Duration = Duration::from_secs(2);
/// Iterations whose time is kept for the median.
const ITERATION_TIMES: usize = 1 << 16;
/// Samples of error against run time.
const CURVE_POINTS: usize = 4096;

/// How the map's store is used: `map::Place`.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Kept {
    pub fresh: bool,
    pub flight: i64,
}

pub struct Mapping {
    pub mapper: Mapper,
    /// Where keyframes and corrections come from.
    pub ring: Arc<KeyframeRing>,
    /// The keyframe in hand.
    keyframe: Keyframe,
    /// Keyframes with lower numbers may be taken.
    collected: u64,
    /// Joined epochs that were taken over.
    joined: usize,
    /// What closed loops do to the map.
    seams: Seams,
    pub curve: Vec<CurvePoint>,
    pub iteration_ms: Vec<f32>,
    pub iterations: u64,
    /// Time spent in steps, s; that of training steps, with densification and paging.
    pub busy_s: f64,
    training_s: f64,
    /// Steps that were due while the mapper rested, in lockstep, and the time that it rested otherwise, s.
    rested: u64,
    rested_s: f64,
    pub anchors: u64,
    /// Why mapping stopped before the end, if it did; odometry goes on.
    pub failure: Option<String>,
    /// Keyframes that are scored in the end: all in lockstep, where nobody waits.
    scored_max: usize,
    /// A step succeeded: the driver can live with its pipeline cache.
    has_worked: bool,
    period_s: f64,
    next_curve_s: f64,
}

impl Mapping {
    /// Opens the device on a thread of low priority: the threads of a CPU device inherit it, so
    /// that odometry is served first.
    pub fn open(
        calibration: &Calibration,
        board: &Board,
        ring: Arc<KeyframeRing>,
        place: Option<Place>,
    ) -> Result<Mapping, Fault> {
        let in_lockstep = place.is_some_and(|place| place.at_once);
        let build = || {
            host::lower_priority(NICE);
            Mapper::open_on(calibration, board, place)
        };
        let mapper = super::apart("mapping", build)?;
        if let Some(disk) = mapper.disk() {
            let (writes, reads) = (disk.clone(), disk);
            super::start("store-write", move || writes.write_loop());
            super::start("store-read", move || reads.read_loop());
        }
        let seams = Seams::new(&ring);
        Ok(Mapping {
            mapper,
            keyframe: ring.shape().clone(),
            ring,
            collected: 0,
            joined: 0,
            seams,
            curve: Vec::with_capacity(CURVE_POINTS),
            iteration_ms: Vec::with_capacity(ITERATION_TIMES),
            iterations: 0,
            busy_s: 0.0,
            training_s: 0.0,
            rested: 0,
            rested_s: 0.0,
            anchors: 0,
            failure: None,
            scored_max: if in_lockstep { usize::MAX } else { board.budget.keyframes as usize },
            has_worked: false,
            period_s: board.map.curve_period_s,
            next_curve_s: board.map.curve_period_s,
        })
    }

    /// Takes over the keyframes and corrections that came.
    pub fn collect(&mut self) {
        let (first, _) = self.mapper.first_numbers();
        let (written, now) = (self.ring.corrections_written(), self.keyframe.t);
        if self.failure.is_none() {
            let scored = unsealed(|| self.seams.score(&mut self.mapper, &self.ring, written, now));
            scored.unwrap_or_else(|e| self.fail(e));
        }
        self.ring.corrections(written, |c| self.mapper.correct(&PoseCorrection { id: first + c.id, ..*c }));
        for Join { flight, epoch, into } in self.ring.joins(self.joined) {
            self.mapper.join(flight, epoch, into);
            self.joined += 1;
        }
        self.collected = self.ring.offered();
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
        if worked && !std::mem::replace(&mut self.has_worked, true) {
            unsealed(|| {
                self.mapper.keep_pipelines().unwrap_or_else(|why| print_err(format_args!("stipple: note: {why}")))
            });
        }
        gauges.anchors.store(self.anchors, Relaxed);
        gauges.iterations.store(self.iterations, Relaxed);
        gauges.splats.store(self.mapper.splat_count() as u64, Relaxed);
        worked
    }

    /// One step that is due in lockstep.
    pub fn step_due(&mut self, gauges: &Gauges) {
        let rests = !self.step(Instant::now(), gauges) && self.failure.is_none() && self.mapper.is_trained_enough();
        self.rested += u64::from(rests);
    }

    fn work(&mut self, deadline: Instant) -> Result<bool, GpuError> {
        while let Some(slot) = self.ring.take(self.collected, &mut self.keyframe) {
            let (first, epoch) = self.mapper.first_numbers();
            (self.keyframe.id, self.keyframe.epoch) = (self.keyframe.id + first, self.keyframe.epoch + epoch);
            // A slot at which the device failed stays taken: the next mapper is not offered its keyframe.
            let anchor = matches!(self.mapper.ingest(&self.keyframe)?, StepKind::Anchor { .. });
            self.ring.done(slot);
            self.anchors += u64::from(anchor);
            if anchor || Instant::now() >= deadline {
                return Ok(true);
            }
        }
        let report = self.mapper.step(deadline)?;
        self.training_s += if report.iterations > 0 { 1e-3 * report.ms } else { 0.0 };
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

    /// How long to rest after work, by the share of its time that the governor leaves the mapper.
    fn rest(&self, worked: Duration) -> Duration {
        match self.ring.word(Word::Share).load(Relaxed) {
            share @ 1..1000 => worked.mul_f64(1000.0 / share as f64 - 1.0).min(REST_MAX),
            _ => Duration::ZERO,
        }
    }

    /// Puts the most important Gaussians where readers of the status socket find them, if one asks.
    fn show_points(&mut self) {
        let ring = self.ring.clone();
        let Some(cloud) = ring.cloud.as_ref().filter(|cloud| self.failure.is_none() && cloud.take_wish()) else {
            return;
        };
        let shown = unsealed(|| {
            let (epoch, mut splats) = self.mapper.newest_splats()?;
            let (exposure, of) = (self.mapper.median_exposure(), splats.len());
            if of > POINTS {
                splats.select_nth_unstable_by(POINTS, |a, b| b.importance().total_cmp(&a.importance()));
            }
            let byte = |v: f64| (v * 255.0).round().clamp(0.0, 255.0) as u8;
            let point = |s: &Gaussian| Point {
                p: s.mean,
                rgb: s.colour.map(|c| byte(exposure.observed(f64::from(c)))),
                opacity: byte(f64::from(s.opacity())),
            };
            cloud.write(self.keyframe.t, epoch, of, splats.iter().take(POINTS).map(point));
            Ok(())
        });
        if let Err(e) = shown {
            self.fail(e);
        }
    }

    /// Ends mapping: a device that fails once is lost or hangs.
    fn fail(&mut self, e: GpuError) {
        self.mapper.counters().gpu_failures.add(1);
        self.failure = Some(unsealed(|| e.to_string()));
    }
}

/// Keyframes drawn into DIR/renders.
const PANELS: usize = 12;

/// What mapping came to. Figures that could not be had are `None`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MapResult {
    pub anchors: u64,
    pub iterations: u64,
    pub iteration_ms_p50: Option<f64>,
    pub iteration_ms_p99: Option<f64>,
    pub splats: u64,
    pub gpu_bytes: u64,
    pub device: String,
    pub curve: Vec<CurvePoint>,
    pub kernels: Vec<KernelTime>,
    pub left_out: Vec<LeftOut>,
    pub counters: Vec<(String, u64)>,
    pub quality: Evaluation,
    pub seams: Vec<ScoredLoop>,
    /// Why the map is incomplete, where it is.
    pub failure: Option<String>,
    /// Figures of a process of its own; zero without one.
    pub heap_after_seal: u64,
    pub rss_peak_bytes: u64,
    #[serde(skip)]
    pub drawn: Vec<Drawn>,
}

/// A keyframe beside its rendering.
#[derive(Clone, Debug, PartialEq)]
pub struct Drawn {
    pub name: String,
    pub caption: String,
    pub picture: Picture,
}

impl Mapping {
    /// What the mapper did not do as nothing needed it.
    fn left_out(&self) -> Vec<LeftOut> {
        let steps = (self.iterations, self.training_s);
        let by_time = if self.training_s > 0.0 { self.rested_s * steps.0 as f64 / steps.1 } else { 0.0 };
        let (covered, away) = (self.mapper.counters().views_covered.get(), self.mapper.away());
        let shown = "Stereo depth of keyframes whose view the map shows";
        let rested = "Training steps after images had had their number";
        let on_disk = "Gaussians on disk at the end: neither drawn nor trained";
        vec![
            LeftOut::beside(shown, covered, self.mapper.matched()),
            LeftOut::beside(rested, self.rested + by_time as u64, steps),
            LeftOut { what: on_disk.into(), times: away, of: self.mapper.splat_count() as u64, saved_ms: None },
        ]
    }

    /// Writes `map.ply` and `keyframes.tum`, evaluates and draws, in this order, and calls `tell` with what there is after each,
    /// so that a process whose time is over has told the most important first.
    pub fn conclude(&mut self, out: &OutputDir, tell: &mut dyn FnMut(&MapResult)) -> MapResult {
        let ms: Vec<f64> = self.iteration_ms.iter().map(|v| f64::from(*v)).collect();
        let mut kernels = self.mapper.kernel_times();
        kernels.sort_by(|a, b| b.total_ms.total_cmp(&a.total_ms));
        let kernel =
            |k: crate::gpu::Timing| KernelTime { name: k.name.to_string(), dispatches: k.count, total_ms: k.total_ms };
        let mut result = MapResult {
            anchors: self.anchors,
            iterations: self.iterations,
            iteration_ms_p50: percentile(&ms, 0.5),
            iteration_ms_p99: percentile(&ms, 0.99),
            splats: self.mapper.splat_count() as u64,
            gpu_bytes: self.mapper.gpu_bytes(),
            device: self.mapper.device().to_string(),
            curve: self.curve.clone(),
            seams: self.seams.take(),
            kernels: kernels.into_iter().map(kernel).collect(),
            left_out: self.left_out(),
            heap_after_seal: mem::heap_after_seal(),
            ..MapResult::default()
        };
        if self.failure.is_none() {
            self.failure = self.measure(out, &mut result, tell).err();
        }
        result.failure = self.failure.clone();
        result.counters = self.mapper.counters().list().into_iter().map(|(name, n)| (name.to_string(), n)).collect();
        result.rss_peak_bytes = host::rss_peak_bytes().unwrap_or(0);
        tell(&result);
        result
    }

    /// Writes the Gaussians as viewers show them, in the exposure of most images, and the poses of keyframes; then figures, then
    /// pictures.
    fn measure(
        &mut self,
        out: &OutputDir,
        result: &mut MapResult,
        tell: &mut dyn FnMut(&MapResult),
    ) -> Result<(), String> {
        let gpu = |e: GpuError| e.to_string();
        let kept = self.mapper.save().map_err(gpu)?;
        let run = self.mapper.stored_run().filter(|_| self.mapper.splat_count() > 0);
        match (kept, run) {
            (Ok(true), Some(run)) => {
                let request = Request { run: Some(run), ..Request::default() };
                export(&out.file(MAP_STORE), &out.file("map.ply"), Form::Ply, &request).map_err(|e| e.to_string())?;
            }
            (kept, run) => {
                if run.is_some() {
                    let why = kept.err().map_or_else(|| "it is full".into(), |fault| fault.to_string());
                    let what = "map.ply has what is in memory alone, since the map's store has not all of it";
                    print_err(format_args!("stipple: warning: {what}: {why}"));
                }
                self.write_pool(out)?;
            }
        }
        tell(result);
        let posed = out.write("keyframes.tum", |w| {
            let mut file = TumWriter::begin(w)?;
            self.mapper.keyframe_poses().try_for_each(|(epoch, pose)| file.pose(epoch, &pose))
        });
        result.quality = self.mapper.evaluate_some(self.scored_max).map_err(gpu)?;
        tell(result);
        let panels = self.mapper.panels(PANELS).map_err(gpu)?;
        let draw = |p: &crate::map::Panel| Drawn { name: p.name.clone(), caption: caption(p), picture: panel(p) };
        result.drawn = panels.iter().map(draw).collect();
        posed.map_err(|fault| fault.to_string())
    }

    /// Writes the Gaussians in the pool as `map.ply`.
    fn write_pool(&mut self, out: &OutputDir) -> Result<(), String> {
        let mut splats = self.mapper.splats().map_err(|e| e.to_string())?;
        let exposure = self.mapper.median_exposure();
        for colour in splats.iter_mut().flat_map(|s| &mut s.colour) {
            *colour = exposure.observed(f64::from(*colour)) as f32;
        }
        out.write("map.ply", |w| ply::write_ply(w, splats.into_iter())).map_err(|fault| fault.to_string())
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
    let mut resumes = Instant::now();
    loop {
        let tracked = tracked();
        let now = Instant::now();
        let rests = now < resumes;
        let worked = !rests && {
            mapping.collect();
            let worked = mapping.step(now + SLICE, gauges);
            mapping.show_points();
            resumes = Instant::now() + mapping.rest(now.elapsed());
            worked
        };
        gauges.slices.fetch_add(1, Relaxed);
        threads::alive();
        let t_s = start.elapsed().as_secs_f64();
        mapping.sample_if_due(t_s, gauges);
        gauges.broke.fetch_or(mapping.failure.is_some(), Relaxed);
        if tracked && (over(t_s) || mapping.failure.is_some()) {
            break;
        }
        if rests {
            std::thread::sleep((resumes - now).min(SLICE));
        } else if !worked {
            let asleep = Instant::now();
            std::thread::sleep(IDLE);
            if mapping.failure.is_none() && mapping.mapper.is_trained_enough() {
                mapping.rested_s += asleep.elapsed().as_secs_f64();
            }
        }
    }
    unsealed(|| mapping.sample(start.elapsed().as_secs_f64(), gauges));
    mapping
}
