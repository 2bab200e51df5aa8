//! What the program asks of the operating system: priority, clocks, signals, memory and disk.
#![allow(unsafe_code)]

use std::fs::File;
use std::io::{self, Write as _};
use std::os::fd::AsRawFd;
use std::os::unix::fs::{FileTypeExt as _, OpenOptionsExt as _};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

/// Raises the calling thread's nice value to `nice` (0 to 19): others are served before it. Threads that it starts from
/// then on inherit the value, those of a Vulkan driver that renders on the CPU included.
pub fn lower_priority(nice: i32) {
    // SAFETY: plain integers; `0` means the calling thread. Failing leaves the priority as it was.
    unsafe {
        libc::setpriority(libc::PRIO_PROCESS, 0, nice);
    }
}

/// CPU time, s, of the program's own code and of the kernel on its behalf. Their sum is exact, as of the thread's last
/// timer tick or switch; how it splits is estimated from what the kernel met at its ticks, so the parts mean something
/// after a second or more.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CpuTime {
    pub user_s: f64,
    pub kernel_s: f64,
}

impl CpuTime {
    /// CPU time in all, s.
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

/// CPU time that the calling thread has used so far. Allocates nothing.
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

/// CPU time that the calling thread has used so far, exact to the call: for the parts of a frame. Allocates nothing.
pub fn thread_cpu_now() -> std::time::Duration {
    let mut t = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: `t` outlives the call; the clock exists on every Linux.
    unsafe { libc::clock_gettime(libc::CLOCK_THREAD_CPUTIME_ID, &mut t) };
    std::time::Duration::new(t.tv_sec as u64, t.tv_nsec as u32)
}

/// Now by `CLOCK_MONOTONIC`, in which the kernel stamps frames, edges and inertial samples.
pub fn monotonic() -> crate::Nanos {
    now(libc::CLOCK_MONOTONIC)
}

/// Now by `CLOCK_MONOTONIC`, by `CLOCK_BOOTTIME`, which goes on in suspend, and by `CLOCK_REALTIME`, since 1970.
pub fn clocks() -> [crate::Nanos; 3] {
    [libc::CLOCK_MONOTONIC, libc::CLOCK_BOOTTIME, libc::CLOCK_REALTIME].map(now)
}

fn now(clock: libc::clockid_t) -> crate::Nanos {
    let mut t = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: `t` outlives the call; the clocks asked for exist on every Linux.
    unsafe { libc::clock_gettime(clock, &mut t) };
    crate::Nanos(t.tv_sec * 1_000_000_000 + t.tv_nsec)
}

/// Makes a write to a closed pipe end the program quietly, as it ends others (`| head`); Rust's default is a panic.
pub fn end_when_unread() {
    // SAFETY: sets the signal's own default action; no handler of ours is involved.
    unsafe {
        libc::signal(libc::SIGPIPE, libc::SIG_DFL);
    }
}

/// Descriptor of standard output.
pub const STDOUT: i32 = 1;
/// Descriptor of standard error.
pub const STDERR: i32 = 2;

/// Device and inode of an open file; `None` where it is closed.
pub fn device_and_inode(fd: i32) -> Option<(u64, u64)> {
    // SAFETY: the struct is plain integers, and a descriptor that is not open makes the call fail.
    unsafe {
        let mut stat: libc::stat = std::mem::zeroed();
        (libc::fstat(fd, &mut stat) == 0).then_some((stat.st_dev, stat.st_ino))
    }
}

/// Whether the process at the other end of a Unix socket is root's, this user's, or in a group that this process is in.
pub fn peer_is_trusted(socket: i32) -> std::io::Result<bool> {
    /// More groups than these count as none.
    const GROUPS: usize = 256;
    let mut peer = libc::ucred { pid: 0, uid: u32::MAX, gid: u32::MAX };
    let (mut theirs, mut ours) = ([u32::MAX; GROUPS], [u32::MAX; GROUPS]);
    let option = |name, to: *mut libc::c_void, bytes: usize| {
        let mut bytes = bytes as libc::socklen_t;
        // SAFETY: `to` is `bytes` long, and any bytes are valid there; a descriptor that is no socket makes the call fail.
        let failed = unsafe { libc::getsockopt(socket, libc::SOL_SOCKET, name, to, &mut bytes) } != 0;
        if failed {
            Err(std::io::Error::last_os_error())
        } else {
            Ok(bytes as usize)
        }
    };
    option(libc::SO_PEERCRED, (&raw mut peer).cast(), size_of_val(&peer))?;
    let bytes = option(libc::SO_PEERGROUPS, theirs.as_mut_ptr().cast(), size_of_val(&theirs)).unwrap_or(0);
    let theirs = &theirs[..bytes / size_of::<u32>()];
    // SAFETY: `ours` has room for as many groups as are asked for; the other two cannot fail.
    let (count, uid, gid) =
        unsafe { (libc::getgroups(GROUPS as i32, ours.as_mut_ptr()), libc::geteuid(), libc::getegid()) };
    let ours = &ours[..usize::try_from(count).unwrap_or(0)];
    let is_ours = |group: &u32| *group == gid || ours.contains(group);
    Ok(peer.uid == 0 || peer.uid == uid || is_ours(&peer.gid) || theirs.iter().any(is_ours))
}

static STOP: AtomicBool = AtomicBool::new(false);

/// Signals that ask a run to stop: from a keyboard, from a service manager, from a terminal that is gone.
const STOP_SIGNALS: [libc::c_int; 3] = [libc::SIGINT, libc::SIGTERM, libc::SIGHUP];

extern "C" fn ask_to_stop(signal: libc::c_int) {
    if STOP.swap(true, Ordering::Relaxed) {
        // SAFETY: both calls may be made in a signal handler. The signal is blocked while its handler runs, and ends the
        // program as soon as it returns.
        unsafe {
            libc::signal(signal, libc::SIG_DFL);
            libc::raise(signal);
        }
    }
}

/// Sets what SIGINT, SIGTERM and SIGHUP do. SIGHUP stays as it is where `nohup`
/// made it ignored, or where it reloads.
fn on_stop_signals(handler: libc::sighandler_t) {
    // SAFETY: the handler is a function that does only what a signal may do, or a constant that ignores the signal. The
    // struct is plain integers, for which zero is valid.
    unsafe {
        let mut action: libc::sigaction = std::mem::zeroed();
        action.sa_sigaction = handler;
        action.sa_flags = libc::SA_RESTART;
        for signal in STOP_SIGNALS {
            let mut before: libc::sigaction = std::mem::zeroed();
            libc::sigaction(signal, std::ptr::null(), &mut before);
            let reloads = ask_to_reload as extern "C" fn(libc::c_int) as usize;
            if signal != libc::SIGHUP || ![libc::SIG_IGN, reloads].contains(&before.sa_sigaction) {
                libc::sigaction(signal, &action, std::ptr::null_mut());
            }
        }
    }
}

/// The flag that SIGINT, SIGTERM and SIGHUP (but see `reload_asked_for`) set, from the first call on, instead of ending the program. A second signal, of
/// any of them, ends it at once.
pub fn stop_asked_for() -> &'static AtomicBool {
    on_stop_signals(ask_to_stop as extern "C" fn(libc::c_int) as usize);
    &STOP
}

static RELOAD: AtomicBool = AtomicBool::new(false);

extern "C" fn ask_to_reload(_: libc::c_int) {
    RELOAD.store(true, Ordering::Relaxed);
}

/// The flag that SIGHUP sets from here on, in the place of the one of `stop_asked_for`.
pub fn reload_asked_for() -> &'static AtomicBool {
    // SAFETY: the handler does only what a signal may do; the struct is plain integers, for which zero is valid.
    unsafe {
        let mut action: libc::sigaction = std::mem::zeroed();
        action.sa_sigaction = ask_to_reload as extern "C" fn(libc::c_int) as usize;
        action.sa_flags = libc::SA_RESTART;
        libc::sigaction(libc::SIGHUP, &action, std::ptr::null_mut());
    }
    &RELOAD
}

/// Makes this process end with the one that started it, `parent`, whatever ends that, and leaves signals that ask to stop to
/// it. Fails where that one has ended already.
pub fn live_with_parent(parent: u32) -> std::io::Result<()> {
    on_stop_signals(libc::SIG_IGN);
    // SAFETY: plain integers.
    let orphan = unsafe {
        libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL);
        libc::getppid() as u32 != parent
    };
    if orphan {
        return Err(std::io::Error::other("its parent has ended"));
    }
    Ok(())
}

/// Asks for real-time priority of the calling thread (SCHED_FIFO, 1 to 99): ordinary threads of all processes wait for it.
/// Threads and processes that it starts are ordinary. Fails where the system does not allow it (`LimitRTPRIO`).
pub fn ask_for_realtime(priority: i32) -> std::io::Result<()> {
    let parameter = libc::sched_param { sched_priority: priority };
    // SAFETY: zero means the calling thread; the struct outlives the call.
    let failed = unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO | libc::SCHED_RESET_ON_FORK, &parameter) };
    if failed == 0 {
        Ok(())
    } else {
        Err(std::io::Error::last_os_error())
    }
}

/// Keeps every page that this process has used, and will use, in memory. Fails where the system does not allow all of it
/// (`LimitMEMLOCK`): under a finite limit each later allocation beyond it would fail.
pub fn lock_memory() -> std::io::Result<()> {
    let mut limit = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
    // SAFETY: the struct outlives the call.
    unsafe { libc::getrlimit(libc::RLIMIT_MEMLOCK, &mut limit) };
    if limit.rlim_cur != libc::RLIM_INFINITY && !may_lock_all() {
        return Err(std::io::Error::other(format!("the limit of locked memory is {} KiB", limit.rlim_cur >> 10)));
    }
    // SAFETY: plain integers.
    let failed = unsafe { libc::mlockall(libc::MCL_CURRENT | libc::MCL_FUTURE | libc::MCL_ONFAULT) };
    if failed == 0 {
        Ok(())
    } else {
        Err(std::io::Error::last_os_error())
    }
}

/// Whether this process has CAP_IPC_LOCK, and with it no limit of locked memory.
fn may_lock_all() -> bool {
    const CAP_IPC_LOCK: u32 = 14;
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let effective = status.lines().find_map(|line| line.strip_prefix("CapEff:"));
    effective.and_then(|hex| u64::from_str_radix(hex.trim(), 16).ok()).is_some_and(|bits| bits >> CAP_IPC_LOCK & 1 == 1)
}

/// Ends the process at once, and runs nothing else: no thread is waited for.
pub fn exit_now(code: i32) -> ! {
    // SAFETY: takes a plain integer and does not return.
    unsafe { libc::_exit(code) }
}

/// Writes to a descriptor without waiting for its reader; answers whether all was taken. A pipe takes up to 4096 bytes whole
/// or not at all; a terminal and a socket may take a part.
pub fn write_now(fd: i32, bytes: &[u8]) -> bool {
    // SAFETY: the bytes outlive the calls.
    let sent = unsafe { libc::send(fd, bytes.as_ptr().cast(), bytes.len(), libc::MSG_DONTWAIT | libc::MSG_NOSIGNAL) };
    if sent >= 0 || io::Error::last_os_error().raw_os_error() != Some(libc::ENOTSOCK) {
        return sent == bytes.len() as isize;
    }
    // A terminal that is ready may have room for a single byte, and another process may fill a pipe between question and write.
    // Opened again, either is ours to make non-blocking.
    // SAFETY: a plain integer.
    let is_terminal = unsafe { libc::isatty(fd) } == 1;
    let place = format!("/proc/self/fd/{fd}");
    if is_terminal || std::fs::metadata(&place).is_ok_and(|m| m.file_type().is_fifo()) {
        let mut options = std::fs::OpenOptions::new();
        options.write(true).custom_flags(libc::O_NONBLOCK | libc::O_NOCTTY);
        if let Ok(mut file) = options.open(place) {
            return file.write_all(bytes).is_ok();
        }
    }
    // That of another user, as behind `su`, cannot be opened: a terminal that holds nothing back has room for a line.
    let mut waiting = 0;
    // SAFETY: the integer outlives the call.
    let mut is_empty = || unsafe { libc::ioctl(fd, libc::TIOCOUTQ, &mut waiting) == 0 && waiting == 0 };
    let has_room = if is_terminal { is_empty() } else { is_writable(fd, 0) };
    // SAFETY: the bytes outlive the call.
    has_room && unsafe { libc::write(fd, bytes.as_ptr().cast(), bytes.len()) == bytes.len() as isize }
}

/// Columns of the terminal that a descriptor is; 80 where it is none.
pub fn columns(fd: i32) -> u16 {
    let mut size = libc::winsize { ws_row: 0, ws_col: 0, ws_xpixel: 0, ws_ypixel: 0 };
    // SAFETY: the struct outlives the call.
    unsafe { libc::ioctl(fd, libc::TIOCGWINSZ, &mut size) };
    if size.ws_col == 0 {
        80
    } else {
        size.ws_col
    }
}

/// Whether a descriptor takes a few hundred bytes within `wait_ms`. One whose reader is gone takes them: writing fails.
pub fn is_writable(fd: i32, wait_ms: i32) -> bool {
    is_ready(fd, libc::POLLOUT, wait_ms)
}

/// Whether a descriptor has something to read, or its end, within `wait_ms`.
pub fn is_readable(fd: i32, wait_ms: i32) -> bool {
    is_ready(fd, libc::POLLIN, wait_ms)
}

fn is_ready(fd: i32, events: i16, wait_ms: i32) -> bool {
    let mut asked = libc::pollfd { fd, events, revents: 0 };
    // SAFETY: one struct, which outlives the call.
    unsafe { libc::poll(&mut asked, 1, wait_ms) == 1 }
}

/// Locks a file or folder against other processes that lock it, until it is closed. Fails where one has.
pub fn lock(file: &std::fs::File) -> std::io::Result<()> {
    use std::os::fd::AsRawFd;
    // SAFETY: the descriptor is open.
    let failed = unsafe { libc::flock(file.as_raw_fd(), libc::LOCK_EX | libc::LOCK_NB) };
    if failed == 0 {
        Ok(())
    } else {
        Err(std::io::Error::last_os_error())
    }
}

/// Whether another process is stopped (SIGSTOP), and its resident set, bytes; `None` where there is no such process.
pub fn stopped_and_resident(pid: u32) -> Option<(bool, u64)> {
    let text = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The name, in parentheses, may hold anything; fields after it are numbered from 3.
    let fields: Vec<&str> = text.rsplit_once(')')?.1.split_whitespace().collect();
    let (state, pages): (&str, u64) = (fields.first()?, fields.get(21)?.parse().ok()?);
    // SAFETY: plain integers.
    let page = unsafe { libc::sysconf(libc::_SC_PAGESIZE) };
    Some((matches!(state, "T" | "t"), pages * page as u64))
}

/// Bytes that can still be written below the folder `at`; `None` where there is no such folder.
pub fn disk_free(at: &Path) -> Option<u64> {
    let path = std::ffi::CString::new(at.as_os_str().as_encoded_bytes()).ok()?;
    // SAFETY: plain integers, for which zero is valid; `path` and `s` outlive the call.
    let (asked, s) = unsafe {
        let mut s: libc::statvfs = std::mem::zeroed();
        (libc::statvfs(path.as_ptr(), &mut s), s)
    };
    (asked == 0).then(|| s.f_bavail * s.f_frsize)
}

/// Writes the entries of the folder that holds `path` to the disk: until then a power cut may undo a new name. A file
/// system that knows no such thing is no failure.
pub fn sync_folder_of(path: &Path) -> io::Result<()> {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    match File::open(folder)?.sync_all() {
        Err(e) if matches!(e.kind(), io::ErrorKind::InvalidInput | io::ErrorKind::Unsupported) => Ok(()),
        done => done,
    }
}

/// Writes everything that waits for the disk of an open file to it: in one go, where there are many small files.
pub fn sync_disk_of(file: &File) -> io::Result<()> {
    // SAFETY: an open file, borrowed for the call.
    match unsafe { libc::syncfs(file.as_raw_fd()) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

/// Memory that can be had without swapping, bytes; `None` where /proc is absent.
pub fn memory_available() -> Option<u64> {
    proc_bytes("/proc/meminfo", "MemAvailable:")
}

/// Largest resident set of this process so far, bytes; `None` where /proc is absent.
pub fn rss_peak_bytes() -> Option<u64> {
    proc_bytes("/proc/self/status", "VmHWM:")
}

/// The resident set of this process now.
pub fn rss_bytes() -> Option<u64> {
    proc_bytes("/proc/self/status", "VmRSS:")
}

/// A value that a file of /proc gives in KiB, in bytes.
fn proc_bytes(file: &str, key: &str) -> Option<u64> {
    let text = std::fs::read_to_string(file).ok()?;
    let kib = text.lines().find_map(|line| line.strip_prefix(key))?.split_whitespace().next()?;
    Some(kib.parse::<u64>().ok()? * 1024)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::time::{Duration, Instant};

    #[test]
    fn what_the_system_does_not_know_is_none() {
        assert!(disk_free(Path::new("/tmp")).is_some_and(|bytes| bytes > 0));
        assert_eq!([disk_free(Path::new("/no/such/folder")), disk_free(Path::new("/tmp\0"))], [None; 2]);
        assert!(memory_available().is_some_and(|bytes| bytes > 0));
    }

    #[test]
    fn peak_resident_set_grows_with_touched_memory() {
        let before = rss_peak_bytes().unwrap();
        let touched = std::hint::black_box(vec![1u8; 64 << 20]);
        let after = rss_peak_bytes().unwrap();
        assert!(after >= before && after >= touched.len() as u64, "{before} {after}");
    }

    #[test]
    fn sleeping_costs_no_cpu_time_and_spinning_does() {
        let start = thread_cpu();
        std::thread::sleep(Duration::from_millis(60));
        let slept = (thread_cpu() - start).total_s();
        while (thread_cpu() - start).total_s() < 0.05 {
            std::hint::black_box(Instant::now());
        }
        assert!(slept < 0.04, "{slept}");
    }
}
