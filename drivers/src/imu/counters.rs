//! What was met on the way from an inertial unit to its samples, by name.

use super::bus::BusFault;
use super::die::Trouble;

crate::counters! {
    #[derive(Clone, Copy, PartialEq, Eq)]
    pub struct ImuCounters of u64, read by u64::clone;
    /// Transfers that nobody acknowledged.
    imu_nacks,
    /// Transfers that ended before all was said, and reads that held no whole sample.
    imu_short_transfers,
    /// Transfers that gave up on a busy bus.
    imu_bus_busy,
    /// Transfers that failed otherwise.
    imu_bus_errors,
    /// Times that the bus or the device was gone.
    imu_gone,
    /// Times that the FIFO was full, and cleared.
    imu_fifo_overflows,
    /// FIFO counts that cannot be.
    imu_fifo_garbage,
    /// Frames that were marked invalid or made no sense.
    imu_frames_invalid,
    /// Samples that the unit itself says it dropped.
    imu_samples_skipped,
    /// Holes of more than one and a half periods between samples, and how many are missing in them.
    imu_gaps,
    imu_samples_missing,
    /// Times that a sensor gave one value for too long.
    imu_frozen,
    /// Times that a unit answered and gave no samples.
    imu_silences,
    /// Answers to WHO_AM_I of another chip.
    imu_strangers,
    /// Samples with an axis at the end of its range.
    imu_saturated,
    /// Times that the unit was set up anew, and those that failed.
    imu_restarts,
    imu_restarts_failed,
    /// Times that the sensor's clock had to be found anew.
    imu_clock_slips,
    /// Stamps of the kernel that were not newer than the last, or of the future: their samples were put near their
    /// neighbours.
    imu_stamps_refused,
    /// Edges of another clock, or out of order; edges without a sample and samples without an edge; failures to read
    /// edges.
    imu_edges_refused,
    imu_edges_unmatched,
    imu_edge_faults,
    /// Samples of the gyro that none of the accelerometer stands beside, where they are two dies.
    imu_unpaired,
    /// The estimate of the sample rate, 1/1000 Hz of the host's clock.
    imu_rate_millihertz,
}

impl ImuCounters {
    pub fn count(&mut self, trouble: &Trouble) {
        let counter = match trouble {
            Trouble::Bus(BusFault::Nack) => &mut self.imu_nacks,
            Trouble::Bus(BusFault::Short) => &mut self.imu_short_transfers,
            Trouble::Bus(BusFault::Busy) => &mut self.imu_bus_busy,
            Trouble::Bus(BusFault::Gone) => &mut self.imu_gone,
            Trouble::Bus(BusFault::Io | BusFault::Refused(_)) => &mut self.imu_bus_errors,
            Trouble::Overflow => &mut self.imu_fifo_overflows,
            Trouble::Garbage(_) => &mut self.imu_fifo_garbage,
            Trouble::Frozen(_) => &mut self.imu_frozen,
            Trouble::Silent => &mut self.imu_silences,
            Trouble::Stranger(_) => &mut self.imu_strangers,
            // Of a restart, which is counted itself.
            Trouble::Stuck(..) | Trouble::NoConfiguration | Trouble::BadConfiguration(_) | Trouble::SelfTest(..) => {
                return
            }
        };
        *counter += 1;
    }
}
