//! The rows of the stability table as text, csv, json and a page.

use super::Row;
use crate::odometry::page;
use serde_json::{json, Value};
use std::fmt::Write as _;
use std::io::{self, Write};

const MM: f64 = 1e3;

fn reasons(row: &Row) -> String {
    let s = &row.stats;
    let by = [
        ("frame gap", s.resets_frame_gap),
        ("disagreement", s.resets_disagreement),
        ("unseen", s.resets_unseen),
        ("state", s.resets_state),
    ];
    by.iter().filter(|(_, n)| *n > 0).map(|(why, n)| format!("{n} {why}")).collect::<Vec<_>>().join(", ")
}

fn bits(row: &Row) -> String {
    row.health.reasons().collect::<Vec<_>>().join(" ")
}

fn or_dash(v: Option<f64>, scale: f64, decimals: usize) -> String {
    v.map_or("-".into(), |v| format!("{:.decimals$}", v * scale))
}

pub fn text(rows: &[Row]) -> String {
    let mut text = format!(
        "{:36} {:9} {:>9} {:>9} {:>9} {:>8} {:>5}  said\n",
        "", "verdict", "before mm", "after mm", "jump mm", "quality", "least"
    );
    for r in rows {
        let _ = writeln!(
            text,
            "{:36} {:9} {:>9} {:>9} {:>9} {:>8} {:>5}  {}",
            r.name,
            r.verdict.name(),
            or_dash(r.before, MM, 1),
            or_dash(r.after, MM, 1),
            or_dash(r.jump, MM, 1),
            r.quality,
            r.quality_lowest,
            bits(r)
        );
    }
    text.trim_end().to_string()
}

/// A field is empty where nothing was measured.
pub fn csv(out: &mut impl Write, rows: &[Row]) -> io::Result<()> {
    let counters: Vec<&str> = rows.first().map_or(vec![], |r| r.stats.counters().iter().map(|c| c.0).collect());
    writeln!(
        out,
        "case,verdict,expected,ate_before_m,ate_after_m,jump_m,restart_sigmas,quality,quality_lowest,health,{}",
        counters.join(",")
    )?;
    for r in rows {
        let m = |v: Option<f64>| v.map_or(String::new(), |v| format!("{v:.6}"));
        let name = r.name.replace(',', ";");
        write!(out, "{name},{},{},", r.verdict.name(), r.expect.name())?;
        write!(out, "{},{},{},{},", m(r.before), m(r.after), m(r.jump), m(r.restart_sigmas))?;
        write!(out, "{},{},{}", r.quality, r.quality_lowest, bits(r))?;
        r.stats.counters().iter().try_for_each(|(_, n)| write!(out, ",{n}"))?;
        writeln!(out)?;
    }
    Ok(())
}

pub fn json(out: &mut impl Write, rows: &[Row]) -> io::Result<()> {
    let row = |r: &Row| {
        let counters: serde_json::Map<String, Value> =
            r.stats.counters().iter().map(|(name, n)| (name.to_string(), json!(n))).collect();
        json!({
            "case": r.name, "verdict": r.verdict.name(), "expected": r.expect.name(),
            "as_expected": r.complaint().is_none(),
            "ate_before_m": r.before, "ate_after_m": r.after, "jump_m": r.jump, "restart_sigmas": r.restart_sigmas,
            "quality": r.quality, "quality_lowest": r.quality_lowest,
            "health": r.health.reasons().collect::<Vec<_>>(), "counters": counters,
        })
    };
    serde_json::to_writer_pretty(&mut *out, &json!({ "rows": rows.iter().map(row).collect::<Vec<_>>() }))?;
    writeln!(out)
}

pub fn html(out: &mut impl Write, rows: &[Row], seeds: usize) -> io::Result<()> {
    let what = format!("{} cases; made-up tracks are the worst of {seeds} seeded flights each", rows.len());
    page::head(out, "Odometry: stability", &what)?;
    write!(out, "<p class=\"note\">Errors are of the part of the flight before and of the part after the fault, each aligned on its own (ATE, mm), and of the motion across it. Survived: within the stated bounds, without a reset. Detected: wrong, and health or quality say so. A restart's sigmas: distance of its position from the truth in its own covariance (3 dimensions).</p>")?;
    let head = [
        "case",
        "verdict",
        "before, mm",
        "after, mm",
        "jump, mm",
        "resets",
        "restart, \u{3c3}",
        "quality",
        "lowest",
        "said",
    ];
    let cells = |r: &Row| {
        let cells = vec![
            r.name.to_string(),
            r.verdict.name().to_string(),
            or_dash(r.before, MM, 1),
            or_dash(r.after, MM, 1),
            or_dash(r.jump, MM, 1),
            reasons(r),
            or_dash(r.restart_sigmas, 1.0, 1),
            r.quality.to_string(),
            r.quality_lowest.to_string(),
            bits(r).replace('_', " "),
        ];
        (r.complaint().is_some(), cells)
    };
    let rows: Vec<_> = rows.iter().map(cells).collect();
    out.write_all(page::table("Cases", &head, &rows).as_bytes())?;
    page::foot(out)
}
