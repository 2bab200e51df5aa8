//! The whole program on the kernel's own subsystems: a recording is played through two UVC cameras and through an MPU-6500
//! on I2C with a data-ready line, and `stipple run` flies it. For the virtual machine: `make hil TESTS=flight`.
//!
//! Physics cannot be slowed down for a slow machine, so the machine's time is: its clock counts the instructions that it
//! executes, eight a nanosecond, and stands still while the host is busy with something else (`run-vm.sh -i -w 8`). To what
//! runs there the recording plays at its own pace.
//!
//! The trajectory must be that of a replay from a folder: to a millimetre of what the run recorded itself, and within a
//! centimetre of the same pictures and samples with the instants at which they were due, where what the run saw bears
//! those that the kernel stamped. No alignment: a pose is compared with the pose of the same picture.
#![allow(clippy::unwrap_used)]

mod devices;
mod flown;
#[path = "../program/panics.rs"]
mod panics;
mod plugged;
#[path = "../program/start.rs"]
#[allow(dead_code)] // its recording is of the simulator
mod start;
mod unit;

use devices::{environment, sensors_of_a_board, wait_until, Devices, MS};
use flown::{count, counted, report, stipple};
use panics::{panic_after, Panicked};
use start::text;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::{Frames, Image, ImuSample, Nanos, Span};
use unit::counts;

/// One picture in so many may be lost to a machine that is slow: two in a row, after which the tracker may not find its
/// points again, then come less than once a flight.
const LOST_OF: usize = 30;
/// Inertial samples of the recording on either side of its pictures.
const AROUND: Span = Span(100 * MS);
/// Largest distances from a replay of what was given, m. What differs is stamps, and what they decide: with two dozen
/// landmarks in view at this size, a track more or less through the innovation gate moves a pose by its stated deviation,
/// 4 mm. Of replays whose pictures bear stamps 0.1 us (deviation) off the median is 5.3 mm at most and the worst of 25 is
/// 7.2 mm; 165 us off all of them, 5.4 and 7.4 mm; 7 us off the inertial ones 2 mm. At twice the width and height they are
/// 2.1 and 6.1 mm.
const RMS_MAX: f64 = 0.005;
const WORST_MAX: f64 = 0.01;
/// Deviation of a pose, as odometry states it with two dozen landmarks in view, m.
const STATED_DEVIATION: f64 = 0.004;

/// What the devices can give of a recording: samples in steps of the unit, and pictures, of a quarter of the pixels unless
/// HIL_FLIGHT ends in -full. Not in the machine, where decoding it takes minutes.
#[test]
#[ignore = "make hil"]
fn prepare() {
    let (from, to) = (environment("HIL_RECORDING"), environment("HIL_FLIGHT"));
    let recording = Recording::open(&from, &OpenOptions::default()).unwrap();
    let (mut reader, mut calibration) = (recording.reader(), recording.calibration.clone());
    let halved = calibration.cameras[0].camera.width > 400 && !to.to_string_lossy().ends_with("-full");
    for c in calibration.cameras.iter_mut().map(|c| &mut c.camera).filter(|_| halved) {
        // Pixel centres are integers.
        (c.width, c.height, c.fx, c.fy) = (c.width / 2, c.height / 2, c.fx / 2.0, c.fy / 2.0);
        (c.cx, c.cy) = ((c.cx + 0.5) / 2.0 - 0.5, (c.cy + 0.5) / 2.0 - 0.5);
    }
    let (first, last) = (recording.frames[0].t, recording.frames.last().unwrap().t);
    let during = |s: &&ImuSample| (first - AROUND..=last + AROUND).contains(&s.t);
    let imu: Vec<_> = recording.imu.iter().filter(during).map(|s| (s.t, counts(s))).collect();
    let mut whole = Frames::for_rig(&recording.calibration);
    let frames = (0..recording.frames.len()).map(|i| {
        reader.read(i, &mut whole).unwrap();
        let images = whole.images.iter().map(|i| if halved { half(i) } else { i.clone() }).collect();
        Frames { t: whole.t, images, colours: vec![] }
    });
    devices::write(&to, &calibration, frames, &imu);
}

fn half(image: &Image) -> Image {
    let mut out = Image::new(image.width / 2, image.height / 2);
    for y in 0..out.height {
        for x in 0..out.width {
            let four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(i, j)| u32::from(image.at(2 * x + i, 2 * y + j)));
            out.pixels[y * out.width + x] = ((four.iter().sum::<u32>() + 2) / 4) as u8;
        }
    }
    out
}

impl Devices {
    /// Every sample that was given while the recording played arrived, once, in order; answers what was recorded.
    fn samples_are_whole(&self, dir: &Path) -> Recording {
        let kept = Recording::open(&dir.join("kept"), &OpenOptions::default()).unwrap();
        let during = |t: Nanos| (self.start..self.end()).contains(&t);
        let arrived: Vec<_> = kept.imu.iter().filter(|s| during(s.t)).collect();
        println!("samples given after they were due by {}", median_and_worst(self.feed.slow(self.start)));
        let late = self.feed.late(&arrived).expect("what arrived is what was given, without a gap");
        println!("{} samples arrived, stamp less due: {}", late.len(), median_and_worst(late));
        kept
    }

    /// PSNR of pictures without any detail, each of its own mean grey, against those of the left camera, dB.
    fn plain_grey_db(&self) -> f64 {
        let film = fs::read(self.flight.join("cam0.grey")).unwrap();
        let variance = |picture: &[u8]| {
            let n = picture.len() as f64;
            let mean = picture.iter().map(|p| f64::from(*p)).sum::<f64>() / n;
            picture.iter().map(|p| (f64::from(*p) - mean).powi(2)).sum::<f64>() / n
        };
        let of_all: Vec<f64> = film.chunks_exact(self.size.0 * self.size.1).step_by(20).map(variance).collect();
        10.0 * (255.0f64.powi(2) * of_all.len() as f64 / of_all.iter().sum::<f64>()).log10()
    }

    /// A board file of them.
    fn board(&self, dir: &Path) -> PathBuf {
        let plain = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(start::BOARD)).unwrap();
        let path = dir.join("board.toml");
        let sensors = sensors_of_a_board(&format!("{}/mav0", self.flight.display()), self.fps);
        // All frames are recorded: PNG is slow here, and written when there is time.
        fs::write(&path, format!("{plain}{sensors}[record]\nring_frames = 250\n")).unwrap();
        path
    }

    /// What was given, as a recording that bears the instants at which it was due.
    fn given(&self, dir: &Path) -> PathBuf {
        let given = dir.join("given");
        for k in 0..2 {
            let (from, to) = (self.flight.join(format!("mav0/cam{k}")), given.join(format!("mav0/cam{k}")));
            fs::create_dir_all(to.join("data")).unwrap();
            fs::copy(from.join("sensor.yaml"), to.join("sensor.yaml")).unwrap();
            for image in fs::read_dir(from.join("data")).unwrap() {
                // A recording is read from its own folder: no link leads out of it.
                let image = image.unwrap();
                let name = to.join("data").join(image.file_name());
                fs::hard_link(image.path(), &name).or_else(|_| fs::copy(image.path(), &name).map(drop)).unwrap();
            }
            let list = fs::read_to_string(from.join("data.csv")).unwrap();
            let rows = list.lines().skip(1).map(|l| l.split_once(',').unwrap().1).zip(&self.stamps);
            let rows: String = rows.map(|(name, t)| format!("{},{name}\n", (self.start + *t).0)).collect();
            fs::write(to.join("data.csv"), format!("#t,name\n{rows}")).unwrap();
        }
        let (from, to) = (self.flight.join("mav0/imu0"), given.join("mav0/imu0"));
        fs::create_dir_all(&to).unwrap();
        fs::copy(from.join("sensor.yaml"), to.join("sensor.yaml")).unwrap();
        fs::write(to.join("data.csv"), self.feed.csv()).unwrap();
        given
    }
}

/// Stamps and positions of a trajectory.
fn trajectory(out: &Path) -> Vec<(Nanos, [f64; 3])> {
    let text = fs::read_to_string(out.join("trajectory.tum")).unwrap();
    let row = |line: &str| {
        let v: Vec<&str> = line.split_whitespace().collect();
        let (s, ns) = v[0].split_once('.').unwrap();
        let t = s.parse::<i64>().unwrap() * 1000 * MS + format!("{ns:0<9}")[..9].parse::<i64>().unwrap();
        (Nanos(t), [1, 2, 3].map(|i| v[i].parse().unwrap()))
    };
    text.lines().filter(|l| !l.starts_with('#')).map(row).collect()
}

/// How far apart the poses of the same pictures are, m: how many there are, root mean square, largest.
fn apart(devices: &Devices, one: &Path, other: &Path) -> (usize, f64, f64) {
    let [one, other] = [one, other].map(trajectory);
    let (mut n, mut sum, mut worst) = (0, 0.0, 0f64);
    for (t, p) in &one {
        let Some((_, q)) = other.iter().find(|(u, _)| devices.picture(*u) == devices.picture(*t)) else { continue };
        let d2: f64 = (0..3).map(|i| (p[i] - q[i]).powi(2)).sum();
        (n, sum, worst) = (n + 1, sum + d2, worst.max(d2.sqrt()));
    }
    (n, (sum / n.max(1) as f64).sqrt(), worst)
}

fn median_and_worst(mut late: Vec<i64>) -> String {
    late.sort_unstable();
    let us = |i: usize| late[i] / 1000;
    format!("median {} us, {} to {} us", us(late.len() / 2), us(0), us(late.len() - 1))
}

/// The whole recording, which the run records itself.
fn fly(devices: &mut Devices, dir: &Path, more: &[&str], during: impl FnOnce(&mut Devices)) {
    let (board, kept) = (devices.board(dir), dir.join("kept").display().to_string());
    flown::fly(devices, &board, dir, &[&["--record", &kept], more].concat(), during);
}

/// From a folder, as given and as seen.
fn replayed(dir: &Path, board: &Path, name: &str) -> PathBuf {
    let (from, out) = (dir.join(name), dir.join(format!("{name}-out")));
    let [from, board, to] = [&from, board, &out].map(|p| p.to_str().unwrap());
    let more = ["--pace", "lockstep", "--set", "map.enabled=false"];
    let o = stipple(&[&["replay", from, "--board", board, "--out", to], &more[..]].concat()).output().unwrap();
    assert!(o.status.success(), "{}", text(&o));
    out
}

#[test]
#[ignore = "needs the machine of tests/hil/flight.sh"]
fn flight_through_the_kernel_is_the_flight_from_a_folder() {
    let dir = tempfile::tempdir().unwrap();
    let (mut devices, dir) = (Devices::plug(), dir.path());
    fly(&mut devices, dir, &["--set", "map.enabled=false"], |_| {});
    let out = dir.join("out");
    let r = report(&out);
    println!("{}", counted(&r));

    let [pairs, frames, lost] = devices.pairs_are_tracked(&r, devices.stamps.len() / LOST_OF);
    assert_eq!((frames + lost, count(&r, "camera_frames")), (pairs, pairs));
    let kept = devices.samples_are_whole(dir);
    let late = kept.frames.iter().map(|f| (f.t - devices.exposed(devices.picture(f.t))).0).collect();
    println!("{} frames were kept, stamp less exposure: {}", kept.frames.len(), median_and_worst(late));

    let board = dir.join("board.toml");
    devices.given(dir);
    let [given, seen] = ["given", "kept"].map(|name| replayed(dir, &board, name));
    let (n, rms, worst) = apart(&devices, &out, &given);
    println!("{n} poses against the replay of what was given: {:.2} mm rms, {:.2} mm at most", rms * 1e3, worst * 1e3);
    let (_, rms_seen, worst_seen) = apart(&devices, &out, &seen);
    println!(
        "against the replay of what it recorded: {:.4} mm rms, {:.4} mm at most",
        rms_seen * 1e3,
        worst_seen * 1e3
    );
    // A drone waits for its pose before it takes off: a second is enough for that.
    let without = count(&r, "frames_without_odometry");
    assert!(n as u64 + without == frames && without <= u64::from(devices.fps), "{n} of {frames}");
    assert!(rms < RMS_MAX && worst < WORST_MAX && worst_seen < 0.001);
    assert_eq!((&r["heap_after_seal"], &r["pace"]), (&0.into(), &"live".into()));
    let quiet = ["camera_lost", "camera_silent", "imu_lost", "imu_silent", "imu_missing", "imu_frozen", "imu_overflow"];
    quiet.iter().for_each(|name| assert_eq!(count(&r, name), 0, "{name}"));
}

#[test]
#[ignore = "needs the machine of tests/hil/flight.sh"]
fn map_is_trained_on_what_the_cameras_see() {
    let dir = tempfile::tempdir().unwrap();
    let (mut devices, dir) = (Devices::plug(), dir.path());
    fly(&mut devices, dir, &["--set", "budget.splats=4000", "--set", "budget.keyframes=40"], |_| {});
    let r = report(&dir.join("out"));
    println!("{}", counted(&r));
    let trained = ["anchors", "splats", "iterations", "psnr_db"].map(|name| r[name].as_f64().unwrap());
    println!("anchors, Gaussians, steps, dB: {trained:?}");
    // A map that shows the scene: its error is at most half of that of pictures without any detail.
    let plain = devices.plain_grey_db();
    assert!(trained.iter().all(|n| *n > 0.0) && trained[3] > plain + 3.0, "{plain} dB without detail");
    assert_eq!(r["heap_after_seal"], 0);

    // What comes while the mapper has the one processor may meet no free buffer; the kernel's numbers say so.
    let [pairs, frames, lost] = devices.pairs_are_tracked(&r, devices.stamps.len() / LOST_OF);
    assert!(frames + lost + count(&r, "camera_missed_by_sequence") >= pairs);
    devices.samples_are_whole(dir);
    // Where the run began and which pictures it dropped are its own; its poses are not those of a replay.
    let poses = trajectory(&dir.join("out")).len() as u64;
    assert_eq!(poses + count(&r, "frames_without_odometry"), frames);
}

#[test]
#[ignore = "needs the machine of tests/hil/flight.sh"]
fn flight_goes_on_after_a_plug_was_pulled() {
    let dir = tempfile::tempdir().unwrap();
    let (mut devices, dir) = (Devices::plug(), dir.path());
    let pulled = devices.stamps.len() / 2;
    fly(&mut devices, dir, &["--set", "map.enabled=false"], |devices| {
        wait_until(devices.exposed(pulled));
        devices.replug(1, Span(1000 * MS));
    });
    let r = report(&dir.join("out"));
    println!("{}", counted(&r));
    // The other camera flies on meanwhile.
    for (name, n) in [("one_camera_lost", 1), ("camera_losses", 1), ("camera_returns", 1), ("camera_lost", 0)] {
        assert_eq!(count(&r, name), n, "{name}");
    }
    assert!((1000..4000).contains(&count(&r, "one_camera_away_ms")));
    assert_eq!(r["heap_after_seal"], 0);
    devices.samples_are_whole(dir);
    let lost = ["imu_missing", "imu_samples_missing", "imu_edges_unmatched", "imu_edges_refused", "imu_clock_slips"];
    lost.iter().for_each(|name| assert_eq!(count(&r, name), 0, "{name}"));
    devices.given(dir);
    let given = replayed(dir, &dir.join("board.toml"), "given");
    let (n, rms, worst) = apart(&devices, &dir.join("out"), &given);
    println!("{n} poses against the replay of what was given: {:.2} mm rms, {:.2} mm at most", rms * 1e3, worst * 1e3);
    // Three times the deviation that odometry states for a pose of this flight: beyond it the poses would contradict that.
    assert!(worst < 3.0 * STATED_DEVIATION, "{:.2} mm", worst * 1e3);
    let last = devices.picture(trajectory(&dir.join("out")).last().unwrap().0);
    assert_eq!(last + 1, devices.stamps.len(), "the last picture has a pose");
}

/// The thread that no recording has (tests/program/mission.rs has the others): ten panics at moments of their own.
#[test]
#[ignore = "needs the machine of tests/hil/flight.sh"]
fn flight_ends_at_once_when_the_trigger_panics() {
    for pass in 0..10 {
        let dir = tempfile::tempdir().unwrap();
        let (mut devices, dir) = (Devices::plug(), dir.path());
        let [board, out] = [devices.board(dir), dir.join("out")].map(|p| p.display().to_string());
        let mut run = stipple(&["run", "--board", &board, "--out", &out, "--allow-injection"]);
        run.args(["--set", "map.enabled=false", "--set", "gpio.trigger=hil-gpio:camera-trigger"]);
        run.args(panic_after("trigger", 2.0 + 0.171 * f64::from(pass), &dir.join("rules.toml")));
        let run = run.stderr(Stdio::piped()).spawn().unwrap();
        devices.play();
        let Panicked { end_s, lost_s } = Panicked::judge(run, "trigger", false, Path::new(&out));
        println!("ended {end_s:.3} s after the panic, last frame of the log {lost_s:.3} s before it");
        assert!(end_s < 1.0 && lost_s < 1.0);
    }
}

#[test]
#[ignore = "needs the machine of tests/hil/flight.sh"]
fn flight_is_found_healthy_and_recorded_as_it_was_given() {
    let dir = tempfile::tempdir().unwrap();
    let (mut devices, dir) = (Devices::plug(), dir.path());
    let [board, out, kept] = [devices.board(dir), dir.join("out"), dir.join("kept")].map(|p| p.display().to_string());
    let mut doctor = stipple(&["doctor", "--board", &board, "--duration", "5", "--out", &out]);
    let doctor = doctor.stdout(Stdio::piped()).spawn().unwrap();
    devices.play();
    let output = doctor.wait_with_output().unwrap();
    let said = text(&output);
    println!("{said}");
    assert!(output.status.success() && !said.lines().any(|l| l.starts_with("fail")));
    for line in ["camera rate: 20.0 Hz", "inertial rate: 200.0 Hz", "left and right: 0 images without a partner"] {
        assert!(said.lines().any(|l| l.starts_with("ok") && l.contains(line)), "{line}");
    }
    // The recording plays on.
    assert!(stipple(&["record", "--board", &board, "--out", &kept, "--duration", "3"]).status().unwrap().success());
    let kept = Recording::open(Path::new(&kept), &OpenOptions::default()).unwrap();
    let film = [0, 1].map(|k| fs::read(devices.flight.join(format!("cam{k}.grey"))).unwrap());
    let (mut reader, mut frames) = (kept.reader(), Frames::for_rig(&kept.calibration));
    for i in 0..kept.frames.len() {
        reader.read(i, &mut frames).unwrap();
        let at = devices.picture(frames.t) * devices.size.0 * devices.size.1;
        let same = |(image, film): (&Image, &Vec<u8>)| film[at..].starts_with(&image.pixels);
        assert!(frames.images.iter().zip(&film).all(same), "frame {i}");
    }
    let late = devices.feed.late(&Vec::from_iter(&kept.imu)).expect("what was recorded is what was given");
    println!("{} frames and {} samples recorded, each as it was given", kept.frames.len(), late.len());
    assert!(kept.frames.len() >= 40 && late.len() >= 400);
}
