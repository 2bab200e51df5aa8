//! Pose graph of fixed size: a node for each keyframe, with position and yaw; edges by odometry between keyframes that follow
//! each other, and by recognised places.
//!
//! Least squares by Gauss-Newton, with a Cholesky factorisation of 4x4 blocks in the order of minimum degree. A loop edge
//! may be false: loop edges have the Geman-McClure cost, brought in by graduated non-convexity (Yang et al. 2020), so that
//! those which the others contradict end without weight. Where all new loops say about what the graph says, one step or two from
//! where it is are enough. A node that is dropped leaves its two odometry edges as one. Nodes of
//! earlier flights are fixed: what was found in their map stays where it is.
//!
//! Errors of a node: position in the world, m, and yaw, rad.

mod edge;
mod solver;
#[cfg(test)]
mod tests;

pub use edge::Edge;

use super::pose4::{turned, wrapped, Pose4};
use nalgebra::{Matrix4, Vector4};
use solver::Solver;

/// Squared residual of 4 numbers at which a loop edge counts half: one true loop in a thousand is beyond it.
const LOOP_SCALE: f64 = 18.47;
/// Steps of graduated non-convexity and of Gauss-Newton at most, and the step after which the next would be nothing: m, rad.
const ITERATIONS: usize = 20;
const STEP_MIN: f64 = 1e-3;
/// A new loop whose squared residual is less agrees with the graph as it is.
const AGREES: f64 = 0.5 * LOOP_SCALE;
/// The scale of the cost shrinks by so much a step.
const SHRINK: f64 = 4.0;
/// A loop edge of less weight than this was rejected.
const REJECTED: f64 = 0.1;
const NONE: u32 = u32::MAX;

/// What came of an optimisation.
#[derive(Clone, Copy, Debug, Default)]
pub struct Outcome {
    pub iterations: usize,
    /// Half the sum of squared residuals, each loop's bounded.
    pub cost: f64,
    pub loops_rejected: usize,
    /// False: the factor did not fit, or a matrix was not positive definite; poses are as before.
    pub solved: bool,
    /// Blocks of the factor.
    pub blocks: usize,
}

pub struct PoseGraph {
    poses: Vec<Pose4>,
    used: Vec<bool>,
    /// Nodes that never move: those of earlier flights.
    fixed: Vec<bool>,
    edges: Vec<Edge>,
    /// Weight of each edge: 1 for odometry.
    weights: Vec<f64>,
    /// Inverse of each edge's covariance.
    information: Vec<Matrix4<f64>>,
    /// Edges with numbers under this were there when the graph was optimised last, and nothing was moved since.
    settled: usize,
    /// Odometry edges that lead to each node and from it.
    chain: Vec<[u32; 2]>,
    /// How far the neighbours of each node are from each other: distance, m, plus twice the turn, rad; infinite where odometry
    /// does not lead to both.
    apart: Vec<f64>,
    /// Poses to go back to.
    before: Vec<Pose4>,
    solver: Solver,
}

impl PoseGraph {
    /// Room for so many nodes, edges and blocks of the factor.
    pub fn new(nodes: usize, edges: usize, blocks: usize) -> PoseGraph {
        PoseGraph {
            poses: vec![Pose4::default(); nodes],
            used: vec![false; nodes],
            fixed: vec![false; nodes],
            edges: Vec::with_capacity(edges),
            weights: Vec::with_capacity(edges),
            information: Vec::with_capacity(edges),
            settled: 0,
            chain: vec![[NONE; 2]; nodes],
            apart: vec![f64::INFINITY; nodes],
            before: vec![Pose4::default(); nodes],
            solver: Solver::new(nodes, blocks),
        }
    }

    /// Bytes that it takes.
    pub fn bytes(&self) -> usize {
        let node = 2 * size_of::<Pose4>() + 2 * size_of::<bool>() + size_of::<[u32; 2]>() + size_of::<f64>();
        let edge = size_of::<Edge>() + size_of::<f64>() + size_of::<Matrix4<f64>>();
        size_of::<Self>() + self.poses.len() * node + self.edges.capacity() * edge + self.solver.bytes()
    }

    /// Adds a node; `None` where all are used, or the pose is not finite.
    pub fn add(&mut self, pose: Pose4) -> Option<u16> {
        let free = self.used.iter().position(|used| !used).filter(|_| pose.is_finite())?;
        (self.used[free], self.poses[free], self.chain[free]) = (true, pose, [NONE; 2]);
        self.fixed[free] = false;
        Some(free as u16)
    }

    /// Adds a node that never moves.
    pub fn add_fixed(&mut self, pose: Pose4) -> Option<u16> {
        let node = self.add(pose)?;
        self.fixed[node as usize] = true;
        Some(node)
    }

    pub fn is_fixed(&self, node: u16) -> bool {
        self.fixed[node as usize]
    }

    /// Moves some nodes as one: what lies between them stays.
    pub fn carry(&mut self, by: &Pose4, which: impl Fn(u16) -> bool) {
        for n in (0..self.poses.len()).filter(|n| self.used[*n] && which(*n as u16)) {
            self.poses[n] = by.compose(&self.poses[n]);
        }
        self.settled = 0;
    }

    /// Takes back the newest loop edge.
    pub fn drop_newest_loop(&mut self) {
        if self.edges.last().is_some_and(|edge| edge.is_loop) {
            self.remove_edge(self.edges.len() - 1);
            self.solver.forget();
        }
    }

    /// Adds an edge; `None` where all are used, a node is not there, it has its odometry already, or the edge is no
    /// measurement. Loops leave room for the odometry of all nodes.
    pub fn link(&mut self, edge: Edge) -> Option<()> {
        let [from, to] = [edge.from, edge.to].map(usize::from);
        let there = |n: usize| self.used.get(n) == Some(&true);
        let alike = self.edges.iter().filter(|e| e.is_loop == edge.is_loop).count();
        let odometry = self.poses.len().saturating_sub(1);
        let room = if edge.is_loop { self.edges.capacity().saturating_sub(odometry) } else { odometry };
        if alike >= room || from == to || !there(from) || !there(to) || !edge.is_valid() {
            return None;
        }
        let number = self.edges.len() as u32;
        let information = edge.covariance.cholesky()?.inverse();
        if !edge.is_loop {
            if self.chain[from][1] != NONE || self.chain[to][0] != NONE {
                return None;
            }
            (self.chain[from][1], self.chain[to][0]) = (number, number);
        }
        self.edges.push(edge);
        self.weights.push(1.0);
        self.information.push(information);
        self.measure_apart([from, to]);
        Some(())
    }

    /// The node before one, where odometry leads from there.
    pub fn before(&self, node: u16) -> Option<u16> {
        self.edges.get(self.chain[node as usize][0] as usize).map(|edge| edge.from)
    }

    /// Replaces what odometry measured from the node before each of these, which follow each other in time. Each moves by as
    /// much as its measurement changed, and with the one before it.
    pub fn measure_again(&mut self, measured: &[(u16, Pose4)]) {
        let mut was = None;
        for (node, measured) in measured {
            let (n, number) = (*node as usize, self.chain[*node as usize][0] as usize);
            let Some(edge) = self.edges.get_mut(number) else { continue };
            let from = edge.from as usize;
            let before = was.filter(|(of, _)| *of == from).map_or(self.poses[from], |(_, pose)| pose);
            let changed = edge.measured.inverse().compose(measured);
            was = Some((n, self.poses[n]));
            self.poses[n] = self.poses[from].compose(&before.between(&self.poses[n])).compose(&changed);
            edge.measured = *measured;
            self.measure_apart([from, n]);
        }
        // Loops of nodes that moved may no longer agree.
        let moved = |n: u16| measured.iter().any(|(node, _)| *node == n);
        let loosened = self.edges.iter().position(|e| e.is_loop && (moved(e.from) || moved(e.to)));
        self.settled = loosened.map_or(self.settled, |i| self.settled.min(i));
    }

    pub fn pose(&self, node: u16) -> Pose4 {
        self.poses[node as usize]
    }

    /// Loop edges with their weights: 0 where it was rejected.
    pub fn loops(&self) -> impl Iterator<Item = (&Edge, f64)> + '_ {
        self.edges.iter().zip(&self.weights).filter(|(e, _)| e.is_loop).map(|(e, w)| (e, *w))
    }

    /// Measures how far the neighbours of each of two nodes are from each other.
    fn measure_apart(&mut self, nodes: [usize; 2]) {
        for node in nodes {
            let [before, after] = self.chain[node].map(|e| self.edges.get(e as usize).map(|edge| edge.measured));
            let moved = before.zip(after).map(|(a, b)| a.compose(&b));
            self.apart[node] = moved.map_or(f64::INFINITY, |m| m.p.length() + 2.0 * m.yaw.abs());
        }
    }

    /// The node, of those with odometry to both sides, whose neighbours are the nearest to each other.
    pub fn closest_neighbours(&self, may: impl Fn(u16) -> bool) -> Option<u16> {
        let some = (0..self.poses.len()).filter(|n| self.apart[*n].is_finite() && may(*n as u16));
        some.min_by(|a, b| self.apart[*a].total_cmp(&self.apart[*b])).map(|n| n as u16)
    }

    /// Removes a node. Its odometry becomes one edge between its neighbours; its loops are those of the nearer neighbour.
    pub fn drop_node(&mut self, node: u16) {
        let [to, from] = self.chain[node as usize].map(|e| self.edges.get(e as usize).copied());
        let ways = [to.map(|a| (a.covariance.trace(), a.inverse())), from.map(|b| (b.covariance.trace(), b))];
        let nearer = ways.into_iter().flatten().min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, way)| way);
        for i in (0..self.edges.len()).rev() {
            let edge = self.edges[i];
            if edge.from != node && edge.to != node {
                continue;
            }
            let moved = nearer.filter(|_| edge.is_loop).map(|near| match edge.from == node {
                true => near.inverse().then(&edge),
                false => edge.then(&near),
            });
            match moved.filter(|m| m.from != m.to && m.is_valid()) {
                Some(moved) => {
                    self.information[i] = moved.covariance.cholesky().map_or_else(Matrix4::zeros, |c| c.inverse());
                    self.edges[i] = moved;
                }
                None => self.remove_edge(i),
            }
        }
        self.settled = 0;
        self.used[node as usize] = false;
        self.chain[node as usize] = [NONE; 2];
        if let (Some(a), Some(b)) = (to, from) {
            self.link(a.then(&b));
        }
        self.solver.forget();
    }

    fn remove_edge(&mut self, i: usize) {
        let unhook = |chain: &mut Vec<[u32; 2]>, edge: &Edge, number: u32| {
            if !edge.is_loop {
                (chain[edge.from as usize][1], chain[edge.to as usize][0]) = (number, number);
            }
        };
        let (last, ends) = (self.edges.len() - 1, [self.edges[i].from, self.edges[i].to].map(usize::from));
        unhook(&mut self.chain, &self.edges[i], NONE);
        if i != last {
            unhook(&mut self.chain, &self.edges[last], i as u32);
        }
        self.edges.swap_remove(i);
        self.weights.swap_remove(i);
        self.information.swap_remove(i);
        self.settled = self.settled.min(i);
        self.measure_apart(ends);
    }

    /// Moves the nodes to where all edges agree best.
    pub fn optimise(&mut self) -> Outcome {
        let mut outcome = Outcome::default();
        self.before.copy_from_slice(&self.poses);
        // The first step is that of least squares; then the cost becomes the robust one in steps.
        let mut scale = f64::INFINITY;
        if self.settled > 0 && (self.settled..self.edges.len()).all(|i| self.chi2(i) < AGREES) {
            scale = 1.0;
            self.weigh(scale);
        } else {
            self.weights.iter_mut().for_each(|w| *w = 1.0);
        }
        self.settled = 0;
        let Some(blocks) = self.solver.order(&self.used, &self.fixed, &self.edges) else { return outcome };
        outcome.blocks = blocks;
        for _ in 0..ITERATIONS {
            outcome.iterations += 1;
            self.solver.clear(&self.used, &self.fixed);
            self.add_edges();
            let Some(step) = self.solver.solve() else {
                self.poses.copy_from_slice(&self.before);
                return outcome;
            };
            let mut moved = 0.0f64;
            for (n, d) in step.filter(|(n, _)| !self.fixed[*n]) {
                let pose = &mut self.poses[n];
                pose.p += glam::DVec3::new(d[0], d[1], d[2]);
                pose.yaw = wrapped(pose.yaw + d[3]);
                moved = moved.max(d.amax());
            }
            let worst = self.chi2_of_loops().fold(0.0, f64::max);
            scale = match scale.is_infinite() {
                true => f64::max(1.0, 2.0 * worst / LOOP_SCALE),
                false => f64::max(1.0, scale / SHRINK),
            };
            self.weigh(scale);
            if !moved.is_finite() {
                self.poses.copy_from_slice(&self.before);
                return outcome;
            }
            if scale == 1.0 && moved < STEP_MIN {
                break;
            }
        }
        (outcome.solved, self.settled) = (true, self.edges.len());
        outcome.loops_rejected = self.loops().filter(|(_, w)| *w < REJECTED).count();
        outcome.cost = (0..self.edges.len()).map(|i| self.cost(i)).sum();
        outcome
    }

    /// Puts every edge into the equations.
    fn add_edges(&mut self) {
        for ((edge, weight), information) in self.edges.iter().zip(&self.weights).zip(&self.information) {
            let [a, b] = [edge.from, edge.to].map(|n| &self.poses[n as usize]);
            self.solver.add(edge, &(information * *weight), a, b);
        }
    }

    fn chi2_of_loops(&self) -> impl Iterator<Item = f64> + '_ {
        (0..self.edges.len()).filter(|i| self.edges[*i].is_loop).map(|i| self.chi2(i))
    }

    /// Squared residual of an edge in deviations.
    fn chi2(&self, i: usize) -> f64 {
        let edge = &self.edges[i];
        let (r, _) = edge.residual(&self.poses[edge.from as usize], &self.poses[edge.to as usize]);
        r.dot(&(self.information[i] * r))
    }

    fn cost(&self, i: usize) -> f64 {
        let (chi2, edge) = (self.chi2(i), &self.edges[i]);
        0.5 * if edge.is_loop { LOOP_SCALE * chi2 / (LOOP_SCALE + chi2) } else { chi2 }
    }

    fn weigh(&mut self, scale: f64) {
        let c2 = scale * LOOP_SCALE;
        for i in (0..self.edges.len()).filter(|i| self.edges[*i].is_loop) {
            self.weights[i] = (c2 / (c2 + self.chi2(i))).powi(2);
        }
    }

    /// Covariance of the pose of `b` in the frame of `a`, as the graph knew it when it was optimised last, and by odometry
    /// since. `None` where nothing connects the two.
    pub fn covariance_between(&mut self, a: u16, b: u16) -> Option<Matrix4<f64>> {
        // There is no factor, or a chain that began since then leads to nothing that it has.
        if !self.solver.factored || self.known(a).is_none() || self.known(b).is_none() {
            self.factor()?;
        }
        let (known_a, tail_a) = self.known(a)?;
        let (known_b, tail_b) = self.known(b)?;
        let mut edge = match known_a == known_b {
            true => Edge::nothing(known_a),
            false => {
                let covariance = self.relative(known_a, known_b)?;
                let measured = self.pose(known_a).between(&self.pose(known_b));
                Edge { from: known_a, to: known_b, measured, covariance, is_loop: true }
            }
        };
        edge = tail_b.map_or(edge, |tail| edge.then(&tail));
        edge = tail_a.map_or(edge, |tail| tail.inverse().then(&edge));
        Some(edge.covariance)
    }

    /// Factors the normal matrix at the poses as they are.
    fn factor(&mut self) -> Option<()> {
        self.solver.order(&self.used, &self.fixed, &self.edges)?;
        self.solver.clear(&self.used, &self.fixed);
        self.add_edges();
        self.solver.solve().map(|_| ())
    }

    /// The newest node before one that the factor has, and the odometry from there.
    fn known(&self, node: u16) -> Option<(u16, Option<Edge>)> {
        let (mut at, mut tail): (u16, Option<Edge>) = (node, None);
        while !self.solver.has(at) {
            let edge = *self.edges.get(self.chain[at as usize][0] as usize)?;
            tail = Some(tail.map_or(edge, |t| edge.then(&t)));
            at = edge.from;
        }
        Some((at, tail))
    }

    /// Covariance of the pose of one node in the frame of another, both in the factor.
    fn relative(&mut self, a: u16, b: u16) -> Option<Matrix4<f64>> {
        let [[aa, ab], [ba, bb]] = self.solver.joint(a, b)?;
        let (pa, pb) = (self.pose(a), self.pose(b));
        let [ja, jb] = edge::jacobians(&pa, &pb);
        let c =
            ja * aa * ja.transpose() + ja * ab * jb.transpose() + jb * ba * ja.transpose() + jb * bb * jb.transpose();
        let c = 0.5 * (c + c.transpose());
        c.iter().all(|x| x.is_finite()).then_some(c)
    }
}

/// A residual and its derivatives, for `solver` and tests.
type Residual = (Vector4<f64>, [Matrix4<f64>; 2]);

/// A position turned into another frame.
fn in_frame(frame: &Pose4, pose: &Pose4) -> glam::DVec3 {
    turned(-frame.yaw, pose.p - frame.p)
}
