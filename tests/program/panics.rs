//! A thread of a run that panics because `--inject` asks for it, and what the run leaves behind.

use super::start::{stipple, text};
use std::fs;
use std::io::{BufRead, BufReader};
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::Child;
use std::time::Instant;
use stipple_drivers::{host, Nanos};

/// Arguments of a run whose `thread` panics `at_s` seconds after it started; the rule is written to `rules`.
pub fn panic_after(thread: &str, at_s: f64, rules: &Path) -> [String; 2] {
    fs::write(rules, format!("[[thread]]\nname = \"{thread}\"\npanic_s = {at_s}\n")).unwrap();
    ["--inject".into(), rules.to_str().unwrap().into()]
}

/// What became of a run one of whose threads panicked.
pub struct Panicked {
    /// From the line about it until the thread's process had ended, s.
    pub end_s: f64,
    /// From the last frame of the log before the panic to the panic, s.
    pub lost_s: f64,
}

impl Panicked {
    /// Waits for the end of a run, whose stderr is piped, and judges what it said and logged in `out`. A run `flies_on` where
    /// the thread is the mapper's.
    pub fn judge(mut run: Child, thread: &str, flies_on: bool, out: &Path) -> Panicked {
        let (mut said, mut at, mut ended) = (String::new(), None, None);
        // Both processes have ended when nobody can write any more.
        for line in BufReader::new(run.stderr.take().unwrap()).lines().map(Result::unwrap) {
            if line.contains(" panicked at ") {
                at = Some((Instant::now(), host::monotonic()));
            } else if line.contains("was ended by signal 6") {
                ended = Some(Instant::now());
            }
            said += &(line + "\n");
        }
        let (status, ended) = (run.wait().unwrap(), ended.unwrap_or_else(Instant::now));
        let (began, at) = at.unwrap_or_else(|| panic!("{thread}: no panic: {said}"));
        assert!(
            said.matches(" panicked at ").count() == 1 && said.contains(&format!("thread {thread} panicked")),
            "{said}"
        );
        assert_eq!(status.signal(), (!flies_on).then_some(6), "{thread}: {said}");
        assert!(!flies_on || status.success(), "{thread}: {said}");
        let logs = fs::read_dir(out).unwrap().map(|e| e.unwrap().path());
        let log = fs::read(logs.filter(|p| p.extension().is_some_and(|e| e == "mcap")).max().unwrap()).unwrap();
        let messages = mcap::MessageStream::new_with_options(&log, mcap::read::Options::IgnoreEndMagic.into()).unwrap();
        let frames = messages.map_while(Result::ok).filter(|m| m.channel.topic == "/state").map(|m| m.log_time as i64);
        let last = frames.filter(|t| *t <= at.0).max().unwrap_or_else(|| panic!("{thread}: no frame: {said}"));
        let o = stipple().args(["recover", out.to_str().unwrap()]).output().unwrap();
        // Who writes the log cannot write of its own end.
        let told = flies_on || thread == "log" || text(&o).contains(&format!("thread {thread} panicked"));
        assert!(o.status.success() && told, "{}", text(&o));
        Panicked { end_s: (ended - began).as_secs_f64(), lost_s: (at - Nanos(last)).secs() }
    }
}
