//! Repair of one reading that cannot be motion: a bit turned over on the way from the unit.
//!
//! Judged once the next sample is there, against both neighbours. Such a reading stands out on one axis, in one sample, while
//! that axis goes on behind it as before and the other five see nothing. A shock is no such thing: it lasts, or it is felt
//! about every axis. What stands out is told by what the axis did lately, so that vibration raises its own bar.
//!
//! It takes little to be wrong in a new way here, so it is bounded: one in eight samples, eight at once, and none at the end of its
//! range, which has a meaning of its own. Bits below what stands out cost millimetres, those above did cost
//! centimetres and decimetres: `stipple-bench faults`.

use stipple_drivers::{ImuSample, Span};

/// Axes in order: gyro x, y, z, accelerometer x, y, z.
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
/// Neighbours further apart than so many periods tell nothing of each other.
const PERIODS_MAX: f64 = 4.0;
/// What a repair costs, and is saved up at most, in samples.
const COST: u32 = 8;
const SAVED_MAX: u32 = 64;

fn axes(s: &ImuSample) -> [f64; AXES] {
    let (w, a) = (s.gyro_body, s.accel_body);
    [w.x, w.y, w.z, a.x, a.y, a.z]
}

/// The samples of one unit on their way through: what each axis does from sample to sample, and how many repairs are allowed.
#[derive(Clone, Debug)]
pub struct Spikes {
    /// Neighbours further apart than this tell nothing of each other.
    interval_max: Span,
    /// The two samples before the next, repaired; the later one may be held back.
    last: [Option<ImuSample>; 2],
    held: bool,
    /// Mean distance of a reading from the middle of its neighbours.
    level: [f64; AXES],
    seen: u32,
    saved: u32,
}

impl Spikes {
    pub fn new(rate_hz: f64) -> Spikes {
        let interval_max = Span::from_secs(PERIODS_MAX / rate_hz);
        Spikes { interval_max, last: [None; 2], held: false, level: [0.0; AXES], seen: 0, saved: 0 }
    }

    /// Takes a sample and gives those that are judged; answers whether one of them was repaired. A sample that jumps is held
    /// back until the next one tells what it was.
    pub fn pass(&mut self, sample: ImuSample, give: &mut impl FnMut(ImuSample)) -> bool {
        let mut repaired = None;
        if let [Some(before), Some(now)] = self.last {
            repaired = self.judge(&before, &now, &sample);
        }
        let [_, now] = &mut self.last;
        *now = repaired.or(*now);
        self.flush(give);
        self.last.rotate_left(1);
        self.last[1] = Some(sample);
        self.held = self.jumps();
        if !self.held {
            give(sample);
        }
        repaired.is_some()
    }

    /// Gives the sample that is held back, where there is one: none comes for long.
    pub fn flush(&mut self, give: &mut impl FnMut(ImuSample)) {
        if let (true, Some(sample)) = (std::mem::take(&mut self.held), self.last[1]) {
            give(sample);
        }
    }

    /// Whether the newest sample may turn out to be a spike. What stands out by `d` of the middle of its neighbours, which
    /// are at most `BACK d` apart, is at least `(1 - BACK / 2) d` from each.
    fn jumps(&self) -> bool {
        let [Some(before), Some(now)] = &self.last else { return false };
        let (a, b) = (axes(before), axes(now));
        let far = |i: usize| (b[i] - a[i]).abs() > (1.0 - 0.5 * BACK) * self.out_min(i);
        self.may_repair() && now.t - before.t <= self.interval_max && (0..AXES).any(far)
    }

    fn may_repair(&self) -> bool {
        self.seen >= AVERAGED && self.saved >= COST
    }

    /// Least distance from the middle of its neighbours at which a reading of an axis stands out.
    fn out_min(&self, axis: usize) -> f64 {
        OUT_MIN[axis / 3].max(OUT_LEVELS * self.level[axis])
    }

    /// `now` as it must have been, if its neighbours say that a reading of it is none.
    fn judge(&mut self, before: &ImuSample, now: &ImuSample, after: &ImuSample) -> Option<ImuSample> {
        if (after.t - before.t).secs() > 2.0 * self.interval_max.secs() {
            return None;
        }
        let [a, b, c] = [before, now, after].map(axes);
        // At even intervals; at uneven ones the middle is off by a part of what the axis moves on.
        let out: [f64; AXES] = std::array::from_fn(|i| (b[i] - 0.5 * (a[i] + c[i])).abs());
        let lone = (0..AXES).find(|i| self.held && self.stands_out(*i, &a, &b, &c, out[*i]));
        let lone = lone.filter(|_| self.may_repair() && now.saturated == [false; 2]);
        self.learn(&out, lone);
        let i = lone?;
        let middle = 0.5 * (a[i] + c[i]);
        let mut repaired = ImuSample { doubted: true, ..*now };
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
        out > self.out_min(i) && (c[i] - a[i]).abs() < BACK * out && (0..AXES).all(|k| k == i || quiet(k))
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
    use super::*;
    use crate::world::Noise;
    use glam::DVec3;
    use stipple_drivers::Nanos;

    const GRAVITY: DVec3 = DVec3::new(0.0, 0.0, 9.81);

    /// A second of a unit that turns and shakes a little, `spoil`ed, and which samples were repaired.
    fn repaired(spoil: impl Fn(usize, &mut ImuSample)) -> (Vec<ImuSample>, Vec<usize>) {
        let mut random = Noise(7);
        let mut list: Vec<ImuSample> = (0..200)
            .map(|i| {
                let turn = DVec3::new(1.0, 0.5, -2.0) * (i as f64 * 0.03).sin();
                ImuSample {
                    t: Nanos(i * 5_000_000),
                    gyro_body: turn + random.vector() * 0.02,
                    accel_body: GRAVITY + turn + random.vector() * 0.3,
                    ..ImuSample::default()
                }
            })
            .collect();
        for (i, s) in list.iter_mut().enumerate() {
            spoil(i, s);
            s.saturated[1] = s.accel_body.abs().max_element() > 150.0;
        }
        let (mut spikes, mut given, mut found) = (Spikes::new(200.0), vec![], vec![]);
        for (i, s) in list.iter().enumerate() {
            if spikes.pass(*s, &mut |s| given.push(s)) {
                found.push(i - 1);
            }
        }
        spikes.flush(&mut |s| given.push(s));
        assert_eq!(given.len(), list.len(), "each is given once");
        assert!(given.is_sorted_by_key(|s| s.t));
        (given, found)
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
            assert!(list[i].doubted && !list[i + 1].doubted, "{i}");
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
        assert!(repaired(|i, s| if i == 100 {
            (s.gyro_body.z, s.saturated) = (34.9, [true, false])
        })
        .1
        .is_empty());
    }

    #[test]
    fn repairs_are_bounded() {
        let found = repaired(|i, s| s.gyro_body.y += if i > 80 && i % 3 == 0 { 3.0 } else { 0.0 }).1;
        assert!(found.len() <= (SAVED_MAX / COST) as usize + 120 / COST as usize, "{found:?}");
    }
}
