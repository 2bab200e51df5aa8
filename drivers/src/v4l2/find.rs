//! Finds the node of a camera that the board file names. Numbers of nodes change with the order in which devices are found, so
//! a camera is named by the serial number of its USB device, by its place on the bus, or by a link that udev keeps; never by
//! /dev/videoN.

use super::fault::refused;
use super::kernel::{Kernel, Listed, Request};
use super::uapi::*;
use crate::{Fault, FaultKind};
use std::path::{Path, PathBuf};

/// A camera as a board file names it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Select {
    /// `serial:0001`: the serial number of the USB device.
    Serial(String),
    /// `bus:usb-xhci-hcd.1-2`, as `v4l2-ctl --list-devices` writes it.
    Bus(String),
    /// `path:/dev/v4l/by-path/...`, or any other link.
    Path(PathBuf),
}

impl Select {
    /// Parses a name; an error says what is wrong with it.
    pub fn parse(text: &str) -> Result<Select, String> {
        let how = "write serial:NUMBER, bus:INFO or path:/dev/v4l/by-path/LINK (`v4l2-ctl --list-devices` shows them)";
        match text.split_once(':') {
            Some((_, "")) | None => Err(format!("\"{text}\" names no camera: {how}")),
            Some(("serial", serial)) => Ok(Select::Serial(serial.to_string())),
            Some(("bus", bus)) => Ok(Select::Bus(bus.to_string())),
            Some(("path", path)) if !path.starts_with('/') => Err(format!("\"{path}\" is no absolute path: {how}")),
            Some(("path", path)) => {
                let name = path.rsplit('/').next().unwrap_or_default();
                let number = name.strip_prefix("video").is_some_and(|n| n.bytes().all(|b| b.is_ascii_digit()));
                if number {
                    return Err(format!("\"{path}\" is a number that changes with every boot: {how}"));
                }
                Ok(Select::Path(path.into()))
            }
            Some((kind, _)) => Err(format!("\"{kind}:\" is unknown: {how}")),
        }
    }
}

impl std::fmt::Display for Select {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Select::Serial(serial) => write!(f, "serial:{serial}"),
            Select::Bus(bus) => write!(f, "bus:{bus}"),
            Select::Path(path) => write!(f, "path:{}", path.display()),
        }
    }
}

/// A node that may be the camera.
#[derive(Clone, Debug)]
struct Candidate {
    listed: Listed,
    card: String,
    bus: String,
    captures: bool,
}

impl std::fmt::Display for Candidate {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} (\"{}\", bus:{}", self.listed.path.display(), self.card, self.bus)?;
        if let Some(serial) = &self.listed.serial {
            write!(f, ", serial:{serial}")?;
        }
        write!(f, ")")
    }
}

/// The path of the one node that captures video and has this name.
pub(super) fn find(kernel: &dyn Kernel, select: &Select) -> Result<PathBuf, Fault> {
    if let Select::Path(path) = select {
        return Ok(path.clone());
    }
    let nodes = kernel.nodes().map_err(|e| refused("/sys/class/video4linux", "list the cameras", "readdir", &e))?;
    let (mut seen, mut silent) = (Vec::new(), None);
    for listed in nodes {
        match ask(kernel, &listed) {
            Ok(candidate) if candidate.captures => seen.push(candidate),
            // A node for metadata beside the camera's.
            Ok(_) => {}
            Err(fault) => silent = Some(fault),
        }
    }
    let fits = |c: &&Candidate| match select {
        Select::Serial(serial) => c.listed.serial.as_ref() == Some(serial),
        Select::Bus(bus) => c.bus == *bus,
        Select::Path(_) => false,
    };
    let found: Vec<&Candidate> = seen.iter().filter(fits).collect();
    match (found.as_slice(), silent) {
        ([one], _) => Ok(one.listed.path.clone()),
        // The node that could not be asked may be the one.
        ([], Some(fault)) => Err(fault),
        ([], None) => {
            let list: Vec<String> = seen.iter().map(Candidate::to_string).collect();
            let list = if list.is_empty() { "there is none".to_string() } else { list.join(", ") };
            Err(no_camera(select, format!("no such camera; {list}")))
        }
        (several, _) => {
            let list: Vec<String> = several.iter().map(|c| c.to_string()).collect();
            let what = format!("{} nodes fit: {}", several.len(), list.join(", "));
            Err(Fault::new(FaultKind::Config, select.to_string(), what, "name one by path:/dev/v4l/by-path/LINK"))
        }
    }
}

/// The fault of a camera that is not there.
fn no_camera(select: &Select, what: String) -> Fault {
    let fix = "check its cable and power, and camera.devices in the board file";
    Fault::new(FaultKind::Unavailable, select.to_string(), what, fix)
}

fn ask(kernel: &dyn Kernel, listed: &Listed) -> Result<Candidate, Fault> {
    let fd = kernel.open(&listed.path).map_err(|e| cannot_open(&listed.path, &e))?;
    let mut capability = Capability::default();
    let answer = kernel.ioctl(fd, Request::QueryCap(&mut capability));
    kernel.close(fd);
    let place = listed.path.display().to_string();
    answer.map_err(|e| refused(&place, "ask what it is", "VIDIOC_QUERYCAP", &e))?;
    let captures = capabilities(&capability) & (CAP_CAPTURE | CAP_CAPTURE_MULTI) != 0;
    Ok(Candidate { listed: listed.clone(), card: text(&capability.card), bus: text(&capability.bus_info), captures })
}

pub(super) fn cannot_open(path: &Path, e: &std::io::Error) -> Fault {
    refused(&path.display().to_string(), "open the camera", "open", e)
}

/// The capabilities of the node, not all of its device's.
pub(super) fn capabilities(c: &Capability) -> u32 {
    if c.capabilities & CAP_DEVICE_CAPS != 0 {
        c.device_caps
    } else {
        c.capabilities
    }
}

/// A string of the kernel's, which ends with a zero byte.
pub(super) fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|b| *b == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(&bytes[..end]).into_owned()
}
