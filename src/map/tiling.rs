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
        // Intel's compiler picks a width per kernel, narrower than the one it reports.
        let fixed_width = !caps.name.contains("Intel");
        let sub = caps.allows(GROUP_VOTE) && caps.allows(GROUP_SHUFFLE) && fixed_width;
        // A card with more processors than a picture has tiles waits for its longest list, which halves with the tile:
        // an NVIDIA H200 takes 0.434 ms a step at 52 k Gaussians instead of 0.469, and 0.475 with columns of 2. Where
        // tiles are plenty, fewer pixels a lane only make more lists. All tiles of such a card are under way at once, so
        // that to begin with the longest list gains nothing. The backward raster follows it, 0.64 µs a Gaussian at
        // 752x480 whatever their number; on V1_01 lists are 98 on average and 156 at most, and to cut the long ones
        // could save 30 of 103 µs, for 8 bytes an intersection of transmittance and colour where they are cut.
        let column = if caps.kind == DeviceKind::Discrete { 4 } else { Tiling::BASELINE.column };
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
