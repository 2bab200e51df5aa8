//! Loops on whole flights: drift goes, and a place that looks exactly like another is not taken for it.
#![allow(clippy::unwrap_used)]

use stipple::config::Board;
use stipple::loops::pose4::{wrapped, Pose4};
use stipple::output::OutputDir;
use stipple::run::sensors::Input;
use stipple::run::{fly, Options, Pace, Steps};
use stipple_drivers::replay::read_trajectory;
use stipple_drivers::sim::Scenario;
use stipple_drivers::types::pose_at;
use stipple_drivers::{Nanos, Span};

/// Two rooms that look the same, 14 m apart: a, b, a, b.
#[test]
fn between_rooms_that_look_the_same_each_is_recognised_as_itself() {
    let text = include_str!("../board-configs/lavapipe.toml");
    let board = Board::parse("lavapipe.toml", text, &["map.enabled=false".into()]).unwrap();
    let scenario = Scenario { seed: 5, ..Scenario::named("twins").unwrap() };
    let input = Input::simulated(&scenario, |_, _| ()).unwrap();
    let truth = input.truth.clone();
    let dir = tempfile::tempdir().unwrap();
    let out = OutputDir::create(dir.path()).unwrap();
    let options = Options { pace: Pace::Lockstep(Steps::PerFrame(1)), ..Options::default() };
    let report = fly(input, &board, &out, &options, None).unwrap().report;
    assert!(report.loops.len() >= 10, "{} loops", report.loops.len());
    for l in &report.loops {
        let level = |t| Pose4::upright(&pose_at(&truth, Nanos(t), Span(100_000_000)).unwrap()).0;
        let is = level(l.with_ns).between(&level(l.t_ns));
        let off = (is.p - glam::DVec3::from(l.p_m)).length();
        assert!(off < 0.5 && wrapped(is.yaw - l.yaw_rad).abs() < 0.08, "{off} m: {l:?}");
    }
    let counter = |name: &str| report.counted().find(|(n, _)| *n == name).map_or(0, |(_, n)| n);
    assert!(counter("loops_implausible") > 5, "the other room was seen to look the same, and refused");
    let (with, without) = (report.ate_rmse_m.unwrap(), report.odometry_ate_rmse_m.unwrap());
    assert!(with < without, "{with} {without}");
    assert_eq!(report.heap_after_seal, Some(0));
    // The files have what the report says.
    let [map, odometry] = ["trajectory.tum", "odometry.tum"].map(|name| read_trajectory(&out.file(name)).unwrap());
    assert_eq!(map.len(), odometry.len());
    let moved = map.iter().zip(&odometry).map(|(a, b)| (a.pose.p - b.pose.p).length()).fold(0.0, f64::max);
    assert!(moved > 0.01 && moved < 1.0, "{moved}");
}
