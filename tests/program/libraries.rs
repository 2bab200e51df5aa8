//! What the program needs of a machine to start, and what it does where OpenCV is missing.

use crate::start::{self, text};
use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

const STIPPLE: &str = env!("CARGO_BIN_EXE_stipple");

/// Runs the program where the loader looks into `libraries` first.
fn stipple(libraries: &Path, args: &[&str]) -> Output {
    start::stipple().args(args).env("LD_LIBRARY_PATH", libraries).output().unwrap()
}

/// A folder in which the libraries of OpenCV that the program's shim asks for are files that are none.
fn without_opencv() -> tempfile::TempDir {
    let program = fs::read(STIPPLE).unwrap();
    let starts = program.windows(11).enumerate().filter(|(_, w)| w == b"libopencv_c").map(|(i, _)| i);
    let names = starts.map(|i| program[i..].iter().take_while(|b| b.is_ascii_graphic()).map(|b| *b as char).collect());
    let names: BTreeSet<String> = names.filter(|name: &String| name.contains(".so.")).collect();
    assert_eq!(names.len(), 2, "calib3d and core: {names:?}");
    let folder = tempfile::tempdir().unwrap();
    names.iter().for_each(|name| fs::write(folder.path().join(name), [b'x'; 4096]).unwrap());
    folder
}

#[test]
fn the_program_itself_needs_neither_libgpiod_nor_opencv() {
    let o = Command::new("ldd").arg(STIPPLE).output().unwrap();
    let said = text(&o);
    assert!(o.status.success() && said.contains("libc.so"), "{said}");
    assert!(!said.contains("gpiod") && !said.contains("opencv"), "{said}");
}

#[test]
fn every_board_fits_with_sgm_where_opencv_cannot_be_loaded() {
    let missing = without_opencv();
    let boards = fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("board-configs")).unwrap();
    let boards = boards.map(|e| e.unwrap().path()).filter(|p| p.extension().is_some_and(|e| e == "toml"));
    for (board, method) in boards.flat_map(|b| ["bm", "sgbm"].map(|method| (b.clone(), method))) {
        let method_set = format!("stereo.method={method}");
        let o = stipple(missing.path(), &["check", "--board", board.to_str().unwrap(), "--set", &method_set]);
        let (said, warned) = (text(&o), String::from_utf8_lossy(&o.stderr).into_owned());
        assert!(o.status.success(), "{said}");
        assert!(said.contains("stereo: pair on its way to the GPU") && !said.contains("disparity of OpenCV"), "{said}");
        assert!(warned.lines().count() == 1 && warned.starts_with("stipple: warning: stereo.method"), "{warned}");
        for part in [&format!("`{method}`"), "libopencv_c", "`sgm` matches", "libopencv-calib3d"] {
            assert!(warned.contains(part), "{part}: {warned}");
        }
    }
    let o = stipple(missing.path(), &["check", "--set", "stereo.method=sgm"]);
    assert!(o.status.success() && o.stderr.is_empty(), "what asks for none is told nothing: {}", text(&o));
}

#[test]
fn sgm_makes_the_map_where_opencv_cannot_be_loaded() {
    let dir = tempfile::tempdir().unwrap();
    let (flight, out) = (dir.path().join("flight"), dir.path().join("out"));
    let missing = without_opencv();
    let o = stipple(missing.path(), &["sim", "demo", "--duration", "1", "--out", flight.to_str().unwrap()]);
    assert!(o.status.success(), "{}", text(&o));
    let flown = ["--board", "board-configs/lavapipe.toml", "--pace", "lockstep", "--steps", "1", "--scale", "4"];
    let [flight, to] = [&flight, &out].map(|p| p.to_str().unwrap());
    let flown = [&["replay", flight, "--out", to, "--set", "stereo.method=bm"], &flown[..]].concat();
    let o = stipple(missing.path(), &flown);
    let said = text(&o);
    assert!(o.status.success(), "{said}");
    assert_eq!(said.matches("`sgm` matches in its place").count(), 1, "{said}");
    let report: serde_json::Value = serde_json::from_slice(&fs::read(out.join("report.json")).unwrap()).unwrap();
    assert!(report["warnings"] == 1 && report["splats"].as_u64() > Some(1000), "{report}");
    let page = fs::read_to_string(out.join("report.html")).unwrap();
    assert!(page.contains("`sgm` matches in its place"), "the report says so");
}
