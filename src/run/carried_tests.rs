//! Which frames the front end leaves to inertia.

use super::*;
use crate::world::{room, stream, World, FRAME_SECS, RATE_HZ};
use glam::{DQuat, DVec3};
use std::ops::Range;

/// Time of rest, in which odometry becomes sure, and from which on frames are counted, s.
const REST: f64 = 3.0;
const COUNTED: f64 = 5.0;
const END: f64 = 9.0;

/// At rest, then turning about the upright, rad/s.
fn turning(rate: f64) -> impl Fn(f64) -> Pose {
    move |t| {
        let (since, gathers) = ((t - REST).max(0.0), 1.0);
        let turned = if since < gathers { since * since / 2.0 } else { since - gathers / 2.0 };
        Pose::new(DQuat::from_rotation_z(rate * turned), DVec3::ZERO)
    }
}

/// Whether each frame after `COUNTED` was left to inertia; `spoil` may change a sample.
fn left_out(pose: impl Fn(f64) -> Pose + 'static, set: &[&str], spoil: impl Fn(f64, &mut ImuSample)) -> Vec<bool> {
    let set: Vec<String> = set.iter().map(|s| s.to_string()).collect();
    let board = include_str!("../../board-configs/lavapipe.toml");
    let board = Board::parse("lavapipe.toml", board, &set).expect("a board of ours");
    let mut noise = stream(1, 1);
    let points = room(1500, &mut noise);
    let mut world = World::seen_from(pose, points, noise);
    let run = OdometryRun::new(&world.rig, &board, 1000).expect("a rig of two cameras");
    let OdometryRun { mut front, mut back, .. } = run;
    let mut packets = [(); 3].map(|()| FramePacket::for_rig(&world.rig, 0));
    let (counters, start) = (Counters::default(), back.answer());
    let (mut answer, mut next, mut sample, mut found) = (start.clone(), start, 0, vec![]);
    for frame in 0..(END / FRAME_SECS) as i32 {
        let at = f64::from(frame) * FRAME_SECS + 0.0012;
        let packet = &mut packets[0];
        while f64::from(sample) / RATE_HZ < at + 1.0 / RATE_HZ {
            let t = f64::from(sample) / RATE_HZ;
            let mut s = world.imu(t);
            spoil(t, &mut s);
            packet.push_imu(s, &counters);
            sample += 1;
        }
        let mut tracks = Tracks::default();
        world.tracks(at, &mut tracks);
        packet.writable().expect("the front end holds another").t = tracks.t;
        front.track(packet, &answer);
        packet.tracks = tracks;
        back.estimate(packet);
        (answer, next) = (next, back.answer());
        if at > COUNTED {
            assert!(packet.tracked.is_some(), "a pose at {at}");
            found.push(packet.carried);
        }
        packet.clear();
        packets.rotate_left(1);
    }
    found
}

fn count(left_out: &[bool]) -> usize {
    left_out.iter().filter(|left_out| **left_out).count()
}

#[test]
fn every_other_frame_is_left_out_at_rest_and_in_a_slow_turn() {
    for rate in [0.0, 0.3] {
        let found = left_out(turning(rate), &[], |_, _| ());
        assert!(count(&found) * 5 > found.len() * 2, "{rate} rad/s: {} of {}", count(&found), found.len());
        assert!(found.windows(2).all(|two| two != [true; 2]), "{rate} rad/s: two in a row");
    }
}

#[test]
fn no_frame_is_left_out_in_a_fast_turn_or_where_nothing_may_be() {
    assert_eq!(count(&left_out(turning(2.0), &[], |_, _| ())), 0);
    assert_eq!(count(&left_out(turning(0.0), &["frontend.carried_px=0"], |_, _| ())), 0);
}

#[test]
fn no_frame_is_left_to_samples_that_are_doubted_or_saturated() {
    const SPOILT: Range<f64> = 6.0..8.0;
    let spoilers: [fn(&mut ImuSample); 2] = [|s| s.doubted = true, |s| s.saturated = [true, false]];
    for spoil in spoilers {
        // One sample of each frame.
        let one_in_ten = |t: f64| (t * RATE_HZ).round() as i64 % 10 == 5;
        let found = left_out(turning(0.0), &[], |t, s| {
            if SPOILT.contains(&t) && one_in_ten(t) {
                spoil(s);
            }
        });
        let at = |t: f64| ((t - COUNTED) / FRAME_SECS) as usize;
        assert_eq!(count(&found[at(SPOILT.start) + 2..at(SPOILT.end)]), 0);
        assert!(count(&found[..at(SPOILT.start)]) > 5);
    }
}
