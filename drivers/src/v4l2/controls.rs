//! Controls of a camera: exposure in time, everything else by the name that `v4l2-ctl --list-ctrls` gives it. Values are
//! checked against the range that the camera states, and a name it does not have is refused with those it has.

use super::exposure::Exposure;
use super::fault::refused;
use super::kernel::{Kernel, Request};
use super::uapi::*;
use super::Settings;
use crate::types::Span;
use crate::{Fault, FaultKind};

/// Unit of `CID_EXPOSURE_ABSOLUTE`.
const EXPOSURE_UNIT: Span = Span(100_000);
/// Controls that are listed at most: more than any camera has, for a driver whose list never ends.
const CONTROLS_MAX: usize = 512;

/// The controls of an open camera.
pub(super) struct Controls<'a> {
    kernel: &'a dyn Kernel,
    fd: i32,
    /// The camera's name in messages.
    name: &'a str,
    known: Vec<QueryControl>,
}

impl<'a> Controls<'a> {
    pub(super) fn list(kernel: &'a dyn Kernel, fd: i32, name: &'a str) -> Result<Controls<'a>, Fault> {
        let mut known: Vec<QueryControl> = Vec::new();
        let mut last = 0;
        while known.len() < CONTROLS_MAX {
            let mut control = QueryControl { id: last | NEXT_CONTROL, ..Default::default() };
            match kernel.ioctl(fd, Request::QueryControl(&mut control)) {
                Ok(()) if control.id <= last => break,
                Ok(()) => {
                    last = control.id;
                    known.push(control);
                }
                // The end of the list; or a driver without controls.
                Err(e) if matches!(e.raw_os_error(), Some(libc::EINVAL | libc::ENOTTY)) => break,
                Err(e) => return Err(refused(name, "list its controls", "VIDIOC_QUERY_EXT_CTRL", &e)),
            }
        }
        known.retain(|c| c.flags & CONTROL_DISABLED == 0 && CONTROL_NUMBERS.contains(&c.kind));
        Ok(Controls { kernel, fd, name, known })
    }

    /// Sets what the settings ask for; answers the exposure that results, which is followed from then on.
    pub(super) fn apply(&self, settings: &Settings) -> Result<Exposure, Fault> {
        // First of all: a camera that exposes automatically refuses an exposure.
        for (name, value) in &settings.controls {
            let key = format!("camera.controls.{name}");
            let control = self.known.iter().find(|c| label(c) == *name).ok_or_else(|| self.unknown(&key, name))?;
            self.set(&key, control, *value)?;
        }
        let absolute = self.known.iter().find(|c| c.id == CID_EXPOSURE_ABSOLUTE);
        let lines = self.known.iter().find(|c| c.id == CID_EXPOSURE && settings.exposure_line.0 > 0);
        let (control, unit) = match (absolute, lines) {
            (Some(control), _) => (control, EXPOSURE_UNIT),
            (None, Some(control)) => (control, settings.exposure_line),
            (None, None) if settings.exposure.0 == 0 => return Ok(Exposure::unknown()),
            (None, None) => {
                let fix =
                    "state camera.exposure_line_us where it has `exposure` in lines, or leave camera.exposure_us out";
                return Err(self.wrong(format!("cannot set an exposure in time; it has {}", self.names()), fix));
            }
        };
        let auto = self.known.iter().find(|c| c.id == CID_EXPOSURE_AUTO);
        if settings.exposure.0 > 0 {
            if let Some(auto) = auto {
                self.set("camera.exposure_us", auto, EXPOSURE_MANUAL)?;
            }
            let value = (settings.exposure.0 + unit.0 / 2) / unit.0;
            self.set("camera.exposure_us", control, value)?;
        }
        let mut exposure = Exposure::new(control, unit, self.get(control)?);
        let manual = [EXPOSURE_MANUAL, EXPOSURE_SHUTTER_PRIORITY];
        let automatic = auto.map_or(Ok(false), |auto| self.get(auto).map(|mode| !manual.contains(&mode)))?;
        exposure.begin(self.kernel, self.fd, automatic);
        Ok(exposure)
    }

    fn set(&self, key: &str, control: &QueryControl, value: i64) -> Result<(), Fault> {
        let name = label(control);
        let (least, most, step) = (control.minimum, control.maximum, control.step.max(1));
        let off_step = (i128::from(value) - i128::from(least)) % i128::from(step) != 0;
        if value < least || value > most || off_step {
            let what = format!("{key}: `{name}` = {value} is not among {least} to {most} in steps of {step}");
            return Err(self.wrong(what, "change it in the board file"));
        }
        if control.flags & CONTROL_READ_ONLY != 0 {
            return Err(self.wrong(format!("{key}: `{name}` can only be read"), "leave it out of the board file"));
        }
        let purpose = format!("set `{name}` to {value} ({key})");
        let mut asked = ExtControl { id: control.id, size: 0, reserved: 0, value };
        let answer = self.kernel.ioctl(self.fd, Request::SetExtControl(&mut asked));
        answer.map_err(|e| refused(self.name, &purpose, "VIDIOC_S_EXT_CTRLS", &e))
    }

    fn get(&self, control: &QueryControl) -> Result<i64, Fault> {
        let purpose = format!("read `{}`", label(control));
        let mut asked = ExtControl { id: control.id, ..ExtControl::default() };
        let answer = self.kernel.ioctl(self.fd, Request::GetExtControl(&mut asked));
        answer.map_err(|e| refused(self.name, &purpose, "VIDIOC_G_EXT_CTRLS", &e))?;
        Ok(control.number(asked.value))
    }

    fn unknown(&self, key: &str, name: &str) -> Fault {
        self.wrong(format!("{key}: it has no control `{name}`; it has {}", self.names()), "change it in the board file")
    }

    fn names(&self) -> String {
        if self.known.is_empty() {
            return "none".to_string();
        }
        let range = |c: &QueryControl| format!("{} ({} to {})", label(c), c.minimum, c.maximum);
        self.known.iter().map(range).collect::<Vec<_>>().join(", ")
    }

    fn wrong(&self, what: String, fix: &str) -> Fault {
        Fault::new(FaultKind::Config, self.name, what, fix)
    }
}

/// The name as v4l2-ctl writes it: lower case, anything but letters and digits as one underscore.
fn label(control: &QueryControl) -> String {
    let mut label = String::new();
    for c in super::find::text(&control.name).chars() {
        if c.is_ascii_alphanumeric() {
            label.push(c.to_ascii_lowercase());
        } else if !label.is_empty() && !label.ends_with('_') {
            label.push('_');
        }
    }
    label.truncate(label.trim_end_matches('_').len());
    label
}
