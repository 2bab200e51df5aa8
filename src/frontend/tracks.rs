//! Tracked points: what the tracker hands to the estimator.

use crate::limits::{CAMERAS_MAX, TRACKS};
use crate::mem::List;
use glam::DVec2;
use stipple_drivers::Nanos;

/// A point tracked in one camera. The same `id` in two cameras is the same point in space.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Track {
    pub id: u64,
    /// Pixel in the raw (distorted) image; integer = pixel centre.
    pub px: [f32; 2],
}

impl Track {
    /// The pixel in double precision.
    pub fn px(&self) -> DVec2 {
        DVec2::new(self.px[0] as f64, self.px[1] as f64)
    }
}

/// Ids of points that the estimator rejected in one frame; those beyond are left out.
pub type Rejected = List<u64, TRACKS>;

/// Points seen at one instant, `cameras[camera]`, ascending id.
#[derive(Clone, Debug, Default)]
pub struct Tracks {
    pub t: Nanos,
    pub cameras: [List<Track, TRACKS>; CAMERAS_MAX],
}

impl Tracks {
    /// The point with this id in one camera.
    pub fn find(&self, camera: usize, id: u64) -> Option<&Track> {
        let list = &self.cameras[camera];
        list.binary_search_by_key(&id, |t| t.id).ok().map(|i| &list[i])
    }
}
