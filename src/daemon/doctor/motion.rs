//! How camera 0 moved from one frame to the next: two frames of one or two cameras, adjusted together with their points.
//!
//! Points are unknowns as well as the motion, as rays of inverse distance in the frame before (Schur complement), so that an
//! unsure depth weighs what it is worth: a depth taken as true would turn translation into rotation. Inverse depths and
//! the translation have wide priors, which is what one camera has to go by, and a camera that only turns.

use glam::{DMat3, DQuat, DVec2, DVec3};
use nalgebra::{Matrix3, Matrix6, SMatrix, Vector3, Vector6};
use stipple_drivers::Pose;

/// Fewer points tell no motion.
pub const POINTS_MIN: usize = 12;
/// One camera needs some thirty, two need five.
const ITERATIONS: usize = 50;
/// A smaller step is the last, rad and m.
const STEP_MIN: f64 = 1e-8;
/// Width of the robust weight, on the plane at distance 1: a pixel and a half of a camera of 450 px.
const HUBER: f64 = 0.003;
/// Of a view, on that plane: what the priors are held against.
const VIEW_SIGMA: f64 = 5e-4;
/// Inverse depth, 1/m, and translation, m, of which nothing else is known.
const RHO: f64 = 0.25;
const RHO_SIGMA: f64 = 0.5;
const RHO_MAX: f64 = 10.0;
const MOVED_SIGMA: f64 = 0.5;
/// Nothing this near is seen, of the distance to the plane.
const NEAR: f64 = 0.05;

/// Where the rays of one point meet the plane at distance 1 in camera 0 and camera 1: before, then now.
#[derive(Clone, Copy, Debug)]
pub struct Views {
    pub first: [DVec2; 2],
    pub second: [Option<DVec2>; 2],
}

/// A point in the frame before: (x, y, 1) / rho.
#[derive(Clone, Copy, Debug)]
struct Point {
    at: DVec2,
    rho: f64,
}

type Row6 = SMatrix<f64, 2, 6>;
type Row3 = SMatrix<f64, 2, 3>;

/// A view as the estimate has it: place on the plane, and derivatives by translation and rotation (left) and by the point.
struct View {
    at: DVec2,
    d_pose: Row6,
    d_point: Row3,
}

/// `moved`: now, not before. `to_second`: in camera 1. `None` where it cannot be seen.
fn view(point: &Point, pose: &Pose, moved: bool, to_second: Option<&Pose>) -> Option<View> {
    let u = point.at.extend(1.0);
    let (r, t) = if moved { (pose.rotation(), pose.p) } else { (DMat3::IDENTITY, DVec3::ZERO) };
    let h0 = r * u + t * point.rho;
    let (turn, shift) = to_second.map_or((DMat3::IDENTITY, DVec3::ZERO), |s| (s.rotation(), s.p));
    let h = turn * h0 + shift * point.rho;
    if h.z < NEAR {
        return None;
    }
    let at = h.truncate() / h.z;
    let plane = |d: DVec3| (d.truncate() - at * d.z) / h.z;
    let axes = [DVec3::X, DVec3::Y, DVec3::Z];
    let d_pose: [DVec2; 6] = std::array::from_fn(|k| match k {
        _ if !moved => DVec2::ZERO,
        0..=2 => plane(turn * axes[k] * point.rho),
        _ => plane(turn * axes[k - 3].cross(h0)),
    });
    let d_point = [plane(turn * r.x_axis), plane(turn * r.y_axis), plane(turn * t + shift)];
    Some(View { at, d_pose: Row6::from_fn(|i, k| d_pose[k][i]), d_point: Row3::from_fn(|i, k| d_point[k][i]) })
}

/// The normal equations of one point with the pose.
struct Normal {
    pose: Matrix6<f64>,
    cross: SMatrix<f64, 6, 3>,
    point: Matrix3<f64>,
    by_pose: Vector6<f64>,
    by_point: Vector3<f64>,
    squares: f64,
    views: usize,
}

fn normal(point: &Point, views: &Views, pose: &Pose, second_from_first: Option<&Pose>) -> Normal {
    let rho_weight = (VIEW_SIGMA / RHO_SIGMA).powi(2);
    let mut n = Normal {
        pose: Matrix6::zeros(),
        cross: SMatrix::zeros(),
        point: Matrix3::from_diagonal(&Vector3::new(0.0, 0.0, rho_weight)),
        by_pose: Vector6::zeros(),
        by_point: Vector3::new(0.0, 0.0, rho_weight * (point.rho - RHO)),
        squares: 0.0,
        views: 0,
    };
    let of = |moved: usize| {
        let second = views.second[moved].zip(second_from_first).map(|(seen, to)| (seen, moved == 1, Some(to)));
        [Some((views.first[moved], moved == 1, None)), second]
    };
    for (seen, moved, to_second) in [of(0), of(1)].into_iter().flatten().flatten() {
        let Some(v) = view(point, pose, moved, to_second) else { continue };
        let e = v.at - seen;
        let weight = (HUBER / e.length()).min(1.0);
        let e = nalgebra::Vector2::new(e.x, e.y);
        n.pose += weight * v.d_pose.transpose() * v.d_pose;
        n.cross += weight * v.d_pose.transpose() * v.d_point;
        n.point += weight * v.d_point.transpose() * v.d_point;
        n.by_pose += weight * v.d_pose.transpose() * e;
        n.by_point += weight * v.d_point.transpose() * e;
        n.squares += weight * e.norm_squared();
        n.views += 1;
    }
    n
}

/// `now_from_before` of camera 0, and the covariance of its rotation (of a small turn on the left), rad².
pub fn motion(seen: &[Views], second_from_first: Option<&Pose>) -> Option<(Pose, DMat3)> {
    let mut points: Vec<Point> = seen.iter().map(|v| Point { at: v.first[0], rho: RHO }).collect();
    let (mut pose, mut covariance) = (Pose::IDENTITY, Matrix6::zeros());
    for _ in 0..ITERATIONS {
        let list: Vec<Normal> = points.iter().zip(seen).map(|(p, v)| normal(p, v, &pose, second_from_first)).collect();
        let still = (VIEW_SIGMA / MOVED_SIGMA).powi(2);
        let mut h = Matrix6::from_diagonal(&Vector6::new(still, still, still, 0.0, 0.0, 0.0));
        let mut g = Vector6::new(still * pose.p.x, still * pose.p.y, still * pose.p.z, 0.0, 0.0, 0.0);
        let (mut squares, mut free) = (0.0, -6.0);
        for n in &list {
            let Some(inverse) = n.point.try_inverse() else { continue };
            h += n.pose - n.cross * inverse * n.cross.transpose();
            g += n.by_pose - n.cross * inverse * n.by_point;
            squares += n.squares;
            free += 2.0 * n.views as f64 - 3.0;
        }
        let inverse = h.cholesky()?.inverse();
        let step = -(inverse * g);
        for (point, n) in points.iter_mut().zip(&list) {
            let Some(inverse) = n.point.try_inverse() else { continue };
            let d = -(inverse * (n.by_point + n.cross.transpose() * step));
            point.at += DVec2::new(d.x, d.y);
            point.rho = (point.rho + d.z).clamp(0.0, RHO_MAX);
        }
        let turn = DQuat::from_scaled_axis(DVec3::new(step[3], step[4], step[5]));
        pose = Pose::new(turn * pose.q, turn * pose.p + DVec3::new(step[0], step[1], step[2]));
        covariance = inverse * (squares / f64::max(free, 1.0));
        if step.norm() < STEP_MIN {
            break;
        }
    }
    let fits = |(point, views): &(&Point, &Views)| {
        let off =
            |moved: usize| view(point, &pose, moved == 1, None).map_or(1.0, |v| (v.at - views.first[moved]).length());
        off(0).max(off(1)) < HUBER
    };
    let right = points.iter().zip(seen).filter(fits).count();
    let turn = DMat3::from_cols_array(&std::array::from_fn(|i| covariance[(3 + i % 3, 3 + i / 3)]));
    (pose.is_finite() && 2 * right > seen.len()).then_some((pose, turn))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::bench::world::stream;

    const SECOND: Pose = Pose { q: DQuat::IDENTITY, p: DVec3::new(-0.11, 0.0, 0.0) };

    fn truth() -> Pose {
        Pose::new(DQuat::from_scaled_axis(DVec3::new(0.03, -0.05, 0.02)), DVec3::new(0.02, -0.01, 0.04))
    }

    /// What two cameras see of 60 points, each `sigma` off.
    fn seen(sigma: f64, seed: u64) -> Vec<Views> {
        let mut rng = stream(seed, 0x6472);
        let mut noise = || sigma * rng.vector().truncate();
        let point = |i: usize| DVec3::new((i as f64 * 0.7).sin(), (i as f64 * 1.3).cos(), 2.0 + (i % 5) as f64);
        let plane = |p: DVec3| p.truncate() / p.z;
        (0..60)
            .map(|i| {
                let (a, b) = (point(i), truth().transform(point(i)));
                let mut at = |p: DVec3| plane(p) + noise();
                Views { first: [at(a), at(b)], second: [Some(at(SECOND.transform(a))), Some(at(SECOND.transform(b)))] }
            })
            .collect()
    }

    fn error(found: &Pose) -> DVec3 {
        (found.q * truth().q.conjugate()).to_scaled_axis()
    }

    #[test]
    fn derivatives_are_those_of_finite_differences() {
        let point = Point { at: DVec2::new(0.3, -0.2), rho: 0.4 };
        const H: f64 = 1e-6;
        for (moved, second) in [(false, false), (false, true), (true, false), (true, true)] {
            let to = second.then_some(&SECOND);
            let v = view(&point, &truth(), moved, to).unwrap();
            for k in 0..9 {
                let at = |h: f64| {
                    let (mut p, mut pose) = (point, truth());
                    match k {
                        0..=2 => pose.p[k] += h,
                        3..=5 => {
                            let turn = DQuat::from_scaled_axis(DVec3::AXES[k - 3] * h);
                            pose = Pose::new(turn * pose.q, turn * pose.p);
                        }
                        6 | 7 => p.at[k - 6] += h,
                        _ => p.rho += h,
                    }
                    view(&p, &pose, moved, to).unwrap().at
                };
                let numeric = (at(H) - at(-H)) / (2.0 * H);
                let analytic: [f64; 2] =
                    std::array::from_fn(|i| if k < 6 { v.d_pose[(i, k)] } else { v.d_point[(i, k - 6)] });
                assert!((numeric - DVec2::from(analytic)).length() < 1e-7, "{moved} {second} {k}");
            }
        }
    }

    #[test]
    fn the_motion_of_points_is_found_with_a_third_of_them_wrong() {
        let mut views = seen(0.0, 1);
        for (i, v) in views.iter_mut().enumerate().filter(|(i, _)| i % 3 == 0) {
            v.first[1] += DVec2::new(0.05, -0.08) * (i % 7) as f64;
        }
        let (found, _) = motion(&views, Some(&SECOND)).unwrap();
        assert!(error(&found).length() < 3e-3, "{}", error(&found));
    }

    #[test]
    fn one_camera_tells_the_turn_while_it_moves() {
        let (found, _) = motion(&seen(1e-4, 1), None).unwrap();
        assert!(error(&found).length() < 1e-3, "{}", error(&found));
    }

    #[test]
    fn errors_of_the_turn_are_as_large_as_stated() {
        let squares = (0..100).map(|seed| {
            let (found, covariance) = motion(&seen(3e-4, seed), Some(&SECOND)).unwrap();
            let e = error(&found);
            e.dot(covariance.inverse() * e) / 3.0
        });
        let mean = squares.sum::<f64>() / 100.0;
        assert!((0.75..1.3).contains(&mean), "{mean}");
    }
}
