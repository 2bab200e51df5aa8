//! Views that were not taken at their frame's stamp: by a camera whose clock is off, or in a row that a
//! rolling shutter exposed earlier or later.
//!
//! In τ the body goes on with the velocity and rate it has, both seen from the body:
//! `R(τ) = R Exp(ω τ)`, `p(τ) = p + R v τ`. To the residuals that is a camera that sits elsewhere on the
//! body, `body_from_cam(τ) = (Exp(ω τ), v τ) body_from_cam`, so poses have the Jacobians they always had,
//! and rotating or translating the world changes no residual: position and yaw stay unobservable. The twist
//! is held through an optimization, and for good once its frame has a fixed linearization point.

use super::reprojection::{ExtrinsicDerivatives, Transform};
use crate::math::so3;
use glam::{DMat3, DVec3};

/// Velocity and rate of the body, in the body frame, m/s and rad/s.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Twist {
    pub v: DVec3,
    pub w: DVec3,
}

/// The place of a camera τ after the stamp, and its derivatives to τ and to its place at the stamp.
#[derive(Clone, Copy, Debug)]
pub struct DelayedCamera {
    pub body_from_cam: Transform,
    /// Rotation of the body in τ.
    rotation: DMat3,
    /// Derivatives of [p, θ] to τ.
    d_p: DVec3,
    d_theta: DVec3,
}

impl DelayedCamera {
    /// `tau` in seconds.
    pub fn new(body_from_cam: &Transform, twist: &Twist, tau: f64) -> DelayedCamera {
        let rotation = so3::exp_matrix(twist.w * tau);
        DelayedCamera {
            body_from_cam: Transform { r: rotation * body_from_cam.r, p: rotation * body_from_cam.p + twist.v * tau },
            rotation,
            d_p: rotation * twist.w.cross(body_from_cam.p) + twist.v,
            d_theta: body_from_cam.r.transpose() * twist.w,
        }
    }

    /// Derivatives to [p, θ] of the camera at τ, made derivatives to those at the stamp and to τ.
    fn to_stamp(self, d: &[f64; 6]) -> ([f64; 6], f64) {
        let (d_p, d_theta) = (DVec3::new(d[0], d[1], d[2]), DVec3::new(d[3], d[4], d[5]));
        let p = self.rotation.transpose() * d_p;
        ([p.x, p.y, p.z, d[3], d[4], d[5]], d_p.dot(self.d_p) + d_theta.dot(self.d_theta))
    }
}

/// Turns derivatives to both cameras at their instants into those to the cameras at the stamp; answers, for each
/// coordinate of the pixel, the derivatives to the time offsets of the host's camera and of the seeing one.
pub fn to_stamp(d: &mut ExtrinsicDerivatives, host: &DelayedCamera, target: &DelayedCamera) -> [[f64; 2]; 2] {
    std::array::from_fn(|k| {
        let (of_host, of_target) = (host.to_stamp(&d.host[k]), target.to_stamp(&d.target[k]));
        (d.host[k], d.target[k]) = (of_host.0, of_target.0);
        [of_host.1, of_target.1]
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::reprojection::{CameraModel, Point, View};
    use super::*;
    use glam::{DQuat, DVec2};
    use stipple_drivers::{Camera, Lens, Pose};

    const H: f64 = 1e-6;

    fn pose(k: f64) -> Pose {
        Pose::new(DQuat::from_scaled_axis(DVec3::new(0.3, -0.2, 0.4) * k), DVec3::new(0.5, -0.3, 0.2) * k)
    }

    fn moved(at: &Pose, i: usize, h: f64) -> Pose {
        let e = DVec3::AXES[i % 3] * h;
        if i < 3 {
            Pose::new(at.q, at.p + e)
        } else {
            Pose::new(at.q * so3::exp(e), at.p)
        }
    }

    /// Host pose, target pose, host camera, target camera; time offsets of both cameras.
    #[derive(Clone, Copy)]
    struct Scene {
        poses: [Pose; 4],
        time_offsets: [f64; 2],
    }

    const TWISTS: [Twist; 2] = [
        Twist { v: DVec3::new(1.0, -2.0, 0.5), w: DVec3::new(2.0, 1.0, -3.0) },
        Twist { v: DVec3::new(-0.5, 1.0, 2.0), w: DVec3::new(-1.0, 2.0, 1.5) },
    ];
    /// Delays of the rows, s.
    const ROWS: [f64; 2] = [-0.007, 0.009];

    fn scene() -> Scene {
        let mut host_cam = pose(0.3);
        host_cam.p = DVec3::new(0.05, 0.1, -0.02);
        Scene { poses: [pose(1.0), pose(1.2), host_cam, pose(0.25)], time_offsets: [0.004, -0.003] }
    }

    fn camera() -> Camera {
        let lens = Lens::Radtan { k1: -0.28, k2: 0.07, p1: 2e-4, p2: 2e-5 };
        Camera { width: 752, height: 480, fx: 458.0, fy: 457.0, cx: 367.0, cy: 248.0, lens }
    }

    fn delayed(s: &Scene) -> [DelayedCamera; 2] {
        [0, 1].map(|k| DelayedCamera::new(&Transform::from(&s.poses[2 + k]), &TWISTS[k], s.time_offsets[k] + ROWS[k]))
    }

    fn pixel(point: &Point, s: &Scene) -> DVec2 {
        let [host, target] = delayed(s);
        let camera_model = CameraModel { camera: camera(), body_from_cam: target.body_from_cam, readout: 0.0 };
        let [a, b] = [0, 1].map(|k| Transform::from(&s.poses[k]));
        let view = View { host_cam: &host.body_from_cam, host: &a, camera: &camera_model, target: &b };
        view.predict(point).unwrap()
    }

    #[test]
    fn derivatives_of_a_delayed_view_match_differences_to_poses_cameras_and_time() {
        let s = scene();
        for point in [
            Point::new(DVec3::new(0.1, -0.2, 1.0).normalize(), 0.4),
            Point::new(DVec3::new(-0.3, 0.1, 1.0).normalize(), 0.0),
            Point::new(DVec3::new(0.2, 0.3, 1.0).normalize(), 1.5),
        ] {
            let [host, target] = delayed(&s);
            let camera_model = CameraModel { camera: camera(), body_from_cam: target.body_from_cam, readout: 0.0 };
            let (a, b) = (Transform::from(&s.poses[0]), Transform::from(&s.poses[1]));
            let view = View { host_cam: &host.body_from_cam, host: &a, camera: &camera_model, target: &b };
            let (r, mut d) = view.reproject_with_extrinsics(&point).unwrap();
            let d_time = to_stamp(&mut d, &host, &target);
            assert!((r.px - pixel(&point, &s)).length() < 1e-12);
            let close = |analytic: f64, numeric: f64, what: &str| {
                let error = (analytic - numeric).abs() / (1.0 + analytic.abs());
                assert!(error < 2e-6, "{what}: analytic {analytic}, numeric {numeric}");
            };
            for (which, (what, analytic)) in
                [("host", r.d_host), ("target", r.d_target), ("host camera", d.host), ("camera", d.target)]
                    .into_iter()
                    .enumerate()
            {
                for i in 0..6 {
                    let at = |h: f64| {
                        let mut s = s;
                        s.poses[which] = moved(&s.poses[which], i, h);
                        pixel(&point, &s)
                    };
                    let numeric = (at(H) - at(-H)) / (2.0 * H);
                    (0..2).for_each(|k| close(analytic[k][i], numeric[k], what));
                }
            }
            for (which, what) in ["time of the host", "time of the view"].into_iter().enumerate() {
                let at = |h: f64| {
                    let mut s = s;
                    s.time_offsets[which] += h;
                    pixel(&point, &s)
                };
                let numeric = (at(H) - at(-H)) / (2.0 * H);
                (0..2).for_each(|k| close(d_time[k][which], numeric[k], what));
            }
        }
    }

    #[test]
    fn a_delayed_camera_is_where_the_body_takes_it() {
        let (s, tau) = (scene(), 0.01);
        let delayed = DelayedCamera::new(&Transform::from(&s.poses[2]), &TWISTS[0], tau);
        let body = s.poses[0];
        let later = Pose::new(body.q * so3::exp(TWISTS[0].w * tau), body.p + body.q * TWISTS[0].v * tau);
        let expected = later * s.poses[2];
        let found = body.rotation() * delayed.body_from_cam.p + body.p;
        assert!((found - expected.p).length() < 1e-12);
        let rotation = body.rotation() * delayed.body_from_cam.r;
        assert!((rotation - expected.rotation()).to_cols_array().iter().all(|x| x.abs() < 1e-12));
    }
}
