//! The two rasters against their twin: grey and colour, with depth and without, with subgroups and without.

use super::splat::{worst, Rng};
use super::twins::raster::{backward, forward, Flat, Planes};
use stipple::config::GpuConfig;
use stipple::gpu::kernels::{raster_backward, raster_forward, types::Projected};
use stipple::gpu::{Buf, Gpu, Threads};
use stipple::map::Tiling;

const W: usize = 37;
const H: usize = 21;

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
            [centre[0], centre[1], a, b, c, opacity, red, z, green, blue].map(|v| f64::from(v as f32))
        })
        .collect()
}

/// A gradient by pixel, of one sign more than of the other.
fn planes(channels: usize, seed: u64) -> Planes {
    let mut r = Rng(seed);
    let mut noise = || (0..W * H).map(|_| f64::from(r.uniform(-1.0, 2.0) as f32)).collect::<Vec<_>>();
    let mut v = Planes::zeros(W * H);
    (0..channels).for_each(|c| v.colour[c] = noise());
    v
}

fn words(v: &Planes, channels: usize) -> Vec<f32> {
    v.colour[..channels].iter().flatten().map(|v| *v as f32).collect()
}

#[test]
fn raster_twin_agrees_with_finite_differences() {
    const STEP: f64 = 1e-6;
    let splats = flat_scene(12, 3);
    let v = planes(3, 4);
    let some = |s: &[Flat]| s.iter().copied().map(Some).collect::<Vec<_>>();
    let loss = |s: &[Flat]| v.dot(&forward(&some(s), W, H).planes);
    let margin = forward(&some(&splats), W, H).margin;
    assert!(margin > 1e-4, "a decision is too close for differences: {margin}");
    let gradient = backward(&some(&splats), W, H, &v, &[0.0; W * H]);
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
    fn run(&mut self, splats: &[Flat], v: &Planes, channels: u32, depth: bool) -> (Vec<f32>, Vec<Vec<f64>>) {
        let (Tiling { lanes, column, variant, .. }, tiles, n) = (self.tiling, self.tiles(), splats.len() as u32);
        let slot_words = if channels == 3 { 12 } else { 8 };
        let records: Vec<Projected> = splats
            .iter()
            .map(|s| Projected {
                centre_conic: [s[0] + 0.5, s[1] + 0.5, s[2], s[3]].map(|v| v as f32),
                conic_shade: [s[4], s[5], s[6], s[7]].map(|v| v as f32),
            })
            .collect();
        let chroma: Vec<[f32; 2]> = splats.iter().map(|s| [s[8] as f32, s[9] as f32]).collect();
        let ranges = self.upload(&(0..tiles).map(|t| [t * n, (t + 1) * n]).chain([[0, 0]]).collect::<Vec<_>>());
        let intersections = self.upload(&(0..tiles * n).collect::<Vec<_>>());
        let owners = self.upload(&(0..tiles * n).map(|e| e % n).collect::<Vec<_>>());
        let (records, chroma) = (self.upload(&records), self.upload(&chroma));
        let pixel_gradient = self.upload(&words(v, channels as usize));
        let rendered = self.upload(&vec![0f32; (channels as usize + 2) * W * H]);
        let gradients = self.upload(&vec![f32::NAN; tiles as usize * splats.len() * slot_words]);

        let spec = raster_forward::Spec { lanes, column, depth, channels };
        let forward = self.gpu.kernel_variant::<raster_forward::K>(spec, variant).unwrap();
        let spec = raster_backward::Spec { lanes, column, channels };
        let backward = self.gpu.kernel_variant::<raster_backward::K>(spec, variant).unwrap();
        let size = [W as u32, H as u32];
        let mut rec = self.gpu.record();
        let bind = raster_forward::Bind {
            ranges: ranges.read(),
            intersections: intersections.read(),
            owners: owners.read(),
            projected_in: records.read(),
            chroma: chroma.read(),
            rendered: rendered.write(),
        };
        rec.dispatch(&forward, bind, raster_forward::Push { size }, Threads::d1(tiles * lanes));
        let bind = raster_backward::Bind {
            ranges: ranges.read(),
            intersections: intersections.read(),
            owners: owners.read(),
            projected_in: records.read(),
            chroma: chroma.read(),
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
    let open_as = |profile: &str, baseline, column| {
        let config = GpuConfig { profile: profile.into(), ..crate::config() };
        let gpu = Gpu::open(&config, 8 << 20).unwrap();
        let tiling = if baseline { Tiling::BASELINE } else { Tiling::of(gpu.caps()) };
        Rig { gpu, tiling: Tiling { column, ..tiling } }
    };
    let open = |baseline, column| open_as("", baseline, column);
    // A CPU reads texels; what a GPU with subgroups runs is compared too.
    let mut of_a_gpu = open(false, 8);
    if of_a_gpu.tiling.variant == "cpu" {
        of_a_gpu.tiling.variant = "subgroup";
    }
    // Of an Intel GPU, whose kernels ask for a width of subgroup.
    let asks = open_as("Intel Gen12", false, 8);
    vec![open(true, 8), open(true, 4), open(false, 8), open(false, 4), open(false, 2), of_a_gpu, asks]
}

fn close(got: impl IntoIterator<Item = f32>, want: &[f64], tolerance: f64, what: &str) {
    let scale = want.iter().fold(1.0f64, |m, v| m.max(v.abs()));
    let error = worst(got.into_iter().map(f64::from), want.iter().copied());
    assert!(error < tolerance * scale, "{what} off by {error} of {scale}");
}

#[test]
fn both_rasters_agree_with_their_twin_in_grey_and_colour_with_depth_and_without() {
    let splats = flat_scene(70, 5);
    let some: Vec<_> = splats.iter().copied().map(Some).collect();
    let twin = forward(&some, W, H);
    assert!(twin.margin > 1e-6, "a decision is too close to compare: {}", twin.margin);
    for mut rig in rigs() {
        for (channels, depth) in [(1, false), (1, true), (3, false), (3, true)] {
            let case = format!("{:?}, {channels} channels, depth {depth}", rig.tiling);
            let v = planes(channels as usize, 6);
            let want = backward(&some, W, H, &v, &[0.0; W * H]);
            let (picture, got) = rig.run(&splats, &v, channels, depth);
            let plane = |p: usize| picture[p * W * H..][..W * H].iter().copied();
            let channels = channels as usize;
            (0..channels).for_each(|c| close(plane(c), &twin.planes.colour[c], 1e-5, &format!("{case}: colour {c}")));
            close(plane(channels), &twin.transmittance, 1e-5, &format!("{case}: transmittance"));
            if depth {
                close(plane(channels + 1), &twin.depth, 1e-4, &format!("{case}: depth"));
            }
            for k in 0..got[0].len() {
                let used = k < if channels == 3 { 10 } else { 7 } && k != 7;
                let of = |i: usize| match k {
                    5 => want[i][5] * splats[i][5],
                    _ if used => want[i][k],
                    _ => 0.0,
                };
                let want: Vec<f64> = (0..splats.len()).map(of).collect();
                close(got.iter().map(|g| g[k] as f32), &want, 2e-4, &format!("{case}: slot word {k}"));
            }
        }
    }
}
