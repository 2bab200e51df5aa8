//! The autopilot's writer: ODOMETRY (or VISION_POSITION_ESTIMATE) of each frame as it comes, HEARTBEAT, TIMESYNC, STATUSTEXT.
//!
//! States are sent one by one, the newest first: what a slow link has no room for is left out, never queued. While no frame
//! comes, states carried by inertial samples take their place, so that a camera that stops for a moment makes no gap that an
//! autopilot would give up at (PX4 200 ms, ArduPilot 300 ms). Stamps are of the monotonic clock, which TIMESYNC ties to the
//! autopilot's; they only grow. `reset_counter` is the low byte of the epochs that began in the runs of the folder. A loop closure
//! moves no message.

mod link;
mod message;
pub mod parser;

use super::event::{EventId, Severity};
use super::{Event, Feed, Source, Stamps, State};
use crate::config::{Address, MavlinkConfig, StateMessage};
use link::Link;
use mavlink::dialects::common::{
    MavAutopilot, MavModeFlag, MavSeverity, MavState, MavType, HEARTBEAT_DATA, STATUSTEXT_DATA, TIMESYNC_DATA,
};
use mavlink::{MAVLinkV2MessageRaw, MavHeader, MessageData};
use message::Axes;
use mio::{Events, Poll, Token, Waker};
use parser::{Heard, Parser, Received};
use std::collections::VecDeque;
use std::io;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use stipple_drivers::counters::Counter;
use stipple_drivers::{counters, host, Fault, FaultKind};

/// MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY, and MAV_COMP_ID_AUTOPILOT1.
const OWN_COMPONENT: u8 = 197;
const AUTOPILOT: u8 = 1;
const LINK: Token = Token(0);
const FEED: Token = Token(1);
/// Heartbeats and requests of TIMESYNC.
const SECOND: Duration = Duration::from_secs(1);
/// Longest sleep, so that a stop is heard.
const PATIENCE: Duration = Duration::from_millis(50);
/// Without a frame for so long, and for so many periods of the camera, states between frames take the place of frames.
const FILL_AFTER: Duration = Duration::from_millis(90);
const FILL_PERIODS: f64 = 1.8;
/// States that say that odometry has failed are sent for so long; then silence says it, to autopilots that read no quality too.
const FAILED_TOLD: Duration = Duration::from_secs(1);
/// A stamp that is so far ahead of now is no stamp, µs.
const AHEAD_US: u64 = 50_000;
/// A condition is told when it has lasted so long.
const LASTING: Duration = Duration::from_millis(300);
/// Without a state for so long, odometry is silent.
const SILENT: Duration = Duration::from_millis(500);
/// Without a heartbeat for so long, the autopilot is.
const UNHEARD: Duration = Duration::from_secs(5);
/// A stamp that is so much older than the last one is of another clock; one that is older by less is late.
const CLOCK_STEP: i64 = 1_000_000_000;
/// Texts are sent at most so often.
const TEXT_PERIOD: Duration = Duration::from_millis(100);
/// A text that states kept waiting for so long goes first.
const TEXT_PATIENCE: Duration = Duration::from_millis(300);
/// A vehicle that starts so steep, degrees, is likelier one whose inertial unit is mounted otherwise.
const STEEP: f64 = 45.0;
/// Bytes of a text in one message.
const CHUNK: usize = 50;
/// Reads before states are looked at again: a flood does not hold them up.
const READS: usize = 32;
/// Answers that may wait.
const WAITING: usize = 8;

counters! {
    /// What came over the link.
    pub struct Counts of Counter, read by Counter::get;
    /// Messages sent, and those of them that are states.
    mavlink_sent,
    mavlink_states_sent,
    /// Messages that the link refused; times that it was opened anew.
    mavlink_refused,
    mavlink_reopened,
    /// Messages received, and bytes that belong to none.
    mavlink_received,
    mavlink_bytes_malformed,
    /// Longest time from a request of TIMESYNC to its answer, µs.
    mavlink_round_trip_us_most,
}

/// What odometry does, as an autopilot's operator is told.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Condition {
    Starting,
    Running,
    Carried,
    DeadReckoned,
    Silent,
}

impl Condition {
    fn told(self) -> (EventId, &'static str) {
        match self {
            Condition::Starting => (EventId::OdometryStarting, "odometry: starting"),
            Condition::Running => (EventId::OdometryRunning, "odometry: running"),
            Condition::Carried => (EventId::OdometryCarried, "odometry: no camera frames, carried by inertia"),
            Condition::DeadReckoned => (EventId::OdometryLost, "odometry: lost, dead reckoning"),
            Condition::Silent => (EventId::OdometryLost, "odometry: lost, no states"),
        }
    }

    fn state(self) -> MavState {
        match self {
            Condition::Starting => MavState::MAV_STATE_CALIBRATING,
            Condition::Running | Condition::Carried => MavState::MAV_STATE_ACTIVE,
            Condition::DeadReckoned | Condition::Silent => MavState::MAV_STATE_CRITICAL,
        }
    }
}

/// A text that is being sent, piece by piece.
struct Text {
    event: Event,
    id: u16,
    chunk: u8,
}

/// Where the writer takes a new rate and kind of message from.
#[derive(Clone)]
pub struct Settings(Arc<Mutex<Option<(f64, StateMessage)>>>);

impl Settings {
    /// Takes over from `config` what may change while the writer writes.
    pub fn set(&self, config: &MavlinkConfig) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some((config.rate_hz, config.message));
    }
}

/// The writer. It lives on a thread of its own.
pub struct Autopilot {
    poll: Poll,
    events: Events,
    feed: Feed,
    counts: Arc<Counts>,
    settings: Settings,
    address: Address,
    config: MavlinkConfig,
    stamps: Stamps,
    axes: Axes,
    link: Option<Link>,
    /// When to open the link again, and whether it was said that it is lost.
    retry: Instant,
    is_lost: bool,
    parser: Parser,
    sequence: u8,
    /// The newest state that is to be sent, and the stamp of the last that was, µs.
    pending: Option<State>,
    last_sent_us: Option<u64>,
    /// When the last state came, the last of a frame, and the time between two of these.
    last_state: Option<Instant>,
    last_frame: Option<Instant>,
    frame_period: Duration,
    /// Since when odometry has failed.
    failed: Option<Instant>,
    /// When the next state may be sent by the rate.
    state_due: Instant,
    heartbeat_due: Instant,
    timesync_due: Instant,
    /// Stamp of the last request.
    asked: i64,
    text_due: Instant,
    /// Answers, and when their requests came.
    answers: VecDeque<(TIMESYNC_DATA, i64)>,
    text: Option<Text>,
    texts: u16,
    condition: Condition,
    /// What it seems to be, and since when.
    seeming: (Condition, Instant),
    /// When the autopilot was heard last, and whether it was told that there is one of another system.
    heard: Option<Instant>,
    told_other: bool,
}

impl Autopilot {
    /// A writer to the autopilot that a board names, and what feeds it; `None` where it names none. The link is opened by `run`, again and again
    /// until it is there: a converter may be plugged in late.
    pub fn new(config: &MavlinkConfig, stamps: Stamps, epochs_before: u32) -> Result<Option<(Autopilot, Feed)>, Fault> {
        let Some(address) = config.address() else { return Ok(None) };
        let refused = |e: io::Error| {
            Fault::new(FaultKind::Unavailable, "mavlink.link", format!("the system has no epoll for it: {e}"), "")
        };
        let poll = Poll::new().map_err(refused)?;
        let feed = Feed::new(Waker::new(poll.registry(), FEED).map_err(refused)?, true);
        let now = Instant::now();
        let autopilot = Autopilot {
            poll,
            events: Events::with_capacity(8),
            feed: feed.clone(),
            counts: Arc::default(),
            settings: Settings(Arc::default()),
            address,
            config: config.clone(),
            stamps,
            axes: Axes::new(config.mount_rpy_deg, epochs_before),
            link: None,
            retry: now,
            is_lost: false,
            parser: Parser::new(),
            sequence: 0,
            pending: None,
            last_sent_us: None,
            last_state: None,
            last_frame: None,
            frame_period: Duration::from_millis(50),
            failed: None,
            state_due: now,
            heartbeat_due: now,
            timesync_due: now,
            asked: 0,
            text_due: now,
            answers: VecDeque::with_capacity(WAITING),
            text: None,
            texts: 0,
            condition: Condition::Starting,
            seeming: (Condition::Starting, now),
            heard: None,
            told_other: false,
        };
        Ok(Some((autopilot, feed)))
    }

    /// Thread `autopilot`: writes until `over`; `alive` is called at least each `PATIENCE`.
    pub fn run(mut self, over: &AtomicBool, alive: impl Fn()) {
        while !over.load(Ordering::Acquire) {
            alive();
            let new = self.settings.0.lock().unwrap_or_else(PoisonError::into_inner).take();
            if let Some((rate_hz, message)) = new {
                (self.config.rate_hz, self.config.message) = (rate_hz, message);
            }
            self.open();
            let served = self.serve();
            let wait = served.unwrap_or_else(|e| {
                self.lose(&e);
                Duration::ZERO
            });
            // Interrupted: it is asked again.
            let _ = self.poll.poll(&mut self.events, Some(wait.min(PATIENCE)));
        }
    }

    /// Where it takes new settings from.
    pub fn settings(&self) -> Settings {
        self.settings.clone()
    }

    /// What was sent and received so far, for whoever asks while it runs.
    pub fn counts(&self) -> Arc<Counts> {
        self.counts.clone()
    }

    fn open(&mut self) {
        if self.link.is_some() || Instant::now() < self.retry {
            return;
        }
        self.retry = Instant::now() + SECOND;
        match Link::open(&self.address, self.poll.registry(), LINK) {
            Ok(link) => {
                // What is left of before the loss is of no use.
                (self.pending, self.parser) = (None, Parser::new());
                if std::mem::take(&mut self.is_lost) {
                    self.counts.mavlink_reopened.add(1);
                    self.feed.say(EventId::LinkOpen, format!("autopilot: link {} is open", self.config.link));
                }
                self.link = Some(link);
            }
            Err(e) => self.lose(&e),
        }
    }

    fn lose(&mut self, e: &io::Error) {
        (self.link, self.heard) = (None, None);
        self.retry = Instant::now() + SECOND;
        if !std::mem::replace(&mut self.is_lost, true) {
            self.feed.say(
                EventId::LinkLost,
                format!("autopilot: link {} is lost: {e}; it is tried again each second", self.config.link),
            );
        }
    }

    /// Reads and writes what there is; answers how long there is nothing to do.
    fn serve(&mut self) -> io::Result<Duration> {
        let more = self.read()?;
        self.take_states();
        self.judge();
        while self.link.as_mut().map_or(Ok(false), Link::is_free)? {
            if !self.write_one()? {
                break;
            }
        }
        if more {
            return Ok(Duration::ZERO);
        }
        let now = Instant::now();
        let texts_due = (self.text.is_some() || !self.feed.0.events.is_empty()).then_some(self.text_due);
        let urgent = (self.pending.is_some() || !self.answers.is_empty()).then_some(now);
        let due = [Some(self.heartbeat_due), Some(self.timesync_due), texts_due, urgent].into_iter().flatten().min();
        // Nothing is written before the link is open, and free.
        let free = self.link.as_ref().map_or(self.retry, Link::free_at);
        Ok(due.unwrap_or(now).max(free).saturating_duration_since(now))
    }

    /// Reads what came; whether there is more.
    fn read(&mut self) -> io::Result<bool> {
        let mut bytes = [0; 2048];
        for _ in 0..READS {
            let Some(link) = &mut self.link else { return Ok(false) };
            let is_whole = link.gives_datagrams();
            let Some((count, from)) = link.read(&mut bytes)? else { return Ok(false) };
            let mut parser = std::mem::take(&mut self.parser);
            let before = parser.malformed;
            parser.take(&bytes[..count], is_whole, |received| self.hear(&received, from));
            self.counts.mavlink_bytes_malformed.add(parser.malformed - before);
            self.parser = parser;
        }
        Ok(true)
    }

    fn hear(&mut self, received: &Received, from: Option<SocketAddr>) {
        self.counts.mavlink_received.add(1);
        match &received.heard {
            Heard::Heartbeat(beat) if beat.autopilot != MavAutopilot::MAV_AUTOPILOT_INVALID => {
                self.hear_autopilot(received, beat, from);
            }
            // A request to us, or to everybody.
            Heard::Timesync(t) if t.tc1 == 0 && self.is_for_us(t) => {
                let (target_system, target_component) = (received.system, received.component);
                let came = host::monotonic().0;
                // One that finds the list full comes again.
                if self.answers.len() < WAITING {
                    let answer = TIMESYNC_DATA { tc1: 0, ts1: t.ts1, target_system, target_component };
                    self.answers.push_back((answer, came));
                }
            }
            // An answer to us has the stamp of our request, whose fields of the target older ends do not know.
            Heard::Timesync(t) if t.tc1 != 0 && t.ts1 == self.asked => {
                let round_us = (host::monotonic().0.saturating_sub(t.ts1) / 1000).clamp(0, 1_000_000);
                self.counts.mavlink_round_trip_us_most.raise(round_us as u64);
            }
            _ => {}
        }
    }

    fn is_for_us(&self, t: &TIMESYNC_DATA) -> bool {
        let is_our_system = t.target_system == 0 || u32::from(t.target_system) == self.config.system;
        is_our_system && [0, OWN_COMPONENT].contains(&t.target_component)
    }

    fn hear_autopilot(&mut self, received: &Received, beat: &HEARTBEAT_DATA, from: Option<SocketAddr>) {
        if received.component != AUTOPILOT {
            return;
        }
        let (system, ours, link) = (u32::from(received.system), self.config.system, &self.config.link);
        let kind = match beat.autopilot {
            MavAutopilot::MAV_AUTOPILOT_PX4 => "PX4",
            MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA => "ArduPilot",
            _ => "of another make",
        };
        if system != ours {
            // Another vehicle, or ours by another number. It is not answered.
            if !std::mem::replace(&mut self.told_other, true) {
                let fix = format!("if it is ours, set mavlink.system, which is {ours}");
                self.feed.say(
                    EventId::AutopilotForeign,
                    format!("autopilot: another one on {link}: {kind}, system {system}; {fix}"),
                );
            }
            return;
        }
        if let (Some(open), Some(from)) = (&mut self.link, from) {
            open.answer_to(from);
        }
        if self.heard.replace(Instant::now()).is_none() {
            self.feed.say(EventId::AutopilotHeard, format!("autopilot: heard on {link}: {kind}, system {system}"));
            // Who was not there did not hear it.
            self.condition = Condition::Starting;
        }
    }

    /// Takes the newest of the states that came.
    fn take_states(&mut self) {
        let now = Instant::now();
        while let Some(state) = self.feed.0.states.pop() {
            let is_frame = state.source != Source::Carried;
            if is_frame {
                let since = self.last_frame.replace(now).map_or(self.frame_period, |last| now - last);
                // Slower by and by, so that one gap makes no slow camera.
                self.frame_period = since.min(2 * self.frame_period).max(Duration::from_millis(1));
            }
            let patience = FILL_AFTER.max(self.frame_period.mul_f64(FILL_PERIODS));
            let fills = self.last_frame.is_some_and(|last| now - last >= patience);
            if is_frame || fills {
                self.last_state = Some(now);
                self.feed.0.skipped.add(u64::from(self.pending.replace(state).is_some()));
            }
        }
    }

    /// Tells what odometry does where that changed, and that nothing is heard of the autopilot.
    fn judge(&mut self) {
        let now = Instant::now();
        if self.heard.is_some_and(|heard| now - heard > UNHEARD) {
            self.heard = None;
            self.link.iter_mut().for_each(Link::forget_peer);
            self.feed.say(
                EventId::AutopilotSilent,
                format!("autopilot: no heartbeat on {} for {} s", self.config.link, UNHEARD.as_secs()),
            );
        }
        let seems = match (&self.pending, self.last_state) {
            (Some(state), _) => match state.source {
                _ if state.has_failed() => Condition::DeadReckoned,
                Source::Carried => Condition::Carried,
                _ => Condition::Running,
            },
            (None, Some(at)) if now - at > SILENT => Condition::Silent,
            _ => self.seeming.0,
        };
        if seems != self.seeming.0 {
            self.seeming = (seems, now);
        }
        if self.condition != seems && now - self.seeming.1 >= LASTING {
            self.condition = seems;
            let (id, text) = seems.told();
            self.feed.event(id, text);
        }
    }

    /// Writes what is most urgent; whether there was something.
    fn write_one(&mut self) -> io::Result<bool> {
        let now = Instant::now();
        if let Some((answer, came)) = self.answers.pop_front() {
            // What it waited here is not one end's clock ahead of the other's.
            let tc1 = came + (host::monotonic().0 - came) / 2;
            self.write(&TIMESYNC_DATA { tc1, ..answer })?;
        } else if now >= self.heartbeat_due {
            self.heartbeat_due = (self.heartbeat_due + SECOND).max(now);
            self.write(&HEARTBEAT_DATA {
                custom_mode: 0,
                mavtype: MavType::MAV_TYPE_ONBOARD_CONTROLLER,
                autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
                base_mode: MavModeFlag::empty(),
                system_status: self.condition.state(),
                mavlink_version: 3,
            })?;
        } else if now >= self.timesync_due {
            self.timesync_due = (self.timesync_due + SECOND).max(now);
            self.asked = host::monotonic().0;
            let ts1 = self.asked;
            self.write(&TIMESYNC_DATA { tc1: 0, ts1, target_system: 0, target_component: 0 })?;
        } else if now >= self.text_due + TEXT_PATIENCE && self.write_text()? {
        } else if let Some(state) = self.pending.take() {
            self.write_state(&state)?;
        } else {
            return Ok(now >= self.text_due && self.write_text()?);
        }
        Ok(true)
    }

    fn write_state(&mut self, state: &State) -> io::Result<()> {
        let (now, time_us) = (Instant::now(), (self.stamps.monotonic(state.odometry.t).0 / 1000).max(0) as u64);
        let behind_us = self.last_sent_us.map_or(-1, |last| last as i64 - time_us as i64);
        let is_late = (0..CLOCK_STEP / 1000).contains(&behind_us);
        let period = Duration::from_secs_f64(1.0 / self.config.rate_hz);
        let is_ahead = time_us > host::monotonic().0 as u64 / 1000 + AHEAD_US;
        self.failed = state.has_failed().then(|| self.failed.unwrap_or(now));
        // VISION_POSITION_ESTIMATE cannot say it at all.
        let told = if self.config.message == StateMessage::Odometry { FAILED_TOLD } else { Duration::ZERO };
        let has_failed = self.failed.is_some_and(|since| now - since >= told);
        // A frame that comes a little early is not one too many.
        if is_late || is_ahead || has_failed || now + period / 4 < self.state_due {
            self.feed.0.skipped.add(1);
            return Ok(());
        }
        let sent = match self.config.message {
            StateMessage::Odometry => match self.axes.odometry(state, time_us) {
                Some(message) => self.write(&message)?,
                None => false,
            },
            StateMessage::VisionPosition => match self.axes.vision_position(state, time_us) {
                Some(message) => self.write(&message)?,
                None => false,
            },
        };
        if let Some(degrees) = self.axes.take_nose_up().filter(|degrees| !(degrees.abs() < STEEP)) {
            self.feed.say(EventId::MountDoubtful, format!(
                "autopilot: at the first state the vehicle's nose points {degrees:.0} degrees up: compare mavlink.mount_rpy_deg"
            ));
        }
        if sent {
            self.state_due = (self.state_due + period).max(now);
            self.last_sent_us = Some(time_us);
            self.counts.mavlink_states_sent.add(1);
        } else {
            self.feed.0.skipped.add(1);
        }
        Ok(())
    }

    /// Writes the next piece of a text; whether there was one.
    fn write_text(&mut self) -> io::Result<bool> {
        if self.text.is_none() {
            // What is said of the link to who is at its other end helps nobody.
            let of_others = std::iter::from_fn(|| self.feed.0.events.pop()).find(|event| !event.id.is_of_link());
            let Some(event) = of_others else { return Ok(false) };
            // Zero says that there is one piece.
            let is_long = event.text.len() > CHUNK;
            self.texts = if is_long { self.texts.wrapping_add(1).max(1) } else { self.texts };
            let id = if is_long { self.texts } else { 0 };
            self.text = Some(Text { event, id, chunk: 0 });
        }
        let Some(Text { event: Event { id: event, text, .. }, id, chunk }) = &self.text else { return Ok(false) };
        let rest = &text[(*chunk as usize * CHUNK).min(text.len())..];
        let piece = &rest[..rest.len().min(CHUNK)];
        let mut bytes = [0; CHUNK];
        bytes[..piece.len()].copy_from_slice(piece);
        let message = STATUSTEXT_DATA {
            severity: match event.severity() {
                Severity::Notice => MavSeverity::MAV_SEVERITY_NOTICE,
                Severity::Warning => MavSeverity::MAV_SEVERITY_WARNING,
                Severity::Critical => MavSeverity::MAV_SEVERITY_CRITICAL,
            },
            text: mavlink::types::CharArray::new(bytes),
            id: *id,
            chunk_seq: *chunk,
        };
        // A piece that is not full is the last.
        let is_last = *id == 0 || piece.len() < CHUNK;
        if self.write(&message)? {
            self.text_due = Instant::now() + TEXT_PERIOD;
            match &mut self.text {
                Some(text) if !is_last => text.chunk += 1,
                _ => self.text = None,
            }
            return Ok(true);
        }
        // It is tried again.
        self.text_due = Instant::now() + TEXT_PERIOD;
        Ok(false)
    }

    /// Writes a message; false where the link refuses it.
    fn write(&mut self, data: &impl MessageData) -> io::Result<bool> {
        let Some(link) = &mut self.link else { return Ok(false) };
        let header =
            MavHeader { system_id: self.config.system as u8, component_id: OWN_COMPONENT, sequence: self.sequence };
        let mut raw = MAVLinkV2MessageRaw::new();
        raw.serialize_message_data(header, data);
        let sent = link.write(raw.raw_bytes())?;
        let counts = &self.counts;
        counts.mavlink_sent.add(u64::from(sent));
        counts.mavlink_refused.add(u64::from(!sent));
        // Receivers count what is missing.
        self.sequence = self.sequence.wrapping_add(u8::from(sent));
        Ok(sent)
    }
}
