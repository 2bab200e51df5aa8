//! How camera 0 turns, from the points it follows.

use super::agreement::Turn;
use super::motion::{motion, Views, POINTS_MIN};
use crate::config::FrontendConfig;
use crate::frontend::{Frontend, Prediction, Track};
use glam::DVec2;
use std::sync::Arc;
use stipple_drivers::{Calibration, Fault, Frames, Nanos, RigCamera};

/// A longer interval is not one of neighbouring frames, s.
const INTERVAL_MAX: f64 = 0.25;

/// Follows points and makes turns of them.
pub struct Turning {
    frontend: Frontend,
    calibration: Calibration,
    last: Option<Nanos>,
    /// Of the frame before: id, and where camera 0 and camera 1 saw it.
    points: Vec<(u64, DVec2, Option<DVec2>)>,
    pub turns: Vec<Turn>,
}

impl Turning {
    pub fn new(calibration: &Calibration, config: &FrontendConfig) -> Result<Turning, Fault> {
        let frontend = Frontend::new(calibration, config)?;
        Ok(Turning { frontend, calibration: calibration.clone(), last: None, points: vec![], turns: vec![] })
    }

    pub fn add(&mut self, frames: &Arc<Frames>) {
        let tracks = self.frontend.track(frames, &Prediction::default());
        let c = &self.calibration.cameras;
        let in_second = |id: u64| flat(c.get(1)?, find(&tracks.cameras[1], id)?);
        let now: Vec<(u64, DVec2, Option<DVec2>)> =
            tracks.cameras[0].iter().filter_map(|t| Some((t.id, flat(&c[0], t)?, in_second(t.id)))).collect();
        let before = |id: u64| self.points.binary_search_by_key(&id, |p| p.0).ok().map(|at| self.points[at]);
        let pairs: Vec<Views> = now
            .iter()
            .filter_map(|n| {
                let b = before(n.0)?;
                Some(Views { first: [b.1, n.1], second: [b.2, n.2] })
            })
            .collect();
        let follows = |last: &Nanos| (0.0..INTERVAL_MAX).contains(&(frames.t - *last).secs()) && frames.t > *last;
        if let Some(from) = self.last.filter(|last| follows(last) && pairs.len() >= POINTS_MIN) {
            let second_from_first = c.get(1).map(|second| second.body_from_cam.inverse() * c[0].body_from_cam);
            self.turns.extend(motion(&pairs, second_from_first.as_ref()).map(|(now_from_before, covariance)| Turn {
                from,
                to: frames.t,
                before_from_now: now_from_before.q.conjugate(),
                covariance,
            }));
        }
        self.last = Some(frames.t);
        self.points = now;
    }
}

fn find(tracks: &[Track], id: u64) -> Option<&Track> {
    tracks.binary_search_by_key(&id, |t| t.id).ok().map(|at| &tracks[at])
}

/// Where the ray of a track meets the plane at distance 1.
fn flat(camera: &RigCamera, track: &Track) -> Option<DVec2> {
    let ray = camera.camera.unproject(DVec2::new(f64::from(track.px[0]), f64::from(track.px[1])))?;
    (ray.z > 0.1).then(|| ray.truncate() / ray.z)
}
