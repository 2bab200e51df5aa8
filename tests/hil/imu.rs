//! Our inertial and GPIO drivers on the real I2C, SPI, IIO and GPIO of a kernel, in the machine that `imu.sh` sets up. A
//! thread takes the part of the sensor: it writes a sample into the simulated unit (`mods/hil-imu`), then pulses its
//! data-ready line (gpio-sim). Under emulation nothing here passes or fails on latency: a stamp is right if it lies
//! between the instants before and after its pulse, whenever that was.
#![allow(clippy::unwrap_used)]

use std::fs::{read_to_string, File, OpenOptions};
use std::os::unix::fs::FileExt;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;
use stipple_drivers::gpio::{DataReady, Edge, LineName, Output, Trigger};
use stipple_drivers::host::monotonic;
use stipple_drivers::imu::edges::{EdgeQueue, Edges};
use stipple_drivers::imu::{IioImu, IioOptions, RegisterImu, RegisterOptions, Wiring};
use stipple_drivers::source::{ImuBatch, ImuReading, ImuSource, SourceFault, Wait};
use stipple_drivers::{Nanos, Span};

const MS: i64 = 1_000_000;
const RATE_HZ: f64 = 100.0;
const PERIOD: Span = Span(10 * MS);
/// The kernel stamps an edge in the interrupt that the pulse raises, which may be served a little after it.
const SERVED: Span = Span(2 * MS);

fn debug(file: &str) -> PathBuf {
    PathBuf::from("/sys/kernel/debug/hil-imu").join(file)
}

fn set(file: &str, value: u32) {
    std::fs::write(debug(file), value.to_string()).unwrap();
}

fn line_file(line: u32, what: &str) -> PathBuf {
    PathBuf::from(std::env::var("HIL_LINES").unwrap()).join(format!("sim_gpio{line}/{what}"))
}

fn pull(file: &File, up: bool) {
    file.write_at(if up { b"pull-up" } else { b"pull-down" }, 0).unwrap();
}

fn line(name: &str) -> LineName {
    LineName { chip: "hil-gpio".into(), line: name.into() }
}

fn data_ready() -> DataReady {
    DataReady::open(&line("imu-ready"), Edge::Rising).unwrap()
}

/// The sensor: sample i holds i, and came between two instants.
struct Feed {
    stop: Arc<AtomicBool>,
    fed: Arc<Mutex<Vec<(Nanos, Nanos)>>>,
    thread: Option<JoinHandle<()>>,
}

fn counts(i: i16) -> [i16; 7] {
    [i, -i, 4096, 1000, i.wrapping_mul(2), 7, -7]
}

impl Feed {
    fn start() -> Feed {
        let (stop, fed) = (Arc::new(AtomicBool::new(false)), Arc::new(Mutex::new(vec![])));
        let regs = OpenOptions::new().write(true).open(debug("regs")).unwrap();
        let ready = OpenOptions::new().write(true).open(line_file(3, "pull")).unwrap();
        let (stopped, list) = (stop.clone(), fed.clone());
        let thread = std::thread::spawn(move || {
            let mut due = monotonic();
            for i in 0..15_000 {
                if stopped.load(Ordering::Relaxed) {
                    return;
                }
                let bytes: Vec<u8> = counts(i).iter().flat_map(|v| v.to_be_bytes()).collect();
                let before = monotonic();
                regs.write_at(&bytes, 0x3B).unwrap();
                pull(&ready, true);
                list.lock().unwrap().push((before, monotonic()));
                pull(&ready, false);
                // A sensor that was late does not hurry after.
                due = (due + PERIOD).max(monotonic() + Span(PERIOD.0 / 2));
                std::thread::sleep(Duration::from_nanos((due - monotonic()).0.max(0) as u64));
            }
        });
        Feed { stop, fed, thread: Some(thread) }
    }

    /// The sample may be read before its pulse is over.
    fn between(&self, i: usize) -> (Nanos, Nanos) {
        loop {
            if let Some(instants) = self.fed.lock().unwrap().get(i) {
                return *instants;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

impl Drop for Feed {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().into_iter().for_each(|t| t.join().unwrap());
    }
}

struct Seen {
    readings: Vec<ImuReading>,
    lost: Vec<String>,
}

/// Reads until there are so many more, a minute at most.
fn read(imu: &mut dyn ImuSource, n: usize, seen: &mut Seen) {
    let (until, wanted) = (monotonic() + Span(60_000 * MS), seen.readings.len() + n);
    let mut batch = ImuBatch::default();
    while seen.readings.len() < wanted && monotonic() < until {
        match imu.next(Span(100 * MS), &mut batch) {
            Ok(Wait::Got) => seen.readings.extend(batch.iter()),
            Ok(_) => {}
            Err(SourceFault::Lost(fault)) => seen.lost.push(fault.to_string()),
            Err(fault) => panic!("{fault}"),
        }
    }
    assert!(seen.readings.len() >= wanted, "{} of {wanted}: {:?}", seen.readings.len(), imu.counters());
}

/// The numbers of the samples: every value of each must be right, stamps must grow.
fn numbers(seen: &Seen, accel: f64, gyro: f64) -> Vec<usize> {
    assert!(seen.readings.windows(2).all(|w| w[0].sample.t < w[1].sample.t), "stamps grow");
    let number = |r: &ImuReading| {
        let i = (r.sample.accel_body.x / accel).round() as i16;
        let [ax, ay, az, _, gx, gy, gz] = counts(i).map(f64::from);
        let (a, g) = (r.sample.accel_body, r.sample.gyro_body);
        let off =
            [a.x - ax * accel, a.y - ay * accel, a.z - az * accel, g.x - gx * gyro, g.y - gy * gyro, g.z - gz * gyro];
        assert!(off.iter().all(|d| d.abs() < 1e-6), "sample {i}: {r:?}");
        i as usize
    };
    seen.readings.iter().map(number).collect()
}

/// Samples between neighbours that did not arrive.
fn missing(numbers: &[usize]) -> usize {
    numbers.windows(2).map(|w| w[1].checked_sub(w[0] + 1).expect("in order and once")).sum()
}

fn registers_on(wiring: Wiring, edges: bool) -> RegisterImu {
    let options = RegisterOptions {
        chip: "mpu-6500".into(),
        wiring: vec![wiring],
        rate_hz: RATE_HZ,
        accel_range_g: 8.0,
        gyro_range_dps: 500.0,
        self_test: false,
        configuration: PathBuf::new(),
        frozen_samples: 50,
    };
    options.open(edges.then(data_ready)).unwrap()
}

fn i2c() -> Wiring {
    Wiring::I2c { adapter: "hil-imu i2c".into(), address: 0x68 }
}

fn spi() -> Wiring {
    let nodes = std::fs::read_dir("/dev").unwrap().filter_map(Result::ok).map(|e| e.path());
    let path = nodes.filter(|p| p.to_string_lossy().contains("spidev")).max().unwrap();
    Wiring::Spi { path: path.to_string_lossy().into(), hz: 1_000_000 }
}

const ACCEL: f64 = 8.0 / 32768.0 * 9.80665;
const GYRO: f64 = 500.0 / 32768.0 * std::f64::consts::PI / 180.0;

fn empty() -> Seen {
    Seen { readings: vec![], lost: vec![] }
}

mod registers {
    use super::*;

    /// Samples whose stamp is that of their pulse.
    fn stamped(seen: &Seen, feed: &Feed, numbers: &[usize]) -> usize {
        let right = |(r, i): &(&ImuReading, &usize)| {
            let (before, after) = feed.between(**i);
            (before..=after + SERVED).contains(&r.sample.t)
        };
        seen.readings.iter().zip(numbers).filter(right).count()
    }

    fn exact_with_edges(wiring: Wiring) {
        let feed = Feed::start();
        let mut imu = registers_on(wiring, true);
        let mut seen = empty();
        read(&mut imu, 400, &mut seen);
        let (numbers, c) = (numbers(&seen, ACCEL, GYRO), imu.counts());
        let right = stamped(&seen, &feed, &numbers);
        println!("{} samples, {right} stamped by their edge, {c:?}", numbers.len());
        assert_eq!((missing(&numbers), c.imu_fifo_overflows, c.imu_restarts), (0, 0, 0));
        // A sample without its edge is stamped by the estimated line, up to a read's length off. Nothing loses edges here.
        assert_eq!((right, c.imu_edges_unmatched), (numbers.len(), 0));
        assert!((seen.readings[9].temperature_c.unwrap() - 23.995).abs() < 0.01);
    }

    #[test]
    #[ignore = "needs the machine of tests/hil/imu.sh"]
    fn i2c_bursts_are_exact_and_stamped_by_their_edges() {
        exact_with_edges(i2c());
    }

    #[test]
    #[ignore = "needs the machine of tests/hil/imu.sh"]
    fn spi_bursts_are_exact_and_stamped_by_their_edges() {
        exact_with_edges(spi());
    }

    #[test]
    #[ignore = "needs the machine of tests/hil/imu.sh"]
    fn without_a_line_stamps_are_near_their_samples_and_the_clock_is_found() {
        let feed = Feed::start();
        let mut imu = registers_on(i2c(), false);
        let mut seen = empty();
        read(&mut imu, 600, &mut seen);
        let numbers = numbers(&seen, ACCEL, GYRO);
        assert_eq!(missing(&numbers), 0);
        let late: Vec<i64> =
            seen.readings.iter().zip(&numbers).map(|(r, i)| (r.sample.t - feed.between(*i).0).0.abs()).collect();
        let mut sorted = late.clone();
        sorted.sort_unstable();
        let (median, p95) = (sorted[300] / 1000, sorted[570] / 1000);
        println!("stamp less sample: median {median} us, p95 {p95} us; {:?}", imu.counts());
        // Beyond half a period a stamp is nearer to another sample than to its own; at 1 rad/s a millisecond moves a point by
        // a third of a pixel, which is what tracks are known to.
        assert!(sorted[300] < MS && sorted[570] < PERIOD.0 / 2);
        // With a rate 0.1 % off, the stamps between two reads would be wrong by 0.02 ms.
        let rate = imu.counts().imu_rate_millihertz as f64 / 1e3;
        assert!((rate / RATE_HZ - 1.0).abs() < 1e-3, "{rate} Hz");
    }

    #[test]
    #[ignore = "needs the machine of tests/hil/imu.sh"]
    fn failed_transfers_are_told_apart_and_lose_nothing() {
        let _feed = Feed::start();
        let mut imu = registers_on(i2c(), false);
        let mut seen = empty();
        read(&mut imu, 60, &mut seen);
        for file in ["fail", "short", "broken"] {
            set(file, 2);
            read(&mut imu, 60, &mut seen);
        }
        let c = imu.counts();
        assert_eq!((c.imu_nacks, c.imu_short_transfers, c.imu_bus_errors), (2, 2, 2), "{c:?}");
        assert_eq!((c.imu_restarts, missing(&numbers(&seen, ACCEL, GYRO))), (0, 0), "{c:?}");
    }

    #[test]
    #[ignore = "needs the machine of tests/hil/imu.sh"]
    fn a_burst_of_nacks_and_a_device_that_goes_are_come_back_from() {
        for wiring in [i2c(), spi()] {
            let _feed = Feed::start();
            let mut imu = registers_on(wiring, false);
            let mut seen = empty();
            read(&mut imu, 60, &mut seen);
            set("fail", 3);
            read(&mut imu, 60, &mut seen);
            let c = imu.counts();
            assert_eq!((c.imu_nacks + c.imu_bus_errors, c.imu_restarts), (3, 1), "{c:?}");
            set("gone", 1);
            let mut batch = ImuBatch::default();
            let lost = (0..40).find_map(|_| imu.next(Span(100 * MS), &mut batch).err());
            let Some(SourceFault::Lost(fault)) = lost else { panic!("{lost:?}") };
            assert!(fault.to_string().contains("not there"), "{fault}");
            set("gone", 0);
            let back = monotonic();
            read(&mut imu, 60, &mut seen);
            let c = imu.counts();
            let first = seen.readings.iter().find(|r| r.sample.t > back).unwrap();
            println!("back after {} ms, {c:?}", (first.sample.t - back).0 / MS);
            assert!(c.imu_gone >= 1 && c.imu_restarts == 2 && c.imu_gaps >= 2, "{c:?}");
            missing(&numbers(&seen, ACCEL, GYRO));
        }
    }

    #[test]
    #[ignore = "needs the machine of tests/hil/imu.sh"]
    fn a_fifo_that_overflows_is_counted_and_cleared() {
        let _feed = Feed::start();
        let mut imu = registers_on(i2c(), true);
        let mut seen = empty();
        read(&mut imu, 60, &mut seen);
        let lost_before: u32 = read_to_string(debug("lost")).unwrap().trim().parse().unwrap();
        // 36 samples fit: as many again are lost.
        std::thread::sleep(Duration::from_millis(800));
        let lost: u32 = read_to_string(debug("lost")).unwrap().trim().parse().unwrap();
        read(&mut imu, 100, &mut seen);
        let (numbers, c) = (numbers(&seen, ACCEL, GYRO), imu.counts());
        println!("{} refused by the FIFO, {} missing, {c:?}", lost - lost_before, missing(&numbers));
        assert!(lost > lost_before && c.imu_fifo_overflows >= 1 && c.imu_restarts == 0, "{c:?}");
        assert!(c.imu_gaps >= 1 && c.imu_samples_missing > 30, "{c:?}");
    }

    #[test]
    #[ignore = "needs the machine of tests/hil/imu.sh"]
    fn another_chip_or_nobody_does_not_start() {
        let options = |chip: &str, address| {
            let wiring = Wiring::I2c { adapter: "hil-imu i2c".into(), address };
            RegisterOptions {
                chip: chip.into(),
                wiring: vec![wiring],
                rate_hz: 100.0,
                accel_range_g: 8.0,
                gyro_range_dps: 500.0,
                self_test: false,
                configuration: PathBuf::new(),
                frozen_samples: 0,
            }
        };
        let refused = |chip, address| options(chip, address).open(None).map(|_| ()).unwrap_err().to_string();
        assert!(refused("mpu-6500", 0x69).contains("imu.address"), "{}", refused("mpu-6500", 0x69));
        assert!(refused("mpu-9250", 0x68).contains("0x70"), "{}", refused("mpu-9250", 0x68));
    }
}

mod kernel {
    use super::*;

    #[test]
    #[ignore = "needs the machine of tests/hil/imu.sh"]
    fn the_stock_drivers_buffer_is_read_exactly() {
        let feed = Feed::start();
        let options = IioOptions {
            device: "mpu6500".into(),
            accel_device: String::new(),
            trigger: String::new(),
            rate_hz: RATE_HZ,
            frozen_samples: 50,
            sysfs: "/sys/bus/iio/devices".into(),
            dev: "/dev".into(),
        };
        let mut imu = IioImu::open(&options).unwrap();
        let mut seen = empty();
        read(&mut imu, 400, &mut seen);
        // The driver's own range, as sysfs says it.
        let number = |file: &str| -> f64 {
            let devices = std::fs::read_dir("/sys/bus/iio/devices").unwrap().filter_map(Result::ok);
            let text = devices.filter_map(|d| read_to_string(d.path().join(file)).ok()).next().unwrap();
            text.trim().parse().unwrap()
        };
        let scales = ["in_accel_scale", "in_anglvel_scale"].map(number);
        let numbers = numbers(&seen, scales[0], scales[1]);
        let c = imu.counts();
        let mut off: Vec<i64> =
            seen.readings.iter().zip(&numbers).map(|(r, i)| (r.sample.t - feed.between(*i).0).0.abs() / 1000).collect();
        off.sort_unstable();
        let (scans, missing_ones, median, worst) = (numbers.len(), missing(&numbers), off[200], off[399]);
        println!(
            "{scans} scans, {missing_ones} missing, stamp less pulse: median {median} us, worst {worst} us, {c:?}"
        );
        // Beyond half a period a stamp is nearer to another sample than to its own. (The stock driver spaces its stamps by
        // its own estimate of the chip's clock.)
        assert!(worst < PERIOD.0 / 2000, "{worst} us");
        assert_eq!((missing(&numbers), c.imu_restarts), (0, 0));
        // Another reader is refused and spoils nothing.
        let fault = IioImu::open(&options).map(|_| ()).unwrap_err();
        assert!(fault.to_string().contains("end what else reads it"), "{fault}");
        read(&mut imu, 100, &mut seen);
        assert_eq!((missing(&super::numbers(&seen, scales[0], scales[1])), imu.counts().imu_restarts), (0, 0));
    }
}

mod lines {
    use super::*;

    #[test]
    #[ignore = "needs the machine of tests/hil/imu.sh"]
    fn edges_are_stamped_by_the_kernel_each_once() {
        let ready = OpenOptions::new().write(true).open(line_file(3, "pull")).unwrap();
        for (edge, up) in [(Edge::Rising, true), (Edge::Falling, false)] {
            pull(&ready, !up);
            let mut line = DataReady::open(&line("imu-ready"), edge).unwrap();
            assert_eq!(line.wait(Span(0)), Ok(false));
            let mut queue = EdgeQueue::default();
            for _ in 0..100 {
                let before = monotonic();
                pull(&ready, up);
                let after = monotonic();
                pull(&ready, !up);
                assert_eq!(line.wait(Span(1000 * MS)), Ok(true));
                line.drain(&mut queue).unwrap();
                let [t] = queue.stamps() else { panic!("{:?}", queue.stamps()) };
                assert!((before..=after + SERVED).contains(t), "{t:?} of {before:?} to {after:?}");
                queue.clear();
            }
            // The kernel queues 16; the rest are gone, and it says nothing.
            for _ in 0..40 {
                pull(&ready, up);
                pull(&ready, !up);
            }
            line.drain(&mut queue).unwrap();
            assert!((16..=40).contains(&queue.stamps().len()), "{}", queue.stamps().len());
            println!("{} of 40 edges in the kernel's queue", queue.stamps().len());
        }
    }

    #[test]
    #[ignore = "needs the machine of tests/hil/imu.sh"]
    fn outputs_are_read_back_and_pulses_have_their_length() {
        let value = |line| read_to_string(line_file(line, "value")).unwrap().trim().to_string();
        let mut led = Output::open(&line("6"), true).unwrap();
        assert_eq!(value(6), "1", "off is high where low is active");
        led.set(true).unwrap();
        assert_eq!(value(6), "0");
        let trigger = Output::open(&line("camera-trigger"), false).unwrap();
        assert_eq!(value(5), "0");
        let mut trigger = Trigger::new(trigger, Span(400 * MS), 2.0);
        let seen = std::thread::spawn(move || {
            std::thread::sleep(Duration::from_millis(700));
            read_to_string(line_file(5, "value")).unwrap().trim().to_string()
        });
        let start = monotonic();
        trigger.wait();
        let fired = monotonic();
        trigger.pulse().unwrap();
        assert!((fired - start).0 > 400 * MS, "{fired:?} of {start:?}");
        assert_eq!((seen.join().unwrap().as_str(), value(5).as_str()), ("1", "0"), "active while the pulse lasts");
        assert!((monotonic() - fired).0 >= 400 * MS);
    }

    #[test]
    #[ignore = "needs the machine of tests/hil/imu.sh"]
    fn lines_that_are_busy_or_not_there_are_refused() {
        let refused = |name: &str| Output::open(&line(name), false).map(|_| ()).unwrap_err().to_string();
        let held = Output::open(&line("camera-trigger"), false).unwrap();
        assert!(refused("5").contains("gpioinfo says which"), "{}", refused("5"));
        drop(held);
        assert!(Output::open(&line("5"), false).is_ok(), "dropping it lets it go");
        assert!(refused("no-such-line").contains("gpioinfo list"));
        assert!(refused("99").contains("GPIO hil-gpio line 99"));
    }
}
