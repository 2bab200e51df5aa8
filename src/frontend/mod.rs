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
//! frame finds the point, the patch first seen (the anchor) places it: without an anchor each frame adds its
//! own rounding to the
//! drift. A prediction is refined over the fine levels alone, which is faster and slips less; where it fails
//! the whole pyramid is searched. An image that is missing or not of its camera's size is refused: that
//! camera sees nothing in this frame. Same frames and predictions, same bits out.

pub mod detect;
pub mod patch;
mod pattern;
pub mod pyramid;
mod rig;
mod tracks;

pub use tracks::{Track, Tracks};

use crate::config::FrontendConfig;
use crate::limits::{CAMERAS_MAX, PYRAMID_LEVELS, TRACKS};
use crate::mem::Footprint;
use detect::Detector;
use patch::{align_stack, take_stack, Stack, Template, Warp, STEP_MIN};
use pyramid::{Levels, Pyramid, Seen};
use rig::Rig;
use std::sync::Arc;
use stipple_drivers::{Calibration, Fault, FaultKind, Frames, Nanos, Pose};

/// What is known of the motion before the images are looked at.
#[derive(Clone, Copy, Debug, Default)]
pub struct Prediction {
    /// Motion of the body since the previous frame, from the IMU.
    pub prev_from_now: Option<Pose>,
}

/// What happened to points since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stats {
    pub frames: u64,
    pub created: u64,
    /// Views that were not found again (of a point that may live on in another camera).
    pub lost: u64,
    /// Views found from another camera.
    pub matched: u64,
    /// Views dropped because their ray misses that of the first camera that sees the point.
    pub epipolar_rejected: u64,
    /// Points dropped because an older one is near.
    pub crowded: u64,
    /// Corners and views that did not fit.
    pub full: u64,
    /// Images that were missing, not of their camera's size, or of a camera the rig has not.
    pub images_refused: u64,
}

/// Levels a prediction is refined over, the full image included; the rest are for where it fails.
const FINE_LEVELS: usize = 2;
/// The way back only has to arrive: it is refined until a step is below this, px.
const STEP_MIN_CHECK: f32 = 0.05;
/// Views end this close to the border, px.
const MARGIN_PX: f32 = 2.0;
/// Share of a patch's contrast that may stay unexplained from one frame to the next, and between
/// cameras, whose views differ more.
const UNEXPLAINED_MAX: f32 = 0.4;
const UNEXPLAINED_MATCH_MAX: f32 = 0.6;
/// The anchor places a point while it leaves at most this many times what the last frame's patch
/// leaves unexplained, and does not pull it further than this, px. (Measured: an anchor kept longer
/// trades drift for the bias of a view that has changed, an affine one adds its own noise.)
const ANCHOR_LEFT_MAX: f32 = 2.0;
const ANCHOR_PULL_MAX_PX: f32 = 1.0;
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

#[derive(Clone, Copy)]
struct Point {
    id: u64,
    /// Along the ray of the first camera that sees it; kept while no second camera does.
    inverse_depth: Option<f64>,
    /// Frame of the next search along the epipolar curve in each camera, and the wait after it.
    search_at: [u64; CAMERAS_MAX],
    search_wait: [u64; CAMERAS_MAX],
    views: [Option<[f32; 2]>; CAMERAS_MAX],
    /// Of each view, in the camera's `patches`.
    slots: [usize; CAMERAS_MAX],
}

impl Point {
    fn first(&self) -> Option<usize> {
        self.views.iter().position(Option::is_some)
    }
}

/// What a view looked like: in the last frame at the fine levels, and at its anchor. Coarse levels
/// are taken from the last frame's pyramid when they are needed.
#[derive(Clone, Default)]
struct Patch {
    last: [Template; FINE_LEVELS],
    anchor: Template,
    /// Direction of the turn since the anchor.
    turn: [f32; 2],
}

impl Patch {
    fn restart(&mut self, stack: &Stack) {
        self.last.copy_from_slice(&stack[..FINE_LEVELS]);
        self.anchor = stack[0];
        self.turn = [1.0, 0.0];
    }
}

pub struct Frontend {
    rig: Rig,
    iterations: usize,
    recovered_max_px: f32,
    spacing_px: f32,
    now: Seen,
    before: Seen,
    /// Cameras whose image was taken; the pyramids of the others are of an old one and are not looked at.
    seeing: [bool; CAMERAS_MAX],
    detectors: Vec<Detector>,
    /// Ascending id.
    points: Vec<Point>,
    /// `patches[camera][slot]`
    patches: Vec<Vec<Patch>>,
    /// Free slots of each camera.
    free: Vec<Vec<usize>>,
    /// Patch that is looked for, and where it was found.
    source: Stack,
    scratch: Stack,
    inverse_depths: Vec<f64>,
    next_id: u64,
    tracks: Tracks,
    stats: Stats,
}

impl Frontend {
    pub fn new(calibration: &Calibration, config: &FrontendConfig) -> Result<Frontend, Fault> {
        let n = calibration.cameras.len();
        let least = 4 * detect::BORDER;
        let small = calibration.cameras.iter().any(|c| c.camera.width < least || c.camera.height < least);
        if n == 0 || n > CAMERAS_MAX || small {
            let what = format!("the tracker takes 1 to {CAMERAS_MAX} cameras of at least {least} px a side");
            return Err(Fault::new(FaultKind::Config, "calibration", what, "use a calibration of this rig"));
        }
        let rig = Rig::new(calibration, config.epipolar_max);
        Ok(Frontend {
            detectors: (0..n).map(|camera| detector(calibration, &rig, camera, config)).collect(),
            rig,
            iterations: config.iterations as usize,
            recovered_max_px: config.forward_backward_max_px as f32,
            spacing_px: SPACING * config.grid_px as f32,
            now: Seen::nothing_yet(calibration),
            before: Seen::nothing_yet(calibration),
            seeing: [false; CAMERAS_MAX],
            points: Vec::with_capacity(n * TRACKS),
            patches: (0..n).map(|_| vec![Patch::default(); TRACKS]).collect(),
            free: (0..n).map(|_| (0..TRACKS).rev().collect()).collect(),
            source: Default::default(),
            scratch: Default::default(),
            inverse_depths: Vec::with_capacity(n * TRACKS),
            next_id: 0,
            tracks: Tracks::default(),
            stats: Stats::default(),
        })
    }

    pub fn footprint(calibration: &Calibration, config: &FrontendConfig) -> Footprint {
        let mut f = Footprint::default();
        let sizes = calibration.cameras.iter().map(|c| (c.camera.width, c.camera.height));
        f.host("frontend pyramids", 2 * sizes.clone().map(|(w, h)| Pyramid::bytes(w, h)).sum::<usize>());
        f.host("frontend patches", calibration.cameras.len() * TRACKS * size_of::<Patch>());
        let grid = sizes.map(|(w, h)| Detector::bytes(w, h, config)).sum::<usize>();
        let each = size_of::<Point>() + size_of::<usize>() + size_of::<f64>();
        let points = calibration.cameras.len() * TRACKS * each;
        f.host("frontend points", size_of::<Frontend>() + points + grid);
        f
    }

    pub fn stats(&self) -> &Stats {
        &self.stats
    }

    /// Follows all points into the new images, replaces what was lost. The frame is shared until the next is tracked:
    /// until then nobody writes into it.
    pub fn track(&mut self, frames: &Arc<Frames>, prediction: &Prediction) -> &Tracks {
        std::mem::swap(&mut self.now, &mut self.before);
        self.now.frames = frames.clone();
        self.stats.frames += 1;
        self.look();
        let median = self.median_inverse_depth();
        self.follow(prediction, median);
        let median = self.median_inverse_depth();
        self.find_missing(0, median);
        self.drop_unseen();
        for camera in 0..self.cameras() {
            let first_new = self.points.len();
            if self.seeing[camera] {
                self.detect(camera);
            }
            self.find_missing(first_new, median);
        }
        self.publish(frames.t);
        // Who wrote the frame before may have it back.
        self.before.frames = frames.clone();
        &self.tracks
    }

    /// Takes the images that are of their camera's size; the cameras of the others lose all their views.
    fn look(&mut self) {
        let Seen { frames, pyramids } = &mut self.now;
        self.stats.images_refused += frames.images.len().saturating_sub(pyramids.len()) as u64;
        for (camera, pyramid) in pyramids.iter_mut().enumerate() {
            let image = frames.images.get(camera).filter(|image| pyramid.fits(image));
            self.seeing[camera] = image.is_some();
            image.into_iter().for_each(|image| pyramid.build(image));
        }
        for camera in 0..self.cameras() {
            if self.seeing[camera] {
                continue;
            }
            self.stats.images_refused += 1;
            for i in 0..self.points.len() {
                self.stats.lost += u64::from(self.points[i].views[camera].is_some());
                self.lose(i, camera);
            }
        }
    }

    fn cameras(&self) -> usize {
        self.patches.len()
    }

    fn median_inverse_depth(&mut self) -> f64 {
        self.inverse_depths.clear();
        self.inverse_depths.extend(self.points.iter().filter_map(|p| p.inverse_depth));
        let middle = self.inverse_depths.len() / 2;
        if self.inverse_depths.is_empty() {
            return INVERSE_DEPTH_START;
        }
        *self.inverse_depths.select_nth_unstable_by(middle, f64::total_cmp).1
    }

    fn follow(&mut self, prediction: &Prediction, median: f64) {
        for camera in 0..self.cameras() {
            let motion = prediction.prev_from_now.map(|m| self.rig.motion(camera, &m));
            for i in 0..self.points.len() {
                let point = self.points[i];
                let Some(px) = point.views[camera] else { continue };
                let q = point.inverse_depth.unwrap_or(median);
                let start = motion.and_then(|m| self.rig.transfer(camera, camera, &m, px, q));
                let fine = FINE_LEVELS - 1;
                let predicted = start.and_then(|s| self.follow_view(camera, point.slots[camera], px, s, fine));
                // A wrong prediction must not lose what a still camera would keep.
                let view = predicted.or_else(|| {
                    let coarse = PYRAMID_LEVELS - 1;
                    self.follow_view(camera, point.slots[camera], px, start.unwrap_or(Warp::upright(px)), coarse)
                });
                match view {
                    Some(_) => self.points[i].views[camera] = view,
                    None => {
                        self.lose(i, camera);
                        self.stats.lost += 1;
                    }
                }
            }
        }
        for i in 0..self.points.len() {
            self.gate(i);
        }
        self.thin();
    }

    /// Ends a view and frees its patch.
    fn lose(&mut self, i: usize, camera: usize) {
        if self.points[i].views[camera].take().is_some() {
            self.free[camera].push(self.points[i].slots[camera]);
        }
    }

    /// Of points that came too near to each other the oldest stays: judged where the younger is seen first.
    fn thin(&mut self) {
        for i in 1..self.points.len() {
            let Some(first) = self.points[i].first() else { continue };
            let px = self.points[i].views[first].expect("it is seen there");
            if is_near(&self.points[..i], first, px, self.spacing_px) {
                (0..self.cameras()).for_each(|camera| self.lose(i, camera));
                self.stats.crowded += 1;
            }
        }
    }

    /// One view from the last frame to this one, from level `coarsest` on.
    fn follow_view(
        &mut self,
        camera: usize,
        slot: usize,
        px: [f32; 2],
        start: Warp,
        coarsest: usize,
    ) -> Option<[f32; 2]> {
        let search = Search { from: self.before.levels(camera), to: self.now.levels(camera), px, start, coarsest };
        let patch = &mut self.patches[camera][slot];
        let mut stack = &patch.last[..];
        if coarsest >= FINE_LEVELS {
            self.source[..FINE_LEVELS].copy_from_slice(stack);
            take_stack(&mut self.source, &search.from, px, FINE_LEVELS..coarsest + 1);
            stack = &self.source;
        }
        let (found, left) = align_stack(stack, &search.to, start, coarsest, self.iterations, STEP_MIN)?;
        if left > UNEXPLAINED_MAX {
            return None;
        }
        let mut anchored = found;
        anchored.turn(patch.turn[0], patch.turn[1]);
        let anchor_left = patch.anchor.align(search.to[0], &mut anchored, self.iterations, STEP_MIN);
        let held = anchor_left.is_some_and(|l| l < ANCHOR_LEFT_MAX * left)
            && distance(anchored.px(), found.px()) < ANCHOR_PULL_MAX_PX;
        let placed = if held { anchored.px() } else { found.px() };
        if !search.returns(&mut self.scratch, found, placed, self.iterations, self.recovered_max_px) {
            return None;
        }
        if held {
            patch.last.copy_from_slice(&self.scratch[..FINE_LEVELS]);
            patch.turn = [anchored.c, anchored.s];
        } else {
            patch.restart(&self.scratch);
        }
        Some(placed)
    }

    /// Drops views that disagree with the first and triangulates from those that agree.
    fn gate(&mut self, i: usize) {
        let Point { views, .. } = self.points[i];
        let Some(first) = self.points[i].first() else { return };
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
                    self.lose(i, camera);
                    self.stats.epipolar_rejected += 1;
                }
            }
        }
        if weights > 0.0 {
            self.points[i].inverse_depth = Some((sum / weights).max(0.0));
        }
    }

    /// Looks for the missing views of points `first..` from a camera that has them.
    fn find_missing(&mut self, first: usize, median: f64) {
        for i in first..self.points.len() {
            let views = self.points[i].views;
            let Some(from) = self.points[i].first() else { continue };
            for to in 0..self.cameras() {
                if views[to].is_none() && self.seeing[to] {
                    self.find_view(i, from, to, median);
                }
            }
            self.gate(i);
        }
    }

    /// One view from another camera of the same instant.
    fn find_view(&mut self, i: usize, from: usize, to: usize, median: f64) {
        let Some(&slot) = self.free[to].last() else {
            self.stats.full += 1;
            return;
        };
        if let Some(px) = self.search_view(i, from, to, slot, median) {
            self.free[to].pop();
            (self.points[i].views[to], self.points[i].slots[to]) = (Some(px), slot);
            self.stats.matched += 1;
        }
    }

    /// Where it is; its patch goes to `slot`.
    fn search_view(&mut self, i: usize, from: usize, to: usize, slot: usize, median: f64) -> Option<[f32; 2]> {
        let point = self.points[i];
        let px = point.views[from]?;
        let due = self.stats.frames >= point.search_at[to];
        if !due && point.inverse_depth.is_none() {
            return None;
        }
        let relative = self.rig.between(from, to);
        let q = point.inverse_depth.unwrap_or(median);
        self.source[..FINE_LEVELS].copy_from_slice(&self.patches[from][point.slots[from]].last);
        take_stack(&mut self.source, &self.now.levels(from), px, FINE_LEVELS..PYRAMID_LEVELS);
        let guess = self.rig.transfer(from, to, &relative, px, q);
        if let Some(found) = guess.and_then(|g| self.match_view(slot, from, to, px, g, PYRAMID_LEVELS - 1)) {
            return Some(found);
        }
        if !due {
            return None;
        }
        let wait = (2 * point.search_wait[to]).clamp(1, SEARCH_WAIT_MAX);
        (self.points[i].search_at[to], self.points[i].search_wait[to]) = (self.stats.frames + wait, wait);
        let template = &self.source[SEARCH_LEVEL];
        if !template.usable() {
            return None;
        }
        let image = self.now.levels(to)[SEARCH_LEVEL];
        let mut best = [(f32::MAX, Warp::default()); SEARCH_TRIES];
        for k in 0..SEARCH_STEPS {
            let q = SEARCH_INVERSE_DEPTH_MAX * k as f64 / (SEARCH_STEPS - 1) as f64;
            let Some(warp) = self.rig.transfer(from, to, &relative, px, q) else { continue };
            let small = warp.at_level(SEARCH_LEVEL);
            let Some(left) = template.unexplained(image, &small) else { continue };
            let at = best.partition_point(|b| b.0 <= left);
            if at < SEARCH_TRIES {
                best[at..].rotate_right(1);
                best[at] = (left, warp);
            }
        }
        let tries = best.into_iter().filter(|b| b.0 < f32::MAX);
        tries.map(|b| b.1).find_map(|warp| self.match_view(slot, from, to, px, warp, SEARCH_LEVEL))
    }

    /// Aligns the source patch of one camera in another, both ways, and accepts it only where rays meet.
    fn match_view(
        &mut self,
        slot: usize,
        from: usize,
        to: usize,
        px: [f32; 2],
        start: Warp,
        coarsest: usize,
    ) -> Option<[f32; 2]> {
        let (warp, left) = align_stack(&self.source, &self.now.levels(to), start, coarsest, self.iterations, STEP_MIN)?;
        let (f, g) = (self.rig.bearing(from, px)?, self.rig.bearing(to, warp.px())?);
        if left > UNEXPLAINED_MATCH_MAX || self.rig.triangulate(from, to, f, g).is_none() {
            return None;
        }
        let search = Search { from: self.now.levels(from), to: self.now.levels(to), px, start, coarsest };
        if !search.returns(&mut self.scratch, warp, warp.px(), self.iterations, self.recovered_max_px) {
            return None;
        }
        self.patches[to][slot].restart(&self.scratch);
        Some(warp.px())
    }

    fn drop_unseen(&mut self) {
        self.points.retain(|p| p.first().is_some());
    }

    /// New points of one camera. What an earlier camera sees too it has looked for already.
    fn detect(&mut self, camera: usize) {
        let mut seen = [0; CAMERAS_MAX];
        for p in &self.points {
            (0..CAMERAS_MAX).for_each(|c| seen[c] += usize::from(p.views[c].is_some()));
        }
        let others = (0..camera).filter(|c| seen[*c] >= GIVES_MIN).fold(0, |bits, c| bits | 1 << c);
        let points = self.points.iter().filter_map(|p| p.views[camera]);
        let room = self.free[camera].len().min(self.points.capacity() - self.points.len());
        let (corners, excess) = self.detectors[camera].detect(self.now.levels(camera)[0], points, others, room);
        self.stats.full += excess as u64;
        for corner in corners {
            let px = [corner.x as f32, corner.y as f32];
            take_stack(&mut self.scratch, &self.now.levels(camera), px, 0..FINE_LEVELS);
            let sharp = self.scratch[0].usable() && self.scratch[0].sigma_px() < SIGMA_MAX_PX;
            let known = self.rig.bearing(camera, px).is_some();
            if !sharp || !known || is_near(&self.points, camera, px, self.spacing_px) {
                continue;
            }
            let slot = self.free[camera].pop().expect("no more corners than free slots");
            self.patches[camera][slot].restart(&self.scratch);
            let mut point = Point {
                id: self.next_id,
                inverse_depth: None,
                search_at: [0; CAMERAS_MAX],
                search_wait: [0; CAMERAS_MAX],
                views: [None; CAMERAS_MAX],
                slots: [0; CAMERAS_MAX],
            };
            (point.views[camera], point.slots[camera]) = (Some(px), slot);
            self.points.push(point);
            self.next_id += 1;
            self.stats.created += 1;
        }
    }

    fn publish(&mut self, t: Nanos) {
        self.tracks.t = t;
        for (camera, list) in self.tracks.cameras.iter_mut().enumerate() {
            list.clear();
            for p in &self.points {
                if let Some(px) = p.views[camera] {
                    list.push(Track { id: p.id, px }).expect("a camera has TRACKS patches, one a view");
                }
            }
        }
    }
}

/// A patch at `px` of one image looked for around `start` in another.
struct Search<'a> {
    from: Levels<'a>,
    to: Levels<'a>,
    px: [f32; 2],
    start: Warp,
    coarsest: usize,
}

impl Search<'_> {
    /// Takes the patch where it was placed and aligns it back: it must arrive where it came from.
    /// The way back starts as far off as the way there did, and at the coarsest level too.
    fn returns(
        &self,
        stack: &mut Stack,
        found: Warp,
        placed: [f32; 2],
        iterations: usize,
        recovered_max_px: f32,
    ) -> bool {
        let image = self.to[0];
        let [right, bottom] = [image.width, image.height].map(|n| (n - 1) as f32 - MARGIN_PX);
        if !(placed[0] >= MARGIN_PX && placed[1] >= MARGIN_PX && placed[0] <= right && placed[1] <= bottom) {
            return false;
        }
        take_stack(stack, &self.to, placed, 0..FINE_LEVELS.max(self.coarsest + 1));
        // What the anchor moved here, it moves there.
        let (dx, dy) = (placed[0] - found.x, placed[1] - found.y);
        let origin = [self.px[0] + found.c * dx + found.s * dy, self.px[1] + found.c * dy - found.s * dx];
        let (x, y) = (found.x + origin[0] - self.start.x, found.y + origin[1] - self.start.y);
        let back = Warp { x, y, c: found.c, s: -found.s };
        align_stack(&stack[..], &self.from, back, self.coarsest, iterations, STEP_MIN_CHECK)
            .is_some_and(|(recovered, _)| distance(recovered.px(), origin) <= recovered_max_px)
    }
}

/// The grid of a camera, knowing which cells earlier cameras see at the distance guessed before any is known.
fn detector(calibration: &Calibration, rig: &Rig, camera: usize, config: &FrontendConfig) -> Detector {
    let of = &calibration.cameras[camera].camera;
    let mut detector = Detector::new(of.width, of.height, config);
    let sees = |px, other| rig.transfer(camera, other, &rig.between(camera, other), px, INVERSE_DEPTH_START).is_some();
    detector.share(|px| (0..camera).filter(|other| sees(px, *other)).fold(0, |bits, other| bits | 1 << other));
    detector
}

fn is_near(points: &[Point], camera: usize, px: [f32; 2], spacing_px: f32) -> bool {
    points.iter().any(|p| p.views[camera].is_some_and(|q| distance(px, q) < spacing_px))
}

fn distance(a: [f32; 2], b: [f32; 2]) -> f32 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}
