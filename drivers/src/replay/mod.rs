//! Recorded datasets of one to four cameras and an inertial unit: EuRoC ASL (`mav0`, sensor.yaml) and TUM-VI (`mav0` beside
//! a Kalibr camchain.yaml), images as 8- or 16-bit PNG or JPEG.
//!
//! `Recording::open` reads all tables and the calibration, pairs the images by stamp into frames and checks the inertial
//! stream against them; a `Reader` decodes the images of one frame at a time. A problem that makes the whole recording
//! useless (no calibration, an empty table) is a `Fault`; one that hurts a row or an image costs that row or image, a named
//! counter and a warning with file and line. Stamps that do not grow are dropped so that the most rows stay (`order`): one
//! corrupt stamp far in the future costs itself and not the rest of the recording.
//!
//! A recording may come from anywhere: files are read with a limit of size, names and links in it lead to nothing outside
//! its folder, and pipes and devices are not opened (`input`).

mod calibration;
mod cameras;
mod findings;
mod images;
mod inertial;
mod order;
mod pairing;
mod table;
mod trajectory;

pub use calibration::read_calibration;
pub use cameras::CAMERAS_MAX;
pub use findings::ReplayCounters;
pub use images::{ImageFault, Reader};
pub use inertial::read_inertial;
pub use pairing::{FrameFiles, ImageFile};
pub(crate) use table::{numbers, read_strictly, Row};
pub use trajectory::read_trajectory;

use crate::source::{Aid, AidReading};
use crate::types::{ImuSample, Nanos, Span, TimedPose};
use crate::{input, Calibration, Fault, FaultKind};
use findings::Findings;
use glam::DVec3;
use std::path::{Path, PathBuf};

/// How a recording is read.
#[derive(Clone, Debug, PartialEq)]
pub struct OpenOptions {
    /// Largest stamp difference of images of one frame.
    pub pair_tolerance: Span,
    /// Gap between inertial samples that counts as a hole.
    pub imu_hole: Span,
    /// Calibration used instead of the recording's own; see `read_calibration`.
    pub calibration: Option<PathBuf>,
    /// Readout time of every camera, first row to last, where the board states it.
    pub readout: Option<Span>,
}

impl Default for OpenOptions {
    fn default() -> Self {
        OpenOptions { pair_tolerance: Span(2_000_000), imu_hole: Span(20_000_000), calibration: None, readout: None }
    }
}

/// A dataset with its tables in memory and its images on disk. All stamps grow strictly. The calibration of time and of the
/// unit's axes is applied: stamps of images are in the inertial unit's clock, samples are corrected.
#[derive(Clone, Debug)]
pub struct Recording {
    /// The calibration that was applied.
    pub calibration: Calibration,
    /// Inertial samples, corrected.
    pub imu: Vec<ImuSample>,
    /// Readings of a barometer; empty where the recording has none.
    pub aids: Vec<AidReading>,
    /// Frames in the order of their stamps.
    pub frames: Vec<FrameFiles>,
    /// Ground truth, `world_from_body`; empty where the recording has none.
    pub truth: Vec<TimedPose>,
    /// "file:line: what", at most `findings::WARNINGS_OF_A_KIND` of each kind.
    pub warnings: Vec<String>,
    /// Counters of what was wrong.
    pub counters: ReplayCounters,
    /// The folder that holds it, canonical.
    root: PathBuf,
}

impl Recording {
    /// Opens a folder that holds `mav0/`, or `mav0/` itself. A fault where the whole recording is of no use.
    pub fn open(dataset: &Path, options: &OpenOptions) -> Result<Recording, Fault> {
        let (home, mav0) = layout(dataset)?;
        let root = root(&home, &mav0)?;
        let mut findings = Findings::default();
        let calibration = match &options.calibration {
            Some(path) => calibration::read(path, options.readout, &mut findings)?,
            None => calibration::of_recording(&home, &mav0, options.readout, &mut findings)?,
        };
        let lists = pairing::image_lists(&mav0, &calibration, &mut findings)?;
        let frames = pairing::into_frames(&mav0, lists, options.pair_tolerance, &mut findings)?;
        let mut imu = read_imu(&mav0.join("imu0/data.csv"), options.imu_hole, &mut findings)?;
        imu.iter_mut().for_each(|s| *s = calibration.imu.correction.apply(s));
        check_cover(&frames, &imu, &mut findings);
        let baro = mav0.join("baro0/data.csv");
        let aids = if baro.is_file() { read_pressures(&baro, &mut findings)? } else { vec![] };
        let truth = ["state_groundtruth_estimate0/data.csv", "mocap0/data.csv"]
            .into_iter()
            .map(|name| mav0.join(name))
            .find(|path| path.is_file())
            .map_or(Ok(Vec::new()), |path| trajectory::read(&path, &mut findings))?;
        let Findings { warnings, counters } = findings;
        Ok(Recording { calibration, imu, aids, frames, truth, warnings, counters, root })
    }

    /// A decoder of the frames, with memory of its own, for one thread.
    pub fn reader(&self) -> Reader {
        Reader::new(self.frames.as_slice().into(), self.root.as_path().into())
    }
}

/// The folder that holds `mav0`, and `mav0`.
fn layout(dataset: &Path) -> Result<(PathBuf, PathBuf), Fault> {
    let missing = |what: &str| {
        let fix = "name a folder that holds mav0/ (EuRoC ASL or TUM-VI)";
        Err(Fault::new(FaultKind::NoInput, dataset.display().to_string(), what, fix))
    };
    if !dataset.is_dir() {
        return missing(if dataset.exists() { "is a file, not a folder" } else { "no such folder" });
    }
    let inner = dataset.join("mav0");
    if inner.is_dir() {
        return Ok((dataset.to_path_buf(), inner));
    }
    if dataset.join("cam0").is_dir() {
        return Ok((dataset.join(".."), dataset.to_path_buf()));
    }
    missing("holds neither mav0/ nor cam0/")
}

/// The canonical path of the folder `home`; a fault where a folder or a table of the recording is a link that leads out of
/// it. Images are looked at one by one when they are read.
fn root(home: &Path, mav0: &Path) -> Result<PathBuf, Fault> {
    let fault =
        |path: &Path, what: String, fix: &str| Fault::new(FaultKind::NoInput, path.display().to_string(), what, fix);
    let cannot = |e: std::io::Error| fault(home, format!("cannot read: {e}"), "check the path");
    let root = std::fs::canonicalize(home).map_err(cannot)?;
    let inside =
        |folder: &Path| std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path()).collect::<Vec<_>>();
    let sensors = inside(mav0);
    let tables = sensors.iter().flat_map(|folder| inside(folder));
    let beside = ["dso", "dso/camchain.yaml", "dso/imu_config.yaml", "camchain.yaml", "imu_config.yaml"];
    let mut names = [mav0.to_path_buf()].into_iter().chain(beside.map(|name| home.join(name)));
    let out = names.find(|p| input::leads_out(p, &root));
    match out.or_else(|| sensors.iter().cloned().chain(tables).find(|p| input::leads_out(p, &root))) {
        Some(link) => {
            let fix = "put there what it points to: a recording is read from its own folder alone";
            Err(fault(&link, "is a link out of the recording".into(), fix))
        }
        None => Ok(root),
    }
}

/// Columns of a table of inertial samples.
const IMU_COLUMNS: &str = "stamp [ns], gyro x y z [rad/s], accelerometer x y z [m/s²]";

/// The sample of such a row.
fn imu_of(fields: &[&str]) -> Option<ImuSample> {
    let [t, values @ ..] = fields else { return None };
    let v: [f64; 6] = table::numbers(values)?.try_into().ok()?;
    let (gyro_body, accel_body) = (DVec3::new(v[0], v[1], v[2]), DVec3::new(v[3], v[4], v[5]));
    Some(ImuSample { t: Nanos(t.parse().ok()?), gyro_body, accel_body, ..ImuSample::default() })
}

fn read_imu(path: &Path, hole: Span, findings: &mut Findings) -> Result<Vec<ImuSample>, Fault> {
    let mut rows = table::read(path, IMU_COLUMNS, imu_of, findings)?;
    rows.retain(|row| {
        if !row.value.is_finite() {
            findings.warn(|c| &mut c.imu_not_finite, path, row.line, "sample is not finite: dropped");
        }
        row.value.is_finite()
    });
    let rows = order::increasing(rows, |s| s.t, path, findings);
    if rows.is_empty() {
        return Err(Fault::new(FaultKind::Data, path.display().to_string(), "holds no finite sample", "record again"));
    }
    for pair in rows.windows(2) {
        let gap = pair[1].value.t - pair[0].value.t;
        if gap > hole {
            let what = format!("hole of {:.4} s before this sample", gap.secs());
            findings.warn(|c| &mut c.imu_holes, path, pair[1].line, what);
        }
    }
    Ok(rows.into_iter().map(|r: Row<ImuSample>| r.value).collect())
}

fn read_pressures(path: &Path, findings: &mut Findings) -> Result<Vec<AidReading>, Fault> {
    let parse = |fields: &[&str]| -> Option<AidReading> {
        let [t, pa] = fields else { return None };
        Some(AidReading { t: Nanos(t.parse().ok()?), value: Aid::Pressure(pa.parse().ok()?) })
    };
    let mut rows = table::read(path, "stamp [ns], pressure [Pa]", parse, findings)?;
    rows.retain(|row| {
        let Aid::Pressure(pa) = row.value.value;
        if !pa.is_finite() {
            findings.warn(|c| &mut c.pressures_not_finite, path, row.line, "pressure is not finite: dropped");
        }
        pa.is_finite()
    });
    Ok(order::increasing(rows, |r| r.t, path, findings).into_iter().map(|row| row.value).collect())
}

/// Counts frames outside the inertial stream; they stay, as mapping with given poses can use them.
fn check_cover(frames: &[FrameFiles], imu: &[ImuSample], findings: &mut Findings) {
    let (Some(first), Some(last)) = (imu.first(), imu.last()) else { return };
    for frame in frames.iter().filter(|f| f.t < first.t || f.t > last.t) {
        let Some(image) = frame.images.iter().flatten().next() else { continue };
        let what = "image outside the span of the inertial samples";
        findings.warn(|c| &mut c.images_outside_imu, &image.list, image.line, what);
    }
}
