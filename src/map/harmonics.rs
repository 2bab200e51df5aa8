//! Colours that are more than one grey level: green and blue, and spherical harmonics of degree 1 to 3. Their
//! coefficients, Adam moments and kernels exist only where the shape asks for them; a grey map of degree 0 has none.
//!
//! Colour towards d: c + Σ c_k Y_k(d), unclamped, so that no gradient dies; c is between 0 and 1.

use super::buffers::{Buffers, Shape, ARRIVALS};
use super::view::{LearningRates, View};
use crate::gpu::kernels::{harmonics, harmonics_backward, harmonics_insert, harmonics_turn};
use crate::gpu::{Buf, Gpu, GpuError, Kernel, Recorder, Threads};
use crate::mem::Footprint;
use std::ops::Range;
use stipple_drivers::{Fault, Pose};

/// Learning rate of what depends on the direction, of that of the constant (Kerbl et al. 2023).
const RATE_PART: f32 = 1.0 / 20.0;

pub struct Harmonics {
    colours: Kernel<harmonics::K>,
    backward: Kernel<harmonics_backward::K>,
    /// The same, leaving the coefficients as they are.
    backward_still: Kernel<harmonics_backward::K>,
    insert: Kernel<harmonics_insert::K>,
    /// Where colours depend on the direction.
    turn: Option<Kernel<harmonics_turn::K>>,
    /// `Shape::colour_extra` of each slot, in the order of harmonics.glsl.
    pub coefficients: Buf<f32>,
    /// First and second of each coefficient.
    pub moments: Buf<[f32; 2]>,
    arrivals: Buf<[f32; 2]>,
    tints: Vec<[f32; 2]>,
    capacity: u32,
}

impl Harmonics {
    pub fn footprint(shape: &Shape) -> Footprint {
        let mut f = Footprint::default();
        let n = shape.splats as usize * shape.colour_extra();
        if n > 0 {
            f.gpu("splats: colour beyond the first level", n * size_of::<f32>());
            f.gpu("splats: Adam moments of that", n * size_of::<[f32; 2]>());
            f.gpu("splats: green and blue of arrivals", ARRIVALS * size_of::<[f32; 2]>());
            f.host("pipeline: green and blue of arrivals", ARRIVALS * size_of::<[f32; 2]>());
        }
        f
    }

    pub fn new(gpu: &mut Gpu, shape: &Shape, chunk: u32) -> Result<Harmonics, Fault> {
        let (channels, degree) = (shape.channels, shape.sh_degree);
        let n = shape.splats as usize * shape.colour_extra();
        Ok(Harmonics {
            colours: gpu.kernel(harmonics::Spec { channels, degree })?,
            backward: gpu.kernel(harmonics_backward::Spec { channels, degree, learn: true, chunk })?,
            backward_still: gpu.kernel(harmonics_backward::Spec { channels, degree, learn: false, chunk })?,
            insert: gpu.kernel(harmonics_insert::Spec { channels, degree })?,
            turn: (degree > 0).then(|| gpu.kernel(harmonics_turn::Spec { channels, degree })).transpose()?,
            coefficients: gpu.alloc("splats: colour beyond the first level", n)?,
            moments: gpu.alloc("splats: Adam moments of that", n)?,
            arrivals: gpu.alloc("splats: green and blue of arrivals", ARRIVALS)?,
            tints: Vec::with_capacity(ARRIVALS),
            capacity: shape.intersections,
        })
    }

    /// Before the raster: the colour of the visible as seen from `view`.
    pub(super) fn record_colours(&self, rec: &mut Recorder, b: &Buffers, view: &View, splats: u32) {
        let bind = harmonics::Bind {
            visible_count: b.visible_count.read(),
            slots: b.ranked.read(),
            splats: b.splats.read(),
            coefficients: self.coefficients.read(),
            projected_in_out: b.projected.read_write(),
            tints: b.tints.write(),
        };
        rec.dispatch(&self.colours, bind, harmonics::Push { eye: eye(view) }, Threads::d1(splats));
    }

    /// Between the raster's backward pass and the projection's; without rates nothing is trained.
    pub(super) fn record_update(
        &self,
        rec: &mut Recorder,
        b: &Buffers,
        view: &View,
        splats: u32,
        rates: Option<&LearningRates>,
    ) {
        let bind = harmonics_backward::Bind {
            visible_count: b.visible_count.read(),
            slots: b.ranked.read(),
            tile_offsets: b.tile_offsets.read(),
            splats: b.splats.read(),
            steps: b.steps.read(),
            isect_gradients: b.over.isect_gradients.cast().read_write(),
            coefficients: self.coefficients.read_write(),
            coefficient_moments: self.moments.read_write(),
        };
        let colour = rates.map_or(0.0, |r| r.colour);
        let push = harmonics_backward::Push {
            eye: eye(view),
            capacity: self.capacity,
            rate_colour: colour,
            rate_harmonics: RATE_PART * colour,
        };
        let kernel = if rates.is_some() { &self.backward } else { &self.backward_still };
        rec.dispatch(kernel, bind, push, Threads::d1(splats));
    }

    /// Of arrivals, ahead of `record_insert`.
    pub(super) fn take_tints(&mut self, gpu: &mut Gpu, tints: impl Iterator<Item = [f32; 2]>) -> Result<(), GpuError> {
        self.tints.clear();
        self.tints.extend(tints);
        gpu.upload(self.arrivals, 0, &self.tints)
    }

    /// Beside `insert` of the records.
    pub(super) fn record_insert(&self, rec: &mut Recorder, b: &Buffers, arrivals: u32) {
        let bind = harmonics_insert::Bind {
            arrival_tints: self.arrivals.read(),
            arrival_slots: b.arrival_slots.read(),
            coefficients: self.coefficients.write(),
            coefficient_moments: self.moments.write(),
        };
        rec.dispatch(&self.insert, bind, harmonics_insert::Push { arrivals }, Threads::d1(arrivals));
    }

    /// Beside `move_block`: colours turn with their Gaussians.
    pub(super) fn record_turn(&self, rec: &mut Recorder, by: &Pose, slots: Range<u32>) {
        let Some(turn) = &self.turn else { return };
        let bind = harmonics_turn::Bind {
            coefficients: self.coefficients.read_write(),
            coefficient_moments: self.moments.read_write(),
        };
        let push = harmonics_turn::Push {
            turn: by.q.as_quat().to_array(),
            first: slots.start,
            count: slots.end - slots.start,
        };
        rec.dispatch(turn, bind, push, Threads::d1(push.count));
    }
}

fn eye(view: &View) -> [f32; 4] {
    let p = view.world_from_cam.p.as_vec3();
    [p.x, p.y, p.z, 0.0]
}

/// Of a colour: how many channels, and to which degree it depends on the direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Form {
    pub channels: usize,
    pub degree: usize,
}

impl Form {
    /// Coefficients beyond the level in a Gaussian's record.
    pub fn extra(self) -> usize {
        self.channels * (self.degree + 1).pow(2) - 1
    }

    /// A Gaussian's constants, and what depends on the direction as files have it: all of red, of green, of blue.
    pub fn rgb(self, level: f32, extra: &[f32]) -> ([f32; 3], impl Iterator<Item = f32> + '_) {
        let last = self.channels - 1;
        let constant = std::array::from_fn(|c| if c.min(last) == 0 { level } else { extra[c - 1] });
        let of = move |c: usize| (0..self.degree * (self.degree + 2)).map(move |k| (k, c.min(last)));
        (constant, (0..3).flat_map(of).map(move |(k, c)| extra[last + k * self.channels + c]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_have_a_colour_channel_by_channel() {
        let extra: Vec<f32> = (1..12).map(|k| k as f32).collect();
        let (constant, rest) = Form { channels: 3, degree: 1 }.rgb(0.5, &extra);
        assert_eq!(constant, [0.5, 1.0, 2.0]);
        assert_eq!(rest.collect::<Vec<_>>(), [3.0, 6.0, 9.0, 4.0, 7.0, 10.0, 5.0, 8.0, 11.0]);
        let (constant, rest) = Form { channels: 1, degree: 1 }.rgb(0.5, &extra[..3]);
        assert_eq!(constant, [0.5; 3]);
        assert_eq!(rest.collect::<Vec<_>>(), [1.0, 2.0, 3.0, 1.0, 2.0, 3.0, 1.0, 2.0, 3.0]);
    }
}
