//! Agreement of cameras: whether two that look at the same things, by the calibration, see the same things.
//!
//! Points that one of two cameras sees and the other should are counted. A normal rig finds most of them in both within its
//! first frames, and is not looked at again. Where almost none is found for a second, the same points are looked for
//! once more as if the two images were exchanged, which tells swapped cameras from those that show something else.

use super::Frontend;
use crate::limits::CAMERAS_MAX;
use stipple_drivers::{Nanos, Span};

/// Cameras agree when this share of the points that both should see is seen in both, and disagree below the other. Normal rigs
/// have 0.77 to 1 in recordings and simulated flights, and 0.5 with images shifted by some pixels; rigs that lie have 0 to 0.02.
const AGREE_MIN: f64 = 0.3;
const DISAGREE_MAX: f64 = 0.12;
/// They are swapped when this share is found with the images exchanged: 0.7 to 1 of swapped cameras, 0.01 of others.
const SWAPPED_MIN: f64 = 0.4;
/// Points of all frames, and points of one, that a verdict takes.
const POINTS_MIN: u32 = 150;
const EXCHANGED_MIN: u32 = 10;
/// Time that a verdict takes, unless cameras agree.
const JUDGED_AFTER: Span = Span(700_000_000);

/// Inverse distances at which a point has to be in view of a second camera to be expected there, 1/m.
const OVERLAP: [f64; 2] = [0.0, 0.5];

/// What is found of two cameras, the lower number first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Each sees what the other should.
    Swapped,
    /// The second never saw what the first sees.
    Disagree,
    /// They disagreed at first, and agree now.
    AgreeAfterAll,
}

const VERDICTS: [Verdict; 3] = [Verdict::Swapped, Verdict::Disagree, Verdict::AgreeAfterAll];
const PAIRS: usize = CAMERAS_MAX * CAMERAS_MAX;

/// A set of verdicts, a bit for each that there can be of each two cameras.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Verdicts(pub u64);

impl Verdicts {
    /// The verdicts, each with its cameras.
    pub fn iter(self) -> impl Iterator<Item = (Verdict, [usize; 2])> {
        let bits = (0..VERDICTS.len() * PAIRS).filter(move |bit| self.0 >> bit & 1 == 1);
        bits.map(|bit| (VERDICTS[bit / PAIRS], [bit % PAIRS / CAMERAS_MAX, bit % CAMERAS_MAX]))
    }

    fn add(&mut self, verdict: Verdict, [a, b]: [usize; 2]) {
        self.0 |= 1 << (verdict as usize * PAIRS + a * CAMERAS_MAX + b);
    }

    fn has(self, verdict: Verdict, cameras: [usize; 2]) -> bool {
        let mut one = Verdicts::default();
        one.add(verdict, cameras);
        self.0 & one.0 != 0
    }
}

/// Points that both of two cameras should see, and those that both do.
#[derive(Clone, Copy, Debug, Default)]
pub struct Shared {
    pub expected: u32,
    pub found: u32,
}

impl Shared {
    pub fn add(&mut self, found: bool) {
        self.expected += 1;
        self.found += u32::from(found);
    }

    fn share(self) -> f64 {
        f64::from(self.found) / f64::from(self.expected.max(1))
    }
}

#[derive(Clone, Copy, Default)]
struct Pair {
    /// First frame that counts.
    since: Option<Nanos>,
    shared: Shared,
    agrees: bool,
}

/// The pairs of a rig.
#[derive(Default)]
pub struct Agreement {
    pairs: [Pair; PAIRS],
    pub verdicts: Verdicts,
}

impl Agreement {
    /// Whether two cameras, the lower number first, are to be looked at.
    pub fn is_open(&self, [a, b]: [usize; 2]) -> bool {
        !self.pairs[a * CAMERAS_MAX + b].agrees && !self.verdicts.has(Verdict::Swapped, [a, b])
    }

    /// Takes what a frame at `t` shows of two cameras; `exchanged` looks for its points with the images exchanged.
    pub fn judge(&mut self, cameras: [usize; 2], t: Nanos, frame: Shared, exchanged: impl FnOnce() -> Shared) {
        let pair = &mut self.pairs[cameras[0] * CAMERAS_MAX + cameras[1]];
        pair.shared.expected += frame.expected;
        pair.shared.found += frame.found;
        let since = *pair.since.get_or_insert(t);
        if pair.shared.expected < POINTS_MIN {
            return;
        }
        let share = pair.shared.share();
        if share >= AGREE_MIN {
            pair.agrees = true;
            if self.verdicts.has(Verdict::Disagree, cameras) {
                self.verdicts.add(Verdict::AgreeAfterAll, cameras);
            }
        } else if t - since >= JUDGED_AFTER && frame.expected >= EXCHANGED_MIN {
            (pair.since, pair.shared) = (None, Shared::default());
            let exchanged = exchanged();
            if exchanged.expected >= EXCHANGED_MIN && exchanged.share() >= SWAPPED_MIN {
                self.verdicts.add(Verdict::Swapped, cameras);
            } else if share <= DISAGREE_MAX {
                self.verdicts.add(Verdict::Disagree, cameras);
            }
        }
    }
}

impl Frontend {
    /// Compares what cameras see of points that both should see.
    pub(super) fn compare(&mut self, t: Nanos, median: f64) {
        let pairs = (0..self.cameras()).flat_map(|b| (0..b).map(move |a| [a, b]));
        for cameras in pairs {
            if !self.agreement.is_open(cameras) || cameras.iter().any(|c| !self.seeing[*c]) {
                continue;
            }
            let frame = self.shared(cameras, |frontend, i, _, to| frontend.points.list[i].views[to].is_some());
            let mut agreement = std::mem::take(&mut self.agreement);
            agreement.judge(cameras, t, frame, || self.shared_if_exchanged(cameras, median));
            self.agreement = agreement;
        }
    }

    /// Counts points that one of two cameras sees and the other should, by its calibration: at infinity and at two metres.
    fn shared(
        &mut self,
        cameras: [usize; 2],
        mut found: impl FnMut(&mut Frontend, usize, usize, usize) -> bool,
    ) -> Shared {
        let mut shared = Shared::default();
        for i in 0..self.points.list.len() {
            let Some(from) = self.points.list[i].first().filter(|first| cameras.contains(first)) else { continue };
            let Some(px) = self.points.list[i].views[from] else { continue };
            let to = cameras[usize::from(from == cameras[0])];
            let relative = self.rig.between(from, to);
            if OVERLAP.iter().all(|q| self.rig.transfer(from, to, &relative, px, *q).is_some()) {
                shared.add(found(self, i, from, to));
            }
        }
        shared
    }

    /// Looks for the points of a frame with the images of two cameras exchanged. Nothing of the points is changed.
    fn shared_if_exchanged(&mut self, cameras: [usize; 2], median: f64) -> Shared {
        self.rig.exchange(cameras);
        let shared = self.shared(cameras, |frontend, i, from, to| {
            let kept = frontend.points.list[i];
            frontend.points.list[i].search_at[to] = 0;
            frontend.points.list[i].inverse_depth = None;
            let found = frontend.search_view(i, from, to, median);
            frontend.points.list[i] = kept;
            found.is_some()
        });
        self.rig.exchange(cameras);
        shared
    }
}
