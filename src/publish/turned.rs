//! States in axes that others ask for, with their covariances.

use super::State;
use glam::{DMat3, DQuat, DVec3};
use nalgebra::{SMatrix, Vector3};

/// A state in other axes than the estimator's.
#[derive(Clone, Copy, Debug)]
pub struct Turned {
    /// Local frame, m.
    pub p: DVec3,
    pub local_from_vehicle: DQuat,
    /// Vehicle's axes, m/s and rad/s.
    pub v: DVec3,
    pub rate: DVec3,
    /// Covariance of position and rotation, both in the axes of the local frame; `None` where it is not known.
    pub pose_covariance: Option<SMatrix<f64, 6, 6>>,
    /// Covariance of velocity and rate, both in the vehicle's axes.
    pub velocity_covariance: Option<SMatrix<f64, 6, 6>>,
}

/// Standard deviation of an angular rate, rad/s, beside that of the gyro's bias: of nobody's use, and not zero.
const RATE_SIGMA: f64 = 0.01;

fn dmat(m: DMat3) -> SMatrix<f64, 3, 3> {
    SMatrix::from_column_slice(&m.to_cols_array())
}

fn cross(v: DVec3) -> SMatrix<f64, 3, 3> {
    Vector3::new(v.x, v.y, v.z).cross_matrix()
}

impl Turned {
    /// A state whose world is turned by `local_from_world` and whose body by `vehicle_from_body`; `None` where a number of it
    /// is not finite, as an f32.
    pub fn new(state: &State, local_from_world: DQuat, vehicle_from_body: DQuat) -> Option<Turned> {
        let (l, v) = (local_from_world, vehicle_from_body);
        let pose = &state.odometry.world_from_body;
        let v_body = pose.q.conjugate() * state.odometry.v_world;
        let covariances = state.covariance.as_ref().map(|c| covariances((l, pose.q, v), v_body, c));
        let turned = Turned {
            p: l * pose.p,
            local_from_vehicle: (l * pose.q * v.conjugate()).normalize(),
            v: v * v_body,
            rate: v * state.rate,
            pose_covariance: covariances.map(|(of_pose, _)| of_pose),
            velocity_covariance: covariances.map(|(_, of_velocity)| of_velocity),
        };
        let vectors = [turned.p, turned.v, turned.rate].into_iter().flat_map(|v| v.to_array());
        let entries = [&turned.pose_covariance, &turned.velocity_covariance].into_iter().flatten().flatten();
        let mut all = vectors.chain(turned.local_from_vehicle.to_array()).chain(entries.copied());
        all.all(|x| (x as f32).is_finite()).then_some(turned)
    }
}

/// Covariances of `Turned` from that of position and velocity in the world, of rotation on the right and of the biases.
/// The rotations: local from world, world from body, vehicle from body.
fn covariances(
    (l, q, v): (DQuat, DQuat, DQuat),
    v_body: DVec3,
    c: &[[f64; 15]; 15],
) -> (SMatrix<f64, 6, 6>, SMatrix<f64, 6, 6>) {
    let c = SMatrix::<f64, 15, 15>::from_fn(|i, j| c[i][j]);
    let [l, turn, v, body_from_world] = [l, l * q, v, q.conjugate()].map(|q| dmat(DMat3::from_quat(q)));
    // Positions, rotations, velocities and biases of the gyro are the first twelve errors.
    let (mut pose, mut velocity) = (SMatrix::<f64, 6, 15>::zeros(), SMatrix::<f64, 6, 15>::zeros());
    pose.fixed_view_mut::<3, 3>(0, 0).copy_from(&l);
    pose.fixed_view_mut::<3, 3>(3, 3).copy_from(&turn);
    // R Exp(δ) turns v back to v_body + v_body × δ.
    velocity.fixed_view_mut::<3, 3>(0, 3).copy_from(&(v * cross(v_body)));
    velocity.fixed_view_mut::<3, 3>(0, 6).copy_from(&(v * body_from_world));
    velocity.fixed_view_mut::<3, 3>(3, 9).copy_from(&-v);
    let mut of_velocity = velocity * c * velocity.transpose();
    (3..6).for_each(|i| of_velocity[(i, i)] += RATE_SIGMA * RATE_SIGMA);
    (pose * c * pose.transpose(), of_velocity)
}
