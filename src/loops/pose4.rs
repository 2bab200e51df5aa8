//! Poses of four degrees of freedom: gravity gives roll and pitch, so a loop closure finds position and yaw.

use glam::{DQuat, DVec3};
use std::f64::consts::PI;
use stipple_drivers::Pose;

/// A level frame (z up) in another one: position, m, and yaw, rad.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pose4 {
    pub p: DVec3,
    pub yaw: f64,
}

impl Pose4 {
    /// The frame of a body turned upright, and the rotation from the body's frame to it. The yaw is that of the rotation's
    /// twist about z.
    pub fn upright(pose: &Pose) -> (Pose4, DQuat) {
        let twist = DQuat::from_xyzw(0.0, 0.0, pose.q.z, pose.q.w);
        let twist = if twist.length_squared() > 1e-12 { twist.normalize() } else { DQuat::IDENTITY };
        let yaw = wrapped(2.0 * twist.z.atan2(twist.w));
        (Pose4 { p: pose.p, yaw }, twist.inverse() * pose.q)
    }

    /// `self * other`.
    pub fn compose(&self, other: &Pose4) -> Pose4 {
        Pose4 { p: self.apply(other.p), yaw: wrapped(self.yaw + other.yaw) }
    }

    pub fn inverse(&self) -> Pose4 {
        Pose4 { p: turned(-self.yaw, -self.p), yaw: wrapped(-self.yaw) }
    }

    /// `self⁻¹ * other`.
    pub fn between(&self, other: &Pose4) -> Pose4 {
        Pose4 { p: turned(-self.yaw, other.p - self.p), yaw: wrapped(other.yaw - self.yaw) }
    }

    /// A point of the frame, in the one that it is in.
    pub fn apply(&self, v: DVec3) -> DVec3 {
        turned(self.yaw, v) + self.p
    }

    /// The same as a pose of six degrees of freedom.
    pub fn pose(&self) -> Pose {
        Pose::new(DQuat::from_rotation_z(self.yaw), self.p)
    }

    pub fn is_finite(&self) -> bool {
        self.p.is_finite() && self.yaw.is_finite()
    }
}

/// A vector turned about z.
pub fn turned(yaw: f64, v: DVec3) -> DVec3 {
    let (s, c) = yaw.sin_cos();
    DVec3::new(c * v.x - s * v.y, s * v.x + c * v.y, v.z)
}

/// An angle from -π to π.
pub fn wrapped(angle: f64) -> f64 {
    let a = (angle + PI).rem_euclid(2.0 * PI) - PI;
    if a.is_nan() {
        angle
    } else {
        a
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn composition_and_inverse_agree_with_poses_of_six_degrees() {
        let a = Pose4 { p: DVec3::new(1.0, -2.0, 0.5), yaw: 3.0 };
        let b = Pose4 { p: DVec3::new(-0.3, 4.0, 1.0), yaw: 1.5 };
        let (ab, six) = (a.compose(&b), a.pose() * b.pose());
        assert!((ab.p - six.p).length() < 1e-12 && ab.pose().q.dot(six.q).abs() > 1.0 - 1e-12);
        assert!((ab.yaw - (4.5 - 2.0 * PI)).abs() < 1e-12, "wrapped");
        let back = a.between(&ab);
        assert!((back.p - b.p).length() < 1e-12 && (back.yaw - b.yaw).abs() < 1e-12);
        let none = a.compose(&a.inverse());
        assert!(none.p.length() < 1e-12 && none.yaw.abs() < 1e-12);
    }

    #[test]
    fn an_upright_frame_and_the_tilt_give_the_pose_back_and_extreme_angles_do_not_break() {
        for (yaw, tilt) in [(0.3, 0.0), (-3.1, 0.4), (2.9, 1.5), (1.0, 3.1)] {
            let q = DQuat::from_rotation_z(yaw) * DQuat::from_rotation_y(tilt);
            let (level, level_from_body) = Pose4::upright(&Pose::new(q, DVec3::X));
            let again = level.pose().q * level_from_body;
            assert!(again.dot(q).abs() > 1.0 - 1e-9, "{yaw} {tilt}");
            assert!(wrapped(level.yaw - yaw).abs() < 1e-9, "{yaw} {tilt}: {}", level.yaw);
        }
        let upside_down = DQuat::from_rotation_x(PI);
        assert!(Pose4::upright(&Pose::new(upside_down, DVec3::ZERO)).0.is_finite());
        assert_eq!((wrapped(PI), wrapped(-PI), wrapped(1e9).abs() <= PI), (-PI, -PI, true));
        assert!(wrapped(f64::NAN).is_nan());
    }
}
