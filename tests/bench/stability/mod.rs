//! `stipple-bench stability`: one row for each thing that goes wrong on a flight, for odometry here, for a training step on the GPU in
//! `steps`, for the map in `mapping`.
//!
//! A row says what became of the estimator (survived within stated bounds; detected, when it was wrong
//! and said so; reset, and by what reason; missed, when it was wrong and silent), the error of the part of the
//! flight before and of the part after the fault, each aligned on its own, and the jump from one to the
//! other. Made-up tracks (`cases`) and rendered images with their light changed (`rendered`). The same
//! rows are asserted by `tests`.

mod cases;
mod mapping;
mod rendered;
mod steps;
#[cfg(test)]
pub mod tests;

use crate::consistency::agrees;
use crate::flight::{record, Plan, Record};
use crate::missed;
use crate::page::{count, millimetres, number, text, Page, Part, Table};
use crate::table;
use crate::world::FRAME_SECS;
use std::path::PathBuf;
use stipple::output::metrics::trajectory_error;
use stipple::output::OutputDir;
use stipple::vio::instruments::Stats;
use stipple::vio::{Health, Vio};
use stipple_drivers::{Fault, FaultKind, TimedPose};

/// A quality this low says that the estimate is not to be relied on.
const QUALITY_LOW: u8 = 20;
/// An estimate that is wrong is detected when this share of its frames say so.
const SAID_SHARE: f64 = 0.9;
/// Frames in a row that warn of nothing before an estimate can be relied on (a quarter of a second), and frames for which an
/// error must stand for a controller to follow it (more than a tenth).
const CLEAN_FRAMES: usize = 5;
const FOLLOWED_FRAMES: usize = 3;
/// An estimate that is further off must say so: a drone that holds its place within 0.1 m would leave it, m.
const UNANNOUNCED_MAX: f64 = 0.1;
/// Distance in its covariance that one restart in four hundred exceeds: χ² of three dimensions, 99.73 %.
const THREE_SIGMA: f64 = 3.76;
/// After a reset the quality agrees with the error of the velocity within this, s, and stays so: until then a controller flies
/// by a claim that nobody checked. The error is its root mean square over a quarter of a second to either side, ns.
const AGREES_WITHIN_S: f64 = 3.0;
const EITHER_SIDE: i64 = 250_000_000;
/// Frames into a fault that lasts for which the jump is taken.
const JUMP_FRAMES: usize = 20;

/// Outcome of a case, in the order of how bad it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Verdict {
    Survived,
    /// Wrong, and says so.
    Detected,
    /// Noticed, given up, started again.
    Reset,
    /// Wrong and silent.
    Missed,
}

impl Verdict {
    pub fn name(self) -> &'static str {
        match self {
            Verdict::Survived => "survived",
            Verdict::Detected => "detected",
            Verdict::Reset => "reset",
            Verdict::Missed => "MISSED",
        }
    }
}

/// How far off a flight may be, m: ATE before and after the fault, and the step across it.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    pub before: f64,
    pub after: f64,
    pub jump: f64,
}

impl Default for Limits {
    fn default() -> Limits {
        Limits { before: 0.006, after: 0.006, jump: 0.008 }
    }
}

#[derive(Clone)]
struct Case {
    name: &'static str,
    plan: Plan,
    /// Frames from which and before which the fault lasts; `None` when it is the whole flight.
    fault: Option<(usize, usize)>,
    expect: Verdict,
    limits: Limits,
    /// Bits that must be set on some frame.
    health: Health,
}

/// Figures of a case: the worst over the seeds flown.
#[derive(Clone, Debug)]
pub struct Row {
    pub name: &'static str,
    pub expect: Verdict,
    pub limits: Limits,
    pub says: Health,
    /// The fault does not end.
    pub lasts: bool,
    pub verdict: Verdict,
    /// ATE, m.
    pub before: Option<f64>,
    pub after: Option<f64>,
    /// Error of the motion across the fault, m.
    pub jump: Option<f64>,
    /// The largest error of the motion that no health bit and no low quality warned of, m; of flights on which something fails.
    pub unannounced: Option<f64>,
    /// Distance of the restart's position from the truth in its covariance.
    pub restart_sigmas: Option<f64>,
    /// Time after the first pose that follows a reset until the quality agrees with the error of the velocity, s.
    pub agrees_after: Option<f64>,
    pub stats: Stats,
    /// Bits set once it had started.
    pub health: Health,
    /// Median before the fault (of all, without one), and the lowest after the start.
    pub quality: u8,
    pub quality_lowest: u8,
}

impl Row {
    /// The first thing that is not as it has to be.
    pub fn complaint(&self) -> Option<String> {
        let over = |v: Option<f64>, max: f64| v.is_some_and(|v| v > max);
        // A fault that lasts may end the next start too.
        let resets = match (self.expect, self.lasts) {
            (Verdict::Reset, true) => 1..=3,
            (Verdict::Reset, false) => 1..=1,
            _ => 0..=0,
        };
        let (name, said) = (self.name, self.health.reasons().collect::<Vec<_>>().join(" "));
        if self.verdict != self.expect {
            return Some(format!("{name}: {}, not {}", self.verdict.name(), self.expect.name()));
        }
        if !self.health.has(self.says) {
            return Some(format!("{name}: says only {said}"));
        }
        if !resets.contains(&self.stats.resets) {
            return Some(format!("{name}: {} resets, not {resets:?}", self.stats.resets));
        }
        if let Some(m) = self.unannounced.filter(|m| *m > UNANNOUNCED_MAX) {
            return Some(format!("{name}: {m:.3} m off, and says nothing"));
        }
        if let Some(sigmas) = self.restart_sigmas.filter(|s| *s > THREE_SIGMA) {
            return Some(format!("{name}: starts again {sigmas:.1} sigma from the truth"));
        }
        if let Some(s) = self.agrees_after.filter(|s| *s > AGREES_WITHIN_S) {
            return Some(format!("{name}: its quality claims too much until {s:.2} s after a restart"));
        }
        let detected = self.expect == Verdict::Detected;
        let far = over(self.before, self.limits.before)
            || !detected && (over(self.after, self.limits.after) || over(self.jump, self.limits.jump));
        far.then(|| format!("{name}: before {:?}, after {:?}, jump {:?} m", self.before, self.after, self.jump))
    }

    fn worst(self, other: Row) -> Row {
        let max = |a: Option<f64>, b: Option<f64>| a.into_iter().chain(b).reduce(f64::max);
        let stats = if other.stats.resets > self.stats.resets { other.stats } else { self.stats };
        Row {
            verdict: self.verdict.max(other.verdict),
            before: max(self.before, other.before),
            after: max(self.after, other.after),
            jump: max(self.jump, other.jump),
            unannounced: max(self.unannounced, other.unannounced),
            restart_sigmas: max(self.restart_sigmas, other.restart_sigmas),
            agrees_after: max(self.agrees_after, other.agrees_after),
            // Bits that every flight showed.
            health: Health(self.health.0 & other.health.0),
            quality: self.quality.min(other.quality),
            quality_lowest: self.quality_lowest.min(other.quality_lowest),
            stats,
            ..self
        }
    }
}

fn ate(part: &[&Record]) -> Option<f64> {
    let estimated: Vec<TimedPose> = part.iter().filter_map(|r| r.estimate).collect();
    let truth: Vec<TimedPose> = part.iter().map(|r| r.truth).collect();
    trajectory_error(&estimated, &truth).map(|e| e.ate_rmse_m)
}

/// Error of the estimated motion from one record to another, m.
fn jump(a: &Record, b: &Record) -> Option<f64> {
    let moved = a.estimate?.pose.inverse() * b.estimate?.pose;
    let truly = a.truth.pose.inverse() * b.truth.pose;
    Some((truly.inverse() * moved).p.length())
}

/// Whether a record says that it is not to be relied on.
fn warns(r: &Record) -> bool {
    r.health.0 & !Health::NORMAL.0 != 0 || r.quality <= QUALITY_LOW
}

/// The largest error of the motion that stands for `FOLLOWED_FRAMES` in an estimate which can be relied on, m: from the last
/// pose before frame `from`, and after a reset from the first pose that does not warn, since a reset says that nothing before it counts.
fn unannounced(records: &[Record], from: usize) -> f64 {
    let mut reference: Option<&Record> = None;
    let (mut clean, mut errors, mut most) = (0, vec![], 0.0);
    for r in records {
        clean = if warns(r) || r.estimate.is_none() { 0 } else { clean + 1 };
        let since = reference.filter(|since| since.resets == r.resets && r.frame >= from);
        if since.is_none() {
            reference = r.estimate.filter(|_| r.frame < from || !warns(r)).and(Some(r));
        }
        match since.and_then(|since| jump(since, r)).filter(|_| clean >= CLEAN_FRAMES) {
            Some(error) => errors.push(error),
            None => errors.clear(),
        }
        let standing = errors.iter().rev().take(FOLLOWED_FRAMES).copied().fold(f64::INFINITY, f64::min);
        most = if errors.len() >= FOLLOWED_FRAMES { standing.max(most) } else { most };
    }
    most
}

/// Time from the first pose that follows a reset until the quality agrees with the error of the velocity and stays so until
/// the next reset, s; the longest of a flight. `None` without such a pose, infinite where the flight ends in disagreement.
fn agrees_after(records: &[Record]) -> Option<f64> {
    let ends = records.last()?.frame;
    let lives = records.chunk_by(|a, b| a.resets == b.resets).filter(|life| life[0].resets > 0);
    let settled = lives.filter_map(|life| {
        let poses: Vec<_> = life.iter().filter_map(|r| Some((r, r.velocity_error?))).collect();
        let (first, _) = poses.first()?;
        let rms = |r: &Record| {
            let near = poses.iter().filter(|(other, _)| (other.truth.t - r.truth.t).0.abs() <= EITHER_SIDE);
            let (sum, n) = near.fold((0.0, 0.0), |(sum, n), (_, e)| (sum + e * e, n + 1.0));
            (sum / f64::max(n, 1.0)).sqrt()
        };
        let last = poses.iter().rfind(|(r, _)| !agrees(r.quality, rms(r)));
        Some(last.map_or(0.0, |(r, _)| match r.frame {
            frame if frame == ends => f64::INFINITY,
            frame => (frame + 1 - first.frame) as f64 * FRAME_SECS,
        }))
    });
    settled.reduce(f64::max)
}

/// A flight as a row. `None`: the fault is the whole flight.
fn judge(case: &Case, records: &[Record], vio: &Vio) -> Row {
    let fault = case.fault;
    let (from, to) = fault.unwrap_or((0, 0));
    let lasts = to == usize::MAX;
    let before: Vec<&Record> = records.iter().filter(|r| r.frame < from).collect();
    let after: Vec<&Record> = records.iter().filter(|r| r.frame >= if lasts { from } else { to }).collect();
    let first_after = if lasts { from + JUMP_FRAMES } else { to };
    let started: Vec<&Record> = records.iter().skip_while(|r| r.estimate.is_none()).collect();
    let last = before.iter().rev().find(|r| r.estimate.is_some());
    let next = records.iter().find(|r| r.frame >= first_after && r.estimate.is_some());
    let restart =
        records.windows(2).filter(|w| w[0].estimate.is_none() && w[0].resets > 0).find(|w| w[1].estimate.is_some());
    let mut health = Health::default();
    started.iter().for_each(|r| health.set(r.health, true));
    let mut of: Vec<u8> = if fault.is_some() { &before } else { &started }
        .iter()
        .filter(|r| r.estimate.is_some())
        .map(|r| r.quality)
        .collect();
    of.sort_unstable();
    let mut row = Row {
        name: case.name,
        expect: case.expect,
        limits: case.limits,
        says: case.health,
        lasts,
        verdict: Verdict::Survived,
        before: ate(&before),
        after: ate(&after),
        jump: last.zip(next).filter(|_| fault.is_some()).and_then(|(a, b)| jump(a, b)),
        unannounced: fault.map(|_| unannounced(records, from)),
        restart_sigmas: restart.and_then(|w| w[1].position_sigmas),
        agrees_after: agrees_after(records),
        stats: *vio.stats(),
        health,
        quality: of.get(of.len() / 2).copied().unwrap_or(0),
        quality_lowest: started.iter().map(|r| r.quality).min().unwrap_or(0),
    };
    let far = |v: Option<f64>, max: f64| v.is_none_or(|v| v > max);
    let wrong = far(row.after, row.limits.after) || row.jump.is_some_and(|j| j > row.limits.jump);
    let estimates = || after.iter().filter(|r| r.estimate.is_some());
    let said = estimates().filter(|r| warns(r)).count() as f64 >= SAID_SHARE * estimates().count() as f64;
    row.verdict = match (row.stats.resets > 0, wrong, said) {
        (true, ..) => Verdict::Reset,
        (_, false, _) => Verdict::Survived,
        (_, true, true) => Verdict::Detected,
        (_, true, false) => Verdict::Missed,
    };
    row
}

fn worst_of(rows: impl Iterator<Item = Row>) -> Option<Row> {
    rows.reduce(Row::worst)
}

/// Cases whose name contains `only`, flown with each seed.
pub fn rows(seeds: &[u64], only: &str) -> Result<Vec<Row>, Fault> {
    let mut rows = Vec::new();
    for case in cases::all().into_iter().filter(|case| case.name.contains(only)) {
        rows.extend(worst_of(seeds.iter().map(|seed| {
            let (records, vio) = record(&case.plan, *seed);
            judge(&case, &records, &vio)
        })));
    }
    rows.extend(rendered::rows(only)?);
    Ok(rows)
}

/// Every case on made-up tracks, frame by frame.
pub fn flights(seed: u64) -> Vec<Vec<Record>> {
    cases::all().iter().map(|case| record(&case.plan, seed).0).collect()
}

const NOTE: &str = "Errors are of the part of the flight before and of the part after the fault, each aligned on its own (ATE), and of the motion across it (jump). Survived: within the stated bounds, without a reset. Detected: wrong, and health or quality say so. Unannounced: the largest error of the motion since before the fault, or since the first pose after the reset that warns of nothing, that stands for more than a tenth of a second while nothing warns of it; 100 mm at most, which a drone that holds its place can bear. Restart: distance of its position from the truth in its own covariance (3 dimensions). Quality agrees: seconds from the first pose that follows a reset until the quality claims no more than one bin of the reliability diagram above what the velocity's root mean square error over half a second earns, and stays so (3 s at most; a more modest claim agrees). Bold: not as expected.";

fn shown_seconds(s: f64) -> String {
    if s.is_finite() {
        format!("{s:.2}")
    } else {
        "never".into()
    }
}

pub fn table(rows: &[Row]) -> Table {
    table!("stability", "Cases", rows, |r| r.complaint().is_some(), [
        text("case") => r.name,
        text("verdict") => r.verdict.name(),
        text("expected") => r.expect.name(),
        millimetres("before", 1) => r.before,
        millimetres("after", 1) => r.after,
        millimetres("jump", 1) => r.jump,
        millimetres("unannounced", 1) => r.unannounced,
        number("restart", "sigma", 1) => r.restart_sigmas,
        text("quality agrees after, s") => r.agrees_after.map_or(String::new(), shown_seconds),
        count("quality") => r.quality,
        count("lowest quality") => r.quality_lowest,
        text("said") => r.health.reasons().collect::<Vec<_>>().join(" "),
    ])
}

/// The estimator's counters in each case.
fn counters(rows: &[Row]) -> Table {
    let names = rows.first().map_or(vec![], |r| r.stats.list().iter().map(|c| count(c.0)).collect());
    Table::new("counters", "Counters", rows, &[vec![text("case")], names].concat(), |r| {
        let counts = r.stats.list().into_iter().map(|c| c.1.into());
        (false, std::iter::once(r.name.into()).chain(counts).collect())
    })
}

/// Outcome of everything that may go wrong on a flight, for odometry and for the map: one row a case
#[derive(clap::Args)]
pub struct Args {
    /// Folder for the results
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Flights of each case; the worst is shown
    #[arg(long, value_name = "N", default_value = "5", value_parser = clap::value_parser!(u64).range(1..=1000))]
    seeds: u64,
    /// Only cases whose name contains this
    #[arg(long, value_name = "TEXT", default_value = "")]
    only: String,
    /// 100 000 training steps in the map's longest case, not 2000: 20 s on a GPU
    #[arg(long)]
    long: bool,
}

pub fn run(args: &Args) -> Result<(), Fault> {
    let out = OutputDir::create(&args.out)?;
    let seeds: Vec<u64> = (1..=args.seeds).collect();
    let only = args.only.as_str();
    let rows = rows(&seeds, only)?;
    let (steps, maps) = (steps::rows(only)?, mapping::rows(args.long, only)?);
    if rows.is_empty() && steps.is_empty() && maps.is_empty() {
        let fix = "the first column of the tables has the names; without --only all cases are flown";
        return Err(Fault::new(FaultKind::Usage, "--only", format!("no case has {only:?} in its name"), fix));
    }
    let shown = [table(&rows), steps::table(&steps), mapping::table(&maps)];
    shown.iter().for_each(|table| println!("{}", table.text()));
    let [odometry, kernels, map] = shown;
    let page = Page {
        name: "stability",
        title: "Stability",
        what: format!(
            "odometry: {} cases, made-up tracks are the worst of {} seeded flights each; kernels: {}; map: {}",
            rows.len(),
            seeds.len(),
            steps.len(),
            maps.len()
        ),
        facts: vec![],
        parts: vec![
            Part::Note(NOTE.into()),
            Part::Table(odometry),
            Part::Table(counters(&rows)),
            Part::Note(steps::NOTE.into()),
            Part::Table(kernels),
            Part::Note(mapping::NOTE.into()),
            Part::Table(map),
        ],
    };
    page.write(&out)?;
    println!("{}", out.file("stability.html").display());
    let mut complaints: Vec<String> = rows.iter().filter_map(Row::complaint).collect();
    complaints.extend(steps.iter().filter_map(steps::Row::complaint));
    complaints.extend(maps.iter().filter_map(mapping::Row::complaint));
    missed("stability", &complaints)
}
