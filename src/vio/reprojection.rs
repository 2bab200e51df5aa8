//! Reprojection: where a camera sees a point of another frame, and the derivatives of that pixel. All derivatives
//! are checked by finite differences.
//!
//! A landmark lives in a camera of its host frame: stereographic direction `s` and inverse distance
//! `rho`. Its point, scaled by `rho`, is `b(s)`, so points at infinity are ordinary:
//! `x_w = R_h (R_c b + rho t_c) + rho p_h`, `x_t = R_tᵀ (x_w - rho p_t)`; projection ignores the scale.

use glam::{DMat3, DVec2, DVec3};
use stipple_drivers::{Camera, Pose, RigCamera};

/// A pose with its rotation as a matrix, for what projects many points; `p` in m.
#[derive(Clone, Copy, Debug, Default)]
pub struct Transform {
    pub r: DMat3,
    pub p: DVec3,
}

impl From<&Pose> for Transform {
    fn from(pose: &Pose) -> Transform {
        Transform { r: pose.rotation(), p: pose.p }
    }
}

/// A camera: lens, place on the body and shutter.
#[derive(Clone, Copy, Debug)]
pub struct CameraModel {
    pub camera: Camera,
    pub body_from_cam: Transform,
    /// First row to last, s; zero is a global shutter.
    pub readout: f64,
}

impl From<&RigCamera> for CameraModel {
    fn from(c: &RigCamera) -> CameraModel {
        CameraModel { camera: c.camera, body_from_cam: Transform::from(&c.body_from_cam), readout: c.readout.secs() }
    }
}

impl CameraModel {
    /// Time at which a row is exposed, after the stamp, which is the middle row's, s.
    pub fn row_delay(&self, row: f64) -> f64 {
        self.readout * (row / (self.camera.height - 1).max(1) as f64 - 0.5)
    }
}

/// A point on the ray of a camera of its host frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Point {
    /// (x, y)/(1 + z) of the unit bearing.
    pub s: DVec2,
    /// 1/m along the bearing.
    pub rho: f64,
}

impl Point {
    pub fn new(bearing: DVec3, rho: f64) -> Point {
        Point { s: bearing.truncate() / (1.0 + bearing.z), rho }
    }

    /// Unit ray to the point, in its host's camera.
    pub fn bearing(&self) -> DVec3 {
        let n = self.s.length_squared();
        (2.0 * self.s).extend(1.0 - n) / (1.0 + n)
    }

    fn d_bearing(&self) -> [DVec3; 2] {
        let (s, n) = (self.s, self.s.length_squared());
        let k = 2.0 / ((1.0 + n) * (1.0 + n));
        [
            DVec3::new(1.0 + n - 2.0 * s.x * s.x, -2.0 * s.x * s.y, -2.0 * s.x) * k,
            DVec3::new(-2.0 * s.x * s.y, 1.0 + n - 2.0 * s.y * s.y, -2.0 * s.y) * k,
        ]
    }
}

/// Prediction minus observation, px, and derivatives to [p, θ] of both frames and to [s, rho].
#[derive(Clone, Copy, Debug, Default)]
pub struct Reprojection {
    pub px: DVec2,
    pub d_host: [[f64; 6]; 2],
    pub d_target: [[f64; 6]; 2],
    pub d_point: [[f64; 3]; 2],
}

/// Derivatives of the pixel to [p, θ] of the cameras on the body, the host's and the target's.
#[derive(Clone, Copy, Debug, Default)]
pub struct ExtrinsicDerivatives {
    pub host: [[f64; 6]; 2],
    pub target: [[f64; 6]; 2],
}

/// The two cameras of a view: where the host's sits on its body and that body in the world, the camera that sees the
/// point and the body it is on.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    pub host_cam: &'a Transform,
    pub host: &'a Transform,
    pub camera: &'a CameraModel,
    pub target: &'a Transform,
}

/// A point, scaled by its inverse distance, in each frame on the way from its host's camera to another.
struct Ray {
    x_host: DVec3,
    x_target: DVec3,
    x_cam: DVec3,
}

/// A row of d(px)/d(x_cam), carried back through each frame on the ray's way.
struct Gradient {
    cam: DVec3,
    target: DVec3,
    host: DVec3,
    point: DVec3,
}

impl View<'_> {
    /// Pixel at which the point is seen; `None` where the camera cannot see it.
    pub fn predict(&self, point: &Point) -> Option<DVec2> {
        self.camera.camera.project(self.trace(point).x_cam)
    }

    /// That pixel with its derivatives to both frames and to the point.
    #[inline]
    pub fn reproject(&self, point: &Point) -> Option<Reprojection> {
        self.derive(point, |_, _, _| {})
    }

    /// That pixel with derivatives also to where the cameras sit.
    pub fn reproject_with_extrinsics(&self, point: &Point) -> Option<(Reprojection, ExtrinsicDerivatives)> {
        let mut d = ExtrinsicDerivatives::default();
        let bearing = point.bearing();
        let r = self.derive(point, |k, ray, g| {
            let (th_host, th_target) = (bearing.cross(g.point), g.cam.cross(ray.x_cam));
            let (p_host, p_target) = (g.host * point.rho, g.target * -point.rho);
            d.host[k] = [p_host.x, p_host.y, p_host.z, th_host.x, th_host.y, th_host.z];
            d.target[k] = [p_target.x, p_target.y, p_target.z, th_target.x, th_target.y, th_target.z];
        })?;
        Some((r, d))
    }

    #[inline(always)]
    fn trace(&self, point: &Point) -> Ray {
        let View { host_cam, host, camera, target } = self;
        let x_host = host_cam.r * point.bearing() + host_cam.p * point.rho;
        let x_rel = host.r * x_host + (host.p - target.p) * point.rho;
        let x_target = target.r.transpose() * x_rel;
        let x_cam = camera.body_from_cam.r.transpose() * (x_target - camera.body_from_cam.p * point.rho);
        Ray { x_host, x_target, x_cam }
    }

    /// Reprojection; `each` gets the gradient of each coordinate of the pixel.
    #[inline(always)]
    fn derive(&self, point: &Point, mut each: impl FnMut(usize, &Ray, &Gradient)) -> Option<Reprojection> {
        let View { host_cam, host, camera, target } = self;
        let rho = point.rho;
        let ray = self.trace(point);
        let (px, d_px) = camera.camera.project_with_jacobian(ray.x_cam)?;
        let d_bearing = point.d_bearing();
        let d_rho_rel = host.r * host_cam.p + host.p - target.p;
        let mut out = Reprojection { px, ..Reprojection::default() };
        for k in 0..2 {
            let g_cam = DVec3::from_array(d_px[k]);
            let g_target = camera.body_from_cam.r * g_cam;
            let g_world = target.r * g_target;
            let g_host = host.r.transpose() * g_world;
            let g_point = host_cam.r.transpose() * g_host;
            let p = g_world * rho;
            let th_host = ray.x_host.cross(g_host);
            let th_target = g_target.cross(ray.x_target);
            out.d_host[k] = [p.x, p.y, p.z, th_host.x, th_host.y, th_host.z];
            out.d_target[k] = [-p.x, -p.y, -p.z, th_target.x, th_target.y, th_target.z];
            let d_rho = g_world.dot(d_rho_rel) - g_target.dot(camera.body_from_cam.p);
            out.d_point[k] = [g_point.dot(d_bearing[0]), g_point.dot(d_bearing[1]), d_rho];
            each(k, &ray, &Gradient { cam: g_cam, target: g_target, host: g_host, point: g_point });
        }
        Some(out)
    }
}

/// Huber on a whitened length: (weight of the squared residual, cost).
#[inline]
pub fn huber(length: f64, width: f64) -> (f64, f64) {
    if length <= width {
        (1.0, 0.5 * length * length)
    } else {
        (width / length, width * (length - 0.5 * width))
    }
}

/// Curvature of Huber's cost along an error beyond the width, as a share of the curvature across it. The true one is zero, but
/// steps by it overshoot and are taken back; one, as in iteratively reweighted least squares, makes steps too short.
pub const CURVATURE: f64 = 0.5;

/// Factor on the deviation of a view by which the curvatures of all views sum up to the information that the estimate has,
/// for errors of two Gaussian coordinates and a width of `width` deviations (Huber, 1964).
pub fn huber_scale(width: f64) -> f64 {
    const STEP: f64 = 1e-3;
    // The share of errors within the width, the mean weight ψ/r, and the mean derivative of ψ, which is ψ' along the error and
    // ψ/r across it. The variance is E[ψ²] / E[ψ']²; of a coordinate, E[ψ²] is the share as well.
    let share = 1.0 - (-0.5 * width * width).exp();
    let beyond: f64 = (0..8000).map(|i| STEP * (-0.5 * (width + STEP * (f64::from(i) + 0.5)).powi(2)).exp()).sum();
    let weight = share + width * beyond;
    let derivative = 0.5 * (share + weight);
    // The curvature that the rows of a view have.
    let claimed = derivative + 0.5 * CURVATURE * (weight - share);
    (claimed * share).sqrt() / derivative
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::inertial::Motion;
    use super::super::world::stream;
    use super::*;
    use glam::DQuat;
    use stipple_drivers::Lens;

    const H: f64 = 1e-6;

    fn close(analytic: f64, numeric: f64, what: &str) {
        let error = (analytic - numeric).abs() / (1.0 + analytic.abs().max(numeric.abs()));
        assert!(error < 2e-6, "{what}: analytic {analytic}, numeric {numeric}");
    }

    fn moved(m: &Motion, i: usize, h: f64) -> Motion {
        let mut d = [0.0; 15];
        d[i] = h;
        m.plus(&d)
    }

    fn motion(k: f64) -> Motion {
        Motion {
            pose: Pose::new(DQuat::from_scaled_axis(DVec3::new(0.3, -0.2, 0.4) * k), DVec3::new(0.5, -0.3, 0.2) * k),
            v: DVec3::new(0.3, 0.8, -0.4) * k,
            bg: DVec3::new(0.01, -0.02, 0.03) * k,
            ba: DVec3::new(-0.1, 0.05, 0.2) * k,
        }
    }

    fn cameras() -> Vec<CameraModel> {
        let lenses = [
            Lens::Radtan { k1: -0.28, k2: 0.07, p1: 2e-4, p2: 2e-5 },
            Lens::KannalaBrandt { k: [0.01, -0.005, 0.003, -0.001] },
            Lens::DoubleSphere { xi: -0.2, alpha: 0.6 },
        ];
        let camera = |lens| CameraModel {
            camera: Camera { width: 752, height: 480, fx: 458.0, fy: 457.0, cx: 367.0, cy: 248.0, lens },
            body_from_cam: Transform::from(&Pose::new(
                DQuat::from_scaled_axis(DVec3::new(0.1, 0.2, -0.3)),
                DVec3::new(0.05, 0.1, -0.02),
            )),
            readout: 0.0,
        };
        lenses.into_iter().map(camera).collect()
    }

    #[test]
    fn reprojection_jacobians_match_differences_to_host_target_and_point() {
        let (host, target) = (motion(1.0), motion(1.3));
        for camera in cameras() {
            for point in [
                Point::new(DVec3::new(0.1, -0.2, 1.0).normalize(), 0.4),
                Point::new(DVec3::new(-0.3, 0.1, 1.0).normalize(), 0.0),
                Point::new(DVec3::new(0.4, 0.3, 1.0).normalize(), 1.5),
            ] {
                let on = |m: &Motion| Transform::from(&m.pose);
                let f = |point: &Point, host: &Motion, target: &Motion| {
                    let (host, target) = (&on(host), &on(target));
                    View { host_cam: &camera.body_from_cam, host, camera: &camera, target }.predict(point).unwrap()
                };
                let (on_host, on_target) = (&on(&host), &on(&target));
                let host_cam = &camera.body_from_cam;
                let r = View { host_cam, host: on_host, camera: &camera, target: on_target }.reproject(&point).unwrap();
                assert!((r.px - f(&point, &host, &target)).length() < 1e-12);
                for i in 0..6 {
                    let d_host = (f(&point, &moved(&host, i, H), &target) - f(&point, &moved(&host, i, -H), &target))
                        / (2.0 * H);
                    let d_target = (f(&point, &host, &moved(&target, i, H)) - f(&point, &host, &moved(&target, i, -H)))
                        / (2.0 * H);
                    for row in 0..2 {
                        close(r.d_host[row][i], d_host[row], "host");
                        close(r.d_target[row][i], d_target[row], "target");
                    }
                }
                for i in 0..3 {
                    let at = |h: f64| {
                        let mut p = point;
                        match i {
                            2 => p.rho += h,
                            _ => p.s[i] += h,
                        }
                        f(&p, &host, &target)
                    };
                    let d = (at(H) - at(-H)) / (2.0 * H);
                    (0..2).for_each(|row| close(r.d_point[row][i], d[row], "point"));
                }
            }
        }
    }

    #[test]
    fn stereographic_point_keeps_its_bearing() {
        for b in [DVec3::Z, DVec3::new(0.9, -0.4, 0.1), DVec3::new(-0.5, 0.5, -0.5)] {
            assert!((Point::new(b.normalize(), 1.0).bearing() - b.normalize()).length() < 1e-14);
        }
    }

    /// The place of a point from 40 views of it, 4000 times.
    #[test]
    fn huber_scale_gives_the_variance_of_the_estimate() {
        let mut noise = stream(1, 1);
        for width in [0.3, 0.5, 1.0, 3.0] {
            let (mut squares, mut claimed) = (0.0, 0.0);
            for _ in 0..4000 {
                let views = [(); 40].map(|()| DVec2::new(noise.normal(), noise.normal()));
                let mut at = DVec2::ZERO;
                for _ in 0..60 {
                    let weights = views.map(|v| huber((v - at).length(), width).0);
                    let information = weights.iter().sum::<f64>();
                    at = views.iter().zip(weights).map(|(v, w)| *v * w).sum::<DVec2>() / information;
                }
                let curvature = |v: DVec2| match huber((v - at).length(), width).0 {
                    weight if weight < 1.0 => 0.5 * (1.0 + CURVATURE) * weight,
                    weight => weight,
                };
                let information = views.map(curvature).iter().sum::<f64>();
                squares += 0.5 * at.length_squared();
                claimed += huber_scale(width).powi(2) / information;
            }
            assert!((squares / claimed - 1.0).abs() < 0.05, "{width}: {}", squares / claimed);
        }
    }

    #[test]
    fn huber_cost_and_weight_agree() {
        // d(cost)/d(length) = weight * length, on both sides of the width.
        for x in [0.3, 0.999, 1.001, 4.0] {
            let gradient = (huber(x + H, 1.0).1 - huber(x - H, 1.0).1) / (2.0 * H);
            close(huber(x, 1.0).0 * x, gradient, "huber");
        }
    }
}
