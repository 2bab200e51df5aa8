//! Image lists of the cameras, and the frames that are made of them: one image of every camera, taken together.

use super::findings::Findings;
use super::table::{self, Row};
use super::{cameras, order};
use crate::types::{Nanos, Span};
use crate::{Calibration, Fault, FaultKind};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// An image file, and the table and line that list it.
#[derive(Clone, Debug, PartialEq)]
pub struct ImageFile {
    /// The image.
    pub path: PathBuf,
    /// The csv that lists it.
    pub list: Arc<Path>,
    /// The line of `list`, from 1.
    pub line: usize,
}

/// One image of every camera, taken together; `t` is camera 0's stamp in the inertial unit's clock.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameFiles {
    /// The stamp of the first camera that has an image, in the inertial unit's clock.
    pub t: Nanos,
    /// The files, one for each camera; `None` of a camera whose recording has ended.
    pub images: Vec<Option<ImageFile>>,
}

/// A camera that gives nothing for so long before the others end has ended early: ten images at 20 Hz.
const ENDED_EARLY: Span = Span(500_000_000);

/// A row of an image list; `t` is in the inertial unit's clock once the list was read.
pub struct ImageRow {
    t: Nanos,
    file: String,
}

/// Reads the image lists of all cameras, each of which must be calibrated and recorded.
pub fn image_lists(
    mav0: &Path,
    calibration: &Calibration,
    findings: &mut Findings,
) -> Result<Vec<Vec<Row<ImageRow>>>, Fault> {
    let (recorded, calibrated) = (cameras::recorded(mav0)?, calibration.cameras.len());
    if recorded != calibrated {
        let what = format!("holds {}, the calibration has {}", cameras::named(recorded), cameras::named(calibrated));
        let fix = "take the others out of the one that has more, or name the right calibration with --calibration FILE";
        return Err(Fault::new(FaultKind::Config, mav0.display().to_string(), what, fix));
    }
    let list = |k: usize| list_path(mav0, k);
    // A name alone: a path could lead out of the recording.
    let is_name = |file: &str| Path::new(file).file_name().is_some_and(|name| name == file);
    let parse = |fields: &[&str]| match fields {
        [t, file] if is_name(file) => Some(ImageRow { t: Nanos(t.parse().ok()?), file: file.to_string() }),
        _ => None,
    };
    let read = |k: usize| {
        let rows = table::read(&list(k), "stamp [ns], file name", parse, findings)?;
        let mut rows = order::increasing(rows, |r| r.t, &list(k), findings);
        rows.iter_mut().for_each(|r| r.value.t = calibration.cameras[k].to_imu_clock(r.value.t));
        Ok(rows)
    };
    (0..recorded).map(read).collect()
}

fn list_path(mav0: &Path, camera: usize) -> PathBuf {
    mav0.join(format!("cam{camera}/data.csv"))
}

/// Makes frames of the lists, oldest images first: an image whose partners are all within the tolerance makes a frame with
/// them; any other is unpaired, as a frame needs an image of every camera. When a camera ends early the others go on
/// without it.
pub fn into_frames(
    mav0: &Path,
    lists: &[Vec<Row<ImageRow>>],
    tolerance: Span,
    findings: &mut Findings,
) -> Result<Vec<FrameFiles>, Fault> {
    let paths: Vec<Arc<Path>> = (0..lists.len()).map(|k| list_path(mav0, k).into()).collect();
    let early = ended_early(lists, &paths, findings);
    let mut heads = vec![0usize; lists.len()];
    let mut frames = Vec::new();
    loop {
        let stamp = |k: usize, ahead: usize| lists[k].get(heads[k] + ahead).map(|r| r.value.t);
        let cameras = (0..lists.len()).filter(|k| !early[*k] || stamp(*k, 0).is_some());
        let Some(oldest) = cameras.clone().filter(|k| stamp(*k, 0).is_some()).min_by_key(|k| stamp(*k, 0)) else {
            break;
        };
        let t = stamp(oldest, 0).expect("chosen among those with a stamp");
        let newest = cameras.clone().map(|k| stamp(k, 0).unwrap_or(Nanos(i64::MAX))).max().unwrap_or(t);
        let ended = cameras.clone().any(|k| stamp(k, 0).is_none());
        // Where the oldest camera's next image is closer to the others, it is the partner.
        let next_is_closer = newest > t && stamp(oldest, 1).is_some_and(|n| n <= newest);
        if !ended && newest - t <= tolerance && !next_is_closer {
            let image = |k: usize| {
                let row = lists[k].get(heads[k])?;
                let path = paths[k].with_file_name("data").join(&row.value.file);
                Some(ImageFile { path, list: paths[k].clone(), line: row.line })
            };
            let first = (0..lists.len()).find_map(|k| stamp(k, 0)).unwrap_or(t);
            frames.push(FrameFiles { t: first, images: (0..lists.len()).map(image).collect() });
            heads.iter_mut().for_each(|h| *h += 1);
        } else {
            let line = lists[oldest][heads[oldest]].line;
            let what = format!("image {} has no partner within {:.4} s: dropped", t.0, tolerance.secs());
            findings.warn(|c| &mut c.images_unpaired, &paths[oldest], line, what);
            heads[oldest] += 1;
        }
    }
    if !frames.iter().any(|f: &FrameFiles| f.images.iter().all(Option::is_some)) {
        let what = format!("no image has a partner within {:.4} s in every camera", tolerance.secs());
        let fix = "check that the cameras are synchronised, or raise replay.pair_tolerance_s";
        return Err(Fault::new(FaultKind::Data, mav0.display().to_string(), what, fix));
    }
    Ok(frames)
}

/// Which cameras end before another does, each with a warning.
fn ended_early(lists: &[Vec<Row<ImageRow>>], paths: &[Arc<Path>], findings: &mut Findings) -> Vec<bool> {
    let end = |k: usize| lists[k].last().map(|row| row.value.t);
    let Some(longest) = (0..lists.len()).rev().max_by_key(|k| end(*k)) else { return vec![] };
    let mut early = vec![false; lists.len()];
    for (k, list) in lists.iter().enumerate() {
        let (Some(row), Some(last)) = (list.last(), end(longest)) else { continue };
        let before = last - row.value.t;
        if before > ENDED_EARLY {
            let what = format!(
                "camera {k} ended {:.1} s before camera {longest}: goes on with camera {longest}, and black images of camera \
                 {k}. Add its other images, or see why it stopped",
                before.secs()
            );
            findings.warn(|c| &mut c.cameras_ended_early, &paths[k], row.line, what);
            early[k] = true;
        }
    }
    early
}
