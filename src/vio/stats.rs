//! What the estimator counts, and under which names it reaches the report.

use super::health::Health;

/// What was dropped, refused, or went wrong so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stats {
    pub frames: u64,
    pub keyframes: u64,
    pub imu_rejected: u64,
    /// Samples of which one axis could not be motion, and was put between its neighbours.
    pub imu_repaired: u64,
    pub imu_overflow: u64,
    /// Samples at the end of the sensor's range.
    pub imu_saturated: u64,
    /// Frames not newer than the last.
    pub frames_rejected: u64,
    /// Tracks of cameras the rig has not, with pixels that are none, or out of order.
    pub tracks_rejected: u64,
    /// Views of known landmarks too far from where these must be.
    pub tracks_gated: u64,
    /// Frames of which so many were that the prediction must have been wrong, and none was refused.
    pub gates_opened: u64,
    pub landmarks_full: u64,
    pub outliers: u64,
    pub solver_failures: u64,
    /// All resets; below by their reason.
    pub resets: u64,
    /// No frame came for `FRAME_GAP_MAX`.
    pub resets_frame_gap: u64,
    /// Vision and inertia disagreed.
    pub resets_disagreement: u64,
    /// Nothing known was seen for too long.
    pub resets_unseen: u64,
    /// The state was not finite, or beyond what flies.
    pub resets_state: u64,
    /// Holes in the inertial samples.
    pub imu_gaps: u64,
    /// Frames of which a camera saw next to nothing while another did.
    pub camera_blind: u64,
    pub iterations: u64,
    /// Frames held still because nothing moved.
    pub zero_velocity_updates: u64,
}

impl Stats {
    /// What was dropped, refused or went wrong, by name.
    pub fn counters(&self) -> [(&'static str, u64); 20] {
        [
            ("imu_rejected", self.imu_rejected),
            ("imu_repaired", self.imu_repaired),
            ("imu_overflow", self.imu_overflow),
            ("imu_saturated", self.imu_saturated),
            ("imu_gaps", self.imu_gaps),
            ("frames_rejected", self.frames_rejected),
            ("tracks_rejected", self.tracks_rejected),
            ("tracks_gated", self.tracks_gated),
            ("gates_opened", self.gates_opened),
            ("landmarks_full", self.landmarks_full),
            ("outliers", self.outliers),
            ("solver_failures", self.solver_failures),
            ("resets", self.resets),
            ("resets_frame_gap", self.resets_frame_gap),
            ("resets_disagreement", self.resets_disagreement),
            ("resets_unseen", self.resets_unseen),
            ("resets_state", self.resets_state),
            ("camera_blind", self.camera_blind),
            ("zero_velocity_updates", self.zero_velocity_updates),
            ("solver_iterations", self.iterations),
        ]
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
