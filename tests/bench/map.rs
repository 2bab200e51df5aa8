//! `stipple-bench map`: what a map is worth at equal time, against the cap of Gaussians and without parts of the method; with `--work`
//! against the number of training steps, of which the default is where the mapper rests.
//!
//! Every run plays the same input through the program with the same seconds of mapping, spread evenly over its frames
//! (lockstep by time: what a step costs is part of what is measured, so figures repeat only as well as the clock
//! does). Each leaves its own report in a folder of DIR.

use crate::page::{count, mebibytes, number, text, Page, Part, Table};
use crate::run::{Job, Source};
use crate::table;
use serde_json::json;
use std::path::PathBuf;
use std::time::Instant;
use stipple::output::chart::{Chart, Series};
use stipple::output::report::Report;
use stipple::output::OutputDir;
use stipple::run::Steps;
use stipple_drivers::Fault;

/// Seconds of mapping a run when not stated.
const SECONDS: f64 = 30.0;
const QUICK_SECONDS: f64 = 1.5;
/// Caps of the pool, Gaussians.
const CAPS: [u32; 4] = [20_000, 52_000, 100_000, 200_000];
const QUICK_CAPS: [u32; 2] = [1_500, 3_000];
/// Cap of the ablations, Gaussians: the published system's count on V1_01.
const ABLATED_CAP: u32 = 52_000;
/// (Gaussian, tile) pairs bought a Gaussian of the cap: twice what views of V1_01 list of 52 k.
const INTERSECTIONS: u32 = 15;
/// At least, whatever the cap.
const INTERSECTIONS_MIN: u32 = 300_000;
/// Points of each run's curve.
const PROBES: f64 = 20.0;
/// Steps a keyframe of the work-precision diagram, after which the mapper rests, and which of them is the default.
const WORK: [u32; 7] = [25, 50, 100, 150, 300, 600, 1200];
const QUICK_WORK: [u32; 2] = [4, 8];
const WORK_DEFAULT: u32 = 300;
/// The caps are what is limited here.
const MEMORY_MAX_MIB: u32 = 8192;

/// A method, by what it sets differently from the board.
#[derive(Clone, Copy, Debug)]
pub struct Variant {
    pub name: &'static str,
    pub about: &'static str,
    pub set: &'static [&'static str],
}

const fn variant(name: &'static str, about: &'static str, set: &'static [&'static str]) -> Variant {
    Variant { name, about, set }
}

/// The lines of the cap sweep; the first is the default.
const LINES: [Variant; 2] = [
    variant("default", "the board's own settings", &[]),
    variant(
        "as published",
        "anchors by alpha; seeds and densifies up to the cap, never evicts; a raised burst",
        &["map.evict=false", "map.seeds_per_step=0", "map.wrong_error=1", "map.burst_rate=2"],
    ),
];

/// The method without, or with, one part. The first row of the table is the default.
const ABLATIONS: [Variant; 12] = [
    variant("no burst", "a new anchor waits for its turn", &["map.burst_iterations=0"]),
    variant("no densification", "seeds on bare depth only", &["map.densify_max=0"]),
    variant("no eviction", "a full pool takes no more", &["map.evict=false"]),
    variant("any seeds", "as many as the pool has room for, whatever the steps", &["map.seeds_per_step=0"]),
    variant("anchors by alpha", "covered but wrong views are not anchors", &["map.wrong_error=1"]),
    variant(
        "nearly every view an anchor",
        "stereo depth and seeds wherever anything is missing",
        &["map.anchor_missing_min=0"],
    ),
    variant("no SSIM", "L1 alone", &["map.ssim_weight=0"]),
    variant("no needle loss", "axes of any ratio", &["map.needle_weight=0"]),
    variant("no scale loss", "axes of any length", &["map.scale_weight=0"]),
    variant("no pose", "keyframe poses as given", &["map.refine_pose=false"]),
    variant("no exposure", "one exposure for all keyframes", &["map.refine_exposure=false"]),
    variant("neither", "neither pose nor exposure refined", &["map.refine_pose=false", "map.refine_exposure=false"]),
];

/// Quality of the map at equal time: against the cap of Gaussians, and without parts of the method
#[derive(clap::Args)]
pub struct Args {
    /// Recording, as for replay; without it the simulated flight of the demo
    dataset: Option<PathBuf>,
    /// Folder for the results
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Board file; without it the one for Vulkan on the CPU
    #[arg(long, value_name = "FILE")]
    board: Option<PathBuf>,
    /// Skip odometry, as for replay
    #[arg(long, value_name = "CSV")]
    poses: Option<PathBuf>,
    /// Seconds of mapping of each run
    #[arg(long, value_name = "S", value_parser = crate::seconds)]
    seconds: Option<f64>,
    /// In place of all that: quality against the number of training steps a keyframe, and their time; 2 min on an H200, hours
    /// without a GPU
    #[arg(long, conflicts_with = "seconds")]
    work: bool,
    /// Two small caps and one ablation, or two small numbers of steps
    #[arg(long)]
    quick: bool,
    /// Override a key of the board file in every run
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
    set: Vec<String>,
}

fn db(v: Option<f64>) -> String {
    v.map_or("-".into(), |v| format!("{v:.2} dB"))
}

/// A run and its report.
struct Row {
    variant: Variant,
    cap: u32,
    report: Report,
}

struct Sweep {
    seconds: f64,
    /// The cap sweep, by line and cap.
    caps: Vec<Row>,
    /// The default, then each ablation.
    ablations: Vec<Row>,
}

pub fn run(args: &Args) -> Result<(), Fault> {
    let out_dir = OutputDir::create(&args.out)?;
    let Args { dataset, board, poses, set, .. } = args;
    let source = Source { dataset: dataset.clone(), board: board.clone(), poses: poses.clone(), set: set.clone() };
    if args.work {
        return work(args, &source, &out_dir);
    }
    let seconds = args.seconds.unwrap_or(if args.quick { QUICK_SECONDS } else { SECONDS });
    let start = Instant::now();
    let measure = |folder: &str, variant: Variant, cap: u32| -> Result<Row, Fault> {
        let name = format!("{folder}-{}-{cap}", variant.name.replace(' ', "-"));
        let set = assignments(&variant, cap, seconds);
        let dir = OutputDir::create(&args.out.join("runs").join(name))?;
        let report = source.play(&Job { set: &set, steps: Steps::EqualTime(seconds), quick: args.quick }, &dir)?;
        eprintln!(
            "{:6.1} s  {:<24} cap {cap:>6}: {} Gaussians, {} steps, {} training, {} held out",
            start.elapsed().as_secs_f64(),
            variant.name,
            report.splats.unwrap_or(0),
            report.iterations.unwrap_or(0),
            db(report.quality.psnr_db),
            db(report.quality.psnr_heldout_db)
        );
        Ok(Row { variant, cap, report })
    };
    let mut sweep = Sweep { seconds, caps: vec![], ablations: vec![] };
    let (caps, ablated): (&[u32], u32) = if args.quick { (&QUICK_CAPS, QUICK_CAPS[1]) } else { (&CAPS, ABLATED_CAP) };
    for line in LINES {
        for cap in caps {
            sweep.caps.push(measure("cap", line, *cap)?);
        }
    }
    let ablations = &ABLATIONS[..if args.quick { 1 } else { ABLATIONS.len() }];
    for ablation in std::iter::once(&LINES[0]).chain(ablations) {
        sweep.ablations.push(measure("ablation", *ablation, ablated)?);
        // After each: whoever ends a run of many minutes early keeps what there is.
        page(&sweep).write(&out_dir)?;
    }
    println!("{}\n\n{}\n{}", table(&sweep).text(), conclusion(&sweep), out_dir.file("map.html").display());
    Ok(())
}

/// Quality against the training that keyframes get: a run for each number of steps, in lockstep.
fn work(args: &Args, source: &Source, out: &OutputDir) -> Result<(), Fault> {
    let mut rows: Vec<(u32, Report)> = vec![];
    for &steps in if args.quick { &QUICK_WORK[..] } else { &WORK } {
        let mut set = assignments(&LINES[0], ABLATED_CAP, SECONDS);
        set.push(format!("map.steps_per_keyframe_max={steps}"));
        let dir = OutputDir::create(&args.out.join("runs").join(format!("work-{steps}")))?;
        // So many are offered at every frame that the limit a keyframe decides.
        let report = source.play(&Job { set: &set, steps: Steps::PerFrame(steps), quick: args.quick }, &dir)?;
        eprintln!("{steps} steps a keyframe: {} training", db(report.quality.psnr_db));
        rows.push((steps, report));
        work_page(&rows).write(out)?;
    }
    println!("{}\n{}", work_table(&rows).text(), out.file("map-work.html").display());
    Ok(())
}

/// Time of a run's training steps, s.
fn training_s(report: &Report) -> Option<f64> {
    Some(1e-3 * report.iteration_ms_p50? * report.iterations? as f64)
}

fn work_table(rows: &[(u32, Report)]) -> Table {
    table!("map-work", "Quality against training", rows, |r| r.0 == WORK_DEFAULT, [
        count("steps a keyframe") => r.0,
        count("steps") => r.1.iterations,
        number("training", "s", 1) => training_s(&r.1),
        count("anchors") => r.1.anchors,
        count("Gaussians") => r.1.splats,
        number("PSNR", "dB", 2) => r.1.quality.psnr_db,
        number("held out", "dB", 2) => r.1.quality.psnr_heldout_db,
        number("held out exposure fitted", "dB", 2) => r.1.quality.psnr_heldout_fitted_db,
        number("held out pose refined", "dB", 2) => r.1.quality.psnr_heldout_aligned_db,
    ])
}

fn work_page(rows: &[(u32, Report)]) -> Page {
    let first = rows.first().map(|r| &r.1);
    let named = |v: Option<&String>| v.cloned().unwrap_or("-".into());
    let (dataset, device) = (first.and_then(|r| r.dataset.as_ref()), first.and_then(|r| r.device.as_ref()));
    let line = |get: fn(&Report) -> Option<f64>| -> Vec<(f64, f64)> {
        rows.iter().filter_map(|r| Some((training_s(&r.1)?, get(&r.1)?))).collect()
    };
    let chart = |title, get: fn(&Report) -> Option<f64>| {
        let default = rows.iter().filter(|r| r.0 == WORK_DEFAULT).filter_map(|r| Some((training_s(&r.1)?, get(&r.1)?)));
        let series =
            vec![Series::dots("every number of steps", 1, line(get)), Series::dots("default", 2, default.collect())];
        Chart { title, x: "training, s", y: "PSNR, dB", series, ..Chart::default() }.svg()
    };
    Page {
        name: "map-work",
        title: "Map: quality against training",
        what: format!("{}, {}; lockstep, at most {ABLATED_CAP} Gaussians", named(dataset), named(device)),
        facts: vec![("dataset", json!(dataset)), ("device", json!(device))],
        parts: vec![
            Part::Note("The mapper rests when keyframes had their steps on average. Time is that of the steps: their number times the median of one.".into()),
            Part::Charts(
                "Quality against training",
                vec![
                    chart("Training views", |r| r.quality.psnr_db),
                    chart("Held out, exposure fitted", |r| r.quality.psnr_heldout_fitted_db),
                ],
            ),
            Part::Table(work_table(rows)),
        ],
    }
}

fn assignments(variant: &Variant, cap: u32, seconds: f64) -> Vec<String> {
    let intersections = (INTERSECTIONS * cap).max(INTERSECTIONS_MIN);
    let shape = [
        format!("memory_max_mib={MEMORY_MAX_MIB}"),
        format!("budget.intersections={intersections}"),
        format!("budget.splats={cap}"),
        // What is on disk would count beside the cap.
        "store.enabled=false".into(),
        format!("map.curve_period_s={}", seconds / PROBES),
    ];
    shape.into_iter().chain(variant.set.iter().map(|s| s.to_string())).collect()
}

impl Row {
    /// Time of a training step, seeding and evaluation of coverage included, ms.
    fn step_ms(&self, seconds: f64) -> Option<f64> {
        self.report.iterations.filter(|n| *n > 0).map(|n| 1e3 * seconds / n as f64)
    }
}

const NOTE: &str = "Every run has the same seconds of mapping: making anchors, depth and densification count, probes for curves and the evaluation do not. A run with dearer steps takes fewer. Figures repeat as well as the clock does: differences under 0.1 dB say nothing.";

type Get = fn(&Row) -> Option<f64>;

fn page(sweep: &Sweep) -> Page {
    let first = sweep.caps.first().map(|r| &r.report);
    let (dataset, device) = (first.and_then(|r| r.dataset.clone()), first.and_then(|r| r.device.clone()));
    let scale = first.and_then(|r| r.scale);
    let named = |v: &Option<String>| v.clone().unwrap_or("-".into());
    let psnr: [(&str, Get); 2] =
        [("training", |r| r.report.quality.psnr_db), ("held out", |r| r.report.quality.psnr_heldout_db)];
    let ssim: [(&str, Get); 2] =
        [("training", |r| r.report.quality.ssim), ("held out", |r| r.report.quality.ssim_heldout)];
    let mut charts = vec![];
    for line in LINES {
        let own = |what: &[(&'static str, Get)]| -> Vec<(&str, Vec<(f64, f64)>)> {
            what.iter().map(|(name, get)| (*name, along(&line, *get, sweep))).collect()
        };
        charts.push(against_cap(&format!("PSNR: {}", line.name), "PSNR, dB", own(&psnr)));
        charts.push(against_cap(&format!("SSIM: {}", line.name), "SSIM", own(&ssim)));
    }
    let lines = |get: Get| LINES.iter().map(|line| (line.name, along(line, get, sweep))).collect();
    charts.push(against_cap("Training PSNR by method", "PSNR, dB", lines(|r| r.report.quality.psnr_db)));
    charts.push(against_cap("Gaussians used", "Gaussians", lines(|r| r.report.splats.map(|n| n as f64))));
    charts.push(over_time(sweep));
    Page {
        name: "map",
        title: "Map: quality at equal time",
        what: format!(
            "{}, scale {}, {}; {} s of mapping a run, spread evenly over its frames",
            named(&dataset),
            scale.unwrap_or(1),
            named(&device),
            sweep.seconds
        ),
        facts: vec![
            ("dataset", json!(dataset)),
            ("device", json!(device)),
            ("scale", json!(scale)),
            ("mapping_s", json!(sweep.seconds)),
        ],
        parts: vec![
            Part::Note(conclusion(sweep)),
            Part::Note(NOTE.into()),
            Part::Charts("Quality against the cap", charts),
            Part::Table(table(sweep)),
        ],
    }
}

fn table(sweep: &Sweep) -> Table {
    let rows = sweep.caps.iter().map(|r| ("cap", r)).chain(sweep.ablations.iter().map(|r| ("ablation", r)));
    table!("map", "Runs", rows, |r| r.1.variant.name == LINES[0].name, [
        text("part") => r.0,
        text("variant") => r.1.variant.name,
        text("what it is") => r.1.variant.about,
        text("set") => r.1.variant.set.join(" "),
        count("cap") => r.1.cap,
        count("Gaussians") => r.1.report.splats,
        count("anchors") => r.1.report.anchors,
        count("keyframes") => r.1.report.keyframes,
        count("steps") => r.1.report.iterations,
        number("step", "ms", 2) => r.1.step_ms(sweep.seconds),
        number("PSNR", "dB", 2) => r.1.report.quality.psnr_db,
        number("SSIM", "", 3) => r.1.report.quality.ssim,
        number("held out", "dB", 2) => r.1.report.quality.psnr_heldout_db,
        number("held out SSIM", "", 3) => r.1.report.quality.ssim_heldout,
        number("held out pose refined", "dB", 2) => r.1.report.quality.psnr_heldout_aligned_db,
        mebibytes("GPU memory") => r.1.report.gpu_bytes,
    ])
}

/// A figure of a line's runs against their caps.
fn along(line: &Variant, get: Get, sweep: &Sweep) -> Vec<(f64, f64)> {
    let rows = sweep.caps.iter().filter(|r| r.variant.name == line.name);
    rows.filter_map(|r| Some((f64::from(r.cap), get(r)?))).collect()
}

fn against_cap(title: &str, y: &str, lines: Vec<(&str, Vec<(f64, f64)>)>) -> Option<String> {
    let series = lines.into_iter().zip(1u8..).map(|((name, points), ink)| Series::dots(name, ink, points));
    Chart { title, x: "cap, Gaussians", y, series: series.collect(), ..Chart::default() }.svg()
}

/// The default's error against mapping time at the lowest and the highest cap.
fn over_time(sweep: &Sweep) -> Option<String> {
    let default: Vec<&Row> = sweep.caps.iter().filter(|r| r.variant.name == LINES[0].name).collect();
    let ends = [default.first()?, default.last()?];
    let names = ends.map(|r| format!("cap {}", r.cap));
    let curve = |r: &Row| r.report.curve.iter().filter_map(|c| Some((c.t_s, c.psnr_db?))).collect();
    let series = (0..2).map(|i| Series::dots(&names[i], i as u8 + 1, curve(ends[i])));
    let title = "Training PSNR of a probe against mapping time";
    Chart { title, x: "mapping, s", y: "PSNR, dB", series: series.collect(), ..Chart::default() }.svg()
}

/// One sentence: what raising the cap does to the first line.
fn conclusion(sweep: &Sweep) -> String {
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
        change(|r| r.report.quality.psnr_db),
        change(|r| r.report.quality.psnr_heldout_db),
        low.report.splats.unwrap_or(0),
        high.report.splats.unwrap_or(0)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_variant_is_within_the_bounds_and_not_the_default() {
        let board = |set: &[String]| crate::run::default_board(set).expect("variants stay within the bounds");
        for cap in CAPS.iter().chain(&QUICK_CAPS) {
            assert_eq!(board(&assignments(&LINES[0], *cap, 1.0)).budget.splats, *cap);
        }
        let default = board(&assignments(&LINES[0], ABLATED_CAP, 1.0));
        for v in LINES[1..].iter().chain(&ABLATIONS) {
            assert_ne!(board(&assignments(v, ABLATED_CAP, 1.0)), default, "{}", v.name);
        }
    }
}
