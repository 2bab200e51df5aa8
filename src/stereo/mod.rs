//! Stereo: a raw pair in, a rectified left image and a depth map at mapping resolution out, by the
//! method that the board file names (`matcher`).
//!
//! `RectifiedViews` owns the maps, `Stereo` every buffer it matches in. Rectification runs at full
//! resolution (matching needs it) and the mapping resolution is a box average of it, so that a
//! mapping pixel is the mean of the light that fell on it. Depth is asked for anchors only.

pub mod alignment;
pub mod confidence;
pub mod matcher;
pub mod onnx;
pub mod opencv;
pub mod rectify;
pub mod rectify_gpu;
pub mod sgm;

use crate::config::{StereoConfig, StereoMethod};
use crate::gpu::{Arena, Gpu, GpuError};
use crate::mem::Footprint;
pub use matcher::Matcher;
use rectify::{box_average, Rectification, Remap, Turned};
use rectify_gpu::Rectifier;
use stipple_drivers::{Calibration, Camera, Fault, Image, Pose, RigCamera};

/// An undistorted camera: px = (fx x/z + cx, fy y/z + cy), integer = pixel centre.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pinhole {
    pub width: usize,
    pub height: usize,
    pub fx: f64,
    pub fy: f64,
    pub cx: f64,
    pub cy: f64,
}

impl Pinhole {
    /// The same view with `divisor` x `divisor` pixels averaged into one.
    pub fn divided(&self, divisor: usize) -> Pinhole {
        let s = divisor as f64;
        Pinhole {
            width: self.width / divisor,
            height: self.height / divisor,
            fx: self.fx / s,
            fy: self.fy / s,
            cx: (self.cx + 0.5) / s - 0.5,
            cy: (self.cy + 0.5) / s - 0.5,
        }
    }
}

/// Where the rectified left camera sits on the rig.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RectifiedCamera {
    pub pinhole: Pinhole,
    pub body_from_rect: Pose,
    pub baseline_m: f64,
}

/// Disparity x_left - x_right of each pixel of the rectified left image, px, negative where unknown, and its standard
/// deviation.
#[derive(Clone, Debug, PartialEq)]
pub struct Disparity {
    pub width: usize,
    pub height: usize,
    pub px: Vec<f32>,
    /// Without meaning where the disparity is unknown.
    pub sigma_px: Vec<f32>,
}

impl Disparity {
    pub fn new(width: usize, height: usize) -> Disparity {
        Disparity { width, height, px: vec![-1.0; width * height], sigma_px: vec![0.0; width * height] }
    }

    fn forget(&mut self) {
        self.px.fill(-1.0);
    }
}

/// Depth along the optical axis, m; 0 where unknown.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthMap {
    pub width: usize,
    pub height: usize,
    pub metres: Vec<f32>,
    /// Standard deviation; of no meaning where the depth is unknown.
    pub sigma_m: Vec<f32>,
}

impl DepthMap {
    pub fn new(width: usize, height: usize) -> DepthMap {
        DepthMap::of(width, height, vec![0.0; width * height])
    }

    /// A map of depths without error.
    pub fn of(width: usize, height: usize, metres: Vec<f32>) -> DepthMap {
        DepthMap { width, height, sigma_m: vec![0.0; metres.len()], metres }
    }
}

/// The rig without distortion: both views at full resolution, and the left one at mapping resolution.
pub struct RectifiedViews {
    rectification: Rectification,
    /// The rig that the maps were made for.
    mapped: Vec<RigCamera>,
    /// The right camera in the left one, as calibrated.
    calibrated: Pose,
    mapping: RectifiedCamera,
    divisor: usize,
    maps: [Remap; 2],
    rectified: [Image; 2],
    valid: Vec<u8>,
    rig: Vec<RigCamera>,
}

impl RectifiedViews {
    pub fn new(calibration: &Calibration, divisor: u32) -> Result<RectifiedViews, Fault> {
        let r = Rectification::new(calibration)?;
        let (full, divisor) = (r.camera.pinhole, divisor as usize);
        let maps = [r.map(&calibration.cameras[0]), r.map(&calibration.cameras[1])];
        let image = || Image::new(full.width, full.height);
        Ok(RectifiedViews {
            mapping: RectifiedCamera { pinhole: full.divided(divisor), ..r.camera },
            rectification: r,
            mapped: calibration.cameras.clone(),
            calibrated: left_from_right(&calibration.cameras),
            divisor,
            valid: maps[0].valid_blocks(divisor),
            maps,
            rectified: [image(), image()],
            rig: calibration.cameras.clone(),
        })
    }

    /// The rectified left camera at mapping resolution.
    pub fn camera(&self) -> RectifiedCamera {
        self.mapping
    }

    /// 1 where a mapping pixel is wholly covered by the raw left image, by each rectification so far, else 0.
    pub fn valid_mask(&self) -> &[u8] {
        &self.valid
    }

    /// The same of either side: 0 left, 1 right.
    pub fn valid_of(&self, side: usize) -> Vec<u8> {
        self.maps[side].valid_blocks(self.divisor)
    }

    /// Sets the pixels of a mask of one side to 0 that are not wholly covered.
    pub fn mask(&self, side: usize, valid: &mut [u8]) {
        self.maps[side].mask_blocks(self.divisor, valid);
    }

    /// Takes over where the cameras sit on the body by now. Answers whether the maps were made anew, since rows were off one
    /// another: not where the cameras are no pair any more, or one that no knock makes of the calibrated. Allocates nothing.
    pub fn adjust(&mut self, body_from_cam: &[Pose]) -> bool {
        let places = || self.rig.iter().zip(body_from_cam);
        if places().all(|(c, at)| c.body_from_cam == *at) || !places().all(|(_, at)| at.is_finite()) {
            return false;
        }
        self.rig.iter_mut().zip(body_from_cam).for_each(|(c, at)| c.body_from_cam = *at);
        let now = left_from_right(&self.rig);
        let moved = self.rectification.moved(&self.rig).filter(|_| Turned::new(&self.calibrated, &now).is_possible());
        let moved = moved.filter(|_| self.rectification.rows_are_off(&left_from_right(&self.mapped), &now));
        let anew = moved.is_some();
        if let Some(moved) = moved {
            self.rectification = moved;
            self.mapped.clone_from(&self.rig);
            self.maps.iter_mut().zip(&self.rig).for_each(|(map, camera)| self.rectification.fill(camera, map));
            self.maps[0].mask_blocks(self.divisor, &mut self.valid);
        }
        let (body_from_rect, baseline_m) = (self.body_from_rect(0), now.p.length());
        self.mapping = RectifiedCamera { body_from_rect, baseline_m, ..self.mapping };
        anew
    }

    /// Where a rectified camera sits on the body: 0 left, 1 right.
    pub fn body_from_rect(&self, side: usize) -> Pose {
        let raw = &self.rig[side].body_from_cam;
        Pose::new(raw.q * self.rectification.cam_from_rect(&self.mapped[side]), raw.p)
    }

    /// Every camera of the rig, where it sits by now.
    pub fn rig(&self) -> &[RigCamera] {
        &self.rig
    }

    /// Raw pixels across one at mapping resolution.
    pub fn divisor(&self) -> usize {
        self.divisor
    }

    /// One side's image (0 left, 1 right) without distortion, at mapping resolution. `out` is pre-shaped.
    pub fn rectify(&mut self, side: usize, raw: &Image, out: &mut Image) {
        self.maps[side].apply(raw, &mut self.rectified[side]);
        box_average(&self.rectified[side], self.divisor, out);
    }
}

/// What matching keeps on the GPU, if it runs there.
#[derive(Clone, Copy, Default)]
pub struct Buffers {
    rectifier: Option<rectify_gpu::Buffers>,
    sgm: Option<sgm::Buffers>,
}

impl Buffers {
    pub fn new(arena: &mut Arena, calibration: &Calibration, config: &StereoConfig) -> Result<Buffers, Fault> {
        let Camera { width, height, .. } = calibration.cameras[0].camera;
        if config.method != StereoMethod::Sgm {
            return Ok(Buffers::default());
        }
        let one_size = images_of_one_size(calibration);
        Ok(Buffers {
            rectifier: one_size.then(|| rectify_gpu::Buffers::new(arena, width, height)).transpose()?,
            sgm: Some(sgm::Buffers::new(arena, &sgm::Shape::of(width, height, config))?),
        })
    }
}

pub struct Stereo {
    pub views: RectifiedViews,
    /// The matcher's on the GPU, where the raw images have the rectified ones' size.
    rectifier: Option<Rectifier>,
    matcher: Matcher,
    disparity: Disparity,
    depth_range_m: [f64; 2],
}

impl Stereo {
    /// Host rows of what `new` takes; the GPU's are `Buffers`. Answers the views, for what is built on them.
    pub fn footprint(
        calibration: &Calibration,
        config: &StereoConfig,
        divisor: u32,
        f: &mut Footprint,
    ) -> Result<RectifiedViews, Fault> {
        let views = f.build("stereo: rectification", || RectifiedViews::new(calibration, divisor))?;
        let Pinhole { width, height, .. } = views.rectification.camera.pinhole;
        f.build("stereo: disparity and its deviation", || Disparity::new(width, height));
        Matcher::footprint(width, height, config, f)?;
        Ok(views)
    }

    /// `gpu` is for the matcher that runs there; its arena must hold `Buffers`.
    pub fn new(
        calibration: &Calibration,
        config: &StereoConfig,
        divisor: u32,
        mut gpu: Option<&mut Gpu>,
    ) -> Result<Stereo, Fault> {
        let views = RectifiedViews::new(calibration, divisor)?;
        let Pinhole { width, height, .. } = views.rectification.camera.pinhole;
        let mut rectifier = None;
        let mut buffers = Buffers::default();
        if let Some(gpu) = &mut gpu {
            buffers = Buffers::new(gpu.arena(), calibration, config)?;
            rectifier = buffers.rectifier.map(|b| Rectifier::new(gpu, b, width, height, &views.maps)).transpose()?;
        }
        Ok(Stereo {
            views,
            rectifier,
            matcher: Matcher::new(width, height, config, gpu.zip(buffers.sgm))?,
            disparity: Disparity::new(width, height),
            depth_range_m: [config.depth_min_m, config.depth_max_m],
        })
    }

    /// Takes over where the cameras sit on the body by now; answers whether rectification was made anew.
    pub fn adjust(&mut self, gpu: &mut Gpu, body_from_cam: &[Pose]) -> Result<bool, GpuError> {
        let anew = self.views.adjust(body_from_cam);
        if let (true, Some(rectifier)) = (anew, &mut self.rectifier) {
            rectifier.upload(gpu, &self.views.maps)?;
        }
        Ok(anew)
    }

    /// Depth at mapping resolution. `out` is pre-shaped, `gpu` the one given to `new`. Answers how many pixels have
    /// depth; none when an eye sees nothing.
    pub fn depth(
        &mut self,
        gpu: Option<&mut Gpu>,
        raw_left: &Image,
        raw_right: &Image,
        out: &mut DepthMap,
    ) -> Result<usize, Fault> {
        match (&mut self.matcher, &mut self.rectifier, gpu) {
            (Matcher::Sgm(sgm), Some(rectifier), Some(gpu)) => {
                matcher::compute_raw(sgm, rectifier, gpu, [raw_left, raw_right], &mut self.disparity)?;
            }
            (matcher, _, gpu) => {
                let RectifiedViews { maps, rectified, .. } = &mut self.views;
                maps[0].apply(raw_left, &mut rectified[0]);
                maps[1].apply(raw_right, &mut rectified[1]);
                let [left, right] = rectified;
                matcher.compute(gpu, left, right, &mut self.disparity)?;
            }
        }
        Ok(self.disparity_to_depth(out))
    }

    /// A mapping pixel takes the median of its block's disparities, and none when less than half
    /// of the block has one: the mean would invent surfaces between foreground and background.
    fn disparity_to_depth(&self, out: &mut DepthMap) -> usize {
        const BLOCK_MAX: usize = 16; // divisor 4
        let RectifiedViews { rectification, mapping, divisor: s, valid, .. } = &self.views;
        let full = rectification.camera.pinhole;
        let (w, s, fb) = (full.width, *s, full.fx * mapping.baseline_m);
        let sigma_max = self.matcher.sigma_max_px();
        let mut found = 0;
        for y in 0..out.height {
            for x in 0..out.width {
                let mut block = [(0.0f32, 0.0f32); BLOCK_MAX];
                let mut n = 0;
                for row in 0..s {
                    let at = (y * s + row) * w + x * s;
                    for (&d, &sigma) in self.disparity.px[at..][..s].iter().zip(&self.disparity.sigma_px[at..][..s]) {
                        if d > 0.0 && sigma <= sigma_max {
                            block[n] = (d, sigma);
                            n += 1;
                        }
                    }
                }
                let (mut depth, mut deviation) = (0.0, 0.0);
                if 2 * n >= s * s && n > 0 && valid[y * out.width + x] != 0 {
                    block[..n].sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
                    let (d, sigma) = (f64::from(block[n / 2].0), f64::from(block[n / 2].1));
                    let z = fb / d;
                    if (self.depth_range_m[0]..=self.depth_range_m[1]).contains(&z) {
                        // Neighbours err alike: the median of a block is no better than one of them.
                        (depth, deviation) = (z as f32, (z * sigma / d) as f32);
                        found += 1;
                    }
                }
                out.metres[y * out.width + x] = depth;
                out.sigma_m[y * out.width + x] = deviation;
            }
        }
        found
    }
}

fn left_from_right(cameras: &[RigCamera]) -> Pose {
    cameras[0].body_from_cam.inverse() * cameras[1].body_from_cam
}

fn images_of_one_size(calibration: &Calibration) -> bool {
    let size = |c: &RigCamera| (c.camera.width, c.camera.height);
    matches!(&calibration.cameras[..], [left, right, ..] if size(left) == size(right))
}

#[cfg(test)]
mod tests {
    use super::*;
    #[cfg(feature = "opencv")]
    use crate::config::StereoMethod;
    use stipple_drivers::{ImuCalibration, Lens};

    fn rig(lens: Lens, f: f64) -> Calibration {
        let camera = Camera { width: 320, height: 240, fx: f, fy: f, cx: 160.3, cy: 118.9, lens };
        let right = Pose::new(glam::DQuat::from_rotation_y(0.01), glam::DVec3::new(0.1, 0.002, -0.001));
        Calibration {
            cameras: vec![RigCamera::new(camera, Pose::IDENTITY), RigCamera::new(camera, right)],
            imu: ImuCalibration::CONSUMER,
        }
    }

    /// Maps are made anew for rows that are off, not for a pair that moved as one nor for one that no knock makes.
    #[test]
    fn views_follow_cameras_that_moved_and_maps_those_that_a_knock_may_have_moved() {
        let rig = rig(Lens::Radtan { k1: -0.2, k2: 0.05, p1: 1e-4, p2: -1e-4 }, 200.0);
        let mut views = RectifiedViews::new(&rig, 1).expect("a sound rig");
        let [left, right] = [0, 1].map(|i| rig.cameras[i].body_from_cam);
        let (at_boot, taps) = (views.camera(), views.maps[0].taps(320).collect::<Vec<_>>());
        let knock = Pose::new(glam::DQuat::from_rotation_x(0.05), glam::DVec3::new(0.0, 0.02, 0.0));
        let unusable = Pose { p: glam::DVec3::X * f64::NAN, ..right };
        let turned = |x: f64| right * Pose::new(glam::DQuat::from_rotation_x(x), glam::DVec3::ZERO);
        let cases = [
            ([knock * left, knock * right], false),
            ([left, turned(1e-3)], false),
            ([left, turned(0.2)], false),
            ([left, Pose { p: -right.p, ..right }], false),
            ([left, unusable], false),
            ([left, turned(0.03)], true),
            ([left, turned(0.03)], false),
            ([left, right], true),
        ];
        for (n, (places, anew)) in cases.into_iter().enumerate() {
            assert_eq!(views.adjust(&places), anew, "case {n}");
            assert!(views.camera().body_from_rect.is_finite() && views.camera().pinhole == at_boot.pinhole, "case {n}");
            if n == 0 {
                let off = (knock * at_boot.body_from_rect).inverse() * views.camera().body_from_rect;
                assert!(off.p.length() < 1e-12 && off.q.to_scaled_axis().length() < 1e-12, "{off:?}");
            }
        }
        let back = views.camera();
        let off = at_boot.body_from_rect.inverse() * back.body_from_rect;
        assert!(off.q.to_scaled_axis().length() < 1e-9 && (back.baseline_m - at_boot.baseline_m).abs() < 1e-12);
        assert!(views.maps[0].taps(320).eq(taps));
    }

    #[cfg(feature = "opencv")]
    #[test]
    fn plane_has_its_depth() {
        let lens = Lens::Radtan { k1: -0.2, k2: 0.05, p1: 1e-4, p2: -1e-4 };
        let rig = rig(lens, 200.0);
        let z_world = 2.0;
        let draw = |c: &RigCamera| {
            let mut image = Image::new(320, 240);
            for y in 0..240 {
                for x in 0..320 {
                    let b = c.camera.unproject(glam::DVec2::new(x as f64, y as f64)).expect("inside the model");
                    let d = c.body_from_cam.q * b;
                    let p = c.body_from_cam.p + d * ((z_world - c.body_from_cam.p.z) / d.z);
                    let cell = |s: f64| ((p.x * s).sin() * (p.y * s * 1.3 + p.x).cos()) * 40.0;
                    image.pixels[y * 320 + x] = (128.0 + cell(23.0) + cell(61.0) + cell(7.0)) as u8;
                }
            }
            image
        };
        let (left, right) = (draw(&rig.cameras[0]), draw(&rig.cameras[1]));
        for divisor in [1, 2] {
            let mut stereo = Stereo::new(&rig, &StereoConfig::default(), divisor, None).expect("a sound rig");
            let camera = stereo.views.camera();
            let mut depth = DepthMap::new(camera.pinhole.width, camera.pinhole.height);
            let found = stereo.depth(None, &left, &right, &mut depth).expect("matching runs");
            assert!(found * 2 > depth.metres.len(), "{found} of {}", depth.metres.len());
            let mut worst = vec![];
            for y in 0..depth.height {
                for x in 0..depth.width {
                    let z = f64::from(depth.metres[y * depth.width + x]);
                    if z > 0.0 {
                        let p = camera.pinhole;
                        let ray = glam::DVec3::new((x as f64 - p.cx) / p.fx, (y as f64 - p.cy) / p.fy, 1.0) * z;
                        worst.push((camera.body_from_rect.transform(ray).z - z_world).abs());
                    }
                }
            }
            worst.sort_by(f64::total_cmp);
            assert!(worst[worst.len() / 2] < 0.02, "median error {} m", worst[worst.len() / 2]);
            assert!(worst[worst.len() * 95 / 100] < 0.1, "95 % error {} m", worst[worst.len() * 95 / 100]);
        }
    }

    #[cfg(feature = "opencv")]
    #[test]
    fn every_opencv_method_gives_depth_and_a_blind_eye_none() {
        let rig = rig(Lens::Radtan { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0 }, 200.0);
        let mut left = Image::new(320, 240);
        let level = |i: usize| 40 + (i % 320 * 7 + i / 320 * 13 + (i % 320) * (i / 320) % 31) % 170;
        left.pixels.iter_mut().enumerate().for_each(|(i, p)| *p = level(i) as u8);
        let mut noise = Image::new(320, 240);
        noise.pixels.iter_mut().enumerate().for_each(|(i, p)| *p = (level(i) % 4) as u8);
        for method in [StereoMethod::Bm, StereoMethod::Sgbm] {
            let config = StereoConfig { method, depth_max_m: 1e4, ..StereoConfig::default() };
            let mut stereo = Stereo::new(&rig, &config, 1, None).expect("a sound rig");
            let mut depth = DepthMap::new(320, 240);
            for dark in [Image::new(320, 240), noise.clone()] {
                assert_eq!(stereo.depth(None, &left, &dark, &mut depth).expect("no fault"), 0, "{method:?}");
                assert_eq!(stereo.depth(None, &dark, &left, &mut depth).expect("no fault"), 0, "{method:?}");
            }
            assert!(depth.metres.iter().all(|z| *z == 0.0));
        }
    }

    #[test]
    fn divided_pinhole_sees_the_same_rays() {
        let p = Pinhole { width: 64, height: 48, fx: 50.0, fy: 51.0, cx: 31.2, cy: 24.1 };
        let h = p.divided(2);
        // The centre of mapping pixel (3, 5) is the corner between four full pixels, (6.5, 10.5).
        assert!(((3.0 - h.cx) / h.fx - (6.5 - p.cx) / p.fx).abs() < 1e-12);
        assert!(((5.0 - h.cy) / h.fy - (10.5 - p.cy) / p.fy).abs() < 1e-12);
    }

    #[test]
    fn fisheye_is_rectified_to_a_bounded_angle() {
        let rig = rig(Lens::KannalaBrandt { k: [0.01, -0.01, 0.005, -0.001] }, 100.0);
        let r = Rectification::new(&rig).expect("a sound rig");
        let half = (r.camera.pinhole.width as f64 / 2.0 / r.camera.pinhole.fx).atan().to_degrees();
        assert!((30.0..61.0).contains(&half), "{half}");
    }
}
