//! Images in, tracked points out: a stereo patch tracker.
//!
//! ```text
//! frames -> pyramids -> follow every view from the last frame (IMU-predicted start, refined
//!                       against the patch first seen, checked backwards)
//!        -> epipolar gate -> match views that are missing -> detect in free cells -> match those
//! ```
//!
//! Camera 0 finds points; the same id in another camera is the same point. Each view is followed
//! in its own camera; a point lives while any camera sees it, and what one camera lost is looked
//! for again from another in every frame. The patch of the last frame finds the point, the patch
//! first seen (the anchor) places it: without an anchor each frame adds its own rounding to the
//! drift. A prediction is refined over the fine levels alone, which is faster and slips less; where it fails
//! the whole pyramid is searched. Same frames and predictions, same bits out.

pub mod detect;
pub mod patch;
pub mod pyramid;
mod rig;

use crate::config::FrontendConfig;
use crate::limits::{CAMERAS_MAX, PYRAMID_LEVELS, TRACKS};
use crate::mem::{Footprint, List};
use detect::Detector;
use patch::{align_stack, take_stack, Stack, Template, Warp, STEP_MIN};
use pyramid::Pyramid;
use rig::Rig;
use stipple_drivers::{Calibration, Exit, Fault, Frames, Nanos, Pose};

/// A point tracked in one camera. The same `id` in two cameras is the same point in space.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Track {
    pub id: u64,
    /// Pixel in the raw (distorted) image; integer = pixel centre.
    pub px: [f32; 2],
}

/// Points seen at one instant, `cameras[camera]`, ascending id.
#[derive(Clone, Debug, Default)]
pub struct Tracks {
    pub t: Nanos,
    pub cameras: [List<Track, TRACKS>; CAMERAS_MAX],
}

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
    /// Views dropped because their ray misses that of camera 0.
    pub epipolar_rejected: u64,
    /// Points dropped because an older one is near.
    pub crowded: u64,
    /// Corners that did not fit.
    pub full: u64,
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

#[derive(Clone, Copy)]
struct Point {
    id: u64,
    slot: usize,
    /// Along the ray of camera 0; kept while no second camera sees the point.
    inverse_depth: Option<f64>,
    /// Frame of the next search along the epipolar curve, and the wait after it.
    search_at: u64,
    search_wait: u64,
    views: [Option<[f32; 2]>; CAMERAS_MAX],
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
    now: Vec<Pyramid>,
    before: Vec<Pyramid>,
    detector: Detector,
    /// Ascending id.
    points: Vec<Point>,
    /// `patches[camera][slot]`
    patches: Vec<Vec<Patch>>,
    free: Vec<usize>,
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
            return Err(Fault::new(Exit::Config, "calibration", what, "use a calibration of this rig"));
        }
        let pyramids = || calibration.cameras.iter().map(|c| Pyramid::new(c.camera.width, c.camera.height)).collect();
        let first = &calibration.cameras[0].camera;
        Ok(Frontend {
            rig: Rig::new(calibration, config.epipolar_max),
            iterations: config.iterations as usize,
            recovered_max_px: config.recovered_max_px as f32,
            spacing_px: SPACING * config.grid_px as f32,
            now: pyramids(),
            before: pyramids(),
            detector: Detector::new(first.width, first.height, config),
            points: Vec::with_capacity(TRACKS),
            patches: (0..n).map(|_| vec![Patch::default(); TRACKS]).collect(),
            free: (0..TRACKS).rev().collect(),
            source: Default::default(),
            scratch: Default::default(),
            inverse_depths: Vec::with_capacity(TRACKS),
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
        let grid = sizes.take(1).map(|(w, h)| Detector::bytes(w, h, config)).sum::<usize>();
        let points = TRACKS * (size_of::<Point>() + size_of::<usize>() + size_of::<f64>());
        f.host("frontend points", size_of::<Frontend>() + points + grid);
        f
    }

    pub fn stats(&self) -> &Stats {
        &self.stats
    }

    /// Follows all points into the new images, replaces what was lost.
    pub fn track(&mut self, frames: &Frames, prediction: &Prediction) -> &Tracks {
        std::mem::swap(&mut self.now, &mut self.before);
        for (pyramid, image) in self.now.iter_mut().zip(&frames.images) {
            pyramid.build(image);
        }
        self.stats.frames += 1;
        let median = self.median_inverse_depth();
        self.follow(prediction, median);
        let median = self.median_inverse_depth();
        self.find_missing(0, median);
        self.drop_unseen();
        let first_new = self.points.len();
        self.detect();
        self.find_missing(first_new, median);
        self.publish(frames.t);
        &self.tracks
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
        for camera in 0..self.now.len() {
            let motion = prediction.prev_from_now.map(|m| self.rig.motion(camera, &m));
            for i in 0..self.points.len() {
                let point = self.points[i];
                let Some(px) = point.views[camera] else { continue };
                let q = point.inverse_depth.unwrap_or(median);
                let start = motion.and_then(|m| self.rig.transfer(camera, camera, &m, px, q));
                let fine = FINE_LEVELS - 1;
                let predicted = start.and_then(|s| self.follow_view(camera, point.slot, px, s, fine));
                // A wrong prediction must not lose what a still camera would keep.
                let view = predicted.or_else(|| {
                    let coarse = PYRAMID_LEVELS - 1;
                    self.follow_view(camera, point.slot, px, start.unwrap_or(Warp::upright(px)), coarse)
                });
                self.points[i].views[camera] = view;
                self.stats.lost += u64::from(view.is_none());
            }
        }
        for i in 0..self.points.len() {
            self.gate(i);
        }
        self.thin();
    }

    /// Of points that came too near to each other in camera 0 the oldest stays.
    fn thin(&mut self) {
        for i in 1..self.points.len() {
            let crowded = self.points[i].views[0].is_some_and(|px| is_near(&self.points[..i], px, self.spacing_px));
            if crowded {
                self.points[i].views = [None; CAMERAS_MAX];
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
        let search = Search { from: &self.before[camera], to: &self.now[camera], px, start, coarsest };
        let patch = &mut self.patches[camera][slot];
        let mut stack = &patch.last[..];
        if coarsest >= FINE_LEVELS {
            self.source[..FINE_LEVELS].copy_from_slice(stack);
            take_stack(&mut self.source, search.from, px, FINE_LEVELS..coarsest + 1);
            stack = &self.source;
        }
        let (found, left) = align_stack(stack, search.to, start, coarsest, self.iterations, STEP_MIN)?;
        if left > UNEXPLAINED_MAX {
            return None;
        }
        let mut anchored = found;
        anchored.turn(patch.turn[0], patch.turn[1]);
        let anchor_left = patch.anchor.align(&search.to.levels[0], &mut anchored, self.iterations, STEP_MIN);
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

    /// Drops views that disagree with camera 0 and triangulates from those that agree.
    fn gate(&mut self, i: usize) {
        let point = &mut self.points[i];
        let Some(f) = point.views[0].and_then(|px| self.rig.bearing(0, px)) else { return };
        let (mut sum, mut weights) = (0.0, 0.0);
        for camera in 1..self.now.len() {
            let Some(px) = point.views[camera] else { continue };
            let seen = self.rig.bearing(camera, px).and_then(|g| self.rig.triangulate(0, camera, f, g));
            match seen {
                Some((q, weight)) => {
                    sum += weight * q;
                    weights += weight;
                }
                None => {
                    point.views[camera] = None;
                    self.stats.epipolar_rejected += 1;
                }
            }
        }
        if weights > 0.0 {
            point.inverse_depth = Some((sum / weights).max(0.0));
        }
    }

    /// Looks for the missing views of points `first..` from a camera that has them.
    fn find_missing(&mut self, first: usize, median: f64) {
        for i in first..self.points.len() {
            let views = self.points[i].views;
            let Some(from) = views.iter().position(Option::is_some) else { continue };
            for to in 0..self.now.len() {
                if views[to].is_none() {
                    let found = self.find_view(i, from, to, median);
                    self.points[i].views[to] = found;
                    self.stats.matched += u64::from(found.is_some());
                }
            }
            self.gate(i);
        }
    }

    /// One view from another camera of the same instant.
    fn find_view(&mut self, i: usize, from: usize, to: usize, median: f64) -> Option<[f32; 2]> {
        let point = self.points[i];
        let px = point.views[from]?;
        let due = self.stats.frames >= point.search_at;
        if !due && point.inverse_depth.is_none() {
            return None;
        }
        let relative = self.rig.between(from, to);
        let q = point.inverse_depth.unwrap_or(median);
        self.source[..FINE_LEVELS].copy_from_slice(&self.patches[from][point.slot].last);
        take_stack(&mut self.source, &self.now[from], px, FINE_LEVELS..PYRAMID_LEVELS);
        let guess = self.rig.transfer(from, to, &relative, px, q);
        if let Some(found) = guess.and_then(|g| self.match_view(point.slot, from, to, px, g, PYRAMID_LEVELS - 1)) {
            return Some(found);
        }
        if !due {
            return None;
        }
        let wait = (2 * point.search_wait).clamp(1, SEARCH_WAIT_MAX);
        (self.points[i].search_at, self.points[i].search_wait) = (self.stats.frames + wait, wait);
        let template = &self.source[SEARCH_LEVEL];
        if !template.usable() {
            return None;
        }
        let mut best = [(f32::MAX, Warp::default()); SEARCH_TRIES];
        for k in 0..SEARCH_STEPS {
            let q = SEARCH_INVERSE_DEPTH_MAX * k as f64 / (SEARCH_STEPS - 1) as f64;
            let Some(warp) = self.rig.transfer(from, to, &relative, px, q) else { continue };
            let small = warp.at_level(SEARCH_LEVEL);
            let Some(left) = template.unexplained(&self.now[to].levels[SEARCH_LEVEL], &small) else { continue };
            let at = best.partition_point(|b| b.0 <= left);
            if at < SEARCH_TRIES {
                best[at..].rotate_right(1);
                best[at] = (left, warp);
            }
        }
        let tries = best.into_iter().filter(|b| b.0 < f32::MAX);
        tries.map(|b| b.1).find_map(|warp| self.match_view(point.slot, from, to, px, warp, SEARCH_LEVEL))
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
        let (warp, left) = align_stack(&self.source, &self.now[to], start, coarsest, self.iterations, STEP_MIN)?;
        let (f, g) = (self.rig.bearing(from, px)?, self.rig.bearing(to, warp.px())?);
        if left > UNEXPLAINED_MATCH_MAX || self.rig.triangulate(from, to, f, g).is_none() {
            return None;
        }
        let search = Search { from: &self.now[from], to: &self.now[to], px, start, coarsest };
        if !search.returns(&mut self.scratch, warp, warp.px(), self.iterations, self.recovered_max_px) {
            return None;
        }
        self.patches[to][slot].restart(&self.scratch);
        Some(warp.px())
    }

    fn drop_unseen(&mut self) {
        let free = &mut self.free;
        self.points.retain(|p| {
            let seen = p.views.iter().any(Option::is_some);
            if !seen {
                free.push(p.slot);
            }
            seen
        });
    }

    fn detect(&mut self) {
        let seen = self.points.iter().filter_map(|p| p.views[0]);
        let (corners, excess) = self.detector.detect(&self.now[0].levels[0], seen, self.free.len());
        self.stats.full += excess as u64;
        for corner in corners {
            let px = [corner.x as f32, corner.y as f32];
            take_stack(&mut self.scratch, &self.now[0], px, 0..FINE_LEVELS);
            let sharp = self.scratch[0].usable() && self.scratch[0].sigma_px() < SIGMA_MAX_PX;
            if !sharp || self.rig.bearing(0, px).is_none() || is_near(&self.points, px, self.spacing_px) {
                continue;
            }
            let slot = self.free.pop().expect("no more corners than free slots");
            self.patches[0][slot].restart(&self.scratch);
            let mut views = [None; CAMERAS_MAX];
            views[0] = Some(px);
            self.points.push(Point {
                id: self.next_id,
                slot,
                inverse_depth: None,
                search_at: 0,
                search_wait: 0,
                views,
            });
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
                    list.push(Track { id: p.id, px }).expect("there are no more points than TRACKS");
                }
            }
        }
    }
}

/// A patch at `px` of one image looked for around `start` in another.
struct Search<'a> {
    from: &'a Pyramid,
    to: &'a Pyramid,
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
        let image = &self.to.levels[0];
        let [right, bottom] = [image.width, image.height].map(|n| (n - 1) as f32 - MARGIN_PX);
        if !(placed[0] >= MARGIN_PX && placed[1] >= MARGIN_PX && placed[0] <= right && placed[1] <= bottom) {
            return false;
        }
        take_stack(stack, self.to, placed, 0..FINE_LEVELS.max(self.coarsest + 1));
        // What the anchor moved here, it moves there.
        let (dx, dy) = (placed[0] - found.x, placed[1] - found.y);
        let origin = [self.px[0] + found.c * dx + found.s * dy, self.px[1] + found.c * dy - found.s * dx];
        let (x, y) = (found.x + origin[0] - self.start.x, found.y + origin[1] - self.start.y);
        let back = Warp { x, y, c: found.c, s: -found.s };
        align_stack(&stack[..], self.from, back, self.coarsest, iterations, STEP_MIN_CHECK)
            .is_some_and(|(recovered, _)| distance(recovered.px(), origin) <= recovered_max_px)
    }
}

fn is_near(points: &[Point], px: [f32; 2], spacing_px: f32) -> bool {
    points.iter().any(|p| p.views[0].is_some_and(|q| distance(px, q) < spacing_px))
}

fn distance(a: [f32; 2], b: [f32; 2]) -> f32 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}
