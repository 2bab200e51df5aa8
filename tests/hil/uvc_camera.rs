//! A USB camera that is a program: UVC 1.0 over a bulk endpoint, plugged through USB/IP into the `vhci_hcd` of the machine
//! it runs on, so that the kernel's own uvcvideo driver makes a video node of it. For the virtual machine of `run-vm.sh`.
//!
//! hil-uvc-camera PORT SERIAL FORMAT WIDTH HEIGHT FPS [FRAMES INSTANTS]
//!
//! PORT is one of the hub's eight. Pictures are `pattern::packed`, and picture `k` is exposed at `k` periods of
//! CLOCK_MONOTONIC, hence cameras started apart see together; or those of FRAMES, a file of raw ones in FORMAT, once, so
//! many ns after the instant that `play` names as the lines of INSTANTS say. What the machine is too slow to send in a
//! quarter of a period is not sent, as a camera does. One whose SERIAL begins with AE exposes automatically, and says how
//! long in its controls, at first for 4 ms.
//!
//! Lines on the standard input: `skip N` (send nothing for N pictures), `corrupt N` (with the error bit), `short N` (end
//! after half), `silent N` (as skip, and said so), `expose N` (for so many 0.1 ms from then on), `repeat NS` (before
//! `play`: the file begins again each NS), `play NS`, `unplug`. Lines on the standard output: `streaming`, `sent K`, `not sent K`.

#[path = "jpeg.rs"]
mod jpeg;
#[allow(dead_code)] // the tests ask for the pictures back
#[path = "pattern.rs"]
mod pattern;

use std::collections::VecDeque;
use std::io::{BufRead, Read, Write};
use std::os::fd::AsRawFd;
use std::os::unix::net::UnixStream;
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

/// Bytes of a bulk transfer: header of 2, then the picture's.
const PAYLOAD: usize = 16384;
const HIGH_SPEED: u32 = 3;

struct Camera {
    serial: String,
    format: String,
    width: usize,
    height: usize,
    period: i64,
}

/// Pictures and when each is exposed.
struct Film {
    frames: Vec<u8>,
    instants: Vec<i64>,
}

impl Film {
    /// The newest picture exposed at `t`, counted on over the times that the film `repeats`.
    fn newest(&self, t: i64, repeats: Option<i64>) -> i64 {
        let (times, t) = repeats.map_or((0, t), |every| (t.div_euclid(every), t.rem_euclid(every)));
        times * self.instants.len() as i64 + self.instants.partition_point(|due| *due <= t) as i64 - 1
    }

    /// When picture `k` is exposed.
    fn due(&self, k: i64, repeats: Option<i64>) -> Option<i64> {
        let n = self.instants.len() as i64;
        let times = repeats.map_or(0, |every| k / n * every);
        self.instants.get(repeats.map_or(k, |_| k % n) as usize).map(|due| times + due)
    }
}

/// What the host asked for and has not been answered.
#[derive(Default)]
struct Bus {
    /// Sequence number and length of each transfer that waits for a payload.
    waiting: VecDeque<(u32, usize)>,
    streaming: bool,
    /// Exposure that the camera has set, in 0.1 ms.
    exposure: u32,
}

#[derive(Default)]
struct Orders {
    skip: u32,
    corrupt: u32,
    short: u32,
    /// When the first picture of a file is exposed.
    play: Option<i64>,
    /// After how long the file begins again, ns.
    repeat: Option<i64>,
}

type Shared<T> = Arc<(Mutex<T>, Condvar)>;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let usage = "hil-uvc-camera PORT SERIAL FORMAT WIDTH HEIGHT FPS [FRAMES INSTANTS]";
    let number = |i: usize| arguments.get(i).and_then(|a| a.parse::<f64>().ok()).expect(usage);
    let (width, height) = (number(3) as usize, number(4) as usize);
    let (serial, format) = (arguments[1].clone(), arguments[2].clone());
    let camera = Camera { serial, format, width, height, period: (1e9 / number(5)) as i64 };
    let film = arguments.get(6).zip(arguments.get(7)).map(|(frames, instants)| {
        let list = std::fs::read_to_string(instants).expect("the file of instants");
        let instants = list.lines().map(|l| l.parse().expect("ns")).collect();
        Film { frames: std::fs::read(frames).expect("the file of frames"), instants }
    });
    let socket = plug(number(0) as u32);
    let bus: Shared<Bus> = Arc::default();
    bus.0.lock().expect("whole").exposure = 40;
    let orders: Shared<Orders> = Arc::default();
    let answers = Arc::new(Mutex::new(socket.try_clone().expect("a second descriptor")));
    {
        let (bus, answers, descriptors) = (bus.clone(), answers.clone(), Descriptors::of(&camera));
        std::thread::spawn(move || serve(socket, &bus, &answers, &descriptors));
    }
    {
        let (orders, bus) = (orders.clone(), bus.clone());
        std::thread::spawn(move || {
            std::io::stdin().lock().lines().map_while(Result::ok).for_each(|l| obey(&l, &orders, &bus))
        });
    }
    expose(&camera, film.as_ref(), &bus, &orders, &answers);
}

/// The other end of the pair is the host controller's.
fn plug(port: u32) -> UnixStream {
    let (ours, theirs) = UnixStream::pair().expect("a pair of sockets");
    let attach = "/sys/devices/platform/vhci_hcd.0/attach";
    let line = format!("{port} {} {} {HIGH_SPEED}", theirs.as_raw_fd(), 1 << 16 | (port + 2));
    std::fs::write(attach, line).expect("modprobe vhci-hcd first; PORT is free");
    ours
}

fn obey(line: &str, shared: &Shared<Orders>, bus: &Shared<Bus>) {
    let (order, number) = line.split_once(' ').unwrap_or((line, "1"));
    let number: i64 = number.parse().expect("a number");
    let mut orders = shared.0.lock().expect("no thread panics with it");
    match order {
        "skip" | "silent" => orders.skip += number as u32,
        "corrupt" => orders.corrupt += number as u32,
        "short" => orders.short += number as u32,
        "expose" => bus.0.lock().expect("whole").exposure = number as u32,
        "play" => orders.play = Some(number),
        "repeat" => orders.repeat = Some(number),
        "unplug" => std::process::exit(0),
        _ => panic!("unknown order {line}"),
    }
    shared.1.notify_all();
}

/// Sends pictures as they are due, while the host streams.
fn expose(
    camera: &Camera,
    film: Option<&Film>,
    bus: &Shared<Bus>,
    orders: &Shared<Orders>,
    answers: &Mutex<UnixStream>,
) {
    let told = || {
        let orders = orders.1.wait_while(orders.0.lock().expect("whole"), |o| o.play.is_none()).expect("whole");
        (orders.play.expect("waited for"), orders.repeat)
    };
    let (start, repeats) = film.map_or((0, None), |_| told());
    let now = || stipple_drivers::host::monotonic().0 - start;
    let (mut last, mut fid) = (-1, 0u8);
    loop {
        drop(bus.1.wait_while(bus.0.lock().expect("whole"), |b| !b.streaming).expect("whole"));
        let newest = film.map_or(now() / camera.period, |f| f.newest(now(), repeats));
        let k = newest.max(last + 1);
        let due = film.map_or(Some(k * camera.period), |f| f.due(k, repeats));
        let Some(due) = due else { return park() };
        std::thread::sleep(Duration::from_nanos((due - now()).max(0) as u64));
        let size = Descriptors::picture_bytes(camera);
        let picture = match film {
            None => pattern::packed(&camera.format, k as u32, camera.width, camera.height),
            Some(film) => film.frames[k as usize % film.instants.len() * size..][..size].to_vec(),
        };
        last = k;
        let (skip, corrupt, short) = {
            let mut o = orders.0.lock().expect("whole");
            let now = (o.skip > 0, o.corrupt > 0, o.short > 0);
            *o = Orders {
                skip: o.skip.saturating_sub(1),
                corrupt: o.corrupt.saturating_sub(1),
                short: o.short.saturating_sub(1),
                ..*o
            };
            now
        };
        let late = now() - due > camera.period / 4;
        if skip || late {
            println!("not sent {k}");
            continue;
        }
        fid ^= 1;
        let end = if short { picture.len() / 2 } else { picture.len() };
        if send(&picture[..end], fid | if corrupt { 0x40 } else { 0 }, bus, answers) {
            println!("sent {k}");
        }
    }
}

/// A camera whose recording is over stays plugged.
fn park() {
    loop {
        std::thread::park();
    }
}

/// A picture, payload by payload as the host has room; false where it stopped to stream.
fn send(picture: &[u8], flags: u8, bus: &Shared<Bus>, answers: &Mutex<UnixStream>) -> bool {
    const END_OF_HEADER: u8 = 0x80;
    const END_OF_FRAME: u8 = 0x02;
    let mut at = 0;
    while at < picture.len() {
        let mut b =
            bus.1.wait_while(bus.0.lock().expect("whole"), |b| b.streaming && b.waiting.is_empty()).expect("whole");
        if !b.streaming {
            return false;
        }
        let (sequence, room) = b.waiting.pop_front().expect("waited for");
        let size = (picture.len() - at).min(room.min(PAYLOAD) - 2);
        let last = if at + size == picture.len() { END_OF_FRAME } else { 0 };
        let payload = [&[2, END_OF_HEADER | flags | last], &picture[at..at + size]].concat();
        at += size;
        // Under the lock, so that a transfer that the host takes back is not answered after that.
        answer(answers, RET_SUBMIT, sequence, 0, payload.len(), &payload);
        drop(b);
    }
    true
}

const CMD_UNLINK: u32 = 2;
const RET_SUBMIT: u32 = 3;
const RET_UNLINK: u32 = 4;
const BULK_ENDPOINT: u32 = 1;
const ECONNRESET: i32 = 104;
const EPIPE: i32 = 32;

/// USB/IP: 48 bytes of head in network order, then what was read. `moved` bytes went either way.
fn answer(to: &Mutex<UnixStream>, command: u32, sequence: u32, status: i32, moved: usize, data: &[u8]) {
    let mut head = [0u8; 48];
    let words = [(0, command), (1, sequence), (5, status as u32), (6, moved as u32)];
    words.iter().for_each(|(i, w)| head[4 * i..4 * i + 4].copy_from_slice(&w.to_be_bytes()));
    let sent = to.lock().expect("whole").write_all(&[&head, data].concat());
    sent.unwrap_or_else(|_| std::process::exit(0));
}

/// Reads what the host asks until it lets go.
fn serve(mut socket: UnixStream, bus: &Shared<Bus>, answers: &Mutex<UnixStream>, descriptors: &Descriptors) {
    let mut head = [0u8; 48];
    while socket.read_exact(&mut head).is_ok() {
        let word = |i: usize| u32::from_be_bytes(head[4 * i..4 * i + 4].try_into().expect("four bytes"));
        let (command, sequence, to_host, endpoint) = (word(0), word(1), word(3) == 1, word(4));
        if command == CMD_UNLINK {
            let mut b = bus.0.lock().expect("whole");
            let before = b.waiting.len();
            b.waiting.retain(|w| w.0 != word(5));
            let status = if b.waiting.len() < before { -ECONNRESET } else { 0 };
            answer(answers, RET_UNLINK, sequence, status, 0, &[]);
            continue;
        }
        let length = word(6) as usize;
        if !to_host {
            let mut written = vec![0; length];
            socket.read_exact(&mut written).expect("what it says it sends");
        }
        if endpoint == BULK_ENDPOINT {
            bus.0.lock().expect("whole").waiting.push_back((sequence, length));
            bus.1.notify_all();
            continue;
        }
        let setup: [u8; 8] = head[40..48].try_into().expect("eight bytes");
        match descriptors.control(setup, bus) {
            None => answer(answers, RET_SUBMIT, sequence, -EPIPE, 0, &[]),
            Some(_) if !to_host => answer(answers, RET_SUBMIT, sequence, 0, length, &[]),
            Some(data) => {
                let data = &data[..data.len().min(length)];
                answer(answers, RET_SUBMIT, sequence, 0, data.len(), data);
            }
        }
    }
    std::process::exit(0);
}

/// What the camera says of itself (USB Video Class 1.0, and USB 2.0 chapter 9).
struct Descriptors {
    device: Vec<u8>,
    configuration: Vec<u8>,
    probe: Vec<u8>,
    strings: [String; 3],
    automatic: bool,
}

impl Descriptors {
    fn picture_bytes(camera: &Camera) -> usize {
        let bits = pattern::FORMATS.iter().find(|f| f.0 == camera.format).map_or(8, |f| usize::from(f.2));
        // Compressed ones never reach this.
        camera.width * camera.height * if bits == 0 { 16 } else { bits } / 8
    }

    fn of(camera: &Camera) -> Descriptors {
        let (_, code, bits) = pattern::FORMATS.iter().find(|f| f.0 == camera.format).expect("one of pattern::FORMATS");
        let size = Self::picture_bytes(camera) as u32;
        let interval = (camera.period / 100) as u32;
        let [w, h] = [camera.width, camera.height].map(|v| (v as u16).to_le_bytes());
        let (long, guid) = (u32::to_le_bytes, b"\0\0\x10\0\x80\0\0\xaa\0\x38\x9b\x71");
        let rate = long((u64::from(size) * 8 * 1_000_000_000 / camera.period as u64) as u32);
        let compressed = *bits == 0;
        let format: Vec<u8> = if compressed {
            vec![11, 0x24, 6, 1, 1, 0, 1, 0, 0, 0, 0]
        } else {
            [&[27, 0x24, 4, 1, 1][..], &code[..], guid, &[*bits, 1, 0, 0, 0, 0]].concat()
        };
        let frame_head = [30, 0x24, if compressed { 7 } else { 5 }, 1, 0];
        let frame =
            [&frame_head[..], &w, &h, &rate, &rate, &long(size), &long(interval), &[1], &long(interval)].concat();
        let colour = [6, 0x24, 0x0d, 1, 1, 4];
        let stream_length = ((14 + format.len() + frame.len() + colour.len()) as u16).to_le_bytes();
        let automatic = camera.serial.starts_with("AE");
        // Of the camera terminal: the mode of automatic exposure, and the time of exposure.
        let controls = if automatic { 0x0a } else { 0 };
        let mut configuration = [
            // Configuration, association, control interface with camera terminal and output.
            &[9, 2, 0, 0, 2, 1, 0, 0x80, 250][..],
            &[8, 0x0b, 0, 2, 0x0e, 3, 0, 2],
            &[9, 4, 0, 0, 0, 0x0e, 1, 0, 2],
            &[13, 0x24, 1, 0, 1, 40, 0, 0x00, 0x6c, 0xdc, 0x02, 1, 1],
            &[18, 0x24, 2, 1, 1, 2, 0, 0, 0, 0, 0, 0, 0, 0, 3, controls, 0, 0],
            &[9, 0x24, 3, 2, 1, 1, 0, 1, 0],
            // Streaming interface, its one format and size, its bulk endpoint.
            &[9, 4, 1, 0, 1, 0x0e, 2, 0, 0],
            &[14, 0x24, 1, 1, stream_length[0], stream_length[1], 0x81, 0, 2, 0, 0, 0, 1, 0],
            &format,
            &frame,
            &colour,
            &[7, 5, 0x81, 2, 0, 2, 0],
        ]
        .concat();
        let total = (configuration.len() as u16).to_le_bytes();
        configuration[2..4].copy_from_slice(&total);
        let probe = [&[1, 0, 1, 1][..], &long(interval), &[0; 10], &long(size), &long(PAYLOAD as u32)].concat();
        let device = vec![18, 1, 0, 2, 0xef, 2, 1, 64, 0x09, 0x12, 1, 0, 0, 1, 1, 2, 3, 1];
        let strings = ["Stipple".to_string(), format!("HIL {}", camera.serial), camera.serial.clone()];
        Descriptors { device, configuration, probe, strings, automatic }
    }

    /// What a control transfer is answered; none: it is not understood.
    fn control(&self, setup: [u8; 8], bus: &Shared<Bus>) -> Option<Vec<u8>> {
        const GET_DESCRIPTOR: (u8, u8) = (0x80, 6);
        const PROBE: u8 = 1;
        const COMMIT: u8 = 2;
        const TERMINAL: u8 = 1;
        let [kind, request, low, high, ..] = setup;
        let stream = |on: bool| {
            on.then(|| println!("streaming"));
            bus.0.lock().expect("whole").streaming = on;
            bus.1.notify_all();
            Some(vec![])
        };
        match (kind, request) {
            GET_DESCRIPTOR => match high {
                1 => Some(self.device.clone()),
                2 => Some(self.configuration.clone()),
                3 if low == 0 => Some(vec![4, 3, 9, 4]),
                3 => self.strings.get(usize::from(low) - 1).map(|s| {
                    let text: Vec<u8> = s.encode_utf16().flat_map(u16::to_le_bytes).collect();
                    [&[text.len() as u8 + 2, 3], &text[..]].concat()
                }),
                _ => None,
            },
            // The host stopped: it clears the halt of the endpoint.
            (0x02, 1) => stream(false),
            (0x00..=0x02, _) => Some(vec![]),
            (0x80..=0x82, 0) => Some(vec![0, 0]),
            (0xa1, _) if self.automatic && setup[5] == TERMINAL => exposure(request, high, bus),
            // GET_INFO, GET_LEN, and the one setting there is.
            (0xa1, 0x86) => Some(vec![3]),
            (0xa1, 0x85) => Some(vec![self.probe.len() as u8, 0]),
            (0xa1, _) if high == PROBE || high == COMMIT => Some(self.probe.clone()),
            (0x21, 1) if high == COMMIT => stream(true),
            (0x21, 1) => Some(vec![]),
            _ => None,
        }
    }
}

/// The answer of the camera terminal: which `request` about which `control`.
fn exposure(request: u8, control: u8, bus: &Shared<Bus>) -> Option<Vec<u8>> {
    const AUTO_MODE: u8 = 2;
    const TIME: u8 = 4;
    /// The time of exposure is automatic, the aperture is not; the other mode there is: neither is.
    const APERTURE_PRIORITY: u8 = 8;
    const MANUAL: u8 = 1;
    let time = |n: u32| Some(n.to_le_bytes().to_vec());
    match (control, request) {
        // GET_CUR, GET_DEF; GET_RES lists the modes.
        (AUTO_MODE, 0x81 | 0x87) => Some(vec![APERTURE_PRIORITY]),
        (AUTO_MODE, 0x84) => Some(vec![APERTURE_PRIORITY | MANUAL]),
        (AUTO_MODE, 0x86) => Some(vec![3]),
        // GET_CUR, GET_MIN, GET_MAX, GET_RES, GET_DEF; GET_INFO: it is read, set, and changes by itself.
        (TIME, 0x81) => time(bus.0.lock().expect("whole").exposure),
        (TIME, 0x82 | 0x84) => time(1),
        (TIME, 0x83) => time(10_000),
        (TIME, 0x87) => time(40),
        (TIME, 0x86) => Some(vec![0x0b]),
        _ => None,
    }
}
