//! Every system call with every error it can give, at boot and while streaming; and boards that ask for what there is not.
#![cfg(test)]

use super::*;
use std::collections::BTreeSet;

/// What the documentation of these calls names, and what drivers return besides.
const ERRORS: [i32; 13] = [
    libc::EACCES,
    libc::EBUSY,
    libc::EFAULT,
    libc::EINVAL,
    libc::EIO,
    libc::EMFILE,
    libc::ENODEV,
    libc::ENOMEM,
    libc::ENOSPC,
    libc::ENOTTY,
    libc::EPIPE,
    libc::EPROTO,
    libc::ETIMEDOUT,
];

/// Two cameras with an exposure, and a board that asks for all they can. Named by path, so that each call has one place.
fn everything() -> (Machine, Settings) {
    let machine = pair_of_cameras();
    let exposure = control(CID_EXPOSURE_ABSOLUTE, "Exposure Time, Absolute", 1, 1000, 1);
    let gain = control(CID_EXPOSURE - 5, "Gain", 0, 64, 2);
    machine.state().cams.iter_mut().for_each(|c| c.controls = vec![(gain, 0), (exposure, 10)]);
    let mut s = settings(&["path:/dev/left", "path:/dev/right"]);
    for (i, name) in ["/dev/left", "/dev/right"].into_iter().enumerate() {
        machine.state().cams[i].path = name.into();
    }
    s.exposure = Span(5 * MS);
    s.controls = vec![("gain".to_string(), 32)];
    (machine, s)
}

/// What is no failure: a list that has ended, a rate that the driver does not set. A list that ends too soon may lack what is
/// asked for: then that is what is said.
fn is_an_answer(call: &str, errno: i32) -> bool {
    match call {
        "VIDIOC_ENUM_FMT" | "VIDIOC_ENUM_FRAMESIZES" | "VIDIOC_QUERY_EXT_CTRL" | "VIDIOC_S_PARM" => {
            [libc::EINVAL, libc::ENOTTY].contains(&errno)
        }
        _ => false,
    }
}

#[test]
fn at_boot_every_error_of_every_call_is_said_with_its_place_and_leaves_nothing_open() {
    let calls = [
        "open",
        "VIDIOC_QUERYCAP",
        "VIDIOC_ENUM_FMT",
        "VIDIOC_ENUM_FRAMESIZES",
        "VIDIOC_S_FMT",
        "VIDIOC_S_PARM",
        "VIDIOC_QUERY_EXT_CTRL",
        "VIDIOC_S_EXT_CTRLS",
        "VIDIOC_G_EXT_CTRLS",
        "VIDIOC_REQBUFS",
        "VIDIOC_QUERYBUF",
        "mmap",
        "VIDIOC_QBUF",
        "VIDIOC_STREAMON",
    ];
    for call in calls {
        let (machine, s) = everything();
        let rig = open(&machine, s).unwrap();
        // Every time that it is called, of the first camera and of the second.
        let times = machine.state().calls[call];
        drop(rig);
        assert!(times >= 2 && machine.has_everything_back());
        for (after, errno) in (0..times).flat_map(|after| ERRORS.map(|errno| (after, errno))) {
            let (machine, s) = everything();
            machine.fail(call, errno, after, 1);
            let answer = open(&machine, s);
            if let Err(fault) = &answer {
                let line = fault.to_string();
                let error = std::io::Error::from_raw_os_error(errno).to_string();
                let said = line.contains(&format!("{call}: {error}"));
                assert!(said || is_an_answer(call, errno), "{call} {errno}: {line}");
                let place = if after < times / 2 { "/dev/left" } else { "/dev/right" };
                assert!(line.starts_with(place), "{call} {errno} at call {after}: {line}");
                assert!(!fault.fix.is_empty() && !line.contains('\n'), "{call}: {line}");
            }
            assert!(answer.is_err() || is_an_answer(call, errno), "{call} {errno} at call {after} was passed over");
            drop(answer);
            assert!(machine.has_everything_back(), "{call} {errno} at call {after}");
        }
    }
}

#[test]
fn what_cannot_be_asked_is_said_where_it_may_be_the_camera_and_passed_over_where_it_is_another() {
    for call in ["readdir", "open", "VIDIOC_QUERYCAP"] {
        for errno in ERRORS {
            let machine = pair_of_cameras();
            machine.fail(call, errno, 0, 1);
            let line = open(&machine, settings(&["serial:0000", "serial:0001"])).err().unwrap().to_string();
            let place = if call == "readdir" { "video4linux" } else { "/dev/video0" };
            assert!(line.contains(call) && line.contains(place), "{line}");
            assert!(machine.has_everything_back());
            machine.fail(call, errno, 1, 1);
            let answer = open(&machine, settings(&["serial:0000", "serial:0001"]));
            assert_eq!(answer.is_ok(), call != "readdir", "the second node is not the first camera");
        }
    }
}

#[test]
fn while_streaming_every_error_of_every_call_is_survived_and_counted() {
    for call in ["VIDIOC_DQBUF", "VIDIOC_QBUF", "poll"] {
        for errno in ERRORS {
            let machine = pair_of_cameras();
            let (mut rig, mut frames) = opened(&machine);
            (0..2).for_each(|camera| machine.shoot(camera, 1..400, |_, _| {}));
            take(&mut rig, &mut frames, 5);
            machine.fail(call, errno, 3, 1);
            let other = take(&mut rig, &mut frames, 200);
            let lost = other.iter().find_map(|o| o.as_ref().err());
            let times = (count(&rig, "camera_losses"), count(&rig, "camera_returns"));
            if call == "VIDIOC_DQBUF" && errno == libc::EIO {
                // The driver says that one frame is gone, and nothing else is.
                assert_eq!((count(&rig, "camera_io_errors"), times, lost), (1, (0, 0), None));
            } else {
                assert!(rig.warnings()[0].contains(call), "{call} {errno}: {:?}", rig.warnings());
                // A wait is of all cameras; else the other goes on alone.
                assert_eq!(times, if call == "poll" { (2, 2) } else { (1, 1) }, "{call} {errno}");
                assert_eq!(lost.is_some(), call == "poll", "{lost:?}");
                assert_eq!(count(&rig, "camera_images_absent") > 0, call != "poll");
                assert!(rig.away().is_none() && frames.images.iter().all(|i| i.pixels.iter().any(|p| *p > 0)));
            }
            drop(rig);
            assert!(machine.has_everything_back(), "{call} {errno}");
        }
    }
}

#[test]
fn a_wait_that_fails_while_a_camera_is_away_ends_the_source() {
    let machine = pair_of_cameras();
    let (mut rig, mut frames) = opened(&machine);
    machine.state().cams.iter_mut().for_each(|c| c.present = false);
    assert!(matches!(rig.next(Span(MS), &mut frames), Err(SourceFault::Lost(_))));
    machine.fail("poll", libc::ENOMEM, 0, 1);
    let broken = rig.next(Span(MS), &mut frames).unwrap_err();
    assert!(matches!(&broken, SourceFault::Broken(f) if f.to_string().contains("poll")), "{broken}");
}

#[test]
fn a_driver_that_only_hangs_up_or_misnames_its_buffers_is_a_loss() {
    let machine = pair_of_cameras();
    let (mut rig, mut frames) = opened(&machine);
    machine.state().cams[1].hangs = true;
    (0..20).for_each(|_| drop(rig.next(Span(MS), &mut frames)));
    let lost = rig.away().expect("it is no endless wait").to_string();
    assert!(lost.contains("/dev/video1") && lost.contains("poll reports an error"), "{lost}");
    machine.state().cams[1].hangs = false;
    (0..2).for_each(|camera| machine.shoot(camera, 1..400, |_, _| {}));
    take(&mut rig, &mut frames, 15);
    assert!(rig.away().is_none());
    machine.state().cams[0].misnames = Some(99);
    take(&mut rig, &mut frames, 5);
    let lost = rig.away().expect("buffer 99 is not read").to_string();
    assert!(lost.contains("/dev/video0") && lost.contains("a buffer that there is not"), "{lost}");
    machine.state().cams[0].misnames = None;
    take(&mut rig, &mut frames, 5);
    drop(rig);
    assert!(machine.has_everything_back());
}

#[test]
fn errors_that_do_not_end_are_a_loss_and_no_endless_loop() {
    let machine = pair_of_cameras();
    let (mut rig, mut frames) = opened(&machine);
    (0..2).for_each(|camera| machine.shoot(camera, 1..400, |_, _| {}));
    take(&mut rig, &mut frames, 5);
    machine.fail("VIDIOC_DQBUF", libc::EIO, 0, 1_000_000);
    let answers: Vec<_> = (0..20).map(|_| rig.next(Span(100 * MS), &mut frames)).collect();
    assert!(answers.iter().all(|a| *a != Ok(Wait::Got)));
    assert!(count(&rig, "camera_losses") >= 1);
    machine.state().fails.clear();
    take(&mut rig, &mut frames, 20);
}

#[test]
fn what_fails_while_it_is_given_back_changes_nothing() {
    for call in ["VIDIOC_STREAMOFF", "VIDIOC_REQBUFS"] {
        for errno in ERRORS {
            let machine = pair_of_cameras();
            let (rig, _) = opened(&machine);
            machine.fail(call, errno, 0, 2);
            drop(rig);
            assert!(machine.state().failed.contains(call));
            assert!(machine.has_everything_back(), "{call} {errno}");
        }
    }
}

#[test]
fn rates_that_cannot_be_listed_are_left_out_of_the_list() {
    for errno in ERRORS {
        let machine = pair_of_cameras();
        machine.fail("VIDIOC_ENUM_FRAMEINTERVALS", errno, 0, 100);
        let mut s = settings(&["serial:0000", "serial:0001"]);
        s.format = Some(Format::Yuyv);
        let line = open(&machine, s).err().unwrap().to_string();
        assert!(line.contains("GREY 6x4; GREY 32x16"), "{line}");
        assert!(machine.state().failed.contains("VIDIOC_ENUM_FRAMEINTERVALS"));
    }
}

/// The tests above, together, have met an error of every request there is.
#[test]
fn no_request_is_without_a_test_of_its_errors() {
    let source = concat!(include_str!("errors.rs"), include_str!("exposures.rs"));
    let kernel = include_str!("../kernel.rs");
    let names: BTreeSet<&str> = kernel.split('"').filter(|s| s.starts_with("VIDIOC_")).collect();
    assert!(names.len() >= 15, "{names:?}");
    for name in names {
        assert!(source.contains(&format!("\"{name}\"")), "{name} is not made to fail");
    }
}

#[track_caller]
fn refused(machine: &Machine, s: Settings, parts: &[&str]) {
    let fault = open(machine, s).err().expect("must be refused");
    let line = fault.to_string();
    assert!(!fault.fix.is_empty() && !line.contains('\n'), "{line}");
    for part in parts {
        assert!(line.contains(part), "`{part}` is not in `{line}`");
    }
    assert!(machine.has_everything_back());
}

#[test]
fn what_a_camera_does_not_offer_is_refused_with_what_it_offers() {
    let both = || settings(&["serial:0000", "serial:0001"]);
    let list = "GREY 6x4 at 20 Hz; GREY 32x16 at 20 Hz";
    let machine = pair_of_cameras();
    refused(&machine, Settings { format: Some(Format::Mjpeg), ..both() }, &["/dev/video0", "mjpeg at 6x4", list]);
    refused(&machine, Settings { rate_hz: 30.0, ..both() }, &["30 Hz, but 20.000 Hz", list, "camera.rate_hz"]);
    refused(&machine, Settings { exposure: Span(MS), ..both() }, &["exposure", "it has none"]);
    let controls = |name: &str, value| Settings { controls: vec![(name.to_string(), value)], ..both() };
    refused(&machine, controls("gain", 3), &["camera.controls.gain", "it has none"]);
    // A driver that sets another size without a word.
    machine.state().cams[0].adjust = |got| got.0 = 5;
    refused(&machine, both(), &["/dev/video0", "but GREY at 5x4", list]);
    // A driver whose numbers cannot be.
    machine.state().cams[0].adjust = |got| got.2 = 5;
    refused(&machine, both(), &["rows of 5 bytes", "driver"]);
    machine.state().cams[0].adjust = |_| {};
    machine.state().cams[0].buffer_bytes = WIDTH * HEIGHT - 1;
    refused(&machine, both(), &["pictures of 23", "driver"]);
    let machine = pair_of_cameras();
    machine.state().cams[1].buffers_given = 2;
    refused(&machine, both(), &["/dev/video1", "2 buffers"]);
    machine.state().cams[0].capabilities = CAP_STREAMING | 2;
    refused(
        &machine,
        Settings { devices: vec![Select::Path("/dev/video0".into()), Select::Serial("0001".into())], ..both() },
        &["does not stream video"],
    );
}

#[test]
fn a_camera_without_rates_of_its_own_is_believed() {
    let machine = pair_of_cameras();
    machine.state().cams.iter_mut().for_each(|c| c.interval = None);
    let (mut rig, mut frames) = opened(&machine);
    (0..2).for_each(|camera| machine.shoot(camera, 1..10, |_, _| {}));
    take(&mut rig, &mut frames, 9);
    assert_eq!(count(&rig, "camera_missed_by_stamp"), 0);
}

#[test]
fn controls_are_checked_against_what_the_camera_states() {
    let (machine, s) = everything();
    drop(open(&machine, s.clone()).unwrap());
    let values: Vec<i64> = machine.state().cams[1].controls.iter().map(|c| c.1).collect();
    assert_eq!(values, [32, 50], "gain, and 5 ms in units of 0.1 ms");
    let controls = |name: &str, value| Settings { controls: vec![(name.to_string(), value)], ..s.clone() };
    refused(&machine, controls("gain", 65), &["`gain` = 65", "0 to 64 in steps of 2"]);
    refused(&machine, controls("gain", 33), &["`gain` = 33", "steps of 2"]);
    refused(&machine, controls("gain", i64::MIN), &["`gain`"]);
    refused(&machine, controls("gian", 2), &["gian", "gain (0 to 64), exposure_time_absolute (1 to 1000)"]);
    refused(&machine, Settings { exposure: Span(500 * MS), ..s.clone() }, &["camera.exposure_us", "= 5000"]);
    machine.state().cams[0].controls[0].0.flags = CONTROL_READ_ONLY;
    refused(&machine, s, &["can only be read"]);
}

#[test]
fn exposure_is_set_in_lines_where_the_camera_counts_them_and_made_manual_where_it_is_not() {
    let (machine, mut s) = everything();
    let lines = control(CID_EXPOSURE, "Exposure", 4, 2000, 1);
    machine.state().cams.iter_mut().for_each(|c| c.controls = vec![(lines, 100)]);
    s.controls.clear();
    refused(&machine, s.clone(), &["exposure", "camera.exposure_line_us"]);
    s.exposure_line = Span(20_000);
    let rig = open(&machine, s.clone()).unwrap();
    assert!(rig.describe()[1].contains("exposure 5000 us"));
    drop(rig);
    assert_eq!(machine.state().cams[0].controls[0].1, 250);
    let auto = control(CID_EXPOSURE_AUTO, "Auto Exposure", 0, 3, 1);
    let exposure = control(CID_EXPOSURE_ABSOLUTE, "Exposure Time, Absolute", 1, 1000, 1);
    machine.state().cams.iter_mut().for_each(|c| c.controls = vec![(auto, 3), (exposure, 10)]);
    drop(open(&machine, s).unwrap());
    assert_eq!(machine.state().cams[0].controls.iter().map(|c| c.1).collect::<Vec<_>>(), [EXPOSURE_MANUAL, 50]);
}

#[test]
fn a_camera_is_named_by_serial_bus_or_link_and_never_by_number() {
    for text in ["/dev/video0", "path:/dev/video0", "path:video0", "path:", "serial:", "usb:1", ""] {
        assert!(Select::parse(text).is_err(), "{text}");
    }
    for text in ["serial:0001", "bus:usb-xhci-hcd.1-2", "path:/dev/v4l/by-path/pci-0-usb-0:1:1.0-video-index0"] {
        assert_eq!(Select::parse(text).unwrap().to_string(), text);
    }
    let machine = pair_of_cameras();
    // In whichever order they were found.
    machine.state().cams.swap(0, 1);
    let (rig, _) = opened(&machine);
    assert!(rig.describe()[0].starts_with("/dev/video0") && rig.describe()[1].starts_with("/dev/video1"));
    drop(rig);
    drop(open(&machine, settings(&["bus:usb-0-2", "serial:0000"])).unwrap());
    refused(
        &machine,
        settings(&["bus:usb-0-3", "serial:0000"]),
        &["bus:usb-0-3: no such camera", "bus:usb-0-1, serial:0000"],
    );
    refused(&machine, settings(&["serial:0000", "serial:0000"]), &["twice"]);
    refused(&machine, settings(&[]), &["names 0", "2 cameras"]);
    refused(&machine, settings(&["serial:0000", "serial:0001", "bus:usb-0-2"]), &["names 3"]);
    refused(&machine, Settings { width: 7, ..settings(&["serial:0000", "serial:0001"]) }, &["calibration is of 6x4"]);
    let loose = Settings { pair_tolerance: Span(25 * MS), ..settings(&["serial:0000", "serial:0001"]) };
    refused(&machine, loose, &["pair_tolerance_s", "half a period"]);
    refused(&machine, Settings { rate_hz: f64::NAN, ..settings(&["serial:0000", "serial:0001"]) }, &["rate_hz"]);
    // Two streams of one device share its serial number; a node of metadata does not count.
    machine.state().cams[0].serial = Some("0000".into());
    refused(&machine, settings(&["serial:0000", "bus:usb-0-2"]), &["2 nodes fit", "by-path"]);
    machine.state().cams[0].capabilities = CAP_STREAMING | 0x0080_0000;
    refused(&machine, settings(&["serial:0000", "bus:usb-0-2"]), &["bus:usb-0-2: no such camera"]);
    machine.state().cams.clear();
    refused(&machine, settings(&["serial:0000", "serial:0001"]), &["there is none"]);
}
