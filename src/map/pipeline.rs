//! The splat kernels in the order they run. Rendering is `project` to `raster_forward`; a training step
//! goes on through the loss and back to the parameters.
//!
//! ```text
//! project -> sort by depth                               Gaussians -> visible, front to back
//! count_tiles -> scan -> emit_tiles -> sort by tile -> tile_ranges -> raster_forward
//! ssim_rows -> ssim_columns -> loss_rows -> loss_columns  picture -> gradient by pixel
//! raster_backward -> sum_chunks -> project_backward (Adam) -> summary   gradient by intersection -> Gaussian
//! ```
//!
//! Counts stay on the GPU: a dispatch over Gaussians is sized by those alive, never by the pool's capacity, and ends
//! early past those visible; one over intersections is indirect. A submission ends by bringing 64 bytes to the host. While a step runs the next may be started (`start`, `finish`), so that the device need not
//! wait for the host. Sums have one order, so that a step is the same in every run (3D Gaussian splatting:
//! Kerbl et al. 2023; one gradient slot per intersection instead of atomics).

use super::blocks::Block;
pub use super::buffers::Shape;
use super::buffers::{image_groups, Buffers, GROUP, RUN};
use super::pool::APPENDED_AT_ONCE;
pub use super::pool::{Gaussian, PruneRule};
use super::sort::{Pairs, Scan, Sorter};
pub use super::tiling::Tiling;
use super::view::{camera, size, stats};
pub use super::view::{Exposure, Fisheye, Goal, LearningRates, Rendered, Stats, StepStats, View, Weights};
use crate::gpu::kernels::types::{Splat, Status};
use crate::gpu::kernels::*;
use crate::gpu::{Gpu, GpuError, Kernel, KernelDef, Recorder, Threads};
use crate::limits::CAMERAS_MAX;
use crate::mem::Footprint;
use stipple_drivers::{Fault, FaultKind};

/// Bits of a depth key: depth_key.glsl.
const DEPTH_BITS: u32 = 16;

pub(super) struct Kernels {
    project: ByLens<project::K>,
    count_tiles: Kernel<count_tiles::K>,
    emit_tiles: Kernel<emit_tiles::K>,
    tile_ranges: Kernel<tile_ranges::K>,
    pub(super) raster_forward: Kernel<raster_forward::K>,
    /// The same, with depth.
    raster_picture: Kernel<raster_forward::K>,
    raster_backward: Kernel<raster_backward::K>,
    pub(super) ssim_rows: Kernel<ssim_rows::K>,
    ssim_columns: Kernel<ssim_columns::K>,
    pub(super) ssim_map: Kernel<ssim_columns::K>,
    loss_rows: Kernel<loss_rows::K>,
    loss_columns: Kernel<loss_columns::K>,
    /// The same, with the gradient by the exposure.
    loss_columns_exposure: Kernel<loss_columns::K>,
    /// Where it pays.
    sum_chunks: Option<Kernel<sum_chunks::K>>,
    /// Of colour maps.
    chroma_backward: Option<Kernel<chroma_backward::K>>,
    project_backward: ByLens<project_backward::K>,
    /// The same, leaving the map as it is.
    project_backward_still: ByLens<project_backward::K>,
    summary: Kernel<summary::K>,
    pub(super) prune: Kernel<prune::K>,
    pub(super) repack: Kernel<repack::K>,
    pub(super) importance: Kernel<importance::K>,
    pub(super) move_block: Kernel<move_block::K>,
}

/// A kernel made for each of the two lenses.
struct ByLens<K> {
    pinhole: Kernel<K>,
    fisheye: Kernel<K>,
}

impl<K> ByLens<K> {
    fn of(&self, view: &View) -> &Kernel<K> {
        match view.fisheye {
            None => &self.pinhole,
            Some(_) => &self.fisheye,
        }
    }
}

pub struct Pipeline {
    pub(super) shape: Shape,
    tiling: Tiling,
    pub(super) k: Kernels,
    pub(super) b: Buffers,
    pub(super) scan: Scan,
    sorter: Sorter,
    /// Slots below this are in use.
    pub(super) high_water: u32,
    pub(super) blocks: Vec<Block>,
    pub(super) steps_started: usize,
    /// By camera.
    pub(super) valid_pixels: [u32; CAMERAS_MAX],
    /// Host side of images, slots and pool transfers.
    pub(super) words: Vec<u32>,
    pub(super) pool: Vec<Splat>,
    pub(super) chroma: Vec<[f32; 2]>,
}

impl Pipeline {
    pub fn footprint(shape: &Shape) -> Footprint {
        let mut f = Buffers::footprint(shape);
        f.host("pipeline: blocks", shape.keyframes as usize * size_of::<Block>());
        f.host("pipeline: transfers", shape.words_max() * size_of::<u32>() + APPENDED_AT_ONCE * size_of::<Gaussian>());
        f
    }

    /// Arena bytes that `new` takes, alignment included.
    pub fn arena_bytes(shape: &Shape) -> u64 {
        let align = |bytes: u64| bytes.next_multiple_of(crate::gpu::ALIGN);
        let rows = Pipeline::footprint(shape).rows;
        // Two scans: the sorter's and ours; some rows are two buffers.
        rows.iter().filter(|r| r.gpu).map(|r| align(r.bytes) + crate::gpu::ALIGN).sum::<u64>() + (64 << 10)
    }

    pub fn new(gpu: &mut Gpu, shape: Shape) -> Result<Pipeline, Fault> {
        let tiling = Tiling::of(gpu.caps());
        Pipeline::with_tiling(gpu, shape, tiling)
    }

    /// As `new`, with the raster chosen.
    pub fn with_tiling(gpu: &mut Gpu, shape: Shape, tiling: Tiling) -> Result<Pipeline, Fault> {
        let Tiling { lanes, column, variant, .. } = tiling;
        if shape.width == 0
            || shape.height == 0
            || shape.splats == 0
            || shape.intersections == 0
            || shape.keyframes == 0
            || !matches!(shape.channels, 1 | 3)
            || !(1..=CAMERAS_MAX as u32).contains(&shape.cameras)
        {
            let what = format!("{shape:?} has a zero, neither 1 nor 3 channels, or no or too many cameras");
            return Err(Fault::new(FaultKind::Config, "map", what, "raise the board's [budget]"));
        }
        let channels = shape.channels;
        let forward =
            |gpu: &mut Gpu, depth| gpu.kernel_variant(raster_forward::Spec { lanes, column, depth, channels }, variant);
        let k = Kernels {
            project: ByLens {
                pinhole: gpu.kernel::<project::K>(project::Spec { lanes, column, fisheye: false })?,
                fisheye: gpu.kernel::<project::K>(project::Spec { lanes, column, fisheye: true })?,
            },
            count_tiles: gpu.kernel::<count_tiles::K>(count_tiles::Spec { lanes, column })?,
            emit_tiles: gpu.kernel::<emit_tiles::K>(emit_tiles::Spec { lanes, column })?,
            tile_ranges: plain::<tile_ranges::K>(gpu)?,
            raster_forward: forward(gpu, false)?,
            raster_picture: forward(gpu, true)?,
            raster_backward: gpu.kernel_variant(raster_backward::Spec { lanes, column, channels }, variant)?,
            ssim_rows: plain::<ssim_rows::K>(gpu)?,
            ssim_columns: gpu.kernel::<ssim_columns::K>(ssim_columns::Spec { map: 0 })?,
            ssim_map: gpu.kernel::<ssim_columns::K>(ssim_columns::Spec { map: 1 })?,
            loss_rows: plain::<loss_rows::K>(gpu)?,
            loss_columns: plain::<loss_columns::K>(gpu)?,
            loss_columns_exposure: gpu.kernel::<loss_columns::K>(loss_columns::Spec { exposure: true })?,
            sum_chunks: (tiling.chunk > 1)
                .then(|| gpu.kernel(sum_chunks::Spec { channels, chunk: tiling.chunk }))
                .transpose()?,
            chroma_backward: (channels == 3)
                .then(|| gpu.kernel(chroma_backward::Spec { chunk: tiling.chunk }))
                .transpose()?,
            project_backward: project_backward_of(gpu, &shape, tiling, true)?,
            project_backward_still: project_backward_of(gpu, &shape, tiling, false)?,
            summary: plain::<summary::K>(gpu)?,
            prune: plain::<prune::K>(gpu)?,
            repack: plain::<repack::K>(gpu)?,
            importance: plain::<importance::K>(gpu)?,
            move_block: plain::<move_block::K>(gpu)?,
        };
        let mut p = Pipeline {
            shape,
            tiling,
            k,
            b: Buffers::new(gpu, &shape)?,
            scan: Scan::new(gpu)?,
            sorter: Sorter::new(gpu)?,
            high_water: 0,
            blocks: Vec::with_capacity(shape.keyframes as usize),
            steps_started: 0,
            valid_pixels: [0; CAMERAS_MAX],
            words: Vec::with_capacity(shape.words_max()),
            pool: Vec::with_capacity(APPENDED_AT_ONCE),
            chroma: Vec::with_capacity(APPENDED_AT_ONCE),
        };
        let all = vec![255; shape.pixels()];
        for camera in 0..shape.cameras as usize {
            p.set_mask_of(gpu, camera, &all).map_err(Fault::from)?;
        }
        Ok(p)
    }

    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// What is in the arena, for tests of single stages.
    pub fn buffers(&self) -> &Buffers {
        &self.b
    }

    /// Draws the map. Views up to the pipeline's shape in size.
    pub fn render(&mut self, gpu: &mut Gpu, view: &View, out: &mut Rendered) -> Result<Stats, GpuError> {
        let mut rec = gpu.record();
        self.record_picture(&mut rec, view, &self.k.raster_picture);
        self.record_summary(&mut rec, 0, 0);
        rec.read_back(self.b.status);
        gpu.submit(rec)?;
        let status = self.status(gpu)?;
        let n = view.camera.width * view.camera.height;
        (out.width, out.height) = (view.camera.width, view.camera.height);
        let channels = self.shape.channels as usize;
        let planes = [(0, channels, &mut out.colour), (channels, 1, &mut out.alpha), (channels + 1, 1, &mut out.depth)];
        for (plane, count, pixels) in planes {
            pixels.resize(count * n, 0.0);
            gpu.download(self.b.rendered, plane * n, pixels)?;
        }
        out.alpha.iter_mut().for_each(|t| *t = 1.0 - *t);
        Ok(stats(&status))
    }

    pub(super) fn record_step(
        &self,
        rec: &mut Recorder,
        view: &View,
        goal: &Goal,
        rates: Option<&LearningRates>,
        weights: &Weights,
    ) {
        let (w, h) = (self.shape.width, self.shape.height);
        assert!(
            (view.camera.width, view.camera.height) == (w as usize, h as usize) && goal.slot < self.shape.keyframes,
            "training views are of the shape the pipeline was made with"
        );
        let by_tile = self.record_picture(rec, view, &self.k.raster_forward);
        self.record_loss(rec, goal, weights);
        self.record_update(rec, view, by_tile, rates, weights);
        self.record_summary(rec, self.shape.channels * image_groups(w, h), self.high_water.div_ceil(GROUP));
    }

    /// What the last summary said.
    pub(super) fn status(&self, gpu: &mut Gpu) -> Result<Status, GpuError> {
        let mut s = [Status::default()];
        gpu.read_back(&mut s)?;
        Ok(s[0])
    }

    fn tiles(&self, view: &View) -> u32 {
        let [tw, th] = self.tiling.tile();
        (view.camera.width as u32).div_ceil(tw) * (view.camera.height as u32).div_ceil(th)
    }

    pub(super) fn record_picture(&self, rec: &mut Recorder, view: &View, raster: &Kernel<raster_forward::K>) -> Pairs {
        let (k, b, n) = (&self.k, &self.b, self.high_water);
        let size = size(view);
        let per_slot = Threads::d1(n + 1);
        rec.fill(b.failed, 0);
        rec.dispatch(
            k.project.of(view),
            project::Bind {
                splats: b.splats.read(),
                projected_out: b.projected.write(),
                keys: b.over.depth_keys.write(),
                failed: b.failed.read_write(),
            },
            project::Push { camera: camera(view), size, splats: n },
            per_slot,
        );
        let slots = b.over.depth_keys.part(0, n as usize + 1);
        let (from, to) = b.over.pairs(slots, b.ranked, self.sorter.passes(DEPTH_BITS));
        self.sorter.record(rec, (from, to), self.scan.unlimited(), b.visible_count, DEPTH_BITS);
        rec.dispatch(
            &k.count_tiles,
            count_tiles::Bind {
                visible_count: b.visible_count.read(),
                slots: b.ranked.read(),
                projected_in: b.projected.read(),
                tile_counts: b.tile_offsets.write(),
            },
            count_tiles::Push { size, splats: n },
            per_slot,
        );
        self.scan.record(rec, b.tile_offsets.part(0, n as usize + 1));
        rec.dispatch(
            &k.emit_tiles,
            emit_tiles::Bind {
                visible_count: b.visible_count.read(),
                slots: b.ranked.read(),
                projected_in: b.projected.read(),
                tile_offsets: b.tile_offsets.read(),
                keys: b.over.isect_keys.write(),
                owners: b.owners.write(),
                isect_count: b.isect_count.write(),
            },
            emit_tiles::Push { size, splats: n, capacity: self.shape.intersections },
            per_slot,
        );
        let tiles = self.tiles(view);
        let bits = u32::BITS - tiles.leading_zeros();
        let pairs = b.over.pairs(b.over.isect_keys, b.isects, self.sorter.passes(bits));
        let sorted = self.sorter.record(rec, pairs, b.isect_count.part(0, 1), b.isects_sorted, bits);
        rec.fill(b.ranges, 0);
        rec.dispatch_indirect(
            &k.tile_ranges,
            tile_ranges::Bind { isect_count: b.isect_count.read(), keys: sorted.keys.read(), ranges: b.ranges.write() },
            tile_ranges::Push { tiles: tiles + 1 },
            b.isect_count,
            2,
        );
        rec.dispatch(
            raster,
            raster_forward::Bind {
                ranges: b.ranges.read(),
                intersections: sorted.payload.read(),
                owners: b.owners.read(),
                projected_in: b.projected.read(),
                chroma: b.chroma.read(),
                rendered: b.rendered.write(),
            },
            raster_forward::Push { size },
            Threads::d1(tiles * self.tiling.lanes),
        );
        sorted
    }

    /// Channel by channel: each is an image of its own.
    fn record_loss(&self, rec: &mut Recorder, goal: &Goal, weights: &Weights) {
        for channel in 0..self.shape.channels {
            self.record_loss_of(rec, goal, weights, channel);
        }
    }

    fn record_loss_of(&self, rec: &mut Recorder, goal: &Goal, weights: &Weights, channel: u32) {
        let (k, b) = (&self.k, &self.b);
        let (w, h) = (self.shape.width, self.shape.height);
        let (size, target, exposure) = (
            [w, h],
            (goal.slot * self.shape.channels + channel) * self.shape.image_words() as u32,
            goal.exposure.unwrap_or_default().words(),
        );
        let (rows, columns) = (Threads::d1(w.div_ceil(RUN) * h), Threads::d1(w * h.div_ceil(RUN)));
        let mask = b.mask.part(goal.camera as usize * self.shape.mask_stride(), self.shape.image_words());
        let (plane, group) = (channel * w * h, channel * image_groups(w, h));
        let valid = (self.valid_pixels[goal.camera as usize].max(1) * self.shape.channels) as f32;
        rec.dispatch(
            &k.ssim_rows,
            ssim_rows::Bind {
                grey: b.rendered.read(),
                targets: b.targets.read(),
                mask: mask.read(),
                filtered: b.over.filtered.write(),
            },
            ssim_rows::Push { size, target, plane, exposure },
            rows,
        );
        rec.dispatch(
            &k.ssim_columns,
            ssim_columns::Bind {
                filtered: b.over.filtered.read(),
                mask: mask.read(),
                slopes: b.over.slopes.write(),
                ssim_sums: b.ssim_sums.write(),
            },
            ssim_columns::Push { size, group },
            columns,
        );
        rec.dispatch(
            &k.loss_rows,
            loss_rows::Bind { slopes: b.over.slopes.read(), filtered: b.over.filtered.write() },
            loss_rows::Push { size },
            rows,
        );
        rec.dispatch(
            if goal.exposure.is_some() { &k.loss_columns_exposure } else { &k.loss_columns },
            loss_columns::Bind {
                filtered: b.over.filtered.read(),
                grey: b.rendered.read(),
                targets: b.targets.read(),
                mask: mask.read(),
                grey_gradient: b.pixel_gradient.write(),
                loss_sums: b.loss_sums.write(),
            },
            loss_columns::Push {
                size,
                target,
                plane,
                group,
                exposure,
                l1_weight: (1.0 - weights.ssim) / valid,
                ssim_weight: weights.ssim / valid,
            },
            columns,
        );
    }

    pub(super) fn record_update(
        &self,
        rec: &mut Recorder,
        view: &View,
        by_tile: Pairs,
        rates: Option<&LearningRates>,
        weights: &Weights,
    ) {
        let (k, b) = (&self.k, &self.b);
        let size = size(view);
        rec.dispatch(
            &k.raster_backward,
            raster_backward::Bind {
                ranges: b.ranges.read(),
                intersections: by_tile.payload.read(),
                owners: b.owners.read(),
                projected_in: b.projected.read(),
                chroma: b.chroma.read(),
                rendered: b.rendered.read(),
                pixel_gradient: b.pixel_gradient.read(),
                isect_gradients: b.over.isect_gradients.write(),
            },
            raster_backward::Push { size },
            Threads::d1((self.tiles(view) + 1) * self.tiling.lanes),
        );
        if let Some(sum_chunks) = &k.sum_chunks {
            let slots = sum_chunks::Bind {
                isect_count: b.isect_count.read(),
                owners: b.owners.read(),
                isect_gradients: b.over.isect_gradients.read_write(),
            };
            rec.dispatch_indirect(sum_chunks, slots, (), b.isect_count, 2);
        }
        if let (Some(chroma_backward), Some(rates)) = (&k.chroma_backward, rates) {
            let chroma = chroma_backward::Bind {
                visible_count: b.visible_count.read(),
                slots: b.ranked.read(),
                tile_offsets: b.tile_offsets.read(),
                steps: b.steps.read(),
                isect_gradients: b.over.isect_gradients.cast().read(),
                chroma: b.chroma.read_write(),
                chroma_moments: b.chroma_moments.read_write(),
            };
            let push = chroma_backward::Push { capacity: self.shape.intersections, rate: rates.colour };
            rec.dispatch(chroma_backward, chroma, push, Threads::d1(self.high_water));
        }
        let update = if rates.is_some() { &k.project_backward } else { &k.project_backward_still };
        let rates = rates.copied().unwrap_or_default();
        rec.dispatch(
            update.of(view),
            project_backward::Bind {
                visible_count: b.visible_count.read(),
                slots: b.ranked.read(),
                tile_offsets: b.tile_offsets.read(),
                isect_gradients: b.over.isect_gradients.cast().read(),
                splats: b.splats.read_write(),
                moments_in_out: b.moments.read_write(),
                steps: b.steps.read_write(),
                sums: b.pose_sums.write(),
            },
            project_backward::Push {
                camera: camera(view),
                size,
                capacity: self.shape.intersections,
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
            Threads::d1(self.high_water),
        );
    }

    pub(super) fn record_summary(&self, rec: &mut Recorder, image_groups: u32, splat_groups: u32) {
        let b = &self.b;
        rec.dispatch(
            &self.k.summary,
            summary::Bind {
                visible_count: b.visible_count.read(),
                isect_count: b.isect_count.read(),
                failed: b.failed.read(),
                ssim_sums: b.ssim_sums.read(),
                loss_sums: b.loss_sums.read(),
                sums: b.pose_sums.read(),
                status_out: b.status.write(),
            },
            summary::Push { image_groups, splat_groups },
            Threads::groups(1, 1, 1),
        );
    }
}

fn project_backward_of(
    gpu: &mut Gpu,
    shape: &Shape,
    tiling: Tiling,
    learn: bool,
) -> Result<ByLens<project_backward::K>, Fault> {
    let channels = shape.channels;
    let mut of = |fisheye| gpu.kernel(project_backward::Spec { channels, chunk: tiling.chunk, fisheye, learn });
    Ok(ByLens { pinhole: of(false)?, fisheye: of(true)? })
}

fn plain<K: KernelDef>(gpu: &mut Gpu) -> Result<Kernel<K>, Fault>
where
    K::Spec: Default,
{
    gpu.kernel::<K>(K::Spec::default())
}
