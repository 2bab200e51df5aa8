//! What the status socket tells, as lines of JSON and as text for Prometheus.

use super::About;
use crate::publish::turned::Turned;
use crate::publish::{Event, Source, State};
use glam::DQuat;
use nalgebra::SMatrix;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt::Write;
use stipple_drivers::Nanos;

type Text = Cow<'static, str>;

/// Any line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Message {
    Status(Box<StatusMessage>),
    State(Box<StateMessage>),
    Event(EventMessage),
    /// `count` points of `stride` bytes follow.
    Points {
        generation: u64,
        t_ns: i64,
        wall_ns: i64,
        epoch: u32,
        count: usize,
        of: usize,
        stride: usize,
    },
    Error {
        error: String,
    },
}

/// The newest state. Its pose is that of the inertial unit in `odom`: z is up, it begins at the first pose, and within an epoch
/// it drifts and never jumps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StateMessage {
    /// Stamp of the picture by the monotonic clock, and the same instant since 1970, UTC.
    pub t_ns: i64,
    pub wall_ns: i64,
    pub epoch: u32,
    /// 0 to 100.
    pub quality: u8,
    pub source: Text,
    pub health: Vec<Text>,
    pub position: [f64; 3],
    /// odom from body, w last.
    pub orientation: [f64; 4],
    /// m/s and rad/s, body.
    pub velocity_body: [f64; 3],
    pub rate_body: [f64; 3],
    /// Row by row, of (position, rotation about the axes of `odom`), m and rad; `None` where it is not known.
    pub pose_covariance: Option<Vec<f64>>,
    /// Row by row, of the velocity in the body.
    pub velocity_covariance: Option<Vec<f64>>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EventMessage {
    pub t_ns: i64,
    pub wall_ns: i64,
    pub id: Text,
    pub level: Text,
    pub text: String,
}

/// How the map goes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MapStatus {
    pub keyframes: u64,
    pub anchors: u64,
    pub splats: u64,
    pub iterations: u64,
    /// PSNR of the last probe, in training.
    pub psnr_db: Option<f64>,
}

/// What share of its time the mapper may work, and why not all of it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct GovernorStatus {
    pub share: f64,
    pub reason: Option<Text>,
}

impl Default for GovernorStatus {
    fn default() -> GovernorStatus {
        GovernorStatus { share: 1.0, reason: None }
    }
}

/// The power that is measured on the board, and the energy since the start.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PowerStatus {
    pub watts: f64,
    pub joules: f64,
}

/// Where `odom` is in the map, in which loops agree. It changes when a place is recognised, and pose and velocity do not with
/// it: who wants poses in the map composes the two.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MapFromOdomMessage {
    /// Stamp of the picture by which the place was recognised.
    pub t_ns: i64,
    /// How often it has changed in this run.
    pub count: u32,
    /// Epoch of the `odom` that it is of.
    pub epoch: u32,
    pub position: [f64; 3],
    /// About z, rad.
    pub yaw: f64,
    /// Row by row, of the vehicle's position and yaw in the map at that stamp, m and rad.
    pub covariance: [[f64; 4]; 4],
}

/// How a run goes, told by its main thread once a second.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    pub frames: u64,
    /// Frames with a pose.
    pub posed: u64,
    pub map: MapStatus,
    pub governor: GovernorStatus,
    /// `None` where the board has no sensor of power that may be read.
    #[serde(default)]
    pub power: Option<PowerStatus>,
    /// `None` before a place was recognised.
    #[serde(default)]
    pub map_from_odom: Option<MapFromOdomMessage>,
    pub counters: BTreeMap<Text, u64>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StatusMessage {
    pub version: Text,
    pub board: String,
    pub dataset: String,
    /// When this was written.
    pub t_ns: i64,
    pub wall_ns: i64,
    pub uptime_s: f64,
    pub state: Option<StateMessage>,
    pub health: Vec<Text>,
    #[serde(flatten)]
    pub summary: Summary,
}

fn rows<const N: usize>(m: &SMatrix<f64, 6, 6>) -> Vec<f64> {
    (0..N * N).map(|i| m[(i / N, i % N)]).collect()
}

/// Clocks now: since 1970 less monotonic, ns.
#[derive(Clone, Copy)]
pub struct WallClock(pub i64);

impl WallClock {
    pub fn of(self, t: Nanos) -> i64 {
        t.0.saturating_add(self.0)
    }
}

impl StateMessage {
    /// `t` is the stamp by the monotonic clock. `None` where a number is not finite.
    pub fn new(state: &State, t: Nanos, wall: WallClock) -> Option<StateMessage> {
        let turned = Turned::new(state, DQuat::IDENTITY, DQuat::IDENTITY)?;
        Some(StateMessage {
            t_ns: t.0,
            wall_ns: wall.of(t),
            epoch: state.epoch,
            quality: state.quality,
            source: Text::Borrowed(match state.source {
                Source::Frame => "frame",
                Source::Carried => "carried",
                Source::DeadReckoned => "dead_reckoned",
            }),
            health: state.health.reasons().map(Text::Borrowed).collect(),
            position: turned.p.to_array(),
            orientation: turned.local_from_vehicle.to_array(),
            velocity_body: turned.v.to_array(),
            rate_body: turned.rate.to_array(),
            pose_covariance: turned.pose_covariance.as_ref().map(rows::<6>),
            velocity_covariance: turned.velocity_covariance.as_ref().map(rows::<3>),
        })
    }
}

impl EventMessage {
    pub fn new(event: &Event, wall: WallClock) -> EventMessage {
        EventMessage {
            t_ns: event.at.0,
            wall_ns: wall.of(event.at),
            id: event.id.name().into(),
            level: event.id.severity().name().into(),
            text: String::from_utf8_lossy(&event.text).into_owned(),
        }
    }
}

/// The text of Prometheus, format 0.0.4.
pub fn metrics(
    about: &About,
    uptime_s: f64,
    age_s: Option<f64>,
    state: Option<&StateMessage>,
    summary: &Summary,
) -> String {
    let mut text = String::new();
    let mut add = |name: &str, kind: &str, value: f64| {
        let _ = writeln!(text, "# TYPE stipple_{name} {kind}\nstipple_{name} {value}");
    };
    add("uptime_seconds", "gauge", uptime_s);
    add("frames_total", "counter", summary.frames as f64);
    add("frames_posed_total", "counter", summary.posed as f64);
    if let (Some(age_s), Some(state)) = (age_s, state) {
        add("state_age_seconds", "gauge", age_s);
        add("state_quality", "gauge", f64::from(state.quality));
        add("state_epoch", "gauge", f64::from(state.epoch));
        if let Some(c) = &state.pose_covariance {
            add("state_position_sigma_metres", "gauge", [0, 7, 14].map(|i| c[i]).iter().sum::<f64>().sqrt());
        }
        for reason in &state.health {
            add(&format!("health_{reason}"), "gauge", 1.0);
        }
    }
    let map = &summary.map;
    let counts = [("keyframes", map.keyframes), ("anchors", map.anchors), ("gaussians", map.splats)];
    counts.into_iter().for_each(|(name, n)| add(&format!("map_{name}"), "gauge", n as f64));
    add("map_iterations_total", "counter", map.iterations as f64);
    map.psnr_db.into_iter().for_each(|db| add("map_psnr_db", "gauge", db));
    add("mapper_share", "gauge", summary.governor.share);
    if let Some(power) = summary.power {
        add("power_watts", "gauge", power.watts);
        add("energy_joules_total", "counter", power.joules);
    }
    for (name, n) in &summary.counters {
        match name.ends_with("_most") {
            true => add(name, "gauge", *n as f64),
            false => add(&format!("{name}_total"), "counter", *n as f64),
        }
    }
    let quoted = |text: &str| text.replace('\\', r"\\").replace('"', r#"\""#).replace('\n', r"\n");
    let (version, board) = (about.version, quoted(&about.board));
    let _ = writeln!(
        text,
        "# TYPE stipple_build_info gauge\nstipple_build_info{{version=\"{version}\",board=\"{board}\"}} 1"
    );
    text
}
