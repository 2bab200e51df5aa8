//! The log of a run, and what `stipple recover` makes of it: after an end, after SIGKILL at any moment, with damage,
//! and on a disk that is full or gone.

use crate::small_disk::on_a_small_disk;
use crate::start::{children, flight, kill, shared_library, stipple, text, BOARD};
use serde_json::Value;
use std::fs;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

/// A replay without a map, or a run with one.
fn fly(what: &[&str], out: &Path) -> Command {
    let mut command = stipple();
    let map = if what[0] == "run" { "map.scale=4" } else { "map.enabled=false" };
    let more = ["--board", BOARD, "--set", map, "--out", out.to_str().unwrap()];
    command.args(what).args(more);
    command
}

fn recover(out: &Path) -> Output {
    stipple().args(["recover", out.to_str().unwrap()]).output().unwrap()
}

fn poses(out: &Path) -> usize {
    fs::read_to_string(out.join("trajectory.tum")).unwrap().lines().skip(1).count()
}

fn report(out: &Path) -> Value {
    serde_json::from_slice(&fs::read(out.join("report.json")).unwrap()).unwrap()
}

#[test]
fn a_log_gives_the_trajectory_that_the_run_wrote() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (flight(dir.path(), "3"), dir.path().join("out"));
    let o = fly(&["replay", data.to_str().unwrap(), "--pace", "lockstep"], &out).output().unwrap();
    assert!(o.status.success(), "{}", text(&o));
    let r = report(&out);
    let counts =
        ["log_records_lost", "log_ended_early", "log_files"].map(|n| r[format!("count_{n}")].as_u64().unwrap());
    assert_eq!((counts, &r["heap_after_seal"]), ([0, 0, 1], &0.into()));
    let tum = out.join("trajectory.tum");
    let wrote = fs::read(&tum).unwrap();
    // What a run wrote at its end stays, though it were changed.
    fs::write(&tum, b"mine").unwrap();
    let o = recover(&out);
    assert!(text(&o).contains("stays as it is") && fs::read(&tum).unwrap() == b"mine", "{}", text(&o));
    fs::remove_file(&tum).unwrap();
    let o = recover(&out);
    assert!(
        o.status.success()
            && text(&o).contains(" 61 frames")
            && text(&o).contains(": 3.0 s, ")
            && text(&o).contains("ended: "),
        "{}",
        text(&o)
    );
    assert!(fs::read(&tum).unwrap() == wrote);
    // Damage costs the part of the log that it is in.
    let log = out.join("log-0000.mcap");
    let whole = fs::read(&log).unwrap();
    let mut damaged = whole.clone();
    damaged[whole.len() / 2..][..512].fill(0);
    fs::write(&log, damaged).unwrap();
    fs::remove_file(&tum).unwrap();
    let o = recover(&out);
    let said = text(&o);
    assert!(said.contains("are damaged or cut off: skipped") && said.contains("ended: "), "{said}");
    let of_whole = String::from_utf8(wrote.clone()).unwrap();
    let lines = fs::read_to_string(&tum).unwrap();
    assert!(poses(&out) > 10 && lines.lines().all(|line| of_whole.lines().any(|l| l == line)), "{said}");
    fs::write(&log, whole).unwrap();
    // Another run in the same folder loses nothing of the one before.
    let o = fly(&["run", "--dataset", data.to_str().unwrap(), "--duration", "2"], &out).output().unwrap();
    assert!(o.status.success(), "{}", text(&o));
    assert!(out.join("log-0001.mcap").is_file());
    assert!(recover(&out).status.success() && poses(&out) < 45);
    assert!(fs::read(out.join("trajectory-log-0000.tum")).unwrap() == wrote);
}

#[test]
fn a_killed_run_is_recovered_but_for_its_last_second() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (flight(dir.path(), "8"), dir.path().join("out"));
    for pause_ms in [0, 130, 370] {
        let _ = fs::remove_dir_all(&out);
        fs::create_dir(&out).unwrap();
        fs::write(out.join("map.ply"), b"of an earlier run").unwrap();
        let mut child = fly(&["run", "--dataset", data.to_str().unwrap()], &out)
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        // One line a second: "3.0 of 8.0 s: 57 frames, ..".
        let lines = BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok);
        let frames = |line: String| line.split_once(" s: ")?.1.split_once(" frames")?.0.parse::<u64>().ok();
        let frames = lines.filter_map(frames).find(|n| *n >= 30).unwrap();
        std::thread::sleep(Duration::from_millis(1000 + pause_ms));
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(!out.join("trajectory.tum").exists() && !out.join("map.ply").exists());
        assert!(out.join("previous-map.ply").exists());
        let o = recover(&out);
        let said = text(&o);
        assert!(o.status.success() && said.contains("cut off or damaged here"), "{said}");
        let logged: u64 = said.split_once(" frames").unwrap().0.rsplit_once(' ').unwrap().1.parse().unwrap();
        assert!(logged >= frames, "{frames} a second before the end: {said}");
        assert!(logged < 10 + poses(&out) as u64, "{said}");
    }
}

#[test]
fn a_folder_without_a_log_is_told_so() {
    let dir = tempfile::tempdir().unwrap();
    for (place, code) in [(dir.path().join("no"), 66), (dir.path().to_path_buf(), 65)] {
        let o = recover(&place);
        assert_eq!(o.status.code(), Some(code), "{}", text(&o));
    }
    assert!(!dir.path().join("no").exists());
}

/// A disk with a little more room than the log leaves to others: the log ends, and the run does not.
#[test]
fn a_disk_that_fills_ends_the_log_and_not_the_run() {
    on_a_small_disk("65600k", "log::a_disk_that_fills_ends_the_log_and_not_the_run", |disk| {
        let dir = tempfile::tempdir().unwrap();
        let (data, out) = (flight(dir.path(), "8"), disk.join("out"));
        let o = fly(&["run", "--dataset", data.to_str().unwrap()], &out).output().unwrap();
        let (r, said) = (report(&out), text(&o));
        assert!(o.status.success() && said.matches("the log of this run ended early").count() == 1, "{said}");
        assert!(said.contains("are kept: make room") && r["count_log_ended_early"] == 1, "{said}");
        let lost = r["count_log_records_lost"].as_u64().unwrap();
        assert!(lost > 20 && r["frames"].as_u64().unwrap() > 100 && poses(&out) > 90, "{said}");
        // All that was written is there, and says why there is no more.
        fs::remove_file(out.join("trajectory.tum")).unwrap();
        let o = recover(&out);
        assert!(o.status.success() && text(&o).contains("make room"), "{}", text(&o));
        assert!(poses(&out) > 10, "{}", text(&o));
    });
}

/// A disk that is pulled out, or that its driver makes read-only after an error: from then on, every call that would write to
/// it fails with the error code of that (tests/program/pulled_disk.c).
#[test]
fn a_disk_pulled_out_or_made_read_only_ends_the_log_and_not_the_run() {
    let dir = tempfile::tempdir().unwrap();
    let (data, shim) = (flight(dir.path(), "5"), dir.path().join("pulled_disk.so"));
    shared_library("tests/program/pulled_disk.c", &[], &shim);
    for (code, name) in [("5", "os error 5"), ("30", "os error 30")] {
        let (out, pulled) = (dir.path().join(code), dir.path().join(format!("pulled-{code}")));
        let mut command = fly(&["run", "--dataset", data.to_str().unwrap()], &out);
        let shimmed = [("LD_PRELOAD", &shim), ("PULLED_DISK", &out), ("PULLED_FLAG", &pulled)];
        command.envs(shimmed).env("PULLED_ERRNO", code).stdout(Stdio::null()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let mut said = vec![];
        for line in BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok) {
            if line.starts_with("2.") && line.contains(" frames") {
                fs::write(&pulled, b"").unwrap();
                // A mapper that dies then comes back: mapping needs no disk.
                children(child.id()).into_iter().for_each(|mapper| kill(mapper, "KILL"));
            }
            said.push(line);
        }
        let (ended, said) = (child.wait().unwrap(), said.join("\n"));
        assert_eq!(ended.code(), Some(73), "{said}");
        // The run went on to its end, and said once that the log had not.
        assert!(said.contains("\n4.") && said.matches("the log of this run ended early").count() == 1, "{said}");
        assert!(said.contains(name) && said.lines().count() < 25, "{said}");
        assert!(said.contains("the mapper maps again"), "{said}");
        assert!(!out.join("trajectory.tum").exists() && !out.join("report.json").exists());
        let o = recover(&out);
        assert!(o.status.success() && (15..60).contains(&poses(&out)), "{} of\n{said}", text(&o));
    }
}
