//! `stipple-bench stereo`: every method of disparity on pairs whose truth is known.
//!
//! Sets are Middlebury's cones and teddy, simulated flights (also by range of depth), pairs for time alone, and
//! the hard cases. `score` states the protocol, `flights` what is flown. Given a recording, each method also makes a map of it (`effect`).
//! Besides the page it leaves `pictures/`.

mod effect;
mod flights;
mod methods;
mod page;
mod pictures;
mod scenes;
mod score;
mod sets;
#[cfg(all(test, feature = "opencv"))]
mod tests;

use crate::inputs::Folders;
use crate::run::Source;
use effect::Effect;
pub use methods::{Base, Runner, NAMES};
use score::Score;
use sets::Set;
use std::path::PathBuf;
use stipple::config::Board;
use stipple::output::metrics::percentile;
use stipple::output::panel::Picture;
use stipple::output::{atomically, OutputDir};
use stipple::stereo::Disparity;
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::Fault;

/// Depths that simulated flights are judged by, m.
const RANGES_M: [f64; 6] = [0.5, 1.0, 2.0, 4.0, 8.0, 20.0];
/// Pairs for time alone: disparities at 752x480, how often, and when fewer will do, ms.
const TIMED: [u32; 2] = [64, 128];
const REPEATS: usize = 5;
const LONG_MS: f64 = 5000.0;
/// The sets of a quick run.
const QUICK: [&str; 2] = ["hard_occlusion", "hard_black_eye"];

/// Disparity of every method against truth: Middlebury, simulated flights, hard cases, time
#[derive(clap::Args)]
pub struct Args {
    /// Recording of which each method makes a map, too
    dataset: Option<PathBuf>,
    #[command(flatten)]
    folders: Folders,
    /// Board file whose [stereo] and [gpu] to use, and of the map the rest; the methods' own defaults without it
    #[arg(long, value_name = "FILE")]
    board: Option<PathBuf>,
    /// Skip odometry in the maps, as for replay
    #[arg(long, value_name = "CSV", requires = "dataset")]
    poses: Option<PathBuf>,
    /// Seconds of mapping with each method
    #[arg(long, value_name = "S", value_parser = crate::seconds, requires = "dataset")]
    seconds: Option<f64>,
    /// Override a key of the board file
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
    set: Vec<String>,
    /// Two hard cases
    #[arg(long)]
    quick: bool,
}

/// Time of mapping when not stated, s.
const MAPPING_S: f64 = 60.0;

/// A method on a set.
pub struct Row {
    pub set: String,
    pub method: &'static str,
    pub score: Score,
    /// Median wall time of a pair.
    pub ms: f64,
    pub bytes: u64,
    pub device: String,
}

#[derive(Default)]
pub struct Bench {
    /// Name and what it is.
    pub sets: Vec<(String, String)>,
    pub rows: Vec<Row>,
    pub pictures: Vec<(String, Picture)>,
    /// Methods that are not to be had here, and why.
    pub left_out: Vec<(&'static str, String)>,
    pub maps: Vec<Effect>,
}

pub fn run(args: &Args) -> Result<(), Fault> {
    let Args { dataset, board, poses, set, .. } = args;
    let loaded = board.as_deref().map(|path| Board::load(path, set)).transpose()?;
    // A wrong folder is told now, not after the minutes that come before the maps.
    dataset.as_deref().map(|path| Recording::open(path, &OpenOptions::default())).transpose()?;
    let out = OutputDir::create(&args.folders.out)?;
    let sets = match args.quick {
        true => scenes::hard().into_iter().filter(|s| QUICK.contains(&s.name.as_str())).collect(),
        false => all_sets(&args.folders)?,
    };
    // After each method: whoever ends a run of many minutes early keeps what there is.
    let keep = |bench: &Bench| page::page(bench).write(&out);
    let mut bench = measure(&sets, &Base::of(loaded.as_ref()), &keep)?;
    if dataset.is_some() {
        let source = Source { dataset: dataset.clone(), board: board.clone(), poses: poses.clone(), set: set.clone() };
        bench.maps = effect::map(args.seconds.unwrap_or(MAPPING_S), &out, &source)?;
    }
    out.replace_folder("pictures", |dir| {
        bench.pictures.iter().try_for_each(|(name, p)| atomically(&dir.join(format!("{name}.png")), |w| p.write_png(w)))
    })?;
    page::page(&bench).finish(&out)
}

fn all_sets(folders: &Folders) -> Result<Vec<Set>, Fault> {
    let folder = folders.recordings()?;
    let mut sets = sets::middlebury(&folder)?;
    if sets.is_empty() {
        eprintln!("no Middlebury pairs in {}", folder.display());
    }
    sets.extend(flights::sets(&folder)?);
    sets.extend(scenes::hard());
    Ok(sets)
}

/// One method and size at a time, so that one matcher's memory and device are open at once. After each method `keep`
/// is shown what there is, so that an interrupted run leaves it.
fn measure(sets: &[Set], base: &Base, keep: &dyn Fn(&Bench) -> Result<(), Fault>) -> Result<Bench, Fault> {
    let mut bench =
        Bench { sets: sets.iter().map(|s| (s.name.clone(), s.about.clone())).collect(), ..Bench::default() };
    for method in NAMES {
        let mut ranges = [Score::default(); RANGES_M.len() - 1];
        let mut of_range: Option<Row> = None;
        let mut done = vec![false; sets.len()];
        while let Some(next) = done.iter().position(|d| !d) {
            let shape = |s: &Set| (s.size(), s.disparities);
            let alike: Vec<usize> = (next..sets.len()).filter(|&i| shape(&sets[i]) == shape(&sets[next])).collect();
            alike.iter().for_each(|&i| done[i] = true);
            let mut runner = match Runner::new(method, base, sets[next].size(), sets[next].disparities) {
                Ok(runner) => runner,
                Err(fault) => {
                    eprintln!("{method} is left out: {fault}");
                    bench.left_out.push((method, fault.to_string()));
                    break;
                }
            };
            for i in alike {
                let row = judge(&sets[i], method, &mut runner, &mut ranges, &mut bench.pictures)?;
                eprintln!("{}", row.line());
                if sets[i].name.starts_with("sim_") {
                    of_range = Some(Row { set: String::new(), ..row.like() });
                }
                bench.rows.push(row);
            }
            if sets[next].name.starts_with("sim_") {
                for disparities in TIMED {
                    let row = time(&sets[next], method, base, disparities)?;
                    eprintln!("{}", row.line());
                    bench.rows.push(row);
                }
            }
        }
        if let Some(row) = of_range {
            for (k, score) in ranges.into_iter().enumerate() {
                let set = format!("sim {} to {} m", RANGES_M[k], RANGES_M[k + 1]);
                let row = Row { set, score, ..row.like() };
                eprintln!("{}", row.line());
                bench.rows.push(row);
            }
        }
        keep(&bench)?;
    }
    Ok(bench)
}

/// A method on every pair of a set; a single one after a run to warm up.
fn judge(
    set: &Set,
    method: &'static str,
    runner: &mut Runner,
    ranges: &mut [Score],
    pictures: &mut Vec<(String, Picture)>,
) -> Result<Row, Fault> {
    let (w, h) = set.size();
    let mut found = Disparity::new(w, h);
    let mut score = Score::default();
    let mut ms = vec![];
    let fb = set.focal_baseline.unwrap_or(0.0);
    if set.pairs.len() == 1 {
        runner.run(&set.pairs[0].left, &set.pairs[0].right, &mut found)?;
    }
    for (k, pair) in set.pairs.iter().enumerate() {
        ms.push(runner.run(&pair.left, &pair.right, &mut found)?);
        score.add(pair, &found, [0.0, f64::INFINITY], fb);
        if set.name.starts_with("sim_") {
            for (range, ends) in ranges.iter_mut().zip(RANGES_M.windows(2)) {
                range.add(pair, &found, [fb / ends[1], fb / ends[0]], fb);
            }
        }
        if k == 0 {
            let picture = pictures::picture(pair, &found);
            pictures.push((format!("{}-{method}", set.name), picture));
        }
    }
    Ok(Row::of(set.name.clone(), method, score, &ms, runner))
}

/// The first pair of a set again and again, with another range of disparities.
fn time(set: &Set, method: &'static str, base: &Base, disparities: u32) -> Result<Row, Fault> {
    let mut runner = Runner::new(method, base, set.size(), disparities)?;
    let (w, h) = set.size();
    let (pair, mut found) = (&set.pairs[0], Disparity::new(w, h));
    let warm = runner.run(&pair.left, &pair.right, &mut found)?;
    let mut ms = vec![];
    while ms.len() < REPEATS && (ms.is_empty() || warm + ms.iter().sum::<f64>() < LONG_MS) {
        ms.push(runner.run(&pair.left, &pair.right, &mut found)?);
    }
    let mut score = Score::default();
    score.add(pair, &found, [0.0, f64::INFINITY], set.focal_baseline.unwrap_or(0.0));
    Ok(Row::of(format!("time {w}x{h}, {disparities} disparities"), method, score, &ms, &runner))
}

impl Row {
    /// `ms` of each pair.
    fn of(set: String, method: &'static str, score: Score, ms: &[f64], runner: &Runner) -> Row {
        let ms = percentile(ms, 0.5).unwrap_or(0.0);
        Row { set, method, score, ms, bytes: runner.bytes, device: runner.device.clone() }
    }

    /// Another set's, of the same method and device.
    fn like(&self) -> Row {
        Row { set: String::new(), device: self.device.clone(), ..*self }
    }

    fn line(&self) -> String {
        let percent = |v: Option<f64>| v.map_or("-".to_string(), |v| format!("{:.2} %", 100.0 * v));
        let (s, seen) = (&self.score.all, &self.score.visible);
        format!(
            "{:<28} {:<9} bad1 {:>8} bad2 {:>8} mean {:>6.3} px density {:>8} {:>8.1} ms  residual variance {} of {} px, \
             {} gross",
            self.set,
            self.method,
            percent(s.bad1()),
            percent(s.bad2()),
            s.mean_px().unwrap_or(f64::NAN),
            percent(s.density()),
            self.ms,
            seen.residual_variance().map_or("-".to_string(), |v| format!("{v:.2}")),
            seen.judged(),
            percent(seen.gross()),
        )
    }
}
