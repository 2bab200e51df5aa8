//! How far a training step of the kernels is from its twin, stage by stage.

use super::project::Parameters;
use stipple::gpu::{Gpu, GpuError};
use stipple::map::{Gaussian, LearningRates, Pipeline, Rendered, View, Weights};

/// A step that moves nothing.
pub const STILL: LearningRates = LearningRates { position: 0.0, scale: 0.0, rotation: 0.0, opacity: 0.0, colour: 0.0 };
/// Weight of SSIM in the step that is compared.
pub const SSIM: f32 = 0.2;
/// The loss is of order one: a billionth of it is nothing, and what rounding leaves of zero.
const NOTHING: f64 = 1e-9;

/// Parameters of a Gaussian by group.
pub const GROUPS: [(&str, std::ops::Range<usize>); 5] =
    [("mean", 0..3), ("log scale", 3..6), ("quaternion", 6..10), ("opacity", 10..11), ("grey", 11..12)];

/// The largest differences between kernels and twin.
#[derive(Clone, Copy, Debug, Default)]
pub struct Errors {
    /// Error of centre, conic, opacity, grey and depth on the image, over one more than their size.
    pub projected: f64,
    /// Error of a pixel's grey and alpha, of 1.
    pub picture: f64,
    /// Error of a pixel's depth, m.
    pub depth: f64,
    pub l1: f64,
    pub ssim: f64,
    /// Error of the loss's gradient by a pixel, over the largest of the picture.
    pub pixel: f64,
    /// Errors of the gradients by `GROUPS`, over the largest of the scene.
    pub groups: [f64; 5],
    /// Error of the gradient by the pose, over its largest component.
    pub pose: f64,
    /// Extra error allowed for a pixel, of 1, where a Gaussian's alpha is within rounding of the least that is drawn.
    pub flip: f64,
}

/// Error of a gradient that is never allowed, over the largest of its kind, but for `flip`.
const GRADIENT_MAX: f64 = 0.1;

impl Errors {
    /// The first that is over the bound to which kernels are held; `wider` times as much is allowed for rounding.
    pub fn complaint(&self, wider: f64) -> Option<String> {
        let gradient = |rounding: f64| (wider * rounding).min(GRADIENT_MAX) + 50.0 * self.flip;
        let mut all = vec![
            ("projected", self.projected, wider * 2e-5),
            ("picture", self.picture, wider * 1e-5 + self.flip),
            ("depth", self.depth, wider * 1e-3 + 4.0 * self.flip),
            ("L1", self.l1, wider * 1e-5 + self.flip),
            ("SSIM", self.ssim, wider * 1e-4 + self.flip),
            ("pixel gradient", self.pixel, gradient(2e-3)),
            ("pose gradient", self.pose, gradient(1e-3)),
        ];
        all.extend(GROUPS.iter().zip(self.groups).map(|((name, _), error)| (*name, error, gradient(1e-3))));
        // What is not a number is over every bound.
        let over = all.into_iter().find(|(_, error, bound)| !(error <= bound));
        over.map(|(what, error, bound)| format!("{what} is {error:.2e} off its twin, {bound:.2e} is allowed"))
    }
}

/// Whether every parameter of a Gaussian is finite.
pub fn finite(s: &Gaussian) -> bool {
    bytemuck::cast_slice::<_, f32>(std::slice::from_ref(s)).iter().all(|v| v.is_finite())
}

fn largest(values: impl IntoIterator<Item = f64>) -> f64 {
    // NaN stays, as `f64::max` would drop it.
    values.into_iter().fold(0.0, |m: f64, v: f64| if m.is_nan() || v.abs() <= m { m } else { v.abs() })
}

fn worst<'a>(got: &[f32], want: impl IntoIterator<Item = &'a f64>) -> f64 {
    largest(got.iter().zip(want).map(|(a, b)| f64::from(*a) - b))
}

/// Draws `splats`, which are all that the pipeline's pool holds, and takes a step that moves nothing towards `goal` in image 1 under
/// `mask`; compares both with the twin.
pub fn compare(
    gpu: &mut Gpu,
    p: &mut Pipeline,
    v: &View,
    splats: &[Gaussian],
    [goal, mask]: [&[u8]; 2],
) -> Result<Errors, GpuError> {
    p.loss.set_image(gpu, 1, goal)?;
    p.loss.set_mask(gpu, 0, mask)?;
    let doubles: Vec<Parameters> = splats.iter().map(super::project::parameters).collect();
    let wanted: Vec<f64> = goal.iter().map(|g| f64::from(*g) / 255.0).collect();
    let twin = super::step(&vec![0.0; goal.len()], &doubles, v, &[0.0; 6], &wanted, mask, f64::from(SSIM));

    let mut picture = Rendered::default();
    p.render(gpu, v, &mut picture)?;
    let mut projected = vec![Default::default(); splats.len()];
    gpu.download(p.renderer.projected, 0, &mut projected)?;
    let mut error: f64 = 0.0;
    for (t, got) in super::project_all(&doubles, v, &[0.0; 6]).iter().zip(&projected) {
        // Those off the image are culled by the kernel and keep zeros.
        let (Some(t), true) = (t, got.conic_shade[3] != 0.0) else { continue };
        let (a, b) = (got.centre_conic, got.conic_shade);
        let got = [a[0] - 0.5, a[1] - 0.5, a[2], a[3], b[0], b[1], b[2], b[3]];
        error = largest(got.iter().zip(t).map(|(g, t)| (f64::from(*g) - t.v) / (1.0 + t.v.abs())).chain([error]));
    }
    let alpha: Vec<f64> = twin.rendered.transmittance.iter().map(|t| 1.0 - t).collect();
    let grey = worst(&picture.colour, &twin.rendered.planes.colour[0]);

    let weights = Weights { ssim: SSIM, needle: 0.0, scale: 0.0, scale_soft_m: 1.0, opacity: 0.0 };
    let step = p.train(gpu, v, 1, Some(&STILL), &weights)?;
    let mut gradient = vec![0f32; goal.len()];
    gpu.download(p.loss.buffers.pixel_gradient, 0, &mut gradient)?;
    // R <- R Exp(θ) moves points by Exp(-θ), p <- p + δ by -Rᵀδ.
    let (rho, phi) = (glam::DVec3::from_slice(&twin.twist[..3]), glam::DVec3::from_slice(&twin.twist[3..]));
    let dp = -(v.world_from_cam.q * rho);
    let pose = [dp.x, dp.y, dp.z, -phi.x, -phi.y, -phi.z];
    Ok(Errors {
        projected: error,
        picture: largest([grey, worst(&picture.alpha, &alpha)]),
        depth: worst(&picture.depth, &twin.rendered.depth),
        l1: (step.l1 - twin.loss.l1).abs(),
        ssim: (step.ssim - twin.loss.ssim).abs(),
        pixel: worst(&gradient, &twin.loss.gradient) / largest(twin.loss.gradient.iter().copied()),
        groups: by_group(gpu, p, &twin.splats)?,
        pose: largest(step.pose_gradient.iter().zip(pose).map(|(a, b)| a - b)) / largest(pose),
        flip: if twin.rendered.margin > 1e-5 { 0.0 } else { 1.0 / 255.0 },
    })
}

/// Errors of the gradients of the first step from rest: Adam's first moment is a tenth of the gradient after it.
pub fn by_group(gpu: &mut Gpu, p: &Pipeline, twins: &[[f64; 12]]) -> Result<[f64; 5], GpuError> {
    let mut moments = vec![stipple::gpu::kernels::types::Moments::default(); twins.len()];
    gpu.download(p.pool.buffers.moments, 0, &mut moments)?;
    Ok(GROUPS.map(|(_, range)| {
        let scale = largest(twins.iter().flat_map(|g| g[range.clone()].iter().copied()));
        let errors = moments.iter().zip(twins).flat_map(|(m, twin)| {
            let [a, b, q] = m.m;
            let got = [a[0], a[1], a[2], b[0], b[1], b[2], q[0], q[1], q[2], q[3], a[3], b[3]];
            range.clone().map(move |k| (f64::from(got[k]) * 10.0 - twin[k]).abs())
        });
        match largest(errors) {
            error if error <= NOTHING => 0.0,
            error => (error - NOTHING) / scale,
        }
    }))
}

#[test]
fn largest_keeps_what_is_not_a_number() {
    assert_eq!(largest([1.0, -5.0, 0.1]), 5.0);
    assert!(largest([5.0, f64::NAN, 0.1]).is_nan());
}
