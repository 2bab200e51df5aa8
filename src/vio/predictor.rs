//! The motion between two frames before their images are looked at, for a tracker on a thread of its own: a past state
//! carried by the inertial samples to both.
//!
//! The state is that of the frame *before* the last, though the last one's may be known already:
//! so a tracker may work on a frame while the estimator is still busy with the one before it, and
//! what it finds does not depend on whether it did. What the state's error adds over one more frame
//! is far below a pixel, since only the motion between the two frames is used.
//!
//! For whoever publishes between frames it carries the newest state itself, with its covariance (`on_update`, `state_at`):
//! the estimator is a frame's exposure, transfer and computation late, the samples are not. One prediction integrates the
//! samples since the frame, or since the last `advance`, some 1 µs each.

use super::health::{self, Health};
use super::inertial::{body_velocity_sigma, Covariance, Motion};
use super::preintegration::Noise;
use super::recovery::DeadReckoning;
use super::samples::ImuRing;
use super::shutter::Twist;
use super::{Known, Odometry, Update, FRAME_GAP_MAX};
use crate::config::VioConfig;
use crate::limits::CAMERAS_MAX;
use crate::math::so3;
use glam::DVec3;
use stipple_drivers::{Calibration, ImuSample, Nanos, Pose, Span};

/// Predicts for one tracker, with inertial samples of its own.
#[derive(Clone, Debug)]
pub struct Predictor {
    noise: Noise,
    imu: ImuRing,
    /// Stamp of the last tracked frame.
    last: Option<Nanos>,
    newest: Option<Newest>,
}

/// The newest state that the estimator gave.
#[derive(Clone, Copy, Debug)]
struct Newest {
    /// Stamp of its frame.
    frame: Nanos,
    /// Carried by `advance`.
    state: DeadReckoning,
    is_determined: bool,
    epoch: u32,
    health: Health,
    quality: u8,
}

/// The newest state carried to an instant.
#[derive(Clone, Copy, Debug)]
pub struct Predicted {
    pub odometry: Odometry,
    /// Covariance as `Vio::covariance` has it, with the noise of the samples since.
    pub covariance: Option<Covariance>,
    /// Epoch of the frame that is carried, what it suffered from, its quality, and the time since.
    pub epoch: u32,
    pub health: Health,
    pub quality: u8,
    pub age: Span,
}

impl Predictor {
    pub fn new(calibration: &Calibration, config: &VioConfig) -> Predictor {
        Predictor {
            noise: Noise::new(&calibration.imu, config),
            imu: ImuRing::new(calibration.imu.rate_hz),
            last: None,
            newest: None,
        }
    }

    /// Takes a sample; refuses what the estimator refuses.
    pub fn on_imu(&mut self, sample: ImuSample) {
        if self.imu.admits(&sample) {
            if self.imu.newest().is_some_and(|n| (sample.t - n.t).secs() > FRAME_GAP_MAX) {
                // One sample held for minutes leads nowhere.
                self.change_clock();
            }
            self.imu.push(sample);
        }
    }

    /// Whether the samples since the last tracked frame are there and sound, so that one at `t` may be left to them.
    pub fn is_sound(&self, t: Nanos) -> bool {
        self.last.is_some_and(|last| self.imu.is_sound(last, t, &self.noise))
    }

    /// Takes the factors less one by which readings are to be multiplied, as `Vio::known` has them.
    pub fn set_scale(&mut self, scale: [DVec3; 2]) {
        self.imu.scale = scale;
    }

    /// Goes over to another clock, or past a gap of the samples: forgets samples and frames.
    pub fn change_clock(&mut self) {
        self.imu.clear();
        self.last = None;
        self.newest = None;
    }

    /// Places of the cameras on the body as they see the frame at `t`, and how far their rotations may be off, rad; `None` where
    /// nothing of them is estimated. A camera that is exposed later than camera 0 sees from where the body has moved it to.
    /// `known` is as for `motion_to`.
    pub fn cameras_at(&self, t: Nanos, known: &Known) -> Option<([Pose; CAMERAS_MAX], f64)> {
        let cameras = known.cameras?;
        let twist = known.odometry.map_or(Twist::default(), |o| Twist {
            v: o.world_from_body.q.conjugate() * o.v_world,
            w: self.imu.rate_at(t) * (1.0 + self.imu.scale[0]) - o.gyro_bias,
        });
        let mut places = cameras.body_from_cam;
        for (place, offset) in places.iter_mut().zip(&cameras.time_offsets) {
            let tau = offset - cameras.time_offsets[0];
            let moved = Pose::new(so3::exp(twist.w * tau), twist.v * tau);
            *place = if tau == 0.0 { *place } else { moved * *place };
        }
        Some((places, cameras.rotation_sigma + cameras.time_sigma * twist.w.length()))
    }

    /// Motion of the body from the last tracked frame to the one at `t`, which is the last from now on, `before_from_now`; `None` at the first frame.
    /// `state` is what the estimator knew after the frame two before this one; without it, or with one of a clock that was
    /// ahead, only the gyro predicts, a rotation. Samples up to `t` must have come; the newest is held where they have not.
    pub fn motion_to(&mut self, t: Nanos, state: Option<&Odometry>) -> Option<Pose> {
        let motion = self.motion_since_last(t, state);
        self.last = Some(t);
        motion
    }

    /// Motion as `motion_to` gives it, without the frame at `t` becoming the last.
    pub fn motion_since_last(&self, t: Nanos, state: Option<&Odometry>) -> Option<Pose> {
        let last = self.last?;
        let Some(state) = state.filter(|s| s.t <= t) else {
            let inc = self.imu.integrate_scaled(last, t, DVec3::ZERO, DVec3::ZERO, &self.noise);
            return Some(Pose::new(inc.q, DVec3::ZERO));
        };
        let imu = &self.imu;
        let carry =
            |from: &Motion, t0, t1| from.propagate(&imu.integrate_scaled(t0, t1, from.bg, from.ba, &self.noise));
        let before = carry(&Motion::from(state), state.t, last.max(state.t));
        let now = carry(&before, last.max(state.t), t);
        Some(before.pose.inverse() * now.pose)
    }
}

/// For whoever publishes.
impl Predictor {
    /// Takes what a frame led to; where that is no state there is none to carry until the next. A frame that was refused led to
    /// nothing, and the one before goes on being carried.
    pub fn on_update(&mut self, update: &Update) {
        if update.health.has(Health::FRAME_REJECTED) {
            return;
        }
        // A stamp so far ahead is of a clock that was.
        let is_ahead = |t: Nanos| self.imu.newest().is_some_and(|n| (t - n.t).secs() > FRAME_GAP_MAX);
        self.newest = update.odometry.or(update.dead_reckoned).filter(|o| !is_ahead(o.t)).map(|o| Newest {
            frame: o.t,
            state: DeadReckoning::new(o.t, &Motion::from(&o), &update.covariance.unwrap_or_default()),
            is_determined: update.covariance.is_some(),
            epoch: update.epoch,
            health: update.health,
            quality: update.quality,
        });
    }

    /// Carries the newest state to `t` for good: what is asked for then, of instants not before `t`, costs the samples since.
    pub fn advance(&mut self, t: Nanos) {
        if let Some(newest) = &mut self.newest {
            if self.imu.covers(newest.state.t) {
                newest.state.advance(t, &self.imu, &self.noise);
            }
        }
    }

    /// The newest state carried to `t` by the samples that came; past them the last is held, with the noise of a gap.
    /// `None` without a state; before it or the last `advance`, or `FRAME_GAP_MAX` after; and where a sample since was
    /// overwritten. Its quality is the frame's, less what the velocity has become uncertain by since, and 0 from
    /// `FRAME_GAP_MAX` after the frame on: then it is dead reckoning.
    pub fn state_at(&self, t: Nanos) -> Option<Predicted> {
        let Newest { frame, mut state, is_determined, epoch, mut health, mut quality } = self.newest?;
        let since = t - state.t;
        if since < Span(0) || since.secs() > FRAME_GAP_MAX || !self.imu.covers(state.t) {
            return None;
        }
        state.advance(t, &self.imu, &self.noise);
        let covariance = state.covariance()?;
        quality = quality.min(health::quality(Some(body_velocity_sigma(&covariance, &state.motion)), 1, 1.0));
        let age = t - frame;
        if age.secs() > FRAME_GAP_MAX {
            (health, quality) = (health | Health::DEAD_RECKONED, 0);
        }
        let covariance = is_determined.then_some(covariance);
        Some(Predicted { odometry: Odometry::new(t, &state.motion), covariance, epoch, health, quality, age })
    }
}

#[cfg(test)]
mod tests {
    use super::super::world::{calibration, rate_and_force, Path};
    use super::*;

    fn at(t: f64) -> Nanos {
        Nanos((t * 1e9).round() as i64)
    }

    #[test]
    fn motion_from_two_frames_ago_is_that_of_the_path() {
        let path = Path { rest: -1.0 };
        let mut predictor = Predictor::new(&calibration(), &VioConfig::default());
        for i in 0..80 {
            let t = i as f64 / 200.0;
            let (gyro_body, accel_body) = rate_and_force(|t| path.pose(t), t);
            predictor.on_imu(ImuSample { t: at(t), gyro_body, accel_body, ..ImuSample::default() });
        }
        let (t0, t1, t2) = (0.1012, 0.1512, 0.2012);
        let v_world = (path.pose(t0 + 1e-5).p - path.pose(t0 - 1e-5).p) / 2e-5;
        let (gyro_bias, accel_bias) = (DVec3::ZERO, DVec3::ZERO);
        let state = Odometry { t: at(t0), world_from_body: path.pose(t0), v_world, gyro_bias, accel_bias };
        let truth = path.pose(t1).inverse() * path.pose(t2);
        assert_eq!(predictor.clone().motion_to(at(t1), Some(&state)), None, "nothing is before the first frame");
        predictor.motion_to(at(t1), None);
        let moved = predictor.clone().motion_to(at(t2), Some(&state)).expect("a second frame");
        assert!((moved.p - truth.p).length() < 1e-4 && moved.q.angle_between(truth.q) < 1e-4, "{moved:?} {truth:?}");
        let rotated = predictor.motion_to(at(t2), None).expect("a second frame");
        assert!(rotated.p == DVec3::ZERO && rotated.q.angle_between(truth.q) < 1e-4, "{rotated:?} {truth:?}");
    }
}
