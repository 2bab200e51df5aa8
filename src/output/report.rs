//! `report.json`: one flat object. A figure that was not measured is null, never zero.

use crate::map::{CurvePoint, Evaluation, SeamScores};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::{self, Write};

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Report {
    /// What was run.
    pub dataset: Option<String>,
    pub board: Option<String>,
    /// `recorded` or `lockstep`.
    pub pace: Option<String>,
    /// Mapping resolution divisor.
    pub scale: Option<u32>,
    pub device: Option<String>,

    /// Frames tracked; frames that arrived and were not.
    pub frames: Option<u64>,
    pub frames_dropped: Option<u64>,
    pub keyframes: Option<u64>,
    pub anchors: Option<u64>,
    /// Frames of reference of the trajectory: one, and one more for each reset and each restart elsewhere.
    pub epochs: Option<u32>,

    /// Error of the poses in the map, with the loops that were closed; `odometry_ate_rmse_m` is that of the estimator's poses.
    pub ate_rmse_m: Option<f64>,
    pub odometry_ate_rmse_m: Option<f64>,
    pub rte_1s_m: Option<f64>,
    pub rpe_deg: Option<f64>,
    /// Threads of tracking: 1, or 2 for front end and estimator.
    pub tracking_threads: Option<u32>,
    /// Frames over the wall time in which tracking was not waiting for one.
    pub tracking_fps: Option<f64>,
    /// CPU time of all its threads, a frame.
    pub tracking_cpu_ms: Option<f64>,
    /// CPU time of the thread that reads the cameras, a frame, the kernel's part of it, and copies of each byte on the way.
    pub camera_cpu_ms: Option<f64>,
    pub camera_kernel_ms: Option<f64>,
    pub camera_copies: Option<f64>,
    /// Wall time from taking a frame to its pose, and in each half.
    pub tracking_ms_p50: Option<f64>,
    pub tracking_ms_p99: Option<f64>,
    pub frontend_ms_p50: Option<f64>,
    pub frontend_ms_p99: Option<f64>,
    pub estimator_ms_p50: Option<f64>,
    pub estimator_ms_p99: Option<f64>,
    /// Quality of the odometry, 0 to 100: lowest, median, and the share of frames under 50.
    pub quality_min: Option<u32>,
    pub quality_p50: Option<u32>,
    pub quality_under_50: Option<f64>,
    /// Hash of the bits of every odometry state.
    pub vio_hash: Option<String>,

    /// What was estimated of the rig, over its calibration, and standard deviations.
    pub time_offsets: Vec<TimeOffsetFound>,
    /// By how much a barometer's height had drifted from the estimate's at the end, and its standard deviation.
    pub height_bias_m: Option<f64>,
    pub height_bias_sigma_m: Option<f64>,
    pub extrinsics: Vec<ExtrinsicsFound>,
    /// How well each part is known of what is estimated of the rig.
    pub convergence: Vec<Convergence>,
    /// Factors less one, by axis.
    pub gyro_scale: Option<[f64; 3]>,
    pub gyro_scale_sigma: Option<[f64; 3]>,
    pub accel_scale: Option<[f64; 3]>,
    pub accel_scale_sigma: Option<[f64; 3]>,

    #[serde(flatten)]
    pub quality: Evaluation,
    pub splats: Option<u64>,
    pub iterations: Option<u64>,
    pub iteration_ms_p50: Option<f64>,
    pub iteration_ms_p99: Option<f64>,
    /// Run time from which on no probe of the curve was under `GOOD_DB`.
    pub seconds_to_25_db: Option<f64>,

    pub gpu_bytes: Option<u64>,
    /// Tracker and estimator, whole.
    pub estimator_bytes: Option<u64>,
    /// Resident set of the process that flies, at its peak.
    pub rss_peak_bytes: Option<u64>,
    /// Resident set of the mapper's process, where it has one of its own, at its peak.
    pub map_rss_peak_bytes: Option<u64>,
    pub heap_after_seal: Option<u64>,
    pub wall_s: Option<f64>,
    /// Energy that was measured on the board, where it has sensors that may be read, and the mean power while they were.
    pub energy_j: Option<f64>,
    pub power_mean_w: Option<f64>,
    /// Number of warnings about the input.
    pub warnings: u64,

    /// Error against run time.
    pub curve: Vec<CurvePoint>,
    /// The first loops that were closed.
    pub loops: Vec<LoopClosed>,
    /// GPU time by kernel, most expensive first.
    pub kernels: Vec<KernelTime>,
    /// Work that nothing in this run needed.
    pub left_out: Vec<LeftOut>,

    /// `count_<name>` of every counter, `health_<bit>_frames` of every bit of the odometry's health.
    #[serde(flatten)]
    pub counts: BTreeMap<String, u64>,
}

/// Time that is to be added to the stamps of a camera's images, beyond what its calibration adds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TimeOffsetFound {
    pub camera: usize,
    pub offset_s: f64,
    pub offset_sigma_s: f64,
}

/// A loop that was closed: when, with what was seen when, by how many corners, the pose of the vehicle that was measured in
/// the upright frame of then, and by how much poses in the map moved.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LoopClosed {
    pub t_ns: i64,
    pub with_ns: i64,
    pub corners: u64,
    pub p_m: [f64; 3],
    pub yaw_rad: f64,
    pub moved_m: f64,
    pub moved_rad: f64,
    /// The place was of another epoch, of this flight or an earlier one, and both are one map since then.
    #[serde(default)]
    pub joins: bool,
    /// The place is of an earlier flight, and `with_ns` by the clock of that.
    #[serde(default)]
    pub earlier: bool,
    /// What it did to the map, where that was scored.
    #[serde(default)]
    pub map: Option<SeamScores>,
}

/// Whether a part of the rig was found, and what is left of its deviation.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Convergence {
    /// `time_offset`, `extrinsics`, `gyro_scale` or `accel_scale`.
    pub part: String,
    /// The camera that it is of, if any.
    pub camera: Option<usize>,
    pub converged: bool,
    /// The largest of its deviations, as a share of what it was at the start.
    pub sigma_left: f64,
}

/// Where a camera sits over where it was calibrated: position in the body frame, rotation vector in its own.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ExtrinsicsFound {
    pub camera: usize,
    pub p_m: [f64; 3],
    pub p_sigma_m: [f64; 3],
    pub theta_rad: [f64; 3],
    pub theta_sigma_rad: [f64; 3],
}

/// Work of a kind that was not done where nothing needed it: `times` out of `of`, and the time that it would have taken at the mean of
/// what was done of it, ms.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LeftOut {
    pub what: String,
    pub times: u64,
    pub of: u64,
    pub saved_ms: Option<f64>,
}

impl LeftOut {
    /// `times` left out, beside `done` that took `done_s` together, s.
    pub fn beside(what: &str, times: u64, (done, done_s): (u64, f64)) -> LeftOut {
        let saved_ms = (done > 0).then(|| 1e3 * done_s * times as f64 / done as f64);
        LeftOut { what: what.into(), times, of: times + done, saved_ms }
    }
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct KernelTime {
    pub name: String,
    pub dispatches: u64,
    pub total_ms: f64,
}

const COUNT: &str = "count_";

/// What the published method reaches on EuRoC's V1_01 when the flight is over; dB on training views.
pub const GOOD_DB: f64 = 25.0;

/// The first point of the curve from which on training views stay at `db`; `None` where they end below it.
pub fn seconds_to(curve: &[CurvePoint], db: f64) -> Option<f64> {
    let good = curve.iter().rev().take_while(|c| c.psnr_db.is_none_or(|p| p >= db));
    good.filter(|c| c.psnr_db.is_some()).last().map(|c| c.t_s)
}

impl Report {
    pub fn set_counters(&mut self, counters: &[(impl AsRef<str>, u64)]) {
        self.counts = counters.iter().map(|(name, n)| (format!("{COUNT}{}", name.as_ref()), *n)).collect();
    }

    /// Frames on which each bit of the odometry's health was set; after the counters.
    pub fn set_health(&mut self, frames: impl Iterator<Item = (&'static str, u64)>) {
        self.counts.extend(frames.map(|(name, n)| (format!("health_{name}_frames"), n)));
    }

    /// A counter by its name; 0 where there is none.
    pub fn count(&self, name: &str) -> u64 {
        self.counts.get(&format!("{COUNT}{name}")).copied().unwrap_or(0)
    }

    /// Counters that are not zero, without their prefix.
    pub fn counted(&self) -> impl Iterator<Item = (&str, u64)> {
        self.counts.iter().filter(|(_, n)| **n > 0).map(|(name, n)| (name.strip_prefix(COUNT).unwrap_or(name), *n))
    }

    pub fn write_json(&self, out: &mut impl Write) -> io::Result<()> {
        serde_json::to_writer_pretty(&mut *out, self)?;
        writeln!(out)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::counters::Counters;

    const KEYS: &str =
        "frames keyframes anchors frames_dropped ate_rmse_m odometry_ate_rmse_m rte_1s_m rpe_deg tracking_fps tracking_ms_p50 \
        tracking_ms_p99 tracking_threads tracking_cpu_ms frontend_ms_p50 frontend_ms_p99 estimator_ms_p50 \
        estimator_ms_p99 psnr_db ssim psnr_heldout_db ssim_heldout psnr_heldout_between_db psnr_heldout_fitted_db ssim_heldout_fitted psnr_heldout_aligned_db splats iterations \
        iteration_ms_p50 iteration_ms_p99 seconds_to_25_db gpu_bytes estimator_bytes quality_min quality_p50 quality_under_50 rss_peak_bytes map_rss_peak_bytes heap_after_seal wall_s energy_j power_mean_w device vio_hash dataset board pace scale \
        camera_cpu_ms camera_kernel_ms camera_copies height_bias_m height_bias_sigma_m gyro_scale gyro_scale_sigma accel_scale accel_scale_sigma epochs";

    #[test]
    fn unmeasured_figures_are_null_and_present() {
        let json: serde_json::Value = serde_json::to_value(Report::default()).unwrap();
        for key in KEYS.split_whitespace() {
            assert_eq!(json.get(key), Some(&serde_json::Value::Null), "{key}");
        }
        assert!(
            json["curve"].is_array()
                && json["time_offsets"].is_array()
                && json["convergence"].is_array()
                && json["extrinsics"].is_array()
                && json["kernels"].is_array()
                && json["left_out"].is_array()
                && json["loops"].is_array()
                && json["warnings"] == 0
        );
    }

    #[test]
    fn report_is_flat_and_reads_back() {
        let counters = Counters::default();
        counters.outliers.add(7);
        let mut report = Report { wall_s: Some(24.5), ..Report::default() };
        report.quality = Evaluation { psnr_db: Some(24.5), ..Evaluation::default() };
        report.set_counters(&counters.list());
        report.set_health([("imu_gap", 3)].into_iter());
        report.curve.push(CurvePoint {
            t_s: 5.0,
            psnr_db: Some(20.0),
            psnr_heldout_db: None,
            splats: 10,
            iterations: 20,
        });
        let mut bytes = Vec::new();
        report.write_json(&mut bytes).unwrap();
        let json: serde_json::Value = serde_json::from_slice(&bytes).unwrap();
        assert_eq!((&json["count_outliers"], &json["health_imu_gap_frames"]), (&7.into(), &3.into()));
        assert_eq!(json["curve"][0]["psnr_heldout_db"], serde_json::Value::Null);
        let nested = json.as_object().unwrap().iter().filter(|(_, v)| v.is_object());
        assert_eq!(nested.count(), 0);
        assert_eq!(serde_json::from_slice::<Report>(&bytes).unwrap(), report);
        assert_eq!(report.counted().collect::<Vec<_>>(), [("outliers", 7), ("health_imu_gap_frames", 3)]);
    }

    #[test]
    fn what_is_left_out_would_have_taken_as_long_as_the_rest_of_its_kind() {
        let of = |times, done| LeftOut::beside("steps", times, done);
        assert_eq!(of(30, (10, 0.5)), LeftOut { what: "steps".into(), times: 30, of: 40, saved_ms: Some(1500.0) });
        assert_eq!(of(30, (0, 0.0)), LeftOut { what: "steps".into(), times: 30, of: 30, saved_ms: None });
    }

    #[test]
    fn time_to_25_db_is_the_last_time_it_was_reached() {
        let curve = |points: &[(f64, Option<f64>)]| -> Option<f64> {
            let of = |&(t_s, psnr_db): &(f64, Option<f64>)| CurvePoint { t_s, psnr_db, ..CurvePoint::default() };
            seconds_to(&points.iter().map(of).collect::<Vec<_>>(), GOOD_DB)
        };
        assert_eq!(
            curve(&[(0.0, None), (5.0, Some(26.0)), (10.0, Some(24.0)), (15.0, Some(25.0)), (20.0, Some(30.0))]),
            Some(15.0)
        );
        assert_eq!(curve(&[(5.0, Some(26.0)), (10.0, None)]), Some(5.0));
        assert_eq!(curve(&[(5.0, Some(26.0)), (10.0, Some(24.9))]), None);
        assert_eq!(curve(&[]), None);
    }

    #[test]
    fn figures_that_are_not_numbers_become_null() {
        let quality = Evaluation { ssim: Some(f64::NAN), psnr_db: Some(f64::INFINITY), ..Evaluation::default() };
        let report = Report { quality, ..Report::default() };
        let json = serde_json::to_value(&report).unwrap();
        assert!(json["ssim"].is_null() && json["psnr_db"].is_null());
    }
}
