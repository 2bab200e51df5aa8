//! When a frame was exposed, which frames are missing before it, and which frames of several cameras belong together: all
//! decided from numbers alone.

use super::kernel::NODES_MAX;
use super::uapi;
use crate::types::{Nanos, Span};
use serde::{Deserialize, Serialize};

/// The event at which a frame is stamped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StampPoint {
    /// What each buffer's flags say: the start of exposure, or the end of the frame.
    Driver,
    /// The exposure of the first row begins.
    ExposureStart,
    /// The first row is read out: its exposure has ended. CSI receivers call this the start of frame; uvcvideo stamps it where
    /// the camera sends no clock of its own, although it flags the start of exposure.
    FrameStart,
    /// The last row was received.
    FrameEnd,
}

/// What is needed to make mid-exposure stamps of a driver's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Timing {
    /// Event that the driver stamps.
    pub point: StampPoint,
    /// Length of a row's exposure.
    pub exposure: Span,
    /// From the end of the first row's exposure until the last row was received.
    pub transfer: Span,
}

impl Timing {
    /// The middle of the first row's exposure, from the driver's stamp and flags.
    pub(super) fn mid_exposure(self, stamp: Nanos, flags: u32) -> Nanos {
        let half = Span(self.exposure.0 / 2);
        let of_flags = match flags & uapi::STAMP_SOURCE_MASK {
            uapi::STAMP_SOURCE_EXPOSURE => StampPoint::ExposureStart,
            _ => StampPoint::FrameEnd,
        };
        match if self.point == StampPoint::Driver { of_flags } else { self.point } {
            StampPoint::ExposureStart => stamp + half,
            StampPoint::FrameStart => stamp - half,
            _ => stamp - self.transfer - half,
        }
    }
}

/// How far a driver's stamp can be believed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stamp {
    Monotonic(Nanos),
    /// The driver does not say in which clock it stamps.
    Unknown,
    /// The driver copied the stamp from elsewhere.
    Copied,
    /// It is said to be monotonic, and lies in the future, or further back than a frame can wait.
    Implausible,
}

/// Longest that a frame waits in the driver's queue: frames of a reader that stops for longer are dropped.
const WAITED_MAX: Span = Span(10_000_000_000);
/// A stamp may be ahead of our clock by this: some drivers estimate it, and vivid stamps a frame's end when it starts it.
/// Stamps of another clock are off by more.
const AHEAD_MAX: Span = Span(100_000_000);

/// Judges a driver's stamp, in seconds and microseconds, by its flags and the clock.
pub(super) fn stamp_of(flags: u32, seconds: i64, microseconds: i64, now: Nanos) -> Stamp {
    match flags & uapi::STAMP_MASK {
        uapi::STAMP_MONOTONIC => {
            let nanos = seconds.saturating_mul(1_000_000_000).saturating_add(microseconds.saturating_mul(1000));
            let t = Nanos(nanos);
            if t > now + AHEAD_MAX || t < now - WAITED_MAX {
                return Stamp::Implausible;
            }
            Stamp::Monotonic(t)
        }
        uapi::STAMP_COPY => Stamp::Copied,
        _ => Stamp::Unknown,
    }
}

/// Finds the frames missing before a frame, by its number and by its stamp, as neither sees all: numbers stay contiguous over
/// frames that a USB camera never sent, and stamps do not tell two lost frames from a camera that was stopped.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Gaps {
    last: Option<(u32, Nanos)>,
}

/// How a frame follows the one before: as the next, or with a stamp that is not newer than the last one's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Order {
    Next { missed_by_sequence: u64, missed_by_stamp: u64 },
    NotNewer,
}

impl Gaps {
    /// Takes the next frame; `period` is zero where the rate is unknown.
    pub(super) fn see(&mut self, sequence: u32, t: Nanos, period: Span) -> Order {
        let Some((last_sequence, last_t)) = self.last else {
            self.last = Some((sequence, t));
            return Order::Next { missed_by_sequence: 0, missed_by_stamp: 0 };
        };
        if t <= last_t {
            return Order::NotNewer;
        }
        self.last = Some((sequence, t));
        // Numbers wrap after 2^32 frames. One that stays or goes back was restarted and says nothing.
        let ahead = sequence.wrapping_sub(last_sequence);
        let missed_by_sequence = if ahead < 1 << 31 { u64::from(ahead.saturating_sub(1)) } else { 0 };
        // Rounded: jitter of up to half a period is no gap.
        let periods = if period.0 > 0 { (t - last_t).0.saturating_add(period.0 / 2) / period.0 } else { 1 };
        Order::Next { missed_by_sequence, missed_by_stamp: periods.max(1) as u64 - 1 }
    }
}

/// What to do with the oldest frame held of each camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Pairing {
    /// They were exposed together.
    Together,
    /// The frame of this camera has no partner.
    Drop(usize),
    /// A partner may still come.
    Wait,
}

/// Time from the oldest of the stamps to the newest.
pub(super) fn spread(stamps: &[Option<Nanos>]) -> Span {
    let stamps = || stamps.iter().flatten();
    stamps().max().zip(stamps().min()).map_or(Span(0), |(newest, oldest)| *newest - *oldest)
}

/// Decides about the oldest frame held of each camera: `heads` are their stamps, `full` says which cameras can hold no more.
/// Stamps of a camera grow, so the oldest head that is further than the tolerance from the newest can find no partner.
pub(super) fn pair(heads: &[Option<Nanos>], full: &[bool], tolerance: Span) -> Pairing {
    debug_assert!(heads.len() <= NODES_MAX && heads.len() == full.len());
    let stamps = || heads.iter().enumerate().filter_map(|(camera, t)| t.map(|t| (t, camera)));
    let (Some((oldest, camera)), Some((newest, _))) = (stamps().min(), stamps().max()) else { return Pairing::Wait };
    if newest - oldest > tolerance {
        return Pairing::Drop(camera);
    }
    if heads.iter().all(Option::is_some) {
        return Pairing::Together;
    }
    // One camera is silent while another's buffers run out: the newest frames are worth more.
    match full.iter().position(|full| *full) {
        Some(camera) => Pairing::Drop(camera),
        None => Pairing::Wait,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const MS: i64 = 1_000_000;

    #[test]
    fn the_middle_of_exposure_is_found_from_every_point_of_a_frame() {
        let timing = |point| Timing { point, exposure: Span(8 * MS), transfer: Span(20 * MS) };
        // Exposed from 100 to 108, received until 128: the middle is 104.
        let cases = [
            (StampPoint::ExposureStart, 100, 0),
            (StampPoint::FrameStart, 108, 0),
            (StampPoint::FrameEnd, 128, 0),
            (StampPoint::Driver, 100, uapi::STAMP_SOURCE_EXPOSURE),
            (StampPoint::Driver, 128, 0),
            // The board knows better than the driver.
            (StampPoint::FrameStart, 108, uapi::STAMP_SOURCE_EXPOSURE),
        ];
        for (point, stamp, flags) in cases {
            assert_eq!(timing(point).mid_exposure(Nanos(stamp * MS), flags), Nanos(104 * MS), "{point:?} {flags:#x}");
        }
    }

    #[test]
    fn stamps_of_another_clock_are_told_from_ours() {
        let now = Nanos(1_000 * 1_000_000_000);
        let of = |flags, s| stamp_of(flags, s, 0, now);
        assert_eq!(of(uapi::STAMP_MONOTONIC, 999), Stamp::Monotonic(Nanos(999_000_000_000)));
        assert_eq!(of(uapi::STAMP_COPY, 999), Stamp::Copied);
        assert_eq!(of(0, 999), Stamp::Unknown);
        assert_eq!(of(uapi::STAMP_MONOTONIC, 1001), Stamp::Implausible, "from the future");
        assert_eq!(of(uapi::STAMP_MONOTONIC, 900), Stamp::Implausible, "older than a frame can wait");
        assert_eq!(of(uapi::STAMP_MONOTONIC, 0), Stamp::Implausible, "never written");
        assert_eq!(stamp_of(uapi::STAMP_MONOTONIC, i64::MAX, i64::MAX, now), Stamp::Implausible);
        assert_eq!(stamp_of(uapi::STAMP_MONOTONIC, i64::MIN, i64::MIN, now), Stamp::Implausible);
    }

    #[test]
    fn numbers_wrap_and_restart_without_a_gap() {
        let next = |by_sequence, by_stamp| Order::Next { missed_by_sequence: by_sequence, missed_by_stamp: by_stamp };
        let mut gaps = Gaps::default();
        let period = Span(50 * MS);
        assert_eq!(gaps.see(u32::MAX - 1, Nanos(0), period), next(0, 0), "the first has none before it");
        assert_eq!(gaps.see(u32::MAX, Nanos(50 * MS), period), next(0, 0));
        assert_eq!(gaps.see(0, Nanos(100 * MS), period), next(0, 0), "wrapped");
        assert_eq!(gaps.see(3, Nanos(250 * MS), period), next(2, 2));
        assert_eq!(gaps.see(4, Nanos(450 * MS), period), next(0, 3), "never sent: only stamps tell");
        assert_eq!(gaps.see(7, Nanos(500 * MS), period), next(2, 0), "only numbers tell");
        assert_eq!(gaps.see(0, Nanos(550 * MS), period), next(0, 0), "restarted");
        assert_eq!(gaps.see(0, Nanos(600 * MS), period), next(0, 0), "always zero");
        assert_eq!(gaps.see(1, Nanos(600 * MS), period), Order::NotNewer);
        assert_eq!(gaps.see(1, Nanos(590 * MS), period), Order::NotNewer);
        assert_eq!(gaps.see(1, Nanos(900 * MS), Span(0)), next(0, 0), "a rate that is unknown misses nothing");
        assert_eq!(gaps.see(2, Nanos(i64::MAX), Span(1)), next(0, i64::MAX as u64 - 900_000_001));
    }

    proptest! {
        #[test]
        fn every_lost_frame_is_counted_once_whatever_the_jitter(
            lost in prop::collection::vec(any::<bool>(), 2..200),
            jitter in prop::collection::vec(-0.24f64..0.24, 200),
            start: u32,
        ) {
            let period = Span(50 * MS);
            let mut gaps = Gaps::default();
            let (mut by_sequence, mut by_stamp, mut kept) = (0, 0, Vec::new());
            for (i, lost) in lost.iter().enumerate() {
                if *lost {
                    continue;
                }
                kept.push(i);
                let t = Nanos(i as i64 * period.0 + (jitter[i] * period.0 as f64) as i64);
                match gaps.see(start.wrapping_add(i as u32), t, period) {
                    Order::Next { missed_by_sequence, missed_by_stamp } => {
                        by_sequence += missed_by_sequence;
                        by_stamp += missed_by_stamp;
                    }
                    Order::NotNewer => prop_assert!(false, "stamps grow"),
                }
            }
            let missing = kept.last().map_or(0, |last| last - kept[0] + 1 - kept.len()) as u64;
            prop_assert_eq!((by_sequence, by_stamp), (missing, missing));
        }

        /// Two cameras of one trigger, each with frames lost: exactly those that both have come out, in order.
        #[test]
        fn exactly_the_frames_that_every_camera_has_are_paired(
            lost in prop::collection::vec((any::<bool>(), any::<bool>(), any::<bool>()), 1..100),
            jitter in prop::collection::vec(0..1_000_000i64, 300),
        ) {
            let cameras: Vec<Vec<usize>> = [0, 1, 2].map(|c: usize| {
                let kept = |(_, l): &(usize, &(bool, bool, bool))| ![l.0, l.1, l.2][c];
                lost.iter().enumerate().filter(kept).map(|(i, _)| i).collect()
            }).to_vec();
            let stamp = |c: usize, i: usize| Nanos(i as i64 * 50 * MS + jitter[(3 * i + c) % 300]);
            let (mut at, mut paired) = ([0; 3], Vec::new());
            loop {
                let heads: Vec<Option<Nanos>> = (0..3).map(|c| cameras[c].get(at[c]).map(|i| stamp(c, *i))).collect();
                match pair(&heads, &[false; 3], Span(MS)) {
                    Pairing::Together => {
                        let i = cameras[0][at[0]];
                        prop_assert!((0..3).all(|c| cameras[c][at[c]] == i));
                        paired.push(i);
                        at.iter_mut().for_each(|a| *a += 1);
                    }
                    Pairing::Drop(c) => at[c] += 1,
                    Pairing::Wait => break,
                }
            }
            let both: Vec<usize> = (0..lost.len()).filter(|i| !(lost[*i].0 || lost[*i].1 || lost[*i].2)).collect();
            prop_assert_eq!(paired, both);
        }
    }

    #[test]
    fn a_silent_partner_costs_frames_only_when_buffers_run_out() {
        let t = |ms: i64| Some(Nanos(ms * MS));
        let tolerance = Span(MS);
        assert_eq!(pair(&[None, None], &[false, false], tolerance), Pairing::Wait);
        assert_eq!(pair(&[t(5), None], &[false, false], tolerance), Pairing::Wait);
        assert_eq!(pair(&[t(5), None], &[true, false], tolerance), Pairing::Drop(0));
        assert_eq!(pair(&[t(5), t(6)], &[true, false], tolerance), Pairing::Together);
        assert_eq!(pair(&[t(5), t(5)], &[false, false], Span(0)), Pairing::Together, "equal stamps");
        assert_eq!(pair(&[t(7), t(5)], &[false, false], tolerance), Pairing::Drop(1));
        assert_eq!(pair(&[t(5), None, t(7)], &[false; 3], tolerance), Pairing::Drop(0));
        assert_eq!(pair(&[Some(Nanos(i64::MIN)), Some(Nanos(i64::MAX))], &[false; 2], tolerance), Pairing::Drop(0));
        assert_eq!(pair(&[t(1)], &[false], Span(0)), Pairing::Together, "one camera waits for nobody");
    }
}
