//! Adam on a camera pose: position additive in the world, rotation perturbed on the right.

use glam::{DQuat, DVec3};
use stipple_drivers::Pose;

const BETA1: f64 = 0.9;
/// Poses take tens of steps, not thousands: the second moment must settle within them.
const BETA2: f64 = 0.99;
const EPSILON: f64 = 1e-12;

/// Moments of one pose.
#[derive(Clone, Copy, Debug, Default)]
pub struct PoseAdam {
    m: [f64; 6],
    v: [f64; 6],
    steps: i32,
}

impl PoseAdam {
    /// One step down `gradient` (by [p, θ]); metres and radians move alike, at most about `rate` each. Not taken
    /// when the gradient is not finite.
    pub fn step(&mut self, pose: &mut Pose, gradient: &[f64; 6], rate: f64) {
        if !gradient.iter().all(|g| g.is_finite()) {
            return;
        }
        self.steps += 1;
        let mut d = [0.0; 6];
        for i in 0..6 {
            self.m[i] = BETA1 * self.m[i] + (1.0 - BETA1) * gradient[i];
            self.v[i] = BETA2 * self.v[i] + (1.0 - BETA2) * gradient[i] * gradient[i];
            let m = self.m[i] / (1.0 - BETA1.powi(self.steps));
            let v = self.v[i] / (1.0 - BETA2.powi(self.steps));
            d[i] = -rate * m / (v.sqrt() + EPSILON);
        }
        *pose = Pose::new(
            pose.q * DQuat::from_scaled_axis(DVec3::new(d[3], d[4], d[5])),
            pose.p + DVec3::new(d[0], d[1], d[2]),
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn descends_to_the_pose_that_fits() {
        // Points seen from the true pose; squared distance of where another pose sees them.
        let truth = Pose::new(DQuat::from_scaled_axis(DVec3::new(0.3, -0.2, 0.5)), DVec3::new(1.0, 2.0, 3.0));
        let points = [DVec3::X, DVec3::Y * 2.0, DVec3::new(1.0, 1.0, 3.0), DVec3::new(-2.0, 0.5, 1.0)];
        let mut pose = Pose::new(truth.q * DQuat::from_scaled_axis(DVec3::splat(0.02)), truth.p + DVec3::splat(0.03));
        let mut adam = PoseAdam::default();
        for k in 0..200 {
            let mut g = [0.0; 6];
            for &b in &points {
                let e = pose.transform(b) - truth.transform(b);
                let turn = b.cross(pose.q.conjugate() * e); // d|e|²/dθ for R Exp(θ), halved
                for i in 0..3 {
                    g[i] += e[i];
                    g[3 + i] += turn[i];
                }
            }
            adam.step(&mut pose, &g, 2e-3 * 0.98f64.powi(k));
        }
        assert!((pose.p - truth.p).length() < 1e-3 && pose.q.angle_between(truth.q) < 1e-3);
    }

    #[test]
    fn gradient_that_is_not_finite_moves_nothing() {
        let mut pose = Pose::IDENTITY;
        PoseAdam::default().step(&mut pose, &[f64::NAN, 0.0, 0.0, 0.0, 0.0, 0.0], 1.0);
        assert_eq!(pose, Pose::IDENTITY);
    }
}
