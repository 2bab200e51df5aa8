//! A camera and where it looks from: what a picture of the map is drawn for.

use super::coarseness::Coarseness;
use crate::gpu::kernels::types::Camera as CameraWords;
use crate::stereo::Pinhole;
use glam::{DVec2, DVec3};
use stipple_drivers::{Camera, Lens, Pose};

/// A camera where it is looked from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    pub world_from_cam: Pose,
    pub camera: Pinhole,
    /// The lens that bends what `camera` would see; a pinhole without.
    pub fisheye: Option<Fisheye>,
    pub coarseness: Coarseness,
    /// Only the Gaussians of this epoch are seen.
    pub epoch: u32,
}

impl View {
    /// A view of the first epoch that leaves nothing out.
    pub fn new(world_from_cam: Pose, camera: Pinhole, fisheye: Option<Fisheye>) -> View {
        View { world_from_cam, camera, fisheye, coarseness: Coarseness::default(), epoch: 0 }
    }

    /// In the world, what a pixel shows at `depth` as the raster counts it: along the axis, of a fisheye along the ray.
    /// `None` outside the lens' domain.
    pub fn point(&self, x: usize, y: usize, depth: f64) -> Option<DVec3> {
        let (c, x, y) = (&self.camera, x as f64, y as f64);
        let p_cam = match self.fisheye {
            None => DVec3::new((x - c.cx) / c.fx, (y - c.cy) / c.fy, 1.0),
            Some(Fisheye { k, .. }) => {
                let lens = Lens::KannalaBrandt { k };
                let Pinhole { width, height, fx, fy, cx, cy } = *c;
                Camera { width, height, fx, fy, cx, cy, lens }.unproject(DVec2::new(x, y))?
            }
        };
        Some(self.world_from_cam.transform(p_cam * depth))
    }

    /// The pixel that shows a point in the camera's frame, and its depth as the raster counts it, m; `None` where it is outside
    /// the picture by more than a margin, px.
    pub fn project(&self, p_cam: DVec3, margin_px: f64) -> Option<(f64, f64, f64)> {
        let (p, c) = (p_cam, &self.camera);
        let (px, depth) = match self.fisheye {
            None if p.z <= 0.0 => return None,
            None => (DVec2::new(c.fx * p.x / p.z + c.cx, c.fy * p.y / p.z + c.cy), p.z),
            Some(Fisheye { k, theta_max }) => {
                if p.truncate().length().atan2(p.z) > theta_max {
                    return None;
                }
                let Pinhole { width, height, fx, fy, cx, cy } = *c;
                let lens = Lens::KannalaBrandt { k };
                (Camera { width, height, fx, fy, cx, cy, lens }.project(p)?, p.length())
            }
        };
        let inside = |v: f64, size: usize| v >= -0.5 - margin_px && v < size as f64 - 0.5 + margin_px;
        (inside(px.x, c.width) && inside(px.y, c.height)).then_some((px.x, px.y, depth))
    }
}

/// A Kannala-Brandt lens, as far as its image is seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fisheye {
    pub k: [f64; 4],
    /// Gaussians further off the axis are not drawn, rad.
    pub theta_max: f64,
}

impl Fisheye {
    /// A little beyond the corners, so that what only reaches in with its rim is drawn too.
    const BEYOND_CORNERS: f64 = 1.05;
    /// Short of π, where the image is a circle and no point.
    const THETA_END: f64 = 3.0;
    const THETA_STEP: f64 = 1e-3;

    /// Ends where the image does, or before it where the radius stops growing and points would fold back.
    pub fn new(k: [f64; 4], camera: &Pinhole) -> Fisheye {
        let reach = |at: f64, size: usize, f: f64| f64::max(at + 0.5, size as f64 - 0.5 - at) / f;
        let corner = reach(camera.cx, camera.width, camera.fx).hypot(reach(camera.cy, camera.height, camera.fy));
        let series = |t: f64, c: [f64; 4]| {
            let t2 = t * t;
            1.0 + t2 * (c[0] + t2 * (c[1] + t2 * (c[2] + t2 * c[3])))
        };
        let derivative = [3.0 * k[0], 5.0 * k[1], 7.0 * k[2], 9.0 * k[3]];
        let thetas = (1..).map(|i| f64::from(i) * Fisheye::THETA_STEP).take_while(|t| *t < Fisheye::THETA_END);
        let (mut theta_max, mut seen) = (0.0, None);
        for t in thetas.take_while(|t| series(*t, derivative) > 0.0) {
            theta_max = t;
            if seen.is_none() && t * series(t, k) >= corner {
                seen = Some(t * Fisheye::BEYOND_CORNERS);
            }
        }
        Fisheye { k, theta_max: seen.map_or(theta_max, |seen| theta_max.min(seen)) }
    }
}

impl View {
    /// Which of two kernels draws it: 0 for a pinhole, 1 for a fisheye.
    pub(super) fn lens(&self) -> usize {
        usize::from(self.fisheye.is_some())
    }

    /// The same view at half the size: pixels of two by two become one.
    pub(super) fn halved(&self) -> View {
        let Pinhole { width, height, fx, fy, cx, cy } = self.camera;
        let [cx, cy] = [cx, cy].map(|c| 0.5 * (c + 0.5) - 0.5);
        let camera = Pinhole { width: width / 2, height: height / 2, fx: 0.5 * fx, fy: 0.5 * fy, cx, cy };
        View { camera, ..*self }
    }

    /// Width and height, px.
    pub(super) fn size(&self) -> [u32; 2] {
        [self.camera.width as u32, self.camera.height as u32]
    }

    /// The camera and its pose for a kernel.
    pub(super) fn words(&self) -> CameraWords {
        let cam_from_world = self.world_from_cam.inverse();
        let (q, t, c) = (cam_from_world.q.as_quat(), cam_from_world.p.as_vec3(), &self.camera);
        let (k, theta_max) = self.fisheye.map_or(([0.0; 4], 0.0), |f| (f.k, f.theta_max));
        CameraWords {
            rotation: q.to_array(),
            translation: [t.x, t.y, t.z, theta_max as f32],
            focal_centre: [c.fx, c.fy, c.cx, c.cy].map(|v| v as f32),
            distortion: k.map(|k| k as f32),
        }
    }
}
