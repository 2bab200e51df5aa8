//! `map.html`: quality against the cap and without parts of the method, in one file that needs nothing else.

use super::{tables, Row, Sweep, Variant, LINES};
use crate::odometry::page::{foot, head, section, table};
use std::io::{self, Write};
use stipple::output::chart::{escape, Chart, Series};

pub fn write(out: &mut impl Write, sweep: &Sweep) -> io::Result<()> {
    let first = sweep.caps.first().map(|r| &r.report);
    let named = |v: Option<&String>| v.map_or("-".to_string(), |s| escape(s));
    let what = format!(
        "{}, scale {}, {}; {} s of mapping a run, spread evenly over its frames",
        named(first.and_then(|r| r.dataset.as_ref())),
        first.and_then(|r| r.scale).unwrap_or(1),
        named(first.and_then(|r| r.device.as_ref())),
        sweep.seconds
    );
    head(out, "Map: quality at equal time", &what)?;
    write!(out, "<section><h2>Caps</h2><p>{}</p>", escape(&tables::conclusion(sweep)))?;
    write!(out, "<p class=\"note\">Every run has the same seconds of mapping: making anchors, depth and densification count, probes for curves and the evaluation do not. A run with dearer steps takes fewer. Figures repeat as well as the clock does: differences under 0.1 dB say nothing.</p></section>")?;
    let db: [(&str, &str, Get); 2] =
        [("training", "PSNR, dB", |r| r.report.psnr_db), ("held out", "PSNR, dB", |r| r.report.psnr_heldout_db)];
    let ssim: [(&str, &str, Get); 2] =
        [("training", "SSIM", |r| r.report.ssim), ("held out", "SSIM", |r| r.report.ssim_heldout)];
    let mut charts = vec![];
    for line in LINES {
        charts.push(against_cap(&format!("PSNR: {}", line.name), &line, &db, sweep));
        charts.push(against_cap(&format!("SSIM: {}", line.name), &line, &ssim, sweep));
    }
    charts.push(lines("Training PSNR by method", "PSNR, dB", |r| r.report.psnr_db, sweep));
    charts.push(lines("Gaussians used", "Gaussians", |r| r.report.splats.map(|n| n as f64), sweep));
    charts.push(over_time(sweep));
    section(out, "Quality against the cap", &charts)?;
    out.write_all(rows("Caps", &sweep.caps, sweep.seconds, true).as_bytes())?;
    out.write_all(rows("Ablations", &sweep.ablations, sweep.seconds, false).as_bytes())?;
    foot(out)
}

type Get = fn(&Row) -> Option<f64>;

fn of_line<'a>(line: &'a Variant, get: Get, sweep: &'a Sweep) -> Vec<(f64, f64)> {
    let rows = sweep.caps.iter().filter(|r| r.variant.name == line.name);
    rows.filter_map(|r| Some((f64::from(r.cap), get(r)?))).collect()
}

fn against_cap(title: &str, line: &Variant, what: &[(&str, &str, Get)], sweep: &Sweep) -> Option<String> {
    let series = what.iter().zip(1u8..).map(|((name, _, get), ink)| Series {
        name,
        ink,
        dots: true,
        points: of_line(line, *get, sweep),
    });
    Chart { title, x: "cap, Gaussians", y: what[0].1, series: series.collect(), ..Chart::default() }.svg()
}

/// All lines in one drawing; left out where there is but one.
fn lines(title: &str, y: &str, get: Get, sweep: &Sweep) -> Option<String> {
    let series: Vec<Series> = LINES
        .iter()
        .zip(1u8..)
        .map(|(line, ink)| Series { name: line.name, ink, dots: true, points: of_line(line, get, sweep) })
        .collect();
    Chart { title, x: "cap, Gaussians", y, series, ..Chart::default() }.svg()
}

/// The default's error against mapping time at the lowest and the highest cap.
fn over_time(sweep: &Sweep) -> Option<String> {
    let default: Vec<&Row> = sweep.caps.iter().filter(|r| r.variant.name == LINES[0].name).collect();
    let ends = [default.first()?, default.last()?];
    let names = ends.map(|r| format!("cap {}", r.cap));
    let curve = |r: &Row| r.report.curve.iter().filter_map(|c| Some((c.t_s, c.psnr_db?))).collect();
    let series = (0..2).map(|i| Series { name: &names[i], ink: i as u8 + 1, dots: true, points: curve(ends[i]) });
    let title = "Training PSNR of a probe against mapping time";
    Chart { title, x: "mapping, s", y: "PSNR, dB", series: series.collect(), ..Chart::default() }.svg()
}

fn rows(title: &str, rows: &[Row], seconds: f64, with_cap: bool) -> String {
    let head = [
        if with_cap { "method, cap" } else { "method" },
        "what it is",
        "Gaussians",
        "steps",
        "ms a step",
        "PSNR, dB",
        "SSIM",
        "held out, dB",
        "SSIM held out",
        "held out, pose refined, dB",
    ];
    let number = |v: Option<f64>, digits: usize| v.map_or("\u{2013}".into(), |v| format!("{v:.digits$}"));
    let cells = |row: &Row| {
        let r = &row.report;
        let name = if with_cap { format!("{}, {}", row.variant.name, row.cap) } else { row.variant.name.into() };
        vec![
            name,
            row.variant.about.to_string(),
            r.splats.unwrap_or(0).to_string(),
            r.iterations.unwrap_or(0).to_string(),
            number(row.step_ms(seconds), 2),
            number(r.psnr_db, 2),
            number(r.ssim, 3),
            number(r.psnr_heldout_db, 2),
            number(r.ssim_heldout, 3),
            number(r.psnr_heldout_aligned_db, 2),
        ]
    };
    let marked: Vec<_> = rows.iter().map(|r| (r.variant.name == LINES[0].name, cells(r))).collect();
    table(title, &head, &marked)
}
