//! The two rasters against their twin, alone and through the whole chain to the parameters: grey and colour,
//! with and without inverse depth, with subgroups and without.

use super::splat::{mask, open_with, scene, shape, view, worst, Rng, STILL};
use super::twins::project::{parameters, Parameters};
use super::twins::raster::{backward, forward, Flat, Planes};
use super::twins::{descend, project_all};
use stipple::gpu::kernels::{raster_backward, raster_forward, types::Projected};
use stipple::gpu::{Buf, Gpu, Threads};
use stipple::map::pipeline::{SplatInit, Tiling, View, Weights};

const W: usize = 37;
const H: usize = 21;
/// Values of DEPTH: shade.glsl.
const EXPECTED_DEPTH: u32 = 1;
const INVERSE_DEPTH: u32 = 2;

/// Gaussians on the image, nearest first.
fn flat_scene(n: usize, seed: u64) -> Vec<Flat> {
    let mut r = Rng(seed);
    (0..n)
        .map(|i| {
            let (a, c) = (r.uniform(0.02, 0.4), r.uniform(0.02, 0.4));
            let b = r.uniform(-0.8, 0.8) * f64::sqrt(a * c);
            let centre = [r.uniform(-3.0, W as f64 + 3.0), r.uniform(-3.0, H as f64 + 3.0)];
            let mut level = || r.uniform(0.05, 0.95);
            let (red, green, blue, opacity) = (level(), level(), level(), level());
            let z = 1.0 + 0.1 * i as f64;
            // As the kernels get them.
            [centre[0], centre[1], a, b, c, opacity, red, 1.0 / z, green, blue].map(|v| f64::from(v as f32))
        })
        .collect()
}

/// A gradient by pixel, of one sign more than of the other.
fn planes(channels: usize, depth: bool, seed: u64) -> Planes {
    let mut r = Rng(seed);
    let mut noise = || (0..W * H).map(|_| f64::from(r.uniform(-1.0, 2.0) as f32)).collect::<Vec<_>>();
    let mut v = Planes::zeros(W * H);
    (0..channels).for_each(|c| v.colour[c] = noise());
    if depth {
        (v.inverse_depth, v.transmittance) = (noise(), noise());
    }
    v
}

fn words(v: &Planes, channels: usize) -> Vec<f32> {
    let colours = v.colour[..channels].iter();
    colours.chain([&v.inverse_depth, &v.transmittance]).flatten().map(|v| *v as f32).collect()
}

#[test]
fn raster_twin_agrees_with_finite_differences() {
    const STEP: f64 = 1e-6;
    let splats = flat_scene(12, 3);
    let v = planes(3, true, 4);
    let some = |s: &[Flat]| s.iter().copied().map(Some).collect::<Vec<_>>();
    let loss = |s: &[Flat]| v.dot(&forward(&some(s), W, H).planes);
    let margin = forward(&some(&splats), W, H).margin;
    assert!(margin > 1e-4, "a decision is too close for differences: {margin}");
    let gradient = backward(&some(&splats), W, H, &v);
    for i in 0..splats.len() {
        for k in 0..10 {
            let moved = |h: f64| {
                let mut s = splats.clone();
                s[i][k] += h;
                loss(&s)
            };
            let numeric = (moved(STEP) - moved(-STEP)) / (2.0 * STEP);
            let error = (gradient[i][k] - numeric).abs();
            assert!(error <= 1e-5 + 1e-6 * numeric.abs(), "splat {i} entry {k}: {} against {numeric}", gradient[i][k]);
        }
    }
}

/// One run of both kernels over lists in which every tile has every Gaussian.
struct Rig {
    gpu: Gpu,
    tiling: Tiling,
}

impl Rig {
    fn upload<T: bytemuck::Pod>(&mut self, items: &[T]) -> Buf<T> {
        let buf = self.gpu.alloc("test", items.len()).unwrap();
        self.gpu.upload(buf, 0, items).unwrap();
        buf
    }

    fn tiles(&self) -> u32 {
        let [width, height] = self.tiling.tile();
        (W as u32).div_ceil(width) * (H as u32).div_ceil(height)
    }

    /// What was rendered, and the gradient by each Gaussian in the words of its slot.
    fn run(&mut self, splats: &[Flat], v: &Planes, channels: u32, depth: u32) -> (Vec<f32>, Vec<Vec<f64>>) {
        let (Tiling { lanes, column, variant, .. }, tiles, n) = (self.tiling, self.tiles(), splats.len() as u32);
        let slot_words = if channels == 3 { 12 } else { 8 };
        let records: Vec<Projected> = splats
            .iter()
            .map(|s| Projected {
                centre_conic: [s[0] + 0.5, s[1] + 0.5, s[2], s[3]].map(|v| v as f32),
                conic_shade: [s[4], s[5], s[6], 1.0 / s[7]].map(|v| v as f32),
            })
            .collect();
        let tints: Vec<[f32; 2]> = splats.iter().map(|s| [s[8] as f32, s[9] as f32]).collect();
        let ranges = self.upload(&(0..tiles).map(|t| [t * n, (t + 1) * n]).chain([[0, 0]]).collect::<Vec<_>>());
        let intersections = self.upload(&(0..tiles * n).collect::<Vec<_>>());
        let owners = self.upload(&(0..tiles * n).map(|e| e % n).collect::<Vec<_>>());
        let (records, tints) = (self.upload(&records), self.upload(&tints));
        let pixel_gradient = self.upload(&words(v, channels as usize));
        let rendered = self.upload(&vec![0f32; (channels as usize + 2) * W * H]);
        let gradients = self.upload(&vec![f32::NAN; tiles as usize * splats.len() * slot_words]);

        let spec = raster_forward::Spec { lanes, column, depth, channels };
        let forward = self.gpu.kernel_variant::<raster_forward::K>(spec, variant).unwrap();
        let spec = raster_backward::Spec { lanes, column, depth, channels, degree: 0 };
        let backward = self.gpu.kernel_variant::<raster_backward::K>(spec, variant).unwrap();
        let size = [W as u32, H as u32];
        let mut rec = self.gpu.record();
        let bind = raster_forward::Bind {
            ranges: ranges.read(),
            intersections: intersections.read(),
            owners: owners.read(),
            projected_in: records.read(),
            tints: tints.read(),
            rendered: rendered.write(),
        };
        rec.dispatch(&forward, bind, raster_forward::Push { size }, Threads::d1(tiles * lanes));
        let bind = raster_backward::Bind {
            ranges: ranges.read(),
            intersections: intersections.read(),
            owners: owners.read(),
            projected_in: records.read(),
            tints: tints.read(),
            rendered: rendered.read(),
            pixel_gradient: pixel_gradient.read(),
            isect_gradients: gradients.write(),
        };
        rec.dispatch(&backward, bind, raster_backward::Push { size }, Threads::d1(tiles * lanes));
        self.gpu.submit(rec).unwrap();

        let mut picture = vec![0f32; rendered.len()];
        self.gpu.download(rendered, 0, &mut picture).unwrap();
        let mut slots = vec![0f32; gradients.len()];
        self.gpu.download(gradients, 0, &mut slots).unwrap();
        let mut sums = vec![vec![0.0; slot_words]; splats.len()];
        for (e, slot) in slots.chunks_exact(slot_words).enumerate() {
            let sum = &mut sums[e % splats.len()];
            sum.iter_mut().zip(slot).for_each(|(s, g)| *s += f64::from(*g));
        }
        (picture, sums)
    }
}

fn rigs() -> Vec<Rig> {
    let open = |baseline, column| {
        let gpu = Gpu::open(&crate::config(), 8 << 20).unwrap();
        let tiling = if baseline { Tiling::BASELINE } else { Tiling::of(gpu.caps()) };
        Rig { gpu, tiling: Tiling { column, ..tiling } }
    };
    vec![open(true, 8), open(true, 4), open(false, 8), open(false, 4), open(false, 2)]
}

fn close(got: impl IntoIterator<Item = f32>, want: &[f64], tolerance: f64, what: &str) {
    let scale = want.iter().fold(1.0f64, |m, v| m.max(v.abs()));
    let error = worst(got.into_iter().map(f64::from), want.iter().copied());
    assert!(error < tolerance * scale, "{what} off by {error} of {scale}");
}

#[test]
fn both_rasters_agree_with_their_twin_in_grey_and_colour_with_and_without_depth() {
    let splats = flat_scene(70, 5);
    let some: Vec<_> = splats.iter().copied().map(Some).collect();
    let twin = forward(&some, W, H);
    assert!(twin.margin > 1e-6, "a decision is too close to compare: {}", twin.margin);
    for mut rig in rigs() {
        for (channels, depth) in [(1, 0), (1, INVERSE_DEPTH), (3, 0), (3, INVERSE_DEPTH)] {
            let case = format!("{:?}, {channels} channels, depth {depth}", rig.tiling);
            let v = planes(channels as usize, depth != 0, 6);
            let want = backward(&some, W, H, &v);
            let (picture, got) = rig.run(&splats, &v, channels, depth);
            let plane = |p: usize| picture[p * W * H..][..W * H].iter().copied();
            let channels = channels as usize;
            (0..channels).for_each(|c| close(plane(c), &twin.planes.colour[c], 1e-5, &format!("{case}: colour {c}")));
            close(plane(channels), &twin.planes.transmittance, 1e-5, &format!("{case}: transmittance"));
            if depth != 0 {
                close(plane(channels + 1), &twin.planes.inverse_depth, 1e-5, &format!("{case}: inverse depth"));
            }
            for k in 0..got[0].len() {
                let used = k < if channels == 3 { 10 } else { 8 } && (k != 7 || depth != 0);
                let of = |i: usize| match k {
                    5 => want[i][5] * splats[i][5],
                    _ if used => want[i][k],
                    _ => 0.0,
                };
                let want: Vec<f64> = (0..splats.len()).map(of).collect();
                close(got.iter().map(|g| g[k] as f32), &want, 2e-4, &format!("{case}: slot word {k}"));
            }
        }
        let (picture, _) = rig.run(&splats, &planes(1, false, 6), 1, EXPECTED_DEPTH);
        close(picture[2 * W * H..].iter().copied(), &twin.depth, 1e-4, "expected depth");
    }
}

#[test]
fn twin_gradients_by_inverse_depth_and_transmittance_agree_with_finite_differences() {
    const STEP: f64 = 1e-6;
    let view = view(W, H);
    let splats: Vec<Parameters> = scene(16, &view, 3).iter().map(parameters).collect();
    let v = planes(1, true, 7);
    let loss = |s: &[Parameters], twist: &[f64; 6]| {
        let projected = super::twins::flat(&project_all(s, &view, twist));
        let rendered = forward(&projected, W, H);
        assert!(rendered.margin > 1e-7, "a decision is too close for differences: {}", rendered.margin);
        v.dot(&rendered.planes)
    };
    let (by_splat, by_twist) = descend(&project_all(&splats, &view, &[0.0; 6]), &view, &v);
    let agree = |analytic: f64, numeric: f64, what: String| {
        let error = (analytic - numeric).abs();
        assert!(error <= 2e-5 + 1e-5 * numeric.abs(), "{what}: {analytic} against {numeric}");
    };
    for i in 0..splats.len() {
        for k in 0..12 {
            let moved = |h: f64| {
                let mut s = splats.clone();
                s[i][k] += h;
                loss(&s, &[0.0; 6])
            };
            agree(by_splat[i][k], (moved(STEP) - moved(-STEP)) / (2.0 * STEP), format!("splat {i} parameter {k}"));
        }
    }
    for k in 0..6 {
        let turned = |h: f64| loss(&splats, &std::array::from_fn(|i| if i == k { h } else { 0.0 }));
        agree(by_twist[k], (turned(STEP) - turned(-STEP)) / (2.0 * STEP), format!("twist {k}"));
    }
}

#[test]
fn gradients_by_inverse_depth_reach_the_parameters_and_the_pose() {
    let view = view(W, H);
    inverse_depth_reaches_the_parameters(&view, &scene(64, &view, 3));
    let view = super::fisheye::wide_view(W, H);
    inverse_depth_reaches_the_parameters(&view, &super::fisheye::around(64, &view, 3));
}

fn inverse_depth_reaches_the_parameters(view: &View, splats: &[SplatInit]) {
    let doubles: Vec<Parameters> = splats.iter().map(parameters).collect();
    let seen = mask(W, H);
    let mut v = planes(1, true, 7);
    for plane in [&mut v.colour[0], &mut v.inverse_depth, &mut v.transmittance] {
        plane.iter_mut().zip(&seen).filter(|(_, m)| **m == 0).for_each(|(v, _)| *v = 0.0);
    }
    let (want, twist) = descend(&project_all(&doubles, view, &[0.0; 6]), view, &v);
    for baseline in [true, false] {
        let (mut gpu, mut p) = open_with(shape(view, 64, 1 << 16), baseline);
        p.append(&mut gpu, splats).unwrap();
        let weights = Weights { needle: 0.0, scale: 0.0, opacity: 0.0, ..Weights::default() };
        let step = p.descend(&mut gpu, view, &words(&v, 1), &STILL, &weights).unwrap();
        let mut moments = vec![Default::default(); splats.len()];
        gpu.download(p.buffers().moments, 0, &mut moments).unwrap();
        for k in 0..12 {
            // Adam's first moment after one step from rest: a tenth of the gradient.
            let of = |m: &stipple::gpu::kernels::types::Moments| {
                let [a, b, q] = m.m;
                [a[0], a[1], a[2], b[0], b[1], b[2], q[0], q[1], q[2], q[3], a[3], b[3]][k] * 10.0
            };
            let want: Vec<f64> = want.iter().map(|g| g[k]).collect();
            close(moments.iter().map(of), &want, 1e-3, &format!("baseline {baseline}: parameter {k}"));
        }
        let dp = -(view.world_from_cam.q * glam::DVec3::from_slice(&twist[..3]));
        let want = [dp.x, dp.y, dp.z, -twist[3], -twist[4], -twist[5]];
        close(step.pose_gradient.map(|g| g as f32), &want, 1e-3, "pose");
    }
}
