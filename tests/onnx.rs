//! A small network of stereo, written as an ONNX file by the test itself and run by ONNX Runtime through the door,
//! against the same network evaluated here in f64.
//!
//! Both images lose their local mean; products of the left one and the right one shifted by each disparity are
//! averaged over windows (a correlation cost volume); a softmax over disparities weighs their mean (soft-argmin).
//! The test needs ONNX Runtime, which Debian 12 does not package: `make test-onnx` fetches it and runs this, or
//! `STIPPLE_ONNXRUNTIME=.../libonnxruntime.so cargo test --test onnx -- --ignored`.
#![allow(clippy::unwrap_used)]

#[allow(dead_code)] // each test takes of it what it needs
#[path = "bench/world.rs"]
mod world;

use stipple::config::{NetworkConfig, StereoConfig, StereoMethod};
use stipple::stereo::{Disparity, Matcher};
use stipple_drivers::Image;
use world::Noise;

const W: usize = 96;
const H: usize = 48;
const DISPARITIES: usize = 16;
/// Half sides of the windows of the mean and of the correlation.
const MEAN: usize = 3;
const WINDOW: usize = 2;
/// Makes the softmax sharp.
const GAIN: f64 = 60.0;

/// Protocol buffers, as much as a model needs.
#[derive(Default)]
struct Message(Vec<u8>);

impl Message {
    fn varint(&mut self, mut v: u64) {
        while v >= 0x80 {
            self.0.push(v as u8 | 0x80);
            v >>= 7;
        }
        self.0.push(v as u8);
    }

    fn number(mut self, field: u64, v: i64) -> Message {
        self.varint(field << 3);
        self.varint(v as u64);
        self
    }

    fn bytes(mut self, field: u64, v: &[u8]) -> Message {
        self.varint(field << 3 | 2);
        self.varint(v.len() as u64);
        self.0.extend_from_slice(v);
        self
    }

    fn text(self, field: u64, v: &str) -> Message {
        self.bytes(field, v.as_bytes())
    }

    fn each<T>(self, items: &[T], put: impl Fn(Message, &T) -> Message) -> Message {
        items.iter().fold(self, put)
    }
}

fn node(op: &str, inputs: &[&str], output: &str, attributes: &[Message]) -> Message {
    let m = Message::default().each(inputs, |m, i| m.text(1, i)).text(2, output).text(4, op);
    m.each(attributes, |m, a| m.bytes(5, &a.0))
}

fn int(name: &str, v: i64) -> Message {
    Message::default().text(1, name).number(3, v).number(20, 2)
}

fn ints(name: &str, v: &[i64]) -> Message {
    Message::default().text(1, name).each(v, |m, v| m.number(8, *v)).number(20, 7)
}

fn floats(name: &str, dims: &[i64], v: &[f32]) -> Message {
    let raw: Vec<u8> = v.iter().flat_map(|v| v.to_le_bytes()).collect();
    Message::default().each(dims, |m, d| m.number(1, *d)).number(2, 1).text(8, name).bytes(9, &raw)
}

fn longs(name: &str, v: &[i64]) -> Message {
    let raw: Vec<u8> = v.iter().flat_map(|v| v.to_le_bytes()).collect();
    Message::default().number(1, v.len() as i64).number(2, 7).text(8, name).bytes(9, &raw)
}

fn value(name: &str, dims: &[i64]) -> Message {
    let dim = |m: Message, d: &i64| m.bytes(1, &Message::default().number(1, *d).0);
    let shape = Message::default().each(dims, dim);
    let tensor = Message::default().number(1, 1).bytes(2, &shape.0);
    Message::default().text(1, name).bytes(2, &Message::default().bytes(1, &tensor.0).0)
}

/// Mean over a window, zeros outside.
fn pool(half: usize, input: &str, output: &str) -> Message {
    let (side, half) = (2 * half as i64 + 1, half as i64);
    let shape = [ints("kernel_shape", &[side; 2]), ints("pads", &[half; 4]), int("count_include_pad", 1)];
    node("AveragePool", &[input], output, &shape)
}

fn model() -> Vec<u8> {
    let image = [1, 1, H as i64, W as i64];
    let mut nodes = vec![];
    let mut constants = vec![longs("zero", &[0]), longs("one", &[1]), longs("axis", &[3]), longs("end", &[W as i64])];
    for eye in ["left", "right"] {
        nodes.push(pool(MEAN, eye, &format!("{eye}_mean")));
        nodes.push(node("Sub", &[eye, &format!("{eye}_mean")], &format!("{eye}_flat"), &[]));
    }
    let mut slices = vec![];
    for d in 0..DISPARITIES {
        let name = |s: &str| format!("{s}_{d}");
        constants.push(longs(&name("pads"), &[0, 0, 0, d as i64, 0, 0, 0, 0]));
        nodes.push(node("Pad", &["right_flat", &name("pads")], &name("padded"), &[]));
        nodes.push(node("Slice", &[&name("padded"), "zero", "end", "axis"], &name("shifted"), &[]));
        nodes.push(node("Mul", &["left_flat", &name("shifted")], &name("product"), &[]));
        nodes.push(pool(WINDOW, &name("product"), &name("cost")));
        slices.push(name("cost"));
    }
    let slices: Vec<&str> = slices.iter().map(String::as_str).collect();
    nodes.push(node("Concat", &slices, "volume", &[int("axis", 1)]));
    constants.push(floats("gain", &[1], &[GAIN as f32]));
    nodes.push(node("Mul", &["volume", "gain"], "sharp", &[]));
    nodes.push(node("Softmax", &["sharp"], "weights", &[int("axis", 1)]));
    let candidates: Vec<f32> = (0..DISPARITIES).map(|d| d as f32).collect();
    constants.push(floats("candidates", &[1, DISPARITIES as i64, 1, 1], &candidates));
    nodes.push(node("Mul", &["weights", "candidates"], "weighed", &[]));
    nodes.push(node("ReduceSum", &["weighed", "one"], "disparity", &[int("keepdims", 1)]));
    let graph = Message::default().each(&nodes, |m, n| m.bytes(1, &n.0)).text(2, "correlation");
    let graph = graph.each(&constants, |m, c| m.bytes(5, &c.0));
    let graph = graph.each(&["left", "right"], |m, name| m.bytes(11, &value(name, &image).0));
    let graph = graph.bytes(12, &value("disparity", &image).0);
    let opset = Message::default().text(1, "").number(2, 13);
    Message::default().number(1, 8).bytes(8, &opset.0).bytes(7, &graph.0).0
}

fn mean(image: &[f64], half: usize) -> Vec<f64> {
    let of = |i: usize| {
        let (x, y) = (i % W, i / W);
        let mut sum = 0.0;
        for v in y.saturating_sub(half)..(y + half + 1).min(H) {
            sum += image[v * W..][x.saturating_sub(half)..(x + half + 1).min(W)].iter().sum::<f64>();
        }
        sum / ((2 * half + 1) * (2 * half + 1)) as f64
    };
    (0..W * H).map(of).collect()
}

/// The network in f64; images as it gets them.
fn evaluate(left: &[f64], right: &[f64]) -> Vec<f64> {
    let flat = |image: &[f64]| -> Vec<f64> { image.iter().zip(mean(image, MEAN)).map(|(v, m)| v - m).collect() };
    let (left, right) = (flat(left), flat(right));
    let cost = |d: usize| {
        let product = |i: usize| if i % W >= d { left[i] * right[i - d] } else { 0.0 };
        mean(&(0..W * H).map(product).collect::<Vec<f64>>(), WINDOW)
    };
    let volume: Vec<Vec<f64>> = (0..DISPARITIES).map(cost).collect();
    let soft = |i: usize| {
        let weights: Vec<f64> = volume.iter().map(|c| (GAIN * c[i]).exp()).collect();
        let sum: f64 = weights.iter().sum();
        weights.iter().enumerate().map(|(d, w)| d as f64 * w / sum).sum()
    };
    (0..W * H).map(soft).collect()
}

const TRUE_PX: usize = 6;

fn pair() -> (Image, Image) {
    let mut noise = Noise(5);
    let mut right = Image::new(W, H);
    right.pixels.iter_mut().for_each(|p| *p = (40.0 + 170.0 * noise.uniform()) as u8);
    let mut left = Image::new(W, H);
    for i in 0..W * H {
        left.pixels[i] = if i % W >= TRUE_PX { right.pixels[i - TRUE_PX] } else { 128 };
    }
    (left, right)
}

fn config(model: &std::path::Path) -> StereoConfig {
    let network = NetworkConfig {
        model: model.to_str().unwrap().into(),
        runtime: std::env::var("STIPPLE_ONNXRUNTIME").unwrap_or_default(),
        channels: 1,
        mean: [0.5; 3],
        deviation: [0.25; 3],
        threads: 1,
        ..NetworkConfig::default()
    };
    StereoConfig { method: StereoMethod::Onnx, network, ..StereoConfig::default() }
}

#[test]
#[ignore = "needs ONNX Runtime, which Debian 12 does not package: make test-onnx"]
fn the_runtime_answers_what_the_network_is() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("correlation.onnx");
    std::fs::write(&file, model()).unwrap();
    let (left, right) = pair();
    let mut method = Matcher::new(W, H, &config(&file), None).unwrap_or_else(|e| panic!("{e}"));
    let mut found = Disparity::new(W, H);
    method.compute(None, &left, &right, &mut found).unwrap();
    let given = |image: &Image| image.pixels.iter().map(|p| (f64::from(*p) / 255.0 - 0.5) / 0.25).collect::<Vec<f64>>();
    let expected = evaluate(&given(&left), &given(&right));
    let (mut compared, mut right_ones) = (0, 0);
    for (i, want) in expected.iter().enumerate() {
        let got = f64::from(found.px[i]);
        if *want <= (i % W) as f64 + 0.49 {
            assert!((got - want).abs() < 2e-3, "pixel {} {}: {got} against {want}", i % W, i / W);
            compared += 1;
        }
        right_ones += usize::from((want - TRUE_PX as f64).abs() < 0.5);
    }
    assert!(compared * 10 > W * H * 8 && right_ones * 10 > W * H * 8, "{compared} {right_ones} of {}", W * H);
    assert!(found.px.iter().zip(&found.sigma_px).all(|(d, s)| *d < 0.0 || (s.is_finite() && *s > 0.0)));
}

#[test]
#[ignore = "needs ONNX Runtime, which Debian 12 does not package: make test-onnx"]
fn a_model_that_is_described_wrongly_is_refused_at_boot() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("correlation.onnx");
    std::fs::write(&file, model()).unwrap();
    let right = config(&file);
    let said = |network: NetworkConfig| {
        let config = StereoConfig { network, ..right.clone() };
        Matcher::new(W, H, &config, None).err().map(|f| f.to_string()).unwrap_or_default()
    };
    let name = said(NetworkConfig { left: "image1".into(), ..right.network.clone() });
    assert!(name.contains("image1") && name.contains("[stereo.network]"), "{name}");
    let channels = said(NetworkConfig { channels: 3, ..right.network.clone() });
    assert!(channels.contains("does not run"), "{channels}");
    std::fs::write(&file, b"not a model").unwrap();
    let broken = said(right.network.clone());
    assert!(broken.contains("refuses") && broken.contains("correlation.onnx"), "{broken}");
}

#[test]
fn without_the_runtime_the_fault_names_what_to_install() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("correlation.onnx");
    std::fs::write(&file, model()).unwrap();
    let mut config = config(&file);
    config.network.runtime = dir.path().join("libonnxruntime.so").to_str().unwrap().into();
    let said = Matcher::new(W, H, &config, None).err().map(|f| f.to_string()).unwrap_or_default();
    assert!(said.contains("stereo.network.runtime") && said.contains("pip install onnxruntime"), "{said}");
}
