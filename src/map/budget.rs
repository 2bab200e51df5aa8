//! Who leaves when the pool is full: of those trained often enough to be judged, the least important, as many as the
//! newcomers need. The threshold is read off a histogram of 256 bins; nothing is sorted.

use super::blocks::{importance_of_bin, Bins};

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
}
