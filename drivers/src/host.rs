//! The few things asked of the operating system.
#![allow(unsafe_code)]

use std::sync::atomic::{AtomicBool, Ordering};

/// Work that may wait, in the order in which it is served after reading the sensors and odometry: the nice value of its
/// threads. What is not recorded in time is lost, what is not mapped in time comes later.
#[derive(Clone, Copy, Debug)]
pub enum Waits {
    Recording = 5,
    Mapping = 10,
}

/// Makes the calling thread yield to others. Threads it starts from then on inherit it:
/// a Vulkan device opened by such a thread renders on the CPU, where it does, behind odometry.
pub fn lower_priority(waits: Waits) {
    // SAFETY: plain integers; `0` means the calling thread. Failing leaves the priority as it was.
    unsafe {
        libc::setpriority(libc::PRIO_PROCESS, 0, waits as i32);
    }
}

/// CPU time, s: of the program, and of the kernel on its behalf. The kernel knows the sum exactly and divides it by what it
/// met at its ticks, so the parts are worth something after a second or more.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CpuTime {
    pub user_s: f64,
    pub kernel_s: f64,
}

impl CpuTime {
    pub fn total_s(self) -> f64 {
        self.user_s + self.kernel_s
    }
}

impl std::ops::Sub for CpuTime {
    type Output = CpuTime;
    fn sub(self, other: CpuTime) -> CpuTime {
        CpuTime { user_s: self.user_s - other.user_s, kernel_s: self.kernel_s - other.kernel_s }
    }
}

/// Of the calling thread so far.
pub fn thread_cpu() -> CpuTime {
    // SAFETY: a struct of integers may be zero, and outlives the call; the calling thread can always be asked for.
    let used = unsafe {
        let mut used: libc::rusage = std::mem::zeroed();
        libc::getrusage(libc::RUSAGE_THREAD, &mut used);
        used
    };
    let secs = |t: libc::timeval| t.tv_sec as f64 + t.tv_usec as f64 * 1e-6;
    CpuTime { user_s: secs(used.ru_utime), kernel_s: secs(used.ru_stime) }
}

/// CLOCK_MONOTONIC, in which drivers stamp frames and edges.
pub fn monotonic() -> crate::Nanos {
    let mut t = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: `t` outlives the call; the clock exists on every Linux.
    unsafe { libc::clock_gettime(libc::CLOCK_MONOTONIC, &mut t) };
    crate::Nanos(t.tv_sec * 1_000_000_000 + t.tv_nsec)
}

/// From now on a write that nobody reads any more ends the program quietly, as it does others; Rust would panic.
pub fn end_when_unread() {
    // SAFETY: sets the signal's own default action; no handler of ours is involved.
    unsafe {
        libc::signal(libc::SIGPIPE, libc::SIG_DFL);
    }
}

static STOP: AtomicBool = AtomicBool::new(false);

extern "C" fn ask_to_stop(_signal: libc::c_int) {
    STOP.store(true, Ordering::Relaxed);
}

/// From the first call on SIGINT and SIGTERM set this flag and end nothing; the second of a kind ends the program as
/// it would have without.
pub fn stop_asked_for() -> &'static AtomicBool {
    // SAFETY: the handler does nothing but store to an atomic, which a signal may do. The struct is plain integers, for
    // which zero is valid.
    unsafe {
        let mut action: libc::sigaction = std::mem::zeroed();
        action.sa_sigaction = ask_to_stop as extern "C" fn(libc::c_int) as usize;
        action.sa_flags = libc::SA_RESETHAND | libc::SA_RESTART;
        for signal in [libc::SIGINT, libc::SIGTERM] {
            libc::sigaction(signal, &action, std::ptr::null_mut());
        }
    }
    &STOP
}

/// What can be written below `at`, bytes.
pub fn disk_free(at: &std::path::Path) -> Option<u64> {
    let path = std::ffi::CString::new(at.as_os_str().as_encoded_bytes()).ok()?;
    // SAFETY: plain integers, for which zero is valid; `path` and `s` outlive the call.
    let (asked, s) = unsafe {
        let mut s: libc::statvfs = std::mem::zeroed();
        (libc::statvfs(path.as_ptr(), &mut s), s)
    };
    (asked == 0).then(|| s.f_bavail * s.f_frsize)
}

/// Memory that can be had without swapping, bytes.
pub fn memory_available() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|l| l.strip_prefix("MemAvailable:"))?;
    Some(line.split_whitespace().next()?.parse::<u64>().ok()? * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    #[test]
    fn what_the_system_does_not_know_is_none() {
        assert!(disk_free(Path::new("/tmp")).is_some_and(|bytes| bytes > 0));
        assert_eq!([disk_free(Path::new("/no/such/folder")), disk_free(Path::new("/tmp\0"))], [None; 2]);
        assert!(memory_available().is_some_and(|bytes| bytes > 0));
    }
}
