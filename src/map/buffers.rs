//! What the splat kernels keep in the arena, sized once by `Shape`.

use super::sort::{Pairs, Scan, Sorter};
use crate::gpu::kernels::types::{Moments, Projected, Splat, Status};
use crate::gpu::{Buf, Gpu, ALIGN};
use crate::mem::Footprint;
use stipple_drivers::Fault;

/// Capacities of the mapper, from the board's budget and the rectified camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Mapping resolution, px.
    pub width: u32,
    pub height: u32,
    pub splats: u32,
    /// (Gaussian, tile) pairs of one view.
    pub intersections: u32,
    /// Images kept to train on.
    pub keyframes: u32,
    /// Of a Gaussian's colour: 1, grey, or 3.
    pub channels: u32,
    /// Cameras that train, each with a mask.
    pub cameras: u32,
}

/// Pixels of a run filtered by one thread of the loss: RUN of ssim.glsl.
pub const RUN: u32 = 8;
/// Invocations of a workgroup of every kernel that reduces.
pub const GROUP: u32 = 64;
/// Bins of importance.comp.
pub const IMPORTANCE_BINS: usize = 256;
/// Side of the smallest tile, px: 8 lanes with columns of 8, or 32 with columns of 2.
const TILE_MIN: u32 = 8;

impl Shape {
    pub fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// Words of one stored 8-bit image; rows are padded to whole words.
    pub fn image_words(&self) -> usize {
        self.width.div_ceil(4) as usize * self.height as usize
    }

    /// Words from one camera's mask to the next: where a buffer may be bound.
    pub fn mask_stride(&self) -> usize {
        self.image_words().next_multiple_of(ALIGN as usize / size_of::<u32>())
    }

    /// Words the host moves at once: an image, or the flags of all slots.
    pub(super) fn words_max(&self) -> usize {
        self.image_words().max(self.splats as usize + 1)
    }

    /// Colour, transmittance, depth: planes of raster_forward.
    fn rendered_planes(&self) -> usize {
        self.channels as usize + 2
    }

    /// Words of an intersection's gradient: SLOT of raster_backward.
    fn slot_words(&self) -> usize {
        if self.channels == 3 {
            12
        } else {
            8
        }
    }

    /// Gaussians that have green and blue beside the level in their record.
    pub(super) fn coloured(&self) -> usize {
        if self.channels == 3 {
            self.splats as usize
        } else {
            0
        }
    }

    fn tiles_max(&self) -> usize {
        // Half as wide and twice as high is as much, but for a ragged edge.
        (self.width.div_ceil(TILE_MIN) + 1) as usize * self.height.div_ceil(TILE_MIN) as usize
    }
}

macro_rules! buffers {
    ($($field:ident: $of:ty, $name:literal, |$s:ident| $len:expr;)+) => {
        /// Every buffer, by what it holds.
        pub struct Buffers { $(pub $field: Buf<$of>),+, pub over: Overlay }

        impl Buffers {
            pub fn new(gpu: &mut Gpu, shape: &Shape) -> Result<Buffers, Fault> {
                let over = Overlay::new(gpu, shape)?;
                Ok(Buffers { $($field: { let $s = shape; gpu.alloc::<$of>($name, $len)? }),+, over })
            }

            pub fn footprint(shape: &Shape) -> Footprint {
                let mut f = Footprint::default();
                $(f.gpu($name, { let $s = shape; $len } * size_of::<$of>());)+
                f.gpu(OVERLAY, size_of::<u32>() * Overlay::words(shape));
                f.extend(Scan::footprint());
                f.extend(Sorter::footprint());
                f
            }
        }
    };
}

buffers! {
    splats: Splat, "splats: parameters", |s| s.splats as usize;
    moments: Moments, "splats: Adam moments", |s| s.splats as usize;
    steps: u32, "splats: Adam steps and importance", |s| s.splats as usize;
    projected: Projected, "splats: projected", |s| s.splats as usize;
    chroma: [f32; 2], "splats: green and blue", |s| s.coloured().max(1);
    chroma_moments: [f32; 4], "splats: Adam moments of green and blue", |s| s.coloured().max(1);
    ranked: u32, "splats: visible slots by depth", |s| s.splats as usize + 1;
    tile_offsets: u32, "splats: tiles touched, then their prefix sum", |s| s.splats as usize + 1;
    pose_sums: f32, "splats: pose gradient by workgroup", |s| 8 * (s.splats.div_ceil(GROUP) as usize);
    kept: u32, "splats: kept, then their prefix sum", |s| s.splats as usize + 1;
    importance_bins: u32, "splats: how many of which importance", |_s| IMPORTANCE_BINS;
    isects: u32, "intersections: by tile", |s| s.intersections as usize;
    owners: u32, "intersections: slots", |s| s.intersections as usize;
    ranges: [u32; 2], "tiles: ranges", |s| s.tiles_max() + 1;
    rendered: f32, "pixels: colour, transmittance, depth", |s| s.rendered_planes() * s.pixels();
    pixel_gradient: f32, "pixels: gradient", |s| s.channels as usize * s.pixels();
    ssim_sums: f32, "pixels: SSIM by workgroup", |s| s.channels as usize * image_groups(s.width, s.height) as usize;
    loss_sums: [f32; 4], "pixels: L1 and exposure gradient by workgroup", |s| s.channels as usize * image_groups(s.width, s.height) as usize;
    mask: u32, "keyframes: masks", |s| s.cameras as usize * s.mask_stride();
    targets: u32, "keyframes: images", |s| s.image_words() * (s.channels * s.keyframes) as usize;
    visible_count: u32, "counts: visible", |_s| 1;
    isect_count: u32, "counts: intersections listed, needed, workgroups", |_s| 5;
    isects_sorted: u32, "counts: intersections sorted", |_s| 1;
    failed: u32, "counts: not finite", |_s| 1;
    status: Status, "status", |_s| 1;
}

const OVERLAY: &str = "intersections: gradients, over keys and loss planes";

/// Bytes used in turn: to sort, then by the loss, then for the gradients of intersections. What a step needs after its
/// stage is not here.
pub struct Overlay {
    /// While sorting.
    pub depth_keys: Buf<u32>,
    pub isect_keys: Buf<u32>,
    spare: Pairs,
    /// In the loss: filtered moments (5 planes) and SSIM slopes (3).
    pub filtered: Buf<f32>,
    pub slopes: Buf<f32>,
    /// In the backward pass.
    pub isect_gradients: Buf<f32>,
}

/// Words of `n` and the gap to where the next buffer may start.
fn aligned(n: usize) -> usize {
    n.next_multiple_of(ALIGN as usize / size_of::<u32>())
}

impl Overlay {
    /// Keys of Gaussians and of intersections are not needed at the same time, so they are the same.
    fn keys(shape: &Shape) -> usize {
        (shape.splats as usize + 1).max(shape.intersections as usize)
    }

    fn words(shape: &Shape) -> usize {
        let planes = aligned(5 * shape.pixels()) + 3 * shape.pixels();
        let gradients = shape.slot_words() * shape.intersections as usize;
        planes.max(gradients).max(3 * aligned(Overlay::keys(shape)))
    }

    fn new(gpu: &mut Gpu, shape: &Shape) -> Result<Overlay, Fault> {
        let all = gpu.alloc::<u32>(OVERLAY, Overlay::words(shape))?;
        let (keys, pixels) = (Overlay::keys(shape), shape.pixels());
        let nth = |i: usize| all.part(i * aligned(keys), keys);
        Ok(Overlay {
            depth_keys: nth(0).part(0, shape.splats as usize + 1),
            isect_keys: nth(0).part(0, shape.intersections as usize),
            spare: Pairs { keys: nth(1), payload: nth(2) },
            filtered: all.part(0, 5 * pixels).cast(),
            slopes: all.part(aligned(5 * pixels), 3 * pixels).cast(),
            isect_gradients: all.part(0, shape.slot_words() * shape.intersections as usize).cast(),
        })
    }

    /// What to sort `keys` from and to, so that after `passes` the payload is in `into`.
    pub fn pairs(&self, keys: Buf<u32>, into: Buf<u32>, passes: u32) -> (Pairs, Pairs) {
        let (from, to) = match passes % 2 {
            0 => (into, self.spare.payload),
            _ => (self.spare.payload, into),
        };
        (Pairs { keys, payload: from }, Pairs { keys: self.spare.keys, payload: to })
    }
}

/// Workgroups of the column passes of the loss.
pub fn image_groups(width: u32, height: u32) -> u32 {
    (width * height.div_ceil(RUN)).div_ceil(GROUP)
}
