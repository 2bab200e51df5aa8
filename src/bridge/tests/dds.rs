//! The bridge between a daemon that the test plays and Eclipse Cyclone DDS (other_end.py), which rmw_cyclonedds is built on:
//! over the loopback interface, without multicast, in a domain of each test's own.
#![cfg(test)]
#![allow(clippy::unwrap_used)]

use glam::{DQuat, DVec3};
use serde_json::{json, Value};
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{channel, Receiver};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// The unit's z is forward, its y right, its x up.
const MOUNT: [&str; 2] = ["--mount-rpy-deg", "0,90,0"];
const PATIENCE: Duration = Duration::from_secs(20);
/// Levels of DiagnosticStatus.
const LEVELS: [u64; 3] = [0, 1, 2];

fn python() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../target/python-dds")
}

/// Where `make test` puts Cyclone DDS; where it could not, this says so, and a test is left out.
fn is_left_out() -> bool {
    let is_there = python().join("cyclonedds").is_dir();
    if !is_there {
        eprintln!(
            "left out: there is no cyclonedds in target/python-dds; `make target/python-dds/cyclonedds` fetches it"
        );
    }
    !is_there
}

/// A domain of this process and test; those above 101 use ports that Linux gives to others.
fn domain() -> String {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    (1 + (std::process::id() + 17 * NEXT.fetch_add(1, Ordering::Relaxed)) % 100).to_string()
}

fn wall_ns() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_nanos() as i64
}

fn wait_for<T>(what: &str, mut poll: impl FnMut() -> Option<T>) -> T {
    let begun = Instant::now();
    loop {
        if let Some(found) = poll() {
            return found;
        }
        assert!(begun.elapsed() < PATIENCE, "{what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

fn signal(child: &Child, name: &str) {
    assert!(Command::new("kill").args(["-s", name, &child.id().to_string()]).status().unwrap().success());
}

/// A process whose lines are kept, and which ends with the test.
struct Process(Child, Arc<Mutex<Vec<String>>>);

impl Process {
    fn start(command: &mut Command, takes_errors: bool) -> Process {
        let piped = if takes_errors { command.stderr(Stdio::piped()) } else { command.stdout(Stdio::piped()) };
        let mut child = piped.stdin(Stdio::piped()).spawn().unwrap();
        let output: Box<dyn Read + Send> =
            if takes_errors { Box::new(child.stderr.take().unwrap()) } else { Box::new(child.stdout.take().unwrap()) };
        let lines = Arc::new(Mutex::new(vec![]));
        let kept = lines.clone();
        std::thread::spawn(move || {
            BufReader::new(output).lines().map_while(Result::ok).for_each(|line| kept.lock().unwrap().push(line));
        });
        Process(child, lines)
    }

    fn lines(&self) -> Vec<String> {
        self.1.lock().unwrap().clone()
    }

    fn ends_with(mut self, code: i32) -> Vec<String> {
        let status = wait_for("the process ends", || self.0.try_wait().unwrap());
        assert_eq!(status.code(), Some(code), "{:?}", self.lines());
        self.lines()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Cyclone DDS, and what it heard of a topic.
struct OtherEnd(Process);

impl OtherEnd {
    fn start(domain: &str, only: &[&str]) -> OtherEnd {
        let mut command = Command::new("python3");
        command.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/other_end.py")).arg(domain);
        if !only.is_empty() {
            command.arg("--only").args(only);
        }
        let process = Process::start(command.env("PYTHONPATH", python()), false);
        wait_for("Cyclone DDS is where `make test` puts it", || (!process.lines().is_empty()).then_some(()));
        OtherEnd(process)
    }

    fn heard(&self, topic: &str) -> Vec<Value> {
        let begins = format!("{{\"topic\": \"{topic}\"");
        let of_topic = |line: &String| line.starts_with(&begins);
        let lines = self.0.lines();
        lines
            .iter()
            .filter(|l| of_topic(l))
            .map(|l| serde_json::from_str::<Value>(l).unwrap()["message"].take())
            .collect()
    }

    /// Waits for diagnostics of a level with a text.
    fn diagnosed(&self, level: u64, text: &str) -> Value {
        let from = self.heard("diagnostics").len();
        wait_for(&format!("level {level}: {text}"), || {
            let all = self.heard("diagnostics").split_off(from);
            let is_it = |d: &Value| d["level"] == level && d["message"].as_str().unwrap().contains(text);
            all.into_iter().map(|mut d| d[0].take()).find(is_it)
        })
    }
}

/// The daemon's side of the socket. Points are what was put there; other connections are handed over.
struct Daemon {
    subscribers: Receiver<(UnixStream, String)>,
    path: PathBuf,
    points: Arc<Mutex<Vec<u8>>>,
}

impl Daemon {
    fn start(path: &Path) -> Daemon {
        let _ = std::fs::remove_file(path);
        let listener = UnixListener::bind(path).unwrap();
        let (send, subscribers) = channel();
        let points = Arc::new(Mutex::new(vec![]));
        let kept = points.clone();
        std::thread::spawn(move || {
            for mut stream in listener.incoming().map_while(Result::ok) {
                let mut request = String::new();
                BufReader::new(stream.try_clone().unwrap()).read_line(&mut request).unwrap();
                if !request.contains("points") {
                    if send.send((stream, request)).is_err() {
                        return;
                    }
                    continue;
                }
                let points = kept.lock().unwrap().clone();
                let (count, generation) = (points.len() / 16, points.len());
                let head = json!({"type": "points", "generation": generation, "t_ns": 1, "wall_ns": 1_000_000_007_i64 + count as i64,
                    "epoch": 0, "count": count, "of": 2 * count, "stride": 16});
                let _ = stream.write_all(&[format!("{head}\n").as_bytes(), &points].concat());
            }
        });
        Daemon { subscribers, path: path.into(), points }
    }

    fn bridge(&self, domain: &str, more: &[&str]) -> Process {
        let mut command = Command::new(env!("CARGO_BIN_EXE_stipple-bridge"));
        command.args(["--socket", self.path.to_str().unwrap(), "--domain", domain, "--localhost"]).args(more);
        Process::start(&mut command, true)
    }

    fn subscriber(&self) -> UnixStream {
        self.subscribers.recv_timeout(PATIENCE).unwrap().0
    }
}

fn tell(link: &mut UnixStream, line: &Value) {
    link.write_all(format!("{line}\n").as_bytes()).unwrap();
}

/// State number `n`, of no special form.
fn state(n: usize) -> Value {
    static ZERO: std::sync::OnceLock<Instant> = std::sync::OnceLock::new();
    let t_ns = ZERO.get_or_init(Instant::now).elapsed().as_nanos() as i64;
    let wave = |k: usize| ((n * 31 + k * 17) as f64 * 0.1).sin();
    let three = |k: usize| [wave(k), wave(k + 1), wave(k + 2)];
    let q = DQuat::from_scaled_axis(DVec3::from(three(3)) * 2.0);
    let mut position = three(0);
    position[0] = n as f64;
    json!({"type": "state", "t_ns": t_ns, "wall_ns": wall_ns(), "epoch": 0, "quality": 80, "source": "frame",
        "position": position, "orientation": q.to_array(), "velocity_body": three(7), "rate_body": three(11),
        "pose_covariance": (0..36).map(wave).collect::<Vec<_>>(),
        "velocity_covariance": (40..49).map(wave).collect::<Vec<_>>(), "unknown": [1, {}]})
}

fn status(uptime_s: f64) -> Value {
    json!({"type": "status", "version": "0.1.0", "board": "drone-pi5", "dataset": "", "t_ns": 1, "wall_ns": 1, "uptime_s": uptime_s,
        "state": null, "health": [], "counters": {"frames_overwritten": 3}, "map": {"anchors": 4, "psnr_db": null},
        "frames": 10, "posed": 9, "governor": {"share": 1.0, "reason": null},
        "map_from_odom": {"t_ns": 1, "count": 2, "epoch": 7, "position": [1.0, 2.0, 3.0], "yaw": 0.5, "covariance": ([[0.0; 4]; 4])}})
}

/// Tells states far below zero until Cyclone hears them: both ends know each other from then on.
fn acquaint(link: &mut UnixStream, others: &[&OtherEnd]) {
    wait_for("the ends find each other", || {
        let mut early = state(0);
        early["position"][0] = (-1e6).into();
        tell(link, &early);
        std::thread::sleep(Duration::from_millis(40));
        let hears = |o: &&OtherEnd| !o.heard("odometry").is_empty();
        others.iter().all(hears).then_some(())
    });
    std::thread::sleep(Duration::from_millis(500));
}

fn numbers(value: &Value) -> Vec<f64> {
    serde_json::from_value(value.clone()).unwrap()
}

/// What Cyclone heard beside what the daemon told, turned here by the definition of the axes.
fn is_that_state(heard: &Value, told: &Value) {
    let near = |a: &[f64], b: &[f64]| {
        assert!(a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12), "{a:?} {b:?}");
    };
    assert_eq!(
        (&heard["stamp"], &heard["frame"], &heard["child"]),
        (&told["wall_ns"], &"odom".into(), &"base_link".into())
    );
    let (pose, q) = (numbers(&heard["pose"]), numbers(&told["orientation"]));
    near(&pose[..3], &numbers(&told["position"]));
    let (odom_from_base, odom_from_body) = (DQuat::from_slice(&pose[3..]), DQuat::from_slice(&q));
    for (of_base, of_body) in [(DVec3::X, DVec3::Z), (DVec3::Y, DVec3::NEG_Y), (DVec3::Z, DVec3::X)] {
        near(&(odom_from_base * of_base).to_array(), &(odom_from_body * of_body).to_array());
    }
    // Row of the body, and its sign, for each axis of base.
    const FROM: [(usize, f64); 3] = [(2, 1.0), (1, -1.0), (0, 1.0)];
    let (v, w, twist) = (numbers(&told["velocity_body"]), numbers(&told["rate_body"]), numbers(&heard["twist"]));
    near(&twist, &[FROM.map(|(row, sign)| sign * v[row]), FROM.map(|(row, sign)| sign * w[row])].concat());
    near(&numbers(&heard["pose_covariance"]), &numbers(&told["pose_covariance"]));
    let (of_body, of_base) = (numbers(&told["velocity_covariance"]), numbers(&heard["twist_covariance"]));
    for (i, j) in (0..9).map(|n| (n / 3, n % 3)) {
        let ((row, of_row), (column, of_column)) = (FROM[i], FROM[j]);
        near(&[of_base[6 * i + j]], &[of_row * of_column * of_body[3 * row + column]]);
    }
}

#[test]
fn every_state_and_cloud_arrives_once_and_as_it_was() {
    if is_left_out() {
        return;
    }
    const STATES: usize = 600;
    let (dir, domain) = (tempfile::tempdir().unwrap(), domain());
    let daemon = Daemon::start(&dir.path().join("status"));
    let bridge = daemon.bridge(&domain, &[&MOUNT[..], &["--cloud-period", "0.5", "--rate", "0"]].concat());
    let (mut link, request) = daemon.subscribers.recv_timeout(PATIENCE).unwrap();
    assert_eq!(request, "{\"subscribe\":[\"state\",\"event\",\"status\"],\"hz\":0}\n");
    let other = OtherEnd::start(&domain, &[]);
    acquaint(&mut link, &[&other]);
    tell(&mut link, &status(1.0));
    let told: Vec<Value> = (0..STATES)
        .map(|n| {
            let told = state(n);
            tell(&mut link, &told);
            if n == STATES / 2 {
                // A point in a hundred is not finite.
                let x = |i: u16| if i.is_multiple_of(100) { f32::NAN } else { f32::from(i) };
                let point =
                    |i: u16| [x(i).to_le_bytes(), 1.5f32.to_le_bytes(), 2.5f32.to_le_bytes(), [1, 2, 3, i as u8]];
                *daemon.points.lock().unwrap() = (0..=u16::MAX).flat_map(point).flatten().collect();
            }
            std::thread::sleep(Duration::from_millis(5));
            told
        })
        .collect();
    wait_for("a cloud", || (!other.heard("map").is_empty()).then_some(()));
    std::thread::sleep(Duration::from_millis(1500));
    let counted = |heard: Vec<Value>, x: fn(&Value) -> &Value| -> Vec<Value> {
        heard.into_iter().filter(|m| x(m).as_f64().unwrap() >= 0.0).collect()
    };
    let heard = counted(other.heard("odometry"), |m| &m["pose"][0]);
    let tf = counted(other.heard("tf"), |m| &m[0]["pose"][0]);
    assert_eq!((heard.len(), tf.len()), (STATES, STATES), "{:?}", bridge.lines());
    for ((heard, told), tf) in heard.iter().zip(&told).zip(&tf) {
        is_that_state(heard, told);
        assert_eq!(tf.as_array().unwrap().len(), 2);
        let ([x, y, z], (sin, cos)) = ([1.0, 2.0, 3.0], 0.25f64.sin_cos());
        assert_eq!(json!(["stamp", "frame", "child"].map(|key| &tf[1][key])), json!([heard["stamp"], "map", "odom"]));
        let found = numbers(&tf[1]["pose"]);
        let near = |(a, b): (&f64, f64)| (a - b).abs() < 1e-12;
        assert!(found.len() == 7 && found.iter().zip([x, y, z, 0.0, 0.0, sin, cos]).all(near), "{found:?}");
        ["stamp", "frame", "child", "pose"].iter().for_each(|key| assert_eq!(tf[0][key], heard[key]));
    }
    for (what, part) in [("alone", &heard[..STATES / 2]), ("beside a cloud", &heard[STATES / 2..])] {
        assert!(print_latency(what, part) < 50_000);
    }
    assert_cloud(&other.heard("map"), &daemon.points.lock().unwrap());
    // Who comes late gets the last cloud, which is not sent again.
    let late = OtherEnd::start(&domain, &["map"]);
    wait_for("the last cloud", || (late.heard("map").len() == 1).then_some(()));
    assert_cloud(&late.heard("map"), &daemon.points.lock().unwrap());
    tell(&mut link, &status(5.0));
    let values = &other.diagnosed(2, "no state for")["values"];
    assert_eq!((&values["counters.frames_overwritten"], &values["cloud_points"]), (&"3".into(), &"64880".into()));
    signal(&bridge.0, "TERM");
    let said = bridge.ends_with(0);
    assert_eq!(said.last().unwrap(), "stipple-bridge: stopped");
}

/// Prints times from a line of the socket to Cyclone's reader, and answers their median, us.
fn print_latency(what: &str, heard: &[Value]) -> i64 {
    let since = |m: &Value| (m["now"].as_i64().unwrap() - m["stamp"].as_i64().unwrap()) / 1000;
    let mut all: Vec<i64> = heard.iter().map(since).collect();
    all.sort_unstable();
    let part = |p: usize| all[p * (all.len() - 1) / 100];
    println!("line to Cyclone, {what}: p50 {} us, p99 {} us, most {} us", part(50), part(99), part(100));
    part(50)
}

/// One cloud was heard, of the points that are finite.
fn assert_cloud(heard: &[Value], points: &[u8]) {
    assert_eq!(heard.len(), 1);
    let is_finite = |p: &&[u8]| f32::from_le_bytes(p[..4].try_into().unwrap()).is_finite();
    let finite: Vec<&[u8]> = points.chunks_exact(16).filter(is_finite).collect();
    let packed = finite
        .iter()
        .flat_map(|p| [&p[..12], &[p[14], p[13], p[12], 0], &(f32::from(p[15]) / 255.0).to_le_bytes()].concat());
    let hex: String = packed.map(|byte| format!("{byte:02x}")).collect();
    let m = &heard[0];
    let shape = ["stamp", "frame", "height", "width", "step", "row", "big", "dense"].map(|key| m[key].clone());
    let stamp = 1_000_000_007_i64 + 65_536;
    assert_eq!(json!(shape), json!([stamp, "map", 1, finite.len(), 20, 20 * finite.len(), false, true]));
    assert!(m["data"] == hex, "bytes of the cloud");
    assert_eq!(m["fields"][3], json!(["rgb", 12, 7, 1]));
}

/// A daemon's states, 20 a second over the connection that there is, with members set to other values.
struct Flight {
    link: Option<UnixStream>,
    changed: Vec<(&'static str, Value)>,
    is_over: bool,
}

fn fly() -> Arc<Mutex<Flight>> {
    let flight = Arc::new(Mutex::new(Flight { link: None, changed: vec![], is_over: false }));
    let shared = flight.clone();
    std::thread::spawn(move || {
        for n in 0.. {
            std::thread::sleep(Duration::from_millis(50));
            let mut flight = shared.lock().unwrap();
            if flight.is_over {
                return;
            }
            let mut told = state(n);
            flight.changed.iter().for_each(|(key, value)| told[*key] = value.clone());
            let _ = flight.link.as_mut().map(|link| link.write_all(format!("{told}\n").as_bytes()));
        }
    });
    flight
}

/// How long something that happened once is told, and a little.
const RECENT: Duration = Duration::from_secs(11);

#[test]
fn diagnostics_follow_the_daemon_through_everything() {
    if is_left_out() {
        return;
    }
    let [ok, warn, error] = LEVELS;
    let (dir, domain) = (tempfile::tempdir().unwrap(), domain());
    let path = dir.path().join("status");
    let daemon = Daemon::start(&path);
    std::fs::remove_file(&path).unwrap();
    let bridge = daemon.bridge(&domain, &["--cloud-period", "0"]);
    let other = OtherEnd::start(&domain, &["odometry", "diagnostics"]);
    other.diagnosed(error, "no daemon: ");
    let daemon = Daemon::start(&path);
    let begun = Instant::now();
    let mut link = daemon.subscriber();
    assert!(begun.elapsed() < Duration::from_secs(1), "a daemon that comes is found within a second");
    tell(&mut link, &status(100.0));
    other.diagnosed(error, "no pose yet");
    let flight = fly();
    let set = |changed: &[(&'static str, Value)]| flight.lock().unwrap().changed = changed.to_vec();
    let say = |bytes: &[u8]| flight.lock().unwrap().link.as_mut().unwrap().write_all(bytes).unwrap();
    flight.lock().unwrap().link = Some(link);
    let good = other.diagnosed(ok, "odometry is running");
    assert_eq!((&good["name"], &good["hardware"]), (&"stipple/odometry".into(), &"drone-pi5".into()));
    set(&[("quality", 0.into())]);
    other.diagnosed(error, "odometry has failed");
    set(&[("quality", 20.into())]);
    other.diagnosed(warn, "weak");
    // Numbers that are none, no JSON, half a line in two parts, a line without an end, and bytes that are no text.
    set(&[("position", json!([1, null, 3]))]);
    other.diagnosed(error, "no state for");
    set(&[]);
    for wrong in [&b"{\"type\":\"state\"}\n"[..], b"{\n", b"\n", b"\xff\xfe\n", b"[1e999]\n", b"{\"type\":\"new\"}\n"] {
        say(wrong);
    }
    other.diagnosed(warn, "a line of the daemon is no message");
    say(&[vec![b'x'; 3 << 20], b"\n".to_vec()].concat());
    let long = other.diagnosed(warn, "a line of the daemon is too long");
    assert_eq!(long["values"]["bridge.lines_too_long"], "1");
    let event = json!({"type": "event", "t_ns": 1, "wall_ns": wall_ns(), "id": "sensor-lost", "level": "critical", "text": "left camera"});
    say(format!("{event}\n").as_bytes());
    other.diagnosed(error, "sensor-lost: left camera");
    set(&[("epoch", 1.into())]);
    let before = other.heard("odometry").len();
    other.diagnosed(error, "epoch 1 begins");
    std::thread::sleep(RECENT);
    other.diagnosed(ok, "odometry is running");
    assert!(other.heard("odometry").len() > before + 150, "states go on through a reset");
    // The daemon ends in the middle of a line, and another one starts.
    say(b"{\"type\":\"sta");
    flight.lock().unwrap().link = None;
    std::fs::remove_file(&path).unwrap();
    other.diagnosed(error, "no daemon: ");
    let daemon = Daemon::start(&path);
    let mut link = daemon.subscriber();
    tell(&mut link, &status(1.0));
    flight.lock().unwrap().link = Some(link);
    other.diagnosed(warn, "the daemon was started anew");
    // One that says nothing any more is left for a new connection.
    let silent = flight.lock().unwrap().link.take();
    other.diagnosed(error, "nothing came for 5 s");
    let again = daemon.subscriber();
    drop((silent, again));
    flight.lock().unwrap().is_over = true;
    let heard = other.heard("odometry");
    let stamps: Vec<i64> = heard.iter().map(|m| m["stamp"].as_i64().unwrap()).collect();
    assert!(stamps.windows(2).all(|s| s[0] < s[1]));
    signal(&bridge.0, "INT");
    let said = bridge.ends_with(0);
    for what in
        ["No such file", "connected to", "is no message", "too long", "epoch 1 begins", "started anew", "nothing came"]
    {
        let times = said.iter().filter(|line| line.contains(what)).count();
        assert!((1..=4).contains(&times), "{what}: {said:?}");
    }
    assert!(said.len() < 30, "once for each change: {said:?}");
}

/// A reader whose process is stopped takes nothing and refuses nothing.
#[test]
fn reader_that_stalls_costs_the_others_nothing() {
    if is_left_out() {
        return;
    }
    const STATES: usize = 400;
    let (dir, domain) = (tempfile::tempdir().unwrap(), domain());
    let daemon = Daemon::start(&dir.path().join("status"));
    let bridge = daemon.bridge(&domain, &["--cloud-period", "0.1"]);
    let mut link = daemon.subscriber();
    let (stalled, other) = (OtherEnd::start(&domain, &["odometry", "map"]), OtherEnd::start(&domain, &["odometry"]));
    acquaint(&mut link, &[&stalled, &other]);
    signal(&stalled.0 .0, "STOP");
    let mut slowest = Duration::ZERO;
    for n in 0..STATES {
        let begun = Instant::now();
        tell(&mut link, &state(n));
        slowest = slowest.max(begun.elapsed());
        *daemon.points.lock().unwrap() = 1f32.to_le_bytes().repeat(4 * (n + 1) * 10);
        std::thread::sleep(Duration::from_millis(10));
    }
    wait_for("every state", || {
        let heard = other.heard("odometry");
        (heard.iter().filter(|m| m["pose"][0].as_f64().unwrap() >= 0.0).count() == STATES).then_some(())
    });
    assert!(slowest < Duration::from_millis(500), "the daemon never waits: {slowest:?}");
    signal(&stalled.0 .0, "CONT");
    // What fits into its queues, or is sent again, arrives late.
    wait_for("the reader goes on", || {
        let last = stalled.heard("odometry").last().cloned();
        last.filter(|m| m["pose"][0] == (STATES - 1) as f64).map(|_| ())
    });
    signal(&bridge.0, "TERM");
    bridge.ends_with(0);
}

#[test]
fn wrong_options_are_refused_and_a_signal_ends_a_bridge_without_a_daemon() {
    let dir = tempfile::tempdir().unwrap();
    let run = |args: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_stipple-bridge"));
        command.args(args).output().unwrap().status.code()
    };
    for wrong in [
        ["--domain", "233"],
        ["--mount-rpy-deg", "1,2"],
        ["--mount-rpy-deg", "1,2,x"],
        ["--mount-rpy-deg", "1,2,nan"],
        ["--namespace", "a b"],
        ["--namespace", "a//b"],
        ["--frames", "odom"],
        ["--cloud-period", "-1"],
        ["--rate", "x"],
    ] {
        assert_eq!(run(&wrong), Some(64), "{wrong:?}");
    }
    assert_eq!(run(&["--help"]), Some(0));
    let daemon = Daemon::start(&dir.path().join("status"));
    std::fs::remove_file(&daemon.path).unwrap();
    let bridge = daemon.bridge(&domain(), &["--cloud-period", "0"]);
    wait_for("the first line", || (!bridge.lines().is_empty()).then_some(()));
    std::thread::sleep(Duration::from_secs(2));
    let daemon = Daemon::start(&daemon.path);
    (0..4).for_each(|_| tell(&mut daemon.subscriber(), &json!({"type": "error", "error": "no room"})));
    signal(&bridge.0, "TERM");
    let begun = Instant::now();
    let said = bridge.ends_with(0);
    assert!(begun.elapsed() < Duration::from_secs(2) && said.len() == 3, "once for each change: {said:?}");
    assert!(said[0].contains("start the daemon, or name its socket with --socket"), "{said:?}");
    assert!(said[1].contains("the daemon refuses: no room") && said[2].ends_with("stopped"), "{said:?}");
}
