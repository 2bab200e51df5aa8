//! Divergence monitor: from what frames look like after their optimization, when the estimate is to be given up, and
//! from when on a new one is trusted.

use super::health::{Health, Reset};
use stipple_drivers::Nanos;

/// Share of a frame's views that must agree with it after optimization, once it has so many: otherwise it is suspect.
const INLIERS_MIN: f64 = 0.65;
const VIEWS_MIN: usize = 10;
/// Squared whitened residual of the newest inertial factor, per dimension, that is suspect.
const MISFIT_MAX: f64 = 30.0;
/// Suspect frames that last this much longer than others, s, are a divergence: wrong tracks and samples also agree by chance.
/// Ten frames at 20 Hz.
const SUSPECT_MAX: f64 = 0.475;
/// A frame lasts since the one before it, but no longer than this, s; and doubt this short is none.
const FRAME_MAX: f64 = 0.1;
const SUSPECT_NONE: f64 = 0.004;
/// Known landmarks have fewer views than this for longer than this, s: inertia alone carries the estimate too far.
const SEEN_VIEWS: usize = 6;
const UNSEEN_MAX: f64 = 3.0;
/// Seeing enough of them for so long ends that, s: three frames at 20 Hz.
const SEEING_AGAIN: f64 = 0.125;
/// Time after a start in which nothing may speak against it before it is trusted, s: what spoiled the last start
/// may still be there.
const PROBATION: f64 = SUSPECT_MAX;

/// What a frame looked like after its optimization.
#[derive(Clone, Copy, Debug)]
pub struct Evidence {
    pub t: Nanos,
    /// Since the frame before, s.
    pub dt: f64,
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

/// What spoke against the estimate so far.
#[derive(Clone, Copy, Debug, Default)]
pub struct Monitor {
    /// Time since the start, and by which suspect frames lasted longer than others, s.
    lived: f64,
    suspect: f64,
    unseen_since: Option<Nanos>,
    /// Time since then in which enough landmarks were seen, s.
    seeing: f64,
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
        let dt = e.dt.min(FRAME_MAX);
        self.lived += dt;
        self.suspect = if vision || inertia { self.suspect + dt } else { (self.suspect - dt).max(0.0) };
        if seen {
            self.seeing += dt;
        } else if self.unseen_since.is_none() {
            (self.unseen_since, self.seeing) = (Some(e.t), 0.0);
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

    /// Suspect frames are not yet outlasted by others, or too few known landmarks are seen.
    pub fn is_suspect(&self) -> bool {
        self.suspect >= SUSPECT_NONE || self.unseen_since.is_some()
    }

    /// Nothing speaks against the newest estimate, nor did since its start.
    pub fn is_trusted(&self) -> bool {
        !self.is_suspect() && self.lived >= PROBATION
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(i: i64, views: usize, inliers: usize, misfit: f64) -> Evidence {
        Evidence { t: Nanos(i * 50_000_000), dt: 0.05, views, inliers, known: inliers, at_rest: false, misfit }
    }

    /// The frame that ends a flight of such frames, and why.
    fn end(of: impl Fn(i64) -> Evidence) -> Option<(i64, Reset)> {
        let mut monitor = Monitor::default();
        (0..100).find_map(|i| monitor.check(&of(i)).map(|why| (i, why)))
    }

    #[test]
    fn divergence_needs_disagreement_that_lasts() {
        assert_eq!(end(|i| frame(i, 80, if i % 2 == 0 { 70 } else { 5 }, 1.0)), None);
        let last = 9;
        assert_eq!(end(|i| frame(i, 80, 5, 1.0)), Some((last, Reset::Disagreement)));
        assert_eq!(end(|i| frame(i, 80, 80, f64::NAN)), Some((last, Reset::Disagreement)));
        assert_eq!(end(|i| frame(i, 0, 0, 1.0)), Some((61, Reset::Unseen)));
        let new_only = |i| Evidence { known: 0, ..frame(i, 80, 80, 1.0) };
        assert_eq!(end(new_only), Some((61, Reset::Unseen)), "landmarks of one frame carry nothing");
    }

    #[test]
    fn divergence_takes_as_long_at_every_frame_rate() {
        for rate_hz in [10.0, 20.0, 60.0, 120.0] {
            let mut monitor = Monitor::default();
            let dt = 1.0 / rate_hz;
            let end = (1..1000).find(|_| monitor.check(&Evidence { dt, ..frame(0, 80, 5, 1.0) }).is_some());
            assert!(end.is_some_and(|n| (0.45..=0.5).contains(&(n as f64 * dt))), "{rate_hz} Hz: {end:?}");
        }
    }

    #[test]
    fn trust_takes_a_second_look_after_a_start() {
        let mut monitor = Monitor::default();
        let trusted = (0..100).find(|i| monitor.check(&frame(*i, 80, 80, 1.0)).is_none() && monitor.is_trusted());
        assert_eq!(trusted, Some(9));
        monitor.check(&frame(100, 80, 5, 1.0));
        assert!(!monitor.is_trusted() && monitor.bits() == (Health::VISION_DISAGREES | Health::INERTIA_ALONE));
    }
}
