//! `[record]`: what `stipple record` and `stipple run --record` keep.

use serde::{Deserialize, Serialize};

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RecordConfig {
    /// Frames that wait for the disk; past it they are dropped from the recording, and counted.
    pub ring_frames: u32,
}

impl Default for RecordConfig {
    fn default() -> Self {
        // SD cards stall for a second now and then: 1.6 s at 20 Hz, 22 MiB of two 752x480 cameras.
        RecordConfig { ring_frames: 32 }
    }
}
