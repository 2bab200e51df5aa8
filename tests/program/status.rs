//! The status socket of `stipple run`, and what asks it: `stipple status`, Prometheus, bridges; reload; `stipple bugreport`.

use crate::start::{flight, signal, stipple, text, BOARD};
use serde_json::Value;
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::net::{UnixDatagram, UnixStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// A run that goes on until it is dropped.
struct Run {
    child: Child,
    out: PathBuf,
    _dir: tempfile::TempDir,
}

impl Drop for Run {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Run {
    fn start(more: impl FnOnce(&Path, &mut Command)) -> Run {
        let dir = tempfile::tempdir().unwrap();
        // What others than root may not enter, they cannot ask in.
        fs::set_permissions(dir.path(), std::os::unix::fs::PermissionsExt::from_mode(0o755)).unwrap();
        let (data, out) = (flight(dir.path(), "4"), dir.path().join("out"));
        let mut command = stipple();
        command.args(["run", "--repeat", "--dataset", data.to_str().unwrap(), "--out", out.to_str().unwrap()]);
        command.stdout(Stdio::null()).stderr(fs::File::create(dir.path().join("stderr")).unwrap());
        command.env_remove("RUNTIME_DIRECTORY").env_remove("NOTIFY_SOCKET");
        more(dir.path(), &mut command);
        let run = Run { child: command.spawn().unwrap(), out, _dir: dir };
        let begun = Instant::now();
        while UnixStream::connect(run.socket()).is_err() {
            assert!(begun.elapsed() < Duration::from_secs(60), "{}", run.said());
            std::thread::sleep(Duration::from_millis(20));
        }
        run
    }

    fn without_map() -> Run {
        Run::start(|_, command| {
            command.args(["--board", BOARD, "--set", "map.enabled=false"]);
        })
    }

    fn socket(&self) -> PathBuf {
        self.out.join("status")
    }

    fn said(&self) -> String {
        fs::read_to_string(self._dir.path().join("stderr")).unwrap()
    }

    fn ask(&self, request: &str) -> BufReader<UnixStream> {
        let mut stream = UnixStream::connect(self.socket()).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        BufReader::new(stream)
    }

    fn status(&self) -> Value {
        json(&mut self.ask("{\"get\":\"status\"}\n"))
    }

    /// The status once it is as wanted.
    fn status_when(&self, wanted: impl Fn(&Value) -> bool) -> Value {
        let begun = Instant::now();
        loop {
            let status = self.status();
            if wanted(&status) {
                return status;
            }
            assert!(begun.elapsed() < Duration::from_secs(60), "{status} {}", self.said());
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    fn command(&self, name: &str, more: &[&str]) -> String {
        let o = stipple().arg(name).args(more).arg(&self.out).output().unwrap();
        assert!(o.status.success(), "{}", text(&o));
        String::from_utf8(o.stdout).unwrap()
    }
}

fn json(from: &mut impl BufRead) -> Value {
    let mut line = String::new();
    from.read_line(&mut line).unwrap();
    serde_json::from_str(&line).unwrap_or_else(|e| panic!("{e}: {line}"))
}

fn is_flying(status: &Value) -> bool {
    status["posed"].as_u64() > Some(20) && status["state"].is_object()
}

#[test]
fn status_is_told_as_json_as_metrics_over_http_and_on_a_screen() {
    let run = Run::without_map();
    let status = run.status_when(is_flying);
    let state = &status["state"];
    assert_eq!((status["board"].as_str(), state["epoch"].as_u64()), (Some("lavapipe"), Some(0)));
    let age_ms = (status["t_ns"].as_i64().unwrap() - state["t_ns"].as_i64().unwrap()) as f64 * 1e-6;
    assert!((0.0..2000.0).contains(&age_ms), "{age_ms}");
    assert_eq!(status["wall_ns"].as_i64().unwrap() / 3_600_000_000_000, wall_hours(), "of this time");
    let q: f64 = state["orientation"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap().powi(2)).sum();
    let c: Vec<f64> = state["pose_covariance"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
    assert!((q - 1.0).abs() < 1e-9 && c.len() == 36 && (0..6).all(|i| c[7 * i] > 0.0), "{state}");
    assert!(status["counters"]["frames_overwritten"].is_u64());
    let screen = run.command("status", &[]);
    assert!(screen.contains("odometry  quality") && screen.contains(" with a pose"), "{screen}");
    assert!(serde_json::from_str::<Value>(&run.command("status", &["--json"])).is_ok());
    let metrics = run.command("status", &["--metrics"]);
    // Every line of the format is a comment, or a name, perhaps labels, and a number.
    for line in metrics.lines().filter(|line| !line.starts_with("# TYPE stipple_")) {
        let (name, value) = line.rsplit_once(' ').unwrap();
        let plain = name.split('{').next().unwrap();
        assert!(plain.chars().all(|c| c.is_ascii_alphanumeric() || c == '_') && value.parse::<f64>().is_ok(), "{line}");
    }
    assert!(metrics.contains("stipple_frames_posed_total ") && metrics.contains("stipple_frames_overwritten_total "));
    let mut answer = String::new();
    run.ask("GET /status HTTP/1.1\r\nHost: stipple\r\nAccept: */*\r\n\r\n").read_to_string(&mut answer).unwrap();
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    assert!(head.starts_with("HTTP/1.1 200 OK") && head.contains(&format!("Content-Length: {}", body.len())), "{head}");
    answer.clear();
    run.ask("GET /else HTTP/1.0\r\n\r\n").read_to_string(&mut answer).unwrap();
    assert!(answer.starts_with("HTTP/1.1 404"));
    signal(&run.child, "TERM");
    let begun = Instant::now();
    while run.socket().exists() && begun.elapsed() < Duration::from_secs(10) {
        std::thread::sleep(Duration::from_millis(20));
    }
    assert!(!run.socket().exists(), "it goes with the run");
}

fn wall_hours() -> i64 {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap();
    since.as_secs() as i64 / 3600
}

#[test]
fn subscribers_get_states_at_their_rate_status_each_second_and_events() {
    let run = Run::start(|dir, command| {
        // A camera that is unplugged now and then.
        let rules = dir.join("rules.toml");
        fs::write(&rules, "[[camera]]\nfault = \"unplug\"\nstart_s = 1.5\nend_s = 2.5\n").unwrap();
        command.args(["--board", BOARD, "--set", "map.enabled=false", "--inject", rules.to_str().unwrap()]);
    });
    run.status_when(is_flying);
    let mut all = run.ask("{\"subscribe\":[\"state\",\"event\",\"status\"]}\n");
    let mut few = run.ask("{\"subscribe\":[\"state\"],\"hz\":5}\n");
    let (mut stamps, mut statuses, mut events) = (vec![], 0, vec![]);
    let begun = Instant::now();
    while begun.elapsed() < Duration::from_secs(6) {
        let line = json(&mut all);
        match line["type"].as_str().unwrap() {
            "state" => stamps.push(line["t_ns"].as_i64().unwrap()),
            "status" => statuses += 1,
            "event" => {
                events.push((line["id"].as_str().unwrap().to_string(), line["level"].as_str().unwrap().to_string()))
            }
            other => panic!("{other}"),
        }
    }
    assert!(stamps.is_sorted() && stamps.len() > 60, "{}", stamps.len());
    assert!((5..=7).contains(&statuses), "{statuses}");
    let has = |id: &str, level: &str| events.contains(&(id.into(), level.into()));
    assert!(has("sensor_lost", "critical") && has("sensor_back", "notice"), "{events:?}");
    few.get_mut().set_nonblocking(true).unwrap();
    let (mut bytes, mut text) = ([0; 4096], vec![]);
    while let Ok(count @ 1..) = few.read(&mut bytes) {
        text.extend_from_slice(&bytes[..count]);
    }
    let count = String::from_utf8(text).unwrap().lines().count();
    assert!((15..=32).contains(&count), "{count} states in six seconds at 5 Hz, one of them without a camera");
    // Who comes late hears of what was.
    let first = json(&mut run.ask("{\"subscribe\":[\"event\"]}\n"));
    assert_eq!(first["type"], "event");
}

#[test]
fn malformed_requests_too_many_readers_and_readers_that_stall_harm_nobody() {
    let run = Run::without_map();
    run.status_when(is_flying);
    let huge = "x".repeat(1 << 20) + "\n";
    for wrong in
        ["\n", "{}\n", "nothing\n", "{\"get\":\"all\"}\n", "\u{0}\u{1}\n", "{\"subscribe\":7}\n", huge.as_str()]
    {
        let mut stream = UnixStream::connect(run.socket()).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        // It may have been closed before all of it was taken.
        let _ = stream.write_all(wrong.as_bytes());
        let answer = json(&mut BufReader::new(stream));
        assert!(answer["type"] == "error" && !answer["error"].as_str().unwrap().is_empty(), "{answer}");
    }
    let stalled: Vec<_> = (0..7).map(|_| run.ask("{\"subscribe\":[\"state\",\"event\",\"status\"]}\n")).collect();
    assert_eq!(run.status()["type"], "status", "the eighth");
    let eighth = run.ask("{\"get\":\"status\"}\n");
    let begun = Instant::now();
    let refused = loop {
        // The one that asked before may still be there.
        let mut stream = UnixStream::connect(run.socket()).unwrap();
        stream.set_read_timeout(Some(Duration::from_millis(200))).unwrap();
        let mut line = String::new();
        if BufReader::new(&mut stream).read_line(&mut line).is_ok() && !line.is_empty() {
            break line;
        }
        assert!(begun.elapsed() < Duration::from_secs(10));
    };
    assert!(refused.contains("8 others are connected"), "{refused}");
    drop(eighth);
    // 250 bytes a line and more: a reader's room is used up in ten seconds.
    std::thread::sleep(Duration::from_secs(12));
    drop(stalled);
    let status = run.status_when(is_flying);
    assert_eq!(status["counters"]["frames_overwritten"], 0, "{status}");
    signal(&run.child, "TERM");
    let begun = Instant::now();
    while !run.out.join("report.json").exists() && begun.elapsed() < Duration::from_secs(30) {
        std::thread::sleep(Duration::from_millis(50));
    }
    let report: Value = serde_json::from_slice(&fs::read(run.out.join("report.json")).unwrap()).unwrap();
    assert!(report["count_status_refused"].as_u64() >= Some(1), "{report}");
    assert!(report["count_status_lines_lost"].as_u64() >= Some(1), "{report}");
}

/// Left out where the test is not root's, and cannot be somebody else.
#[test]
fn strangers_are_refused_and_told_so() {
    let run = Run::without_map();
    let as_nobody = |groups: &str| {
        let script = format!(
            "import socket; s = socket.socket(socket.AF_UNIX); s.connect({:?}); s.sendall(b'{{\"get\":\"status\"}}\\n'); \
             print(s.makefile().readline())",
            run.socket().to_str().unwrap()
        );
        let o =
            Command::new("setpriv").args(["--reuid=65534", "--regid=65534", groups, "python3", "-c", &script]).output();
        o.ok().filter(|o| o.status.success()).map(|o| String::from_utf8(o.stdout).unwrap())
    };
    let Some(refused) = as_nobody("--clear-groups") else {
        eprintln!("left out: setpriv or python3 is missing, or this is not root");
        return;
    };
    assert!(refused.contains("only root, the user that flies and members of the groups"), "{refused}");
    // The command says it, too.
    let mut status = Command::new("setpriv");
    status.args(["--reuid=65534", "--regid=65534", "--clear-groups", env!("CARGO_BIN_EXE_stipple"), "status"]);
    for more in [vec![], vec!["--json"]] {
        let o = status.args(more).arg(&run.out).output().unwrap();
        assert!(o.status.code() == Some(69) && text(&o).contains("the user that flies"), "{}", text(&o));
    }
    // Root's group has 0.
    assert!(as_nobody("--groups=0").unwrap().contains("\"status\""));
}

#[test]
fn points_of_the_map_are_told_as_they_are() {
    let run = Run::start(|_, command| {
        command.args(["--board", BOARD, "--set", "map.scale=4"]);
    });
    run.status_when(|status| status["map"]["splats"].as_u64() > Some(100));
    let begun = Instant::now();
    let mut reader = run.ask("");
    let (head, bytes) = loop {
        reader.get_mut().write_all(b"{\"get\":\"points\"}\n").unwrap();
        let head = json(&mut reader);
        assert_eq!((head["type"].as_str(), head["stride"].as_u64()), (Some("points"), Some(16)));
        let mut bytes = vec![0; 16 * head["count"].as_u64().unwrap() as usize];
        reader.read_exact(&mut bytes).unwrap();
        if !bytes.is_empty() {
            break (head, bytes);
        }
        assert!(begun.elapsed() < Duration::from_secs(60), "{head}");
        std::thread::sleep(Duration::from_millis(500));
    };
    assert!(head["generation"].as_u64() >= Some(1) && head["of"].as_u64() >= head["count"].as_u64(), "{head}");
    let of = |at: usize| f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
    let near = (0..bytes.len()).step_by(16).filter(|at| [0, 4, 8].iter().all(|i| of(at + i).abs() < 20.0)).count();
    assert!(near * 10 > bytes.len() / 16 * 9, "{near} of {} are in the room", bytes.len() / 16);
    // The connection goes on.
    reader.get_mut().write_all(b"{\"get\":\"status\"}\n").unwrap();
    assert_eq!(json(&mut reader)["type"], "status");
}

/// A limit that any frame exceeds stands for a board that is too slow, or too hot.
#[test]
fn mapper_that_is_slowed_down_goes_on_and_each_change_is_told() {
    let run = Run::start(|_, command| {
        command.args(["--board", BOARD, "--set", "map.scale=4", "--set", "governor.frame_share_max=0.05"]);
        command.args(["--set", "frontend.threads=1"]);
    });
    let mut events = run.ask("{\"subscribe\":[\"event\"]}\n");
    let slow = run.status_when(|status| status["governor"]["share"].as_f64() < Some(0.2));
    assert!(slow["governor"]["reason"].as_str().unwrap().contains("of its time for a frame"), "{slow}");
    let mut changes = vec![];
    while changes.len() < 5 {
        let event = json(&mut events);
        if event["id"] == "mapper_share" {
            changes.push(event["text"].as_str().unwrap().to_string());
        }
    }
    assert!(changes[0].starts_with("the mapper works 70 % of its time: tracking takes "), "{changes:?}");
    let work = |status: &Value| ["anchors", "iterations"].map(|name| status["map"][name].as_u64().unwrap());
    let before = work(&run.status());
    let after = run.status_when(|status| work(status) != before);
    assert_eq!(after["counters"]["map_restarts"], 0, "it is slow, and does not hang: {after}");
}

/// All or nothing, and the manager hears when it begins and when it is over.
#[test]
fn board_file_is_reloaded_all_or_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let manager = UnixDatagram::bind(dir.path().join("notify")).unwrap();
    manager.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
    let board = dir.path().join("board.toml");
    let original = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(BOARD)).unwrap();
    fs::write(&board, &original).unwrap();
    let run = Run::start(|_, command| {
        command.args(["--board", board.to_str().unwrap(), "--set", "map.enabled=false"]);
        command.env("NOTIFY_SOCKET", dir.path().join("notify"));
    });
    run.status_when(is_flying);
    let mut events = run.ask("{\"subscribe\":[\"event\"]}\n");
    let reload = |text: &str, events: &mut BufReader<UnixStream>| {
        fs::write(&board, text).unwrap();
        signal(&run.child, "HUP");
        loop {
            let event = json(events);
            if event["id"].as_str().unwrap().starts_with("reload") {
                return (event["id"].as_str().unwrap().to_string(), event["text"].as_str().unwrap().to_string());
            }
        }
    };
    let with = |more: &str| format!("{original}\n{more}");
    let (id, said) = reload(&with("[governor]\nframe_share_max = 0.5\n"), &mut events);
    assert_eq!((id.as_str(), said.as_str()), ("reloaded", "reloaded: governor.frame_share_max"));
    let mut heard = vec![];
    while !heard.iter().any(|m: &String| m.contains("RELOADING=1")) || !heard.last().unwrap().contains("READY=1") {
        let mut bytes = [0; 4096];
        let count = manager.recv(&mut bytes).expect("RELOADING, then READY");
        heard.push(String::from_utf8(bytes[..count].to_vec()).unwrap());
    }
    let begins = heard.iter().find(|m| m.contains("RELOADING=1")).unwrap();
    assert!(begins.lines().any(|l| l.strip_prefix("MONOTONIC_USEC=").is_some_and(|us| us.parse::<u64>().is_ok())));
    let (id, said) = reload(&with("[governor]\nframe_share_max = 0.4\n[log]\npredicted_hz = 100.0\n"), &mut events);
    assert!(id == "reload_refused" && said.ends_with("a restart is needed for log.predicted_hz"), "{said}");
    let (id, said) = reload("this is no board", &mut events);
    assert!(id == "reload_refused" && said.contains("board.toml"), "{said}");
    let (id, said) = reload(&with("[governor]\nframe_share_max = 0.5\n"), &mut events);
    assert_eq!((id.as_str(), said.as_str()), ("reloaded", "the board file is as before"), "nothing was taken over");
    assert!(is_flying(&run.status()), "it flies on");
}

#[test]
fn bugreport_has_log_board_and_system_in_one_file() {
    let run = Run::without_map();
    run.status_when(is_flying);
    std::thread::sleep(Duration::from_millis(1500));
    let file = run.out.with_file_name("report.tar.gz");
    let said = run.command("bugreport", &["--board", BOARD, "--out", file.to_str().unwrap()]);
    assert!(said.contains("status.json: ") && !said.contains("status.json: left out"), "{said}");
    let o = Command::new("tar").args(["--list", "--file"]).arg(&file).output().unwrap();
    let list = String::from_utf8(o.stdout).unwrap();
    for name in ["log-0000.mcap", "lavapipe.toml", "system.txt", "contents.txt", "status.json"] {
        assert!(list.lines().any(|line| line.ends_with(&format!("/{name}"))), "{name}: {list}");
    }
    // Nothing else is left, and nothing is overwritten.
    let names: Vec<_> = fs::read_dir(file.parent().unwrap()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert!(names.iter().all(|name| !name.to_string_lossy().contains("partial")), "{names:?}");
    let o = stipple().args(["bugreport", "--out", file.to_str().unwrap()]).arg(&run.out).output().unwrap();
    assert_eq!(o.status.code(), Some(73), "{}", text(&o));
}

#[test]
fn asking_where_nobody_answers_fails_and_says_why() {
    let dir = tempfile::tempdir().unwrap();
    for command in ["status", "top"] {
        let o = stipple().arg(command).arg(dir.path()).output().unwrap();
        // `top` wants a terminal first.
        let (code, why) = if command == "top" { (64, "is no terminal") } else { (69, "no run answers there") };
        assert!(o.status.code() == Some(code) && text(&o).contains(why), "{}", text(&o));
    }
    let socket = std::os::unix::net::UnixListener::bind(dir.path().join("status")).unwrap();
    let o = stipple().arg("status").arg(dir.path()).output().unwrap();
    assert!(o.status.code() == Some(69) && text(&o).contains("does not answer within"), "{}", text(&o));
    drop(socket);
}
