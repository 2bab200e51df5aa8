//! The one door to stereo matching: a rectified pair in, disparity and its standard deviation out, by
//! the method that the board file names.
//!
//! | method | where | what it says of its confidence |
//! |---|---|---|
//! | `bm`, `sgbm` | CPU, OpenCV | `confidence`, from the picture's detail and the neighbours' agreement |
//! | `sgm` | GPU | its own |
//! | `onnx` | CPU, a network of the user's | as the first |

use super::confidence::Confidence;
use super::onnx::{self, Network};
use super::opencv::{self, OpenCv};
use super::rectify_gpu::{packed, rows, Rectifier};
use super::sgm::wls::Wls;
use super::sgm::{self, Sgm};
use super::Disparity;
use crate::config::{StereoConfig, StereoMethod};
use crate::gpu::Gpu;
use crate::mem::Footprint;
use stipple_drivers::{Fault, FaultKind, Image};

pub enum Matcher {
    OpenCv(OpenCv, Confidence),
    Onnx(Box<Network>, Confidence),
    Sgm(Box<Sgm>),
}

impl Matcher {
    /// Puts `sgm` in the place of a method of OpenCV's that cannot be loaded on this machine; answers why.
    pub fn replace_missing(config: &mut StereoConfig) -> Option<Fault> {
        let mut missing = opencv::missing(config.method)?;
        missing.what += "; `sgm` matches in its place";
        config.method = StereoMethod::Sgm;
        Some(missing)
    }

    /// Host rows of what `new` takes for images of this size.
    pub fn footprint(width: usize, height: usize, config: &StereoConfig, f: &mut Footprint) -> Result<(), Fault> {
        match config.method {
            StereoMethod::Bm | StereoMethod::Sgbm => {
                f.build("stereo: disparity of OpenCV", || OpenCv::new(width, height, config))?;
                f.host("stereo: OpenCV's own buffers (estimate)", opencv::working_bytes(width, height, config));
                f.build("stereo: sums of the confidence", || Confidence::new(width, config));
            }
            StereoMethod::Onnx => {
                f.build("stereo: network tensors, for images of this size", || onnx::tensors([width, height]));
                f.build("stereo: sums of the confidence", || Confidence::new(width, config));
            }
            StereoMethod::Sgm => {
                f.build("stereo: pair on its way to the GPU", || {
                    ([(); 2].map(|()| packed(width, height)), rows(width))
                });
            }
        }
        Ok(())
    }

    /// Whether this program has the method, for images of this size, and its files are there.
    pub fn check_supported(width: usize, height: usize, config: &StereoConfig) -> Result<(), Fault> {
        match config.method {
            StereoMethod::Bm | StereoMethod::Sgbm if !cfg!(feature = "opencv") => {
                Err(opencv::refused_without_opencv(config.method))
            }
            StereoMethod::Onnx => Network::check_files(width, height, &config.network),
            _ => Ok(()),
        }
    }

    /// `gpu` is for the method that runs there, with its buffers.
    pub fn new(
        width: usize,
        height: usize,
        config: &StereoConfig,
        gpu: Option<(&mut Gpu, sgm::Buffers)>,
    ) -> Result<Matcher, Fault> {
        match config.method {
            StereoMethod::Bm | StereoMethod::Sgbm => {
                Ok(Matcher::OpenCv(OpenCv::new(width, height, config)?, Confidence::new(width, config)))
            }
            StereoMethod::Onnx => {
                let network = Network::new(width, height, &config.network)?;
                Ok(Matcher::Onnx(Box::new(network), Confidence::new(width, config)))
            }
            StereoMethod::Sgm => {
                let (gpu, buffers) = gpu.ok_or_else(|| without_gpu(config.method))?;
                Ok(Matcher::Sgm(Box::new(Sgm::new(gpu, buffers, sgm::Shape::of(width, height, config))?)))
            }
        }
    }

    /// What may be further off than this is filled in, not seen: no depth, px.
    pub fn sigma_max_px(&self) -> f32 {
        match self {
            Matcher::Sgm(_) => Wls::SIGMA_MAX_PX,
            Matcher::OpenCv(..) | Matcher::Onnx(..) => f32::INFINITY,
        }
    }

    /// All three of the shape given to `new`, and `gpu` the one. Nothing is known when an eye sees nothing.
    pub fn compute(
        &mut self,
        gpu: Option<&mut Gpu>,
        left: &Image,
        right: &Image,
        out: &mut Disparity,
    ) -> Result<(), Fault> {
        if is_blind(left) || is_blind(right) {
            out.forget();
            return Ok(());
        }
        match self {
            Matcher::OpenCv(matcher, confidence) => {
                matcher.compute(left, right, &mut out.px)?;
                confidence.estimate(left, out);
                Ok(())
            }
            Matcher::Onnx(network, confidence) => {
                network.compute(left, right, out)?;
                confidence.estimate(left, out);
                Ok(())
            }
            Matcher::Sgm(sgm) => {
                let gpu = gpu.ok_or_else(|| without_gpu(StereoMethod::Sgm))?;
                Ok(sgm.compute(gpu, left, right, out)?)
            }
        }
    }
}

/// Does what `Matcher::compute` does with a raw pair, by the method that rectifies too.
pub fn compute_raw(
    sgm: &mut Sgm,
    rectifier: &mut Rectifier,
    gpu: &mut Gpu,
    [left, right]: [&Image; 2],
    out: &mut Disparity,
) -> Result<(), Fault> {
    if is_blind(left) || is_blind(right) {
        out.forget();
        return Ok(());
    }
    Ok(sgm.compute_raw(gpu, rectifier, [left, right], out)?)
}

/// Whether an image holds nothing to match: a covered or dead camera still shows noise of a level or two, and
/// methods that fill in what they do not see would answer a surface for it.
fn is_blind(image: &Image) -> bool {
    /// Standard deviation of the grey levels.
    const NOTHING: f64 = 3.0;
    let seen = || image.pixels.iter().filter(|p| **p != 0).map(|p| f64::from(*p));
    let n = seen().count().max(1) as f64;
    let mean = seen().sum::<f64>() / n;
    seen().map(|p| (p - mean).powi(2)).sum::<f64>() / n < NOTHING * NOTHING
}

fn without_gpu(method: StereoMethod) -> Fault {
    let what = format!("`{}` runs on the GPU and none is open here", method.name());
    Fault::new(FaultKind::Config, "stereo.method", what, "use `bm` or `sgbm`")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_program_without_opencv_says_so_and_what_to_use() {
        let said = opencv::refused_without_opencv(StereoMethod::Sgbm).to_string();
        assert!(said.contains("`sgbm`") && said.contains("feature `opencv`") && said.contains("\"sgm\""), "{said}");
        let named =
            |method| Matcher::check_supported(8, 8, &StereoConfig { method, ..StereoConfig::default() }).is_ok();
        assert_eq!((named(StereoMethod::Bm), named(StereoMethod::Sgm)), (cfg!(feature = "opencv"), true));
    }
}
