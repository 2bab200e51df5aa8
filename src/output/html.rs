//! `report.html`: the report, plots and renders in one file that needs nothing else.
//!
//! A page reads from the top: what was run, the headline numbers, error against run time, the
//! trajectory, the time spent, the pictures, and what went wrong. What was not measured is a dash.

use super::chart::{bars, escape, histogram, Chart, Series};
use super::metrics::{percentile, TrajectoryError};
use super::panel::Picture;
use super::report::{KernelTime, Report, GOOD_DB};
use super::trajectory::epoch_at;
use crate::map::{spread, SeamScore, SeamScores};
use glam::DVec3;
use std::fmt::{Display, Write};
use std::io;
use stipple_drivers::{Nanos, TimedPose};

/// Pictures embedded, and their width, px: a page of a few megabytes still opens at once.
const PICTURES_MAX: usize = 6;
const PICTURE_WIDTH_MAX: usize = 1600;
const WARNINGS_MAX: usize = 50;
const KERNELS_MAX: usize = 20;
const LOOPS_MAX: usize = 12;

/// What the page shows beyond the figures of the report.
#[derive(Clone, Copy, Debug, Default)]
pub struct Evidence<'a> {
    /// The trajectory of the run, in its own frame.
    pub estimated: &'a [TimedPose],
    /// First frame and number of each epoch.
    pub epochs: &'a [(Nanos, u32)],
    /// Empty where there is none.
    pub truth: &'a [TimedPose],
    pub error: Option<&'a TrajectoryError>,
    /// Stamp of each tracked frame and the time it took, ms.
    pub tracking_ms: &'a [(Nanos, f64)],
    /// Caption and picture, in the order to be shown.
    pub pictures: &'a [(String, Picture)],
    pub warnings: &'a [String],
}

pub fn write_html(out: &mut impl io::Write, report: &Report, evidence: &Evidence) -> io::Result<()> {
    let dataset = report.dataset.as_deref().unwrap_or("run");
    let name = dataset.trim_end_matches('/').rsplit('/').next().unwrap_or(dataset);
    head(out, &escape(name), &subtitle(report), "")?;
    out.write_all(tables(report).as_bytes())?;
    section(out, "Mapping", &mapping(report))?;
    section(out, "Trajectory", &trajectory(evidence))?;
    section(out, "Tracking time", &tracking_time(evidence.tracking_ms))?;
    pictures(out, evidence.pictures)?;
    out.write_all(events(report, evidence.warnings).as_bytes())?;
    foot(out)
}

/// Opens a page: title and the line below it in HTML, and style on top of `STYLE`.
pub fn head(out: &mut impl io::Write, title: &str, what: &str, style: &str) -> io::Result<()> {
    write!(out, "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">")?;
    write!(out, "<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">")?;
    write!(out, "<title>{title} \u{2013} Stipple</title><style>{STYLE}{style}</style></head><body><main>")?;
    write!(out, "<header><p class=\"over\">Stipple</p><h1>{title}</h1><p class=\"what\">{what}</p></header>")
}

pub fn foot(out: &mut impl io::Write) -> io::Result<()> {
    writeln!(out, "</main></body></html>")
}

/// Charts below a title; nothing where no chart has a point.
pub fn section(out: &mut impl io::Write, title: &str, charts: &[Option<String>]) -> io::Result<()> {
    if charts.iter().all(Option::is_none) {
        return Ok(());
    }
    write!(out, "<section><h2>{title}</h2><div class=\"charts\">")?;
    for chart in charts.iter().flatten() {
        write!(out, "<figure>{chart}</figure>")?;
    }
    write!(out, "</div></section>")
}

fn subtitle(report: &Report) -> String {
    let parts = [
        report.board.as_ref().map(|b| format!("board {b}")),
        report.pace.as_ref().map(|p| format!("{p} pace")),
        report.scale.map(|s| if s == 1 { "full resolution".to_string() } else { format!("1/{s} resolution") }),
        report.device.clone(),
    ];
    escape(&parts.into_iter().flatten().collect::<Vec<_>>().join(" \u{b7} "))
}

/// Name, value, unit.
type Row<'a> = (&'a str, Option<String>, &'a str);

fn tables(report: &Report) -> String {
    let f = |v: Option<f64>, decimals: usize| v.filter(|v| v.is_finite()).map(|v| format!("{v:.decimals$}"));
    let n = |v: Option<u64>| v.map(grouped);
    let mib = |v: Option<u64>| v.map(|b| format!("{:.1}", b as f64 / (1 << 20) as f64));
    let odometry: [Row; 13] = [
        ("Trajectory error (ATE)", f(report.ate_rmse_m, 4), "m"),
        ("The same without loops closed", f(report.odometry_ate_rmse_m, 4), "m"),
        ("Error over 1 s (RTE)", f(report.rte_1s_m, 4), "m"),
        ("Rotation over 1 s (RPE)", f(report.rpe_deg, 3), "\u{b0}"),
        ("Tracking rate", f(report.tracking_fps, 1), "fps"),
        ("Tracking time, median", f(report.tracking_ms_p50, 2), "ms"),
        ("Tracking time, 99 %", f(report.tracking_ms_p99, 2), "ms"),
        ("Frames tracked", n(report.frames), ""),
        ("Frames dropped", n(report.frames_dropped), ""),
        ("Epochs (frames of reference)", n(report.epochs.map(u64::from)), ""),
        ("Quality, median", n(report.quality_p50.map(u64::from)), "of 100"),
        ("Quality, lowest", n(report.quality_min.map(u64::from)), "of 100"),
        ("Frames of quality under 50", f(report.quality_under_50.map(|v| 100.0 * v), 1), "%"),
    ];
    let map: [Row; 12] = [
        ("PSNR, training views", f(report.quality.psnr_db, 2), "dB"),
        ("PSNR, held-out views", f(report.quality.psnr_heldout_db, 2), "dB"),
        ("PSNR, held-out, pose between neighbours", f(report.quality.psnr_heldout_between_db, 2), "dB"),
        ("PSNR, held-out, exposure fitted", f(report.quality.psnr_heldout_fitted_db, 2), "dB"),
        ("PSNR, held-out, pose refined too", f(report.quality.psnr_heldout_aligned_db, 2), "dB"),
        ("SSIM, training views", f(report.quality.ssim, 3), ""),
        ("SSIM, held-out views", f(report.quality.ssim_heldout, 3), ""),
        ("SSIM, held-out, exposure fitted", f(report.quality.ssim_heldout_fitted, 3), ""),
        ("Gaussians", n(report.splats), ""),
        ("Iterations", n(report.iterations), ""),
        ("Iteration time, median", f(report.iteration_ms_p50, 1), "ms"),
        ("Time until training views stay at 25 dB", f(report.seconds_to_25_db, 0), "s"),
    ];
    let cost: [Row; 10] = [
        ("Run time", f(report.wall_s, 1), "s"),
        ("Energy that was measured", f(report.energy_j, 0), "J"),
        ("Power that was measured, mean", f(report.power_mean_w, 1), "W"),
        ("Keyframes", n(report.keyframes), ""),
        ("Anchors", n(report.anchors), ""),
        ("Tracker and estimator", mib(report.estimator_bytes), "MiB"),
        ("GPU memory", mib(report.gpu_bytes), "MiB"),
        ("Resident memory, peak", mib(report.rss_peak_bytes), "MiB"),
        ("Resident memory of the mapper's process, peak", mib(report.map_rss_peak_bytes), "MiB"),
        ("Heap allocations after seal", n(report.heap_after_seal), ""),
    ];
    let others = [table_of_left_out(report), table_of_rig(report), table_of_loops(report)];
    let parts = [table("Odometry", &odometry), table("Map", &map), table("Cost", &cost), others.concat()];
    format!("<section class=\"tables\">{}</section>", parts.concat())
}

type RigRow = (String, Option<String>, &'static str);

/// What was estimated of the rig; empty where nothing was.
fn table_of_rig(report: &Report) -> String {
    let three = |v: [f64; 3], unit: f64| v.map(|x| format!("{:.2}", x * unit)).join(", ");
    let pair = |v: Option<[f64; 3]>, s: Option<[f64; 3]>, unit: f64| {
        v.zip(s).map(|(v, s)| format!("{} ± {}", three(v, unit), three(s, unit)))
    };
    const MM: f64 = 1e3;
    const DEGREES: f64 = 180.0 / std::f64::consts::PI;
    const PERCENT: f64 = 100.0;
    let mut rows: Vec<RigRow> = Vec::new();
    for t in &report.time_offsets {
        let shown = format!("{:.3} ± {:.3}", t.offset_s * 1e3, t.offset_sigma_s * 1e3);
        rows.push((format!("Camera {}, time offset", t.camera), Some(shown), "ms"));
    }
    for e in &report.extrinsics {
        let k = e.camera;
        rows.push((format!("Camera {k}, position"), pair(Some(e.p_m), Some(e.p_sigma_m), MM), "mm"));
        let turn = pair(Some(e.theta_rad), Some(e.theta_sigma_rad), DEGREES);
        rows.push((format!("Camera {k}, rotation"), turn, "\u{b0}"));
    }
    for c in report.convergence.iter().filter(|c| !c.converged) {
        let of = c.camera.map_or(String::new(), |camera| format!("Camera {camera}, "));
        let shown = format!("not found, {:.0} % of the deviation at the start left", 100.0 * c.sigma_left);
        rows.push((format!("{of}{}", c.part.replace('_', " ")), Some(shown), ""));
    }
    let scales = [
        ("Gyro scale", report.gyro_scale, report.gyro_scale_sigma),
        ("Accelerometer scale", report.accel_scale, report.accel_scale_sigma),
    ];
    for (name, v, s) in scales {
        rows.extend(pair(v, s, PERCENT).map(|shown| (name.to_string(), Some(shown), "%")));
    }
    rows.extend(barometer(report));
    if rows.is_empty() {
        return String::new();
    }
    table("Rig, over its calibration", &rows)
}

/// What nothing needed, and the time that it would have taken; empty where all was done.
fn table_of_left_out(report: &Report) -> String {
    let saved = |ms: Option<f64>| ms.map_or(String::new(), |ms| format!("{:.1} s", 1e-3 * ms));
    let left = report.left_out.iter().filter(|l| l.times > 0);
    let rows: Vec<_> =
        left.map(|l| (l, format!("{} of {}", grouped(l.times), grouped(l.of)), saved(l.saved_ms))).collect();
    let rows: Vec<Row> = rows.iter().map(|(l, n, s)| (l.what.as_str(), Some(n.clone()), s.as_str())).collect();
    if rows.is_empty() {
        return String::new();
    }
    table("Work left out", &rows)
}

/// What closed loops did to the map; empty where none was scored.
fn table_of_loops(report: &Report) -> String {
    let scored = report.loops.iter().filter_map(|l| Some((l, l.map?))).take(LOOPS_MAX);
    let three = |map: SeamScores, of: &dyn Fn(SeamScore) -> Option<f64>, decimals: usize| {
        let at = |score: Option<SeamScore>| score.and_then(of).map_or("\u{2013}".into(), |v| format!("{v:.decimals$}"));
        Some([map.before, map.after, map.later].map(at).join(", "))
    };
    let start = report.loops.first().map_or(0, |l| l.t_ns);
    let rows: Vec<RigRow> = scored
        .flat_map(|(l, map)| {
            let at = format!(
                "{:.0} s after the first loop, moves {:.2} m: PSNR of views",
                (l.t_ns - start) as f64 * 1e-9,
                l.moved_m
            );
            let apart = three(map, &|score| score.disagreement.map(|share| 100.0 * share), 1);
            [
                (at, three(map, &|score| score.psnr_db, 2), "dB"),
                ("Depth error against stereo, newest anchors".into(), apart, "%"),
            ]
        })
        .collect();
    if rows.is_empty() {
        return String::new();
    }
    table("Map at closed loops: before, after, 10 s later", &rows)
}

/// By how much a barometer's height drifted, and of how many frames; `None` without one.
fn barometer(report: &Report) -> Option<RigRow> {
    let shown = report.height_bias_m.zip(report.height_bias_sigma_m).map(|(b, s)| format!("{b:.2} ± {s:.2}"));
    let [used, refused] = ["heights_used", "heights_gated"].map(|name| report.count(name));
    let name = format!("Drift of the barometer, {} heights used, {} refused", grouped(used), grouped(refused));
    (shown.is_some() || used + refused > 0).then_some((name, shown, "m"))
}

fn table<Name: Display>(title: &str, rows: &[(Name, Option<String>, &str)]) -> String {
    let mut html = format!("<table><caption>{title}</caption>");
    for (name, value, unit) in rows {
        let value = value.as_deref().unwrap_or("\u{2013}");
        let _ = write!(html, "<tr><th scope=\"row\">{name}</th><td>{value}</td><td class=\"u\">{unit}</td></tr>");
    }
    html + "</table>"
}

fn mapping(report: &Report) -> [Option<String>; 4] {
    let curve = &report.curve;
    let of = |value: &dyn Fn(usize) -> Option<f64>| -> Vec<(f64, f64)> {
        (0..curve.len()).filter_map(|i| value(i).map(|v| (curve[i].t_s, v))).collect()
    };
    let run_time = "run time, s";
    let psnr = Chart {
        title: "PSNR",
        x: run_time,
        y: "dB",
        series: vec![
            Series::dots("training views", 1, of(&|i| curve[i].psnr_db)),
            Series::dots("held-out views", 2, of(&|i| curve[i].psnr_heldout_db)),
        ],
        levels: report.seconds_to_25_db.map(|_| ("25 dB", GOOD_DB)).into_iter().collect(),
        ..Chart::default()
    };
    let count = |title, value: &dyn Fn(usize) -> f64| Chart {
        title,
        x: run_time,
        from_zero: true,
        series: vec![Series::dots(title, 1, of(&|i| Some(value(i))))],
        ..Chart::default()
    };
    let splats = count("Gaussians", &|i| curve[i].splats as f64);
    let iterations = count("Iterations", &|i| curve[i].iterations as f64);
    [psnr.svg(), splats.svg(), iterations.svg(), kernel_bars(&report.kernels)]
}

fn trajectory(evidence: &Evidence) -> [Option<String>; 4] {
    let Some(start) = evidence.estimated.first().map(|e| e.t) else { return [const { None }; 4] };
    let end = evidence.estimated.last().map_or(start, |e| e.t);
    let onto_truth = evidence.error.map(|e| e.truth_from_estimate).unwrap_or_default();
    let secs = |t: Nanos| (t - start).secs();
    let epoch = |e: &TimedPose| epoch_at(evidence.epochs, e.t);
    let epochs: Vec<(String, u8, &[TimedPose])> = evidence
        .estimated
        .chunk_by(|a, b| epoch(a) == epoch(b))
        .map(|poses| match epoch(&poses[0]) {
            0 => ("estimate".into(), 1, poses),
            // The legend has room for a few.
            epoch => (if epoch < 4 { format!("epoch {epoch}") } else { String::new() }, 1 + (epoch % 2) as u8, poses),
        })
        .collect();
    let series = |point: &dyn Fn(Nanos, DVec3) -> (f64, f64)| {
        let seen = |e: &&TimedPose| e.t >= start && e.t <= end;
        // Truth without an alignment is in another frame than the estimate: it is not drawn.
        let truth = if evidence.error.is_some() { evidence.truth } else { &[] };
        let truth = truth.iter().filter(seen).map(|e| point(e.t, e.pose.p)).collect();
        let estimates = epochs.iter().map(|(name, ink, poses)| {
            Series::line(name, *ink, poses.iter().map(|e| point(e.t, onto_truth.transform(e.pose.p))).collect())
        });
        std::iter::once(Series::line("ground truth", 3, truth)).chain(estimates).collect::<Vec<_>>()
    };
    let above = Chart {
        title: "Seen from above",
        x: "x, m",
        y: "y, m",
        equal: true,
        series: series(&|_, p| (p.x, p.y)),
        ..Chart::default()
    };
    let side = Chart { title: "Seen from the side", y: "z, m", series: series(&|_, p| (p.x, p.z)), ..above.clone() };
    let height =
        Chart { title: "Height", x: "time, s", y: "z, m", series: series(&|t, p| (secs(t), p.z)), ..Chart::default() };
    let errors = evidence.error.and_then(|e| {
        let points = e.errors.iter().map(|&(t, m)| (secs(t), m)).collect();
        let chart = Chart {
            title: "Position error after alignment",
            x: "time, s",
            y: "m",
            from_zero: true,
            series: vec![Series::line("error", 2, points)],
            levels: vec![("RMSE", e.ate_rmse_m)],
            ..Chart::default()
        };
        chart.svg()
    });
    [above.svg(), side.svg(), height.svg(), errors]
}

fn tracking_time(frames: &[(Nanos, f64)]) -> [Option<String>; 2] {
    let values: Vec<f64> = frames.iter().map(|m| m.1).collect();
    let (Some(p50), Some(p99)) = (percentile(&values, 0.5), percentile(&values, 0.99)) else { return [None, None] };
    let start = frames[0].0;
    // A single hiccup of the machine must not flatten the rest.
    let most = (2.0 * p99).max(f64::MIN_POSITIVE);
    let points = frames.iter().map(|&(t, ms)| ((t - start).secs(), ms)).collect();
    let over_time = Chart {
        title: "Tracking time of each tracked frame",
        x: "time, s",
        y: "ms",
        from_zero: true,
        y_max: Some(most),
        levels: vec![("median", p50), ("99 %", p99)],
        series: vec![Series::line("frame", 1, points)],
        ..Chart::default()
    };
    let spread = Chart {
        title: "Distribution of tracking time",
        x: "ms, the last bin holds all above",
        y: "frames",
        from_zero: true,
        series: vec![Series::line("frames", 1, histogram(&values, most, 40))],
        ..Chart::default()
    };
    [over_time.svg(), spread.svg()]
}

fn kernel_bars(kernels: &[KernelTime]) -> Option<String> {
    let total: f64 = kernels.iter().map(|k| k.total_ms).sum();
    let mut sorted: Vec<&KernelTime> = kernels.iter().collect();
    sorted.sort_by(|a, b| b.total_ms.total_cmp(&a.total_ms));
    let row = |k: &KernelTime| {
        let share = 100.0 * k.total_ms / total.max(f64::MIN_POSITIVE);
        let each = k.total_ms / k.dispatches.max(1) as f64;
        (k.name.clone(), k.total_ms, format!("{share:.1} % \u{b7} {each:.3} ms"))
    };
    let rows: Vec<_> = sorted.into_iter().take(KERNELS_MAX).map(row).collect();
    bars("GPU time by kernel", "share \u{b7} mean of a dispatch", &rows)
}

fn pictures(out: &mut impl io::Write, pictures: &[(String, Picture)]) -> io::Result<()> {
    if pictures.is_empty() {
        return Ok(());
    }
    write!(out, "<section><h2>Renders</h2><p class=\"note\">Observed, rendered, absolute error, depth.</p>")?;
    for index in spread(pictures.len(), PICTURES_MAX) {
        let (caption, picture) = &pictures[index];
        figure(out, caption, &picture.shrunk(PICTURE_WIDTH_MAX))?;
    }
    write!(out, "</section>")
}

/// A picture as wide as the page, within it.
pub fn figure(out: &mut impl io::Write, caption: &str, picture: &Picture) -> io::Result<()> {
    let mut bytes = Vec::new();
    picture.write_png(&mut bytes)?;
    write!(out, "<figure class=\"wide\"><img alt=\"{0}\" src=\"data:image/png;base64,{1}\"><figcaption>{0}</figcaption></figure>", escape(caption), base64(&bytes))
}

fn events(report: &Report, warnings: &[String]) -> String {
    let mut html = String::from("<section><h2>Counters and warnings</h2>");
    let counted: Vec<(&str, u64)> = report.counted().collect();
    if counted.is_empty() {
        html.push_str("<p class=\"note\">Every counter is zero: nothing was dropped, refused or cut.</p>");
    } else {
        html.push_str("<table class=\"counters\">");
        for (name, n) in counted {
            let name = escape(&name.replace('_', " "));
            let _ = write!(html, "<tr><th scope=\"row\">{name}</th><td>{}</td></tr>", grouped(n));
        }
        html.push_str("</table>");
    }
    match warnings.len() {
        0 => html.push_str("<p class=\"note\">No warnings about the input.</p>"),
        n => {
            html.push_str("<ul class=\"warnings\">");
            warnings.iter().take(WARNINGS_MAX).for_each(|w| {
                let _ = write!(html, "<li>{}</li>", escape(w));
            });
            html.push_str("</ul>");
            if n > WARNINGS_MAX {
                let _ = write!(html, "<p class=\"note\">and {} more</p>", n - WARNINGS_MAX);
            }
        }
    }
    if let Some(hash) = &report.vio_hash {
        let _ = write!(html, "<p class=\"note\">Hash of the odometry: <code>{}</code></p>", escape(hash));
    }
    html + "</section>"
}

/// Thousands set apart by narrow spaces.
fn grouped(n: u64) -> String {
    let digits = n.to_string();
    let mut text = String::new();
    for (i, c) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i) % 3 == 0 {
            text.push('\u{202f}');
        }
        text.push(c);
    }
    text
}

fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let group = (0..3).fold(0u32, |g, i| g << 8 | chunk.get(i).copied().unwrap_or(0) as u32);
        for i in 0..4 {
            let digit = DIGITS[(group >> (18 - 6 * i) & 63) as usize] as char;
            text.push(if i <= chunk.len() { digit } else { '=' });
        }
    }
    text
}

pub const STYLE: &str = include_str!("report.css");

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn base64_pads_every_remainder() {
        assert_eq!(base64(b"Man"), "TWFu");
        assert_eq!(base64(b"Ma"), "TWE=");
        assert_eq!(base64(b"M"), "TQ==");
        assert_eq!(base64(&[0xff, 0xfe, 0xfd]), "//79");
    }

    #[test]
    fn nothing_measured_still_makes_a_page_without_outside_references() {
        let mut page = Vec::new();
        write_html(&mut page, &Report::default(), &Evidence::default()).unwrap();
        let page = String::from_utf8(page).unwrap();
        assert!(page.starts_with("<!doctype html>") && page.ends_with("</main></body></html>\n"));
        assert!(!page.contains("http") && !page.contains("NaN"));
        assert!(page.contains("\u{2013}</td>"), "a dash where nothing was measured");
    }

    #[test]
    fn barometer_is_told_of_where_there_is_one() {
        let page = |report: &Report| {
            let mut page = Vec::new();
            write_html(&mut page, report, &Evidence::default()).unwrap();
            String::from_utf8(page).unwrap()
        };
        assert!(!page(&Report::default()).contains("barometer"));
        let mut report = Report { height_bias_m: Some(-0.314), height_bias_sigma_m: Some(0.021), ..Report::default() };
        report.set_counters(&[("heights_used", 1234), ("heights_gated", 7)]);
        let (name, value) = ("Drift of the barometer, 1\u{202f}234 heights used, 7 refused", "-0.31 ± 0.02");
        assert!(page(&report).contains(&format!("{name}</th><td>{value}</td><td class=\"u\">m</td>")));
        // All refused: a dash.
        report = Report::default();
        report.set_counters(&[("heights_gated", 7)]);
        assert!(page(&report).contains("0 heights used, 7 refused</th><td>\u{2013}</td>"));
    }
}
