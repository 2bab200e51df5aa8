//! What the mapper itself finds out about a keyframe: a small correction of its pose and its exposure, each
//! refined by its own Adam beside the map.
//!
//! The correction multiplies the pose that odometry gives, in the body frame (world_from_refined =
//! world_from_body · body_from_refined), so a later correction from odometry or a loop composes with it, and
//! nothing of it ever goes back to odometry. The gauge, where the map as a whole is and how bright, is no keyframe's:
//! a decay of every correction towards none, decoupled from the gradient (AdamW; Loshchilov & Hutter, ICLR 2019), holds
//! it, and what one exposure moves by all move back together, since a map that is still dim would else brighten them all.
//! Fixing the first keyframe instead leaves it worst fitted. As Adam moves at most about `rate` a step, the decay also
//! bounds a correction, by 1 / DECAY an axis.

use super::exposure::{Exposure, PIVOT};
use glam::{DQuat, DVec3};
use stipple_drivers::Pose;

const BETA1: f64 = 0.9;
/// Keyframes take tens of steps, not thousands: the second moment must settle within them.
const BETA2: f64 = 0.99;
const EPSILON: f64 = 1e-12;
/// A step's decay over its rate, 1/m and 1/rad: an axis moves 20 cm and 0.2 rad at most.
const POSE_DECAY: f64 = 5.0;
/// The same of the exposure, by ln gain and grey level.
const EXPOSURE_DECAY: f64 = 0.1;

/// Adam over N numbers.
#[derive(Clone, Copy, Debug)]
struct Adam<const N: usize> {
    m: [f64; N],
    v: [f64; N],
    steps: i32,
}

impl<const N: usize> Default for Adam<N> {
    fn default() -> Self {
        Adam { m: [0.0; N], v: [0.0; N], steps: 0 }
    }
}

impl<const N: usize> Adam<N> {
    /// What to add to the numbers; nothing when the gradient is not finite.
    fn step(&mut self, gradient: &[f64; N], rate: f64) -> [f64; N] {
        if !gradient.iter().all(|g| g.is_finite()) {
            return [0.0; N];
        }
        self.steps += 1;
        std::array::from_fn(|i| {
            self.m[i] = BETA1 * self.m[i] + (1.0 - BETA1) * gradient[i];
            self.v[i] = BETA2 * self.v[i] + (1.0 - BETA2) * gradient[i] * gradient[i];
            let m = self.m[i] / (1.0 - BETA1.powi(self.steps));
            let v = self.v[i] / (1.0 - BETA2.powi(self.steps));
            -rate * m / (v.sqrt() + EPSILON)
        })
    }
}

/// What was found out about one keyframe.
#[derive(Clone, Copy, Debug, Default)]
pub struct Refinement {
    pub body_from_refined: Pose,
    pub exposure: Exposure,
    pose: Adam<6>,
    exposed: Adam<2>,
}

impl Refinement {
    /// What was found out before, without moments.
    pub fn known(body_from_refined: Pose, exposure: Exposure) -> Refinement {
        Refinement { body_from_refined, exposure, ..Refinement::default() }
    }

    /// `part` of the way to another's; without moments.
    pub fn towards(&self, other: &Refinement, part: f64) -> Refinement {
        let (a, b) = (self.body_from_refined, other.body_from_refined);
        let (e, f) = (self.exposure, other.exposure);
        let between = |a: f64, b: f64| a + part * (b - a);
        Refinement {
            body_from_refined: Pose::new(a.q.slerp(b.q, part), a.p.lerp(b.p, part)),
            exposure: Exposure { gain: between(e.gain, f.gain), offset: between(e.offset, f.offset) },
            ..Refinement::default()
        }
    }

    /// One step down `gradient`, by [p, θ] of `world_from_cam` (p additive in the world, rotation perturbed on the
    /// right); metres and radians move alike, at most about `rate` each.
    pub fn step_pose(&mut self, gradient: &[f64; 6], world_from_cam: &Pose, body_from_cam: &Pose, rate: f64) {
        let d = self.pose.step(&in_body(gradient, world_from_cam, body_from_cam), rate);
        let keep = 1.0 - rate * POSE_DECAY;
        let Pose { q, p } = self.body_from_refined;
        let rotation = DQuat::from_scaled_axis(keep * q.to_scaled_axis()) * DQuat::from_scaled_axis(three(&d, 3));
        self.body_from_refined = Pose::new(rotation, keep * p + q * three(&d, 0));
    }

    /// One step down `gradient`, by [gain, offset]; ln gain and the level of mid-grey move at most about `rate`. Answers
    /// by how much they did.
    pub fn step_exposure(&mut self, gradient: &[f64; 2], rate: f64) -> [f64; 2] {
        let Exposure { gain, .. } = self.exposure;
        let d = self.exposed.step(&[gain * (gradient[0] - PIVOT * gradient[1]), gradient[1]], rate);
        let before = self.exposure.levels();
        let keep = 1.0 - rate * EXPOSURE_DECAY;
        self.exposure = Exposure::from_levels([keep * before[0] + d[0], keep * before[1] + d[1]]);
        let after = self.exposure.levels();
        [after[0] - before[0], after[1] - before[1]]
    }

    /// Moves ln gain and the level of mid-grey.
    pub fn shift_exposure(&mut self, by: [f64; 2]) {
        let [log_gain, level] = self.exposure.levels();
        self.exposure = Exposure::from_levels([log_gain + by[0], level + by[1]]);
    }
}

/// A gradient by a camera's pose as one by the body's, both perturbed on the right: p += R δ, R <- R Exp(θ).
fn in_body(gradient: &[f64; 6], world_from_cam: &Pose, body_from_cam: &Pose) -> [f64; 6] {
    let by_p = body_from_cam.q * (world_from_cam.q.conjugate() * three(gradient, 0));
    let by_rotation = body_from_cam.q * three(gradient, 3) + body_from_cam.p.cross(by_p);
    [by_p.x, by_p.y, by_p.z, by_rotation.x, by_rotation.y, by_rotation.z]
}

fn three(v: &[f64], at: usize) -> DVec3 {
    DVec3::new(v[at], v[at + 1], v[at + 2])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(turn: [f64; 3], p: [f64; 3]) -> Pose {
        Pose::new(DQuat::from_scaled_axis(DVec3::from(turn)), DVec3::from(p))
    }

    /// Half the squared distance of where a camera sees points from where it should, and its gradient by [p, θ].
    fn misfit(world_from_cam: &Pose, truth: &Pose) -> (f64, [f64; 6]) {
        let points = [DVec3::X, DVec3::Y * 2.0, DVec3::new(1.0, 1.0, 3.0), DVec3::new(-2.0, 0.5, 1.0)];
        let (mut value, mut g) = (0.0, [0.0; 6]);
        for b in points {
            let e = world_from_cam.transform(b) - truth.transform(b);
            let turn = b.cross(world_from_cam.q.conjugate() * e); // of R Exp(θ)
            value += 0.5 * e.length_squared();
            (0..3).for_each(|i| g[i] += e[i]);
            (0..3).for_each(|i| g[3 + i] += turn[i]);
        }
        (value, g)
    }

    const GIVEN: ([f64; 3], [f64; 3]) = ([0.3, -0.2, 0.5], [1.0, 2.0, 3.0]);
    const RIG: ([f64; 3], [f64; 3]) = ([0.1, 0.2, -1.5], [0.05, -0.3, 0.2]);

    #[test]
    fn gradient_in_the_body_agrees_with_finite_differences() {
        let (given, rig) = (pose(GIVEN.0, GIVEN.1), pose(RIG.0, RIG.1));
        let truth = given * pose([0.02, 0.01, -0.03], [0.03, 0.02, 0.01]) * rig;
        let (_, by_cam) = misfit(&(given * rig), &truth);
        let analytic = in_body(&by_cam, &(given * rig), &rig);
        for k in 0..6 {
            let at = |h: f64| {
                let mut d = [0.0; 6];
                d[k] = h;
                misfit(&(given * pose([d[3], d[4], d[5]], [d[0], d[1], d[2]]) * rig), &truth).0
            };
            let numeric = (at(1e-6) - at(-1e-6)) / 2e-6;
            assert!((analytic[k] - numeric).abs() < 1e-7, "{k}: {} against {numeric}", analytic[k]);
        }
    }

    #[test]
    fn descends_to_the_pose_that_fits_and_no_farther_than_its_bound() {
        let (given, rig) = (pose(GIVEN.0, GIVEN.1), pose(RIG.0, RIG.1));
        let near = given * pose([0.02; 3], [0.03; 3]) * rig;
        let far = given * pose([0.0; 3], [3.0, 0.0, 0.0]) * rig;
        for (truth, reach) in [(near, 1e-2), (far, 3.0)] {
            let mut r = Refinement::default();
            for k in 0..2000 {
                let world_from_cam = given * r.body_from_refined * rig;
                let (_, g) = misfit(&world_from_cam, &truth);
                r.step_pose(&g, &world_from_cam, &rig, 2e-3 * 0.998f64.powi(k));
            }
            let refined = given * r.body_from_refined * rig;
            assert!((refined.p - truth.p).length() < reach && refined.q.angle_between(truth.q) < reach);
            assert!(r.body_from_refined.p.length() < 1.1 * 3f64.sqrt() / POSE_DECAY, "{:?}", r.body_from_refined);
        }
    }

    #[test]
    fn exposure_descends_to_the_one_that_fits() {
        let greys: Vec<f64> = (0..50).map(|i| 0.2 + 0.01 * f64::from(i)).collect();
        let truth = Exposure { gain: 1.3, offset: -0.08 };
        let mut r = Refinement::default();
        for k in 0..600 {
            let mut g = [0.0; 2];
            for &x in &greys {
                let e = r.exposure.observed(x) - truth.observed(x);
                (g[0], g[1]) = (g[0] + e * x, g[1] + e);
            }
            r.step_exposure(&g, 1e-2 * 0.99f64.powi(k));
        }
        assert!((r.exposure.gain - truth.gain).abs() < 0.02 && (r.exposure.offset - truth.offset).abs() < 0.01);
        assert!((truth.inverse(truth.observed(0.37)) - 0.37).abs() < 1e-12);
    }

    #[test]
    fn gradients_that_are_not_finite_move_nothing() {
        let mut r = Refinement::default();
        r.step_pose(&[f64::NAN, 0.0, 0.0, 0.0, 0.0, 0.0], &Pose::IDENTITY, &Pose::IDENTITY, 0.1);
        r.step_exposure(&[0.0, f64::INFINITY], 0.1);
        assert_eq!((r.body_from_refined, r.exposure), (Pose::IDENTITY, Exposure::default()));
    }
}
