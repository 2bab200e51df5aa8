//! What may happen to `stipple run` in the field, with the map on: its mapper dies, hangs or is stopped, a thread panics, it
//! is asked to stop in every way, and nobody reads what it says. Odometry goes on, or the process ends at once and the
//! next one starts.

use crate::panics::{panic_after, Panicked};
use crate::start::{children, flight, kill, shared_library, signal, stipple, text, BOARD};
use serde_json::Value;
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(30);

/// A run with a map, whose output is kept. Where tests run under `nohup`, it does not inherit that SIGHUP is ignored.
fn run(dataset: &Path, out: &Path) -> Command {
    run_by(&["--default-signal=HUP"], dataset, out)
}

/// The run, started by `env` with these arguments.
fn run_by(env: &[&str], dataset: &Path, out: &Path) -> Command {
    let mut command = Command::new("env");
    command.current_dir(env!("CARGO_MANIFEST_DIR")).args(env).arg(env!("CARGO_BIN_EXE_stipple"));
    let (dataset, out) = (dataset.to_str().unwrap(), out.to_str().unwrap());
    command.args(["run", "--board", BOARD, "--dataset", dataset, "--out", out, "--set", "map.scale=4"]);
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn report(out: &Path) -> Value {
    serde_json::from_slice(&fs::read(out.join("report.json")).unwrap()).unwrap()
}

/// Waits for the answer of `look`.
fn wait_for<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let begun = Instant::now();
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(begun.elapsed() < PATIENCE, "waited for {what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// The mapper of a run, once it maps: its kernels hold buffers.
fn worker(run: &Child) -> u32 {
    wait_for("a mapper", || children(run.id()).first().copied())
}

/// Libraries and devices that a process has mapped.
fn maps(pid: u32) -> String {
    fs::read_to_string(format!("/proc/{pid}/maps")).unwrap()
}

fn folder() -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    (dir, out)
}

#[test]
fn the_process_that_flies_loads_no_driver_and_outlives_a_mapper_that_is_killed_or_stopped() {
    for how in ["KILL", "STOP"] {
        let (dir, out) = folder();
        let data = flight(dir.path(), "8");
        let child = run(&data, &out).spawn().unwrap();
        let first = worker(&child);
        std::thread::sleep(Duration::from_secs(3));
        let flying = maps(child.id());
        for library in ["libvulkan", "libLLVM", "libopencv", "stipple_opencv"] {
            assert!(!flying.contains(library), "{library} is loaded by the process that flies");
        }
        assert!(maps(first).contains("libvulkan"));
        kill(first, how);
        let begun = Instant::now();
        let second = wait_for("another mapper", || children(child.id()).into_iter().find(|pid| *pid != first));
        assert!(begun.elapsed() < Duration::from_secs(2), "{how} noticed after {:?}", begun.elapsed());
        assert_ne!(first, second);
        let o = child.wait_with_output().unwrap();
        let (r, said) = (report(&out), text(&o));
        assert!(o.status.success() && out.join("map.ply").exists(), "{said}");
        assert_eq!((&r["count_map_restarts"], &r["heap_after_seal"]), (&1.into(), &0.into()), "{said}");
        // The driver and its compiler are resident in the mapper's process alone.
        assert!(r["map_rss_peak_bytes"].as_u64().unwrap() > 50 << 20, "{said}");
        assert!(r["ate_rmse_m"].as_f64().unwrap() < 0.02 && r["splats"].as_u64().unwrap() > 500, "{said}");
        assert!(said.contains("starts again") && said.contains("on disk"), "{said}");
        assert!(r["count_frames_overwritten"].as_u64().unwrap_or(0) <= 1, "{said}");
    }
}

#[test]
fn a_mapper_that_cannot_start_is_said_at_once() {
    let (dir, out) = folder();
    let data = flight(dir.path(), "1");
    let o = run(&data, &out).env("VK_DRIVER_FILES", "/dev/null").output().unwrap();
    assert_eq!(o.status.code(), Some(69), "{}", text(&o));
    assert!(text(&o).contains("ulkan"), "{}", text(&o));
}

#[test]
fn a_folder_belongs_to_one_run_at_a_time() {
    let (dir, out) = folder();
    let data = flight(dir.path(), "4");
    let first = run(&data, &out).spawn().unwrap();
    worker(&first);
    for args in [
        vec!["recover", out.to_str().unwrap()],
        vec!["run", "--dataset", data.to_str().unwrap(), "--out", out.to_str().unwrap()],
    ] {
        let o = stipple().args(&args).output().unwrap();
        assert!(o.status.code() == Some(73) && text(&o).contains("another run"), "{args:?}: {}", text(&o));
    }
    assert!(first.wait_with_output().unwrap().status.success());
}

/// The folder is gone when the run ends: every file is tried, figures are printed, and the exit code says so.
#[test]
fn a_run_whose_results_cannot_be_written_still_prints_its_figures() {
    let (dir, out) = folder();
    let data = flight(dir.path(), "4");
    let child = run(&data, &out).spawn().unwrap();
    worker(&child);
    std::thread::sleep(Duration::from_secs(2));
    fs::remove_dir_all(&out).unwrap();
    let o = child.wait_with_output().unwrap();
    let said = text(&o);
    assert_eq!(o.status.code(), Some(73), "{said}");
    assert!(
        said.contains("odometry    ") && said.contains("trajectory.tum") && said.contains("stipple recover"),
        "{said}"
    );
}

#[test]
fn a_worker_by_hand_says_who_starts_it() {
    let o = stipple().arg("map-worker").stdin(Stdio::null()).output().unwrap();
    assert!(o.status.code() == Some(64) && text(&o).contains("stipple run"), "{}", text(&o));
}

#[test]
fn every_way_to_ask_for_a_stop_writes_the_files_and_a_second_one_ends_at_once() {
    let dir = tempfile::tempdir().unwrap();
    let data = flight(dir.path(), "20");
    for name in ["TERM", "HUP"] {
        let out = dir.path().join(name);
        let child = run(&data, &out).spawn().unwrap();
        worker(&child);
        std::thread::sleep(Duration::from_secs(3));
        signal(&child, name);
        let o = child.wait_with_output().unwrap();
        assert!(o.status.success() && out.join("map.ply").exists(), "{name}: {}", text(&o));
        assert!((10..200).contains(&report(&out)["frames"].as_u64().unwrap()));
    }
    // As `nohup` starts it.
    let out = dir.path().join("nohup");
    let child = run_by(&["--ignore-signal=HUP"], &data, &out).spawn().unwrap();
    worker(&child);
    signal(&child, "HUP");
    std::thread::sleep(Duration::from_secs(3));
    signal(&child, "TERM");
    let o = child.wait_with_output().unwrap();
    // One that the signal had ended would have seen hardly any.
    assert!(o.status.success() && report(&out)["frames"].as_u64().unwrap() >= 10, "{}", text(&o));
    let mut child = run(&data, &dir.path().join("twice")).spawn().unwrap();
    let mapper = worker(&child);
    std::thread::sleep(Duration::from_secs(2));
    // A mapper that cannot answer holds the end up, as far as evaluation may.
    signal(&child, "INT");
    signal(&child, "TERM");
    let begun = Instant::now();
    let status = child.wait().unwrap();
    assert!(begun.elapsed() < Duration::from_secs(1));
    assert!(matches!(status.signal(), Some(2 | 15)), "ended by whichever came second: {status:?}");
    wait_for("the mapper to end with it", || has_ended(mapper));
}

/// Whether a process has ended, reaped or not.
fn has_ended(pid: u32) -> Option<()> {
    fs::read_to_string(format!("/proc/{pid}/stat")).map_or(true, |s| s.contains(") Z")).then_some(())
}

#[test]
fn nobody_needs_to_read_what_a_run_says() {
    let (dir, out) = folder();
    let data = flight(dir.path(), "4");
    // Full from the start, and read by nobody until the run is over.
    let mut child = run(&data, &out);
    let (mut reader, writer) = UnixStream::pair().unwrap();
    let mut filler = writer.try_clone().unwrap();
    // Blocks when it is full; the rest goes when it is read.
    let filled = std::thread::spawn(move || drop(filler.write_all(&vec![b'.'; 1 << 22])));
    std::thread::sleep(Duration::from_millis(200));
    let begun = Instant::now();
    let status = child.stderr(OwnedFd::from(writer)).stdout(Stdio::null()).status().unwrap();
    assert!(status.success() && begun.elapsed() < PATIENCE, "{status:?} after {:?}", begun.elapsed());
    assert!(report(&out)["count_lines_lost"].as_u64().unwrap() > 0);
    drop(child);
    let mut all = vec![];
    reader.read_to_end(&mut all).unwrap();
    filled.join().unwrap();
}

/// A terminal that is stopped (Ctrl-S, a dead link of ssh): it says that it has room until a line is in it, and takes no more.
#[test]
fn a_terminal_that_takes_no_more_holds_up_nothing() {
    let (dir, out) = folder();
    let data = flight(dir.path(), "20");
    let words = run(&data, &out);
    let line: Vec<_> =
        std::iter::once(words.get_program()).chain(words.get_args()).map(|w| w.to_str().unwrap()).collect();
    // Its own output is a pipe that nobody reads, after which it reads no more of the terminal.
    let mut terminal = Command::new("script")
        .args(["-qec", &line.join(" "), "/dev/null"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .env("TERM", "xterm")
        .spawn()
        .unwrap();
    let run = wait_for("a run", || children(terminal.id()).first().copied());
    wait_for("a log", || out.join("log-0000.mcap").exists().then_some(()));
    std::thread::sleep(Duration::from_secs(3));
    kill(terminal.id(), "STOP");
    // The terminal has room for some kilobytes.
    std::thread::sleep(Duration::from_secs(8));
    kill(run, "TERM");
    wait_for("the trajectory", || out.join("trajectory.tum").exists().then_some(()));
    wait_for("the report", || out.join("report.json").exists().then_some(()));
    wait_for("the run's end", || has_ended(run));
    let report = report(&out);
    // The terminal was full, and the run was stopped before its flight was over.
    assert!(report["count_lines_lost"].as_u64().is_some_and(|lost| lost > 0), "{report}");
    assert!(report["frames"].as_u64().unwrap() < 380, "{report}");
    kill(terminal.id(), "CONT");
    terminal.kill().unwrap();
    terminal.wait().unwrap();
}

/// Lets a thread hang from two seconds after it started on, in a run that takes these arguments.
fn hangs(thread: &str, data: &Path, out: &Path) -> Command {
    let rules = out.with_extension("toml");
    fs::write(&rules, format!("[[thread]]\nname = \"{thread}\"\nhang_s = 2.0\n")).unwrap();
    let mut command = run(data, out);
    command.args(["--inject", rules.to_str().unwrap()]);
    command
}

/// A driver that never answers: who asks for a stop does not wait for it, and the log has the trajectory.
#[test]
fn a_thread_that_hangs_does_not_keep_a_run_from_ending() {
    let dir = tempfile::tempdir().unwrap();
    let data = flight(dir.path(), "6");
    let check = |thread: &str| {
        let out = dir.path().join(thread);
        let child = hangs(thread, &data, &out).args(["--set", "map.enabled=false"]).spawn().unwrap();
        wait_for("a log", || out.join("log-0000.mcap").exists().then_some(()));
        std::thread::sleep(Duration::from_secs(4));
        signal(&child, "TERM");
        let begun = Instant::now();
        let o = child.wait_with_output().unwrap();
        let limit_s = if thread == "log" { 34 } else { 7 };
        assert!(begun.elapsed() < Duration::from_secs(limit_s), "after {:?}", begun.elapsed());
        assert!(o.status.code() == Some(70) && text(&o).contains(&format!("thread {thread} hangs")), "{}", text(&o));
        let o = stipple().args(["recover", out.to_str().unwrap()]).output().unwrap();
        assert!(o.status.success() && out.join("trajectory.tum").exists(), "{}", text(&o));
    };
    std::thread::scope(|scope| {
        scope.spawn(|| check("camera"));
        check("log");
    });
}

/// A mapper whose process gives no sign of life is killed and started again.
#[test]
fn a_mapper_that_hangs_is_started_again() {
    let (dir, out) = folder();
    let data = flight(dir.path(), "12");
    let o = hangs("beat", &data, &out).output().unwrap();
    let said = text(&o);
    assert!(
        o.status.success() && said.contains("gave no sign of life for 5 s") && said.contains("maps again"),
        "{said}"
    );
    assert!(report(&out)["count_map_restarts"] == 1 && out.join("map.ply").exists(), "{said}");
}

/// A GPU whose driver was reset: the mapper says so, a new one opens it again, and odometry loses nothing.
#[test]
fn a_gpu_that_is_lost_is_opened_again() {
    let (dir, out) = folder();
    let (data, flag) = (flight(dir.path(), "10"), dir.path().join("lost"));
    let shim = dir.path().join("vulkan/libvulkan.so.1");
    fs::create_dir(dir.path().join("vulkan")).unwrap();
    shared_library("tests/program/lost_gpu.c", &[], &shim);
    let known = Command::new("/sbin/ldconfig").arg("-p").output().unwrap();
    let known = String::from_utf8(known.stdout).unwrap();
    let real =
        known.lines().find(|line| line.trim().starts_with("libvulkan.so.1 ")).unwrap().rsplit_once("=> ").unwrap().1;
    let mut command = run(&data, &out);
    command.envs([("LD_LIBRARY_PATH", shim.parent().unwrap()), ("REAL_VULKAN", Path::new(real)), ("LOST_GPU", &flag)]);
    let mut child = command.stdout(Stdio::null()).spawn().unwrap();
    let mut said = vec![];
    for line in BufReader::new(child.stderr.take().unwrap()).lines().map(Result::unwrap) {
        if line.starts_with("3.") && line.contains(" frames") {
            assert!(!line.contains(" 0 iterations"), "it maps: {line}");
            fs::write(&flag, b"").unwrap();
        }
        said.push(line);
    }
    let (status, said) = (child.wait().unwrap(), said.join("\n"));
    assert!(status.success() && !flag.exists(), "{said}");
    assert!(said.contains("the Vulkan device is lost") && said.contains("the mapper maps again"), "{said}");
    let r = report(&out);
    assert_eq!([&r["count_map_restarts"], &r["count_frames_overwritten"]], [1, 0], "{said}");
    assert!(r["splats"].as_u64().unwrap() > 0 && out.join("map.ply").exists(), "{said}");
}

/// Threads that the program starts in a run of a recording, and what makes a run have them. `trigger` needs cameras.
const THREADS: [(&str, &[&str]); 15] = [
    ("main", &[]),
    ("camera", &[]),
    ("status", &[]),
    ("imu", &[]),
    ("barometer", &["--set", "baro.chip=bmp388"]),
    ("tracking", &["--set", "frontend.threads=1"]),
    ("frontend", &["--set", "frontend.threads=2"]),
    ("estimator", &["--set", "frontend.threads=2"]),
    ("autopilot", &["--set", "mavlink.link=udpout:127.0.0.1:9"]),
    ("log", &[]),
    ("led", &["--set", "gpio.led=fake:3"]),
    ("writer", &["--record"]),
    ("map-answers", &[]),
    ("mapping", &[]),
    ("beat", &[]),
];
/// Those of the mapper's process.
const MAPPERS: [&str; 2] = ["mapping", "beat"];

/// A libgpiod whose lines go nowhere, where a run looks first; both names, so that the machine's is not found.
fn build_gpio(folder: &Path) {
    fs::create_dir(folder).unwrap();
    shared_library("drivers/tests/gpio/fake.c", &["-DVERSION=1"], &folder.join("libgpiod.so.3"));
    fs::copy(folder.join("libgpiod.so.3"), folder.join("libgpiod.so.2")).unwrap();
}

/// Lets a thread of a run panic, so many seconds after it started, and judges what is left in `out`.
fn panicked(pass: usize, (thread, args): (&str, &[&str]), at_s: f64, data: &Path, out: &Path) -> Panicked {
    let (rules, recorded) = (out.with_extension("toml"), out.with_extension(format!("recorded-{pass}")));
    let mut command = run(data, out);
    command.args(panic_after(thread, at_s, &rules)).args(args);
    command.env("LD_LIBRARY_PATH", data.with_file_name("gpio"));
    command.args((thread == "writer").then_some(&recorded));
    let (flies_on, lines) = (MAPPERS.contains(&thread), out.with_extension("lines"));
    command.args((thread != "led").then_some(["--set", "gpio.led=fake:3"]).into_iter().flatten());
    let child = command.stdout(fs::File::create(&lines).unwrap()).spawn().unwrap();
    let left = Panicked::judge(child, thread, flies_on, out);
    // The LED stays on, but for a panic of the thread that sets it.
    let lines = fs::read_to_string(lines).unwrap();
    let last = lines.lines().rfind(|line| line.starts_with("set 3 ")).unwrap();
    assert!(flies_on || thread == "led" || last == "set 3 1", "{thread}: {lines}");
    assert!(!flies_on || report(out)["count_map_restarts"] == 1, "{thread}: one restart");
    left
}

/// A start in a folder where others have panicked.
fn starts_again(data: &Path, out: &Path) {
    let o = run(data, out).output().unwrap();
    assert!(o.status.success() && out.join("report.json").exists(), "the next start: {}", text(&o));
}

/// The process has ended within a second, says who and why in one line, its log is complete to the last second, and the next
/// one starts; the mapper's takes nothing with it.
fn panics_end_the_process_at_once(threads: &[(&str, &[&str])]) {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (flight(dir.path(), "4"), dir.path().join("out"));
    build_gpio(&dir.path().join("gpio"));
    for (pass, thread) in threads.iter().enumerate() {
        let Panicked { end_s, lost_s } = panicked(pass, *thread, 2.5, &data, &out);
        assert!(end_s < 1.0 && lost_s < 1.0, "{}: ended after {end_s} s, lost {lost_s} s", thread.0);
    }
    starts_again(&data, &out);
}

// Each thread takes six seconds, most of which it waits: half of them are run beside the others.
#[test]
fn a_panic_in_any_thread_ends_the_process_at_once() {
    panics_end_the_process_at_once(&THREADS[..THREADS.len() / 2]);
}

#[test]
fn a_panic_in_any_other_thread_ends_the_process_at_once() {
    panics_end_the_process_at_once(&THREADS[THREADS.len() / 2..]);
}

/// `cargo test --release --test program mission::panics -- --ignored --nocapture`: each thread ten times, at moments of its own.
#[test]
#[ignore = "a quarter of an hour, on a machine that does nothing else"]
fn panics_of_each_thread() {
    let dir = tempfile::tempdir().unwrap();
    let data = flight(dir.path(), "8");
    build_gpio(&dir.path().join("gpio"));
    let mut random = 0x2545_f491_4f6c_dd1d_u64;
    println!("| thread | panics | ended within | log ends before the panic by | next start |\n|---|---|---|---|---|");
    for thread in THREADS {
        let (out, mut worst) = (dir.path().join(thread.0), [0.0_f64; 2]);
        for pass in 0..10 {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            let at_s = 2.5 + 4.0 * (random >> 11) as f64 / (1_u64 << 53) as f64;
            let Panicked { end_s, lost_s } = panicked(pass, thread, at_s, &data, &out);
            worst = [worst[0].max(end_s), worst[1].max(lost_s)];
        }
        starts_again(&data, &out);
        println!("| {} | 10 | {:.2} s | {:.2} s | works |", thread.0, worst[0], worst[1]);
        assert!(worst[0] < 1.0 && worst[1] < 1.0, "{}", thread.0);
    }
}

/// The pause before the next start grows with each death; at the end of a run there is a mapper all the same.
#[test]
fn a_mapper_that_pauses_when_a_run_ends_is_started_for_the_map() {
    for dies_again in [false, true] {
        let (dir, out) = folder();
        let data = flight(dir.path(), "8");
        let child = run(&data, &out).spawn().unwrap();
        let mut mapper = worker(&child);
        // A mapper that dies before the flight begins ends the run.
        wait_for("the flight's log", || out.join("log-0000.mcap").exists().then_some(()));
        std::thread::sleep(Duration::from_millis(1500));
        // It pauses for 0, 1, 2 and 4 seconds.
        for died in 1..=4 + usize::from(dies_again) {
            kill(mapper, "KILL");
            wait_for("its end", || has_ended(mapper));
            if died < 4 + usize::from(dies_again) {
                mapper = wait_for("another mapper", || children(child.id()).into_iter().find(|pid| *pid != mapper));
            }
        }
        let o = child.wait_with_output().unwrap();
        let (r, said) = (report(&out), text(&o));
        assert!(o.status.success() && said.contains("starts again in 4 s"), "{said}");
        assert_eq!(r["count_map_restarts"], 4, "{said}");
        assert_eq!(out.join("map.ply").exists(), !dies_again, "{said}");
        assert_eq!(r["splats"].as_u64().unwrap() > 500, !dies_again, "{said}");
        assert_eq!(said.contains("died at the end, though it was started again for the end"), dies_again, "{said}");
    }
}

/// `cargo test --release --test program not_disturbed -- --ignored --nocapture`: passes of MH_01, every other one with its
/// mapper killed (20) or stopped (5) at a random moment. Frames of all passes of a kind are pooled.
#[test]
#[ignore = "ten minutes, on a machine that does nothing else"]
fn tracking_is_not_disturbed_by_a_mapper_that_dies() {
    let recordings = std::env::var_os("STIPPLE_RECORDINGS").map_or("../shared/data".into(), PathBuf::from);
    let data = recordings.join("euroc_MH_01_easy_11s");
    let mut random = 0x9e37_79b9_7f4a_7c15_u64;
    let mut pooled: [(Vec<f64>, Vec<f64>); 2] = Default::default();
    let (mut dropped, mut mapped, mut noticed) = ([0, 0], vec![], vec![]);
    for pass in 0..50 {
        let (disturbed, how) = (pass % 2, if pass < 40 { "KILL" } else { "STOP" });
        let (_dir, out) = folder();
        let child = run(&data, &out).spawn().unwrap();
        let first = worker(&child);
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        if disturbed == 1 {
            // From when the first frames come until a second before the last.
            std::thread::sleep(Duration::from_millis(1500 + random / (u64::MAX / 8500)));
            kill(first, how);
            let begun = Instant::now();
            wait_for("another mapper", || children(child.id()).into_iter().find(|pid| *pid != first));
            noticed.push(begun.elapsed().as_secs_f64());
        }
        let o = child.wait_with_output().unwrap();
        assert!(o.status.success(), "{}", text(&o));
        dropped[disturbed] += report(&out)["frames_dropped"].as_u64().unwrap();
        let log = fs::read(out.join("log-0000.mcap")).unwrap();
        let mut lost_at = None;
        for message in mcap::MessageStream::new(&log).unwrap().map(Result::unwrap) {
            let value: Value = serde_json::from_slice(&message.data).unwrap();
            match message.channel.topic.as_str() {
                "/state" => {
                    pooled[disturbed].0.push(value["latency_ms"].as_f64().unwrap());
                    pooled[disturbed].1.push(value["cpu_ms"].as_f64().unwrap());
                }
                "/event" if value["kind"] == "map" => {
                    let starts = value["text"].as_str().unwrap().contains("maps again");
                    match lost_at {
                        Some(lost) if starts => mapped.push((message.log_time - lost) as f64 * 1e-9),
                        _ => lost_at = Some(message.log_time),
                    }
                }
                _ => {}
            }
        }
    }
    let at = |list: &mut Vec<f64>, share: f64| {
        list.sort_by(f64::total_cmp);
        list[(share * (list.len() - 1) as f64) as usize]
    };
    let [quiet, disturbed] = pooled.each_mut().map(|(ms, cpu)| (at(ms, 0.5), at(cpu, 0.99), ms.len()));
    let most = |list: &[f64]| list.iter().copied().fold(0.0, f64::max);
    println!("| | undisturbed | mapper killed or stopped | ratio |\n|---|---|---|---|");
    println!("| frames; lost | {}; {} | {}; {} | |", quiet.2, dropped[0], disturbed.2, dropped[1]);
    println!("| tracking, median | {:.2} ms | {:.2} ms | {:.3} |", quiet.0, disturbed.0, disturbed.0 / quiet.0);
    println!("| CPU a frame, 99 % | {:.2} ms | {:.2} ms | {:.3} |", quiet.1, disturbed.1, disturbed.1 / quiet.1);
    println!("| noticed after, at most | | {:.2} s of {} | |", most(&noticed), noticed.len());
    println!("| maps again after, at most | | {:.2} s of {} | |", most(&mapped), mapped.len());
    assert!(dropped[1] == 0 && disturbed.0 < 1.05 * quiet.0 && disturbed.1 < 1.15 * quiet.1);
    assert!(most(&noticed) < 2.0 && most(&mapped) < 3.0);
}
