//! Board files: strict TOML (unknown keys are refused), units in every name, one `validate`.
//!
//! A board file states what the board is (`name`, `memory_max_mib`), its `[budget]`, and where it
//! departs from the defaults of the method (`[frontend]`, `[vio]`, `[stereo]`, `[map]`, `[gpu]`).
//! `--set section.key=value` edits the parsed table before it is checked, so an override obeys
//! the same rules as the file.

mod bounds;
mod camera;
mod imu;
mod inject;
mod map;
mod network;
mod record;

use bounds::BOUNDS;
pub use camera::CameraConfig;
pub use imu::{GpioConfig, ImuConfig};
pub use inject::InjectConfig;
pub use map::{MapConfig, Projection};
pub use network::{Fit, NetworkConfig};
pub use record::RecordConfig;
use serde::{Deserialize, Serialize};
use std::path::Path;
use stipple_drivers::{Fault, FaultKind};

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Board {
    pub name: String,
    /// Refuse to start when the byte table exceeds this, MiB.
    pub memory_max_mib: u64,
    pub budget: Budget,
    #[serde(default)]
    pub rig: RigConfig,
    #[serde(default)]
    pub frontend: FrontendConfig,
    #[serde(default)]
    pub vio: VioConfig,
    #[serde(default)]
    pub stereo: StereoConfig,
    #[serde(default)]
    pub map: MapConfig,
    #[serde(default)]
    pub gpu: GpuConfig,
    #[serde(default)]
    pub replay: ReplayConfig,
    #[serde(default)]
    pub inject: InjectConfig,
    #[serde(default)]
    pub camera: CameraConfig,
    #[serde(default)]
    pub record: RecordConfig,
    #[serde(default)]
    pub imu: ImuConfig,
    #[serde(default)]
    pub gpio: GpioConfig,
}

/// Capacities bought at boot. Every one is a hard limit; full is counted, never grown.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Budget {
    /// Gaussians in the pool.
    pub splats: u32,
    /// (Gaussian, tile) pairs of one view; the farthest are dropped past it.
    pub intersections: u32,
    /// Keyframes the mapper keeps to train and evaluate on.
    pub keyframes: u32,
    /// Widest camera image the board accepts, px.
    pub image_width_max: u32,
    pub image_height_max: u32,
}

/// What the board knows of its sensors and their calibration does not say.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RigConfig {
    /// The cameras have a rolling shutter.
    pub rolling_shutter: bool,
    /// First row to last, s; 0: as the calibration says.
    pub readout_s: f64,
    /// Calibration of the board's own sensors, from the board file's folder: Kalibr camchain.yaml with imu_config.yaml
    /// beside it, Basalt json, or the mav0 of a recording.
    pub calibration: String,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FrontendConfig {
    /// 1: tracker and estimator take turns; 2: a thread each, the same poses bit for bit.
    pub threads: u32,
    /// Detection cell, one point per cell, px.
    pub grid_px: u32,
    /// FAST thresholds, grey levels: halved from the first down to the second.
    pub fast_threshold: u32,
    pub fast_threshold_min: u32,
    /// Inverse-compositional iterations a level.
    pub iterations: u32,
    /// Forward-backward distance accepted, px.
    pub recovered_max_px: f64,
    /// |f1ᵀ E f0| accepted between unit bearings.
    pub epipolar_max: f64,
}

impl Default for FrontendConfig {
    fn default() -> Self {
        FrontendConfig {
            threads: 2,
            grid_px: 60,
            fast_threshold: 40,
            fast_threshold_min: 5,
            iterations: 3,
            recovered_max_px: 0.2,
            epipolar_max: 0.005,
        }
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct VioConfig {
    /// Observation standard deviation and Huber width, px.
    pub observation_sigma_px: f64,
    pub huber_px: f64,
    pub iterations_max: u32,
    /// Newest frames kept with velocity and biases, and older ones kept as poses.
    pub states: u32,
    pub keyframes: u32,
    /// New keyframe when fewer than this fraction of points are landmarks, and not sooner than
    /// `keyframe_gap_min` frames.
    pub keyframe_connected_min: f64,
    pub keyframe_gap_min: u32,
    /// Baseline that triangulates, m.
    pub triangulation_baseline_min_m: f64,
    /// Prior standard deviations at the start: accelerometer bias m/s², gyro bias rad/s.
    pub accel_bias_sigma: f64,
    pub gyro_bias_sigma: f64,
    /// Observations further than this from their prediction after optimisation are dropped, px.
    pub outlier_px: f64,
    /// Factors on the calibration's noise densities, for vibration and scale errors it does not state.
    pub gyro_noise_scale: f64,
    pub accel_noise_scale: f64,
    /// Hold velocity and gyro bias when nothing moves.
    pub zero_velocity: bool,
    /// Refine while flying: the cameras' time offset, where they sit, the scale of the inertial unit's axes; and
    /// how well each is known before. Extrinsics wrong by an angle need `frontend.epipolar_max` above it.
    pub estimate_time_offset: bool,
    pub estimate_extrinsics: bool,
    pub estimate_imu_scale: bool,
    pub time_offset_sigma_s: f64,
    pub extrinsics_sigma_m: f64,
    pub extrinsics_sigma_rad: f64,
    pub imu_scale_sigma: f64,
    /// Ends of the sensors' ranges, rad/s and m/s²: samples there are clipped and weigh little.
    pub gyro_max: f64,
    pub accel_max: f64,
}

impl Default for VioConfig {
    fn default() -> Self {
        VioConfig {
            observation_sigma_px: 0.5,
            huber_px: 1.0,
            iterations_max: 7,
            states: 3,
            keyframes: 7,
            keyframe_connected_min: 0.7,
            keyframe_gap_min: 5,
            triangulation_baseline_min_m: 0.05,
            accel_bias_sigma: 0.3,
            gyro_bias_sigma: 0.1,
            outlier_px: 3.0,
            gyro_noise_scale: 2.0,
            accel_noise_scale: 8.0,
            zero_velocity: true,
            estimate_time_offset: false,
            estimate_extrinsics: false,
            estimate_imu_scale: false,
            time_offset_sigma_s: 0.01,
            extrinsics_sigma_m: 0.01,
            extrinsics_sigma_rad: 0.02,
            imu_scale_sigma: 0.02,
            gyro_max: 34.9,
            accel_max: 156.9,
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum StereoMethod {
    /// OpenCV block matching.
    Bm,
    /// OpenCV semi-global block matching.
    Sgbm,
    /// Semi-global matching of census transforms on the GPU.
    Sgm,
    /// A network of the user's, run by ONNX Runtime.
    Onnx,
}

impl StereoMethod {
    /// As a board file writes it.
    pub fn name(self) -> &'static str {
        match self {
            StereoMethod::Bm => "bm",
            StereoMethod::Sgbm => "sgbm",
            StereoMethod::Sgm => "sgm",
            StereoMethod::Onnx => "onnx",
        }
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StereoConfig {
    pub method: StereoMethod,
    /// Smooth the disparities of `sgm` along the picture's edges by weighted least squares, which also fills holes.
    pub wls: bool,
    /// Disparity range at full resolution, px, a multiple of 16.
    pub disparities: u32,
    /// Matching window of `bm` and of `sgbm`, px, odd.
    pub block_px: u32,
    pub sgbm_block_px: u32,
    /// Best match of `bm` and of `sgbm` must beat the second by this, percent.
    pub uniqueness_percent: u32,
    /// Directions in which `sgm` sums costs: 4 or 8.
    pub sgm_paths: u32,
    /// As `uniqueness_percent`, of `sgm`.
    pub sgm_uniqueness_percent: u32,
    /// Depths used for seeding, m.
    pub depth_min_m: f64,
    pub depth_max_m: f64,
    /// Of `onnx`.
    pub network: NetworkConfig,
}

impl Default for StereoConfig {
    fn default() -> Self {
        StereoConfig {
            // What this program has: the other needs OpenCV.
            method: if cfg!(feature = "opencv") { StereoMethod::Bm } else { StereoMethod::Sgm },
            wls: true,
            disparities: 96,
            block_px: 11,
            sgbm_block_px: 5,
            uniqueness_percent: 10,
            sgm_paths: 8,
            sgm_uniqueness_percent: 10,
            depth_min_m: 0.3,
            depth_max_m: 20.0,
            network: NetworkConfig::default(),
        }
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GpuConfig {
    /// Substring of the Vulkan device name; empty takes the first discrete, else integrated, else CPU device.
    pub device: String,
    /// Time one submission may take; integrated GPUs reset on long ones, ms.
    pub submission_max_ms: f64,
    /// Use subgroup arithmetic where the device has it.
    pub subgroups: bool,
}

impl Default for GpuConfig {
    fn default() -> Self {
        GpuConfig { device: String::new(), submission_max_ms: 20.0, subgroups: true }
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReplayConfig {
    /// Largest stamp difference of the images of one frame, s.
    pub pair_tolerance_s: f64,
    /// Gap between inertial samples that counts as a hole, s.
    pub imu_hole_s: f64,
    /// Calibration used instead of the recording's own (Kalibr yaml or Basalt json); empty: the recording's.
    pub calibration: String,
}

impl Default for ReplayConfig {
    fn default() -> Self {
        ReplayConfig { pair_tolerance_s: 0.002, imu_hole_s: 0.02, calibration: String::new() }
    }
}

impl Board {
    /// Reads a board file, applies `key.path=value` overrides, validates.
    pub fn load(path: &Path, overrides: &[String]) -> Result<Board, Fault> {
        let place = path.display().to_string();
        let text = std::fs::read_to_string(path).map_err(|e| {
            Fault::new(
                FaultKind::NoInput,
                &place,
                format!("cannot read the board file: {e}"),
                "name one, such as those of board-configs/",
            )
        })?;
        Board::parse(&place, &text, overrides)
    }

    pub fn parse(place: &str, text: &str, overrides: &[String]) -> Result<Board, Fault> {
        // Checked as written first, so that an error names the line of the file.
        let mut board: Board = toml::from_str(text).map_err(|e| in_file(place, text, &e))?;
        if !overrides.is_empty() {
            let mut table: toml::Table = toml::from_str(text).map_err(|e| in_file(place, text, &e))?;
            for assignment in overrides {
                set(&mut table, assignment)?;
                // After each, so that the one that is wrong is the one that is named.
                board = Board::deserialize(table.clone()).map_err(|e| in_override(assignment, e.message()))?;
            }
        }
        board.validate().map_err(|(key, what)| {
            let set_by = overrides.iter().rev().find(|o| o.split('=').next().is_some_and(|k| k.trim() == key));
            let at = match (set_by, line_of(text, key)) {
                (Some(assignment), _) => shown(assignment),
                (None, Some(line)) => format!("{place}:{line}"),
                (None, None) => format!("{place} (default)"),
            };
            Fault::new(FaultKind::Config, at, what, format!("change {key}"))
        })?;
        Ok(board)
    }

    /// The first key that is out of bounds, and what is wrong with it.
    fn validate(&self) -> Result<(), (&'static str, String)> {
        let table = toml::Table::try_from(self).expect("a board is a table of numbers, strings and booleans");
        for (key, bound) in BOUNDS {
            let value = lookup(&table, key).expect("BOUNDS names keys of the board");
            let number = value.as_float().or(value.as_integer().map(|i| i as f64)).unwrap_or(f64::NAN);
            if !bound.holds(number) {
                return Err((key, format!("{key} = {value} must be {bound}")));
            }
        }
        if let Some(wrong) = self.camera.wrong() {
            return Err(wrong);
        }
        let among: &[(bool, &'static str, &str)] = &[
            (
                self.frontend.fast_threshold >= self.frontend.fast_threshold_min,
                "frontend.fast_threshold",
                "must not be less than frontend.fast_threshold_min",
            ),
            (
                self.rig.readout_s > 0.0 || !self.rig.rolling_shutter,
                "rig.rolling_shutter",
                "needs rig.readout_s: without the time of a readout every image would bend",
            ),
            (
                self.stereo.network.normalises(),
                "stereo.network.deviation",
                "must be three positive numbers, stereo.network.mean three finite ones",
            ),
            (self.stereo.network.channels != 2, "stereo.network.channels", "must be 1 or 3"),
            (self.stereo.depth_max_m > self.stereo.depth_min_m, "stereo.depth_max_m", "must exceed stereo.depth_min_m"),
            (
                self.budget.intersections >= self.budget.splats,
                "budget.intersections",
                "must not be less than budget.splats: a Gaussian in view covers at least one tile",
            ),
        ];
        self.inject.check()?;
        if let Some((_, key, rule)) = among.iter().find(|(holds, _, _)| !holds) {
            return Err((key, format!("{key} {rule}")));
        }
        self.gpio.wrong().or_else(|| self.imu.wrong(&self.gpio)).map_or(Ok(()), Err)
    }
}

fn lookup<'a>(table: &'a toml::Table, key: &str) -> Option<&'a toml::Value> {
    match key.split_once('.') {
        Some((section, rest)) => lookup(table.get(section)?.as_table()?, rest),
        None => table.get(key),
    }
}

/// Line of the file on which a key stands.
fn line_of(text: &str, key: &str) -> Option<usize> {
    let document = toml::de::DeTable::parse(text).ok()?;
    let mut parts = key.split('.');
    let mut value = document.get_ref().get(parts.next()?)?;
    for part in parts {
        value = value.get_ref().get(part)?;
    }
    Some(line_at(text, value.span().start))
}

fn line_at(text: &str, byte: usize) -> usize {
    1 + text.as_bytes()[..byte.min(text.len())].iter().filter(|b| **b == b'\n').count()
}

fn in_file(place: &str, text: &str, e: &toml::de::Error) -> Fault {
    // A missing key has no place of its own: the span is empty or the whole table.
    let line = e.span().filter(|s| !s.is_empty()).map(|s| line_at(text, s.start));
    let at = line.map_or(place.to_string(), |l| format!("{place}:{l}"));
    let written = line.and_then(|l| text.lines().nth(l - 1)).map_or(String::new(), |l| format!(" (`{}`)", l.trim()));
    let what = e.message().replace('\n', " ");
    Fault::new(FaultKind::Config, at, format!("{what}{written}"), "board-configs/ shows every section")
}

/// An override as part of a one-line message.
fn shown(assignment: &str) -> String {
    format!("--set {}", assignment.replace('\n', "\\n"))
}

fn in_override(assignment: &str, what: &str) -> Fault {
    Fault::new(
        FaultKind::Config,
        shown(assignment),
        what.replace('\n', " "),
        "write section.key=value with a key of board-configs/",
    )
}

/// Applies one `a.b=value`; the value is TOML, and a bare word is a string.
fn set(table: &mut toml::Table, assignment: &str) -> Result<(), Fault> {
    let wrong = |what: &str| Fault::new(FaultKind::Usage, shown(assignment), what, "write --set section.key=value");
    let (key, value) = assignment.split_once('=').ok_or_else(|| wrong("there is no '='"))?;
    let parsed: toml::Table = toml::from_str(&format!("v = {value}"))
        .or_else(|_| toml::from_str(&format!("v = {value:?}")))
        .map_err(|_| wrong("the value is not TOML"))?;
    // A line break could smuggle in a second key.
    let value = parsed.get("v").filter(|_| parsed.len() == 1).ok_or_else(|| wrong("the value is not one value"))?;
    let mut at = table;
    let mut parts: Vec<&str> = key.trim().split('.').collect();
    let last = parts.pop().filter(|k| !k.is_empty()).ok_or_else(|| wrong("there is no key before '='"))?;
    for part in parts {
        at = at
            .entry(part)
            .or_insert_with(|| toml::Value::Table(toml::Table::new()))
            .as_table_mut()
            .ok_or_else(|| wrong(&format!("`{part}` is a value, not a section")))?;
    }
    at.insert(last.to_string(), value.clone());
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::bounds::Bound::{PowerOfTwo, Stepped};
    use super::*;
    use std::collections::BTreeSet;

    const MINIMAL: &str = "name = \"t\"\nmemory_max_mib = 64\n[budget]\nsplats = 1000\nintersections = 10000\n\
        keyframes = 8\nimage_width_max = 752\nimage_height_max = 480\n";

    /// Dotted names of every number in a table.
    fn numbers(table: &toml::Table, prefix: &str, into: &mut BTreeSet<String>) {
        for (key, value) in table {
            match value {
                toml::Value::Table(t) => numbers(t, &format!("{prefix}{key}."), into),
                v if v.is_integer() || v.is_float() => drop(into.insert(format!("{prefix}{key}"))),
                _ => {}
            }
        }
    }

    #[test]
    fn every_number_has_a_bound_and_every_bound_a_number() {
        let board = Board::parse("t.toml", MINIMAL, &[]).unwrap();
        let mut keys = BTreeSet::new();
        numbers(&toml::Table::try_from(&board).unwrap(), "", &mut keys);
        let bounded: BTreeSet<String> = BOUNDS.iter().map(|b| b.0.to_string()).collect();
        assert_eq!(keys, bounded);
    }

    #[test]
    fn bounds_say_what_they_are_and_refuse_what_is_not_a_number() {
        for (_, bound) in BOUNDS {
            assert!(!bound.holds(f64::NAN) && !bound.holds(f64::INFINITY) && !bound.holds(-1.0), "{bound}");
        }
        assert!(Stepped(5.0, 51.0, 2.0, 1.0).holds(11.0) && !Stepped(5.0, 51.0, 2.0, 1.0).holds(12.0));
        assert!(PowerOfTwo(1.0, 4.0).holds(2.0) && !PowerOfTwo(1.0, 4.0).holds(3.0));
        assert_eq!(Stepped(16.0, 512.0, 16.0, 0.0).to_string(), "a multiple of 16, 16 to 512");
    }

    #[test]
    fn lines_are_found_in_sections_and_in_dotted_keys() {
        let text = "name = \"t\"\n\n[budget]\nsplats = 3\n[map]\nscale = 2\n";
        assert_eq!(line_of(text, "name"), Some(1));
        assert_eq!(line_of(text, "budget.splats"), Some(4));
        assert_eq!(line_of(text, "map.scale"), Some(6));
        assert_eq!(line_of("a.b = 1\n", "a.b"), Some(1));
        assert_eq!(line_of(text, "map.seed"), None);
    }
}
