//! What an autopilot hears of a run, by pymavlink as the other end (tests/autopilot/other_end.py), which has models of the gates of
//! PX4 and of ArduPilot: over UDP and over a pseudo-terminal that is read as fast as a UART gives bytes; through resets, a cut
//! line, a reader that stalls, and damaged messages.

use crate::start::{flight, stipple, text, BOARD};
use glam::{DQuat, DVec3, EulerRot};
use mavlink::dialects::common::{MavAutopilot, HEARTBEAT_DATA};
use mavlink::{MAVLinkV2MessageRaw, MavHeader};
use serde_json::Value;
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::UdpSocket;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use stipple::run::log::read::{read_files, runs, Message};

/// Severities of STATUSTEXT.
const CRITICAL: u64 = 2;
const NOTICE: u64 = 5;
/// The unit of the simulated rig, EuRoC's: its z is forward, its x up.
const MOUNT: &str = "mavlink.mount_rpy_deg=[0, 90, 0]";

/// Where `make test` puts pymavlink; where it could not, this says so, and a test is left out.
fn is_left_out() -> bool {
    let is_there = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/python/pymavlink").is_dir();
    if !is_there {
        eprintln!("left out: there is no pymavlink in target/python; `make target/python/pymavlink` fetches it");
    }
    !is_there
}

/// The other end of a link, and the link.
struct OtherEnd(Child, BufReader<std::process::ChildStdout>, String);

fn listen(arguments: &[&str]) -> OtherEnd {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut python = Command::new("python3");
    python.arg(root.join("tests/autopilot/other_end.py")).args(arguments).env("PYTHONPATH", root.join("target/python"));
    let mut child = python.stdout(Stdio::piped()).spawn().unwrap();
    let (mut lines, mut first) = (BufReader::new(child.stdout.take().unwrap()), String::new());
    lines.read_line(&mut first).unwrap();
    let link = first.strip_prefix("ready ").expect("pymavlink is where `make test` puts it").trim().to_string();
    OtherEnd(child, lines, link)
}

impl OtherEnd {
    fn heard(mut self) -> Value {
        let mut rest = String::new();
        self.1.read_to_string(&mut rest).unwrap();
        assert!(self.0.wait().unwrap().success());
        serde_json::from_str(&rest).unwrap()
    }
}

/// Flies a recording with an autopilot at the other end; the report, what was heard, and what was said.
fn fly(data: &Path, out: &Path, other: &[&str], more: &[&str]) -> (Value, Value, String) {
    let other = listen(other);
    let link = format!("mavlink.link={}", other.2);
    let mut run = stipple();
    run.args(["run", "--board", BOARD, "--set", "map.enabled=false", "--set", &link, "--set", MOUNT]);
    run.args(["--dataset", data.to_str().unwrap(), "--out", out.to_str().unwrap()]).args(more);
    let o = run.output().unwrap();
    assert!(o.status.success(), "{}", text(&o));
    let report = serde_json::from_slice(&fs::read(out.join("report.json")).unwrap()).unwrap();
    (report, other.heard(), text(&o))
}

fn rules(dir: &Path, text: &str) -> String {
    let path = dir.join("inject.toml");
    fs::write(&path, text).unwrap();
    path.to_str().unwrap().into()
}

fn count(report: &Value, name: &str) -> u64 {
    report.get(format!("count_{name}")).and_then(Value::as_u64).unwrap_or(0)
}

/// Everything that was sent arrived, in messages that both autopilots take.
#[track_caller]
fn whole_and_taken(heard: &Value, report: &Value) {
    assert_eq!((&heard["lost"], &heard["nan"], &heard["bad"]), (&0.into(), &0.into(), &0.into()), "{heard}");
    assert_eq!(heard["counts"]["ODOMETRY"].as_u64().unwrap(), count(report, "mavlink_states_sent"), "{heard}");
    assert!(heard["px4"]["refused"] == 0 && heard["ardupilot"]["refused"] == 0, "{heard}");
}

#[test]
fn both_autopilots_take_every_state_in_their_own_axes_and_clocks() {
    if is_left_out() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (flight(dir.path(), "8"), dir.path().join("out"));
    let (report, heard, said) = fly(&data, &out, &["udp", "9", "--states"], &[]);
    whole_and_taken(&heard, &report);
    assert!(heard["px4"]["gaps"] == 0 && heard["ardupilot"]["unhealthy"] == 0, "{heard}");
    // A ground vehicle would not know it: onboard controller, no autopilot; the state is active at the end.
    let beats = heard["heartbeats"].as_array().unwrap();
    assert!(
        (7..=10).contains(&beats.len())
            && beats.last().unwrap().as_array().unwrap()[1..] == [18, 8, 4].map(Value::from),
        "{beats:?}"
    );
    assert!(said.contains("autopilot: heard on udpout:127.0.0.1"), "{said}");
    assert!(said.contains("PX4, system 1\n"), "{said}");
    let told = |severity: u64, text: &str| {
        heard["texts"].as_array().unwrap().iter().any(|t| t[0] == severity && t[1].as_str().unwrap().contains(text))
    };
    assert!(told(NOTICE, "odometry: running"), "{heard}");
    // Both ends have the same clock.
    let sync = &heard["timesync"];
    assert!(sync["answers"].as_u64().unwrap() > 50 && sync["offset_ms"].as_f64().unwrap().abs() < 1.0, "{sync}");
    assert!(count(&report, "mavlink_round_trip_us_most") > 0, "{report}");
    // The picture is there at its stamp, and tracked in some milliseconds.
    let age = heard["age_ms"]["median"].as_f64().unwrap();
    assert!((0.0..50.0).contains(&age), "{age} ms");
    poses_are_those_of_the_log(&heard, &out);
}

/// Poses of messages beside those of the log, turned here by the definitions of the axes.
fn poses_are_those_of_the_log(heard: &Value, out: &Path) {
    let mut logged = vec![];
    read_files(&runs(out).unwrap()[0].files, |_, message| {
        if let Message::State(state) = message {
            logged.extend(state.estimate);
        }
        Ok(())
    })
    .unwrap();
    let told: Vec<Vec<f64>> = serde_json::from_value(heard["states"].clone()).unwrap();
    assert!(told.len() > 100 && told.len() == logged.len(), "{} {}", told.len(), logged.len());
    let body_from_vehicle = DQuat::from_euler(EulerRot::XYZ, 0.0, -90f64.to_radians(), 0.0);
    let first = logged[0].pose().q * body_from_vehicle * DVec3::X;
    // Columns of the local frame, in the world: forward, right, down.
    let forward = DVec3::new(first.x, first.y, 0.0).normalize();
    let axes = [forward, forward.cross(DVec3::Z), DVec3::NEG_Z];
    let local = |v: DVec3| DVec3::from_array(axes.map(|axis| axis.dot(v)));
    for (told, logged) in told.iter().zip(&logged) {
        let (p, q) = (DVec3::from_slice(&told[1..]), DQuat::from_xyzw(told[5], told[6], told[7], told[4]));
        assert!((p - local(logged.pose().p)).length() < 1e-5);
        let world_from_vehicle = logged.pose().q * body_from_vehicle;
        for axis in DVec3::AXES {
            assert!((q * axis - local(world_from_vehicle * axis)).length() < 1e-5);
        }
        // Velocities are in the vehicle's axes.
        let v = DVec3::from_slice(&told[8..]);
        assert!((q * v - local(logged.v_world.into())).length() < 1e-4);
    }
}

#[test]
fn states_go_over_a_uart_and_are_thinned_where_it_is_slow() {
    if is_left_out() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let data = flight(dir.path(), "5");
    let (fast, heard, said) = fly(&data, &dir.path().join("fast"), &["serial", "6"], &[]);
    assert!(!said.contains("nose points"), "{said}");
    whole_and_taken(&heard, &fast);
    assert!(heard["px4"]["gaps"] == 0 && heard["px4"]["fused"].as_u64().unwrap() > 80, "{heard}");
    // 244 bytes take 64 ms: a state waits for no other.
    let slow = ["serial", "7", "--baud", "38400"];
    let (report, heard, _) = fly(&data, &dir.path().join("slow"), &slow, &[]);
    whole_and_taken(&heard, &report);
    let states = heard["counts"]["ODOMETRY"].as_u64().unwrap();
    assert!(heard["counts"]["HEARTBEAT"].as_u64().unwrap() >= 4, "{heard}");
    assert!((35..80).contains(&states) && count(&report, "mavlink_states_skipped") > 10, "{heard}");
    assert!(heard["age_ms"]["median"].as_f64().unwrap() < 64.0 + 64.0 + 50.0, "{heard}");
}

#[test]
fn reset_is_counted_once_at_both_ends_and_no_gap_is_one_to_give_up_at() {
    if is_left_out() {
        return;
    }
    // Longer than odometry believes inertia alone.
    const UNPLUGGED: &str = "[[camera]]\nfault = \"unplug\"\nstart_s = 3.0\nend_s = 6.5\n";
    let dir = tempfile::tempdir().unwrap();
    let (data, inject) = (flight(dir.path(), "10"), rules(dir.path(), UNPLUGGED));
    let (report, heard, said) = fly(&data, &dir.path().join("out"), &["udp", "11", "--states"], &["--inject", &inject]);
    let resets = heard["resets"].as_array().unwrap();
    assert_eq!(*resets, [0, 1], "{said}");
    assert!(said.matches("epoch 1 begins").count() == 1 && !said.contains("epoch 2"), "{said}");
    assert_eq!((&heard["lost"], &heard["nan"]), (&0.into(), &0.into()));
    assert_eq!(heard["counts"]["ODOMETRY"].as_u64().unwrap(), count(&report, "mavlink_states_sent"));
    let told: Vec<Vec<f64>> = serde_json::from_value(heard["states"].clone()).unwrap();
    // Inertia carries states on; what is not known any more says so for a second, and then no more.
    let gaps = told.windows(2).filter(|s| s[0][11] > 0.0).map(|s| s[1][0] - s[0][0]);
    let longest = gaps.fold(0.0, f64::max) * 1e-6;
    assert!(longest < 0.2 && told.windows(2).all(|s| s[1][0] > s[0][0]), "{longest} s");
    let failed = told.iter().filter(|s| s[11] == -1.0).count();
    assert!((10..80).contains(&failed), "{failed}");
    let told = |severity: u64, text: &str| {
        heard["texts"].as_array().unwrap().iter().any(|t| t[0] == severity && t[1].as_str().unwrap().contains(text))
    };
    assert!(told(CRITICAL, "odometry: lost") && told(4, "epoch 1 begins"), "{heard}");
    // A run that is started anew in the same folder begins in another frame.
    let (_, heard, _) = fly(&data, &dir.path().join("out"), &["udp", "3"], &["--duration", "3"]);
    assert_eq!(heard["resets"], serde_json::json!([10]));
}

/// None of it reaches the flight, and the link is there again when the line is.
#[test]
fn damaged_messages_and_a_line_that_is_cut_or_stalls_cost_messages_alone() {
    if is_left_out() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let data = flight(dir.path(), "9");
    let check = |kind: &str, fault: &str| {
        let out = dir.path().join(format!("{kind}{fault}"));
        let (report, heard, said) = fly(&data, &out, &[kind, "9", "--malformed", "1000", fault, "3", "5"], &[]);
        let case = format!("{kind} {fault}: {heard} {said}");
        assert!(heard["malformed_sent"].as_u64().unwrap() >= 990, "{case}");
        assert!(count(&report, "mavlink_bytes_malformed") > 10_000, "{case}");
        assert!(report["frames"].as_u64().unwrap() >= 178, "{case}");
        assert!(count(&report, "frames_overwritten") == 0 && heard["nan"] == 0, "{case}");
        // Two seconds of nine are gone.
        assert!(heard["counts"]["ODOMETRY"].as_u64().unwrap() > 100, "{case}");
        assert!(heard["px4"]["stops"].as_u64().unwrap() <= 1, "{case}");
        if (kind, fault) == ("serial", "--cut") {
            assert!(said.contains("is lost") && said.contains("is open"), "{case}");
            assert_eq!(count(&report, "mavlink_reopened"), 1, "{case}");
        }
    };
    for fault in ["--cut", "--stall"] {
        // In real time, which leaves most of the processor idle.
        std::thread::scope(|scope| {
            scope.spawn(|| check("serial", fault));
            check("udp", fault);
        });
    }
}

/// A vehicle in the same network is no reason to send it our states; our own autopilot is.
#[test]
fn who_sends_first_and_is_of_our_system_is_answered() {
    let dir = tempfile::tempdir().unwrap();
    let data = flight(dir.path(), "6");
    let heartbeat = |system: u8| {
        let header = MavHeader { system_id: system, component_id: 1, sequence: 0 };
        let autopilot = MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA;
        let mut raw = MAVLinkV2MessageRaw::new();
        raw.serialize_message_data(header, &HEARTBEAT_DATA { autopilot, ..HEARTBEAT_DATA::default() });
        raw.raw_bytes().to_vec()
    };
    let socket = || UdpSocket::bind("127.0.0.1:0").unwrap();
    let (stranger, own, late, free) = (socket(), socket(), socket(), socket().local_addr().unwrap());
    let mut run = stipple();
    run.args(["run", "--board", BOARD, "--set", "map.enabled=false", "--set", &format!("mavlink.link=udpin:{free}")]);
    run.args(["--dataset", data.to_str().unwrap(), "--out", dir.path().join("out").to_str().unwrap()]);
    let child = run.stderr(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let begun = Instant::now();
    while begun.elapsed() < Duration::from_secs(5) {
        for (from, system, after_s) in [(&stranger, 2, 0.0), (&own, 1, 1.5), (&late, 1, 3.0)] {
            if begun.elapsed().as_secs_f64() > after_s {
                from.send_to(&heartbeat(system), free).unwrap();
            }
        }
        std::thread::sleep(Duration::from_millis(200));
    }
    let o = child.wait_with_output().unwrap();
    assert!(o.status.success(), "{}", text(&o));
    let got = |socket: &UdpSocket| {
        socket.set_nonblocking(true).unwrap();
        let mut bytes = [0; 300];
        std::iter::from_fn(|| socket.recv(&mut bytes).ok()).count()
    };
    assert_eq!((got(&stranger), got(&late)), (0, 0), "{}", text(&o));
    assert!(got(&own) > 30, "{}", text(&o));
    let said = text(&o);
    assert!(said.matches("ArduPilot, system 2; if it is ours, set mavlink.system, which is 1").count() == 1, "{said}");
    assert!(said.contains(&format!("heard on udpin:{free}: ArduPilot, system 1")), "{said}");
}

#[test]
fn link_that_cannot_be_is_named_before_the_flight_and_one_that_is_not_there_yet_is_tried_again() {
    let dir = tempfile::tempdir().unwrap();
    let data = flight(dir.path(), "2");
    let run = |set: &str, out: &str| {
        let mut run = stipple();
        run.args(["run", "--board", BOARD, "--set", "map.enabled=false", "--set", set]);
        run.args(["--dataset", data.to_str().unwrap(), "--out", dir.path().join(out).to_str().unwrap()]);
        run.output().unwrap()
    };
    let wrong = run("mavlink.link=udp:10.0.0.1:14550", "wrong");
    assert_eq!(wrong.status.code(), Some(78), "{}", text(&wrong));
    assert!(text(&wrong).contains("must be serial:DEVICE:BAUD, udpout:IP:PORT or udpin:IP:PORT"), "{}", text(&wrong));
    for absent in ["serial:/dev/stipple-none:57600", "serial:/dev/null:57600", "udpout:127.0.0.1:9"] {
        let o = run(&format!("mavlink.link={absent}"), "absent");
        assert!(o.status.success(), "{}", text(&o));
        // Without a mounting the unit's x, which is up, is taken for the nose.
        assert!(text(&o).contains("nose points") == absent.starts_with("udp"), "{}", text(&o));
        let lines = text(&o).matches("is lost").count();
        assert_eq!(lines, usize::from(absent.starts_with("serial")), "{}", text(&o));
    }
}

fn part(values: &mut [f64], part: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values[((part * values.len() as f64) as usize).min(values.len() - 1)]
}

/// Latencies of tracking in the log of a run, ms.
fn latencies(out: &Path) -> Vec<f64> {
    let mut list = vec![];
    read_files(&runs(out).unwrap()[0].files, |_, message| {
        if let Message::State(state) = message {
            list.extend(state.estimate.map(|_| state.latency_ms));
        }
        Ok(())
    })
    .unwrap();
    list
}

/// Time from the stamp of a picture until its pose is at the autopilot's end, with the map on, beside tracking's own.
#[test]
#[ignore = "a measurement on the recordings: STIPPLE_RECORDINGS, release build, nothing else on the machine"]
fn age_of_poses_at_the_other_end() {
    let data = Path::new(&std::env::var("STIPPLE_RECORDINGS").unwrap()).join("euroc_MH_01_easy_11s");
    let dir = tempfile::tempdir().unwrap();
    println!("| link | poses | age: median | p99 | most | tracking: median | p99 | p99 over p99 |\n|---|---|---|---|---|---|---|---|");
    for (kind, allowed_ms) in [("udp", 3.0), ("serial", 8.0)] {
        let (mut tracked, mut ages) = (vec![], vec![]);
        for pass in 0..5 {
            let out = dir.path().join(format!("{kind}{pass}"));
            let (report, heard, _) = fly(&data, &out, &[kind, "13", "--ages"], &["--set", "map.enabled=true"]);
            whole_and_taken(&heard, &report);
            tracked.extend(latencies(&out));
            ages.extend(serde_json::from_value::<Vec<f64>>(heard["ages"].clone()).unwrap());
        }
        let (n, most) = (ages.len(), ages.iter().copied().fold(0.0, f64::max));
        let [median, p99] = [0.5, 0.99].map(|p| part(&mut ages, p));
        let [own, own_p99] = [0.5, 0.99].map(|p| part(&mut tracked, p));
        let over = p99 - own_p99;
        println!("| {kind} | {n} | {median:.2} ms | {p99:.2} | {most:.2} | {own:.2} | {own_p99:.2} | {over:+.2} |");
        assert!(over <= allowed_ms, "{kind}: {over} ms of {allowed_ms}");
    }
}

/// Twenty minutes with a fault each minute: a camera that is unplugged for long, an inertial unit that is, and a line that is cut.
#[test]
#[ignore = "20 minutes: cargo test --release --test program autopilot::twenty -- --ignored --nocapture"]
fn twenty_minutes_with_faults_lose_no_message_and_count_every_reset_once() {
    let dir = tempfile::tempdir().unwrap();
    let data = flight(dir.path(), "60");
    let rule = |minute: u32| {
        let (sensor, start) = (["camera", "imu"][minute as usize % 2], f64::from(minute) * 60.0 + 20.0);
        format!("[[{sensor}]]\nfault = \"unplug\"\nstart_s = {start}\nend_s = {}\n", start + 3.5)
    };
    let inject = rules(dir.path(), &(0..20).map(rule).collect::<String>());
    let out = dir.path().join("out");
    let more = ["--inject", &inject, "--repeat", "--duration", "1200"];
    let (report, heard, said) = fly(&data, &out, &["udp", "1200", "--malformed", "1000"], &more);
    let begun: Vec<u64> = serde_json::from_value(heard["resets"].clone()).unwrap();
    // Epochs with a pose, and those with one that is trusted.
    let (mut epochs, mut trusted) = (vec![], vec![]);
    read_files(&runs(&out).unwrap()[0].files, |_, message| {
        if let Message::State(state) = message {
            let epoch = u64::from(state.epoch % 256);
            let has_failed = state.dead_reckoned || state.quality == 0;
            for (list, counts) in [(&mut epochs, state.estimate.is_some()), (&mut trusted, !has_failed)] {
                if state.estimate.is_some() && counts && list.last() != Some(&epoch) {
                    list.push(epoch);
                }
            }
        }
        Ok(())
    })
    .unwrap();
    println!(
        "{} messages, {} of them states, {} lost, {} with NaN, counter of resets {:?} here, {:?} in the log; PX4 {}, ArduPilot {}; age {}",
        heard["counts"],
        heard["counts"]["ODOMETRY"],
        heard["lost"],
        heard["nan"],
        begun.last(),
        epochs.last(),
        heard["px4"],
        heard["ardupilot"],
        heard["age_ms"]
    );
    let said = said.lines().filter(|line| line.starts_with("stipple:")).collect::<Vec<_>>().join("\n");
    assert_eq!((&heard["lost"], &heard["nan"], &heard["bad"]), (&0.into(), &0.into(), &0.into()), "{said}");
    // States of an epoch in which odometry had failed for long are not sent: the counter passes over it, and comes to the same.
    let told = trusted.iter().all(|epoch| begun.contains(epoch)) && begun.iter().all(|epoch| epochs.contains(epoch));
    assert!(told && begun.last() == epochs.last(), "{begun:?} heard, {epochs:?} flown, {trusted:?} trusted: {said}");
    assert!(begun.len() > 5 && begun.windows(2).all(|b| b[1] > b[0]), "{begun:?}: {said}");
    assert!(count(&report, "mavlink_bytes_malformed") > 10_000);
}

/// Readers of the status socket that subscribe to everything and read nothing, as soon as there is a socket.
fn subscribe_and_stall(out: &Path) -> std::thread::JoinHandle<Vec<UnixStream>> {
    const REQUEST: &[u8] = b"{\"subscribe\":[\"state\",\"event\",\"status\"]}\n";
    let socket = out.join("status");
    std::thread::spawn(move || {
        while UnixStream::connect(&socket).is_err() {
            std::thread::sleep(Duration::from_millis(20));
        }
        let mut readers: Vec<_> = (0..8).map(|_| UnixStream::connect(&socket).unwrap()).collect();
        readers.iter_mut().for_each(|reader| reader.write_all(REQUEST).unwrap());
        readers
    })
}

/// Ten pairs of passes, by turns with an autopilot and eight readers of the status socket that read nothing, and without any;
/// frames of all passes of a kind are pooled.
#[test]
#[ignore = "a measurement on the recordings: STIPPLE_RECORDINGS, release build, nothing else on the machine; five minutes"]
fn readers_that_stall_cost_odometry_nothing() {
    let data = Path::new(&std::env::var("STIPPLE_RECORDINGS").unwrap()).join("euroc_MH_01_easy_11s");
    let dir = tempfile::tempdir().unwrap();
    let (mut latency_ms, mut cpu_ms) = ([vec![], vec![]], [vec![], vec![]]);
    let mut lost = 0;
    for pass in 0..20 {
        let (out, stalls) = (dir.path().join(pass.to_string()), pass % 2);
        if stalls == 1 {
            let readers = subscribe_and_stall(&out);
            let stalled = ["serial", "9", "--stall", "0.5", "100"];
            let (report, ..) = fly(&data, &out, &stalled, &["--set", "map.enabled=true"]);
            assert_eq!(readers.join().unwrap().len(), 8);
            lost += count(&report, "status_lines_lost");
        } else {
            let mut run = stipple();
            run.args(["run", "--board", BOARD, "--dataset", data.to_str().unwrap(), "--out", out.to_str().unwrap()]);
            assert!(run.output().unwrap().status.success());
        }
        read_files(&runs(&out).unwrap()[0].files, |_, message| {
            if let Message::State(state) = message {
                latency_ms[stalls].push(state.latency_ms);
                cpu_ms[stalls].push(state.cpu_ms);
            }
            Ok(())
        })
        .unwrap();
    }
    let frames = latency_ms.each_ref().map(Vec::len);
    let [alone, stalled] = latency_ms.map(|mut ms| part(&mut ms, 0.5));
    let [cpu_alone, cpu_stalled] = cpu_ms.map(|mut ms| part(&mut ms, 0.99));
    println!(
        "{frames:?} frames; median {alone:.3} and {stalled:.3} ms, ratio {:.3}; 99 % of CPU time {cpu_alone:.3} and \
         {cpu_stalled:.3} ms, ratio {:.3}; {lost} lines lost to readers",
        stalled / alone,
        cpu_stalled / cpu_alone
    );
    assert!(lost > 0, "they stalled");
    assert!(stalled < 1.05 * alone && cpu_stalled < 1.15 * cpu_alone);
}
