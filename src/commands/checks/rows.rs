//! Rows of cameras 0 and 1 after rectification: stereo matches along them.

use super::Check;
use crate::stereo::alignment::Alignment;
use crate::stereo::rectify::{Rectification, Remap};
use stipple_drivers::{Calibration, Fault, Frames, Image};

/// Half of what costs `bm` a third more error and 2 % of its pixels (hard_misaligned in `stipple-bench stereo`).
const ROWS_MAX_PX: f64 = 0.5;

/// Matches of the left image in the right one, and the other way round: of swapped cameras only the other way has any.
pub struct Rows {
    disparities: usize,
    rectified: Result<([Remap; 2], [usize; 2]), Fault>,
    straight: Alignment,
    swapped: Alignment,
}

impl Rows {
    pub fn new(calibration: &Calibration, disparities: u32) -> Rows {
        let rectified = Rectification::new(calibration).map(|r| {
            let p = r.camera.pinhole;
            ([0, 1].map(|i| r.map(&calibration.cameras[i])), [p.width, p.height])
        });
        let disparities = disparities as usize;
        Rows { disparities, rectified, straight: Alignment::default(), swapped: Alignment::default() }
    }

    /// Matches corners of one more stereo pair.
    pub fn add(&mut self, frames: &Frames) {
        let Ok((maps, [width, height])) = &self.rectified else { return };
        let view = |i: usize, image: usize| {
            let mut out = Image::new(*width, *height);
            maps[i].apply(&frames.images[image], &mut out);
            out
        };
        self.straight.add(&view(0, 0), &view(1, 1), self.disparities);
        self.swapped.add(&view(0, 1), &view(1, 0), self.disparities);
    }

    /// The line named `name`, with a remark; cameras that look apart fail where a map is needed.
    pub fn check(&self, name: &str, remark: &str, map_needed: bool) -> Check {
        if let Err(fault) = &self.rectified {
            let what = format!("{name}: the calibration {}", fault.what);
            return match map_needed {
                true => Check::fail(what, fault.fix.clone()),
                false => Check::warn(what, "right for cameras that look apart; odometry needs no more, a map does"),
            };
        }
        let (n, m) = (self.straight.rows.len(), self.swapped.rows.len());
        if m > 2 * n && m > 20 {
            let what = format!("{name}: {n} corners match as calibrated, {m} with the cameras swapped{remark}");
            let fix = "cameras 0 and 1 are swapped: exchange them in camera.devices or in the calibration";
            return Check::fail(what, fix);
        }
        let Some((rows, spread)) = self.straight.summary() else {
            let what = format!("{name}: only {n} corners match, too few to say{remark}");
            return Check::warn(what, "look at something with detail, a metre away or more");
        };
        let what = format!(
            "{name}: camera 1 sees points {rows:+.2} px lower after rectification (median of {n} corners, deviation \
             {:.2} px{remark})",
            1.4826 * spread
        );
        match rows.abs() > ROWS_MAX_PX {
            true => Check::warn(what, "stereo matches rows: calibrate the extrinsics and principal points anew"),
            false => Check::ok(what),
        }
    }
}
