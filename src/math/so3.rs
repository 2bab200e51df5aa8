//! SO(3): exponential, logarithm, Jacobians.
//!
//! Rotations are perturbed on the right, `R <- R Exp(θ)`, everywhere in this project; θ is in the
//! frame the rotation maps *from* (the body). The right Jacobian is `Exp(φ + δ) ≈ Exp(φ) Exp(Jr(φ) δ)`.
//! Series are used near zero, where the closed forms cancel.

use glam::{DMat3, DQuat, DVec3};

/// Below this squared angle the closed forms lose more digits than the series drop, rad².
const SMALL_ANGLE2: f64 = 1e-8;

/// `hat(a) * b = a × b`.
#[inline]
pub fn hat(a: DVec3) -> DMat3 {
    DMat3::from_cols(DVec3::new(0.0, a.z, -a.y), DVec3::new(-a.z, 0.0, a.x), DVec3::new(a.y, -a.x, 0.0))
}

/// Unit quaternion of a rotation vector, rad.
pub fn exp(phi: DVec3) -> DQuat {
    let th2 = phi.length_squared();
    let (s, w) = if th2 < SMALL_ANGLE2 {
        (0.5 - th2 / 48.0, 1.0 - th2 / 8.0)
    } else {
        let th = th2.sqrt();
        ((0.5 * th).sin() / th, (0.5 * th).cos())
    };
    DQuat::from_xyzw(s * phi.x, s * phi.y, s * phi.z, w).normalize()
}

/// Rotation matrix of a rotation vector (Rodrigues).
pub fn exp_matrix(phi: DVec3) -> DMat3 {
    let th2 = phi.length_squared();
    let (a, b) = if th2 < SMALL_ANGLE2 {
        (1.0 - th2 / 6.0, 0.5 - th2 / 24.0)
    } else {
        let (sin, cos) = th2.sqrt().sin_cos();
        (sin / th2.sqrt(), (1.0 - cos) / th2)
    };
    let k = hat(phi);
    DMat3::IDENTITY + k * a + k * k * b
}

/// Rotation vector of a unit quaternion, |log| <= π.
pub fn log(q: DQuat) -> DVec3 {
    let q = if q.w < 0.0 { -q } else { q };
    let v = DVec3::new(q.x, q.y, q.z);
    let n2 = v.length_squared();
    if n2 < SMALL_ANGLE2 {
        v * (2.0 / q.w) * (1.0 - n2 / (3.0 * q.w * q.w))
    } else {
        let n = n2.sqrt();
        v * (2.0 * n.atan2(q.w) / n)
    }
}

/// Jr(φ): `Exp(φ + δ) ≈ Exp(φ) Exp(Jr(φ) δ)`.
pub fn right_jacobian(phi: DVec3) -> DMat3 {
    let th2 = phi.length_squared();
    let (a, b) = if th2 < SMALL_ANGLE2 {
        (0.5 - th2 / 24.0, 1.0 / 6.0 - th2 / 120.0)
    } else {
        let th = th2.sqrt();
        ((1.0 - th.cos()) / th2, (th - th.sin()) / (th2 * th))
    };
    let k = hat(phi);
    DMat3::IDENTITY - k * a + k * k * b
}

/// Jr⁻¹(φ).
pub fn right_jacobian_inverse(phi: DVec3) -> DMat3 {
    let th2 = phi.length_squared();
    let b = if th2 < SMALL_ANGLE2 {
        1.0 / 12.0 + th2 / 720.0
    } else {
        let th = th2.sqrt();
        1.0 / th2 - 0.5 / (th * (0.5 * th).tan())
    };
    let k = hat(phi);
    DMat3::IDENTITY + k * 0.5 + k * k * b
}

#[cfg(test)]
mod tests {
    use super::*;

    const SAMPLES: [DVec3; 6] = [
        DVec3::ZERO,
        DVec3::new(1e-9, -2e-9, 3e-9),
        DVec3::new(1e-4, 2e-4, -1e-4),
        DVec3::new(0.3, -0.2, 0.5),
        DVec3::new(-1.5, 1.2, 0.8),
        DVec3::new(3.1, 0.1, -0.2),
    ];

    #[test]
    fn log_inverts_exp() {
        for phi in SAMPLES {
            assert!((log(exp(phi)) - phi).length() < 1e-12 * (1.0 + phi.length()), "{phi}");
        }
    }

    #[test]
    fn exp_is_continuous_across_the_small_angle_switch() {
        let axis = DVec3::new(1.0, 2.0, -2.0) / 3.0;
        let th = SMALL_ANGLE2.sqrt();
        let (below, above) = (th * (1.0 - 1e-9), th * (1.0 + 1e-9));
        assert!((exp(axis * below) - exp(axis * above)).length() < 1e-12);
        assert!((right_jacobian_inverse(axis * below) - right_jacobian_inverse(axis * above))
            .to_cols_array()
            .iter()
            .all(|d| d.abs() < 1e-8));
    }

    #[test]
    fn right_jacobian_is_the_derivative_of_exp() {
        const H: f64 = 1e-6;
        for phi in SAMPLES {
            let j = right_jacobian(phi);
            for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
                let up = log(exp(phi).conjugate() * exp(phi + axis * H));
                let down = log(exp(phi).conjugate() * exp(phi - axis * H));
                let numeric = (up - down) / (2.0 * H);
                assert!((numeric - j * axis).length() < 1e-8, "{phi} {axis}");
            }
        }
    }

    #[test]
    fn right_jacobian_inverse_inverts() {
        for phi in SAMPLES {
            let e = right_jacobian(phi) * right_jacobian_inverse(phi) - DMat3::IDENTITY;
            assert!(e.to_cols_array().iter().all(|d| d.abs() < 1e-9), "{phi} {e}");
        }
    }

    #[test]
    fn hat_is_the_cross_product() {
        let (a, b) = (DVec3::new(1.0, -2.0, 0.5), DVec3::new(0.2, 0.7, -1.1));
        assert!((hat(a) * b - a.cross(b)).length() < 1e-15);
    }
}
