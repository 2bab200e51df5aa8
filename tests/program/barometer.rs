//! A barometer in a live run on a simulated flight: its readings reach the estimator, and a run goes on without them. What
//! becomes of one that falls silent, comes late, is unplugged or breaks is counted and said.

use std::ops::Range;
use std::path::Path;
use std::sync::atomic::AtomicBool;
use stipple::config::Board;
use stipple::output::metrics::trajectory_error;
use stipple::run::sensors::{Playback, Recorded};
use stipple::run::status::Status;
use stipple::run::tracking::{OdometryRun, Tracker};
use stipple::run::{fly_in_real_time, Flown, Realtime, Steering};
use stipple_drivers::paced::Images;
use stipple_drivers::sim::{Scenario, Sim};
use stipple_drivers::source::{AidBatch, AidReading, AidSource, SourceFault, Wait};
use stipple_drivers::{Fault, FaultKind, Frames, Nanos, Span, TimedPose};

#[derive(Clone, Copy)]
enum Trouble {
    /// Says nothing, and then all of it at once.
    Late,
    Unplugged,
    Broken,
}

/// The barometer of a flight, which fails between times of its own, s after its first reading.
struct Failing {
    source: Box<dyn AidSource>,
    troubles: Vec<(Range<f64>, Trouble)>,
    first: Option<Nanos>,
    held: Vec<AidReading>,
}

impl AidSource for Failing {
    fn next(&mut self, timeout: Span, batch: &mut AidBatch) -> Result<Wait, SourceFault> {
        let wait = self.source.next(timeout, batch)?;
        let Some(newest) = batch.last().map(|r| r.t) else { return Ok(wait) };
        let at = (newest - *self.first.get_or_insert(newest)).secs();
        let trouble = self.troubles.iter().find(|(when, _)| when.contains(&at)).map(|(_, what)| *what);
        let fault = |what: &str| Fault::new(FaultKind::Unavailable, "the test's barometer", what, "look at its cable");
        match trouble {
            None if self.held.is_empty() => return Ok(wait),
            None => {
                self.held.extend(batch.iter());
                batch.clear();
                self.held.drain(..).for_each(|reading| batch.push(reading).unwrap());
                return Ok(Wait::Got);
            }
            Some(Trouble::Late) => self.held.extend(batch.iter()),
            Some(_) => {}
        }
        batch.clear();
        match trouble {
            Some(Trouble::Unplugged) => Err(SourceFault::Lost(fault("no longer answers"))),
            Some(Trouble::Broken) => Err(SourceFault::Broken(fault("answers nonsense"))),
            _ => Ok(Wait::TimedOut),
        }
    }
}

/// A flight in real time, and its truth.
fn fly(secs: f64, troubles: Vec<(Range<f64>, Trouble)>) -> (Flown, Vec<TimedPose>) {
    let set = ["map.enabled=false", "baro.chip=bmp388"].map(String::from);
    let board = Board::load(Path::new("board-configs/lavapipe.toml"), &set).unwrap();
    let mut scenario = Scenario::named("demo").unwrap();
    (scenario.image_divisor, scenario.duration) = (2, Span::from_secs(secs));
    let mut sim = Sim::new(&scenario).unwrap();
    let count = sim.frame_count();
    let frame = |i: usize| {
        let mut frames = Frames::for_rig(sim.calibration());
        sim.render(i, &mut frames);
        frames
    };
    let frames: Vec<Frames> = (0..count).map(frame).collect();
    let stamps = frames.iter().map(|f| f.t).collect();
    let (imu, aids) = (sim.imu().to_vec(), sim.aids().to_vec());
    let mut sensors = Recorded { images: Images::Rendered(frames), stamps, imu, aids }.paced(Playback::default());
    let failing = |source| Box::new(Failing { source, troubles, first: None, held: vec![] }) as Box<dyn AidSource>;
    sensors.aids = sensors.aids.map(failing);
    let run = OdometryRun::new(sim.calibration(), &board, count).unwrap();
    let options = Realtime { holdout: 0, until_s: None, sensors_s: None, stop: &AtomicBool::new(false) };
    let tracker = Tracker::Odometry(Box::new(run));
    (
        fly_in_real_time(
            sensors,
            sim.calibration(),
            tracker,
            (None, None),
            &options,
            &mut Status::silent(),
            &mut Steering::default(),
        ),
        sim.truth(),
    )
}

/// The run came to its end, the flight is good, and the barometer said this of itself.
fn check(flown: &Flown, truth: &[TimedPose], said: &[&str]) {
    let run = flown.tracker.odometry().unwrap();
    let lines: Vec<&str> = flown.notices.iter().map(|(_, line)| line.as_str()).collect();
    assert!(flown.broken.is_none() && run.back.trajectory.seen > 40, "{lines:?}");
    assert!(trajectory_error(&run.back.trajectory, truth).unwrap().ate_rmse_m < 0.03);
    let of_barometer: Vec<_> = lines.into_iter().filter(|line| line.contains("barometer")).collect();
    assert_eq!(of_barometer.len(), said.len(), "{of_barometer:?}");
    of_barometer.iter().zip(said).for_each(|(line, start)| assert!(line.starts_with(start), "{line}"));
    let s = run.back.vio.stats();
    assert_eq!((s.pressures_rejected, s.pressures_frozen, s.resets), (0, 0, 0));
}

#[test]
fn live_barometer_that_falls_silent_or_is_unplugged_is_counted_and_taken_back() {
    let (flown, truth) = fly(7.0, vec![(2.5..3.3, Trouble::Late), (4.5..5.2, Trouble::Unplugged)]);
    check(
        &flown,
        &truth,
        &["barometer is silent", "barometer is back after 0.8 s", "barometer lost", "barometer is back after 0.7 s"],
    );
    let (c, vio) = (&flown.counters, &flown.tracker.odometry().unwrap().back.vio);
    assert_eq!((c.aid_silent.get(), c.aid_lost.get(), c.aid_overflow.get()), (1, 1, 0));
    assert!((1300..2500).contains(&c.aid_away_ms.get()), "{}", c.aid_away_ms.get());
    // Forty come late, of which the newest are still of use.
    let s = vio.stats();
    eprintln!("{} frames, {} heights, {} late", flown.frames, s.heights_used, s.pressures_late);
    assert!((20..=40).contains(&s.pressures_late), "{}", s.pressures_late);
    // Of 7 s, one and a half without; a few frames pass before the estimate starts, and those left to inertia use none.
    let tracked = flown.frames as u64 - s.frames_carried;
    assert!(s.heights_used as f64 > 0.6 * tracked as f64, "{} of {tracked}", s.heights_used);
    let [bias, sigma] = vio.height_bias().unwrap();
    assert!(bias.abs() < 0.5 && sigma > 0.0 && sigma < 0.2, "{bias} ± {sigma}");
}

#[test]
fn run_goes_on_without_a_barometer_that_breaks() {
    let (flown, truth) = fly(4.0, vec![(2.0..4.0, Trouble::Broken)]);
    check(&flown, &truth, &["barometer is broken"]);
    let used = flown.tracker.odometry().unwrap().back.vio.stats().heights_used;
    assert_eq!((flown.counters.aid_lost.get(), flown.counters.aid_silent.get()), (1, 0));
    assert!((10..=42).contains(&used), "{used}: none after it broke");
}
