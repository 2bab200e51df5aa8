//! One video node, from opening to a stream of buffers. Formats are negotiated strictly: a camera that gives another size or
//! rate than its calibration was made at is of no use. Dropping a node gives everything back to the kernel.

#![allow(unsafe_code)]

use super::colour::{least_bytes_in_colour, Stated};
use super::controls::Controls;
use super::exposure::{Exposure, Followed};
use super::fault::refused;
use super::find::{cannot_open, capabilities, text};
use super::kernel::{Kernel, Request};
use super::offer::{self, code_text};
use super::pixels::{least_bytes, Format, Part};
use super::uapi::*;
use super::Settings;
use crate::types::{Nanos, Span};
use crate::ycbcr::Matrix;
use crate::{Fault, FaultKind};
use std::io;
use std::path::Path;
use std::sync::Arc;

/// Largest relative error of the rate a camera gives: intervals are whole units of 100 ns.
const RATE_TOLERANCE: f64 = 0.01;

/// Buffers that are asked for: four bridge a pause of two frames.
const BUFFERS: u32 = 4;
/// Fewest that will do: one for the driver to fill, one to wait, one to read.
const BUFFERS_MIN: u32 = 3;
/// VIDEO_MAX_FRAME of the kernel.
const BUFFERS_MAX: u32 = 32;

/// What to do about a camera without colour.
pub(super) const NO_COLOUR: &str =
    "set map.colour = false, or camera.format to nv12, yuyv, rggb, grbg, gbrg, bggr or mjpeg where the camera has one";

/// A node that streams.
pub(super) struct Node {
    kernel: Arc<dyn Kernel>,
    /// Descriptor of the open node.
    pub fd: i32,
    /// Path, and the camera's own name, for messages.
    pub name: String,
    /// `CAPTURE` or `CAPTURE_MULTI`.
    kind: u32,
    /// Format of its pictures.
    pub format: Format,
    /// From their YCbCr to RGB.
    pub matrix: Matrix,
    /// The whole picture.
    pub part: Part,
    /// From frame to frame.
    pub period: Span,
    /// The exposure of its newest frame.
    pub exposure: Exposure,
    buffers: Vec<Mapped>,
}

/// A buffer of the kernel's in our memory.
struct Mapped {
    at: *const u8,
    length: usize,
}

// SAFETY: a mapping is memory of the process, not of a thread.
unsafe impl Send for Mapped {}

/// The format that the driver made of the one it was asked for.
struct Set {
    fourcc: u32,
    width: u32,
    height: u32,
    /// Bytes of a row.
    stride: usize,
    /// Most bytes of a picture.
    bytes: usize,
    stated: Stated,
}

/// A filled buffer that we hold, until `Node::give_back` takes it.
pub(super) struct Filled {
    index: u32,
    start: usize,
    bytes: usize,
    /// Number of the frame by the driver's count.
    pub sequence: u32,
    /// Flags of the buffer: clock and event of the stamp.
    pub flags: u32,
    pub stamp_s: i64,
    pub stamp_us: i64,
}

/// The answer of a node to a request for a filled buffer.
pub(super) enum Taken {
    Filled(Filled),
    /// The driver marked the content as damaged; it has the buffer again.
    Corrupt,
    /// The driver reports a lost frame with an error.
    Failed(io::Error),
    Nothing,
}

/// A system call that failed while streaming.
pub(super) struct Failure {
    /// Name of the call in the documentation.
    pub call: &'static str,
    /// What the kernel answered.
    pub error: io::Error,
}

impl Node {
    /// Opens and starts a node whose pictures have `parts` cameras side by side, some of which are read in colour where it is
    /// `coloured`.
    pub(super) fn open(
        kernel: Arc<dyn Kernel>,
        path: &Path,
        (parts, coloured): (usize, bool),
        want: &Settings,
    ) -> Result<Node, Fault> {
        let fd = kernel.open(path).map_err(|e| cannot_open(path, &e))?;
        let part = Part { x: 0, width: want.width * parts, height: want.height, stride: 0 };
        let (name, format) = (path.display().to_string(), Format::Grey);
        let (period, exposure, buffers) = (Span(0), Exposure::unknown(), Vec::new());
        let matrix = Matrix::JFIF;
        let mut node = Node { kernel, fd, name, kind: CAPTURE, format, matrix, part, period, exposure, buffers };
        node.identify()?;
        let least = node.negotiate(want, coloured)?;
        node.period = node.set_rate(want)?;
        node.exposure = Controls::list(&*node.kernel, node.fd, &node.name)?.apply(want)?;
        node.map_buffers(least)?;
        node.start()?;
        Ok(node)
    }

    fn refused(&self, purpose: &str, call: &'static str, e: io::Error) -> Fault {
        refused(&self.name, purpose, call, &e)
    }

    fn ioctl(&self, purpose: &str, request: Request) -> Result<(), Fault> {
        let call = request.name();
        self.kernel.ioctl(self.fd, request).map_err(|e| self.refused(purpose, call, e))
    }

    fn identify(&mut self) -> Result<(), Fault> {
        let mut c = Capability::default();
        self.ioctl("ask what it is", Request::QueryCap(&mut c))?;
        self.name = format!("{} (\"{}\", bus:{})", self.name, text(&c.card), text(&c.bus_info));
        let has = capabilities(&c);
        let single = has & CAP_CAPTURE != 0;
        if has & (CAP_CAPTURE | CAP_CAPTURE_MULTI) == 0 || has & CAP_STREAMING == 0 {
            let what = format!("does not stream video (capabilities {has:#x})");
            return Err(Fault::new(FaultKind::Config, &self.name, what, "name another node in camera.devices"));
        }
        self.kind = if single { CAPTURE } else { CAPTURE_MULTI };
        Ok(())
    }

    /// Sets format and size; answers the least bytes of a picture.
    fn negotiate(&mut self, want: &Settings, coloured: bool) -> Result<usize, Fault> {
        let offers = offer::list(&*self.kernel, self.fd, self.kind)
            .map_err(|(call, e)| self.refused("list its formats", call, e))?;
        let (width, height) = (self.part.width as u32, self.part.height as u32);
        let acceptable = |f: &Format| want.format.is_none_or(|w| w == *f);
        let first = |is: fn(Format, u32) -> bool| {
            let fits = |f: Format| Some((f, offers.iter().find(|o| is(f, o.fourcc) && o.has(width, height))?));
            Format::all().filter(acceptable).find_map(fits)
        };
        // A camera in grey beside one in colour gives luma, too, where it can: tracking compares their levels.
        let in_colour = if want.colours > 0 { first(Format::is_in_colour) } else { None };
        let any = if coloured { None } else { first(Format::is) };
        let Some((format, offered)) = in_colour.or(any) else {
            if coloured {
                return Err(self.not_in_colour(want, &offers));
            }
            let asked = want.format.map_or("a format that can be read", Format::name);
            return Err(self.not_offered(&format!("{asked} at {width}x{height}"), &offers));
        };
        let set = self.set_format(offered.fourcc)?;
        if (set.fourcc, set.width, set.height) != (offered.fourcc, width, height) {
            let got = format!("{} at {}x{}", code_text(set.fourcc), set.width, set.height);
            let asked = format!("{} at {width}x{height}, but {got}", format.name());
            return Err(self.not_offered(&asked, &offers));
        }
        // A driver that leaves the stride out means rows without padding.
        let row_bytes = format.row_bytes(self.part.width);
        self.part.stride = if set.stride == 0 { row_bytes } else { set.stride };
        let least = if coloured { least_bytes_in_colour(format, self.part) } else { least_bytes(format, self.part) };
        if self.part.stride < row_bytes || set.bytes < least {
            let said = format!("says rows of {} bytes and pictures of {}", set.stride, set.bytes);
            return Err(self.at_fault(format!("{said}, too few for {width}x{height}")));
        }
        (self.format, self.matrix) = (format, set.stated.matrix());
        Ok(least)
    }

    fn set_format(&self, fourcc: u32) -> Result<Set, Fault> {
        let (width, height) = (self.part.width as u32, self.part.height as u32);
        if self.kind == CAPTURE {
            let mut f = FormatSingle { kind: CAPTURE, width, height, fourcc, ..Default::default() };
            (f.field, f.private) = (FIELD_NONE, FORMAT_EXTENDED);
            self.ioctl("set its format", Request::SetFormat(&mut f))?;
            let (stride, bytes) = (f.bytes_per_line as usize, f.size_image as usize);
            let stated = Stated { colorspace: f.colorspace, encoding: f.encoding, quantization: f.quantization };
            return Ok(Set { fourcc: f.fourcc, width: f.width, height: f.height, stride, bytes, stated });
        }
        let mut f = FormatMulti { width, height, fourcc, num_planes: 1, ..Default::default() };
        (f.kind, f.field) = (CAPTURE_MULTI, FIELD_NONE);
        self.ioctl("set its format", Request::SetFormatMulti(&mut f))?;
        // The first plane has the luma, or everything.
        let (stride, bytes) = (f.planes[0].bytes_per_line as usize, f.planes[0].size_image as usize);
        let (encoding, quantization) = (f.encoding.into(), f.quantization.into());
        let stated = Stated { colorspace: f.colorspace, encoding, quantization };
        Ok(Set { fourcc: f.fourcc, width: f.width, height: f.height, stride, bytes, stated })
    }

    /// The fault of a camera without a format in colour, or without the one that the board names.
    fn not_in_colour(&self, want: &Settings, offers: &[offer::Offer]) -> Fault {
        let asked = want.format.map_or(String::new(), |f| format!("{} ", f.name()));
        let list = offer::text(&*self.kernel, self.fd, offers);
        let size = format!("{}x{}", self.part.width, self.part.height);
        let separate = offers.iter().any(|o| o.fourcc == u32::from_le_bytes(*b"NM12"));
        let why = if separate { " (colours of NM12 are not read)" } else { "" };
        let what = format!(
            "map.colour = true, but the camera gives no {asked}picture in colour at {size}{why}; it offers {list}"
        );
        Fault::new(FaultKind::Config, &self.name, what, NO_COLOUR)
    }

    fn at_fault(&self, what: String) -> Fault {
        Fault::new(FaultKind::Unavailable, &self.name, what, "its driver is at fault: choose another camera.format")
    }

    fn not_offered(&self, asked: &str, offers: &[offer::Offer]) -> Fault {
        let list = offer::text(&*self.kernel, self.fd, offers);
        let what = format!("does not give {asked}; it offers {list}");
        let fix = "change camera.format, camera.rate_hz or the size, which is the calibration's";
        Fault::new(FaultKind::Config, &self.name, what, fix)
    }

    /// Sets the rate; answers the period of frames. Drivers without rates are triggered, or set elsewhere, and are believed.
    fn set_rate(&self, want: &Settings) -> Result<Span, Fault> {
        let asked = Span::from_secs(1.0 / want.rate_hz);
        let mut p = StreamParm {
            kind: self.kind,
            numerator: 1000,
            denominator: (want.rate_hz * 1000.0).round() as u32,
            ..Default::default()
        };
        match self.kernel.ioctl(self.fd, Request::SetParm(&mut p)) {
            Err(e) if matches!(e.raw_os_error(), Some(libc::ENOTTY | libc::EINVAL)) => return Ok(asked),
            Err(e) => return Err(self.refused("set its rate", "VIDIOC_S_PARM", e)),
            Ok(()) if p.capability & CAP_TIME_PER_FRAME == 0 || p.numerator == 0 || p.denominator == 0 => {
                return Ok(asked)
            }
            Ok(()) => {}
        }
        let period = f64::from(p.numerator) / f64::from(p.denominator);
        if (period * want.rate_hz - 1.0).abs() > RATE_TOLERANCE {
            let offers = offer::list(&*self.kernel, self.fd, self.kind).unwrap_or_default();
            let asked = format!("{} Hz, but {:.3} Hz", want.rate_hz, 1.0 / period);
            return Err(self.not_offered(&asked, &offers));
        }
        Ok(Span::from_secs(period))
    }

    /// Asks for buffers and maps them. A buffer too small for `least` bytes would be read past its end.
    fn map_buffers(&mut self, least: usize) -> Result<(), Fault> {
        let mut r = RequestBuffers { count: BUFFERS, kind: self.kind, memory: MEMORY_MMAP, ..Default::default() };
        self.ioctl("ask for buffers", Request::GetBuffers(&mut r))?;
        if r.count < BUFFERS_MIN {
            let what = format!("the driver gives {} buffers, {BUFFERS_MIN} are needed", r.count);
            let fix = "free memory, or choose another camera.format";
            return Err(Fault::new(FaultKind::Unavailable, &self.name, what, fix));
        }
        for index in 0..r.count.min(BUFFERS_MAX) {
            let (mut b, mut planes) = (self.buffer(index), [Plane::default(); PLANES_MAX]);
            self.ioctl("ask where a buffer is", Request::QueryBuffer(&mut b, &mut planes))?;
            let (place, length) =
                if self.kind == CAPTURE { (b.place, b.length) } else { (planes[0].place, planes[0].length) };
            if (length as usize) < least {
                return Err(self.at_fault(format!("its buffers have {length} bytes, a picture {least}")));
            }
            // Offsets have 32 bits in both kinds of queue; the rest of the field is not the kernel's.
            let offset = i64::from(place as u32);
            let at = self.kernel.map(self.fd, offset, length as usize);
            let at = at.map_err(|e| self.refused("map a buffer", "mmap", e))?;
            self.buffers.push(Mapped { at, length: length as usize });
        }
        Ok(())
    }

    fn start(&mut self) -> Result<(), Fault> {
        for index in 0..self.buffers.len() as u32 {
            self.queue(index).map_err(|f| self.refused("queue a buffer", f.call, f.error))?;
        }
        self.ioctl("start streaming", Request::StreamOn(self.kind))
    }

    fn buffer(&self, index: u32) -> Buffer {
        Buffer { index, kind: self.kind, memory: MEMORY_MMAP, ..Buffer::default() }
    }

    fn queue(&self, index: u32) -> Result<(), Failure> {
        let (mut b, mut planes) = (self.buffer(index), [Plane::default(); PLANES_MAX]);
        let answer = self.kernel.ioctl(self.fd, Request::Queue(&mut b, &mut planes));
        answer.map_err(|error| Failure { call: "VIDIOC_QBUF", error })
    }

    /// Takes the oldest filled buffer. Does not wait.
    pub(super) fn take(&self) -> Result<Taken, Failure> {
        let (mut b, mut planes) = (self.buffer(0), [Plane::default(); PLANES_MAX]);
        match self.kernel.ioctl(self.fd, Request::Dequeue(&mut b, &mut planes)) {
            Ok(()) => {}
            Err(e) if e.raw_os_error() == Some(libc::EAGAIN) => return Ok(Taken::Nothing),
            Err(e) if e.raw_os_error() == Some(libc::EIO) => return Ok(Taken::Failed(e)),
            Err(error) => return Err(Failure { call: "VIDIOC_DQBUF", error }),
        }
        let Some(mapped) = self.buffers.get(b.index as usize) else {
            return Err(Failure { call: "VIDIOC_DQBUF", error: io::Error::other("names a buffer that there is not") });
        };
        if b.flags & BUFFER_ERROR != 0 {
            self.queue(b.index)?;
            return Ok(Taken::Corrupt);
        }
        let (start, end) = match self.kind {
            CAPTURE => (0, b.bytes_used as usize),
            _ => (planes[0].data_offset as usize, planes[0].bytes_used as usize),
        };
        let end = end.min(mapped.length);
        let start = start.min(end);
        let (stamp_s, stamp_us) = (b.stamp_s, b.stamp_us);
        let (index, bytes) = (b.index, end - start);
        Ok(Taken::Filled(Filled { index, start, bytes, sequence: b.sequence, flags: b.flags, stamp_s, stamp_us }))
    }

    /// Brings the exposure to the frame that is stamped so. One system call at most, which does not wait.
    pub(super) fn follow_exposure(&mut self, stamp: Nanos) -> Followed {
        self.exposure.follow(&*self.kernel, self.fd, stamp)
    }

    /// The bytes that the camera wrote.
    pub(super) fn bytes<'a>(&'a self, filled: &'a Filled) -> &'a [u8] {
        let mapped = &self.buffers[filled.index as usize];
        // SAFETY: `start + bytes` is at most the mapping's length (`take`), the mapping lives as long as the node, and the
        // kernel does not write to a buffer it does not have: `filled` is consumed when it is given back.
        unsafe { std::slice::from_raw_parts(mapped.at.add(filled.start), filled.bytes) }
    }

    pub(super) fn give_back(&self, filled: Filled) -> Result<(), Failure> {
        self.queue(filled.index)
    }

    /// Most buffers that we may hold while the driver still has two to fill.
    pub(super) fn held_max(&self) -> usize {
        self.buffers.len().saturating_sub(2).max(1)
    }
}

impl Drop for Node {
    /// A device that is gone refuses these; closing the descriptor does the same, so their answers say nothing.
    fn drop(&mut self) {
        let _ = self.kernel.ioctl(self.fd, Request::StreamOff(self.kind));
        for b in self.buffers.drain(..) {
            // SAFETY: `at` and `length` are those of `map`; slices of it borrow the node and are gone.
            unsafe { self.kernel.unmap(b.at, b.length) };
        }
        let mut none = RequestBuffers { count: 0, kind: self.kind, memory: MEMORY_MMAP, ..Default::default() };
        let _ = self.kernel.ioctl(self.fd, Request::GetBuffers(&mut none));
        self.kernel.close(self.fd);
    }
}
