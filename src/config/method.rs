//! The method's sections: `[frontend]`, `[vio]`, `[stereo]`, `[map]`, `[gpu]`. Each has the few keys that a board may need to set,
//! and the constants of the method, which only a bench varies; what they were chosen by is in tests/bench/README.md.

use super::section::{section, Bound};
use crate::limits::CAMERAS_MAX;
use serde::{Deserialize, Serialize};

section! {
    /// Tracking of points.
    FrontendConfig, "frontend.";
    /// 1: tracker and estimator take turns; 2: a thread each, with the same poses bit for bit. Take 1 on a board whose other
    /// cores are busy.
    threads: u32 = 2, Bound::Within(1.0, 2.0);
    /// Side of a detection cell; one point is followed in each. Larger cells take less CPU time and lose accuracy: 80 px take
    /// six tenths of the time for nearly twice the error. Images of 376x240 have 24 cells of 60 px: 30 px, as many points as in
    /// 752x480, err a third less in the mean on the demo, for three times the CPU time.
    grid_px: u32 = 60, Bound::Within(16.0, 200.0);
    /// Least contrast of a corner, grey levels. Raise it to spend less time on faint corners.
    fast_threshold_min: u32 = 5, Bound::Within(1.0, 255.0);
    tuning
    /// Motion of the view since the last tracked frame, px, below which a frame is left to inertia where odometry is sure; none
    /// is where it is 0.
    carried_px: f64 = 16.0;
    /// Inverse-compositional iterations a level.
    iterations: u32 = 3;
    /// Largest distance between a point and its match followed back, px.
    forward_backward_max_px: f64 = 0.2;
    /// Largest |f1ᵀ E f0| between unit bearings of one point.
    epipolar_max: f64 = 0.005;
}

section! {
    /// The estimator.
    VioConfig, "vio.";
    /// Allowance for a data sheet: factor on the gyro noise density of a calibration that does not say `noise_source: measured`
    /// beside it (`stipple calib-noise` prints it); one that does is believed as it stands, factor 1. A data sheet's figure is
    /// that of a typical unit at rest: it has neither this unit's vibration nor its errors of scale and axes. Chosen from 1, 2
    /// and 4 over ten flights of EuRoC's unit and a simulated one.
    gyro_noise_scale: f64 = 2.0, Bound::Positive;
    /// The same for the accelerometer, which feels vibration more and whose errors of scale are multiplied by gravity: chosen from
    /// 2, 4 and 8.
    accel_noise_scale: f64 = 8.0, Bound::Positive;
    /// Whether the offset between each camera's clock and the inertial unit's is estimated. Set it where they are not triggered
    /// together, or one camera later than another; 8 ms cost eight times the error. Poses are then at their frames' stamps by the
    /// inertial clock; log and report have the offsets. The map takes all cameras to be exposed when camera 0 is.
    estimate_time_offset: bool = false;
    /// Whether the cameras' places on the body are estimated. Set it after a hard landing, or for a rig that flexes.
    estimate_extrinsics: bool = false;
    /// Whether the scale of the inertial unit's axes is estimated. Set it for a unit that was not calibrated.
    estimate_imu_scale: bool = false;
    /// Gravity where the rig flies, m/s²: 9.780 at the equator, 9.807 at 45° and 9.832 at the poles, less 0.003 for each
    /// kilometre of height.
    gravity: f64 = 9.81, Bound::Within(9.7, 9.9);
    tuning
    /// Standard deviation of an observation, px.
    observation_sigma_px: f64 = 0.3;
    /// Width of Huber's weight, px. Less than a deviation: tracks slide along edges and move by themselves, and their errors are
    /// larger than Gaussian ones.
    huber_px: f64 = 0.2;
    iterations_max: u32 = 7;
    /// Newest frames kept with velocity and biases.
    states: u32 = 3;
    /// Older frames kept as poses.
    keyframes: u32 = 7;
    /// A keyframe is due when fewer than this fraction of points are landmarks.
    keyframe_connected_min: f64 = 0.7;
    /// Time between two keyframes, at least, s: at 20 Hz every fifth frame may be one.
    keyframe_gap_min_s: f64 = 0.225;
    /// Baseline that triangulates, m.
    triangulation_baseline_min_m: f64 = 0.05;
    /// Standard deviation of the accelerometer's bias at the start, m/s².
    accel_bias_sigma: f64 = 0.3;
    /// Standard deviation of the gyro's bias at the start, rad/s.
    gyro_bias_sigma: f64 = 0.1;
    /// Observations further than this from their prediction after optimisation are dropped, px.
    outlier_px: f64 = 3.0;
    /// Holds velocity and gyro bias when nothing moves.
    zero_velocity: bool = true;
    /// Standard deviation of each camera's offset before it is estimated, s.
    time_offset_sigma_s: f64 = 0.01;
    /// Standard deviation of a camera's position before it is estimated, m.
    extrinsics_sigma_m: f64 = 0.01;
    /// Standard deviation of a camera's attitude before it is estimated, rad. The tracker's epipolar gate is wider by three.
    extrinsics_sigma_rad: f64 = 0.02;
    /// Standard deviation of the scale of an axis before it is estimated.
    imu_scale_sigma: f64 = 0.02;
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
    /// The name that a board file writes.
    pub fn name(self) -> &'static str {
        match self {
            StereoMethod::Bm => "bm",
            StereoMethod::Sgbm => "sgbm",
            StereoMethod::Sgm => "sgm",
            StereoMethod::Onnx => "onnx",
        }
    }
}

section! {
    /// Stereo depth, which seeds the map.
    StereoConfig, "stereo.";
    /// bm (OpenCV block matching; fast on a CPU), sgbm (OpenCV semi-global; sgm does the work of both where OpenCV is missing),
    /// sgm (semi-global on the GPU; the best where there is one) or onnx (a network of yours).
    method: StereoMethod = if cfg!(feature = "opencv") { StereoMethod::Bm } else { StereoMethod::Sgm };
    /// Range of disparities at full resolution, px. Raise it to see nearer than focal length times baseline over this.
    disparities: u32 = 96, Bound::Multiple(16.0, 512.0, 16.0);
    /// Least depth used.
    depth_min_m: f64 = 0.3, Bound::Positive;
    /// Largest depth used. Lower it for a short baseline, whose far depths are noise.
    depth_max_m: f64 = 20.0, Bound::Positive;
    /// The network of stereo.method = "onnx".
    network: NetworkConfig = NetworkConfig::default();
    tuning
    /// Smooths the disparities of `sgm` along the picture's edges by weighted least squares, which also fills holes.
    wls: bool = true;
    /// Matching window of `bm`, px, odd.
    block_px: u32 = 11;
    /// Matching window of `sgbm`, px, odd.
    sgbm_block_px: u32 = 5;
    /// The best match of `bm` and `sgbm` must beat the second by this, percent.
    uniqueness_percent: u32 = 10;
    /// Directions in which `sgm` sums costs: 4 or 8.
    sgm_paths: u32 = 8;
    /// The best match of `sgm` must beat the second by this, percent.
    sgm_uniqueness_percent: u32 = 10;
}

/// How images of another size than the network's are brought to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Fit {
    /// Repeats the last column and row to the right and below; the network must be as large as the images.
    Pad,
    /// Interpolates; disparities are scaled back.
    Scale,
}

section! {
    /// A network for stereo.method = "onnx": two images of 32-bit floats in, as many disparities as pixels out.
    NetworkConfig, "stereo.network.";
    /// ONNX file.
    model: String = String::new();
    /// ONNX Runtime's shared library; empty: libonnxruntime.so where the loader finds it.
    runtime: String = String::new();
    /// Mean of each channel that is subtracted from grey levels of 0 to 1; the default is ImageNet's, which most networks were
    /// trained with.
    mean: [f64; 3] = [0.485, 0.456, 0.406];
    /// Deviation that each channel is divided by.
    deviation: [f64; 3] = [0.229, 0.224, 0.225];
    /// Whether the output is minus the disparity, as optical flow has it.
    negated: bool = false;
    tuning
    left: String = "left".into();
    right: String = "right".into();
    disparity: String = "disparity".into();
    width: u32 = 0;
    height: u32 = 0;
    fit: Fit = Fit::Pad;
    channels: u32 = 3;
    scale: f64 = 1.0 / 255.0;
    threads: u32 = 0;
}

impl NetworkConfig {
    /// Whether mean and deviation are numbers to normalise by.
    pub(super) fn normalises(&self) -> bool {
        self.mean.iter().all(|m| m.is_finite()) && self.deviation.iter().all(|d| d.is_finite() && *d > 0.0)
    }
}

/// What the map is trained on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Projection {
    /// Views without distortion, of cameras 0 and 1.
    Rectified,
    /// Raw images of Kannala-Brandt lenses.
    Fisheye,
}

section! {
    /// What the mapper does with its budget.
    MapConfig, "map.";
    /// Whether a map is made; odometry needs none.
    enabled: bool = true;
    /// Divisor of the mapping resolution. 2 takes a quarter of the time of a step and gives up detail finer than 2 px.
    scale: u32 = 1, Bound::PowerOfTwo(1.0, 4.0);
    /// Cameras that train; rectified views are two at most. More than one pay where they see different things.
    cameras: u32 = 1, Bound::Within(1.0, CAMERAS_MAX as f64);
    /// rectified (cameras 0 and 1 without distortion) or fisheye (raw images of Kannala-Brandt lenses, all of their view).
    projection: Projection = Projection::Rectified;
    /// Whether red, green and blue are trained, of cameras or recordings in colour: three times the images and the loss of a grey
    /// map, and 24 bytes a Gaussian more. A camera without a format in colour is refused.
    colour: bool = false;
    /// Gaussians that an anchor may add for every training step that keyframes got so far on average; 0: no limit. More make
    /// every later step dearer and are not trained themselves: raise it where the mapper has time after the flight.
    seeds_per_step: u32 = 50, Bound::Within(0.0, 1_000_000.0);
    /// Training steps for a new anchor, every other on its view, before keyframes are drawn at random again: half a second of
    /// them.
    burst_iterations: u32 = 20, Bound::Within(0.0, 10_000.0);
    /// Number of training steps on each view, its first, that draw it at half the size; a discrete GPU takes none, as its steps
    /// hardly become shorter. On a processor they take 0.4 of the time, and maps that get few steps end better; integrated GPUs
    /// were not measured. Set 0 where many keyframes show one place: those lose detail. Images take a quarter more GPU memory.
    half_size_steps: u32 = 0, Bound::Within(0.0, 10_000.0);
    /// Training steps for every keyframe on average, after which the mapper rests until the next one; 0: no end. More teach the
    /// map its few views by heart.
    steps_per_keyframe_max: u32 = 300, Bound::Within(0.0, 1_000_000.0);
    tuning
    /// A keyframe becomes an anchor when more than this fraction of its valid view is not reconstructed: the rendered alpha is
    /// under `covered_alpha`, or the rendering is `wrong_error` off what is seen, of 1.
    anchor_missing_min: f64 = 0.05;
    covered_alpha: f64 = 0.05;
    wrong_error: f64 = 0.25;
    /// A view that is only wrong becomes an anchor when this many steps were taken since the last one: seeds that nothing trains
    /// are a loss.
    wrong_after_steps: u32 = 200;
    /// Side of a cell of the occupancy grid, m.
    occupancy_cell_m: f64 = 0.1;
    /// Cells of its hash table.
    occupancy_cells: u32 = 1 << 18;
    /// A correction moves an anchor's Gaussians when it exceeds this since they were last moved, m and rad: odometry's
    /// corrections within its window stay below, those of a loop do not.
    move_tolerance: f64 = 0.02;
    /// Gaussians that an anchor may seed.
    seeds_per_anchor: u32 = 8192;
    /// Learning rates of a burst over those of other steps.
    burst_rate: f64 = 1.0;
    /// Gaussians added to an anchor after its burst, where none of its picture is right.
    densify_max: u32 = 4096;
    /// Training steps from one image that is fetched from the disk to the next, at least.
    rotation_steps: u32 = 1;
    /// A full pool gives its least important Gaussians for new ones.
    evict: bool = true;
    /// Weight of 1 - SSIM beside L1.
    ssim_weight: f64 = 0.2;
    /// Weight of the logarithm of the longest axis over three times the second, mean over the visible Gaussians.
    needle_weight: f64 = 0.1;
    /// Weight of the logarithm of the longest axis over `scale_soft_m`, mean over the visible Gaussians.
    scale_weight: f64 = 0.1;
    scale_soft_m: f64 = 0.1;
    /// Weight of the opacity, mean over the visible Gaussians.
    opacity_weight: f64 = 0.0;
    /// Adam's rate of positions, per metre of median scene depth.
    lr_position: f64 = 2e-3;
    /// Adam's rate of the logarithm of scales.
    lr_scale: f64 = 3e-2;
    /// Adam's rate of quaternions.
    lr_rotation: f64 = 1e-2;
    /// Adam's rate of the logit of opacities.
    lr_opacity: f64 = 5e-2;
    /// Adam's rate of colours.
    lr_colour: f64 = 1e-2;
    /// All rates fall as 1 / (1 + steps / lr_halving_steps), in steps a keyframe, to the part `lr_part_min` of themselves.
    lr_halving_steps: f64 = 50.0;
    lr_part_min: f64 = 0.1;
    /// Whether the mapper corrects the poses of its keyframes for itself.
    refine_pose: bool = true;
    /// Adam's rate of poses, m and rad.
    lr_pose: f64 = 1e-4;
    /// Whether it finds gain and offset of each keyframe.
    refine_exposure: bool = true;
    /// Adam's rate of exposures, ln gain and grey.
    lr_exposure: f64 = 1e-2;
    /// Time between samples of the curve of error against run time, s.
    curve_period_s: f64 = 5.0;
    seed: u64 = 1;
}

section! {
    /// Loop closure: places that are recognised correct the drift of odometry, and join what was mapped before a reset or by an earlier
    /// run. They are kept in `places` of the run's folder where the board has a store.
    LoopsConfig, "loops.";
    /// Whether places are recognised. It takes two cameras that see the same.
    enabled: bool = true;
}

section! {
    /// The map on disk, in `map` of the run's folder: what the mapper's memory does not hold.
    StoreConfig, "store.";
    /// Whether the map is kept there, too. Without, mapping ends when `budget.keyframes` have come, and a restart begins anew.
    enabled: bool = true;
    /// Space on the disk, MiB, taken in files of 8 MiB as it is needed; half of it holds records. A snapshot, of twice the bytes of a full pool, lies beside it. A keyframe of 376x240 in grey takes 90 kB, a thousand
    /// Gaussians 150 kB.
    max_mib: u64 = 2048, Bound::Within(128.0, 1_048_576.0);
    /// Most that is written in a second, MiB, on average, beside the snapshots (`map/latest`) that are overwritten with each keyframe.
    write_mib_per_s: f64 = 8.0, Bound::Within(0.1, 4096.0);
    /// Keyframes that are known: 1 to 2 KiB of memory each, and 2 KiB for the blocks that it may see; as many are known to loop
    /// closure, 17 KiB each, and beyond that the ones whose neighbours are the nearest are left out.
    keyframes: u32 = 2048, Bound::Within(2.0, 65_536.0);
}

section! {
    /// The Vulkan device.
    GpuConfig, "gpu.";
    /// Part of the device's name; empty: the first discrete, else integrated, else CPU device. Name one where there are several.
    device: String = String::new();
    /// Longest time of one submission. Integrated GPUs reset on long ones; a CPU has no watchdog, and fewer submissions cost
    /// less.
    submission_max_ms: f64 = 20.0, Bound::Positive;
    tuning
    /// Uses subgroup arithmetic where the device has it, and texel buffers on a CPU.
    subgroups: bool = true;
    /// Name of a `Profile` whose limits count beside those of the device; empty: none.
    profile: String = String::new();
}
