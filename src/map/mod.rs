//! The mapper: keyframes in, a map of Gaussians out, a bounded amount of work at a time.
//!
//! `step` looks at waiting keyframes first. One whose view the map does not cover becomes an anchor: stereo
//! depth, seeds, then a burst of training steps on it alone (`lifecycle`). Otherwise single training steps go to
//! keyframes drawn uniformly at random (the map sees its past as often as its present, so it does not forget).
//! Held-out keyframes are stored, never trained on, never anchors. Read `pipeline` for what a step does on
//! the GPU.
//!
//! A step is started before the one before it is finished, so that the device never waits for the host. What a step
//! says of its keyframe's pose and exposure is therefore taken in exactly one step late, whenever the device ends it,
//! and before anything else is done with the map: the same seed and keyframes give the same map to the bit.

pub mod anchors;
pub mod blocks;
pub mod budget;
pub mod buffers;
pub mod densify;
pub mod evaluate;
pub mod eyes;
pub mod keyframes;
mod lifecycle;
pub mod occupancy;
pub mod pipeline;
pub mod pool;
pub mod quality;
pub mod refine;
pub mod schedule;
pub mod sort;
pub mod step;
pub mod tiling;
pub mod view;

use crate::config::{Board, MapConfig};
use crate::counters::Counters;
use crate::gpu::{Gpu, GpuError, Timing};
use crate::mem::Footprint;
use crate::stereo::{DepthMap, Stereo};
use anchors::Seeder;
use eyes::{Eye, Pair};
use keyframes::{Queue, Store};
use occupancy::Occupancy;
use pipeline::{LearningRates, Pipeline, Rendered, Shape, View, Weights};
use schedule::Schedule;
use std::time::Instant;
use step::Step;
use stipple_drivers::{Calibration, Fault};

pub use keyframes::{Keyframe, Offer, PoseCorrection};
pub use pipeline::Gaussian;
pub use quality::{CurvePoint, Evaluation, Panel};

/// What a call of `step` did; an anchor ends the call, so none is missed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Did {
    /// There was nothing to do.
    #[default]
    Idle,
    /// A keyframe was stored.
    Stored,
    /// A keyframe was dropped: the store is full.
    Dropped,
    /// A keyframe became an anchor.
    Anchor { seeded: u32 },
    /// Training steps on the newest anchor alone.
    Burst,
    /// Training steps on keyframes drawn at random.
    Train,
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepReport {
    pub did: Did,
    pub ms: f64,
    /// Training steps taken.
    pub iterations: u32,
    /// Of the last training step that has ended.
    pub loss: f64,
}

/// A training step that was started and not looked at yet.
struct UnderWay {
    /// Of the image it is on.
    index: usize,
    step: Step,
}

/// Commands are timed one by one in one recording of so many: each timestamp drains the device.
const TIMED_IN: u64 = 32;

pub struct Mapper {
    gpu: Gpu,
    stereo: Stereo,
    pipeline: Pipeline,
    config: MapConfig,
    queue: Queue,
    store: Store,
    /// The cameras that train.
    eyes: Vec<Eye>,
    /// The newest keyframe without distortion, where that is not what trains.
    pair: Option<Pair>,
    seeder: Seeder,
    occupancy: Occupancy,
    /// Of the occupancy, by seed.
    answers: Vec<u32>,
    schedule: Schedule,
    /// Depth of the newest anchor, m.
    depth: DepthMap,
    rendered: Rendered,
    /// SSIM of the newest anchor by pixel, with room for more channels.
    similarity: Vec<f32>,
    /// Median depth of the first anchor, m: what a position step is measured in.
    scene_depth_m: f64,
    /// Started.
    iterations: u64,
    /// What that was when the last anchor came.
    anchored_at: u64,
    under_way: Option<UnderWay>,
    /// Of the last training step that has ended.
    loss: f64,
    counters: Counters,
    /// Corrections came since anchors were last put in place.
    corrected: bool,
}

/// Of a scene nothing is known of yet, m.
const SCENE_DEPTH_M: f64 = 3.0;

impl Mapper {
    pub fn footprint(calibration: &Calibration, board: &Board) -> Footprint {
        let camera = &calibration.cameras[0].camera;
        let scale = board.map.scale as usize;
        let (width, height) = (camera.width / scale, camera.height / scale);
        let cameras = calibration.cameras.len();
        let shape = shape(board, eyes::count(cameras, &board.map), width, height);
        let (pixels, images) = (width * height, shape.keyframes as usize);
        let seeds_max = seeds_max(&board.map);
        let mut f = Pipeline::footprint(&shape);
        f.gpu("alignment", Pipeline::arena_bytes(&shape).saturating_sub(f.gpu_total()) as usize);
        let colours = eyes::colours(cameras, &board.map);
        f.extend(Queue::footprint(raw_pixels_max(board), eyes::images(cameras, &board.map), colours));
        f.extend(Store::footprint(images, shape.channels as usize, pixels));
        f.extend(eyes::footprint(calibration, &board.map, pixels));
        f.extend(Seeder::footprint(pixels, seeds_max));
        f.extend(Occupancy::footprint(board.map.occupancy_cells));
        let planes = 3 + 2 * shape.channels as usize;
        f.host("map: rendering, depth and similarity", pixels * planes * size_of::<f32>());
        f.host("map: answers of the occupancy", seeds_max * size_of::<u32>());
        f
    }

    /// On a device of its own, with depth by the board's method.
    pub fn open(calibration: &Calibration, board: &Board) -> Result<Mapper, Fault> {
        let bytes = Mapper::footprint(calibration, board).gpu_total()
            + Stereo::footprint(calibration, &board.stereo, board.map.scale).gpu_total();
        let mut gpu = Gpu::open(&board.gpu, bytes)?;
        let stereo = Stereo::new(calibration, &board.stereo, board.map.scale, Some(&mut gpu))?;
        Mapper::new(gpu, stereo, board)
    }

    /// The arena of `gpu` must hold `footprint(..).gpu_total()`.
    pub fn new(mut gpu: Gpu, stereo: Stereo, board: &Board) -> Result<Mapper, Fault> {
        let camera = stereo.camera().pinhole;
        let (width, height) = (camera.width, camera.height);
        let config = board.map.clone();
        let eyes = eyes::eyes(&stereo, &config)?;
        let shape = shape(board, eyes.len(), width, height);
        let mut pipeline = Pipeline::new(&mut gpu, shape)?;
        for (i, eye) in eyes.iter().enumerate() {
            pipeline.set_mask_of(&mut gpu, i, &eye.valid)?;
        }
        let seeds_max = seeds_max(&config);
        let occupancy = Occupancy::new(&mut gpu, config.occupancy_cell_m, config.occupancy_cells)?;
        let (rig, channels) = (stereo.rig().len(), shape.channels as usize);
        let planes = |n: usize| vec![0.0; n * width * height];
        gpu.time_commands(TIMED_IN);
        Ok(Mapper {
            gpu,
            pipeline,
            queue: Queue::new(raw_pixels_max(board), eyes::images(rig, &config), eyes::colours(rig, &config)),
            store: Store::new(shape.keyframes as usize, eyes.len(), channels, width, height),
            pair: Pair::new(&stereo, &eyes[0], channels),
            eyes,
            seeder: Seeder::new(width, height, seeds_max),
            occupancy,
            answers: Vec::with_capacity(seeds_max),
            schedule: Schedule::new(config.seed),
            depth: DepthMap::new(width, height),
            rendered: Rendered { width, height, colour: planes(channels), alpha: planes(1), depth: planes(1) },
            similarity: planes(channels),
            scene_depth_m: SCENE_DEPTH_M,
            iterations: 0,
            anchored_at: 0,
            under_way: None,
            loss: 0.0,
            counters: Counters::default(),
            corrected: false,
            stereo,
            config,
        })
    }

    /// Copies what it needs. Never waits for the GPU.
    pub fn offer(&mut self, keyframe: &Keyframe) -> Offer {
        let offer = self.queue.push(keyframe);
        if offer == Offer::Full {
            self.counters.keyframes_rejected.add(1);
        }
        offer
    }

    /// Of a keyframe: what an offer must have.
    pub fn images(&self) -> usize {
        eyes::images(self.stereo.rig().len(), &self.config)
    }

    /// How many of them in colour.
    pub fn colours_offered(&self) -> usize {
        eyes::colours(self.stereo.rig().len(), &self.config)
    }

    /// Whether an offer now would be accepted.
    pub fn has_room(&self) -> bool {
        !self.queue.is_full()
    }

    /// Moves a keyframe, and with the next step the Gaussians of an anchor. Never waits for the GPU.
    pub fn correct(&mut self, correction: &PoseCorrection) {
        self.queue.correct(correction);
        self.corrected |= self.store.correct(correction);
    }

    /// Puts the Gaussians of corrected anchors where their anchors are now.
    fn follow(&mut self) -> Result<(), GpuError> {
        self.settle()?;
        let (mut moved, tolerance) = (0, self.config.move_tolerance);
        let displaced = self.store.displaced(tolerance).inspect(|_| moved += 1);
        self.pipeline.move_blocks(&mut self.gpu, displaced)?;
        self.counters.blocks_moved.add(moved);
        self.corrected = false;
        Ok(())
    }

    /// Works until `deadline`, and does at least one thing: takes in a waiting keyframe, else trains once.
    pub fn step(&mut self, deadline: Instant) -> Result<StepReport, GpuError> {
        let start = Instant::now();
        let mut report = StepReport::default();
        if self.corrected {
            self.follow()?;
        }
        loop {
            if !self.queue.is_empty() {
                if report.iterations > 0 {
                    break; // the next call's
                }
                report.did = self.take_in()?;
                if matches!(report.did, Did::Anchor { .. }) {
                    break;
                }
            } else {
                let Some(did) = self.train()? else { break };
                report.did = did;
                report.iterations += 1;
                report.loss = self.loss;
            }
            if Instant::now() >= deadline {
                break;
            }
        }
        report.ms = start.elapsed().as_secs_f64() * 1e3;
        Ok(report)
    }

    /// Starts a training step, then finishes the one before it; `None` when there is nothing to train.
    fn train(&mut self) -> Result<Option<Did>, GpuError> {
        if self.schedule.must_wait() {
            self.settle()?;
        }
        let burst = self.schedule.in_burst();
        let idle = self.pipeline.count() == 0 || (self.trained_enough() && !burst);
        let next = if idle { None } else { self.schedule.next(self.store.training()) };
        let Some(index) = next else {
            self.settle()?;
            return Ok(None);
        };
        let view = self.view(index);
        let (rates, weights) = (self.rates(), self.weights());
        let goal = self.goal(index);
        let step = self.pipeline.start(&mut self.gpu, &view, goal, &rates, &weights)?;
        self.iterations += 1;
        let before = self.under_way.replace(UnderWay { index, step });
        self.take(before)?;
        Ok(Some(if burst { Did::Burst } else { Did::Train }))
    }

    /// Finishes the step under way, if any: before anything but training is done with the map.
    fn settle(&mut self) -> Result<(), GpuError> {
        let last = self.under_way.take();
        self.take(last)
    }

    /// Waits for a step and takes in what it says.
    fn take(&mut self, step: Option<UnderWay>) -> Result<(), GpuError> {
        let Some(UnderWay { index, step }) = step else { return Ok(()) };
        let done = self.pipeline.finish(&mut self.gpu, &step)?;
        self.loss = done.loss;
        self.counters.intersections_overflow.add(u64::from(done.stats.overflow > 0));
        self.counters.splats_not_finite.add(u64::from(done.stats.failed));
        self.counters.gradients_rejected.add(u64::from(done.gradients_rejected));
        self.refine(index, &step.view, &done);
        self.schedule.took().map_or(Ok(()), |anchor| self.densify(anchor))
    }

    /// Steps past this only teach the map the few views it has, and what they do not show looks covered to the next.
    fn trained_enough(&self) -> bool {
        let most = u64::from(self.config.steps_per_keyframe_max);
        most > 0 && self.iterations >= most * self.store.training().len() as u64
    }

    fn view(&self, index: usize) -> View {
        self.eye(index).view(self.store.world_from_body(index))
    }

    /// The camera of a stored image.
    fn eye(&self, index: usize) -> &Eye {
        &self.eyes[self.store.camera(index)]
    }

    /// Smaller as the steps a keyframe has had grow: large ones find the picture, small ones settle it.
    fn rate_part(&self) -> f64 {
        let steps = self.iterations as f64 / self.store.len().max(1) as f64;
        f64::max(self.config.lr_part_min, 1.0 / (1.0 + steps / self.config.lr_halving_steps))
    }

    fn rates(&self) -> LearningRates {
        let c = &self.config;
        let part = self.rate_part() * if self.schedule.in_burst() { c.burst_rate } else { 1.0 };
        LearningRates {
            position: (part * c.lr_position * self.scene_depth_m) as f32,
            scale: (part * c.lr_scale) as f32,
            rotation: (part * c.lr_rotation) as f32,
            opacity: (part * c.lr_opacity) as f32,
            colour: (part * c.lr_colour) as f32,
        }
    }

    fn weights(&self) -> Weights {
        let c = &self.config;
        Weights {
            ssim: c.ssim_weight as f32,
            needle: c.needle_weight as f32,
            scale: c.scale_weight as f32,
            scale_soft_m: c.scale_soft_m as f32,
            opacity: c.opacity_weight as f32,
        }
    }

    fn room(&self) -> usize {
        self.pipeline.shape().splats as usize - self.pipeline.count()
    }

    /// The Gaussians alive. Allocates.
    pub fn splats(&mut self) -> Result<Vec<Gaussian>, GpuError> {
        self.pipeline.download(&mut self.gpu)
    }

    /// A keyframe as stored, in the order they came.
    pub fn keyframe(&self, index: usize) -> &keyframes::Stored {
        self.store.get(index * self.eyes.len())
    }

    pub fn splat_count(&self) -> usize {
        self.pipeline.count()
    }

    pub fn anchor_count(&self) -> usize {
        self.store.anchors()
    }

    pub fn keyframe_count(&self) -> usize {
        self.store.len() / self.eyes.len()
    }

    pub fn iterations(&self) -> u64 {
        self.iterations
    }

    pub fn counters(&self) -> &Counters {
        &self.counters
    }

    pub fn gpu_bytes(&self) -> u64 {
        self.gpu.arena_used()
    }

    pub fn device(&self) -> &str {
        &self.gpu.caps().name
    }

    pub fn kernel_times(&self) -> Vec<Timing> {
        self.gpu.timings().to_vec()
    }

    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }
}

fn shape(board: &Board, cameras: usize, width: usize, height: usize) -> Shape {
    let b = &board.budget;
    Shape {
        width: width as u32,
        height: height as u32,
        splats: b.splats,
        intersections: b.intersections,
        keyframes: b.keyframes * cameras as u32,
        channels: eyes::channels(&board.map) as u32,
        cameras: cameras as u32,
    }
}

/// Gaussians that may arrive at once.
fn seeds_max(config: &MapConfig) -> usize {
    config.seeds_per_anchor.max(config.densify_max) as usize
}

fn raw_pixels_max(board: &Board) -> usize {
    board.budget.image_width_max as usize * board.budget.image_height_max as usize
}

/// Median of the pixels that have depth, by counting them in 256 bins of 1/depth; allocates nothing.
fn median_depth(metres: &[f32]) -> Option<f64> {
    const BINS: usize = 256;
    const NEAREST_M: f32 = 0.1;
    let mut bins = [0u32; BINS];
    let bin = |z: f32| ((NEAREST_M / z * BINS as f32) as usize).min(BINS - 1);
    metres.iter().filter(|z| **z > 0.0).for_each(|&z| bins[bin(z)] += 1);
    let half = bins.iter().sum::<u32>().div_ceil(2);
    let mut passed = 0;
    let at = bins.iter().position(|n| {
        passed += n;
        half > 0 && passed >= half
    })?;
    Some(f64::from(NEAREST_M) * BINS as f64 / (at as f64 + 0.5))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn median_depth_ignores_holes() {
        assert_eq!(median_depth(&[0.0; 9]), None);
        let z = median_depth(&[0.0, 0.0, 1.0, 2.0, 9.0, 0.0]).expect("three have depth");
        assert!((z - 2.0).abs() < 0.1, "{z}");
    }
}
