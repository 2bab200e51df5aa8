//! The estimator survives what goes wrong on a flight within a stated error, or notices and starts again. The rows are those of `stipple-bench stability`, here on fewer flights;
//! `cargo test --bin stipple-bench stability -- --nocapture` prints them.
#![allow(clippy::unwrap_used)]

use super::{
    agrees_after, cases, judge, rendered, table, unannounced, Case, Row, Verdict, AGREES_WITHIN_S, THREE_SIGMA,
};
use crate::flight::{record, Plan, Record};
use crate::world::Noise;
use glam::{DQuat, DVec3};
use std::sync::OnceLock;
use stipple::output::metrics::trajectory_error;
use stipple::vio::instruments::Stats;
use stipple::vio::Health;
use stipple_drivers::{ImuSample, Nanos, Pose, TimedPose};

struct Run {
    ate: f64,
    /// Distance of the estimate from its first, at the end.
    travelled: f64,
    stats: Stats,
    /// Frames with saturated samples.
    saturated: usize,
}

fn run(plan: &Plan) -> Run {
    let (records, vio) = record(plan, 7);
    let estimated: Vec<TimedPose> = records.iter().filter_map(|r| r.estimate).collect();
    let truth: Vec<TimedPose> = records.iter().map(|r| r.truth).collect();
    let (first, last) = (estimated[0].pose.p, estimated[estimated.len() - 1].pose.p);
    let ate = trajectory_error(&estimated, &truth).unwrap().ate_rmse_m;
    let saturated = records.iter().filter(|r| r.health.has(Health::IMU_SATURATED)).count();
    Run { ate, travelled: first.distance(last), stats: *vio.stats(), saturated }
}

fn resting(_: f64) -> Pose {
    Pose::new(DQuat::from_rotation_z(0.3), DVec3::new(0.2, -0.1, 0.3))
}

#[test]
fn zero_velocity_update_stops_the_creep_of_a_resting_rig() {
    let held = run(&Plan { pose: resting, ..Plan::default() });
    let free = run(&Plan { pose: resting, config: |c| c.zero_velocity = false, ..Plan::default() });
    let updates = [held.stats, free.stats].map(|s| s.zero_velocity_updates);
    let moved = (held.travelled, free.travelled);
    eprintln!("at rest 8 s: {updates:?} updates, moved {moved:.5?} m, ATE {:.5} and {:.5} m", held.ate, free.ate);
    assert!(updates[0] > 140 && updates[1] == 0);
    assert!(held.travelled < 0.002 && held.ate <= free.ate);
}

#[test]
fn flight_is_never_taken_for_rest() {
    assert_eq!(run(&Plan::default()).stats.zero_velocity_updates, 0);
}

/// A gyro of 0.3 rad/s and an accelerometer of 1.07 g: this flight leaves both.
fn clip(s: &mut ImuSample, _: &mut Noise) {
    s.gyro_body = s.gyro_body.clamp(DVec3::splat(-0.3), DVec3::splat(0.3));
    s.accel_body = s.accel_body.clamp(DVec3::splat(-10.5), DVec3::splat(10.5));
}

#[test]
fn clipped_samples_harm_less_when_the_range_is_known() {
    let told = run(&Plan { range: [0.3, 10.5], warp: clip, ..Plan::default() });
    let untold = run(&Plan { warp: clip, ..Plan::default() });
    let (n, resets) = (told.saturated, untold.stats.resets);
    eprintln!(
        "{n} frames with clipped samples: ATE {:.4} m; range not known {:.4} m, {resets} resets",
        told.ate, untold.ate
    );
    assert!(n > 40 && untold.saturated == 0);
    assert!(told.ate < 0.03 && told.ate < 0.7 * untold.ate && told.stats.resets == 0);
}

/// The cases on made-up tracks, flown once for all tests that look at them: what was recorded, and a row each.
pub fn flown() -> &'static (Vec<Vec<Record>>, Vec<Row>) {
    static FLOWN: OnceLock<(Vec<Vec<Record>>, Vec<Row>)> = OnceLock::new();
    FLOWN.get_or_init(|| {
        let fly = |case: &Case| {
            let (records, vio) = record(&case.plan, 1);
            let row = judge(case, &records, &vio);
            (records, row)
        };
        cases::all().iter().map(fly).unzip()
    })
}

#[test]
fn flights_gone_wrong_are_survived_or_noticed() {
    let (_, rows) = flown();
    let rows = [&rows[..], &rendered::rows("").unwrap()].concat();
    eprintln!("{}", table(&rows).text());
    let complaints: Vec<String> = rows.iter().filter_map(|r| r.complaint()).collect();
    assert!(complaints.is_empty(), "{complaints:#?}");
}

/// Frames flown after a fault that ended, where only the restart matters.
const RESTART_FRAMES: usize = 40;

/// The cases that end in one reset and go on, for a closer look at how; until so many frames after the fault.
fn recovering(seed: u64, frames: usize) -> Vec<(&'static str, Vec<Record>, Stats)> {
    let mut flown = Vec::new();
    for mut case in cases::all() {
        let Some((_, to)) = case.fault.filter(|f| case.expect == Verdict::Reset && f.1 != usize::MAX) else { continue };
        case.plan.frames = to + frames;
        let (records, vio) = record(&case.plan, seed);
        flown.push((case.name, records, *vio.stats()));
    }
    flown
}

/// Whatever ended the estimate: one reset is counted, the restart stands where the covariance says, and so
/// does every frame after it.
#[test]
fn restart_goes_on_from_the_trusted_pose_with_honest_covariance() {
    for (name, records, stats) in (0..8).flat_map(|seed| recovering(100 + seed, RESTART_FRAMES)) {
        assert_eq!(stats.resets, 1, "{name}: {stats:?}");
        let after: Vec<_> = records.iter().skip_while(|r| r.resets == 0).filter(|r| r.estimate.is_some()).collect();
        assert!(after.len() > 10, "{name}: {} frames after the restart", after.len());
        for r in [after[0], after[after.len() - 1]] {
            let sigmas = r.position_sigmas.unwrap();
            assert!(sigmas < THREE_SIGMA, "{name}, frame {}: {sigmas:.1} sigma from the truth", r.frame);
        }
    }
}

/// A restart is worth what it says: whoever flies by the quality gets no better claim than the velocity earns.
#[test]
fn quality_agrees_with_the_error_within_three_seconds_of_a_restart() {
    // A second more than the quality has to agree, so that it also stays so.
    for (name, records, _) in (0..4).flat_map(|seed| recovering(200 + seed, 80)) {
        let after = agrees_after(&records).expect("it starts again");
        eprintln!("{name}: {after:.2} s");
        assert!(after <= AGREES_WITHIN_S, "{name}: the quality claims too much until {after:.2} s after the restart");
    }
}

/// A flight at rest in the truth.
fn made_up(frame: usize) -> Record {
    let truth = TimedPose { t: Nanos(frame as i64 * 50_000_000), pose: Pose::IDENTITY };
    let (estimate, health) = (Some(truth), Health::default());
    Record { frame, truth, estimate, health, quality: 80, resets: 0, position_sigmas: None, velocity_error: None }
}

#[test]
fn a_quality_agrees_up_to_one_bin_above_what_the_error_earns() {
    // An error of 50 mm/s earns 50, which is in the bin below 51 to 65. The reset comes at frame 10, the first pose at frame 20.
    let flight = |claims: fn(usize) -> u8| -> Vec<Record> {
        let record = |frame| Record {
            resets: u64::from(frame >= 10),
            velocity_error: (frame >= 20).then_some(0.05),
            quality: claims(frame),
            ..made_up(frame)
        };
        (0..60).map(record).collect()
    };
    let after = |claims| agrees_after(&flight(claims)).unwrap();
    assert_eq!([after(|_| 65), after(|_| 3), after(|_| 66)], [0.0, 0.0, f64::INFINITY]);
    assert_eq!([after(|i| if i < 40 { 90 } else { 60 }), after(|i| if i == 30 { 70 } else { 50 })], [1.0, 0.55]);
    assert_eq!(agrees_after(&flight(|_| 90)[..20]), None, "no pose follows the reset");
}

/// Half a metre to the side from frame 10 on; `warned` frames of it say so.
fn shifted(warned: std::ops::Range<usize>) -> f64 {
    let record = |frame: usize| {
        let r = made_up(frame);
        let off = Pose { p: DVec3::X * if frame < 10 { 0.0 } else { 0.5 }, ..Pose::IDENTITY };
        let health = if warned.contains(&frame) { Health::VISION_DISAGREES } else { Health::default() };
        Record { estimate: Some(TimedPose { pose: off, ..r.truth }), health, ..r }
    };
    unannounced(&(0..30).map(record).collect::<Vec<_>>(), 10)
}

#[test]
fn an_error_counts_unless_it_is_said_within_a_tenth_of_a_second_and_for_as_long_as_it_lasts() {
    assert_eq!([shifted(0..0), shifted(13..30), shifted(12..30), shifted(10..20)], [0.5, 0.5, 0.0, 0.5]);
    // Four clean frames between warnings are not enough to rely on it.
    assert_eq!(shifted(10..26), 0.0);
}
