//! `[stereo.network]`: what a network of the user's wants to be given, and what it answers.

use serde::{Deserialize, Serialize};

/// How images of another size than the network's are brought to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Fit {
    /// Repeats the last column and row to the right and below; the network must be as large as the images.
    Pad,
    /// Interpolates; disparities are scaled back.
    Scale,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct NetworkConfig {
    /// ONNX file. Its inputs and output are tensors of 32-bit floats, 1 x channels x height x width, and as many
    /// values as pixels.
    pub model: String,
    /// ONNX Runtime's shared library; empty: libonnxruntime.so where the loader finds it.
    pub runtime: String,
    /// Names of the inputs and of the output.
    pub left: String,
    pub right: String,
    pub disparity: String,
    /// Size of the inputs, px; 0: that of the images. Most networks want multiples of 32.
    pub width: u32,
    pub height: u32,
    pub fit: Fit,
    /// 1: grey; 3: grey three times.
    pub channels: u32,
    /// A channel is (grey * scale - mean) / deviation, grey 0 to 255.
    pub scale: f64,
    pub mean: [f64; 3],
    pub deviation: [f64; 3],
    /// The output is minus the disparity, as optical flow has it.
    pub negated: bool,
    /// Threads of a run; 0: as many as the runtime likes.
    pub threads: u32,
}

impl Default for NetworkConfig {
    fn default() -> Self {
        NetworkConfig {
            model: String::new(),
            runtime: String::new(),
            left: "left".into(),
            right: "right".into(),
            disparity: "disparity".into(),
            width: 0,
            height: 0,
            fit: Fit::Pad,
            channels: 3,
            scale: 1.0 / 255.0,
            // ImageNet's, which most networks were trained with.
            mean: [0.485, 0.456, 0.406],
            deviation: [0.229, 0.224, 0.225],
            negated: false,
            threads: 0,
        }
    }
}

impl NetworkConfig {
    /// What is wrong with what is no single number.
    pub(super) fn normalises(&self) -> bool {
        self.mean.iter().all(|m| m.is_finite()) && self.deviation.iter().all(|d| d.is_finite() && *d > 0.0)
    }
}
