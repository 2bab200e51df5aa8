//! Exposures that change while a camera streams, and stamps that follow them.
#![cfg(test)]

use super::*;

/// Frames are stamped at the start of the frame, as the first row's exposure ends: `k` periods less a millisecond.
fn mid_exposure(k: i64, exposure: i64) -> Nanos {
    Nanos(BOOT + k * PERIOD - MS - exposure / 2)
}

/// Two cameras with an exposure in units of 0.1 ms, at 4 ms; its flags and the automatic's value are given.
fn exposing(flags: u32, auto: Option<i64>) -> (Machine, Rig, Frames) {
    let machine = pair_of_cameras();
    let mut exposure = control(CID_EXPOSURE_ABSOLUTE, "Exposure Time, Absolute", 1, 1000, 1);
    exposure.flags = flags;
    let mode = auto.map(|value| (control(CID_EXPOSURE_AUTO, "Auto Exposure", 0, 3, 1), value));
    for c in &mut machine.state().cams {
        c.controls = mode.into_iter().chain([(exposure, 40)]).collect();
    }
    let rig = open(&machine, settings(&["serial:0000", "serial:0001"])).unwrap();
    (0..2).for_each(|camera| machine.shoot(camera, 1..100, |_, _| {}));
    (machine, rig, Frames::for_rig(&rig_of(2, WIDTH, HEIGHT)))
}

fn expose(machine: &Machine, count: i64) {
    let mut s = machine.state();
    s.cams
        .iter_mut()
        .for_each(|c| c.controls.iter_mut().filter(|q| q.0.id == CID_EXPOSURE_ABSOLUTE).for_each(|q| q.1 = count));
}

fn calls(machine: &Machine, name: &str) -> usize {
    machine.state().calls.get(name).copied().unwrap_or(0)
}

/// Automatic exposure moved mid-exposure stamps by half its change while the exposure was read at opening alone.
#[test]
fn stamps_follow_an_exposure_that_the_camera_sets_by_itself() {
    // A control that says so, and one that does not beside an automatic exposure that is on.
    for (flags, auto) in [(CONTROL_VOLATILE, None), (0, Some(3)), (0, Some(0))] {
        let (machine, mut rig, mut frames) = exposing(flags, auto);
        take(&mut rig, &mut frames, 3);
        assert_eq!(frames.t, mid_exposure(3, 4 * MS));
        expose(&machine, 120);
        let before = calls(&machine, "VIDIOC_G_EXT_CTRLS");
        take(&mut rig, &mut frames, 5);
        assert_eq!(frames.t, mid_exposure(8, 12 * MS));
        assert_eq!(calls(&machine, "VIDIOC_G_EXT_CTRLS") - before, 2 * 5, "one call a frame");
        assert_eq!(calls(&machine, "VIDIOC_DQEVENT"), 0);
        assert_eq!(count(&rig, "camera_exposure_changes"), 2);
        assert!(rig.describe()[0].contains("exposure 12000 us"), "{:?}", rig.describe());
    }
}

#[test]
fn stamps_follow_an_exposure_that_somebody_sets_from_the_first_frame_after_it() {
    let (machine, mut rig, mut frames) = exposing(0, Some(EXPOSURE_MANUAL));
    take(&mut rig, &mut frames, 3);
    let read = calls(&machine, "VIDIOC_G_EXT_CTRLS");
    // Set between frames 8 and 9, as our reader pauses: it hears of it with frames from before.
    {
        let mut s = machine.state();
        s.now = BOOT + 9 * PERIOD + MS;
        let at = BOOT + 8 * PERIOD + 20 * MS;
        s.cams.iter_mut().for_each(|c| c.events.push_back((at, CID_EXPOSURE_ABSOLUTE, 120)));
    }
    for k in 4..=7 {
        take(&mut rig, &mut frames, 1);
        assert_eq!(frames.t, mid_exposure(k, 4 * MS), "picture {k}");
    }
    take(&mut rig, &mut frames, 1);
    assert!(frames.t >= mid_exposure(9, 12 * MS), "the next that was not lost");
    assert_eq!((frames.t.0 - mid_exposure(0, 12 * MS).0) % PERIOD, 0);
    let before = (calls(&machine, "VIDIOC_DQEVENT"), count(&rig, "camera_frames"));
    take(&mut rig, &mut frames, 10);
    let after = (calls(&machine, "VIDIOC_DQEVENT"), count(&rig, "camera_frames"));
    assert!((after.0 - before.0) as u64 <= 2 * (after.1 - before.1) + 2, "one call a frame: {before:?} {after:?}");
    assert_eq!(calls(&machine, "VIDIOC_G_EXT_CTRLS"), read, "it is not read besides");
    assert_eq!(count(&rig, "camera_exposure_changes"), 2);
    assert!(machine.state().cams.iter().all(|c| c.subscribed == [CID_EXPOSURE_ABSOLUTE]));
}

/// While images were paired by the middle of their exposures, exposures that differ by 8 ms made it 4 ms: every image was
/// dropped, as the tolerance is 2 ms.
#[test]
fn cameras_are_paired_whose_exposures_differ() {
    // Started together by a trigger; and ended together by a common readout.
    for late in [8 * MS, 0] {
        let machine = pair_of_cameras();
        let exposure = control(CID_EXPOSURE_ABSOLUTE, "Exposure Time, Absolute", 1, 1000, 1);
        machine.state().cams.iter_mut().zip([40, 120]).for_each(|(c, count)| c.controls = vec![(exposure, count)]);
        let mut rig = open(&machine, settings(&["serial:0000", "serial:0001"])).unwrap();
        let mut frames = Frames::for_rig(&rig_of(2, WIDTH, HEIGHT));
        machine.shoot(0, 1..20, |_, _| {});
        machine.shoot(1, 1..20, |_, s| (s.at, s.stamp) = (s.at + late, s.stamp + late));
        take(&mut rig, &mut frames, 19);
        assert_eq!(frames.t, mid_exposure(19, 4 * MS), "the stamp is the first camera's");
        assert_eq!(count(&rig, "camera_images_unpaired"), 0);
    }
}

/// An event of another control says nothing of the exposure; nor does one that changed its range alone.
#[test]
fn other_events_change_nothing() {
    let (machine, mut rig, mut frames) = exposing(0, None);
    machine.state().cams.iter_mut().for_each(|c| c.events.push_back((BOOT, CID_EXPOSURE, 999)));
    take(&mut rig, &mut frames, 3);
    assert_eq!((frames.t, count(&rig, "camera_exposure_changes")), (mid_exposure(3, 4 * MS), 0));
}

#[test]
fn a_driver_that_neither_tells_nor_can_be_read_keeps_the_exposure_of_its_opening() {
    for (call, flags) in
        [("VIDIOC_SUBSCRIBE_EVENT", 0), ("VIDIOC_DQEVENT", 0), ("VIDIOC_G_EXT_CTRLS", CONTROL_VOLATILE)]
    {
        for errno in [libc::EINVAL, libc::ENOTTY, libc::EIO, libc::ETIMEDOUT, libc::ENOENT, libc::EACCES] {
            let machine = pair_of_cameras();
            let mut exposure = control(CID_EXPOSURE_ABSOLUTE, "Exposure Time, Absolute", 1, 1000, 1);
            exposure.flags = flags;
            machine.state().cams.iter_mut().for_each(|c| c.controls = vec![(exposure, 40)]);
            // Opening reads it once of each camera.
            machine.fail(call, errno, if flags == 0 { 0 } else { 2 }, 1_000_000);
            let mut rig = open(&machine, settings(&["serial:0000", "serial:0001"])).unwrap();
            let mut frames = Frames::for_rig(&rig_of(2, WIDTH, HEIGHT));
            (0..2).for_each(|camera| machine.shoot(camera, 1..40, |_, _| {}));
            expose(&machine, 120);
            take(&mut rig, &mut frames, 30);
            assert_eq!(frames.t, mid_exposure(30, 4 * MS), "{call} {errno}");
            assert_eq!(count(&rig, "camera_losses"), 0);
            let lost = count(&rig, "camera_exposures_lost");
            assert_eq!(lost, if flags == 0 { 0 } else { 2 }, "{call} {errno}");
        }
    }
}

/// A camera that answers late must not hold up the frames.
#[test]
fn an_exposure_that_takes_long_to_read_is_not_read_again() {
    let (machine, mut rig, mut frames) = exposing(CONTROL_VOLATILE, None);
    take(&mut rig, &mut frames, 3);
    machine.state().read_takes = 30 * MS;
    expose(&machine, 120);
    take(&mut rig, &mut frames, 10);
    assert_eq!(count(&rig, "camera_exposures_lost"), 2);
    assert_eq!(frames.t.0 % PERIOD, mid_exposure(0, 12 * MS).0.rem_euclid(PERIOD), "the one that was read holds");
    let before = calls(&machine, "VIDIOC_G_EXT_CTRLS");
    take(&mut rig, &mut frames, 10);
    assert_eq!(calls(&machine, "VIDIOC_G_EXT_CTRLS"), before);
}
