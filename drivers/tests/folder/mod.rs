//! Datasets for the tests of the reader: the recordings where they are installed, and a small
//! generated folder to spoil.
#![allow(clippy::unwrap_used, dead_code)] // each test binary uses its part

use std::fs;
use std::path::{Path, PathBuf};
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::{Fault, FaultKind};
use tempfile::TempDir;

/// A file or folder of the recordings, or `None` (said aloud) where they are not installed.
pub fn recorded(test: &str, name: &str) -> Option<PathBuf> {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    let path = std::env::var_os("STIPPLE_RECORDINGS").map_or_else(beside, PathBuf::from).join(name);
    if !path.exists() {
        println!("ignored: {test}: no recordings");
        return None;
    }
    Some(path)
}

pub const W: usize = 32;
pub const H: usize = 24;
pub const PAIRS: usize = 6;
pub const T0: i64 = 1_000_000_000;
pub const FRAME: i64 = 50_000_000;

pub const CAMERA: &str = "%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, BASELINE,
         0.0, 1.0, 0.0, 0.0,
         0.0, 0.0, 1.0, 0.0,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [32, 24]
camera_model: pinhole
intrinsics: [20.0, 20.0, 15.5, 11.5] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.1, 0.01, 0.0, 0.0]
";
pub const IMU: &str = "rate_hz: 200
gyroscope_noise_density: 1.6968e-04     # [ rad / s / sqrt(Hz) ]
gyroscope_random_walk: 1.9393e-05
accelerometer_noise_density: 2.0000e-3
accelerometer_random_walk: 3.0000e-3
";

pub fn grey() -> Vec<u8> {
    (0..W * H).map(|i| (i * 7 % 251) as u8).collect()
}

pub fn png(colour: png::ColorType, depth: png::BitDepth, w: usize, h: usize, bytes: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut e = png::Encoder::new(&mut out, w as u32, h as u32);
    e.set_color(colour);
    e.set_depth(depth);
    e.write_header().unwrap().write_image_data(bytes).unwrap();
    out
}

/// A dataset of six pairs at 20 Hz with 200 Hz inertial samples around them and two true poses.
pub struct Folder(pub TempDir);

impl Folder {
    pub fn new() -> Folder {
        let f = Folder(tempfile::tempdir().unwrap());
        let image = png(png::ColorType::Grayscale, png::BitDepth::Eight, W, H, &grey());
        for k in 0..2 {
            f.write(&format!("cam{k}/sensor.yaml"), CAMERA.replace("BASELINE", &format!("{}", 0.1 * f64::from(k))));
            let rows: Vec<String> = (0..PAIRS as i64).map(|i| format!("{0},{0}.png", T0 + i * FRAME)).collect();
            f.write(&format!("cam{k}/data.csv"), format!("#timestamp [ns],filename\n{}\n", rows.join("\n")));
            for i in 0..PAIRS as i64 {
                f.write(&format!("cam{k}/data/{}.png", T0 + i * FRAME), &image);
            }
        }
        f.write("imu0/sensor.yaml", IMU);
        let row = |i: i64| format!("{},0.0,0.1,0.2,0.0,0.0,9.81", T0 - FRAME + i * 5_000_000);
        let rows: Vec<String> = (0..80).map(row).collect();
        f.write("imu0/data.csv", format!("#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z\n{}\n", rows.join("\n")));
        let truth = format!("#timestamp,p,p,p,q,q,q,q,v\n{},1,2,3,1,0,0,0,9\n{},2,2,3,0,1,0,0,9\n", T0, T0 + FRAME);
        f.write("state_groundtruth_estimate0/data.csv", truth);
        f
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join("mav0").join(name)
    }

    pub fn write(&self, name: &str, content: impl AsRef<[u8]>) {
        fs::create_dir_all(self.path(name).parent().unwrap()).unwrap();
        fs::write(self.path(name), content).unwrap();
    }

    /// One more camera, which sees what camera 0 does.
    pub fn add_camera(&self, k: usize, baseline: f64) {
        let copy =
            |name: &str| self.write(&format!("cam{k}/{name}"), fs::read(self.path(&format!("cam0/{name}"))).unwrap());
        self.write(&format!("cam{k}/sensor.yaml"), CAMERA.replace("BASELINE", &format!("{baseline}")));
        copy("data.csv");
        (0..PAIRS as i64).for_each(|i| copy(&format!("data/{}.png", T0 + i * FRAME)));
    }

    pub fn remove_camera(&self, k: usize) {
        fs::remove_dir_all(self.path(&format!("cam{k}"))).unwrap();
    }

    /// Replaces the text of line `line` (1 is the first).
    pub fn edit(&self, name: &str, line: usize, f: impl Fn(&str) -> String) {
        let text = fs::read_to_string(self.path(name)).unwrap();
        let lines = text.lines().enumerate().map(|(i, l)| if i + 1 == line { f(l) } else { l.to_string() });
        self.write(name, lines.collect::<Vec<_>>().join("\n") + "\n");
    }

    pub fn replace(&self, name: &str, from: &str, to: &str) {
        let text = fs::read_to_string(self.path(name)).unwrap();
        assert!(text.contains(from));
        self.write(name, text.replace(from, to));
    }

    pub fn open(&self) -> Result<Recording, Fault> {
        Recording::open(self.0.path(), &OpenOptions::default())
    }

    /// The one counter that is not zero, as (name, count), and the warnings.
    pub fn one_fault(&self) -> (Recording, (&'static str, u64)) {
        let r = self.open().unwrap();
        let counted: Vec<_> = r.counters.list().into_iter().filter(|(_, n)| *n > 0).collect();
        assert_eq!(counted.len(), 1, "{counted:?} {:?}", r.warnings);
        (r, counted[0])
    }

    /// Opening fails with this code, naming this place (a file, or file:line) and this word.
    pub fn refused(&self, kind: FaultKind, place: &str, word: &str) -> Fault {
        let fault = self.open().unwrap_err();
        assert_eq!(fault.kind, kind, "{fault}");
        assert!(fault.place.contains(place), "{fault}");
        assert!(fault.what.contains(word), "{fault}");
        assert!(!fault.fix.is_empty() && !fault.to_string().contains('\n'), "{fault}");
        fault
    }
}
