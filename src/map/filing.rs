//! What of a view goes to the store and comes back, and how much room the store is given.

use super::block::{KeyframeAbout, KIND_RUN};
use super::paging::splat_bytes;
use super::pool::{BLOCKS, FREE_DIVISOR};
use super::refine::Refinement;
use super::shape::Shape;
use super::views::{Stored, Views};
use crate::config::Board;
use crate::limits::CAMERAS_MAX;
use crate::store::{self, Key, Limits};
use stipple_drivers::{Calibration, Image};

/// Blocks that a run may make. An anchor has up to 16, and covers some square metres: a large building.
pub const BLOCKS_KNOWN: usize = 8192;
/// Buffers between here and the disk: what is written and what is read at a time.
pub const BUFFERS: usize = 8;
pub const SEGMENT_BYTES: u64 = 8 << 20;
/// Whether blocks keep Adam's moments on disk. Without them the patrol loses 2.6 dB in training and 1.5 held
/// out, or more (tests/bench/README.md).
pub const MOMENTS: bool = true;

pub fn image_id(views: &Views, index: usize) -> u32 {
    views.get(index).id as u32 * CAMERAS_MAX as u32 + views.camera(index) as u32
}

pub fn run_key(run: u32) -> Key {
    Key { kind: KIND_RUN, run, id: 0 }
}

pub fn state(e: &Stored, home: u32) -> KeyframeAbout {
    KeyframeAbout {
        t: e.t,
        epoch: e.epoch,
        held_out: e.held_out,
        anchor: e.anchor,
        home,
        given: e.given,
        refined: e.refined.body_from_refined,
        body_from_cam: e.body_from_cam,
        body_from_raw: e.body_from_raw,
        exposure: e.refined.exposure,
        coarseness: e.coarseness,
        steps: e.steps,
        horizon: e.horizon,
    }
}

pub fn entry(id: u32, s: &KeyframeAbout) -> Stored {
    Stored {
        id: u64::from(id / CAMERAS_MAX as u32),
        t: s.t,
        epoch: s.epoch,
        given: s.given,
        body_from_cam: s.body_from_cam,
        body_from_raw: s.body_from_raw,
        placed: s.given * s.body_from_cam,
        held_out: s.held_out,
        anchor: false,
        refined: Refinement::known(s.refined, s.exposure),
        coarseness: s.coarseness,
        horizon: s.horizon,
        absent: None,
        steps: s.steps,
        trained_at: 0,
        near_at: s.t,
        visited_again: false,
    }
}

/// Copies an image's planes from its record; false where it is not as large.
pub fn read_planes(payload: &[u8], planes: &mut [Image]) -> bool {
    let bytes: usize = planes.iter().map(|p| p.pixels.len()).sum();
    if payload.len() != bytes {
        return false;
    }
    let mut rest = payload;
    for plane in planes {
        let (pixels, after) = rest.split_at(plane.pixels.len());
        plane.pixels.copy_from_slice(pixels);
        rest = after;
    }
    true
}

pub fn limits(board: &Board, shape: &Shape, at_once: bool) -> Limits {
    Limits {
        bytes_max: board.store.max_mib << 20,
        segment_bytes: SEGMENT_BYTES,
        records_max: records_max(board, shape),
        payload_max: payload_max(board, shape),
        buffers: BUFFERS,
        write_bytes_per_s: if at_once { 0 } else { (board.store.write_mib_per_s * 1048576.0) as u64 },
    }
}

/// Keyframes that are known at once.
pub fn keyframes_known(board: &Board, shape: &Shape) -> usize {
    (board.store.keyframes.max(board.budget.keyframes) as usize).max((shape.images / shape.cameras) as usize)
}

/// A state and an image of each camera of each keyframe, blocks and runs; twice, for the runs before.
pub fn records_max(board: &Board, shape: &Shape) -> usize {
    2 * (2 * keyframes_known(board, shape) * shape.cameras as usize + BLOCKS_KNOWN + 64)
}

pub fn payload_max(board: &Board, shape: &Shape) -> usize {
    let seeds = board.map.seeds_per_anchor.min(shape.splats.div_ceil(FREE_DIVISOR as u32));
    let splats = (seeds + board.map.densify_max).min(shape.splats) as usize;
    let block = splats * splat_bytes(shape.channels == 3, MOMENTS);
    block.max(shape.pixels() * shape.channels as usize)
}

/// Bytes of a snapshot of all that may be in the pool and of all keyframes.
pub fn latest_max(board: &Board, shape: &Shape) -> u64 {
    let states = keyframes_known(board, shape) * shape.cameras as usize;
    let splats = shape.splats as usize * splat_bytes(shape.channels == 3, MOMENTS);
    store::snapshot_bytes(BLOCKS + states + BUFFERS, splats + BUFFERS * payload_max(board, shape))
}

/// A number of a rig and the form of its images: maps of another are not read.
pub fn identity(calibration: &Calibration, board: &Board, shape: &Shape) -> u64 {
    let Shape { width, height, channels, cameras, .. } = *shape;
    store::identity(&format!(
        "{:?} {:?} {width} {height} {channels} {cameras}",
        calibration.cameras, board.map.projection
    ))
}
