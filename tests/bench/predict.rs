//! `stipple-bench predict`: how wrong a pose is that inertial samples carry beyond the newest estimate, as whoever publishes at
//! the inertial unit's rate gives it out, and whether its covariance says so.
//!
//! Before that, how far the inertial samples lead from a recorded path: what of an error is the path's own.
//!
//! Error: of the motion from the frame's instant to so many milliseconds later, over the frames of a flight; with the samples
//! up to then, and with those up to the frame alone, the newest held. Consistency: as of `stipple-bench consistency`, of
//! position, rotation and velocity that are predicted.

use crate::consistency::{bounds, told, BIASES};
use crate::flight::{estimate_from_truth, frame_time, from_rest, velocity, BEFORE};
use crate::inputs::{self, Flight, Folders};
use crate::page::{count, millimetres, number, percent, text, Page, Part, Table};
use crate::table;
use crate::world::{room, stream, World, RATE_HZ};
use nalgebra::{SMatrix, SVector};
use std::time::Instant;
use stipple::config::{FrontendConfig, VioConfig};
use stipple::frontend::{Frontend, Prediction, Tracks};
use stipple::output::metrics::percentile;
use stipple::output::OutputDir;
use stipple::vio::{Odometry, Predicted, Predictor, Update, Vio};
use stipple_drivers::sim::{Scenario, Sim, State};
use stipple_drivers::types::pose_at;
use stipple_drivers::{Fault, ImuSample, Nanos, Pose, Span};

const AHEAD_MS: [i64; 4] = [5, 10, 20, 50];
const FRAMES: usize = 160;
/// Gap in the truth that is interpolated across.
const HOLE: Span = Span(20_000_000);
const SECONDS: f64 = 12.0;
/// How long samples are followed from the states of a recorded path, and how often, s.
const FOLLOWED: f64 = 1.0;

/// Errors at one distance ahead, m and degrees: root mean square, and at the 99th percentile.
#[derive(Clone, Copy, Debug, Default)]
pub struct Errors {
    pub p_rms: f64,
    pub p_99: f64,
    pub turn_rms: f64,
    pub turn_99: f64,
}

impl Errors {
    fn of(list: &[(f64, f64)]) -> Errors {
        let of = |pick: fn(&(f64, f64)) -> f64| {
            let values: Vec<f64> = list.iter().map(pick).collect();
            let squares = values.iter().map(|x| x * x).sum::<f64>();
            ((squares / values.len().max(1) as f64).sqrt(), percentile(&values, 0.99).unwrap_or(f64::NAN))
        };
        let ((p_rms, p_99), (turn_rms, turn_99)) = (of(|e| e.0), of(|e| e.1));
        Errors { p_rms, p_99, turn_rms, turn_99 }
    }
}

pub struct Ahead {
    pub flight: String,
    pub ms: i64,
    pub frames: usize,
    /// With the samples up to then, and with those up to the frame.
    pub carried: Errors,
    pub held: Errors,
    /// Mean time of one prediction, µs.
    pub us: f64,
}

/// Feeds samples up to the first at or past `t`.
fn feed<'a>(
    samples: &mut impl Iterator<Item = &'a ImuSample>,
    t: Nanos,
    last: &mut Nanos,
    mut take: impl FnMut(&ImuSample),
) {
    while *last < t {
        let Some(sample) = samples.next() else { return };
        take(sample);
        *last = sample.t;
    }
}

fn measure(name: &str, flight: &Flight) -> Result<Vec<Ahead>, Fault> {
    let config = VioConfig::default();
    let mut frontend = Frontend::new(&flight.calibration, &FrontendConfig::default())?;
    let mut vio = Vio::new(&flight.calibration, &config);
    let mut predictor = Predictor::new(&flight.calibration, &config);
    let (mut samples, mut fed, mut before) = (flight.imu.iter(), Nanos::MIN, None);
    let mut errors = vec![(vec![], vec![], 0.0); AHEAD_MS.len()];
    for frames in &flight.frames {
        feed(&mut samples, frames.t, &mut fed, |s| {
            vio.on_imu(*s);
            predictor.on_imu(*s);
        });
        let prediction = Prediction { prev_from_now: predictor.motion_to(frames.t, before.as_ref()) };
        before = vio.odometry();
        let update = vio.on_tracks(frontend.track(frames, &prediction));
        predictor.on_update(&update);
        let Some((o, then)) = update.odometry.zip(pose_at(&flight.truth, frames.t, HOLE)) else { continue };
        let (mut ahead, mut coming, mut last) = (predictor.clone(), samples.clone(), fed);
        for (ms, (carried, held, secs)) in AHEAD_MS.iter().zip(&mut errors) {
            let t = o.t + Span(ms * 1_000_000);
            feed(&mut coming, t, &mut last, |s| ahead.on_imu(*s));
            let Some(now) = pose_at(&flight.truth, t, HOLE) else { continue };
            let error = |p: Predicted| {
                let (moved, truth) = (o.world_from_body.inverse() * p.odometry.world_from_body, then.inverse() * now);
                (moved.p.distance(truth.p), moved.q.angle_between(truth.q).to_degrees())
            };
            let begun = Instant::now();
            let predicted = ahead.state_at(t);
            *secs += begun.elapsed().as_secs_f64();
            carried.extend(predicted.map(error));
            held.extend(predictor.state_at(t).map(error));
        }
    }
    let row = |(ms, (carried, held, secs)): (&i64, &(Vec<_>, Vec<_>, f64))| Ahead {
        flight: name.into(),
        ms: *ms,
        frames: carried.len(),
        carried: Errors::of(carried),
        held: Errors::of(held),
        us: 1e6 * secs / carried.len().max(1) as f64,
    };
    Ok(AHEAD_MS.iter().zip(&errors).map(row).collect())
}

/// NEES of what is predicted, and the share of errors within three deviations.
#[derive(Clone, Copy, Debug, Default)]
pub struct Claim {
    pub ms: i64,
    /// Mean over frames and flights, of position, rotation and velocity: nine dimensions.
    pub nees: f64,
    pub within: f64,
}

fn squared(predicted: &Predicted, truth: &Pose, v_world: glam::DVec3) -> Option<(f64, usize)> {
    let (o, c): (&Odometry, _) = (&predicted.odometry, predicted.covariance?);
    let turn = (o.world_from_body.q.conjugate() * truth.q).to_scaled_axis();
    let e = [truth.p - o.world_from_body.p, turn, v_world - o.v_world];
    let e = SVector::<f64, 9>::from_fn(|i, _| e[i / 3][i % 3]);
    let factor = SMatrix::<f64, 9, 9>::from_fn(|i, j| c[i][j]).cholesky()?;
    let within = (0..9).filter(|i| e[*i].powi(2) < 9.0 * c[*i][*i]).count();
    Some((e.dot(&factor.solve(&e)), within))
}

/// Predictions of an estimator that is told the world's own noise.
pub fn claims(flights: u64) -> Vec<Claim> {
    let mut sums = [(0.0, 0, 0); AHEAD_MS.len()];
    for seed in 0..flights {
        let mut noise = stream(seed, 1);
        let points = room(1500, &mut noise);
        let mut world = World::seen_from(from_rest, points, stream(seed, 2));
        world.rig.imu.measured = true;
        (world.gyro_bias, world.accel_bias) = (noise.vector() * BIASES.0, noise.vector() * BIASES.1);
        let imu: Vec<ImuSample> =
            (0..((frame_time(FRAMES) + BEFORE) * RATE_HZ) as usize).map(|i| world.imu(i as f64 / RATE_HZ)).collect();
        let mut config = VioConfig::default();
        told(&mut config);
        let (mut vio, mut predictor) = (Vio::new(&world.rig, &config), Predictor::new(&world.rig, &config));
        let (mut samples, mut fed, mut to_estimate) = (imu.iter(), Nanos::MIN, None);
        let mut tracks = Tracks::default();
        for frame in 0..FRAMES {
            world.tracks(frame_time(frame), &mut tracks);
            feed(&mut samples, tracks.t, &mut fed, |s| {
                vio.on_imu(*s);
                predictor.on_imu(*s);
            });
            let update = vio.on_tracks(&tracks);
            predictor.on_update(&update);
            let Some(o) = update.odometry else { continue };
            let truth = from_rest(frame_time(frame));
            let moved = *to_estimate.get_or_insert_with(|| estimate_from_truth(&o.world_from_body, &truth));
            let (mut ahead, mut coming, mut last) = (predictor.clone(), samples.clone(), fed);
            for (ms, sum) in AHEAD_MS.iter().zip(&mut sums) {
                let t = tracks.t + Span(ms * 1_000_000);
                feed(&mut coming, t, &mut last, |s| ahead.on_imu(*s));
                let at = t.0 as f64 * 1e-9;
                let (truth, v) = (moved * from_rest(at), moved.q * velocity(from_rest, at));
                if let Some((nees, within)) = ahead.state_at(t).and_then(|p| squared(&p, &truth, v)) {
                    *sum = (sum.0 + nees, sum.1 + within, sum.2 + 1);
                }
            }
        }
    }
    let claim = |(ms, sum): (&i64, &(f64, usize, usize))| {
        let n = sum.2.max(1) as f64;
        Claim { ms: *ms, nees: sum.0 / n, within: sum.1 as f64 / (9.0 * n) }
    };
    AHEAD_MS.iter().zip(&sums).map(claim).collect()
}

/// How far inertial samples lead from a path in a second, from the path's own states and biases: root mean squares.
pub struct Apart {
    pub flight: &'static str,
    pub unit: &'static str,
    pub times: usize,
    /// m, m/s and degrees.
    pub p: f64,
    pub v: f64,
    pub turn: f64,
}

fn apart(flight: &'static str, unit: &'static str, scenario: &Scenario) -> Result<Apart, Fault> {
    let sim = Sim::new(scenario)?;
    let mut predictor = Predictor::new(sim.calibration(), &VioConfig::default());
    let (mut samples, mut fed, mut sums, mut times) = (sim.imu().iter(), Nanos::MIN, [0.0; 3], 0);
    let frames_between = (FOLLOWED * scenario.rate_hz) as usize;
    for i in (0..sim.frame_count().saturating_sub(frames_between)).step_by(frames_between) {
        let [t, then] = [sim.stamp(i), sim.stamp(i + frames_between)];
        let (from, to) = (sim.truth_at(t), sim.truth_at(then));
        let State { pose: world_from_body, v_world, gyro_bias, accel_bias } = from;
        let odometry = Some(Odometry { t, world_from_body, v_world, gyro_bias, accel_bias });
        predictor.on_update(&Update { odometry, ..Update::default() });
        feed(&mut samples, then, &mut fed, |s| predictor.on_imu(*s));
        let Some(Predicted { odometry: o, .. }) = predictor.state_at(then) else { continue };
        let turn = o.world_from_body.q.angle_between(to.pose.q).to_degrees();
        let errors = [o.world_from_body.p.distance(to.pose.p), o.v_world.distance(to.v_world), turn];
        sums.iter_mut().zip(errors).for_each(|(sum, e)| *sum += e * e);
        times += 1;
    }
    let [p, v, turn] = sums.map(|sum: f64| (sum / times.max(1) as f64).sqrt());
    Ok(Apart { flight, unit, times, p, v, turn })
}

fn apart_table(rows: &[Apart]) -> Table {
    table!("apart", "Inertial unit and recorded path, after a second", rows, |r| r.unit == "recorded", [
        text("flight") => r.flight,
        text("unit") => r.unit,
        count("times") => r.times,
        number("rotation rms", "deg", 3) => r.turn,
        number("velocity rms", "m/s", 4) => r.v,
        millimetres("position rms", 2) => r.p,
    ])
}

fn ahead_table(rows: &[Ahead]) -> Table {
    table!("ahead", "Ahead of the estimate", rows, |r| r.ms == 20, [
        text("flight") => r.flight.as_str(),
        number("ahead", "ms", 0) => r.ms as f64,
        count("frames") => r.frames,
        millimetres("position rms", 2) => r.carried.p_rms,
        millimetres("position 99 %", 2) => r.carried.p_99,
        number("rotation rms", "deg", 3) => r.carried.turn_rms,
        number("rotation 99 %", "deg", 3) => r.carried.turn_99,
        millimetres("held: position 99 %", 2) => r.held.p_99,
        number("held: rotation 99 %", "deg", 3) => r.held.turn_99,
        number("time", "µs", 1) => r.us,
    ])
}

fn claim_table(rows: &[Claim]) -> Table {
    table!("claims", "What the covariance of predictions claims", rows, |r| r.ms == 20, [
        number("ahead", "ms", 0) => r.ms as f64,
        number("NEES of 9", "", 2) => r.nees,
        percent("within three deviations", 2) => r.within,
    ])
}

/// Error and covariance of poses predicted ahead of the estimate
#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    folders: Folders,
    /// A short flight
    #[arg(long)]
    quick: bool,
}

pub fn run(args: &Args) -> Result<(), Fault> {
    let out = OutputDir::create(&args.folders.out)?;
    let (seconds, flights) = if args.quick { (3.0, 2) } else { (SECONDS, 50) };
    let mut rows = measure("aggressive", &inputs::rendered(aggressive(), seconds)?)?;
    let truth = args.folders.recordings()?.join(inputs::RECORDING);
    let truth = truth.join("mav0/state_groundtruth_estimate0/data.csv");
    if truth.is_file() && !args.quick {
        let scenario = Scenario::from_euroc(&truth, None)?;
        rows.extend(measure("path of MH_01", &inputs::rendered(scenario, seconds)?)?);
    }
    let mut path = vec![];
    for (name, _, [poses, imu]) in inputs::recorded(&args.folders.recordings()?).filter(|_| !args.quick) {
        path.push(apart(name, "simulated", &Scenario::from_euroc(&poses, None)?)?);
        path.push(apart(name, "recorded", &Scenario::from_euroc(&poses, Some(&imu))?)?);
    }
    let claims = claims(flights);
    let (low, high) = bounds(9.0, flights as usize);
    let (path, ahead, claimed) = (apart_table(&path), ahead_table(&rows), claim_table(&claims));
    println!(
        "{}\n\n{}\n\n{}\n\n95 % of means over {flights} flights: {low:.2} to {high:.2}",
        path.text(),
        ahead.text(),
        claimed.text()
    );
    let page = Page {
        name: "predict",
        title: "Odometry: ahead of the estimate",
        what: format!("poses carried by inertial samples; {flights} seeded flights for the covariance"),
        facts: vec![],
        parts: vec![Part::Table(path), Part::Table(ahead), Part::Table(claimed)],
    };
    page.write(&out)
}

fn aggressive() -> Scenario {
    Scenario::named("aggressive").expect("a scenario of the simulator")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// What an autopilot takes without noticing: 2 mm and a tenth of a degree, 20 ms after an exposure.
    #[test]
    fn twenty_milliseconds_ahead_of_an_aggressive_flight_are_two_millimetres_off() {
        let rows = measure("aggressive", &inputs::rendered(aggressive(), 4.0).unwrap()).unwrap();
        let row = rows.iter().find(|r| r.ms == 20).unwrap();
        eprintln!("{:?} in {} µs", row.carried, row.us);
        assert!(row.frames > 50 && row.carried.p_99 < 0.002 && row.carried.turn_99 < 0.1, "{:?}", row.carried);
    }

    #[test]
    fn predictions_are_as_wrong_as_their_covariance_says() {
        let flights = 12;
        let (low, high) = bounds(9.0, flights);
        for claim in claims(flights as u64) {
            eprintln!("{claim:?}, {low} to {high}");
            assert!((low..high).contains(&claim.nees) && claim.within > 0.99, "{claim:?}, {low} to {high}");
        }
    }
}
