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
        let o = Command::new(env!("CARGO_BIN_EXE_stipple")).arg("check").arg(&board).output().unwrap();
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
