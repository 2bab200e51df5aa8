//! MCAP recordings of a stranger, read for the noise of the inertial unit: what is read is finite, at a rate above zero.
#![no_main]

use libfuzzer_sys::fuzz_target;
use std::sync::LazyLock;
use stipple_drivers::replay::read_inertial;
use stipple_drivers::ImuSample;
use tempfile::TempDir;

static FOLDER: LazyLock<TempDir> = LazyLock::new(|| tempfile::tempdir().expect("the scratch folder can be written to"));

fuzz_target!(|data: &[u8]| {
    let log = FOLDER.path().join("recording-000.mcap");
    std::fs::write(&log, data).expect("the scratch folder can be written to");
    let each = |rate_hz: f64, s: &ImuSample| assert!(rate_hz > 0.0 && rate_hz.is_finite() && s.is_finite());
    if let Err(fault) = read_inertial(&log, each) {
        assert!(!fault.to_string().contains('\n'), "{fault}");
    }
});
