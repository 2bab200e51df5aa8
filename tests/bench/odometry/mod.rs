//! `stipple bench`: what the estimator's parameters cost and what they buy (`odometry`), what becomes of it
//! when something goes wrong (`stability`), whether it is as good as it says (`consistency`), what a map is
//! worth at equal time (`map`), what a training step costs by kernel (`kernels`), and how good the methods of stereo
//! are (`stereo`).
//!
//! `odometry` flies every input with the defaults and with one parameter at a time moved away
//! from them, frontend and estimator on the calling thread, in lockstep, without a mapper. It
//! leaves `odometry.csv` (a row an input and setting), `odometry.json`, `odometry.html` and
//! `odometry.svg` (error against run time). Each input is rendered or read into memory once and dropped before the next.

mod measure;
pub mod page;
mod settings;
mod tables;

use crate::inputs::{self, Flight, Input};
use measure::{measure, Figures};
use settings::Setting;
use std::path::PathBuf;
use std::time::Instant;
use stipple::output::OutputDir;
use stipple_drivers::Fault;

/// Seconds of each input when not stated, and at most: an input is in memory whole, 14 MB a second.
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
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Folder of recordings; otherwise $STIPPLE_RECORDINGS, otherwise ../shared/data
    #[arg(long, value_name = "FOLDER")]
    recordings: Option<PathBuf>,
    /// Seconds of each input, 40 at most
    #[arg(long, value_name = "S", value_parser = crate::seconds)]
    seconds: Option<f64>,
    /// One small flight, two settings
    #[arg(long)]
    quick: bool,
    /// The default settings only: a row a flight
    #[arg(long, conflicts_with = "quick")]
    defaults: bool,
}

/// One input at one setting.
struct Row {
    input: usize,
    setting: usize,
    figures: Figures,
}

/// What is known of an input once its frames are dropped.
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

pub struct Sweep {
    inputs: Vec<Flown>,
    settings: Vec<Setting>,
    rows: Vec<Row>,
}

pub fn run(options: &Args) -> Result<(), Fault> {
    let out = OutputDir::create(&options.out)?;
    let (inputs, settings, seconds) = match options.quick {
        true => (inputs::quick(), settings::quick(), options.seconds.unwrap_or(QUICK_SECONDS)),
        false => (
            inputs::all(options.recordings.as_deref())?,
            if options.defaults { settings::defaults() } else { settings::all() },
            options.seconds.unwrap_or(SECONDS).min(SECONDS_MAX),
        ),
    };
    let sweep = fly(&inputs, settings, seconds)?;
    out.write("odometry.csv", |w| tables::csv(w, &sweep))?;
    out.write("odometry.json", |w| tables::json(w, &sweep))?;
    out.write("odometry.html", |w| page::write(w, &sweep))?;
    out.write("odometry.svg", |w| page::picture(w, &sweep))?;
    println!("{}\n{}", tables::conclusion(&sweep), out.file("odometry.html").display());
    Ok(())
}

fn fly(inputs: &[Input], settings: Vec<Setting>, seconds: f64) -> Result<Sweep, Fault> {
    let mut sweep = Sweep { inputs: vec![], settings, rows: vec![] };
    let start = Instant::now();
    for (i, input) in inputs.iter().enumerate() {
        let flight: Flight = input.load(seconds)?;
        let frames = flight.frames.len();
        sweep.inputs.push(Flown { name: input.name.clone(), about: input.about.clone(), frames });
        for (s, setting) in sweep.settings.iter().enumerate() {
            let figures = measure(&flight, setting)?;
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
