//! What is measured: the methods of the door, and OpenCV's own filter beside them.

use std::time::Instant;
use stipple::config::{Board, GpuConfig, StereoConfig, StereoMethod};
use stipple::gpu::Gpu;
use stipple::stereo::{Disparity, Method};
use stipple_drivers::{Fault, Image};

pub const NAMES: [&str; 6] = ["bm", "sgbm", "sgbm_wls", "sgm", "sgm_wls", "onnx"];

/// A method for pairs of one size.
pub struct Runner {
    how: How,
    gpu: Option<Gpu>,
    pub bytes: u64,
    pub device: String,
}

enum How {
    Door(Box<Method>),
    /// Of so many disparities.
    #[cfg(feature = "ximgproc")]
    SgbmWls(u32),
}

/// What the board says of stereo and the GPU, but for method and range.
pub struct Base {
    pub stereo: StereoConfig,
    pub gpu: GpuConfig,
}

impl Base {
    pub fn of(board: Option<&Board>) -> Base {
        board.map_or_else(
            || Base { stereo: StereoConfig::default(), gpu: GpuConfig::default() },
            |b| Base { stereo: b.stereo.clone(), gpu: b.gpu.clone() },
        )
    }
}

impl Runner {
    /// `name` of `NAMES`; a fault says why a method is not to be had here.
    pub fn new(name: &str, base: &Base, (width, height): (usize, usize), disparities: u32) -> Result<Runner, Fault> {
        let (method, wls) = match name {
            "sgbm_wls" => return sgbm_wls(disparities),
            "bm" => (StereoMethod::Bm, false),
            "sgbm" => (StereoMethod::Sgbm, false),
            "sgm" => (StereoMethod::Sgm, false),
            "sgm_wls" => (StereoMethod::Sgm, true),
            _ => (StereoMethod::Onnx, false),
        };
        let config = StereoConfig { method, wls, disparities, ..base.stereo.clone() };
        let footprint = Method::footprint(width, height, &config);
        let mut gpu = match footprint.gpu_total() {
            0 => None,
            bytes => Some(Gpu::open(&base.gpu, bytes)?),
        };
        let how = How::Door(Box::new(Method::new(width, height, &config, gpu.as_mut())?));
        let device = gpu.as_ref().map_or_else(cpu, |g| g.caps().name.clone());
        Ok(Runner { how, gpu, bytes: footprint.total(), device })
    }

    /// Wall time, ms.
    pub fn run(&mut self, left: &Image, right: &Image, out: &mut Disparity) -> Result<f64, Fault> {
        let start = Instant::now();
        match &mut self.how {
            How::Door(method) => method.compute(self.gpu.as_mut(), left, right, out)?,
            #[cfg(feature = "ximgproc")]
            How::SgbmWls(disparities) => {
                stipple::stereo::ximgproc::sgbm_wls(*disparities, left, right, out)?;
                out.sigma_px.fill(f32::INFINITY);
            }
        }
        Ok(start.elapsed().as_secs_f64() * 1e3)
    }

    /// Names of the parts of its variance, none of a method that states none.
    pub fn parts(&self) -> &'static [&'static str] {
        match &self.how {
            How::Door(method) => method.parts(),
            #[cfg(feature = "ximgproc")]
            How::SgbmWls(_) => &[],
        }
    }

    /// The deviations of what was run last by one part of the variance alone.
    pub fn restate(&mut self, left: &Image, only: usize, out: &mut Disparity) -> Result<(), Fault> {
        match &mut self.how {
            How::Door(method) => method.restate(self.gpu.as_mut(), left, only, out),
            #[cfg(feature = "ximgproc")]
            How::SgbmWls(_) => Ok(()),
        }
    }

    /// Whether it says how far its disparities may be off.
    pub fn has_deviation(&self) -> bool {
        matches!(self.how, How::Door(_))
    }
}

#[cfg(feature = "ximgproc")]
fn sgbm_wls(disparities: u32) -> Result<Runner, Fault> {
    Ok(Runner { how: How::SgbmWls(disparities), gpu: None, bytes: 0, device: cpu() })
}

#[cfg(not(feature = "ximgproc"))]
fn sgbm_wls(_disparities: u32) -> Result<Runner, Fault> {
    let what = "OpenCV's filter is there for comparison only, and this program was built without it";
    Err(Fault::new(
        stipple_drivers::Exit::Config,
        "sgbm_wls",
        what,
        "build with --features ximgproc (needs libopencv-contrib-dev)",
    ))
}

/// The processor by its own name, and its threads.
fn cpu() -> String {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = text.lines().find_map(|l| l.strip_prefix("model name")).map(|l| l.trim_start_matches([' ', '\t', ':']));
    let threads = std::thread::available_parallelism().map_or(1, |n| n.get());
    format!("{}, {threads} threads", name.unwrap_or("CPU"))
}
