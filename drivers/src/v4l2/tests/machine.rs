//! A kernel of two cameras that do what they are told, in a time of its own: every call can be made to fail with every
//! error, and what is not given back is seen.
#![cfg(test)]
#![allow(unsafe_code)]

use super::super::kernel::{Kernel, Listed, Ready, Request};
use super::super::uapi::*;
use crate::types::{Nanos, Span};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard};

/// An image that a camera will send.
#[derive(Clone, Debug)]
pub struct Shot {
    /// When the driver has it.
    pub at: i64,
    pub stamp: i64,
    pub sequence: u32,
    pub flags: u32,
    pub bytes: Vec<u8>,
    /// Where the picture starts, in a multi-planar queue.
    pub data_offset: usize,
}

pub type Sizes = Vec<(u32, u32)>;

pub struct Cam {
    pub path: PathBuf,
    pub serial: Option<String>,
    pub bus: &'static str,
    pub capabilities: u32,
    pub present: bool,
    pub formats: Vec<([u8; 4], Sizes)>,
    /// What S_PARM answers: seconds a frame; none: it refuses.
    pub interval: Option<(u32, u32)>,
    pub controls: Vec<(QueryControl, i64)>,
    /// Controls whose changes are to be told, and those that wait to be: when, which, its value.
    pub subscribed: Vec<u32>,
    pub events: VecDeque<(i64, u32, i64)>,
    /// What S_FMT makes of the size, and of bytes a row.
    pub adjust: fn(&mut (u32, u32, u32)),
    /// Colour space, encoding and quantization that S_FMT answers.
    pub stated: [u32; 3],
    pub buffer_bytes: usize,
    pub buffers_given: u32,
    /// poll reports an error and no call says which.
    pub hangs: bool,
    /// Every buffer is given under this number.
    pub misnames: Option<u32>,
    pub shots: VecDeque<Shot>,
    buffers: Vec<Vec<u8>>,
    queued: VecDeque<u32>,
    done: VecDeque<(u32, Shot)>,
    streaming: bool,
    pub dropped: usize,
}

pub struct Fail {
    pub call: &'static str,
    pub errno: i32,
    /// Calls of this name that go well before it.
    pub after: usize,
    pub times: usize,
}

#[derive(Default)]
pub struct State {
    pub now: i64,
    pub cams: Vec<Cam>,
    pub fails: Vec<Fail>,
    pub failed: BTreeSet<&'static str>,
    pub calls: BTreeMap<&'static str, usize>,
    /// Time that reading a control takes.
    pub read_takes: i64,
    fds: BTreeMap<i32, usize>,
    mapped: BTreeSet<usize>,
}

#[derive(Clone)]
pub struct Machine(pub Arc<Mutex<State>>);

pub const WIDTH: usize = 6;
pub const HEIGHT: usize = 4;
pub const PERIOD: i64 = 50_000_000;
/// When the machine was started: stamps are never near zero.
pub const BOOT: i64 = 100_000_000_000;

impl Cam {
    pub fn new(index: usize) -> Cam {
        Cam {
            path: format!("/dev/video{index}").into(),
            serial: Some(format!("000{index}")),
            bus: ["usb-0-1", "usb-0-2"][index],
            capabilities: CAP_CAPTURE | CAP_STREAMING,
            present: true,
            formats: vec![(*b"GREY", vec![(WIDTH as u32, HEIGHT as u32), (32, 16)])],
            interval: Some((1, 20)),
            controls: Vec::new(),
            subscribed: Vec::new(),
            events: VecDeque::new(),
            adjust: |_| {},
            stated: [0; 3],
            buffer_bytes: 64,
            buffers_given: 4,
            hangs: false,
            misnames: None,
            shots: VecDeque::new(),
            buffers: Vec::new(),
            queued: VecDeque::new(),
            done: VecDeque::new(),
            streaming: false,
            dropped: 0,
        }
    }

    fn multi(&self) -> bool {
        self.capabilities & CAP_CAPTURE == 0
    }

    /// What was shot until `now`, into the buffers there are.
    fn run(&mut self, now: i64) {
        while self.shots.front().is_some_and(|s| s.at <= now) {
            let shot = self.shots.pop_front().expect("looked at");
            if !self.streaming || !self.present {
                continue;
            }
            let Some(index) = self.queued.pop_front() else {
                self.dropped += 1;
                continue;
            };
            self.buffers[index as usize][..shot.bytes.len()].copy_from_slice(&shot.bytes);
            self.done.push_back((index, shot));
        }
    }

    fn forget(&mut self) {
        self.streaming = false;
        self.queued.clear();
        self.done.clear();
        self.events.clear();
    }
}

impl Machine {
    pub fn new(cams: Vec<Cam>) -> Machine {
        Machine(Arc::new(Mutex::new(State { now: BOOT, cams, ..State::default() })))
    }

    pub fn state(&self) -> MutexGuard<'_, State> {
        self.0.lock().expect("no test panics while it holds this")
    }

    pub fn fail(&self, call: &'static str, errno: i32, after: usize, times: usize) {
        self.state().fails.push(Fail { call, errno, after, times });
    }

    /// Pictures of `camera` from `BOOT` on, `PERIOD` apart; pixel `i` of picture `k` is `i + k + 100 * camera`.
    pub fn shoot(&self, camera: usize, pictures: std::ops::Range<u32>, change: impl Fn(u32, &mut Shot)) {
        for k in pictures {
            let at = BOOT + i64::from(k) * PERIOD;
            let bytes = (0..WIDTH * HEIGHT).map(|i| pixel(camera, k, i)).collect();
            let stamp = at - 1_000_000;
            let mut shot = Shot { at, stamp, sequence: k, flags: STAMP_MONOTONIC, bytes, data_offset: 0 };
            change(k, &mut shot);
            self.state().cams[camera].shots.push_back(shot);
        }
    }

    /// Nothing is open, mapped or bought.
    pub fn has_everything_back(&self) -> bool {
        let s = self.state();
        s.fds.is_empty() && s.mapped.is_empty() && s.cams.iter().all(|c| c.buffers.is_empty() || !c.present)
    }

    fn call(&self, name: &'static str) -> io::Result<MutexGuard<'_, State>> {
        let mut s = self.state();
        *s.calls.entry(name).or_default() += 1;
        let mut errno = None;
        for f in s.fails.iter_mut().filter(|f| f.call == name && f.times > 0) {
            if f.after > 0 {
                f.after -= 1;
            } else {
                f.times -= 1;
                errno = Some(f.errno);
                break;
            }
        }
        match errno {
            Some(errno) => {
                s.failed.insert(name);
                Err(io::Error::from_raw_os_error(errno))
            }
            None => Ok(s),
        }
    }
}

pub fn pixel(camera: usize, k: u32, i: usize) -> u8 {
    (i as u32 + k + 100 * camera as u32) as u8
}

fn refuse<T>(errno: i32) -> io::Result<T> {
    Err(io::Error::from_raw_os_error(errno))
}

impl Kernel for Machine {
    fn nodes(&self) -> io::Result<Vec<Listed>> {
        let s = self.call("readdir")?;
        let there = s.cams.iter().filter(|c| c.present);
        Ok(there.map(|c| Listed { path: c.path.clone(), serial: c.serial.clone() }).collect())
    }

    fn open(&self, path: &Path) -> io::Result<i32> {
        let mut s = self.call("open")?;
        let Some(cam) = s.cams.iter().position(|c| c.path == path && c.present) else { return refuse(libc::ENOENT) };
        let fd = s.fds.keys().last().map_or(100, |last| last + 1);
        s.fds.insert(fd, cam);
        Ok(fd)
    }

    fn close(&self, fd: i32) {
        let mut s = self.state();
        let cam = s.fds.remove(&fd).expect("closed once");
        if !s.fds.values().any(|c| *c == cam) {
            s.cams[cam].forget();
            s.cams[cam].buffers.clear();
        }
    }

    fn ioctl(&self, fd: i32, request: Request) -> io::Result<()> {
        let mut s = self.call(request.name())?;
        let now = s.now;
        let cam = *s.fds.get(&fd).expect("an open descriptor");
        let c = &mut s.cams[cam];
        if !c.present {
            return refuse(libc::ENODEV);
        }
        c.run(now);
        let read = matches!(request, Request::GetExtControl(_));
        let answered = answer(c, request);
        s.now += if read { s.read_takes } else { 0 };
        answered
    }

    fn map(&self, fd: i32, offset: i64, length: usize) -> io::Result<*const u8> {
        let mut s = self.call("mmap")?;
        let cam = s.fds[&fd];
        let buffer = &s.cams[cam].buffers[offset as usize / 4096];
        assert_eq!(buffer.len(), length);
        let at = buffer.as_ptr();
        s.mapped.insert(at as usize);
        Ok(at)
    }

    unsafe fn unmap(&self, at: *const u8, _: usize) {
        assert!(self.state().mapped.remove(&(at as usize)), "unmapped once");
    }

    fn poll(&self, fds: &[i32], ready: &mut [Ready], timeout: Span) -> io::Result<()> {
        let mut s = self.call("poll")?;
        let until = s.now + timeout.0.max(0);
        let cams: Vec<usize> = fds.iter().map(|fd| s.fds[fd]).collect();
        let next = cams.iter().filter_map(|c| s.cams[*c].shots.front()).map(|shot| shot.at).min();
        if cams.iter().all(|c| s.cams[*c].done.is_empty() && s.cams[*c].present) {
            s.now = next.unwrap_or(until).clamp(s.now, until);
        }
        let now = s.now;
        for (c, ready) in cams.iter().zip(ready) {
            let c = &mut s.cams[*c];
            c.run(now);
            *ready = Ready { readable: !c.done.is_empty(), error: !c.present || c.hangs };
        }
        Ok(())
    }

    fn now(&self) -> Nanos {
        Nanos(self.state().now)
    }
}

fn answer(c: &mut Cam, request: Request) -> io::Result<()> {
    match request {
        Request::QueryCap(a) => {
            a.capabilities = c.capabilities | CAP_DEVICE_CAPS;
            a.device_caps = c.capabilities;
            a.card[..4].copy_from_slice(b"cam\0");
            a.bus_info[..c.bus.len()].copy_from_slice(c.bus.as_bytes());
        }
        Request::EnumFormat(a) => match c.formats.get(a.index as usize) {
            Some((code, _)) => a.fourcc = u32::from_le_bytes(*code),
            None => return refuse(libc::EINVAL),
        },
        Request::EnumSize(a) => {
            let sizes = c.formats.iter().find(|f| u32::from_le_bytes(f.0) == a.fourcc).map(|f| &f.1);
            let Some((w, h)) = sizes.and_then(|s| s.get(a.index as usize)) else { return refuse(libc::EINVAL) };
            a.kind = SIZE_DISCRETE;
            a.extent[..2].copy_from_slice(&[*w, *h]);
        }
        Request::EnumInterval(a) => match (a.index, c.interval) {
            (0, Some((num, den))) => {
                a.kind = SIZE_DISCRETE;
                a.interval[..2].copy_from_slice(&[num, den]);
            }
            _ => return refuse(libc::EINVAL),
        },
        Request::SetFormat(a) => {
            let mut got = (a.width, a.height, a.width);
            (c.adjust)(&mut got);
            (a.width, a.height, a.bytes_per_line) = got;
            a.size_image = c.buffer_bytes as u32;
            assert_eq!(a.private, FORMAT_EXTENDED);
            [a.colorspace, a.encoding, a.quantization] = c.stated;
        }
        Request::SetFormatMulti(a) => {
            let mut got = (a.width, a.height, a.width);
            (c.adjust)(&mut got);
            (a.width, a.height, a.planes[0].bytes_per_line) = got;
            a.planes[0].size_image = c.buffer_bytes as u32;
            (a.colorspace, a.encoding, a.quantization) = (c.stated[0], c.stated[1] as u8, c.stated[2] as u8);
        }
        Request::SetParm(a) => match c.interval {
            Some((num, den)) => (a.capability, a.numerator, a.denominator) = (CAP_TIME_PER_FRAME, num, den),
            None => return refuse(libc::ENOTTY),
        },
        Request::GetBuffers(a) => {
            c.forget();
            a.count = a.count.min(c.buffers_given);
            c.buffers = vec![vec![0; c.buffer_bytes]; a.count as usize];
        }
        Request::QueryBuffer(a, planes) => {
            let place = u64::from(a.index) * 4096;
            (a.place, a.length) = (place, c.buffer_bytes as u32);
            if c.multi() {
                (planes[0].place, planes[0].length) = (place, c.buffer_bytes as u32);
            }
        }
        Request::Queue(a, _) => {
            assert!(!c.queued.contains(&a.index), "buffer {} is queued twice", a.index);
            c.queued.push_back(a.index);
        }
        Request::Dequeue(a, planes) => {
            let Some((index, shot)) = c.done.pop_front() else { return refuse(libc::EAGAIN) };
            (a.index, a.sequence, a.flags) = (c.misnames.unwrap_or(index), shot.sequence, shot.flags);
            (a.stamp_s, a.stamp_us) = (shot.stamp / 1_000_000_000, shot.stamp % 1_000_000_000 / 1000);
            a.bytes_used = shot.bytes.len() as u32;
            (planes[0].bytes_used, planes[0].data_offset) = (a.bytes_used, shot.data_offset as u32);
        }
        Request::StreamOn(_) => c.streaming = true,
        Request::StreamOff(_) => c.forget(),
        Request::QueryControl(a) => {
            let wanted = a.id & !NEXT_CONTROL;
            let Some((control, _)) = c.controls.iter().find(|q| q.0.id > wanted) else { return refuse(libc::EINVAL) };
            *a = *control;
        }
        Request::SetExtControl(a) => set(c, a.id, a.value),
        // As the kernel does, only the low half is written.
        Request::GetExtControl(a) => a.value = i64::from(get(c, a.id) as u32),
        Request::SubscribeEvent(a) => {
            assert_eq!(a.kind, EVENT_CONTROL);
            c.subscribed.push(a.id);
        }
        Request::DequeueEvent(a) => {
            let Some((at, id, value)) = c.events.pop_front() else { return refuse(libc::ENOENT) };
            (a.kind, a.id, a.changes, a.value) = (EVENT_CONTROL, id, EVENT_CONTROL_VALUE, i64::from(value as u32));
            (a.stamp_s, a.stamp_ns) = (at / 1_000_000_000, at % 1_000_000_000);
        }
    }
    Ok(())
}

fn set(c: &mut Cam, id: u32, value: i64) {
    c.controls.iter_mut().find(|q| q.0.id == id).expect("a control it has").1 = value;
}

fn get(c: &Cam, id: u32) -> i64 {
    c.controls.iter().find(|q| q.0.id == id).expect("a control it has").1
}
