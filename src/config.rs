//! Board files: strict TOML (unknown keys are refused), units in every name, one `validate`.
//!
//! A board file states what the board is (`name`, `memory_max_mib`), its `[budget]`, and where it
//! departs from the defaults of the method (`[frontend]`, `[vio]`, `[stereo]`, `[map]`, `[gpu]`).
//! `--set section.key=value` edits the parsed table before it is checked, so an override obeys
//! the same rules as the file.

use serde::{Deserialize, Serialize};
use std::path::Path;
use stipple_drivers::{Exit, Fault};

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Board {
    pub name: String,
    /// Refuse to start when the byte table exceeds this, MiB.
    pub memory_max_mib: u64,
    pub budget: Budget,
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

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FrontendConfig {
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
            grid_px: 50,
            fast_threshold: 40,
            fast_threshold_min: 5,
            iterations: 5,
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
}

impl Default for VioConfig {
    fn default() -> Self {
        VioConfig {
            observation_sigma_px: 0.5,
            huber_px: 1.0,
            iterations_max: 7,
            keyframe_connected_min: 0.7,
            keyframe_gap_min: 5,
            triangulation_baseline_min_m: 0.05,
            accel_bias_sigma: 0.3,
            gyro_bias_sigma: 0.1,
            outlier_px: 3.0,
            gyro_noise_scale: 2.0,
            accel_noise_scale: 4.0,
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum StereoMethod {
    /// OpenCV block matching.
    Bm,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StereoConfig {
    pub method: StereoMethod,
    /// Disparity range at full resolution, px, a multiple of 16.
    pub disparities: u32,
    /// Matching window, px, odd.
    pub block_px: u32,
    /// Best match must beat the second by this, percent.
    pub uniqueness_percent: u32,
    /// Depths used for seeding, m.
    pub depth_min_m: f64,
    pub depth_max_m: f64,
}

impl Default for StereoConfig {
    fn default() -> Self {
        StereoConfig {
            method: StereoMethod::Bm,
            disparities: 96,
            block_px: 11,
            uniqueness_percent: 10,
            depth_min_m: 0.3,
            depth_max_m: 20.0,
        }
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MapConfig {
    pub enabled: bool,
    /// Mapping resolution divisor: 1, 2 or 4.
    pub scale: u32,
    /// A keyframe becomes an anchor when more than this fraction of its valid view is uncovered
    /// (rendered alpha under `covered_alpha`).
    pub anchor_uncovered_min: f64,
    pub covered_alpha: f64,
    /// Occupancy grid cell, m, and its capacity (cells).
    pub occupancy_cell_m: f64,
    pub occupancy_cells: u32,
    /// Gaussians an anchor may seed.
    pub seeds_per_anchor: u32,
    /// Steps on a new anchor alone before uniform sampling resumes.
    pub burst_iterations: u32,
    /// Mapper iterations a frame in lockstep pace.
    pub lockstep_iterations: u32,
    /// Weight of 1 - SSIM beside L1.
    pub ssim_weight: f64,
    /// Adam learning rates: position (per metre of median scene depth), log scale, quaternion,
    /// opacity logit, colour.
    pub lr_position: f64,
    pub lr_scale: f64,
    pub lr_rotation: f64,
    pub lr_opacity: f64,
    pub lr_colour: f64,
    /// Seconds between samples of the error-against-time curve.
    pub curve_period_s: f64,
    pub seed: u64,
}

impl Default for MapConfig {
    fn default() -> Self {
        MapConfig {
            enabled: true,
            scale: 1,
            anchor_uncovered_min: 0.05,
            covered_alpha: 0.05,
            occupancy_cell_m: 0.1,
            occupancy_cells: 1 << 18,
            seeds_per_anchor: 8192,
            burst_iterations: 20,
            lockstep_iterations: 2,
            ssim_weight: 0.2,
            lr_position: 3.2e-4,
            lr_scale: 5e-3,
            lr_rotation: 2e-3,
            lr_opacity: 5e-2,
            lr_colour: 5e-3,
            curve_period_s: 5.0,
            seed: 1,
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
    /// Largest stamp difference of a stereo pair, s.
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
                Exit::NoInput,
                &place,
                format!("cannot read the board file: {e}"),
                "pass --board with a file of board-configs/",
            )
        })?;
        Board::parse(&place, &text, overrides)
    }

    pub fn parse(place: &str, text: &str, overrides: &[String]) -> Result<Board, Fault> {
        let bad = |e: toml::de::Error| {
            let line = e.span().map(|s| 1 + text[..s.start.min(text.len())].matches('\n').count());
            let at = line.map_or(place.to_string(), |l| format!("{place}:{l}"));
            Fault::new(Exit::Config, at, e.message().replace('\n', " "), "see board-configs/ for every key")
        };
        // Checked as written first, so that an error names the line of the file.
        let board: Board = toml::from_str(text).map_err(bad)?;
        let board = if overrides.is_empty() {
            board
        } else {
            let mut table: toml::Table = toml::from_str(text).map_err(bad)?;
            for o in overrides {
                set(&mut table, o)?;
            }
            Board::deserialize(table).map_err(|e| {
                Fault::new(
                    Exit::Config,
                    format!("--set {}", overrides.join(" ")),
                    e.message().replace('\n', " "),
                    "keys are section.key as in board-configs/",
                )
            })?
        };
        board.validate(place)?;
        Ok(board)
    }

    fn validate(&self, place: &str) -> Result<(), Fault> {
        let b = &self.budget;
        let m = &self.map;
        let s = &self.stereo;
        let v = &self.vio;
        let f = &self.frontend;
        let rules: &[(bool, &str, &str)] = &[
            (self.memory_max_mib >= 16, "memory_max_mib", "must be at least 16"),
            ((256..=4_000_000).contains(&b.splats), "budget.splats", "must be 256..4000000"),
            ((1024..=64_000_000).contains(&b.intersections), "budget.intersections", "must be 1024..64000000"),
            ((2..=4096).contains(&b.keyframes), "budget.keyframes", "must be 2..4096"),
            ((64..=4096).contains(&b.image_width_max), "budget.image_width_max", "must be 64..4096"),
            ((64..=4096).contains(&b.image_height_max), "budget.image_height_max", "must be 64..4096"),
            ((16..=200).contains(&f.grid_px), "frontend.grid_px", "must be 16..200"),
            (
                f.fast_threshold_min >= 1 && f.fast_threshold >= f.fast_threshold_min && f.fast_threshold <= 255,
                "frontend.fast_threshold",
                "must be fast_threshold_min..255",
            ),
            ((1..=50).contains(&f.iterations), "frontend.iterations", "must be 1..50"),
            (f.recovered_max_px > 0.0, "frontend.recovered_max_px", "must be positive"),
            (f.epipolar_max > 0.0, "frontend.epipolar_max", "must be positive"),
            (v.observation_sigma_px > 0.0, "vio.observation_sigma_px", "must be positive"),
            (v.huber_px > 0.0, "vio.huber_px", "must be positive"),
            ((1..=100).contains(&v.iterations_max), "vio.iterations_max", "must be 1..100"),
            (v.accel_bias_sigma > 0.0 && v.gyro_bias_sigma > 0.0, "vio.*_bias_sigma", "must be positive"),
            (v.gyro_noise_scale > 0.0 && v.accel_noise_scale > 0.0, "vio.*_noise_scale", "must be positive"),
            (v.triangulation_baseline_min_m > 0.0, "vio.triangulation_baseline_min_m", "must be positive"),
            (
                s.disparities > 0 && s.disparities % 16 == 0 && s.disparities <= 512,
                "stereo.disparities",
                "must be a multiple of 16 up to 512",
            ),
            (s.block_px % 2 == 1 && (5..=51).contains(&s.block_px), "stereo.block_px", "must be odd, 5..51"),
            (s.depth_min_m > 0.0 && s.depth_max_m > s.depth_min_m, "stereo.depth_max_m", "must exceed depth_min_m > 0"),
            (matches!(m.scale, 1 | 2 | 4), "map.scale", "must be 1, 2 or 4"),
            (m.occupancy_cell_m > 0.0, "map.occupancy_cell_m", "must be positive"),
            (
                m.occupancy_cells.is_power_of_two() && m.occupancy_cells >= 1024,
                "map.occupancy_cells",
                "must be a power of two of at least 1024",
            ),
            ((0.0..=1.0).contains(&m.ssim_weight), "map.ssim_weight", "must be 0..1"),
            (m.seeds_per_anchor >= 1, "map.seeds_per_anchor", "must be positive"),
            (m.curve_period_s > 0.0, "map.curve_period_s", "must be positive"),
            (self.gpu.submission_max_ms > 0.0, "gpu.submission_max_ms", "must be positive"),
            (
                self.replay.pair_tolerance_s >= 0.0 && self.replay.imu_hole_s > 0.0,
                "replay.imu_hole_s",
                "must be positive",
            ),
        ];
        match rules.iter().find(|(ok, _, _)| !ok) {
            Some((_, key, rule)) => {
                Err(Fault::new(Exit::Config, format!("{place}: {key}"), *rule, "change the board file"))
            }
            None => Ok(()),
        }
    }
}

/// Applies one `a.b=value`; the value is TOML, and a bare word is a string.
fn set(table: &mut toml::Table, assignment: &str) -> Result<(), Fault> {
    let wrong =
        |what: &str| Fault::new(Exit::Usage, format!("--set {assignment}"), what, "write --set section.key=value");
    let (key, value) = assignment.split_once('=').ok_or_else(|| wrong("no '='"))?;
    let parsed: toml::Table = toml::from_str(&format!("v = {value}"))
        .or_else(|_| toml::from_str(&format!("v = {value:?}")))
        .map_err(|_| wrong("the value is not TOML"))?;
    let mut at = table;
    let mut parts: Vec<&str> = key.trim().split('.').collect();
    let last = parts.pop().filter(|k| !k.is_empty()).ok_or_else(|| wrong("no key"))?;
    for part in parts {
        at = at
            .entry(part)
            .or_insert_with(|| toml::Value::Table(toml::Table::new()))
            .as_table_mut()
            .ok_or_else(|| wrong("the section is a value"))?;
    }
    at.insert(last.to_string(), parsed["v"].clone());
    Ok(())
}
