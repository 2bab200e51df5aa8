//! An inertial unit that the kernel drives, through its IIO buffer: sysfs says what there is and takes the settings,
//! `/dev/iio:deviceN` gives the scans with the stamps of the kernel's interrupt.
//!
//! A device is chosen by its name, its label or its place in the device tree (`i2c-1/1-0068`), never by its number. A
//! unit whose driver makes two devices of it (st_lsm6dsx, inv_icm42600, BMI088) is read as two and joined. What the
//! kernel's driver does not offer (a watermark, a rate) is left as it is; what it offers and refuses is an error of
//! boot.
#![allow(unsafe_code)]

use super::counters::ImuCounters;
use super::die::Trouble;
use super::iio_scan::{channel, Channel, Element, Kind, Scan};
use super::merge::{Merge, Reading};
use super::timeline::{ClockReport, Timeline};
use super::unit::GAP;
use crate::host::monotonic;
use crate::source::{ImuBatch, ImuReading, ImuSource, SourceFault, Wait};
use crate::types::{ImuSample, Nanos, Span};
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

#[derive(Clone, Debug, PartialEq)]
pub struct IioOptions {
    /// Name, label or place of the device; of the gyro's where the accelerometer has one of its own.
    pub device: String,
    /// The accelerometer's; empty: the same device.
    pub accel_device: String,
    /// Trigger of a device that has no data-ready interrupt of its own; empty: as the driver set it.
    pub trigger: String,
    pub rate_hz: f64,
    pub frozen_samples: u32,
    /// Where sysfs and the devices are.
    pub sysfs: PathBuf,
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
const BACKOFF: Span = Span(100_000_000);
const SILENT_PERIODS: i64 = 20;
const SILENT_MIN: Span = Span(500_000_000);

fn read_text(path: &Path) -> Option<String> {
    std::fs::read_to_string(path).ok().map(|t| t.trim().to_string())
}

fn read_number(path: &Path) -> Option<f64> {
    read_text(path)?.parse().ok().filter(|v: &f64| v.is_finite())
}

/// Writes a setting; one that the driver does not have is no fault, one that it refuses is.
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

/// Folder of the device that a board file names.
fn find(options: &IioOptions, wanted: &str) -> Result<PathBuf, Fault> {
    let entries = std::fs::read_dir(&options.sysfs).into_iter().flatten().filter_map(Result::ok);
    let mut devices: Vec<PathBuf> = entries.map(|e| e.path()).filter(|p| p.join("scan_elements").is_dir()).collect();
    devices.sort();
    let named = |folder: &&PathBuf| {
        let told = ["name", "label"].iter().any(|f| read_text(&folder.join(f)).as_deref() == Some(wanted));
        let place = || std::fs::canonicalize(folder).is_ok_and(|p| p.to_string_lossy().contains(wanted));
        told || (wanted.contains('/') && place())
    };
    let found: Vec<&PathBuf> = devices.iter().filter(named).collect();
    let list = || devices.iter().filter_map(|d| read_text(&d.join("name"))).collect::<Vec<_>>().join(", ");
    match found[..] {
        [one] => Ok(one.clone()),
        [] => {
            let fix = format!(
                "name one with a buffer: {}",
                Some(list()).filter(|l| !l.is_empty()).unwrap_or("there is none".into())
            );
            Err(Fault::new(FaultKind::Unavailable, "imu.device", format!("there is no IIO device `{wanted}`"), fix))
        }
        _ => {
            let what = format!("{} IIO devices are called `{wanted}`", found.len());
            Err(Fault::new(FaultKind::Config, "imu.device", what, "name one by its place, such as i2c-1/1-0068"))
        }
    }
}

/// A buffer that is open and running.
struct Device {
    folder: PathBuf,
    file: File,
    scan: Scan,
    /// Bytes of the read that ended in the middle of a scan.
    held: Vec<u8>,
}

impl Device {
    fn open(options: &IioOptions, wanted: &str) -> Result<Device, Fault> {
        let folder = find(options, wanted)?;
        let set = |file: &str, value: &str| write(&folder.join(file), value);
        // First of all: the kernel lets one read, and what another reads must be left as it is.
        let node = options.dev.join(folder.file_name().unwrap_or_default());
        let file = OpenOptions::new().read(true).custom_flags(libc::O_NONBLOCK).open(&node).map_err(|e| {
            let fix = "let the user read it (udev rule), and end what else reads it";
            Fault::new(FaultKind::Unavailable, node.display().to_string(), e.to_string(), fix)
        })?;
        // A buffer that was left running cannot be set up.
        set("buffer/enable", "0")?;
        let scan = Scan::new(enable_channels(&folder)?);
        if scan.elements_of_interest() == 0 {
            let fix = "name a device with three axes of acceleration or angular velocity";
            return Err(Fault::new(FaultKind::Config, &options.device, "it has no such channels", fix));
        }
        set("current_timestamp_clock", "monotonic")?;
        if !options.trigger.is_empty() {
            set("trigger/current_trigger", &options.trigger)?;
        }
        set_rate(&folder, options.rate_hz)?;
        set("buffer/length", &BUFFER_SCANS.to_string())?;
        set("buffer/watermark", &super::watermark(options.rate_hz).to_string())?;
        if !set("buffer/enable", "1")? {
            let fix = "its driver needs an interrupt, or set imu.trigger";
            return Err(Fault::new(FaultKind::Unavailable, &options.device, "it has no buffer", fix));
        }
        let held = Vec::with_capacity(scan.bytes * (READ_SCANS + 1));
        Ok(Device { folder, file, scan, held })
    }

    /// Waits for scans; false where none came.
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

    /// Takes whole scans; a part of one waits for its rest.
    fn read(&mut self, counters: &mut ImuCounters, mut give: impl FnMut(&Scan, &[u8])) -> Result<usize, i32> {
        let kept = self.held.len();
        let room = self.scan.bytes * READ_SCANS;
        self.held.resize(kept + room, 0);
        // SAFETY: `held` has room for that many bytes from there on, and outlives the call.
        let n = match unsafe { read(self.file.as_raw_fd(), self.held[kept..].as_mut_ptr().cast(), room) } {
            0 => Err(libc::ENODEV),
            n => usize::try_from(n).or_else(|_| failed(0)),
        };
        self.held.truncate(kept + *n.as_ref().unwrap_or(&0));
        n?;
        let scans = self.held.len() / self.scan.bytes;
        let whole = scans * self.scan.bytes;
        self.held[..whole].chunks_exact(self.scan.bytes).for_each(|bytes| give(&self.scan, bytes));
        self.held.drain(..whole);
        counters.imu_short_transfers += u64::from(!self.held.is_empty());
        Ok(scans)
    }
}

/// What a call that failed answers: a signal, or nothing to read after all, is no fault.
fn failed<T>(nothing: T) -> Result<T, i32> {
    match std::io::Error::last_os_error().raw_os_error() {
        Some(libc::EINTR | libc::EAGAIN) => Ok(nothing),
        errno => Err(errno.unwrap_or(libc::EIO)),
    }
}

impl Drop for Device {
    fn drop(&mut self) {
        // Fails when the device is gone, which is all the same.
        let _ = write(&self.folder.join("buffer/enable"), "0");
    }
}

impl Scan {
    fn elements_of_interest(&self) -> usize {
        usize::from(self.has_all(Channel::Accel)) + usize::from(self.has_all(Channel::Gyro))
    }
}

/// Enables what we know of and nothing else, and says how the scan is made up.
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
        let described = || {
            let kind = Kind::parse(&read_text(&scan.join(format!("in_{name}_type")))?)?;
            let index = read_number(&scan.join(format!("in_{name}_index")))? as u32;
            Some(Element {
                channel,
                index,
                kind,
                offset: attribute(folder, name, "offset").unwrap_or(0.0),
                scale: attribute(folder, name, "scale").unwrap_or(1.0),
            })
        };
        elements.push(described().ok_or_else(|| {
            let place = scan.join(format!("in_{name}_type")).display().to_string();
            Fault::new(
                FaultKind::Unavailable,
                place,
                "does not say how the channel is stored",
                "another driver is needed",
            )
        })?);
    }
    Ok(elements)
}

/// `in_accel_x_scale`, or `in_accel_scale` for all axes.
fn attribute(folder: &Path, channel: &str, what: &str) -> Option<f64> {
    let shared = channel.split_once('_').map_or(channel, |(kind, _)| kind);
    [channel, shared].iter().find_map(|name| read_number(&folder.join(format!("in_{name}_{what}"))))
}

/// The rate of the device, or of its sensors.
fn set_rate(folder: &Path, hz: f64) -> Result<(), Fault> {
    let files = ["sampling_frequency", "in_anglvel_sampling_frequency", "in_accel_sampling_frequency"];
    for file in files {
        let path = folder.join(file);
        // Drivers differ in how they want a number written: as they write it themselves, if it is one of theirs.
        let offered = read_text(&folder.join(format!("{file}_available"))).unwrap_or_default();
        let same = |text: &&str| text.parse().is_ok_and(|v: f64| (v / hz - 1.0).abs() < 0.1);
        let text = offered.split_whitespace().find(same).map_or(hz.to_string(), str::to_string);
        write(&path, &text)?;
        let Some(now) = read_number(&path) else { continue };
        if (now / hz - 1.0).abs() > 0.1 {
            let fix = format!("set imu.rate_hz to one that it has ({offered})");
            return Err(Fault::new(
                FaultKind::Config,
                "imu.rate_hz",
                format!("the driver runs at {now} Hz, not {hz}"),
                fix,
            ));
        }
    }
    Ok(())
}

/// One device's stream: stamps checked, gaps counted.
struct Stream {
    wanted: String,
    device: Option<Device>,
    line: Timeline,
    last: Option<Nanos>,
    heard: Nanos,
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

    fn has(&self, axis: fn(usize) -> Channel) -> bool {
        self.device.as_ref().is_some_and(|d| d.scan.has_all(axis))
    }

    fn collect(&mut self, counters: &mut ImuCounters, mut give: impl FnMut(Reading)) -> Result<usize, i32> {
        let Some(device) = &mut self.device else { return Err(libc::ENODEV) };
        if !device.wait(Span(0))? {
            return Ok(0);
        }
        let now = monotonic();
        let (line, last, raw, repeats) = (&mut self.line, &mut self.last, &mut self.raw, &mut self.repeats);
        let mut met = *counters;
        let scans = device.read(counters, |scan, bytes| {
            let before = *raw;
            let (mut reading, stamp) = scan.reading(bytes, raw);
            *repeats = if *raw == before { repeats.saturating_add(1) } else { 0 };
            let told = stamp.unwrap_or(now);
            let t = in_order(told, *last, now, line.period());
            if t != told {
                met.imu_stamps_refused += 1;
                line.lose();
            } else if !line.advance(1, t, t, Some(t)) {
                met.imu_clock_slips += 1;
            }
            let periods = last.map_or(1.0, |last| (t - last).0 as f64 / line.period().0 as f64);
            if periods > GAP {
                met.imu_gaps += 1;
                met.imu_samples_missing += (periods.round() - 1.0).max(1.0) as u64;
            }
            *last = Some(t);
            met.imu_saturated += u64::from(reading.saturated);
            reading.t = t;
            give(reading);
        });
        met.imu_short_transfers = counters.imu_short_transfers;
        *counters = met;
        let scans = scans?;
        if scans > 0 {
            self.heard = now;
        }
        Ok(scans)
    }
}

/// A stamp, or where it cannot be one a place near its neighbours: a sample is worth more than its stamp. Some of the
/// kernel's drivers guess the period, and run ahead of the clock or back.
fn in_order(told: Nanos, last: Option<Nanos>, now: Nanos, period: Span) -> Nanos {
    let Some(last) = last else { return told.min(now).max(now - FIRST_AGE_MAX) };
    let t = if told > now + AHEAD { now.min(last + period) } else { told };
    t.max(last + Span(1000))
}

pub struct IioImu {
    options: IioOptions,
    /// One, or gyro and accelerometer.
    streams: Vec<Stream>,
    merge: Option<Merge>,
    retry: Nanos,
    lost: Option<Trouble>,
    counters: ImuCounters,
}

impl IioImu {
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
        Ok(IioImu { options: options.clone(), streams, merge, retry: Nanos::MIN, lost: None, counters })
    }

    pub fn clock(&self) -> ClockReport {
        self.streams[0].line.report()
    }

    pub fn seen(&self) -> ImuCounters {
        ImuCounters {
            imu_unpaired: self.merge.as_ref().map_or(0, |m| m.unpaired),
            imu_rate_millihertz: (self.clock().rate_hz * 1e3).round() as u64,
            ..self.counters
        }
    }

    fn collect(&mut self, timeout: Span, batch: &mut ImuBatch) -> Result<(), Trouble> {
        let gone = |errno| match errno {
            libc::ENODEV | libc::EBADF | libc::ENXIO => Trouble::Bus(super::bus::BusFault::Gone),
            errno => Trouble::Bus(super::bus::BusFault::of(errno)),
        };
        // Only the gyro is waited for: the accelerometer's samples are beside its own.
        let first = self.streams[0].device.as_ref().ok_or(Trouble::Silent)?;
        first.wait(timeout).map_err(gone)?;
        let frozen_after = self.options.frozen_samples;
        for stream in &mut self.streams {
            let merge = &mut self.merge;
            stream
                .collect(&mut self.counters, |reading| match merge {
                    Some(merge) => merge.push(reading),
                    None => push(batch, reading),
                })
                .map_err(gone)?;
            if frozen_after > 0 && stream.repeats + 1 >= frozen_after {
                return Err(Trouble::Frozen("kernel's device"));
            }
            let allowed = Span(stream.line.period().0.saturating_mul(SILENT_PERIODS).max(SILENT_MIN.0));
            if monotonic() - stream.heard > allowed {
                return Err(Trouble::Silent);
            }
        }
        if let Some(merge) = &mut self.merge {
            merge.drain(batch);
        }
        Ok(())
    }

    /// Closes the devices; they are looked for again by name, as their numbers may be others then.
    fn close(&mut self, why: Trouble) {
        self.counters.count(&why);
        self.streams.iter_mut().for_each(|s| s.device = None);
        self.merge.iter_mut().for_each(Merge::clear);
        self.lost = Some(why);
        self.retry = monotonic() + BACKOFF;
    }

    fn look(&mut self, limit: Nanos) -> Result<(), SourceFault> {
        let Some(why) = self.lost else { return Ok(()) };
        super::pause(self.retry.min(limit) - monotonic());
        if monotonic() < self.retry {
            return Err(self.fault(why));
        }
        for i in 0..self.streams.len() {
            match Device::open(&self.options, &self.streams[i].wanted) {
                Ok(device) => {
                    let stream = &mut self.streams[i];
                    (stream.device, stream.heard, stream.repeats) = (Some(device), monotonic(), 0);
                    stream.line.lose();
                }
                Err(_) => {
                    self.counters.imu_restarts_failed += 1;
                    self.streams.iter_mut().for_each(|s| s.device = None);
                    self.retry = monotonic() + BACKOFF;
                    return Err(self.fault(why));
                }
            }
        }
        self.counters.imu_restarts += 1;
        self.lost = None;
        Ok(())
    }

    fn fault(&self, why: Trouble) -> SourceFault {
        let fix = "check cable, supply and the kernel's log; it is looked for again and again";
        let what = format!("the inertial unit is lost: {why}");
        SourceFault::Lost(Fault::new(FaultKind::Unavailable, format!("IIO {}", self.options.device), what, fix))
    }
}

fn push(batch: &mut ImuBatch, reading: Reading) {
    if let (Some(gyro_body), Some(accel_body)) = (reading.gyro, reading.accel) {
        let sample = ImuSample { t: reading.t, gyro_body, accel_body };
        let pushed =
            batch.push(ImuReading { sample, temperature_c: reading.temperature_c, saturated: reading.saturated });
        debug_assert!(pushed.is_ok(), "a batch holds more than one read");
    }
}

impl ImuSource for IioImu {
    fn next(&mut self, timeout: Span, batch: &mut ImuBatch) -> Result<Wait, SourceFault> {
        batch.clear();
        let limit = monotonic() + timeout.max(Span(0));
        loop {
            self.look(limit)?;
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

    fn counters(&self) -> Vec<(&'static str, u64)> {
        self.seen().list()
    }
}
