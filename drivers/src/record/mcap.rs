//! A recording as MCAP: ROS 2 messages in CDR, which Foxglove and `ros2 bag` read. Images are PNG inside
//! `sensor_msgs/msg/CompressedImage`, lossless at half the bytes of raw ones; the calibration is attached as EuRoC's
//! sensor.yaml.
//!
//! A chunk holds one frame and the samples before it, and is written at once when the frame is complete. A kill cuts off the
//! last chunk at most. The first write that fails takes its chunk back, closes the file, and ends the recording: what comes
//! after it is counted as failed. The index of a file is kept in memory until the file ends, so a file ends after
//! `FRAMES_PER_FILE` frames and another begins.

use super::Sink;
use crate::calibration::RigCamera;
use crate::euroc::{camera_yaml, imu_yaml, png};
use crate::source::{Aid, AidReading, ImuReading};
use crate::types::{Frames, Nanos};
use crate::{host, Calibration};
use ::mcap::records::MessageHeader;
use ::mcap::{Attachment, McapError, WriteOptions, Writer};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

const HEADER: &str = "\
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
";
const IMAGE: &str = "std_msgs/Header header\nstring format\nuint8[] data\n";
const PRESSURE: &str = "std_msgs/Header header\nfloat64 fluid_pressure\nfloat64 variance\n";
const IMU: &str = "\
std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
";

/// Frames of one file: two minutes at 30 Hz, whose index takes 1 MiB of memory.
const FRAMES_PER_FILE: u32 = 4096;
/// The end of a file without a summary: the records DataEnd and Footer, whose numbers and checksums are 0, and the magic.
const END: [u8; 50] = {
    let mut end = [0; 50];
    let magic = *b"\x89MCAP0\r\n";
    (end[0], end[1], end[13], end[14]) = (0x0f, 4, 0x02, 20);
    let mut i = 0;
    while i < magic.len() {
        end[42 + i] = magic[i];
        i += 1;
    }
    end
};

/// Writes files recording-000.mcap and so on.
pub struct McapSink {
    dir: PathBuf,
    calibration: Calibration,
    /// `None` after a failure: the recording has ended.
    file: Option<Open>,
    files: u32,
    pub(super) frames_per_file: u32,
    sequence: u32,
    encoded: Vec<u8>,
    message: Vec<u8>,
}

struct Open {
    writer: Writer<File>,
    /// The same file, to look at its size and to bring it to the disk.
    file: File,
    /// Bytes up to the last whole chunk.
    good: u64,
    frames: u32,
    images: Vec<u16>,
    imu: u16,
    baro: u16,
}

fn failed(e: McapError) -> io::Error {
    match e {
        McapError::Io(e) => e,
        other => io::Error::other(other),
    }
}

impl McapSink {
    /// Begins the first file.
    pub fn create(dir: &Path, calibration: &Calibration) -> io::Result<McapSink> {
        let mut sink = McapSink {
            dir: dir.to_path_buf(),
            calibration: calibration.clone(),
            file: None,
            files: 0,
            frames_per_file: FRAMES_PER_FILE,
            sequence: 0,
            encoded: Vec::new(),
            message: Vec::new(),
        };
        sink.file = Some(sink.begin().map_err(failed)?);
        Ok(sink)
    }

    fn begin(&mut self) -> Result<Open, McapError> {
        let path = self.dir.join(format!("recording-{:03}.mcap", self.files));
        let created = File::create_new(&path)?;
        let file = created.try_clone()?;
        self.files += 1;
        let options = WriteOptions::new().profile("ros2").library("stipple").compression(None).disable_seeking(true);
        let mut writer = options.create(created)?;
        let none = BTreeMap::new();
        let image =
            writer.add_schema("sensor_msgs/msg/CompressedImage", "ros2msg", format!("{IMAGE}{HEADER}").as_bytes())?;
        let imu = writer.add_schema("sensor_msgs/msg/Imu", "ros2msg", format!("{IMU}{HEADER}").as_bytes())?;
        let mut images = Vec::new();
        for (k, camera) in self.calibration.cameras.iter().enumerate() {
            images.push(writer.add_channel(image, &format!("/cam{k}/image"), "cdr", &none)?);
            attach(&mut writer, &format!("cam{k}"), camera_yaml(camera, &format!("recorded cam{k}"), 0.0))?;
        }
        let imu = writer.add_channel(imu, "/imu0", "cdr", &none)?;
        let schema = format!("{PRESSURE}{HEADER}");
        let baro = writer.add_schema("sensor_msgs/msg/FluidPressure", "ros2msg", schema.as_bytes())?;
        let baro = writer.add_channel(baro, "/baro0", "cdr", &none)?;
        attach(&mut writer, "imu0", imu_yaml(&self.calibration.imu, "recorded, corrected"))?;
        writer.flush()?;
        host::sync_folder_of(&path)?;
        let good = file.metadata()?.len();
        Ok(Open { writer, file, good, frames: 0, images, imu, baro })
    }

    fn write(&mut self, channel: impl Fn(&Open) -> u16, t: Nanos, sequence: u32) -> Result<(), McapError> {
        let Some(file) = &mut self.file else { return Err(io::Error::other("it ended when a write failed").into()) };
        let t = t.0.max(0) as u64;
        let header = MessageHeader { channel_id: channel(file), sequence, log_time: t, publish_time: t };
        file.writer.write_to_known_channel(&header, &self.message)
    }

    fn all(&mut self, frames: &Frames) -> Result<(), McapError> {
        self.sequence += 1;
        if self.file.as_ref().is_some_and(|file| file.frames >= self.frames_per_file) {
            self.end()?;
            self.file = Some(self.begin()?);
        }
        for (k, image) in frames.images.iter().enumerate() {
            let camera: RigCamera = self.calibration.cameras[k];
            self.encoded.clear();
            png(&mut self.encoded, image, frames.colours.get(k)).map_err(io::Error::other)?;
            let t = camera.from_imu_clock(frames.t);
            let mut cdr = Cdr::new(&mut self.message);
            cdr.header(t, &format!("cam{k}"));
            cdr.text("png");
            cdr.bytes(&self.encoded);
            self.write(|file| file.images[k], t, self.sequence)?;
        }
        let file = self.file.as_mut().expect("a message was written to it");
        file.writer.flush()?;
        file.good = file.file.metadata()?.len();
        file.frames += 1;
        Ok(())
    }

    /// Writes the index of the file and brings all of it to the disk.
    fn end(&mut self) -> Result<(), McapError> {
        let Some(open) = &mut self.file else { return Ok(()) };
        open.writer.finish()?;
        open.file.sync_all()?;
        self.file = None;
        Ok(())
    }

    /// Closes the file after its last whole chunk where a write failed.
    fn settled(&mut self, written: Result<(), McapError>) -> io::Result<()> {
        if let Some(Open { writer, file, good, .. }) = self.file.take_if(|_| written.is_err()) {
            // Without what it writes when it is dropped.
            drop(writer.into_inner());
            // The cut chunk makes room for the end. A disk that refuses it leaves a file that was never closed, as a kill
            // does, whose whole chunks are read.
            let closed = file.set_len(good).and_then(|()| file.write_all_at(&END, good));
            if closed.is_err() {
                let _ = file.set_len(good);
            }
            let _ = file.sync_all();
        }
        written.map_err(failed)
    }
}

fn attach(writer: &mut Writer<File>, sensor: &str, yaml: String) -> Result<(), McapError> {
    let (name, media_type) = (format!("{sensor}/sensor.yaml"), "application/yaml".to_string());
    writer.attach(&Attachment { log_time: 0, create_time: 0, name, media_type, data: Cow::Owned(yaml.into_bytes()) })
}

impl Sink for McapSink {
    fn frames(&mut self, frames: &Frames) -> io::Result<()> {
        let written = self.all(frames);
        self.settled(written)
    }

    fn imu(&mut self, reading: &ImuReading) -> io::Result<()> {
        let s = &reading.sample;
        let mut cdr = Cdr::new(&mut self.message);
        cdr.header(s.t, "imu0");
        // No orientation is measured, which ROS marks by -1; the covariances are not known: 0.
        cdr.floats(&[0.0, 0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        for v in [s.gyro_body, s.accel_body] {
            cdr.floats(&v.to_array());
            cdr.floats(&[0.0; 9]);
        }
        let written = self.write(|file| file.imu, s.t, 0);
        self.settled(written)
    }

    fn aid(&mut self, reading: &AidReading) -> io::Result<()> {
        let Aid::Pressure(pa) = reading.value;
        let mut cdr = Cdr::new(&mut self.message);
        cdr.header(reading.t, "baro0");
        // The variance is not known: 0.
        cdr.floats(&[pa, 0.0]);
        let written = self.write(|file| file.baro, reading.t, 0);
        self.settled(written)
    }

    fn sync(&mut self) -> io::Result<()> {
        self.file.as_ref().map_or(Ok(()), |open| open.file.sync_data())
    }

    fn finish(&mut self) -> io::Result<()> {
        let ended = self.end();
        self.settled(ended)
    }
}

/// Little-endian CDR: every number is aligned to its size, counted from the end of the four-byte header.
struct Cdr<'a>(&'a mut Vec<u8>);

impl Cdr<'_> {
    fn new(out: &mut Vec<u8>) -> Cdr<'_> {
        out.clear();
        out.extend([0, 1, 0, 0]);
        Cdr(out)
    }

    fn align(&mut self, to: usize) {
        let at = self.0.len() - 4;
        self.0.resize(4 + at.next_multiple_of(to), 0);
    }

    fn word(&mut self, v: u32) {
        self.align(4);
        self.0.extend(v.to_le_bytes());
    }

    fn header(&mut self, t: Nanos, frame_id: &str) {
        self.word(t.0.div_euclid(1_000_000_000) as u32);
        self.word(t.0.rem_euclid(1_000_000_000) as u32);
        self.text(frame_id);
    }

    fn text(&mut self, text: &str) {
        self.word(text.len() as u32 + 1);
        self.0.extend(text.as_bytes());
        self.0.push(0);
    }

    fn bytes(&mut self, bytes: &[u8]) {
        self.word(bytes.len() as u32);
        self.0.extend(bytes);
    }

    fn floats(&mut self, values: &[f64]) {
        self.align(8);
        values.iter().for_each(|v| self.0.extend(v.to_le_bytes()));
    }
}
