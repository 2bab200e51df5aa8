//! An MPU-6500 that plays a recording: hil-imu's registers and its data-ready line, sample by sample as they are due.
#![allow(dead_code)] // one test looks at what came, another plays alone

use std::fmt::Write as _;
use std::fs::{File, OpenOptions};
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;
use stipple_drivers::host::monotonic;
use stipple_drivers::{ImuSample, Nanos, Span};

pub const RATE_HZ: u32 = 200;
const PERIOD: Span = Span(1_000_000_000 / RATE_HZ as i64);
/// One step at ±16 g, m/s², and at ±2000 °/s, rad/s.
const ACCEL: f64 = 16.0 / 32768.0 * 9.80665;
const GYRO: f64 = 2000.0 / 32768.0 * std::f64::consts::PI / 180.0;

/// Counts of accelerometer and gyro, in the order of the registers.
pub type Counts = [i16; 6];

/// Samples that were given, and when.
type Given = Vec<(Counts, Nanos)>;

pub fn counts(s: &ImuSample) -> Counts {
    let [a, g] = [s.accel_body / ACCEL, s.gyro_body / GYRO].map(|v| v.to_array().map(|v| v.round() as i16));
    [a[0], a[1], a[2], g[0], g[1], g[2]]
}

pub fn sample(t: Nanos, c: Counts) -> ImuSample {
    let [ax, ay, az, gx, gy, gz] = c.map(f64::from);
    ImuSample {
        t,
        gyro_body: glam::dvec3(gx, gy, gz) * GYRO,
        accel_body: glam::dvec3(ax, ay, az) * ACCEL,
        ..ImuSample::default()
    }
}

/// The unit, which never rests: what it gives before the recording starts is the recording backwards.
pub struct Feed {
    length: Span,
    /// Sample `n` is due `n` periods after it.
    first: Nanos,
    begins: Arc<AtomicUsize>,
    given: Arc<Mutex<Given>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Feed {
    pub fn start(recorded: Vec<Counts>) -> Feed {
        let (begins, given, stop): (Arc<AtomicUsize>, Arc<Mutex<Given>>, Arc<AtomicBool>) = Default::default();
        let lines = std::env::var("HIL_LINES").expect("set by lines.sh");
        let length = Span(recorded.len() as i64 * PERIOD.0);
        let open = |path: &Path| OpenOptions::new().write(true).open(path).unwrap();
        let registers = open(Path::new("/sys/kernel/debug/hil-imu/regs"));
        let ready = open(&Path::new(&lines).join("sim_gpio3/pull"));
        let (first, n0, list, stopped) = (monotonic(), begins.clone(), given.clone(), stop.clone());
        let thread = std::thread::spawn(move || {
            for n in 0.. {
                let wait = first + Span(n as i64 * PERIOD.0) - monotonic();
                std::thread::sleep(Duration::from_nanos(wait.0.max(0) as u64));
                if stopped.load(Relaxed) {
                    return;
                }
                let counts = recorded[n0.load(Relaxed).abs_diff(n) % recorded.len()];
                list.lock().unwrap().push((counts, monotonic()));
                give(&registers, &ready, counts);
            }
        });
        Feed { length, first, begins, given, stop, thread: Some(thread) }
    }

    /// After how long it gives the recording again.
    pub fn length(&self) -> Span {
        self.length
    }

    fn due(&self, n: usize) -> Nanos {
        self.first + Span(n as i64 * PERIOD.0)
    }

    /// Plays the recording from the first sample that is due after `t`, at the instant it answers.
    pub fn play_after(&self, t: Nanos) -> Nanos {
        let n = ((t - self.first).0 / PERIOD.0) as usize + 1;
        self.begins.store(n, Relaxed);
        self.due(n)
    }

    /// All that was given, as an EuRoC table.
    pub fn csv(&self) -> String {
        let mut text = "#t,gyro,accel\n".to_string();
        for (n, (c, _)) in self.given.lock().unwrap().iter().enumerate() {
            let (t, s) = (self.due(n), sample(self.due(n), *c));
            let (g, a) = (s.gyro_body, s.accel_body);
            writeln!(text, "{},{:.9},{:.9},{:.9},{:.9},{:.9},{:.9}", t.0, g.x, g.y, g.z, a.x, a.y, a.z).unwrap();
        }
        text
    }

    /// How much later than due each was given from `t` on, ns: none of a real unit, and of this one what the kernel held
    /// its processor for.
    pub fn slow(&self, t: Nanos) -> Vec<i64> {
        let given = self.given.lock().unwrap();
        given.iter().enumerate().filter(|(_, g)| g.1 > t).map(|(n, g)| (g.1 - self.due(n)).0).collect()
    }

    /// How much later than due each was stamped, ns; none where they are not what was given one after the other.
    pub fn late(&self, arrived: &[&ImuSample]) -> Option<Vec<i64>> {
        let seen: Vec<Counts> = arrived.iter().map(|s| counts(s)).collect();
        let given: Vec<Counts> = self.given.lock().unwrap().iter().map(|g| g.0).collect();
        let at = given.windows(seen.len()).position(|w| w == seen)?;
        Some(arrived.iter().enumerate().map(|(i, s)| (s.t - self.due(at + i)).0).collect())
    }
}

/// A sample into the registers, and its edge.
fn give(registers: &File, ready: &File, c: Counts) {
    let [ax, ay, az, gx, gy, gz] = c;
    let bytes: Vec<u8> = [ax, ay, az, 0, gx, gy, gz].iter().flat_map(|v| v.to_be_bytes()).collect();
    registers.write_at(&bytes, 0x3B).unwrap();
    ready.write_at(b"pull-up", 0).unwrap();
    ready.write_at(b"pull-down", 0).unwrap();
}

impl Drop for Feed {
    fn drop(&mut self) {
        self.stop.store(true, Relaxed);
        self.thread.take().into_iter().for_each(|t| t.join().unwrap());
    }
}
