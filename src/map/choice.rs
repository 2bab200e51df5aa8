//! Room in which the archive finds what is wanted in memory (`residency`); bought at boot.

use super::filing::BLOCKS_KNOWN;
use stipple_drivers::{Nanos, Pose};

/// What is wanted, and room to find it.
pub struct Choice {
    /// Keyframes by how near they are, m.
    pub order: Vec<(f32, u32)>,
    pub wanted: Vec<bool>,
    /// The wanted, most wanted first.
    pub blocks: Vec<u32>,
    /// A block on its way to the store.
    pub page: Vec<u8>,
    pub leaving: Vec<u32>,
    /// Pixels that count and do not show what is on disk.
    pub hidden: Vec<u8>,
    /// The epoch that is mapped.
    pub epoch: u32,
    /// The last keyframe.
    pub last: Option<(Nanos, Pose)>,
}

impl Choice {
    pub fn new(keyframes: usize, payload: usize, pixels: usize) -> Choice {
        Choice {
            order: Vec::with_capacity(keyframes),
            wanted: vec![false; BLOCKS_KNOWN],
            blocks: Vec::with_capacity(BLOCKS_KNOWN),
            page: Vec::with_capacity(payload),
            leaving: Vec::with_capacity(BLOCKS_KNOWN),
            hidden: Vec::with_capacity(pixels),
            epoch: 0,
            last: None,
        }
    }
}
