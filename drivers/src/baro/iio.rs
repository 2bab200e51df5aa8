//! A barometer that the kernel drives (bmp280, which has the BMP388 too; dps310, ms5611, lps22): `in_pressure_input`, kPa,
//! or `in_pressure_raw` with its scale and offset. Each read of the file is a measurement.

use super::{BaroError, Sensor};
use crate::host::monotonic;
use crate::imu::bus::BusFault;
use crate::imu::{is_called, pause};
use crate::types::{Nanos, Span};
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

const PA_A_KPA: f64 = 1000.0;

/// A device of the kernel's.
pub(super) struct Iio {
    wanted: String,
    sysfs: PathBuf,
    file: Option<File>,
    /// kPa = (number + offset) scale.
    offset: f64,
    scale: f64,
}

impl Iio {
    pub(super) fn new(wanted: &str, sysfs: impl Into<PathBuf>) -> Iio {
        Iio { wanted: wanted.into(), sysfs: sysfs.into(), file: None, offset: 0.0, scale: 1.0 }
    }

    fn read(&self) -> Result<f64, BaroError> {
        let mut text = [0; 64];
        let n = self.file.as_ref().ok_or(BusFault::Gone)?.read_at(&mut text, 0).map_err(fault)?;
        let number = std::str::from_utf8(&text[..n]).ok().and_then(|t| t.trim().parse::<f64>().ok());
        number.ok_or(BaroError::Bus(BusFault::Short))
    }
}

fn fault(e: io::Error) -> BaroError {
    BaroError::Bus(BusFault::of(e.raw_os_error().unwrap_or(libc::EIO)))
}

fn number(path: &Path) -> Option<f64> {
    std::fs::read_to_string(path).ok()?.trim().parse().ok()
}

impl Sensor for Iio {
    fn start(&mut self) -> Result<(), BaroError> {
        self.file = None;
        let devices = std::fs::read_dir(&self.sysfs).into_iter().flatten().flatten().map(|e| e.path());
        let has_pressure = |d: &PathBuf| ["input", "raw"].iter().any(|n| d.join(format!("in_pressure_{n}")).is_file());
        let found: Vec<PathBuf> = devices.filter(|d| has_pressure(d) && is_called(d, &self.wanted)).collect();
        let [device] = &found[..] else { return Err(BaroError::Named(found.len())) };
        let processed = device.join("in_pressure_input");
        let attribute = |name: &str| number(&device.join(format!("in_pressure_{name}")));
        (self.offset, self.scale) = (0.0, 1.0);
        let path = if processed.is_file() {
            processed
        } else {
            (self.offset, self.scale) = (attribute("offset").unwrap_or(0.0), attribute("scale").unwrap_or(1.0));
            device.join("in_pressure_raw")
        };
        self.file = Some(File::open(path).map_err(fault)?);
        Ok(())
    }

    fn measure(&mut self) -> Result<(Nanos, f64), BaroError> {
        let begun = monotonic();
        let kpa = (self.read()? + self.offset) * self.scale;
        Ok((begun + Span((monotonic() - begun).0 / 2), kpa * PA_A_KPA))
    }

    fn now(&self) -> Nanos {
        monotonic()
    }

    fn sleep(&mut self, span: Span) {
        pause(span);
    }
}
