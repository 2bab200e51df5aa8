//! The newest inertial samples, in a ring bought once, and their integration between two instants.
//!
//! Samples are interpolated at the ends of what is integrated; outside the samples the nearest is held.

use super::preintegration::{Increment, Noise};
use crate::limits::IMU_HISTORY_SECS;
use glam::DVec3;
use std::collections::VecDeque;
use stipple_drivers::{ImuSample, Nanos, Span};

/// Rate at which samples are compared with what counts as rest, Hz: noise spreads with the square root of the rate.
const REST_RATE_HZ: f64 = 200.0;

/// The newest samples, ascending stamps; old ones are overwritten.
#[derive(Clone, Debug)]
pub struct ImuRing {
    /// Never longer than `capacity`.
    samples: VecDeque<ImuSample>,
    capacity: usize,
    /// Samples in a period of `REST_RATE_HZ`, 1 at least.
    block: usize,
    /// Factors on the readings of gyro and accelerometer, less one, as estimated: without unit.
    pub scale: [DVec3; 2],
}

impl ImuRing {
    /// A ring without samples, for those of `IMU_HISTORY_SECS`.
    pub fn new(rate_hz: f64) -> ImuRing {
        let capacity = (IMU_HISTORY_SECS * rate_hz).ceil() as usize;
        let block = (rate_hz / REST_RATE_HZ).round().max(1.0) as usize;
        ImuRing { samples: VecDeque::with_capacity(capacity), capacity, block, scale: [DVec3::ZERO; 2] }
    }

    /// Whether a sample is finite and newer than the last.
    pub fn admits(&self, s: &ImuSample) -> bool {
        s.is_finite() && self.newest().is_none_or(|n| s.t > n.t)
    }

    /// Takes a sample that was admitted; returns the one that was overwritten.
    pub fn push(&mut self, s: ImuSample) -> Option<ImuSample> {
        let old = if self.samples.len() == self.capacity { self.samples.pop_front() } else { None };
        self.samples.push_back(s);
        old
    }

    /// Forgets all samples.
    pub fn clear(&mut self) {
        self.samples.clear();
    }

    /// The newest sample.
    pub fn newest(&self) -> Option<&ImuSample> {
        self.samples.back()
    }

    /// Whether no sample after `t` was overwritten.
    pub fn covers(&self, t: Nanos) -> bool {
        self.samples.front().is_some_and(|s| s.t <= t)
    }

    /// Whether the samples from `from` to `to` are there, believed and within the sensor's range.
    pub fn is_sound(&self, from: Nanos, to: Nanos, noise: &Noise) -> bool {
        let mut at = from;
        let mut sound = |s: &ImuSample| {
            let gap = noise.is_gap((s.t - at).secs());
            at = s.t;
            !gap && !s.doubted && s.saturated == [false; 2]
        };
        let all = self.samples.range(self.after(from)..self.after(to)).all(&mut sound);
        all && self.covers(from) && !noise.is_gap((to - at).secs())
    }

    #[cfg(test)]
    pub fn iter(&self) -> impl Iterator<Item = &ImuSample> {
        self.samples.iter()
    }

    /// First index with a stamp after `t`.
    fn after(&self, t: Nanos) -> usize {
        self.samples.partition_point(|s| s.t <= t)
    }

    /// The reading at `t`: linear between samples, held outside them; saturated where a sample is that it is made of.
    fn sample_at(&self, t: Nanos) -> Option<ImuSample> {
        let next = self.after(t);
        let before = next.checked_sub(1).map(|i| &self.samples[i]);
        let (Some(a), Some(b)) = (before, self.samples.get(next)) else {
            return before.or(self.samples.front()).copied();
        };
        let s = (t - a.t).secs() / (b.t - a.t).secs();
        Some(ImuSample {
            t,
            gyro_body: a.gyro_body.lerp(b.gyro_body, s),
            accel_body: a.accel_body.lerp(b.accel_body, s),
            saturated: [0, 1].map(|i| a.saturated[i] || b.saturated[i]),
            doubted: false,
        })
    }

    /// What the gyro read at `t`, rad/s; zero without any sample.
    pub fn rate_at(&self, t: Nanos) -> DVec3 {
        self.sample_at(t).map_or(DVec3::ZERO, |s| s.gyro_body)
    }

    /// The increment over `[t0, t1]` by the estimated scale.
    pub fn integrate_scaled(&self, t0: Nanos, t1: Nanos, bg: DVec3, ba: DVec3, noise: &Noise) -> Increment {
        let [gyro, accel] = self.scale;
        self.integrate(t0, t1, bg, ba, noise).rescaled(gyro, accel)
    }

    /// The increment over `[t0, t1]` of what was read. Without any sample: gravity-free rest with the noise of a gap.
    pub fn integrate(&self, t0: Nanos, t1: Nanos, bg: DVec3, ba: DVec3, noise: &Noise) -> Increment {
        let mut inc = Increment::new(bg, ba);
        inc.gravity = DVec3::NEG_Z * noise.gravity;
        let Some(mut last) = self.sample_at(t0) else {
            inc.step_between([bg, ba], [bg, ba], (t1 - t0).secs(), noise);
            return inc;
        };
        let mut t = t0;
        let mut step = |to: Nanos, s: &ImuSample| {
            let (a, b) = ([last.gyro_body, last.accel_body], [s.gyro_body, s.accel_body]);
            inc.step_between(a, b, (to - t).secs(), &noise.between(last.saturated, s.saturated));
            (t, last) = (to, *s);
        };
        for s in self.samples.range(self.after(t0)..self.after(t1)) {
            step(s.t, s);
        }
        if let Some(end) = self.sample_at(t1) {
            step(t1, &end);
        }
        inc
    }

    /// Mean by the estimated scale, and standard deviation (norm over axes) at `REST_RATE_HZ`, of the last `span`, when it
    /// is covered.
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
            let blocks = (from..to).step_by(self.block).map(|i| self.samples.range(i..to.min(i + self.block)));
            let scale = 1.0 / blocks.len() as f64;
            let off =
                blocks.map(|b| (b.len() as f64, b.map(f).fold(DVec3::ZERO, |a, b| a + b))).map(|(n, s)| s / n - m);
            (off.map(|x| x.length_squared()).sum::<f64>() * scale).sqrt()
        };
        let (gyro, accel) = (mean(|s| s.gyro_body), mean(|s| s.accel_body));
        Some(Statistics {
            gyro: gyro * (1.0 + self.scale[0]),
            accel: accel * (1.0 + self.scale[1]),
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
    use super::super::inertial::Motion;
    use super::*;
    use crate::config::VioConfig;
    use stipple_drivers::ImuCalibration;

    #[test]
    fn ring_keeps_the_newest_and_gives_back_what_it_overwrote() {
        let mut ring = ImuRing::new(200.0);
        let n = 512;
        let sample = |i: usize| ImuSample { t: Nanos(i as i64), ..ImuSample::default() };
        for i in 0..n {
            assert!(ring.push(sample(i)).is_none());
        }
        assert_eq!(ring.push(sample(n)).map(|s| s.t), Some(Nanos(0)));
        assert_eq!(ring.iter().next().map(|s| s.t), Some(Nanos(1)));
        assert_eq!(ring.iter().count(), n);
    }

    #[test]
    fn history_is_as_long_at_four_kilohertz() {
        let mut ring = ImuRing::new(4000.0);
        for i in 0..20_000 {
            let _ = ring.push(ImuSample { t: Nanos(i * 250_000), ..ImuSample::default() });
        }
        let until = Nanos(19_999 * 250_000);
        assert!(ring.statistics(until, Span::from_secs(2.5)).is_some());
    }

    #[test]
    fn unit_at_rest_stands_still_in_the_gravity_of_the_board() {
        let config = VioConfig { gravity: 9.78, ..VioConfig::default() };
        let noise = Noise::new(&ImuCalibration::CONSUMER, &config);
        let mut ring = ImuRing::new(200.0);
        let accel_body = DVec3::Z * 9.78;
        for i in 0..200 {
            let _ = ring.push(ImuSample { t: Nanos(i * 5_000_000), accel_body, ..ImuSample::default() });
        }
        let inc = ring.integrate(Nanos(0), Nanos(900_000_000), DVec3::ZERO, DVec3::ZERO, &noise);
        let moved = Motion::default().propagate(&inc);
        assert!(moved.pose.p.length() < 1e-9 && moved.v.length() < 1e-9, "{moved:?}");
    }
}
