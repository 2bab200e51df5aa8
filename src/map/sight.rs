//! Which keyframes see which blocks: told by horizons and by samples of the blocks, for all that is known, wherever it is.

use super::archive::{Archive, Block};
use super::horizon::{Absent, Horizon, CELLS, COLUMNS, ROWS, SIGMAS};
use super::scene::Scene;
use super::seen::Sight;
use super::view::View;
use glam::DVec3;
use stipple_drivers::Pose;

/// Part of what is seen in a cell and beside it that may be missing while the cell is still compared. With 0.2, 0.3, 0.4 and 0.7
/// the first 240 s of the patrol had 27.9, 27.9, 27.8 and 27.6 dB in training, 24.5, 24.6, 24.7 and 24.5 held out.
const AWAY_MAX: f32 = 0.3;
/// Part of it above which the image stands in for what is missing. Held out, the same flight had 24.1 and 24.4 dB without, in two
/// runs, and 24.7, 24.6 and 24.5 dB with 0.02, 0.05 and 0.1.
const AWAY_FILLED: f32 = 0.05;

/// σ in a picture, over the picture's width, of a Gaussian that counts as one, and how many the largest may count as.
const SIZE_ONE: f64 = 0.015;
const SIZE_MAX: f64 = 4.0;
/// The blocks that a keyframe sees, and the Gaussians that it sees of them, by their samples and how large they are in it.
pub fn seen_by<'a>(sight: &'a Sight, blocks: &'a [Block], keyframe: usize) -> impl Iterator<Item = (usize, f32)> + 'a {
    let of_it = sight.of(keyframe).iter().map(|seen| (usize::from(seen.block), seen.samples()));
    // A block without samples was damaged on the disk.
    let known = of_it.filter(|(block, _)| blocks[*block].samples_len > 0);
    known.map(|(block, samples)| {
        let b = &blocks[block];
        (block, samples * b.count as f32 / f32::from(b.samples_len))
    })
}

impl Archive {
    /// Looks anew at the keyframes of which what they see, or a block of that, has changed: how much of it is in the pool, and
    /// which block is their home.
    pub fn look_at_changed(&mut self) {
        while let Some(keyframe) = self.sight.next_changed() {
            let (mut all, mut away, mut most) = (0.0, 0.0, (0.0, None));
            for (block, seen) in seen_by(&self.sight, &self.blocks, keyframe) {
                let b = &self.blocks[block];
                all += seen;
                away += if b.in_pool { 0.0 } else { seen };
                if seen > most.0 {
                    most = (seen, Some(b.anchor));
                }
            }
            let Some(known) = self.known.get_mut(keyframe) else { continue };
            known.away = if away > 0.0 { away / all } else { 0.0 };
            (known.home, known.absent_found) = (most.1, false);
        }
    }

    /// Looks again which blocks a view sees, by its horizon.
    pub fn look_from(&mut self, view: &View, horizon: &Horizon, keyframe: usize) {
        self.sight.clear(keyframe);
        let eye = Eye::new(view);
        for block in 0..self.blocks.len() {
            let seen = eye.seen_of(&self.blocks[block], horizon);
            if seen > 0.0 {
                self.sight.set(keyframe, block, seen);
            }
        }
    }

    /// The cells of a view that show what of some blocks is not in the pool, by what their neighbours show, too; `None` where it
    /// shows nothing of that.
    pub fn absent_from(
        &self,
        view: &View,
        horizon: &Horizon,
        blocks: impl Iterator<Item = usize> + Clone,
    ) -> Option<Absent> {
        if blocks.clone().all(|block| self.blocks[block].in_pool) {
            return None;
        }
        // Gaussians that are here, and away.
        let (mut seen, eye) = ([[0.0f32; 2]; CELLS], Eye::new(view));
        for b in blocks.map(|block| &self.blocks[block]) {
            let each = b.count as f32 / f32::from(b.samples_len.max(1));
            for p in b.samples() {
                if let Some((cell, size)) = eye.sees(horizon, *p) {
                    seen[cell][usize::from(!b.in_pool)] += each * size;
                }
            }
        }
        let mut absent = seen.iter().any(|[_, away]| *away > 0.0).then(Absent::default)?;
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
                absent.hidden.insert(cell);
            }
            if away > AWAY_FILLED * all {
                absent.filled.insert(cell);
            }
        }
        Some(absent)
    }

    /// The blocks of which a view may see something.
    pub fn in_reach<'a>(&'a self, view: &'a View) -> impl Iterator<Item = usize> + Clone + 'a {
        let eye = Eye::new(view);
        let reached = move |b: &Block| b.samples_len > 0 && eye.may_see(b);
        self.blocks.iter().enumerate().filter(move |(_, b)| reached(b)).map(|(block, _)| block)
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
            let seen = Eye::new(&scene.view(index)).seen_of(&self.blocks[block], &horizon);
            self.sight.set(keyframe, block, seen);
        }
    }
}

/// A view that is looked from, with what is the same for every point.
#[derive(Clone, Copy)]
struct Eye<'a> {
    view: &'a View,
    cam_from_world: Pose,
    /// Half the angle of a cone around the picture, rad.
    cone: f64,
}

impl<'a> Eye<'a> {
    fn new(view: &'a View) -> Eye<'a> {
        let c = &view.camera;
        let half = |size: usize, f: f64| (size as f64 / 2.0 + 1.0).max(c.cx.max(c.cy).min(size as f64)) / f;
        let cone = half(c.width, c.fx).hypot(half(c.height, c.fy)).atan();
        Eye { view, cam_from_world: view.world_from_cam.inverse(), cone }
    }

    /// How much is seen of a block, in samples of the size `SIZE_ONE`.
    fn seen_of(&self, b: &Block, horizon: &Horizon) -> f32 {
        if !self.may_see(b) {
            return 0.0;
        }
        b.samples().iter().filter_map(|sample| self.sees(horizon, *sample)).map(|(_, size)| size).sum()
    }

    /// The cell in which a sample of a block is seen, and how large it is there: its area over that of one of `SIZE_ONE`. What is
    /// just outside the picture reaches in.
    fn sees(&self, horizon: &Horizon, [x, y, z, size_m]: [f32; 4]) -> Option<(usize, f32)> {
        let p = self.cam_from_world.transform(DVec3::new(x.into(), y.into(), z.into()));
        let width = self.view.camera.width as f64;
        let sigma_px = f64::from(size_m) * self.view.camera.fx / p.length().max(1e-3);
        let margin_px = (SIGMAS * sigma_px).clamp(f64::MIN_POSITIVE, width);
        let (cell, outside_px) = horizon.sees(self.view, p, margin_px)?;
        let inside = 1.0 - outside_px / margin_px;
        let size = (sigma_px / (SIZE_ONE * width)).powi(2).min(SIZE_MAX);
        Some((cell, (size * inside * inside) as f32))
    }

    /// Whether anything of a block may be seen: it is of the view's epoch, and its ball reaches before the camera and into its cone.
    fn may_see(&self, b: &Block) -> bool {
        let (p, radius) = (self.cam_from_world.transform(b.centre.as_dvec3()), f64::from(b.radius));
        if b.epoch != self.view.epoch || self.view.fisheye.is_some() || p.length() <= radius {
            return b.epoch == self.view.epoch;
        }
        p.truncate().length().atan2(p.z) - (radius / p.length()).asin() <= self.cone
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::coverage::tests::view;

    #[test]
    fn what_reaches_into_the_picture_is_seen_by_its_size() {
        let (view, open) = (view(), Horizon::default());
        let size = |p: [f32; 4]| Eye::new(&view).sees(&open, p).map_or(0.0, |(_, size)| size);
        let (near, far) = (size([0.0, 0.0, 1.0, 0.01]), size([0.0, 0.0, 2.0, 0.01]));
        assert!((near / far - 4.0).abs() < 1e-3, "{near} {far}");
        assert_eq!(size([0.0, 0.0, 0.5, 9.0]), SIZE_MAX as f32);
        // Beside the picture, whose half is as wide as `edge` at 1 m.
        let edge = view.camera.width as f32 / 2.0 / view.camera.fx as f32;
        assert!(size([edge + 0.1, 0.0, 1.0, 0.2]) > 0.0 && size([edge + 0.1, 0.0, 1.0, 0.01]) == 0.0);
        for odd in [[0.0, 0.0, 1.0, 0.0], [0.0; 4], [f32::NAN, 0.0, 1.0, 0.1], [0.0, 0.0, -1.0, 0.1]] {
            assert!(size(odd) >= 0.0, "{odd:?}");
        }
    }
}
