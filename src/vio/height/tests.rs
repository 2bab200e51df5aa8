//! A barometer on climbs of the synthetic world: what it adds, what it must not believe, and its Jacobians.

use super::super::factors::{of_window, Factor};
use super::super::rows::FactorRows;
use super::super::world::{stream, Noise, Path, World, FRAME_SECS, RATE_HZ};
use super::super::Vio;
use super::*;
use crate::config::{BaroConfig, VioConfig};
use crate::frontend::Tracks;
use glam::DVec3;
use stipple_drivers::source::{Aid, AidReading};
use stipple_drivers::Pose;

/// Noise of a reading and drift in ten minutes, m: what a board says of a barometer by default.
const NOISE: f64 = 0.03;
const DRIFT: f64 = 1.0;
const BARO_HZ: f64 = 50.0;
/// Altitude of the take-off, m.
const GROUND: f64 = 250.0;
/// When the climb begins and how long it takes, s, and how high it goes, m.
const CLIMB: (f64, f64, f64) = (2.0, 30.0, 120.0);
/// Walls of the shaft that is climbed, m from its middle: a view between buildings.
const WALLS: f64 = 20.0;

fn climb(t: f64) -> Pose {
    let (from, secs, height) = CLIMB;
    let s = ((t - from) / secs).clamp(0.0, 1.0);
    let pose = Path { rest: -1.0 }.pose(t);
    Pose::new(pose.q, pose.p + DVec3::Z * (height * s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)))
}

/// Points on the walls of a shaft, `half` from its middle, as many as give a view a hundred.
fn shaft(half: f64, noise: &mut Noise) -> Vec<DVec3> {
    let n = 75_000.0 / half;
    let wall = |noise: &mut Noise| {
        let (u, z) = (half * (2.0 * noise.uniform() - 1.0), 160.0 * noise.uniform() - 20.0);
        match noise.bits() % 4 {
            0 => DVec3::new(half, u, z),
            1 => DVec3::new(-half, u, z),
            2 => DVec3::new(u, half, z),
            _ => DVec3::new(u, -half, z),
        }
    };
    (0..n as usize).map(|_| wall(noise)).collect()
}

fn pressure(altitude: f64) -> f64 {
    101_325.0 * (1.0 - altitude * 0.0065 / 288.15).powf(9.80665 / (287.052_87 * 0.0065))
}

/// What a flight came to: errors of height and of the bias, and the deviation stated of it, at frames a second apart, m.
struct Flight {
    errors: Vec<[f64; 3]>,
    vio: Vio,
}

impl Flight {
    fn most(&self) -> f64 {
        self.errors.iter().map(|[z, ..]| z.abs()).fold(0.0, f64::max)
    }

    fn last(&self) -> [f64; 3] {
        *self.errors.last().expect("it flew")
    }

    /// By how much its height differs from that of another flight at most, m.
    fn bends(&self, other: &Flight) -> f64 {
        assert_eq!(self.errors.len(), other.errors.len());
        self.errors.iter().zip(&other.errors).map(|(a, b)| (a[0] - b[0]).abs()).fold(0.0, f64::max)
    }
}

/// Where a flight goes, and what it sees.
#[derive(Clone, Copy)]
struct Course {
    pose: fn(f64) -> Pose,
    /// Distance of the walls, m.
    walls: f64,
    /// One in so many points is seen: far from walls few corners are found.
    thinned: u64,
    secs: f64,
}

/// A climb of 120 m between walls so far away.
fn climb_between(walls: f64) -> Course {
    Course { pose: climb, walls, thinned: 1, secs: 34.0 }
}

/// Flies along a course; `reading` makes what the barometer gives out of the stamp and the altitude it should give.
fn fly(
    seed: u64,
    Course { pose, walls, thinned, secs }: Course,
    barometer: bool,
    mut reading: impl FnMut(f64, f64) -> Option<(f64, f64)>,
) -> Flight {
    let mut noise = Noise(seed);
    let points = shaft(walls, &mut noise);
    let mut world = World::seen_from(pose, points, noise);
    let mut vio = Vio::new(&world.rig, &VioConfig::default());
    if barometer {
        vio = vio.with_barometer(&BaroConfig { chip: "bmp388".into(), ..BaroConfig::default() });
    }
    let (mut air, mut drift, mut readings) = (stream(seed, 0x4241_524f), 0.0, 0);
    let (mut tracks, mut samples) = (Tracks::default(), 0);
    let (mut first, mut start) = (None, None);
    let mut errors = vec![];
    for frame in 0..(secs / FRAME_SECS) as usize {
        let t = frame as f64 * FRAME_SECS + 0.0012;
        while samples as f64 / RATE_HZ < t + 1.0 / RATE_HZ {
            vio.on_imu(world.imu(samples as f64 / RATE_HZ));
            samples += 1;
        }
        while (readings as f64) / BARO_HZ < t {
            let at = readings as f64 / BARO_HZ;
            drift += air.normal() * DRIFT * (1.0 / BARO_HZ / 600.0).sqrt();
            let altitude = GROUND + pose(at).p.z + drift + air.normal() * NOISE;
            first = first.or(Some(altitude));
            if let Some((stamp, pa)) = reading(at, altitude) {
                vio.on_aid(&AidReading { t: Nanos((stamp * 1e9) as i64), value: Aid::Pressure(pa) });
            }
            readings += 1;
        }
        world.tracks(t, &mut tracks);
        tracks.cameras.iter_mut().for_each(|c| c.retain(|t| t.id % thinned == 0));
        let Some(odometry) = vio.on_tracks(&tracks).odometry else { continue };
        let (z, truth) = (odometry.world_from_body.p.z, pose(t).p.z);
        let offset = *start.get_or_insert(z - truth);
        if frame % 20 == 0 {
            let bias = vio.height_bias().unwrap_or([f64::NAN; 2]);
            let expected = GROUND + drift - offset - first.expect("readings come first");
            errors.push([z - truth - offset, bias[0] - expected, bias[1]]);
        }
    }
    Flight { errors, vio }
}

fn true_reading(t: f64, altitude: f64) -> Option<(f64, f64)> {
    Some((t, pressure(altitude)))
}

/// Root mean square, over flights, of the largest error of height in each, m; and by how many deviations the barometer's bias was
/// off at most. At most a share `refused` of its heights is refused.
fn climbs(course: Course, barometer: bool, refused: f64) -> [f64; 2] {
    let (mut square, mut worst) = (0.0, 0.0f64);
    let seeds = [1, 2, 3];
    for seed in seeds {
        let flown = fly(seed, course, barometer, true_reading);
        let sigmas = flown.errors.iter().map(|[_, e, s]| (e / s).abs()).fold(0.0, f64::max);
        let ([z, bias, sigma], off, s) = (flown.last(), flown.most(), &flown.vio.stats);
        eprintln!(
            "walls {} m away, seed {seed}: height off by {off:.3} m at most, {z:.3} at the top; bias by {bias:.3} of \
             {sigma:.3}, {sigmas:.2} sigma at most",
            course.walls
        );
        let (used, gated) = (s.heights_used as f64, s.heights_gated as f64);
        assert!(!barometer || used > 500.0 && gated <= refused * used, "{gated} of {used} refused");
        square += off * off / seeds.len() as f64;
        worst = worst.max(sigmas);
    }
    [square.sqrt(), worst]
}

#[test]
fn barometer_holds_the_height_of_a_climb_and_its_drift_is_told_apart() {
    let [off, sigmas] = climbs(climb_between(WALLS), true, 0.0);
    eprintln!("climb of 120 m: {off:.3} m; bias within {sigmas:.2} sigma");
    assert!(off <= 0.3 && sigmas < 3.5, "{off} {sigmas}");
}

/// Walls twice as far, of which a third of the points is seen: the scale is hardly observed.
#[test]
fn climb_far_from_walls_keeps_its_scale() {
    let course = Course { thinned: 3, ..climb_between(2.0 * WALLS) };
    let [[without, _], [with, _]] = [false, true].map(|barometer| climbs(course, barometer, 0.1));
    eprintln!("climb far from walls: {without:.3} m without barometer, {with:.3} with");
    assert!(without < 2.0 && with < 0.5, "{without} {with}");
}

/// Ten seconds of a flight in a room, where a barometer adds nothing.
const ROOM: Course = Course { pose: |t| Path { rest: -1.0 }.pose(t), walls: 4.0, thinned: 1, secs: 12.0 };

#[test]
fn door_that_slams_does_not_bend_the_flight() {
    let quiet = fly(1, ROOM, true, true_reading);
    let slammed = fly(1, ROOM, true, |t, h| {
        let slam = if (5.0..7.0).contains(&t) { 3.0 } else { 0.0 };
        Some((t, pressure(h + slam)))
    });
    let s = &slammed.vio.stats;
    eprintln!(
        "slam: bent by {:.4} m, {} heights refused, {} steps",
        slammed.bends(&quiet),
        s.heights_gated,
        s.height_steps
    );
    assert!(slammed.bends(&quiet) < 0.02 && (38..=42).contains(&s.heights_gated) && s.height_steps == 0);
}

#[test]
fn step_that_stays_becomes_bias() {
    let quiet = fly(1, ROOM, true, true_reading);
    let stepped = fly(1, ROOM, true, |t, h| Some((t, pressure(h + if t > 4.0 { 2.0 } else { 0.0 }))));
    let (s, [_, bias, sigma]) = (&stepped.vio.stats, stepped.last());
    eprintln!(
        "step: bent by {:.4} m, bias off by {:.3} of {sigma:.3}, {} steps",
        stepped.bends(&quiet),
        bias - 2.0,
        s.height_steps
    );
    assert!(stepped.bends(&quiet) < 0.02 && (bias - 2.0).abs() < 3.0 * sigma && s.height_steps == 1);
}

#[test]
fn readings_that_say_nothing_change_nothing_and_are_counted() {
    let none = fly(1, ROOM, false, true_reading);
    assert_eq!((none.vio.stats.heights_used, none.vio.height_bias()), (0, None), "not asked for, not taken");
    let odd = |reading: fn(f64, f64) -> Option<(f64, f64)>| fly(1, ROOM, true, reading);
    let absent = odd(|_, _| None);
    let not_numbers =
        odd(|t, _| Some((t, [f64::NAN, f64::INFINITY, -1.0, 0.0, 2e5][(t * BARO_HZ).round() as usize % 5])));
    let constant = odd(|t, _| Some((t, 98_000.0)));
    let late = odd(|t, h| Some((t - 1.0, pressure(h + 30.0 * t))));
    let backwards = odd(|t, h| Some((100.0 - t, pressure(h))));
    let counts = |f: &Flight| {
        let s = &f.vio.stats;
        [s.pressures_rejected, s.pressures_frozen, s.pressures_late, s.heights_used]
    };
    for (name, flight, expected) in [
        ("absent", &absent, [0, 0, 0, 0]),
        ("not numbers", &not_numbers, [598, 0, 0, 0]),
        ("late", &late, [0, 0, 575, 0]),
        ("backwards", &backwards, [597, 0, 0, 0]),
    ] {
        eprintln!("{name}: bent by {:.6} m, {:?}", flight.bends(&none), counts(flight));
        assert_eq!(counts(flight), expected, "{name}");
        assert!(flight.bends(&none) < 1e-3 && flight.vio.height_bias().is_none(), "{name}");
    }
    eprintln!("constant: bent by {:.6} m, {:?}", constant.bends(&none), counts(&constant));
    assert_eq!(counts(&constant)[1], 589);
    assert!(constant.bends(&none) < 0.02, "but for the first few it is refused");
}

#[test]
fn rows_are_the_derivatives_of_the_cost() {
    let vio = fly(1, Course { secs: 3.0, ..climb_between(WALLS) }, true, true_reading).vio;
    let graph = &vio.estimator.graph;
    let (window, model) = (&graph.window, &vio.estimator.model);
    let (layout, mut out, mut seen) = (Layout::of(window), FactorRows::new(), [0; 2]);
    for factor in of_window(window, &[]) {
        match factor {
            Factor::Height { .. } => seen[0] += 1,
            Factor::HeightWalk { .. } => seen[1] += 1,
            _ => continue,
        }
        let cost_at = |column: usize, h: f64| {
            let (mut dx, mut cost, mut moved) = (vec![0.0; layout.dim], 0.0, window.clone());
            dx[column] = h;
            moved.step(&layout, &dx);
            factor.add_cost(&moved, model, &mut cost);
            cost
        };
        let linearized = factor.linearize(window, model, &layout, &mut out);
        assert!((linearized.cost - cost_at(0, 0.0)).abs() < 1e-12);
        let row = out.rows.row(0);
        let mut gradient = vec![0.0; layout.dim];
        for (i, column) in out.columns.iter().flat_map(|c| c.at..c.at + c.len).enumerate() {
            gradient[column] = row[i] * row[row.len() - 1];
        }
        for (column, expected) in gradient.iter().enumerate() {
            let numeric = (cost_at(column, 1e-6) - cost_at(column, -1e-6)) / 2e-6;
            assert!(
                (numeric - expected).abs() < 1e-5 * (1.0 + expected.abs()),
                "{factor:?} {column}: {numeric} {expected}"
            );
        }
    }
    assert!(seen[0] >= 1 && seen[1] >= 1, "{seen:?}");
}

#[test]
fn altitude_is_that_of_the_standard_atmosphere() {
    // ISO 2533, tables: geopotential altitudes.
    for (pa, m) in [(101_325.0, 0.0), (95_460.8, 500.0), (89_874.6, 1000.0), (79_495.2, 2000.0), (54_019.9, 5000.0)] {
        assert!((altitude(pa, 15.0) - m).abs() < 0.05, "{pa}: {}", altitude(pa, 15.0));
    }
    let climb = |air_c: f64| altitude(pressure(300.0), air_c) - altitude(pressure(180.0), air_c);
    assert!((climb(15.0) - 120.0).abs() < 1e-6 && (climb(25.0) - 124.16).abs() < 0.01, "{}", climb(25.0));
}
