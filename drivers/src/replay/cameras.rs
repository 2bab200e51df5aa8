//! The number of cameras of a recording or a calibration: cam0, cam1 and so on without a gap, at most `CAMERAS_MAX`. A gap is
//! found when the missing camera is read, so that its file or key is named.

use crate::{Fault, FaultKind};
use std::path::Path;

/// Most cameras of one rig: as many as the estimator takes.
pub const CAMERAS_MAX: usize = 4;

/// One more than the highest number among these names of cameras; other names are passed over.
pub fn count<'a>(names: impl Iterator<Item = &'a str>) -> usize {
    names.filter_map(number).map(|k| k.saturating_add(1)).max().unwrap_or(0)
}

/// The number of a name such as `cam12`.
fn number(name: &str) -> Option<usize> {
    let digits = name.strip_prefix("cam")?;
    digits.bytes().all(|b| b.is_ascii_digit()).then(|| digits.parse().ok())?
}

/// The number of camera folders in `mav0`; one at least, as a recording without any lacks cam0. A fault where there are
/// more than a rig may have.
pub fn recorded(mav0: &Path) -> Result<usize, Fault> {
    let entries = std::fs::read_dir(mav0).map_err(|e| {
        Fault::new(FaultKind::NoInput, mav0.display().to_string(), format!("cannot read: {e}"), "check the path")
    })?;
    let folders = entries.flatten().filter(|e| e.path().is_dir());
    let names: Vec<String> = folders.map(|e| e.file_name().to_string_lossy().into_owned()).collect();
    let count = count(names.iter().map(String::as_str)).max(1);
    if count > CAMERAS_MAX {
        let fix = format!("move the folders from cam{CAMERAS_MAX} on elsewhere");
        return Err(Fault::new(FaultKind::Data, mav0.display().to_string(), too_many(count), fix));
    }
    Ok(count)
}

/// What is wrong with more cameras than a rig may have.
pub fn too_many(count: usize) -> String {
    format!("holds cam{}, a rig has {CAMERAS_MAX} cameras at most (cam0 to cam{})", count - 1, CAMERAS_MAX - 1)
}

/// A number of cameras in words: "1 camera", "4 cameras".
pub fn named(count: usize) -> String {
    format!("{count} camera{}", if count == 1 { "" } else { "s" })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_of_cameras_count() {
        assert_eq!(count(["imu0", "cam0", "camera", "cam", "cam-1", "camx", "depth0"].into_iter()), 1);
        assert_eq!(count(["cam12", "cam0"].into_iter()), 13);
        assert_eq!(count(["cam99999999999999999999999"].into_iter()), 0);
        assert_eq!(count([format!("cam{}", usize::MAX).as_str()].into_iter()), usize::MAX);
        assert_eq!(count([].into_iter()), 0);
    }
}
