//! Edges of the pose graph: what is measured between two nodes, and how well.

use super::super::pose4::{wrapped, Pose4};
use super::{in_frame, Residual};
use nalgebra::{Matrix4, Vector4};

/// Least and largest variance that an edge may have: m², rad².
const VARIANCE: [f64; 2] = [1e-10, 1e6];

/// A measured pose of one node in the frame of another.
#[derive(Clone, Copy, Debug)]
pub struct Edge {
    pub from: u16,
    pub to: u16,
    pub measured: Pose4,
    /// Covariance of the measured position in the frame of `from`, m², and yaw, rad².
    pub covariance: Matrix4<f64>,
    /// By a recognised place, which may be false; else by odometry.
    pub is_loop: bool,
}

impl Edge {
    /// The edge from a node to itself.
    pub fn nothing(node: u16) -> Edge {
        Edge { from: node, to: node, measured: Pose4::default(), covariance: Matrix4::zeros(), is_loop: true }
    }

    /// Whether numbers are finite and the covariance is positive definite.
    pub fn is_valid(&self) -> bool {
        let c = &self.covariance;
        let bounded = (0..4).all(|i| c[(i, i)] >= VARIANCE[0] && c[(i, i)] <= VARIANCE[1]);
        self.measured.is_finite() && bounded && c.cholesky().is_some()
    }

    /// This edge and another that begins where it ends, as one. It is a loop edge where one of them is.
    pub fn then(&self, next: &Edge) -> Edge {
        let measured = self.measured.compose(&next.measured);
        // By the errors of this one: yaw turns the next about its beginning.
        let mut by_first = Matrix4::identity();
        let arm = measured.p - self.measured.p;
        (by_first[(0, 3)], by_first[(1, 3)]) = (-arm.y, arm.x);
        let (sin, cos) = self.measured.yaw.sin_cos();
        let mut by_next = Matrix4::identity();
        (by_next[(0, 0)], by_next[(0, 1)], by_next[(1, 0)], by_next[(1, 1)]) = (cos, -sin, sin, cos);
        let covariance =
            by_first * self.covariance * by_first.transpose() + by_next * next.covariance * by_next.transpose();
        Edge { from: self.from, to: next.to, measured, covariance, is_loop: self.is_loop || next.is_loop }
    }

    /// The same edge, from its end to its beginning.
    pub fn inverse(&self) -> Edge {
        let measured = self.measured.inverse();
        let (sin, cos) = measured.yaw.sin_cos();
        let mut j = -Matrix4::identity();
        (j[(0, 0)], j[(0, 1)], j[(1, 0)], j[(1, 1)]) = (-cos, sin, -sin, -cos);
        (j[(0, 3)], j[(1, 3)]) = (measured.p.y, -measured.p.x);
        let covariance = j * self.covariance * j.transpose();
        Edge { from: self.to, to: self.from, measured, covariance, is_loop: self.is_loop }
    }

    /// Residual and derivatives by the errors of both nodes.
    pub fn residual(&self, a: &Pose4, b: &Pose4) -> Residual {
        let p = in_frame(a, b) - self.measured.p;
        let r = Vector4::new(p.x, p.y, p.z, wrapped(b.yaw - a.yaw - self.measured.yaw));
        (r, jacobians(a, b))
    }
}

/// Derivatives of the pose of `b` in the frame of `a` by the errors of both.
pub fn jacobians(a: &Pose4, b: &Pose4) -> [Matrix4<f64>; 2] {
    let (sin, cos) = a.yaw.sin_cos();
    let mut jb = Matrix4::identity();
    (jb[(0, 0)], jb[(0, 1)], jb[(1, 0)], jb[(1, 1)]) = (cos, sin, -sin, cos);
    let mut ja = -jb;
    let p = in_frame(a, b);
    (ja[(0, 3)], ja[(1, 3)]) = (p.y, -p.x);
    [ja, jb]
}
