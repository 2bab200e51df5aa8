//! `stipple bugreport`: what helps to find a fault, in one file that can be sent.

use super::status::{Connection, Place};
use super::BoardArgs;
use crate::run::log::read::newest_files;
use crate::run::status::print_out;
use std::fs::{self, OpenOptions};
use std::io::{self, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{SystemTime, UNIX_EPOCH};
use stipple_drivers::{Fault, FaultKind};

/// Where the service has its board and its results, and where a run has its results that was started without --out.
const SERVICE_BOARD: &str = "/etc/stipple/board.toml";
const RESULTS: [&str; 2] = ["/var/lib/stipple/run", "out/run"];
/// Bytes of logs that are packed, the newest files: one is ten minutes or more. The same of the kernel's messages.
const LOGS_MAX: u64 = 32 << 20;
const KERNEL_MAX: usize = 1 << 20;
const JOURNAL_LINES: &str = "5000";
/// What a machine tells of itself.
const SYSTEM: [&str; 6] =
    ["/proc/version", "/proc/cmdline", "/etc/os-release", "/proc/meminfo", "/proc/cpuinfo", "/proc/device-tree/model"];

#[derive(clap::Args)]
pub struct Args {
    /// Folder of the run's results [default: /var/lib/stipple/run, then out/run]
    dir: Option<PathBuf>,
    #[command(flatten)]
    board: BoardArgs,
    /// File to write [default: stipple-bugreport-SECONDS.tar.gz, in this folder]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// A folder that is removed again.
struct Scratch(PathBuf);

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// What is packed, and what could not be had, with the reason.
struct Parts {
    folder: PathBuf,
    contents: Vec<String>,
}

pub fn bugreport(args: &Args) -> Result<(), Fault> {
    let seconds = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
    let name = format!("stipple-bugreport-{seconds}");
    let out = args.out.clone().unwrap_or_else(|| PathBuf::from(format!("{name}.tar.gz")));
    let cannot =
        |what: String| Fault::new(FaultKind::NoOutput, out.display().to_string(), what, "choose another --out file");
    if out.exists() {
        return Err(cannot("is there already".into()));
    }
    let beside = out.parent().filter(|dir| !dir.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let scratch = Scratch(beside.join(format!(".{name}.partial")));
    let folder = scratch.0.join(&name);
    fs::create_dir_all(&folder).map_err(|e| cannot(format!("cannot be written: {e}")))?;
    let mut parts = Parts { folder, contents: vec![] };
    let board = args.board.board.clone().or_else(|| Some(PathBuf::from(SERVICE_BOARD)).filter(|file| file.exists()));
    let dir = args
        .dir
        .clone()
        .unwrap_or_else(|| PathBuf::from(RESULTS.iter().find(|dir| Path::new(dir).is_dir()).unwrap_or(&RESULTS[1])));
    parts.gather(&dir, board.as_deref(), &args.board);
    let contents = parts.contents.join("\n") + "\n";
    fs::write(parts.folder.join("contents.txt"), &contents).map_err(|e| cannot(format!("cannot be written: {e}")))?;
    // The program is on every Debian.
    let mut tar = Command::new("tar");
    tar.arg("--create").arg("--gzip").arg("--file").arg(&out).arg("--directory").arg(&scratch.0).arg(&name);
    let packed = tar.stdin(Stdio::null()).status().map_err(|e| cannot(format!("tar does not run: {e}")))?;
    if !packed.success() {
        let _ = fs::remove_file(&out);
        return Err(cannot(format!("tar did not write it: {packed}")));
    }
    print_out(contents.trim_end());
    print_out(format!(
        "wrote {}; its log says where the vehicle was, and its board file what it is made of",
        out.display()
    ));
    Ok(())
}

impl Parts {
    /// Notes how a part went.
    fn note(&mut self, name: &str, done: io::Result<u64>) {
        self.contents.push(match done {
            Ok(bytes) => format!("{name}: {bytes} bytes"),
            Err(e) => format!("{name}: left out, {e}"),
        });
    }

    fn text(&mut self, name: &str, text: io::Result<String>) {
        let done = text.and_then(|text| fs::write(self.folder.join(name), &text).map(|()| text.len() as u64));
        self.note(name, done);
    }

    fn copy(&mut self, from: &Path) {
        let name = from.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
        let done = fs::copy(from, self.folder.join(&name));
        self.note(&name, done);
    }

    fn gather(&mut self, dir: &Path, board: Option<&Path>, args: &BoardArgs) {
        let newest = newest_files(dir, LOGS_MAX).unwrap_or_default();
        if newest.is_empty() {
            self.note("log", Err(io::Error::other(format!("{} has none", dir.display()))));
        }
        newest.iter().for_each(|file| self.copy(file));
        for name in ["report.json", "epochs"] {
            if dir.join(name).is_file() {
                self.copy(&dir.join(name));
            }
        }
        if let Some(board) = board {
            self.copy(board);
            let read = BoardArgs { board: Some(board.into()), set: args.set.clone() }.load();
            match read.map(|read| read.rig.calibration) {
                Ok(calibration) if !calibration.is_empty() => {
                    self.copy(&board.parent().unwrap_or(Path::new(".")).join(calibration));
                }
                Ok(_) => {}
                Err(fault) => self.note("calibration", Err(io::Error::other(fault.to_string()))),
            }
        }
        let place = Place::of(dir.join("status").exists().then(|| dir.to_path_buf()));
        let asked = Connection::open(&place).and_then(|mut run| {
            run.ask(r#"{"get":"status"}"#)?;
            run.line()
        });
        self.text("status.json", asked.map_err(|fault| io::Error::other(fault.to_string())));
        let of_machine = SYSTEM.iter().filter_map(|file| Some(format!("{file}\n{}\n", fs::read_to_string(file).ok()?)));
        let system = format!("stipple {}\n\n{}", env!("CARGO_PKG_VERSION"), of_machine.collect::<String>());
        self.text("system.txt", Ok(system));
        self.text("kernel.txt", kernel_messages());
        self.text("journal.txt", journal());
    }
}

/// The kernel's messages, the newest where there are many.
fn kernel_messages() -> io::Result<String> {
    const O_NONBLOCK: i32 = 0o4000;
    let mut kmsg = OpenOptions::new().read(true).custom_flags(O_NONBLOCK).open("/dev/kmsg")?;
    let (mut all, mut record) = (vec![], [0; 8192]);
    loop {
        match kmsg.read(&mut record) {
            Ok(0) => break,
            Ok(count) => all.extend_from_slice(&record[..count]),
            // A message that was overwritten while it was read.
            Err(e) if e.kind() == io::ErrorKind::BrokenPipe => {}
            Err(e) if e.kind() == io::ErrorKind::WouldBlock => break,
            Err(e) => return Err(e),
        }
    }
    let from = all.len().saturating_sub(KERNEL_MAX);
    Ok(String::from_utf8_lossy(&all[from..]).into_owned())
}

/// What the service said.
fn journal() -> io::Result<String> {
    let mut command = Command::new("journalctl");
    command.args(["--unit", "stipple", "--lines", JOURNAL_LINES, "--output", "short-precise", "--no-pager", "--quiet"]);
    let said = command.stdin(Stdio::null()).output()?;
    if !said.status.success() {
        return Err(io::Error::other(String::from_utf8_lossy(&said.stderr).trim().replace('\n', " ")));
    }
    Ok(String::from_utf8_lossy(&said.stdout).into_owned())
}
