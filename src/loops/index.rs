//! Place index: which places have descriptors that agree with given ones in some run of bits.
//!
//! Hash tables over disjoint runs of 16 bits (locality-sensitive hashing, Indyk and Motwani 1998): descriptors of the same
//! corner differ in some bits, but hardly in all runs. Each bucket is a list of fixed size; of more places it keeps some drawn at
//! random, each as likely (reservoir sampling, Vitter 1985), or the newest would look like everything. Memory is taken once.

use super::features::Descriptor;

/// Tables, each of 2^16 buckets.
const TABLES: usize = 8;
const BUCKETS: usize = 1 << 16;
/// Entries of a bucket: three quarters of the mean at 2048 places of 300 descriptors.
const BUCKET: usize = 7;
/// No place.
const NONE: u16 = u16::MAX;

/// A place that was found, and its votes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Candidate {
    pub place: u16,
    pub votes: f32,
}

pub struct PlaceIndex {
    /// `entries[(table * BUCKETS + bucket) * BUCKET..]`
    entries: Vec<u16>,
    /// Places that each bucket was given, as far as a byte counts.
    given: Vec<u8>,
    /// Votes of each place, zero between queries.
    votes: Vec<f32>,
    /// Places that have votes.
    voted: Vec<u16>,
}

impl PlaceIndex {
    /// An index of places with numbers under `places`.
    pub fn new(places: usize) -> PlaceIndex {
        let places = places.min(NONE as usize);
        PlaceIndex {
            entries: vec![NONE; TABLES * BUCKETS * BUCKET],
            given: vec![0; TABLES * BUCKETS],
            votes: vec![0.0; places],
            voted: Vec::with_capacity(places),
        }
    }

    /// Bytes that it takes.
    pub fn bytes(&self) -> usize {
        size_of::<Self>() + self.entries.len() * 2 + self.given.len() + self.votes.len() * 4 + self.voted.capacity() * 2
    }

    /// Adds the descriptors of a place.
    pub fn insert<'a>(&mut self, place: u16, descriptors: impl Iterator<Item = &'a Descriptor>) {
        for bucket in descriptors.flat_map(buckets) {
            let list = &mut self.entries[bucket * BUCKET..][..BUCKET];
            // Corners of one place that look alike count once.
            if list.contains(&place) {
                continue;
            }
            let given = usize::from(self.given[bucket]);
            self.given[bucket] = self.given[bucket].saturating_add(1);
            let free = list.iter().position(|e| *e == NONE);
            let at = free.unwrap_or_else(|| drawn(place, bucket) % (given + 1).max(BUCKET));
            if at < BUCKET {
                list[at] = place;
            }
        }
    }

    /// Removes a place, by the descriptors that it was inserted with.
    pub fn remove<'a>(&mut self, place: u16, descriptors: impl Iterator<Item = &'a Descriptor>) {
        for bucket in descriptors.flat_map(buckets) {
            let list = &mut self.entries[bucket * BUCKET..][..BUCKET];
            list.iter_mut().filter(|e| **e == place).for_each(|e| *e = NONE);
            self.given[bucket] = self.given[bucket].saturating_sub(1);
        }
    }

    /// Finds the places with most votes among the eligible ones; answers how many of `out` were filled, the best first. A
    /// vote counts less where a bucket has many places.
    pub fn query<'a>(
        &mut self,
        descriptors: impl Iterator<Item = &'a Descriptor>,
        eligible: impl Fn(u16) -> bool,
        out: &mut [Candidate],
    ) -> usize {
        for bucket in descriptors.flat_map(buckets) {
            let list = &self.entries[bucket * BUCKET..][..BUCKET];
            let length = list.iter().filter(|e| **e != NONE).count() as f32;
            for place in list.iter().filter(|e| **e != NONE) {
                let votes = &mut self.votes[*place as usize];
                if *votes == 0.0 {
                    self.voted.push(*place);
                }
                *votes += 1.0 / length;
            }
        }
        let mut found = 0;
        for place in self.voted.drain(..) {
            let votes = std::mem::take(&mut self.votes[place as usize]);
            if !eligible(place) {
                continue;
            }
            let better = |c: &Candidate| c.votes > votes || (c.votes == votes && c.place < place);
            let at = out[..found].partition_point(better);
            if at < out.len() {
                found = (found + 1).min(out.len());
                out[at..found].rotate_right(1);
                out[at] = Candidate { place, votes };
            }
        }
        found
    }
}

/// A number that is as good as random for a place in a bucket (the mixing of SplitMix64).
fn drawn(place: u16, bucket: usize) -> usize {
    let mut x = (u64::from(place) << 32 | bucket as u64).wrapping_add(0x9e37_79b9_7f4a_7c15);
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    (x ^ (x >> 31)) as usize
}

/// The buckets of a descriptor, one of each table: 16 of every 32 bits.
fn buckets(descriptor: &Descriptor) -> impl Iterator<Item = usize> {
    let d = *descriptor;
    (0..TABLES).map(move |table| {
        let bits = (d[table / 2] >> (32 * (table % 2))) & 0xffff;
        table * BUCKETS + bits as usize
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::{stream, Noise};

    fn random(noise: &mut Noise) -> Descriptor {
        std::array::from_fn(|_| noise.bits())
    }

    /// Flips `n` of a descriptor's bits, some perhaps back.
    fn worn(d: &Descriptor, n: usize, noise: &mut Noise) -> Descriptor {
        let mut d = *d;
        for _ in 0..n {
            let bit = noise.bits() as usize % 256;
            d[bit / 64] ^= 1 << (bit % 64);
        }
        d
    }

    #[test]
    fn a_place_is_found_at_capacity_by_a_third_of_its_corners_with_an_eighth_of_their_bits_changed() {
        let mut noise = stream(7, 0);
        let places: Vec<Vec<Descriptor>> = (0..2048).map(|_| (0..300).map(|_| random(&mut noise)).collect()).collect();
        let mut index = PlaceIndex::new(2048);
        places.iter().enumerate().for_each(|(k, d)| index.insert(k as u16, d.iter()));
        assert!(index.bytes() < 10 << 20, "{} bytes", index.bytes());
        let mut found = 0;
        for k in (0..2048).step_by(64) {
            let seen = places[k].iter().enumerate();
            let seen: Vec<Descriptor> =
                seen.map(|(i, d)| if i % 3 == 0 { worn(d, 32, &mut noise) } else { random(&mut noise) }).collect();
            let mut best = [Candidate::default(); 4];
            let n = index.query(seen.iter(), |_| true, &mut best);
            found += usize::from(best[..n].iter().any(|c| c.place == k as u16));
        }
        assert!(found >= 30, "{found} of 32");
    }

    #[test]
    fn what_was_removed_or_is_not_eligible_is_not_found() {
        let mut noise = stream(3, 0);
        let places: Vec<Vec<Descriptor>> = (0..9).map(|_| (0..50).map(|_| random(&mut noise)).collect()).collect();
        let mut index = PlaceIndex::new(16);
        places.iter().enumerate().for_each(|(k, d)| index.insert(k as u16, d.iter()));
        let mut best = [Candidate::default(); 2];
        assert_eq!((index.query(places[4].iter(), |_| true, &mut best) > 0, best[0].place), (true, 4));
        assert!(best[0].votes > 390.0, "400 buckets, hardly any shared: {}", best[0].votes);
        let n = index.query(places[4].iter(), |k| k != 4, &mut best);
        assert!(best[..n].iter().all(|c| c.place != 4 && c.votes < 5.0));
        index.remove(4, places[4].iter());
        let n = index.query(places[4].iter(), |_| true, &mut best);
        assert!(best[..n].iter().all(|c| c.place != 4));
        index.insert(4, places[5].iter());
        assert_eq!(index.query(places[5].iter(), |_| true, &mut best), 2, "two places with the same looks");
        assert_eq!([best[0].place, best[1].place], [4, 5]);
    }

    #[test]
    fn a_bucket_that_is_full_keeps_any_as_likely() {
        let same = [[0x1234_5678_9abc_def0; 4]];
        let (mut kept, mut early) = (0, 0);
        for first in 0..200u16 {
            let mut index = PlaceIndex::new(8192);
            (0..28).for_each(|k| index.insert(first * 28 + k, same.iter()));
            let mut best = [Candidate::default(); 32];
            let n = index.query(same.iter(), |_| true, &mut best);
            // The four words are equal, and so are the buckets of each half; a list has 7 of 28.
            kept += n;
            early += best[..n].iter().filter(|c| c.place < first * 28 + 14).count();
        }
        let share = early as f64 / kept as f64;
        assert!((0.45..0.55).contains(&share), "{share}: the newest do not push out the oldest");
    }
}
