//! Acceptance of a loop: which of a keyframe's verifications is to be believed, if any, and why not.

use super::graph::{Edge, PoseGraph};
use super::pose4::{turned, wrapped, Pose4};
use super::verify::Verified;
use crate::mem::List;
use nalgebra::{Matrix4, Vector4};
use stipple_drivers::Nanos;

/// Corners that have to agree, their share of the matches, the cells of twelve that they are in, and how badly they may
/// agree, in deviations squared.
const INLIERS_MIN: usize = 30;
const SHARE_MIN: f64 = 0.5;
const CELLS_MIN: usize = 4;
const MISFIT_MAX: f64 = 1.6;
/// Deviations up to which a verification says where it was taken from: m, rad.
const SIGMA_MAX: [f64; 2] = [0.2, 0.02];
/// Two verifications agree within these, and within 3 deviations: m, rad.
const AGREE: [f64; 2] = [1.0, 0.035];
/// Verifications of the keyframes before count for so long, s.
const REMEMBERED_S: f64 = 5.0;
/// A place in another frame needs so many verifications that agree with it, one of an earlier keyframe, and so many corners.
const JOIN_AGREE: usize = 2;
const JOIN_INLIERS: usize = 40;
/// Another place, so far away, with this share of its corners speaks against it, where the corners agree at least so well and say
/// so precisely where they are seen from: a corridor of equal doors has 0.36 of them one door, 3 m, further.
const JOIN_RIVAL_SHARE: f64 = 0.35;
const JOIN_RIVAL_M: f64 = 2.0;
const RIVAL_MISFIT_MAX: f64 = 2.4;
const RIVAL_YAW_SIGMA_MAX: f64 = 0.025;
/// A place with this share of the corners that agree looks the same.
const AMBIGUOUS_SHARE: f64 = 0.6;
/// Squared deviations of 4 numbers that odometry may have drifted: 3 deviations of one. For a place that may be confused
/// with it, which is to be excluded safely: 5 deviations.
const DRIFT_MAX: f64 = 16.25;
const EXCLUDED: f64 = 34.6;
/// Drift of odometry: m² for each m, m² and rad² for each keyframe, rad² for each s, rad² for each rad turned.
const DRIFT_PER_M: f64 = 4e-5;
const DRIFT_PER_KEYFRAME: [f64; 2] = [1e-7, 1e-9];
const DRIFT_PER_S: f64 = 3e-7;
const DRIFT_PER_RAD: f64 = 1e-7;
/// By how much more the variance of a long way is, as errors of one keyframe and the next are not independent.
const CORRELATED: f64 = 10.0;

/// A candidate that was verified.
#[derive(Clone, Copy, Debug)]
pub struct Verification {
    /// The candidate's node.
    pub node: u16,
    pub verified: Verified,
}

impl Verification {
    /// The edge from the candidate to the keyframe that was verified.
    pub fn edge(&self, node: u16) -> Edge {
        let Verified { candidate_from_query: measured, covariance, .. } = self.verified;
        Edge { from: self.node, to: node, measured, covariance, is_loop: true }
    }

    /// Whether it is to be believed, and says about the same as the graph.
    pub fn agrees_with(&self, node: u16, graph: &PoseGraph) -> bool {
        let expected = graph.pose(self.node).between(&graph.pose(node));
        let found = &self.verified.candidate_from_query;
        let (far, angle) = ((found.p - expected.p).length(), wrapped(found.yaw - expected.yaw).abs());
        is_strong(&self.verified) && far < AGREE[0] && angle < 5.0 * AGREE[1]
    }
}

impl Default for Verification {
    fn default() -> Verification {
        let verified = Verified {
            candidate_from_query: Pose4::default(),
            covariance: Matrix4::identity(),
            inliers: 0,
            matches: 0,
            cells: 0,
            misfit: f64::INFINITY,
        };
        Verification { node: 0, verified }
    }
}

#[derive(Clone, Copy, Debug)]
pub enum Verdict {
    Accepted(Verification),
    /// Accepted, of a place in another frame: nothing led from one to the other so far.
    Joins(Verification),
    /// No candidate was verified.
    None,
    Weak,
    Alone,
    Ambiguous,
    Implausible,
}

/// A keyframe that is judged.
#[derive(Clone, Copy, Debug)]
pub struct Asker {
    pub node: u16,
    pub t: Nanos,
    /// Epoch of the estimator, and the pose in its frame.
    pub epoch: u32,
    pub odom: Pose4,
    /// The frame that its node is in.
    pub frame: u32,
}

/// A verification of an earlier keyframe: where it puts that keyframe.
#[derive(Clone, Copy, Debug, Default)]
struct Remembered {
    t: Nanos,
    /// In `odom`, and by the verification in the frame of the candidate.
    odom: Pose4,
    frame: u32,
    map: Pose4,
    sigma: [f64; 2],
    inliers: usize,
    /// It is to be believed; else it only tells that another place may look the same.
    strong: bool,
}

type Strong = (Verification, Remembered);

/// Remembers what the last keyframes were verified with.
#[derive(Default)]
pub struct Judge {
    remembered: List<Remembered, 64>,
    epoch: u32,
}

impl Judge {
    /// Judges the verifications of a keyframe; `frame_of` is the frame that a node is in.
    pub fn judge(
        &mut self,
        asker: &Asker,
        verified: &[Verification],
        frame_of: impl Fn(u16) -> u32,
        graph: &mut PoseGraph,
    ) -> Verdict {
        let &Asker { t, odom, .. } = asker;
        // Nothing leads from one epoch of the estimator to the next.
        let goes_on = std::mem::replace(&mut self.epoch, asker.epoch) == asker.epoch;
        self.remembered.retain(|r| goes_on && (t - r.t).secs().abs() <= REMEMBERED_S);
        if verified.is_empty() {
            return Verdict::None;
        }
        let mut seen: List<Strong, 16> = List::default();
        for v in verified.iter().filter(|v| is_rival(&v.verified)) {
            let map = graph.pose(v.node).compose(&v.verified.candidate_from_query);
            let c = &v.verified.covariance;
            let sigma = [(c[(0, 0)] + c[(1, 1)] + c[(2, 2)]).sqrt(), c[(3, 3)].sqrt()];
            let (frame, inliers, strong) = (frame_of(v.node), v.verified.inliers, is_strong(&v.verified));
            let _ = seen.push((*v, Remembered { t, odom, frame, map, sigma, inliers, strong }));
        }
        let mut strong = seen.clone();
        strong.retain(|(_, r)| r.strong);
        // Others that agree with one: of this keyframe by other candidates, and of earlier keyframes.
        let support = |i: usize| {
            let others = strong.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, (_, r))| r);
            others.chain(self.remembered.iter()).filter(|r| agree(&strong[i].1, r)).count()
        };
        let best = |here: bool| {
            let of_kind = (0..strong.len()).filter(|i| (strong[*i].1.frame == asker.frame) == here);
            of_kind.map(|i| (support(i), strong[i].0.verified.inliers, i)).max()
        };
        let here = match best(true) {
            None => Verdict::Weak,
            Some((0, ..)) => Verdict::Alone,
            Some((.., i)) => weigh(asker.node, &strong[i], &strong, graph),
        };
        let verdict = match (here, best(false)) {
            (Verdict::Accepted(_), _) | (_, None) => here,
            (_, Some((count, _, i))) => self.weigh_join(&strong[i], count, &seen),
        };
        for (_, r) in seen.iter() {
            if self.remembered.is_full() {
                self.remembered.rotate_left(1);
                let last = self.remembered.len() - 1;
                self.remembered[last] = *r;
            } else {
                let _ = self.remembered.push(*r);
            }
        }
        verdict
    }

    /// Judges a place in another frame, that so many verifications agree with. No pose excludes a place that looks the same,
    /// so another keyframe has to say the same, and none may say otherwise.
    fn weigh_join(&self, (v, r): &Strong, count: usize, seen: &[Strong]) -> Verdict {
        let before = self.remembered.iter().filter(|s| s.t != r.t && agree(r, s)).count();
        if before == 0 || count < JOIN_AGREE || r.inliers < JOIN_INLIERS {
            return Verdict::Alone;
        }
        let all = seen.iter().map(|(_, s)| s).chain(self.remembered.iter());
        let alike = |s: &&Remembered| s.inliers as f64 >= JOIN_RIVAL_SHARE * r.inliers as f64;
        let far = |s: &&Remembered| (carried(s, r).p - r.map.p).length() > JOIN_RIVAL_M;
        let mut rivals = all.filter(|s| s.frame == r.frame).filter(alike).filter(far);
        match rivals.next() {
            Some(_) => Verdict::Ambiguous,
            None => Verdict::Joins(*v),
        }
    }
}

/// Where a verification puts the vehicle at the time of another one.
fn carried(from: &Remembered, to: &Remembered) -> Pose4 {
    from.map.compose(&from.odom.between(&to.odom))
}

fn is_elsewhere(map: &Pose4, r: &Remembered) -> bool {
    let (far, angle) = ((map.p - r.map.p).length(), wrapped(map.yaw - r.map.yaw).abs());
    far > AGREE[0] || angle > 5.0 * AGREE[1]
}

fn looks_alike(rival: &Remembered, best: &Remembered) -> bool {
    rival.inliers as f64 >= AMBIGUOUS_SHARE * best.inliers as f64
}

/// Whether two verifications put the vehicle at the same place.
fn agree(a: &Remembered, b: &Remembered) -> bool {
    let carried = carried(b, a);
    let (far, angle) = ((carried.p - a.map.p).length(), wrapped(carried.yaw - a.map.yaw).abs());
    let within = |k: usize| AGREE[k].min(3.0 * a.sigma[k].hypot(b.sigma[k]));
    // The lever of the motion between them turns yaw into distance.
    let lever = (b.odom.p - a.odom.p).length() * b.sigma[1] * 3.0;
    b.strong && a.frame == b.frame && far <= (within(0) + lever).min(AGREE[0]) && angle <= within(1)
}

fn is_strong(v: &Verified) -> bool {
    let c = &v.covariance;
    v.inliers >= INLIERS_MIN
        && v.inliers as f64 >= SHARE_MIN * v.matches as f64
        && v.cells >= CELLS_MIN
        && v.misfit <= MISFIT_MAX
        && (0..3).all(|i| c[(i, i)] < SIGMA_MAX[0] * SIGMA_MAX[0])
        && c[(3, 3)] < SIGMA_MAX[1] * SIGMA_MAX[1]
}

/// Whether a verification is good enough to speak against another one.
fn is_rival(v: &Verified) -> bool {
    v.cells >= CELLS_MIN && v.misfit <= RIVAL_MISFIT_MAX && v.covariance[(3, 3)].sqrt() <= RIVAL_YAW_SIGMA_MAX
}

/// Compares a verification with what the graph knows, and with its rivals.
fn weigh(node: u16, best: &Strong, strong: &[Strong], graph: &mut PoseGraph) -> Verdict {
    let (v, r) = best;
    let rivals = strong.iter().filter(|(_, s)| s.frame == r.frame && looks_alike(s, r) && is_elsewhere(&s.map, r));
    let mut ambiguous = false;
    for (w, _) in rivals {
        ambiguous |= drift(node, w, graph).is_none_or(|d| d < EXCLUDED);
    }
    match drift(node, v, graph) {
        Some(d) if !(d <= DRIFT_MAX) => Verdict::Implausible,
        // No odometry leads from one to the other.
        None => Verdict::Implausible,
        _ if ambiguous => Verdict::Ambiguous,
        _ => Verdict::Accepted(*v),
    }
}

/// Squared deviations, of 4 numbers, by which a verification contradicts the graph. `None` where nothing connects the two.
fn drift(node: u16, v: &Verification, graph: &mut PoseGraph) -> Option<f64> {
    let expected = graph.pose(v.node).between(&graph.pose(node));
    let found = &v.verified.candidate_from_query;
    let covariance = graph.covariance_between(v.node, node)? * CORRELATED + v.verified.covariance;
    let (p, yaw) = (found.p - expected.p, wrapped(found.yaw - expected.yaw));
    let e = Vector4::new(p.x, p.y, p.z, yaw);
    Some(e.dot(&covariance.cholesky()?.solve(&e)))
}

/// Covariance of a motion by odometry in so much time: of position in the first frame, m², and yaw, rad².
pub fn odometry_covariance(moved: &Pose4, secs: f64) -> Matrix4<f64> {
    let far = moved.p.length();
    let p = DRIFT_PER_M * far + DRIFT_PER_KEYFRAME[0];
    let yaw = DRIFT_PER_S * secs.abs() + DRIFT_PER_RAD * moved.yaw.abs() + DRIFT_PER_KEYFRAME[1];
    let mut c = Matrix4::from_diagonal(&Vector4::new(p, p, p, yaw));
    // A yaw that is off turns the motion: half of it on the way.
    let side = 0.5 * turned(std::f64::consts::FRAC_PI_2, moved.p);
    let lever = Vector4::new(side.x, side.y, 0.0, 0.0);
    c += lever * lever.transpose() * yaw;
    let cross = lever * yaw;
    for i in 0..2 {
        c[(i, 3)] += cross[i];
        c[(3, i)] += cross[i];
    }
    c
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use glam::DVec3;

    /// A walk of 60 m out and back, a keyframe each metre and second.
    fn walk() -> PoseGraph {
        let mut graph = PoseGraph::new(64, 128, 512);
        for k in 0..61u16 {
            let x = if k <= 30 { k } else { 60 - k };
            let pose = Pose4 { p: DVec3::new(x as f64, 0.0, 0.0), yaw: 0.0 };
            assert_eq!(graph.add(pose), Some(k));
            if k > 0 {
                let measured = graph.pose(k - 1).between(&pose);
                let covariance = odometry_covariance(&measured, 1.0);
                graph.link(Edge { from: k - 1, to: k, measured, covariance, is_loop: false }).unwrap();
            }
        }
        graph
    }

    /// Node 60, which is at node 0, verified by another: at its true place but for `off`.
    fn verified(graph: &PoseGraph, node: u16, off: DVec3, inliers: usize) -> Verification {
        let true_pose = graph.pose(node).between(&graph.pose(60));
        let verified = Verified {
            candidate_from_query: Pose4 { p: true_pose.p + off, ..true_pose },
            covariance: Matrix4::identity() * 1e-4,
            inliers,
            matches: inliers + 10,
            cells: 8,
            misfit: 0.8,
        };
        Verification { node, verified }
    }

    fn asker(node: u16, seconds: i64, graph: &PoseGraph) -> Asker {
        Asker { node, t: Nanos(seconds * 1_000_000_000), epoch: 0, odom: graph.pose(node), frame: 0 }
    }

    fn judged(list: &[Verification], graph: &mut PoseGraph) -> String {
        let verdict = Judge::default().judge(&asker(60, 60, graph), list, |_| 0, graph);
        format!("{verdict:?}").split(['(', ' ']).next().unwrap().to_string()
    }

    #[test]
    fn each_verdict_has_its_reason() {
        let mut g = walk();
        let right = |node, g: &PoseGraph| verified(g, node, DVec3::new(0.0, 0.3, 0.0), 60);
        let (a, b) = (right(0, &g), right(1, &g));
        assert_eq!(judged(&[], &mut g), "None");
        assert_eq!(judged(&[a, b], &mut g), "Accepted");
        assert_eq!(judged(&[a], &mut g), "Alone");
        let weak = |change: fn(&mut Verified)| {
            let mut v = [a, b];
            v.iter_mut().for_each(|v| change(&mut v.verified));
            v
        };
        for change in [
            (|v| v.inliers = INLIERS_MIN - 1) as fn(&mut Verified),
            |v| v.matches = 300,
            |v| v.cells = CELLS_MIN - 1,
            |v| v.misfit = 3.0,
            |v| v.misfit = f64::NAN,
            |v| v.covariance *= 1e4,
            |v| v.covariance *= f64::NAN,
        ] {
            assert_eq!(judged(&weak(change), &mut g), "Weak");
        }
        // A twin of the place, 14 m from it: odometry of 60 m does not err so.
        let far = |node, g: &PoseGraph| verified(g, node, DVec3::new(14.0, 0.0, 0.0), 90);
        let twins = [far(0, &g), far(1, &g)];
        assert_eq!(judged(&twins, &mut g), "Implausible");
        // Beside it the true one is believed all the same, where it is the better one.
        let better = [verified(&g, 0, DVec3::ZERO, 120), verified(&g, 1, DVec3::ZERO, 120), twins[0], twins[1]];
        assert_eq!(judged(&better, &mut g), "Accepted");
        // A rival within what odometry may err.
        let rival = [a, b, verified(&g, 2, DVec3::new(0.0, -1.0, 0.0), 50)];
        assert_eq!(judged(&rival, &mut g), "Ambiguous");
        let small = [a, b, verified(&g, 2, DVec3::new(0.0, -1.0, 0.0), 30)];
        assert_eq!(judged(&small, &mut g), "Accepted", "it looks much less alike");
    }

    #[test]
    fn verifications_of_keyframes_before_count_where_odometry_leads_from_them() {
        let mut g = walk();
        let mut judge = Judge::default();
        let at = |node: u16, by: u16, g: &PoseGraph| {
            let mut v = verified(g, by, DVec3::ZERO, 60);
            v.verified.candidate_from_query = g.pose(by).between(&g.pose(node));
            v
        };
        for (node, seconds, accepted) in [(58u16, 58, false), (59, 59, true), (60, 70, false)] {
            let v = at(node, 1, &g);
            let verdict = judge.judge(&asker(node, seconds, &g), &[v], |_| 0, &mut g);
            assert_eq!(matches!(verdict, Verdict::Accepted(_)), accepted, "{node}");
        }
    }

    #[test]
    fn the_covariance_of_odometry_grows_with_the_way_and_is_positive_definite() {
        for (p, yaw, secs) in [(0.0, 0.0, 0.0), (1.0, 3.0, 0.2), (100.0, -3.0, 60.0), (1e-9, 0.0, 1e6)] {
            let c = odometry_covariance(&Pose4 { p: DVec3::new(p, -p, 0.1 * p), yaw }, secs);
            let edge = Edge { from: 0, to: 1, measured: Pose4::default(), covariance: c, is_loop: false };
            assert!(c.cholesky().is_some(), "{p} {yaw} {secs}");
            assert!(edge.is_valid());
        }
    }
}
