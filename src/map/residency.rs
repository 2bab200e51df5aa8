//! Which blocks are in memory.
//!
//! What is wanted follows from the keyframes that are known. When one comes, that is what those see that are nearest to where
//! the vehicle is, and to where it will be in two seconds; then what those see that lack the fewest Gaussians, so that as many
//! views as may be can be trained on; as much as fits beside a reserve for what is new. Between keyframes the pool turns to other
//! places (`rehearse`): the map forgets a place that is never trained on, and a view along a corridor needs what is seen from
//! none of those nearby. A block that is not wanted stays until its room is needed.
//! What keyframes nearby that look at the same as the newest see of what is near is wanted whether or not it fits; where it does
//! not, the least important Gaussians go: a scene that is denser than the pool is thinned, and one that is larger is paged.
//!
//! A keyframe may see blocks that are not in the pool. Where its picture shows some of them the image stands in for them, and
//! where it shows much of them it is not compared (`sight`): the Gaussians that are there would be bent to stand for those
//! that are missing.
//!
//! Where the depth of a new view finds a block that is on disk, the view is not uncovered, and nothing is seeded (`hide`).

use super::archive::{Archive, Arrived};
use super::block::BlockAbout;
use super::choice::{Choice, NEWEST};
use super::horizon::{cell_of, Horizon};
use super::scene::Scene;
use super::schedule::Rng;
use super::sight::seen_by;
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
/// Keyframes nearest to a place whose blocks may be wanted there: as many as `Choice::needed_by` has bits.
const NEAREST: usize = u128::BITS as usize;
/// What is as near as this to the vehicle, m, is thinned rather than left out.
const NEAR_M: f32 = 8.0;
/// A block of which a keyframe sees less than this part of what it sees of its blocks on average is not fetched for it.
const NEEDED_MIN: f32 = 0.25;
/// Part of the pool that is left for what is new when a keyframe comes.
const RESERVE_DIVISOR: usize = 8;
/// Blocks asked for when a keyframe comes whose surroundings do not fit, and between training steps.
const PAGED_WHERE_THINNED: usize = 32;
const PAGED_A_STEP: usize = 16;
/// Training steps at a place before the pool turns to another.
const STEPS_AT_A_PLACE: u64 = 20;
/// Views drawn to find another place.
const PLACES_DRAWN: usize = 16;
/// Part of a horizon that may be open.
const OPEN_MAX: f64 = 0.05;
/// The disk answers within this, or what it was asked for is done without: when a keyframe comes, and when a picture is drawn.
const PATIENCE_IN_FLIGHT: Duration = Duration::from_millis(50);
const PATIENCE: Duration = Duration::from_secs(2);

impl Archive {
    /// The part of the Gaussians that a keyframe sees that are in blocks that `here` names; all of none.
    fn part_seen(&self, keyframe: usize, here: impl Fn(usize) -> bool) -> f32 {
        let (mut all, mut away) = (0.0, 0.0);
        for (block, seen) in seen_by(&self.sight, &self.blocks, keyframe) {
            all += seen;
            away += if here(block) { 0.0 } else { seen };
        }
        if away > 0.0 {
            1.0 - away / all
        } else {
            1.0
        }
    }

    /// Whether nearly all that a keyframe sees is in the pool.
    pub fn is_shown(&self, keyframe: usize) -> bool {
        self.part_seen(keyframe, |block| self.blocks[block].in_pool) >= 1.0 - LEFT_MAX
    }

    /// Chooses what is wanted where a keyframe was taken, and fetches it: what is here decides how much of the view is new, and
    /// the Gaussians of a new anchor grow beside it. Not while those of the last one do (`busy`).
    pub fn arrive(
        &mut self,
        scene: &mut Scene,
        (t, pose): (Nanos, Pose),
        epoch: u32,
        busy: bool,
    ) -> Result<(), GpuError> {
        self.growing = busy;
        self.leave_other_epochs(scene, epoch)?;
        self.look_at_new_blocks(scene, busy)?;
        let ahead = self.choice.last.map_or(pose, |(before, from)| {
            let dt = (t - before).secs();
            let by = (pose.p - from.p) * if dt > 0.0 { AHEAD.secs() / dt } else { 0.0 };
            Pose { p: pose.p + by.clamp_length_max(AHEAD_MAX_M), ..pose }
        });
        let choice = &mut self.choice;
        (choice.last, choice.epoch) = (Some((t, pose)), epoch);
        choice.elsewhere = false;
        choice.reserve = scene.pipeline.pool.capacity() / RESERVE_DIVISOR;
        self.choose(scene, &[pose, ahead]);
        // What is new finds the reserve, and thins nothing.
        self.make_room(scene, 0)?;
        if busy {
            return Ok(());
        }
        self.fetch_wanted(scene, PATIENCE_IN_FLIGHT)
    }

    /// Turns the pool to another place after so many training steps at one, and fetches some of what is wanted. Called between
    /// training steps; a keyframe that comes turns it to where the vehicle is.
    pub fn rehearse(&mut self, scene: &mut Scene, rng: &mut Rng) -> Result<(), GpuError> {
        if self.choice.last.is_none() {
            return Ok(());
        }
        self.choice.steps += 1;
        if self.choice.steps % STEPS_AT_A_PLACE == 0 {
            if let Some(view) = self.draw_place(&scene.views, rng) {
                self.turn(scene, scene.views.world_from_body(view));
            }
        }
        self.page(scene, PAGED_A_STEP)
    }

    /// Wants what is seen at another place; no room is left for what is new.
    fn turn(&mut self, scene: &Scene, pose: Pose) {
        (self.choice.elsewhere, self.choice.reserve) = (true, 0);
        self.choose(scene, &[pose]);
        // Views of the last place were drawn ahead.
        self.drawn.next.clear();
    }

    /// Draws a view: of some the one with the fewest steps, and every other time the one that was trained on the longest ago, for
    /// what it shows is trained on from elsewhere, too. `None` where nearly all that it sees is in the pool.
    fn draw_place(&self, views: &Views, rng: &mut Rng) -> Option<usize> {
        // A map that fits needs no other place.
        if self.blocks.iter().all(|b| b.in_pool || b.samples_len == 0 || b.epoch != self.choice.epoch) {
            return None;
        }
        let drawn = (0..PLACES_DRAWN).filter_map(|_| rng.one_of(views.training()));
        let firsts = drawn.map(|view| views.first(view as usize));
        let of_this_epoch = firsts.filter(|first| views.get(*first).epoch == self.choice.epoch);
        let place = if self.choice.steps / STEPS_AT_A_PLACE % 2 == 0 {
            of_this_epoch.min_by_key(|first| views.get(*first).steps)
        } else {
            views.least_recent(of_this_epoch.map(|first| first as u32)).map(|first| first as usize)
        };
        place.filter(|first| !self.is_shown(*first / views.cameras()))
    }

    /// Writes the blocks whose burst ended before its time, as another anchor came, and looks who sees them. The newest still
    /// grows while the trainer is busy with it.
    fn look_at_new_blocks(&mut self, scene: &mut Scene, busy: bool) -> Result<(), GpuError> {
        let newest = scene.pipeline.pool.newest().filter(|_| busy);
        for block in 0..self.blocks.len() {
            let b = self.blocks[block];
            if b.in_pool && b.samples_len == 0 && newest != Some(b.number) {
                self.complete(scene, block)?;
            }
        }
        Ok(())
    }

    /// Wants what the keyframes nearest to some poses see.
    fn choose(&mut self, scene: &Scene, poses: &[Pose]) {
        for (number, count) in scene.pipeline.pool.blocks() {
            if let Some(block) = self.block_of(number) {
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
        self.choice.order.truncate(NEAREST);
        self.want_views_of(scene.pipeline.pool.capacity() - self.choice.reserve);
    }

    /// Finds the blocks that the newest keyframes see.
    fn find_now_seen(&mut self) {
        let newest = self.known.len().saturating_sub(NEWEST)..self.known.len();
        let Archive { choice, sight, blocks, .. } = self;
        choice.now_seen.clear();
        choice.now_seen.resize(blocks.len(), false);
        newest.for_each(|keyframe| sight.blocks(keyframe).for_each(|block| choice.now_seen[block] = true));
    }

    /// Wants the blocks that the keyframes in `order` see: where the vehicle is, first those of keyframes that look at what is
    /// seen now, whether or not they fit; then one keyframe after the other, until the room is full.
    fn want_views_of(&mut self, room: usize) {
        self.find_now_seen();
        let order = std::mem::take(&mut self.choice.order);
        self.choice.wanted.fill(false);
        self.choice.blocks.clear();
        let mut taken = 0;
        if !self.choice.elsewhere {
            for &(_, keyframe) in order.iter().take_while(|(near, _)| *near <= LOCAL_M) {
                if self.part_seen(keyframe as usize, |b| self.choice.now_seen[b]) >= SHARED_MIN {
                    self.want_near(keyframe as usize, &mut taken);
                }
            }
        }
        self.choice.thins = taken > room;
        let local = if !self.choice.elsewhere { LOCAL_M } else { 0.0 };
        for (nth, &(_, keyframe)) in order.iter().enumerate().take_while(|(nth, (near, _))| *nth == 0 || *near <= local)
        {
            // All of what another place itself shows; of what others see, what is behind far doors is left out.
            let left = if nth == 0 && self.choice.elsewhere { 0.0 } else { LEFT_MAX };
            if !self.want_until(keyframe as usize, left, room, &mut taken) {
                break;
            }
        }
        self.choice.order = order;
        self.want_cheapest(room - taken.min(room));
    }

    /// Wants what the keyframes see that lack the fewest Gaussians beside what is wanted already, so that there are as many
    /// views to train on as there may be.
    fn want_cheapest(&mut self, mut room: usize) {
        let order = std::mem::take(&mut self.choice.order);
        let mut lacking = std::mem::take(&mut self.choice.lacking);
        let Archive { sight, blocks, choice, .. } = self;
        lacking.clear();
        choice.needed_by.fill(0);
        debug_assert!(order.len() <= NEAREST);
        for (nth, &(_, keyframe)) in order.iter().enumerate() {
            let (mut all, mut n) = (0.0, 0.0f32);
            seen_by(sight, blocks, keyframe as usize).for_each(|(_, seen)| (all, n) = (all + seen, n + 1.0));
            let least = NEEDED_MIN * all / n.max(1.0);
            let mut lacks = 0;
            for (block, seen) in seen_by(sight, blocks, keyframe as usize) {
                if seen > least && !choice.wanted[block] {
                    choice.needed_by[block] |= 1 << nth;
                    lacks += blocks[block].count as usize;
                }
            }
            lacking.push(lacks);
        }
        loop {
            let fits = |i: &usize| (1..=room).contains(&lacking[*i]);
            let Some(next) = (0..order.len()).filter(fits).min_by_key(|i| (lacking[*i], *i)) else { break };
            room -= lacking[next];
            for block in sight.blocks(order[next].1 as usize) {
                if choice.needed_by[block] >> next & 1 == 0 {
                    continue;
                }
                choice.wanted[block] = true;
                choice.blocks.push(block as u32);
                // All who need it lack less.
                let mut needed_by = std::mem::take(&mut choice.needed_by[block]);
                while needed_by != 0 {
                    lacking[needed_by.trailing_zeros() as usize] -= blocks[block].count as usize;
                    needed_by &= needed_by - 1;
                }
            }
        }
        (self.choice.order, self.choice.lacking) = (order, lacking);
    }

    /// Wants the blocks that a keyframe sees that are near the vehicle.
    fn want_near(&mut self, keyframe: usize, taken: &mut usize) {
        let Archive { sight, blocks, choice, .. } = self;
        let Some((_, at)) = choice.last else { return };
        for (block, _) in seen_by(sight, blocks, keyframe) {
            let b = &blocks[block];
            if b.centre.distance(at.p.as_vec3()) <= NEAR_M && !choice.wanted[block] {
                *taken += b.count as usize;
                choice.wanted[block] = true;
                choice.blocks.push(block as u32);
            }
        }
    }

    /// Wants the blocks that a keyframe sees most of, until all but a part of what it sees is wanted; false where that is more
    /// than there is room for.
    fn want_until(&mut self, keyframe: usize, left: f32, room: usize, taken: &mut usize) -> bool {
        let Archive { sight, blocks, choice, .. } = self;
        let Choice { wanted, ranked, blocks: chosen, .. } = choice;
        let all: f32 = seen_by(sight, blocks, keyframe).map(|(_, seen)| seen).sum();
        ranked.clear();
        ranked.extend(seen_by(sight, blocks, keyframe).filter(|(b, _)| !wanted[*b]).map(|(b, seen)| (seen, b as u32)));
        ranked.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let mut missing: f32 = ranked.iter().map(|(seen, _)| seen).sum();
        for &(seen, block) in ranked.iter() {
            if missing <= left * all {
                break;
            }
            let count = blocks[block as usize].count as usize;
            if *taken + count > room {
                return false;
            }
            *taken += count;
            missing -= seen;
            wanted[block as usize] = true;
            chosen.push(block);
        }
        true
    }

    /// Wants the blocks that a keyframe sees, those that it sees most of first, then what else is before its camera, the nearest
    /// first, as many as fit.
    fn want_seen_by(&mut self, keyframe: usize, view: &View, room: usize) {
        let mut ranked = std::mem::take(&mut self.choice.ranked);
        ranked.clear();
        ranked.extend(seen_by(&self.sight, &self.blocks, keyframe).map(|(b, seen)| (-seen, b as u32)));
        let seen = ranked.len();
        for block in self.in_reach(view) {
            if !ranked[..seen].iter().any(|(_, other)| *other == block as u32) {
                let far = self.blocks[block].centre.as_dvec3().distance(view.world_from_cam.p);
                ranked.push((far as f32, block as u32));
            }
        }
        let Archive { blocks, choice, .. } = self;
        let Choice { wanted, blocks: chosen, .. } = choice;
        wanted.fill(false);
        chosen.clear();
        ranked.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let mut taken = 0;
        for &(_, block) in ranked.iter() {
            let count = blocks[block as usize].count as usize;
            if taken + count <= room {
                taken += count;
                wanted[block as usize] = true;
                chosen.push(block);
            }
        }
        choice.ranked = ranked;
    }

    /// Fetches what is wanted and waits for it, as long as `patience`; where the disk is read on this thread until it is here.
    fn fetch_wanted(&mut self, scene: &mut Scene, patience: Duration) -> Result<(), GpuError> {
        if self.choice.evict && self.choice.thins {
            // Not all of it fits: each page makes the scene thinner, one at a time.
            return self.page(scene, PAGED_WHERE_THINNED);
        }
        let begun = Instant::now();
        loop {
            let before = self.exchanges;
            self.page(scene, usize::MAX)?;
            let waits = self.choice.blocks.iter().any(|b| self.blocks[*b as usize].asked);
            // What has no room does not come.
            if !waits && self.exchanges == before || !self.at_once && begun.elapsed() > patience {
                return Ok(());
            }
            if waits {
                std::thread::sleep(Duration::from_micros(200));
            }
        }
    }

    /// Puts what came from the disk in its place, and asks for `most` blocks more of what is wanted.
    fn page(&mut self, scene: &mut Scene, most: usize) -> Result<(), GpuError> {
        self.receive(scene)?;
        let missing = |a: &Archive, block: usize| {
            let b = &a.blocks[block];
            (!b.in_pool && !b.asked && b.samples_len > 0).then_some(b.count as usize)
        };
        // Room for all of them at once: what leaves is taken out of the pool's arrays together.
        let counts = self.choice.blocks.iter().filter_map(|b| missing(self, *b as usize));
        let wanted: usize = counts.take(most).sum();
        if wanted == 0 {
            return Ok(());
        }
        self.make_room(scene, wanted)?;
        let mut asked = 0;
        for i in 0..self.choice.blocks.len() {
            let block = self.choice.blocks[i] as usize;
            let Some(count) = missing(self, block) else { continue };
            let fits = count <= scene.pipeline.pool.room();
            if asked == most || !fits || !self.ask_for_block(&scene.views, block) {
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
            self.exchanged(block);
            return Ok(());
        };
        if self.growing || b.in_pool || !self.choice.wanted[block] || !self.make_room(scene, about.count as usize)? {
            return Ok(());
        }
        let (gpu, pool, count) = (&mut scene.gpu, &mut scene.pipeline.pool, about.count as usize);
        let in_pool = pool.insert_block(gpu, (b.number, b.epoch), (count, about.moments), &fetched.payload)?;
        if in_pool {
            self.blocks[block].in_pool = true;
            self.blocks[block].count = count as u32;
            self.exchanged(block);
            scene.counters.blocks_paged_in.add(1);
            // What moved while it was away.
            if b.placed != about.placed {
                pool.move_blocks(gpu, std::iter::once((b.number, b.placed * about.placed.inverse())))?;
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
        if room < count + reserve {
            // The farthest first.
            let mut ranked = std::mem::take(&mut self.choice.ranked);
            ranked.clear();
            for (number, _) in scene.pipeline.pool.blocks() {
                let Some(block) = self.block_of(number) else { continue };
                let b = &self.blocks[block];
                if b.samples_len > 0 && !self.choice.wanted[block] {
                    ranked.push((at.map_or(0.0, |at: Vec3| b.centre.distance(at)), block as u32));
                }
            }
            ranked.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(b.1.cmp(&a.1)));
            let lacks = |(_, block): &&(f32, u32)| {
                let lacks = room < count + reserve;
                room += self.blocks[*block as usize].count as usize;
                lacks
            };
            let leave = ranked.iter().take_while(lacks).count();
            let leave = self.save_blocks(scene, &ranked[..leave], false)?;
            leaving.extend(ranked[..leave].iter().map(|(_, block)| self.blocks[*block as usize].number));
            self.choice.ranked = ranked;
        }
        self.take_out(scene, &leaving)?;
        self.choice.leaving = leaving;
        let room = scene.pipeline.pool.room();
        let thins = self.choice.evict && self.choice.thins;
        Ok(room >= count || thins && scene.make_room(count, true)? >= count)
    }

    fn take_out(&mut self, scene: &mut Scene, numbers: &[u32]) -> Result<(), GpuError> {
        if numbers.is_empty() {
            return Ok(());
        }
        scene.pipeline.pool.remove_blocks(&mut scene.gpu, |number| numbers.contains(&number))?;
        for &number in numbers {
            if let Some(block) = self.block_of(number) {
                self.blocks[block].in_pool = false;
                self.exchanged(block);
            }
        }
        scene.counters.blocks_paged_out.add(numbers.len() as u64);
        Ok(())
    }

    /// Takes out the blocks of other epochs, whose frames are others.
    fn leave_other_epochs(&mut self, scene: &mut Scene, epoch: u32) -> Result<(), GpuError> {
        let mut leaving = std::mem::take(&mut self.choice.leaving);
        leaving.clear();
        for block in 0..self.blocks.len() {
            let b = self.blocks[block];
            if b.in_pool && b.epoch != epoch && self.save_if_changed(scene, block)? {
                leaving.push(b.number);
            }
        }
        self.take_out(scene, &leaving)?;
        self.choice.leaving = leaving;
        Ok(())
    }

    /// Takes the horizon of a view from the scene's last picture, which is of it, and looks from there.
    pub fn saw(&mut self, scene: &mut Scene, first: usize) {
        let (view, mut horizon) = (scene.view(first), Horizon::of(&scene.rendered));
        let keyframe = first / scene.views.cameras();
        if !self.is_shown(keyframe) {
            // A hole in the picture is what is absent.
            horizon.take_over(&scene.views.get(first).horizon);
        }
        scene.views.get_mut(first).horizon = horizon;
        if keyframe < self.known.len() {
            // Its state is to be written again.
            self.known[keyframe].stated = u32::MAX;
            self.known[keyframe].open = horizon.open_part() > OPEN_MAX;
            self.known[keyframe].absent_found = false;
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
        let cells = self.absent_from(view, horizon, self.in_reach(view))?.hidden;
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
        self.want_seen_by(keyframe, &scene.view(index), scene.pipeline.pool.capacity());
        let begun = Instant::now();
        self.fetch_wanted(scene, PATIENCE)?;
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
