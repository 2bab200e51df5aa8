//! `stipple-bench odometry`: error against run time of tracker and estimator.
//!
//! Every input is flown with the defaults and with one parameter at a time moved away from them, tracker and
//! estimator on the calling thread, in lockstep, without a mapper. Besides the page with its tables it leaves `odometry.svg` (error
//! against run time). Each input is rendered or read into memory once and dropped before the next.

mod charts;
mod measure;
mod settings;

use crate::inputs::{self, Flight, Folders, Input};
use crate::page::{count, millimetres, number, text, Page, Part, Table};
use crate::table;
use measure::{measure, Figures};
use serde_json::json;
use settings::{curves, Setting, DEFAULT};
use std::time::Instant;
use stipple::output::OutputDir;
use stipple_drivers::{Fault, FaultKind};

/// Length of each input when not stated, and at most, s: an input is in memory whole, 14 MB a second.
const SECONDS: f64 = 12.0;
const SECONDS_MAX: f64 = 40.0;
/// The quick run ends while its flight is still near its start.
const QUICK_SECONDS: f64 = 4.0;
/// A setting is as accurate as the best when its error is at most this many times the best's, and as fast as
/// the fastest of those at this many times its run time: what the flights and the clock can tell apart.
const AS_GOOD: f64 = 1.15;
const AS_FAST: f64 = 1.1;

/// Error against run time of frontend and estimator over flights and settings
#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    folders: Folders,
    /// Seconds of each input, 40 at most
    #[arg(long, value_name = "S", value_parser = crate::seconds)]
    seconds: Option<f64>,
    /// One small flight, two settings
    #[arg(long)]
    quick: bool,
    /// The default settings only: a row a flight
    #[arg(long, conflicts_with = "quick")]
    defaults: bool,
    /// One parameter of the sweep alone, beside the default
    #[arg(long, value_name = "SECTION.KEY", conflicts_with_all = ["quick", "defaults"])]
    only: Option<String>,
}

/// One input at one setting.
struct Row {
    input: usize,
    setting: usize,
    figures: Figures,
}

/// Facts of an input that stay when its frames are dropped.
struct Flown {
    name: String,
    about: String,
    frames: usize,
}

/// A setting over all inputs.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Overall {
    /// Geometric mean of the inputs' errors, m.
    ate_m: f64,
    ate_worst_m: f64,
    /// Mean over inputs.
    cpu_ms_per_frame: f64,
}

struct Sweep {
    inputs: Vec<Flown>,
    settings: Vec<Setting>,
    rows: Vec<Row>,
}

pub fn run(args: &Args) -> Result<(), Fault> {
    let out = OutputDir::create(&args.folders.out)?;
    let (inputs, settings, seconds) = match args.quick {
        true => (inputs::quick(), settings::quick(), args.seconds.unwrap_or(QUICK_SECONDS)),
        false => (inputs::all(&args.folders)?, chosen(args)?, args.seconds.unwrap_or(SECONDS).min(SECONDS_MAX)),
    };
    let sweep = fly(&inputs, settings, seconds)?;
    page(&sweep).write(&out)?;
    out.write("odometry.svg", |w| charts::picture(w, &sweep))?;
    println!("{}\n{}", conclusion(&sweep), out.file("odometry.html").display());
    Ok(())
}

fn chosen(args: &Args) -> Result<Vec<Setting>, Fault> {
    let Some(key) = &args.only else {
        return Ok(if args.defaults { settings::default() } else { settings::all() });
    };
    let fix = format!("name one of {}", settings::keys().join(", "));
    settings::of(key).ok_or_else(|| Fault::new(FaultKind::Usage, key, "is no parameter of the sweep", fix))
}

fn fly(inputs: &[Input], settings: Vec<Setting>, seconds: f64) -> Result<Sweep, Fault> {
    let mut sweep = Sweep { inputs: vec![], settings, rows: vec![] };
    let start = Instant::now();
    for (i, input) in inputs.iter().enumerate() {
        let flight: Flight = input.load(seconds)?;
        let frames = flight.frames.len();
        sweep.inputs.push(Flown { name: input.name.clone(), about: input.about.clone(), frames });
        for (s, setting) in sweep.settings.iter().enumerate() {
            let figures = measure(&flight, &setting.board)?;
            let ate = figures.ate_m.map_or("none".to_string(), |m| format!("{m:.4} m"));
            eprintln!(
                "{:6.1} s  {} of {}  {:<30} {:<32} ATE {ate}, {:.2} ms a frame",
                start.elapsed().as_secs_f64(),
                i + 1,
                inputs.len(),
                input.name,
                setting.name,
                figures.cpu_ms_per_frame
            );
            sweep.rows.push(Row { input: i, setting: s, figures });
        }
    }
    Ok(sweep)
}

impl Sweep {
    fn row(&self, input: usize, setting: usize) -> &Figures {
        &self.rows[input * self.settings.len() + setting].figures
    }

    /// `None` when the setting gave no trajectory on some input.
    fn overall(&self, setting: usize) -> Option<Overall> {
        let rows: Vec<&Figures> = (0..self.inputs.len()).map(|i| self.row(i, setting)).collect();
        let errors = rows.iter().map(|r| r.ate_m).collect::<Option<Vec<f64>>>().filter(|e| !e.is_empty())?;
        let n = errors.len() as f64;
        Some(Overall {
            ate_m: (errors.iter().map(|e| e.max(1e-9).ln()).sum::<f64>() / n).exp(),
            ate_worst_m: errors.iter().copied().fold(0.0, f64::max),
            cpu_ms_per_frame: rows.iter().map(|r| r.cpu_ms_per_frame).sum::<f64>() / n,
        })
    }

    /// (CPU ms a frame, error m) of every setting that has them, over all inputs.
    fn points(&self) -> Vec<Option<(f64, f64)>> {
        (0..self.settings.len()).map(|s| self.overall(s).map(|o| (o.cpu_ms_per_frame, o.ate_m))).collect()
    }

    /// The same on one input.
    fn points_of(&self, input: usize) -> Vec<Option<(f64, f64)>> {
        let of = |s| (self.row(input, s).cpu_ms_per_frame, self.row(input, s).ate_m);
        (0..self.settings.len()).map(of).map(|(ms, ate)| ate.map(|m| (ms, m))).collect()
    }
}

/// Among (time, error), the fastest of those as good as the best; the first, which is the default, when it
/// is as good and as fast as any.
fn knee(points: &[Option<(f64, f64)>]) -> Option<usize> {
    let best = points.iter().flatten().map(|p| p.1).min_by(f64::total_cmp)?;
    let near = |p: &(f64, f64)| p.1 <= AS_GOOD * best;
    let candidates = points.iter().enumerate().filter_map(|(i, p)| p.filter(near).map(|p| (i, p.0)));
    let (fastest, ms) = candidates.clone().min_by(|a, b| a.1.total_cmp(&b.1))?;
    Some(candidates.take(1).find(|(i, t)| *i == 0 && *t <= AS_FAST * ms).map_or(fastest, |c| c.0))
}

/// One sentence: the default and the knee.
fn conclusion(sweep: &Sweep) -> String {
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

fn page(sweep: &Sweep) -> Page {
    let frames: usize = sweep.inputs.iter().map(|i| i.frames).sum();
    let (inputs, settings) = (sweep.inputs.len(), sweep.settings.len());
    let points = sweep.points();
    let along = curves(&sweep.settings).iter().map(|c| charts::parameter(c, &points)).collect();
    let each = (0..inputs).map(|i| charts::front(&sweep.inputs[i].name, &sweep.points_of(i), sweep)).collect();
    let about = sweep.inputs.iter().map(|i| format!("{}: {}.", i.name, i.about)).collect::<Vec<_>>().join(" ");
    let note = format!(
        "ATE is after rigid alignment. Stages are wall time, so their 99th percentile holds what else the machine did. Errors above {} times the default's are drawn at that height. Run times repeat to a few per cent, and the error of one flight moves by tens of per cent between settings that differ in nothing that matters: read the curves over all inputs first.",
        charts::CUT
    );
    Page {
        name: "odometry",
        title: "Odometry: error against run time",
        what: format!(
            "{inputs} inputs, {frames} frames, {settings} settings; frontend and estimator on one thread, no mapper"
        ),
        facts: vec![("knee", json!(knee(&points).map(|s| &sweep.settings[s].name)))],
        parts: vec![
            Part::Note(conclusion(sweep)),
            Part::Note(note),
            Part::Charts("All settings, all inputs", vec![charts::front("all inputs", &points, sweep)]),
            Part::Charts("One parameter at a time, all inputs", along),
            Part::Charts("All settings on each input", each),
            Part::Table(overall(sweep)),
            Part::Table(figures(sweep)),
            Part::Note(about),
        ],
    }
}

/// Settings over all inputs, fastest first.
fn overall(sweep: &Sweep) -> Table {
    let knee = knee(&sweep.points());
    let mut order: Vec<usize> = (0..sweep.settings.len()).collect();
    let time = |s: &usize| sweep.overall(*s).map_or(f64::INFINITY, |o| o.cpu_ms_per_frame);
    order.sort_by(|a, b| time(a).total_cmp(&time(b)));
    let marks = |s: usize| [(s == 0).then_some(DEFAULT), (knee == Some(s)).then_some("knee")];
    table!("settings", "All settings over all inputs", order, |s| s == 0, [
        text("setting") => sweep.settings[s].name.as_str(),
        text("set") => sweep.settings[s].set.join(" "),
        millimetres("ATE geometric mean", 3) => sweep.overall(s).map(|o| o.ate_m),
        millimetres("ATE worst", 3) => sweep.overall(s).map(|o| o.ate_worst_m),
        number("CPU a frame", "ms", 2) => sweep.overall(s).map(|o| o.cpu_ms_per_frame),
        text("mark") => marks(s).into_iter().flatten().collect::<Vec<_>>().join(" and "),
    ])
}

/// Every input at every setting; the default first.
fn figures(sweep: &Sweep) -> Table {
    let mut rows: Vec<&Row> = sweep.rows.iter().collect();
    rows.sort_by_key(|r| r.setting);
    table!("odometry", "Each input at each setting", rows, |r| r.setting == 0, [
        text("input") => sweep.inputs[r.input].name.as_str(),
        text("setting") => sweep.settings[r.setting].name.as_str(),
        millimetres("ATE", 3) => r.figures.ate_m,
        millimetres("RTE 1 s", 3) => r.figures.rte_1s_m,
        number("RPE", "deg", 3) => r.figures.rpe_deg,
        number("frontend", "ms", 2) => r.figures.frontend_ms_p50,
        number("frontend 99 %", "ms", 2) => r.figures.frontend_ms_p99,
        number("estimator", "ms", 2) => r.figures.estimator_ms_p50,
        number("estimator 99 %", "ms", 2) => r.figures.estimator_ms_p99,
        number("CPU a frame", "ms", 3) => r.figures.cpu_ms_per_frame,
        number("one thread", "frames/s", 1) => r.figures.fps_one_thread,
        number("iterations a frame", "", 1) => r.figures.iterations_per_frame,
        count("frames") => sweep.inputs[r.input].frames,
        count("frames with pose") => r.figures.tracked,
        count("left to inertia") => r.figures.carried,
        count("keyframes") => r.figures.keyframes,
        count("resets") => r.figures.resets,
        text("hash") => format!("{:016x}", r.figures.hash),
    ])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn knee_is_the_fastest_of_those_as_good_as_the_best() {
        let points = [Some((9.0, 1.0)), Some((4.0, 1.14)), Some((2.0, 1.16)), None, Some((5.0, 1.05))];
        assert_eq!(knee(&points), Some(1));
        assert_eq!(knee(&[Some((4.3, 1.1)), Some((4.0, 1.0))]), Some(0));
        assert_eq!(knee(&[Some((4.3, 1.2)), Some((4.0, 1.0))]), Some(1));
        assert_eq!(knee(&[None, Some((3.0, 7.0))]), Some(1));
        assert_eq!(knee(&[None]), None);
    }
}
