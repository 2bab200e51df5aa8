//! Innovation gate: which tracks can be the landmarks they claim to be.
//!
//! A known landmark is predicted into the newest frame before any of its views is believed; what lies
//! further from that than the uncertainty of the prediction allows is left out. The uncertainty is that
//! of the motion since the frame before (inertial increment, and the velocity and gyro bias it
//! started from), of the landmark's inverse distance, and of both views: `eᵀ S⁻¹ e` with
//! `S = J P Jᵀ + J_ρ σ_ρ² J_ρᵀ + 2 σ² I` against a chi-square bound. When most of many fail at once
//! it may be the prediction that is wrong, and the gate is left open.

use super::graph::Graph;
use super::inertial::{body_velocity_covariance, Covariance};
use super::landmarks::{Landmark, Observation};
use super::projection::{observe, Host};
use super::rig::CAMERA_DIM_MAX;
use super::window::{Window, POSE_DIM};
use crate::frontend::{Rejected, Tracks};
use crate::limits::{CAMERAS_MAX, TRACKS};
use crate::math::block::matrix;
use nalgebra::{Matrix3, SMatrix, SVector};

/// Two degrees of freedom pass with all but 4e-6 of true views.
const CHI_SQUARE_MAX: f64 = 25.0;
/// The prediction is taken to be wrong when a frame has at least so many views of known landmarks and less than this share of
/// them passes. Fewer views cannot tell, and wrong ones would pull the pose with them.
const VIEWS_MIN: usize = 8;
const PASS_MIN: f64 = 0.6;

/// Covariance of the predicted pose relative to the window, errors [p in the world, θ on the right].
pub type PoseCovariance = SMatrix<f64, POSE_DIM, POSE_DIM>;

/// Covariance of the frame in `slot`, which is where an increment led from the frame before it, whose velocity and
/// gyro bias have the covariance `from`.
pub fn predicted_covariance(window: &Window, slot: usize, from: &Covariance) -> PoseCovariance {
    let frame = window.frame(slot);
    let (dt, inc) = (frame.increment.dt, &frame.increment.covariance);
    let before = window.slots().rev().nth(1).map(|s| window.frame(s).now).unwrap_or_default();
    let r = matrix(before.pose.rotation());
    let block = |row: usize, col: usize| inc.fixed_view::<3, 3>(row, col).into_owned();
    let of = |at: usize| Matrix3::from_fn(|i, j| from[at + i][at + j]) * (dt * dt);
    let mut p = PoseCovariance::zeros();
    // In the body, since the world's yaw moves the points that the window sees too.
    let of_velocity = r * body_velocity_covariance(from, &before) * r.transpose() * (dt * dt);
    p.fixed_view_mut::<3, 3>(0, 0).copy_from(&(r * block(0, 0) * r.transpose() + of_velocity));
    p.fixed_view_mut::<3, 3>(3, 3).copy_from(&(block(3, 3) + of(9)));
    let cross = r * block(0, 3);
    p.fixed_view_mut::<3, 3>(0, 3).copy_from(&cross);
    p.fixed_view_mut::<3, 3>(3, 0).copy_from(&cross.transpose());
    p
}

/// Squared Mahalanobis distance of a view from its prediction; `None` where it cannot be predicted.
fn distance(l: &Landmark, o: &Observation, window: &Window, p: &PoseCovariance, sigma_px: f64) -> Option<f64> {
    let mut columns = [[0.0; CAMERA_DIM_MAX]; 2];
    let r = observe(l, &Host::of(l, window), o, window, &mut columns)?;
    let j = SMatrix::<f64, 2, POSE_DIM>::from_fn(|i, k| r.d_target[i][k]);
    let d_rho = SVector::<f64, 2>::new(r.d_point[0][2], r.d_point[1][2]) * f64::from(l.rho_sigma);
    let mut s = j * p * j.transpose() + d_rho * d_rho.transpose();
    (0..2).for_each(|i| s[(i, i)] += 2.0 * sigma_px * sigma_px);
    let e = SVector::<f64, 2>::new(r.px.x, r.px.y);
    Some(e.dot(&(s.try_inverse()? * e)))
}

/// What the gate did to a frame's tracks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Passed {
    pub refused: usize,
    /// Most would have been refused, so none was.
    pub open: bool,
}

/// Adds an id; a point that several cameras see is rejected once.
pub fn add_once(rejected: &mut Rejected, id: u64) {
    if !rejected.contains(&id) {
        let _ = rejected.push(id);
    }
}

/// Takes out of `tracks` the views of known landmarks that cannot be theirs, and lists their ids.
pub fn gate(
    graph: &Graph,
    slot: usize,
    tracks: &mut Tracks,
    p: &PoseCovariance,
    sigma_px: f64,
    rejected: &mut Rejected,
) -> Passed {
    let Graph { window, landmarks, .. } = graph;
    let mut wrong = [[false; TRACKS]; CAMERAS_MAX];
    let (mut known, mut refused) = (0, 0);
    for (camera, list) in tracks.cameras.iter().enumerate() {
        for (i, track) in list.iter().enumerate() {
            let Some(l) = landmarks.find(track.id).map(|at| &landmarks.pool[at]) else { continue };
            let seen = Observation { slot: slot as u8, camera: camera as u8, px: track.px };
            // A point that cannot be predicted is left to the optimization to judge.
            let Some(d) = distance(l, &seen, window, p, sigma_px) else { continue };
            known += 1;
            // Also when it is not a number.
            wrong[camera][i] = !(d <= CHI_SQUARE_MAX);
            refused += wrong[camera][i] as usize;
        }
    }
    if known >= VIEWS_MIN && ((known - refused) as f64) < PASS_MIN * known as f64 {
        return Passed { refused: 0, open: true };
    }
    for (list, wrong) in tracks.cameras.iter_mut().zip(&wrong) {
        let mut i = 0;
        list.retain(|track| {
            i += 1;
            if wrong[i - 1] {
                add_once(rejected, track.id);
            }
            !wrong[i - 1]
        });
    }
    Passed { refused, open: false }
}
