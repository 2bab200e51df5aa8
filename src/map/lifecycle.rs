//! What becomes of a keyframe: stored to be trained on with the rest (the pool), or made an anchor.
//!
//! ```text
//! rendered -> covered and right ------------------------------------> pool
//!          -> bare or wrong: seeds on its depth --> burst -> densified -> pool
//! ```
//!
//! An anchor costs the other views: its seeds stand before what they see, and are in its exposure. Where the steps to make
//! that good do not come, the map ends worse than it was; V1_01 at 28 steps a second fell from 25 to 19.6 dB in its last ten
//! seconds, which have a third of its keyframes. Hence what is only wrong waits until the last anchor had time to show what
//! it is good for, seeds are faint and no more than steps can train, a burst trains the other views as well, and exposures
//! start without what earlier ones learnt of blur: 24.6 dB.
//!
//! What there were no steps for when a view came is not made up for once a flight rests: to densify such views again, one a
//! lap and where alpha allows, gained 0.1 to 0.6 dB on six simulated flights of 10 s and 50 s of rest, but 0.07 dB held out,
//! and nothing on V1_01.
//!
//! An anchor opens a block of the pool; what its seeds and its densification need and is not free is taken from the
//! least important, if the board lets (`budget`).

use super::anchors::{self, Missing};
use super::budget::threshold;
use super::densify::mean;
use super::eyes;
use super::pipeline::{PruneRule, View};
use super::{median_depth, Did, Mapper, SCENE_DEPTH_M};
use crate::gpu::GpuError;
use crate::mem::unsealed;

/// What anchor `$index` sees of the last rendering, which was `$from` there; fields are borrowed one by one, so that the
/// seeder is still free.
macro_rules! seen {
    ($mapper:ident, $index:ident, $from:expr, $planes:expr, $valid:expr, $depth:expr) => {
        anchors::Seen {
            planes: $planes,
            valid: $valid,
            depth: $depth,
            alpha: &$mapper.rendered.alpha,
            colour: &$mapper.rendered.colour,
            exposure: $mapper.store.exposure($index),
            rendered_depth: &$mapper.rendered.depth,
            from: $from,
        }
    };
}

/// Part of a view that must have depth to seed from; the rest is continued from it.
const DEPTH_MIN: f64 = 0.01;
/// Fewer steps than this and a Gaussian's importance is not known.
const STEPS_JUDGED: u32 = 30;
/// Steps a keyframe that anchors count on, however few they were so far: the first, which is all there is to see, and others.
const STEPS_FIRST: usize = 40;
const STEPS_MIN: usize = 8;
/// Part of the pool that one anchor may evict.
const EVICTED_MAX: usize = 16;
/// Part of what is free that a whole uncovered view may take, so that there is always room for the next; and part of
/// the pool where others are evicted for it.
const FREE_SHARE: usize = 8;
const POOL_SHARE: usize = 16;

impl Mapper {
    /// Stores the oldest waiting keyframe, and makes it an anchor when the map does not show its view, or not well.
    pub(super) fn take_in(&mut self) -> Result<Did, GpuError> {
        self.settle()?;
        let Some(keyframe) = self.queue.front() else { return Ok(Did::Idle) };
        if self.store.is_full() {
            self.counters.keyframe_store_full.add(1);
            self.queue.pop();
            return Ok(Did::Dropped);
        }
        let index = self.store.len();
        for (i, eye) in self.eyes.iter().enumerate() {
            self.store.add(keyframe, |channel, plane| {
                eyes::draw(i, eye, &mut self.stereo, eyes::raw(keyframe, i, channel), plane);
            });
            for (channel, plane) in self.store.planes(index + i).iter().enumerate() {
                self.pipeline.set_plane(&mut self.gpu, (index + i) as u32, channel, &plane.pixels)?;
            }
        }
        if let Some(pair) = &mut self.pair {
            for (channel, plane) in pair.planes.iter_mut().enumerate() {
                self.stereo.rectify(eyes::raw(keyframe, 0, channel), plane);
            }
        }
        let did = if self.store.get(index).held_out { Did::Stored } else { self.cover(index)? };
        self.queue.pop();
        Ok(did)
    }

    /// Seeds come of the rectified pair, whatever the lens of what trains.
    fn rectified(&self, index: usize) -> View {
        let rect = self.stereo.camera();
        let world_from_cam = self.store.world_from_body(index) * rect.body_from_rect;
        View { world_from_cam, camera: rect.pinhole, fisheye: None }
    }

    fn cover(&mut self, index: usize) -> Result<Did, GpuError> {
        let view = self.rectified(index);
        if self.pair.is_some() {
            // Without distortion, what lies beyond a fisheye's rim is drawn across the picture: it tells no exposure.
            let own = self.view(index);
            self.pipeline.render(&mut self.gpu, &own, &mut self.rendered)?;
            self.expose(index);
        }
        self.pipeline.render(&mut self.gpu, &view, &mut self.rendered)?;
        if self.pair.is_none() {
            self.expose(index);
        }
        let planes = self.pair.as_ref().map_or_else(|| self.store.planes(index), |pair| &pair.planes);
        let seen = seen!(self, index, view, planes, self.stereo.valid_mask(), &self.depth);
        let Missing { bare, wrong } = Missing::of(&seen, self.config.covered_alpha, self.config.wrong_error);
        let least = self.config.anchor_missing_min;
        let proven = self.iterations - self.anchored_at >= u64::from(self.config.wrong_after_steps);
        if bare <= least && (bare + wrong <= least || !proven) {
            return Ok(Did::Stored);
        }
        let Some(keyframe) = self.queue.front() else { return Ok(Did::Stored) };
        let [left, right, ..] = &keyframe.images[..] else { return Ok(Did::Stored) };
        // A pair that cannot be matched gives no depth, and no anchor; the keyframe is still trained on.
        let Ok(found) = unsealed(|| self.stereo.depth(Some(&mut self.gpu), left, right, &mut self.depth)) else {
            self.counters.depth_failures.add(1);
            return Ok(Did::Stored);
        };
        if (found as f64) < DEPTH_MIN * self.depth.metres.len() as f64 {
            self.counters.depth_absent.add(1);
            return Ok(Did::Stored);
        }
        if let Some(pair) = &mut self.pair {
            pair.bend(&self.depth, &view.camera);
        }
        if self.store.anchors() == 0 {
            self.scene_depth_m = median_depth(&self.depth.metres).unwrap_or(SCENE_DEPTH_M);
        }
        let whole = self.seeds_of_a_view();
        let wanted = ((bare + wrong) * whole as f64).ceil() as usize;
        let room = self.make_room(wanted)?;
        if room == 0 && !self.config.evict {
            return Ok(Did::Stored);
        }
        self.pipeline.open_block(index as u32);
        let planes = self.pair.as_ref().map_or_else(|| self.store.planes(index), |pair| &pair.planes);
        let seen = seen!(self, index, view, planes, self.stereo.valid_mask(), &self.depth);
        let points = self.seeder.seed(&seen, whole, &self.counters);
        self.occupancy.look(&mut self.gpu, &self.pipeline, points, &mut self.answers)?;
        let seeds = self.seeder.settle(&self.answers, room, &self.counters);
        let splats = seeds.iter().map(|s| s.gaussian(planes, seen.exposure));
        let seeded = self.pipeline.append(&mut self.gpu, splats)? as u32;
        self.counters.anchors_for_error.add(u64::from(bare <= least));
        self.anchored_at = self.iterations;
        let entry = self.store.get_mut(index);
        (entry.anchor, entry.placed) = (true, entry.given);
        self.schedule.start_burst(index, self.config.burst_iterations);
        Ok(Did::Anchor { seeded })
    }

    /// Seeds for a view that is all bare.
    fn seeds_of_a_view(&self) -> usize {
        let pool = self.pipeline.shape().splats as usize;
        let share = if self.config.evict { pool / POOL_SHARE } else { self.room().div_ceil(FREE_SHARE) };
        share.min(self.config.seeds_per_anchor as usize).min(self.affordable())
    }

    /// Gaussians that an anchor may add at the steps a keyframe gets here: more than are trained cost every later step
    /// its time and give nothing back.
    fn affordable(&self) -> usize {
        let steps = self.iterations / self.store.training().len().max(1) as u64;
        match self.config.seeds_per_step as usize {
            0 => usize::MAX,
            limit => limit * (steps as usize).max(if self.store.anchors() == 0 { STEPS_FIRST } else { STEPS_MIN }),
        }
    }

    /// Removes what is faint, huge or not finite, and where that leaves less room than wanted, the least important.
    /// Answers the room there is then.
    fn make_room(&mut self, wanted: usize) -> Result<usize, GpuError> {
        let mut rule = PruneRule { steps_min: STEPS_JUDGED, ..PruneRule::default() };
        let mut evicted = 0;
        if self.config.evict && self.room() < wanted {
            let bins = self.pipeline.importance(&mut self.gpu, STEPS_JUDGED)?;
            let most = self.pipeline.shape().splats as usize / EVICTED_MAX;
            (rule.importance_min, evicted) = threshold(&bins, wanted - self.room(), most);
        }
        let removed = self.pipeline.prune(&mut self.gpu, &rule)?;
        self.counters.splats_evicted.add(evicted.min(removed) as u64);
        self.counters.splats_pruned.add(removed.saturating_sub(evicted) as u64);
        Ok(self.room())
    }

    /// Adds Gaussians where the newest anchor's picture is least like its image, through the lens that trains.
    pub(super) fn densify(&mut self, index: usize) -> Result<(), GpuError> {
        if self.config.densify_max == 0 || self.pipeline.newest() != Some(index as u32) {
            return Ok(());
        }
        let view = self.view(index);
        self.pipeline.render(&mut self.gpu, &view, &mut self.rendered)?;
        let goal = self.goal(index);
        self.pipeline.similarity(&mut self.gpu, goal, &mut self.similarity)?;
        let lacking = 0.5 * (1.0 - mean(&self.similarity, &self.eye(index).valid));
        let wanted = (f64::from(self.config.densify_max) * lacking) as usize;
        let wanted = wanted.min(self.affordable());
        let wanted = wanted.min(self.make_room(wanted)?);
        let depth = self.pair.as_ref().map_or(&self.depth, |pair| &pair.distance);
        let planes = self.store.planes(index);
        let seen = seen!(self, index, view, planes, &self.eyes[0].valid, depth);
        let seeds = self.seeder.densify(&seen, &self.similarity, wanted, &self.counters);
        let splats = seeds.iter().map(|s| s.gaussian(planes, seen.exposure));
        let added = self.pipeline.append(&mut self.gpu, splats)?;
        self.counters.splats_densified.add(added as u64);
        Ok(())
    }
}
