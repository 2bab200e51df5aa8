//! What to simulate: a rig, a path and a seed. The same scenario gives the same bytes.
//!
//! Named scenarios fly in a room of 8 x 6 x 3.5 m, patrols in a building (`patrol`), and begin with a second at rest. A recorded scenario takes its path (and,
//! if given, its inertial samples) from csv files in EuRoC's format.

use super::imu::{Bias, ImuErrors};
use super::patrol::{Extent, Plan, RoomBox, Route};
use super::recording;
use super::render::Sensor;
use super::way::{look, smooth, under_way, REST};
use crate::calibration::{Calibration, ImuCalibration, ImuCorrection, RigCamera};
use crate::camera::{Camera, Lens};
use crate::fault::Fault;
use crate::types::{ImuSample, Pose, Span, TimedPose};
use glam::{DMat3, DQuat, DVec3};
use std::f64::consts::TAU;
use std::path::Path;

/// A flight to simulate.
#[derive(Clone, Debug)]
pub struct Scenario {
    /// Name in messages.
    pub name: String,
    /// Seed of all that is random: furniture, patterns, noise.
    pub seed: u64,
    /// Length of the run; a recorded path may end sooner.
    pub duration: Span,
    /// Part of it that is left out at its beginning: the first frame is taken then.
    pub begin: Span,
    /// Frames per second.
    pub rate_hz: f64,
    /// The rig at full resolution.
    pub calibration: Calibration,
    /// Images are made this many times smaller on each side.
    pub image_divisor: usize,
    /// Noise and vignette of the sensors.
    pub sensor: Sensor,
    /// Changes of the exposure.
    pub light: Light,
    /// A patrol has the light of the second round in the first, and the other way around.
    pub other_light: bool,
    /// Errors of the cameras beyond the calibration.
    pub camera_errors: CameraErrors,
    /// Errors of the inertial unit beyond the calibration.
    pub imu_errors: ImuErrors,
    /// Path of the body.
    pub path: Flight,
    /// Whether a person moves through the room.
    pub person: bool,
}

/// Errors of the cameras that the calibration does not state. A rolling shutter is not one of them: it is the `readout` of
/// the calibration's cameras, middle rows at the stamp.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CameraErrors {
    /// The inertial unit's clock less the stamps of images.
    pub time_offset: Span,
    /// Camera k takes its images so much after the instant of the frame, whose stamp does not tell; beyond the list, at it.
    pub late: Vec<Span>,
    /// Camera k truly stands at `body_from_cam * extrinsics[k]`; beyond the list, where the calibration says.
    pub extrinsics: Vec<Pose>,
}

/// Deviations of the exposure from that of a smooth meter.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Light {
    /// Steps, each with its instant of the run, the factor of the exposure from then on, and grey levels added.
    pub steps: Vec<(Span, f64, f64)>,
    /// Flicker of the lamps: the fraction of the light that comes and goes.
    pub flicker: f64,
    pub flicker_hz: f64,
}

impl Light {
    /// The factor, and the grey levels added, `t` after the start.
    pub fn at(&self, t: Span) -> (f64, f64) {
        let (gain, offset) = self.steps.iter().rev().find(|s| s.0 <= t).map_or((1.0, 0.0), |s| (s.1, s.2));
        (gain * (1.0 + self.flicker * (TAU * self.flicker_hz * t.secs()).sin()), offset)
    }
}

/// The path of the body.
#[derive(Clone, Debug)]
pub enum Flight {
    /// At rest.
    Static,
    /// Holding its place as a small multicopter does: 0.2 m, 5°.
    Hover,
    /// Around the room, looking across it.
    Circle,
    /// Around the room at about 1 m/s, looking at walls and furniture.
    Demo,
    /// Up to 4 m/s, 8 m/s² and 3 rad/s.
    Aggressive,
    /// Flies as `Demo`, lands and rests, takes off and hovers, flies on; `rest` and `hover` in s, the flights are `PAUSE_FLIGHT`.
    Pauses {
        rest: f64,
        hover: f64,
    },
    /// Through a building in two rounds.
    Patrol(Extent),
    Recorded(Recording),
}

/// A recorded flight.
#[derive(Clone, Debug)]
pub struct Recording {
    /// `world_from_body`, z up.
    pub poses: Vec<TimedPose>,
    /// True biases; empty where the file does not state them.
    pub biases: Vec<Bias>,
    /// Real inertial samples; simulated ones when `None`.
    pub imu: Option<Vec<ImuSample>>,
}

const NAMED: [(&str, Flight, f64); 10] = [
    ("demo", Flight::Demo, 10.0),
    ("hover", Flight::Hover, 10.0),
    ("circle", Flight::Circle, 12.0),
    ("aggressive", Flight::Aggressive, 12.0),
    ("static", Flight::Static, 5.0),
    ("pauses", Flight::Pauses { rest: 60.0, hover: 20.0 }, 100.0),
    ("patrol-two", Flight::Patrol(Extent::Two), 85.0),
    ("patrol", Flight::Patrol(Extent::Whole), 600.0),
    ("twins", Flight::Patrol(Extent::Twins), 112.0),
    ("doors", Flight::Patrol(Extent::Doors), 84.0),
];

/// Frames a second of a patrol: at its speed the view moves by as much between two as elsewhere.
const PATROL_HZ: f64 = 10.0;
/// `Pauses`: length of each of its two flights, s; of landing, of taking off and of coming to hover, s; height of the landed
/// body, m; share of `Hover`'s motion that is left.
pub const PAUSE_FLIGHT: f64 = 10.0;
const PAUSE_LAND: f64 = 2.5;
const PAUSE_HEIGHT: f64 = 0.6;
const PAUSE_WOBBLE: f64 = 0.25;

impl Scenario {
    /// The names of scenarios.
    pub fn names() -> impl Iterator<Item = &'static str> {
        NAMED.iter().map(|n| n.0)
    }

    /// The scenario of a name.
    pub fn named(name: &str) -> Option<Scenario> {
        let (name, flight, secs) = NAMED.iter().find(|n| n.0 == name)?;
        let mut scenario = Scenario::flying(name, flight.clone(), *secs);
        if matches!(flight, Flight::Demo | Flight::Pauses { .. } | Flight::Patrol(_)) {
            // Maps in minutes on a software rasteriser; a flight of minutes.
            scenario.image_divisor = 2;
        }
        if matches!(flight, Flight::Patrol(_)) {
            scenario.rate_hz = PATROL_HZ;
        }
        Some(scenario)
    }

    /// The rooms of a patrol, and the parts of its corridors; none of another flight.
    pub fn rooms(&self) -> &'static [RoomBox] {
        self.path.plan().map_or(&[], |plan| plan.rooms)
    }

    /// The index of the room in which a point of the world is.
    pub fn room_at(&self, p: DVec3) -> Option<usize> {
        self.rooms().iter().position(|r| r.contains(p))
    }

    /// When the second round of a patrol begins, from the start.
    pub fn second_round(&self) -> Option<Span> {
        self.path.plan().map(|plan| Route::new(plan).second_round())
    }

    /// The flight of a EuRoC `state_groundtruth_estimate0` csv, with the inertial samples of `imu` (EuRoC `imu0` csv) or,
    /// without it, simulated along the smoothed path. A fault where a file cannot be read.
    pub fn from_euroc(truth: &Path, imu: Option<&Path>) -> Result<Scenario, Fault> {
        let recording = recording::read(truth, imu)?;
        let span = |p: &[TimedPose]| p.last().map_or(0.0, |l| (l.t - p[0].t).secs());
        let secs = span(&recording.poses);
        Ok(Scenario::flying("euroc", Flight::Recorded(recording), secs))
    }

    fn flying(name: &str, path: Flight, secs: f64) -> Scenario {
        Scenario {
            name: name.to_string(),
            seed: 1,
            duration: Span::from_secs(secs),
            begin: Span(0),
            other_light: false,
            rate_hz: 20.0,
            calibration: euroc_rig(),
            image_divisor: 1,
            sensor: Sensor { read_noise: 1.2, shot_noise: 0.025, vignette: 0.35 },
            light: Light::default(),
            camera_errors: CameraErrors::default(),
            imu_errors: ImuErrors::EUROC,
            path,
            person: false,
        }
    }

    /// The rig whose images are made: `calibration` at the resolution of `image_divisor`.
    pub fn rig(&self) -> Calibration {
        let mut rig = self.calibration.clone();
        let d = self.image_divisor.max(1);
        for c in &mut rig.cameras {
            c.camera = shrunk(&c.camera, d);
        }
        rig
    }
}

fn shrunk(c: &Camera, divisor: usize) -> Camera {
    let s = divisor as f64;
    // Pixel centres are integers, so the corner of the image is at -0.5.
    Camera {
        width: c.width / divisor,
        height: c.height / divisor,
        fx: c.fx / s,
        fy: c.fy / s,
        cx: (c.cx + 0.5) / s - 0.5,
        cy: (c.cy + 0.5) / s - 0.5,
        lens: c.lens,
    }
}

/// Names of rigs made of EuRoC's cameras and inertial unit: one camera, two that look the same way, two that look opposite
/// ways and share nothing, and four (two ahead, one to each side).
pub const RIGS: [&str; 4] = ["mono", "stereo", "opposed", "four"];

/// The rig of a name.
pub fn rig_named(name: &str) -> Option<Calibration> {
    let mut rig = euroc_rig();
    let turned = |c: &RigCamera, yaw: f64, p: DVec3| RigCamera {
        body_from_cam: Pose::new(c.body_from_cam.q * DQuat::from_rotation_y(yaw), c.body_from_cam.p + p),
        ..*c
    };
    let [left, right] = [rig.cameras[0], rig.cameras[1]];
    match name {
        "mono" => rig.cameras.truncate(1),
        "stereo" => {}
        "opposed" => rig.cameras[1] = turned(&right, TAU / 2.0, DVec3::ZERO),
        // 70°: two cameras share a few degrees, as on headsets.
        "four" => rig.cameras.extend([
            turned(&left, -1.222, DVec3::new(0.0, 0.0, -0.02)),
            turned(&right, 1.222, DVec3::new(0.0, 0.0, -0.02)),
        ]),
        _ => return None,
    }
    Some(rig)
}

/// The VI-sensor of EuRoC (Burri et al., IJRR 2016): 752x480, 0.11 m baseline.
pub fn euroc_rig() -> Calibration {
    let camera = |f: [f64; 4], k1, k2, p1, p2| Camera {
        width: 752,
        height: 480,
        fx: f[0],
        fy: f[1],
        cx: f[2],
        cy: f[3],
        lens: Lens::Radtan { k1, k2, p1, p2 },
    };
    let rows =
        |x: [f64; 3], y: [f64; 3], z: [f64; 3]| DQuat::from_mat3(&DMat3::from_cols_array_2d(&[x, y, z]).transpose());
    let q0 = rows(
        [0.0148655429818, -0.999880929698, 0.00414029679422],
        [0.999557249008, 0.0149672133247, 0.025715529948],
        [-0.0257744366974, 0.00375618835797, 0.999660727178],
    );
    let q1 = rows(
        [0.0125552670891, -0.999755099723, 0.0182237714554],
        [0.999598781151, 0.0130119051815, 0.0251588363115],
        [-0.0253898008918, 0.0179005838253, 0.999517347078],
    );
    let p0 = DVec3::new(-0.0216401454975, -0.064676986768, 0.00981073058949);
    let p1 = DVec3::new(-0.0198435579556, 0.0453689425024, 0.00786212447038);
    let cam0 = camera([458.654, 457.296, 367.215, 248.375], -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05);
    let cam1 = camera([457.587, 456.134, 379.999, 255.238], -0.28368365, 0.07451284, -0.00010473, -3.555907e-05);
    Calibration {
        cameras: vec![RigCamera::new(cam0, Pose::new(q0, p0)), RigCamera::new(cam1, Pose::new(q1, p1))],
        imu: ImuCalibration {
            rate_hz: 200.0,
            gyro_noise: 1.6968e-4,
            gyro_walk: 1.9393e-5,
            accel_noise: 2.0e-3,
            accel_walk: 3.0e-3,
            range: ImuCalibration::RANGE,
            measured: false,
            correction: ImuCorrection::NONE,
        },
    }
}

impl Flight {
    /// Whether motors shake the unit `t` seconds from the start; only `Pauses` has any, on while it hovers.
    pub fn motors(&self, t: f64) -> bool {
        let Flight::Pauses { rest, hover } = self else { return false };
        (PAUSE_FLIGHT + rest..PAUSE_FLIGHT + rest + hover).contains(&t)
    }

    pub(super) fn plan(&self) -> Option<&'static Plan> {
        if let Flight::Patrol(extent) = self {
            Some(extent.plan())
        } else {
            None
        }
    }

    /// `world_from_cam0` of a flight in one room, `t` seconds from its start. The room is centred on the origin with its floor
    /// at z = 0. `None` for a recording and a patrol.
    pub fn look(&self, t: f64) -> Option<Pose> {
        let s = way(t);
        Some(match self {
            Flight::Recorded(_) | Flight::Patrol(_) => return None,
            Flight::Static => look(DVec3::new(0.3, -0.4, 1.4), 0.9, -0.1, 0.0),
            Flight::Hover => {
                let (p, turn) = wobble(s);
                look(DVec3::new(0.3, -0.4, 1.4) + p, 0.9 + turn.x, -0.1 + turn.y, turn.z)
            }
            Flight::Circle => {
                let a = 0.7 * s;
                let p = DVec3::new(1.7 * a.cos(), 1.1 * a.sin(), 1.5 + 0.25 * (2.0 * a).sin());
                look(p, a + TAU / 2.0 + 0.25 * (1.5 * a).sin(), -0.12 + 0.08 * (3.0 * a).sin(), 0.05 * (2.0 * a).sin())
            }
            Flight::Demo => {
                let (p, [yaw, pitch, roll]) = round(s);
                look(p, yaw, pitch, roll)
            }
            Flight::Pauses { rest, hover } => {
                let (stop, up, go) = (PAUSE_FLIGHT - PAUSE_LAND, PAUSE_FLIGHT + rest, PAUSE_FLIGHT + rest + hover);
                let (mut p, [yaw, pitch, roll]) = round(s - under_way(t - stop) + under_way(t - go));
                let over = |at: f64| smooth((t - at) / PAUSE_LAND);
                p.z += (over(stop) - over(up)) * (PAUSE_HEIGHT - p.z);
                let (dp, turn) = wobble(t - up);
                let share = PAUSE_WOBBLE * (over(up) - over(go - PAUSE_LAND));
                look(p + dp * share, yaw + turn.x * share, pitch + turn.y * share, roll + turn.z * share)
            }
            Flight::Aggressive => {
                let a = 1.05 * s;
                let p = DVec3::new(2.1 * a.sin(), 1.3 * (2.0 * a).sin(), 1.6 + 0.45 * (3.0 * a).sin());
                look(p, 0.8 * a + 1.2 * (1.3 * a).sin(), 0.35 * (2.1 * a).sin(), 0.5 * (1.7 * a).sin())
            }
        })
    }
}

/// Seconds under way at `t`: none at rest, then smoothly more, then as time passes.
fn way(t: f64) -> f64 {
    under_way(t - REST)
}

/// Displacement, m, and turn (yaw, pitch, roll) of a multicopter that holds its place.
fn wobble(s: f64) -> (DVec3, DVec3) {
    let w = |f: f64| (TAU * f * s).sin();
    (
        DVec3::new(0.2 * w(0.21), 0.15 * w(0.33), 0.12 * w(0.27)),
        DVec3::new(0.09 * w(0.37), 0.07 * w(0.43), 0.06 * w(0.51)),
    )
}

/// Position, yaw, pitch and roll on a path around the room, once in ten seconds.
fn round(s: f64) -> (DVec3, [f64; 3]) {
    let a = 0.766 * s;
    let p = DVec3::new(1.6 * a.cos(), 1.05 * a.sin(), 1.35 + 0.3 * (2.0 * a).sin());
    (p, [a + 0.35 * (2.0 * a).sin(), -0.12 + 0.14 * (3.0 * a).sin(), 0.08 * (2.5 * a).sin()])
}
