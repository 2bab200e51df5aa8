//! Which keyframes see which blocks: told by horizons and by samples of the blocks, for all that is known, wherever it is.

use super::archive::{Archive, Block};
use super::filing::BLOCKS_KNOWN;
use super::horizon::{Cells, Horizon, CELLS, COLUMNS, ROWS};
use super::scene::Scene;
use super::view::View;
use glam::{DVec3, Vec3};

/// Part of what is seen in a cell and beside it that may be missing while the cell is still compared. Masking more costs more
/// than the Gaussians that are bent for a while: with 0.1, 0.3 and 0.6 the patrol's first 240 s had 25.6, 26.3 and 26.2 dB.
const AWAY_MAX: f32 = 0.3;

impl Archive {
    /// The block that a keyframe sees most of.
    pub fn home(&self, keyframe: usize) -> Option<usize> {
        let row = &self.sight[keyframe * BLOCKS_KNOWN..][..self.blocks.len()];
        let most = row.iter().copied().max().filter(|n| *n > 0)?;
        row.iter().position(|n| *n == most)
    }

    /// Looks again which blocks a view sees, by its horizon.
    pub fn look_from(&mut self, view: &View, horizon: &Horizon, keyframe: usize) {
        for block in 0..self.blocks.len() {
            self.look(view, horizon, keyframe, block);
        }
    }

    fn look(&mut self, view: &View, horizon: &Horizon, keyframe: usize, block: usize) {
        let b = &self.blocks[block];
        let seen = if b.epoch == view.epoch && in_reach(view, b) {
            b.points().iter().filter(|p| horizon.sees(view, Vec3::from_array(**p).as_dvec3())).count() as u8
        } else {
            0
        };
        self.sight[keyframe * BLOCKS_KNOWN + block] = seen;
    }

    /// The cells of a view that show what is not in the pool, by what their neighbours show, too.
    pub fn hidden_from(&self, view: &View, horizon: &Horizon) -> Cells {
        let seen_by_this = |b: &&Block| b.epoch == view.epoch && b.samples_len > 0 && in_reach(view, b);
        let mut hidden = Cells::default();
        if self.blocks.iter().filter(seen_by_this).all(|b| b.in_pool) {
            return hidden;
        }
        // Gaussians that are here, and away.
        let mut seen = [[0.0f32; 2]; CELLS];
        for b in self.blocks.iter().filter(seen_by_this) {
            let each = b.count as f32 / f32::from(b.samples_len);
            for p in b.points() {
                if let Some(cell) = horizon.may_see(view, Vec3::from_array(*p).as_dvec3()) {
                    seen[cell][usize::from(!b.in_pool)] += each;
                }
            }
        }
        for cell in 0..CELLS {
            let (x, y) = (cell % COLUMNS, cell / COLUMNS);
            let (mut all, mut away) = (0.0, 0.0);
            for cy in y.saturating_sub(1)..(y + 2).min(ROWS) {
                for cx in x.saturating_sub(1)..(x + 2).min(COLUMNS) {
                    let [here, gone] = seen[cy * COLUMNS + cx];
                    (all, away) = (all + here + gone, away + gone);
                }
            }
            if away > AWAY_MAX * all {
                hidden.insert(cell);
            }
        }
        hidden
    }

    /// Looks from every keyframe that is known.
    pub fn look_around(&mut self, scene: &Scene) {
        let cameras = scene.views.cameras();
        for keyframe in 0..self.known.len() {
            let horizon = scene.views.get(keyframe * cameras).horizon;
            self.look_from(&scene.view(keyframe * cameras), &horizon, keyframe);
        }
    }

    /// Looks which keyframes see a block.
    pub fn look_for(&mut self, scene: &Scene, block: usize) {
        let cameras = scene.views.cameras();
        for keyframe in 0..self.known.len().min(scene.views.len() / cameras) {
            let index = keyframe * cameras;
            let horizon = scene.views.get(index).horizon;
            self.look(&scene.view(index), &horizon, keyframe, block);
        }
    }
}

/// Whether a view may see anything of a block: its ball reaches before the camera and into its cone.
fn in_reach(view: &View, b: &Block) -> bool {
    let p: DVec3 = view.world_from_cam.inverse().transform(b.centre.as_dvec3());
    let radius = f64::from(b.radius);
    if view.fisheye.is_some() || p.length() <= radius {
        return true;
    }
    let c = &view.camera;
    let half = |size: usize, f: f64| (size as f64 / 2.0 + 1.0).max(c.cx.max(c.cy).min(size as f64)) / f;
    let cone = half(c.width, c.fx).hypot(half(c.height, c.fy)).atan();
    let off = p.truncate().length().atan2(p.z) - (radius / p.length()).asin();
    off <= cone
}
