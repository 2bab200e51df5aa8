//! Weighted least squares along the picture's edges: the fast global smoother (Min et al., TIP 2014) on weighted
//! disparities and on the weights, whose quotient is the disparity. Three passes of rows and columns with falling strength
//! stand for the solve in two dimensions.

use super::Buffers;
use crate::gpu::kernels::{fill_rows, median, settle, smooth_lines};
use crate::gpu::{Gpu, Kernel, Recorder, Threads};
use stipple_drivers::Fault;

pub struct Wls {
    fill_rows: Kernel<fill_rows::K>,
    median: Kernel<median::K>,
    smooth_lines: Kernel<smooth_lines::K>,
    settle: Kernel<settle::K>,
}

/// Parts of the variance of what `settle` answers, px².
#[derive(Clone, Copy, Debug)]
pub struct Variance {
    pub least: f32,
    /// By the squared distance of the window from a plane, and by the same over the disparity.
    pub bent: f32,
    pub bent_far: f32,
    /// By what the picture does not show, and by what of the window was not matched.
    pub faint: f32,
    pub missing: f32,
}

impl Variance {
    /// Factors of greatest likelihood on simulated flights, with the filter and without. Errors of other flights have 0.90 to
    /// 1.20 of it without the filter and 0.97 to 1.31 with, by range of depth. Factors fitted to more flights did worse: 0.69 to
    /// 1.40, and more of what is filled in would pass `SIGMA_MAX_PX`.
    pub const FITTED: Variance = Variance { least: 0.0004, bent: 5.4, bent_far: 9.1, faint: 0.217, missing: 0.137 };
}

impl Wls {
    /// Strength, and the difference of grey levels at which a link is 1/e. More of either moves what was matched right:
    /// 200 and 1000 leave 0.3 and 0.5 % more of teddy bad by 1 px.
    pub const LAMBDA: f32 = 20.0;
    pub const SIGMA: f32 = 1.0;
    /// Passes of rows and columns, each with a quarter of the strength before.
    pub const PASSES: i32 = 3;
    /// Weight of what is filled in, against what is matched: between disparities that are alike, and of what is hidden.
    pub const FILL: f32 = 0.3;
    pub const HIDDEN: f32 = 0.1;
    pub const ALIKE_PX: f32 = 2.0;
    /// How far from what is matched, px.
    pub const FILL_REACH: f32 = 64.0;
    /// Less weight than this is no disparity. Far from all matches the weight is small and the variance large.
    pub const WEIGHT_MIN: f32 = 1e-30;
    /// No depth beyond: what is filled in over a hidden strip has 0.8, what is further from all matches more.
    pub const SIGMA_MAX_PX: f32 = 1.25;

    pub fn new(gpu: &mut Gpu) -> Result<Wls, Fault> {
        Ok(Wls {
            fill_rows: gpu.kernel_in_pieces(fill_rows::Spec::default())?,
            median: gpu.kernel_in_pieces(median::Spec::default())?,
            smooth_lines: gpu.kernel_in_pieces(smooth_lines::Spec::default())?,
            settle: gpu.kernel_in_pieces(settle::Spec::default())?,
        })
    }

    /// The strength of pass `pass` (eq. 10 of the paper with a factor of 1/4).
    pub fn lambda(pass: i32) -> f32 {
        Wls::LAMBDA * 1.5 * 4f32.powi(Wls::PASSES - 1 - pass) / (4f32.powi(Wls::PASSES) - 1.0)
    }

    pub fn record(&self, rec: &mut Recorder, b: &Buffers, size: [u32; 2], smooth: bool) {
        let [width, height] = size;
        let [weight, hidden] = if smooth { [Wls::FILL, Wls::HIDDEN] } else { [0.0; 2] };
        rec.dispatch(
            &self.fill_rows,
            fill_rows::Bind { disparity: b.disparity.read(), data: b.data.read_write() },
            fill_rows::Push { size, weight, hidden, alike: Wls::ALIKE_PX, reach: Wls::FILL_REACH },
            Threads::d1(height),
        );
        rec.dispatch(
            &self.median,
            median::Bind { data: b.data.read(), medians: b.medians.write() },
            median::Push { size },
            Threads::d1(width * height),
        );
        for pass in 0..if smooth { Wls::PASSES } else { 0 } {
            for columns in [0, 1] {
                rec.dispatch(
                    &self.smooth_lines,
                    smooth_lines::Bind {
                        images: b.images.read(),
                        data: b.medians.read_write(),
                        ratios: b.ratios.read_write(),
                    },
                    smooth_lines::Push { size, columns, lambda: Wls::lambda(pass), inverse_sigma: 1.0 / Wls::SIGMA },
                    Threads::d1(size[1 - columns as usize]),
                );
            }
        }
        let Variance { least, bent, bent_far, faint, missing } = Variance::FITTED;
        rec.dispatch(
            &self.settle,
            settle::Bind {
                images: b.images.read(),
                data: b.medians.read(),
                disparity: b.disparity.write(),
                deviation: b.deviation.write(),
            },
            settle::Push { size, weight_min: Wls::WEIGHT_MIN, fill: Wls::FILL, least, bent, bent_far, faint, missing },
            Threads::d1(width * height),
        );
    }
}
