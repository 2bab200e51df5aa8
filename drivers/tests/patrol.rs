//! Properties of a flight through a building: it keeps clear of every surface, sees every room twice from other sides and in
//! other light, and gives the same bytes again.

#![allow(clippy::unwrap_used)]

use glam::DVec3;
use stipple_drivers::sim::{Scenario, Sim};
use stipple_drivers::{Frames, Span};

const NAMES: [&str; 2] = ["patrol-two", "patrol"];

#[test]
fn the_path_keeps_clear_of_every_surface_and_is_that_of_a_careful_drone() {
    for name in NAMES.into_iter().chain(["twins", "doors"]) {
        let sim = Sim::new(&Scenario::named(name).unwrap()).unwrap();
        let (mut clear, mut speed, mut turn, mut push) = (f64::INFINITY, 0.0f64, 0.0f64, 0.0f64);
        let mut before: Option<DVec3> = None;
        for s in sim.imu().iter().step_by(4) {
            let truth = sim.truth_at(s.t);
            clear = clear.min(sim.clearance(truth.pose.p));
            speed = speed.max(truth.v_world.length());
            turn = turn.max((s.gyro_body - truth.gyro_bias).length());
            push = push.max(before.map_or(0.0, |v| (truth.v_world - v).length() / 0.02));
            before = Some(truth.v_world);
        }
        println!("{name}: {clear:.2} m clear, {speed:.2} m/s, {:.0} deg/s, {push:.2} m/s²", turn.to_degrees());
        assert!(clear >= 0.3, "{name}: {clear} m");
        assert!(speed < 1.2 && turn < 60f64.to_radians() && push < 2.0, "{name}: {speed} {turn} {push}");
    }
}

#[test]
fn every_room_is_seen_twice_from_opposite_headings() {
    for name in NAMES {
        let scenario = Scenario::named(name).unwrap();
        let (sim, second) = (Sim::new(&scenario).unwrap(), scenario.second_round().unwrap());
        let cam = sim.calibration().cameras[0].body_from_cam;
        let mut seen = vec![[vec![], vec![]]; scenario.rooms().len()];
        for s in sim.imu().iter().step_by(20) {
            let pose = sim.truth_at(s.t).pose;
            let room = scenario.room_at(pose.p).unwrap_or_else(|| panic!("{name}: {} is in no room", pose.p));
            let heading = ((pose * cam).q * DVec3::Z).truncate().normalize();
            seen[room][usize::from((s.t - sim.stamp(0)).0 >= second.0)].push((pose.p.truncate(), heading));
        }
        for (room, [first, again]) in scenario.rooms().iter().zip(&seen) {
            assert!(first.len().min(again.len()) > 20, "{name}, {}: {} and {}", room.name, first.len(), again.len());
            if room.corridor {
                continue;
            }
            // Of what the second visit passes near the path of the first, the share seen from another side.
            let (mut near, mut other) = (0, 0);
            for (p, heading) in again {
                let nearest = first.iter().min_by(|a, b| a.0.distance(*p).total_cmp(&b.0.distance(*p))).unwrap();
                if nearest.0.distance(*p) < 1.0 {
                    near += 1;
                    other += usize::from(heading.dot(nearest.1) < 0.5);
                }
            }
            println!("{name}, {}: {other} of {near}", room.name);
            assert!(near > 50 && 2 * other > near, "{name}, {}: {other} of {near}", room.name);
        }
    }
}

/// Rooms that look the same are visited in turn; bays that look the same are passed forth and back.
#[test]
fn places_that_look_the_same_are_passed_twice() {
    for (name, among, expected) in [
        ("twins", &["room a", "room b"][..], "room a, room b, room a, room b"),
        (
            "doors",
            &["bay 1", "bay 5", "bay 8", "room east", "room west"][..],
            "bay 1, bay 5, bay 8, room east, bay 8, bay 5, bay 1, room west, bay 1",
        ),
    ] {
        let scenario = Scenario::named(name).unwrap();
        let sim = Sim::new(&scenario).unwrap();
        let place = |p: DVec3| scenario.room_at(p).unwrap_or_else(|| panic!("{name}: {p} is in no room"));
        let mut passed: Vec<&str> = sim.truth().iter().map(|s| scenario.rooms()[place(s.pose.p)].name).collect();
        passed.retain(|room| among.contains(room));
        passed.dedup();
        assert_eq!(passed.join(", "), expected, "{name}");
    }
}

#[test]
fn the_same_seed_gives_the_same_building_on_any_number_of_threads() {
    let scenario = Scenario { duration: Span::from_secs(60.0), ..Scenario::named("patrol-two").unwrap() };
    let shoot = |scenario: &Scenario, threads: usize| {
        let mut sim = Sim::with_threads(scenario, threads).unwrap();
        let mut frames = Frames::for_rig(sim.calibration());
        let mut shot = |i: usize| {
            sim.render(i, &mut frames);
            frames.images.clone()
        };
        let shots = [0, 130, 392, 560].map(&mut shot);
        (shots, sim.imu().to_vec())
    };
    let one = shoot(&scenario, 1);
    assert!(one == shoot(&scenario, 3));
    let other = shoot(&Scenario { seed: 2, ..scenario }, 2);
    assert!((0..4).all(|k| one.0[k] != other.0[k]) && one.1 != other.1);
}
