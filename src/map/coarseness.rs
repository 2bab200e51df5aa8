//! How much a view leaves out where its list of (Gaussian, tile) pairs would not fit.
//!
//! A list has a fixed size. One that overflows would lose some Gaussians, and the view would show holes: what they
//! hid looks uncovered, is seeded once more, and the list overflows the more. So a view that needs more is drawn coarser:
//! each Gaussian is listed only as far as it is brighter than a level, the faint ones not at all (`level_of`, tiles.glsl).
//! What is left is trained to look right. The level rises until the list fits, and falls again when there is room.

/// How far above the faintest that is seen a Gaussian must be to be listed, as twice the logarithm of the ratio. Zero: all is
/// listed as far as it is seen.
#[derive(Clone, Copy, Debug, Default, PartialEq, PartialOrd)]
pub struct Coarseness(f32);

/// 2 ln 255: not even the opaque are listed.
const MAX: f32 = 11.1;
/// The least that it rises by, and what it falls by: small, so that a list that has room is not full again at once.
const RISE: f32 = 0.2;
const FALL: f32 = 0.05;
/// Parts of a list. Where less than `ROOM` is needed it falls; past `TIGHT` it rises before the growth of the Gaussians in
/// training costs a step, to where about `AIM` is needed. A list that never overflowed may be full to the last place.
const ROOM: f64 = 0.75;
const AIM: f64 = 0.8;
const TIGHT: f64 = 0.9;

impl Coarseness {
    /// The one of a level that was kept.
    pub fn at(level: f32) -> Coarseness {
        Coarseness(level.clamp(0.0, MAX))
    }

    pub fn level(self) -> f32 {
        self.0
    }

    /// For the next picture from the same place, after one that needed so many of the list's places.
    pub fn after(self, needed: u32, capacity: u32) -> Coarseness {
        let full = f64::from(needed) / f64::from(capacity);
        if full > if self.0 > 0.0 { TIGHT } else { 1.0 } {
            // Lists shrink with the area of what is listed, or less.
            let rise = 0.5 * (MAX - self.0) * (1.0 - AIM / full) as f32;
            Coarseness((self.0 + rise.max(RISE)).min(MAX))
        } else if full < ROOM {
            Coarseness((self.0 - FALL).max(0.0))
        } else {
            self
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Picture after picture of a view that needs `whole` when nothing is left out: what the last were drawn with.
    fn settled(whole: f64, start: Coarseness) -> (Coarseness, u32) {
        let needed = |c: Coarseness| (whole * f64::from(1.0 - c.level() / MAX)) as u32;
        let last = (0..500).fold(start, |c, _| c.after(needed(c), 1000));
        (last, needed(last))
    }

    #[test]
    fn a_view_that_overflows_is_drawn_coarser_until_it_fits_and_finer_again_when_there_is_room() {
        assert_eq!(settled(900.0, Coarseness::default()), (Coarseness::default(), 900));
        let (coarse, needed) = settled(9000.0, Coarseness::default());
        assert!(coarse > Coarseness::default() && (750..=900).contains(&needed), "{coarse:?} {needed}");
        // Between the two it stays as it is, and it rises before the list is full.
        assert_eq!(coarse.after(needed, 1000), coarse);
        assert!(coarse.after(950, 1000) > coarse && Coarseness::default().after(1000, 1000) == Coarseness::default());
        assert_eq!(settled(700.0, coarse).0, Coarseness::default());
        assert_eq!(Coarseness(MAX).after(u32::MAX, 1), Coarseness(MAX));
    }
}
