//! `stipple run` as a systemd service: what it tells the manager, and the unit that starts it.

use crate::start::{children, flight, signal, stipple, text, BOARD};
use std::fs;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use stipple::run::log::read::{read_files, runs, Message};
use stipple::run::log::State;
use stipple_drivers::host;

const UNIT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/board-configs/stipple.service");

/// A run without a map that tells `notify` how it goes.
fn run(dir: &Path, data: &Path, notify: &str) -> Command {
    let mut command = stipple();
    command.args(["run", "--board", BOARD, "--set", "map.enabled=false", "--repeat"]);
    command.args(["--dataset", data.to_str().unwrap(), "--out", dir.join("out").to_str().unwrap()]);
    command.env("NOTIFY_SOCKET", notify).stderr(Stdio::null());
    command
}

/// What comes until `limit`, or until a message has `last`.
fn heard(socket: &UnixDatagram, limit: Duration, last: &str) -> Vec<String> {
    let end = Instant::now() + limit;
    let (mut all, mut bytes) = (vec![], [0; 4096]);
    socket.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
    while Instant::now() < end && !all.last().is_some_and(|m: &String| m.contains(last)) {
        if let Ok(n) = socket.recv(&mut bytes) {
            all.push(String::from_utf8(bytes[..n].to_vec()).unwrap());
        }
    }
    all
}

fn count(messages: &[String], line: &str) -> usize {
    messages.iter().flat_map(|m| m.lines()).filter(|l| *l == line).count()
}

#[test]
fn manager_hears_that_a_run_is_ready_alive_and_stopping() {
    let dir = tempfile::tempdir().unwrap();
    let (data, path) = (flight(dir.path(), "3"), dir.path().join("notify"));
    let hidden = format!("stipple-test-{}", std::process::id());
    let sockets = [
        (UnixDatagram::bind(&path).unwrap(), path.to_str().unwrap().to_string()),
        // Without a place in the file system, as a user's manager may have it.
        (UnixDatagram::bind_addr(&SocketAddr::from_abstract_name(&hidden).unwrap()).unwrap(), format!("@{hidden}")),
    ];
    for (socket, name) in sockets {
        let mut child = run(dir.path(), &data, &name).spawn().unwrap();
        let before = heard(&socket, Duration::from_secs(30), "READY=1");
        assert_eq!((before.len(), count(&before, "READY=1")), (1, 1), "{before:?}");
        let messages = heard(&socket, Duration::from_millis(3500), "nothing says this");
        assert!((2..=4).contains(&count(&messages, "WATCHDOG=1")), "each second: {messages:?}");
        let status = messages.last().unwrap().lines().find_map(|l| l.strip_prefix("STATUS=")).unwrap();
        assert!(status.contains("epoch 0") && status.contains("frames") && !status.contains(" 0 frames"), "{status}");
        signal(&child, "TERM");
        let messages = heard(&socket, Duration::from_secs(10), "STOPPING=1");
        assert_eq!((count(&messages, "STOPPING=1"), count(&messages, "READY=1")), (1, 0), "{messages:?}");
        assert!(child.wait().unwrap().success());
        fs::remove_dir_all(dir.path().join("out")).unwrap();
    }
}

/// Nobody asks it to stop: its results are written before the watchdog could bite.
#[test]
fn manager_hears_that_a_run_ends_by_itself_and_its_mapper_goes_first_where_memory_ends() {
    let dir = tempfile::tempdir().unwrap();
    let (data, path) = (flight(dir.path(), "3"), dir.path().join("notify"));
    let socket = UnixDatagram::bind(&path).unwrap();
    let mut command = stipple();
    command.args(["run", "--board", BOARD, "--set", "map.scale=4", "--dataset", data.to_str().unwrap()]);
    command.args(["--duration", "4", "--out", dir.path().join("out").to_str().unwrap()]);
    let mut child = command.env("NOTIFY_SOCKET", &path).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let before = heard(&socket, Duration::from_secs(60), "READY=1");
    let mapper = children(child.id())[0];
    assert_eq!(fs::read_to_string(format!("/proc/{mapper}/oom_score_adj")).unwrap().trim(), "500");
    let messages = heard(&socket, Duration::from_secs(30), "STOPPING=1");
    assert!(count(&before, "READY=1") == 1 && count(&messages, "STOPPING=1") == 1, "{before:?} {messages:?}");
    assert!(child.wait().unwrap().success());
}

/// Ready is a promise: poses follow. `cargo test --release --test program first_pose -- --nocapture` prints when.
#[test]
fn first_pose_comes_within_three_seconds_after_ready() {
    let dir = tempfile::tempdir().unwrap();
    let mut flights = vec![("simulated flight", flight(dir.path(), "5"))];
    flights.extend(std::env::var("STIPPLE_RECORDINGS").map(|r| ("MH_01", Path::new(&r).join("euroc_MH_01_easy_11s"))));
    for (name, data) in flights {
        let (path, out) = (dir.path().join(format!("{name} notify")), dir.path().join(name));
        let socket = UnixDatagram::bind(&path).unwrap();
        let mut command = stipple();
        command.args(["run", "--board", BOARD, "--set", "map.scale=4", "--dataset", data.to_str().unwrap()]);
        command.args(["--duration", "5", "--out", out.to_str().unwrap()]).env("NOTIFY_SOCKET", &path);
        let begun = host::monotonic();
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        heard(&socket, Duration::from_secs(60), "READY=1");
        let ready = host::monotonic();
        assert!(child.wait().unwrap().success());
        let mut first = None;
        read_files(&runs(&out).unwrap()[0].files, |at, message| {
            if matches!(message, Message::State(State { estimate: Some(_), .. })) {
                first.get_or_insert(at);
            }
            Ok(())
        })
        .unwrap();
        let (after_start, after_ready) = ((ready - begun).secs(), (first.unwrap() - ready).secs());
        println!(
            "{name}: ready {after_start:.2} s after the start of the process, first pose {after_ready:.2} s after that"
        );
        assert!(after_ready < 3.0, "{name}: {after_ready} s");
    }
}

/// A thread that hangs must reach the watchdog, which starts the run anew.
#[test]
fn watchdog_is_not_fed_while_a_thread_hangs() {
    let dir = tempfile::tempdir().unwrap();
    let (data, path, rules) = (flight(dir.path(), "3"), dir.path().join("notify"), dir.path().join("rules.toml"));
    fs::write(&rules, "[[thread]]\nname = \"estimator\"\nhang_s = 1.0\n").unwrap();
    let socket = UnixDatagram::bind(&path).unwrap();
    let mut command = run(dir.path(), &data, path.to_str().unwrap());
    let mut child = command.args(["--inject", rules.to_str().unwrap(), "--set", "frontend.threads=2"]).spawn().unwrap();
    let messages = heard(&socket, Duration::from_secs(12), "nothing says this");
    child.kill().unwrap();
    child.wait().unwrap();
    let fed: Vec<bool> = messages.iter().map(|m| m.contains("WATCHDOG=1")).collect();
    assert!(fed.len() > 8 && fed[..4].iter().all(|fed| *fed) && fed[fed.len() - 3..] == [false; 3], "{messages:?}");
}

/// A manager that takes nothing holds nothing up.
#[test]
fn run_goes_on_when_nobody_reads_what_it_tells() {
    let dir = tempfile::tempdir().unwrap();
    let (data, path) = (flight(dir.path(), "3"), dir.path().join("notify"));
    let socket = UnixDatagram::bind(&path).unwrap();
    let full = UnixDatagram::unbound().unwrap();
    full.set_nonblocking(true).unwrap();
    while full.send_to(b"X", &path).is_ok() {}
    let o = run(dir.path(), &data, path.to_str().unwrap()).args(["--duration", "3"]).output().unwrap();
    assert!(o.status.success(), "{}", text(&o));
    let log = dir.path().join("out/report.json");
    let report: serde_json::Value = serde_json::from_slice(&fs::read(log).unwrap()).unwrap();
    assert_eq!(report["count_frames_overwritten"].as_u64().unwrap_or(0), 0);
    drop(socket);
}

/// Directives of the unit, and the version of systemd that first knew each (its NEWS).
const KNOWN_SINCE: [(&str, u32); 51] = [
    ("AmbientCapabilities", 229),
    ("CacheDirectory", 235),
    ("CapabilityBoundingSet", 20),
    ("ConfigurationDirectory", 235),
    ("Description", 1),
    ("DeviceAllow", 208),
    ("DevicePolicy", 208),
    ("DynamicUser", 232),
    ("Environment", 1),
    ("ExecReload", 1),
    ("ExecStart", 1),
    ("IPAddressAllow", 235),
    ("IPAddressDeny", 235),
    ("LimitMEMLOCK", 1),
    ("LimitRTPRIO", 1),
    ("LockPersonality", 235),
    ("NoNewPrivileges", 187),
    ("OOMPolicy", 243),
    ("OOMScoreAdjust", 1),
    ("PrivateMounts", 239),
    ("PrivateTmp", 20),
    ("ProtectClock", 245),
    ("ProtectControlGroups", 232),
    ("ProtectHome", 214),
    ("ProtectHostname", 242),
    ("ProtectKernelLogs", 244),
    ("ProtectKernelModules", 232),
    ("ProtectProc", 247),
    ("ProtectSystem", 214),
    ("RemoveIPC", 232),
    ("Restart", 1),
    ("RestartPreventExitStatus", 189),
    ("RestartSec", 1),
    ("RestrictAddressFamilies", 211),
    ("RestrictNamespaces", 233),
    ("RestrictSUIDSGID", 242),
    ("RuntimeDirectory", 211),
    ("RuntimeDirectoryMode", 211),
    ("StartLimitIntervalSec", 230),
    ("StateDirectory", 235),
    ("StateDirectoryMode", 235),
    ("SupplementaryGroups", 1),
    ("SystemCallArchitectures", 209),
    ("SystemCallErrorNumber", 209),
    ("SystemCallFilter", 187),
    ("TimeoutStartSec", 188),
    ("TimeoutStopSec", 188),
    ("Type", 1),
    ("UMask", 1),
    ("WantedBy", 1),
    ("WatchdogSec", 183),
];

#[test]
fn unit_has_only_directives_that_systemd_249_knows() {
    let unit = fs::read_to_string(UNIT).unwrap();
    let lines = unit.lines().filter(|l| !l.starts_with(['#', '[']) && !l.is_empty());
    for line in lines {
        let name = line.split_once('=').unwrap_or_else(|| panic!("no directive: {line}")).0;
        let since = KNOWN_SINCE.iter().find(|(known, _)| *known == name).map(|(_, since)| *since);
        assert!(since.is_some_and(|since| since <= 249), "{line}: since {since:?}");
    }
}

/// systemd's own judgement; of a copy whose program is there.
#[test]
fn unit_is_sound_and_hardened_by_systemds_own_tools() {
    let dir = tempfile::tempdir().unwrap();
    let copy = dir.path().join("stipple.service");
    let unit = fs::read_to_string(UNIT).unwrap();
    fs::write(&copy, unit.replace("/usr/bin/stipple", env!("CARGO_BIN_EXE_stipple"))).unwrap();
    let analyze = |args: &[&str]| {
        Command::new("systemd-analyze").args(args).arg(&copy).env("SYSTEMD_PAGER", "").output().unwrap()
    };
    let verified = analyze(&["verify", "--man=no"]);
    assert!(verified.status.success() && text(&verified).is_empty(), "{}", text(&verified));
    // Exposure of 2.0 at most, in tenths.
    let judged = analyze(&["security", "--offline=true", "--threshold=20"]);
    assert!(judged.status.success(), "{}", text(&judged));
}
