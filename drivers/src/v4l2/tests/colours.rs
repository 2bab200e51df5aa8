//! Colours from the kernel's buffer to the frame, the choice of a format that has them, and cameras without.
#![cfg(test)]

use super::*;
use crate::record;
use crate::replay::{OpenOptions, Recording};
use crate::source::ImuReading;
use crate::types::{Colour, ImuSample};
use crate::ycbcr::Matrix;

/// A camera of these formats, whose rows take as many bytes as those of the widest.
fn camera(index: usize, codes: &[&[u8; 4]]) -> Cam {
    let mut cam = Cam::new(index);
    cam.formats = codes.iter().map(|code| (**code, vec![(WIDTH as u32, HEIGHT as u32)])).collect();
    cam.adjust = |size| size.2 *= 2;
    cam.buffer_bytes = 2 * WIDTH * HEIGHT * 2;
    cam
}

fn machine(left: &[&[u8; 4]], right: &[&[u8; 4]]) -> Machine {
    Machine::new(vec![camera(0, left), camera(1, right)])
}

/// Two cameras, the first `colours` of them in colour.
fn asked(colours: usize) -> Settings {
    Settings { colours, ..settings(&["serial:0000", "serial:0001"]) }
}

fn shape(colours: usize) -> Frames {
    Frames::in_colour(&rig_of(2, WIDTH, HEIGHT), colours)
}

/// Names of the chosen formats.
fn chosen(rig: &Rig) -> Vec<String> {
    rig.describe().iter().map(|line| line.split(": ").nth(1).unwrap().split(' ').next().unwrap().to_string()).collect()
}

/// Rows of YUYV, of one colour.
fn yuyv([y, cb, cr]: [u8; 3]) -> Vec<u8> {
    [y, cb, y, cr].repeat(WIDTH / 2 * HEIGHT)
}

fn is(colour: &Colour, [r, g, b]: [u8; 3]) -> bool {
    colour.iter().zip([r, g, b]).all(|(plane, level)| plane.pixels.iter().all(|p| *p == level))
}

#[test]
fn colours_come_with_the_grey_of_the_cameras_that_are_asked_for_them() {
    let machine = machine(&[b"GREY", b"MJPG", b"YUYV"], &[b"GREY", b"YUYV"]);
    let mut rig = open(&machine, asked(1)).unwrap();
    assert_eq!(chosen(&rig), ["yuyv", "yuyv"], "the other has the same levels");
    let mut frames = shape(1);
    for camera in 0..2 {
        machine.shoot(camera, 1..4, |k, s| s.bytes = yuyv([100 + k as u8, 90, 200]));
    }
    take(&mut rig, &mut frames, 3);
    assert!(frames.images.iter().all(|image| image.pixels.iter().all(|p| *p == 103)));
    assert!(is(&frames.colours[0], Matrix::new(0.299, 0.114, false).rgb(103, 90, 200)), "{:?}", frames.colours[0]);
    let copied = (3 * (4 + 1) * WIDTH * HEIGHT) as u64;
    assert_eq!(counted(&rig), [("camera_frames", 3), ("camera_bytes_copied", copied)], "each plane is copied once");
    // Who does not want them has the grey alone; more than were asked for there are not.
    let mut grey = shape(0);
    (0..2).for_each(|camera| machine.shoot(camera, 4..5, |_, s| s.bytes = yuyv([50, 128, 128])));
    take(&mut rig, &mut grey, 1);
    assert_eq!(grey.images[0].pixels, [50; WIDTH * HEIGHT]);
    assert!(matches!(rig.next(Span(0), &mut shape(2)), Err(SourceFault::Broken(_))));
    let mut small = shape(1);
    small.colours[0][2] = crate::Image::new(1, 1);
    assert!(matches!(rig.next(Span(0), &mut small), Err(SourceFault::Broken(_))));
}

#[test]
fn matrix_and_range_are_those_that_the_driver_states_in_both_kinds_of_queue() {
    for (capabilities, (colorspace, encoding, quantization), matrix) in [
        (CAP_CAPTURE, (3, 0, 0), Matrix::new(0.2126, 0.0722, false)),
        (CAP_CAPTURE, (8, 2, 1), Matrix::new(0.2126, 0.0722, true)),
        (CAP_CAPTURE_MULTI, (8, 0, 0), Matrix::new(0.299, 0.114, false)),
        (CAP_CAPTURE_MULTI, (8, 2, 1), Matrix::new(0.2126, 0.0722, true)),
    ] {
        let machine = machine(&[b"YUYV"], &[b"YUYV"]);
        for cam in &mut machine.state().cams {
            (cam.capabilities, cam.stated) = (capabilities | CAP_STREAMING, [colorspace, encoding, quantization]);
        }
        let (mut rig, mut frames) = (open(&machine, asked(2)).unwrap(), shape(2));
        (0..2).for_each(|camera| machine.shoot(camera, 1..2, |_, s| s.bytes = yuyv([90, 110, 170])));
        take(&mut rig, &mut frames, 1);
        assert!(frames.colours.iter().all(|colour| is(colour, matrix.rgb(90, 110, 170))), "{colorspace} {encoding}");
    }
}

#[test]
fn a_format_in_colour_is_chosen_in_order_and_only_where_it_is_asked_for() {
    let all: [&[u8; 4]; 6] = [b"MJPG", b"BA81", b"YUYV", b"NV12", b"Y10 ", b"GREY"];
    for (codes, in_colour, in_grey) in [
        (&all[..], "nv12", "grey"),
        (&all[..3], "yuyv", "yuyv"),
        (&all[..2], "bggr", "bggr"),
        (&all[..1], "mjpeg", "mjpeg"),
    ] {
        assert_eq!(chosen(&open(&machine(codes, codes), asked(2)).unwrap()), [in_colour; 2]);
        assert_eq!(chosen(&open(&machine(codes, codes), asked(0)).unwrap()), [in_grey; 2]);
    }
    // The second camera is read in grey, and has nothing else.
    assert_eq!(chosen(&open(&machine(&all, &[b"Y10 "]), asked(1)).unwrap()), ["nv12", "y10"]);
    let named = Settings { format: Some(Format::Mjpeg), ..asked(2) };
    assert_eq!(chosen(&open(&machine(&all, &all), named).unwrap()), ["mjpeg"; 2]);
}

#[test]
fn a_camera_without_colour_is_refused_with_what_it_offers_and_what_to_do() {
    let fault = |machine: Machine, settings| {
        let fault = open(&machine, settings).err().expect("must be refused");
        assert_eq!(fault.kind, FaultKind::Config);
        assert!(machine.has_everything_back());
        fault.to_string()
    };
    let said = fault(machine(&[b"YUYV"], &[b"GREY", b"Y10 ", b"NM12"]), asked(2));
    println!("{said}");
    for words in
        ["/dev/video1", "map.colour = true", "GREY 6x4", "Y10 6x4", "NM12 are not read", "set map.colour = false"]
    {
        assert!(said.contains(words), "{words}: {said}");
    }
    let named = |format| Settings { format: Some(format), ..asked(1) };
    let said = fault(machine(&[b"YUYV", b"GREY"], &[b"YUYV"]), named(Format::Grey));
    println!("{said}");
    assert!(said.contains("map.colour = true, but camera.format = \"grey\" is grey"), "{said}");
    let said = fault(machine(&[b"YUYV", b"GREY"], &[b"YUYV"]), named(Format::Nv12));
    assert!(said.contains("gives no nv12 picture in colour at 6x4") && said.contains("YUYV 6x4"), "{said}");
    // Buffers that end before the chroma.
    let machine = machine(&[b"NV12"], &[b"NV12"]);
    for cam in &mut machine.state().cams {
        cam.adjust = |_| {};
        cam.buffer_bytes = WIDTH * HEIGHT * 3 / 2 - 1;
    }
    assert!(open(&machine, asked(0)).is_ok());
    assert!(open(&machine, asked(1)).err().unwrap().to_string().contains("too few for 6x4"));
}

#[test]
fn a_picture_cut_in_its_chroma_and_a_lost_cameras_are_black_in_every_plane() {
    let machine = machine(&[b"NV12"], &[b"NV12"]);
    machine.state().cams.iter_mut().for_each(|cam| cam.adjust = |_| {});
    let (mut rig, mut frames) = (open(&machine, asked(2)).unwrap(), shape(2));
    let whole = vec![128; WIDTH * HEIGHT * 3 / 2];
    for camera in 0..2 {
        machine.shoot(camera, 1..3, |k, s| {
            s.bytes = whole.clone();
            s.bytes.truncate(whole.len() - usize::from((camera, k) == (0, 2)));
        });
    }
    take(&mut rig, &mut frames, 1);
    let level = Matrix::new(0.299, 0.114, false).rgb(128, 128, 128);
    assert!(frames.colours.iter().all(|colour| is(colour, level)));
    take(&mut rig, &mut frames, 1);
    assert!(is(&frames.colours[0], [0; 3]) && is(&frames.colours[1], level));
    assert_eq!((count(&rig, "camera_images_short"), &*frames.images[0].pixels), (1, &[0; WIDTH * HEIGHT][..]));
    machine.state().cams[1].present = false;
    machine.shoot(0, 3..40, |_, s| s.bytes = whole.clone());
    while count(&rig, "camera_images_absent") == 0 {
        take(&mut rig, &mut frames, 1);
    }
    assert!(is(&frames.colours[0], level) && is(&frames.colours[1], [0; 3]));
}

#[test]
fn halves_of_one_node_have_colours_of_their_own() {
    let mut cam = camera(0, &[b"GREY", b"YUYV"]);
    cam.formats.iter_mut().for_each(|f| f.1 = vec![(2 * WIDTH as u32, HEIGHT as u32)]);
    cam.buffer_bytes *= 2;
    let machine = Machine::new(vec![cam]);
    let s = Settings { colours: 1, ..settings(&["serial:0000"]) };
    let (mut rig, mut frames) = (open(&machine, s).unwrap(), shape(1));
    let row = [[90, 60, 90, 200].repeat(WIDTH / 2), [40, 128, 40, 128].repeat(WIDTH / 2)].concat();
    machine.shoot(0, 1..2, |_, s| s.bytes = row.repeat(HEIGHT));
    take(&mut rig, &mut frames, 1);
    assert!(is(&frames.colours[0], Matrix::new(0.299, 0.114, false).rgb(90, 60, 200)));
    assert_eq!((frames.images[0].at(5, 3), frames.images[1].at(0, 0)), (90, 40));
}

/// What is flown is what is recorded: the colours of a live frame come back from the files.
#[test]
fn a_recording_of_live_frames_is_in_their_colours() {
    let machine = machine(&[b"BA81"], &[b"YUYV"]);
    machine.state().cams[0].adjust = |_| {};
    let (mut rig, mut frames) = (open(&machine, asked(2)).unwrap(), shape(2));
    machine.shoot(0, 1..2, |_, s| s.bytes = [[200, 90, 200, 90, 200, 90], [90, 10, 90, 10, 90, 10]].concat().repeat(2));
    machine.shoot(1, 1..2, |_, s| s.bytes = yuyv([103, 90, 200]));
    take(&mut rig, &mut frames, 1);
    assert!(is(&frames.colours[0], [10, 90, 200]));
    let (dir, mut calibration) = (tempfile::tempdir().unwrap(), rig_of(2, WIDTH, HEIGHT));
    calibration.cameras[1].body_from_cam.p.x = 0.1;
    let mut sink = record::open(&dir.path().join("flight"), record::Format::Euroc, &calibration).unwrap();
    sink.frames(&frames).unwrap();
    for i in -20..20 {
        let sample = ImuSample { t: frames.t + Span(5 * MS * i), ..ImuSample::default() };
        sink.imu(&ImuReading { sample, ..ImuReading::default() }).unwrap();
    }
    sink.finish().unwrap();
    let recording = Recording::open(&dir.path().join("flight"), &OpenOptions::default()).unwrap();
    let (mut reader, mut read) = (recording.reader(), shape(2));
    assert!(reader.has_colour(2));
    reader.read(0, &mut read).unwrap();
    assert_eq!(read.colours, frames.colours);
    assert_eq!(read.images[0], frames.images[0], "a sensor's own pixels have the grey of their colours");
}
