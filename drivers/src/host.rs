//! The few things asked of the operating system.
#![allow(unsafe_code)]

/// Makes the calling thread yield to others (nice 10). Threads it starts from then on inherit it:
/// a Vulkan device opened by such a thread renders on the CPU, where it does, behind odometry.
pub fn lower_priority() {
    const NICE: i32 = 10;
    // SAFETY: plain integers; `0` means the calling thread. Failing leaves the priority as it was.
    unsafe {
        libc::setpriority(libc::PRIO_PROCESS, 0, NICE);
    }
}

/// CLOCK_MONOTONIC, in which drivers stamp frames and edges.
pub fn monotonic() -> crate::Nanos {
    let mut t = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: `t` outlives the call; the clock exists on every Linux.
    unsafe { libc::clock_gettime(libc::CLOCK_MONOTONIC, &mut t) };
    crate::Nanos(t.tv_sec * 1_000_000_000 + t.tv_nsec)
}
