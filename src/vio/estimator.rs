//! The window estimator: one frame in, its optimized state out, while nothing has gone wrong.
//!
//! Per frame: preintegrate the inertial samples since the last one and predict; attach tracks to
//! landmarks; perhaps declare a keyframe and triangulate; optimize the window; drop outliers;
//! marginalize back to the resting size. After Usenko et al., RA-L 2020, with the state of a new frame output after
//! its own optimization. Where it starts, and when it is given up, is the supervisor's (`mod.rs`) to say.

use super::factors::inertial_residual_at;
use super::graph::Graph;
use super::height::{Attached, Heights};
use super::inertial::{body_velocity_sigma, Covariance, InertialWeight, Motion, MotionSigma};
use super::initialization::{Start, GAUGE_SIGMA, RESECTION_MIN};
use super::innovation_gate::{gate, predicted_covariance, Passed};
use super::marginalization::Marginalizer;
use super::model::Model;
use super::monitor::Evidence;
use super::recovery::deviations;
use super::rig::{RigParameters, RigState};
use super::samples::ImuRing;
use super::solver::{Outcome, Solver};
use super::triangulation::{drop_outliers, triangulate};
use super::window::Frame;
use super::zero_velocity;
use crate::config::VioConfig;
use crate::frontend::{Rejected, Tracks};
use crate::limits::{CAMERAS_MAX, FRAMES, RIG_DIM};
use glam::DVec3;
use stipple_drivers::{Calibration, Nanos};

/// A keyframe is declared at once when fewer landmarks than this are in view.
const CONNECTED_FEW: usize = 20;
/// Speed above which the vehicle counts as moving, m/s: more than the error of the first estimates of a start at rest.
const MOVING: f64 = 0.3;
/// A state this far from sense is a failure: m/s, m/s², rad/s.
const SPEED_MAX: f64 = 100.0;
const ACCEL_BIAS_MAX: f64 = 5.0;
const GYRO_BIAS_MAX: f64 = 1.0;
/// Prior of a window that starts in motion: deviations of tilt, rad, and of velocity, m/s.
const TILT_UNKNOWN: f64 = 1.0;
const V_UNKNOWN: f64 = 30.0;
/// Bound on outliers after each of its optimizations, as a factor on the usual one.
const ALIGNED_OUTLIERS: [f64; 3] = [5.0, 1.0, 1.0];
/// Such a start is accepted when the speed's deviation is below this share of the speed, and the mean squared residual, in
/// deviations and for each degree of freedom, below this bound: a fifth of wrong tracks stays below it.
const SPEED_KNOWN: f64 = 0.1;
const MISFIT_MAX: f64 = 0.75;
/// Share of a frame's views that fit it below which they have misled the optimization, which is done again without the others.
const MISLED: f64 = 0.3;
/// Deviations of the rig by which the bound of outliers is widened.
const RIG_SIGMAS: f64 = 3.0;

/// What one frame led to.
#[derive(Clone, Copy, Debug, Default)]
pub struct Step {
    pub keyframe: bool,
    /// Points seen that are landmarks, and that are not.
    pub connected: usize,
    pub unconnected: usize,
    pub gate: Passed,
    /// The samples since the last frame say nothing: their covariance could not be factored.
    pub inertia_lost: bool,
    /// Columns that marginalization had to drop because they were not finite.
    pub columns_lost: u64,
    /// Zero velocity was measured.
    pub at_rest: bool,
    /// What became of the heights of a barometer.
    pub heights: Attached,
    pub outcome: Outcome,
    pub outliers: usize,
    /// Landmarks refused because there was no room.
    pub landmarks_full: usize,
    /// Covariance of the newest state; `None` where the window does not determine it.
    pub covariance: Option<Covariance>,
    /// `None` at a start.
    pub evidence: Option<Evidence>,
}

/// The window and what works on it.
#[derive(Clone, Debug)]
pub struct Estimator {
    pub model: Model,
    pub graph: Graph,
    /// Tracks of the frame in each slot.
    pub tracks: Vec<Tracks>,
    pub solver: Solver,
    marginalizer: Marginalizer,
    /// Readings of a barometer; `None` where the rig has none.
    pub heights: Option<Heights>,
    /// Deviation of the barometer's bias at the newest frame, m.
    pub height_deviation: Option<f64>,
    /// Standard deviations of the rig, in the order of its columns.
    pub rig_deviations: [f64; RIG_DIM],
    /// Points that the newest frame's views contradict.
    pub rejected: Rejected,
    /// Stamp of the newest keyframe.
    keyframe_at: Nanos,
    /// There was motion since the start.
    moved: bool,
}

impl Estimator {
    pub fn new(calibration: &Calibration, config: &VioConfig) -> Estimator {
        let model = Model::new(calibration, config);
        let rig = RigState::new(&model.cameras, calibration, config);
        Estimator {
            rig_deviations: rig.sigmas(config),
            model,
            graph: Graph::new(rig),
            tracks: vec![Tracks::default(); FRAMES],
            solver: Solver::new(),
            marginalizer: Marginalizer::new(),
            heights: None,
            height_deviation: None,
            rejected: Rejected::default(),
            keyframe_at: Nanos(0),
            moved: false,
        }
    }

    /// The newest frame; `None` until started.
    pub fn newest(&self) -> Option<&Frame> {
        self.graph.window.newest().map(|slot| self.graph.window.frame(slot))
    }

    /// Forgets everything but what was learnt of the rig.
    pub fn clear(&mut self) {
        self.graph.clear();
        self.moved = false;
        self.rejected.clear();
        self.height_deviation = None;
        self.heights.iter_mut().for_each(Heights::forget_bias);
    }

    /// First frame of an empty window.
    pub fn start(&mut self, tracks: &Tracks, start: &Start, imu: &ImuRing) -> Step {
        let slot = self.begin(tracks, &start.motion, imu);
        self.believe(slot, &start.sigma, [start.motion.bg, start.motion.ba]);
        let landmarks_full = self.make_keyframe(slot).unwrap_or(0);
        Step {
            keyframe: true,
            connected: self.graph.landmarks.pool.len(),
            landmarks_full,
            covariance: Some(start.sigma.covariance(&start.motion)),
            ..Step::default()
        }
    }

    /// Puts a frame into an empty window; answers its slot.
    fn begin(&mut self, tracks: &Tracks, motion: &Motion, imu: &ImuRing) -> usize {
        let mut frame = Frame::new(tracks.t, *motion);
        frame.rate = imu.rate_at(tracks.t);
        frame.hold_twist();
        let slot = self.graph.window.push(frame).expect("an empty window has room");
        self.tracks[slot].clone_from(tracks);
        slot
    }

    /// Begins the prior with what is known of the only frame it is about, and of the rig.
    fn believe(&mut self, slot: usize, sigma: &MotionSigma, biases: [DVec3; 2]) {
        let Graph { window, prior, .. } = &mut self.graph;
        window.frame_mut(slot).fix_linearization_point();
        window.rig.fix_linearization_point();
        self.rig_deviations = window.rig.sigmas(&self.model.config);
        prior.start(slot, &window.frame(slot).now, sigma, biases, window, &self.rig_deviations);
    }

    /// All frames of an empty window at once, the first of them moving as `first` says. The prior knows next to
    /// nothing: what is known afterwards is what the views and the inertial samples say, each once. Answers the start
    /// that the newest would be, too. `None` where views and samples disagree or do not tell the speed; then the
    /// window is empty again.
    pub fn start_in_motion(&mut self, frames: &[Tracks], first: &Motion, imu: &ImuRing) -> Option<(Start, Step)> {
        let rig = self.graph.window.rig.now;
        let mut step = self.fill(frames, first, imu);
        if !self.knows_speed(&step) {
            self.clear();
            self.forget_rig(rig);
            return None;
        }
        let motion = self.newest()?.now;
        let sigma = deviations(&motion, step.covariance.as_ref()?);
        let sigma = MotionSigma { p: GAUGE_SIGMA, yaw: GAUGE_SIGMA, ..sigma };
        step.columns_lost = (0..frames.len()).map(|_| self.marginalize()).sum();
        Some((Start { motion, sigma }, step))
    }

    /// Takes the rig back to what it was, for a prior that begins anew.
    fn forget_rig(&mut self, before: RigParameters) {
        self.graph.window.rig.now = before;
        self.graph.window.rig.release();
    }

    /// Fills an empty window with the frames of an alignment and optimizes it.
    fn fill(&mut self, frames: &[Tracks], first: &Motion, imu: &ImuRing) -> Step {
        let rig = self.graph.window.rig.now;
        let oldest = self.begin(&frames[0], first, imu);
        self.graph.window.frame_mut(oldest).doubted = true;
        let mut slot = oldest;
        for tracks in &frames[1..] {
            let frame = Frame { doubted: true, ..self.propagated(slot, tracks.t, imu) };
            slot = self.graph.window.push(frame).expect("room for the frames of an alignment");
            self.tracks[slot].clone_from(tracks);
        }
        let mut step = Step { keyframe: true, ..Step::default() };
        let px_max = self.outlier_px(slot);
        self.graph.window.hold_twists();
        for i in (0..frames.len()).rev() {
            let slot = self.graph.window.order[i] as usize;
            let (made, full) =
                triangulate(&mut self.graph, slot, &self.tracks, &self.model, px_max * ALIGNED_OUTLIERS[0]);
            let frame = self.graph.window.frame_mut(slot);
            (frame.keyframe, frame.hosted) = (true, made);
            step.landmarks_full += full;
        }
        let VioConfig { gyro_bias_sigma: bg, accel_bias_sigma: ba, .. } = self.model.config;
        let sigma = MotionSigma { p: GAUGE_SIGMA, tilt: TILT_UNKNOWN, yaw: GAUGE_SIGMA, v: V_UNKNOWN, bg, ba };
        for factor in ALIGNED_OUTLIERS {
            // Linearized anew where the last optimization led, the biases still expected to be none.
            self.graph.window.frame_mut(oldest).linearization_point = None;
            self.forget_rig(rig);
            self.believe(oldest, &sigma, [DVec3::ZERO; 2]);
            step.outcome = self.solver.optimize(&mut self.graph, &self.model);
            step.outliers += drop_outliers(&mut self.graph, px_max * factor, slot, &mut self.rejected);
        }
        step.covariance = self.solver.newest_covariance();
        step.connected = self.graph.landmarks.pool.iter().filter(|l| l.views_in(slot) > 0).count();
        (self.keyframe_at, self.moved) = (frames[frames.len() - 1].t, true);
        step
    }

    /// Whether the views of an alignment agree with the samples and tell the speed.
    fn knows_speed(&self, step: &Step) -> bool {
        let (Some(frame), Some(covariance)) = (self.newest(), &step.covariance) else { return false };
        let (speed, sigma) = (frame.now.v.length(), body_velocity_sigma(covariance, &frame.now));
        let views: usize = self.graph.landmarks.pool.iter().map(|l| l.observations.len()).sum();
        let unknown = 3 * self.graph.landmarks.pool.len() + 15;
        let misfit = 2.0 * self.graph.cost(&self.model) / (2 * views).saturating_sub(unknown).max(1) as f64;
        self.is_sane() && sigma < SPEED_KNOWN * speed && misfit < MISFIT_MAX && step.connected >= RESECTION_MIN
    }

    /// One more frame of a window that has some. `covariance` is that of the newest state so far, which the gate
    /// needs; `doubted` says that something speaks against the estimate.
    pub fn advance(&mut self, tracks: &Tracks, imu: &ImuRing, covariance: Option<&Covariance>, doubted: bool) -> Step {
        let before = self.graph.window.newest().expect("a started window has frames");
        self.rejected.clear();
        let (slot, mut step) = self.enter(before, tracks, imu, covariance);
        self.graph.window.frame_mut(slot).doubted = step.gate.open || doubted;
        if step.keyframe {
            let made = self.make_keyframe(slot);
            (step.keyframe, step.landmarks_full) = (made.is_some(), made.unwrap_or(0));
        }

        if let Some(heights) = &mut self.heights {
            step.heights = heights.attach(&mut self.graph.window);
        }
        self.solve(&mut step);
        self.height_deviation = self.heights.as_ref().and_then(|_| self.solver.newest_height_deviation());
        let views = self.graph.landmarks.views_in(slot);
        let n = self.graph.window.rig.dim();
        if step.keyframe && n > 0 {
            self.solver.rig_deviations(&mut self.rig_deviations[..n]);
        }
        let px_max = self.outlier_px(slot);
        step.outliers = drop_outliers(&mut self.graph, px_max, slot, &mut self.rejected);
        let evidence = self.evidence(before, slot, views, step.at_rest);
        if views > 0 && (evidence.inliers as f64) < MISLED * views as f64 {
            self.solve(&mut step);
        }
        step.evidence = Some(evidence);
        step.columns_lost = self.marginalize();
        step
    }

    /// Optimizes the window; adds what that took to `step`.
    fn solve(&mut self, step: &mut Step) {
        let Outcome { iterations, failures, rejected } = self.solver.optimize(&mut self.graph, &self.model);
        step.outcome.iterations += iterations;
        step.outcome.failures += failures;
        step.outcome.rejected += rejected;
        step.covariance = self.solver.newest_covariance();
    }

    /// The frame after that in slot `before`, where inertia puts it.
    pub fn propagated(&self, before: usize, t: Nanos, imu: &ImuRing) -> Frame {
        let (from, rig) = (self.graph.window.frame(before), &self.graph.window.rig.now);
        let inc = imu.integrate(from.t, t, from.now.bg, from.now.ba, &self.model.noise);
        let mut frame = Frame::new(t, from.now.propagate(&inc.rescaled(rig.gyro_scale, rig.accel_scale)));
        frame.weight = InertialWeight::new(&inc, &self.model.noise);
        frame.increment = inc;
        frame.rate = imu.rate_at(t);
        if let Some(heights) = &self.heights {
            frame.height_bias = self.graph.window.frame(before).height_bias;
            frame.height_walk = heights.walk_weight(frame.increment.dt);
        }
        frame
    }

    /// Takes a frame into the window; answers its slot, and whether it is to be a keyframe.
    pub fn enter(
        &mut self,
        before: usize,
        tracks: &Tracks,
        imu: &ImuRing,
        covariance: Option<&Covariance>,
    ) -> (usize, Step) {
        let mut step = Step::default();
        let frame = self.propagated(before, tracks.t, imu);
        step.inertia_lost = frame.weight.is_nothing();
        let slot = self.graph.window.push(frame).expect("marginalization left room for one frame");
        self.graph.window.hold_twists();
        self.tracks[slot].clone_from(tracks);
        if let Some(covariance) = covariance {
            let p = predicted_covariance(&self.graph.window, slot, covariance);
            let config = &self.model.config;
            // Wider while the rig is not known well.
            let sigma_px = config.observation_sigma_px + self.outlier_px(slot) - config.outlier_px;
            step.gate = gate(&self.graph, slot, &mut self.tracks[slot], &p, sigma_px, &mut self.rejected);
        }
        if self.model.config.zero_velocity {
            step.at_rest = zero_velocity::hold(slot, &mut self.graph.window, &self.tracks, imu);
        }
        (step.connected, step.unconnected) = self.graph.landmarks.attach(slot, &self.tracks[slot]);
        // At rest there is no parallax to triangulate by: once there was motion, a keyframe would push out one that has some.
        self.moved |= !step.at_rest && self.graph.window.frame(slot).now.v.length() > MOVING;
        let due = self.is_keyframe_due(tracks.t, step.connected, step.unconnected);
        step.keyframe = due && !(step.at_rest && self.moved);
        (slot, step)
    }

    fn is_keyframe_due(&self, t: Nanos, connected: usize, unconnected: usize) -> bool {
        let config = &self.model.config;
        let fraction = connected as f64 / (connected + unconnected).max(1) as f64;
        let gap = (t - self.keyframe_at).secs();
        let due = fraction < config.keyframe_connected_min && gap > config.keyframe_gap_min_s;
        unconnected > 0 && (due || connected < CONNECTED_FEW)
    }

    /// Triangulates what the frame in `slot` sees and declares it a keyframe; answers how many landmarks had no room. `None` when
    /// it is none, since all it would do is push out the keyframe that its points wait to move away from.
    pub fn make_keyframe(&mut self, slot: usize) -> Option<usize> {
        let px_max = self.outlier_px(slot);
        let (made, full) = triangulate(&mut self.graph, slot, &self.tracks, &self.model, px_max);
        if made + full == 0 && self.waits_for_baseline(slot) {
            return None;
        }
        let frame = self.graph.window.frame_mut(slot);
        self.keyframe_at = frame.t;
        (frame.keyframe, frame.hosted) = (true, made);
        Some(full)
    }

    /// Whether most points of the frame in `slot` are in the newest keyframe too.
    fn waits_for_baseline(&self, slot: usize) -> bool {
        let window = &self.graph.window;
        let Some(keyframe) = window.slots().rev().find(|s| window.frame(*s).keyframe) else { return false };
        let seen = || self.tracks[slot].cameras.iter().flat_map(|c| c.iter());
        let both = seen().filter(|t| (0..CAMERAS_MAX).any(|c| self.tracks[keyframe].find(c, t.id).is_some())).count();
        2 * both > seen().count()
    }

    /// Distance from its prediction at which a view is wrong, px: wider while the rig is not known well.
    fn outlier_px(&self, slot: usize) -> f64 {
        let (rig, sigma) = (&self.graph.window.rig, &self.rig_deviations);
        let cameras = &self.model.cameras;
        let focal = cameras.iter().fold(0.0f64, |f, c| f.max(c.camera.fx));
        let most = |m: f64, i: usize| m.max(sigma[i]);
        let times = (0..cameras.len()).filter_map(|c| rig.time_column(c));
        let time = times.fold(0.0, most) * self.graph.window.frame(slot).twist.w.length();
        let thetas = (0..cameras.len()).filter_map(|c| rig.extrinsic_column(c)).flat_map(|at| at + 3..at + 6);
        let rotation = thetas.fold(0.0, most);
        self.model.config.outlier_px + RIG_SIGMAS * focal * (time + rotation)
    }

    /// Evidence for the monitor; `views` of the frame there were before outliers were dropped.
    fn evidence(&self, before: usize, slot: usize, views: usize, at_rest: bool) -> Evidence {
        let known =
            self.graph.landmarks.pool.iter().filter(|l| l.host as usize != slot).map(|l| l.views_in(slot)).sum();
        Evidence {
            t: self.graph.window.frame(slot).t,
            dt: (self.graph.window.frame(slot).t - self.graph.window.frame(before).t).secs(),
            views,
            inliers: self.graph.landmarks.views_in(slot),
            known,
            at_rest,
            misfit: inertial_residual_at(&self.graph.window, before, slot).norm_squared() / 15.0,
        }
    }

    /// Brings the window back to its resting size; answers how many columns were not finite and are lost.
    pub fn marginalize(&mut self) -> u64 {
        self.marginalizer.marginalize(&mut self.graph, &mut self.solver.rows, &self.model)
    }

    /// Whether the newest state is finite, and one that flies.
    pub fn is_sane(&self) -> bool {
        self.newest().is_some_and(|f| {
            let m = &f.now;
            self.graph.window.rig.is_sane()
                && m.is_finite()
                && m.v.length() < SPEED_MAX
                && m.ba.length() < ACCEL_BIAS_MAX
                && m.bg.length() < GYRO_BIAS_MAX
        })
    }
}
