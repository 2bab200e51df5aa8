//! Long dispatches in pieces: how many workgroups one submission may hold.
//!
//! What a kernel takes on a device is known once it has run there. So its first piece is a few workgroups, and each piece
//! tells how many the next may have: as many as take half of `submission_max_ms` at the speed measured, which leaves a factor
//! of two for a piece that is slower than the one before, and no more than `GROWTH` times as many as were ever timed.
//! Workgroups of a dispatch cannot wait for each other, so the result does not depend on the pieces.

/// Workgroups of a kernel that has never run: of the slowest, `aggregate` at 128 disparities, one core of lavapipe takes 2 ms each.
const FIRST: u32 = 2;
/// A clock may be too coarse for a small piece, and caches may hold it.
const GROWTH: u32 = 16;
/// Share of the bound that a piece is to take.
const AIM: f64 = 0.5;

/// The dimension a dispatch is cut along. A long row of workgroups wraps into y (`Threads::d1`) and finds its index by
/// the width of the dispatch, which must stay.
pub(super) fn axis([_, y, z]: [u32; 3]) -> usize {
    match (y, z) {
        (1, 1) => 0,
        (y, z) if y >= z => 1,
        _ => 2,
    }
}

/// How fast a kernel runs on this device, as last timed.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct PieceTiming {
    ms_per_group: f64,
    /// The most that were timed at once; zero: it has never run.
    groups: u32,
}

impl PieceTiming {
    pub fn note(&mut self, groups: u32, ms: f64) {
        if groups > 0 {
            self.ms_per_group = ms / f64::from(groups);
            self.groups = self.groups.max(groups);
        }
    }

    /// What so many workgroups take, ms; without end where too few were timed to say.
    pub fn estimate(&self, groups: u32) -> f64 {
        match groups <= self.groups.saturating_mul(GROWTH) {
            true => self.ms_per_group * f64::from(groups),
            false => f64::INFINITY,
        }
    }

    /// How many of the `left` slabs of `slab` workgroups each make the next piece; all where they take `max_ms` at most.
    pub fn piece(&self, left: u32, slab: u32, max_ms: f64) -> u32 {
        let groups = left.saturating_mul(slab);
        if self.estimate(groups) <= max_ms {
            return left;
        }
        let trusted = (self.groups.saturating_mul(GROWTH).max(FIRST) / slab).max(1);
        // Even pieces: the last is no smaller, and its time no worse, than the others.
        let pieces = (self.ms_per_group * f64::from(groups) / (AIM * max_ms)).ceil().max(1.0);
        ((f64::from(left) / pieces).ceil() as u32).clamp(1, trusted.min(left))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Pieces of a dispatch, and how long the longest took, on a device that runs `wide` workgroups at once.
    fn flown(timing: &mut PieceTiming, mut left: u32, slab: u32, wide: u32, ms: f64) -> (usize, f64) {
        let (mut pieces, mut longest) = (0, 0f64);
        while left > 0 {
            let slabs = timing.piece(left, slab, 20.0);
            assert!((1..=left).contains(&slabs));
            let took = ms * f64::from((slabs * slab).div_ceil(wide));
            timing.note(slabs * slab, took);
            (left, pieces, longest) = (left - slabs, pieces + 1, longest.max(took));
        }
        (pieces, longest)
    }

    #[test]
    fn pieces_stay_within_the_bound_and_a_fast_device_soon_needs_none() {
        for (wide, ms) in [(1, 3.0), (4, 3.0), (64, 9.0), (1, 0.1), (2000, 0.7)] {
            let mut timing = PieceTiming::default();
            let (first, longest) = flown(&mut timing, 376, 1, wide, ms);
            assert!(first > 1 && longest <= 20.0, "{wide} at once, {ms} ms: {first} pieces, {longest} ms");
            let (then, longest) = flown(&mut timing, 376, 1, wide, ms);
            let least = (376f64 / f64::from(wide)).ceil() * ms / 20.0;
            assert!(
                then as f64 <= 1.0 + 3.0 * least && longest <= 20.0,
                "{wide}, {ms} ms: {then} of {least}, {longest}"
            );
            let (slabs, longest) = flown(&mut timing, 60, 94, wide, ms / 94.0);
            assert!(slabs <= 60 && longest <= 20.0, "{slabs} pieces, {longest} ms");
        }
    }

    #[test]
    fn a_kernel_that_never_ran_begins_small_and_one_too_coarse_to_time_grows_slowly() {
        let mut timing = PieceTiming::default();
        assert_eq!((timing.piece(1000, 1, 20.0), timing.estimate(1)), (FIRST, f64::INFINITY));
        timing.note(FIRST, 0.0);
        assert_eq!(timing.piece(1000, 1, 20.0), FIRST * GROWTH);
        assert_eq!(timing.piece(FIRST * GROWTH, 1, 20.0), FIRST * GROWTH);
    }

    #[test]
    fn wrapped_rows_keep_their_width() {
        assert_eq!([[9, 1, 1], [9, 3, 1], [9, 3, 2], [9, 2, 3]].map(axis), [0, 1, 1, 2]);
    }
}
