//! What camera 0 and the inertial unit say of each other: the offset of their clocks, the attitude of the camera in the
//! body and the gyro's bias, with deviations.
//!
//! The odometry estimator finds them, as it does in flight where a board asks for it. It takes a rig to be nearly as
//! calibrated, so the coarse relation (`coarse.rs`) is taken out of stamps and samples first.

use super::coarse::{coarse, rotation, Coarse, Point, Turn};
use crate::config::{FrontendConfig, VioConfig};
use crate::frontend::{Frontend, Prediction, Track, Tracks};
use crate::math::so3::{exp, log};
use crate::vio::Vio;
use glam::{DMat3, DVec2, DVec3};
use std::sync::Arc;
use stipple_drivers::{Calibration, Fault, Frames, ImuSample, RigCamera, Span};

/// Longest interval between neighbouring frames, s.
const INTERVAL_MAX: f64 = 0.25;
/// Noise as sensors of a rig have it that does not vibrate, px and factors on the calibration's: flight is more careful.
/// Errors on simulated flights are as large as the deviations that result.
const POINT_SIGMA_PX: f64 = 0.25;
const GYRO_NOISE: f64 = 1.0;
const ACCEL_NOISE: f64 = 2.0;
/// Deviations before the estimate: s, m, rad.
const TIME_SIGMA: f64 = 0.01;
const PLACE_SIGMA: f64 = 0.01;
const ATTITUDE_SIGMA: f64 = 0.05;

/// Follows points, for the estimate at the end and for the rates of camera 0.
pub struct Follower {
    frontend: Frontend,
    calibration: Calibration,
    tracks: Vec<Tracks>,
    turns: Vec<Turn>,
}

/// What camera and inertial unit say of each other.
#[derive(Clone, Debug)]
pub struct Agreement {
    pub frames: usize,
    pub coarse: Coarse,
    /// `None` where the odometry estimator does not start, or gave up.
    pub fine: Option<Fine>,
}

/// What the odometry estimator found.
#[derive(Clone, Copy, Debug)]
pub struct Fine {
    /// Clock of the gyro ahead of the camera's, beyond what the calibration says, and its deviation, s.
    pub offset_s: f64,
    pub offset_sigma_s: f64,
    /// Rotation from where the calibration has camera 0 to where it is, about its axes, and deviations, rad.
    pub turned: DVec3,
    pub turned_sigma: DVec3,
    /// Bias of the gyro, body frame, and its deviations, rad/s.
    pub bias: DVec3,
    pub bias_sigma: DVec3,
}

impl Follower {
    pub fn new(calibration: &Calibration, config: &FrontendConfig) -> Result<Follower, Fault> {
        let frontend = Frontend::new(calibration, config)?;
        Ok(Follower { frontend, calibration: calibration.clone(), tracks: vec![], turns: vec![] })
    }

    /// Follows points into the next frame. Nothing predicts where they are: the gyro is what is to be judged.
    pub fn add(&mut self, frames: &Arc<Frames>) {
        let now = self.frontend.track(frames, &Prediction::default());
        if let Some(before) = self.tracks.last() {
            let cameras = &self.calibration.cameras;
            let second_from_first = cameras.get(1).map(|c| c.body_from_cam.inverse() * cameras[0].body_from_cam);
            let point = |n: &Track| {
                let second = now.find(1, n.id).and_then(|s| cameras.get(1)?.camera.unproject(s.px()));
                let (before, now) = (flat(&cameras[0], before.find(0, n.id)?)?, flat(&cameras[0], n)?);
                Some(Point::new(before, now, second, second_from_first))
            };
            let points: Vec<Point> = now.cameras[0].iter().filter_map(point).collect();
            let secs = (now.t - before.t).secs();
            if secs > 0.0 && secs < INTERVAL_MAX {
                let turn = |phi| Turn { from: before.t, to: now.t, rate: phi / secs };
                self.turns.extend(rotation(&points).map(turn));
            }
        }
        self.tracks.push(now.clone());
    }

    /// Relation of the frames so far to these samples; `None` of too few frames with points.
    pub fn agreement(&self, imu: &[ImuSample], config: &VioConfig) -> Option<Agreement> {
        let coarse = coarse(&self.turns, imu, self.calibration.cameras[0].body_from_cam.q)?;
        Some(Agreement { frames: self.tracks.len(), coarse, fine: self.fine(&coarse, imu, config) })
    }

    fn fine(&self, coarse: &Coarse, imu: &[ImuSample], config: &VioConfig) -> Option<Fine> {
        let config = VioConfig {
            estimate_time_offset: true,
            estimate_extrinsics: true,
            time_offset_sigma_s: TIME_SIGMA,
            extrinsics_sigma_m: PLACE_SIGMA,
            extrinsics_sigma_rad: ATTITUDE_SIGMA,
            observation_sigma_px: POINT_SIGMA_PX,
            gyro_noise_scale: GYRO_NOISE,
            accel_noise_scale: ACCEL_NOISE,
            ..config.clone()
        };
        let body_from_reading = DMat3::from_quat(coarse.rotation) * coarse.axes;
        let mut vio = Vio::new(&self.calibration, &config);
        let mut samples = imu.iter().map(|s| ImuSample {
            gyro_body: body_from_reading * s.gyro_body,
            accel_body: body_from_reading * s.accel_body,
            ..*s
        });
        for tracks in &self.tracks {
            let t = tracks.t + Span::from_secs(coarse.offset_s);
            for s in samples.by_ref() {
                vio.on_imu(s);
                if s.t >= t {
                    break;
                }
            }
            vio.on_tracks(&Tracks { t, ..tracks.clone() });
        }
        if vio.stats().resets > 0 {
            return None;
        }
        let (odometry, covariance, rig) = (vio.odometry()?, vio.covariance()?, vio.rig()?);
        let ([offset, offset_sigma_s], [e, sigma]) = (rig.time_offsets[0]?, rig.extrinsics[0]?);
        let cam = self.calibration.cameras[0].body_from_cam.q;
        let turned = cam.conjugate() * coarse.rotation.conjugate() * cam * exp(DVec3::new(e[3], e[4], e[5]));
        Some(Fine {
            offset_s: coarse.offset_s + offset,
            offset_sigma_s,
            turned: log(turned),
            turned_sigma: DVec3::new(sigma[3], sigma[4], sigma[5]),
            bias: odometry.gyro_bias,
            bias_sigma: DVec3::new(covariance[9][9], covariance[10][10], covariance[11][11]).map(f64::sqrt),
        })
    }
}

/// Where the ray of a track meets the plane at distance 1.
fn flat(camera: &RigCamera, track: &Track) -> Option<DVec2> {
    let ray = camera.camera.unproject(track.px())?;
    (ray.z > 0.1).then(|| ray.truncate() / ray.z)
}
