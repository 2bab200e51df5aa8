//! Loop closure: recognises places, and corrects the drift of odometry by them, in memory that is taken once.
//!
//! ```text
//! keyframe -> features -> index -> candidates -> verification -> acceptance -> pose graph -> map_from_odom, corrections
//!                 `-> places on disk                               `-> refused, counted by reason
//! ```
//!
//! A closure that is false is the worst fault there is: so two verifications have to agree, no other place may look the same
//! that the drift allows, and the correction has to be one that odometry can have made since (3 deviations).
//!
//! Frames: `odom` is that of the estimator, which drifts and never jumps inside an epoch; `map` is the one in which loops
//! agree. Whoever needs a pose in `map` composes it with `Loops::map_from_odom`. Each epoch of the estimator, in this flight or
//! an earlier one, begins in a map of its own, of which nothing is known in another: its frame. Where a place of another frame
//! is recognised, the two become one: that of this flight moves, and places of earlier flights never do.

pub mod accept;
pub mod features;
mod frames;
pub mod graph;
pub mod index;
pub mod kept;
pub mod pose4;
pub mod verify;

use crate::config::FrontendConfig;
use crate::limits::{CAMERAS_MAX, FRAMES};
use crate::mem::List;
use accept::{Asker, Judge, Verdict, Verification};
use features::{Extractor, Feature, Ray, FEATURES};
use glam::{DQuat, DVec3};
use graph::{Edge, PoseGraph};
use index::{Candidate, PlaceIndex};
use kept::{Epoch, Keeper};
use nalgebra::{Matrix4, Vector4};
use pose4::Pose4;
use std::sync::Arc;
use stipple_drivers::{counters, Calibration, Fault, Frames, Nanos, Pose};
use verify::{Seen, Verifier, CORNER_SIGMA_PX};

/// Candidates that are verified for a keyframe: by looks, and by where they are.
const BY_LOOKS: usize = 8;
const BY_PLACE: usize = 3;
/// A keyframe closes no loop with one younger than this, s.
const OLD_S: f64 = 20.0;
/// Least time between two loops that are closed, s.
const REST_S: f64 = 1.0;
/// For so long after two map frames were joined, s, every recognised place closes a loop: loops alone hold the two together.
const FRESH_S: f64 = 10.0;
/// Candidates by looks where the vehicle may be anywhere. Of those that are nearer to each other than this, m, two are verified, so
/// that a place that looks the same is among them.
const ANYWHERE: usize = 32;
const APART_M: f64 = 2.0;
/// Deviations of the map of an earlier flight, whose places stay where they are: m, rad.
const KEPT_SIGMA: [f64; 2] = [0.05, 0.005];
/// Candidates by place are nearer than this, m, and look within this angle of the same direction, rad.
const NEAR_M: f64 = 3.0;
const NEAR_RAD: f64 = 0.8;
/// A tilt that one keyframe corrects by more than this is written to the disk again, rad: a third of what a verification allows.
const TILT_KEPT: f64 = 0.001;
/// Number of keyframes of which a full graph drops one, many at a time: after a drop the next loop has to factor and search the
/// whole graph.
const ONE_DROPPED_OF: usize = 16;

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
    /// Times that an epoch was found in the map of another, and that two maps of earlier flights were to be joined, which stay
    /// where they are.
    epochs_joined,
    epochs_refused,
    /// Places of earlier flights that were read, and places that the disk did not take.
    places_read,
    places_unkept,
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
    /// Newest estimates of the keyframes in the estimator's window, by stamp, the oldest first.
    pub window: &'a [(Nanos, Pose)],
    pub body_from_cam: Option<[Pose; CAMERAS_MAX]>,
}

/// What is kept of a keyframe.
#[derive(Clone, Copy, Default)]
pub struct Place {
    pub t: Nanos,
    pub id: Option<u64>,
    pub epoch: Epoch,
    /// Pose of the upright frame in `odom` by the first estimate, which is the one that the run published.
    pub odom: Pose4,
    /// Rotation of the body in its upright frame, by the newest estimate.
    pub tilt: DQuat,
    /// Number of its map frame. Poses of places with the same number can be compared.
    frame: u32,
    /// Its key on the disk.
    number: u32,
    features: u16,
    used: bool,
}

/// A loop that was closed.
#[derive(Clone, Copy, Debug)]
pub struct Closure {
    pub t: Nanos,
    /// Stamp of the keyframe that was recognised, and whether it is of an earlier flight and by the clock of that.
    pub with: Nanos,
    pub earlier: bool,
    /// Corners that agree.
    pub inliers: usize,
    /// Pose of this keyframe's level frame in that of the one that was recognised.
    pub measured: Pose4,
    /// By how much `map_from_odom` changed for this keyframe: m, rad.
    pub moved: [f64; 2],
    /// The epoch of the place, where it was in another frame than this keyframe until now.
    pub joins: Option<Epoch>,
}

/// Where `odom` is in the map.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MapFromOdom {
    /// Stamp of the keyframe that it was found by.
    pub t: Nanos,
    /// How often it has changed in this flight.
    pub count: u32,
    /// Epoch of `odom`.
    pub epoch: u32,
    pub pose: Pose4,
    /// Covariance of the vehicle's position, m², and yaw, rad², in the map at that stamp.
    pub covariance: [[f64; 4]; 4],
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

/// Upright pose and tilt of a place by the newest estimate of its keyframe; `None` where the estimator's window no longer holds
/// it. Yaw is the turn about z since the tilt that the place has: `Pose4::upright` of the new pose alone would take a corrected
/// roll for yaw where the body's x points up.
fn newest_estimate(window: &[(Nanos, Pose)], place: &Place) -> Option<(Pose4, DQuat)> {
    let (_, pose) = window.iter().find(|(at, _)| *at == place.t)?;
    let (upright, more) = Pose4::upright(&Pose::new(pose.q * place.tilt.inverse(), pose.p));
    Some((upright, more * place.tilt))
}

/// The motion of the body from a place to a keyframe, by the newest estimate of both.
fn motion_since(place: &Place, keyframe: &LoopKeyframe) -> Pose {
    let (upright, tilt) = newest_estimate(keyframe.window, place).unwrap_or((place.odom, place.tilt));
    (upright.pose() * Pose::new(tilt, DVec3::ZERO)).inverse() * keyframe.odom_from_body
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
    last_joined: Option<Nanos>,
    map_from_odom: MapFromOdom,
    /// The frame of the epoch that the estimator is in, and the next one.
    frame: u32,
    next_frame: u32,
    flight: i64,
    next_number: u32,
    keeper: Option<Keeper>,
    /// Places have moved since their poses were written, and when that was.
    poses_moved: bool,
    poses_kept: Nanos,
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
            last_joined: None,
            map_from_odom: MapFromOdom::default(),
            frame: 0,
            next_frame: 1,
            flight: 0,
            next_number: 0,
            keeper: None,
            poses_moved: false,
            poses_kept: Nanos(0),
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
    pub fn map_from_odom(&self) -> MapFromOdom {
        self.map_from_odom
    }

    /// When this flight began, ms since 1970.
    pub fn flight(&self) -> i64 {
        self.flight
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
        let correction =
            |(place, pose): (&Place, Pose4)| (place.epoch.number, place.t, pose.compose(&place.odom.inverse()));
        let of_this_flight = self.places().filter(|(place, _)| place.epoch.flight == self.flight);
        let mut list: Vec<_> =
            if self.stats.loops_closed > 0 { of_this_flight.map(correction).collect() } else { vec![] };
        list.sort_by_key(|(_, t, _)| *t);
        Corrections { list }
    }

    /// Takes a keyframe, and looks for a loop that it closes.
    pub fn add(&mut self, keyframe: &LoopKeyframe) -> Option<Closure> {
        let camera = self.extract(keyframe)?;
        self.close(keyframe, camera)
    }

    /// Finds the features of a keyframe, and camera 0 in its level frame, m; `None` where its pose is not finite.
    pub fn extract(&mut self, keyframe: &LoopKeyframe) -> Option<DVec3> {
        let (odom, tilt) = Pose4::upright(&keyframe.odom_from_body);
        if !odom.is_finite() {
            return None;
        }
        let up = keyframe.odom_from_body.q.inverse() * DVec3::Z;
        let epoch = Epoch { flight: self.flight, number: keyframe.epoch };
        let before = self.last.map(|n| self.places[n as usize]);
        let before_from_now =
            before.filter(|p| p.epoch == epoch).map(|place| (place.t, motion_since(&place, keyframe)));
        let (features, rays) = &mut self.query;
        self.extractor.extract(keyframe.frames, up, keyframe.body_from_cam.as_ref(), before_from_now, features);
        Some(self.extractor.rays(features, tilt, rays))
    }

    /// Adds the keyframe whose features `extract` found last, with what it answered, m, and looks for a loop that it closes.
    pub fn close(&mut self, keyframe: &LoopKeyframe, camera: DVec3) -> Option<Closure> {
        let (odom, tilt) = Pose4::upright(&keyframe.odom_from_body);
        let epoch = Epoch { flight: self.flight, number: keyframe.epoch };
        let before = self.last.map(|n| self.places[n as usize]);
        if before.is_some_and(|before| before.epoch != epoch) {
            (self.frame, self.next_frame) = (self.next_frame, self.next_frame + 1);
            (self.last, self.map_from_odom.epoch) = (None, keyframe.epoch);
        }
        self.measure_again(keyframe.window);
        let node = self.add_node(keyframe, odom)?;
        self.places[node as usize] = Place {
            t: keyframe.t,
            id: keyframe.id,
            epoch,
            odom,
            tilt,
            frame: self.frame,
            number: self.next_number,
            features: self.query.0.len() as u16,
            used: true,
        };
        self.next_number += 1;
        let verified = self.verify(node, camera);
        let closure = self.decide(node, &verified);
        let start = node as usize * FEATURES;
        self.features[start..][..self.query.0.len()].copy_from_slice(&self.query.0);
        self.index.insert(node, self.query.0.iter().map(|f| &f.descriptor));
        self.last = Some(node);
        self.keep(node);
        self.keep_poses_in_time(keyframe.t);
        closure
    }

    /// A node for a keyframe, linked to the one before by odometry.
    fn add_node(&mut self, keyframe: &LoopKeyframe, odom: Pose4) -> Option<u16> {
        let last = self.last;
        // The newest estimate of the one before, so that the two are of one window.
        let before = last.map(|n| {
            let place = &self.places[n as usize];
            newest_estimate(keyframe.window, place).map_or(place.odom, |(odom, _)| odom)
        });
        let moved = before.map(|b| b.between(&odom));
        let pose = match (last, &moved) {
            (Some(n), Some(moved)) => self.graph.pose(n).compose(moved),
            _ => self.map_from_odom.pose.compose(&odom),
        };
        let node = self.graph.add(pose).or_else(|| {
            (0..self.places.len().div_ceil(ONE_DROPPED_OF)).for_each(|_| self.drop_one(last));
            self.graph.add(pose)
        })?;
        if let (Some(n), Some(measured)) = (last, moved) {
            let secs = (keyframe.t - self.places[n as usize].t).secs();
            let covariance = accept::odometry_covariance(&measured, secs);
            self.graph.link(Edge { from: n, to: node, measured, covariance, is_loop: false });
        }
        Some(node)
    }

    /// Measures the odometry between the newest keyframes again, from what the estimator's window says of them by now: it has
    /// seen what came after them.
    fn measure_again(&mut self, window: &[(Nanos, Pose)]) {
        let mut nodes: List<(u16, Pose4, DQuat), FRAMES> = List::default();
        let mut at = self.last;
        while let Some(node) = at {
            let Some((upright, tilt)) = newest_estimate(window, &self.places[node as usize]) else { break };
            if nodes.push((node, upright, tilt)).is_err() {
                break;
            }
            at = self.graph.before(node);
        }
        let mut moved: List<(u16, Pose4), FRAMES> = List::default();
        for pair in nodes.windows(2).rev() {
            let [(to, newer, _), (_, older, _)] = [pair[0], pair[1]];
            let _ = moved.push((to, older.between(&newer)));
        }
        self.graph.measure_again(&moved);
        self.poses_moved |= !moved.is_empty();
        for (node, _, tilt) in nodes.iter() {
            let was = std::mem::replace(&mut self.places[*node as usize].tilt, *tilt);
            // A later flight would verify places with a tilt from before the estimator had converged.
            if tilt.angle_between(was) > TILT_KEPT {
                self.keep(*node);
            }
        }
    }

    /// Takes the keyframe out of the graph whose neighbours in time are the nearest to each other; not `last`.
    fn drop_one(&mut self, last: Option<u16>) {
        let nearest = self.graph.closest_neighbours(|n| Some(n) != last);
        let Some(node) = nearest else { return };
        let place = &mut self.places[node as usize];
        let start = node as usize * FEATURES;
        let features = &self.features[start..][..place.features as usize];
        self.index.remove(node, features.iter().map(|f| &f.descriptor));
        place.used = false;
        let number = place.number;
        self.keeper.iter_mut().for_each(|keeper| keeper.remove(number));
        self.graph.drop_node(node);
        self.stats.loop_keyframes_dropped += 1;
    }

    /// Verifies the candidates of a keyframe whose features are in `query`.
    fn verify(&mut self, node: u16, camera: DVec3) -> List<Verification, { BY_LOOKS + BY_PLACE }> {
        let candidates = self.candidates(node);
        let mut list = List::default();
        let (features, rays) = &self.query;
        let query = Seen { features, rays, camera };
        for candidate in candidates.iter() {
            let place = &self.places[*candidate as usize];
            let start = *candidate as usize * FEATURES;
            let features = &self.features[start..][..place.features as usize];
            let camera = self.extractor.rays(features, place.tilt, &mut self.rays);
            let seen = Seen { features, rays: &self.rays, camera };
            if let Some(mut verified) = self.verifier.verify(&query, &seen) {
                if self.graph.is_fixed(*candidate) {
                    let [p, yaw] = KEPT_SIGMA.map(|s| s * s);
                    verified.covariance += Matrix4::from_diagonal(&Vector4::new(p, p, p, yaw));
                }
                let _ = list.push(Verification { node: *candidate, verified });
            }
        }
        self.stats.loop_queries += u64::from(!candidates.is_empty());
        list
    }

    /// Places that a keyframe may be at: those that look most like it, and those that are near.
    fn candidates(&mut self, node: u16) -> List<u16, { BY_LOOKS + BY_PLACE }> {
        let places = &self.places;
        let own = places[node as usize];
        let is_old = |n: u16| {
            let p = &places[n as usize];
            p.used && (p.epoch.flight != own.epoch.flight || p.frame != own.frame || (own.t - p.t).secs() > OLD_S)
        };
        let mut by_looks = [Candidate::default(); ANYWHERE];
        let anywhere = self.is_lost();
        let descriptors = self.query.0.iter().map(|f| &f.descriptor);
        let most = if anywhere { ANYWHERE } else { BY_LOOKS };
        let count = self.index.query(descriptors, is_old, &mut by_looks[..most]);
        let (mut list, graph) = (List::default(), &self.graph);
        for c in &by_looks[..count] {
            let there = graph.pose(c.place).p;
            let beside = |n: &&u16| {
                let same = places[**n as usize].frame == places[c.place as usize].frame;
                same && (graph.pose(**n).p - there).length() < APART_M
            };
            if list.len() < BY_LOOKS && (!anywhere || list.iter().filter(beside).count() < 2) {
                let _ = list.push(c.place);
            }
        }
        let here = graph.pose(node);
        for _ in 0..BY_PLACE {
            let may = |n: &u16| is_old(*n) && places[*n as usize].frame == own.frame && !list.contains(n);
            let near = (0..places.len() as u16).filter(may).filter_map(|n| {
                let there = graph.pose(n);
                let far = (there.p - here.p).length();
                let turned = pose4::wrapped(there.yaw - here.yaw).abs();
                (far < NEAR_M && turned < NEAR_RAD).then_some((far, n))
            });
            let Some((_, place)) = near.min_by(|a, b| a.0.total_cmp(&b.0)) else { break };
            let _ = list.push(place);
        }
        list
    }

    /// Closes the loop that the verifications speak for, or counts why not.
    fn decide(&mut self, node: u16, verified: &[Verification]) -> Option<Closure> {
        let Place { t, epoch, odom, frame, .. } = self.places[node as usize];
        let asker = Asker { node, t, epoch: epoch.number, odom, frame };
        let places = &self.places;
        let verdict = self.judge.judge(&asker, verified, |n| places[n as usize].frame, &mut self.graph);
        let count = match &verdict {
            Verdict::Accepted(_) | Verdict::Joins(_) => &mut self.stats.loops_recognised,
            Verdict::None => &mut self.stats.loops_none,
            Verdict::Weak => &mut self.stats.loops_weak,
            Verdict::Alone => &mut self.stats.loops_alone,
            Verdict::Ambiguous => &mut self.stats.loops_ambiguous,
            Verdict::Implausible => &mut self.stats.loops_implausible,
        };
        *count += 1;
        self.recognised = None;
        let (best, joins) = match verdict {
            Verdict::Accepted(best) => (best, None),
            Verdict::Joins(best) => (best, Some(self.places[best.node as usize].epoch)),
            _ => return None,
        };
        let Place { t: with, epoch: seen_in, .. } = self.places[best.node as usize];
        let earlier = seen_in.flight != self.flight;
        self.recognised = Some((with, best.verified.candidate_from_query));
        let since = |last: Option<Nanos>| last.map_or(f64::INFINITY, |last| (t - last).secs());
        let fresh = joins.is_some() || since(self.last_joined) <= FRESH_S;
        if !fresh && since(self.last_closed) < REST_S {
            return None;
        }
        let was = self.map_from_odom.pose.compose(&odom);
        if !self.link(&best.edge(node), if fresh { verified } else { &[] }) {
            return None;
        }
        let v = &best.verified;
        self.last_closed = Some(t);
        self.last_joined = joins.map_or(self.last_joined, |_| Some(t));
        self.stats.loops_closed += 1;
        let now = self.graph.pose(node);
        let covariance = self.covariance_in_map(node);
        let (count, epoch) = (self.map_from_odom.count + 1, epoch.number);
        self.map_from_odom = MapFromOdom { t, count, epoch, pose: now.compose(&odom.inverse()), covariance };
        let moved = [(now.p - was.p).length(), pose4::wrapped(now.yaw - was.yaw).abs()];
        let measured = v.candidate_from_query;
        let closure = Closure { t, with, earlier, inliers: v.inliers, measured, moved, joins };
        if self.closures.len() < CLOSURES {
            self.closures.push(closure);
        }
        Some(closure)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use stipple_drivers::{Camera, Image, ImuCalibration, Lens, RigCamera};

    /// A body whose x points up, as that of EuRoC's rig: a roll that is corrected by 3 degrees is no yaw.
    #[test]
    fn a_corrected_tilt_turns_no_place_about_the_vertical() {
        let (t, p) = (Nanos(5), DVec3::new(1.0, 2.0, 3.0));
        let first = Pose::new(DQuat::from_rotation_z(0.4) * DQuat::from_rotation_y(-1.5), p);
        let (odom, tilt) = Pose4::upright(&first);
        let place = Place { t, odom, tilt, used: true, ..Place::default() };
        for axis in [DVec3::X, DVec3::Y, DVec3::new(0.6, -0.8, 0.0)] {
            let second = Pose::new(DQuat::from_axis_angle(axis, 0.05) * first.q, p);
            let (now, tilt) =
                newest_estimate(&[(Nanos(4), first), (t, second)], &place).expect("a place in the window");
            assert!((now.yaw - odom.yaw).abs() < 1e-3 && now.p == p, "{axis}: {now:?}, {odom:?}");
            assert!(((now.pose().q * tilt).dot(second.q).abs() - 1.0).abs() < 1e-12, "{axis}");
        }
        assert!(newest_estimate(&[(Nanos(4), first)], &place).is_none());
        let moved = Pose::new(DQuat::from_rotation_x(0.3), DVec3::new(0.1, 0.2, 0.4));
        let newest = Pose::new(DQuat::from_rotation_x(0.02) * first.q, p + DVec3::X);
        for (window, at) in [(&[(t, newest)][..], newest), (&[], first)] {
            let (frames, id, body_from_cam) = (&Arc::new(Frames::default()), None, None);
            let keyframe = LoopKeyframe { t, frames, id, epoch: 0, odom_from_body: at * moved, window, body_from_cam };
            let off = motion_since(&place, &keyframe).inverse() * moved;
            assert!(off.p.length() < 1e-9 && off.q.xyz().length() < 1e-9, "{off:?}");
        }
    }

    #[test]
    fn a_full_graph_drops_a_sixteenth_of_its_keyframes_where_they_are_closest_together() {
        const SIZE: usize = 128;
        let lens = Lens::Radtan { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0 };
        let camera = Camera { width: SIZE, height: SIZE, fx: 100.0, fy: 100.0, cx: 63.5, cy: 63.5, lens };
        let places = [0.0, 0.1].map(|x| Pose::new(DQuat::IDENTITY, DVec3::new(x, 0.0, 0.0)));
        let cameras = places.map(|place| RigCamera::new(camera, place)).to_vec();
        let rig = Calibration { cameras, imu: ImuCalibration::CONSUMER };
        let mut loops = Loops::new(&rig, &FrontendConfig::default(), 64).expect("a rig");
        let frames = Arc::new(Frames { t: Nanos(0), images: vec![Image::new(SIZE, SIZE); 2], colours: vec![] });
        // A metre apart up to the fortieth, a centimetre after it.
        let x = |k: i64| k.min(39) as f64 + 0.01 * (k - 39).max(0) as f64;
        for (k, known) in (0..70).zip((1..=64).chain([61, 62, 63, 64, 61, 62])) {
            let (t, odom_from_body) = (Nanos(k), Pose::new(DQuat::IDENTITY, DVec3::new(x(k), 0.0, 0.0)));
            let (frames, id, window, body_from_cam) = (&frames, None, &[][..], None);
            loops.add(&LoopKeyframe { t, frames, id, epoch: 0, odom_from_body, window, body_from_cam });
            assert_eq!(loops.places().count(), known, "after {k}");
            let at = |k: i64| loops.places().find(|(place, _)| place.t == Nanos(k)).map(|(_, pose)| pose.p.x);
            assert!((0..=k)
                .filter(|n| *n < 39 || *n + 1 >= k)
                .all(|n| at(n).is_some_and(|at| (at - x(n)).abs() < 1e-9)));
        }
        assert_eq!(loops.stats.loop_keyframes_dropped, 8);
    }
}
