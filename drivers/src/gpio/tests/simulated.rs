//! libgpiod, of either version, on a machine with one chip, of which the named call fails as it is told. The real one: on
//! the kernel's own simulated chip, tests/hil; how it is loaded: drivers/tests/gpio.rs.
#![cfg(test)]

use super::super::abi::Handle;
use super::super::library::Library;
use super::super::v1::{self, Event, Request};
use super::super::v2;
use std::cell::{Cell, RefCell};
use std::ffi::{c_char, c_int, c_uint, c_ulong, CStr};
use std::ptr::{null_mut, NonNull};

thread_local! {
    /// Which call fails, with which error.
    pub static FAILS: Cell<(&'static str, i32)> = const { Cell::new(("", 0)) };
    /// Version of the library; 0 where there is none.
    pub static VERSION: Cell<u32> = const { Cell::new(1) };
    /// Objects of the library that were not given back.
    pub static OPEN: Cell<usize> = const { Cell::new(0) };
    pub static LEVELS: RefCell<Vec<c_int>> = const { RefCell::new(Vec::new()) };
    /// Stamps, ns, of edges that are waiting.
    pub static WAITING: RefCell<Vec<i64>> = const { RefCell::new(Vec::new()) };
    /// Signals that are to come while it sleeps.
    pub static SIGNALS: Cell<u32> = const { Cell::new(0) };
    /// Stamps of the edges that version 2 read last, ns.
    static READ: RefCell<Vec<i64>> = const { RefCell::new(Vec::new()) };
}

pub fn library() -> Result<&'static Library, &'static str> {
    static LIBRARIES: [Library; 2] = [Library::V1(v1::Api::SIMULATED), Library::V2(v2::Api::SIMULATED)];
    VERSION.get().checked_sub(1).map(|i| &LIBRARIES[i as usize]).ok_or("libgpiod.so.3: not there")
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

/// An object that is given back by `released`.
fn made(call: &str) -> Handle {
    if fails(call) {
        return null_mut();
    }
    OPEN.set(OPEN.get() + 1);
    NonNull::dangling().as_ptr()
}

fn released() {
    OPEN.set(OPEN.get() - 1);
}

/// An object that belongs to another.
fn part(call: &str) -> Handle {
    if fails(call) {
        return null_mut();
    }
    NonNull::dangling().as_ptr()
}

fn set(level: c_int) -> c_int {
    // The one that lets go can fail by itself.
    let done = answer(if level == 0 { "clear" } else { "set" }, 0);
    if done == 0 {
        LEVELS.with_borrow_mut(|l| l.push(level));
    }
    done
}

fn take(count: usize) -> Vec<i64> {
    WAITING.with_borrow_mut(|w| w.drain(..w.len().min(count)).collect())
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

pub unsafe extern "C" fn gpiod_chip_open_lookup(_: *const c_char) -> Handle {
    made("open")
}

pub unsafe extern "C" fn gpiod_chip_close(_: Handle) {
    released();
}

pub unsafe extern "C" fn gpiod_chip_get_line(_: Handle, _: c_uint) -> Handle {
    part("get line")
}

pub unsafe extern "C" fn gpiod_chip_find_line(_: Handle, _: *const c_char) -> Handle {
    part("find line")
}

pub unsafe extern "C" fn gpiod_line_request(_: Handle, _: *const Request, level: c_int) -> c_int {
    LEVELS.with_borrow_mut(|l| l.push(level));
    answer("request", 0)
}

pub unsafe extern "C" fn gpiod_line_set_value(_: Handle, level: c_int) -> c_int {
    set(level)
}

pub unsafe extern "C" fn gpiod_line_event_wait(_: Handle, _: *const libc::timespec) -> c_int {
    answer("wait", c_int::from(WAITING.with_borrow(|w| !w.is_empty())))
}

pub unsafe extern "C" fn gpiod_line_event_read_multiple(_: Handle, events: *mut Event, count: c_uint) -> c_int {
    let stamps = take(count as usize);
    for (i, t) in stamps.iter().enumerate() {
        let t = libc::timespec { tv_sec: t / 1_000_000_000, tv_nsec: t % 1_000_000_000 };
        // SAFETY: the caller has room for `count` events.
        unsafe { events.add(i).write(Event { t, kind: 1 }) };
    }
    answer("read", stamps.len() as c_int)
}

/// Version 2 from here on. The one chip is the third.
pub unsafe extern "C" fn gpiod_chip_open(path: *const c_char) -> Handle {
    // SAFETY: a string of the caller's.
    if unsafe { CStr::from_ptr(path) } == c"/dev/gpiochip2" {
        return made("open");
    }
    // SAFETY: the errno of this thread.
    unsafe { *libc::__errno_location() = libc::ENOENT };
    null_mut()
}

pub unsafe extern "C" fn gpiod_chip_get_info(_: Handle) -> Handle {
    made("information")
}

pub unsafe extern "C" fn gpiod_chip_info_get_label(_: Handle) -> *const c_char {
    c"chip".as_ptr()
}

pub unsafe extern "C" fn gpiod_chip_info_free(_: Handle) {
    released();
}

pub unsafe extern "C" fn gpiod_chip_get_line_offset_from_name(_: Handle, _: *const c_char) -> c_int {
    answer("find offset", 3)
}

pub unsafe extern "C" fn gpiod_line_settings_new() -> Handle {
    made("settings")
}

pub unsafe extern "C" fn gpiod_line_settings_free(_: Handle) {
    released();
}

pub unsafe extern "C" fn gpiod_line_settings_set_direction(_: Handle, _: c_int) -> c_int {
    answer("direction", 0)
}

pub unsafe extern "C" fn gpiod_line_settings_set_edge_detection(_: Handle, _: c_int) -> c_int {
    answer("edge", 0)
}

pub unsafe extern "C" fn gpiod_line_settings_set_active_low(_: Handle, _: bool) {}

pub unsafe extern "C" fn gpiod_line_config_new() -> Handle {
    made("lines")
}

pub unsafe extern "C" fn gpiod_line_config_free(_: Handle) {
    released();
}

pub unsafe extern "C" fn gpiod_line_config_add_line_settings(
    _: Handle,
    _: *const c_uint,
    _: usize,
    _: Handle,
) -> c_int {
    answer("add", 0)
}

pub unsafe extern "C" fn gpiod_request_config_new() -> Handle {
    made("configuration")
}

pub unsafe extern "C" fn gpiod_request_config_free(_: Handle) {
    released();
}

pub unsafe extern "C" fn gpiod_request_config_set_consumer(_: Handle, _: *const c_char) {}

pub unsafe extern "C" fn gpiod_chip_request_lines(_: Handle, _: Handle, _: Handle) -> Handle {
    LEVELS.with_borrow_mut(|l| l.push(0));
    made("request")
}

pub unsafe extern "C" fn gpiod_line_request_release(_: Handle) {
    released();
}

pub unsafe extern "C" fn gpiod_line_request_set_value(_: Handle, _: c_uint, level: c_int) -> c_int {
    set(level)
}

pub unsafe extern "C" fn gpiod_line_request_wait_edge_events(_: Handle, _: i64) -> c_int {
    answer("wait", c_int::from(WAITING.with_borrow(|w| !w.is_empty())))
}

pub unsafe extern "C" fn gpiod_line_request_read_edge_events(_: Handle, _: Handle, count: usize) -> c_int {
    let stamps = take(count);
    READ.with_borrow_mut(|read| read.clone_from(&stamps));
    answer("read", stamps.len() as c_int)
}

pub unsafe extern "C" fn gpiod_edge_event_buffer_new(_: usize) -> Handle {
    made("buffer")
}

pub unsafe extern "C" fn gpiod_edge_event_buffer_free(_: Handle) {
    released();
}

/// The event is its place, from 1.
pub unsafe extern "C" fn gpiod_edge_event_buffer_get_event(_: Handle, i: c_ulong) -> Handle {
    std::ptr::without_provenance_mut(i as usize + 1)
}

pub unsafe extern "C" fn gpiod_edge_event_get_timestamp_ns(event: Handle) -> u64 {
    READ.with_borrow(|read| read[event.addr() - 1] as u64)
}
