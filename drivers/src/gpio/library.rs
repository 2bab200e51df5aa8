//! libgpiod, loaded when the first line is named: version 2, or version 1, which have different interfaces.

use super::abi::{Wanted, EVENTS};
use super::{v1, v2};
use crate::types::{Nanos, Span};
#[cfg(not(test))]
use std::sync::OnceLock;

pub(super) enum Library {
    V1(v1::Api),
    V2(v2::Api),
}

/// The library of this machine, or why there is none. The names are those of version 2 and of version 1.
#[cfg(not(test))]
pub(super) fn library() -> Result<&'static Library, &'static str> {
    static LOADED: OnceLock<Result<Library, String>> = OnceLock::new();
    LOADED.get_or_init(|| load(&["libgpiod.so.3", "libgpiod.so.2"])).as_ref().map_err(String::as_str)
}

#[cfg(test)]
pub(super) use super::tests::simulated::library;

/// The first of these libraries that is one; else what was said of each.
pub(super) fn load(names: &[&str]) -> Result<Library, String> {
    let mut said = Vec::new();
    for name in names {
        // SAFETY: libgpiod does nothing when it is loaded.
        let library = match unsafe { libloading::Library::new(name) } {
            // It stays loaded for the life of the program.
            Ok(library) => std::mem::ManuallyDrop::new(library),
            Err(why) => {
                said.push(why.to_string());
                continue;
            }
        };
        // SAFETY: the types are those of <gpiod.h>, and neither version has all the names of the other.
        match unsafe { v2::Api::of(&library).map(Library::V2).or_else(|_| v1::Api::of(&library).map(Library::V1)) } {
            Ok(library) => return Ok(library),
            Err(why) => said.push(why.to_string()),
        }
    }
    Err(said.join("; "))
}

/// A requested line. Dropping it releases the line and puts an output back to its hardware default.
pub(super) enum Line {
    V1(v1::Line),
    V2(v2::Line),
}

// SAFETY: libgpiod's handles hold file descriptors and no thread's state; only their one owner uses them.
unsafe impl Send for Line {}

impl Line {
    pub(super) fn request(library: &'static Library, wanted: &Wanted) -> Result<Line, i32> {
        match library {
            Library::V1(api) => v1::Line::request(api, wanted).map(Line::V1),
            Library::V2(api) => v2::Line::request(api, wanted).map(Line::V2),
        }
    }

    /// Whether an edge is waiting, after at most `timeout`.
    pub(super) fn wait(&mut self, timeout: Span) -> Result<bool, i32> {
        let timeout = Span(timeout.0.max(0));
        let waited = match self {
            Line::V1(line) => line.wait(timeout),
            Line::V2(line) => line.wait(timeout),
        };
        match waited {
            // A signal is no fault.
            Err(libc::EINTR) => Ok(false),
            waited => waited.map(|edges| edges == 1),
        }
    }

    /// Takes the edges that are waiting; blocks where there are none.
    pub(super) fn read(&mut self, stamps: &mut [Nanos; EVENTS]) -> Result<usize, i32> {
        match self {
            Line::V1(line) => line.read(stamps),
            Line::V2(line) => line.read(stamps),
        }
    }

    pub(super) fn set(&mut self, active: bool) -> Result<(), i32> {
        match self {
            Line::V1(line) => line.set(active),
            Line::V2(line) => line.set(active),
        }
        .map(|_| ())
    }
}
