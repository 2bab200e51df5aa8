//! A landmark's view by the rig as it is estimated: where each camera sits, and when each row was taken.
//!
//! Where nothing of that is estimated and shutters are global, this is `predict` and `reproject` as they
//! stand. Otherwise both cameras, the host's and the viewing one, are carried to their instants
//! (`shutter.rs`), and the view touches the cameras' columns of the rig. Residuals are taken at the
//! estimate, Jacobians at the linearisation points.

use super::landmarks::{Landmark, Observation};
use super::residuals::{predict, reproject, reproject_with_extrinsics, CameraModel, Reprojection, Transform};
use super::rig::{EXTRINSIC_DIM, TIME_DIM};
use super::shutter::{carry_back, DelayedCamera};
use super::window::Window;
use crate::limits::CAMERAS_MAX;
use glam::DVec2;

/// Derivatives of a view to the rig's columns that cameras touch; the first `camera_dim` are meant.
pub type CameraColumns = [[f64; TIME_DIM + EXTRINSIC_DIM * CAMERAS_MAX]; 2];

fn shifted(camera_model: &CameraModel, time_offset: f64, row: f32, slot: usize, window: &Window) -> DelayedCamera {
    DelayedCamera::new(
        &camera_model.body_from_cam,
        &window.frame(slot).twist,
        time_offset + camera_model.row_delay(row.into()),
    )
}

/// Where a camera sits when it takes a row of the frame in `slot`.
pub fn placed(camera: usize, row: f32, slot: usize, window: &Window) -> Transform {
    let camera_model = &window.rig.cameras()[camera];
    if window.rig.is_plain() {
        return camera_model.body_from_cam;
    }
    shifted(camera_model, window.rig.now.time_offset, row, slot, window).body_from_cam
}

/// Where the camera sits that a landmark is hosted in, for all its views.
pub fn host_cam(l: &Landmark, window: &Window) -> Transform {
    placed(l.host_camera as usize, l.host_row, l.host as usize, window)
}

/// Pixel at which the observation should be.
pub fn predicted(l: &Landmark, host_cam: &Transform, o: &Observation, window: &Window) -> Option<DVec2> {
    let camera_model = &window.rig.cameras()[o.camera as usize];
    let (host, target) = (&window.frame(l.host as usize).body, &window.frame(o.slot as usize).body);
    if window.rig.is_plain() {
        return predict(&l.point, host_cam, host, camera_model, target);
    }
    let camera_model =
        CameraModel { body_from_cam: placed(o.camera as usize, o.px[1], o.slot as usize, window), ..*camera_model };
    predict(&l.point, host_cam, host, &camera_model, target)
}

/// The host's camera at the estimate, and at the linearisation point where that has to be carried.
pub struct Host {
    now: Transform,
    fixed: Option<DelayedCamera>,
}

impl Host {
    pub fn of(l: &Landmark, window: &Window) -> Host {
        let (rig, slot) = (&window.rig, l.host as usize);
        let camera_model = &rig.cameras_linearized()[l.host_camera as usize];
        let fixed = || shifted(camera_model, rig.linearized().time_offset, l.host_row, slot, window);
        Host { now: host_cam(l, window), fixed: (!rig.is_plain()).then(fixed) }
    }
}

/// Prediction minus observation, and derivatives; those to the rig, where it has columns, go to `columns`.
pub fn observe(
    l: &Landmark,
    host: &Host,
    o: &Observation,
    window: &Window,
    columns: &mut CameraColumns,
) -> Option<Reprojection> {
    let rig = &window.rig;
    let (h, t) = (window.frame(l.host as usize), window.frame(o.slot as usize));
    let (host_camera, camera) = (l.host_camera as usize, o.camera as usize);
    let (host_cam, camera_model) = (&rig.cameras_linearized()[host_camera], &rig.cameras_linearized()[camera]);
    let mut r = if let Some(host) = &host.fixed {
        let target = shifted(camera_model, rig.linearized().time_offset, o.px[1], o.slot as usize, window);
        let camera_model = CameraModel { body_from_cam: target.body_from_cam, ..*camera_model };
        let (r, mut d) = reproject_with_extrinsics(
            &l.point,
            &host.body_from_cam,
            &h.body_linearized,
            &camera_model,
            &t.body_linearized,
        )?;
        let d_time = carry_back(&mut d, host, &target);
        for (k, row) in columns.iter_mut().enumerate() {
            row.fill(0.0);
            if rig.parts.time_offset {
                row[0] = d_time[k];
            }
            for (camera, d) in [(host_camera, &d.host[k]), (camera, &d.target[k])] {
                if let Some(at) = rig.extrinsic_column(camera) {
                    row[at..].iter_mut().zip(d).for_each(|(sum, d)| *sum += d);
                }
            }
        }
        r
    } else {
        reproject(&l.point, &host_cam.body_from_cam, &h.body_linearized, camera_model, &t.body_linearized)?
    };
    if h.is_linearized || t.is_linearized || rig.is_linearized {
        r.px = predicted(l, &host.now, o, window)?;
    }
    r.px -= o.px();
    Some(r)
}
