//! Every method of stereo on the hard cases, whose truth is exact: what it says is right, and where it cannot know
//! it mostly says nothing.
#![allow(clippy::unwrap_used)]

use super::scenes::{hard, WIDTH};
use super::score::Score;
use super::sets::{Pair, Set};
use super::{Base, Runner};
use std::sync::OnceLock;
use stipple::stereo::Disparity;

const METHODS: [&str; 2] = ["bm", "sgbm"];

fn set(name: &str) -> &'static Set {
    static SETS: OnceLock<Vec<Set>> = OnceLock::new();
    SETS.get_or_init(hard).iter().find(|s| s.name == name).unwrap()
}

/// Every method on a case.
fn each(name: &str, judge: impl Fn(&str, &Pair, &Disparity, &Score)) {
    let set = set(name);
    let (w, h) = set.size();
    for method in METHODS {
        let mut runner = Runner::new(method, &Base::of(None), (w, h), set.disparities).unwrap();
        let mut found = Disparity::new(w, h);
        runner.run(&set.pairs[0].left, &set.pairs[0].right, &mut found).unwrap();
        let mut score = Score::default();
        score.add(&set.pairs[0], &found, [0.0, f64::INFINITY], set.focal_baseline.unwrap());
        let (s, [bad1, bad2, density]) = (&score.visible, figures(&score));
        println!("{name} {method}: visible bad1 {bad1:.4} bad2 {bad2:.4} density {density:.3}, {:?}", s.mean_px());
        judge(method, &set.pairs[0], &found, &score);
    }
}

/// Shares of visible pixels: bad1, bad2, density.
fn figures(score: &Score) -> [f64; 3] {
    let s = &score.visible;
    [s.bad1(), s.bad2(), s.density()].map(|v| v.unwrap_or(0.0))
}

/// Share of the pixels that `which` picks that have a disparity, and of these the share off by over 2 px.
fn part(pair: &Pair, found: &Disparity, which: impl Fn(usize) -> bool) -> (f64, f64) {
    let picked: Vec<usize> = (0..pair.truth.len()).filter(|&i| which(i)).collect();
    let known: Vec<&usize> = picked.iter().filter(|&&i| found.px[i] >= 0.0).collect();
    let wrong = known.iter().filter(|&&&i| (found.px[i] - pair.truth[i]).abs() > 2.0).count();
    (known.len() as f64 / picked.len() as f64, wrong as f64 / known.len().max(1) as f64)
}

#[test]
fn a_plain_wall_gets_no_wrong_depth() {
    each("hard_textureless", |method, _, _, score| {
        let [_, bad2, density] = figures(score);
        assert!(bad2 < 0.015 && density > 0.55, "{method}: {bad2} {density}");
    });
}

#[test]
fn a_repeated_pattern_is_not_taken_for_another_period() {
    each("hard_repeated", |method, _, _, score| {
        let [_, bad2, density] = figures(score);
        assert!(bad2 < 0.01 && density > 0.55, "{method}: {bad2} {density}");
    });
}

#[test]
fn a_slanted_floor_is_dense_and_right() {
    each("hard_slanted", |method, _, _, score| {
        let [bad1, _, density] = figures(score);
        assert!(bad1 < 0.005 && density > 0.88, "{method}: {bad1} {density}");
    });
}

#[test]
fn thin_poles_do_not_spoil_the_wall_behind_them() {
    each("hard_thin", |method, pair, found, score| {
        let [_, bad2, _] = figures(score);
        assert!(bad2 < 0.035, "{method}: {bad2}");
        // Far from the poles the wall is right.
        let wall = |i: usize| {
            let near = |x: usize| pair.truth[i - i % WIDTH + x] > 15.0;
            let x = i % WIDTH;
            pair.visible[i] && !(x.saturating_sub(20)..(x + 20).min(WIDTH)).any(near)
        };
        let (density, wrong) = part(pair, found, wall);
        assert!(density > 0.9 && wrong < 0.002, "{method}: {density} {wrong}");
    });
}

#[test]
fn what_only_one_eye_sees_is_mostly_left_unknown() {
    each("hard_occlusion", |method, pair, found, score| {
        let [_, bad2, density] = figures(score);
        assert!(bad2 < 0.012 && density > 0.88, "{method}: {bad2} {density}");
        let (hidden, _) = part(pair, found, |i| !pair.visible[i] && i % WIDTH > 30);
        assert!(hidden < 0.5, "{method}: {hidden} of what is hidden is known");
    });
}

#[test]
fn half_the_light_in_one_eye_changes_little() {
    each("hard_exposure", |method, _, _, score| {
        let [bad1, _, density] = figures(score);
        assert!(bad1 < 0.015 && density > 0.88, "{method}: {bad1} {density}");
    });
}

#[test]
fn a_row_of_misalignment_costs_accuracy_and_not_depth() {
    each("hard_misaligned", |method, _, _, score| {
        let [_, bad2, density] = figures(score);
        assert!(bad2 < 0.015 && density > 0.85, "{method}: {bad2} {density}");
    });
}

#[test]
fn a_black_eye_gives_no_depth() {
    each("hard_black_eye", |method, _, found, _| {
        assert!(found.px.iter().all(|d| *d < 0.0), "{method}");
    });
}
