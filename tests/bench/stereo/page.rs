//! The tables, charts and pictures of `stipple-bench stereo`.

use super::effect::{Effect, AT_S};
use super::{Bench, Row, NAMES, RANGES_M};
use crate::page::{count, mebibytes, number, percent, text, Page, Part, Table};
use crate::table;
use stipple::output::chart::{bars, Chart, Series};

const PROTOCOL: &str = "A pixel counts if its truth is known; in the columns of visible pixels, if the right eye sees it too. Density is the share of counting pixels that have a disparity. A pixel without one is not bad, but lowers the density: bad 1, bad 2 (error above 1 and 2 px) and the mean absolute error are over counting pixels that have one. The same for every method. Residual variance: of error over stated deviation, visible pixels with an error of at most 3 px; 1 is calibrated, and what is beyond is given as gross. Time is wall time of one pair, matching and deviation, rectification not included; the median over the set's pairs. Memory is that of the method's rows in the byte table; of OpenCV's own buffers an estimate. Pictures: left eye, truth, disparity, error (to 4 px), deviation (to 2 px).";

/// The method whose rows are marked.
const OWN: &str = "sgm_wls";

pub fn page(bench: &Bench) -> Page {
    let mut devices: Vec<&str> = bench.rows.iter().map(|r| r.device.as_str()).collect();
    devices.sort_unstable();
    devices.dedup();
    let mut names: Vec<&str> = vec![];
    bench.rows.iter().for_each(|r| {
        if !names.contains(&r.set.as_str()) {
            names.push(&r.set)
        }
    });
    let of = |prefix: &'static str| names.iter().copied().filter(move |n| n.starts_with(prefix));
    let range = vec![
        by_range(bench, "Mean depth error by range", "m", |r| r.score.visible.mean_m()),
        by_range(bench, "Residual variance by range", "", |r| r.score.visible.residual_variance()),
        by_range(bench, "Density by range", "share", |r| r.score.visible.density()),
        by_range(bench, "Errors above 1 px by range", "share", |r| r.score.visible.bad1()),
    ];
    let left_out = bench.left_out.iter().map(|(method, why)| Part::Note(format!("{method} is left out: {why}")));
    let mut parts: Vec<Part> = std::iter::once(Part::Note(PROTOCOL.into())).chain(left_out).collect();
    parts.extend([
        Part::Charts("Middlebury", of("middlebury").map(|set| bad(bench, set)).collect()),
        Part::Charts("Simulated flights", range),
        Part::Charts("Effect on the map", vec![map_curves(bench)]),
        Part::Charts("Time", of("time").map(|set| times(bench, set)).collect()),
        Part::Table(sets(bench)),
        Part::Table(rows(bench)),
    ]);
    if !bench.maps.is_empty() {
        parts.push(Part::Table(maps(bench)));
    }
    parts.extend(bench.pictures.iter().map(|(name, picture)| Part::Picture(name.clone(), picture.clone())));
    let title = "Stereo: disparity against truth";
    Page { name: "stereo", title, what: devices.join("; "), facts: vec![], parts }
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
    let series = NAMES.into_iter().zip([4u8, 2, 6, 1, 5]).map(|(name, ink)| Series::dots(name, ink, line(name)));
    Chart { title, x: "depth, m", y, series: series.collect(), from_zero: true, ..Chart::default() }.svg()
}

fn map_curves(bench: &Bench) -> Option<String> {
    let points = |e: &Effect| e.report.curve.iter().filter_map(|c| Some((c.t_s, c.psnr_db?))).collect();
    let series = bench.maps.iter().zip([4u8, 2, 1]).map(|(e, ink)| Series::dots(e.method, ink, points(e)));
    let title = "Training PSNR of a probe against mapping time, by method of depth";
    Chart { title, x: "mapping, s", y: "PSNR, dB", series: series.collect(), ..Chart::default() }.svg()
}

fn sets(bench: &Bench) -> Table {
    table!("sets", "Sets", &bench.sets, |s| false, [
        text("set") => s.0.as_str(),
        text("what it is") => s.1.as_str(),
    ])
}

fn rows(bench: &Bench) -> Table {
    table!("stereo", "Methods", &bench.rows, |r| r.method == OWN, [
        text("set") => r.set.as_str(),
        text("method") => r.method,
        percent("bad 1", 2) => r.score.all.bad1(),
        percent("bad 2", 2) => r.score.all.bad2(),
        number("mean error", "px", 3) => r.score.all.mean_px(),
        percent("density", 2) => r.score.all.density(),
        count("pixels") => r.score.all.pixels(),
        percent("visible bad 1", 2) => r.score.visible.bad1(),
        percent("visible bad 2", 2) => r.score.visible.bad2(),
        number("visible mean error", "px", 3) => r.score.visible.mean_px(),
        percent("visible density", 2) => r.score.visible.density(),
        number("mean depth error", "m", 3) => r.score.visible.mean_m().filter(|_| r.set.starts_with("sim")),
        percent("gross", 2) => r.score.visible.gross(),
        number("residual variance", "", 2) => r.score.visible.residual_variance(),
        percent("within a deviation", 1) => r.score.visible.within_a_deviation(),
        number("judged", "px", 0) => r.score.visible.judged(),
        number("time", "ms", 1) => r.ms,
        mebibytes("memory") => r.bytes,
        text("device") => r.device.as_str(),
    ])
}

fn maps(bench: &Bench) -> Table {
    table!("maps", "The map by method of depth", &bench.maps, |e| e.method == OWN, [
        text("method") => e.method,
        number("at 10 s", "dB", 2) => e.psnr_at(AT_S[0]),
        number("at 30 s", "dB", 2) => e.psnr_at(AT_S[1]),
        number("at the end", "dB", 2) => e.report.quality.psnr_db,
        number("held out", "dB", 2) => e.report.quality.psnr_heldout_db,
        number("SSIM", "", 3) => e.report.quality.ssim,
        count("anchors") => e.report.anchors,
        count("Gaussians") => e.report.splats,
        count("steps") => e.report.iterations,
    ])
}
