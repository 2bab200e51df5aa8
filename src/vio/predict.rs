//! The motion between two frames before their images are looked at: a past state carried by the
//! inertial samples to both.
//!
//! The state is that of the frame *before* the last, though the last one's may be known already:
//! so a tracker may work on a frame while the estimator is still busy with the one before it, and
//! what it finds does not depend on whether it did. What the state's error adds over one more frame
//! is far below a pixel, since only the motion between the two frames is used.

use super::preintegration::Noise;
use super::residuals::Motion;
use super::samples::ImuRing;
use glam::DVec3;
use stipple_drivers::{Nanos, Pose};

/// A state of the estimator as a tracker needs it; without one there is only the gyroscope.
#[derive(Clone, Copy, Debug)]
pub struct Predictor {
    pub(super) noise: Noise,
    pub(super) state: Option<(Nanos, Motion)>,
}

impl Predictor {
    /// `prev_from_now` of the body over `[prev, t]`. Before initialisation the rotation only.
    pub fn motion(&self, imu: &ImuRing, prev: Nanos, t: Nanos) -> Pose {
        let Some((t0, state)) = &self.state else {
            let inc = imu.integrate(prev, t, DVec3::ZERO, DVec3::ZERO, &self.noise);
            return Pose::new(inc.q, DVec3::ZERO);
        };
        let carry = |from: &Motion, t0, t1| from.propagate(&imu.integrate(t0, t1, from.bg, from.ba, &self.noise));
        let before = carry(state, *t0, prev.max(*t0));
        let now = carry(&before, prev.max(*t0), t);
        before.pose.inverse() * now.pose
    }
}

#[cfg(test)]
mod tests {
    use super::super::world::{calibration, rate_and_force, Path};
    use super::super::Vio;
    use super::*;
    use crate::config::VioConfig;
    use stipple_drivers::ImuSample;

    fn at(t: f64) -> Nanos {
        Nanos((t * 1e9).round() as i64)
    }

    #[test]
    fn motion_from_two_frames_ago_is_that_of_the_path() {
        let path = Path { rest: -1.0 };
        let mut imu = ImuRing::new();
        for i in 0..80 {
            let t = i as f64 / 200.0;
            let (gyro_body, accel_body) = rate_and_force(|t| path.pose(t), t);
            imu.push(ImuSample { t: at(t), gyro_body, accel_body });
        }
        let (t0, t1, t2) = (0.1012, 0.1512, 0.2012);
        let v = (path.pose(t0 + 1e-5).p - path.pose(t0 - 1e-5).p) / 2e-5;
        let noise = Vio::new(&calibration(), &VioConfig::default()).noise;
        let state = Some((at(t0), Motion { pose: path.pose(t0), v, ..Motion::default() }));
        let truth = path.pose(t1).inverse() * path.pose(t2);
        let moved = Predictor { noise, state }.motion(&imu, at(t1), at(t2));
        assert!((moved.p - truth.p).length() < 1e-4 && moved.q.angle_between(truth.q) < 1e-4, "{moved:?} {truth:?}");
        let turned = Predictor { noise, state: None }.motion(&imu, at(t1), at(t2));
        assert!(turned.p == DVec3::ZERO && turned.q.angle_between(truth.q) < 1e-4, "{turned:?} {truth:?}");
    }
}
