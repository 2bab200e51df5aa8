//! Each kind of fault: what it does to what passes, and what is counted.
#![cfg(test)]
#![allow(clippy::unwrap_used)]

use super::*;
use crate::paced::{Images, Pace, PacedFrames, PacedImu};
use crate::types::{Image, ImuSample};
use std::sync::Arc;

const MS: i64 = 1_000_000;
const FRAMES: i64 = 100;

fn shape() -> Frames {
    Frames { images: vec![Image::new(4, 4)], ..Frames::default() }
}

/// Frames of 20 ms whose pixels say their number, ten times as fast.
fn camera(rules: &[Rule]) -> FaultyFrames {
    let frame = |i: i64| {
        let image = Image { pixels: vec![i as u8 + 1; 16], ..Image::new(4, 4) };
        Frames { t: Nanos(i * 20 * MS), images: vec![image], colours: vec![] }
    };
    let frames: Vec<Frames> = (0..FRAMES).map(frame).collect();
    let stamps: Vec<Nanos> = frames.iter().map(|f| f.t).collect();
    let source = PacedFrames::new(Images::Rendered(frames), stamps, Pace::at_speed(Nanos(0), 10.0));
    FaultyFrames::new(Box::new(source), rules, 7, shape())
}

/// Number by stamp and by pixel of every frame delivered, and how often it was lost.
fn seen(source: &mut impl FrameSource) -> (Vec<(i64, u8)>, u32) {
    let (mut frames, mut seen, mut lost) = (shape(), vec![], 0);
    loop {
        match source.next(Span(20 * MS), &mut frames) {
            Ok(Wait::Got) => seen.push((frames.t.0 / (20 * MS), frames.images[0].pixels[5])),
            Ok(Wait::TimedOut) => {}
            Ok(Wait::Ended) => return (seen, lost),
            Err(SourceFault::Lost(_)) => lost += 1,
            Err(e) => panic!("{e}"),
        }
    }
}

fn count(list: &[(&'static str, u64)], name: &str) -> u64 {
    list.iter().find(|(n, _)| *n == name).map_or(0, |(_, n)| *n)
}

#[test]
fn faults_strike_their_window_and_are_counted_exactly() {
    let mut source = camera(&[
        Rule::within(Kind::Drop, 0.1, 0.2),
        Rule::within(Kind::Freeze, 0.4, 0.6),
        Rule::within(Kind::Blackout, 0.8, 0.9),
        Rule { by_s: 2.0, ..Rule::within(Kind::StampJump, 1.0, 1.02) },
        Rule::within(Kind::Duplicate, 1.2, 1.24),
        Rule::within(Kind::Unplug, 1.4, 1.8),
    ]);
    let (seen, lost) = seen(&mut source);
    let counters = source.counters();
    assert_eq!(count(&counters, "injected_frames_dropped"), 5);
    assert!(!seen.iter().any(|(t, _)| (5..10).contains(t)));
    assert_eq!(count(&counters, "injected_frames_frozen"), 10);
    assert!(seen.iter().filter(|(t, _)| (20..30).contains(t)).all(|(_, px)| *px == 20));
    assert_eq!(count(&counters, "injected_frames_blacked_out"), 5);
    assert_eq!(seen.iter().filter(|(_, px)| *px == 0).count(), 5);
    assert_eq!(count(&counters, "injected_frames_jumped"), 1);
    assert!(seen.contains(&(150, 51)));
    assert_eq!(count(&counters, "injected_frames_duplicated"), 2);
    assert_eq!(seen.iter().filter(|(t, _)| *t == 60).count(), 2);
    assert_eq!(count(&counters, "injected_frames_unplugged"), 20);
    assert_eq!(count(&counters, "injected_camera_unplugs"), 1);
    assert!(lost >= 2, "said at once, and again while it lasts: {lost}");
    assert_eq!(seen.len() as i64, FRAMES - 5 - 20 + 2);
}

#[test]
fn one_camera_alone_is_black_and_away_while_its_rule_lasts() {
    let rule = Rule { camera: Some(0), ..Rule::within(Kind::Unplug, 0.2, 0.4) };
    let (mut source, mut frames) = (camera(&[rule]), shape());
    let mut black = 0;
    while source.next(Span(20 * MS), &mut frames).unwrap() != Wait::Ended {
        let is_black = frames.images[0].pixels == [0; 16];
        assert_eq!(source.away().is_some(), is_black);
        black += usize::from(is_black);
    }
    let counters = source.counters();
    assert_eq!((black, count(&counters, "injected_camera_unplugs")), (10, 1), "{counters:?}");
    assert!(Rule { fault: Kind::Drop, ..rule }.check().is_err());
}

#[test]
fn the_same_seed_strikes_the_same_frames() {
    let rules = [Rule { probability: 0.2, ..Rule::within(Kind::Drop, 0.0, 2.0) }];
    let (mut a, mut b) = (camera(&rules), camera(&rules));
    assert_eq!(seen(&mut a), seen(&mut b));
    let dropped = count(&a.counters(), "injected_frames_dropped");
    assert!((8..35).contains(&dropped), "{dropped}");
}

#[test]
fn what_strikes_lasts_its_length() {
    let rules = [Rule { length_s: 0.1, ..Rule::within(Kind::Gap, 0.5, 0.501) }];
    let mut source = camera(&rules);
    assert_eq!(seen(&mut source).0.len() as i64, FRAMES - 5);
}

#[test]
fn a_unit_fails_as_told() {
    let sample = |i: i64| ImuSample { t: Nanos(i * 5 * MS), gyro_body: DVec3::splat(i as f64), ..ImuSample::default() };
    let samples: Arc<[ImuSample]> = (0..400).map(sample).collect();
    let rules = [
        Rule::within(Kind::Drop, 0.1, 0.2),
        Rule::within(Kind::Freeze, 0.4, 0.6),
        Rule::within(Kind::Duplicate, 0.8, 0.81),
        Rule::within(Kind::BitFlip, 1.0, 1.01),
        Rule::within(Kind::Unplug, 1.2, 1.6),
    ];
    let mut source = FaultyImu::new(Box::new(PacedImu::new(samples, Pace::at_speed(Nanos(0), 10.0))), &rules, 3);
    let (mut batch, mut seen, mut lost) = (ImuBatch::default(), vec![], 0);
    loop {
        match source.next(Span(10 * MS), &mut batch) {
            Ok(Wait::Got) => seen.extend(batch.iter().map(|r| r.sample)),
            Ok(Wait::TimedOut) => {}
            Ok(Wait::Ended) => break,
            Err(_) => lost += 1,
        }
    }
    let c = source.counters();
    let counted = |name: &str| count(&c, name) as usize;
    assert_eq!(
        [counted("injected_imu_dropped"), counted("injected_imu_frozen"), counted("injected_imu_unplugged")],
        [20, 40, 80]
    );
    assert_eq!(seen.iter().filter(|s| s.gyro_body.x == 79.0).count(), 41);
    assert_eq!(seen.len(), 400 - 20 - 80 + counted("injected_imu_duplicated"));
    assert!(lost > 0 && counted("injected_imu_duplicated") == 2 && counted("injected_imu_flipped") == 2);
}

#[test]
fn senseless_rules_are_named() {
    let rule = Rule::within(Kind::Drop, 1.0, 2.0);
    assert!(rule.check().is_ok());
    assert!(Rule { probability: 1.5, ..rule }.check().is_err());
    assert!(Rule { end_s: 0.5, ..rule }.check().is_err());
    assert!(Rule { fault: Kind::Delay, ..rule }.check().is_err());
    assert!(Rule { fault: Kind::Delay, by_s: -1.0, ..rule }.check().is_err());
}
