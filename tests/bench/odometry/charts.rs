//! Error against run time, drawn.

use super::settings::{Curve, DEFAULT};
use super::{knee, Sweep};
use crate::page::STYLE;
use std::io::{self, Write};
use stipple::output::chart::{Chart, Series};
use stipple::output::html;

/// Errors of more than this many times the default's are drawn at that height.
pub const CUT: f64 = 3.0;
const MM: f64 = 1e3;

/// (CPU ms a frame, error m) of each setting that has both.
type Points = [Option<(f64, f64)>];

/// Error against run time of all settings over all inputs, as a drawing that stands alone.
pub fn picture(out: &mut impl Write, sweep: &Sweep) -> io::Result<()> {
    let chart = front("all inputs", &sweep.points(), sweep).unwrap_or_default();
    let namespace = "<svg xmlns=\"http://www.w3.org/2000/svg\" ";
    let (open, rest) = chart.split_at(chart.find('>').map_or(0, |i| i + 1));
    write!(out, "{}<style>{}{STYLE}</style>", open.replacen("<svg ", namespace, 1), html::STYLE)?;
    writeln!(out, "<rect width=\"100%\" height=\"100%\" fill=\"var(--page)\"/>{rest}")
}

fn chart(title: &str, mut series: Vec<Series>, points: &Points) -> Option<String> {
    let cut = points.first().copied().flatten().map_or(f64::INFINITY, |p| CUT * p.1);
    let scaled = |s: &mut Series| s.points.iter_mut().for_each(|p| p.1 = MM * p.1.min(cut));
    series.iter_mut().for_each(scaled);
    let x = "CPU time a frame, ms";
    Chart { title, x, y: "ATE, mm", series, from_zero: true, ..Chart::default() }.svg()
}

/// The curve of a parameter, in the order of its values.
pub fn parameter(curve: &Curve, points: &Points) -> Option<String> {
    let along = curve.settings.iter().filter_map(|s| points[*s]).collect();
    let title = format!("{}: {}", curve.name, curve.values.join(", "));
    let default = points[0].into_iter().collect();
    chart(&title, vec![Series::dots("along the parameter", 1, along), Series::dots(DEFAULT, 2, default)], points)
}

/// All settings of an input, and those that none beats in both time and error.
pub fn front(name: &str, points: &Points, sweep: &Sweep) -> Option<String> {
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
        Series::dots("settings", 3, sorted),
        Series::dots("not beaten in both", 1, front),
        Series::dots(DEFAULT, 2, points[0].into_iter().collect()),
    ];
    chart(&title, series, points)
}
