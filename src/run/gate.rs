//! The gate that every frame and inertial sample passes once, before anybody uses it: stamps must grow and not jump,
//! pictures and readings must change, and what is missing is counted. Every check counts; only what would mislead the
//! estimator is refused.
//!
//! A stamp ahead of its arrival by more than `JUMP_MAX` is refused, and so is one that is not newer than the last. If that
//! is all that comes for `RELEARN`, the sensor's clock has changed for good and is believed from then on; `Clock` tells users
//! of stamps when it went back. Arrivals are on any clock that keeps going; without one, as of a recording read ahead, a
//! sample arrives at its own stamp.

use super::spikes::Spikes;
use crate::counters::{Counter, Counters};
use stipple_drivers::source::{frozen_readings, ImuReading, RANGE_END};
use stipple_drivers::{Frames, Image, ImuCalibration, ImuSample, Nanos, Span};

/// Largest step of a stamp beyond the time that passed, ns: further than a queue of frames can be behind.
pub const JUMP_MAX: Span = Span(1_000_000_000);
/// Time after which a clock that jumped is believed, ns.
pub const RELEARN: Span = Span(2_000_000_000);
/// Intervals of whose median the period is made.
const INTERVALS: usize = 15;
/// Every 61st pixel is compared to tell two pictures apart: noise changes half of them.
const PIXEL_STRIDE: usize = 61;
/// Grey levels between the darkest and the brightest pixel of a covered eye.
const BLANK_LEVELS: u8 = 6;

/// A believed stamp that is older than the last by more is of another clock: unplugged sensors come back with stamps that are a
/// little older.
const BACK_MAX: Span = Span(100_000_000);

/// What stamps are of.
#[derive(Clone, Copy)]
pub enum Stream {
    Frames,
    Samples,
}

/// The newest stamps that were believed of frames and of samples.
#[derive(Default)]
pub struct Clock([Option<Nanos>; 2]);

impl Clock {
    /// Whether a stamp that is believed is of a clock that went back. The other stream's stamps are taken to do so, too.
    pub fn went_back(&mut self, stream: Stream, t: Nanos) -> bool {
        let back = self.0[stream as usize].is_some_and(|last| last - t > BACK_MAX);
        if back {
            *self = Clock::default();
        }
        self.0[stream as usize] = Some(t);
        back
    }
}

/// The stamps of one sensor.
#[derive(Default)]
pub struct Stamps {
    /// Stamp and arrival of the last that was believed.
    last: Option<(Nanos, Nanos)>,
    /// Arrival since which nothing was believed.
    refusing: Option<Nanos>,
    intervals: [i64; INTERVALS],
    count: usize,
}

/// Where what is wrong with stamps is counted.
pub struct StampCounters<'a> {
    pub missing: &'a Counter,
    pub not_newer: &'a Counter,
    pub jumped: &'a Counter,
}

impl Stamps {
    /// After a loss its clock may be another.
    pub fn forget(&mut self) {
        self.last = None;
        self.refusing = None;
    }

    /// Median of the last intervals, ns.
    pub fn period(&self) -> Option<i64> {
        let mut sorted = self.intervals;
        sorted.sort_unstable();
        (self.count >= INTERVALS).then(|| sorted[INTERVALS / 2])
    }

    /// Whether a sample with this stamp, which arrived at `now`, is believed.
    pub fn admit(&mut self, t: Nanos, now: Nanos, counters: &StampCounters) -> bool {
        if let Some((last, at)) = self.last {
            let not_newer = t <= last;
            if not_newer || (t - last).0 > (now - at).0 + JUMP_MAX.0 {
                let since = *self.refusing.get_or_insert(now);
                if now - since < RELEARN {
                    if not_newer { counters.not_newer } else { counters.jumped }.add(1);
                    return false;
                }
            } else {
                self.follow((t - last).0, counters);
            }
        }
        self.refusing = None;
        self.last = Some((t, now));
        true
    }

    fn follow(&mut self, interval: i64, counters: &StampCounters) {
        if let Some(period) = self.period().filter(|p| interval > p + p / 2) {
            counters.missing.add(((interval + period / 2) / period - 1).max(0) as u64);
        }
        self.intervals[self.count % INTERVALS] = interval;
        self.count += 1;
    }
}

/// The frames of a rig.
pub struct FrameGate {
    pub stamps: Stamps,
    /// Pixels of the last frame, every `PIXEL_STRIDE`th.
    looks: Vec<Vec<u8>>,
    /// A camera saw nothing in it, or gave the image before once more.
    pub blank: bool,
}

impl FrameGate {
    pub fn new(shape: &Frames) -> FrameGate {
        let look = |image: &Image| vec![0; image.pixels.len().div_ceil(PIXEL_STRIDE)];
        FrameGate { stamps: Stamps::default(), looks: shape.images.iter().map(look).collect(), blank: false }
    }

    /// Whether frames that arrived at `now` are believed. A camera that hangs gives a black image while another goes on.
    pub fn admit(&mut self, frames: &mut Frames, now: Nanos, c: &Counters) -> bool {
        let counters = StampCounters {
            missing: &c.frames_missing,
            not_newer: &c.frames_not_newer,
            jumped: &c.frames_timestamp_jump,
        };
        if !self.stamps.admit(frames.t, now, &counters) {
            return false;
        }
        let (mut frozen, mut blank) = (0, false);
        for (image, look) in frames.images.iter_mut().zip(&mut self.looks) {
            let (mut same, mut low, mut high) = (true, u8::MAX, 0);
            for (px, kept) in image.pixels.iter().step_by(PIXEL_STRIDE).zip(look) {
                same &= px == kept;
                (low, high) = (low.min(*px), high.max(*px));
                *kept = *px;
            }
            let dull = high.saturating_sub(low) < BLANK_LEVELS;
            // Black twice is the dark, not a camera that hangs.
            if same && !dull {
                frozen += 1;
                image.pixels.fill(0);
            }
            blank |= dull || same;
        }
        if frozen == frames.images.len() {
            c.frames_frozen.add(1);
            return false;
        }
        self.blank = blank;
        c.frames_blank.add(u64::from(blank));
        c.images_frozen.add(frozen as u64);
        true
    }
}

/// The readings of an inertial unit.
pub struct ImuGate {
    pub stamps: Stamps,
    /// Ends of the ranges of gyro and accelerometer, rad/s and m/s².
    range: [f64; 2],
    last: Option<ImuSample>,
    repeated: u32,
    /// So many repetitions are of a unit that hangs.
    frozen_after: u32,
    /// Samples since the last one given were refused.
    refused: bool,
    spikes: Spikes,
}

impl ImuGate {
    pub fn new(imu: &ImuCalibration) -> ImuGate {
        let spikes = Spikes::new(imu.rate_hz);
        ImuGate {
            stamps: Stamps::default(),
            range: imu.range,
            last: None,
            repeated: 0,
            frozen_after: frozen_readings(imu.rate_hz),
            refused: false,
            spikes,
        }
    }

    /// Takes a reading that arrived at `now` and gives what is believed, in order: nothing, this one, or the one that was
    /// held back before it, too.
    pub fn pass(&mut self, reading: &ImuReading, now: Nanos, c: &Counters, give: &mut impl FnMut(ImuSample)) {
        let counters =
            StampCounters { missing: &c.imu_missing, not_newer: &c.imu_not_newer, jumped: &c.imu_timestamp_jump };
        let mut sample = reading.sample;
        let refused = std::mem::replace(&mut self.refused, true);
        if !sample.is_finite() {
            c.imu_rejected.add(1);
            return;
        }
        if !self.stamps.admit(sample.t, now, &counters) {
            return;
        }
        let same = |s: ImuSample| s.gyro_body == sample.gyro_body && s.accel_body == sample.accel_body;
        self.repeated = if self.last.is_some_and(same) { self.repeated + 1 } else { 0 };
        self.last = Some(sample);
        if self.repeated >= self.frozen_after {
            c.imu_frozen.add(if self.repeated == self.frozen_after { u64::from(self.repeated) } else { 1 });
            return;
        }
        let peaks = [sample.gyro_body, sample.accel_body].map(|v| v.abs().max_element());
        sample.saturated = std::array::from_fn(|i| peaks[i] >= RANGE_END * self.range[i]);
        if reading.saturated && sample.saturated == [false; 2] {
            // The unit does not say which: an end that the calibration has moved.
            sample.saturated = [true; 2];
        }
        (self.refused, sample.doubted) = (false, refused);
        c.imu_saturated.add(u64::from(sample.saturated != [false; 2]));
        c.imu_repaired.add(u64::from(self.spikes.pass(sample, give)));
    }

    /// Gives the sample that is held back, where there is one; after a loss the unit's clock may be another.
    pub fn lose(&mut self, give: &mut impl FnMut(ImuSample)) {
        self.spikes.flush(give);
        self.stamps.forget();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    /// Stamps (ms) that arrive every 20 ms: those believed, and counts of missing, not newer, jumped.
    fn believed(stamps: &[i64]) -> (Vec<i64>, [u64; 3]) {
        let mut gate = Stamps::default();
        let [missing, not_newer, jumped] = [Counter::default(), Counter::default(), Counter::default()];
        let counters = StampCounters { missing: &missing, not_newer: &not_newer, jumped: &jumped };
        let arrives = |i: usize| Nanos(20 * i as i64 * MS);
        let list = stamps.iter().enumerate();
        let kept = list.filter(|(i, t)| gate.admit(Nanos(**t * MS), arrives(*i), &counters)).map(|(_, t)| *t);
        (kept.collect(), [missing.get(), not_newer.get(), jumped.get()])
    }

    #[test]
    fn jumps_and_repetitions_are_refused_and_what_lacks_is_counted() {
        let mut stamps: Vec<i64> = (0..40).map(|i| 20 * i).collect();
        (stamps[20], stamps[25], stamps[30]) = (5000, 480, 200);
        let (kept, counts) = believed(&stamps);
        assert_eq!((kept.len(), counts), (37, [3, 2, 1]));
        let skipping: Vec<i64> = (0..60).filter(|i| !(30..34).contains(i)).map(|i| 20 * i).collect();
        assert_eq!(believed(&skipping).1, [4, 0, 0]);
    }

    #[test]
    fn a_clock_that_changed_for_good_is_believed() {
        let stamps: Vec<i64> = (0..300).map(|i| 20 * i + if i < 50 { 0 } else { 100_000 }).collect();
        let (kept, [_, _, jumped]) = believed(&stamps);
        assert_eq!((kept.len() as u64 + jumped, jumped), (300, 100));
    }

    #[test]
    fn clocks_that_go_back_together_do_so_once() {
        let mut clock = Clock::default();
        let mut back = |stream, ms: i64| clock.went_back(stream, Nanos(ms * MS));
        let (frame, sample) = (Stream::Frames, Stream::Samples);
        assert!(![back(sample, 9000), back(frame, 9000), back(sample, 8990), back(frame, 9050)].contains(&true));
        assert_eq!([back(sample, 1000), back(frame, 990), back(sample, 1005)], [true, false, false]);
    }

    #[test]
    fn a_unit_that_hangs_is_refused_and_one_repetition_is_not() {
        let (mut gate, c) = (ImuGate::new(&ImuCalibration::CONSUMER), Counters::default());
        let values = (0..100).map(|i: i32| if (50..75).contains(&i) { 50 } else { i / 2 });
        let (mut given, mut doubted) = (0, 0);
        for (i, v) in values.enumerate() {
            let (t, gyro_body) = (Nanos(i as i64 * MS), glam::DVec3::splat(f64::from(v)));
            let sample = ImuSample { t, gyro_body, ..ImuSample::default() };
            gate.pass(&ImuReading { sample, ..ImuReading::default() }, t, &c, &mut |s| {
                (given, doubted) = (given + 1, doubted + u32::from(s.doubted));
            });
        }
        assert_eq!((given, doubted, c.imu_frozen.get()), (100 - 5, 1, 24));
    }

    /// While twenty repetitions at any rate were a unit that hangs, at 4 kHz that was 5 ms.
    #[test]
    fn a_fast_unit_may_repeat_itself_as_long_as_a_slow_one() {
        for (rate_hz, repeats) in [(50.0, 20), (200.0, 20), (4000.0, 400)] {
            let (mut gate, c) =
                (ImuGate::new(&ImuCalibration { rate_hz, ..ImuCalibration::CONSUMER }), Counters::default());
            for i in 0..=repeats {
                assert_eq!(c.imu_frozen.get(), 0, "{rate_hz} Hz, {i}");
                let t = Nanos(i * (1e9 / rate_hz) as i64);
                gate.pass(
                    &ImuReading { sample: ImuSample { t, ..ImuSample::default() }, ..ImuReading::default() },
                    t,
                    &c,
                    &mut |_| {},
                );
            }
            assert_eq!(c.imu_frozen.get(), repeats as u64, "{rate_hz} Hz");
        }
    }

    #[test]
    fn the_ends_of_the_ranges_are_flagged() {
        let (mut gate, c) = (ImuGate::new(&ImuCalibration::CONSUMER), Counters::default());
        let mut flags = vec![];
        for (i, (gyro, accel, said)) in
            [(1.0, 9.8, false), (34.8, 9.8, false), (1.0, -156.5, false), (2.0, 9.8, true)].into_iter().enumerate()
        {
            let (gyro_body, accel_body) = (glam::DVec3::X * gyro, glam::DVec3::Z * accel);
            let sample = ImuSample { t: Nanos(i as i64 * MS), gyro_body, accel_body, ..ImuSample::default() };
            let reading = ImuReading { sample, saturated: said, ..ImuReading::default() };
            gate.pass(&reading, sample.t, &c, &mut |s| flags.push(s.saturated));
        }
        assert_eq!(flags, [[false, false], [true, false], [false, true], [true, true]]);
        assert_eq!(c.imu_saturated.get(), 3);
    }

    #[test]
    fn what_is_no_number_is_refused() {
        let (mut gate, c) = (ImuGate::new(&ImuCalibration::CONSUMER), Counters::default());
        let sample = ImuSample { accel_body: glam::DVec3::NAN, ..ImuSample::default() };
        gate.pass(&ImuReading { sample, ..ImuReading::default() }, Nanos(0), &c, &mut |_| panic!("given"));
        assert_eq!(c.imu_rejected.get(), 1);
    }

    /// An image of 80 by 80 pixels; one of seed 0 is black.
    fn picture(seed: u8) -> Image {
        Image { pixels: (0..6400).map(|i| (i as u8).wrapping_mul(seed)).collect(), ..Image::new(80, 80) }
    }

    #[test]
    fn a_hanging_camera_is_refused_and_a_covered_one_is_not() {
        let c = Counters::default();
        let mut gate = FrameGate::new(&Frames { images: vec![Image::new(80, 80)], ..Frames::default() });
        let black = Image::new(80, 80);
        let pictures = [picture(3), picture(5), picture(5), black.clone(), black, picture(7)];
        let admitted = pictures.into_iter().enumerate().map(|(i, image)| {
            gate.admit(
                &mut Frames { t: Nanos(i as i64 * MS), images: vec![image], colours: vec![] },
                Nanos(i as i64 * MS),
                &c,
            )
        });
        assert_eq!(admitted.collect::<Vec<_>>(), [true, true, false, true, true, true]);
        assert_eq!((c.frames_frozen.get(), c.frames_blank.get()), (1, 2));
    }

    /// Seeds of the images of two cameras; a seed of 0 is a covered camera.
    #[test]
    fn a_camera_that_hangs_is_blank_while_the_other_goes_on() {
        let c = Counters::default();
        let mut gate = FrameGate::new(&Frames { images: vec![Image::new(80, 80); 2], ..Frames::default() });
        let seeds = [[3, 5], [7, 5], [9, 5], [9, 5], [11, 13], [11, 0]];
        let given = seeds.into_iter().enumerate().map(|(i, seeds)| {
            let t = Nanos(i as i64 * MS);
            let mut frames = Frames { t, images: seeds.map(picture).to_vec(), colours: vec![] };
            let admitted = gate.admit(&mut frames, t, &c);
            let seen = frames.images.iter().zip(seeds).map(|(image, seed)| *image == picture(seed)).collect::<Vec<_>>();
            (admitted, seen[0], seen[1], gate.blank)
        });
        let expected = [
            (true, true, true, false),
            (true, true, false, true),
            (true, true, false, true),
            (false, false, false, true),
            (true, true, true, false),
            (true, false, true, true),
        ];
        assert_eq!(given.collect::<Vec<_>>(), expected);
        assert_eq!((c.frames_frozen.get(), c.images_frozen.get(), c.frames_blank.get()), (1, 3, 3));
    }
}
