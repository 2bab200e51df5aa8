//! The computer: Vulkan, memory, disk.

use crate::commands::checks::Check;
use crate::config::Board;
use crate::gpu::capability::SAMPLED_BUFFER;
use crate::gpu::kernels::ALL;
use crate::gpu::{DeviceKind, Gpu, Reflected};
use crate::run::memory::{self, mib};
use std::path::Path;
use stipple_drivers::{host, Calibration};

/// Less than this is left for a run's own files, and for a minute of recording, bytes.
const DISK_FAIL: u64 = 64 << 20;
const DISK_WARN: u64 = 2 << 30;

/// The device the map would take, and what it can run.
pub fn vulkan(board: &Board) -> Vec<Check> {
    if !board.map.enabled {
        return vec![Check::ok("Vulkan: not needed, map.enabled = false")];
    }
    let gpu = match Gpu::open(&board.gpu, 1 << 20) {
        Ok(gpu) => gpu,
        Err(fault) => return vec![Check::fail(format!("Vulkan: {}", fault.what), fault.fix)],
    };
    let c = gpu.caps();
    let what = format!(
        "Vulkan: {} ({:?}), {} invocations, {} KiB shared, buffers of {:.0} MiB",
        c.name,
        c.kind,
        c.invocations_max,
        c.shared_max_bytes >> 10,
        mib(c.binding_max_bytes)
    );
    let mut checks = vec![match c.kind {
        DeviceKind::Cpu => {
            Check::warn(what, "the map is trained on the CPU: install the GPU's Vulkan driver if it has one")
        }
        _ => Check::ok(what),
    }];
    let runs = |baseline: bool| {
        // Variants for CPU devices are none that a GPU lacks.
        let is_meant = |k: &&Reflected| c.kind == DeviceKind::Cpu || !k.capabilities.contains(&SAMPLED_BUFFER);
        let of = ALL.iter().filter(|k| k.baseline == baseline).filter(is_meant);
        let able = of.clone().filter(|k| k.capabilities.iter().all(|capability| c.allows(*capability)));
        (able.count(), of.count())
    };
    let ((kernels, all), (faster, variants)) = (runs(true), runs(false));
    let what = format!(
        "kernels: {kernels} of {all}, {faster} of {variants} faster variants, subgroups of {}",
        c.subgroup_size
    );
    checks.push(match () {
        _ if kernels < all => Check::fail(what, "update the Vulkan driver: it lacks what Vulkan 1.1 promises"),
        _ if faster == 0 && board.gpu.subgroups => {
            Check::warn(what, "nothing to do: the map is the same, and somewhat slower")
        }
        _ => Check::ok(what),
    });
    checks
}

/// The byte table against the board's limit and against what is free.
pub fn memory_ceiling(calibration: Option<&Calibration>, board: &Board) -> Check {
    let largest = memory::largest_rig(board);
    let rig = calibration.unwrap_or(&largest);
    let table = match memory::check_fits("this rig", rig, board, true) {
        Ok(table) => table,
        Err(fault) => return Check::fail(format!("memory: {}", fault.what), fault.fix),
    };
    let free = host::memory_available();
    let what = format!(
        "memory: {:.0} MiB of memory_max_mib = {}, {} free",
        mib(table.total()),
        board.memory_max_mib,
        free.map_or("unknown".into(), |b| format!("{:.0} MiB", mib(b)))
    );
    match free {
        Some(free) if free < table.total() => Check::fail(what, "free memory, or shrink [budget]"),
        _ => Check::ok(what),
    }
}

pub fn disk(at: &Path) -> Check {
    // The nearest folder that exists.
    let there = at.ancestors().find(|p| p.exists()).unwrap_or(Path::new("."));
    let there = if there.as_os_str().is_empty() { Path::new(".") } else { there };
    let Some(free) = host::disk_free(there) else {
        return Check::warn(format!("disk: {} cannot be asked", there.display()), "check that the folder exists");
    };
    let what = format!("disk: {:.1} GiB free at {}", free as f64 / f64::from(1 << 30), there.display());
    match free {
        f if f < DISK_FAIL => Check::fail(what, "free the disk"),
        f if f < DISK_WARN => Check::warn(what, "recording two 752x480 cameras takes about 0.5 GiB a minute"),
        _ => Check::ok(what),
    }
}
