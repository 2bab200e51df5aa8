//! Loop closure: recognises places, and corrects the drift of odometry by them, in memory that is taken once.
//!
//! ```text
//! keyframe -> features -> index -> candidates -> verification -> acceptance -> pose graph -> map_from_odom, corrections
//!                 `----------------> stored with the keyframe      `-> refused, counted by reason
//! ```
//!
//! A closure that is false is the worst fault there is: so two verifications have to agree, no other place may look the same
//! that the drift allows, and the correction has to be one that odometry can have made since (3 deviations).
//!
//! Frames: `odom` is that of the estimator, which drifts and never jumps inside an epoch; `map` is the one in which loops
//! agree. Whoever needs a pose in `map` composes it with `Loops::map_from_odom`.

pub mod accept;
pub mod features;
pub mod graph;
pub mod index;
pub mod pose4;
pub mod verify;

use crate::config::FrontendConfig;
use crate::limits::CAMERAS_MAX;
use crate::mem::List;
use accept::{Judge, Verdict, Verification};
use features::{Extractor, Feature, Ray, FEATURES};
use glam::{DQuat, DVec3};
use graph::{Edge, PoseGraph};
use index::{Candidate, PlaceIndex};
use pose4::Pose4;
use std::sync::Arc;
use stipple_drivers::{counters, Calibration, Fault, Frames, Nanos, Pose};
use verify::{Seen, Verifier, CORNER_SIGMA_PX};

/// Candidates that are verified for a keyframe: by looks, and by where they are.
const BY_LOOKS: usize = 8;
const BY_PLACE: usize = 3;
/// A keyframe closes no loop with one younger than this, s.
const OLD_S: f64 = 20.0;
/// Once a loop is closed, the next that says the same has to wait so long, s.
const REST_S: f64 = 1.0;
/// Candidates by place are nearer than this, m, and look within this angle of the same direction, rad.
const NEAR_M: f64 = 3.0;
const NEAR_RAD: f64 = 0.8;

counters! {
    /// What became of keyframes that looked for a loop.
    #[derive(Clone, Copy, PartialEq, Eq)]
    pub struct Stats of u64, read by u64::clone;
    /// Keyframes whose place was recognised, and those of them by which a loop was closed.
    loops_recognised,
    loops_closed,
    /// Closures of which the graph made nothing, as the others contradict them.
    loops_rejected,
    /// Keyframes that were compared with older ones, and those of them that agree with none.
    loop_queries,
    loops_none,
    /// Too few corners agree, too close together, or worse than their deviations.
    loops_weak,
    /// No second verification agrees.
    loops_alone,
    /// Another place looks the same.
    loops_ambiguous,
    /// Odometry cannot have drifted that far.
    loops_implausible,
    /// The graph had no room for the loop, or could not be solved in its memory.
    loops_unsolved,
    /// Keyframes that were taken out of the graph as it was full.
    loop_keyframes_dropped,
}

/// A keyframe as the estimator hands it over.
pub struct LoopKeyframe<'a> {
    pub t: Nanos,
    pub frames: &'a Arc<Frames>,
    /// Its number for the map, where the map took it.
    pub id: Option<u64>,
    pub epoch: u32,
    pub odom_from_body: Pose,
    /// The newest estimate of the keyframe before it.
    pub before: Option<(Nanos, Pose)>,
    pub body_from_cam: Option<[Pose; CAMERAS_MAX]>,
}

/// What is kept of a keyframe.
#[derive(Clone, Copy, Default)]
pub struct Place {
    pub t: Nanos,
    pub id: Option<u64>,
    pub epoch: u32,
    /// Pose in `odom`, of the upright frame, and what turns the body upright.
    pub odom: Pose4,
    pub tilt: DQuat,
    features: u16,
    used: bool,
}

/// A loop that was closed.
#[derive(Clone, Copy, Debug)]
pub struct Closure {
    pub t: Nanos,
    /// Stamp of the keyframe that was recognised.
    pub with: Nanos,
    /// Corners that agree.
    pub inliers: usize,
    /// Pose of this keyframe's level frame in that of the one that was recognised.
    pub measured: Pose4,
    /// By how much `map_from_odom` changed for this keyframe: m, rad.
    pub moved: [f64; 2],
}

/// Closures that are kept for the report, beside their count.
const CLOSURES: usize = 256;

/// Corrections of odometry by the loops of a flight: epoch, stamp, `map_from_odom`.
#[derive(Clone, Debug, Default)]
pub struct Corrections {
    list: Vec<(u32, Nanos, Pose4)>,
}

impl Corrections {
    /// A pose of the estimator in the map; between two keyframes of its epoch by what lies between their corrections.
    pub fn in_map(&self, t: Nanos, odom_from_body: &Pose) -> Pose {
        let after = self.list.partition_point(|(_, at, _)| *at <= t);
        let [a, b] = match (after.checked_sub(1).map(|i| &self.list[i]), self.list.get(after)) {
            (Some(a), Some(b)) if a.0 == b.0 => [a, b],
            (Some(a), _) => [a, a],
            (None, Some(b)) => [b, b],
            (None, None) => return *odom_from_body,
        };
        let share = if b.1 > a.1 { (t - a.1).secs() / (b.1 - a.1).secs() } else { 0.0 };
        // Each takes the pose somewhere: between these places, not between the frames, whose origin may be far.
        let [x, y] = [a, b].map(|c| c.2.pose() * *odom_from_body);
        x.interpolate(&y, share)
    }
}

/// The loop closure of one rig.
pub struct Loops {
    extractor: Extractor,
    index: PlaceIndex,
    verifier: Verifier,
    judge: Judge,
    pub graph: PoseGraph,
    /// By node of the graph.
    places: Vec<Place>,
    features: Vec<Feature>,
    query: (List<Feature, FEATURES>, List<Ray, FEATURES>),
    rays: List<Ray, FEATURES>,
    /// The newest keyframe's node.
    last: Option<u16>,
    last_closed: Option<Nanos>,
    map_from_odom: Pose4,
    pub stats: Stats,
    /// The first closures.
    pub closures: Vec<Closure>,
    /// What the newest keyframe was recognised as: the other's stamp and the pose measured to it, whether or not the loop was
    /// closed.
    pub recognised: Option<(Nanos, Pose4)>,
}

impl Loops {
    /// Room for so many keyframes. Fails where the tracker cannot take the rig.
    pub fn new(calibration: &Calibration, frontend: &FrontendConfig, keyframes: usize) -> Result<Loops, Fault> {
        let extractor = Extractor::new(calibration, frontend)?;
        let camera = calibration.cameras[0].camera;
        let size = [camera.width, camera.height];
        Ok(Loops {
            verifier: Verifier::new(extractor.bearing_sigma(CORNER_SIGMA_PX), size),
            extractor,
            index: PlaceIndex::new(keyframes),
            judge: Judge::default(),
            graph: PoseGraph::new(keyframes, 2 * keyframes, 8 * keyframes),
            places: vec![Place::default(); keyframes],
            features: vec![Feature::default(); keyframes * FEATURES],
            query: Default::default(),
            rays: List::default(),
            last: None,
            last_closed: None,
            map_from_odom: Pose4::default(),
            stats: Stats::default(),
            closures: Vec::with_capacity(CLOSURES),
            recognised: None,
        })
    }

    /// Bytes of the index, the graph and the features.
    pub fn bytes(&self) -> usize {
        self.index.bytes()
            + self.graph.bytes()
            + self.features.len() * size_of::<Feature>()
            + self.places.len() * size_of::<Place>()
    }

    /// The frame of the estimator in that of the map, now.
    pub fn map_from_odom(&self) -> Pose {
        self.map_from_odom.pose()
    }

    /// Keyframes of the graph with their poses in the map, in no order.
    pub fn places(&self) -> impl Iterator<Item = (&Place, Pose4)> + '_ {
        (0..self.places.len()).filter(|n| self.places[*n].used).map(|n| (&self.places[n], self.graph.pose(n as u16)))
    }

    /// Keyframes that the mapper has, by their numbers, with the poses of their bodies in the map.
    pub fn keyframes_in_map(&self) -> impl Iterator<Item = (u64, Pose)> + '_ {
        let pose = |(place, pose): (&Place, Pose4)| Some((place.id?, pose.pose() * Pose::new(place.tilt, DVec3::ZERO)));
        self.places().filter_map(pose)
    }

    /// What puts poses of the estimator in the map, at each keyframe of the graph, the oldest first. Allocates.
    pub fn corrections(&self) -> Corrections {
        let correction = |(place, pose): (&Place, Pose4)| (place.epoch, place.t, pose.compose(&place.odom.inverse()));
        let mut list: Vec<_> =
            if self.stats.loops_closed > 0 { self.places().map(correction).collect() } else { vec![] };
        list.sort_by_key(|(_, t, _)| *t);
        Corrections { list }
    }

    /// Takes a keyframe, and looks for a loop that it closes.
    pub fn add(&mut self, keyframe: &LoopKeyframe) -> Option<Closure> {
        let (odom, tilt) = Pose4::upright(&keyframe.odom_from_body);
        if !odom.is_finite() {
            return None;
        }
        let up = keyframe.odom_from_body.q.inverse() * DVec3::Z;
        let (features, rays) = &mut self.query;
        self.extractor.extract(keyframe.frames, up, keyframe.body_from_cam.as_ref(), features);
        let camera = self.extractor.rays(features, tilt, rays);
        let node = self.add_node(keyframe, odom)?;
        let place = Place {
            t: keyframe.t,
            id: keyframe.id,
            epoch: keyframe.epoch,
            odom,
            tilt,
            features: self.query.0.len() as u16,
            used: true,
        };
        self.places[node as usize] = place;
        let verified = self.verify(node, camera);
        let closure = self.decide(node, &verified);
        let start = node as usize * FEATURES;
        self.features[start..][..self.query.0.len()].copy_from_slice(&self.query.0);
        self.index.insert(node, self.query.0.iter().map(|f| &f.descriptor));
        self.last = Some(node);
        closure
    }

    /// A node for a keyframe, linked to the one before by odometry.
    fn add_node(&mut self, keyframe: &LoopKeyframe, odom: Pose4) -> Option<u16> {
        let last = self.last.filter(|n| self.places[*n as usize].epoch == keyframe.epoch);
        // The newest estimate of the one before, so that the two are of one window.
        let before = last.map(|n| {
            let place = &self.places[n as usize];
            let newest = keyframe.before.filter(|(t, _)| *t == place.t).map(|(_, pose)| Pose4::upright(&pose).0);
            newest.unwrap_or(place.odom)
        });
        let moved = before.map(|b| b.between(&odom));
        let pose = match (last, &moved) {
            (Some(n), Some(moved)) => self.graph.pose(n).compose(moved),
            _ => self.map_from_odom.compose(&odom),
        };
        let node = self.graph.add(pose).or_else(|| {
            self.drop_one();
            self.graph.add(pose)
        })?;
        if let (Some(n), Some(measured)) = (last, moved) {
            let secs = (keyframe.t - self.places[n as usize].t).secs();
            let covariance = accept::odometry_covariance(&measured, secs);
            self.graph.link(Edge { from: n, to: node, measured, covariance, is_loop: false });
        }
        Some(node)
    }

    /// Takes the keyframe out of the graph whose neighbours in time are the nearest to each other.
    fn drop_one(&mut self) {
        let nearest = self.graph.closest_neighbours(|n| Some(n) != self.last);
        let Some(node) = nearest else { return };
        let place = &mut self.places[node as usize];
        let start = node as usize * FEATURES;
        let features = &self.features[start..][..place.features as usize];
        self.index.remove(node, features.iter().map(|f| &f.descriptor));
        place.used = false;
        self.graph.drop_node(node);
        self.stats.loop_keyframes_dropped += 1;
    }

    /// Verifies the candidates of a keyframe whose features are in `query`.
    fn verify(&mut self, node: u16, camera: DVec3) -> List<Verification, { BY_LOOKS + BY_PLACE }> {
        let t = self.places[node as usize].t;
        let places = &self.places;
        let old = |n: u16| places[n as usize].used && (t - places[n as usize].t).secs() > OLD_S;
        let mut candidates = [Candidate::default(); BY_LOOKS + BY_PLACE];
        let descriptors = self.query.0.iter().map(|f| &f.descriptor);
        let mut count = self.index.query(descriptors, old, &mut candidates[..BY_LOOKS]);
        let here = self.graph.pose(node);
        for _ in 0..BY_PLACE {
            let listed = |n: u16| candidates[..count].iter().any(|c| c.place == n);
            let near = (0..places.len() as u16).filter(|n| old(*n) && !listed(*n)).filter_map(|n| {
                let there = self.graph.pose(n);
                let far = (there.p - here.p).length();
                let turned = pose4::wrapped(there.yaw - here.yaw).abs();
                (far < NEAR_M && turned < NEAR_RAD).then_some((far, n))
            });
            let Some((_, place)) = near.min_by(|a, b| a.0.total_cmp(&b.0)) else { break };
            candidates[count] = Candidate { place, votes: 0.0 };
            count += 1;
        }
        let mut list = List::default();
        let (features, rays) = &self.query;
        let query = Seen { features, rays, camera };
        for candidate in &candidates[..count] {
            let place = &self.places[candidate.place as usize];
            let start = candidate.place as usize * FEATURES;
            let features = &self.features[start..][..place.features as usize];
            let camera = self.extractor.rays(features, place.tilt, &mut self.rays);
            let seen = Seen { features, rays: &self.rays, camera };
            if let Some(verified) = self.verifier.verify(&query, &seen) {
                let _ = list.push(Verification { node: candidate.place, verified });
            }
        }
        self.stats.loop_queries += u64::from(count > 0);
        list
    }

    /// Closes the loop that the verifications speak for, or counts why not.
    fn decide(&mut self, node: u16, verified: &[Verification]) -> Option<Closure> {
        let t = self.places[node as usize].t;
        let odom = self.places[node as usize].odom;
        let verdict = self.judge.judge(node, t, &odom, verified, &mut self.graph);
        let count = match &verdict {
            Verdict::Accepted(_) => &mut self.stats.loops_recognised,
            Verdict::None => &mut self.stats.loops_none,
            Verdict::Weak => &mut self.stats.loops_weak,
            Verdict::Alone => &mut self.stats.loops_alone,
            Verdict::Ambiguous => &mut self.stats.loops_ambiguous,
            Verdict::Implausible => &mut self.stats.loops_implausible,
        };
        *count += 1;
        self.recognised = None;
        let Verdict::Accepted(best) = verdict else { return None };
        let with = self.places[best.node as usize].t;
        self.recognised = Some((with, best.verified.candidate_from_query));
        if self.last_closed.is_some_and(|last| (t - last).secs() < REST_S) {
            return None;
        }
        let v = &best.verified;
        let edge = Edge {
            from: best.node,
            to: node,
            measured: v.candidate_from_query,
            covariance: v.covariance,
            is_loop: true,
        };
        let before = self.map_from_odom;
        let outcome = self.graph.link(edge).map(|()| self.graph.optimise()).filter(|outcome| outcome.solved);
        let Some(outcome) = outcome else {
            self.stats.loops_unsolved += 1;
            return None;
        };
        self.stats.loops_rejected = outcome.loops_rejected as u64;
        self.last_closed = Some(t);
        self.stats.loops_closed += 1;
        self.map_from_odom = self.graph.pose(node).compose(&odom.inverse());
        let (was, now) = (before.compose(&odom), self.map_from_odom.compose(&odom));
        let moved = [(now.p - was.p).length(), pose4::wrapped(now.yaw - was.yaw).abs()];
        let closure = Closure { t, with, inliers: v.inliers, measured: v.candidate_from_query, moved };
        if self.closures.len() < CLOSURES {
            self.closures.push(closure);
        }
        Some(closure)
    }
}
