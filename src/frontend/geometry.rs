//! Two-view geometry between the cameras of a rig, and between a camera and itself a moment ago.

use super::patch::Warp;
use glam::{DVec2, DVec3};
use stipple_drivers::{Calibration, Pose, RigCamera};

/// Half the width of the patch: the lever that shows its rotation, px.
const LEVER_PX: f32 = 4.0;
/// A negative inverse depth of this many pixels of disparity is a far point and noise, px.
const DISPARITY_SLACK_PX: f64 = 2.0;
/// Least distance of a point, m.
const DEPTH_MIN: f64 = 0.1;

/// Rays of the middle of a patch and of a pixel beside it.
pub type PatchRays = (DVec3, Option<DVec3>);

/// The cameras of a rig and where they sit.
pub struct RigGeometry {
    cameras: Vec<RigCamera>,
    body_from_cam: Vec<Pose>,
    /// `between[to * cameras + from]` is `to_from_from`.
    between: Vec<Pose>,
    epipolar_max: f64,
    /// By how much rays may miss each other beyond that, as places are still being estimated, rad.
    widened: f64,
}

impl RigGeometry {
    pub fn new(calibration: &Calibration, epipolar_max: f64) -> RigGeometry {
        let n = calibration.cameras.len();
        let mut rig = RigGeometry {
            cameras: calibration.cameras.clone(),
            body_from_cam: calibration.cameras.iter().map(|c| c.body_from_cam).collect(),
            between: vec![Pose::IDENTITY; n * n],
            epipolar_max,
            widened: 0.0,
        };
        rig.refresh();
        rig
    }

    fn refresh(&mut self) {
        let n = self.cameras.len();
        for (i, between) in self.between.iter_mut().enumerate() {
            *between = self.body_from_cam[i / n].inverse() * self.body_from_cam[i % n];
        }
    }

    /// Takes the cameras to be at these places, which may be so far off, rad.
    pub fn correct(&mut self, body_from_cam: &[Pose], widened: f64) {
        self.body_from_cam.iter_mut().zip(body_from_cam).for_each(|(to, from)| *to = *from);
        self.widened = widened;
        self.refresh();
    }

    /// The longest focal length, px.
    pub fn focal_px(&self) -> f64 {
        self.cameras.iter().fold(0.0, |f, c| f.max(c.camera.fx))
    }

    /// Takes the images of two cameras for each other's; the second time as before. Masks stay with their images.
    pub fn exchange(&mut self, [a, b]: [usize; 2]) {
        self.cameras.swap(a, b);
        let masks = self.cameras[a].masks;
        self.cameras[a].masks = std::mem::replace(&mut self.cameras[b].masks, masks);
        self.body_from_cam.swap(a, b);
        self.refresh();
    }

    /// Unit ray of a pixel; `None` outside the camera model and where the vehicle is in view.
    pub fn bearing(&self, camera: usize, px: [f32; 2]) -> Option<DVec3> {
        let bearing = self.cameras[camera].camera.unproject(DVec2::new(px[0] as f64, px[1] as f64));
        bearing.filter(|_| !self.is_masked(camera, px))
    }

    /// Whether the vehicle is in view at a pixel.
    pub fn is_masked(&self, camera: usize, px: [f32; 2]) -> bool {
        self.cameras[camera].is_masked(px[0] as f64, px[1] as f64)
    }

    /// Motion of one camera: `now_from_before`, from that of the body.
    pub fn motion(&self, camera: usize, before_from_now: &Pose) -> Pose {
        let body_from_cam = self.body_from_cam[camera];
        body_from_cam.inverse() * before_from_now.inverse() * body_from_cam
    }

    /// `to_from_from` between two cameras at one instant.
    pub fn between(&self, from: usize, to: usize) -> Pose {
        self.between[to * self.cameras.len() + from]
    }

    /// Rays of a pixel, and of the one beside it that shows how a patch is turned, where that has one; `None` where the pixel has
    /// none.
    pub fn rays(&self, camera: usize, px: [f32; 2]) -> Option<PatchRays> {
        Some((self.bearing(camera, px)?, self.bearing(camera, [px[0] + LEVER_PX, px[1]])))
    }

    /// Place and rotation in camera `to` of a patch at an inverse distance `q`, 1/m; `None` where it is not seen.
    pub fn transfer(&self, from: usize, to: usize, to_from_from: &Pose, px: [f32; 2], q: f64) -> Option<Warp> {
        self.transfer_rays(to, to_from_from, &self.rays(from, px)?, q)
    }

    /// The same of a patch whose rays are known.
    pub fn transfer_rays(&self, to: usize, to_from_from: &Pose, rays: &PatchRays, q: f64) -> Option<Warp> {
        let send = |ray: DVec3| {
            let at = self.cameras[to].camera.project(to_from_from.q * ray + to_from_from.p * q)?;
            self.cameras[to].camera.contains(at, 0.0).then_some([at.x as f32, at.y as f32])
        };
        let centre = send(rays.0)?;
        let mut warp = Warp::upright(centre);
        if let Some(side) = rays.1.and_then(send) {
            warp.rotate(side[0] - centre[0], side[1] - centre[1]);
        }
        Some(warp)
    }

    /// Inverse distance of a point seen in two cameras, 1/m, along the ray of `from`, and its weight:
    /// the q that best puts R f + q t on the other ray. `None` when the rays miss each other by more
    /// than the epipolar gate or meet behind a camera.
    pub fn triangulate(&self, from: usize, to: usize, f: DVec3, g: DVec3) -> Option<(f64, f64)> {
        let Pose { q: r, p: t } = self.between(from, to);
        let f = r * f;
        if g.dot(t.normalize().cross(f)).abs() > self.epipolar_max + self.widened {
            return None;
        }
        let (a, b) = (g.cross(t), g.cross(f));
        let weight = a.length_squared();
        let q = -a.dot(b) / weight;
        let slack = DISPARITY_SLACK_PX / (self.cameras[from].camera.fx * t.length()) + self.widened / t.length();
        (q > -slack && q < 1.0 / DEPTH_MIN && g.dot(f + t * q.max(0.0)) > 0.0).then_some((q, weight))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use glam::DQuat;
    use stipple_drivers::calibration::Mask;
    use stipple_drivers::{Camera, ImuCalibration, ImuCorrection, Lens};

    fn rig() -> RigGeometry {
        let lens = Lens::KannalaBrandt { k: [0.01, -0.01, 0.006, -0.0017] };
        let camera = Camera { width: 640, height: 480, fx: 300.0, fy: 300.0, cx: 320.0, cy: 240.0, lens };
        let rolled = Pose::new(DQuat::from_euler(glam::EulerRot::XYZ, 0.02, -0.05, 0.2), DVec3::new(0.1, 0.01, 0.0));
        let cameras = [Pose::IDENTITY, rolled].map(|body_from_cam| RigCamera::new(camera, body_from_cam)).to_vec();
        let imu = ImuCalibration {
            rate_hz: 200.0,
            gyro_noise: 1e-3,
            gyro_walk: 1e-5,
            accel_noise: 1e-2,
            accel_walk: 1e-4,
            range: ImuCalibration::RANGE,
            measured: false,
            correction: ImuCorrection::NONE,
        };
        RigGeometry::new(&Calibration { cameras, imu }, 0.005)
    }

    #[test]
    fn exchanged_cameras_keep_the_masks_of_their_images() {
        let mut rig = rig();
        rig.cameras[0].masks[0] = Mask { left: 0, top: 0, right: 100, bottom: 100 };
        rig.exchange([0, 1]);
        assert!(rig.is_masked(0, [50.0, 50.0]) && !rig.is_masked(1, [50.0, 50.0]));
        assert!((rig.between(0, 1).p - DVec3::new(0.1, 0.01, 0.0)).length() < 1e-12, "each is where the other was");
        rig.exchange([0, 1]);
        assert!(rig.is_masked(0, [50.0, 50.0]) && !rig.is_masked(1, [50.0, 50.0]));
    }

    #[test]
    fn transfer_and_triangulation_agree() {
        let rig = rig();
        for q in [0.0, 0.2, 1.0] {
            let px = [250.0, 200.0];
            let warp = rig.transfer(0, 1, &rig.between(0, 1), px, q).unwrap();
            let (f, g) = (rig.bearing(0, px).unwrap(), rig.bearing(1, warp.px()).unwrap());
            assert!((rig.triangulate(0, 1, f, g).unwrap().0 - q).abs() < 1e-3);
            // the second camera is rolled by 0.2 rad, so the patch rotates the other way
            assert!((warp.s.atan2(warp.c) + 0.2).abs() < 0.05);
        }
    }

    #[test]
    fn points_off_the_epipolar_line_or_behind_are_refused() {
        let rig = rig();
        let px = [330.0, 250.0];
        let f = rig.bearing(0, px).unwrap();
        let [x, y] = rig.transfer(0, 1, &rig.between(0, 1), px, 0.0).unwrap().px();
        let t = rig.between(0, 1).p.normalize();
        for (along, across, ok) in [(30.0, 0.0, true), (-30.0, 0.0, false), (30.0, 4.0, false)] {
            let (dx, dy) = (t.x as f32, t.y as f32);
            let g = rig.bearing(1, [x + along * dx - across * dy, y + along * dy + across * dx]).unwrap();
            assert_eq!(rig.triangulate(0, 1, f, g).is_some(), ok, "{along} {across}");
        }
    }
}
