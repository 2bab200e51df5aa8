//! What a run shows while it goes on: a bar on a terminal, one line a second otherwise, and a status LED where one is wired.

use super::log::LogSender;
use super::service::{Journal, Service};
use super::status_led::StatusLed;
use super::threads;
use super::tracking::FramePacket;
use crate::config::MavlinkConfig;
use crate::counters::Counters;
use crate::frontend::{Verdict, Verdicts};
use crate::loops::MapFromOdom;
use crate::publish::event::{EventId, Notice};
use crate::publish::mavlink::Settings;
use crate::publish::status::message::{GovernorStatus, MapFromOdomMessage, MapStatus, PowerStatus, Summary};
use crate::publish::status::Shared;
use crate::publish::{Feed, Feeds};
use crate::vio::{Finding, Findings, Health, Part};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle, TermLike};
use std::fmt::{self, Write as _};
use std::io::{self, IsTerminal};
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering::Acquire, Ordering::Relaxed, Ordering::Release};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use stipple_drivers::host::{self, STDERR, STDOUT};

/// Written by the threads of a run, read by whoever shows it.
#[derive(Default)]
pub struct Gauges {
    pub frames: AtomicU64,
    /// Frames with a pose; where nobody tracks, all.
    pub posed: AtomicU64,
    /// The map failed, or a sensor broke.
    pub broke: AtomicBool,
    pub keyframes: AtomicU64,
    pub anchors: AtomicU64,
    pub splats: AtomicU64,
    pub iterations: AtomicU64,
    /// Slices of work that mapping has ended.
    pub slices: AtomicU64,
    /// Training PSNR of the last probe, 0.01 dB.
    pub psnr_cdb: AtomicU64,
    /// Longest that tracking took a frame since it was asked last, µs.
    pub latency_us_most: AtomicU64,
    /// Time of the recording played so far, ms.
    pub played_ms: AtomicU64,
    /// The epoch of the newest frame, and the health of the epoch's first.
    pub epoch: AtomicU32,
    pub epoch_health: AtomicU32,
    /// `Verdicts` on the cameras, and `Findings` on what is estimated of the rig.
    pub verdicts: AtomicU64,
    pub findings: AtomicU64,
    /// Where `odom` is in the map; of no count before a place was recognised.
    pub map_from_odom: Mutex<MapFromOdom>,
}

impl Gauges {
    /// Takes note of the epoch of a frame.
    pub fn set_epoch(&self, epoch: u32, health: Health) {
        if epoch != self.epoch.load(Relaxed) {
            self.epoch_health.store(health.0, Relaxed);
            self.epoch.store(epoch, Release);
        }
    }

    /// Takes note of a frame that was tracked just now.
    pub fn set_frame(&self, packet: &FramePacket) {
        self.set_epoch(packet.epoch, packet.health);
        self.set_found(packet);
        self.latency_us_most.fetch_max(packet.begun.elapsed().as_micros() as u64, Relaxed);
    }

    /// Where `odom` is in the map, once a place was recognised.
    fn map_from_odom(&self) -> Option<MapFromOdomMessage> {
        let MapFromOdom { t, count, epoch, pose, covariance } =
            *self.map_from_odom.lock().unwrap_or_else(PoisonError::into_inner);
        let (position, yaw) = (pose.p.to_array(), pose.yaw);
        (count > 0).then_some(MapFromOdomMessage { t_ns: t.0, count, epoch, position, yaw, covariance })
    }

    /// Takes note of a loop that was closed; answers the line about it.
    pub fn set_closed(&self, (placed, notice): (MapFromOdom, Option<Notice>)) -> Option<Notice> {
        *self.map_from_odom.lock().unwrap_or_else(PoisonError::into_inner) = placed;
        notice
    }

    /// Takes note of what was found of the rig by a frame.
    pub fn set_found(&self, packet: &FramePacket) {
        self.verdicts.store(packet.verdicts.0, Relaxed);
        self.findings.store(packet.findings.0, Relaxed);
    }
}

pub struct Status {
    bar: Option<ProgressBar>,
    /// `None`: until it is stopped.
    total_ms: Option<u64>,
    /// `None`: never.
    next_line: Option<Instant>,
    led: Option<StatusLed>,
    log: Option<LogSender>,
    service: Option<Service>,
    journal: Option<Journal>,
    /// Writers of the run, the one to the autopilot, and the readers of the status socket.
    feeds: Feeds,
    autopilot: Option<Settings>,
    readers: Option<Arc<Shared>>,
    /// What share of its time the mapper works, and why.
    pub governor: GovernorStatus,
    pub power: Option<PowerStatus>,
    /// When counters are logged next.
    next_count: Instant,
    /// Whether it was said that logging ended.
    log_ended: bool,
    /// The epoch, the verdicts on cameras, and the findings on the rig, that were told last.
    epoch: u32,
    verdicts: u64,
    findings: u64,
    /// The count of `map_from_odom` that was logged last.
    placed: u32,
}

const LINE_PERIOD: Duration = Duration::from_secs(1);

impl Status {
    pub fn new(total_s: Option<f64>) -> Status {
        let total_ms = total_s.map(|s| (s.max(0.0) * 1e3) as u64);
        let bar = io::stderr().is_terminal().then(|| {
            let target = ProgressDrawTarget::term_like(Box::<Terminal>::default());
            let bar = ProgressBar::with_draw_target(total_ms, target);
            let drawn = if total_ms.is_some() { "{bar:30} {percent:>3}%" } else { "{spinner}" };
            let style = ProgressStyle::with_template(&format!("{drawn} {{elapsed}} {{msg}}"));
            bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
            bar
        });
        Status { bar, total_ms, next_line: Some(Instant::now() + LINE_PERIOD), ..Status::silent() }
    }

    /// Shows nothing.
    pub fn silent() -> Status {
        let next_count = Instant::now() + LINE_PERIOD;
        Status {
            bar: None,
            total_ms: None,
            next_line: None,
            led: None,
            log: None,
            service: None,
            journal: None,
            feeds: Feeds::default(),
            autopilot: None,
            readers: None,
            governor: GovernorStatus::default(),
            power: None,
            next_count,
            log_ended: false,
            epoch: 0,
            verdicts: 0,
            findings: 0,
            placed: 0,
        }
    }

    /// Shows it on the LED of a board that has one, too.
    pub fn with_led(mut self, led: Option<StatusLed>) -> Status {
        self.led = led;
        self
    }

    /// Logs what it says, and counters, too.
    pub fn with_log(mut self, log: LogSender) -> Status {
        self.log = Some(log);
        self
    }

    /// Tells the service manager and its journal, too, where there is one and this is a `service`.
    pub fn with_service(mut self, service: bool) -> Status {
        self.service = service.then(Service::of_this_process).flatten();
        self.journal = service.then(Journal::of_this_process).flatten();
        self
    }

    /// Tells the writers of a run what it says, too.
    pub fn tell_writers(&mut self, feeds: Feeds) {
        self.feeds = feeds;
    }

    /// Where the writer to an autopilot takes other settings from.
    pub fn tell_autopilot(&mut self, settings: Settings) {
        self.autopilot = Some(settings);
    }

    /// Tells the readers of the status socket how the run goes, each second.
    pub fn tell_readers(&mut self, readers: Arc<Shared>) {
        self.readers = Some(readers);
    }

    /// Lines about links since this was asked last.
    pub fn writers_said(&self) -> Vec<Notice> {
        self.feeds.0.iter().flat_map(Feed::notices).collect()
    }

    /// Whether a service manager hears of the run.
    pub fn is_managed(&self) -> bool {
        self.service.is_some()
    }

    /// The board file is being read again.
    pub fn reloading(&mut self) {
        self.service.iter_mut().for_each(Service::reloading);
    }

    /// Takes over what may change of the autopilot's writer while it writes.
    pub fn set_autopilot(&self, config: &MavlinkConfig) {
        self.autopilot.iter().for_each(|settings| settings.set(config));
    }

    /// The run is to end: results are written from here on.
    pub fn stopping(&mut self) {
        self.service.iter_mut().for_each(Service::stopping);
    }

    /// The run ended as it was asked to: the LED shows no fault.
    pub fn ended_well(&mut self) {
        self.led.iter_mut().for_each(StatusLed::ended_well);
    }

    /// Cheap to call often: draws at most once a second without a terminal.
    pub fn show(&mut self, g: &Gauges) {
        if let Some(led) = &mut self.led {
            led.show(g.posed.load(Relaxed), g.broke.load(Relaxed), Instant::now());
        }
        if let Some(service) = &mut self.service {
            service.tell(threads::are_alive(), || format!("epoch {}, {}", g.epoch.load(Relaxed), line(g)));
        }
        let played = g.played_ms.load(Relaxed).min(self.total_ms.unwrap_or(u64::MAX));
        match &self.bar {
            Some(bar) => {
                bar.set_position(played);
                bar.set_message(line(g));
            }
            // The journal has the events, and the service manager how it goes.
            None if self.journal.is_some() => {}
            None if self.next_line.is_some_and(|due| Instant::now() >= due) => {
                self.next_line = self.next_line.map(|due| due + LINE_PERIOD);
                let of = self.total_ms.map_or(String::new(), |ms| format!(" of {:.1}", ms as f64 * 1e-3));
                print_err(format_args!("{:.1}{of} s: {}", played as f64 * 1e-3, line(g)));
            }
            None => {}
        }
    }

    /// Logs where `odom` is in the map when that has changed, counters and gauges once a second, and says it when logging has
    /// ended. Cheap to call often.
    pub fn log_counters(&mut self, counters: &Counters, g: &Gauges) {
        let placed = g.map_from_odom().filter(|placed| placed.count != self.placed);
        if let (Some(placed), Some(log)) = (placed, &self.log) {
            log.map_from_odom(placed);
            self.placed = placed.count;
        }
        if Instant::now() < self.next_count {
            return;
        }
        self.next_count += LINE_PERIOD;
        self.tell_summary(counters, g);
        let Some(log) = &self.log else { return };
        let gauges = [
            ("frames", &g.frames),
            ("keyframes", &g.keyframes),
            ("anchors", &g.anchors),
            ("splats", &g.splats),
            ("iterations", &g.iterations),
        ];
        let all = gauges.iter().map(|(name, n)| (*name, n.load(Relaxed))).chain(counters.list());
        log.counters(all.map(|(name, n)| (name.into(), n)).collect());
        let ended = log.notice().filter(|_| !self.log_ended).map(str::to_string);
        if let Some(why) = ended {
            // The log takes no more.
            self.print(EventId::LogEnded, &why);
            self.feeds.event(EventId::LogEnded, &why);
            self.log_ended = true;
        }
    }

    fn tell_summary(&self, counters: &Counters, g: &Gauges) {
        let Some(readers) = &self.readers else { return };
        let psnr = g.psnr_cdb.load(Relaxed);
        readers.tell(Summary {
            frames: g.frames.load(Relaxed),
            posed: g.posed.load(Relaxed),
            map: MapStatus {
                keyframes: g.keyframes.load(Relaxed),
                anchors: g.anchors.load(Relaxed),
                splats: g.splats.load(Relaxed),
                iterations: g.iterations.load(Relaxed),
                psnr_db: (psnr > 0).then_some(psnr as f64 * 0.01),
            },
            governor: self.governor.clone(),
            power: self.power,
            map_from_odom: g.map_from_odom(),
            counters: counters.list().into_iter().map(|(name, n)| (name.into(), n)).collect(),
        });
    }

    /// A line about an epoch that began since this was asked last.
    pub fn epoch_begun(&mut self, g: &Gauges) -> Option<String> {
        let epoch = g.epoch.load(Acquire);
        if std::mem::replace(&mut self.epoch, epoch) == epoch {
            return None;
        }
        let resets = Health(g.epoch_health.load(Relaxed) & Health::RESETS.0);
        let why = match resets.reasons().next() {
            Some(reset) => format!("{reset}: poses go on in a frame that dead reckoning guesses"),
            None => "odometry runs again, elsewhere than dead reckoning led".into(),
        };
        Some(format!("epoch {epoch} begins: {why}"))
    }

    /// A line about each finding on cameras and rig since this was asked last.
    pub fn rig_judged(&mut self, g: &Gauges) -> Vec<Notice> {
        let verdicts = g.verdicts.load(Relaxed);
        let before = std::mem::replace(&mut self.verdicts, verdicts);
        let of_cameras = Verdicts(verdicts & !before).iter().map(|(verdict, cameras)| judged(verdict, cameras));
        of_cameras.chain(self.rig_found(Findings(g.findings.load(Relaxed)))).collect()
    }

    /// A line about each finding on what is estimated of the rig since this was asked last.
    pub fn rig_found(&mut self, findings: Findings) -> Vec<Notice> {
        let before = std::mem::replace(&mut self.findings, findings.0);
        let new = Findings(findings.0 & !before);
        let thrown = "what was estimated of the rig can be no rig and is thrown away, its calibration is used again: is it of this \
                      rig, with its cameras in order?";
        let thrown = new.has_thrown_away().then(|| (EventId::RigDiscarded, thrown.to_string()));
        thrown.into_iter().chain(new.iter().map(|(finding, part)| found(finding, part))).collect()
    }

    /// Prints a line that stays, logs it as an event, and tells the writers.
    pub fn say(&self, id: EventId, text: &str) {
        self.log.iter().for_each(|log| log.event(id, text));
        self.feeds.event(id, text);
        self.print(id, text);
    }

    fn print(&self, id: EventId, text: &str) {
        if self.journal.as_ref().is_some_and(|journal| journal.write(id, self.epoch, text)) {
            return;
        }
        match &self.bar {
            Some(bar) => bar.println(format!("stipple: {text}")),
            None if self.next_line.is_some() => print_err(format_args!("stipple: {text}")),
            None => {}
        }
    }

    pub fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

fn judged(verdict: Verdict, [a, b]: [usize; 2]) -> Notice {
    match verdict {
        Verdict::Swapped => {
            let line = format!(
                "cameras {a} and {b} are swapped: each sees what the other should. Exchange their names in camera.devices, or \
                 the data of their folders in a recording"
            );
            (EventId::CamerasSwapped, line)
        }
        Verdict::Disagree => {
            let line = format!(
                "camera {b} never agrees with camera {a}: wrong calibration, other frame timing, or covered? `stipple \
                 calib-check` judges a calibration by a recording"
            );
            (EventId::CamerasDisagree, line)
        }
        Verdict::AgreeAfterAll => (EventId::CamerasAgree, format!("camera {b} agrees with camera {a} after all")),
    }
}

/// Fits an event.
fn found(finding: Finding, part: Part) -> Notice {
    let (name, key) = match part {
        Part::TimeOffset(c) => (format!("time offset of camera {c}"), "vio.time_offset_sigma_s"),
        Part::Extrinsics(c) => (format!("place of camera {c}"), "vio.extrinsics_sigma_*"),
        Part::GyroScale => ("scale of the gyro".into(), "vio.imu_scale_sigma"),
        Part::AccelScale => ("scale of the accelerometer".into(), "vio.imu_scale_sigma"),
    };
    let (id, what) = match finding {
        Finding::Unknown => (
            EventId::RigUnknown,
            "is not found, poses are as wrong as its calibration: turn and accelerate about all axes, or calibrate it".into(),
        ),
        Finding::Moving => (
            EventId::RigMoving,
            "is not found, its estimate goes on moving by many deviations: is a part loose, or the rest of the calibration \
             wrong?"
                .into(),
        ),
        Finding::TooFar => (
            EventId::RigTooFar,
            format!(
                "is estimated further from its calibration than the board deems possible: calibrate it, or raise {key}"
            ),
        ),
        Finding::FoundAfterAll => (EventId::RigFound, String::from("is found after all")),
    };
    (id, format!("the {name} {what}"))
}

fn line(g: &Gauges) -> String {
    let psnr = g.psnr_cdb.load(Relaxed);
    let psnr = if psnr == 0 { String::new() } else { format!(", {:.2} dB", psnr as f64 * 0.01) };
    format!(
        "{} frames, {} keyframes, {} anchors, {} Gaussians, {} iterations{psnr}",
        g.frames.load(Relaxed),
        g.keyframes.load(Relaxed),
        g.anchors.load(Relaxed),
        g.splats.load(Relaxed),
        g.iterations.load(Relaxed),
    )
}

/// What a pipe that is writable takes without waiting.
const LINE_BYTES_MAX: usize = 4096;
/// Lines that nobody took.
static LINES_LOST: AtomicU64 = AtomicU64::new(0);

/// The terminal of standard error, for a bar that never waits for it.
#[derive(Debug, Default)]
struct Terminal(Mutex<String>);

impl Terminal {
    fn put(&self, text: fmt::Arguments) -> io::Result<()> {
        let mut waiting = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        waiting.write_fmt(text).map_err(io::Error::other)
    }

    /// Moves the cursor by `n`, in the direction that ANSI gives this letter.
    fn step(&self, n: usize, direction: char) -> io::Result<()> {
        if n == 0 {
            return Ok(());
        }
        self.put(format_args!("\x1b[{n}{direction}"))
    }
}

impl TermLike for Terminal {
    fn width(&self) -> u16 {
        host::columns(STDERR)
    }

    fn move_cursor_up(&self, n: usize) -> io::Result<()> {
        self.step(n, 'A')
    }

    fn move_cursor_down(&self, n: usize) -> io::Result<()> {
        self.step(n, 'B')
    }

    fn move_cursor_right(&self, n: usize) -> io::Result<()> {
        self.step(n, 'C')
    }

    fn move_cursor_left(&self, n: usize) -> io::Result<()> {
        self.step(n, 'D')
    }

    fn write_line(&self, text: &str) -> io::Result<()> {
        self.put(format_args!("{text}\n"))
    }

    fn write_str(&self, text: &str) -> io::Result<()> {
        self.put(format_args!("{text}"))
    }

    fn clear_line(&self) -> io::Result<()> {
        self.put(format_args!("\r\x1b[2K"))
    }

    fn flush(&self) -> io::Result<()> {
        let text = std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner));
        let written = host::write_now(STDERR, text.as_bytes());
        LINES_LOST.fetch_add(u64::from(!written), Relaxed);
        Ok(())
    }
}

/// Prints a line to standard error. One that is closed, or whose reader has stopped reading, costs the line and nothing else.
pub fn print_err(line: fmt::Arguments) {
    let text = format!("{line}\n");
    let written = host::write_now(STDERR, &text.as_bytes()[..text.len().min(LINE_BYTES_MAX)]);
    LINES_LOST.fetch_add(u64::from(!written), Relaxed);
}

/// Counts a line that a full queue gave back.
pub fn count_lost<T>(pushed: Result<(), T>) {
    LINES_LOST.fetch_add(u64::from(pushed.is_err()), Relaxed);
}

/// Lines that standard error, or a queue on the way to it, did not take so far.
pub fn lines_lost() -> u64 {
    LINES_LOST.load(Relaxed)
}

/// Prints lines of the result to standard output; one that is closed, or that nobody reads for five seconds, likewise.
pub fn print_out(line: impl fmt::Display) {
    if host::is_writable(STDOUT, 5000) {
        let _ = io::Write::write_fmt(&mut io::stdout(), format_args!("{line}\n"));
    }
}
