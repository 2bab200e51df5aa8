//! Recordings from a stranger: their names and links lead to nothing outside their folder, and pipes, devices and files
//! without end are refused without being opened.
#![allow(clippy::unwrap_used)]

mod folder;

use folder::{Folder, FRAME, T0};
use std::fs;
use std::os::unix::fs::{symlink, MetadataExt};
use std::os::unix::net::UnixListener;
use std::path::Path;
use std::process::Command;
use stipple_drivers::replay::{read_calibration, read_trajectory, ImageFault};
use stipple_drivers::{input, FaultKind, Frames};

const TABLES: [&str; 5] =
    ["cam0/data.csv", "cam1/sensor.yaml", "imu0/data.csv", "imu0/sensor.yaml", "state_groundtruth_estimate0/data.csv"];

/// Fails to read the first image, for this reason.
fn first_image(f: &Folder, fault: ImageFault, word: &str) {
    let r = f.open().unwrap();
    let mut reader = r.reader();
    assert_eq!(reader.read(0, &mut Frames::for_rig(&r.calibration)), Err(fault));
    assert!(reader.warnings()[0].contains(word), "{:?}", reader.warnings());
}

fn pipe(path: &Path) {
    assert!(Command::new("mkfifo").arg(path).status().unwrap().success());
}

#[test]
fn a_link_out_of_the_recording_is_refused_and_one_within_it_is_followed() {
    let elsewhere = Folder::new();
    for name in TABLES.iter().chain(&["cam0", "cam1/data", "imu0"]) {
        let f = Folder::new();
        let _ = fs::remove_dir_all(f.path(name)).or_else(|_| fs::remove_file(f.path(name)));
        symlink(elsewhere.path(name), f.path(name)).unwrap();
        f.refused(FaultKind::NoInput, name, "link out of the recording");
    }
    let f = Folder::new();
    let image = f.path(&format!("cam0/data/{T0}.png"));
    fs::remove_file(&image).unwrap();
    symlink(elsewhere.path(&format!("cam0/data/{T0}.png")), &image).unwrap();
    first_image(&f, ImageFault::Missing, "link out of the recording");
    assert!(!f.open().unwrap().reader().has_colour(1));

    let f = Folder::new();
    fs::remove_dir_all(f.path("cam1/data")).unwrap();
    symlink("../cam0/data", f.path("cam1/data")).unwrap();
    fs::remove_file(f.path(&format!("cam0/data/{T0}.png"))).unwrap();
    symlink(format!("{}.png", T0 + FRAME), f.path(&format!("cam0/data/{T0}.png"))).unwrap();
    let r = f.open().unwrap();
    r.reader().read(0, &mut Frames::for_rig(&r.calibration)).unwrap();
}

/// Reading a pipe would wait for ever; that this test ends shows that none is opened.
#[test]
fn pipes_sockets_and_folders_in_place_of_a_file_are_refused() {
    let made: [fn(&Path); 3] =
        [pipe, |path| drop(UnixListener::bind(path).unwrap()), |path| fs::create_dir(path).unwrap()];
    for make in made {
        for name in &TABLES[..3] {
            let f = Folder::new();
            fs::remove_file(f.path(name)).unwrap();
            make(&f.path(name));
            f.refused(FaultKind::NoInput, name, "not a plain file");
        }
        let f = Folder::new();
        let image = f.path(&format!("cam0/data/{T0}.png"));
        fs::remove_file(&image).unwrap();
        make(&image);
        first_image(&f, ImageFault::Missing, "not a plain file");
        let what = read_trajectory(&image).unwrap_err().what;
        assert!(what.contains("not a plain file"), "{what}");
    }
    let what = read_calibration(Path::new("/dev/zero")).unwrap_err().what;
    assert!(what.contains("not a plain file"), "{what}");
}

/// The files have holes in place of a terabyte: a reader that begins to take memory for them ends here.
#[test]
fn tables_and_calibrations_without_end_are_refused_before_memory_is_taken() {
    for name in &TABLES[..4] {
        let f = Folder::new();
        let file = fs::File::options().write(true).open(f.path(name)).unwrap();
        file.set_len(1 << 40).unwrap();
        f.refused(FaultKind::NoInput, name, "1099511627776 bytes or more");
    }
    let f = Folder::new();
    f.replace("cam0/sensor.yaml", "[32, 24]", "[4097, 24]");
    f.refused(FaultKind::Config, "cam0/sensor.yaml", "from 1 to 4096");
}

#[test]
fn files_are_read_up_to_their_limit_and_what_says_no_size_is_too() {
    let dir = tempfile::tempdir().unwrap();
    let (path, mut bytes) = (dir.path().join("f"), vec![7; 100]);
    fs::write(&path, [1, 2, 3]).unwrap();
    input::read(&path, 3, &mut bytes).unwrap();
    assert_eq!(bytes, [1, 2, 3]);
    assert!(input::read(&path, 2, &mut bytes).unwrap_err().to_string().contains("2 at most"));
    // Files of the kernel say 0 bytes, whatever they hold.
    let endless = Path::new("/proc/self/status");
    assert_eq!(fs::metadata(endless).unwrap().size(), 0);
    assert!(input::read(endless, 10, &mut bytes).unwrap_err().to_string().contains("10 at most"));
}

/// A JPEG whose decoder stops half way and says that all is well: found by `make fuzz`.
#[test]
fn no_image_shows_a_part_of_the_image_before_it() {
    let f = Folder::new();
    f.write(&format!("cam0/data/{T0}.png"), include_bytes!("folder/broken_scan.jpg"));
    first_image(&f, ImageFault::Undecodable, "breaks off");
}

/// A palette of 49 bytes made the decoder panic: found by `make fuzz`.
#[test]
fn a_broken_palette_is_an_error_and_no_panic() {
    let f = Folder::new();
    f.write(&format!("cam0/data/{T0}.png"), include_bytes!("folder/broken_palette.png"));
    first_image(&f, ImageFault::Undecodable, "palette is broken");
}
