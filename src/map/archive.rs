//! What of the map is on disk, and what of it is in memory.
//!
//! The store on disk is the map: a block of Gaussians for each anchor, and every keyframe with its images. The pool of
//! Gaussians and the places for images are caches of it, and so the map may be larger than both. What should be in them is
//! chosen when a keyframe comes (`residency`): blocks go out and come in whole, between training steps. Images are fetched
//! when a step on them was drawn (`rotation`).
//! Blocks are written once their anchor was densified, again whenever they had a quarter more training steps, and before they
//! go; images once. Two threads of the store write and read, in lockstep this one, so that a run can be repeated to the bit. What
//! cannot be written to a full or broken disk stays in memory, and what finds no room there is thinned as without a store.

use super::block::{BlockAbout, KeyframeAbout, RunAbout};
use super::block::{KIND_BLOCK, KIND_IMAGE, KIND_KEYFRAME, NO_BLOCK, SAMPLES};
use super::choice::{Choice, Drawn};
use super::filing::{
    entry, identity, image_id, keyframes_known, limits, payload_max, run_key, state, BLOCKS_KNOWN, MOMENTS,
};
use super::horizon::ball;
use super::scene::Scene;
use super::shape::Shape;
use super::views::Views;
use crate::config::Board;
use crate::counters::Counters;
use crate::gpu::GpuError;
use crate::limits::CAMERAS_MAX;
use crate::mem::{unsealed, Footprint};
use crate::store::{self, Disk, Fetched, Key, Store};
use glam::Vec3;
use std::path::Path;
use std::sync::Arc;
use stipple_drivers::{host, Calibration, Fault, FaultKind, Pose};

/// Training steps after which a block is written again, as a part of those it had, and at least.
const REWRITTEN_PART: f64 = 0.25;
const REWRITTEN_MIN: u32 = 100;
/// Least space on the disk that a map is begun with, bytes.
const BYTES_MIN: u64 = 128 << 20;
/// Blocks and states of keyframes written when a keyframe comes, at most.
const BLOCKS_AT_ONCE: usize = 2;
const STATES_AT_ONCE: usize = 4;

/// Where the store is, and how it is used.
#[derive(Clone, Copy, Debug)]
pub struct Place<'a> {
    pub folder: &'a Path,
    /// Whether what is there is set aside.
    pub fresh: bool,
    /// When the flight began, ms since 1970. A mapper of the flight that was there last goes on with its map; another begins
    /// a run of its own beside the earlier ones. `None`: whatever flight was there last, to look at its map.
    pub flight: Option<i64>,
    /// Whether what is asked of the disk is done at once, on the mapper's thread: for lockstep.
    pub at_once: bool,
}

/// A block that is known.
#[derive(Clone, Copy, Debug)]
pub struct Block {
    /// Index of its anchor among the views.
    pub anchor: u32,
    pub epoch: u32,
    /// Gaussians when it was last looked at.
    pub count: u32,
    pub samples: [[f32; 3]; SAMPLES],
    pub samples_len: u8,
    pub centre: Vec3,
    pub radius: f32,
    /// Where its Gaussians were put in place from.
    pub placed: Pose,
    pub in_pool: bool,
    /// It was asked of the disk and has not come yet.
    pub asked: bool,
    /// Training steps of views that see it, and how many of them had been taken when it was last written.
    pub steps: u32,
    written: Option<u32>,
}

impl Block {
    pub fn points(&self) -> &[[f32; 3]] {
        &self.samples[..usize::from(self.samples_len)]
    }

    fn changed(&self) -> bool {
        self.written.is_none_or(|at| self.steps > at)
    }

    /// Whether enough steps were taken to write it again.
    fn is_due(&self) -> bool {
        self.written.is_none_or(|at| self.steps - at >= REWRITTEN_MIN.max((f64::from(at) * REWRITTEN_PART) as u32))
    }
}

/// What the archive knows of a keyframe beside its views.
#[derive(Clone, Copy, Debug, Default)]
pub struct Known {
    /// Its images were handed to the store.
    pub saved: bool,
    /// Its images were asked of the disk; how many have not come.
    pub asked: u8,
    /// Its steps when its state was last written.
    stated: u32,
    /// The horizon was taken from a picture with much of it still open.
    pub open: bool,
    /// The exchange of blocks after which what is hidden of it was last looked at.
    pub looked_at: u64,
    /// One of its images could not be had: those that come go.
    pub in_part: bool,
}

pub struct Archive {
    pub store: Store,
    disk: Arc<Disk>,
    at_once: bool,
    pub run: u32,
    /// Epoch 0 of this run, in the store.
    epoch_base: u32,
    /// The run, and whether it was there before.
    about: RunAbout,
    pub goes_on: bool,
    pub blocks: Vec<Block>,
    pub known: Vec<Known>,
    /// How many of a block's samples a keyframe sees: keyframe by keyframe.
    pub sight: Vec<u8>,
    pub choice: Choice,
    /// A new block grows: none comes behind it.
    pub growing: bool,
    /// How often blocks came, went, moved or were first sampled.
    pub exchanges: u64,
    pub drawn: Drawn,
    /// The next block and keyframe that are looked at for writing.
    next_block: usize,
    next_state: usize,
}

impl Archive {
    /// Bytes on the host.
    pub fn footprint(board: &Board, shape: &Shape, f: &mut Footprint) {
        f.build("map: blocks and keyframes known", || tables(board, shape));
        f.build("map: views drawn", || Drawn::new(board, shape, false));
        f.extend(Store::footprint(&limits(board, shape, false)));
    }

    /// Opens the store for a run.
    pub fn open(place: Place, calibration: &Calibration, board: &Board, shape: &Shape) -> Result<Archive, Fault> {
        if place.fresh {
            store::set_aside(place.folder)?;
        }
        let mut limits = limits(board, shape, place.at_once);
        // Others write to the disk, too: the log of the run first of all.
        let free = place.folder.parent().and_then(host::disk_free).unwrap_or(u64::MAX);
        limits.bytes_max = limits.bytes_max.min(free / 2);
        if limits.bytes_max < BYTES_MIN {
            let what =
                format!("has {} MiB of free space, less than twice the {} of a map", free >> 20, BYTES_MIN >> 20);
            let fix = "make room, or name another --out folder";
            return Err(Fault::new(FaultKind::NoOutput, place.folder.display().to_string(), what, fix));
        }
        let (store, disk) = Store::open(place.folder, identity(calibration, board, shape), &limits)?;
        let (mut run, mut epochs) = (0, 0);
        store.entries(|key, about| {
            run = run.max(key.run + 1);
            let epoch = match key.kind {
                KIND_BLOCK => BlockAbout::decode(about).map(|b| b.epoch),
                KIND_KEYFRAME => KeyframeAbout::decode(about).map(|k| k.epoch),
                _ => RunAbout::decode(about).map(|r| r.epoch_base),
            };
            epochs = epochs.max(epoch.map_or(0, |e| e + 1));
        });
        let last = |store: &Store, run: u32| store.about(&run_key(run)).and_then(|about| RunAbout::decode(&about));
        let newest = run.checked_sub(1).and_then(|run| Some((run, last(&store, run)?)));
        let (run, about, goes_on) =
            match newest.filter(|(_, about)| place.flight.is_none_or(|flight| about.started_unix_ms == flight)) {
                Some((run, about)) => (run, about, true),
                None => {
                    let about = RunAbout {
                        epoch_base: epochs,
                        started_unix_ms: place.flight.unwrap_or_default(),
                        colour: shape.channels == 3,
                        width: shape.width,
                        height: shape.height,
                        cameras: shape.cameras,
                        channels: shape.channels,
                        scene_depth_m: 0.0,
                    };
                    (run, about, false)
                }
            };
        let (blocks, known, sight, choice) = tables(board, shape);
        let mut archive = Archive {
            store,
            disk: Arc::new(disk),
            at_once: place.at_once,
            run,
            epoch_base: about.epoch_base,
            about,
            goes_on,
            blocks,
            known,
            sight,
            choice,
            growing: false,
            exchanges: 1,
            drawn: Drawn::new(board, shape, place.at_once),
            next_block: 0,
            next_state: 0,
        };
        archive.state_run();
        Ok(archive)
    }

    /// The side of the store that reads and writes, for the threads that do; `None` where this thread does.
    pub fn disk(&self) -> Option<Arc<Disk>> {
        (!self.at_once).then(|| self.disk.clone())
    }

    /// Does what waits for the disk where no threads do.
    fn serve(&self) {
        if self.at_once {
            unsealed(|| self.disk.serve());
        }
    }

    fn state_run(&mut self) {
        let about = self.about.encode();
        self.store.put(run_key(self.run), &about, |_| ());
        self.serve();
    }

    /// Median depth of the scene at the first anchor, m, if the run had one.
    pub fn scene_depth_m(&self) -> Option<f64> {
        Some(self.about.scene_depth_m).filter(|depth| *depth > 0.0)
    }

    pub fn set_scene_depth(&mut self, depth_m: f64) {
        self.about.scene_depth_m = depth_m;
        self.state_run();
    }

    fn key(&self, kind: u8, id: u32) -> Key {
        Key { kind, run: self.run, id }
    }

    /// Takes over what the last run left: every keyframe and block is known, and none is in memory.
    pub fn resume(&mut self, views: &mut Views) {
        let (mut states, cameras) = (vec![], views.cameras());
        self.store.entries(|key, about| {
            if key.kind == KIND_KEYFRAME && key.run == self.run {
                states.extend(KeyframeAbout::decode(about).map(|state| (key.id, state)));
            }
        });
        states.sort_unstable_by_key(|(id, _)| *id);
        // All views of a keyframe, and its images, or none.
        let whole: Vec<_> = states
            .chunk_by(|a, b| a.0 / CAMERAS_MAX as u32 == b.0 / CAMERAS_MAX as u32)
            .filter(|of_one| of_one.len() == cameras)
            .filter(|of_one| of_one.iter().all(|(id, _)| self.store.about(&self.key(KIND_IMAGE, *id)).is_some()))
            .collect();
        for (id, state) in whole.into_iter().flatten() {
            views.know(entry(*id, state, self.epoch_base));
        }
        self.know_keyframes(views.len() / cameras);
        for (keyframe, known) in self.known.iter_mut().enumerate() {
            (known.saved, known.stated) = (true, views.get(keyframe * cameras).steps);
        }
        let mut found = vec![];
        self.store.entries(|key, about| {
            if key.kind == KIND_BLOCK && key.run == self.run {
                found.extend(BlockAbout::decode(about).map(|block| (key.id, block)));
            }
        });
        found.sort_unstable_by_key(|(id, _)| *id);
        for (id, b) in found {
            let Some(anchor) = views.index_of(u64::from(id)) else { continue };
            let steps = views.get(anchor).steps;
            let entry = views.get_mut(anchor);
            (entry.anchor, entry.placed) = (true, b.placed);
            self.blocks.push(Block {
                anchor: anchor as u32,
                epoch: b.epoch - self.epoch_base,
                count: b.count,
                samples: b.samples,
                samples_len: b.samples_len,
                centre: Vec3::ZERO,
                radius: 0.0,
                placed: b.placed,
                in_pool: false,
                asked: false,
                steps,
                written: Some(steps),
            });
            self.measure(self.blocks.len() - 1);
        }
    }

    fn know_keyframes(&mut self, count: usize) {
        while self.known.len() < count && self.known.len() < self.known.capacity() {
            self.known.push(Known::default());
        }
    }

    /// Takes in a keyframe that was added to the views, whose images are written.
    pub fn take_in(&mut self, scene: &Scene, index: usize) {
        self.know_keyframes(scene.views.len() / scene.views.cameras());
        self.save_images(&scene.views, index);
    }

    /// The number of the block of an anchor.
    pub fn block_of(&self, anchor: u32) -> Option<usize> {
        self.blocks.iter().position(|b| b.anchor == anchor)
    }

    /// Takes in the block that was opened for an anchor.
    pub fn open_block(&mut self, views: &Views, anchor: usize) {
        if self.blocks.len() == BLOCKS_KNOWN {
            return;
        }
        let entry = views.get(anchor);
        self.blocks.push(Block {
            anchor: anchor as u32,
            epoch: entry.epoch,
            count: 0,
            samples: [[0.0; 3]; SAMPLES],
            samples_len: 0,
            centre: Vec3::ZERO,
            radius: 0.0,
            placed: entry.placed,
            in_pool: true,
            asked: false,
            steps: 0,
            written: None,
        });
    }

    /// Whether another block can be made.
    pub fn is_full(&self) -> bool {
        self.blocks.len() == BLOCKS_KNOWN
    }

    /// A block's ball, from its samples.
    fn measure(&mut self, block: usize) {
        let b = &mut self.blocks[block];
        (b.centre, b.radius) = ball(&b.samples[..usize::from(b.samples_len)]);
    }

    /// Hands a block in the pool to the store, and looks where its Gaussians are; false where the store takes none now.
    pub fn save_block(&mut self, scene: &mut Scene, block: usize) -> Result<bool, GpuError> {
        if !self.store.has_room() {
            self.serve();
            if !self.store.has_room() {
                return Ok(false);
            }
        }
        let b = self.blocks[block];
        let id = scene.views.get(b.anchor as usize).id as u32;
        let (gpu, pool) = (&mut scene.gpu, &mut scene.pipeline.pool);
        // The header tells where the Gaussians are, so they are looked at first.
        let (mut bytes, mut failed) = (std::mem::take(&mut self.choice.page), None);
        bytes.clear();
        match pool.read_block(gpu, b.anchor, MOMENTS, &mut bytes) {
            Ok(count) => self.look_at(block, count, &bytes),
            Err(e) => failed = Some(e),
        }
        let b = &self.blocks[block];
        let about = BlockAbout {
            epoch: b.epoch + self.epoch_base,
            count: b.count,
            colour: pool.colour,
            moments: MOMENTS,
            placed: b.placed,
            moved: Pose::IDENTITY,
            samples: b.samples,
            samples_len: b.samples_len,
        };
        let taken = failed.is_none()
            && self.store.put(self.key(KIND_BLOCK, id), &about.encode(), |payload| payload.extend_from_slice(&bytes));
        self.choice.page = bytes;
        if taken {
            let b = &mut self.blocks[block];
            b.written = Some(b.steps);
        }
        self.serve();
        failed.map_or(Ok(taken), Err)
    }

    /// Takes a block's samples from its arrays.
    fn look_at(&mut self, block: usize, count: usize, bytes: &[u8]) {
        const SPLAT: usize = size_of::<crate::gpu::kernels::types::Splat>();
        self.exchanges += u64::from(self.blocks[block].samples_len == 0);
        let b = &mut self.blocks[block];
        (b.count, b.samples_len) = (count as u32, 0);
        for i in 0..SAMPLES.min(count) {
            let at = (i * count / SAMPLES.min(count)) * SPLAT;
            let mean: [f32; 3] = bytemuck::pod_read_unaligned(&bytes[at..at + 12]);
            if mean.iter().all(|v| v.is_finite()) {
                b.samples[usize::from(b.samples_len)] = mean;
                b.samples_len += 1;
            }
        }
        self.measure(block);
    }

    fn save_images(&mut self, views: &Views, index: usize) {
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
        let cameras = views.cameras();
        let home = self.home(keyframe).map_or(NO_BLOCK, |b| views.get(self.blocks[b].anchor as usize).id as u32);
        for index in keyframe * cameras..(keyframe + 1) * cameras {
            let about = state(views.get(index), home, self.epoch_base);
            if !self.store.put(self.key(KIND_KEYFRAME, image_id(views, index)), &about.encode(), |_| ()) {
                return false;
            }
            self.serve();
        }
        self.known[keyframe].stated = views.get(keyframe * cameras).steps;
        true
    }

    /// Counts a training step on a view.
    pub fn trained(&mut self, keyframe: usize) {
        let row = &self.sight[keyframe * BLOCKS_KNOWN..][..self.blocks.len()];
        for (block, seen) in self.blocks.iter_mut().zip(row) {
            block.steps += u32::from(*seen > 0 && block.in_pool);
        }
    }

    /// Writes a few of the blocks and states that have changed most while the map trained.
    pub fn save_some(&mut self, scene: &mut Scene) -> Result<(), GpuError> {
        let mut written = 0;
        for _ in 0..self.blocks.len() {
            self.next_block = (self.next_block + 1) % self.blocks.len();
            let b = self.blocks[self.next_block];
            // The newest is written when it is densified.
            let complete = b.samples_len > 0;
            if b.in_pool && complete && b.is_due() {
                if written == BLOCKS_AT_ONCE || !self.save_block(scene, self.next_block)? {
                    break;
                }
                written += 1;
            }
        }
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
        Ok(self.store.flush().map(|()| whole))
    }

    /// Gaussians that are on disk alone.
    pub fn away(&self) -> usize {
        self.blocks.iter().filter(|b| !b.in_pool && b.samples_len > 0).map(|b| b.count as usize).sum()
    }

    /// Takes over where anchors are by now, and moves what is known of their blocks along.
    pub fn follow(&mut self, views: &Views) {
        for block in 0..self.blocks.len() {
            let b = &mut self.blocks[block];
            let placed = views.get(b.anchor as usize).placed;
            let by = placed * b.placed.inverse();
            if by.p.length() == 0.0 && by.q.to_scaled_axis().length() == 0.0 {
                continue;
            }
            for point in &mut b.samples[..usize::from(b.samples_len)] {
                *point = by.transform(Vec3::from_array(*point).as_dvec3()).as_vec3().to_array();
            }
            b.placed = placed;
            // Moved, it is another one than on disk.
            b.steps += u32::from(b.in_pool);
            self.measure(block);
            self.exchanges += 1;
        }
    }

    /// Asks the disk for a block; false where it cannot be asked now.
    pub fn ask_for_block(&mut self, views: &Views, block: usize) -> bool {
        let key = self.key(KIND_BLOCK, views.get(self.blocks[block].anchor as usize).id as u32);
        let asked = self.blocks[block].asked || self.store.fetch(key);
        self.blocks[block].asked = asked;
        self.serve();
        asked
    }

    /// Asks the disk for a keyframe's images; false where it cannot be asked now.
    pub fn ask_for_images(&mut self, views: &Views, keyframe: usize) -> bool {
        let cameras = views.cameras();
        for camera in 0..cameras {
            if !self.store.fetch(self.key(KIND_IMAGE, image_id(views, keyframe * cameras + camera))) {
                self.known[keyframe].in_part = self.known[keyframe].asked > 0;
                return self.known[keyframe].asked > 0;
            }
            self.known[keyframe].asked += 1;
        }
        self.serve();
        true
    }

    /// What came from the disk, told by what it is; buffers are given back by `store.give_back`.
    pub fn next_fetched(&mut self, views: &Views) -> Option<(Arrived, Fetched)> {
        let fetched = self.store.fetched()?;
        let key = fetched.key;
        let arrived = match key.kind {
            KIND_BLOCK => {
                let block = views.index_of(u64::from(key.id)).and_then(|anchor| self.block_of(anchor as u32));
                block.map_or(Arrived::Unknown, Arrived::Block)
            }
            _ => {
                let (id, camera) = (key.id / CAMERAS_MAX as u32, key.id as usize % CAMERAS_MAX);
                views.index_of(u64::from(id)).map_or(Arrived::Unknown, |first| Arrived::Image(first + camera))
            }
        };
        Some((arrived, fetched))
    }

    /// Adds the store's figures to the counters.
    pub fn count(&self, counters: &Counters) {
        let f = self.store.figures();
        for (counter, value) in [
            (&counters.store_bytes_put, f.put_bytes),
            (&counters.store_bytes_written, f.written_bytes),
            (&counters.store_bytes_read, f.read_bytes),
            (&counters.store_records_damaged, f.records_damaged),
            (&counters.store_refused_full, f.refused_full),
            (&counters.store_write_errors, f.write_errors),
        ] {
            counter.raise(value);
        }
    }
}

/// What came from the disk.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Arrived {
    Block(usize),
    /// The view whose image it is.
    Image(usize),
    Unknown,
}

fn tables(board: &Board, shape: &Shape) -> (Vec<Block>, Vec<Known>, Vec<u8>, Choice) {
    let keyframes = keyframes_known(board, shape);
    (
        Vec::with_capacity(BLOCKS_KNOWN),
        Vec::with_capacity(keyframes),
        vec![0; keyframes * BLOCKS_KNOWN],
        Choice::new(keyframes, payload_max(board, shape), shape.pixels(), board.map.evict),
    )
}
