//! `odometry.csv` and `odometry.json`, and the sentence a run ends with.

use super::{knee, Sweep};
use serde_json::{json, Value};
use std::io::{self, Write};

const COLUMNS: &str = "input,setting,ate_m,rte_1s_m,rpe_deg,frontend_ms_p50,frontend_ms_p99,estimator_ms_p50,\
    estimator_ms_p99,cpu_ms_per_frame,fps_one_thread,keyframes,resets,hash";

/// A field is empty where nothing was measured.
pub fn csv(out: &mut impl Write, sweep: &Sweep) -> io::Result<()> {
    writeln!(out, "{COLUMNS}")?;
    for row in &sweep.rows {
        let f = &row.figures;
        let error = |v: Option<f64>| v.map_or(String::new(), |v| format!("{v:.6}"));
        write!(out, "{},{},", sweep.inputs[row.input].name, sweep.settings[row.setting].name)?;
        write!(out, "{},{},{},", error(f.ate_m), error(f.rte_1s_m), error(f.rpe_deg))?;
        write!(out, "{:.4},{:.4},", f.frontend_ms_p50, f.frontend_ms_p99)?;
        write!(out, "{:.4},{:.4},", f.estimator_ms_p50, f.estimator_ms_p99)?;
        write!(out, "{:.4},{:.2},", f.cpu_ms_per_frame, f.fps_one_thread)?;
        writeln!(out, "{},{},{:016x}", f.keyframes, f.resets, f.hash)?;
    }
    Ok(())
}

pub fn json(out: &mut impl Write, sweep: &Sweep) -> io::Result<()> {
    let name = |s: Option<usize>| s.map(|s| sweep.settings[s].name.as_str());
    let inputs: Vec<Value> = (0..sweep.inputs.len())
        .map(|i| {
            let input = &sweep.inputs[i];
            let knee = name(knee(&sweep.points_of(i)));
            json!({ "name": input.name, "about": input.about, "frames": input.frames, "knee": knee })
        })
        .collect();
    let settings: Vec<Value> = (0..sweep.settings.len())
        .map(|s| {
            let overall = sweep.overall(s);
            json!({
                "name": sweep.settings[s].name,
                "set": sweep.settings[s].set,
                "ate_m_geometric_mean": overall.map(|o| o.ate_m),
                "ate_m_worst": overall.map(|o| o.ate_worst_m),
                "cpu_ms_per_frame": overall.map(|o| o.cpu_ms_per_frame),
            })
        })
        .collect();
    let rows: Vec<Value> = sweep
        .rows
        .iter()
        .map(|row| {
            let f = &row.figures;
            json!({
                "input": sweep.inputs[row.input].name,
                "setting": sweep.settings[row.setting].name,
                "default": row.setting == 0,
                "ate_m": f.ate_m,
                "rte_1s_m": f.rte_1s_m,
                "rpe_deg": f.rpe_deg,
                "frontend_ms_p50": f.frontend_ms_p50,
                "frontend_ms_p99": f.frontend_ms_p99,
                "estimator_ms_p50": f.estimator_ms_p50,
                "estimator_ms_p99": f.estimator_ms_p99,
                "cpu_ms_per_frame": f.cpu_ms_per_frame,
                "fps_one_thread": f.fps_one_thread,
                "iterations_per_frame": f.iterations_per_frame,
                "frames_with_pose": f.tracked,
                "keyframes": f.keyframes,
                "resets": f.resets,
                "hash": format!("{:016x}", f.hash),
            })
        })
        .collect();
    let knee = name(knee(&sweep.points()));
    let document = json!({ "knee": knee, "inputs": inputs, "settings": settings, "rows": rows });
    serde_json::to_writer_pretty(&mut *out, &document)?;
    writeln!(out)
}

/// Where the default and the knee are.
pub fn conclusion(sweep: &Sweep) -> String {
    let said = |s: usize| {
        let figures = sweep.overall(s).map(|o| {
            format!(
                "ATE {:.4} m (geometric mean; worst {:.4} m), {:.2} ms of CPU a frame",
                o.ate_m, o.ate_worst_m, o.cpu_ms_per_frame
            )
        });
        figures.unwrap_or("no trajectory on some input".into())
    };
    let default = format!("default: {}", said(0));
    match knee(&sweep.points()) {
        Some(0) => format!("{default}. It is the knee: none that is as good (15 %) is faster (10 %)."),
        Some(s) => format!(
            "{default}. Knee, the fastest within 15 % of the best error: {}: {}.",
            sweep.settings[s].name,
            said(s)
        ),
        None => default,
    }
}
