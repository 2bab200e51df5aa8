//! Health: what is wrong with a frame, one bit a reason, and how good the estimate is.

/// What a frame suffered from, as bits; none is a frame without complaint.
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
    /// Fewer landmarks are in view than declare a keyframe at once.
    pub const FEW_LANDMARKS: Health = Health(1 << 2);
    /// Inertial samples are missing since the last frame.
    pub const IMU_GAP: Health = Health(1 << 3);
    /// A sample since the last frame was at the end of the sensor's range.
    pub const IMU_SATURATED: Health = Health(1 << 4);
    /// A sample since the last frame was refused or repaired.
    pub const IMU_REJECTED: Health = Health(1 << 5);
    /// A step of the solver was not finite.
    pub const SOLVER_FAILED: Health = Health(1 << 6);
    /// Reset at this frame: vision and inertia disagreed for too long.
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
    /// Reset at this frame: no frame came for too long.
    pub const FRAME_GAP_RESET: Health = Health(1 << 14);
    /// Reset at this frame: nothing known was seen for too long.
    pub const UNSEEN_RESET: Health = Health(1 << 15);
    /// Reset at this frame: the state was not finite or beyond what flies.
    pub const STATE_RESET: Health = Health(1 << 16);
    /// No estimator runs: the state is the last one that was trusted, carried on by inertia.
    pub const DEAD_RECKONED: Health = Health(1 << 17);
    /// The frame was refused: it is no newer than the last.
    pub const FRAME_REJECTED: Health = Health(1 << 18);

    /// The bits of a frame at which the estimator was reset.
    pub const RESETS: Health =
        Health(Health::DIVERGED_RESET.0 | Health::FRAME_GAP_RESET.0 | Health::UNSEEN_RESET.0 | Health::STATE_RESET.0);

    /// Name of each bit, as in the report, the lowest first.
    pub const NAMES: [&str; 19] = [
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
        "dead_reckoned",
        "frame_rejected",
    ];
    /// Bits of a normal flight.
    #[cfg(feature = "instruments")]
    pub const NORMAL: Health = Health(Health::INITIALISING.0 | Health::ZERO_VELOCITY.0);

    /// Sets bits when a condition holds; clears none.
    pub fn set(&mut self, bits: Health, when: bool) {
        self.0 |= if when { bits.0 } else { 0 };
    }

    /// Whether all of these bits are set.
    pub fn has(self, bits: Health) -> bool {
        self.0 & bits.0 == bits.0
    }

    /// Names of the reasons.
    pub fn reasons(self) -> impl Iterator<Item = &'static str> {
        Health::NAMES.into_iter().enumerate().filter(move |(i, _)| self.0 >> i & 1 == 1).map(|(_, n)| n)
    }
}

/// The velocity's standard deviation at which half is lost, m/s.
const SIGMA_V_HALF: f64 = 0.05;
/// Landmarks that are enough however large the image is, and the share of it that one takes, px²: a square of 95 px, so that
/// EuRoC's image of 752x480 holds those 40, and half of it on each side holds 10.
const LANDMARKS_ENOUGH: f64 = 40.0;
const LANDMARK_PX2: f64 = 9025.0;
/// Fewer landmarks than this part of what is enough are few.
pub const FEW: f64 = 0.5;

/// Landmarks that are enough in images of so many pixels, the vehicle's own left out.
pub fn landmarks_enough(pixels: usize) -> f64 {
    (pixels as f64 / LANDMARK_PX2).clamp(1.0, LANDMARKS_ENOUGH)
}

/// 0 to 100: `100 min(1, landmarks / enough) / (1 + σ_v / 0.05 m/s)`, with σ_v² the trace of the covariance of the velocity
/// in the body's frame; zero where that is unknown. The velocity's and not the position's, because odometry's position error only
/// ever grows; σ_v is by how much it may grow each second: 5 mm at 91, 5 cm at 50, half a metre at 9. Quality does not
/// know of faults that have not shown; `Vio::on_tracks` limits that of frames whose views do not fit.
pub fn quality(sigma_v: Option<f64>, landmarks: usize, enough: f64) -> u8 {
    let Some(sigma_v) = sigma_v else { return 0 };
    let seen = (landmarks as f64 / enough).min(1.0);
    (100.0 * seen / (1.0 + sigma_v / SIGMA_V_HALF)).round() as u8
}

/// A velocity this uncertain is not one to fly by, m/s: a walk's.
pub const SIGMA_V_UNOBSERVED: f64 = 0.5;

/// Why the estimate was given up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Reset {
    FrameGap,
    /// Vision and inertia disagreed.
    Disagreement,
    /// Nothing known was seen.
    Unseen,
    /// Not finite, or beyond what flies.
    State,
    /// The caller asked for it.
    #[default]
    Asked,
}

impl Reset {
    /// The bit that says so.
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

#[cfg(test)]
mod tests {
    use super::*;

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
    fn quality_falls_with_uncertain_velocity_and_with_few_landmarks() {
        let of = |sigma, landmarks| quality(sigma, landmarks, landmarks_enough(752 * 480));
        assert_eq!([of(None, 90), of(Some(0.0), 90), of(Some(0.0), 10)], [0, 100, 25]);
        assert_eq!(of(Some(SIGMA_V_HALF), 90), 50);
    }

    #[test]
    fn small_image_that_holds_what_it_can_is_not_half_as_good() {
        assert_eq!(quality(Some(0.0), 10, landmarks_enough(376 * 240)), 100);
        assert_eq!(landmarks_enough(1920 * 1080), LANDMARKS_ENOUGH);
    }
}
