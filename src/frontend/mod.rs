//! Images in, tracked points out: a stereo patch tracker.
//!
//! ```text
//! frames -> pyramids -> follow every view from the last frame (IMU-predicted start, refined
//!                       against the patch first seen, checked backwards)
//!        -> epipolar gate -> match views that are missing
//!        -> camera by camera: detect in free cells -> match those in the others
//! ```
//!
//! Any number of cameras, with or without overlap: each finds points where it sees what no earlier camera
//! does, or where those that do are blind, so that what is seen twice is found once. The same id in another
//! camera is the same point. Each view is followed in its own camera; a point lives while any camera sees
//! it, and what one camera lost is looked for again from another in every frame. The patch of the last
//! frame finds the point, the patch first seen (the reference) places it: without a reference each frame adds its
//! own rounding to the drift. A prediction is refined over the fine levels alone, which is faster and slips less;
//! where it fails the whole pyramid is searched. An image that is missing or not of its camera's size is refused: that
//! camera sees nothing in this frame. Same frames and predictions, same bits out.

mod agreement;
mod detect;
mod geometry;
mod patch;
mod pattern;
mod points;
mod pyramid;
mod search;
mod tracks;

pub use agreement::{Verdict, Verdicts};
pub use tracks::{Rejected, Track, Tracks};

use crate::config::FrontendConfig;
use crate::limits::{CAMERAS_MAX, PYRAMID_LEVELS, TRACKS};
use agreement::Agreement;
use detect::Detector;
use geometry::RigGeometry;
use patch::{take_stack, Stack, Warp, STEP_MIN};
use points::{distance, Point, Points, FINE_LEVELS};
use pyramid::FramePyramids;
pub use pyramid::{Levels, Pyramid};
use search::{Limits, Search};
use std::sync::Arc;
use stipple_drivers::{counters, Calibration, Fault, FaultKind, Frames, Image, Nanos, Pose};

/// What is known of the motion before the images are looked at.
#[derive(Clone, Copy, Debug, Default)]
pub struct Prediction {
    /// Motion of the body since the previous frame, from the inertial samples; `None` where it is not known.
    pub prev_from_now: Option<Pose>,
}

counters! {
    /// What happened to points since the start.
    #[derive(Clone, Copy, PartialEq, Eq)]
    pub struct Stats of u64, read by u64::clone;
    tracks_created,
    /// Views that were not found again (of a point that may live on in another camera).
    tracks_lost,
    /// Views found from another camera.
    tracks_matched,
    /// Views dropped because their ray misses that of the first camera that sees the point.
    tracks_epipolar_rejected,
    /// Points dropped because an older one is near.
    tracks_crowded,
    /// Points dropped because the estimator rejected them.
    tracks_contradicted,
    /// Corners and views that did not fit.
    tracks_full,
    /// Images that were missing, not of their camera's size, or of a camera the rig has not.
    frontend_images_refused,
}

/// Share of a patch's contrast that may stay unexplained from one frame to the next, and between
/// cameras, whose views differ more.
const UNEXPLAINED_MAX: f32 = 0.4;
const UNEXPLAINED_MATCH_MAX: f32 = 0.6;
/// The reference places a point while it leaves at most this many times what the last frame's patch
/// leaves unexplained, and does not pull it further than this, px. Kept longer it would trade
/// drift for the bias of a view that has changed.
const REFERENCE_LEFT_MAX: f32 = 2.0;
const REFERENCE_PULL_MAX_PX: f32 = 1.0;
/// A corner is worth following when one grey level of noise moves it less than this, px.
const SIGMA_MAX_PX: f32 = 0.2;
/// Points keep this share of a cell from each other.
const SPACING: f32 = 0.25;
/// Guess before anything was triangulated, 1/m.
const INVERSE_DEPTH_START: f64 = 0.25;
/// Inverse depths tried along the epipolar curve when the first guess fails: 0 to this, 1/m.
const SEARCH_INVERSE_DEPTH_MAX: f64 = 2.0;
/// At f·b = 50 px·m two steps differ by 6.7 px of disparity: 1.7 px at the level that judges them,
/// inside the basin of the alignment.
const SEARCH_STEPS: usize = 16;
const SEARCH_LEVEL: usize = 2;
/// Best of them that are tried in full.
const SEARCH_TRIES: usize = 3;
/// A point that no search found is searched for less and less often, and one of unknown depth not even
/// guessed at in between, frames.
const SEARCH_WAIT_MAX: u64 = 16;

/// A camera with fewer points than this gives none to the others: they look for their own.
const GIVES_MIN: usize = 8;

/// Deviations of estimated places by which epipolar gates are widened.
const RIG_SIGMAS: f64 = 3.0;

/// The tracker of one rig.
pub struct Frontend {
    rig: RigGeometry,
    limits: Limits,
    spacing_px: f32,
    now: FramePyramids,
    before: FramePyramids,
    /// Cameras whose image was taken; the pyramids of the others are of an old one and are not looked at.
    seeing: [bool; CAMERAS_MAX],
    detectors: Vec<Detector>,
    points: Points,
    /// Patch that is looked for, and where it was found.
    source: Stack,
    scratch: Stack,
    inverse_depths: Vec<f64>,
    /// Frames so far.
    frame: u64,
    tracks: Tracks,
    stats: Stats,
    agreement: Agreement,
}

impl Frontend {
    /// Fails where the rig has no camera, too many, or one too small.
    pub fn new(calibration: &Calibration, config: &FrontendConfig) -> Result<Frontend, Fault> {
        let n = calibration.cameras.len();
        let least = 4 * detect::BORDER;
        let small = calibration.cameras.iter().any(|c| c.camera.width < least || c.camera.height < least);
        if n == 0 || n > CAMERAS_MAX || small {
            let what = format!("the tracker takes 1 to {CAMERAS_MAX} cameras of at least {least} px a side");
            return Err(Fault::new(FaultKind::Config, "calibration", what, "use a calibration of this rig"));
        }
        let rig = RigGeometry::new(calibration, config.epipolar_max);
        Ok(Frontend {
            detectors: (0..n).map(|camera| detector(calibration, &rig, camera, config)).collect(),
            rig,
            limits: Limits::new(config),
            spacing_px: SPACING * config.grid_px as f32,
            now: FramePyramids::new(calibration),
            before: FramePyramids::new(calibration),
            seeing: [false; CAMERAS_MAX],
            points: Points::new(n),
            source: Default::default(),
            scratch: Default::default(),
            inverse_depths: Vec::with_capacity(n * TRACKS),
            frame: 0,
            tracks: Tracks::default(),
            stats: Stats::default(),
            agreement: Agreement::default(),
        })
    }

    /// What happened to points since the start.
    pub fn stats(&self) -> &Stats {
        &self.stats
    }

    /// Takes the cameras to be where they are estimated, with this deviation of their rotation, rad: the next frame is
    /// followed by it.
    pub fn correct(&mut self, body_from_cam: &[Pose], sigma_rad: f64) {
        self.rig.correct(body_from_cam, RIG_SIGMAS * sigma_rad);
    }

    /// What was found of cameras that do not see what the calibration says.
    pub fn verdicts(&self) -> Verdicts {
        self.agreement.verdicts
    }

    /// Follows all points into the new images, replaces what was lost. The frame is shared until the next is tracked:
    /// until then nobody writes into it.
    pub fn track(&mut self, frames: &Arc<Frames>, prediction: &Prediction) -> &Tracks {
        std::mem::swap(&mut self.now, &mut self.before);
        self.now.frames = frames.clone();
        self.frame += 1;
        self.build_pyramids();
        let median = self.median_inverse_depth();
        let secs = (frames.t - self.before.frames.t).secs();
        self.follow(prediction, median);
        let median = self.median_inverse_depth();
        self.find_missing(0, median);
        self.drop_unseen();
        for camera in 0..self.cameras() {
            let first_new = self.points.list.len();
            if self.seeing[camera] {
                self.detect(camera);
                self.detectors[camera].elapse(secs);
            }
            self.find_missing(first_new, median);
        }
        self.compare(frames.t, median);
        self.publish(frames.t);
        // Who wrote the frame before may have it back.
        self.before.frames = frames.clone();
        &self.tracks
    }

    /// Estimates how far the view has moved by a motion since the last frame, px: focal length times the rotation and what moves
    /// the point of median distance aside.
    pub fn flow_px(&mut self, prev_from_now: &Pose) -> f64 {
        let angle = 2.0 * prev_from_now.q.xyz().length().min(1.0).asin();
        self.rig.focal_px() * (angle + self.median_inverse_depth() * prev_from_now.p.length())
    }

    /// Finds corners of camera 0 without any history, and the views of each in all cameras. What was followed before is forgotten,
    /// and the frame is not kept: its pyramids stay, for `levels`.
    pub fn detect_anew(&mut self, frames: &Arc<Frames>) -> &Tracks {
        for i in 0..self.points.list.len() {
            (0..self.cameras()).for_each(|camera| _ = self.points.lose(i, camera));
        }
        self.drop_unseen();
        self.now.frames = frames.clone();
        self.build_pyramids();
        if self.seeing[0] {
            self.detect(0);
        }
        self.find_views_anew();
        self.publish(frames.t);
        self.now.frames = self.before.frames.clone();
        &self.tracks
    }

    /// Looks for the other views of corners of camera 0 of which nothing is known: each at the distance of the corner nearest in the
    /// image that has another view, over the fine levels; where it is not there, along the epipolar curve.
    fn find_views_anew(&mut self) {
        for i in 0..self.points.list.len() {
            let (found, rest) = self.points.list.split_at(i);
            let (Some(px), patch) = (rest[0].views[0], rest[0].patches[0]) else { continue };
            let apart = |p: &Point| p.views[0].map_or(f32::MAX, |[x, y]| (x - px[0]).powi(2) + (y - px[1]).powi(2));
            let known = found.iter().filter_map(|p| Some((apart(p), p.inverse_depth?)));
            let q = known.min_by(|a, b| a.0.total_cmp(&b.0)).map_or(INVERSE_DEPTH_START, |(_, q)| q);
            self.source[..FINE_LEVELS].copy_from_slice(&self.points.patches[0][patch].last);
            for to in 1..self.cameras() {
                if !self.seeing[to] {
                    continue;
                }
                let guess = self.rig.transfer(0, to, &self.rig.between(0, to), px, q);
                let view = guess.and_then(|guess| self.match_view((0, to), px, guess, FINE_LEVELS - 1)).or_else(|| {
                    take_stack(&mut self.source, &self.now.levels(0), px, FINE_LEVELS..SEARCH_LEVEL + 1);
                    self.search_curve((0, to), px)
                });
                view.into_iter().for_each(|view| self.points.add_view(i, to, view, &self.scratch));
            }
            self.gate(i);
        }
    }

    /// The pyramid that was built last from an image of a camera.
    pub fn levels<'a>(&'a self, camera: usize, image: &'a Image) -> Levels<'a> {
        self.now.pyramids[camera].over(image)
    }

    /// Hands out the pyramid that was built last from an image of camera 0, in exchange for another one.
    pub fn exchange_pyramid(&mut self, pyramid: &mut Pyramid) {
        std::mem::swap(&mut self.now.pyramids[0], pyramid);
    }

    /// Finds in an earlier image of camera 0 what is at `px` of `image`, its newest one, at an inverse distance, 1/m, by the motion
    /// of the camera between them. Answers the pixel; `None` where nothing there looks the same.
    pub fn find_earlier(
        &mut self,
        image: &Image,
        (earlier, earlier_from_now): (&Levels, &Pose),
        px: [f32; 2],
        inverse_depth: f64,
    ) -> Option<[f32; 2]> {
        let start = self.rig.transfer(0, 0, earlier_from_now, px, inverse_depth)?;
        let from = self.now.pyramids[0].over(image);
        take_stack(&mut self.source, &from, px, 0..FINE_LEVELS);
        let search = Search { from, to: *earlier, px, start, coarsest: FINE_LEVELS - 1, limits: self.limits };
        let (found, left) = search.find(&self.source[..FINE_LEVELS])?;
        let alike = left <= UNEXPLAINED_MATCH_MAX && search.returns(&mut self.scratch, found, found.px());
        Some(found.px()).filter(|px| alike && !self.rig.is_masked(0, *px))
    }

    /// Drops the points that the estimator rejected, so that what moves by itself does not keep its places: the cells rest.
    pub fn reject(&mut self, ids: &[u64]) {
        for id in ids {
            let Ok(i) = self.points.list.binary_search_by_key(id, |p| p.id) else { continue };
            self.stats.tracks_contradicted += 1;
            for camera in 0..self.cameras() {
                if let Some(px) = self.points.list[i].views[camera] {
                    self.detectors[camera].rest(px);
                }
                self.points.lose(i, camera);
            }
        }
        self.drop_unseen();
    }

    /// Takes the images that are of their camera's size; the cameras of the others lose all their views.
    fn build_pyramids(&mut self) {
        let FramePyramids { frames, pyramids } = &mut self.now;
        self.stats.frontend_images_refused += frames.images.len().saturating_sub(pyramids.len()) as u64;
        for (camera, pyramid) in pyramids.iter_mut().enumerate() {
            let image = frames.images.get(camera).filter(|image| pyramid.fits(image));
            self.seeing[camera] = image.is_some();
            image.into_iter().for_each(|image| pyramid.build(image));
        }
        for camera in 0..self.cameras() {
            if self.seeing[camera] {
                continue;
            }
            self.stats.frontend_images_refused += 1;
            for i in 0..self.points.list.len() {
                self.stats.tracks_lost += u64::from(self.points.lose(i, camera));
            }
        }
    }

    fn cameras(&self) -> usize {
        self.detectors.len()
    }

    fn median_inverse_depth(&mut self) -> f64 {
        self.inverse_depths.clear();
        self.inverse_depths.extend(self.points.list.iter().filter_map(|p| p.inverse_depth));
        let middle = self.inverse_depths.len() / 2;
        if self.inverse_depths.is_empty() {
            return INVERSE_DEPTH_START;
        }
        *self.inverse_depths.select_nth_unstable_by(middle, f64::total_cmp).1
    }

    /// Finds every view of the last frame in this one.
    fn follow(&mut self, prediction: &Prediction, median: f64) {
        for camera in 0..self.cameras() {
            let motion = prediction.prev_from_now.map(|m| self.rig.motion(camera, &m));
            for i in 0..self.points.list.len() {
                let point = self.points.list[i];
                let Some(px) = point.views[camera] else { continue };
                let q = point.inverse_depth.unwrap_or(median);
                let start = motion.and_then(|m| self.rig.transfer(camera, camera, &m, px, q));
                let predicted = start.and_then(|s| self.follow_view(&point, camera, s, FINE_LEVELS - 1));
                // A wrong prediction must not lose what a still camera would keep.
                let view = predicted.or_else(|| {
                    let start = start.unwrap_or(Warp::upright(px));
                    self.follow_view(&point, camera, start, PYRAMID_LEVELS - 1)
                });
                match view.filter(|px| !self.rig.is_masked(camera, *px)) {
                    Some(_) => self.points.list[i].views[camera] = view,
                    None => self.stats.tracks_lost += u64::from(self.points.lose(i, camera)),
                }
            }
        }
        for i in 0..self.points.list.len() {
            self.gate(i);
        }
        self.thin();
    }

    /// Drops points that came too near to an older one, judged where the younger is seen first.
    fn thin(&mut self) {
        for i in 1..self.points.list.len() {
            let Some(first) = self.points.list[i].first() else { continue };
            let px = self.points.list[i].views[first].expect("it is seen there");
            if self.points.is_near(i, first, px, self.spacing_px) {
                for camera in 0..self.cameras() {
                    self.points.lose(i, camera);
                }
                self.stats.tracks_crowded += 1;
            }
        }
    }

    /// Finds one view of the last frame in this one, from level `coarsest` on.
    fn follow_view(&mut self, point: &Point, camera: usize, start: Warp, coarsest: usize) -> Option<[f32; 2]> {
        let px = point.views[camera]?;
        let (from, to) = (self.before.levels(camera), self.now.levels(camera));
        let search = Search { from, to, px, start, coarsest, limits: self.limits };
        let patch = &mut self.points.patches[camera][point.patches[camera]];
        let mut stack = &patch.last[..];
        if coarsest >= FINE_LEVELS {
            self.source[..FINE_LEVELS].copy_from_slice(stack);
            take_stack(&mut self.source, &search.from, px, FINE_LEVELS..coarsest + 1);
            stack = &self.source;
        }
        let (found, left) = search.find(stack).filter(|(_, left)| *left <= UNEXPLAINED_MAX)?;
        let mut referred = found;
        referred.rotate(patch.rotation[0], patch.rotation[1]);
        let reference_left = patch.reference.align(search.to[0], &mut referred, self.limits.iterations, STEP_MIN);
        let holds = reference_left.is_some_and(|l| l < REFERENCE_LEFT_MAX * left)
            && distance(referred.px(), found.px()) < REFERENCE_PULL_MAX_PX;
        let placed = if holds { referred.px() } else { found.px() };
        if !search.returns(&mut self.scratch, found, placed) {
            return None;
        }
        if holds {
            patch.last.copy_from_slice(&self.scratch[..FINE_LEVELS]);
            patch.rotation = [referred.c, referred.s];
        } else {
            patch.restart(&self.scratch);
        }
        Some(placed)
    }

    /// Drops views that disagree with the first and triangulates from those that agree.
    fn gate(&mut self, i: usize) {
        let Point { views, .. } = self.points.list[i];
        let Some(first) = self.points.list[i].first() else { return };
        let Some(f) = views[first].and_then(|px| self.rig.bearing(first, px)) else { return };
        let (mut sum, mut weights) = (0.0, 0.0);
        for camera in first + 1..self.cameras() {
            let Some(px) = views[camera] else { continue };
            let seen = self.rig.bearing(camera, px).and_then(|g| self.rig.triangulate(first, camera, f, g));
            match seen {
                Some((q, weight)) => {
                    sum += weight * q;
                    weights += weight;
                }
                None => {
                    self.points.lose(i, camera);
                    self.stats.tracks_epipolar_rejected += 1;
                }
            }
        }
        if weights > 0.0 {
            self.points.list[i].inverse_depth = Some((sum / weights).max(0.0));
        }
    }

    /// Looks for the missing views of points `first..` from a camera that has them.
    fn find_missing(&mut self, first: usize, median: f64) {
        for i in first..self.points.list.len() {
            let views = self.points.list[i].views;
            let Some(from) = self.points.list[i].first() else { continue };
            for to in 0..self.cameras() {
                if views[to].is_none() && self.seeing[to] {
                    self.find_view(i, from, to, median);
                }
            }
            self.gate(i);
        }
    }

    /// Looks for one view from another camera of the same instant.
    fn find_view(&mut self, i: usize, from: usize, to: usize, median: f64) {
        if !self.points.has_room(to) {
            self.stats.tracks_full += 1;
        } else if let Some(px) = self.search_view(i, from, to, median) {
            self.points.add_view(i, to, px, &self.scratch);
            self.stats.tracks_matched += 1;
        }
    }

    /// Where that view is; what it looks like is left in `scratch`.
    fn search_view(&mut self, i: usize, from: usize, to: usize, median: f64) -> Option<[f32; 2]> {
        let point = self.points.list[i];
        let px = point.views[from]?;
        let due = self.frame >= point.search_at[to];
        if !due && point.inverse_depth.is_none() {
            return None;
        }
        let relative = self.rig.between(from, to);
        let q = point.inverse_depth.unwrap_or(median);
        self.source[..FINE_LEVELS].copy_from_slice(&self.points.patches[from][point.patches[from]].last);
        take_stack(&mut self.source, &self.now.levels(from), px, FINE_LEVELS..PYRAMID_LEVELS);
        let guess = self.rig.transfer(from, to, &relative, px, q);
        if let Some(found) = guess.and_then(|g| self.match_view((from, to), px, g, PYRAMID_LEVELS - 1)) {
            return Some(found);
        }
        if !due {
            return None;
        }
        let wait = (2 * point.search_wait[to]).clamp(1, SEARCH_WAIT_MAX);
        (self.points.list[i].search_at[to], self.points.list[i].search_wait[to]) = (self.frame + wait, wait);
        self.search_curve((from, to), px)
    }

    /// Searches along the epipolar curve of the other camera for the source patch at `px`.
    fn search_curve(&mut self, (from, to): (usize, usize), px: [f32; 2]) -> Option<[f32; 2]> {
        let (relative, rays) = (self.rig.between(from, to), self.rig.rays(from, px)?);
        let template = &self.source[SEARCH_LEVEL];
        if !template.usable() {
            return None;
        }
        let image = self.now.levels(to)[SEARCH_LEVEL];
        let mut best = [(f32::MAX, Warp::default()); SEARCH_TRIES];
        for k in 0..SEARCH_STEPS {
            let q = SEARCH_INVERSE_DEPTH_MAX * k as f64 / (SEARCH_STEPS - 1) as f64;
            let Some(warp) = self.rig.transfer_rays(to, &relative, &rays, q) else { continue };
            let small = warp.at_level(SEARCH_LEVEL);
            let Some(left) = template.unexplained(image, &small) else { continue };
            let at = best.partition_point(|b| b.0 <= left);
            if at < SEARCH_TRIES {
                best[at..].rotate_right(1);
                best[at] = (left, warp);
            }
        }
        let tries = best.into_iter().filter(|b| b.0 < f32::MAX);
        tries.map(|b| b.1).find_map(|warp| self.match_view((from, to), px, warp, SEARCH_LEVEL))
    }

    /// Aligns the source patch of one camera in another, both ways, and accepts it only where rays meet.
    fn match_view(
        &mut self,
        (from, to): (usize, usize),
        px: [f32; 2],
        start: Warp,
        coarsest: usize,
    ) -> Option<[f32; 2]> {
        let (levels_from, levels_to) = (self.now.levels(from), self.now.levels(to));
        let search = Search { from: levels_from, to: levels_to, px, start, coarsest, limits: self.limits };
        let (warp, left) = search.find(&self.source)?;
        let (f, g) = (self.rig.bearing(from, px)?, self.rig.bearing(to, warp.px())?);
        let meets = left <= UNEXPLAINED_MATCH_MAX && self.rig.triangulate(from, to, f, g).is_some();
        (meets && search.returns(&mut self.scratch, warp, warp.px())).then_some(warp.px())
    }

    fn drop_unseen(&mut self) {
        self.points.list.retain(|p| p.first().is_some());
    }

    /// Creates points of one camera. What an earlier camera sees too it has looked for already.
    fn detect(&mut self, camera: usize) {
        let mut seen = [0; CAMERAS_MAX];
        for p in &self.points.list {
            (0..CAMERAS_MAX).for_each(|c| seen[c] += usize::from(p.views[c].is_some()));
        }
        let others = (0..camera).filter(|c| seen[*c] >= GIVES_MIN).fold(0, |bits, c| bits | 1 << c);
        let points = self.points.list.iter().filter_map(|p| p.views[camera]);
        let room = self.points.room(camera);
        let (corners, excess) = self.detectors[camera].detect(self.now.levels(camera)[0], points, others, room);
        self.stats.tracks_full += excess as u64;
        for corner in corners {
            let px = [corner.x as f32, corner.y as f32];
            take_stack(&mut self.scratch, &self.now.levels(camera), px, 0..FINE_LEVELS);
            let sharp = self.scratch[0].usable() && self.scratch[0].sigma_px < SIGMA_MAX_PX;
            let known = self.rig.bearing(camera, px).is_some();
            let near = || self.points.is_near(self.points.list.len(), camera, px, self.spacing_px);
            if !sharp || !known || near() {
                continue;
            }
            self.points.create(camera, px, &self.scratch);
            self.stats.tracks_created += 1;
        }
    }

    /// Lists what each camera sees.
    fn publish(&mut self, t: Nanos) {
        self.tracks.t = t;
        for (camera, list) in self.tracks.cameras.iter_mut().enumerate() {
            list.clear();
            for p in &self.points.list {
                if let Some(px) = p.views[camera] {
                    list.push(Track { id: p.id, px }).expect("a camera has TRACKS patches, one a view");
                }
            }
        }
    }
}

/// The grid of a camera, knowing which cells earlier cameras see at the distance guessed before any is known.
fn detector(calibration: &Calibration, rig: &RigGeometry, camera: usize, config: &FrontendConfig) -> Detector {
    let of = &calibration.cameras[camera].camera;
    let mut detector = Detector::new(of.width, of.height, config);
    let sees = |px, other| rig.transfer(camera, other, &rig.between(camera, other), px, INVERSE_DEPTH_START).is_some();
    detector.share(|px| (0..camera).filter(|other| sees(px, *other)).fold(0, |bits, other| bits | 1 << other));
    detector
}

/// The insides, for benches that time them.
#[cfg(feature = "instruments")]
#[doc(hidden)]
pub mod instruments {
    pub use super::detect::Detector;
    pub use super::patch::{align_stack, take_stack, Stack, Warp, STEP_MIN};
    pub use super::pyramid::Pyramid;
}
