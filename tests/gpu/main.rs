//! Kernels against their twins, on whatever Vulkan device there is (lavapipe in CI).
#![allow(clippy::unwrap_used)]

mod chroma;
mod exposure;
mod fisheye;
mod held_out;
mod occupancy;
mod pool;
mod raster;
mod sort;
mod speed;
mod splat;
mod stereo;
mod stereo_scenes;
mod stiff;
mod tiles;
mod twins;

use stipple::config::GpuConfig;

const BASELINE: &str = "STIPPLE_TEST_BASELINE";

/// What tests open their device with: without subgroups where the environment says so.
pub fn config() -> GpuConfig {
    GpuConfig { subgroups: std::env::var_os(BASELINE).is_none(), ..GpuConfig::default() }
}

/// Every device is at least the baseline; all that is compared here is compared on it too.
#[test]
fn the_whole_suite_holds_on_the_baseline() {
    if std::env::var_os(BASELINE).is_some() {
        return;
    }
    let o = std::process::Command::new(std::env::current_exe().unwrap())
        .env(BASELINE, "1")
        .args(["--test-threads", "2", "--skip", "validation", "--skip", "noise"])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&o.stdout);
    assert!(o.status.success() && said.contains("test result: ok"), "{said}");
}
