//! A flight through a building, rendered as it is flown: odometry stays with it, and its memory does not grow.
#![allow(clippy::unwrap_used)]

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::Arc;
use stipple::config::Board;
use stipple::output::OutputDir;
use stipple::run::sensors::Input;
use stipple::run::{fly, KeyframesAt, Options, Pace, Spacing, Steps};
use stipple_drivers::sim::Scenario;
use stipple_drivers::{host, Span};

/// Flies so much of the patrol of two rooms without a map; answers the report, and the resident set after a third of it and at
/// its end, bytes.
fn flown(seconds: f64, at_truth: Option<KeyframesAt>) -> (stipple::output::report::Report, [u64; 2]) {
    let board = include_str!("../board-configs/lavapipe.toml");
    let board = Board::parse("lavapipe.toml", board, &["map.enabled=false".into()]).unwrap();
    let scenario = Scenario { duration: Span::from_secs(seconds), ..Scenario::named("patrol-two").unwrap() };
    let seen = Arc::new([AtomicU64::new(0), AtomicU64::new(0)]);
    let tell = seen.clone();
    let input = Input::simulated(&scenario, move |frame, of| {
        let rss = host::rss_bytes().unwrap_or(0);
        tell[usize::from(frame > of / 3)].store(rss, Relaxed);
    });
    let dir = tempfile::tempdir().unwrap();
    let out = OutputDir::create(&dir.path().join("out")).unwrap();
    let options = Options { pace: Pace::Lockstep(Steps::PerFrame(0)), at_truth, ..Options::default() };
    let report = fly(input.unwrap(), &board, &out, &options, None).unwrap().report;
    (report, [seen[0].load(Relaxed), seen[1].load(Relaxed)])
}

#[test]
fn odometry_follows_two_rounds_of_two_rooms_in_memory_that_stays_level() {
    let (report, [early, late]) = flown(85.0, None);
    println!("ATE {:?} m, {early} then {late} bytes", report.ate_rmse_m);
    assert_eq!((report.frames, report.epochs, report.heap_after_seal), (Some(851), Some(1), Some(0)));
    assert!(report.ate_rmse_m.unwrap() < 0.3, "{:?}", report.ate_rmse_m);
    // Frames of two 376x240 cameras would take 50 MiB more.
    assert!(late < early + (8 << 20), "{early} then {late}");
}

#[test]
fn keyframes_at_true_poses_are_as_far_apart_as_asked() {
    let spacing = Spacing { moved_m: 0.5, turned_rad: 0.262, waited_s: 1.0 };
    let (report, _) = flown(12.0, Some(KeyframesAt::Spaced(spacing)));
    // One a second at rest and while it flies straight at 0.9 m/s two a second at most; turns add theirs.
    let keyframes = report.keyframes.unwrap();
    assert!(report.frames == Some(121) && (12..40).contains(&keyframes), "{keyframes}");
}
