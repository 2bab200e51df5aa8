//! Projection of a landmark into a view of it, by the rig as it is estimated: where each camera sits, and when each
//! row was taken.
//!
//! Where nothing of that is estimated and shutters are global, this is `reprojection.rs` as it
//! stands. Otherwise both cameras, the host's and the viewing one, are carried to their instants
//! (`shutter.rs`), and the view touches the cameras' columns of the rig. Residuals are taken at the
//! estimate, Jacobians at the linearization points.

use super::landmarks::{Landmark, Observation};
use super::reprojection::{CameraModel, Reprojection, Transform, View};
use super::rig::CAMERA_DIM_MAX;
use super::shutter::{to_stamp, DelayedCamera};
use super::window::Window;
use glam::DVec2;

/// Derivatives of a view to the rig's columns that cameras touch; the first `camera_dim` are meant.
pub type CameraColumns = [[f64; CAMERA_DIM_MAX]; 2];

fn delayed(camera: &CameraModel, time_offset: f64, row: f32, slot: usize, window: &Window) -> DelayedCamera {
    let tau = time_offset + camera.row_delay(row.into());
    DelayedCamera::new(&camera.body_from_cam, &window.frame(slot).twist, tau)
}

/// Place of a camera on the body when it takes a row, px, of the frame in `slot`.
pub fn placed(camera: usize, row: f32, slot: usize, window: &Window) -> Transform {
    let model = &window.rig.cameras()[camera];
    if window.rig.is_plain() {
        return model.body_from_cam;
    }
    delayed(model, window.rig.now.time_offsets[camera], row, slot, window).body_from_cam
}

/// Place of the camera that a landmark is hosted in, for all its views.
pub fn host_cam(l: &Landmark, window: &Window) -> Transform {
    placed(l.host_camera as usize, l.host_row, l.host as usize, window)
}

/// Pixel at which the observation should be; `None` where the camera cannot see the point.
pub fn predicted(l: &Landmark, host_cam: &Transform, o: &Observation, window: &Window) -> Option<DVec2> {
    let camera = &window.rig.cameras()[o.camera as usize];
    let host = &window.frame(l.host as usize).world_from_body;
    let target = &window.frame(o.slot as usize).world_from_body;
    if window.rig.is_plain() {
        return View { host_cam, host, camera, target }.predict(&l.point);
    }
    let body_from_cam = placed(o.camera as usize, o.px[1], o.slot as usize, window);
    let camera = &CameraModel { body_from_cam, ..*camera };
    View { host_cam, host, camera, target }.predict(&l.point)
}

/// The host's camera at the estimate, and at the linearization point where that has to be carried to its instant.
pub struct Host {
    now: Transform,
    delayed: Option<DelayedCamera>,
}

impl Host {
    /// Host of all views of a landmark.
    pub fn of(l: &Landmark, window: &Window) -> Host {
        let (rig, slot, camera) = (&window.rig, l.host as usize, l.host_camera as usize);
        let (model, time_offset) = (&rig.cameras_linearized()[camera], rig.linearized().time_offsets[camera]);
        let delayed = || delayed(model, time_offset, l.host_row, slot, window);
        Host { now: host_cam(l, window), delayed: (!rig.is_plain()).then(delayed) }
    }
}

/// Prediction minus observation, px, and derivatives; those to the rig, where it has columns, go to `columns`.
/// `None` where the camera cannot see the point.
pub fn observe(
    l: &Landmark,
    at: &Host,
    o: &Observation,
    window: &Window,
    columns: &mut CameraColumns,
) -> Option<Reprojection> {
    let rig = &window.rig;
    let (host_frame, frame) = (window.frame(l.host as usize), window.frame(o.slot as usize));
    let (host, target) = (&host_frame.world_from_body_linearized, &frame.world_from_body_linearized);
    let cameras = [l.host_camera, o.camera].map(usize::from);
    let [host_camera, camera] = cameras.map(|c| &rig.cameras_linearized()[c]);
    let mut r = if let Some(host_cam) = &at.delayed {
        let time_offset = rig.linearized().time_offsets[cameras[1]];
        let seeing = delayed(camera, time_offset, o.px[1], o.slot as usize, window);
        let camera = &CameraModel { body_from_cam: seeing.body_from_cam, ..*camera };
        let view = View { host_cam: &host_cam.body_from_cam, host, camera, target };
        let (r, mut d) = view.reproject_with_extrinsics(&l.point)?;
        let d_time = to_stamp(&mut d, host_cam, &seeing);
        for (k, row) in columns.iter_mut().enumerate() {
            row.fill(0.0);
            for ((camera, d), d_time) in cameras.into_iter().zip([&d.host[k], &d.target[k]]).zip(d_time[k]) {
                if let Some(at) = rig.time_column(camera) {
                    row[at] += d_time;
                }
                if let Some(at) = rig.extrinsic_column(camera) {
                    row[at..].iter_mut().zip(d).for_each(|(sum, d)| *sum += d);
                }
            }
        }
        r
    } else {
        View { host_cam: &host_camera.body_from_cam, host, camera, target }.reproject(&l.point)?
    };
    let fixed = host_frame.linearization_point.is_some() || frame.linearization_point.is_some();
    if fixed || rig.is_linearized() {
        r.px = predicted(l, &at.now, o, window)?;
    }
    r.px -= o.px();
    Some(r)
}
