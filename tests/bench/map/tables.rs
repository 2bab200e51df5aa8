//! `map.csv`, `map.json`, and the sentence a run ends with.

use super::{Row, Sweep, LINES};
use serde_json::{json, Value};
use std::io::{self, Write};

const COLUMNS: &str = "part,variant,cap,splats,anchors,iterations,step_ms,psnr_db,ssim,psnr_heldout_db,ssim_heldout,\
    psnr_heldout_aligned_db,gpu_bytes";

/// A field is empty where nothing was measured.
pub fn csv(out: &mut impl Write, sweep: &Sweep) -> io::Result<()> {
    writeln!(out, "{COLUMNS}")?;
    for (part, row) in parts(sweep) {
        let r = &row.report;
        let number = |v: Option<f64>| v.map_or(String::new(), |v| format!("{v:.4}"));
        let count = |v: Option<u64>| v.map_or(String::new(), |v| v.to_string());
        write!(out, "{part},{},{},{},{},", row.variant.name, row.cap, count(r.splats), count(r.anchors))?;
        write!(out, "{},{},", count(r.iterations), number(row.step_ms(sweep.seconds)))?;
        write!(out, "{},{},", number(r.psnr_db), number(r.ssim))?;
        write!(out, "{},{},", number(r.psnr_heldout_db), number(r.ssim_heldout))?;
        writeln!(out, "{},{}", number(r.psnr_heldout_aligned_db), count(r.gpu_bytes))?;
    }
    Ok(())
}

pub fn json(out: &mut impl Write, sweep: &Sweep) -> io::Result<()> {
    let rows: Vec<Value> = parts(sweep)
        .map(|(part, row)| {
            let r = &row.report;
            json!({
                "part": part,
                "variant": row.variant.name,
                "about": row.variant.about,
                "set": row.variant.set,
                "cap": row.cap,
                "splats": r.splats,
                "anchors": r.anchors,
                "keyframes": r.keyframes,
                "iterations": r.iterations,
                "step_ms": row.step_ms(sweep.seconds),
                "psnr_db": r.psnr_db,
                "ssim": r.ssim,
                "psnr_heldout_db": r.psnr_heldout_db,
                "ssim_heldout": r.ssim_heldout,
                "psnr_heldout_aligned_db": r.psnr_heldout_aligned_db,
                "gpu_bytes": r.gpu_bytes,
                "counts": r.counts,
            })
        })
        .collect();
    let first = sweep.caps.first().map(|r| &r.report);
    let document = json!({
        "dataset": first.and_then(|r| r.dataset.clone()),
        "device": first.and_then(|r| r.device.clone()),
        "scale": first.and_then(|r| r.scale),
        "mapping_s": sweep.seconds,
        "rows": rows,
    });
    serde_json::to_writer_pretty(&mut *out, &document)?;
    writeln!(out)
}

fn parts(sweep: &Sweep) -> impl Iterator<Item = (&'static str, &Row)> {
    sweep.caps.iter().map(|r| ("cap", r)).chain(sweep.ablations.iter().map(|r| ("ablation", r)))
}

/// What raising the cap does to the first line.
pub fn conclusion(sweep: &Sweep) -> String {
    let default: Vec<&Row> = sweep.caps.iter().filter(|r| r.variant.name == LINES[0].name).collect();
    let (Some(low), Some(high)) = (default.first(), default.last()) else { return "nothing was run".into() };
    let change = |get: fn(&Row) -> Option<f64>| match (get(low), get(high)) {
        (Some(a), Some(b)) => format!("{:+.2} dB", b - a),
        _ => "not measured".into(),
    };
    format!(
        "From a cap of {} to {} Gaussians, {} s of mapping each: training PSNR {}, held out {}; {} and {} are used.",
        low.cap,
        high.cap,
        sweep.seconds,
        change(|r| r.report.psnr_db),
        change(|r| r.report.psnr_heldout_db),
        low.report.splats.unwrap_or(0),
        high.report.splats.unwrap_or(0)
    )
}
