//! Stereo-inertial odometry, sans-IO: inertial samples and tracks in, odometry out.
//!
//! ```text
//! samples -> ring ---> initialization -> start ------.
//! tracks  ----------->   (until there is one)        v
//!         `-> frame ----------------------------> estimator -> monitor -> odometry, health, quality
//!                          reset: recovery remembers  ^            |
//!                          what to resume from        `--- clear --'
//! ```
//!
//! `Vio` supervises: it finds a start (`initialization`), gives frames to the window estimator (`estimator`), judges
//! what came of each (`monitor`), and after a reset resumes from what was trusted (`recovery`).
//!
//! Until motion and gravity are known tracks give no odometry. The same input gives
//! bit-identical output; `hash` compares keyframe poses. Nothing is allocated after `new`.

mod alignment;
mod carried;
mod convergence;
mod elimination;
mod estimator;
mod factors;
mod graph;
mod health;
mod height;
mod inertial;
mod initialization;
mod innovation_gate;
mod landmarks;
mod marginalization;
mod model;
mod monitor;
mod predictor;
mod preintegration;
mod prior;
mod projection;
mod recovery;
mod reprojection;
mod rig;
mod rows;
mod samples;
mod shutter;
mod solver;
mod stats;
mod triangulation;
mod window;
mod zero_velocity;

pub use carried::Schedule;
pub use convergence::{Finding, Findings, Judged, Part};
pub use health::Health;
pub use predictor::{Predicted, Predictor};
pub use rig::RigEstimate;

use crate::config::{BaroConfig, VioConfig};
use crate::frontend::{Rejected, Tracks};
use crate::limits::CAMERAS_MAX;
use convergence::Convergence;
use estimator::{Estimator, Step};
use glam::DVec3;
use health::{quality, Reset, FEW, SIGMA_V_UNOBSERVED};
use height::{Heights, Pushed};
pub use inertial::Covariance;
use inertial::{body_velocity_sigma, Motion};
use initialization::{Initializer, RESECTION_MIN};
use monitor::Monitor;
use recovery::Recovery;
use samples::ImuRing;
use stats::{Stats, Tally};
use stipple_drivers::source::{Aid, AidReading};
use stipple_drivers::{Calibration, ImuSample, Nanos, Pose, Span};

/// No image is this wide.
const PX_MAX: f32 = 65536.0;
/// Inertia alone is not believed for longer than this, s; the ring of samples may not hold more either.
const FRAME_GAP_MAX: f64 = 2.0;
/// The most that a start is worth after one that went wrong, until it is trusted, and a frame whose views do not fit.
const QUALITY_SUSPECT: u8 = 20;
/// A camera with fewer than one in so many of another's tracks is blind.
const BLIND_FRACTION: usize = 10;

/// The estimate at one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Odometry {
    pub t: Nanos,
    pub world_from_body: Pose,
    /// m/s, world frame.
    pub v_world: DVec3,
    /// rad/s, body frame.
    pub gyro_bias: DVec3,
    /// m/s², body frame.
    pub accel_bias: DVec3,
}

impl Odometry {
    fn new(t: Nanos, m: &Motion) -> Odometry {
        Odometry { t, world_from_body: m.pose, v_world: m.v, gyro_bias: m.bg, accel_bias: m.ba }
    }
}

impl From<&Odometry> for Motion {
    fn from(o: &Odometry) -> Motion {
        Motion { pose: o.world_from_body, v: o.v_world, bg: o.gyro_bias, ba: o.accel_bias }
    }
}

/// What is known of motion and rig after a frame, for those who work by it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Known {
    /// `None` until initialized.
    pub odometry: Option<Odometry>,
    /// `None` where nothing of the cameras is estimated.
    pub cameras: Option<Cameras>,
    /// Factors on the readings of gyro and accelerometer, less one.
    pub imu_scale: [DVec3; 2],
}

/// Where and when the cameras see, as estimated.
#[derive(Clone, Copy, Debug, Default)]
pub struct Cameras {
    pub body_from_cam: [Pose; CAMERAS_MAX],
    /// The largest deviation of their rotations, rad.
    pub rotation_sigma: f64,
    /// Time from a frame's stamp to the exposure of each, and the largest deviation, s.
    pub time_offsets: [f64; CAMERAS_MAX],
    pub time_sigma: f64,
}

/// What one frame led to.
#[derive(Clone, Copy, Debug, Default)]
pub struct Update {
    /// Poses of one epoch are in one frame and do not jump. A reset begins the next, which starts where dead reckoning
    /// guesses it in the frame of the one before; so does a restart that dead reckoning contradicts.
    pub epoch: u32,
    /// `None` until initialized, and again after a reset.
    pub odometry: Option<Odometry>,
    /// The last state that was trusted, carried on by inertia, while there is no `odometry`.
    pub dead_reckoned: Option<Odometry>,
    /// The frame was left to inertia, which carried the odometry of the last tracked one.
    pub carried: bool,
    /// Covariance of whichever of the two there is, as `Vio::covariance`.
    pub covariance: Option<[[f64; 15]; 15]>,
    pub keyframe: bool,
    /// Tracks that are landmarks, a point that several cameras see once.
    pub connected: usize,
    pub health: Health,
    /// 0 to 100: how many landmarks are seen, and how well the velocity is known (`health.rs`).
    pub quality: u8,
}

/// The odometry of one rig.
#[derive(Clone, Debug)]
pub struct Vio {
    imu: ImuRing,
    initializer: Initializer,
    estimator: Estimator,
    monitor: Monitor,
    recovery: Recovery,
    convergence: Convergence,
    /// Covariance of the newest state in the world of the first start.
    covariance: Option<Covariance>,
    /// Stamp of the newest frame, and of the newest that was tracked.
    stamp: Option<Nanos>,
    last: Option<Nanos>,
    /// What the inertial samples since then suffered.
    pending: Health,
    stats: Stats,
    tally: Tally,
    epoch: u32,
    hash: u64,
}

impl Vio {
    pub fn new(calibration: &Calibration, config: &VioConfig) -> Vio {
        let estimator = Estimator::new(calibration, config);
        Vio {
            imu: ImuRing::new(calibration.imu.rate_hz),
            initializer: Initializer::new(),
            convergence: Convergence::new(estimator.rig_deviations),
            estimator,
            monitor: Monitor::default(),
            recovery: Recovery::default(),
            covariance: None,
            stamp: None,
            last: None,
            pending: Health::default(),
            stats: Stats::default(),
            tally: Tally::default(),
            epoch: 0,
            hash: FNV_START,
        }
    }

    /// Takes a sample that the gate let through; refuses what is not finite or not newer than the last.
    pub fn on_imu(&mut self, s: ImuSample) {
        let noise = &self.estimator.model.noise;
        if !self.imu.admits(&s) {
            self.stats.imu_rejected += 1;
            self.pending.set(Health::IMU_REJECTED, true);
            return;
        }
        let since = self.imu.newest().map_or(0.0, |n| (s.t - n.t).secs());
        let gap = noise.is_gap(since);
        if since > FRAME_GAP_MAX {
            // One sample held for minutes leads nowhere: what is dead-reckoned meanwhile goes back to where it was trusted.
            self.epoch += u32::from(!self.is_running() && !self.recovery.is_first());
            self.recovery.interrupt(Span(0));
        }
        let overwritten = self.imu.push(s);
        self.pending.set(Health::IMU_GAP, gap);
        self.pending.set(Health::IMU_REJECTED, s.doubted);
        self.pending.set(Health::IMU_SATURATED, s.saturated != [false; 2]);
        self.recovery.propagate(s.t, &self.imu, noise);
        // Over a longer gap there will be a reset, and what dead reckoning has integrated by then is not needed.
        let needed = |old: ImuSample, t: Nanos| old.t > t && (s.t - t).secs() <= FRAME_GAP_MAX;
        let lost = overwritten.zip(self.estimator.newest()).is_some_and(|(old, newest)| needed(old, newest.t));
        self.stats.imu_gaps += u64::from(gap);
        self.stats.imu_overflow += u64::from(lost);
    }

    /// With a barometer, where the board names one. Without one its readings are not taken, and nothing of it is estimated.
    pub fn with_barometer(mut self, config: &BaroConfig) -> Vio {
        self.estimator.heights = config.is_named().then(|| Heights::new(config));
        self.estimator.graph.window.has_heights = config.is_named();
        self
    }

    /// Takes what a sensor beside cameras and inertial unit gave.
    pub fn on_aid(&mut self, reading: &AidReading) {
        let Aid::Pressure(pa) = reading.value;
        if let Some(heights) = &mut self.estimator.heights {
            let window = &self.estimator.graph.window;
            let oldest = window.order.iter().map(|slot| window.frame(*slot as usize)).find(|frame| frame.is_state);
            match heights.push(reading.t, pa) {
                Pushed::Taken => self.stats.pressures_late += u64::from(oldest.is_some_and(|f| reading.t < f.t)),
                Pushed::Rejected => self.stats.pressures_rejected += 1,
                Pushed::Frozen => self.stats.pressures_frozen += 1,
            }
        }
    }

    /// Height by the barometer over that of the estimate at the newest frame, and its deviation, m, both over the first
    /// reading. `None` without a barometer, and before the first frame with a height.
    pub fn height_bias(&self) -> Option<[f64; 2]> {
        let known = self.estimator.heights.as_ref().is_some_and(Heights::knows_bias);
        Some([self.estimator.newest()?.height_bias, self.estimator.height_deviation.filter(|_| known)?])
    }

    /// Takes what the cameras saw at one instant. Inertial samples up to it must have come before;
    /// where they have not, the last is taken as constant. A frame that is not newer than the last is refused and counted.
    pub fn on_tracks(&mut self, tracks: &Tracks) -> Update {
        if !self.admits(tracks.t) {
            return self.rejected();
        }
        let last = self.last.replace(tracks.t);
        let tracks = &self.admitted(tracks);
        let mut reset = None;
        if self.is_running() && last.is_some_and(|t| (tracks.t - t).secs() > FRAME_GAP_MAX) {
            reset = Some(Reset::FrameGap);
            self.reset_for(Reset::FrameGap);
        }
        let step = if self.is_running() { Some(self.advance(tracks)) } else { self.start(tracks) };
        let failure = step.as_ref().and_then(|step| self.failure(step));
        if let Some(why) = failure {
            reset = Some(why);
            self.reset_for(why);
        }
        let step = step.filter(|_| failure.is_none());
        let mut update = step.as_ref().map_or(Update::default(), |step| self.output(step));
        update.health = self.health(tracks, step.as_ref());
        reset.into_iter().for_each(|why| update.health.set(why.bit(), true));
        update.quality = quality(self.sigma_v(), update.connected, self.estimator.model.landmarks_enough);
        let untrusted = self.recovery.is_suspect() && !self.monitor.is_trusted();
        if untrusted || update.health.has(Health::VISION_DISAGREES) {
            update.quality = update.quality.min(QUALITY_SUSPECT);
        }
        (update.epoch, update.covariance) = (self.epoch, self.covariance);
        self.dead_reckon(tracks.t, &mut update);
        self.stats.camera_blind += u64::from(update.health.has(Health::ONE_CAMERA_BLIND));
        self.tally.add(update.health, update.odometry.map(|_| update.quality));
        match (self.estimator.newest(), &self.covariance) {
            (Some(f), Some(c)) if self.monitor.is_trusted() => self.recovery.trust(f.t, &f.now, c),
            _ => self.recovery.invalidate(),
        }
        update
    }

    /// Fills in where inertia puts the vehicle at `t`, where there is no odometry.
    fn dead_reckon(&mut self, t: Nanos, update: &mut Update) {
        if update.odometry.is_none() {
            let carried = self.recovery.dead_reckoned(t, &self.imu, &self.estimator.model.noise).unzip();
            (update.dead_reckoned, update.covariance) = (carried.0.map(|m| Odometry::new(t, &m)), carried.1);
        }
        update.health.set(Health::DEAD_RECKONED, update.dead_reckoned.is_some());
    }

    /// The tracks that a tracker of this rig can give: no cameras it has not, no pixels that are none, ids in order.
    fn admitted(&mut self, tracks: &Tracks) -> Tracks {
        let mut clean = tracks.clone();
        for (camera, list) in clean.cameras.iter_mut().enumerate() {
            let before = list.len();
            let (known, mut last) = (camera < self.estimator.model.cameras.len(), None);
            list.retain(|t| {
                let ok = known && t.px.iter().all(|x| x.abs() < PX_MAX) && last.is_none_or(|id| t.id > id);
                last = if ok { Some(t.id) } else { last };
                ok
            });
            self.stats.tracks_rejected += (before - list.len()) as u64;
        }
        clean
    }

    /// First frame of the window, once motion and gravity are known.
    fn start(&mut self, tracks: &Tracks) -> Option<Step> {
        // Without anything to see, the mean force would start a flight that nothing corrects.
        if tracks.cameras.iter().all(|camera| camera.len() < RESECTION_MIN) {
            return None;
        }
        let model = &self.estimator.model;
        let (start, window) = match self.initializer.add(tracks, &self.imu, model) {
            Some(start) => (start, None),
            None => {
                let (frames, first) = self.initializer.align(tracks.t, &self.imu, model)?;
                let (start, step) = self.estimator.start_in_motion(frames, &first, &self.imu)?;
                (start, Some(step))
            }
        };
        let is_first = self.recovery.is_first();
        let resumed = self.recovery.resume(&start, tracks.t, &self.imu, &self.estimator.model.noise);
        let window = window.filter(|_| is_first);
        if window.is_none() {
            self.clear_estimator();
        }
        let Some(start) = resumed else {
            self.initializer.clear();
            return None;
        };
        self.epoch += u32::from(self.recovery.jumped());
        // A window that was aligned lies in a world of its own; what resumes in an older one begins with its newest state.
        let step = window.unwrap_or_else(|| self.estimator.start(tracks, &start, &self.imu));
        self.take(&step);
        Some(step)
    }

    /// One more frame of a running estimator.
    fn advance(&mut self, tracks: &Tracks) -> Step {
        let doubted = self.monitor.is_suspect() || self.recovery.is_suspect() && !self.monitor.is_trusted();
        let step = self.estimator.advance(tracks, &self.imu, self.covariance.as_ref(), doubted);
        self.take(&step);
        if let Some(evidence) = step.evidence.as_ref().filter(|_| !step.at_rest) {
            let Estimator { graph, rig_deviations, .. } = &self.estimator;
            self.convergence.add(evidence.dt, &graph.window.rig, rig_deviations);
        }
        step
    }

    /// Counts what a step did and takes its covariance.
    fn take(&mut self, step: &Step) {
        let now = self.estimator.newest().map(|f| f.now).unwrap_or_default();
        self.covariance = step.covariance.map(|c| self.recovery.in_world(c, &now));
        self.imu.scale = self.estimator.graph.window.rig.now.imu_scale();
        let s = &mut self.stats;
        s.tracks_gated += step.gate.refused as u64;
        s.gates_opened += u64::from(step.gate.open);
        s.zero_velocity_updates += u64::from(step.at_rest);
        s.heights_used += u64::from(step.heights.used);
        s.heights_gated += u64::from(step.heights.gated);
        s.height_steps += u64::from(step.heights.steps);
        s.landmarks_full += step.landmarks_full as u64;
        s.outliers += step.outliers as u64;
        s.solver_failures += u64::from(step.outcome.failures);
        s.solver_steps_rejected += u64::from(step.outcome.rejected);
        s.inertia_lost += u64::from(step.inertia_lost);
        s.prior_columns_lost += step.columns_lost;
        s.solver_iterations += u64::from(step.outcome.iterations);
    }

    /// Why the estimate is to be given up after a step, if it is.
    fn failure(&mut self, step: &Step) -> Option<Reset> {
        let diverged = step.evidence.as_ref().and_then(|e| self.monitor.check(e));
        diverged.or((!self.estimator.is_sane()).then_some(Reset::State))
    }

    fn output(&mut self, step: &Step) -> Update {
        let odometry = self.odometry();
        if let (true, Some(o)) = (step.keyframe, odometry) {
            let (p, q) = (o.world_from_body.p, o.world_from_body.q);
            self.hash = fnv(self.hash, o.t.0 as u64);
            for x in [p.x, p.y, p.z, q.x, q.y, q.z, q.w] {
                self.hash = fnv(self.hash, x.to_bits());
            }
        }
        Update { odometry, keyframe: step.keyframe, connected: step.connected, ..Update::default() }
    }

    /// Bits of a frame; `step` is what it led to, unless there was none or a reset came after it.
    fn health(&mut self, tracks: &Tracks, step: Option<&Step>) -> Health {
        let mut h = std::mem::take(&mut self.pending) | self.monitor.bits();
        let model = &self.estimator.model;
        let seen = tracks.cameras[..model.cameras.len()].iter().map(|c| c.len());
        let (least, most) = seen.fold((usize::MAX, 0), |(a, b), n| (a.min(n), b.max(n)));
        let held = self.imu.newest().is_none_or(|n| model.noise.is_gap((tracks.t - n.t).secs()));
        let unobserved = self.sigma_v().is_none_or(|sigma| !(sigma < SIGMA_V_UNOBSERVED));
        h.set(Health::INITIALISING, !self.is_running());
        h.set(Health::NO_TRACKS, most == 0);
        h.set(Health::IMU_GAP, held);
        h.set(Health::ONE_CAMERA_BLIND, BLIND_FRACTION * least < most);
        if let Some(step) = step {
            h.set(Health::FEW_LANDMARKS, (step.connected as f64) < FEW * model.landmarks_enough);
            h.set(Health::SOLVER_FAILED, step.outcome.failures > 0);
            h.set(Health::ZERO_VELOCITY, step.at_rest);
            h.set(Health::VELOCITY_UNOBSERVED, unobserved);
        }
        h
    }

    /// Goes over to another clock, on which stamps go on at `t`, `unheard` after the last of the one before. Samples and
    /// readings are forgotten, and the next epoch begins where the estimate was last trusted, as uncertain as the rig may
    /// have moved since.
    pub fn change_clock(&mut self, t: Nanos, unheard: Span) {
        let Some(newest) = self.imu.newest().map(|s| s.t).max(self.last) else { return };
        self.recovery.interrupt(t - unheard - newest);
        self.imu.clear();
        self.estimator.heights.iter_mut().for_each(Heights::forget_readings);
        (self.stamp, self.last) = (None, None);
        self.pending.set(Reset::FrameGap.bit(), true);
        self.reset_for(Reset::FrameGap);
    }

    /// Forgets everything but the inertial samples and where it was, and initializes again.
    #[cfg(feature = "instruments")]
    pub fn reset(&mut self) {
        self.reset_for(Reset::Asked);
    }

    /// Points of the last frame that contradict the estimate, once.
    pub fn take_rejected(&mut self) -> Rejected {
        std::mem::take(&mut self.estimator.rejected)
    }

    fn reset_for(&mut self, why: Reset) {
        self.recovery.reset(why);
        let thrown_away = !self.estimator.graph.window.rig.is_sane();
        self.stats.rigs_thrown_away += u64::from(thrown_away);
        self.convergence.restart(thrown_away);
        self.clear_estimator();
        self.initializer.clear();
        self.monitor = Monitor::default();
        self.covariance = None;
        self.epoch += 1;
        self.stats.add_reset(why);
    }

    fn clear_estimator(&mut self) {
        self.estimator.clear();
        self.imu.scale = self.estimator.graph.window.rig.now.imu_scale();
    }

    /// Whether there is odometry: a start was found, and no reset came since.
    pub fn is_running(&self) -> bool {
        self.estimator.newest().is_some()
    }

    /// The newest state. `None` until initialized.
    pub fn odometry(&self) -> Option<Odometry> {
        self.estimator.newest().map(|f| Odometry::new(f.t, &f.now))
    }

    /// Covariance of the newest state, errors [p, θ, v, bg, ba]: p, m, and v, m/s, in the world; θ, rad, on the right
    /// of the rotation; biases, rad/s and m/s². `None` until initialized, and where the window does not determine it.
    pub fn covariance(&self) -> Option<&[[f64; 15]; 15]> {
        self.covariance.as_ref()
    }

    /// Standard deviation of the newest velocity in the frame of the body, m/s, all axes.
    fn sigma_v(&self) -> Option<f64> {
        let now = &self.estimator.newest()?.now;
        self.covariance.as_ref().map(|c| body_velocity_sigma(c, now))
    }

    /// What is estimated of the rig; `None` when nothing is.
    pub fn rig(&self) -> Option<RigEstimate> {
        let rig = &self.estimator.graph.window.rig;
        rig.parts.any().then(|| RigEstimate::new(rig, &self.estimator.rig_deviations))
    }

    /// What was found so far of what is estimated of the rig, after some time of motion.
    pub fn rig_findings(&self) -> Findings {
        self.convergence.findings
    }

    /// The same at the end of a run, however short.
    pub fn rig_findings_at_end(&self) -> Findings {
        self.convergence.concluded(&self.estimator.graph.window.rig, &self.estimator.rig_deviations)
    }

    /// How well each part of the rig is known that is estimated.
    pub fn rig_parts(&self) -> impl Iterator<Item = Judged> + '_ {
        self.convergence.parts(&self.estimator.graph.window.rig, &self.estimator.rig_deviations)
    }

    /// What the tracker works by.
    pub fn known(&self) -> Known {
        let (rig, sigma) = (&self.estimator.graph.window.rig, &self.estimator.rig_deviations);
        let cameras = (rig.parts.extrinsics || rig.parts.time_offset).then(|| {
            let most = |m: f64, i: usize| m.max(sigma[i]);
            let all = 0..rig.cameras().len();
            let thetas = all.clone().filter_map(|c| rig.extrinsic_column(c)).flat_map(|at| at + 3..at + 6);
            Cameras {
                body_from_cam: rig.now.body_from_cam,
                rotation_sigma: thetas.fold(0.0, most),
                time_offsets: rig.now.time_offsets,
                time_sigma: all.filter_map(|c| rig.time_column(c)).fold(0.0, most),
            }
        });
        Known { odometry: self.odometry(), cameras, imu_scale: rig.now.imu_scale() }
    }

    /// Time that is to be added to the stamps of each camera's images, beyond what the calibration adds, zero of cameras that
    /// the rig has not; `None` where it is not estimated.
    pub fn time_offsets(&self) -> Option<[Span; CAMERAS_MAX]> {
        let rig = &self.estimator.graph.window.rig;
        rig.parts.time_offset.then(|| rig.now.time_offsets.map(Span::from_secs))
    }

    /// Stamp, pose, and whether it is a keyframe, of every frame of the window, oldest first. The pose is that of the
    /// body at the exposure of camera 0, by its estimated time offset; `known` says where the cameras sit on it.
    pub fn window(&self) -> impl Iterator<Item = (Nanos, Pose, bool)> + '_ {
        let window = &self.estimator.graph.window;
        window.slots().map(|s| window.frame(s)).map(|f| (f.t, window.exposed(f), f.keyframe))
    }

    /// The epoch of the newest frame.
    pub fn epoch(&self) -> u32 {
        self.epoch
    }

    /// FNV-1a over stamp and pose bits of every keyframe as it was output.
    pub fn hash(&self) -> u64 {
        self.hash
    }

    /// What was dropped, refused, repaired or done so far.
    pub fn stats(&self) -> &Stats {
        &self.stats
    }

    /// Number of frames on which each bit of health was set, by the bit's name.
    pub fn health_frames(&self) -> impl Iterator<Item = (&'static str, u64)> + '_ {
        self.tally.health()
    }

    /// Lowest and median quality, and the share of frames under 50, of all frames with odometry; `None` without any.
    pub fn quality_summary(&self) -> Option<(u8, u8, f64)> {
        self.tally.quality()
    }
}

/// The insides, for benches that time them and for tests.
#[cfg(feature = "instruments")]
#[doc(hidden)]
pub mod instruments {
    pub use super::estimator::Estimator;
    pub use super::factors::view_rows;
    pub use super::graph::Graph;
    pub use super::inertial::Covariance;
    pub use super::preintegration::Increment;
    pub use super::samples::ImuRing;
    pub use super::solver::{Outcome, LAMBDA_START};
    pub use super::stats::Stats;
    pub use super::window::Layout;

    /// The window estimator, the inertial samples, and the covariance of the newest state.
    pub fn parts(vio: &super::Vio) -> (&Estimator, &ImuRing, Option<&Covariance>) {
        (&vio.estimator, &vio.imu, vio.covariance.as_ref())
    }
}

const FNV_START: u64 = 0xcbf2_9ce4_8422_2325;

fn fnv(hash: u64, word: u64) -> u64 {
    word.to_le_bytes().iter().fold(hash, |h, b| (h ^ *b as u64).wrapping_mul(0x0000_0100_0000_01b3))
}

#[cfg(test)]
mod restart_tests;
#[cfg(test)]
mod start_tests;
#[cfg(test)]
mod tests;
#[cfg(test)]
use crate::world;
