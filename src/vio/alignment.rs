//! A start in motion by one camera: velocity, gravity and biases from bearings and inertial samples.
//!
//! In steps, each of which makes the next one's problem small. The gyro's bias is that by which all views of two frames
//! lie in planes through the line between them (`gyro_bias`). With rotations known, the path is linear up to a factor
//! (`path`); with the path, velocity and gravity are linear for every factor, and gravity's length and the samples tell
//! which it is (`along`). Then Gauss-Newton on all directions, each point eliminated (Martinelli, IJCV 2014; Dong-Si and
//! Mourikis, IROS 2012, whose linear system shrinks towards nothing when a bias or a track is wrong). Tracks that
//! contradict lose their weight as the bound on what fits narrows.
//!
//! What comes out is where the window begins to optimize from (`Estimator::start_in_motion`): it knows of all noise, and its
//! covariance says whether the speed is known.

use super::inertial::Motion;
use super::model::Model;
use super::preintegration::Increment;
use super::reprojection::CameraModel;
use super::samples::ImuRing;
use crate::frontend::Tracks;
use crate::limits::{CAMERAS_MAX, RIG_DIM, TRACKS, WINDOW_DIM};
use crate::math::block::{matrix, vector};
use crate::math::so3;
use glam::{DMat3, DQuat, DVec3};
use nalgebra::{Matrix3, SMatrix};
use stipple_drivers::{Nanos, Pose};

/// Frames that are aligned, at most and at least, and the least time between two, s.
pub const FRAMES_MAX: usize = 10;
const FRAMES_MIN: usize = 6;
const SPACING: f64 = 0.09;
/// Frames between the two of a pair whose epipolar planes tell the gyro's bias.
const PAIR: usize = 2;
/// Time without success after which the start falls back to the mean force, s.
const WAIT: f64 = 1.5;
/// Width of the robust weight at each step, in deviations of a bearing.
const BOUNDS: [f64; 12] = [200.0, 100.0, 50.0, 25.0, 12.0, 8.0, 6.0, 4.0, 3.0, 3.0, 3.0, 3.0];
/// The same for the path, while the rotations are still less well known.
const PATH_BOUNDS: [f64; 4] = [100.0, 50.0, 30.0, 20.0];
/// What unknown biases may do while the scale is searched: to positions, m, and to gravity's length, m/s².
const ROUGH_POSITION: f64 = 0.02;
const GRAVITY_LENGTH: f64 = 0.2;
/// Least distance of the sampled path from a parabola that tells the scale, m: several times what the samples' noise makes.
const EXCITED: f64 = 0.002;
/// Scales that are tried: how many, the least, and the ratio of two neighbours.
const FACTORS: i32 = 120;
const FACTOR_MIN: f64 = 0.02;
const FACTOR_STEP: f64 = 1.07;
/// Gravity's length once the accelerometer's bias is sought too, m/s².
const GRAVITY_LENGTH_FINE: f64 = 0.01;
/// Tracks that have to fit.
const TRACKS_MIN: usize = 12;
/// Least distance of a point ahead of its camera, m.
const DISTANCE_MIN: f64 = 0.1;

const _: () = assert!(15 * FRAMES_MAX + RIG_DIM <= WINDOW_DIM, "the window takes all frames as states");

type Mat12 = SMatrix<f64, 12, 12>;
type Vec12 = SMatrix<f64, 12, 1>;
type Mat312 = SMatrix<f64, 3, 12>;
/// Positions of all frames but the first.
const PATH_DIM: usize = 3 * (FRAMES_MAX - 1);
type MatPath = SMatrix<f64, PATH_DIM, PATH_DIM>;
type Path = [DVec3; FRAMES_MAX];

/// A direction, in a camera, at which a frame sees a point.
#[derive(Clone, Copy, Debug)]
struct Ray {
    id: u64,
    frame: u8,
    camera: u8,
    bearing: DVec3,
}

/// The frames of the last second, some time apart.
#[derive(Clone, Debug)]
pub struct Alignment {
    frames: Vec<Tracks>,
    rays: Vec<Ray>,
    since: Option<Nanos>,
}

impl Alignment {
    pub fn new() -> Alignment {
        let rays = Vec::with_capacity(FRAMES_MAX * CAMERAS_MAX * TRACKS);
        Alignment { frames: Vec::with_capacity(FRAMES_MAX), rays, since: None }
    }

    /// Starts over.
    pub fn clear(&mut self) {
        self.frames.clear();
        self.since = None;
    }

    /// Takes a frame, unless it is too near to the last; the oldest goes where there is no room.
    pub fn add(&mut self, tracks: &Tracks) {
        self.since = self.since.or(Some(tracks.t));
        if self.frames.last().is_some_and(|last| (tracks.t - last.t).secs() < SPACING) {
            return;
        }
        if self.frames.len() == FRAMES_MAX {
            self.frames.remove(0);
        }
        self.frames.push(tracks.clone());
    }

    /// Whether there was time enough for a start to be found.
    pub fn is_overdue(&self, t: Nanos) -> bool {
        self.since.is_some_and(|since| (t - since).secs() >= WAIT)
    }

    /// The frames, oldest first, and the motion of the first of them; `None` while there are too few, the newest is not
    /// one of them, or nothing fits.
    pub fn solve(&mut self, t: Nanos, imu: &ImuRing, model: &Model) -> Option<(&[Tracks], Motion)> {
        if self.frames.len() < FRAMES_MIN || self.frames.last()?.t != t {
            return None;
        }
        self.cast(&model.cameras);
        let start = self.frames[0].t;
        let mut increments = [Increment::new(DVec3::ZERO, DVec3::ZERO); FRAMES_MAX];
        for (increment, tracks) in increments.iter_mut().zip(&self.frames) {
            *increment = imu.integrate_scaled(start, tracks.t, DVec3::ZERO, DVec3::ZERO, &model.noise);
        }
        let focal = model.cameras.first()?.camera.fx;
        let noise = Deviations {
            bearing: model.config.observation_sigma_px / focal,
            bg: model.config.gyro_bias_sigma,
            ba: model.config.accel_bias_sigma,
        };
        let solution = solve(&self.rays, &increments[..self.frames.len()], &model.cameras, &noise)?;
        Some((&self.frames, solution.motion()))
    }

    /// Makes the rays of all views, those of a point together.
    fn cast(&mut self, cameras: &[CameraModel]) {
        let Alignment { frames, rays, .. } = self;
        rays.clear();
        for (frame, tracks) in frames.iter().enumerate() {
            for (camera, (list, model)) in tracks.cameras.iter().zip(cameras).enumerate() {
                rays.extend(list.iter().filter_map(|track| {
                    let bearing = model.camera.unproject(track.px())?;
                    Some(Ray { id: track.id, frame: frame as u8, camera: camera as u8, bearing })
                }));
            }
        }
        rays.sort_unstable_by_key(|r| (r.id, r.frame, r.camera));
    }
}

/// Deviations of a direction, rad, and of the biases, rad/s and m/s².
struct Deviations {
    bearing: f64,
    bg: f64,
    ba: f64,
}

/// Velocity and gravity in the body at the first frame, and the gyro's bias.
#[derive(Clone, Copy, Debug)]
struct Solution {
    v: DVec3,
    g: DVec3,
    bg: DVec3,
    ba: DVec3,
}

impl Solution {
    /// The motion of the first frame in a world whose z is up.
    fn motion(&self) -> Motion {
        let q = DQuat::from_rotation_arc(-self.g.normalize(), DVec3::Z);
        Motion { pose: Pose::new(q, DVec3::ZERO), v: q * self.v, bg: self.bg, ba: self.ba }
    }

    fn step(&mut self, d: &Vec12) {
        let at = |i: usize| DVec3::new(d[i], d[i + 1], d[i + 2]);
        (self.v, self.g, self.bg, self.ba) = (self.v + at(0), self.g + at(3), self.bg + at(6), self.ba + at(9));
    }
}

/// A frame where the solution puts it, in the body at the first frame.
#[derive(Clone, Copy, Debug)]
struct Placed {
    dt: f64,
    r: DMat3,
    p: DVec3,
    /// Derivatives of rotation (on the right) and position to the biases.
    d_q_bg: DMat3,
    d_p_bg: DMat3,
    d_p_ba: DMat3,
}

impl Placed {
    fn new(inc: &Increment, s: &Solution) -> Placed {
        let (dp, q, _) = inc.corrected(s.bg, s.ba);
        let d_q_bg = so3::right_jacobian(inc.d_q_bg() * s.bg) * inc.d_q_bg();
        let p = s.v * inc.dt + s.g * (0.5 * inc.dt * inc.dt) + dp;
        Placed { dt: inc.dt, r: DMat3::from_quat(q), p, d_q_bg, d_p_bg: inc.d_p_bg(), d_p_ba: inc.d_p_ba() }
    }

    /// Where the ray begins, and its direction.
    fn cast(&self, ray: &Ray, cameras: &[CameraModel]) -> (DVec3, DVec3) {
        let camera = &cameras[ray.camera as usize].body_from_cam;
        (self.p + self.r * camera.p, self.r * (camera.r * ray.bearing))
    }

    /// Derivative of where a point at `x` is seen, turned back to the first body, to [v, g, bg, ba].
    fn derivative(&self, x: DVec3) -> Mat312 {
        let seen = self.r.transpose() * (x - self.p);
        let by_bg = self.r * so3::hat(seen) * self.d_q_bg - self.d_p_bg;
        let mut j = Mat312::zeros();
        for i in 0..3 {
            (j[(i, i)], j[(i, 3 + i)]) = (-self.dt, -0.5 * self.dt * self.dt);
            (0..3).for_each(|k| (j[(i, 6 + k)], j[(i, 9 + k)]) = (by_bg.col(k)[i], -self.d_p_ba.col(k)[i]));
        }
        j
    }
}

/// What is across a direction.
fn across(u: DVec3) -> DMat3 {
    DMat3::IDENTITY - outer(u)
}

/// The point nearest to the rays of a track; `None` where they are parallel, or it is behind one of them.
fn nearest(rays: &[Ray], placed: &[Placed], cameras: &[CameraModel]) -> Option<DVec3> {
    let (mut h, mut b) = (DMat3::ZERO, DVec3::ZERO);
    for ray in rays {
        let (from, u) = placed[ray.frame as usize].cast(ray, cameras);
        let across = across(u);
        (h, b) = (h + across, b + across * from);
    }
    let x = h.inverse() * b;
    let is_ahead = |ray: &Ray| {
        let (from, u) = placed[ray.frame as usize].cast(ray, cameras);
        (x - from).dot(u) > DISTANCE_MIN
    };
    (x.is_finite() && rays.iter().all(is_ahead)).then_some(x)
}

/// Gyro bias by which all views of two frames lie in planes through the line between them (Kneip and Lynen, ICCV 2013;
/// He et al., CVPR 2023), whatever the distances.
fn gyro_bias(rays: &[Ray], increments: &[Increment], cameras: &[CameraModel], noise: &Deviations) -> Option<DVec3> {
    let mut s = Solution { v: DVec3::ZERO, g: DVec3::ZERO, bg: DVec3::ZERO, ba: DVec3::ZERO };
    // Direction of the line between each frame and that `PAIR` after it.
    let mut lines = [[DVec3::ZERO; FRAMES_MAX]; CAMERAS_MAX];
    for bound in BOUNDS {
        let mut placed = [Placed::new(&increments[0], &s); FRAMES_MAX];
        placed.iter_mut().zip(increments).for_each(|(to, inc)| *to = Placed::new(inc, &s));
        let weight = |off: f64| robust(off / noise.bearing, bound);
        let mut planes = [[DMat3::ZERO; FRAMES_MAX]; CAMERAS_MAX];
        let (mut h, mut b) = (DMat3::IDENTITY * noise.bg.powi(-2), s.bg * noise.bg.powi(-2));
        for step in 0..2 {
            for track in rays.chunk_by(|a, b| a.id == b.id) {
                for (i, to) in track.iter().enumerate() {
                    let is_from = |r: &&Ray| r.camera == to.camera && r.frame as usize + PAIR == to.frame as usize;
                    let Some(from) = track[..i].iter().find(is_from) else { continue };
                    let [(a, u), (c, w)] = [from, to].map(|r| {
                        let frame = &placed[r.frame as usize];
                        (frame, frame.cast(r, cameras).1)
                    });
                    let (n, at) = (u.cross(w), (from.camera as usize, from.frame as usize));
                    let line = lines[at.0][at.1];
                    let off = line.dot(n);
                    if step == 0 {
                        planes[at.0][at.1] += outer(n) * weight(off);
                        continue;
                    }
                    let d = so3::hat(w) * so3::hat(u) * a.r * a.d_q_bg - so3::hat(u) * so3::hat(w) * c.r * c.d_q_bg;
                    let (d, weight) = (d.transpose() * line, weight(off) * (noise.bearing).powi(-2));
                    (h, b) = (h + outer(d) * weight, b + d * (off * weight));
                }
            }
            for (lines, planes) in lines.iter_mut().zip(&planes).filter(|_| step == 0) {
                for (line, plane) in lines.iter_mut().zip(planes) {
                    let eigen = matrix(*plane).symmetric_eigen();
                    let least = eigen.eigenvectors.column(eigen.eigenvalues.imin());
                    *line = DVec3::new(least[0], least[1], least[2]);
                }
            }
        }
        s.bg -= h.inverse() * b;
    }
    s.bg.is_finite().then_some(s.bg)
}

/// The outer product with itself.
fn outer(u: DVec3) -> DMat3 {
    DMat3::from_cols(u * u.x, u * u.y, u * u.z)
}

/// Normal equations in [v, g, bg, ba], and the tracks in them whose views fit.
struct Normal {
    h: Mat12,
    b: Vec12,
    fitting: usize,
}

impl Normal {
    /// Adds a track, its point eliminated: by how much the directions to `point` differ from the rays.
    fn add(
        &mut self,
        rays: &[Ray],
        point: DVec3,
        placed: &[Placed],
        cameras: &[CameraModel],
        weight: impl Fn(f64) -> f64,
    ) {
        let (mut h_pp, mut b_p, mut h_px) = (Matrix3::zeros(), nalgebra::Vector3::zeros(), Mat312::zeros());
        let (mut h, mut b) = (Mat12::zeros(), Vec12::zeros());
        for ray in rays {
            let frame = &placed[ray.frame as usize];
            let (from, u) = frame.cast(ray, cameras);
            let far = (point - from).length();
            let d = (point - from) / far;
            let w = weight((d - u).length());
            let (j, p, off) =
                (frame.derivative(point), matrix(across(d)) * (w / (far * far)), across(d) * (d - u) * (w / far));
            let pj = p * j;
            h_pp += p;
            h_px += pj;
            h += j.transpose() * pj;
            b_p += vector(off);
            b += j.transpose() * vector(off);
        }
        if let Some(inverse) = h_pp.try_inverse() {
            self.h += h - h_px.transpose() * inverse * h_px;
            self.b += b - h_px.transpose() * (inverse * b_p);
            self.fitting += 1;
        }
    }

    /// Adds that three unknowns from `at` differ from what they are by no more than a deviation.
    fn hold(&mut self, at: usize, sigma: f64, off: DVec3) {
        for i in 0..3 {
            self.h[(at + i, at + i)] += 1.0 / (sigma * sigma);
            self.b[at + i] += off[i] / (sigma * sigma);
        }
    }
}

/// Weight of what is off by so many deviations, where `bound` of them still fit.
fn robust(off: f64, bound: f64) -> f64 {
    (1.0 / (1.0 + (off / bound).powi(2))).powi(2)
}

/// Positions of one camera at all frames, in the body at the first and from there, up to one factor: those by which the rays of
/// each track meet best. Rotations are taken as known.
fn path(rays: &[Ray], placed: &[Placed], cameras: &[CameraModel], camera: u8, noise: f64) -> Option<Path> {
    let mut path = [DVec3::ZERO; FRAMES_MAX];
    for (i, bound) in [f64::INFINITY].into_iter().chain(PATH_BOUNDS).enumerate() {
        let mut a = MatPath::zeros();
        for track in rays.chunk_by(|a, b| a.id == b.id) {
            let views = || {
                track.iter().filter(|r| r.camera == camera).map(|r| {
                    let frame = r.frame as usize;
                    (frame, path[frame], placed[frame].r * (cameras[camera as usize].body_from_cam.r * r.bearing))
                })
            };
            if views().count() < 3 {
                continue;
            }
            let (h, b) =
                views().fold((DMat3::ZERO, DVec3::ZERO), |(h, b), (_, from, u)| (h + across(u), b + across(u) * from));
            let x = h.inverse() * b;
            let weight = |from: DVec3, u: DVec3| {
                let (far, off) = ((x - from).length(), (across(u) * (x - from)).length());
                if i == 0 {
                    1.0
                } else {
                    robust(off / (far * noise), bound) / (far * far).max(1e-2)
                }
            };
            let sum = views().fold(DMat3::ZERO, |sum, (_, from, u)| sum + across(u) * weight(from, u));
            let inverse = sum.inverse();
            if !inverse.is_finite() {
                continue;
            }
            for (k, from_k, u_k) in views().filter(|v| v.0 > 0) {
                let p_k = across(u_k) * weight(from_k, u_k);
                for (l, from_l, u_l) in views().filter(|v| v.0 > 0) {
                    let p_l = across(u_l) * weight(from_l, u_l);
                    let own = if k == l { p_k } else { DMat3::ZERO };
                    let mut view = a.fixed_view_mut::<3, 3>(3 * (k - 1), 3 * (l - 1));
                    view += matrix(own - p_k * inverse * p_l);
                }
            }
        }
        // Frames there are none of stay where the first is.
        let much = a.trace() + 1.0;
        (3 * (placed.len() - 1)..PATH_DIM).for_each(|i| a[(i, i)] = much);
        let eigen = a.try_symmetric_eigen(1e-12, 300)?;
        let least = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
        for (k, p) in path.iter_mut().enumerate().take(placed.len()).skip(1) {
            *p = DVec3::new(least[3 * k - 3], least[3 * k - 2], least[3 * k - 1]);
        }
    }
    // Its sign is that by which points are ahead.
    let ahead = rays.chunk_by(|a, b| a.id == b.id).map(|track| {
        let own = |r: &&Ray| r.camera == camera;
        let (Some(a), Some(b)) = (track.iter().find(own), track.iter().rfind(own)) else { return 0 };
        let [u, w] =
            [a, b].map(|r| placed[r.frame as usize].r * (cameras[camera as usize].body_from_cam.r * r.bearing));
        let line = path[b.frame as usize] - path[a.frame as usize];
        // Seen from further on, a point ahead turns against the way.
        (across(u) * line).dot(w).partial_cmp(&0.0).map_or(0, |o| -(o as i32))
    });
    let sign = if ahead.sum::<i32>() < 0 { -1.0 } else { 1.0 };
    path.iter().all(|p| p.is_finite()).then(|| path.map(|p| p * sign))
}

/// Velocity and gravity by which the samples lead along a path that is known up to a factor: the factor of many that leaves
/// least of the samples unexplained, and gravity as long as it is. `None` where the samples lead along a parabola, as
/// they do at any factor.
fn along(path: &Path, placed: &[Placed], lever: DVec3, gravity: f64) -> Option<(DVec3, DVec3)> {
    // Both what is seen and what was sampled, as v T + ½ g T² and a rest.
    let (mut h, mut b) = ([0.0; 3], [[DVec3::ZERO; 2]; 2]);
    let of = |k: usize| [path[k], placed[k].p + placed[k].r * lever - lever];
    for (k, frame) in placed.iter().enumerate() {
        let a = [frame.dt, 0.5 * frame.dt * frame.dt];
        h = [h[0] + a[0] * a[0], h[1] + a[0] * a[1], h[2] + a[1] * a[1]];
        (0..2).for_each(|which| (0..2).for_each(|i| b[which][i] += of(k)[which] * a[i]));
    }
    let det = h[0] * h[2] - h[1] * h[1];
    let fit = b.map(|b| ((b[0] * h[2] - b[1] * h[1]) / det, (b[1] * h[0] - b[0] * h[1]) / det));
    let at = |s: f64| (fit[0].0 * s - fit[1].0, fit[0].1 * s - fit[1].1);
    let rest = |s: f64, (v, g): (DVec3, DVec3)| {
        let left = placed.iter().enumerate().map(move |(k, frame)| {
            let [seen, sampled] = of(k);
            (seen * s - sampled - v * frame.dt - g * (0.5 * frame.dt * frame.dt)).length_squared()
        });
        left.sum::<f64>()
    };
    if rest(0.0, at(0.0)) < EXCITED.powi(2) * placed.len() as f64 {
        return None;
    }
    let cost = |s: f64| {
        let length = (at(s).1.length() - gravity) / GRAVITY_LENGTH;
        rest(s, at(s)) / ROUGH_POSITION.powi(2) + length.powi(2)
    };
    let factors = (0..FACTORS).map(|i| FACTOR_MIN * FACTOR_STEP.powi(i));
    let best = factors.map(|s| (cost(s), s)).filter(|c| c.0.is_finite()).min_by(|a, b| a.0.total_cmp(&b.0))?;
    Some(at(best.1))
}

/// Velocity, gravity and biases from rays sorted by point, and the increments from the first frame to each.
fn solve(rays: &[Ray], increments: &[Increment], cameras: &[CameraModel], noise: &Deviations) -> Option<Solution> {
    let place = |s: &Solution| {
        let mut placed = [Placed::new(&increments[0], s); FRAMES_MAX];
        placed.iter_mut().zip(increments).for_each(|(to, inc)| *to = Placed::new(inc, s));
        placed
    };
    let (n, gravity) = (increments.len(), increments.first()?.gravity.length());
    let bg = gyro_bias(rays, increments, cameras, noise)?;
    let mut s = Solution { v: DVec3::ZERO, g: DVec3::ZERO, bg, ba: DVec3::ZERO };
    let camera = (0..cameras.len() as u8).max_by_key(|c| rays.iter().filter(|r| r.camera == *c).count())?;
    let placed = place(&s);
    let path = path(rays, &placed[..n], cameras, camera, noise.bearing)?;
    (s.v, s.g) = along(&path, &placed[..n], cameras[camera as usize].body_from_cam.p, gravity)?;
    let mut fitting = 0;
    for bound in BOUNDS {
        let placed = place(&s);
        let mut normal = Normal { h: Mat12::zeros(), b: Vec12::zeros(), fitting: 0 };
        for track in rays.chunk_by(|a, b| a.id == b.id).filter(|track| track.len() > 2) {
            if let Some(x) = nearest(track, &placed, cameras) {
                let weight = |off: f64| robust(off / noise.bearing, bound) / noise.bearing.powi(2);
                normal.add(track, x, &placed, cameras, weight);
            }
        }
        normal.hold(6, noise.bg, s.bg);
        normal.hold(9, noise.ba, s.ba);
        let (down, weight) = (vector(s.g.normalize()), GRAVITY_LENGTH_FINE.powi(-2));
        let mut h = normal.h.fixed_view_mut::<3, 3>(3, 3);
        h += down * down.transpose() * weight;
        let mut b = normal.b.fixed_rows_mut::<3>(3);
        b += down * ((s.g.length() - gravity) * weight);
        s.step(&-normal.h.cholesky()?.solve(&normal.b));
        fitting = normal.fitting;
    }
    (fitting >= TRACKS_MIN && s.v.is_finite() && s.g.is_finite()).then_some(s)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::world::{self, room, stream, World};
    use super::*;
    use crate::config::VioConfig;

    const PATH: world::Path = world::Path { rest: -1.0 };
    const GRAVITY: DVec3 = DVec3::new(0.0, 0.0, -9.81);

    /// Exact increments from `t0` to frames a tenth of a second apart, and exact rays to points of a room from one camera.
    fn exact(t0: f64) -> (Vec<Increment>, Vec<Ray>, Model, Solution) {
        let model = Model::new(&World::new(PATH).rig, &VioConfig::default());
        let (a, v) = (PATH.pose(t0), PATH.velocity(t0));
        let to_a = a.q.conjugate();
        let mut rays = vec![];
        let increments = (0..8).map(|k| {
            let (dt, b) = (0.1 * k as f64, PATH.pose(t0 + 0.1 * k as f64));
            let mut inc = Increment::new(DVec3::ZERO, DVec3::ZERO);
            (inc.dt, inc.gravity) = (dt, GRAVITY);
            (inc.q, inc.p) = (to_a * b.q, to_a * (b.p - a.p - v * dt - GRAVITY * (0.5 * dt * dt)));
            inc.v = to_a * (PATH.velocity(t0 + dt) - v - GRAVITY * dt);
            let camera = &model.cameras[0];
            for (id, point) in room(200, &mut stream(3, 3)).iter().enumerate() {
                let seen =
                    camera.body_from_cam.r.transpose() * (b.inverse().transform(*point) - camera.body_from_cam.p);
                if seen.z > 0.5 * seen.length() {
                    rays.push(Ray { id: id as u64, frame: k, camera: 0, bearing: seen.normalize() });
                }
            }
            inc
        });
        let increments = increments.collect();
        rays.sort_unstable_by_key(|r| (r.id, r.frame));
        (increments, rays, model, Solution { v: to_a * v, g: to_a * GRAVITY, bg: DVec3::ZERO, ba: DVec3::ZERO })
    }

    #[test]
    fn velocity_and_gravity_are_exact_where_nothing_is_noisy() {
        for i in 0..20 {
            let (increments, rays, model, truth) = exact(0.37 * f64::from(i));
            let s = solve(&rays, &increments, &model.cameras, &Deviations { bearing: 1e-3, bg: 0.1, ba: 0.3 }).unwrap();
            let error = (s.v - truth.v).length().max((s.g - truth.g).length()).max(s.bg.length().max(s.ba.length()));
            assert!(error < 1e-6, "start {i}: {error} {s:?} {truth:?}");
        }
    }

    #[test]
    fn derivative_of_a_ray_matches_differences() {
        let (mut increments, _, _, mut s) = exact(0.9);
        let mut world = World::new(PATH);
        let mut ring = ImuRing::new(200.0);
        (0..200).for_each(|i| assert!(ring.push(world.imu(f64::from(i) * 0.005)).is_none()));
        let noise = Model::new(&world.rig, &VioConfig::default()).noise;
        increments[5] = ring.integrate(Nanos(0), Nanos(500_000_000), DVec3::ZERO, DVec3::ZERO, &noise);
        s.bg = DVec3::new(0.02, -0.01, 0.03);
        let x = DVec3::new(3.0, -2.0, 1.0);
        let j = Placed::new(&increments[5], &s).derivative(x);
        for i in 0..12 {
            const H: f64 = 1e-6;
            // Where the point is seen from the frame, turned to the first body by the rotation before the change.
            let seen = |h: f64| {
                let mut moved = s;
                let mut d = Vec12::zeros();
                d[i] = h;
                moved.step(&d);
                let placed = Placed::new(&increments[5], &moved);
                Placed::new(&increments[5], &s).r * (placed.r.transpose() * (x - placed.p))
            };
            let numeric = (seen(H) - seen(-H)) / (2.0 * H);
            for row in 0..3 {
                assert!((j[(row, i)] - numeric[row]).abs() < 1e-7, "{row} {i}: {} {numeric}", j[(row, i)]);
            }
        }
    }
}
