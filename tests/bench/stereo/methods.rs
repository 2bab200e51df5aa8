//! The methods of disparity that a board can name, each run on pairs of one size.

use std::time::Instant;
use stipple::config::{Board, GpuConfig, StereoConfig, StereoMethod};
use stipple::gpu::{Arena, Gpu};
use stipple::mem::Footprint;
use stipple::stereo::{sgm, Disparity, Matcher};
use stipple_drivers::{Fault, Image};

pub const NAMES: [&str; 5] = ["bm", "sgbm", "sgm", "sgm_wls", "onnx"];

/// A method for pairs of one size.
pub struct Runner {
    matcher: Matcher,
    gpu: Option<Gpu>,
    pub bytes: u64,
    pub device: String,
}

/// The board's `[stereo]` and `[gpu]`, whose method and range of disparities are replaced.
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
            "bm" => (StereoMethod::Bm, false),
            "sgbm" => (StereoMethod::Sgbm, false),
            "sgm" => (StereoMethod::Sgm, false),
            "sgm_wls" => (StereoMethod::Sgm, true),
            _ => (StereoMethod::Onnx, false),
        };
        let config = StereoConfig { method, wls, disparities, ..base.stereo.clone() };
        let mut footprint = Footprint::default();
        Matcher::footprint(width, height, &config, &mut footprint)?;
        let mut gpu = None;
        if method == StereoMethod::Sgm {
            let shape = sgm::Shape::of(width, height, &config);
            let mut arena = Arena::counting();
            sgm::Buffers::new(&mut arena, &shape)?;
            footprint.extend(arena.footprint());
            let mut device = Gpu::open(&base.gpu, arena.used())?;
            let buffers = sgm::Buffers::new(device.arena(), &shape)?;
            gpu = Some((device, buffers));
        }
        let matcher = Matcher::new(width, height, &config, gpu.as_mut().map(|(gpu, buffers)| (gpu, *buffers)))?;
        let gpu = gpu.map(|(gpu, _)| gpu);
        let device = gpu.as_ref().map_or_else(cpu, |g| g.caps().name.clone());
        Ok(Runner { matcher, gpu, bytes: footprint.total(), device })
    }

    /// Wall time, ms.
    pub fn run(&mut self, left: &Image, right: &Image, out: &mut Disparity) -> Result<f64, Fault> {
        let start = Instant::now();
        self.matcher.compute(self.gpu.as_mut(), left, right, out)?;
        Ok(start.elapsed().as_secs_f64() * 1e3)
    }
}

/// The processor by its own name, and its threads.
fn cpu() -> String {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = text.lines().find_map(|l| l.strip_prefix("model name")).map(|l| l.trim_start_matches([' ', '\t', ':']));
    let threads = std::thread::available_parallelism().map_or(1, |n| n.get());
    format!("{}, {threads} threads", name.unwrap_or("CPU"))
}
