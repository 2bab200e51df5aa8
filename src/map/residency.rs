//! Which blocks are in memory.
//!
//! What is wanted follows from the keyframes that are known. When one comes, that is what those see that are nearest to where
//! the vehicle is, and to where it will be in two seconds, as much as fits beside a reserve for what is new. Between keyframes
//! the pool turns to other places and back (`rehearse`): the map forgets a place that is never trained on, and a view along a
//! corridor needs what is seen from none of those nearby. A block that is not wanted stays until its room is needed.
//! What keyframes nearby that look at the same as the newest see is wanted whether or not it fits; where it does not, the least
//! important Gaussians go: a scene that is denser than the pool is thinned, and one that is larger is paged.
//!
//! A keyframe may see blocks that are not in the pool. The cells of its picture that show much of them are not compared
//! (`sight`): the Gaussians that are there would be bent to stand for those that are missing.
//!
//! Where the depth of a new view finds a block that is on disk, the view is not uncovered, and nothing is seeded (`hide`).

use super::archive::{Archive, Arrived};
use super::block::BlockAbout;
use super::choice::{Choice, NEWEST};
use super::filing::BLOCKS_KNOWN;
use super::horizon::{cell_of, Horizon};
use super::scene::Scene;
use super::schedule::Rng;
use super::view::View;
use super::views::Views;
use crate::gpu::GpuError;
use crate::store::Fetched;
use glam::Vec3;
use std::time::{Duration, Instant};
use stipple_drivers::{Nanos, Pose, Span};

/// How far ahead blocks are fetched, and how far a vehicle is believed to come until then, m.
const AHEAD: Span = Span(2_000_000_000);
const AHEAD_MAX_M: f64 = 4.0;
/// A keyframe that looks the other way counts as farther away by this, m.
const FACING_M: f64 = 2.0;
/// Part of the Gaussians that a keyframe sees that nobody fetches for it: what is seen through far doors.
const LEFT_MAX: f32 = 0.04;
/// A keyframe as near as this, m, looks at the same as the newest where they, too, see this part of what it sees.
const LOCAL_M: f32 = 2.0;
const SHARED_MIN: f32 = 0.8;
/// Part of the pool that is left for what is new when a keyframe comes.
const RESERVE_DIVISOR: usize = 8;
/// Blocks asked for when a keyframe comes, some MiB, and between training steps.
const PAGED_AT_ONCE: usize = 8;
const PAGED_A_STEP: usize = 4;
/// Training steps at a place before the pool turns to another.
const STEPS_AT_A_PLACE: i32 = 20;
/// Views drawn to find another place.
const PLACES_DRAWN: usize = 4;
/// Part of a horizon that may be open.
const OPEN_MAX: f64 = 0.05;
/// The disk answers within this, or what it was asked for is done without.
const PATIENCE: Duration = Duration::from_secs(2);

impl Archive {
    /// Gaussians of a block that a keyframe sees, by the block's samples.
    fn seen(&self, keyframe: usize, block: usize) -> f32 {
        let b = &self.blocks[block];
        let samples = f32::from(self.sight[keyframe * BLOCKS_KNOWN + block]);
        samples * b.count as f32 / f32::from(b.samples_len.max(1))
    }

    /// The part of the Gaussians that a keyframe sees that are in blocks that `here` names; all of none.
    fn part_seen(&self, keyframe: usize, here: impl Fn(usize) -> bool) -> f32 {
        let (mut all, mut away) = (0.0, 0.0);
        for block in 0..self.blocks.len() {
            let seen = self.seen(keyframe, block);
            all += seen;
            away += if here(block) { 0.0 } else { seen };
        }
        if away > 0.0 {
            1.0 - away / all
        } else {
            1.0
        }
    }

    /// The part of the Gaussians that a keyframe sees that are in the pool.
    pub fn part_here(&self, keyframe: usize) -> f32 {
        self.part_seen(keyframe, |block| self.blocks[block].in_pool)
    }

    /// Whether nearly all that a keyframe sees is in the pool.
    pub fn is_shown(&self, keyframe: usize) -> bool {
        self.part_here(keyframe) >= 1.0 - LEFT_MAX
    }

    /// Chooses what is wanted where a keyframe was taken, and fetches some of it.
    pub fn arrive(
        &mut self,
        scene: &mut Scene,
        (t, pose): (Nanos, Pose),
        epoch: u32,
        busy: bool,
    ) -> Result<(), GpuError> {
        self.leave_other_epochs(scene, epoch)?;
        self.look_at_new_blocks(scene, busy)?;
        let ahead = self.choice.last.map_or(pose, |(before, from)| {
            let dt = (t - before).secs();
            let by = (pose.p - from.p) * if dt > 0.0 { AHEAD.secs() / dt } else { 0.0 };
            Pose { p: pose.p + by.clamp_length_max(AHEAD_MAX_M), ..pose }
        });
        let choice = &mut self.choice;
        (choice.last, choice.epoch) = (Some((t, pose)), epoch);
        choice.elsewhere = None;
        choice.reserve = scene.pipeline.pool.capacity() / RESERVE_DIVISOR;
        self.choose(scene, &[pose, ahead]);
        // What is new finds the reserve, and thins nothing.
        self.make_room(scene, 0)?;
        self.page(scene, PAGED_AT_ONCE, busy)
    }

    /// Turns the pool to another place after so many training steps where the vehicle is, and back after as many there, and
    /// fetches some of what is wanted. Called between training steps; a keyframe that comes turns it back, too.
    pub fn rehearse(&mut self, scene: &mut Scene, rng: &mut Rng) -> Result<(), GpuError> {
        let Some((_, pose)) = self.choice.last else { return Ok(()) };
        let elsewhere = self.choice.elsewhere.is_some();
        let by = if elsewhere { -1 } else { 1 };
        self.choice.steps_ahead = (self.choice.steps_ahead + by).clamp(0, STEPS_AT_A_PLACE);
        if elsewhere && self.choice.steps_ahead == 0 {
            self.turn(scene, None, pose);
        } else if !elsewhere && self.choice.steps_ahead == STEPS_AT_A_PLACE {
            if let Some(view) = self.draw_place(&scene.views, rng) {
                self.turn(scene, Some(view), scene.views.world_from_body(view as usize));
            }
        }
        self.page(scene, PAGED_A_STEP, false)
    }

    /// Wants what is seen at a place, the view's or the vehicle's; no room is left for what is new.
    fn turn(&mut self, scene: &Scene, elsewhere: Option<u32>, pose: Pose) {
        (self.choice.elsewhere, self.choice.reserve) = (elsewhere, 0);
        self.choose(scene, &[pose]);
        // Views of the last place were drawn ahead.
        self.drawn.next.clear();
    }

    /// Draws a view some of which is not in the pool: of a few such the one with the fewest steps.
    fn draw_place(&self, views: &Views, rng: &mut Rng) -> Option<u32> {
        // A map that fits draws its views as one without a store.
        if self.blocks.iter().all(|b| b.in_pool || b.samples_len == 0 || b.epoch != self.choice.epoch) {
            return None;
        }
        let drawn = (0..PLACES_DRAWN).filter_map(|_| rng.one_of(views.training()));
        let away = drawn
            .map(|view| views.first(view as usize))
            .filter(|first| views.get(*first).epoch == self.choice.epoch && !self.is_shown(*first / views.cameras()));
        away.min_by_key(|first| views.get(*first).steps).map(|first| first as u32)
    }

    /// Writes the blocks whose burst ended before its time, as another anchor came, and looks who sees them. The newest still
    /// grows while the trainer is busy with it.
    fn look_at_new_blocks(&mut self, scene: &mut Scene, busy: bool) -> Result<(), GpuError> {
        let newest = scene.pipeline.pool.newest().filter(|_| busy);
        for block in 0..self.blocks.len() {
            let b = self.blocks[block];
            if b.in_pool && b.samples_len == 0 && newest != Some(b.anchor) && self.save_block(scene, block)? {
                self.look_for(scene, block);
            }
        }
        Ok(())
    }

    /// Wants what the keyframes nearest to some poses see.
    fn choose(&mut self, scene: &Scene, poses: &[Pose]) {
        for (anchor, count) in scene.pipeline.pool.blocks() {
            if let Some(block) = self.block_of(anchor) {
                self.blocks[block].count = count;
            }
        }
        let (views, cameras, epoch) = (&scene.views, scene.views.cameras(), self.choice.epoch);
        let forward = |body: &Pose| (*body * scene.cameras[0].body_from_cam).q * glam::DVec3::Z;
        self.choice.order.clear();
        for &index in views.training().iter().filter(|i| **i as usize % cameras == 0) {
            let (entry, keyframe) = (views.get(index as usize), index as usize / cameras);
            if entry.epoch != epoch {
                continue;
            }
            let looks = entry.world_from_cam().q * glam::DVec3::Z;
            let far = |pose: &Pose| {
                let cosine = forward(pose).dot(looks);
                (pose.p - entry.given.p).length() + FACING_M * (1.0 - cosine) / 2.0
            };
            let nearest = poses.iter().map(far).fold(f64::INFINITY, f64::min);
            self.choice.order.push((nearest as f32, keyframe as u32));
        }
        self.choice.order.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        self.want_views_of(scene.pipeline.pool.capacity() - self.choice.reserve);
    }

    /// Finds the blocks that the newest keyframes see.
    fn find_now_seen(&mut self) {
        let newest = self.known.len().saturating_sub(NEWEST)..self.known.len();
        let Archive { choice, sight, blocks, .. } = self;
        choice.now_seen.clear();
        choice.now_seen.extend((0..blocks.len()).map(|b| newest.clone().any(|k| sight[k * BLOCKS_KNOWN + b] > 0)));
    }

    /// Wants the blocks that the keyframes in `order` see, one keyframe after the other, until they fill the room; where the
    /// vehicle is, past that those alone that look at what is seen now.
    fn want_views_of(&mut self, room: usize) {
        self.find_now_seen();
        let here = self.choice.elsewhere.is_none();
        let order = std::mem::take(&mut self.choice.order);
        self.choice.wanted.fill(false);
        self.choice.blocks.clear();
        let (mut taken, mut full) = (0, false);
        for (nth, &(near, keyframe)) in order.iter().enumerate() {
            let looks_at_the_same =
                |a: &Archive| a.part_seen(keyframe as usize, |b| a.choice.now_seen[b]) >= SHARED_MIN;
            let stays = here && near <= LOCAL_M && looks_at_the_same(self);
            if full && !stays {
                continue;
            }
            // All of what the place itself shows; of what others see, what is behind far doors is left out.
            let left = if nth == 0 && !here { 0.0 } else { LEFT_MAX };
            // What it sees most of first, until nearly all of it is wanted.
            while self.part_seen(keyframe as usize, |b| self.choice.wanted[b]) < 1.0 - left {
                let more = |b: &usize| !self.choice.wanted[*b] && self.seen(keyframe as usize, *b) > 0.0;
                let most = (0..self.blocks.len()).filter(more).max_by(|a, b| {
                    self.seen(keyframe as usize, *a).total_cmp(&self.seen(keyframe as usize, *b)).then(b.cmp(a))
                });
                let Some(block) = most else { break };
                full |= taken + self.blocks[block].count as usize > room;
                if full && !stays {
                    break;
                }
                taken += self.blocks[block].count as usize;
                self.choice.wanted[block] = true;
                self.choice.blocks.push(block as u32);
            }
        }
        self.choice.order = order;
    }

    /// Wants the blocks that a keyframe sees, those that it sees most of first, as many as fit.
    fn want_seen_by(&mut self, keyframe: usize, room: usize) {
        self.choice.wanted.fill(false);
        let row = &self.sight[keyframe * BLOCKS_KNOWN..][..self.blocks.len()];
        let blocks = &mut self.choice.blocks;
        blocks.clear();
        blocks.extend((0..row.len() as u32).filter(|b| row[*b as usize] > 0));
        blocks.sort_unstable_by_key(|b| (u8::MAX - row[*b as usize], *b));
        let mut taken = 0;
        for b in blocks {
            let count = self.blocks[*b as usize].count as usize;
            if taken + count <= room {
                taken += count;
                self.choice.wanted[*b as usize] = true;
            }
        }
        let Choice { blocks, wanted, .. } = &mut self.choice;
        blocks.retain(|b| wanted[*b as usize]);
    }

    /// Puts what came from the disk in its place, and asks for `most` blocks more of what is wanted. While a new block grows
    /// (`busy`), no other comes behind it.
    pub fn page(&mut self, scene: &mut Scene, most: usize, busy: bool) -> Result<(), GpuError> {
        if busy {
            return Ok(());
        }
        self.receive(scene)?;
        let mut asked = 0;
        for i in 0..self.choice.blocks.len() {
            let block = self.choice.blocks[i] as usize;
            let b = self.blocks[block];
            if b.in_pool || b.asked || b.samples_len == 0 {
                continue;
            }
            if asked == most || !self.make_room(scene, b.count as usize)? || !self.ask_for_block(&scene.views, block) {
                break;
            }
            asked += 1;
            // Done at once, it has come by now.
            self.receive(scene)?;
        }
        Ok(())
    }

    pub fn receive(&mut self, scene: &mut Scene) -> Result<(), GpuError> {
        while let Some((arrived, fetched)) = self.next_fetched(&scene.views) {
            let done = match arrived {
                Arrived::Block(block) => self.take_block(scene, block, &fetched),
                Arrived::Image(index) => self.take_image(scene, index, &fetched),
                Arrived::Unknown => Ok(()),
            };
            self.store.give_back(fetched);
            done?;
        }
        Ok(())
    }

    fn take_block(&mut self, scene: &mut Scene, block: usize, fetched: &Fetched) -> Result<(), GpuError> {
        let b = self.blocks[block];
        self.blocks[block].asked = false;
        let about = BlockAbout::decode(&fetched.about).filter(|about| about.count > 0 && !fetched.payload.is_empty());
        let Some(about) = about else {
            // Damaged: what it was is lost, and its place is uncovered from here on.
            scene.counters.blocks_lost.add(1);
            self.blocks[block].samples_len = 0;
            self.exchanges += 1;
            return Ok(());
        };
        if self.growing || b.in_pool || !self.choice.wanted[block] || !self.make_room(scene, about.count as usize)? {
            return Ok(());
        }
        let (gpu, pool, count) = (&mut scene.gpu, &mut scene.pipeline.pool, about.count as usize);
        let in_pool = pool.insert_block(gpu, (b.anchor, b.epoch), (count, about.moments), &fetched.payload)?;
        if in_pool {
            self.blocks[block].in_pool = true;
            self.blocks[block].count = count as u32;
            self.exchanges += 1;
            scene.counters.blocks_paged_in.add(1);
            // What moved while it was away.
            let by = b.placed * about.placed.inverse();
            if by.p.length() > 0.0 || by.q.to_scaled_axis().length() > 0.0 {
                pool.move_blocks(gpu, std::iter::once((b.anchor, by)))?;
            }
        }
        Ok(())
    }

    /// Makes room in the pool for so many Gaussians beside the reserve, by taking out blocks that are not wanted and, where
    /// they alone do not fit, the least important Gaussians; whether they fit.
    fn make_room(&mut self, scene: &mut Scene, count: usize) -> Result<bool, GpuError> {
        let reserve = self.choice.reserve;
        let (mut room, at) = (scene.pipeline.pool.room(), self.choice.last.map(|(_, pose)| pose.p.as_vec3()));
        let mut leaving = std::mem::take(&mut self.choice.leaving);
        leaving.clear();
        while room < count + reserve {
            let far = |b: &usize| at.map_or(0.0, |at: Vec3| self.blocks[*b].centre.distance(at));
            let may = |b: &usize| {
                let known = &self.blocks[*b];
                known.in_pool && known.samples_len > 0 && !self.choice.wanted[*b] && !leaving.contains(&known.anchor)
            };
            let Some(block) = (0..self.blocks.len()).filter(may).max_by(|a, b| far(a).total_cmp(&far(b))) else {
                break;
            };
            if !self.save_if_changed(scene, block)? {
                break;
            }
            room += self.blocks[block].count as usize;
            leaving.push(self.blocks[block].anchor);
        }
        self.take_out(scene, &leaving)?;
        self.choice.leaving = leaving;
        let room = scene.pipeline.pool.room();
        Ok(room >= count || self.choice.evict && scene.make_room(count, true)? >= count)
    }

    fn take_out(&mut self, scene: &mut Scene, anchors: &[u32]) -> Result<(), GpuError> {
        if anchors.is_empty() {
            return Ok(());
        }
        scene.pipeline.pool.remove_blocks(&mut scene.gpu, |anchor| anchors.contains(&anchor))?;
        self.blocks.iter_mut().filter(|b| anchors.contains(&b.anchor)).for_each(|b| b.in_pool = false);
        self.exchanges += 1;
        scene.counters.blocks_paged_out.add(anchors.len() as u64);
        Ok(())
    }

    /// Takes out the blocks of other epochs, whose frames are others.
    fn leave_other_epochs(&mut self, scene: &mut Scene, epoch: u32) -> Result<(), GpuError> {
        let mut leaving = std::mem::take(&mut self.choice.leaving);
        leaving.clear();
        for block in 0..self.blocks.len() {
            let b = self.blocks[block];
            if b.in_pool && b.epoch != epoch && self.save_if_changed(scene, block)? {
                leaving.push(b.anchor);
            }
        }
        self.take_out(scene, &leaving)?;
        self.choice.leaving = leaving;
        Ok(())
    }

    /// Takes the horizon of a view from the scene's last picture, which is of it, and looks from there.
    pub fn saw(&mut self, scene: &mut Scene, first: usize) {
        let (view, mut horizon) = (scene.view(first), Horizon::of(&scene.rendered));
        horizon.take_over(&scene.views.get(first).horizon);
        let keyframe = first / scene.views.cameras();
        scene.views.get_mut(first).horizon = horizon;
        if keyframe < self.known.len() {
            self.known[keyframe].open = horizon.open_part() > OPEN_MAX;
            self.known[keyframe].looked_at = 0;
            self.look_from(&view, &horizon, keyframe);
        }
    }

    pub fn look_again(&mut self, scene: &mut Scene, first: usize) -> Result<(), GpuError> {
        let view = scene.view(first);
        scene.render(&view)?;
        self.saw(scene, first);
        self.known[first / scene.views.cameras()].open = false;
        Ok(())
    }

    /// The valid pixels of a view less the cells that show what is not in the pool; `None` where there are none of these.
    pub fn hide(&mut self, view: &View, horizon: &Horizon, valid: &[u8]) -> Option<&[u8]> {
        let cells = self.hidden_from(view, horizon);
        if cells.is_empty() {
            return None;
        }
        let (w, h) = (view.camera.width, view.camera.height);
        let hidden = &mut self.choice.hidden;
        hidden.clear();
        hidden.extend(valid.iter().enumerate().map(|(i, valid)| {
            let cell = cell_of((i % w) as f64, (i / w) as f64, w, h);
            if cells.contains(cell) {
                0
            } else {
                *valid
            }
        }));
        Some(hidden)
    }

    /// Brings a keyframe's images and all blocks that it sees into memory and waits for them: to be scored and drawn. False
    /// where its images cannot be had.
    pub fn bring(&mut self, scene: &mut Scene, index: usize) -> Result<bool, GpuError> {
        // Who looks takes no Gaussian out of the map.
        let evict = std::mem::replace(&mut self.choice.evict, false);
        let brought = self.bring_all(scene, index);
        self.choice.evict = evict;
        brought
    }

    fn bring_all(&mut self, scene: &mut Scene, index: usize) -> Result<bool, GpuError> {
        self.growing = false;
        self.choice.reserve = 0;
        let keyframe = index / scene.views.cameras();
        self.leave_other_epochs(scene, scene.views.get(index).epoch)?;
        self.want_seen_by(keyframe, scene.pipeline.pool.capacity());
        let begun = Instant::now();
        let missing = |a: &Archive| a.choice.blocks.iter().any(|b| a.blocks[*b as usize].asked);
        loop {
            let before = self.exchanges;
            self.page(scene, PAGED_AT_ONCE, false)?;
            // A page is some blocks; what has no room does not come.
            let done = !missing(self) && self.exchanges == before;
            if done || begun.elapsed() > PATIENCE {
                break;
            }
            if missing(self) {
                std::thread::sleep(Duration::from_millis(1));
            }
        }
        if !scene.views.has_place(index) && self.known.get(keyframe).is_some_and(|k| k.saved) {
            while !self.ask_for_images(&scene.views, keyframe) && begun.elapsed() < PATIENCE {
                self.receive(scene)?;
            }
        }
        while self.known.get(keyframe).is_some_and(|k| k.asked > 0) && begun.elapsed() < PATIENCE {
            self.receive(scene)?;
            std::thread::sleep(Duration::from_micros(200));
        }
        Ok(scene.views.has_place(index))
    }
}
