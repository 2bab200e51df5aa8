//! Board files as their users meet them: what is wrong is named with its place, and the boards
//! that ship load.
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;
use stipple::config::{keys, Board, InjectConfig, StereoMethod};
use stipple::publish::event::EVENTS;
use stipple_drivers::baro::BaroOptions;
use stipple_drivers::gpio::Edge;
use stipple_drivers::imu::ImuOptions;
use stipple_drivers::sim::euroc_rig;
use stipple_drivers::{Fault, FaultKind};

const BOARD: &str = r#"name = "test"
memory_max_mib = 256

[budget]
splats = 10000
intersections = 200000
keyframes = 40
image_width_max = 752
image_height_max = 480

[map]
scale = 2
"#;

fn parse(text: &str, overrides: &[&str]) -> Result<Board, Fault> {
    let overrides: Vec<String> = overrides.iter().map(|o| o.to_string()).collect();
    Board::parse("test.toml", text, &overrides)
}

/// The fault must be one line, of that kind, and contain every part.
fn refused(result: Result<Board, Fault>, kind: FaultKind, parts: &[&str]) {
    let fault = result.expect_err("must be refused");
    let line = fault.to_string();
    assert_eq!(fault.kind, kind, "{line}");
    assert!(!line.contains('\n') && !fault.fix.is_empty(), "{line}");
    for part in parts {
        assert!(line.contains(part), "`{part}` is not in `{line}`");
    }
}

#[test]
fn unknown_key_is_named_with_its_line() {
    refused(
        parse(&BOARD.replace("keyframes", "keyframs"), &[]),
        FaultKind::Config,
        &["test.toml:7", "keyframs", "keyframes"],
    );
    refused(parse(&format!("{BOARD}colour = 3\n"), &[]), FaultKind::Config, &["test.toml:13", "colour"]);
    refused(parse(&format!("{BOARD}[maps]\n"), &[]), FaultKind::Config, &["test.toml:13", "maps"]);
}

#[test]
fn missing_key_and_broken_syntax_are_named() {
    refused(parse(&BOARD.replace("splats = 10000\n", ""), &[]), FaultKind::Config, &["test.toml", "missing", "splats"]);
    refused(parse(&BOARD.replace("= 40", "= = 40"), &[]), FaultKind::Config, &["test.toml:7"]);
    refused(parse("", &[]), FaultKind::Config, &["test.toml", "name"]);
}

#[test]
fn value_of_the_wrong_type_is_named_with_its_line() {
    refused(
        parse(&BOARD.replace("= 40", "= \"forty\""), &[]),
        FaultKind::Config,
        &["test.toml:7", "keyframes", "forty"],
    );
    refused(parse(&BOARD.replace("= 40", "= -40"), &[]), FaultKind::Config, &["test.toml:7", "-40"]);
}

#[test]
fn value_out_of_bounds_is_named_with_its_line_and_its_bound() {
    refused(
        parse(&BOARD.replace("= 10000\n", "= 10\n"), &[]),
        FaultKind::Config,
        &["test.toml:5", "budget.splats = 10", "256"],
    );
    refused(
        parse(&BOARD.replace("scale = 2", "scale = 3"), &[]),
        FaultKind::Config,
        &["test.toml:12", "map.scale = 3"],
    );
    let text = format!("{BOARD}[stereo]\ndisparities = 40\n");
    refused(parse(&text, &[]), FaultKind::Config, &["test.toml:14", "stereo.disparities = 40", "a multiple of 16"]);
    let text = format!("{BOARD}[vio]\ngyro_noise_scale = nan\n");
    refused(parse(&text, &[]), FaultKind::Config, &["test.toml:14", "vio.gyro_noise_scale", "positive"]);
}

#[test]
fn values_that_contradict_each_other_are_named() {
    let text = format!("{BOARD}[stereo]\ndepth_min_m = 3.0\ndepth_max_m = 2.0\n");
    refused(parse(&text, &[]), FaultKind::Config, &["test.toml:15", "stereo.depth_max_m", "depth_min_m"]);
    refused(
        parse(BOARD, &["budget.intersections=5000"]),
        FaultKind::Config,
        &["--set budget.intersections=5000", "splats"],
    );
    // The key at fault may be a default that the file does not write.
    let text = format!("{BOARD}[stereo]\ndepth_min_m = 30.0\n");
    refused(parse(&text, &[]), FaultKind::Config, &["test.toml", "default", "depth_max_m"]);
}

#[test]
fn cameras_are_named_by_what_does_not_change() {
    let camera = |more: &str| parse(&format!("{BOARD}[camera]\n{more}\n"), &[]);
    let board = camera(
        "devices = [\"serial:01\", \"bus:usb-1\"]\nformat = \"y10p\"\nstamp = \"frame-end\"\n\
        [camera.controls]\ngain = 16\ntrigger_mode = -1",
    );
    let camera_of = board.unwrap().camera;
    assert_eq!((camera_of.devices.len(), camera_of.controls["trigger_mode"]), (2, -1));
    let wrong = camera("rate_hz = 30\ndevices = [\"path:/dev/video0\"]");
    refused(wrong, FaultKind::Config, &["test.toml:15", "camera.devices", "/dev/video0", "by-path"]);
    refused(camera("devices = [\"0001\"]"), FaultKind::Config, &["test.toml:14", "names no camera"]);
    refused(camera("format = \"rgb\""), FaultKind::Config, &["test.toml:14", "rgb", "yuyv"]);
    let loose = camera("devices = [\"serial:1\", \"serial:2\"]\npair_tolerance_s = 0.03");
    refused(loose, FaultKind::Config, &["test.toml:15", "half a period"]);
    refused(camera("rate_hz = 0"), FaultKind::Config, &["test.toml:14", "0.1 to 1000"]);
    refused(camera("gain = 2"), FaultKind::Config, &["test.toml:14", "gain"]);
}

#[test]
fn overrides_reach_nested_keys_strings_numbers_and_booleans() {
    let set = [
        "name=other",
        "map.scale=4",
        "map.enabled=false",
        "gpu.device=llvmpipe (LLVM",
        "vio.gyro_noise_scale=3",
        "stereo.method=bm",
    ];
    let board = parse(BOARD, &set).unwrap();
    assert_eq!((board.name.as_str(), board.map.scale, board.map.enabled), ("other", 4, false));
    assert_eq!((board.gpu.device.as_str(), board.vio.gyro_noise_scale), ("llvmpipe (LLVM", 3.0));
    assert_eq!(board.stereo.method, StereoMethod::Bm);
    assert_eq!(parse(BOARD, &["rig.calibration=\"a b.yaml\""]).unwrap().rig.calibration, "a b.yaml");
    assert_eq!(parse(BOARD, &["map.scale=4", "map.scale=1"]).unwrap().map.scale, 1, "the last one counts");
}

#[test]
fn overrides_obey_the_rules_of_the_file() {
    refused(parse(BOARD, &["map.scale=4", "map.scales=1"]), FaultKind::Config, &["--set map.scales=1", "scales"]);
    refused(parse(BOARD, &["nothing.here=1"]), FaultKind::Config, &["nothing"]);
    refused(parse(BOARD, &["map.scale=three"]), FaultKind::Config, &["--set map.scale=three", "three"]);
    refused(parse(BOARD, &["budget.splats=1"]), FaultKind::Config, &["--set budget.splats=1", "256"]);
    refused(parse(BOARD, &["map.scale"]), FaultKind::Usage, &["--set map.scale", "'='"]);
    refused(parse(BOARD, &["=1"]), FaultKind::Usage, &["--set =1", "key"]);
    refused(parse(BOARD, &["name.x=1"]), FaultKind::Usage, &["`name` is a value"]);
    refused(parse(BOARD, &["map.scale=1\nname = 2"]), FaultKind::Usage, &["not one value"]);
}

#[test]
fn an_override_cannot_hide_an_error_of_the_file() {
    refused(parse(&format!("{BOARD}scales = 3\n"), &["map.scale=1"]), FaultKind::Config, &["test.toml:13", "scales"]);
}

#[test]
fn an_inertial_unit_is_described_whole_or_refused() {
    let with = |lines: &str| parse(&format!("{BOARD}[imu]\n{lines}"), &[]);
    assert!(parse(BOARD, &[]).unwrap().imu.options().is_none());
    let board = with("chip = \"icm-42688-p\"\ndevice = \"/dev/spidev0.0\"\nrate_hz = 500\n").unwrap();
    let Some(ImuOptions::Register(options)) = board.imu.options() else { panic!("it is driven by its registers") };
    assert_eq!((options.rate_hz, options.wiring.len()), (500.0, 1));
    let board = with("chip = \"bmi088\"\ndevice = \"/dev/i2c-1\"\n").unwrap();
    let Some(ImuOptions::Register(options)) = board.imu.options() else { panic!("it is driven by its registers") };
    let wired: Vec<String> = options.wiring.iter().map(|w| w.to_string()).collect();
    assert_eq!(wired, ["/dev/i2c-1 0x68", "/dev/i2c-1 0x18"]);
    refused(with("chip = \"bno055\"\n"), FaultKind::Config, &["test.toml:14", "bno055", "lsm6dsox"]);
    refused(with("chip = \"mpu-6500\"\n"), FaultKind::Config, &["imu.device", "spidev"]);
    refused(
        with("chip = \"bmi270\"\ndevice = \"a\"\n"),
        FaultKind::Config,
        &["imu.configuration", "bmi270_config_file"],
    );
    refused(with("chip = \"bmi088\"\ndevice = \"/dev/spidev0.0\"\n"), FaultKind::Config, &["imu.accel_device"]);
    refused(with("chip = \"iio\"\n"), FaultKind::Config, &["imu.device"]);
    let line = "[gpio]\ndata_ready = \"tegra-gpio:PQ.05\"\n";
    refused(with(&format!("chip = \"iio\"\ndevice = \"d\"\n{line}")), FaultKind::Config, &["test.toml:17", "kernel"]);
    refused(
        parse(&format!("{BOARD}[gpio]\nled = \"3\"\n"), &[]),
        FaultKind::Config,
        &["test.toml:14", "gpio.led", "CHIP:LINE"],
    );
    refused(with("chip = \"iio\"\nrate_hz = 5\n"), FaultKind::Config, &["test.toml:15", "10 to 4000"]);
    let (name, edge) = parse(&format!("{BOARD}{line}"), &[]).unwrap().gpio.data_ready().unwrap();
    assert_eq!((name.to_string().as_str(), edge), ("tegra-gpio line PQ.05", Edge::Rising));
    let (_, edge) =
        parse(&format!("{BOARD}[gpio]\ndata_ready = \"!tegra-gpio:7\"\n"), &[]).unwrap().gpio.data_ready().unwrap();
    assert_eq!(edge, Edge::Falling);
}

#[test]
fn a_barometer_is_off_unless_it_is_named() {
    let with = |lines: &str| parse(&format!("{BOARD}[baro]\n{lines}"), &[]);
    let board = parse(BOARD, &[]).unwrap();
    assert!(board.baro.options().is_none() && !board.baro.is_named());
    let board = with("chip = \"bmp388\"\ndevice = \"/dev/i2c-1\"\naddress = 0x77\nnoise_m = 0.1\n").unwrap();
    assert_eq!(board.baro.options(), Some(BaroOptions::Bmp388 { adapter: "/dev/i2c-1".into(), address: 0x77 }));
    assert!(board.baro.is_named() && (board.baro.noise_m, board.baro.drift_m, board.baro.air_c) == (0.1, 1.0, 15.0));
    let board = with("chip = \"iio\"\ndevice = \"dps310\"\n").unwrap();
    assert_eq!(board.baro.options(), Some(BaroOptions::Iio { device: "dps310".into() }));
    refused(with("chip = \"bmp085\"\n"), FaultKind::Config, &["test.toml:14", "bmp085", "bmp388"]);
    refused(with("chip = \"iio\"\nnoise_m = 0\n"), FaultKind::Config, &["test.toml:15", "baro.noise_m"]);
}

#[test]
fn missing_file_is_named() {
    refused(Board::load(Path::new("no/such.toml"), &[]), FaultKind::NoInput, &["no/such.toml", "board-configs/"]);
}

#[test]
fn a_mask_that_is_not_within_its_image_is_refused() {
    let masked = |masks: &str| {
        let board = parse(BOARD, &[&format!("rig.masks={masks}")])?;
        let mut calibration = euroc_rig();
        board.rig.mask(&mut calibration).map(|()| calibration)
    };
    let calibration = masked("[[0, 0, 400, 752, 480], [1, 3, 4, 5, 6]]").unwrap();
    let at = |camera: usize, x: f64, y: f64| calibration.cameras[camera].is_masked(x, y);
    assert!(at(0, 0.0, 400.0) && at(0, 751.0, 479.0) && at(1, 3.0, 4.0) && at(1, 4.0, 5.0));
    assert!(!at(0, 0.0, 399.0) && !at(1, 0.0, 400.0) && !at(1, 5.0, 5.0) && !at(1, 2.0, 4.0));
    for (masks, said) in [
        ("[[0, 0, 400, 753, 480]]", "752x480"),
        ("[[0, 0, 0, 752, 481]]", "752x480"),
        ("[[0, 300, 0, 300, 480]]", "no rectangle"),
        ("[[2, 0, 0, 9, 9]]", "cameras are 0 to 1"),
        (&format!("[{}]", ["[1, 0, 0, 9, 9]"; 9].join(", ")), "up to 8"),
        ("[[0, -1, 0, 9, 9]]", "rig.masks"),
        ("[[0, nan, 0, 9, 9]]", "rig.masks"),
        ("[[0, 0.5, 0, 9, 9]]", "rig.masks"),
        ("[[0, 0, 9, 9]]", "rig.masks"),
    ] {
        let fault = masked(masks).expect_err(masks);
        let line = fault.to_string();
        assert!(fault.kind == FaultKind::Config && line.contains(said) && line.contains("rig.masks"), "{line}");
        assert!(!fault.fix.is_empty() && !line.contains('\n'), "{line}");
    }
}

#[test]
fn the_example_with_sensors_is_whole() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("board-configs/drone-pi5.toml");
    let board = Board::load(&file, &[]).unwrap();
    assert_eq!((board.camera.devices.len(), board.camera.controls["gain"]), (2, 16));
    assert!(board.imu.options().is_some() && board.gpio.data_ready().is_some() && board.gpio.led().is_some());
    assert_eq!(parse(&toml::to_string(&board).unwrap(), &[]).unwrap(), board);
}

/// Between these lines of board-configs/README.md stands what `STIPPLE_BLESS=1 cargo test --test config` writes.
const BEGIN: &str = "<!-- keys -->";
const END: &str = "<!-- end of keys -->";

/// The table of every key, by section.
fn keys_page() -> String {
    // Without what this file sets beside the sections that have no defaults.
    let board = BOARD.split("[map]").next().unwrap();
    let board = toml::Table::try_from(parse(board, &[]).unwrap()).unwrap();
    let units = [
        ("_s", "s"),
        ("_us", "µs"),
        ("_ms", "ms"),
        ("_hz", "Hz"),
        ("_px", "px"),
        ("_m", "m"),
        ("_mib", "MiB"),
        ("_g", "g"),
        ("_dps", "°/s"),
        ("_c", "°C"),
        ("image_width_max", "px"),
        ("image_height_max", "px"),
        ("disparities", "px"),
        ("fast_threshold_min", "grey levels"),
    ];
    let (mut page, mut last) = (String::new(), None);
    for key in keys() {
        let (section, name) = key.name.rsplit_once('.').unwrap_or(("", key.name));
        if last != Some(section) {
            let title = if section.is_empty() { "At the top".to_string() } else { format!("`[{section}]`") };
            page += &format!("\n## {title}\n\n| key | unit | default | bounds | meaning, and when to change it |\n|---|---|---|---|---|\n");
            last = Some(section);
        }
        let unit = units.iter().find(|(suffix, _)| name.ends_with(suffix)).map_or("", |(_, unit)| unit);
        let required = section.is_empty() || section == "budget";
        let value = key
            .name
            .split('.')
            .fold(Some(&toml::Value::Table(board.clone())).cloned(), |at, part| at?.get(part).cloned());
        let default = if required { "required".into() } else { format!("`{}`", value.unwrap()) };
        page += &format!("| `{name}` | {unit} | {default} | {} |{} |\n", key.bound, key.doc.replace('|', "\\|"));
    }
    page
}

/// Lists the events, for those who search the journal.
fn events_page() -> String {
    let mut page = String::from("| id | level | MESSAGE_ID | meaning |\n|---|---|---|---|\n");
    for (id, meaning) in EVENTS {
        let level = format!("{:?}", id.severity()).to_lowercase();
        page += &format!("| `{}` | {level} | `{:032x}` | {} |\n", id.name(), id.message_id(), meaning.trim());
    }
    page
}

#[test]
fn the_page_of_events_is_up_to_date() {
    const PAGE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/board-configs/events.md");
    let page = fs::read_to_string(PAGE).unwrap();
    let (before, table) = page.split_once("| id | level").unwrap();
    if std::env::var_os("STIPPLE_BLESS").is_some() {
        fs::write(PAGE, format!("{before}{}", events_page())).unwrap();
        return;
    }
    assert_eq!(
        format!("| id | level{table}"),
        events_page(),
        "STIPPLE_BLESS=1 cargo test --test config writes it anew"
    );
}

#[test]
fn the_page_of_keys_is_up_to_date_and_there_are_few() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("board-configs/README.md");
    let text = std::fs::read_to_string(&file).unwrap();
    let (before, rest) = text.split_once(BEGIN).unwrap();
    let (page, after) = rest.split_once(END).unwrap();
    if std::env::var_os("STIPPLE_BLESS").is_some() {
        std::fs::write(&file, format!("{before}{BEGIN}\n{}\n{END}{after}", keys_page())).unwrap();
        return;
    }
    assert_eq!(page.trim(), keys_page().trim(), "STIPPLE_BLESS=1 cargo test --test config writes it anew");
    assert!(keys().count() <= 86, "{} keys", keys().count());
}

#[test]
fn written_and_read_again_a_board_is_the_same() {
    let board = parse(BOARD, &[]).unwrap();
    assert_eq!(parse(&toml::to_string(&board).unwrap(), &[]).unwrap(), board);
}

#[test]
fn shipped_boards_load_and_are_named_after_their_file() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("board-configs");
    let mut seen: Vec<String> = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|e| e == "toml") {
            let stem = path.file_stem().unwrap().to_str().unwrap().to_string();
            assert_eq!(Board::load(&path, &[]).unwrap().name, stem);
            seen.push(stem);
        }
    }
    seen.sort();
    assert_eq!(seen, ["drone-pi5", "jetson-orin-nano", "lavapipe", "raspberry-pi-5", "x86-igpu"]);
}

#[test]
fn the_calibration_to_begin_with_is_one() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("board-configs/camchain-example.yaml");
    let calibration = stipple_drivers::replay::read_calibration(&file).unwrap();
    let second_from_first = calibration.cameras[1].body_from_cam.inverse() * calibration.cameras[0].body_from_cam;
    assert!((second_from_first.p - glam::DVec3::new(-0.1, 0.0, 0.0)).length() < 1e-12);
}

#[test]
fn board_files_that_are_pipes_devices_or_without_end_are_refused_unread() {
    let dir = tempfile::tempdir().unwrap();
    let (pipe, large) = (dir.path().join("pipe.toml"), dir.path().join("large.toml"));
    assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    std::fs::File::create(&large).unwrap().set_len(1 << 40).unwrap();
    for (path, word) in [(pipe.as_path(), "plain file"), (Path::new("/dev/zero"), "plain file"), (&large, "at most")] {
        let faults = [Board::load(path, &[]).unwrap_err(), InjectConfig::load(path).unwrap_err()];
        assert!(faults.iter().all(|f| f.kind == FaultKind::NoInput && f.what.contains(word)), "{faults:?}");
    }
}
