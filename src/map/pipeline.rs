//! The GPU's side of the map: a picture, or a training step, in one submission each.
//!
//! ```text
//! render -> loss -> backward -> summary
//! ```
//!
//! A submission ends by bringing 64 bytes to the host. While a step runs the next may be started (`start`, `finish`), so
//! that the device need not wait for the host.

use super::backward::{self, Backward};
use super::coarseness::Coarseness;
use super::loss::{self, Loss};
use super::pool::{self, Pool};
use super::render::{self, Rendered, Renderer};
use super::scan::{self, Scan};
use super::shape::{Scratch, Shape, GROUP};
use super::step::{LearningRates, Stats, StepStats, Target, Weights};
use super::tiling::Tiling;
use super::view::View;
use crate::gpu::kernels::summary;
use crate::gpu::kernels::types::Status;
use crate::gpu::{Arena, Buf, Gpu, GpuError, Kernel, Recorder, Threads, Ticket, REPORTS};
use stipple_drivers::Fault;

/// Everything that the map keeps in the arena.
pub struct Buffers {
    scratch: Scratch,
    pool: pool::Buffers,
    render: render::Buffers,
    loss: loss::Buffers,
    backward: backward::Buffers,
    scan: scan::Buffers,
    status: Buf<Status>,
}

impl Buffers {
    pub fn new(arena: &mut Arena, shape: &Shape) -> Result<Buffers, Fault> {
        Ok(Buffers {
            pool: pool::Buffers::new(arena, shape)?,
            render: render::Buffers::new(arena, shape)?,
            loss: loss::Buffers::new(arena, shape)?,
            backward: backward::Buffers::new(arena, shape)?,
            scratch: Scratch::new(arena, shape)?,
            scan: scan::Buffers::new(arena)?,
            status: arena.alloc("status", 1)?,
        })
    }
}

pub struct Pipeline {
    pub pool: Pool,
    pub renderer: Renderer,
    pub loss: Loss,
    pub backward: Backward,
    shape: Shape,
    summary: Kernel<summary::K>,
    status: Buf<Status>,
    steps_started: usize,
}

/// A training step that was started, and what its answer will be read with.
#[must_use]
#[derive(Clone, Copy, Debug)]
pub struct Step {
    ticket: Ticket,
    /// Its place among the reports.
    place: usize,
    pub view: View,
    pub target: Target,
    ssim_weight: f32,
}

/// Place of the reports that are waited for at once; the others are of steps under way.
const WAITED_FOR: usize = REPORTS - 1;

impl Pipeline {
    /// Bytes of an arena that `new` takes all of.
    #[cfg(feature = "instruments")]
    pub fn arena_bytes(shape: &Shape) -> Result<u64, Fault> {
        let mut arena = Arena::counting();
        Buffers::new(&mut arena, shape)?;
        Ok(arena.used())
    }

    pub fn new(gpu: &mut Gpu, shape: Shape) -> Result<Pipeline, Fault> {
        let tiling = Tiling::of(gpu.caps());
        Pipeline::with_tiling(gpu, shape, tiling)
    }

    /// Does what `new` does with the raster chosen.
    pub fn with_tiling(gpu: &mut Gpu, shape: Shape, tiling: Tiling) -> Result<Pipeline, Fault> {
        shape.check()?;
        let Buffers { scratch, pool, render, loss, backward, scan, status } = Buffers::new(gpu.arena(), &shape)?;
        let scan = Scan::new(gpu, &scan)?;
        Ok(Pipeline {
            // Gradients of intersections live for one step.
            pool: Pool::new(gpu, pool, scratch.isect_gradients.cast(), scan, &shape)?,
            renderer: Renderer::new(gpu, render, scratch, &shape, tiling)?,
            loss: Loss::new(gpu, loss, &scratch, &shape, tiling.loss_by_tiles)?,
            backward: Backward::new(gpu, backward, &scratch, &shape, tiling)?,
            shape,
            summary: gpu.kernel(summary::Spec::default())?,
            status,
            steps_started: 0,
        })
    }

    #[cfg(feature = "instruments")]
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// Draws the map, coarser than `view` asks where it would not fit. Views up to the shape in size.
    pub fn render(&self, gpu: &mut Gpu, view: &View, out: &mut Rendered) -> Result<Stats, GpuError> {
        let mut view = *view;
        let stats = loop {
            let mut rec = gpu.record();
            self.renderer.record(&mut rec, &self.pool, &view, true);
            self.record_summary(&mut rec, 0, 0);
            let stats = Stats::new(&self.status(gpu, rec)?, &view);
            if stats.overflow == 0 {
                break stats;
            }
            view.coarseness = self.coarseness_after(&stats);
        };
        let n = view.camera.width * view.camera.height;
        (out.width, out.height) = (view.camera.width, view.camera.height);
        let channels = self.shape.channels as usize;
        let planes = [(0, channels, &mut out.colour), (channels, 1, &mut out.alpha), (channels + 1, 1, &mut out.depth)];
        for (plane, count, pixels) in planes {
            pixels.resize(count * n, 0.0);
            gpu.download(self.renderer.rendered, plane * n, pixels)?;
        }
        out.alpha.iter_mut().for_each(|t| *t = 1.0 - *t);
        Ok(stats)
    }

    /// How coarsely a view is drawn next.
    pub fn coarseness_after(&self, stats: &Stats) -> Coarseness {
        stats.coarseness.after(stats.needed(), self.shape.intersections)
    }

    /// SSIM by pixel of what was rendered last against an image; once for a picture, which it fills where something is absent.
    pub fn similarity(&self, gpu: &mut Gpu, target: &Target, map: &mut Vec<f32>) -> Result<(), GpuError> {
        self.loss.similarity(gpu, self.renderer.rendered, target, map)
    }

    /// One step on an image, whose view must have the shape's size. Without rates the map, Adam's moments included, stays as it
    /// is to the bit.
    pub fn train(
        &mut self,
        gpu: &mut Gpu,
        view: &View,
        target: impl Into<Target>,
        rates: Option<&LearningRates>,
        weights: &Weights,
    ) -> Result<StepStats, GpuError> {
        let target = target.into();
        let mut rec = gpu.record();
        self.record_step(&mut rec, view, &target, rates, weights);
        let status = self.status(gpu, rec)?;
        Ok(StepStats::new(&status, view, self.loss.values(&target), weights.ssim))
    }

    /// Starts what `train` does. `finish` must have its answer before the step after next is started.
    pub fn start(
        &mut self,
        gpu: &mut Gpu,
        view: &View,
        target: impl Into<Target>,
        rates: &LearningRates,
        weights: &Weights,
    ) -> Result<Step, GpuError> {
        let target = target.into();
        let place = self.steps_started % WAITED_FOR;
        self.steps_started += 1;
        let mut rec = gpu.record();
        self.record_step(&mut rec, view, &target, Some(rates), weights);
        rec.report(self.status, place);
        let ticket = gpu.start(rec)?;
        Ok(Step { ticket, place, view: *view, target, ssim_weight: weights.ssim })
    }

    /// Waits for a step that was started; its answer.
    pub fn finish(&self, gpu: &mut Gpu, step: &Step) -> Result<StepStats, GpuError> {
        let mut status = [Status::default()];
        gpu.report(step.ticket, step.place, &mut status)?;
        Ok(StepStats::new(&status[0], &step.view, self.loss.values(&step.target), step.ssim_weight))
    }

    fn record_step(
        &self,
        rec: &mut Recorder,
        view: &View,
        target: &Target,
        rates: Option<&LearningRates>,
        weights: &Weights,
    ) {
        let shape = &self.shape;
        assert!(
            view.size() == [shape.width, shape.height]
                && target.image < shape.images
                && (shape.half_size || !target.half_size),
            "training views are of the shape the map was made with"
        );
        let halved = view.halved();
        let view = if target.half_size { &halved } else { view };
        let gradient = self.loss.buffers.pixel_gradient;
        self.renderer.record(rec, &self.pool, view, false);
        self.loss.record(rec, self.renderer.rendered, target, weights.ssim);
        self.backward.record(rec, &self.pool, &self.renderer, gradient, view, rates, weights);
        self.record_summary(rec, self.loss.sums(target), self.pool.slots(view.epoch).end.div_ceil(GROUP));
    }

    fn record_summary(&self, rec: &mut Recorder, image_groups: u32, splat_groups: u32) {
        let loss = &self.loss.buffers;
        rec.dispatch(
            &self.summary,
            summary::Bind {
                counts_in: self.renderer.lists.buffers.counts.read(),
                ssim_sums: loss.ssim_sums.read(),
                loss_sums: loss.loss_sums.read(),
                sums: self.backward.buffers.pose_sums.read(),
                status_out: self.status.write(),
            },
            summary::Push { image_groups, splat_groups },
            Threads::groups(1, 1, 1),
        );
    }

    /// Runs a recording that ends with a summary, and waits for what it says.
    fn status(&self, gpu: &mut Gpu, mut rec: Recorder) -> Result<Status, GpuError> {
        rec.report(self.status, WAITED_FOR);
        let ticket = gpu.start(rec)?;
        let mut status = [Status::default()];
        gpu.report(ticket, WAITED_FOR, &mut status)?;
        Ok(status[0])
    }
}
