//! Uniform cumulative B-spline on R³ x SO(3), order 6: C⁴, so that the specific force and the angular velocity it implies are
//! smooth and exact.
//!
//! Position is an ordinary B-spline; rotation is R(t) = R_i Π Exp(λ_j(u) d_j) with d_j = Log(R_{i+j-1}⁻¹ R_{i+j}) and λ_j the
//! cumulative basis; the angular velocity follows by the recursion ω <- Exp(-λ d) ω + λ' d (Sommer et al., CVPR 2020). Time is
//! in seconds from the start of the spline.

use crate::types::Pose;
use glam::{DQuat, DVec3};

/// Control poses that shape one segment.
pub const ORDER: usize = 6;
const DEGREE: usize = ORDER - 1;

/// A motion in time.
#[derive(Clone, Debug)]
pub struct Spline {
    /// Knot spacing, s.
    knot: f64,
    controls: Vec<Pose>,
}

/// The motion at one instant: m, m/s, m/s², rad/s.
#[derive(Clone, Copy, Debug)]
pub struct Motion {
    /// `world_from_body`, m.
    pub pose: Pose,
    /// Velocity in the world frame, m/s.
    pub v_world: DVec3,
    /// Acceleration in the world frame, m/s².
    pub a_world: DVec3,
    /// Angular velocity in the body frame, rad/s.
    pub gyro_body: DVec3,
}

impl Spline {
    /// The spline whose control poses are samples of `path`: a slightly smoothed `path` on [0, duration].
    pub fn sampled(duration: f64, knot: f64, path: impl Fn(f64) -> Pose) -> Spline {
        let controls = (0..control_count(duration, knot)).map(|i| path(control_time(i, knot))).collect();
        Spline { knot, controls }
    }

    /// A fit to time-sorted samples (at least one): each round moves every control pose by the mean residual of the samples
    /// near it. Rounds converge fast for motions that the knots resolve and slowly at their Nyquist rate, so a few rounds
    /// follow the motion and leave the noise of the samples behind.
    pub fn fit(samples: &[(f64, Pose)], knot: f64, rounds: usize) -> Spline {
        let duration = samples.last().map_or(0.0, |s| s.0);
        let mut spline = Spline::sampled(duration, knot, |t| sample_at(samples, t));
        let n = spline.controls.len();
        let mut residual = vec![(DVec3::ZERO, DVec3::ZERO, 0.0); n];
        for _ in 0..rounds {
            residual.fill((DVec3::ZERO, DVec3::ZERO, 0.0));
            for (t, pose) in samples {
                let at = spline.at(*t).pose;
                let dp = pose.p - at.p;
                let dq = log(at.q.conjugate() * pose.q);
                // The fractional control index, see `control_time`.
                let x = t / knot + 2.0;
                let i = x.floor() as usize;
                for (i, w) in [(i, 1.0 - x.fract()), (i + 1, x.fract())] {
                    if let Some(r) = residual.get_mut(i) {
                        *r = (r.0 + w * dp, r.1 + w * dq, r.2 + w);
                    }
                }
            }
            for (c, r) in spline.controls.iter_mut().zip(&residual) {
                if r.2 > 0.0 {
                    *c = Pose::new(c.q * DQuat::from_scaled_axis(r.1 / r.2), c.p + r.0 / r.2);
                }
            }
        }
        spline
    }

    /// The last instant at which the spline is defined, s.
    pub fn duration(&self) -> f64 {
        (self.controls.len() - DEGREE) as f64 * self.knot
    }

    /// The motion at `t`, which is clamped to [0, duration].
    pub fn at(&self, t: f64) -> Motion {
        let segments = self.controls.len() - DEGREE;
        let x = (t / self.knot).clamp(0.0, segments as f64);
        let i = (x.floor() as usize).min(segments - 1);
        let u = x - i as f64;
        let c = &self.controls[i..i + ORDER];
        let (b0, b1, b2) = (basis(DEGREE, u), basis(DEGREE - 1, u), basis(DEGREE - 2, u));
        let (mut p, mut v, mut a) = (DVec3::ZERO, DVec3::ZERO, DVec3::ZERO);
        for j in 0..ORDER {
            p += b0[j] * c[j].p;
            if j > 0 {
                v += b1[j - 1] * (c[j].p - c[j - 1].p);
            }
            if j > 1 {
                a += b2[j - 2] * (c[j].p - 2.0 * c[j - 1].p + c[j - 2].p);
            }
        }
        let mut q = c[0].q;
        let mut w = DVec3::ZERO;
        for j in 1..ORDER {
            let d = log(c[j - 1].q.conjugate() * c[j].q);
            let cumulative: f64 = b0[j..].iter().sum();
            let step = DQuat::from_scaled_axis(cumulative * d);
            q *= step;
            w = step.conjugate() * w + b1[j - 1] * d;
        }
        let rate = 1.0 / self.knot;
        Motion { pose: Pose::new(q, p), v_world: v * rate, a_world: a * rate * rate, gyro_body: w * rate }
    }
}

fn control_count(duration: f64, knot: f64) -> usize {
    (duration / knot).ceil().max(1.0) as usize + DEGREE
}

/// The instant at which control pose `i` weighs most.
fn control_time(i: usize, knot: f64) -> f64 {
    (i as f64 - 2.0) * knot
}

/// Values of the `degree + 1` uniform B-splines that live on one segment (Cox-de Boor).
fn basis(degree: usize, u: f64) -> [f64; ORDER] {
    let mut n = [0.0; ORDER];
    n[0] = 1.0;
    for j in 1..=degree {
        let mut carried = 0.0;
        for r in 0..j {
            let share = n[r] / j as f64;
            n[r] = carried + ((r + 1) as f64 - u) * share;
            carried = (u + (j - r - 1) as f64) * share;
        }
        n[j] = carried;
    }
    n
}

/// The rotation vector, rad, of the shorter way round.
pub fn log(q: DQuat) -> DVec3 {
    let q = if q.w < 0.0 { -q } else { q };
    let v = q.xyz();
    let n = v.length();
    if n < 1e-10 {
        2.0 * v
    } else {
        v * (2.0 * n.atan2(q.w) / n)
    }
}

/// The sampled path at `t`, held at its ends.
fn sample_at(samples: &[(f64, Pose)], t: f64) -> Pose {
    let after = samples.partition_point(|s| s.0 < t);
    match (after.checked_sub(1).map(|i| samples[i]), samples.get(after)) {
        (None, Some(s)) => s.1,
        (Some(s), None) => s.1,
        (Some(a), Some(b)) => a.1.interpolate(&b.1, (t - a.0) / (b.0 - a.0)),
        (None, None) => Pose::IDENTITY,
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn wild() -> Spline {
        Spline::sampled(4.0, 0.1, |t| {
            let w = DVec3::new((2.0 * t).sin(), 1.5 * (1.3 * t).cos(), 0.9 * t);
            Pose::new(DQuat::from_scaled_axis(w), DVec3::new((3.0 * t).sin(), (2.0 * t).cos(), 0.1 * t * t))
        })
    }

    #[test]
    fn velocity_acceleration_and_rate_are_the_derivatives_of_the_pose() {
        let s = wild();
        let h = 1e-5;
        for k in 1..200 {
            let t = 0.0193 * k as f64;
            let (a, m, b) = (s.at(t - h), s.at(t), s.at(t + h));
            assert!(((b.pose.p - a.pose.p) / (2.0 * h) - m.v_world).length() < 1e-7, "v at {t}");
            assert!(((b.v_world - a.v_world) / (2.0 * h) - m.a_world).length() < 1e-5, "a at {t}");
            let w = log(a.pose.q.conjugate() * b.pose.q) / (2.0 * h);
            assert!((w - m.gyro_body).length() < 1e-6, "w at {t}: {w} {}", m.gyro_body);
        }
    }

    #[test]
    fn derivatives_are_continuous_across_knots() {
        let s = wild();
        for k in 1..39 {
            let (a, b) = (s.at(0.1 * k as f64 - 1e-9), s.at(0.1 * k as f64 + 1e-9));
            assert!((a.a_world - b.a_world).length() < 1e-5);
            assert!((a.gyro_body - b.gyro_body).length() < 1e-6);
        }
    }

    #[test]
    fn fit_follows_samples_of_a_resolved_motion() {
        let truth = wild();
        let samples: Vec<(f64, Pose)> =
            (0..=800).map(|k| (k as f64 * 0.005, truth.at(k as f64 * 0.005).pose)).collect();
        let fitted = Spline::fit(&samples, 0.05, 8);
        for k in 20..380 {
            let (a, b) = (truth.at(k as f64 * 0.01), fitted.at(k as f64 * 0.01));
            assert!((a.pose.p - b.pose.p).length() < 1e-3, "{k}");
            assert!((a.v_world - b.v_world).length() < 0.02, "{k}");
            assert!(log(a.pose.q.conjugate() * b.pose.q).length() < 1e-3, "{k}");
        }
    }
}
