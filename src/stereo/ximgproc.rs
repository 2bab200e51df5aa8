//! OpenCV's semi-global matching with its own weighted-least-squares filter (`cv::ximgproc`): what ours is
//! measured against in `stipple-bench stereo`, and no method of the program. Feature `ximgproc`.
#![allow(unsafe_code)]

use super::Disparity;
use std::ffi::c_int;
use stipple_drivers::{Exit, Fault, Image};

extern "C" {
    fn stipple_sgbm_wls(
        width: c_int,
        height: c_int,
        disparities: c_int,
        left: *const u8,
        right: *const u8,
        disparity: *mut f32,
    ) -> c_int;
}

/// Says nothing of its deviation. Allocates.
pub fn sgbm_wls(disparities: u32, left: &Image, right: &Image, out: &mut Disparity) -> Result<(), Fault> {
    let px = out.width * out.height;
    assert!(left.pixels.len() == px && right.pixels.len() == px && out.px.len() == px, "one shape");
    // SAFETY: the three buffers hold width * height items (asserted) and outlive the call.
    let rc = unsafe {
        stipple_sgbm_wls(
            out.width as c_int,
            out.height as c_int,
            disparities as c_int,
            left.pixels.as_ptr(),
            right.pixels.as_ptr(),
            out.px.as_mut_ptr(),
        )
    };
    match rc {
        0 => Ok(()),
        _ => Err(Fault::new(Exit::Software, "stereo", "OpenCV's filter failed", "report this with the images")),
    }
}
