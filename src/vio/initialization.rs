//! The first state: where down is, how fast we move, and the gyro's bias.
//!
//! At rest (quiet samples and still tracks) gravity and gyro bias are means. Otherwise stereo gives
//! metric points at a first frame and, by resection against them, poses of the next half second; the
//! preintegrated increments between these poses are then linear in the first velocity and gravity,
//! and, through rotation, in the gyro bias (Martinelli, IJCV 2014). The poses do not drift, so half
//! a second fixes gravity to well under a degree even while shaken by hand. Points whose stereo parallax
//! is noise have no depth and give no pose: where there are only such, as with one camera, velocity and gravity come of
//! directions alone (`alignment.rs`). Where the motion does not tell how fast it is, gravity is after some time the mean
//! specific force, the velocity is unknown and said to be, and the window must find it.

use super::alignment::Alignment;
use super::inertial::{Motion, MotionSigma};
use super::model::Model;
use super::preintegration::Increment;
use super::reprojection::{huber, Point, Transform, View};
use super::samples::ImuRing;
use super::triangulation::InverseDistance;
use super::zero_velocity::{REST_ACCEL, REST_GYRO, REST_PX};
use crate::config::VioConfig;
use crate::frontend::{Track, Tracks};
use crate::limits::{CAMERAS_MAX, TRACKS};
use crate::math::so3;
use glam::{DMat3, DQuat, DVec2, DVec3};
use nalgebra::{SMatrix, SVector};
use stipple_drivers::{Nanos, Pose, Span};

/// Rest: the unit is quiet for this long, s, and its mean rate is one that a bias can explain, rad/s.
const REST_SPAN: f64 = 0.5;
const REST_GYRO_MEAN: f64 = 0.15;

/// Alignment: span, s, and frames it takes at least and at most.
const ALIGN_SPAN: f64 = 0.45;
const ALIGN_FRAMES_MIN: usize = 6;
const ALIGN_FRAMES_MAX: usize = 64;
/// Least time between two frames of an alignment, s, so that the most of them span `ALIGN_SPAN` at every frame rate.
const ALIGN_SPACING: f64 = ALIGN_SPAN / (ALIGN_FRAMES_MAX - 1) as f64;
/// Points a resection needs.
pub const RESECTION_MIN: usize = 12;
const RESECTION_ITERATIONS: usize = 12;
/// Misfit accepted: of the length of gravity, m/s², and of positions, m.
const GRAVITY_MISFIT: f64 = 1.5;
const POSITION_MISFIT: f64 = 0.05;
/// Rotation noise of one resection, rad: the weight of the gyro bias' prior.
const RESECTION_ROTATION: f64 = 2e-3;
/// Width of Huber's weight of a resection, px; a view three times as far off is no inlier.
const START_HUBER_PX: f64 = 1.0;
/// An inverse distance of this many standard deviations is a measured one.
const DEPTH_SIGNIFICANT: f64 = 3.0;
/// Resections that may fail, and alignments that may contradict each other, before the mean force has to do. The
/// latter are many, some ten seconds, since starting all the same would not mend a contradiction.
const RESECTIONS_FAILED_MAX: u32 = 3;
const ALIGNMENTS_FAILED_MAX: u32 = 20;
/// The mean force: over this long, s; how far from gravity's length it may be, m/s²; and what is then known of
/// tilt, rad, and of velocity, m/s.
const MEAN_SPAN: f64 = 1.0;
const MEAN_FORCE_MISFIT: f64 = 2.5;
const MEAN_FORCE_TILT: f64 = 0.3;
const MEAN_FORCE_V: f64 = 3.0;
/// Lower bounds of the deviations of an alignment in motion: tilt, rad; velocity, m/s; gyro bias, rad/s. The accelerometer's
/// unknown bias sets them.
const ALIGNED_TILT: f64 = 0.05;
const ALIGNED_V: f64 = 0.1;
const ALIGNED_GYRO: f64 = 0.02;
/// Position and yaw are ours to choose; this fixes them, m and rad.
pub const GAUGE_SIGMA: f64 = 1e-4;

/// The first state, and how well it is known.
#[derive(Clone, Copy, Debug)]
pub struct Start {
    pub motion: Motion,
    pub sigma: MotionSigma,
}

/// A track of the reference frame, in the first camera that sees it.
#[derive(Clone, Copy, Debug)]
struct ReferencePoint {
    id: u64,
    camera: usize,
    px: DVec2,
    /// The point, and the relative standard deviation of its inverse distance; `None` where stereo does not measure one.
    point: Option<(Point, f64)>,
}

/// A frame resected against the reference, and the increment that leads to it from the one before.
#[derive(Clone, Copy, Debug)]
struct ResectedFrame {
    t: Nanos,
    reference_from_body: Pose,
    /// Standard deviation of the position along its worst axis, m.
    sigma: f64,
    increment: Increment,
}

/// Looks for a start in the frames it is given.
#[derive(Clone, Debug)]
pub struct Initializer {
    reference: Vec<ReferencePoint>,
    /// The reference frame first.
    frames: Vec<ResectedFrame>,
    resections_failed: u32,
    alignments_failed: u32,
    alignment: Alignment,
}

impl Initializer {
    pub fn new() -> Initializer {
        Initializer {
            reference: Vec::with_capacity(TRACKS * CAMERAS_MAX),
            frames: Vec::with_capacity(ALIGN_FRAMES_MAX),
            resections_failed: 0,
            alignments_failed: 0,
            alignment: Alignment::new(),
        }
    }

    /// Starts over.
    pub fn clear(&mut self) {
        self.reference.clear();
        self.frames.clear();
        (self.resections_failed, self.alignments_failed) = (0, 0);
        self.alignment.clear();
    }

    /// Takes what the cameras saw at one instant, inertial samples up to it known; answers the state of that instant
    /// once a start is found.
    pub fn add(&mut self, tracks: &Tracks, imu: &ImuRing, model: &Model) -> Option<Start> {
        self.alignment.add(tracks);
        let Some(last) = self.frames.last().copied() else {
            self.refer_to(tracks, model);
            return None;
        };
        if let Some(start) = self.at_rest(tracks, imu, &model.config) {
            return Some(start);
        }
        if (tracks.t - last.t).secs() < ALIGN_SPACING {
            return None;
        }
        let increment = imu.integrate_scaled(last.t, tracks.t, DVec3::ZERO, DVec3::ZERO, &model.noise);
        let before = self.frames[self.frames.len().saturating_sub(2)].reference_from_body;
        let last = last.reference_from_body;
        let guess = Pose::new(last.q * increment.q, last.p + (last.p - before.p));
        if let Some((reference_from_body, sigma)) = resect(&self.reference, tracks, model, guess) {
            self.frames.push(ResectedFrame { t: tracks.t, reference_from_body, sigma, increment });
            let (n, span) = (self.frames.len(), (tracks.t - self.frames[0].t).secs());
            if n < ALIGN_FRAMES_MAX && (n < ALIGN_FRAMES_MIN || span < ALIGN_SPAN) {
                return None;
            }
            let start = align(&self.frames, self.scale_sigma(), &model.config);
            if start.is_some() {
                return start;
            }
            self.alignments_failed += 1;
        } else {
            self.resections_failed += 1;
        }
        self.refer_to(tracks, model);
        let exhausted =
            self.resections_failed >= RESECTIONS_FAILED_MAX || self.alignments_failed >= ALIGNMENTS_FAILED_MAX;
        let exhausted = exhausted && (self.has_distances() || self.alignment.is_overdue(tracks.t));
        exhausted.then(|| from_mean_force(tracks.t, imu, model))?
    }

    /// Where stereo measures no distances: the newest frames, oldest first, and the motion of the first of them.
    pub fn align<'a>(&'a mut self, t: Nanos, imu: &ImuRing, model: &Model) -> Option<(&'a [Tracks], Motion)> {
        if self.has_distances() {
            return None;
        }
        self.alignment.solve(t, imu, model)
    }

    /// Whether stereo measures as many distances as a resection needs.
    fn has_distances(&self) -> bool {
        self.reference.iter().filter(|p| p.point.is_some()).count() >= RESECTION_MIN
    }

    /// Relative deviation of all distances together.
    fn scale_sigma(&self) -> f64 {
        let information: f64 = self.reference.iter().filter_map(|s| s.point).map(|(_, r)| 1.0 / (r * r)).sum();
        1.0 / information.max(1.0).sqrt()
    }

    /// Starts over from this frame: its stereo points are the metric reference.
    fn refer_to(&mut self, tracks: &Tracks, model: &Model) {
        self.frames.clear();
        self.frames.push(ResectedFrame {
            t: tracks.t,
            reference_from_body: Pose::IDENTITY,
            sigma: 0.0,
            increment: Increment::new(DVec3::ZERO, DVec3::ZERO),
        });
        self.reference.clear();
        for (camera, list) in tracks.cameras.iter().enumerate() {
            for track in list.iter().filter(|t| (0..camera).all(|c| tracks.find(c, t.id).is_none())) {
                let point = stereo_point(track, camera, tracks, model);
                self.reference.push(ReferencePoint { id: track.id, camera, px: track.px(), point });
            }
        }
    }

    fn at_rest(&self, tracks: &Tracks, imu: &ImuRing, config: &VioConfig) -> Option<Start> {
        let s = imu.statistics(tracks.t, Span::from_secs(REST_SPAN))?;
        let quiet = s.gyro_sigma < REST_GYRO && s.accel_sigma < REST_ACCEL && s.gyro.length() < REST_GYRO_MEAN;
        // By axis, so that noise of both does not add up to a motion.
        let (mut still, mut seen) = ([0, 0], 0);
        for s in &self.reference {
            if let Some(t) = tracks.find(s.camera, s.id) {
                seen += 1;
                still[0] += ((t.px[0] as f64 - s.px.x).abs() < REST_PX) as usize;
                still[1] += ((t.px[1] as f64 - s.px.y).abs() < REST_PX) as usize;
            }
        }
        if !quiet || seen < RESECTION_MIN || still.iter().any(|n| 2 * n < seen) {
            return None;
        }
        let q = DQuat::from_rotation_arc(s.accel.normalize(), DVec3::Z);
        let motion = Motion { pose: Pose::new(q, DVec3::ZERO), bg: s.gyro, ..Motion::default() };
        // The tilt is as good as the unknown accelerometer bias lets it be.
        let tilt = config.accel_bias_sigma / config.gravity;
        Some(Start { motion, sigma: sigma(config, tilt, 0.02, 0.01) })
    }
}

fn sigma(config: &VioConfig, tilt: f64, v: f64, bg: f64) -> MotionSigma {
    let (bg, ba) = (bg.min(config.gyro_bias_sigma), config.accel_bias_sigma);
    MotionSigma { p: GAUGE_SIGMA, tilt, yaw: GAUGE_SIGMA, v, bg, ba }
}

/// A point from the stereo views of one frame, in the camera of `track`, and the relative deviation of its inverse
/// distance; `None` when that is not significant.
fn stereo_point(track: &Track, camera: usize, tracks: &Tracks, model: &Model) -> Option<(Point, f64)> {
    let host = &model.cameras[camera];
    let bearing = host.camera.unproject(track.px())?;
    let mut distance = InverseDistance::default();
    for (c, camera) in model.cameras.iter().enumerate().skip(camera + 1) {
        let Some(seen) = tracks.find(c, track.id) else { continue };
        let seen = camera.camera.unproject(seen.px())?;
        let baseline_min = model.config.triangulation_baseline_min_m;
        distance.add(&host.body_from_cam, bearing, &camera.body_from_cam, seen, baseline_min);
    }
    // Two views, each with the noise of a pixel.
    let sigma_px = std::f64::consts::SQRT_2 * model.config.observation_sigma_px;
    let (rho, sigma) = (distance.rho(), sigma_px / (host.camera.fx * distance.information.sqrt()));
    (rho > DEPTH_SIGNIFICANT * sigma).then(|| (Point::new(bearing, rho), sigma / rho))
}

/// The body's pose from the reference's points, and the deviation of its position along the worst axis:
/// Gauss-Newton with Huber on all cameras' views.
fn resect(points: &[ReferencePoint], tracks: &Tracks, model: &Model, guess: Pose) -> Option<(Pose, f64)> {
    let reference = Transform { r: DMat3::IDENTITY, p: DVec3::ZERO };
    let mut pose = guess;
    let (mut inliers, mut sigma) = (0, 0.0);
    for iteration in 0..RESECTION_ITERATIONS {
        let body = Transform::from(&pose);
        let mut h = SMatrix::<f64, 6, 6>::identity() * 1e-6;
        let mut b = SVector::<f64, 6>::zeros();
        inliers = 0;
        for p in points {
            let Some((point, _)) = &p.point else { continue };
            for (c, camera) in model.cameras.iter().enumerate() {
                let Some(seen) = tracks.find(c, p.id) else { continue };
                let host_cam = &model.cameras[p.camera].body_from_cam;
                let view = View { host_cam, host: &reference, camera, target: &body };
                let Some(r) = view.reproject(point) else { continue };
                let e = r.px - seen.px();
                inliers += (c == p.camera && e.length() < 3.0 * START_HUBER_PX) as usize;
                let (w, _) = huber(e.length(), START_HUBER_PX);
                for (row, e) in [e.x, e.y].into_iter().enumerate() {
                    let j = SVector::<f64, 6>::from_row_slice(&r.d_target[row]);
                    h += j * j.transpose() * w;
                    b += j * (e * w);
                }
            }
        }
        let factor = h.cholesky()?;
        let d = factor.solve(&-b);
        if !d.iter().all(|x| x.is_finite()) {
            return None;
        }
        pose = Pose::new(pose.q * so3::exp(DVec3::new(d[3], d[4], d[5])), pose.p + DVec3::new(d[0], d[1], d[2]));
        if d.norm() < 1e-5 && iteration > 0 || iteration + 1 == RESECTION_ITERATIONS {
            let position = factor.inverse().fixed_view::<3, 3>(0, 0).into_owned();
            sigma = model.config.observation_sigma_px * position.symmetric_eigenvalues().max().max(0.0).sqrt();
            break;
        }
    }
    (inliers >= RESECTION_MIN).then_some((pose, sigma))
}

/// Velocity, gravity and gyro bias from resected poses and the increments between them. `scale_sigma`: how
/// wrong all distances may be together.
fn align(frames: &[ResectedFrame], scale_sigma: f64, config: &VioConfig) -> Option<Start> {
    let ridge = (RESECTION_ROTATION / config.gyro_bias_sigma).powi(2);
    let (mut h, mut b) = (DMat3::IDENTITY * ridge, DVec3::ZERO);
    for k in 1..frames.len() {
        let (from, to) = (&frames[k - 1].reference_from_body, &frames[k]);
        let rotation = from.q.conjugate() * to.reference_from_body.q;
        let j = to.increment.d_q_bg();
        h += j.transpose() * j;
        b += j.transpose() * so3::log(to.increment.q.conjugate() * rotation);
    }
    let bg = h.inverse() * b;

    // p_k = v0 T + ½ g T² + S_k: two unknown vectors, the same scalars on every axis.
    let (mut t, mut s, mut v) = (0.0, DVec3::ZERO, DVec3::ZERO);
    let (mut h, mut b) = ([0.0; 3], [DVec3::ZERO; 2]);
    let mut rows = [(0.0, DVec3::ZERO); ALIGN_FRAMES_MAX];
    for k in 1..frames.len() {
        let inc = &frames[k].increment;
        let (dp, _, dv) = inc.corrected(bg, DVec3::ZERO);
        let q = frames[k - 1].reference_from_body.q;
        s += v * inc.dt + q * dp;
        v += q * dv;
        t += inc.dt;
        let y = frames[k].reference_from_body.p - s;
        let a = [t, 0.5 * t * t];
        h[0] += a[0] * a[0];
        h[1] += a[0] * a[1];
        h[2] += a[1] * a[1];
        b[0] += y * a[0];
        b[1] += y * a[1];
        rows[k] = (t, y);
    }
    let g = (b[1] * h[0] - b[0] * h[1]) / (h[0] * h[2] - h[1] * h[1]);
    if !g.is_finite() || (g.length() - config.gravity).abs() > GRAVITY_MISFIT {
        return None;
    }
    let g = g.normalize() * config.gravity;
    let v0 = (b[0] - g * h[1]) / h[0];
    let misfit =
        rows[1..frames.len()].iter().map(|(t, y)| (*y - v0 * *t - g * (0.5 * t * t)).length_squared()).sum::<f64>();
    let misfit = (misfit / frames.len() as f64).sqrt();
    if !(misfit < POSITION_MISFIT) {
        return None;
    }
    // Deviations of the two unknowns, by that of one position.
    let noise = frames[1..].iter().map(|f| f.sigma).fold(misfit, f64::max);
    let det = h[0] * h[2] - h[1] * h[1];
    let (sigma_g, sigma_v) =
        (noise * (h[0] / det).sqrt(), noise * ((h[2] - 2.0 * t * h[1] + t * t * h[0]) / det).max(0.0).sqrt());
    let world_from_reference = Pose::new(DQuat::from_rotation_arc(-g.normalize(), DVec3::Z), DVec3::ZERO);
    let last = &frames[frames.len() - 1].reference_from_body;
    let motion = Motion {
        pose: world_from_reference * *last,
        v: world_from_reference.q * (v0 + g * t + v),
        bg,
        ba: DVec3::ZERO,
    };
    let tilt = ALIGNED_TILT.hypot(sigma_g / config.gravity);
    let v = ALIGNED_V.hypot(sigma_v).hypot(scale_sigma * motion.v.length());
    Some(Start { motion, sigma: sigma(config, tilt, v, ALIGNED_GYRO) })
}

/// Tilt from the mean specific force of the last second, the rest unknown.
fn from_mean_force(t: Nanos, imu: &ImuRing, model: &Model) -> Option<Start> {
    let span = Span::from_secs(MEAN_SPAN);
    imu.statistics(t, span)?;
    let inc = imu.integrate_scaled(t - span, t, DVec3::ZERO, DVec3::ZERO, &model.noise);
    if (inc.v.length() / inc.dt - model.config.gravity).abs() > MEAN_FORCE_MISFIT {
        return None;
    }
    let up = inc.q.conjugate() * inc.v.try_normalize()?;
    let motion = Motion { pose: Pose::new(DQuat::from_rotation_arc(up, DVec3::Z), DVec3::ZERO), ..Motion::default() };
    Some(Start { motion, sigma: sigma(&model.config, MEAN_FORCE_TILT, MEAN_FORCE_V, model.config.gyro_bias_sigma) })
}
