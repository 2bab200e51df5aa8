//! The points of the window: a fixed pool, found by track id; triangulation; outliers.

use super::projection::{host_cam, placed, predicted};
use super::residuals::{CameraModel, Point, Transform};
use super::window::{Window, FRAMES};
use crate::frontend::{Track, Tracks};
use crate::limits::{CAMERAS_MAX, LANDMARKS, OBSERVATIONS};
use crate::mem::List;
use glam::{DVec2, DVec3};

/// Nearer points than this are refused when triangulated, 1/m.
const RHO_MAX: f64 = 5.0;
/// Bearing noise used to tell a far point from one behind the camera, rad.
const BEARING_SIGMA: f64 = 2e-3;

#[derive(Clone, Copy, Debug, Default)]
pub struct Observation {
    pub slot: u8,
    pub camera: u8,
    pub px: [f32; 2],
}

impl Observation {
    pub fn px(&self) -> DVec2 {
        DVec2::new(self.px[0] as f64, self.px[1] as f64)
    }
}

#[derive(Clone, Debug, Default)]
pub struct Landmark {
    pub id: u64,
    pub host: u8,
    /// The camera of the host whose ray the point is on.
    pub host_camera: u8,
    /// Row of that view, px: a rolling shutter takes each at its own time.
    pub host_row: f32,
    pub point: Point,
    /// Standard deviation of its inverse distance, the frames taken as known, 1/m.
    pub rho_sigma: f32,
    pub observations: List<Observation, OBSERVATIONS>,
}

#[derive(Clone, Debug)]
pub struct Landmarks {
    pub pool: Vec<Landmark>,
    /// (id, place in the pool), ascending.
    index: Vec<(u64, u16)>,
}

/// A view of a point that is being triangulated.
struct View {
    observation: Observation,
    /// World-from-camera.
    camera: Transform,
    bearing: DVec3,
}

impl Landmarks {
    pub fn new() -> Landmarks {
        Landmarks { pool: Vec::with_capacity(LANDMARKS), index: Vec::with_capacity(LANDMARKS) }
    }

    pub const BYTES: usize = LANDMARKS * (size_of::<Landmark>() + size_of::<(u64, u16)>());

    pub fn clear(&mut self) {
        self.pool.clear();
        self.index.clear();
    }

    fn reindex(&mut self) {
        self.index.clear();
        self.index.extend(self.pool.iter().enumerate().map(|(i, l)| (l.id, i as u16)));
        self.index.sort_unstable();
    }

    pub fn find(&self, id: u64) -> Option<usize> {
        self.index.binary_search_by_key(&id, |e| e.0).ok().map(|i| self.index[i].1 as usize)
    }

    /// Keeps landmarks for which `keep` is true; their order changes only through removal.
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
                if !tracks.cameras[..camera].iter().any(|c| find_track(c, track.id).is_some()) {
                    *if found.is_some() { &mut connected } else { &mut unconnected } += 1;
                }
            }
        }
        (connected, unconnected)
    }

    /// Views of one frame.
    pub fn views_in(&self, slot: usize) -> usize {
        self.pool.iter().map(|l| l.observations.iter().filter(|o| o.slot as usize == slot).count()).sum()
    }

    /// Forgets a frame; landmarks hosted there or left with fewer than two views go.
    pub fn forget(&mut self, slot: usize) {
        self.retain_views(|l| l.host as usize != slot, |_, o| o.slot as usize != slot);
    }

    fn retain_views(
        &mut self,
        mut keep: impl FnMut(&Landmark) -> bool,
        mut keep_view: impl FnMut(&Landmark, &Observation) -> bool,
    ) {
        for i in 0..self.pool.len() {
            let mut views = std::mem::take(&mut self.pool[i].observations);
            views.retain(|o| keep_view(&self.pool[i], o));
            self.pool[i].observations = views;
        }
        self.retain(|l| keep(l) && l.observations.len() >= 2);
    }

    /// Drops views further than `px_max` from their prediction; answers how many.
    pub fn drop_outliers(&mut self, window: &Window, px_max: f64) -> usize {
        let mut dropped = 0;
        self.retain_views(
            |_| true,
            |l, o| {
                let ok =
                    predicted(l, &host_cam(l, window), o, window).is_some_and(|px| (px - o.px()).length() <= px_max);
                dropped += !ok as usize;
                ok
            },
        );
        dropped
    }

    /// Makes landmarks of the newest frame's unconnected tracks, each hosted by the first camera that can;
    /// answers (made, refused because full).
    pub fn triangulate(
        &mut self,
        slot: usize,
        window: &Window,
        tracks: &[Tracks],
        cameras: &[CameraModel],
        baseline_min: f64,
        px_max: f64,
    ) -> (usize, usize) {
        let (mut made, mut full) = (0, 0);
        for (camera, list) in tracks[slot].cameras.iter().enumerate() {
            let fresh = self.pool.len();
            for track in list.iter() {
                if self.find(track.id).is_some() {
                    continue;
                }
                let host = (slot, camera);
                let Some(landmark) = triangulate_one(track, host, window, tracks, cameras, baseline_min, px_max) else {
                    continue;
                };
                if self.pool.len() == LANDMARKS {
                    full += 1;
                } else {
                    self.pool.push(landmark);
                    made += 1;
                }
            }
            // The next camera finds what this one made.
            if self.pool.len() > fresh {
                self.reindex();
            }
        }
        (made, full)
    }
}

impl Default for Landmarks {
    fn default() -> Self {
        Landmarks::new()
    }
}

pub fn find_track(list: &[Track], id: u64) -> Option<&Track> {
    list.binary_search_by_key(&id, |t| t.id).ok().map(|i| &list[i])
}

fn camera_in_world(o: &Observation, window: &Window) -> Transform {
    let (body, camera_model) =
        (&window.frame(o.slot as usize).body, placed(o.camera as usize, o.px[1], o.slot as usize, window));
    Transform { r: body.r * camera_model.r, p: body.r * camera_model.p + body.p }
}

fn views_of(
    track: &Track,
    (slot, host_camera): (usize, usize),
    window: &Window,
    tracks: &[Tracks],
    cameras: &[CameraModel],
) -> ([Option<View>; FRAMES * CAMERAS_MAX], usize) {
    let mut views = [const { None }; FRAMES * CAMERAS_MAX];
    let mut n = 0;
    for s in window.slots() {
        for (camera, camera_model) in cameras.iter().enumerate() {
            if s == slot && camera == host_camera {
                continue;
            }
            let Some(seen) = find_track(&tracks[s].cameras[camera], track.id) else { continue };
            let observation = Observation { slot: s as u8, camera: camera as u8, px: seen.px };
            let Some(bearing) = camera_model.camera.unproject(observation.px()) else { continue };
            views[n] = Some(View { observation, camera: camera_in_world(&observation, window), bearing });
            n += 1;
        }
    }
    (views, n)
}

/// Inverse distance along the host's bearing by linear least squares over all views that have the
/// baseline: `b_t × (R b + rho t) = 0`, in which the angles of the far views are small and weigh alike.
fn triangulate_one(
    track: &Track,
    (slot, host_camera): (usize, usize),
    window: &Window,
    tracks: &[Tracks],
    cameras: &[CameraModel],
    baseline_min: f64,
    px_max: f64,
) -> Option<Landmark> {
    let host_view = Observation { slot: slot as u8, camera: host_camera as u8, px: track.px };
    let bearing = cameras[host_camera].camera.unproject(host_view.px())?;
    let host = camera_in_world(&host_view, window);
    let (views, n) = views_of(track, (slot, host_camera), window, tracks, cameras);
    let (mut num, mut den) = (0.0, 0.0);
    for v in views[..n].iter().flatten() {
        let to_view = v.camera.r.transpose();
        let offset = host.p - v.camera.p;
        if offset.length() < baseline_min {
            continue;
        }
        let (a, b) = (v.bearing.cross(to_view * (host.r * bearing)), v.bearing.cross(to_view * offset));
        num -= a.dot(b);
        den += b.length_squared();
    }
    if !(den > 0.0) {
        return None;
    }
    let rho = num / den;
    if !(rho < RHO_MAX && rho > -3.0 * BEARING_SIGMA / den.sqrt()) {
        return None;
    }
    let mut landmark = Landmark {
        id: track.id,
        host: slot as u8,
        host_camera: host_camera as u8,
        host_row: track.px[1],
        point: Point::new(bearing, rho.max(0.0)),
        ..Landmark::default()
    };
    let _ = landmark.observations.push(host_view);
    let sits = host_cam(&landmark, window);
    for v in views[..n].iter().flatten() {
        let o = v.observation;
        let seen = predicted(&landmark, &sits, &o, window);
        if seen.is_some_and(|px| (px - o.px()).length() <= px_max) {
            let _ = landmark.observations.push(o);
        }
    }
    (landmark.observations.len() >= 2).then_some(landmark)
}
