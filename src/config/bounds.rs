//! What every number of a board file may be.

use crate::limits::{CAMERAS_MAX, KEYFRAMES, STATES};
use Bound::{Positive, PowerOfTwo, Stepped, Within};

/// What a number of a board file may be.
#[derive(Clone, Copy, Debug)]
pub(super) enum Bound {
    Within(f64, f64),
    /// Finite and above zero.
    Positive,
    /// Within, and `divisor * n + rest`.
    Stepped(f64, f64, f64, f64),
    PowerOfTwo(f64, f64),
}

impl Bound {
    pub(super) fn holds(self, v: f64) -> bool {
        match self {
            Within(low, high) => (low..=high).contains(&v),
            Positive => v.is_finite() && v > 0.0,
            Stepped(low, high, divisor, rest) => (low..=high).contains(&v) && v % divisor == rest,
            PowerOfTwo(low, high) => (low..=high).contains(&v) && v.log2().fract() == 0.0,
        }
    }
}

impl std::fmt::Display for Bound {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Within(low, high) => write!(f, "{low} to {high}"),
            Positive => write!(f, "positive"),
            Stepped(low, high, divisor, rest) if *divisor == 2.0 && *rest == 1.0 => write!(f, "odd, {low} to {high}"),
            Stepped(low, high, divisor, _) => write!(f, "a multiple of {divisor}, {low} to {high}"),
            PowerOfTwo(low, high) => write!(f, "a power of two, {low} to {high}"),
        }
    }
}

/// Every number of a board file, with what it may be.
pub(super) const BOUNDS: &[(&str, Bound)] = &[
    ("memory_max_mib", Within(16.0, 1_048_576.0)),
    ("budget.splats", Within(256.0, 4_000_000.0)),
    ("budget.intersections", Within(1024.0, 64_000_000.0)),
    ("budget.keyframes", Within(2.0, 4096.0)),
    ("budget.image_width_max", Within(64.0, 4096.0)),
    ("budget.image_height_max", Within(64.0, 4096.0)),
    // Above a tenth of a second the body's motion between rows is no longer of first order.
    ("rig.readout_s", Within(0.0, 0.1)),
    ("frontend.threads", Within(1.0, 2.0)),
    ("frontend.grid_px", Within(16.0, 200.0)),
    ("frontend.fast_threshold", Within(1.0, 255.0)),
    ("frontend.fast_threshold_min", Within(1.0, 255.0)),
    ("frontend.iterations", Within(1.0, 50.0)),
    ("frontend.recovered_max_px", Positive),
    ("frontend.epipolar_max", Positive),
    ("vio.observation_sigma_px", Positive),
    ("vio.huber_px", Positive),
    ("vio.iterations_max", Within(1.0, 100.0)),
    ("vio.states", Within(2.0, STATES as f64)),
    ("vio.keyframes", Within(3.0, KEYFRAMES as f64)),
    ("vio.keyframe_connected_min", Within(0.0, 1.0)),
    ("vio.keyframe_gap_min", Within(0.0, 1000.0)),
    ("vio.triangulation_baseline_min_m", Positive),
    ("vio.accel_bias_sigma", Positive),
    ("vio.gyro_bias_sigma", Positive),
    ("vio.outlier_px", Positive),
    ("vio.gyro_noise_scale", Positive),
    ("vio.accel_noise_scale", Positive),
    ("vio.time_offset_sigma_s", Within(1e-6, 0.1)),
    ("vio.extrinsics_sigma_m", Within(1e-6, 1.0)),
    ("vio.extrinsics_sigma_rad", Within(1e-6, 0.5)),
    ("vio.imu_scale_sigma", Within(1e-6, 0.5)),
    ("vio.gyro_max", Positive),
    ("vio.accel_max", Positive),
    ("stereo.disparities", Stepped(16.0, 512.0, 16.0, 0.0)),
    ("stereo.block_px", Stepped(5.0, 51.0, 2.0, 1.0)),
    ("stereo.sgbm_block_px", Stepped(1.0, 21.0, 2.0, 1.0)),
    ("stereo.sgm_paths", PowerOfTwo(4.0, 8.0)),
    ("stereo.sgm_uniqueness_percent", Within(0.0, 50.0)),
    ("stereo.uniqueness_percent", Within(0.0, 100.0)),
    ("stereo.depth_min_m", Positive),
    ("stereo.depth_max_m", Positive),
    ("stereo.network.width", Within(0.0, 4096.0)),
    ("stereo.network.height", Within(0.0, 4096.0)),
    ("stereo.network.channels", Within(1.0, 3.0)),
    ("stereo.network.scale", Positive),
    ("stereo.network.threads", Within(0.0, 256.0)),
    ("map.scale", PowerOfTwo(1.0, 4.0)),
    ("map.cameras", Within(1.0, CAMERAS_MAX as f64)),
    ("map.sh_degree", Within(0.0, 3.0)),
    ("map.anchor_missing_min", Within(0.0, 1.0)),
    ("map.covered_alpha", Within(0.0, 1.0)),
    ("map.occupancy_cell_m", Positive),
    ("map.occupancy_cells", PowerOfTwo(1024.0, 16_777_216.0)),
    ("map.move_tolerance", Within(0.0, 1000.0)),
    ("map.seeds_per_step", Within(0.0, 1_000_000.0)),
    ("map.seeds_per_anchor", Within(1.0, 1_000_000.0)),
    ("map.burst_iterations", Within(0.0, 10_000.0)),
    ("map.wrong_error", Within(0.0, 1.0)),
    ("map.wrong_after_steps", Within(0.0, 1_000_000.0)),
    ("map.burst_rate", Within(0.01, 100.0)),
    ("map.densify_max", Within(0.0, 16_384.0)),
    ("map.converge_iterations_max", Within(0.0, 10_000.0)),
    ("map.steps_per_keyframe_max", Within(0.0, 1_000_000.0)),
    ("map.ssim_weight", Within(0.0, 1.0)),
    ("map.depth_weight", Within(0.0, 100.0)),
    ("map.needle_weight", Within(0.0, 100.0)),
    ("map.scale_weight", Within(0.0, 100.0)),
    ("map.scale_soft_m", Positive),
    ("map.opacity_weight", Within(0.0, 100.0)),
    ("map.lr_position", Positive),
    ("map.lr_scale", Positive),
    ("map.lr_rotation", Positive),
    ("map.lr_opacity", Positive),
    ("map.lr_colour", Positive),
    ("map.lr_halving_steps", Positive),
    ("map.lr_part_min", Within(0.0, 1.0)),
    ("map.lr_pose", Within(0.0, 0.1)),
    ("map.lr_exposure", Within(0.0, 0.1)),
    ("map.curve_period_s", Positive),
    ("map.seed", Within(0.0, u64::MAX as f64)),
    ("gpu.submission_max_ms", Positive),
    ("replay.pair_tolerance_s", Within(0.0, 1.0)),
    ("replay.imu_hole_s", Positive),
    ("inject.seed", Within(0.0, u64::MAX as f64)),
    ("camera.width_px", Within(0.0, 4096.0)),
    ("camera.height_px", Within(0.0, 4096.0)),
    ("camera.rate_hz", Within(0.1, 1000.0)),
    ("camera.exposure_us", Within(0.0, 1_000_000.0)),
    // A line of a sensor takes 5 to 60 us.
    ("camera.exposure_line_us", Within(0.0, 1000.0)),
    ("camera.transfer_s", Within(0.0, 0.5)),
    ("camera.pair_tolerance_s", Within(0.0, 1.0)),
    ("record.ring_frames", Within(1.0, 4096.0)),
    // Seven bits, less those that the bus keeps for itself.
    ("imu.i2c_address", Within(3.0, 119.0)),
    ("imu.accel_i2c_address", Within(3.0, 119.0)),
    ("imu.spi_hz", Within(10_000.0, 24_000_000.0)),
    ("imu.rate_hz", Within(10.0, 4000.0)),
    ("imu.accel_range_g", Within(1.0, 64.0)),
    ("imu.gyro_range_dps", Within(50.0, 8000.0)),
    ("imu.frozen_samples", Within(0.0, 1_000_000.0)),
    ("gpio.trigger.pulse_us", Within(1.0, 100_000.0)),
];
