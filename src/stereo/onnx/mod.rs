//! Disparity by a network of the user's: an ONNX file, run by ONNX Runtime, both named in the board file. No
//! weights ship, and the runtime is loaded only when a model is named.
//!
//! The board file describes the network (`config::NetworkConfig`): names, size, normalisation. What it answers is
//! unknown where it is not finite or points out of the right image, which a network fills in from what it learnt.

mod runtime;

use super::Disparity;
use crate::config::{Fit, NetworkConfig};
use runtime::{Refused, Session};
use stipple_drivers::{Fault, FaultKind, Image};

pub struct Network {
    config: NetworkConfig,
    session: Session,
    /// Width and height of the images, and of the network's inputs.
    size: [usize; 2],
    inner: [usize; 2],
    output: Vec<f32>,
}

/// Where ONNX Runtime comes from; Debian 12 has no package of it.
const INSTALL: &str =
    "install ONNX Runtime (`pip install onnxruntime`, or the archive onnxruntime-linux of its releases) and \
    name its libonnxruntime.so in stereo.network.runtime, or set stereo.method to another";

fn inner(width: usize, height: usize, config: &NetworkConfig) -> [usize; 2] {
    let or = |own: u32, image: usize| if own == 0 { image } else { own as usize };
    [or(config.width, width), or(config.height, height)]
}

/// Inputs and output, at the size of the images; what the runtime takes for weights and activations is not known before.
pub fn tensors([width, height]: [usize; 2]) -> [Vec<f32>; 3] {
    [3, 3, 1].map(|channels| vec![0.0; channels * width * height])
}

fn bad(key: &str, what: String, fix: &str) -> Fault {
    Fault::new(FaultKind::Config, format!("stereo.network.{key}"), what, fix)
}

impl Network {
    /// What can be said of a board without the runtime: a model is named and there, and its size holds the images.
    pub fn check_files(width: usize, height: usize, config: &NetworkConfig) -> Result<(), Fault> {
        if config.model.is_empty() {
            return Err(bad("model", "names no file, and stereo.method is `onnx`".into(), "name an ONNX file"));
        }
        if !std::path::Path::new(&config.model).is_file() {
            return Err(bad("model", format!("there is no file {}", config.model), "name an ONNX file"));
        }
        let [w, h] = inner(width, height, config);
        if config.fit == Fit::Pad && (w < width || h < height) {
            let what = format!("{w}x{h} is smaller than the images, {width}x{height}");
            return Err(bad("width", what, "set stereo.network.fit = \"scale\", or a larger size"));
        }
        Ok(())
    }

    /// Loads runtime and model, and runs it once, so that what is wrong with either is said at boot.
    pub fn new(width: usize, height: usize, config: &NetworkConfig) -> Result<Network, Fault> {
        Network::check_files(width, height, config)?;
        let [w, h] = inner(width, height, config);
        let names = [config.left.as_str(), &config.right, &config.disparity];
        let shape = [1, config.channels as usize, h, w];
        let session = Session::open(&config.runtime, &config.model, names, shape, config.threads);
        let session = session.map_err(|why| match why {
            Refused::Library(what) => bad("runtime", format!("cannot load ONNX Runtime: {what}"), INSTALL),
            Refused::Model(what) => {
                bad("model", format!("ONNX Runtime refuses {}: {what}", config.model), "see the file")
            }
        })?;
        let output = vec![0.0; w * h];
        let mut network = Network { config: config.clone(), session, size: [width, height], inner: [w, h], output };
        network.session.run(&mut network.output).map_err(|what| {
            let fix = "describe the network's inputs and output in [stereo.network]";
            bad("model", format!("{} does not run: {what}", config.model), fix)
        })?;
        Ok(network)
    }

    pub fn compute(&mut self, left: &Image, right: &Image, out: &mut Disparity) -> Result<(), Fault> {
        for (i, image) in [left, right].into_iter().enumerate() {
            normalise(image, self.inner, &self.config, self.session.input(i));
        }
        self.session
            .run(&mut self.output)
            .map_err(|what| Fault::new(FaultKind::Internal, "stereo.network", what, "report this with the model"))?;
        let ([w, h], [nw, nh]) = (self.size, self.inner);
        let sign = if self.config.negated { -1.0 } else { 1.0 };
        for y in 0..h {
            for x in 0..w {
                let d = match self.config.fit {
                    Fit::Pad => self.output[y * nw + x],
                    Fit::Scale => w as f32 / nw as f32 * scaled(|i| self.output[i], [nw, nh], [w, h], x, y),
                };
                let d = sign * d;
                // Neither zero, which is infinitely far, nor past the right image's edge.
                let inside = d > 0.0 && d <= x as f32 + 0.5;
                out.px[y * w + x] = if inside { d } else { -1.0 };
            }
        }
        Ok(())
    }
}

/// Fills a tensor of channels with an image brought to the network's size.
fn normalise(image: &Image, [nw, nh]: [usize; 2], config: &NetworkConfig, into: &mut [f32]) {
    let (w, h) = (image.width, image.height);
    let grey = |i: usize| f32::from(image.pixels[i]);
    for y in 0..nh {
        for x in 0..nw {
            let level = match config.fit {
                Fit::Pad => grey(y.min(h - 1) * w + x.min(w - 1)),
                Fit::Scale => scaled(grey, [w, h], [nw, nh], x, y),
            };
            for c in 0..config.channels as usize {
                let value = (f64::from(level) * config.scale - config.mean[c]) / config.deviation[c];
                into[(c * nh + y) * nw + x] = value as f32;
            }
        }
    }
}

/// Pixel (x, y) of a picture of `w` x `h` that is scaled to `to`, bilinearly.
fn scaled(values: impl Fn(usize) -> f32, [w, h]: [usize; 2], to: [usize; 2], x: usize, y: usize) -> f32 {
    let at = |k: usize, n: usize, to: usize| {
        let at = ((k as f32 + 0.5) * n as f32 / to as f32 - 0.5).clamp(0.0, (n - 1) as f32);
        let first = (at as usize).min(n - 2);
        (first, at - first as f32)
    };
    let ((i, s), (j, t)) = (at(x, w, to[0]), at(y, h, to[1]));
    let row = |j: usize| values(j * w + i) * (1.0 - s) + values(j * w + i + 1) * s;
    row(j) * (1.0 - t) + row(j + 1) * t
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_are_padded_by_their_edges_or_scaled_and_normalised() {
        let mut image = Image::new(4, 2);
        image.pixels = vec![0, 51, 102, 153, 0, 51, 102, 153];
        let config = NetworkConfig { mean: [0.2; 3], deviation: [0.5; 3], ..NetworkConfig::default() };
        let mut tensor = vec![0.0; 3 * 6 * 3];
        normalise(&image, [6, 3], &config, &mut tensor);
        let row: Vec<f32> = tensor[..6].iter().map(|v| v * 0.5 + 0.2).collect();
        let want = [0.0, 0.2, 0.4, 0.6, 0.6, 0.6];
        assert!(row.iter().zip(want).all(|(a, b)| (a - b).abs() < 1e-6), "{row:?}");
        assert_eq!((&tensor[..18], &tensor[12..18]), (&tensor[18..36], &tensor[..6]));
        let config = NetworkConfig { fit: Fit::Scale, channels: 1, ..config };
        let mut tensor = vec![0.0; 2 * 2];
        normalise(&image, [2, 2], &config, &mut tensor);
        assert!((tensor[0] * 0.5 + 0.2 - 0.1).abs() < 1e-6 && (tensor[1] * 0.5 + 0.2 - 0.5).abs() < 1e-6, "{tensor:?}");
    }

    #[test]
    fn without_runtime_or_model_the_fault_says_what_to_do() {
        let said = |config: NetworkConfig| Network::new(8, 8, &config).err().map(|f| f.to_string()).unwrap_or_default();
        let none = said(NetworkConfig::default());
        assert!(none.contains("stereo.network.model") && none.contains("ONNX file"), "{none}");
        let absent = said(NetworkConfig { model: "no/such.onnx".into(), ..NetworkConfig::default() });
        assert!(absent.contains("no/such.onnx"), "{absent}");
        let model = concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml").to_string();
        let runtime = "no/such/libonnxruntime.so".to_string();
        let missing = said(NetworkConfig { model, runtime, ..NetworkConfig::default() });
        assert!(missing.contains("pip install onnxruntime") && missing.contains("stereo.network.runtime"), "{missing}");
    }
}
