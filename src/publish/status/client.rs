//! One connection to the status socket: requests in, lines out, in buffers of fixed size.

use mio::net::UnixStream;
use serde::Deserialize;
use std::io::{self, Read, Write};
use std::time::{Duration, Instant};

/// Longest request, bytes.
const REQUEST_MAX: usize = 1024;
/// Answers that may wait for a reader, bytes; lines that do not fit are left out.
const WAITING_MAX: usize = 128 << 10;
/// Bytes of a connection.
pub const BYTES: usize = REQUEST_MAX + WAITING_MAX;
/// A reader that takes nothing of a cloud for so long is cut off: others wait for the cloud's memory.
const CLOUD_PATIENCE: Duration = Duration::from_secs(5);

/// What a line may ask for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Item {
    Status,
    Metrics,
    Points,
}

/// What may be subscribed to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stream {
    State,
    Event,
    Status,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    get: Option<Item>,
    subscribe: Option<Vec<Stream>>,
    hz: Option<f64>,
}

/// A request.
#[derive(Debug, PartialEq)]
pub enum Request {
    Get(Item),
    /// Streams, and the least time between states.
    Subscribe(Vec<Stream>, Duration),
    /// GET of HTTP, by its path: a scraper of metrics, or curl.
    Http(String),
}

impl Request {
    /// Reads a line, without its end.
    pub fn parse(line: &[u8]) -> Result<Request, String> {
        let line = line.strip_suffix(b"\r").unwrap_or(line);
        if let Some(rest) = line.strip_prefix(b"GET /") {
            let path = rest.split(|byte| *byte == b' ').next().unwrap_or_default();
            return Ok(Request::Http(String::from_utf8_lossy(path).into_owned()));
        }
        let refused = |why: String| {
            format!(
                r#"{why}: ask {{"get":"status"}}, "metrics" or "points", or {{"subscribe":["state","event","status"],"hz":10}}"#
            )
        };
        let line: Line = serde_json::from_slice(line).map_err(|e| refused(format!("no request: {e}")))?;
        match (line.get, line.subscribe) {
            (Some(item), None) if line.hz.is_none() => Ok(Request::Get(item)),
            (None, Some(streams)) => {
                let hz = line.hz.unwrap_or(0.0);
                let period =
                    if hz > 0.0 { Duration::try_from_secs_f64(1.0 / hz).unwrap_or_default() } else { Duration::ZERO };
                Ok(Request::Subscribe(streams, period))
            }
            _ => Err(refused("one of get and subscribe".into())),
        }
    }
}

/// What a connection is subscribed to.
#[derive(Debug, Default)]
pub struct Subscription {
    pub states: bool,
    pub events: bool,
    pub status: bool,
    /// The events that are kept are to go first.
    pub wants_kept: bool,
    /// Least time between states, and when the next may go.
    period: Duration,
    due: Option<Instant>,
}

impl Subscription {
    pub fn new(streams: &[Stream], period: Duration) -> Subscription {
        let has = |stream| streams.contains(&stream);
        let (states, events, status) = (has(Stream::State), has(Stream::Event), has(Stream::Status));
        Subscription { states, events, status, wants_kept: events, period, due: None }
    }

    /// Whether a state is to go now.
    pub fn takes_state(&mut self, now: Instant) -> bool {
        // One that comes a little early is not one too many.
        if !self.states || self.due.is_some_and(|due| now + self.period / 4 < due) {
            return false;
        }
        self.due = Some((self.due.unwrap_or(now) + self.period).max(now));
        true
    }
}

pub struct Client {
    pub stream: UnixStream,
    pub subscription: Subscription,
    /// The part of a request that has come.
    request: Vec<u8>,
    /// What is to be written, and how much of it was.
    waiting: Vec<u8>,
    written: usize,
    /// How much of the cloud was written, where it is asked for, and when something was last.
    cloud: Option<(usize, Instant)>,
    /// It is closed when all is written; what else it sends is not read as requests.
    ends: bool,
}

impl Client {
    pub fn new(stream: UnixStream) -> Client {
        Client {
            stream,
            subscription: Subscription::default(),
            request: Vec::with_capacity(REQUEST_MAX),
            waiting: Vec::with_capacity(WAITING_MAX),
            written: 0,
            cloud: None,
            ends: false,
        }
    }

    /// Reads what came, as whole lines; `None` where the other end is gone.
    pub fn read(&mut self) -> Option<Vec<Result<Request, String>>> {
        let (mut requests, mut bytes) = (vec![], [0; REQUEST_MAX]);
        loop {
            let count = match self.stream.read(&mut bytes) {
                Ok(0) => return None,
                Ok(count) => count,
                Err(e) if e.kind() == io::ErrorKind::WouldBlock => return Some(requests),
                Err(e) if e.kind() == io::ErrorKind::Interrupted => continue,
                Err(_) => return None,
            };
            for byte in &bytes[..count] {
                if self.ends {
                    break;
                }
                if *byte == b'\n' {
                    requests.push(Request::parse(&self.request));
                    self.request.clear();
                } else if self.request.len() < REQUEST_MAX {
                    self.request.push(*byte);
                } else {
                    requests.push(Err(format!("no request: it has more than {REQUEST_MAX} bytes")));
                    self.ends = true;
                }
                // The head of HTTP goes on after its first line.
                self.ends |= matches!(requests.last(), Some(Err(_) | Ok(Request::Http(_))));
            }
            // One that sends without an end is answered in between.
            if !requests.is_empty() {
                return Some(requests);
            }
        }
    }

    /// Queues bytes; false where they do not fit, or a cloud goes first.
    pub fn queue(&mut self, bytes: &[u8]) -> bool {
        if self.written == self.waiting.len() {
            self.waiting.clear();
            self.written = 0;
        } else if self.waiting.len() + bytes.len() > WAITING_MAX {
            self.waiting.drain(..self.written);
            self.written = 0;
        }
        let fits = self.cloud.is_none() && self.waiting.len() + bytes.len() <= WAITING_MAX;
        if fits {
            self.waiting.extend_from_slice(bytes);
        }
        fits
    }

    /// Lets the cloud follow what is queued.
    pub fn queue_cloud(&mut self) {
        self.cloud = Some((0, Instant::now()));
    }

    pub fn wants_cloud(&self) -> bool {
        self.cloud.is_some()
    }

    /// Closes it when all is written.
    pub fn end(&mut self) {
        self.ends = true;
    }

    /// Writes what there is; false where it is over.
    pub fn write(&mut self, cloud: &[u8]) -> bool {
        loop {
            let (rest, of_cloud) = match (&self.waiting[self.written..], self.cloud) {
                ([], Some((at, _))) if at >= cloud.len() => {
                    self.cloud = None;
                    continue;
                }
                ([], Some((at, _))) => (&cloud[at..], true),
                ([], None) => return !self.ends,
                (rest, _) => (rest, false),
            };
            match self.stream.write(rest) {
                Ok(count) if of_cloud => self.cloud = self.cloud.map(|(at, _)| (at + count, Instant::now())),
                Ok(count) => self.written += count,
                Err(e) if e.kind() == io::ErrorKind::WouldBlock => {
                    return self.cloud.is_none_or(|(_, since)| since.elapsed() < CLOUD_PATIENCE);
                }
                Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
                Err(_) => return false,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn requests_are_lines_of_json_or_of_http() {
        let parse = |text: &str| Request::parse(text.as_bytes());
        assert_eq!(parse(r#"{"get":"status"}"#), Ok(Request::Get(Item::Status)));
        let subscribe = parse("{\"subscribe\":[\"state\",\"event\"],\"hz\":20}\r");
        assert_eq!(subscribe, Ok(Request::Subscribe(vec![Stream::State, Stream::Event], Duration::from_millis(50))));
        assert_eq!(parse("GET /metrics HTTP/1.1\r"), Ok(Request::Http("metrics".into())));
        for hz in ["0", "-1", "1e-300", "1e300"] {
            assert!(parse(&format!(r#"{{"subscribe":["state"],"hz":{hz}}}"#)).is_ok(), "{hz}");
        }
        for wrong in ["", "{}", "[]", "status", r#"{"get":"all"}"#, r#"{"get":"status","subscribe":[]}"#, "\u{0}"] {
            assert!(parse(wrong).unwrap_err().contains("subscribe"), "{wrong}");
        }
    }

    #[test]
    fn states_go_at_the_rate_that_was_asked_for() {
        let start = Instant::now();
        let sent = |hz: u64, frames_hz: u64| {
            let mut s = Subscription::new(&[Stream::State], Duration::from_nanos(1_000_000_000 / hz));
            (0..10 * frames_hz)
                .filter(|i| s.takes_state(start + Duration::from_nanos(i * 1_000_000_000 / frames_hz)))
                .count()
        };
        assert_eq!(sent(10, 20), 100);
        assert!((130..=155).contains(&sent(15, 20)), "{}", sent(15, 20));
        assert_eq!(sent(30, 20), 200, "each there is");
    }
}
