//! Camera models.
//!
//! Pinhole with radial-tangential distortion (Brown; OpenCV's order k1 k2 p1 p2), the same with a rational radial part
//! (OpenCV's eight coefficients), Kannala-Brandt (KB4, "equidistant"), and double sphere (Usenko et al., 3DV 2018). `project`
//! takes a point in the camera frame (x right, y down, z forward, metres) to pixels (integer = pixel centre); `unproject`
//! gives the unit bearing. Both answer `None` outside the model's domain, so a returned value is always finite and
//! invertible. The domain of radtan and rational lenses ends where the radius stops growing, else points far off the axis
//! would fold back into the image.

// `!(a > b)` and not `a <= b`: it also refuses NaN.
#![allow(clippy::neg_cmp_op_on_partial_ord)]

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};
use std::f64::consts::PI;

/// A distortion model with its coefficients.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Lens {
    /// Radial factor 1 + k1 u + k2 u², u = r².
    Radtan { k1: f64, k2: f64, p1: f64, p2: f64 },
    /// Radial factor (1 + k1 u + k2 u² + k3 u³) / (1 + k4 u + k5 u² + k6 u³), u = r²; see `Lens::rational`.
    Rational { k: [f64; 6], p1: f64, p2: f64, r2_max: f64 },
    /// Image radius θ + k1 θ³ + k2 θ⁵ + k3 θ⁷ + k4 θ⁹ of the angle θ off the axis.
    KannalaBrandt { k: [f64; 4] },
    /// Displacement `xi` of the spheres, and `alpha`, which shifts the projection.
    DoubleSphere { xi: f64, alpha: f64 },
}

/// A camera: size, focal lengths and principal point in pixels, and its lens.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Columns, pixels.
    pub width: usize,
    /// Rows, pixels.
    pub height: usize,
    /// Focal length along x, px.
    pub fx: f64,
    /// Focal length along y, px.
    pub fy: f64,
    /// Column of the principal point, px.
    pub cx: f64,
    /// Row of the principal point, px.
    pub cy: f64,
    /// Distortion.
    pub lens: Lens,
}

/// Rows of d(px)/d(point), px/m.
pub type ProjectionJacobian = [[f64; 3]; 2];

const Z_MIN: f64 = 1e-6;
/// Squared radius 89.4 degrees off the axis, the end of a pinhole's domain.
const R2_UNBOUNDED: f64 = 1e4;

impl Lens {
    /// No distortion.
    pub const NONE: Lens = Lens::Radtan { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0 };

    /// A rational lens. Its domain ends where the calibration says (`r_max` of x/z, y/z; 0: it does not say), but not beyond
    /// the place where the radius stops growing, which is found in steps of 0.1 %.
    pub fn rational(k: [f64; 6], p1: f64, p2: f64, r_max: f64) -> Lens {
        let end = if r_max > 0.0 { r_max.min(R2_UNBOUNDED.sqrt()) } else { R2_UNBOUNDED.sqrt() };
        let mut r = 1e-3;
        while r < end {
            let (radial, derivative) = rational_radial(r * r, &k);
            if !(radial > 0.0 && radial + 2.0 * r * r * derivative > 0.0) {
                break;
            }
            r *= 1.001;
        }
        let r = r.min(end) / 1.001;
        Lens::Rational { k, p1, p2, r2_max: r * r }
    }
}

impl Camera {
    /// Whether a pixel is in the image, at least `margin` pixels from its border.
    pub fn contains(&self, px: DVec2, margin: f64) -> bool {
        px.x >= margin
            && px.y >= margin
            && px.x <= self.width as f64 - 1.0 - margin
            && px.y <= self.height as f64 - 1.0 - margin
    }

    /// The pixel of a point in the camera frame, m. `None` where the model is not defined.
    pub fn project(&self, p_cam: DVec3) -> Option<DVec2> {
        self.project_with_jacobian(p_cam).map(|(px, _)| px)
    }

    /// The pixel of a point, and d(px)/d(p_cam).
    pub fn project_with_jacobian(&self, p: DVec3) -> Option<(DVec2, ProjectionJacobian)> {
        let (m, dm) = match self.lens {
            Lens::Radtan { k1, k2, p1, p2 } => {
                let inside = |u| u < R2_UNBOUNDED && (radtan_grows(u, k1, k2) || u < radtan_r2_max(k1, k2));
                brown(p, inside, |u| (1.0 + u * (k1 + u * k2), k1 + 2.0 * k2 * u), p1, p2)?
            }
            Lens::Rational { k, p1, p2, r2_max } => brown(p, |u| u < r2_max, |u| rational_radial(u, &k), p1, p2)?,
            Lens::KannalaBrandt { k } => kannala_brandt(p, &k)?,
            Lens::DoubleSphere { xi, alpha } => double_sphere(p, xi, alpha)?,
        };
        let px = DVec2::new(self.fx * m.x + self.cx, self.fy * m.y + self.cy);
        let j = [dm[0].map(|d| d * self.fx), dm[1].map(|d| d * self.fy)];
        px.is_finite().then_some((px, j))
    }

    /// The unit bearing of a pixel in the camera frame. `None` where the model is not defined.
    pub fn unproject(&self, px: DVec2) -> Option<DVec3> {
        let m = DVec2::new((px.x - self.cx) / self.fx, (px.y - self.cy) / self.fy);
        let b = match self.lens {
            Lens::Radtan { k1, k2, p1, p2 } => {
                let r2_max = radtan_r2_max(k1, k2);
                brown_inverse(m, r2_max, |u| (1.0 + u * (k1 + u * k2), k1 + 2.0 * k2 * u), p1, p2)?
            }
            Lens::Rational { k, p1, p2, r2_max } => brown_inverse(m, r2_max, |u| rational_radial(u, &k), p1, p2)?,
            Lens::KannalaBrandt { k } => kannala_brandt_inverse(m, &k)?,
            Lens::DoubleSphere { xi, alpha } => double_sphere_inverse(m, xi, alpha)?,
        };
        b.is_finite().then(|| b.normalize())
    }
}

/// A point of the normalised image plane, and its derivative to the point in the camera frame.
type Normalised = (DVec2, [[f64; 3]; 2]);

/// Whether r(1 + k1 r² + k2 r⁴) certainly grows up to r² = u: where the Bernstein coefficients of its derivative are positive,
/// which for most points of a lens tells without a root.
fn radtan_grows(u: f64, k1: f64, k2: f64) -> bool {
    let k1u = k1 * u;
    1.0 + 1.5 * k1u > 0.0 && 1.0 + 3.0 * k1u + 5.0 * k2 * u * u > 0.0
}

/// Squared radius (of x/z, y/z) at which r(1 + k1 r² + k2 r⁴) stops growing.
fn radtan_r2_max(k1: f64, k2: f64) -> f64 {
    // d/dr = 1 + 3 k1 u + 5 k2 u², u = r²; its smallest positive root, in the form that allows k2 = 0.
    let root = (9.0 * k1 * k1 - 20.0 * k2).sqrt();
    [2.0 / (-3.0 * k1 + root), 2.0 / (-3.0 * k1 - root)].into_iter().filter(|u| *u > 0.0).fold(R2_UNBOUNDED, f64::min)
}

/// The factor of the radius at u = r², and its derivative to u.
fn rational_radial(u: f64, k: &[f64; 6]) -> (f64, f64) {
    let n = 1.0 + u * (k[0] + u * (k[1] + u * k[2]));
    let d = 1.0 + u * (k[3] + u * (k[4] + u * k[5]));
    let dn = k[0] + u * (2.0 * k[1] + u * 3.0 * k[2]);
    let dd = k[3] + u * (2.0 * k[4] + u * 3.0 * k[5]);
    (n / d, (dn * d - n * dd) / (d * d))
}

/// Brown's distortion; `radial` gives the factor of the radius at u = r² and its derivative to u.
#[inline(always)]
fn brown_distort(a: DVec2, radial: impl Fn(f64) -> (f64, f64), p1: f64, p2: f64) -> (DVec2, [[f64; 2]; 2]) {
    let (x, y) = (a.x, a.y);
    let u = x * x + y * y;
    let (radial, d_radial) = radial(u);
    let m = DVec2::new(
        x * radial + 2.0 * p1 * x * y + p2 * (u + 2.0 * x * x),
        y * radial + p1 * (u + 2.0 * y * y) + 2.0 * p2 * x * y,
    );
    let xy = 2.0 * x * y * d_radial + 2.0 * p1 * x + 2.0 * p2 * y;
    let j = [
        [radial + 2.0 * x * x * d_radial + 2.0 * p1 * y + 6.0 * p2 * x, xy],
        [xy, radial + 2.0 * y * y * d_radial + 6.0 * p1 * y + 2.0 * p2 * x],
    ];
    (m, j)
}

#[inline(always)]
fn brown(
    p: DVec3,
    inside: impl Fn(f64) -> bool,
    radial: impl Fn(f64) -> (f64, f64),
    p1: f64,
    p2: f64,
) -> Option<Normalised> {
    if !(p.z > Z_MIN) {
        return None;
    }
    let iz = 1.0 / p.z;
    let a = DVec2::new(p.x * iz, p.y * iz);
    if !inside(a.length_squared()) {
        return None;
    }
    let (m, d) = brown_distort(a, radial, p1, p2);
    if !(d[0][0] * d[1][1] > d[0][1] * d[1][0]) {
        // Folded here by the tangential part.
        return None;
    }
    let row = |r: [f64; 2]| [r[0] * iz, r[1] * iz, -(r[0] * a.x + r[1] * a.y) * iz];
    Some((m, [row(d[0]), row(d[1])]))
}

/// The place where a function that grows on low..high (given with its derivative) reaches `target`: Newton's method, halving
/// the bracket where a step leaves it, until a step is under `settled`. Where the derivative is not positive counts as beyond.
fn growing_root(target: f64, mut low: f64, mut high: f64, settled: f64, f: impl Fn(f64) -> (f64, f64)) -> f64 {
    let mut x = target.clamp(low, high);
    for _ in 0..60 {
        let (value, derivative) = f(x);
        let grows = derivative > 0.0;
        if grows && value <= target {
            low = x;
        } else {
            high = x;
        }
        let newton = x - (value - target) / derivative;
        let next = if grows && newton >= low && newton <= high { newton } else { 0.5 * (low + high) };
        let step = next - x;
        x = next;
        if step.abs() < settled {
            break;
        }
    }
    x
}

fn brown_inverse(m: DVec2, r2_max: f64, radial: impl Fn(f64) -> (f64, f64), p1: f64, p2: f64) -> Option<DVec3> {
    // The radial part in one dimension, then Newton in two for the tangential part.
    let radius = |r: f64| {
        let (factor, derivative) = radial(r * r);
        (r * factor, factor + 2.0 * r * r * derivative)
    };
    let distorted = m.length();
    if !(distorted > 1e-12) {
        return (distorted >= 0.0).then_some(DVec3::Z);
    }
    let mut a = m * (growing_root(distorted, 0.0, 0.999 * r2_max.sqrt(), 1e-3, radius) / distorted);
    for _ in 0..30 {
        let (f, j) = brown_distort(a, &radial, p1, p2);
        let e = f - m;
        let det = j[0][0] * j[1][1] - j[0][1] * j[1][0];
        if det.abs() < 1e-9 {
            return None;
        }
        let step = DVec2::new(j[1][1] * e.x - j[0][1] * e.y, j[0][0] * e.y - j[1][0] * e.x) / det;
        a -= step;
        if a.length_squared() >= r2_max {
            a *= 0.99 * (r2_max / a.length_squared()).sqrt();
        }
        if step.length_squared() < 1e-24 {
            break;
        }
    }
    let (f, _) = brown_distort(a, &radial, p1, p2);
    ((f - m).length_squared() < 1e-16).then(|| a.extend(1.0))
}

fn kannala_brandt(p: DVec3, k: &[f64; 4]) -> Option<Normalised> {
    let u = p.x * p.x + p.y * p.y;
    let r = u.sqrt();
    let rho2 = u + p.z * p.z;
    if !(rho2 > Z_MIN * Z_MIN) || !rho2.is_finite() {
        return None;
    }
    if r < 1e-8 * p.z.abs() {
        if p.z <= 0.0 {
            return None;
        }
        let iz = 1.0 / p.z;
        let m = DVec2::new(p.x * iz, p.y * iz);
        return Some((m, [[iz, 0.0, -m.x * iz], [0.0, iz, -m.y * iz]]));
    }
    let th = r.atan2(p.z);
    if !kb_grows(th, k) {
        return None;
    }
    let (d, b) = kb_polynomial(th, k);
    let a = d / r;
    let h = b / rho2;
    let g = (p.z * h - a) / u;
    let m = DVec2::new(a * p.x, a * p.y);
    let j = [[a + p.x * p.x * g, p.x * p.y * g, -p.x * h], [p.x * p.y * g, a + p.y * p.y * g, -p.y * h]];
    Some((m, j))
}

/// The image radius d of an angle θ, and its derivative.
fn kb_polynomial(th: f64, k: &[f64; 4]) -> (f64, f64) {
    let t2 = th * th;
    let d = th * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))));
    let b = 1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])));
    (d, b)
}

/// Whether the image radius d grows all the way from the axis to `th`; past a maximum it may grow again, which is no longer
/// the same lens. d' as a polynomial in θ² lies above the least of its Bernstein coefficients on [0, th²].
fn kb_grows(th: f64, k: &[f64; 4]) -> bool {
    let u = th * th;
    let (a1, a2, a3, a4) = (3.0 * k[0] * u, 5.0 * k[1] * u * u, 7.0 * k[2] * u.powi(3), 9.0 * k[3] * u.powi(4));
    let b3 = 1.0 + 0.75 * a1 + 0.5 * a2 + 0.25 * a3;
    bernstein_positive([1.0, 1.0 + 0.25 * a1, 1.0 + 0.5 * a1 + a2 / 6.0, b3, 1.0 + a1 + a2 + a3 + a4], 10)
}

/// Whether a polynomial, given by its Bernstein coefficients, is positive; one that comes so near to zero that `splits`
/// halvings do not tell counts as not positive.
fn bernstein_positive(b: [f64; 5], splits: u32) -> bool {
    if b.iter().all(|c| *c > 0.0) {
        return true;
    }
    if !(b[0] > 0.0 && b[4] > 0.0) || splits == 0 {
        return false;
    }
    // De Casteljau's algorithm at one half.
    let (mut left, mut right) = (b, b);
    for level in 1..5 {
        for i in 0..5 - level {
            right[i] = 0.5 * (right[i] + right[i + 1]);
        }
        left[level] = right[0];
    }
    bernstein_positive(left, splits - 1) && bernstein_positive(right, splits - 1)
}

fn kannala_brandt_inverse(m: DVec2, k: &[f64; 4]) -> Option<DVec3> {
    const STEP: f64 = 0.1; // rad
    let r = m.length();
    if r < 1e-12 {
        return Some(DVec3::Z);
    }
    // Bracket on the first growing stretch, then Newton, which alone may end beyond the maximum.
    let (mut low, mut high) = (0.0, STEP);
    loop {
        let (d, b) = kb_polynomial(high, k);
        if !(b > 0.0) || d >= r {
            break;
        }
        if high >= PI {
            return None;
        }
        (low, high) = (high, (high + STEP).min(PI));
    }
    let th = growing_root(r, low, high, 1e-15, |th| kb_polynomial(th, k));
    let (d, _) = kb_polynomial(th, k);
    ((d - r).abs() < 1e-9 && kb_grows(th, k)).then(|| (m / r * th.sin()).extend(th.cos()))
}

fn double_sphere(p: DVec3, xi: f64, alpha: f64) -> Option<Normalised> {
    let u = p.x * p.x + p.y * p.y;
    let d1 = (u + p.z * p.z).sqrt();
    if !(d1 > Z_MIN) {
        return None;
    }
    let z1 = xi * d1 + p.z;
    let d2 = (u + z1 * z1).sqrt();
    // The radius grows with the angle about the second sphere's centre until its cosine is -w; the
    // bound on p.z printed in the paper lies beyond that for xi < 0 and lets points fold back.
    let w = if alpha > 0.5 { (1.0 - alpha) / alpha } else { alpha / (1.0 - alpha) };
    if !(z1 > -w * d2) {
        return None;
    }
    let n = alpha * d2 + (1.0 - alpha) * z1;
    let inv = 1.0 / n;
    let m = DVec2::new(p.x * inv, p.y * inv);
    // dn/d(x, y, z).
    let dz1 = DVec3::new(xi * p.x / d1, xi * p.y / d1, xi * p.z / d1 + 1.0);
    let dd2 = DVec3::new(p.x + z1 * dz1.x, p.y + z1 * dz1.y, z1 * dz1.z) / d2;
    let dn = alpha * dd2 + (1.0 - alpha) * dz1;
    let j = [
        [inv - m.x * dn.x * inv, -m.x * dn.y * inv, -m.x * dn.z * inv],
        [-m.y * dn.x * inv, inv - m.y * dn.y * inv, -m.y * dn.z * inv],
    ];
    Some((m, j))
}

fn double_sphere_inverse(m: DVec2, xi: f64, alpha: f64) -> Option<DVec3> {
    let r2 = m.length_squared();
    let disc = 1.0 - (2.0 * alpha - 1.0) * r2;
    if disc < 0.0 {
        return None;
    }
    let mz = (1.0 - alpha * alpha * r2) / (alpha * disc.sqrt() + 1.0 - alpha);
    let s = mz * mz + (1.0 - xi * xi) * r2;
    if s < 0.0 {
        return None;
    }
    let f = (mz * xi + s.sqrt()) / (mz * mz + r2);
    Some(DVec3::new(f * m.x, f * m.y, f * mz - xi))
}
