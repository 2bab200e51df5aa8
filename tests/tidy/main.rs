//! The rules of the architecture that a compiler does not check: who may see whom, where `unsafe`, `unwrap` and threads
//! may stand, how long files and functions may get, and what their comments must say.
#![allow(clippy::unwrap_used)]

mod graph;
mod source;

use graph::{paths, Graph};
use source::{closing, code, files, is_test_file, shipped_code};
use std::collections::{BTreeMap, BTreeSet};

/// Modules everybody may see.
const COMMON: [&str; 5] = ["math", "mem", "limits", "config", "counters"];
/// What else a module may see. `run` sees all of these, `commands` sees `run` too, nobody sees `commands`; a module that is
/// not here sees only the common ones.
const EDGES: [(&str, &[&str]); 8] = [
    ("vio", &["frontend"]),
    ("loops", &["frontend", "store"]),
    ("stereo", &["gpu"]),
    ("map", &["gpu", "stereo", "store"]),
    ("output", &["map", "store", "vio"]),
    ("publish", &["vio"]),
    ("run", &["frontend", "vio", "loops", "gpu", "stereo", "store", "map", "output", "publish"]),
    ("commands", &["run", "frontend", "vio", "loops", "gpu", "stereo", "store", "map", "output", "publish"]),
];
/// Where `unsafe` may stand: the GPU, the allocator, the shims of OpenCV and ONNX Runtime, system calls of drivers.
const UNSAFE: [&str; 5] =
    ["src/gpu/", "src/mem.rs", "src/stereo/opencv.rs", "src/stereo/onnx/runtime.rs", "drivers/src/"];
/// Where threads and processes may start: those of a flight, the recorder's writer, the simulator's renderers, the bridge's,
/// the programs that pack a report, those that read headers ahead as a store opens, those that compile kernels.
const SPAWNS: [&str; 8] = [
    "src/bridge/src/main.rs",
    "src/commands/bugreport.rs",
    "src/gpu/kernel.rs",
    "src/run/mod.rs",
    "src/run/worker.rs",
    "src/store/scan.rs",
    "drivers/src/record/mod.rs",
    "drivers/src/sim/",
];
/// A package apart, which sees nothing of the crate whose sources are around it, nor that of it.
const APART: [&str; 1] = ["src/bridge/"];
const RUST_LINES_MAX: usize = 600;
const FUNCTION_LINES_MAX: usize = 90;
const KERNEL_LINES_MAX: usize = 250;
/// Lines of code that the product may have, and its estimator, frontend, mapper, GPU core, stereo and kernels together.
const CODE_MAX: usize = 52_400;
const CORE_MAX: usize = 20_100;
const CORE: [&str; 10] = [
    "src/vio/",
    "src/frontend/",
    "src/map/",
    "src/gpu/",
    "src/stereo/",
    "shaders-glsl/splat/",
    "shaders-glsl/stereo/",
    "shaders-glsl/scan/",
    "shaders-glsl/common/",
    "shaders-glsl/selftest/",
];
/// Lines between a safety comment and the end of what it explains.
const SAFETY_REACH: usize = 5;

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
    for file in all.iter().filter(|f| f.path.starts_with("src/") && f.ends_with(".rs") && !f.below(&APART)) {
        let inside = file.path.trim_start_matches("src/").trim_end_matches(".rs");
        let module = inside.split('/').next().unwrap();
        if ["main", "lib"].contains(&module) || is_test_file(file, &all) {
            continue;
        }
        let code = shipped_code(&file.text);
        let more = EDGES.iter().find(|(from, _)| *from == module).map_or(&[][..], |(_, to)| to);
        for seen in paths(&code).into_iter().filter(|p| p[0] == "crate").map(|p| p[1].clone()).collect::<BTreeSet<_>>()
        {
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
fn no_two_files_see_each_other() {
    let (apart, all): (Vec<_>, Vec<_>) = files().into_iter().partition(|f| f.below(&APART));
    let circles = [Graph::of("src/", &all), Graph::of("drivers/src/", &all), Graph::of("src/bridge/src/", &apart)];
    none(circles.iter().flat_map(Graph::circles).collect());
}

#[test]
fn threads_start_where_they_may() {
    let all = files();
    let mut offences = Vec::new();
    for file in all.iter().filter(|f| f.below(&["src/", "drivers/src/"]) && f.ends_with(".rs")) {
        if file.below(&SPAWNS) || is_test_file(file, &all) {
            continue;
        }
        let code = shipped_code(&file.text);
        for call in ["thread::spawn(", ".spawn(", ".spawn_scoped("] {
            for (at, _) in code.match_indices(call) {
                offences.push(format!("{}:{}: starts a thread", file.path, line_of(&code, at)));
            }
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
fn functions_are_short() {
    let mut offences = Vec::new();
    for file in files().iter().filter(|f| f.below(&["src/", "drivers/src/"]) && f.ends_with(".rs")) {
        let code = shipped_code(&file.text);
        for (at, _) in code.match_indices("fn ") {
            let head = &code[at..];
            let body = head.find('{').filter(|open| head.find(';').is_none_or(|end| *open < end));
            let lines = body.map_or(0, |open| head[..closing(head, open)].lines().count());
            if lines > FUNCTION_LINES_MAX {
                let line = line_of(&code, at);
                offences.push(format!("{}:{line}: {lines} lines, {FUNCTION_LINES_MAX} are allowed", file.path));
            }
        }
    }
    none(offences);
}

/// Prints the lines of code by room: without tests, comments and blank lines (`cargo test --test tidy lines -- --nocapture`).
#[test]
fn the_product_has_few_lines() {
    let all = files();
    let mut rooms: BTreeMap<String, usize> = BTreeMap::new();
    for file in all.iter().filter(|f| f.below(&["src/", "drivers/src/", "shaders-glsl/"])) {
        let is_code = ["rs", "comp", "glsl", "cpp", "css"].iter().any(|e| file.ends_with(&format!(".{e}")));
        if !is_code || is_test_file(file, &all) || file.below(&APART) {
            continue;
        }
        let lines = shipped_code(&file.text).lines().filter(|l| !l.trim().is_empty()).count();
        let depth = if file.path.starts_with("drivers/") { 3 } else { 2 };
        let parts: Vec<&str> = file.path.split('/').collect();
        let room = if parts.len() > depth { format!("{}/", parts[..depth].join("/")) } else { file.path.clone() };
        *rooms.entry(room).or_default() += lines;
    }
    rooms.iter().for_each(|(room, lines)| println!("{lines:6}  {room}"));
    let total: usize = rooms.values().sum();
    let core: usize = rooms.iter().filter(|(room, _)| CORE.contains(&room.as_str())).map(|(_, lines)| lines).sum();
    println!("{total:6}  in all; {core} of estimator, frontend, mapper, GPU, stereo and kernels");
    assert!(total <= CODE_MAX && core <= CORE_MAX, "{total} of {CODE_MAX}, {core} of {CORE_MAX}");
}

#[test]
fn doc_comments_begin_with_a_noun_or_a_verb() {
    let mut offences = Vec::new();
    for file in files().iter().filter(|f| f.ends_with(".rs") && f.below(&["src/", "drivers/", "tests/bench/"])) {
        let mut before = "";
        for (number, line) in file.text.lines().enumerate() {
            let line = line.trim();
            let opens = ["///", "//!"].iter().any(|doc| line.starts_with(doc) && !before.starts_with(doc));
            let first = line.trim_start_matches(['/', '!']).split_whitespace().next().unwrap_or("");
            if opens && ["Of", "As", "And", "Likewise"].contains(&first) {
                offences.push(format!("{}:{}: begins with `{first}`: {line}", file.path, number + 1));
            }
            before = line;
        }
    }
    none(offences);
}

/// Whether a doc comment names a unit.
fn names_a_unit(doc: &str) -> bool {
    const UNITS: [&str; 28] = [
        "s", "ms", "us", "µs", "ns", "m", "mm", "m/s", "m/s²", "rad", "rad/s", "rad²", "px", "Hz", "dB", "1/m",
        "bytes", "MiB", "°C", "degrees", "grey", "percent", "fraction", "seconds", "metres", "radians", "pixels",
        "ratio",
    ];
    doc.split(|c: char| c.is_whitespace() || ",.;:()[]|".contains(c)).any(|word| UNITS.contains(&word))
        || doc.contains("unit")
}

/// Public items of the sensors' crate and of the estimator are documented: numbers with their unit, results with their error.
/// The comment on an item or a struct goes for what follows without an empty line; a plain `new` is documented by its type.
#[test]
fn public_items_say_what_they_are() {
    const SUFFIXES: [&str; 14] =
        ["_s", "_ms", "_us", "_ns", "_hz", "_px", "_m", "_g", "_dps", "_db", "_c", "_rad", "_secs", "_bytes"];
    let all = files();
    let mut offences = Vec::new();
    for file in all.iter().filter(|f| f.below(&["drivers/src/", "src/vio/"]) && f.ends_with(".rs")) {
        if is_test_file(file, &all) {
            continue;
        }
        let code = shipped_code(&file.text);
        let (mut doc, mut group) = (String::new(), String::new());
        for (number, (line, code)) in file.text.lines().zip(code.lines()).enumerate() {
            let (line, code) = (line.trim(), code.trim());
            if let Some(text) = line.strip_prefix("///") {
                doc += text;
                doc.push(' ');
            } else if !line.starts_with("#[") {
                let item =
                    code.strip_prefix("pub ").filter(|item| !item.starts_with("use ") && !item.starts_with("mod "));
                let name = item.map(|i| i.split([':', '(', '<', ' ', '=']).next().unwrap_or(""));
                let is_field = item.is_some_and(|i| i.ends_with(',') && i.contains(": "));
                let number_of = item.is_some_and(|i| [": f64", ": f32", ": Option<f64>"].iter().any(|t| i.contains(t)));
                let suffixed = name.is_some_and(|n| n == "BYTES" || SUFFIXES.iter().any(|s| n.ends_with(s)));
                let fallible = item.is_some_and(|i| i.contains("fn ") && i.contains("Fault>"));
                let says_error = ["rror", "fuse", "ail", "ault", "cannot", "refus"].iter().any(|w| doc.contains(w));
                let at = format!("{}:{}", file.path, number + 1);
                if line.is_empty() {
                    group.clear();
                } else if item.is_some() && doc.is_empty() {
                    doc.clone_from(&group);
                } else if item.is_some() {
                    group.clone_from(&doc);
                }
                let is_new = item.is_some_and(|i| i.starts_with("fn new(") && !fallible);
                if item.is_some() && doc.is_empty() && !suffixed && !is_new {
                    offences.push(format!("{at}: no doc comment: {code}"));
                } else if is_field && number_of && !suffixed && !names_a_unit(&doc) {
                    offences.push(format!("{at}: no unit: {code}"));
                } else if fallible && !says_error {
                    offences.push(format!("{at}: no error: {code}"));
                }
                doc.clear();
            }
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
    let seen: BTreeSet<String> = paths(&shipped_code(text)).into_iter().map(|p| p[1].clone()).collect();
    assert_eq!(seen.into_iter().collect::<Vec<_>>(), ["config", "limits", "math", "mem"]);
    assert!(shipped_code(text).contains("fn h()") && !code(text).contains("unwrap"));
    assert_eq!(shipped_code(text).lines().count(), text.lines().count());
    assert!(names_path(concat!("see /ho", "me/x"), concat!("/ho", "me/")));
    assert!(!names_path(concat!("see ../wo", "rk/x"), concat!("/wo", "rk/")));
}
