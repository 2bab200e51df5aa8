//! Twins of the lists of tiles: project.comp, tile_ranges.comp, fill_lists.comp and sort_lists.comp.

use stipple::gpu::kernels::types::Projected;

/// Nothing nearer is drawn, m: types.glsl.
const NEAR: f32 = 0.05;

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

/// Twin of the walk of project.comp: of every tile, the least a dx² + 2b dx dy + c dy² over its pixel centres'
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

/// Twin of depth_key of tile_depth.glsl.
pub fn depth_key(z: f32) -> u32 {
    ((z.max(NEAR).to_bits() - NEAR.to_bits()) >> 11).min(0xffff)
}

/// Twin of sort_lists.comp: slots in the order of depth and then of slots.
pub fn sorted(all: impl IntoIterator<Item = (u32, Projected)>) -> Vec<u32> {
    let mut order: Vec<(u32, u32)> = all.into_iter().map(|(slot, g)| (depth_key(g.conic_shade[3]), slot)).collect();
    order.sort_unstable();
    order.into_iter().map(|(_, slot)| slot).collect()
}
