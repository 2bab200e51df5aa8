//! Scenes that `stipple-bench kernels` trains on: a wall of Gaussians, or those that a recording's stereo depth gives.

use glam::DVec3;
use std::path::Path;
use stipple::config::{GpuConfig, StereoConfig};
use stipple::gpu::{Arena, Gpu};
use stipple::map::{Gaussian, View};
use stipple::stereo::{Buffers, DepthMap, Pinhole, Stereo};
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::types::Image;
use stipple_drivers::{Fault, FaultKind, Frames, Pose};

pub struct Scene {
    pub name: String,
    pub view: View,
    pub splats: Vec<Gaussian>,
    pub image: Vec<u8>,
    pub mask: Vec<u8>,
}

/// Opacity of a seed, as the mapper's.
const SEED_OPACITY_LOGIT: f32 = 0.0;

/// SplitMix64 to [0, 1).
struct Rng(u64);

impl Rng {
    fn uniform(&mut self, low: f64, high: f64) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        low + (high - low) * ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }
}

impl Scene {
    /// `n` Gaussians on a wavy wall, turned at random and as wide as their share of the image.
    pub fn wall(width: usize, height: usize, n: usize) -> Scene {
        let f = 0.8 * width.max(height) as f64;
        let camera = Pinhole { width, height, fx: f, fy: f, cx: 0.5 * width as f64, cy: 0.5 * height as f64 };
        let pitch = ((width * height) as f64 / n as f64).sqrt();
        let mut r = Rng(1);
        let splats = (0..n)
            .map(|_| {
                let (x, y) = (r.uniform(0.0, width as f64), r.uniform(0.0, height as f64));
                let z = 3.0 + (x * 0.02).sin() + (y * 0.03).cos();
                let p = DVec3::new((x - camera.cx) / f * z, (y - camera.cy) / f * z, z);
                Gaussian {
                    mean: p.as_vec3().to_array(),
                    log_scale: std::array::from_fn(|_| (z / f * pitch * r.uniform(0.5, 1.2)).ln() as f32),
                    quat_xyzw: std::array::from_fn(|_| r.uniform(-1.0, 1.0) as f32),
                    opacity_logit: r.uniform(-1.0, 2.0) as f32,
                    colour: [r.uniform(0.1, 0.9) as f32; 3],
                }
            })
            .collect();
        let level = |i: usize| 128.0 + 90.0 * ((i % width) as f64 * 0.2).sin() * ((i / width) as f64 * 0.15).cos();
        Scene {
            name: format!("{width}x{height}, {n} Gaussians"),
            view: View::new(Pose::IDENTITY, camera, None),
            splats,
            image: (0..width * height).map(|i| level(i) as u8).collect(),
            mask: vec![255; width * height],
        }
    }

    /// `n` Gaussians at the stereo depth of the frame with the densest depth among a few of a recording, evenly over
    /// the pixels that have one, as wide as their share of the image.
    pub fn recorded(folder: &Path, n: usize, config: &StereoConfig, device: &GpuConfig) -> Result<Scene, Fault> {
        const TRIED: usize = 8;
        let recording = Recording::open(folder, &OpenOptions::default())?;
        let mut arena = Arena::counting();
        Buffers::new(&mut arena, &recording.calibration, config)?;
        let mut gpu = match arena.used() {
            0 => None,
            bytes => Some(Gpu::open(device, bytes)?),
        };
        let mut stereo = Stereo::new(&recording.calibration, config, 1, gpu.as_mut())?;
        let camera = stereo.views.camera().pinhole;
        let (mut frames, mut reader) = (Frames::for_rig(&recording.calibration), recording.reader());
        let mut depth = DepthMap::new(camera.width, camera.height);
        let mut best: Option<(usize, Vec<f32>, Image)> = None;
        for i in 0..TRIED {
            let read = reader.read((2 * i + 1) * recording.frames.len() / (2 * TRIED), &mut frames);
            if read.is_err() || frames.images.len() < 2 {
                continue;
            }
            let found = stereo.depth(gpu.as_mut(), &frames.images[0], &frames.images[1], &mut depth)?;
            if best.as_ref().is_none_or(|b| found > b.0) {
                let mut image = Image::new(camera.width, camera.height);
                stereo.views.rectify(0, &frames.images[0], &mut image);
                best = Some((found, depth.metres.clone(), image));
            }
        }
        let none =
            || Fault::new(FaultKind::Data, folder.display().to_string(), "no frame with stereo depth", "use another");
        let (_, metres, image) = best.ok_or_else(none)?;
        let seen: Vec<usize> = (0..metres.len()).filter(|i| metres[*i] > 0.0).collect();
        let n = n.min(seen.len());
        if n == 0 {
            return Err(none());
        }
        let pitch = (metres.len() as f64 / n as f64).sqrt();
        let splat = |k: usize| {
            let i = seen[k * seen.len() / n];
            let z = f64::from(metres[i]);
            let (x, y) = ((i % camera.width) as f64, (i / camera.width) as f64);
            let p = DVec3::new((x - camera.cx) / camera.fx * z, (y - camera.cy) / camera.fy * z, z);
            Gaussian {
                mean: p.as_vec3().to_array(),
                log_scale: [(z / camera.fx * pitch).ln() as f32; 3],
                quat_xyzw: [0.0, 0.0, 0.0, 1.0],
                opacity_logit: SEED_OPACITY_LOGIT,
                colour: [f32::from(image.pixels[i]) / 255.0; 3],
            }
        };
        let place = folder.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
        Ok(Scene {
            name: format!("{place}, {n} from stereo depth"),
            view: View::new(Pose::IDENTITY, camera, None),
            splats: (0..n).map(splat).collect(),
            mask: stereo.views.valid_mask().to_vec(),
            image: image.pixels,
        })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use stipple::config::StereoMethod;
    use stipple_drivers::sim::{write_euroc, Scenario, Sim};
    use stipple_drivers::Span;

    /// The only method of a build without OpenCV.
    #[test]
    fn a_scene_is_seeded_from_depth_that_the_gpu_matches() {
        let mut scenario = Scenario::named("demo").unwrap();
        (scenario.image_divisor, scenario.duration) = (4, Span::from_secs(1.0));
        let dir = tempfile::tempdir().unwrap();
        write_euroc(&mut Sim::new(&scenario).unwrap(), dir.path(), 0, |_, _| {}).unwrap();
        let config = StereoConfig { method: StereoMethod::Sgm, disparities: 32, ..StereoConfig::default() };
        let scene = Scene::recorded(dir.path(), 2000, &config, &GpuConfig::default()).unwrap();
        assert_eq!((scene.splats.len(), scene.image.len()), (2000, 188 * 120));
    }
}
