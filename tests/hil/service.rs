//! The service as systemd runs it: the files of the Debian package on a machine that boots, with two UVC cameras, an MPU-6500
//! on I2C and an autopilot on UDP, which play and listen without an end. For the virtual machine: `make hil TESTS=service`.
//!
//! The sensors are plugged in while the machine boots, when the service has been started, as slow cameras are. They fly
//! there and back: the recording rests at both ends, so that it goes on forever without a jump, and who is started in
//! the middle of it meets a flight.
#![allow(clippy::unwrap_used)]

mod devices;
mod manager;
mod plugged;
#[path = "../program/start.rs"]
#[allow(dead_code)] // the program is started by the manager
mod start;
mod unit;

use devices::{environment, sensors_of_a_board, wait_until, Devices, MAP, MS};
use manager::{journal, properties, systemctl, tried, wait_for, BOARD, OUT};
use serde_json::Value;
use start::{children, kill};
use std::fs;
use std::net::UdpSocket;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant};
use stipple::run::log::read::{read_files, runs, Message};
use stipple_drivers::host::monotonic;
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::{Frames, ImuSample, Nanos, Span};
use unit::{counts, Counts};

const FPS: u32 = 10;
const SECOND: usize = FPS as usize;
const AUTOPILOT: &str = "127.0.0.1:14550";
/// What the devices play, and the board file, of a simulated flight from rest to rest. Not in the machine.
#[test]
#[ignore = "make hil"]
fn prepare() {
    let (from, to) = (environment("HIL_RECORDING"), environment("HIL_FLIGHT"));
    let recording = Recording::open(&from, &OpenOptions::default()).unwrap();
    let (mut reader, mut whole) = (recording.reader(), Frames::for_rig(&recording.calibration));
    // Every second frame: the one processor is emulated.
    let n = recording.frames.len().div_ceil(2);
    let (first, last) = (recording.frames[0].t, recording.frames[2 * (n - 1)].t);
    let back = |t: Nanos| last + (last - t);
    let frames = (0..n).chain((1..n - 1).rev()).enumerate().map(|(k, i)| {
        reader.read(2 * i, &mut whole).unwrap();
        let t = if k < n { whole.t } else { back(whole.t) };
        Frames { t, images: whole.images.clone(), colours: vec![] }
    });
    let there: Vec<&ImuSample> = recording.imu.iter().filter(|s| (first..=last).contains(&s.t)).collect();
    // Turned round, rates change their signs, and neither accelerations nor the gyro's error do, which is what it reads at rest.
    let resting: Vec<_> = there.iter().filter(|s| s.t < first + Span(1000 * MS)).map(|s| s.gyro_body).collect();
    let error = resting.iter().sum::<glam::DVec3>() / resting.len() as f64;
    let mut imu: Vec<(Nanos, Counts)> = there.iter().map(|s| (s.t, counts(s))).collect();
    imu.extend(there[1..there.len() - 1].iter().rev().map(|s| {
        let gyro_body = error * 2.0 - s.gyro_body;
        (back(s.t), counts(&ImuSample { gyro_body, ..**s }))
    }));
    devices::write(&to, &recording.calibration, frames, &imu);
    let sensors = sensors_of_a_board("mav0", FPS);
    fs::write(to.join("board.toml"), format!("{MAP}{sensors}[mavlink]\nlink = \"udpout:{AUTOPILOT}\"\n")).unwrap();
}

/// The sensors, the autopilot, and the service that flies with them.
struct Vehicle {
    devices: Devices,
    /// When states came to the autopilot, and their counter of resets.
    heard: Arc<Mutex<Vec<(Nanos, u8)>>>,
    /// The board file as it was installed.
    board: String,
}

/// The vehicle, whose service tracks. One test after the other has it.
fn vehicle() -> MutexGuard<'static, Vehicle> {
    static VEHICLE: OnceLock<Mutex<Vehicle>> = OnceLock::new();
    let vehicle = VEHICLE.get_or_init(|| {
        let mut devices = Devices::plug();
        devices.play_for_ever();
        Mutex::new(Vehicle { devices, heard: listen(), board: fs::read_to_string(BOARD).unwrap() })
    });
    let vehicle = vehicle.lock().unwrap_or_else(PoisonError::into_inner);
    if properties()["ActiveState"] == "failed" {
        systemctl(&["start", "stipple"]);
    }
    vehicle
}

/// What the autopilot hears: MAVLink 2, whose ODOMETRY has the counter of resets at byte 230.
fn listen() -> Arc<Mutex<Vec<(Nanos, u8)>>> {
    const ODOMETRY: [u8; 3] = [0x4B, 0x01, 0];
    const HEADER: usize = 10;
    let heard: Arc<Mutex<Vec<(Nanos, u8)>>> = Arc::default();
    let (socket, list) = (UdpSocket::bind(AUTOPILOT).unwrap(), heard.clone());
    std::thread::spawn(move || {
        let mut bytes = [0; 512];
        while let Ok(n) = socket.recv(&mut bytes) {
            if n > HEADER && bytes[0] == 0xFD && bytes[7..HEADER] == ODOMETRY {
                // Zeros at the end of a message are left out.
                let resets = bytes[..n - 2].get(HEADER + 230).copied().unwrap_or(0);
                list.lock().unwrap().push((monotonic(), resets));
            }
        }
    });
    heard
}

/// A start of the process, which tracks.
#[derive(Debug)]
struct Life {
    pid: u32,
    restarts: u32,
    runs: usize,
    begun: Nanos,
    ready: Nanos,
}

/// Instants at which trusted poses were logged by the newest run.
fn poses() -> (usize, Vec<Nanos>) {
    let (runs, mut poses) = (runs(Path::new(OUT)).unwrap_or_default(), vec![]);
    let files = runs.last().map_or(&[][..], |run| &run.files);
    let read = read_files(files, |at, message| {
        if matches!(message, Message::State(s) if s.estimate.is_some() && !s.dead_reckoned) {
            poses.push(at);
        }
        Ok(())
    });
    read.unwrap();
    (runs.len(), poses)
}

impl Vehicle {
    /// Waits until a process that is not `before` has logged a second of poses, and the autopilot has heard of them.
    fn tracks(&self, before: Option<&Life>) -> Life {
        let mut life = None;
        wait_for("an active service", || {
            let p = properties();
            let stamp = |name: &str| Nanos(p[name].parse::<i64>().unwrap_or(0) * 1000);
            let pid = p["MainPID"].parse().unwrap();
            life = (p["ActiveState"] == "active" && before.is_none_or(|life| life.pid != pid)).then(|| Life {
                pid,
                restarts: p["NRestarts"].parse().unwrap(),
                runs: 0,
                begun: stamp("ExecMainStartTimestampMonotonic"),
                ready: stamp("ActiveEnterTimestampMonotonic"),
            });
            life.is_some()
        });
        let mut life = life.unwrap();
        let mut first = None;
        wait_for("a second of poses", || {
            let (runs, poses) = poses();
            let poses: Vec<_> = poses.into_iter().filter(|at| *at > life.begun).collect();
            (life.runs, first) = (runs, poses.first().copied());
            poses.len() >= SECOND
        });
        wait_for("a second of states", || self.resets_since(life.ready).len() >= SECOND);
        let [ready, first] = [life.ready - life.begun, first.unwrap() - life.ready].map(Span::secs);
        println!("ready {ready:.2} s after the start of the process, first pose {first:.2} s after that: {life:?}");
        life
    }

    /// Counters of resets of the states that the autopilot heard since.
    fn resets_since(&self, t: Nanos) -> Vec<u8> {
        self.heard.lock().unwrap().iter().filter(|(at, _)| *at > t).map(|(_, resets)| *resets).collect()
    }

    /// The manager started the process once more, it tracks, and the autopilot is told that poses have a new frame.
    fn is_started_again_after(&self, life: &Life, what: &str) {
        let resets = *self.resets_since(life.begun).last().unwrap();
        let new = self.tracks(Some(life));
        assert_eq!((new.restarts, new.runs), (life.restarts + 1, life.runs + 1), "{what}");
        let newest = *self.resets_since(new.ready).last().unwrap();
        println!("{what}: poses again, counter of resets {resets} before and {newest} after");
        assert_ne!(newest, resets);
        // Neither the old process nor its mapper is left.
        let all = fs::read_to_string("/sys/fs/cgroup/system.slice/stipple.service/cgroup.procs").unwrap();
        let mut of_the_new = children(new.pid);
        of_the_new.push(new.pid);
        assert!(all.lines().all(|pid| of_the_new.contains(&pid.parse().unwrap())), "{all} {of_the_new:?}");
    }
}

/// The process of the mapper that this process has started, and is not `unlike`.
fn mapper_of(life: &Life, unlike: u32) -> u32 {
    let mut mapper = 0;
    wait_for("a mapper", || {
        mapper = children(life.pid).into_iter().find(|pid| *pid != unlike).unwrap_or(0);
        mapper != 0
    });
    mapper
}

/// Whether the newest run has said so in its log.
fn said(what: &str) -> bool {
    let mut found = false;
    let read = read_files(&runs(Path::new(OUT)).unwrap().last().unwrap().files, |_, message| {
        found |= matches!(message, Message::Event(e) if e.text.contains(what));
        Ok(())
    });
    read.unwrap();
    found
}

/// Frames, as the manager's line about the service has them.
fn frames_told() -> u64 {
    let text = properties()["StatusText"].clone();
    let frames = text.split(", ").find_map(|part| part.strip_suffix(" frames"));
    frames.unwrap_or_else(|| panic!("{text}")).parse().unwrap()
}

#[test]
#[ignore = "needs the machine of tests/hil/service.sh"]
fn boot_leads_to_tracking() {
    let life = vehicle().tracks(None);
    let p = properties();
    let expected = [("UnitFileState", "enabled"), ("SubState", "running"), ("Type", "notify"), ("Result", "success")];
    expected.into_iter().for_each(|(name, value)| assert_eq!(p[name], value, "{name}"));
    println!("sensors were there at start {}: {:?}", life.restarts + 1, p["StatusText"]);
    assert!(life.restarts > 0, "the service was started by the boot, before there were sensors");
    let before = frames_told();
    wait_for("frames that the manager is told of", || frames_told() >= before + u64::from(FPS));
}

#[test]
#[ignore = "needs the machine of tests/hil/service.sh"]
fn crash_of_the_process_that_flies_is_mended() {
    let vehicle = vehicle();
    let life = vehicle.tracks(None);
    // As a panic ends it. The first SEGV without a fault is taken by Rust's guard of the stack.
    kill(life.pid, "ABRT");
    vehicle.is_started_again_after(&life, "ABRT");
    assert!(journal().contains("Failed with result 'core-dump'") || journal().contains("Failed with result 'signal'"));
}

#[test]
#[ignore = "needs the machine of tests/hil/service.sh"]
fn crash_of_the_mapper_costs_the_service_nothing() {
    let vehicle = vehicle();
    let life = vehicle.tracks(None);
    let before = mapper_of(&life, 0);
    let ready = Instant::now();
    kill(before, "KILL");
    let after = mapper_of(&life, before);
    println!("another mapper {:.2} s after the first was killed", ready.elapsed().as_secs_f64());
    let now = monotonic();
    wait_for("a mapper that maps again", || said("the mapper maps again"));
    wait_for("a second of poses", || poses().1.into_iter().filter(|at| *at > now).count() >= SECOND);
    let p = properties();
    assert_eq!((p["MainPID"].parse(), p["NRestarts"].parse()), (Ok(life.pid), Ok(life.restarts)));
    assert_eq!((&*p["ActiveState"], mapper_of(&life, before)), ("active", after));
}

#[test]
#[ignore = "needs the machine of tests/hil/service.sh"]
fn devices_are_sensors_and_no_others() {
    let _vehicle = vehicle();
    let sensors = manager::sensors();
    for (node, group) in &sensors {
        let found = manager::output("stat", &["-c", "%G %a", node]);
        assert_eq!(found.trim(), format!("{group} 660"), "{node}");
    }
    // Anybody may open these, were it not for the policy: a trial without one shows it.
    let others = ["/dev/hwrng", "/dev/loop-control", "/dev/vcs"].map(String::from);
    others
        .iter()
        .for_each(|node| fs::set_permissions(node, std::os::unix::fs::PermissionsExt::from_mode(0o666)).unwrap());
    let sensors: Vec<String> = sensors.into_iter().map(|(node, _)| node).collect();
    let all = [&sensors[..], &others[..]].concat();
    let opened = |policy| tried(&all, policy);
    assert_eq!(opened(false), all, "without a policy");
    assert_eq!(opened(true), sensors, "with the unit's policy");
    println!("{sensors:?} are opened, {others:?} are refused");
}

#[test]
#[ignore = "needs the machine of tests/hil/service.sh"]
fn process_has_no_privilege_but_its_priorities() {
    let life = vehicle().tracks(None);
    let status = fs::read_to_string(format!("/proc/{}/status", life.pid)).unwrap();
    let field =
        |name: &str| status.lines().find_map(|l| l.strip_prefix(name)).unwrap_or_else(|| panic!("{name}")).trim();
    let ids = |name: &str| field(name).split_whitespace().map(|id| id.parse().unwrap()).collect::<Vec<u32>>();
    // The range of dynamic users.
    for id in [ids("Uid:"), ids("Gid:")].concat() {
        assert!((61184..=65519).contains(&id), "{status}");
    }
    let groups = ["video", "render", "dialout", "stipple-sensors"];
    for name in groups {
        let entry = manager::output("getent", &["group", name]);
        assert!(ids("Groups:").contains(&entry.split(':').nth(2).unwrap().parse().unwrap()), "{name}");
    }
    for name in ["CapInh:", "CapPrm:", "CapEff:", "CapBnd:", "CapAmb:"] {
        assert_eq!(u64::from_str_radix(field(name), 16), Ok(0), "{name}");
    }
    assert_eq!((field("NoNewPrivs:"), field("Seccomp:")), ("1", "2"), "{status}");
    let locked: u64 = field("VmLck:").trim_end_matches(" kB").parse().unwrap();
    let adjusted = |pid: u32| fs::read_to_string(format!("/proc/{pid}/oom_score_adj")).unwrap().trim().to_string();
    assert_eq!([adjusted(life.pid), adjusted(mapper_of(&life, 0))], ["-500", "500"]);
    let threads = manager::priorities(life.pid);
    println!("user {}, {locked} kB locked, real-time threads {threads:?}", ids("Uid:")[0]);
    assert!(locked > 0 && threads.contains(&("imu".into(), 12)) && threads.contains(&("camera".into(), 11)));
}

#[test]
#[ignore = "needs the machine of tests/hil/service.sh"]
fn status_is_told_and_a_reload_is_an_event_of_the_journal() {
    let vehicle = vehicle();
    let life = vehicle.tracks(None);
    let status: Value = serde_json::from_str(&manager::output("stipple", &["status", "--json"])).unwrap();
    assert!(status["posed"].as_u64() >= Some(1) && status["state"].is_object(), "{status}");
    let stranger = "setpriv --reuid=65534 --regid=65534 --clear-groups stipple status 2>&1";
    let refused = manager::output("sh", &["-c", stranger]);
    assert!(refused.contains("only root, the user that flies"), "{refused}");
    let events = |id: &str| manager::output("journalctl", &["-b", "-o", "cat", &format!("STIPPLE_EVENT={id}")]);
    fs::write(BOARD, format!("{}[governor]\nframe_share_max = 0.5\n", vehicle.board)).unwrap();
    assert!(systemctl(&["reload", "stipple"]));
    wait_for("the reload", || events("reloaded").contains("reloaded: governor.frame_share_max"));
    fs::write(BOARD, vehicle.board.replace("splats = 4000", "splats = 5000")).unwrap();
    assert!(systemctl(&["reload", "stipple"]));
    wait_for("its refusal", || events("reload_refused").contains("a restart is needed for budget.splats"));
    fs::write(BOARD, &vehicle.board).unwrap();
    let p = properties();
    assert_eq!((&*p["ActiveState"], p["MainPID"].parse()), ("active", Ok(life.pid)));
    println!(
        "status: {} of {} frames with a pose; {}",
        status["posed"],
        status["frames"],
        events("reload_refused").trim()
    );
}

#[test]
#[ignore = "needs the machine of tests/hil/service.sh"]
fn stop_leaves_results() {
    let vehicle = vehicle();
    let life = vehicle.tracks(None);
    let begun = Instant::now();
    assert!(systemctl(&["stop", "stipple"]));
    let p = properties();
    println!("stopped within {:.1} s", begun.elapsed().as_secs_f64());
    assert_eq!(
        (&*p["ActiveState"], &*p["Result"], &*p["ExecMainStatus"]),
        ("inactive", "success", "0"),
        "{}",
        journal()
    );
    let report: Value = serde_json::from_slice(&fs::read(Path::new(OUT).join("report.json")).unwrap()).unwrap();
    let poses = fs::read_to_string(Path::new(OUT).join("trajectory.tum")).unwrap().lines().count();
    println!("{} frames, {poses} poses, map {}", report["frames"], report["splats"]);
    assert!(report["frames"].as_u64().unwrap() >= FPS.into() && poses >= SECOND);
    assert!(fs::metadata(Path::new(OUT).join("map.ply")).unwrap().len() > 0);
    assert!(systemctl(&["start", "stipple"]));
    vehicle.tracks(Some(&life));
}

#[test]
#[ignore = "needs the machine of tests/hil/service.sh"]
fn unplugged_camera_comes_back_to_the_same_process() {
    let mut vehicle = vehicle();
    let life = vehicle.tracks(None);
    vehicle.devices.replug(1, Span(1000 * MS));
    wait_for("the camera's return in the log", || said("one camera is back after"));
    let now = monotonic();
    wait_for("a second of poses", || poses().1.into_iter().filter(|at| *at > now).count() >= SECOND);
    assert_eq!(properties()["MainPID"].parse(), Ok(life.pid));
}

#[test]
#[ignore = "needs the machine of tests/hil/service.sh"]
fn watchdog_ends_a_process_that_is_stuck() {
    let vehicle = vehicle();
    let life = vehicle.tracks(None);
    let begun = Instant::now();
    kill(life.pid, "STOP");
    vehicle.is_started_again_after(&life, "STOP");
    println!("tracks {:.1} s after it was stopped", begun.elapsed().as_secs_f64());
    assert!(journal().contains("Watchdog timeout") && journal().contains("Failed with result 'watchdog'"));
}

#[test]
#[ignore = "needs the machine of tests/hil/service.sh"]
fn wrong_board_file_is_said_and_not_tried_again() {
    let vehicle = vehicle();
    fs::write(BOARD, vehicle.board.replace("mpu-6500", "mpu-0000")).unwrap();
    assert!(!systemctl(&["restart", "stipple"]));
    // Longer than RestartSec.
    wait_until(monotonic() + Span(4000 * MS));
    let p = properties();
    let seen = ["ActiveState", "Result", "ExecMainStatus", "NRestarts"].map(|name| &*p[name]);
    assert_eq!(seen, ["failed", "exit-code", "78", "0"], "{}", journal());
    let said = journal().lines().rev().find(|l| l.contains("board.toml")).map(String::from);
    println!("it said: {said:?}");
    assert!(said.is_some_and(|line| line.contains("mpu-0000")));
    fs::write(BOARD, &vehicle.board).unwrap();
    std::thread::sleep(Duration::from_millis(100));
    assert!(systemctl(&["start", "stipple"]));
    vehicle.tracks(None);
}
