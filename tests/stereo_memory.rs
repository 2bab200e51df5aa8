//! OpenCV allocates behind us; its matchers work in buffers of one shape, so that this does not grow. A test of its
//! own program: the resident set is that of all its threads.
#![cfg(feature = "opencv")]
#![allow(clippy::unwrap_used)]

#[allow(dead_code)] // each test takes of it what it needs
#[path = "bench/world.rs"]
mod world;

use stipple::config::{StereoConfig, StereoMethod};
use stipple::stereo::{Disparity, Matcher};
use stipple_drivers::host::rss_peak_bytes;
use stipple_drivers::Image;
use world::Noise;

const WIDTH: usize = 384;
const HEIGHT: usize = 240;

/// A wall of random grey levels, `px` of disparity away.
fn pair(px: usize, noise: &mut Noise) -> [Image; 2] {
    let mut pair = [Image::new(WIDTH, HEIGHT), Image::new(WIDTH, HEIGHT)];
    for i in 0..WIDTH * HEIGHT {
        let level = (255.0 * noise.uniform()) as u8;
        pair[0].pixels[i] = level;
        pair[1].pixels[i - px.min(i % WIDTH)] = level;
    }
    pair
}

#[test]
fn a_hundred_pairs_take_no_more_memory_than_ten() {
    let pairs: Vec<[Image; 2]> = (0..8).map(|i| pair(3 + 7 * i, &mut Noise(i as u64))).collect();
    for method in [StereoMethod::Bm, StereoMethod::Sgbm] {
        let config = StereoConfig { method, disparities: 64, ..StereoConfig::default() };
        let mut matcher = Matcher::new(WIDTH, HEIGHT, &config, None).unwrap();
        let mut found = Disparity::new(WIDTH, HEIGHT);
        let mut run = |n: usize| {
            for [left, right] in (0..n).map(|i| &pairs[i % pairs.len()]) {
                matcher.compute(None, left, right, &mut found).unwrap();
            }
            rss_peak_bytes().unwrap()
        };
        let (few, many) = (run(16), run(100));
        assert!(found.px.iter().filter(|d| **d > 0.0).count() > WIDTH * HEIGHT / 2, "{method:?} matches the wall");
        println!("{method:?}: {few} then {many} bytes");
        assert!(many <= few + (1 << 20), "{method:?}: {few} then {many} bytes");
    }
}
