//! A recording as an EuRoC ASL folder.
//!
//! An image is written under a hidden name and renamed, and its row is appended when the images of all cameras are there.
//! Rows go out in one write, and one that the disk cuts short is taken back. Stamps are the cameras' own; samples are
//! corrected by the calibration already, as everything downstream of a source is.

use super::Sink;
use crate::calibration::RigCamera;
use crate::euroc::{aid_row, camera_yaml, imu_row, imu_yaml, png, BARO_COLUMNS, IMAGE_COLUMNS, IMU_COLUMNS};
use crate::source::{AidReading, ImuReading};
use crate::types::Frames;
use crate::{host, Calibration};
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// Samples of one write; a frame writes out those that wait, too.
const ROWS: usize = 20;
/// Rows kept while the disk is full, bytes: five seconds of a 1 kHz unit.
const ROWS_BYTES_MAX: usize = 1 << 19;

/// A csv that ends with a whole row.
struct Rows {
    file: File,
    /// Bytes of whole rows.
    good: u64,
    /// Rows that are not written yet, and how many.
    waiting: Vec<u8>,
    count: usize,
}

impl Rows {
    fn create(path: &Path, columns: &str) -> io::Result<Rows> {
        let file = OpenOptions::new().append(true).create_new(true).open(path)?;
        let mut rows = Rows { file, good: 0, waiting: columns.into(), count: 0 };
        rows.flush()?;
        Ok(rows)
    }

    fn flush(&mut self) -> io::Result<()> {
        if let Err(e) = self.file.write_all(&self.waiting) {
            self.file.set_len(self.good)?;
            return Err(e);
        }
        self.good += self.waiting.len() as u64;
        self.waiting.clear();
        self.count = 0;
        Ok(())
    }

    /// Appends one row, or leaves the file as it was.
    fn append(&mut self, row: std::fmt::Arguments<'_>) -> io::Result<()> {
        self.waiting.clear();
        self.waiting.write_fmt(row)?;
        self.flush()
    }

    /// Adds one row to those that wait, and writes them where they are many.
    fn queue(&mut self, row: impl FnOnce(&mut Vec<u8>) -> io::Result<()>) -> io::Result<()> {
        if self.waiting.len() > ROWS_BYTES_MAX {
            self.flush()?;
        }
        row(&mut self.waiting)?;
        self.count += 1;
        if self.count >= ROWS {
            self.count = 0;
            // What did not fit waits; it counts as failed only when it is given up.
            let _ = self.flush();
        }
        Ok(())
    }

    /// Takes rows back, down to so many bytes.
    fn cut(&mut self, good: u64) -> io::Result<()> {
        self.good = good;
        self.file.set_len(good)
    }
}

struct CameraFolder {
    camera: RigCamera,
    data: PathBuf,
    rows: Rows,
    /// Bytes of rows before the frame that is being listed.
    before: u64,
}

/// Writes an EuRoC ASL folder.
pub struct EurocSink {
    cameras: Vec<CameraFolder>,
    imu: Rows,
    /// Made with the first reading, in this folder.
    baro: Option<Rows>,
    baro_folder: PathBuf,
    encoded: Vec<u8>,
}

impl EurocSink {
    /// Makes the folders and the files of calibration.
    pub fn create(dir: &Path, calibration: &Calibration) -> io::Result<EurocSink> {
        let mav = dir.join("mav0");
        let mut cameras = Vec::new();
        for (k, camera) in calibration.cameras.iter().enumerate() {
            let folder = mav.join(format!("cam{k}"));
            let data = folder.join("data");
            fs::create_dir_all(&data)?;
            // The rate is in the stamps.
            write_new(&folder.join("sensor.yaml"), camera_yaml(camera, &format!("recorded cam{k}"), 0.0).as_bytes())?;
            let rows = Rows::create(&folder.join("data.csv"), IMAGE_COLUMNS)?;
            cameras.push(CameraFolder { camera: *camera, data, rows, before: 0 });
        }
        let folder = mav.join("imu0");
        fs::create_dir_all(&folder)?;
        write_new(&folder.join("sensor.yaml"), imu_yaml(&calibration.imu, "recorded, corrected").as_bytes())?;
        let imu = Rows::create(&folder.join("data.csv"), IMU_COLUMNS)?;
        Ok(EurocSink { cameras, imu, baro: None, baro_folder: mav.join("baro0"), encoded: Vec::new() })
    }

    fn images(&mut self, frames: &Frames) -> io::Result<()> {
        for (k, (folder, image)) in self.cameras.iter().zip(&frames.images).enumerate() {
            let (partial, path) = names(folder, frames);
            self.encoded.clear();
            png(&mut self.encoded, image, frames.colours.get(k)).map_err(io::Error::other)?;
            let written = write_new(&partial, &self.encoded).and_then(|()| fs::rename(&partial, &path));
            if written.is_err() {
                // Gives the disk back what half an image took.
                let _ = fs::remove_file(&partial);
                return written;
            }
        }
        Ok(())
    }

    /// Lists a frame for every camera or for none.
    fn list(&mut self, frames: &Frames) -> io::Result<()> {
        self.cameras.iter_mut().for_each(|folder| folder.before = folder.rows.good);
        let listed = self.cameras.iter_mut().try_for_each(|folder| {
            let t = folder.camera.from_imu_clock(frames.t).0;
            folder.rows.append(format_args!("{t},{t}.png\n"))
        });
        if listed.is_err() {
            self.cameras.iter_mut().try_for_each(|folder| folder.rows.cut(folder.before))?;
        }
        listed
    }
}

/// Writes a file that is not there yet, which a link would be.
fn write_new(path: &Path, bytes: &[u8]) -> io::Result<()> {
    File::create_new(path)?.write_all(bytes)
}

/// The hidden name of an image, and its own.
fn names(folder: &CameraFolder, frames: &Frames) -> (PathBuf, PathBuf) {
    let t = folder.camera.from_imu_clock(frames.t).0;
    (folder.data.join(format!(".{t}.partial")), folder.data.join(format!("{t}.png")))
}

impl Sink for EurocSink {
    fn frames(&mut self, frames: &Frames) -> io::Result<()> {
        self.imu.flush()?;
        self.baro.as_mut().map_or(Ok(()), Rows::flush)?;
        let written = self.images(frames).and_then(|()| self.list(frames));
        if written.is_err() {
            for folder in &self.cameras {
                let _ = fs::remove_file(names(folder, frames).1);
            }
        }
        written
    }

    fn imu(&mut self, reading: &ImuReading) -> io::Result<()> {
        self.imu.queue(|out| imu_row(out, &reading.sample))
    }

    fn aid(&mut self, reading: &AidReading) -> io::Result<()> {
        let rows = match self.baro.take() {
            Some(rows) => rows,
            None => {
                fs::create_dir_all(&self.baro_folder)?;
                Rows::create(&self.baro_folder.join("data.csv"), BARO_COLUMNS)?
            }
        };
        self.baro.insert(rows).queue(|out| aid_row(out, reading))
    }

    fn sync(&mut self) -> io::Result<()> {
        host::sync_disk_of(&self.imu.file)
    }

    fn finish(&mut self) -> io::Result<()> {
        self.imu.flush()?;
        self.baro.as_mut().map_or(Ok(()), Rows::flush)?;
        self.sync()
    }
}
