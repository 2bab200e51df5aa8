//! Cameras through V4L2: a node for each, or one node with their pictures side by side.
//!
//! A thin layer of our own over the ioctls (`kernel`, `uapi`): buffers are the kernel's, mapped once; frames are paired
//! while they still lie there (`stamps::pair`), and a pair is written into the caller's images by the one copy there is,
//! which also makes 8-bit grey of them (`pixels`), and colours where they are asked for (`colour`). All decisions are functions of numbers, and all system calls go through
//! one trait, so tests meet each error of each call without a camera.
//!
//! Stamps are the driver's, brought to the middle of the exposure of the first row (`stamps::Timing`), which is followed from
//! frame to frame (`exposure`), and then to the calibration's clock and middle row, as those of recordings are. A frame is
//! `Got` when every camera has one whose exposure starts or ends within the tolerance, however much exposures differ; its
//! stamp is the first camera's; an image without a partner is counted and its buffer given back at once. A camera that is
//! unplugged or silent is closed, and from the next call on looked for by its name and opened again, with growing pauses.
//! Meanwhile the others go on without it: its image is black, and `away` says why. The rig is `Lost` when no camera is left.
//!
//! Nothing is allocated between opening and losing a camera, except by the JPEG decoder and to word a warning.

mod bayer;
mod colour;
mod controls;
mod exposure;
mod fault;
mod find;
mod kernel;
mod node;
mod offer;
mod pixels;
mod rig;
mod stamps;
mod stream;
#[cfg(test)]
mod tests;
mod uapi;

pub use find::Select;
pub use pixels::Format;
pub use rig::Rig;
pub use stamps::StampPoint;

use crate::types::Span;
use crate::{Fault, FaultKind, RigCamera};
use kernel::NODES_MAX;

/// The cameras of a rig as the board file describes them.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// One for each camera, in the order of the calibration; or one, with the pictures of all side by side.
    pub devices: Vec<Select>,
    /// `None`: the first of the formats, in the order of `Format`, that the camera has in its size; where cameras are read in
    /// colour, the first in colour.
    pub format: Option<Format>,
    /// Cameras that are read in colour, the first of the calibration.
    pub colours: usize,
    /// Columns of one camera's picture, pixels.
    pub width: usize,
    /// Rows of one camera's picture, pixels.
    pub height: usize,
    pub rate_hz: f64,
    /// Zero: as the camera has it, frame by frame.
    pub exposure: Span,
    /// Time of one line, where the camera counts its exposure in lines; zero: it counts in time.
    pub exposure_line: Span,
    /// Other controls, by the names of `v4l2-ctl --list-ctrls`: gain, black level, trigger.
    pub controls: Vec<(String, i64)>,
    /// Event that the driver stamps.
    pub stamp: StampPoint,
    /// From the end of the first row's exposure until the last row was received.
    pub transfer: Span,
    /// Largest difference of the starts of exposure of the images of one frame, or of their ends.
    pub pair_tolerance: Span,
}

crate::counters! {
    /// Faults and losses of cameras since they were opened first.
    #[derive(Clone, Copy, PartialEq, Eq)]
    pub struct CameraCounters of u64, read by u64::clone;
    /// Frames given: one image of every camera.
    camera_frames,
    /// Calls that waited in vain.
    camera_timeouts,
    /// Bytes written from the kernel's buffers into images: of grey pictures once each pixel, four times in colour.
    camera_bytes_copied,
    /// Images missing before one that came, by its number and by its stamp.
    camera_missed_by_sequence,
    camera_missed_by_stamp,
    /// Black images in the place of a lost camera's.
    camera_images_absent,
    /// Images without a partner within the tolerance.
    camera_images_unpaired,
    /// Images that the driver marked as damaged.
    camera_images_corrupt,
    /// Images of fewer bytes than their size takes.
    camera_images_short,
    /// Compressed images that could not be decoded.
    camera_images_undecodable,
    /// Images that the driver reported as lost (EIO).
    camera_io_errors,
    /// Images stamped on arrival, because their driver does not say in which clock it stamps, or copied the stamp from
    /// elsewhere.
    camera_stamps_unknown,
    camera_stamps_copied,
    /// Images whose exposure is not that of the image before, and cameras whose exposure could not be followed any more.
    camera_exposure_changes,
    camera_exposures_lost,
    /// Images dropped for a stamp in the future, or from long ago.
    camera_stamps_implausible,
    /// Images and frames dropped for a stamp that is not newer than the last one's.
    camera_stamps_not_newer,
    /// Times that a camera was unplugged, refused to go on, or fell silent.
    camera_losses,
    /// Losses because it fell silent.
    camera_silences,
    /// Times that a lost camera gave an image again.
    camera_returns,
}

/// Refuses settings that do not fit the cameras of a calibration.
fn check(settings: &Settings, cameras: &[RigCamera]) -> Result<(), Fault> {
    let wrong = |what: String, fix: &str| Err(Fault::new(FaultKind::Config, "[camera]", what, fix));
    let (devices, count) = (settings.devices.len(), cameras.len());
    if devices == 0 || count == 0 || count > NODES_MAX || (devices != count && devices != 1) {
        let what = format!("camera.devices names {devices}, the calibration has {count} cameras (at most {NODES_MAX})");
        return wrong(what, "name one device for each camera, or one that gives all side by side");
    }
    if let Some((_, twice)) = settings.devices.iter().enumerate().find(|(i, d)| settings.devices[..*i].contains(d)) {
        return wrong(format!("camera.devices names {twice} twice"), "name each camera once");
    }
    let (width, height) = (settings.width, settings.height);
    if let Some(c) = cameras.iter().map(|c| &c.camera).find(|c| (c.width, c.height) != (width, height)) {
        let (w, h) = (c.width, c.height);
        let what = format!("the calibration is of {w}x{h}, the cameras are asked for {width}x{height}");
        return wrong(what, "calibrate at the size that is used");
    }
    if let Some(grey) = settings.format.filter(|f| settings.colours > 0 && !f.has_colour()) {
        let what = format!("map.colour = true, but camera.format = \"{}\" is grey", grey.name());
        return wrong(what, node::NO_COLOUR);
    }
    let rate = settings.rate_hz;
    if !(rate > 0.0 && rate.is_finite()) {
        return wrong(format!("camera.rate_hz = {rate} is no rate"), "state the cameras' rate");
    }
    if devices > 1 && settings.pair_tolerance.secs() * rate >= 0.5 {
        let what = format!("camera.pair_tolerance_s is half a period at {rate} Hz or more: any two images would pair");
        return wrong(what, "lower it");
    }
    Ok(())
}
