//! Poses from a table in place of odometry: stamps in, poses and which of them make keyframes out.

use stipple_drivers::types::pose_at;
use stipple_drivers::{Nanos, Pose, Span, TimedPose};

/// Largest gap in a table of poses that is interpolated across.
const POSE_GAP_MAX: Span = Span(100_000_000);

/// Poses looked up by stamp.
#[derive(Default)]
pub struct Table {
    pub poses: Vec<TimedPose>,
    /// Without it every frame is a keyframe.
    pub keyframes: Option<KeyframesAt>,
    /// The last keyframe.
    pub last: Option<TimedPose>,
}

/// Which frames are keyframes.
#[derive(Clone, Debug, PartialEq)]
#[cfg_attr(not(feature = "instruments"), allow(dead_code))] // benches and tests ask for it
pub enum KeyframesAt {
    Spaced(Spacing),
    /// Those of these stamps, in order: what another flight chose.
    Stamps(Vec<Nanos>),
}

/// What makes a frame a keyframe: any of these since the last one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spacing {
    pub moved_m: f64,
    pub turned_rad: f64,
    pub waited_s: f64,
}

impl Spacing {
    fn has_passed(&self, last: &TimedPose, now: &TimedPose) -> bool {
        (now.pose.p - last.pose.p).length() >= self.moved_m
            || now.pose.q.angle_between(last.pose.q) >= self.turned_rad
            || (now.t - last.t).secs() >= self.waited_s
    }
}

impl Table {
    /// The pose at an instant, and whether it makes a keyframe; `None` where the table does not cover it.
    pub fn at(&mut self, t: Nanos) -> Option<(Pose, bool)> {
        let now = TimedPose { t, pose: pose_at(&self.poses, t, POSE_GAP_MAX)? };
        let keyframe = match (&self.keyframes, &self.last) {
            (Some(KeyframesAt::Stamps(stamps)), _) => stamps.binary_search(&t).is_ok(),
            (Some(KeyframesAt::Spaced(spacing)), Some(last)) => spacing.has_passed(last, &now),
            _ => true,
        };
        if keyframe {
            self.last = Some(now);
        }
        Some((now.pose, keyframe))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec3};

    #[test]
    fn a_keyframe_comes_when_the_view_has_moved_turned_or_waited() {
        let spacing = Spacing { moved_m: 0.5, turned_rad: 0.25, waited_s: 1.0 };
        let at = |secs: f64, x: f64, turn: f64| TimedPose {
            t: Nanos((secs * 1e9) as i64),
            pose: Pose::new(DQuat::from_rotation_z(turn), DVec3::X * x),
        };
        let first = at(0.0, 0.0, 0.0);
        assert!(!spacing.has_passed(&first, &at(0.9, 0.4, 0.2)));
        for later in [at(0.1, 0.6, 0.0), at(0.1, 0.0, -0.3), at(1.0, 0.0, 0.0)] {
            assert!(spacing.has_passed(&first, &later), "{later:?}");
        }
    }

    #[test]
    fn keyframes_are_those_of_the_stamps_given() {
        let poses = [0, 50_000_000, 100_000_000].map(|t| TimedPose { t: Nanos(t), pose: Pose::IDENTITY }).to_vec();
        let keyframes = Some(KeyframesAt::Stamps(vec![Nanos(50_000_000)]));
        let mut table = Table { poses, keyframes, last: None };
        let chosen = [0, 50_000_000, 70_000_000].map(|t| table.at(Nanos(t)).map(|(_, keyframe)| keyframe));
        assert_eq!(chosen, [Some(false), Some(true), Some(false)]);
    }
}
