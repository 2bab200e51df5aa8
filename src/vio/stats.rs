//! What the estimator counts, and under which names it reaches the report.

/// What was dropped, refused, or went wrong so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stats {
    pub frames: u64,
    pub keyframes: u64,
    pub imu_rejected: u64,
    pub imu_overflow: u64,
    /// Samples at the end of the sensor's range.
    pub imu_saturated: u64,
    /// Frames not newer than the last.
    pub frames_rejected: u64,
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
    pub fn counters(&self) -> [(&'static str, u64); 16] {
        [
            ("imu_rejected", self.imu_rejected),
            ("imu_overflow", self.imu_overflow),
            ("imu_saturated", self.imu_saturated),
            ("imu_gaps", self.imu_gaps),
            ("frames_rejected", self.frames_rejected),
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
