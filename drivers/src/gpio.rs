//! Single lines of GPIO through libgpiod 1.6, which Debian 12 and JetPack 6 ship: a data-ready input whose edges the kernel
//! stamps, an output that triggers cameras, and one for a status LED. No thread is started here.
//!
//! A chip is chosen by its label, name or path, a line by its name or offset. Offsets of lines are a matter of wiring; the
//! numbers of chips change with the order in which drivers are probed, so a label is the better choice.
//!
//! The kernel stamps edges with `CLOCK_MONOTONIC` since 5.7, in the interrupt. It queues 16 for each line and drops those
//! that come when the queue is full; `imu::edges` finds that out by counting.
#![allow(unsafe_code)]

use crate::host::monotonic;
use crate::imu::edges::{EdgeFault, EdgeQueue, Edges};
use crate::types::{Nanos, Span};
use crate::{Fault, FaultKind};
use serde::{Deserialize, Serialize};
use std::ffi::{c_char, c_int, c_uint, CString};

#[cfg(test)]
mod tests;

/// The part of <gpiod.h>, version 1, that is used.
mod c {
    use super::*;

    #[repr(C)]
    pub(super) struct Chip {
        _private: [u8; 0],
    }

    #[repr(C)]
    pub(super) struct Line {
        _private: [u8; 0],
    }

    /// `struct gpiod_line_request_config`
    #[repr(C)]
    pub(super) struct Request {
        pub(super) consumer: *const c_char,
        pub(super) request_type: c_int,
        pub(super) flags: c_int,
    }

    /// `struct gpiod_line_event`
    #[repr(C)]
    pub(super) struct Event {
        pub(super) t: libc::timespec,
        pub(super) kind: c_int,
    }

    pub(super) const DIRECTION_OUTPUT: c_int = 3;
    pub(super) const EVENT_FALLING: c_int = 4;
    pub(super) const EVENT_RISING: c_int = 5;
    pub(super) const ACTIVE_LOW: c_int = 4;

    /// In tests every call can be made to fail.
    #[cfg(test)]
    pub use super::tests::simulated::*;

    #[cfg(not(test))]
    pub use libc::clock_nanosleep;

    #[cfg(not(test))]
    #[link(name = "gpiod")]
    extern "C" {
        pub(super) fn gpiod_chip_open_lookup(descr: *const c_char) -> *mut Chip;
        pub(super) fn gpiod_chip_close(chip: *mut Chip);
        pub(super) fn gpiod_chip_get_line(chip: *mut Chip, offset: c_uint) -> *mut Line;
        pub(super) fn gpiod_chip_find_line(chip: *mut Chip, name: *const c_char) -> *mut Line;
        pub(super) fn gpiod_line_request(line: *mut Line, config: *const Request, default: c_int) -> c_int;
        pub(super) fn gpiod_line_set_value(line: *mut Line, value: c_int) -> c_int;
        pub(super) fn gpiod_line_event_wait(line: *mut Line, timeout: *const libc::timespec) -> c_int;
        pub(super) fn gpiod_line_event_read_multiple(line: *mut Line, events: *mut Event, count: c_uint) -> c_int;
    }
}

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

/// The edge that means that a sample is ready.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Edge {
    Rising,
    Falling,
}

/// A requested line. Dropping it closes its chip, which releases the line and puts an output back to its hardware default.
struct Line {
    chip: *mut c::Chip,
    line: *mut c::Line,
}

// SAFETY: libgpiod's handles hold file descriptors and no thread's state; only their one owner uses them.
unsafe impl Send for Line {}

fn errno() -> i32 {
    std::io::Error::last_os_error().raw_os_error().unwrap_or(libc::EIO)
}

fn c_string(text: &str) -> Result<CString, i32> {
    CString::new(text).map_err(|_| libc::EINVAL)
}

impl Line {
    fn request(name: &LineName, kind: c_int, flags: c_int) -> Result<Line, i32> {
        let (chip_name, line_name) = (c_string(&name.chip)?, c_string(&name.line)?);
        // SAFETY: a string that outlives the call; the result is checked.
        let chip = unsafe { c::gpiod_chip_open_lookup(chip_name.as_ptr()) };
        if chip.is_null() {
            return Err(errno());
        }
        // From here on dropping it closes the chip.
        let mut found = Line { chip, line: std::ptr::null_mut() };
        // SAFETY: the chip is open; strings outlive the calls; a missing line is null.
        found.line = unsafe {
            match name.line.parse() {
                Ok(offset) => c::gpiod_chip_get_line(chip, offset),
                Err(_) => c::gpiod_chip_find_line(chip, line_name.as_ptr()),
            }
        };
        if found.line.is_null() {
            return Err(libc::ENOENT);
        }
        let request = c::Request { consumer: c"stipple".as_ptr(), request_type: kind, flags };
        // SAFETY: the line belongs to the open chip; the request and its string outlive the call.
        match unsafe { c::gpiod_line_request(found.line, &request, 0) } {
            ..0 => Err(errno()),
            _ => Ok(found),
        }
    }
}

impl Drop for Line {
    fn drop(&mut self) {
        // SAFETY: it was opened and nobody else closes it; this releases the line too, after which nothing uses it.
        unsafe { c::gpiod_chip_close(self.chip) }
    }
}

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
    name: LineName,
    edge: Edge,
}

/// Edges that the kernel queues for one line.
const EVENTS: usize = 16;

impl DataReady {
    /// Requests the line for edges; a fault where it cannot be had.
    pub fn open(name: &LineName, edge: Edge) -> Result<DataReady, Fault> {
        let mut opened = DataReady { line: None, name: name.clone(), edge };
        opened.reopen().map_err(|EdgeFault(errno)| cannot_use(name, errno))?;
        Ok(opened)
    }

    fn line(&self) -> Result<&Line, EdgeFault> {
        self.line.as_ref().ok_or(EdgeFault(libc::ENODEV))
    }
}

impl Edges for DataReady {
    fn wait(&mut self, timeout: Span) -> Result<bool, EdgeFault> {
        let timeout = timespec(timeout.0.max(0));
        // SAFETY: the line is requested for events; the timeout outlives the call.
        match unsafe { c::gpiod_line_event_wait(self.line()?.line, &timeout) } {
            ready @ (0 | 1) => Ok(ready == 1),
            // A signal is no fault.
            _ if errno() == libc::EINTR => Ok(false),
            _ => Err(EdgeFault(errno())),
        }
    }

    fn drain(&mut self, into: &mut EdgeQueue) -> Result<(), EdgeFault> {
        // Reading blocks where there is nothing, so it is asked for first.
        while self.wait(Span(0))? {
            let mut events = [const { c::Event { t: timespec(0), kind: 0 } }; EVENTS];
            // SAFETY: the line is requested for events; there is room for as many as are asked for.
            let read =
                unsafe { c::gpiod_line_event_read_multiple(self.line()?.line, events.as_mut_ptr(), EVENTS as c_uint) };
            if read < 0 {
                return Err(EdgeFault(errno()));
            }
            let now = monotonic();
            for event in &events[..(read as usize).min(EVENTS)] {
                into.push(Nanos(event.t.tv_sec * 1_000_000_000 + event.t.tv_nsec), now);
            }
        }
        Ok(())
    }

    fn reopen(&mut self) -> Result<(), EdgeFault> {
        // The line is busy until the old request is gone.
        self.line = None;
        let kind = if self.edge == Edge::Rising { c::EVENT_RISING } else { c::EVENT_FALLING };
        self.line = Some(Line::request(&self.name, kind, 0).map_err(EdgeFault)?);
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
        let flags = if active_low { c::ACTIVE_LOW } else { 0 };
        let line = Line::request(name, c::DIRECTION_OUTPUT, flags).map_err(|errno| cannot_use(name, errno))?;
        Ok(Output { line, name: name.clone() })
    }

    /// Makes the line active or inactive; a fault where the line is gone.
    pub fn set(&mut self, active: bool) -> Result<(), Fault> {
        // SAFETY: the line is requested for as long as `self` lives.
        match unsafe { c::gpiod_line_set_value(self.line.line, c_int::from(active)) } {
            ..0 => Err(cannot_use(&self.name, errno())),
            _ => Ok(()),
        }
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
        while unsafe { c::clock_nanosleep(libc::CLOCK_MONOTONIC, libc::TIMER_ABSTIME, &due, std::ptr::null_mut()) }
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
