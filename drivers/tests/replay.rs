//! The reader of recordings on small generated folders with every fault it must survive.
#![allow(clippy::unwrap_used)]

mod folder;

use folder::{grey, Folder, CAMERA, FRAME, IMU, PAIRS, T0};
use std::fs;
use std::path::Path;
use stipple_drivers::replay::*;
use stipple_drivers::source::Aid;
use stipple_drivers::{FaultKind, Frames, Lens, Nanos, Span};

#[test]
fn generated_folder_is_clean() {
    let f = Folder::new();
    let r = f.open().unwrap();
    assert_eq!((r.frames.len(), r.imu.len(), r.truth.len(), r.warnings.len()), (PAIRS, 80, 2, 0));
    assert_eq!((r.imu[1].gyro_body.z, r.imu[1].accel_body.z), (0.2, 9.81));
    assert_eq!((r.truth[1].pose.q.x, r.truth[1].pose.p.x), (1.0, 2.0));
    let mut frames = Frames::for_rig(&r.calibration);
    r.reader().read(5, &mut frames).unwrap();
    assert_eq!((frames.t, &frames.images[1].pixels), (Nanos(T0 + 5 * FRAME), &grey()));
}

#[test]
fn carriage_returns_spaces_and_plain_headlines_are_read() {
    let f = Folder::new();
    for name in ["cam0/data.csv", "cam1/data.csv", "imu0/data.csv", "state_groundtruth_estimate0/data.csv"] {
        let text = fs::read_to_string(f.path(name)).unwrap();
        f.write(name, text.trim_start_matches('#').replace(',', " , ").replace('\n', "\r\n\r\n"));
    }
    let r = f.open().unwrap();
    assert_eq!((r.frames.len(), r.imu.len(), r.truth.len(), r.warnings.len()), (PAIRS, 80, 2, 0));
    r.reader().read(0, &mut Frames::for_rig(&r.calibration)).unwrap();
}

#[test]
fn image_without_partner_is_dropped_and_counted() {
    let f = Folder::new();
    f.edit("cam1/data.csv", 4, |_| String::new());
    let (r, counted) = f.one_fault();
    assert_eq!((r.frames.len(), counted), (PAIRS - 1, ("images_unpaired", 1)));
    assert!(r.warnings[0].contains("cam0/data.csv:4: "), "{:?}", r.warnings);
}

#[test]
fn pressures_are_read_where_there_are_and_a_bad_row_costs_itself() {
    let f = Folder::new();
    assert!(f.open().unwrap().aids.is_empty());
    let rows = [(0, "98000.5"), (20, "nan"), (40, "loud"), (60, "98001"), (50, "98002"), (80, "98003")];
    let rows = rows.map(|(ms, pa)| format!("{},{pa}\n", T0 + ms * 1_000_000)).concat();
    f.write("baro0/data.csv", format!("#timestamp [ns],pressure [Pa]\n{rows}"));
    let r = f.open().unwrap();
    let read: Vec<_> = r.aids.iter().map(|a| ((a.t.0 - T0) / 1_000_000, a.value)).collect();
    assert_eq!(read.len(), 3, "{read:?}");
    assert_eq!((read[0], read[2]), ((0, Aid::Pressure(98000.5)), (80, Aid::Pressure(98003.0))));
    let c = &r.counters;
    assert_eq!((c.pressures_not_finite, c.rows_malformed, c.stamps_out_of_order), (1, 1, 1));
    f.write("baro0/data.csv", "this is, no table\nof, it\n");
    assert!(f.open().unwrap_err().to_string().contains("baro0/data.csv"));
}

#[test]
fn pair_tolerance_is_kept() {
    for (shift, pairs, unpaired) in [(2_000_000, PAIRS, 0), (-2_000_000, PAIRS, 0), (2_000_001, PAIRS - 1, 2)] {
        let f = Folder::new();
        f.edit("cam1/data.csv", 3, |_| format!("{},{}.png", T0 + FRAME + shift, T0 + FRAME));
        let r = f.open().unwrap();
        assert_eq!((r.frames.len(), r.counters.images_unpaired), (pairs, unpaired), "{shift}");
        assert!(r.frames.iter().all(|p| (p.t.0 - T0) % FRAME == 0), "the stamp is camera 0's");
    }
}

#[test]
fn closest_of_two_candidates_is_paired() {
    let f = Folder::new();
    f.edit("cam1/data.csv", 3, |l| format!("{},early.png\n{l}", T0 + FRAME - 1_500_000));
    let (r, counted) = f.one_fault();
    assert_eq!((r.frames.len(), counted), (PAIRS, ("images_unpaired", 1)));
    assert!(r.warnings[0].contains("cam1/data.csv:3: "), "{:?}", r.warnings);
}

#[test]
fn cameras_that_never_meet_are_refused() {
    let f = Folder::new();
    f.write("cam1/data.csv", "1,a.png\n2,b.png\n");
    let fault = f.refused(FaultKind::Data, "mav0", "no image has a partner");
    assert!(fault.fix.contains("camera.pair_tolerance_s"), "{fault}");
}

/// Rows of a camera that has these of a hundred images at 20 Hz.
fn rows(has: fn(i64) -> bool) -> String {
    (0..100).filter(|i| has(*i)).map(|i| format!("{0},{0}.png\n", T0 + i * FRAME)).collect()
}

/// Images of the other camera were dropped as unpaired where a list began late or had a hole, and the recording was refused
/// where it was empty.
#[test]
fn while_a_camera_is_away_the_others_go_on() {
    type Case = (fn(i64) -> bool, [u64; 3], &'static str);
    // Images that one of two cameras has of a hundred at 20 Hz; counts of absent and unpaired ones, and of times away.
    let cases: [Case; 6] = [
        (|i| !(30..60).contains(&i), [30, 0, 1], "gave no image for 1."),
        (|i| i >= 30, [30, 0, 1], "began 1.5 s after the others"),
        (|i| i < 70, [30, 0, 1], "ended 1.5 s before the others"),
        (|_| false, [100, 0, 1], "has no images"),
        (|i| (20..40).contains(&i), [80, 0, 2], "ended 3.0 s before the others"),
        (|i| !(30..36).contains(&i), [0, 6, 0], "has no partner"),
    ];
    for (has, [absent, unpaired, away], words) in cases {
        for k in 0..2 {
            let f = Folder::new();
            f.write(&format!("cam{k}/data.csv"), rows(has));
            f.write(&format!("cam{}/data.csv", 1 - k), rows(|_| true));
            let r = f.open().unwrap();
            let c = &r.counters;
            assert_eq!([c.images_absent, c.images_unpaired, c.cameras_away], [absent, unpaired, away], "{words}");
            assert_eq!(r.frames.len() as u64, 100 - unpaired, "{words}");
            let black = r.frames.iter().filter(|f| f.images[k].is_none() && f.images[1 - k].is_some()).count();
            assert_eq!(black as u64, absent, "{words}");
            assert!(r.frames.windows(2).all(|w| w[0].t < w[1].t));
            assert!(r.warnings.iter().any(|w| w.contains(words)), "{words}: {:?}", r.warnings);
        }
    }
}

/// A frame of its own would make the recording last until then, and the one image that is missing beside it no pause.
#[test]
fn an_image_far_from_all_others_is_dropped_though_the_other_camera_is_away() {
    for (line, stamp, lost) in [(2, 17, 2), (PAIRS + 1, i64::MAX, PAIRS + 1)] {
        let f = Folder::new();
        f.edit("cam0/data.csv", line, |l| format!("{stamp},{}", l.split_once(',').unwrap().1));
        let r = f.open().unwrap();
        let c = &r.counters;
        assert_eq!((r.frames.len(), c.images_absent, c.images_unpaired), (PAIRS - 1, 0, 2), "{stamp}");
        let dropped = format!("cam0/data.csv:{line}: image {stamp} is more than 0.5 s from its camera's others");
        assert!(r.warnings[0].contains(&dropped), "{:?}", r.warnings);
        assert!(r.warnings[1].contains(&format!("cam1/data.csv:{lost}: ")), "{:?}", r.warnings);
    }
    // What is said of a camera that is away is not measured from there.
    type Case = (fn(i64) -> bool, &'static str);
    let cases: [Case; 2] = [
        (|i| i >= 30, "camera 0 began 1.5 s after the others"),
        (|i| i < 70, "camera 0 ended 1.5 s before the others"),
    ];
    for (has, words) in cases {
        let f = Folder::new();
        f.write("cam0/data.csv", format!("17,a.png\n{}{},b.png\n", rows(has), i64::MAX));
        f.write("cam1/data.csv", rows(|_| true));
        let r = f.open().unwrap();
        let c = &r.counters;
        assert_eq!([c.images_absent, c.images_unpaired, c.cameras_away, r.frames.len() as u64], [30, 2, 1, 100]);
        assert!(r.warnings.iter().any(|w| w.contains(words)), "{words}: {:?}", r.warnings);
    }
}

/// Live it is so: a slow camera is not away between its images.
#[test]
fn a_camera_is_away_by_its_own_period() {
    let f = Folder::new();
    f.write("cam0/data.csv", rows(|_| true));
    f.write("cam1/data.csv", rows(|i| i % 20 == 0));
    let r = f.open().unwrap();
    assert_eq!((r.frames.len(), r.counters.images_unpaired, r.counters.images_absent), (5, 95, 0));
}

#[test]
fn duplicated_stamp_is_dropped_and_counted() {
    let f = Folder::new();
    f.edit("imu0/data.csv", 10, |l| format!("{l}\n{l}"));
    let (r, counted) = f.one_fault();
    assert_eq!((r.imu.len(), counted), (80, ("stamps_duplicated", 1)));
    assert!(r.warnings[0].contains("imu0/data.csv:11: "), "{:?}", r.warnings);
}

#[test]
fn corrupt_stamp_costs_its_row_only() {
    for stamp in ["9000000000000", "17"] {
        let f = Folder::new();
        f.edit("imu0/data.csv", 10, |l| format!("{stamp},{}", l.split_once(',').unwrap().1));
        let (r, counted) = f.one_fault();
        assert_eq!((r.imu.len(), counted), (79, ("stamps_out_of_order", 1)));
        assert!(r.warnings[0].contains("imu0/data.csv:10: "), "{:?}", r.warnings);
    }
}

#[test]
fn malformed_row_is_dropped_and_counted() {
    for row in
        ["1000000,x,0,0,0,0,0", "1000000,0,0", "1000000,0,0,0,0,0,0,0", "abc", "1.5,0,0,0,0,0,0", "\u{0}\u{fffd}"]
    {
        let f = Folder::new();
        f.edit("imu0/data.csv", 20, |_| row.to_string());
        let (r, counted) = f.one_fault();
        assert_eq!((r.imu.len(), counted), (79, ("rows_malformed", 1)), "{row}");
        assert!(r.warnings[0].contains("imu0/data.csv:20: "), "{:?}", r.warnings);
    }
}

#[test]
fn sample_that_is_not_finite_is_dropped_and_counted() {
    let f = Folder::new();
    f.edit("imu0/data.csv", 20, |l| l.replace("9.81", "NaN"));
    f.edit("imu0/data.csv", 30, |l| l.replace("0.1", "inf"));
    let (r, counted) = f.one_fault();
    assert_eq!((r.imu.len(), counted), (78, ("imu_not_finite", 2)));
    assert!(r.warnings[0].contains("imu0/data.csv:20: "), "{:?}", r.warnings);
}

#[test]
fn hole_in_the_inertial_stream_is_counted() {
    let f = Folder::new();
    (20..24).for_each(|i| f.edit("imu0/data.csv", i, |_| String::new()));
    let (r, counted) = f.one_fault();
    assert_eq!(counted, ("imu_holes", 1));
    assert!(r.warnings[0].contains("imu0/data.csv:24: hole of 0.0250 s"), "{:?}", r.warnings);
}

#[test]
fn images_outside_the_inertial_stream_are_counted_and_kept() {
    let f = Folder::new();
    let text = fs::read_to_string(f.path("imu0/data.csv")).unwrap();
    f.write("imu0/data.csv", text.lines().take(40).collect::<Vec<_>>().join("\n"));
    let (r, counted) = f.one_fault();
    assert_eq!((r.frames.len(), counted), (PAIRS, ("images_outside_imu", 3)));
    assert!(r.warnings[0].contains("cam0/data.csv:5: "), "{:?}", r.warnings);
}

#[test]
fn warnings_of_one_kind_are_capped_and_counting_goes_on() {
    let f = Folder::new();
    (10..60).for_each(|i| f.edit("imu0/data.csv", i, |_| "letters".to_string()));
    let r = f.open().unwrap();
    assert_eq!(r.counters.rows_malformed, 50);
    let malformed: Vec<_> = r.warnings.iter().filter(|w| w.contains("letters")).collect();
    assert_eq!(malformed.len(), 20);
    assert!(malformed[19].ends_with("(more of this kind are only counted)"));
}

#[test]
fn useless_folders_are_refused() {
    let o = OpenOptions::default();
    assert_eq!(Recording::open(Path::new("/no/such/folder"), &o).unwrap_err().kind, FaultKind::NoInput);
    let empty = tempfile::tempdir().unwrap();
    assert_eq!(Recording::open(empty.path(), &o).unwrap_err().kind, FaultKind::NoInput);
    for name in ["cam0/data.csv", "cam1/data.csv", "imu0/data.csv", "cam1/sensor.yaml"] {
        let f = Folder::new();
        fs::remove_file(f.path(name)).unwrap();
        f.refused(FaultKind::NoInput, name, "cannot read");
    }
    let f = Folder::new();
    fs::remove_file(f.path("cam0/sensor.yaml")).unwrap();
    f.refused(FaultKind::NoInput, "mav0", "no calibration");
}

#[test]
fn tables_of_another_kind_are_refused() {
    for name in ["cam0/data.csv", "imu0/data.csv", "state_groundtruth_estimate0/data.csv"] {
        for content in ["", "#timestamp\n", "\n\n", "letters,and,more\nletters,and,more\n"] {
            let f = Folder::new();
            f.remove_camera(1);
            f.write(name, content);
            f.refused(FaultKind::Data, name, if content.contains("letters") { "letters" } else { "holds no rows" });
        }
    }
    let f = Folder::new();
    fs::copy(f.path("state_groundtruth_estimate0/data.csv"), f.path("imu0/data.csv")).unwrap();
    f.refused(FaultKind::Data, "imu0/data.csv:2", "gyro x y z");
    let f = Folder::new();
    fs::copy(f.path("imu0/data.csv"), f.path("cam1/data.csv")).unwrap();
    f.refused(FaultKind::Data, "cam1/data.csv:2", "file name");
}

#[test]
fn wrong_calibrations_are_refused_by_key_and_line() {
    let keys = ["T_BS", "resolution", "camera_model", "intrinsics", "distortion_model", "distortion_coefficients"];
    for key in keys {
        let f = Folder::new();
        f.replace("cam1/sensor.yaml", &format!("{key}:"), "other:");
        f.refused(FaultKind::Config, "cam1/sensor.yaml", key);
    }
    for key in IMU.lines().filter_map(|l| l.split_once(':')).map(|(k, _)| k) {
        let f = Folder::new();
        f.replace("imu0/sensor.yaml", key, "other");
        f.refused(FaultKind::Config, "imu0/sensor.yaml", key);
    }
    let cases = [
        ("data: [1.0,", "data: [1.002,", ":6", "orthonormal"),
        ("data: [1.0,", "data: [-1.0,", ":6", "right-handed"),
        ("0.0, 0.0, 0.0, 1.0]", "0.0, 0.0, 0.0]", ":6", "16 numbers, found 15"),
        ("0.0, 0.0, 0.0, 1.0]", "0.0, 0.0, 0.5, 1.0]", ":6", "last row"),
        ("[20.0,", "[-20.0,", "sensor.yaml", "must be positive"),
        ("[20.0,", "[.nan,", ":13", "numbers"),
        ("[20.0,", "[twenty,", ":13", "numbers"),
        ("[32, 24]", "[32, 0]", "sensor.yaml", "resolution"),
        ("[32, 24]", "[32, 999999999]", "sensor.yaml", "resolution"),
        ("radial-tangential", "fov", ":14", "fov"),
        ("camera_model: pinhole", "camera_model: [", "sensor.yaml:", "not YAML"),
        ("0.1,", "0.0,", "mav0", "zero baseline"),
    ];
    for (from, to, place, word) in cases {
        let f = Folder::new();
        f.replace("cam1/sensor.yaml", from, to);
        f.refused(FaultKind::Config, place, word);
    }
}

#[test]
fn missing_noise_falls_back_to_defaults_with_a_warning() {
    let f = Folder::new();
    fs::remove_file(f.path("imu0/sensor.yaml")).unwrap();
    let (r, counted) = f.one_fault();
    assert_eq!(counted, ("calibration_notes", 1));
    assert_eq!(r.calibration.imu.rate_hz, 200.0);
    assert!(r.warnings[0].contains("imu0/sensor.yaml: "), "{:?}", r.warnings);
}

#[test]
fn figures_of_noise_are_a_data_sheets_unless_the_file_says_that_they_were_measured() {
    let f = Folder::new();
    assert!(!f.open().unwrap().calibration.imu.measured);
    for (source, measured) in [("datasheet", false), ("measured", true)] {
        f.write("imu0/sensor.yaml", format!("{IMU}noise_source: {source}\n"));
        let imu = f.open().unwrap().calibration.imu;
        assert_eq!(imu.measured, measured);
        // A recording hands it on.
        f.write("imu0/sensor.yaml", stipple_drivers::euroc::imu_yaml(&imu, "recorded"));
        assert_eq!(f.open().unwrap().calibration.imu, imu);
    }
    f.write("imu0/sensor.yaml", format!("{IMU}noise_source: guessed\n"));
    f.refused(FaultKind::Config, "imu0/sensor.yaml:6", "measured or datasheet");
}

#[test]
fn rounded_rotations_are_made_orthonormal() {
    let f = Folder::new();
    f.replace("cam1/sensor.yaml", "data: [1.0,", "data: [1.0003,");
    let q = f.open().unwrap().calibration.cameras[1].body_from_cam.q;
    assert!(q.is_normalized() && q.w > 1.0 - 1e-9);
}

#[test]
fn rigs_of_one_to_four_cameras_are_read() {
    let f = Folder::new();
    f.remove_camera(1);
    for cameras in 1..=4 {
        if cameras > 1 {
            f.add_camera(cameras - 1, 0.1 * cameras as f64);
        }
        let r = f.open().unwrap();
        let mut frames = Frames::for_rig(&r.calibration);
        r.reader().read(0, &mut frames).unwrap();
        let read = (r.calibration.cameras.len(), frames.images.len(), r.frames.len(), r.warnings.len());
        assert_eq!(read, (cameras, cameras, PAIRS, 0));
    }
}

#[test]
fn a_frame_that_lacks_one_of_four_images_is_left_out_and_counted() {
    let f = Folder::new();
    (2..4).for_each(|k| f.add_camera(k, 0.1 + 0.1 * k as f64));
    f.edit("cam3/data.csv", 4, |_| String::new());
    let (r, counted) = f.one_fault();
    assert_eq!((r.frames.len(), counted), (PAIRS - 1, ("images_unpaired", 3)));
    assert!((0..3).all(|k| r.warnings.iter().any(|w| w.contains(&format!("cam{k}/data.csv:4: ")))), "{:?}", r.warnings);
    assert!(r.frames.iter().all(|f| f.images.len() == 4));
}

#[test]
fn too_many_cameras_and_gaps_among_them_are_refused() {
    let f = Folder::new();
    f.write("cam4/sensor.yaml", CAMERA.replace("BASELINE", "0.5"));
    let fault = f.refused(FaultKind::Data, "mav0", "4 cameras at most");
    assert!(fault.fix.contains("cam4"), "{fault}");
    f.remove_camera(4);
    f.add_camera(3, 0.3);
    f.refused(FaultKind::NoInput, "cam2/sensor.yaml", "cannot read");
    f.add_camera(2, 0.3);
    f.refused(FaultKind::Config, "mav0", "cameras 2 and 3");
    f.replace("cam2/sensor.yaml", "0.3", "0.2");
    f.open().unwrap();
    fs::remove_file(f.path("cam2/data.csv")).unwrap();
    f.refused(FaultKind::NoInput, "cam2/data.csv", "cannot read");
}

#[test]
fn a_calibration_of_another_number_of_cameras_is_refused() {
    let f = Folder::new();
    let with = |calibration: &str| {
        let o = OpenOptions { calibration: Some(f.path(calibration)), ..OpenOptions::default() };
        Recording::open(f.0.path(), &o)
    };
    for (cameras, said) in [(1, "holds 2 cameras, the calibration has 1 camera"), (3, "has 3 cameras")] {
        f.write("../chain.yaml", camchain(cameras));
        let fault = with("../chain.yaml").unwrap_err();
        assert!(fault.kind == FaultKind::Config && fault.what.contains(said), "{fault}");
        assert!(fault.fix.contains("--calibration FILE"), "{fault}");
    }
    f.write("../chain.yaml", camchain(5));
    let fault = with("../chain.yaml").unwrap_err();
    assert!(fault.kind == FaultKind::Config && fault.what.contains("4 cameras at most"), "{fault}");
    f.write("../chain.yaml", camchain(2));
    assert_eq!(with("../chain.yaml").unwrap().calibration.cameras.len(), 2);
}

/// A Kalibr chain of cameras 0.1 m apart; the first says where the unit is, the others step on.
fn camchain(cameras: usize) -> String {
    let camera = |k: usize| {
        let pose = if k == 0 { "T_cam_imu" } else { "T_cn_cnm1" };
        format!(
            "cam{k}:\n  {pose}:\n  - [1.0, 0.0, 0.0, -0.1]\n  - [0.0, 1.0, 0.0, 0.0]\n  - [0.0, 0.0, 1.0, 0.0]\n  \
             - [0.0, 0.0, 0.0, 1.0]\n  camera_model: ds\n  distortion_model: none\n  distortion_coeffs: []\n  \
             intrinsics: [-0.2, 0.57, 20, 20, 15.5, 11.5]\n  resolution: [32, 24]\n  timeshift_cam_imu: 0.001\n"
        )
    };
    (0..cameras).map(camera).collect()
}

#[test]
fn kalibr_chain_is_read_and_may_give_steps_between_cameras() {
    let f = Folder::new();
    fs::remove_file(f.path("cam0/sensor.yaml")).unwrap();
    let chain = camchain(2);
    f.write("../camchain.yaml", &chain);
    let r = f.open().unwrap();
    assert_eq!(r.counters.calibration_notes, 1, "the missing imu_config.yaml");
    let stamps: Vec<i64> = r.frames.iter().map(|p| p.t.0).collect();
    assert_eq!(stamps[..2], [T0 + 1_000_000, T0 + FRAME + 1_000_000], "in the inertial unit's clock");
    let c = &r.calibration.cameras;
    assert!((c[0].body_from_cam.p.x - 0.1).abs() < 1e-12 && (c[1].body_from_cam.p.x - 0.2).abs() < 1e-12);
    assert_eq!(c[1].camera.lens, Lens::DoubleSphere { xi: -0.2, alpha: 0.57 });
    f.write("../camchain.yaml", chain.replace("cam1:", "cam2:"));
    f.refused(FaultKind::Config, "camchain.yaml", "cam1");
    // named from outside, as with replay.calibration
    let o = OpenOptions { calibration: Some(f.path("../camchain.yaml")), ..OpenOptions::default() };
    assert_eq!(Recording::open(f.0.path(), &o).unwrap_err().kind, FaultKind::Config);
}

#[test]
fn a_rolling_shutter_needs_its_readout_time() {
    let f = Folder::new();
    let state = |line: &str| {
        for k in 0..2 {
            let text = CAMERA.replace("BASELINE", &format!("{}", 0.1 * f64::from(k)));
            f.write(&format!("cam{k}/sensor.yaml"), text.replace("rate_hz", &format!("{line}\nrate_hz")));
        }
    };
    state("shutter: rolling");
    let fault = f.refused(FaultKind::Config, "cam0/sensor.yaml:10", "rolling");
    assert!(fault.fix.contains("rig.readout_s"), "{fault}");
    let stated = OpenOptions { readout: Some(Span::from_secs(0.016)), ..OpenOptions::default() };
    let r = Recording::open(f.0.path(), &stated).unwrap();
    assert!(r.calibration.cameras.iter().all(|c| c.readout == Span(16_000_000)));
    assert_eq!(r.frames[0].t.0, T0 + 8_000_000, "the middle row");
    for (line, readout) in [
        ("shutter: global", 0),
        ("readout_time: 0.02", 20_000_000),
        ("line_delay: 0.001", 23_000_000), // of 24 rows, 23 steps
    ] {
        state(line);
        assert!(f.open().unwrap().calibration.cameras.iter().all(|c| c.readout == Span(readout)), "{line}");
    }
    for (line, word) in
        [("shutter: slow", "global or rolling"), ("readout_time: -0.01", "readout"), ("line_delay: 1.0", "readout")]
    {
        state(line);
        f.refused(FaultKind::Config, "cam0/sensor.yaml:10", word);
    }
}

#[test]
fn basalt_axes_and_time_offset_reach_the_samples_and_the_stamps() {
    let f = Folder::new();
    let pose = |x: f64| format!(r#"{{"px":{x},"py":0,"pz":0,"qx":0,"qy":0,"qz":0,"qw":1}}"#);
    let lens = r#"{"camera_type":"pinhole","intrinsics":{"fx":20,"fy":20,"cx":15.5,"cy":11.5}}"#;
    let json = format!(
        r#"{{"value0":{{"T_imu_cam":[{},{}],"intrinsics":[{lens},{lens}],"resolution":[[32,24],[32,24]],
        "calib_accel_bias":[0.1,0.2,0.3,0.01,0.02,0.03,0.04,0.05,0.06],
        "calib_gyro_bias":[0.001,0.002,0.003,0.01,0.02,0.03,0.04,0.05,0.06,0.07,0.08,0.09],
        "imu_update_rate":200,"accel_noise_std":[1,1,1],"gyro_noise_std":[1,1,1],
        "accel_bias_std":[1,1,1],"gyro_bias_std":[1,1,1],"cam_time_offset_ns":-3000000}}}}"#,
        pose(0.0),
        pose(0.1)
    );
    f.write("basalt.json", &json);
    let plain = f.open().unwrap();
    let o = OpenOptions { calibration: Some(f.path("basalt.json")), ..OpenOptions::default() };
    let r = Recording::open(f.0.path(), &o).unwrap();
    assert_eq!(r.frames[0].t.0, T0 - 3_000_000);
    let (a, b) = (plain.imu[0], r.imu[0]);
    let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-12, "{a} {b}");
    let (w, s) = (a.gyro_body, a.accel_body);
    close(b.gyro_body.x, w.x + 0.01 * w.x + 0.04 * w.y + 0.07 * w.z - 0.001);
    close(b.gyro_body.z, w.z + 0.03 * w.x + 0.06 * w.y + 0.09 * w.z - 0.003);
    close(b.accel_body.x, s.x + 0.01 * s.x - 0.1);
    close(b.accel_body.z, s.z + 0.03 * s.x + 0.05 * s.y + 0.06 * s.z - 0.3);
    f.write("basalt.json", json.replace("0.04,0.05,0.06]", "0.04,0.05,-1.0]"));
    let fault = Recording::open(f.0.path(), &o).unwrap_err();
    assert!(fault.kind == FaultKind::Config && fault.what.contains("calib_accel_bias"), "{fault}");
    let axes = r.calibration.imu.correction;
    assert!((axes.undo(&b).gyro_body - w).length() < 1e-12 && (axes.undo(&b).accel_body - s).length() < 1e-12);
}

#[test]
fn trajectory_formats_agree() {
    let f = Folder::new();
    f.write("a.csv", "#t,x,y,z,w,x,y,z,v\r\n1403636584763555584,1,2,3,0.5,-0.5,0.5,0.5,7\r\n");
    f.write("a.txt", "# t x y z qx qy qz qw\n1403636584.763555584  1 2 3 -0.5 0.5 0.5 0.5\n");
    let euroc = read_trajectory(&f.path("a.csv")).unwrap();
    assert_eq!(euroc, read_trajectory(&f.path("a.txt")).unwrap());
    assert_eq!((euroc[0].t.0, euroc[0].pose.q.w), (1403636584763555584, 0.5));
    for (bad, kind, place) in [
        ("1,0,0,0,1,0,0,0\n2,0,0,0,9,0,0,0\n", FaultKind::Data, "a.csv:2"),
        ("1,0,0,0,1,0,0,0\n1,0,0,0,1,0,0,0\n", FaultKind::Data, "a.csv:2"),
        ("1,0,0,0,1,0,0\n", FaultKind::Data, "a.csv:1"),
        ("", FaultKind::Data, "a.csv"),
    ] {
        f.write("a.csv", bad);
        let fault = read_trajectory(&f.path("a.csv")).unwrap_err();
        assert!(fault.kind == kind && fault.place.ends_with(place), "{fault}");
    }
    assert_eq!(read_trajectory(&f.path("none.csv")).unwrap_err().kind, FaultKind::NoInput);
}
