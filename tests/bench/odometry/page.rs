//! `odometry.html`: error against run time, in one file that needs nothing else.

use super::measure::Figures;
use super::settings::{curves, Curve, DEFAULT};
use super::{knee, tables, Sweep};
use std::fmt::Write as _;
use std::io::{self, Write};
use stipple::output::chart::{escape, Chart, Series};

const STYLE: &str = include_str!("../../../src/output/report.css");
/// On top of the reports' style: settings that are not on the front are points without a line, of
/// which only a first dot stays, for the legend.
const MORE_STYLE: &str = ".line.ink3 { stroke-width: 5.2; stroke-dasharray: 0 9999; } .dot.ink3 { fill: var(--ink3); opacity: .6; } \
    .wide-table { overflow-x: auto; } .wide-table td, .wide-table th { padding-left: 10px; font-size: 13.5px; } \
    .wide-table td { font-weight: 400; } tr.default td, tr.default th { font-weight: 700; } \
    thead th { text-align: right; color: var(--soft); border-top: 0; } .wide-table th:first-child { text-align: left; padding-left: 0; }";
/// Errors of more than this many times the default's are drawn at that height.
const CUT: f64 = 3.0;
const CM: f64 = 100.0;
/// What stands for the mean over inputs.
const ALL: &str = "all inputs";

type Points = [Option<(f64, f64)>];

/// Opens a page of the bench.
pub fn head(out: &mut impl Write, title: &str, what: &str) -> io::Result<()> {
    write!(out, "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">")?;
    write!(out, "<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">")?;
    write!(out, "<title>{title} \u{2013} Stipple</title>")?;
    write!(out, "<style>{STYLE}{MORE_STYLE}</style></head><body><main>")?;
    write!(out, "<header><p class=\"over\">Stipple</p><h1>{title}</h1><p class=\"what\">{what}</p></header>")
}

pub fn foot(out: &mut impl Write) -> io::Result<()> {
    writeln!(out, "</main></body></html>")
}

pub fn write(out: &mut impl Write, sweep: &Sweep) -> io::Result<()> {
    let frames: usize = sweep.inputs.iter().map(|i| i.frames).sum();
    let (inputs, settings) = (sweep.inputs.len(), sweep.settings.len());
    let what = format!(
        "{inputs} inputs, {frames} stereo frames, {settings} settings; frontend and estimator on one thread, no mapper"
    );
    head(out, "Odometry: error against run time", &what)?;
    write!(out, "<section><h2>Knee</h2><p>{}</p>", escape(&tables::conclusion(sweep)))?;
    write!(out, "<p class=\"note\">ATE after rigid alignment. Over all inputs: geometric mean of the errors, mean of the CPU time. Stages are wall time, so their 99th percentile holds what else the machine did. Errors above {CUT} times the default's are drawn at that height. Run times repeat to a few per cent, and the error of one flight moves by tens of per cent between settings that differ in nothing that matters: read the curves over all inputs first.</p></section>")?;
    out.write_all(defaults(sweep).as_bytes())?;
    let points = sweep.points();
    section(out, "All settings, all inputs", &[front(ALL, &points, sweep)])?;
    let charts: Vec<_> = curves(&sweep.settings).iter().map(|c| parameter(c, &points)).collect();
    section(out, "One parameter at a time, all inputs", &charts)?;
    let charts: Vec<_> = (0..inputs).map(|i| front(&sweep.inputs[i].name, &sweep.points_of(i), sweep)).collect();
    section(out, "All settings on each input", &charts)?;
    out.write_all(settings_table(sweep).as_bytes())?;
    foot(out)
}

/// Error against run time of all settings over all inputs, as a drawing that stands alone.
pub fn picture(out: &mut impl Write, sweep: &Sweep) -> io::Result<()> {
    let chart = front(ALL, &sweep.points(), sweep).unwrap_or_default();
    let namespace = "<svg xmlns=\"http://www.w3.org/2000/svg\" ";
    let (open, rest) = chart.split_at(chart.find('>').map_or(0, |i| i + 1));
    write!(out, "{}<style>{STYLE}{MORE_STYLE}</style>", open.replacen("<svg ", namespace, 1))?;
    writeln!(out, "<rect width=\"100%\" height=\"100%\" fill=\"var(--page)\"/>{rest}")
}

pub fn section(out: &mut impl Write, title: &str, charts: &[Option<String>]) -> io::Result<()> {
    write!(out, "<section><h2>{title}</h2><div class=\"charts\">")?;
    for chart in charts.iter().flatten() {
        write!(out, "<figure>{chart}</figure>")?;
    }
    write!(out, "</div></section>")
}

pub fn table(title: &str, head: &[&str], rows: &[(bool, Vec<String>)]) -> String {
    let mut html = format!("<section><h2>{title}</h2><div class=\"wide-table\"><table><thead><tr>");
    for name in head {
        let _ = write!(html, "<th scope=\"col\">{name}</th>");
    }
    html.push_str("</tr></thead>");
    for (marked, cells) in rows {
        html.push_str(if *marked { "<tr class=\"default\">" } else { "<tr>" });
        for (i, cell) in cells.iter().enumerate() {
            let cell = escape(cell);
            let _ =
                if i == 0 { write!(html, "<th scope=\"row\">{cell}</th>") } else { write!(html, "<td>{cell}</td>") };
        }
        html.push_str("</tr>");
    }
    html + "</table></div></section>"
}

fn number(v: Option<f64>, decimals: usize) -> String {
    v.map_or("\u{2013}".into(), |v| format!("{v:.decimals$}"))
}

fn defaults(sweep: &Sweep) -> String {
    let head = [
        "input",
        "frames",
        "ATE, cm",
        "RTE 1 s, cm",
        "RPE, \u{b0}",
        "frontend, ms: median / 99 %",
        "estimator, ms: median / 99 %",
        "iterations a frame",
        "CPU, ms a frame",
        "frames/s",
        "keyframes",
        "resets",
        "knee",
    ];
    let pair = |a: f64, b: f64| format!("{a:.2} / {b:.2}");
    let row = |i: usize| {
        let f: &Figures = sweep.row(i, 0);
        let knee = knee(&sweep.points_of(i)).map_or("\u{2013}".into(), |s| sweep.settings[s].name.clone());
        let cells = vec![
            sweep.inputs[i].name.clone(),
            format!("{} of {}", f.tracked, sweep.inputs[i].frames),
            number(f.ate_m.map(|m| m * CM), 2),
            number(f.rte_1s_m.map(|m| m * CM), 2),
            number(f.rpe_deg, 3),
            pair(f.frontend_ms_p50, f.frontend_ms_p99),
            pair(f.estimator_ms_p50, f.estimator_ms_p99),
            format!("{:.1}", f.iterations_per_frame),
            format!("{:.2}", f.cpu_ms_per_frame),
            format!("{:.1}", f.fps_one_thread),
            f.keyframes.to_string(),
            f.resets.to_string(),
            knee,
        ];
        (false, cells)
    };
    let rows: Vec<_> = (0..sweep.inputs.len()).map(row).collect();
    table("Each input at the default setting", &head, &rows)
        + &format!(
            "<p class=\"note\">{}</p>",
            sweep.inputs.iter().map(|i| escape(&format!("{}: {}.", i.name, i.about))).collect::<Vec<_>>().join(" ")
        )
}

/// Fastest first.
fn settings_table(sweep: &Sweep) -> String {
    let knee = knee(&sweep.points());
    let mut order: Vec<usize> = (0..sweep.settings.len()).collect();
    let time = |s: &usize| sweep.overall(*s).map_or(f64::INFINITY, |o| o.cpu_ms_per_frame);
    order.sort_by(|a, b| time(a).total_cmp(&time(b)));
    let row = |s: usize| {
        let o = sweep.overall(s);
        let mark = match (s == 0, knee == Some(s)) {
            (true, true) => "default and knee",
            (true, false) => DEFAULT,
            (false, true) => "knee",
            (false, false) => "",
        };
        let setting = &sweep.settings[s];
        let cells = vec![
            setting.name.clone(),
            if setting.set.len() > 1 { setting.set.join(" ") } else { String::new() },
            number(o.map(|o| o.ate_m * CM), 3),
            number(o.map(|o| o.ate_worst_m * CM), 3),
            number(o.map(|o| o.cpu_ms_per_frame), 2),
            mark.into(),
        ];
        (s == 0, cells)
    };
    let rows: Vec<_> = order.into_iter().map(row).collect();
    let head = ["setting", "set", "ATE, cm: geometric mean", "worst", "CPU, ms a frame", ""];
    table("All settings over all inputs", &head, &rows)
}

fn chart(title: &str, mut series: Vec<Series>, points: &Points) -> Option<String> {
    let cut = points.first().copied().flatten().map_or(f64::INFINITY, |p| CUT * p.1);
    let scaled = |s: &mut Series| s.points.iter_mut().for_each(|p| p.1 = CM * p.1.min(cut));
    series.iter_mut().for_each(scaled);
    let x = "CPU time a frame, ms";
    Chart { title, x, y: "ATE, cm", series, from_zero: true, ..Chart::default() }.svg()
}

fn dots<'a>(name: &'a str, ink: u8, points: Vec<(f64, f64)>) -> Series<'a> {
    Series { name, ink, dots: true, points }
}

/// The curve of a parameter, in the order of its values.
fn parameter(curve: &Curve, points: &Points) -> Option<String> {
    let along = curve.settings.iter().filter_map(|s| points[*s]).collect();
    let title = format!("{}: {}", curve.name, curve.values.join(", "));
    let series = vec![dots("along the parameter", 1, along), dots(DEFAULT, 2, points[0].into_iter().collect())];
    chart(&title, series, points)
}

/// All settings of an input, and those that none beats in both time and error.
fn front(name: &str, points: &Points, sweep: &Sweep) -> Option<String> {
    let mut sorted: Vec<(f64, f64)> = points.iter().flatten().copied().collect();
    sorted.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let mut front: Vec<(f64, f64)> = Vec::new();
    for p in &sorted {
        if front.last().is_none_or(|best| p.1 < best.1) {
            front.push(*p);
        }
    }
    let title = match knee(points) {
        Some(s) => format!("{name}; knee: {}", sweep.settings[s].name),
        None => name.to_string(),
    };
    let series = vec![
        dots("settings", 3, sorted.clone()),
        dots("not beaten in both", 1, front),
        dots(DEFAULT, 2, points[0].into_iter().collect()),
    ];
    chart(&title, series, points)
}
