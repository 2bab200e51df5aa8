//! What needs neither a daemon nor a DDS.
#![cfg(test)]
#![allow(clippy::unwrap_used)]

use crate::cloud::cloud;
use crate::convert::{time, transform, Frames, Stamps, UNKNOWN};
use crate::diagnostics::{wall_ns, Monitor};
use crate::messages::{Odometry, Time, ERROR, OK, WARN};
use crate::socket::{Connection, Event, Heard, MapFromOdom, Points, State, Status};
use glam::{DQuat, DVec3, EulerRot};
use std::io::{Read, Write};
use std::os::unix::net::UnixListener;

/// Mounting in the EuRoC vehicle: the unit's z is forward, y right, x up.
const EUROC: [f64; 3] = [0.0, 90.0, 0.0];

fn state(q: DQuat, velocity_body: [f64; 3]) -> State {
    State {
        t_ns: 1,
        wall_ns: 1,
        epoch: 0,
        quality: 80,
        source: "frame".into(),
        position: [1.0, 2.0, 3.0],
        orientation: q.to_array(),
        velocity_body,
        rate_body: [0.1, 0.2, 0.3],
        pose_covariance: None,
        velocity_covariance: None,
    }
}

fn frames(mount_rpy_deg: [f64; 3]) -> Frames {
    Frames::new(["map", "odom", "base_link"], mount_rpy_deg)
}

fn told(frames: &Frames, state: &State) -> Odometry {
    frames.odometry(state, time(0).unwrap()).unwrap()
}

#[test]
fn base_has_its_axes_forward_left_and_up() {
    for (of_body, of_base) in [(DVec3::Z, DVec3::X), (DVec3::Y, DVec3::NEG_Y), (DVec3::X, DVec3::Z)] {
        assert!((frames(EUROC).base_from_body * of_body - of_base).length() < 1e-12);
    }
    for axis in DVec3::AXES {
        let of_base = frames([180.0, 0.0, 0.0]).base_from_body * axis;
        assert!((of_base - axis).length() < 1e-12, "a unit whose x is forward and z up needs no turn");
    }
}

#[test]
fn vehicle_that_climbs_forward_in_a_left_turn_says_so() {
    // Level, its nose to the north of odom, which is y. The unit's z is forward, its x up.
    let (forward, up) = (DVec3::Y, DVec3::Z);
    let odom_from_body = DQuat::from_mat3(&glam::DMat3::from_cols(up, forward.cross(up), forward));
    let mut s = state(odom_from_body, [0.5, 0.0, 2.0]);
    s.rate_body = [0.3, 0.0, 0.0];
    let o = told(&frames(EUROC), &s);
    let q = DQuat::from_array(o.orientation);
    assert!((q * DVec3::X - DVec3::Y).length() < 1e-12 && (q * DVec3::Z - DVec3::Z).length() < 1e-12);
    let near = |a: [f64; 3], b: [f64; 3]| assert!((DVec3::from(a) - DVec3::from(b)).length() < 1e-12, "{a:?} {b:?}");
    near(o.linear, [2.0, 0.0, 0.5]);
    near(o.angular, [0.0, 0.0, 0.3]);
    near(o.position, s.position);
    let t = transform(&o);
    assert_eq!((t.translation, t.rotation, &t.header), (o.position, o.orientation, &o.header));
    assert_eq!((o.header.frame_id.as_str(), t.child_frame_id.as_str()), ("odom", "base_link"));
}

#[test]
fn odom_is_where_the_last_recognised_place_puts_it() {
    let frames = frames(EUROC);
    let o = told(&frames, &state(DQuat::IDENTITY, [0.0; 3]));
    let found = MapFromOdom { position: [1.0, -2.0, 0.5], yaw: std::f64::consts::FRAC_PI_2 };
    let t = frames.map_from_odom(&o, Some(found));
    assert_eq!(
        (t.header.frame_id.as_str(), t.child_frame_id.as_str(), &t.header.stamp),
        ("map", "odom", &o.header.stamp)
    );
    assert_eq!(t.translation, found.position);
    assert!((DQuat::from_array(t.rotation) * DVec3::X - DVec3::Y).length() < 1e-12);
    let broken = MapFromOdom { yaw: f64::NAN, ..found };
    for told in [None, Some(broken)] {
        let t = frames.map_from_odom(&o, told);
        assert_eq!((t.translation, t.rotation), ([0.0; 3], [0.0, 0.0, 0.0, 1.0]));
    }
}

/// Errors of the state along the columns of a factor of its covariance, and what becomes of them in a message.
#[test]
fn covariances_are_those_of_the_turned_errors() {
    const H: f64 = 1e-6;
    let frames = frames([10.0, 20.0, 30.0]);
    let base = state(DQuat::from_euler(EulerRot::XYZ, 0.4, -1.1, 2.0), [0.7, 0.2, -0.4]);
    let factor = |i: usize, j: usize| ((7 * i + 13 * j) as f64).sin();
    let entry = |from: usize, size: usize, i: usize, j: usize| -> f64 {
        (0..size).map(|k| factor(from + i, k) * factor(from + j, k)).sum()
    };
    let mut covered = base.clone();
    covered.pose_covariance = Some((0..36).map(|n| entry(0, 6, n / 6, n % 6)).collect());
    covered.velocity_covariance = Some((0..9).map(|n| entry(6, 3, n / 3, n % 3)).collect());
    let exact = told(&frames, &covered);
    let (mut pose, mut twist) = ([[0.0; 6]; 6], [[0.0; 3]; 3]);
    for column in 0..6 {
        let part = |from: usize| DVec3::from_array(std::array::from_fn(|i| H * factor(from + i, column)));
        let mut moved = base.clone();
        moved.position = (DVec3::from(base.position) + part(0)).to_array();
        moved.orientation = (DQuat::from_scaled_axis(part(3)) * DQuat::from_array(base.orientation)).to_array();
        if column < 3 {
            moved.velocity_body = (DVec3::from(base.velocity_body) + part(6)).to_array();
        }
        let o = told(&frames, &moved);
        let turned = DQuat::from_array(o.orientation) * DQuat::from_array(exact.orientation).conjugate();
        let difference = |a: [f64; 3], b: [f64; 3]| ((DVec3::from(a) - DVec3::from(b)) / H).to_array();
        let rotation = ((if turned.w < 0.0 { -turned } else { turned }).to_scaled_axis() / H).to_array();
        let errors = [difference(o.position, exact.position), rotation].concat();
        let of_twist = difference(o.linear, exact.linear);
        (0..36).for_each(|n| pose[n / 6][n % 6] += errors[n / 6] * errors[n % 6]);
        (0..9).for_each(|n| twist[n / 3][n % 3] += of_twist[n / 3] * of_twist[n % 3]);
    }
    for (i, j) in (0..36).map(|n| (n / 6, n % 6)) {
        assert!((pose[i][j] - exact.pose_covariance[i][j]).abs() < 1e-4, "pose {i} {j}");
        let linear = if i < 3 && j < 3 { twist[i][j] } else { 0.0 };
        let expected = if i == j && i >= 3 { 1e-4 } else { linear };
        assert!((expected - exact.twist_covariance[i][j]).abs() < 1e-4, "twist {i} {j}");
    }
}

#[test]
fn what_is_not_finite_or_no_matrix_is_not_told_and_what_is_unknown_is_wide() {
    let frames = frames(EUROC);
    let good = state(DQuat::IDENTITY, [0.0; 3]);
    for bad in [f64::NAN, f64::INFINITY] {
        let mut spoiled = vec![good.clone(); 6];
        spoiled[0].position[1] = bad;
        spoiled[1].orientation[0] = bad;
        spoiled[2].velocity_body = [bad; 3];
        spoiled[3].rate_body[2] = bad;
        spoiled[4].velocity_covariance = Some(vec![bad; 9]);
        spoiled[5].pose_covariance = Some(vec![bad; 36]);
        assert!(spoiled.iter().all(|state| frames.odometry(state, time(0).unwrap()).is_none()));
    }
    let large = State { velocity_covariance: Some(vec![f64::MAX; 9]), ..good.clone() };
    assert!(self::frames([10.0, 20.0, 30.0]).odometry(&large, time(0).unwrap()).is_none(), "not finite once turned");
    for (pose, velocity) in [(35, 9), (36, 8), (0, 9), (36, 10)] {
        let mut short = good.clone();
        (short.pose_covariance, short.velocity_covariance) = (Some(vec![1.0; pose]), Some(vec![1.0; velocity]));
        assert!(frames.odometry(&short, time(0).unwrap()).is_none(), "{pose} {velocity}");
    }
    let zero = State { orientation: [0.0; 4], ..good.clone() };
    assert!(frames.odometry(&zero, time(0).unwrap()).is_none());
    let known = State { pose_covariance: Some(vec![1.0; 36]), velocity_covariance: Some(vec![1.0; 9]), ..good.clone() };
    for unknown in [good, State { quality: 0, ..known }] {
        let o = told(&frames, &unknown);
        let of = |i: usize| (o.pose_covariance[i][i], o.twist_covariance[i][i]);
        assert_eq!((of(0), of(5).0), ((UNKNOWN, UNKNOWN), UNKNOWN));
    }
}

#[test]
fn stamps_only_grow_whatever_the_clock_does() {
    let mut stamps = Stamps::default();
    let at = |sec, nanosec| Some(Time { sec, nanosec });
    assert_eq!(stamps.stamp(1_000, 5_000_000_007), at(5, 7));
    assert_eq!(stamps.stamp(1_000, 5_000_000_007), None, "the same again");
    assert_eq!(stamps.stamp(900, 4_000_000_000), None, "an older one");
    assert_eq!(stamps.stamp(1_500, 3_000_000_000), at(5, 507), "the wall clock was set back");
    assert_eq!(stamps.ahead_ns, 2_000_000_507);
    assert_eq!(stamps.stamp(2_500, 3_000_001_000), at(5, 1_507));
    assert_eq!(stamps.stamp(3_500, 6_000_000_000), at(6, 0), "and forward");
    assert_eq!(stamps.ahead_ns, 0);
    assert_eq!(stamps.stamp(4_000, i64::MAX), None, "no time of ROS");
    assert_eq!(stamps.stamp(4_000, 6_000_000_001), at(6, 1), "which leaves no mark");
    assert_eq!((time(-1), time(i64::MIN), time(i64::MAX)), (None, None, None));
}

#[test]
fn lines_come_whole_in_parts_and_too_long() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("status");
    let listener = UnixListener::bind(&path).unwrap();
    let writer = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        assert_eq!(stream.read(&mut [0; 8]).unwrap(), 3, "the request");
        stream.write_all(b"one\ntw").unwrap();
        std::thread::sleep(std::time::Duration::from_millis(250));
        stream.write_all(b"o\n").unwrap();
        stream.write_all(&vec![b'x'; 1 << 20]).unwrap();
        stream.write_all(b"\n\nthree\n12345678four\nfi").unwrap();
    });
    let mut connection = Connection::open(&path, "{}").unwrap();
    let mut heard = vec![];
    let end = loop {
        match connection.next() {
            Ok(Heard::Line(b"three\n")) => {
                heard.push("three".into());
                let mut bytes = vec![];
                while bytes.len() < 8 {
                    connection.more(&mut bytes, 8).unwrap();
                }
                heard.push(String::from_utf8(bytes).unwrap());
            }
            Ok(Heard::Line(line)) => heard.push(String::from_utf8(line.trim_ascii_end().to_vec()).unwrap()),
            Ok(Heard::TooLong) => heard.push("too long".into()),
            Ok(Heard::Nothing) => {}
            Err(e) => break e,
        }
    };
    assert_eq!(heard, ["one", "two", "too long", "", "three", "12345678", "four"]);
    assert_eq!(end.kind(), std::io::ErrorKind::UnexpectedEof, "half a line is none");
    writer.join().unwrap();
    assert!(Connection::open(&dir.path().join("absent"), "{}").is_err());
}

#[test]
fn cloud_has_the_points_that_are_finite_as_ros_packs_them() {
    let points = |count| Points { generation: 1, wall_ns: 1_500_000_000, epoch: 0, count, stride: 16 };
    let point =
        |x: f32, rgba: [u8; 4]| [x, 2.0, 3.0].iter().flat_map(|n| n.to_le_bytes()).chain(rgba).collect::<Vec<u8>>();
    let bytes = [point(1.0, [10, 20, 30, 255]), point(f32::NAN, [0; 4]), point(4.0, [255, 255, 255, 51])].concat();
    let message = cloud(&points(3), &bytes, "odom").unwrap();
    assert_eq!((message.width, message.row_step, message.data.len()), (2, 40, 40));
    assert_eq!(message.header.stamp, Time { sec: 1, nanosec: 500_000_000 });
    let word = |at: usize| u32::from_le_bytes(message.data[at..at + 4].try_into().unwrap());
    assert_eq!((word(12), f32::from_bits(word(16))), (0x000a_141e, 1.0));
    assert_eq!((f32::from_bits(word(20)), word(32), f32::from_bits(word(36))), (4.0, 0x00ff_ffff, 0.2));
    assert!(cloud(&points(1), &point(f32::INFINITY, [0; 4]), "odom").is_none(), "an empty cloud");
}

#[test]
fn level_is_that_of_the_worst() {
    let monitor = || {
        let mut monitor = Monitor::new("stipple/odometry".into());
        monitor.link(None);
        monitor.state(&state(DQuat::IDENTITY, [0.0; 3]), 0);
        monitor
    };
    let level = |monitor: &Monitor| monitor.report().level;
    assert_eq!(level(&Monitor::new(String::new())), ERROR);
    assert_eq!(monitor().report().message, "odometry is running");
    let with = |change: fn(&mut State)| {
        let (mut monitor, mut state) = (monitor(), state(DQuat::IDENTITY, [0.0; 3]));
        change(&mut state);
        let said = monitor.state(&state, 0);
        (level(&monitor), said.is_some())
    };
    assert_eq!(with(|s| s.quality = 0), (ERROR, false));
    assert_eq!(with(|s| s.source = "dead_reckoned".into()), (ERROR, false));
    assert_eq!(with(|s| s.quality = 20), (WARN, false));
    assert_eq!(with(|s| s.epoch = 1), (WARN, true));
    let event = |level: &str, age_s: i64| {
        let wall_ns = wall_ns() - age_s * 1_000_000_000;
        let mut monitor = monitor();
        monitor.event(Event { wall_ns, id: "sensor-lost".into(), level: level.into(), text: "camera".into() });
        monitor.report().level
    };
    assert_eq!([("critical", 0), ("warning", 0), ("notice", 0)].map(|(l, age)| event(l, age)), [ERROR, WARN, OK]);
    assert_eq!(event("critical", 60), OK, "what was kept from long ago");
    let mut ill = monitor();
    ill.status(Status { health: vec!["no light".into()], uptime_s: 9.0, ..Status::default() });
    assert_eq!((level(&ill), ill.report().message.as_str()), (WARN, "no light"));
    assert!(ill.status(Status { uptime_s: 1.0, ..Status::default() }).unwrap().contains("started anew"));
    assert!(ill.link(Some("gone".into())) && !ill.link(Some("gone".into())), "told once");
    assert_eq!((level(&ill), ill.report().message.starts_with("no daemon: gone; ")), (ERROR, true));
}
