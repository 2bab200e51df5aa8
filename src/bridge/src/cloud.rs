//! The map's Gaussians as a PointCloud2, asked for over a connection of its own, on a thread of its own: a megabyte of points
//! delays no state.

use crate::convert::time;
use crate::dds::Writer;
use crate::messages::{Header, PointCloud2, PointField, FLOAT32};
use crate::socket::{Connection, Heard, Line, Points};
use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::SyncSender;
use std::time::{Duration, Instant};

/// Most points of a cloud, and the bytes of one on the socket: x, y, z as f32, red, green, blue and opacity as u8.
const POINTS_MAX: usize = 65_536;
const STRIDE: usize = 16;
/// Bytes of a point in a message: x, y, z, rgb and opacity.
const STEP: u32 = 20;
/// Longest wait for a cloud, and the pause while there is none.
const ANSWER_MAX: Duration = Duration::from_secs(5);
const PAUSE: Duration = Duration::from_secs(1);

/// How the last cloud went: points published, or why there is none.
pub type Outcome = Result<usize, String>;

/// What the thread of the clouds needs.
pub struct Clouds {
    pub socket: PathBuf,
    pub frame_id: String,
    pub period: Duration,
    pub writer: Writer<PointCloud2>,
    pub outcomes: SyncSender<Outcome>,
}

impl Clouds {
    /// Publishes each new cloud until `stop`.
    pub fn run(self, stop: &AtomicBool) {
        let mut last = None;
        while !stop.load(Ordering::Relaxed) {
            let begun = Instant::now();
            let outcome = self.ask(stop).map_err(|e| e.to_string()).and_then(|(points, bytes)| {
                let this = (points.generation, points.epoch, points.wall_ns);
                match last {
                    _ if points.count == 0 => Ok(0),
                    // A map that did not change is not sent again: who comes late gets it from the writer.
                    Some((sent, count)) if sent == this => Ok(count),
                    _ => self.publish(&points, &bytes).inspect(|count| last = Some((this, *count))),
                }
            });
            let pause = if matches!(outcome, Ok(1..)) { self.period } else { PAUSE.min(self.period) };
            // The main thread reads them each 100 ms; one that is lost is followed by the next.
            let _ = self.outcomes.try_send(outcome);
            crate::sleep(pause.saturating_sub(begun.elapsed()), stop);
        }
    }

    fn publish(&self, points: &Points, bytes: &[u8]) -> Outcome {
        let cloud = cloud(points, bytes, &self.frame_id).ok_or("no point of the cloud is finite")?;
        let count = cloud.width as usize;
        if self.writer.write(cloud) {
            Ok(count)
        } else {
            Err("a reader does not take clouds in time".into())
        }
    }

    /// The points that the daemon has. Fails where it is not there, or does not answer in time.
    fn ask(&self, stop: &AtomicBool) -> io::Result<(Points, Vec<u8>)> {
        let refused = |why: &str| io::Error::new(io::ErrorKind::InvalidData, why);
        let mut connection = Connection::open(&self.socket, r#"{"get":"points"}"#)?;
        let begun = Instant::now();
        let is_late = || begun.elapsed() > ANSWER_MAX || stop.load(Ordering::Relaxed);
        let points = loop {
            match connection.next()? {
                Heard::Line(line) => match serde_json::from_slice(line) {
                    Ok(Line::Points(points)) => break points,
                    Ok(Line::Error { error }) => return Err(refused(&error)),
                    _ => return Err(refused("the answer is no points")),
                },
                Heard::TooLong => return Err(refused("the answer is no points")),
                Heard::Nothing if is_late() => return Err(io::ErrorKind::TimedOut.into()),
                Heard::Nothing => {}
            }
        };
        if points.count > POINTS_MAX || points.stride != STRIDE {
            return Err(refused("there are more points, or longer ones, than the bridge knows"));
        }
        let count = points.count * STRIDE;
        let mut bytes = Vec::with_capacity(count);
        while bytes.len() < count {
            connection.more(&mut bytes, count)?;
            if is_late() {
                return Err(io::ErrorKind::TimedOut.into());
            }
        }
        Ok((points, bytes))
    }
}

/// The points as a message, without those that are not finite; `None` where none is left.
pub fn cloud(points: &Points, bytes: &[u8], frame_id: &str) -> Option<PointCloud2> {
    let mut data = Vec::with_capacity(points.count * STEP as usize);
    for point in bytes.chunks_exact(STRIDE) {
        let is_finite = |at: &[u8]| at.try_into().is_ok_and(|number: [u8; 4]| f32::from_le_bytes(number).is_finite());
        if !point[..12].chunks_exact(4).all(is_finite) {
            continue;
        }
        let [red, green, blue, opacity] = [point[12], point[13], point[14], point[15]];
        data.extend_from_slice(&point[..12]);
        // ROS has 0x00RRGGBB in the bits of a float.
        data.extend_from_slice(&[blue, green, red, 0]);
        data.extend_from_slice(&(f32::from(opacity) / 255.0).to_le_bytes());
    }
    let width = u32::try_from(data.len()).ok()? / STEP;
    let fields = ["x", "y", "z", "rgb", "opacity"].into_iter().zip((0..).step_by(4));
    let message = PointCloud2 {
        header: Header { stamp: time(points.wall_ns)?, frame_id: frame_id.into() },
        height: 1,
        width,
        fields: fields.map(|(name, offset)| PointField { name, offset, datatype: FLOAT32, count: 1 }).collect(),
        is_bigendian: false,
        point_step: STEP,
        row_step: width * STEP,
        data,
        is_dense: true,
    };
    (width > 0).then_some(message)
}
