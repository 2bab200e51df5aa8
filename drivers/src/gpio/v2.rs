//! The part of <gpiod.h> of libgpiod 2 that is used: a request holds its line, and the chip may be closed.

use super::abi::{api, checked, Edge, Handle, Held, Purpose, Wanted, EVENTS};
use crate::types::{Nanos, Span};
use std::ffi::{c_char, c_int, c_uint, c_ulong, CStr};
use std::io::Write;

const DIRECTION_INPUT: c_int = 2;
const DIRECTION_OUTPUT: c_int = 3;
const EDGE_NONE: c_int = 1;
const EDGE_RISING: c_int = 2;
const EDGE_FALLING: c_int = 3;

api! {
    gpiod_chip_open: fn(*const c_char) -> Handle;
    gpiod_chip_close: fn(Handle);
    gpiod_chip_get_info: fn(Handle) -> Handle;
    gpiod_chip_info_get_label: fn(Handle) -> *const c_char;
    gpiod_chip_info_free: fn(Handle);
    gpiod_chip_get_line_offset_from_name: fn(Handle, *const c_char) -> c_int;
    gpiod_line_settings_new: fn() -> Handle;
    gpiod_line_settings_free: fn(Handle);
    gpiod_line_settings_set_direction: fn(Handle, c_int) -> c_int;
    gpiod_line_settings_set_edge_detection: fn(Handle, c_int) -> c_int;
    gpiod_line_settings_set_active_low: fn(Handle, bool);
    gpiod_line_config_new: fn() -> Handle;
    gpiod_line_config_free: fn(Handle);
    gpiod_line_config_add_line_settings: fn(Handle, *const c_uint, usize, Handle) -> c_int;
    gpiod_request_config_new: fn() -> Handle;
    gpiod_request_config_free: fn(Handle);
    gpiod_request_config_set_consumer: fn(Handle, *const c_char);
    gpiod_chip_request_lines: fn(Handle, Handle, Handle) -> Handle;
    gpiod_line_request_release: fn(Handle);
    gpiod_line_request_set_value: fn(Handle, c_uint, c_int) -> c_int;
    gpiod_line_request_wait_edge_events: fn(Handle, i64) -> c_int;
    gpiod_line_request_read_edge_events: fn(Handle, Handle, usize) -> c_int;
    gpiod_edge_event_buffer_new: fn(usize) -> Handle;
    gpiod_edge_event_buffer_free: fn(Handle);
    gpiod_edge_event_buffer_get_event: fn(Handle, c_ulong) -> Handle;
    gpiod_edge_event_get_timestamp_ns: fn(Handle) -> u64;
}

/// Chips that are looked at for one of a label.
const CHIPS: usize = 64;

impl Api {
    fn open(&self, path: &CStr) -> Result<Held, i32> {
        // SAFETY: a string that outlives the call; the result is checked.
        unsafe { Held::new((self.gpiod_chip_open)(path.as_ptr()), self.gpiod_chip_close) }
    }

    /// The chip of a path, a name, a number or a label: libgpiod 1 looked for it itself.
    fn find(&self, name: &CStr) -> Result<Held, i32> {
        if name.to_bytes().starts_with(b"/") {
            return self.open(name);
        }
        let mut why = libc::ENOENT;
        for number in 0..CHIPS {
            let mut path = [0; 32];
            // It has room for the path and a zero.
            let _ = write!(&mut path[..31], "/dev/gpiochip{number}");
            let path = CStr::from_bytes_until_nul(&path).map_err(|_| libc::EINVAL)?;
            let named = [&b"/dev/gpiochip"[..], b"/dev/"].map(|before| path.to_bytes().strip_prefix(before));
            match self.open(path) {
                Ok(chip) if named.contains(&Some(name.to_bytes())) || self.has_label(&chip, name)? => return Ok(chip),
                Err(errno) if errno != libc::ENOENT => why = errno,
                _ => {}
            }
        }
        Err(why)
    }

    fn has_label(&self, chip: &Held, label: &CStr) -> Result<bool, i32> {
        // SAFETY: the chip is open; its label is a string that lives as long as the information.
        unsafe {
            let info = Held::new((self.gpiod_chip_get_info)(chip.0), self.gpiod_chip_info_free)?;
            Ok(CStr::from_ptr((self.gpiod_chip_info_get_label)(info.0)) == label)
        }
    }
}

/// A requested line.
pub(super) struct Line {
    api: &'static Api,
    request: Held,
    events: Held,
    offset: c_uint,
}

impl Line {
    pub(super) fn request(api: &'static Api, wanted: &Wanted) -> Result<Line, i32> {
        let (direction, edge, active_low) = match wanted.purpose {
            Purpose::Edges(Edge::Rising) => (DIRECTION_INPUT, EDGE_RISING, false),
            Purpose::Edges(Edge::Falling) => (DIRECTION_INPUT, EDGE_FALLING, false),
            Purpose::Output { active_low } => (DIRECTION_OUTPUT, EDGE_NONE, active_low),
        };
        let chip = api.find(&wanted.chip)?;
        // SAFETY: every handle is of the kind that the function wants and not null; strings and the offset outlive the calls.
        // The library copies the settings into the configuration, and the configuration into the request.
        unsafe {
            let offset = match wanted.offset {
                Some(offset) => offset,
                None => checked((api.gpiod_chip_get_line_offset_from_name)(chip.0, wanted.line.as_ptr()))? as c_uint,
            };
            let settings = Held::new((api.gpiod_line_settings_new)(), api.gpiod_line_settings_free)?;
            checked((api.gpiod_line_settings_set_direction)(settings.0, direction))?;
            checked((api.gpiod_line_settings_set_edge_detection)(settings.0, edge))?;
            (api.gpiod_line_settings_set_active_low)(settings.0, active_low);
            let lines = Held::new((api.gpiod_line_config_new)(), api.gpiod_line_config_free)?;
            checked((api.gpiod_line_config_add_line_settings)(lines.0, &offset, 1, settings.0))?;
            let config = Held::new((api.gpiod_request_config_new)(), api.gpiod_request_config_free)?;
            (api.gpiod_request_config_set_consumer)(config.0, c"stipple".as_ptr());
            let request = (api.gpiod_chip_request_lines)(chip.0, config.0, lines.0);
            let request = Held::new(request, api.gpiod_line_request_release)?;
            let events = Held::new((api.gpiod_edge_event_buffer_new)(EVENTS), api.gpiod_edge_event_buffer_free)?;
            Ok(Line { api, request, events, offset })
        }
    }

    pub(super) fn wait(&mut self, timeout: Span) -> Result<c_int, i32> {
        // SAFETY: the line is requested for edges.
        checked(unsafe { (self.api.gpiod_line_request_wait_edge_events)(self.request.0, timeout.0) })
    }

    pub(super) fn read(&mut self, stamps: &mut [Nanos; EVENTS]) -> Result<usize, i32> {
        // SAFETY: the line is requested for edges; the buffer has room for as many as are asked for.
        let read = unsafe { (self.api.gpiod_line_request_read_edge_events)(self.request.0, self.events.0, EVENTS) };
        let read = (checked(read)? as usize).min(EVENTS);
        for (i, stamp) in stamps[..read].iter_mut().enumerate() {
            // SAFETY: as many events were read; each is the buffer's, and not null.
            unsafe {
                let event = (self.api.gpiod_edge_event_buffer_get_event)(self.events.0, i as c_ulong);
                *stamp = Nanos((self.api.gpiod_edge_event_get_timestamp_ns)(event) as i64);
            }
        }
        Ok(read)
    }

    pub(super) fn set(&mut self, active: bool) -> Result<c_int, i32> {
        // SAFETY: the line is requested for as long as `self` lives.
        checked(unsafe { (self.api.gpiod_line_request_set_value)(self.request.0, self.offset, c_int::from(active)) })
    }
}
