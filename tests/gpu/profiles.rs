//! The limits of the GPUs of small boards, applied to the device that is here (`config::Profile`): kernels and boards fit them,
//! and a map is trained within them. How fast those GPUs are cannot be told here.

use std::path::Path;
use std::process::Command;
use std::time::Instant;
use stipple::config::{Board, GpuConfig, Profile, PROFILES};
use stipple::gpu::{capability, kernels, DeviceKind, Gpu, ALIGN};
use stipple::map::{Keyframe, Mapper, Tiling};
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::sim::{write_euroc, Scenario, Sim};
use stipple_drivers::types::pose_at;
use stipple_drivers::{Frames, Span};

/// Board files of each GPU. The Mali has none of its own.
const BOARDS: [(&str, &str); 5] = [
    ("V3D 7.1", "raspberry-pi-5"),
    ("V3D 7.1", "drone-pi5"),
    ("Mali-G610", "x86-igpu"),
    ("Intel Gen12", "x86-igpu"),
    ("Orin", "jetson-orin-nano"),
];

fn board(name: &str, set: &[&str]) -> Board {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("board-configs/{name}.toml"));
    Board::load(&path, &set.iter().map(|s| s.to_string()).collect::<Vec<_>>()).unwrap()
}

fn limited_to(profile: &str) -> GpuConfig {
    GpuConfig { profile: profile.into(), ..GpuConfig::default() }
}

/// Kernels at the default of their constants; opening one checks invocations and shared memory as it is.
#[test]
fn every_kernel_and_the_variants_that_a_gpu_takes_fit_it() {
    for p in &PROFILES {
        assert!(ALIGN.is_multiple_of(p.alignment), "{}", p.name);
        let gpu = Gpu::open(&limited_to(p.name), 1 << 16).unwrap();
        // With subgroups of the GPU's width, which the device here may not have.
        let mut caps = gpu.caps().clone();
        caps.subgroup_operations = p.subgroup_operations;
        let taken: Vec<_> = kernels::ALL.iter().filter(|k| k.capabilities.iter().all(|c| caps.allows(*c))).collect();
        for baseline in kernels::ALL.iter().filter(|k| k.baseline) {
            assert!(taken.iter().any(|k| k.name == baseline.name), "{} does not run {}", p.name, baseline.name);
        }
        assert!(taken.iter().any(|k| !k.baseline), "{} has subgroups", p.name);
        for k in taken {
            let place = format!("{} on {}: {k:?}", k.name, p.name);
            assert!(k.local.iter().product::<u32>() <= p.invocations_max, "{place}");
            assert!(k.local.iter().zip(p.local_max).all(|(n, most)| *n <= most), "{place}");
            assert!(k.shared_bytes <= p.shared_max_bytes, "{place}");
            assert!(k.buffers as u32 <= p.buffers_max && k.push_bytes <= p.push_max_bytes, "{place}");
        }
    }
}

#[test]
fn boards_with_two_grey_cameras_fit_their_gpus_at_the_largest_images() {
    for (name, file) in BOARDS {
        let (p, board) = (Profile::of(name).unwrap().unwrap(), board(file, &[]));
        let mut calibration = Scenario::named("demo").unwrap().calibration;
        for camera in &mut calibration.cameras {
            camera.camera.width = board.budget.image_width_max as usize;
            camera.camera.height = board.budget.image_height_max as usize;
        }
        let footprint = Mapper::footprint(&calibration, &board).unwrap();
        let largest = footprint.rows.iter().filter(|row| row.gpu).map(|row| row.bytes).max().unwrap();
        println!("{file} on {name}: {largest} B in one buffer, {} B in all", footprint.gpu_total());
        assert!(largest > 1 << 20 && largest <= p.binding_max_bytes, "{file} on {name}: {largest} B in one buffer");
        assert!(footprint.gpu_total() <= p.allocation_max_bytes, "{file} on {name}: {} B", footprint.gpu_total());
    }
}

#[test]
fn an_unknown_profile_is_a_fault_that_lists_those_there_are() {
    let fault = Gpu::open(&limited_to("Voodoo"), 1 << 16).map(|_| ()).unwrap_err();
    assert!(fault.what.contains("Voodoo") && PROFILES.iter().all(|p| fault.fix.contains(p.name)), "{fault}");
}

const PROFILE: &str = "STIPPLE_TEST_PROFILE";
/// Subgroups of 16 lanes, the widest that lavapipe has.
const WIDEST_BITS: &str = "512";
const MADE: &str = "mean PSNR of all views, dB: ";

/// A map within the limits of the profile that `PROFILE` names, or without limits where it is empty.
#[test]
#[ignore = "part of the test below, in a process for each profile"]
fn one_map_within_one_profile() {
    let name = std::env::var(PROFILE).unwrap();
    let file = BOARDS.iter().find(|(gpu, _)| *gpu == name).map_or("raspberry-pi-5", |(_, file)| file);
    let alike = ["stereo.method=\"sgm\"", "map.scale=1", "map.half_size_steps=5", "store.enabled=false"];
    let mut board = board(file, &alike);
    board.gpu = limited_to(&name);
    let gpu = Gpu::open(&board.gpu, 1 << 16).unwrap();
    if let (Some(p), DeviceKind::Integrated) = (Profile::of(&name).unwrap(), gpu.caps().kind) {
        let ([least, most], width) = (p.subgroup_sizes, gpu.caps().subgroup_size);
        let has_width = (least..=most).contains(&width);
        assert_eq!(
            gpu.caps().allows(capability::GROUP_SHUFFLE),
            has_width,
            "subgroups of {width} in {least} to {most}"
        );
        // Lavapipe takes the request for a width, where a GPU would pick one.
        assert_eq!(gpu.caps().subgroup_size_required, has_width && least < most);
        let tiling = Tiling::of(gpu.caps());
        assert!(tiling.variant == "subgroup" && tiling.lanes == width.min(32) || !has_width, "{tiling:?}");
    }
    let mut scenario = Scenario::named("demo").unwrap();
    (scenario.image_divisor, scenario.rate_hz) = (4, 2.5);
    // It rests for a second.
    (scenario.begin, scenario.duration) = (Span::from_secs(1.0), Span::from_secs(2.6));
    let dir = tempfile::tempdir().unwrap();
    write_euroc(&mut Sim::new(&scenario).unwrap(), dir.path(), 2, |_, _| {}).unwrap();
    let recording = Recording::open(dir.path(), &OpenOptions::default()).unwrap();
    let mut mapper = Mapper::open(&recording.calibration, &board).unwrap();
    let (mut frames, mut reader) = (Frames::for_rig(&recording.calibration), recording.reader());
    for (i, frame) in recording.frames.iter().enumerate() {
        reader.read(i, &mut frames).unwrap();
        let world_from_body = pose_at(&recording.truth, frame.t, Span(50_000_000)).unwrap();
        let images = frames.images.clone();
        let keyframe = Keyframe { id: i as u64, t: frame.t, world_from_body, images, ..Keyframe::default() };
        mapper.ingest(&keyframe).unwrap();
        for _ in 0..10 {
            mapper.step(Instant::now()).unwrap();
        }
    }
    let psnr = mapper.evaluate().unwrap().psnr_db.unwrap();
    println!("{name} ({}), {} views, {} Gaussians", mapper.device(), recording.frames.len(), mapper.splat_count());
    println!("{MADE}{psnr:.2}");
    assert!(mapper.device().contains(&name) && mapper.splat_count() > 100);
    assert_eq!(mapper.counters().gpu_failures.get(), 0);
    // Five on each view, or one more where it was drawn twice in a row.
    let halved = mapper.counters().steps_at_half_size.get();
    assert!((20..=30).contains(&halved), "{halved} steps at half the size");
}

fn psnr_within(profile: &str) -> f64 {
    let o = Command::new(std::env::current_exe().unwrap())
        .env(PROFILE, profile)
        .env(crate::WIDTH, WIDEST_BITS)
        .env("STIPPLE_VALIDATION", "1")
        .args(["--ignored", "--nocapture", "--exact", "profiles::one_map_within_one_profile"])
        .output()
        .unwrap();
    let said = [o.stdout, o.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
    println!("{said}");
    assert!(o.status.success() && said.contains("1 passed"), "{profile}: {said}");
    assert!(!said.contains("vulkan validation:"), "{profile}: {said}");
    said.lines().find_map(|line| line.strip_prefix(MADE)).unwrap().parse().unwrap()
}

#[test]
fn a_map_trained_within_a_profile_is_as_good_as_without() {
    let without = psnr_within("");
    for p in &PROFILES {
        let within = psnr_within(p.name);
        assert!((within - without).abs() < 1.0, "{}: {within} dB, {without} dB without limits", p.name);
    }
}
