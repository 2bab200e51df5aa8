//! The pattern of a patch and what a template takes at its offsets: values and gradients of the image.
//!
//! Offsets sit on half pixels: 52 of them (thirteen vectors of four) fill a disc of radius 4.

use stipple_drivers::Image;

/// Offsets of the pattern.
pub(super) const N: usize = 52;
pub(super) const SIDE: usize = 8;
/// Pattern, one pixel more on every side for the differences.
pub(super) const GRID: usize = SIDE + 2;
/// Pixels around a template: the grid, and one more for the bilinear neighbours.
pub(super) type Pixels = [[i16; GRID + 1]; GRID + 1];
/// Steps of an interpolated gradient in one grey: 255·64 fits 16 bits.
pub(super) const FRACTION: f32 = 64.0;
/// Grid index of each offset; the offset is `index - GRID/2 + 1/2`.
pub(super) const PATTERN: [[usize; 2]; N] = pattern();
pub(super) const DX: [f32; N] = offsets(0);
pub(super) const DY: [f32; N] = offsets(1);
/// All offsets are inside.
pub(super) const ALL: u64 = (1 << N) - 1;

/// First pixel and length of the pattern's run in each row of its square.
pub(super) const RUNS: [(usize, usize); SIDE] = runs();

const fn runs() -> [(usize, usize); SIDE] {
    let mut runs = [(0, 0); SIDE];
    let mut k = 0;
    while k < N {
        let [x, y] = PATTERN[k];
        if runs[y - 1].1 == 0 {
            runs[y - 1].0 = x - 1;
        }
        runs[y - 1].1 += 1;
        k += 1;
    }
    runs
}

const fn pattern() -> [[usize; 2]; N] {
    let mut p = [[0; 2]; N];
    let (mut n, mut k) = (0, 0);
    while k < SIDE * SIDE {
        let (x, y) = (2 * (k % SIDE) as i32 - 7, 2 * (k / SIDE) as i32 - 7); // twice the offset
        if x * x + y * y < 64 {
            p[n] = [k % SIDE + 1, k / SIDE + 1];
            n += 1;
        }
        k += 1;
    }
    assert!(n == N);
    p
}

const fn offsets(axis: usize) -> [f32; N] {
    let mut o = [0.0; N];
    let mut k = 0;
    while k < N {
        o[k] = PATTERN[k][axis] as f32 - (GRID as f32 - 1.0) / 2.0;
        k += 1;
    }
    o
}

/// Pixels around a point inside the image, the bilinear fraction of the samples among them, and which offsets
/// (with their four neighbours) lie inside it. `None` when half of them or more do not.
#[inline(always)]
pub(super) fn pixels_around(image: &Image, x: f32, y: f32) -> Option<(Pixels, [f32; 2], u64)> {
    let half = (GRID as f32 - 1.0) / 2.0;
    let (left, top) = ((x - half).floor(), (y - half).floor());
    let fraction = [x - half - left, y - half - top];
    let (left, top) = (left as isize, top as isize);
    let (w, h) = (image.width as isize, image.height as isize);
    let whole = left >= 0 && top >= 0 && left + (GRID as isize) < w && top + (GRID as isize) < h;
    let mut pixels = [[0i16; GRID + 1]; GRID + 1];
    for (j, row) in pixels.iter_mut().enumerate() {
        let line = (top + j as isize).clamp(0, h - 1) as usize * image.width;
        if whole {
            let from = line + left as usize;
            for (v, p) in row.iter_mut().zip(&image.pixels[from..from + GRID + 1]) {
                *v = i16::from(*p);
            }
        } else {
            for (i, v) in row.iter_mut().enumerate() {
                *v = i16::from(image.pixels[line + (left + i as isize).clamp(0, w - 1) as usize]);
            }
        }
    }
    let mut inside = ALL;
    if !whole {
        let ok = |at: isize, n: isize| at >= 0 && at + 1 < n;
        for (k, [i, j]) in PATTERN.iter().enumerate() {
            let (i, j) = (left + *i as isize, top + *j as isize);
            if !(ok(i - 1, w) && ok(i + 1, w) && ok(j - 1, h) && ok(j + 1, h)) {
                inside &= !(1 << k);
            }
        }
        if inside.count_ones() <= N as u32 / 2 {
            return None;
        }
    }
    Some((pixels, fraction, inside))
}

/// Bilinear samples of the pattern's square.
#[inline(always)]
pub(super) fn values(pixels: &Pixels, fx: f32, fy: f32) -> [[f32; SIDE]; SIDE] {
    let (w00, w10, w01, w11) = ((1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy);
    let mut out = [[0.0; SIDE]; SIDE];
    for (j, out) in out.iter_mut().enumerate() {
        let (row, below) = (pixels[j + 1].map(f32::from), pixels[j + 2].map(f32::from));
        for i in 0..SIDE {
            out[i] = w00 * row[i + 1] + w10 * row[i + 2] + w01 * below[i + 1] + w11 * below[i + 2];
        }
    }
    out
}

/// Twice the gradient by x and by y at the samples of the pattern's square, in 1/FRACTION grey a pixel.
#[inline(always)]
pub(super) fn gradients(pixels: &Pixels, fx: f32, fy: f32) -> [[[i16; SIDE]; SIDE]; 2] {
    let whole = |v: f32| (v * FRACTION).round() as i16;
    let (x, y, w11) = (whole(fx), whole(fy), whole(fx * fy));
    let (w10, w01) = (x - w11, y - w11);
    let w00 = whole(1.0) - w10 - w01 - w11;
    let mut g = [[[0; SIDE]; SIDE]; 2];
    for j in 0..SIDE {
        let rows = [&pixels[j], &pixels[j + 1], &pixels[j + 2], &pixels[j + 3]];
        for i in 0..SIDE {
            // By x and by y at column i + k of row j + n of the pattern's grid.
            let dx = |n: usize, k: usize| rows[n + 1][i + k + 2] - rows[n + 1][i + k];
            let dy = |n: usize, k: usize| rows[n + 2][i + k + 1] - rows[n][i + k + 1];
            g[0][j][i] = w00 * dx(0, 0) + w10 * dx(0, 1) + w01 * dx(1, 0) + w11 * dx(1, 1);
            g[1][j][i] = w00 * dy(0, 0) + w10 * dy(0, 1) + w01 * dy(1, 0) + w11 * dy(1, 1);
        }
    }
    g
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sixteen_bit_gradients_are_those_of_the_samples() {
        // Black and white pixels at every phase are the largest a sum can get.
        for case in 0..3 * 33 * 33 {
            let (fx, fy) = ((case % 33) as f32 / 33.0, (case / 33 % 33) as f32 / 33.0);
            let pixel = |i: usize, j: usize| match case / (33 * 33) {
                0 => 255 * ((i / 2 + j / 2) % 2) as i16,
                1 => 255 * (i / 2 % 2) as i16,
                _ => (i * i * 37 + j * 91 + i * j * 53) as i16 % 256,
            };
            let pixels: Pixels = std::array::from_fn(|j| std::array::from_fn(|i| pixel(i, j)));
            let at = |i: usize, j: usize| {
                let p = |i: usize, j: usize| f32::from(pixel(i, j));
                let (top, bottom) =
                    (p(i, j) + fx * (p(i + 1, j) - p(i, j)), p(i, j + 1) + fx * (p(i + 1, j + 1) - p(i, j + 1)));
                top + fy * (bottom - top)
            };
            let [gx, gy] = gradients(&pixels, fx, fy);
            for (j, i) in (0..SIDE).flat_map(|j| (0..SIDE).map(move |i| (j, i))) {
                let exact = [at(i + 2, j + 1) - at(i, j + 1), at(i + 1, j + 2) - at(i + 1, j)];
                for (g, exact) in [gx[j][i], gy[j][i]].into_iter().zip(exact) {
                    // Weights are off by a half, one, one and one and a half steps at most.
                    assert!((f32::from(g) / FRACTION - exact).abs() <= 4.0 * 255.0 / FRACTION, "{g} {exact}");
                }
            }
        }
    }
}
