//! Divergence monitor: from what frames look like after their optimization, when the estimate is to be given up, and
//! from when on a new one is trusted.

use super::health::{Health, Reset};
use stipple_drivers::Nanos;

/// Share of a frame's views that must agree with it after optimization, once it has so many: otherwise it is suspect.
const INLIERS_MIN: f64 = 0.65;
const VIEWS_MIN: usize = 10;
/// Squared whitened residual of the newest inertial factor, per dimension, that is suspect.
const MISFIT_MAX: f64 = 30.0;
/// This many more suspect frames than others are a divergence: wrong tracks and samples also agree by chance.
const SUSPECT_MAX: u32 = 10;
/// Known landmarks have fewer views than this for longer than this, s: inertia alone carries the estimate too far.
const SEEN_VIEWS: usize = 6;
const UNSEEN_MAX: f64 = 3.0;
/// Frames that see enough of them end that.
const SEEING_AGAIN: u32 = 3;
/// Frames after a start that nothing may speak against before it is trusted: what spoiled the last start
/// may still be there.
const PROBATION: u32 = SUSPECT_MAX;

/// What a frame looked like after its optimization.
#[derive(Clone, Copy, Debug)]
pub struct Evidence {
    pub t: Nanos,
    /// Views of landmarks before and after outliers were dropped.
    pub views: usize,
    pub inliers: usize,
    /// Inliers of landmarks that earlier frames saw: a landmark made of this frame alone
    /// says nothing of where it is.
    pub known: usize,
    /// The zero-velocity check holds, which is as good as seeing known landmarks.
    pub at_rest: bool,
    /// Squared whitened inertial residual per dimension, without unit.
    pub misfit: f64,
}

/// Suspect frames so far.
#[derive(Clone, Copy, Debug, Default)]
pub struct Monitor {
    frames: u32,
    suspect: u32,
    unseen_since: Option<Nanos>,
    /// Frames since then that saw enough landmarks.
    seeing: u32,
    /// What speaks against the newest estimate.
    now: Health,
}

impl Monitor {
    /// Why the estimate is to be given up, if it is.
    pub fn check(&mut self, e: &Evidence) -> Option<Reset> {
        let vision = e.views >= VIEWS_MIN && (e.inliers as f64) < INLIERS_MIN * e.views as f64;
        let inertia = !(e.misfit < MISFIT_MAX);
        self.now = Health::default();
        self.now.set(Health::VISION_DISAGREES, vision);
        self.now.set(Health::INERTIA_DISAGREES, inertia);
        let seen = e.known >= SEEN_VIEWS || e.at_rest;
        self.now.set(Health::INERTIA_ALONE, !seen);
        self.frames = self.frames.saturating_add(1);
        self.suspect = if vision || inertia { self.suspect + 1 } else { self.suspect.saturating_sub(1) };
        if seen {
            self.seeing = self.seeing.saturating_add(1);
        } else if self.unseen_since.is_none() {
            (self.unseen_since, self.seeing) = (Some(e.t), 0);
        }
        if self.seeing >= SEEING_AGAIN {
            self.unseen_since = None;
        }
        if self.suspect >= SUSPECT_MAX {
            return Some(Reset::Disagreement);
        }
        self.unseen_since.is_some_and(|t| (e.t - t).secs() > UNSEEN_MAX).then_some(Reset::Unseen)
    }

    /// What speaks against the newest estimate, as bits.
    pub fn bits(&self) -> Health {
        self.now
    }

    /// Nothing speaks against the newest estimate, nor did since its start.
    pub fn is_trusted(&self) -> bool {
        self.suspect == 0 && self.unseen_since.is_none() && self.frames >= PROBATION
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(i: i64, views: usize, inliers: usize, misfit: f64) -> Evidence {
        Evidence { t: Nanos(i * 50_000_000), views, inliers, known: inliers, at_rest: false, misfit }
    }

    /// The frame that ends a flight of such frames, and why.
    fn end(of: impl Fn(i64) -> Evidence) -> Option<(i64, Reset)> {
        let mut monitor = Monitor::default();
        (0..100).find_map(|i| monitor.check(&of(i)).map(|why| (i, why)))
    }

    #[test]
    fn divergence_needs_disagreement_that_lasts() {
        assert_eq!(end(|i| frame(i, 80, if i % 2 == 0 { 70 } else { 5 }, 1.0)), None);
        let last = SUSPECT_MAX as i64 - 1;
        assert_eq!(end(|i| frame(i, 80, 5, 1.0)), Some((last, Reset::Disagreement)));
        assert_eq!(end(|i| frame(i, 80, 80, f64::NAN)), Some((last, Reset::Disagreement)));
        assert_eq!(end(|i| frame(i, 0, 0, 1.0)), Some((61, Reset::Unseen)));
        let new_only = |i| Evidence { known: 0, ..frame(i, 80, 80, 1.0) };
        assert_eq!(end(new_only), Some((61, Reset::Unseen)), "landmarks of one frame carry nothing");
    }

    #[test]
    fn trust_takes_a_second_look_after_a_start() {
        let mut monitor = Monitor::default();
        let trusted = (0..100).find(|i| monitor.check(&frame(*i, 80, 80, 1.0)).is_none() && monitor.is_trusted());
        assert_eq!(trusted, Some(PROBATION as i64 - 1));
        monitor.check(&frame(100, 80, 5, 1.0));
        assert!(!monitor.is_trusted() && monitor.bits() == (Health::VISION_DISAGREES | Health::INERTIA_ALONE));
    }
}
