//! `stipple-bench loops`: what recognising places is worth, and whether it errs.
//!
//! Flights, in lockstep, by odometry: the error of the whole trajectory with loops and without, what was closed,
//! and what was refused and why; a closure is false where it is off the truth. Places, at true poses: of the keyframes that
//! revisit a place, how many recognise it, by the angle between the two views. Cost: CPU time of each keyframe, and bytes,
//! with room for 2048 keyframes. Starts, resets and recordings: `relocalise`.

use crate::inputs::{self, Folders};
use crate::page::{count, millimetres, number, percent, text, Page, Part, Table};
use crate::relocalise::{against_each_other, against_table, join, joined_table, relocalise, relocalised_table};
use crate::run::{default_board, settings_for};
use crate::table;
use serde_json::json;
use std::sync::Arc;
use stipple::config::{Board, FrontendConfig};
use stipple::loops::pose4::{wrapped, Pose4};
use stipple::loops::{LoopKeyframe, Loops};
use stipple::output::metrics::percentile;
use stipple::output::report::{LoopClosed, Report};
use stipple::output::OutputDir;
use stipple::run::sensors::{Input, Recorded, Source};
use stipple::run::{fly, Options, Pace, Steps};
use stipple_drivers::host::thread_cpu_now;
use stipple_drivers::replay::{OpenOptions, Recording};
use stipple_drivers::sim::Scenario;
use stipple_drivers::types::pose_at;
use stipple_drivers::{Fault, FaultKind, Frames, Nanos, Pose, Span, TimedPose};

/// A closure further off the truth than this is false: m, rad. The drift of odometry is not in it. A true one is believed to
/// 0.2 m and 1.1 degrees or better, one deviation.
const FALSE: [f64; 2] = [0.5, 0.08];
/// A revisit: older than this, s, and nearer than this, m.
const OLD_S: f64 = 20.0;
const NEAR_M: f64 = 1.0;
/// Bounds of the angle between the two views, degrees.
const ANGLES: [f64; 4] = [0.0, 30.0, 60.0, 90.0];
/// Gap in the truth that is interpolated across.
const HOLE: Span = Span(100_000_000);
/// Keyframes at true poses: this far apart, m, rad.
const APART: [f64; 2] = [0.3, 0.15];
pub const KEYFRAMES: usize = 2048;
/// Factor of all grey levels where cameras see a quarter of the light.
const QUARTER: f64 = 0.25;

/// Loop closure: error with and without, false closures, recall, cost
#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    folders: Folders,
    /// Seeds of each simulated building
    #[arg(long, value_name = "N", default_value_t = 3)]
    seeds: u64,
    /// The first of them: what was chosen on some is judged on others
    #[arg(long, value_name = "N", default_value_t = 1)]
    first_seed: u64,
    /// Seconds of each flight at most
    #[arg(long, value_name = "S", default_value_t = 1e4, value_parser = crate::seconds)]
    seconds: f64,
    /// Starts in the map of an earlier flight
    #[arg(long, value_name = "N", default_value_t = 12)]
    starts: usize,
    /// The flights whose name contains this alone; `places`, `relocalise`, `resets` or `recordings`: that table
    /// alone;
    /// `relocalise-patrol`: starts in the whole patrol
    #[arg(long, value_name = "NAME")]
    only: Option<String>,
    /// Override a key of the board file
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
    set: Vec<String>,
}

impl Args {
    fn all_seeds(&self) -> std::ops::Range<u64> {
        self.first_seed..self.first_seed + self.seeds
    }
}

struct Flown {
    name: String,
    report: Report,
    wrong: usize,
}

struct Recall {
    name: String,
    keyframes: usize,
    /// By angle: revisits, and those recognised.
    revisits: [[usize; 2]; 3],
    recognised: usize,
    wrong: usize,
    /// CPU time of a keyframe, ms, its features too and without them: median, 99th percentile. Where the graph was full, of
    /// those since.
    ms: [[Option<f64>; 2]; 2],
    known: usize,
    bytes: usize,
}

pub fn run(args: &Args) -> Result<(), Fault> {
    let out = OutputDir::create(&args.folders.out)?;
    let (mut flown, mut recalls) = (vec![], vec![]);
    for (name, scenario) in flights(args)? {
        let wanted = args.only.as_ref().is_none_or(|only| name.contains(only.as_str()));
        if wanted {
            flown.push(measure(name, &scenario, args, &out)?);
        }
    }
    let asked = |name: &str| args.only.as_ref().is_none_or(|only| only == name);
    if asked("places") {
        recalls = places(args)?;
    }
    let (mut starts, mut resets, mut against) = (vec![], vec![], vec![]);
    let whole = args.only.as_deref() == Some("relocalise-patrol");
    for (name, wanted) in
        ["patrol-two", "twins", "doors"].map(|n| (n, asked("relocalise"))).into_iter().chain([("patrol", whole)])
    {
        for seed in args.all_seeds().filter(|_| wanted) {
            starts.push(relocalise(name, seed, args.starts, &args.set, &out)?);
        }
    }
    for seed in args.all_seeds().filter(|_| asked("resets")) {
        resets.push(join("patrol-two", seed, &args.set, &out)?);
    }
    if asked("recordings") {
        against = against_each_other(&args.folders.recordings()?)?;
    }
    let wrong = flown.iter().map(|f| f.wrong).chain(recalls.iter().map(|r| r.wrong));
    let wrong = wrong.chain(starts.iter().map(|r| r.wrong)).chain(resets.iter().map(|r| r.wrong));
    let wrong: usize = wrong.chain(against.iter().map(|r| r.wrong)).sum();
    let tables = [
        flights_table(flown),
        places_table(recalls),
        relocalised_table(starts),
        joined_table(resets),
        against_table(against),
    ];
    if tables.iter().all(Table::is_empty) {
        let (place, fix) = (args.only.clone().unwrap_or("--seeds 0".into()), "see `stipple-bench loops --help`");
        return Err(Fault::new(
            FaultKind::Usage,
            place,
            "nothing is measured by this name, of these seeds and recordings",
            fix,
        ));
    }
    tables.iter().for_each(|table| println!("{}", table.text()));
    println!("{wrong} false");
    let page = Page {
        name: "loops",
        title: "Loop closure",
        what: "odometry with loops and without, places recognised, cost".into(),
        facts: vec![("false", json!(wrong))],
        parts: std::iter::once(Part::Note(NOTE.into())).chain(tables.map(Part::Table)).collect(),
    };
    page.write(&out)?;
    crate::missed("loops", &if wrong > 0 { vec![format!("{wrong} false closures")] } else { vec![] })
}

const NOTE: &str = "Errors are those of whole trajectories after rigid alignment. A closure is false where what it measured is off the truth by 0.5 m or 4.6 degrees. Revisits: a keyframe older than 20 s within 1 m, by the angle between the views.";

fn flights(args: &Args) -> Result<Vec<(String, Scenario)>, Fault> {
    let mut list = vec![];
    for name in ["twins", "doors", "patrol-two"] {
        for seed in args.all_seeds() {
            let scenario = Scenario { seed, ..Scenario::named(name).expect("a scenario") };
            list.push((format!("{name}, seed {seed}"), scenario));
        }
    }
    if args.only.as_ref().is_some_and(|only| MEMS.contains(only.as_str())) {
        for seed in args.all_seeds() {
            list.push((
                format!("{MEMS}, seed {seed}"),
                with_mems(Scenario { seed, ..Scenario::named("patrol").expect("a scenario") }),
            ));
        }
    }
    for (name, start_s, [truth, imu]) in inputs::recorded(&args.folders.recordings()?) {
        let mut scenario = Scenario::from_euroc(&truth, Some(&imu))?;
        inputs::cut(&mut scenario, start_s, args.seconds);
        list.push((name.into(), scenario));
    }
    Ok(list)
}

/// The patrol of ten minutes with another inertial unit: flown where it is named.
const MEMS: &str = "patrol with a BMI088";

/// A flight with the inertial unit of a data sheet, the BMI088's: noise of 0.014 degrees/s and 175 µg per √Hz, offsets of 1 degree/s
/// and 20 mg; biases walk as far in ten minutes as they would by 5 K (0.015 degrees/s and 0.2 mg each).
pub fn with_mems(mut scenario: Scenario) -> Scenario {
    let imu = &mut scenario.calibration.imu;
    (imu.gyro_noise, imu.accel_noise) = (2.44e-4, 1.72e-3);
    (imu.gyro_walk, imu.accel_walk) = (5.3e-5, 4e-4);
    (scenario.imu_errors.gyro_bias, scenario.imu_errors.accel_bias) = (0.0175, 0.2);
    scenario
}

/// The board of flights without a map.
pub fn board_without_map(scenario: &Scenario, set: &[String]) -> Result<Board, Fault> {
    let set: Vec<String> = std::iter::once("map.enabled=false".into()).chain(settings_for(scenario, set)).collect();
    default_board(&set)
}

/// Flies in lockstep without a map.
fn measure(name: String, scenario: &Scenario, args: &Args, out: &OutputDir) -> Result<Flown, Fault> {
    let board = board_without_map(scenario, &args.set)?;
    let scenario = Scenario { duration: scenario.duration.min(Span::from_secs(args.seconds)), ..scenario.clone() };
    let input = Input::simulated(&scenario, |_, _| ())?;
    let truth = input.truth.clone();
    let options = Options { pace: Pace::Lockstep(Steps::PerFrame(1)), ..Options::default() };
    let flight = OutputDir::create(&out.file(&name.replace([' ', ','], "")))?;
    let report = fly(input, &board, &flight, &options, None)?.report;
    let wrong = report.loops.iter().filter(|l| is_false(&truth, l)).count();
    let ate = |m: Option<f64>| m.map_or("-".into(), |m| format!("{:.1} mm", 1e3 * m));
    eprintln!("{name}: {} without loops, {} with", ate(report.odometry_ate_rmse_m), ate(report.ate_rmse_m));
    Ok(Flown { name, report, wrong })
}

/// Whether a loop that was closed within a flight is not a true one.
pub fn is_false(truth: &[TimedPose], l: &LoopClosed) -> bool {
    is_off(truth, Nanos(l.with_ns), Nanos(l.t_ns), &Pose4 { p: l.p_m.into(), yaw: l.yaw_rad })
}

/// Whether a pose measured between two instants is not the true one.
fn is_off(truth: &[TimedPose], with: Nanos, t: Nanos, measured: &Pose4) -> bool {
    let level = |t| pose_at(truth, t, HOLE).map(|pose| Pose4::upright(&pose).0);
    let (Some(a), Some(b)) = (level(with), level(t)) else { return false };
    let is = a.between(&b);
    let (far, angle) = ((is.p - measured.p).length(), wrapped(is.yaw - measured.yaw).abs());
    if far > FALSE[0] || angle > FALSE[1] {
        eprintln!(
            "false at {} ns: {far:.3} m, {:.2} degrees off, {:.2} m apart",
            t.0,
            angle.to_degrees(),
            is.p.length()
        );
    }
    (is.p - measured.p).length() > FALSE[0] || wrapped(is.yaw - measured.yaw).abs() > FALSE[1]
}

/// The places of a recording, of two simulated rooms in other light, and of as many keyframes as there is room for.
fn places(args: &Args) -> Result<Vec<Recall>, Fault> {
    let mut list = vec![];
    let recording = args.folders.recordings()?.join("euroc_V1_01_easy_keyframes");
    if recording.is_dir() {
        let r = Recording::open(&recording, &OpenOptions::default())?;
        let mut reader = r.reader();
        let mut frames = (0..r.frames.len()).map(|i| {
            let mut frames = Frames::for_rig(&r.calibration);
            reader.read(i, &mut frames).is_ok().then(|| Arc::new(frames))
        });
        list.push(recall("V1_01 keyframes", &r.calibration, &r.truth, &mut frames, [0.0; 2])?);
    }
    let quarter = "patrol-two, second round at a quarter";
    for (name, apart) in [("patrol-two", APART), (quarter, APART), ("patrol", APART.map(|a| 0.4 * a))] {
        let mut scenario = Scenario::named(name.split(',').next().unwrap_or(name)).expect("a scenario");
        if name == quarter {
            scenario.light.steps = scenario.second_round().map(|t| (t, QUARTER, 0.0)).into_iter().collect();
        }
        let scenario = Scenario { duration: scenario.duration.min(Span::from_secs(args.seconds)), ..scenario };
        let Input { calibration, truth, source, .. } = Input::simulated(&scenario, |_, _| ())?;
        let Source::Recorded(Recorded { mut images, stamps, .. }) = source else { continue };
        let mut frames = (0..stamps.len()).map(|i| {
            let mut frames = Frames::for_rig(&calibration);
            images.read(i, &mut frames).ok().map(|()| Arc::new(Frames { t: stamps[i], ..frames }))
        });
        list.push(recall(name, &calibration, &truth, &mut frames, apart)?);
    }
    Ok(list)
}

fn recall(
    name: &str,
    calibration: &stipple_drivers::Calibration,
    truth: &[TimedPose],
    frames: &mut dyn Iterator<Item = Option<Arc<Frames>>>,
    apart: [f64; 2],
) -> Result<Recall, Fault> {
    let mut loops = Loops::new(calibration, &FrontendConfig::default(), KEYFRAMES)?;
    let mut seen: Vec<(Nanos, Pose)> = vec![];
    let (mut revisits, mut recognised, mut wrong, mut ms) = ([[0; 2]; 3], 0, 0, vec![]);
    for frames in frames.flatten() {
        let Some(pose) = pose_at(truth, frames.t, HOLE) else { continue };
        let moves =
            |(_, p): &(Nanos, Pose)| (p.p - pose.p).length() >= apart[0] || p.q.angle_between(pose.q) >= apart[1];
        if !seen.last().is_none_or(moves) {
            continue;
        }
        let old = seen.iter().filter(|(t, p)| (frames.t - *t).secs() > OLD_S && (p.p - pose.p).length() <= NEAR_M);
        let angle = old.map(|(_, p)| p.q.angle_between(pose.q).to_degrees()).min_by(f64::total_cmp);
        let keyframe = LoopKeyframe {
            t: frames.t,
            frames: &frames,
            id: None,
            epoch: 0,
            odom_from_body: pose,
            window: &[],
            body_from_cam: None,
        };
        let begun = thread_cpu_now();
        let camera = loops.extract(&keyframe);
        let extracted = thread_cpu_now();
        camera.and_then(|camera| loops.close(&keyframe, camera));
        let taken = [begun, extracted].map(|since| (thread_cpu_now() - since).as_secs_f64() * 1e3);
        ms.push((loops.stats.loop_keyframes_dropped > 0, taken));
        let right = loops.recognised.map(|(with, measured)| !is_off(truth, with, frames.t, &measured));
        recognised += usize::from(right.is_some());
        wrong += usize::from(right == Some(false));
        let bin = angle.and_then(|a| (0..3).find(|k| a >= ANGLES[*k] && a < ANGLES[*k + 1]));
        if let Some(bin) = bin {
            revisits[bin][0] += 1;
            revisits[bin][1] += usize::from(right == Some(true));
        }
        seen.push((frames.t, pose));
    }
    let known = seen.len() - loops.stats.loop_keyframes_dropped as usize;
    let full = ms.iter().position(|(is_full, _)| *is_full).unwrap_or(0);
    let taken = |k: usize| ms[full..].iter().map(|(_, ms): &(bool, [f64; 2])| ms[k]).collect::<Vec<_>>();
    let ms = [taken(0), taken(1)].map(|ms| [0.5, 0.99].map(|p| percentile(&ms, p)));
    Ok(Recall {
        name: name.into(),
        keyframes: seen.len(),
        revisits,
        recognised,
        wrong,
        ms,
        known,
        bytes: loops.bytes(),
    })
}

fn flights_table(flown: Vec<Flown>) -> Table {
    let counter = |f: &Flown, name: &str| f.report.counted().find(|(n, _)| *n == name).map_or(0, |(_, n)| n as usize);
    let ratio = |f: &Flown| Some(f.report.ate_rmse_m? / f.report.odometry_ate_rmse_m?);
    table!("flights", "Flights by odometry", flown, |f| f.wrong > 0, [
        text("flight") => f.name.clone(),
        millimetres("without loops", 1) => f.report.odometry_ate_rmse_m,
        millimetres("with", 1) => f.report.ate_rmse_m,
        number("ratio", "", 2) => ratio(&f),
        count("closed") => f.report.loops.len(),
        count("false") => f.wrong,
        count("recognised") => counter(&f, "loops_recognised"),
        count("none") => counter(&f, "loops_none"),
        count("weak") => counter(&f, "loops_weak"),
        count("alone") => counter(&f, "loops_alone"),
        count("ambiguous") => counter(&f, "loops_ambiguous"),
        count("implausible") => counter(&f, "loops_implausible"),
    ])
}

fn places_table(recalls: Vec<Recall>) -> Table {
    let share =
        |r: &Recall, k: usize| (r.revisits[k][0] > 0).then(|| r.revisits[k][1] as f64 / r.revisits[k][0] as f64);
    table!("places", "Places at true poses", recalls, |r| r.wrong > 0, [
        text("flight") => r.name.clone(),
        count("keyframes") => r.keyframes,
        count("revisits to 30\u{b0}") => r.revisits[0][0],
        percent("recognised", 0) => share(&r, 0),
        count("to 60\u{b0}") => r.revisits[1][0],
        percent("of them recognised", 0) => share(&r, 1),
        count("to 90\u{b0}") => r.revisits[2][0],
        percent("and of these", 0) => share(&r, 2),
        count("recognised in all") => r.recognised,
        count("false") => r.wrong,
        number("CPU of insert, query, verify, optimise: median", "ms", 1) => r.ms[1][0],
        number("99 %", "ms", 1) => r.ms[1][1],
        number("with its features: median", "ms", 1) => r.ms[0][0],
        number("99 %", "ms", 1) => r.ms[0][1],
        count("known") => r.known,
        number("memory", "MiB", 1) => Some(r.bytes as f64 / 1048576.0),
    ])
}
