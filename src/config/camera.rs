//! `[camera]`: the cameras of a live run, through V4L2. Without it a run reads none.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use stipple_drivers::v4l2::{Format, Select, Settings, StampPoint};
use stipple_drivers::{Calibration, Fault, FaultKind, Span};

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CameraConfig {
    /// One a camera in the calibration's order, or one that gives all pictures side by side: serial:NUMBER of the USB
    /// device, bus:INFO of `v4l2-ctl --list-devices`, or path:LINK of /dev/v4l/by-path. Numbers of nodes change.
    pub devices: Vec<String>,
    /// grey, y10, y12, y16, y10p, y12p, nv12, yuyv or mjpeg; left out: the first of these that the camera has.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub format: Option<Format>,
    /// Of one picture; 0: the calibration's. Another size than that is refused.
    pub width_px: u32,
    pub height_px: u32,
    pub rate_hz: f64,
    /// 0: as the camera has it. A fixed one is half of what makes stamps good.
    pub exposure_us: u32,
    /// Time of one line, where the camera counts its exposure in lines; 0: it counts in time.
    pub exposure_line_us: f64,
    /// Anything else, by the names of `v4l2-ctl --list-ctrls`: gain = 16, black_level = 64, trigger_mode = 1.
    pub controls: BTreeMap<String, i64>,
    /// When the driver stamps: driver (as its flags say), exposure-start, frame-start (CSI receivers, and uvcvideo
    /// although it says otherwise) or frame-end.
    pub stamp: StampPoint,
    /// From the end of the first row's exposure until the last row was received: what frame-end stamps are late by.
    pub transfer_s: f64,
    /// Largest stamp difference of the images of one frame. Cameras of one trigger differ by less than a row.
    pub pair_tolerance_s: f64,
}

impl Default for CameraConfig {
    fn default() -> Self {
        CameraConfig {
            devices: Vec::new(),
            format: None,
            width_px: 0,
            height_px: 0,
            rate_hz: 20.0,
            exposure_us: 0,
            exposure_line_us: 0.0,
            controls: BTreeMap::new(),
            stamp: StampPoint::Driver,
            transfer_s: 0.0,
            pair_tolerance_s: 0.002,
        }
    }
}

impl CameraConfig {
    /// The first key that is wrong for what it says, and why.
    pub(super) fn wrong(&self) -> Option<(&'static str, String)> {
        if let Some(why) = self.devices.iter().find_map(|d| Select::parse(d).err()) {
            return Some(("camera.devices", format!("camera.devices: {why}")));
        }
        if let Some(twice) = self.devices.iter().enumerate().find(|(i, d)| self.devices[..*i].contains(d)) {
            return Some(("camera.devices", format!("camera.devices names {} twice: name each camera once", twice.1)));
        }
        if self.devices.len() > 1 && self.pair_tolerance_s * self.rate_hz >= 0.5 {
            let why = "camera.pair_tolerance_s must be less than half a period of camera.rate_hz";
            return Some(("camera.pair_tolerance_s", format!("{why}: any two images would pair")));
        }
        None
    }

    /// For the cameras of a calibration.
    pub fn settings(&self, calibration: &Calibration) -> Result<Settings, Fault> {
        let fault = |what: String, fix: &str| Fault::new(FaultKind::Config, "camera.devices", what, fix);
        if self.devices.is_empty() {
            let fix = "write [camera] with devices = [\"serial:..\", ..] and rate_hz (`v4l2-ctl --list-devices`)";
            return Err(fault("the board file names no camera".to_string(), fix));
        }
        let devices = self.devices.iter().map(|d| Select::parse(d)).collect::<Result<_, _>>();
        let first = calibration.cameras.first().map_or((0, 0), |c| (c.camera.width, c.camera.height));
        let or = |px: u32, calibrated: usize| if px == 0 { calibrated } else { px as usize };
        Ok(Settings {
            devices: devices.map_err(|why| fault(why, ""))?,
            format: self.format,
            width: or(self.width_px, first.0),
            height: or(self.height_px, first.1),
            rate_hz: self.rate_hz,
            exposure: Span(i64::from(self.exposure_us) * 1000),
            exposure_line: Span((self.exposure_line_us * 1e3).round() as i64),
            controls: self.controls.iter().map(|(name, value)| (name.clone(), *value)).collect(),
            stamp: self.stamp,
            transfer: Span::from_secs(self.transfer_s),
            pair_tolerance: Span::from_secs(self.pair_tolerance_s),
        })
    }
}
