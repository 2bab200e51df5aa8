//! Recordings under a slow and under a full disk.
#![cfg(test)]
#![allow(clippy::unwrap_used)]

#[path = "../../../tests/program/small_disk.rs"]
mod small_disk;

use super::*;
use crate::paced::PacedAids;
use crate::paced::{Images, Pace, PacedFrames, PacedImu};
use crate::replay::{OpenOptions, Recording};
use crate::sim::euroc_rig;
use crate::source::Aid;
use crate::types::{ImuSample, Nanos};
use glam::DVec3;
use small_disk::on_a_small_disk;
use std::time::{Duration, Instant};

const MS: i64 = 1_000_000;

/// A rig of small cameras.
fn rig() -> Calibration {
    let mut rig = euroc_rig();
    for c in &mut rig.cameras {
        (c.camera.width, c.camera.height) = (160, 120);
    }
    rig
}

/// Frame i, 50 ms after the last, noisy enough to resist compression.
fn frame(i: usize) -> Frames {
    let mut frames = Frames::for_rig(&rig());
    frames.t = Nanos((i as i64 + 1) * 50 * MS);
    let mut state = i as u32 + 1;
    for px in frames.images.iter_mut().flat_map(|image| &mut image.pixels) {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        *px = (state >> 24) as u8;
    }
    frames
}

fn sources(frames: usize) -> (PacedFrames, PacedImu) {
    let images: Vec<Frames> = (0..frames).map(frame).collect();
    let stamps: Vec<Nanos> = images.iter().map(|f| f.t).collect();
    let sample = |i: i64| ImuSample { t: Nanos(i * 5 * MS), gyro_body: DVec3::splat(i as f64), ..ImuSample::default() };
    let pace = Pace::at_speed(Nanos(0), 10.0);
    let samples: Vec<ImuSample> = (0..frames as i64 * 10 + 20).map(sample).collect();
    (PacedFrames::new(Images::Rendered(images), stamps, pace), PacedImu::new(samples.into(), pace))
}

/// Plays `frames` frames through taps into `sink`; the longest call of the camera beyond its pace, and what came of it.
fn record(sink: Box<dyn Sink>, frames: usize, slots: usize) -> (Duration, Recorded) {
    let shape = frame(0);
    let (camera, unit) = sources(frames);
    let (recorder, (mut camera, mut unit, _)) =
        start(sink, (Box::new(camera), Box::new(unit), None), Ring::new(&shape, slots), || ());
    let mut slowest = Duration::ZERO;
    std::thread::scope(|s| {
        s.spawn(move || {
            let mut batch = ImuBatch::default();
            while unit.next(Span(100 * MS), &mut batch).unwrap() != Wait::Ended {}
        });
        let mut out = shape;
        loop {
            let begun = Instant::now();
            if camera.next(Span(100 * MS), &mut out).unwrap() == Wait::Ended {
                break;
            }
            slowest = slowest.max(begun.elapsed());
        }
        drop(camera);
    });
    (slowest, recorder.finish())
}

fn count(r: &Recorded, name: &str) -> u64 {
    r.counters.iter().find(|(n, _)| *n == name).unwrap().1
}

#[test]
fn a_recording_reads_back_bit_for_bit() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("r");
    let (_, r) = record(open(&out, Format::Euroc, &rig()).unwrap(), 20, 32);
    assert_eq!((count(&r, "record_frames_written"), r.failure.as_deref()), (20, None));
    let back = Recording::open(&out, &OpenOptions::default()).unwrap();
    assert_eq!((back.frames.len(), back.imu.len(), back.warnings.len()), (20, 220, 0), "{:?}", back.warnings);
    let (mut reader, mut frames) = (back.reader(), Frames::for_rig(&rig()));
    for i in 0..20 {
        reader.read(i, &mut frames).unwrap();
        let truth = frame(i);
        assert!(frames.t == truth.t && frames.images == truth.images, "{i}");
    }
    assert!(back.imu.iter().enumerate().all(|(i, s)| s.gyro_body.x == i as f64));
    assert!(back.calibration.cameras.iter().zip(&rig().cameras).all(|(a, b)| a.camera == b.camera));
}

/// Takes 30 ms a frame where one comes every 5 ms, and counts how often it is brought to the disk.
struct SlowDisk(Vec<Nanos>, Arc<AtomicU64>);

impl Sink for SlowDisk {
    fn frames(&mut self, frames: &Frames) -> io::Result<()> {
        std::thread::sleep(Duration::from_millis(30));
        self.0.push(frames.t);
        Ok(())
    }
    fn imu(&mut self, _: &ImuReading) -> io::Result<()> {
        Ok(())
    }
    fn aid(&mut self, _: &AidReading) -> io::Result<()> {
        Ok(())
    }
    fn sync(&mut self) -> io::Result<()> {
        self.1.fetch_add(1, Relaxed);
        Ok(())
    }
    fn finish(&mut self) -> io::Result<()> {
        assert!(self.0.windows(2).all(|w| w[0] < w[1]), "in order");
        Ok(())
    }
}

#[test]
fn a_slow_disk_costs_frames_of_the_recording_and_no_time_of_the_source() {
    let (slowest, r) = record(Box::new(SlowDisk(vec![], Arc::default())), 100, 4);
    let (written, dropped) = (count(&r, "record_frames_written"), count(&r, "record_frames_dropped"));
    assert_eq!((written + dropped, &r.failure), (100, &None));
    assert!(dropped > 40 && written >= 10, "{written} written, {dropped} dropped");
    assert_eq!(count(&r, "record_ring_most"), 4, "the ring was full, and no larger");
    // Frames come every 5 ms; the rest is what a loaded machine takes.
    assert!(slowest < Duration::from_millis(30 * 4), "{slowest:?}");
}

#[test]
fn a_full_disk_leaves_every_frame_before_it_readable() {
    on_a_small_disk("2m", "record::tests::a_full_disk_leaves_every_frame_before_it_readable", |disk| {
        let out = disk.join("r");
        // 38 KiB a frame: full after some fifty.
        let (_, r) = record(open(&out, Format::Euroc, &rig()).unwrap(), 80, 100);
        let (written, failed) = (count(&r, "record_frames_written"), count(&r, "record_frames_failed"));
        assert!(written > 20 && failed > 10 && written + failed == 80, "{r:?}");
        assert!(r.failure.clone().unwrap().contains("space"), "{r:?}");
        let back = Recording::open(&out, &OpenOptions::default()).unwrap();
        assert_eq!((back.frames.len() as u64, back.warnings.len()), (written, 0), "{:?}", back.warnings);
        let (mut reader, mut frames) = (back.reader(), Frames::for_rig(&rig()));
        assert!((0..back.frames.len()).all(|i| reader.read(i, &mut frames).is_ok()));
    });
}

/// What was recorded is on the disk within a second, not when the kernel likes.
#[test]
fn a_recording_is_brought_to_the_disk_every_second() {
    let syncs = Arc::new(AtomicU64::new(0));
    let begun = Instant::now();
    let (_, r) = record(Box::new(SlowDisk(vec![], syncs.clone())), 450, 4);
    let (seconds, syncs) = (begun.elapsed().as_secs(), syncs.load(Relaxed));
    assert!(r.failure.is_none() && syncs >= 1 && syncs <= seconds, "{syncs} times in {seconds} s");
}

/// Images of each camera in an MCAP whose end is whole.
fn images(file: &Path) -> u64 {
    let file = std::fs::read(file).unwrap();
    let messages = ::mcap::MessageStream::new(&file).unwrap().map(Result::unwrap);
    messages.filter(|m| m.channel.topic == "/cam1/image").count() as u64
}

#[test]
fn a_full_disk_ends_an_mcap_in_one_file_that_is_closed_and_readable() {
    on_a_small_disk("2m", "record::tests::a_full_disk_ends_an_mcap_in_one_file_that_is_closed_and_readable", |disk| {
        let out = disk.join("r");
        let mut sink = McapSink::create(&out_folder(&out), &rig()).unwrap();
        let reading = ImuReading::default();
        let mut written = 0;
        while sink.imu(&reading).and_then(|()| sink.frames(&frame(written))).is_ok() {
            written += 1;
        }
        // As before, every sample and frame from then on began another file.
        for i in 0..20 {
            assert!(sink.imu(&reading).is_err() && sink.frames(&frame(100 + i)).is_err());
        }
        sink.finish().unwrap();
        assert_eq!(std::fs::read_dir(&out).unwrap().count(), 1);
        assert!(written > 20, "{written}");
        assert_eq!(images(&out.join("recording-000.mcap")), written as u64);
    });
}

fn out_folder(out: &Path) -> std::path::PathBuf {
    std::fs::create_dir(out).unwrap();
    out.to_path_buf()
}

#[test]
fn a_full_disk_leaves_every_whole_chunk_of_mcap_readable() {
    on_a_small_disk("2m", "record::tests::a_full_disk_leaves_every_whole_chunk_of_mcap_readable", |disk| {
        let out = disk.join("r");
        let (_, r) = record(open(&out, Format::Mcap, &rig()).unwrap(), 80, 100);
        let (written, failed) = (count(&r, "record_frames_written"), count(&r, "record_frames_failed"));
        assert!(written > 20 && failed > 10 && written + failed == 80, "{r:?}");
        assert!(r.failure.clone().unwrap().contains("space"), "{r:?}");
        assert_eq!(images(&out.join("recording-000.mcap")), written);
    });
}

/// The index of a file is kept in memory until it ends: the number of frames of a file bounds it.
#[test]
fn a_long_mcap_goes_on_in_another_file_and_each_is_whole() {
    let dir = tempfile::tempdir().unwrap();
    let mut sink = McapSink::create(dir.path(), &rig()).unwrap();
    sink.frames_per_file = 4;
    (0..10).for_each(|i| sink.frames(&frame(i)).unwrap());
    sink.finish().unwrap();
    let file = |k: usize| dir.path().join(format!("recording-00{k}.mcap"));
    assert_eq!([0, 1, 2].map(|k| images(&file(k))), [4, 4, 2]);
    for k in 0..3 {
        let summary = ::mcap::Summary::read(&std::fs::read(file(k)).unwrap()).unwrap().unwrap();
        // Schemas and channels, which the calibration's attachments part, are in chunks of their own.
        assert!(summary.chunk_indexes.len() <= 4 + 4 && summary.attachment_indexes.len() == 3);
    }
}

/// A recording without a barometer has no table of it.
#[test]
fn pressures_are_recorded_and_read_back() {
    let readings =
        (0..50).map(|i| AidReading { t: Nanos(i * 20 * MS), value: Aid::Pressure(98_000.0 + i as f64 / 7.0) });
    let readings: Vec<AidReading> = readings.collect();
    let dir = tempfile::tempdir().unwrap();
    for format in [Format::Euroc, Format::Mcap] {
        let out = dir.path().join(format!("{format:?}"));
        let (camera, unit) = sources(10);
        let baro = PacedAids::new(readings.clone(), Pace::at_speed(Nanos(0), 100.0));
        let sources: Sources = (Box::new(camera), Box::new(unit), Some(Box::new(baro)));
        let sink = open(&out, format, &rig()).unwrap();
        let (recorder, (mut camera, mut unit, baro)) = start(sink, sources, Ring::new(&frame(0), 20), || ());
        let (mut batch, mut samples, mut shown) = (AidBatch::default(), ImuBatch::default(), frame(0));
        let mut baro = baro.unwrap();
        while baro.next(Span(100 * MS), &mut batch).unwrap() != Wait::Ended {}
        while unit.next(Span(100 * MS), &mut samples).unwrap() != Wait::Ended {}
        while camera.next(Span(100 * MS), &mut shown).unwrap() != Wait::Ended {}
        drop((camera, unit, baro));
        let r = recorder.finish();
        assert_eq!((count(&r, "record_aids_written"), r.failure), (50, None));
        if format == Format::Mcap {
            let file = std::fs::read(out.join("recording-000.mcap")).unwrap();
            let messages = ::mcap::MessageStream::new(&file).unwrap().map(Result::unwrap);
            let pressures = messages.filter(|m| m.channel.topic == "/baro0");
            // Its header ends at 24: four of CDR's own, two words, and "baro0" with its length, aligned to eight after the four.
            let read = pressures.map(|m| f64::from_le_bytes(m.data[28..36].try_into().unwrap())).collect::<Vec<_>>();
            assert_eq!((read.len(), read[49]), (50, 98_007.0));
            continue;
        }
        let back = Recording::open(&out, &OpenOptions::default()).unwrap();
        assert_eq!((back.aids.len(), back.aids[49]), (50, readings[49]));
    }
    let without = dir.path().join("without");
    record(open(&without, Format::Euroc, &rig()).unwrap(), 3, 4);
    assert!(!without.join("mav0/baro0").exists());
}

/// Somebody else's links under the names of a recording lead nowhere.
#[test]
fn a_recording_follows_no_link() {
    let (dir, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let victim = other.path().join("victim");
    std::fs::write(&victim, "precious").unwrap();
    let mut sink = EurocSink::create(dir.path(), &rig()).unwrap();
    let partial = dir.path().join("mav0/cam0/data").join(format!(".{}.partial", frame(0).t.0));
    std::os::unix::fs::symlink(&victim, partial).unwrap();
    assert!(sink.frames(&frame(0)).is_err());
    sink.frames(&frame(1)).unwrap();
    sink.finish().unwrap();
    std::os::unix::fs::symlink(&victim, other.path().join("recording-000.mcap")).unwrap();
    assert!(McapSink::create(other.path(), &rig()).is_err());
    assert_eq!(std::fs::read(&victim).unwrap(), b"precious");
}
