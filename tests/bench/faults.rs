//! `stipple-bench faults`: a simulated flight in real time through the fault injector and the live path, once for each
//! fault: which counter saw it, how long odometry took to be itself again, what it cost.

use crate::run::default_board;
use serde_json::{json, Value};
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
use stipple::config::{Board, InjectConfig};
use stipple::output::metrics::trajectory_error;
use stipple::output::OutputDir;
use stipple::run::sensors::Recorded;
use stipple::run::status::Status;
use stipple::run::tracking::{OdometryRun, Tracker};
use stipple::run::{fly_in_real_time, memory, Flown, Realtime};
use stipple::vio::health::Health;
use stipple_drivers::inject::{Kind, Rule};
use stipple_drivers::paced::Images;
use stipple_drivers::sim::{Scenario, Sim};
use stipple_drivers::types::pose_at;
use stipple_drivers::{Fault, Frames, Nanos, Span, TimedPose};

/// Of the flight; all faults strike at `STRIKES_S`, when it has been under way for three seconds, and at least four seconds
/// follow each.
const FLIGHT_S: f64 = 8.0;
const AFTER_S: f64 = 4.0;
const STRIKES_S: f64 = 4.0;
/// Between true poses, which are as many as frames.
const TRUTH_HOLE: Span = Span(100_000_000);
/// Frames in order after which odometry is itself again: a quarter of a second.
const HEALTHY_FRAMES: usize = 5;
/// What tells a fault.
const DETECTORS: [&str; 22] = [
    "frames_missing",
    "frames_not_newer",
    "frames_leapt",
    "frames_frozen",
    "frames_blank",
    "frames_without_imu",
    "frames_overwritten",
    "camera_lost",
    "camera_silent",
    "eye_lost",
    "imu_missing",
    "imu_not_newer",
    "imu_leapt",
    "imu_frozen",
    "imu_saturated",
    "imu_lost",
    "imu_silent",
    "imu_overflow",
    "imu_gaps",
    "imu_rejected",
    "imu_repaired",
    "resets",
];

struct Case {
    name: &'static str,
    /// Strikes the unit, not the cameras.
    inertial: bool,
    rule: Rule,
    /// What is written where no counter sees it.
    unseen: &'static str,
}

fn cases() -> Vec<Case> {
    let lasting = |fault, secs: f64| Rule::within(fault, STRIKES_S, STRIKES_S + secs);
    let camera = |name, rule| Case { name, inertial: false, rule, unseen: "-" };
    let unit = |name, rule| Case { name, inertial: true, rule, unseen: "-" };
    let flipped = |name, bits| Case {
        unseen: "nothing: no sum guards a grey picture",
        ..camera(name, Rule { bits, ..lasting(Kind::BitFlip, 0.5) })
    };
    let eye = |rule: Rule, camera| Rule { camera: Some(camera), ..rule };
    let some = |rule: Rule| Rule { probability: 0.2, ..rule };
    let by = |rule: Rule, by_s: f64| Rule { by_s, ..rule };
    vec![
        camera("frames: one in five dropped, 2 s", some(lasting(Kind::Drop, 2.0))),
        camera("frames: 0.1 s late, 0.5 s", by(lasting(Kind::Delay, 0.5), 0.1)),
        camera("frames: each twice, 0.5 s", lasting(Kind::Duplicate, 0.5)),
        camera("frames: frozen, 0.5 s", lasting(Kind::Freeze, 0.5)),
        flipped("frames: a bit flipped in each image, 0.5 s", 1),
        flipped("frames: 1000 bits flipped in each image, 0.5 s", 1000),
        camera("frames: black, 0.5 s", lasting(Kind::Blackout, 0.5)),
        camera("frames: none, 1 s", lasting(Kind::Gap, 1.0)),
        camera("frames: stamps 60 s ahead, 0.2 s", by(lasting(Kind::StampJump, 0.2), 60.0)),
        camera("frames: stamps 60 s back, 0.2 s", by(lasting(Kind::StampJump, 0.2), -60.0)),
        camera("left camera unplugged, 2 s", eye(lasting(Kind::Unplug, 2.0), 0)),
        camera("right camera unplugged, 2 s", eye(lasting(Kind::Unplug, 2.0), 1)),
        camera("both unplugged, 0.5 s", lasting(Kind::Unplug, 0.5)),
        camera("both unplugged, 1 s", lasting(Kind::Unplug, 1.0)),
        camera("both unplugged, 2 s", lasting(Kind::Unplug, 2.0)),
        camera("both unplugged, 5 s", lasting(Kind::Unplug, 5.0)),
        unit("samples: one in five dropped, 2 s", some(lasting(Kind::Drop, 2.0))),
        Case {
            unseen: "nothing: they are waited for",
            ..unit("samples: 0.05 s late, 0.5 s", by(lasting(Kind::Delay, 0.5), 0.05))
        },
        unit("samples: each twice, 0.5 s", lasting(Kind::Duplicate, 0.5)),
        unit("samples: frozen, 0.2 s", lasting(Kind::Freeze, 0.2)),
        unit("samples: one in five with a bit flipped, 0.5 s", some(lasting(Kind::BitFlip, 0.5))),
        unit("samples: none, 0.5 s", lasting(Kind::Gap, 0.5)),
        unit("samples: stamps 60 s ahead, 0.1 s", by(lasting(Kind::StampJump, 0.1), 60.0)),
        unit("unit unplugged, 1 s", lasting(Kind::Unplug, 1.0)),
    ]
}

/// The flight, rendered once.
struct Flight {
    board: Board,
    sim: Sim,
    frames: Vec<Frames>,
    truth: Vec<TimedPose>,
}

/// One flight and what became of it.
struct Outcome {
    injected: Vec<(&'static str, u64)>,
    detected: Vec<(&'static str, u64)>,
    /// Frames of the flight without a pose.
    lost: usize,
    /// From the end of the fault until odometry was itself again, s.
    recovered_s: Option<f64>,
    health: Health,
    ate_m: Option<f64>,
    /// Of what came after the fault, aligned by itself.
    after_m: Option<f64>,
    /// Error of the motion from the last pose before the fault to the first after it.
    jump_m: Option<f64>,
}

impl Flight {
    fn render(board: Board) -> Result<Flight, Fault> {
        let mut scenario = Scenario::named("demo").expect("the demo's scenario is compiled in");
        scenario.duration = Span::from_secs(cases().iter().map(flight_s).fold(FLIGHT_S, f64::max));
        let mut sim = Sim::new(&scenario)?;
        let mut frames = Vec::new();
        for i in 0..sim.frame_count() {
            let mut f = Frames::for_rig(sim.calibration());
            sim.render(i, &mut f);
            frames.push(f);
        }
        let truth = sim.truth();
        Ok(Flight { board, sim, frames, truth })
    }

    fn fly(&self, case: Option<&Case>) -> Result<Outcome, Fault> {
        let mut inject = InjectConfig::default();
        if let Some(case) = case {
            if case.inertial { &mut inject.imu } else { &mut inject.camera }.push(case.rule);
        }
        let calibration = self.sim.calibration();
        let mut stamps: Vec<Nanos> = self.frames.iter().map(|f| f.t).collect();
        let end = stamps[0] + Span::from_secs(case.map_or(FLIGHT_S, flight_s));
        stamps.truncate(stamps.partition_point(|t| *t < end));
        let flown = stamps.len();
        let (first, images) = (stamps[0], Images::Rendered(self.frames.clone()));
        let shape = || Frames::for_rig(calibration);
        let sensors = Recorded { images, stamps, imu: self.sim.imu().to_vec() }.paced().with_faults(&inject, shape);
        let run = OdometryRun::new(calibration, &self.board, self.frames.len())?;
        let options = Realtime { holdout: 0, until_s: None, sensors_s: None, stop: &AtomicBool::new(false) };
        let mut silent = Status::silent();
        let tracker = Tracker::Odometry(Box::new(run));
        let played = fly_in_real_time(sensors, calibration, tracker, None, &options, &mut silent);
        let end_s = case.map_or(STRIKES_S, |c| c.rule.end_s);
        Ok(self.judge(&played, flown, first + Span::from_secs(STRIKES_S), first + Span::from_secs(end_s)))
    }

    fn judge(&self, played: &Flown, flown: usize, strikes: Nanos, ends: Nanos) -> Outcome {
        let run = played.tracker.odometry().expect("flown by odometry");
        let trajectory: Vec<TimedPose> =
            run.back.trajectory.iter().map(|o| TimedPose { t: o.t, pose: o.world_from_body }).collect();
        let after: Vec<TimedPose> = trajectory.iter().filter(|p| p.t >= ends).copied().collect();
        let ate = |list: &[TimedPose]| trajectory_error(list, &self.truth).map(|e| e.ate_rmse_m);
        let health = &run.back.health;
        let well = |h: Health| h.0 & !Health::NORMAL.0 == 0 && !h.has(Health::INITIALISING);
        let tail: Vec<_> = health.iter().filter(|(t, _)| *t >= ends).collect();
        let itself = |i: &usize| tail[*i..].iter().take(HEALTHY_FRAMES).all(|(_, h)| well(*h));
        let recovered = (0..tail.len().saturating_sub(HEALTHY_FRAMES)).find(itself);
        let all = [played.counters.list(), played.source.clone(), played.tracker.counters()].concat();
        let is_injected = |name: &str| name.starts_with("injected_");
        Outcome {
            injected: all.iter().filter(|(name, _)| is_injected(name)).copied().collect(),
            detected: all.iter().filter(|(name, n)| *n > 0 && DETECTORS.contains(name)).copied().collect(),
            lost: flown - trajectory.len().min(flown),
            recovered_s: recovered.map(|i| (tail[i].0 - ends).secs()),
            health: health.iter().filter(|(t, _)| *t >= strikes).fold(Health::default(), |sum, (_, h)| sum | *h),
            ate_m: ate(&trajectory),
            after_m: ate(&after),
            jump_m: trajectory.iter().rfind(|p| p.t < strikes).zip(after.first()).and_then(|(a, b)| self.jump(a, b)),
        }
    }

    fn jump(&self, a: &TimedPose, b: &TimedPose) -> Option<f64> {
        let truth = |t: Nanos| pose_at(&self.truth, t, TRUTH_HOLE);
        let truly = truth(a.t)?.inverse() * truth(b.t)?;
        Some((truly.inverse() * (a.pose.inverse() * b.pose)).p.length())
    }
}

fn flight_s(case: &Case) -> f64 {
    FLIGHT_S.max(case.rule.end_s + AFTER_S)
}

/// Sensors that fail, in real time: which counter sees each fault, and what it costs; three minutes
#[derive(clap::Args)]
pub struct Args {
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// The unplugged sensors only
    #[arg(long)]
    quick: bool,
}

pub fn run(args: &Args) -> Result<(), Fault> {
    let out = OutputDir::create(&args.out)?;
    let board = default_board(&["map.enabled=false".to_string()])?;
    let flight = Flight::render(board)?;
    memory::check_fits("the simulated flight", flight.sim.calibration(), &flight.board, false)?;
    let plain = flight.fly(None)?;
    let mut rows = Vec::new();
    let mut cases = cases();
    if args.quick {
        cases.retain(|c| c.rule.fault == Kind::Unplug && c.rule.end_s < STRIKES_S + 2.0);
    }
    for case in &cases {
        let outcome = flight.fly(Some(case))?;
        eprintln!("{}", case.name);
        rows.push((case, outcome));
    }
    let table = table(&plain, &rows);
    println!("{table}");
    out.write("faults.md", |w| writeln!(w, "{table}"))?;
    let list: Vec<Value> = rows.iter().map(|(case, o)| json_row(case.name, o)).collect();
    let whole = json!({ "without": json_row("none", &plain), "faults": list });
    out.write("faults.json", |w| {
        serde_json::to_writer_pretty(&mut *w, &whole)?;
        writeln!(w)
    })
}

fn json_row(name: &str, o: &Outcome) -> Value {
    let counted = |list: &[(&'static str, u64)]| {
        list.iter().map(|(n, v)| (n.to_string(), json!(v))).collect::<serde_json::Map<_, _>>()
    };
    json!({
        "fault": name,
        "injected": counted(&o.injected),
        "detected": counted(&o.detected),
        "frames_lost": o.lost,
        "recovered_s": o.recovered_s,
        "health": o.health.reasons().collect::<Vec<_>>(),
        "ate_m": o.ate_m,
        "ate_after_m": o.after_m,
        "jump_m": o.jump_m,
    })
}

/// What a fault raised above what the flight without one counts.
fn table(plain: &Outcome, rows: &[(&Case, Outcome)]) -> String {
    let mm = |v: Option<f64>| v.map_or("-".into(), |v| format!("{:.1}", 1e3 * v));
    let before = |name: &str| plain.detected.iter().find(|(n, _)| *n == name).map_or(0, |(_, v)| *v);
    let listed = |list: Vec<String>, none: &str| if list.is_empty() { none.into() } else { list.join(", ") };
    let mut text =
        "| fault | injected | seen by | frames lost | itself again after s | said | ATE mm | after it mm | jump mm |\n\
                    |---|---|---|---|---|---|---|---|---|\n"
            .to_string();
    let _ = writeln!(
        text,
        "| none | - | - | {} | - | - | {} | {} | {} |",
        plain.lost,
        mm(plain.ate_m),
        mm(plain.after_m),
        mm(plain.jump_m)
    );
    for (case, o) in rows {
        let seen = o.detected.iter().filter(|(n, v)| *v > before(n)).map(|(n, v)| format!("{n} {}", v - before(n)));
        let said = Health(o.health.0 & !Health::NORMAL.0);
        let _ = writeln!(
            text,
            "| {} | {} | {} | {} | {} | {} | {} | {} | {} |",
            case.name,
            listed(o.injected.iter().map(|(_, v)| v.to_string()).collect(), "-"),
            listed(seen.collect(), case.unseen),
            o.lost.saturating_sub(plain.lost),
            o.recovered_s.map_or("never".into(), |s| format!("{s:.2}")),
            listed(said.reasons().map(str::to_string).collect(), "-"),
            mm(o.ate_m),
            mm(o.after_m),
            mm(o.jump_m),
        );
    }
    text.trim_end().to_string()
}
