//! What a closed loop does to the map. A seam is where an earlier visit and this one meet in the map: how well views of both
//! look is scored before the loop moves anything, after it, and a while later, the same views each time. Beside it stands how far
//! the surfaces of the map are from those that stereo finds at the newest anchors, which are other views.

use super::archive::Archive;
use super::evaluate::{mean, score};
use super::render::Rendered;
use super::scene::Scene;
use crate::gpu::GpuError;
use serde::{Deserialize, Serialize};
use stipple_drivers::Nanos;

/// Views of each visit.
const VIEWS: usize = 2;
/// Gaussians that cover so much of a pixel show a surface.
const COVERED: f32 = 0.9;
/// Bins of the disagreement of depths, and the width of one: up to 50 %.
const BINS: usize = 400;
const BIN: f32 = 0.00125;
/// Fewest pixels that tell of it.
const PIXELS_MIN: u32 = 200;

/// How well the map shows a seam; `None` where nothing could be compared.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SeamScore {
    /// Mean over its views.
    pub psnr_db: Option<f64>,
    /// Mean `depth_disagreement` of the newest anchors.
    pub disagreement: Option<f64>,
}

/// The scores of a seam over time; `None` where there was none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SeamScores {
    /// Before the loop moved anything, when it had, and ten seconds of flight later.
    pub before: Option<SeamScore>,
    pub after: Option<SeamScore>,
    pub later: Option<SeamScore>,
}

/// A seam: indices of training views, those of the earlier visit first. There are none of an earlier flight.
#[derive(Clone, Copy, Debug)]
pub struct Seam([Option<usize>; 2 * VIEWS]);

impl Seam {
    /// The seam of a loop closed with what was seen at `with`, where that was in this flight: the newest views, and those nearest
    /// in time to the other. Only views whose images and Gaussians are in memory.
    pub fn new(scene: &Scene, archive: &Option<Archive>, with: Option<Nanos>) -> Seam {
        let views = &scene.views;
        let shown = |i: usize| archive.as_ref().is_none_or(|archive| archive.is_shown(i / views.cameras()));
        let usable = |i: &usize| views.camera(*i) == 0 && views.has_place(*i) && shown(*i);
        let own = views.own_training().iter().map(|i| *i as usize).filter(usable);
        let mut seam = [None; 2 * VIEWS];
        let (earlier, newest) = seam.split_at_mut(VIEWS);
        newest.iter_mut().zip(own.clone().rev()).for_each(|(to, i)| *to = Some(i));
        for k in (0..VIEWS).filter(|_| with.is_some()) {
            let far = |i: &usize| with.map_or(0, |with| (views.get(*i).t.0 - with.0).abs());
            let other = own.clone().filter(|i| !earlier.contains(&Some(*i)) && !newest.contains(&Some(*i)));
            earlier[k] = other.min_by_key(far);
        }
        Seam(seam)
    }

    /// PSNR of the views that still have a place. Allocates.
    pub fn psnr_db(&self, scene: &mut Scene) -> Result<Option<f64>, GpuError> {
        let here = self.0.into_iter().flatten().filter(|i| scene.views.has_place(*i)).collect::<Vec<_>>();
        let scores = here.into_iter().map(|i| score(scene, i)).collect::<Result<Vec<_>, GpuError>>()?;
        Ok(mean(&scores))
    }
}

/// Median disagreement of the depth of a picture of the map with what stereo finds there, over the pixels that have both, as a
/// share of the depth. Surfaces that are there twice, or in the wrong place, are in it. 0.5 stands for that and more.
pub fn depth_disagreement(rendered: &Rendered, metres: &[f32], valid: &[u8]) -> Option<f64> {
    let (mut bins, mut count) = ([0u32; BINS + 1], 0);
    for (i, m) in metres.iter().enumerate().filter(|(i, m)| **m > 0.0 && m.is_finite() && valid[*i] != 0) {
        if rendered.alpha[i] > COVERED {
            let apart = (rendered.depth[i] - m).abs() / m;
            bins[(apart / BIN).min(BINS as f32) as usize] += 1;
            count += 1;
        }
    }
    let mut below = 0;
    let median = bins.iter().position(|n| {
        below += n;
        2 * below >= count
    });
    median.filter(|_| count >= PIXELS_MIN).map(|bin| f64::from(bin as f32 * BIN))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_disagreement_is_that_of_most_pixels_that_have_both_depths() {
        let n = 1000;
        let mut rendered = Rendered::new(n, 1, 1);
        rendered.alpha.fill(1.0);
        rendered.depth.fill(2.1);
        let (metres, valid) = (vec![2.0; n], vec![1; n]);
        let found = depth_disagreement(&rendered, &metres, &valid).expect("all pixels tell");
        assert!((found - 0.05).abs() < 0.002, "{found}");
        // What neither stereo nor the map knows tells nothing, and what is far off is in the last bin.
        rendered.depth[..400].fill(1e9);
        assert_eq!(depth_disagreement(&rendered, &metres, &valid), Some(found));
        rendered.alpha[..801].fill(0.5);
        assert_eq!(depth_disagreement(&rendered, &metres, &valid), None);
        rendered.alpha.fill(1.0);
        rendered.depth.fill(f32::MAX);
        assert_eq!(depth_disagreement(&rendered, &metres, &valid), Some(0.5));
        assert_eq!(depth_disagreement(&rendered, &vec![f32::NAN; n], &valid), None);
        assert_eq!(depth_disagreement(&rendered, &metres, &vec![0; n]), None);
    }
}
