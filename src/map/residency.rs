//! Which blocks and images are in memory.
//!
//! What is wanted follows from the keyframes that are known: those nearest to where the vehicle is, and to where it will be in two
//! seconds, are to be trained on, so all blocks that they see are to be in the pool, as many keyframes as the pool allows. A
//! keyframe one of whose blocks is missing is not trained on: others would be bent to stand for what it lacks. A block that
//! is not wanted stays until its room is needed.
//!
//! Images rotate: while the map trains, keyframes on disk whose blocks are in the pool take, one at a time, the places of those
//! that were trained on longest, so in the end all are trained on alike. The newest, and the last of a block, stay.
//!
//! A view is not uncovered where it shows a block that is on disk: where a keyframe's own depth finds such a block, nothing is
//! seeded (`hide`).

use super::archive::{Archive, Arrived};
use super::block::BlockAbout;
use super::choice::Choice;
use super::filing::{read_planes, BLOCKS_KNOWN};
use super::horizon::{cell_of, Horizon, CELLS, COLUMNS, ROWS};
use super::scene::Scene;
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
/// A keyframe all of whose blocks are in the pool counts as nearer by this, m: without, two views at a limit would exchange their
/// blocks over and over.
const STAYS_M: f64 = 1.0;
/// Part of the Gaussians that a keyframe sees that may be missing when it is trained on: what is seen through far doors.
const AWAY_MAX: f32 = 0.04;
/// What keyframes nearer than this see is wanted whether or not it fits, m: where it does not, the least important Gaussians
/// go. A scene that is denser than the pool is thinned, one that is larger is paged.
const LOCAL_M: f32 = 4.0;
/// Part of the pool that is left for what is new.
const RESERVE_DIVISOR: usize = 8;
/// Blocks asked for when a keyframe comes: some MiB.
const PAGED_AT_ONCE: usize = 8;
/// Newest keyframes whose poses odometry still corrects.
const NEWEST: usize = 8;
/// Places for each block in the pool, below which a block's last keyframe may go, too.
const VIEWS_PER_BLOCK: usize = 3;
/// Draws until another keyframe is found for a place.
const DRAWS: usize = 16;
/// Part of a horizon that may be open.
const OPEN_MAX: f64 = 0.05;
/// Keyframes that are asked whether they show a point, and points of a cell along each axis.
const ASKED: usize = 48;
const POINTS: usize = 3;
/// The disk answers within this, or what it was asked for is done without.
const PATIENCE: Duration = Duration::from_secs(2);

/// Keyframes, the newest, whose images stay.
fn newest_kept(views: &Views) -> usize {
    NEWEST.min(views.places() / 2)
}

impl Archive {
    /// Gaussians of a block that a keyframe sees, by the block's samples.
    fn seen(&self, keyframe: usize, block: usize) -> f32 {
        let b = &self.blocks[block];
        let samples = f32::from(self.sight[keyframe * BLOCKS_KNOWN + block]);
        samples * b.count as f32 / f32::from(b.samples_len.max(1))
    }

    /// Whether nearly all Gaussians that a keyframe sees are in blocks that `here` names.
    fn has_nearly_all(&self, keyframe: usize, here: impl Fn(usize) -> bool) -> bool {
        let (mut all, mut away) = (0.0, 0.0);
        for block in 0..self.blocks.len() {
            let seen = self.seen(keyframe, block);
            all += seen;
            away += if here(block) { 0.0 } else { seen };
        }
        away <= AWAY_MAX * all
    }

    /// Whether nearly all Gaussians that a keyframe sees are in the pool.
    fn is_whole(&self, keyframe: usize) -> bool {
        self.has_nearly_all(keyframe, |block| self.blocks[block].in_pool)
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
        self.choice.last = Some((t, pose));
        self.choose(scene, [pose, ahead], epoch);
        // What is new finds the reserve, and thins nothing.
        self.make_room(scene, 0)?;
        self.page(scene, busy)
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

    fn choose(&mut self, scene: &Scene, poses: [Pose; 2], epoch: u32) {
        for (anchor, count) in scene.pipeline.pool.blocks() {
            if let Some(block) = self.block_of(anchor) {
                self.blocks[block].count = count;
            }
        }
        let (views, cameras) = (&scene.views, scene.views.cameras());
        let looks = poses.map(|p| (p.p, p * scene.cameras[0].body_from_cam));
        self.choice.order.clear();
        for &index in views.training().iter().filter(|i| **i as usize % cameras == 0) {
            let (entry, keyframe) = (views.get(index as usize), index as usize / cameras);
            if entry.epoch != epoch {
                continue;
            }
            let from = entry.world_from_cam();
            let far = |(p, look): &(glam::DVec3, Pose)| {
                let cosine = (look.q * glam::DVec3::Z).dot(from.q * glam::DVec3::Z);
                (*p - entry.given.p).length() + FACING_M * (1.0 - cosine) / 2.0
            };
            let near = f64::min(far(&looks[0]), far(&looks[1])) - if self.is_whole(keyframe) { STAYS_M } else { 0.0 };
            self.choice.order.push((near as f32, keyframe as u32));
        }
        self.choice.order.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let pool = &scene.pipeline.pool;
        self.want_views_of(pool.capacity() - pool.capacity() / RESERVE_DIVISOR);
    }

    /// Wants all blocks that the keyframes in `order` see, one keyframe after the other, those that do not fit left out.
    fn want_views_of(&mut self, room: usize) {
        let order = std::mem::take(&mut self.choice.order);
        self.choice.wanted.fill(false);
        self.choice.blocks.clear();
        self.choice.candidates.clear();
        let mut taken = 0;
        for &(near, keyframe) in &order {
            let before = (self.choice.blocks.len(), taken);
            // What it sees most of first, until nearly all of it is wanted.
            while !self.has_nearly_all(keyframe as usize, |b| self.choice.wanted[b]) {
                let more = |b: &usize| !self.choice.wanted[*b] && self.seen(keyframe as usize, *b) > 0.0;
                let most = (0..self.blocks.len()).filter(more).max_by(|a, b| {
                    self.seen(keyframe as usize, *a).total_cmp(&self.seen(keyframe as usize, *b)).then(b.cmp(a))
                });
                let Some(block) = most else { break };
                taken += self.blocks[block].count as usize;
                self.choice.wanted[block] = true;
                self.choice.blocks.push(block as u32);
            }
            if taken > room && near > LOCAL_M {
                // It does not fit, and takes none of the room.
                while self.choice.blocks.len() > before.0 {
                    let block = self.choice.blocks.pop().expect("there are more");
                    self.choice.wanted[block as usize] = false;
                }
                taken = before.1;
                continue;
            }
            self.choice.candidates.push(keyframe);
        }
        self.choice.order = order;
    }

    /// Wants the blocks that a keyframe sees, those that it sees most of first, as many as fit.
    fn want_seen_by(&mut self, keyframe: usize, room: usize) {
        self.choice.wanted.fill(false);
        self.choice.candidates.clear();
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

    /// Puts what came from the disk in its place, and asks for more of what is wanted. While a new block grows (`busy`), no
    /// other comes behind it.
    pub fn page(&mut self, scene: &mut Scene, busy: bool) -> Result<(), GpuError> {
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
            if asked == PAGED_AT_ONCE
                || !self.make_room(scene, b.count as usize)?
                || !self.ask_for_block(&scene.views, block)
            {
                break;
            }
            asked += 1;
            // Done at once, it has come by now.
            self.receive(scene)?;
        }
        self.refresh(scene);
        Ok(())
    }

    /// Tells the views which of them may be trained on.
    pub fn refresh(&self, scene: &mut Scene) {
        let cameras = scene.views.cameras();
        let (stay, of) = (newest_kept(&scene.views), self.choice.candidates.len());
        scene.views.make_ready(stay, of, |first| {
            let keyframe = first / cameras;
            self.known.get(keyframe).is_none_or(|k| k.asked == 0) && self.is_whole(keyframe)
        });
    }

    fn receive(&mut self, scene: &mut Scene) -> Result<(), GpuError> {
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
            return Ok(());
        };
        if b.in_pool || !self.choice.wanted[block] || !self.make_room(scene, about.count as usize)? {
            return Ok(());
        }
        let (gpu, pool, count) = (&mut scene.gpu, &mut scene.pipeline.pool, about.count as usize);
        let in_pool = pool.insert_block(gpu, (b.anchor, b.epoch), (count, about.moments), &fetched.payload)?;
        if in_pool {
            self.blocks[block].in_pool = true;
            self.blocks[block].count = count as u32;
            scene.counters.blocks_paged_in.add(1);
            // What moved while it was away.
            let by = b.placed * about.placed.inverse();
            if by.p.length() > 0.0 || by.q.to_scaled_axis().length() > 0.0 {
                pool.move_blocks(gpu, std::iter::once((b.anchor, by)))?;
            }
        }
        Ok(())
    }

    fn take_image(&mut self, scene: &mut Scene, index: usize, fetched: &Fetched) -> Result<(), GpuError> {
        let keyframe = index / scene.views.cameras();
        self.known[keyframe].asked = self.known[keyframe].asked.saturating_sub(1);
        let placed = scene.views.has_place(index) || (self.make_place(scene)? && scene.views.place(index));
        if !placed {
            return Ok(());
        }
        if !read_planes(&fetched.payload, scene.views.planes_mut(index)) {
            scene.counters.keyframes_lost.add(1);
            self.known[keyframe].saved = false;
            scene.views.unplace(index);
            return Ok(());
        }
        scene.upload_image(index)?;
        scene.counters.images_paged_in.add(1);
        Ok(())
    }

    /// Makes room in the pool for so many Gaussians beside the reserve, by taking out blocks that are not wanted; whether they
    /// fit.
    fn make_room(&mut self, scene: &mut Scene, count: usize) -> Result<bool, GpuError> {
        let reserve = scene.pipeline.pool.capacity() / RESERVE_DIVISOR;
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
        let missing = count.saturating_sub(scene.pipeline.pool.room());
        if missing > 0 {
            scene.thin(missing)?;
        }
        Ok(scene.pipeline.pool.room() >= count)
    }

    fn take_out(&mut self, scene: &mut Scene, anchors: &[u32]) -> Result<(), GpuError> {
        if anchors.is_empty() {
            return Ok(());
        }
        scene.pipeline.pool.remove_blocks(&mut scene.gpu, |anchor| anchors.contains(&anchor))?;
        self.blocks.iter_mut().filter(|b| anchors.contains(&b.anchor)).for_each(|b| b.in_pool = false);
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

    /// Sees that a place for images is free: takes that of the keyframe that is missed least. False where all must stay.
    pub fn make_place(&mut self, scene: &mut Scene) -> Result<bool, GpuError> {
        if scene.views.has_free_place() {
            return Ok(true);
        }
        let cameras = scene.views.cameras();
        let mut tried = [usize::MAX; 4];
        for n in 0..tried.len() {
            let untried = scene.views.placed().filter(|first| !tried.contains(first));
            let ranked = untried.filter_map(|first| Some((self.rank(&scene.views, first)?, first)));
            let Some((_, first)) = ranked.max() else { break };
            tried[n] = first;
            if self.known[first / cameras].open {
                self.look_again(scene, first)?;
            }
            if self.save_keyframe(&scene.views, first / cameras) {
                scene.views.unplace(first);
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// How much the images of a keyframe may go: by kind, then by training steps since they came; `None` where they must stay.
    fn rank(&self, views: &Views, first: usize) -> Option<(u8, u32, usize)> {
        let cameras = views.cameras();
        let (entry, keyframe) = (views.get(first), first / cameras);
        let newest = views.placed().max().unwrap_or(0) / cameras;
        let recent = keyframe + newest_kept(views) > newest;
        if self.known.get(keyframe)?.asked > 0 || recent && !entry.held_out {
            return None;
        }
        // Where places are few, each would be the last of its block, and none would ever go.
        let few = views.places() < VIEWS_PER_BLOCK * self.blocks.iter().filter(|b| b.in_pool).count();
        let last = !few
            && self.home(keyframe).is_some_and(|home| {
                let shares = |f: &usize| *f != first && self.home(*f / cameras) == Some(home);
                self.blocks[home].in_pool && !views.placed().any(|f| shares(&f))
            });
        let kind = if entry.held_out {
            3
        } else if last {
            0
        } else {
            1 + u8::from(!self.is_whole(keyframe))
        };
        Some((kind, entry.steps_here, usize::MAX - first))
    }

    /// Takes the horizon of a view from the scene's last picture, which is of it, and looks from there.
    pub fn saw(&mut self, scene: &mut Scene, first: usize) {
        let (view, horizon) = (scene.view(first), Horizon::of(&scene.rendered));
        let keyframe = first / scene.views.cameras();
        scene.views.get_mut(first).horizon = horizon;
        if keyframe < self.known.len() {
            self.known[keyframe].open = horizon.open_part() > OPEN_MAX;
            self.look_from(&view, &horizon, keyframe);
        }
    }

    fn look_again(&mut self, scene: &mut Scene, first: usize) -> Result<(), GpuError> {
        let view = scene.view(first);
        scene.render(&view)?;
        self.saw(scene, first);
        self.known[first / scene.views.cameras()].open = false;
        Ok(())
    }

    /// Exchanges an image now and then.
    pub fn rotate(&mut self, scene: &mut Scene) -> Result<(), GpuError> {
        if scene.steps % self.rotation_steps != 0 || self.choice.candidates.is_empty() {
            return Ok(());
        }
        self.receive(scene)?;
        let cameras = scene.views.cameras();
        let waits = self.known.iter().any(|k| k.asked > 0);
        for _ in 0..if waits { 0 } else { DRAWS } {
            let n = self.rng.below(self.choice.candidates.len());
            let keyframe = self.choice.candidates[n] as usize;
            let known = self.known[keyframe];
            if known.saved && !scene.views.has_place(keyframe * cameras) && self.is_whole(keyframe) {
                self.ask_for_images(&scene.views, keyframe);
                self.receive(scene)?;
                break;
            }
        }
        self.refresh(scene);
        Ok(())
    }

    /// The valid pixels of a view less those that show, by the view's own depth, what is on disk; `None` where there are none of
    /// these. What is on disk is told by the horizons of the keyframes nearby one of whose blocks is not in the pool: the map
    /// covered them as far as they see.
    pub fn hide(&mut self, scene: &Scene, view: &View, depth: &[f32], valid: &[u8]) -> Option<&[u8]> {
        let (w, h, cameras) = (view.camera.width, view.camera.height, scene.views.cameras());
        let mut asked = [None; ASKED];
        let parts = self.choice.order.iter().map(|(_, keyframe)| *keyframe as usize).filter(|k| !self.is_whole(*k));
        for (to, keyframe) in asked.iter_mut().zip(parts) {
            let index = keyframe * cameras;
            *to = Some((scene.view(index), scene.views.get(index).horizon));
        }
        asked[0]?;
        // Points of a cell that have depth, and how many of them are known.
        let (mut points, mut known) = ([0u8; CELLS], [0u8; CELLS]);
        let (across, down) = ((w / (COLUMNS * POINTS)).max(1), (h / (ROWS * POINTS)).max(1));
        for y in (down / 2..h).step_by(down) {
            for x in (across / 2..w).step_by(across) {
                let z = f64::from(depth[y * w + x]);
                let Some(point) = (z > 0.0).then(|| view.point(x, y, z)).flatten() else { continue };
                let cell = cell_of(x as f64, y as f64, w, h);
                points[cell] += 1;
                known[cell] += u8::from(asked.iter().flatten().any(|(view, horizon)| horizon.shows(view, point)));
            }
        }
        let shows = |cell: usize| points[cell] > 0 && 2 * known[cell] > points[cell];
        if !(0..CELLS).any(shows) {
            return None;
        }
        let hidden = &mut self.choice.hidden;
        hidden.clear();
        hidden.extend(valid.iter().enumerate().map(|(i, valid)| {
            let cell = cell_of((i % w) as f64, (i / w) as f64, w, h);
            if shows(cell) {
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
        let keyframe = index / scene.views.cameras();
        self.leave_other_epochs(scene, scene.views.get(index).epoch)?;
        self.want_seen_by(keyframe, scene.pipeline.pool.capacity());
        let begun = Instant::now();
        let missing = |a: &Archive| a.choice.blocks.iter().any(|b| a.blocks[*b as usize].asked);
        loop {
            self.page(scene, false)?;
            if !missing(self) || begun.elapsed() > PATIENCE {
                break;
            }
            std::thread::sleep(Duration::from_millis(1));
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
