//! Which blocks each keyframe sees and how much of them: for each keyframe a list of bounded length.

use super::filing::BLOCKS_KNOWN;

/// Blocks that a keyframe may see; of more, those that it sees least of are forgotten.
const SEEN_MAX: usize = 512;
/// Parts of a sample in which what is seen is counted.
const PARTS_OF_A_SAMPLE: f32 = 64.0;

/// A block that a keyframe sees, and how much of it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Seen {
    pub block: u16,
    amount: u16,
}

const _: () = assert!(BLOCKS_KNOWN <= 1 << 16);

/// What each keyframe sees of which blocks; allocated at boot.
pub struct Sight {
    seen: Vec<Seen>,
    lens: Vec<u16>,
}

impl Seen {
    /// How much is seen of it, in samples.
    pub fn samples(&self) -> f32 {
        f32::from(self.amount) / PARTS_OF_A_SAMPLE
    }
}

impl Sight {
    /// For so many keyframes.
    pub fn new(keyframes: usize) -> Sight {
        Sight { seen: vec![Seen::default(); keyframes * SEEN_MAX], lens: vec![0; keyframes] }
    }

    /// What a keyframe sees.
    pub fn of(&self, keyframe: usize) -> &[Seen] {
        &self.seen[keyframe * SEEN_MAX..][..usize::from(self.lens[keyframe])]
    }

    /// The blocks that a keyframe sees.
    pub fn blocks(&self, keyframe: usize) -> impl Iterator<Item = usize> + Clone + '_ {
        self.of(keyframe).iter().map(|seen| usize::from(seen.block))
    }

    /// Forgets what a keyframe sees.
    pub fn clear(&mut self, keyframe: usize) {
        self.lens[keyframe] = 0;
    }

    /// States how much a keyframe sees of a block, in samples; zero forgets it.
    pub fn set(&mut self, keyframe: usize, block: usize, samples: f32) {
        let amount = (samples * PARTS_OF_A_SAMPLE).ceil() as u16;
        let (row, len) = (&mut self.seen[keyframe * SEEN_MAX..][..SEEN_MAX], &mut self.lens[keyframe]);
        let n = usize::from(*len);
        let seen = Seen { block: block as u16, amount };
        match row[..n].iter().position(|s| s.block == seen.block) {
            Some(at) if amount > 0 => row[at] = seen,
            Some(at) => {
                row[at] = row[n - 1];
                *len -= 1;
            }
            None if amount == 0 => (),
            None if n < SEEN_MAX => {
                row[n] = seen;
                *len += 1;
            }
            None => {
                if let Some(least) = row.iter_mut().min_by_key(|s| s.amount).filter(|s| s.amount < amount) {
                    *least = seen;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_more_blocks_than_are_kept_the_least_seen_is_forgotten() {
        let mut sight = Sight::new(2);
        (0..SEEN_MAX).for_each(|block| sight.set(1, block, 1.0 + block as f32 / 9.0));
        sight.set(1, SEEN_MAX, 0.5);
        assert!(sight.blocks(1).all(|block| block < SEEN_MAX), "what is seen less than all of them");
        sight.set(1, SEEN_MAX, 2.0);
        assert!(sight.blocks(1).any(|block| block == SEEN_MAX) && sight.blocks(1).all(|block| block > 0));
        sight.set(1, 7, 0.0);
        assert_eq!((sight.blocks(1).count(), sight.blocks(0).count()), (SEEN_MAX - 1, 0));
    }
}
