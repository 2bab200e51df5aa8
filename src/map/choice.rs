//! Room in which the archive finds what is wanted in memory (`residency`, `rotation`); bought at boot.

use super::filing::{keyframes_known, BLOCKS_KNOWN};
use super::parts::Ordering;
use super::shape::Shape;
use crate::config::Board;
use std::collections::VecDeque;
use stipple_drivers::{Nanos, Pose};

/// What is wanted, and room to find it.
pub struct Choice {
    /// Keyframes by how near they are, m.
    pub order: Vec<(f32, u32)>,
    /// Gaussians that each of them needs and that are not wanted.
    pub lacking: Vec<usize>,
    /// For each block a bit for each keyframe of `order` that needs it; none once it is wanted.
    pub needed_by: Vec<u128>,
    pub wanted: Vec<bool>,
    /// Which blocks the newest keyframes see.
    pub now_seen: Vec<bool>,
    /// Whether Gaussians may go where they do not fit.
    pub evict: bool,
    /// What must be in the pool where the vehicle is does not fit: the least important goes.
    pub thins: bool,
    /// The wanted, most wanted first.
    pub blocks: Vec<u32>,
    /// A block on its way to the store.
    pub page: Vec<u8>,
    /// Room to cut a block into parts.
    pub ordering: Ordering,
    pub leaving: Vec<u32>,
    /// Blocks by what is seen of them, or by how far they are.
    pub ranked: Vec<(f32, u32)>,
    /// Pixels that count and do not show what is on disk.
    pub hidden: Vec<u8>,
    /// The epoch that is mapped.
    pub epoch: u32,
    /// The last keyframe.
    pub last: Option<(Nanos, Pose)>,
    /// Whether the pool is turned to another place than the vehicle's.
    pub elsewhere: bool,
    /// Training steps while a turn to another place may come.
    pub steps: u64,
    /// Gaussians that the pool is to have room for beside those that are wanted.
    pub reserve: usize,
}

impl Choice {
    pub fn new(keyframes: usize, payload: usize, pixels: usize, evict: bool) -> Choice {
        Choice {
            order: Vec::with_capacity(keyframes),
            lacking: Vec::with_capacity(keyframes),
            needed_by: vec![0; BLOCKS_KNOWN],
            wanted: vec![false; BLOCKS_KNOWN],
            now_seen: Vec::with_capacity(BLOCKS_KNOWN),
            evict,
            thins: false,
            blocks: Vec::with_capacity(BLOCKS_KNOWN),
            page: Vec::with_capacity(payload),
            ordering: Ordering::new(payload),
            leaving: Vec::with_capacity(BLOCKS_KNOWN),
            ranked: Vec::with_capacity(BLOCKS_KNOWN),
            hidden: Vec::with_capacity(pixels),
            epoch: 0,
            last: None,
            elsewhere: false,
            steps: 0,
            reserve: 0,
        }
    }
}

/// Views drawn ahead, at most.
const AHEAD: usize = 8;
/// Newest keyframes, whose poses odometry still corrects and of which one is an anchor's.
pub const NEWEST: usize = 8;

/// Views to train on, drawn ahead of their steps.
pub struct Drawn {
    /// Views that may be trained on: enough of what they see is in the pool.
    pub trainable: Vec<u32>,
    /// Views that were drawn, the next one first.
    pub next: VecDeque<u32>,
    /// How many are drawn ahead.
    pub ahead: usize,
    /// Training steps from one fetched image to the next, at least, and those at the last one.
    pub steps: u64,
    pub fetched_at: u64,
    /// The exchange of blocks after which the trainable were last found.
    pub found_at: u64,
}

impl Drawn {
    pub fn new(board: &Board, shape: &Shape, at_once: bool) -> Drawn {
        let places = (shape.images / shape.cameras) as usize;
        // Beside the newest, the images drawn ahead have places, and as many leave theirs.
        let ahead = (AHEAD.min((places - newest_kept(places)) / 2)).max(1);
        Drawn {
            trainable: Vec::with_capacity(keyframes_known(board, shape) * shape.cameras as usize),
            next: VecDeque::with_capacity(AHEAD),
            ahead: if at_once { 1 } else { ahead },
            steps: u64::from(board.map.rotation_steps.max(1)),
            fetched_at: 0,
            found_at: 0,
        }
    }
}

/// Keyframes, the newest, whose images stay.
pub fn newest_kept(places: usize) -> usize {
    NEWEST.min(places / 2)
}
