//! A YAML or JSON file as a tree; its faults name the key and the line. Keys are JSON pointers (`/cam0/intrinsics`).

use super::super::{findings, table};
use super::rigid;
use crate::input::SETTINGS_BYTES_MAX;
use crate::types::Pose;
use crate::{Fault, FaultKind};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// A parsed file, with its text for line numbers.
pub struct Document {
    /// The file it was read from.
    pub path: PathBuf,
    text: String,
    root: Value,
}

/// No calibration nests as deep; the parser of YAML takes the longer the deeper.
const DEPTH_MAX: i32 = 64;

/// The first line where brackets nest too deep.
fn too_deep(text: &str) -> Option<usize> {
    let mut depth = 0;
    let deep = |byte: u8| {
        depth += i32::from(matches!(byte, b'[' | b'{')) - i32::from(matches!(byte, b']' | b'}'));
        depth > DEPTH_MAX
    };
    let at = text.bytes().position(deep)?;
    Some(1 + text[..at].matches('\n').count())
}

fn wrong(path: &Path, line: usize, what: String) -> Fault {
    let place = findings::place(path, line);
    Fault::new(FaultKind::Config, place, what.replace('\n', " "), "correct the calibration file")
}

impl Document {
    /// Reads and parses a file; a fault where it cannot be read or is neither YAML nor JSON.
    pub fn read(path: &Path) -> Result<Document, Fault> {
        let bytes = table::read_bytes(path, SETTINGS_BYTES_MAX)?;
        let text = String::from_utf8(bytes).map_err(|_| wrong(path, 0, "is not text".into()))?;
        Document::parse(path, text)
    }

    /// Parses the text of a file; a fault where it is neither YAML nor JSON.
    pub fn parse(path: &Path, mut text: String) -> Result<Document, Fault> {
        let wrong = |line: usize, what: String| wrong(path, line, what);
        if text.starts_with('%') {
            // OpenCV writes "%YAML:1.0", which is not YAML; blanked, so that lines keep their numbers.
            let end = text.find('\n').unwrap_or(text.len());
            text.replace_range(..end, "");
        }
        if let Some(line) = too_deep(&text) {
            return Err(wrong(line, format!("has lists within lists, more than {DEPTH_MAX} deep")));
        }
        let root: Result<Value, _> = if text.trim_start().starts_with('{') {
            serde_json::from_str(&text).map_err(|e| wrong(e.line(), e.to_string()))
        } else {
            serde_yaml_ng::from_str(&text)
                .map_err(|e| wrong(e.location().map_or(0, |l| l.line()), format!("not YAML: {e}")))
        };
        Ok(Document { path: path.to_path_buf(), root: root?, text })
    }

    /// Whether there is such a key.
    pub fn has(&self, key: &str) -> bool {
        self.root.pointer(key).is_some()
    }

    /// The keys of the outermost level.
    pub fn keys(&self) -> impl Iterator<Item = &str> {
        self.root.as_object().into_iter().flat_map(|o| o.keys().map(String::as_str))
    }

    /// The length of a list; 0 where there is none.
    pub fn length(&self, key: &str) -> usize {
        self.root.pointer(key).and_then(Value::as_array).map_or(0, Vec::len)
    }

    /// The line of a key, or of the deepest part of it that is there; 0 if none is.
    pub fn line(&self, key: &str) -> usize {
        let mut found = 0;
        for part in key.split('/').filter(|p| !p.is_empty() && p.parse::<usize>().is_err()) {
            let names = |l: &str| {
                let l = l.trim_start().trim_start_matches(['"', '\'']);
                l.strip_prefix(part).is_some_and(|rest| rest.trim_start_matches(['"', '\'', ' ']).starts_with(':'))
            };
            match self.text.lines().enumerate().skip(found).find(|(_, l)| names(l)) {
                Some((i, _)) => found = i + 1,
                None => break,
            }
        }
        found
    }

    /// A fault of a key.
    pub fn fault(&self, key: &str, what: &str) -> Fault {
        let name = key.trim_start_matches('/').replace('/', ".");
        let what = if name.is_empty() { what.to_string() } else { format!("{name}: {what}") };
        Fault::new(FaultKind::Config, findings::place(&self.path, self.line(key)), what, "correct the calibration file")
    }

    fn get(&self, key: &str) -> Result<&Value, Fault> {
        self.root.pointer(key).ok_or_else(|| self.fault(key, "this key is missing"))
    }

    /// A word; a fault where there is none.
    pub fn text(&self, key: &str) -> Result<&str, Fault> {
        self.get(key)?.as_str().ok_or_else(|| self.fault(key, "must be a word"))
    }

    /// A finite number; text that is one counts. A fault where there is none.
    pub fn number(&self, key: &str) -> Result<f64, Fault> {
        finite(self.get(key)?).ok_or_else(|| self.fault(key, "must be a number"))
    }

    /// A number above zero; a fault where there is none.
    pub fn positive(&self, key: &str) -> Result<f64, Fault> {
        let value = self.number(key)?;
        if value > 0.0 {
            return Ok(value);
        }
        Err(self.fault(key, "must be positive"))
    }

    /// A list of `n` numbers, or of lists that hold so many in all; a fault where they are not.
    pub fn numbers(&self, key: &str, n: usize) -> Result<Vec<f64>, Fault> {
        let wrong = || self.fault(key, "must be a list of numbers");
        let items = self.get(key)?.as_array().ok_or_else(wrong)?;
        let flat = items.iter().flat_map(|v| v.as_array().map_or(std::slice::from_ref(v), Vec::as_slice));
        let values: Vec<f64> = flat.map(|v| finite(v).ok_or_else(wrong)).collect::<Result<_, _>>()?;
        if values.len() != n {
            return Err(self.fault(key, &format!("must be {n} numbers, found {}", values.len())));
        }
        Ok(values)
    }

    /// A rigid transform, from the 16 numbers of its matrix, row by row; a fault where it is none.
    pub fn transform(&self, key: &str) -> Result<Pose, Fault> {
        rigid(&self.numbers(key, 16)?).map_err(|what| self.fault(key, what))
    }
}

fn finite(value: &Value) -> Option<f64> {
    let number = value.as_f64().or_else(|| value.as_str()?.parse().ok())?;
    number.is_finite().then_some(number)
}
