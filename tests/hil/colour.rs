//! Colour from live cameras to the map: a simulated flight is played in YUYV through two UVC cameras, beside an MPU-6500 on
//! I2C, and `stipple run` maps it with `map.colour`. For the virtual machine: `make hil TESTS=colour`.
//!
//! The map's colours are those that were simulated. The pictures before they became YUYV are the truth: each Gaussian is
//! looked up in them where the run's own poses put it, without the program's renderer.
#![allow(clippy::unwrap_used)]

mod devices;
mod flown;
mod plugged;
#[path = "../program/start.rs"]
#[allow(dead_code)] // its recording is grey
mod start;
mod unit;

use devices::{environment, sensors_of_a_board, Devices, MAP, MS};
use flown::{count, counted, fly, report};
use glam::DVec3;
use serde_json::Value;
use std::collections::HashMap;
use std::fs;
use std::path::Path;
use stipple_drivers::replay::{read_trajectory, OpenOptions, Recording};
use stipple_drivers::sim::{Scenario, Sim};
use stipple_drivers::{Frames, Nanos, Span, TimedPose};
use unit::counts;

/// Of the pictures: the one processor is emulated.
const RATE_HZ: f64 = 10.0;
const SECONDS: f64 = 6.0;
/// Inertial samples on either side of the pictures.
const AROUND: Span = Span(100 * MS);
/// Pictures that the machine may lose of the 61: colours are judged by a third of a flight as well, and losses by flight.rs.
const LOST_MAX: usize = 40;
/// The nearest Gaussian of a square of so many pixels is what is seen there.
const SQUARE: f64 = 8.0;

/// What the devices play: a simulated flight in colour. Not in the machine.
#[test]
#[ignore = "make hil"]
fn prepare() {
    let mut scenario = Scenario::named("demo").unwrap();
    (scenario.rate_hz, scenario.duration) = (RATE_HZ, Span::from_secs(SECONDS));
    let mut sim = Sim::new(&scenario).unwrap();
    let (first, last) = (sim.stamp(0), sim.stamp(sim.frame_count() - 1));
    let during = |t: Nanos| (first - AROUND..=last + AROUND).contains(&t);
    let imu: Vec<_> = sim.imu().iter().filter(|s| during(s.t)).map(|s| (s.t, counts(s))).collect();
    let calibration = sim.calibration().clone();
    let mut whole = Frames::in_colour(&calibration, 2);
    let frames = (0..sim.frame_count()).map(|i| {
        sim.render(i, &mut whole);
        whole.clone()
    });
    devices::write(&environment("HIL_FLIGHT"), &calibration, frames, &imu);
}

/// A Gaussian of `map.ply`.
struct Splat {
    at: DVec3,
    rgb: [f64; 3],
}

/// Those that hide what is behind them.
fn opaque(ply: &Path) -> Vec<Splat> {
    const END: &[u8] = b"end_header\n";
    let bytes = fs::read(ply).unwrap();
    let begin = bytes.windows(END.len()).position(|w| w == END).unwrap() + END.len();
    let header = std::str::from_utf8(&bytes[..begin]).unwrap();
    let names: Vec<&str> = header.lines().filter_map(|l| l.strip_prefix("property float ")).collect();
    let column = |name: &str| names.iter().position(|n| *n == name).unwrap();
    let (x, red, opacity) = (column("x"), column("f_dc_0"), column("opacity"));
    let rows = bytes[begin..].chunks_exact(4 * names.len()).map(|row| {
        row.chunks_exact(4).map(|b| f64::from(f32::from_le_bytes(b.try_into().unwrap()))).collect::<Vec<f64>>()
    });
    // The opacity is a logit, the colour the constant spherical harmonic.
    let splat = |v: Vec<f64>| Splat {
        at: DVec3::from_slice(&v[x..x + 3]),
        rgb: [0, 1, 2].map(|c| 0.5 + 0.282_094_791_773_878_14 * v[red + c]),
    };
    rows.filter(|v| v[opacity] > 0.0).map(splat).collect()
}

/// What a colour is beyond its grey.
fn chroma(rgb: [f64; 3]) -> [f64; 3] {
    let mean = rgb.iter().sum::<f64>() / 3.0;
    rgb.map(|v| v - mean)
}

/// Chroma of Gaussians and of the simulated scene where they are seen.
struct Met {
    pairs: Vec<([f64; 3], [f64; 3])>,
}

impl Met {
    /// In every fifth picture of the left camera that has a pose.
    fn of(splats: &[Splat], poses: &[TimedPose], picture: impl Fn(Nanos) -> usize, flight: &Path) -> Met {
        let recording = Recording::open(flight, &OpenOptions::default()).unwrap();
        let (mut reader, left) = (recording.reader(), &recording.calibration.cameras[0]);
        let (mut frames, mut pairs) = (Frames::in_colour(&recording.calibration, 1), vec![]);
        for TimedPose { t, pose } in poses.iter().step_by(5) {
            reader.read(picture(*t), &mut frames).unwrap();
            let cam_from_world = (*pose * left.body_from_cam).inverse();
            let mut nearest: HashMap<(i64, i64), (f64, [usize; 2], &Splat)> = HashMap::new();
            for splat in splats {
                let p = cam_from_world.transform(splat.at);
                let px = left.camera.project(p).filter(|px| p.z > 0.1 && left.camera.contains(*px, 1.0));
                let Some(px) = px else { continue };
                let at = [px.x.round() as usize, px.y.round() as usize];
                let seen = nearest.entry(((px.x / SQUARE) as i64, (px.y / SQUARE) as i64)).or_insert((p.z, at, splat));
                if p.z < seen.0 {
                    *seen = (p.z, at, splat);
                }
            }
            let truth = |[x, y]: [usize; 2]| [0, 1, 2].map(|c| f64::from(frames.colours[0][c].at(x, y)) / 255.0);
            pairs.extend(nearest.values().map(|(_, at, splat)| (chroma(splat.rgb), chroma(truth(*at)))));
        }
        Met { pairs }
    }

    fn mean(&self, of: impl Fn(&[f64; 3], &[f64; 3]) -> f64) -> f64 {
        self.pairs.iter().map(|(splat, truth)| of(splat, truth)).sum::<f64>() / self.pairs.len() as f64
    }

    /// The map has the scene's colours: as strong, the same, and no other.
    fn judge(&self) {
        let dot = |a: &[f64; 3], b: &[f64; 3]| (0..3).map(|c| a[c] * b[c]).sum::<f64>();
        let strength = |v: &[f64; 3]| dot(v, v).sqrt();
        let off = |a: &[f64; 3], b: &[f64; 3]| (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>();
        let [map, scene] = [self.mean(|a, _| strength(a)), self.mean(|_, b| strength(b))];
        let correlation = self.mean(dot) / (self.mean(|a, _| dot(a, a)) * self.mean(|_, b| dot(b, b))).sqrt();
        let [own, grey] = [self.mean(off), self.mean(|_, b| off(&[0.0; 3], b))].map(f64::sqrt);
        let turned = |by: usize| self.mean(|a, b| off(&[0, 1, 2].map(|c| a[(c + by) % 3]), b)).sqrt();
        println!(
            "{} Gaussians met in pictures: chroma {map:.3} in the map, {scene:.3} in the scene, correlation {correlation:.3}; \
             off by {own:.3}, were they grey by {grey:.3}, with channels exchanged by {:.3} and {:.3}",
            self.pairs.len(),
            turned(1),
            turned(2),
        );
        assert!(self.pairs.len() > 500, "{}", self.pairs.len());
        assert!((scene / 2.0..scene * 1.5).contains(&map), "{map} {scene}");
        assert!(correlation > 0.7, "{correlation}");
        assert!(own < 0.8 * grey && own < turned(1).min(turned(2)) / 1.5);
    }
}

/// PSNR of pictures without any detail, each of its own mean colour, against those of the left camera, dB.
fn plain_db(flight: &Path) -> f64 {
    let recording = Recording::open(flight, &OpenOptions::default()).unwrap();
    let (mut reader, mut frames) = (recording.reader(), Frames::in_colour(&recording.calibration, 1));
    let variance = |pixels: &[u8]| {
        let n = pixels.len() as f64;
        let mean = pixels.iter().map(|p| f64::from(*p)).sum::<f64>() / n;
        pixels.iter().map(|p| (f64::from(*p) - mean).powi(2)).sum::<f64>() / n
    };
    let mut of_all = vec![];
    for i in (0..recording.frames.len()).step_by(10) {
        reader.read(i, &mut frames).unwrap();
        of_all.extend(frames.colours[0].iter().map(|plane| variance(&plane.pixels)));
    }
    10.0 * (255.0f64.powi(2) * of_all.len() as f64 / of_all.iter().sum::<f64>()).log10()
}

/// Counters of the sensors that are not zero, but for those that a flight has where nothing fails and the machine is slow.
fn unexpected(report: &Value) -> Vec<String> {
    let usual = [
        "camera_bytes_copied",
        "camera_frames",
        "camera_images_unpaired",
        "camera_missed_by_sequence",
        "camera_timeouts",
        "imu_rate_millihertz",
    ];
    let of_sensors = |name: &&str| ["camera_", "one_camera_", "imu_"].iter().any(|kind| name.starts_with(kind));
    let names = report.as_object().unwrap().keys().filter_map(|key| key.strip_prefix("count_")).filter(of_sensors);
    names.filter(|name| count(report, name) > 0 && !usual.contains(name)).map(String::from).collect()
}

#[test]
#[ignore = "needs the machine of tests/hil/colour.sh"]
fn map_has_the_colours_that_live_cameras_see() {
    let dir = tempfile::tempdir().unwrap();
    let (mut devices, dir) = (Devices::plug(), dir.path());
    let board = dir.join("board.toml");
    let sensors = sensors_of_a_board(&format!("{}/mav0", devices.flight.display()), devices.fps);
    fs::write(&board, format!("{MAP}{sensors}")).unwrap();
    fly(&mut devices, &board, dir, &["--set", "map.colour=true"], |_| {});
    let r = report(&dir.join("out"));
    println!("{}", counted(&r));
    let trained = ["anchors", "splats", "iterations", "psnr_db"].map(|name| r[name].as_f64().unwrap());
    let plain = plain_db(&devices.flight);
    println!("anchors, Gaussians, steps, dB: {trained:?}; {plain:.1} dB without detail");

    let [pairs, frames, lost] = devices.pairs_are_tracked(&r, LOST_MAX);
    assert!(frames + lost + count(&r, "camera_missed_by_sequence") >= pairs);
    assert_eq!((&r["heap_after_seal"], &r["pace"]), (&0.into(), &"live".into()));
    assert_eq!(unexpected(&r), Vec::<String>::new());

    let poses = read_trajectory(&dir.join("out/trajectory.tum")).unwrap();
    let splats = opaque(&dir.join("out/map.ply"));
    Met::of(&splats, &poses, |t| devices.picture(t), &devices.flight).judge();
    assert!(trained.iter().all(|n| *n > 0.0) && trained[3] > plain + 3.0, "{plain} dB without detail");
}
