//! How a picture is cut into tiles for the raster, and sums over tiles into chunks, by what the device is.

use crate::gpu::capability::{GROUP_SHUFFLE, GROUP_VOTE, SAMPLED_BUFFER};
use crate::gpu::{Caps, DeviceKind};

/// The size of a tile, and the variant of the raster that draws it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tiling {
    /// Invocations that shade a tile in step.
    pub lanes: u32,
    /// Pixels of a lane.
    pub column: u32,
    pub variant: &'static str,
    /// Gradients of one Gaussian that `sum_chunks` sums ahead: CHUNK_GPU, or 1 without it.
    pub chunk: u32,
    /// Whether the loss filters tiles in shared memory, or runs from registers, as on a CPU.
    pub loss_by_tiles: bool,
}

/// Lanes of a chunk in sum_chunks.comp.
pub const CHUNK_GPU: u32 = 16;

impl Tiling {
    /// What every device runs.
    pub const BASELINE: Tiling = Tiling { lanes: 32, column: 8, variant: "", chunk: 1, loss_by_tiles: true };

    pub fn of(caps: &Caps) -> Tiling {
        let sub = caps.allows(GROUP_VOTE) && caps.allows(GROUP_SHUFFLE);
        // A card with more processors than a picture has tiles waits for its longest list, which halves with the tile:
        // an NVIDIA H200 takes 0.203 ms a step at 52 k Gaussians and 752x480, 0.210 with columns of 8 and 0.235 with
        // columns of 2 (30 k at 320x240: 0.159, 0.222 and 0.142). Where tiles are plenty, fewer pixels a lane only make more
        // lists and move more bytes.
        let column = if caps.kind == DeviceKind::Discrete { 4 } else { Tiling::BASELINE.column };
        // Measured on an H100 and an H200 alone; a GPU whose shared memory is ordinary memory may be better off with runs.
        let loss_by_tiles = caps.kind != DeviceKind::Cpu;
        let chunk = if loss_by_tiles { CHUNK_GPU } else { 1 };
        let variant = if caps.allows(SAMPLED_BUFFER) { "cpu" } else { "subgroup" };
        match caps.subgroup_size {
            n @ (8 | 16 | 32 | 64) if sub => Tiling { lanes: n.min(32), column, variant, chunk, loss_by_tiles },
            _ => Tiling { column, chunk, loss_by_tiles, ..Tiling::BASELINE },
        }
    }

    /// Width and height, px: tiles.glsl.
    pub fn tile(&self) -> [u32; 2] {
        let width = self.lanes.min(16);
        [width, self.column * self.lanes / width]
    }
}
