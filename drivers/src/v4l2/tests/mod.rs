//! What cameras do wrong, and what is made of it: on a machine whose every call can fail (`machine`).
#![cfg(test)]
#![allow(clippy::unwrap_used)]

mod colours;
mod errors;
mod exposures;
mod machine;
mod streams;

use super::uapi::*;
use super::*;
use crate::source::{FrameSource, SourceFault, Wait};
use crate::types::{Frames, Nanos};
use crate::{Calibration, Camera, ImuCalibration, Lens, Pose};
use machine::{Cam, Machine, BOOT, HEIGHT, PERIOD, WIDTH};
use std::sync::Arc;

const MS: i64 = 1_000_000;

fn settings(devices: &[&str]) -> Settings {
    Settings {
        devices: devices.iter().map(|d| Select::parse(d).unwrap()).collect(),
        format: None,
        colours: 0,
        width: WIDTH,
        height: HEIGHT,
        rate_hz: 20.0,
        exposure: Span(0),
        exposure_line: Span(0),
        controls: Vec::new(),
        stamp: StampPoint::FrameStart,
        transfer: Span(0),
        pair_tolerance: Span(2 * MS),
    }
}

fn rig_of(cameras: usize, width: usize, height: usize) -> Calibration {
    let lens = Lens::Radtan { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0 };
    let camera = Camera { width, height, fx: 5.0, fy: 5.0, cx: 2.5, cy: 1.5, lens };
    let rig = RigCamera::new(camera, Pose::IDENTITY);
    Calibration { cameras: vec![rig; cameras], imu: ImuCalibration::CONSUMER }
}

fn pair_of_cameras() -> Machine {
    Machine::new(vec![Cam::new(0), Cam::new(1)])
}

fn open(machine: &Machine, settings: Settings) -> Result<Rig, Fault> {
    Rig::open_in(Arc::new(machine.clone()), settings, &rig_of(2, WIDTH, HEIGHT))
}

fn opened(machine: &Machine) -> (Rig, Frames) {
    let rig = open(machine, settings(&["serial:0000", "serial:0001"])).unwrap();
    (rig, Frames::for_rig(&rig_of(2, WIDTH, HEIGHT)))
}

fn count(rig: &Rig, name: &str) -> u64 {
    rig.counters().into_iter().find(|c| c.0 == name).unwrap_or_else(|| panic!("no counter {name}")).1
}

/// Counters that are not zero.
fn counted(rig: &Rig) -> Vec<(&'static str, u64)> {
    rig.counters().into_iter().filter(|c| c.1 > 0).collect()
}

/// Picture that a frame must be of both cameras.
#[track_caller]
fn assert_is(frames: &Frames, k: u32) {
    assert_eq!(frames.t, Nanos(BOOT + i64::from(k) * PERIOD - MS));
    for (camera, image) in frames.images.iter().enumerate() {
        let expected: Vec<u8> = (0..WIDTH * HEIGHT).map(|i| machine::pixel(camera, k, i)).collect();
        assert_eq!(image.pixels, expected, "camera {camera}, picture {k}");
    }
}

/// Calls until `pictures` frames came; what else was answered is returned.
fn take(rig: &mut Rig, frames: &mut Frames, pictures: usize) -> Vec<Result<Wait, SourceFault>> {
    let (mut got, mut other) = (0, Vec::new());
    while got < pictures && other.len() < 1000 {
        match rig.next(Span(100 * MS), frames) {
            Ok(Wait::Got) => got += 1,
            answer => other.push(answer),
        }
    }
    assert_eq!(got, pictures, "{other:?}");
    other
}

fn control(id: u32, name: &str, minimum: i64, maximum: i64, step: u64) -> QueryControl {
    let mut c = QueryControl { id, kind: CONTROL_INTEGER, minimum, maximum, step, ..Default::default() };
    c.name[..name.len()].copy_from_slice(name.as_bytes());
    c
}
