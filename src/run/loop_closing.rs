//! Loop closure beside a flight. In lockstep a keyframe is worked in at once; in real time it goes by copy to a thread of its
//! own, `loops`, which nobody waits for: while that is busy, keyframes go by it and are counted.
//!
//! ```text
//! tracking -> keyframe (copy) -> loops -> map_from_odom, poses of keyframes in the map -> tracking -> mapper
//! ```

use super::tracking::{FramePacket, Tracked};
use super::waker::Waker;
use crate::config::Board;
use crate::counters::Counters;
use crate::limits::CAMERAS_MAX;
use crate::loops::{Closure, LoopKeyframe, Loops};
use crate::publish::event::{EventId, Notice};
use crossbeam_queue::ArrayQueue;
use std::sync::atomic::AtomicBool;
use std::sync::Arc;
use stipple_drivers::{host, Calibration, Fault, Frames, Nanos, Pose};

/// Keyframes on their way to the thread: one being worked in, one that waits.
const KEYFRAMES: usize = 2;

/// What loop closure tells tracking.
#[derive(Clone, Copy)]
pub enum Answer {
    /// The frame of the estimator in that of the map, from now on.
    MapFromOdom(Pose),
    /// The pose in the map of a keyframe that the mapper has.
    Keyframe { id: u64, map_from_body: Pose },
}

/// A keyframe on its way.
struct Work {
    frames: Arc<Frames>,
    t: Nanos,
    id: Option<u64>,
    epoch: u32,
    odom_from_body: Pose,
    before: Option<(Nanos, Pose)>,
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
        self.before = newest_before(packet, tracked);
        self.body_from_cam = tracked.body_from_cam;
        fits
    }
}

/// The newest estimate of the keyframe before.
fn newest_before(packet: &FramePacket, tracked: &Tracked) -> Option<(Nanos, Pose)> {
    tracked.corrections.iter().filter(|(t, _)| *t < packet.frames.t).max_by_key(|(t, _)| *t).copied()
}

/// Keyframes to the thread and answers from it.
pub struct LoopQueue {
    free: ArrayQueue<Box<Work>>,
    waiting: ArrayQueue<Box<Work>>,
    answers: ArrayQueue<Answer>,
    closed: ArrayQueue<Closure>,
    waker: Waker,
}

/// Keyframes that loop closure knows: at least, and as many as two bytes number.
const KEYFRAMES_MIN: usize = 64;
const KEYFRAMES_MAX: usize = 16_384;
/// Closures that move poses by less are in the report alone: m, rad.
const TOLD: [f64; 2] = [0.05, 0.01];
/// Niceness of the thread: below tracking, above mapping.
const NICE: i32 = 5;
/// Lines of closures that wait to be told.
const CLOSED: usize = 16;

impl LoopQueue {
    fn new(calibration: &Calibration, keyframes: usize) -> LoopQueue {
        let free = ArrayQueue::new(KEYFRAMES);
        for _ in 0..KEYFRAMES {
            let frames = Arc::new(Frames::for_rig(calibration));
            let (id, before, body_from_cam) = (None, None, None);
            let work =
                Work { frames, t: Nanos(0), id, epoch: 0, odom_from_body: Pose::IDENTITY, before, body_from_cam };
            let _ = free.push(Box::new(work));
        }
        // All keyframes of the graph, twice, so that a second closure need not wait for the first to be read.
        let answers = ArrayQueue::new(2 * keyframes + 2);
        let closed = ArrayQueue::new(CLOSED);
        LoopQueue { free, waiting: ArrayQueue::new(KEYFRAMES), answers, closed, waker: Waker::default() }
    }

    /// Works a keyframe in, and answers what it moved.
    fn work(&self, loops: &mut Loops, keyframe: &LoopKeyframe) {
        let Some(closure) = loops.add(keyframe) else { return };
        let _ = self.closed.push(closure);
        let _ = self.answers.push(Answer::MapFromOdom(loops.map_from_odom()));
        for (id, map_from_body) in loops.keyframes_in_map() {
            // A full queue has older answers for the same keyframes; they come again with the next closure.
            let _ = self.answers.push(Answer::Keyframe { id, map_from_body });
        }
    }

    /// Lines about the loops that were closed and moved something.
    pub fn closed(&self) -> impl Iterator<Item = Notice> + '_ {
        let told = |c: &Closure| c.moved[0] >= TOLD[0] || c.moved[1] >= TOLD[1];
        std::iter::from_fn(|| self.closed.pop()).filter(told).map(|c| {
            let [far, angle] = c.moved;
            let ago = (c.t - c.with).secs();
            let text = format!(
                "place of {ago:.0} s ago recognised by {} corners: poses in the map move by {far:.3} m and {:.2} degrees",
                c.inliers,
                angle.to_degrees()
            );
            (EventId::Loop, text)
        })
    }
}

/// The side of the thread `loops`.
pub struct LoopThread {
    queue: Arc<LoopQueue>,
    loops: Box<Loops>,
}

impl LoopThread {
    /// Works keyframes in until `over`, and says what was closed; answers the loops.
    pub fn run(mut self, over: &AtomicBool, say: impl Fn(Notice)) -> Box<Loops> {
        host::lower_priority(NICE);
        while let Some(work) = self.queue.waker.wait(over, || self.queue.waiting.pop()) {
            let Work { t, frames, id, epoch, odom_from_body, before, body_from_cam } = &*work;
            let (t, id, epoch) = (*t, *id, *epoch);
            let (odom_from_body, before, body_from_cam) = (*odom_from_body, *before, *body_from_cam);
            let keyframe = LoopKeyframe { t, frames, id, epoch, odom_from_body, before, body_from_cam };
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
}

impl LoopClosing {
    /// `None` where the board asks for none, or the rig sees no depth.
    pub fn new(calibration: &Calibration, board: &Board) -> Result<Option<LoopClosing>, Fault> {
        if !board.loops.enabled || calibration.cameras.len() < 2 {
            return Ok(None);
        }
        let keyframes = (board.store.keyframes as usize).clamp(KEYFRAMES_MIN, KEYFRAMES_MAX);
        let loops = Loops::new(calibration, &board.frontend, keyframes)?;
        let queue = Arc::new(LoopQueue::new(calibration, keyframes));
        Ok(Some(LoopClosing { queue, here: Some(Box::new(loops)), map_from_odom: Pose::IDENTITY, held: None }))
    }

    /// A pose of the estimator, in the map.
    pub fn in_map(&self, odom_from_body: &Pose) -> Pose {
        self.map_from_odom * *odom_from_body
    }

    /// Takes a keyframe, or lets it go by; `id` is its number for the mapper, where that took it.
    pub fn offer(&mut self, packet: &FramePacket, tracked: &Tracked, id: Option<u64>, counters: &Counters) {
        let Tracked { world_from_body: odom_from_body, body_from_cam, .. } = tracked;
        if let Some(loops) = &mut self.here {
            let (t, frames, epoch, before) =
                (packet.frames.t, &packet.frames, packet.epoch, newest_before(packet, tracked));
            let (odom_from_body, body_from_cam) = (*odom_from_body, *body_from_cam);
            self.queue.work(loops, &LoopKeyframe { t, frames, id, epoch, odom_from_body, before, body_from_cam });
            return;
        }
        let Some(mut work) = self.queue.free.pop() else {
            counters.loops_busy.add(1);
            return;
        };
        let filled = work.fill(packet, tracked, id);
        let to = if filled { &self.queue.waiting } else { &self.queue.free };
        let _ = to.push(work);
        self.queue.waker.wake();
    }

    /// Takes the answers that came, as long as `push` has room for what the mapper is to know.
    pub fn answers(&mut self, mut push: impl FnMut(u64, Pose) -> bool) {
        while let Some(answer) = self.held.take().or_else(|| self.queue.answers.pop()) {
            match answer {
                Answer::MapFromOdom(pose) => self.map_from_odom = pose,
                Answer::Keyframe { id, map_from_body } if !push(id, map_from_body) => {
                    self.held = Some(answer);
                    return;
                }
                Answer::Keyframe { .. } => {}
            }
        }
    }

    /// The loops, for a thread of their own.
    pub fn take_loops(&mut self) -> Option<LoopThread> {
        self.here.take().map(|loops| LoopThread { queue: self.queue.clone(), loops })
    }
}
