//! The factors of the window: everything that was measured, each as whitened residuals of frames, points and rig.
//!
//! There is one list of them. The cost, the linearization and the marginalization go through it and know none of its
//! members, so that a new kind of measurement (GNSS, wheels; `height.rs` is the first) is a variant of `Factor`, its place in
//! `measured_at` or `between`, a cost and its rows. The prior stands apart (`prior.rs`): it is not measured but kept.
//!
//! Rows are `[J | r]` of a least-squares problem. A landmark's are `[point | frames | r]`; Householder QR of the three
//! columns of the point leaves rows that do not contain it (Demmel et al., ICCV 2021), for the marginalization; the solver sums
//! views up sparsely instead, and knows a landmark by name for that (`elimination.rs`). Residuals are taken at the
//! estimate, Jacobians at the first estimates (FEJ), those to the rig's columns too.

use super::height;
use super::inertial::{inertial_jacobians, inertial_residual, scale_jacobian, Vec15};
use super::landmarks::{Landmark, Observation};
use super::model::Model;
use super::projection::{host_cam, observe, predicted, CameraColumns, Host};
use super::rig::{CAMERA_DIM_MAX, SCALE_DIM};
use super::rows::{FactorRows, POINT_DIM};
use super::window::{Height, Layout, Window, MOTION_DIM, POSE_DIM};
use super::zero_velocity;
use crate::limits::FRAMES;
use crate::math::dense::Columns;
use glam::DVec3;

/// Square root of the information on an inverse distance nothing observes, m.
const RHO_RIDGE: f64 = 1e-3;
/// An observation whose point has left the camera model costs as if this far off, px.
const LOST_PX: f64 = 20.0;

/// One measurement, by the slots of the frames it is about.
#[derive(Clone, Copy, Debug)]
pub enum Factor<'a> {
    /// The inertial samples between two states.
    Inertial { from: usize, to: usize },
    /// A state seen at rest, with the mean rate of the gyro, rad/s.
    ZeroVelocity { slot: usize, rate: DVec3 },
    /// What a barometer said at a state, m, and its inverse deviation.
    Height { slot: usize, height: f64, weight: f64 },
    /// The walk of its bias between two states.
    HeightWalk { from: usize, to: usize },
    /// All views of a landmark.
    Landmark(&'a Landmark),
}

/// What linearizing a factor gave besides its rows.
#[derive(Clone, Copy, Debug)]
pub struct Linearized {
    /// Cost at the estimate, half a sum of squared deviations without unit.
    pub cost: f64,
    /// First of the rows that speak of the window alone; those before hold the landmark's point. `None` where the
    /// views do not determine the point: then they say nothing of the window.
    pub first: Option<usize>,
}

/// Every factor of the window, oldest first.
pub fn of_window<'a>(window: &'a Window, landmarks: &'a [Landmark]) -> impl Iterator<Item = Factor<'a>> + 'a {
    let before = std::iter::once(None).chain(window.states().map(Some));
    let of_states = before.zip(window.states()).flat_map(move |(from, to)| {
        from.into_iter().flat_map(move |from| between(window, from, to)).chain(measured_at(window, to))
    });
    of_states.chain(landmarks.iter().map(Factor::Landmark))
}

/// The factors removed when `state` and some landmarks are marginalized; `next` is the state after it.
pub fn of_leaving<'a>(
    window: &'a Window,
    (state, next): (usize, usize),
    landmarks: impl Iterator<Item = &'a Landmark> + 'a,
) -> impl Iterator<Item = Factor<'a>> + 'a {
    between(window, state, next).chain(measured_at(window, state)).chain(landmarks.map(Factor::Landmark))
}

/// What ties two states together that follow each other.
fn between<'a>(window: &Window, from: usize, to: usize) -> impl Iterator<Item = Factor<'a>> {
    let walk = window.has_heights.then_some(Factor::HeightWalk { from, to });
    std::iter::once(Factor::Inertial { from, to }).chain(walk)
}

/// What was measured at one state alone.
fn measured_at<'a>(window: &Window, slot: usize) -> impl Iterator<Item = Factor<'a>> {
    let frame = window.frame(slot);
    let height = match frame.height {
        Height::Measured { height, weight } => Some(Factor::Height { slot, height, weight }),
        Height::Unknown | Height::Refused => None,
    };
    frame.rest_rate.map(|rate| Factor::ZeroVelocity { slot, rate }).into_iter().chain(height)
}

impl Factor<'_> {
    /// Adds half the squared whitened residual at the estimate, robust for views.
    pub fn add_cost(self, window: &Window, model: &Model, sum: &mut f64) {
        match self {
            Factor::Inertial { from, to } => *sum += 0.5 * inertial_residual_at(window, from, to).norm_squared(),
            Factor::ZeroVelocity { slot, rate } => *sum += zero_velocity::cost(&window.frame(slot).now, rate),
            Factor::Height { slot, height, weight } => *sum += height::weighed(window, slot, height, weight).1,
            Factor::HeightWalk { from, to } => *sum += 0.5 * height::walk_residual(window, from, to).powi(2),
            Factor::Landmark(l) => costs_of_views(l, window, model).for_each(|cost| *sum += cost),
        }
    }

    /// Its rows in the columns of a layout, as far as these are in it.
    pub fn linearize(self, window: &Window, model: &Model, layout: &Layout, out: &mut FactorRows) -> Linearized {
        match self {
            Factor::Inertial { from, to } => {
                Linearized { cost: inertial_rows(window, from, to, layout, out), first: Some(0) }
            }
            Factor::ZeroVelocity { slot, rate } => {
                Linearized { cost: zero_velocity_rows(window, slot, rate, layout, out), first: Some(0) }
            }
            Factor::Height { slot, height, weight } => {
                Linearized { cost: height::rows(window, slot, (height, weight), layout, out), first: Some(0) }
            }
            Factor::HeightWalk { from, to } => {
                Linearized { cost: height::walk_rows(window, from, to, layout, out), first: Some(0) }
            }
            Factor::Landmark(l) => {
                let cost = view_rows(l, window, model, layout, out);
                Linearized { cost, first: (out.rows.eliminate(POINT_DIM) == POINT_DIM).then_some(POINT_DIM) }
            }
        }
    }
}

/// The whitened inertial residual between two states at the estimate, the unit's scale included.
pub fn inertial_residual_at(window: &Window, from: usize, to: usize) -> Vec15 {
    let (a, b, rig) = (window.frame(from), window.frame(to), &window.rig.now);
    let scaled = b.increment.rescaled(rig.gyro_scale, rig.accel_scale);
    inertial_residual(&scaled, &b.weight, &a.now, &b.now)
}

fn inertial_rows(window: &Window, from: usize, to: usize, layout: &Layout, out: &mut FactorRows) -> f64 {
    let (a, b, rig) = (window.frame(from), window.frame(to), window.rig.linearized());
    let r = inertial_residual_at(window, from, to);
    let (before, after) = (a.linearized(), b.linearized());
    let (gyro, accel) = (rig.gyro_scale, rig.accel_scale);
    let (ja, jb) = inertial_jacobians(&b.increment.rescaled(gyro, accel), &b.weight, before, after);
    let scale = layout.imu();
    out.begin(0, layout.state(from).into_iter().chain(layout.state(to)).flatten().chain(scale));
    let scale = scale.map(|s| (out.offset(s.at), scale_jacobian(&b.increment, &b.weight, before, after, gyro, accel)));
    let at = [from, to].map(|s| layout.state(s).map(|part| part.map(|p| out.offset(p.at))));
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

/// It is linear, so it has no linearization point to keep.
fn zero_velocity_rows(window: &Window, slot: usize, rate: DVec3, layout: &Layout, out: &mut FactorRows) -> f64 {
    let now = &window.frame(slot).now;
    let [_, motion] = layout.state(slot);
    out.begin(0, motion.into_iter());
    for (i, (r, weight)) in zero_velocity::residual(now, rate).into_iter().zip(zero_velocity::WEIGHTS).enumerate() {
        let row = out.rows.push();
        (row[i], row[MOTION_DIM]) = (weight, r);
    }
    zero_velocity::cost(now, rate)
}

fn costs_of_views<'a>(l: &'a Landmark, window: &'a Window, model: &'a Model) -> impl Iterator<Item = f64> + 'a {
    let host_cam = host_cam(l, window);
    let off = move |o: &Observation| predicted(l, &host_cam, o, window).map_or(LOST_PX, |px| (px - o.px()).length());
    l.observations.iter().map(move |o| model.view_noise(window.frame(o.slot as usize)).cost(off(o)))
}

/// Views in frames of the layout, `[point | frames | r]`, before the point is eliminated; answers their cost.
pub fn view_rows(landmark: &Landmark, window: &Window, model: &Model, layout: &Layout, out: &mut FactorRows) -> f64 {
    let host = landmark.host as usize;
    let views = landmark.observations.iter().filter(|o| layout.pose(o.slot as usize).is_some());
    let mut touched = [false; FRAMES];
    views.clone().for_each(|o| touched[o.slot as usize] = true);
    let others = (0..FRAMES).any(|s| touched[s] && s != host);
    touched[host] = others;
    let frames = (0..FRAMES).filter(|s| touched[*s] && others).filter_map(|s| layout.pose(s));
    out.begin(POINT_DIM, frames.map(|at| Columns { at, len: POSE_DIM }).chain(layout.cameras()));
    let host_at = layout.pose(host).filter(|_| others);

    let mut cost = 0.0;
    let cameras_at = layout.cameras().map(|s| (out.offset(s.at), s.len));
    let host_view = Host::of(landmark, window);
    let mut columns: CameraColumns = [[0.0; CAMERA_DIM_MAX]; 2];
    for o in views {
        let noise = model.view_noise(window.frame(o.slot as usize));
        let Some(r) = observe(landmark, &host_view, o, window, &mut columns) else {
            cost += noise.cost(LOST_PX);
            continue;
        };
        let whitened = noise.whiten(r.px);
        cost += whitened.cost;
        let target_at = layout.pose(o.slot as usize).filter(|_| o.slot != landmark.host);
        // In its host's own frame a view says nothing about poses.
        let frames = host_at.zip(target_at).map(|(host, target)| [host, target]);
        let frames_at = frames.map(|at| at.map(|at| out.offset(at)));
        let ascending = frames.map(|[a, b]| [a.min(b), a.max(b)]);
        out.frames.push(ascending).expect("OBSERVATIONS is the most a landmark has");
        for axis in 0..2 {
            let row = out.rows.push();
            let by = whitened.rows.col(axis);
            let mut put = |at: usize, [x, y]: [&[f64]; 2]| {
                row[at..].iter_mut().zip(x).zip(y).for_each(|((to, x), y)| *to = x * by.x + y * by.y);
            };
            put(0, [&r.d_point[0], &r.d_point[1]]);
            if let Some((at, len)) = cameras_at {
                put(at, [&columns[0][..len], &columns[1][..len]]);
            }
            if let Some([host_at, target_at]) = frames_at {
                put(host_at, [&r.d_host[0], &r.d_host[1]]);
                put(target_at, [&r.d_target[0], &r.d_target[1]]);
            }
            let last = row.len() - 1;
            row[last] = whitened.error[axis];
        }
    }
    out.rows.push()[POINT_DIM - 1] = RHO_RIDGE;
    cost
}
