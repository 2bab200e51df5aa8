//! What a run leaves behind: trajectory, map, renders, report, and the folder they go to.
//!
//! A file appears under its final name only when it is complete: it is written to a hidden name
//! in the same folder, flushed to the disk and renamed. A run that dies leaves earlier results
//! as they were and at most one hidden `.NAME.partial`, which the next run overwrites.

pub mod chart;
pub mod html;
pub mod metrics;
pub mod panel;
pub mod ply;
pub mod report;
pub mod trajectory;

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use stipple_drivers::{Fault, FaultKind};

/// Writes `path` through `write`, all or nothing.
pub fn atomically<R>(path: &Path, write: impl FnOnce(&mut BufWriter<File>) -> io::Result<R>) -> Result<R, Fault> {
    let partial = partial_name(path);
    let file = File::create(&partial).map_err(|e| cannot_create(path, &e))?;
    let mut out = BufWriter::with_capacity(1 << 16, file);
    let written = write(&mut out)
        .and_then(|r| out.flush().map(|()| r))
        .and_then(|r| out.get_ref().sync_all().map(|()| r))
        .and_then(|r| fs::rename(&partial, path).map(|()| r));
    written.map_err(|e| {
        // The write error is the one to report; a leftover hidden file is harmless.
        let _ = fs::remove_file(&partial);
        cannot_write(path, &e)
    })
}

/// The folder of `--out`: created and proved writable before any work starts.
#[derive(Clone, Debug)]
pub struct OutputDir {
    path: PathBuf,
}

impl OutputDir {
    pub fn create(path: &Path) -> Result<OutputDir, Fault> {
        fs::create_dir_all(path).map_err(|e| cannot_create(path, &e))?;
        let probe = path.join(".writable.partial");
        File::create(&probe).and_then(|_| fs::remove_file(&probe)).map_err(|e| cannot_create(path, &e))?;
        Ok(OutputDir { path: path.to_path_buf() })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    pub fn file(&self, name: &str) -> PathBuf {
        self.path.join(name)
    }

    /// Writes the file `name` of this folder, all or nothing.
    pub fn write<R>(&self, name: &str, write: impl FnOnce(&mut BufWriter<File>) -> io::Result<R>) -> Result<R, Fault> {
        atomically(&self.file(name), write)
    }

    /// Removes what an earlier run left under `name`, a file or a folder, and this one does not write. Fails where it cannot
    /// be removed.
    pub fn remove(&self, name: &str) -> Result<(), Fault> {
        let path = self.file(name);
        let removed = if path.is_dir() { clear(&path) } else { fs::remove_file(&path) };
        match removed {
            Err(e) if e.kind() != io::ErrorKind::NotFound => Err(cannot_write(&path, &e)),
            _ => Ok(()),
        }
    }

    /// Replaces the subfolder `name` by what `fill` puts into it, so that files of an earlier run
    /// never mix with those of this one.
    pub fn replace_folder<R>(&self, name: &str, fill: impl FnOnce(&Path) -> Result<R, Fault>) -> Result<R, Fault> {
        let folder = self.file(name);
        let partial = partial_name(&folder);
        let made = clear(&partial).and_then(|()| fs::create_dir(&partial)).map_err(|e| cannot_create(&folder, &e));
        let filled = made.and_then(|()| fill(&partial)).and_then(|r| {
            clear(&folder).and_then(|()| fs::rename(&partial, &folder)).map_err(|e| cannot_write(&folder, &e))?;
            Ok(r)
        });
        if filled.is_err() {
            let _ = fs::remove_dir_all(&partial);
        }
        filled
    }
}

/// Removes a folder of an earlier run, if there is one.
fn clear(folder: &Path) -> io::Result<()> {
    match fs::remove_dir_all(folder) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
        other => other,
    }
}

fn partial_name(path: &Path) -> PathBuf {
    let name = path.file_name().map_or_else(Default::default, |n| n.to_string_lossy().into_owned());
    path.with_file_name(format!(".{name}.partial"))
}

fn cannot_create(path: &Path, e: &io::Error) -> Fault {
    let (place, what) = (path.display().to_string(), format!("cannot be created: {e}"));
    Fault::new(FaultKind::NoOutput, place, what, "choose an --out folder that can be written to")
}

fn cannot_write(path: &Path, e: &io::Error) -> Fault {
    let (place, what) = (path.display().to_string(), format!("cannot be written: {e}"));
    Fault::new(FaultKind::Io, place, what, "check the free space of the disk")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn names(dir: &Path) -> Vec<String> {
        let mut n: Vec<_> = fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        n.sort();
        n
    }

    #[test]
    fn failed_write_leaves_the_earlier_result_and_nothing_else() {
        let dir = tempfile::tempdir().unwrap();
        let out = OutputDir::create(dir.path()).unwrap();
        out.write("a.txt", |w| w.write_all(b"old")).unwrap();
        let fault = out
            .write("a.txt", |w| {
                w.write_all(b"half")?;
                Err::<(), _>(io::Error::other("disk full"))
            })
            .unwrap_err();
        assert_eq!(fault.kind, FaultKind::Io);
        assert!(fault.to_string().contains("a.txt") && fault.to_string().contains("disk full"), "{fault}");
        assert_eq!(fs::read(dir.path().join("a.txt")).unwrap(), b"old");
        assert_eq!(names(dir.path()), ["a.txt"]);
    }

    #[test]
    fn folder_below_a_file_cannot_be_created() {
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("file"), b"").unwrap();
        let fault = OutputDir::create(&dir.path().join("file/out")).unwrap_err();
        assert_eq!(fault.kind, FaultKind::NoOutput);
        assert!(fault.place.contains("file/out"), "{fault}");
    }

    #[test]
    fn what_an_earlier_run_left_is_removed_and_what_is_not_there_is_no_error() {
        let dir = tempfile::tempdir().unwrap();
        let out = OutputDir::create(dir.path()).unwrap();
        out.write("map.ply", |w| w.write_all(b"old")).unwrap();
        out.replace_folder("renders", |d| atomically(&d.join("1.png"), |w| w.write_all(b"x"))).unwrap();
        ["map.ply", "renders", "never"].iter().for_each(|name| out.remove(name).unwrap());
        assert!(names(dir.path()).is_empty());
    }

    #[test]
    fn replaced_folder_holds_only_the_new_files() {
        let dir = tempfile::tempdir().unwrap();
        let out = OutputDir::create(dir.path()).unwrap();
        let fill = |name: &'static str| move |d: &Path| atomically(&d.join(name), |w| w.write_all(b"x"));
        out.replace_folder("renders", fill("1.png")).unwrap();
        out.replace_folder("renders", fill("2.png")).unwrap();
        let failed = out.replace_folder("renders", |_| {
            Err::<(), _>(Fault::new(FaultKind::Io, "renders/3.png", "cannot be written", ""))
        });
        assert!(failed.is_err());
        assert_eq!(names(dir.path()), ["renders"]);
        assert_eq!(names(&dir.path().join("renders")), ["2.png"]);
    }
}
