//! Compile-time shape of the estimator. Capacities that depend on the board live in its `[budget]`.

/// Cameras on a rig. Two is what every board has; four is what headsets have.
pub const CAMERAS_MAX: usize = 4;
/// Newest frames kept with velocity and biases (15 dof), at most; `vio.states`, a tuning constant, says how many.
pub const STATES: usize = 5;
/// Older frames kept as poses only (6 dof), at most.
pub const KEYFRAMES: usize = 10;
/// Time offset and extrinsics of every camera, scale of the inertial unit, where they are estimated.
pub const RIG_DIM: usize = (1 + 6) * CAMERAS_MAX + 6;
/// Frames in the window at its peak: one more of each just before marginalization.
pub const FRAMES: usize = STATES + 1 + KEYFRAMES + 1;
/// The bias of a barometer, one a state, where a board has one.
pub const HEIGHT_DIM: usize = STATES + 1;
/// Window dimension at its peak.
pub const WINDOW_DIM: usize = 15 * (STATES + 1) + 6 * (KEYFRAMES + 1) + RIG_DIM + HEIGHT_DIM;
/// Points tracked in one camera at a time.
pub const TRACKS: usize = 300;
/// Landmarks alive in the window.
pub const LANDMARKS: usize = 1200;
/// Observations of one landmark: every camera of every frame of the window.
pub const OBSERVATIONS: usize = CAMERAS_MAX * FRAMES;
/// Inertial samples between two frames: 1 kHz over half a second.
pub const IMU_BETWEEN_FRAMES: usize = 512;
/// Seconds of inertial samples that tracker and estimator keep: longer than a start or a gap between frames may last.
pub const IMU_HISTORY_SECS: f64 = 2.56;
/// Pyramid levels, the full image included.
pub const PYRAMID_LEVELS: usize = 4;

const _: () = assert!(LANDMARKS >= 2 * TRACKS, "a keyframe change keeps the old landmarks while new ones arrive");
const _: () = assert!(STATES >= 2, "an inertial factor needs two states");
const _: () = assert!(FRAMES <= u8::MAX as usize, "observations name slots in a byte");
