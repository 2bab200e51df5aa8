//! Twins of count_tiles.comp, emit_tiles.comp, tile_ranges.comp and summary.comp.

/// A Gaussian on the image: centre (half-integer pixel centres), conic a, b, c, opacity.
pub type Ellipse = [f64; 6];

/// Tiles in the order of their index.
#[derive(Clone, Copy)]
pub struct Grid {
    pub width: usize,
    pub height: usize,
    pub tile: [usize; 2],
}

impl Grid {
    pub fn columns(&self) -> usize {
        self.width.div_ceil(self.tile[0])
    }

    pub fn rows(&self) -> usize {
        self.height.div_ceil(self.tile[1])
    }
}

/// Twin of count_tiles.comp and emit_tiles.comp: of every tile, the least a dx² + 2b dx dy + c dy² over its pixel centres'
/// rectangle, over the level the kernels list up to: below 1 it is listed.
pub fn touched(e: &Ellipse, g: &Grid) -> Vec<f64> {
    let [x, y, a, b, c, opacity] = *e;
    let level = 2.0 * (opacity * 255.0).ln() * 1.001 + 0.001;
    let value = |dx: f64, dy: f64| a * dx * dx + 2.0 * b * dx * dy + c * dy * dy;
    let mut out = Vec::new();
    for row in 0..g.rows() {
        for column in 0..g.columns() {
            let side = |i: usize, n: usize, at: f64| ((i * n) as f64 + 0.5 - at, ((i + 1) * n) as f64 - 0.5 - at);
            let ((x0, x1), (y0, y1)) = (side(column, g.tile[0], x), side(row, g.tile[1], y));
            let least = if x0 <= 0.0 && x1 >= 0.0 && y0 <= 0.0 && y1 >= 0.0 {
                0.0
            } else {
                let across = [y0, y1].map(|dy| value((-b * dy / a).clamp(x0, x1), dy));
                let along = [x0, x1].map(|dx| value(dx, (-b * dx / c).clamp(y0, y1)));
                across.into_iter().chain(along).fold(f64::INFINITY, f64::min)
            };
            out.push(least / level);
        }
    }
    out
}

/// Twin of tile_ranges.comp.
pub fn tile_ranges(keys: &[u32], tiles: usize) -> Vec<[u32; 2]> {
    let mut out = vec![[0; 2]; tiles];
    for (tile, range) in out.iter_mut().enumerate() {
        let first = keys.partition_point(|k| (*k as usize) < tile);
        let end = keys.partition_point(|k| (*k as usize) <= tile);
        if end > first {
            *range = [first as u32, end as u32];
        }
    }
    out
}

/// Twin of summary.comp: sums of SSIM; of |x - y| and the exposure's gradient; of the pose terms and what was refused.
pub fn summary(ssim: &[f32], loss: &[[f32; 4]], pose: &[[f32; 8]]) -> (f64, [f64; 3], [f64; 7]) {
    let of = |k: usize| loss.iter().map(|l| f64::from(l[k])).sum();
    let terms = std::array::from_fn(|k| pose.iter().map(|p| f64::from(p[k])).sum());
    (ssim.iter().map(|s| f64::from(*s)).sum(), [of(0), of(1), of(2)], terms)
}
