//! The tracking side of a run: inertial samples and frames in, poses and keyframes out.
//!
//! With `--poses` the poses come from a table, odometry is skipped, and every frame is a keyframe.

use crate::config::Board;
use crate::counters::Counters;
use crate::frontend::{Frontend, Prediction};
use crate::vio::{Odometry, Vio};
use std::time::Instant;
use stipple_drivers::types::pose_at;
use stipple_drivers::{Calibration, Fault, Frames, ImuSample, Nanos, Pose, Span, TimedPose};

/// A hole in a table of poses over which none is interpolated.
const POSE_HOLE: Span = Span(100_000_000);

/// What one frame gave.
pub struct Tracked {
    pub world_from_body: Pose,
    pub keyframe: bool,
}

pub enum Tracking {
    Odometry(Box<OdometryRun>),
    Table(Vec<TimedPose>),
}

pub struct OdometryRun {
    frontend: Frontend,
    vio: Vio,
    /// One entry a frame, room for all of them bought at the start.
    pub trajectory: Vec<Odometry>,
    pub frame_ms: Vec<(Nanos, f64)>,
}

impl OdometryRun {
    pub fn new(calibration: &Calibration, board: &Board, frames: usize) -> Result<OdometryRun, Fault> {
        Ok(OdometryRun {
            frontend: Frontend::new(calibration, &board.frontend)?,
            vio: Vio::new(calibration, &board.vio),
            trajectory: Vec::with_capacity(frames),
            frame_ms: Vec::with_capacity(frames),
        })
    }

    fn frame(&mut self, frames: &Frames) -> Option<Tracked> {
        let start = Instant::now();
        let prediction = Prediction { prev_from_now: self.vio.predict_motion(frames.t) };
        let tracks = self.frontend.track(frames, &prediction);
        let update = self.vio.on_tracks(tracks);
        if self.frame_ms.len() < self.frame_ms.capacity() {
            self.frame_ms.push((frames.t, start.elapsed().as_secs_f64() * 1e3));
        }
        let odometry = update.odometry?;
        if self.trajectory.len() < self.trajectory.capacity() {
            self.trajectory.push(odometry);
        }
        Some(Tracked { world_from_body: odometry.world_from_body, keyframe: update.keyframe })
    }
}

impl Tracking {
    pub fn imu(&mut self, sample: ImuSample) {
        if let Tracking::Odometry(run) = self {
            run.vio.on_imu(sample);
        }
    }

    pub fn frame(&mut self, frames: &Frames, counters: &Counters) -> Option<Tracked> {
        match self {
            Tracking::Odometry(run) => run.frame(frames),
            Tracking::Table(poses) => {
                let pose = pose_at(poses, frames.t, POSE_HOLE);
                if pose.is_none() {
                    counters.frames_without_pose.add(1);
                }
                pose.map(|world_from_body| Tracked { world_from_body, keyframe: true })
            }
        }
    }

    /// Newest poses of the keyframes still being optimised.
    pub fn corrections(&self, mut each: impl FnMut(Nanos, Pose)) {
        if let Tracking::Odometry(run) = self {
            for (t, pose, keyframe) in run.vio.window() {
                if keyframe {
                    each(t, pose);
                }
            }
        }
    }

    pub fn hash(&self) -> Option<u64> {
        match self {
            Tracking::Odometry(run) => Some(run.vio.hash()),
            Tracking::Table(_) => None,
        }
    }

    pub fn counters(&self) -> Vec<(&'static str, u64)> {
        match self {
            Tracking::Odometry(run) => {
                let f = run.frontend.stats();
                let mut list = vec![
                    ("tracks_created", f.created),
                    ("tracks_lost", f.lost),
                    ("tracks_matched", f.matched),
                    ("tracks_epipolar_rejected", f.epipolar_rejected),
                    ("tracks_full", f.full),
                ];
                let v = run.vio.stats();
                // The first frames of a run that starts in motion, and those after a reset.
                let without = run.frame_ms.len().saturating_sub(run.trajectory.len());
                list.extend([
                    ("frames_without_odometry", without as u64),
                    ("imu_rejected", v.imu_rejected),
                    ("imu_overflow", v.imu_overflow),
                    ("frames_rejected", v.frames_rejected),
                    ("landmarks_full", v.landmarks_full),
                    ("outliers", v.outliers),
                    ("solver_failures", v.solver_failures),
                    ("resets", v.resets),
                    ("divergences", v.divergences),
                    ("imu_gaps", v.imu_gaps),
                    ("imu_saturated", v.imu_saturated),
                    ("camera_blind", v.camera_blind),
                    ("zero_velocity_updates", v.zero_velocity_updates),
                ]);
                list
            }
            Tracking::Table(_) => vec![],
        }
    }
}
