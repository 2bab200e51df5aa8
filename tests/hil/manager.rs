//! The service manager of the machine, as it is asked, and what it starts with the properties of the unit.

use std::collections::HashMap;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};
use std::time::{Duration, Instant};

pub const BOARD: &str = "/etc/stipple/board.toml";
pub const OUT: &str = "/var/lib/stipple/run";
const UNIT: &str = "/lib/systemd/system/stipple.service";
const PATIENCE: Duration = Duration::from_secs(30);

/// A program at the priority of programs, below what plays the devices.
fn run(program: &str, arguments: &[&str]) -> Output {
    Command::new("chrt").args(["--other", "0", program]).args(arguments).output().unwrap()
}

pub fn output(program: &str, arguments: &[&str]) -> String {
    String::from_utf8(run(program, arguments).stdout).unwrap()
}

pub fn systemctl(arguments: &[&str]) -> bool {
    run("systemctl", arguments).status.success()
}

/// Properties of the service, as the manager has them now.
pub fn properties() -> HashMap<String, String> {
    let names = "ActiveState,SubState,Result,UnitFileState,Type,MainPID,NRestarts,StatusText,ExecMainStatus";
    let instants = "ExecMainStartTimestampMonotonic,ActiveEnterTimestampMonotonic";
    let text = output("systemctl", &["show", "stipple", "-p", names, "-p", instants]);
    text.lines().filter_map(|l| l.split_once('=')).map(|(name, value)| (name.into(), value.into())).collect()
}

/// What manager and service said of the service since the machine booted. The manager's lines come by the kernel's log, so
/// that they bear no name of a unit.
pub fn journal() -> String {
    let all = output("journalctl", &["-b", "--no-pager", "-o", "short-monotonic"]);
    all.lines().filter(|line| line.contains("stipple")).map(|line| format!("{line}\n")).collect()
}

pub fn wait_for(what: &str, mut there: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !there() {
        if begun.elapsed() > PATIENCE {
            panic!("waited for {what}\n{:?}\n{}", properties(), journal());
        }
        std::thread::sleep(Duration::from_millis(500));
    }
}

/// Nodes of the sensors, and the group that each belongs to.
pub fn sensors() -> Vec<(String, &'static str)> {
    let named = |class: &str, node: &str, part: &str| -> Vec<String> {
        let all = fs::read_dir(Path::new("/sys/class").join(class)).unwrap().flatten();
        let its = all.filter(|e| fs::read_to_string(e.path().join("name")).is_ok_and(|name| name.contains(part)));
        its.map(|e| format!("/dev/{node}{}", e.file_name().to_string_lossy())).collect()
    };
    let lines = std::env::var("HIL_LINES").unwrap();
    let chip = Path::new(&lines).file_name().unwrap().to_string_lossy().into_owned();
    let mut all: Vec<_> = named("video4linux", "", "FLIGHT").into_iter().map(|node| (node, "video")).collect();
    assert!(all.len() >= 2, "{all:?}");
    all.extend(named("i2c-dev", "", "hil-imu i2c").into_iter().map(|node| (node, "stipple-sensors")));
    all.push((format!("/dev/{chip}"), "stipple-sensors"));
    all
}

/// Which of the nodes a shell can open that has the unit's properties, with or without its policy on devices.
pub fn tried(nodes: &[String], policy: bool) -> Vec<String> {
    // One process has its folders. The clock's protection alone makes a policy.
    let mut left_out = vec![
        "ExecStart=",
        "ExecReload=",
        "RuntimeDirectory",
        "Type=",
        "WatchdogSec=",
        "Restart",
        "StateDirectory",
        "CacheDirectory",
    ];
    left_out.extend(["ConfigurationDirectory", "Environment="]);
    if !policy {
        left_out.extend(["Device", "ProtectClock="]);
    }
    let unit = fs::read_to_string(UNIT).unwrap();
    let kept = unit.lines().filter(|line| !left_out.iter().any(|start| line.starts_with(start)));
    let kept: String = kept.map(|line| format!("{line}\n")).collect();
    let script = "for node; do if (: <>$node) 2>/dev/null || (: <$node) 2>/dev/null; then echo $node; fi; done";
    let script = script.replace('$', "$$");
    let service = format!(
        "[Service]\nType=oneshot\nStandardOutput=truncate:/run/stipple-trial.opened\n\
         ExecStart=/bin/sh -c '{script}' sh {}\n",
        nodes.join(" "),
    );
    fs::write("/run/systemd/system/stipple-trial.service", kept.replace("[Service]\n", &service)).unwrap();
    assert!(systemctl(&["daemon-reload"]) && systemctl(&["start", "stipple-trial"]));
    fs::read_to_string("/run/stipple-trial.opened").unwrap().lines().map(String::from).collect()
}

/// Names and priorities of the real-time threads of a process.
pub fn priorities(pid: u32) -> Vec<(String, u32)> {
    let threads = fs::read_dir(format!("/proc/{pid}/task")).unwrap().flatten();
    let stats = threads.filter_map(|t| fs::read_to_string(t.path().join("stat")).ok());
    let of = |stat: String| {
        let (name, rest) = stat.split_once('(')?.1.rsplit_once(')')?;
        // proc(5): fields 40 and 41 are the priority of a real-time thread and the policy; the rest begins with the third.
        let fields: Vec<&str> = rest.split_whitespace().collect();
        (fields[41 - 3] != "0").then(|| Some((name.to_string(), fields[40 - 3].parse().ok()?)))?
    };
    stats.filter_map(of).collect()
}
