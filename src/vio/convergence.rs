//! Whether what is estimated of the rig has been found, and what is doubtful where it has not.
//!
//! A rig is estimated where its calibration is wrong, and until it is found poses are wrong by as much. A flight that is too
//! calm to tell, or an error too large for the tracker to match across, leaves it so, and the estimate looks like any other.
//! So after some time of motion each part is judged by its deviations, by how far it moved since, and by how far it is from
//! the calibration; what is said once is said when it turns out otherwise, too.

use super::rig::{RigState, EXTRINSIC_DIM, SCALE_DIM, TIME_DIM};
use crate::limits::{CAMERAS_MAX, RIG_DIM};
use std::ops::Range;

/// Time of motion after which a part that is not found is said to be so, and time between two looks, s.
const JUDGED_AFTER: f64 = 20.0;
const LOOK: f64 = 5.0;
/// A part is found when no deviation is over this share of what it was at the start: 0.29 of places after 9 s of an aggressive
/// flight, 0.49 after 11 s of MH_01, which does not accelerate much.
const LEFT_MAX: f64 = 0.5;
/// It keeps moving when it went this many deviations between two looks, and this share of its deviation at the start: less
/// matters to nobody.
const MOVED_SIGMAS: f64 = 5.0;
const MOVED_SHARE: f64 = 0.1;
/// Deviations at the start that an offset, or a vector by its length, can be off by.
const FAR_SIGMAS: f64 = 4.0;

/// What is found as one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// Time offset and place of the camera of this number.
    TimeOffset(usize),
    Extrinsics(usize),
    GyroScale,
    AccelScale,
}

const PARTS: usize = 2 * CAMERAS_MAX + 2;

impl Part {
    fn of(i: usize) -> Part {
        match i {
            i if i < CAMERAS_MAX => Part::TimeOffset(i),
            i if i < 2 * CAMERAS_MAX => Part::Extrinsics(i - CAMERAS_MAX),
            i if i == 2 * CAMERAS_MAX => Part::GyroScale,
            _ => Part::AccelScale,
        }
    }

    /// Its columns; `None` where it is not estimated.
    fn columns(self, rig: &RigState) -> Option<Range<usize>> {
        let half = SCALE_DIM / 2;
        let scale = rig.parts.imu_scale.then(|| rig.camera_dim());
        let (at, len) = match self {
            Part::TimeOffset(c) => (rig.time_column(c)?, TIME_DIM),
            Part::Extrinsics(c) => (rig.extrinsic_column(c)?, EXTRINSIC_DIM),
            Part::GyroScale => (scale?, half),
            Part::AccelScale => (scale? + half, half),
        };
        Some(at..at + len)
    }
}

/// What is said of a part.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Finding {
    /// A deviation is still near what it was at the start.
    Unknown,
    /// The estimate moves by more than it is said to be unsure.
    Moving,
    /// The calibration cannot be off by so much.
    TooFar,
    /// It was doubted, and is found now.
    FoundAfterAll,
}

const FINDINGS: [Finding; 4] = [Finding::Unknown, Finding::Moving, Finding::TooFar, Finding::FoundAfterAll];

/// A set of findings, a bit for each that there can be of each part, and one more: the rig was thrown away.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Findings(pub u64);

const THROWN_AWAY: u64 = 1 << (FINDINGS.len() * PARTS);

impl Findings {
    /// The findings, each with its part.
    pub fn iter(self) -> impl Iterator<Item = (Finding, Part)> {
        let bits = (0..FINDINGS.len() * PARTS).filter(move |bit| self.0 >> bit & 1 == 1);
        bits.map(|bit| (FINDINGS[bit / PARTS], Part::of(bit % PARTS)))
    }

    /// Whether what was learnt of the rig was once thrown away.
    pub fn has_thrown_away(self) -> bool {
        self.0 & THROWN_AWAY != 0
    }

    fn bit(finding: Finding, part: usize) -> u64 {
        1 << (finding as usize * PARTS + part)
    }

    fn doubts(part: usize) -> u64 {
        let doubts = [Finding::Unknown, Finding::Moving, Finding::TooFar];
        doubts.into_iter().fold(0, |bits, doubt| bits | Findings::bit(doubt, part))
    }
}

/// How well a part is known.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Judged {
    pub part: Part,
    /// The largest of its deviations, as a fraction of what it was at the start.
    pub left: f64,
    /// `None` where it is found.
    pub doubt: Option<Finding>,
}

/// The state of the search.
#[derive(Clone, Debug)]
pub struct Convergence {
    /// Deviations at the start.
    began: [f64; RIG_DIM],
    /// Time of motion since the start or the last reset, and when the next look is due, s.
    moved_s: f64,
    next_look: f64,
    /// Errors and deviations at the last look.
    last: Option<[[f64; RIG_DIM]; 2]>,
    /// Parts that moved between the last two looks.
    moving: [bool; PARTS],
    pub findings: Findings,
}

impl Convergence {
    /// `began`: deviations at the start, in the order of the columns.
    pub fn new(began: [f64; RIG_DIM]) -> Convergence {
        let (last, moving, findings) = (None, [false; PARTS], Findings::default());
        Convergence { began, moved_s: 0.0, next_look: LOOK, last, moving, findings }
    }

    /// Begins again after a reset, at which what was learnt may have been thrown away. What was said stays said.
    pub fn restart(&mut self, thrown_away: bool) {
        let bit = if thrown_away { THROWN_AWAY } else { 0 };
        *self = Convergence { findings: Findings(self.findings.0 | bit), ..Convergence::new(self.began) };
    }

    /// Takes `dt` s more of motion, after which the rig is this, with these deviations.
    pub fn add(&mut self, dt: f64, rig: &RigState, deviations: &[f64; RIG_DIM]) {
        self.moved_s += dt;
        if !rig.parts.any() || self.moved_s < self.next_look {
            return;
        }
        self.next_look = self.moved_s + LOOK;
        let now = rig.errors();
        if let Some([errors, sigmas]) = self.last.replace([now, *deviations]) {
            let moved = |i: usize| {
                let most = (MOVED_SIGMAS * sigmas[i]).max(MOVED_SHARE * self.began[i]);
                (now[i] - errors[i]).abs() > most
            };
            self.moving = std::array::from_fn(|p| Part::of(p).columns(rig).is_some_and(|mut all| all.any(moved)));
        }
        if self.moved_s >= JUDGED_AFTER {
            self.findings = self.concluded(rig, deviations);
        }
    }

    /// Findings so far, with what there is to say of each part as it is now, however short the motion was.
    pub fn concluded(&self, rig: &RigState, deviations: &[f64; RIG_DIM]) -> Findings {
        let mut bits = self.findings.0;
        for p in 0..PARTS {
            match self.judge(p, rig, deviations).map(|judged| judged.doubt) {
                Some(Some(doubt)) => bits |= Findings::bit(doubt, p),
                Some(None) if bits & Findings::doubts(p) != 0 => bits |= Findings::bit(Finding::FoundAfterAll, p),
                _ => {}
            }
        }
        Findings(bits)
    }

    /// Every part that is estimated.
    pub fn parts<'a>(&'a self, rig: &'a RigState, deviations: &'a [f64; RIG_DIM]) -> impl Iterator<Item = Judged> + 'a {
        (0..PARTS).filter_map(|p| self.judge(p, rig, deviations))
    }

    fn judge(&self, p: usize, rig: &RigState, deviations: &[f64; RIG_DIM]) -> Option<Judged> {
        let (part, errors) = (Part::of(p), rig.errors());
        let columns = part.columns(rig)?;
        let left = columns.clone().fold(0.0, |most: f64, i| most.max(deviations[i] / self.began[i]));
        let squares: [f64; RIG_DIM] = std::array::from_fn(|i| (errors[i] / self.began[i]).powi(2));
        let far = squares[columns].chunks(3).any(|vector| vector.iter().sum::<f64>() > FAR_SIGMAS * FAR_SIGMAS);
        let doubts = [(left > LEFT_MAX, Finding::Unknown), (self.moving[p], Finding::Moving), (far, Finding::TooFar)];
        Some(Judged { part, left, doubt: doubts.into_iter().find(|(holds, _)| *holds).map(|(_, doubt)| doubt) })
    }
}
