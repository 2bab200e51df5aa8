//! Rectification: both cameras turned so that their rows are parallel to the baseline, lens
//! distortion removed (any model of `stipple_drivers::camera`), as look-up tables made at boot, and anew where cameras are found
//! to sit elsewhere.
//!
//! The common focal length and principal point are the ones that show the widest view without
//! blank borders along the middle row and column of both cameras, and no ray further off-axis than
//! `TAN_MAX`: a pinhole cannot hold a fisheye's whole view, and beyond that angle one raw pixel
//! would be smeared over many.

use super::{Pinhole, RectifiedCamera};
use glam::{DMat3, DQuat, DVec2, DVec3};
use stipple_drivers::{Calibration, Fault, FaultKind, Image, Pose, RigCamera};

/// tan of the widest half angle of a rectified view (60°, 1.73; 50° keeps fisheye pixels under 2.4x stretch).
const TAN_MAX: f64 = 1.2;
/// Weights are in 1/128 px.
const WEIGHT_BITS: u32 = 7;
/// Marks a pixel without source.
const OUTSIDE: u32 = u32::MAX;

pub struct Rectification {
    pub camera: RectifiedCamera,
    /// Rotation of each rectified camera on the rig; both are the same.
    body_from_rect: DQuat,
}

/// Rows of the two views may be so far off one another, in their middle, before the maps are made anew, px.
const ROWS_OFF_MAX: f64 = 0.25;
/// What is matched is farther away, m: by so much does it move along a row where the baseline turns.
const NEAR_M: f64 = 0.5;
/// A pair that was turned further is not one that was knocked, rad: an estimate that is lost would cost the view its edges.
const TURNED_MAX: f64 = 0.1;

impl Rectification {
    pub fn new(calibration: &Calibration) -> Result<Rectification, Fault> {
        let help =
            "a map needs cameras 0 and 1 side by side, looking the same way; without a map: --set map.enabled=false";
        Rectification::of(&calibration.cameras, None)
            .map_err(|what| Fault::new(FaultKind::Config, "calibration", what, help))
    }

    /// Rectification of cameras that were moved on the body, seen through the same pinhole as before; `None` where they are no
    /// pair any more.
    pub fn moved(&self, cameras: &[RigCamera]) -> Option<Rectification> {
        Rectification::of(cameras, Some(self.camera.pinhole)).ok()
    }

    fn of(cameras: &[RigCamera], pinhole: Option<Pinhole>) -> Result<Rectification, &'static str> {
        let [left, right, ..] = cameras else {
            return Err("has fewer than two cameras");
        };
        let along = right.body_from_cam.p - left.body_from_cam.p;
        let baseline_m = along.length();
        if !(baseline_m > 1e-4) {
            return Err("has a zero baseline between cameras 0 and 1");
        }
        let axis = |c: &RigCamera| c.body_from_cam.q * DVec3::Z;
        let x = along / baseline_m;
        let forward = axis(left) + axis(right);
        let z = forward - x * x.dot(forward);
        if z.length() < 0.5 || (left.body_from_cam.q * DVec3::X).dot(x) < 0.5 {
            return Err("has cameras 0 and 1 not side by side (is camera 1 the right one?)");
        }
        let z = z.normalize();
        let body_from_rect = DQuat::from_mat3(&DMat3::from_cols(x, z.cross(x), z)).normalize();
        let pinhole = pinhole
            .or_else(|| common_pinhole(left, right, body_from_rect))
            .ok_or("leaves no common view after rectification")?;
        let pose = Pose::new(body_from_rect, left.body_from_cam.p);
        Ok(Rectification { camera: RectifiedCamera { pinhole, body_from_rect: pose, baseline_m }, body_from_rect })
    }

    /// How the rectified camera is turned in a raw one.
    pub fn cam_from_rect(&self, camera: &RigCamera) -> DQuat {
        camera.body_from_cam.q.conjugate() * self.body_from_rect
    }

    /// Whether rows are off one another where the right camera has moved in the left one from `before` to `after`.
    pub fn rows_are_off(&self, before: &Pose, after: &Pose) -> bool {
        let Turned { camera, baseline } = Turned::new(before, after);
        let fx = self.camera.pinhole.fx;
        fx * camera + fx * self.camera.baseline_m / NEAR_M * baseline > ROWS_OFF_MAX
    }

    /// Where each rectified pixel comes from in a raw image of `camera`.
    pub fn map(&self, camera: &RigCamera) -> Remap {
        let p = &self.camera.pinhole;
        let taps = Vec::with_capacity(p.width * p.height);
        let mut map = Remap { width: p.width, height: p.height, source_width: camera.camera.width, taps };
        self.fill(camera, &mut map);
        map
    }

    /// The same into a map of this size.
    pub fn fill(&self, camera: &RigCamera, map: &mut Remap) {
        let p = &self.camera.pinhole;
        let cam_from_rect = self.cam_from_rect(camera);
        let raw = &camera.camera;
        let taps = &mut map.taps;
        taps.clear();
        for y in 0..p.height {
            for x in 0..p.width {
                let ray = DVec3::new((x as f64 - p.cx) / p.fx, (y as f64 - p.cy) / p.fy, 1.0);
                let tap = raw
                    .project(cam_from_rect * ray)
                    .filter(|px| raw.contains(*px, 0.0) && !camera.is_masked(px.x, px.y));
                taps.push(tap.map_or(Tap { index: OUTSIDE, wx: 0, wy: 0 }, |px| Tap::at(px, raw.width, raw.height)));
            }
        }
    }
}

/// The common intrinsics of both rectified views; see the module's text.
fn common_pinhole(left: &RigCamera, right: &RigCamera, body_from_rect: DQuat) -> Option<Pinhole> {
    let (width, height) = (left.camera.width, left.camera.height);
    let mut side = [TAN_MAX; 4]; // left, right, top, bottom: tangents of the view's edges
    for c in [left, right] {
        let rect_from_cam = body_from_rect.conjugate() * c.body_from_cam.q;
        let (w, h) = ((c.camera.width - 1) as f64, (c.camera.height - 1) as f64);
        let edges = [(0.0, h / 2.0), (w, h / 2.0), (w / 2.0, 0.0), (w / 2.0, h)];
        for (i, (x, y)) in edges.into_iter().enumerate() {
            // An edge outside the model's domain (fisheye past 180°) or behind does not limit.
            let Some(b) = c.camera.unproject(DVec2::new(x, y)) else { continue };
            let r = rect_from_cam * b;
            if r.z > 0.05 {
                let t = [-r.x, r.x, -r.y, r.y][i] / r.z;
                side[i] = side[i].min(t);
            }
        }
    }
    let [l, r, t, b] = side;
    if l + r < 0.1 || t + b < 0.1 {
        return None;
    }
    let f = (width as f64 / (l + r)).max(height as f64 / (t + b));
    let cx = 0.5 * (width as f64 - 1.0) + 0.5 * (l - r) * f;
    let cy = 0.5 * (height as f64 - 1.0) + 0.5 * (t - b) * f;
    Some(Pinhole { width, height, fx: f, fy: f, cx, cy })
}

/// One bilinear look-up.
#[derive(Clone, Copy, Debug)]
pub struct Tap {
    /// Upper left source pixel.
    index: u32,
    wx: u16,
    wy: u16,
}

impl Tap {
    fn at(px: DVec2, width: usize, height: usize) -> Tap {
        let one = f64::from(1 << WEIGHT_BITS);
        // The last row and column are reached with weight one from the pixel before them.
        let x0 = (px.x.floor() as usize).min(width - 2);
        let y0 = (px.y.floor() as usize).min(height - 2);
        Tap {
            index: (y0 * width + x0) as u32,
            wx: ((px.x - x0 as f64) * one).round() as u16,
            wy: ((px.y - y0 as f64) * one).round() as u16,
        }
    }
}

/// How far the right camera and the baseline to it have turned in the left camera, rad.
pub struct Turned {
    camera: f64,
    baseline: f64,
}

impl Turned {
    /// Poses of the right camera in the left one, before and after.
    pub fn new(before: &Pose, after: &Pose) -> Turned {
        let camera = (before.q.conjugate() * after.q).to_scaled_axis().length();
        Turned { camera, baseline: before.p.angle_between(after.p) }
    }

    /// Whether it may have been a knock.
    pub fn is_possible(&self) -> bool {
        self.camera.max(self.baseline) < TURNED_MAX
    }
}

pub struct Remap {
    width: usize,
    height: usize,
    source_width: usize,
    taps: Vec<Tap>,
}

impl Remap {
    /// Pixels without source become 0.
    pub fn apply(&self, raw: &Image, out: &mut Image) {
        debug_assert!(raw.width == self.source_width && out.width == self.width);
        let one = 1u32 << WEIGHT_BITS;
        for (tap, px) in self.taps.iter().zip(&mut out.pixels) {
            *px = if tap.index == OUTSIDE {
                0
            } else {
                let i = tap.index as usize;
                let j = i + self.source_width;
                let (wx, wy) = (u32::from(tap.wx), u32::from(tap.wy));
                let top = u32::from(raw.pixels[i]) * (one - wx) + u32::from(raw.pixels[i + 1]) * wx;
                let bottom = u32::from(raw.pixels[j]) * (one - wx) + u32::from(raw.pixels[j + 1]) * wx;
                ((top * (one - wy) + bottom * wy + (1 << (2 * WEIGHT_BITS - 1))) >> (2 * WEIGHT_BITS)) as u8
            };
        }
    }

    /// The look-ups for a kernel, with raw rows of `stride` bytes: the source's place in bytes, all ones where there is none, and
    /// the weights to the right and down.
    pub fn taps(&self, stride: usize) -> impl Iterator<Item = [u32; 2]> + '_ {
        let place =
            move |index: u32| (index as usize / self.source_width * stride + index as usize % self.source_width) as u32;
        let one = move |t: &Tap| match t.index {
            OUTSIDE => [OUTSIDE, 0],
            index => [place(index), u32::from(t.wx) | u32::from(t.wy) << 16],
        };
        self.taps.iter().map(one)
    }

    /// 1 for each `divisor` x `divisor` block that has a source everywhere.
    pub fn valid_blocks(&self, divisor: usize) -> Vec<u8> {
        let mut valid = vec![1u8; (self.width / divisor) * (self.height / divisor)];
        self.mask_blocks(divisor, &mut valid);
        valid
    }

    /// Sets the blocks to 0 that have not.
    pub fn mask_blocks(&self, divisor: usize, valid: &mut [u8]) {
        let (w, h) = (self.width / divisor, self.height / divisor);
        for y in 0..h * divisor {
            for x in 0..w * divisor {
                if self.taps[y * self.width + x].index == OUTSIDE {
                    valid[(y / divisor) * w + x / divisor] = 0;
                }
            }
        }
    }
}

/// Mean of each `divisor` x `divisor` block; `out` is pre-shaped.
pub fn box_average(image: &Image, divisor: usize, out: &mut Image) {
    if divisor == 1 {
        out.copy_from(image);
        return;
    }
    let n = (divisor * divisor) as u32;
    for y in 0..out.height {
        for x in 0..out.width {
            let mut sum = n / 2;
            for row in 0..divisor {
                let start = (y * divisor + row) * image.width + x * divisor;
                sum += image.pixels[start..start + divisor].iter().map(|p| u32::from(*p)).sum::<u32>();
            }
            out.pixels[y * out.width + x] = (sum / n) as u8;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use stipple_drivers::{Camera, ImuCalibration, Lens};

    /// A pair a little askew, as calibrations have it.
    fn rig(camera: Camera) -> Calibration {
        let turned = DQuat::from_euler(glam::EulerRot::XYZ, 0.012, -0.02, 0.015);
        let right = Pose::new(turned, DVec3::new(0.11, 0.003, -0.002));
        Calibration {
            cameras: vec![RigCamera::new(camera, Pose::IDENTITY), RigCamera::new(camera, right)],
            imu: ImuCalibration::CONSUMER,
        }
    }

    /// The largest distance between where our map takes a pixel from and where `reference` says, px, and of how many.
    fn worst(
        rig: &Calibration,
        reference: impl Fn(&Rectification, &RigCamera, usize) -> Option<DVec2>,
    ) -> (f64, usize) {
        let r = Rectification::new(rig).expect("a sound rig");
        let (mut worst, mut n) = (0f64, 0);
        for camera in &rig.cameras {
            let map = r.map(camera);
            for (i, tap) in map.taps.iter().enumerate().filter(|(_, t)| t.index != OUTSIDE) {
                let at = |corner: usize, weight: u16| corner as f64 + f64::from(weight) / f64::from(1 << WEIGHT_BITS);
                let (x, y) = (tap.index as usize % map.source_width, tap.index as usize / map.source_width);
                let ours = DVec2::new(at(x, tap.wx), at(y, tap.wy));
                if let Some(theirs) = reference(&r, camera, i) {
                    worst = worst.max(ours.distance(theirs));
                    n += 1;
                }
            }
        }
        (worst, n)
    }

    #[cfg(feature = "opencv")]
    fn against_opencv(camera: Camera, fisheye: bool, distortion: [f64; 4]) {
        let rig = rig(camera);
        let k = [camera.fx, camera.fy, camera.cx, camera.cy];
        let r = Rectification::new(&rig).expect("a sound rig");
        let p = r.camera.pinhole;
        let maps: Vec<Vec<[f32; 2]>> = rig
            .cameras
            .iter()
            .map(|c| {
                let turn =
                    DMat3::from_quat(r.body_from_rect.conjugate() * c.body_from_cam.q).transpose().to_cols_array();
                let rectified = [p.fx, p.fy, p.cx, p.cy];
                super::super::opencv::tests::rectification_map(
                    fisheye,
                    k,
                    distortion,
                    turn,
                    rectified,
                    [p.width, p.height],
                )
            })
            .collect();
        let (worst, n) = worst(&rig, |_, c, i| {
            let side = usize::from(c.body_from_cam != Pose::IDENTITY);
            let [x, y] = maps[side][i];
            Some(DVec2::new(f64::from(x), f64::from(y)))
        });
        assert!(worst < 0.05 && n > p.width * p.height, "{worst} px of {n}");
    }

    #[cfg(feature = "opencv")]
    #[test]
    fn maps_of_brown_lenses_are_those_of_opencv() {
        let (k1, k2, p1, p2) = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-5);
        let lens = Lens::Radtan { k1, k2, p1, p2 };
        let camera = Camera { width: 752, height: 480, fx: 458.654, fy: 457.296, cx: 367.215, cy: 248.375, lens };
        against_opencv(camera, false, [k1, k2, p1, p2]);
    }

    #[cfg(feature = "opencv")]
    #[test]
    fn maps_of_fisheyes_are_those_of_opencv() {
        let k = [0.0101710798924, -0.0108164400299, 0.0059427817694, -0.0016622846678];
        let lens = Lens::KannalaBrandt { k };
        let camera = Camera { width: 512, height: 512, fx: 190.4, fy: 190.4, cx: 254.9, cy: 256.9, lens };
        against_opencv(camera, true, k);
    }

    /// OpenCV has no such lens; equations 40 to 45 of Usenko et al. as they are printed.
    #[test]
    fn maps_of_double_spheres_are_those_of_the_paper() {
        let (xi, alpha) = (-0.2409573942178872, 0.566996899163044);
        let lens = Lens::DoubleSphere { xi, alpha };
        let camera = Camera { width: 752, height: 480, fx: 349.756, fy: 348.724, cx: 365.894, cy: 249.329, lens };
        let rig = rig(camera);
        let (worst, n) = worst(&rig, |r, c, i| {
            let p = r.camera.pinhole;
            let (x, y) = ((i % p.width) as f64, (i / p.width) as f64);
            let ray = DVec3::new((x - p.cx) / p.fx, (y - p.cy) / p.fy, 1.0);
            let q = c.body_from_cam.q.conjugate() * (r.body_from_rect * ray);
            let d1 = q.length();
            let d2 = (q.x * q.x + q.y * q.y + (xi * d1 + q.z).powi(2)).sqrt();
            let depth = alpha * d2 + (1.0 - alpha) * (xi * d1 + q.z);
            Some(DVec2::new(camera.fx * q.x / depth + camera.cx, camera.fy * q.y / depth + camera.cy))
        });
        assert!(worst < 0.05 && n > 752 * 480, "{worst} px of {n}");
    }
}
