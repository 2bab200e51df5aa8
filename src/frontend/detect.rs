//! Corners: FAST-9 (Rosten and Drummond, ECCV 2006), the strongest of each free grid cell.
//!
//! The score of a pixel is the least threshold at which it is no corner any more, grey levels. Every pixel of a cell is scored,
//! many at once, which takes less time than choosing those that may be corners. Ties go to the first in scan order.

use crate::config::FrontendConfig;
use crate::math::wide::wide;
use stipple_drivers::Image;

/// Corners keep this far from the image border, so that coarse levels see most of the patch, px.
pub const BORDER: usize = 19;
/// A cell whose point was rejected is not looked at for so long, s, 16 frames at 20 Hz: a new point of what moves there would
/// be a landmark before it is rejected too. Chosen from 0 to 2 s on four flights past a person; neighbours differ little.
const REST: f64 = 0.775;
/// A frame counts for no longer, s: while frames are missing, no point is looked for either.
const FRAME_MAX: f64 = 0.05;
/// The ring, from the top clockwise.
#[rustfmt::skip]
const RING: [(isize, isize); 16] = [
    (0, -3), (1, -3), (2, -2), (3, -1), (3, 0), (3, 1), (2, 2), (1, 3),
    (0, 3), (-1, 3), (-2, 2), (-3, 1), (-3, 0), (-3, -1), (-2, -2), (-1, -3),
];

/// A corner at an integer pixel, and the least threshold at which it is none, grey levels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Corner {
    pub x: usize,
    pub y: usize,
    pub score: u8,
}

/// The detection grid of one camera, and which of its cells hold a point.
pub struct Detector {
    cell: usize,
    columns: usize,
    origin: [usize; 2],
    taken: Vec<bool>,
    /// Bit of each other camera that sees a cell too.
    shared: Vec<u8>,
    /// Time for which each cell is not looked at, s.
    rests: Vec<f64>,
    corners: Vec<Corner>,
    threshold: u8,
}

impl Detector {
    pub fn new(width: usize, height: usize, config: &FrontendConfig) -> Detector {
        let cell = config.grid_px as usize;
        let (columns, rows) = (width / cell, height / cell);
        Detector {
            cell,
            columns,
            origin: [(width % cell) / 2, (height % cell) / 2],
            taken: vec![false; columns * rows],
            shared: vec![0; columns * rows],
            rests: vec![0.0; columns * rows],
            corners: Vec::with_capacity(columns * rows),
            threshold: config.fast_threshold_min.clamp(1, 255) as u8,
        }
    }

    /// Marks each cell by the cameras that see its middle.
    pub fn share(&mut self, sees: impl Fn([f32; 2]) -> u8) {
        for k in 0..self.shared.len() {
            let middle = |origin: usize, n: usize| (origin + n * self.cell) as f32 + 0.5 * (self.cell - 1) as f32;
            self.shared[k] = sees([middle(self.origin[0], k % self.columns), middle(self.origin[1], k / self.columns)]);
        }
    }

    fn cell_at(&self, [x, y]: [f32; 2]) -> Option<usize> {
        let rows = self.taken.len() / self.columns.max(1);
        let i = (x - self.origin[0] as f32) / self.cell as f32;
        let j = (y - self.origin[1] as f32) / self.cell as f32;
        let inside = i >= 0.0 && j >= 0.0 && i < self.columns as f32 && j < rows as f32;
        inside.then(|| j as usize * self.columns + i as usize)
    }

    /// Lets the cell at a pixel rest, whose point was rejected; the rest of one that rests already is not made longer.
    pub fn rest(&mut self, px: [f32; 2]) {
        if let Some(k) = self.cell_at(px).filter(|k| self.rests[*k] == 0.0) {
            self.rests[k] = REST;
        }
    }

    /// Takes it that the last frame came so long after the one before, s.
    pub fn elapse(&mut self, secs: f64) {
        self.rests.iter_mut().for_each(|rest| *rest = (*rest - secs.clamp(0.0, FRAME_MAX)).max(0.0));
    }

    /// Finds at most `room` corners, one in each cell that is free of `points` and that none of the cameras
    /// `others` (bits) sees too; the strongest when there are more. Also answers how many did not fit.
    pub fn detect(
        &mut self,
        image: &Image,
        points: impl Iterator<Item = [f32; 2]>,
        others: u8,
        room: usize,
    ) -> (&[Corner], usize) {
        self.taken.iter_mut().zip(&self.rests).for_each(|(taken, rest)| *taken = *rest > 0.0);
        for px in points {
            if let Some(k) = self.cell_at(px) {
                self.taken[k] = true;
            }
        }
        self.corners.clear();
        for k in 0..self.taken.len() {
            if !self.taken[k] && self.shared[k] & others == 0 {
                let x = self.origin[0] + (k % self.columns) * self.cell;
                let y = self.origin[1] + (k / self.columns) * self.cell;
                let corner = strongest(image, [x, y], self.cell, self.threshold);
                self.corners.extend(corner); // one a cell: the capacity is the number of cells
            }
        }
        let excess = self.corners.len().saturating_sub(room);
        if excess > 0 {
            self.corners.sort_unstable_by_key(|c| (std::cmp::Reverse(c.score), c.y, c.x));
            self.corners.truncate(room);
        }
        (&self.corners, excess)
    }
}

/// Pixels of a row that are scored at once.
const LANES: usize = 32;
type Lanes = [u8; LANES];

wide! {
    /// The strongest corner of the square cell at `at`, if any exceeds the threshold.
    pub fn strongest<'a>(image: &'a Image, at: [usize; 2], cell: usize, threshold: u8) -> Option<Corner> {
        let w = image.width;
        let x0 = at[0].max(BORDER);
        let x1 = (at[0] + cell).min(w.saturating_sub(BORDER));
        let y1 = (at[1] + cell).min(image.height.saturating_sub(BORDER));
        let mut best = Corner { x: 0, y: 0, score: threshold };
        for y in at[1].max(BORDER)..y1 {
            for x in (x0..x1).step_by(LANES) {
                // Scores beyond the cell, which may be of the next row, are left out; `BORDER` rows below hold what is read.
                let scores = scores(&image.pixels, y * w + x, w);
                if scores.iter().fold(0, |most, s| most.max(*s)) <= best.score {
                    continue;
                }
                for (x, score) in (x..x1).zip(scores) {
                    if score > best.score {
                        best = Corner { x, y, score };
                    }
                }
            }
        }
        (best.score > threshold).then_some(best)
    }
}

/// The largest difference, in grey levels, from each of the pixels from `at` on that nine neighbouring pixels of its ring reach
/// in one direction, or 0.
#[inline(always)]
fn scores(pixels: &[u8], at: usize, stride: usize) -> Lanes {
    let mut ring = [[0; LANES]; 16];
    for (lanes, (dx, dy)) in ring.iter_mut().zip(RING) {
        let from = (at as isize + dy * stride as isize + dx) as usize;
        lanes.copy_from_slice(&pixels[from..from + LANES]);
    }
    // Least and most of windows of two and of four, then of arcs of nine: two neighbouring arcs share eight pixels.
    let mut two = [([0; LANES], [0; LANES]); 8];
    for k in 0..8 {
        let (a, b) = (&ring[2 * k + 1], &ring[(2 * k + 2) % 16]);
        two[k] = (each(a, b, u8::min), each(a, b, u8::max));
    }
    let mut four = two;
    for k in 0..8 {
        let (a, b) = (&two[k], &two[(k + 1) % 8]);
        four[k] = (each(&a.0, &b.0, u8::min), each(&a.1, &b.1, u8::max));
    }
    let (mut brightest, mut darkest) = ([0; LANES], [u8::MAX; LANES]);
    for k in 0..8 {
        let (first, last) = (&ring[2 * k], &ring[(2 * k + 9) % 16]);
        let (a, b) = (&four[k], &four[(k + 2) % 8]);
        let least = each(&each(&a.0, &b.0, u8::min), &each(first, last, u8::max), u8::min);
        let most = each(&each(&a.1, &b.1, u8::max), &each(first, last, u8::min), u8::max);
        (brightest, darkest) = (each(&brightest, &least, u8::max), each(&darkest, &most, u8::min));
    }
    let centre = &pixels[at..at + LANES];
    let mut scores = [0; LANES];
    for i in 0..LANES {
        scores[i] = brightest[i].saturating_sub(centre[i]).max(centre[i].saturating_sub(darkest[i]));
    }
    scores
}

#[inline(always)]
fn each(a: &Lanes, b: &Lanes, of: impl Fn(u8, u8) -> u8) -> Lanes {
    let mut lanes = *a;
    (0..LANES).for_each(|i| lanes[i] = of(a[i], b[i]));
    lanes
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;

    const ARC: usize = 9;

    /// The definition, word by word.
    fn is_corner(image: &Image, x: usize, y: usize, t: i32) -> bool {
        let c = image.at(x, y) as i32;
        let at = |k: usize| {
            let (dx, dy) = RING[k % 16];
            image.at((x as isize + dx) as usize, (y as isize + dy) as usize) as i32
        };
        (0..16).any(|s| (s..s + ARC).all(|k| at(k) > c + t) || (s..s + ARC).all(|k| at(k) < c - t))
    }

    fn noise([width, height]: [usize; 2], seed: u64, contrast: u64, block: usize) -> Image {
        let mut image = Image::new(width, height);
        for y in 0..image.height {
            for x in 0..image.width {
                let cell = (x / block) as u64 * 7919 + (y / block) as u64 * 104729;
                let s = (seed ^ cell).wrapping_mul(0x9E3779B97F4A7C15);
                let s = (s ^ (s >> 29)).wrapping_mul(0xBF58476D1CE4E5B9);
                image.pixels[y * image.width + x] = ((s >> 40) % contrast) as u8;
            }
        }
        image
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]
        #[test]
        fn strongest_corner_is_that_of_the_definition(seed in any::<u64>(), contrast in 2u64..256, block in 1usize..6) {
            // Wider than the pixels that are scored at once, and up to the end of the least image.
            for ([width, height], cell, side) in [
                ([96, 90], [0, 0], 30),
                ([96, 90], [30, 20], 30),
                ([96, 90], [60, 60], 30),
                ([96, 90], [21, 18], 70),
                ([76, 76], [0, 0], 76),
            ] {
                let image = noise([width, height], seed, contrast, block);
                let (mut expect, mut best) = (None, 5);
                for y in cell[1].max(BORDER)..(cell[1] + side).min(height - BORDER) {
                    for x in cell[0].max(BORDER)..(cell[0] + side).min(width - BORDER) {
                        while is_corner(&image, x, y, best) {
                            best += 1;
                            expect = Some((x, y));
                        }
                    }
                }
                let got = strongest(&image, cell, side, 5);
                prop_assert_eq!(got.map(|c| (c.x, c.y)), expect);
                prop_assert_eq!(got.map_or(5, |c| c.score as i32), best);
            }
        }
    }

    #[test]
    fn cells_rest_as_long_at_every_frame_rate_from_twenty_on() {
        let image = noise([96, 90], 3, 256, 4);
        let config = FrontendConfig { grid_px: 20, ..FrontendConfig::default() };
        for (frame_hz, frames) in [(10.0, 16), (20.0, 16), (60.0, 47)] {
            let mut detector = Detector::new(image.width, image.height, &config);
            let all = detector.detect(&image, std::iter::empty(), 0, 100).0.to_vec();
            detector.rest([all[0].x as f32, all[0].y as f32]);
            let rested = (0..100).take_while(|_| {
                let found = detector.detect(&image, std::iter::empty(), 0, 100).0.len();
                detector.elapse(1.0 / frame_hz);
                found < all.len()
            });
            assert_eq!(rested.count(), frames, "{frame_hz} Hz");
        }
    }

    #[test]
    fn taken_cells_are_skipped_and_full_rooms_keep_the_strongest() {
        let image = noise([96, 90], 3, 256, 4);
        let config = FrontendConfig { grid_px: 20, ..FrontendConfig::default() };
        let mut detector = Detector::new(image.width, image.height, &config);
        let all = detector.detect(&image, std::iter::empty(), 0, 100).0.to_vec();
        assert!(all.len() > 4);
        let hit = all[0];
        let without = detector.detect(&image, std::iter::once([hit.x as f32, hit.y as f32]), 0, 100).0.to_vec();
        assert_eq!(without, all[1..]);
        let (few, excess) = detector.detect(&image, std::iter::empty(), 0, 3);
        assert_eq!((few.len(), excess), (3, all.len() - 3));
        let weakest = few.iter().map(|c| c.score).min().unwrap();
        assert!(all.iter().filter(|c| c.score > weakest).count() < 3);
    }
}
