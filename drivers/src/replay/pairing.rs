//! Image lists of the cameras, and the frames that are made of them: one image of every camera, taken together.

use super::findings::Findings;
use super::table::{self, Row};
use super::{cameras, order};
use crate::source::missed_after;
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
    /// The files, one for each camera; `None` of a camera that is away.
    pub images: Vec<Option<ImageFile>>,
}

/// A row of an image list; `t` is in the inertial unit's clock once the list was read.
pub struct ImageRow {
    t: Nanos,
    file: String,
}

/// Columns of a list.
const COLUMNS: &str = "stamp [ns], file name";

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
        let rows = table::read_any(&list(k), COLUMNS, parse, findings)?;
        let mut rows = order::increasing(rows, |r| r.t, &list(k), findings);
        rows.iter_mut().for_each(|r| r.value.t = calibration.cameras[k].to_imu_clock(r.value.t));
        Ok(rows)
    };
    let lists = (0..recorded).map(read).collect::<Result<Vec<_>, _>>()?;
    match lists.iter().all(Vec::is_empty) {
        true => Err(table::no_rows(&list(0), COLUMNS)),
        false => Ok(lists),
    }
}

fn list_path(mav0: &Path, camera: usize) -> PathBuf {
    mav0.join(format!("cam{camera}/data.csv"))
}

/// A camera that gives no image for longer is away, by the median of its periods.
fn patience(list: &[Row<ImageRow>]) -> Span {
    let mut steps: Vec<Span> = list.windows(2).map(|w| w[1].value.t - w[0].value.t).collect();
    let middle = steps.len() / 2;
    missed_after(if steps.is_empty() { Span(0) } else { *steps.select_nth_unstable(middle).1 })
}

/// Leaves out images that are far from their camera's others and have no partner, as those of corrupt stamps: a frame of such
/// a one would make the recording last until then. One camera alone needs no partners.
fn drop_strays(lists: &mut [Vec<Row<ImageRow>>], tolerance: Span, paths: &[Arc<Path>], findings: &mut Findings) {
    let stamps: Vec<Vec<Nanos>> = lists.iter().map(|list| list.iter().map(|row| row.value.t).collect()).collect();
    for (k, list) in lists.iter_mut().enumerate().filter(|_| stamps.len() > 1) {
        let patience = patience(list);
        list.retain(|Row { line, value: ImageRow { t, .. } }| {
            let kept = stamps.iter().enumerate().any(|(camera, of)| {
                let (itself, reach) = if camera == k { (1, patience) } else { (0, tolerance) };
                let at = of.partition_point(|s| s < t);
                let near = |i: usize| of.get(i).is_some_and(|s| (*t - *s).max(*s - *t) <= reach);
                at > 0 && near(at - 1) || near(at + itself)
            });
            if !kept {
                let far = format!("more than {:.1} s from its camera's others", patience.secs());
                let what = format!("image {} is {far}, and has no partner: dropped", t.0);
                findings.warn(|c| &mut c.images_unpaired, &paths[k], *line, what);
            }
            kept
        });
    }
}

/// The lists, and how far they were read.
struct Heads<'a> {
    lists: &'a [Vec<Row<ImageRow>>],
    /// The next image of each camera.
    heads: Vec<usize>,
    /// Each camera's: one that gives nothing for longer is away.
    patience: Vec<Span>,
    /// The first and the last stamp of all.
    ends: [Nanos; 2],
}

impl Heads<'_> {
    fn of(lists: &[Vec<Row<ImageRow>>]) -> Heads<'_> {
        let patience = lists.iter().map(|list| patience(list)).collect();
        let stamps = || lists.iter().flatten().map(|row| row.value.t);
        let ends = [stamps().min(), stamps().max()].map(Option::unwrap_or_default);
        Heads { lists, heads: vec![0; lists.len()], patience, ends }
    }

    fn row(&self, k: usize, index: usize) -> Option<&Row<ImageRow>> {
        self.lists[k].get(index)
    }

    fn next(&self, k: usize) -> Option<Nanos> {
        self.row(k, self.heads[k]).map(|row| row.value.t)
    }

    fn after(&self, k: usize) -> Option<Nanos> {
        self.row(k, self.heads[k] + 1).map(|row| row.value.t)
    }

    fn before(&self, k: usize) -> Option<Nanos> {
        self.row(k, self.heads[k].checked_sub(1)?).map(|row| row.value.t)
    }

    /// Time without an image of a camera before its next one.
    fn gap(&self, k: usize) -> Span {
        self.next(k).unwrap_or(self.ends[1]) - self.before(k).unwrap_or(self.ends[0])
    }

    /// Whether a camera is away at `t`, the oldest of the next stamps.
    fn is_away(&self, k: usize, t: Nanos, tolerance: Span) -> bool {
        let gives_none = self.next(k).is_none_or(|next| next - t > tolerance);
        gives_none && (self.lists[k].is_empty() || self.gap(k) > self.patience[k])
    }

    /// The line that shows why a camera is away, and what is said of it.
    fn why_away(&self, k: usize) -> (usize, String) {
        let secs = self.gap(k).secs();
        let line = |index: usize| self.row(k, index).map_or(0, |row| row.line);
        let (line, what) = match (self.before(k), self.next(k)) {
            (None, None) => (0, "has no images".to_string()),
            (None, Some(_)) => (line(0), format!("began {secs:.1} s after the others")),
            (Some(_), None) => (line(self.heads[k] - 1), format!("ended {secs:.1} s before the others")),
            (Some(_), Some(_)) => (line(self.heads[k]), format!("gave no image for {secs:.1} s before this one")),
        };
        let fix = "Add its other images, or see why it gave none";
        (line, format!("camera {k} {what}: goes on without it, and black images of camera {k}. {fix}"))
    }
}

/// Makes frames of the lists, oldest images first: an image whose partners are all within the tolerance makes a frame with
/// them; any other is unpaired. While a camera is away, as live, the others go on without it.
pub fn into_frames(
    mav0: &Path,
    mut lists: Vec<Vec<Row<ImageRow>>>,
    tolerance: Span,
    findings: &mut Findings,
) -> Result<Vec<FrameFiles>, Fault> {
    let paths: Vec<Arc<Path>> = (0..lists.len()).map(|k| list_path(mav0, k).into()).collect();
    let recorded = lists.iter().filter(|list| !list.is_empty()).count();
    drop_strays(&mut lists, tolerance, &paths, findings);
    let mut heads = Heads::of(&lists);
    // Where each camera stood when it was last said to be away.
    let mut told = vec![None; lists.len()];
    let mut frames = Vec::new();
    while let Some((t, oldest)) = (0..lists.len()).filter_map(|k| Some((heads.next(k)?, k))).min() {
        let (away, cameras): (Vec<usize>, Vec<usize>) = (0..lists.len()).partition(|k| heads.is_away(*k, t, tolerance));
        let newest = cameras.iter().map(|k| heads.next(*k).unwrap_or(Nanos(i64::MAX))).max().unwrap_or(t);
        // Where the oldest camera's next image is closer to the others, it is the partner.
        let next_is_closer = newest > t && heads.after(oldest).is_some_and(|n| n <= newest);
        if newest - t > tolerance || next_is_closer {
            let line = lists[oldest][heads.heads[oldest]].line;
            let what = format!("image {} has no partner within {:.4} s: dropped", t.0, tolerance.secs());
            findings.warn(|c| &mut c.images_unpaired, &paths[oldest], line, what);
            heads.heads[oldest] += 1;
            continue;
        }
        for k in away {
            findings.counters.images_absent += 1;
            if told[k].replace(heads.heads[k]) != Some(heads.heads[k]) {
                let (line, what) = heads.why_away(k);
                findings.warn(|c| &mut c.cameras_away, &paths[k], line, what);
            }
        }
        let first = cameras.first().and_then(|k| heads.next(*k)).unwrap_or(t);
        let mut frame = FrameFiles { t: first, images: vec![None; lists.len()] };
        for k in cameras {
            let path = |row: &Row<ImageRow>| paths[k].with_file_name("data").join(&row.value.file);
            let file = |row| ImageFile { path: path(row), list: paths[k].clone(), line: row.line };
            frame.images[k] = heads.row(k, heads.heads[k]).map(file);
            heads.heads[k] += 1;
        }
        frames.push(frame);
    }
    if !frames.iter().any(|f: &FrameFiles| f.images.iter().flatten().count() >= recorded.min(2)) {
        let what = format!("no image has a partner within {:.4} s in another camera", tolerance.secs());
        let fix = "check that the cameras are synchronised, or raise camera.pair_tolerance_s";
        return Err(Fault::new(FaultKind::Data, mav0.display().to_string(), what, fix));
    }
    Ok(frames)
}
