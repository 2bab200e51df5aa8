//! What of the map is on disk, and what of it is in memory.
//!
//! The store on disk is the map: a block of Gaussians for each anchor, and every keyframe with its images. The pool of
//! Gaussians and the places for images are caches of it, and so the map may be larger than both. What should be in them is
//! chosen when a keyframe comes (`residency`): blocks go out and come in whole, between training steps. Images are fetched
//! when a step on them was drawn (`rotation`).
//! Blocks are written once their anchor was densified, again whenever they had a quarter more training steps, and before they
//! go; images once. Two threads of the store write and read, in lockstep this one, so that a run can be repeated to the bit. With
//! each keyframe all that has changed since is written at once beside the store (`latest`), for a mapper that dies. What cannot
//! be written to a full or broken disk stays in memory, and what finds no room there is thinned as without a store.

use super::block::{BlockAbout, KeyframeAbout, RunAbout};
use super::block::{JoinAbout, KIND_BLOCK, KIND_IMAGE, KIND_JOIN, KIND_KEYFRAME, NO_BLOCK, SAMPLES};
use super::choice::{Choice, Drawn};
use super::filing::image_id;
use super::filing::{entry, identity, keyframes_known, latest_max, limits, payload_max, run_key, BLOCKS_KNOWN};
use super::horizon::ball;
use super::parts::PARTS;
use super::runs::{Run, Runs};
use super::scene::Scene;
use super::seen::Sight;
use super::shape::Shape;
use super::views::Views;
use crate::config::Board;
use crate::counters::Counters;
use crate::gpu::GpuError;
use crate::limits::CAMERAS_MAX;
use crate::mem::{unsealed, Footprint};
use crate::store::{self, Disk, Fetched, Key, Snapshot, Store};
use glam::{DVec3, Vec3};
use std::io;
use std::path::Path;
use std::sync::Arc;
use stipple_drivers::{host, Calibration, Fault, FaultKind, Nanos, Pose};

/// Training steps after which a block is written again, as a part of those it had, and at least.
const REWRITTEN_PART: f64 = 0.25;
const REWRITTEN_MIN: u32 = 10;
/// Training steps on a view at which its horizon is first taken again, and from one time to the next.
const FIRST_LOOK: u32 = 5;
const LOOKS_RATIO: u32 = 4;
/// Before any stamp.
const LONG_AGO: Nanos = Nanos(i64::MIN / 4);
/// A snapshot takes at most this part of the space that the store may take.
const LATEST_DIVISOR: u64 = 4;
/// Least space on the disk that a map is begun with, bytes.
const BYTES_MIN: u64 = 128 << 20;

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
    /// Which part of the anchor's Gaussians it is (`parts`).
    pub number: u32,
    pub epoch: u32,
    /// Gaussians when it was last looked at.
    pub count: u32,
    pub samples: [[f32; 4]; SAMPLES],
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
    pub written: Option<u32>,
}

impl Block {
    pub fn samples(&self) -> &[[f32; 4]] {
        &self.samples[..usize::from(self.samples_len)]
    }

    pub fn changed(&self) -> bool {
        self.written.is_none_or(|at| self.steps > at)
    }

    /// Whether enough steps were taken to write it again.
    pub fn is_due(&self) -> bool {
        self.written.is_none_or(|at| self.steps - at >= REWRITTEN_MIN.max((f64::from(at) * REWRITTEN_PART) as u32))
    }
}

/// The id of a part of a block in the store.
pub fn part_id(views: &Views, b: &Block) -> u32 {
    views.get(b.anchor as usize).id as u32 * PARTS + b.number % PARTS
}

/// What the archive knows of a keyframe beside its views.
#[derive(Clone, Copy, Debug, Default)]
pub struct Known {
    /// Its images were handed to the store.
    pub saved: bool,
    /// Its images were asked of the disk; how many have not come.
    pub asked: u8,
    /// Its steps when its state was last written.
    pub stated: u32,
    /// The horizon was taken from a picture with much of it still open.
    pub open: bool,
    /// Training steps on it at which its horizon is taken again.
    look_at: u32,
    /// The part of the Gaussians that it sees that are not in the pool.
    pub away: f32,
    /// The anchor of the block that it sees most of.
    pub home: Option<u32>,
    /// The cells of its views that show what is not in the pool were found for what is there now.
    pub absent_found: bool,
    /// One of its images could not be had: those that come go.
    pub in_part: bool,
}

pub struct Archive {
    pub store: Store,
    disk: Arc<Disk>,
    pub at_once: bool,
    pub run: u32,
    about: RunAbout,
    /// The runs whose maps are known, this one last.
    pub runs: Runs,
    pub blocks: Vec<Block>,
    pub known: Vec<Known>,
    pub sight: Sight,
    /// The index of the block of each number, or `NO_BLOCK`.
    numbers: Vec<u32>,
    pub choice: Choice,
    /// A new block grows: none comes behind it.
    pub growing: bool,
    /// How often blocks came, went, moved or were first sampled.
    pub exchanges: u64,
    pub drawn: Drawn,
    /// What a mapper that dies leaves; none where there is no room or another's file in its place.
    pub latest: Option<Snapshot>,
    pub latest_due: Nanos,
    /// The next block and keyframe that are looked at for writing.
    pub next_block: usize,
    pub next_state: usize,
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
        let (of, most) = (identity(calibration, board, shape), latest_max(board, shape));
        let (mut store, disk) = Store::open(place.folder, of, &limits)?;
        let latest = Snapshot::open(place.folder, of).and_then(|mut latest| {
            let taken = take_over(&latest, place.fresh, &mut store, &disk);
            // Of a small disk the store has all. What was not taken over must not come back in a later run.
            latest.make(if 2 * most < limits.bytes_max / LATEST_DIVISOR { most } else { 0 })?;
            taken.map(|()| latest)
        });
        let latest = latest.ok().filter(Snapshot::has_room);
        let about = RunAbout {
            epoch_base: 0,
            started_unix_ms: place.flight.unwrap_or_default(),
            colour: shape.channels == 3,
            width: shape.width,
            height: shape.height,
            cameras: shape.cameras,
            channels: shape.channels,
            scene_depth_m: 0.0,
        };
        let runs = Runs::of(&store, about, place.flight, keyframes_known(board, shape));
        let Run { run, about, .. } = *runs.newest();
        let (blocks, known, sight, choice, numbers) = tables(board, shape);
        let mut archive = Archive {
            store,
            disk: Arc::new(disk),
            at_once: place.at_once,
            run,
            about,
            runs,
            blocks,
            known,
            sight,
            numbers,
            choice,
            growing: false,
            exchanges: 1,
            drawn: Drawn::new(board, shape, place.at_once),
            latest,
            latest_due: LONG_AGO,
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
    pub fn serve(&self) {
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

    /// The key of what has a number over all runs.
    pub fn key(&self, kind: u8, id: u32) -> Key {
        self.runs.key(kind, id)
    }

    /// Takes over what the runs left: every keyframe and block is known, and none is in memory.
    pub fn resume(&mut self, views: &mut Views) {
        for at in 0..self.runs.list.len() {
            let run = self.runs.list[at];
            self.resume_keyframes(views, &run);
            if run.run != self.run {
                views.earlier = views.len();
            }
            self.resume_blocks(views, &run);
        }
    }

    fn resume_keyframes(&mut self, views: &mut Views, run: &Run) {
        let (mut states, cameras, known) = (vec![], views.cameras(), self.known.len());
        let has_image = |id: u32| self.store.about(&Key { kind: KIND_IMAGE, run: run.run, id }).is_some();
        self.store.entries(|key, about| {
            if key.kind == KIND_KEYFRAME && key.run == run.run {
                states.extend(KeyframeAbout::decode(about).map(|state| (key.id, state)));
            }
        });
        states.sort_unstable_by_key(|(id, _)| *id);
        // All views of a keyframe, and its images, or none.
        let whole: Vec<_> = states
            .chunk_by(|a, b| a.0 / CAMERAS_MAX as u32 == b.0 / CAMERAS_MAX as u32)
            .filter(|of_one| of_one.len() == cameras)
            .filter(|of_one| of_one.iter().all(|(id, _)| has_image(*id)))
            .collect();
        for (id, state) in whole.into_iter().flatten() {
            let mut entry = entry(*id, state);
            (entry.id, entry.epoch) = (entry.id + run.first, self.runs.resolved(entry.epoch));
            if run.run != self.run {
                // The clock of a flight before may have been another.
                entry.near_at = LONG_AGO;
            }
            views.know(entry);
        }
        self.know_keyframes(views.len() / cameras);
        for (keyframe, known) in self.known.iter_mut().enumerate().skip(known) {
            (known.saved, known.stated) = (true, views.get(keyframe * cameras).steps);
        }
    }

    fn resume_blocks(&mut self, views: &mut Views, run: &Run) {
        let mut found = vec![];
        self.store.entries(|key, about| {
            if key.kind == KIND_BLOCK && key.run == run.run {
                found.extend(BlockAbout::decode(about).map(|block| (key.id, block)));
            }
        });
        found.sort_unstable_by_key(|(id, _)| *id);
        for (id, b) in found {
            let Some(anchor) = views.index_of(u64::from(id / PARTS) + run.first) else { continue };
            let steps = views.get(anchor).steps;
            let entry = views.get_mut(anchor);
            (entry.anchor, entry.placed) = (true, b.placed);
            self.know_block(Block {
                anchor: anchor as u32,
                number: anchor as u32 * PARTS + id % PARTS,
                epoch: self.runs.resolved(b.epoch),
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

    /// Makes one map of two epochs, by their numbers over all runs.
    pub fn join(&mut self, from: u32, into: u32) {
        self.runs.joined.push((from, into));
        self.exchanges += 1;
        for block in 0..self.blocks.len() {
            if self.blocks[block].epoch == from {
                self.blocks[block].epoch = into;
                self.exchanged(block);
            }
        }
        let about = JoinAbout { into }.encode();
        self.store.put(Key { kind: KIND_JOIN, run: self.run, id: from }, &about, |_| ());
        self.serve();
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

    /// The index of the block of a number.
    pub fn block_of(&self, number: u32) -> Option<usize> {
        self.numbers.get(number as usize).filter(|block| **block != NO_BLOCK).map(|block| *block as usize)
    }

    pub fn know_block(&mut self, block: Block) {
        if let Some(index) = self.numbers.get_mut(block.number as usize) {
            *index = self.blocks.len() as u32;
            self.blocks.push(block);
        }
    }

    /// Takes in the block that was opened for an anchor.
    pub fn open_block(&mut self, views: &Views, anchor: usize) {
        if self.blocks.len() == BLOCKS_KNOWN {
            return;
        }
        let entry = views.get(anchor);
        self.know_block(Block {
            anchor: anchor as u32,
            number: anchor as u32 * PARTS,
            epoch: entry.epoch,
            count: 0,
            samples: [[0.0; 4]; SAMPLES],
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

    /// Notes that a block came, went, moved or was first sampled.
    pub fn exchanged(&mut self, block: usize) {
        self.exchanges += 1;
        self.sight.touch(block);
    }

    /// Whether another block can be made.
    pub fn is_full(&self) -> bool {
        self.blocks.len() == BLOCKS_KNOWN
    }

    /// A block's ball, from its samples.
    pub fn measure(&mut self, block: usize) {
        let b = &mut self.blocks[block];
        (b.centre, b.radius) = ball(&b.samples[..usize::from(b.samples_len)]);
    }

    /// Counts a training step on a view, and looks again from where it was taken as its steps grow: what stood before a far
    /// wall when the view came has become what it is, and what is behind it has been mapped.
    pub fn trained(&mut self, scene: &mut Scene, index: usize) -> Result<(), GpuError> {
        let (keyframe, first) = (index / scene.views.cameras(), scene.views.first(index));
        let steps = scene.views.get(first).steps;
        if index == first && self.known.get(keyframe).is_some_and(|known| steps >= known.look_at.max(FIRST_LOOK)) {
            self.known[keyframe].look_at = steps * LOOKS_RATIO;
            self.look_again(scene, first)?;
        }
        let Archive { blocks, sight, .. } = self;
        sight.blocks(keyframe).for_each(|block| blocks[block].steps += u32::from(blocks[block].in_pool));
        Ok(())
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
            if placed == b.placed {
                continue;
            }
            let by = placed * b.placed.inverse();
            for sample in &mut b.samples[..usize::from(b.samples_len)] {
                let [x, y, z, size] = *sample;
                *sample = by.transform(DVec3::new(x.into(), y.into(), z.into())).as_vec3().extend(size).to_array();
            }
            b.placed = placed;
            // Moved, it is another one than on disk.
            b.steps += u32::from(b.in_pool);
            self.measure(block);
            self.exchanged(block);
        }
    }

    /// Asks the disk for a block; false where it cannot be asked now.
    pub fn ask_for_block(&mut self, views: &Views, block: usize) -> bool {
        let key = self.key(KIND_BLOCK, part_id(views, &self.blocks[block]));
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
        let key = self.runs.over_all(&fetched.key);
        let arrived = match key.kind {
            KIND_BLOCK => {
                let anchor = views.index_of(u64::from(key.id / PARTS));
                let block = anchor.and_then(|anchor| self.block_of(anchor as u32 * PARTS + key.id % PARTS));
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

/// Hands what a mapper that died left in its snapshot to the store, unless the map begins anew. What finds no room in the store is
/// lost, as without a snapshot.
fn take_over(latest: &Snapshot, fresh: bool, store: &mut Store, disk: &Disk) -> io::Result<()> {
    if fresh || store.figures().records == 0 {
        return Ok(());
    }
    latest.read(|key, generation, about, payload| {
        // An anchor that grew then may have been cut into parts since, of which the first was not stored.
        let is_whole = key.kind == KIND_BLOCK && key.id % PARTS == 0 && generation == 0;
        let has = |key: &Key| store.generation(key) != (0, false);
        let is_cut = is_whole && (1..PARTS).any(|part| has(&Key { id: key.id + part, ..key }));
        if is_cut || store.generation(&key).0 != generation {
            return;
        }
        let put = |store: &mut Store| store.put(key, about, |buffer| buffer.extend_from_slice(payload));
        if !put(store) {
            // Its buffers are full.
            disk.serve();
            put(store);
        }
    })?;
    store.flush().map_err(|fault| io::Error::other(fault.to_string()))
}

/// What came from the disk.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Arrived {
    Block(usize),
    /// The view whose image it is.
    Image(usize),
    Unknown,
}

fn tables(board: &Board, shape: &Shape) -> (Vec<Block>, Vec<Known>, Sight, Choice, Vec<u32>) {
    let keyframes = keyframes_known(board, shape);
    (
        Vec::with_capacity(BLOCKS_KNOWN),
        Vec::with_capacity(keyframes),
        Sight::new(keyframes),
        Choice::new(keyframes, payload_max(board, shape), shape.pixels(), board.map.evict),
        vec![NO_BLOCK; keyframes * shape.cameras as usize * PARTS as usize],
    )
}
