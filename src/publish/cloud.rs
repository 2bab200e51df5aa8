//! The Gaussians of a map as points, for readers of the status socket: in memory that the mapper's process and the one that
//! flies share. The mapper writes them when it is asked; a reader of half of them notices.

use std::io;
use std::sync::atomic::{fence, Ordering::Acquire, Ordering::Relaxed, Ordering::Release};
use stipple_drivers::shared::SharedWords;
use stipple_drivers::Nanos;

/// Most points of a cloud: the most important Gaussians are taken.
pub const POINTS: usize = 1 << 16;
/// Bytes of a point: x, y, z as f32, m; red, green, blue and opacity as u8.
pub const STRIDE: usize = 16;
const WORDS_EACH: usize = STRIDE / size_of::<u64>();
/// Words before the points: odd while they are written; whether they are wanted; the head.
const GENERATION: usize = 0;
const WANTED: usize = 1;
const COUNT: usize = 2;
const OF: usize = 3;
const STAMP: usize = 4;
const EPOCH: usize = 5;
const HEAD: usize = 8;
const WORDS: usize = HEAD + POINTS * WORDS_EACH;

/// Bytes of its memory.
pub const BYTES: usize = WORDS * size_of::<u64>();

/// A Gaussian as readers see it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// World of its epoch, m.
    pub p: [f32; 3],
    pub rgb: [u8; 3],
    pub opacity: u8,
}

/// What is known of a cloud.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Head {
    /// Grows with each cloud; none has 0.
    pub generation: u64,
    /// Stamp of the newest keyframe in it.
    pub t: Nanos,
    pub epoch: u32,
    pub count: usize,
    /// Gaussians of the map.
    pub of: usize,
}

pub struct Cloud(SharedWords);

impl Cloud {
    /// Takes new memory.
    pub fn create() -> io::Result<Cloud> {
        SharedWords::create(WORDS).map(Cloud)
    }

    /// Maps the memory that the process which flies has taken, by its descriptor.
    pub fn attach(fd: i32) -> io::Result<Cloud> {
        SharedWords::attach(fd, WORDS).map(Cloud)
    }

    /// The descriptor of its memory.
    pub fn number(&self) -> i32 {
        self.0.number()
    }

    /// Asks for a new one.
    pub fn ask(&self) {
        self.0[WANTED].store(1, Relaxed);
    }

    /// Whether a new one is wanted: once for each time it was asked for.
    pub fn take_wish(&self) -> bool {
        self.0[WANTED].swap(0, Relaxed) != 0
    }

    /// Puts a new one in the place of the last. Points beyond `POINTS` are left out.
    pub fn write(&self, t: Nanos, epoch: u32, of: usize, points: impl Iterator<Item = Point>) {
        // A mapper that died as it wrote leaves an odd number.
        let odd = (self.0[GENERATION].load(Relaxed) + 1) | 1;
        self.0[GENERATION].store(odd, Relaxed);
        fence(Release);
        let mut count = 0;
        for (point, words) in points.zip(self.0[HEAD..].chunks_exact(WORDS_EACH)) {
            let [x, y, z] = point.p.map(|v| u64::from(v.to_bits()));
            let [r, g, b] = point.rgb;
            let colour = u64::from(u32::from_le_bytes([r, g, b, point.opacity]));
            words[0].store(x | y << 32, Relaxed);
            words[1].store(z | colour << 32, Relaxed);
            count += 1;
        }
        for (at, value) in [(COUNT, count), (OF, of as u64), (STAMP, t.0 as u64), (EPOCH, u64::from(epoch))] {
            self.0[at].store(value, Relaxed);
        }
        self.0[GENERATION].store(odd + 1, Release);
    }

    /// Appends the points to `to` as little-endian bytes, `STRIDE` each; `None` where there are none yet, or new ones are being written.
    pub fn read(&self, to: &mut Vec<u8>) -> Option<Head> {
        let before = self.0[GENERATION].load(Acquire);
        let word = |at: usize| self.0[at].load(Relaxed);
        let count = (word(COUNT) as usize).min(POINTS);
        let (start, head) = (to.len(), (word(OF) as usize, Nanos(word(STAMP) as i64), word(EPOCH) as u32));
        for word in &self.0[HEAD..HEAD + count * WORDS_EACH] {
            to.extend_from_slice(&word.load(Relaxed).to_le_bytes());
        }
        fence(Acquire);
        if before == 0 || before % 2 == 1 || self.0[GENERATION].load(Relaxed) != before {
            to.truncate(start);
            return None;
        }
        let (of, t, epoch) = head;
        Some(Head { generation: before / 2, t, epoch, count, of })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn point(i: usize) -> Point {
        Point { p: [i as f32, -1.5, 2.0], rgb: [i as u8, 2, 3], opacity: 200 }
    }

    #[test]
    fn points_arrive_as_they_were_written_when_they_are_asked_for() {
        let cloud = Cloud::create().unwrap();
        let mut bytes = vec![];
        assert_eq!(cloud.read(&mut bytes), None, "there are none yet");
        assert!(!cloud.take_wish());
        cloud.ask();
        assert!(cloud.take_wish() && !cloud.take_wish(), "once");
        cloud.write(Nanos(7), 3, 9, (0..2).map(point));
        let head = cloud.read(&mut bytes).unwrap();
        assert_eq!(head, Head { generation: 1, t: Nanos(7), epoch: 3, count: 2, of: 9 });
        let second = [1.0f32, -1.5, 2.0].map(f32::to_le_bytes).as_flattened().to_vec();
        assert_eq!(bytes[STRIDE..], [second, vec![1, 2, 3, 200]].concat());
        cloud.write(Nanos(8), 3, 100_000, (0..100_000).map(point));
        bytes.clear();
        assert_eq!(cloud.read(&mut bytes).map(|head| (head.generation, head.count)), Some((2, POINTS)));
        assert_eq!(bytes.len(), POINTS * STRIDE);
    }

    #[test]
    fn cloud_of_a_mapper_that_died_as_it_wrote_is_none_until_the_next() {
        let cloud = Cloud::create().unwrap();
        cloud.write(Nanos(1), 0, 1, (0..1).map(point));
        cloud.0[GENERATION].fetch_add(1, Relaxed);
        assert_eq!(cloud.read(&mut vec![]), None);
        cloud.write(Nanos(2), 0, 1, (0..1).map(point));
        assert_eq!(cloud.read(&mut vec![]).unwrap().t, Nanos(2));
    }
}
