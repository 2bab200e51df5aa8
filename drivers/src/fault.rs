//! The one error type of boot and of input: what is wrong, where, why, and what to do.
//! It prints as one line and carries the sysexits code the program ends with.

use std::fmt;
use std::path::Path;

/// Exit codes of `sysexits.h`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Exit {
    Usage = 64,
    /// Input data is malformed.
    Data = 65,
    /// An input file or folder does not exist or cannot be read.
    NoInput = 66,
    /// A needed service or device is missing (no Vulkan device).
    Unavailable = 69,
    Software = 70,
    /// An output cannot be created.
    CantCreate = 73,
    Io = 74,
    /// A board or calibration file is wrong.
    Config = 78,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Fault {
    pub exit: Exit,
    /// File, file:line, or key.
    pub place: String,
    pub what: String,
    /// What to do about it.
    pub fix: String,
}

impl Fault {
    pub fn new(exit: Exit, place: impl Into<String>, what: impl Into<String>, fix: impl Into<String>) -> Fault {
        Fault { exit, place: place.into(), what: what.into(), fix: fix.into() }
    }

    pub fn at(exit: Exit, path: &Path, line: usize, what: impl Into<String>, fix: impl Into<String>) -> Fault {
        Fault::new(exit, format!("{}:{line}", path.display()), what, fix)
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.place, self.what)?;
        if !self.fix.is_empty() {
            write!(f, "; {}", self.fix)?;
        }
        Ok(())
    }
}

impl std::error::Error for Fault {}
