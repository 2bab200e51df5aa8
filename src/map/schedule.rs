//! Which keyframe is trained on next: uniformly at random, from a seed, so that a run can be repeated.

/// SplitMix64 (Steele, Lea & Flood, OOPSLA 2014).
pub struct Rng(u64);

impl Rng {
    pub fn new(seed: u64) -> Rng {
        Rng(seed)
    }

    pub fn next_u64(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Uniform in `0..n`; the bias is below n / 2^64.
    pub fn below(&mut self, n: usize) -> usize {
        ((u128::from(self.next_u64()) * n as u128) >> 64) as usize
    }
}

/// The order of training steps: a new anchor's burst first, then uniform draws.
pub struct Schedule {
    rng: Rng,
    burst: Option<(usize, u32)>,
}

impl Schedule {
    pub fn new(seed: u64) -> Schedule {
        Schedule { rng: Rng::new(seed), burst: None }
    }

    /// The next `steps` go to keyframe `anchor` alone.
    pub fn start_burst(&mut self, anchor: usize, steps: u32) {
        self.burst = (steps > 0).then_some((anchor, steps));
    }

    pub fn in_burst(&self) -> bool {
        self.burst.is_some()
    }

    /// The keyframe of the next step out of `training`, or `None` when there is none.
    pub fn next(&mut self, training: &[u32]) -> Option<usize> {
        if let Some((anchor, left)) = self.burst {
            self.burst = (left > 1).then_some((anchor, left - 1));
            return Some(anchor);
        }
        (!training.is_empty()).then(|| training[self.rng.below(training.len())] as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_are_uniform_and_repeat_with_the_seed() {
        let draw = |seed| {
            let mut s = Schedule::new(seed);
            let training: Vec<u32> = (0..10).collect();
            (0..10_000).map(|_| s.next(&training).expect("ten to choose from")).collect::<Vec<_>>()
        };
        let a = draw(7);
        assert_eq!(a, draw(7));
        assert_ne!(a, draw(8));
        for k in 0..10 {
            let n = a.iter().filter(|&&i| i == k).count();
            assert!((850..1150).contains(&n), "{k}: {n}"); // 5 sigma of a binomial
        }
    }

    #[test]
    fn burst_trains_the_new_anchor_alone() {
        let mut s = Schedule::new(1);
        s.start_burst(42, 3);
        assert_eq!([s.next(&[]), s.next(&[5]), s.next(&[5]), s.next(&[5])], [Some(42), Some(42), Some(42), Some(5)]);
        assert_eq!(s.next(&[]), None);
    }
}
