//! Images of a recording, PNG or JPEG, read in grey and in colour: what is read says nothing of the image before it, and
//! the grey of a PNG is the same both ways. (A JPEG of several scans may differ: its decoder passes over those of colour.)
#![no_main]

#[path = "../recording.rs"]
mod recording;

use libfuzzer_sys::fuzz_target;
use std::cell::RefCell;
use std::path::PathBuf;
use stipple_drivers::replay::{OpenOptions, Reader, Recording};
use stipple_drivers::Frames;
use tempfile::TempDir;

struct Open {
    _dir: TempDir,
    mav0: PathBuf,
    reader: Reader,
    grey: Frames,
    colour: Frames,
}

thread_local!(static OPEN: RefCell<Open> = RefCell::new({
    let (_dir, mav0) = recording::recording();
    let r = Recording::open(&mav0, &OpenOptions::default()).expect("the recording is whole");
    let (grey, colour) = (Frames::for_rig(&r.calibration), Frames::in_colour(&r.calibration, 1));
    Open { _dir, mav0, reader: r.reader(), grey, colour }
}));

fuzz_target!(|data: &[u8]| {
    OPEN.with_borrow_mut(|open| {
        recording::write(&open.mav0, &format!("cam0/data/{}.png", recording::T0), data);
        let _ = open.reader.has_colour(1);
        let mut read = |fill: u8, frames: &mut Frames| {
            let planes = frames.colours.iter_mut().flatten();
            frames.images.iter_mut().chain(planes).for_each(|image| image.pixels.fill(fill));
            open.reader.read(0, frames).map(|()| (frames.images[0].clone(), frames.colours.clone()))
        };
        let (grey, colour) = (read(0, &mut open.grey), read(0, &mut open.colour));
        assert_eq!((&grey, &colour), (&read(255, &mut open.grey), &read(255, &mut open.colour)));
        if let (Ok(grey), Ok(colour), true) = (grey, colour, data.starts_with(b"\x89PNG")) {
            assert_eq!(grey.0, colour.0);
        }
    });
});
