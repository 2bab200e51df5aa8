//! How libgpiod is loaded: each of its versions, built by the test (gpio/fake.c), and none. Lines that work are driven in the
//! virtual machine (tests/hil).
#![allow(clippy::unwrap_used)]

use std::path::Path;
use std::process::Command;
use stipple_drivers::gpio::{DataReady, Edge, LineName, Output};
use stipple_drivers::imu::edges::{EdgeQueue, Edges};
use stipple_drivers::types::Span;

fn line(chip: &str, line: &str) -> LineName {
    LineName { chip: chip.into(), line: line.into() }
}

#[test]
#[ignore = "part of the tests below, in processes that find another libgpiod"]
fn a_program_that_uses_lines() {
    let mut input = match DataReady::open(&line("fake", "ready"), Edge::Rising) {
        Ok(input) => input,
        Err(fault) => return println!("{fault}"),
    };
    let mut queue = EdgeQueue::default();
    input.drain(&mut queue).unwrap();
    queue.stamps().iter().for_each(|t| println!("stamp {}", t.0));
    assert_eq!((input.wait(Span(0)), input.reopen(), queue.refused), (Ok(false), Ok(()), 0));
    drop(input);
    let mut output = Output::open(&line("fake", "5"), true).unwrap();
    output.set(true).unwrap();
    output.set(false).unwrap();
    drop(output);
    println!("{}", Output::open(&line("no-such-chip", "5"), true).map(|_| ()).unwrap_err());
}

/// What the program above prints where the loader looks into `folder` first.
fn said(folder: &Path) -> String {
    let mut program = Command::new(std::env::current_exe().unwrap());
    program.args(["a_program_that_uses_lines", "--exact", "--ignored", "--nocapture"]).env("LD_LIBRARY_PATH", folder);
    let output = program.output().unwrap();
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    said
}

fn build_fake(version: u32, to: &Path) {
    let source = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/gpio/fake.c");
    let mut compiler = Command::new("cc");
    compiler
        .args(["-Wall", "-Werror", "-shared", "-fPIC", "-o"])
        .arg(to)
        .arg(source)
        .arg(format!("-DVERSION={version}"));
    assert!(compiler.status().unwrap().success());
}

/// Files that are no libraries, so that those of the machine are not found either.
fn hide_the_machines(folder: &Path) {
    for name in ["libgpiod.so.3", "libgpiod.so.2"] {
        std::fs::write(folder.join(name), [b'x'; 4096]).unwrap();
    }
}

#[test]
fn either_version_is_loaded_and_asked_for_the_same() {
    // What the versions call a rising edge, an output and a low one.
    let wanted = [
        ["request 3 for stipple: 5 0 0", "request 5 for stipple: 3 4 0"],
        ["request 3 for stipple: 2 2 0", "request 5 for stipple: 3 1 1"],
    ];
    for (version, file) in [(1, "libgpiod.so.2"), (2, "libgpiod.so.3")] {
        let folder = tempfile::tempdir().unwrap();
        hide_the_machines(folder.path());
        build_fake(version, &folder.path().join(file));
        let said = said(folder.path());
        let stamps = |word: &str| -> Vec<String> {
            said.lines().filter_map(|l| l.strip_prefix(word)).map(str::to_string).collect()
        };
        assert_eq!((stamps("stamp "), stamps("stamp ").len()), (stamps("edge "), 2), "{said}");
        let [input, output] = wanted[version as usize - 1];
        assert_eq!((said.matches(input).count(), said.matches(output).count()), (2, 1), "{said}");
        assert!(said.contains("set 5 1\nset 5 0\n"), "{said}");
        let released = if version == 1 { "close 1\n" } else { "nothing held\n" };
        assert!(said.matches(released).count() >= 3, "{said}");
        assert!(said.contains("no-such-chip line 5") && said.contains("gpiodetect"), "{said}");
    }
}

#[test]
fn where_no_version_is_the_fault_names_both_and_what_to_install() {
    let folder = tempfile::tempdir().unwrap();
    hide_the_machines(folder.path());
    let said = said(folder.path());
    for part in ["GPIO fake line ready", "libgpiod.so.3", "libgpiod.so.2", "apt install libgpiod3"] {
        assert!(said.contains(part), "{part}: {said}");
    }
}
