//! Densification of an anchor after its burst: Gaussians where its picture is least like what was seen.
//!
//! As published: `MAX · (1 − mean SSIM) / 2` pixels, drawn with weight 1 − SSIM (here by error diffusion, which draws the
//! same density without clumps), at the depth of the stereo pair where it is valid and of the rendering elsewhere, as wide
//! as the distance to the nearest of the other newcomers. A fisheye's rim, which no pair sees, gets none until it is
//! rendered: depth carried over to it from the nearest matches hid what was to come (12 simulated keyframes at 60 steps:
//! training 22.30 dB in place of 23.43; without densification 22.82).

use super::anchors::{Seed, Seeder, Seen, SPACING_PX, SPREAD};
use super::buffers::RUN;
use super::pipeline::{Goal, Pipeline};
use crate::counters::Counters;
use crate::gpu::kernels::{ssim_columns, ssim_rows};
use crate::gpu::{Gpu, GpuError, Threads};
use glam::DVec3;

/// Newcomers whose distance makes a Gaussian's width.
const NEIGHBOURS: usize = 3;
const OPACITY_MATCHED: f64 = 0.5;
const OPACITY_RENDERED: f64 = 0.2;
/// Rendered depth is believed where this much of the pixel is covered.
const DEPTH_ALPHA: f32 = 0.5;

/// The mean of a map over the pixels that count.
pub fn mean(map: &[f32], valid: &[u8]) -> f64 {
    let (sum, n) =
        map.iter().zip(valid).filter(|(_, v)| **v != 0).fold((0.0, 0u32), |(s, n), (m, _)| (s + f64::from(*m), n + 1));
    sum / f64::from(n.max(1))
}

impl Pipeline {
    /// SSIM by pixel of what was rendered last against a keyframe, mean of its channels; one where masked. `map` has room for
    /// them all.
    pub fn similarity(&mut self, gpu: &mut Gpu, goal: Goal, map: &mut Vec<f32>) -> Result<(), GpuError> {
        let (n, channels) = (self.shape.pixels(), self.shape.channels);
        map.resize(n * channels as usize, 1.0);
        for (channel, plane) in map.chunks_exact_mut(n).enumerate() {
            self.similarity_of(gpu, &goal, channel as u32, plane)?;
        }
        if channels > 1 {
            (0..n).for_each(|i| map[i] = map[i..].iter().step_by(n).sum::<f32>() / channels as f32);
            map.truncate(n);
        }
        Ok(())
    }

    fn similarity_of(&mut self, gpu: &mut Gpu, goal: &Goal, channel: u32, map: &mut [f32]) -> Result<(), GpuError> {
        let (w, h) = (self.shape.width, self.shape.height);
        let (b, size) = (&self.b, [w, h]);
        let target = (goal.slot * self.shape.channels + channel) * self.shape.image_words() as u32;
        let mask = b.mask.part(goal.camera as usize * self.shape.mask_stride(), self.shape.image_words());
        let exposure = goal.exposure.unwrap_or_default().words();
        let mut rec = gpu.record();
        let rows = ssim_rows::Bind {
            grey: b.rendered.read(),
            targets: b.targets.read(),
            mask: mask.read(),
            filtered: b.over.filtered.write(),
        };
        rec.dispatch(
            &self.k.ssim_rows,
            rows,
            ssim_rows::Push { size, target, plane: channel * w * h, exposure },
            Threads::d1(w.div_ceil(RUN) * h),
        );
        let columns = ssim_columns::Bind {
            filtered: b.over.filtered.read(),
            mask: mask.read(),
            slopes: b.over.slopes.write(),
            ssim_sums: b.ssim_sums.write(),
        };
        let threads = Threads::d1(w * h.div_ceil(RUN));
        rec.dispatch(&self.k.ssim_map, columns, ssim_columns::Push { size, group: 0 }, threads);
        gpu.submit(rec)?;
        gpu.download(self.b.over.slopes, 0, map)
    }
}

impl Seeder {
    /// At most `wanted` Gaussians, where `similarity` is low and there is a depth.
    pub fn densify(&mut self, seen: &Seen, similarity: &[f32], wanted: usize, counters: &Counters) -> &[Seed] {
        let wanted = wanted.min(self.seeds_max);
        let mut sum = 0.0;
        for i in 0..similarity.len() {
            let has_depth = seen.depth.metres[i] > 0.0 || rendered_depth(seen, i).is_some();
            let weight = if seen.valid[i] != 0 && has_depth { (1.0 - similarity[i]).max(0.0) } else { 0.0 };
            self.density[i] = weight;
            sum += f64::from(weight);
        }
        let scale = (wanted as f64 / sum.max(1e-9)) as f32;
        self.density.iter_mut().for_each(|d| *d = (*d * scale).min(1.0));
        self.pick(seen, wanted, counters, |seeder, x, y| {
            let i = y * seen.width() + x;
            let matched = seen.depth.metres[i] > 0.0;
            let z = f64::from(if matched { seen.depth.metres[i] } else { rendered_depth(seen, i).unwrap_or_default() });
            let Some(p_world) = seen.from.point(x, y, z) else { return };
            seeder.seeds.push(Seed {
                p_world,
                sigma_m: z / seen.from.camera.fx,
                opacity: if matched { OPACITY_MATCHED } else { OPACITY_RENDERED },
                pixel: i as u32,
            });
        });
        widen(&mut self.seeds);
        &self.seeds
    }
}

fn rendered_depth(seen: &Seen, i: usize) -> Option<f32> {
    (seen.alpha[i] >= DEPTH_ALPHA && seen.rendered_depth[i] > 0.0).then(|| seen.rendered_depth[i])
}

/// From a pixel's width to that of the mean distance to the nearest others, within the spacing of seeds.
fn widen(seeds: &mut [Seed]) {
    for i in 0..seeds.len() {
        let mut nearest = [f64::INFINITY; NEIGHBOURS];
        let p: DVec3 = seeds[i].p_world;
        for (j, other) in seeds.iter().enumerate() {
            let d = p.distance_squared(other.p_world);
            if j != i && d < nearest[NEIGHBOURS - 1] {
                nearest[NEIGHBOURS - 1] = d;
                nearest.sort_unstable_by(f64::total_cmp);
            }
        }
        let found = nearest.iter().filter(|d| d.is_finite());
        let (sum, n) = found.fold((0.0, 0), |(s, n), d| (s + d.sqrt(), n + 1));
        let pixel_m = seeds[i].sigma_m;
        let spacing_m = if n > 0 { sum / f64::from(n) } else { 0.0 };
        seeds[i].sigma_m = SPREAD * spacing_m.clamp(SPACING_PX[0] * pixel_m, SPACING_PX[1] * pixel_m);
    }
}

#[cfg(test)]
mod tests {
    use super::super::anchors::tests::{flat, from, H, W};
    use super::super::view::Exposure;
    use super::*;
    use stipple_drivers::Image;

    #[test]
    fn newcomers_go_where_the_picture_is_wrong_and_to_the_depth_there_is() {
        let (mut depth, image) = (flat(2.0), Image::new(W, H));
        // The lower half has no match; it was rendered 3 m away, but for its left quarter, which is bare.
        depth.metres[W * H / 2..].fill(0.0);
        let alpha: Vec<f32> = (0..W * H).map(|i| if i % W < W / 4 { 0.1 } else { 0.9 }).collect();
        // Right half wrong.
        let similarity: Vec<f32> = (0..W * H).map(|i| if i % W < W / 2 { 1.0 } else { 0.2 }).collect();
        let seen = Seen {
            planes: std::slice::from_ref(&image),
            valid: &[1; W * H],
            depth: &depth,
            alpha: &alpha,
            colour: &[0.0; W * H],
            exposure: Exposure::default(),
            rendered_depth: &[3.0; W * H],
            from: from(),
        };
        let mut s = Seeder::new(W, H, 500);
        let seeds = s.densify(&seen, &similarity, 200, &Counters::default()).to_vec();
        assert!((180..=200).contains(&seeds.len()), "{}", seeds.len());
        assert!(seeds.iter().all(|k| k.p_world.x > -0.05));
        assert!(seeds.iter().all(|k| (k.p_world.z - 2.0).abs() < 1e-6 || (k.p_world.z - 3.0).abs() < 1e-6));
        // 1536 px for 200: 2.8 px apart.
        let px = |k: &Seed| k.sigma_m / k.p_world.z * 50.0;
        let mean = seeds.iter().map(px).sum::<f64>() / seeds.len() as f64;
        assert!((0.3 * 2.8..0.7 * 2.8).contains(&mean), "{mean}");
        assert!(s.densify(&seen, &[1.0; W * H], 200, &Counters::default()).is_empty());
    }
}
