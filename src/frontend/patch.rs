//! Patch alignment: inverse-compositional SE(2) on mean-normalised patches, coarse to fine.
//!
//! A template is taken once, upright, at a point of one image; alignment moves and rotates it over
//! another image until the two agree (Baker and Matthews, IJCV 2004). Dividing a patch by its mean
//! makes the residual blind to exposure and gain.
//!
//! ```text
//! d_i = I_i / m, m = mean I            values of the template
//! J_i = (g_i - d_i mean(g)) / m        g_i = ∇I_i [1 0 -y_i; 0 1 x_i], the mean moves too
//! r_i = I'(T o_i) / mean I' - d_i      inc = -(JᵀJ)⁻¹ Jᵀ r      T <- T exp(inc)
//! ```
//!
//! Offsets o_i sit on half pixels: 52 of them (thirteen vectors of four) fill a disc of radius 4.
//! A template is upright, so its pixels share one bilinear fraction. Its gradients are central differences of
//! the 8-bit pixels, interpolated in 16 bits, a row of eight to a vector register; they only say which way to
//! go, and where the residual vanishes is left to the values, which are not rounded.

use super::pattern::{gradients, pixels_around, values, ALL, DX, DY, FRACTION, N, RUNS};
use super::pyramid::Levels;
use crate::limits::PYRAMID_LEVELS;
use crate::math::wide::wide;
use stipple_drivers::Image;

/// No offset is longer (3.5² + 1.5² = 14.5 = 3.81²), px.
const RADIUS: f32 = 3.9;

/// A level is left when its step is below this, px of the level. Coarse levels only need to hand on
/// a guess inside the next basin.
pub const STEP_MIN: f32 = 0.02;
const STEP_MIN_COARSE: f32 = 0.1;
/// A step this long has left the basin, px.
const STEP_MAX: f32 = 10.0;

/// Place and rotation of a patch: (x, y) + [c -s; s c] o.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct Warp {
    pub x: f32,
    pub y: f32,
    pub c: f32,
    pub s: f32,
}

impl Warp {
    /// At a pixel, not rotated.
    pub fn upright(px: [f32; 2]) -> Warp {
        Warp { x: px[0], y: px[1], c: 1.0, s: 0.0 }
    }

    /// Its place.
    pub fn px(&self) -> [f32; 2] {
        [self.x, self.y]
    }

    /// The warp on a coarser level.
    pub fn at_level(&self, level: usize) -> Warp {
        let k = 1.0 / (1 << level) as f32;
        Warp { x: self.x * k, y: self.y * k, ..*self }
    }

    fn at_full(&self, level: usize) -> Warp {
        let k = (1 << level) as f32;
        Warp { x: self.x * k, y: self.y * k, ..*self }
    }

    /// T <- T exp(inc), to first order in translation; the rotation stays orthonormal.
    fn step(&mut self, inc: [f32; 3]) {
        self.x += self.c * inc[0] - self.s * inc[1];
        self.y += self.s * inc[0] + self.c * inc[1];
        self.rotate(1.0, inc[2]);
    }

    /// Rotates further by the direction (c, s), which need not be of unit length.
    pub fn rotate(&mut self, c: f32, s: f32) {
        let (tc, ts) = (self.c * c - self.s * s, self.s * c + self.c * s);
        let n = 1.0 / (tc * tc + ts * ts).sqrt();
        (self.c, self.s) = (tc * n, ts * n);
    }
}

/// What alignment to one patch of one image needs.
#[derive(Clone, Copy)]
pub struct Template {
    /// I/mean; 0 outside the image.
    value: [f32; N],
    /// (JᵀJ)⁻¹Jᵀ
    gain: [[f32; N]; 3],
    /// Σ(value - 1)²
    contrast: f32,
    /// Standard deviation of the aligned place for one grey level of image noise, px.
    pub sigma_px: f32,
    /// Bit i: offset i was inside the image. 0: not usable.
    inside: u64,
}

impl Default for Template {
    fn default() -> Self {
        Template { value: [0.0; N], gain: [[0.0; N]; 3], contrast: 0.0, sigma_px: 0.0, inside: 0 }
    }
}

impl Template {
    /// Whether there was enough contrast to align to.
    pub fn usable(&self) -> bool {
        self.inside != 0
    }

    /// Takes the patch at a pixel of a level.
    pub fn take(&mut self, image: &Image, x: f32, y: f32) {
        take(self, image, x, y);
    }

    /// Moves `warp` (pixels of this level) onto the template. Answers what share of the template's
    /// contrast was left unexplained before the last step, or `None` when it slid off.
    pub fn align(&self, image: &Image, warp: &mut Warp, iterations: usize, step_min: f32) -> Option<f32> {
        align(self, image, warp, iterations, step_min)
    }

    /// Σr²/contrast at a warp. `None` unless more than half of the pattern is in both images.
    pub fn unexplained(&self, image: &Image, warp: &Warp) -> Option<f32> {
        unexplained(self, image, warp)
    }

    /// r_i, and as above. The block, where there is one, holds the warp.
    #[inline(always)]
    fn difference(&self, image: &Image, block: Option<&Block>, warp: &Warp, r: &mut [f32; N]) -> Option<f32> {
        let mut inside = self.inside;
        match block {
            Some(block) => block.sample(warp, r),
            None => inside &= sample(image, warp, r),
        }
        if inside.count_ones() <= N as u32 / 2 {
            return None;
        }
        // Both means over the same pixels; the template's is 1 over its own.
        let (mut mean, mut own) = (sum(r) / N as f32, 1.0);
        if inside != ALL {
            let count = inside.count_ones() as f32;
            let over = |v: &[f32; N]| (0..N).filter(|k| inside >> k & 1 == 1).map(|k| v[k]).sum::<f32>() / count;
            (mean, own) = (over(r), over(&self.value));
        }
        if !(mean > 1.0 && own > 0.0) {
            return None;
        }
        let (scale, own) = (1.0 / mean, 1.0 / own);
        for k in 0..N {
            r[k] = r[k] * scale - self.value[k] * own;
        }
        if inside != ALL {
            for (k, r) in r.iter_mut().enumerate() {
                if inside >> k & 1 == 0 {
                    *r = 0.0;
                }
            }
        }
        Some(dot(r, r) / self.contrast)
    }
}

wide! {
    fn take<'a>(template: &'a mut Template, image: &'a Image, x: f32, y: f32) -> () {
        template.inside = 0;
        if !(x >= 0.0 && y >= 0.0 && x <= (image.width - 1) as f32 && y <= (image.height - 1) as f32) {
            return;
        }
        let Some((pixels, [fx, fy], inside)) = pixels_around(image, x, y) else { return };
        let mut g = [[0f32; N]; 3];
        let mut g_mean = [0f32; 3];
        let on = weights(inside);
        let value = values(&pixels, fx, fy);
        let [gx, gy] = gradients(&pixels, fx, fy).map(|g| g.map(|row| row.map(|v| 0.5 / FRACTION * f32::from(v))));
        let [g0, g1, _] = &mut g;
        let mut k = 0;
        for (j, (from, run)) in RUNS.into_iter().enumerate() {
            for (out, row) in [(&mut template.value, &value[j]), (&mut *g0, &gx[j]), (&mut *g1, &gy[j])] {
                out[k..k + run].copy_from_slice(&row[from..from + run]);
            }
            k += run;
        }
        if inside != ALL {
            for k in 0..N {
                template.value[k] *= on[k];
                g[0][k] *= on[k];
                g[1][k] *= on[k];
            }
        }
        for k in 0..N {
            g[2][k] = DX[k] * g[1][k] - DY[k] * g[0][k];
        }
        let count = inside.count_ones() as f32;
        let mean = sum(&template.value) / count;
        if !(mean > 1.0) {
            return; // black: a ratio of noise
        }
        for a in 0..3 {
            g_mean[a] = sum(&g[a]) / count;
        }
        let scale = 1.0 / mean;
        let mut spread = [0f32; N];
        for k in 0..N {
            template.value[k] *= scale;
            spread[k] = on[k] * (template.value[k] - 1.0);
            for a in 0..3 {
                g[a][k] = on[k] * (g[a][k] - template.value[k] * g_mean[a]) * scale;
            }
        }
        template.contrast = dot(&spread, &spread);
        let Some(inv) = invert_normal(&g) else { return };
        for a in 0..3 {
            for k in 0..N {
                template.gain[a][k] = inv[a][0] * g[0][k] + inv[a][1] * g[1][k] + inv[a][2] * g[2][k];
            }
        }
        template.sigma_px = (inv[0][0] + inv[1][1]).sqrt() / mean;
        template.inside = inside;
    }
}

wide! {
    fn unexplained<'a>(template: &'a Template, image: &'a Image, warp: &'a Warp) -> Option<f32> {
        let block = Block::around(image, warp.x, warp.y);
        template.difference(image, block.as_ref(), warp, &mut [0f32; N])
    }
}

wide! {
    fn align<'a>(
        template: &'a Template,
        image: &'a Image,
        warp: &'a mut Warp,
        iterations: usize,
        step_min: f32,
    ) -> Option<f32> {
        let mut left = f32::MAX;
        let mut block: Option<Block> = None;
        let mut r = [0f32; N];
        for _ in 0..iterations {
            if !block.as_ref().is_some_and(|b| b.holds(warp)) {
                block = Block::around(image, warp.x, warp.y);
            }
            left = template.difference(image, block.as_ref(), warp, &mut r)?;
            let mut inc = [0f32; 3];
            for a in 0..3 {
                inc[a] = -dot(&template.gain[a], &r);
            }
            let length = inc[0].abs().max(inc[1].abs()).max(RADIUS * inc[2].abs());
            if !(length < STEP_MAX) {
                return None;
            }
            warp.step(inc);
            if length < step_min {
                break;
            }
        }
        Some(left)
    }
}

/// Templates of all levels at one point.
pub type Stack = [Template; PYRAMID_LEVELS];

/// Takes some of the levels: `levels` of both.
pub fn take_stack(stack: &mut Stack, from: &Levels, px: [f32; 2], levels: std::ops::Range<usize>) {
    for (l, t) in stack.iter_mut().enumerate().take(levels.end).skip(levels.start) {
        let k = 1.0 / (1 << l) as f32;
        t.take(from[l], px[0] * k, px[1] * k);
    }
}

/// Aligns from level `coarsest` down to the full image. A coarse level that cannot be aligned
/// leaves the guess to the next; the last must succeed.
pub fn align_stack(
    stack: &[Template],
    to: &Levels,
    start: Warp,
    coarsest: usize,
    iterations: usize,
    step_min: f32,
) -> Option<(Warp, f32)> {
    let mut warp = start;
    for l in (1..=coarsest).rev() {
        let mut w = warp.at_level(l);
        if stack[l].usable() && stack[l].align(to[l], &mut w, iterations, STEP_MIN_COARSE).is_some() {
            warp = w.at_full(l);
        }
    }
    let left = stack[0].usable().then(|| stack[0].align(to[0], &mut warp, 2 * iterations, step_min))??;
    Some((warp, left))
}

/// Sums in four lanes: the order is fixed, and the compiler may use vectors.
#[inline(always)]
fn dot(a: &[f32; N], b: &[f32; N]) -> f32 {
    let mut s = [0f32; 4];
    for (a, b) in a.chunks_exact(4).zip(b.chunks_exact(4)) {
        for i in 0..4 {
            s[i] += a[i] * b[i];
        }
    }
    (s[0] + s[1]) + (s[2] + s[3])
}

#[inline(always)]
fn sum(a: &[f32; N]) -> f32 {
    dot(a, &[1.0; N])
}

/// (JᵀJ)⁻¹ of three columns, by cofactors in f64; `None` when nearly singular.
#[inline(always)]
fn invert_normal(j: &[[f32; N]; 3]) -> Option<[[f32; 3]; 3]> {
    let mut h = [0.0; 6];
    for (h, (a, b)) in h.iter_mut().zip([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]) {
        *h = f64::from(dot(&j[a], &j[b]));
    }
    let [xx, xy, xt, yy, yt, tt] = h;
    let c = [
        [yy * tt - yt * yt, xt * yt - xy * tt, xy * yt - xt * yy],
        [xt * yt - xy * tt, xx * tt - xt * xt, xy * xt - xx * yt],
        [xy * yt - xt * yy, xy * xt - xx * yt, xx * yy - xy * xy],
    ];
    let det = xx * c[0][0] + xy * c[0][1] + xt * c[0][2];
    // Relative to the product of the diagonal, which bounds it from above (Hadamard).
    if !(det > 1e-6 * xx * yy * tt && det.is_finite()) {
        return None;
    }
    let inv = c.map(|row| row.map(|v| (v / det) as f32));
    inv.iter().flatten().all(|v| v.is_finite()).then_some(inv)
}

/// 1 for the offsets that were inside, 0 for the others.
#[inline(always)]
fn weights(inside: u64) -> [f32; N] {
    let mut on = [1.0; N];
    if inside != ALL {
        (0..N).for_each(|k| on[k] = (inside >> k & 1) as f32);
    }
    on
}

/// The neighbourhood of a patch: the part of an image that alignment reads while it moves the patch by
/// up to three pixels. Its size is known to the compiler, so that samples are fetched unchecked.
struct Block {
    pixels: [u8; BLOCK * (BLOCK + 2)],
    left: f32,
    top: f32,
}

const BLOCK: usize = 16;
/// Least distance of a sample from the end of the block, px: its neighbour, and a pixel for rounding.
const REACH: f32 = RADIUS + 1.0;
/// 2^23: adding it to a float leaves no bits for a fraction.
const ROUND: f32 = 8388608.0;

impl Block {
    /// Around a place; `None` where it does not lie within the image.
    #[inline(always)]
    fn around(image: &Image, x: f32, y: f32) -> Option<Block> {
        let (left, top) = ((x - 0.5 * BLOCK as f32).round(), (y - 0.5 * BLOCK as f32).round());
        let (right, bottom) = (image.width as f32 - BLOCK as f32, image.height as f32 - BLOCK as f32);
        if !(left >= 0.0 && top >= 0.0 && left <= right && top <= bottom) {
            return None;
        }
        let mut pixels = [0; BLOCK * (BLOCK + 2)];
        let from = top as usize * image.width + left as usize;
        for (j, row) in pixels.chunks_exact_mut(BLOCK).take(BLOCK).enumerate() {
            row.copy_from_slice(&image.pixels[from + j * image.width..][..BLOCK]);
        }
        Some(Block { pixels, left, top })
    }

    #[inline(always)]
    fn holds(&self, warp: &Warp) -> bool {
        let within = |v: f32| v >= REACH && v <= (BLOCK - 1) as f32 - REACH;
        within(warp.x - self.left) && within(warp.y - self.top)
    }

    /// Bilinear samples at the warped offsets.
    #[inline(always)]
    fn sample(&self, warp: &Warp, out: &mut [f32; N]) {
        let (cx, cy) = (warp.x - self.left, warp.y - self.top);
        let (mut fx, mut fy, mut at) = ([0f32; N], [0f32; N], [0u32; N]);
        for k in 0..N {
            let x = cx + (warp.c * DX[k] - warp.s * DY[k]);
            let y = cy + (warp.s * DX[k] + warp.c * DY[k]);
            // Adding 2^23 to x - 1/2 rounds it down to an integer in the low bits, in vectors.
            let (i, j) = (x - 0.5 + ROUND, y - 0.5 + ROUND);
            (fx[k], fy[k]) = (x - (i - ROUND), y - (j - ROUND));
            at[k] = (j.to_bits() & 15) * BLOCK as u32 + (i.to_bits() & 15);
        }
        let mut quad = [0u32; N];
        for k in 0..N {
            let q = at[k] as usize % (BLOCK * BLOCK);
            let pair = |q: usize| u16::from_le_bytes([self.pixels[q], self.pixels[q + 1]]) as u32;
            quad[k] = pair(q) | pair(q + BLOCK) << 16;
        }
        for k in 0..N {
            let byte = |n: u32| ((quad[k] >> n) & 255) as i32 as f32;
            let (a, b, c, d) = (byte(0), byte(8), byte(16), byte(24));
            let (top, bottom) = (a + fx[k] * (b - a), c + fx[k] * (d - c));
            out[k] = top + fy[k] * (bottom - top);
        }
    }
}

/// Bilinear samples at the warped offsets near the border; answers which were inside.
#[inline(always)]
fn sample(image: &Image, warp: &Warp, out: &mut [f32; N]) -> u64 {
    let w = image.width;
    let (right, bottom) = ((w - 1) as f32, (image.height - 1) as f32);
    let mut inside = 0;
    for k in 0..N {
        let x = warp.x + (warp.c * DX[k] - warp.s * DY[k]);
        let y = warp.y + (warp.s * DX[k] + warp.c * DY[k]);
        if x >= 0.0 && y >= 0.0 && x < right && y < bottom {
            let (i, j) = (x as usize, y as usize);
            out[k] = bilinear(&image.pixels[j * w + i..], w, x - i as f32, y - j as f32);
            inside |= 1 << k;
        }
    }
    inside
}

#[inline(always)]
fn bilinear(q: &[u8], stride: usize, fx: f32, fy: f32) -> f32 {
    let q = &q[..stride + 2];
    let (a, b, c, d) = (q[0] as f32, q[1] as f32, q[stride] as f32, q[stride + 1] as f32);
    let (top, bottom) = (a + fx * (b - a), c + fx * (d - c));
    top + fy * (bottom - top)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::pyramid::Pyramid;
    use super::*;

    /// Smooth in every direction at every level: wavelengths of 9 to 60 px.
    fn smooth(x: f64, y: f64) -> f64 {
        let wave = |kx: f64, ky: f64, phase: f64| (x * kx + y * ky + phase).sin();
        let fine = wave(0.5, 0.3, 0.1) + wave(-0.25, 0.55, 1.7);
        let coarse = wave(0.17, -0.09, 0.4) + wave(0.06, 0.14, 2.2) + wave(-0.1, 0.08, 5.0);
        120.0 + 16.0 * fine + 20.0 * coarse
    }

    /// The image in which the patch at (60, 50) appears at `place`, rotated by `angle`, `gain` times as bright.
    fn moved(place: [f64; 2], angle: f64, gain: f64) -> (Image, Pyramid) {
        let mut image = Image::new(128, 104);
        let (s, c) = angle.sin_cos();
        for v in 0..image.height {
            for u in 0..image.width {
                let (x, y) = (u as f64 - place[0], v as f64 - place[1]);
                let value = smooth(60.0 + c * x + s * y, 50.0 - s * x + c * y);
                image.pixels[v * image.width + u] = (gain * value).round().clamp(0.0, 255.0) as u8;
            }
        }
        let mut pyramid = Pyramid::new(image.width, image.height);
        pyramid.build(&image);
        (image, pyramid)
    }

    fn levels((image, pyramid): &(Image, Pyramid)) -> Levels<'_> {
        pyramid.over(image)
    }

    fn follow(place: [f64; 2], angle: f64, gain: f64) -> (Warp, f32) {
        let mut stack = Stack::default();
        take_stack(&mut stack, &levels(&moved([60.0, 50.0], 0.0, 1.0)), [60.0, 50.0], 0..PYRAMID_LEVELS);
        let target = moved(place, angle, gain);
        align_stack(&stack, &levels(&target), Warp::upright([60.0, 50.0]), PYRAMID_LEVELS - 1, 5, STEP_MIN).unwrap()
    }

    #[test]
    fn sub_pixel_translations_and_rotations_are_recovered() {
        for (dx, dy, angle) in
            [(0.0, 0.0, 0.0), (0.37, -0.81, 0.0), (5.3, 3.6, 0.05), (-9.2, 6.1, -0.1), (2.5, 2.5, 0.2)]
        {
            let (warp, left) = follow([60.0 + dx, 50.0 + dy], angle, 1.0);
            let error = (warp.x as f64 - 60.0 - dx).hypot(warp.y as f64 - 50.0 - dy);
            let rotation = (warp.s as f64).atan2(warp.c as f64) - angle;
            assert!(error < 0.05 && rotation.abs() < 0.01, "({dx}, {dy}, {angle}): {error} px, {rotation} rad");
            assert!(left < 0.01, "{left}");
        }
    }

    #[test]
    fn gain_changes_nothing() {
        let (plain, _) = follow([63.4, 48.9], 0.03, 1.0);
        for gain in [0.4, 1.3] {
            let (warp, _) = follow([63.4, 48.9], 0.03, gain);
            assert!((warp.x - plain.x).hypot(warp.y - plain.y) < 0.03, "gain {gain}");
        }
    }

    #[test]
    fn a_patch_cut_by_the_border_still_aligns() {
        let (a, b) = (moved([60.0, 50.0], 0.0, 1.0), moved([60.4, 50.3], 0.0, 1.0));
        let mut stack = Stack::default();
        let b = levels(&b);
        take_stack(&mut stack, &levels(&a), [2.0, 30.0], 0..PYRAMID_LEVELS);
        let (warp, _) = align_stack(&stack, &b, Warp::upright([2.0, 30.0]), PYRAMID_LEVELS - 1, 5, STEP_MIN).unwrap();
        assert!((warp.x - 2.4).hypot(warp.y - 30.3) < 0.1, "{warp:?}");
        assert!(stack[0].unexplained(b[0], &Warp::upright([-1.0, 30.0])).is_none());
        assert!(stack[0].unexplained(b[0], &Warp::upright([f32::NAN, 30.0])).is_none());
    }

    #[test]
    fn flat_black_or_one_dimensional_patches_are_refused() {
        let fill = |f: fn(usize) -> u8| {
            let mut image = Image::new(40, 40);
            (0..1600).for_each(|k| image.pixels[k] = f(k % 40));
            let mut template = Template::default();
            template.take(&image, 20.0, 20.0);
            template.usable()
        };
        assert!(!fill(|_| 80));
        assert!(!fill(|_| 0));
        assert!(!fill(|x| (6 * x) as u8));
    }
}
