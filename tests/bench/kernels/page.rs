//! `kernels.csv`, `kernels.json` and `kernels.html`.

use super::{Bench, Case, Cost};
use crate::odometry::page::{foot, head, section, table};
use serde_json::{json, Value};
use std::io::{self, Write};
use stipple::output::chart::{bars, Chart, Series};

fn cases(bench: &Bench) -> impl Iterator<Item = &Case> {
    bench.by_count.iter().chain(&bench.by_size).chain(&bench.single)
}

impl Cost {
    /// Of the roofline, what is reached; none where nothing is counted.
    fn reached(&self) -> Option<f64> {
        (self.roof_ms > 0.0 && self.ms > 0.0).then(|| self.roof_ms / self.ms)
    }
}

pub fn csv(out: &mut impl Write, bench: &Bench) -> io::Result<()> {
    writeln!(out, "case,splats,visible,intersections,pixels,kernel,calls,ms,bytes,flops,roofline_ms,reached")?;
    for case in cases(bench) {
        let n = &case.counts;
        for k in &case.kernels {
            write!(out, "\"{}\",{},{},{},{},", case.name, n.splats, n.visible, n.intersections, n.pixels)?;
            let reached = k.reached().map_or(String::new(), |r| format!("{r:.4}"));
            let (bytes, flops) = (k.bytes, k.flops);
            writeln!(out, "{},{},{:.5},{bytes:.0},{flops:.0},{:.5},{reached}", k.name, k.calls, k.ms, k.roof_ms)?;
        }
    }
    Ok(())
}

pub fn json(out: &mut impl Write, bench: &Bench) -> io::Result<()> {
    let kernel = |k: &Cost| {
        json!({ "name": k.name, "calls": k.calls, "ms": k.ms, "bytes": k.bytes, "flops": k.flops,
                "roofline_ms": k.roof_ms, "reached": k.reached() })
    };
    let case = |c: &Case| {
        json!({
            "name": c.name, "splats": c.counts.splats, "visible": c.counts.visible,
            "intersections": c.counts.intersections, "pixels": c.counts.pixels,
            "device_ms_commands_timed": c.timed_ms, "device_ms": c.device_ms, "wall_ms": c.wall_ms, "host_ms": c.host_ms,
            "steps_per_s": c.steps_per_s(), "gpu_bytes": c.arena_bytes,
            "list_mean": c.list_mean, "list_longest": c.list_longest,
            "kernels": c.kernels.iter().map(kernel).collect::<Vec<Value>>(),
        })
    };
    let document = json!({
        "device": bench.device,
        "raster": { "lanes": bench.tiling.lanes, "column": bench.tiling.column, "variant": bench.tiling.variant },
        "copy_bytes_per_s": bench.peaks.bytes_per_s,
        "fma_flops_per_s": bench.peaks.flops_per_s,
        "cases": cases(bench).map(case).collect::<Vec<Value>>(),
    });
    serde_json::to_writer_pretty(&mut *out, &document)?;
    writeln!(out)
}

pub fn html(out: &mut impl Write, bench: &Bench) -> io::Result<()> {
    let [w, h] = bench.tiling.tile();
    let what = format!("{}; tiles of {w}x{h} pixels, {} lanes each", bench.device, bench.tiling.lanes);
    head(out, "Kernels: cost of a training step", &what)?;
    let (copy, fma) = (bench.peaks.bytes_per_s * 1e-9, bench.peaks.flops_per_s * 1e-9);
    write!(out, "<section><h2>Roofline</h2><p class=\"note\">Measured here: copies at {copy:.0} GB/s, multiply-adds at {fma:.0} GFLOP/s. A kernel's roofline is the longer of its bytes, each buffer once, at the one and its operations at the other; the rasters' operations count every pixel of a tile against every Gaussian listed, though opaque pixels end early. Kernel times hold the wait for the command before.</p></section>")?;
    let sweeps = [(&bench.by_count, "Gaussians"), (&bench.by_size, "pixels")];
    let charts: Vec<_> = sweeps.iter().map(|(cases, x)| growth(cases, x)).collect();
    section(out, "How the cost grows", &charts)?;
    let shares: Vec<_> = cases(bench).map(share).collect();
    section(out, "Where the time goes", &shares)?;
    for case in cases(bench) {
        out.write_all(rows(case).as_bytes())?;
    }
    foot(out)
}

fn growth(cases: &[Case], x: &str) -> Option<String> {
    let along = |c: &Case| if x == "pixels" { c.counts.pixels } else { c.counts.splats };
    let of = |get: &dyn Fn(&Case) -> f64| cases.iter().map(|c| (along(c), get(c))).collect::<Vec<_>>();
    let part = |names: &'static [&'static str]| {
        of(&|c| c.kernels.iter().filter(|k| names.iter().any(|n| k.name.starts_with(n))).map(|k| k.ms).sum())
    };
    let dots = |name, ink, points| Series { name, ink, dots: true, points };
    let series = vec![
        dots("step, wall", 1, of(&|c| c.wall_ms)),
        dots("step, device", 2, of(&|c| c.device_ms)),
        dots("rasters", 3, part(&["raster_"])),
        dots("sort", 4, part(&["radix_", "scan_"])),
    ];
    let title = format!("A training step against {x}");
    Chart { title: &title, x, y: "ms", series, from_zero: true, ..Chart::default() }.svg()
}

fn share(case: &Case) -> Option<String> {
    let total = case.kernels.iter().map(|k| k.ms).sum::<f64>().max(f64::MIN_POSITIVE);
    let row = |k: &Cost| (k.name.to_string(), k.ms, format!("{:.3} ms, {:.0} %", k.ms, 100.0 * k.ms / total));
    bars(&case.name, "ms a step", &case.kernels.iter().map(row).collect::<Vec<_>>())
}

fn rows(case: &Case) -> String {
    let head = ["kernel", "calls", "ms", "MB moved", "MFLOP", "roofline, ms", "reached"];
    let mut rows: Vec<(bool, Vec<String>)> = vec![];
    for k in &case.kernels {
        let cells = vec![
            k.name.to_string(),
            format!("{:.0}", k.calls),
            format!("{:.3}", k.ms),
            format!("{:.2}", k.bytes * 1e-6),
            format!("{:.1}", k.flops * 1e-6),
            format!("{:.4}", k.roof_ms),
            k.reached().map_or("\u{2013}".into(), |r| format!("{:.0} %", 100.0 * r)),
        ];
        rows.push((false, cells));
    }
    let title = format!(
        "{}: {:.3} ms on the device, {:.1} steps/s, {:.1} MiB",
        case.name,
        case.device_ms,
        case.steps_per_s(),
        case.arena_bytes as f64 / f64::from(1 << 20)
    );
    table(&title, &head, &rows)
}
