//! How camera 0 moved from one frame to the next: two frames of one or two cameras, adjusted together with their points.
//!
//! Points are unknowns as well as the motion, as rays of inverse distance in the frame before (Schur complement), so that an
//! unsure depth weighs what it is worth: a depth taken as true would turn translation into rotation. Inverse depths and
//! the translation have wide priors, which is what one camera has to go by, and a camera that only turns.
//!
//! Points that are followed wrongly are off by less than a pixel where the camera moves little (reflections, edges, what stands
//! before something else), and lag behind more often than not: a weight that only bounds their pull left MH_01's yaw 3.3 % short
//! and its camera 1.0 degree from where it is. So the adjustment starts with Huber's weight and ends with that of Geman and
//! McClure (1987), to which they are nothing (0.1 %, and 0.3 degrees, as odometry estimates it too).

use super::agreement::median;
use glam::{DMat3, DQuat, DVec2, DVec3};
use nalgebra::{Matrix3, Matrix6, SMatrix, Vector3, Vector6};
use stipple_drivers::Pose;

/// Fewer points tell no motion.
pub const POINTS_MIN: usize = 12;
/// One camera needs some forty, two need ten.
const ITERATIONS: usize = 60;
/// A smaller step is the last, rad and m.
const STEP_MIN: f64 = 1e-8;
/// A smaller step is near enough to be without Huber's weight.
const STEP_HUBER: f64 = 1e-5;
/// Width of Huber's weight, on the plane at distance 1: a pixel and a half of a camera of 450 px.
const HUBER: f64 = 0.003;
/// Width of Geman's and McClure's, in deviations of the views; and the least, on the plane.
const GEMAN: f64 = 3.0;
const GEMAN_MIN: f64 = 1e-5;
/// Median of the length of two normal deviates.
const RAYLEIGH_MEDIAN: f64 = 1.177;
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
    /// Of weighted errors; of weights, and of what they take in of a further error.
    squares: f64,
    weights: f64,
    slopes: f64,
    views: usize,
}

/// Of a view so far off: Huber's, or where a width is given Geman's and McClure's; and how much of a further error is taken in,
/// of a component on average.
fn weight(off: f64, geman: Option<f64>) -> (f64, f64) {
    let Some(width) = geman else {
        let weight = (HUBER / off).min(1.0);
        return (weight, weight);
    };
    let u = (off / width).powi(2);
    let weight = (1.0 + u).powi(-2);
    (weight, weight * (1.0 - 2.0 * u / (1.0 + u)))
}

fn normal(
    point: &Point,
    views: &Views,
    pose: &Pose,
    second_from_first: Option<&Pose>,
    geman: Option<f64>,
    offs: &mut Vec<f64>,
) -> Normal {
    let rho_weight = (VIEW_SIGMA / RHO_SIGMA).powi(2);
    let mut n = Normal {
        pose: Matrix6::zeros(),
        cross: SMatrix::zeros(),
        point: Matrix3::from_diagonal(&Vector3::new(0.0, 0.0, rho_weight)),
        by_pose: Vector6::zeros(),
        by_point: Vector3::new(0.0, 0.0, rho_weight * (point.rho - RHO)),
        squares: 0.0,
        weights: 0.0,
        slopes: 0.0,
        views: 0,
    };
    let of = |moved: usize| {
        let second = views.second[moved].zip(second_from_first).map(|(seen, to)| (seen, moved == 1, Some(to)));
        [Some((views.first[moved], moved == 1, None)), second]
    };
    for (seen, moved, to_second) in [of(0), of(1)].into_iter().flatten().flatten() {
        let Some(v) = view(point, pose, moved, to_second) else { continue };
        let e = v.at - seen;
        offs.push(e.length());
        let (weight, slope) = weight(e.length(), geman);
        let e = nalgebra::Vector2::new(e.x, e.y);
        n.pose += weight * v.d_pose.transpose() * v.d_pose;
        n.cross += weight * v.d_pose.transpose() * v.d_point;
        n.point += weight * v.d_point.transpose() * v.d_point;
        n.by_pose += weight * v.d_pose.transpose() * e;
        n.by_point += weight * v.d_point.transpose() * e;
        n.squares += weight * weight * e.norm_squared();
        n.weights += weight;
        n.slopes += slope;
        n.views += 1;
    }
    n
}

/// `now_from_before` of camera 0, and the covariance of its rotation (of a small turn on the left), rad².
pub fn motion(seen: &[Views], second_from_first: Option<&Pose>) -> Option<(Pose, DMat3)> {
    let mut points: Vec<Point> = seen.iter().map(|v| Point { at: v.first[0], rho: RHO }).collect();
    let (mut pose, mut covariance) = (Pose::IDENTITY, Matrix6::zeros());
    let (mut geman, mut offs) = (None, Vec::new());
    for _ in 0..ITERATIONS {
        offs.clear();
        let each = points.iter().zip(seen);
        let list: Vec<Normal> = each.map(|(p, v)| normal(p, v, &pose, second_from_first, geman, &mut offs)).collect();
        let still = (VIEW_SIGMA / MOVED_SIGMA).powi(2);
        let mut h = Matrix6::from_diagonal(&Vector6::new(still, still, still, 0.0, 0.0, 0.0));
        let mut g = Vector6::new(still * pose.p.x, still * pose.p.y, still * pose.p.z, 0.0, 0.0, 0.0);
        let (mut squares, mut weights, mut slopes, mut views, mut free) = (0.0, 0.0, 0.0, 0.0, -6.0);
        for n in &list {
            let Some(inverse) = n.point.try_inverse() else { continue };
            h += n.pose - n.cross * inverse * n.cross.transpose();
            g += n.by_pose - n.cross * inverse * n.by_point;
            squares += n.squares;
            weights += n.weights;
            slopes += n.slopes;
            views += n.views as f64;
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
        // Of an M-estimator (Huber 1981, 7.6), with what the fit itself took from the errors given back.
        let free = f64::max(free, 1.0);
        covariance = inverse * (weights / views) * (squares / free) * (views / slopes).powi(2);
        match geman {
            None if step.norm() < STEP_HUBER => {
                let sigma = median(&offs) / RAYLEIGH_MEDIAN * (2.0 * views / free).sqrt();
                geman = Some((GEMAN * sigma).max(GEMAN_MIN));
            }
            Some(_) if step.norm() < STEP_MIN => break,
            _ => {}
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
    use crate::world::stream;

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
        assert!(error(&found).length() < 1e-4, "{}", error(&found));
    }

    #[test]
    fn points_that_lag_by_less_than_a_pixel_do_not_slow_the_turn() {
        let mut views = seen(2e-4, 1);
        for (i, v) in views.iter_mut().enumerate().filter(|(i, _)| i % 4 == 0) {
            let lags = 0.002 + 1e-4 * (i % 7) as f64;
            v.first[1].x += lags;
            v.second[1] = v.second[1].map(|s| s + DVec2::new(lags, 0.0));
        }
        let (found, _) = motion(&views, Some(&SECOND)).unwrap();
        assert!(error(&found).length() < 2e-4, "{}", error(&found));
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
