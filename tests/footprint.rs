//! The byte table of every board, as `stipple check` prints it, is a golden file: a change of
//! memory shows as a diff. `STIPPLE_BLESS=1 cargo test --test footprint` writes them anew.
#![allow(clippy::unwrap_used)]

use std::path::Path;
use std::process::Command;

#[test]
fn byte_tables_are_as_reviewed() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut boards = 0;
    for entry in std::fs::read_dir(root.join("board-configs")).unwrap() {
        let board = entry.unwrap().path();
        if board.extension().is_none_or(|e| e != "toml") {
            continue;
        }
        let o = Command::new(env!("CARGO_BIN_EXE_stipple")).arg("check").arg("--board").arg(&board).output().unwrap();
        assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
        let table = String::from_utf8(o.stdout).unwrap();
        let name = board.file_stem().unwrap().to_str().unwrap();
        let golden = root.join(format!("tests/golden/footprint-{name}.txt"));
        if std::env::var_os("STIPPLE_BLESS").is_some() {
            std::fs::write(&golden, &table).unwrap();
        }
        let reviewed = std::fs::read_to_string(&golden).unwrap_or_default();
        assert_eq!(table, reviewed, "{} differs from {}", board.display(), golden.display());
        boards += 1;
    }
    assert!(boards >= 4);
}

/// What a small drone's GPU is asked for at most: 100 k grey Gaussians, EuRoC's images, 64 keyframes.
const DRONE: [&str; 5] = [
    "budget.splats=100000",
    "budget.keyframes=64",
    "budget.image_width_max=752",
    "budget.image_height_max=480",
    "budget.intersections=1500000",
];

fn gpu_bytes(more: &[&str]) -> u64 {
    let board = Path::new(env!("CARGO_MANIFEST_DIR")).join("board-configs/x86-igpu.toml");
    let mut check = Command::new(env!("CARGO_BIN_EXE_stipple"));
    check.arg("check").arg("--board").arg(board).args(DRONE.iter().chain(more).flat_map(|s| ["--set", s]));
    let table = String::from_utf8(check.output().unwrap().stdout).unwrap();
    let total = table.lines().find(|l| l.contains("gpu  total")).unwrap();
    total.split_whitespace().next().unwrap().parse().unwrap()
}

#[test]
fn a_hundred_thousand_gaussians_take_at_most_128_mib_of_the_gpu() {
    let grey = gpu_bytes(&[]);
    assert!(grey <= 128 << 20, "{grey} B");
    assert!(gpu_bytes(&["map.colour=true"]) > grey, "colour is counted");
}
