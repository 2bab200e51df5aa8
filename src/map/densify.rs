//! Densification of an anchor after its burst: Gaussians where its picture is least like what was seen.
//!
//! As published: `MAX · (1 − mean SSIM) / 2` pixels, drawn with weight 1 − SSIM (here by error diffusion, which draws the
//! same density without clumps), at the depth of the stereo pair where it is valid and of the rendering elsewhere, as wide
//! as the distance to the nearest of the other newcomers. A fisheye's rim, which no pair sees, gets none until it is
//! rendered: depth carried over to it from the nearest matches would hide what is to come.

use super::coverage::KeyframeView;
use super::diffusion::Diffusion;
use super::seeds::{initial_opacity, Seed, SPACING_PX, SPREAD};
use crate::counters::Counters;
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

/// At most `wanted` Gaussians, and no more than `seeds` holds, where `similarity` is low and there is a depth.
pub fn densify(
    seen: &KeyframeView,
    similarity: &[f32],
    wanted: usize,
    diffusion: &mut Diffusion,
    seeds: &mut Vec<Seed>,
    counters: &Counters,
) {
    let wanted = wanted.min(seeds.capacity());
    let mut sum = 0.0;
    for i in 0..similarity.len() {
        let has_depth = seen.depth[i] > 0.0 || rendered_depth(seen, i).is_some();
        let weight = if seen.valid[i] != 0 && has_depth { (1.0 - similarity[i]).max(0.0) } else { 0.0 };
        diffusion.density[i] = weight;
        sum += f64::from(weight);
    }
    diffusion.scale(wanted, sum.max(1e-9));
    seeds.clear();
    diffusion.pick(|x, y, _| {
        if seeds.len() == wanted {
            counters.splats_full.add(1);
            return;
        }
        let i = y * seen.width() + x;
        let matched = seen.depth[i] > 0.0;
        let z = f64::from(if matched { seen.depth[i] } else { rendered_depth(seen, i).unwrap_or_default() });
        let Some(p_world) = seen.view.point(x, y, z) else { return };
        seeds.push(Seed {
            p_world,
            sigma_m: z / seen.view.camera.fx,
            opacity: if matched { initial_opacity(OPACITY_MATCHED, seen.depth_sigma_m[i]) } else { OPACITY_RENDERED },
            pixel: i as u32,
        });
    });
    widen(seeds);
}

fn rendered_depth(seen: &KeyframeView, i: usize) -> Option<f32> {
    let r = seen.rendered;
    (r.alpha[i] >= DEPTH_ALPHA && r.depth[i] > 0.0).then(|| r.depth[i])
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
    use super::super::coverage::tests::{black, seen, H, W};
    use super::*;
    use stipple_drivers::Image;

    #[test]
    fn newcomers_go_where_the_picture_is_wrong_and_to_the_depth_there_is() {
        let image = Image::new(W, H);
        // The lower half has no match; it was rendered 3 m away, but for its left quarter, which is uncovered.
        let depth: Vec<f32> = (0..W * H).map(|i| if i < W * H / 2 { 2.0 } else { 0.0 }).collect();
        let alpha: Vec<f32> = (0..W * H).map(|i| if i % W < W / 4 { 0.1 } else { 0.9 }).collect();
        // Right half wrong.
        let similarity: Vec<f32> = (0..W * H).map(|i| if i % W < W / 2 { 1.0 } else { 0.2 }).collect();
        let mut rendered = black(&alpha);
        rendered.depth.fill(3.0);
        let (v, counters) = (seen(&image, &depth, &rendered), Counters::default());
        let (mut d, mut seeds) = (Diffusion::new(W, H), Vec::with_capacity(500));
        densify(&v, &similarity, 200, &mut d, &mut seeds, &counters);
        assert!((180..=200).contains(&seeds.len()), "{}", seeds.len());
        assert!(seeds.iter().all(|k| k.p_world.x > -0.05));
        assert!(seeds.iter().all(|k| (k.p_world.z - 2.0).abs() < 1e-6 || (k.p_world.z - 3.0).abs() < 1e-6));
        // 1536 px for 200: 2.8 px apart.
        let px = |k: &Seed| k.sigma_m / k.p_world.z * 50.0;
        let mean = seeds.iter().map(px).sum::<f64>() / seeds.len() as f64;
        assert!((0.3 * 2.8..0.7 * 2.8).contains(&mean), "{mean}");
        let uncertain = KeyframeView { depth_sigma_m: &[0.8; W * H], ..v };
        densify(&uncertain, &similarity, 200, &mut d, &mut seeds, &counters);
        let opacity = |k: &Seed| if k.p_world.z < 2.5 { 0.25 * OPACITY_MATCHED } else { OPACITY_RENDERED };
        assert!(seeds.iter().all(|k| (k.opacity - opacity(k)).abs() < 1e-6));
        densify(&v, &[1.0; W * H], 200, &mut d, &mut seeds, &counters);
        assert!(seeds.is_empty());
    }
}
