//! Frames as they should be, as they should not, and what is counted then.
#![cfg(test)]

use super::*;

#[test]
fn pairs_come_whole_in_order_and_stamped() {
    let machine = pair_of_cameras();
    let (mut rig, mut frames) = opened(&machine);
    machine.shoot(0, 1..40, |_, _| {});
    // The right one is delivered later, as over a bus they share.
    machine.shoot(1, 1..40, |_, s| (s.at, s.stamp) = (s.at + 3 * MS, s.stamp + MS));
    for k in 1..40 {
        assert_eq!(rig.next(Span(100 * MS), &mut frames), Ok(Wait::Got));
        assert_is(&frames, k);
    }
    let copied = (39 * 2 * WIDTH * HEIGHT) as u64;
    assert_eq!(counted(&rig), [("camera_frames", 39), ("camera_bytes_copied", copied)], "each pixel is copied once");
    assert!(rig.warnings().is_empty());
    // A pair costs each camera a buffer taken and given back; four are queued at the start. Of eight asked for, six are in vain.
    let calls = |name: &str| machine.state().calls[name];
    assert_eq!(calls("VIDIOC_QBUF"), 2 * (39 + 4));
    assert!(calls("VIDIOC_DQBUF") <= 39 * 8 && calls("poll") <= 39 * 2);
    assert_eq!(rig.next(Span(100 * MS), &mut frames), Ok(Wait::TimedOut));
    assert_eq!(count(&rig, "camera_timeouts"), 1);
    drop(rig);
    assert!(machine.has_everything_back());
}

#[test]
fn stamps_are_brought_to_the_calibrations_clock_and_middle_row() {
    let machine = pair_of_cameras();
    let mut s = settings(&["serial:0000", "serial:0001"]);
    let exposure = control(CID_EXPOSURE_ABSOLUTE, "Exposure Time, Absolute", 1, 1000, 1);
    machine.state().cams.iter_mut().for_each(|c| c.controls = vec![(exposure, 40)]);
    (s.stamp, s.transfer) = (StampPoint::FrameEnd, Span(10 * MS));
    let mut calibration = rig_of(2, WIDTH, HEIGHT);
    for c in &mut calibration.cameras {
        (c.time_offset, c.readout) = (Span(7), Span(6 * MS));
    }
    let mut rig = Rig::open_in(Arc::new(machine.clone()), s, &calibration).unwrap();
    let mut frames = Frames::for_rig(&calibration);
    (0..2).for_each(|camera| machine.shoot(camera, 1..2, |_, _| {}));
    take(&mut rig, &mut frames, 1);
    // Received 10 ms after an exposure of 4 ms; the middle row is 3 ms after the first.
    assert_eq!(frames.t, Nanos(BOOT + PERIOD - MS - 10 * MS - 2 * MS + 7 + 3 * MS));
    assert!(rig.describe()[0].contains("exposure 4000 us"), "{:?}", rig.describe());
}

#[test]
fn what_was_lost_at_the_source_and_in_the_driver_is_counted_by_what_can_tell() {
    let machine = pair_of_cameras();
    let (mut rig, mut frames) = opened(&machine);
    // Both cameras send nothing at 5 and 6 and number on; the driver of the left one loses 10.
    for camera in 0..2 {
        machine.shoot(camera, 1..5, |_, _| {});
        machine.shoot(camera, 7..10, |k, s| s.sequence = k - 2);
    }
    machine.shoot(0, 11..20, |k, s| s.sequence = k - 2);
    machine.shoot(1, 10..20, |k, s| s.sequence = k - 2);
    let other = take(&mut rig, &mut frames, 16);
    assert!(other.iter().all(|o| *o == Ok(Wait::TimedOut)), "{other:?}");
    assert_is(&frames, 19);
    assert_eq!(count(&rig, "camera_missed_by_stamp"), 2 + 2 + 1);
    assert_eq!(count(&rig, "camera_missed_by_sequence"), 1);
    assert_eq!(count(&rig, "camera_images_unpaired"), 1);
}

#[test]
fn whatever_is_dropped_its_buffer_comes_back() {
    type Change = fn(u32, &mut machine::Shot);
    let cases: [(&str, Change); 6] = [
        ("camera_images_corrupt", |_, s| s.flags |= BUFFER_ERROR),
        ("camera_images_short", |_, s| s.bytes.truncate(WIDTH * HEIGHT - 1)),
        ("camera_images_short", |_, s| s.bytes.clear()),
        ("camera_stamps_implausible", |_, s| s.stamp += 5_000 * MS),
        ("camera_stamps_not_newer", |_, s| s.stamp = BOOT - 1_000 * MS),
        ("camera_images_unpaired", |_, s| s.stamp -= 7 * MS),
    ];
    for (counter, spoil) in cases {
        let machine = pair_of_cameras();
        let (mut rig, mut frames) = opened(&machine);
        // The first of each is whole; a hundred are spoilt, many times the buffers; then one is whole again.
        machine.shoot(0, 1..103, |k, s| {
            if k > 1 && k < 102 {
                spoil(k, s)
            }
        });
        machine.shoot(1, 1..103, |_, _| {});
        take(&mut rig, &mut frames, 1);
        assert_is(&frames, 1);
        // One that gives nothing whole for long is gone on without.
        while frames.t.0 < BOOT + 102 * PERIOD - MS {
            let _ = rig.next(Span(100 * MS), &mut frames);
        }
        assert_is(&frames, 102);
        assert_eq!(count(&rig, counter), if counter.ends_with("unpaired") { 200 } else { 100 }, "{counter}");
        assert_eq!(machine.state().cams.iter().map(|c| c.dropped).sum::<usize>(), 0, "{counter}: buffers ran out");
        assert_eq!(count(&rig, "camera_losses"), 0);
    }
}

#[test]
fn frames_of_another_clock_are_stamped_on_arrival_and_counted() {
    for (flags, counter) in [(0, "camera_stamps_unknown"), (STAMP_COPY, "camera_stamps_copied")] {
        let machine = pair_of_cameras();
        let (mut rig, mut frames) = opened(&machine);
        (0..2).for_each(|camera| machine.shoot(camera, 1..10, |_, s| (s.flags, s.stamp) = (flags, 12345)));
        take(&mut rig, &mut frames, 9);
        assert_eq!(frames.t, Nanos(BOOT + 9 * PERIOD));
        assert_eq!(count(&rig, counter), 18);
    }
}

#[test]
fn equal_and_backward_stamps_never_come_out() {
    let machine = pair_of_cameras();
    let (mut rig, mut frames) = opened(&machine);
    for camera in 0..2 {
        machine.shoot(camera, 1..20, |k, s| match k {
            7 => s.stamp -= PERIOD,
            11 => s.stamp -= 3 * PERIOD,
            _ => {}
        });
    }
    let mut last = Nanos(0);
    for _ in 0..17 {
        assert_eq!(rig.next(Span(200 * MS), &mut frames), Ok(Wait::Got));
        assert!(frames.t > last);
        last = frames.t;
    }
    assert_eq!(count(&rig, "camera_stamps_not_newer"), 4);
}

#[test]
fn a_reader_that_pauses_gets_old_frames_in_order_and_the_loss_is_counted() {
    let machine = pair_of_cameras();
    let (mut rig, mut frames) = opened(&machine);
    (0..2).for_each(|camera| machine.shoot(camera, 1..41, |_, _| {}));
    take(&mut rig, &mut frames, 1);
    machine.state().now += 20 * PERIOD;
    for k in 2..6 {
        assert_eq!(rig.next(Span(MS), &mut frames), Ok(Wait::Got));
        assert_is(&frames, k);
    }
    take(&mut rig, &mut frames, 19);
    assert_is(&frames, 40);
    let lost: usize = machine.state().cams.iter().map(|c| c.dropped).sum();
    assert_eq!((count(&rig, "camera_missed_by_sequence"), lost), (2 * 16, 2 * 16));
}

/// The left picture is black, the right one is picture `k`.
fn assert_is_alone(frames: &Frames, k: u32) {
    assert_eq!(frames.t, Nanos(BOOT + i64::from(k) * PERIOD - MS));
    assert!(frames.images[0].pixels.iter().all(|p| *p == 0));
    assert!((0..WIDTH * HEIGHT).all(|i| frames.images[1].pixels[i] == machine::pixel(1, k, i)));
}

#[test]
fn without_one_camera_the_other_goes_on_and_it_comes_back_by_itself_under_another_number() {
    let machine = pair_of_cameras();
    let (mut rig, mut frames) = opened(&machine);
    (0..2).for_each(|camera| machine.shoot(camera, 1..200, |_, _| {}));
    take(&mut rig, &mut frames, 10);
    machine.state().cams[0].present = false;
    for k in 11..40 {
        assert_eq!(rig.next(Span(100 * MS), &mut frames), Ok(Wait::Got), "no frame is missed");
        assert_is_alone(&frames, k);
        let away = rig.away().expect("it is gone").to_string();
        let words = if k < 12 { ["/dev/video0", "unplugged"] } else { ["serial:0000", "serial:0001)"] };
        assert!(k == 12 || words.iter().all(|w| away.contains(w)) && away.contains("cable"), "{k}: {away}");
    }
    {
        let mut s = machine.state();
        s.cams[0].present = true;
        s.cams[0].path = "/dev/video7".into();
    }
    take(&mut rig, &mut frames, 60);
    assert!(rig.away().is_none(), "it comes back within its longest pause");
    assert_is(&frames, 99);
    assert_eq!((count(&rig, "camera_losses"), count(&rig, "camera_returns")), (1, 1));
    assert_eq!(count(&rig, "camera_missed_by_stamp"), 0, "a loss is no gap");
    drop(rig);
    assert!(machine.has_everything_back());
}

#[test]
fn a_lost_cameras_black_images_are_counted_in_frames_alone() {
    let machine = pair_of_cameras();
    let (mut rig, mut frames) = opened(&machine);
    machine.shoot(0, 1..11, |_, _| {});
    machine.shoot(1, 1..40, |k, s| s.bytes.truncate(if (15..25).contains(&k) { 1 } else { usize::MAX }));
    take(&mut rig, &mut frames, 10);
    machine.state().cams[0].present = false;
    take(&mut rig, &mut frames, 19);
    assert_is_alone(&frames, 39);
    assert_eq!((count(&rig, "camera_images_short"), count(&rig, "camera_images_absent")), (10, 19));
}

#[test]
fn without_any_camera_the_rig_is_lost_at_once_and_comes_back_by_itself() {
    let machine = pair_of_cameras();
    let (mut rig, mut frames) = opened(&machine);
    (0..2).for_each(|camera| machine.shoot(camera, 1..200, |_, _| {}));
    take(&mut rig, &mut frames, 10);
    machine.state().cams.iter_mut().for_each(|c| c.present = false);
    let before = machine.state().now;
    for i in 0..10 {
        let lost = rig.next(Span(100 * MS), &mut frames).unwrap_err().to_string();
        assert!(lost.starts_with("lost: ") && lost.contains("cable"), "{lost}");
        assert_eq!(machine.state().now - before, i * 100 * MS, "said at once, then each timeout is waited out");
    }
    machine.state().cams.iter_mut().for_each(|c| c.present = true);
    let other = take(&mut rig, &mut frames, 20);
    assert!(other.len() < 25, "it comes back within its longest pause: {}", other.len());
    assert_eq!((count(&rig, "camera_losses"), count(&rig, "camera_returns")), (2, 2));
}

#[test]
fn a_silent_camera_is_opened_again_and_its_partner_does_not_starve() {
    let machine = pair_of_cameras();
    let (mut rig, mut frames) = opened(&machine);
    machine.shoot(1, 1..200, |_, _| {});
    machine.shoot(0, 1..11, |_, _| {});
    machine.shoot(0, 80..200, |_, _| {});
    take(&mut rig, &mut frames, 10);
    // Half a second is waited; then it goes on alone, with the image that came last.
    take(&mut rig, &mut frames, 1);
    let first = ((frames.t.0 + MS - BOOT) / PERIOD) as u32;
    assert!((19..23).contains(&first), "{first}");
    assert_is_alone(&frames, first);
    assert!(rig.away().is_none(), "only silent yet");
    take(&mut rig, &mut frames, 40);
    let lost = rig.away().expect("it was opened again and gives nothing").to_string();
    assert!(lost.contains("video0") && lost.contains("gave nothing for 2"), "{lost}");
    take(&mut rig, &mut frames, 60);
    assert_is(&frames, ((frames.t.0 + MS - BOOT) / PERIOD) as u32);
    assert_eq!((count(&rig, "camera_silences"), count(&rig, "camera_returns")), (1, 1));
    assert_eq!(machine.state().cams[1].dropped, 0, "its buffers came back while the other was silent");
}

#[test]
fn at_boot_nobody_goes_on_before_every_camera_has_given_an_image() {
    let machine = pair_of_cameras();
    let (mut rig, mut frames) = opened(&machine);
    machine.shoot(0, 1..100, |_, _| {});
    machine.shoot(1, 30..100, |_, _| {});
    take(&mut rig, &mut frames, 1);
    assert_is(&frames, 30);
    assert_eq!(count(&rig, "camera_images_absent"), 0);
}

#[test]
fn one_node_gives_both_pictures_side_by_side() {
    let mut cam = Cam::new(0);
    cam.formats = vec![(*b"GREY", vec![(2 * WIDTH as u32, HEIGHT as u32)])];
    // Rows padded to 16 bytes.
    cam.adjust = |got| got.2 = 16;
    let machine = Machine::new(vec![cam]);
    let mut rig = open(&machine, settings(&["bus:usb-0-1"])).unwrap();
    let mut frames = Frames::for_rig(&rig_of(2, WIDTH, HEIGHT));
    machine.shoot(0, 1..5, |_, s| s.bytes = (0..16 * HEIGHT as u8).collect());
    take(&mut rig, &mut frames, 4);
    assert_eq!(frames.images[0].pixels[..7], [0, 1, 2, 3, 4, 5, 16]);
    assert_eq!(frames.images[1].pixels[..7], [6, 7, 8, 9, 10, 11, 22]);
}

#[test]
fn a_multi_planar_queue_gives_the_plane_of_luma_after_its_header() {
    let mut cams = vec![Cam::new(0), Cam::new(1)];
    for c in &mut cams {
        c.capabilities = CAP_CAPTURE_MULTI | CAP_STREAMING;
        c.formats = vec![(*b"NM12", vec![(WIDTH as u32, HEIGHT as u32)])];
    }
    let machine = Machine::new(cams);
    let mut rig = open(&machine, settings(&["serial:0000", "serial:0001"])).unwrap();
    let mut frames = Frames::for_rig(&rig_of(2, WIDTH, HEIGHT));
    for camera in 0..2 {
        machine.shoot(camera, 1..5, |_, s| {
            s.bytes.splice(0..0, [9; 5]);
            s.data_offset = 5;
        });
    }
    take(&mut rig, &mut frames, 4);
    assert_is(&frames, 4);
    assert_eq!(rig.describe().len(), 2);
}

#[test]
fn compressed_frames_are_decoded_and_a_cut_one_costs_itself() {
    let mut cams = vec![Cam::new(0), Cam::new(1)];
    cams.iter_mut().for_each(|c| (c.formats, c.buffer_bytes) = (vec![(*b"MJPG", vec![(16, 8)])], 4096));
    let machine = Machine::new(cams);
    let mut s = settings(&["serial:0000", "serial:0001"]);
    (s.width, s.height) = (16, 8);
    let calibration = rig_of(2, 16, 8);
    let mut rig = Rig::open_in(Arc::new(machine.clone()), s, &calibration).unwrap();
    let mut frames = Frames::for_rig(&calibration);
    for camera in 0..2 {
        machine.shoot(camera, 1..11, |k, s| {
            s.bytes = crate::jpeg::flat(16, 8, &[10, 20 * k as u8]);
            let cut = s.bytes.len() - 4;
            s.bytes.truncate(if k == 5 || (camera, k) == (1, 7) { cut } else { cut + 4 });
        });
    }
    take(&mut rig, &mut frames, 6);
    assert!(frames.images[0].at(15, 7).abs_diff(140) <= 1, "the other camera's image is whole");
    assert!(frames.images[1].pixels.iter().all(|px| *px == 0));
    take(&mut rig, &mut frames, 3);
    assert_eq!((count(&rig, "camera_frames"), count(&rig, "camera_images_undecodable")), (9, 3));
    assert!(frames.images[1].at(15, 7).abs_diff(200) <= 1);
    assert!(rig.warnings()[0].contains("/dev/video0") && rig.warnings()[0].contains("decode"), "{:?}", rig.warnings());
}

#[test]
fn frames_of_another_shape_are_refused_before_a_pixel_is_written() {
    let machine = pair_of_cameras();
    let (mut rig, _) = opened(&machine);
    let mut other = Frames::for_rig(&rig_of(1, WIDTH, HEIGHT));
    assert!(matches!(rig.next(Span(0), &mut other), Err(SourceFault::Broken(_))));
    let mut other = Frames::for_rig(&rig_of(2, WIDTH + 1, HEIGHT));
    assert!(matches!(rig.next(Span(0), &mut other), Err(SourceFault::Broken(_))));
}
