//! What is wrong, one bit a reason; how good the estimate is; and when it is no longer to be trusted.

use super::marginalise::Sigma;
use super::residuals::Motion;
use super::Odometry;
use glam::DQuat;
use stipple_drivers::{Nanos, Pose};

/// What a frame suffered from, as bits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Health(pub u32);

impl Health {
    /// No odometry yet, or again.
    pub const INITIALISING: Health = Health(1);
    /// No camera tracked anything.
    pub const NO_TRACKS: Health = Health(1 << 1);
    pub const FEW_LANDMARKS: Health = Health(1 << 2);
    /// Inertial samples are missing since the last frame.
    pub const IMU_GAP: Health = Health(1 << 3);
    pub const IMU_SATURATED: Health = Health(1 << 4);
    pub const IMU_REJECTED: Health = Health(1 << 5);
    /// A step of the solver was not finite.
    pub const SOLVER_FAILED: Health = Health(1 << 6);
    /// The estimate was given up at this frame.
    pub const DIVERGED_RESET: Health = Health(1 << 7);
    /// At rest, and held there. Not a fault.
    pub const ZERO_VELOCITY: Health = Health(1 << 8);
    /// A camera sees next to nothing while another does.
    pub const ONE_CAMERA_BLIND: Health = Health(1 << 9);

    pub const NAMES: [&str; 10] = [
        "initialising",
        "no_tracks",
        "few_landmarks",
        "imu_gap",
        "imu_saturated",
        "imu_rejected",
        "solver_failed",
        "diverged_reset",
        "zero_velocity",
        "one_camera_blind",
    ];

    pub fn set(&mut self, bits: Health, when: bool) {
        self.0 |= if when { bits.0 } else { 0 };
    }

    pub fn has(self, bits: Health) -> bool {
        self.0 & bits.0 == bits.0
    }

    /// Names of the reasons.
    pub fn reasons(self) -> impl Iterator<Item = &'static str> {
        Health::NAMES.into_iter().enumerate().filter(move |(i, _)| self.0 >> i & 1 == 1).map(|(_, n)| n)
    }
}

/// Landmarks that are enough, and the velocity's standard deviation at which half is lost, m/s.
const LANDMARKS_ENOUGH: f64 = 40.0;
const SIGMA_V_HALF: f64 = 0.1;

/// 0 to 100: `100 min(1, landmarks / 40) / (1 + (σ_v / 0.1 m/s)²)`, with σ_v² the trace of the velocity's
/// covariance. The velocity's and not the position's, because odometry's position error only ever grows;
/// σ_v is by how much it grows each second. Zero without a covariance.
pub fn quality(covariance: Option<&[[f64; 15]; 15]>, landmarks: usize) -> u8 {
    let Some(c) = covariance else { return 0 };
    let variance = c[6][6] + c[7][7] + c[8][8];
    let seen = (landmarks as f64 / LANDMARKS_ENOUGH).min(1.0);
    (100.0 * seen / (1.0 + variance / (SIGMA_V_HALF * SIGMA_V_HALF))).round() as u8
}

/// Fewer of its views than this agree with a frame after optimisation: the frame is suspect.
const INLIERS_MIN: f64 = 0.65;
const VIEWS_MIN: usize = 10;
/// Squared whitened residual of the newest inertial factor, per dimension, that is suspect.
const MISFIT_MAX: f64 = 30.0;
/// This many more suspect frames than others are a divergence: wrong tracks and samples also agree by chance.
const SUSPECT_MAX: u32 = 10;
/// With fewer views than this for longer than this, s, inertia alone carries the estimate too far.
const CARRIED_VIEWS: usize = 4;
const CARRIED_MAX: f64 = 3.0;

/// What a frame looked like after its optimisation.
#[derive(Clone, Copy, Debug)]
pub struct Evidence {
    pub t: Nanos,
    /// Views of landmarks before and after outliers were dropped.
    pub views: usize,
    pub inliers: usize,
    /// Squared whitened inertial residual per dimension.
    pub misfit: f64,
}

#[derive(Clone, Copy, Debug, Default)]
pub struct Watch {
    suspect: u32,
    carried_since: Option<Nanos>,
}

impl Watch {
    /// Whether the estimate has diverged.
    pub fn diverged(&mut self, e: &Evidence) -> bool {
        let disagrees = e.views >= VIEWS_MIN && (e.inliers as f64) < INLIERS_MIN * e.views as f64;
        self.suspect =
            if disagrees || !(e.misfit < MISFIT_MAX) { self.suspect + 1 } else { self.suspect.saturating_sub(1) };
        if e.inliers >= CARRIED_VIEWS {
            self.carried_since = None;
        } else if self.carried_since.is_none() {
            self.carried_since = Some(e.t);
        }
        let carried = self.carried_since.is_some_and(|t| (e.t - t).secs() > CARRIED_MAX);
        self.suspect >= SUSPECT_MAX || carried
    }

    /// Nothing speaks against the newest estimate.
    pub fn trusts(&self) -> bool {
        self.suspect == 0 && self.carried_since.is_none()
    }
}

/// How fast an estimator that is down assumes to move at least, m/s, and to turn, rad/s.
const SPEED_UNSEEN: f64 = 0.5;
const RATE_UNSEEN: f64 = 0.5;

/// The last output nothing spoke against: where a restart goes on.
#[derive(Clone, Copy, Debug)]
pub struct Trusted {
    t: Nanos,
    pub pose: Pose,
    speed: f64,
    /// Standard deviations of position, m, and of yaw, rad.
    sigma_p: f64,
    sigma_yaw: f64,
}

impl Trusted {
    /// Without a covariance, on the first frame of a start, its deviations are those of `before`.
    pub fn at(o: &Odometry, covariance: Option<&[[f64; 15]; 15]>, before: Option<&Trusted>) -> Trusted {
        let sigma = |i: usize| covariance.map(|c| (i..i + 3).map(|k| c[k][k]).sum::<f64>().sqrt());
        Trusted {
            t: o.t,
            pose: o.world_from_body,
            speed: o.v_world.length(),
            sigma_p: sigma(0).or(before.map(|b| b.sigma_p)).unwrap_or(0.0),
            sigma_yaw: sigma(3).or(before.map(|b| b.sigma_yaw)).unwrap_or(0.0),
        }
    }

    /// Position and yaw of the trusted pose, the rest of `start`.
    pub fn go_on(&self, start: &Motion) -> Motion {
        let turn = self.pose.q * start.pose.q.conjugate();
        // The part of the turn about the world's axis; none is left when it is half a turn about a level axis.
        let twist = DQuat::from_xyzw(0.0, 0.0, turn.z, turn.w);
        let twist = if twist.length_squared() > 1e-12 { twist.normalize() } else { DQuat::IDENTITY };
        Motion { pose: Pose::new(twist * start.pose.q, self.pose.p), v: twist * start.v, ..*start }
    }

    /// Adds what may have happened between the trusted pose and a restart at `t`; a yaw beyond half a turn
    /// is no more unknown.
    pub fn widen(&self, t: Nanos, sigma: &mut Sigma) {
        let away = (t - self.t).secs();
        sigma.p += self.sigma_p + self.speed.max(SPEED_UNSEEN) * away;
        sigma.yaw = (sigma.yaw + self.sigma_yaw + RATE_UNSEEN * away).min(std::f64::consts::PI);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(i: i64, views: usize, inliers: usize, misfit: f64) -> Evidence {
        Evidence { t: Nanos(i * 50_000_000), views, inliers, misfit }
    }

    #[test]
    fn each_reason_has_one_bit_and_its_name() {
        let mut h = Health::default();
        h.set(Health::ONE_CAMERA_BLIND, true);
        h.set(Health::IMU_GAP, true);
        h.set(Health::NO_TRACKS, false);
        assert!(h.has(Health::IMU_GAP) && !h.has(Health::NO_TRACKS));
        assert!(h.reasons().eq(["imu_gap", "one_camera_blind"]));
    }

    #[test]
    fn divergence_needs_disagreement_that_lasts() {
        let mut watch = Watch::default();
        assert!((0..100).all(|i| !watch.diverged(&frame(i, 80, if i % 2 == 0 { 70 } else { 5 }, 1.0))));
        let mut watch = Watch::default();
        assert_eq!((0..100).find(|i| watch.diverged(&frame(*i, 80, 5, 1.0))), Some(SUSPECT_MAX as i64 - 1));
        let mut watch = Watch::default();
        assert!((0..100).any(|i| watch.diverged(&frame(i, 80, 80, f64::NAN))) && !watch.trusts());
        let mut watch = Watch::default();
        assert_eq!((0..100).find(|i| watch.diverged(&frame(*i, 0, 0, 1.0))), Some(61));
    }

    #[test]
    fn quality_falls_with_uncertain_velocity_and_with_few_landmarks() {
        let mut c = [[0.0; 15]; 15];
        assert_eq!((quality(None, 90), quality(Some(&c), 90), quality(Some(&c), 10)), (0, 100, 25));
        c[7][7] = SIGMA_V_HALF * SIGMA_V_HALF;
        assert_eq!(quality(Some(&c), 90), 50);
    }
}
