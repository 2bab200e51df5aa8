//! The program as a user starts it, for the tests of what it does with sensors.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output};
use std::sync::Mutex;
use std::time::UNIX_EPOCH;

pub const BOARD: &str = "board-configs/lavapipe.toml";

pub fn stipple() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_stipple"));
    command.current_dir(env!("CARGO_MANIFEST_DIR"));
    command
}

pub fn text(o: &Output) -> String {
    String::from_utf8_lossy(&o.stderr).into_owned() + &String::from_utf8_lossy(&o.stdout)
}

/// Asks it to stop: with `kill` of the shell, since Debian's own is in a package that not every machine has.
pub fn signal(child: &Child, name: &str) {
    kill(child.id(), name);
}

pub fn kill(pid: u32, name: &str) {
    assert!(Command::new("sh").args(["-c", &format!("kill -{name} {pid}")]).status().unwrap().success());
}

/// The processes that `parent` has started.
pub fn children(parent: u32) -> Vec<u32> {
    let all = std::fs::read_dir("/proc").unwrap().filter_map(|e| e.unwrap().file_name().to_str()?.parse::<u32>().ok());
    let parent_of = |pid: &u32| {
        let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
        stat.rsplit_once(')')?.1.split_whitespace().nth(1)?.parse::<u32>().ok()
    };
    all.filter(|pid| parent_of(pid) == Some(parent)).collect()
}

/// Compiles a source of tests/program or drivers/tests, with these definitions, into a library that a program can be given.
pub fn shared_library(source: &str, definitions: &[&str], to: &Path) {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join(source);
    let mut compiler = Command::new("cc");
    compiler.args(["-shared", "-fPIC"]).args(definitions).arg("-o").arg(to).arg(source).arg("-ldl");
    assert!(compiler.status().unwrap().success(), "{compiler:?}");
}

/// A copy of a simulated flight in `dir`. One is rendered for each duration and build of the program, in target/tmp.
pub fn flight(dir: &Path, seconds: &str) -> PathBuf {
    static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());
    let _guard = ONE_AT_A_TIME.lock();
    let built = std::fs::metadata(env!("CARGO_BIN_EXE_stipple")).unwrap().modified().unwrap();
    let built = built.duration_since(UNIX_EPOCH).unwrap().as_nanos();
    let flights = Path::new(env!("CARGO_TARGET_TMPDIR")).join("flights");
    let rendered = flights.join(format!("{built}/{seconds}"));
    if !rendered.exists() {
        remove_all_but(&flights, &built.to_string());
        let unfinished = flights.join(format!("{built}/{seconds}-{}", std::process::id()));
        let args = ["sim", "demo", "--duration", seconds, "--out", unfinished.to_str().unwrap()];
        let o = stipple().args(args).output().unwrap();
        assert!(o.status.success(), "{}", text(&o));
        // Another process may have been as quick.
        assert!(std::fs::rename(&unfinished, &rendered).is_ok() || rendered.exists());
    }
    let out = dir.join("flight");
    assert!(Command::new("cp").arg("-r").args([&rendered, &out]).status().unwrap().success());
    out
}

fn remove_all_but(folder: &Path, name: &str) {
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        if entry.file_name() != name {
            let _ = std::fs::remove_dir_all(entry.path());
        }
    }
}
