//! Which images are in memory: those of the views that are trained on next.
//!
//! Views are drawn ahead of the steps that train on them, of a few the one trained on the longest ago, for steps on others
//! have changed what it shows (`Views::draw`); images that have no place are fetched from the disk meanwhile. Where none of
//! the drawn has come, one of those that are here is drawn uniformly. Views that come and go in groups instead, each trained
//! on for a while, cost 0.75 dB (24 places for 121 views, 3255 steps, the simulator's two rooms): the map then fits the few
//! views of the last group.

use super::archive::Archive;
use super::choice::{newest_kept, Drawn};
use super::filing::read_planes;
use super::horizon::CELLS;
use super::parts::PARTS;
use super::scene::Scene;
use super::schedule::Rng;
use super::views::Views;
use crate::gpu::GpuError;
use crate::store::Fetched;

/// Draws until another view is found.
const DRAWS: usize = 16;
/// Views that may be trained on for each that is drawn ahead, at least.
const TRAINABLE_AN_AHEAD: usize = 4;
/// Part of the Gaussians that a keyframe sees, and of its picture, that must be in the pool when it is trained on.
const HERE_MIN: f32 = 0.7;
/// Places for each block in the pool, below which a block's last keyframe may go, too.
const VIEWS_PER_BLOCK: usize = 3;

impl Archive {
    /// Finds the views of the present epoch that may be trained on.
    pub fn find_trainable(&mut self, views: &Views) {
        self.look_at_changed();
        let (cameras, epoch) = (views.cameras(), self.choice.epoch);
        let mut trainable = std::mem::take(&mut self.drawn.trainable);
        trainable.clear();
        for &index in views.training().iter().filter(|i| **i as usize % cameras == 0) {
            let keyframe = index as usize / cameras;
            if views.get(index as usize).epoch == epoch && self.shows_enough_of(keyframe) {
                trainable.extend(index..index + cameras as u32);
            }
        }
        self.drawn.trainable = trainable;
        self.drawn.found_at = self.exchanges;
    }

    /// Whether enough of what a keyframe sees is in the pool.
    fn shows_enough_of(&self, keyframe: usize) -> bool {
        self.known.get(keyframe).is_none_or(|known| known.away <= 1.0 - HERE_MIN)
    }

    /// The views that are trained on now.
    pub fn trained_beside(&self) -> &[u32] {
        &self.drawn.trainable
    }

    /// The next view to train on, whose images have a place; `None` when there is none.
    pub fn next_view(&mut self, scene: &mut Scene, rng: &mut Rng) -> Result<Option<usize>, GpuError> {
        if !self.growing {
            self.rehearse(scene, rng)?;
        }
        if self.drawn.found_at != self.exchanges {
            self.find_trainable(&scene.views);
        }
        // What found no place, or is damaged, does not come any more.
        let (views, cameras) = (&scene.views, scene.views.cameras());
        let known = &self.known;
        let asked = |i: &u32| known.get(*i as usize / cameras).is_some_and(|k| k.asked > 0);
        self.drawn.next.retain(|i| views.has_place(*i as usize) || asked(i));
        // Were most of them drawn ahead, their order would be fixed.
        let ahead = self.drawn.ahead.min(self.drawn.trainable.len() / TRAINABLE_AN_AHEAD).max(1);
        while self.drawn.next.len() < ahead {
            let Some(index) = self.draw(scene, rng)? else { break };
            self.drawn.next.push_back(index);
        }
        let drawn = |a: &Archive, scene: &Scene| a.drawn.next.iter().position(|index| a.is_here(&scene.views, *index));
        while let Some(index) = drawn(self, scene).and_then(|at| self.drawn.next.remove(at)) {
            // Blocks may have left since it was drawn.
            if self.shows_enough(scene, index) {
                return Ok(Some(index as usize));
            }
        }
        // The disk is slower than the steps: what is here is trained on meanwhile.
        let any = self.any_here(scene, rng);
        if any.is_none() {
            // No step comes that the next image could wait for.
            self.drawn.fetched_at = 0;
        }
        Ok(any)
    }

    /// One of the views whose images are here and that may be trained on.
    fn any_here(&mut self, scene: &mut Scene, rng: &mut Rng) -> Option<usize> {
        for _ in 0..DRAWS {
            let (mut found, mut n) = (None, 0);
            for &index in self.drawn.trainable.iter().filter(|index| self.is_here(&scene.views, **index)) {
                n += 1;
                found = if rng.below(n) == 0 { Some(index) } else { found };
            }
            let index = found?;
            if self.shows_enough(scene, index) {
                return Some(index as usize);
            }
        }
        None
    }

    /// Whether a view's images have a place and have come.
    fn is_here(&self, views: &Views, index: u32) -> bool {
        views.has_place(index as usize) && self.has_come(index, views.cameras())
    }

    fn has_come(&self, index: u32, cameras: usize) -> bool {
        self.known.get(index as usize / cameras).is_none_or(|k| k.asked == 0)
    }

    /// Draws a view, and asks for its images where they are on disk.
    fn draw(&mut self, scene: &mut Scene, rng: &mut Rng) -> Result<Option<u32>, GpuError> {
        let cameras = scene.views.cameras();
        for _ in 0..DRAWS {
            let Drawn { trainable, next, .. } = &self.drawn;
            let Some(index) = scene.views.draw(trainable, |index| !next.contains(&index), rng) else { continue };
            let keyframe = index as usize / cameras;
            if !self.shows_enough(scene, index) {
                continue;
            }
            if scene.views.has_place(index as usize) || !self.has_come(index, cameras) {
                return Ok(Some(index));
            }
            let may = self.drawn.fetched_at == 0 || scene.steps >= self.drawn.fetched_at + self.drawn.steps;
            if may && self.known[keyframe].saved && self.ask_for_images(&scene.views, keyframe) {
                self.drawn.fetched_at = scene.steps;
                self.receive(scene)?;
                return Ok(Some(index));
            }
        }
        Ok(None)
    }

    /// Whether a view is of the present epoch and shows enough of what is in the pool.
    fn shows_enough(&mut self, scene: &mut Scene, index: u32) -> bool {
        self.find_absent(scene, index as usize);
        let view = scene.views.get(index as usize);
        let hidden = view.absent.map_or(0, |absent| absent.hidden.len());
        view.epoch == self.choice.epoch && hidden as f32 <= (1.0 - HERE_MIN) * CELLS as f32
    }

    /// Finds where the views of a keyframe show what is not in the pool, if that has changed since it was last found.
    pub fn find_absent(&mut self, scene: &mut Scene, index: usize) {
        let (first, cameras) = (scene.views.first(index), scene.views.cameras());
        self.look_at_changed();
        if self.known.get(first / cameras).is_none_or(|k| k.absent_found) {
            return;
        }
        for view in first..first + cameras {
            let horizon = scene.views.get(view).horizon;
            let seen = self.sight.blocks(first / cameras);
            scene.views.get_mut(view).absent = self.absent_from(&scene.view(view), &horizon, seen);
        }
        self.known[first / cameras].absent_found = true;
    }

    pub fn take_image(&mut self, scene: &mut Scene, index: usize, fetched: &Fetched) -> Result<(), GpuError> {
        let keyframe = index / scene.views.cameras();
        self.known[keyframe].asked = self.known[keyframe].asked.saturating_sub(1);
        let room = scene.views.has_place(index) || (self.make_place(scene)? && scene.views.place(index));
        if room && read_planes(&fetched.payload, scene.views.planes_mut(index)) {
            scene.upload_image(index)?;
            scene.counters.images_paged_in.add(1);
        } else {
            // Damaged where it had room.
            scene.counters.keyframes_lost.add(u64::from(room));
            self.known[keyframe].saved &= !room;
            self.known[keyframe].in_part = true;
        }
        // All images of a keyframe, or none.
        if self.known[keyframe].asked == 0 && std::mem::take(&mut self.known[keyframe].in_part) {
            scene.views.unplace(index);
        }
        Ok(())
    }

    /// Sees that a place for images is free: takes that of the keyframe that is missed least. False where all must stay.
    pub fn make_place(&mut self, scene: &mut Scene) -> Result<bool, GpuError> {
        if scene.views.free_place().is_some() {
            return Ok(true);
        }
        self.look_at_changed();
        let cameras = scene.views.cameras();
        // Where places are few, each would be the last of its block, and none would ever go.
        let anchors = self.blocks.iter().filter(|b| b.in_pool && b.number % PARTS == 0).count();
        let few = scene.views.places() < VIEWS_PER_BLOCK * anchors;
        let mut tried = [usize::MAX; 4];
        for n in 0..tried.len() {
            let untried = scene.views.placed().filter(|first| !tried.contains(first));
            let ranked = untried.filter_map(|first| Some((self.rank(&scene.views, first, few)?, first)));
            let Some((_, first)) = ranked.max() else { break };
            tried[n] = first;
            if self.known[first / cameras].open {
                self.look_again(scene, first)?;
                self.look_at_changed();
            }
            if self.save_keyframe(&scene.views, first / cameras) {
                scene.views.unplace(first);
                return Ok(true);
            }
        }
        // With two places both may be taken by what is new and what is drawn.
        if self.drawn.next.is_empty() {
            return Ok(false);
        }
        self.drawn.next.clear();
        self.make_place(scene)
    }

    /// How much the images of a keyframe may go: by kind, then the longer they were here; `None` where they must stay. What goes
    /// does not depend on the steps it got, so all are trained on alike.
    fn rank(&self, views: &Views, first: usize, few: bool) -> Option<(u8, u64)> {
        let cameras = views.cameras();
        let (entry, keyframe) = (views.get(first), first / cameras);
        let newest = views.placed().max().unwrap_or(0) / cameras;
        let recent = keyframe + newest_kept(views.places()) > newest;
        let next = self.drawn.next.iter().any(|i| *i as usize / cameras == keyframe);
        let grows = |block: usize| self.blocks[block].in_pool && self.blocks[block].samples_len == 0;
        if self.block_of(first as u32 * PARTS).is_some_and(grows)
            || self.known.get(keyframe)?.asked > 0
            || next
            || recent && !entry.held_out
        {
            return None;
        }
        let home = |keyframe: usize| self.known.get(keyframe)?.home;
        let last = !few
            && home(keyframe).is_some_and(|anchor| {
                let shares = |f: &usize| *f != first && home(*f / cameras) == Some(anchor);
                let parts = anchor * PARTS..(anchor + 1) * PARTS;
                let is_here = parts.filter_map(|part| self.block_of(part)).any(|part| self.blocks[part].in_pool);
                is_here && !views.placed().any(|f| shares(&f))
            });
        let kind = if entry.held_out {
            3
        } else if last {
            0
        } else {
            1 + u8::from(!self.shows_enough_of(keyframe))
        };
        Some((kind, u64::MAX - views.arrival(first)))
    }
}
