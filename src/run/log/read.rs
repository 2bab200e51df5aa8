//! Reads logs back, damaged ones and those of a run that was killed or cut off included: every chunk whose checksum holds,
//! wherever it is found, once, in the order of writing, in memory for one chunk and an index.

use super::file::{logs, topic, CLOCKS, COUNTERS, EVENT, MAP_FROM_ODOM, PREDICTED, RIG, STATE};
use super::{Clocks, Event, PredictedState, Rig, State};
use crate::output::trajectory::TumWriter;
use crate::publish::status::message::MapFromOdomMessage;
use ::mcap::parse_record;
use ::mcap::records::{op, Record};
use ::mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Write};
use std::ops::Range;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use stipple_drivers::{Nanos, TimedPose};

/// No record of ours is this long: a length that says so is damage.
const LENGTH_MAX: usize = 1 << 18;
/// Bytes read at once, at least.
const READ: usize = 1 << 16;
/// Opcode and length of a record; then start, end, length, checksum, compression (a text: its length) and length again of a
/// chunk, before its messages.
const HEAD: usize = 1 + 8;
const CHUNK_HEAD: usize = HEAD + 8 + 8 + 8 + 4 + 4 + 8;

/// A message of a log. A reader has one at a time, and most are states.
#[allow(clippy::large_enum_variant)]
#[derive(Debug, PartialEq)]
pub enum Message<'a> {
    State(State),
    Predicted(PredictedState),
    Rig(Rig),
    MapFromOdom(MapFromOdomMessage),
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
            PREDICTED => of(data).map(Message::Predicted),
            RIG => of(data).map(Message::Rig),
            MAP_FROM_ODOM => of(data).map(Message::MapFromOdom),
            EVENT => of(data).map(Message::Event),
            COUNTERS => of(data).map(Message::Counters),
            CLOCKS => of(data).map(Message::Clocks),
            _ => None,
        }
    }
}

/// The newest files of the logs in a folder that have at most `bytes` together; the newest whatever it has.
pub fn newest_files(dir: &Path, bytes: u64) -> io::Result<Vec<PathBuf>> {
    let mut sum = 0;
    let all = logs(dir)?.into_iter().rev().map(|(_, file)| file);
    let mut fits = |file: &PathBuf| {
        let is_first = sum == 0;
        sum += file.metadata().map_or(0, |m| m.len());
        is_first || sum <= bytes
    };
    Ok(all.take_while(|file| fits(file)).collect())
}

/// A file, of which a part is in memory.
struct Window {
    file: File,
    size: u64,
    start: u64,
    bytes: Vec<u8>,
}

/// A chunk whose checksum holds.
struct Chunk {
    at: u64,
    run_ns: i64,
    /// The number of its first message.
    sequence: u32,
}

fn number(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight bytes"))
}

impl Window {
    fn open(path: &Path) -> io::Result<Window> {
        let file = File::open(path)?;
        Ok(Window { size: file.metadata()?.len(), file, start: 0, bytes: vec![] })
    }

    /// The bytes from `at` on, fewer than asked for only at the end of the file.
    fn bytes(&mut self, at: u64, n: usize) -> io::Result<&[u8]> {
        let wanted = (at + n as u64).min(self.size);
        if at < self.start || wanted > self.start + self.bytes.len() as u64 {
            self.bytes.resize(n.max(READ).min((self.size - at) as usize), 0);
            self.start = at;
            self.file.read_exact_at(&mut self.bytes, at)?;
        }
        let from = (at - self.start) as usize;
        Ok(&self.bytes[from..from + (wanted - at) as usize])
    }

    /// The length of the chunk that begins there, and its records; none where its head or its checksum does not hold.
    fn chunk(&mut self, at: u64) -> io::Result<Option<(u64, Vec<Record<'static>>)>> {
        let head = self.bytes(at, CHUNK_HEAD)?;
        if head.len() < CHUNK_HEAD || head[0] != op::CHUNK || number(head, 1) > LENGTH_MAX as u64 {
            return Ok(None);
        }
        let body = number(head, 1) as usize;
        let length = body.checked_sub(CHUNK_HEAD - HEAD).map(|n| n as u64);
        let fits = [25, 41].iter().all(|at| Some(number(head, *at)) == length);
        // Checksum 0 says that there is none.
        if !fits || head[33..37] == [0; 4] || head[37..41] != [0; 4] {
            return Ok(None);
        }
        let bytes = self.bytes(at, HEAD + body)?;
        // The checksum is looked at before any record is: a length of a record is believed.
        let mut reader = LinearReader::new_with_options(
            LinearReaderOptions::default()
                .with_skip_start_magic(true)
                .with_skip_end_magic(true)
                .with_prevalidate_chunk_crcs(true)
                .with_record_length_limit(LENGTH_MAX),
        );
        reader.insert(bytes.len()).copy_from_slice(bytes);
        reader.notify_read(bytes.len());
        let mut records = vec![];
        while let Some(Ok(LinearReadEvent::Record { opcode, data })) = reader.next_event() {
            if opcode == op::MESSAGE {
                records.extend(parse_record(opcode, data).ok().map(Record::into_owned));
            }
        }
        Ok((!records.is_empty()).then_some(((HEAD + body) as u64, records)))
    }
}

/// The messages of a chunk, each with its number and the instant it was logged at.
fn messages<'a>(records: &'a [Record]) -> impl Iterator<Item = (u32, Nanos, Message<'a>)> {
    records.iter().filter_map(|record| {
        let Record::Message { header, data } = record else { return None };
        let message = Message::parse(topic(header.channel_id)?, data)?;
        Some((header.sequence, Nanos(header.log_time as i64), message))
    })
}

/// Finds the chunks of the run that wrote a file, and what of its bytes is neither them nor another record.
fn scan(path: &Path) -> io::Result<(Vec<Chunk>, Vec<Range<u64>>)> {
    let mut file = Window::open(path)?;
    let (mut chunks, mut damage): (Vec<Chunk>, Vec<Range<u64>>) = (vec![], vec![]);
    // Bytes up to `known` are accounted for. The record at `last` has no checksum: it was none where a chunk is found in it.
    let (mut at, mut last, mut known) = (0, 0, 0);
    while at < file.size {
        if let Some((length, records)) = file.chunk(at)? {
            if let Some((sequence, _, Message::Clocks(Clocks { run_ns, .. }))) = messages(&records).next() {
                if at != known {
                    damage.push(if at < known { last } else { known }..at);
                }
                chunks.push(Chunk { at, run_ns, sequence });
                at += length;
                (last, known) = (at, at);
                continue;
            }
        }
        if at == known {
            let head = file.bytes(at, HEAD)?;
            let length = match head {
                _ if head.starts_with(&::mcap::MAGIC[..head.len().min(8)]) => 8,
                [op::HEADER..=op::DATA_END, ..] if head[0] != op::CHUNK && head.len() == HEAD => {
                    number(head, 1).saturating_add(HEAD as u64)
                }
                _ => 0,
            };
            if length <= LENGTH_MAX as u64 {
                (last, known) = (at, at + length);
            }
        }
        at += 1;
    }
    if known != file.size {
        damage.push(if known > file.size { last } else { known }..file.size);
    }
    // A disk may answer blocks of a file that was removed.
    let mut runs = BTreeMap::new();
    chunks.iter().for_each(|c| *runs.entry(c.run_ns).or_insert(0) += 1);
    let own = runs.iter().max_by_key(|(_, n)| **n).map(|(run, _)| *run);
    chunks.retain(|c| Some(c.run_ns) == own);
    Ok((chunks, damage))
}

/// The files of one run in their order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LoggedRun {
    /// Nanoseconds since 1970 when it began.
    pub run_ns: i64,
    pub files: Vec<PathBuf>,
    /// Bytes that are no part of a log, and the file they are in.
    pub damage: Vec<(PathBuf, Range<u64>)>,
}

/// The runs logged in a folder, the oldest first. A file without a whole chunk holds nothing.
pub fn runs(dir: &Path) -> io::Result<Vec<LoggedRun>> {
    let mut runs: Vec<LoggedRun> = vec![];
    // What is no file, such as a pipe, may never answer.
    for (_, path) in logs(dir)?.into_iter().filter(|(_, path)| path.is_file()) {
        let (chunks, damage) = scan(&path)?;
        let mut damage = damage.into_iter().map(|range| (path.clone(), range)).collect();
        match (chunks.first().map(|c| c.run_ns), runs.last_mut()) {
            (Some(run_ns), Some(last)) if last.run_ns == run_ns => {
                last.files.push(path);
                last.damage.append(&mut damage);
            }
            (Some(run_ns), _) => runs.push(LoggedRun { run_ns, files: vec![path], damage }),
            (None, Some(last)) => last.damage.append(&mut damage),
            (None, None) => {}
        }
    }
    Ok(runs)
}

/// Shows every message of the files of one run. Fails where a file cannot be read, or `each` fails.
pub fn read_files(files: &[PathBuf], mut each: impl FnMut(Nanos, Message) -> io::Result<()>) -> io::Result<()> {
    let mut chunks = vec![];
    for path in files {
        chunks.extend(scan(path)?.0.into_iter().map(|c| (c.sequence, path, c.at)));
    }
    // A disk may have a block twice, and not where it was written.
    chunks.sort_unstable();
    chunks.dedup_by_key(|c| c.0);
    for of_one_file in chunks.chunk_by(|a, b| a.1 == b.1) {
        let mut file = Window::open(of_one_file[0].1)?;
        for (_, _, at) in of_one_file {
            let Some((_, records)) = file.chunk(*at)? else { continue };
            messages(&records).try_for_each(|(_, at, message)| each(at, message))?;
        }
    }
    Ok(())
}

/// Writes the trajectory that the files of a run hold, each pose as `in_map` gives it, and shows every message; answers
/// the stamp of the last pose.
pub fn write_trajectory(
    files: &[PathBuf],
    out: &mut TumWriter<impl Write>,
    in_map: impl Fn(&TimedPose) -> TimedPose,
    mut each: impl FnMut(Nanos, &Message),
) -> io::Result<Option<Nanos>> {
    let mut last = None;
    read_files(files, |at, message| {
        each(at, &message);
        let Message::State(State { t_ns, epoch, estimate: Some(estimate), dead_reckoned: false, .. }) = message else {
            return Ok(());
        };
        last = Some(Nanos(t_ns));
        out.pose(epoch, &in_map(&TimedPose { t: Nanos(t_ns), pose: estimate.pose() }))
    })?;
    Ok(last)
}
