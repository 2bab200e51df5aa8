//! States in the frames of ROS (REP 103 and 105).
//!
//! `map` is the one in which loops agree: poses in it jump when a place is recognised, and the map's Gaussians are in it.
//! `odom` is the daemon's: z up, its origin at the first pose of an epoch, its x where the start put it, which is not the
//! vehicle's nose. `base_link` has its origin in the inertial unit, and the vehicle's axes: x forward, y left, z up.

use crate::messages::{Covariance, Header, Odometry, Time, TransformStamped};
use crate::socket::{MapFromOdom, State};
use glam::{DMat3, DQuat, DVec3, DVec4, EulerRot};

/// Variance that stands for one that is unknown.
pub const UNKNOWN: f64 = 1e4;
/// Variance of an angular rate, rad²/s², which the daemon does not tell: that of a gyro's noise and bias, and not zero.
const RATE_VARIANCE: f64 = 1e-4;
/// How far the length of a quaternion may be from 1.
const LENGTH_TOLERANCE: f64 = 1e-3;

/// Names of the frames, and the turn from the inertial unit to the vehicle.
#[derive(Clone, Debug)]
pub struct Frames {
    pub map: String,
    pub odom: String,
    pub base: String,
    pub base_from_body: DQuat,
}

impl Frames {
    /// `mount_rpy_deg`: roll, pitch and yaw of the inertial unit in the vehicle, as the board key `mavlink.mount_rpy_deg` has
    /// them: about the axes forward, right and down, roll first, degrees. `base` has the axes forward, left and up.
    pub fn new([map, odom, base]: [&str; 3], mount_rpy_deg: [f64; 3]) -> Frames {
        let [roll, pitch, yaw] = mount_rpy_deg.map(f64::to_radians);
        let frd_from_body = DQuat::from_euler(EulerRot::ZYX, yaw, pitch, roll);
        // Half a turn about forward: right and down become left and up.
        let base_from_body = DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0) * frd_from_body;
        Frames { map: map.into(), odom: odom.into(), base: base.into(), base_from_body }
    }

    /// The state as a message; `None` where a number of it is not finite, or a matrix or the orientation is none.
    pub fn odometry(&self, state: &State, stamp: Time) -> Option<Odometry> {
        let q = DVec4::from_array(state.orientation);
        if !((q.length() - 1.0).abs() < LENGTH_TOLERANCE) {
            return None;
        }
        let odom_from_base = DQuat::from_vec4(q.normalize()) * self.base_from_body.conjugate();
        // What has failed knows nothing of its errors.
        let known = state.quality > 0;
        let pose_covariance = match state.pose_covariance.as_deref().filter(|_| known) {
            Some(told) if told.len() != 36 => return None,
            Some(told) => std::array::from_fn(|row| std::array::from_fn(|column| told[6 * row + column])),
            None => diagonal([UNKNOWN; 6]),
        };
        let of_velocity = match state.velocity_covariance.as_deref().filter(|_| known) {
            Some(told) => self.turned(told.try_into().ok()?),
            None => DMat3::from_diagonal(DVec3::splat(UNKNOWN)),
        };
        let mut twist_covariance = diagonal([RATE_VARIANCE; 6]);
        for row in 0..3 {
            (0..3).for_each(|column| twist_covariance[row][column] = of_velocity.col(column)[row]);
        }
        let odometry = Odometry {
            header: Header { stamp, frame_id: self.odom.clone() },
            child_frame_id: self.base.clone(),
            position: state.position,
            orientation: odom_from_base.normalize().to_array(),
            pose_covariance,
            linear: (self.base_from_body * DVec3::from_array(state.velocity_body)).to_array(),
            angular: (self.base_from_body * DVec3::from_array(state.rate_body)).to_array(),
            twist_covariance,
        };
        is_finite(&odometry).then_some(odometry)
    }

    /// Where `odom` is in `map`, for /tf, at the stamp of an odometry: the identity before a place was recognised. After a reset
    /// it stays what it was until another is, as it does for the daemon's mapper.
    pub fn map_from_odom(&self, odometry: &Odometry, told: Option<MapFromOdom>) -> TransformStamped {
        let is_usable = |m: &MapFromOdom| DVec3::from(m.position).is_finite() && m.yaw.is_finite();
        let found = told.filter(is_usable);
        TransformStamped {
            header: Header { stamp: odometry.header.stamp.clone(), frame_id: self.map.clone() },
            child_frame_id: self.odom.clone(),
            translation: found.map_or([0.0; 3], |m| m.position),
            rotation: DQuat::from_rotation_z(found.map_or(0.0, |m| m.yaw)).to_array(),
        }
    }

    /// Covariance of a vector in the axes of `base`, from that in the body's by rows.
    fn turned(&self, told: &[f64; 9]) -> DMat3 {
        let turn = DMat3::from_quat(self.base_from_body);
        turn * DMat3::from_cols_array(told).transpose() * turn.transpose()
    }
}

/// The same pose for /tf.
pub fn transform(odometry: &Odometry) -> TransformStamped {
    TransformStamped {
        header: odometry.header.clone(),
        child_frame_id: odometry.child_frame_id.clone(),
        translation: odometry.position,
        rotation: odometry.orientation,
    }
}

fn diagonal(of: [f64; 6]) -> Covariance {
    std::array::from_fn(|row| std::array::from_fn(|column| if row == column { of[row] } else { 0.0 }))
}

fn is_finite(o: &Odometry) -> bool {
    let vectors = [o.position, o.linear, o.angular].into_iter().flatten().chain(o.orientation);
    let matrices = [o.pose_covariance, o.twist_covariance].into_iter().flatten().flatten();
    vectors.chain(matrices).all(f64::is_finite)
}

/// A time of ROS; `None` before 1970 and after 2038, which its seconds cannot say.
pub fn time(wall_ns: i64) -> Option<Time> {
    let nanosec = u32::try_from(wall_ns.rem_euclid(1_000_000_000)).ok()?;
    let sec = i32::try_from(wall_ns.div_euclid(1_000_000_000)).ok().filter(|sec| *sec >= 0)?;
    Some(Time { sec, nanosec })
}

/// Stamps that only grow, in Unix time.
#[derive(Debug, Default)]
pub struct Stamps {
    /// The last stamp, and CLOCK_MONOTONIC there, ns.
    last: Option<(i64, i64)>,
    /// How far the last stamp was ahead of the wall clock, which was set back, ns.
    pub ahead_ns: i64,
}

impl Stamps {
    /// The stamp of what was at `wall_ns` and, by CLOCK_MONOTONIC, at `t_ns`: the first of them. After the wall clock was set
    /// back the second goes on from the last stamp. `None` for what is not later than the last.
    pub fn stamp(&mut self, t_ns: i64, wall_ns: i64) -> Option<Time> {
        let stamp_ns = match self.last {
            Some((stamp_ns, at_ns)) if wall_ns <= stamp_ns && t_ns > at_ns => stamp_ns.checked_add(t_ns - at_ns)?,
            Some((stamp_ns, _)) if wall_ns <= stamp_ns => return None,
            _ => wall_ns,
        };
        let stamp = time(stamp_ns)?;
        self.last = Some((stamp_ns, t_ns));
        self.ahead_ns = stamp_ns - wall_ns;
        Some(stamp)
    }
}
