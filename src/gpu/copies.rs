//! Copies between staging and the arena that share a submission: one with its wait takes 0.06 to 0.12 ms on an H100, whatever it
//! copies.

use super::memory::TRANSFER_BYTES;
use ash::vk;

/// Copies in one submission.
const MOST: usize = 64;

/// Copies from staging, where they lie one after another, to the arena.
pub struct Copies {
    regions: [vk::BufferCopy; MOST],
    len: usize,
    bytes: usize,
}

impl Default for Copies {
    fn default() -> Copies {
        Copies { regions: [vk::BufferCopy::default(); MOST], len: 0, bytes: 0 }
    }
}

impl Copies {
    /// Whether one more has room, and touches none of the others: copies of one submission have no order.
    pub fn fit(&self, bytes: usize, to: u64) -> bool {
        let apart = |r: &vk::BufferCopy| to + bytes as u64 <= r.dst_offset || r.dst_offset + r.size <= to;
        self.len < MOST && bytes <= TRANSFER_BYTES - self.bytes && self.regions().iter().all(apart)
    }

    /// Adds one that fits; where it lies in staging.
    pub fn add(&mut self, bytes: usize, to: u64) -> usize {
        let from = self.bytes;
        self.regions[self.len] = vk::BufferCopy { src_offset: from as u64, dst_offset: to, size: bytes as u64 };
        (self.len, self.bytes) = (self.len + 1, from + bytes);
        from
    }

    /// What Vulkan copies, as they were added.
    pub fn regions(&self) -> &[vk::BufferCopy] {
        &self.regions[..self.len]
    }

    /// Bytes of all of them.
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    /// Turns all of them round: from the arena to staging.
    pub fn reverse(&mut self) {
        for r in &mut self.regions[..self.len] {
            std::mem::swap(&mut r.src_offset, &mut r.dst_offset);
        }
    }

    /// Forgets all of them.
    pub fn clear(&mut self) {
        (self.len, self.bytes) = (0, 0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_overlaps_or_is_too_much_does_not_fit() {
        let mut t = Copies::default();
        assert_eq!((t.add(100, 1000), t.add(50, 1100)), (0, 100));
        assert!(t.fit(10, 1150) && t.fit(10, 990) && !t.fit(11, 990) && !t.fit(1, 1149) && !t.fit(500, 900));
        assert!(t.fit(TRANSFER_BYTES - 150, 2000) && !t.fit(TRANSFER_BYTES - 149, 2000));
        t.reverse();
        assert_eq!((t.regions()[1].src_offset, t.regions()[1].dst_offset, t.bytes()), (1100, 100, 150));
        t.clear();
        (0..MOST as u64).for_each(|i| {
            assert!(t.fit(1, i));
            t.add(1, i);
        });
        assert!(!t.fit(1, 9999));
    }
}
