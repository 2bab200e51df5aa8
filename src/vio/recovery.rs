//! Recovery after a reset: a restart resumes from the last estimate nothing spoke against, carried on by inertia.
//!
//! Vision or inertia go wrong some frames before it shows, so after a disagreement it is an estimate of
//! `LAG` before the first doubt that a restart resumes from. While nothing speaks against the inertial samples either
//! (no frame came, nothing was seen) the carried pose is the best there is, and its covariance, propagated with it,
//! says how good. Where a restart finds another velocity than the carried state expects, inertia was wrong meanwhile: the
//! trusted pose is kept as it was, widened by how far the rig may have come since; so is the first pose of a start that
//! was given up before anything was trusted, and the trusted pose before a gap in the samples. Down is carried by the gyro
//! alone; a restart that finds another one, for some seconds, is refused, for its accelerometer is wrong.

use super::health::Reset;
use super::inertial::{Covariance, Mat15, Motion, MotionSigma};
use super::initialization::{Start, GAUGE_SIGMA};
use super::preintegration::{Increment, Noise};
use super::samples::ImuRing;
use super::FRAME_GAP_MAX;
use crate::math::block::{put, vector};
use crate::math::so3;
use glam::{DMat3, DQuat, DVec3};
use nalgebra::{Matrix3, SMatrix};
use stipple_drivers::{Nanos, Pose, Span};

/// An estimate is confirmed when nothing spoke against it for this long, s. Less than the ring of samples holds.
const LAG: f64 = 0.4;
/// Time after the trusted estimate for which its down is better than a restart's that contradicts it, s.
const DOWN_HOLDS: f64 = 5.0;
/// Samples are integrated this long after they came, s: the ring of samples need not hold a whole outage, and
/// no frame is that late.
const DELAY: f64 = 0.2;
/// How fast an estimator that is down assumes to move at least, m/s, and to rotate, rad/s.
const SPEED_UNSEEN: f64 = 0.5;
const RATE_UNSEEN: f64 = 0.5;
/// Squared distances beyond which a restart contradicts the carried state: three and two dimensions, 99.9 %.
const VELOCITY_GATE: f64 = 16.3;
const TILT_GATE: f64 = 13.8;
/// A restart this unsure of its velocity, m/s, cannot vouch for the inertial samples.
const VOUCHING_V: f64 = 0.3;

/// Keeps what a restart resumes from.
#[derive(Clone, Copy, Debug, Default)]
pub struct Recovery {
    newest: Option<TrustedState>,
    /// Waits for `LAG`, then is the confirmed one.
    candidate: Option<TrustedState>,
    confirmed: Option<TrustedState>,
    /// The last start, or what was trusted on another clock or before a gap in the samples: where a restart begins while
    /// nothing is trusted.
    started: Option<DeadReckoning>,
    /// Something was wrong before a reset, and nothing was trusted since.
    suspect: bool,
    /// The last restart was not where dead reckoning had led.
    jumped: bool,
    origin: Origin,
}

impl Recovery {
    /// An estimate nothing speaks against.
    pub fn trust(&mut self, t: Nanos, motion: &Motion, covariance: &Covariance) {
        self.suspect = false;
        let then = DeadReckoning::new(t, motion, covariance);
        let newest = TrustedState { then, carried: then };
        match &self.candidate {
            Some(c) if (t - c.then.t).secs() < LAG => {}
            waited => (self.confirmed, self.candidate) = (waited.or(self.confirmed), Some(newest)),
        }
        self.newest = Some(newest);
    }

    /// Something speaks against the newest estimate.
    pub fn invalidate(&mut self) {
        self.candidate = None;
    }

    /// Why the estimate is given up, and a restart will be needed.
    pub fn reset(&mut self, why: Reset) {
        self.suspect |= matches!(why, Reset::Disagreement | Reset::State);
    }

    /// Carries what was trusted past a gap in the samples, or over to a clock that is `by` ahead. No samples lead on from
    /// there.
    pub fn interrupt(&mut self, by: Span) {
        let from = self.trusted().map(|trusted| trusted.then).or(self.started);
        let started = from.map(|from| DeadReckoning { t: from.t + by, ..from });
        *self = Recovery { started, suspect: self.suspect, origin: self.origin, ..Recovery::default() };
    }

    /// Whether an estimate was given up because samples or estimate were wrong, and none was trusted since: they may have
    /// been wrong for some time before that, and may be still.
    pub fn is_suspect(&self) -> bool {
        self.suspect
    }

    /// Carries on as time passes.
    pub fn propagate(&mut self, now: Nanos, imu: &ImuRing, noise: &Noise) {
        let t = now - Span::from_secs(DELAY);
        for trusted in [&mut self.newest, &mut self.confirmed].into_iter().flatten() {
            if (t - trusted.carried.t).secs() > 0.5 * DELAY {
                trusted.carried.advance(t, imu, noise);
            }
        }
    }

    /// A restart at `t` in the world of before: position and yaw as trusted, the rest of `start`; what is not known of
    /// the two is kept apart for `in_world`. `None` while the start cannot be true.
    pub fn resume(&mut self, start: &Start, t: Nanos, imu: &ImuRing, noise: &Noise) -> Option<Start> {
        let suspect = self.is_suspect();
        self.candidate = None;
        let resumed = match (self.trusted(), &self.started) {
            (Some(mut from), _) => from.resume(start, suspect, t, imu, noise),
            (None, Some(from)) => Some((from.widened(start, t), false)),
            (None, None) => Some((*start, false)),
        };
        resumed.map(|(mut start, jumped)| {
            self.jumped = jumped;
            self.started = Some(DeadReckoning::new(t, &start.motion, &start.sigma.covariance(&start.motion)));
            self.origin = Origin::split(&mut start);
            start
        })
    }

    /// Whether there is nothing yet that a restart would resume from.
    pub fn is_first(&self) -> bool {
        self.trusted().is_none() && self.started.is_none()
    }

    /// Whether the last restart was not where dead reckoning had led.
    pub fn jumped(&self) -> bool {
        self.jumped
    }

    /// After a reset, what a restart would resume from, carried to `t`, and its covariance. `None` where nothing was
    /// trusted before, nothing finite came of it, or no sample came for `FRAME_GAP_MAX`.
    pub fn dead_reckoned(&self, t: Nanos, imu: &ImuRing, noise: &Noise) -> Option<(Motion, Covariance)> {
        imu.newest().filter(|n| (t - n.t).secs() <= FRAME_GAP_MAX)?;
        let mut carried = self.trusted()?.carried;
        carried.advance(t, imu, noise);
        carried.covariance().map(|covariance| (carried.motion, covariance))
    }

    fn trusted(&self) -> Option<TrustedState> {
        if self.is_suspect() {
            self.confirmed
        } else {
            self.newest.or(self.confirmed)
        }
    }

    /// The covariance, in the world of before, of a motion whose errors since the restart have covariance `c`.
    pub fn in_world(&self, c: Covariance, motion: &Motion) -> Covariance {
        self.origin.add_to(c, motion)
    }
}

/// What a restart does not know of where it is in the world of before: position and yaw, which no sensor
/// observes. Apart from the window's covariance, whose precision it would cost, it is what it was at the
/// start and is added.
#[derive(Clone, Copy, Debug, Default)]
struct Origin {
    p: DVec3,
    sigma_p: f64,
    sigma_yaw: f64,
}

impl Origin {
    /// Takes its share out of the deviations of a start.
    fn split(start: &mut Start) -> Origin {
        let apart = |sigma: &mut f64| {
            let rest = (sigma.powi(2) - GAUGE_SIGMA.powi(2)).max(0.0).sqrt();
            *sigma = sigma.min(GAUGE_SIGMA);
            rest
        };
        let p = start.motion.pose.p;
        Origin { p, sigma_p: apart(&mut start.sigma.p), sigma_yaw: apart(&mut start.sigma.yaw) }
    }

    fn add_to(&self, mut c: Covariance, motion: &Motion) -> Covariance {
        let d_yaw =
            [DVec3::Z.cross(motion.pose.p - self.p), motion.pose.q.conjugate() * DVec3::Z, DVec3::Z.cross(motion.v)];
        for i in 0..9 {
            c[i][i] += if i < 3 { self.sigma_p.powi(2) } else { 0.0 };
            for j in 0..9 {
                c[i][j] += d_yaw[i / 3][i % 3] * d_yaw[j / 3][j % 3] * self.sigma_yaw.powi(2);
            }
        }
        c
    }
}

/// An estimate nothing spoke against, as it was and as inertia carries it on.
#[derive(Clone, Copy, Debug)]
struct TrustedState {
    then: DeadReckoning,
    carried: DeadReckoning,
}

impl TrustedState {
    /// The start, and whether it lies elsewhere than dead reckoning led.
    fn resume(
        &mut self,
        start: &Start,
        suspect: bool,
        t: Nanos,
        imu: &ImuRing,
        noise: &Noise,
    ) -> Option<(Start, bool)> {
        let TrustedState { then, carried } = self;
        carried.advance(t, imu, noise);
        let away = (t - then.t).secs();
        let mut sigma = start.sigma;
        if !suspect && sigma.v > carried.sigma(6) {
            // Dead reckoning knows the motion better than a start that does not see it.
            return Some((Start { motion: carried.motion, sigma: carried.sigmas() }, false));
        }
        let moved = in_world_of(&carried.motion.pose, &start.motion);
        if away < DOWN_HOLDS && !carried.expects_down(&moved, &sigma) {
            return None;
        }
        if carried.expects_velocity(&moved, &sigma) && (!suspect || sigma.v < VOUCHING_V) {
            sigma.p = sigma.p.hypot(carried.sigma(0));
            sigma.yaw = sigma.yaw.hypot(carried.about_world_axis(DVec3::Z));
            return Some((Start { motion: moved, sigma }, false));
        }
        Some((then.widened(start, t), true))
    }
}

/// `start` with the position and the yaw of `pose`.
fn in_world_of(pose: &Pose, start: &Motion) -> Motion {
    let rotation = pose.q * start.pose.q.conjugate();
    // The part of it about the world's axis; none is left when it is half a turn about a level axis.
    let twist = DQuat::from_xyzw(0.0, 0.0, rotation.z, rotation.w);
    let twist = if twist.length_squared() > 1e-12 { twist.normalize() } else { DQuat::IDENTITY };
    Motion { pose: Pose::new(twist * start.pose.q, pose.p), v: twist * start.v, ..*start }
}

/// A motion carried on by inertial samples, and its covariance, errors [p, θ, v, bg, ba].
#[derive(Clone, Copy, Debug)]
pub struct DeadReckoning {
    pub t: Nanos,
    pub motion: Motion,
    pub covariance: Mat15,
}

/// Standard deviations of a motion, each along the axis on which it is largest.
pub fn deviations(motion: &Motion, covariance: &Covariance) -> MotionSigma {
    DeadReckoning::new(Nanos(0), motion, covariance).sigmas()
}

/// Derivative of the motion after an increment to the motion before it.
fn transition(from: &Motion, inc: &Increment) -> Mat15 {
    let (dp, dq, dv) = inc.corrected(from.bg, from.ba);
    let r = from.pose.rotation();
    let mut f = Mat15::identity();
    put(&mut f, 0, 3, r * so3::hat(dp) * -1.0);
    put(&mut f, 0, 6, DMat3::IDENTITY * inc.dt);
    put(&mut f, 0, 9, r * inc.d_p_bg());
    put(&mut f, 0, 12, r * inc.d_p_ba());
    put(&mut f, 3, 3, DMat3::from_quat(dq.conjugate()));
    put(&mut f, 3, 9, inc.d_q_bg());
    put(&mut f, 6, 3, r * so3::hat(dv) * -1.0);
    put(&mut f, 6, 9, r * inc.d_v_bg());
    put(&mut f, 6, 12, r * inc.d_v_ba());
    f
}

impl DeadReckoning {
    pub fn new(t: Nanos, motion: &Motion, covariance: &Covariance) -> DeadReckoning {
        DeadReckoning { t, motion: *motion, covariance: Mat15::from_fn(|i, j| covariance[i][j]) }
    }

    /// Its covariance; `None` where motion or covariance is not finite.
    pub fn covariance(&self) -> Option<Covariance> {
        let finite = self.motion.is_finite() && self.covariance.iter().all(|c| c.is_finite());
        finite.then(|| std::array::from_fn(|i| std::array::from_fn(|j| self.covariance[(i, j)])))
    }

    /// Carries it on to `t`; an instant that is not later changes nothing.
    pub fn advance(&mut self, t: Nanos, imu: &ImuRing, noise: &Noise) {
        if t <= self.t {
            return;
        }
        let from = self.motion;
        let inc = imu.integrate_scaled(self.t, t, from.bg, from.ba, noise);
        let f = transition(&from, &inc);
        let mut p = f * self.covariance * f.transpose();
        // Increment errors are in the first body frame, but for the rotation's, which is on the right.
        let r = from.pose.rotation();
        let mut to_world = SMatrix::<f64, 9, 9>::identity();
        put(&mut to_world, 0, 0, r);
        put(&mut to_world, 6, 6, r);
        let added = to_world * inc.covariance * to_world.transpose();
        for i in 0..9 {
            for j in 0..9 {
                p[(i, j)] += added[(i, j)];
            }
        }
        for i in 0..3 {
            p[(9 + i, 9 + i)] += noise.gyro_walk * noise.gyro_walk * inc.dt;
            p[(12 + i, 12 + i)] += noise.accel_walk * noise.accel_walk * inc.dt;
        }
        (self.t, self.motion, self.covariance) = (t, from.propagate(&inc), p);
    }

    /// A start at this pose, as uncertain as the rig may have come by `t`.
    fn widened(&self, start: &Start, t: Nanos) -> Start {
        let (motion, mut sigma) = (in_world_of(&self.motion.pose, &start.motion), start.sigma);
        let away = (t - self.t).secs();
        let speed = self.motion.v.length().max(motion.v.length()).max(SPEED_UNSEEN);
        sigma.p += self.sigma(0) + speed * away;
        // Beyond half a turn a yaw is no more unknown.
        let yaw = sigma.yaw + self.about_world_axis(DVec3::Z) + RATE_UNSEEN * away;
        sigma.yaw = yaw.min(std::f64::consts::PI);
        Start { motion, sigma }
    }

    fn block(&self, at: usize) -> Matrix3<f64> {
        self.covariance.fixed_view::<3, 3>(at, at).into_owned()
    }

    /// Standard deviation of the three errors from `at`, along the axis on which it is largest.
    fn sigma(&self, at: usize) -> f64 {
        self.block(at).symmetric_eigenvalues().max().max(0.0).sqrt()
    }

    fn sigmas(&self) -> MotionSigma {
        let [x, y, yaw] = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| self.about_world_axis(axis));
        let [p, v, bg, ba] = [0, 6, 9, 12].map(|at| self.sigma(at));
        MotionSigma { p, tilt: x.max(y), yaw, v, bg, ba }
    }

    fn about_world_axis(&self, axis: DVec3) -> f64 {
        let a = vector(self.motion.pose.q.conjugate() * axis);
        a.dot(&(self.block(3) * a)).max(0.0).sqrt()
    }

    /// Whether a restart's velocity is what this leads one to expect.
    fn expects_velocity(&self, start: &Motion, sigma: &MotionSigma) -> bool {
        let dv = vector(start.v - self.motion.v);
        let spread = self.block(6) + Matrix3::identity() * (sigma.v * sigma.v);
        spread.cholesky().is_some_and(|factor| dv.dot(&factor.solve(&dv)) < VELOCITY_GATE)
    }

    /// Whether a restart's down is.
    fn expects_down(&self, start: &Motion, sigma: &MotionSigma) -> bool {
        let tilt = (self.motion.pose.q.conjugate() * DVec3::Z).angle_between(start.pose.q.conjugate() * DVec3::Z);
        let [x, y] = [DVec3::X, DVec3::Y].map(|axis| self.about_world_axis(axis));
        tilt * tilt < TILT_GATE * (x.max(y).powi(2) + sigma.tilt * sigma.tilt)
    }
}

#[cfg(test)]
mod tests {
    use super::super::world::{Path, World, RATE_HZ};
    use super::*;
    use crate::config::VioConfig;

    #[test]
    fn origin_rotates_and_translates_what_is_seen_from_it() {
        let motion = Motion { pose: Path { rest: -1.0 }.pose(0.4), v: DVec3::new(1.0, 2.0, 3.0), ..Motion::default() };
        let sigma = MotionSigma { p: 0.5, yaw: 0.2, tilt: 0.1, v: 0.3, bg: 0.1, ba: 0.1 };
        let mut start = Start { motion: Motion::default(), sigma };
        let origin = Origin::split(&mut start);
        let c = origin.add_to([[0.0; 15]; 15], &motion);
        // A rotation of the world by a small angle moves the motion by these errors.
        const H: f64 = 1e-6;
        let rotation = DQuat::from_rotation_z(H);
        let th = so3::log(motion.pose.q.conjugate() * rotation * motion.pose.q);
        let d = [rotation * motion.pose.p - motion.pose.p, th, rotation * motion.v - motion.v].map(|x| x / H);
        for i in 0..9 {
            for j in 0..9 {
                let translation = if i == j && i < 3 { 0.25 } else { 0.0 };
                let expected = translation + 0.04 * d[i / 3][i % 3] * d[j / 3][j % 3];
                assert!((c[i][j] - expected).abs() < 1e-5 * (1.0 + expected.abs()), "{i} {j}: {} {expected}", c[i][j]);
            }
        }
        assert!(start.sigma.p == GAUGE_SIGMA && start.sigma.yaw == GAUGE_SIGMA && start.sigma.v == 0.3);
    }

    #[test]
    fn transition_matches_differences_of_the_propagation() {
        let mut world = World::new(Path { rest: -1.0 });
        let mut ring = ImuRing::new(RATE_HZ);
        for i in 0..100 {
            ring.push(world.imu(i as f64 / RATE_HZ));
        }
        let noise = Noise::new(&world.rig.imu, &VioConfig::default());
        let from = Motion {
            pose: Path { rest: -1.0 }.pose(0.1),
            v: DVec3::new(0.3, -0.5, 0.2),
            bg: DVec3::new(0.01, -0.02, 0.03),
            ba: DVec3::new(0.1, 0.2, -0.1),
        };
        let inc = ring.integrate(Nanos(100_000_000), Nanos(350_000_000), from.bg, from.ba, &noise);
        let (f, after) = (transition(&from, &inc), from.propagate(&inc));
        const H: f64 = 1e-6;
        for i in 0..15 {
            let moved = |h: f64| {
                let mut d = [0.0; 15];
                d[i] = h;
                let m = from.plus(&d).propagate(&inc);
                let th = so3::log(after.pose.q.conjugate() * m.pose.q);
                [m.pose.p - after.pose.p, th, m.v - after.v, m.bg - after.bg, m.ba - after.ba]
            };
            let (a, b) = (moved(H), moved(-H));
            for j in 0..15 {
                let numeric = (a[j / 3][j % 3] - b[j / 3][j % 3]) / (2.0 * H);
                assert!((f[(j, i)] - numeric).abs() < 1e-6, "error {j} to {i}: {} {numeric}", f[(j, i)]);
            }
        }
    }
}
