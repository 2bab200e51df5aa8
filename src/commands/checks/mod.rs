//! What `doctor` and `calib-check` judge alike: one line a check, with what to do.

mod agreement;
mod coarse;
pub mod gyro;
pub mod rows;

pub use agreement::Follower;

use std::path::Path;
use stipple_drivers::{Fault, FaultKind};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    Ok,
    Warn,
    Fail,
}

/// One line of the answer, and what to do.
#[derive(Clone, Debug, PartialEq)]
pub struct Check {
    pub verdict: Verdict,
    what: String,
    fix: String,
}

impl Check {
    pub fn ok(what: impl Into<String>) -> Check {
        Check { verdict: Verdict::Ok, what: what.into(), fix: String::new() }
    }

    pub fn warn(what: impl Into<String>, fix: impl Into<String>) -> Check {
        Check { verdict: Verdict::Warn, what: what.into(), fix: fix.into() }
    }

    pub fn fail(what: impl Into<String>, fix: impl Into<String>) -> Check {
        Check { verdict: Verdict::Fail, what: what.into(), fix: fix.into() }
    }

    pub fn print(&self) {
        let verdict = match self.verdict {
            Verdict::Ok => "ok",
            Verdict::Warn => "warn",
            Verdict::Fail => "fail",
        };
        println!("{verdict:<6} {}", self.what);
        if !self.fix.is_empty() {
            println!("{:<6} -> {}", "", self.fix);
        }
    }
}

/// An error where a check failed.
pub fn all_passed<'a>(kind: FaultKind, place: &Path, checks: impl Iterator<Item = &'a Check>) -> Result<(), Fault> {
    match checks.filter(|c| c.verdict == Verdict::Fail).count() {
        0 => Ok(()),
        n => {
            let what = format!("{n} check{} failed", if n == 1 { "" } else { "s" });
            Err(Fault::new(kind, place.display().to_string(), what, "see the lines above"))
        }
    }
}
