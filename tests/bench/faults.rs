//! `stipple-bench faults`: a simulated flight in real time through the fault injector and the live path, once for each
//! fault: which counter saw it, how long odometry took to be itself again, what it cost. A fault that its counter misses, or
//! that costs more than a drone can bear, ends the bench with an error.

use crate::missed;
use crate::page::{count, millimetres, number, text, Page, Part, Table};
use crate::run::default_board;
use crate::table;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
use stipple::config::{Board, InjectConfig};
use stipple::output::metrics::trajectory_error;
use stipple::output::OutputDir;
use stipple::run::sensors::{Playback, Recorded};
use stipple::run::status::Status;
use stipple::run::tracking::{OdometryRun, Tracker};
use stipple::run::{fly_in_real_time, memory, Flown, Realtime, Steering};
use stipple::vio::Health;
use stipple_drivers::inject::{Kind, Rule};
use stipple_drivers::paced::Images;
use stipple_drivers::sim::{Scenario, Sim};
use stipple_drivers::types::pose_at;
use stipple_drivers::{Fault, Frames, Nanos, Span, TimedPose};

/// Length of the flight, s; all faults strike at `STRIKES_S`, when it has been under way for three seconds, and at least four seconds
/// follow each.
const FLIGHT_S: f64 = 8.0;
const AFTER_S: f64 = 4.0;
const STRIKES_S: f64 = 4.0;
/// Between true poses, which are as many as frames.
const TRUTH_HOLE: Span = Span(100_000_000);
/// Frames in order after which odometry is itself again: a quarter of a second.
const HEALTHY_FRAMES: usize = 5;
/// Counters that tell a fault.
const DETECTORS: [&str; 22] = [
    "frames_missing",
    "frames_not_newer",
    "frames_timestamp_jump",
    "frames_frozen",
    "frames_blank",
    "frames_without_imu",
    "frames_overwritten",
    "camera_lost",
    "camera_silent",
    "one_camera_lost",
    "imu_missing",
    "imu_not_newer",
    "imu_timestamp_jump",
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

/// Bounds for a drone that holds its place within 0.1 m, whatever fails: no jump beyond that, and odometry back
/// within a second, in which a velocity that is wrong by 0.1 m/s has carried it as far.
const JUMP_MAX_M: f64 = 0.1;
const RECOVERED_MAX_S: f64 = 1.0;
/// While no camera sees anything the drone cannot hold its place; the jump may be this share of what it flies meanwhile.
const BLIND_SHARE: f64 = 0.05;
const SPEED: f64 = 2.0;

struct Case {
    name: &'static str,
    /// Strikes the unit, not the cameras.
    inertial: bool,
    rule: Rule,
    /// Counters that must see the fault: one each time it is injected, others at least once. Empty where nothing can.
    each: &'static str,
    once: &'static [&'static str],
    /// Why no counter sees it, where none does.
    unseen: &'static str,
}

#[rustfmt::skip]
fn cases() -> Vec<Case> {
    let lasting = |fault, secs: f64| Rule::within(fault, STRIKES_S, STRIKES_S + secs);
    let case = |name: &'static str, rule, each, once| {
        let inertial = name.starts_with("samples") || name.starts_with("unit");
        Case { name, inertial, rule, each, once, unseen: "-" }
    };
    let unseen = |unseen, name, rule| Case { unseen, ..case(name, rule, "", &[]) };
    let grey = "nothing: no sum guards a grey picture";
    let one_camera = |rule: Rule, camera| Rule { camera: Some(camera), ..rule };
    let some = |rule: Rule| Rule { probability: 0.2, ..rule };
    let by = |rule: Rule, by_s: f64| Rule { by_s, ..rule };
    use Kind::*;
    vec![
        case("frames: one in five dropped, 2 s", some(lasting(Drop, 2.0)), "frames_missing", &[]),
        case("frames: 0.1 s late, 0.5 s", by(lasting(Delay, 0.5), 0.1), "", &["frames_overwritten"]),
        case("frames: each twice, 0.5 s", lasting(Duplicate, 0.5), "frames_not_newer", &[]),
        case("frames: frozen, 0.5 s", lasting(Freeze, 0.5), "frames_frozen", &[]),
        unseen(grey, "frames: a bit flipped in each image, 0.5 s", Rule { bits: 1, ..lasting(BitFlip, 0.5) }),
        unseen(grey, "frames: 1000 bits flipped in each image, 0.5 s", Rule { bits: 1000, ..lasting(BitFlip, 0.5) }),
        case("frames: black, 0.5 s", lasting(Blackout, 0.5), "frames_blank", &[]),
        case("frames: none, 1 s", lasting(Gap, 1.0), "frames_missing", &["camera_silent"]),
        case("frames: stamps 60 s ahead, 0.2 s", by(lasting(StampJump, 0.2), 60.0), "frames_timestamp_jump", &[]),
        case("frames: stamps 60 s back, 0.2 s", by(lasting(StampJump, 0.2), -60.0), "frames_not_newer", &[]),
        case("left camera unplugged, 2 s", one_camera(lasting(Unplug, 2.0), 0), "frames_blank", &["one_camera_lost"]),
        case("right camera unplugged, 2 s", one_camera(lasting(Unplug, 2.0), 1), "frames_blank", &["one_camera_lost"]),
        case("both unplugged, 0.5 s", lasting(Unplug, 0.5), "", &["camera_lost"]),
        case("both unplugged, 1 s", lasting(Unplug, 1.0), "", &["camera_lost"]),
        case("both unplugged, 2 s", lasting(Unplug, 2.0), "", &["camera_lost", "resets"]),
        case("both unplugged, 5 s", lasting(Unplug, 5.0), "", &["camera_lost", "resets"]),
        case("samples: one in five dropped, 2 s", some(lasting(Drop, 2.0)), "imu_missing", &[]),
        unseen("nothing: they are waited for", "samples: 0.05 s late, 0.5 s", by(lasting(Delay, 0.5), 0.05)),
        case("samples: each twice, 0.5 s", lasting(Duplicate, 0.5), "imu_not_newer", &[]),
        case("samples: frozen, 0.2 s", lasting(Freeze, 0.2), "imu_frozen", &[]),
        case("samples: one in five with a bit flipped, 0.5 s", some(lasting(BitFlip, 0.5)), "", &["imu_repaired"]),
        case("samples: none, 0.5 s", lasting(Gap, 0.5), "imu_missing", &["imu_silent"]),
        case("samples: stamps 60 s ahead, 0.1 s", by(lasting(StampJump, 0.1), 60.0), "imu_timestamp_jump", &[]),
        case("unit unplugged, 1 s", lasting(Unplug, 1.0), "", &["imu_lost"]),
    ]
}

impl Case {
    fn jump_max_m(&self) -> f64 {
        let dark = matches!(self.rule.fault, Kind::Unplug | Kind::Gap | Kind::Blackout);
        let blind = dark && !self.inertial && self.rule.camera.is_none();
        let flown = if blind { SPEED * (self.rule.end_s - STRIKES_S) } else { 0.0 };
        JUMP_MAX_M.max(BLIND_SHARE * flown)
    }

    /// The first thing that is not as it has to be, beside a flight without a fault.
    fn complaint(&self, o: &Outcome, plain: &Outcome) -> Option<String> {
        let risen = |name: &str| o.count(name) - plain.count(name).min(o.count(name));
        let wrong = if o.injected == 0 {
            "was not injected".into()
        } else if !self.each.is_empty() && risen(self.each) < o.injected {
            format!("{} saw {} of {}", self.each, risen(self.each), o.injected)
        } else if let Some(blind) = self.once.iter().find(|name| risen(name) == 0) {
            format!("{blind} did not see it")
        } else if o.recovered_s.is_none_or(|s| s > RECOVERED_MAX_S) {
            format!("itself again after {:?} s, not within {RECOVERED_MAX_S}", o.recovered_s)
        } else if o.jump_m.is_none_or(|m| m > self.jump_max_m()) {
            format!("jumps by {:?} m, not within {}", o.jump_m, self.jump_max_m())
        } else {
            return None;
        };
        Some(format!("{}: {wrong}", self.name))
    }
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
    /// Frames or samples that the fault struck.
    injected: u64,
    detected: Vec<(&'static str, u64)>,
    /// Frames of the flight without a pose.
    lost: usize,
    /// Time from the end of the fault until odometry was itself again, s.
    recovered_s: Option<f64>,
    health: Health,
    ate_m: Option<f64>,
    /// ATE of the part after the fault, aligned by itself, m.
    after_m: Option<f64>,
    /// Error of the motion from the last pose before the fault to the first after it.
    jump_m: Option<f64>,
}

impl Outcome {
    fn count(&self, name: &str) -> u64 {
        self.detected.iter().find(|(n, _)| *n == name).map_or(0, |(_, v)| *v)
    }
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
        let sensors = Recorded { images, stamps, imu: self.sim.imu().to_vec(), aids: vec![] }
            .paced(Playback::default())
            .with_faults(&inject, shape);
        let run = OdometryRun::new(calibration, &self.board, self.frames.len())?;
        let options = Realtime { holdout: 0, until_s: None, sensors_s: None, stop: &AtomicBool::new(false) };
        let mut silent = Status::silent();
        let tracker = Tracker::Odometry(Box::new(run));
        let played = fly_in_real_time(
            sensors,
            calibration,
            tracker,
            (None, None),
            &options,
            &mut silent,
            &mut Steering::default(),
        );
        let end_s = case.map_or(STRIKES_S, |c| c.rule.end_s);
        Ok(self.judge(&played, flown, first + Span::from_secs(STRIKES_S), first + Span::from_secs(end_s)))
    }

    fn judge(&self, played: &Flown, flown: usize, strikes: Nanos, ends: Nanos) -> Outcome {
        let run = played.tracker.odometry().expect("flown by odometry");
        let trajectory = run.back.trajectory.to_vec();
        let after: Vec<TimedPose> = trajectory.iter().filter(|p| p.t >= ends).copied().collect();
        let ate = |list: &[TimedPose]| trajectory_error(list, &self.truth).map(|e| e.ate_rmse_m);
        let health = &run.back.health;
        let well = |h: Health| h.0 & !Health::NORMAL.0 == 0 && !h.has(Health::INITIALISING);
        let tail: Vec<_> = health.iter().filter(|(t, _)| *t >= ends).collect();
        let itself = |i: &usize| tail[*i..].iter().take(HEALTHY_FRAMES).all(|(_, h)| well(*h));
        let recovered = (0..tail.len().saturating_sub(HEALTHY_FRAMES)).find(itself);
        let all = [played.counters.list(), played.source.clone(), played.tracker.counters()].concat();
        // Beside the frames without a camera, how often it went.
        let is_injected = |name: &str| name.starts_with("injected_") && !name.ends_with("_unplugs");
        Outcome {
            injected: all.iter().filter(|(name, _)| is_injected(name)).map(|(_, n)| n).sum(),
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

/// Sensors that fail, in real time: which counter sees each fault, and what it costs; four minutes
#[derive(clap::Args)]
pub struct Args {
    /// Folder for the results
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Three faults: a camera, both cameras and the inertial unit unplugged
    #[arg(long)]
    quick: bool,
}

const QUICK: [&str; 3] = ["right camera unplugged, 2 s", "both unplugged, 0.5 s", "unit unplugged, 1 s"];

pub fn run(args: &Args) -> Result<(), Fault> {
    let out = OutputDir::create(&args.out)?;
    let board = default_board(&["map.enabled=false".to_string()])?;
    let flight = Flight::render(board)?;
    memory::check_fits("the simulated flight", flight.sim.calibration(), &flight.board, false)?;
    let cases: Vec<Case> = cases().into_iter().filter(|c| !args.quick || QUICK.contains(&c.name)).collect();
    let mut flights = vec![(None, flight.fly(None)?)];
    for case in &cases {
        eprintln!("{}", case.name);
        flights.push((Some(case), flight.fly(Some(case))?));
    }
    let complaint = |(case, o): &(Option<&Case>, Outcome)| case.and_then(|case| case.complaint(o, &flights[0].1));
    let complaints: Vec<String> = flights.iter().filter_map(complaint).collect();
    let title = "Faults of sensors";
    let what = format!("a simulated flight of {FLIGHT_S} s in real time through the fault injector, a row a fault");
    let parts = vec![Part::Note(NOTE.into()), Part::Table(table(&flights))];
    Page { name: "faults", title, what, facts: vec![], parts }.finish(&out)?;
    missed("faults", &complaints)
}

const NOTE: &str = "Seen by: counters that rose above those of the flight without a fault. Itself again: from the end of the fault until five frames in order say nothing but what is normal, a second at most. Jump: error of the motion across the fault. Bold: not as it has to be.";

/// The first flight is the one without a fault.
fn table(flights: &[(Option<&Case>, Outcome)]) -> Table {
    let plain = &flights[0].1;
    let missed = |r: &(Option<&Case>, Outcome)| r.0.is_some_and(|case| case.complaint(&r.1, plain).is_some());
    table!("faults", "Faults", flights, |r| missed(r), [
        text("fault") => r.0.map_or("none", |c| c.name),
        count("injected") => r.1.injected,
        text("seen by") => seen_by(r.0, &r.1, plain),
        count("frames lost") => r.0.map_or(r.1.lost, |_| r.1.lost.saturating_sub(plain.lost)),
        number("itself again after", "s", 2) => r.1.recovered_s,
        text("said") => Health(r.1.health.0 & !Health::NORMAL.0).reasons().collect::<Vec<_>>().join(", "),
        millimetres("ATE", 1) => r.1.ate_m,
        millimetres("ATE after it", 1) => r.1.after_m,
        millimetres("jump", 1) => r.1.jump_m,
        millimetres("jump at most", 0) => r.0.map(Case::jump_max_m),
    ])
}

/// Counters that rose above those of the flight without a fault.
fn seen_by(case: Option<&Case>, o: &Outcome, plain: &Outcome) -> String {
    let risen = o.detected.iter().map(|(n, v)| (n, v - plain.count(n).min(*v))).filter(|(_, v)| *v > 0);
    match risen.map(|(n, v)| format!("{n} {v}")).collect::<Vec<_>>() {
        none if none.is_empty() => case.map_or("-", |c| c.unseen).to_string(),
        seen => seen.join(", "),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn outcome(detected: Vec<(&'static str, u64)>) -> Outcome {
        Outcome {
            injected: 3,
            detected,
            lost: 0,
            recovered_s: Some(0.1),
            health: Health::default(),
            ate_m: None,
            after_m: None,
            jump_m: Some(0.05),
        }
    }

    #[test]
    fn a_fault_that_is_not_seen_or_costs_too_much_is_complained_of() {
        let case = &cases()[0];
        let plain = outcome(vec![("frames_missing", 2)]);
        let said = |o: &Outcome| case.complaint(o, &plain).unwrap_or_default();
        assert_eq!(said(&outcome(vec![("frames_missing", 5)])), "");
        assert!(said(&outcome(vec![("frames_missing", 4)])).contains("saw 2 of 3"));
        assert!(said(&outcome(vec![])).contains("saw 0 of 3"));
        assert!(said(&Outcome { recovered_s: None, ..outcome(vec![("frames_missing", 5)]) }).contains("itself again"));
        assert!(said(&Outcome { jump_m: Some(0.11), ..outcome(vec![("frames_missing", 5)]) }).contains("jumps"));
        assert!(said(&Outcome { injected: 0, ..outcome(vec![]) }).contains("not injected"));
    }

    #[test]
    fn every_fault_is_expected_somewhere_and_counted_by_a_counter_that_is_looked_at() {
        for case in cases() {
            let looked_at = |name: &&str| name.is_empty() || DETECTORS.contains(name);
            assert!(looked_at(&case.each) && case.once.iter().all(looked_at), "{}", case.name);
            assert_eq!(case.each.is_empty() && case.once.is_empty(), case.unseen != "-", "{}", case.name);
        }
        assert!(QUICK.iter().all(|name| cases().iter().any(|c| c.name == *name)));
        let blind = |name: &str| cases().iter().find(|c| c.name == name).map(Case::jump_max_m);
        assert_eq!((blind("both unplugged, 5 s"), blind("left camera unplugged, 2 s")), (Some(0.5), Some(0.1)));
    }
}
