//! Counters of what goes wrong between an inertial unit and its samples.

use super::bus::BusFault;
use super::error::ImuError;
use crate::types::{Nanos, Span};

/// Between samples further apart than this many periods some are missing.
const GAP: f64 = 1.5;

crate::counters! {
    /// Faults and repairs on the way from an inertial unit to its samples.
    #[derive(Clone, Copy, PartialEq, Eq)]
    pub struct ImuCounters of u64, read by u64::clone;
    /// Transfers that no device acknowledged.
    imu_nacks,
    /// Transfers that ended early, and reads that held no whole sample.
    imu_short_transfers,
    /// Transfers that gave up on a busy bus.
    imu_bus_busy,
    /// Transfers that failed otherwise.
    imu_bus_errors,
    /// Times that the bus or the device was gone.
    imu_gone,
    /// Times that the FIFO was full, and cleared.
    imu_fifo_overflows,
    /// Counts of the FIFO that are more than it holds.
    imu_fifo_garbage,
    /// Frames that were marked invalid or had an unknown header.
    imu_frames_invalid,
    /// Samples that the unit itself says it dropped.
    imu_samples_skipped,
    /// Gaps of more than one and a half periods between samples, and how many samples are missing in them.
    imu_gaps,
    imu_samples_missing,
    /// Times that a sensor gave one value for too long.
    imu_frozen,
    /// Times that a unit answered and gave no samples.
    imu_silences,
    /// Answers to WHO_AM_I of another chip.
    imu_wrong_chips,
    /// Samples with an axis at the end of its range.
    imu_saturated,
    /// Times that the unit was set up anew, and times that this failed.
    imu_restarts,
    imu_restarts_failed,
    /// Times that the estimate of the sensor's clock had to start anew.
    imu_clock_slips,
    /// Stamps of the kernel that were not newer than the last, or in the future: their samples were put near their
    /// neighbours.
    imu_stamps_refused,
    /// Edges of another clock, or out of order; edges without a sample and samples without an edge; failures to read
    /// edges.
    imu_edges_refused,
    imu_edges_unmatched,
    imu_edge_faults,
    /// Samples of the gyro without one of the accelerometer beside it, where they are two dies.
    imu_unpaired,
    /// The estimate of the sample rate, 1/1000 Hz of the host's clock.
    imu_rate_millihertz,
}

impl ImuCounters {
    /// Counts an error under its name.
    pub fn count(&mut self, error: &ImuError) {
        let counter = match error {
            ImuError::Bus(BusFault::Nack) => &mut self.imu_nacks,
            ImuError::Bus(BusFault::Short) => &mut self.imu_short_transfers,
            ImuError::Bus(BusFault::Busy) => &mut self.imu_bus_busy,
            ImuError::Bus(BusFault::Gone) => &mut self.imu_gone,
            ImuError::Bus(BusFault::Io | BusFault::Refused(_)) => &mut self.imu_bus_errors,
            ImuError::Overflow => &mut self.imu_fifo_overflows,
            ImuError::BadCount(_) => &mut self.imu_fifo_garbage,
            ImuError::Frozen(_) => &mut self.imu_frozen,
            ImuError::Silent => &mut self.imu_silences,
            ImuError::WrongChip(_) => &mut self.imu_wrong_chips,
            // They end a restart, which is counted itself.
            ImuError::Stuck(..)
            | ImuError::NoConfiguration
            | ImuError::BadConfiguration(_)
            | ImuError::SelfTest(..) => return,
        };
        *counter += 1;
    }

    /// Counts the gap before a sample at `t`, where more than `GAP` periods have passed since `last`.
    pub fn count_gap(&mut self, last: Option<Nanos>, t: Nanos, period: Span) {
        let periods = last.map_or(1.0, |last| (t - last).0 as f64 / period.0 as f64);
        if periods > GAP {
            self.imu_gaps += 1;
            self.imu_samples_missing += (periods.round() - 1.0).max(1.0) as u64;
        }
    }
}
