//! Faults of system calls: which call failed on which device, and what to do about it.

use crate::{Fault, FaultKind};
use std::io;

/// The fault of a `call` on `place` that failed; `purpose` completes "cannot".
pub(super) fn refused(place: &str, purpose: &str, call: &str, e: &io::Error) -> Fault {
    let (kind, fix) = remedy(e);
    Fault::new(kind, place, format!("cannot {purpose}: {call}: {e}"), fix)
}

/// Whether the device behind a descriptor is gone.
pub(super) fn is_gone(e: &io::Error) -> bool {
    matches!(e.raw_os_error(), Some(libc::ENODEV | libc::ENXIO | libc::ENOENT))
}

fn remedy(e: &io::Error) -> (FaultKind, &'static str) {
    let fix = match e.raw_os_error() {
        _ if is_gone(e) => "check its cable and power",
        Some(libc::EBUSY) => "another program streams from it (`fuser -v /dev/video*`): stop that",
        Some(libc::EACCES | libc::EPERM) => "add the user to the group `video` (the units in board-configs/ do)",
        Some(libc::ENOMEM) => "the kernel has no memory for its buffers: free some, or lower the cameras' size",
        Some(libc::ENOSPC) => {
            "the bus has no bandwidth left: put the cameras on separate controllers, or lower camera.rate_hz"
        }
        Some(libc::ENOTTY) => "its driver cannot do this: it is not a camera, or needs a newer kernel",
        Some(libc::EMFILE | libc::ENFILE) => "raise the limit of open files (`ulimit -n`)",
        Some(libc::EIO | libc::EPROTO | libc::ETIMEDOUT | libc::EPIPE) => {
            return (FaultKind::Io, "the camera does not answer: check its cable and power, `dmesg` says more")
        }
        Some(libc::EINVAL | libc::ERANGE) => {
            return (FaultKind::Config, "the camera refuses the value: compare [camera] with `v4l2-ctl --all`")
        }
        _ => return (FaultKind::Io, "`dmesg` says more"),
    };
    (FaultKind::Unavailable, fix)
}
