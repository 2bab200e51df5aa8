//! Pixels picked at a wanted density by error diffusion (Floyd and Steinberg 1976): evenly spaced where the density is
//! flat, and without clumps.

use super::schedule::Rng;

pub struct Diffusion {
    width: usize,
    /// Picks wanted a pixel, to be filled before `pick`.
    pub density: Vec<f32>,
    /// Error carried to the row being walked and to the next, one pixel of margin on each side.
    carried: [Vec<f32>; 2],
}

impl Diffusion {
    pub fn new(width: usize, height: usize) -> Diffusion {
        let carried = std::array::from_fn(|_| vec![0.0; width + 2]);
        Diffusion { width, density: vec![0.0; width * height], carried }
    }

    /// Scales the density, whose sum is `sum`, to `wanted` picks; at most one a pixel.
    pub fn scale(&mut self, wanted: usize, sum: f64) {
        let scale = (wanted as f64 / sum) as f32;
        self.density.iter_mut().for_each(|d| *d = (*d * scale).min(1.0));
    }

    /// Calls `put` with column and row of each pixel that is picked, and the density there.
    pub fn pick(&mut self, mut put: impl FnMut(usize, usize, f32)) {
        let Diffusion { width, density, carried } = self;
        // The first row inherits what a row above would have left, else a sparse pattern starts late.
        let mut rng = Rng::new(1);
        carried[0].fill_with(|| rng.below(1024) as f32 / 1024.0 - 0.5);
        carried[1].fill(0.0);
        for (y, row) in density.chunks_exact(*width).enumerate() {
            for step in 0..*width {
                // Alternate rows run backwards, else the pattern leans.
                let x = if y % 2 == 0 { step } else { *width - 1 - step };
                let wanted = row[x] + carried[0][x + 1];
                let picked = wanted >= 0.5;
                let rest = wanted - if picked { 1.0 } else { 0.0 };
                let (ahead, behind) = if y % 2 == 0 { (x + 2, x) } else { (x, x + 2) };
                carried[0][ahead] += rest * (7.0 / 16.0);
                carried[1][behind] += rest * (3.0 / 16.0);
                carried[1][x + 1] += rest * (5.0 / 16.0);
                carried[1][ahead] += rest * (1.0 / 16.0);
                if picked && row[x] > 0.0 {
                    put(x, y, row[x]);
                }
            }
            carried.swap(0, 1);
            carried[1].fill(0.0);
        }
    }
}
