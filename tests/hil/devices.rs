//! Two UVC cameras and an MPU-6500 that play a recording, as the kernel's own drivers see them, and the board file of them.
#![allow(dead_code)] // each test needs its part

use super::plugged::Uvc;
use super::unit::{self, counts, Counts, Feed};
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use stipple_drivers::host::monotonic;
use stipple_drivers::record::{self, Format};
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::source::ImuReading;
use stipple_drivers::{Calibration, Colour, Frames, Nanos, Span};

pub const MS: i64 = 1_000_000;
/// From when the cameras stream until the recording starts: the program has its threads by then.
const BEFORE: Span = Span(200 * MS);
const PATIENCE: Duration = Duration::from_secs(60);

pub fn environment(name: &str) -> PathBuf {
    PathBuf::from(std::env::var_os(name).unwrap_or_else(|| panic!("{name} is set by tests/hil/run")))
}

/// The smallest map: the one processor is emulated.
pub const MAP: &str = "
    name = \"hil\"
    memory_max_mib = 640
    [budget]
    splats = 4000
    intersections = 200000
    keyframes = 40
    image_width_max = 376
    image_height_max = 240
    [map]
    scale = 4
    steps_per_keyframe_max = 2
    [gpu]
    device = \"llvmpipe\"
    submission_max_ms = 1000.0
";

/// Writes what the devices play: frames and samples as they come, as a recording and as the cameras' raw pictures, which are
/// in colour where the frames are.
pub fn write(to: &Path, calibration: &Calibration, frames: impl Iterator<Item = Frames>, imu: &[(Nanos, Counts)]) {
    let _ = fs::remove_dir_all(to);
    let mut sink = record::open(to, Format::Euroc, calibration).unwrap();
    let (mut raw, mut first, mut instants) = ([vec![], vec![]], None, String::new());
    let mut format = "";
    for frame in frames {
        format = if frame.colours.is_empty() { "grey" } else { "yuyv" };
        for (k, raw) in raw.iter_mut().enumerate() {
            raw.extend(frame.colours.get(k).map_or_else(|| frame.images[k].pixels.clone(), yuyv));
        }
        instants += &format!("{}\n", (frame.t - *first.get_or_insert(frame.t)).0);
        sink.frames(&frame).unwrap();
    }
    for (t, counts) in imu {
        sink.imu(&ImuReading { sample: unit::sample(*t, *counts), ..ImuReading::default() }).unwrap();
    }
    sink.finish().unwrap();
    fs::write(to.join("instants"), instants).unwrap();
    raw.iter().enumerate().for_each(|(k, raw)| fs::write(to.join(format!("cam{k}.{format}")), raw).unwrap());
}

/// BT.601 in the limited range, as the camera's descriptor says; two pixels have the mean of their chroma.
fn yuyv([red, green, blue]: &Colour) -> Vec<u8> {
    let ycbcr = |i: usize| {
        let [r, g, b] = [red, green, blue].map(|plane| f64::from(plane.pixels[i]) / 255.0);
        let y = 0.299 * r + 0.587 * g + 0.114 * b;
        [16.0 + 219.0 * y, 128.0 + 224.0 * (b - y) / 1.772, 128.0 + 224.0 * (r - y) / 1.402]
    };
    let pair = |i: usize| {
        let [a, b] = [ycbcr(i), ycbcr(i + 1)];
        [a[0], (a[1] + b[1]) / 2.0, b[0], (a[2] + b[2]) / 2.0].map(|v| v.round() as u8)
    };
    assert!(red.width % 2 == 0, "a pair is of one row");
    (0..red.pixels.len()).step_by(2).flat_map(pair).collect()
}

/// Both cameras and the unit.
pub struct Devices {
    pub flight: PathBuf,
    pub size: (usize, usize),
    /// From the recording's first sample to its first picture, and from there to each.
    lead: Span,
    pub stamps: Vec<Span>,
    pub fps: u32,
    pub cameras: [Uvc; 2],
    pub feed: Feed,
    /// Ports of the hub that were used.
    ports: u32,
    /// What the cameras were told.
    orders: String,
    /// When the first picture was exposed.
    pub start: Nanos,
}

pub const SERIALS: [&str; 2] = ["FLIGHT-L", "FLIGHT-R"];

fn camera(flight: &Path, k: usize, port: u32, size: (usize, usize), fps: u32) -> Uvc {
    let films = ["yuyv", "grey"].map(|format| flight.join(format!("cam{k}.{format}")));
    let film = films.iter().find(|film| film.exists()).expect("written by prepare");
    Uvc::playing(port, SERIALS[k], size, fps, [film, &flight.join("instants")])
}

impl Devices {
    pub fn plug() -> Devices {
        let flight = environment("HIL_FLIGHT");
        let recording = Recording::open(&flight, &OpenOptions::default()).unwrap();
        let c = recording.calibration.cameras[0].camera;
        let size = (c.width, c.height);
        let first = recording.frames[0].t;
        let lead = first - recording.imu[0].t;
        let stamps: Vec<Span> = recording.frames.iter().map(|f| f.t - first).collect();
        let fps = (1.0 / stamps[1].secs()).round() as u32;
        wait_for("the nodes of the test before to go", || !SERIALS.into_iter().any(is_found));
        let cameras = [camera(&flight, 0, 0, size, fps), camera(&flight, 1, 1, size, fps)];
        wait_for("both nodes", || SERIALS.into_iter().all(is_found));
        let feed = Feed::start(recording.imu.iter().map(counts).collect());
        Devices { flight, size, lead, stamps, fps, cameras, feed, ports: 2, orders: String::new(), start: Nanos(0) }
    }

    /// Plays the recording as soon as a program reads the cameras.
    pub fn play(&mut self) {
        wait_for("a program that reads the cameras", || self.cameras.iter().all(Uvc::is_streaming));
        self.start = self.feed.play_after(monotonic() + BEFORE) + self.lead;
        self.orders = format!("play {}", self.start.0);
        self.cameras.iter_mut().for_each(|c| c.order(&self.orders));
    }

    /// Plays the recording again and again from here on, whoever reads it: it ends as it begins.
    pub fn play_for_ever(&mut self) {
        self.start = self.feed.play_after(monotonic() + BEFORE) + self.lead;
        let orders = format!("repeat {}\nplay {}", self.feed.length().0, self.start.0);
        self.cameras.iter_mut().for_each(|c| c.order(&orders));
        self.orders = orders;
    }

    /// When picture `k` is exposed.
    pub fn exposed(&self, k: usize) -> Nanos {
        self.start + self.stamps[k]
    }

    pub fn end(&self) -> Nanos {
        self.exposed(self.stamps.len() - 1)
    }

    /// The picture of a stamp: the last one exposed.
    pub fn picture(&self, t: Nanos) -> usize {
        self.stamps.partition_point(|s| self.start + *s <= t).saturating_sub(1)
    }

    /// Pulls a camera's plug and puts it into another port.
    pub fn replug(&mut self, k: usize, away: Span) {
        self.cameras[k].order("unplug");
        wait_until(monotonic() + away);
        self.cameras[k] = camera(&self.flight, k, self.ports, self.size, self.fps);
        self.cameras[k].order(&self.orders);
        self.ports += 1;
    }
}

/// The sensors of a board file.
pub fn sensors_of_a_board(calibration: &str, fps: u32) -> String {
    let [left, right] = SERIALS;
    format!(
        "
        [rig]
        calibration = \"{calibration}\"
        [camera]
        devices = [\"serial:{left}\", \"serial:{right}\"]
        rate_hz = {fps}.0
        stamp = \"frame-start\"
        pair_tolerance_s = 0.02
        [imu]
        chip = \"mpu-6500\"
        device = \"hil-imu i2c\"
        rate_hz = {}.0
        [gpio]
        data_ready = \"hil-gpio:imu-ready\"
        ",
        unit::RATE_HZ,
    )
}

pub fn wait_for(what: &str, there: impl Fn() -> bool) {
    let begun = Instant::now();
    while !there() {
        assert!(begun.elapsed() < PATIENCE, "waited for {what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// The kernel has made its node.
pub fn is_found(serial: &str) -> bool {
    let nodes = fs::read_dir("/sys/class/video4linux").into_iter().flatten().flatten();
    nodes.filter_map(|n| fs::read_to_string(n.path().join("name")).ok()).any(|name| name.contains(serial))
}

pub fn wait_until(t: Nanos) {
    std::thread::sleep(Duration::from_nanos((t - monotonic()).0.max(0) as u64));
}
