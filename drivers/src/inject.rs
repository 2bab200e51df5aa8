//! Faults on purpose: wraps a source, and makes it drop, delay, duplicate, freeze, flip bits, go dark, fall silent,
//! leap in time or come unplugged.
//!
//! Rules come from a board's `[inject]` or from a test. Each names a fault and when it strikes: in a window of the
//! source's own time, with a probability, or both; by a seed, so the same frames are struck every time. Counters
//! say exactly what was done, so that what was detected can be held against it.

use crate::source::{FrameSource, ImuBatch, ImuReading, ImuSource, SourceFault, Wait};
use crate::types::{Frames, Nanos, Span};
use crate::{Fault, FaultKind};
use glam::DVec3;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use std::time::{Duration, Instant};

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Withheld.
    Drop,
    /// Delivered `by_s` late, under its right stamp.
    Delay,
    /// Delivered twice.
    Duplicate,
    /// What was measured before, under a new stamp.
    Freeze,
    /// One bit, or `bits`, of every image, or one of one axis of a 16-bit unit.
    BitFlip,
    /// Black images.
    Blackout,
    /// Silence.
    Gap,
    /// A stamp `by_s` off.
    StampJump,
    /// Lost, as with the cable out.
    Unplug,
}

impl Kind {
    pub const ALL: [Kind; 9] = [
        Kind::Drop,
        Kind::Delay,
        Kind::Duplicate,
        Kind::Freeze,
        Kind::BitFlip,
        Kind::Blackout,
        Kind::Gap,
        Kind::StampJump,
        Kind::Unplug,
    ];
    const FRAMES: [&'static str; 9] = [
        "injected_frames_dropped",
        "injected_frames_delayed",
        "injected_frames_duplicated",
        "injected_frames_frozen",
        "injected_frames_flipped",
        "injected_frames_blacked_out",
        "injected_frames_silenced",
        "injected_frames_jumped",
        "injected_frames_unplugged",
    ];
    const IMU: [&'static str; 9] = [
        "injected_imu_dropped",
        "injected_imu_delayed",
        "injected_imu_duplicated",
        "injected_imu_frozen",
        "injected_imu_flipped",
        "injected_imu_blacked_out",
        "injected_imu_silenced",
        "injected_imu_jumped",
        "injected_imu_unplugged",
    ];

    fn withholds(self) -> bool {
        matches!(self, Kind::Drop | Kind::Gap | Kind::Unplug)
    }
}

/// A fault, and when it strikes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rule {
    pub fault: Kind,
    /// From when until when, after the source's first stamp, s.
    #[serde(default)]
    pub start_s: f64,
    #[serde(default = "forever")]
    pub end_s: f64,
    /// Of each frame or sample in the window.
    #[serde(default = "always")]
    pub probability: f64,
    /// How long it lasts once it strikes, s; 0: for the one frame or sample.
    #[serde(default)]
    pub length_s: f64,
    /// Of `delay` and `stamp_jump`, s.
    #[serde(default)]
    pub by_s: f64,
    /// Of `blackout` and `unplug`: this camera alone, while the others go on.
    #[serde(default)]
    pub camera: Option<usize>,
    /// Of `bit_flip`, in each image.
    #[serde(default = "one")]
    pub bits: u32,
}

fn one() -> u32 {
    1
}

fn forever() -> f64 {
    f64::INFINITY
}

fn always() -> f64 {
    1.0
}

impl Rule {
    /// Strikes everything in `[start_s, end_s)`.
    pub fn within(fault: Kind, start_s: f64, end_s: f64) -> Rule {
        Rule { fault, start_s, end_s, probability: 1.0, length_s: 0.0, by_s: 0.0, camera: None, bits: 1 }
    }

    /// What is wrong with it.
    pub fn check(&self) -> Result<(), &'static str> {
        let needs_by = matches!(self.fault, Kind::Delay | Kind::StampJump);
        match self {
            _ if !(0.0..=1.0).contains(&self.probability) => Err("probability must be 0 to 1"),
            _ if !(self.start_s >= 0.0 && self.end_s > self.start_s) => {
                Err("end_s must exceed start_s, and neither be negative")
            }
            _ if !(self.length_s >= 0.0 && self.length_s.is_finite()) => Err("length_s must not be negative"),
            _ if needs_by && !(self.by_s.is_finite() && self.by_s != 0.0) => Err("this fault needs by_s, in seconds"),
            _ if self.fault == Kind::Delay && self.by_s < 0.0 => Err("a delay is not negative"),
            _ if self.camera.is_some() && !matches!(self.fault, Kind::Blackout | Kind::Unplug) => {
                Err("only blackout and unplug strike one camera alone")
            }
            _ => Ok(()),
        }
    }
}

/// What is said of who is, and what to do.
const UNPLUGGED: (&str, &str) = ("unplugged by [inject]", "it comes back as the rule says");

/// Rules under way.
struct Plan {
    rules: Vec<(Rule, Option<Nanos>)>,
    rng: ChaCha8Rng,
    first: Option<Nanos>,
    counts: [u64; Kind::ALL.len()],
    unplugs: u64,
    unplugged: bool,
    /// A camera is, and the others are not.
    away: Option<Fault>,
    place: &'static str,
}

impl Plan {
    fn new(rules: &[Rule], seed: u64, place: &'static str) -> Plan {
        Plan {
            rules: rules.iter().map(|r| (*r, None)).collect(),
            rng: ChaCha8Rng::seed_from_u64(seed),
            first: None,
            counts: [0; Kind::ALL.len()],
            unplugs: 0,
            unplugged: false,
            away: None,
            place,
        }
    }

    fn has(&self, kind: Kind) -> bool {
        self.rules.iter().any(|(r, _)| r.fault == kind)
    }

    /// Counts, and calls `act` with each rule that strikes at `t`. A fault that withholds strikes alone.
    fn strike(&mut self, t: Nanos, mut act: impl FnMut(&Rule, &mut ChaCha8Rng)) {
        let first = *self.first.get_or_insert(t);
        let at_s = (t - first).secs();
        let (mut unplugged, mut one) = (false, None);
        for (rule, until) in &mut self.rules {
            let lasts = until.is_some_and(|end| t < end);
            let within = at_s >= rule.start_s && at_s < rule.end_s;
            let strikes = lasts || within && self.rng.random::<f64>() < rule.probability;
            if !strikes {
                continue;
            }
            if !lasts {
                *until = Some(t + Span::from_secs(rule.length_s));
            }
            self.counts[rule.fault as usize] += 1;
            act(rule, &mut self.rng);
            if let (Kind::Unplug, Some(camera)) = (rule.fault, rule.camera) {
                one = Some(camera);
            } else if rule.fault.withholds() {
                unplugged = rule.fault == Kind::Unplug;
                break;
            }
        }
        let was = self.unplugged || self.away.is_some();
        self.unplugs += u64::from((unplugged || one.is_some()) && !was);
        self.unplugged = unplugged;
        if self.away.is_some() != one.is_some() {
            let fault = |c| Fault::new(FaultKind::Unavailable, format!("camera {c}"), UNPLUGGED.0, UNPLUGGED.1);
            self.away = one.map(fault);
        }
    }

    /// Asks until something of what the source gave is left, or `timeout` is over. `ask` waits that long at most, spoils what
    /// came, and says whether any of it is delivered.
    fn pass(
        &mut self,
        timeout: Span,
        mut ask: impl FnMut(&mut Plan, Span) -> Result<(Wait, bool), SourceFault>,
    ) -> Result<Wait, SourceFault> {
        let limit = Instant::now() + Duration::from_nanos(timeout.0.max(0) as u64);
        loop {
            let was_unplugged = self.unplugged;
            match ask(self, Span(limit.saturating_duration_since(Instant::now()).as_nanos() as i64))? {
                (Wait::Got, true) => return Ok(Wait::Got),
                (Wait::Got, _) if self.unplugged && !was_unplugged => return Err(self.lost()),
                (Wait::Got, _) if Instant::now() < limit => {}
                (Wait::Ended, _) => return Ok(Wait::Ended),
                _ if self.unplugged => return Err(self.lost()),
                _ => return Ok(Wait::TimedOut),
            }
        }
    }

    fn lost(&self) -> SourceFault {
        SourceFault::Lost(Fault::new(FaultKind::Unavailable, self.place, UNPLUGGED.0, UNPLUGGED.1))
    }

    fn counters(&self, names: &[&'static str; Kind::ALL.len()], unplugs: &'static str) -> Vec<(&'static str, u64)> {
        let mut list: Vec<_> = names.iter().copied().zip(self.counts).filter(|(_, n)| *n > 0).collect();
        if self.unplugs > 0 {
            list.push((unplugs, self.unplugs));
        }
        list
    }
}

fn sleep(secs: f64) {
    std::thread::sleep(Duration::from_secs_f64(secs.max(0.0)));
}

/// A rig that fails.
pub struct FaultyFrames<S> {
    source: S,
    plan: Plan,
    last: LastFrames,
}

/// What was delivered last, for who freezes or comes twice.
struct LastFrames {
    frames: Frames,
    kept: bool,
    again: bool,
}

impl<S: FrameSource> FaultyFrames<S> {
    /// `shape` is that of the frames it will be lent.
    pub fn new(source: S, rules: &[Rule], seed: u64, shape: Frames) -> FaultyFrames<S> {
        let plan = Plan::new(rules, seed, "camera");
        let kept = plan.has(Kind::Freeze) || plan.has(Kind::Duplicate);
        FaultyFrames { source, plan, last: LastFrames { frames: shape, kept, again: false } }
    }
}

impl LastFrames {
    /// Whether the frame is delivered.
    fn spoil(&mut self, plan: &mut Plan, frames: &mut Frames) -> bool {
        let (mut delivered, mut frozen, mut late_s) = (true, false, 0.0);
        let (last, again) = (&self.frames, &mut self.again);
        plan.strike(frames.t, |rule, rng| match rule.fault {
            Kind::Unplug | Kind::Blackout if rule.camera.is_some() => {
                let camera = rule.camera.unwrap_or_default();
                let colours = frames.colours.get_mut(camera).into_iter().flatten();
                frames.images.get_mut(camera).into_iter().chain(colours).for_each(|image| image.pixels.fill(0));
            }
            Kind::Drop | Kind::Gap | Kind::Unplug => delivered = false,
            Kind::Delay => late_s += rule.by_s,
            Kind::Duplicate => *again = true,
            Kind::Freeze => {
                let t = frames.t;
                frames.copy_from(last);
                frames.t = t;
                frozen = true;
            }
            Kind::BitFlip => {
                for image in &mut frames.images {
                    for _ in 0..rule.bits {
                        let at = rng.random_range(0..image.pixels.len());
                        image.pixels[at] ^= 1 << rng.random_range(0..8);
                    }
                }
            }
            Kind::Blackout => {
                let planes = frames.images.iter_mut().chain(frames.colours.iter_mut().flatten());
                planes.for_each(|image| image.pixels.fill(0));
            }
            Kind::StampJump => frames.t = frames.t + Span::from_secs(rule.by_s),
        });
        if delivered && self.kept && !frozen {
            self.frames.copy_from(frames);
        }
        self.frames.t = frames.t;
        sleep(late_s);
        delivered
    }
}

impl<S: FrameSource> FrameSource for FaultyFrames<S> {
    fn next(&mut self, timeout: Span, frames: &mut Frames) -> Result<Wait, SourceFault> {
        let FaultyFrames { source, plan, last } = self;
        if std::mem::take(&mut last.again) {
            frames.copy_from(&last.frames);
            return Ok(Wait::Got);
        }
        plan.pass(timeout, |plan, left| {
            let wait = source.next(left, frames)?;
            Ok((wait, wait == Wait::Got && last.spoil(plan, frames)))
        })
    }

    fn away(&self) -> Option<&Fault> {
        self.plan.away.as_ref().or_else(|| self.source.away())
    }

    fn counters(&self) -> Vec<(&'static str, u64)> {
        let mut list = self.source.counters();
        list.extend(self.plan.counters(&Kind::FRAMES, "injected_camera_unplugs"));
        list
    }

    fn warnings(&self) -> &[String] {
        self.source.warnings()
    }
}

/// Ends of the range of the 16-bit registers in which bits flip: 2000 °/s, 16 g.
const GYRO_RANGE: f64 = 34.907;
const ACCEL_RANGE: f64 = 156.91;

/// An inertial unit that fails.
pub struct FaultyImu<S> {
    source: S,
    plan: Plan,
    last: ImuReading,
}

impl<S: ImuSource> FaultyImu<S> {
    pub fn new(source: S, rules: &[Rule], seed: u64) -> FaultyImu<S> {
        // Another stream than the cameras'.
        FaultyImu { source, plan: Plan::new(rules, seed ^ 0x494D_5500, "imu"), last: ImuReading::default() }
    }
}

/// Leaves in `batch` what is delivered of it; `last` is the reading before.
fn spoil(batch: &mut ImuBatch, last: &mut ImuReading, plan: &mut Plan) {
    let mut spoilt = ImuBatch::default();
    let mut late_s: f64 = 0.0;
    for reading in batch.iter() {
        let (mut out, mut delivered, mut twice) = (*reading, true, false);
        plan.strike(reading.sample.t, |rule, rng| match rule.fault {
            Kind::Drop | Kind::Gap | Kind::Unplug => delivered = false,
            Kind::Delay => late_s = late_s.max(rule.by_s),
            Kind::Duplicate => twice = true,
            Kind::Freeze => {
                let t = out.sample.t;
                out = *last;
                out.sample.t = t;
            }
            Kind::BitFlip => flip(&mut out, rng),
            // Refused where rules are read: a unit has no light.
            Kind::Blackout => {}
            Kind::StampJump => out.sample.t = out.sample.t + Span::from_secs(rule.by_s),
        });
        for _ in 0..if delivered { 1 + u32::from(twice) } else { 0 } {
            // A FIFO that full is not doubled; what is in it is delivered.
            let _ = spoilt.push(out);
            *last = out;
        }
    }
    *batch = spoilt;
    sleep(late_s);
}

fn flip(reading: &mut ImuReading, rng: &mut ChaCha8Rng) {
    let axis = rng.random_range(0..3);
    let one = |v: &mut DVec3, range: f64, bit: u32| {
        let raw = (v[axis] / range * 32768.0).round().clamp(-32768.0, 32767.0) as i16;
        v[axis] = f64::from(raw ^ (1i16 << bit)) * range / 32768.0;
    };
    let bit = rng.random_range(0..16);
    if rng.random::<bool>() {
        one(&mut reading.sample.gyro_body, GYRO_RANGE, bit);
    } else {
        one(&mut reading.sample.accel_body, ACCEL_RANGE, bit);
    }
}

impl<S: ImuSource> ImuSource for FaultyImu<S> {
    fn next(&mut self, timeout: Span, batch: &mut ImuBatch) -> Result<Wait, SourceFault> {
        let FaultyImu { source, plan, last } = self;
        plan.pass(timeout, |plan, left| {
            let wait = source.next(left, batch)?;
            spoil(batch, last, plan);
            Ok((wait, !batch.is_empty()))
        })
    }

    fn counters(&self) -> Vec<(&'static str, u64)> {
        let mut list = self.source.counters();
        list.extend(self.plan.counters(&Kind::IMU, "injected_imu_unplugs"));
        list
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::paced::{Images, Pace, PacedFrames, PacedImu};
    use crate::types::{Image, ImuSample};
    use std::sync::Arc;

    const MS: i64 = 1_000_000;
    const FRAMES: i64 = 100;

    fn shape() -> Frames {
        Frames { images: vec![Image::new(4, 4)], ..Frames::default() }
    }

    /// Frames of 20 ms whose pixels say their number, ten times as fast.
    fn camera(rules: &[Rule]) -> FaultyFrames<PacedFrames> {
        let frame = |i: i64| {
            let image = Image { pixels: vec![i as u8 + 1; 16], ..Image::new(4, 4) };
            Frames { t: Nanos(i * 20 * MS), images: vec![image], colours: vec![] }
        };
        let frames: Vec<Frames> = (0..FRAMES).map(frame).collect();
        let stamps: Vec<Nanos> = frames.iter().map(|f| f.t).collect();
        let source = PacedFrames::new(Images::Rendered(frames), stamps, Pace::at_speed(Nanos(0), 10.0));
        FaultyFrames::new(source, rules, 7, shape())
    }

    /// Number by stamp and by pixel of every frame delivered, and how often it was lost.
    fn seen(source: &mut impl FrameSource) -> (Vec<(i64, u8)>, u32) {
        let (mut frames, mut seen, mut lost) = (shape(), vec![], 0);
        loop {
            match source.next(Span(20 * MS), &mut frames) {
                Ok(Wait::Got) => seen.push((frames.t.0 / (20 * MS), frames.images[0].pixels[5])),
                Ok(Wait::TimedOut) => {}
                Ok(Wait::Ended) => return (seen, lost),
                Err(SourceFault::Lost(_)) => lost += 1,
                Err(e) => panic!("{e}"),
            }
        }
    }

    fn count(list: &[(&'static str, u64)], name: &str) -> u64 {
        list.iter().find(|(n, _)| *n == name).map_or(0, |(_, n)| *n)
    }

    #[test]
    fn faults_strike_their_window_and_are_counted_exactly() {
        let mut source = camera(&[
            Rule::within(Kind::Drop, 0.1, 0.2),
            Rule::within(Kind::Freeze, 0.4, 0.6),
            Rule::within(Kind::Blackout, 0.8, 0.9),
            Rule { by_s: 2.0, ..Rule::within(Kind::StampJump, 1.0, 1.02) },
            Rule::within(Kind::Duplicate, 1.2, 1.24),
            Rule::within(Kind::Unplug, 1.4, 1.8),
        ]);
        let (seen, lost) = seen(&mut source);
        let counters = source.counters();
        assert_eq!(count(&counters, "injected_frames_dropped"), 5);
        assert!(!seen.iter().any(|(t, _)| (5..10).contains(t)));
        assert_eq!(count(&counters, "injected_frames_frozen"), 10);
        assert!(seen.iter().filter(|(t, _)| (20..30).contains(t)).all(|(_, px)| *px == 20));
        assert_eq!(count(&counters, "injected_frames_blacked_out"), 5);
        assert_eq!(seen.iter().filter(|(_, px)| *px == 0).count(), 5);
        assert_eq!(count(&counters, "injected_frames_jumped"), 1);
        assert!(seen.contains(&(150, 51)));
        assert_eq!(count(&counters, "injected_frames_duplicated"), 2);
        assert_eq!(seen.iter().filter(|(t, _)| *t == 60).count(), 2);
        assert_eq!(count(&counters, "injected_frames_unplugged"), 20);
        assert_eq!(count(&counters, "injected_camera_unplugs"), 1);
        assert!(lost >= 2, "said at once, and again while it lasts: {lost}");
        assert_eq!(seen.len() as i64, FRAMES - 5 - 20 + 2);
    }

    #[test]
    fn one_camera_alone_is_black_and_away_while_its_rule_lasts() {
        let rule = Rule { camera: Some(0), ..Rule::within(Kind::Unplug, 0.2, 0.4) };
        let (mut source, mut frames) = (camera(&[rule]), shape());
        let mut black = 0;
        while source.next(Span(20 * MS), &mut frames).unwrap() != Wait::Ended {
            let is_black = frames.images[0].pixels == [0; 16];
            assert_eq!(source.away().is_some(), is_black);
            black += usize::from(is_black);
        }
        let counters = source.counters();
        assert_eq!((black, count(&counters, "injected_camera_unplugs")), (10, 1), "{counters:?}");
        assert!(Rule { fault: Kind::Drop, ..rule }.check().is_err());
    }

    #[test]
    fn the_same_seed_strikes_the_same_frames() {
        let rules = [Rule { probability: 0.2, ..Rule::within(Kind::Drop, 0.0, 2.0) }];
        let (mut a, mut b) = (camera(&rules), camera(&rules));
        assert_eq!(seen(&mut a), seen(&mut b));
        let dropped = count(&a.counters(), "injected_frames_dropped");
        assert!((8..35).contains(&dropped), "{dropped}");
    }

    #[test]
    fn what_strikes_lasts_its_length() {
        let rules = [Rule { length_s: 0.1, ..Rule::within(Kind::Gap, 0.5, 0.501) }];
        let mut source = camera(&rules);
        assert_eq!(seen(&mut source).0.len() as i64, FRAMES - 5);
    }

    #[test]
    fn a_unit_fails_as_told() {
        let sample =
            |i: i64| ImuSample { t: Nanos(i * 5 * MS), gyro_body: DVec3::splat(i as f64), ..ImuSample::default() };
        let samples: Arc<[ImuSample]> = (0..400).map(sample).collect();
        let rules = [
            Rule::within(Kind::Drop, 0.1, 0.2),
            Rule::within(Kind::Freeze, 0.4, 0.6),
            Rule::within(Kind::Duplicate, 0.8, 0.81),
            Rule::within(Kind::BitFlip, 1.0, 1.01),
            Rule::within(Kind::Unplug, 1.2, 1.6),
        ];
        let mut source = FaultyImu::new(PacedImu::new(samples, Pace::at_speed(Nanos(0), 10.0)), &rules, 3);
        let (mut batch, mut seen, mut lost) = (ImuBatch::default(), vec![], 0);
        loop {
            match source.next(Span(10 * MS), &mut batch) {
                Ok(Wait::Got) => seen.extend(batch.iter().map(|r| r.sample)),
                Ok(Wait::TimedOut) => {}
                Ok(Wait::Ended) => break,
                Err(_) => lost += 1,
            }
        }
        let c = source.counters();
        let counted = |name: &str| count(&c, name) as usize;
        assert_eq!(
            [counted("injected_imu_dropped"), counted("injected_imu_frozen"), counted("injected_imu_unplugged")],
            [20, 40, 80]
        );
        assert_eq!(seen.iter().filter(|s| s.gyro_body.x == 79.0).count(), 41);
        assert_eq!(seen.len(), 400 - 20 - 80 + counted("injected_imu_duplicated"));
        assert!(lost > 0 && counted("injected_imu_duplicated") == 2 && counted("injected_imu_flipped") == 2);
    }

    #[test]
    fn senseless_rules_are_named() {
        let rule = Rule::within(Kind::Drop, 1.0, 2.0);
        assert!(rule.check().is_ok());
        assert!(Rule { probability: 1.5, ..rule }.check().is_err());
        assert!(Rule { end_s: 0.5, ..rule }.check().is_err());
        assert!(Rule { fault: Kind::Delay, ..rule }.check().is_err());
        assert!(Rule { fault: Kind::Delay, by_s: -1.0, ..rule }.check().is_err());
    }
}
