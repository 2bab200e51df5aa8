//! Landmarks made of tracks by triangulation, and views that do not fit dropped.

use super::graph::Graph;
use super::innovation_gate::add_once;
use super::landmarks::{Landmark, Observation};
use super::model::Model;
use super::projection::{host_cam, placed, predicted};
use super::reprojection::{Point, Transform};
use super::window::Window;
use crate::frontend::{Rejected, Track, Tracks};
use crate::limits::{CAMERAS_MAX, FRAMES, LANDMARKS};
use glam::DVec3;

/// Inverse distance above which points are refused when triangulated, 1/m.
const RHO_MAX: f64 = 5.0;
/// Bearing noise used to tell a far point from one behind the camera, rad.
const BEARING_SIGMA: f64 = 2e-3;

/// Inverse distance along a bearing by linear least squares over all views that have the baseline:
/// `b_t × (R b + rho t) = 0`, in which the angles of the far views are small and weigh alike.
#[derive(Clone, Copy, Debug, Default)]
pub struct InverseDistance {
    numerator: f64,
    /// Information, rad² m².
    pub information: f64,
}

impl InverseDistance {
    /// Adds the view `seen` (unit, in the camera at `view`) of a point along `bearing` (unit, in the camera at `from`).
    /// Both cameras are in one frame; nearer ones than `baseline_min`, m, say nothing.
    pub fn add(&mut self, from: &Transform, bearing: DVec3, view: &Transform, seen: DVec3, baseline_min: f64) {
        let to_view = view.r.transpose();
        let offset = from.p - view.p;
        if offset.length() < baseline_min {
            return;
        }
        let (a, b) = (seen.cross(to_view * (from.r * bearing)), seen.cross(to_view * offset));
        self.numerator -= a.dot(b);
        self.information += b.length_squared();
    }

    /// 1/m; not a number without any view.
    pub fn rho(&self) -> f64 {
        self.numerator / self.information
    }
}

/// A view of a point that is being triangulated.
struct View {
    observation: Observation,
    world_from_cam: Transform,
    bearing: DVec3,
}

/// Makes landmarks of the unconnected tracks of the frame in `slot`, each hosted by the first camera that can;
/// views further than `px_max` from where the point then is are left out. Answers (made, refused because full).
pub fn triangulate(graph: &mut Graph, slot: usize, tracks: &[Tracks], model: &Model, px_max: f64) -> (usize, usize) {
    let Graph { window, landmarks, .. } = graph;
    let (mut made, mut full) = (0, 0);
    for (camera, list) in tracks[slot].cameras.iter().enumerate() {
        let before = landmarks.pool.len();
        for track in list.iter() {
            if landmarks.find(track.id).is_some() {
                continue;
            }
            let Some(landmark) = triangulate_one(track, (slot, camera), window, tracks, model, px_max) else {
                continue;
            };
            if landmarks.pool.len() == LANDMARKS {
                full += 1;
            } else {
                landmarks.pool.push(landmark);
                made += 1;
            }
        }
        // The next camera finds what this one made.
        if landmarks.pool.len() > before {
            landmarks.reindex();
        }
    }
    (made, full)
}

/// Drops views further than `px_max` from their prediction; answers how many. Adds the ids of those of the frame in `slot`
/// to `rejected`.
pub fn drop_outliers(graph: &mut Graph, px_max: f64, slot: usize, rejected: &mut Rejected) -> usize {
    let Graph { window, landmarks, .. } = graph;
    let mut dropped = 0;
    landmarks.retain_views(|l, o| {
        let px = predicted(l, &host_cam(l, window), o, window);
        let fits = px.is_some_and(|px| (px - o.px()).length() <= px_max);
        dropped += !fits as usize;
        if !fits && usize::from(o.slot) == slot {
            add_once(rejected, l.id);
        }
        fits
    });
    dropped
}

fn world_from_cam(o: &Observation, window: &Window) -> Transform {
    let body = &window.frame(o.slot as usize).world_from_body;
    let camera = placed(o.camera as usize, o.px[1], o.slot as usize, window);
    Transform { r: body.r * camera.r, p: body.r * camera.p + body.p }
}

/// Views of a track besides that of its host.
fn views_of(
    id: u64,
    host: (usize, usize),
    window: &Window,
    tracks: &[Tracks],
) -> ([Option<View>; FRAMES * CAMERAS_MAX], usize) {
    let mut views = [const { None }; FRAMES * CAMERAS_MAX];
    let mut n = 0;
    for slot in window.slots() {
        for (camera, model) in window.rig.cameras().iter().enumerate().filter(|(c, _)| (slot, *c) != host) {
            let Some(seen) = tracks[slot].find(camera, id) else { continue };
            let observation = Observation { slot: slot as u8, camera: camera as u8, px: seen.px };
            let Some(bearing) = model.camera.unproject(observation.px()) else { continue };
            views[n] = Some(View { observation, world_from_cam: world_from_cam(&observation, window), bearing });
            n += 1;
        }
    }
    (views, n)
}

fn triangulate_one(
    track: &Track,
    (slot, camera): (usize, usize),
    window: &Window,
    tracks: &[Tracks],
    model: &Model,
    px_max: f64,
) -> Option<Landmark> {
    let host_view = Observation { slot: slot as u8, camera: camera as u8, px: track.px };
    let bearing = window.rig.cameras()[camera].camera.unproject(host_view.px())?;
    let host = world_from_cam(&host_view, window);
    let (views, n) = views_of(track.id, (slot, camera), window, tracks);
    let mut distance = InverseDistance::default();
    for v in views[..n].iter().flatten() {
        distance.add(&host, bearing, &v.world_from_cam, v.bearing, model.config.triangulation_baseline_min_m);
    }
    let (rho, information) = (distance.rho(), distance.information);
    if !(information > 0.0 && rho < RHO_MAX && rho > -3.0 * BEARING_SIGMA / information.sqrt()) {
        return None;
    }
    let mut landmark = Landmark {
        id: track.id,
        host: slot as u8,
        host_camera: camera as u8,
        host_row: track.px[1],
        point: Point::new(bearing, rho.max(0.0)),
        ..Landmark::default()
    };
    let _ = landmark.observations.push(host_view);
    let body_from_host_cam = host_cam(&landmark, window);
    for o in views[..n].iter().flatten().map(|v| v.observation) {
        let px = predicted(&landmark, &body_from_host_cam, &o, window);
        if px.is_some_and(|px| (px - o.px()).length() <= px_max) {
            let _ = landmark.observations.push(o);
        }
    }
    (landmark.observations.len() >= 2).then_some(landmark)
}
