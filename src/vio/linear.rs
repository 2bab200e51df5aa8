//! Factors as rows `[J | r]` of a least-squares problem: what the solver sums up and
//! marginalisation stacks. A row holds only the columns its factor touches.
//!
//! A landmark's block is `[point | frames | r]`; Householder QR of the three columns of the point
//! leaves rows that do not contain it (Demmel et al., ICCV 2021). Residuals are taken at the
//! estimate, Jacobians at the linearisation points, those to the rig's columns too.

use super::landmarks::Landmark;
use super::projection::{host_cam, observe, predicted, CameraColumns, Host};
use super::residuals::{huber, inertial_jacobians, inertial_residual, scale_jacobian, Vec15};
use super::rig::SCALE_DIM;
use super::solve::Model;
use super::window::{Layout, Window, FRAMES, MOTION_DIM, POSE_DIM};
use super::zero_velocity::{rest_residual, REST_WEIGHTS};
use crate::limits::{OBSERVATIONS, RIG_DIM, WINDOW_DIM};
use crate::math::dense::{Columns, System};
use crate::math::qr::Rows;
use crate::mem::List;

/// Columns of a point, first in a landmark's block.
pub const POINT_DIM: usize = 3;
/// Square root of the information on an inverse distance nothing observes, m.
const RHO_RIDGE: f64 = 1e-3;
/// An observation whose point has left the camera model costs as if this far off, px.
const LOST_PX: f64 = 20.0;
/// Parts of the window that one factor can touch: the poses a landmark sees, or all of two states.
pub const SPANS: usize = FRAMES + 2;
/// Columns of a landmark's block besides the point.
pub const LOCAL_DIM: usize = POSE_DIM * FRAMES + RIG_DIM;
const COLS_MAX: usize = POINT_DIM + LOCAL_DIM + 1;
const ROWS_MAX: usize = 2 * OBSERVATIONS + 1;

/// The rows of one factor; reused for every factor.
#[derive(Clone, Debug)]
pub struct Linear {
    pub rows: Rows,
    /// Of the layout, ascending; they follow each other in the rows after the point's columns.
    pub spans: List<Columns, SPANS>,
    lead: usize,
    gram: Vec<f64>,
}

impl Linear {
    pub fn new() -> Linear {
        Linear {
            rows: Rows::new(ROWS_MAX, COLS_MAX),
            spans: List::default(),
            lead: 0,
            gram: vec![0.0; Rows::gram_len(COLS_MAX)],
        }
    }

    pub const BYTES: usize = Rows::bytes(ROWS_MAX, COLS_MAX) + Rows::gram_len(COLS_MAX) * size_of::<f64>();

    /// Empties, for rows with `lead` columns of their own before those of `spans`.
    fn begin(&mut self, lead: usize, spans: impl Iterator<Item = Columns>) {
        self.spans.clear();
        for span in spans {
            self.spans.push(span).expect("SPANS is the most a factor touches");
        }
        self.spans.sort_unstable_by_key(|s| s.at);
        self.lead = lead;
        self.rows.clear(lead + self.spans.iter().map(|s| s.len).sum::<usize>() + 1);
    }

    /// Where the columns of the layout from `at` are in the rows.
    fn offset(&self, at: usize) -> usize {
        self.lead + self.spans.iter().take_while(|s| s.at != at).map(|s| s.len).sum::<usize>()
    }

    /// Adds the square of the rows from `first`, the point's columns left out.
    pub fn add_to(&mut self, first: usize, system: &mut System) {
        let stride = self.rows.gram(first, &mut self.gram);
        system.add_gram(&self.gram, stride, self.lead, &self.spans);
    }

    /// Appends the rows from `first`, the point's columns left out; makes room when there is none.
    pub fn append_to(&self, first: usize, stack: &mut Rows) {
        if stack.room() < self.rows.len() - first {
            stack.triangularize();
        }
        for i in first..self.rows.len() {
            let row = self.rows.row(i);
            let out = stack.push();
            let mut j = self.lead;
            for s in self.spans.iter() {
                out[s.at..s.at + s.len].copy_from_slice(&row[j..j + s.len]);
                j += s.len;
            }
            out[out.len() - 1] = row[j];
        }
    }
}

impl Default for Linear {
    fn default() -> Self {
        Linear::new()
    }
}

/// Rows of the stack of a marginalisation: what stays of it when triangular, and the largest factor.
pub const STACK_ROWS: usize = WINDOW_DIM + 4 * ROWS_MAX;

/// A landmark's views in frames of the layout; answers their cost.
fn view_rows(landmark: &Landmark, window: &Window, model: &Model, layout: &Layout, out: &mut Linear) -> f64 {
    let host = landmark.host as usize;
    let views = landmark.observations.iter().filter(|o| layout.pose(o.slot as usize).is_some());
    let mut touched = [false; FRAMES];
    views.clone().for_each(|o| touched[o.slot as usize] = true);
    let others = (0..FRAMES).any(|s| touched[s] && s != host);
    touched[host] = others;
    let frames = (0..FRAMES).filter(|s| touched[*s] && others).filter_map(|s| layout.pose(s));
    out.begin(POINT_DIM, frames.map(|at| Columns { at, len: POSE_DIM }).chain(layout.cameras()));
    let host_at = layout.pose(host).filter(|_| others).map(|at| out.offset(at));

    let mut cost = 0.0;
    let inv_sigma = 1.0 / model.sigma_px;
    let cameras_at = layout.cameras().map(|s| (out.offset(s.at), s.len));
    let host_cam = Host::of(landmark, window);
    let mut columns: CameraColumns = [[0.0; RIG_DIM - SCALE_DIM]; 2];
    for o in views {
        let Some(r) = observe(landmark, &host_cam, o, window, &mut columns) else {
            cost += huber(LOST_PX * inv_sigma, model.huber_px * inv_sigma).1;
            continue;
        };
        let (weight, c) = huber(r.px.length() * inv_sigma, model.huber_px * inv_sigma);
        cost += c;
        let weight = weight.sqrt() * inv_sigma;
        let target_at = layout.pose(o.slot as usize).filter(|_| o.slot != landmark.host).map(|at| out.offset(at));
        for axis in 0..2 {
            let row = out.rows.push();
            let mut put = |at: usize, x: &[f64]| {
                row[at..].iter_mut().zip(x).for_each(|(to, x)| *to = x * weight);
            };
            put(0, &r.d_point[axis]);
            if let Some((at, len)) = cameras_at {
                put(at, &columns[axis][..len]);
            }
            // In its host's own frame a view says nothing about poses.
            if let (Some(host_at), Some(target_at)) = (host_at, target_at) {
                put(host_at, &r.d_host[axis]);
                put(target_at, &r.d_target[axis]);
            }
            let last = row.len() - 1;
            row[last] = r.px[axis] * weight;
        }
    }
    out.rows.push()[POINT_DIM - 1] = RHO_RIDGE;
    cost
}

/// The same with its point eliminated: the first `POINT_DIM` rows hold it, the others do not. Answers the cost
/// of its views, and whether they determine the point; one that they do not says nothing of the frames.
pub fn landmark_rows(
    landmark: &Landmark,
    window: &Window,
    model: &Model,
    layout: &Layout,
    out: &mut Linear,
) -> (f64, bool) {
    let cost = view_rows(landmark, window, model, layout, out);
    (cost, out.rows.eliminate(POINT_DIM) == POINT_DIM)
}

/// Rows before elimination, `[point | all columns of the layout | r]`, for tests; `None` where `landmark_rows`
/// would say nothing.
#[cfg(test)]
pub fn raw_landmark_rows(
    landmark: &Landmark,
    window: &Window,
    model: &Model,
    layout: &Layout,
    out: &mut Linear,
) -> Option<Vec<Vec<f64>>> {
    view_rows(landmark, window, model, layout, out);
    let mut full = Vec::new();
    for i in 0..out.rows.len() {
        let (row, mut wide, mut j) = (out.rows.row(i), vec![0.0; POINT_DIM + layout.dim + 1], POINT_DIM);
        (0..POINT_DIM).for_each(|k| wide[k] = row[k]);
        for s in out.spans.iter() {
            (0..s.len).for_each(|k| wide[POINT_DIM + s.at + k] = row[j + k]);
            j += s.len;
        }
        wide[POINT_DIM + layout.dim] = row[j];
        full.push(wide);
    }
    (out.rows.eliminate(POINT_DIM) == POINT_DIM).then_some(full)
}

/// The whitened inertial residual between two states at the estimate, the unit's scale included.
pub fn inertial_residual_at(window: &Window, from: usize, slot: usize) -> Vec15 {
    let (a, b, rig) = (window.frame(from), window.frame(slot), &window.rig);
    if rig.parts.imu_scale {
        let scaled = b.increment.rescaled(rig.now.gyro_scale, rig.now.accel_scale);
        inertial_residual(&scaled, &b.weight, &a.now, &b.now)
    } else {
        inertial_residual(&b.increment, &b.weight, &a.now, &b.now)
    }
}

/// The inertial factor between two states; answers its cost.
pub fn inertial_rows(window: &Window, from: usize, slot: usize, layout: &Layout, out: &mut Linear) -> f64 {
    let (a, b) = (window.frame(from), window.frame(slot));
    let rig = &window.rig;
    let r = inertial_residual_at(window, from, slot);
    let (before, after) = (a.motion_linearized(), b.motion_linearized());
    let (gyro, accel) = (rig.linearized().gyro_scale, rig.linearized().accel_scale);
    let (ja, jb) = if rig.parts.imu_scale {
        inertial_jacobians(&b.increment.rescaled(gyro, accel), &b.weight, before, after)
    } else {
        inertial_jacobians(&b.increment, &b.weight, before, after)
    };
    let scale = layout.imu();
    out.begin(0, layout.state(from).into_iter().chain(layout.state(slot)).flatten().chain(scale));
    let scale = scale.map(|s| (out.offset(s.at), scale_jacobian(&b.increment, &b.weight, before, after, gyro, accel)));
    let at = [from, slot].map(|s| layout.state(s).map(|part| part.map(|p| out.offset(p.at))));
    for i in 0..r.len() {
        let row = out.rows.push();
        for (at, j) in at.iter().zip([&ja, &jb]) {
            for (part, columns) in at.iter().zip([0..POSE_DIM, POSE_DIM..POSE_DIM + MOTION_DIM]) {
                let Some(part) = part else { continue };
                columns.enumerate().for_each(|(k, c)| row[part + k] = j[(i, c)]);
            }
        }
        if let Some((at, j)) = &scale {
            (0..SCALE_DIM).for_each(|k| row[at + k] = j[(i, k)]);
        }
        row[row.len() - 1] = r[i];
    }
    0.5 * r.norm_squared()
}

/// The factor of a frame at rest, `None` when it is not; answers its cost. It is linear, so it has no
/// linearisation point to keep.
pub fn rest_rows(window: &Window, slot: usize, layout: &Layout, out: &mut Linear) -> Option<f64> {
    let (r, [_, motion]) = (rest_residual(window.frame(slot))?, layout.state(slot));
    out.begin(0, motion.into_iter());
    for (i, (r, weight)) in r.into_iter().zip(REST_WEIGHTS).enumerate() {
        let row = out.rows.push();
        (row[i], row[MOTION_DIM]) = (weight, r);
    }
    Some(0.5 * r.iter().map(|r| r * r).sum::<f64>())
}

/// What the views of all landmarks cost at the estimate.
pub fn cost_of_views(landmarks: &[Landmark], window: &Window, model: &Model) -> f64 {
    let inv_sigma = 1.0 / model.sigma_px;
    let lost = huber(LOST_PX * inv_sigma, model.huber_px * inv_sigma).1;
    let mut cost = 0.0;
    for l in landmarks {
        let host_cam = host_cam(l, window);
        for o in l.observations.iter() {
            cost += match predicted(l, &host_cam, o, window) {
                Some(px) => huber((px - o.px()).length() * inv_sigma, model.huber_px * inv_sigma).1,
                None => lost,
            };
        }
    }
    cost
}
