//! The newest inertial samples, in a ring bought once, and their integration between two instants.
//!
//! Samples are interpolated at the ends of what is integrated; outside the samples the nearest is held.

use super::preintegration::{Increment, Noise};
use super::spikes::Spikes;
use crate::limits::IMU_BETWEEN_FRAMES;
use glam::DVec3;
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

/// The newest samples; old ones are overwritten.
#[derive(Clone, Debug)]
pub struct ImuRing {
    samples: Vec<ImuSample>,
    /// Samples ever pushed.
    count: usize,
    leap: Leap,
    spikes: Spikes,
}

impl ImuRing {
    pub fn new() -> ImuRing {
        let samples = vec![ImuSample::default(); IMU_BETWEEN_FRAMES];
        ImuRing { samples, count: 0, leap: Leap::default(), spikes: Spikes::default() }
    }

    pub const BYTES: usize = IMU_BETWEEN_FRAMES * size_of::<ImuSample>();

    /// Whether a sample is finite, newer than the last, and does not leap ahead of it.
    pub fn admits(&mut self, s: &ImuSample) -> bool {
        let last = self.newest().map(|n| n.t);
        s.is_finite() && last.is_none_or(|n| s.t > n) && !self.leap.refuses(last, s.t)
    }

    /// Returns the sample that was overwritten.
    pub fn push(&mut self, s: ImuSample) -> Option<ImuSample> {
        let at = self.count % IMU_BETWEEN_FRAMES;
        let old = (self.count >= IMU_BETWEEN_FRAMES).then(|| self.samples[at]);
        self.samples[at] = s;
        self.count += 1;
        old
    }

    /// Judges the sample before the newest; answers whether it was repaired. What was integrated up to it before stays.
    pub fn repair(&mut self, noise: &Noise) -> bool {
        if self.len() < 3 {
            return false;
        }
        let [before, now, after] = [3, 2, 1].map(|back| (self.count - back) % IMU_BETWEEN_FRAMES);
        let [a, b, c] = [before, now, after].map(|at| &self.samples[at]);
        let repaired = self.spikes.repaired(a, b, c, noise);
        if let Some(s) = repaired {
            self.samples[now] = s;
        }
        repaired.is_some()
    }

    fn len(&self) -> usize {
        self.count.min(IMU_BETWEEN_FRAMES)
    }

    /// `i` = 0 is the oldest kept.
    fn get(&self, i: usize) -> &ImuSample {
        &self.samples[(self.count - self.len() + i) % IMU_BETWEEN_FRAMES]
    }

    pub fn newest(&self) -> Option<&ImuSample> {
        self.len().checked_sub(1).map(|i| self.get(i))
    }

    #[cfg(test)]
    pub fn iter(&self) -> impl Iterator<Item = &ImuSample> {
        (0..self.len()).map(|i| self.get(i))
    }

    /// First index with a stamp after `t`.
    fn after(&self, t: Nanos) -> usize {
        let (mut lo, mut hi) = (0, self.len());
        while lo < hi {
            let mid = (lo + hi) / 2;
            if self.get(mid).t <= t {
                lo = mid + 1;
            } else {
                hi = mid;
            }
        }
        lo
    }

    /// Rate and force at `t`: linear between samples, held outside them.
    fn sample_at(&self, t: Nanos) -> Option<(DVec3, DVec3)> {
        let n = self.len();
        let next = self.after(t);
        if n == 0 {
            return None;
        }
        if next == 0 || next == n {
            let s = self.get(next.min(n - 1));
            return Some((s.gyro_body, s.accel_body));
        }
        let (a, b) = (self.get(next - 1), self.get(next));
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
            inc.step(bg, ba, (t1 - t0).secs(), noise);
            return inc;
        };
        let mut t = t0;
        let mut step = |to: Nanos, w1: DVec3, a1: DVec3| {
            inc.step_between([w, a], [w1, a1], (to - t).secs(), &noise.between((w, a), (w1, a1)));
            (t, w, a) = (to, w1, a1);
        };
        for i in self.after(t0)..self.after(t1) {
            let s = self.get(i);
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
        let n = to - from;
        if n < 10 || (self.get(to - 1).t - self.get(from).t).secs() < 0.9 * span.secs() {
            return None;
        }
        let scale = 1.0 / n as f64;
        let mean = |f: &dyn Fn(&ImuSample) -> DVec3| {
            (from..to).map(|i| f(self.get(i))).fold(DVec3::ZERO, |a, b| a + b) * scale
        };
        let gyro = mean(&|s| s.gyro_body);
        let accel = mean(&|s| s.accel_body);
        let spread = |f: &dyn Fn(&ImuSample) -> DVec3, m: DVec3| {
            ((from..to).map(|i| (f(self.get(i)) - m).length_squared()).sum::<f64>() * scale).sqrt()
        };
        Some(Statistics {
            gyro,
            accel,
            gyro_sigma: spread(&|s| s.gyro_body, gyro),
            accel_sigma: spread(&|s| s.accel_body, accel),
        })
    }
}

impl Default for ImuRing {
    fn default() -> Self {
        ImuRing::new()
    }
}

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
        let mut ring = ImuRing::new();
        let sample = |i: usize| ImuSample { t: Nanos(i as i64), ..ImuSample::default() };
        for i in 0..IMU_BETWEEN_FRAMES {
            assert!(ring.push(sample(i)).is_none());
        }
        assert_eq!(ring.push(sample(IMU_BETWEEN_FRAMES)).map(|s| s.t), Some(Nanos(0)));
        assert_eq!(ring.iter().next().map(|s| s.t), Some(Nanos(1)));
        assert_eq!(ring.iter().count(), IMU_BETWEEN_FRAMES);
    }
}
