//! `stipple run` beside devices that play a recording, and what its report says of that.

use super::devices::{wait_until, Devices, MS};
use super::start::signal;
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::Command;
use stipple_drivers::Span;

/// From the last picture until the program is stopped: less than a silence.
const AFTER: Span = Span(250 * MS);

impl Devices {
    /// All pictures that both cameras sent were tracked, but for `most`; answers how many they are, how many were tracked,
    /// and how many were dropped and counted.
    pub fn pairs_are_tracked(&self, r: &Value, most: usize) -> [u64; 3] {
        let [left, right] = [0, 1].map(|k| self.cameras[k].sent());
        let pairs = left.iter().filter(|k| right.contains(k)).count() as u64;
        let frames = r["frames"].as_u64().unwrap();
        let lost = r["frames_dropped"].as_u64().unwrap() + count(r, "camera_images_unpaired");
        println!("{} and {} pictures sent, {pairs} pairs: {frames} tracked, {lost} counted", left.len(), right.len());
        assert!(frames as usize + most >= self.stamps.len(), "{frames} of {}", self.stamps.len());
        [pairs, frames, lost]
    }
}

/// The program, at the priority of a program: what plays the devices goes before it, as hardware does.
pub fn stipple(arguments: &[&str]) -> Command {
    let mut command = Command::new("chrt");
    command.args(["--other", "0", env!("CARGO_BIN_EXE_stipple")]).args(arguments);
    command
}

pub fn report(out: &Path) -> Value {
    serde_json::from_slice(&fs::read(out.join("report.json")).unwrap()).unwrap()
}

pub fn count(report: &Value, name: &str) -> u64 {
    report[format!("count_{name}")].as_u64().unwrap_or(0)
}

/// Counters that are not zero.
pub fn counted(report: &Value) -> String {
    let all = report.as_object().unwrap().iter().filter(|(k, v)| k.starts_with("count_") && v.as_u64() != Some(0));
    all.map(|(k, v)| format!("{} {v}", &k[6..])).collect::<Vec<_>>().join(", ")
}

/// `stipple run` through the whole recording, stopped by SIGTERM; `during` is called once it plays.
pub fn fly(devices: &mut Devices, board: &Path, dir: &Path, more: &[&str], during: impl FnOnce(&mut Devices)) {
    let [board, out] = [board, &dir.join("out")].map(|p| p.display().to_string());
    let mut run = stipple(&[&["run", "--board", &board, "--out", &out], more].concat()).spawn().unwrap();
    devices.play();
    during(devices);
    wait_until(devices.end() + AFTER);
    signal(&run, "TERM");
    assert!(run.wait().unwrap().success());
}
