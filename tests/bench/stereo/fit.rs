//! How the methods' deviations were fitted: `stipple-bench stereo --fit`.
//!
//! A variance is a sum of parts with factors of no less than zero, and errors are taken for normal. The factors of greatest
//! likelihood are those at which each part's errors are as large as it says; they are found by raising and lowering each until
//! they are (a majorisation: no step makes the errors less likely). Every range of depths counts alike,
//! however many pixels it has, from `PIXELS_MIN` on. What is judged is what `score` judges: pixels that both eyes see, errors up to `GROSS_PX`.
//!
//! Leaves `fit.json`: factors, and the variance of residuals by range on the flights fitted to and on the others.

use super::flights::Frames;
use super::methods::{Base, Runner, NAMES};
use super::score::GROSS_PX;
use super::sets::{Pair, Set};
use super::RANGES_M;
use serde_json::{json, Value};
use stipple::output::OutputDir;
use stipple::stereo::Disparity;
use stipple_drivers::{Fault, Image};

/// Of each flight, and of each frame a strip of so many rows: errors within a frame are alike, so many frames say more than
/// many rows.
pub const FRAMES: Frames = Frames { even: 4, near: 4 };
const ROWS: usize = 96;
/// One pixel in so many, coprime to the width of a picture.
const EVERY: usize = 7;
const STEPS: usize = 500;
const PIXELS_MIN: usize = 5000;
/// Parts of a variance, at most.
const PARTS: usize = 6;
const RANGES: usize = RANGES_M.len() - 1;

/// An error and what a variance of it is made of, px².
struct Sample {
    range: usize,
    error2: f64,
    parts: [f64; PARTS],
}

impl Sample {
    fn variance(&self, factors: &[f64; PARTS]) -> f64 {
        self.parts.iter().zip(factors).map(|(p, f)| p * f).sum::<f64>().max(1e-9)
    }
}

/// Fits on the first sets and judges on the second, by every method that states deviations.
pub fn fit(sets: &[Vec<Set>; 2], base: &Base, out: &OutputDir) -> Result<(), Fault> {
    let mut rows: Vec<Value> = vec![];
    for method in NAMES {
        let Some(first) = sets[0].first() else { break };
        let mut runner = match Runner::new(method, base, (first.size().0, ROWS), first.disparities) {
            Ok(runner) if !runner.parts().is_empty() => runner,
            Ok(_) => continue,
            Err(fault) => {
                eprintln!("{method} is left out: {fault}");
                continue;
            }
        };
        let fitted = gather(&sets[0], &mut runner)?;
        let factors = greatest_likelihood(&fitted);
        let others = gather(&sets[1], &mut runner)?;
        let [own, judged] = [&fitted, &others].map(|samples| by_range(samples, &factors));
        let named = runner.parts().iter().zip(factors);
        let text: Vec<String> = named.map(|(name, f)| format!("{name}: {f:.3e}")).collect();
        println!("{method}: {}", text.join(", "));
        for (k, ends) in RANGES_M.windows(2).enumerate() {
            let [a, b] = [&own, &judged].map(|r| format!("{:.2} of {:>6} px", r[k].0, r[k].1));
            println!("  {:>4} to {:>2} m: residual variance {a} fitted, {b} judged", ends[0], ends[1]);
        }
        let ranges = |r: &[(f64, usize); RANGES]| r.iter().map(|(v, n)| json!([v, n])).collect::<Vec<_>>();
        rows.push(json!({ "method": method, "parts": runner.parts(), "factors": &factors[..runner.parts().len()],
                          "ranges_m": RANGES_M, "fitted": ranges(&own), "judged": ranges(&judged) }));
        out.write("fit.json", |w| Ok(serde_json::to_writer_pretty(w, &rows)?))?;
    }
    Ok(())
}

fn gather(sets: &[Set], runner: &mut Runner) -> Result<Vec<Sample>, Fault> {
    let mut samples = vec![];
    for set in sets {
        let (w, h) = (set.size().0, ROWS);
        let fb = set.focal_baseline.unwrap_or(0.0);
        let mut found = Disparity::new(w, h);
        for (k, pair) in set.pairs.iter().enumerate() {
            let pair = strip(pair, k, fb);
            runner.run(&pair.left, &pair.right, &mut found)?;
            let first = samples.len();
            let mut places = vec![];
            for i in (0..w * h).step_by(EVERY).filter(|&i| pair.visible[i] && found.px[i] >= 0.0) {
                let (error, depth) = (found.px[i] - pair.truth[i], fb / f64::from(pair.truth[i].max(1e-3)));
                let range = RANGES_M.windows(2).position(|ends| (ends[0]..ends[1]).contains(&depth));
                if let (Some(range), true) = (range, error.abs() <= GROSS_PX) {
                    samples.push(Sample { range, error2: f64::from(error).powi(2), parts: [0.0; PARTS] });
                    places.push(i);
                }
            }
            for part in 0..runner.parts().len() {
                runner.restate(&pair.left, part, &mut found)?;
                for (sample, i) in samples[first..].iter_mut().zip(&places) {
                    sample.parts[part] = f64::from(found.sigma_px[*i]).powi(2);
                }
            }
        }
        eprintln!("{}: {} samples so far", set.name, samples.len());
    }
    Ok(samples)
}

/// Of frame `k` the rows that see most within a metre; where none does, the next ones of each frame.
fn strip(pair: &Pair, k: usize, focal_baseline: f64) -> Pair {
    let (w, h) = (pair.left.width, pair.left.height);
    let near = |d: &&f32| f64::from(**d) > focal_baseline / RANGES_M[1];
    let seen = |strip: usize| pair.truth[strip * ROWS * w..][..ROWS * w].iter().filter(near).count();
    let (most, nearest) = (0..h / ROWS).map(|s| (seen(s), s)).max().unwrap_or_default();
    let first = if most > 0 { nearest } else { k % (h / ROWS) } * ROWS * w;
    let within = first..first + ROWS * w;
    let cut = |image: &Image| Image { width: w, height: ROWS, pixels: image.pixels[within.clone()].to_vec() };
    let (left, right) = (cut(&pair.left), cut(&pair.right));
    Pair { left, right, truth: pair.truth[within.clone()].to_vec(), visible: pair.visible[within].to_vec() }
}

/// With f the factors, s a sample's parts, e its error and v = f s: f_k is multiplied by √(Σ w s_k e² / v² / Σ w s_k / v).
fn greatest_likelihood(samples: &[Sample]) -> [f64; PARTS] {
    let mut pixels = [0usize; RANGES];
    samples.iter().for_each(|s| pixels[s.range] += 1);
    let mut factors = [0.01; PARTS];
    for _ in 0..STEPS {
        let (mut seen, mut said) = ([0.0; PARTS], [0.0; PARTS]);
        for s in samples {
            let v = s.variance(&factors);
            let weight = 1.0 / pixels[s.range].max(PIXELS_MIN) as f64 / v;
            for k in 0..PARTS {
                seen[k] += weight * s.parts[k] * s.error2 / v;
                said[k] += weight * s.parts[k];
            }
        }
        for k in 0..PARTS {
            factors[k] *= if said[k] > 0.0 { (seen[k] / said[k]).sqrt() } else { 0.0 };
        }
    }
    factors
}

/// Variance of error over deviation, and of how many pixels.
fn by_range(samples: &[Sample], factors: &[f64; PARTS]) -> [(f64, usize); RANGES] {
    std::array::from_fn(|k| {
        let within = || samples.iter().filter(|s| s.range == k);
        let n = within().count();
        (within().map(|s| s.error2 / s.variance(factors)).sum::<f64>() / n.max(1) as f64, n)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::stream;

    #[test]
    fn factors_that_made_the_errors_are_found_again() {
        let mut noise = stream(5, 1);
        let truth = [0.02, 3.0, 0.0, 0.5, 0.0, 0.0];
        let mut draw = |i: usize| {
            let parts = [1.0, 0.1 * noise.uniform(), noise.uniform(), noise.uniform().powi(4), 0.0, 0.0];
            let mut sample = Sample { range: i % RANGES, error2: 0.0, parts };
            sample.error2 = sample.variance(&truth) * noise.normal().powi(2);
            sample
        };
        let samples: Vec<Sample> = (0..20_000).map(&mut draw).collect();
        let found = greatest_likelihood(&samples);
        for k in 0..PARTS {
            assert!((found[k] - truth[k]).abs() < 0.15 * truth[k] + 0.02, "{found:?}");
        }
        assert!(by_range(&samples, &found).iter().all(|(v, n)| (v - 1.0).abs() < 0.1 && *n == 4000));
    }
}
