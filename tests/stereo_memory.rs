//! OpenCV allocates behind us; its matchers work in buffers of one shape, so that this does not grow. A test of its
//! own program: the resident set is that of all its threads.
#![cfg(feature = "opencv")]
#![allow(clippy::unwrap_used)]

use stipple::bench::stereo::scenes::hard;
use stipple::bench::stereo::{Base, Runner};
use stipple::output::process::rss_peak_bytes;
use stipple::stereo::Disparity;

#[test]
fn a_hundred_pairs_take_no_more_memory_than_ten() {
    let sets = hard();
    let (w, h) = sets[0].size();
    for method in ["bm", "sgbm"] {
        let mut runner = Runner::new(method, &Base::of(None), (w, h), sets[0].disparities).unwrap();
        let mut found = Disparity::new(w, h);
        let mut run = |n: usize| {
            for pair in (0..n).map(|i| &sets[i % sets.len()].pairs[0]) {
                runner.run(&pair.left, &pair.right, &mut found).unwrap();
            }
            rss_peak_bytes().unwrap()
        };
        let (few, many) = (run(16), run(100));
        println!("{method}: {few} then {many} bytes");
        assert!(many <= few + (1 << 20), "{method}: {few} then {many} bytes");
    }
}
