//! One reading that cannot be motion: a bit turned over on the way from the unit.
//!
//! Judged once the next sample is there, against both neighbours. Such a reading stands out on one axis, in one sample, while
//! that axis goes on behind it as before and the other five see nothing. A shock is no such thing: it lasts, or it is felt
//! about every axis. What stands out is told by what the axis did lately, so that vibration raises its own bar.
//!
//! It takes little to be wrong in a new way here, so it is bounded: one in eight samples, eight at once, and none at the end of its
//! range, which has a meaning of its own (`Noise::between`). Bits below what stands out cost millimetres, those above did cost
//! centimetres and decimetres: `stipple-bench faults`.

use super::preintegration::Noise;
use stipple_drivers::ImuSample;

/// Of the axes in order: gyro x, y, z, accelerometer x, y, z.
const AXES: usize = 6;
/// What stands out by less is left alone, rad/s and m/s²: 0.14 degrees and 5 cm/s by a sample of 5 ms. On the flights of
/// EuRoC at hand (88 thousand samples, motors on) a lone axis stands out by 0.29 rad/s and 15.3 m/s² at most, ...
const OUT_MIN: [f64; 2] = [0.5, 10.0];
/// ... which is 8 times what it does on average in the samples before.
const OUT_LEVELS: f64 = 20.0;
/// The axis moves on by less than this share of what stands out.
const BACK: f64 = 0.5;
/// Other axes change by less than this many of their levels, and parts of `OUT_MIN`, to one neighbour or the other.
const QUIET_LEVELS: f64 = 6.0;
const QUIET: f64 = 0.05;
/// Samples over which a level is averaged; before so many nothing is judged.
const AVERAGED: u32 = 64;
/// What a repair costs, and is saved up at most, in samples.
const COST: u32 = 8;
const SAVED_MAX: u32 = 64;

fn axes(s: &ImuSample) -> [f64; AXES] {
    let (w, a) = (s.gyro_body, s.accel_body);
    [w.x, w.y, w.z, a.x, a.y, a.z]
}

/// What each axis does from sample to sample, and how many repairs are allowed.
#[derive(Clone, Copy, Debug, Default)]
pub struct Spikes {
    /// Mean distance of a reading from the middle of its neighbours.
    level: [f64; AXES],
    seen: u32,
    saved: u32,
}

impl Spikes {
    /// `now` as it must have been, if `before` and `after` say that a reading of it is none.
    pub fn repaired(
        &mut self,
        before: &ImuSample,
        now: &ImuSample,
        after: &ImuSample,
        noise: &Noise,
    ) -> Option<ImuSample> {
        if noise.is_gap((after.t - before.t).secs() * 0.5) {
            return None;
        }
        let [a, b, c] = [before, now, after].map(axes);
        // At even intervals; at uneven ones the middle is off by a part of what the axis moves on.
        let out: [f64; AXES] = std::array::from_fn(|i| (b[i] - 0.5 * (a[i] + c[i])).abs());
        let clipped = noise.clipped(now.gyro_body, now.accel_body);
        let lone = (0..AXES).find(|i| self.stands_out(*i, &a, &b, &c, out[*i]));
        let lone = lone.filter(|_| self.seen >= AVERAGED && self.saved >= COST && !(clipped.0 || clipped.1));
        self.learn(&out, lone);
        let mut repaired = *now;
        let i = lone?;
        let middle = 0.5 * (a[i] + c[i]);
        if i < 3 {
            repaired.gyro_body[i] = middle;
        } else {
            repaired.accel_body[i - 3] = middle;
        }
        self.saved -= COST;
        Some(repaired)
    }

    fn stands_out(&self, i: usize, a: &[f64; AXES], b: &[f64; AXES], c: &[f64; AXES], out: f64) -> bool {
        let quiet = |k: usize| {
            let change = (b[k] - a[k]).abs().min((c[k] - b[k]).abs());
            change <= QUIET_LEVELS * self.level[k] + QUIET * OUT_MIN[k / 3]
        };
        out > OUT_MIN[i / 3].max(OUT_LEVELS * self.level[i])
            && (c[i] - a[i]).abs() < BACK * out
            && (0..AXES).all(|k| k == i || quiet(k))
    }

    /// Levels follow what the axes do, not what is taken out of them, and no single reading raises one much.
    fn learn(&mut self, out: &[f64; AXES], lone: Option<usize>) {
        for i in (0..AXES).filter(|i| lone != Some(*i)) {
            let seen = out[i].min(3.0 * self.level[i] + 0.2 * OUT_MIN[i / 3]);
            self.level[i] += (seen - self.level[i]) / f64::from(AVERAGED);
        }
        self.seen = (self.seen + 1).min(AVERAGED);
        self.saved = (self.saved + 1).min(SAVED_MAX);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::world::{calibration, Noise as Random};
    use super::*;
    use crate::config::VioConfig;
    use glam::DVec3;
    use stipple_drivers::Nanos;

    const GRAVITY: DVec3 = DVec3::new(0.0, 0.0, 9.81);

    /// A second of a unit that turns and shakes a little, `spoil`ed, and which samples were repaired.
    fn repaired(spoil: impl Fn(usize, &mut ImuSample)) -> (Vec<ImuSample>, Vec<usize>) {
        let mut random = Random(7);
        let noise = Noise::new(&calibration().imu, &VioConfig::default());
        let mut list: Vec<ImuSample> = (0..200)
            .map(|i| {
                let turn = DVec3::new(1.0, 0.5, -2.0) * (i as f64 * 0.03).sin();
                ImuSample {
                    t: Nanos(i * 5_000_000),
                    gyro_body: turn + random.vector() * 0.02,
                    accel_body: GRAVITY + turn + random.vector() * 0.3,
                }
            })
            .collect();
        list.iter_mut().enumerate().for_each(|(i, s)| spoil(i, s));
        let (mut spikes, mut found) = (Spikes::default(), vec![]);
        for i in 1..list.len() - 1 {
            if let Some(s) = spikes.repaired(&list[i - 1], &list[i], &list[i + 1], &noise) {
                list[i] = s;
                found.push(i);
            }
        }
        (list, found)
    }

    #[test]
    fn a_high_bit_turned_over_is_taken_back_and_a_low_one_stays() {
        let plain = repaired(|_, _| {}).0;
        let (list, found) = repaired(|i, s| match i {
            100 => s.gyro_body.y += 2.2,
            120 => s.accel_body.z -= 78.0,
            140 => s.gyro_body.x += 0.03,
            160 => s.accel_body.x += 1.2,
            _ => {}
        });
        assert_eq!(found, [100, 120]);
        for i in found {
            assert!((list[i].gyro_body - plain[i].gyro_body).length() < 0.2, "{i}");
            assert!((list[i].accel_body - plain[i].accel_body).length() < 2.0, "{i}");
        }
    }

    #[test]
    fn shocks_pass() {
        let hit = |from: usize, list: &[f64], axis: DVec3| {
            let list = list.to_vec();
            move |i: usize, s: &mut ImuSample| {
                if let Some(by) = i.checked_sub(from).and_then(|k| list.get(k)) {
                    s.accel_body += axis * *by;
                    s.gyro_body += axis.cross(DVec3::new(0.3, 0.2, 0.1)) * (*by / 20.0);
                }
            }
        };
        let up = DVec3::Z;
        // A landing of three samples, of two, and one of one that is felt about every axis; the last at the end of the range.
        assert!(repaired(hit(100, &[40.0, 90.0, 30.0], up)).1.is_empty());
        assert!(repaired(hit(100, &[80.0, -50.0], up)).1.is_empty());
        assert!(repaired(hit(100, &[90.0], DVec3::new(0.2, 0.3, 0.9))).1.is_empty());
        assert!(repaired(hit(100, &[200.0], up)).1.is_empty());
        // The same three samples where nothing else feels them.
        let alone = |i: usize, s: &mut ImuSample| s.accel_body.z += [0.0, 60.0][usize::from((100..103).contains(&i))];
        assert!(repaired(alone).1.is_empty());
    }

    #[test]
    fn a_sample_at_the_end_of_its_range_is_left_as_it_is() {
        assert!(repaired(|i, s| s.gyro_body.z = if i == 100 { 34.9 } else { s.gyro_body.z }).1.is_empty());
    }

    #[test]
    fn repairs_are_bounded() {
        let found = repaired(|i, s| s.gyro_body.y += if i > 80 && i % 3 == 0 { 3.0 } else { 0.0 }).1;
        assert!(found.len() <= (SAVED_MAX / COST) as usize + 120 / COST as usize, "{found:?}");
    }
}
