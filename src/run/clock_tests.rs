//! Tracking across a step of the clocks.

use super::super::gate::{ImuGate, StampCounters, Stamps};
use super::*;
use crate::world::{Path, World, FRAME_SECS, RATE_HZ};
use stipple_drivers::source::ImuReading;

const PATH: Path = Path { rest: -1.0 };
/// Time at which both clocks go back, and by how much, s.
const STEP_AT: f64 = 12.0;
const BACK: f64 = 10.0;

fn stamp(arrival: f64) -> Nanos {
    Nanos(((arrival - if arrival < STEP_AT { 0.0 } else { BACK }) * 1e9).round() as i64)
}

/// A frame with a pose: when it came, its epoch, by how much its place is off and the stated deviation of that, m.
struct Posed {
    arrival: f64,
    epoch: u32,
    error_m: f64,
    sigma_m: f64,
}

#[test]
fn clocks_that_go_back_for_good_begin_an_epoch_within_seconds() {
    let board = include_str!("../../board-configs/lavapipe.toml");
    let board = Board::parse("lavapipe.toml", board, &[]).expect("a board of ours");
    let mut world = World::new(PATH);
    let run = OdometryRun::new(&world.rig, &board, 1000).expect("a rig of two cameras");
    let OdometryRun { mut front, mut back, .. } = run;
    let (counters, mut imu, mut stamps) = (Counters::default(), ImuGate::new(&world.rig.imu), Stamps::default());
    let frame_counters = StampCounters {
        missing: &counters.frames_missing,
        not_newer: &counters.frames_not_newer,
        jumped: &counters.frames_timestamp_jump,
    };
    let mut packets = [(); 3].map(|()| FramePacket::for_rig(&world.rig, 0));
    let start = back.answer();
    let (mut answer, mut next, mut sample) = (start.clone(), start, 0);
    let (mut posed, mut resets): (Vec<Posed>, usize) = (vec![], 0);
    let mut world_from_truth = None;
    for frame in 0..400 {
        let arrival = f64::from(frame) * FRAME_SECS + 0.0012;
        let packet = &mut packets[0];
        while f64::from(sample) / RATE_HZ < arrival + 1.0 / RATE_HZ {
            let at = f64::from(sample) / RATE_HZ;
            let now = Nanos((at * 1e9) as i64);
            let sample_now = ImuSample { t: stamp(at), ..world.imu(at) };
            let reading = ImuReading { sample: sample_now, ..ImuReading::default() };
            imu.pass(&reading, now, &counters, &mut |s| packet.push_imu(s, &counters));
            sample += 1;
        }
        let mut tracks = Tracks::default();
        world.tracks(arrival, &mut tracks);
        tracks.t = stamp(arrival);
        if !stamps.admit(tracks.t, Nanos((arrival * 1e9) as i64), &frame_counters) {
            continue;
        }
        packet.writable().expect("the front end holds another").t = tracks.t;
        front.track(packet, &answer);
        packet.tracks = tracks;
        back.estimate(packet);
        (answer, next) = (next, back.answer());
        resets += usize::from(packet.health.has(Health::FRAME_GAP_RESET));
        if let (Some(tracked), Some(c)) = (&packet.tracked, back.vio.covariance()) {
            let (pose, truth) = (tracked.world_from_body, PATH.pose(arrival));
            let world_from_truth = *world_from_truth.get_or_insert(pose * truth.inverse());
            let error_m = (pose.p - (world_from_truth * truth).p).length();
            let sigma_m = c[0][0].max(c[1][1]).max(c[2][2]).sqrt();
            posed.push(Posed { arrival, epoch: packet.epoch, error_m, sigma_m });
        }
        packet.clear();
        packets.rotate_left(1);
    }
    let before = posed.iter().rfind(|p| p.arrival < STEP_AT).expect("it flies before");
    assert!(before.epoch == 0 && before.arrival > STEP_AT - 0.1);
    let after = posed.iter().find(|p| p.arrival > STEP_AT).expect("it flies after");
    eprintln!("back after {:.2} s, {:.2} m off of {:.2} m", after.arrival - STEP_AT, after.error_m, after.sigma_m);
    assert!(after.arrival < STEP_AT + 4.0 && after.error_m < 3.0 * after.sigma_m);
    assert!((after.epoch, resets, back.vio.stats().resets_frame_gap) == (1, 1, 1));
    let last = posed.last().expect("it flies to the end");
    assert!(last.epoch == 1 && last.arrival > 19.9, "{} at {}", last.epoch, last.arrival);
}
