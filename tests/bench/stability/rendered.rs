//! Light that changes: a rendered flight whose images are brightened, darkened, flattened or covered,
//! through tracker and estimator.

use super::{judge, Case, Limits, Record, Row, Verdict};
use crate::inputs::{self, Flight};
use std::sync::Arc;
use stipple::config::{FrontendConfig, VioConfig};
use stipple::frontend::{Frontend, Prediction};
use stipple::vio::{Health, Predictor, Vio};
use stipple_drivers::types::pose_at;
use stipple_drivers::{Fault, Frames, Span, TimedPose};

/// Length of the flight, s; its first is at rest.
const SECONDS: f64 = 7.0;
/// Frames from and to which light is bad.
const FROM: usize = 60;
const TO: usize = 110;
/// Truth is given at inertial samples.
const TRUTH_HOLE: Span = Span(20_000_000);

/// Gain on the grey levels of an image, and what is added.
type Light = (f32, f32);
const AS_IS: Light = (1.0, 0.0);

struct Shown {
    name: &'static str,
    /// Gain and offset by frame and camera.
    light: fn(usize, usize) -> Light,
    expect: Verdict,
    limits: Limits,
    health: Health,
}

fn bad(frame: usize) -> bool {
    (FROM..TO).contains(&frame)
}

fn cases() -> Vec<Shown> {
    use Verdict::Survived;
    let shown =
        |name, light| Shown { name, light, expect: Survived, limits: Limits::default(), health: Health::default() };
    vec![
        shown("images as they are", |_, _| AS_IS),
        shown("exposure steps: half, double", |i, _| match i {
            FROM..80 => (0.5, 0.0),
            80..TO => (2.0, 0.0),
            _ => AS_IS,
        }),
        shown("exposure steps in one camera", |i, camera| if bad(i) && camera == 1 { (0.4, 0.0) } else { AS_IS }),
        shown("flicker by 30 % from frame to frame", |i, _| {
            if bad(i) {
                ([1.3, 0.8, 1.0, 0.7, 1.15][i % 5], 0.0)
            } else {
                AS_IS
            }
        }),
        shown("flicker, cameras apart", |i, camera| {
            if bad(i) {
                ([1.2, 0.85, 1.0, 0.75, 1.1][(i + 2 * camera) % 5], 0.0)
            } else {
                AS_IS
            }
        }),
        shown("low contrast: an eighth", |i, _| if bad(i) { (0.125, 100.0) } else { AS_IS }),
        Shown {
            limits: Limits { after: 0.012, jump: 0.03, ..Limits::default() },
            health: Health::INERTIA_ALONE,
            ..shown("black for 1 s", |i, _| if (FROM..FROM + 20).contains(&i) { (0.0, 0.0) } else { AS_IS })
        },
        Shown {
            health: Health::ONE_CAMERA_BLIND,
            limits: Limits { jump: 0.012, ..Limits::default() },
            ..shown("right lens covered", |i, camera| if bad(i) && camera == 1 { (0.0, 0.0) } else { AS_IS })
        },
        Shown {
            limits: Limits { after: 0.01, jump: 0.1, ..Limits::default() },
            ..shown("left lens covered", |i, camera| if bad(i) && camera == 0 { (0.0, 0.0) } else { AS_IS })
        },
    ]
}

fn lit(from: &Frames, frame: usize, light: fn(usize, usize) -> Light, out: &mut Frames) {
    out.t = from.t;
    for (camera, (image, changed)) in from.images.iter().zip(&mut out.images).enumerate() {
        let (gain, offset) = light(frame, camera);
        for (a, b) in image.pixels.iter().zip(&mut changed.pixels) {
            *b = (f32::from(*a) * gain + offset).round().clamp(0.0, 255.0) as u8;
        }
    }
}

fn fly(flight: &Flight, light: fn(usize, usize) -> Light) -> Result<(Vec<Record>, Vio), Fault> {
    let mut frontend = Frontend::new(&flight.calibration, &FrontendConfig::default())?;
    let mut vio = Vio::new(&flight.calibration, &VioConfig::default());
    let mut predictor = Predictor::new(&flight.calibration, &VioConfig::default());
    let mut before = None;
    let mut frames = Arc::new(Frames::for_rig(&flight.calibration));
    let mut samples = flight.imu.iter();
    let mut records = Vec::new();
    for (i, original) in flight.frames.iter().enumerate() {
        lit(original, i, light, Arc::make_mut(&mut frames));
        for sample in samples.by_ref() {
            vio.on_imu(*sample);
            predictor.on_imu(*sample);
            if sample.t >= frames.t {
                break;
            }
        }
        let prediction = Prediction { prev_from_now: predictor.motion_to(frames.t, before.as_ref()) };
        before = vio.odometry();
        let update = vio.on_tracks(frontend.track(&frames, &prediction));
        let Some(truth) = pose_at(&flight.truth, frames.t, TRUTH_HOLE) else { continue };
        records.push(Record {
            frame: i,
            truth: TimedPose { t: frames.t, pose: truth },
            estimate: update.odometry.map(|o| TimedPose { t: o.t, pose: o.world_from_body }),
            health: update.health,
            quality: update.quality,
            resets: vio.stats().resets,
            position_sigmas: None,
            velocity_error: None,
        });
    }
    Ok((records, vio))
}

pub fn rows(only: &str) -> Result<Vec<Row>, Fault> {
    let cases: Vec<Shown> = cases().into_iter().filter(|shown| shown.name.contains(only)).collect();
    if cases.is_empty() {
        return Ok(vec![]);
    }
    let flight = inputs::quick()[0].load(SECONDS)?;
    let mut rows = Vec::new();
    for shown in cases {
        let (records, vio) = fly(&flight, shown.light)?;
        let Shown { name, expect, limits, health, .. } = shown;
        let to = if name.contains("black") { FROM + 20 } else { TO };
        let case = Case { name, plan: Default::default(), fault: Some((FROM, to)), expect, limits, health };
        rows.push(judge(&case, &records, &vio));
    }
    Ok(rows)
}
