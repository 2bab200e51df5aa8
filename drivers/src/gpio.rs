//! Single lines of GPIO through libgpiod 1.6, which Debian 12 and JetPack 6 ship: a data-ready input whose edges the
//! kernel stamps, an output that triggers cameras, and one for a status LED. No thread is started here.
//!
//! A chip is chosen by its label, name or path, a line by its name or offset. Line offsets stay as they are wired;
//! chip numbers change with the order in which drivers are probed, so a label is the better choice.
//!
//! The kernel stamps edges with `CLOCK_MONOTONIC` since 5.7, in the interrupt. It queues 16 a line and drops those
//! that come when the queue is full; `imu::edges` finds that out by counting.
#![allow(unsafe_code)]

use crate::host::monotonic;
use crate::imu::edges::{EdgeFault, EdgeQueue, Edges};
use crate::types::{Nanos, Span};
use crate::{Fault, FaultKind};
use serde::{Deserialize, Serialize};
use std::ffi::{c_char, c_int, c_uint, CString};

/// What is used of <gpiod.h>, version 1.
mod c {
    use super::*;

    #[repr(C)]
    pub struct Chip {
        _private: [u8; 0],
    }

    #[repr(C)]
    pub struct Line {
        _private: [u8; 0],
    }

    /// `struct gpiod_line_request_config`
    #[repr(C)]
    pub struct Request {
        pub consumer: *const c_char,
        pub request_type: c_int,
        pub flags: c_int,
    }

    /// `struct gpiod_line_event`
    #[repr(C)]
    pub struct Event {
        pub t: libc::timespec,
        pub kind: c_int,
    }

    pub const DIRECTION_OUTPUT: c_int = 3;
    pub const EVENT_FALLING: c_int = 4;
    pub const EVENT_RISING: c_int = 5;
    pub const ACTIVE_LOW: c_int = 4;

    /// In tests every call can be made to fail.
    #[cfg(test)]
    pub use super::simulated::*;

    #[cfg(not(test))]
    pub use libc::clock_nanosleep;

    #[cfg(not(test))]
    #[link(name = "gpiod")]
    extern "C" {
        pub fn gpiod_chip_open_lookup(descr: *const c_char) -> *mut Chip;
        pub fn gpiod_chip_close(chip: *mut Chip);
        pub fn gpiod_chip_get_line(chip: *mut Chip, offset: c_uint) -> *mut Line;
        pub fn gpiod_chip_find_line(chip: *mut Chip, name: *const c_char) -> *mut Line;
        pub fn gpiod_line_request(line: *mut Line, config: *const Request, default: c_int) -> c_int;
        pub fn gpiod_line_get_value(line: *mut Line) -> c_int;
        pub fn gpiod_line_set_value(line: *mut Line, value: c_int) -> c_int;
        pub fn gpiod_line_event_wait(line: *mut Line, timeout: *const libc::timespec) -> c_int;
        pub fn gpiod_line_event_read_multiple(line: *mut Line, events: *mut Event, count: c_uint) -> c_int;
    }
}

/// A line, as a board file names it.
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

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Edge {
    Rising,
    Falling,
}

/// A requested line. Closing the chip releases it, and puts an output back to what the hardware makes of it.
struct Line {
    name: LineName,
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
    fn request(name: &LineName, kind: c_int, flags: c_int, value: bool) -> Result<Line, i32> {
        let (chip_name, line_name) = (c_string(&name.chip)?, c_string(&name.line)?);
        // SAFETY: a string that outlives the call; the result is checked.
        let chip = unsafe { c::gpiod_chip_open_lookup(chip_name.as_ptr()) };
        if chip.is_null() {
            return Err(errno());
        }
        // From here on dropping it closes the chip.
        let mut found = Line { name: name.clone(), chip, line: std::ptr::null_mut() };
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
        let done = unsafe { c::gpiod_line_request(found.line, &request, c_int::from(value)) };
        if done < 0 {
            Err(errno())
        } else {
            Ok(found)
        }
    }

    fn open(name: &LineName, kind: c_int, flags: c_int, value: bool) -> Result<Line, Fault> {
        Line::request(name, kind, flags, value).map_err(|errno| cannot_open(name, errno))
    }

    fn get(&self) -> Result<bool, i32> {
        // SAFETY: the line is requested for as long as `self` lives.
        let value = unsafe { c::gpiod_line_get_value(self.line) };
        if value < 0 {
            Err(errno())
        } else {
            Ok(value == 1)
        }
    }

    fn set(&self, value: bool) -> Result<(), i32> {
        // SAFETY: as above.
        let done = unsafe { c::gpiod_line_set_value(self.line, c_int::from(value)) };
        if done < 0 {
            Err(errno())
        } else {
            Ok(())
        }
    }
}

impl Drop for Line {
    fn drop(&mut self) {
        // SAFETY: it was opened and nobody else closes it; this releases the line too, after which nothing uses it.
        unsafe { c::gpiod_chip_close(self.chip) }
    }
}

fn cannot_open(name: &LineName, errno: i32) -> Fault {
    let fix = match errno {
        libc::EBUSY => "another program or driver holds the line: gpioinfo says which",
        libc::EACCES | libc::EPERM => "let the user open /dev/gpiochip* (udev rule, or group gpio)",
        libc::ENOTTY | libc::EINVAL => "name a GPIO chip whose line can do this",
        _ => "gpiodetect and gpioinfo list chips and lines",
    };
    let what = format!("cannot be used: {}", std::io::Error::from_raw_os_error(errno));
    Fault::new(FaultKind::Unavailable, format!("GPIO {name}"), what, fix)
}

/// An input whose edges mean that a sample is ready.
pub struct DataReady {
    /// None while it is gone.
    line: Option<Line>,
    name: LineName,
    edge: Edge,
}

/// What the kernel queues of one line.
const EVENTS: usize = 16;

impl DataReady {
    pub fn open(name: &LineName, edge: Edge) -> Result<DataReady, Fault> {
        let mut opened = DataReady { line: None, name: name.clone(), edge };
        opened.reopen().map_err(|EdgeFault(errno)| cannot_open(name, errno))?;
        Ok(opened)
    }

    fn line(&self) -> Result<&Line, EdgeFault> {
        self.line.as_ref().ok_or(EdgeFault(libc::ENODEV))
    }
}

impl Edges for DataReady {
    fn wait(&mut self, timeout: Span) -> Result<bool, EdgeFault> {
        let ns = timeout.0.max(0);
        let timeout = libc::timespec { tv_sec: ns / 1_000_000_000, tv_nsec: ns % 1_000_000_000 };
        // SAFETY: the line is requested for events; the timeout outlives the call.
        match unsafe { c::gpiod_line_event_wait(self.line()?.line, &timeout) } {
            ready @ (0 | 1) => Ok(ready == 1),
            // A signal is no fault.
            _ if errno() == libc::EINTR => Ok(false),
            _ => Err(EdgeFault(errno())),
        }
    }

    fn drain(&mut self, into: &mut EdgeQueue) -> Result<(), EdgeFault> {
        // Reading blocks where there is nothing: asked for first.
        while self.wait(Span(0))? {
            let mut events = [const { c::Event { t: libc::timespec { tv_sec: 0, tv_nsec: 0 }, kind: 0 } }; EVENTS];
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
        self.line = Some(Line::request(&self.name, kind, 0, false).map_err(EdgeFault)?);
        Ok(())
    }
}

/// An output line.
pub struct Output(Line);

impl Output {
    /// Inactive at first.
    pub fn open(name: &LineName, active_low: bool) -> Result<Output, Fault> {
        let flags = if active_low { c::ACTIVE_LOW } else { 0 };
        Ok(Output(Line::open(name, c::DIRECTION_OUTPUT, flags, false)?))
    }

    pub fn set(&mut self, active: bool) -> Result<(), Fault> {
        self.0.set(active).map_err(|errno| cannot_open(&self.0.name, errno))
    }

    /// What the line carries.
    pub fn get(&self) -> Result<bool, Fault> {
        self.0.get().map_err(|errno| cannot_open(&self.0.name, errno))
    }
}

/// When a pulse began, and by how much that may be wrong: the time that setting the line took.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fired {
    pub at: Nanos,
    pub within: Span,
}

impl Fired {
    /// Middle of an exposure that starts with the pulse: the stamp of the frame it takes.
    pub fn mid_exposure(&self, exposure: Span) -> Nanos {
        self.at + Span(exposure.0 / 2)
    }
}

/// Starts exposures of all cameras wired to one line, at a rate without drift. `wait` and `pulse` are for a thread
/// that does nothing else, of the highest priority it can get: `loop { trigger.wait(); trigger.pulse()? }`. The
/// daemon lists it among its threads; nothing here starts one.
pub struct Trigger {
    line: Output,
    pulse: Span,
    period: Span,
    due: Nanos,
    /// Periods that were over before their pulse.
    pub missed: u64,
}

impl Trigger {
    pub fn new(line: Output, pulse: Span, rate_hz: f64) -> Trigger {
        let period = Span::from_secs(1.0 / rate_hz);
        Trigger { line, pulse, period, due: monotonic() + period, missed: 0 }
    }

    /// Sleeps until the next pulse is due.
    pub fn wait(&mut self) {
        let due = libc::timespec { tv_sec: self.due.0 / 1_000_000_000, tv_nsec: self.due.0 % 1_000_000_000 };
        // SAFETY: the instant outlives the call; the remaining time is not asked for.
        while unsafe { c::clock_nanosleep(libc::CLOCK_MONOTONIC, libc::TIMER_ABSTIME, &due, std::ptr::null_mut()) }
            == libc::EINTR
        {}
        let missed;
        (self.due, missed) = next_due(self.due, self.period, monotonic());
        self.missed += missed;
    }

    /// One pulse, now; sleeps for its length.
    pub fn pulse(&mut self) -> Result<Fired, Fault> {
        let before = monotonic();
        self.line.set(true)?;
        let within = monotonic() - before;
        std::thread::sleep(std::time::Duration::from_nanos(self.pulse.0.max(0) as u64));
        self.line.set(false)?;
        Ok(Fired { at: before + Span(within.0 / 2), within: Span(within.0 / 2) })
    }
}

/// The pulse after one that was due: on the same grid, those that are over left out and counted.
fn next_due(due: Nanos, period: Span, now: Nanos) -> (Nanos, u64) {
    let late = (now - due).0.max(0) / period.0.max(1);
    (due + Span(period.0.saturating_mul(late + 1)), late as u64)
}

/// libgpiod on a machine with one chip, of which the named call fails as it is told. The real one: drivers/tests/gpio.rs
/// and, on the kernel's own simulated chip, tests/hil.
#[cfg(test)]
mod simulated {
    use super::c::{Chip, Event, Line, Request};
    use super::*;
    use std::cell::{Cell, RefCell};
    use std::ptr::{null_mut, NonNull};

    thread_local! {
        /// Which call fails, with which error.
        pub static FAILS: Cell<(&'static str, i32)> = const { Cell::new(("", 0)) };
        pub static OPEN: Cell<usize> = const { Cell::new(0) };
        pub static LEVELS: RefCell<Vec<c_int>> = const { RefCell::new(Vec::new()) };
        /// Stamps, ns, of edges that are waiting.
        pub static WAITING: RefCell<Vec<i64>> = const { RefCell::new(Vec::new()) };
        /// Signals that are to come while it sleeps.
        pub static SIGNALS: Cell<u32> = const { Cell::new(0) };
    }

    fn fails(call: &str) -> bool {
        let (struck, errno) = FAILS.get();
        // SAFETY: the errno of this thread.
        unsafe { *libc::__errno_location() = errno };
        struck == call
    }

    fn answer(call: &str, good: c_int) -> c_int {
        if fails(call) {
            -1
        } else {
            good
        }
    }

    fn pointer<T>(call: &str) -> *mut T {
        if fails(call) {
            null_mut()
        } else {
            NonNull::dangling().as_ptr()
        }
    }

    pub unsafe fn clock_nanosleep(
        clock: libc::clockid_t,
        flags: c_int,
        due: *const libc::timespec,
        left: *mut libc::timespec,
    ) -> c_int {
        match SIGNALS.get() {
            // SAFETY: as the caller has it.
            0 => unsafe { libc::clock_nanosleep(clock, flags, due, left) },
            n => {
                SIGNALS.set(n - 1);
                libc::EINTR
            }
        }
    }

    pub unsafe fn gpiod_chip_open_lookup(_: *const c_char) -> *mut Chip {
        let chip: *mut Chip = pointer("open");
        OPEN.set(OPEN.get() + usize::from(!chip.is_null()));
        chip
    }

    pub unsafe fn gpiod_chip_close(_: *mut Chip) {
        OPEN.set(OPEN.get() - 1);
    }

    pub unsafe fn gpiod_chip_get_line(_: *mut Chip, _: c_uint) -> *mut Line {
        pointer("get line")
    }

    pub unsafe fn gpiod_chip_find_line(_: *mut Chip, _: *const c_char) -> *mut Line {
        pointer("find line")
    }

    pub unsafe fn gpiod_line_request(_: *mut Line, _: *const Request, level: c_int) -> c_int {
        LEVELS.with_borrow_mut(|l| l.push(level));
        answer("request", 0)
    }

    pub unsafe fn gpiod_line_get_value(_: *mut Line) -> c_int {
        answer("get", LEVELS.with_borrow(|l| l.last().copied().unwrap_or(0)))
    }

    pub unsafe fn gpiod_line_set_value(_: *mut Line, level: c_int) -> c_int {
        // The one that lets go can fail by itself.
        let done = answer(if level == 0 { "clear" } else { "set" }, 0);
        if done == 0 {
            LEVELS.with_borrow_mut(|l| l.push(level));
        }
        done
    }

    pub unsafe fn gpiod_line_event_wait(_: *mut Line, _: *const libc::timespec) -> c_int {
        answer("wait", c_int::from(WAITING.with_borrow(|w| !w.is_empty())))
    }

    pub unsafe fn gpiod_line_event_read_multiple(_: *mut Line, events: *mut Event, count: c_uint) -> c_int {
        let n = WAITING.with_borrow_mut(|w| {
            let n = w.len().min(count as usize);
            for (i, t) in w.drain(..n).enumerate() {
                let t = libc::timespec { tv_sec: t / 1_000_000_000, tv_nsec: t % 1_000_000_000 };
                // SAFETY: the caller has room for `count` events.
                unsafe { events.add(i).write(Event { t, kind: 1 }) };
            }
            n
        });
        answer("read", n as c_int)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::simulated::{FAILS, LEVELS, OPEN, SIGNALS, WAITING};
    use super::*;

    const ERRNOS: [i32; 8] =
        [libc::EACCES, libc::EBUSY, libc::EINVAL, libc::EIO, libc::ENODEV, libc::ENOENT, libc::ENOTTY, libc::EPERM];

    fn line(chip: &str, line: &str) -> LineName {
        LineName { chip: chip.into(), line: line.into() }
    }

    #[test]
    fn every_error_of_every_call_of_opening_is_said_and_leaves_nothing_open() {
        for errno in ERRNOS {
            for (call, name) in [("open", "3"), ("get line", "3"), ("find line", "LED"), ("request", "3")] {
                FAILS.set((call, errno));
                let (input, output) =
                    (DataReady::open(&line("chip", name), Edge::Falling), Output::open(&line("chip", name), true));
                for fault in [input.map(|_| ()).unwrap_err(), output.map(|_| ()).unwrap_err()] {
                    let said = if call.ends_with("line") { libc::ENOENT } else { errno };
                    assert!(fault.to_string().contains(&std::io::Error::from_raw_os_error(said).to_string()));
                    assert!(fault.place == format!("GPIO chip line {name}") && !fault.fix.is_empty(), "{fault}");
                }
                assert_eq!(OPEN.get(), 0, "{call}");
            }
        }
        assert!(Output::open(&line("a\0b", "3"), false).is_err(), "a name with a zero byte");
    }

    #[test]
    fn every_error_of_an_input_is_a_value_and_a_signal_is_none() {
        let mut input = DataReady::open(&line("chip", "3"), Edge::Rising).unwrap();
        let mut queue = EdgeQueue::default();
        for errno in ERRNOS {
            FAILS.set(("wait", errno));
            assert_eq!((input.wait(Span(1)), input.drain(&mut queue)), (Err(EdgeFault(errno)), Err(EdgeFault(errno))));
            WAITING.with_borrow_mut(|w| *w = vec![monotonic().0]);
            FAILS.set(("read", errno));
            assert_eq!(input.drain(&mut queue), Err(EdgeFault(errno)));
            FAILS.set(("request", errno));
            assert_eq!(input.reopen(), Err(EdgeFault(errno)));
            assert_eq!((input.wait(Span(0)), OPEN.get()), (Err(EdgeFault(libc::ENODEV)), 0));
            FAILS.set(("", 0));
            assert_eq!((input.reopen(), OPEN.get()), (Ok(()), 1));
        }
        FAILS.set(("wait", libc::EINTR));
        assert_eq!(input.wait(Span(1)), Ok(false));
        FAILS.set(("", 0));
        // More than one read takes.
        WAITING.with_borrow_mut(|w| *w = (0..EVENTS as i64 + 3).map(|i| monotonic().0 - 1000 + i).collect());
        assert_eq!(
            (input.drain(&mut queue), queue.stamps().len(), input.wait(Span(0))),
            (Ok(()), EVENTS + 3, Ok(false))
        );
    }

    #[test]
    fn every_error_of_an_output_is_said_and_the_next_pulse_is_tried() {
        let mut trigger = Trigger::new(Output::open(&line("chip", "3"), false).unwrap(), Span(1000), 1000.0);
        for errno in ERRNOS {
            for call in ["set", "clear"] {
                FAILS.set((call, errno));
                let said = trigger.pulse().unwrap_err().to_string();
                assert!(said.starts_with("GPIO chip line 3"), "{said}");
            }
            FAILS.set(("get", errno));
            assert!(trigger.line.get().is_err());
            FAILS.set(("", 0));
            trigger.wait();
            assert!(trigger.pulse().is_ok_and(|fired| fired.within >= Span(0)) && trigger.line.get() == Ok(false));
            assert!(LEVELS.with_borrow(|l| l.ends_with(&[1, 0])), "high, then low");
        }
        drop(trigger);
        assert_eq!(OPEN.get(), 0);
    }

    #[test]
    fn a_signal_does_not_bring_a_pulse_forward() {
        let mut trigger = Trigger::new(Output::open(&line("chip", "3"), false).unwrap(), Span(1000), 50.0);
        let due = trigger.due;
        SIGNALS.set(3);
        trigger.wait();
        assert!(SIGNALS.get() == 0 && monotonic() >= due);
    }

    #[test]
    fn every_errno_says_what_to_do() {
        let fix = |errno| cannot_open(&line("chip", "3"), errno).fix;
        assert!(fix(libc::EBUSY).contains("gpioinfo says which"));
        assert!(fix(libc::EACCES).contains("udev"));
        assert!(fix(libc::ENOTTY).contains("can do this"));
        assert!(fix(libc::ENOENT).contains("gpioinfo list"));
    }

    #[test]
    fn pulses_keep_their_grid_however_late_one_is() {
        let (due, missed) = next_due(Nanos(100), Span(50), Nanos(103));
        assert_eq!((due, missed), (Nanos(150), 0));
        let (due, missed) = next_due(Nanos(100), Span(50), Nanos(260));
        assert_eq!((due, missed), (Nanos(300), 3), "150, 200 and 250 are over");
        assert_eq!(next_due(Nanos(100), Span(50), Nanos(40)).0, Nanos(150));
    }

    #[test]
    fn frames_are_stamped_in_the_middle_of_their_exposure() {
        let fired = Fired { at: Nanos(1_000), within: Span(5) };
        assert_eq!(fired.mid_exposure(Span(600)), Nanos(1_300));
    }
}
