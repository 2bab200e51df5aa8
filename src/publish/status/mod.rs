//! The status socket: how a run goes, for people, scrapers of metrics and bridges on the same machine.
//!
//! A connection sends lines of JSON: `{"get":"status"}`, `"metrics"` or `"points"`, or
//! `{"subscribe":["state","event","status"],"hz":10}`; it gets lines of JSON (`message`), after the line for points their bytes
//! (`cloud`). GET /status and GET /metrics of HTTP are answered, too. Root, this user and members of its groups may ask. Memory is fixed: so many
//! connections, so many bytes that wait for each; what does not fit is left out and counted.

pub mod client;
pub mod message;

use super::cloud::{self, Cloud};
use super::{Event, Feed, Stamps, State};
use client::{Client, Item, Request, Subscription};
use message::{metrics, EventMessage, Message, StateMessage, StatusMessage, Summary, WallClock};
use mio::net::UnixListener;
use mio::{Events, Interest, Poll, Token, Waker};
use std::collections::VecDeque;
use std::io;
use std::os::fd::AsRawFd;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use stipple_drivers::counters::Counter;
use stipple_drivers::{counters, host};

/// Connections at once.
const CLIENTS: usize = 8;
const LISTENER: Token = Token(CLIENTS);
const FEED: Token = Token(CLIENTS + 1);
/// Events that a new subscriber gets first.
const EVENTS_KEPT: usize = 64;
/// Longest sleep.
const PATIENCE: Duration = Duration::from_millis(250);
const SECOND: Duration = Duration::from_secs(1);

/// Bytes of all connections, beside those of points.
pub const BYTES: usize = CLIENTS * client::BYTES;

counters! {
    /// What readers of the status socket asked, and what they were not told.
    pub struct Counts of Counter, read by Counter::get;
    status_connections,
    /// Connections refused: of others than may ask, or one too many.
    status_refused,
    status_requests,
    /// Lines left out, since a reader was slow.
    status_lines_lost,
}

/// What is known of a run before it begins.
pub struct About {
    pub version: &'static str,
    pub board: String,
    pub dataset: String,
}

/// What the main thread tells, and what it reads.
#[derive(Default)]
pub struct Shared {
    summary: Mutex<Summary>,
    pub counts: Counts,
}

impl Shared {
    /// Puts a new summary in the place of the last.
    pub fn tell(&self, summary: Summary) {
        *self.summary.lock().unwrap_or_else(PoisonError::into_inner) = summary;
    }
}

/// The server. It lives on a thread of its own.
pub struct StatusServer {
    poll: Poll,
    events: Events,
    feed: Feed,
    shared: Arc<Shared>,
    listener: UnixListener,
    path: PathBuf,
    clients: [Option<Client>; CLIENTS],
    about: About,
    began: Instant,
    stamps: Stamps,
    /// The newest state, and when it came.
    state: Option<(State, Instant)>,
    kept: VecDeque<Event>,
    status_due: Instant,
    cloud: Option<Arc<Cloud>>,
    points: Vec<u8>,
    /// The points that are read now, and when new ones were asked for last.
    head: Option<cloud::Head>,
    wished: Option<Instant>,
}

impl StatusServer {
    /// Listens at `path`, in the place of whatever socket is there. Fails where the file system has none, or the path is too long for one.
    pub fn new(
        path: &Path,
        about: About,
        stamps: Stamps,
        cloud: Option<Arc<Cloud>>,
    ) -> io::Result<(StatusServer, Feed, Arc<Shared>)> {
        use std::os::unix::fs::FileTypeExt;
        if std::fs::symlink_metadata(path).is_ok_and(|file| file.file_type().is_socket()) {
            std::fs::remove_file(path)?;
        }
        let poll = Poll::new()?;
        let mut listener = UnixListener::bind(path)?;
        // Who may ask is told why not.
        std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o666))?;
        poll.registry().register(&mut listener, LISTENER, Interest::READABLE)?;
        let feed = Feed::new(Waker::new(poll.registry(), FEED)?, false);
        let (shared, now) = (Arc::<Shared>::default(), Instant::now());
        let server = StatusServer {
            poll,
            events: Events::with_capacity(2 * CLIENTS),
            feed: feed.clone(),
            shared: shared.clone(),
            listener,
            path: path.into(),
            clients: Default::default(),
            about,
            began: now,
            stamps,
            state: None,
            kept: VecDeque::with_capacity(EVENTS_KEPT),
            status_due: now,
            points: Vec::with_capacity(if cloud.is_some() { cloud::POINTS * cloud::STRIDE } else { 0 }),
            cloud,
            head: None,
            wished: None,
        };
        Ok((server, feed, shared))
    }

    /// Thread `status`: answers until `over`; `alive` is called at least each `PATIENCE`.
    pub fn run(mut self, over: &AtomicBool, alive: impl Fn()) {
        let mut more = false;
        while !over.load(Ordering::Acquire) {
            alive();
            let now = Instant::now();
            let subscribed = self.clients.iter().flatten().any(|client| client.subscription.status);
            let due = if subscribed { self.status_due.saturating_duration_since(now) } else { PATIENCE };
            // Interrupted: it is asked again.
            let _ = self.poll.poll(&mut self.events, Some(if more { Duration::ZERO } else { due.min(PATIENCE) }));
            self.accept();
            self.tell();
            more = (0..CLIENTS).filter(|i| self.serve(*i)).count() > 0;
            let wants = self.clients.iter().flatten().any(|client| client.subscription.states);
            self.feed.0.wants_states.store(wants, Ordering::Relaxed);
        }
    }

    fn accept(&mut self) {
        while let Ok((mut stream, _)) = self.listener.accept() {
            let counts = &self.shared.counts;
            let free = self.clients.iter().position(Option::is_none);
            let refused = match (host::peer_is_trusted(stream.as_raw_fd()), free) {
                (Ok(true), Some(i)) => {
                    let both = Interest::READABLE | Interest::WRITABLE;
                    let registered = self.poll.registry().register(&mut stream, Token(i), both);
                    registered.map(|()| self.clients[i] = Some(Client::new(stream))).map_err(|e| e.to_string())
                }
                (Ok(true), None) => {
                    // Room for one line is there on any new connection.
                    let error = format!("{CLIENTS} others are connected, and no more may be");
                    refuse(&mut stream, error.clone());
                    Err(error)
                }
                (Ok(false), _) => {
                    let error =
                        "only root, the user that flies and members of the groups of its process may ask".to_string();
                    refuse(&mut stream, error.clone());
                    Err(error)
                }
                (Err(e), _) => Err(e.to_string()),
            };
            counts.status_connections.add(u64::from(refused.is_ok()));
            counts.status_refused.add(u64::from(refused.is_err()));
        }
    }

    /// Queues what came from the run to those who subscribed to it.
    fn tell(&mut self) {
        let (now, wall) = (Instant::now(), wall_clock());
        while let Some(state) = self.feed.0.states.pop() {
            self.state = Some((state, now));
            if self.clients.iter_mut().flatten().all(|client| !client.subscription.states) {
                continue;
            }
            let Some(message) = StateMessage::new(&state, self.stamps.monotonic(state.odometry.t), wall) else {
                continue;
            };
            self.queue(&Message::State(Box::new(message)), |client| client.subscription.takes_state(now));
        }
        while let Some(event) = self.feed.0.events.pop() {
            self.queue(&Message::Event(EventMessage::new(&event, wall)), |client| client.subscription.events);
            if self.kept.len() == EVENTS_KEPT {
                self.kept.pop_front();
            }
            self.kept.push_back(event);
        }
        if now >= self.status_due {
            self.status_due = (self.status_due + SECOND).max(now);
            if self.clients.iter().flatten().any(|client| client.subscription.status) {
                self.queue(&self.status(), |client| client.subscription.status);
            }
        }
    }

    /// Queues a line to those connections that take it.
    fn queue(&mut self, message: &Message, mut takes: impl FnMut(&mut Client) -> bool) {
        let line = line(message);
        for client in self.clients.iter_mut().flatten() {
            let lost = takes(client) && !client.queue(&line);
            self.shared.counts.status_lines_lost.add(u64::from(lost));
        }
    }

    /// Answers what a connection asks, and writes what waits for it; whether it may have asked more.
    fn serve(&mut self, i: usize) -> bool {
        let Some(mut client) = self.clients[i].take() else { return false };
        let Some(requests) = client.read() else { return false };
        let more = !requests.is_empty();
        for request in requests {
            let of_points = request == Ok(Request::Get(Item::Points));
            let answer = self.answer(request, &mut client);
            let queued = client.queue(&answer);
            if of_points && queued && self.head.is_some() {
                client.queue_cloud();
            }
            let counts = &self.shared.counts;
            counts.status_requests.add(1);
            counts.status_lines_lost.add(u64::from(!queued));
            if std::mem::take(&mut client.subscription.wants_kept) {
                let wall = wall_clock();
                let lines = self.kept.iter().map(|event| line(&Message::Event(EventMessage::new(event, wall))));
                counts.status_lines_lost.add(lines.filter(|line| !client.queue(line)).count() as u64);
            }
        }
        if client.write(&self.points) {
            self.clients[i] = Some(client);
        }
        more
    }

    fn answer(&mut self, request: Result<Request, String>, client: &mut Client) -> Vec<u8> {
        match request {
            Ok(Request::Get(Item::Status)) => line(&self.status()),
            Ok(Request::Get(Item::Metrics)) => self.metrics().into_bytes(),
            Ok(Request::Get(Item::Points)) => self.points(client),
            Ok(Request::Subscribe(streams, period)) => {
                client.subscription = Subscription::new(&streams, period);
                vec![]
            }
            Ok(Request::Http(path)) => {
                client.end();
                let (code, kind, body) = match path.as_str() {
                    "metrics" => ("200 OK", "text/plain; version=0.0.4", self.metrics().into_bytes()),
                    "status" => ("200 OK", "application/json", line(&self.status())),
                    _ => ("404 Not Found", "text/plain", b"there are /metrics and /status\n".to_vec()),
                };
                let head = format!(
                    "HTTP/1.1 {code}\r\nContent-Type: {kind}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n",
                    body.len()
                );
                [head.into_bytes(), body].concat()
            }
            Err(error) => {
                client.end();
                line(&Message::Error { error })
            }
        }
    }

    fn newest(&self) -> Option<StateMessage> {
        let (state, _) = self.state.as_ref()?;
        StateMessage::new(state, self.stamps.monotonic(state.odometry.t), wall_clock())
    }

    fn status(&self) -> Message {
        let (state, now) = (self.newest(), host::monotonic());
        Message::Status(Box::new(StatusMessage {
            version: self.about.version.into(),
            board: self.about.board.clone(),
            dataset: self.about.dataset.clone(),
            t_ns: now.0,
            wall_ns: wall_clock().of(now),
            uptime_s: self.began.elapsed().as_secs_f64(),
            health: state.as_ref().map_or_else(Vec::new, |state| state.health.clone()),
            state,
            summary: self.summary(),
        }))
    }

    fn summary(&self) -> Summary {
        self.shared.summary.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn metrics(&self) -> String {
        let age_s = self.state.map(|(_, came)| came.elapsed().as_secs_f64());
        metrics(&self.about, self.began.elapsed().as_secs_f64(), age_s, self.newest().as_ref(), &self.summary())
    }

    /// The line before the points; they follow it.
    fn points(&mut self, client: &mut Client) -> Vec<u8> {
        let Some(cloud) = &self.cloud else {
            return line(&Message::Error { error: "this run has no map".into() });
        };
        // The mapper answers in its own time, and not more often than this.
        if self.wished.is_none_or(|wished| wished.elapsed() >= SECOND) {
            cloud.ask();
            self.wished = Some(Instant::now());
        }
        // What somebody reads stays as it is.
        if !self.clients.iter().flatten().any(Client::wants_cloud) && !client.wants_cloud() {
            self.points.clear();
            self.head = cloud.read(&mut self.points);
        }
        let stride = cloud::STRIDE;
        let Some(head) = self.head else {
            return line(&Message::Points { generation: 0, t_ns: 0, wall_ns: 0, epoch: 0, count: 0, of: 0, stride });
        };
        let (t, cloud::Head { generation, epoch, count, of, .. }) = (self.stamps.monotonic(head.t), head);
        line(&Message::Points { generation, t_ns: t.0, wall_ns: wall_clock().of(t), epoch, count, of, stride })
    }
}

impl Drop for StatusServer {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.path);
    }
}

/// Says why a connection is not served.
fn refuse(stream: &mut mio::net::UnixStream, error: String) {
    let _ = io::Write::write(stream, &line(&Message::Error { error }));
}

fn line(message: &Message) -> Vec<u8> {
    let mut bytes = serde_json::to_vec(message).unwrap_or_default();
    bytes.push(b'\n');
    bytes
}

fn wall_clock() -> WallClock {
    let [monotonic, _, realtime] = host::clocks();
    WallClock(realtime.0 - monotonic.0)
}
