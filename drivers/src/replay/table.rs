//! Rows of a csv with their line numbers. `#` lines and one headline without it are not data; CRLF, spaces and empty lines
//! are tolerated.

use super::findings::Findings;
use super::order;
use crate::{input, Fault, FaultKind, Nanos};
use std::path::Path;

/// A row, and the line of the file in which it stands, from 1.
#[derive(Clone, Debug)]
pub struct Row<T> {
    /// The line, from 1.
    pub line: usize,
    /// What the row says.
    pub value: T,
}

/// Reads a table in which nothing may be wrong: the first row that cannot be read, or is out of order, is a fault.
pub fn read_strictly<T>(
    path: &Path,
    columns: &str,
    parse: impl Fn(&[&str]) -> Option<T>,
    stamp: impl Fn(&T) -> Nanos,
) -> Result<Vec<Row<T>>, Fault> {
    let mut findings = Findings::default();
    let rows = order::increasing(read(path, columns, parse, &mut findings)?, stamp, path, &mut findings);
    findings.refuse_any()?;
    Ok(rows)
}

/// Largest table, bytes: an hour of a 1 kHz unit, at 140 a row.
pub const TABLE_BYTES_MAX: u64 = 1 << 29;

/// Reads a file of at most `bytes_max` bytes; a fault where that fails.
pub fn read_bytes(path: &Path, bytes_max: u64) -> Result<Vec<u8>, Fault> {
    let mut bytes = Vec::new();
    input::read(path, bytes_max, &mut bytes).map(|()| bytes).map_err(|e| {
        let fix = "check the path and that the recording is complete";
        Fault::new(FaultKind::NoInput, path.display().to_string(), format!("cannot read: {e}"), fix)
    })
}

/// Reads every row, as [`read_any`] does; a fault where there is none.
pub fn read<T>(
    path: &Path,
    columns: &str,
    parse: impl Fn(&[&str]) -> Option<T>,
    findings: &mut Findings,
) -> Result<Vec<Row<T>>, Fault> {
    let rows = read_any(path, columns, parse, findings)?;
    if rows.is_empty() {
        return Err(no_rows(path, columns));
    }
    Ok(rows)
}

/// The fault of a table without rows.
pub fn no_rows(path: &Path, columns: &str) -> Fault {
    let (place, fix) = (path.display().to_string(), "check that the recording is complete");
    Fault::new(FaultKind::Data, place, format!("holds no rows of {columns}"), fix)
}

/// Reads every row. One that cannot be parsed is counted and skipped, but if it is the first, the file is not of the
/// expected kind, which `columns` names.
pub fn read_any<T>(
    path: &Path,
    columns: &str,
    parse: impl Fn(&[&str]) -> Option<T>,
    findings: &mut Findings,
) -> Result<Vec<Row<T>>, Fault> {
    let bytes = read_bytes(path, TABLE_BYTES_MAX)?;
    let text = String::from_utf8_lossy(&bytes);
    let mut rows = Vec::new();
    let mut headline = true;
    for (i, content) in text.lines().enumerate() {
        let (line, content) = (i + 1, content.trim().trim_start_matches('\u{feff}'));
        if content.is_empty() || content.starts_with('#') {
            headline &= content.is_empty(); // a `#` line has named the columns
            continue;
        }
        let fields: Vec<&str> = split(content);
        let names_columns = headline && fields.iter().all(|f| f.parse::<f64>().is_err());
        headline = false;
        match parse(&fields) {
            Some(value) => rows.push(Row { line, value }),
            None if names_columns => {}
            None if rows.is_empty() => {
                let what = format!("expected {columns}, found \"{}\"", excerpt(content));
                return Err(Fault::at(FaultKind::Data, path, line, what, "check that this is the right file"));
            }
            None => {
                let what = format!("expected {columns}, found \"{}\": row dropped", excerpt(content));
                findings.warn(|c| &mut c.rows_malformed, path, line, what);
            }
        }
    }
    Ok(rows)
}

/// Fields between commas, or between blanks where there is no comma.
pub fn split(content: &str) -> Vec<&str> {
    if content.contains(',') {
        content.split(',').map(str::trim).collect()
    } else {
        content.split_whitespace().collect()
    }
}

/// The beginning of a row, for messages.
pub fn excerpt(content: &str) -> String {
    content.chars().take(60).filter(|c| !c.is_control()).collect()
}

/// The fields as numbers; `None` where one is none.
pub fn numbers(fields: &[&str]) -> Option<Vec<f64>> {
    fields.iter().map(|f| f.parse().ok()).collect()
}
