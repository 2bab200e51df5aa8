//! Relocalisation: how soon a vehicle that starts anywhere finds itself in the map of an earlier flight, and whether it errs.
//!
//! A patrol is flown and its places are kept. Then flights of a few seconds begin spread over it, each part in the light of the
//! other round, with a new estimator, and only find their way (`stipple run --localise-only`).

use crate::inputs::{self, Flight};
use crate::loops::{board_without_map, is_false, KEYFRAMES};
use crate::page::{count, millimetres, number, percent, text, Table};
use crate::table;
use std::path::Path;
use stipple::config::FrontendConfig;
use stipple::loops::{LoopKeyframe, Loops};
use stipple::output::metrics::{align, percentile};
use stipple::output::OutputDir;
use stipple::run::sensors::Input;
use stipple::run::{fly, Options, Pace, Steps};
use stipple_drivers::replay::read_trajectory;
use stipple_drivers::sim::Scenario;
use stipple_drivers::types::pose_at;
use stipple_drivers::{Fault, Nanos, Span};

/// Length of a flight that is to find itself, and the time that it has for it, s.
const FLIGHT_S: f64 = 6.0;
const IN_TIME_S: f64 = 5.0;
/// Poses further off than this are wrong: m, rad.
const WRONG: [f64; 2] = [0.5, 0.08];
const HOLE: Span = Span(100_000_000);
/// Spreads starts evenly, however many there are: the golden ratio.
const SPREAD: f64 = 0.618_033_988_749_895;

pub struct Relocalised {
    name: String,
    starts: usize,
    /// From the first frame until each was found, s, and how far the last pose was off, m.
    after_s: Vec<f64>,
    off_m: Vec<f64>,
    pub wrong: usize,
    ambiguous: usize,
}

/// Flies a patrol, and `starts` short flights in its map.
pub fn relocalise(name: &str, seed: u64, starts: usize, set: &[String], out: &OutputDir) -> Result<Relocalised, Fault> {
    let whole = Scenario { seed, ..Scenario::named(name).expect("a scenario") };
    let board = board_without_map(&whole, set)?;
    let folder = OutputDir::create(&out.file(&format!("{name}-{seed}-places")))?;
    let options = Options { pace: Pace::Lockstep(Steps::PerFrame(1)), fresh: true, ..Options::default() };
    let first = Input::simulated(&whole, |_, _| ())?;
    let truth = first.truth.clone();
    fly(first, &board, &folder, &options, None)?;
    let flown = read_trajectory(&folder.file("trajectory.tum"))?;
    let pairs: Vec<_> = flown.iter().filter_map(|e| Some((e.pose.p, pose_at(&truth, e.t, HOLE)?.p))).collect();
    let world_from_map = align(pairs.iter().copied());
    let mut result = Relocalised {
        name: format!("{name}, seed {seed}"),
        starts,
        after_s: vec![],
        off_m: vec![],
        wrong: 0,
        ambiguous: 0,
    };
    let room_s = whole.duration.secs() - FLIGHT_S;
    for k in 0..starts {
        let begin_s = room_s * (k as f64 * SPREAD).fract();
        let [begin, duration] = [begin_s, begin_s + FLIGHT_S].map(Span::from_secs);
        let scenario = Scenario { begin, duration, other_light: true, ..whole.clone() };
        let input = Input::simulated(&scenario, |_, _| ())?;
        let truth = input.truth.clone();
        let options = Options { localise_only: true, fresh: false, ..options.clone() };
        let report = fly(input, &board, &folder, &options, None)?.report;
        let counter = |name: &str| report.counted().find(|(n, _)| *n == name).map_or(0, |(_, n)| n as usize);
        result.ambiguous += counter("loops_ambiguous");
        let Some(found) = report.loops.iter().find(|l| l.joins) else {
            let why = ["none", "weak", "alone", "ambiguous"].map(|why| counter(&format!("loops_{why}")));
            eprintln!("{}: not found from {begin_s:.1} s on: none, weak, alone, ambiguous {why:?}", result.name);
            continue;
        };
        result.after_s.push((found.t_ns - truth[0].t.0) as f64 * 1e-9);
        let Some(last) = read_trajectory(&folder.file("trajectory.tum"))?.last().copied() else { continue };
        let Some(is) = pose_at(&truth, last.t, HOLE) else { continue };
        let found = world_from_map * last.pose;
        let (far, angle) = ((found.p - is.p).length(), found.q.angle_between(is.q));
        result.off_m.push(far);
        if far > WRONG[0] || angle > WRONG[1] {
            result.wrong += 1;
            eprintln!("{}: wrong from {:.1} s on: {far:.2} m, {angle:.3} rad", result.name, begin_s);
        }
    }
    Ok(result)
}

/// Recordings of one rig one after the other, each as an epoch of its own: which of them are taken for one place.
pub struct Against {
    name: String,
    keyframes: usize,
    joined: u64,
    pub wrong: usize,
}

/// Keyframes are so far apart, s.
const APART_S: f64 = 0.5;
/// Length of a flight along a recorded path, s.
const ALONG_S: f64 = 60.0;
/// V1_01 was recorded twice, in one room: its keyframes, and a second at rest.
const SAME_ROOM: &str = "euroc_V1_01";

/// Each recording, and cameras simulated along recorded flights, against all before it.
pub fn against_each_other(folder: &Path) -> Result<Vec<Against>, Fault> {
    let mut loops: Option<Loops> = None;
    let (mut list, mut seen): (Vec<Against>, Vec<String>) = (vec![], vec![]);
    let recorded = ["euroc_MH_01_easy_11s", "euroc_V1_01_easy_keyframes", "euroc_V1_01_easy_static_1s"];
    let there = recorded.into_iter().filter(|name| folder.join(name).is_dir());
    let mut flights: Vec<(String, Flight)> = vec![];
    for name in there {
        flights.push((name.into(), inputs::read(&folder.join(name), f64::INFINITY)?));
    }
    for (name, start_s, [truth, imu]) in inputs::recorded(folder) {
        let mut scenario = Scenario::from_euroc(&truth, Some(&imu))?;
        inputs::cut(&mut scenario, start_s, ALONG_S);
        // Rooms of one seed have the same pictures on their walls.
        scenario.seed = flights.len() as u64;
        flights.push((name.into(), inputs::rendered(scenario, ALONG_S)?));
    }
    for (epoch, (name, flight)) in flights.into_iter().enumerate() {
        let known = match &mut loops {
            Some(known) => known,
            // One rig took all of them, by the calibration of the first.
            None => loops.insert(Loops::new(&flight.calibration, &FrontendConfig::default(), KEYFRAMES)?),
        };
        let (before, mut last, mut keyframes) = (known.stats.epochs_joined, None::<Nanos>, 0);
        for frames in &flight.frames {
            let Some(odom_from_body) = pose_at(&flight.truth, frames.t, HOLE) else { continue };
            if last.is_some_and(|last| (frames.t - last).secs() < APART_S) {
                continue;
            }
            (last, keyframes) = (Some(frames.t), keyframes + 1);
            let (t, id, body_from_cam) = (frames.t, None, None);
            let epoch = epoch as u32;
            known.add(&LoopKeyframe { t, frames, id, epoch, odom_from_body, window: &[], body_from_cam });
        }
        let joined = known.stats.epochs_joined - before;
        let same = name.starts_with(SAME_ROOM) && seen.iter().any(|s| s.starts_with(SAME_ROOM));
        let wrong = joined.saturating_sub(u64::from(same)) as usize;
        seen.push(name.clone());
        list.push(Against { name, keyframes, joined, wrong });
    }
    Ok(list)
}

pub fn against_table(rows: Vec<Against>) -> Table {
    table!("against", "Recordings of one rig, each against all before it", rows, |r| r.wrong > 0, [
        text("recording") => r.name.clone(),
        count("keyframes") => r.keyframes,
        count("taken for an earlier one") => r.joined as usize,
        count("false") => r.wrong,
    ])
}

/// A patrol with its cameras black three times, each long enough that the estimator begins anew.
pub struct Joined {
    name: String,
    /// Epochs, joins, and how far the recorded places of closed loops were off.
    epochs: Option<u32>,
    joined: usize,
    pub wrong: usize,
    /// Errors of the whole trajectory: undisturbed, and with resets.
    ate_m: [Option<f64>; 2],
}

/// Black pictures: when, as parts of the flight, and for how long, s.
const BLACK_AT: [f64; 3] = [0.3, 0.6, 0.8];
const BLACK_S: f64 = 4.0;
/// A trajectory with resets may be worse by this, m.
const WORSE_MAX_M: f64 = 0.05;

pub fn join(name: &str, seed: u64, set: &[String], out: &OutputDir) -> Result<Joined, Fault> {
    let whole = Scenario { seed, ..Scenario::named(name).expect("a scenario") };
    let board = board_without_map(&whole, set)?;
    let steps = BLACK_AT.map(|at| at * whole.duration.secs()).into_iter();
    let steps = steps.flat_map(|at| [(Span::from_secs(at), 0.0, 0.0), (Span::from_secs(at + BLACK_S), 1.0, 0.0)]);
    let mut black = whole.clone();
    black.light.steps = steps.collect();
    let fly_one = |scenario: &Scenario, folder: &str| {
        let options = Options { pace: Pace::Lockstep(Steps::PerFrame(1)), fresh: true, ..Options::default() };
        let folder = OutputDir::create(&out.file(&format!("{name}-{seed}-{folder}")))?;
        let input = Input::simulated(scenario, |_, _| ())?;
        let truth = input.truth.clone();
        Ok::<_, Fault>((fly(input, &board, &folder, &options, None)?.report, truth))
    };
    let (undisturbed, _) = fly_one(&whole, "undisturbed")?;
    let (report, truth) = fly_one(&black, "resets")?;
    let wrong = report.loops.iter().filter(|l| is_false(&truth, l)).count();
    Ok(Joined {
        name: format!("{name}, seed {seed}"),
        epochs: report.epochs,
        joined: report.loops.iter().filter(|l| l.joins).count(),
        wrong,
        ate_m: [undisturbed.ate_rmse_m, report.ate_rmse_m],
    })
}

pub fn joined_table(rows: Vec<Joined>) -> Table {
    let worse = |r: &Joined| Some(r.ate_m[1]? - r.ate_m[0]?);
    let is_bad = |r: &Joined| r.wrong > 0 || worse(r).is_none_or(|worse| worse > WORSE_MAX_M);
    table!("joined", "Three resets in a flight", rows, |r| is_bad(&r), [
        text("flight") => r.name.clone(),
        count("epochs") => r.epochs.unwrap_or(0) as usize,
        count("joined") => r.joined,
        count("false") => r.wrong,
        millimetres("undisturbed", 1) => r.ate_m[0],
        millimetres("with resets", 1) => r.ate_m[1],
    ])
}

pub fn relocalised_table(rows: Vec<Relocalised>) -> Table {
    let in_time =
        |r: &Relocalised| r.after_s.iter().filter(|s| **s <= IN_TIME_S).count() as f64 / r.starts.max(1) as f64;
    table!("relocalised", "Starts in the map of an earlier flight, in other light", rows, |r| r.wrong > 0, [
        text("map") => r.name.clone(),
        count("starts") => r.starts,
        count("found") => r.after_s.len(),
        percent("within 5 s", 0) => Some(in_time(&r)),
        number("after: median", "s", 1) => percentile(&r.after_s, 0.5),
        number("95 %", "s", 1) => percentile(&r.after_s, 0.95),
        count("wrong") => r.wrong,
        millimetres("off: median", 0) => percentile(&r.off_m, 0.5),
        millimetres("most", 0) => r.off_m.iter().copied().reduce(f64::max),
        count("ambiguous keyframes") => r.ambiguous,
    ])
}
