//! Frames: what is known of epochs that began in maps of their own, kept from flight to flight, until a recognised place
//! makes one map of two.

use super::accept::{odometry_covariance, Verification};
use super::features::{Feature, FEATURES};
use super::graph::Edge;
use super::kept::{Keeper, KeptPlace};
use super::{Loops, Place};
use nalgebra::Matrix4;
use stipple_drivers::Nanos;

/// Poses of kept places are written again after so long, s.
const POSES_KEPT_S: f64 = 10.0;

impl Loops {
    /// Takes the places of earlier flights, and where those of this one are kept, if they are. Called before the first keyframe;
    /// `flight` is when this one began, ms since 1970.
    pub fn remember(&mut self, flight: i64, kept: &[(KeptPlace, Vec<Feature>)], keeper: Option<Keeper>) {
        (self.flight, self.keeper) = (flight, keeper);
        let mut last: Option<(u16, u32)> = None;
        for (k, features) in kept {
            self.next_number = self.next_number.max(k.number + 1);
            self.next_frame = self.next_frame.max(k.frame + 1);
            let Some(node) = self.graph.add_fixed(k.map).or_else(|| {
                self.drop_one(last.map(|(n, _)| n));
                self.graph.add_fixed(k.map)
            }) else {
                continue;
            };
            if let Some((before, _)) = last.filter(|(_, frame)| *frame == k.frame) {
                let measured = self.graph.pose(before).between(&k.map);
                let covariance = odometry_covariance(&measured, 0.0);
                self.graph.link(Edge { from: before, to: node, measured, covariance, is_loop: false });
            }
            last = Some((node, k.frame));
            let count = features.len().min(FEATURES);
            self.places[node as usize] = Place {
                t: k.t,
                id: None,
                epoch: k.epoch,
                odom: k.odom,
                tilt: k.tilt,
                frame: k.frame,
                number: k.number,
                features: count as u16,
                used: true,
            };
            self.features[node as usize * FEATURES..][..count].copy_from_slice(&features[..count]);
            self.index.insert(node, features[..count].iter().map(|f| &f.descriptor));
            self.stats.places_read += 1;
        }
        self.frame = self.next_frame;
        self.next_frame += 1;
    }

    /// Whether there are places in another frame than the one that the vehicle is in.
    pub fn is_lost(&self) -> bool {
        self.places.iter().any(|p| p.used && p.frame != self.frame)
    }

    /// Whether the vehicle is in the map of an earlier flight.
    pub fn is_in_earlier_map(&self) -> bool {
        self.has_kept(self.frame)
    }

    /// Writes where places are by now, if they have moved.
    pub fn keep_poses(&mut self) {
        let places = self.places.iter().enumerate().filter(|(_, p)| p.used);
        let poses = places.map(|(n, p)| (p.number, p.frame, self.graph.pose(n as u16)));
        if let Some(keeper) = self.keeper.as_mut().filter(|_| self.poses_moved) {
            self.poses_moved = !keeper.put_poses(poses);
        }
    }

    /// Writes a place to the disk.
    pub(super) fn keep(&mut self, node: u16) {
        let Place { t, epoch, odom, tilt, frame, number, features, .. } = self.places[node as usize];
        let place = KeptPlace { number, t, epoch, frame, odom, map: self.graph.pose(node), tilt };
        let features = &self.features[node as usize * FEATURES..][..features as usize];
        if let Some(keeper) = &mut self.keeper {
            self.stats.places_unkept += u64::from(!keeper.put(&place, features));
        }
    }

    /// Does so once in `POSES_KEPT_S`.
    pub(super) fn keep_poses_in_time(&mut self, t: Nanos) {
        if (t - self.poses_kept).secs().abs() >= POSES_KEPT_S {
            self.poses_kept = t;
            self.keep_poses();
        }
    }

    /// Takes a loop into the graph; false, and counted, where that cannot be. Where it leads to another frame, makes one of both.
    /// Takes in the others of `beside` that agree with it: depths of one keyframe err together.
    pub(super) fn link(&mut self, edge: &Edge, beside: &[Verification]) -> bool {
        let [a, b] = [edge.from, edge.to].map(|n| self.places[n as usize].frame);
        let joins = a != b;
        let [a_kept, b_kept] = [a, b].map(|frame| self.has_kept(frame));
        if joins && a_kept && b_kept {
            self.stats.epochs_refused += 1;
            return false;
        }
        if self.graph.link(*edge).is_none() {
            self.stats.loops_unsolved += 1;
            return false;
        }
        if joins {
            // The older one stays where it is, and that of an earlier flight.
            let stays = if a_kept || (a < b && !b_kept) { a } else { b };
            let moves = if stays == a { b } else { a };
            let there = self.graph.pose(edge.from).compose(&edge.measured);
            let mut by = there.compose(&self.graph.pose(edge.to).inverse());
            by = if stays == a { by } else { by.inverse() };
            self.graph.carry(&by, |n| self.places[n as usize].frame == moves);
            self.places.iter_mut().filter(|p| p.frame == moves).for_each(|p| p.frame = stays);
            self.frame = if self.frame == moves { stays } else { self.frame };
            self.stats.epochs_joined += 1;
        }
        let frame = self.places[edge.to as usize].frame;
        let others = beside.iter().filter(|v| v.node != edge.from && self.places[v.node as usize].frame == frame);
        // Of an edge that made one frame of two, the frame stays.
        let mut may_go = usize::from(!joins);
        for v in others {
            if v.agrees_with(edge.to, &self.graph) {
                may_go += usize::from(self.graph.link(v.edge(edge.to)).is_some());
            }
        }
        let outcome = self.graph.optimise();
        self.poses_moved = true;
        if !outcome.solved {
            self.stats.loops_unsolved += 1;
            (0..may_go).for_each(|_| self.graph.drop_newest_loop());
            return joins;
        }
        self.stats.loops_rejected = outcome.loops_rejected as u64;
        true
    }

    /// Whether places of an earlier flight are in a frame.
    fn has_kept(&self, frame: u32) -> bool {
        let mut places = self.places.iter().enumerate();
        places.any(|(n, place)| place.used && place.frame == frame && self.graph.is_fixed(n as u16))
    }

    /// Covariance of a node's pose in its map; that of nothing where it is not known.
    pub(super) fn covariance_in_map(&mut self, node: u16) -> [[f64; 4]; 4] {
        let frame = self.places[node as usize].frame;
        let same = |n: &usize| self.places[*n].used && self.places[*n].frame == frame;
        let origin = (0..self.places.len()).filter(same).min_by_key(|n| {
            let place = &self.places[*n];
            (!self.graph.is_fixed(*n as u16), place.epoch.flight, place.t)
        });
        let found = origin.and_then(|n| Some((n, self.graph.covariance_between(n as u16, node)?)));
        let Some((origin, covariance)) = found else { return [[0.0; 4]; 4] };
        let (sin, cos) = self.graph.pose(origin as u16).yaw.sin_cos();
        let mut turn = Matrix4::identity();
        (turn[(0, 0)], turn[(0, 1)], turn[(1, 0)], turn[(1, 1)]) = (cos, -sin, sin, cos);
        let c = turn * covariance * turn.transpose();
        std::array::from_fn(|i| std::array::from_fn(|k| c[(i, k)]))
    }
}
