//! Faults on purpose: wraps a source and drops, delays, duplicates, freezes or falsifies what passes, or falls silent, or is
//! unplugged.
//!
//! Rules come from a board's `[inject]` or from a test. Each names a fault and when it strikes: in a window of the source's
//! own time, with a probability, or both. The randomness is seeded, so the same frames are struck every time. Counters say
//! exactly what was done, so that what was detected can be compared with it.

use crate::source::{FrameSource, ImuBatch, ImuReading, ImuSource, SourceFault, Wait};
use crate::types::{Frames, Image, Nanos, Span};
use crate::{Fault, FaultKind};
use glam::DVec3;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use std::time::{Duration, Instant};

#[cfg(test)]
mod tests;

/// A fault of a frame or of an inertial sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Withheld.
    Drop,
    /// Delivered `by_s` late, under its right stamp.
    Delay,
    /// Delivered twice.
    Duplicate,
    /// The measurement before, under a new stamp.
    Freeze,
    /// One bit, or `bits`, of every image; of a sample one bit of one axis, as of a 16-bit unit.
    BitFlip,
    /// Black images.
    Blackout,
    /// Silence.
    Gap,
    /// A stamp that is `by_s` off.
    StampJump,
    /// Lost, as with the cable out.
    Unplug,
}

/// Counters of each kind, of frames and of inertial samples.
const COUNTERS: [[&str; 2]; 9] = [
    ["injected_frames_dropped", "injected_imu_dropped"],
    ["injected_frames_delayed", "injected_imu_delayed"],
    ["injected_frames_duplicated", "injected_imu_duplicated"],
    ["injected_frames_frozen", "injected_imu_frozen"],
    ["injected_frames_flipped", "injected_imu_flipped"],
    ["injected_frames_blacked_out", "injected_imu_blacked_out"],
    ["injected_frames_silenced", "injected_imu_silenced"],
    ["injected_frames_jumped", "injected_imu_jumped"],
    ["injected_frames_unplugged", "injected_imu_unplugged"],
];

/// A fault, and when it strikes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rule {
    /// What happens to a frame or sample that is struck.
    pub fault: Kind,
    /// The window in which it strikes, after the source's first stamp, s.
    #[serde(default)]
    pub start_s: f64,
    #[serde(default = "forever")]
    pub end_s: f64,
    /// Chance of each frame or sample in the window to be struck, a fraction.
    #[serde(default = "always")]
    pub probability: f64,
    /// How long it lasts once it strikes, s; 0: for the one frame or sample.
    #[serde(default)]
    pub length_s: f64,
    /// How late `delay` delivers, and how far off `stamp_jump` stamps, s.
    #[serde(default)]
    pub by_s: f64,
    /// `blackout`, `freeze` and `unplug`: this camera alone, while the others go on.
    #[serde(default)]
    pub camera: Option<usize>,
    /// `bit_flip`: bits in each image.
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
    /// A rule that strikes everything in `[start_s, end_s)`.
    pub fn within(fault: Kind, start_s: f64, end_s: f64) -> Rule {
        Rule { fault, start_s, end_s, probability: 1.0, length_s: 0.0, by_s: 0.0, camera: None, bits: 1 }
    }

    /// Refuses a rule that makes no sense, with the reason.
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
            _ if self.camera.is_some() && !matches!(self.fault, Kind::Blackout | Kind::Freeze | Kind::Unplug) => {
                Err("only blackout, freeze and unplug strike one camera alone")
            }
            _ => Ok(()),
        }
    }
}

/// The rules of one source, and what they did so far.
struct Plan {
    /// Each rule, and until when it lasts once it struck.
    rules: Vec<(Rule, Option<Nanos>)>,
    rng: ChaCha8Rng,
    /// The source's first stamp.
    first: Option<Nanos>,
    counts: [u64; COUNTERS.len()],
    unplugs: u64,
    unplugged: bool,
    /// One camera is unplugged, and the others are not.
    away: Option<Fault>,
    place: &'static str,
}

impl Plan {
    fn new(rules: &[Rule], seed: u64, place: &'static str) -> Plan {
        Plan {
            rules: rules.iter().map(|r| (*r, None)).collect(),
            rng: ChaCha8Rng::seed_from_u64(seed),
            first: None,
            counts: [0; COUNTERS.len()],
            unplugs: 0,
            unplugged: false,
            away: None,
            place,
        }
    }

    fn has(&self, kind: Kind) -> bool {
        self.rules.iter().any(|(r, _)| r.fault == kind)
    }

    /// Counts, and calls `act` with, each rule that strikes at `t`. After one that withholds no other strikes.
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
            match (rule.fault, rule.camera) {
                (Kind::Unplug, Some(camera)) => one = Some(camera),
                (Kind::Drop | Kind::Gap | Kind::Unplug, _) => {
                    unplugged = rule.fault == Kind::Unplug;
                    break;
                }
                _ => {}
            }
        }
        let before = self.unplugged || self.away.is_some();
        self.unplugs += u64::from((unplugged || one.is_some()) && !before);
        self.unplugged = unplugged;
        if self.away.is_some() != one.is_some() {
            self.away = one.map(|camera| unplugged_at(&format!("camera {camera}")));
        }
    }

    /// Reads until something is left to deliver, or `timeout` is over. `read` waits for the source, as long as it is told at
    /// most, strikes what came, and says whether any of it is delivered.
    fn read(
        &mut self,
        timeout: Span,
        mut read: impl FnMut(&mut Plan, Span) -> Result<(Wait, bool), SourceFault>,
    ) -> Result<Wait, SourceFault> {
        let limit = Instant::now() + Duration::from_nanos(timeout.0.max(0) as u64);
        let lost = |plan: &Plan| Err(SourceFault::Lost(unplugged_at(plan.place)));
        loop {
            let was_unplugged = self.unplugged;
            match read(self, Span(limit.saturating_duration_since(Instant::now()).as_nanos() as i64))? {
                (Wait::Got, true) => return Ok(Wait::Got),
                (Wait::Got, _) if self.unplugged && !was_unplugged => return lost(self),
                (Wait::Got, _) if Instant::now() < limit => {}
                (Wait::Ended, _) => return Ok(Wait::Ended),
                _ if self.unplugged => return lost(self),
                _ => return Ok(Wait::TimedOut),
            }
        }
    }

    /// The source's counters with those of the faults that were injected; `column` is that of `COUNTERS`.
    fn counters(
        &self,
        mut source: Vec<(&'static str, u64)>,
        column: usize,
        unplugs: &'static str,
    ) -> Vec<(&'static str, u64)> {
        let injected = COUNTERS.iter().map(|names| names[column]).zip(self.counts);
        source.extend(injected.chain([(unplugs, self.unplugs)]).filter(|(_, n)| *n > 0));
        source
    }
}

fn unplugged_at(place: &str) -> Fault {
    Fault::new(FaultKind::Unavailable, place, "unplugged by [inject]", "it comes back as the rule says")
}

fn sleep(secs: f64) {
    std::thread::sleep(Duration::from_secs_f64(secs.max(0.0)));
}

/// A rig of cameras that fails as its rules say.
pub struct FaultyFrames {
    source: Box<dyn FrameSource>,
    plan: Plan,
    last: LastFrames,
}

/// The frames that were delivered last, for those that freeze or come twice.
struct LastFrames {
    frames: Frames,
    /// A rule needs them.
    kept: bool,
    /// They are delivered once more.
    again: bool,
}

impl FaultyFrames {
    /// Wraps a rig; `shape` has the shape of the frames that `next` will fill.
    pub fn new(source: Box<dyn FrameSource>, rules: &[Rule], seed: u64, shape: Frames) -> FaultyFrames {
        let plan = Plan::new(rules, seed, "camera");
        let kept = plan.has(Kind::Freeze) || plan.has(Kind::Duplicate);
        FaultyFrames { source, plan, last: LastFrames { frames: shape, kept, again: false } }
    }
}

fn blacken<'a>(images: impl Iterator<Item = &'a mut Image>) {
    images.for_each(|image| image.pixels.fill(0));
}

impl LastFrames {
    /// Whether the frame, with its faults, is delivered.
    fn inject_faults(&mut self, plan: &mut Plan, frames: &mut Frames) -> bool {
        let (mut delivered, mut frozen, mut late_s) = (true, false, 0.0);
        let (last, again) = (&self.frames, &mut self.again);
        plan.strike(frames.t, |rule, rng| match (rule.fault, rule.camera) {
            (Kind::Unplug | Kind::Blackout, Some(camera)) => {
                let colours = frames.colours.get_mut(camera).into_iter().flatten();
                blacken(frames.images.get_mut(camera).into_iter().chain(colours));
            }
            (Kind::Drop | Kind::Gap | Kind::Unplug, _) => delivered = false,
            (Kind::Delay, _) => late_s += rule.by_s,
            (Kind::Duplicate, _) => *again = true,
            (Kind::Freeze, Some(camera)) => {
                let images = frames.images.get_mut(camera).zip(last.images.get(camera));
                let colours = frames.colours.get_mut(camera).zip(last.colours.get(camera));
                let planes = colours.into_iter().flat_map(|(to, from)| to.iter_mut().zip(from));
                images.into_iter().chain(planes).for_each(|(to, from)| to.copy_from(from));
            }
            (Kind::Freeze, _) => {
                let t = frames.t;
                frames.copy_from(last);
                frames.t = t;
                frozen = true;
            }
            (Kind::BitFlip, _) => {
                for image in &mut frames.images {
                    for _ in 0..rule.bits {
                        let at = rng.random_range(0..image.pixels.len());
                        image.pixels[at] ^= 1 << rng.random_range(0..8);
                    }
                }
            }
            (Kind::Blackout, _) => blacken(frames.images.iter_mut().chain(frames.colours.iter_mut().flatten())),
            (Kind::StampJump, _) => frames.t = frames.t + Span::from_secs(rule.by_s),
        });
        if delivered && self.kept && !frozen {
            self.frames.copy_from(frames);
        }
        self.frames.t = frames.t;
        sleep(late_s);
        delivered
    }
}

impl FrameSource for FaultyFrames {
    fn next(&mut self, timeout: Span, frames: &mut Frames) -> Result<Wait, SourceFault> {
        let FaultyFrames { source, plan, last } = self;
        if std::mem::take(&mut last.again) {
            frames.copy_from(&last.frames);
            return Ok(Wait::Got);
        }
        plan.read(timeout, |plan, left| {
            let wait = source.next(left, frames)?;
            Ok((wait, wait == Wait::Got && last.inject_faults(plan, frames)))
        })
    }

    fn inner(&self) -> Option<&dyn FrameSource> {
        Some(&*self.source)
    }

    fn away(&self) -> Option<&Fault> {
        self.plan.away.as_ref().or_else(|| self.source.away())
    }

    fn counters(&self) -> Vec<(&'static str, u64)> {
        self.plan.counters(self.source.counters(), 0, "injected_camera_unplugs")
    }
}

/// Ends of the range of the 16-bit registers in which bits flip: 2000 °/s and 16 g, in rad/s and m/s².
const GYRO_RANGE: f64 = 34.907;
const ACCEL_RANGE: f64 = 156.91;

/// An inertial unit that fails as its rules say.
pub struct FaultyImu {
    source: Box<dyn ImuSource>,
    plan: Plan,
    last: ImuReading,
}

impl FaultyImu {
    /// Wraps a unit; cameras with the same seed are struck independently.
    pub fn new(source: Box<dyn ImuSource>, rules: &[Rule], seed: u64) -> FaultyImu {
        // Another random stream than the cameras'.
        FaultyImu { source, plan: Plan::new(rules, seed ^ 0x494D_5500, "imu"), last: ImuReading::default() }
    }
}

/// Leaves in `batch` what is delivered, with its faults; `last` is the reading before.
fn inject_faults(batch: &mut ImuBatch, last: &mut ImuReading, plan: &mut Plan) {
    let mut delivered = ImuBatch::default();
    let mut late_s: f64 = 0.0;
    for reading in batch.iter() {
        let (mut out, mut times) = (*reading, 1);
        plan.strike(reading.sample.t, |rule, rng| match rule.fault {
            Kind::Drop | Kind::Gap | Kind::Unplug => times = 0,
            Kind::Delay => late_s = late_s.max(rule.by_s),
            Kind::Duplicate => times = 2,
            Kind::Freeze => {
                let t = out.sample.t;
                out = *last;
                out.sample.t = t;
            }
            Kind::BitFlip => flip(&mut out, rng),
            // Refused where rules are read: a unit sees no light.
            Kind::Blackout => {}
            Kind::StampJump => out.sample.t = out.sample.t + Span::from_secs(rule.by_s),
        });
        for _ in 0..times {
            // A FIFO that full is not doubled; what is in it is delivered.
            let _ = delivered.push(out);
            *last = out;
        }
    }
    *batch = delivered;
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

impl ImuSource for FaultyImu {
    fn next(&mut self, timeout: Span, batch: &mut ImuBatch) -> Result<Wait, SourceFault> {
        let FaultyImu { source, plan, last } = self;
        plan.read(timeout, |plan, left| {
            let wait = source.next(left, batch)?;
            inject_faults(batch, last, plan);
            Ok((wait, !batch.is_empty()))
        })
    }

    fn inner(&self) -> Option<&dyn ImuSource> {
        Some(&*self.source)
    }

    fn counters(&self) -> Vec<(&'static str, u64)> {
        self.plan.counters(self.source.counters(), 1, "injected_imu_unplugs")
    }
}
