//! How good disparities are. The protocol, the same for every method:
//!
//! - a pixel counts if its truth is known (`all`), or besides that the right eye sees it (`visible`);
//! - `density` is the share of counting pixels that have a disparity;
//! - an unknown pixel is not bad, but lowers the density: `bad1`, `bad2` (error above 1 and 2 px) and `mean_px`
//!   (mean absolute error) are over counting pixels that have a disparity;
//! - `residual_variance` is that of error / stated deviation over visible pixels whose error is at most
//!   `GROSS_PX`, `judged` of them; what is beyond is a wrong match, which no deviation of a right one describes. Such errors
//!   are as long as the range of disparities allows, so a few in a thousand would alone make the variance any number; their
//!   share is given as `gross` (at most 0.5 % in any range of the simulated flights). Who uses a deviation must bear them
//!   by other means: a loss that is linear beyond a deviation or two, or a gate.

use super::sets::Pair;
use stipple::stereo::Disparity;

/// Errors beyond are wrong matches, px.
pub const GROSS_PX: f32 = 3.0;

#[derive(Clone, Copy, Debug, Default)]
pub struct Tally {
    counting: u64,
    known: u64,
    bad1: u64,
    bad2: u64,
    error_px: f64,
    error_m: f64,
    residual2: f64,
    within: u64,
    gross: u64,
}

impl Tally {
    /// `error` px and stated deviation of a known disparity.
    fn add(&mut self, estimate: f32, sigma: f32, truth: f32, focal_baseline: f64) {
        self.counting += 1;
        if !(estimate >= 0.0) {
            return;
        }
        let error = (estimate - truth).abs();
        self.known += 1;
        self.bad1 += u64::from(error > 1.0);
        self.bad2 += u64::from(error > 2.0);
        self.error_px += f64::from(error);
        // Infinitely far is taken for a tenth of a pixel.
        let depth = |d: f32| focal_baseline / f64::from(d.max(0.1));
        self.error_m += (depth(estimate) - depth(truth)).abs();
        if error <= GROSS_PX {
            let residual = f64::from(error / sigma);
            self.residual2 += residual * residual;
            self.within += u64::from(residual <= 1.0);
        } else {
            self.gross += 1;
        }
    }

    fn share(n: u64, of: u64) -> Option<f64> {
        (of > 0).then(|| n as f64 / of as f64)
    }

    pub fn pixels(&self) -> u64 {
        self.counting
    }

    pub fn density(&self) -> Option<f64> {
        Tally::share(self.known, self.counting)
    }

    pub fn bad1(&self) -> Option<f64> {
        Tally::share(self.bad1, self.known)
    }

    pub fn bad2(&self) -> Option<f64> {
        Tally::share(self.bad2, self.known)
    }

    pub fn mean_px(&self) -> Option<f64> {
        (self.known > 0).then(|| self.error_px / self.known as f64)
    }

    pub fn mean_m(&self) -> Option<f64> {
        (self.known > 0).then(|| self.error_m / self.known as f64)
    }

    /// Pixels of the residual variance.
    pub fn judged(&self) -> u64 {
        self.known - self.gross
    }

    pub fn residual_variance(&self) -> Option<f64> {
        (self.judged() > 0).then(|| self.residual2 / self.judged() as f64)
    }

    /// 0.68 of normal errors.
    pub fn within_a_deviation(&self) -> Option<f64> {
        Tally::share(self.within, self.judged())
    }

    pub fn gross(&self) -> Option<f64> {
        Tally::share(self.gross, self.known)
    }
}

/// Score of a method on a set, or on the part of it within a range of depths.
#[derive(Clone, Copy, Debug, Default)]
pub struct Score {
    pub all: Tally,
    pub visible: Tally,
}

impl Score {
    /// Counts the pixels of a pair whose true disparity is in `range`, px.
    pub fn add(&mut self, pair: &Pair, found: &Disparity, range: [f64; 2], focal_baseline: f64) {
        for (i, &truth) in pair.truth.iter().enumerate() {
            if truth >= 0.0 && (range[0]..range[1]).contains(&f64::from(truth)) {
                self.all.add(found.px[i], found.sigma_px[i], truth, focal_baseline);
                if pair.visible[i] {
                    self.visible.add(found.px[i], found.sigma_px[i], truth, focal_baseline);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use stipple_drivers::Image;

    #[test]
    fn unknown_lowers_density_and_is_not_bad() {
        let image = Image::new(6, 1);
        let pair = Pair {
            left: image.clone(),
            right: image,
            truth: vec![5.0, 5.0, 5.0, 5.0, -1.0, 5.0],
            visible: vec![true, true, true, true, true, false],
        };
        let px = vec![5.5, -1.0, 6.5, 9.0, 5.0, 5.0];
        let found = Disparity { width: 6, height: 1, px, sigma_px: vec![0.5; 6] };
        let mut score = Score::default();
        score.add(&pair, &found, [0.0, 100.0], 50.0);
        let (all, visible) = (score.all, score.visible);
        assert_eq!((all.pixels(), visible.pixels()), (5, 4));
        assert_eq!((all.density(), all.bad1(), all.bad2()), (Some(0.8), Some(0.5), Some(0.25)));
        assert_eq!((visible.mean_px(), visible.gross()), (Some(2.0), Some(1.0 / 3.0)));
        // Residuals of 1 and 3.
        assert_eq!((visible.residual_variance(), visible.within_a_deviation()), (Some(5.0), Some(0.5)));
        assert_eq!(Tally::default().bad1(), None);
    }
}
