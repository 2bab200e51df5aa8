//! How a picture is cut into tiles for the raster, by what the device is.

use crate::gpu::{Caps, DeviceKind};

/// The size of a tile, and the variant of the raster that draws it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tiling {
    /// Invocations that shade a tile in step.
    pub lanes: u32,
    /// Pixels of a lane.
    pub column: u32,
    pub variant: &'static str,
}

impl Tiling {
    /// What every device runs.
    pub const BASELINE: Tiling = Tiling { lanes: 32, column: 8, variant: "" };

    pub fn of(caps: &Caps) -> Tiling {
        // Intel's compiler picks a width per kernel, narrower than the one it reports.
        let fixed_width = !caps.name.contains("Intel");
        let sub = caps.subgroup.vote && caps.subgroup.shuffle && fixed_width;
        // A card with more processors than a picture has tiles waits for its longest list, which halves with the tile:
        // an NVIDIA H200 takes 0.434 ms a step at 52 k Gaussians instead of 0.469, and 0.475 with columns of 2. Where
        // tiles are plenty, fewer pixels a lane only make more lists.
        let column = if caps.kind == DeviceKind::Discrete { 4 } else { Tiling::BASELINE.column };
        match caps.subgroup_size {
            n @ (8 | 16 | 32 | 64) if sub => Tiling { lanes: n.min(32), column, variant: "subgroup" },
            _ => Tiling { column, ..Tiling::BASELINE },
        }
    }

    /// Width and height, px: tiles.glsl.
    pub fn tile(&self) -> [u32; 2] {
        let width = self.lanes.min(16);
        [width, self.column * self.lanes / width]
    }
}
