//! Sensors as a run reads them: a camera rig and an inertial unit, each on a thread of its own.
//!
//! Hardware and recordings (`paced`) are sources alike; the fault injector (`inject`) and the recorder (`record`) wrap
//! either. Stamps of frames are mid-exposure; they and those of inertial samples are `CLOCK_MONOTONIC` of the host, or the
//! clock of a recording. The caller lends the buffers, which are shaped once: after it was opened a source allocates
//! nothing, except to word a fault.
//!
//! A cable that comes loose ends nothing: `next` answers `Lost` for as long as the device is gone, looks for it again on
//! every call, and goes on with `Got` when it is back.

use crate::types::{Frames, ImuSample, Nanos, Span};
use crate::{Fault, List};
use std::fmt;

/// A rig of cameras.
pub trait FrameSource: Send {
    /// Waits for the next frame, `timeout` at most, and fills `frames`, which is shaped by `Frames::for_rig` or `in_colour`.
    /// Unless the answer is `Got`, its pixels are unspecified.
    fn next(&mut self, timeout: Span, frames: &mut Frames) -> Result<Wait, SourceFault>;

    /// The source that this one wraps, if it wraps one: it answers what the wrapper leaves out below.
    fn inner(&self) -> Option<&dyn FrameSource> {
        None
    }

    /// Why one camera of the rig is away while the others go on; its images are black meanwhile.
    fn away(&self) -> Option<&Fault> {
        self.inner()?.away()
    }

    /// Counters so far, by name.
    fn counters(&self) -> Vec<(&'static str, u64)> {
        self.inner().map_or_else(Vec::new, |source| source.counters())
    }

    /// The first few things that went wrong, a line each.
    fn warnings(&self) -> &[String] {
        self.inner().map_or(&[], |source| source.warnings())
    }
}

/// An inertial unit.
pub trait ImuSource: Send {
    /// Waits for samples, `timeout` at most, and fills `batch` with them in the order of their stamps. It is empty unless the
    /// answer is `Got`.
    fn next(&mut self, timeout: Span, batch: &mut ImuBatch) -> Result<Wait, SourceFault>;

    /// The source that this one wraps, if it wraps one: it answers what the wrapper leaves out below.
    fn inner(&self) -> Option<&dyn ImuSource> {
        None
    }

    /// Ends of the ranges that gyro and accelerometer are set to, rad/s and m/s², where the source knows them.
    fn range(&self) -> Option<[f64; 2]> {
        self.inner()?.range()
    }

    /// Counters so far, by name.
    fn counters(&self) -> Vec<(&'static str, u64)> {
        self.inner().map_or_else(Vec::new, |source| source.counters())
    }
}

/// A sensor beside cameras and inertial unit.
pub trait AidSource: Send {
    /// Waits for readings, `timeout` at most, and fills `batch` with them in the order of their stamps. It is empty unless the
    /// answer is `Got`.
    fn next(&mut self, timeout: Span, batch: &mut AidBatch) -> Result<Wait, SourceFault>;

    /// Counters so far, by name.
    fn counters(&self) -> Vec<(&'static str, u64)> {
        vec![]
    }
}

/// What such a sensor measures. Another kind is another variant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Aid {
    /// Pressure of the air, Pa.
    Pressure(f64),
}

/// A reading of such a sensor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AidReading {
    /// When it was taken.
    pub t: Nanos,
    /// What was measured.
    pub value: Aid,
}

impl Default for AidReading {
    fn default() -> AidReading {
        AidReading { t: Nanos(0), value: Aid::Pressure(f64::NAN) }
    }
}

/// Readings of one call at most.
pub const AID_BATCH: usize = 64;

/// The readings of one call, oldest first.
pub type AidBatch = List<AidReading, AID_BATCH>;

/// The outcome of waiting for a source.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wait {
    /// The buffer is filled.
    Got,
    /// Nothing came in time.
    TimedOut,
    /// Nothing more comes: a recording is over.
    Ended,
}

/// Why a source gives nothing. The fault says which device, what happened to it and what to do.
#[derive(Clone, Debug, PartialEq)]
pub enum SourceFault {
    /// Unplugged or silent. Later calls look for it again, and wait out their timeout before they answer this anew.
    Lost(Fault),
    /// Calling again is of no use.
    Broken(Fault),
}

impl SourceFault {
    /// The fault behind it.
    pub fn fault(&self) -> &Fault {
        match self {
            SourceFault::Lost(fault) | SourceFault::Broken(fault) => fault,
        }
    }
}

impl fmt::Display for SourceFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let verb = if matches!(self, SourceFault::Lost(_)) { "lost" } else { "broken" };
        write!(f, "{verb}: {}", self.fault())
    }
}

impl std::error::Error for SourceFault {}

/// An inertial sample with what its source knows beside it.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct ImuReading {
    /// Stamp, angular velocity and specific force.
    pub sample: ImuSample,
    pub temperature_c: Option<f32>,
    /// An axis stands at the end of its range.
    pub saturated: bool,
}

/// A reading from this fraction of its range on stands at the end of it.
pub const RANGE_END: f64 = 0.99;

/// Readings alike to the last bit for so long are of a unit that hangs.
const FROZEN: Span = Span(100_000_000);
/// Fewest readings alike that tell: a unit whose noise is a third of a step repeats all six axes one time in five.
const FROZEN_READINGS_MIN: f64 = 20.0;

/// Readings alike in a row, at a rate in Hz, that are of a unit that hangs.
pub fn frozen_readings(rate_hz: f64) -> u32 {
    (FROZEN.secs() * rate_hz).round().max(FROZEN_READINGS_MIN) as u32
}

/// The other cameras go on without one that gave no image for so long: five of its periods, and at least half a second, a
/// quarter of what odometry bridges.
pub(crate) fn missed_after(period: Span) -> Span {
    Span(period.0.saturating_mul(5)).max(Span(500_000_000))
}

/// Samples of one call at most: more than the largest FIFO of the units that are driven holds (LSM6DSOX: 219), fewer than a
/// tenth of what a run queues.
pub const IMU_BATCH: usize = 256;

/// The readings of one call, oldest first.
pub type ImuBatch = List<ImuReading, IMU_BATCH>;
