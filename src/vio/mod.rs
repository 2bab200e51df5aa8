//! Sliding-window visual-inertial estimator, sans-IO.
use glam::DVec3;
use stipple_drivers::{Nanos, Pose};

/// The estimate at one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Odometry {
    pub t: Nanos,
    pub world_from_body: Pose,
    /// m/s, world frame.
    pub v_world: DVec3,
    /// rad/s, body frame.
    pub gyro_bias: DVec3,
    /// m/s², body frame.
    pub accel_bias: DVec3,
}
