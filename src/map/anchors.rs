//! What makes an anchor of a keyframe: how much of its view the map lacks, stereo depth, seeds, and densification.
//!
//! ```text
//! rendered -> covered and right -------------------------------> stored, to be trained on with the rest
//!          -> uncovered or mismatched: seeds on its depth --> burst -> densified -> stored
//! ```
//!
//! An anchor costs the other views: its seeds stand before what they see, and are in its exposure; where the steps to make
//! that good do not come, the map ends worse than it was. Hence what is only mismatched waits until the last anchor had
//! time to show what it is good for, seeds are faint and no more than steps can train, a burst trains the other views as
//! well, and exposures start without what earlier ones learnt of blur.
//!
//! An anchor opens a block of the pool; what its seeds and its densification need and is not free is taken from the least
//! important, if the board lets. What it adds where an earlier visit left Gaussians takes the place of as many of the least
//! important: in other light a room that is seen again is wrong nearly everywhere, and would double with each visit.

use super::archive::Archive;
use super::cameras::{RectifiedPair, TrainingCamera};
use super::coarseness::Coarseness;
use super::coverage::{Coverage, KeyframeView};
use super::densify::{densify, mean};
use super::diffusion::Diffusion;
use super::evaluate;
use super::horizon::Horizon;
use super::keyframes::Keyframe;
use super::occupancy::{self, Occupancy};
use super::parts::PARTS;
use super::pool::FREE_DIVISOR;
use super::scene::Scene;
use super::seam::depth_disagreement;
use super::seeds::{Seed, Seeder};
use super::view::View;
use super::views::Views;
use crate::config::MapConfig;
use crate::gpu::{Gpu, GpuError};
use crate::mem::unsealed;
use crate::stereo::{DepthMap, RectifiedViews, Stereo};
use std::time::Instant;
use stipple_drivers::{Fault, Image};

/// Part of a view that must have depth to seed from; the rest is continued from it.
const DEPTH_MIN: f64 = 0.01;
/// Steps a keyframe that anchors count on, however few they were so far: the first, which is all there is to see, and others.
const STEPS_FIRST: usize = 40;
const STEPS_MIN: usize = 8;
/// A whole uncovered view may take one in so many of the pool where others are evicted for it.
const POOL_DIVISOR: usize = 16;

/// Anchors that tell how far the map's surfaces are from those of stereo.
const JUDGED: usize = 4;
/// Seeds lie where an earlier visit left Gaussians if they share a cell that is so many times as wide as the occupancy grid's:
/// depth is no better far away.
const VISIT_CELLS: f32 = 5.0;

/// A keyframe that became an anchor.
#[derive(Clone, Copy, Debug)]
pub struct NewAnchor {
    pub seeded: u32,
    /// Median depth of the first anchor, m.
    pub scene_depth_m: Option<f64>,
}

/// Host memory of the making of anchors.
pub struct Workspace {
    /// Depth of the newest anchor, m.
    depth: DepthMap,
    seeder: Seeder,
    diffusion: Diffusion,
    newcomers: Vec<Seed>,
    /// The occupancy's, by seed.
    answers: Vec<u32>,
    /// Its answers where only Gaussians of earlier visits count.
    earlier: Vec<u32>,
    /// SSIM of the newest anchor by pixel, with room for more channels.
    similarity: Vec<f32>,
}

impl Workspace {
    pub fn new(width: usize, height: usize, channels: usize, config: &MapConfig) -> Workspace {
        let seeds_max = config.seeds_per_anchor as usize;
        Workspace {
            depth: DepthMap::new(width, height),
            seeder: Seeder::new(width, height, seeds_max, config.wrong_error),
            diffusion: Diffusion::new(width, height),
            newcomers: Vec::with_capacity(config.densify_max as usize),
            answers: Vec::with_capacity(seeds_max),
            earlier: Vec::with_capacity(seeds_max),
            similarity: Vec::with_capacity(channels * width * height),
        }
    }
}

pub struct Anchors {
    config: MapConfig,
    /// The newest keyframe without distortion, where that is not what trains.
    pair: Option<RectifiedPair>,
    work: Workspace,
    occupancy: Occupancy,
    /// Steps when the last anchor came.
    anchored_at: u64,
    /// Part of its seeds that lie where an earlier visit left Gaussians.
    seen_part: f64,
    /// `depth_disagreement` of the newest.
    disagreements: [Option<f64>; JUDGED],
    /// Pairs that were matched, and the time it took, s.
    pub matched: (u64, f64),
}

impl Anchors {
    pub fn new(
        gpu: &mut Gpu,
        buffers: occupancy::Buffers,
        work: Workspace,
        pair: Option<RectifiedPair>,
        config: &MapConfig,
    ) -> Result<Anchors, Fault> {
        let occupancy = Occupancy::new(gpu, buffers, config.occupancy_cell_m)?;
        Ok(Anchors {
            config: config.clone(),
            pair,
            work,
            occupancy,
            anchored_at: 0,
            seen_part: 0.0,
            disagreements: [None; JUDGED],
            matched: (0, 0.0),
        })
    }

    /// Mean `depth_disagreement` of the newest anchors.
    pub fn disagreement(&self) -> Option<f64> {
        evaluate::mean(&self.disagreements)
    }

    /// Takes over another rectification.
    pub fn adjust(&mut self, views: &RectifiedViews, left: &TrainingCamera) {
        self.pair.iter_mut().for_each(|pair| pair.adjust(views, left));
    }

    /// Makes stored image `index`, the first of `keyframe`, an anchor when the map, on disk or in the pool, does not show its
    /// view, or not well.
    pub fn try_anchor(
        &mut self,
        scene: &mut Scene,
        stereo: &mut Stereo,
        archive: &mut Option<Archive>,
        keyframe: &Keyframe,
        index: usize,
    ) -> Result<Option<NewAnchor>, GpuError> {
        if let Some(pair) = &mut self.pair {
            for (channel, plane) in pair.planes.iter_mut().enumerate() {
                stereo.views.rectify(0, keyframe.plane(0, channel), plane);
            }
        }
        // Seeds come of the rectified pair, whatever the lens of what trains.
        let rect = stereo.views.camera();
        let world_from_cam = scene.views.world_from_body(index) * rect.body_from_rect;
        let (coarseness, epoch) = (Coarseness::default(), keyframe.epoch);
        let view = View { world_from_cam, camera: rect.pinhole, fisheye: None, coarseness, epoch };
        self.render(scene, archive, index, &view)?;
        let coverage = {
            let seen = seen(scene, &self.pair, index, &view, stereo.views.valid_mask(), &self.work.depth);
            Coverage::new(&seen, self.config.covered_alpha, self.config.wrong_error)
        };
        let least = self.config.anchor_missing_min;
        let proven = scene.steps - self.anchored_at >= u64::from(self.config.wrong_after_steps);
        if coverage.uncovered <= least && (coverage.lacking() <= least || !proven) {
            scene.counters.views_covered.add(1);
            return Ok(None);
        }
        if !self.match_depth(scene, stereo, keyframe) {
            return Ok(None);
        }
        if let Some(found) = depth_disagreement(&scene.rendered, &self.work.depth.metres, stereo.views.valid_mask()) {
            self.disagreements.rotate_right(1);
            self.disagreements[0] = Some(found);
        }
        if let Some(pair) = &mut self.pair {
            pair.distort(&self.work.depth, &view.camera);
        }
        // Where depth finds what is on disk, nothing is lacking.
        let mut horizon = Horizon::of(&scene.rendered);
        horizon.fill(&self.work.depth.metres, view.camera.width);
        if self.pair.is_none() {
            scene.views.get_mut(index).horizon = horizon;
            let own = scene.view(index);
            archive.iter_mut().for_each(|a| a.look_from(&own, &horizon, index / scene.views.cameras()));
        }
        let hidden = archive.as_mut().and_then(|a| a.hide(&view, &horizon, stereo.views.valid_mask()));
        let valid = hidden.unwrap_or(stereo.views.valid_mask());
        let coverage = if hidden.is_some() {
            let seen = seen(scene, &self.pair, index, &view, valid, &self.work.depth);
            Coverage::new(&seen, self.config.covered_alpha, self.config.wrong_error)
        } else {
            coverage
        };
        if coverage.lacking() <= least {
            scene.counters.anchors_on_disk.add(1);
            return Ok(None);
        }
        let first = scene.views.anchors() == 0;
        let whole = self.seeds_of_a_view(scene);
        let wanted = (coverage.lacking() * whole as f64).ceil() as usize;
        let before = scene.pipeline.pool.count() as usize;
        let room = scene.make_room(wanted, self.config.evict)?;
        if room == 0 && !self.config.evict {
            return Ok(None);
        }
        if !scene.pipeline.pool.open_block(index as u32 * PARTS, keyframe.epoch) {
            scene.counters.blocks_full.add(1);
            return Ok(None);
        }
        let (seeded, again) = self.seed(scene, index, &view, valid, (whole, room))?;
        self.seen_part = again as f64 / seeded.max(1) as f64;
        self.replace(scene, before, seeded)?;
        scene.counters.anchors_for_error.add(u64::from(coverage.uncovered <= least));
        self.anchored_at = scene.steps;
        let entry = scene.views.get_mut(index);
        (entry.anchor, entry.placed) = (true, entry.world_from_cam());
        let scene_depth_m = if first { median_depth(&self.work.depth.metres) } else { None };
        Ok(Some(NewAnchor { seeded: seeded as u32, scene_depth_m }))
    }

    /// Draws what the rectified pair should see into the scene, and exposes the new image by what trains.
    fn render(
        &self,
        scene: &mut Scene,
        archive: &mut Option<Archive>,
        index: usize,
        rectified: &View,
    ) -> Result<(), GpuError> {
        // Without distortion, what lies beyond a fisheye's rim is drawn across the picture: it tells no exposure.
        let own = View { coarseness: Coarseness::default(), ..scene.view(index) };
        let coarseness = scene.render(if self.pair.is_some() { &own } else { rectified })?;
        scene.views.get_mut(index).coarseness = coarseness;
        if self.config.refine_exposure {
            scene.expose(index);
        }
        if let Some(archive) = archive {
            archive.saw(scene, index);
        }
        if self.pair.is_some() {
            scene.render(rectified)?;
        }
        Ok(())
    }

    /// Whether the pair could be matched. One that cannot gives no depth, and no anchor; the keyframe is still trained on.
    fn match_depth(&mut self, scene: &mut Scene, stereo: &mut Stereo, keyframe: &Keyframe) -> bool {
        let depth = &mut self.work.depth;
        let [left, right, ..] = &keyframe.images[..] else { return false };
        let start = Instant::now();
        let found = unsealed(|| stereo.depth(Some(&mut scene.gpu), left, right, depth));
        self.matched = (self.matched.0 + 1, self.matched.1 + start.elapsed().as_secs_f64());
        let Ok(found) = found else {
            scene.counters.depth_failures.add(1);
            return false;
        };
        let enough = found as f64 >= DEPTH_MIN * depth.metres.len() as f64;
        scene.counters.depth_absent.add(u64::from(!enough));
        enough
    }

    /// Seeds as dense as `whole` for a view, `room` at most; how many, and how many where an earlier visit left Gaussians.
    fn seed(
        &mut self,
        scene: &mut Scene,
        index: usize,
        view: &View,
        valid: &[u8],
        (whole, room): (usize, usize),
    ) -> Result<(usize, usize), GpuError> {
        let Workspace { depth, seeder, diffusion, answers, earlier, .. } = &mut self.work;
        let seen = seen(scene, &self.pair, index, view, valid, depth);
        let points = seeder.seed(&seen, whole, diffusion, &scene.counters);
        let Scene { gpu, pipeline, views, counters, .. } = scene;
        let pool = &pipeline.pool;
        self.occupancy.look_up(gpu, pool, (std::iter::once(pool.slots(view.epoch)), 1.0), points, answers)?;
        let anchor = |number: u32| views.get((number / PARTS) as usize);
        let left = pool.slots_of(|n| anchor(n).epoch == view.epoch && anchor(n).visited_again);
        self.occupancy.look_up(gpu, pool, (left, VISIT_CELLS), points, earlier)?;
        let (exposure, planes) = (views.exposure(index), planes(views, &self.pair, index));
        let (seeds, again) = seeder.keep(answers, earlier, room, counters);
        let splats = seeds.iter().map(|s| s.gaussian(planes, exposure));
        Ok((pipeline.pool.append(gpu, splats)?, again))
    }

    /// Takes from the pool, which held so many `before`, about as many as were added where an earlier visit left Gaussians.
    fn replace(&self, scene: &mut Scene, before: usize, added: usize) -> Result<(), GpuError> {
        let new = (added as f64 * (1.0 - self.seen_part)).ceil() as usize;
        let surplus = (scene.pipeline.pool.count() as usize).saturating_sub(before + new);
        if self.config.evict && surplus > 0 {
            scene.prune(surplus, surplus + surplus / 4)?;
        }
        Ok(())
    }

    /// Adds Gaussians where the newest anchor's picture is least like its image, through the lens that trains.
    pub fn densify(&mut self, scene: &mut Scene, archive: &mut Option<Archive>, index: usize) -> Result<(), GpuError> {
        self.fill_in(scene, index)?;
        let Some(archive) = archive else { return Ok(()) };
        if let Some(block) = archive.block_of(index as u32 * PARTS).filter(|b| archive.blocks[*b].in_pool) {
            archive.complete(scene, block)?;
            let view = scene.view(index);
            scene.render(&view)?;
            archive.saw(scene, index);
        }
        Ok(())
    }

    fn fill_in(&mut self, scene: &mut Scene, index: usize) -> Result<(), GpuError> {
        if self.config.densify_max == 0 || scene.pipeline.pool.newest() != Some(index as u32 * PARTS) {
            return Ok(());
        }
        let (view, target) = (scene.view(index), scene.target(index));
        scene.render(&view)?;
        scene.pipeline.similarity(&mut scene.gpu, &target, &mut self.work.similarity)?;
        let lacking = 0.5 * (1.0 - mean(&self.work.similarity, &scene.camera(index).valid));
        let wanted = (f64::from(self.config.densify_max) * lacking) as usize;
        let wanted = wanted.min(self.affordable(scene));
        let before = scene.pipeline.pool.count() as usize;
        let wanted = wanted.min(scene.make_room(wanted, self.config.evict)?);
        let Workspace { depth, diffusion, newcomers, similarity, .. } = &mut self.work;
        let DepthMap { metres: depth, sigma_m: depth_sigma_m, .. } =
            self.pair.as_ref().map_or(&*depth, |pair| &pair.distance);
        let planes = scene.views.planes(index);
        let (valid, rendered, exposure) = (&scene.cameras[0].valid, &scene.rendered, target.exposure);
        let seen = KeyframeView { planes, valid, depth, depth_sigma_m, rendered, exposure, view };
        densify(&seen, similarity, wanted, diffusion, newcomers, &scene.counters);
        let splats = newcomers.iter().map(|s| s.gaussian(planes, target.exposure));
        let added = scene.pipeline.pool.append(&mut scene.gpu, splats)?;
        scene.counters.splats_densified.add(added as u64);
        self.replace(scene, before, added)
    }

    /// Seeds for a view that is all uncovered.
    fn seeds_of_a_view(&self, scene: &Scene) -> usize {
        let pool = &scene.pipeline.pool;
        let share = if self.config.evict { pool.capacity() / POOL_DIVISOR } else { pool.room().div_ceil(FREE_DIVISOR) };
        share.min(self.config.seeds_per_anchor as usize).min(self.affordable(scene))
    }

    /// Gaussians that an anchor may add at the steps a keyframe gets here: more than are trained cost every later step
    /// its time and give nothing back.
    fn affordable(&self, scene: &Scene) -> usize {
        let steps = (scene.steps / scene.views.own_training().len().max(1) as u64) as usize;
        match self.config.seeds_per_step as usize {
            0 => usize::MAX,
            limit => limit * steps.max(if scene.views.anchors() == 0 { STEPS_FIRST } else { STEPS_MIN }),
        }
    }
}

/// The image that seeds take their colour from.
fn planes<'a>(views: &'a Views, pair: &'a Option<RectifiedPair>, index: usize) -> &'a [Image] {
    pair.as_ref().map_or_else(|| views.planes(index), |pair| &pair.planes)
}

/// What a new keyframe sees without distortion, beside the scene's last picture, which was drawn from there.
fn seen<'a>(
    scene: &'a Scene,
    pair: &'a Option<RectifiedPair>,
    index: usize,
    view: &View,
    valid: &'a [u8],
    DepthMap { metres: depth, sigma_m: depth_sigma_m, .. }: &'a DepthMap,
) -> KeyframeView<'a> {
    let (planes, exposure) = (planes(&scene.views, pair, index), scene.views.exposure(index));
    KeyframeView { planes, valid, depth, depth_sigma_m, rendered: &scene.rendered, exposure, view: *view }
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
    use super::median_depth;

    #[test]
    fn median_depth_ignores_holes() {
        assert_eq!(median_depth(&[0.0; 9]), None);
        let z = median_depth(&[0.0, 0.0, 1.0, 2.0, 9.0, 0.0]).expect("three have depth");
        assert!((z - 2.0).abs() < 0.1, "{z}");
    }
}
