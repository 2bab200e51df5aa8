//! What crosses the border of the mapper: keyframes, and corrections of their poses.

use crate::limits::CAMERAS_MAX;
use stipple_drivers::{Colour, Image, Nanos, Pose};

/// Raw images of one instant and where the body was, mid-exposure.
#[derive(Clone, Debug, Default)]
pub struct Keyframe {
    pub id: u64,
    pub t: Nanos,
    /// Keyframes of different epochs are in different frames, and train different Gaussians.
    pub epoch: u32,
    pub world_from_body: Pose,
    /// Where each camera sits, as estimated along with that pose; `None`: as in the keyframe before, at first as calibrated.
    pub body_from_cam: Option<[Pose; CAMERAS_MAX]>,
    /// Images as the cameras gave them: left, right, and further ones that train.
    pub images: Vec<Image>,
    /// The colours of the images that train on them.
    pub colours: Vec<Colour>,
    /// Never trained on, only evaluated.
    pub held_out: bool,
}

impl Keyframe {
    /// One plane of what camera `i` saw.
    pub fn plane(&self, i: usize, channel: usize) -> &Image {
        self.colours.get(i).map_or(&self.images[i], |colour| &colour[channel])
    }
}

/// A better pose for a keyframe handed over earlier.
#[derive(Clone, Copy, Debug)]
pub struct PoseCorrection {
    pub id: u64,
    pub world_from_body: Pose,
    /// Where each camera sits, as of a keyframe; `None` changes nothing.
    pub body_from_cam: Option<[Pose; CAMERAS_MAX]>,
}
