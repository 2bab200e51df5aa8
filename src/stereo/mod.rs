//! Rectification and stereo depth.
use stipple_drivers::Pose;

/// An undistorted camera at mapping resolution: px = (fx x/z + cx, fy y/z + cy), integer = pixel centre.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pinhole {
    pub width: usize,
    pub height: usize,
    pub fx: f64,
    pub fy: f64,
    pub cx: f64,
    pub cy: f64,
}

/// Where the rectified left camera sits on the rig.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RectifiedCamera {
    pub pinhole: Pinhole,
    pub body_from_rect: Pose,
    /// m
    pub baseline_m: f64,
}
