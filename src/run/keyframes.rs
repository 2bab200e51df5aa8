//! Keyframes on their way to the mapper, through memory that its process may share with the one that flies.
//!
//! A fixed number of slots, each with a state, a head and the images; tracking fills free ones and waits for nobody: an
//! offer may fail. Pose corrections go through a ring of their own. A slot that was mapped keeps its keyframe until it is
//! filled anew, so that a mapper that starts again is offered the newest keyframes once more. While there is no mapper
//! the oldest keyframe makes room for the newest.

use super::loop_closing::{Answer, Join, LoopClosing, Moved};
use super::tracking::{FramePacket, Tracked};
use crate::config::Board;
use crate::counters::Counters;
use crate::limits::CAMERAS_MAX;
use crate::map::{cameras, Keyframe, PoseCorrection};
use crate::publish::cloud::Cloud;
use glam::{DQuat, DVec3};
use std::collections::VecDeque;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering::Acquire, Ordering::Relaxed, Ordering::Release};
use std::sync::Arc;
use stipple_drivers::shared::{read_bytes, words_of, write_bytes, SharedWords};
use stipple_drivers::{Calibration, Fault, FaultKind, Frames, Image, Nanos, Pose};

/// Keyframes between tracking and the map: as many as come while one or two anchors are being made.
pub const SLOTS: usize = 12;
/// Pose corrections that wait: those of a window, and what a closed loop moves, which comes as there is room.
const CORRECTIONS: usize = 512;

/// What the two sides tell each other beside keyframes, a word each.
#[derive(Clone, Copy)]
pub enum Word {
    /// The mapper is ready for keyframes.
    Ready,
    /// Counted up by the mapper's process several times a second.
    Beat,
    /// Counted up whenever the mapper ends a slice of work.
    Progress,
    /// The run is over: evaluate, tell, end.
    Stop,
    Anchors,
    Splats,
    Iterations,
    /// Training PSNR of the last probe, 0.01 dB.
    PsnrCdb,
    /// No mapper takes keyframes.
    Absent,
    /// Corrections written, and read, so far.
    Written,
    Read,
    /// Epochs joined so far.
    Joins,
    /// Loops so far that move the map; the newest's stamp and that of what it was closed with, 0 of an earlier flight.
    Moved,
    MovedAt,
    MovedWith,
    /// Share of its time that the mapper may work, 1/1000; 0: the whole.
    Share,
}

const WORDS: usize = 24;
/// A pose of the body, whether the cameras' are estimated, and these.
const POSE: usize = 7;
const POSES: usize = POSE + 1 + CAMERAS_MAX * POSE;
/// A correction: number of the keyframe, and poses.
const CORRECTION: usize = 1 + POSES;
/// Joined epochs that a flight may have, and the words of one.
const JOINS: usize = 16;
const JOIN: usize = 3;
/// Words before the corrections.
const FIXED: usize = WORDS + JOINS * JOIN;
/// Head of a slot: state, number, stamp, whether it is held out, epoch, poses.
const HEAD: usize = POSES_AT + POSES;
const POSES_AT: usize = 5;

/// States of a slot. `DONE` is free, and still holds a keyframe.
const EMPTY: u64 = 0;
const FILLING: u64 = 1;
const OFFERED: u64 = 2;
const TAKEN: u64 = 3;
const DONE: u64 = 4;

fn no_memory(e: std::io::Error) -> Fault {
    Fault::new(FaultKind::Unavailable, "the ring of keyframes", format!("no shared memory: {e}"), "free memory")
}

pub struct KeyframeRing {
    words: SharedWords,
    /// Images and colours of a slot that holds nothing, to be cloned.
    shape: Keyframe,
    slot_words: usize,
    /// Where the mapper puts points for readers, where there may be any.
    pub cloud: Option<Arc<Cloud>>,
}

impl KeyframeRing {
    /// With room for a cloud of points.
    pub fn with_cloud(mut self, cloud: std::io::Result<Cloud>) -> Result<KeyframeRing, Fault> {
        self.cloud = Some(Arc::new(cloud.map_err(no_memory)?));
        Ok(self)
    }

    /// Takes new memory, for the images that the board's map wants of this rig.
    pub fn new(calibration: &Calibration, board: &Board) -> Result<KeyframeRing, Fault> {
        let shape = shape(calibration, board);
        KeyframeRing::on(SharedWords::create(words(&shape)), shape)
    }

    /// Maps the memory that the process which flies has taken, by its descriptor.
    pub fn attach(fd: i32, calibration: &Calibration, board: &Board) -> Result<KeyframeRing, Fault> {
        let shape = shape(calibration, board);
        KeyframeRing::on(SharedWords::attach(fd, words(&shape)), shape)
    }

    fn on(shared: std::io::Result<SharedWords>, shape: Keyframe) -> Result<KeyframeRing, Fault> {
        let slot_words = HEAD + image_words(&shape);
        shared.map(|words| KeyframeRing { words, shape, slot_words, cloud: None }).map_err(no_memory)
    }

    /// Bytes that `new` takes, and the keyframe that the mapper reads from it.
    pub fn bytes(calibration: &Calibration, board: &Board) -> usize {
        let shape = shape(calibration, board);
        (words(&shape) + image_words(&shape)) * size_of::<u64>()
    }

    /// The descriptor of its memory.
    pub fn number(&self) -> i32 {
        self.words.number()
    }

    /// A keyframe to read slots into.
    pub fn shape(&self) -> &Keyframe {
        &self.shape
    }

    /// Images of a keyframe that are wanted in colour.
    pub fn colours(&self) -> usize {
        self.shape.colours.len()
    }

    pub fn word(&self, word: Word) -> &AtomicU64 {
        &self.words[word as usize]
    }

    fn slot(&self, slot: usize) -> &[AtomicU64] {
        let start = FIXED + CORRECTIONS * CORRECTION + slot * self.slot_words;
        &self.words[start..start + self.slot_words]
    }

    fn correction(&self, number: u64) -> &[AtomicU64] {
        let start = FIXED + number as usize % CORRECTIONS * CORRECTION;
        &self.words[start..start + CORRECTION]
    }

    /// Takes the slot of those in one of `states` whose keyframe is the oldest, and puts it in state `to`.
    fn claim(&self, states: &[u64], numbers: Range<u64>, to: u64) -> Option<usize> {
        loop {
            let seen = (0..SLOTS).map(|i| (i, self.slot(i)[0].load(Acquire), self.slot(i)[1].load(Relaxed)));
            let fits = |(_, state, id): &(usize, u64, u64)| states.contains(state) && numbers.contains(id);
            let (i, state, _) = seen.filter(fits).min_by_key(|(_, state, id)| (*state != EMPTY, *id))?;
            if self.slot(i)[0].compare_exchange(state, to, Acquire, Relaxed).is_ok() {
                return Some(i);
            }
        }
    }

    /// Copies a keyframe in; false when every slot is taken.
    pub fn offer(&self, frames: &Frames, id: u64, held_out: bool, (epoch, poses): (u32, &Poses)) -> bool {
        let all = 0..u64::MAX;
        let free = self.claim(&[EMPTY, DONE], all.clone(), FILLING);
        let absent = || self.word(Word::Absent).load(Acquire) != 0;
        let Some(i) = free.or_else(|| absent().then(|| self.claim(&[OFFERED], all, FILLING)).flatten()) else {
            return false;
        };
        let slot = self.slot(i);
        slot[1].store(id, Relaxed);
        slot[2].store(frames.t.0 as u64, Relaxed);
        slot[3].store(u64::from(held_out), Relaxed);
        slot[4].store(u64::from(epoch), Relaxed);
        poses.write(&slot[POSES_AT..HEAD]);
        let mut at = HEAD;
        let colours = frames.colours.iter().take(self.colours()).flatten();
        for image in frames.images.iter().take(self.shape.images.len()).chain(colours) {
            let end = at + words_of(image.pixels.len());
            write_bytes(&slot[at..end], &image.pixels);
            at = end;
        }
        slot[0].store(OFFERED, Release);
        true
    }

    /// Reads the oldest keyframe with a number under `until` that waits; answers its slot, which is busy until it is `done`.
    pub fn take(&self, until: u64, keyframe: &mut Keyframe) -> Option<usize> {
        let i = self.claim(&[OFFERED], 0..until, TAKEN)?;
        let slot = self.slot(i);
        keyframe.id = slot[1].load(Relaxed);
        keyframe.t = Nanos(slot[2].load(Relaxed) as i64);
        keyframe.held_out = slot[3].load(Relaxed) != 0;
        keyframe.epoch = slot[4].load(Relaxed) as u32;
        let Poses { world_from_body, body_from_cam } = Poses::read(&slot[POSES_AT..HEAD]);
        (keyframe.world_from_body, keyframe.body_from_cam) = (world_from_body, body_from_cam);
        let mut at = HEAD;
        for image in keyframe.images.iter_mut().chain(keyframe.colours.iter_mut().flatten()) {
            let end = at + words_of(image.pixels.len());
            read_bytes(&slot[at..end], &mut image.pixels);
            at = end;
        }
        Some(i)
    }

    /// Frees the slot of a keyframe that was taken.
    pub fn done(&self, slot: usize) {
        self.slot(slot)[0].store(DONE, Release);
    }

    /// One more than the highest number of a keyframe that waits.
    pub fn offered(&self) -> u64 {
        let waits = |i: &usize| self.slot(*i)[0].load(Acquire) == OFFERED;
        (0..SLOTS).filter(waits).map(|i| self.slot(i)[1].load(Relaxed) + 1).max().unwrap_or(0)
    }

    /// Hands over a better pose; false when as many wait as may.
    fn push_correction(&self, id: u64, poses: &Poses) -> bool {
        let written = self.word(Word::Written).load(Relaxed);
        if written - self.word(Word::Read).load(Acquire) >= CORRECTIONS as u64 {
            return false;
        }
        let to = self.correction(written);
        to[0].store(id, Relaxed);
        poses.write(&to[1..]);
        self.word(Word::Written).store(written + 1, Release);
        true
    }

    /// Tells that two epochs are one map; false when as many were told as may be.
    fn push_join(&self, join: &Join) -> bool {
        let joins = self.word(Word::Joins).load(Relaxed);
        if joins >= JOINS as u64 {
            return false;
        }
        let start = WORDS + joins as usize * JOIN;
        // A flight after 1970 has no number 0.
        let words = [join.flight.unwrap_or(0) as u64, u64::from(join.epoch), u64::from(join.into)];
        self.words[start..start + JOIN].iter().zip(words).for_each(|(to, word)| to.store(word, Relaxed));
        self.word(Word::Joins).store(joins + 1, Release);
        true
    }

    /// The joined epochs from one number on: a mapper that starts again is told all of them.
    pub fn joins(&self, from: usize) -> impl Iterator<Item = Join> + '_ {
        let upto = (self.word(Word::Joins).load(Acquire) as usize).min(JOINS);
        (from..upto).map(|n| {
            let [flight, epoch, into] = std::array::from_fn(|i| self.words[WORDS + n * JOIN + i].load(Relaxed));
            Join { flight: (flight != 0).then_some(flight as i64), epoch: epoch as u32, into: into as u32 }
        })
    }

    /// Tells of a loop whose corrections follow.
    pub(super) fn push_moved(&self, moved: &Moved) {
        self.word(Word::MovedAt).store(moved.t.0 as u64, Relaxed);
        self.word(Word::MovedWith).store(moved.with.map_or(0, |with| with.0 as u64), Relaxed);
        self.word(Word::Moved).fetch_add(1, Release);
    }

    /// How many loops moved the map so far, and the newest of them.
    pub fn moved(&self) -> (u64, Moved) {
        let count = self.word(Word::Moved).load(Acquire);
        let [t, with] = [Word::MovedAt, Word::MovedWith].map(|word| Nanos(self.word(word).load(Relaxed) as i64));
        (count, Moved { t, with: (with != Nanos(0)).then_some(with) })
    }

    /// Corrections written so far, and read.
    pub fn corrections_written(&self) -> u64 {
        self.word(Word::Written).load(Acquire)
    }

    pub fn corrections_read(&self) -> u64 {
        self.word(Word::Read).load(Relaxed)
    }

    /// Calls `correct` with the corrections before number `written`, which reach keyframes that wait, too.
    pub fn corrections(&self, written: u64, mut correct: impl FnMut(&PoseCorrection)) {
        for number in self.word(Word::Read).load(Relaxed)..written {
            let from = self.correction(number);
            let (id, poses) = (from[0].load(Relaxed), Poses::read(&from[1..]));
            for slot in (0..SLOTS).map(|i| self.slot(i)) {
                if slot[0].load(Acquire) == OFFERED && slot[1].load(Relaxed) == id {
                    poses.write(&slot[POSES_AT..HEAD]);
                }
            }
            let Poses { world_from_body, body_from_cam } = poses;
            correct(&PoseCorrection { id, world_from_body, body_from_cam });
            self.word(Word::Read).store(number + 1, Release);
        }
    }

    /// Makes ready for another mapper after one has died: what it had finished is offered again. What it was busy with is
    /// not, as that may be what broke it.
    pub fn offer_again(&self) {
        for slot in (0..SLOTS).map(|i| self.slot(i)) {
            let _ = slot[0].compare_exchange(TAKEN, EMPTY, Acquire, Relaxed);
            let _ = slot[0].compare_exchange(DONE, OFFERED, Acquire, Relaxed);
        }
    }
}

fn words(shape: &Keyframe) -> usize {
    FIXED + CORRECTIONS * CORRECTION + SLOTS * (HEAD + image_words(shape))
}

fn image_words(shape: &Keyframe) -> usize {
    shape.images.iter().chain(shape.colours.iter().flatten()).map(|i| words_of(i.pixels.len())).sum()
}

/// A keyframe with the images that the board's map wants of this rig.
fn shape(calibration: &Calibration, board: &Board) -> Keyframe {
    let count = calibration.cameras.len();
    let image = |i: usize| {
        let c = &calibration.cameras[i].camera;
        Image::new(c.width, c.height)
    };
    let colours = (0..cameras::colours(count, &board.map)).map(|i| std::array::from_fn(|_| image(i))).collect();
    let images = (0..cameras::images(count, &board.map)).map(image).collect();
    Keyframe { images, colours, ..Keyframe::default() }
}

/// Where the body was, and each camera on it, where that is estimated.
#[derive(Clone, Copy)]
pub struct Poses {
    pub world_from_body: Pose,
    pub body_from_cam: Option<[Pose; CAMERAS_MAX]>,
}

impl Poses {
    fn write(&self, words: &[AtomicU64]) {
        let (body, cameras) = words.split_at(POSE);
        write_pose(body, &self.world_from_body);
        cameras[0].store(u64::from(self.body_from_cam.is_some()), Relaxed);
        let given = self.body_from_cam.iter().flatten();
        cameras[1..].chunks_exact(POSE).zip(given).for_each(|(words, pose)| write_pose(words, pose));
    }

    fn read(words: &[AtomicU64]) -> Poses {
        let (body, cameras) = words.split_at(POSE);
        let camera = |i: usize| read_pose(&cameras[1 + i * POSE..]);
        let estimated = cameras[0].load(Relaxed) != 0;
        let body_from_cam = estimated.then(|| std::array::from_fn(camera));
        Poses { world_from_body: read_pose(body), body_from_cam }
    }
}

fn write_pose(words: &[AtomicU64], pose: &Pose) {
    let (q, p) = (pose.q, pose.p);
    let numbers = [q.x, q.y, q.z, q.w, p.x, p.y, p.z];
    words.iter().zip(numbers).for_each(|(word, n)| word.store(n.to_bits(), Relaxed));
}

fn read_pose(words: &[AtomicU64]) -> Pose {
    let n: [f64; POSE] = std::array::from_fn(|i| f64::from_bits(words[i].load(Relaxed)));
    Pose { q: DQuat::from_xyzw(n[0], n[1], n[2], n[3]), p: DVec3::new(n[4], n[5], n[6]) }
}

/// Newest keyframes, which the estimator may still move: more than a window holds.
const RECENT: usize = 32;

/// Numbers keyframes, chooses the held-out ones, and hands them to the mapper where there is one.
pub struct Keyframes {
    /// Every Nth keyframe is held out; 0: none.
    holdout: u32,
    /// Keyframes that found a slot; without a mapper, all.
    pub count: u64,
    /// Stamps and numbers of the newest.
    recent: VecDeque<(Nanos, u64)>,
    /// What closes loops, where places are recognised.
    pub loops: Option<LoopClosing>,
}

impl Keyframes {
    pub fn new(holdout: u32, loops: Option<LoopClosing>) -> Keyframes {
        Keyframes { holdout, count: 0, recent: VecDeque::with_capacity(RECENT), loops }
    }

    /// Hands a tracked frame on: a keyframe to the mapper and to what closes loops, and the newer poses of others with it. The
    /// mapper is told poses in the map. What loop closure answers reaches it with any frame: a vehicle that has come home may
    /// give no further keyframe.
    pub fn pass_on(&mut self, packet: &FramePacket, ring: Option<&KeyframeRing>, counters: &Counters) {
        match (&packet.tracked, &mut self.loops) {
            (Some(tracked), _) if tracked.keyframe => self.pass_keyframe_on(packet, tracked, ring, counters),
            (Some(tracked), Some(loops)) if !packet.blank && !packet.carried => loops.ask(packet, tracked, counters),
            _ => {}
        }
        let Some(loops) = &mut self.loops else { return };
        loops.answers(|answer| match answer {
            Answer::Keyframe { id, map_from_body } => {
                let poses = Poses { world_from_body: *map_from_body, body_from_cam: None };
                ring.is_none_or(|ring| ring.push_correction(*id, &poses))
            }
            Answer::Joined(join) => {
                let told = ring.is_none_or(|ring| ring.push_join(join));
                counters.corrections_full.add(u64::from(!told));
                true
            }
            Answer::Moved(moved) => {
                ring.iter().for_each(|ring| ring.push_moved(moved));
                true
            }
            Answer::MapFromOdom(_) => true,
        });
    }

    fn pass_keyframe_on(
        &mut self,
        packet: &FramePacket,
        tracked: &Tracked,
        ring: Option<&KeyframeRing>,
        counters: &Counters,
    ) {
        if packet.blank {
            counters.keyframes_blank.add(u64::from(ring.is_some()));
            self.count += u64::from(ring.is_none());
            return;
        }
        let (id, body_from_cam) = (self.offer(packet, tracked, ring, counters), tracked.body_from_cam);
        for (t, odom_from_body) in tracked.corrections.iter() {
            if let Some((_, found)) = self.recent.iter().find(|(at, found)| at == t && Some(*found) != id) {
                let poses = Poses { world_from_body: self.in_map(odom_from_body), body_from_cam };
                let pushed = ring.is_none_or(|ring| ring.push_correction(*found, &poses));
                counters.corrections_full.add(u64::from(!pushed));
            }
        }
        self.loops.iter_mut().for_each(|loops| loops.offer(packet, tracked, id, counters));
    }

    fn in_map(&self, odom_from_body: &Pose) -> Pose {
        self.loops.as_ref().map_or(*odom_from_body, |loops| loops.in_map(odom_from_body))
    }

    /// Offers a keyframe to the mapper, where there is one; answers its number if that took it.
    fn offer(
        &mut self,
        packet: &FramePacket,
        tracked: &Tracked,
        ring: Option<&KeyframeRing>,
        counters: &Counters,
    ) -> Option<u64> {
        let Some(ring) = ring else {
            self.count += 1;
            return None;
        };
        let (id, n) = (self.count, u64::from(self.holdout));
        let world_from_body = self.in_map(&tracked.world_from_body);
        let poses = Poses { world_from_body, body_from_cam: tracked.body_from_cam };
        if !ring.offer(&packet.frames, id, n > 0 && id % n == n - 1, (packet.epoch, &poses)) {
            counters.keyframes_rejected.add(1);
            return None;
        }
        self.count += 1;
        self.recent.truncate(RECENT - 1);
        self.recent.push_front((packet.frames.t, id));
        Some(id)
    }
}

#[cfg(test)]
pub mod tests {
    use super::*;
    use stipple_drivers::{Camera, ImuCalibration, Lens, RigCamera};

    pub fn ring() -> KeyframeRing {
        let lens = Lens::Radtan { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0 };
        let camera = Camera { width: 5, height: 3, fx: 4.0, fy: 4.0, cx: 2.0, cy: 1.0, lens };
        let cameras = vec![RigCamera::new(camera, Pose::IDENTITY); 2];
        let board = include_str!("../../board-configs/lavapipe.toml");
        let board = Board::parse("lavapipe.toml", board, &[]).expect("a board of ours");
        KeyframeRing::new(&Calibration { cameras, imu: ImuCalibration::CONSUMER }, &board).expect("some bytes")
    }

    const AT_ORIGIN: Poses = Poses { world_from_body: Pose::IDENTITY, body_from_cam: None };

    /// Offers a keyframe whose pixels tell its number.
    fn offer(ring: &KeyframeRing, id: u64) -> bool {
        let image = Image { pixels: vec![id as u8; 15], ..Image::new(5, 3) };
        let frames = Frames { t: Nanos(id as i64 * 7), images: vec![image; 2], colours: vec![] };
        ring.offer(&frames, id, id == 3, (id as u32 / 4, &AT_ORIGIN))
    }

    /// The numbers of what waits, in order; each is marked as done.
    fn drained(ring: &KeyframeRing) -> Vec<u64> {
        let mut keyframe = ring.shape().clone();
        let next = |keyframe: &mut Keyframe| ring.take(u64::MAX, keyframe).map(|slot| ring.done(slot));
        std::iter::from_fn(|| next(&mut keyframe).map(|()| keyframe.id)).collect()
    }

    #[test]
    fn a_full_ring_rejects_the_newest_keeps_order_and_lets_corrections_reach_what_waits() {
        let (ring, mut corrected) = (ring(), vec![]);
        assert!((0..SLOTS as u64).all(|id| offer(&ring, id)) && !offer(&ring, 99));
        let moved = Pose { p: DVec3::X, ..Pose::IDENTITY };
        let at = |c: usize| Pose { p: DVec3::new(0.0, c as f64, 0.0), ..Pose::IDENTITY };
        let body_from_cam = Some(std::array::from_fn(at));
        assert!(ring.push_correction(2, &Poses { world_from_body: moved, body_from_cam }));
        ring.corrections(ring.corrections_written(), |c| corrected.push(c.id));
        assert_eq!(corrected, [2]);
        let mut keyframe = ring.shape().clone();
        for id in 0..4 {
            let slot = ring.take(4, &mut keyframe).expect("it waits");
            let x = if id == 2 { 1.0 } else { 0.0 };
            assert_eq!((keyframe.id, keyframe.t, keyframe.world_from_body.p.x), (id, Nanos(id as i64 * 7), x));
            assert_eq!(keyframe.body_from_cam, if id == 2 { body_from_cam } else { None });
            assert_eq!((keyframe.held_out, &keyframe.images[1].pixels[..]), (id == 3, &[id as u8; 15][..]));
            ring.done(slot);
        }
        assert_eq!(ring.take(4, &mut keyframe), None, "only those that were asked for");
        assert_eq!(drained(&ring), (4..SLOTS as u64).collect::<Vec<_>>());
    }

    #[test]
    fn corrections_are_bounded() {
        let ring = ring();
        assert!((0..CORRECTIONS).all(|_| ring.push_correction(0, &AT_ORIGIN)) && !ring.push_correction(0, &AT_ORIGIN));
        ring.corrections(ring.corrections_written(), |_| ());
        assert!(ring.push_correction(0, &AT_ORIGIN));
    }

    #[test]
    fn a_mapper_that_died_leaves_the_newest_keyframes_to_the_next_but_not_what_it_was_busy_with() {
        let (ring, mut keyframe) = (ring(), ring().shape().clone());
        assert!((0..5).all(|id| offer(&ring, id)));
        (0..3).for_each(|_| ring.done(ring.take(9, &mut keyframe).expect("it waits")));
        let _busy = ring.take(9, &mut keyframe).expect("it waits");
        ring.word(Word::Absent).store(1, Release);
        ring.offer_again();
        // Nobody takes them: the oldest makes room.
        assert!((5..5 + SLOTS as u64).all(|id| offer(&ring, id)));
        assert_eq!(drained(&ring), (5..5 + SLOTS as u64).collect::<Vec<_>>());
        ring.offer_again();
        assert_eq!(drained(&ring), (5..5 + SLOTS as u64).collect::<Vec<_>>());
    }
}
