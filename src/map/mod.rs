//! The mapper: keyframes in, a map of Gaussians out, a bounded amount of work at a time.
//!
//! `ingest` stores a keyframe. One whose view the map does not cover becomes an anchor: stereo depth, seeds, then a burst
//! of training steps on it (`anchors`). `step` trains, otherwise, on the keyframe of a few drawn at random that was trained
//! on the longest ago: the map sees its past as often as its present, so it does not forget (`trainer`). Held-out keyframes are
//! stored, never trained on, never anchors. Read `pipeline` for what a training step does on the GPU.

pub mod anchors;
pub mod archive;
pub mod backward;
pub mod block;
pub mod cameras;
mod choice;
mod coarseness;
pub mod coverage;
mod densify;
mod depth_fill;
mod diffusion;
mod evaluate;
pub mod exposure;
mod filing;
pub mod horizon;
mod keyframes;
mod latest;
pub mod lists;
pub mod loss;
pub mod occupancy;
pub mod paging;
pub mod parts;
pub mod pipeline;
pub mod pool;
pub mod refine;
pub mod render;
mod residency;
mod rotation;
mod runs;
mod saving;
pub mod scan;
mod scene;
pub mod schedule;
mod seam;
mod seeds;
mod seen;
pub mod shape;
mod sight;
pub mod ssim;
pub mod step;
pub mod tiling;
mod trainer;
pub mod view;
mod views;

use crate::config::{Board, MapConfig, Projection};
use crate::counters::Counters;
use crate::gpu::{cache_folder, Arena, DeviceKind, Gpu, GpuError, Timing};
use crate::mem::Footprint;
use crate::stereo::{self, Stereo};
use anchors::{Anchors, Workspace};
use archive::Archive;
use cameras::RectifiedPair;
use scene::Scene;
use std::time::Instant;
use stipple_drivers::{Calibration, Fault, Nanos, Pose, TimedPose};
use trainer::Trainer;
use views::Views;

pub use archive::Place;
pub use evaluate::{spread, CurvePoint, Evaluation, Panel};
pub use exposure::Exposure;
pub use keyframes::{Keyframe, PoseCorrection};
pub use pipeline::Pipeline;
pub use pool::Gaussian;
pub use render::Rendered;
pub use seam::{Seam, SeamScore, SeamScores};
pub use shape::Shape;

#[cfg(feature = "instruments")]
pub use {
    coarseness::Coarseness,
    evaluate::KeyframeScore,
    pool::PruneRule,
    step::{LearningRates, StepStats, Target, Weights},
    tiling::Tiling,
    view::{Fisheye, View},
    views::Stored,
};

/// What the mapper did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum StepKind {
    /// There was nothing to do.
    #[default]
    Idle,
    /// A keyframe was stored.
    Stored,
    /// A keyframe was dropped: the store is full.
    Dropped,
    /// A keyframe became an anchor.
    Anchor { seeded: u32 },
    /// Training steps of the newest anchor's burst.
    Burst,
    /// Training steps on keyframes drawn at random.
    Train,
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepReport {
    pub kind: StepKind,
    pub ms: f64,
    /// Training steps taken.
    pub iterations: u32,
    /// The loss of the last training step that has ended.
    pub loss: f64,
}

/// Commands are timed one by one in one recording of so many: each timestamp drains the device.
const TIMED_IN: u64 = 32;

pub struct Mapper {
    scene: Scene,
    stereo: Stereo,
    anchors: Anchors,
    trainer: Trainer,
    /// What of the map is on disk; none keeps all of it in memory.
    archive: Option<Archive>,
    /// Why there is no archive though there is a place for it.
    pub unkept: Option<Fault>,
    /// Corrections move Gaussians when they exceed this, m and rad.
    move_tolerance: f64,
    /// Corrections came since anchors were last put in place.
    corrected: bool,
}

impl Mapper {
    /// What `open` takes: its host parts, and every buffer on the GPU.
    pub fn footprint(calibration: &Calibration, board: &Board) -> Result<Footprint, Fault> {
        let mut f = Footprint::default();
        let views = Stereo::footprint(calibration, &board.stereo, board.map.scale, &mut f)?;
        let shape = shape(calibration, board);
        let (w, h, channels) = (shape.width as usize, shape.height as usize, shape.channels as usize);
        let known = known(board, &shape);
        f.build("map: keyframes", || Views::new(&shape, known));
        if board.store.enabled {
            Archive::footprint(board, &shape, &mut f);
        }
        let cameras = f.build("map: cameras", || cameras::training(&views, &board.map))?;
        f.build("map: rectified view of a fisheye", || RectifiedPair::new(&views, &cameras[0], channels));
        f.build("map: rendering", || Rendered::new(w, h, channels));
        f.build("map: depth, seeds and densification", || Workspace::new(w, h, channels, &board.map));
        f.build("map: transfers", || {
            (
                pool::Transfers::new(&shape),
                Vec::<u32>::with_capacity(shape.image_words()),
                Vec::<u8>::with_capacity(shape.halved_pixels()),
            )
        });
        f.extend(buffers(calibration, board)?.footprint());
        Ok(f)
    }

    /// Opens the board's device with all the memory it will take, and keeps the whole map in it.
    #[cfg(feature = "instruments")]
    pub fn open(calibration: &Calibration, board: &Board) -> Result<Mapper, Fault> {
        Mapper::open_on(calibration, board, None)
    }

    /// Opens the board's device with all the memory it will take. The map is kept on disk where there is a place for it that can
    /// be used (`unkept`).
    pub fn open_on(calibration: &Calibration, board: &Board, place: Option<Place>) -> Result<Mapper, Fault> {
        let mut gpu = Gpu::open(&board.gpu, buffers(calibration, board)?.used())?;
        cache_folder().iter().for_each(|folder| _ = gpu.reuse_pipelines(folder));
        let stereo = Stereo::new(calibration, &board.stereo, board.map.scale, Some(&mut gpu))?;
        let config = &board.map;
        // There a step takes the time of its launches, however few its pixels are.
        let is_discrete = gpu.caps().kind == DeviceKind::Discrete;
        let half_size_steps = if is_discrete { 0 } else { config.half_size_steps };
        let shape = shape(calibration, board);
        let (w, h, channels) = (shape.width as usize, shape.height as usize, shape.channels as usize);
        let cameras = cameras::training(&stereo.views, config)?;
        let mut pipeline = Pipeline::new(&mut gpu, shape)?;
        for (i, camera) in cameras.iter().enumerate() {
            pipeline.loss.set_mask(&mut gpu, i, &camera.valid)?;
        }
        let cells = occupancy::Buffers::new(gpu.arena(), config.occupancy_cells)?;
        let pair = RectifiedPair::new(&stereo.views, &cameras[0], channels);
        let work = Workspace::new(w, h, channels, config);
        let anchors = Anchors::new(&mut gpu, cells, work, pair, config)?;
        gpu.compile()?;
        gpu.time_commands(TIMED_IN);
        let known = if place.is_some() { known(board, &shape) } else { 0 };
        let (mut views, rendered) = (Views::new(&shape, known), Rendered::new(w, h, channels));
        let mut trainer = Trainer::new(&MapConfig { half_size_steps, ..config.clone() });
        let counters = Counters::default();
        let (mut archive, unkept) = match place.map(|place| Archive::open(place, calibration, board, &shape)) {
            Some(Err(fault)) => (None, Some(fault)),
            opened => (opened.and_then(Result::ok), None),
        };
        if let Some(archive) = &mut archive {
            archive.resume(&mut views);
            // Parts of an anchor that were written before and after it was moved.
            archive.follow(&views);
            counters.snapshot_errors.add(u64::from(archive.latest.is_none()));
            trainer.scene_depth_m = archive.scene_depth_m().unwrap_or(trainer.scene_depth_m);
        }
        let steps = (views.earlier..views.len()).map(|i| u64::from(views.get(i).steps)).sum();
        let scene = Scene { gpu, pipeline, views, cameras, rendered, steps, counters };
        archive.iter_mut().for_each(|archive| archive.look_around(&scene));
        Ok(Mapper {
            scene,
            stereo,
            anchors,
            trainer,
            archive,
            unkept,
            move_tolerance: config.move_tolerance,
            corrected: false,
        })
    }

    /// Writes what the driver compiled to the user's cache, so that later starts are quicker.
    pub fn keep_pipelines(&mut self) -> Result<(), Fault> {
        self.scene.gpu.keep_pipelines()
    }

    /// Stores a keyframe, and makes it an anchor when the map does not show its view, or not well. One whose pose is not finite is
    /// refused.
    pub fn ingest(&mut self, keyframe: &Keyframe) -> Result<StepKind, GpuError> {
        if !keyframe.world_from_body.is_finite() {
            self.scene.counters.keyframes_not_finite.add(1);
            return Ok(StepKind::Dropped);
        }
        if self.archive.is_some() && self.scene.views.index_of(keyframe.id).is_some() {
            // The mapper before this one had it, and left it on the disk.
            self.correct(&PoseCorrection {
                id: keyframe.id,
                world_from_body: keyframe.world_from_body,
                body_from_cam: None,
            });
            return Ok(StepKind::Stored);
        }
        self.apply_corrections()?;
        self.finish_pending()?;
        self.scene.views.visit(keyframe.t, keyframe.epoch, keyframe.world_from_body.p);
        if let Some(archive) = &mut self.archive {
            let at = (keyframe.t, keyframe.world_from_body);
            archive.arrive(&mut self.scene, at, keyframe.epoch, self.trainer.in_burst())?;
            if !self.scene.views.knows_all_it_can() {
                archive.make_place(&mut self.scene)?;
            }
        }
        if self.scene.views.is_full() {
            self.scene.counters.keyframe_store_full.add(1);
            return Ok(StepKind::Dropped);
        }
        if let Some(body_from_cam) = &keyframe.body_from_cam {
            self.adjust(body_from_cam)?;
        }
        let index = self.scene.views.len();
        for i in 0..self.scene.cameras.len() {
            let Scene { views, cameras, .. } = &mut self.scene;
            let poses = [cameras[i].body_from_cam, self.stereo.views.rig()[i].body_from_cam];
            views.add(keyframe, poses, |channel, plane| {
                cameras::draw(i, &cameras[i], &mut self.stereo.views, keyframe.plane(i, channel), plane);
            });
            self.scene.upload_image(index + i)?;
        }
        if let Some(archive) = &mut self.archive {
            archive.take_in(&self.scene, index);
        }
        let kind = if keyframe.held_out { self.hold_out(index)? } else { self.train_on(keyframe, index)? };
        if let Some(archive) = &mut self.archive {
            archive.find_trainable(&self.scene.views);
            archive.save_some(&mut self.scene)?;
            archive.save_latest(&mut self.scene, keyframe.t)?;
        }
        Ok(kind)
    }

    /// Takes in a keyframe that is only evaluated.
    fn hold_out(&mut self, index: usize) -> Result<StepKind, GpuError> {
        if let Some(archive) = &mut self.archive {
            let view = self.scene.view(index);
            self.scene.render(&view)?;
            archive.saw(&mut self.scene, index);
        }
        Ok(StepKind::Stored)
    }

    /// Takes in a keyframe that is trained on.
    fn train_on(&mut self, keyframe: &Keyframe, index: usize) -> Result<StepKind, GpuError> {
        if self.archive.as_ref().is_some_and(Archive::is_full) {
            self.scene.counters.blocks_full.add(1);
            return Ok(StepKind::Stored);
        }
        let (scene, archive) = (&mut self.scene, &mut self.archive);
        let Some(anchor) = self.anchors.try_anchor(scene, &mut self.stereo, archive, keyframe, index)? else {
            return Ok(StepKind::Stored);
        };
        if let Some(archive) = archive {
            archive.open_block(&scene.views, index);
            archive.find_absent(scene, index);
            anchor.scene_depth_m.iter().for_each(|depth| archive.set_scene_depth(*depth));
        }
        self.trainer.scene_depth_m = anchor.scene_depth_m.unwrap_or(self.trainer.scene_depth_m);
        self.trainer.start_burst(index);
        Ok(StepKind::Anchor { seeded: anchor.seeded })
    }

    /// Takes over where the cameras sit on the body by now.
    fn adjust(&mut self, body_from_cam: &[Pose]) -> Result<(), GpuError> {
        let Scene { gpu, pipeline, cameras, counters, .. } = &mut self.scene;
        let anew = self.stereo.adjust(gpu, body_from_cam)?;
        cameras::adjust(cameras, &self.stereo.views, anew);
        if anew {
            counters.rectified_anew.add(1);
            for (i, camera) in cameras.iter().enumerate() {
                pipeline.loss.set_mask(gpu, i, &camera.valid)?;
            }
            self.anchors.adjust(&self.stereo.views, &cameras[0]);
        }
        Ok(())
    }

    /// Moves a keyframe, and with what is done next the Gaussians of an anchor. Never waits for the GPU.
    pub fn correct(&mut self, correction: &PoseCorrection) {
        self.corrected |= self.scene.views.correct(correction);
    }

    /// The numbers over all runs of its store of the first keyframe of this flight and of its first epoch.
    pub fn first_numbers(&self) -> (u64, u32) {
        let run = self.archive.as_ref().map(|archive| archive.runs.newest());
        run.map_or((0, 0), |run| (run.first, run.about.epoch_base))
    }

    /// Makes one map of an epoch, of this flight or of the one that began at `flight` (ms since 1970), and epoch `into` of this
    /// flight: what one has, the other sees. Counted where that cannot be.
    pub fn join(&mut self, flight: Option<i64>, epoch: u32, into: u32) {
        let Scene { views, pipeline, counters, .. } = &mut self.scene;
        let found = match &self.archive {
            Some(Archive { runs, .. }) if runs.may_join() => {
                runs.epoch(flight, epoch).zip(runs.epoch(None, into)).map(|(a, b)| (runs.resolved(a), runs.resolved(b)))
            }
            None if flight.is_none() => Some((epoch, into)),
            _ => None,
        };
        let Some((from, into)) = found.filter(|(from, into)| pipeline.pool.join(*from, *into)) else {
            counters.epochs_kept_apart.add(1);
            return;
        };
        if from != into {
            views.join(from, into);
            self.archive.iter_mut().for_each(|archive| archive.join(from, into));
        }
    }

    /// Whether images had `steps_per_keyframe_max` steps on average: more would teach the map its few views by heart.
    pub fn is_trained_enough(&self) -> bool {
        self.scene.pipeline.pool.count() > 0 && self.trainer.trained_enough(&self.scene)
    }

    /// Stereo pairs that were matched, and the time it took, s.
    pub fn matched(&self) -> (u64, f64) {
        self.anchors.matched
    }

    /// Gaussians of the map that are on disk alone, and neither drawn nor trained.
    pub fn away(&self) -> u64 {
        self.archive.as_ref().map_or(0, Archive::away) as u64
    }

    /// Trains until `deadline`, and takes at least one step if there is something to train.
    pub fn step(&mut self, deadline: Instant) -> Result<StepReport, GpuError> {
        let start = Instant::now();
        let mut report = StepReport::default();
        self.apply_corrections()?;
        loop {
            if self.trainer.must_wait() {
                self.finish_pending()?;
            }
            if let Some(archive) = &mut self.archive {
                archive.growing = self.trainer.in_burst();
                archive.receive(&mut self.scene)?;
            }
            let Some(kind) = self.trainer.step(&mut self.scene, &mut self.archive)? else {
                self.finish_pending()?;
                break;
            };
            report.kind = kind;
            report.iterations += 1;
            report.loss = self.trainer.loss;
            if let (Some(archive), Some(index)) = (&mut self.archive, self.trainer.trained.take()) {
                archive.trained(&mut self.scene, index)?;
            }
            if Instant::now() >= deadline {
                break;
            }
        }
        report.ms = start.elapsed().as_secs_f64() * 1e3;
        Ok(report)
    }

    fn apply_corrections(&mut self) -> Result<(), GpuError> {
        if std::mem::take(&mut self.corrected) {
            self.finish_pending()?;
            self.scene.apply_corrections(self.move_tolerance)?;
            if let Some(archive) = &mut self.archive {
                archive.follow(&self.scene.views);
            }
        }
        Ok(())
    }

    /// Takes in the training step in flight; an anchor whose burst it ends is densified.
    fn finish_pending(&mut self) -> Result<(), GpuError> {
        match self.trainer.finish_pending(&mut self.scene, &self.archive)? {
            Some(anchor) => self.anchors.densify(&mut self.scene, &mut self.archive, anchor),
            None => Ok(()),
        }
    }

    /// Scores a few keyframes at run time `t_s`. Allocates.
    pub fn sample(&mut self, t_s: f64) -> Result<CurvePoint, GpuError> {
        let [psnr_db, psnr_heldout_db] = evaluate::sample(&mut self.scene, &self.archive)?;
        let (splats, iterations) = (u64::from(self.scene.pipeline.pool.count()), self.scene.steps);
        Ok(CurvePoint { t_s, psnr_db, psnr_heldout_db, splats, iterations })
    }

    /// The seam of a loop that is closed now with what was seen at `with`, where that was in this flight.
    pub fn seam(&self, with: Option<Nanos>) -> Seam {
        Seam::new(&self.scene, &self.archive, with)
    }

    /// Scores a seam with all that was corrected. Allocates.
    pub fn score_seam(&mut self, seam: &Seam) -> Result<SeamScore, GpuError> {
        self.apply_corrections()?;
        let (psnr_db, disagreement) = (seam.psnr_db(&mut self.scene)?, self.anchors.disagreement());
        Ok(SeamScore { psnr_db, disagreement })
    }

    /// Scores every keyframe, those on disk too. Allocates.
    #[cfg(feature = "instruments")]
    pub fn evaluate(&mut self) -> Result<Evaluation, GpuError> {
        self.evaluate_some(usize::MAX)
    }

    /// Scores `most` of the keyframes, spread over the run. Allocates.
    pub fn evaluate_some(&mut self, most: usize) -> Result<Evaluation, GpuError> {
        self.finish_for_paging()?;
        evaluate::evaluate(&mut self.scene, &mut self.archive, self.trainer.weights(), most)
    }

    /// Takes in the step in flight where images are to come and go: a place must not change hands under it.
    fn finish_for_paging(&mut self) -> Result<(), GpuError> {
        if self.archive.is_some() {
            self.finish_pending()?;
        }
        Ok(())
    }

    /// Pictures of `count` keyframes spread over the run. Allocates.
    pub fn panels(&mut self, count: usize) -> Result<Vec<Panel>, GpuError> {
        self.finish_for_paging()?;
        evaluate::panels(&mut self.scene, &mut self.archive, count)
    }

    /// The exposure that most images were taken with. Allocates.
    pub fn median_exposure(&self) -> Exposure {
        self.scene.median_exposure()
    }

    /// The newest epoch of this flight and its Gaussians. Allocates.
    pub fn newest_splats(&mut self) -> Result<(u32, Vec<Gaussian>), GpuError> {
        let pool = &self.scene.pipeline.pool;
        let (epoch, slots) = pool.newest_epoch();
        let mut splats = pool.download(&mut self.scene.gpu)?;
        splats.truncate(slots.end as usize);
        splats.drain(..(slots.start as usize).min(splats.len()));
        Ok((epoch.saturating_sub(self.first_numbers().1), splats))
    }

    /// The Gaussians alive. Allocates.
    pub fn splats(&mut self) -> Result<Vec<Gaussian>, GpuError> {
        self.scene.pipeline.pool.download(&mut self.scene.gpu)
    }

    /// A keyframe as stored, in the order they came.
    #[cfg(feature = "instruments")]
    pub fn keyframe(&self, index: usize) -> &Stored {
        self.scene.views.get(index * self.scene.cameras.len())
    }

    /// Epochs and poses of this flight's keyframes, in their order: with the correction that training found, held out with what
    /// is interpolated between their neighbours in time.
    pub fn keyframe_poses(&self) -> impl Iterator<Item = (u32, TimedPose)> + '_ {
        let (views, first_epoch) = (&self.scene.views, self.first_numbers().1);
        (views.earlier..views.len()).step_by(views.cameras()).map(move |i| {
            let e = views.get(i);
            let refined = if e.held_out { views.between(i) } else { e.refined };
            let pose = TimedPose { t: e.t, pose: e.given * refined.body_from_refined };
            (e.epoch.saturating_sub(first_epoch), pose)
        })
    }

    /// Gaussians of the map, in the pool and on disk.
    pub fn splat_count(&self) -> usize {
        self.scene.pipeline.pool.count() as usize + self.away() as usize
    }

    /// The side of the store that reads and writes, where threads are to do that.
    pub fn disk(&self) -> Option<std::sync::Arc<crate::store::Disk>> {
        self.archive.as_ref().and_then(Archive::disk)
    }

    /// Number of the run in the map's store.
    pub fn stored_run(&self) -> Option<u32> {
        self.archive.as_ref().map(|archive| archive.run)
    }

    /// Writes all of the map to its store, if it has one, and answers whether the store has all of it then. Fails where it
    /// cannot be written.
    pub fn save(&mut self) -> Result<Result<bool, Fault>, GpuError> {
        self.finish_pending()?;
        let Some(archive) = &mut self.archive else { return Ok(Ok(false)) };
        archive.flush(&mut self.scene)
    }

    #[cfg(feature = "instruments")]
    pub fn anchor_count(&self) -> usize {
        self.scene.views.anchors()
    }

    #[cfg(feature = "instruments")]
    pub fn keyframe_count(&self) -> usize {
        self.scene.views.len() / self.scene.cameras.len()
    }

    /// Training steps started.
    #[cfg(feature = "instruments")]
    pub fn iterations(&self) -> u64 {
        self.scene.steps
    }

    pub fn counters(&self) -> &Counters {
        self.archive.iter().for_each(|archive| archive.count(&self.scene.counters));
        &self.scene.counters
    }

    pub fn gpu_bytes(&self) -> u64 {
        self.scene.gpu.arena_used()
    }

    pub fn device(&self) -> &str {
        &self.scene.gpu.caps().name
    }

    pub fn kernel_times(&self) -> Vec<Timing> {
        self.scene.gpu.timings().to_vec()
    }
}

/// Views that there is room for beside those whose images are in memory.
fn known(board: &Board, shape: &Shape) -> usize {
    if board.store.enabled {
        filing::keyframes_known(board, shape) * shape.cameras as usize
    } else {
        0
    }
}

/// Every buffer that `open` takes from the arena.
fn buffers(calibration: &Calibration, board: &Board) -> Result<Arena, Fault> {
    let mut arena = Arena::counting();
    stereo::Buffers::new(&mut arena, calibration, &board.stereo)?;
    let shape = shape(calibration, board);
    shape.check()?;
    pipeline::Buffers::new(&mut arena, &shape)?;
    occupancy::Buffers::new(&mut arena, board.map.occupancy_cells)?;
    Ok(arena)
}

fn shape(calibration: &Calibration, board: &Board) -> Shape {
    let (camera, b) = (&calibration.cameras[0].camera, &board.budget);
    let cameras = cameras::count(calibration.cameras.len(), &board.map) as u32;
    Shape {
        width: camera.width as u32 / board.map.scale,
        height: camera.height as u32 / board.map.scale,
        splats: b.splats,
        intersections: b.intersections,
        images: b.keyframes * cameras,
        channels: cameras::channels(&board.map) as u32,
        cameras,
        fisheye: board.map.projection == Projection::Fisheye,
        half_size: board.map.half_size_steps > 0,
    }
}
