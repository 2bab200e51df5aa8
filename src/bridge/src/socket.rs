//! The daemon's status socket: lines of JSON, and the bytes of points. What is kept of a connection is bounded, and no call
//! waits longer than `WAIT`, whatever the daemon sends.

use serde::Deserialize;
use serde_json::Value;
use socket2::{Domain, SockAddr, Socket, Type};
use std::collections::BTreeMap;
use std::io::{self, BufRead, BufReader, ErrorKind, Write};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::time::Duration;

/// Longest line, bytes; a longer one is passed over.
const LINE_MAX: usize = 256 << 10;
/// Longest wait for bytes.
const WAIT: Duration = Duration::from_millis(100);
/// Longest wait for a daemon that takes no connection or no request.
const CONNECT_WAIT: Duration = Duration::from_secs(1);

/// What a line says. Members and types that are unknown are passed over.
#[derive(Debug, Deserialize)]
#[serde(tag = "type", rename_all = "lowercase")]
pub enum Line {
    State(State),
    Status(Status),
    Event(Event),
    Points(Points),
    Error {
        error: String,
    },
    #[serde(other)]
    Other,
}

/// A state in the frames of the daemon: odom, gravity-aligned with z up, and the axes of the inertial unit, the body's.
#[derive(Clone, Debug, Deserialize)]
pub struct State {
    /// CLOCK_MONOTONIC of the picture.
    pub t_ns: i64,
    /// The same instant as Unix time.
    pub wall_ns: i64,
    /// Counts resets.
    pub epoch: u32,
    /// 0 to 100 percent.
    pub quality: u8,
    pub source: String,
    /// m, in odom.
    pub position: [f64; 3],
    /// odom from body: x, y, z, w.
    pub orientation: [f64; 4],
    /// m/s, in the body's axes.
    pub velocity_body: [f64; 3],
    /// rad/s, in the body's axes.
    pub rate_body: [f64; 3],
    /// 6x6 by rows, of position and of rotation about the axes of odom, m² and rad².
    pub pose_covariance: Option<Vec<f64>>,
    /// 3x3 by rows, in the body's axes, m²/s².
    pub velocity_covariance: Option<Vec<f64>>,
}

impl State {
    /// Whether odometry has failed: nothing but inertia is left of it.
    pub fn has_failed(&self) -> bool {
        self.quality == 0 || self.source == "dead_reckoned"
    }
}

/// How the daemon is, once a second.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Status {
    pub version: String,
    pub board: String,
    pub uptime_s: f64,
    pub health: Vec<String>,
    pub counters: BTreeMap<String, Value>,
    pub map: Option<BTreeMap<String, Value>>,
    pub frames: u64,
    pub posed: u64,
    pub map_from_odom: Option<MapFromOdom>,
    pub governor: Option<BTreeMap<String, Value>>,
    pub power: Option<BTreeMap<String, Value>>,
}

/// Where `odom` is in the map, which loops have made agree: told once a place was recognised.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
pub struct MapFromOdom {
    /// m.
    pub position: [f64; 3],
    /// About z, rad.
    pub yaw: f64,
}

#[derive(Clone, Debug, Deserialize)]
pub struct Event {
    pub wall_ns: i64,
    pub id: String,
    pub level: String,
    pub text: String,
}

/// What goes before the bytes of points.
#[derive(Clone, Debug, Deserialize)]
pub struct Points {
    pub generation: u64,
    pub wall_ns: i64,
    pub epoch: u32,
    pub count: usize,
    /// Bytes of a point.
    pub stride: usize,
}

/// What one wait brought.
pub enum Heard<'a> {
    Line(&'a [u8]),
    TooLong,
    /// No whole line yet.
    Nothing,
}

/// A connection to the daemon.
pub struct Connection {
    reader: BufReader<UnixStream>,
    line: Vec<u8>,
    is_whole: bool,
    is_skipping: bool,
}

impl Connection {
    /// Connects and asks. Fails where there is no daemon, or one that takes no connection for `CONNECT_WAIT`.
    pub fn open(path: &Path, request: &str) -> io::Result<Connection> {
        let socket = Socket::new(Domain::UNIX, Type::STREAM, None)?;
        socket.set_write_timeout(Some(CONNECT_WAIT))?;
        socket.set_read_timeout(Some(WAIT))?;
        socket.connect(&SockAddr::unix(path)?)?;
        let mut stream = UnixStream::from(OwnedFd::from(socket));
        stream.write_all(format!("{request}\n").as_bytes())?;
        Ok(Connection { reader: BufReader::new(stream), line: vec![], is_whole: false, is_skipping: false })
    }

    /// Waits once, and answers a line if that made one whole. Fails where the connection has ended.
    pub fn next(&mut self) -> io::Result<Heard<'_>> {
        if std::mem::take(&mut self.is_whole) {
            self.line.clear();
        }
        let Some(chunk) = waited(&mut self.reader)? else { return Ok(Heard::Nothing) };
        let end = chunk.iter().position(|byte| *byte == b'\n');
        let used = end.map_or(chunk.len(), |end| end + 1);
        self.is_skipping |= self.line.len() + used > LINE_MAX;
        if self.is_skipping {
            self.line.clear();
        } else {
            self.line.extend_from_slice(&chunk[..used]);
        }
        self.reader.consume(used);
        if end.is_none() {
            return Ok(Heard::Nothing);
        }
        if std::mem::take(&mut self.is_skipping) {
            return Ok(Heard::TooLong);
        }
        self.is_whole = true;
        Ok(Heard::Line(&self.line))
    }

    /// Waits once for bytes after a line, and puts them behind `bytes`, of which there are to be `count`. Fails where the
    /// connection has ended.
    pub fn more(&mut self, bytes: &mut Vec<u8>, count: usize) -> io::Result<()> {
        if let Some(chunk) = waited(&mut self.reader)? {
            let used = chunk.len().min(count - bytes.len());
            bytes.extend_from_slice(&chunk[..used]);
            self.reader.consume(used);
        }
        Ok(())
    }
}

/// Bytes that are there, or `None` after `WAIT`.
fn waited(reader: &mut BufReader<UnixStream>) -> io::Result<Option<&[u8]>> {
    match reader.fill_buf() {
        Ok([]) => Err(io::Error::new(ErrorKind::UnexpectedEof, "the daemon closed the connection")),
        Ok(chunk) => Ok(Some(chunk)),
        Err(e) if [ErrorKind::WouldBlock, ErrorKind::TimedOut, ErrorKind::Interrupted].contains(&e.kind()) => Ok(None),
        Err(e) => Err(e),
    }
}
