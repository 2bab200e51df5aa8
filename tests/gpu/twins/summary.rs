//! Twin of summary.comp.

/// Twin of summary.comp: sums of SSIM; of |x - y| and the exposure's gradient; of the pose terms and what was refused.
pub fn summary(ssim: &[f32], loss: &[[f32; 4]], pose: &[[f32; 8]]) -> (f64, [f64; 3], [f64; 7]) {
    let of = |k: usize| loss.iter().map(|l| f64::from(l[k])).sum();
    let terms = std::array::from_fn(|k| pose.iter().map(|p| f64::from(p[k])).sum());
    (ssim.iter().map(|s| f64::from(*s)).sum(), [of(0), of(1), of(2)], terms)
}
