//! The IIO backend against a made-up sysfs and a pipe for a device: layout, settings, values, and what is refused.
#![cfg(test)]
#![allow(clippy::unwrap_used, unsafe_code)]

use crate::host::monotonic;
use crate::imu::bus::BusFault;
use crate::imu::iio::{IioImu, IioOptions};
use crate::imu::unit::GRAVITY;
use crate::source::{ImuBatch, ImuReading, ImuSource, SourceFault, Wait};
use crate::types::{Nanos, Span};
use std::cell::Cell;
use std::fs::{create_dir_all, read_to_string, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

const MS: i64 = 1_000_000;

thread_local! {
    /// Which system call fails, with which error.
    static STRUCK: Cell<(&'static str, i32)> = const { Cell::new(("", 0)) };
}

fn struck(call: &str) -> bool {
    let (which, errno) = STRUCK.get();
    if which == call {
        // SAFETY: the errno of this thread.
        unsafe { *libc::__errno_location() = errno };
    }
    which == call
}

pub unsafe fn poll(fds: *mut libc::pollfd, count: libc::nfds_t, ms: libc::c_int) -> libc::c_int {
    if struck("poll") {
        -1
    } else {
        // SAFETY: as the caller has it.
        unsafe { libc::poll(fds, count, ms) }
    }
}

pub unsafe fn read(fd: libc::c_int, into: *mut libc::c_void, count: usize) -> isize {
    if struck("read") {
        -1
    } else {
        // SAFETY: as the caller has it.
        unsafe { libc::read(fd, into, count) }
    }
}

struct Kernel {
    root: tempfile::TempDir,
}

/// Steps of ±8 g and ±500 °/s, as inv_mpu6050 writes them.
const ACCEL_SCALE: f64 = 0.002394;
const GYRO_SCALE: f64 = 0.000266;

impl Kernel {
    fn new() -> Kernel {
        let root = tempfile::tempdir().unwrap();
        create_dir_all(root.path().join("dev")).unwrap();
        Kernel { root }
    }

    fn folder(&self, number: u32) -> PathBuf {
        self.root.path().join(format!("sys/iio:device{number}"))
    }

    fn put(&self, number: u32, file: &str, text: &str) {
        let path = self.folder(number).join(file);
        create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    }

    fn node(&self, number: u32) -> PathBuf {
        self.root.path().join(format!("dev/iio:device{number}"))
    }

    /// A device with these kinds of axes, and a channel that we have no use for.
    fn device(&self, number: u32, name: &str, kinds: &[&str]) {
        self.put(number, "name", &format!("{name}\n"));
        let mut index = 0;
        let mut element = |channel: &str, kind: &str| {
            let file = |what: &str| format!("scan_elements/in_{channel}_{what}");
            self.put(number, &file("en"), "0\n");
            self.put(number, &file("type"), kind);
            self.put(number, &file("index"), &format!("{index}\n"));
            index += 1;
        };
        for kind in kinds {
            ["x", "y", "z"].iter().for_each(|axis| element(&format!("{kind}_{axis}"), "be:s16/16>>0\n"));
        }
        element("temp", "be:s16/16>>0\n");
        element("magn_x", "le:s16/16>>0\n");
        element("timestamp", "le:s64/64>>0\n");
        let files = [
            ("in_accel_scale", ACCEL_SCALE.to_string()),
            ("in_anglvel_scale", GYRO_SCALE.to_string()),
            ("in_temp_scale", "2.994".into()),
            ("in_temp_offset", "7011".into()),
            ("sampling_frequency", "50".into()),
            ("sampling_frequency_available", "10 50 200.000 500".into()),
            ("current_timestamp_clock", "realtime".into()),
            ("buffer/enable", "0".into()),
            ("buffer/length", "2".into()),
            ("trigger/current_trigger", "".into()),
        ];
        files.iter().for_each(|(file, text)| self.put(number, file, text));
        let node = std::ffi::CString::new(self.node(number).to_str().unwrap()).unwrap();
        // SAFETY: a path that ends in zero and outlives the call.
        assert_eq!(unsafe { libc::mkfifo(node.as_ptr(), 0o600) }, 0);
    }

    fn options(&self, device: &str) -> IioOptions {
        IioOptions {
            device: device.into(),
            accel_device: String::new(),
            trigger: String::new(),
            rate_hz: 200.0,
            frozen_samples: 40,
            sysfs: self.root.path().join("sys"),
            dev: self.root.path().join("dev"),
        }
    }

    fn set(&self, number: u32, file: &str) -> String {
        read_to_string(self.folder(number).join(file)).unwrap()
    }

    /// The writing end of a device that is being read.
    fn writer(&self, number: u32) -> File {
        OpenOptions::new().write(true).open(self.node(number)).unwrap()
    }
}

/// Axes, temperature (none where the channel is off), padding, stamp: `in_magn_x` is left out.
fn scan(axes: &[i16], temperature: i16, t: Nanos) -> Vec<u8> {
    let mut bytes: Vec<u8> = axes.iter().chain([&temperature]).flat_map(|v| v.to_be_bytes()).collect();
    bytes.resize(bytes.len().next_multiple_of(8), 0xEE);
    bytes.extend(t.0.to_le_bytes());
    bytes
}

fn next(imu: &mut IioImu) -> (Result<Wait, SourceFault>, Vec<ImuReading>) {
    let mut batch = ImuBatch::default();
    let wait = imu.next(Span(30 * MS), &mut batch);
    (wait, batch.to_vec())
}

#[test]
fn scans_of_one_device_are_read_to_the_bit() {
    let kernel = Kernel::new();
    kernel.device(3, "mpu6500", &["accel", "anglvel"]);
    let mut imu = IioImu::open(&kernel.options("mpu6500")).unwrap();
    let set = ["buffer/enable", "buffer/length", "current_timestamp_clock", "sampling_frequency"];
    assert_eq!(set.map(|f| kernel.set(3, f)), ["1", "1024", "monotonic", "200.000"]);
    assert_eq!(kernel.set(3, "scan_elements/in_anglvel_z_en"), "1");
    assert_eq!(kernel.set(3, "scan_elements/in_magn_x_en"), "0");
    assert_eq!(imu.range(), Some([GYRO_SCALE, ACCEL_SCALE].map(|scale| 32767.0 * scale)));
    let mut writer = kernel.writer(3);
    assert_eq!(next(&mut imu), (Ok(Wait::TimedOut), vec![]));
    let t = monotonic();
    let scans: Vec<u8> = (0..5)
        .flat_map(|i| scan(&[i, -2, 4096, 100, -200, 32767], -3000, Nanos(t.0 - (20 - i64::from(i)) * 5 * MS)))
        .collect();
    // The last scan comes in two parts.
    writer.write_all(&scans[..scans.len() - 9]).unwrap();
    let (wait, mut seen) = next(&mut imu);
    assert_eq!((wait, seen.len()), (Ok(Wait::Got), 4));
    writer.write_all(&scans[scans.len() - 9..]).unwrap();
    seen.extend(next(&mut imu).1);
    assert_eq!(seen.len(), 5);
    for (i, reading) in seen.iter().enumerate() {
        let sample = reading.sample;
        assert_eq!(sample.t, Nanos(t.0 - (20 - i as i64) * 5 * MS));
        assert_eq!(sample.accel_body.to_array(), [i as f64 * ACCEL_SCALE, -2.0 * ACCEL_SCALE, 4096.0 * ACCEL_SCALE]);
        assert_eq!(sample.gyro_body.to_array(), [100.0 * GYRO_SCALE, -200.0 * GYRO_SCALE, 32767.0 * GYRO_SCALE]);
        assert!((sample.accel_body.z / GRAVITY - 1.0).abs() < 1e-3 && reading.saturated);
        assert!((reading.temperature_c.unwrap() - 12.009).abs() < 1e-3);
    }
    let counted = imu.counts();
    assert_eq!((counted.imu_short_transfers, counted.imu_saturated, counted.imu_gaps), (1, 5, 0));
}

#[test]
fn a_unit_of_two_devices_is_joined() {
    let kernel = Kernel::new();
    kernel.device(0, "icm42600-accel", &["accel"]);
    kernel.device(1, "icm42600-gyro", &["anglvel"]);
    let options = IioOptions { accel_device: "icm42600-accel".into(), ..kernel.options("icm42600-gyro") };
    let mut imu = IioImu::open(&options).unwrap();
    let (mut accel, mut gyro) = (kernel.writer(0), kernel.writer(1));
    let t = monotonic().0 - 200 * MS;
    for i in 0..10i16 {
        let t = t + i64::from(i) * 5 * MS;
        accel.write_all(&scan(&[100 * i, 0, 4096], 0, Nanos(t))).unwrap();
        gyro.write_all(&scan(&[i, 0, 0], 0, Nanos(t + 2 * MS))).unwrap();
    }
    let (wait, seen) = next(&mut imu);
    assert_eq!((wait, seen.len()), (Ok(Wait::Got), 9), "the tenth waits for its later neighbour");
    for (i, reading) in seen.iter().enumerate() {
        let expected = (100.0 * i as f64 + 40.0) * ACCEL_SCALE;
        assert!((reading.sample.accel_body.x - expected).abs() < 1e-9, "{reading:?}");
        assert_eq!(reading.sample.t.0, t + i as i64 * 5 * MS + 2 * MS);
    }
}

#[test]
fn stamps_that_jump_are_mended_and_gaps_counted() {
    let kernel = Kernel::new();
    kernel.device(0, "mpu6500", &["accel", "anglvel"]);
    let mut imu = IioImu::open(&kernel.options("mpu6500")).unwrap();
    let mut writer = kernel.writer(0);
    let t = monotonic().0 - 400 * MS;
    let stamps =
        [t, t + 5 * MS, t + 5 * MS, t - MS, 1_900_000_000_000_000_000, t + 10 * MS, t + 50 * MS, i64::MIN, t + 55 * MS];
    for (i, t) in stamps.iter().enumerate() {
        writer.write_all(&scan(&[i as i16, 0, 0, 0, 0, 0], 0, Nanos(*t))).unwrap();
    }
    let seen = next(&mut imu).1;
    let kept: Vec<i64> = seen.iter().map(|r| (r.sample.t.0 - t) / 1000).collect();
    assert_eq!(kept, [0, 5000, 5001, 5002, 10_002, 10_003, 50_000, 50_001, 55_000], "no sample is dropped");
    let counted = imu.counts();
    assert_eq!((counted.imu_stamps_refused, counted.imu_gaps), (5, 1));
}

#[test]
fn a_device_that_goes_is_lost_and_found_under_another_number() {
    let kernel = Kernel::new();
    kernel.device(0, "mpu6500", &["accel", "anglvel"]);
    let mut imu = IioImu::open(&kernel.options("mpu6500")).unwrap();
    drop(kernel.writer(0));
    std::fs::remove_dir_all(kernel.folder(0)).unwrap();
    let (wait, _) = next(&mut imu);
    assert!(matches!(wait, Err(SourceFault::Lost(_))), "{wait:?}");
    let (wait, _) = next(&mut imu);
    assert!(matches!(wait, Err(SourceFault::Lost(_))), "{wait:?}");
    kernel.device(7, "mpu6500", &["accel", "anglvel"]);
    let mut writer = None;
    let mut seen = vec![];
    for i in 0..60 {
        // Opening a pipe to write waits for its reader.
        if writer.is_none() && kernel.set(7, "buffer/enable") == "1" {
            writer = Some(kernel.writer(7));
        }
        if let Some(writer) = &mut writer {
            writer.write_all(&scan(&[i, 0, 0, 0, 0, 0], 0, monotonic())).unwrap();
        }
        seen.extend(next(&mut imu).1);
    }
    assert!(seen.len() > 20, "{} {:?}", seen.len(), imu.counts());
    let counted = imu.counts();
    assert!(counted.imu_gone == 1 && counted.imu_restarts == 1, "{counted:?}");
}

#[test]
fn equal_scans_and_silence_close_and_reopen_the_device() {
    let kernel = Kernel::new();
    kernel.device(0, "mpu6500", &["accel", "anglvel"]);
    let mut imu = IioImu::open(&kernel.options("mpu6500")).unwrap();
    let mut writer = kernel.writer(0);
    let t = monotonic().0 - 400 * MS;
    for i in 0..45 {
        writer.write_all(&scan(&[1, 2, 3, 4, 5, 6], 0, Nanos(t + i * 5 * MS))).unwrap();
    }
    let (wait, seen) = next(&mut imu);
    assert_eq!((wait, seen.len()), (Ok(Wait::Got), 45));
    assert_eq!(imu.counts().imu_frozen, 1);
    assert_eq!(kernel.set(0, "buffer/enable"), "0", "closed");
    let until = monotonic() + Span(1200 * MS);
    while monotonic() < until && imu.counts().imu_silences == 0 {
        let _ = next(&mut imu);
    }
    assert!(imu.counts().imu_restarts >= 1 && imu.counts().imu_silences == 1, "{:?}", imu.counts());
}

/// The error of opening, in one line.
fn refused(options: &IioOptions) -> String {
    let fault = IioImu::open(options).map(|_| ()).unwrap_err();
    assert!(!fault.fix.is_empty());
    fault.to_string()
}

#[test]
fn what_cannot_be_read_is_refused_with_what_to_do() {
    let kernel = Kernel::new();
    let line = refused(&kernel.options("mpu6500"));
    assert!(line.contains("no IIO device `mpu6500`") && line.contains("there is none"), "{line}");
    kernel.device(0, "mpu6500", &["accel", "anglvel"]);
    let line = refused(&kernel.options("bmi160"));
    assert!(line.contains("mpu6500"), "{line}");
}

/// A driver that refuses a setting, as /dev/full refuses every write.
#[test]
fn every_setting_that_is_refused_is_named() {
    let settings = [
        "buffer/enable",
        "scan_elements/in_accel_x_en",
        "scan_elements/in_magn_x_en",
        "current_timestamp_clock",
        "trigger/current_trigger",
        "sampling_frequency",
        "in_anglvel_sampling_frequency",
        "in_accel_sampling_frequency",
        "buffer/length",
        "buffer/watermark",
    ];
    for setting in settings {
        let kernel = Kernel::new();
        kernel.device(0, "mpu6500", &["accel", "anglvel"]);
        let file = kernel.folder(0).join(setting);
        let _ = std::fs::remove_file(&file);
        std::os::unix::fs::symlink("/dev/full", &file).unwrap();
        let line = refused(&IioOptions { trigger: "timer".into(), ..kernel.options("mpu6500") });
        assert!(line.contains(setting) && line.contains("_available"), "{line}");
    }
    let fix = |errno| crate::imu::iio::refused(Path::new("f"), "1", &std::io::Error::from_raw_os_error(errno)).fix;
    assert!(fix(libc::EACCES).contains("udev") && fix(libc::EBUSY).contains("fuser"));
    assert!(fix(libc::EINVAL).contains("_available"));
}

/// Nodes that can be opened and not read: what reading answers closes the device, is counted, and it is looked for again.
#[test]
fn every_error_of_reading_is_a_loss_that_says_which() {
    let cases = [("/proc/self/mem", "input/output error"), ("/tmp", "Is a directory"), ("/dev/null", "not there")];
    for (node, said) in cases {
        let kernel = Kernel::new();
        kernel.device(0, "mpu6500", &["accel", "anglvel"]);
        std::fs::remove_file(kernel.node(0)).unwrap();
        std::os::unix::fs::symlink(node, kernel.node(0)).unwrap();
        let mut imu = IioImu::open(&kernel.options("mpu6500")).unwrap();
        let (wait, samples) = next(&mut imu);
        let lost = wait.unwrap_err().to_string();
        assert!(samples.is_empty() && lost.starts_with("lost: ") && lost.contains(said), "{node}: {lost}");
        let c = imu.counts();
        assert_eq!(c.imu_bus_errors + c.imu_gone, 1, "{node}: {c:?}");
    }
}

#[test]
fn every_error_of_every_call_is_a_loss_that_is_come_back_from_and_a_signal_is_none() {
    let of_poll = [libc::EFAULT, libc::EINVAL, libc::ENOMEM].map(|errno| ("poll", errno));
    let of_read = [libc::EBADF, libc::EBUSY, libc::EFAULT, libc::EINVAL, libc::EIO, libc::ENODEV, libc::ENOMEM];
    let none = [("poll", libc::EINTR), ("read", libc::EINTR), ("read", libc::EAGAIN)];
    let faults = of_poll.into_iter().chain(of_read.map(|errno| ("read", errno)));
    for (call, errno, lost) in faults.map(|(c, e)| (c, e, true)).chain(none.map(|(c, e)| (c, e, false))) {
        let kernel = Kernel::new();
        kernel.device(0, "mpu6500", &["accel", "anglvel"]);
        let mut imu = IioImu::open(&kernel.options("mpu6500")).unwrap();
        let mut writer = kernel.writer(0);
        writer.write_all(&scan(&[1, 2, 3, 4, 5, 6], 0, monotonic())).unwrap();
        STRUCK.set((call, errno));
        let (wait, samples) = next(&mut imu);
        STRUCK.set(("", 0));
        let said = BusFault::of(errno).to_string();
        match wait {
            Ok(wait) => assert!(!lost && wait == Wait::TimedOut, "{call} {errno}"),
            Err(fault) => assert!(lost && fault.to_string().contains(&said), "{call} {errno}: {fault}"),
        }
        let c = imu.counts();
        let counted = c.imu_bus_busy + c.imu_bus_errors + c.imu_gone;
        assert!(samples.is_empty() && counted == u64::from(lost), "{call} {errno}: {c:?}");
        let until = monotonic() + Span(2000 * MS);
        while next(&mut imu).0 != Ok(Wait::Got) {
            assert!(monotonic() < until, "{call} {errno}: {:?}", imu.counts());
        }
        assert_eq!(imu.counts().imu_restarts, u64::from(lost), "{call} {errno}");
    }
}

#[test]
fn devices_without_axes_or_descriptions_or_twice_are_refused() {
    let kernel = Kernel::new();
    kernel.device(0, "accel-only", &["accel"]);
    let line = refused(&kernel.options("accel-only"));
    assert!(line.contains("gyro") && line.contains("imu.accel_device"), "{line}");
    kernel.device(1, "odd", &["accel", "anglvel"]);
    kernel.put(1, "scan_elements/in_accel_y_type", "be:float");
    assert!(refused(&kernel.options("odd")).contains("in_accel_y_type"));
    kernel.device(2, "twice", &["accel", "anglvel"]);
    kernel.device(3, "twice", &["accel", "anglvel"]);
    assert!(refused(&kernel.options("twice")).contains("by its place"));
    kernel.put(3, "label", "imu-front");
    assert!(IioImu::open(&kernel.options("imu-front")).is_ok());
    std::fs::remove_file(kernel.folder(2).join("buffer/enable")).unwrap();
    std::fs::remove_dir_all(kernel.folder(3)).unwrap();
    assert!(refused(&kernel.options("twice")).contains("imu.trigger"));
    std::fs::remove_file(Path::new(&kernel.node(2))).unwrap();
    assert!(refused(&kernel.options("twice")).contains("udev"));
}
