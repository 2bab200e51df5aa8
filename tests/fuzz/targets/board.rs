//! Board files, and `--set` (lines after a NUL): parsing answers, and what it takes is within its bounds.
#![no_main]

use libfuzzer_sys::fuzz_target;
use stipple::config::Board;

fuzz_target!(|text: &str| {
    let (file, set) = text.split_once('\0').unwrap_or((text, ""));
    let set: Vec<String> = set.lines().map(str::to_string).collect();
    match Board::parse("fuzz.toml", file, &set) {
        Ok(board) => assert!((16..=1_048_576).contains(&board.memory_max_mib)),
        Err(fault) => assert!(!fault.to_string().contains('\n'), "{fault}"),
    }
});
