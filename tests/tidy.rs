//! The rules of the architecture that a compiler does not check: who may see whom, where `unsafe`
//! and `unwrap` may stand, how long a file may get, and that each says what it is.
#![allow(clippy::unwrap_used)]

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Modules everybody may see.
const COMMON: [&str; 5] = ["math", "mem", "limits", "config", "counters"];
/// What else a module may see. `run` sees all of these, `commands` sees `run` too, nobody sees `commands`; a module that is
/// not here sees only the common ones.
const EDGES: [(&str, &[&str]); 7] = [
    ("vio", &["frontend"]),
    ("loops", &["vio"]),
    ("stereo", &["gpu"]),
    ("map", &["gpu", "stereo"]),
    ("output", &["map", "vio"]),
    ("run", &["frontend", "vio", "gpu", "stereo", "map", "output"]),
    ("commands", &["run", "frontend", "vio", "gpu", "stereo", "map", "output"]),
];
/// Where `unsafe` may stand: the GPU, the allocator, the shims of OpenCV and ONNX Runtime, system calls of drivers.
const UNSAFE: [&str; 5] =
    ["src/gpu/", "src/mem.rs", "src/stereo/opencv.rs", "src/stereo/onnx/runtime.rs", "drivers/src/"];
const RUST_LINES_MAX: usize = 600;
const KERNEL_LINES_MAX: usize = 250;
/// Lines between a safety comment and the end of what it explains.
const SAFETY_REACH: usize = 5;

struct File {
    /// From the root of the repository, with forward slashes.
    path: String,
    text: String,
}

impl File {
    fn ends_with(&self, extension: &str) -> bool {
        self.path.ends_with(extension)
    }

    fn below(&self, folders: &[&str]) -> bool {
        folders.iter().any(|f| self.path.starts_with(f))
    }
}

/// Every text file of the project.
fn files() -> Vec<File> {
    // Asked at run time, so that one build of this test can look at another checkout.
    let root = std::env::var("CARGO_MANIFEST_DIR").expect("cargo sets it");
    let root = Path::new(&root);
    let mut found = Vec::new();
    let mut folders = vec![root.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path: PathBuf = entry.unwrap().path();
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            let skipped = ["target", "out", ".git", ".gl", ".carry", "shared", "proptest-regressions"];
            if skipped.contains(&name.as_str()) {
                continue;
            }
            if path.is_dir() {
                folders.push(path);
            } else if let Ok(text) = std::fs::read_to_string(&path) {
                let relative = path.strip_prefix(root).unwrap().to_string_lossy().replace('\\', "/");
                found.push(File { path: relative, text });
            }
        }
    }
    found.sort_by(|a, b| a.path.cmp(&b.path));
    assert!(found.iter().any(|f| f.path == "src/lib.rs"), "the walk finds the sources");
    found
}

/// Source text with comments and the insides of strings blanked, line by line as it was.
fn code(text: &str) -> String {
    let bytes = text.as_bytes();
    let mut out = bytes.to_vec();
    let mut i = 0;
    while i < bytes.len() {
        let end = token_end(bytes, i);
        if end > i {
            out[i..end].iter_mut().filter(|b| **b != b'\n').for_each(|b| *b = b' ');
            i = end;
        } else {
            i += 1;
        }
    }
    String::from_utf8_lossy(&out).into_owned()
}

/// Where the comment, string or character that starts at `i` ends; `i` when none starts there.
fn token_end(bytes: &[u8], i: usize) -> usize {
    let rest = &bytes[i..];
    let until = |from: usize, close: &[u8]| {
        let found = rest[from..].windows(close.len()).position(|w| w == close);
        found.map_or(bytes.len(), |at| i + from + at + close.len())
    };
    let in_word = i > 0 && (bytes[i - 1].is_ascii_alphanumeric() || bytes[i - 1] == b'_');
    match rest {
        [b'/', b'/', ..] => until(2, b"\n") - 1,
        [b'/', b'*', ..] => until(2, b"*/"),
        [b'r', b'"', ..] if !in_word => until(2, b"\""),
        [b'r', b'#', ..] if !in_word && rest[1..].iter().find(|b| **b != b'#') == Some(&b'"') => {
            let hashes = rest[1..].iter().take_while(|b| **b == b'#').count();
            let close: Vec<u8> = std::iter::once(b'"').chain(std::iter::repeat_n(b'#', hashes)).collect();
            until(hashes + 2, &close)
        }
        [b'"', ..] => quoted_end(bytes, i),
        // A character, not a lifetime.
        [b'\'', b'\\', _, ..] => until(3, b"'"),
        [b'\'', first, ..] => {
            let width = if *first < 0x80 { 1 } else { first.leading_ones() as usize };
            if rest.get(1 + width) == Some(&b'\'') {
                i + 2 + width
            } else {
                i
            }
        }
        _ => i,
    }
}

fn quoted_end(bytes: &[u8], start: usize) -> usize {
    let mut i = start + 1;
    while i < bytes.len() && bytes[i] != b'"' {
        i += if bytes[i] == b'\\' { 2 } else { 1 };
    }
    (i + 1).min(bytes.len())
}

/// Code with everything under `#[cfg(test)]` blanked too.
fn shipped_code(text: &str) -> String {
    let mut code = code(text);
    while let Some(start) = code.find("#[cfg(test)]") {
        let rest = &code[start..];
        let semicolon = rest.find(';').unwrap_or(rest.len());
        let end = match rest.find('{') {
            Some(open) if open < semicolon => closing(rest, open),
            _ => (semicolon + 1).min(rest.len()),
        };
        let blank: String = rest[..end].chars().map(|c| if c == '\n' { '\n' } else { ' ' }).collect();
        code.replace_range(start..start + end, &blank);
    }
    code
}

/// After the brace that closes the one at `open`.
fn closing(code: &str, open: usize) -> usize {
    let mut depth = 0;
    for (i, c) in code[open..].char_indices() {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            _ => {}
        }
        if depth == 0 {
            return open + i + 1;
        }
    }
    code.len()
}

/// Files that hold only tests: named by `#[cfg(test)] mod name;` beside them, or saying so themselves.
fn is_test_file(file: &File, all: &[File]) -> bool {
    let Some((folder, name)) = file.path.rsplit_once('/') else { return false };
    let declared = format!("mod {};", name.trim_end_matches(".rs"));
    let parents = [format!("{folder}/mod.rs"), format!("{folder}/lib.rs"), format!("{folder}.rs")];
    let declares = |f: &&File| f.path != file.path && parents.contains(&f.path);
    let hidden = |f: &File| code(&f.text).contains(&declared) && !shipped_code(&f.text).contains(&declared);
    file.text.contains("#![cfg(test)]") || all.iter().filter(declares).any(hidden)
}

/// Names that follow `crate::`, those inside `use crate::{..}` included.
fn modules_seen(code: &str) -> BTreeSet<String> {
    let mut seen = BTreeSet::new();
    for (at, _) in code.match_indices("crate::") {
        if code[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_' || c == ':' || c == '$') {
            continue;
        }
        let rest = &code[at + "crate::".len()..];
        if !rest.starts_with('{') {
            seen.insert(word(rest));
            continue;
        }
        let list = &rest[1..closing(rest, 0) - 1];
        let mut depth = 0;
        let mut starts = true;
        for (i, c) in list.char_indices() {
            if starts && depth == 0 && !c.is_whitespace() {
                seen.insert(word(&list[i..]));
                starts = false;
            }
            match c {
                '{' => depth += 1,
                '}' => depth -= 1,
                ',' if depth == 0 => starts = true,
                _ => {}
            }
        }
    }
    seen
}

fn word(text: &str) -> String {
    text.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect()
}

fn line_of(text: &str, byte: usize) -> usize {
    1 + text[..byte].matches('\n').count()
}

#[track_caller]
fn none(offences: Vec<String>) {
    assert!(offences.is_empty(), "\n{}", offences.join("\n"));
}

#[test]
fn modules_see_only_what_the_architecture_allows() {
    let all = files();
    let mut offences = Vec::new();
    for file in all.iter().filter(|f| f.path.starts_with("src/") && f.ends_with(".rs")) {
        let inside = file.path.trim_start_matches("src/").trim_end_matches(".rs");
        let module = inside.split('/').next().unwrap();
        if ["main", "lib"].contains(&module) || is_test_file(file, &all) {
            continue;
        }
        let code = shipped_code(&file.text);
        let more = EDGES.iter().find(|(from, _)| *from == module).map_or(&[][..], |(_, to)| to);
        for seen in modules_seen(&code) {
            let known =
                all.iter().any(|f| f.path.starts_with(&format!("src/{seen}/")) || f.path == format!("src/{seen}.rs"));
            let allowed = seen == module || COMMON.contains(&seen.as_str()) || more.contains(&seen.as_str());
            if known && !allowed {
                offences.push(format!("{}: `{module}` sees `{seen}`", file.path));
            }
        }
        if code.contains("super::super::super::") {
            offences.push(format!("{}: climbs out of its module with super::", file.path));
        }
    }
    none(offences);
}

#[test]
fn nothing_shipped_unwraps() {
    let all = files();
    let mut offences = Vec::new();
    for file in all.iter().filter(|f| f.below(&["src/", "drivers/src/"]) && f.ends_with(".rs")) {
        let code = shipped_code(&file.text);
        let test_only = is_test_file(file, &all);
        for (at, _) in code.match_indices(".unwrap()").filter(|_| !test_only) {
            offences.push(format!("{}:{}: unwrap", file.path, line_of(&code, at)));
        }
    }
    none(offences);
}

#[test]
fn unsafe_stands_where_it_may_and_says_why_it_holds() {
    let mut offences = Vec::new();
    for file in files().iter().filter(|f| f.ends_with(".rs") && !f.below(&["tests/"])) {
        let code = code(&file.text);
        let lines: Vec<&str> = file.text.lines().collect();
        for (at, _) in code.match_indices("unsafe ") {
            let line = line_of(&code, at);
            if !file.below(&UNSAFE) {
                offences.push(format!("{}:{line}: unsafe is not allowed here", file.path));
            }
            // The signature of an `unsafe fn`, or the type of one, promises nothing; the blocks inside it do.
            let written = code.lines().nth(line - 1).unwrap();
            let claims = !written.contains(" fn ") && !written.contains(" fn(");
            let above = &lines[line.saturating_sub(SAFETY_REACH + 1)..line];
            if claims && !above.iter().any(|l| l.contains("SAFETY:")) {
                offences.push(format!("{}:{line}: unsafe without a SAFETY comment", file.path));
            }
        }
    }
    none(offences);
}

#[test]
fn files_are_short_and_open_with_what_they_are() {
    let mut offences = Vec::new();
    for file in files() {
        let lines = file.text.lines().count();
        let header = match file.path.rsplit('.').next() {
            Some("rs") => Some(("//!", RUST_LINES_MAX)),
            Some("comp") => Some(("//", KERNEL_LINES_MAX)),
            Some("glsl" | "cpp") => Some(("//", RUST_LINES_MAX)),
            _ => None,
        };
        let Some((opening, lines_max)) = header else { continue };
        let first = file.text.lines().find(|l| !l.trim().is_empty() && !l.starts_with('#')).unwrap_or("");
        if !first.starts_with(opening) {
            offences.push(format!("{}: does not open with `{opening}` and what it is", file.path));
        }
        if lines >= lines_max {
            offences.push(format!("{}: {lines} lines, fewer than {lines_max} are allowed", file.path));
        }
    }
    none(offences);
}

#[test]
fn nothing_is_left_for_later_and_no_machine_is_named() {
    let unfinished = [
        concat!("TO", "DO"),
        concat!("FIX", "ME"),
        concat!("to", "do!("),
        concat!("unimple", "mented!("),
        concat!("db", "g!("),
    ];
    let machine = [
        concat!("/ho", "me/"),
        concat!("/ro", "ot/"),
        concat!("/Us", "ers/"),
        concat!("/wo", "rk/"),
        concat!("/tm", "p/"),
    ];
    let mut offences = Vec::new();
    for file in files() {
        for (number, line) in file.text.lines().enumerate() {
            for word in unfinished.iter().filter(|w| line.contains(**w)) {
                offences.push(format!("{}:{}: `{word}`", file.path, number + 1));
            }
            for path in machine.iter().filter(|p| names_path(line, p)) {
                offences.push(format!("{}:{}: path of one machine `{path}`", file.path, number + 1));
            }
        }
    }
    none(offences);
}

/// Whether an absolute path begins with `prefix`; where it stands within a relative one it does not count.
fn names_path(line: &str, prefix: &str) -> bool {
    line.match_indices(prefix).any(|(at, _)| !line[..at].ends_with(|c: char| c.is_alphanumeric() || "._-}".contains(c)))
}

#[test]
fn every_dependency_has_its_reason() {
    let mut offences = Vec::new();
    for file in files().iter().filter(|f| f.path.ends_with("Cargo.toml")) {
        let mut in_dependencies = false;
        for (number, line) in file.text.lines().enumerate() {
            if let Some(section) = line.strip_prefix('[') {
                in_dependencies = section.contains("dependencies");
            } else if in_dependencies && line.contains('=') && !line.contains(" # ") {
                offences.push(format!("{}:{}: no reason given: {line}", file.path, number + 1));
            }
        }
    }
    none(offences);
}

#[test]
fn the_reader_of_code_is_not_fooled() {
    let text = "let a = \"crate::gpu\"; // crate::map\nlet b = r#\"x\" crate::vio\"#; let c = '\"'; use crate::{mem, math::{so3, se3}, limits};\n\
        fn f<'a>(x: &'a str) { crate::config::g() } /* .unwrap() */\n#[cfg(test)]\nmod tests { use crate::output; }\nfn h() {}\n";
    let seen: Vec<String> = modules_seen(&shipped_code(text)).into_iter().collect();
    assert_eq!(seen, ["config", "limits", "math", "mem"]);
    assert!(shipped_code(text).contains("fn h()") && !code(text).contains("unwrap"));
    assert_eq!(shipped_code(text).lines().count(), text.lines().count());
    assert!(names_path(concat!("see /ho", "me/x"), concat!("/ho", "me/")));
    assert!(!names_path(concat!("see ../wo", "rk/x"), concat!("/wo", "rk/")));
}
