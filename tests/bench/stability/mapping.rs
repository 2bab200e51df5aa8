//! What becomes of the map: keyframes of a simulated flight at true poses, whose images, depths, poses or settings are not as
//! they should be. A row compares the keyframes that nothing is wrong with to those of the same flight without the fault.

#[path = "../../flight/mod.rs"]
#[allow(dead_code)] // the tests of the mapper take more of it
mod keyframes;

use super::steps::twins::compare::finite;
use crate::page::{count, number, text, Table};
use crate::table;
use glam::{DQuat, DVec3};
use keyframes::{board, flight};
use std::time::Instant;
use stipple::config::Board;
use stipple::map::{Keyframe, Mapper, StepKind};
use stipple_drivers::{Calibration, Fault, FaultKind, Pose};

/// Keyframes of the flight, every fourth of them held out, and steps after each.
const KEYFRAMES: usize = 8;
const STEPS: u32 = 40;
/// Keyframes that a passing fault spoils; their neighbours 3 and 7 are held out.
const BAD: [u64; 2] = [4, 5];
/// Steps of the long row, and of the longest.
const LONG: u32 = 2_000;
const LONGEST: u32 = 100_000;
/// What sound keyframes may lose, dB: as much as is allowed where lists overflow.
const LOST_DB: f64 = 1.5;
/// Where sound keyframes cannot help losing: everything must stay finite, and the mapper must go on.
const ANY: f64 = f64::INFINITY;

/// What is wrong, on which flight.
#[derive(Clone, Copy)]
struct Case {
    name: &'static str,
    set: &'static [&'static str],
    /// Changes a keyframe before the mapper sees it.
    spoil: fn(&mut Keyframe),
    /// Keyframes that the fault spoils: they are not scored.
    bad: &'static [u64],
    /// Keyframes that are not scored either: held out beside a spoiled one, whose exposure they take over.
    unscored: &'static [u64],
    keyframes: usize,
    /// Steps beyond those that every flight has.
    more_steps: u32,
    lost_max: f64,
    /// Counters of which one must say so.
    says: &'static [&'static str],
}

const SOUND: Case = Case {
    name: "as it is",
    set: &[],
    spoil: |_| {},
    bad: &[],
    unscored: &[],
    keyframes: KEYFRAMES,
    more_steps: 0,
    lost_max: LOST_DB,
    says: &[],
};

const fn set(name: &'static str, set: &'static [&'static str]) -> Case {
    Case { name, set, ..SOUND }
}

/// A fault of the keyframes `BAD`.
const fn passing(name: &'static str, spoil: fn(&mut Keyframe)) -> Case {
    Case { name, spoil, bad: &BAD, ..SOUND }
}

/// A step of the light for the keyframes `BAD`.
const fn stepping(name: &'static str, spoil: fn(&mut Keyframe)) -> Case {
    Case { unscored: &[3], ..passing(name, spoil) }
}

/// A fault of every keyframe.
const fn lasting(name: &'static str, spoil: fn(&mut Keyframe)) -> Case {
    Case { name, spoil, lost_max: ANY, ..SOUND }
}

fn cases(longest: bool) -> Vec<Case> {
    let (long, steps) = if longest { ("100 000 steps", LONGEST) } else { ("2 000 steps", LONG) };
    vec![
        SOUND,
        Case {
            lost_max: ANY,
            ..set(
                "learning rates x0.01",
                &[
                    "map.lr_position=2e-5",
                    "map.lr_scale=3e-4",
                    "map.lr_rotation=1e-4",
                    "map.lr_opacity=5e-4",
                    "map.lr_colour=1e-4",
                ],
            )
        },
        Case {
            lost_max: ANY,
            ..set(
                "learning rates x100",
                &["map.lr_position=0.2", "map.lr_scale=3", "map.lr_rotation=1", "map.lr_opacity=5", "map.lr_colour=1"],
            )
        },
        Case { lost_max: ANY, ..set("rates of poses and exposures x100", &["map.lr_pose=1e-2", "map.lr_exposure=1"]) },
        Case { more_steps: steps, set: &["map.steps_per_keyframe_max=0"], ..set(long, &[]) },
        Case { keyframes: 1, more_steps: 500, set: &["map.steps_per_keyframe_max=0"], ..set("one view only", &[]) },
        lasting("black images", |k| fill(k, |_, _| 0)),
        lasting("white images", |k| fill(k, |_, _| 255)),
        lasting("images of noise", |k| noise(k, 0..2)),
        lasting("a checkerboard of 1 px", |k| fill(k, |x, y| 255 * ((x + y) % 2) as u8)),
        lasting("a checkerboard of 8 px", |k| fill(k, |x, y| 255 * ((x / 8 + y / 8) % 2) as u8)),
        // Such keyframes are not offered to the mapper in flight.
        passing("black for two keyframes", |k| fill(k, |_, _| 0)).losing(&["depth_absent"]),
        passing("white for two keyframes", |k| fill(k, |_, _| 255)).losing(&["depth_absent"]),
        passing("noise for two keyframes", |k| noise(k, 0..2)),
        passing("right image of noise for two keyframes", |k| noise(k, 1..2)),
        stepping("exposure of half for two keyframes", |k| light(k, 0.5)),
        stepping("exposure of an eighth for two keyframes", |k| light(k, 0.125)),
        // What is white tells nothing.
        stepping("exposure x2 for two keyframes", |k| light(k, 2.0)).within(4.0),
        stepping("exposure x8 for two keyframes", |k| light(k, 8.0)).within(4.0),
        passing("depths of half for two keyframes", |k| shift(k, true)),
        passing("depths of far away for two keyframes", |k| shift(k, false)),
        passing("poses off by 1 m and 30° for two keyframes", |k| {
            k.world_from_body = k.world_from_body * Pose::new(DQuat::from_rotation_z(0.52), DVec3::new(0.6, -0.8, 0.0));
        }),
        Case {
            says: &["keyframes_not_finite"],
            ..passing("poses that are not numbers for two keyframes", |k| k.world_from_body.p.x = f64::NAN)
        },
        set("no room for Gaussians: 500", &["budget.splats=500"]).losing(&["splats_full", "splats_evicted"]),
        set("no room for intersections: 4000", &["budget.splats=4000", "budget.intersections=4000"])
            .losing(&["views_coarsened", "intersections_overflow"]),
        set("no room for keyframes: 3", &["budget.keyframes=3"]).losing(&["keyframe_store_full"]),
        set("no room for occupied cells: 64", &["map.occupancy_cells=64"]).losing(&["occupancy_full"]),
        lasting("1 km from the origin", |k| k.world_from_body.p += DVec3::new(800.0, -600.0, 10.0)).within(LOST_DB),
        lasting("10 km from the origin", |k| k.world_from_body.p += DVec3::new(8e3, -6e3, 100.0)).within(LOST_DB),
        lasting("1000 km from the origin", |k| k.world_from_body.p += DVec3::new(8e5, -6e5, 100.0)),
    ]
}

impl Case {
    /// Bound by nothing, as long as one of `says` is counted.
    fn losing(self, says: &'static [&'static str]) -> Case {
        Case { lost_max: ANY, says, ..self }
    }

    fn within(self, lost_max: f64) -> Case {
        Case { lost_max, ..self }
    }

    /// The board of the mapper's tests, with stereo on the GPU, which is the same on every device.
    fn board(&self) -> Board {
        board(&[&["stereo.method=sgm"][..], self.set].concat())
    }

    fn is_bad(&self, id: u64) -> bool {
        self.bad.contains(&id)
    }
}

fn fill(k: &mut Keyframe, level: fn(usize, usize) -> u8) {
    for image in &mut k.images {
        let width = image.width;
        image.pixels.iter_mut().enumerate().for_each(|(i, p)| *p = level(i % width, i / width));
    }
}

/// Grey levels at random, other ones in every image.
fn noise(k: &mut Keyframe, images: std::ops::Range<usize>) {
    for (camera, image) in k.images.iter_mut().enumerate().filter(|(camera, _)| images.contains(camera)) {
        let mut rng = stipple::map::schedule::Rng::new(k.id * 2 + camera as u64);
        image.pixels.iter_mut().for_each(|p| *p = rng.below(256) as u8);
    }
}

fn light(k: &mut Keyframe, gain: f32) {
    let lit = |p: &mut u8| *p = (f32::from(*p) * gain).round().clamp(0.0, 255.0) as u8;
    k.images.iter_mut().flat_map(|image| &mut image.pixels).for_each(lit);
}

/// Moves the right image so that every disparity is twice what it was at 3 m, or nothing.
fn shift(k: &mut Keyframe, nearer: bool) {
    // 115 px of focal length, 0.11 m of baseline.
    let px = 4;
    let right = &mut k.images[1];
    for row in right.pixels.chunks_exact_mut(right.width) {
        if nearer {
            row.rotate_left(px);
        } else {
            row.rotate_right(px);
        }
    }
}

/// What a flight left.
#[derive(Clone, Default)]
struct Flown {
    /// PSNR of each keyframe, by its number, and whether it is held out.
    scores: Vec<(u64, bool, f64)>,
    splats: usize,
    finite: bool,
    counts: Vec<(&'static str, u64)>,
}

impl Flown {
    /// Mean PSNR of the sound keyframes that `other` has, too.
    fn mean(&self, case: &Case, held_out: bool, other: &Flown) -> Option<f64> {
        let has = |id: &u64| other.scores.iter().any(|score| score.0 == *id);
        let sound = |id: &u64| !case.is_bad(*id) && !case.unscored.contains(id);
        let of = self.scores.iter().filter(|(id, held, _)| *held == held_out && sound(id) && has(id));
        let db: Vec<f64> = of.map(|s| s.2).collect();
        (!db.is_empty()).then(|| db.iter().sum::<f64>() / db.len() as f64)
    }

    fn count(&self, name: &str) -> u64 {
        self.counts.iter().find(|(n, _)| *n == name).map_or(0, |c| c.1)
    }
}

fn fly(case: &Case, (calibration, flight): &(Calibration, Vec<Keyframe>)) -> Result<Flown, Fault> {
    let lost =
        |e| Fault::new(FaultKind::Unavailable, case.name, format!("{e:?}"), "check the device with `stipple doctor`");
    let mut mapper = Mapper::open(calibration, &case.board())?;
    let mut flown = Flown { finite: true, ..Flown::default() };
    for (n, sound) in flight.iter().take(case.keyframes).enumerate() {
        let mut keyframe = sound.clone();
        if case.bad.is_empty() || case.is_bad(keyframe.id) {
            (case.spoil)(&mut keyframe);
        }
        mapper.ingest(&keyframe).map_err(lost)?;
        let last = n + 1 == case.keyframes;
        let mut left = STEPS + if last { case.more_steps } else { 0 };
        while left > 0 {
            let report = mapper.step(Instant::now()).map_err(lost)?;
            if report.kind == StepKind::Idle {
                break;
            }
            flown.finite &= report.loss.is_finite();
            left -= report.iterations.min(left);
        }
    }
    let scores = mapper.evaluate().map_err(lost)?.keyframe_scores;
    flown.scores = scores.iter().filter_map(|s| Some((s.id, s.held_out, s.psnr_db?))).collect();
    flown.finite &= flown.scores.iter().all(|score| score.2.is_finite());
    let splats = mapper.splats().map_err(lost)?;
    flown.finite &= splats.iter().all(finite);
    flown.splats = splats.len();
    flown.counts = mapper.counters().list().into_iter().filter(|(_, n)| *n > 0).collect();
    Ok(flown)
}

pub struct Row {
    case: Case,
    flown: Flown,
    /// What sound keyframes lost that were trained on, and those held out, dB.
    lost: Option<f64>,
    lost_held_out: Option<f64>,
    /// Counters that the flight without the fault does not have, or has less of.
    said: Vec<&'static str>,
}

impl Row {
    fn verdict(&self) -> &'static str {
        let worse = self.lost.is_none_or(|lost| !(lost <= LOST_DB));
        match (worse, self.said.is_empty()) {
            (false, _) => "survived",
            (true, false) => "detected",
            (true, true) => "worse",
        }
    }

    /// The first thing that is not as it has to be.
    pub fn complaint(&self) -> Option<String> {
        let Case { name, lost_max, says, .. } = self.case;
        if !self.flown.finite {
            return Some(format!("{name}: something of the map is not finite"));
        }
        if !says.is_empty() && !says.iter().any(|n| self.flown.count(n) > 0) {
            return Some(format!("{name}: none of {says:?} was counted"));
        }
        let lost = self.lost.unwrap_or(f64::INFINITY);
        let over = lost_max.is_finite() && !(lost <= lost_max);
        over.then(|| format!("{name}: {lost:.2} dB less on sound keyframes, {lost_max} are allowed"))
    }
}

/// Cases whose name contains `only`; `longest` takes 100 000 steps in one of them.
pub fn rows(longest: bool, only: &str) -> Result<Vec<Row>, Fault> {
    let cases: Vec<Case> = cases(longest).into_iter().filter(|case| case.name.contains(only)).collect();
    rows_of(&cases)
}

fn rows_of(cases: &[Case]) -> Result<Vec<Row>, Fault> {
    if cases.is_empty() {
        return Ok(vec![]);
    }
    let flight = flight(KEYFRAMES);
    let sound = fly(&SOUND, &flight)?;
    let row = |case: &Case| -> Result<Row, Fault> {
        let flown = fly(case, &flight)?;
        let lost = |held_out| Some(sound.mean(case, held_out, &flown)? - flown.mean(case, held_out, &sound)?);
        let more = flown.counts.iter().filter(|(name, n)| *n > sound.count(name) && !USUAL.contains(name));
        let said = more.map(|c| c.0).collect();
        Ok(Row { case: *case, lost: lost(false), lost_held_out: lost(true), said, flown })
    };
    cases.iter().map(row).collect()
}

/// Counters of what the mapper does on any flight, some of it now and then.
const USUAL: [&str; 8] = [
    "seeds_occupied",
    "splats_densified",
    "splats_pruned",
    "intersections_most",
    "anchors_for_error",
    "rectified_anew",
    "views_covered",
    "occupancy_full",
];

pub const NOTE: &str = "Map: eight keyframes of a simulated flight at true poses, 188x120, 40 steps after each. Lost: PSNR of the keyframes that nothing is wrong with, beside the same of the flight without the fault (trained on; held out, given pose). Survived: at most 1.5 dB. Detected: more, and a counter says so that the sound flight does not have. Worse: more, and nothing says so. Losses of held-out keyframes are shown and not judged. Everything must stay finite. Where images are wrong throughout, or settings, the loss has no bound.";

pub fn table(rows: &[Row]) -> Table {
    table!("map", "Map", rows, |r| r.complaint().is_some(), [
        text("case") => r.case.name,
        text("verdict") => r.verdict(),
        number("PSNR", "dB", 2) => r.flown.mean(&r.case, false, &r.flown),
        number("held out", "dB", 2) => r.flown.mean(&r.case, true, &r.flown),
        number("lost", "dB", 2) => r.lost,
        number("lost, held out", "dB", 2) => r.lost_held_out,
        text("all finite") => if r.flown.finite { "yes" } else { "NO" },
        count("Gaussians") => r.flown.splats as u64,
        text("said") => r.said.iter().map(|n| format!("{n} {}", r.flown.count(n))).collect::<Vec<_>>().join(", "),
    ])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_case_has_a_board() {
        for case in cases(false) {
            case.board();
        }
    }

    /// Two of the cases; `stipple-bench stability` flies them all.
    #[test]
    fn the_map_survives_changes_of_light_and_poses_that_are_not_numbers() {
        let some = ["exposure of an eighth for two keyframes", "poses that are not numbers for two keyframes"];
        let cases: Vec<Case> = cases(false).into_iter().filter(|c| some.contains(&c.name)).collect();
        let rows = rows_of(&cases).expect("a device");
        println!("{}", table(&rows).text());
        assert_eq!(rows.len(), some.len());
        assert_eq!(rows.iter().filter_map(Row::complaint).collect::<Vec<_>>(), Vec::<String>::new());
    }
}
