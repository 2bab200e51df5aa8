//! Verification of a candidate: whether two keyframes see the same corners, and from where.
//!
//! Descriptors are matched mutually; RANSAC on two matches finds yaw and translation between the level frames of both, as
//! gravity gives the rest; matches near where the found motion says are added; all that agree refine it by least squares,
//! with the deviation of each depth, and with roll and pitch near zero, as gravity is not known exactly. The result has the
//! count of agreeing corners, their spread over the image, and how well they agree with their stated deviations.

use super::features::{distance, Feature, Ray, FEATURES};
use super::pose4::{wrapped, Pose4};
use crate::mem::List;
use glam::{DMat3, DQuat, DVec2, DVec3};
use nalgebra::{Matrix3x6, Matrix4, Matrix6, Vector3, Vector6};

/// Bits in which two descriptors of a corner may differ; more where the place of the match is known.
const DISTANCE_MAX: u32 = 72;
const DISTANCE_GUIDED_MAX: u32 = 88;
/// Deviation of a corner that was detected twice, not aligned, px.
pub const CORNER_SIGMA_PX: f64 = 1.5;
/// Draws of two matches at most, and the odds of missing the motion at which they end.
const DRAWS: usize = 400;
const MISSED: f64 = 1e-3;
/// Normalised squared residual, of 3 numbers, up to which a match agrees: one in a thousand is lost.
const AGREES: f64 = 16.3;
/// Least horizontal distance of two points that tell yaw, m.
const LEVER_MIN: f64 = 0.2;
/// Depths that RANSAC draws from: share of deviation at most.
const DRAWN_SIGMA_MAX: f64 = 0.15;
/// Fewest matches that are worth a search.
pub const MATCHES_MIN: usize = 12;
/// Steps of a search while it is still found out which corners agree, and of the last one.
const ITERATIONS: [usize; 2] = [3, 8];
/// Share of the stated deviation of a depth in the last search: in simulated images four depths of five err by less than 0.4 of
/// what is stated, which is what corners may differ by and still agree.
const DEPTHS_REFINED: f64 = 0.5;
/// A step that ends a search: m and rad, far below `FLOOR`.
const CONVERGED: f64 = 1e-5;
/// Deviations below which no verification is believed: m, rad.
const FLOOR: [f64; 2] = [0.01, 0.002];
/// Deviation of the roll and of the pitch between two level frames, rad.
const TILT_SIGMA: f64 = 0.003;
/// Image cells, across and down, that corners are counted by.
const CELLS: [usize; 2] = [4, 3];

/// A keyframe as verification sees it.
pub struct Seen<'a> {
    pub features: &'a [Feature],
    pub rays: &'a [Ray],
    /// Camera 0 in the level frame, m.
    pub camera: DVec3,
}

/// What a verification found.
#[derive(Clone, Copy, Debug)]
pub struct Verified {
    /// Pose of the query's level frame in that of the candidate.
    pub candidate_from_query: Pose4,
    /// Covariance of its position in the candidate's level frame, m², and yaw, rad².
    pub covariance: Matrix4<f64>,
    /// Corners that agree, of how many matches.
    pub inliers: usize,
    pub matches: usize,
    /// Cells of twelve of the query's image that have one.
    pub cells: usize,
    /// Mean normalised squared residual of a number; 1 where deviations are as stated.
    pub misfit: f64,
}

/// A motion from the candidate to the query: the pose of the query's level frame, and by how much that is not level, as
/// angles about its x and y, rad.
#[derive(Clone, Copy, Debug)]
struct Motion {
    pose: Pose4,
    tilt: DVec2,
    /// Rotation by both, from the candidate's level frame to the query's.
    rotation: DMat3,
}

impl Motion {
    fn new(pose: Pose4, tilt: DVec2) -> Motion {
        let rotation = DQuat::from_scaled_axis(-tilt.extend(0.0)) * DQuat::from_rotation_z(-pose.yaw);
        Motion { pose, tilt, rotation: DMat3::from_quat(rotation) }
    }
}

#[derive(Clone, Copy, Debug, Default)]
struct Match {
    query: u16,
    candidate: u16,
}

/// Verifies candidates in memory that is taken once.
pub struct Verifier {
    bearing_sigma: f64,
    size: [f64; 2],
    matches: List<Match, FEATURES>,
    best: List<Match, FEATURES>,
    /// Best candidate of each query corner and its distance, and the other way around.
    forward: [(u16, u16); FEATURES],
    backward: [(u16, u16); FEATURES],
    random: u64,
}

impl Verifier {
    /// `bearing_sigma` is that of a detected corner, rad; `size` that of camera 0's image, px.
    pub fn new(bearing_sigma: f64, size: [usize; 2]) -> Verifier {
        Verifier {
            bearing_sigma,
            size: size.map(|s| s as f64),
            matches: List::default(),
            best: List::default(),
            forward: [(0, 0); FEATURES],
            backward: [(0, 0); FEATURES],
            random: 1,
        }
    }

    /// Looks for the motion between two keyframes. `None` where too few corners agree on any.
    pub fn verify(&mut self, query: &Seen, candidate: &Seen) -> Option<Verified> {
        self.random = 0x9e37_79b9_7f4a_7c15;
        self.match_all(query, candidate);
        if self.matches.len() < MATCHES_MIN {
            return None;
        }
        let matches = self.matches.len();
        let mut motion = self.ransac(query, candidate)?;
        for round in 0..3 {
            self.collect(query, candidate, &motion, round > 0);
            if self.best.len() < MATCHES_MIN / 2 {
                return None;
            }
            motion = self.refine(query, candidate, motion, 1.0, ITERATIONS[0])?.0;
        }
        self.collect(query, candidate, &motion, true);
        let (motion, _, misfit) = self.refine(query, candidate, motion, 1.0, ITERATIONS[0])?;
        let (Motion { pose, .. }, covariance, _) =
            self.refine(query, candidate, motion, DEPTHS_REFINED, ITERATIONS[1])?;
        let mut cells = 0u32;
        for m in self.best.iter() {
            let px = query.features[m.query as usize].px();
            let cell = |at: f64, size: f64, n: usize| ((at / size * n as f64) as usize).min(n - 1);
            cells |= 1 << (cell(px.y, self.size[1], CELLS[1]) * CELLS[0] + cell(px.x, self.size[0], CELLS[0]));
        }
        let cells = cells.count_ones() as usize;
        Some(Verified { candidate_from_query: pose, covariance, inliers: self.best.len(), matches, cells, misfit })
    }

    /// Fills in `matches`: pairs of which each is the other's nearest.
    fn match_all(&mut self, query: &Seen, candidate: &Seen) {
        self.matches.clear();
        self.forward.fill((0, u16::MAX));
        self.backward.fill((0, u16::MAX));
        for (i, a) in query.features.iter().enumerate() {
            for (j, b) in candidate.features.iter().enumerate() {
                let d = distance(&a.descriptor, &b.descriptor) as u16;
                if d < self.forward[i].1 {
                    self.forward[i] = (j as u16, d);
                }
                if d < self.backward[j].1 {
                    self.backward[j] = (i as u16, d);
                }
            }
        }
        for i in 0..query.features.len() {
            let (j, d) = self.forward[i];
            if u32::from(d) <= DISTANCE_MAX && self.backward[j as usize].0 as usize == i {
                let _ = self.matches.push(Match { query: i as u16, candidate: j });
            }
        }
    }

    /// The motion of two matches that the others agree with best (MSAC, Torr and Zisserman 2000).
    fn ransac(&mut self, query: &Seen, candidate: &Seen) -> Option<Motion> {
        let near = |r: &Ray| r.sigma < DRAWN_SIGMA_MAX * r.inverse_depth;
        let mut near_matches = self.matches.clone();
        near_matches.retain(|m| near(&query.rays[m.query as usize]) && near(&candidate.rays[m.candidate as usize]));
        let n = near_matches.len();
        if n < 4 {
            return None;
        }
        let (mut best, mut most, mut least, mut draws) = (None, 0, f64::INFINITY, DRAWS);
        let mut draw = 0;
        while draw < draws {
            draw += 1;
            let (a, b) = (self.uniform(n), self.uniform(n));
            let Some(pose) = motion_of_two(query, candidate, near_matches[a], near_matches[b]) else { continue };
            let motion = Motion::new(pose, DVec2::ZERO);
            let (mut agree, mut cost) = (0, 0.0);
            for m in self.matches.iter() {
                let misfit = self.misfit(query, candidate, &motion, m);
                agree += usize::from(misfit <= AGREES);
                cost += misfit.min(AGREES);
            }
            if cost < least {
                (best, most, least) = (Some(motion), agree, cost);
                let share = agree as f64 / self.matches.len() as f64;
                let needed = MISSED.ln() / (1.0 - share * share).max(1e-12).ln();
                draws = DRAWS.min(3 * needed.max(0.0) as usize + 10);
            }
        }
        best.filter(|_| most >= MATCHES_MIN / 2)
    }

    /// A number under `n`.
    fn uniform(&mut self, n: usize) -> usize {
        // xorshift64*
        self.random ^= self.random >> 12;
        self.random ^= self.random << 25;
        self.random ^= self.random >> 27;
        (((self.random.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 32) * n as u64) >> 32) as usize
    }

    fn agrees(&self, query: &Seen, candidate: &Seen, motion: &Motion, m: &Match) -> bool {
        self.misfit(query, candidate, motion, m) <= AGREES
    }

    /// Normalised squared residual of a match, its three numbers taken as independent: a bound from above on the exact one
    /// along the depth, which is cheap.
    fn misfit(&self, query: &Seen, candidate: &Seen, motion: &Motion, m: &Match) -> f64 {
        let (q, c) = (&query.rays[m.query as usize], &candidate.rays[m.candidate as usize]);
        let Some(p) = Predicted::new(query, candidate, motion, c) else { return f64::INFINITY };
        if p.bearing.dot(q.bearing) < 0.9 {
            return f64::INFINITY;
        }
        let off = p.bearing - q.bearing;
        let bearing = self.bearing_sigma.powi(2) + p.bearing_by_depth.length_squared() * c.sigma * c.sigma;
        let depth =
            q.sigma * q.sigma + (p.depth_by_depth * c.sigma).powi(2) + (self.bearing_sigma * q.inverse_depth).powi(2);
        off.length_squared() / bearing + (p.inverse_depth - q.inverse_depth).powi(2) / depth
    }

    /// Fills in `best`: the matches that agree with a motion, and, guided by it, corners that match where it says.
    fn collect(&mut self, query: &Seen, candidate: &Seen, motion: &Motion, guided: bool) {
        self.best.clear();
        if !guided {
            for k in 0..self.matches.len() {
                if self.agrees(query, candidate, motion, &self.matches[k]) {
                    let m = self.matches[k];
                    let _ = self.best.push(m);
                }
            }
            return;
        }
        self.backward.fill((0, u16::MAX));
        self.forward.fill((0, u16::MAX));
        for j in 0..candidate.rays.len() {
            let Some(p) = Predicted::new(query, candidate, motion, &candidate.rays[j]) else { continue };
            for i in 0..query.rays.len() {
                if p.bearing.dot(query.rays[i].bearing) < 0.995 {
                    continue;
                }
                let d = distance(&query.features[i].descriptor, &candidate.features[j].descriptor);
                let m = Match { query: i as u16, candidate: j as u16 };
                if d > DISTANCE_GUIDED_MAX || !self.agrees(query, candidate, motion, &m) {
                    continue;
                }
                if (d as u16) < self.backward[j].1 {
                    self.backward[j] = (i as u16, d as u16);
                }
                if (d as u16) < self.forward[i].1 {
                    self.forward[i] = (j as u16, d as u16);
                }
            }
        }
        for i in 0..query.rays.len() {
            let (j, d) = self.forward[i];
            if d != u16::MAX && self.backward[j as usize].0 as usize == i {
                let _ = self.best.push(Match { query: i as u16, candidate: j });
            }
        }
    }

    /// Refines a motion by the matches in `best` (Gauss-Newton, Geman-McClure weights at the gate), with deviations of depths that
    /// are `depths` of those stated: motion, covariance of its pose, misfit.
    fn refine(
        &self,
        query: &Seen,
        candidate: &Seen,
        start: Motion,
        depths: f64,
        steps: usize,
    ) -> Option<(Motion, Matrix4<f64>, f64)> {
        let level = TILT_SIGMA.powi(-2);
        let mut motion = start;
        let (mut h, mut sum) = (Matrix6::zeros(), 0.0);
        for round in 0..=steps {
            h = Matrix6::from_diagonal(&Vector6::new(0.0, 0.0, 0.0, 0.0, level, level));
            let mut b = Vector6::new(0.0, 0.0, 0.0, 0.0, level * motion.tilt.x, level * motion.tilt.y);
            let mut weights = 0.0;
            sum = 0.0;
            for m in self.best.iter() {
                let Some((r, j)) = self.residual(query, candidate, &motion, m, depths) else { continue };
                let chi2 = r.norm_squared();
                let weight = (AGREES / (AGREES + chi2)).powi(2);
                h += j.transpose() * j * weight;
                b += j.transpose() * r * weight;
                sum += weight * chi2;
                weights += 3.0 * weight;
            }
            sum /= f64::max(weights - 4.0, 1.0);
            if round == steps {
                break;
            }
            let step = h.cholesky()?.solve(&b);
            let Motion { pose: Pose4 { p, yaw }, tilt, .. } = motion;
            let pose = Pose4 { p: p - DVec3::new(step[0], step[1], step[2]), yaw: wrapped(yaw - step[3]) };
            motion = Motion::new(pose, tilt - DVec2::new(step[4], step[5]));
            if step.norm() < CONVERGED {
                break;
            }
        }
        let mut covariance = h.cholesky()?.inverse().fixed_view::<4, 4>(0, 0) * sum.max(1.0);
        for i in 0..4 {
            covariance[(i, i)] += FLOOR[i / 3].powi(2);
        }
        (motion.pose.p.is_finite() && covariance.iter().all(|c| c.is_finite())).then_some((motion, covariance, sum))
    }

    /// Whitened residual of a match (two of bearing, one of inverse depth) and its derivative by position, yaw and tilt.
    fn residual(
        &self,
        query: &Seen,
        candidate: &Seen,
        motion: &Motion,
        m: &Match,
        depths: f64,
    ) -> Option<(Vector3<f64>, Matrix3x6<f64>)> {
        let (q, c) = (&query.rays[m.query as usize], &candidate.rays[m.candidate as usize]);
        let p = Predicted::new(query, candidate, motion, c)?;
        let (u, v) = q.bearing.any_orthonormal_pair();
        let rows = |d: DVec3, depth: f64| Vector3::new(u.dot(d), v.dot(d), depth);
        let r = rows(p.bearing - q.bearing, p.inverse_depth - q.inverse_depth);
        let mut j = Matrix3x6::zeros();
        for (k, (bearing, depth)) in p.by_motion().into_iter().enumerate() {
            j.set_column(k, &rows(bearing, depth));
        }
        let by_depth = rows(p.bearing_by_depth, p.depth_by_depth) * (depths * c.sigma);
        let own =
            [self.bearing_sigma, self.bearing_sigma, (depths * q.sigma).hypot(self.bearing_sigma * q.inverse_depth)];
        let covariance =
            nalgebra::Matrix3::from_diagonal(&Vector3::from(own.map(|s| s * s))) + by_depth * by_depth.transpose();
        let l = covariance.cholesky()?.l();
        Some((l.solve_lower_triangular(&r)?, l.solve_lower_triangular(&j)?))
    }
}

/// Where the query should see a corner of the candidate.
struct Predicted {
    bearing: DVec3,
    inverse_depth: f64,
    /// Derivatives by the candidate's inverse depth.
    bearing_by_depth: DVec3,
    depth_by_depth: f64,
    /// The corner in the query's level frame over its distance from the candidate; that from the camera is `length` long.
    turned: DVec3,
    rotation: DMat3,
    length: f64,
    candidate_inverse_depth: f64,
}

impl Predicted {
    /// `None` where the corner would be in the camera itself.
    fn new(query: &Seen, candidate: &Seen, motion: &Motion, ray: &Ray) -> Option<Predicted> {
        let Motion { pose, rotation, .. } = *motion;
        let rho = ray.inverse_depth;
        let turned = rotation * (ray.bearing + rho * (candidate.camera - pose.p));
        let w = turned - rho * query.camera;
        let length = w.length();
        if !(length > 1e-3) {
            return None;
        }
        let bearing = w / length;
        let by_depth = rotation * (candidate.camera - pose.p) - query.camera;
        let along = bearing.dot(by_depth);
        Some(Predicted {
            bearing,
            inverse_depth: rho / length,
            bearing_by_depth: (by_depth - bearing * along) / length,
            depth_by_depth: (1.0 - rho * along / length) / length,
            turned,
            rotation,
            length,
            candidate_inverse_depth: rho,
        })
    }

    /// Derivatives of bearing and inverse depth by the position and the yaw of the motion, and, where it is small, by its tilt.
    fn by_motion(&self) -> [(DVec3, f64); 6] {
        let rho = self.candidate_inverse_depth;
        let columns = [self.rotation.x_axis, self.rotation.y_axis, self.rotation.z_axis].map(|c| -rho * c);
        let [yaw, x, y] = [self.rotation.z_axis, DVec3::X, DVec3::Y].map(|axis| -axis.cross(self.turned));
        [columns[0], columns[1], columns[2], yaw, x, y].map(|d| {
            let along = self.bearing.dot(d);
            ((d - self.bearing * along) / self.length, -rho * along / (self.length * self.length))
        })
    }
}

/// The motion that takes two corners of the query to those of the candidate.
fn motion_of_two(query: &Seen, candidate: &Seen, a: Match, b: Match) -> Option<Pose4> {
    let point = |seen: &Seen, i: u16| {
        let ray = &seen.rays[i as usize];
        (seen.camera + ray.bearing / ray.inverse_depth, ray.sigma / (ray.inverse_depth * ray.inverse_depth))
    };
    let [(qa, sqa), (qb, sqb)] = [a, b].map(|m| point(query, m.query));
    let [(ca, sca), (cb, scb)] = [a, b].map(|m| point(candidate, m.candidate));
    let (dq, dc) = (qb - qa, cb - ca);
    let lever = dq.truncate().length().min(dc.truncate().length());
    let sigma = (sqa * sqa + sqb * sqb + sca * sca + scb * scb).sqrt();
    if lever < LEVER_MIN || (dq.length() - dc.length()).abs() > 3.0 * sigma || (dq.z - dc.z).abs() > 3.0 * sigma {
        return None;
    }
    let yaw = wrapped(dc.y.atan2(dc.x) - dq.y.atan2(dq.x));
    let r = DMat3::from_rotation_z(yaw);
    let p = 0.5 * ((ca - r * qa) + (cb - r * qb));
    p.is_finite().then_some(Pose4 { p, yaw })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::features::Descriptor;
    use super::*;
    use crate::world::{stream, Noise};
    use nalgebra::Vector4;

    /// A keyframe of a world of points, with the noise of corners and stereo.
    struct View {
        features: Vec<Feature>,
        rays: Vec<Ray>,
        camera: DVec3,
    }

    const SIGMA_RAD: f64 = 1e-3;

    impl View {
        fn new(level: &Pose4, points: &[(DVec3, Descriptor)], worn: usize, rng: &mut Noise) -> View {
            let camera = DVec3::new(0.1, 0.0, 0.05);
            let mut view = View { features: vec![], rays: vec![], camera };
            for (p, descriptor) in points {
                let d = level.inverse().apply(*p) - camera;
                if d.x < 0.5 {
                    continue;
                }
                let off = rng.vector() * SIGMA_RAD;
                let sigma = 0.01;
                let inverse_depth = (1.0 / d.length() + sigma * rng.normal()).max(0.01);
                let mut descriptor = *descriptor;
                (0..worn).for_each(|_| flip(&mut descriptor, rng.bits()));
                let px = glam::DVec2::new(320.0 - 200.0 * d.y / d.x, 240.0 - 200.0 * d.z / d.x);
                let px = px.clamp(glam::DVec2::ZERO, glam::DVec2::new(639.0, 479.0));
                view.features.push(Feature::new(descriptor, px, inverse_depth, sigma).unwrap());
                let bearing = (d.normalize() + off).normalize();
                view.rays.push(Ray { bearing, inverse_depth, sigma });
            }
            view
        }

        fn seen(&self) -> Seen<'_> {
            Seen { features: &self.features, rays: &self.rays, camera: self.camera }
        }
    }

    fn flip(descriptor: &mut Descriptor, bit: u64) {
        descriptor[bit as usize / 64 % 4] ^= 1 << (bit % 64);
    }

    /// From one number to another.
    fn within(low: f64, high: f64, rng: &mut Noise) -> f64 {
        low + (high - low) * rng.uniform()
    }

    fn points(count: usize, rng: &mut Noise) -> Vec<(DVec3, Descriptor)> {
        let mut one = || {
            let p = DVec3::new(within(2.0, 9.0, rng), within(-4.0, 4.0, rng), within(-1.5, 1.5, rng));
            (p, std::array::from_fn(|_| rng.bits()))
        };
        (0..count).map(|_| one()).collect()
    }

    #[test]
    fn derivatives_are_those_of_what_is_predicted() {
        let mut rng = stream(1, 0);
        let world = points(30, &mut rng);
        let (a, b) = (Pose4::default(), Pose4 { p: DVec3::new(0.4, -0.3, 0.1), yaw: 0.3 });
        let (query, candidate) = (View::new(&b, &world, 0, &mut rng), View::new(&a, &world, 0, &mut rng));
        let (q, c) = (query.seen(), candidate.seen());
        let pose = Pose4 { p: DVec3::new(0.5, -0.2, 0.0), yaw: 0.35 };
        // Those by the tilt itself hold where there is none.
        for (ray, tilt, known) in
            candidate.rays.iter().flat_map(|r| [(r, DVec2::ZERO, 6), (r, DVec2::new(0.3, -0.2), 4)])
        {
            let motion = Motion::new(pose, tilt);
            let at = |motion: &Motion| {
                let p = Predicted::new(&q, &c, motion, ray).unwrap();
                (p.bearing, p.inverse_depth)
            };
            let by_motion = Predicted::new(&q, &c, &motion, ray).unwrap().by_motion();
            for (k, (bearing, depth)) in by_motion.into_iter().take(known).enumerate() {
                let moved = |by: f64| {
                    let (mut pose, mut tilt) = (pose, tilt);
                    match k {
                        0..3 => pose.p[k] += by,
                        3 => pose.yaw += by,
                        _ => tilt[k - 4] += by,
                    }
                    at(&Motion::new(pose, tilt))
                };
                let h = 1e-6;
                let (plus, minus) = (moved(h), moved(-h));
                assert!(((plus.0 - minus.0) / (2.0 * h) - bearing).length() < 1e-7, "{k}");
                assert!(((plus.1 - minus.1) / (2.0 * h) - depth).abs() < 1e-7, "{k}");
            }
            let far = |by: f64| {
                let ray = Ray { inverse_depth: ray.inverse_depth + by, ..*ray };
                let p = Predicted::new(&q, &c, &motion, &ray).unwrap();
                (p.bearing, p.inverse_depth)
            };
            let p = Predicted::new(&q, &c, &motion, ray).unwrap();
            let (plus, minus) = (far(1e-6), far(-1e-6));
            assert!(((plus.0 - minus.0) / 2e-6 - p.bearing_by_depth).length() < 1e-7);
            assert!(((plus.1 - minus.1) / 2e-6 - p.depth_by_depth).abs() < 1e-7);
        }
    }

    #[test]
    fn the_motion_is_found_among_as_many_wrong_corners_with_the_deviation_that_is_stated() {
        let mut rng = stream(2, 0);
        let mut verifier = Verifier::new(SIGMA_RAD, [640, 480]);
        let (mut nees, n) = (0.0, 40);
        for _ in 0..n {
            let world = points(120, &mut rng);
            let others = [points(100, &mut rng), points(100, &mut rng)];
            let truth = Pose4 {
                p: DVec3::new(within(-1.0, 1.0, &mut rng), within(-1.0, 1.0, &mut rng), within(-0.3, 0.3, &mut rng)),
                yaw: within(-0.5, 0.5, &mut rng),
            };
            let [with_a, with_b] = others.map(|other| [world.clone(), other].concat());
            let candidate = View::new(&Pose4::default(), &with_a, 12, &mut rng);
            let query = View::new(&truth, &with_b, 12, &mut rng);
            let v = verifier.verify(&query.seen(), &candidate.seen()).unwrap();
            let (p, yaw) = (v.candidate_from_query.p - truth.p, wrapped(v.candidate_from_query.yaw - truth.yaw));
            assert!(p.length() < 0.1 && yaw.abs() < 0.02, "{v:?} {truth:?}");
            assert!(v.inliers > 60 && v.cells >= 4 && v.misfit < 1.6, "{v:?}");
            let e = Vector4::new(p.x, p.y, p.z, yaw);
            nees += e.dot(&v.covariance.cholesky().unwrap().solve(&e)) / n as f64;
        }
        assert!(nees < 6.0, "4 where deviations are as stated: {nees}");
    }

    /// Gravity of the query is off by 4 mrad, which moves what it sees by as much as 2 cm would.
    #[test]
    fn a_frame_that_is_not_level_does_not_shift_the_motion() {
        let mut rng = stream(5, 0);
        let mut verifier = Verifier::new(SIGMA_RAD, [640, 480]);
        let (mut off, n) = (0.0, 20);
        for k in 0..n {
            let world = points(120, &mut rng);
            let truth = Pose4 { p: DVec3::new(0.8, -0.5, 0.2), yaw: 0.2 };
            let candidate = View::new(&Pose4::default(), &world, 12, &mut rng);
            let mut query = View::new(&truth, &world, 12, &mut rng);
            let axis = DVec3::new((k as f64).cos(), (k as f64).sin(), 0.0);
            let tilt = DQuat::from_scaled_axis(axis * 0.004);
            query.rays.iter_mut().for_each(|ray| ray.bearing = tilt * ray.bearing);
            query.camera = tilt * query.camera;
            let v = verifier.verify(&query.seen(), &candidate.seen()).unwrap();
            off += (v.candidate_from_query.p - truth.p).length() / n as f64;
        }
        assert!(off < 0.01, "{off} m");
    }

    #[test]
    fn different_places_and_extreme_numbers_are_not_verified() {
        let mut rng = stream(3, 0);
        let mut verifier = Verifier::new(SIGMA_RAD, [640, 480]);
        let views: Vec<View> =
            (0..8).map(|k| View::new(&Pose4::default(), &points(200, &mut stream(3, k)), 0, &mut rng)).collect();
        for k in 1..8 {
            let found = verifier.verify(&views[0].seen(), &views[k].seen());
            assert!(found.is_none_or(|v| v.inliers < 20), "{found:?}");
        }
        let nothing = Seen { features: &[], rays: &[], camera: DVec3::ZERO };
        assert!(verifier.verify(&nothing, &views[0].seen()).is_none());
        assert!(verifier.verify(&views[0].seen(), &nothing).is_none());
        // All corners look the same, at one place.
        let same = View {
            features: vec![Feature::new([1; 4], glam::DVec2::splat(99.0), 0.25, 0.01).unwrap(); 100],
            rays: vec![Ray { bearing: DVec3::X, inverse_depth: 0.25, sigma: 0.01 }; 100],
            camera: DVec3::ZERO,
        };
        assert!(verifier.verify(&same.seen(), &same.seen()).is_none());
        let broken = View {
            rays: vec![Ray { bearing: DVec3::NAN, inverse_depth: f64::NAN, sigma: f64::NAN }; views[0].rays.len()],
            features: views[0].features.clone(),
            camera: DVec3::NAN,
        };
        assert!(verifier.verify(&views[0].seen(), &broken.seen()).is_none());
    }
}
