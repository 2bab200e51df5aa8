//! The map as it stands: Gaussians on the device, the keyframes that they are trained on, and the cameras that saw these.

use super::cameras::TrainingCamera;
use super::coarseness::Coarseness;
use super::exposure::{gain_from, median_exposure, Exposure};
use super::parts::PARTS;
use super::pipeline::Pipeline;
use super::pool::{threshold, PruneRule};
use super::render::Rendered;
use super::step::{Stats, Target};
use super::view::View;
use super::views::{Stored, Views};
use crate::counters::Counters;
use crate::gpu::{Gpu, GpuError};
use stipple_drivers::Pose;

/// Fewer steps than this and a Gaussian's importance is not known.
const STEPS_JUDGED: u32 = 30;
/// One in so many of the pool may be evicted at a time.
const EVICTED_DIVISOR: usize = 16;

pub struct Scene {
    pub gpu: Gpu,
    pub pipeline: Pipeline,
    pub views: Views,
    pub cameras: Vec<TrainingCamera>,
    /// The last picture.
    pub rendered: Rendered,
    /// Training steps started.
    pub steps: u64,
    pub counters: Counters,
}

impl Scene {
    /// The camera of a stored image.
    pub fn camera(&self, index: usize) -> &TrainingCamera {
        &self.cameras[self.views.camera(index)]
    }

    /// Where a stored image was taken, as far as is known.
    pub fn view(&self, index: usize) -> View {
        self.view_from(index, self.views.world_from_body(index))
    }

    /// What the camera of a stored image sees where the body is at another pose.
    pub fn view_from(&self, index: usize, world_from_body: Pose) -> View {
        let Stored { coarseness, epoch, body_from_cam, .. } = *self.views.get(index);
        let TrainingCamera { camera, fisheye, .. } = *self.camera(index);
        View { coarseness, epoch, ..View::new(world_from_body * body_from_cam, camera, fisheye) }
    }

    /// What a picture of a stored image is compared with, at its full size.
    pub fn target(&self, index: usize) -> Target {
        Target {
            image: self.views.image(index) as u32,
            camera: self.views.camera(index) as u32,
            exposure: self.views.exposure(index),
            absent: self.views.get(index).absent,
            half_size: false,
        }
    }

    /// Brings the planes of a view that has a place to the device.
    pub fn upload_image(&mut self, index: usize) -> Result<(), GpuError> {
        let image = self.views.image(index) as u32;
        for (channel, plane) in self.views.planes(index).iter().enumerate() {
            self.pipeline.loss.set_plane(&mut self.gpu, image, channel, &plane.pixels)?;
        }
        Ok(())
    }

    /// Removes what is faint, huge or not finite, and with `evict`, where that leaves less room than wanted, the least
    /// important. Answers the room there is then.
    pub fn make_room(&mut self, wanted: usize, evict: bool) -> Result<usize, GpuError> {
        let pool = &self.pipeline.pool;
        let lacks = if evict { wanted.saturating_sub(pool.room()) } else { 0 };
        self.prune(lacks, pool.capacity() / EVICTED_DIVISOR)?;
        Ok(self.pipeline.pool.room())
    }

    /// Removes what is faint, huge or not finite, and about `evicted` of the least important, never more than `most` of them.
    pub fn prune(&mut self, evicted: usize, most: usize) -> Result<(), GpuError> {
        let (gpu, pool) = (&mut self.gpu, &mut self.pipeline.pool);
        let mut rule = PruneRule { steps_min: STEPS_JUDGED, ..PruneRule::default() };
        let mut unimportant = 0;
        if evicted > 0 {
            let bins = pool.importance(gpu, STEPS_JUDGED)?;
            (rule.importance_min, unimportant) = threshold(&bins, evicted, most);
        }
        let removed = pool.prune(gpu, &rule)?;
        self.counters.splats_evicted.add(unimportant.min(removed) as u64);
        self.counters.splats_pruned.add(removed.saturating_sub(unimportant) as u64);
        Ok(())
    }

    /// Draws the map into `rendered`; how coarsely, that the view might fit.
    pub fn render(&mut self, view: &View) -> Result<Coarseness, GpuError> {
        let Stats { coarseness, intersections, .. } = self.pipeline.render(&mut self.gpu, view, &mut self.rendered)?;
        self.counters.views_coarsened.add(u64::from(coarseness > Coarseness::default()));
        self.counters.intersections_most.raise(u64::from(intersections));
        Ok(coarseness)
    }

    /// Takes the gain of a new image from what `rendered`, its view, already shows of it. The first is the gauge.
    pub fn expose(&mut self, index: usize) {
        if self.views.training().first() == Some(&(index as u32)) {
            return;
        }
        let guess = self.views.get(index).refined.exposure;
        if let Some(gain) = gain_from(self.views.planes(index), guess, &self.rendered, &self.camera(index).valid) {
            self.views.get_mut(index).refined.exposure.gain = gain;
        }
    }

    /// Puts the Gaussians of anchors that were corrected by more than `tolerance` (m, rad) where their anchors are now;
    /// these are counted.
    pub fn apply_corrections(&mut self, tolerance: f64) -> Result<(), GpuError> {
        let displaced = self.views.displaced(tolerance).inspect(|_| self.counters.blocks_moved.add(1));
        let pool = &self.pipeline.pool;
        let parts = |(anchor, by): (u32, Pose)| (anchor * PARTS..(anchor + 1) * PARTS).map(move |part| (part, by));
        pool.move_blocks(&mut self.gpu, displaced.flat_map(parts).filter(|(part, _)| pool.holds(*part)))
    }

    /// The exposure of the median training view: what takes the map's colours, whose gauge is none of a camera's, to what
    /// most images show. Allocates.
    pub fn median_exposure(&self) -> Exposure {
        let exposures: Vec<Exposure> = self.views.training().iter().map(|i| self.views.exposure(*i as usize)).collect();
        median_exposure(&exposures).unwrap_or_default()
    }
}
