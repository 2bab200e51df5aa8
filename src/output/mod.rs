//! What a run leaves behind: trajectory, map, renders, report, and the folder they go to.
//!
//! A file appears under its final name only when it is complete: it is written to a hidden name in the same folder, flushed
//! to the disk and renamed, and the folder is flushed too. A run that dies leaves earlier results as they were and at most
//! one hidden `.NAME.partial`, which the next run removes. No link is followed: the hidden name is made anew, and renaming
//! replaces a link rather than what it points to. A folder of results is replaced only if it holds nothing but what this
//! program wrote: a hidden `.stipple` in it lists that.

pub mod chart;
pub mod export;
pub mod html;
pub mod metrics;
pub mod panel;
pub mod ply;
pub mod report;
pub mod spz;
pub mod trajectory;

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use stipple_drivers::host::sync_folder_of;
use stipple_drivers::{host, input, Fault, FaultKind};

/// Writes `path` through `write`, all or nothing.
pub fn atomically<R>(path: &Path, write: impl FnOnce(&mut BufWriter<File>) -> io::Result<R>) -> Result<R, Fault> {
    let partial = partial_name(path);
    let file = create_anew(&partial).map_err(|e| cannot_create(path, &e))?;
    let mut out = BufWriter::with_capacity(1 << 16, file);
    let written = write(&mut out)
        .and_then(|r| out.flush().map(|()| r))
        .and_then(|r| out.get_ref().sync_all().map(|()| r))
        .and_then(|r| fs::rename(&partial, path).map(|()| r))
        .and_then(|r| sync_folder_of(path).map(|()| r));
    written.map_err(|e| {
        // The write error is the one to report; a leftover hidden file is harmless.
        let _ = fs::remove_file(&partial);
        cannot_write(path, &e)
    })
}

/// Makes a file under a name of ours, in place of what an earlier run left there or somebody else put there.
fn create_anew(path: &Path) -> io::Result<File> {
    absent(fs::remove_file(path))?;
    File::create_new(path)
}

/// What is not there need not be removed.
fn absent(removed: io::Result<()>) -> io::Result<()> {
    removed.or_else(|e| if e.kind() == io::ErrorKind::NotFound { Ok(()) } else { Err(e) })
}

/// What a run writes at its end: of its flight, and of its map.
const OF_FLIGHT: [&str; 4] = ["trajectory.tum", "odometry.tum", "report.html", "report.json"];
const OF_MAP: [&str; 3] = ["keyframes.tum", "map.ply", "renders"];

/// The folder of `--out`: created and proved writable before any work starts.
#[derive(Clone, Debug)]
pub struct OutputDir {
    path: PathBuf,
}

impl OutputDir {
    /// Refuses, before any work, a folder whose `renders` this program did not write.
    pub fn create(path: &Path) -> Result<OutputDir, Fault> {
        fs::create_dir_all(path).map_err(|e| cannot_create(path, &e))?;
        let probe = path.join(".writable.partial");
        let probed = create_anew(&probe).map(drop).or_else(|e| match e.kind() {
            // Another run asks at this moment.
            io::ErrorKind::AlreadyExists => Ok(()),
            _ => Err(e),
        });
        probed.and_then(|()| absent(fs::remove_file(&probe))).map_err(|e| cannot_create(path, &e))?;
        own_files(&path.join("renders"))?;
        Ok(OutputDir { path: path.to_path_buf() })
    }

    /// A folder that `create` proved writable before; a disk may have been full or unplugged since.
    pub fn existing(path: &Path) -> OutputDir {
        OutputDir { path: path.to_path_buf() }
    }

    /// Keeps other runs out of the folder until the answer is dropped. Fails where another has it.
    pub fn lock(&self) -> Result<File, Fault> {
        let locked = File::open(&self.path).and_then(|folder| host::lock(&folder).map(|()| folder));
        locked.map_err(|e| {
            let what = match e.kind() {
                io::ErrorKind::WouldBlock => "another run writes to it".into(),
                _ => format!("cannot be locked: {e}"),
            };
            let fix = "wait until it has ended, or choose another --out folder";
            Fault::new(FaultKind::NoOutput, self.path.display().to_string(), what, fix)
        })
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

    /// Removes a file or a folder of results. Fails where it cannot be removed.
    fn remove(&self, name: &str) -> Result<(), Fault> {
        let path = self.file(name);
        match path.is_dir() {
            true => clear(&path),
            false => absent(fs::remove_file(&path)).map_err(|e| cannot_write(&path, &e)),
        }
    }

    /// Renames the results of an earlier run, if there are any, to `previous-report.html` and so on, and removes what had these
    /// names: after a kill they are not taken for results of this run. Those of the map stay without `with_map`.
    pub fn set_aside(&self, with_map: bool) -> Result<(), Fault> {
        let previous = |name: &str| format!("previous-{name}");
        let of_map: &[&str] = if with_map { &OF_MAP } else { &[] };
        let results = || OF_FLIGHT.iter().chain(of_map);
        let mut there = results().filter(|name| self.file(name).symlink_metadata().is_ok()).peekable();
        if there.peek().is_some() {
            results().try_for_each(|name| self.remove(&previous(name)))?;
        }
        there.try_for_each(|name| {
            let path = self.file(name);
            let renamed = fs::rename(&path, self.file(&previous(name))).and_then(|()| sync_folder_of(&path));
            renamed.map_err(|e| cannot_write(&path, &e))
        })
    }

    /// Replaces the subfolder `name` by what `fill` puts into it, so that files of an earlier run
    /// never mix with those of this one.
    pub fn replace_folder<R>(&self, name: &str, fill: impl FnOnce(&Path) -> Result<R, Fault>) -> Result<R, Fault> {
        let folder = self.file(name);
        let partial = partial_name(&folder);
        // Under a hidden name of ours, so whatever is there is ours; a link is removed, not followed.
        let made = absent(fs::remove_dir_all(&partial)).and_then(|()| fs::create_dir(&partial));
        let filled = made.map_err(|e| cannot_create(&folder, &e)).and_then(|()| fill(&partial)).and_then(|r| {
            let names = entries(&partial).map_err(|e| cannot_write(&folder, &e))?;
            atomically(&partial.join(LIST), |w| {
                names.iter().try_for_each(|name| writeln!(w, "{}", Path::new(name).display()))
            })?;
            clear(&folder)?;
            let renamed = fs::rename(&partial, &folder).and_then(|()| sync_folder_of(&folder));
            renamed.map_err(|e| cannot_write(&folder, &e))?;
            Ok(r)
        });
        if filled.is_err() {
            let _ = fs::remove_dir_all(&partial);
        }
        filled
    }
}

/// The list of what this program wrote into a folder, a name a line.
const LIST: &str = ".stipple";

fn entries(folder: &Path) -> io::Result<Vec<OsString>> {
    fs::read_dir(folder)?.map(|e| Ok(e?.file_name())).collect()
}

/// The files of a folder of results; none where there is no such folder. A fault where this program did not write them all.
fn own_files(folder: &Path) -> Result<Vec<PathBuf>, Fault> {
    let about = match fs::symlink_metadata(folder) {
        Ok(about) => about,
        Err(_) => return Ok(vec![]),
    };
    let foreign = |what: String| {
        let fix = "move it elsewhere, or choose another --out folder";
        Err(Fault::new(FaultKind::NoOutput, folder.display().to_string(), what, fix))
    };
    if !about.is_dir() {
        return foreign("is not a folder of this program's results".into());
    }
    let names = entries(folder).map_err(|e| cannot_write(folder, &e))?;
    // Without a list, nothing in it is ours, but for the pictures of an earlier version beside its report.
    let list = input::read_settings(&folder.join(LIST)).unwrap_or_default();
    let earlier = list.is_empty() && folder.with_file_name("report.json").is_file();
    let picture = |name: &str| {
        let number = name.strip_suffix(".png").map(|n| n.strip_suffix("_heldout").unwrap_or(n));
        number.is_some_and(|n| n.len() >= 4 && n.bytes().all(|b| b.is_ascii_digit()))
    };
    let listed = |name: &str| list.lines().any(|l| l == name) || earlier && picture(name);
    let own = |name: &&OsString| *name == LIST || name.to_str().is_some_and(listed);
    match names.iter().find(|name| !own(name)) {
        Some(name) => foreign(format!("holds {}, which this program did not write", Path::new(name).display())),
        None => Ok(names.iter().map(|name| folder.join(name)).collect()),
    }
}

/// Removes a folder of an earlier run, if there is one and nothing of anybody else is in it.
fn clear(folder: &Path) -> Result<(), Fault> {
    let removed = own_files(folder)?.iter().try_for_each(fs::remove_file);
    removed.and_then(|()| absent(fs::remove_dir(folder))).map_err(|e| cannot_write(folder, &e))
}

fn partial_name(path: &Path) -> PathBuf {
    let name = path.file_name().map_or_else(Default::default, |n| n.to_string_lossy().into_owned());
    path.with_file_name(format!(".{name}.partial"))
}

fn cannot_create(path: &Path, e: &io::Error) -> Fault {
    let (place, what) = (path.display().to_string(), format!("cannot be created or written to: {e}"));
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
    fn results_of_an_earlier_run_are_set_aside_until_there_are_others() {
        let dir = tempfile::tempdir().unwrap();
        let out = OutputDir::create(dir.path()).unwrap();
        out.write("map.ply", |w| w.write_all(b"1")).unwrap();
        out.write("log-0000.mcap", |w| w.write_all(b"1")).unwrap();
        out.replace_folder("renders", |d| atomically(&d.join("1.png"), |w| w.write_all(b"x"))).unwrap();
        // The second of two finds nothing: a run between them was killed.
        for _ in 0..2 {
            out.set_aside(true).unwrap();
            assert_eq!(names(dir.path()), ["log-0000.mcap", "previous-map.ply", "previous-renders"]);
            assert_eq!(names(&dir.path().join("previous-renders")), [LIST, "1.png"]);
        }
        out.write("report.json", |w| w.write_all(b"2")).unwrap();
        out.set_aside(true).unwrap();
        assert_eq!(names(dir.path()), ["log-0000.mcap", "previous-report.json"]);
        // Runs that only localise leave the map of the one before.
        out.write("map.ply", |w| w.write_all(b"3")).unwrap();
        for report in [b"3", b"4"] {
            out.write("report.json", |w| w.write_all(report)).unwrap();
            out.set_aside(false).unwrap();
            assert_eq!(names(dir.path()), ["log-0000.mcap", "map.ply", "previous-report.json"]);
        }
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
        assert_eq!(names(&dir.path().join("renders")), [LIST, "2.png"]);
    }

    #[test]
    fn the_pictures_of_an_earlier_version_are_known_by_their_names_and_its_report() {
        let dir = tempfile::tempdir().unwrap();
        let renders = dir.path().join("renders");
        fs::create_dir(&renders).unwrap();
        ["0007.png", "0012_heldout.png"].iter().for_each(|n| fs::write(renders.join(n), b"x").unwrap());
        assert!(OutputDir::create(dir.path()).is_err(), "another program's");
        fs::write(dir.path().join("report.json"), b"{}").unwrap();
        assert!(OutputDir::create(dir.path()).is_ok());
        fs::write(renders.join("7.png"), b"x").unwrap();
        assert!(OutputDir::create(dir.path()).is_err());
    }

    #[test]
    fn links_in_the_place_of_results_are_replaced_and_what_they_point_to_is_left() {
        use std::os::unix::fs::symlink;
        let (dir, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let victim = other.path().join("victim");
        fs::write(&victim, b"precious").unwrap();
        for name in ["a.txt", ".a.txt.partial", ".writable.partial"] {
            symlink(&victim, dir.path().join(name)).unwrap();
        }
        symlink(other.path(), dir.path().join(".renders.partial")).unwrap();
        let out = OutputDir::create(dir.path()).unwrap();
        out.write("a.txt", |w| w.write_all(b"new")).unwrap();
        out.replace_folder("renders", |d| atomically(&d.join("1.png"), |w| w.write_all(b"x"))).unwrap();
        assert_eq!(fs::read(&victim).unwrap(), b"precious");
        assert_eq!(fs::read(dir.path().join("a.txt")).unwrap(), b"new");
        assert_eq!(
            (names(dir.path()), names(other.path())),
            (vec!["a.txt".into(), "renders".into()], vec!["victim".into()])
        );
        assert!(!fs::symlink_metadata(dir.path().join("a.txt")).unwrap().is_symlink());
    }

    /// `renders` of a user, a file that a user added to ours, and a link to a folder of ours: none is touched.
    #[test]
    fn a_folder_that_holds_files_of_others_is_refused_before_any_work_and_left_as_it_is() {
        let dir = tempfile::tempdir().unwrap();
        let renders = dir.path().join("renders");
        let fill = |d: &Path| atomically(&d.join("1.png"), |w| w.write_all(b"new"));
        let out = OutputDir::create(dir.path()).unwrap();
        let refused = |word: &str| {
            let faults = [
                OutputDir::create(dir.path()).map(drop).unwrap_err(),
                out.replace_folder("renders", fill).unwrap_err(),
                out.remove("renders").unwrap_err(),
            ];
            assert!(faults.iter().all(|f| f.kind == FaultKind::NoOutput && f.what.contains(word)), "{faults:?}");
            assert_eq!(names(dir.path()).len(), 1, "nothing half written is left: {:?}", names(dir.path()));
        };
        fs::create_dir(&renders).unwrap();
        fs::write(renders.join("1.png"), b"a user's").unwrap();
        refused("holds 1.png");
        assert_eq!(fs::read(renders.join("1.png")).unwrap(), b"a user's");
        fs::remove_file(renders.join("1.png")).unwrap();
        out.replace_folder("renders", fill).unwrap();
        fs::write(renders.join("notes.txt"), b"a user's").unwrap();
        refused("holds notes.txt");
        assert_eq!(names(&renders), [LIST, "1.png", "notes.txt"]);
        fs::remove_file(renders.join("notes.txt")).unwrap();
        let kept = tempfile::tempdir().unwrap();
        fs::rename(&renders, kept.path().join("r")).unwrap();
        std::os::unix::fs::symlink(kept.path().join("r"), &renders).unwrap();
        refused("not a folder of this program's");
        assert_eq!(names(&kept.path().join("r")), [LIST, "1.png"]);
    }
}
