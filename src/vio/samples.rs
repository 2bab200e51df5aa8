//! The newest inertial samples, in a ring bought once, and their integration between two instants.
//!
//! Samples are interpolated at the ends of what is integrated; outside the samples the nearest is held.

use super::preintegration::{Increment, Noise};
use super::spikes::Spikes;
use crate::limits::IMU_BETWEEN_FRAMES;
use glam::DVec3;
use std::collections::VecDeque;
use stipple_drivers::{ImuSample, Nanos, Span};

/// A stamp further ahead than this of the one before it is not believed alone, s.
const LEAP_MAX: f64 = 5.0;

/// Refuses a stamp that leaps ahead, since believing it would make every later one too old; the next that
/// agrees with it is believed.
#[derive(Clone, Copy, Debug, Default)]
pub struct Leap {
    to: Option<Nanos>,
}

impl Leap {
    pub fn refuses(&mut self, last: Option<Nanos>, t: Nanos) -> bool {
        let far = |from: Nanos| (t - from).secs() > LEAP_MAX;
        if !last.is_some_and(far) || self.to.is_some_and(|to| t > to && !far(to)) {
            self.to = None;
            return false;
        }
        self.to = Some(t);
        true
    }
}

/// The newest samples, ascending stamps; old ones are overwritten.
#[derive(Clone, Debug)]
pub struct ImuRing {
    /// Never longer than its capacity at the start.
    samples: VecDeque<ImuSample>,
    leap: Leap,
    spikes: Spikes,
}

impl ImuRing {
    /// A ring without samples.
    pub fn empty() -> ImuRing {
        let samples = VecDeque::with_capacity(IMU_BETWEEN_FRAMES);
        ImuRing { samples, leap: Leap::default(), spikes: Spikes::default() }
    }

    pub const BYTES: usize = IMU_BETWEEN_FRAMES * size_of::<ImuSample>();

    /// Whether a sample is finite, newer than the last, and does not leap ahead of it.
    pub fn admits(&mut self, s: &ImuSample) -> bool {
        let last = self.newest().map(|n| n.t);
        s.is_finite() && last.is_none_or(|n| s.t > n) && !self.leap.refuses(last, s.t)
    }

    /// Takes a sample that was admitted; returns the one that was overwritten.
    pub fn push(&mut self, s: ImuSample) -> Option<ImuSample> {
        let old = if self.samples.len() == IMU_BETWEEN_FRAMES { self.samples.pop_front() } else { None };
        self.samples.push_back(s);
        old
    }

    /// Judges the sample before the newest; answers whether it was repaired. What was integrated up to it before stays.
    pub fn repair(&mut self, noise: &Noise) -> bool {
        let Some(before) = self.samples.len().checked_sub(3) else { return false };
        let [a, b, c] = [0, 1, 2].map(|i| &self.samples[before + i]);
        let repaired = self.spikes.repaired(a, b, c, noise);
        if let Some(s) = repaired {
            self.samples[before + 1] = s;
        }
        repaired.is_some()
    }

    /// The newest sample.
    pub fn newest(&self) -> Option<&ImuSample> {
        self.samples.back()
    }

    #[cfg(test)]
    pub fn iter(&self) -> impl Iterator<Item = &ImuSample> {
        self.samples.iter()
    }

    /// First index with a stamp after `t`.
    fn after(&self, t: Nanos) -> usize {
        self.samples.partition_point(|s| s.t <= t)
    }

    /// Rate and force at `t`: linear between samples, held outside them.
    fn sample_at(&self, t: Nanos) -> Option<(DVec3, DVec3)> {
        let next = self.after(t);
        let before = next.checked_sub(1).map(|i| &self.samples[i]);
        let (Some(a), Some(b)) = (before, self.samples.get(next)) else {
            let nearest = before.or(self.samples.front())?;
            return Some((nearest.gyro_body, nearest.accel_body));
        };
        let s = (t - a.t).secs() / (b.t - a.t).secs();
        Some((a.gyro_body.lerp(b.gyro_body, s), a.accel_body.lerp(b.accel_body, s)))
    }

    /// What the gyro read at `t`, rad/s; zero without any sample.
    pub fn rate_at(&self, t: Nanos) -> DVec3 {
        self.sample_at(t).map_or(DVec3::ZERO, |s| s.0)
    }

    /// The increment over `[t0, t1]`. Without any sample: gravity-free rest with the noise of a gap.
    pub fn integrate(&self, t0: Nanos, t1: Nanos, bg: DVec3, ba: DVec3, noise: &Noise) -> Increment {
        let mut inc = Increment::new(bg, ba);
        let Some((mut w, mut a)) = self.sample_at(t0) else {
            inc.step_between([bg, ba], [bg, ba], (t1 - t0).secs(), noise);
            return inc;
        };
        let mut t = t0;
        let mut step = |to: Nanos, w1: DVec3, a1: DVec3| {
            inc.step_between([w, a], [w1, a1], (to - t).secs(), &noise.between((w, a), (w1, a1)));
            (t, w, a) = (to, w1, a1);
        };
        for s in self.samples.range(self.after(t0)..self.after(t1)) {
            step(s.t, s.gyro_body, s.accel_body);
        }
        if let Some((w1, a1)) = self.sample_at(t1) {
            step(t1, w1, a1);
        }
        inc
    }

    /// Mean and standard deviation (norm over axes) of the last `span`, when it is covered.
    pub fn statistics(&self, until: Nanos, span: Span) -> Option<Statistics> {
        let (from, to) = (self.after(until - span), self.after(until));
        let samples = || self.samples.range(from..to);
        let n = samples().len();
        if n < 10 || (self.samples[to - 1].t - self.samples[from].t).secs() < 0.9 * span.secs() {
            return None;
        }
        let scale = 1.0 / n as f64;
        let mean = |f: fn(&ImuSample) -> DVec3| samples().map(f).fold(DVec3::ZERO, |a, b| a + b) * scale;
        let spread = |f: fn(&ImuSample) -> DVec3, m: DVec3| {
            (samples().map(|s| (f(s) - m).length_squared()).sum::<f64>() * scale).sqrt()
        };
        let (gyro, accel) = (mean(|s| s.gyro_body), mean(|s| s.accel_body));
        Some(Statistics {
            gyro,
            accel,
            gyro_sigma: spread(|s| s.gyro_body, gyro),
            accel_sigma: spread(|s| s.accel_body, accel),
        })
    }
}

/// Readings over a span: means, rad/s and m/s², and their standard deviations, norms over the axes.
#[derive(Clone, Copy, Debug)]
pub struct Statistics {
    pub gyro: DVec3,
    pub accel: DVec3,
    pub gyro_sigma: f64,
    pub accel_sigma: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ring_keeps_the_newest_and_gives_back_what_it_overwrote() {
        let mut ring = ImuRing::empty();
        let sample = |i: usize| ImuSample { t: Nanos(i as i64), ..ImuSample::default() };
        for i in 0..IMU_BETWEEN_FRAMES {
            assert!(ring.push(sample(i)).is_none());
        }
        assert_eq!(ring.push(sample(IMU_BETWEEN_FRAMES)).map(|s| s.t), Some(Nanos(0)));
        assert_eq!(ring.iter().next().map(|s| s.t), Some(Nanos(1)));
        assert_eq!(ring.iter().count(), IMU_BETWEEN_FRAMES);
    }
}
