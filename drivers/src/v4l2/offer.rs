//! The formats, sizes and rates that a camera offers: as a list to choose from, and as a line to read.

use super::kernel::{Kernel, Request};
use super::pixels::Format;
use super::uapi::*;
use std::io;

/// Most entries of one list, for a driver whose list never ends. The kernel's own virtual camera has 93 formats.
const ENTRIES_MAX: u32 = 256;

/// One format that a camera offers.
pub(super) struct Offer {
    /// Code of the format.
    pub fourcc: u32,
    /// Empty where the driver does not list them: then any may be asked for.
    sizes: Vec<FrameSize>,
}

impl Offer {
    pub(super) fn has(&self, width: u32, height: u32) -> bool {
        self.sizes.is_empty() || self.sizes.iter().any(|s| size_has(s, width, height))
    }
}

fn size_has(s: &FrameSize, width: u32, height: u32) -> bool {
    let e = s.extent;
    if s.kind == SIZE_DISCRETE {
        return (e[0], e[1]) == (width, height);
    }
    let on = |v: u32, least: u32, most: u32, step: u32| (least..=most).contains(&v) && (v - least) % step.max(1) == 0;
    on(width, e[0], e[1], e[2]) && on(height, e[3], e[4], e[5])
}

/// The call that failed, and its error.
type Refusal = (&'static str, io::Error);

/// The formats and sizes of a queue of this kind.
pub(super) fn list(kernel: &dyn Kernel, fd: i32, kind: u32) -> Result<Vec<Offer>, Refusal> {
    let mut offers = Vec::new();
    for index in 0..ENTRIES_MAX {
        let mut f = FormatDescription { index, kind, ..Default::default() };
        if ended("VIDIOC_ENUM_FMT", kernel.ioctl(fd, Request::EnumFormat(&mut f)))? {
            break;
        }
        let mut sizes = Vec::new();
        for index in 0..ENTRIES_MAX {
            let mut s = FrameSize { index, fourcc: f.fourcc, ..Default::default() };
            if ended("VIDIOC_ENUM_FRAMESIZES", kernel.ioctl(fd, Request::EnumSize(&mut s)))? {
                break;
            }
            let range = s.kind != SIZE_DISCRETE;
            sizes.push(s);
            if range {
                break;
            }
        }
        offers.push(Offer { fourcc: f.fourcc, sizes });
    }
    Ok(offers)
}

/// Whether a list has ended, or the driver has none.
fn ended(call: &'static str, answer: io::Result<()>) -> Result<bool, Refusal> {
    match answer {
        Ok(()) => Ok(false),
        Err(e) if matches!(e.raw_os_error(), Some(libc::EINVAL | libc::ENOTTY)) => Ok(true),
        Err(e) => Err((call, e)),
    }
}

/// "GREY 752x480 at 20, 10 Hz; YUYV 640x480 at 30 Hz; H264": sizes and rates of the formats that can be read. It is written
/// after something else was refused, so whatever the driver does not answer is left out.
pub(super) fn text(kernel: &dyn Kernel, fd: i32, offers: &[Offer]) -> String {
    let mut entries = Vec::new();
    for offer in offers {
        let name = code_text(offer.fourcc);
        let readable = Format::all().any(|f| f.is(offer.fourcc));
        if offer.sizes.is_empty() || !readable {
            entries.push(name.clone());
        }
        for s in offer.sizes.iter().filter(|_| readable) {
            let e = s.extent;
            if s.kind == SIZE_DISCRETE {
                let rates = rates(kernel, fd, offer.fourcc, e[0], e[1]);
                entries.push(format!("{name} {}x{}{rates}", e[0], e[1]));
            } else {
                entries.push(format!("{name} {}x{} to {}x{} in steps of {}x{}", e[0], e[3], e[1], e[4], e[2], e[5]));
            }
        }
    }
    if entries.is_empty() {
        return "nothing".to_string();
    }
    entries.join("; ")
}

fn rates(kernel: &dyn Kernel, fd: i32, fourcc: u32, width: u32, height: u32) -> String {
    let mut rates = Vec::new();
    for index in 0..ENTRIES_MAX {
        let mut i = FrameInterval { index, fourcc, width, height, ..Default::default() };
        if kernel.ioctl(fd, Request::EnumInterval(&mut i)).is_err() {
            break;
        }
        // Numerator and denominator of seconds.
        let hz = |n: usize| f64::from(i.interval[n + 1]) / f64::from(i.interval[n].max(1));
        if i.kind == SIZE_DISCRETE {
            rates.push(rounded(hz(0)));
        } else {
            rates.push(format!("{} to {}", rounded(hz(2)), rounded(hz(0))));
            break;
        }
    }
    if rates.is_empty() {
        return String::new();
    }
    format!(" at {} Hz", rates.join(", "))
}

fn rounded(hz: f64) -> String {
    let text = format!("{hz:.2}");
    text.trim_end_matches('0').trim_end_matches('.').to_string()
}

/// The text of a format's code, such as "GREY"; what is no letter becomes a dot.
pub(super) fn code_text(fourcc: u32) -> String {
    let letters = fourcc.to_le_bytes().map(|b| if b.is_ascii_graphic() || b == b' ' { b as char } else { '.' });
    letters.iter().collect::<String>().trim_end().to_string()
}
