//! The points of the window: a fixed pool, found by track id, with the views of each.

use super::reprojection::Point;
use crate::frontend::Tracks;
use crate::limits::{LANDMARKS, OBSERVATIONS};
use crate::mem::List;
use glam::DVec2;

/// A view of a point: which camera of which frame, and where, px.
#[derive(Clone, Copy, Debug, Default)]
pub struct Observation {
    pub slot: u8,
    pub camera: u8,
    pub px: [f32; 2],
}

impl Observation {
    /// In double precision.
    pub fn px(&self) -> DVec2 {
        DVec2::new(self.px[0] as f64, self.px[1] as f64)
    }
}

/// A point and its views.
#[derive(Clone, Debug, Default)]
pub struct Landmark {
    /// Id of its tracks.
    pub id: u64,
    /// Slot of the frame it is given in, and the camera of that frame whose ray the point is on.
    pub host: u8,
    pub host_camera: u8,
    /// Row of that view, px: a rolling shutter takes each at its own time.
    pub host_row: f32,
    pub point: Point,
    /// Standard deviation of its inverse distance, the frames taken as known, 1/m.
    pub rho_sigma: f32,
    pub observations: List<Observation, OBSERVATIONS>,
}

impl Landmark {
    /// Views in one frame.
    pub fn views_in(&self, slot: usize) -> usize {
        self.observations.iter().filter(|o| o.slot as usize == slot).count()
    }
}

/// The points, and an index by id.
#[derive(Clone, Debug)]
pub struct Landmarks {
    pub pool: Vec<Landmark>,
    /// (id, place in the pool), ascending.
    index: Vec<(u64, u16)>,
}

impl Landmarks {
    pub fn new() -> Landmarks {
        Landmarks { pool: Vec::with_capacity(LANDMARKS), index: Vec::with_capacity(LANDMARKS) }
    }

    /// Forgets all points.
    pub fn clear(&mut self) {
        self.pool.clear();
        self.index.clear();
    }

    /// Makes the index of the pool anew, after points were added or removed.
    pub fn reindex(&mut self) {
        self.index.clear();
        self.index.extend(self.pool.iter().enumerate().map(|(i, l)| (l.id, i as u16)));
        self.index.sort_unstable();
    }

    /// Place in the pool of the point with this id.
    pub fn find(&self, id: u64) -> Option<usize> {
        self.index.binary_search_by_key(&id, |e| e.0).ok().map(|i| self.index[i].1 as usize)
    }

    /// Keeps landmarks for which `keep` is true, in order.
    pub fn retain(&mut self, keep: impl FnMut(&Landmark) -> bool) {
        self.pool.retain(keep);
        self.reindex();
    }

    /// Adds every track that already is a landmark; answers how many points are and are not.
    pub fn attach(&mut self, slot: usize, tracks: &Tracks) -> (usize, usize) {
        let (mut connected, mut unconnected) = (0, 0);
        for (camera, list) in tracks.cameras.iter().enumerate() {
            for track in list.iter() {
                let found = self.find(track.id);
                if let Some(i) = found {
                    let seen = Observation { slot: slot as u8, camera: camera as u8, px: track.px };
                    // Capacity is every camera of every frame, so a push cannot fail.
                    let _ = self.pool[i].observations.push(seen);
                }
                // A point that several cameras see counts once.
                if (0..camera).all(|c| tracks.find(c, track.id).is_none()) {
                    *if found.is_some() { &mut connected } else { &mut unconnected } += 1;
                }
            }
        }
        (connected, unconnected)
    }

    /// Views of all points in one frame.
    pub fn views_in(&self, slot: usize) -> usize {
        self.pool.iter().map(|l| l.views_in(slot)).sum()
    }

    /// Forgets a frame; landmarks hosted there or left with fewer than two views go.
    pub fn forget(&mut self, slot: usize) {
        self.pool.retain(|l| l.host as usize != slot);
        self.retain_views(|_, o| o.slot as usize != slot);
    }

    /// Keeps views for which `keep` is true, and landmarks that still have two.
    pub fn retain_views(&mut self, mut keep: impl FnMut(&Landmark, &Observation) -> bool) {
        for i in 0..self.pool.len() {
            let mut views = std::mem::take(&mut self.pool[i].observations);
            views.retain(|o| keep(&self.pool[i], o));
            self.pool[i].observations = views;
        }
        self.retain(|l| l.observations.len() >= 2);
    }
}
