//! What has changed of the map since it was handed to the store, at one instant: with it a mapper that dies loses the training
//! since its last keyframe, not all since each block was last written.

use super::archive::{part_id, Archive};
use super::block::{KIND_BLOCK, KIND_IMAGE, KIND_KEYFRAME, NO_BLOCK};
use super::filing::{image_id, state};
use super::scene::Scene;
use crate::gpu::GpuError;
use crate::store::{Snapshot, ABOUT};
use std::io;
use stipple_drivers::{Nanos, Span};

/// Bytes a second of flight that are written at most: a large pool has a snapshot each few seconds.
const BYTES_PER_S: f64 = 50e6;
/// Pause after an error.
const RETRY: Span = Span(1_000_000_000);

impl Archive {
    /// Writes a snapshot of what the store does not have as it is, with a keyframe, where one is due.
    pub fn save_latest(&mut self, scene: &mut Scene, t: Nanos) -> Result<(), GpuError> {
        if t < self.latest_due {
            return Ok(());
        }
        let Some(mut latest) = self.latest.take() else { return Ok(()) };
        let written = self.write_latest(scene, &mut latest);
        self.latest = Some(latest);
        self.latest_due = t + match written? {
            Ok(bytes) => Span::from_secs(bytes as f64 / BYTES_PER_S),
            Err(_) => {
                scene.counters.snapshot_errors.add(1);
                RETRY
            }
        };
        Ok(())
    }

    /// Writes the blocks in the pool that have changed, one that grows too, the states of keyframes, and what waits in buffers of
    /// the store; bytes.
    fn write_latest(&mut self, scene: &mut Scene, snapshot: &mut Snapshot) -> Result<io::Result<u64>, GpuError> {
        snapshot.begin();
        let mut blocks = std::mem::take(&mut self.choice.ranked);
        blocks.clear();
        for block in scene.pipeline.pool.blocks().filter_map(|(number, _)| self.block_of(number)) {
            let b = &self.blocks[block];
            // What waits in a buffer of the store dies with it.
            if b.changed() || self.store.generation(&self.key(KIND_BLOCK, part_id(&scene.views, b))).1 {
                blocks.push((0.0, block as u32));
            }
        }
        let mut bytes = std::mem::take(&mut self.choice.page);
        let (mut added, colour) = (Ok(true), scene.pipeline.pool.colour);
        let read = self.read_pages(scene, &blocks, &mut bytes, |archive, views, block, count, own| {
            let mut b = archive.blocks[block];
            b.look_at(count, own);
            let key = archive.key(KIND_BLOCK, part_id(views, &b));
            added = snapshot.add(&key, archive.store.generation(&key).0, &b.about(colour).encode(), own);
            matches!(added, Ok(true))
        });
        self.choice.ranked = blocks;
        if read.is_err() {
            self.choice.page = bytes;
            return read.map(|_| Err(io::ErrorKind::Other.into()));
        }
        self.look_at_changed();
        let (views, cameras) = (&scene.views, scene.views.cameras());
        for index in 0..self.known.len() * cameras {
            let (known, entry) = (self.known[index / cameras], views.get(index));
            let is_due = known.saved && (index >= views.earlier || known.stated != entry.steps);
            if !is_due || !matches!(added, Ok(true)) {
                continue;
            }
            let home = known.home.map_or(NO_BLOCK, |anchor| views.get(anchor as usize).id as u32);
            let key = self.key(KIND_KEYFRAME, image_id(views, index));
            added = snapshot.add(&key, self.store.generation(&key).0, &state(entry, home).encode(), &[]);
            let image = self.key(KIND_IMAGE, image_id(views, index));
            if let (Ok(true), (generation, true), true) =
                (&added, self.store.generation(&image), views.has_place(index))
            {
                bytes.clear();
                views.planes(index).iter().for_each(|plane| bytes.extend_from_slice(&plane.pixels));
                added = snapshot.add(&image, generation, &[0; ABOUT], &bytes);
            }
        }
        self.choice.page = bytes;
        Ok(match added {
            Ok(true) => snapshot.end(),
            Ok(false) => Err(io::ErrorKind::StorageFull.into()),
            Err(e) => Err(e),
        })
    }
}
