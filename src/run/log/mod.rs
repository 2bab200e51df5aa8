//! The log of a run: what it knew, on the disk while it goes on, so that a run that dies loses a second.
//!
//! ```text
//! any thread -> queue of fixed size -> thread `log` -> DIR/log-0000.mcap, DIR/log-0001.mcap, ..
//! ```
//!
//! A push neither waits nor allocates; what finds the queue full is counted. Files are appended to, synced each
//! `SYNC_PERIOD`, rotated by size, and never removed or overwritten: another run in the same folder numbers on, and each file
//! names its run. Where the disk has less room than a floor, or refuses a write, logging ends, with a notice and a counter;
//! what was written stays as it is and the run goes on. MCAP with messages in JSON: Foxglove and `mcap cat --json` show it,
//! and at 30 frames a second it takes 23 kB/s, 0.5 kB more for each state between frames (`log.predicted_hz`).

mod file;
pub mod read;
#[cfg(test)]
mod tests;

use super::threads;
use crate::limits::CAMERAS_MAX;
use crate::mem::{cut, Footprint, List};
use crate::publish::event::EventId;
use crate::publish::status::message::MapFromOdomMessage;
use crate::publish::TEXT;
use crate::vio::{Odometry, Predicted, RigEstimate, Update};
use crossbeam_queue::ArrayQueue;
use file::LogFiles;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use stipple_drivers::counters::Counter;
use stipple_drivers::{counters, host, Nanos, Pose};

/// Records that may wait for the disk: two minutes at 30 Hz. A card that stalls, stalls for seconds.
const QUEUE: usize = 4096;
/// A cut-off run loses what came since the last sync, and the sync may take as long again.
const SYNC_PERIOD: Duration = Duration::from_millis(500);
/// A process whose thread panicked has ended within a second.
const PANIC_MAX: Duration = Duration::from_millis(700);
const POLL_PERIOD: Duration = Duration::from_millis(50);
const THREAD: &str = "log";
/// Nice value of the thread: as the recorder's, after sensors and odometry.
const NICE: i32 = 5;

/// When a file is full, and when the disk is, bytes.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    pub file: u64,
    /// Space that is left to others, and to what a run writes at its end.
    pub free: u64,
}

/// Ten minutes of a camera at 30 Hz are one file. The index of a file is in memory until its end: a quarter of a mebibyte.
pub const LIMITS: Limits = Limits { file: 16 << 20, free: 64 << 20 };

counters! {
    struct Counts of Counter, read by Counter::get;
    /// Records on the disk; records lost, since the queue was full or logging had ended.
    log_records_written,
    log_records_lost,
    /// Files begun, and times that logging ended before the run did.
    log_files,
    log_ended_early,
}

/// The estimate of a state, as a log has it: the fields of `Odometry`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    pub p_m: [f64; 3],
    /// World from body, w last.
    pub q_xyzw: [f64; 4],
    pub v_world: [f64; 3],
    pub gyro_bias: [f64; 3],
    pub accel_bias: [f64; 3],
}

impl From<&Odometry> for Estimate {
    fn from(o: &Odometry) -> Estimate {
        Estimate {
            p_m: o.world_from_body.p.to_array(),
            q_xyzw: o.world_from_body.q.to_array(),
            v_world: o.v_world.to_array(),
            gyro_bias: o.gyro_bias.to_array(),
            accel_bias: o.accel_bias.to_array(),
        }
    }
}

impl Estimate {
    pub fn pose(&self) -> Pose {
        Pose { q: glam::DQuat::from_array(self.q_xyzw), p: self.p_m.into() }
    }
}

/// One frame, with a pose or without.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct State {
    /// Stamp of the frame, mid-exposure by the calibration's clocks. The estimate is of this instant by the inertial clock.
    pub t_ns: i64,
    /// Estimated time from then until the exposure of each camera, by the inertial clock, zero of cameras that the rig has not;
    /// `None` where it is not estimated.
    pub time_offsets_ns: Option<[i64; CAMERAS_MAX]>,
    /// Poses of one epoch are in one frame; `vio::Update` says when the next begins.
    pub epoch: u32,
    pub estimate: Option<Estimate>,
    /// The estimate is the last one that was trusted, carried on by inertia: no estimator runs.
    pub dead_reckoned: bool,
    /// The frame was not tracked: the estimate is that of the last tracked one, carried on by inertia.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub carried: bool,
    /// Standard deviations of the estimate: position, m, and velocity, m/s, in the world; rotation, rad, in the body.
    pub sigma: Option<[f32; 9]>,
    /// The bits of `Health`, which the channel names.
    pub health: u32,
    pub quality: u8,
    pub keyframe: bool,
    /// From when the front end took the frame until its pose was there, ms.
    pub latency_ms: f64,
    /// CPU time that tracking it took, ms.
    pub cpu_ms: f64,
}

/// A state between frames, carried by inertial samples; what has the name of a field of `State` is the same.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PredictedState {
    /// Stamp of the sample that it was carried to, and the time since the frame that it was carried from.
    pub t_ns: i64,
    pub age_ns: i64,
    pub epoch: u32,
    pub estimate: Estimate,
    pub sigma: Option<[f32; 9]>,
    pub health: u32,
    pub quality: u8,
}

impl From<&Predicted> for PredictedState {
    fn from(p: &Predicted) -> PredictedState {
        PredictedState {
            t_ns: p.odometry.t.0,
            age_ns: p.age.0,
            epoch: p.epoch,
            estimate: Estimate::from(&p.odometry),
            sigma: p.covariance.as_ref().map(deviations),
            health: p.health.0,
            quality: p.quality,
        }
    }
}

/// Standard deviations of position, velocity and rotation.
fn deviations(c: &[[f64; 15]; 15]) -> [f32; 9] {
    [0, 1, 2, 6, 7, 8, 3, 4, 5].map(|i| c[i][i].sqrt() as f32)
}

impl State {
    pub fn new(t: Nanos, update: &Update, latency_ms: f64, cpu_ms: f64) -> State {
        let estimate = update.odometry.or(update.dead_reckoned).as_ref().map(Estimate::from);
        let sigma = update.covariance.as_ref().map(deviations);
        State {
            t_ns: t.0,
            time_offsets_ns: None,
            epoch: update.epoch,
            estimate,
            dead_reckoned: update.dead_reckoned.is_some(),
            carried: update.carried,
            sigma: sigma.filter(|_| estimate.is_some()),
            health: update.health.0,
            quality: update.quality,
            keyframe: update.keyframe,
            latency_ms,
            cpu_ms,
        }
    }
}

/// What is estimated of the rig beside a keyframe: how far it is off the calibration, and the standard deviations. `None` where
/// it is not estimated, or nothing is known of it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Rig {
    /// Stamp of the keyframe.
    pub t_ns: i64,
    /// Added to the stamps of each camera, s.
    pub time_offsets: [Option<[f32; 2]>; CAMERAS_MAX],
    /// [p, θ] of each camera on the body, m and rad, θ on the right.
    pub extrinsics: [Option<[[f32; 6]; 2]>; CAMERAS_MAX],
    /// Factors of the gyro's axes and the accelerometer's, less one.
    pub imu_scale: Option<[[f32; 6]; 2]>,
}

impl Rig {
    pub fn new(t: Nanos, rig: &RigEstimate) -> Rig {
        let six = |both: [[f64; 6]; 2]| {
            let is_finite = both.as_flattened().iter().all(|x| x.is_finite());
            is_finite.then(|| both.map(|six| six.map(|x| x as f32)))
        };
        let two = |both: [f64; 2]| both.iter().all(|x| x.is_finite()).then(|| both.map(|x| x as f32));
        Rig {
            t_ns: t.0,
            time_offsets: rig.time_offsets.map(|found| found.and_then(two)),
            extrinsics: rig.extrinsics.map(|found| found.and_then(six)),
            imu_scale: rig.imu_scale.and_then(six),
        }
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Event<'a> {
    /// Older versions call it `kind`.
    #[serde(alias = "kind")]
    pub id: EventId,
    /// Epoch of the state before it; logs of older versions have none.
    #[serde(default)]
    pub epoch: u32,
    pub text: Cow<'a, str>,
}

/// Ties the clocks to one another, and a chunk to its run: the first message of each.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Clocks {
    pub monotonic_ns: i64,
    /// Goes on in suspend.
    pub boottime_ns: i64,
    /// Since 1970, UTC, as far as the machine knows.
    pub realtime_ns: i64,
    /// When the run began: `realtime_ns` then.
    pub run_ns: i64,
}

impl Clocks {
    fn now(run_ns: Option<i64>) -> Clocks {
        let [monotonic_ns, boottime_ns, realtime_ns] = host::clocks().map(|t| t.0);
        Clocks { monotonic_ns, boottime_ns, realtime_ns, run_ns: run_ns.unwrap_or(realtime_ns) }
    }
}

enum Content {
    State(State),
    Predicted(PredictedState),
    Rig(Rig),
    MapFromOdom(MapFromOdomMessage),
    Event(EventId, List<u8, TEXT>),
    /// From a thread that may allocate; none that is zero.
    Counters(Vec<(Cow<'static, str>, u64)>),
}

struct Record {
    at: Nanos,
    content: Content,
}

/// What the threads of a run and the log's share.
pub struct Queue {
    records: ArrayQueue<Record>,
    over: AtomicBool,
    /// Its thread has ended.
    closed: AtomicBool,
    counts: Counts,
    /// Why logging ended early.
    notice: OnceLock<String>,
}

impl Queue {
    pub fn measured(footprint: &mut Footprint) -> Queue {
        let records = footprint.build("queues: log", || ArrayQueue::new(QUEUE));
        Queue { records, over: false.into(), closed: false.into(), counts: Counts::default(), notice: OnceLock::new() }
    }

    fn push(&self, content: Content) {
        let full = self.records.push(Record { at: host::monotonic(), content }).is_err();
        self.counts.log_records_lost.add(u64::from(full));
    }
}

/// Where the threads of a run hand over what is logged.
#[derive(Clone)]
pub struct LogSender(Arc<Queue>);

impl LogSender {
    pub fn state(&self, state: State) {
        self.0.push(Content::State(state));
    }

    pub fn rig(&self, rig: Rig) {
        self.0.push(Content::Rig(rig));
    }

    pub fn map_from_odom(&self, placed: MapFromOdomMessage) {
        self.0.push(Content::MapFromOdom(placed));
    }

    /// Half of the queue is left to what comes once a frame, and to events.
    pub fn predicted(&self, state: PredictedState) {
        if self.0.records.len() < QUEUE / 2 {
            self.0.push(Content::Predicted(state));
        } else {
            self.0.counts.log_records_lost.add(1);
        }
    }

    pub fn event(&self, id: EventId, text: &str) {
        self.0.push(Content::Event(id, cut(text)));
    }

    /// Counters as they stand; from a thread that may allocate.
    pub fn counters(&self, mut list: Vec<(Cow<'static, str>, u64)>) {
        list.retain(|(_, n)| *n > 0);
        self.0.push(Content::Counters(list));
    }

    /// Why logging ended early, where it did.
    pub fn notice(&self) -> Option<&str> {
        self.0.notice.get().map(String::as_str)
    }
}

/// A log being written.
pub struct Log {
    queue: Arc<Queue>,
    /// Epochs that began in the runs of this folder before, where they are counted; else 0.
    pub epochs_before: u32,
    /// `None` once it was waited for.
    thread: Option<JoinHandle<Vec<PathBuf>>>,
}

impl Drop for Log {
    fn drop(&mut self) {
        self.end();
    }
}

impl Log {
    /// Begins the log of a run in `dir`. A log that cannot be written is a notice, and no reason not to fly.
    pub fn start(dir: PathBuf, limits: Limits, what: &str) -> Log {
        Log::begin(dir, limits, what, None)
    }

    /// Begins one that counts epochs over the runs of `dir`, in a file `epochs` there, for who hears of several runs.
    pub fn start_counting_epochs(dir: PathBuf, limits: Limits, what: &str) -> Log {
        let before = file::epochs_begun(&dir);
        Log::begin(dir, limits, what, Some(before))
    }

    fn begin(dir: PathBuf, limits: Limits, what: &str, before: Option<u32>) -> Log {
        let queue = Arc::new(Queue::measured(&mut Footprint::default()));
        let shared = queue.clone();
        LogSender(queue.clone()).event(EventId::Start, what);
        let thread = super::start(THREAD, move || {
            host::lower_priority(NICE);
            let files = write(&shared, LogFiles::new(dir, limits, before));
            shared.closed.store(true, Ordering::Release);
            files
        });
        *lock_last() = Some(queue.clone());
        Log { queue, epochs_before: before.unwrap_or(0), thread: Some(thread) }
    }

    pub fn sender(&self) -> LogSender {
        LogSender(self.queue.clone())
    }

    /// Waits until everything is on the disk, adds the counters of the log, and answers its files.
    pub fn finish(mut self, counters: &mut Vec<(&'static str, u64)>) -> Vec<PathBuf> {
        let files = self.end();
        counters.extend(self.queue.counts.list());
        files
    }

    fn end(&mut self) -> Vec<PathBuf> {
        self.queue.over.store(true, Ordering::Release);
        let Some(thread) = self.thread.take() else { return vec![] };
        thread.thread().unpark();
        thread.join().unwrap_or_default()
    }
}

/// The log that was begun last.
static LAST: Mutex<Option<Arc<Queue>>> = Mutex::new(None);

fn lock_last() -> MutexGuard<'static, Option<Arc<Queue>>> {
    LAST.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Ends the log with a panic, and waits until it is on the disk, or for `PANIC_MAX`.
pub fn close_for_panic(what: &str) {
    let Some(queue) = LAST.try_lock().ok().and_then(|last| last.clone()) else { return };
    if std::thread::current().name() == Some(THREAD) {
        // Nobody is left to write it.
        return;
    }
    LogSender(queue.clone()).event(EventId::Panic, what);
    queue.over.store(true, Ordering::Release);
    let limit = Instant::now() + PANIC_MAX;
    while !queue.closed.load(Ordering::Acquire) && Instant::now() < limit {
        std::thread::sleep(POLL_PERIOD / 10);
    }
}

/// Thread `log`: answers the files it wrote.
fn write(queue: &Queue, mut files: LogFiles) -> Vec<PathBuf> {
    let counts = &queue.counts;
    let (mut due, mut ended, mut unsynced) = (Instant::now() + SYNC_PERIOD, files.begin().err(), 0);
    loop {
        threads::alive();
        // Read before the queue, so that what came last is still written.
        let over = queue.over.load(Ordering::Acquire);
        // At most what the queue holds, so that the next sync is not put off.
        for record in std::iter::from_fn(|| queue.records.pop()).take(QUEUE) {
            unsynced += 1;
            if ended.is_none() {
                ended = files.write(&record).err();
            }
        }
        if ended.is_none() && (over || Instant::now() >= due) {
            ended = files.sync(over).err();
            due = Instant::now() + SYNC_PERIOD;
            if ended.is_none() {
                counts.log_records_written.add(std::mem::take(&mut unsynced));
                ended = files.leave_room().err();
            }
        }
        if let Some(why) = &ended {
            counts.log_records_lost.add(std::mem::take(&mut unsynced));
            if queue.notice.set(format!("the log of this run ended early: {why}")).is_ok() {
                counts.log_ended_early.add(1);
                files.give_up();
            }
        }
        if over {
            counts.log_files.add(files.written.len() as u64);
            return files.written;
        }
        std::thread::park_timeout(POLL_PERIOD);
    }
}
