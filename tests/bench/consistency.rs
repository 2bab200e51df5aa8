//! `stipple-bench consistency`: are the errors as large as the covariance says, and does quality mean
//! something.
//!
//! Consistency: normalised estimation error squared (NEES, eᵀ P⁻¹ e) of all fifteen errors over seeded
//! flights of a world made as the estimator is told, mean over flights at each instant, beside its 95 %
//! bounds (χ² of 15 N dimensions over N; Bar-Shalom et al. 2001, 5.4). The world of the estimate is tied to
//! the truth by position and yaw of the first estimate, so position errors are relative to the start, and blocks are means from
//! a second after it on.
//!
//! Reliability: every frame of the flights of the stability table, by its quality, beside the error of its
//! velocity and the error of its motion over the next second.

use crate::flight::{errors, estimate_from_truth, fly, from_rest, Plan, Record};
use crate::page::{count, millimetres, number, percent, text, Page, Part, Table};
use crate::stability;
use crate::table;
use nalgebra::{Matrix3, SMatrix, SVector, Vector3};
use std::path::PathBuf;
use stipple::config::VioConfig;
use stipple::output::chart::{Chart, Series};
use stipple::output::metrics::percentile;
use stipple::output::OutputDir;
use stipple_drivers::Fault;

type Mat15 = SMatrix<f64, 15, 15>;
type Vec15 = SVector<f64, 15>;

const DIM: f64 = 15.0;
/// Two-sided 95 % of a normal distribution.
const Z: f64 = 1.96;
/// Standard deviations of the biases with which a flight starts, rad/s and m/s²: EuRoC's unit. The estimator is
/// told the same where it is told the truth.
pub const BIASES: (f64, f64) = (0.02, 0.05);
/// One second, in frames.
const SECOND: usize = 20;
/// Upper ends of the bins of quality.
const BINS: [u8; 9] = [2, 10, 20, 35, 50, 65, 75, 85, 100];
/// Error of the velocity that earns a quality of 50, m/s: that of the formula of `quality`.
const HALF: f64 = 0.05;

/// Whether a quality claims no more than an error of the velocity earns, m/s, or at most one bin above it. What is more
/// modest agrees: landmarks may be few, and doubt says more than the error.
pub fn agrees(quality: u8, velocity_error: f64) -> bool {
    let bin = |quality: u8| BINS.partition_point(|to| *to < quality);
    bin(quality) <= bin((100.0 / (1.0 + velocity_error / HALF)).round() as u8) + 1
}

/// The world's own noise of views and biases.
pub fn told(c: &mut VioConfig) {
    c.observation_sigma_px = crate::world::SIGMA_PX;
    (c.gyro_bias_sigma, c.accel_bias_sigma) = BIASES;
}

/// NEES of many flights.
#[derive(Clone, Debug, Default)]
pub struct Consistency {
    pub flights: usize,
    /// Mean over the flights, by time since the start, s.
    pub over_time: Vec<(f64, f64)>,
    pub mean: f64,
    /// NEES of position, rotation, velocity, gyro and accelerometer bias, three dimensions each, from a second after the start on:
    /// until then the tie to the truth makes most of the position's error zero.
    pub blocks: [f64; 5],
    /// The same by second since the start, the first included.
    pub by_second: Vec<[f64; 5]>,
    /// 95 % of the means at one instant lie between these.
    pub bounds: (f64, f64),
    /// Share of the instants that do.
    pub within: f64,
    /// Estimates without a covariance that is symmetric and positive definite.
    pub undetermined: usize,
}

/// χ² of `k` dimensions at `z` standard deviations of a normal (Wilson and Hilferty 1931).
fn chi_square(k: f64, z: f64) -> f64 {
    let v = 2.0 / (9.0 * k);
    k * (1.0 - v + z * v.sqrt()).powi(3)
}

/// Bounds of 95 % of the means over flights of a NEES of so many dimensions.
pub fn bounds(dimensions: f64, flights: usize) -> (f64, f64) {
    let bound = |z: f64| chi_square(dimensions * flights as f64, z) / flights as f64;
    (bound(-Z), bound(Z))
}

fn consistency_of(measured: bool, biases: (f64, f64), config: fn(&mut VioConfig), flights: usize) -> Consistency {
    let plan = Plan { pose: from_rest, biases: Some(biases), measured, config, ..Plan::default() };
    let mut sums: Vec<(f64, usize)> = vec![(0.0, 0); plan.frames];
    let mut by_second: Vec<([f64; 5], usize)> = vec![];
    let (mut n, mut undetermined) = (0, 0);
    for seed in 0..flights as u64 {
        let mut to_estimate = None;
        let mut start = None;
        fly(&plan, seed, |seen| {
            let Some(o) = seen.update.odometry else { return };
            undetermined += 1;
            let Some(c) = seen.vio.covariance() else { return };
            let moved = *to_estimate.get_or_insert_with(|| estimate_from_truth(&o.world_from_body, &seen.truth.pose));
            let Some(e) = errors(seen, &moved) else { return };
            let first = *start.get_or_insert(seen.frame);
            let vector = Vec15::from_fn(|i, _| e[i / 3][i % 3]);
            let covariance = Mat15::from_fn(|i, j| c[i][j]);
            if (covariance - covariance.transpose()).norm() > 1e-9 * covariance.norm() {
                return;
            }
            let Some(factor) = covariance.cholesky() else { return };
            undetermined -= 1;
            let at = &mut sums[seen.frame - first];
            (at.0, at.1, n) = (at.0 + vector.dot(&factor.solve(&vector)), at.1 + 1, n + 1);
            by_second.resize(by_second.len().max((seen.frame - first) / SECOND + 1), ([0.0; 5], 0));
            let (sums, count) = &mut by_second[(seen.frame - first) / SECOND];
            *count += 1;
            for (b, sum) in sums.iter_mut().enumerate() {
                let block = Matrix3::from_fn(|i, j| c[3 * b + i][3 * b + j]);
                let e = Vector3::new(e[b].x, e[b].y, e[b].z);
                *sum += block.cholesky().map_or(0.0, |f| e.dot(&f.solve(&e)));
            }
        });
    }
    let later = by_second.get(1..).unwrap_or_default();
    let counted = later.iter().map(|(_, n)| *n).sum::<usize>().max(1) as f64;
    let seconds = |i: usize| i as f64 / SECOND as f64;
    let whole = sums.iter().enumerate().filter(|(_, s)| s.1 == flights);
    let over_time: Vec<(f64, f64)> = whole.map(|(i, s)| (seconds(i), s.0 / s.1 as f64)).collect();
    let bounds = bounds(DIM, flights);
    let inside = over_time.iter().filter(|(_, v)| (bounds.0..=bounds.1).contains(v)).count();
    Consistency {
        flights,
        mean: sums.iter().map(|s| s.0).sum::<f64>() / f64::from(n.max(1)),
        blocks: std::array::from_fn(|b| later.iter().map(|(sums, _)| sums[b]).sum::<f64>() / counted),
        by_second: by_second.iter().map(|(sums, n)| sums.map(|sum| sum / *n as f64)).collect(),
        bounds,
        within: inside as f64 / over_time.len().max(1) as f64,
        undetermined,
        over_time,
    }
}

/// NEES of an estimator told the world's own noise, that of the unit as measured.
pub fn told_the_truth(flights: usize) -> Consistency {
    consistency_of(true, BIASES, told, flights)
}

/// NEES of the same with the figures of the unit stated as those of a data sheet, whose allowance widens what is true.
pub fn told_a_data_sheet(flights: usize) -> Consistency {
    consistency_of(false, BIASES, told, flights)
}

/// NEES of the default settings with a unit whose noise was measured.
pub fn at_the_defaults_measured(flights: usize) -> Consistency {
    consistency_of(true, BIASES, |_| {}, flights)
}

/// NEES of the same with biases as large as the default settings expect.
pub fn at_the_defaults_expected(flights: usize) -> Consistency {
    let VioConfig { gyro_bias_sigma, accel_bias_sigma, .. } = VioConfig::default();
    consistency_of(true, (gyro_bias_sigma, accel_bias_sigma), |_| {}, flights)
}

/// NEES of the default settings, which claim less than they know.
pub fn at_the_defaults(flights: usize) -> Consistency {
    consistency_of(false, BIASES, |_| {}, flights)
}

/// Errors of the frames within a range of quality.
#[derive(Clone, Copy, Debug)]
pub struct Bin {
    /// Both ends belong to it.
    pub from: u8,
    pub to: u8,
    pub frames: usize,
    /// Error of the velocity in the body's frame, m/s.
    pub velocity: f64,
    pub velocity_p90: f64,
    /// Error of the motion over the next second, m: mean, median, 90 %.
    pub drift: f64,
    pub drift_p50: f64,
    pub drift_p90: f64,
}

fn drift(a: &Record, b: &Record) -> Option<f64> {
    let moved = a.estimate?.pose.inverse() * b.estimate?.pose;
    let truly = a.truth.pose.inverse() * b.truth.pose;
    Some((truly.inverse() * moved).p.length())
}

/// The reliability diagram of flights.
pub fn reliability(flights: &[Vec<Record>]) -> Vec<Bin> {
    by_quality(flights, &BINS)
}

/// The same with bins of one's own, by their upper ends.
pub fn by_quality(flights: &[Vec<Record>], ends: &[u8]) -> Vec<Bin> {
    // Quality, velocity error, drift.
    let mut seen: Vec<(u8, f64, f64)> = Vec::new();
    for records in flights {
        for (i, r) in records.iter().enumerate() {
            let later = records[i..].iter().find(|l| l.frame == r.frame + SECOND);
            if let (Some(v), Some(d)) = (r.velocity_error, later.and_then(|l| drift(r, l))) {
                seen.push((r.quality, v, d));
            }
        }
    }
    let mut from = 0;
    let mut bins = Vec::new();
    for &to in ends {
        let of = |f: &dyn Fn(&(u8, f64, f64)) -> f64| -> Vec<f64> {
            seen.iter().filter(|s| (from..=to).contains(&s.0)).map(f).collect()
        };
        let (v, d) = (of(&|s| s.1), of(&|s| s.2));
        let mean = |x: &[f64]| x.iter().sum::<f64>() / x.len() as f64;
        let rank = |x: &[f64], p: f64| percentile(x, p).unwrap_or(f64::NAN);
        if !v.is_empty() {
            let (velocity, velocity_p90) = (mean(&v), rank(&v, 0.9));
            let (drift, drift_p50, drift_p90) = (mean(&d), rank(&d, 0.5), rank(&d, 0.9));
            bins.push(Bin { from, to, frames: v.len(), velocity, velocity_p90, drift, drift_p50, drift_p90 });
        }
        from = to + 1;
    }
    bins
}

/// NEES of estimators that are told the world's own noise, or are at the defaults, with the unit's as measured or as a data
/// sheet's.
pub fn summary(all: [&Consistency; 5]) -> Table {
    let names = [
        "told the world's own noise",
        "told, the unit's as a data sheet's",
        "at the defaults, the unit's as measured",
        "the same, biases as large as expected",
        "at the defaults",
    ];
    let rows = names.into_iter().zip(all);

    table!("consistency", "NEES", rows, |r| false, [
        text("estimator") => r.0,
        count("flights") => r.1.flights,
        number("NEES of 15", "", 2) => r.1.mean,
        number("lower bound", "", 2) => r.1.bounds.0,
        number("upper bound", "", 2) => r.1.bounds.1,
        percent("instants within", 0) => r.1.within,
        number("position of 3", "", 2) => r.1.blocks[0],
        number("rotation of 3", "", 2) => r.1.blocks[1],
        number("velocity of 3", "", 2) => r.1.blocks[2],
        number("gyro bias of 3", "", 2) => r.1.blocks[3],
        number("accelerometer bias of 3", "", 2) => r.1.blocks[4],
        count("without covariance") => r.1.undetermined,
    ])
}

fn by_instant(told: &Consistency, defaults: &Consistency) -> Table {
    let rows = told.over_time.iter().zip(&defaults.over_time);
    table!("nees", "NEES by instant", rows, |r| false, [
        number("time", "s", 2) => r.0.0,
        number("NEES told", "", 4) => r.0.1,
        number("NEES at the defaults", "", 4) => r.1.1,
    ])
}

fn by_second(told: &Consistency) -> Table {
    let rows = told.by_second.iter().enumerate();
    table!("nees-by-second", "NEES by second since the start, told the world's own noise", rows, |r| false, [
        count("from") => r.0,
        number("position of 3", "", 2) => r.1[0],
        number("rotation of 3", "", 2) => r.1[1],
        number("velocity of 3", "", 2) => r.1[2],
        number("gyro bias of 3", "", 2) => r.1[3],
        number("accelerometer bias of 3", "", 2) => r.1[4],
    ])
}

pub fn diagram(bins: &[Bin]) -> Table {
    table!("reliability", "By quality", bins, |b| false, [
        count("quality from") => b.from,
        count("quality to") => b.to,
        count("frames") => b.frames,
        number("velocity error", "mm/s", 1) => 1e3 * b.velocity,
        number("velocity error 90 %", "mm/s", 1) => 1e3 * b.velocity_p90,
        millimetres("drift over 1 s", 1) => b.drift,
        millimetres("drift median", 1) => b.drift_p50,
        millimetres("drift 90 %", 1) => b.drift_p90,
    ])
}

fn page(all: [&Consistency; 5], bins: &[Bin]) -> Page {
    let [told, _, _, _, defaults] = all;
    let frames: usize = bins.iter().map(|b| b.frames).sum();
    let nees = Chart {
        title: "NEES of 15 errors, mean over the flights",
        x: "time since the start, s",
        y: "NEES",
        series: vec![
            Series::line("told the world's noise", 1, told.over_time.clone()),
            Series::line("defaults", 2, defaults.over_time.clone()),
        ],
        levels: vec![("2.5 %", told.bounds.0), ("97.5 %", told.bounds.1)],
        from_zero: true,
        ..Chart::default()
    };
    let middle = |b: &Bin| f64::from(b.from + b.to) / 2.0;
    // Errors span four decades: drawn by their logarithm.
    let by = |f: &dyn Fn(&Bin) -> f64| -> Vec<(f64, f64)> {
        bins.iter().map(|b| (middle(b), f(b).max(1e-5).log10())).collect()
    };
    // What the formula of `quality` claims, in full view of enough landmarks.
    let claimed: Vec<(f64, f64)> =
        (1..100).map(|q| (f64::from(q), (HALF * (100.0 / f64::from(q) - 1.0)).log10())).collect();
    let chart = |title, y, mean, high| {
        let series = vec![
            Series::dots("mean", 1, mean),
            Series::dots("90 %", 2, high),
            Series::dots("claimed", 3, claimed.clone()),
        ];
        Chart { title, x: "quality", y, series, ..Chart::default() }.svg()
    };
    let drift = chart("Error of the motion over the next second", "log10 m", by(&|b| b.drift), by(&|b| b.drift_p90));
    let velocity = chart("Error of the velocity", "log10 m/s", by(&|b| b.velocity), by(&|b| b.velocity_p90));
    Page {
        name: "consistency",
        title: "Odometry: consistency and quality",
        what: format!("{} seeded flights of 8 s from rest; {frames} frames of flights gone wrong", told.flights),
        facts: vec![],
        parts: vec![
            Part::Note("At the defaults the estimator claims less than it knows, on purpose.".into()),
            Part::Charts("Consistency", vec![nees.svg()]),
            Part::Table(summary(all)),
            Part::Table(by_second(told)),
            Part::Charts("Quality against actual error", vec![drift, velocity]),
            Part::Table(diagram(bins)),
            Part::Table(by_instant(told, defaults)),
        ],
    }
}

/// Errors beside what the covariance claims, and beside the quality
#[derive(clap::Args)]
pub struct Args {
    /// Folder for the results
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Seeded flights
    #[arg(long, value_name = "N", default_value = "50", value_parser = clap::value_parser!(u64).range(2..=10_000))]
    flights: u64,
}

pub fn run(args: &Args) -> Result<(), Fault> {
    let (out, flights) = (OutputDir::create(&args.out)?, args.flights as usize);
    let settings =
        [told_the_truth, told_a_data_sheet, at_the_defaults_measured, at_the_defaults_expected, at_the_defaults];
    let all = settings.map(|f| f(flights));
    let seeds = (flights as u64).div_ceil(10);
    let bins = reliability(&(1..=seeds).flat_map(stability::flights).collect::<Vec<_>>());
    page(all.each_ref(), &bins).write(&out)?;
    let tables = [summary(all.each_ref()), by_second(&all[0]), diagram(&bins)];
    tables.iter().for_each(|table| println!("{}\n", table.text()));
    println!("{}", out.file("consistency.html").display());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_are_those_of_tables() {
        // χ² of 10 dimensions: 3.247 and 20.483; of 100: 74.22 and 129.56.
        for (k, low, high) in [(10.0, 3.247, 20.483), (100.0, 74.22, 129.56)] {
            assert!((chi_square(k, -Z) - low).abs() < 0.01 * low && (chi_square(k, Z) - high).abs() < 0.01 * high);
        }
    }

    /// Errors that are larger than stated in one block must not hide behind smaller ones in another.
    #[test]
    fn errors_are_as_large_as_the_covariance_of_an_estimator_told_the_truth() {
        let flights = 16;
        let told = told_the_truth(flights);
        eprintln!("mean {} in {:?}, blocks {:?}", told.mean, told.bounds, told.blocks);
        assert_eq!(told.undetermined, 0, "every covariance is symmetric and positive definite");
        assert!((told.bounds.0..=told.bounds.1).contains(&told.mean), "{} is outside {:?}", told.mean, told.bounds);
        // Errors of one flight are alike at all its instants, so that flights are what there is of them.
        let bound = |z: f64| chi_square(3.0 * flights as f64, z) / flights as f64;
        assert!(told.blocks.iter().all(|b| (bound(-Z)..=bound(Z)).contains(b)), "{:?}", told.blocks);
    }

    /// The allowance for a data sheet must not reach a unit whose noise was measured: of true figures it makes an estimate
    /// that claims less than it knows.
    #[test]
    fn the_allowance_for_a_data_sheet_widens_true_figures_and_stating_them_as_measured_takes_it_away() {
        let (measured, sheet) = (told_the_truth(4), told_a_data_sheet(4));
        eprintln!("measured {} {:?}, data sheet {} {:?}", measured.mean, measured.blocks, sheet.mean, sheet.blocks);
        assert!((measured.bounds.0..=measured.bounds.1).contains(&measured.mean), "{measured:?}");
        assert!(sheet.mean < sheet.bounds.0 && sheet.mean < measured.mean, "{} {}", sheet.mean, measured.mean);
    }

    /// Who fuses the estimate gates it by its deviations: none may be smaller than the errors are, and none more than
    /// four times as large, or what should be refused passes.
    #[test]
    fn defaults_claim_less_than_they_know() {
        let defaults = at_the_defaults(4);
        eprintln!("mean {}, blocks {:?}", defaults.mean, defaults.blocks);
        assert!(defaults.undetermined == 0 && (1.0..defaults.bounds.0).contains(&defaults.mean));
        assert!(defaults.blocks.iter().all(|b| (3.0 / 16.0..3.0).contains(b)), "{:?}", defaults.blocks);
    }

    #[test]
    fn error_falls_as_quality_rises() {
        // Few frames lie between 10 and 20: those of a start that is not trusted yet, which may be as good as others.
        let (flights, _) = stability::tests::flown();
        let bins = by_quality(flights, &[20, 65, 100]);
        assert_eq!(bins.len(), 3);
        for pair in bins.windows(2) {
            let [a, b] = pair else { continue };
            eprintln!("{a:?}");
            assert!(a.velocity > b.velocity, "velocity: {a:?} {b:?}");
            // Noise of the mean: a tenth.
            assert!(a.drift > 0.9 * b.drift, "drift: {a:?} {b:?}");
        }
        // What quality 20 and 65 claim, m/s.
        assert!(bins[1].velocity < 0.2 && bins[2].velocity < 0.027, "{bins:?}");
    }
}
