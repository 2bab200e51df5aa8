//! States as MAVLink messages, in the frames that autopilots take: poses in MAV_FRAME_LOCAL_FRD (forward as the vehicle looked
//! when it started, right, down), velocities in MAV_FRAME_BODY_FRD. Both PX4 and ArduPilot take this pair.

use crate::publish::turned::Turned;
use crate::publish::State;
use glam::{DQuat, DVec3, EulerRot};
use mavlink::dialects::common::{MavEstimatorType, MavFrame, ODOMETRY_DATA, VISION_POSITION_ESTIMATE_DATA};
use nalgebra::SMatrix;

/// Turns of the axes.
pub struct Axes {
    /// Rotation of the body, which is the inertial unit, in the vehicle's axes: forward, right, down.
    vehicle_from_body: DQuat,
    /// Rotation of the world, whose z is up, in the local frame. Known from the first state on, and the same from there.
    local_from_world: Option<DQuat>,
    /// Sine of how far the nose pointed up at the first state, until it is asked for.
    nose_up: Option<f64>,
    epochs_before: u32,
}

/// Variance that stands for one that is unknown: MAVLink would have NaN there.
const UNKNOWN: f64 = 1e4;

/// Upper right triangle, row by row.
fn triangle(m: &Option<SMatrix<f64, 6, 6>>) -> [f32; 21] {
    let m = m.unwrap_or_else(|| SMatrix::identity() * UNKNOWN);
    let mut entries = (0..6).flat_map(|row| (row..6).map(move |column| m[(row, column)] as f32));
    std::array::from_fn(|_| entries.next().unwrap_or_default())
}

impl Axes {
    /// `rpy_deg`: roll, pitch and yaw by which the inertial unit is turned in the vehicle. Resets count on from `epochs_before`.
    pub fn new(rpy_deg: [f64; 3], epochs_before: u32) -> Axes {
        let [roll, pitch, yaw] = rpy_deg.map(f64::to_radians);
        let vehicle_from_body = DQuat::from_euler(EulerRot::ZYX, yaw, pitch, roll);
        Axes { vehicle_from_body, local_from_world: None, nose_up: None, epochs_before }
    }

    fn local_from_world(&mut self, state: &State) -> DQuat {
        let (world_from_body, body_from_vehicle) =
            (state.odometry.world_from_body.q, self.vehicle_from_body.conjugate());
        let nose_up = &mut self.nose_up;
        let first = || {
            let forward = world_from_body * (body_from_vehicle * DVec3::X);
            *nose_up = Some(forward.z);
            DQuat::from_rotation_x(std::f64::consts::PI) * DQuat::from_rotation_z(-forward.y.atan2(forward.x))
        };
        let turn = self.local_from_world.unwrap_or_else(first);
        // A first state that is not finite is not the first.
        self.local_from_world = Some(turn).filter(|turn| turn.is_finite());
        turn
    }

    fn turn(&mut self, state: &State) -> Option<Turned> {
        Turned::new(state, self.local_from_world(state), self.vehicle_from_body)
    }

    /// How far the nose pointed up at the first state, degrees: once.
    pub fn take_nose_up(&mut self) -> Option<f64> {
        self.nose_up.take().map(|sine| sine.clamp(-1.0, 1.0).asin().to_degrees())
    }

    fn reset_counter(&self, state: &State) -> u8 {
        self.epochs_before.wrapping_add(state.epoch) as u8
    }

    /// ODOMETRY of a state; `None` where it is not finite.
    pub fn odometry(&mut self, state: &State, time_usec: u64) -> Option<ODOMETRY_DATA> {
        let s = self.turn(state)?;
        let [p, v, rate] = [s.p, s.v, s.rate].map(|v| v.as_vec3());
        let q = s.local_from_vehicle.as_quat();
        Some(ODOMETRY_DATA {
            time_usec,
            x: p.x,
            y: p.y,
            z: p.z,
            q: [q.w, q.x, q.y, q.z],
            vx: v.x,
            vy: v.y,
            vz: v.z,
            rollspeed: rate.x,
            pitchspeed: rate.y,
            yawspeed: rate.z,
            pose_covariance: triangle(&s.pose_covariance),
            velocity_covariance: triangle(&s.velocity_covariance),
            frame_id: MavFrame::MAV_FRAME_LOCAL_FRD,
            child_frame_id: MavFrame::MAV_FRAME_BODY_FRD,
            reset_counter: self.reset_counter(state),
            estimator_type: MavEstimatorType::MAV_ESTIMATOR_TYPE_VIO,
            quality: quality(state),
        })
    }

    /// VISION_POSITION_ESTIMATE of a state; `None` where it is not finite.
    pub fn vision_position(&mut self, state: &State, usec: u64) -> Option<VISION_POSITION_ESTIMATE_DATA> {
        let s = self.turn(state)?;
        let p = s.p.as_vec3();
        let (yaw, pitch, roll) = s.local_from_vehicle.to_euler(EulerRot::ZYX);
        Some(VISION_POSITION_ESTIMATE_DATA {
            usec,
            x: p.x,
            y: p.y,
            z: p.z,
            roll: roll as f32,
            pitch: pitch as f32,
            yaw: yaw as f32,
            covariance: triangle(&s.pose_covariance),
            reset_counter: self.reset_counter(state),
        })
    }
}

/// 1 to 100 percent; -1 where odometry has failed, since 0 is for a quality that is unknown.
fn quality(state: &State) -> i8 {
    if state.has_failed() {
        -1
    } else {
        state.quality.min(100) as i8
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::publish::Source;
    use crate::vio::Odometry;
    use stipple_drivers::{Nanos, Pose};

    /// Mounting in the EuRoC vehicle: the unit's z is forward, y right, x up.
    const EUROC: [f64; 3] = [0.0, 90.0, 0.0];

    fn state(q: DQuat, p: DVec3, v_world: DVec3) -> State {
        let odometry = Odometry {
            t: Nanos(0),
            world_from_body: Pose { q, p },
            v_world,
            gyro_bias: DVec3::ZERO,
            accel_bias: DVec3::ZERO,
        };
        let (rate, covariance, source) = (DVec3::ZERO, None, Source::Frame);
        State { odometry, rate, covariance, epoch: 258, quality: 80, health: Default::default(), source }
    }

    /// World from the body of EuRoC's vehicle, level, its nose in the direction of `heading`.
    fn level(heading: f64) -> DQuat {
        let world_from_vehicle = DQuat::from_rotation_z(heading) * DQuat::from_rotation_x(std::f64::consts::PI);
        world_from_vehicle * Axes::new(EUROC, 0).vehicle_from_body
    }

    #[test]
    fn body_of_euroc_has_its_z_forward_and_its_x_up() {
        let turn = Axes::new(EUROC, 0).vehicle_from_body;
        for (of_body, of_vehicle) in [(DVec3::Z, DVec3::X), (DVec3::Y, DVec3::Y), (DVec3::X, DVec3::NEG_Z)] {
            assert!((turn * of_body - of_vehicle).length() < 1e-12);
        }
    }

    #[test]
    fn vehicle_that_flies_forward_right_and_up_is_at_positive_x_and_y_and_negative_z() {
        let mut axes = Axes::new(EUROC, 0);
        let heading = 2.0;
        let start = axes.odometry(&state(level(heading), DVec3::ZERO, DVec3::ZERO), 1).unwrap();
        assert!(start.q[0].abs() > 0.999_999, "{:?}", start.q);
        let [forward, right] =
            [heading, heading - 0.5 * std::f64::consts::PI].map(|a| DVec3::new(a.cos(), a.sin(), 0.0));
        let p = 3.0 * forward + 2.0 * right + DVec3::Z;
        // Its nose is a quarter to the right of where it was, and it flies there.
        let turned = state(level(heading - 0.5 * std::f64::consts::PI), p, right);
        let o = axes.odometry(&turned, 7).unwrap();
        let near = |pairs: &[(f32, f32)]| pairs.iter().for_each(|(a, b)| assert!((a - b).abs() < 1e-6, "{a} {b}"));
        near(&[(o.x, 3.0), (o.y, 2.0), (o.z, -1.0), (o.vx, 1.0), (o.vy, 0.0), (o.vz, 0.0)]);
        assert!(o.time_usec == 7 && o.reset_counter == 2 && o.quality == 80);
        let vision = axes.vision_position(&turned, 7).unwrap();
        near(&[(vision.x, 3.0), (vision.z, -1.0), (vision.roll, 0.0), (vision.yaw, std::f32::consts::FRAC_PI_2)]);
    }

    #[test]
    fn what_failed_has_a_quality_below_none_and_what_is_not_finite_is_not_told() {
        let mut axes = Axes::new([0.0; 3], 0);
        let good = state(DQuat::IDENTITY, DVec3::ZERO, DVec3::ZERO);
        let of = |axes: &mut Axes, state| axes.odometry(&state, 0).map(|o| o.quality);
        assert_eq!(of(&mut axes, State { quality: 0, ..good }), Some(-1));
        assert_eq!(of(&mut axes, State { source: Source::DeadReckoned, ..good }), Some(-1));
        for bad in [f64::NAN, f64::INFINITY, 1e300] {
            assert_eq!(of(&mut axes, state(DQuat::IDENTITY, DVec3::splat(bad), DVec3::ZERO)), None);
            assert_eq!(of(&mut axes, State { rate: DVec3::splat(bad), ..good }), None);
            assert_eq!(of(&mut axes, State { covariance: Some([[bad; 15]; 15]), ..good }), None);
        }
        let mut fresh = Axes::new([0.0; 3], 0);
        assert_eq!(of(&mut fresh, state(DQuat::from_xyzw(f64::NAN, 0.0, 0.0, 1.0), DVec3::ZERO, DVec3::ZERO)), None);
        assert_eq!(of(&mut fresh, good), Some(80), "a first state that is not finite leaves no mark");
        let unknown = axes.odometry(&good, 0).unwrap();
        assert!(unknown.pose_covariance.iter().chain(&unknown.velocity_covariance).all(|x| x.is_finite()));
    }

    /// Errors of the state, drawn from a covariance, and what becomes of them in a message.
    #[test]
    fn covariances_are_those_of_the_turned_errors() {
        let q = DQuat::from_euler(EulerRot::XYZ, 0.4, -1.1, 2.0);
        let base = state(q, DVec3::new(1.0, -2.0, 0.5), DVec3::new(0.7, 0.2, -0.4));
        // A factor of the covariance, of no special form.
        let factor = SMatrix::<f64, 15, 15>::from_fn(|i, j| ((7 * i + 13 * j) as f64).sin() * 1e-2);
        let full = factor * factor.transpose();
        let covariance = Some(std::array::from_fn(|i| std::array::from_fn(|j| full[(i, j)])));
        let mut axes = Axes::new([10.0, 20.0, 30.0], 0);
        let exact = axes.turn(&State { covariance, ..base }).unwrap();
        let (mut pose, mut velocity) = (SMatrix::<f64, 6, 6>::zeros(), SMatrix::<f64, 6, 6>::zeros());
        let h = 1e-5;
        for column in 0..15 {
            let e: [f64; 15] = std::array::from_fn(|i| h * factor[(i, column)]);
            let part = |i: usize| DVec3::new(e[i], e[i + 1], e[i + 2]);
            let mut moved = base;
            moved.odometry.world_from_body.p += part(0);
            moved.odometry.world_from_body.q = q * DQuat::from_scaled_axis(part(3));
            moved.odometry.v_world += part(6);
            moved.rate -= part(9);
            let turned = axes.turn(&moved).unwrap();
            let rotated = (turned.local_from_vehicle * exact.local_from_vehicle.conjugate()).to_scaled_axis();
            let six = |a: DVec3, b: DVec3| {
                SMatrix::<f64, 6, 1>::from_iterator(a.to_array().into_iter().chain(b.to_array())) / h
            };
            let of_pose = six(turned.p - exact.p, rotated);
            let of_velocity = six(turned.v - exact.v, turned.rate - exact.rate);
            pose += of_pose * of_pose.transpose();
            velocity += of_velocity * of_velocity.transpose();
        }
        (3..6).for_each(|i| velocity[(i, i)] += 1e-4);
        assert!((pose - exact.pose_covariance.unwrap()).amax() < 1e-6 * pose.amax());
        assert!((velocity - exact.velocity_covariance.unwrap()).amax() < 1e-5 * velocity.amax());
        let told = triangle(&exact.pose_covariance);
        let diagonal = [0, 6, 11, 15, 18, 20].map(|i| told[i]);
        assert_eq!(diagonal, std::array::from_fn(|i| exact.pose_covariance.unwrap()[(i, i)] as f32));
    }
}
