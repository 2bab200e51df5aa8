//! Reads logs back, those of a run that was killed or cut off included: up to the last complete message of each file, in
//! memory for one message.

use super::file::{logs, CLOCKS, COUNTERS, EVENT, STATE};
use super::{Clocks, Event, State};
use crate::output::trajectory;
use ::mcap::parse_record;
use ::mcap::records::Record;
use ::mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use stipple_drivers::{Nanos, TimedPose};

/// No message of ours is this long: a length that says so is damage.
const LENGTH_MAX: usize = 1 << 20;
/// Bytes read at once, at least.
const READ: usize = 1 << 16;

/// A message of a log.
#[derive(Debug, PartialEq)]
pub enum Message<'a> {
    State(State),
    Event(Event<'a>),
    Counters(BTreeMap<String, u64>),
    Clocks(Clocks),
}

impl Message<'_> {
    fn parse<'a>(topic: &str, data: &'a [u8]) -> Option<Message<'a>> {
        fn of<'a, T: Deserialize<'a>>(data: &'a [u8]) -> Option<T> {
            serde_json::from_slice(data).ok()
        }
        match topic {
            STATE => of(data).map(Message::State),
            EVENT => of(data).map(Message::Event),
            COUNTERS => of(data).map(Message::Counters),
            CLOCKS => of(data).map(Message::Clocks),
            _ => None,
        }
    }
}

/// Shows every message of a file with the instant it was logged at, until `each` answers false. Fails where the file cannot
/// be read, or `each` fails; damage is an end.
fn read_file(path: &Path, mut each: impl FnMut(Nanos, Message) -> io::Result<bool>) -> io::Result<()> {
    let mut file = File::open(path)?;
    let mut reader =
        LinearReader::new_with_options(LinearReaderOptions::default().with_record_length_limit(LENGTH_MAX));
    let mut topics = BTreeMap::new();
    while let Some(event) = reader.next_event() {
        match event {
            Ok(LinearReadEvent::ReadRequest(n)) => {
                let n = file.read(reader.insert(n.max(READ)))?;
                reader.notify_read(n);
            }
            Ok(LinearReadEvent::Record { opcode, data }) => match parse_record(opcode, data) {
                Ok(Record::Channel(channel)) => drop(topics.insert(channel.id, channel.topic)),
                Ok(Record::Message { header, data }) => {
                    let message = topics.get(&header.channel_id).and_then(|topic| Message::parse(topic, &data));
                    let goes_on = message.map_or(Ok(true), |m| each(Nanos(header.log_time as i64), m))?;
                    if !goes_on {
                        break;
                    }
                }
                Ok(_) => {}
                Err(_) => break,
            },
            Err(_) => break,
        }
    }
    Ok(())
}

/// The files of one run in their order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LoggedRun {
    /// Nanoseconds since 1970 when it began.
    pub run_ns: i64,
    pub files: Vec<PathBuf>,
}

/// The runs logged in a folder, the oldest first. A file that was cut off before it named its run holds nothing.
pub fn runs(dir: &Path) -> io::Result<Vec<LoggedRun>> {
    let mut runs: Vec<LoggedRun> = vec![];
    // What is no file, such as a pipe, may never answer.
    for (_, path) in logs(dir)?.into_iter().filter(|(_, path)| path.is_file()) {
        let mut run = None;
        read_file(&path, |_, message| {
            run = if let Message::Clocks(c) = message { Some(c.run_ns) } else { None };
            Ok(false)
        })?;
        match (run, runs.last_mut()) {
            (Some(run_ns), Some(last)) if last.run_ns == run_ns => last.files.push(path),
            (Some(run_ns), _) => runs.push(LoggedRun { run_ns, files: vec![path] }),
            (None, _) => {}
        }
    }
    Ok(runs)
}

/// Shows every message of the files of one run.
pub fn read_files(files: &[PathBuf], mut each: impl FnMut(Nanos, Message) -> io::Result<()>) -> io::Result<()> {
    files.iter().try_for_each(|path| read_file(path, |t, message| each(t, message).map(|()| true)))
}

/// Writes the trajectory that the files of a run hold, and shows every message; answers the stamp of the last pose.
pub fn write_trajectory(
    files: &[PathBuf],
    out: &mut impl Write,
    mut each: impl FnMut(Nanos, &Message),
) -> io::Result<Option<Nanos>> {
    let mut last = None;
    trajectory::write_head(out)?;
    read_files(files, |at, message| {
        each(at, &message);
        let Message::State(State { t_ns, estimate: Some(estimate), .. }) = message else { return Ok(()) };
        last = Some(Nanos(t_ns));
        trajectory::write_line(out, &TimedPose { t: Nanos(t_ns), pose: estimate.pose() })
    })?;
    Ok(last)
}
