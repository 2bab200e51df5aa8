//! Gyro and accelerometer of two dies, or of two kernel devices, joined into one stream: each gyro sample with the
//! accelerometer interpolated to its time between the two neighbours. It waits for the later neighbour, which is one
//! sample, and does not bridge gaps.

use crate::source::{ImuBatch, ImuReading, IMU_BATCH};
use crate::types::{ImuSample, Nanos, Span};
use glam::DVec3;
use std::collections::VecDeque;

/// A sample of a unit, or of half of one: rad/s, m/s².
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct Reading {
    /// Instant of the sample.
    pub t: Nanos,
    /// Angular velocity in the body frame, rad/s.
    pub gyro: Option<DVec3>,
    /// Specific force in the body frame, m/s².
    pub accel: Option<DVec3>,
    pub temperature_c: Option<f32>,
    /// An axis stands at the end of its range.
    pub saturated: bool,
}

impl Reading {
    /// The sample, where both sensors are there.
    fn whole(self) -> Option<ImuReading> {
        let sample = ImuSample { t: self.t, gyro_body: self.gyro?, accel_body: self.accel?, ..ImuSample::default() };
        Some(ImuReading { sample, temperature_c: self.temperature_c, saturated: self.saturated })
    }
}

/// Passes a reading on: of a whole unit into the batch, of half a unit into its merge.
pub fn pass(merge: &mut Option<Merge>, batch: &mut ImuBatch, reading: Reading) {
    match merge {
        Some(merge) => merge.push(reading),
        None => {
            let pushed = reading.whole().map_or(Ok(()), |whole| batch.push(whole));
            debug_assert!(pushed.is_ok(), "a batch holds more than one read");
        }
    }
}

/// The halves that wait for each other.
#[derive(Clone, Debug)]
pub struct Merge {
    gyro: VecDeque<Reading>,
    accel: VecDeque<Reading>,
    /// Longest distance between neighbours to interpolate across.
    hole: Span,
    temperature_c: Option<f32>,
    /// Gyro samples that were dropped because no accelerometer samples were beside them.
    pub unpaired: u64,
}

impl Merge {
    /// A merge of a gyro with an accelerometer of this period.
    pub fn new(accel_period: Span) -> Merge {
        // Three periods: a sample lost here and there is no hole.
        let hole = Span(accel_period.0.saturating_mul(3));
        let queue = || VecDeque::with_capacity(IMU_BATCH);
        Merge { gyro: queue(), accel: queue(), hole, temperature_c: None, unpaired: 0 }
    }

    /// Forgets the halves that wait; gyro samples among them count as unpaired.
    pub fn clear(&mut self) {
        self.unpaired += self.gyro.len() as u64;
        self.gyro.clear();
        self.accel.clear();
    }

    /// Takes a reading of either half. A full queue drops its oldest: a gyro sample then was unpaired.
    pub fn push(&mut self, reading: Reading) {
        self.temperature_c = reading.temperature_c.or(self.temperature_c);
        let queue = if reading.gyro.is_some() { &mut self.gyro } else { &mut self.accel };
        if queue.len() == IMU_BATCH {
            queue.pop_front();
            self.unpaired += u64::from(reading.gyro.is_some());
        }
        queue.push_back(reading);
    }

    /// Moves what can be joined into the batch, as far as there is room.
    pub fn drain(&mut self, batch: &mut ImuBatch) {
        while !batch.is_full() {
            let Some(gyro) = self.gyro.front().copied() else { return };
            // The older neighbour: the last accelerometer sample not after it.
            while self.accel.get(1).is_some_and(|next| next.t <= gyro.t) {
                self.accel.pop_front();
            }
            let older = self.accel.front().filter(|a| a.t <= gyro.t);
            let joined = match (older, self.accel.get(1), self.accel.front()) {
                (Some(a), _, _) if a.t == gyro.t => join(a, a, gyro),
                (Some(a), Some(b), _) if b.t - a.t <= self.hole => join(a, b, gyro),
                // The later neighbour may still come.
                (Some(_), None, _) | (None, _, None) => return,
                // Before the first, or in a hole.
                _ => None,
            };
            self.gyro.pop_front();
            match joined {
                Some(mut reading) => {
                    reading.temperature_c = reading.temperature_c.or(self.temperature_c);
                    let pushed = batch.push(reading);
                    debug_assert!(pushed.is_ok(), "there was room");
                }
                None => self.unpaired += 1,
            }
        }
    }
}

/// The gyro's sample with the accelerometer on the line from `a` to `b`.
fn join(a: &Reading, b: &Reading, gyro: Reading) -> Option<ImuReading> {
    let length = (b.t - a.t).secs();
    let s = if length > 0.0 { (gyro.t - a.t).secs() / length } else { 0.0 };
    let accel = Some(a.accel?.lerp(b.accel?, s));
    Reading { accel, saturated: gyro.saturated || a.saturated || b.saturated, ..gyro }.whole()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const PERIOD: Span = Span(10);

    fn gyro(t: i64) -> Reading {
        Reading { t: Nanos(t), gyro: Some(DVec3::splat(t as f64)), ..Reading::default() }
    }

    fn accel(t: i64) -> Reading {
        Reading { t: Nanos(t), accel: Some(DVec3::splat(2.0 * t as f64)), ..Reading::default() }
    }

    fn drained(merge: &mut Merge) -> Vec<(i64, f64)> {
        let mut batch = ImuBatch::default();
        merge.drain(&mut batch);
        batch.iter().map(|r| (r.sample.t.0, r.sample.accel_body.x.round())).collect()
    }

    #[test]
    fn the_accelerometer_is_brought_to_the_gyros_time() {
        let mut merge = Merge::new(PERIOD);
        [accel(0), gyro(3), gyro(10), accel(10), gyro(14)].into_iter().for_each(|r| merge.push(r));
        assert_eq!(drained(&mut merge), [(3, 6.0), (10, 20.0)]);
        assert_eq!(drained(&mut merge), [], "the later neighbour of 14 has not come");
        merge.push(Reading { saturated: true, temperature_c: Some(30.0), ..accel(20) });
        let mut batch = ImuBatch::default();
        merge.drain(&mut batch);
        assert!(batch.len() == 1 && batch[0].saturated && batch[0].temperature_c == Some(30.0));
        assert!((batch[0].sample.accel_body.x - 28.0).abs() < 1e-12);
    }

    #[test]
    fn holes_are_not_bridged() {
        let mut merge = Merge::new(PERIOD);
        [gyro(-5), accel(0), gyro(3), gyro(50), accel(100), accel(110), gyro(105)]
            .into_iter()
            .for_each(|r| merge.push(r));
        assert_eq!(drained(&mut merge), [(105, 210.0)]);
        assert_eq!(merge.unpaired, 3);
    }

    proptest! {
        #[test]
        fn nothing_is_given_twice_or_out_of_order(steps in proptest::collection::vec((any::<bool>(), 1i64..40), 0..900)) {
            let mut merge = Merge::new(PERIOD);
            let (mut t, mut seen, mut gyros) = ([0, 0], vec![], 0);
            for (of_gyro, dt) in steps {
                t[usize::from(of_gyro)] += dt;
                merge.push(if of_gyro { gyro(t[1]) } else { accel(t[0]) });
                gyros += u64::from(of_gyro);
                seen.extend(drained(&mut merge));
            }
            for (t, a) in &seen {
                prop_assert!((a - 2.0 * *t as f64).abs() < 0.5, "a line is interpolated exactly");
            }
            prop_assert!(seen.windows(2).all(|w| w[0].0 < w[1].0));
            prop_assert_eq!(seen.len() as u64 + merge.unpaired + merge.gyro.len() as u64, gyros);
        }
    }
}
