//! A recording as MCAP of whatever stamps and values: it is whole, and every message is read back. An input is a list of
//! eight bytes a stamp; the lowest bit says whether it is a frame's or a sample's.
#![no_main]

use libfuzzer_sys::fuzz_target;
use stipple_drivers::record::{McapSink, Sink};
use stipple_drivers::sim::euroc_rig;
use stipple_drivers::source::ImuReading;
use stipple_drivers::{Frames, Nanos};

fuzz_target!(|data: &[u8]| {
    let dir = tempfile::tempdir().expect("the scratch folder can be written to");
    let mut rig = euroc_rig();
    for c in &mut rig.cameras {
        (c.camera.width, c.camera.height) = (4, 3);
    }
    let (mut frames, mut reading) = (Frames::for_rig(&rig), ImuReading::default());
    let mut sink = McapSink::create(dir.path(), &rig).expect("the folder is new");
    let mut written = 0;
    for bytes in data.chunks_exact(8) {
        let t = Nanos(i64::from_le_bytes(bytes.try_into().expect("chunks of eight")));
        (frames.t, reading.sample.t) = (t, t);
        let is_frame = t.0 & 1 == 1;
        let done = if is_frame { sink.frames(&frames) } else { sink.imu(&reading) };
        done.expect("the disk has room");
        written += if is_frame { rig.cameras.len() } else { 1 };
    }
    sink.finish().expect("the disk has room");
    let file = std::fs::read(dir.path().join("recording-000.mcap")).expect("it was written");
    let messages = mcap::MessageStream::new(&file).expect("the file is whole");
    assert_eq!(messages.filter(|m| m.is_ok()).count(), written);
});
