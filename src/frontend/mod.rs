//! Images in, tracked points out.
use crate::limits::{CAMERAS_MAX, TRACKS};
use crate::mem::List;
use stipple_drivers::Nanos;

/// A point tracked in one camera. The same `id` in two cameras is the same point in space.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Track {
    pub id: u64,
    /// Pixel in the raw (distorted) image; integer = pixel centre.
    pub px: [f32; 2],
}

/// Points seen at one instant, `cameras[camera]`, ascending id.
#[derive(Clone, Debug, Default)]
pub struct Tracks {
    pub t: Nanos,
    pub cameras: [List<Track, TRACKS>; CAMERAS_MAX],
}
