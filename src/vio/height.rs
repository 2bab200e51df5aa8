//! The height above a barometer's first reading: the factor `z + bias - height` on a state, and the walk of the bias.
//!
//! Pressure drifts with the weather, so the bias is a state of its own: a column at each state of the window, which leaves
//! with the state's velocity. All of it is linear, so that it needs no linearization point. Without a barometer there is no
//! such column, and nothing changes by a bit.
//!
//! A reading is never extrapolated: a frame has a height once readings before and after it are there, which may be frames
//! later. One that the estimate contradicts is refused, as while a door slams. Where nothing else comes for `STEP_SECS`, the
//! pressure has changed for good, and the bias is learnt anew: the flight does not bend.

use super::reprojection::huber;
use super::rows::FactorRows;
use super::window::{Height, Layout, Window};
use crate::config::BaroConfig;
use std::collections::VecDeque;
use stipple_drivers::{Nanos, Span};

/// Deviation of a bias of which nothing is known, m.
pub const BIAS_UNKNOWN: f64 = 1e3;
/// Readings kept: more than a second at 50 Hz.
const READINGS: usize = 64;
/// Readings further apart are not interpolated between.
const GAP_MAX: Span = Span(250_000_000);
/// Pressures at which something flies, Pa: from 9 km above the sea to 1.8 km under it.
const PRESSURE: std::ops::RangeInclusive<f64> = 30_000.0..=125_000.0;
/// So many readings in a row, alike to the last bit, are of a sensor that hangs: it resolves a tenth of its noise.
const FROZEN_AFTER: u32 = 10;
/// A height that differs by more deviations from what is predicted is refused.
const GATE: f64 = 5.0;
/// By how much the estimate's vertical speed may be wrong, m/s: widens the gate with the time since the last height.
const SPEED_SIGMA: f64 = 0.03;
/// Time after which refused heights are believed, s.
const STEP_SECS: f64 = 4.0;
/// Width of Huber's weight, deviations.
const HUBER: f64 = 2.0;

/// What became of a reading.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pushed {
    Taken,
    /// Not a pressure, or not newer than the last.
    Rejected,
    /// One of many that are alike.
    Frozen,
}

/// What became of heights of frames.
#[derive(Clone, Copy, Debug, Default)]
pub struct Attached {
    pub used: u32,
    pub gated: u32,
    /// Times that the bias was learnt anew.
    pub steps: u32,
}

/// The newest readings of a barometer, in a ring bought once.
#[derive(Clone, Debug)]
pub struct Heights {
    config: BaroConfig,
    /// Stamps and heights above the first reading, m; never longer than its capacity at the start.
    readings: VecDeque<(Nanos, f64)>,
    /// Altitude of the first reading, m.
    first: Option<f64>,
    /// The last pressure, Pa, and how many came in a row that were the same.
    last: (f64, u32),
    /// Stamp of the newest frame whose height was believed; `None` while the bias is unknown.
    believed: Option<Nanos>,
    /// Stamp of the first frame since then whose height was refused.
    refused: Option<Nanos>,
}

impl Heights {
    pub fn new(config: &BaroConfig) -> Heights {
        let (config, readings) = (config.clone(), VecDeque::with_capacity(READINGS));
        Heights { config, readings, first: None, last: (0.0, 0), believed: None, refused: None }
    }

    /// After a reset the estimate's height is another.
    pub fn forget_bias(&mut self) {
        (self.believed, self.refused) = (None, None);
    }

    /// Readings to come are of another clock.
    pub fn forget_readings(&mut self) {
        self.readings.clear();
    }

    /// Whether a height was believed since the start.
    pub fn knows_bias(&self) -> bool {
        self.believed.is_some()
    }

    /// Inverse deviation of the walk of the bias in so many seconds.
    pub fn walk_weight(&self, dt: f64) -> f64 {
        1.0 / self.walk(dt)
    }

    fn walk(&self, dt: f64) -> f64 {
        self.config.drift_m * (dt / 600.0).sqrt()
    }

    /// Takes a pressure, Pa.
    pub fn push(&mut self, t: Nanos, pa: f64) -> Pushed {
        if !PRESSURE.contains(&pa) || self.readings.back().is_some_and(|(newest, _)| t <= *newest) {
            return Pushed::Rejected;
        }
        self.last = if pa == self.last.0 { (pa, self.last.1.saturating_add(1)) } else { (pa, 1) };
        if self.last.1 >= FROZEN_AFTER {
            return Pushed::Frozen;
        }
        let altitude = altitude(pa, self.config.air_c);
        let height = altitude - *self.first.get_or_insert(altitude);
        if self.readings.len() == READINGS {
            self.readings.pop_front();
        }
        self.readings.push_back((t, height));
        Pushed::Taken
    }

    /// The height at `t` and its deviation, linear between the readings beside it.
    fn at(&self, t: Nanos) -> Option<(f64, f64)> {
        let next = self.readings.partition_point(|(stamp, _)| *stamp < t);
        let (after, b) = *self.readings.get(next)?;
        let (before, a) = if after == t { (after, b) } else { *self.readings.get(next.checked_sub(1)?)? };
        let s = if after == t { 1.0 } else { (t - before).secs() / (after - before).secs() };
        let sigma = self.config.noise_m * (1.0 - s).hypot(s);
        (after - before <= GAP_MAX).then_some((a + (b - a) * s, sigma))
    }

    /// Gives every state of the window the height at its stamp, once there is one and unless it cannot be.
    pub fn attach(&mut self, window: &mut Window) -> Attached {
        let mut done = Attached::default();
        let slots = window.order.clone();
        for slot in slots.iter().map(|s| *s as usize) {
            let frame = window.frame(slot);
            if !frame.is_state || frame.height != Height::Unknown {
                continue;
            }
            let (t, z, bias) = (frame.t, frame.now.pose.p.z, frame.height_bias);
            let Some((height, sigma)) = self.at(t) else { continue };
            let is_off = |believed: Nanos| {
                let dt = (t - believed).secs();
                let sigma = sigma.hypot(self.walk(dt)).hypot(SPEED_SIGMA * dt);
                (z + bias - height).abs() > GATE * sigma
            };
            let off = self.believed.is_some_and(is_off);
            let stays = off && (t - *self.refused.get_or_insert(t)).secs() >= STEP_SECS;
            // The walk to the oldest state is in the prior.
            let is_oldest = window.states().next() == Some(slot);
            if off && (!stays || is_oldest) {
                window.frame_mut(slot).height = Height::Refused;
                done.gated += 1;
                continue;
            }
            if off || self.believed.is_none() {
                done.steps += u32::from(off);
                relearn(window, (off.then_some(slot), t), height - z);
            }
            window.frame_mut(slot).height = Height::Measured { height, weight: 1.0 / sigma };
            (self.believed, self.refused) = (Some(t), None);
            done.used += 1;
        }
        done
    }
}

/// Sets the bias: of all states, or from one on, to which it is then free to have stepped.
fn relearn(window: &mut Window, (stepped, t): (Option<usize>, Nanos), bias: f64) {
    let slots = window.order.clone();
    for slot in slots.iter().map(|s| *s as usize) {
        let frame = window.frame_mut(slot);
        if frame.is_state && (stepped.is_none() || frame.t >= t) {
            frame.height_bias = bias;
        }
    }
    if let Some(slot) = stepped {
        window.frame_mut(slot).height_walk = 1.0 / BIAS_UNKNOWN;
    }
}

/// Altitude of a pressure, Pa, in the standard atmosphere (ISO 2533), m, in air of another temperature at the ground: by 10 K a
/// climb is 3.5 percent off.
fn altitude(pa: f64, air_c: f64) -> f64 {
    const SEA_LEVEL_PA: f64 = 101_325.0;
    const KELVIN: f64 = 273.15;
    const LAPSE: f64 = 0.0065;
    const EXPONENT: f64 = 287.052_87 * LAPSE / 9.80665;
    (KELVIN + air_c) / LAPSE * (1.0 - (pa / SEA_LEVEL_PA).powf(EXPONENT))
}

/// Square root of the weight of a height, and its cost.
pub fn weighed(window: &Window, slot: usize, height: f64, weight: f64) -> (f64, f64) {
    let (w, cost) = huber((residual(window, slot, height) * weight).abs(), HUBER);
    (w.sqrt() * weight, cost)
}

fn residual(window: &Window, slot: usize, height: f64) -> f64 {
    let frame = window.frame(slot);
    frame.now.pose.p.z + frame.height_bias - height
}

/// Its rows, and its cost.
pub fn rows(window: &Window, slot: usize, (height, weight): (f64, f64), layout: &Layout, out: &mut FactorRows) -> f64 {
    let (weight, cost) = weighed(window, slot, height, weight);
    let [pose, _] = layout.state(slot);
    let bias = layout.height_bias(slot);
    out.begin(0, pose.into_iter().chain(bias));
    let at = [pose.map(|c| out.offset(c.at) + 2), bias.map(|c| out.offset(c.at))];
    let row = out.rows.push();
    at.into_iter().flatten().for_each(|column| row[column] = weight);
    row[row.len() - 1] = weight * residual(window, slot, height);
    cost
}

/// Whitened walk of the bias between two states.
pub fn walk_residual(window: &Window, from: usize, to: usize) -> f64 {
    let (a, b) = (window.frame(from), window.frame(to));
    (b.height_bias - a.height_bias) * b.height_walk
}

/// Its rows, and its cost.
pub fn walk_rows(window: &Window, from: usize, to: usize, layout: &Layout, out: &mut FactorRows) -> f64 {
    let (r, weight) = (walk_residual(window, from, to), window.frame(to).height_walk);
    let columns = [from, to].map(|slot| layout.height_bias(slot));
    out.begin(0, columns.into_iter().flatten());
    let at = columns.map(|c| c.map(|c| out.offset(c.at)));
    let row = out.rows.push();
    for (column, sign) in at.into_iter().zip([-1.0, 1.0]) {
        column.into_iter().for_each(|column| row[column] = sign * weight);
    }
    row[row.len() - 1] = r;
    0.5 * r * r
}

#[cfg(test)]
mod tests;
