//! From the gradient by pixel to a step of every visible Gaussian, and to the gradient by the camera's pose.
//!
//! ```text
//! raster_backward -> sum_chunks -> (chroma_backward) -> project_backward (Adam)       gradient by intersection -> Gaussian
//! ```
//!
//! Each intersection has one gradient slot with one writer, in place of atomics, and sums have one order, so that a step is
//! the same in every run.

use super::pool::Pool;
use super::render::Renderer;
use super::shape::{Scratch, Shape, GROUP};
use super::step::{LearningRates, Weights};
use super::tiling::Tiling;
use super::view::View;
use crate::gpu::kernels::{chroma_backward, project_backward, raster_backward, sum_chunks};
use crate::gpu::{Arena, Buf, Gpu, Kernel, Recorder, Threads};
use stipple_drivers::Fault;

#[derive(Clone, Copy)]
pub struct Buffers {
    pub pose_sums: Buf<f32>,
}

impl Buffers {
    pub fn new(arena: &mut Arena, shape: &Shape) -> Result<Buffers, Fault> {
        let groups = shape.splats.div_ceil(GROUP) as usize;
        Ok(Buffers { pose_sums: arena.alloc("splats: pose gradient by workgroup", 8 * groups)? })
    }
}

pub struct Backward {
    pub buffers: Buffers,
    /// One slot an intersection; of this step.
    pub isect_gradients: Buf<f32>,
    capacity: u32,
    raster: Kernel<raster_backward::K>,
    /// Where it pays.
    sum_chunks: Option<Kernel<sum_chunks::K>>,
    /// In colour.
    chroma: Option<Kernel<chroma_backward::K>>,
    /// By lens: leaving the map as it is, and taking a step.
    project: [[Kernel<project_backward::K>; 2]; 2],
}

impl Backward {
    pub fn new(
        gpu: &mut Gpu,
        buffers: Buffers,
        scratch: &Scratch,
        shape: &Shape,
        tiling: Tiling,
    ) -> Result<Backward, Fault> {
        let (channels, Tiling { lanes, column, variant, chunk, .. }) = (shape.channels, tiling);
        let mut project =
            |fisheye, learn| gpu.kernel_in_pieces(project_backward::Spec { channels, chunk, fisheye, learn });
        Ok(Backward {
            buffers,
            isect_gradients: scratch.isect_gradients,
            capacity: shape.intersections,
            project: shape.by_lens(|fisheye| Ok([project(fisheye, false)?, project(fisheye, true)?]))?,
            raster: gpu.kernel_variant(raster_backward::Spec { lanes, column, channels }, variant)?,
            sum_chunks: (chunk > 1).then(|| gpu.kernel(sum_chunks::Spec { channels, chunk })).transpose()?,
            chroma: (channels == 3).then(|| gpu.kernel_in_pieces(chroma_backward::Spec { chunk })).transpose()?,
        })
    }

    /// Takes a step at `rates`, or none: then only the gradient by the pose is summed. The picture is the one that
    /// `renderer` has just drawn, as the loss has compared it.
    pub fn record(
        &self,
        rec: &mut Recorder,
        pool: &Pool,
        renderer: &Renderer,
        pixel_gradient: Buf<f32>,
        view: &View,
        rates: Option<&LearningRates>,
        weights: &Weights,
    ) {
        let b = &renderer.lists.buffers;
        rec.dispatch(
            &self.raster,
            raster_backward::Bind {
                ranges: b.ranges.read(),
                intersections: b.lists.read(),
                owners: b.owners.read(),
                projected_in: renderer.projected.read(),
                chroma: pool.buffers.chroma.read(),
                rendered: renderer.rendered.read(),
                pixel_gradient: pixel_gradient.read(),
                isect_gradients: self.isect_gradients.write(),
            },
            raster_backward::Push { size: view.size() },
            Threads::d1(renderer.tiles(view) * renderer.tiling.lanes),
        );
        if let Some(sum_chunks) = &self.sum_chunks {
            let slots = sum_chunks::Bind {
                counts_in: b.counts.read(),
                owners: b.owners.read(),
                isect_gradients: self.isect_gradients.read_write(),
            };
            rec.dispatch(sum_chunks, slots, (), renderer.lists.walkers);
        }
        if let (Some(chroma), Some(rates)) = (&self.chroma, rates) {
            let bind = chroma_backward::Bind {
                counts_in: b.counts.read(),
                runs: b.runs.read(),
                steps: pool.buffers.steps.read(),
                isect_gradients: self.isect_gradients.cast().read(),
                chroma: pool.buffers.chroma.read_write(),
                chroma_moments: pool.buffers.chroma_moments.read_write(),
            };
            let splats = pool.slots(view.epoch).end;
            let push = chroma_backward::Push { splats, capacity: self.capacity, rate: rates.colour };
            rec.dispatch(chroma, bind, push, Threads::d1(splats));
        }
        self.record_project(rec, pool, renderer, view, rates, weights);
    }

    fn record_project(
        &self,
        rec: &mut Recorder,
        pool: &Pool,
        renderer: &Renderer,
        view: &View,
        rates: Option<&LearningRates>,
        weights: &Weights,
    ) {
        let (b, splats) = (&renderer.lists.buffers, pool.slots(view.epoch).end);
        let kernel = &self.project[view.lens()][usize::from(rates.is_some())];
        let rates = rates.copied().unwrap_or_default();
        rec.dispatch(
            kernel,
            project_backward::Bind {
                counts_in: b.counts.read(),
                runs: b.runs.read(),
                isect_gradients: self.isect_gradients.cast().read(),
                splats: pool.buffers.splats.read_write(),
                moments_in_out: pool.buffers.moments.read_write(),
                steps: pool.buffers.steps.read_write(),
                sums: self.buffers.pose_sums.write(),
            },
            project_backward::Push {
                camera: view.words(),
                size: view.size(),
                splats,
                capacity: self.capacity,
                rate_position: rates.position,
                rate_scale: rates.scale,
                rate_rotation: rates.rotation,
                rate_opacity: rates.opacity,
                rate_colour: rates.colour,
                weight_needle: weights.needle,
                weight_scale: weights.scale,
                log_scale_soft: weights.scale_soft_m.ln(),
                weight_opacity: weights.opacity,
            },
            Threads::d1(splats),
        );
    }
}
