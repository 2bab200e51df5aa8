//! How a camera turns, from the points it follows, against how the gyro says the body turns.
//!
//! Points seen by two cameras have a depth, so their motion to the next frame is a pose and not only a rotation:
//! flying does as well as turning the rig by hand. With one camera the points are taken as far away, which
//! turning by hand in one place makes nearly true.
//!
//! The offset in time is where the two rates' magnitudes correlate best, whatever the extrinsics say. With it the
//! orthogonal matrix that takes one rate to the other is solved for (Wahba; Markley 1988), without asking for a
//! determinant of one: -1 is an axis whose sign is wrong. Then the offset once more, of the turned vectors.

use crate::config::FrontendConfig;
use crate::frontend::{Frontend, Prediction, Track};
use glam::{DMat3, DQuat, DVec2, DVec3};
use nalgebra::{Matrix3, Matrix6, Vector6};
use std::sync::Arc;
use stipple_drivers::{Calibration, Fault, Frames, ImuSample, Nanos, Pose, RigCamera};

/// Fewer points tell no motion.
const POINTS_MIN: usize = 12;
/// A longer interval is not one of neighbouring frames, s.
const INTERVAL_MAX: f64 = 0.25;
const ITERATIONS: usize = 8;
/// Width of the robust weight, on the plane at distance 1: a pixel and a half of a camera of 450 px.
const HUBER: f64 = 0.003;
/// Nearest and farthest points used, m.
const DEPTH_MIN: f64 = 0.1;
const DEPTH_MAX: f64 = 50.0;
/// Offsets looked at, and their step, s.
const OFFSET_MAX: f64 = 0.15;
const OFFSET_STEP: f64 = 0.001;
/// Intervals from which anything is said.
const INTERVALS_MIN: usize = 40;

/// Mean rate of camera 0 over an interval, in its own frame, rad/s.
#[derive(Clone, Copy, Debug)]
pub struct Rate {
    pub from: Nanos,
    pub to: Nanos,
    pub rate_cam: DVec3,
}

/// Follows points and makes rates of them.
pub struct Turning {
    frontend: Frontend,
    calibration: Calibration,
    last: Option<Nanos>,
    /// Of the frame before, in the frame of camera 0: id and place.
    points: Vec<(u64, DVec3)>,
    pub rates: Vec<Rate>,
}

impl Turning {
    pub fn new(calibration: &Calibration, config: &FrontendConfig) -> Result<Turning, Fault> {
        let frontend = Frontend::new(calibration, config)?;
        Ok(Turning { frontend, calibration: calibration.clone(), last: None, points: Vec::new(), rates: Vec::new() })
    }

    pub fn add(&mut self, frames: &Arc<Frames>) {
        let tracks = self.frontend.track(frames, &Prediction::default());
        let c = &self.calibration.cameras;
        let seen: &[Track] = &tracks.cameras[0];
        let pairs: Vec<(DVec3, DVec2)> =
            self.points.iter().filter_map(|(id, point)| Some((*point, flat(&c[0], find(seen, *id)?)?))).collect();
        if let Some(last) = self.last.filter(|last| (0.0..INTERVAL_MAX).contains(&(frames.t - *last).secs())) {
            let dt = (frames.t - last).secs();
            let moved = (pairs.len() >= POINTS_MIN && dt > 0.0).then(|| motion(&pairs, c.len() > 1)).flatten();
            self.rates.extend(moved.map(|now_from_before| {
                let rate_cam = now_from_before.q.conjugate().to_scaled_axis() / dt;
                Rate { from: last, to: frames.t, rate_cam }
            }));
        }
        self.last = Some(frames.t);
        self.points.clear();
        if c.len() < 2 {
            self.points.extend(seen.iter().filter_map(|t| Some((t.id, flat(&c[0], t)?.extend(1.0)))));
            return;
        }
        let first_from_second = c[0].body_from_cam.inverse() * c[1].body_from_cam;
        let second: &[Track] = &tracks.cameras[1];
        self.points.extend(seen.iter().filter_map(|t| {
            let (a, b) = (flat(&c[0], t)?, flat(&c[1], find(second, t.id)?)?);
            Some((t.id, triangulate(a, b, &first_from_second)?))
        }));
    }
}

fn find(tracks: &[Track], id: u64) -> Option<&Track> {
    tracks.binary_search_by_key(&id, |t| t.id).ok().map(|at| &tracks[at])
}

/// Where the ray of a track meets the plane at distance 1.
fn flat(camera: &RigCamera, track: &Track) -> Option<DVec2> {
    let ray = camera.camera.unproject(DVec2::new(f64::from(track.px[0]), f64::from(track.px[1])))?;
    (ray.z > 0.1).then(|| ray.truncate() / ray.z)
}

/// The point nearest to two rays, in the first camera's frame.
fn triangulate(a: DVec2, b: DVec2, first_from_second: &Pose) -> Option<DVec3> {
    let (u, v, p) = (a.extend(1.0), first_from_second.q * b.extend(1.0), first_from_second.p);
    let (uu, vv, uv) = (u.length_squared(), v.length_squared(), u.dot(v));
    let det = uu * vv - uv * uv;
    let depth = (vv * u.dot(p) - uv * v.dot(p)) / det;
    (det > 1e-9 && (DEPTH_MIN..DEPTH_MAX).contains(&depth)).then(|| u * depth)
}

/// Gauss-Newton on the reprojection of points of the frame before; `moves` solves for a translation too.
fn motion(pairs: &[(DVec3, DVec2)], moves: bool) -> Option<Pose> {
    let mut pose = Pose::IDENTITY;
    for _ in 0..ITERATIONS {
        let (mut h, mut g) = (Matrix6::<f64>::zeros(), Vector6::<f64>::zeros());
        for (point, seen) in pairs {
            let p = pose.transform(*point);
            if p.z < DEPTH_MIN {
                continue;
            }
            let (x, y, w) = (p.x / p.z, p.y / p.z, 1.0 / p.z);
            let r = DVec2::new(x, y) - *seen;
            let weight = (HUBER / r.length()).min(1.0);
            // By the translation, then by the rotation vector on the left.
            let rows = [[w, 0.0, -x * w, -x * y, 1.0 + x * x, -y], [0.0, w, -y * w, -1.0 - y * y, x * y, x]];
            for (row, residual) in rows.iter().zip(r.to_array()) {
                let j = Vector6::from_fn(|i, _| if moves || i >= 3 { row[i] } else { 0.0 });
                h += weight * j * j.transpose();
                g += weight * residual * j;
            }
        }
        (0..3).filter(|_| !moves).for_each(|i| h[(i, i)] = 1.0);
        let step = h.cholesky()?.solve(&-g);
        let turn = DQuat::from_scaled_axis(DVec3::new(step[3], step[4], step[5]));
        pose = Pose::new(turn * pose.q, turn * pose.p + DVec3::new(step[0], step[1], step[2]));
    }
    let far = |p: &DVec3, seen: &DVec2| {
        let p = pose.transform(*p);
        p.z < DEPTH_MIN || (p.truncate() / p.z - *seen).length() > HUBER
    };
    let wrong = pairs.iter().filter(|(p, seen)| far(p, seen)).count();
    (pose.is_finite() && 2 * wrong < pairs.len()).then_some(pose)
}

/// What the two rates say of each other.
#[derive(Clone, Copy, Debug)]
pub struct Comparison {
    pub intervals: usize,
    /// Of the gyro's clock over the camera's, beyond what the calibration says, s; and how well they agree there, 0 to 1.
    pub offset_s: f64,
    pub correlation: f64,
    /// Root mean square of the camera's rate about each of its axes, rad/s.
    pub excitation: DVec3,
    /// The least turned of all directions, against the most: below this nothing is known about it.
    pub weakest: f64,
    /// Between the solved and the calibrated extrinsics, degrees and camera axis.
    pub angle_deg: f64,
    pub about: DVec3,
    /// An axis of the gyro whose sign is wrong: 0, 1 or 2.
    pub mirrored: Option<usize>,
    /// What stays unexplained, rad/s.
    pub residual: f64,
}

/// The gyro's angle from the first sample on.
struct Angle(Vec<(Nanos, DVec3)>);

impl Angle {
    fn new(imu: &[ImuSample]) -> Angle {
        let mut sum = DVec3::ZERO;
        let mut list: Vec<(Nanos, DVec3)> = Vec::with_capacity(imu.len());
        for (i, s) in imu.iter().enumerate() {
            if i > 0 {
                let dt = (s.t - imu[i - 1].t).secs();
                sum += 0.5 * dt * (s.gyro_body + imu[i - 1].gyro_body);
            }
            list.push((s.t, sum));
        }
        Angle(list)
    }

    fn at(&self, t: Nanos) -> Option<DVec3> {
        let next = self.0.partition_point(|s| s.0 < t);
        let (a, b) = (self.0.get(next.checked_sub(1)?)?, self.0.get(next)?);
        Some(a.1.lerp(b.1, (t - a.0).secs() / (b.0 - a.0).secs()))
    }

    /// Mean rate over the interval of `r`, `offset` later.
    fn rate(&self, r: &Rate, offset: f64) -> Option<DVec3> {
        let shift = stipple_drivers::Span::from_secs(offset);
        Some((self.at(r.to + shift)? - self.at(r.from + shift)?) / (r.to - r.from).secs())
    }
}

/// `None` of too little to say anything.
pub fn compare(rates: &[Rate], imu: &[ImuSample], body_from_cam: DQuat) -> Option<Comparison> {
    let angle = Angle::new(imu);
    let pairs_at = |offset: f64| -> Vec<(DVec3, DVec3)> {
        rates.iter().filter_map(|r| Some((r.rate_cam, angle.rate(r, offset)?))).collect()
    };
    let lengths = |p: &(DVec3, DVec3)| (DVec3::X * p.0.length(), DVec3::X * p.1.length());
    let (rough, _) = best_offset(|o| correlation(&pairs_at(o).iter().map(lengths).collect::<Vec<_>>()))?;
    // A bias shifts the peak of the magnitudes by milliseconds; that of the turned vectors it does not.
    let (q, _) = orthogonal(&pairs_at(rough))?;
    let turned = |p: &(DVec3, DVec3)| (p.0, q * p.1);
    let (offset_s, agreement) = best_offset(|o| correlation(&pairs_at(o).iter().map(turned).collect::<Vec<_>>()))?;
    let mut pairs = pairs_at(offset_s);
    if pairs.len() < INTERVALS_MIN {
        return None;
    }
    let intervals = pairs.len();
    let (mut q, mut weakest) = orthogonal(&pairs)?;
    let misses = |q: DMat3, pairs: &[(DVec3, DVec3)]| {
        let (cam, body) = means(pairs);
        pairs.iter().map(|(c, b)| ((*c - cam) - q * (*b - body)).length()).collect::<Vec<_>>()
    };
    // Once more without what fits worst: points on something that moves by itself.
    let miss = misses(q, &pairs);
    let limit = 3.0 * median(&miss);
    let mut kept = miss.iter();
    pairs.retain(|_| kept.next().is_some_and(|m| *m <= limit));
    (q, weakest) = orthogonal(&pairs).unwrap_or((q, weakest));
    let calibrated = DMat3::from_quat(body_from_cam.conjugate());
    let turned = |q: DMat3| DQuat::from_mat3(&(q * calibrated.transpose())).normalize();
    let flipped = |axis: usize| {
        let mut signs = DVec3::ONE;
        signs[axis] = -1.0;
        turned(q * DMat3::from_diagonal(signs))
    };
    let nearest = |a: &usize, b: &usize| angle_of(flipped(*a)).total_cmp(&angle_of(flipped(*b)));
    let mirrored = (q.determinant() < 0.0).then(|| (0..3).min_by(nearest)).flatten();
    let turn = mirrored.map_or_else(|| turned(q), flipped);
    let squares = pairs.iter().fold(DVec3::ZERO, |sum, (c, _)| sum + *c * *c) / pairs.len() as f64;
    Some(Comparison {
        intervals,
        offset_s,
        correlation: agreement,
        excitation: DVec3::new(squares.x.sqrt(), squares.y.sqrt(), squares.z.sqrt()),
        weakest,
        angle_deg: angle_of(turn).to_degrees(),
        about: turn.to_scaled_axis().normalize_or_zero(),
        mirrored,
        residual: median(&misses(q, &pairs)),
    })
}

fn angle_of(q: DQuat) -> f64 {
    q.to_scaled_axis().length()
}

fn means(pairs: &[(DVec3, DVec3)]) -> (DVec3, DVec3) {
    let sum = pairs.iter().fold((DVec3::ZERO, DVec3::ZERO), |s, p| (s.0 + p.0, s.1 + p.1));
    (sum.0 / pairs.len() as f64, sum.1 / pairs.len() as f64)
}

/// The orthogonal matrix that takes second to first best, means aside; and the least singular value over the largest.
fn orthogonal(pairs: &[(DVec3, DVec3)]) -> Option<(DMat3, f64)> {
    let (cam, body) = means(pairs);
    let mut h = Matrix3::<f64>::zeros();
    for (c, b) in pairs {
        let (c, b) = (*c - cam, *b - body);
        h += nalgebra::Vector3::from(c.to_array()) * nalgebra::RowVector3::from(b.to_array());
    }
    let svd = h.svd(true, true);
    let m = svd.u? * svd.v_t?;
    let columns: [f64; 9] = m.as_slice().try_into().ok()?;
    Some((DMat3::from_cols_array(&columns), svd.singular_values[2] / svd.singular_values[0].max(1e-12)))
}

/// Of vectors, means aside.
fn correlation(pairs: &[(DVec3, DVec3)]) -> f64 {
    let (a, b) = means(pairs);
    let (aa, bb, ab) = pairs.iter().fold((1e-12, 1e-12, 0.0), |s, p| {
        let (x, y) = (p.0 - a, p.1 - b);
        (s.0 + x.length_squared(), s.1 + y.length_squared(), s.2 + x.dot(y))
    });
    ab / f64::sqrt(aa * bb)
}

/// Where `score` is highest, to a part of a step, and how high.
fn best_offset(score: impl Fn(f64) -> f64) -> Option<(f64, f64)> {
    let steps = (OFFSET_MAX / OFFSET_STEP) as i32;
    let scores: Vec<f64> = (-steps..=steps).map(|k| score(f64::from(k) * OFFSET_STEP)).collect();
    let best = (1..scores.len() - 1).max_by(|a, b| scores[*a].total_cmp(&scores[*b]))?;
    let (a, b, c) = (scores[best - 1], scores[best], scores[best + 1]);
    let curve = a - 2.0 * b + c;
    let part = if curve < 0.0 { (0.5 * (a - c) / curve).clamp(-0.5, 0.5) } else { 0.0 };
    Some(((best as f64 + part - f64::from(steps)) * OFFSET_STEP, b))
}

pub fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn rate_at(t: f64) -> DVec3 {
        DVec3::new((2.1 * t).sin(), 0.7 * (3.3 * t + 1.0).sin(), 0.9 * (1.7 * t).cos() * (0.6 * t).sin())
    }

    /// Twelve seconds of a rig that turns; the gyro's clock is `offset` ahead and its axis `flip` reads the other way.
    fn turning(body_from_cam: DQuat, offset: f64, flip: Option<usize>) -> (Vec<Rate>, Vec<ImuSample>) {
        let sample = |i: i64| {
            let mut gyro = rate_at(i as f64 * 0.005 - offset) + DVec3::splat(0.01);
            flip.into_iter().for_each(|axis| gyro[axis] *= -1.0);
            ImuSample { t: Nanos(i * 5_000_000), gyro_body: gyro, accel_body: DVec3::ZERO }
        };
        let rate = |i: i64| Rate {
            from: Nanos(i * 50_000_000),
            to: Nanos((i + 1) * 50_000_000),
            rate_cam: body_from_cam.conjugate() * rate_at((i as f64 + 0.5) * 0.05),
        };
        ((4..236).map(rate).collect(), (0..2400).map(sample).collect())
    }

    #[test]
    fn offset_extrinsics_and_a_wrong_sign_are_found() {
        let q = DQuat::from_euler(glam::EulerRot::XYZ, 0.4, -1.1, 2.0);
        let (rates, imu) = turning(q, 0.0, None);
        let c = compare(&rates, &imu, q).unwrap();
        assert!(c.offset_s.abs() < 1e-3 && c.angle_deg < 0.2 && c.mirrored.is_none() && c.correlation > 0.99, "{c:?}");
        let (rates, imu) = turning(q, 0.02, None);
        let c = compare(&rates, &imu, q * DQuat::from_rotation_y(0.1)).unwrap();
        assert!((c.offset_s - 0.02).abs() < 1e-3 && (c.angle_deg - 5.73).abs() < 0.2, "{c:?}");
        assert!(c.about.y.abs() > 0.95, "{c:?}");
        let (rates, imu) = turning(q, -0.01, Some(1));
        let c = compare(&rates, &imu, q).unwrap();
        assert!(c.mirrored == Some(1) && c.angle_deg < 0.2 && (c.offset_s + 0.01).abs() < 2e-3, "{c:?}");
    }

    #[test]
    fn the_motion_of_points_is_found_with_a_third_of_them_wrong() {
        let truth = Pose::new(DQuat::from_scaled_axis(DVec3::new(0.03, -0.05, 0.02)), DVec3::new(0.02, -0.01, 0.04));
        let point = |i: usize| DVec3::new((i as f64 * 0.7).sin(), (i as f64 * 1.3).cos(), 2.0 + (i % 5) as f64);
        let pairs: Vec<(DVec3, DVec2)> = (0..60)
            .map(|i| {
                let p = truth.transform(point(i));
                let wrong = if i % 3 == 0 { DVec2::new(0.05, -0.08) * (i % 7) as f64 } else { DVec2::ZERO };
                (point(i), p.truncate() / p.z + wrong)
            })
            .collect();
        let found = motion(&pairs, true).unwrap();
        let error = (found.q * truth.q.conjugate()).to_scaled_axis().length();
        assert!(error < 3e-3, "{error}");
    }
}
