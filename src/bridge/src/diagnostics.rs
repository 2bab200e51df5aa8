//! What the bridge knows of itself and of the daemon, as a DiagnosticStatus.

use crate::cloud::Outcome;
use crate::messages::{DiagnosticStatus, KeyValue, ERROR, OK, WARN};
use crate::socket::{Event, State, Status};
use serde_json::Value;
use std::collections::BTreeMap;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// How long what happened once is told.
const RECENT: Duration = Duration::from_secs(10);
/// Without a state for so long there is none.
const STATE_AGE_MAX: Duration = Duration::from_secs(1);
/// Percent; below it a state is worth a warning.
const QUALITY_LOW: u8 = 30;
/// The one bit of health that is no fault: the vehicle stands, and is held there.
const AT_REST: &str = "zero_velocity";
/// How far stamps may be ahead of the wall clock without a word, ns.
const AHEAD_MAX_NS: i64 = 100_000_000;

/// The last that was heard, and counts since the bridge was started.
pub struct Monitor {
    name: String,
    /// Why there is no connection to the daemon.
    no_link: Option<String>,
    state: Option<(Instant, State)>,
    status: Status,
    reset: Option<(Instant, String)>,
    /// The last line or state that could not be used.
    trouble: Option<(Instant, String)>,
    /// When the last event above a notice ceases to be news.
    event: Option<(Instant, Event)>,
    cloud: Outcome,
    counts: BTreeMap<&'static str, u64>,
    ahead_ns: i64,
}

/// Unix time, ns.
pub fn wall_ns() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_nanos() as i64)
}

fn is_recent(at: &Instant) -> bool {
    at.elapsed() < RECENT
}

impl Monitor {
    pub fn new(name: String) -> Monitor {
        let counted =
            ["states", "states_not_later", "states_not_finite", "not_sent", "lines_malformed", "lines_too_long"];
        Monitor {
            name,
            no_link: Some("not connected yet".into()),
            state: None,
            status: Status::default(),
            reset: None,
            trouble: None,
            event: None,
            cloud: Ok(0),
            counts: counted.map(|name| (name, 0)).into(),
            ahead_ns: 0,
        }
    }

    /// Takes note of a connection, or of why there is none; `true` where that is new.
    pub fn link(&mut self, no_link: Option<String>) -> bool {
        let is_new = self.no_link != no_link;
        self.no_link = no_link;
        is_new
    }

    pub fn count(&mut self, name: &'static str) {
        *self.counts.entry(name).or_default() += 1;
    }

    /// Takes note of what could not be used; `true` where it is the first of its kind for a while.
    pub fn trouble(&mut self, name: &'static str, what: String) -> bool {
        self.count(name);
        let is_new = self.trouble.as_ref().is_none_or(|(at, last)| !is_recent(at) || *last != what);
        self.trouble = Some((Instant::now(), what));
        is_new
    }

    /// Takes note of a state, and answers what to say of a reset before it.
    pub fn state(&mut self, state: &State, ahead_ns: i64) -> Option<String> {
        let epoch = state.epoch;
        let is_reset = self.state.as_ref().is_some_and(|(_, last)| last.epoch != epoch);
        let what = format!("epoch {epoch} begins: odom has a new origin, and poses jump");
        (self.state, self.ahead_ns) = (Some((Instant::now(), state.clone())), ahead_ns);
        is_reset.then(|| self.reset(what))
    }

    /// Takes note of a status, and answers what to say of a restart before it.
    pub fn status(&mut self, status: Status) -> Option<String> {
        let is_restart = status.uptime_s < self.status.uptime_s;
        self.status = status;
        is_restart.then(|| self.reset("the daemon was started anew: odom has a new origin, and poses jump".into()))
    }

    fn reset(&mut self, what: String) -> String {
        self.reset = Some((Instant::now(), what.clone()));
        what
    }

    /// Takes note of an event; those kept from before the connection are news as long as they would have been.
    pub fn event(&mut self, event: Event) {
        let age = Duration::from_nanos(wall_ns().saturating_sub(event.wall_ns).max(0) as u64);
        if event.level != "notice" {
            self.event = Some((Instant::now() + RECENT.saturating_sub(age), event));
        }
    }

    pub fn cloud(&mut self, outcome: Outcome) {
        self.cloud = outcome;
    }

    /// What is wrong, worst first.
    fn findings(&self) -> Vec<(u8, String)> {
        let mut found = vec![];
        match (&self.no_link, &self.state) {
            (Some(why), _) => found.push((ERROR, format!("no daemon: {why}"))),
            (None, None) => found.push((ERROR, "the daemon has no pose yet".into())),
            (None, Some((at, _))) if at.elapsed() > STATE_AGE_MAX => {
                found.push((ERROR, format!("no state for {:.0} s", at.elapsed().as_secs_f64())));
            }
            (None, Some((_, state))) if state.has_failed() => {
                found.push((ERROR, format!("odometry has failed: {}, quality {} %", state.source, state.quality)));
            }
            (None, Some((_, state))) if state.quality < QUALITY_LOW => {
                found.push((WARN, format!("odometry is weak: quality {} %", state.quality)));
            }
            _ => {}
        }
        if let Some((_, event)) = self.event.as_ref().filter(|(until, _)| *until > Instant::now()) {
            found.push((if event.level == "critical" { ERROR } else { WARN }, format!("{}: {}", event.id, event.text)));
        }
        let recent = [&self.reset, &self.trouble].into_iter().flatten().filter(|(at, _)| is_recent(at));
        found.extend(recent.map(|(_, what)| (WARN, what.clone())));
        if self.no_link.is_none() {
            let wrong = self.status.health.iter().filter(|what| *what != AT_REST);
            found.extend(wrong.map(|what| (WARN, what.clone())));
            found.extend(self.cloud.as_ref().err().map(|why| (WARN, format!("no cloud of the map: {why}"))));
        }
        if self.ahead_ns > AHEAD_MAX_NS {
            let ahead_s = self.ahead_ns as f64 * 1e-9;
            found.push((WARN, format!("the clock was set back: stamps are ahead by {ahead_s:.1} s until a restart")));
        }
        found.sort_by_key(|(level, _)| std::cmp::Reverse(*level));
        found
    }

    /// The level is the worst of what is wrong, the message all of it.
    pub fn report(&self) -> DiagnosticStatus {
        let findings = self.findings();
        let message = findings.iter().map(|(_, what)| what.as_str()).collect::<Vec<_>>().join("; ");
        let mut values = vec![];
        let mut tell = |key: &str, value: String| values.push(KeyValue { key: key.into(), value });
        if let Some((at, state)) = &self.state {
            tell("state_age_ms", at.elapsed().as_millis().to_string());
            tell("quality", state.quality.to_string());
            tell("source", state.source.clone());
            tell("epoch", state.epoch.to_string());
        }
        if let Some((_, event)) = &self.event {
            tell("last_event", format!("{} {}: {}", event.level, event.id, event.text));
        }
        tell("cloud_points", self.cloud.as_ref().map_or(0, |points| *points).to_string());
        self.counts.iter().for_each(|(name, count)| tell(&format!("bridge.{name}"), count.to_string()));
        let s = &self.status;
        tell("daemon.version", s.version.clone());
        tell("daemon.uptime_s", format!("{:.1}", s.uptime_s));
        tell("daemon.frames", s.frames.to_string());
        tell("daemon.posed", s.posed.to_string());
        for (room, members) in [
            ("counters", Some(&s.counters)),
            ("map", s.map.as_ref()),
            ("governor", s.governor.as_ref()),
            ("power", s.power.as_ref()),
        ] {
            members.into_iter().flatten().for_each(|(name, value)| tell(&format!("{room}.{name}"), plain(value)));
        }
        DiagnosticStatus {
            level: findings.first().map_or(OK, |(level, _)| *level),
            name: self.name.clone(),
            message: if message.is_empty() { "odometry is running".into() } else { message },
            hardware_id: s.board.clone(),
            values,
        }
    }
}

/// A text without its quotes, anything else as JSON has it.
fn plain(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_string)
}
