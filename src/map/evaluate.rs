//! How good the map is: PSNR and SSIM of rendered keyframes, and pictures of some of them.
//!
//! A keyframe is compared in its exposure: the one refined beside the map, or, held out, the one between its
//! neighbours in time, and at the pose it came with; nothing of a held-out image goes into these figures, nor into the
//! next: at that pose with the correction between its neighbours, as in keyframes.tum.
//! Held-out keyframes are scored twice more, to tell the error's shares: with gain and offset fitted to the image, and
//! with the pose refined on it too.
//! Evaluation changes nothing: a run goes on from it as if there had been none.

use super::archive::Archive;
use super::exposure::{fitted_exposure, Exposure};
use super::refine::Refinement;
use super::scene::Scene;
use super::ssim::{mse, psnr_db, Ssim};
use super::step::{Target, Weights};
use super::view::View;
use super::views::Stored;
use crate::gpu::GpuError;
use crate::limits::CAMERAS_MAX;
use serde::{Deserialize, Serialize};

/// A cheap probe on a few views, through the run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CurvePoint {
    /// Seconds since the run began.
    pub t_s: f64,
    pub psnr_db: Option<f64>,
    pub psnr_heldout_db: Option<f64>,
    pub splats: u64,
    pub iterations: u64,
}

/// Means over all keyframes of a kind; `None` where there are none.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Evaluation {
    pub psnr_db: Option<f64>,
    pub ssim: Option<f64>,
    pub psnr_heldout_db: Option<f64>,
    pub ssim_heldout: Option<f64>,
    /// With the pose correction between its neighbours in time.
    pub psnr_heldout_between_db: Option<f64>,
    /// With gain and offset of each held-out view fitted by least squares over its valid pixels.
    pub psnr_heldout_fitted_db: Option<f64>,
    pub ssim_heldout_fitted: Option<f64>,
    /// With its pose refined on the image as well.
    pub psnr_heldout_aligned_db: Option<f64>,
    /// Held out, of each camera that trains.
    pub psnr_heldout_by_camera_db: Vec<Option<f64>>,
    /// Each keyframe, by its first camera.
    pub keyframe_scores: Vec<KeyframeScore>,
}

/// How well the map shows one keyframe.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct KeyframeScore {
    pub id: u64,
    pub t_ns: i64,
    pub held_out: bool,
    /// Training steps on it.
    pub steps: u32,
    pub psnr_db: Option<f64>,
}

/// A keyframe and its rendering, row-major at mapping resolution.
#[derive(Clone, Debug, Default)]
pub struct Panel {
    pub name: String,
    pub width: usize,
    pub height: usize,
    /// Grey, or three channels interleaved.
    pub observed: Vec<u8>,
    /// 0..1, as many channels or one.
    pub rendered: Vec<f32>,
    /// m; not positive or not finite where there is none.
    pub depth: Vec<f32>,
    /// Zero where not compared; empty compares all.
    pub valid: Vec<u8>,
    /// PSNR of the rendering.
    pub psnr_db: Option<f64>,
}

/// Views of a probe, of each kind.
const PROBED: usize = 5;
/// Steps of a pose refinement, and the first one's size, m and rad; each is a little smaller than the last.
const ALIGN_STEPS: i32 = 50;
const ALIGN_RATE: f64 = 2e-3;
const ALIGN_DECAY: f64 = 0.93;

/// Mean of what could be measured.
pub fn mean(values: &[Option<f64>]) -> Option<f64> {
    let n = values.iter().flatten().count();
    (n > 0).then(|| values.iter().flatten().sum::<f64>() / n as f64)
}

/// Scores a few keyframes spread over those that are in memory with what they see: trained on, and held out. Allocates.
pub fn sample(scene: &mut Scene, archive: &Option<Archive>) -> Result<[Option<f64>; 2], GpuError> {
    let shown = |i: usize| archive.as_ref().is_none_or(|archive| archive.is_shown(i));
    let mut probe = |held_out: bool| {
        let cameras = scene.views.cameras();
        let here =
            |i: &usize| scene.views.has_place(*i) && scene.views.get(*i).held_out == held_out && shown(*i / cameras);
        let of_kind: Vec<usize> = first_images(scene).filter(here).collect();
        let scores = spread(of_kind.len(), PROBED).map(|i| score(scene, of_kind[i]));
        Ok(mean(&scores.collect::<Result<Vec<_>, GpuError>>()?))
    };
    Ok([probe(false)?, probe(true)?])
}

/// Scores every keyframe of this run, those on disk too, or `most` of them spread over it. Allocates.
pub fn evaluate(
    scene: &mut Scene,
    archive: &mut Option<Archive>,
    weights: &Weights,
    most: usize,
) -> Result<Evaluation, GpuError> {
    let mut ssim_of = Ssim::new(scene.rendered.width, scene.rendered.height);
    // PSNR and SSIM of each kind.
    let mut all: [[Vec<Option<f64>>; 2]; 5] = Default::default();
    let [training, held_out, between, fitted, aligned] = &mut all;
    let mut by_camera: [Vec<Option<f64>>; CAMERAS_MAX] = Default::default();
    let mut keyframe_scores = Vec::with_capacity(scene.views.len());
    let (cameras, earlier) = (scene.views.cameras(), scene.views.earlier);
    let keyframes = (scene.views.len() - earlier) / cameras;
    let of_keyframe = |keyframe: usize| earlier + keyframe * cameras..earlier + (keyframe + 1) * cameras;
    for i in spread(keyframes, most).flat_map(of_keyframe) {
        if !bring(scene, archive, i)? {
            continue;
        }
        let observed = observed(scene, i);
        let mut add = |scene: &Scene, [psnr, ssim]: &mut [Vec<Option<f64>>; 2]| {
            let (shown, valid) = (&scene.rendered.colour, &scene.camera(i).valid);
            psnr.push(mse(&observed, shown, valid).map(psnr_db));
            ssim.push(ssim_of.mean(&observed, shown, valid));
        };
        let scored = score(scene, i)?;
        if scene.views.camera(i) == 0 {
            let s = scene.views.get(i);
            let Stored { id, t, held_out, steps, .. } = *s;
            let first = archive.as_ref().map_or(0, |archive| archive.runs.newest().first);
            keyframe_scores.push(KeyframeScore { id: id - first, t_ns: t.0, held_out, steps, psnr_db: scored });
        }
        if !scene.views.get(i).held_out {
            add(scene, training);
            continue;
        }
        by_camera[scene.views.camera(i)].push(scored);
        add(scene, held_out);
        fit(scene, i, &observed);
        add(scene, fitted);
        score_at(scene, i, scene.views.between(i))?;
        add(scene, between);
        let aligned_by = align(scene, i, &observed, weights)?;
        score_at(scene, i, aligned_by)?;
        fit(scene, i, &observed);
        add(scene, aligned);
    }
    let [training, held_out, between, fitted, aligned] = all.map(|kind| kind.map(|values| mean(&values)));
    Ok(Evaluation {
        psnr_db: training[0],
        ssim: training[1],
        psnr_heldout_db: held_out[0],
        ssim_heldout: held_out[1],
        psnr_heldout_between_db: between[0],
        psnr_heldout_fitted_db: fitted[0],
        ssim_heldout_fitted: fitted[1],
        psnr_heldout_aligned_db: aligned[0],
        psnr_heldout_by_camera_db: by_camera.iter().map(|values| mean(values)).collect(),
        keyframe_scores,
    })
}

/// Pictures of `count` keyframes spread over the run. Allocates.
pub fn panels(scene: &mut Scene, archive: &mut Option<Archive>, count: usize) -> Result<Vec<Panel>, GpuError> {
    let all: Vec<usize> = first_images(scene).collect();
    let mut panels = Vec::with_capacity(count);
    for i in spread(all.len(), count).map(|i| all[i]) {
        if !bring(scene, archive, i)? {
            continue;
        }
        let psnr_db = score(scene, i)?;
        let valid = scene.camera(i).valid.clone();
        let (planes, r) = (scene.views.planes(i), &scene.rendered);
        let n = valid.len();
        let observed = (0..n).flat_map(|k| planes.iter().map(move |p| p.pixels[k])).collect();
        let rendered = (0..n).flat_map(|k| r.colour[k..].iter().step_by(n).copied()).collect();
        let kind = if scene.views.get(i).held_out { "_heldout" } else { "" };
        let name = format!("{:04}{kind}", scene.views.get(i).id);
        let (width, height, depth) = (r.width, r.height, r.depth.clone());
        panels.push(Panel { name, width, height, observed, rendered, depth, valid, psnr_db });
    }
    Ok(panels)
}

/// Sees that a keyframe and what it sees are in memory; false where its images are lost.
fn bring(scene: &mut Scene, archive: &mut Option<Archive>, index: usize) -> Result<bool, GpuError> {
    match archive {
        Some(archive) => archive.bring(scene, index),
        None => Ok(scene.views.has_place(index)),
    }
}

/// Renders a keyframe, in its exposure, and compares; `None` where nothing is valid.
pub fn score(scene: &mut Scene, index: usize) -> Result<Option<f64>, GpuError> {
    let view = scene.view(index);
    scene.render(&view)?;
    show(scene, scene.views.exposure(index));
    Ok(mse(&observed(scene, index), &scene.rendered.colour, &scene.camera(index).valid).map(psnr_db))
}

/// The first camera's images.
fn first_images(scene: &Scene) -> impl Iterator<Item = usize> {
    (scene.views.earlier..scene.views.len()).step_by(scene.cameras.len())
}

/// Does what `score` does with another refinement of the keyframe for the moment.
fn score_at(scene: &mut Scene, index: usize, refined: Refinement) -> Result<(), GpuError> {
    let first = scene.views.first(index);
    let own = std::mem::replace(&mut scene.views.get_mut(first).refined, refined);
    let scored = score(scene, index);
    scene.views.get_mut(first).refined = own;
    scored.map(|_| ())
}

/// Puts the rendering into another exposure.
fn show(scene: &mut Scene, exposure: Exposure) {
    scene.rendered.colour.iter_mut().for_each(|x| *x = exposure.observed(f64::from(*x)) as f32);
}

/// Puts the rendering into the exposure that fits an image best.
fn fit(scene: &mut Scene, index: usize, observed: &[f32]) {
    show(scene, fitted_exposure(observed, &scene.rendered.colour, &scene.camera(index).valid));
}

/// An image plane by plane.
fn observed(scene: &Scene, index: usize) -> Vec<f32> {
    scene.views.planes(index).iter().flat_map(|p| &p.pixels).map(|p| f32::from(*p) / 255.0).collect()
}

/// The refinement of a keyframe from which the map, standing still, looks most like its image.
fn align(scene: &mut Scene, index: usize, observed: &[f32], weights: &Weights) -> Result<Refinement, GpuError> {
    let (body_from_cam, view) = (scene.views.get(index).body_from_cam, scene.view(index));
    let given = scene.views.get(scene.views.first(index)).given;
    let mut coarseness = scene.render(&view)?;
    let exposure = fitted_exposure(observed, &scene.rendered.colour, &scene.camera(index).valid);
    let target = Target { exposure, absent: None, ..scene.target(index) };
    let mut refined = Refinement::default();
    let (mut best, mut best_loss) = (refined, f64::INFINITY);
    for k in 0..ALIGN_STEPS {
        let view = View { coarseness, ..scene.view_from(index, given * refined.body_from_refined) };
        let done = scene.pipeline.train(&mut scene.gpu, &view, target, None, weights)?;
        if done.stats.overflow > 0 {
            // A picture with holes tells nothing; the next is coarser.
            coarseness = scene.pipeline.coarseness_after(&done.stats);
            continue;
        }
        if done.loss < best_loss {
            (best, best_loss) = (refined, done.loss);
        }
        let rate = ALIGN_RATE * ALIGN_DECAY.powi(k);
        refined.step_pose(&done.pose_gradient, &view.world_from_cam, &body_from_cam, rate);
    }
    Ok(best)
}

/// At most `count` indices of `len` things, evenly spread, first and last included.
pub fn spread(len: usize, count: usize) -> impl Iterator<Item = usize> {
    let n = len.min(count);
    (0..n).map(move |i| i * (len - 1) / (n - 1).max(1))
}

#[cfg(test)]
mod tests {
    #[test]
    fn spread_keeps_both_ends() {
        let spread = |len, count| super::spread(len, count).collect::<Vec<_>>();
        assert_eq!(spread(11, 6), [0, 2, 4, 6, 8, 10]);
        assert_eq!(spread(20, 3), [0, 9, 19]);
        assert_eq!(spread(2, 6), [0, 1]);
        assert_eq!((spread(1, 6), spread(20, 1)), (vec![0], vec![0]));
        assert!(spread(0, 6).is_empty());
    }
}
