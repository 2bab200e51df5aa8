//! The files of a log: MCAP, in chunks of half a second at most. A chunk has a checksum, names its run and numbers its
//! messages: by itself it says what it is, whatever became of the rest of the file.

use super::{Clocks, Content, Event, Limits, Record};
use crate::publish::event::EventId;
use crate::vio::Health;
use ::mcap::records::MessageHeader;
use ::mcap::{McapError, WriteOptions, Writer};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fs::{read_dir, File, OpenOptions};
use std::io::{self, Read, Write as _};
use std::path::{Path, PathBuf};
use stipple_drivers::{host, Nanos};

/// Topic and schema of each channel; a schema says only what a viewer needs.
pub const STATE: &str = "/state";
pub const EVENT: &str = "/event";
pub const COUNTERS: &str = "/counters";
pub const CLOCKS: &str = "/clocks";
pub const PREDICTED: &str = "/predicted";
pub const RIG: &str = "/rig";
pub const MAP_FROM_ODOM: &str = "/map_from_odom";
const CHANNELS: [(&str, &str, &str); 7] = [
    (
        STATE,
        "stipple.State",
        r#"{"type":"object","properties":{"t_ns":{"type":"integer"},"time_offsets_ns":{"type":"array","items":{"type":"integer"}},"epoch":{"type":"integer"},"estimate":{"type":"object","properties":{
"p_m":{"type":"array","items":{"type":"number"}},"q_xyzw":{"type":"array","items":{"type":"number"}},
"v_world":{"type":"array","items":{"type":"number"}},"gyro_bias":{"type":"array","items":{"type":"number"}},
"accel_bias":{"type":"array","items":{"type":"number"}}}},"dead_reckoned":{"type":"boolean"},"carried":{"type":"boolean"},
"sigma":{"type":"array","items":{"type":"number"}},"health":{"type":"integer"},"quality":{"type":"integer"},
"keyframe":{"type":"boolean"},"latency_ms":{"type":"number"},"cpu_ms":{"type":"number"}}}"#,
    ),
    (
        EVENT,
        "stipple.Event",
        r#"{"type":"object","properties":{"id":{"type":"string"},"epoch":{"type":"integer"},"text":{"type":"string"}}}"#,
    ),
    (COUNTERS, "stipple.Counters", r#"{"type":"object"}"#),
    (
        CLOCKS,
        "stipple.Clocks",
        r#"{"type":"object","properties":{"monotonic_ns":{"type":"integer"},"boottime_ns":{"type":"integer"},
"realtime_ns":{"type":"integer"},"run_ns":{"type":"integer"}}}"#,
    ),
    (
        PREDICTED,
        "stipple.PredictedState",
        r#"{"type":"object","properties":{"t_ns":{"type":"integer"},"age_ns":{"type":"integer"},"epoch":{"type":"integer"},
"estimate":{"type":"object"},"sigma":{"type":"array","items":{"type":"number"}},"health":{"type":"integer"},
"quality":{"type":"integer"}}}"#,
    ),
    (
        RIG,
        "stipple.Rig",
        r#"{"type":"object","properties":{"t_ns":{"type":"integer"},"time_offsets":{"type":"array"},
"extrinsics":{"type":"array"},"imu_scale":{"type":"array"}}}"#,
    ),
    (
        MAP_FROM_ODOM,
        "stipple.MapFromOdom",
        r#"{"type":"object","properties":{"t_ns":{"type":"integer"},"count":{"type":"integer"},"epoch":{"type":"integer"},
"position":{"type":"array","items":{"type":"number"}},"yaw":{"type":"number"},"covariance":{"type":"array"}}}"#,
    ),
];
/// Name of the file that has the number of epochs begun.
const EPOCHS: &str = "epochs";
/// Bytes of messages that end a chunk before the next sync does, as after a stall of the disk: damage costs whole chunks.
const CHUNK: usize = 16 << 10;

/// What a channel holds. Readers know it by its number, since its record may be lost.
pub fn topic(channel: u16) -> Option<&'static str> {
    CHANNELS.get(usize::from(channel).checked_sub(1)?).map(|c| c.0)
}

fn failed(e: McapError) -> io::Error {
    match e {
        McapError::Io(e) => e,
        other => io::Error::other(other),
    }
}

/// Writes log-0000.mcap and so on, after those that are there.
pub struct LogFiles {
    dir: PathBuf,
    pub limits: Limits,
    run_ns: i64,
    /// Messages of the run so far: each has the next number.
    sequence: u32,
    /// Epoch of the last state, and how many began in the runs of this folder before, where they are counted.
    epoch: u32,
    before: Option<u32>,
    open: Option<Open>,
    json: Vec<u8>,
    pub written: Vec<PathBuf>,
}

struct Open {
    writer: Writer<File>,
    /// The writer's, too.
    file: File,
    /// Bytes up to the last chunk that was written whole.
    good: u64,
    /// Bytes of messages since the last chunk was ended.
    chunk: usize,
}

impl LogFiles {
    pub fn new(dir: PathBuf, limits: Limits, before: Option<u32>) -> LogFiles {
        let run_ns = Clocks::now(None).realtime_ns;
        let files =
            LogFiles { dir, limits, run_ns, sequence: 0, epoch: 0, before, open: None, json: vec![], written: vec![] };
        files.count_epochs();
        files
    }

    /// Notes how many epochs have begun, for the next run. Where it cannot be written, that one counts as this one did.
    fn count_epochs(&self) {
        let Some(before) = self.before else { return };
        let (note, written) = (self.dir.join(EPOCHS), self.dir.join(format!("{EPOCHS}.new")));
        let _ = std::fs::remove_file(&written);
        let begun = before.wrapping_add(self.epoch).wrapping_add(1);
        let mut options = OpenOptions::new();
        let file = options.write(true).create_new(true).open(&written);
        let _ = file.and_then(|mut file| writeln!(file, "{begun}")).and_then(|()| std::fs::rename(&written, note));
    }

    /// Begins the next file.
    pub fn begin(&mut self) -> io::Result<()> {
        self.needs_room()?;
        let path = next_file(&self.dir)?;
        let file = OpenOptions::new().write(true).create_new(true).open(&path)?;
        // A name is on the disk when its folder is.
        File::open(&self.dir)?.sync_all()?;
        // A chunk ends where it is asked for, and the next begins with the clocks.
        let options = WriteOptions::new().library("stipple").compression(None).disable_seeking(true).chunk_size(None);
        let mut writer = options.create(file.try_clone()?).map_err(failed)?;
        let names = Health::NAMES.iter().enumerate().map(|(bit, name)| (format!("health bit {bit}"), name.to_string()));
        let (names, none) = (names.collect(), BTreeMap::new());
        for (topic, name, schema) in CHANNELS {
            let schema = writer.add_schema(name, "jsonschema", schema.as_bytes()).map_err(failed)?;
            let notes = if [STATE, PREDICTED].contains(&topic) { &names } else { &none };
            writer.add_channel(schema, topic, "json", notes).map_err(failed)?;
        }
        self.open = Some(Open { writer, file, good: 0, chunk: 0 });
        self.written.push(path);
        Ok(())
    }

    /// Fails where the disk has less room than the floor.
    fn needs_room(&self) -> io::Result<()> {
        match host::disk_free(&self.dir) {
            Some(free) if free < self.limits.free => {
                let (free, floor) = (free >> 20, self.limits.free >> 20);
                let place = self.dir.display();
                Err(io::Error::other(format!("{place} has {free} MiB of free space, and {floor} are kept: make room")))
            }
            _ => Ok(()),
        }
    }

    pub fn write(&mut self, record: &Record) -> io::Result<()> {
        let at = record.at;
        match &record.content {
            Content::State(state) => {
                if std::mem::replace(&mut self.epoch, state.epoch) != state.epoch {
                    self.count_epochs();
                }
                self.message(STATE, at, Some(state.t_ns), state)
            }
            Content::Predicted(state) => self.message(PREDICTED, at, Some(state.t_ns), state),
            Content::MapFromOdom(placed) => self.message(MAP_FROM_ODOM, at, Some(placed.t_ns), placed),
            Content::Rig(rig) => self.message(RIG, at, Some(rig.t_ns), rig),
            Content::Event(id, text) => {
                let event = Event { id: *id, epoch: self.epoch, text: String::from_utf8_lossy(text) };
                self.message(EVENT, at, None, &event)
            }
            Content::Counters(list) => {
                self.message(COUNTERS, at, None, &list.iter().map(|(name, n)| (name, n)).collect::<BTreeMap<_, _>>())
            }
        }
    }

    fn message(&mut self, topic: &str, at: Nanos, taken: Option<i64>, content: &impl Serialize) -> io::Result<()> {
        if self.open.as_ref().is_some_and(|open| open.chunk == 0) {
            self.put(CLOCKS, host::monotonic(), None, &Clocks::now(Some(self.run_ns)))?;
        }
        self.put(topic, at, taken, content)?;
        self.open.as_mut().filter(|open| open.chunk >= CHUNK).map_or(Ok(()), Open::end_chunk)
    }

    fn put(&mut self, topic: &str, at: Nanos, taken: Option<i64>, content: &impl Serialize) -> io::Result<()> {
        let Some(open) = &mut self.open else { return Ok(()) };
        self.json.clear();
        serde_json::to_writer(&mut self.json, content)?;
        let channel = CHANNELS.iter().position(|c| c.0 == topic).expect("one of CHANNELS");
        let [log_time, publish_time] = [at.0, taken.unwrap_or(at.0)].map(|t| t.max(0) as u64);
        let header = MessageHeader { channel_id: channel as u16 + 1, sequence: self.sequence, log_time, publish_time };
        (self.sequence, open.chunk) = (self.sequence.wrapping_add(1), open.chunk + self.json.len());
        open.writer.write_to_known_channel(&header, &self.json).map_err(failed)
    }

    /// Puts everything on the disk; closes the file where it is full or the log is `over`.
    pub fn sync(&mut self, over: bool) -> io::Result<()> {
        let Some(open) = &mut self.open else { return Ok(()) };
        open.end_chunk()?;
        open.file.sync_data()?;
        let full = open.good >= self.limits.file;
        if full && !over {
            // The next file would not begin: this one says so.
            self.leave_room()?;
        }
        if over || full {
            self.close()?;
        }
        if full && !over {
            self.begin()?;
        }
        Ok(())
    }

    /// Ends the log where the disk has less room than the floor, and fails then.
    pub fn leave_room(&mut self) -> io::Result<()> {
        let Err(why) = self.needs_room() else { return Ok(()) };
        let text = why.to_string().into();
        self.message(EVENT, host::monotonic(), None, &Event { id: EventId::LogEnded, epoch: self.epoch, text })?;
        self.close()?;
        Err(why)
    }

    fn close(&mut self) -> io::Result<()> {
        let Some(open) = &mut self.open else { return Ok(()) };
        open.end_chunk()?;
        open.writer.finish().map_err(failed)?;
        open.file.sync_all()?;
        self.open = None;
        Ok(())
    }

    /// Leaves the file with the chunks that were written whole.
    pub fn give_up(&mut self) {
        if let Some(Open { writer, file, good, .. }) = self.open.take() {
            drop(writer.into_inner());
            // A disk that refuses this leaves a cut chunk, which readers pass over.
            let _ = file.set_len(good).and_then(|()| file.sync_all());
        }
    }
}

impl Open {
    fn end_chunk(&mut self) -> io::Result<()> {
        self.chunk = 0;
        self.writer.flush().map_err(failed)?;
        self.good = self.file.metadata()?.len();
        Ok(())
    }
}

/// Resets that a run may have had after its last note, when its log had ended.
const UNNOTED: u32 = 8;

/// Epochs that began in the runs of a folder, with room for those of the last run that were not noted.
pub fn epochs_begun(dir: &Path) -> u32 {
    let mut text = String::new();
    let read = File::open(dir.join(EPOCHS)).and_then(|file| file.take(16).read_to_string(&mut text));
    let noted = read.ok().and_then(|_| text.trim().parse::<u32>().ok());
    noted.map_or(0, |noted| noted.wrapping_add(UNNOTED))
}

/// Numbers and names of the logs in a folder, in order.
pub fn logs(dir: &Path) -> io::Result<Vec<(u64, PathBuf)>> {
    let number = |name: &str| name.strip_prefix("log-")?.strip_suffix(".mcap")?.parse().ok();
    let mut found = vec![];
    for entry in read_dir(dir)? {
        let entry = entry?;
        found.extend(number(&entry.file_name().to_string_lossy()).map(|n: u64| (n, entry.path())));
    }
    found.sort();
    Ok(found)
}

/// The name of the next log in a folder.
fn next_file(dir: &Path) -> io::Result<PathBuf> {
    let next = logs(dir)?.last().map_or(0, |(n, _)| n + 1);
    Ok(dir.join(format!("log-{next:04}.mcap")))
}
