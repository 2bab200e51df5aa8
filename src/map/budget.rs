//! What the fixed pool is spent on: who leaves when it is full, and when more Gaussians stop paying.
//!
//! **Eviction.** Of those trained often enough to be judged, the least important go, as many as the newcomers need. The
//! threshold is read off a histogram of 256 bins; nothing is sorted.
//!
//! **Growth.** A Gaussian added pays once, in the loss of the view it was added for; it costs at every step from then on,
//! because steps get dearer and so fewer. It is worth adding while
//!
//! ```text
//! ΔL / (n K)  >  s H ρ
//! ```
//!
//! ΔL: how far the loss of an anchor's view fell in the steps on it after n Gaussians were added, over what training alone
//! would have taken off it (`by_training`); K: keyframes, because one of K views gains; s: how much a step lowers the mean loss of all views, measured whenever a keyframe is
//! drawn again; H: steps to come, for which the best guess is those so far; ρ: the part of a step's cost that one Gaussian
//! is. Costs are counted, not timed, so that a run can be repeated: pixels, and (Gaussian, tile) pairs at `PAIR_PIXELS`.

use super::blocks::{importance_of_bin, Bins};

/// Cost of a (Gaussian, tile) pair, in pixels of the loss: of that order on a CPU with 8 lanes.
const PAIR_PIXELS: f64 = 1.0;
/// Weight of the newest drawing in the mean slope: about a lap of a hundred keyframes.
const NEWEST: f64 = 0.02;
/// Least part of the wanted number that is still added: a view without Gaussians cannot say what they would be worth.
const SHARE_MIN: f64 = 1.0 / 4.0;

/// The importance below which about `wanted` are found, and how many those are: never more than `most`.
pub fn threshold(bins: &Bins, wanted: usize, most: usize) -> (f32, usize) {
    let (mut below, mut at) = (0, 0);
    for (bin, n) in bins.iter().enumerate() {
        if below >= wanted || below + *n as usize > most {
            break;
        }
        below += *n as usize;
        at = bin + 1;
    }
    if below == 0 {
        return (0.0, 0);
    }
    (importance_of_bin(at), below)
}

/// What `more` steps on a view would take off its loss, after `steps` on it took off `fell`: losses fall with the
/// logarithm of the steps.
pub fn by_training(fell: f64, steps: u32, more: u64) -> f64 {
    let steps = f64::from(steps.max(2));
    fell.max(0.0) * (1.0 + more as f64 / steps).ln() / steps.ln()
}

/// What a step had to do.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Cost {
    pub pixels: usize,
    pub pairs: u32,
    pub splats: usize,
}

impl Cost {
    /// The part of the step that one Gaussian of the pool is: ρ.
    fn part(&self) -> f64 {
        let pairs = PAIR_PIXELS * f64::from(self.pairs);
        pairs / (self.pixels as f64 + pairs).max(1.0) / self.splats.max(1) as f64
    }
}

/// Decides how many of the wanted Gaussians are added.
#[derive(Clone, Copy, Debug)]
pub struct Growth {
    /// Loss taken off all views by a step: s.
    slope: f64,
    observed: bool,
    share: f64,
}

impl Default for Growth {
    fn default() -> Self {
        Growth { slope: 0.0, observed: false, share: 1.0 }
    }
}

impl Growth {
    /// A keyframe drawn again: its loss fell by this in so many steps of the mapper.
    pub fn observe(&mut self, fell: f64, steps: u64) {
        let slope = fell / steps.max(1) as f64;
        if slope.is_finite() {
            self.slope += if self.observed { NEWEST } else { 1.0 } * (slope - self.slope);
            self.observed = true;
        }
    }

    /// What a Gaussian must take off the mean loss of all views to pay for itself.
    pub fn price(&self, cost: &Cost, steps_to_come: u64) -> f64 {
        self.slope.max(0.0) * steps_to_come as f64 * cost.part()
    }

    /// `n` Gaussians took `fell` off the loss of one of `views`. Answers whether they paid.
    pub fn judge(&mut self, fell: f64, n: usize, views: usize, price: f64) -> bool {
        let paid = fell / (n.max(1) * views.max(1)) as f64 > price;
        self.share = if paid { (2.0 * self.share).min(1.0) } else { (0.5 * self.share).max(SHARE_MIN) };
        paid
    }

    /// Of what is wanted.
    pub fn allowed(&self, wanted: usize) -> usize {
        (self.share * wanted as f64).ceil() as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn threshold_takes_enough_and_never_too_many() {
        let mut bins = [0; 256];
        (bins[10], bins[20], bins[30]) = (5, 5, 100);
        let (least, n) = threshold(&bins, 7, 50);
        assert_eq!(n, 10);
        assert!(least > importance_of_bin(20) && least <= importance_of_bin(30));
        assert_eq!(threshold(&bins, 5, 50).1, 5);
        // The next bin would take more than is allowed.
        assert_eq!(threshold(&bins, 60, 50).1, 10);
        assert_eq!(threshold(&bins, 3, 4), (0.0, 0));
        assert_eq!(threshold(&[0; 256], 3, 4), (0.0, 0));
    }

    #[test]
    fn training_alone_takes_off_less_and_less() {
        // 1.0 - 0.1 ln k: 0.1 ln 20 in twenty steps, 0.1 ln 2 in the next twenty.
        let fell = 0.1 * 20f64.ln();
        assert!((by_training(fell, 20, 20) - 0.1 * 2f64.ln()).abs() < 1e-12);
        assert_eq!((by_training(fell, 20, 0), by_training(-1.0, 20, 9)), (0.0, 0.0));
    }

    #[test]
    fn growth_stops_when_training_is_worth_more_and_resumes_when_it_settles() {
        let cost = Cost { pixels: 10_000, pairs: 10_000, splats: 1000 };
        let mut g = Growth::default();
        assert_eq!(g.price(&cost, 1000), 0.0);
        for _ in 0..200 {
            g.observe(0.01, 100);
        }
        // 1e-4 a step, a thousand of them, half the cost to a thousand Gaussians.
        let price = g.price(&cost, 1000);
        assert!((price - 5e-5).abs() < 1e-9, "{price}");
        assert!(!g.judge(0.01, 100, 10, price) && !g.judge(0.01, 100, 10, price));
        assert_eq!(g.allowed(1000), 250);
        assert!((0..20).all(|_| !g.judge(0.0, 100, 10, price)));
        assert_eq!(g.allowed(1600), 400);
        for _ in 0..500 {
            g.observe(0.0, 100);
        }
        let price = g.price(&cost, 1000);
        assert!(g.judge(0.01, 100, 10, price));
        assert!((0..9).all(|_| g.judge(0.01, 100, 10, price)));
        assert_eq!(g.allowed(1000), 1000);
        g.observe(f64::NAN, 1);
        assert!(g.price(&cost, 1).is_finite());
    }
}
