//! Keyframe features: corners that camera 0 and another camera see at once, each with its depth and a binary descriptor.
//!
//! Depth: by the other cameras and by camera 0 in the keyframe before, weighted by what each is worth. A step between two
//! keyframes is several times as long as the way from camera to camera.
//!
//! Descriptor: 256 comparisons of smoothed grey levels in a patch (BRIEF, Calonder et al. 2010), so that gain and offset of
//! the image do not matter. The patch is turned so that its vertical is gravity's in the image, and covers a stated size on
//! the surface, within limits in pixels: a corner looks the same from nearer and from a rolled camera.

use crate::config::FrontendConfig;
use crate::frontend::{Frontend, Levels, Pyramid};
use crate::limits::{CAMERAS_MAX, PYRAMID_LEVELS, TRACKS};
use crate::math::wide::wide;
use crate::mem::List;
use glam::{DQuat, DVec2, DVec3, Vec2};
use std::sync::Arc;
use stipple_drivers::{Calibration, Camera, Fault, Frames, Image, Nanos, Pose};

/// Features of a keyframe at most.
pub const FEATURES: usize = TRACKS;
/// Deviation of a corner that was aligned in another image, px: what depths are worth. In simulated images two of three err by
/// less than 0.06; with 0.15 fewer places of V1_01, which is real, are recognised.
const ALIGNED_SIGMA_PX: f64 = 0.25;
/// Deviation by which a motion of odometry may spoil a depth, as its share: a depth that stereo knows less well has this one at
/// least. With a hundredth fewer places of V1_01 are recognised.
const MOVED_SIGMA: f64 = 0.03;
/// The keyframe before is left out of a depth where it moves that by more deviations of stereo, or sees the point further from
/// where that depth puts it, px.
const CONTRADICTS: f64 = 2.0;
const OFF_MAX_PX: f64 = 2.0;
/// Depths are worth nothing beyond this share of deviation.
const RELATIVE_SIGMA_MAX: f64 = 0.5;
/// Half a side of a patch: m on the surface, and its limits in pixels.
const PATCH_M: f64 = 0.2;
const PATCH_PX: [f64; 2] = [14.0, 40.0];
/// Half a side of a patch that is compared in level 1 of the pyramid, px; twice as much in level 2, and so on.
const PATCH_LEVEL_PX: f64 = 8.0;

/// Units of the numbers of a feature: pixels; inverse distances and their deviations, 1/m.
const PX_UNIT: f64 = 1.0 / 16.0;
const INVERSE_DEPTH_UNIT: f64 = 1.0 / 4096.0;
const SIGMA_UNIT: f64 = 1.0 / 65536.0;

/// 256 bits that tell how a corner looks.
pub type Descriptor = [u64; 4];

/// Bits in which two descriptors differ.
#[inline]
pub fn distance(a: &Descriptor, b: &Descriptor) -> u32 {
    (0..4).map(|k| (a[k] ^ b[k]).count_ones()).sum()
}

/// A corner of camera 0, in 40 bytes.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Feature {
    pub descriptor: Descriptor,
    px: [u16; 2],
    inverse_depth: u16,
    sigma: u16,
}

impl Feature {
    /// `None` where a number does not fit.
    pub(super) fn new(descriptor: Descriptor, px: DVec2, inverse_depth: f64, sigma: f64) -> Option<Feature> {
        let whole = |x: f64, unit: f64| {
            let n = (x / unit).round();
            (n >= 0.0 && n <= u16::MAX as f64).then_some(n as u16)
        };
        let px = [whole(px.x, PX_UNIT)?, whole(px.y, PX_UNIT)?];
        // A deviation is rounded up, and a small one is not nothing.
        let sigma = whole(sigma.min(u16::MAX as f64 * SIGMA_UNIT), SIGMA_UNIT)?.max(1);
        Some(Feature { descriptor, px, inverse_depth: whole(inverse_depth, INVERSE_DEPTH_UNIT)?, sigma })
    }

    /// Pixel in camera 0.
    pub fn px(&self) -> DVec2 {
        DVec2::new(self.px[0] as f64, self.px[1] as f64) * PX_UNIT
    }

    /// Inverse distance from camera 0, and its deviation, 1/m.
    pub fn inverse_depth(&self) -> [f64; 2] {
        [self.inverse_depth as f64 * INVERSE_DEPTH_UNIT, self.sigma as f64 * SIGMA_UNIT]
    }
}

/// A feature as its ray.
#[derive(Clone, Copy, Debug, Default)]
pub struct Ray {
    /// Unit bearing, in the level frame of the keyframe: that of the body, turned upright.
    pub bearing: DVec3,
    /// 1/m.
    pub inverse_depth: f64,
    pub sigma: f64,
}

/// What camera 0 saw in the keyframe before.
struct Before {
    /// Its stamp; `None` before the first.
    t: Option<Nanos>,
    image: Image,
    pyramid: Pyramid,
}

/// Finds the features of keyframes of one rig.
pub struct Extractor {
    frontend: Frontend,
    cameras: Vec<Camera>,
    body_from_cam: [Pose; CAMERAS_MAX],
    before: Before,
    pattern: Pattern,
}

impl Extractor {
    /// Fails where the tracker cannot take the rig.
    pub fn new(calibration: &Calibration, config: &FrontendConfig) -> Result<Extractor, Fault> {
        let cameras: Vec<Camera> = calibration.cameras.iter().map(|c| c.camera).collect();
        let cell = cameras.first().map_or(1.0, |c| ((c.width * c.height) as f64 / FEATURES as f64).sqrt().floor());
        let frontend =
            Frontend::new(calibration, &FrontendConfig { grid_px: (cell as u32).max(16), ..config.clone() })?;
        let place = |i: usize| calibration.cameras.get(i).map_or(Pose::IDENTITY, |c| c.body_from_cam);
        let (width, height) = (cameras[0].width, cameras[0].height);
        let before = Before { t: None, image: Image::new(width, height), pyramid: Pyramid::new(width, height) };
        Ok(Extractor { frontend, cameras, body_from_cam: std::array::from_fn(place), before, pattern: pattern() })
    }

    /// Finds the features of a frame. `up` is the direction against gravity in the body's frame; `body_from_cam` is where the
    /// cameras are, where that is estimated; `before_from_now` is the motion of the body since the frame of that stamp, m, and is
    /// of use where that is the frame that was given before.
    pub fn extract(
        &mut self,
        frames: &Arc<Frames>,
        up: DVec3,
        body_from_cam: Option<&[Pose; CAMERAS_MAX]>,
        before_from_now: Option<(Nanos, Pose)>,
        out: &mut List<Feature, FEATURES>,
    ) {
        out.clear();
        if let Some(places) = body_from_cam {
            self.body_from_cam = *places;
            self.frontend.correct(places, 0.0);
        }
        let Some(image) = frames.images.first() else { return };
        if !self.before.pyramid.fits(image) {
            return;
        }
        let Extractor { frontend, cameras, body_from_cam, before, pattern } = self;
        let tracks = frontend.detect_anew(frames).clone();
        let up = body_from_cam[0].q.inverse() * up;
        let earlier = before_from_now.filter(|(t, _)| before.t == Some(*t)).map(|(_, motion)| Earlier {
            levels: before.pyramid.over(&before.image),
            cam_from_now: body_from_cam[0].inverse() * motion * body_from_cam[0],
        });
        let mut from = [0; CAMERAS_MAX];
        for corner in tracks.cameras[0].iter() {
            let px = DVec2::new(corner.px[0] as f64, corner.px[1] as f64);
            let Some(bearing) = cameras[0].unproject(px) else { continue };
            // Ids ascend in every camera.
            let mut depth = Weighted::default();
            for (c, camera) in cameras.iter().enumerate().skip(1) {
                let seen = &tracks.cameras[c];
                from[c] += seen[from[c]..].iter().take_while(|t| t.id < corner.id).count();
                let Some(view) = seen.get(from[c]).filter(|t| t.id == corner.id) else { continue };
                let other = camera.unproject(DVec2::new(view.px[0] as f64, view.px[1] as f64));
                let cam_from_first = body_from_cam[c].inverse() * body_from_cam[0];
                other.into_iter().for_each(|g| depth.add(bearing, g, &cam_from_first, ALIGNED_SIGMA_PX / camera.fx));
            }
            let Some(mut known) = depth.mean() else { continue };
            if let Some(earlier) = &earlier {
                let found = frontend.find_earlier(image, (&earlier.levels, &earlier.cam_from_now), corner.px, known[0]);
                known = found.and_then(|at| earlier.improved(&depth, bearing, at, &cameras[0])).unwrap_or(known);
            }
            let [inverse_depth, sigma] = known;
            let radius = (cameras[0].fx * PATCH_M * inverse_depth).clamp(PATCH_PX[0], PATCH_PX[1]);
            let down = down_in_image(&cameras[0], bearing, up);
            let levels = frontend.levels(0, image);
            let Some(descriptor) = describe(pattern, &levels, px.as_vec2(), down, radius) else { continue };
            if let Some(feature) = Feature::new(descriptor, px, inverse_depth, sigma) {
                let _ = out.push(feature);
            }
        }
        frontend.exchange_pyramid(&mut before.pyramid);
        before.image.copy_from(image);
        before.t = Some(frames.t);
    }

    /// The rays of features in the level frame, and camera 0's place there. `level_from_body` turns the body upright.
    pub fn rays(&self, features: &[Feature], level_from_body: DQuat, out: &mut List<Ray, FEATURES>) -> DVec3 {
        out.clear();
        let Pose { q, p } = self.body_from_cam[0];
        for f in features {
            let bearing = self.cameras[0].unproject(f.px()).unwrap_or(DVec3::Z);
            let [inverse_depth, sigma] = f.inverse_depth();
            let _ = out.push(Ray { bearing: level_from_body * (q * bearing), inverse_depth, sigma });
        }
        level_from_body * p
    }

    /// Deviation of a pixel's bearing of `sigma_px`, rad.
    pub fn bearing_sigma(&self, sigma_px: f64) -> f64 {
        sigma_px / self.cameras[0].fx
    }
}

/// Camera 0 in the keyframe before: its image, and its motion since.
struct Earlier<'a> {
    levels: Levels<'a>,
    cam_from_now: Pose,
}

impl Earlier<'_> {
    /// Combines the depth of a corner by the other cameras with the pixel at which this image shows it: inverse depth and deviation,
    /// 1/m. `None` where the two contradict each other.
    fn improved(&self, depth: &Weighted, bearing: DVec3, at: [f32; 2], camera: &Camera) -> Option<[f64; 2]> {
        let [q, sigma] = depth.mean()?;
        let seen = camera.unproject(DVec2::new(at[0] as f64, at[1] as f64))?;
        let mut both = *depth;
        both.add(bearing, seen, &self.cam_from_now, ALIGNED_SIGMA_PX / camera.fx);
        let [better, alone] = both.mean()?;
        let better_sigma = alone.hypot(MOVED_SIGMA * better);
        let there = (self.cam_from_now.q * bearing + self.cam_from_now.p * better).normalize();
        let near = (seen - there).length() * camera.fx < OFF_MAX_PX;
        let same = (better - q).abs() < CONTRADICTS * sigma;
        (near && same).then_some([better, better_sigma.min(sigma)])
    }
}

/// The mean of inverse depths, weighted by what each is worth.
#[derive(Clone, Copy, Default)]
struct Weighted {
    sum: f64,
    weight: f64,
}

impl Weighted {
    /// Adds what a second ray tells: the q that best puts R f + q t on it.
    fn add(&mut self, f: DVec3, g: DVec3, to_from_first: &Pose, sigma_rad: f64) {
        let (a, b) = (g.cross(to_from_first.p), g.cross(to_from_first.q * f));
        let weight = a.length_squared() / (2.0 * sigma_rad * sigma_rad);
        if weight > 0.0 && weight.is_finite() {
            self.sum -= weight * a.dot(b) / a.length_squared();
            self.weight += weight;
        }
    }

    /// Inverse depth and deviation, 1/m. `None` where the depth is not known well enough.
    fn mean(&self) -> Option<[f64; 2]> {
        let (q, sigma) = (self.sum / self.weight, self.weight.sqrt().recip());
        (q > 0.0 && sigma < RELATIVE_SIGMA_MAX * q).then_some([q, sigma])
    }
}

/// The direction of gravity in the image at a bearing; that of the image's columns where the camera looks along gravity.
fn down_in_image(camera: &Camera, bearing: DVec3, up: DVec3) -> Vec2 {
    const STEP: f64 = 1e-3;
    let side = (up - bearing * bearing.dot(up)).normalize_or_zero();
    let ends = [-STEP, STEP].map(|s| camera.project(bearing + side * s));
    let [Some(low), Some(high)] = ends else { return Vec2::Y };
    let down = (low - high).as_vec2().normalize_or_zero();
    if down == Vec2::ZERO || side.length() * (up - bearing * bearing.dot(up)).length() < 0.05 {
        return Vec2::Y;
    }
    down
}

/// Side of the part of a level in which a patch lies, px: half a side of a patch is less than 0.71 of `PATCH_LEVEL_PX` there.
const BLOCK: usize = 16;
/// Pixels of it, and two rows so that any place that is taken modulo `BLOCK`² is read unchecked, with those beside and below.
const BLOCK_PIXELS: usize = BLOCK * (BLOCK + 2);

/// Compares the pairs of a patch. `None` where it reaches over the border of the image.
fn describe(pattern: &Pattern, levels: &Levels, px: Vec2, down: Vec2, radius: f64) -> Option<Descriptor> {
    let level = 1 + (radius / PATCH_LEVEL_PX).log2().round().clamp(0.0, (PYRAMID_LEVELS - 2) as f64) as usize;
    let (scale, r) = (1.0 / (1 << level) as f32, radius as f32);
    let image = levels[level];
    let centre = px * scale;
    let reach = r * scale + 1.0;
    let limit = Vec2::new(image.width as f32 - 1.0, image.height as f32 - 1.0);
    if centre.min_element() < reach * 0.5 || (limit - centre).min_element() < reach * 0.5 {
        return None;
    }
    let from = centre.floor() - (BLOCK / 2 - 1) as f32;
    let mut block = [0; BLOCK_PIXELS];
    for (j, row) in block.chunks_exact_mut(BLOCK).take(BLOCK).enumerate() {
        let y = (from.y as isize + j as isize).clamp(0, image.height as isize - 1) as usize;
        let line = &image.pixels[y * image.width..][..image.width];
        for (i, p) in row.iter_mut().enumerate() {
            *p = line[(from.x as isize + i as isize).clamp(0, image.width as isize - 1) as usize];
        }
    }
    Some(compare(pattern, &block, centre - from, down * r * scale))
}

wide! {
    /// Compares the pairs around a place in a block. `axis` is the patch's vertical, half a side long, px.
    fn compare<'a>(pattern: &'a Pattern, block: &'a [u8; BLOCK_PIXELS], centre: Vec2, axis: Vec2) -> Descriptor {
        let mut grey = [[0u32; 256]; 2];
        for (grey, places) in grey.iter_mut().zip(pattern) {
            let (mut at, mut u, mut v) = ([0u32; 256], [0u32; 256], [0u32; 256]);
            for k in 0..256 {
                // 1/256 of a pixel.
                let x = ((centre.x + axis.y * places[0][k] + axis.x * places[1][k]) * 256.0) as i32 as u32;
                let y = ((centre.y - axis.x * places[0][k] + axis.y * places[1][k]) * 256.0) as i32 as u32;
                (at[k], u[k], v[k]) = ((y >> 8) * BLOCK as u32 + (x >> 8), x & 255, y & 255);
            }
            let mut quad = [0u32; 256];
            for k in 0..256 {
                let q = at[k] as usize % (BLOCK * BLOCK);
                let pair = |q: usize| u16::from_le_bytes([block[q], block[q + 1]]) as u32;
                quad[k] = pair(q) | pair(q + BLOCK) << 16;
            }
            for k in 0..256 {
                let (a, b, c, d) = (quad[k] & 255, quad[k] >> 8 & 255, quad[k] >> 16 & 255, quad[k] >> 24);
                grey[k] = (256 - v[k]) * ((256 - u[k]) * a + u[k] * b) + v[k] * ((256 - u[k]) * c + u[k] * d);
            }
        }
        let mut descriptor = [0u64; 4];
        for k in 0..256 {
            descriptor[k / 64] |= u64::from(grey[0][k] < grey[1][k]) << (k % 64);
        }
        descriptor
    }
}

/// Places in a patch, from -1 to 1: x and y of the first ones of 256 pairs, and of the second ones.
type Pattern = [[[f32; 256]; 2]; 2];

/// Pairs of places, denser in the middle: sums of uniform numbers, from a fixed seed, inside the unit circle.
fn pattern() -> Pattern {
    let mut state = 0x9e37_79b9_7f4a_7c15u64;
    let mut uniform = || {
        // xorshift64*
        state ^= state >> 12;
        state ^= state << 25;
        state ^= state >> 27;
        (state.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 40) as f32 / (1u32 << 24) as f32 - 0.5
    };
    let mut place = move || loop {
        let p = Vec2::new(uniform() + uniform() + uniform(), uniform() + uniform() + uniform()) * 0.8;
        if p.length() <= 1.0 {
            return p;
        }
    };
    let mut pattern = [[[0.0; 256]; 2]; 2];
    for k in 0..256 {
        let mut pair = [place(), place()];
        while pair[0].distance(pair[1]) < 0.2 {
            pair[1] = place();
        }
        (0..2).for_each(|i| [pattern[i][0][k], pattern[i][1][k]] = pair[i].to_array());
    }
    pattern
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use stipple_drivers::{ImuCalibration, Lens, Nanos, RigCamera};

    const SIZE: usize = 480;
    const FOCAL: f64 = 400.0;
    const BASELINE: f64 = 0.1;

    fn calibration() -> Calibration {
        let lens = Lens::Radtan { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0 };
        let c = (SIZE as f64 - 1.0) / 2.0;
        let camera = Camera { width: SIZE, height: SIZE, fx: FOCAL, fy: FOCAL, cx: c, cy: c, lens };
        let right = Pose::new(DQuat::IDENTITY, DVec3::new(BASELINE, 0.0, 0.0));
        let cameras = vec![RigCamera::new(camera, Pose::IDENTITY), RigCamera::new(camera, right)];
        Calibration { cameras, imu: ImuCalibration::CONSUMER }
    }

    /// Blots of random grey on a grid, smooth between.
    fn grey(x: f64, y: f64) -> f64 {
        let node = |i: i64, j: i64| {
            let n = (i.wrapping_mul(73_856_093) ^ j.wrapping_mul(19_349_663)) as u64;
            (n.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40) as f64 / (1u64 << 24) as f64
        };
        let octave = |scale: f64| {
            let (x, y) = (x / scale + 100.0, y / scale + 100.0);
            let (i, j, u, v) = (x.floor() as i64, y.floor() as i64, x.fract(), y.fract());
            let row = |j| node(i, j) * (1.0 - u) + node(i + 1, j) * u;
            row(j) * (1.0 - v) + row(j + 1) * v
        };
        255.0 * (0.5 * octave(23.0) + 0.3 * octave(11.0) + 0.2 * octave(5.0))
    }

    /// A wall at one depth, seen by both cameras; `turn` takes a pixel to the wall's coordinates.
    fn wall(disparity: f64, gain: f64, turn: impl Fn(f64, f64) -> (f64, f64)) -> Arc<Frames> {
        let image = |shift: f64| {
            let mut image = Image::new(SIZE, SIZE);
            for (i, p) in image.pixels.iter_mut().enumerate() {
                let (x, y) = turn((i % SIZE) as f64 + shift, (i / SIZE) as f64);
                *p = (gain * grey(x, y)).round().clamp(0.0, 255.0) as u8;
            }
            image
        };
        Arc::new(Frames { t: Nanos(0), images: vec![image(0.0), image(disparity)], colours: vec![] })
    }

    fn features(frames: &Arc<Frames>, up: DVec3) -> Vec<Feature> {
        let mut extractor = Extractor::new(&calibration(), &FrontendConfig::default()).unwrap();
        let mut list = List::default();
        extractor.extract(frames, up, None, None, &mut list);
        list.to_vec()
    }

    #[test]
    fn depths_are_those_of_stereo_and_what_is_seen_again_in_other_light_looks_the_same() {
        let disparity = 16.0;
        let a = features(&wall(disparity, 1.0, |x, y| (x, y)), DVec3::NEG_Y);
        assert!(a.len() > 120, "{}", a.len());
        for f in &a {
            let px = f.px() - DVec2::splat((SIZE as f64 - 1.0) / 2.0);
            let ray = DVec3::new(px.x, px.y, FOCAL).length() / FOCAL;
            let [inverse_depth, sigma] = f.inverse_depth();
            let truth = disparity / (FOCAL * BASELINE) / ray;
            assert!(
                (inverse_depth - truth).abs() < 4.0 * sigma && sigma < 0.1 * truth,
                "{inverse_depth} {truth} {sigma}"
            );
        }
        let dark = features(&wall(disparity, 0.4, |x, y| (x, y)), DVec3::NEG_Y);
        let same = |f: &&Feature| {
            let near = dark.iter().filter(|g| (g.px() - f.px()).length() < 1.5);
            near.map(|g| distance(&g.descriptor, &f.descriptor)).min().is_some_and(|d| d < 30)
        };
        assert!(a.iter().filter(same).count() * 2 > a.len());
    }

    #[test]
    fn the_keyframe_before_makes_depths_more_exact_unless_it_contradicts_them() {
        let (disparity, step) = (4.0, 0.8);
        let noisy = |frames: Arc<Frames>, mut n: u64| {
            let mut frames = Arc::unwrap_or_clone(frames);
            for p in frames.images.iter_mut().flat_map(|i| &mut i.pixels) {
                n = n.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                *p = p.saturating_add((n >> 60) as u8);
            }
            Arc::new(frames)
        };
        let before = noisy(wall(disparity, 1.0, |x, y| (x, y)), 1);
        let now = noisy(wall(disparity, 1.0, |x, y| (x + disparity * step / BASELINE, y)), 2);
        // Cameras that are turned on the body: a step along its z.
        let on_body = Pose::new(DQuat::from_rotation_y(-std::f64::consts::FRAC_PI_2), DVec3::new(0.1, 0.2, 0.3));
        let mut rig = calibration();
        rig.cameras.iter_mut().for_each(|c| c.body_from_cam = on_body * c.body_from_cam);
        let seen = |motion: Option<(Nanos, f64)>| {
            let mut extractor = Extractor::new(&rig, &FrontendConfig::default()).unwrap();
            let mut list = List::default();
            let up = on_body.q * DVec3::NEG_Y;
            extractor.extract(&before, up, None, None, &mut list);
            let short = Image { pixels: vec![0; 9], ..Image::new(SIZE, SIZE) };
            let bad = Frames { t: Nanos(7), images: vec![short.clone(), short], colours: vec![] };
            extractor.extract(&Arc::new(bad), up, None, None, &mut list);
            assert!(list.is_empty());
            let motion = motion.map(|(t, x)| (t, Pose::new(DQuat::IDENTITY, DVec3::new(0.0, 0.0, x))));
            extractor.extract(&now, up, None, motion, &mut list);
            list.to_vec()
        };
        let alone = seen(None);
        let both = seen(Some((Nanos(0), step)));
        assert_eq!(both.len(), alone.len());
        let halved: Vec<usize> =
            (0..both.len()).filter(|i| both[*i].inverse_depth()[1] < 0.5 * alone[*i].inverse_depth()[1]).collect();
        assert!(halved.len() * 2 > both.len(), "{} of {}", halved.len(), both.len());
        let rms = |list: &[Feature]| {
            let error = |i: &usize| {
                let f = &list[*i];
                let px = f.px() - DVec2::splat((SIZE as f64 - 1.0) / 2.0);
                f.inverse_depth()[0] * BASELINE * DVec3::new(px.x, px.y, FOCAL).length() / disparity - 1.0
            };
            (halved.iter().map(|i| error(i).powi(2)).sum::<f64>() / halved.len() as f64).sqrt()
        };
        let [rms_both, rms_alone] = [&both, &alone].map(|list| rms(list));
        assert!(rms_both < 0.5 * rms_alone && rms_both < MOVED_SIGMA, "{rms_both} {rms_alone}");
        // A motion that is off by a twentieth.
        assert!(rms(&seen(Some((Nanos(0), 1.05 * step)))) < 2.0 * MOVED_SIGMA);
        for motion in [(Nanos(1), step), (Nanos(0), f64::NAN), (Nanos(0), 0.0)] {
            assert_eq!(seen(Some(motion)), alone, "{motion:?}");
        }
        // Some corners look like others that are where twice the motion would have them.
        let wrong = seen(Some((Nanos(0), 2.0 * step)));
        let changed = wrong.iter().zip(&alone).filter(|(a, b)| a != b).count();
        assert!(changed * 20 < wrong.len(), "{changed} of {}", wrong.len());
    }

    #[test]
    fn a_camera_on_its_side_sees_the_same_descriptors() {
        let upright = features(&wall(16.0, 1.0, |x, y| (x, y)), DVec3::NEG_Y);
        // The wall turned by 90 degrees in the image; gravity is with it.
        let last = SIZE as f64 - 1.0;
        let rolled = features(&wall(16.0, 1.0, |x, y| (y, last - x)), DVec3::X);
        let mut alike = 0;
        for f in &rolled {
            let px = DVec2::new(f.px().y, last - f.px().x);
            let near = upright.iter().filter(|g| (g.px() - px).length() < 1.5);
            alike += usize::from(near.map(|g| distance(&g.descriptor, &f.descriptor)).min().is_some_and(|d| d < 40));
        }
        assert!(alike * 3 > rolled.len(), "{alike} of {}", rolled.len());
    }

    #[test]
    fn images_without_corners_or_of_another_size_have_none_and_numbers_that_do_not_fit_are_refused() {
        assert!(features(&wall(16.0, 0.0, |x, y| (x, y)), DVec3::NEG_Y).is_empty());
        let small = Frames { t: Nanos(0), images: vec![Image::new(64, 64); 2], colours: vec![] };
        assert!(features(&Arc::new(small), DVec3::NEG_Y).is_empty());
        let none = Frames { t: Nanos(0), images: vec![], colours: vec![] };
        assert!(features(&Arc::new(none), DVec3::NEG_Y).is_empty());
        let of = |px: f64, inverse_depth: f64, sigma: f64| Feature::new([0; 4], DVec2::splat(px), inverse_depth, sigma);
        assert!(of(4095.9, 15.9, 0.9).is_some() && of(5000.0, 1.0, 0.1).is_none() && of(1.0, 17.0, 0.1).is_none());
        assert!(of(f64::NAN, 1.0, 0.1).is_none() && of(1.0, f64::NAN, 0.1).is_none() && of(-1.0, 1.0, 0.1).is_none());
        assert_eq!(of(1.0, 0.5, 9.0).unwrap().inverse_depth()[1], u16::MAX as f64 * SIGMA_UNIT, "as much as fits");
        assert_eq!(size_of::<Feature>(), 40);
        for up in [DVec3::Z, DVec3::NEG_Z, DVec3::ZERO, DVec3::NAN] {
            features(&wall(16.0, 1.0, |x, y| (x, y)), up);
        }
    }
}
