//! An inertial unit that the kernel drives, through its IIO buffer: sysfs says what there is and takes the settings,
//! `/dev/iio:deviceN` gives scans with the stamps of the kernel's interrupt.
//!
//! A device is chosen by its name, its label or its place in the device tree (`i2c-1/1-0068`), never by its number. A unit
//! that its driver splits into two devices (st_lsm6dsx, inv_icm42600, BMI088) is read as two and joined (`merge`). What the
//! kernel's driver does not offer (a watermark, a rate) is left as it is; what it offers and refuses is a fault at boot.
#![allow(unsafe_code)]

use super::bus::BusFault;
use super::counters::ImuCounters;
use super::error::ImuError;
use super::iio_scan::{channel, Channel, Element, Scan, Storage};
use super::merge::{pass, Merge, Reading};
use super::timeline::Timeline;
use super::{pause, watermark};
use crate::host::monotonic;
use crate::source::{ImuBatch, ImuSource, SourceFault, Wait};
use crate::types::{Nanos, Span};
use crate::{Fault, FaultKind};
use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Write};
use std::os::fd::AsRawFd;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

/// In tests each of these calls can be made to fail.
#[cfg(test)]
use super::tests::iio::{poll, read};
#[cfg(not(test))]
use libc::{poll, read};

/// A device of the kernel's, and how it is set.
#[derive(Clone, Debug, PartialEq)]
pub struct IioOptions {
    /// Name, label or place of the device; the gyro's where the accelerometer has a device of its own.
    pub device: String,
    /// The accelerometer's device; empty: the same.
    pub accel_device: String,
    /// Trigger of a device that has no data-ready interrupt of its own; empty: as the driver set it.
    pub trigger: String,
    pub rate_hz: f64,
    /// Equal values in a row that are no coincidence; 0: never.
    pub frozen_samples: u32,
    /// Where sysfs lists the devices.
    pub sysfs: PathBuf,
    /// Where their nodes are: /dev.
    pub dev: PathBuf,
}

/// Scans the kernel keeps for us: a second at 1 kHz.
const BUFFER_SCANS: u32 = 1024;
/// Scans of one read.
const READ_SCANS: usize = 64;
/// A stamp so much later than its read is of another clock, or guessed.
const AHEAD: Span = Span(1_000_000);
/// The first sample is no older than what the kernel keeps.
const FIRST_AGE_MAX: Span = Span(10_000_000_000);
/// Pause between attempts to find a lost device.
const BACKOFF: Span = Span(100_000_000);
/// No sample for so many periods, and at least so long: the device is silent.
const SILENT_PERIODS: i64 = 20;
const SILENT_MIN: Span = Span(500_000_000);

/// An inertial unit of one kernel device or two.
pub struct IioImu {
    options: IioOptions,
    /// One, or gyro and accelerometer.
    streams: Vec<Stream>,
    merge: Option<Merge>,
    /// Why it is lost, and when it is looked for again.
    lost: Option<ImuError>,
    retry: Nanos,
    counters: ImuCounters,
}

impl IioImu {
    /// Finds the devices, sets them and starts their buffers; a fault where one is missing or refuses a setting.
    pub fn open(options: &IioOptions) -> Result<IioImu, Fault> {
        let wanted = [&options.device, &options.accel_device];
        let streams = wanted.iter().filter(|w| !w.is_empty()).map(|w| Stream::open(options, w));
        let streams = streams.collect::<Result<Vec<_>, _>>()?;
        let has = |axis| streams.iter().any(|s| s.has(axis));
        let gyro_first = streams.first().is_some_and(|s| s.has(Channel::Gyro));
        if !has(Channel::Accel) || !has(Channel::Gyro) || !gyro_first {
            let what = "the IIO devices do not give three axes of both gyro and accelerometer";
            let fix = "imu.device names the gyro, imu.accel_device the accelerometer where that is another device";
            return Err(Fault::new(FaultKind::Config, "imu.device", what, fix));
        }
        let merge = streams.get(1).map(|accel| Merge::new(accel.line.period()));
        let counters = ImuCounters::default();
        Ok(IioImu { options: options.clone(), streams, merge, lost: None, retry: Nanos::MIN, counters })
    }

    /// The counters so far.
    pub fn counts(&self) -> ImuCounters {
        ImuCounters {
            imu_unpaired: self.merge.as_ref().map_or(0, |m| m.unpaired),
            imu_rate_millihertz: (self.streams[0].line.rate_hz() * 1e3).round() as u64,
            ..self.counters
        }
    }

    /// Waits for samples, `timeout` at most, and takes those that are there.
    fn collect(&mut self, timeout: Span, batch: &mut ImuBatch) -> Result<(), ImuError> {
        let failed = |errno| match errno {
            libc::ENXIO => ImuError::Bus(BusFault::Gone),
            errno => ImuError::Bus(BusFault::of(errno)),
        };
        // Only the gyro is waited for: the accelerometer's samples come beside its own.
        let first = self.streams[0].device.as_ref().ok_or(ImuError::Silent)?;
        first.wait(timeout).map_err(failed)?;
        let frozen_after = self.options.frozen_samples;
        for stream in &mut self.streams {
            let merge = &mut self.merge;
            stream.collect(&mut self.counters, |reading| pass(merge, batch, reading)).map_err(failed)?;
            if frozen_after > 0 && stream.repeats + 1 >= frozen_after {
                return Err(ImuError::Frozen("kernel's device"));
            }
            let allowed = Span(stream.line.period().0.saturating_mul(SILENT_PERIODS).max(SILENT_MIN.0));
            if monotonic() - stream.heard > allowed {
                return Err(ImuError::Silent);
            }
        }
        if let Some(merge) = &mut self.merge {
            merge.drain(batch);
        }
        Ok(())
    }

    /// Closes the devices; they are looked for again by name, as their numbers may be others then.
    fn close(&mut self, why: ImuError) {
        self.counters.count(&why);
        self.streams.iter_mut().for_each(|s| s.device = None);
        self.merge.iter_mut().for_each(Merge::clear);
        self.lost = Some(why);
        self.retry = monotonic() + BACKOFF;
    }

    /// Looks for lost devices when it is time to, and waits for that until `limit`.
    fn look_for_lost(&mut self, limit: Nanos) -> Result<(), SourceFault> {
        let Some(why) = self.lost else { return Ok(()) };
        pause(self.retry.min(limit) - monotonic());
        if monotonic() < self.retry {
            return Err(self.fault(why));
        }
        if self.streams.iter_mut().try_for_each(|s| s.reopen(&self.options)).is_err() {
            self.counters.imu_restarts_failed += 1;
            self.streams.iter_mut().for_each(|s| s.device = None);
            self.retry = monotonic() + BACKOFF;
            return Err(self.fault(why));
        }
        self.counters.imu_restarts += 1;
        self.lost = None;
        Ok(())
    }

    fn fault(&self, why: ImuError) -> SourceFault {
        why.lost(&format!("IIO {}", self.options.device))
    }
}

impl ImuSource for IioImu {
    fn next(&mut self, timeout: Span, batch: &mut ImuBatch) -> Result<Wait, SourceFault> {
        batch.clear();
        let limit = monotonic() + timeout.max(Span(0));
        loop {
            self.look_for_lost(limit)?;
            if let Err(why) = self.collect((limit - monotonic()).max(Span(0)), batch) {
                self.close(why);
            }
            if !batch.is_empty() {
                return Ok(Wait::Got);
            }
            if let Some(why) = self.lost {
                return Err(self.fault(why));
            }
            if monotonic() >= limit {
                return Ok(Wait::TimedOut);
            }
        }
    }

    fn range(&self) -> Option<[f64; 2]> {
        let of = |axis: Channel| self.streams.iter().find_map(|s| s.device.as_ref()?.scan.range(axis));
        Some([of(Channel::Gyro(0))?, of(Channel::Accel(0))?])
    }

    fn counters(&self) -> Vec<(&'static str, u64)> {
        self.counts().list()
    }
}

/// The samples of one device: stamps are checked, gaps counted.
struct Stream {
    wanted: String,
    /// `None` while it is lost.
    device: Option<Device>,
    line: Timeline,
    last: Option<Nanos>,
    /// When it gave its last sample, or was opened.
    heard: Nanos,
    /// The last values, and how often they came again.
    raw: [i64; 6],
    repeats: u32,
}

impl Stream {
    fn open(options: &IioOptions, wanted: &str) -> Result<Stream, Fault> {
        let device = Some(Device::open(options, wanted)?);
        let line = Timeline::new(Span::from_secs(1.0 / options.rate_hz));
        let (last, heard) = (None, monotonic());
        Ok(Stream { wanted: wanted.into(), device, line, last, heard, raw: [0; 6], repeats: 0 })
    }

    fn reopen(&mut self, options: &IioOptions) -> Result<(), Fault> {
        self.device = Some(Device::open(options, &self.wanted)?);
        (self.heard, self.repeats) = (monotonic(), 0);
        self.line.forget_phase();
        Ok(())
    }

    fn has(&self, axis: fn(usize) -> Channel) -> bool {
        self.device.as_ref().is_some_and(|d| d.scan.has_all(axis))
    }

    /// Hands the samples that are there to `give`; an errno where the device cannot be read.
    fn collect(&mut self, counters: &mut ImuCounters, mut give: impl FnMut(Reading)) -> Result<(), i32> {
        let device = self.device.as_mut().ok_or(libc::ENODEV)?;
        if !device.wait(Span(0))? {
            return Ok(());
        }
        let now = monotonic();
        device.read()?;
        let whole = device.held.len() - device.held.len() % device.scan.bytes;
        for bytes in device.held[..whole].chunks_exact(device.scan.bytes) {
            let before = self.raw;
            let (mut reading, stamp) = device.scan.reading(bytes, &mut self.raw);
            self.repeats = if self.raw == before { self.repeats.saturating_add(1) } else { 0 };
            let stamp = stamp.unwrap_or(now);
            let t = in_order(stamp, self.last, now, self.line.period());
            if t != stamp {
                counters.imu_stamps_refused += 1;
                self.line.forget_phase();
            } else if !self.line.advance(1, t, t, Some(t)) {
                counters.imu_clock_slips += 1;
            }
            counters.count_gap(self.last, t, self.line.period());
            self.last = Some(t);
            counters.imu_saturated += u64::from(reading.saturated);
            reading.t = t;
            give(reading);
            self.heard = now;
        }
        // A part of a scan waits for its rest.
        device.held.drain(..whole);
        counters.imu_short_transfers += u64::from(!device.held.is_empty());
        Ok(())
    }
}

/// The stamp, or a place near its neighbours where it cannot be right: a sample is worth more than its stamp. Some of the
/// kernel's drivers guess the period, and run ahead of the clock or back.
fn in_order(stamp: Nanos, last: Option<Nanos>, now: Nanos, period: Span) -> Nanos {
    let Some(last) = last else { return stamp.min(now).max(now - FIRST_AGE_MAX) };
    let t = if stamp > now + AHEAD { now.min(last + period) } else { stamp };
    t.max(last + Span(1000))
}

/// A buffer that is open and running.
struct Device {
    folder: PathBuf,
    file: File,
    scan: Scan,
    /// Bytes that were read and not taken yet.
    held: Vec<u8>,
}

impl Device {
    fn open(options: &IioOptions, wanted: &str) -> Result<Device, Fault> {
        let folder = find(options, wanted)?;
        let set = |file: &str, value: &str| write(&folder.join(file), value);
        // Before anything is set: the kernel lets one read, and what another reads must be left as it is.
        let node = options.dev.join(folder.file_name().unwrap_or_default());
        let file = OpenOptions::new().read(true).custom_flags(libc::O_NONBLOCK).open(&node).map_err(|e| {
            let fix = "let the user read it (udev rule), and end what else reads it";
            Fault::new(FaultKind::Unavailable, node.display().to_string(), e.to_string(), fix)
        })?;
        // A buffer that was left running cannot be set up.
        set("buffer/enable", "0")?;
        let scan = Scan::new(enable_channels(&folder)?);
        if !scan.has_all(Channel::Accel) && !scan.has_all(Channel::Gyro) {
            let fix = "name a device with three axes of acceleration or angular velocity";
            return Err(Fault::new(FaultKind::Config, &options.device, "it has no such channels", fix));
        }
        set("current_timestamp_clock", "monotonic")?;
        if !options.trigger.is_empty() {
            set("trigger/current_trigger", &options.trigger)?;
        }
        set_rate(&folder, options.rate_hz)?;
        set("buffer/length", &BUFFER_SCANS.to_string())?;
        set("buffer/watermark", &watermark(options.rate_hz).to_string())?;
        if !set("buffer/enable", "1")? {
            let fix = "its driver needs an interrupt, or set imu.trigger";
            return Err(Fault::new(FaultKind::Unavailable, &options.device, "it has no buffer", fix));
        }
        let held = Vec::with_capacity(scan.bytes * (READ_SCANS + 1));
        Ok(Device { folder, file, scan, held })
    }

    /// Waits for scans; false where none came, an errno where the device is gone.
    fn wait(&self, timeout: Span) -> Result<bool, i32> {
        let mut asked = libc::pollfd { fd: self.file.as_raw_fd(), events: libc::POLLIN, revents: 0 };
        let ms = (timeout.0.max(0) as u64).div_ceil(1_000_000).min(i32::MAX as u64) as i32;
        // SAFETY: one entry, which outlives the call.
        match unsafe { poll(&mut asked, 1, ms) } {
            0 => Ok(false),
            1 if asked.revents & libc::POLLIN != 0 => Ok(true),
            1 => Err(libc::ENODEV),
            _ => failed(false),
        }
    }

    /// Appends what there is to `held`, `READ_SCANS` scans at most.
    fn read(&mut self) -> Result<(), i32> {
        let kept = self.held.len();
        let room = self.scan.bytes * READ_SCANS;
        self.held.resize(kept + room, 0);
        // SAFETY: `held` has room for that many bytes from there on, and outlives the call.
        let n = match unsafe { read(self.file.as_raw_fd(), self.held[kept..].as_mut_ptr().cast(), room) } {
            0 => Err(libc::ENODEV),
            n => usize::try_from(n).or_else(|_| failed(0)),
        };
        self.held.truncate(kept + *n.as_ref().unwrap_or(&0));
        n.map(|_| ())
    }
}

impl Drop for Device {
    fn drop(&mut self) {
        // Fails when the device is gone, which is all the same.
        let _ = write(&self.folder.join("buffer/enable"), "0");
    }
}

/// The errno of a call that failed, or `nothing` where a signal came or there was nothing to read after all.
fn failed<T>(nothing: T) -> Result<T, i32> {
    match std::io::Error::last_os_error().raw_os_error() {
        Some(libc::EINTR | libc::EAGAIN) => Ok(nothing),
        errno => Err(errno.unwrap_or(libc::EIO)),
    }
}

/// Whether a device has this name or label, or is at this place in the device tree.
pub(crate) fn is_called(folder: &Path, wanted: &str) -> bool {
    let by_name = ["name", "label"].iter().any(|f| read_text(&folder.join(f)).as_deref() == Some(wanted));
    let by_place = || std::fs::canonicalize(folder).is_ok_and(|p| p.to_string_lossy().contains(wanted));
    by_name || (wanted.contains('/') && by_place())
}

/// The folder of the device that a board file names.
fn find(options: &IioOptions, wanted: &str) -> Result<PathBuf, Fault> {
    let entries = std::fs::read_dir(&options.sysfs).into_iter().flatten().filter_map(Result::ok);
    let mut devices: Vec<PathBuf> = entries.map(|e| e.path()).filter(|p| p.join("scan_elements").is_dir()).collect();
    devices.sort();
    let found: Vec<&PathBuf> = devices.iter().filter(|folder| is_called(folder, wanted)).collect();
    match found[..] {
        [one] => Ok(one.clone()),
        [] => {
            let list = devices.iter().filter_map(|d| read_text(&d.join("name"))).collect::<Vec<_>>().join(", ");
            let list = if list.is_empty() { "there is none" } else { &list };
            let what = format!("there is no IIO device `{wanted}`");
            Err(Fault::new(FaultKind::Unavailable, "imu.device", what, format!("name one with a buffer: {list}")))
        }
        _ => {
            let what = format!("{} IIO devices are called `{wanted}`", found.len());
            Err(Fault::new(FaultKind::Config, "imu.device", what, "name one by its place, such as i2c-1/1-0068"))
        }
    }
}

/// Enables the channels that are of use and no others; answers what the scan is made of.
fn enable_channels(folder: &Path) -> Result<Vec<Element>, Fault> {
    let scan = folder.join("scan_elements");
    let mut elements = Vec::new();
    let entries = std::fs::read_dir(&scan).into_iter().flatten().filter_map(Result::ok);
    for file in entries.filter_map(|e| e.file_name().into_string().ok()) {
        let Some(name) = file.strip_prefix("in_").and_then(|n| n.strip_suffix("_en")) else { continue };
        let channel = channel(name);
        let wanted = channel != Channel::Other;
        // Some drivers cannot leave a channel out: what stays enabled stands in the scan.
        write(&scan.join(&file), if wanted { "1" } else { "0" })?;
        if read_text(&scan.join(&file)).as_deref() != Some("1") {
            continue;
        }
        let element = || {
            let storage = Storage::parse(&read_text(&scan.join(format!("in_{name}_type")))?)?;
            let index = read_number(&scan.join(format!("in_{name}_index")))? as u32;
            let offset = attribute(folder, name, "offset").unwrap_or(0.0);
            let scale = attribute(folder, name, "scale").unwrap_or(1.0);
            Some(Element { channel, index, storage, offset, scale })
        };
        elements.push(element().ok_or_else(|| {
            let place = scan.join(format!("in_{name}_type")).display().to_string();
            let what = "does not say how the channel is stored";
            Fault::new(FaultKind::Unavailable, place, what, "use another driver for the device")
        })?);
    }
    Ok(elements)
}

/// A channel's attribute: `in_accel_x_scale`, or `in_accel_scale` for all axes.
fn attribute(folder: &Path, channel: &str, what: &str) -> Option<f64> {
    let shared = channel.split_once('_').map_or(channel, |(kind, _)| kind);
    [channel, shared].iter().find_map(|name| read_number(&folder.join(format!("in_{name}_{what}"))))
}

/// Sets the rate of the device, or of its sensors.
fn set_rate(folder: &Path, hz: f64) -> Result<(), Fault> {
    for file in ["sampling_frequency", "in_anglvel_sampling_frequency", "in_accel_sampling_frequency"] {
        let path = folder.join(file);
        // Drivers differ in how they want a number written: as they write it themselves, if it is one of theirs.
        let offered = read_text(&folder.join(format!("{file}_available"))).unwrap_or_default();
        let same = |text: &&str| text.parse().is_ok_and(|v: f64| (v / hz - 1.0).abs() < 0.1);
        let text = offered.split_whitespace().find(same).map_or(hz.to_string(), str::to_string);
        write(&path, &text)?;
        let Some(now) = read_number(&path) else { continue };
        if (now / hz - 1.0).abs() > 0.1 {
            let what = format!("the driver runs at {now} Hz, not {hz}");
            let fix = format!("set imu.rate_hz to a rate that it has ({offered})");
            return Err(Fault::new(FaultKind::Config, "imu.rate_hz", what, fix));
        }
    }
    Ok(())
}

/// Writes a setting; false where the driver does not have it. One that it refuses is a fault.
fn write(path: &Path, value: &str) -> Result<bool, Fault> {
    let opened = OpenOptions::new().write(true).truncate(true).open(path);
    match opened.and_then(|mut file| file.write_all(value.as_bytes())) {
        Ok(()) => Ok(true),
        Err(e) if e.kind() == ErrorKind::NotFound => Ok(false),
        Err(e) => Err(refused(path, value, &e)),
    }
}

pub(super) fn refused(path: &Path, value: &str, e: &std::io::Error) -> Fault {
    let fix = match e.kind() {
        ErrorKind::PermissionDenied => "let the user write it (udev rule, or group iio)",
        ErrorKind::ResourceBusy => "end what else reads the device (`fuser /dev/iio:device*`)",
        _ => "the kernel's driver refuses this value: see the files ending in _available beside it",
    };
    Fault::new(FaultKind::Unavailable, path.display().to_string(), format!("`{value}`: {e}"), fix)
}

fn read_text(path: &Path) -> Option<String> {
    std::fs::read_to_string(path).ok().map(|t| t.trim().to_string())
}

fn read_number(path: &Path) -> Option<f64> {
    read_text(path)?.parse().ok().filter(|v: &f64| v.is_finite())
}
