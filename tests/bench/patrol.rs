//! `stipple-bench patrol`: the map of a flight through a building that visits every room twice, by room and by visit.
//!
//! The flight is rendered as it is flown, in lockstep: nothing of it is stored, so the program's memory is all there is to
//! see. A keyframe belongs to the room that its true place is in and to the round of its stamp; a Gaussian to the room that
//! its mean is in, after the trajectory was put on the truth.

use crate::loops::with_mems;
use crate::page::{count, millimetres, number, percent, text, Page, Part, Table};
use crate::run::{default_board, settings_for};
use crate::{ply, table};
use glam::DVec3;
use serde_json::json;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::Arc;
use std::time::Instant;
use stipple::config::Board;
use stipple::map::{KeyframeScore, Mapper, Place, SeamScore, SeamScores};
use stipple::output::metrics::trajectory_error;
use stipple::output::report::{LoopClosed, Report};
use stipple::output::OutputDir;
use stipple::run::sensors::{Input, Source};
use stipple::run::{fly, KeyframesAt, Options, Pace, Spacing, Steps, MAP_STORE};
use stipple_drivers::replay::read_trajectory;
use stipple_drivers::sim::Scenario;
use stipple_drivers::types::pose_at;
use stipple_drivers::{host, Fault, FaultKind, Nanos, Pose, Span, TimedPose};

/// Keyframes at true poses: as many as the estimator makes.
const SPACING: Spacing = Spacing { moved_m: 0.5, turned_rad: 0.262, waited_s: 1.0 };
/// Every so many keyframes one is held out.
const HOLDOUT: u32 = 8;
/// Time of flight after which memory has to stay level, s.
const SETTLED_S: f64 = 60.0;
/// Truth has a pose every 5 ms.
const TRUTH_HOLE: Span = Span(100_000_000);

/// The map of a flight that visits every room of a building twice, by room and visit; flown in lockstep
#[derive(clap::Args)]
pub struct Args {
    /// Folder for the results
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// patrol (eight rooms, 10 min), patrol-two (two rooms, 85 s), twins or doors (places that look the same, 112 and 84 s)
    #[arg(long, value_name = "NAME", default_value = "patrol")]
    scenario: String,
    /// Where poses come from
    #[arg(long, value_enum, default_value = "odometry")]
    poses: Poses,
    /// With true poses: the keyframes are those that the map of an earlier patrol in this folder kept
    #[arg(long, value_name = "DIR")]
    keyframes_of: Option<PathBuf>,
    /// Board file; without it the one for Vulkan on the CPU. Settings for small images come on top: map.scale=1, frontend.grid_px=30
    #[arg(long, value_name = "FILE")]
    board: Option<PathBuf>,
    /// Mapping steps a frame
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u32).range(..=1000))]
    steps: u32,
    /// Score the map that an earlier patrol left in DIR/map, without flying
    #[arg(long)]
    again: bool,
    /// Seconds of the flight; without it all of it
    #[arg(long, value_name = "S", value_parser = crate::seconds)]
    seconds: Option<f64>,
    /// Stop in order once this frame is read, with the few that are read together with it
    #[arg(long, value_name = "N", conflicts_with = "abort_at")]
    stop_at: Option<usize>,
    /// Abort when this frame is read, before anything is done with it: nothing more is written, and --again scores what is left
    #[arg(long, value_name = "N")]
    abort_at: Option<usize>,
    /// Seed of the building and of the sensors' noise; without it the scenario's own
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// The inertial unit of a BMI088's data sheet in place of the scenario's
    #[arg(long)]
    mems: bool,
    /// Override a key of the board file
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
    set: Vec<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, clap::ValueEnum)]
enum Poses {
    /// The simulator's, a keyframe each 0.5 m, 15 degrees or second
    Truth,
    /// Those of the estimator
    Odometry,
}

/// Resident set in flight, bytes.
#[derive(Default)]
struct Resident {
    settled: AtomicU64,
    last: AtomicU64,
}

/// Means over the keyframes of a room in one round.
#[derive(Clone, Debug, Default, PartialEq)]
struct Visit {
    keyframes: usize,
    /// Training steps on the first camera's view of a keyframe that is trained on, until the end of the flight.
    steps: Option<f64>,
    psnr_db: Option<f64>,
    psnr_heldout_db: Option<f64>,
}

struct Row {
    room: &'static str,
    gaussians: usize,
    rounds: [Visit; 2],
}

pub fn run(args: &Args) -> Result<(), Fault> {
    let mut scenario = Scenario::named(&args.scenario).filter(|s| !s.rooms().is_empty()).ok_or_else(|| {
        let fix = "choose patrol, patrol-two, twins or doors";
        Fault::new(FaultKind::Usage, &args.scenario, "is not a flight through a building", fix)
    })?;
    let set = settings_for(&scenario, &args.set);
    let board = match &args.board {
        Some(path) => Board::load(path, &set)?,
        None => default_board(&set)?,
    };
    if let Some(s) = args.seconds {
        scenario.duration = scenario.duration.min(Span::from_secs(s));
    }
    scenario.seed = args.seed.unwrap_or(scenario.seed);
    if args.mems {
        scenario = with_mems(scenario);
    }
    let out = OutputDir::create(&args.out)?;
    if args.again {
        return again(&scenario, &board, &out);
    }
    let resident = Arc::new(Resident::default());
    let (seen, settled) = (resident.clone(), (SETTLED_S * scenario.rate_hz) as usize);
    let (stop_at, abort_at) = (args.stop_at, args.abort_at);
    let input = Input::simulated(&scenario, move |frame, of| {
        if stop_at == Some(frame) {
            host::stop_asked_for().store(true, Relaxed);
        }
        if abort_at == Some(frame) {
            std::process::abort();
        }
        if frame == settled.min(of) || frame == of {
            let bytes = host::rss_bytes().unwrap_or(0);
            let _ = seen.settled.compare_exchange(0, bytes, Relaxed, Relaxed);
            seen.last.store(bytes, Relaxed);
        }
    })?;
    let (truth, first) = (input.truth.clone(), first_stamp(&input));
    let pace = Pace::Lockstep(Steps::PerFrame(args.steps));
    let at_truth = match (args.poses, &args.keyframes_of) {
        (Poses::Truth, Some(folder)) => Some(KeyframesAt::Stamps(keyframes_of(folder)?)),
        (Poses::Truth, None) => Some(KeyframesAt::Spaced(SPACING)),
        (Poses::Odometry, None) => None,
        (Poses::Odometry, Some(_)) => {
            let problem = "is for flights at true poses";
            return Err(Fault::new(FaultKind::Usage, "--keyframes-of", problem, "add --poses truth"));
        }
    };
    let options = Options { pace, at_truth, holdout: HOLDOUT, fresh: true, ..Options::default() };
    let report = fly(input, &board, &out, &options, None)?.report;
    let estimated = read_trajectory(&out.file("trajectory.tum"))?;
    let world = trajectory_error(&estimated, &truth).map_or(Pose::IDENTITY, |e| e.truth_from_estimate);
    let map = out.file("map.ply");
    let means = if map.is_file() { ply::means(&map)? } else { vec![] };
    let means: Vec<DVec3> = means.into_iter().map(|p| world.transform(p)).collect();
    let rows = rows(&scenario, &truth, first, &report.quality.keyframe_scores, &means);
    let page = page(args, &report, &resident, rows);
    page.write(&out)?;
    Ok(())
}

/// Stamps of the keyframes that the map of a patrol kept.
fn keyframes_of(folder: &Path) -> Result<Vec<Nanos>, Fault> {
    let file = folder.join("report.json");
    let fix = "name the folder of a patrol that was flown";
    let fault = |e: String| Fault::new(FaultKind::NoInput, file.display().to_string(), e, fix);
    let text = std::fs::read_to_string(&file).map_err(|e| fault(e.to_string()))?;
    let report: Report = serde_json::from_str(&text).map_err(|e| fault(e.to_string()))?;
    let stamps: Vec<Nanos> = report.quality.keyframe_scores.iter().map(|score| Nanos(score.t_ns)).collect();
    (!stamps.is_empty()).then_some(stamps).ok_or_else(|| fault("has no keyframes".into()))
}

/// Scores what is in the store, and prints the rooms' rows.
fn again(scenario: &Scenario, board: &Board, out: &OutputDir) -> Result<(), Fault> {
    let input = Input::simulated(scenario, |_, _| ())?;
    let (folder, begun) = (out.file(MAP_STORE), Instant::now());
    let place = Place { folder: &folder, fresh: false, flight: None, at_once: true };
    let mut mapper = Mapper::open_on(&input.calibration, board, Some(place))?;
    if let Some(fault) = mapper.unkept.take() {
        return Err(fault);
    }
    println!("opened in {:.2} s, device included", begun.elapsed().as_secs_f64());
    let lost = |e| Fault::new(FaultKind::Unavailable, "the device", format!("{e}"), "see `stipple doctor`");
    let quality = mapper.evaluate().map_err(lost)?;
    let db = |psnr: Option<f64>| psnr.map_or("-".into(), |psnr| format!("{psnr:.2}"));
    let (training, held_out) = (db(quality.psnr_db), db(quality.psnr_heldout_db));
    println!("{} Gaussians; training {training} dB, held out {held_out} dB", mapper.splat_count());
    for row in rows(scenario, &input.truth, first_stamp(&input), &quality.keyframe_scores, &[]) {
        let [a, b] = &row.rounds;
        let figures = [a.psnr_db, a.psnr_heldout_db, b.psnr_db, b.psnr_heldout_db].map(db).join("  ");
        println!("{:10} {figures}", row.room);
    }
    Ok(())
}

fn first_stamp(input: &Input) -> Nanos {
    match &input.source {
        Source::Recorded(r) => r.stamps.first().copied().unwrap_or_default(),
        Source::Live { .. } => Nanos::default(),
    }
}

/// A row for each room, and one for what is in none.
fn rows(scenario: &Scenario, truth: &[TimedPose], first: Nanos, scores: &[KeyframeScore], means: &[DVec3]) -> Vec<Row> {
    let names = scenario.rooms().iter().map(|r| Some(r.name)).chain([None]);
    let place = |p: DVec3| scenario.room_at(p).unwrap_or(scenario.rooms().len());
    let second = scenario.second_round().unwrap_or_default();
    let mut seen: Vec<(usize, usize, &KeyframeScore)> = vec![];
    for score in scores {
        let t = Nanos(score.t_ns);
        let Some(pose) = pose_at(truth, t, TRUTH_HOLE) else { continue };
        seen.push((place(pose.p), usize::from((t - first).0 >= second.0), score));
    }
    let mut gaussians = vec![0; scenario.rooms().len() + 1];
    means.iter().for_each(|p| gaussians[place(*p)] += 1);
    let visit = |room: usize, round: usize| {
        let of: Vec<&KeyframeScore> = seen.iter().filter(|s| (s.0, s.1) == (room, round)).map(|s| s.2).collect();
        let mean = |held_out: bool, of_one: fn(&KeyframeScore) -> Option<f64>| {
            let values: Vec<f64> = of.iter().filter(|s| s.held_out == held_out).filter_map(|s| of_one(s)).collect();
            (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
        };
        Visit {
            keyframes: of.len(),
            steps: mean(false, |s| Some(f64::from(s.steps))),
            psnr_db: mean(false, |s| s.psnr_db),
            psnr_heldout_db: mean(true, |s| s.psnr_db),
        }
    };
    let row = |(k, name): (usize, Option<&'static str>)| Row {
        room: name.unwrap_or("elsewhere"),
        gaussians: gaussians[k],
        rounds: [0, 1].map(|round| visit(k, round)),
    };
    names.enumerate().map(row).collect()
}

const NOTE: &str = "Rounds 1 and 2 are the first and the second visit of every room. Keyframes are those that the map keeps at the end of the flight, each judged then; PSNR is the mean over them, of those trained on and of those held out; steps are the mean of those that are trained on, of their first camera, until the end.";

fn page(args: &Args, report: &Report, resident: &Resident, rows: Vec<Row>) -> Page {
    let [settled, last] = [&resident.settled, &resident.last].map(|bytes| bytes.load(Relaxed));
    let mib = |bytes: u64| bytes as f64 / 1048576.0;
    let ms = |v: Option<f64>| v.map_or("-".into(), |v| format!("{v:.1} ms"));
    let db = |v: Option<f64>| v.map_or("-".into(), |v| format!("{v:.2} dB"));
    let all = format!(
        "{} frames, {} keyframes, {} Gaussians, {} steps; a step {} at the median, {} at the 99th percentile; training {}, \
         held out {}, {} with the pose correction between their neighbours in time; resident set {:.1} MiB after \
         {SETTLED_S:.0} s of flight, {:.1} MiB at its end; {} allocations after boot; {:.1} MiB on the device; ATE {}; {:.0} s \
         in all",
        report.frames.unwrap_or(0),
        report.keyframes.unwrap_or(0),
        report.splats.unwrap_or(0),
        report.iterations.unwrap_or(0),
        ms(report.iteration_ms_p50),
        ms(report.iteration_ms_p99),
        db(report.quality.psnr_db),
        db(report.quality.psnr_heldout_db),
        db(report.quality.psnr_heldout_between_db),
        mib(settled),
        mib(last),
        report.heap_after_seal.unwrap_or(0),
        mib(report.gpu_bytes.unwrap_or(0)),
        report.ate_rmse_m.map_or("-".into(), |m| format!("{m:.3} m")),
        report.wall_s.unwrap_or(0.0),
    );
    let (table, seams) = (table(rows), seams_table(report));
    println!("{all}\n\n{}\n{}\n{}", table.text(), seams.text(), args.out.join("patrol.html").display());
    Page {
        name: "patrol",
        title: "Patrol: the map by room and visit",
        what: format!(
            "{}, poses by {:?}, {} steps a frame, {}",
            args.scenario,
            args.poses,
            args.steps,
            report.device.as_deref().unwrap_or("no map")
        ),
        facts: vec![
            ("scenario", json!(args.scenario)),
            ("keyframes", json!(report.keyframes)),
            ("gaussians", json!(report.splats)),
            ("iteration_ms_p50", json!(report.iteration_ms_p50)),
            ("iteration_ms_p99", json!(report.iteration_ms_p99)),
            ("psnr_db", json!(report.quality.psnr_db)),
            ("psnr_heldout_db", json!(report.quality.psnr_heldout_db)),
            ("psnr_heldout_between_db", json!(report.quality.psnr_heldout_between_db)),
            ("rss_settled_bytes", json!(settled)),
            ("rss_last_bytes", json!(last)),
            ("heap_after_seal", json!(report.heap_after_seal)),
            ("gpu_bytes", json!(report.gpu_bytes)),
            ("ate_rmse_m", json!(report.ate_rmse_m)),
        ],
        parts: vec![Part::Note(all), Part::Note(NOTE.into()), Part::Table(table), Part::Table(seams)],
    }
}

fn table(rows: Vec<Row>) -> Table {
    table!("patrol", "Rooms", rows, |r| r.room == "elsewhere", [
        text("room") => r.room,
        count("Gaussians") => r.gaussians,
        count("keyframes 1") => r.rounds[0].keyframes,
        number("steps 1", "", 0) => r.rounds[0].steps,
        number("PSNR 1", "dB", 2) => r.rounds[0].psnr_db,
        number("held out 1", "dB", 2) => r.rounds[0].psnr_heldout_db,
        count("keyframes 2") => r.rounds[1].keyframes,
        number("steps 2", "", 0) => r.rounds[1].steps,
        number("PSNR 2", "dB", 2) => r.rounds[1].psnr_db,
        number("held out 2", "dB", 2) => r.rounds[1].psnr_heldout_db,
    ])
}

/// Loops that moved the map: views of both visits, before, after and ten seconds later.
fn seams_table(report: &Report) -> Table {
    let start = report.loops.first().map_or(0, |l| l.t_ns);
    let scored: Vec<(&LoopClosed, SeamScores)> = report.loops.iter().filter_map(|l| Some((l, l.map?))).collect();
    let db = |score: Option<SeamScore>| score.and_then(|s| s.psnr_db);
    let share = |score: Option<SeamScore>| score.and_then(|s| s.disagreement);
    table!("seams", "Loops that moved the map", scored, |s| s.1.later.is_none(), [
        number("after the first", "s", 1) => Some((s.0.t_ns - start) as f64 * 1e-9),
        millimetres("moved", 0) => Some(s.0.moved_m),
        number("PSNR before", "dB", 2) => db(s.1.before),
        number("after", "dB", 2) => db(s.1.after),
        number("10 s later", "dB", 2) => db(s.1.later),
        percent("depth off stereo's before", 2) => share(s.1.before),
        percent("10 s after it", 2) => share(s.1.later),
    ])
}

#[cfg(test)]
mod tests {
    use super::*;
    use stipple_drivers::sim::Sim;

    #[test]
    fn keyframes_and_gaussians_are_counted_in_their_room_and_round() {
        let scenario = Scenario::named("patrol-two").expect("a scenario");
        let sim = Sim::new(&scenario).expect("it makes sense");
        let (truth, first) = (sim.truth(), sim.stamp(0));
        let score = |s: f64, held_out: bool, db: f64| KeyframeScore {
            t_ns: (first + Span::from_secs(s)).0,
            held_out,
            psnr_db: Some(db),
            steps: 10 * s as u32,
            ..KeyframeScore::default()
        };
        // In room a in the first round; in room b in the second.
        let scores =
            [score(11.0, false, 20.0), score(12.0, false, 22.0), score(13.0, true, 18.0), score(77.0, false, 25.0)];
        let means = [DVec3::new(3.0, 2.0, 1.0), DVec3::new(3.0, 50.0, 1.0)];
        let rows = rows(&scenario, &truth, first, &scores, &means);
        let visit = |keyframes, steps, psnr_db, psnr_heldout_db| Visit { keyframes, steps, psnr_db, psnr_heldout_db };
        assert_eq!(
            rows.iter().map(|r| (r.room, r.gaussians)).collect::<Vec<_>>(),
            [("room a", 1), ("room b", 0), ("corridor", 0), ("elsewhere", 1)]
        );
        assert_eq!(rows[0].rounds, [visit(3, Some(115.0), Some(21.0), Some(18.0)), Visit::default()]);
        assert_eq!(rows[1].rounds, [Visit::default(), visit(1, Some(770.0), Some(25.0), None)]);
    }
}
