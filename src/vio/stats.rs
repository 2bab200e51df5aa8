//! What the estimator counts, and under which names it reaches the report.

use super::health::{Health, Reset};
use stipple_drivers::counters;

counters! {
    /// What was dropped, refused, repaired or done so far.
    #[derive(Clone, Copy, PartialEq, Eq)]
    pub struct Stats of u64, read by u64::clone;
    imu_rejected,
    imu_overflow,
    /// Holes in the inertial samples.
    imu_gaps,
    /// Frames not newer than the last.
    frames_rejected,
    /// Frames that were left to inertia.
    frames_carried,
    /// Tracks of cameras the rig has not, with pixels that are none, or out of order.
    tracks_rejected,
    /// Views of known landmarks too far from where these must be.
    tracks_gated,
    /// Frames of which so many were that the prediction must have been wrong, and none was refused.
    gates_opened,
    landmarks_full,
    outliers,
    solver_failures,
    /// Steps of the solver that were taken back because they made the cost larger.
    solver_steps_rejected,
    /// Frames whose inertial samples say nothing, since their covariance could not be factored.
    inertia_lost,
    /// Columns of the prior that were not finite, and were dropped.
    prior_columns_lost,
    /// All resets; below by their reason.
    resets,
    /// No frame came for `FRAME_GAP_MAX`.
    resets_frame_gap,
    /// Vision and inertia disagreed.
    resets_disagreement,
    /// Nothing known was seen for too long.
    resets_unseen,
    /// The state was not finite, or beyond what flies.
    resets_state,
    /// Resets at which what was learnt of the rig was thrown away, since no rig could be so.
    rigs_thrown_away,
    /// Frames of which a camera saw next to nothing while another did.
    camera_blind,
    /// Pressures that were no number, of no altitude that is flown, or not newer than the last.
    pressures_rejected,
    /// Pressures of a barometer that repeats itself.
    pressures_frozen,
    /// Pressures that came when every frame of their time had left the estimate.
    pressures_late,
    /// Frames with a height; frames whose height could not be; steps that stayed and were taken for a change of the weather.
    heights_used,
    heights_gated,
    height_steps,
    /// Frames held still because nothing moved.
    zero_velocity_updates,
    solver_iterations,
}

impl Stats {
    /// A reset, by its reason.
    pub fn add_reset(&mut self, why: Reset) {
        self.resets += 1;
        match why {
            Reset::FrameGap => self.resets_frame_gap += 1,
            Reset::Disagreement => self.resets_disagreement += 1,
            Reset::Unseen => self.resets_unseen += 1,
            Reset::State => self.resets_state += 1,
            Reset::Asked => {}
        }
    }
}

/// Frames by what their health and their quality were.
#[derive(Clone, Debug)]
pub struct Tally {
    health: [u64; Health::NAMES.len()],
    quality: [u64; 101],
}

impl Default for Tally {
    fn default() -> Tally {
        Tally { health: [0; Health::NAMES.len()], quality: [0; 101] }
    }
}

impl Tally {
    /// A frame; its quality counts where there is odometry.
    pub fn add(&mut self, health: Health, quality: Option<u8>) {
        for (i, n) in self.health.iter_mut().enumerate() {
            *n += u64::from(health.0 >> i & 1);
        }
        if let Some(q) = quality {
            self.quality[usize::from(q.min(100))] += 1;
        }
    }

    /// Frames on which each bit was set, by its name.
    pub fn health(&self) -> impl Iterator<Item = (&'static str, u64)> + '_ {
        Health::NAMES.into_iter().zip(self.health)
    }

    fn frames(&self) -> u64 {
        self.quality.iter().sum()
    }

    /// Lowest and median quality, and the share of frames under 50; `None` without odometry.
    pub fn quality(&self) -> Option<(u8, u8, f64)> {
        let n = self.frames();
        let rank = |from: u64| {
            let mut seen = 0;
            self.quality.iter().position(|count| {
                seen += count;
                seen > from
            })
        };
        let under: u64 = self.quality[..50].iter().sum();
        (n > 0).then_some(())?;
        Some((rank(0)? as u8, rank(n / 2)? as u8, under as f64 / n as f64))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tally_tells_frames_by_bit_and_quality() {
        let mut tally = Tally::default();
        assert_eq!(tally.quality(), None);
        tally.add(Health::INITIALISING, None);
        for q in [90, 20, 40, 95] {
            tally.add(Health::IMU_GAP | Health::INERTIA_ALONE, Some(q));
        }
        assert_eq!(tally.quality(), Some((20, 90, 0.5)));
        let set: Vec<_> = tally.health().filter(|(_, n)| *n > 0).collect();
        assert_eq!(set, [("initialising", 1), ("imu_gap", 4), ("inertia_alone", 4)]);
    }
}
