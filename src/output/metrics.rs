//! Trajectory error against ground truth: absolute (ATE) after a rigid alignment, relative over
//! one second (RTE in metres, RPE in degrees).
//!
//! Truth is interpolated at the stamps of the estimate, so the two need not share stamps.
//! Alignment: Umeyama, PAMI 1991, without scale, over all associated positions. Relative errors:
//! Sturm et al., IROS 2012, on E = (truthᵢ⁻¹ truthⱼ)⁻¹ (estᵢ⁻¹ estⱼ), which needs no alignment.

use glam::{DMat3, DQuat, DVec3};
use nalgebra::Matrix3;
use stipple_drivers::types::pose_at;
use stipple_drivers::{Nanos, Pose, Span, TimedPose};

/// Longest gap of ground truth that is interpolated: motion capture drops out, 0.1 s of flight
/// is still smooth.
const TRUTH_HOLE: Span = Span(100_000_000);
/// Longest gap of the estimate that is interpolated to find the pose one second later: five frames at 20 Hz.
const ESTIMATE_HOLE: Span = Span(250_000_000);
/// Distance in time of relative errors.
const DELTA: Span = Span(1_000_000_000);
/// An alignment has six unknowns; fewer positions than this fit anything.
const PAIRS_MIN: usize = 3;

#[derive(Clone, Debug, PartialEq)]
pub struct TrajectoryError {
    /// Root mean square position error after alignment, m.
    pub ate_rmse_m: f64,
    /// Root mean square translation error over one second, m; none when shorter than that.
    pub rte_1s_m: Option<f64>,
    /// Root mean square rotation error over one second, degrees.
    pub rpe_deg: Option<f64>,
    /// Moves the estimate onto the truth.
    pub truth_from_estimate: Pose,
    /// Position error at each associated stamp, m.
    pub errors: Vec<(Nanos, f64)>,
}

/// `None` when too few stamps of the estimate lie within the truth.
pub fn trajectory_error(estimated: &[TimedPose], truth: &[TimedPose]) -> Option<TrajectoryError> {
    let pairs: Vec<(Nanos, DVec3, DVec3)> = estimated
        .iter()
        .filter_map(|e| pose_at(truth, e.t, TRUTH_HOLE).map(|g| (e.t, e.pose.p, g.p)))
        .filter(|(_, e, g)| e.is_finite() && g.is_finite())
        .collect();
    if pairs.len() < PAIRS_MIN {
        return None;
    }
    let truth_from_estimate = align(pairs.iter().map(|&(_, e, g)| (e, g)));
    let errors: Vec<(Nanos, f64)> =
        pairs.iter().map(|&(t, e, g)| (t, truth_from_estimate.transform(e).distance(g))).collect();
    let (rte_1s_m, rpe_deg) = relative_error(estimated, truth, DELTA).unzip();
    let ate_rmse_m = rms(errors.iter().map(|e| e.1)).expect("there are at least PAIRS_MIN errors");
    Some(TrajectoryError { ate_rmse_m, rte_1s_m, rpe_deg, truth_from_estimate, errors })
}

/// The rigid transform that minimises Σ|T a - b|² over pairs (a, b).
pub fn align(pairs: impl Iterator<Item = (DVec3, DVec3)> + Clone) -> Pose {
    let n = pairs.clone().count().max(1) as f64;
    let (sum_a, sum_b) = pairs.clone().fold((DVec3::ZERO, DVec3::ZERO), |(sa, sb), (a, b)| (sa + a, sb + b));
    let (mean_a, mean_b) = (sum_a / n, sum_b / n);
    let mut cross = Matrix3::<f64>::zeros();
    for (a, b) in pairs {
        let (a, b) = ((a - mean_a).to_array(), (b - mean_b).to_array());
        cross += Matrix3::from_fn(|row, col| b[row] * a[col]);
    }
    let svd = cross.svd(true, true);
    let (u, v_t) = (svd.u.expect("asked for"), svd.v_t.expect("asked for"));
    // The last singular direction is flipped where the best orthogonal matrix would be a reflection.
    let handed = (u.determinant() * v_t.determinant()).signum();
    let r = u * Matrix3::from_diagonal(&nalgebra::Vector3::new(1.0, 1.0, handed)) * v_t;
    let q = DQuat::from_mat3(&DMat3::from_cols_slice(r.as_slice())).normalize();
    Pose { q, p: mean_b - q * mean_a }
}

/// Root mean square translation (m) and rotation (degrees) error of motions over `delta`.
fn relative_error(estimated: &[TimedPose], truth: &[TimedPose], delta: Span) -> Option<(f64, f64)> {
    let errors: Vec<Pose> = estimated
        .iter()
        .filter_map(|start| {
            let end = start.t + delta;
            let moved = start.pose.inverse() * pose_at(estimated, end, ESTIMATE_HOLE)?;
            let truly = pose_at(truth, start.t, TRUTH_HOLE)?.inverse() * pose_at(truth, end, TRUTH_HOLE)?;
            Some(truly.inverse() * moved)
        })
        .collect();
    let metres = rms(errors.iter().map(|e| e.p.length()))?;
    let degrees = rms(errors.iter().map(|e| angle_deg(e.q)))?;
    Some((metres, degrees))
}

/// Rotation angle; atan2 keeps the precision near zero that acos of w loses.
fn angle_deg(q: DQuat) -> f64 {
    (2.0 * q.xyz().length().atan2(q.w.abs())).to_degrees()
}

fn rms(values: impl ExactSizeIterator<Item = f64>) -> Option<f64> {
    let n = values.len();
    (n > 0).then(|| (values.map(|v| v * v).sum::<f64>() / n as f64).sqrt())
}

/// The value below which a fraction `p` of `values` lies (nearest rank); `None` when there are none.
pub fn percentile(values: &[f64], p: f64) -> Option<f64> {
    let mut sorted: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    let rank = (p * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.saturating_sub(1)).copied()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::f64::consts::TAU;

    /// Three seconds of a tilted figure of eight.
    fn flight(hz: f64) -> Vec<TimedPose> {
        let n = (3.0 * hz) as usize;
        let at = |i: usize| {
            let s = i as f64 / hz;
            let p = DVec3::new((TAU * s / 3.0).sin(), 0.5 * (2.0 * TAU * s / 3.0).sin(), 0.3 * s);
            let q = DQuat::from_euler(glam::EulerRot::ZYX, 0.4 * s, 0.2 * (3.0 * s).sin(), 0.1 * s);
            TimedPose { t: Nanos(1_400_000_000_000_000_000 + (s * 1e9) as i64), pose: Pose::new(q, p) }
        };
        (0..=n).map(at).collect()
    }

    fn moved(by: Pose, poses: &[TimedPose]) -> Vec<TimedPose> {
        poses.iter().map(|e| TimedPose { t: e.t, pose: by * e.pose }).collect()
    }

    #[test]
    fn rigidly_moved_trajectory_has_no_error_and_its_transform_is_found() {
        let truth = flight(200.0);
        let estimate_from_truth =
            Pose::new(DQuat::from_rotation_z(2.0) * DQuat::from_rotation_x(0.3), DVec3::new(3.0, -2.0, 1.0));
        let e = trajectory_error(&moved(estimate_from_truth, &truth), &truth).unwrap();
        assert!(e.ate_rmse_m < 1e-12 && e.rte_1s_m.unwrap() < 1e-12 && e.rpe_deg.unwrap() < 1e-9, "{e:?}");
        let left = e.truth_from_estimate * estimate_from_truth;
        assert!(left.p.length() < 1e-9 && angle_deg(left.q) < 1e-9);
    }

    #[test]
    fn alternating_offset_is_the_ate() {
        // ±d along z at alternate stamps: no rigid motion removes it.
        let truth = flight(200.0);
        let mut estimate = truth.clone();
        for (i, e) in estimate.iter_mut().enumerate() {
            e.pose.p.z += if i % 2 == 0 { 0.05 } else { -0.05 };
        }
        let e = trajectory_error(&estimate, &truth).unwrap();
        assert!((e.ate_rmse_m - 0.05).abs() < 1e-4, "{}", e.ate_rmse_m);
        assert_eq!(e.errors.len(), truth.len());
    }

    #[test]
    fn scale_is_not_removed() {
        let truth = flight(200.0);
        let mut estimate = truth.clone();
        estimate.iter_mut().for_each(|e| e.pose.p *= 1.1);
        let e = trajectory_error(&estimate, &truth).unwrap();
        let mean = truth.iter().map(|e| e.pose.p).sum::<DVec3>() / truth.len() as f64;
        let spread = rms(truth.iter().map(|e| e.pose.p.distance(mean))).unwrap();
        assert!((e.ate_rmse_m - 0.1 * spread).abs() < 1e-9);
    }

    #[test]
    fn constant_drift_is_the_relative_error() {
        // 3 cm/s along the body's x and 2 °/s about the body's z, in the body frame of a straight flight.
        let straight = |s: f64| Pose::new(DQuat::IDENTITY, DVec3::new(s, 0.0, 0.0));
        let drift = |s: f64| Pose::new(DQuat::from_rotation_z((2.0 * s).to_radians()), DVec3::new(1.03 * s, 0.0, 0.0));
        let sample = |f: &dyn Fn(f64) -> Pose| -> Vec<TimedPose> {
            (0..=40).map(|i| TimedPose { t: Nanos(i * 50_000_000), pose: f(i as f64 * 0.05) }).collect()
        };
        let e = trajectory_error(&sample(&drift), &sample(&straight)).unwrap();
        assert!((e.rpe_deg.unwrap() - 2.0).abs() < 1e-9);
        // E.p = est_i⁻¹(est_j) - x̂: 1.03 m along a heading that is wrong by the drift at the start.
        let expected = rms((0..21).map(|i| {
            let yaw = (2.0 * i as f64 * 0.05).to_radians();
            DVec3::new(1.03 * yaw.cos() - 1.0, -1.03 * yaw.sin(), 0.0).length()
        }))
        .unwrap();
        assert!((e.rte_1s_m.unwrap() - expected).abs() < 1e-9);
    }

    #[test]
    fn truth_is_interpolated_at_the_stamps_of_the_estimate() {
        let truth = flight(200.0);
        let estimate: Vec<TimedPose> = flight(30.0).into_iter().skip(2).collect();
        let e = trajectory_error(&estimate, &truth).unwrap();
        assert!(e.ate_rmse_m < 2e-5, "linear interpolation at 200 Hz: {}", e.ate_rmse_m);
        assert!(e.rpe_deg.unwrap() < 2e-3);
    }

    #[test]
    fn short_or_foreign_trajectories_have_no_figures() {
        let truth = flight(200.0);
        assert_eq!(trajectory_error(&truth[..2], &truth), None);
        let later: Vec<TimedPose> = truth.iter().map(|e| TimedPose { t: e.t + Span::from_secs(1e3), ..*e }).collect();
        assert_eq!(trajectory_error(&later, &truth), None);
        let short = trajectory_error(&truth[..100], &truth).unwrap();
        assert!(short.ate_rmse_m < 1e-12 && short.rte_1s_m.is_none() && short.rpe_deg.is_none());
    }

    #[test]
    fn planar_and_still_trajectories_align_without_reflection() {
        let planar: Vec<DVec3> =
            (0..50).map(|i| DVec3::new((i as f64 * 0.2).cos(), (i as f64 * 0.3).sin(), 0.0)).collect();
        let by = Pose::new(DQuat::from_rotation_x(3.0), DVec3::X);
        let found = align(planar.iter().map(|&p| (p, by.transform(p))));
        assert!((found.rotation().determinant() - 1.0).abs() < 1e-9);
        assert!(planar.iter().all(|&p| found.transform(p).distance(by.transform(p)) < 1e-9));
        let still = align([DVec3::ONE; 4].into_iter().map(|p| (p, p + DVec3::Z)));
        assert!(still.is_finite() && still.transform(DVec3::ONE).distance(DVec3::new(1.0, 1.0, 2.0)) < 1e-12);
    }

    #[test]
    fn percentile_is_the_nearest_rank() {
        let v: Vec<f64> = (1..=100).rev().map(f64::from).collect();
        assert_eq!(percentile(&v, 0.5), Some(50.0));
        assert_eq!(percentile(&v, 0.99), Some(99.0));
        assert_eq!(percentile(&[7.0], 0.99), Some(7.0));
        assert_eq!(percentile(&[], 0.5), None);
    }
}
