//! A coarse relation of gyro and camera 0, for a start near enough for the odometry estimator: the offset of their clocks
//! and the rotation between their axes, of either handedness.
//!
//! In: rotation rates of the camera between neighbouring frames, and inertial samples. Both rates are compared without their
//! means, so a constant bias of the gyro changes nothing. At each offset the sum of the singular values of their
//! cross-covariance is the best correlation that any rotation or reflection can give (Wahba's problem; Markley 1988), so one
//! search finds both.

use crate::math::block::vector;
use crate::math::so3::log;
use glam::{DMat3, DQuat, DVec2, DVec3};
use nalgebra::{Matrix2, Matrix2x6, Matrix3, Matrix6, Vector2, Vector6};
use stipple_drivers::{ImuSample, Nanos, Pose};

/// Offsets that are searched, and their step, s.
const OFFSET_MAX: f64 = 0.3;
const OFFSET_STEP: f64 = 0.005;
/// Samples further apart are not integrated across, s.
const GAP_MAX: f64 = 0.05;
/// Least correlation of the two rates at which they are believed to be of one rig.
pub const CORRELATED: f64 = 0.8;
/// Frames between which rates are compared, at least.
const TURNS_MIN: usize = 12;
/// One handedness must leave this much less unexplained than the other to be believed, as a ratio of deviations.
const HANDEDNESS: f64 = 1.3;
/// Axes are named wrongly where a naming leaves less than this of the rotation, rad: a mount is not 20 degrees off.
const NAMED: f64 = 0.35;
/// A smaller rotation is left to the estimator, rad.
const SMALL: f64 = 0.1;

/// How camera 0 turned from one frame to the next.
#[derive(Clone, Copy, Debug)]
pub struct Turn {
    pub from: Nanos,
    pub to: Nanos,
    /// Mean rate about the camera's axes, rad/s.
    pub rate: DVec3,
}

/// Relation of the rates. Nothing is taken out of a gyro whose rate is not the camera's: offset 0, axes as they are.
#[derive(Clone, Copy, Debug)]
pub struct Coarse {
    /// Clock of the gyro ahead of the camera's, s.
    pub offset_s: f64,
    /// Signed names of the axes: `axes * reading` is in the body.
    pub axes: DMat3,
    /// What is left after the names, where it is large: `rotation * axes * reading` is in the body.
    pub rotation: DQuat,
    /// Whether the rates can tell a left-handed gyro from a right-handed one.
    pub handed: bool,
    /// Correlation of the two rates, 0 to 1.
    pub correlation: f64,
    /// Covariance of the camera's rate, about its axes, (rad/s)².
    pub excitation: DMat3,
    /// Standard deviation of the gyro's rate, rad/s.
    pub gyro_sigma: f64,
}

/// Angle that the gyro turned since its first sample, each axis by itself: its differences over a frame are mean rates.
struct Angles<'a> {
    imu: &'a [ImuSample],
    sum: Vec<DVec3>,
}

impl Angles<'_> {
    fn new(imu: &[ImuSample]) -> Angles<'_> {
        let mut sum = vec![DVec3::ZERO];
        for w in imu.windows(2) {
            let step = 0.5 * (w[0].gyro_body + w[1].gyro_body) * (w[1].t - w[0].t).secs();
            sum.push(sum[sum.len() - 1] + step);
        }
        Angles { imu, sum }
    }

    fn at(&self, t: Nanos, offset: f64) -> Option<DVec3> {
        let after = self.imu.partition_point(|s| (s.t - t).secs() <= offset);
        let (a, b) = (self.imu.get(after.checked_sub(1)?)?, self.imu.get(after)?);
        let gap = (b.t - a.t).secs();
        let part = ((t - a.t).secs() + offset) / gap;
        (gap < GAP_MAX).then(|| self.sum[after - 1].lerp(self.sum[after], part))
    }

    fn rate(&self, turn: &Turn, offset: f64) -> Option<DVec3> {
        Some((self.at(turn.to, offset)? - self.at(turn.from, offset)?) / (turn.to - turn.from).secs())
    }
}

/// Sums over frames of products of the two rates, means aside.
struct Products {
    n: f64,
    camera: Matrix3<f64>,
    gyro: f64,
    cross: Matrix3<f64>,
}

impl Products {
    fn new(turns: &[Turn], angles: &Angles, offset: f64) -> Option<Products> {
        let pairs: Vec<_> = turns.iter().filter_map(|t| Some((t.rate, angles.rate(t, offset)?))).collect();
        let n = pairs.len() as f64;
        if pairs.len() < TURNS_MIN {
            return None;
        }
        let sum = pairs.iter().fold((DVec3::ZERO, DVec3::ZERO), |s, p| (s.0 + p.0, s.1 + p.1));
        let mut all = Products { n, camera: Matrix3::zeros(), gyro: 1e-12, cross: Matrix3::zeros() };
        for (camera, gyro) in pairs {
            let (c, g) = (vector(camera - sum.0 / n), vector(gyro - sum.1 / n));
            all.camera += c * c.transpose();
            all.gyro += g.norm_squared();
            all.cross += c * g.transpose();
        }
        Some(all)
    }

    /// Best correlation over all orthogonal matrices.
    fn correlation(&self) -> f64 {
        self.cross.singular_values().sum() / ((self.camera.trace() + 1e-12) * self.gyro).sqrt()
    }

    /// The matrix of determinant `hand` that takes the gyro's rate to the camera's best, and the squares it leaves.
    fn orthogonal(&self, hand: f64) -> Option<(Matrix3<f64>, f64)> {
        let svd = self.cross.svd(true, true);
        let (u, v_t) = (svd.u?, svd.v_t?);
        // The least singular value is the last.
        let sign = nalgebra::Vector3::new(1.0, 1.0, hand * (u * v_t).determinant().signum());
        let explained = svd.singular_values.dot(&sign);
        Some((u * Matrix3::from_diagonal(&sign) * v_t, self.camera.trace() + self.gyro - 2.0 * explained))
    }
}

/// Relation of the rates; `None` of too little to say anything. `body_from_cam` is the calibration's.
pub fn coarse(turns: &[Turn], imu: &[ImuSample], body_from_cam: DQuat) -> Option<Coarse> {
    let angles = Angles::new(imu);
    let score = |k: i32| Products::new(turns, &angles, f64::from(k) * OFFSET_STEP).map(|p| p.correlation());
    let steps = (OFFSET_MAX / OFFSET_STEP) as i32;
    let scored = (-steps..=steps).filter_map(|k| Some((k, score(k)?)));
    let (best, peak) = scored.max_by(|a, b| a.1.total_cmp(&b.1))?;
    // The top of the parabola through the best and its neighbours.
    let top = score(best - 1).zip(score(best + 1)).map_or(0.0, |(a, b)| 0.5 * (a - b) / (a - 2.0 * peak + b));
    let top = if top.is_finite() { top.clamp(-0.5, 0.5) } else { 0.0 };
    let offset_s = (f64::from(best) + top) * OFFSET_STEP;
    let products = Products::new(turns, &angles, offset_s)?;
    let (right, left) = (products.orthogonal(1.0)?, products.orthogonal(-1.0)?);
    let ratio = (left.1 / right.1).sqrt();
    let cam_from_reading = if ratio < 1.0 / HANDEDNESS { left.0 } else { right.0 };
    let body_from_reading = DMat3::from_quat(body_from_cam) * DMat3::from_cols_array_2d(&cam_from_reading.into());
    let correlation = products.correlation();
    let agree = correlation > CORRELATED;
    // Turning about one axis alone leaves the rotation about it open.
    let told = agree && products.cross.singular_values()[1] > 2.0 * right.1.min(left.1);
    let (axes, rotation) = if told { naming(&body_from_reading) } else { (DMat3::IDENTITY, DQuat::IDENTITY) };
    Some(Coarse {
        offset_s: if agree { offset_s } else { 0.0 },
        axes,
        rotation,
        handed: told && !(1.0 / HANDEDNESS..HANDEDNESS).contains(&ratio),
        correlation,
        excitation: DMat3::from_cols_array_2d(&(products.camera / products.n).into()),
        gyro_sigma: (products.gyro / products.n).sqrt(),
    })
}

/// The 48 ways to name three axes with their signs.
fn namings() -> impl Iterator<Item = DMat3> {
    const ORDERS: [[usize; 3]; 6] = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
    ORDERS.into_iter().flat_map(|order| {
        (0..8).map(move |signs| {
            let column = |k: usize| DVec3::AXES[order[k]] * if signs >> k & 1 == 1 { -1.0 } else { 1.0 };
            DMat3::from_cols(column(0), column(1), column(2))
        })
    })
}

/// How the axes are named, if `body_from_reading` is that and a small rotation, and the rotation where it is not small.
fn naming(body_from_reading: &DMat3) -> (DMat3, DQuat) {
    let left = |p: &DMat3| DQuat::from_mat3(&(*body_from_reading * p.transpose())).normalize();
    let hand = body_from_reading.determinant();
    let same = namings().filter(|p| p.determinant() * hand > 0.0);
    let angle = |p: &DMat3| log(left(p)).length();
    let nearest = same.min_by(|a, b| angle(a).total_cmp(&angle(b))).unwrap_or(DMat3::IDENTITY);
    let axes = if hand > 0.0 && angle(&nearest) > NAMED { DMat3::IDENTITY } else { nearest };
    (axes, if angle(&axes) > SMALL { left(&axes) } else { DQuat::IDENTITY })
}

/// Deviation of a point on the plane at distance 1.
const POINT_SIGMA: f64 = 1e-3;
/// Inverse depth of a point that one camera sees, and its deviation, 1/m.
const INVERSE_DEPTH: [f64; 2] = [0.25, 0.5];
/// Deviation of the translation between neighbouring frames, m.
const MOVED_SIGMA: f64 = 0.05;
/// Distance in deviations at which a point has half its weight.
const CAUCHY: f64 = 3.0;
const POINTS_MIN: usize = 10;
/// Share of points, each by its weight, that must follow one motion.
const AGREEING_MIN: f64 = 0.6;
const ITERATIONS: usize = 20;

/// A point on the plane at distance 1, before and now, and its inverse depth with deviation, 1/m.
#[derive(Clone, Copy, Debug)]
pub struct Point {
    pub before: DVec2,
    pub now: DVec2,
    pub inverse_depth: [f64; 2],
}

impl Point {
    /// `second` is where camera 1 sees the point now, as a ray; `second_from_first` relates the cameras.
    pub fn new(before: DVec2, now: DVec2, second: Option<DVec3>, second_from_first: Option<Pose>) -> Point {
        // Where the ray of the first camera, turned and shifted by the baseline, meets that of the second.
        let met = second.zip(second_from_first).map(|(ray, pose)| {
            let (across, along) = (ray.cross(pose.p), ray.cross(pose.q * now.extend(1.0)));
            let lever = across.length() / ray.length();
            [-across.dot(along) / across.length_squared(), POINT_SIGMA / lever]
        });
        let sure = |m: &[f64; 2]| m[0] > -m[1] && m[1] < INVERSE_DEPTH[1];
        Point { before, now, inverse_depth: met.filter(sure).unwrap_or(INVERSE_DEPTH) }
    }
}

/// Small rotation of a camera from the points it follows: rotation vector of `before_from_now`.
///
/// Their flow is linear in the rotation and in the translation times each point's inverse depth (Longuet-Higgins and Prazdny
/// 1980). Robust Gauss-Newton over all of them, inverse depths eliminated.
pub fn rotation(points: &[Point]) -> Option<DVec3> {
    if points.len() < POINTS_MIN {
        return None;
    }
    let mut x = Vector6::<f64>::zeros();
    let mut inverse_depths: Vec<f64> = points.iter().map(|p| p.inverse_depth[0]).collect();
    let loose = MOVED_SIGMA.powi(-2);
    let mut agreeing = 0.0;
    for _ in 0..ITERATIONS {
        let mut a = Matrix6::from_diagonal(&Vector6::new(0.0, 0.0, 0.0, loose, loose, loose));
        let mut b = Vector6::new(0.0, 0.0, 0.0, -loose * x[3], -loose * x[4], -loose * x[5]);
        agreeing = 0.0;
        for (point, rho) in points.iter().zip(&mut inverse_depths) {
            let (at, flow) = (0.5 * (point.before + point.now), point.now - point.before);
            let plane = |d: DVec3| Vector2::new(d.x - at.x * d.z, d.y - at.y * d.z);
            let by = |k: usize| match k {
                0..=2 => plane(at.extend(1.0).cross(DVec3::AXES[k])),
                _ => plane(-DVec3::AXES[k - 3]),
            };
            let mut j = Matrix2x6::from_columns(&std::array::from_fn::<_, 6, _>(by));
            // Inverse depth by the estimate so far.
            let [mean, sigma] = point.inverse_depth;
            let along = j.fixed_columns::<3>(3) * x.fixed_rows::<3>(3);
            let flow = Vector2::new(flow.x, flow.y);
            let rest = flow - j.fixed_columns::<3>(0) * x.fixed_rows::<3>(0);
            let (known, seen) = ((POINT_SIGMA / sigma).powi(2), along.norm_squared());
            *rho = (along.dot(&rest) + known * mean) / (seen + known);
            j.fixed_columns_mut::<3>(3).scale_mut(*rho);
            let off = rest - along * *rho;
            let far = off.norm_squared() / POINT_SIGMA.powi(2) + ((*rho - mean) / sigma).powi(2);
            let share = 1.0 / (1.0 + far / CAUCHY.powi(2));
            agreeing += share;
            let weight = share / POINT_SIGMA.powi(2);
            // The inverse depth is at its best, so it has no gradient, and takes up errors along its direction.
            let free = Matrix2::identity() - along * along.transpose() / (seen + known);
            a += j.transpose() * free * j * weight;
            b += j.transpose() * off * weight;
        }
        x += a.cholesky()?.solve(&b);
    }
    (agreeing > AGREEING_MIN * points.len() as f64).then(|| DVec3::new(x[0], x[1], x[2]))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::math::so3::exp;
    use crate::world::stream;

    const BIAS: DVec3 = DVec3::new(0.02, -0.01, 0.03);
    const SECONDS: f64 = 7.0;

    fn calibrated() -> DQuat {
        DQuat::from_euler(glam::EulerRot::XYZ, 0.4, -1.1, 2.0)
    }

    fn tumbling(t: f64) -> DVec3 {
        DVec3::new((2.1 * t).sin(), 0.7 * (3.3 * t + 1.0).sin(), 0.9 * (1.7 * t).cos() * (0.6 * t).sin())
    }

    /// A rig whose body turns at `rate`, and what its sensors make of it.
    struct Rig {
        rate: fn(f64) -> DVec3,
        body_from_cam: DQuat,
        /// Clock of the gyro ahead of the camera's, s.
        offset: f64,
        /// `axes * reading` is in the body.
        axes: DMat3,
        /// Errors of a camera's attitude, rad, shared by the two intervals that meet there; and of one interval's turn.
        shared: f64,
        alone: f64,
        /// One interval in so many follows something else.
        wrong: usize,
        seed: u64,
    }

    impl Rig {
        fn new() -> Rig {
            let (rate, body_from_cam, axes) = (tumbling as fn(f64) -> DVec3, calibrated(), DMat3::IDENTITY);
            Rig { rate, body_from_cam, offset: 0.0, axes, shared: 1e-4, alone: 1e-4, wrong: usize::MAX, seed: 1 }
        }

        fn sense(&self) -> (Vec<Turn>, Vec<ImuSample>) {
            let mut noise = stream(self.seed, 0x6472);
            let mut normal = || noise.vector();
            let stamp = |t: f64| Nanos(7_000_000_000 + (t * 1e9).round() as i64);
            let sample = |i: usize| {
                let t = i as f64 * 0.005;
                let read = self.axes.transpose() * ((self.rate)(t - self.offset) + BIAS);
                ImuSample { t: stamp(t), gyro_body: read, accel_body: DVec3::ZERO, ..ImuSample::default() }
            };
            let mut imu: Vec<ImuSample> = (0..(SECONDS / 0.005) as usize).map(sample).collect();
            imu.iter_mut().for_each(|s| s.gyro_body += normal() * 2.4e-3);
            let mut before = normal() * self.shared;
            let turn = |i: usize| {
                let from = 0.2 + 0.05 * i as f64;
                let step = |k: usize| exp((self.rate)(from + (k as f64 + 0.5) * 5e-4) * 5e-4);
                let g = (0..100).fold(DQuat::IDENTITY, |q, k| q * step(k));
                let now = normal() * self.shared;
                let error = now - before + normal() * self.alone;
                before = now;
                let gross = if i % self.wrong == self.wrong / 2 { DVec3::new(0.02, -0.01, 0.015) } else { DVec3::ZERO };
                let true_turn = self.body_from_cam.conjugate() * g * self.body_from_cam;
                Turn { from: stamp(from), to: stamp(from + 0.05), rate: log(true_turn * exp(error + gross)) / 0.05 }
            };
            ((0..(20.0 * (SECONDS - 0.4)) as usize).map(turn).collect(), imu)
        }

        fn found(&self) -> Option<Coarse> {
            let (turns, imu) = self.sense();
            coarse(&turns, &imu, calibrated())
        }
    }

    #[test]
    fn offsets_are_found_whatever_the_bias() {
        for offset in [-0.25, -0.02, -0.003, 0.0, 0.007, 0.28] {
            let c = Rig { offset, ..Rig::new() }.found().unwrap();
            assert!((c.offset_s - offset).abs() < 1e-3 && c.correlation > 0.99, "{offset}: {c:?}");
            assert!(c.axes == DMat3::IDENTITY && c.rotation == DQuat::IDENTITY && c.handed, "{c:?}");
        }
    }

    #[test]
    fn what_follows_something_else_does_not_move_it_far() {
        let c = Rig { offset: 0.007, wrong: 6, ..Rig::new() }.found().unwrap();
        assert!((c.offset_s - 0.007).abs() < 5e-3 && c.axes == DMat3::IDENTITY, "{c:?}");
    }

    #[test]
    fn axes_exchanged_and_turned_round_are_named() {
        for axes in namings() {
            let c = Rig { axes, offset: -0.004, ..Rig::new() }.found().unwrap();
            assert!(c.axes == axes && c.handed && c.rotation == DQuat::IDENTITY, "{axes}: {c:?}");
            assert!((c.offset_s + 0.004).abs() < 1e-3, "{c:?}");
        }
    }

    #[test]
    fn a_mount_far_from_its_calibration_is_found() {
        for angle in [0.2, 0.6] {
            let off = exp(DVec3::new(0.6, -0.3, 0.74).normalize() * angle);
            let c = Rig { body_from_cam: calibrated() * off, ..Rig::new() }.found().unwrap();
            let turned = log(calibrated().conjugate() * c.rotation.conjugate() * calibrated());
            assert!((turned - log(off)).length() < 5e-3 && c.axes == DMat3::IDENTITY, "{turned} {c:?}");
        }
    }

    #[test]
    fn what_the_motion_does_not_tell_is_not_said() {
        let about_z: fn(f64) -> DVec3 = |t| DVec3::Z * (2.0 * t).sin();
        let c = Rig { rate: about_z, ..Rig::new() }.found().unwrap();
        assert!(c.axes == DMat3::IDENTITY && c.rotation == DQuat::IDENTITY && !c.handed, "{c:?}");
        let steady: fn(f64) -> DVec3 = |_| DVec3::new(0.5, 0.3, 0.2);
        let c = Rig { rate: steady, ..Rig::new() }.found().unwrap();
        assert!(c.offset_s == 0.0 && c.correlation < CORRELATED, "{c:?}");
    }

    /// What two cameras see of 60 points while the first turns and moves, and how it turned.
    fn seen(sigma: f64, stereo: bool) -> (Vec<Point>, DVec3) {
        let mut rng = stream(1, 0x6472);
        let mut noise = || sigma * rng.vector().truncate();
        let turned = DVec3::new(0.03, -0.05, 0.02);
        let before_from_now = Pose::new(exp(turned), DVec3::new(0.02, -0.01, 0.04));
        let second = Pose::new(DQuat::IDENTITY, DVec3::new(-0.11, 0.0, 0.0));
        let point = |i: usize| {
            let p = DVec3::new((i as f64 * 0.7).sin(), (i as f64 * 1.3).cos(), 2.0 + (i % 5) as f64);
            let mut plane = |p: DVec3| p.truncate() / p.z + noise();
            let (before, now) = (plane(before_from_now.transform(p)), plane(p));
            let ray = stereo.then(|| plane(second.transform(p)).extend(1.0));
            Point::new(before, now, ray, stereo.then_some(second))
        };
        ((0..60).map(point).collect(), turned)
    }

    #[test]
    fn the_turn_is_told_from_the_translation_by_two_cameras_and_by_one() {
        for (stereo, most) in [(true, 5e-4), (false, 3e-3)] {
            let (points, turned) = seen(1e-4, stereo);
            let found = rotation(&points).unwrap();
            assert!((found - turned).length() < most, "{stereo}: {}", (found - turned).length());
        }
    }

    #[test]
    fn the_turn_is_found_with_a_third_of_the_points_wrong() {
        let (mut points, turned) = seen(1e-4, true);
        points.iter_mut().step_by(3).enumerate().for_each(|(i, p)| p.now += DVec2::new(0.05, -0.08) * (i % 7) as f64);
        let found = rotation(&points).unwrap();
        assert!((found - turned).length() < 1e-3, "{}", (found - turned).length());
    }
}
