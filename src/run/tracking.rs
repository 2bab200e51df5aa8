//! The tracking side of a flight: frames with their inertial samples in, poses and keyframes out.
//!
//! ```text
//! next() -> front end -tracked-> back end -> give()      packets
//!               ^----answers------'                      one a frame
//! ```
//!
//! The two halves of odometry share one thread in turns or have a thread each. The front end follows points, the back end
//! estimates. All that passes between them travels in a `FramePacket`, besides what the back end answers: its state, and the
//! points that it rejected. The front end begins frame k when the answer to frame k-2 has come, and predicts from that even
//! where the one to k-1 is known: so neither queue can fill, and poses are the same bit for bit on one thread and on two.
//!
//! Where the view hardly moves the front end leaves a frame to inertia, and the back end carries its last estimate to it
//! (`vio/carried.rs`).
//!
//! With `--poses` the poses come from a table, odometry is skipped, and every frame is a keyframe, or those that are apart by
//! a stated spacing.

use super::carrier::{Carrier, Newest};
use super::gate::{Clock, Stream, RELEARN};
use super::log::{LogSender, Rig, State};
use super::table::Table;
use super::waker::{SetOnDrop, Waker};
use crate::config::Board;
use crate::counters::Counters;
use crate::frontend::{Frontend, Prediction, Rejected, Tracks, Verdicts};
use crate::limits::{CAMERAS_MAX, FRAMES, IMU_BETWEEN_FRAMES};
use crate::mem::{seal_thread, Footprint, List, Thinned};
use crate::output::report::LeftOut;
use crate::publish::Feeds;
use crate::vio::{Findings, Health, Known, Predictor, Schedule, Update, Vio};
use crossbeam_queue::ArrayQueue;
use std::sync::atomic::AtomicBool;
use std::sync::Arc;
use std::time::{Duration, Instant};
use stipple_drivers::host::{thread_cpu, thread_cpu_now};
use stipple_drivers::source::{AidBatch, AidReading};
use stipple_drivers::{Calibration, Fault, Frames, ImuSample, Nanos, Pose, TimedPose};

/// Packets between the two halves: the one whose points are followed and the one being estimated.
const BETWEEN_HALVES: usize = 2;

/// A pose and what it means for the map.
pub struct Tracked {
    /// Newest estimate of the pose at camera 0's exposure.
    pub world_from_body: Pose,
    pub keyframe: bool,
    /// Where the cameras sit on the body; `None`: as calibrated.
    pub body_from_cam: Option<[Pose; CAMERAS_MAX]>,
    /// Newest poses of all keyframes still being optimised; filled beside a keyframe.
    pub corrections: List<(Nanos, Pose), FRAMES>,
}

/// One frame on its way through tracking: its images, the inertial samples since the frame before, and the result.
pub struct FramePacket {
    /// Shared with the front end until it has tracked a later frame.
    pub frames: Arc<Frames>,
    /// Holds samples alone: no frame came for so long that they would not fit before the next.
    pub imu_only: bool,
    /// A camera saw nothing: no view to train a map on.
    pub blank: bool,
    /// Left to inertia: no point was followed.
    pub carried: bool,
    pub imu: List<ImuSample, IMU_BETWEEN_FRAMES>,
    pub aids: AidBatch,
    pub tracks: Tracks,
    pub tracked: Option<Tracked>,
    /// The epoch of its pose, and what the frame suffered from.
    pub epoch: u32,
    pub health: Health,
    /// What was found so far of cameras that do not see what the calibration says.
    pub verdicts: Verdicts,
    /// What was found so far of what is estimated of the rig.
    pub findings: Findings,
    /// When tracking took it.
    pub begun: Instant,
    /// CPU time that following its points took.
    cpu: Duration,
}

impl FramePacket {
    /// Shaped for a rig; the first `colours` cameras in colour.
    pub fn for_rig(calibration: &Calibration, colours: usize) -> Box<FramePacket> {
        Box::new(FramePacket {
            frames: Arc::new(Frames::in_colour(calibration, colours)),
            imu_only: false,
            blank: false,
            carried: false,
            imu: List::default(),
            aids: AidBatch::default(),
            tracks: Tracks::default(),
            tracked: None,
            epoch: 0,
            health: Health::default(),
            verdicts: Verdicts::default(),
            findings: Findings::default(),
            begun: Instant::now(),
            cpu: Duration::ZERO,
        })
    }

    /// The buffers for the next frame; `None` while the front end still reads this one.
    pub fn writable(&mut self) -> Option<&mut Frames> {
        Arc::get_mut(&mut self.frames)
    }

    /// Empties it of what came before its frame.
    pub fn clear(&mut self) {
        self.imu.clear();
        self.aids.clear();
    }

    /// Adds a reading; one that does not fit is counted.
    pub fn push_aid(&mut self, reading: AidReading, counters: &Counters) {
        counters.aid_overflow.add(u64::from(self.aids.push(reading).is_err()));
    }

    /// Adds a sample; a full list drops its oldest, which is counted.
    pub fn push_imu(&mut self, sample: ImuSample, counters: &Counters) {
        if self.imu.push(sample).is_err() {
            counters.imu_overflow.add(1);
            self.imu.rotate_left(1);
            self.imu[IMU_BETWEEN_FRAMES - 1] = sample;
        }
    }
}

/// What makes poses of frames.
pub enum Tracker {
    Odometry(Box<OdometryRun>),
    /// Poses looked up by stamp.
    Table(Table),
    /// No poses: each packet is shown to this and given back.
    Observer(Box<dyn FnMut(&FramePacket) + Send>),
}

pub struct OdometryRun {
    pub front: Front,
    pub back: Back,
    /// Until the thread that publishes takes it; none where the board asks for none.
    pub carrier: Option<Carrier>,
    /// 1 or 2.
    pub threads: u32,
    /// Size of front end and estimator together.
    pub bytes: u64,
}

/// What the back end tells the front end after a frame.
#[derive(Clone)]
pub struct Answer {
    known: Known,
    /// Odometry is sure.
    is_sure: bool,
    rejected: Rejected,
}

/// The half that follows points.
pub struct Front {
    frontend: Frontend,
    predictor: Predictor,
    clock: Clock,
    schedule: Schedule,
    /// Motion of the view below which a frame may be left to inertia, px.
    carried_px: f64,
    /// Wall time of each tracked frame, ms.
    pub ms: Thinned<f64>,
    /// Wall time of tracked frames, with what was waited for the back end, s.
    pub busy_s: f64,
    /// CPU time of the thread, s; that of both halves where they share one.
    pub cpu_s: Option<f64>,
}

impl Front {
    /// `answer` is the back end's to the frame before the last.
    pub fn track(&mut self, packet: &mut FramePacket, answer: &Answer) {
        let cpu = thread_cpu_now();
        packet.begun = Instant::now();
        self.predictor.set_scale(answer.known.imu_scale);
        for s in packet.imu.iter() {
            if self.clock.went_back(Stream::Samples, s.t) {
                self.predictor.change_clock();
            }
            self.predictor.on_imu(*s);
        }
        self.frontend.reject(&answer.rejected);
        if packet.imu_only {
            return;
        }
        let t = packet.frames.t;
        if self.clock.went_back(Stream::Frames, t) {
            self.predictor.change_clock();
        }
        packet.carried = self.leaves_out(t, answer);
        if packet.carried {
            packet.verdicts = self.frontend.verdicts();
            packet.cpu = thread_cpu_now() - cpu;
            return;
        }
        self.schedule.track(t);
        if let Some((body_from_cam, sigma_rad)) = self.predictor.cameras_at(t, &answer.known) {
            self.frontend.correct(&body_from_cam, sigma_rad);
        }
        let prediction = Prediction { prev_from_now: self.predictor.motion_to(t, answer.known.odometry.as_ref()) };
        packet.tracks.clone_from(self.frontend.track(&packet.frames, &prediction));
        packet.verdicts = self.frontend.verdicts();
        let secs = packet.begun.elapsed().as_secs_f64();
        self.busy_s += secs;
        self.ms.push(secs * 1e3);
        packet.cpu = thread_cpu_now() - cpu;
    }

    /// Whether the frame at `t` is left to inertia.
    fn leaves_out(&mut self, t: Nanos, answer: &Answer) -> bool {
        if !self.schedule.has_time(t) || !answer.is_sure || !self.predictor.is_sound(t) {
            return false;
        }
        let motion = self.predictor.motion_since_last(t, answer.known.odometry.as_ref());
        motion.is_some_and(|motion| self.frontend.flow_px(&motion) < self.carried_px)
    }
}

/// Epochs that a run is judged by.
const EPOCHS: usize = 64;

/// The half that estimates. Its lists are bought at the start: what a run is judged by. They hold every frame of a
/// recording, and are thinned in a run without an end, of which the log has every frame.
pub struct Back {
    pub vio: Vio,
    /// What the newest frame led to that was not refused.
    update: Update,
    clock: Clock,
    pub trajectory: Thinned<TimedPose>,
    /// Wall time of each tracked frame, ms.
    pub ms: Thinned<f64>,
    /// Wall time of all frames, s.
    pub busy_s: f64,
    /// Health of every frame, with a pose or without.
    pub health: Thinned<(Nanos, Health)>,
    /// Time from when the front end took a tracked frame until its pose was there, ms.
    pub frame_ms: Thinned<(Nanos, f64)>,
    pub cpu_s: Option<f64>,
    pub log: Option<LogSender>,
    pub feeds: Feeds,
    /// Where the carrier takes states.
    newest: Option<Newest>,
    /// First frame and number of each epoch. Where there are more, the log has them.
    pub epochs: List<(Nanos, u32), EPOCHS>,
}

impl Back {
    /// Fills in `packet.tracked`.
    pub fn estimate(&mut self, packet: &mut FramePacket) {
        let (begun, cpu) = (Instant::now(), thread_cpu_now());
        // Before the samples, so that a change of the clock forgets those of the clock before.
        packet.aids.iter().for_each(|reading| self.vio.on_aid(reading));
        for s in packet.imu.iter() {
            if self.clock.went_back(Stream::Samples, s.t) {
                self.vio.change_clock(s.t, RELEARN);
            }
            self.vio.on_imu(*s);
        }
        packet.tracked = None;
        if packet.imu_only {
            return;
        }
        let t = packet.frames.t;
        if self.clock.went_back(Stream::Frames, t) {
            self.vio.change_clock(t, RELEARN);
        }
        let update = if packet.carried { self.vio.carry(t, &self.update) } else { self.vio.on_tracks(&packet.tracks) };
        if !update.health.has(Health::FRAME_REJECTED) {
            self.update = update;
        }
        (packet.epoch, packet.health) = (update.epoch, update.health);
        packet.findings = self.vio.rig_findings();
        if self.epochs.last().is_none_or(|(_, last)| *last != update.epoch) {
            let _ = self.epochs.push((packet.frames.t, update.epoch));
        }
        let known = self.vio.known();
        let exposed = self.vio.window().last().map(|(_, pose, _)| pose).filter(|_| !update.carried);
        packet.tracked = update.odometry.map(|odometry| Tracked {
            world_from_body: exposed.unwrap_or(odometry.world_from_body),
            keyframe: update.keyframe,
            body_from_cam: known.cameras.map(|cameras| cameras.body_from_cam),
            corrections: if update.keyframe { self.keyframe_poses() } else { List::default() },
        });
        if let Some(odometry) = update.odometry {
            self.trajectory.push(TimedPose { t: odometry.t, pose: odometry.world_from_body });
        }
        let secs = begun.elapsed().as_secs_f64();
        self.busy_s += secs;
        self.health.push((t, update.health));
        let latency_ms = packet.begun.elapsed().as_secs_f64() * 1e3;
        if !packet.carried {
            self.ms.push(secs * 1e3);
            self.frame_ms.push((t, latency_ms));
        }
        if let Some(newest) = &self.newest {
            newest.set(&update, known.imu_scale);
        }
        self.feeds.frame(&update, packet.imu.last());
        if let Some(log) = &self.log {
            let cpu = packet.cpu + (thread_cpu_now() - cpu);
            let time_offsets_ns = self.vio.time_offsets().map(|offsets| offsets.map(|offset| offset.0));
            let state = State::new(packet.frames.t, &update, latency_ms, cpu.as_secs_f64() * 1e3);
            log.state(State { time_offsets_ns, ..state });
            let rig = update.keyframe.then(|| self.vio.rig()).flatten();
            rig.iter().for_each(|rig| log.rig(Rig::new(t, rig)));
        }
    }

    /// What the front end is to hear, once a frame.
    pub fn answer(&mut self) -> Answer {
        let is_sure = self.update.is_sure();
        Answer { rejected: self.vio.take_rejected(), known: self.vio.known(), is_sure }
    }

    fn keyframe_poses(&self) -> List<(Nanos, Pose), FRAMES> {
        let mut list = List::default();
        for (t, pose, _) in self.vio.window().filter(|(_, _, keyframe)| *keyframe) {
            list.push((t, pose)).expect("a window has at most FRAMES frames");
        }
        list
    }
}

impl OdometryRun {
    /// Tracker and estimator of a rig, with room for so many frames in each list. Fails where the tracker cannot take the rig.
    pub fn new(calibration: &Calibration, board: &Board, frames: usize) -> Result<OdometryRun, Fault> {
        OdometryRun::measured(calibration, board, frames, &mut Footprint::default())
    }

    /// Does what `new` does, and adds what it takes to `footprint`.
    pub fn measured(
        calibration: &Calibration,
        board: &Board,
        frames: usize,
        footprint: &mut Footprint,
    ) -> Result<OdometryRun, Fault> {
        let mut f = Footprint::default();
        let frontend = f.build("tracking: front end", || Frontend::new(calibration, &board.frontend))?;
        let vio = || Vio::new(calibration, &board.vio).with_barometer(&board.baro);
        let estimator = || (vio(), Predictor::new(calibration, &board.vio));
        let (vio, predictor) = f.build("tracking: estimator", estimator);
        let bytes = f.total();
        let carrier = || Carrier::new(calibration, board);
        let carrier = Carrier::is_wanted(board).then(|| f.build("tracking: states between frames", carrier));
        let trajectory = f.build("tracking: poses of frames", || Thinned::with_capacity(frames));
        let health = f.build("tracking: health of frames", || Thinned::with_capacity(frames));
        let [front_ms, ms] = f.build("tracking: times of frames", || [(); 2].map(|()| Thinned::with_capacity(frames)));
        let frame_ms = f.build("tracking: latencies of frames", || Thinned::with_capacity(frames));
        footprint.extend(f);
        Ok(OdometryRun {
            front: Front {
                frontend,
                predictor,
                clock: Clock::default(),
                schedule: Schedule::default(),
                carried_px: board.frontend.carried_px,
                ms: front_ms,
                busy_s: 0.0,
                cpu_s: None,
            },
            back: Back {
                vio,
                update: Update::default(),
                clock: Clock::default(),
                trajectory,
                ms,
                busy_s: 0.0,
                health,
                frame_ms,
                cpu_s: None,
                log: None,
                feeds: Feeds::default(),
                newest: carrier.as_ref().map(|carrier| carrier.newest.clone()),
                epochs: List::default(),
            },
            carrier,
            threads: board.frontend.threads,
            bytes,
        })
    }

    /// Tracked frames a second while there are frames to track: over the time in which the busier thread was
    /// not waiting for one.
    pub fn fps(&self) -> Option<f64> {
        let (front, back) = (self.front.busy_s, self.back.busy_s);
        let busy = if self.threads == 1 { front + back } else { front.max(back) };
        (busy > 0.0).then(|| self.back.ms.seen as f64 / busy)
    }

    /// Frames that were left to inertia, beside those that were tracked.
    pub fn left_out(&self) -> LeftOut {
        let mean_ms = |ms: &[f64]| ms.iter().sum::<f64>() / ms.len().max(1) as f64;
        let (carried, tracked) = (self.back.vio.stats().frames_carried, self.back.ms.seen);
        let each_s = 1e-3 * (mean_ms(&self.front.ms) + mean_ms(&self.back.ms));
        LeftOut::beside("Frames in which the view hardly moved", carried, (tracked, each_s * tracked as f64))
    }

    /// CPU time of all threads of tracking, ms a frame.
    pub fn cpu_ms(&self) -> Option<f64> {
        let total = self.front.cpu_s? + if self.threads == 1 { 0.0 } else { self.back.cpu_s? };
        let frames = self.back.health.seen;
        (frames > 0).then(|| 1e3 * total / frames as f64)
    }
}

impl Tracker {
    /// Threads it takes, 1 or 2.
    pub fn threads(&self) -> u32 {
        self.odometry().map_or(1, |run| run.threads)
    }

    /// The part that carries states between frames, for the thread that has the samples.
    pub fn take_carrier(&mut self) -> Option<Carrier> {
        match self {
            Tracker::Odometry(run) => run.carrier.take(),
            Tracker::Table(_) | Tracker::Observer(_) => None,
        }
    }

    pub fn odometry(&self) -> Option<&OdometryRun> {
        match self {
            Tracker::Odometry(run) => Some(run),
            Tracker::Table(_) | Tracker::Observer(_) => None,
        }
    }

    pub fn counters(&self) -> Vec<(&'static str, u64)> {
        let Some(run) = self.odometry() else { return vec![] };
        let mut list = run.front.frontend.stats().list();
        // The first frames of a run that starts in motion, and those after a reset.
        list.push(("frames_without_odometry", run.back.health.seen.saturating_sub(run.back.trajectory.seen)));
        list.extend(run.back.vio.stats().list());
        list
    }
}

/// Fills in the pose of a packet from a table.
pub fn look_up(table: &mut Table, packet: &mut FramePacket, counters: &Counters) {
    packet.tracked = None;
    if packet.imu_only {
        return;
    }
    let found = table.at(packet.frames.t);
    counters.frames_without_pose.add(u64::from(found.is_none()));
    let (body_from_cam, corrections) = (None, List::default());
    packet.tracked =
        found.map(|(pose, keyframe)| Tracked { world_from_body: pose, keyframe, body_from_cam, corrections });
}

/// What the threads of tracking share.
pub struct Link {
    tracked: ArrayQueue<Box<FramePacket>>,
    answers: ArrayQueue<Answer>,
    /// Wakes the thread that takes packets.
    pub taker: Waker,
    back: Waker,
    front_done: AtomicBool,
    back_done: AtomicBool,
}

impl Default for Link {
    fn default() -> Link {
        Link {
            tracked: ArrayQueue::new(BETWEEN_HALVES),
            answers: ArrayQueue::new(BETWEEN_HALVES),
            taker: Waker::default(),
            back: Waker::default(),
            front_done: AtomicBool::new(false),
            back_done: AtomicBool::new(false),
        }
    }
}

/// Where the thread that takes packets gets them, and when there are no more.
pub struct Inlet<'a, T: FnMut() -> Option<Box<FramePacket>>> {
    pub take: T,
    pub over: &'a AtomicBool,
}

impl<T: FnMut() -> Option<Box<FramePacket>>> Inlet<'_, T> {
    fn next(&mut self, link: &Link) -> Option<Box<FramePacket>> {
        link.taker.wait(self.over, &mut self.take)
    }
}

/// Thread `tracking` without odometry: shows every packet to `see`.
pub fn without_odometry(
    link: &Link,
    mut inlet: Inlet<impl FnMut() -> Option<Box<FramePacket>>>,
    mut see: impl FnMut(&mut FramePacket),
    mut give: impl FnMut(Box<FramePacket>),
) {
    while let Some(mut packet) = inlet.next(link) {
        packet.begun = Instant::now();
        see(&mut packet);
        give(packet);
    }
}

/// Thread `tracking` where both halves share it.
pub fn in_turns(
    link: &Link,
    mut inlet: Inlet<impl FnMut() -> Option<Box<FramePacket>>>,
    front: &mut Front,
    back: &mut Back,
    mut give: impl FnMut(Box<FramePacket>),
) {
    seal();
    let start = back.answer();
    let (mut answer, mut next) = (start.clone(), start);
    while let Some(mut packet) = inlet.next(link) {
        front.track(&mut packet, &answer);
        back.estimate(&mut packet);
        (answer, next) = (next, back.answer());
        give(packet);
    }
    front.cpu_s = Some(thread_cpu().total_s());
}

/// Thread `frontend`, where each half has its own; `start` predicts the first frames.
pub fn follow_points(
    link: &Link,
    mut inlet: Inlet<impl FnMut() -> Option<Box<FramePacket>>>,
    front: &mut Front,
    start: Answer,
) {
    let _ended = SetOnDrop(&link.front_done, Some(&link.back));
    seal();
    let (mut answer, mut frames) = (start, 0u64);
    loop {
        if frames >= BETWEEN_HALVES as u64 {
            let begun = Instant::now();
            let Some(newer) = link.taker.wait(&link.back_done, || link.answers.pop()) else { break };
            front.busy_s += begun.elapsed().as_secs_f64();
            answer = newer;
        }
        let Some(mut packet) = inlet.next(link) else { break };
        front.track(&mut packet, &answer);
        frames += 1;
        // There is room: the back end has finished all but the last.
        let _ = link.tracked.push(packet);
        link.back.wake();
    }
    front.cpu_s = Some(thread_cpu().total_s());
}

/// Thread `estimator`.
pub fn estimate(link: &Link, back: &mut Back, mut give: impl FnMut(Box<FramePacket>)) {
    let _ended = SetOnDrop(&link.back_done, Some(&link.taker));
    seal();
    while let Some(mut packet) = link.back.wait(&link.front_done, || link.tracked.pop()) {
        back.estimate(&mut packet);
        let _ = link.answers.push(back.answer());
        link.taker.wake();
        give(packet);
    }
    back.cpu_s = Some(thread_cpu().total_s());
}

/// From here on the thread allocates nothing; what asking for its own handle allocates comes first.
pub fn seal() {
    let _ = std::thread::current();
    seal_thread();
}

#[cfg(test)]
#[path = "carried_tests.rs"]
mod carried_tests;
#[cfg(test)]
#[path = "clock_tests.rs"]
mod clock_tests;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_latency_of_a_frame_without_odometry_counts_from_when_it_is_taken() {
        let mut packet =
            Some(FramePacket::for_rig(&crate::world::World::new(crate::world::Path { rest: -1.0 }).rig, 0));
        let made = Instant::now();
        let (link, over) = (Link::default(), AtomicBool::new(false));
        let take = || {
            over.store(packet.is_none(), std::sync::atomic::Ordering::Relaxed);
            packet.take()
        };
        let mut begun = None;
        without_odometry(&link, Inlet { take, over: &over }, |_| (), |packet| begun = Some(packet.begun));
        assert!(begun.is_some_and(|begun| begun >= made));
    }
}
