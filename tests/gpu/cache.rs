//! Compiled pipelines on disk: used again, never trusted, never in the way.

use super::small_disk::on_a_small_disk;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};
use stipple::gpu::kernels::{axpy, scan_apply, scan_reduce, summary, tile_ranges};
use stipple::gpu::{cache_folder, Gpu, GpuOptions};
use stipple_drivers::Fault;

fn open() -> Gpu {
    Gpu::open_with(&super::config(), 1 << 16, GpuOptions { validation: true }).unwrap()
}

/// What a start does: bytes taken from the folder, and what became of keeping them.
fn start(gpu: &mut Gpu, folder: &Path) -> (usize, Result<(), Fault>) {
    let taken = gpu.reuse_pipelines(folder);
    gpu.kernel::<axpy::K>(axpy::Spec::default()).unwrap();
    gpu.kernel::<summary::K>(summary::Spec::default()).unwrap();
    gpu.kernel::<tile_ranges::K>(tile_ranges::Spec::default()).unwrap();
    gpu.kernel::<scan_apply::K>(scan_apply::Spec::default()).unwrap();
    gpu.kernel::<scan_reduce::K>(scan_reduce::Spec::default()).unwrap();
    (taken, gpu.keep_pipelines())
}

fn names(folder: &Path) -> Vec<PathBuf> {
    fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect()
}

/// The only file of a folder, after a first start.
fn kept(gpu: &mut Gpu, folder: &Path) -> PathBuf {
    assert_eq!(start(gpu, folder), (0, Ok(())));
    let [file] = &names(folder)[..] else { panic!("{:?}", names(folder)) };
    file.clone()
}

#[test]
fn compiled_pipelines_are_written_once_and_used_again() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("made/by/the/first/start");
    let file = kept(&mut open(), &folder);
    let before = fs::metadata(&file).unwrap();
    for _ in 0..2 {
        let mut gpu = open();
        assert_eq!(start(&mut gpu, &folder), (before.len() as usize - 16, Ok(())));
        assert_eq!(gpu.validation_messages(), Vec::<String>::new());
    }
    let after = fs::metadata(&file).unwrap();
    // A file written anew would be another.
    assert_eq!((after.ino(), after.mtime_nsec()), (before.ino(), before.mtime_nsec()));
}

#[test]
fn a_damaged_cache_is_not_taken_and_is_written_anew() {
    let dir = tempfile::tempdir().unwrap();
    let mut gpu = open();
    let file = kept(&mut gpu, dir.path());
    let whole = fs::read(&file).unwrap();
    let flipped = (0..whole.len()).step_by(5).map(|at| {
        let mut bytes = whole.clone();
        bytes[at] ^= 1;
        bytes
    });
    let longer = [&whole[..], b"x"].concat();
    let damaged = flipped.chain([vec![], whole[..8].to_vec(), whole[..whole.len() - 1].to_vec(), longer]);
    for bytes in damaged {
        fs::write(&file, &bytes).unwrap();
        assert_eq!(start(&mut gpu, dir.path()), (0, Ok(())), "{bytes:?}");
        assert_eq!(start(&mut gpu, dir.path()), (whole.len() - 16, Ok(())), "not written anew: {bytes:?}");
    }
    // One too large is not read: 33 MiB that take no space on the disk.
    fs::File::create(&file).unwrap().set_len(33 << 20).unwrap();
    assert_eq!(start(&mut gpu, dir.path()), (0, Ok(())));
    assert_eq!(fs::read(&file).unwrap(), whole);
}

/// A driver that crashes over what it is given would do so at each start.
#[test]
fn a_start_that_dies_with_a_cache_leaves_none_to_the_next() {
    let dir = tempfile::tempdir().unwrap();
    let file = kept(&mut open(), dir.path());
    let whole = fs::read(&file).unwrap();
    let mut dies = open();
    assert!(dies.reuse_pipelines(dir.path()) > 0 && !file.exists());
    std::mem::forget(dies);
    let mut gpu = open();
    assert_eq!(start(&mut gpu, dir.path()), (0, Ok(())));
    assert_eq!(fs::read(&file).unwrap(), whole, "written anew");
    assert!(start(&mut gpu, dir.path()).0 > 0);
    // One that ends by itself puts it back.
    let mut ends = open();
    assert!(ends.reuse_pipelines(dir.path()) > 0);
    drop(ends);
    assert!(start(&mut gpu, dir.path()).0 > 0);
    assert_eq!(names(dir.path()), [file.as_path()], "something is left over");
}

#[test]
fn a_cache_that_cannot_be_kept_is_a_fault_and_stops_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let mut gpu = open();
    let file = kept(&mut gpu, dir.path());
    // A folder in its place.
    fs::remove_file(&file).unwrap();
    fs::create_dir(&file).unwrap();
    let (taken, why) = start(&mut gpu, dir.path());
    let why = why.unwrap_err().to_string();
    assert!(taken == 0 && why.contains(&file.display().to_string()) && why.contains("CACHE_DIRECTORY"), "{why}");
    assert_eq!(names(dir.path()), [file.as_path()], "something is left over");
    fs::remove_dir(&file).unwrap();
    // A file where the folder should be; a folder that not even root can write to.
    fs::write(&file, "").unwrap();
    for folder in [&file.join("below"), Path::new("/proc/stipple")] {
        let (taken, why) = start(&mut gpu, folder);
        assert!(taken == 0 && why.is_err());
    }
    // A pipe that nobody writes to: not waited for, and replaced.
    fs::remove_file(&file).unwrap();
    assert!(std::process::Command::new("mkfifo").arg(&file).status().unwrap().success());
    assert_eq!(start(&mut gpu, dir.path()), (0, Ok(())));
    assert!(start(&mut gpu, dir.path()).0 > 0);
}

#[test]
fn a_full_disk_keeps_no_part_of_a_cache() {
    on_a_small_disk("64k", "cache::a_full_disk_keeps_no_part_of_a_cache", |disk| {
        let mut gpu = open();
        let folder = disk.join("stipple");
        fs::create_dir(&folder).unwrap();
        assert!(fs::write(disk.join("filling"), vec![1; 1 << 20]).is_err());
        let (taken, why) = start(&mut gpu, &folder);
        assert!(taken == 0 && why.unwrap_err().to_string().contains("No space left"));
        assert!(names(&folder).is_empty());
        fs::remove_file(disk.join("filling")).unwrap();
        kept(&mut gpu, &folder);
    });
}

#[test]
fn what_another_process_writes_is_left_to_it_until_it_is_old() {
    let dir = tempfile::tempdir().unwrap();
    let mut gpu = open();
    let file = kept(&mut gpu, dir.path());
    let partial = file.with_extension("partial");
    fs::remove_file(&file).unwrap();
    fs::write(&partial, "").unwrap();
    assert_eq!(start(&mut gpu, dir.path()), (0, Ok(())));
    assert_eq!(names(dir.path()), [partial.as_path()]);
    for shift in [Duration::from_secs(3600), Duration::ZERO] {
        // An hour ago, and an hour ahead of the clock.
        let now = SystemTime::now() + Duration::from_secs(3600);
        fs::File::create(&partial).unwrap().set_modified(now - 2 * shift).unwrap();
        assert_eq!(start(&mut gpu, dir.path()), (0, Ok(())));
        assert_eq!(names(dir.path()), [file.as_path()]);
        fs::remove_file(&file).unwrap();
    }
}

/// Nor do the processes that tests start: they inherit the environment.
#[test]
fn tests_have_no_cache_of_the_users() {
    assert_eq!(cache_folder(), None, "run by cargo, .cargo/config.toml says so");
}
