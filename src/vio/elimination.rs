//! Elimination of the landmarks' points from the normal equations.
//!
//! A landmark's rows are `[A | J | r]`, A the columns of its point. With the thin QR `A = Q R`, `W = QᵀJ` and `g = Qᵀr`, they
//! say `JᵀJ - WᵀW` of the window, and of the point `R d + W dx + g = 0`. JᵀJ is sparse, since a view is about two frames,
//! and is summed up view by view; W has three rows, which are kept for all points and squared together. A is never
//! squared, so that a point far away or hardly determined costs no digits. What the difference costs is rounding of JᵀJ, as
//! any sum of normal equations does.

use super::landmarks::Landmark;
use super::reprojection::Point;
use super::rows::{FactorRows, COLS_MAX, PARTS_MAX, POINT_DIM, ROWS_MAX};
use super::window::{Layout, POSE_DIM};
use crate::limits::LANDMARKS;
use crate::math::dense::{Columns, System};
use crate::math::qr::{Rows, RANK_SQUARE};
use crate::math::wide::wide;

/// Sums are taken in this many lanes, and Q is padded to whole ones.
const LANES: usize = 4;
const Q_ROWS: usize = ROWS_MAX.next_multiple_of(LANES);

/// A point as elimination left it.
#[derive(Clone, Copy, Debug, Default)]
struct Eliminated {
    /// R, upper triangle.
    r: [[f64; POINT_DIM]; POINT_DIM],
    /// First of its rows `[W | g]`. `None` where its views do not determine it: then it does not move.
    first: Option<usize>,
    /// The point before the step.
    saved: Point,
}

/// All points as elimination left them, in the order of their landmarks.
#[derive(Clone, Debug)]
pub struct Elimination {
    points: Vec<Eliminated>,
    /// `[W | g]` of all points, in the columns of the window that views touch.
    rows: FactorRows,
    /// Q of the landmark at hand, by columns.
    q: [[f64; Q_ROWS]; POINT_DIM],
}

impl Elimination {
    pub fn new() -> Elimination {
        Elimination {
            points: Vec::with_capacity(LANDMARKS),
            rows: FactorRows::of_points(),
            q: [[0.0; Q_ROWS]; POINT_DIM],
        }
    }

    /// Empties, for the columns of a layout.
    pub fn begin(&mut self, layout: &Layout) {
        self.points.clear();
        self.rows.begin(0, layout.cameras().into_iter().chain(layout.poses()));
    }

    /// Eliminates the point of the next landmark: adds JᵀJ and Jᵀr of its rows to the system, and keeps W and g.
    pub fn eliminate(&mut self, landmark: &Landmark, rows: &FactorRows, cameras: Option<Columns>, system: &mut System) {
        let r = orthogonalize(&rows.rows, &mut self.q);
        let first = r.is_some().then_some(self.rows.rows.count());
        self.points.push(Eliminated { r: r.unwrap_or_default(), first, saved: landmark.point });
        if first.is_none() {
            return;
        }
        let mut w = [[0.0; COLS_MAX]; POINT_DIM];
        let b = rows.rows.cols() - 1;
        add_views(rows, cameras, &self.q, &mut w, system);
        // Where each part of W is, where it goes, and how wide it is.
        let mut moves = [(0, 0, 0); PARTS_MAX];
        let mut from = POINT_DIM;
        for (to, c) in moves.iter_mut().zip(rows.columns.iter()) {
            *to = (from, self.rows.offset(c.at), c.len);
            from += c.len;
        }
        for w in &w {
            let row = self.rows.rows.push();
            moves[..rows.columns.len()]
                .iter()
                .for_each(|(from, to, n)| row[*to..to + n].copy_from_slice(&w[*from..from + n]));
            row[row.len() - 1] = w[b];
        }
    }

    /// Subtracts WᵀW and Wᵀg of all points from the system.
    pub fn subtract_from(&mut self, system: &mut System) {
        self.rows.subtract_from(system);
    }

    fn g(&self, point: &Eliminated) -> [f64; POINT_DIM] {
        let b = self.rows.rows.cols() - 1;
        point.first.map_or([0.0; POINT_DIM], |first| std::array::from_fn(|i| self.rows.rows.row(first + i)[b]))
    }

    /// Decrease of the cost by the points' own steps.
    pub fn decrease(&self) -> f64 {
        self.points.iter().map(|p| 0.5 * self.g(p).iter().map(|g| g * g).sum::<f64>()).sum()
    }

    /// Moves the points by the steps that belong to the window's, dx.
    pub fn apply(&self, landmarks: &mut [Landmark], dx: &[f64]) {
        for (l, p) in landmarks.iter_mut().zip(&self.points) {
            let [x, y, rho] = self.step(p, dx);
            l.point.s += glam::DVec2::new(x, y);
            l.point.rho = (l.point.rho + rho).max(0.0);
        }
    }

    /// Takes the last step of the points back.
    pub fn restore(&self, landmarks: &mut [Landmark]) {
        landmarks.iter_mut().zip(&self.points).for_each(|(l, p)| l.point = p.saved);
    }

    /// Tells every landmark the standard deviation of its inverse distance, the frames taken as known; infinite when nothing
    /// determines it.
    pub fn tell_deviations(&self, landmarks: &mut [Landmark]) {
        for (l, p) in landmarks.iter_mut().zip(&self.points) {
            l.rho_sigma = p.first.map_or(f32::INFINITY, |_| (1.0 / p.r[POINT_DIM - 1][POINT_DIM - 1]) as f32);
        }
    }

    fn step(&self, point: &Eliminated, dx: &[f64]) -> [f64; POINT_DIM] {
        let (mut d, Some(first)) = ([0.0; POINT_DIM], point.first) else { return [0.0; POINT_DIM] };
        for i in (0..POINT_DIM).rev() {
            let row = self.rows.rows.row(first + i);
            let mut sum = row[row.len() - 1];
            let mut w = row.iter();
            for c in self.rows.columns.iter() {
                sum += w.by_ref().zip(&dx[c.at..c.at + c.len]).map(|(w, x)| w * x).sum::<f64>();
            }
            (i + 1..POINT_DIM).for_each(|j| sum += point.r[i][j] * d[j]);
            d[i] = -sum / point.r[i][i];
        }
        d
    }
}

wide! {
    /// Adds JᵀJ and Jᵀr of a landmark's views to the system, QᵀJ and Qᵀr to W.
    fn add_views<'a>(
        rows: &'a FactorRows,
        cameras: Option<Columns>,
        q: &'a [[f64; Q_ROWS]; POINT_DIM],
        w: &'a mut [[f64; COLS_MAX]; POINT_DIM],
        system: &'a mut System,
    ) -> () {
        let b = rows.rows.cols() - 1;
        for (view, frames) in rows.frames.iter().enumerate() {
            let pair = [rows.rows.row(2 * view), rows.rows.row(2 * view + 1)];
            let q: [[f64; 2]; POINT_DIM] = std::array::from_fn(|c| [q[c][2 * view], q[c][2 * view + 1]]);
            let r = pair.map(|row| row[b]);
            add_part(b, pair.map(|row| &row[b..]), &q, w);
            // The rig's columns are the first of the window.
            let of_cameras = cameras.map(|c| (c, pair.map(|row| &row[POINT_DIM..POINT_DIM + c.len])));
            if let Some((columns, part)) = of_cameras {
                add_part(POINT_DIM, part, &q, w);
                system.add_linear(columns, part, r);
                system.add_product(columns, part, columns, part);
            }
            let Some(frames) = frames else { continue };
            let poses = frames.map(|at| (rows.offset(at), Columns { at, len: POSE_DIM }));
            for (n, (at, columns)) in poses.into_iter().enumerate() {
                let of = |at: usize| pair.map(|row| &row[at..at + POSE_DIM]);
                let part = of(at);
                add_part(at, part, &q, w);
                system.add_linear(columns, part, r);
                for (at, earlier) in &poses[..=n] {
                    system.add_product(columns, part, *earlier, of(*at));
                }
                if let Some((cameras, of_cameras)) = of_cameras {
                    system.add_product(columns, part, cameras, of_cameras);
                }
            }
        }
    }
}

/// Adds the product of Q, two rows of it, with the columns from `at` of two rows.
#[inline(always)]
fn add_part(at: usize, part: [&[f64]; 2], q: &[[f64; 2]; POINT_DIM], w: &mut [[f64; COLS_MAX]; POINT_DIM]) {
    for (w, q) in w.iter_mut().zip(q) {
        let pairs = part[0].iter().zip(part[1]);
        w[at..].iter_mut().zip(pairs).for_each(|(w, (x, y))| *w += q[0] * x + q[1] * y);
    }
}

wide! {
    /// Thin QR of the first columns of rows, by Gram-Schmidt with each column orthogonalized twice, which is as exact as
    /// Householder's (Giraud et al., 2005). `None` where a column depends on earlier ones to working precision.
    fn orthogonalize<'a>(
        rows: &'a Rows,
        q: &'a mut [[f64; Q_ROWS]; POINT_DIM],
    ) -> Option<[[f64; POINT_DIM]; POINT_DIM]> {
        // Whole lanes, zero past the last row.
        let n = rows.count().next_multiple_of(LANES);
        for (c, q) in q.iter_mut().enumerate() {
            q[rows.count()..n].fill(0.0);
            q.iter_mut().enumerate().take(rows.count()).for_each(|(i, q)| *q = rows.row(i)[c]);
        }
        let mut r = [[0.0; POINT_DIM]; POINT_DIM];
        for c in 0..POINT_DIM {
            let (done, rest) = q.split_at_mut(c);
            let column = &mut rest[0][..n];
            let before = dot(column, column);
            for _ in 0..2 {
                for (earlier, r) in done.iter().zip(r.iter_mut()) {
                    let along = dot(&earlier[..n], column);
                    r[c] += along;
                    column.iter_mut().zip(&earlier[..n]).for_each(|(x, e)| *x -= along * e);
                }
            }
            let square = dot(column, column);
            // Also false where anything is not finite.
            if !(square > RANK_SQUARE * before) {
                return None;
            }
            r[c][c] = square.sqrt();
            let scale = 1.0 / r[c][c];
            column.iter_mut().for_each(|x| *x *= scale);
        }
        Some(r)
    }
}

/// Sums in lanes: the order is fixed, and the compiler may use vectors.
#[inline(always)]
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sum = [0.0; LANES];
    for (a, b) in a.chunks_exact(LANES).zip(b.chunks_exact(LANES)) {
        (0..LANES).for_each(|i| sum[i] += a[i] * b[i]);
    }
    (sum[0] + sum[1]) + (sum[2] + sum[3])
}
