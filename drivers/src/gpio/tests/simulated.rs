//! libgpiod on a machine with one chip, of which the named call fails as it is told. The real one: drivers/tests/gpio.rs
//! and, on the kernel's own simulated chip, tests/hil.
#![cfg(test)]

use super::super::c::{Chip, Event, Line, Request};
use std::cell::{Cell, RefCell};
use std::ffi::{c_char, c_int, c_uint};
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
