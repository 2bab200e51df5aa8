//! Sliding-window stereo-inertial estimator, sans-IO: samples and tracks in, odometry out.
//!
//! Per frame: preintegrate the inertial samples since the last one and predict; attach tracks to
//! landmarks; perhaps declare a keyframe and triangulate; optimise the window; drop outliers;
//! marginalise back to the resting size (`STATES` states, `KEYFRAMES` keyframe poses). After Usenko
//! et al., RA-L 2020, with the state of a new frame output after its own optimisation.
//!
//! Until motion and gravity are known (`init`) tracks give no odometry. The same input gives
//! bit-identical output; `hash` proves it. Nothing is allocated after `new`.

pub mod gate;
pub mod health;
pub mod initialization;
pub mod landmarks;
pub mod linear;
pub mod marginalization;
pub mod predict;
pub mod preintegration;
pub mod projection;
mod recovery;
pub mod residuals;
pub mod rig;
pub mod samples;
pub mod shutter;
pub mod solve;
pub mod spikes;
pub mod stages;
mod stats;
pub mod window;
pub mod zero_velocity;

use crate::config::VioConfig;
use crate::frontend::Tracks;
use crate::limits::{CAMERAS_MAX, RIG_DIM, STATES};
use crate::mem::Footprint;
use gate::{gate, predicted_covariance};
use glam::DVec3;
use health::{quality, sigma_v, Evidence, Health, Reset, Watch, SIGMA_V_UNOBSERVED};
use initialization::{Initializer, RESECTION_MIN};
use landmarks::{Landmark, Landmarks};
use linear::inertial_residual_at;
use marginalization::{Marginalizer, Prior};
use predict::Predictor;
use preintegration::{Increment, Noise};
use recovery::{Origin, Recovery};
use residuals::{CameraModel, InertialWeight, Motion};
use rig::{Parts, RigEstimate, RigSigma, RigState};
use samples::{ImuRing, Leap};
use solve::{Model, Outcome, Solver};
pub use stats::{Stats, Tally};
use stipple_drivers::{Calibration, ImuSample, Nanos, Pose};
use window::{Frame, Window, FRAMES};

/// With fewer landmarks in view than this a keyframe is declared at once.
const CONNECTED_FEW: usize = 20;
/// A state this far from sense is a failure, and the estimator starts again: m/s, m/s², rad/s.
const SPEED_MAX: f64 = 100.0;
const ACCEL_BIAS_MAX: f64 = 5.0;
const GYRO_BIAS_MAX: f64 = 1.0;
/// No image is this wide.
const PX_MAX: f32 = 65536.0;
/// Inertia alone is not believed for longer than this, s; the ring of samples may not hold more either.
const FRAME_GAP_MAX: f64 = 2.0;
/// Of the rig's deviations, by which an outlier's distance is widened.
const RIG_SIGMAS: f64 = 3.0;
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

/// What one frame led to.
#[derive(Clone, Copy, Debug, Default)]
pub struct Update {
    /// `None` until initialised.
    pub odometry: Option<Odometry>,
    pub keyframe: bool,
    /// Tracks of camera 0 that are landmarks.
    pub connected: usize,
    pub outcome: Outcome,
    pub health: Health,
    /// 0 to 100, see `health::quality`.
    pub quality: u8,
}

#[derive(Clone, Debug)]
pub struct Vio {
    model: Model,
    config: VioConfig,
    noise: Noise,
    imu: ImuRing,
    window: Window,
    /// What was seen in each slot of the window.
    tracks: Vec<Tracks>,
    landmarks: Landmarks,
    prior: Prior,
    solver: Solver,
    marginalizer: Marginalizer,
    initializer: Initializer,
    /// What is known of the rig at a start, and now, in the order of its columns.
    rig_sigma: RigSigma,
    rig_deviations: [f64; RIG_DIM],
    running: bool,
    /// The zero-velocity update held the frame before the last.
    rests: bool,
    /// As `predictor` before the newest frame, and the stamp of that frame.
    before: Predictor,
    last: Option<Nanos>,
    leap: Leap,
    /// Where a restart goes on, and why there is one.
    trust: Recovery,
    origin: Origin,
    reset_by: Reset,
    watch: Watch,
    /// What the inertial samples since the last frame suffered.
    pending: Health,
    covariance: Option<[[f64; 15]; 15]>,
    frames_since_keyframe: u32,
    stats: Stats,
    tally: Tally,
    hash: u64,
}

impl Vio {
    pub fn new(calibration: &Calibration, config: &VioConfig) -> Vio {
        let cameras: Vec<CameraModel> = calibration.cameras.iter().take(CAMERAS_MAX).map(CameraModel::from).collect();
        let poses: Vec<Pose> = calibration.cameras.iter().take(CAMERAS_MAX).map(|c| c.body_from_cam).collect();
        let rig = RigState::new(&cameras, &poses, Parts::new(config));
        let rig_sigma = RigSigma::new(config);
        let rig_deviations = rig.sigmas(&rig_sigma);
        let noise = Noise::new(&calibration.imu, config);
        Vio {
            model: Model::new(cameras, config),
            config: config.clone(),
            noise,
            imu: ImuRing::new(),
            window: Window::new(rig),
            tracks: vec![Tracks::default(); FRAMES],
            landmarks: Landmarks::new(),
            prior: Prior::new(),
            solver: Solver::new(),
            marginalizer: Marginalizer::new(),
            initializer: Initializer::new(),
            rig_sigma,
            rig_deviations,
            running: false,
            rests: false,
            before: Predictor { noise, state: None },
            last: None,
            leap: Leap::default(),
            trust: Recovery::default(),
            origin: Origin::default(),
            reset_by: Reset::Asked,
            watch: Watch::default(),
            pending: Health::default(),
            covariance: None,
            frames_since_keyframe: 0,
            stats: Stats::default(),
            tally: Tally::default(),
            hash: FNV_START,
        }
    }

    pub fn footprint() -> Footprint {
        let mut f = Footprint::default();
        f.host("vio: inertial ring", ImuRing::BYTES);
        f.host("vio: window", Window::BYTES + FRAMES * size_of::<Tracks>());
        f.host("vio: landmarks", Landmarks::BYTES);
        f.host("vio: solver", Solver::BYTES);
        f.host("vio: prior and marginalisation", Prior::BYTES + Marginalizer::BYTES);
        f.host("vio: initialisation", Initializer::BYTES);
        f
    }

    /// Takes a sample; refuses what is not finite, not newer than the last, or leaps ahead of it.
    pub fn on_imu(&mut self, s: ImuSample) {
        if !self.imu.admits(&s) {
            self.stats.imu_rejected += 1;
            self.pending.set(Health::IMU_REJECTED, true);
            return;
        }
        let gap = self.imu.newest().is_some_and(|n| self.noise.is_gap((s.t - n.t).secs()));
        self.stats.imu_gaps += gap as u64;
        self.pending.set(Health::IMU_GAP, gap);
        let clipped = self.noise.clipped(s.gyro_body, s.accel_body);
        self.stats.imu_saturated += (clipped.0 || clipped.1) as u64;
        self.pending.set(Health::IMU_SATURATED, clipped.0 || clipped.1);
        let overwritten = self.imu.push(s);
        let repaired = self.imu.repair(&self.noise);
        self.stats.imu_repaired += u64::from(repaired);
        self.pending.set(Health::IMU_REJECTED, repaired);
        self.trust.fold(s.t, &self.imu, &self.noise);
        let needed_from = self.window.newest().map(|n| self.window.frame(n).t);
        if let (Some(old), Some(t)) = (overwritten, needed_from) {
            // Over a longer gap it is given up, and what was folded in by then is not needed.
            let lost = old.t > t && (s.t - t).secs() <= FRAME_GAP_MAX;
            self.stats.imu_overflow += lost as u64;
        }
    }

    /// Takes what the cameras saw at one instant. Inertial samples up to it must have come before;
    /// the newest is held where they have not.
    pub fn on_tracks(&mut self, tracks: &Tracks) -> Update {
        let last = self.last;
        if last.is_some_and(|t| tracks.t <= t) || self.leap.refuses(last, tracks.t) {
            self.stats.frames_rejected += 1;
            return Update::default();
        }
        self.stats.frames += 1;
        let tracks = &self.admitted(tracks);
        (self.before, self.last) = (self.predictor(), Some(tracks.t));
        let mut given_up = None;
        if self.running && last.is_some_and(|t| (tracks.t - t).secs() > FRAME_GAP_MAX) {
            given_up = Some(Reset::FrameGap);
            self.reset_for(Reset::FrameGap);
        }
        let tried = if self.running { self.advance(tracks) } else { Ok(self.try_start(tracks)) };
        let mut update = match tried {
            Ok(update) if !self.running || self.is_sane() => update,
            failed => {
                let why = failed.err().unwrap_or(Reset::State);
                given_up = Some(why);
                self.reset_for(why);
                Update::default()
            }
        };
        update.health = self.health_of(tracks, &update);
        given_up.into_iter().for_each(|why| update.health.set(why.bit(), true));
        self.stats.camera_blind += update.health.has(Health::ONE_CAMERA_BLIND) as u64;
        update.quality = quality(self.covariance(), update.connected);
        self.tally.add(update.health, update.odometry.map(|_| update.quality));
        match (self.window.newest(), &self.covariance) {
            (Some(n), Some(c)) if self.watch.trusts() => {
                let f = self.window.frame(n);
                self.trust.add(f.t, &f.now, c);
            }
            _ => self.trust.invalidate(),
        }
        update
    }

    /// Without what no tracker of this rig says: cameras it has not, pixels that are none, ids out of order.
    fn admitted(&mut self, tracks: &Tracks) -> Tracks {
        let mut clean = tracks.clone();
        for (camera, list) in clean.cameras.iter_mut().enumerate() {
            let before = list.len();
            let (known, mut last) = (camera < self.model.cameras.len(), None);
            list.retain(|t| {
                let ok = known && t.px.iter().all(|x| x.abs() < PX_MAX) && last.is_none_or(|id| t.id > id);
                last = if ok { Some(t.id) } else { last };
                ok
            });
            self.stats.tracks_rejected += (before - list.len()) as u64;
        }
        clean
    }

    fn health_of(&mut self, tracks: &Tracks, update: &Update) -> Health {
        let mut h = std::mem::take(&mut self.pending) | self.watch.bits();
        let seen = tracks.cameras[..self.model.cameras.len()].iter().map(|c| c.len());
        let (least, most) = seen.fold((usize::MAX, 0), |(a, b), n| (a.min(n), b.max(n)));
        let held = self.imu.newest().is_none_or(|n| self.noise.is_gap((tracks.t - n.t).secs()));
        let unobserved = self.covariance.as_ref().is_none_or(|c| !(sigma_v(c) < SIGMA_V_UNOBSERVED));
        h.set(Health::INITIALISING, !self.running);
        h.set(Health::NO_TRACKS, most == 0);
        h.set(Health::FEW_LANDMARKS, self.running && update.connected < CONNECTED_FEW);
        h.set(Health::IMU_GAP, held);
        h.set(Health::SOLVER_FAILED, update.outcome.failures > 0);
        h.set(Health::ZERO_VELOCITY, self.running && self.rests);
        h.set(Health::ONE_CAMERA_BLIND, BLIND_FRACTION * least < most);
        h.set(Health::VELOCITY_UNOBSERVED, self.running && unobserved);
        h
    }

    /// First frame of the window, once motion and gravity are known.
    fn try_start(&mut self, tracks: &Tracks) -> Update {
        // Without anything to see, the mean force would start a flight that nothing corrects.
        if tracks.cameras[0].len() < RESECTION_MIN {
            return Update::default();
        }
        let Some(start) = self.initializer.add(tracks, &self.imu, &self.noise, &self.model, &self.config) else {
            return Update::default();
        };
        let Some(mut start) = self.trust.resume(&start, self.reset_by, tracks.t, &self.imu, &self.noise) else {
            self.initializer.clear();
            return Update::default();
        };
        self.origin = Origin::split(&mut start);
        let (motion, sigma) = (start.motion, start.sigma);
        let mut frame = Frame::first(tracks.t, motion);
        frame.rate = self.imu.rate_at(tracks.t);
        frame.hold_twist();
        frame.fix_linearization_point();
        let Some(slot) = self.window.push(frame) else { return Update::default() };
        self.window.rig.fix_linearization_point();
        self.rig_deviations = self.window.rig.sigmas(&self.rig_sigma);
        self.prior.start(slot, &motion, &sigma, (&self.window.rig, &self.rig_sigma));
        self.covariance = Some(self.origin.add_to(sigma.covariance(&motion), &motion));
        self.tracks[slot].clone_from(tracks);
        self.running = true;
        self.make_keyframe(slot);
        self.output(slot, true, self.landmarks.pool.len(), Outcome::default())
    }

    /// The frame after that in slot `before`, where inertia puts it.
    fn propagated(&self, before: usize, t: Nanos) -> Frame {
        let before = self.window.frame(before);
        let inc = self.imu.integrate(before.t, t, before.now.bg, before.now.ba, &self.noise);
        let mut frame = Frame::first(t, before.now.propagate(&self.scaled(&inc)));
        frame.weight = self.inertial_weight(&inc);
        frame.increment = inc;
        frame.rate = self.imu.rate_at(t);
        frame
    }

    /// Takes a frame into the window; answers its slot, and how many of its points are landmarks and are not.
    fn enter(&mut self, before: usize, tracks: &Tracks) -> (usize, usize, usize) {
        let frame = self.propagated(before, tracks.t);
        let slot = self.window.push(frame).expect("marginalisation left room for one frame");
        self.window.hold_twists();
        self.tracks[slot].clone_from(tracks);
        self.gate(slot);

        if self.config.zero_velocity {
            self.rests = zero_velocity::hold(slot, &mut self.window, &self.tracks, &self.imu);
            self.stats.zero_velocity_updates += self.rests as u64;
        }
        let (connected, unconnected) = self.landmarks.attach(slot, &self.tracks[slot]);
        self.frames_since_keyframe += 1;
        (slot, connected, unconnected)
    }

    fn is_keyframe_due(&self, connected: usize, unconnected: usize) -> bool {
        let fraction = connected as f64 / (connected + unconnected).max(1) as f64;
        let due =
            fraction < self.config.keyframe_connected_min && self.frames_since_keyframe > self.config.keyframe_gap_min;
        unconnected > 0 && (due || connected < CONNECTED_FEW)
    }

    /// One more frame, or why the estimate is to be given up.
    fn advance(&mut self, tracks: &Tracks) -> Result<Update, Reset> {
        let Some(before) = self.window.newest() else { return Err(Reset::State) };
        let (slot, connected, unconnected) = self.enter(before, tracks);
        let keyframe = self.is_keyframe_due(connected, unconnected);
        if keyframe {
            self.make_keyframe(slot);
        }

        let outcome = self.solver.optimize(&mut self.window, &mut self.landmarks, &mut self.prior, &self.model);
        self.stats.solver_failures += outcome.failures as u64;
        self.stats.iterations += outcome.iterations as u64;
        let now = &self.window.frame(slot).now;
        self.covariance = self.solver.newest_covariance().map(|c| self.origin.add_to(c, now));
        let views = self.landmarks.views_in(slot);
        if keyframe && self.window.rig.parts.any() {
            let n = self.window.rig.camera_dim() + self.window.rig.parts.imu_dim();
            self.solver.rig_deviations(&mut self.rig_deviations[..n]);
        }
        let dropped = self.landmarks.drop_outliers(&self.window, self.outlier_px(slot));
        self.stats.outliers += dropped as u64;
        let f = self.window.frame(slot);
        let misfit = inertial_residual_at(&self.window, before, slot).norm_squared() / 15.0;
        let inliers = self.landmarks.views_in(slot);
        let seen_before = |l: &&Landmark| l.host as usize != slot;
        let in_frame = |l: &Landmark| l.observations.iter().filter(|o| o.slot as usize == slot).count();
        let known = self.landmarks.pool.iter().filter(seen_before).map(in_frame).sum();
        if let Some(why) = self.watch.judge(&Evidence { t: f.t, views, inliers, known, misfit }) {
            return Err(why);
        }
        let update = self.output(slot, keyframe, connected, outcome);
        self.marginalize();
        Ok(update)
    }

    /// Takes out of what was seen in `slot` what cannot be what it claims.
    fn gate(&mut self, slot: usize) {
        let Some(covariance) = &self.covariance else { return };
        let p = predicted_covariance(&self.window, slot, covariance);
        // Wider while the rig is not known well.
        let sigma_px = self.config.observation_sigma_px + self.outlier_px(slot) - self.config.outlier_px;
        let tracks = &mut self.tracks[slot];
        let passed = gate(slot, tracks, &self.landmarks, &self.window, &p, sigma_px);
        self.stats.tracks_gated += passed.refused as u64;
        self.stats.gates_opened += passed.open as u64;
    }

    fn marginalize(&mut self) {
        let (window, landmarks, linear) = (&mut self.window, &mut self.landmarks, &mut self.solver.linear);
        self.marginalizer.marginalize(window, landmarks, &mut self.prior, linear, &self.model);
    }

    fn scaled(&self, inc: &Increment) -> Increment {
        let rig = &self.window.rig.now;
        inc.rescaled(rig.gyro_scale, rig.accel_scale)
    }

    /// Views further than this from their prediction are wrong: wider while the rig is not known well.
    fn outlier_px(&self, slot: usize) -> f64 {
        let rig = &self.window.rig;
        let known = &self.rig_deviations;
        let focal = self.model.cameras.iter().fold(0.0f64, |f, e| f.max(e.camera.fx));
        let time = if rig.parts.time_offset { known[0] * self.window.frame(slot).twist.w.length() } else { 0.0 };
        let thetas =
            (0..self.model.cameras.len()).filter_map(|c| rig.extrinsic_column(c)).flat_map(|at| at + 3..at + 6);
        let turn = thetas.fold(0.0f64, |m, i| m.max(known[i]));
        self.config.outlier_px + RIG_SIGMAS * focal * (time + turn)
    }

    /// What is estimated of the rig; `None` when nothing is.
    pub fn rig(&self) -> Option<RigEstimate> {
        let rig = &self.window.rig;
        rig.parts.any().then(|| RigEstimate::new(rig, &self.rig_deviations))
    }

    fn inertial_weight(&self, inc: &Increment) -> InertialWeight {
        let root_dt = inc.dt.sqrt();
        InertialWeight {
            // A covariance that cannot be factored says nothing; zero weight leaves the step to vision.
            increment: inc.whitening().unwrap_or_default(),
            bg: 1.0 / (self.noise.gyro_walk * root_dt),
            ba: 1.0 / (self.noise.accel_walk * root_dt),
        }
    }

    fn make_keyframe(&mut self, slot: usize) {
        let (made, full) = self.landmarks.triangulate(
            slot,
            &self.window,
            &self.tracks,
            self.window.rig.cameras(),
            self.config.triangulation_baseline_min_m,
            self.outlier_px(slot),
        );
        self.stats.landmarks_full += full as u64;
        self.stats.keyframes += 1;
        self.frames_since_keyframe = 0;
        let frame = self.window.frame_mut(slot);
        (frame.keyframe, frame.hosted) = (true, made);
    }

    fn output(&mut self, slot: usize, keyframe: bool, connected: usize, outcome: Outcome) -> Update {
        let f = self.window.frame(slot);
        let odometry = odometry(f.t, &f.now);
        if keyframe {
            let (p, q) = (odometry.world_from_body.p, odometry.world_from_body.q);
            self.hash = fnv(self.hash, odometry.t.0 as u64);
            for x in [p.x, p.y, p.z, q.x, q.y, q.z, q.w] {
                self.hash = fnv(self.hash, x.to_bits());
            }
        }
        Update { odometry: Some(odometry), keyframe, connected, outcome, ..Update::default() }
    }

    fn is_sane(&self) -> bool {
        self.window.newest().is_some_and(|n| {
            let m = &self.window.frame(n).now;
            self.window.rig.is_sane()
                && m.is_finite()
                && m.v.length() < SPEED_MAX
                && m.ba.length() < ACCEL_BIAS_MAX
                && m.bg.length() < GYRO_BIAS_MAX
        })
    }

    /// Forgets everything but the inertial samples and where it was, and initialises again.
    pub fn reset(&mut self) {
        self.reset_for(Reset::Asked);
    }

    fn reset_for(&mut self, why: Reset) {
        self.reset_by = why;
        self.window.clear();
        self.landmarks.clear();
        self.prior.clear();
        self.initializer.clear();
        (self.running, self.rests) = (false, false);
        self.watch = Watch::default();
        self.covariance = None;
        self.frames_since_keyframe = 0;
        self.stats.resets += 1;
        match why {
            Reset::FrameGap => self.stats.resets_frame_gap += 1,
            Reset::Disagreement => self.stats.resets_disagreement += 1,
            Reset::Unseen => self.stats.resets_unseen += 1,
            Reset::State => self.stats.resets_state += 1,
            Reset::Asked => {}
        }
    }

    /// Covariance of the newest state, errors [p, θ, v, bg, ba]: p and v in the world, θ on the right of the
    /// rotation. `None` until a frame has been optimised.
    pub fn covariance(&self) -> Option<&[[f64; 15]; 15]> {
        self.covariance.as_ref()
    }

    /// The newest state carried by the inertial samples to `t`. `None` until initialised.
    pub fn predict(&self, t: Nanos) -> Option<Odometry> {
        let f = self.running.then(|| self.window.newest().map(|n| self.window.frame(n)))??;
        let inc = self.imu.integrate(f.t, t.max(f.t), f.now.bg, f.now.ba, &self.noise);
        Some(odometry(f.t.max(t), &f.now.propagate(&self.scaled(&inc))))
    }

    /// What a tracker on another thread predicts with, two frames on.
    pub fn predictor(&self) -> Predictor {
        let newest = self.running.then(|| self.window.newest().map(|n| self.window.frame(n)));
        Predictor { noise: self.noise, state: newest.flatten().map(|f| (f.t, f.now)) }
    }

    /// Motion of the body since the newest frame, for the tracker's start at `t`, from the state of
    /// the frame before it: before initialisation the rotation only, and nothing before the first frame.
    pub fn predict_motion(&self, t: Nanos) -> Option<Pose> {
        Some(self.before.motion(&self.imu, self.last?, t))
    }

    /// Instant, pose, and whether it is a keyframe, of every frame of the window, oldest first.
    pub fn window(&self) -> impl Iterator<Item = (Nanos, Pose, bool)> + '_ {
        self.window.slots().map(|s| self.window.frame(s)).map(|f| (f.t, f.now.pose, f.keyframe))
    }

    /// FNV-1a over stamp and pose bits of every keyframe as it was output.
    pub fn hash(&self) -> u64 {
        self.hash
    }

    pub fn stats(&self) -> &Stats {
        &self.stats
    }

    pub fn tally(&self) -> &Tally {
        &self.tally
    }

    pub fn landmarks(&self) -> usize {
        self.landmarks.pool.len()
    }

    pub fn is_running(&self) -> bool {
        self.running
    }
}

fn odometry(t: Nanos, m: &Motion) -> Odometry {
    Odometry { t, world_from_body: m.pose, v_world: m.v, gyro_bias: m.bg, accel_bias: m.ba }
}

const FNV_START: u64 = 0xcbf2_9ce4_8422_2325;

fn fnv(hash: u64, word: u64) -> u64 {
    word.to_le_bytes().iter().fold(hash, |h, b| (h ^ *b as u64).wrapping_mul(0x0000_0100_0000_01b3))
}

const _: () = assert!(FRAMES > STATES + 1 && FRAMES <= u8::MAX as usize);

#[cfg(test)]
mod tests;
#[cfg(test)]
use crate::world;
