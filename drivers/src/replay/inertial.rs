//! The inertial samples of a recording one by one, in the memory of one row or message, however long it is: of a folder with
//! `mav0/imu0`, or of the MCAP files that `record` leaves. Unlike `Recording` it passes over nothing: what is wrong is a fault.

use super::calibration::{document::Document, stated_rate};
use super::{imu_of, layout, root, table, IMU_COLUMNS};
use crate::input::SETTINGS_BYTES_MAX;
use crate::types::{ImuSample, Nanos};
use crate::{input, Fault, FaultKind};
use ::mcap::records::{op, Record};
use ::mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use ::mcap::McapError;
use glam::DVec3;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

/// Longest row of a table, bytes: five times that of seven numbers in full.
const ROW_BYTES_MAX: u64 = 1024;
/// Longest message of an MCAP file, bytes: the largest image there is, not compressed.
const MESSAGE_BYTES_MAX: usize = 1 << 26;
/// Topic of the samples, and name of the calibration beside them.
const TOPIC: &str = "/imu0";
const CALIBRATION: &str = "imu0/sensor.yaml";

/// Reads the samples of a recording in their order; `each` is told the rate that the recording states, Hz, too. A fault where
/// it states none, and at the first row or message that is not a finite sample.
pub fn read_inertial(log: &Path, mut each: impl FnMut(f64, &ImuSample)) -> Result<(), Fault> {
    match mcap_files(log) {
        files if files.is_empty() => rows(log, each),
        files => files.iter().try_for_each(|file| messages(file, &mut each)),
    }
}

/// The MCAP files of a recording, in the order in which they were written.
fn mcap_files(log: &Path) -> Vec<PathBuf> {
    let is_mcap = |path: &PathBuf| path.extension().is_some_and(|e| e == "mcap");
    if log.is_file() {
        return Some(log.to_path_buf()).filter(is_mcap).into_iter().collect();
    }
    let ours = |path: &PathBuf| {
        is_mcap(path) && path.file_name().is_some_and(|n| n.to_string_lossy().starts_with("recording-"))
    };
    let entries = std::fs::read_dir(log).into_iter().flatten().flatten();
    let mut files: Vec<PathBuf> = entries.map(|e| e.path()).filter(ours).collect();
    // The thousandth has a digit more.
    files.sort_by_key(|path| (path.as_os_str().len(), path.clone()));
    files
}

fn unreadable(path: &Path, why: impl std::fmt::Display) -> Fault {
    let what = format!("cannot be read: {why}");
    Fault::new(FaultKind::Data, path.display().to_string(), what, "record again")
}

fn rows(log: &Path, mut each: impl FnMut(f64, &ImuSample)) -> Result<(), Fault> {
    let (home, mav0) = layout(log)?;
    root(&home, &mav0)?;
    let (own, kalibr) = (mav0.join(CALIBRATION), home.join("imu_config.yaml"));
    let rate = stated_rate(&Document::read(if own.is_file() { &own } else { &kalibr })?)?;
    let path = mav0.join("imu0/data.csv");
    let mut file = BufReader::new(input::open(&path, u64::MAX).map_err(|e| unreadable(&path, e))?);
    let (mut row, mut line, mut first) = (Vec::new(), 0, true);
    loop {
        row.clear();
        file.by_ref().take(ROW_BYTES_MAX).read_until(b'\n', &mut row).map_err(|e| unreadable(&path, e))?;
        line += 1;
        let whole = row.ends_with(b"\n");
        // A recording that was killed may end within a row.
        if !whole && (row.len() as u64) < ROW_BYTES_MAX {
            return Ok(());
        }
        let text = String::from_utf8_lossy(&row);
        let content = text.trim().trim_start_matches('\u{feff}');
        if content.is_empty() || content.starts_with('#') {
            continue;
        }
        let fields = table::split(content);
        match imu_of(&fields).filter(|s| whole && s.is_finite()) {
            Some(sample) => each(rate, &sample),
            // A headline without a `#`.
            None if first && fields.iter().all(|f| f.parse::<f64>().is_err()) => {}
            None => {
                let what = format!("expected {IMU_COLUMNS}, found \"{}\"", table::excerpt(content));
                return Err(Fault::at(FaultKind::Data, &path, line, what, "record again"));
            }
        }
        first = false;
    }
}

fn messages(path: &Path, each: &mut impl FnMut(f64, &ImuSample)) -> Result<(), Fault> {
    let mut file = input::open(path, u64::MAX).map_err(|e| unreadable(path, e))?;
    let options = LinearReaderOptions::default()
        .with_skip_end_magic(true)
        .with_validate_chunk_crcs(true)
        .with_record_length_limit(MESSAGE_BYTES_MAX);
    let mut reader = LinearReader::new_with_options(options);
    let (mut channel, mut rate) = (None, None);
    while let Some(event) = reader.next_event() {
        let (opcode, data) = match event {
            Ok(LinearReadEvent::ReadRequest(need)) => {
                let n = file.read(reader.insert(need)).map_err(|e| unreadable(path, e))?;
                reader.notify_read(n);
                continue;
            }
            Ok(LinearReadEvent::Record { opcode, data }) => (opcode, data),
            // A recording that was killed ends within a chunk; what is missing of it is the end, or a gap before the next file.
            Err(McapError::UnexpectedEof | McapError::UnexpectedEoc) => return Ok(()),
            Err(e) => return Err(unreadable(path, e)),
        };
        if ![op::CHANNEL, op::ATTACHMENT, op::MESSAGE].contains(&opcode) {
            continue;
        }
        if opcode == op::ATTACHMENT && !is_whole(data) {
            return Err(unreadable(path, "an attachment is cut off"));
        }
        match ::mcap::parse_record(opcode, data).map_err(|e| unreadable(path, e))? {
            Record::Channel(c) if c.topic == TOPIC => channel = Some(c.id),
            Record::Attachment { header, data, .. } if header.name == CALIBRATION => {
                if data.len() as u64 > SETTINGS_BYTES_MAX {
                    let what = format!("{CALIBRATION} has {} bytes, {SETTINGS_BYTES_MAX} at most are read", data.len());
                    return Err(unreadable(path, what));
                }
                let text = String::from_utf8_lossy(&data).into_owned();
                rate = Some(stated_rate(&Document::parse(&path.join(CALIBRATION), text)?)?);
            }
            Record::Message { header, data } if Some(header.channel_id) == channel => {
                let rate =
                    rate.ok_or_else(|| unreadable(path, format!("has no {CALIBRATION}, which states the rate")))?;
                let sample = sample_of(&data).filter(ImuSample::is_finite);
                each(
                    rate,
                    &sample.ok_or_else(|| unreadable(path, format!("a message of {TOPIC} is no finite sample")))?,
                );
            }
            _ => {}
        }
    }
    Ok(())
}

/// Whether the record of an attachment has all its fields: the parser panics where its checksum is missing.
fn is_whole(record: &[u8]) -> bool {
    const TIMES: usize = 16;
    const LENGTH_AND_CHECKSUM: usize = 12;
    fn after_text(at: &[u8]) -> Option<&[u8]> {
        let (length, rest) = at.split_first_chunk()?;
        rest.get(u32::from_le_bytes(*length) as usize..)
    }
    let after_name = record.get(TIMES..).and_then(after_text);
    after_name.and_then(after_text).is_some_and(|rest| rest.len() >= LENGTH_AND_CHECKSUM)
}

/// The sample of a `sensor_msgs/msg/Imu` in little-endian CDR, whose numbers are aligned behind a head of four bytes.
fn sample_of(cdr: &[u8]) -> Option<ImuSample> {
    const HEAD: usize = 4;
    let word = |at: usize| Some(u32::from_le_bytes(cdr.get(at..at + 4)?.try_into().ok()?));
    let t = i64::from(word(HEAD)? as i32) * 1_000_000_000 + i64::from(word(HEAD + 4)?);
    let frame_id = HEAD + 12 + word(HEAD + 8)? as usize;
    // Orientation and its covariance stand before the angular velocity, its covariance before the specific force.
    let velocity = HEAD + (frame_id - HEAD).next_multiple_of(8) + 13 * 8;
    let float = |at: usize| Some(f64::from_le_bytes(cdr.get(at..at + 8)?.try_into().ok()?));
    let vector = |at: usize| Some(DVec3::new(float(at)?, float(at + 8)?, float(at + 16)?));
    let (gyro_body, accel_body) = (vector(velocity)?, vector(velocity + 12 * 8)?);
    (cdr[..2] == [0, 1]).then_some(ImuSample { t: Nanos(t), gyro_body, accel_body, ..ImuSample::default() })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// What reading a file says whose one record is an attachment of this body.
    fn said_of(body: &[u8]) -> String {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("recording-000.mcap");
        let record = |op: u8, body: &[u8]| [&[op], &(body.len() as u64).to_le_bytes()[..], body].concat();
        let magic = b"\x89MCAP0\r\n".to_vec();
        std::fs::write(&path, [magic, record(op::HEADER, &[0; 8]), record(op::ATTACHMENT, body)].concat()).unwrap();
        read_inertial(&path, |_, _| {}).map_or_else(|fault| fault.to_string(), |()| String::new())
    }

    /// An attachment's fields up to its data.
    fn head() -> Vec<u8> {
        let text = |s: &str| [&(s.len() as u32).to_le_bytes()[..], s.as_bytes()].concat();
        [vec![0; 16], text(CALIBRATION), text("application/yaml")].concat()
    }

    #[test]
    fn a_calibration_is_read_up_to_the_size_of_settings() {
        for (more, words) in [(0, ""), (1, "1048576 at most are read")] {
            let mut yaml = b"rate_hz: 200\n".to_vec();
            yaml.resize(SETTINGS_BYTES_MAX as usize + more, b'\n');
            let said = said_of(&[head(), (yaml.len() as u64).to_le_bytes().to_vec(), yaml, vec![0; 4]].concat());
            assert!(said.contains(words) && said.is_empty() == words.is_empty(), "{said}");
        }
    }

    /// The parser panicked.
    #[test]
    fn an_attachment_that_is_cut_off_anywhere_is_a_fault() {
        let whole = [head(), vec![0; 12]].concat();
        for length in 0..whole.len() {
            assert!(said_of(&whole[..length]).contains("cut off"), "{length}");
        }
    }
}
