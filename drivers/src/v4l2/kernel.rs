//! The system calls a camera needs, without any decision. `Linux` makes them; tests answer them with a kernel of their own, so
//! that each call fails with each error it can give.
#![allow(unsafe_code)]

use super::uapi::*;
use crate::types::{Nanos, Span};
use std::ffi::CString;
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

/// One ioctl with its argument.
pub(super) enum Request<'a> {
    QueryCap(&'a mut Capability),
    EnumFormat(&'a mut FormatDescription),
    EnumSize(&'a mut FrameSize),
    EnumInterval(&'a mut FrameInterval),
    SetFormat(&'a mut FormatSingle),
    SetFormatMulti(&'a mut FormatMulti),
    SetParm(&'a mut StreamParm),
    GetBuffers(&'a mut RequestBuffers),
    /// The kernel fills the planes where the buffer belongs to a multi-planar queue.
    QueryBuffer(&'a mut Buffer, &'a mut [Plane; PLANES_MAX]),
    Queue(&'a mut Buffer, &'a mut [Plane; PLANES_MAX]),
    Dequeue(&'a mut Buffer, &'a mut [Plane; PLANES_MAX]),
    StreamOn(u32),
    StreamOff(u32),
    QueryControl(&'a mut QueryControl),
    SetExtControl(&'a mut ExtControl),
    GetExtControl(&'a mut ExtControl),
    SubscribeEvent(&'a mut EventSubscription),
    /// Does not wait: ENOENT where there is none.
    DequeueEvent(&'a mut Event),
}

impl Request<'_> {
    /// The name in the documentation.
    pub(super) fn name(&self) -> &'static str {
        match self {
            Request::QueryCap(_) => "VIDIOC_QUERYCAP",
            Request::EnumFormat(_) => "VIDIOC_ENUM_FMT",
            Request::EnumSize(_) => "VIDIOC_ENUM_FRAMESIZES",
            Request::EnumInterval(_) => "VIDIOC_ENUM_FRAMEINTERVALS",
            Request::SetFormat(_) | Request::SetFormatMulti(_) => "VIDIOC_S_FMT",
            Request::SetParm(_) => "VIDIOC_S_PARM",
            Request::GetBuffers(_) => "VIDIOC_REQBUFS",
            Request::QueryBuffer(..) => "VIDIOC_QUERYBUF",
            Request::Queue(..) => "VIDIOC_QBUF",
            Request::Dequeue(..) => "VIDIOC_DQBUF",
            Request::StreamOn(_) => "VIDIOC_STREAMON",
            Request::StreamOff(_) => "VIDIOC_STREAMOFF",
            Request::QueryControl(_) => "VIDIOC_QUERY_EXT_CTRL",
            Request::SetExtControl(_) => "VIDIOC_S_EXT_CTRLS",
            Request::GetExtControl(_) => "VIDIOC_G_EXT_CTRLS",
            Request::SubscribeEvent(_) => "VIDIOC_SUBSCRIBE_EVENT",
            Request::DequeueEvent(_) => "VIDIOC_DQEVENT",
        }
    }
}

/// A video node of this machine.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Listed {
    /// The node, such as /dev/video0.
    pub path: PathBuf,
    /// Serial number of the USB device behind it.
    pub serial: Option<String>,
}

/// The answer of poll for one descriptor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Ready {
    /// A filled buffer waits.
    pub readable: bool,
    /// POLLERR or POLLHUP: not streaming, or gone.
    pub error: bool,
}

/// System calls: those of Linux, or those of a simulated machine.
pub(super) trait Kernel: Send + Sync {
    /// The video nodes of this machine, by path.
    fn nodes(&self) -> io::Result<Vec<Listed>>;
    fn open(&self, path: &Path) -> io::Result<i32>;
    fn close(&self, fd: i32);
    fn ioctl(&self, fd: i32, request: Request) -> io::Result<()>;
    /// Maps a buffer for reading.
    fn map(&self, fd: i32, offset: i64, length: usize) -> io::Result<*const u8>;
    /// # Safety
    /// `at` and `length` are of one `map`, and nobody reads there any more.
    unsafe fn unmap(&self, at: *const u8, length: usize);
    /// Waits until one of `fds` is ready, `timeout` at most; without any it sleeps.
    fn poll(&self, fds: &[i32], ready: &mut [Ready], timeout: Span) -> io::Result<()>;
    /// CLOCK_MONOTONIC.
    fn now(&self) -> Nanos;
}

/// Most cameras that one call of `poll` waits for.
pub(super) const NODES_MAX: usize = 4;

/// The kernel of this machine.
pub(super) struct Linux;

impl Kernel for Linux {
    fn nodes(&self) -> io::Result<Vec<Listed>> {
        const CLASS: &str = "/sys/class/video4linux";
        let mut nodes = Vec::new();
        let entries = match std::fs::read_dir(CLASS) {
            // Without a driver that makes one there is no such folder.
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(nodes),
            entries => entries?,
        };
        for entry in entries.flatten() {
            if entry.file_name().as_bytes().starts_with(b"video") {
                // `device` is the USB interface; the serial number is of the device that has it.
                let serial = std::fs::read_to_string(entry.path().join("device/../serial")).ok();
                let path = Path::new("/dev").join(entry.file_name());
                nodes.push(Listed { path, serial: serial.map(|s| s.trim().to_string()) });
            }
        }
        nodes.sort_by(|a, b| a.path.cmp(&b.path));
        Ok(nodes)
    }

    fn open(&self, path: &Path) -> io::Result<i32> {
        let path = CString::new(path.as_os_str().as_bytes())?;
        // SAFETY: the path is a string that ends with zero and lives during the call.
        let fd = unsafe { libc::open(path.as_ptr(), libc::O_RDWR | libc::O_NONBLOCK | libc::O_CLOEXEC) };
        checked(fd).map(|()| fd)
    }

    fn close(&self, fd: i32) {
        // SAFETY: closes what `open` gave; the caller forgets it.
        unsafe { libc::close(fd) };
    }

    fn ioctl(&self, fd: i32, request: Request) -> io::Result<()> {
        fn call<T>(fd: i32, number: u32, argument: &mut T) -> io::Result<()> {
            loop {
                // SAFETY: `number` was made from the size of `T` (asserted in uapi), which the kernel reads and writes;
                // addresses inside it (planes, controls) are those of arguments that outlive the call.
                let answer = checked(unsafe { libc::ioctl(fd, libc::c_ulong::from(number) as _, argument as *mut T) });
                match answer {
                    Err(e) if e.raw_os_error() == Some(libc::EINTR) => continue,
                    answer => return answer,
                }
            }
        }
        fn with_planes(fd: i32, number: u32, buffer: &mut Buffer, planes: &mut [Plane; PLANES_MAX]) -> io::Result<()> {
            if buffer.kind == CAPTURE_MULTI {
                buffer.place = planes.as_mut_ptr() as u64;
                buffer.length = PLANES_MAX as u32;
            }
            call(fd, number, buffer)
        }
        fn one_control(fd: i32, number: u32, control: &mut ExtControl) -> io::Result<()> {
            let controls = control as *mut ExtControl as u64;
            call(fd, number, &mut ExtControls { count: 1, controls, ..ExtControls::default() })
        }
        match request {
            Request::QueryCap(a) => call(fd, QUERYCAP, a),
            Request::EnumFormat(a) => call(fd, ENUM_FMT, a),
            Request::EnumSize(a) => call(fd, ENUM_FRAMESIZES, a),
            Request::EnumInterval(a) => call(fd, ENUM_FRAMEINTERVALS, a),
            Request::SetFormat(a) => call(fd, S_FMT, a),
            Request::SetFormatMulti(a) => call(fd, S_FMT, a),
            Request::SetParm(a) => call(fd, S_PARM, a),
            Request::GetBuffers(a) => call(fd, REQBUFS, a),
            Request::QueryBuffer(a, planes) => with_planes(fd, QUERYBUF, a, planes),
            Request::Queue(a, planes) => with_planes(fd, QBUF, a, planes),
            Request::Dequeue(a, planes) => with_planes(fd, DQBUF, a, planes),
            Request::StreamOn(mut kind) => call(fd, STREAMON, &mut kind),
            Request::StreamOff(mut kind) => call(fd, STREAMOFF, &mut kind),
            Request::QueryControl(a) => call(fd, QUERY_EXT_CTRL, a),
            Request::SetExtControl(a) => one_control(fd, S_EXT_CTRLS, a),
            Request::GetExtControl(a) => one_control(fd, G_EXT_CTRLS, a),
            Request::SubscribeEvent(a) => call(fd, SUBSCRIBE_EVENT, a),
            Request::DequeueEvent(a) => call(fd, DQEVENT, a),
        }
    }

    fn map(&self, fd: i32, offset: i64, length: usize) -> io::Result<*const u8> {
        // SAFETY: a new mapping where the kernel likes; nothing of ours is replaced.
        let at = unsafe { libc::mmap(std::ptr::null_mut(), length, libc::PROT_READ, libc::MAP_SHARED, fd, offset) };
        if at == libc::MAP_FAILED {
            return Err(io::Error::last_os_error());
        }
        Ok(at.cast())
    }

    unsafe fn unmap(&self, at: *const u8, length: usize) {
        // SAFETY: by the contract of this function.
        unsafe { libc::munmap(at.cast_mut().cast(), length) };
    }

    fn poll(&self, fds: &[i32], ready: &mut [Ready], timeout: Span) -> io::Result<()> {
        let mut polled = [libc::pollfd { fd: -1, events: libc::POLLIN, revents: 0 }; NODES_MAX];
        polled.iter_mut().zip(fds).for_each(|(p, fd)| p.fd = *fd);
        let timeout = timeout.0.max(0);
        let timeout = libc::timespec { tv_sec: timeout / 1_000_000_000, tv_nsec: timeout % 1_000_000_000 };
        // SAFETY: `polled` has NODES_MAX entries and outlives the call; a negative descriptor is passed over.
        let answer = unsafe { libc::ppoll(polled.as_mut_ptr(), NODES_MAX as libc::nfds_t, &timeout, std::ptr::null()) };
        match checked(answer) {
            // A signal is not ready; the caller asks again for what is left of its time.
            Err(e) if e.raw_os_error() == Some(libc::EINTR) => {}
            answer => answer?,
        }
        for (ready, p) in ready.iter_mut().zip(&polled) {
            let error = p.revents & (libc::POLLERR | libc::POLLHUP | libc::POLLNVAL) != 0;
            *ready = Ready { readable: p.revents & libc::POLLIN != 0, error };
        }
        Ok(())
    }

    fn now(&self) -> Nanos {
        crate::host::monotonic()
    }
}

fn checked(answer: i32) -> io::Result<()> {
    if answer < 0 {
        return Err(io::Error::last_os_error());
    }
    Ok(())
}

/// The real calls on files that are no camera: whatever the kernel answers comes back as a value. On cameras: tests/hil.
#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn errno<T>(answer: io::Result<T>) -> Option<i32> {
        answer.err().and_then(|e| e.raw_os_error())
    }

    #[test]
    fn every_request_is_refused_by_what_is_no_camera() {
        assert_eq!(errno(Linux.open(Path::new("/dev/no-such-camera"))), Some(libc::ENOENT));
        assert_eq!(Linux.open(Path::new("a\0b")).unwrap_err().kind(), io::ErrorKind::InvalidInput);
        let fd = Linux.open(Path::new("/dev/null")).unwrap();
        let (mut buffer, mut planes) = (Buffer::default(), [Plane::default(); PLANES_MAX]);
        let mut multi = Buffer { kind: CAPTURE_MULTI, ..Buffer::default() };
        let mut control = ExtControl { id: 1, ..ExtControl::default() };
        let requests = [
            Request::QueryCap(&mut Capability::default()),
            Request::EnumFormat(&mut FormatDescription::default()),
            Request::EnumSize(&mut FrameSize::default()),
            Request::EnumInterval(&mut FrameInterval::default()),
            Request::SetFormat(&mut FormatSingle::default()),
            Request::SetFormatMulti(&mut FormatMulti::default()),
            Request::SetParm(&mut StreamParm::default()),
            Request::GetBuffers(&mut RequestBuffers::default()),
            Request::StreamOn(CAPTURE),
            Request::StreamOff(CAPTURE),
            Request::QueryControl(&mut QueryControl::default()),
            Request::SubscribeEvent(&mut EventSubscription::default()),
            Request::DequeueEvent(&mut Event::default()),
        ];
        for request in requests {
            let name = request.name();
            assert_eq!(errno(Linux.ioctl(fd, request)), Some(libc::ENOTTY), "{name}");
        }
        let refused = |request: Request<'_>| assert_eq!(errno(Linux.ioctl(fd, request)), Some(libc::ENOTTY));
        refused(Request::SetExtControl(&mut control));
        refused(Request::GetExtControl(&mut control));
        for b in [&mut buffer, &mut multi] {
            refused(Request::QueryBuffer(b, &mut planes));
            refused(Request::Queue(b, &mut planes));
            refused(Request::Dequeue(b, &mut planes));
        }
        assert_eq!((multi.place, multi.length), (planes.as_ptr() as u64, PLANES_MAX as u32), "where its planes are");
        assert!(errno(Linux.map(fd, 0, 4096)).is_some());
        Linux.close(fd);
        assert_eq!(errno(Linux.ioctl(-1, Request::StreamOn(CAPTURE))), Some(libc::EBADF));
    }

    #[test]
    fn a_descriptor_that_is_none_hangs_up_and_a_signal_is_no_error() {
        let mut ready = [Ready::default(); 1];
        Linux.poll(&[1 << 20], &mut ready, Span(0)).unwrap();
        assert_eq!(ready, [Ready { readable: false, error: true }]);
        extern "C" fn heard(_: libc::c_int) {}
        // SAFETY: the handler does nothing; a struct of integers may be zero; the thread is alive while it is signalled.
        let took = unsafe {
            let mut action: libc::sigaction = std::mem::zeroed();
            action.sa_sigaction = heard as extern "C" fn(libc::c_int) as usize;
            libc::sigaction(libc::SIGUSR1, &action, std::ptr::null_mut());
            let (told, tells) = std::sync::mpsc::channel();
            let waits = std::thread::spawn(move || {
                told.send(libc::pthread_self()).unwrap();
                let begun = Linux.now();
                Linux.poll(&[], &mut [], Span(20_000_000_000)).map(|()| Linux.now() - begun)
            });
            let thread = tells.recv().unwrap();
            while !waits.is_finished() {
                std::thread::sleep(std::time::Duration::from_millis(20));
                libc::pthread_kill(thread, libc::SIGUSR1);
            }
            waits.join().unwrap().unwrap()
        };
        assert!(took < Span(10_000_000_000), "it came back early, to be asked again: {took:?}");
    }
}
