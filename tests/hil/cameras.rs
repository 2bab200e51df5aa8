//! The cameras' driver on the kernel's own V4L2: two UVC cameras over USB/IP under uvcvideo (`uvc_*`), and vivid, the
//! kernel's virtual camera, multi-planar (`vivid_*`). For the virtual machine: `make hil TESTS="uvc vivid"`.
//!
//! Emulation is slow and its clock uneven: nothing here passes or fails on latency or throughput. What a camera sent is
//! what it says it sent; everything else is compared with that, exactly.
#![allow(clippy::unwrap_used)]

mod jpeg;
mod pattern;
mod plugged;

use plugged::Uvc;
use std::process::Command;
use std::time::{Duration, Instant};
use stipple_drivers::host::{thread_cpu, CpuTime};
use stipple_drivers::source::{FrameSource, SourceFault, Wait};
use stipple_drivers::v4l2::{Format, Rig, Select, Settings, StampPoint};
use stipple_drivers::{Calibration, Camera, Fault, Frames, ImuCalibration, Lens, Pose, RigCamera, Span};

const MS: i64 = 1_000_000;
/// Waits of the tests: a slow machine takes its time, and a broken one does not come back.
const PATIENCE: Duration = Duration::from_secs(20);

fn settings(devices: &[&str], width: usize, height: usize, fps: u32) -> Settings {
    Settings {
        devices: devices.iter().map(|d| Select::parse(d).unwrap()).collect(),
        format: None,
        colours: 0,
        width,
        height,
        rate_hz: f64::from(fps),
        exposure: Span(0),
        exposure_line: Span(0),
        controls: Vec::new(),
        // uvcvideo stamps the first payload, although it flags the start of exposure.
        stamp: StampPoint::FrameStart,
        transfer: Span(0),
        // The bus is one processor's work here: two cameras' first payloads are apart by a whole picture's.
        pair_tolerance: Span(400 * MS / i64::from(fps)),
    }
}

fn rig_of(cameras: usize, width: usize, height: usize) -> Calibration {
    let lens = Lens::Radtan { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0 };
    let camera = Camera { width, height, fx: 300.0, fy: 300.0, cx: width as f64 / 2.0, cy: height as f64 / 2.0, lens };
    Calibration { cameras: vec![RigCamera::new(camera, Pose::IDENTITY); cameras], imu: ImuCalibration::CONSUMER }
}

/// Opens as soon as the kernel has made the nodes.
fn open(settings: &Settings, calibration: &Calibration) -> Rig {
    let start = Instant::now();
    loop {
        match Rig::open(settings.clone(), calibration) {
            Ok(rig) => return rig,
            Err(fault) if start.elapsed() > PATIENCE => panic!("{fault}"),
            Err(_) => std::thread::sleep(Duration::from_millis(100)),
        }
    }
}

fn refused(settings: Settings, calibration: &Calibration) -> Fault {
    Rig::open(settings, calibration).err().expect("must be refused")
}

/// The next frame; what is lost on the way is handed to `lost`.
fn next(rig: &mut Rig, frames: &mut Frames, mut lost: impl FnMut(&SourceFault)) {
    let start = Instant::now();
    loop {
        match rig.next(Span(500 * MS), frames) {
            Ok(Wait::Got) => return,
            Err(fault) => lost(&fault),
            Ok(_) => {}
        }
        assert!(start.elapsed() < PATIENCE, "no frame; {:?}; {:?}", counted(rig), rig.warnings());
    }
}

fn no_loss(fault: &SourceFault) {
    panic!("{fault}");
}

fn count(rig: &Rig, name: &str) -> u64 {
    rig.counters().into_iter().find(|c| c.0 == name).unwrap().1
}

fn counted(rig: &Rig) -> Vec<(&'static str, u64)> {
    rig.counters().into_iter().filter(|c| c.1 > 0).collect()
}

/// The number that all images of a frame share, each of which is exact.
#[track_caller]
fn number(format: &str, frames: &Frames, fps: u32) -> u32 {
    let numbers: Vec<u32> = frames.images.iter().map(|i| pattern::number(format, &i.pixels, i.width)).collect();
    assert!(numbers.iter().all(|k| *k == numbers[0]), "paired {numbers:?}");
    for image in &frames.images {
        assert_eq!(pattern::wrong_pixels(format, numbers[0], &image.pixels, image.width), 0, "picture {}", numbers[0]);
    }
    // Sent when it was due or later, hence stamped then or later, and before now.
    let due = i64::from(numbers[0]) * 1_000_000_000 / i64::from(fps);
    assert!(
        frames.t.0 >= due - MS && frames.t <= stipple_drivers::host::monotonic(),
        "{} stamped {}",
        numbers[0],
        frames.t.0
    );
    numbers[0]
}

#[test]
fn a_picture_is_told_from_every_other() {
    for (format, _, bits) in pattern::FORMATS {
        let bytes = pattern::packed(format, 70_001, 64, 48);
        assert!(bytes.len() == 64 * 48 * usize::from(bits) / 8 || bits == 0, "{format}");
    }
    let mut grey = pattern::packed("grey", 70_001, 64, 48);
    assert_eq!((pattern::number("grey", &grey, 64), pattern::wrong_pixels("grey", 70_001, &grey, 64)), (70_001, 0));
    grey[100] ^= 1;
    assert_eq!(pattern::wrong_pixels("grey", 70_001, &grey, 64), 1);
    assert!(pattern::wrong_pixels("grey", 70_002, &grey, 64) > 3000);
}

#[test]
#[ignore = "needs uvcvideo: make hil"]
fn uvc_pairs_are_exact_and_what_a_camera_skipped_is_counted_exactly() {
    const FPS: u32 = 4;
    let (w, h) = (752, 480);
    let mut left = Uvc::plug(0, "L1", "grey", w, h, FPS);
    let mut right = Uvc::plug(1, "R1", "grey", w, h, FPS);
    let calibration = rig_of(2, w, h);
    let mut rig = open(&settings(&["serial:L1", "serial:R1"], w, h, FPS), &calibration);
    println!("{}", rig.describe().join("\n"));
    let mut frames = Frames::for_rig(&calibration);
    let (mut numbers, mut last) = (Vec::new(), stipple_drivers::Nanos(0));
    let mut cost = CpuTime::default();
    while numbers.len() < 60 {
        let before = thread_cpu();
        next(&mut rig, &mut frames, no_loss);
        let spent = thread_cpu() - before;
        cost = CpuTime { user_s: cost.user_s + spent.user_s, kernel_s: cost.kernel_s + spent.kernel_s };
        let k = number("grey", &frames, FPS);
        assert!(frames.t > last && numbers.last().is_none_or(|l| *l < k));
        (numbers, last) = ([numbers, vec![k]].concat(), frames.t);
        match numbers.len() {
            20 => left.order("skip 3"),
            35 => right.order("skip 2"),
            _ => {}
        }
    }
    // What is still on its way may be counted too: at the end nothing is injected.
    let (first, end) = (numbers[0], *numbers.last().unwrap());
    let unsent = left.unsent(first, end) + right.unsent(first, end);
    let missed = count(&rig, "camera_missed_by_stamp");
    println!("60 pairs of {first} to {end}; {unsent} images not sent, {missed} missed by stamp; {:?}", counted(&rig));
    let ms = |s: f64| 1e3 * s / 60.0;
    println!("a pair: {:.3} ms of emulated CPU, {:.3} of them in the kernel", ms(cost.total_s()), ms(cost.kernel_s));
    let (copied, given) = (count(&rig, "camera_bytes_copied"), count(&rig, "camera_frames"));
    assert_eq!(copied, given * 2 * (w * h) as u64, "each pixel is copied once from the kernel's buffer");
    assert!(unsent >= 5, "5 were skipped on order");
    assert_eq!(missed, unsent, "what the cameras say they did not send");
    assert_eq!(count(&rig, "camera_missed_by_sequence"), 0, "numbers are contiguous over what was never sent");
}

#[test]
#[ignore = "needs uvcvideo: make hil"]
fn uvc_damaged_pictures_leave_a_gap_in_the_numbers() {
    const FPS: u32 = 8;
    let (w, h) = (64, 48);
    let mut camera = Uvc::plug(0, "D1", "grey", w, h, FPS);
    let calibration = rig_of(1, w, h);
    let mut rig = open(&settings(&["serial:D1"], w, h, FPS), &calibration);
    let mut frames = Frames::for_rig(&calibration);
    for i in 0..40 {
        next(&mut rig, &mut frames, no_loss);
        number("grey", &frames, FPS);
        match i {
            10 => camera.order("corrupt 2"),
            20 => camera.order("short 3"),
            _ => {}
        }
    }
    println!("{:?}", counted(&rig));
    // By default uvcvideo keeps damaged pictures to itself, and numbers on.
    assert_eq!(count(&rig, "camera_missed_by_sequence"), 5);
}

#[test]
#[ignore = "needs uvcvideo: make hil"]
fn uvc_every_format_is_exact() {
    const FPS: u32 = 8;
    let (w, h) = (64, 48);
    for (format, ..) in pattern::FORMATS {
        let _camera = Uvc::plug(0, format, format, w, h, FPS);
        let calibration = rig_of(1, w, h);
        let mut rig = open(&settings(&[&format!("serial:{format}")], w, h, FPS), &calibration);
        let mut frames = Frames::for_rig(&calibration);
        for _ in 0..8 {
            next(&mut rig, &mut frames, no_loss);
            number(format, &frames, FPS);
        }
        println!("{}: 8 pictures exact", rig.describe()[0]);
    }
}

#[test]
#[ignore = "needs uvcvideo: make hil"]
fn uvc_one_node_gives_both_side_by_side() {
    const FPS: u32 = 8;
    let _camera = Uvc::plug(0, "SBS", "grey", 128, 48, FPS);
    let calibration = rig_of(2, 64, 48);
    let mut rig = open(&settings(&["serial:SBS"], 64, 48, FPS), &calibration);
    let mut frames = Frames::for_rig(&calibration);
    for _ in 0..8 {
        next(&mut rig, &mut frames, no_loss);
        let rows = frames.images[0].pixels.chunks(64).zip(frames.images[1].pixels.chunks(64));
        let whole: Vec<u8> = rows.flat_map(|(l, r)| [l, r].concat()).collect();
        let k = pattern::number("grey", &whole, 128);
        assert_eq!(pattern::wrong_pixels("grey", k, &whole, 128), 0);
    }
}

#[test]
#[ignore = "needs uvcvideo: make hil"]
fn uvc_without_an_unplugged_camera_the_other_goes_on_and_it_comes_back() {
    const FPS: u32 = 8;
    let (w, h) = (160, 120);
    let left = Uvc::plug(0, "L2", "grey", w, h, FPS);
    let mut right = Uvc::plug(1, "R2", "grey", w, h, FPS);
    let calibration = rig_of(2, w, h);
    let mut rig = open(&settings(&["serial:L2", "serial:R2"], w, h, FPS), &calibration);
    let mut frames = Frames::for_rig(&calibration);
    for round in 1..=3 {
        for _ in 0..10 {
            next(&mut rig, &mut frames, no_loss);
            // A machine that is busy elsewhere may starve one of them for a moment.
            if frames.images[1].pixels.iter().any(|p| *p > 0) {
                number("grey", &frames, FPS);
            }
        }
        right.order("unplug");
        let (mut alone, start) = (0, Instant::now());
        while start.elapsed() < Duration::from_secs(3) {
            let got = rig.next(Span(200 * MS), &mut frames).unwrap() == Wait::Got;
            if got && rig.away().is_some() {
                alone += 1;
                assert!(frames.images[1].pixels.iter().all(|p| *p == 0));
            }
        }
        let away = rig.away().expect("it is unplugged").to_string();
        println!("{alone} frames of the other camera; {away}");
        assert!(alone > 3 && away.contains("serial:R2"));
        let back = Instant::now();
        // Another port of the hub: another path and number.
        right = Uvc::plug(1 + round, "R2", "grey", w, h, FPS);
        while rig.away().is_some() || frames.images[1].pixels.iter().all(|p| *p == 0) {
            next(&mut rig, &mut frames, no_loss);
            assert!(back.elapsed() < Duration::from_secs(60));
        }
        number("grey", &frames, FPS);
        println!("plugged again, the first frame came after {:.2} s", back.elapsed().as_secs_f64());
        assert_eq!(count(&rig, "camera_losses"), u64::from(round));
        assert_eq!(count(&rig, "camera_returns"), u64::from(round));
    }
    drop(left);
}

#[test]
#[ignore = "needs uvcvideo: make hil"]
fn uvc_a_silent_camera_is_opened_again_and_what_is_not_there_is_refused() {
    const FPS: u32 = 8;
    let (w, h) = (64, 48);
    let mut camera = Uvc::plug(0, "S1", "grey", w, h, FPS);
    let calibration = rig_of(1, w, h);
    let asked = settings(&["serial:S1"], w, h, FPS);
    let mut rig = open(&asked, &calibration);
    let mut frames = Frames::for_rig(&calibration);
    (0..8).for_each(|_| next(&mut rig, &mut frames, no_loss));
    let busy = refused(asked.clone(), &calibration).to_string();
    // For three seconds; after two it is opened again.
    camera.order("silent 24");
    let mut lost = Vec::new();
    for _ in 0..16 {
        next(&mut rig, &mut frames, |fault| lost.push(fault.to_string()));
    }
    drop(rig);
    println!("{}\n{busy}", lost[0]);
    assert!(lost[0].contains("gave nothing for"), "{}", lost[0]);
    assert!(busy.contains("VIDIOC_S_FMT") && busy.contains("another program"), "{busy}");
    let line = |s: Settings| {
        let line = refused(s, &calibration).to_string();
        println!("{line}");
        line
    };
    let offers = "it offers GREY 64x48 at 8 Hz";
    assert!(line(Settings { format: Some(Format::Yuyv), ..asked.clone() }).contains(offers));
    assert!(line(Settings { rate_hz: 30.0, pair_tolerance: Span(MS), ..asked.clone() }).contains(offers));
    let other = Settings { devices: vec![Select::Serial("S2".into())], ..asked.clone() };
    assert!(line(other).contains("serial:S1"));
    assert!(line(Settings { exposure: Span(MS), ..asked }).contains("exposure"));
}

/// How long after it was due a picture is stamped, ns: the median of eight.
fn lateness(rig: &mut Rig, frames: &mut Frames, fps: u32) -> i64 {
    let mut late: Vec<i64> = (0..8)
        .map(|_| {
            next(rig, frames, no_loss);
            let image = &frames.images[0];
            let k = pattern::number("grey", &image.pixels, image.width);
            frames.t.0 - i64::from(k) * 1_000_000_000 / i64::from(fps)
        })
        .collect();
    late.sort_unstable();
    late[4]
}

#[test]
#[ignore = "needs uvcvideo: make hil"]
fn uvc_stamps_follow_an_exposure_that_the_camera_sets_by_itself() {
    const FPS: u32 = 8;
    let (w, h) = (64, 48);
    let mut camera = Uvc::plug(0, "AE1", "grey", w, h, FPS);
    let calibration = rig_of(1, w, h);
    let mut rig = open(&settings(&["serial:AE1"], w, h, FPS), &calibration);
    let mut frames = Frames::for_rig(&calibration);
    assert!(rig.describe()[0].contains("exposure 4000 us"), "{:?}", rig.describe());
    let short = lateness(&mut rig, &mut frames, FPS);
    camera.order("expose 640");
    (0..4).for_each(|_| next(&mut rig, &mut frames, no_loss));
    let long = lateness(&mut rig, &mut frames, FPS);
    println!("{}; stamped {} us earlier; {:?}", rig.describe()[0], (short - long) / 1000, counted(&rig));
    assert!(rig.describe()[0].contains("exposure 64000 us"), "{:?}", rig.describe());
    // Half of the 60 ms more; what the emulated bus takes differs by less than ten.
    assert!((short - long - 30 * MS).abs() < 10 * MS, "{short} {long}");
    assert_eq!((count(&rig, "camera_exposure_changes"), count(&rig, "camera_exposures_lost")), (1, 0));
}

/// vivid's first node of the multi-planar API.
fn vivid(format: Format) -> Settings {
    let mut s = settings(&["bus:platform:vivid-000"], 640, 360, 10);
    (s.format, s.stamp) = (Some(format), StampPoint::Driver);
    s
}

fn v4l2_ctl(setting: &str) {
    let status = Command::new("v4l2-ctl").args(["-d", "/dev/video0", "-c", setting]).status();
    assert!(status.unwrap().success(), "v4l2-ctl -c {setting}");
}

#[test]
#[ignore = "needs vivid: make hil"]
fn vivid_gives_the_same_picture_in_every_format_of_a_multi_planar_queue() {
    let calibration = rig_of(1, 640, 360);
    let mut frames = Frames::for_rig(&calibration);
    let mut first: Option<Vec<u8>> = None;
    for format in [Format::Grey, Format::Y10, Format::Y12, Format::Y16, Format::Nv12, Format::Yuyv] {
        let asked = vivid(format);
        let mut rig = match Rig::open(asked, &calibration) {
            Ok(rig) => rig,
            Err(fault) => panic!("{fault}"),
        };
        let mut last = stipple_drivers::Nanos(0);
        for _ in 0..5 {
            next(&mut rig, &mut frames, no_loss);
            assert!(frames.t > last);
            last = frames.t;
        }
        // The text that counts stands on the left; the bars of colour go from white to black.
        let row = frames.images[0].pixels[300 * 640..301 * 640].to_vec();
        let (light, dark) = (row[20], row[620]);
        println!("{}: {light} to {dark}; {:?}", rig.describe()[0], counted(&rig));
        let first = first.get_or_insert_with(|| row.clone());
        let worst = row.iter().zip(first.iter()).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
        // Luma of limited range is scaled: black is 16, white 235.
        assert!(light > 150 && dark < 60 && worst <= 32, "{} differs by {worst}", format.name());
    }
}

/// Bars of three quarters of white, yellow, cyan, green, magenta, red, blue and black, by the kernel's own encoder.
#[test]
#[ignore = "needs vivid: make hil"]
fn vivid_bars_come_in_their_colours() {
    const LEVEL: u8 = 191;
    let calibration = rig_of(1, 640, 360);
    let mut frames = Frames::in_colour(&calibration, 1);
    let bayer = [Format::Rggb, Format::Grbg, Format::Gbrg, Format::Bggr];
    for format in [Format::Nv12, Format::Yuyv].into_iter().chain(bayer) {
        let mut rig = open(&Settings { colours: 1, ..vivid(format) }, &calibration);
        next(&mut rig, &mut frames, no_loss);
        let at = |x: usize| [0, 1, 2].map(|c| frames.colours[0][c].at(x, 300));
        let bars: Vec<[u8; 3]> = (0..8).map(|bar| at(40 + 80 * bar)).collect();
        println!("{}: {bars:?}", rig.describe()[0]);
        for (bar, colour) in bars.iter().enumerate() {
            // Green goes after four bars, red after two, blue after one.
            let exact = [2, 4, 1].map(|bit| if bar & bit == 0 { LEVEL } else { 0 });
            // Half a level of luma and of chroma, by their coefficients, on each side.
            assert!((0..3).all(|c| colour[c].abs_diff(exact[c]) <= 4), "{}: bar {bar} is {colour:?}", format.name());
        }
    }
    let rig = open(&Settings { colours: 1, format: None, ..vivid(Format::Grey) }, &calibration);
    assert!(rig.describe()[0].contains(": nv12 "), "{:?}", rig.describe());
    let fault = refused(Settings { colours: 1, ..vivid(Format::Grey) }, &calibration).to_string();
    assert!(fault.contains("map.colour"), "{fault}");
}

#[test]
#[ignore = "needs vivid: make hil"]
fn vivid_errors_of_the_kernel_are_said_and_survived() {
    let calibration = rig_of(1, 640, 360);
    let mut frames = Frames::for_rig(&calibration);
    let errors = [
        ("inject_vidioc_reqbufs_error=1", "VIDIOC_REQBUFS"),
        ("inject_vidioc_qbuf_error=1", "VIDIOC_QBUF"),
        ("inject_vidioc_streamon_error=1", "VIDIOC_STREAMON"),
    ];
    for (inject, call) in errors {
        v4l2_ctl(inject);
        let fault = refused(vivid(Format::Grey), &calibration).to_string();
        println!("{fault}");
        assert!(fault.contains(call));
    }
    let mut rig = open(&vivid(Format::Grey), &calibration);
    (0..5).for_each(|_| next(&mut rig, &mut frames, no_loss));
    // A buffer marked as damaged.
    v4l2_ctl("inject_v4l2_buf_flag_error=1");
    (0..5).for_each(|_| next(&mut rig, &mut frames, no_loss));
    println!("{:?}", counted(&rig));
    assert_eq!(count(&rig, "camera_images_corrupt"), 1);
    for inject in ["inject_fatal_streaming_error=1", "inject_vidioc_qbuf_error=1", "disconnect=1"] {
        v4l2_ctl(inject);
        let (mut lost, losses) = (Vec::new(), count(&rig, "camera_losses"));
        while count(&rig, "camera_losses") == losses {
            next(&mut rig, &mut frames, |fault| lost.push(fault.to_string()));
        }
        (0..5).for_each(|_| next(&mut rig, &mut frames, |fault| lost.push(fault.to_string())));
        println!("{inject}: {}", lost[0]);
    }
    println!("{:?}", counted(&rig));
    assert_eq!((count(&rig, "camera_losses"), count(&rig, "camera_returns")), (3, 3));
}

#[test]
#[ignore = "needs vivid: make hil"]
fn vivid_numbers_wrap_and_what_it_drops_is_counted_by_numbers_and_by_stamps() {
    let calibration = rig_of(1, 320, 180);
    let mut frames = Frames::for_rig(&calibration);
    let mut asked = vivid(Format::Grey);
    (asked.width, asked.height, asked.rate_hz) = (320, 180, 30.0);
    // Numbers start 128 before they wrap.
    for (setting, frames_asked) in [("wrap_sequence_number=1", 140), ("percentage_of_dropped_buffers=30", 60)] {
        asked.controls =
            vec![(setting.split('=').next().unwrap().to_string(), setting.split('=').nth(1).unwrap().parse().unwrap())];
        let mut rig = open(&asked, &calibration);
        (0..frames_asked).for_each(|_| next(&mut rig, &mut frames, no_loss));
        let (by_number, by_stamp) = (count(&rig, "camera_missed_by_sequence"), count(&rig, "camera_missed_by_stamp"));
        println!("{setting}: {:?}", counted(&rig));
        assert_eq!(by_number, by_stamp);
        assert!(by_number > 0 || setting.starts_with("wrap"));
    }
    v4l2_ctl("percentage_of_dropped_buffers=0");
}
