//! Block matching (`cv::StereoBM`, Konolige) and semi-global block matching (`cv::StereoSGBM`,
//! Hirschmüller) by Debian's OpenCV behind a C++ shim of four functions: no OpenCV type crosses it,
//! exceptions end in it. Built with the feature `opencv`; without it both are refused at boot.
//!
//! The shim is a shared object that the program carries and loads when a board asks for a method of OpenCV's. It needs the
//! version of OpenCV that it was built with; where that is missing, `missing` says so and the rest runs.
#![allow(unsafe_code)]

use crate::config::{StereoConfig, StereoMethod};
#[cfg(feature = "opencv")]
use libloading::os::unix::{Library, RTLD_LOCAL, RTLD_NOW};
#[cfg(feature = "opencv")]
use std::{
    ffi::{c_int, c_void},
    io::Write,
    os::fd::{AsRawFd, FromRawFd},
    sync::OnceLock,
};
use stipple_drivers::{Fault, FaultKind, Image};

/// OpenCV's disparities are in 1/16 px.
#[cfg(feature = "opencv")]
const SUBPIXEL: f32 = 16.0;

pub struct OpenCv {
    #[cfg(feature = "opencv")]
    shim: &'static Shim,
    #[cfg(feature = "opencv")]
    handle: std::ptr::NonNull<std::ffi::c_void>,
    width: usize,
    height: usize,
    /// 1/16 px, negative where unknown.
    fixed: Vec<i16>,
}

/// Bytes that OpenCV allocates behind us, by reading it. BM: two prefiltered images with borders, sums over the disparity
/// range for each of its row strips, the cost image of the left-right check. SGBM: rows of costs and of path costs.
pub fn working_bytes(width: usize, height: usize, config: &StereoConfig) -> usize {
    let (disparities, block) = (config.disparities as usize, config.block_px as usize);
    let padded = (width + disparities) * height;
    if config.method == StereoMethod::Sgbm {
        // 16-bit costs: sums of a window's rows, their total, four path costs of this row and the last.
        let rows = config.sgbm_block_px as usize + 2 + 1 + 2 * 4 + 1;
        10 * padded + 2 * rows * width * disparities
    } else {
        8 * padded + 4 * (disparities + 2) * 4 * (height + block + 2)
    }
}

/// Why `bm` and `sgbm` are refused by a program without OpenCV.
pub fn refused_without_opencv(method: StereoMethod) -> Fault {
    let what = format!("`{}` is OpenCV's and this program was built without the cargo feature `opencv`", method.name());
    let fix = "set stereo.method = \"sgm\", or build with the feature (on by default; needs libopencv-calib3d-dev)";
    Fault::new(FaultKind::Config, "stereo.method", what, fix)
}

/// Why OpenCV's `method` cannot run on this machine; nothing where it can, or is not OpenCV's.
pub fn missing(method: StereoMethod) -> Option<Fault> {
    match method {
        #[cfg(feature = "opencv")]
        StereoMethod::Bm | StereoMethod::Sgbm => shim().err().map(|why| not_loaded(method, why)),
        _ => None,
    }
}

#[cfg(feature = "opencv")]
fn not_loaded(method: StereoMethod, why: &str) -> Fault {
    let what = format!("`{}` is OpenCV's, which cannot be loaded: {why}", method.name());
    let fix = "apt install the libopencv-calib3d that this program was built with, or set stereo.method = \"sgm\"";
    Fault::new(FaultKind::Unavailable, "stereo.method", what, fix)
}

/// The functions of opencv.cpp.
#[cfg(feature = "opencv")]
struct Shim {
    bm_new: unsafe extern "C" fn(c_int, c_int, c_int, c_int, c_int) -> *mut c_void,
    sgbm_new: unsafe extern "C" fn(c_int, c_int, c_int, c_int, c_int, c_int, c_int) -> *mut c_void,
    matcher_free: unsafe extern "C" fn(*mut c_void),
    matcher_compute: unsafe extern "C" fn(*mut c_void, *const u8, *const u8, *mut i16) -> c_int,
    _library: Library,
}

/// The shim, loaded when it is first asked for, or why it cannot be.
#[cfg(feature = "opencv")]
fn shim() -> Result<&'static Shim, &'static str> {
    static LOADED: OnceLock<Result<Shim, String>> = OnceLock::new();
    LOADED.get_or_init(|| load().map_err(|e| e.to_string())).as_ref().map_err(String::as_str)
}

#[cfg(feature = "opencv")]
fn load() -> Result<Shim, Box<dyn std::error::Error>> {
    const BYTES: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/stipple_opencv.so"));
    // SAFETY: a C string; the answer is checked, and nobody else has the descriptor.
    let file = unsafe {
        match libc::memfd_create(c"stipple_opencv.so".as_ptr(), libc::MFD_CLOEXEC) {
            ..0 => Err(std::io::Error::last_os_error()),
            fd => Ok(std::fs::File::from_raw_fd(fd)),
        }
    };
    let file = file.and_then(|mut file| file.write_all(BYTES).map(|()| file))?;
    let path = format!("/proc/self/fd/{}", file.as_raw_fd());
    // SAFETY: our own library and OpenCV's, which a program may load at any time. It stays loaded with its table; the
    // functions have the types of opencv.cpp, which is built with this file.
    unsafe {
        let library = Library::open(Some(path), RTLD_NOW | RTLD_LOCAL)?;
        Ok(Shim {
            bm_new: *library.get(b"stipple_bm_new\0")?,
            sgbm_new: *library.get(b"stipple_sgbm_new\0")?,
            matcher_free: *library.get(b"stipple_matcher_free\0")?,
            matcher_compute: *library.get(b"stipple_matcher_compute\0")?,
            _library: library,
        })
    }
}

#[cfg(feature = "opencv")]
impl OpenCv {
    /// `config.method` says which of the two.
    pub fn new(width: usize, height: usize, config: &StereoConfig) -> Result<OpenCv, Fault> {
        let shim = shim().map_err(|why| not_loaded(config.method, why))?;
        let int = |v: u32| v as c_int;
        let (w, h) = (width as c_int, height as c_int);
        let (disparities, uniqueness) = (int(config.disparities), int(config.uniqueness_percent));
        // SAFETY: plain integers in; the answer is null or a handle owned by `self` until `drop`.
        let handle = unsafe {
            if config.method == StereoMethod::Sgbm {
                // What changes by one disparity and by more costs, as OpenCV's samples choose it.
                let block = int(config.sgbm_block_px);
                let area = block * block;
                (shim.sgbm_new)(w, h, disparities, block, uniqueness, 8 * area, 32 * area)
            } else {
                (shim.bm_new)(w, h, disparities, int(config.block_px), uniqueness)
            }
        };
        let handle = std::ptr::NonNull::new(handle).ok_or_else(|| {
            let what = "OpenCV refuses these matching settings";
            Fault::new(FaultKind::Config, "stereo", what, "see stereo.* in the board file")
        })?;
        Ok(OpenCv { shim, handle, width, height, fixed: vec![0; width * height] })
    }

    /// Disparity of the left image, px, negative where unknown.
    pub fn compute(&mut self, left: &Image, right: &Image, disparity_px: &mut [f32]) -> Result<(), Fault> {
        let px = self.width * self.height;
        assert!(
            left.pixels.len() == px && right.pixels.len() == px && disparity_px.len() == px,
            "buffers of this matcher's shape"
        );
        // SAFETY: the three buffers hold width * height items (asserted, and by construction) and outlive the call.
        let rc = unsafe {
            (self.shim.matcher_compute)(
                self.handle.as_ptr(),
                left.pixels.as_ptr(),
                right.pixels.as_ptr(),
                self.fixed.as_mut_ptr(),
            )
        };
        if rc != 0 {
            let what = "OpenCV's matching failed";
            return Err(Fault::new(FaultKind::Internal, "stereo", what, "report this with the images"));
        }
        for (to, from) in disparity_px.iter_mut().zip(&self.fixed) {
            *to = if *from > 0 { f32::from(*from) / SUBPIXEL } else { -1.0 };
        }
        Ok(())
    }
}

#[cfg(feature = "opencv")]
impl Drop for OpenCv {
    fn drop(&mut self) {
        // SAFETY: `handle` came from one of the two `new` and is freed once.
        unsafe { (self.shim.matcher_free)(self.handle.as_ptr()) }
    }
}

// SAFETY: the handle is used by one thread at a time (`&mut self`); cv::StereoMatcher has no thread affinity.
#[cfg(feature = "opencv")]
unsafe impl Send for OpenCv {}

#[cfg(not(feature = "opencv"))]
impl OpenCv {
    pub fn new(_width: usize, _height: usize, config: &StereoConfig) -> Result<OpenCv, Fault> {
        Err(refused_without_opencv(config.method))
    }

    pub fn compute(&mut self, _left: &Image, _right: &Image, disparity_px: &mut [f32]) -> Result<(), Fault> {
        assert!(self.fixed.len() == self.width * self.height, "none is ever made");
        disparity_px.fill(-1.0);
        Ok(())
    }
}

#[cfg(test)]
#[cfg(feature = "opencv")]
pub mod tests {
    use super::shim;
    use std::ffi::c_int;

    type RectificationMap = unsafe extern "C" fn(
        c_int,
        *const f64,
        *const f64,
        *const f64,
        *const f64,
        c_int,
        c_int,
        *mut f32,
        *mut f32,
    ) -> c_int;

    /// Raw pixels of every rectified one, as OpenCV has them: of Brown's lens or of Kannala's and Brandt's. `k` and
    /// `rectified` are fx fy cx cy, `turn` is rect_from_cam row by row.
    pub fn rectification_map(
        fisheye: bool,
        k: [f64; 4],
        distortion: [f64; 4],
        turn: [f64; 9],
        rectified: [f64; 4],
        [width, height]: [usize; 2],
    ) -> Vec<[f32; 2]> {
        let (mut x, mut y) = (vec![0f32; width * height], vec![0f32; width * height]);
        let library = &shim().expect("OpenCV is here")._library;
        // SAFETY: the type is that of opencv.cpp; arrays of the lengths that the function reads, buffers of width * height
        // that it writes, all alive.
        let rc = unsafe {
            let map = library.get::<RectificationMap>(b"stipple_rectification_map\0").expect("the shim has it");
            map(
                c_int::from(fisheye),
                k.as_ptr(),
                distortion.as_ptr(),
                turn.as_ptr(),
                rectified.as_ptr(),
                width as c_int,
                height as c_int,
                x.as_mut_ptr(),
                y.as_mut_ptr(),
            )
        };
        assert_eq!(rc, 0, "OpenCV makes a map");
        x.into_iter().zip(y).map(|(x, y)| [x, y]).collect()
    }
}
