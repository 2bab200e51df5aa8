//! The one error type of boot and of input: what is wrong, where, why, and what to do. It prints as one line.

use serde::{Deserialize, Serialize};
use std::fmt::{self, Write as _};
use std::path::Path;

/// What sort of thing went wrong, for whoever must decide what to do about it (a program: its exit code).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum FaultKind {
    /// The program was asked for something that it does not do.
    Usage,
    /// Input data is malformed.
    Data,
    /// An input file or folder does not exist or cannot be read.
    NoInput,
    /// A device, or a service of the system, is missing or refuses.
    Unavailable,
    /// A mistake of the program itself.
    Internal,
    /// An output cannot be created.
    NoOutput,
    /// Reading or writing failed on the way.
    Io,
    /// A board or calibration file is wrong.
    Config,
}

/// An error with its place, its cause and its remedy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Fault {
    /// What sort of thing went wrong.
    pub kind: FaultKind,
    /// File, file:line, key of a board file, or device.
    pub place: String,
    /// What is wrong there, and why.
    pub what: String,
    /// What to do about it; empty where nothing can be said.
    pub fix: String,
}

impl Fault {
    /// A fault at a place; `fix` may be empty.
    pub fn new(kind: FaultKind, place: impl Into<String>, what: impl Into<String>, fix: impl Into<String>) -> Fault {
        Fault { kind, place: place.into(), what: what.into(), fix: fix.into() }
    }

    /// A fault of one line of a file.
    pub fn at(kind: FaultKind, path: &Path, line: usize, what: impl Into<String>, fix: impl Into<String>) -> Fault {
        Fault::new(kind, format!("{}:{line}", path.display()), what, fix)
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (separator, fix) = if self.fix.is_empty() { ("", "") } else { ("; ", &self.fix[..]) };
        // What it quotes of a file may hold anything.
        let text = [&self.place, ": ", &self.what, separator, fix].into_iter().flat_map(str::chars);
        text.map(|c| if c.is_control() { ' ' } else { c }).try_for_each(|c| f.write_char(c))
    }
}

impl std::error::Error for Fault {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fault_is_one_line_whatever_it_quotes() {
        let fault = Fault::new(FaultKind::Data, "a.yaml:6", "lens x\n\r> is not known", "correct it");
        assert_eq!(fault.to_string(), "a.yaml:6: lens x  > is not known; correct it");
        assert_eq!(Fault { fix: String::new(), ..fault }.to_string(), "a.yaml:6: lens x  > is not known");
    }
}
