//! Block matching by Debian's OpenCV (`cv::StereoBM`, Konolige's algorithm) behind a C++ shim of
//! three functions: no OpenCV type crosses it, exceptions end in it. Built with the feature
//! `opencv`; without it the method is refused at boot.
#![allow(unsafe_code)]

use crate::config::StereoConfig;
use stipple_drivers::{Exit, Fault, Image};

/// Disparities are in 1/16 px.
pub const SUBPIXEL: i16 = 16;

pub struct BlockMatcher {
    #[cfg(feature = "opencv")]
    handle: std::ptr::NonNull<std::ffi::c_void>,
    width: usize,
    height: usize,
}

impl BlockMatcher {
    /// OpenCV's own working buffers: two prefiltered images with borders, sums over the
    /// disparity range for each of its row strips, the cost image of the left-right check.
    pub fn bytes(width: usize, height: usize, config: &StereoConfig) -> usize {
        let strip = (config.disparities as usize + 2) * 4 * (height + config.block_px as usize + 2);
        let padded = (width + config.disparities as usize) * height;
        8 * padded + 4 * strip
    }
}

#[cfg(feature = "opencv")]
mod ffi {
    use std::ffi::{c_int, c_void};
    extern "C" {
        pub fn stipple_bm_new(
            width: c_int,
            height: c_int,
            disparities: c_int,
            block: c_int,
            uniqueness: c_int,
        ) -> *mut c_void;
        pub fn stipple_bm_free(handle: *mut c_void);
        pub fn stipple_bm_compute(handle: *mut c_void, left: *const u8, right: *const u8, disparity: *mut i16)
            -> c_int;
    }
}

#[cfg(feature = "opencv")]
impl BlockMatcher {
    pub fn new(width: usize, height: usize, config: &StereoConfig) -> Result<BlockMatcher, Fault> {
        let int = |v: usize| v as std::ffi::c_int;
        // SAFETY: plain integers in; the answer is null or a handle owned by `self` until `drop`.
        let handle = unsafe {
            ffi::stipple_bm_new(
                int(width),
                int(height),
                int(config.disparities as usize),
                int(config.block_px as usize),
                int(config.uniqueness_percent as usize),
            )
        };
        let handle = std::ptr::NonNull::new(handle).ok_or_else(|| {
            Fault::new(
                Exit::Config,
                "stereo",
                "OpenCV refuses these block matching settings",
                "see stereo.* in the board file",
            )
        })?;
        Ok(BlockMatcher { handle, width, height })
    }

    /// Disparity of the left image, 1/16 px, negative where unknown.
    pub fn compute(&mut self, left: &Image, right: &Image, disparity: &mut [i16]) -> Result<(), Fault> {
        let px = self.width * self.height;
        assert!(
            left.pixels.len() == px && right.pixels.len() == px && disparity.len() == px,
            "buffers of this matcher's shape"
        );
        // SAFETY: the three buffers hold width * height items (asserted) and outlive the call.
        let rc = unsafe {
            ffi::stipple_bm_compute(
                self.handle.as_ptr(),
                left.pixels.as_ptr(),
                right.pixels.as_ptr(),
                disparity.as_mut_ptr(),
            )
        };
        match rc {
            0 => Ok(()),
            _ => Err(Fault::new(
                Exit::Software,
                "stereo",
                "OpenCV's block matching failed",
                "report this with the images",
            )),
        }
    }
}

#[cfg(feature = "opencv")]
impl Drop for BlockMatcher {
    fn drop(&mut self) {
        // SAFETY: `handle` came from stipple_bm_new and is freed once.
        unsafe { ffi::stipple_bm_free(self.handle.as_ptr()) }
    }
}

// SAFETY: the handle is used by one thread at a time (`&mut self`); cv::StereoBM has no thread affinity.
#[cfg(feature = "opencv")]
unsafe impl Send for BlockMatcher {}

#[cfg(not(feature = "opencv"))]
impl BlockMatcher {
    pub fn new(_width: usize, _height: usize, _config: &StereoConfig) -> Result<BlockMatcher, Fault> {
        let fix = "build with the cargo feature `opencv` (on by default)";
        Err(Fault::new(Exit::Config, "stereo.method", "`bm` needs OpenCV and this program was built without it", fix))
    }

    pub fn compute(&mut self, _left: &Image, _right: &Image, _disparity: &mut [i16]) -> Result<(), Fault> {
        Err(Fault::new(Exit::Software, "stereo", format!("no matcher for {}x{}", self.width, self.height), ""))
    }
}
