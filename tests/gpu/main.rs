//! Kernels against their twins, on whatever Vulkan device there is (lavapipe in CI).
#![allow(clippy::unwrap_used)]

mod cache;
mod chroma;
mod exposure;
mod fisheye;
mod hidden;
mod lists;
mod occupancy;
mod pool;
mod profiles;
mod raster;
mod scan;
#[path = "../program/small_disk.rs"]
mod small_disk;
mod speed;
mod splat;
mod stereo;
mod stereo_scenes;
mod stiff;
mod summary;
mod twins;

use stipple::config::GpuConfig;

const BASELINE: &str = "STIPPLE_TEST_BASELINE";

/// What tests open their device with: without subgroups where the environment says so.
pub fn config() -> GpuConfig {
    GpuConfig { subgroups: std::env::var_os(BASELINE).is_none(), ..GpuConfig::default() }
}

/// Every device is at least the baseline; what has a variant for others is compared on it too. Stereo has none.
#[test]
fn the_map_holds_on_the_baseline() {
    if std::env::var_os(BASELINE).is_some() {
        return;
    }
    let o = std::process::Command::new(std::env::current_exe().unwrap())
        .env(BASELINE, "1")
        .args("--test-threads 2 --skip validation --skip noise --skip stereo --skip profiles".split(' '))
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&o.stdout);
    assert!(o.status.success() && said.contains("test result: ok"), "{said}");
}

const WIDTH: &str = "LP_NATIVE_VECTOR_WIDTH";

/// The control of the next: lavapipe's subgroup has a lane for each 32 bits of the vectors it is told to use.
#[test]
fn subgroups_are_as_wide_as_lavapipe_was_told() {
    let gpu = stipple::gpu::Gpu::open(&config(), 1 << 16).unwrap();
    let told = std::env::var(WIDTH).ok().and_then(|bits| bits.parse::<u32>().ok());
    if let (Some(bits), stipple::gpu::DeviceKind::Cpu) = (told, gpu.caps().kind) {
        assert_eq!(gpu.caps().subgroup_size, bits / 32);
    }
}

/// Too narrow for the subgroup variants, as wide as on most CPUs, and as wide as on V3D and Mali.
#[test]
fn rasters_and_lists_hold_with_subgroups_of_4_8_and_16() {
    for bits in ["128", "256", "512"] {
        let o = std::process::Command::new(std::env::current_exe().unwrap())
            .env(WIDTH, bits)
            .args(["--test-threads", "2", "both_rasters", "lists_of_tiles", "subgroups_are"])
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&o.stdout);
        assert!(o.status.success() && said.contains("test result: ok"), "{bits} bits: {said}");
    }
}
