//! Loop closure beside a flight. In lockstep a keyframe is worked in at once; in real time it goes by copy to a thread of its
//! own, `loops`, which nobody waits for: while that is busy, keyframes go by it and are counted. A vehicle that does not know
//! where it is in the map of an earlier epoch asks twice a second, keyframe or not.
//!
//! ```text
//! tracking -> keyframe (copy) -> loops -> map_from_odom, poses of keyframes in the map -> tracking -> mapper
//! ```

use super::tracking::{FramePacket, Tracked};
use super::waker::Waker;
use crate::config::Board;
use crate::counters::Counters;
use crate::limits::{CAMERAS_MAX, FRAMES};
use crate::loops::kept::{self, Epoch, Keeper, Kept};
use crate::loops::{Closure, LoopKeyframe, Loops, MapFromOdom};
use crate::mem::{Footprint, List};
use crate::publish::event::{EventId, Notice};
use crate::store;
use crossbeam_queue::ArrayQueue;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::Arc;
use stipple_drivers::{host, Calibration, Fault, Frames, Nanos, Pose};

/// Keyframes on their way to the thread: one being worked in, one that waits.
const KEYFRAMES: usize = 2;

/// What loop closure tells tracking.
#[derive(Clone, Copy)]
pub enum Answer {
    /// The frame of the estimator in that of the map, from now on.
    MapFromOdom(Pose),
    /// The keyframes that follow are moved by this loop.
    Moved(Moved),
    /// The pose in the map of a keyframe that the mapper has.
    Keyframe { id: u64, map_from_body: Pose },
    /// Two epochs are one map from now on.
    Joined(Join),
}

/// A loop that moves poses in the map by more than `SCORED`, or joins two maps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Moved {
    pub t: Nanos,
    /// Stamp of what was recognised, where that was in this flight.
    pub with: Option<Nanos>,
}

/// Epoch `epoch`, which has the map frame of epoch `into` of this flight from now on. `flight` is when its flight began, ms since
/// 1970, where it is of an earlier one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Join {
    pub flight: Option<i64>,
    pub epoch: u32,
    pub into: u32,
}

/// A keyframe on its way.
struct Work {
    frames: Arc<Frames>,
    t: Nanos,
    id: Option<u64>,
    epoch: u32,
    odom_from_body: Pose,
    window: List<(Nanos, Pose), FRAMES>,
    body_from_cam: Option<[Pose; CAMERAS_MAX]>,
}

impl Work {
    /// Takes a keyframe over, its images by copy.
    fn fill(&mut self, packet: &FramePacket, tracked: &Tracked, id: Option<u64>) -> bool {
        let Some(frames) = Arc::get_mut(&mut self.frames) else { return false };
        frames.t = packet.frames.t;
        let fits = frames.images.len() == packet.frames.images.len();
        frames.images.iter_mut().zip(&packet.frames.images).for_each(|(to, from)| to.copy_from(from));
        (self.t, self.id, self.epoch) = (packet.frames.t, id, packet.epoch);
        self.odom_from_body = tracked.world_from_body;
        self.window.clone_from(&tracked.corrections);
        self.body_from_cam = tracked.body_from_cam;
        fits
    }
}

/// Keyframes to the thread and answers from it.
pub struct LoopQueue {
    free: ArrayQueue<Box<Work>>,
    waiting: ArrayQueue<Box<Work>>,
    answers: ArrayQueue<Answer>,
    closed: ArrayQueue<(Closure, MapFromOdom)>,
    /// The vehicle's place is unknown in a map that is there, of an earlier epoch or flight: frames that are no keyframes are
    /// searched too.
    lost: AtomicBool,
    waker: Waker,
}

/// Keyframes that loop closure knows: at least, and as many as two bytes number.
const KEYFRAMES_MIN: usize = 64;
const KEYFRAMES_MAX: usize = 16_384;

fn keyframes(board: &Board) -> usize {
    (board.store.keyframes as usize).clamp(KEYFRAMES_MIN, KEYFRAMES_MAX)
}

/// Closures that move poses by less are in the report alone: m, rad.
const TOLD: [f64; 2] = [0.05, 0.01];
/// What they do to the map is scored where they move poses by more: a pixel or two of what is 5 m away.
const SCORED: [f64; 2] = [0.02, 0.004];
/// Niceness of the thread: below tracking, above mapping.
const NICE: i32 = 5;
/// Closures that wait to be told.
const CLOSED: usize = 16;
/// Period at which a lost vehicle asks, s: twice, as two keyframes have to agree, in a second.
const ASKS_S: f64 = 0.5;
/// Folder of places in a run's folder.
const PLACES: &str = "places";

impl LoopQueue {
    fn new(calibration: &Calibration, keyframes: usize) -> LoopQueue {
        let free = ArrayQueue::new(KEYFRAMES);
        for _ in 0..KEYFRAMES {
            let frames = Arc::new(Frames::for_rig(calibration));
            let (id, window, body_from_cam) = (None, List::default(), None);
            let work =
                Work { frames, t: Nanos(0), id, epoch: 0, odom_from_body: Pose::IDENTITY, window, body_from_cam };
            let _ = free.push(Box::new(work));
        }
        // All keyframes of the graph, twice, so that a second closure need not wait for the first to be read.
        let answers = ArrayQueue::new(2 * keyframes + 4);
        let (closed, lost) = (ArrayQueue::new(CLOSED), AtomicBool::new(false));
        LoopQueue { free, waiting: ArrayQueue::new(KEYFRAMES), answers, closed, lost, waker: Waker::default() }
    }

    /// Works a keyframe in, and answers what it moved.
    fn work(&self, loops: &mut Loops, keyframe: &LoopKeyframe) {
        let closure = loops.add(keyframe);
        self.lost.store(loops.is_lost(), Relaxed);
        let Some(closure) = closure else { return };
        let _ = self.closed.push((closure, loops.map_from_odom()));
        let _ = self.answers.push(Answer::MapFromOdom(loops.map_from_odom().pose.pose()));
        if is_moved_by(&closure, SCORED) {
            let moved = Moved { t: closure.t, with: (!closure.earlier).then_some(closure.with) };
            let _ = self.answers.push(Answer::Moved(moved));
        }
        for (id, map_from_body) in loops.keyframes_in_map() {
            // A full queue has older answers for the same keyframes; they come again with the next closure.
            let _ = self.answers.push(Answer::Keyframe { id, map_from_body });
        }
        if let Some(Epoch { flight, number: epoch }) = closure.joins {
            let flight = (flight != loops.flight()).then_some(flight);
            let _ = self.answers.push(Answer::Joined(Join { flight, epoch, into: keyframe.epoch }));
        }
    }

    /// Where `odom` is in the map after each loop that was closed, and a line about those that moved something.
    pub fn closed(&self) -> impl Iterator<Item = (MapFromOdom, Option<Notice>)> + '_ {
        std::iter::from_fn(|| self.closed.pop())
            .map(|(closure, placed)| (placed, line(&closure).map(|line| (EventId::Loop, line))))
    }
}

/// Whether a loop joins two maps, or moves poses in the map by so much: m, rad.
fn is_moved_by(c: &Closure, least: [f64; 2]) -> bool {
    c.joins.is_some() || c.moved.iter().zip(least).any(|(moved, least)| *moved >= least)
}

/// A line about a loop that is told of.
fn line(c: &Closure) -> Option<String> {
    let ([far, angle], inliers) = (c.moved, c.inliers);
    let moves = format!("poses in the map move by {far:.3} m and {:.2} degrees", angle.to_degrees());
    let of = match c.joins {
        _ if c.earlier => "an earlier flight".into(),
        Some(_) => "another epoch".into(),
        None => format!("{:.0} s ago", (c.t - c.with).secs()),
    };
    let joined = if c.joins.is_some() { ", the two maps are one now" } else { "" };
    is_moved_by(c, TOLD).then(|| format!("place of {of} recognised by {inliers} corners{joined}: {moves}"))
}

/// The side of the thread `loops`.
pub struct LoopThread {
    queue: Arc<LoopQueue>,
    loops: Box<Loops>,
}

impl LoopThread {
    /// Works keyframes in until `over`, and says what was closed; answers the loops.
    pub fn run(mut self, over: &AtomicBool, say: impl Fn((MapFromOdom, Option<Notice>))) -> Box<Loops> {
        host::lower_priority(NICE);
        while let Some(work) = self.queue.waker.wait(over, || self.queue.waiting.pop()) {
            let Work { t, frames, id, epoch, odom_from_body, window, body_from_cam } = &*work;
            let (t, id, epoch) = (*t, *id, *epoch);
            let (odom_from_body, body_from_cam) = (*odom_from_body, *body_from_cam);
            let keyframe = LoopKeyframe { t, frames, id, epoch, odom_from_body, window, body_from_cam };
            self.queue.work(&mut self.loops, &keyframe);
            self.queue.closed().for_each(&say);
            let _ = self.queue.free.push(work);
        }
        self.loops
    }
}

/// The side of tracking.
pub struct LoopClosing {
    pub queue: Arc<LoopQueue>,
    /// In lockstep: worked in here.
    pub here: Option<Box<Loops>>,
    map_from_odom: Pose,
    /// An answer that the mapper had no room for.
    held: Option<Answer>,
    /// When the vehicle last asked.
    asked: Option<Nanos>,
}

impl LoopClosing {
    /// `None` where the board asks for none, or the rig sees no depth.
    pub fn new(calibration: &Calibration, board: &Board) -> Result<Option<LoopClosing>, Fault> {
        if !board.loops.enabled || calibration.cameras.len() < 2 {
            return Ok(None);
        }
        let keyframes = keyframes(board);
        let loops = Some(Box::new(Loops::new(calibration, &board.frontend, keyframes)?));
        let queue = Arc::new(LoopQueue::new(calibration, keyframes));
        Ok(Some(LoopClosing { queue, here: loops, map_from_odom: Pose::IDENTITY, held: None, asked: None }))
    }

    /// Host memory that it takes.
    pub fn measured(calibration: &Calibration, board: &Board, f: &mut Footprint) -> Result<(), Fault> {
        let made = f.build("loops: keyframes, index and graph", || LoopClosing::new(calibration, board))?;
        if made.is_some() && board.store.enabled {
            f.extend(Keeper::footprint(keyframes(board)));
        }
        Ok(())
    }

    /// Reads the places of earlier flights in a run's folder, and keeps those of this one there where the board has a store and
    /// this flight may write; answers how many were read. Loops are closed all the same where it fails.
    pub fn remember(
        &mut self,
        (calibration, board): (&Calibration, &Board),
        run_folder: &Path,
        (flight, fresh, read_only): (i64, bool, bool),
    ) -> Result<(usize, Vec<String>), Fault> {
        let Some(loops) = &mut self.here else { return Ok((0, vec![])) };
        loops.remember(flight, &[], None);
        if !board.store.enabled && !read_only {
            return Ok((0, vec![]));
        }
        let folder = run_folder.join(PLACES);
        if fresh {
            store::set_aside(&folder)?;
        }
        let Kept { places, warnings } = kept::read(&folder, calibration)?;
        let keeper = if read_only { None } else { Some(Keeper::new(&folder, calibration, keyframes(board))?) };
        loops.remember(flight, &places, keeper);
        self.queue.lost.store(!places.is_empty(), Relaxed);
        Ok((places.len(), warnings))
    }

    /// A pose of the estimator, in the map.
    pub fn in_map(&self, odom_from_body: &Pose) -> Pose {
        self.map_from_odom * *odom_from_body
    }

    /// Takes a keyframe, or lets it go by; `id` is its number for the mapper, where that took it.
    pub fn offer(&mut self, packet: &FramePacket, tracked: &Tracked, id: Option<u64>, counters: &Counters) {
        let Tracked { world_from_body: odom_from_body, body_from_cam, .. } = tracked;
        if let Some(loops) = &mut self.here {
            let (t, frames, epoch, window) = (packet.frames.t, &packet.frames, packet.epoch, &tracked.corrections);
            let (odom_from_body, body_from_cam) = (*odom_from_body, *body_from_cam);
            self.queue.work(loops, &LoopKeyframe { t, frames, id, epoch, odom_from_body, window, body_from_cam });
            self.asked = Some(t);
            return;
        }
        let Some(mut work) = self.queue.free.pop() else {
            counters.loops_busy.add(1);
            return;
        };
        self.asked = Some(packet.frames.t);
        let filled = work.fill(packet, tracked, id);
        let to = if filled { &self.queue.waiting } else { &self.queue.free };
        let _ = to.push(work);
        self.queue.waker.wake();
    }

    /// Takes a frame that is no keyframe where the vehicle is lost and has not asked for a while.
    pub fn ask(&mut self, packet: &FramePacket, tracked: &Tracked, counters: &Counters) {
        let due = self.asked.is_none_or(|asked| (packet.frames.t - asked).secs() >= ASKS_S);
        if due && self.queue.lost.load(Relaxed) {
            self.offer(packet, tracked, None, counters);
        }
    }

    /// Takes the answers that came, as long as `push` has room for what the mapper is to know.
    pub fn answers(&mut self, mut push: impl FnMut(&Answer) -> bool) {
        while let Some(answer) = self.held.take().or_else(|| self.queue.answers.pop()) {
            if let Answer::MapFromOdom(pose) = answer {
                self.map_from_odom = pose;
            } else if !push(&answer) {
                self.held = Some(answer);
                return;
            }
        }
    }

    /// The loops, for a thread of their own.
    pub fn take_loops(&mut self) -> Option<LoopThread> {
        self.here.take().map(|loops| LoopThread { queue: self.queue.clone(), loops })
    }
}

#[cfg(test)]
mod tests {
    use super::super::keyframes::{self, Keyframes};
    use super::*;
    use stipple_drivers::{Camera, ImuCalibration, Lens, RigCamera};

    #[test]
    fn an_answer_reaches_the_mapper_without_a_further_keyframe() {
        let lens = Lens::Radtan { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0 };
        let camera = Camera { width: 128, height: 128, fx: 100.0, fy: 100.0, cx: 63.5, cy: 63.5, lens };
        let cameras = vec![RigCamera::new(camera, Pose::IDENTITY); 2];
        let rig = Calibration { cameras, imu: ImuCalibration::CONSUMER };
        let board = Board::parse("a board", include_str!("../../board-configs/lavapipe.toml"), &[]).expect("of ours");
        let closing = LoopClosing::new(&rig, &board).expect("a rig").expect("a board with loops");
        let answer = Answer::Keyframe { id: 7, map_from_body: Pose::IDENTITY };
        assert!(closing.queue.answers.push(answer).is_ok());
        let (mut passes, ring) = (Keyframes::new(0, Some(closing)), keyframes::tests::ring());
        let mut packet = FramePacket::for_rig(&rig, 0);
        packet.tracked = Some(Tracked {
            world_from_body: Pose::IDENTITY,
            keyframe: false,
            body_from_cam: None,
            corrections: List::default(),
        });
        passes.pass_on(&packet, Some(&ring), &Counters::default());
        let mut corrected = vec![];
        ring.corrections(ring.corrections_written(), |c| corrected.push(c.id));
        assert_eq!(corrected, [7]);
    }
}
