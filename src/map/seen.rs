//! Which blocks each keyframe sees and how much of them: for each keyframe a list of bounded length; and who sees each block.

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
    /// For each block a bit for each keyframe that sees it.
    seen_from: Vec<u64>,
    /// A bit for each keyframe of which what it sees, or a block of that, has changed.
    changed: Vec<u64>,
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
        let words = keyframes.div_ceil(u64::BITS as usize);
        Sight {
            seen: vec![Seen::default(); keyframes * SEEN_MAX],
            lens: vec![0; keyframes],
            seen_from: vec![0; BLOCKS_KNOWN * words],
            changed: vec![0; words],
        }
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
        for at in 0..usize::from(self.lens[keyframe]) {
            let block = self.seen[keyframe * SEEN_MAX + at].block;
            self.mark(keyframe, block.into(), false);
        }
        self.lens[keyframe] = 0;
    }

    /// States how much a keyframe sees of a block, in samples; zero forgets it.
    pub fn set(&mut self, keyframe: usize, block: usize, samples: f32) {
        let (was_seen, n) = (self.is_seen(keyframe, block), usize::from(self.lens[keyframe]));
        let seen = Seen { block: block as u16, amount: (samples * PARTS_OF_A_SAMPLE).ceil() as u16 };
        let row = &mut self.seen[keyframe * SEEN_MAX..][..SEEN_MAX];
        match row[..n].iter().position(|s| was_seen && s.block == seen.block) {
            Some(at) if seen.amount > 0 => row[at] = seen,
            Some(at) => {
                row[at] = row[n - 1];
                self.lens[keyframe] -= 1;
            }
            None if seen.amount == 0 => return,
            None if n < SEEN_MAX => {
                row[n] = seen;
                self.lens[keyframe] += 1;
            }
            None => {
                let least = row.iter_mut().min_by_key(|s| s.amount).filter(|s| s.amount < seen.amount);
                let Some(least) = least else { return };
                let forgotten = std::mem::replace(least, seen).block;
                self.mark(keyframe, forgotten.into(), false);
            }
        }
        self.mark(keyframe, block, seen.amount > 0);
    }

    /// Notes that a block came, went or moved: whoever sees it has changed.
    pub fn touch(&mut self, block: usize) {
        let words = self.changed.len();
        let seen_from = &self.seen_from[block * words..][..words];
        self.changed.iter_mut().zip(seen_from).for_each(|(changed, from)| *changed |= from);
    }

    /// A keyframe that has changed since it was last answered.
    pub fn next_changed(&mut self) -> Option<usize> {
        let word = self.changed.iter().position(|word| *word != 0)?;
        let bit = self.changed[word].trailing_zeros() as usize;
        self.changed[word] &= self.changed[word] - 1;
        Some(word * u64::BITS as usize + bit)
    }

    /// The index of a keyframe's bit among a block's words, and the bit.
    fn bit(keyframe: usize) -> (usize, u64) {
        (keyframe / u64::BITS as usize, 1 << (keyframe % u64::BITS as usize))
    }

    fn is_seen(&self, keyframe: usize, block: usize) -> bool {
        let (word, bit) = Sight::bit(keyframe);
        self.seen_from[block * self.changed.len() + word] & bit != 0
    }

    fn mark(&mut self, keyframe: usize, block: usize, is_seen: bool) {
        let (word, bit) = Sight::bit(keyframe);
        let seen_from = &mut self.seen_from[block * self.changed.len() + word];
        *seen_from = if is_seen { *seen_from | bit } else { *seen_from & !bit };
        self.changed[word] |= bit;
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

    #[test]
    fn whoever_sees_a_block_that_comes_or_goes_has_changed() {
        let mut sight = Sight::new(100);
        [(3, 7), (99, 7), (99, 8), (64, 9)].into_iter().for_each(|(keyframe, block)| sight.set(keyframe, block, 1.0));
        let changed = |sight: &mut Sight| std::iter::from_fn(|| sight.next_changed()).collect::<Vec<_>>();
        assert_eq!(changed(&mut sight), [3, 64, 99]);
        sight.touch(7);
        assert_eq!(changed(&mut sight), [3, 99]);
        sight.clear(99);
        sight.set(3, 8, 0.0);
        assert_eq!(changed(&mut sight), [99], "the other saw nothing of it before");
        sight.touch(8);
        sight.touch(7);
        assert_eq!(changed(&mut sight), [3]);
        // What is forgotten for another is not seen any more.
        (0..=SEEN_MAX).for_each(|block| sight.set(1, 10 + block, 1.0 + block as f32));
        changed(&mut sight);
        sight.touch(10);
        assert!(changed(&mut sight).is_empty());
    }
}
