//! Single lines of GPIO through libgpiod, version 1 or 2 as the machine has it: a data-ready input whose edges the kernel
//! stamps, an output that triggers cameras, and one for a status LED. No thread is started here.
//!
//! The library is loaded when the first line is opened: what names no line runs without it.
//!
//! A chip is chosen by its label, name or path, a line by its name or offset. Offsets of lines are a matter of wiring; the
//! numbers of chips change with the order in which drivers are probed, so a label is the better choice.
//!
//! The kernel stamps edges with `CLOCK_MONOTONIC` since 5.7, in the interrupt. It queues 16 for each line and drops those
//! that come when the queue is full; `imu::edges` finds that out by counting.
#![allow(unsafe_code)]

mod abi;
mod library;
#[cfg(test)]
mod tests;
mod v1;
mod v2;

use crate::host::monotonic;
use crate::imu::edges::{EdgeFault, EdgeQueue, Edges};
use crate::types::{Nanos, Span};
use crate::{Fault, FaultKind};
pub use abi::Edge;
use abi::{Purpose, Wanted, EVENTS};
use library::{library, Library, Line};
use std::ffi::CString;

#[cfg(not(test))]
use libc::clock_nanosleep;
#[cfg(test)]
use tests::simulated::clock_nanosleep;

/// A line as a board file names it.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct LineName {
    /// Label, name or path of the chip.
    pub chip: String,
    /// Name of the line, or its offset.
    pub line: String,
}

impl std::fmt::Display for LineName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} line {}", self.chip, self.line)
    }
}

impl LineName {
    /// The library and what it is asked for; a fault where there is no library.
    fn wanted(&self, purpose: Purpose) -> Result<(&'static Library, Wanted), Fault> {
        let library = library().map_err(|why| {
            let what = format!("cannot be used: libgpiod cannot be loaded: {why}");
            Fault::new(FaultKind::Unavailable, format!("GPIO {self}"), what, INSTALL)
        })?;
        let text = |text: &str| CString::new(text).map_err(|_| cannot_use(self, libc::EINVAL));
        let offset = self.line.parse().ok();
        Ok((library, Wanted { chip: text(&self.chip)?, line: text(&self.line)?, offset, purpose }))
    }
}

const INSTALL: &str =
    "apt install libgpiod3 (libgpiod2 on Debian 12 and Ubuntu 24.04), or name no GPIO line in the board file";

fn cannot_use(name: &LineName, errno: i32) -> Fault {
    let fix = match errno {
        libc::EBUSY => "another program or driver holds the line: gpioinfo says which",
        libc::EACCES | libc::EPERM => "let the user open /dev/gpiochip* (udev rule, or group gpio)",
        libc::ENOTTY | libc::EINVAL => "name a GPIO chip whose line can do this",
        _ => "gpiodetect and gpioinfo list chips and lines",
    };
    let what = format!("cannot be used: {}", std::io::Error::from_raw_os_error(errno));
    Fault::new(FaultKind::Unavailable, format!("GPIO {name}"), what, fix)
}

/// An input line whose edges say that a sample is ready.
pub struct DataReady {
    /// `None` while it is gone.
    line: Option<Line>,
    library: &'static Library,
    wanted: Wanted,
}

impl DataReady {
    /// Requests the line for edges; a fault where it cannot be had.
    pub fn open(name: &LineName, edge: Edge) -> Result<DataReady, Fault> {
        let (library, wanted) = name.wanted(Purpose::Edges(edge))?;
        let mut opened = DataReady { line: None, library, wanted };
        opened.reopen().map_err(|EdgeFault(errno)| cannot_use(name, errno))?;
        Ok(opened)
    }

    fn line(&mut self) -> Result<&mut Line, EdgeFault> {
        self.line.as_mut().ok_or(EdgeFault(libc::ENODEV))
    }
}

impl Edges for DataReady {
    fn wait(&mut self, timeout: Span) -> Result<bool, EdgeFault> {
        self.line()?.wait(timeout).map_err(EdgeFault)
    }

    fn drain(&mut self, into: &mut EdgeQueue) -> Result<(), EdgeFault> {
        // Reading blocks where there is nothing, so it is asked for first.
        while self.wait(Span(0))? {
            let mut stamps = [Nanos(0); EVENTS];
            let read = self.line()?.read(&mut stamps).map_err(EdgeFault)?;
            let now = monotonic();
            stamps[..read].iter().for_each(|stamp| into.push(*stamp, now));
        }
        Ok(())
    }

    fn reopen(&mut self) -> Result<(), EdgeFault> {
        // The line is busy until the old request is gone.
        self.line = None;
        self.line = Some(Line::request(self.library, &self.wanted).map_err(EdgeFault)?);
        Ok(())
    }
}

/// An instant or a span that is not negative.
const fn timespec(ns: i64) -> libc::timespec {
    libc::timespec { tv_sec: ns / 1_000_000_000, tv_nsec: ns % 1_000_000_000 }
}

/// An output line.
pub struct Output {
    line: Line,
    name: LineName,
}

impl Output {
    /// Requests the line, inactive at first; a fault where it cannot be had.
    pub fn open(name: &LineName, active_low: bool) -> Result<Output, Fault> {
        let (library, wanted) = name.wanted(Purpose::Output { active_low })?;
        let line = Line::request(library, &wanted).map_err(|errno| cannot_use(name, errno))?;
        Ok(Output { line, name: name.clone() })
    }

    /// Makes the line active or inactive; a fault where the line is gone.
    pub fn set(&mut self, active: bool) -> Result<(), Fault> {
        self.line.set(active).map_err(|errno| cannot_use(&self.name, errno))
    }
}

/// Starts the exposures of all cameras that are wired to one line, at a rate without drift. A thread that does nothing else,
/// of the highest priority it can get, calls `wait` and `pulse` in turns.
pub struct Trigger {
    line: Output,
    pulse: Span,
    period: Span,
    due: Nanos,
}

impl Trigger {
    /// Pulses of a length, active on `line`, so many a second from now on.
    pub fn new(line: Output, pulse: Span, rate_hz: f64) -> Trigger {
        let period = Span::from_secs(1.0 / rate_hz);
        Trigger { line, pulse, period, due: monotonic() + period }
    }

    /// Sleeps until the next pulse is due; answers how many were missed, as their periods are over already.
    pub fn wait(&mut self) -> u64 {
        let due = timespec(self.due.0);
        // SAFETY: the instant outlives the call; the remaining time is not asked for.
        while unsafe { clock_nanosleep(libc::CLOCK_MONOTONIC, libc::TIMER_ABSTIME, &due, std::ptr::null_mut()) }
            == libc::EINTR
        {}
        let missed;
        (self.due, missed) = next_due(self.due, self.period, monotonic());
        missed
    }

    /// Gives one pulse now; sleeps for its length. A fault where the line is gone.
    pub fn pulse(&mut self) -> Result<(), Fault> {
        self.line.set(true)?;
        std::thread::sleep(std::time::Duration::from_nanos(self.pulse.0.max(0) as u64));
        self.line.set(false)
    }
}

/// The pulse after one that was due, on the same grid, and how many before it are over already.
fn next_due(due: Nanos, period: Span, now: Nanos) -> (Nanos, u64) {
    let late = (now - due).0.max(0) / period.0.max(1);
    (due + Span(period.0.saturating_mul(late + 1)), late as u64)
}
