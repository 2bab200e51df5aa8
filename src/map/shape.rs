//! How large the buffers of the splat kernels are, and the bytes that the stages of a step use in turn.

use crate::gpu::{Arena, Buf, ALIGN};
use crate::limits::CAMERAS_MAX;
use stipple_drivers::{Fault, FaultKind};

/// Capacities of the map, from the board's budget and the training cameras.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Mapping resolution, px.
    pub width: u32,
    pub height: u32,
    pub splats: u32,
    /// (Gaussian, tile) pairs of one view.
    pub intersections: u32,
    /// Images kept to train on.
    pub images: u32,
    /// Channels of a colour: 1, grey, or 3.
    pub channels: u32,
    /// Cameras that train, each with a mask.
    pub cameras: u32,
    /// Whether views may be of a fisheye, beside pinholes.
    pub fisheye: bool,
    /// Whether steps may draw and compare views at half the size, too.
    pub half_size: bool,
}

/// Pixels of a run filtered by one thread of the loss on a CPU: RUN of ssim.glsl.
pub const RUN: u32 = 8;
/// Planes that are filtered for SSIM: MOMENTS of ssim.glsl.
const MOMENTS: usize = 4;
/// A tile that one workgroup of the loss filters on a GPU, px: WIDTH and HEIGHT of ssim_tile.glsl.
pub const LOSS_TILE: [u32; 2] = [54, 8];
/// Invocations of a workgroup of the kernels that sum runs of pixels, or Gaussians.
pub const GROUP: u32 = 64;
/// What fits into an element of a list: tile_depth.glsl.
const TILES_MAX: usize = (1 << 16) - 1;
const SLOTS_MAX: u32 = 1 << 22;
const INTERSECTIONS_MAX: u32 = 1 << 26;
/// Side of the smallest tile, px: 8 lanes with columns of 8, or 32 with columns of 2.
const TILE_MIN: u32 = 8;

impl Shape {
    pub fn check(&self) -> Result<(), Fault> {
        let fault = |what, fix| Err(Fault::new(FaultKind::Config, "map", what, fix));
        let sizes = [self.width, self.height, self.splats, self.intersections, self.images];
        if sizes.contains(&0) || ![1, 3].contains(&self.channels) || !(1..=CAMERAS_MAX as u32).contains(&self.cameras) {
            let what = format!("{self:?} has a zero, neither 1 nor 3 channels, or no or too many cameras");
            return fault(what, "raise the board's [budget]");
        }
        if self.tiles_max() > TILES_MAX {
            let what = format!("images of {} x {} px are more than {TILES_MAX} tiles", self.width, self.height);
            return fault(what, "raise map.scale, or lower budget.image_width_max and image_height_max");
        }
        if self.splats > SLOTS_MAX || self.intersections > INTERSECTIONS_MAX {
            let what = format!("{} Gaussians or {} intersections are too many", self.splats, self.intersections);
            return fault(what, "lower budget.splats or budget.intersections");
        }
        Ok(())
    }

    /// Makes one for pinholes and one for fisheyes; a map without fisheyes has the first twice.
    pub fn by_lens<T: Copy>(&self, mut make: impl FnMut(bool) -> Result<T, Fault>) -> Result<[T; 2], Fault> {
        let pinhole = make(false)?;
        Ok([pinhole, if self.fisheye { make(true)? } else { pinhole }])
    }

    pub fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// The same at half the size, an odd row or column left off; where steps draw that.
    pub fn halved(&self) -> Option<Shape> {
        self.half_size.then_some(Shape { width: self.width / 2, height: self.height / 2, ..*self })
    }

    /// Pixels of an image at half the size.
    pub fn halved_pixels(&self) -> usize {
        self.halved().map_or(0, |half| half.pixels())
    }

    /// Words of one stored 8-bit image; rows are padded to whole words.
    pub fn image_words(&self) -> usize {
        self.width.div_ceil(4) as usize * self.height as usize
    }

    /// Words from one camera's mask to the next: where a buffer may be bound.
    pub fn mask_stride(&self) -> usize {
        aligned(self.image_words())
    }

    /// Runs of the column passes of the loss, each channel's.
    pub fn loss_runs(&self) -> u32 {
        self.width * self.height.div_ceil(RUN)
    }

    /// Tiles that the loss filters, each channel's.
    pub fn loss_tiles(&self) -> u32 {
        let [width, height] = LOSS_TILE;
        self.width.div_ceil(width) * self.height.div_ceil(height)
    }

    /// Words of an intersection's gradient: SLOT of raster_backward.
    pub fn gradient_words(&self) -> usize {
        if self.channels == 3 {
            12
        } else {
            8
        }
    }

    /// Elements of a buffer that only colour maps need; a buffer cannot be empty.
    pub fn in_colour(&self, n: usize) -> usize {
        if self.channels == 3 {
            n
        } else {
            1
        }
    }

    pub fn tiles_max(&self) -> usize {
        // Half as wide and twice as high is as much, but for a ragged edge.
        (self.width.div_ceil(TILE_MIN) + 1) as usize * self.height.div_ceil(TILE_MIN) as usize
    }
}

/// Bytes used in turn: to list, then by the loss, then for the gradients of intersections. What a step needs after its
/// stage is not here.
#[derive(Clone, Copy)]
pub struct Scratch {
    /// While lists are made: the tile and the depth of each intersection, then elements of lists, and room to sort long ones.
    pub tile_depths: Buf<u32>,
    pub unsorted: Buf<[u32; 2]>,
    pub spare: Buf<[u32; 2]>,
    /// In the loss: filtered moments (4 planes, used on a CPU) and SSIM slopes (3).
    pub filtered: Buf<f32>,
    pub slopes: Buf<f32>,
    /// In the backward pass.
    pub isect_gradients: Buf<f32>,
}

/// Words of `n` and the gap to where the next buffer may start.
fn aligned(n: usize) -> usize {
    n.next_multiple_of(ALIGN as usize / size_of::<u32>())
}

impl Scratch {
    pub fn new(arena: &mut Arena, shape: &Shape) -> Result<Scratch, Fault> {
        let (isects, pixels) = (shape.intersections as usize, shape.pixels());
        let planes = aligned(MOMENTS * pixels) + 3 * pixels;
        let gradients = shape.gradient_words() * isects;
        let words = planes.max(gradients).max(aligned(isects) + aligned(2 * isects) + 4 * isects);
        let all = arena.alloc::<u32>("intersections: gradients, over lists in the making and loss planes", words)?;
        Ok(Scratch {
            tile_depths: all.part(0, isects),
            unsorted: all.part(aligned(isects), 2 * isects).cast(),
            spare: all.part(aligned(isects) + aligned(2 * isects), 4 * isects).cast(),
            filtered: all.part(0, MOMENTS * pixels).cast(),
            slopes: all.part(aligned(MOMENTS * pixels), 3 * pixels).cast(),
            isect_gradients: all.part(0, gradients).cast(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: Shape = Shape {
        width: 8,
        height: 8,
        splats: 1,
        intersections: 1,
        images: 1,
        channels: 1,
        cameras: 1,
        fisheye: false,
        half_size: false,
    };

    #[test]
    fn what_does_not_fit_into_an_element_of_a_list_is_refused() {
        let shape = Shape { width: 752, height: 480, splats: 1 << 22, intersections: 1 << 26, ..SMALL };
        assert_eq!(shape.check(), Ok(()));
        assert_eq!(Shape { width: 2000, height: 2000, ..shape }.check(), Ok(()));
        for (what, refused) in [
            ("2100 x 2100 px", Shape { width: 2100, height: 2100, ..shape }),
            ("4194305 Gaussians", Shape { splats: (1 << 22) + 1, ..shape }),
            ("67108865 intersections", Shape { intersections: (1 << 26) + 1, ..shape }),
            ("zero", Shape { images: 0, ..shape }),
        ] {
            let fault = refused.check().err().map(|f| f.what).unwrap_or_default();
            assert!(fault.contains(what), "{fault}");
        }
    }

    #[test]
    fn what_a_lens_needs_is_made_for_the_lenses_there_are() {
        let mut made = vec![];
        let mut make = |fisheye| {
            made.push(fisheye);
            Ok(made.len())
        };
        assert_eq!(SMALL.by_lens(&mut make).ok(), Some([1, 1]));
        assert_eq!(Shape { fisheye: true, ..SMALL }.by_lens(&mut make).ok(), Some([2, 3]));
        assert_eq!(made, [false, false, true]);
    }
}
