//! What goes to the store: blocks and keyframes, once they are complete, as they change, and before they leave the pool.

use super::archive::{part_id, Archive, Block};
use super::block::{BlockAbout, KIND_BLOCK, KIND_IMAGE, KIND_KEYFRAME, NO_BLOCK, SAMPLES};
use super::filing::{image_id, state, BLOCKS_KNOWN, MOMENTS};
use super::paging::splat_bytes;
use super::parts::{parts_of, start_of, PARTS};
use super::pool::Pool;
use super::scene::Scene;
use super::views::Views;
use crate::gpu::kernels::types::Splat;
use crate::gpu::GpuError;
use crate::store;
use stipple_drivers::{Fault, Pose};

/// Blocks beyond which none is cut: what remains is for whole ones.
const BLOCKS_CUT: usize = BLOCKS_KNOWN / 4 * 3;

/// Gaussians for each sample of a block, and the samples that it has at least.
const GAUSSIANS_A_SAMPLE: usize = 10;
const SAMPLES_MIN: usize = 8;
/// Blocks and states of keyframes written when a keyframe comes, at most.
const BLOCKS_AT_ONCE: usize = 64;
const STATES_AT_ONCE: usize = 16;

/// A Gaussian's mean and how large its disc is, σ, m: the geometric mean of its two larger axes.
fn sample(splat: &Splat) -> [f32; 4] {
    let ([x, y, z, _], [a, b, c, _]) = (splat.mean_opacity, splat.scale_colour);
    [x, y, z, ((a + b + c - a.min(b).min(c)) / 2.0).exp()]
}

impl Block {
    /// Takes samples of so many Gaussians from their arrays.
    pub fn look_at(&mut self, count: usize, bytes: &[u8]) {
        let splat =
            |at: usize| bytemuck::pod_read_unaligned::<Splat>(&bytes[at * size_of::<Splat>()..][..size_of::<Splat>()]);
        (self.count, self.samples_len) = (count as u32, 0);
        let samples = (count / GAUSSIANS_A_SAMPLE).clamp(SAMPLES_MIN, SAMPLES).min(count);
        for i in 0..samples {
            // The largest of each few: what is seen from afar, and reaches farthest.
            let few = (i * count / samples)..((i + 1) * count / samples);
            let sampled = few.map(|at| sample(&splat(at))).filter(|s| s.iter().all(|v| v.is_finite()));
            if let Some(largest) = sampled.max_by(|a, b| a[3].total_cmp(&b[3])) {
                self.samples[usize::from(self.samples_len)] = largest;
                self.samples_len += 1;
            }
        }
    }

    /// What the store keeps in its header.
    pub fn about(&self, colour: bool) -> BlockAbout {
        BlockAbout {
            epoch: self.epoch,
            count: self.count,
            colour,
            moments: MOMENTS,
            placed: self.placed,
            moved: Pose::IDENTITY,
            samples: self.samples,
            samples_len: self.samples_len,
        }
    }
}

impl Archive {
    /// Cuts a block that is complete into its parts, hands them to the store and looks who sees them.
    pub fn complete(&mut self, scene: &mut Scene, block: usize) -> Result<(), GpuError> {
        let more = self.blocks.len();
        self.cut(scene, block)?;
        for part in std::iter::once(block).chain(more..self.blocks.len()) {
            self.save_block(scene, part)?;
            self.look_for(scene, part);
        }
        Ok(())
    }

    /// Cuts a block into parts, in the pool and here; not where it is small or cut already, or more blocks do not fit.
    fn cut(&mut self, scene: &mut Scene, block: usize) -> Result<(), GpuError> {
        let b = self.blocks[block];
        let (gpu, pool): (_, &mut Pool) = (&mut scene.gpu, &mut scene.pipeline.pool);
        let count = pool.block(b.number).len();
        let parts = parts_of(count);
        let fits = self.blocks.len() + parts - 1 <= BLOCKS_CUT && pool.may_have(parts - 1);
        let is_cut = b.number % PARTS != 0 || self.block_of(b.number + 1).is_some();
        if parts < 2 || !fits || is_cut {
            return Ok(());
        }
        let mut bytes = std::mem::take(&mut self.choice.page);
        bytes.clear();
        let cut = pool.read_block(gpu, b.number, MOMENTS, &mut bytes).and_then(|_| {
            let ordered = self.choice.ordering.put_in_order(&bytes, count, parts, pool.colour);
            pool.write_block(gpu, b.number, MOMENTS, ordered)
        });
        self.choice.page = bytes;
        cut?;
        let first = pool.block(b.number).start;
        for part in 1..parts {
            let number = b.number + part as u32;
            pool.cut_block(number - 1, number, first + start_of(part, parts, count) as u32);
            self.know_block(Block { number, ..b });
        }
        Ok(())
    }

    /// Hands a block in the pool to the store, and looks where its Gaussians are; false where the store takes none now.
    pub fn save_block(&mut self, scene: &mut Scene, block: usize) -> Result<bool, GpuError> {
        Ok(self.save_blocks(scene, &[(0.0, block as u32)], true)? == 1)
    }

    /// Hands blocks in the pool to the store, all or those that changed; how many of them, from the first on, it has now.
    pub fn save_blocks(&mut self, scene: &mut Scene, blocks: &[(f32, u32)], all: bool) -> Result<usize, GpuError> {
        let mut bytes = std::mem::take(&mut self.choice.page);
        let saved = self.save_pages(scene, blocks, all, &mut bytes);
        self.choice.page = bytes;
        saved
    }

    /// Does what `save_blocks` does, with room for the bytes of some of them.
    fn save_pages(
        &mut self,
        scene: &mut Scene,
        blocks: &[(f32, u32)],
        all: bool,
        bytes: &mut Vec<u8>,
    ) -> Result<usize, GpuError> {
        if !self.store.has_room() {
            self.serve();
            if !self.store.has_room() {
                return Ok(0);
            }
        }
        let (mut done, colour) = (0, scene.pipeline.pool.colour);
        while done < blocks.len() {
            // What has not changed is there as it is.
            let goes = |(_, block): &&(f32, u32)| all || self.blocks[*block as usize].changed();
            done += blocks[done..].iter().take_while(|block| !goes(block)).count();
            let upto = done + blocks[done..].iter().take_while(goes).count();
            let put = self.read_pages(scene, &blocks[done..upto], bytes, |archive, views, block, count, own| {
                archive.put_block(views, block, colour, count, own)
            })?;
            done += put;
            if done < upto {
                break;
            }
        }
        Ok(done)
    }

    /// Reads blocks in the pool, some at once as `bytes` has room, and hands each one's arrays over; how many were taken, from
    /// the first on.
    pub fn read_pages(
        &mut self,
        scene: &mut Scene,
        blocks: &[(f32, u32)],
        bytes: &mut Vec<u8>,
        mut take: impl FnMut(&mut Archive, &Views, usize, usize, &[u8]) -> bool,
    ) -> Result<usize, GpuError> {
        let (gpu, pool) = (&mut scene.gpu, &mut scene.pipeline.pool);
        let each = splat_bytes(pool.colour, MOMENTS);
        let mut done = 0;
        while done < blocks.len() {
            let number = |at: usize| self.blocks[blocks[at].1 as usize].number;
            let (mut upto, mut size) = (done, 0);
            while upto < blocks.len() {
                let more = pool.block(number(upto)).len() * each;
                if size > 0 && size + more > bytes.capacity() {
                    break;
                }
                (upto, size) = (upto + 1, size + more);
            }
            bytes.clear();
            pool.read_blocks(gpu, (done..upto).map(number), MOMENTS, bytes)?;
            let mut rest = &bytes[..];
            for &(_, block) in &blocks[done..upto] {
                let count = pool.block(self.blocks[block as usize].number).len();
                let (own, after) = rest.split_at(count * each);
                rest = after;
                if !take(self, &scene.views, block as usize, count, own) {
                    return Ok(done);
                }
                done += 1;
            }
        }
        Ok(done)
    }

    /// Hands a block's arrays to the store; false where it takes none now.
    fn put_block(&mut self, views: &Views, block: usize, colour: bool, count: usize, bytes: &[u8]) -> bool {
        if !self.store.has_room() {
            self.serve();
        }
        // The header tells where the Gaussians are, so they are looked at first.
        self.look_at(block, count, bytes);
        let b = &self.blocks[block];
        let about = b.about(colour);
        let key = self.key(KIND_BLOCK, part_id(views, b));
        let taken = self.store.put(key, &about.encode(), |payload| payload.extend_from_slice(bytes));
        if taken {
            let b = &mut self.blocks[block];
            b.written = Some(b.steps);
        }
        self.serve();
        taken
    }

    /// Takes a block's samples from its arrays.
    fn look_at(&mut self, block: usize, count: usize, bytes: &[u8]) {
        if self.blocks[block].samples_len == 0 {
            self.exchanged(block);
        }
        self.blocks[block].look_at(count, bytes);
        if self.blocks[block].samples_len == 0 {
            self.exchanged(block);
        }
        self.measure(block);
    }

    /// Hands a keyframe's images to the store, once.
    pub fn save_images(&mut self, views: &Views, index: usize) {
        let (keyframe, cameras) = (index / views.cameras(), views.cameras());
        let Some(known) = self.known.get(keyframe).copied() else { return };
        if known.saved || !views.has_place(index) {
            return;
        }
        for camera in 0..cameras {
            let id = image_id(views, keyframe * cameras + camera);
            let planes = views.planes(keyframe * cameras + camera);
            let fill = |payload: &mut Vec<u8>| planes.iter().for_each(|p| payload.extend_from_slice(&p.pixels));
            if !self.store.put(self.key(KIND_IMAGE, id), &[0; store::ABOUT], fill) {
                return;
            }
            self.serve();
        }
        self.known[keyframe].saved = true;
        self.save_state(views, keyframe);
    }

    /// Hands what is known of a keyframe to the store.
    fn save_state(&mut self, views: &Views, keyframe: usize) -> bool {
        self.look_at_changed();
        let (cameras, home) = (views.cameras(), self.known[keyframe].home);
        let home = home.map_or(NO_BLOCK, |anchor| views.get(anchor as usize).id as u32);
        for index in keyframe * cameras..(keyframe + 1) * cameras {
            let about = state(views.get(index), home);
            if !self.store.put(self.key(KIND_KEYFRAME, image_id(views, index)), &about.encode(), |_| ()) {
                return false;
            }
            self.serve();
        }
        self.known[keyframe].stated = views.get(keyframe * cameras).steps;
        true
    }

    /// Writes a few of the blocks and states that have changed most while the map trained.
    pub fn save_some(&mut self, scene: &mut Scene) -> Result<(), GpuError> {
        let mut due = std::mem::take(&mut self.choice.ranked);
        due.clear();
        // The newest is written when it is densified.
        let is_due = |b: &Block| b.in_pool && b.samples_len > 0 && b.is_due();
        let blocks = self.blocks.len();
        let turns = (self.next_block..blocks).chain(0..self.next_block.min(blocks));
        due.extend(turns.filter(|b| is_due(&self.blocks[*b])).take(BLOCKS_AT_ONCE).map(|b| (0.0, b as u32)));
        let saved = self.save_blocks(scene, &due, true);
        if let Ok(saved) = saved {
            // The first that was not written is the next one.
            let last = due.last().map_or(self.next_block, |(_, b)| *b as usize + 1);
            self.next_block = due.get(saved).map_or(last, |(_, b)| *b as usize);
        }
        self.choice.ranked = due;
        saved?;
        let keyframes = self.known.len();
        for _ in 0..STATES_AT_ONCE.min(keyframes) {
            self.next_state = (self.next_state + 1) % keyframes;
            self.save_keyframe(&scene.views, self.next_state);
        }
        Ok(())
    }

    /// Writes of a keyframe what was not written yet; whether all of it is in the store.
    pub fn save_keyframe(&mut self, views: &Views, keyframe: usize) -> bool {
        let index = keyframe * views.cameras();
        self.save_images(views, index);
        let known = self.known[keyframe];
        known.saved && (known.stated == views.get(index).steps || self.save_state(views, keyframe))
    }

    /// Writes a block if it has changed since it was written; whether the store has it as it is.
    pub fn save_if_changed(&mut self, scene: &mut Scene, block: usize) -> Result<bool, GpuError> {
        Ok(!self.blocks[block].changed() || self.save_block(scene, block)?)
    }

    /// Writes all that has changed, waits until it is on the disk, and answers whether the store has the whole map. Fails
    /// where it cannot be written.
    pub fn flush(&mut self, scene: &mut Scene) -> Result<Result<bool, Fault>, GpuError> {
        let mut whole = true;
        for block in 0..self.blocks.len() {
            if self.blocks[block].in_pool && !self.save_if_changed(scene, block)? {
                if let Err(fault) = self.store.flush() {
                    return Ok(Err(fault));
                }
                whole &= self.save_if_changed(scene, block)?;
            }
        }
        for keyframe in 0..self.known.len() {
            if !self.save_keyframe(&scene.views, keyframe) {
                if let Err(fault) = self.store.flush() {
                    return Ok(Err(fault));
                }
                whole &= self.save_keyframe(&scene.views, keyframe);
            }
        }
        let flushed = self.store.flush();
        if whole && flushed.is_ok() {
            // The store has later generations of what stays.
            self.latest.iter_mut().for_each(|latest| _ = latest.clear());
        }
        Ok(flushed.map(|()| whole))
    }
}
