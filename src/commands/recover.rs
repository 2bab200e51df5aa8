//! `stipple recover`: the trajectory of a run that left its log and nothing else.

use crate::output::trajectory::TumWriter;
use crate::output::OutputDir;
use crate::publish::event::EventId;
use crate::run::log::read::{runs, write_trajectory, LoggedRun, Message};
use crate::run::status::print_out;
use std::io;
use std::path::{Path, PathBuf};
use stipple_drivers::{Fault, FaultKind, Nanos};

/// Damaged places that are named one by one.
const DAMAGE_LINES: usize = 16;

#[derive(clap::Args)]
pub struct Args {
    /// Folder of the run, as it was given to --out
    dir: PathBuf,
}

/// Writes trajectory.tum of the last run in the folder, and trajectory-log-0000.tum and so on of those before it, named by
/// their first logs.
pub fn recover(args: &Args) -> Result<(), Fault> {
    let place = args.dir.display().to_string();
    let unread = |e: io::Error| {
        Fault::new(FaultKind::NoInput, &place, format!("cannot be read: {e}"), "name the folder of a run")
    };
    let runs = runs(&args.dir).map_err(unread)?;
    let out = OutputDir::create(&args.dir)?;
    let _lock = out.lock()?;
    let mut poses = 0;
    for (i, run) in runs.iter().enumerate() {
        let name = match run.files[0].file_stem() {
            Some(first) if i + 1 < runs.len() => format!("trajectory-{}.tum", first.to_string_lossy()),
            _ => "trajectory.tum".into(),
        };
        poses += recover_run(run, &out, &name)?;
    }
    if poses == 0 {
        let what = format!("has {} logs of runs, and none with a pose", runs.len());
        return Err(Fault::new(FaultKind::Data, place, what, "name the folder of a run that got as far as odometry"));
    }
    Ok(())
}

/// Writes the trajectory of one run as `name`, prints what the log tells, and answers its poses.
fn recover_run(run: &LoggedRun, out: &OutputDir, name: &str) -> Result<u64, Fault> {
    let (mut frames, mut poses, mut events, mut end) = (0u64, 0u64, vec![], None);
    let (mut begun, mut span): (Option<Nanos>, Option<[Nanos; 2]>) = (None, None);
    let each = |at: Nanos, message: &Message| {
        let begun = *begun.get_or_insert(at);
        match message {
            Message::State(state) => {
                span = Some([span.map_or(Nanos(state.t_ns), |[first, _]| first), Nanos(state.t_ns)]);
                frames += 1;
                poses += u64::from(state.estimate.is_some() && !state.dead_reckoned);
            }
            Message::Event(e) if e.id == EventId::End => end = Some(e.text.to_string()),
            Message::Event(e) => events.push(format!("{:9.2} s  {}", (at - begun).secs().max(0.0), e.text)),
            Message::Predicted(_)
            | Message::Rig(_)
            | Message::MapFromOdom(_)
            | Message::Counters(_)
            | Message::Clocks(_) => {}
        }
    };
    let newest = run.files.iter().rev().find_map(|path| modified(path));
    let path = out.file(name);
    // A run that came to its end wrote it after its log, maybe with poses that the log had no room for.
    let kept = modified(&path) >= newest;
    if kept {
        TumWriter::begin(&mut io::sink())
            .and_then(|mut sink| write_trajectory(&run.files, &mut sink, |pose| *pose, each))
            .map_err(|e| cannot_read(run, &e))?;
    } else {
        out.write(name, |w| write_trajectory(&run.files, &mut TumWriter::begin(w)?, |pose| *pose, each))?;
    }
    let names: Vec<_> = run.files.iter().filter_map(|f| Some(f.file_name()?.to_string_lossy())).collect();
    let seconds = span.map_or(0.0, |[first, last]| (last - first).secs());
    let end = end.map_or("cut off or damaged here, without an end".into(), |why| format!("ended: {why}"));
    print_out(format_args!("{}: {seconds:.1} s, {frames} frames, {poses} with a pose; {end}", names.join(", ")));
    events.iter().for_each(print_out);
    for (path, range) in run.damage.iter().take(DAMAGE_LINES) {
        let (file, bytes) = (path.display(), range.end - range.start);
        print_out(format_args!("{file}: {bytes} bytes from byte {} on are damaged or cut off: skipped", range.start));
    }
    if let Some(more) = run.damage.get(DAMAGE_LINES..).filter(|more| !more.is_empty()) {
        let bytes: u64 = more.iter().map(|(_, range)| range.end - range.start).sum();
        print_out(format_args!("and {bytes} bytes in {} more places", more.len()));
    }
    print_out(format_args!(
        "{}{}",
        path.display(),
        if kept { " is newer than the log and stays as it is" } else { "" }
    ));
    Ok(poses)
}

fn modified(path: &Path) -> Option<std::time::SystemTime> {
    path.metadata().and_then(|m| m.modified()).ok()
}

fn cannot_read(run: &LoggedRun, e: &io::Error) -> Fault {
    let place = run.files[0].display().to_string();
    Fault::new(FaultKind::Io, place, format!("cannot be read: {e}"), "check the disk")
}
