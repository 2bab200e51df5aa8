//! Zero-velocity update: a frame that stands still says so. Without it the accelerometer's bias and
//! the pixel noise let a resting rig creep, and no keyframe is ever taken to stop it.
//!
//! A frame is at rest when the inertial samples are quiet, its tracks have not moved against a frame
//! at least `Gate::reference` older, and the estimate is not already fast: far points of a rig in
//! smooth flight stand as still as those of a rig on a table. A rig on the ground with its motors on
//! shakes as it does in flight (EuRoC V1_01: 1.5 m/s², 0.1 rad/s), so quiet it is not: then nothing may
//! have moved against the oldest frame of the window, which a hovering rig leaves behind.

use super::init::{REST_ACCEL, REST_GYRO, REST_PX};
use super::landmarks::find_track;
use super::residuals::Motion;
use super::samples::ImuRing;
use super::window::{Frame, Layout, Window};
use crate::frontend::Tracks;
use crate::limits::TRACKS;
use crate::math::dense::System;
use crate::mem::List;
use glam::DVec3;
use stipple_drivers::Span;

/// Standard deviations of "does not move", m/s, and of "the mean rate is the bias", rad/s.
const SIGMA_V: f64 = 4e-3;
const SIGMA_GYRO: f64 = 2e-3;
/// Tracks in common with the reference.
const COMMON_MIN: usize = 12;

/// What counts as rest.
struct Gate {
    /// Spread of the samples, rad/s and m/s², over this long, s.
    gyro: f64,
    accel: f64,
    span: f64,
    /// The youngest frame to compare tracks with, s, and how far they may have moved, px.
    reference: f64,
    px: f64,
    /// An estimate faster than this is not overruled, m/s; nor a turn, rad/s.
    speed: f64,
    rate: f64,
}

const QUIET: Gate =
    Gate { gyro: REST_GYRO, accel: REST_ACCEL, span: 0.3, reference: 0.1, px: REST_PX, speed: 0.1, rate: 0.02 };
/// Twice what V1_01 shakes by on the ground. A shaken camera's tracks scatter by half a pixel.
const SHAKEN: Gate = Gate { gyro: 0.25, accel: 3.0, span: 0.4, reference: 0.25, px: 1.0, speed: 0.03, rate: 0.01 };

/// Mean rate of a frame at rest, which is the gyro's bias; `None` when it moves or may move.
pub fn at_rest(slot: usize, window: &Window, tracks: &[Tracks], imu: &ImuRing) -> Option<DVec3> {
    let old_enough =
        |gate: &Gate, r: &usize| window.frame(*r).t <= window.frame(slot).t - Span::from_secs(gate.reference);
    let recent = || window.slots().rev().find(|r| old_enough(&QUIET, r));
    let oldest = || {
        let shares = |r: &usize| common(&tracks[*r], &tracks[slot]).take(COMMON_MIN).count() == COMMON_MIN;
        window.slots().take_while(|r| old_enough(&SHAKEN, r)).find(shares)
    };
    let passes = |gate: &Gate, reference: &dyn Fn() -> Option<usize>| {
        let frame = window.frame(slot);
        let s = imu.statistics(frame.t, Span::from_secs(gate.span))?;
        let quiet = s.gyro_sigma < gate.gyro && s.accel_sigma < gate.accel;
        if !quiet || (s.gyro - frame.now.bg).length() > gate.rate || frame.now.v.length() > gate.speed {
            return None;
        }
        let moved = median_displacement(&tracks[reference()?], &tracks[slot])?;
        (moved < gate.px as f32).then_some(s.gyro)
    };
    passes(&QUIET, &recent).or_else(|| passes(&SHAKEN, &oldest))
}

/// Where points that both see were and are, in camera 0.
fn common<'a>(from: &'a Tracks, to: &'a Tracks) -> impl Iterator<Item = ([f32; 2], [f32; 2])> + 'a {
    to.cameras[0].iter().filter_map(|t| find_track(&from.cameras[0], t.id).map(|f| (f.px, t.px)))
}

/// The larger axis of the median absolute displacement in camera 0, px. By axis, so that noise of
/// both does not add up to a motion.
fn median_displacement(from: &Tracks, to: &Tracks) -> Option<f32> {
    let mut moved: [List<f32, TRACKS>; 2] = Default::default();
    for (before, now) in common(from, to) {
        for axis in 0..2 {
            let _ = moved[axis].push((now[axis] - before[axis]).abs());
        }
    }
    if moved[0].len() < COMMON_MIN {
        return None;
    }
    let median = |list: &mut List<f32, TRACKS>| {
        let middle = list.len() / 2;
        *list.select_nth_unstable_by(middle, f32::total_cmp).1
    };
    let [x, y] = &mut moved;
    Some(median(x).max(median(y)))
}

/// Whitened residual: velocity, then gyro bias beside the mean rate.
fn residual(rate: DVec3, now: &Motion) -> [f64; 6] {
    let (v, g) = (now.v / SIGMA_V, (now.bg - rate) / SIGMA_GYRO);
    [v.x, v.y, v.z, g.x, g.y, g.z]
}

pub fn rest_cost(frame: &Frame) -> f64 {
    frame.rest.map_or(0.0, |rate| 0.5 * residual(rate, &frame.now).iter().map(|r| r * r).sum::<f64>())
}

/// Adds a frame's factor, if it is at rest; answers its cost. It is linear, so it has no linearisation
/// point to keep.
pub fn add_rest(frame: &Frame, slot: usize, layout: &Layout, system: &mut System) -> f64 {
    if let (Some(rate), Some(at)) = (frame.rest, layout.motion(slot)) {
        for (i, r) in residual(rate, &frame.now).into_iter().enumerate() {
            let weight = 1.0 / if i < 3 { SIGMA_V } else { SIGMA_GYRO };
            system.b[at + i] += r * weight;
            system.add(at + i, at + i, weight * weight);
        }
    }
    rest_cost(frame)
}

#[cfg(test)]
mod tests {
    use super::*;
    use stipple_drivers::Nanos;

    #[test]
    fn gradient_of_the_rest_factor_matches_differences_of_its_cost() {
        let now = Motion { v: DVec3::new(0.02, -0.01, 0.03), bg: DVec3::new(0.01, 0.0, -0.02), ..Motion::default() };
        let mut frame = Frame::first(Nanos(0), now);
        frame.rest = Some(DVec3::new(0.012, 0.001, -0.021));
        let mut window = Window::new();
        let slot = window.push(frame).expect("an empty window has room");
        let layout = Layout::of(&window);
        let mut system = System::new(15);
        system.clear(15);
        add_rest(window.frame(slot), slot, &layout, &mut system);
        for i in 0..15 {
            let cost = |h: f64| {
                let mut d = [0.0; 15];
                d[i] = h;
                rest_cost(&Frame { now: now.plus(&d), ..frame })
            };
            let slope = (cost(1e-6) - cost(-1e-6)) / 2e-6;
            assert!((slope - system.b[i]).abs() < 1e-5 * (1.0 + slope.abs()), "error {i}: {slope} {}", system.b[i]);
        }
    }
}
