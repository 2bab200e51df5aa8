//! One flight, live or replayed: the only place that starts its threads.
//!
//! ```text
//! camera -> gate -> mailbox(newest) -> frontend -> estimator -> keyframes -> mapping -> report, map.ply
//! imu ----> gate -> queue -----------------^                       `-> loops --^
//! ```
//!
//! | thread | work | heap |
//! |---|---|---|
//! | main | opens everything, shows status, reports | free |
//! | camera | waits for frames, or decodes files and delivers them when they are due | free |
//! | imu | waits for inertial samples; carries states to them (`log.predicted_hz`) | free |
//! | barometer | waits for pressures, where there is one | free |
//! | tracking | front end and back end in turns; offers keyframes | sealed |
//! | or frontend | follows points (`frontend.threads = 2`) | sealed |
//! | and estimator | estimates, one frame behind at most; offers keyframes | sealed |
//! | mapping | rectification, depth, training; low priority, as are the CPU device's own threads and, at boot, those that compile kernels; `stipple run` has it in a process of its own | sealed; OpenCV and the driver allocate behind it |
//! | map-answers | reads what that process tells | free |
//! | store-write, store-read | write and read the map on disk, in the mapper's process | free |
//! | autopilot | writes states to an autopilot and hears it, where the board names one | free |
//! | trigger | starts the cameras' exposures, where a line is wired for it | free |
//! | led | shows the state of a run, where a line is wired for it | free |
//! | loops | recognises places and corrects drift, where the board asks for it; low priority | free |
//! | log | writes states, events and counters to DIR; low priority | free |
//! | writer | writes what is recorded, if anything is; low priority | free |
//! | beat | says for the mapper's process that it lives | free |
//!
//! In lockstep the main thread is sensors and mapping too.
//!
//! Queues between them: frames (the newest wins, the rest are counted as dropped), inertial samples (never dropped),
//! tracks (two frames: the front end waits for the back end), keyframes (an offer may fail, counted), pose corrections.
//! Tracking waits for nobody, but for the samples up to a frame. Shutdown: the cameras end, tracking drains and ends,
//! mapping ends with the run's time.

pub mod carrier;
pub mod gate;
mod governor;
mod keyframes;
mod lockstep;
pub mod log;
mod loop_closing;
pub mod mailbox;
pub mod mapping;
pub mod memory;
mod opening;
mod power;
pub mod recorder;
mod reload;
mod seams;
pub mod sensors;
mod service;
mod spikes;
pub mod status;
pub mod status_led;
pub mod summary;
mod supervisor;
mod table;
pub mod threads;
pub mod tracking;
pub mod waker;
pub mod worker;
pub mod writers;

use crate::config::{Board, InjectConfig};
use crate::counters::Counters;
use crate::loops::Loops;
use crate::output::report::Report;
use crate::output::OutputDir;
use crate::publish::event::{EventId, Notice};
use crate::publish::status::About;
use gate::ImuGate;
use keyframes::Keyframes;
use log::Log;
use loop_closing::LoopClosing;
use mailbox::{Capture, Mailbox};
use power::Energy;
use recorder::Recording;
pub use reload::BoardSource;
use sensors::{Input, Playback, Sensors, Source};
use status::{print_err, Gauges, Status};
use status_led::StatusLed;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering, Ordering::Relaxed};
use std::thread::{Builder, JoinHandle, Scope, ScopedJoinHandle};
use std::time::{Duration, Instant};
use stipple_drivers::paced::FRAMES_UNREADABLE;
use stipple_drivers::record::Format;
use stipple_drivers::replay::read_trajectory;
use stipple_drivers::{host, Calibration, Fault, FaultKind, Frames};
pub use supervisor::Steering;
pub use table::KeyframesAt;
#[cfg(feature = "instruments")]
pub use table::Spacing;
use table::Table;
use tracking::{FramePacket, Inlet, Link, OdometryRun, Tracker};
use worker::MapSide;
use writers::Writers;

/// How frames arrive and mapping steps are spent.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Pace {
    /// Frames arrive at their time; what is not done in time is not done.
    #[default]
    Recorded,
    /// Deterministic: no frame is dropped, and mapping takes a stated number of steps.
    Lockstep(Steps),
}

/// Mapping steps of a flight in lockstep.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Steps {
    PerFrame(u32),
    /// Steps a second of the recording: plays a device that slow.
    PerSecond(f64),
    /// Seconds of mapping, spread evenly over the frames. Only tracking is deterministic then.
    #[cfg_attr(not(feature = "instruments"), allow(dead_code))] // a bench asks for it
    EqualTime(f64),
}

#[derive(Clone, Debug, Default)]
pub struct Options {
    pub pace: Pace,
    /// Table of poses in place of odometry.
    pub poses: Option<PathBuf>,
    /// The input's own true poses in place of odometry, and which frames are keyframes.
    pub at_truth: Option<KeyframesAt>,
    /// Every Nth keyframe is evaluated and never trained on; 0: none.
    pub holdout: u32,
    /// Live sensors are stopped after this time. A recording ends there; past its end the mapper goes on alone.
    pub duration_s: Option<f64>,
    /// Folder that the samples are recorded to, too.
    pub record: Option<PathBuf>,
    /// The map begins with nothing: what an earlier run left in its store is set aside.
    pub fresh: bool,
    /// The vehicle finds itself in the map of earlier runs, and changes nothing of it: there is no mapper.
    pub localise_only: bool,
    /// Mapping is done by a process of its own, and threads ask for real-time priority.
    pub service: bool,
    /// Faults added to the sensors of a recording.
    pub inject: InjectConfig,
    /// How a recording is played in real time.
    pub playback: Playback,
    /// Where the board is read from again, when a service manager asks for it.
    pub source: Option<BoardSource>,
}

/// Who takes keyframes: the mapper, and what closes loops.
type Sinks = (Option<MapSide>, Option<LoopClosing>);

/// What a flight left, beside its files.
pub struct Outcome {
    pub report: Report,
    /// Cost of reading the cameras, in words.
    pub capture: Option<String>,
    /// What went wrong though the files were written: a sensor broke, or a recording lacks something.
    pub fault: Option<Fault>,
}

/// A flight that has ended, before it is evaluated.
pub struct Flown {
    pub tracker: Tracker,
    pub map: Option<MapSide>,
    pub counters: Counters,
    pub frames: usize,
    pub keyframes: u64,
    /// What closed loops, where that was asked for.
    pub loops: Option<Box<Loops>>,
    pub wall_s: f64,
    /// Energy that the board took, where it can measure it; none in lockstep.
    pub energy: Option<Energy>,
    pub warnings: Vec<String>,
    /// Counters of the sources.
    pub source: Vec<(&'static str, u64)>,
    /// Cost of reading the cameras; none in lockstep.
    pub capture: Option<Capture>,
    /// The fault of the source that broke, if one did.
    pub broken: Option<Fault>,
    /// The first lines about sensors lost and found again, threads that hang, and the mapper.
    pub notices: Vec<Notice>,
}

/// Frames that a run without an end is judged by, evenly spread: the log has all of them.
const FRAMES_KEPT: usize = 1 << 14;
/// Lines of a run that are kept for what judges it: the log has all of them.
const NOTICES_KEPT: usize = 64;

/// Flies `input` on `board` and writes what it leaves to `out`.
pub fn fly(
    mut input: Input,
    board: &Board,
    out: &OutputDir,
    options: &Options,
    led: Option<StatusLed>,
) -> Result<Outcome, Fault> {
    let (given, mut board) = (board, board.clone());
    // In a service the mapper's libraries are its process's business, and so is whether all of it fits.
    let apart = board.map.enabled && options.service && matches!(options.pace, Pace::Recorded);
    let _lock = out.lock()?;
    opening::prepare(&mut input, &mut board, options, apart)?;
    let board = &board;
    let colours = memory::colours(&input.calibration, board).len();
    input.needs_colour(colours)?;
    let Playback { speed, repeats } = options.playback;
    let frames = opening::frames_kept(&mut input, options);
    let looked_up = |poses| Tracker::Table(Table { poses, keyframes: options.at_truth.clone(), last: None });
    let mut tracker = match &options.poses {
        Some(path) => looked_up(read_trajectory(path)?),
        None if options.at_truth.is_some() => looked_up(input.truth.clone()),
        None => Tracker::Odometry(Box::new(OdometryRun::new(&input.calibration, board, frames)?)),
    };
    let sinks = opening::sinks(&mut input, board, out, options, (apart, tracker.odometry().is_some()))?;
    let title = summary::Title {
        dataset: input.name,
        board: board.name.clone(),
        pace: match (&options.pace, &input.source) {
            (Pace::Lockstep(_), _) => "lockstep",
            (Pace::Recorded, Source::Recorded(_)) => "recorded",
            (Pace::Recorded, Source::Live { .. }) => "live",
        },
        scale: board.map.scale,
        truth: input.truth,
        opened: input.opened,
    };
    let length_s = input.source.length_s().filter(|_| !repeats);
    out.set_aside(!options.localise_only)?;
    let told = options.service && board.mavlink.address().is_some();
    let start = if told { Log::start_counting_epochs } else { Log::start };
    let log = start(out.path().into(), log::LIMITS, &title.to_string());
    input.warnings.iter().for_each(|warning| log.sender().event(EventId::Setup, warning));
    if let Tracker::Odometry(run) = &mut tracker {
        run.back.log = Some(log.sender());
        run.carrier.iter_mut().for_each(|carrier| carrier.log = Some(log.sender()));
    }
    let total_s = options.duration_s.map(|s| s * speed).or(length_s);
    let mut status = Status::new(total_s).with_led(led).with_log(log.sender()).with_service(options.service);
    let (calibration, live) = (&input.calibration, length_s.is_none());
    let (mut flown, recording) = match (input.source, options.pace) {
        (Source::Recorded(recorded), Pace::Lockstep(steps)) => {
            (lockstep::fly(recorded, calibration, tracker, sinks, options, steps, &mut status), None)
        }
        (source, _) => {
            let before = log.epochs_before;
            let about = About {
                version: env!("CARGO_PKG_VERSION"),
                board: title.board.clone(),
                dataset: title.dataset.clone(),
            };
            let mut steering = Steering::new(given, options.source.as_ref(), status.is_managed());
            let told = (&*writers::socket(out.path()), about, &mut steering);
            play(source, calibration, (tracker, sinks), (board, options), told, (colours, live, before), &mut status)?
        }
    };
    flown.loops.iter_mut().for_each(|loops| loops.keep_poses());
    judge_rig(&mut flown, &mut status);
    status.finish();
    flown.warnings.iter().for_each(|warning| print_err(format_args!("stipple: warning: {warning}")));
    let unread = (!live && flown.counters.frames_unreadable.get() == frames as u64).then(|| {
        let first = flown.warnings.first().map_or("", String::as_str);
        let what = format!("none of its {frames} frames can be read, the first: {first}");
        Fault::new(FaultKind::Data, input.place, what, "check that the recording is complete")
    });
    let capture = flown.capture.and_then(|c| c.line(&flown.source));
    let broken = flown.broken.take();
    let recorded = recording.map(|r| r.finish(&mut flown.source));
    let logged = summary::close_log(log, &title, &mut flown, unread.as_ref().or(broken.as_ref()));
    if let Some(fault) = unread {
        return Err(fault);
    }
    flown.warnings.splice(..0, input.warnings);
    flown.warnings.extend(flown.notices.iter().filter(|(id, _)| id.is_reported()).map(|(_, line)| line.clone()));
    let (report, unwritten) = summary::conclude(title, flown, &logged, out);
    let fault = recorded.and_then(Result::err).or(broken).or(unwritten);
    if fault.is_none() {
        status.ended_well();
    }
    Ok(Outcome { report, capture, fault })
}

/// Flies `source` in real time with the `colours` first cameras in colour, records and disturbs it as asked, and tells the
/// autopilot that the board names and the readers of `socket`; epochs are counted on from those `before`.
fn play(
    source: Source,
    calibration: &Calibration,
    (mut tracker, sinks): (Tracker, Sinks),
    (board, options): (&Board, &Options),
    (socket, about, steering): (&Path, About, &mut Steering),
    (colours, live, before): (usize, bool, u32),
    status: &mut Status,
) -> Result<(Flown, Option<Recording>), Fault> {
    let cloud = sinks.0.as_ref().and_then(|map| map.ring().cloud.clone());
    let shape = || Frames::in_colour(calibration, colours);
    let stamps = source.stamps(options.playback.speed);
    let sensors = source.sensors(options.playback);
    let record = options.record.as_deref().map(|dir| (dir, Format::Euroc));
    let (sensors, recording) = Recording::start(record, sensors, calibration, board, &shape())?;
    let sensors = sensors.with_faults(&options.inject, shape);
    let realtime = Realtime {
        holdout: options.holdout,
        until_s: options.duration_s,
        sensors_s: options.duration_s.filter(|_| live),
        stop: host::stop_asked_for(),
    };
    let writers = match options.service {
        true => Writers::start(board, stamps, before, (socket, about, cloud), &mut tracker, status)?,
        false => Writers::default(),
    };
    let mut flown = fly_in_real_time(sensors, calibration, tracker, sinks, &realtime, status, steering);
    writers.finish(&mut flown.source);
    Ok((flown, recording))
}

/// Says what is estimated of the rig and was not found by the end of the flight.
fn judge_rig(flown: &mut Flown, status: &mut Status) {
    let Some(run) = flown.tracker.odometry() else { return };
    for (id, line) in status.rig_found(run.back.vio.rig_findings_at_end()) {
        status.say(id, &line);
        flown.notices.push((id, line));
    }
}

/// Folder of the map's store in a run's folder.
pub const MAP_STORE: &str = "map";

/// The fault of a store that cannot be used, and what becomes of the map.
fn unkept(fault: &Fault) -> Fault {
    let what = format!("{}; the map is kept in memory alone, and ends where that is full", fault.what);
    Fault::new(fault.kind, &fault.place, what, &fault.fix)
}

/// Reads `input` at its own pace with the threads of a flight, shows every packet to `observer`, without estimating or mapping.
pub fn observe(
    mut input: Input,
    board: &Board,
    duration_s: Option<f64>,
    record: Option<(&Path, Format)>,
    observer: Box<dyn FnMut(&FramePacket) + Send>,
    status: &mut Status,
) -> Result<(Flown, Result<(), Fault>), Fault> {
    input.calibration.imu.range = input.source.imu_range(board);
    let calibration = &input.calibration;
    let live = matches!(input.source, Source::Live { .. });
    if let Source::Recorded(recorded) = &mut input.source {
        recorded.cut(duration_s);
    }
    let sensors = input.source.sensors(Playback::default());
    let shape = Frames::for_rig(calibration);
    let (sensors, recording) = Recording::start(record, sensors, calibration, board, &shape)?;
    let realtime =
        Realtime { holdout: 0, until_s: None, sensors_s: duration_s.filter(|_| live), stop: host::stop_asked_for() };
    let mut steering = Steering::default();
    let (tracker, sinks) = (Tracker::Observer(observer), (None, None));
    let mut flown = fly_in_real_time(sensors, calibration, tracker, sinks, &realtime, status, &mut steering);
    status.finish();
    flown.source.splice(..0, input.opened);
    let recorded = recording.map_or(Ok(()), |r| r.finish(&mut flown.source));
    Ok((flown, recorded))
}

/// Packets that go round: one being read, one waiting, one in hand while they change places, one in tracking for each of
/// its threads, and the last one, from which points are followed.
pub fn packets(threads: u32) -> usize {
    4 + threads as usize
}

/// What the threads of a flight in real time share.
struct Shared {
    start: Instant,
    mailbox: Mailbox,
    counters: Counters,
    gauges: Gauges,
    source_done: AtomicBool,
    tracking_done: AtomicBool,
}

/// When a flight in real time ends; its cameras' end ends it, too.
pub struct Realtime<'a> {
    pub holdout: u32,
    /// The mapper goes on until then.
    pub until_s: Option<f64>,
    /// The sensors are stopped then.
    pub sensors_s: Option<f64>,
    pub stop: &'a AtomicBool,
}

/// Period of the main thread's look at the others.
const STATUS_PERIOD: Duration = Duration::from_millis(20);

/// Runs sensors through tracking and mapping.
pub fn fly_in_real_time(
    mut sensors: Sensors,
    calibration: &Calibration,
    mut tracker: Tracker,
    (map, mut loops): Sinks,
    run: &Realtime,
    status: &mut Status,
    steering: &mut Steering,
) -> Flown {
    let ring = map.as_ref().map(|m| m.ring().clone());
    let colours = ring.as_ref().map_or(0, |r| r.colours());
    let shared = Shared {
        start: Instant::now(),
        mailbox: Mailbox::new(packets(tracker.threads()), calibration, colours),
        counters: Counters::default(),
        gauges: Gauges::default(),
        source_done: AtomicBool::new(false),
        tracking_done: AtomicBool::new(false),
    };
    let (s, link, ring) = (&shared, &Link::default(), ring.as_deref());
    let closing = loops.as_mut().and_then(LoopClosing::take_loops);
    let mut keyframes = Keyframes::new(run.holdout, loops);
    let (map, loops, notices) = std::thread::scope(|scope| {
        let (taker, keyframes) = (&link.taker, &mut keyframes);
        spawn_sensors(scope, (s, taker), calibration, &mut sensors, tracker.take_carrier());
        let observes = matches!(tracker, Tracker::Observer(_));
        let give = move |packet: Box<FramePacket>| {
            if !packet.imu_only {
                keyframes.pass_on(&packet, ring, &s.counters);
                s.gauges.frames.fetch_add(1, Relaxed);
                s.gauges.set_frame(&packet);
                s.gauges.posed.fetch_add(u64::from(observes || packet.tracked.is_some()), Relaxed);
                s.gauges.keyframes.store(keyframes.count, Relaxed);
            }
            let _ = s.mailbox.spare.push(packet);
        };
        let say = |closed| {
            let notice = s.gauges.set_closed(closed);
            status::count_lost(notice.map_or(Ok(()), |notice| s.mailbox.notices.push(notice)));
        };
        let closing = closing.map(|closing| spawn(scope, "loops", move || closing.run(&s.tracking_done, say)));
        let mut held = None;
        let take = move || s.mailbox.take(&mut held, &s.source_done, &s.counters);
        let ended = waker::SetOnDrop(&s.tracking_done, None);
        spawn_tracking(scope, link, &mut tracker, Inlet { take, over: &s.source_done }, &s.counters, give, ended);
        let tracked = || s.tracking_done.load(Ordering::Acquire);
        let over = |t_s: f64| run.stop.load(Relaxed) || run.until_s.is_none_or(|until| t_s >= until);
        let (mut worker, mut thread) = (None, None);
        match map {
            Some(MapSide::Apart(apart)) => worker = Some(apart),
            Some(MapSide::Here(here)) => {
                let work = move || mapping::map(*here, &s.gauges, s.start, tracked, over);
                thread = Some(spawn(scope, "mapping", work));
            }
            None => {}
        }
        let mapped = |t_s: f64, apart: bool| thread.as_ref().map_or(!apart || over(t_s), ScopedJoinHandle::is_finished);
        let notices = supervisor::supervise(s, run, (worker.as_deref_mut(), ring), mapped, status, steering);
        s.counters.map_restarts.add(worker.as_ref().map_or(0, |w| w.restarts));
        let here = |t: ScopedJoinHandle<_>| t.join().expect("a panic ends the process before");
        let loops = closing.map(|t| t.join().expect("a panic ends the process before"));
        (thread.map(|t| MapSide::Here(Box::new(here(t)))).or(worker.map(MapSide::Apart)), loops, notices)
    });
    let warnings = sensors.frames.warnings().to_vec();
    let beside = sensors.aids.as_ref().map_or_else(Vec::new, |aids| aids.counters());
    let mut source = [sensors.frames.counters(), sensors.imu.counters(), beside].concat();
    let unreadable = |count: &(&str, u64)| count.0 == FRAMES_UNREADABLE;
    source.iter().filter(|count| unreadable(count)).for_each(|(_, n)| s.counters.frames_unreadable.add(*n));
    source.retain(|count| !unreadable(count));
    // A recording ends when its taps are gone.
    drop(sensors);
    let arrived = s.mailbox.arrived.load(Relaxed) + s.counters.frames_unreadable.get();
    Flown {
        tracker,
        map,
        frames: arrived as usize,
        keyframes: keyframes.count,
        loops,
        wall_s: shared.start.elapsed().as_secs_f64(),
        energy: steering.energy(),
        warnings,
        counters: shared.counters,
        source,
        capture: shared.mailbox.capture.get().copied(),
        broken: shared.mailbox.broken.pop(),
        notices,
    }
}

/// Starts the threads of the sensors.
fn spawn_sensors<'scope>(
    scope: &'scope Scope<'scope, '_>,
    (s, taker): (&'scope Shared, &'scope waker::Waker),
    calibration: &Calibration,
    sensors: &'scope mut Sensors,
    carrier: Option<carrier::Carrier>,
) {
    let Sensors { frames, imu, aids } = sensors;
    spawn(scope, "camera", move || {
        let _ended = waker::SetOnDrop(&s.source_done, Some(taker));
        mailbox::camera(&s.mailbox, &mut **frames, taker, &s.counters, &s.gauges);
    });
    let gate = ImuGate::new(&calibration.imu);
    spawn(scope, "imu", move || {
        mailbox::inertial(&s.mailbox, &mut **imu, (gate, carrier), taker, &s.source_done, &s.counters)
    });
    if let Some(aids) = aids {
        spawn(scope, "barometer", move || mailbox::aids(&s.mailbox, &mut **aids, &s.source_done, &s.counters));
    }
}

/// Starts a named thread that ends by itself or is asked to.
fn start<T: Send + 'static>(name: &'static str, work: impl FnOnce() -> T + Send + 'static) -> JoinHandle<T> {
    Builder::new().name(name.into()).spawn(watched(name, work)).expect(FEW_THREADS)
}

/// Work that is watched under a name while it goes on.
fn watched<T>(name: &'static str, work: impl FnOnce() -> T) -> impl FnOnce() -> T {
    move || {
        let _watched = threads::watch(name);
        work()
    }
}

/// Does work on a named thread of its own and waits for it.
fn apart<T: Send>(name: &'static str, work: impl FnOnce() -> T + Send) -> T {
    std::thread::scope(|scope| spawn(scope, name, work).join().expect("a panic ends the process before"))
}

const FEW_THREADS: &str = "the system starts the few threads of a flight";

/// Starts a named thread of a flight.
fn spawn<'scope, T: Send + 'scope>(
    scope: &'scope Scope<'scope, '_>,
    name: &'static str,
    work: impl FnOnce() -> T + Send + 'scope,
) -> ScopedJoinHandle<'scope, T> {
    Builder::new().name(name.into()).spawn_scoped(scope, watched(name, work)).expect(FEW_THREADS)
}

/// Starts the threads of tracking. `give` gets each packet back, in order, on the last of them, and `ended` is dropped at
/// its end.
fn spawn_tracking<'scope, 'env>(
    scope: &'scope Scope<'scope, 'env>,
    link: &'env Link,
    tracker: &'env mut Tracker,
    inlet: Inlet<'scope, impl FnMut() -> Option<Box<FramePacket>> + Send + 'scope>,
    counters: &'env Counters,
    give: impl FnMut(Box<FramePacket>) + Send + 'scope,
    ended: impl Send + 'scope,
) {
    match tracker {
        Tracker::Table(poses) => spawn(scope, "tracking", move || {
            let _ended = ended;
            tracking::seal();
            tracking::without_odometry(link, inlet, |packet| tracking::look_up(poses, packet, counters), give);
        }),
        Tracker::Observer(observer) => spawn(scope, "tracking", move || {
            let _ended = ended;
            tracking::without_odometry(link, inlet, |packet| observer(packet), give);
        }),
        Tracker::Odometry(run) => {
            let OdometryRun { front, back, threads, .. } = run.as_mut();
            if *threads == 1 {
                spawn(scope, "tracking", move || {
                    let _ended = ended;
                    tracking::in_turns(link, inlet, front, back, give);
                })
            } else {
                let start = back.answer();
                spawn(scope, "frontend", move || tracking::follow_points(link, inlet, front, start));
                spawn(scope, "estimator", move || {
                    let _ended = ended;
                    tracking::estimate(link, back, give);
                })
            }
        }
    };
}
