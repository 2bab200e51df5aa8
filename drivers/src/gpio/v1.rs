//! The part of <gpiod.h> of libgpiod 1 that is used: a line belongs to its open chip.

use super::abi::{api, checked, Edge, Handle, Held, Purpose, Wanted, EVENTS};
use crate::types::{Nanos, Span};
use std::ffi::{c_char, c_int, c_uint};

/// `struct gpiod_line_request_config`
#[repr(C)]
pub(super) struct Request {
    consumer: *const c_char,
    request_type: c_int,
    flags: c_int,
}

/// `struct gpiod_line_event`
#[repr(C)]
pub(super) struct Event {
    pub(super) t: libc::timespec,
    pub(super) kind: c_int,
}

const DIRECTION_OUTPUT: c_int = 3;
const EVENT_FALLING: c_int = 4;
const EVENT_RISING: c_int = 5;
const ACTIVE_LOW: c_int = 4;

api! {
    gpiod_chip_open_lookup: fn(*const c_char) -> Handle;
    gpiod_chip_close: fn(Handle);
    gpiod_chip_get_line: fn(Handle, c_uint) -> Handle;
    gpiod_chip_find_line: fn(Handle, *const c_char) -> Handle;
    gpiod_line_request: fn(Handle, *const Request, c_int) -> c_int;
    gpiod_line_set_value: fn(Handle, c_int) -> c_int;
    gpiod_line_event_wait: fn(Handle, *const libc::timespec) -> c_int;
    gpiod_line_event_read_multiple: fn(Handle, *mut Event, c_uint) -> c_int;
}

/// A requested line. Closing its chip releases it.
pub(super) struct Line {
    api: &'static Api,
    _chip: Held,
    line: Handle,
}

impl Line {
    pub(super) fn request(api: &'static Api, wanted: &Wanted) -> Result<Line, i32> {
        let (request_type, flags) = match wanted.purpose {
            Purpose::Edges(Edge::Rising) => (EVENT_RISING, 0),
            Purpose::Edges(Edge::Falling) => (EVENT_FALLING, 0),
            Purpose::Output { active_low } => (DIRECTION_OUTPUT, if active_low { ACTIVE_LOW } else { 0 }),
        };
        // SAFETY: a string that outlives the call; the result is checked.
        let chip = unsafe { Held::new((api.gpiod_chip_open_lookup)(wanted.chip.as_ptr()), api.gpiod_chip_close) }?;
        // SAFETY: the chip is open; the string outlives the call; a missing line is null.
        let line = unsafe {
            match wanted.offset {
                Some(offset) => (api.gpiod_chip_get_line)(chip.0, offset),
                None => (api.gpiod_chip_find_line)(chip.0, wanted.line.as_ptr()),
            }
        };
        if line.is_null() {
            return Err(libc::ENOENT);
        }
        let request = Request { consumer: c"stipple".as_ptr(), request_type, flags };
        // SAFETY: the line belongs to the open chip; the request and its string outlive the call.
        checked(unsafe { (api.gpiod_line_request)(line, &request, 0) })?;
        Ok(Line { api, _chip: chip, line })
    }

    pub(super) fn wait(&mut self, timeout: Span) -> Result<c_int, i32> {
        let timeout = libc::timespec { tv_sec: timeout.0 / 1_000_000_000, tv_nsec: timeout.0 % 1_000_000_000 };
        // SAFETY: the line is requested for events; the timeout outlives the call.
        checked(unsafe { (self.api.gpiod_line_event_wait)(self.line, &timeout) })
    }

    pub(super) fn read(&mut self, stamps: &mut [Nanos; EVENTS]) -> Result<usize, i32> {
        const NONE: Event = Event { t: libc::timespec { tv_sec: 0, tv_nsec: 0 }, kind: 0 };
        let mut events = [NONE; EVENTS];
        // SAFETY: the line is requested for events; there is room for as many as are asked for.
        let read =
            unsafe { (self.api.gpiod_line_event_read_multiple)(self.line, events.as_mut_ptr(), EVENTS as c_uint) };
        for (stamp, event) in stamps.iter_mut().zip(&events) {
            *stamp = Nanos(event.t.tv_sec * 1_000_000_000 + event.t.tv_nsec);
        }
        Ok((checked(read)? as usize).min(EVENTS))
    }

    pub(super) fn set(&mut self, active: bool) -> Result<c_int, i32> {
        // SAFETY: the line is requested for as long as `self` lives.
        checked(unsafe { (self.api.gpiod_line_set_value)(self.line, c_int::from(active)) })
    }
}
