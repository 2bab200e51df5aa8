//! The tracking side of a run: a stereo frame with its inertial samples in, pose and keyframe out.
//!
//! Two halves, on one thread in turns or on a thread each: the front end follows points, the back
//! end estimates. All that passes between them travels in a `Slot`, besides the `Predictor` that the
//! back end gives back. The front end predicts frame k from the state after frame k-2 even where that
//! after k-1 is known, so the poses are the same bit for bit on one thread and on two.
//!
//! With `--poses` the poses come from a table, odometry is skipped, and every frame is a keyframe.

use crate::config::Board;
use crate::counters::Counters;
use crate::frontend::{Frontend, Prediction, Tracks};
use crate::limits::IMU_BETWEEN_FRAMES;
use crate::mem::List;
use crate::vio::health::Health;
use crate::vio::predict::Predictor;
use crate::vio::rig::RigEstimate;
use crate::vio::samples::ImuRing;
use crate::vio::window::FRAMES;
use crate::vio::{Odometry, Tally, Vio};
use std::sync::Arc;
use std::time::Instant;
use stipple_drivers::types::pose_at;
use stipple_drivers::{Calibration, Fault, Frames, ImuSample, Nanos, Pose, Span, TimedPose};

/// A hole in a table of poses over which none is interpolated.
const POSE_HOLE: Span = Span(100_000_000);

/// What one frame gave.
pub struct Tracked {
    pub world_from_body: Pose,
    pub keyframe: bool,
    /// Beside a keyframe: newest poses of all keyframes still being optimised.
    pub corrections: List<(Nanos, Pose), FRAMES>,
}

/// What travels through tracking and back: a frame, the samples since the one before it, and what
/// was made of them.
pub struct Slot {
    /// Shared with the front end until it has tracked the frame after this.
    pub frames: Arc<Frames>,
    /// Only samples are in it: no frame came for so long that they would not fit before the next.
    pub frameless: bool,
    /// A camera saw nothing, as far as anybody looked: nothing to train a map on.
    pub blank: bool,
    pub imu: List<ImuSample, IMU_BETWEEN_FRAMES>,
    pub tracks: Tracks,
    pub tracked: Option<Tracked>,
    /// When the front end took it.
    begun: Instant,
}

impl Slot {
    /// The first `colours` cameras in colour.
    pub fn for_rig(calibration: &Calibration, colours: usize) -> Box<Slot> {
        Box::new(Slot {
            frames: Arc::new(Frames::in_colour(calibration, colours)),
            frameless: false,
            blank: false,
            imu: List::default(),
            tracks: Tracks::default(),
            tracked: None,
            begun: Instant::now(),
        })
    }

    /// To write the next frame into; `None` while the front end still looks at this one.
    pub fn writable(&mut self) -> Option<&mut Frames> {
        Arc::get_mut(&mut self.frames)
    }

    /// Without its images.
    pub const BYTES: usize = size_of::<Slot>();

    /// Of more samples than fit the newest are kept, as in the estimator's ring.
    pub fn push_imu(&mut self, sample: ImuSample, counters: &Counters) {
        if self.imu.push(sample).is_err() {
            counters.imu_overflow.add(1);
            self.imu.rotate_left(1);
            self.imu[IMU_BETWEEN_FRAMES - 1] = sample;
        }
    }
}

pub enum Tracking {
    Odometry(Box<OdometryRun>),
    Table(Vec<TimedPose>),
}

pub struct OdometryRun {
    pub front: Front,
    pub back: Back,
    /// 1 or 2.
    pub threads: u32,
    /// Of tracker and estimator together.
    pub bytes: u64,
}

/// Follows points.
pub struct Front {
    frontend: Frontend,
    imu: ImuRing,
    last: Option<Nanos>,
    /// Wall time of each frame, ms, and of all of them with what was waited for the back end, s.
    pub ms: Vec<f64>,
    pub busy_s: f64,
    /// CPU time of the thread, s; that of both halves where they share one.
    pub cpu_s: Option<f64>,
}

impl Front {
    pub fn track(&mut self, slot: &mut Slot, predictor: &Predictor) {
        slot.begun = Instant::now();
        for sample in slot.imu.iter() {
            if self.imu.admits(sample) {
                self.imu.push(*sample);
            }
        }
        if slot.frameless {
            return;
        }
        let t = slot.frames.t;
        let prediction = Prediction { prev_from_now: self.last.map(|prev| predictor.motion(&self.imu, prev, t)) };
        self.last = Some(t);
        slot.tracks.clone_from(self.frontend.track(&slot.frames, &prediction));
        let secs = slot.begun.elapsed().as_secs_f64();
        self.busy_s += secs;
        keep(&mut self.ms, secs * 1e3);
    }
}

/// Estimates.
pub struct Back {
    vio: Vio,
    /// One entry a frame, room for all of them bought at the start.
    pub trajectory: Vec<Odometry>,
    /// Wall time of each frame, ms, and of all of them, s.
    pub ms: Vec<f64>,
    pub busy_s: f64,
    /// Of every frame, odometry or not.
    pub health: Vec<(Nanos, Health)>,
    /// From when the front end took a frame until its pose was there, ms.
    pub frame_ms: Vec<(Nanos, f64)>,
    pub cpu_s: Option<f64>,
}

impl Back {
    /// Frames by health and quality.
    pub fn tally(&self) -> &Tally {
        self.vio.tally()
    }

    pub fn predictor(&self) -> Predictor {
        self.vio.predictor()
    }

    /// Fills in `slot.tracked`.
    pub fn estimate(&mut self, slot: &mut Slot) {
        let begun = Instant::now();
        slot.imu.iter().for_each(|s| self.vio.on_imu(*s));
        slot.tracked = None;
        if slot.frameless {
            return;
        }
        let update = self.vio.on_tracks(&slot.tracks);
        slot.tracked = update.odometry.map(|o| Tracked {
            world_from_body: o.world_from_body,
            keyframe: update.keyframe,
            corrections: if update.keyframe { self.keyframe_poses() } else { List::default() },
        });
        if let Some(odometry) = update.odometry {
            keep(&mut self.trajectory, odometry);
        }
        let secs = begun.elapsed().as_secs_f64();
        self.busy_s += secs;
        keep(&mut self.ms, secs * 1e3);
        keep(&mut self.health, (slot.frames.t, update.health));
        keep(&mut self.frame_ms, (slot.frames.t, slot.begun.elapsed().as_secs_f64() * 1e3));
    }

    fn keyframe_poses(&self) -> List<(Nanos, Pose), FRAMES> {
        let mut list = List::default();
        for (t, pose, _) in self.vio.window().filter(|(_, _, keyframe)| *keyframe) {
            list.push((t, pose)).expect("a window has at most FRAMES frames");
        }
        list
    }
}

/// Appends where there is room: these lists are bought at the start.
fn keep<T>(list: &mut Vec<T>, item: T) {
    if list.len() < list.capacity() {
        list.push(item);
    }
}

impl OdometryRun {
    pub fn new(calibration: &Calibration, board: &Board, frames: usize) -> Result<OdometryRun, Fault> {
        Ok(OdometryRun {
            front: Front {
                frontend: Frontend::new(calibration, &board.frontend)?,
                imu: ImuRing::new(),
                last: None,
                ms: Vec::with_capacity(frames),
                busy_s: 0.0,
                cpu_s: None,
            },
            back: Back {
                vio: Vio::new(calibration, &board.vio),
                trajectory: Vec::with_capacity(frames),
                ms: Vec::with_capacity(frames),
                busy_s: 0.0,
                health: Vec::with_capacity(frames),
                frame_ms: Vec::with_capacity(frames),
                cpu_s: None,
            },
            threads: board.frontend.threads,
            bytes: Frontend::footprint(calibration, &board.frontend).total() + Vio::footprint().total(),
        })
    }

    /// Frames a second while there are frames to track: over the time in which the busier thread was
    /// not waiting for one.
    pub fn fps(&self) -> Option<f64> {
        let (front, back) = (self.front.busy_s, self.back.busy_s);
        let busy = if self.threads == 1 { front + back } else { front.max(back) };
        (busy > 0.0).then(|| self.back.ms.len() as f64 / busy)
    }

    /// CPU time of all threads of tracking, ms a frame.
    pub fn cpu_ms(&self) -> Option<f64> {
        let total = self.front.cpu_s? + if self.threads == 1 { 0.0 } else { self.back.cpu_s? };
        let frames = self.back.ms.len();
        (frames > 0).then(|| 1e3 * total / frames as f64)
    }
}

/// The pose of a frame from a table: every frame is a keyframe.
pub fn look_up(poses: &[TimedPose], slot: &mut Slot, counters: &Counters) {
    if slot.frameless {
        slot.tracked = None;
        return;
    }
    let pose = pose_at(poses, slot.frames.t, POSE_HOLE);
    counters.frames_without_pose.add(u64::from(pose.is_none()));
    slot.tracked =
        pose.map(|world_from_body| Tracked { world_from_body, keyframe: true, corrections: List::default() });
}

impl Tracking {
    /// Threads it takes.
    pub fn threads(&self) -> u32 {
        match self {
            Tracking::Odometry(run) => run.threads,
            Tracking::Table(_) => 1,
        }
    }

    /// What was estimated of the rig, where the board asks.
    pub fn rig(&self) -> Option<RigEstimate> {
        match self {
            Tracking::Odometry(run) => run.back.vio.rig(),
            Tracking::Table(_) => None,
        }
    }

    pub fn hash(&self) -> Option<u64> {
        match self {
            Tracking::Odometry(run) => Some(run.back.vio.hash()),
            Tracking::Table(_) => None,
        }
    }

    pub fn counters(&self) -> Vec<(&'static str, u64)> {
        match self {
            Tracking::Odometry(run) => {
                let f = run.front.frontend.stats();
                let mut list = vec![
                    ("tracks_created", f.created),
                    ("tracks_lost", f.lost),
                    ("tracks_matched", f.matched),
                    ("tracks_epipolar_rejected", f.epipolar_rejected),
                    ("tracks_crowded", f.crowded),
                    ("tracks_full", f.full),
                    // `images_wrong_size` is the reader's.
                    ("frontend_images_refused", f.images_refused),
                ];
                // The first frames of a run that starts in motion, and those after a reset.
                let without = run.back.frame_ms.len().saturating_sub(run.back.trajectory.len());
                list.push(("frames_without_odometry", without as u64));
                list.extend(run.back.vio.stats().counters());
                list
            }
            Tracking::Table(_) => vec![],
        }
    }
}
