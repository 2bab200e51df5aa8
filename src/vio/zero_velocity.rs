//! Zero-velocity update: a frame that stands still says so. Without it the accelerometer's bias and
//! the pixel noise let a resting rig creep, and no keyframe is ever taken to stop it.
//!
//! A frame is at rest when the inertial samples are quiet, its tracks have not moved against a frame
//! at least `Rest::reference` older, and the estimate is not already fast: far points of a rig in
//! smooth flight stand as still as those of a rig on a table. A rig on the ground with its motors on
//! shakes as it does in flight (EuRoC V1_01: 1.5 m/s², 0.1 rad/s), so quiet it is not: then nothing may
//! have moved against the oldest frame of the window, which a hovering rig leaves behind.

use super::inertial::Motion;
use super::samples::ImuRing;
use super::window::Window;
use crate::frontend::Tracks;
use crate::limits::{CAMERAS_MAX, TRACKS};
use crate::mem::List;
use glam::DVec3;
use stipple_drivers::{Nanos, Span};

/// At rest the samples of a unit spread by less than this, rad/s and m/s², and tracks move less than this, px.
pub const REST_GYRO: f64 = 0.03;
pub const REST_ACCEL: f64 = 0.3;
pub const REST_PX: f64 = 0.5;
/// Standard deviations of "does not move", m/s, and of "the mean rate is the bias", rad/s.
const SIGMA_V: f64 = 4e-3;
const SIGMA_GYRO: f64 = 2e-3;
/// Tracks in common with the reference.
const COMMON_MIN: usize = 12;

/// Time by which the frame that is held is older than the newest, which stands too, s, two frames at 20 Hz: a rig that
/// gathers way is seen to only after a tenth of a second, and held meanwhile it costs a single camera its scale. No multiple
/// of a common frame period, so that jitter of the stamps does not change which frame is held.
const LAG: f64 = 0.0725;
/// The frame that is held is as many frames older than the newest at least; every window has as many states.
const LAG_FRAMES: usize = 2;

/// What counts as rest.
struct Rest {
    /// Spread of the samples, rad/s and m/s², over this long, s.
    gyro: f64,
    accel: f64,
    span: f64,
    /// The youngest frame to compare tracks with, s, and how far they may have moved, px.
    reference: f64,
    px: f64,
    /// An estimate faster than this is not overruled, m/s; nor a rotation, rad/s.
    speed: f64,
    rate: f64,
}

const QUIET: Rest =
    Rest { gyro: REST_GYRO, accel: REST_ACCEL, span: 0.3, reference: 0.1, px: REST_PX, speed: 0.1, rate: 0.02 };
/// Twice what V1_01 shakes by on the ground. A shaken camera's tracks scatter by half a pixel.
const SHAKEN: Rest = Rest { gyro: 0.25, accel: 3.0, span: 0.4, reference: 0.25, px: 1.0, speed: 0.03, rate: 0.01 };

/// Holds the frame that has since been seen to stand; answers whether it did.
pub fn hold(newest: usize, window: &mut Window, tracks: &[Tracks], imu: &ImuRing) -> bool {
    let Some(held) = lagging(window, window.frame(newest).t) else { return false };
    let span = stands(newest, window, tracks, imu);
    let rest = span.and_then(|span| imu.statistics(window.frame(held).t, span)).map(|s| s.gyro);
    window.frame_mut(held).rest_rate = rest;
    rest.is_some()
}

/// The youngest state `LAG` before `t`, or the oldest of a window that is shorter.
fn lagging(window: &Window, t: Nanos) -> Option<usize> {
    let older = || window.states().rev().skip(LAG_FRAMES);
    older().find(|s| (t - window.frame(*s).t).secs() >= LAG).or_else(|| older().last())
}

/// How long the samples of a frame at rest have been quiet at least; `None` when it moves or may move. Their mean
/// rate is then the gyro's bias.
fn stands(slot: usize, window: &Window, tracks: &[Tracks], imu: &ImuRing) -> Option<Span> {
    let old_enough =
        |rest: &Rest, r: &usize| window.frame(*r).t <= window.frame(slot).t - Span::from_secs(rest.reference);
    let recent = || window.slots().rev().find(|r| old_enough(&QUIET, r));
    let oldest = || {
        let shares = |r: &usize| (0..CAMERAS_MAX).any(|c| shares_enough(&tracks[*r], &tracks[slot], c));
        window.slots().take_while(|r| old_enough(&SHAKEN, r)).find(shares)
    };
    let passes = |rest: &Rest, reference: &dyn Fn() -> Option<usize>| {
        let frame = window.frame(slot);
        let span = Span::from_secs(rest.span);
        let s = imu.statistics(frame.t, span)?;
        let quiet = s.gyro_sigma < rest.gyro && s.accel_sigma < rest.accel;
        if !quiet || (s.gyro - frame.now.bg).length() > rest.rate || frame.now.v.length() > rest.speed {
            return None;
        }
        let moved = displacement(&tracks[reference()?], &tracks[slot])?;
        (moved < rest.px as f32).then_some(span)
    };
    passes(&QUIET, &recent).or_else(|| passes(&SHAKEN, &oldest))
}

/// Pixels in one camera of the points that both see, before and now.
fn common<'a>(from: &'a Tracks, to: &'a Tracks, camera: usize) -> impl Iterator<Item = ([f32; 2], [f32; 2])> + 'a {
    to.cameras[camera].iter().filter_map(move |t| from.find(camera, t.id).map(|f| (f.px, t.px)))
}

fn shares_enough(from: &Tracks, to: &Tracks, camera: usize) -> bool {
    common(from, to, camera).take(COMMON_MIN).count() == COMMON_MIN
}

/// Median displacement, px, in the camera that sees the most of it; `None` where none shares enough points.
fn displacement(from: &Tracks, to: &Tracks) -> Option<f32> {
    (0..CAMERAS_MAX).filter_map(|camera| median_displacement(from, to, camera)).reduce(f32::max)
}

/// The larger axis of the median absolute displacement in a camera, px. By axis, so that noise of
/// both does not add up to a motion.
fn median_displacement(from: &Tracks, to: &Tracks, camera: usize) -> Option<f32> {
    let mut moved: [List<f32, TRACKS>; 2] = Default::default();
    for (before, now) in common(from, to, camera) {
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

/// Reciprocal deviations of the residual: of velocity, then of the gyro's bias.
pub const WEIGHTS: [f64; 6] = {
    let (v, g) = (1.0 / SIGMA_V, 1.0 / SIGMA_GYRO);
    [v, v, v, g, g, g]
};

/// Whitened residual of a state at rest: velocity, then gyro bias beside the mean rate. Its derivative to
/// [v, bg] is the diagonal of `WEIGHTS`.
pub fn residual(now: &Motion, rate: DVec3) -> [f64; 6] {
    let (v, g) = (now.v / SIGMA_V, (now.bg - rate) / SIGMA_GYRO);
    [v.x, v.y, v.z, g.x, g.y, g.z]
}

/// Half the squared residual.
pub fn cost(now: &Motion, rate: DVec3) -> f64 {
    0.5 * residual(now, rate).iter().map(|r| r * r).sum::<f64>()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_the_derivatives_of_the_residual() {
        let now = Motion { v: DVec3::new(0.02, -0.01, 0.03), bg: DVec3::new(0.01, 0.0, -0.02), ..Motion::default() };
        let rate = DVec3::new(0.012, 0.001, -0.021);
        for i in 0..15 {
            let at = |h: f64| {
                let mut d = [0.0; 15];
                d[i] = h;
                residual(&now.plus(&d), rate)
            };
            let (up, down) = (at(1e-6), at(-1e-6));
            for k in 0..6 {
                let expected = if i == k + 6 { WEIGHTS[k] } else { 0.0 };
                assert!(((up[k] - down[k]) / 2e-6 - expected).abs() < 1e-5, "error {i}, residual {k}");
            }
        }
    }
}
