//! `stereo.html`: tables, charts and pictures of every set, in one file that needs nothing else.

use super::effect::{Effect, AT_S};
use super::{Bench, Row, NAMES, RANGES_M};
use crate::odometry::page::{foot, head, section, table};
use std::io::{self, Write};
use stipple::output::chart::{bars, escape, Chart, Series};
use stipple::output::html::figure;

/// Widest picture within the page, px; those in `pictures/` are larger.
const WIDTH_MAX: usize = 1200;

const PROTOCOL: &str = "A pixel counts if its truth is known; in the columns of visible pixels, if the right eye sees it too. Density is the share of counting pixels that have a disparity. A pixel without one is not bad, but lowers the density: bad 1, bad 2 (error above 1 and 2 px) and the mean absolute error are over counting pixels that have one. The same for every method. Residual variance: of error over stated deviation, visible pixels with an error of at most 3 px; 1 is calibrated, and what is beyond is given as gross. Time is wall time of one pair, matching and deviation, rectification not included; the median over the set's pairs. Bytes are those of the method's row in the byte table; of OpenCV's own buffers an estimate.";

pub fn write(out: &mut impl Write, bench: &Bench) -> io::Result<()> {
    let mut devices: Vec<&str> = bench.rows.iter().map(|r| r.device.as_str()).collect();
    devices.sort_unstable();
    devices.dedup();
    head(out, "Stereo: disparity against truth", &escape(&devices.join("; ")))?;
    write!(out, "<section><h2>Protocol</h2><p class=\"note\">{}</p>", escape(PROTOCOL))?;
    for (method, why) in &bench.left_out {
        write!(out, "<p class=\"note\"><b>{method}</b> is left out: {}</p>", escape(why))?;
    }
    write!(out, "</section>")?;
    let mut names: Vec<&str> = vec![];
    bench.rows.iter().for_each(|r| {
        if !names.contains(&r.set.as_str()) {
            names.push(&r.set)
        }
    });
    let of = |prefix: &str| names.iter().copied().filter(|n| n.starts_with(prefix)).collect::<Vec<_>>();
    let charts: Vec<_> = of("middlebury").iter().map(|set| bad(bench, set)).collect();
    section(out, "Middlebury", &charts)?;
    let range = [
        by_range(bench, "Mean depth error by range", "m", |r| r.score.visible.mean_m()),
        by_range(bench, "Residual variance by range", "", |r| r.score.visible.residual_variance()),
        by_range(bench, "Density by range", "share", |r| r.score.visible.density()),
        by_range(bench, "Errors above 1 px by range", "share", |r| r.score.visible.bad1()),
    ];
    section(out, "Simulated flights", &range)?;
    if !bench.maps.is_empty() {
        section(out, "Effect on the map", &[map_curves(bench)])?;
        out.write_all(maps(bench).as_bytes())?;
    }
    let charts: Vec<_> = of("time").iter().map(|set| times(bench, set)).collect();
    section(out, "Time", &charts)?;
    for set in &names {
        let about = bench.sets.iter().find(|s| s.0 == *set).map_or("", |s| &s.1);
        out.write_all(rows(bench, set, about).as_bytes())?;
        for (name, picture) in bench.pictures.iter().filter(|(n, _)| n.rsplit_once('-').is_some_and(|n| n.0 == *set)) {
            let caption = format!("{name}: left eye, truth, disparity, error (to 4 px), deviation (to 2 px)");
            figure(out, &caption, &picture.shrunk(WIDTH_MAX))?;
        }
    }
    foot(out)
}

fn of_set<'a>(bench: &'a Bench, set: &'a str) -> impl Iterator<Item = &'a Row> {
    bench.rows.iter().filter(move |r| r.set == set)
}

fn bad(bench: &Bench, set: &str) -> Option<String> {
    let bar = |r: &Row| {
        let (bad, density) = (r.score.all.bad1()?, r.score.all.density()?);
        Some((r.method.to_string(), 100.0 * bad, format!("{:.2} %, density {:.1} %", 100.0 * bad, 100.0 * density)))
    };
    bars(&format!("{set}: errors above 1 px"), "%", &of_set(bench, set).filter_map(bar).collect::<Vec<_>>())
}

fn times(bench: &Bench, set: &str) -> Option<String> {
    let bar = |r: &Row| (r.method.to_string(), r.ms, format!("{:.1} ms", r.ms));
    bars(set, "ms", &of_set(bench, set).map(bar).collect::<Vec<_>>())
}

fn by_range(bench: &Bench, title: &str, y: &str, get: fn(&Row) -> Option<f64>) -> Option<String> {
    let line = |method: &'static str| {
        let at = |k: usize| {
            let set = format!("sim {} to {} m", RANGES_M[k], RANGES_M[k + 1]);
            let row = bench.rows.iter().find(|r| r.set == set && r.method == method)?;
            Some(((RANGES_M[k] * RANGES_M[k + 1]).sqrt(), get(row)?))
        };
        (0..RANGES_M.len() - 1).filter_map(at).collect::<Vec<_>>()
    };
    let series = NAMES.into_iter().zip([4u8, 2, 6, 1, 5]).map(|(name, ink)| Series {
        name,
        ink,
        dots: true,
        points: line(name),
    });
    Chart { title, x: "depth, m", y, series: series.collect(), from_zero: true, ..Chart::default() }.svg()
}

fn map_curves(bench: &Bench) -> Option<String> {
    let series = bench.maps.iter().zip([4u8, 2, 1]).map(|(e, ink)| {
        let points = e.report.curve.iter().filter_map(|c| Some((c.t_s, c.psnr_db?))).collect();
        Series { name: e.method, ink, dots: true, points }
    });
    let title = "Training PSNR of a probe against mapping time, by method of depth";
    Chart { title, x: "mapping, s", y: "PSNR, dB", series: series.collect(), ..Chart::default() }.svg()
}

fn maps(bench: &Bench) -> String {
    let head =
        ["method", "at 10 s, dB", "at 30 s, dB", "at the end, dB", "held out, dB", "SSIM", "anchors", "Gaussians"];
    let number = |v: Option<f64>, digits: usize| v.map_or("\u{2013}".into(), |v| format!("{v:.digits$}"));
    let cells = |e: &Effect| {
        let r = &e.report;
        vec![
            e.method.to_string(),
            number(e.psnr_at(AT_S[0]), 2),
            number(e.psnr_at(AT_S[1]), 2),
            number(r.psnr_db, 2),
            number(r.psnr_heldout_db, 2),
            number(r.ssim, 3),
            r.anchors.unwrap_or(0).to_string(),
            r.splats.unwrap_or(0).to_string(),
        ]
    };
    let marked: Vec<_> = bench.maps.iter().map(|e| (e.method == "sgm_wls", cells(e))).collect();
    table("The map by method of depth", &head, &marked)
}

fn rows(bench: &Bench, set: &str, about: &str) -> String {
    let head = [
        "method",
        "bad 1, %",
        "bad 2, %",
        "mean, px",
        "density, %",
        "visible: bad 1, %",
        "bad 2, %",
        "mean, px",
        "density, %",
        "gross, %",
        "residual variance",
        "within a deviation, %",
        "ms",
        "MiB",
    ];
    let number = |v: Option<f64>, scale: f64, digits: usize| {
        v.map_or("\u{2013}".to_string(), |v| format!("{:.digits$}", v * scale))
    };
    let cells = |r: &Row| {
        let (all, seen) = (&r.score.all, &r.score.visible);
        vec![
            r.method.to_string(),
            number(all.bad1(), 100.0, 2),
            number(all.bad2(), 100.0, 2),
            number(all.mean_px(), 1.0, 3),
            number(all.density(), 100.0, 1),
            number(seen.bad1(), 100.0, 2),
            number(seen.bad2(), 100.0, 2),
            number(seen.mean_px(), 1.0, 3),
            number(seen.density(), 100.0, 1),
            number(seen.gross(), 100.0, 2),
            number(seen.residual_variance(), 1.0, 2),
            number(seen.within_a_deviation(), 100.0, 1),
            format!("{:.1}", r.ms),
            format!("{:.1}", r.bytes as f64 / f64::from(1 << 20)),
        ]
    };
    let marked: Vec<_> = of_set(bench, set).map(|r| (r.method == "sgm_wls", cells(r))).collect();
    let title = if about.is_empty() { escape(set) } else { format!("{}: {}", escape(set), escape(about)) };
    table(&title, &head, &marked)
}
