//! What is wrong, one bit a reason; how good the estimate is; and when it is given up.

use stipple_drivers::Nanos;

/// What a frame suffered from, as bits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Health(pub u32);

impl std::ops::BitOr for Health {
    type Output = Health;
    fn bitor(self, other: Health) -> Health {
        Health(self.0 | other.0)
    }
}

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
    /// Given up at this frame: vision and inertia disagreed for too long.
    pub const DIVERGED_RESET: Health = Health(1 << 7);
    /// At rest, and held there. Not a fault.
    pub const ZERO_VELOCITY: Health = Health(1 << 8);
    /// A camera sees next to nothing while another does.
    pub const ONE_CAMERA_BLIND: Health = Health(1 << 9);
    /// The velocity's standard deviation is above `SIGMA_V_UNOBSERVED`.
    pub const VELOCITY_UNOBSERVED: Health = Health(1 << 10);
    /// Most views of the frame do not fit the estimate.
    pub const VISION_DISAGREES: Health = Health(1 << 11);
    /// The inertial samples since the last frame do not fit the estimate.
    pub const INERTIA_DISAGREES: Health = Health(1 << 12);
    /// Next to nothing known is seen: the pose is dead reckoning.
    pub const INERTIA_ALONE: Health = Health(1 << 13);
    /// Given up at this frame: no frame came for too long.
    pub const FRAME_GAP_RESET: Health = Health(1 << 14);
    /// Given up at this frame: nothing known was seen for too long.
    pub const UNSEEN_RESET: Health = Health(1 << 15);
    /// Given up at this frame: the state was not finite or beyond what flies.
    pub const STATE_RESET: Health = Health(1 << 16);

    pub const NAMES: [&str; 17] = [
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
        "velocity_unobserved",
        "vision_disagrees",
        "inertia_disagrees",
        "inertia_alone",
        "frame_gap_reset",
        "unseen_reset",
        "state_reset",
    ];
    /// Bits of a normal flight.
    pub const NORMAL: Health = Health(Health::INITIALISING.0 | Health::ZERO_VELOCITY.0);

    pub fn set(&mut self, bits: Health, when: bool) {
        self.0 |= if when { bits.0 } else { 0 };
    }

    pub fn has(self, bits: Health) -> bool {
        self.0 & bits.0 == bits.0
    }

    /// Some of the bits.
    pub fn any(self, bits: Health) -> bool {
        self.0 & bits.0 != 0
    }

    /// Names of the reasons.
    pub fn reasons(self) -> impl Iterator<Item = &'static str> {
        Health::NAMES.into_iter().enumerate().filter(move |(i, _)| self.0 >> i & 1 == 1).map(|(_, n)| n)
    }
}

/// Landmarks that are enough, and the velocity's standard deviation at which half is lost, m/s.
const LANDMARKS_ENOUGH: f64 = 40.0;
const SIGMA_V_HALF: f64 = 0.05;

/// 0 to 100: `100 min(1, landmarks / 40) / (1 + σ_v / 0.05 m/s)`, with σ_v² the trace of the velocity's
/// covariance. The velocity's and not the position's, because odometry's position error only ever grows;
/// σ_v is by how much it may grow each second: 5 mm at 91, 5 cm at 50, half a metre at 9. Zero without a
/// covariance. Measured by `stipple-bench consistency` over flights gone wrong, the mean error of the velocity
/// is 1.2 m/s up to 10, 0.16 m/s up to 20, 0.03 m/s up to 65 and 0.01 m/s above: what is claimed, or a third of
/// it. A fault that has not shown yet is in no quality.
pub fn quality(covariance: Option<&[[f64; 15]; 15]>, landmarks: usize) -> u8 {
    let Some(c) = covariance else { return 0 };
    let seen = (landmarks as f64 / LANDMARKS_ENOUGH).min(1.0);
    (100.0 * seen / (1.0 + sigma_v(c) / SIGMA_V_HALF)).round() as u8
}

/// A velocity this uncertain is not one to fly by, m/s: a walk's.
pub const SIGMA_V_UNOBSERVED: f64 = 0.5;

/// Standard deviation of the velocity, m/s, all axes.
pub fn sigma_v(covariance: &[[f64; 15]; 15]) -> f64 {
    (covariance[6][6] + covariance[7][7] + covariance[8][8]).sqrt()
}

/// Why the estimate was given up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reset {
    FrameGap,
    /// Vision and inertia disagreed.
    Disagreement,
    /// Nothing known was seen.
    Unseen,
    /// Not finite, or beyond what flies.
    State,
    /// By the caller.
    Asked,
}

impl Reset {
    pub fn bit(self) -> Health {
        match self {
            Reset::FrameGap => Health::FRAME_GAP_RESET,
            Reset::Disagreement => Health::DIVERGED_RESET,
            Reset::Unseen => Health::UNSEEN_RESET,
            Reset::State => Health::STATE_RESET,
            Reset::Asked => Health::INITIALISING,
        }
    }
}

/// Fewer of its views than this agree with a frame after optimisation: the frame is suspect.
const INLIERS_MIN: f64 = 0.65;
const VIEWS_MIN: usize = 10;
/// Squared whitened residual of the newest inertial factor, per dimension, that is suspect.
const MISFIT_MAX: f64 = 30.0;
/// This many more suspect frames than others are a divergence: wrong tracks and samples also agree by chance.
const SUSPECT_MAX: u32 = 10;
/// With fewer views than this of landmarks it knew for longer than this, s, inertia alone carries the
/// estimate too far.
const CARRIED_VIEWS: usize = 6;
const CARRIED_MAX: f64 = 3.0;
/// Frames that see enough of them end that.
const CARRIED_NO_MORE: u32 = 3;
/// Frames after a start that nothing may speak against before it is trusted: what spoiled the last start
/// may still be there.
const PROBATION: u32 = SUSPECT_MAX;

/// What a frame looked like after its optimisation.
#[derive(Clone, Copy, Debug)]
pub struct Evidence {
    pub t: Nanos,
    /// Views of landmarks before and after outliers were dropped.
    pub views: usize,
    pub inliers: usize,
    /// Of the inliers, those of landmarks that earlier frames saw: a landmark made of this frame alone
    /// says nothing of where it is.
    pub known: usize,
    /// Squared whitened inertial residual per dimension.
    pub misfit: f64,
}

#[derive(Clone, Copy, Debug, Default)]
pub struct Watch {
    frames: u32,
    suspect: u32,
    carried_since: Option<Nanos>,
    /// Frames since then that saw enough landmarks.
    seeing: u32,
    now: Health,
}

impl Watch {
    /// Why the estimate is to be given up, if it is.
    pub fn judge(&mut self, e: &Evidence) -> Option<Reset> {
        let vision = e.views >= VIEWS_MIN && (e.inliers as f64) < INLIERS_MIN * e.views as f64;
        let inertia = !(e.misfit < MISFIT_MAX);
        self.now = Health::default();
        self.now.set(Health::VISION_DISAGREES, vision);
        self.now.set(Health::INERTIA_DISAGREES, inertia);
        self.now.set(Health::INERTIA_ALONE, e.known < CARRIED_VIEWS);
        self.frames = self.frames.saturating_add(1);
        self.suspect = if vision || inertia { self.suspect + 1 } else { self.suspect.saturating_sub(1) };
        if e.known >= CARRIED_VIEWS {
            self.seeing = self.seeing.saturating_add(1);
        } else if self.carried_since.is_none() {
            (self.carried_since, self.seeing) = (Some(e.t), 0);
        }
        if self.seeing >= CARRIED_NO_MORE {
            self.carried_since = None;
        }
        if self.suspect >= SUSPECT_MAX {
            return Some(Reset::Disagreement);
        }
        self.carried_since.is_some_and(|t| (e.t - t).secs() > CARRIED_MAX).then_some(Reset::Unseen)
    }

    /// What speaks against the newest estimate, as bits.
    pub fn bits(&self) -> Health {
        self.now
    }

    /// Nothing speaks against the newest estimate, nor did since its start.
    pub fn trusts(&self) -> bool {
        self.suspect == 0 && self.carried_since.is_none() && self.frames >= PROBATION
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(i: i64, views: usize, inliers: usize, misfit: f64) -> Evidence {
        Evidence { t: Nanos(i * 50_000_000), views, inliers, known: inliers, misfit }
    }

    /// The frame that ends a flight of such frames, and why.
    fn end(of: impl Fn(i64) -> Evidence) -> Option<(i64, Reset)> {
        let mut watch = Watch::default();
        (0..100).find_map(|i| watch.judge(&of(i)).map(|why| (i, why)))
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
        assert_eq!(end(|i| frame(i, 80, if i % 2 == 0 { 70 } else { 5 }, 1.0)), None);
        let last = SUSPECT_MAX as i64 - 1;
        assert_eq!(end(|i| frame(i, 80, 5, 1.0)), Some((last, Reset::Disagreement)));
        assert_eq!(end(|i| frame(i, 80, 80, f64::NAN)), Some((last, Reset::Disagreement)));
        assert_eq!(end(|i| frame(i, 0, 0, 1.0)), Some((61, Reset::Unseen)));
        let new_only = |i| Evidence { known: 0, ..frame(i, 80, 80, 1.0) };
        assert_eq!(end(new_only), Some((61, Reset::Unseen)), "landmarks of one frame carry nothing");
    }

    #[test]
    fn trust_takes_a_second_look_after_a_start() {
        let mut watch = Watch::default();
        let trusted = (0..100).find(|i| watch.judge(&frame(*i, 80, 80, 1.0)).is_none() && watch.trusts());
        assert_eq!(trusted, Some(PROBATION as i64 - 1));
        watch.judge(&frame(100, 80, 5, 1.0));
        assert!(!watch.trusts() && watch.bits() == (Health::VISION_DISAGREES | Health::INERTIA_ALONE));
    }

    #[test]
    fn quality_falls_with_uncertain_velocity_and_with_few_landmarks() {
        let mut c = [[0.0; 15]; 15];
        assert_eq!((quality(None, 90), quality(Some(&c), 90), quality(Some(&c), 10)), (0, 100, 25));
        c[7][7] = SIGMA_V_HALF.powi(2);
        assert_eq!(quality(Some(&c), 90), 50);
    }
}
