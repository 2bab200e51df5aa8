//! How a rig sets out, and where it looks.

use crate::types::Pose;
use glam::{DMat3, DQuat, DVec3};

/// Time at rest at the start, and time in which the flight gathers way, s.
pub const REST: f64 = 1.2;
pub const GATHER: f64 = 1.2;

/// Seconds that a rig has been under way, `t` seconds after it began to: smoothly more, then as time passes.
pub fn under_way(t: f64) -> f64 {
    let h = (t / GATHER).clamp(0.0, 1.0);
    GATHER * (h * h * h - 0.5 * h * h * h * h) + (t - GATHER).max(0.0)
}

/// From 0 at 0 to 1 at 1, with two derivatives that are zero at both.
pub fn smooth(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * x * (10.0 - 15.0 * x + 6.0 * x * x)
}

/// `world_from_cam` at `p`, looking along `yaw` (from x towards y) and `pitch` (up), rolled clockwise.
pub fn look(p: DVec3, yaw: f64, pitch: f64, roll: f64) -> Pose {
    let forward = DVec3::new(yaw.cos() * pitch.cos(), yaw.sin() * pitch.cos(), pitch.sin());
    let right = DVec3::new(yaw.sin(), -yaw.cos(), 0.0);
    let level = DQuat::from_mat3(&DMat3::from_cols(right, forward.cross(right), forward));
    Pose::new(level * DQuat::from_rotation_z(roll), p)
}
