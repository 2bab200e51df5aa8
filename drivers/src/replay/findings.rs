//! What was wrong with a recording: a counter for each kind, and warnings, of which only the first few of a kind are kept, so
//! that a damaged recording cannot fill memory or the screen.

use crate::{Fault, FaultKind};
use std::path::Path;

/// Warnings that are kept of one kind; the rest are only counted.
pub const WARNINGS_OF_A_KIND: u64 = 20;

crate::counters! {
    /// Faults of a recording, by kind.
    #[derive(Clone, PartialEq, Eq)]
    pub struct ReplayCounters of u64, read by u64::clone;
    /// Rows of a csv that could not be read: letters, missing or additional fields.
    rows_malformed,
    /// Rows with the stamp of another row of the same table.
    stamps_duplicated,
    /// Rows out of time order.
    stamps_out_of_order,
    /// Image rows without a partner in every other camera.
    images_unpaired,
    /// Times that a camera was away while another went on: from the start, for a while, from then on, or always.
    cameras_away,
    /// Black images in the place of those of cameras that were away.
    images_absent,
    /// Images listed whose file is missing.
    images_missing,
    /// Image files that are cut off or otherwise cannot be decoded.
    images_undecodable,
    /// Image files whose size differs from the calibration's.
    images_wrong_size,
    /// Frames before the first or after the last inertial sample.
    images_outside_imu,
    /// Inertial samples that are not finite.
    imu_not_finite,
    /// Pressures that are not finite.
    pressures_not_finite,
    /// Gaps in the inertial stream.
    imu_holes,
    /// Calibration values that are missing and assumed, or present and not used.
    calibration_notes,
}

/// Warnings, each "file:line: what", and counters.
#[derive(Clone, Debug, Default)]
pub struct Findings {
    /// Warnings in the order in which they were met.
    pub warnings: Vec<String>,
    /// Counters of all faults, those without a warning included.
    pub counters: ReplayCounters,
}

impl Findings {
    /// Counts a fault and keeps its warning; line 0 stands for the whole file.
    pub fn warn(
        &mut self,
        kind: fn(&mut ReplayCounters) -> &mut u64,
        path: &Path,
        line: usize,
        what: impl std::fmt::Display,
    ) {
        let count = kind(&mut self.counters);
        *count += 1;
        if *count > WARNINGS_OF_A_KIND {
            return;
        }
        let place = place(path, line);
        let more = if *count == WARNINGS_OF_A_KIND { " (more of this kind are only counted)" } else { "" };
        self.warnings.push(format!("{place}: {what}{more}"));
    }

    /// The first finding as a fault, for files in which nothing may be wrong.
    pub fn refuse_any(&self) -> Result<(), Fault> {
        let Some(warning) = self.warnings.first() else { return Ok(()) };
        let (place, what) = warning.split_once(": ").unwrap_or((warning, ""));
        let what = what.trim_end_matches(": row dropped");
        Err(Fault::new(FaultKind::Data, place, what, "correct or remove the row"))
    }
}

/// Where a fault is: a file, or its line; line 0 stands for the whole file.
pub fn place(path: &Path, line: usize) -> String {
    match line {
        0 => path.display().to_string(),
        _ => format!("{}:{line}", path.display()),
    }
}
