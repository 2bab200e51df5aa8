//! The estimator is as good as it says: errors beside the covariance, and beside the quality. The whole
//! of it, fifty flights, is `stipple bench consistency`.

use stipple::bench::consistency::{at_the_defaults, by_quality, said, told_the_truth};
use stipple::bench::stability;

#[test]
fn errors_are_as_large_as_the_covariance_of_an_estimator_told_the_truth() {
    let told = told_the_truth(16);
    eprintln!("{}", said("told the world's own noise", &told));
    assert_eq!(told.undetermined, 0, "every covariance is symmetric and positive definite");
    assert!((told.bounds.0..=told.bounds.1).contains(&told.mean), "{} is outside {:?}", told.mean, told.bounds);
}

#[test]
fn defaults_claim_less_than_they_know() {
    let defaults = at_the_defaults(4);
    eprintln!("{}", said("at the defaults", &defaults));
    assert!(defaults.undetermined == 0 && (1.0..defaults.bounds.0).contains(&defaults.mean));
}

#[test]
fn error_falls_as_quality_rises() {
    let bins = by_quality(&stability::flights(1), &[10, 20, 65, 100]);
    assert_eq!(bins.len(), 4);
    for pair in bins.windows(2) {
        let [a, b] = pair else { continue };
        eprintln!("{a:?}");
        assert!(a.velocity > b.velocity, "velocity: {a:?} {b:?}");
        // Noise of the mean: a tenth.
        assert!(a.drift > 0.9 * b.drift, "drift: {a:?} {b:?}");
    }
    // What quality 10, 20 and 65 claim, m/s.
    assert!(bins[1].velocity < 0.45 && bins[2].velocity < 0.2 && bins[3].velocity < 0.027, "{bins:?}");
}
